"""Checks of measurement files before a fit, and of the errors of each file after it.

The checks find values that are probably not what their header says: a wrong unit, a repeated row, a joint
beyond its limits, mixed-up columns. They return warnings; nothing is changed or rejected. Before the fit they
only use the nominal geometry of the robot and quantities that do not depend on where instrument and target
are, such as the spread of positions or the angles between rotations.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence

import numpy as np

from .._typing import Array
from ..calibration.evaluation import compute_errors
from ..estimation.initialization import align
from ..estimation.parameters import PARAMETER_SETS
from ..exceptions import FileFormatError
from ..formatting import join_names, list_first
from ..io.measurement_files import MeasurementFile
from ..io.measurement_files.columns import ROTVEC, SECOND_PREFIX, VALUE_COLUMNS
from ..io.measurement_files.counts import TICKS
from ..io.measurement_files.fitted_rows import count_fitted_rows
from ..io.servo_file import RESOLUTION
from ..io.sidecar import Fitted
from ..measurements.base import Measurement, known_conditions
from ..measurements.columns import MAX_TOOL_OFFSET
from ..measurements.groups import ERROR_GROUPS, error_group
from ..plausibility.displacement import workspace_radius
from ..plausibility.mixups import diagnose_mixups
from ..robot.chain import Chain
from ..robot.conditions import CONDITIONS
from ..robot.error_families import COMPLIANCE
from ..units import ANGLES, LENGTHS
from .reachability import reach_sphere

# Larger joint positions mean a wrong unit: no revolute joint turns further [rad], no prismatic joint slides
# further [m].
_MAX_TURN_RAD, _MAX_STROKE_M = 4 * np.pi, 20.0
# Revolute joints in degrees whose positions lie all in this range are probably in radians [deg]: below, the
# robot does not move; above, no joint limit in radians would allow it.
_MIN_RADIANS_AS_DEG, _MAX_RADIANS_AS_DEG = 1.0, 2 * np.pi
# In that case the measured positions spread by more than this factor farther than the modelled ones.
_MIN_SPREAD_RATIO = 5.0
# Largest mass that a robot carries [kg].
_MAX_PAYLOAD = 2500.0
# Difference of two masses that counts as rounding [kg].
_MASS_TOL = 1e-6
# A joint may exceed its limits by this much without a warning [rad or m]; controllers round.
_LIMIT_SLACK = 1e-3
# Warning about a file that the calibration fitted.
_FITTED_WARNING = "by the calibration of this robot; other measurements have larger errors"
# Largest median error of image coordinates after a fit that gets no warning [px].
_MAX_CALIBRATED_PX = 10.0
# Larger standard deviations mean a wrong unit: no instrument is so coarse [m], [rad].
_MAX_SIGMA = {"length": 0.05, "angle": 0.2}
# Positions that spread farther than this factor times the reach mean a wrong unit.
_MAX_SPREAD_RATIO = 3.0
# Positions that spread this many times less than the modelled ones are probably in metres instead of
# millimetres, if they fit the modelled ones after scaling with a smaller error than the second factor times
# their spread.
_MIN_SCALE, _MAX_SCALED_MISFIT = 50.0, 0.5
# A rotation vector need not be longer than a turn; this much is left for rounding [rad].
_ROTVEC_SLACK_RAD = 0.1
# A calibrated robot usually has smaller errors than this share of its reach, and smaller ones than this angle
# [rad].
_MAX_RELATIVE_MISFIT, _MAX_CALIBRATED_RAD = 0.02, 0.1
# Larger residuals, relative to the size of the workspace or [rad], mean another robot or notation.
_MAX_MISFIT, _MAX_MISFIT_RAD = 0.05, 0.2
# If at least this share of the corners of a board in an image is there again, the rows are of several
# photographs in the same configuration.
_MIN_PHOTOGRAPHED_SHARE = 0.5
# Fewer positions or rotations than this cannot be compared.
_MIN_SAMPLES = 3
# Largest number of rows that the geometric checks use.
_MAX_ROWS = 2000
# Lines that a warning lists before it says how many more there are.
_MAX_LISTED_ROWS = 5


def find_input_warnings(chain: Chain, file: MeasurementFile) -> list[str]:
    """Find implausible values and mixed-up columns in a measurement file."""
    values, repeated = find_value_warnings(chain, file), _check_repetitions(file)
    if values != repeated:
        # Implausible values explain why measurements do not fit the robot; copied rows do not.
        return values
    return [*_check_fit(chain, file), *repeated]


def fitted_warning(item: Measurement, digest: str, fitted: Fitted) -> list[str]:
    """Return a warning about a file with rows that the calibration fitted."""
    if count := count_fitted_rows(item, fitted.rows):
        n_rows = len(item.rows)
        rows = f"row{'' if n_rows == 1 else 's'} {'was' if count == 1 else 'were'}"
        return [f"{count} of {n_rows} {rows} fitted {_FITTED_WARNING}"]
    return [f"this file or a part of it was fitted {_FITTED_WARNING}"] if digest in fitted.files else []


def find_unstated_conditions(
    chain: Chain, known: Container[str], payloads: tuple[float, float] | None = None
) -> list[str]:
    """Name the joint errors of a robot whose condition is not known, with the missing column."""
    # The payload is that of the model, unless the calibration had several, from the least to the largest.
    is_loaded = payloads is not None and payloads[0] < payloads[1]
    needed = [(family, family.condition) for family in chain.error_families if family.condition]
    needed += [(f, "payload") for f in chain.error_families if f.name == COMPLIANCE and is_loaded]
    return [
        f"the {CONDITIONS[name].description} is not stated, on which the {family.description} of the robot "
        f"depends: add the column {CONDITIONS[name].header}"
        for family, name in needed
        if name not in known
    ]


def file_notes(
    chain: Chain, files: Sequence[MeasurementFile], payloads: tuple[float, float] | None
) -> list[str]:
    """List the notes on files, and the conditions that they do not state."""
    return [
        f"{file.source}: {text}"
        for file in files
        for text in (
            *file.notes,
            *find_unstated_conditions(chain, known_conditions([file.data]), payloads),
            *find_payload_notes(chain, file, payloads),
        )
    ]


def find_payload_warnings(chain: Chain, file: MeasurementFile) -> list[str]:
    """Find payloads that bend no joint, or that the result of a calibration does not contain."""
    masses = file.data.conditions().payload
    if masses is None or not np.any(masses > 0) or np.any(masses > _MAX_PAYLOAD) or chain.payload is not None:
        return []
    option = "state mass and centre of the payload by --payload, such as 5kg@0,0,80mm"
    if not PARAMETER_SETS[COMPLIANCE](chain):
        return [f"the column of the payload has no effect, because the robot has no masses; {option}"]
    if np.ptp(masses) == 0:
        mass = f"{masses[0]:g} kg"
        return [f"the payload is {mass} in all rows, but the result holds for the robot without it; {option}"]
    return []


def find_payload_notes(
    chain: Chain, file: MeasurementFile, payloads: tuple[float, float] | None
) -> list[str]:
    """Name payloads beyond those of the calibration of a robot, from the smallest to the largest one."""
    masses = file.data.conditions().payload
    is_elastic = COMPLIANCE in {family.name for family in chain.error_families}
    if masses is None or (payloads is None and not is_elastic):
        return []
    mass = chain.payload.mass if chain.payload else 0.0
    low, high = payloads or (mass, mass)
    is_beyond = (masses < low - _MASS_TOL) | (masses > high + _MASS_TOL)
    if not is_beyond.any():
        return []
    beyond = _format_masses(masses[is_beyond].min(), masses[is_beyond].max())
    calibrated = f"has {_format_masses(low, high)}" if high else "has no payload"
    if is_elastic:
        effect = "how far the joints yield is extrapolated, and its error is not known"
    else:
        effect = "the joints of the model do not yield, so that the column has no effect"
    rows = _format_rows(file.data, is_beyond)
    return [f"the payload is {beyond} in {rows}, and the calibration {calibrated}: {effect}"]


def _format_masses(low: float, high: float) -> str:
    """Return the text of a range of masses."""
    return f"{low:g} kg" if high - low <= _MASS_TOL else f"{low:g} to {high:g} kg"


def _check_fit(chain: Chain, file: MeasurementFile) -> list[str]:
    """Return a warning about columns that are mixed up, or measurements that do not fit the robot."""
    diagnosis = diagnose_mixups(chain, [file.data])
    if diagnosis.hypotheses:
        return [diagnosis.sentence]
    length, angle = diagnosis.before.length_scale, diagnosis.before.angle_scale
    if not (length > _MAX_MISFIT * workspace_radius(chain) or angle > _MAX_MISFIT_RAD):
        return []
    size = f"{np.rad2deg(angle):.3g} deg" if angle > _MAX_MISFIT_RAD else f"{1e3 * length:.3g} mm"
    return [
        f"the measurements differ from this robot by {size}, with the best base and target; check the robot "
        "and tip, the units, order, signs and zeros of the joints, and the notation of rotations: unit, "
        "order of a quaternion, axes and frame of Euler angles"
    ]


def find_value_warnings(chain: Chain, file: MeasurementFile) -> list[str]:
    """Find implausible values in a measurement file."""
    too_far = _columns_beyond_motion(chain, file)
    joints = [*_check_joint_units(chain, file, too_far), *_check_small_joints(chain, file)]
    return [
        *_check_tip(chain, file),
        *joints,
        *_check_lengths(chain, file),
        *_check_rotations(file),
        *_check_limits(chain, file, too_far),
        *_check_masses(file),
        *_check_repetitions(file),
    ]


def require_joint_units(chain: Chain, file: MeasurementFile) -> None:
    """Raise an error if most joints of images turn farther than joints can."""
    # A fit to such images takes long, and its result does not show the cause.
    if file.data.rig is None:
        return
    too_far = _columns_beyond_motion(chain, file)
    if 2 * len(too_far) > chain.n_joints:
        raise FileFormatError(f"{file.source}: {_check_joint_units(chain, file, too_far)[0]}")


def _check_tip(chain: Chain, file: MeasurementFile) -> list[str]:
    """Return a warning if joints behind the tip move."""
    behind = [
        name
        for name in file.other_moving_joints
        if chain.tip in {joint.child for joint in chain.urdf.path(chain.urdf.joint(name).parent)}
    ]
    if not behind:
        return []
    return [
        f"moving joints behind the tip {chain.tip} are ignored: {', '.join(behind)}; if a link behind them "
        "was measured, name it with --tip"
    ]


def poorly_fitted_files(
    chain: Chain, data: Mapping[str, Measurement], known: Mapping[str, float]
) -> dict[str, list[str]]:
    """Find files whose errors remain large after a fit to them and others."""
    _, reach = reach_sphere(chain)
    limits = {"m": _MAX_RELATIVE_MISFIT * reach, "rad": _MAX_CALIBRATED_RAD, "px": _MAX_CALIBRATED_PX}
    out: dict[str, list[str]] = {path: [] for path in data}
    for (path, item), all_errors in zip(
        data.items(), compute_errors(chain, list(data.values()), known), strict=True
    ):
        names = {parameter.name for parameter in item.instrument_parameters if not parameter.is_local}
        sharing = [
            other
            for other in data
            if other != path and names & {parameter.name for parameter in data[other].instrument_parameters}
        ]
        for group, errors in all_errors.items():
            norms = np.linalg.norm(errors, axis=1)
            # A corner behind its camera has no error.
            norms = norms[np.isfinite(norms)]
            median = float(np.median(norms)) if len(norms) else 0.0
            si_unit = ERROR_GROUPS[error_group(group)].unit
            if median <= limits[si_unit]:
                continue
            factor, unit = {"m": (1e3, "mm"), "rad": (180 / np.pi, "deg"), "px": (1.0, "px")}[si_unit]
            size = f"{factor * median:.3g} {unit}"
            text = (
                f"after the fit, the median {group} error is {size}; check the robot, the tip and the columns"
            )
            if sharing:
                instrument = min(names).split(".")[0]
                text += f", and whether {instrument} is the same one as in {' and '.join(sharing)}"
            out[path].append(text)
    return out


def median_radius(points: Array) -> float:
    """Compute the median distance of points from their median, which outliers hardly change."""
    return float(np.median(np.linalg.norm(points - np.median(points, 0), axis=1)))


def _joint_positions_by_configuration(file: MeasurementFile) -> list[Array]:
    """Return the joint positions (m, n) of each configuration of a row; none of a file without them."""
    data = file.data
    if not data.has_joint_values:
        return []
    return np.split(data.configurations(), data.configurations_per_row) if data.configurations_per_row else []


def _subsample(count: int) -> Array:
    """Return indices of at most _MAX_ROWS rows, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(count, _MAX_ROWS)).astype(int))


def _format_as_written(value: float, unit: str) -> str:
    """Return a value in m or rad as it is written in a file with another unit."""
    factor = {**LENGTHS, **ANGLES}.get(unit, 1.0)
    return f"{value * factor:.4g} {unit}".rstrip()


def _format_rows(data: Measurement, mask: Array) -> str:
    """Return a text such as `line 3` or `lines 3, 5, 8, 9, 12 and 4 more`."""
    rows = data.rows[mask].tolist()
    return f"line{'s' if len(rows) > 1 else ''} {list_first(rows, _MAX_LISTED_ROWS)}"


def _columns_beyond_motion(chain: Chain, file: MeasurementFile) -> dict[str, Array]:
    """Return the values [rad or m] of joints that cannot move as far as their columns say, by column name."""
    return {
        prefix + name: q[:, j]
        for prefix, q in zip(("", SECOND_PREFIX), _joint_positions_by_configuration(file), strict=False)
        for j, name in enumerate(chain.joint_names)
        if np.max(np.abs(q[:, j]), initial=0.0) > (_MAX_STROKE_M if chain.is_prismatic[j] else _MAX_TURN_RAD)
    }


def _check_joint_units(chain: Chain, file: MeasurementFile, too_far: Mapping[str, Array]) -> list[str]:
    """Return a warning about the revolute and one about the prismatic joints that move too far."""
    slides = {name for j, name in enumerate(chain.joint_names) if chain.is_prismatic[j]}
    out = []
    for units in (ANGLES, LENGTHS):
        is_slide = units is LENGTHS
        columns = [name for name in too_far if (name.removeprefix(SECOND_PREFIX) in slides) == is_slide]
        if not columns:
            continue
        first, *others = columns
        largest, unit = float(np.abs(too_far[first]).max()), file.units[first]
        problem = f"{largest / (2 * np.pi):.1f} turns" if units is ANGLES else "too far for a prismatic joint"
        out.append(
            f"joint {first} reaches {_format_as_written(largest, unit)}, {problem}; "
            f"{_joint_unit_remedy({name: too_far[name] for name in columns}, file, units)}"
            + (f" (also {join_names(others)})" if others else "")
        )
    return out


def _joint_unit_remedy(
    too_far: Mapping[str, Array], file: MeasurementFile, units: Mapping[str, float]
) -> str:
    """Say which unit explains that joints move too far: one that the header does not state, or counts."""
    written = {name: values * units.get(file.units[name], 1.0) for name, values in too_far.items()}
    largest = max(float(np.abs(values).max()) for values in written.values())
    word, short, limit = (
        ("degrees", "deg", _MAX_TURN_RAD) if units is ANGLES else ("millimetres", "mm", _MAX_STROKE_M)
    )
    if short not in {file.units[name] for name in too_far} and largest <= limit * units[short]:
        return f"if the values are {word}, write [{short}] in the header"
    if units is ANGLES and all(_are_counts(values) for values in written.values()):
        return (
            f"whole numbers from 0 to {RESOLUTION - 1} look like counts of servos; if they are, write "
            f"{next(iter(too_far))}[{TICKS}] in the header, and state a servo file (--servos)"
        )
    return "check the values and the unit in the header"


def _are_counts(values: Array) -> bool:
    """Return whether values (m,) are whole numbers in the range of a servo's encoder."""
    whole = np.round(values)
    is_whole = np.abs(values - whole) <= 1e-9 * np.maximum(1.0, np.abs(values))
    return bool(np.all(is_whole & (whole >= 0) & (whole < RESOLUTION)))


def _check_small_joints(chain: Chain, file: MeasurementFile) -> list[str]:
    """Return a warning if columns in degrees hold radians: no joint moves, but the tool does."""
    configurations = _joint_positions_by_configuration(file)
    revolute = [
        j
        for j, name in enumerate(chain.joint_names)
        if chain.urdf.joint(name).type != "prismatic" and file.units.get(name) == "deg"
    ]
    if not configurations or not revolute:
        return []
    largest = float(np.max(np.abs(np.concatenate(configurations)[:, revolute]), initial=0.0)) * ANGLES["deg"]
    if not _MIN_RADIANS_AS_DEG < largest <= _MAX_RADIANS_AS_DEG:
        return []
    positions, index = file.data.positions(), _subsample(len(configurations[0]))
    if len(positions):
        modelled = chain.poses(configurations[0][index])[:, :3, 3]
        if median_radius(positions[index]) < _MIN_SPREAD_RATIO * median_radius(modelled):
            return []
    return [
        f"no joint moves beyond {largest:.3g} deg, so the robot hardly moves; "
        "if the values are radians, write [rad] instead of [deg] in the header"
    ]


def _check_lengths(chain: Chain, file: MeasurementFile) -> list[str]:
    """Return warnings about lengths that are too long or too short for the robot, and about large sigmas."""
    _, reach = reach_sphere(chain)
    out = _check_position_spread(chain, file, reach)
    data = file.data
    for name, quantity in data.columns.items():
        if name not in file.values or quantity not in _MAX_SIGMA:
            continue
        values, unit = np.abs(file.values[name]), file.units.get(name, "")
        median, largest = float(np.median(values)), float(values.max())
        if name.startswith("sigma_"):
            if median > _MAX_SIGMA[quantity]:
                out.append(
                    f"{name} is {_format_as_written(median, unit)}, more than that of any instrument; "
                    "check its unit"
                )
        elif (limits := data.plausible_range(name, reach)) is not None:
            smallest_plausible, largest_plausible = limits
            if median > largest_plausible:
                out.append(
                    f"{name} is {_format_as_written(median, unit)}, but the robot reaches {reach:.2g} m; "
                    f"{_other_unit([name], file, 'mm')}"
                )
            elif 0 < largest < smallest_plausible:
                out.append(
                    f"{name} is at most {_format_as_written(largest, unit)}; {_other_unit([name], file, 'm')}"
                )
    return out


def _other_unit(names: Sequence[str], file: MeasurementFile, unit: str) -> str:
    """Say how to write that columns are in another unit, unless the file states this unit."""
    if any(file.units.get(name) == unit for name in names):
        return "check the values"
    word = {"mm": "millimetres", "m": "metres"}[unit]
    return f"if they are {word}, write {','.join(f'{name}[{unit}]' for name in names)}"


def _check_position_spread(chain: Chain, file: MeasurementFile, reach: float) -> list[str]:
    """Return a warning if positions spread farther than the robot reaches, or too little by a unit."""
    positions = file.data.positions()
    if len(positions) < _MIN_SAMPLES:
        return []
    index = _subsample(len(positions))
    positions, unit = positions[index], file.units.get("x", "")
    modelled, spread = chain.poses(file.data.q[index])[:, :3, 3], median_radius(positions)
    if spread > (limit := _MAX_SPREAD_RATIO * (reach + MAX_TOOL_OFFSET)):
        widths = np.median(np.abs(positions - np.median(positions, 0)), 0)
        large = [axis for axis, width in zip("xyz", widths, strict=True) if width > limit / np.sqrt(3)]
        along = f" along {' and '.join(large)}" if 0 < len(large) < 3 else ""
        return [
            f"the positions spread {_format_as_written(spread, unit)} around their centre{along}, but the "
            f"robot reaches {reach:.2g} m; {_other_unit(large or 'xyz', file, 'mm')}"
        ]
    modelled_spread = median_radius(modelled)
    if not 0 < spread < modelled_spread / _MIN_SCALE:
        return []
    scaled_misfit = align(positions * (modelled_spread / spread), modelled)[1]
    if scaled_misfit < _MAX_SCALED_MISFIT * modelled_spread:
        return [
            f"the positions spread {_format_as_written(spread, unit)} around their centre, but the robot "
            f"moves its tip by {_format_as_written(modelled_spread, unit)}; {_other_unit('xyz', file, 'm')}"
        ]
    return []


def _check_rotations(file: MeasurementFile) -> list[str]:
    """Return a warning about rotation vectors longer than a turn."""
    vectors = [file.values[name] for name in ROTVEC if name in file.values]
    unit = file.units.get("rx", "")
    if len(vectors) == 3 and unit:
        longest = np.linalg.norm(vectors, axis=0).max()
        if longest > 2 * np.pi + _ROTVEC_SLACK_RAD:
            return [
                f"a rotation vector rx,ry,rz has the length {_format_as_written(longest, unit)}, more than a "
                "turn; if the values are degrees, write [deg]; Euler angles need a column map (--columns)"
            ]
    return []


def _check_limits(chain: Chain, file: MeasurementFile, reported: Container[str]) -> list[str]:
    """Return warnings about joints beyond their limits, except for columns that are reported already."""
    out = []
    for prefix, q in zip(("", SECOND_PREFIX), _joint_positions_by_configuration(file), strict=False):
        for j, name in enumerate(chain.joint_names):
            lower, upper = chain.lower[j], chain.upper[j]
            is_beyond = (q[:, j] < lower - _LIMIT_SLACK) | (q[:, j] > upper + _LIMIT_SLACK)
            if is_beyond.any() and prefix + name not in reported:
                unit = file.units[prefix + name]
                out.append(
                    f"joint {prefix + name} is beyond its limits, {_format_as_written(lower, unit)} to "
                    f"{_format_as_written(upper, unit)}, in {_format_rows(file.data, is_beyond)}; "
                    "check its sign, zero and unit"
                )
    return out


def _check_masses(file: MeasurementFile) -> list[str]:
    """Return a warning about masses of a payload that no robot carries."""
    masses = file.data.conditions().payload
    if masses is None or not np.any(is_heavy := masses > _MAX_PAYLOAD):
        return []
    largest = f"{masses.max():g} kg in {_format_rows(file.data, is_heavy)}"
    return [f"the payload is {largest}, more than any robot carries; check its unit, such as payload[g]"]


def _check_repetitions(file: MeasurementFile) -> list[str]:
    """Return warnings about measurements that occur more than once."""
    repeated = _check_repeated_rows(file)
    return repeated if file.data.rig is None else [*repeated, *_check_repeated_corners(file.data)]


def _check_repeated_rows(file: MeasurementFile) -> list[str]:
    """Return a warning about rows with the same joint positions and the same measured values."""
    columns: list[Array] = [column for q in _joint_positions_by_configuration(file) for column in q.T]
    columns += [np.asarray(column) for name, column in file.values.items() if name in VALUE_COLUMNS]
    original = first_equal_rows(columns)
    is_repeated = original < np.arange(len(original))
    if not is_repeated.any():
        return []
    lines, example = file.data.rows, int(np.flatnonzero(is_repeated)[0])
    return [
        f"{_format_rows(file.data, is_repeated)}: identical to other rows in every digit (line "
        f"{lines[example]} to line {lines[original[example]]}); a copied measurement counts twice, remove it"
    ]


def _check_repeated_corners(item: Measurement) -> list[str]:
    """Return a warning about corners that an image has at several places."""
    # Several photographs in the same configuration are no mistake: they have different names or, without
    # names, repeat most corners. Rows that are equal in every digit have their own warning.
    own = np.arange(len(item.rows))
    view = first_equal_rows([item.image, item.board, item.image_names])
    corner = first_equal_rows([view, item.corner])
    is_other_place = first_equal_rows([corner, *item.values.T]) == own
    is_again = is_other_place & (corner < own)
    n_corners = np.bincount(view[corner == own], minlength=len(own))
    n_again = np.bincount(view[np.unique(corner[is_again])], minlength=len(own))
    is_one_photograph = (item.image_names != "") | (n_again < _MIN_PHOTOGRAPHED_SHARE * n_corners)[view]
    is_wrong = is_again & is_one_photograph
    if not is_wrong.any():
        return []
    example = int(np.flatnonzero(is_wrong)[0])
    return [
        f"{_format_rows(item, is_wrong)}: another place of a corner that the image has already (corner "
        f"{item.corner[example]} in line {item.rows[corner[example]]} and line {item.rows[example]}); an "
        "image has each corner once, correct the corner or the joint positions"
    ]


def first_equal_rows(columns: Sequence[Array]) -> Array:
    """Find rows that are equal in all columns."""
    if not columns or not len(columns[0]):
        return np.empty(0, int)
    # Ranks, as columns of texts and of numbers cannot be stacked.
    ranks, m = [], len(columns[0])
    for column in columns:
        values, rank = np.unique(column, return_inverse=True)
        if len(values) == m:
            return np.arange(m)
        ranks.append(rank)
    keys = np.stack(ranks, -1)
    first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)[1:]
    return first[inverse.reshape(-1)]
