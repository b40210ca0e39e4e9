"""Files of joint values: poses to measure, candidates to choose from, where the tool must be right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .chain import Chain
from .compensation import compensate
from .errors import DhcalError
from .files import PathLike, read_sheet
from .measurement_files import csv_text, joint_columns, joint_values, read_targets, reading_sheet
from .reading_columns import check_columns, check_joint_names
from .se3 import Array


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
    """Joint values (m, n) of a task: as the file has them, or such that the tool is on its targets.

    Targets are places or poses of the chain's tool in the measuring frame.

    Raises:
        DhcalError: what is wrong, or a target that is out of reach.
    """
    columns = read_sheet(path).columns
    if any(name in columns for name in chain.joint_names):
        return read_configurations(path, chain)
    targets = read_targets(path, chain)
    found = compensate(chain, chain, targets.targets)
    if (lost := np.flatnonzero(~found.reached)).size:
        raise DhcalError(
            f"{targets.source}: target {lost[0] + 1} is out of reach ({found.status[lost[0]]}); "
            "correct or remove it"
        )
    return found.q


def configurations_text(q: Array, chain: Chain, comments: Sequence[str]) -> str:
    """The CSV text of joint values (m, n) in metres and radians, exact to the last digit.

    Raises:
        DhcalError: a joint's name cannot head a column.
    """
    check_joint_names(chain)
    return csv_text(joint_columns(q, chain), comments)
