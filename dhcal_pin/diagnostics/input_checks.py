"""Readings that are probably not what they say: a wrong unit, a row twice, a joint beyond its limits.

These are doubts, not errors: nothing is changed or left out. They are told before anything is fitted, from
the robot's nominal geometry, and hold wherever instrument and target are.
"""

from __future__ import annotations

from collections.abc import Container, Mapping

import numpy as np

from .._typing import Array
from ..calibration.evaluation import compute_errors
from ..calibration.initialization import align
from ..io.measurement_columns import ROTVEC, SECOND_PREFIX
from ..io.measurement_csv import MeasurementFile
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..units import ANGLES, LENGTHS
from .column_mixups import diagnose_mixups, median_radius, orientation_misfit
from .reachability import reach_sphere

# Revolute joints do not turn more than this, rad, nor slides slide more than this, m.
_MAX_TURN_RAD, _MAX_STROKE_M = 4 * np.pi, 20.0


# How far beyond its limits a joint is read without a remark, rad or m.
_LIMIT_SLACK = 1e-3


# How far a target may sit from the tip, and an instrument from the arm, m.
_MAX_TOOL_OFFSET_M, _MAX_INSTRUMENT_DISTANCE_M = 1.0, 50.0


# Lengths that no one sets up on purpose, m; sigmas that no instrument has, m and rad.
_MIN_LENGTH_M, _MAX_SIGMA = 2e-3, {"length": 0.05, "angle": 0.2}


# Half of the rotations differ by more than this from what the joints say, rad: another convention.
_MAX_ORIENTATION_MISFIT_RAD = 0.35


# A calibrated arm usually is nearer to its readings than this share of its reach, or angle in rad.
_MAX_RELATIVE_MISFIT, _MAX_MISFIT_RAD = 0.02, 0.1


# Rows that the tests of geometry look at, at most.
_MAX_ROWS = 2000


def find_input_warnings(chain: Chain, readings: MeasurementFile) -> list[str]:
    """What is hard to believe in a file, a sentence each; an empty list for most files."""
    joints = _joint_units(chain, readings)
    out = [*joints.values(), *_small_joints(chain, readings)]
    sizes = _sizes(chain, readings)
    # With joint values in doubt, how they move and turn the tool says nothing about the readings.
    moves = [] if out or sizes else diagnose_mixups(chain, readings.data)
    turns = [] if out or moves else _turns(chain, readings)
    out += [*sizes, *moves, *turns, *_outside(chain, readings, joints)]
    return [*out, *_repeated(readings)]


def poorly_fitted_files(
    chain: Chain, data: Mapping[str, Measurement], known: Mapping[str, float]
) -> dict[str, list[str]]:
    """Readings that stay far from the arm that was fitted to them and others, sentences by file.

    Args:
        chain: calibrated.
        data: the fitted readings by file.
        known: values of the instruments' unknowns by name, as found.
    """
    _, radius = reach_sphere(chain)
    bounds = {"orientation": _MAX_MISFIT_RAD}
    out: dict[str, list[str]] = {path: [] for path in data}
    for (path, item), found in zip(
        data.items(), compute_errors(chain, list(data.values()), known), strict=True
    ):
        names = {unknown.name for unknown in item.instrument_parameters if not unknown.is_local}
        shared = [
            other
            for other in data
            if other != path and names & {u.name for u in data[other].instrument_parameters}
        ]
        for what, errors in found.items():
            usual = float(np.median(np.linalg.norm(errors, axis=1)))
            if usual <= bounds.get(what, _MAX_RELATIVE_MISFIT * radius):
                continue
            text = f"after the fit, {what} is usually {_size(usual, what)} off; check robot, tip and columns"
            if shared:
                text += f", and whether its {min(names).split('.')[0]} is that of {' and '.join(shared)}"
            out[path].append(text)
    return out


def _size(value: float, what: str) -> str:
    return f"{np.rad2deg(value):.3g} deg" if what == "orientation" else f"{1e3 * value:.3g} mm"


def _configurations_per_row(readings: MeasurementFile) -> list[Array]:
    """Joint values (m, n) of each configuration of a row."""
    data = readings.data
    return np.split(data.configurations(), data.configurations_per_row) if data.configurations_per_row else []


def _subsample(count: int) -> Array:
    return np.unique(np.linspace(0, count - 1, min(count, _MAX_ROWS)).astype(int))


def _format_as_written(value: float, unit: str) -> str:
    """A value in SI as it stood in the file."""
    factor = {**LENGTHS, **ANGLES}.get(unit, 1.0)
    return f"{value * factor:.4g} {unit}".rstrip()


def _rows(readings: MeasurementFile, mask: Array) -> str:
    """`row 3` or `rows 3, 5, 8 and 4 more`."""
    rows = [str(row) for row in readings.data.rows[mask]]
    more = f" and {len(rows) - 5} more" if len(rows) > 5 else ""
    return f"row{'s' if len(rows) > 1 else ''} {', '.join(rows[:5])}{more}"


def _joint_units(chain: Chain, readings: MeasurementFile) -> dict[str, str]:
    """Joints that cannot have moved as far as their column says, by the column's name."""
    out: dict[str, str] = {}
    for before, q in zip(("", SECOND_PREFIX), _configurations_per_row(readings), strict=False):
        for j, name in enumerate(chain.joint_names):
            slides = chain.urdf.joint(name).type == "prismatic"
            most, unit = float(np.max(np.abs(q[:, j]), initial=0.0)), readings.units[before + name]
            if most > (_MAX_STROKE_M if slides else _MAX_TURN_RAD):
                far = "far for a slide" if slides else f"{most / (2 * np.pi):.1f} turns"
                out[before + name] = (
                    f"joint {before + name} goes to {_format_as_written(most, unit)}, {far}; "
                    f"if these are {'mm' if slides else 'degrees'}, say so in its unit"
                )
    return out


def _small_joints(chain: Chain, readings: MeasurementFile) -> list[str]:
    """Radians in columns of degrees: no joint moves, but the tool does."""
    ends = _configurations_per_row(readings)
    turning = [
        j
        for j, name in enumerate(chain.joint_names)
        if chain.urdf.joint(name).type != "prismatic" and readings.units.get(name) == "deg"
    ]
    if not ends or not turning:
        return []
    most = float(np.max(np.abs(np.concatenate(ends)[:, turning]), initial=0.0)) * ANGLES["deg"]
    if not 1.0 < most <= 2 * np.pi:
        return []
    seen, index = readings.data.positions(), _subsample(len(ends[0]))
    if len(seen) and median_radius(seen[index]) < 5 * median_radius(chain.poses(ends[0][index])[:, :3, 3]):
        return []
    return [
        f"no joint goes further than {most:.3g} deg, so the arm hardly moves; "
        "if these are radians, write [rad] for [deg]"
    ]


def _sizes(chain: Chain, readings: MeasurementFile) -> list[str]:
    """Lengths that are far too long or far too short for this arm."""
    _, radius = reach_sphere(chain)
    out = _position_sizes(chain, readings, radius)
    for name, what in readings.data.columns.items():
        if name not in readings.values or what == "text" or name in ("x", "y", "z", *ROTVEC):
            continue
        size, unit = np.abs(readings.values[name]), readings.units.get(name, "")
        usual, most = float(np.median(size)), float(size.max())
        if "sigma" in name:
            if usual > _MAX_SIGMA[what]:
                out.append(
                    f"{name} is {_format_as_written(usual, unit)}: no instrument is that coarse; check its unit"
                )
        elif what == "length":
            # Ends of a known distance are both within reach; a wire may come from across the hall.
            limit = (
                2 * (radius + _MAX_TOOL_OFFSET_M) if name[0] == "d" else radius + _MAX_INSTRUMENT_DISTANCE_M
            )
            if usual > limit:
                out.append(
                    f"{name} is {_format_as_written(usual, unit)}, and the arm reaches {radius:.2g} m; "
                    "if these are mm, say so in its unit"
                )
            elif 0 < most < _MIN_LENGTH_M and readings.data.configurations_per_row < 2:
                out.append(
                    f"{name} is {_format_as_written(most, unit)} at most; if these are metres, write {name}[m]"
                )
    return out


def _position_sizes(chain: Chain, readings: MeasurementFile, radius: float) -> list[str]:
    """Positions spread wider than the arm reaches, or as the arm moves but a hundred times smaller."""
    seen = readings.data.positions()
    if len(seen) < 3:
        return []
    index = _subsample(len(seen))
    seen, unit = seen[index], readings.units.get("x", "")
    moved, extent = chain.poses(readings.data.q[index])[:, :3, 3], median_radius(seen)
    if extent > 3 * (radius + _MAX_TOOL_OFFSET_M):
        return [
            f"the positions lie {_format_as_written(extent, unit)} around their middle, and the arm reaches "
            f"{radius:.2g} m; if they are mm, write x[mm],y[mm],z[mm]"
        ]
    wanted = median_radius(moved)
    if 0 < extent < wanted / 50 and align(seen * (wanted / extent), moved)[1] < 0.5 * wanted:
        return [
            f"the positions lie {_format_as_written(extent, unit)} around their middle where the arm moves its tip by "
            f"{_format_as_written(wanted, unit)}; if they are metres, write x[m],y[m],z[m]"
        ]
    return []


def _turns(chain: Chain, readings: MeasurementFile) -> list[str]:
    """Rotation vectors longer than a turn, and rotations that do not turn as the joints do."""
    vectors = [readings.values[name] for name in ROTVEC if name in readings.values]
    unit = readings.units.get("rx", "")
    if len(vectors) == 3 and unit and (longest := np.linalg.norm(vectors, axis=0).max()) > 2 * np.pi + 0.1:
        return [
            f"a rotation vector rx,ry,rz is {_format_as_written(longest, unit)} long, more than a turn; "
            "if these are degrees write [deg], and Euler angles need a map (--columns)"
        ]
    turned = readings.data.rotations()
    if len(turned) < 3:
        return []
    index = _subsample(len(turned))
    modelled = chain.poses(readings.data.q[index])[:, :3, :3]
    off = orientation_misfit(modelled, turned[index])
    if off <= _MAX_ORIENTATION_MISFIT_RAD:
        return []
    return [
        f"the measured rotations are usually {np.rad2deg(off):.0f} deg off this arm's wherever instrument "
        "and target are; check unit, order of a quaternion, axes and frame of Euler angles, "
        "rows of a matrix, and the tip"
    ]


def _outside(chain: Chain, readings: MeasurementFile, known: Container[str]) -> list[str]:
    """Joint values beyond the robot's limits, but for columns whose unit is in doubt anyhow."""
    out = []
    for before, q in zip(("", SECOND_PREFIX), _configurations_per_row(readings), strict=False):
        for j, name in enumerate(chain.joint_names):
            low, high = chain.lower[j], chain.upper[j]
            beyond = (q[:, j] < low - _LIMIT_SLACK) | (q[:, j] > high + _LIMIT_SLACK)
            if beyond.any() and before + name not in known:
                unit = readings.units[before + name]
                out.append(
                    f"joint {before + name} is beyond its limits, {_format_as_written(low, unit)} to "
                    f"{_format_as_written(high, unit)}, in {_rows(readings, beyond)}; check sign, offset and unit"
                )
    return out


def _repeated(readings: MeasurementFile) -> list[str]:
    """Rows with the same joint values and the same readings."""
    columns: list[Array] = [column for q in _configurations_per_row(readings) for column in q.T]
    columns += [np.asarray(values) for values in readings.values.values()]
    if not columns or not len(columns[0]):
        return []
    # Texts and numbers alike by their place in the sorted column.
    keys = np.stack([np.unique(column, return_inverse=True)[1] for column in columns], -1)
    first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)[1:]
    again = np.ones(len(keys), bool)
    again[first] = False
    if not again.any():
        return []
    example = int(np.flatnonzero(again)[0])
    source = int(readings.data.rows[first[inverse[example]]])
    return [
        f"{_rows(readings, again)}: the same as others to the last digit (row "
        f"{readings.data.rows[example]} as row {source}); a copied reading counts twice"
    ]
