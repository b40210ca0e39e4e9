"""Measurement CSV files: joints under their URDF names, units in the header, readings by column name."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from . import se3
from .chain import Chain
from .errors import DhcalError
from .files import ANGLES, LENGTHS, Column, PathLike, Sheet, check_names, read_sheet
from .measurements import Measurement
from .poses import Pose, Position
from .se3 import Array

_XYZ = ("x", "y", "z")
_QUATERNION = ("qw", "qx", "qy", "qz")
_ROTVEC = ("rx", "ry", "rz")
_TEXT = ("set", "pose_id")
# Where a controller was told to go, and where it went with the calibrated model: for screening and for
# judging a compensation, never fitted.
_COMMANDED = ("commanded_x", "commanded_y", "commanded_z")
_AFTER = ("after_x", "after_y", "after_z")
_SIGMA = tuple(f"sigma_{name}" for name in _XYZ)
_TURN_SIGMA = tuple(f"sigma_{name}" for name in _ROTVEC)
# No instrument is that good: m or rad.
_LEAST_SIGMA = 1e-15
_KNOWN = frozenset((*_XYZ, *_QUATERNION, *_ROTVEC, *_TEXT, *_COMMANDED, *_AFTER, *_SIGMA, *_TURN_SIGMA))


@dataclass(frozen=True, eq=False)
class Readings:
    """A measurement file.

    Attributes:
        source: the file's name.
        data: all its rows.
        fit, holdout: the rows by the column `set`; all are to be fitted without it.
        commanded: (m, 3) positions the controller was told, m; None without the columns.
        after: (m, 3) positions reached once more with calibrated parameters, m; None without.
    """

    source: str
    data: Measurement
    fit: Measurement
    holdout: Measurement
    commanded: Array | None
    after: Array | None


def _group(sheet: Sheet, names: Sequence[str], units: Mapping[str, float] | None) -> Array | None:
    """Columns (m, k) in SI; None if none of them is there, DhcalError if only some are."""
    missing = [name for name in names if name not in sheet.columns]
    if len(missing) == len(names):
        return None
    where = f"{sheet.source}:{sheet.header}"
    if missing:
        there = [name for name in names if name in sheet.columns]
        raise DhcalError(
            f"{where}: {', '.join(there)} without {missing[0]!r}; give {','.join(names)} or none"
        )
    if units is None:
        for name in names:
            if sheet.columns[name].unit:
                raise DhcalError(f"{where}: column {name!r} is a pure number; write {name} without a unit")
        return np.stack([sheet.numbers(sheet.columns[name]) for name in names], -1)
    return np.stack([sheet.si(sheet.columns[name], units) for name in names], -1)


def _joints(sheet: Sheet, chain: Chain) -> Array:
    missing = [name for name in chain.joint_names if name not in sheet.columns]
    if missing:
        raise DhcalError(
            f"{sheet.source}:{sheet.header}: no column for joint {missing[0]!r}; "
            f"this robot needs {','.join(f'{name}[{_unit(chain, name)}]' for name in chain.joint_names)}"
        )
    return np.stack([sheet.si(sheet.columns[name], _units(chain, name)) for name in chain.joint_names], -1)


def _units(chain: Chain, name: str) -> Mapping[str, float]:
    joint = chain.urdf.joint(name)
    return LENGTHS if joint.type == "prismatic" else ANGLES


def _unit(chain: Chain, name: str) -> str:
    return "mm" if _units(chain, name) is LENGTHS else "deg"


def _check_joint_names(chain: Chain) -> None:
    """Complains about joints whose names cannot head a column beside the readings."""
    check_names(chain.joint_names, chain.urdf.source)
    if clash := sorted(_KNOWN & set(chain.joint_names)):
        raise DhcalError(
            f"{chain.urdf.source}: joint {clash[0]!r} has the name of a reading; rename it there"
        )


def _check_columns(sheet: Sheet, chain: Chain) -> None:
    joints = {joint.name for joint in chain.urdf.joints}
    for name in sheet.columns:
        if name not in _KNOWN | joints:
            near = difflib.get_close_matches(name[:100], sorted(_KNOWN | joints), 1, 0.7)
            hint = (
                f"did you mean {near[0]!r}?"
                if near
                else f"remove it; the joints are {', '.join(chain.joint_names)}"
            )
            raise DhcalError(
                f"{sheet.source}:{sheet.header}: column {name!r} is neither a joint of this robot "
                f"nor a known reading; {hint}"
            )


def read_readings(path: PathLike, chain: Chain) -> Readings:
    """A measurement CSV file of positions or poses, for a chain's joints.

    Raises:
        DhcalError: what is wrong, with file, line and column, and what would be right.
    """
    sheet = read_sheet(path)
    _check_joint_names(chain)
    _check_columns(sheet, chain)
    where = f"{sheet.source}:{sheet.header}"
    q = _joints(sheet, chain)
    position = _group(sheet, _XYZ, LENGTHS)
    quaternion, rotvec = _group(sheet, _QUATERNION, None), _group(sheet, _ROTVEC, ANGLES)
    if position is None:
        raise DhcalError(f"{where}: no readings; a position needs the columns x[mm],y[mm],z[mm]")
    if quaternion is not None and rotvec is not None:
        raise DhcalError(f"{where}: both qw… and rx… given; keep one rotation")
    sigma, turn_sigma = _group(sheet, _SIGMA, LENGTHS), _group(sheet, _TURN_SIGMA, ANGLES)
    for values, names in ((sigma, _SIGMA), (turn_sigma, _TURN_SIGMA)):
        if values is not None and (bad := np.argwhere(values < _LEAST_SIGMA)).size:
            row, column = bad[0]
            raise DhcalError(
                f"{sheet.source}:{sheet.lines[row]}: column {names[column]!r}: must be above zero; "
                "leave the sigma columns out where they are not known"
            )
    if quaternion is None and rotvec is None:
        if turn_sigma is not None:
            raise DhcalError(f"{where}: sigma_rx… without a rotation; remove it or add qw,qx,qy,qz")
        data: Measurement = Position.of(q, position, sigma)
    else:
        if (sigma is None) != (turn_sigma is None):
            raise DhcalError(f"{where}: give sigma_x… and sigma_rx… for a pose, both or neither")
        turn = se3.exp3(rotvec) if rotvec is not None else _from_quaternion(sheet, quaternion)
        data = Pose.of(q, se3.transform(turn, position), sigma, turn_sigma)
    held = _held(sheet)
    return Readings(
        sheet.source,
        data,
        data.take(~held),
        data.take(held),
        _group(sheet, _COMMANDED, LENGTHS),
        _group(sheet, _AFTER, LENGTHS),
    )


def _from_quaternion(sheet: Sheet, quaternion: Array | None) -> Array:
    assert quaternion is not None
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(quaternion, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1) > 1e-3)
    if bad.size:
        raise DhcalError(
            f"{sheet.source}:{sheet.lines[bad[0]]}: the quaternion's norm is {norm[bad[0]]:.4g}; "
            "it must be 1 within a thousandth (order qw,qx,qy,qz)"
        )
    w, v = quaternion[:, 0] / norm, quaternion[:, 1:] / norm[:, None]
    cross = se3.skew(v)
    return np.eye(3) + 2 * w[:, None, None] * cross + 2 * cross @ cross


def _held(sheet: Sheet) -> Array:
    column: Column | None = sheet.columns.get("set")
    if column is None:
        return np.zeros(len(sheet.cells), bool)
    words = sheet.text(column)
    for word, line in zip(words, sheet.lines, strict=True):
        if word not in ("fit", "holdout"):
            raise DhcalError(f"{sheet.source}:{line}: column 'set': {word!r} must be fit or holdout")
    return np.array([word == "holdout" for word in words])


def read_measurements(path: PathLike, chain: Chain) -> Measurement:
    """All rows of a measurement CSV file; positions where it has no rotation, poses where it has.

    Raises:
        DhcalError: what is wrong, with file, line and column, and what would be right.
    """
    return read_readings(path, chain).data


def measurement_text(data: Measurement, chain: Chain, comments: Sequence[str] = ()) -> str:
    """The CSV text of positions or poses in metres and radians, exact to the last digit.

    Raises:
        DhcalError: a joint's name cannot head a column.
    """
    _check_joint_names(chain)
    columns: list[tuple[str, Array]] = []
    for j, name in enumerate(chain.joint_names):
        columns.append((f"{name}[{'m' if _units(chain, name) is LENGTHS else 'rad'}]", data.q[:, j]))
    columns += [(f"{name}[m]", data.positions()[:, i]) for i, name in enumerate(_XYZ)]
    if isinstance(data, Pose):
        turn = se3.log3(data.poses[:, :3, :3])
        columns += [(f"{name}[rad]", turn[:, i]) for i, name in enumerate(_ROTVEC)]
    if isinstance(data, Position | Pose) and data.stated:
        columns += [(f"{name}[m]", data.sigma[:, i]) for i, name in enumerate(_SIGMA)]
    if isinstance(data, Pose) and data.stated:
        columns += [(f"{name}[rad]", data.rotation_sigma[:, i]) for i, name in enumerate(_TURN_SIGMA)]
    lines = [f"# {comment}" for comment in comments] + [",".join(name for name, _ in columns)]
    lines += [
        ",".join(map(repr, row)) for row in zip(*(values.tolist() for _, values in columns), strict=True)
    ]
    return "\n".join(lines) + "\n"
