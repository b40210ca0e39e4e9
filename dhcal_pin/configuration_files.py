"""Files of joint values: poses to measure, candidates to choose from, where the tool must be right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .chain import Chain
from .configurations import joint_range
from .errors import DhcalError
from .files import LENGTHS, PathLike, read_sheet
from .inverse import solve, to_positions, within
from .measurement_files import csv_text, joint_columns, joint_values, reading_sheet
from .reading_columns import check_columns, check_joint_names
from .se3 import Array
from .workspace import WorkspaceMap

# Near enough for knowing how well the tool would be known there; and from so many starts.
_NEAR = 1e-6
_STARTS = 20


def read_configurations(path: PathLike, chain: Chain, columns: PathLike | None = None) -> Array:
    """Joint values (m, n) of a file that has a column for each joint; readings beside them are not looked at.

    Raises:
        DhcalError: what is wrong, with file, line and column, and what would be right.
    """
    check_joint_names(chain)
    sheet = reading_sheet(path, chain, columns)
    check_columns(sheet, chain)
    return joint_values(sheet, chain)


def read_task(path: PathLike, chain: Chain) -> Array:
    """Joint values (m, n) of a task: as the file has them, or such that the tool is at its x, y, z.

    Positions are those of the chain's tool in the measuring frame; a rotation beside them is not looked at.

    Raises:
        DhcalError: what is wrong, or a position that is out of reach.
    """
    sheet = read_sheet(path)
    if any(name in sheet.columns for name in chain.joint_names):
        return read_configurations(path, chain)
    missing = [name for name in "xyz" if name not in sheet.columns]
    if missing:
        raise DhcalError(
            f"{sheet.source}:{sheet.header}: no column {missing[0]!r}; give joints, or x[mm],y[mm],z[mm]"
        )
    targets = np.stack([sheet.si(sheet.columns[name], LENGTHS) for name in "xyz"], -1)
    low, high = joint_range(chain)
    start = np.random.default_rng(0).uniform(low, high, (len(targets) * _STARTS, chain.size))
    q, gap = solve(chain, to_positions(np.repeat(targets, _STARTS, axis=0)), start)
    q, allowed = within(chain, q)
    good = (allowed & (gap <= _NEAR)).reshape(len(targets), _STARTS)
    left = np.flatnonzero(~good.any(1))
    if not left.size:
        return q.reshape(len(targets), _STARTS, -1)[np.arange(len(targets)), good.argmax(1)]
    raise DhcalError(
        f"{sheet.source}:{sheet.lines[left[0]]}: the tool does not reach this position; correct or remove it"
    )


def map_text(found: WorkspaceMap, comments: Sequence[str]) -> str:
    """The CSV text of a map: a row a cell, millimetres."""
    names = ("x[mm]", "y[mm]", "z[mm]")
    columns = {name: (1e3 * found.centre[:, i]).round(6).tolist() for i, name in enumerate(names)}
    columns |= {"position_std[mm]": (1e3 * found.std).tolist(), "worst[mm]": (1e3 * found.worst).tolist()}
    return csv_text(columns | {"configurations": found.count.tolist()}, comments)


def configurations_text(q: Array, chain: Chain, comments: Sequence[str]) -> str:
    """The CSV text of joint values (m, n) in metres and radians, exact to the last digit.

    Raises:
        DhcalError: a joint's name cannot head a column.
    """
    check_joint_names(chain)
    return csv_text(joint_columns(q, chain), comments)
