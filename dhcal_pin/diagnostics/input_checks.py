"""Readings that are probably not what they say: a wrong unit, a row twice, a joint beyond its limits.

These are doubts, not errors: nothing is changed or left out. They are told before anything is fitted, from
the robot's nominal geometry, and hold wherever instrument and target are.
"""

from __future__ import annotations

from collections.abc import Container, Mapping

import numpy as np

from .._typing import Array
from ..calibration.evaluation import deviations
from ..calibration.initialization import align
from ..io.measurement_columns import ROTVEC, TO
from ..io.measurement_csv import Readings
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..units import ANGLES, LENGTHS
from .column_mixups import misturned, mixed_up, spread
from .reachability import reach

# Revolute joints do not turn more than this, rad, nor slides slide more than this, m.
_MOST_TURN, _MOST_SLIDE = 4 * np.pi, 20.0


# How far beyond its limits a joint is read without a remark, rad or m.
_LIMIT_SLACK = 1e-3


# How far a target may sit from the tip, and an instrument from the arm, m.
_TOOL, _HALL = 1.0, 50.0


# Lengths that no one sets up on purpose, m; sigmas that no instrument has, m and rad.
_LEAST_LENGTH, _MOST_SIGMA = 2e-3, {"length": 0.05, "angle": 0.2}


# Half of the rotations differ by more than this from what the joints say, rad: another convention.
_MOST_MISTURN = 0.35


# A calibrated arm usually is nearer to its readings than this share of its reach, or angle in rad.
_MISFIT, _MISFIT_ANGLE = 0.02, 0.1


# Rows that the tests of geometry look at, at most.
_SAMPLE = 2000


def doubts(chain: Chain, readings: Readings) -> list[str]:
    """What is hard to believe in a file, a sentence each; an empty list for most files."""
    joints = _joint_units(chain, readings)
    out = [*joints.values(), *_small_joints(chain, readings)]
    sizes = _sizes(chain, readings)
    # With joint values in doubt, how they move and turn the tool says nothing about the readings.
    moves = [] if out or sizes else mixed_up(chain, readings.data)
    turns = [] if out or moves else _turns(chain, readings)
    out += [*sizes, *moves, *turns, *_outside(chain, readings, joints)]
    return [*out, *_repeated(readings)]


def misfits(
    chain: Chain, data: Mapping[str, Measurement], known: Mapping[str, float]
) -> dict[str, list[str]]:
    """Readings that stay far from the arm that was fitted to them and others, sentences by file.

    Args:
        chain: calibrated.
        data: the fitted readings by file.
        known: values of the instruments' unknowns by name, as found.
    """
    _, radius = reach(chain)
    bounds = {"orientation": _MISFIT_ANGLE}
    out: dict[str, list[str]] = {path: [] for path in data}
    for (path, item), found in zip(data.items(), deviations(chain, list(data.values()), known), strict=True):
        names = {unknown.name for unknown in item.unknowns if not unknown.local}
        shared = [other for other in data if other != path and names & {u.name for u in data[other].unknowns}]
        for what, errors in found.items():
            usual = float(np.median(np.linalg.norm(errors, axis=1)))
            if usual <= bounds.get(what, _MISFIT * radius):
                continue
            text = f"after the fit, {what} is usually {_size(usual, what)} off; check robot, tip and columns"
            if shared:
                text += f", and whether its {min(names).split('.')[0]} is that of {' and '.join(shared)}"
            out[path].append(text)
    return out


def _size(value: float, what: str) -> str:
    return f"{np.rad2deg(value):.3g} deg" if what == "orientation" else f"{1e3 * value:.3g} mm"


def _ends(readings: Readings) -> list[Array]:
    """Joint values (m, n) of each configuration of a row."""
    data = readings.data
    return np.split(data.configurations(), data.ends) if data.ends else []


def _sample(count: int) -> Array:
    return np.unique(np.linspace(0, count - 1, min(count, _SAMPLE)).astype(int))


def _written(value: float, unit: str) -> str:
    """A value in SI as it stood in the file."""
    factor = {**LENGTHS, **ANGLES}.get(unit, 1.0)
    return f"{value * factor:.4g} {unit}".rstrip()


def _rows(readings: Readings, mask: Array) -> str:
    """`row 3` or `rows 3, 5, 8 and 4 more`."""
    rows = [str(row) for row in readings.data.rows[mask]]
    more = f" and {len(rows) - 5} more" if len(rows) > 5 else ""
    return f"row{'s' if len(rows) > 1 else ''} {', '.join(rows[:5])}{more}"


def _joint_units(chain: Chain, readings: Readings) -> dict[str, str]:
    """Joints that cannot have moved as far as their column says, by the column's name."""
    out: dict[str, str] = {}
    for before, q in zip(("", TO), _ends(readings), strict=False):
        for j, name in enumerate(chain.joint_names):
            slides = chain.urdf.joint(name).type == "prismatic"
            most, unit = float(np.max(np.abs(q[:, j]), initial=0.0)), readings.units[before + name]
            if most > (_MOST_SLIDE if slides else _MOST_TURN):
                far = "far for a slide" if slides else f"{most / (2 * np.pi):.1f} turns"
                out[before + name] = (
                    f"joint {before + name} goes to {_written(most, unit)}, {far}; "
                    f"if these are {'mm' if slides else 'degrees'}, say so in its unit"
                )
    return out


def _small_joints(chain: Chain, readings: Readings) -> list[str]:
    """Radians in columns of degrees: no joint moves, but the tool does."""
    ends = _ends(readings)
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
    seen, index = readings.data.positions(), _sample(len(ends[0]))
    if len(seen) and spread(seen[index]) < 5 * spread(chain.poses(ends[0][index])[:, :3, 3]):
        return []
    return [
        f"no joint goes further than {most:.3g} deg, so the arm hardly moves; "
        "if these are radians, write [rad] for [deg]"
    ]


def _sizes(chain: Chain, readings: Readings) -> list[str]:
    """Lengths that are far too long or far too short for this arm."""
    _, radius = reach(chain)
    out = _position_sizes(chain, readings, radius)
    for name, what in readings.data.columns.items():
        if name not in readings.values or what == "text" or name in ("x", "y", "z", *ROTVEC):
            continue
        size, unit = np.abs(readings.values[name]), readings.units.get(name, "")
        usual, most = float(np.median(size)), float(size.max())
        if "sigma" in name:
            if usual > _MOST_SIGMA[what]:
                out.append(f"{name} is {_written(usual, unit)}: no instrument is that coarse; check its unit")
        elif what == "length":
            # Ends of a known distance are both within reach; a wire may come from across the hall.
            limit = 2 * (radius + _TOOL) if name[0] == "d" else radius + _HALL
            if usual > limit:
                out.append(
                    f"{name} is {_written(usual, unit)}, and the arm reaches {radius:.2g} m; "
                    "if these are mm, say so in its unit"
                )
            elif 0 < most < _LEAST_LENGTH and readings.data.ends < 2:
                out.append(f"{name} is {_written(most, unit)} at most; if these are metres, write {name}[m]")
    return out


def _position_sizes(chain: Chain, readings: Readings, radius: float) -> list[str]:
    """Positions spread wider than the arm reaches, or as the arm moves but a hundred times smaller."""
    seen = readings.data.positions()
    if len(seen) < 3:
        return []
    index = _sample(len(seen))
    seen, unit = seen[index], readings.units.get("x", "")
    moved, extent = chain.poses(readings.data.q[index])[:, :3, 3], spread(seen)
    if extent > 3 * (radius + _TOOL):
        return [
            f"the positions lie {_written(extent, unit)} around their middle, and the arm reaches "
            f"{radius:.2g} m; if they are mm, write x[mm],y[mm],z[mm]"
        ]
    wanted = spread(moved)
    if 0 < extent < wanted / 50 and align(seen * (wanted / extent), moved)[1] < 0.5 * wanted:
        return [
            f"the positions lie {_written(extent, unit)} around their middle where the arm moves its tip by "
            f"{_written(wanted, unit)}; if they are metres, write x[m],y[m],z[m]"
        ]
    return []


def _turns(chain: Chain, readings: Readings) -> list[str]:
    """Rotation vectors longer than a turn, and rotations that do not turn as the joints do."""
    vectors = [readings.values[name] for name in ROTVEC if name in readings.values]
    unit = readings.units.get("rx", "")
    if len(vectors) == 3 and unit and (longest := np.linalg.norm(vectors, axis=0).max()) > 2 * np.pi + 0.1:
        return [
            f"a rotation vector rx,ry,rz is {_written(longest, unit)} long, more than a turn; "
            "if these are degrees write [deg], and Euler angles need a map (--columns)"
        ]
    turned = readings.data.rotations()
    if len(turned) < 3:
        return []
    index = _sample(len(turned))
    modelled = chain.poses(readings.data.q[index])[:, :3, :3]
    off = misturned(modelled, turned[index])
    if off <= _MOST_MISTURN:
        return []
    return [
        f"the measured rotations are usually {np.rad2deg(off):.0f} deg off this arm's wherever instrument "
        "and target are; check unit, order of a quaternion, axes and frame of Euler angles, "
        "rows of a matrix, and the tip"
    ]


def _outside(chain: Chain, readings: Readings, known: Container[str]) -> list[str]:
    """Joint values beyond the robot's limits, but for columns whose unit is in doubt anyhow."""
    out = []
    for before, q in zip(("", TO), _ends(readings), strict=False):
        for j, name in enumerate(chain.joint_names):
            low, high = chain.lower[j], chain.upper[j]
            beyond = (q[:, j] < low - _LIMIT_SLACK) | (q[:, j] > high + _LIMIT_SLACK)
            if beyond.any() and before + name not in known:
                unit = readings.units[before + name]
                out.append(
                    f"joint {before + name} is beyond its limits, {_written(low, unit)} to "
                    f"{_written(high, unit)}, in {_rows(readings, beyond)}; check sign, offset and unit"
                )
    return out


def _repeated(readings: Readings) -> list[str]:
    """Rows with the same joint values and the same readings."""
    columns: list[Array] = [column for q in _ends(readings) for column in q.T]
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
