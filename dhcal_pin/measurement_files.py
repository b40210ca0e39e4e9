"""Measurement CSV files: joints under their URDF names, units in the header, readings by column name."""

from __future__ import annotations

import csv
import difflib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import se3
from .chain import Chain
from .errors import DhcalError
from .files import ANGLES, LENGTHS, Column, PathLike, Sheet, check_names, read_sheet
from .kinds import KINDS
from .measurements import Measurement
from .se3 import Array

_QUATERNION = ("qw", "qx", "qy", "qz")
_ROTVEC = ("rx", "ry", "rz")
# Where a controller was told to go, and where it went with the calibrated model: for screening and for
# judging a compensation, never fitted.
_COMMANDED = ("commanded_x", "commanded_y", "commanded_z")
_AFTER = ("after_x", "after_y", "after_z")
_ASIDE = frozenset(("set", "pose_id", *_COMMANDED, *_AFTER))
# No instrument is that good: m or rad.
_LEAST_SIGMA = 1e-15
# The second configuration of a row stands under the joints' names with this before them.
_TO = "to:"
_READINGS = frozenset(name for kind in KINDS.values() for name in kind.columns) | frozenset(_QUATERNION)
_KNOWN = _READINGS | _ASIDE
_QUANTITIES = {"length": LENGTHS, "angle": ANGLES}


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


def _joints(sheet: Sheet, chain: Chain, before: str = "") -> Array:
    """Joint values (m, n) under the joints' names, each with `before` in front."""
    missing = [name for name in chain.joint_names if before + name not in sheet.columns]
    if missing:
        every = ",".join(f"{before}{name}[{_unit(chain, name)}]" for name in chain.joint_names)
        raise DhcalError(
            f"{sheet.source}:{sheet.header}: no column for joint {before + missing[0]!r}; "
            f"this robot needs {every}"
        )
    columns = [(sheet.columns[before + name], _units(chain, name)) for name in chain.joint_names]
    return np.stack([sheet.si(column, units) for column, units in columns], -1)


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
    names = [joint.name for joint in chain.urdf.joints]
    joints = {*names, *(_TO + name for name in names)}
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


def _kind(sheet: Sheet) -> type[Measurement]:
    """The kind with the most of its columns there, or DhcalError if a column does not go with it."""
    there = set(sheet.columns) & _READINGS
    if there & set(_QUATERNION):
        there = there - set(_QUATERNION) | set(_ROTVEC)
    fits = [
        (len(wanted), -len(kind.columns), kind)
        for kind in KINDS.values()
        for wanted in kind.needs
        if wanted <= there
    ]
    where = f"{sheet.source}:{sheet.header}"
    if not fits:
        lone = f"; {', '.join(sorted(there))} alone is not enough" if there else ""
        raise DhcalError(
            f"{where}: no readings{lone}; a position needs the columns x[mm],y[mm],z[mm], "
            "a pose qw,qx,qy,qz beside them"
        )
    kind = max(fits, key=lambda fit: fit[:2])[2]
    if odd := sorted(there - set(kind.columns)):
        raise DhcalError(
            f"{where}: column {odd[0]!r} does not go with {', '.join(sorted(there & set(kind.columns)))}; "
            f"a {kind.kind} file has {', '.join(kind.columns)}"
        )
    return kind


def _values(sheet: Sheet, kind: type[Measurement]) -> dict[str, Any]:
    """The kind's columns in SI, or as text; a quaternion as a rotation vector."""
    out: dict[str, Any] = {}
    for name, what in kind.columns.items():
        if name not in sheet.columns:
            continue
        column = sheet.columns[name]
        out[name] = sheet.text(column) if what == "text" else sheet.si(column, _QUANTITIES[what])
        if "sigma" in name and (bad := np.flatnonzero(out[name] < _LEAST_SIGMA)).size:
            raise DhcalError(
                f"{sheet.source}:{sheet.lines[bad[0]]}: column {name!r}: must be above zero; "
                "leave the sigma columns out where they are not known"
            )
        if what == "text" and "" in out[name]:
            line = sheet.lines[out[name].index("")]
            raise DhcalError(f"{sheet.source}:{line}: column {name!r}: is empty; write a name")
    if set(_QUATERNION) & set(sheet.columns):
        if set(_ROTVEC) & set(sheet.columns):
            raise DhcalError(f"{sheet.source}:{sheet.header}: both qw… and rx… given; keep one rotation")
        turn = se3.log3(_from_quaternion(sheet, _group(sheet, _QUATERNION, None)))
        out |= {name: turn[:, i] for i, name in enumerate(_ROTVEC)}
    return out


def _whole_sigmas(sheet: Sheet, kind: type[Measurement], values: Mapping[str, Any]) -> None:
    """Complains about some sigmas without the others."""
    wanted = [f"sigma_{name}" for name in kind.columns if name in values and f"sigma_{name}" in kind.columns]
    wanted = wanted or [name for name in kind.columns if name.startswith("sigma_")]
    given = [name for name in wanted if name in values]
    if given and len(given) < len(wanted):
        lacking = next(name for name in wanted if name not in values)
        raise DhcalError(
            f"{sheet.source}:{sheet.header}: {', '.join(given)} without {lacking!r}; "
            f"give {','.join(wanted)} or none"
        )


def read_readings(path: PathLike, chain: Chain) -> Readings:
    """A measurement CSV file of any kind, for a chain's joints.

    Raises:
        DhcalError: what is wrong, with file, line and column, and what would be right.
    """
    sheet = read_sheet(path)
    _check_joint_names(chain)
    _check_columns(sheet, chain)
    kind = _kind(sheet)
    values = _values(sheet, kind)
    _whole_sigmas(sheet, kind, values)
    q = [_joints(sheet, chain, before) for before in ("", _TO)[: kind.ends]]
    try:
        data = kind.from_columns(q or [np.zeros((len(sheet.cells), chain.size))], values)
    except DhcalError as error:
        raise DhcalError(f"{sheet.source}: {error}") from None
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
    """All rows of a measurement CSV file, of the kind that its columns tell.

    Raises:
        DhcalError: what is wrong, with file, line and column, and what would be right.
    """
    return read_readings(path, chain).data


def measurement_text(data: Measurement, chain: Chain, comments: Sequence[str] = ()) -> str:
    """The CSV text of readings of any kind in metres and radians, exact to the last digit.

    Raises:
        DhcalError: a joint's name cannot head a column.
    """
    _check_joint_names(chain)
    columns: dict[str, Any] = {}
    for before, q in zip(
        ("", _TO)[: data.ends], np.split(data.configurations(), max(data.ends, 1)), strict=False
    ):
        for j, name in enumerate(chain.joint_names):
            columns[f"{before}{name}[{'m' if _units(chain, name) is LENGTHS else 'rad'}]"] = q[:, j].tolist()
    for name, values in data.to_columns().items():
        unit = {"length": "[m]", "angle": "[rad]", "text": ""}[data.columns[name]]
        columns[name + unit] = list(values) if unit == "" else values.tolist()
    out = io.StringIO()
    out.writelines(f"# {comment}\n" for comment in comments)
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return out.getvalue()
