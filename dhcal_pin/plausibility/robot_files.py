"""Mistakes in the file of a robot: the unit of lengths; convention, columns and angles of a DH table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from .._typing import Array
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..robot.dh import Convention, DHTable
from ..units import ANGLES, LENGTHS
from .diagnosis import MIN_LOG_RATIO, Diagnosis
from .evidence import Evidence, fit_evidence
from .hypotheses import Hypothesis, JointChange, describe_misread

# Lengths of all links together beyond which the unit of a robot is wrong [m].
SMALLEST_ARM, LARGEST_ARM = 0.01, 50.0
# Convention of a table by the default parameter set of its chain.
_CONVENTIONS: dict[str, Convention] = {"dh": "standard", "modified-dh": "modified"}
# Origins differ from those of a table by less than this [m or 1].
_TOLERANCE = 1e-9

# What is wrong in the file, what to correct, and the robot without the mistake.
_Mistake = tuple[str, str, Chain]


def length_of_links(chain: Chain) -> float:
    """Return the length of all links between joints, if each has the median length [m]."""
    # One wrong origin is no wrong unit.
    lengths = np.linalg.norm(chain.origins[1:-1, :3, 3], axis=1)
    lengths = lengths[lengths > _TOLERANCE]
    return float(len(lengths) * np.median(lengths)) if len(lengths) else 0.0


def find_wrong_lengths(
    chain: Chain, samples: Sequence[Measurement], sets: str, before: Evidence
) -> Diagnosis | None:
    """Look for another unit of length of a robot of impossible size; None without one."""
    size = length_of_links(chain)
    if SMALLEST_ARM <= size <= LARGEST_ARM:
        return None
    mistakes = []
    for true, read in permutations(("m", "cm", "mm"), 2):
        factor = LENGTHS[read] / LENGTHS[true]
        if SMALLEST_ARM <= factor * size <= LARGEST_ARM:
            origins = chain.origins.copy()
            origins[:, :3, 3] *= factor
            text = f"the lengths of the robot are {describe_misread(true, read, factor)}"
            mistakes.append((text, "the lengths in the robot file", replace(chain, origins=origins)))
    return _best(mistakes, samples, sets, before)


def find_wrong_table(
    chain: Chain, samples: Sequence[Measurement], sets: str, before: Evidence
) -> Diagnosis | None:
    """Look for a mistake in the DH table of a robot that explains samples; None without one."""
    table = _read_table(chain)
    if table is None:
        return None
    other = _with_other_convention(table).convention
    mistakes = [
        (text.format(other), instead.format(other), Chain.from_dh(change(table)))
        for text, instead, change in _MISTAKES
    ]
    return _best(mistakes, samples, sets, before)


def _best(
    mistakes: Iterable[_Mistake], samples: Sequence[Measurement], sets: str, before: Evidence
) -> Diagnosis | None:
    """Return the mistake that explains samples best; None if none does."""
    best = None
    for text, instead, mended in mistakes:
        after = fit_evidence(mended, samples, sets)
        hypothesis = Hypothesis("", text, JointChange.of(mended.n_joints), instead)
        found = Diagnosis(before, (hypothesis,), after, gain=after.log - before.log)
        if found.is_certain and found.gain >= MIN_LOG_RATIO and (best is None or found.gain > best.gain):
            best = found
    return best


def _with_other_convention(table: DHTable) -> DHTable:
    """Return the rows of a table in the other convention."""
    return replace(table, convention="modified" if table.convention == "standard" else "standard")


# What is wrong in the table, what to correct, and the table without the mistake.
_MISTAKES: tuple[tuple[str, str, Callable[[DHTable], DHTable]], ...] = (
    (
        "the DH table is in the {0} convention, but was read in the other one",
        'convention in the robot file to "{0}"',
        _with_other_convention,
    ),
    (
        "a and d of the DH table are exchanged",
        "a and d in the robot file",
        lambda table: replace(table, a=table.d, d=table.a),
    ),
    (
        "the angles of the DH table are radians that were read as degrees",
        "the angles in the robot file",
        lambda table: replace(table, theta=ANGLES["deg"] * table.theta, alpha=ANGLES["deg"] * table.alpha),
    ),
)


def _read_table(chain: Chain) -> DHTable | None:
    """Return the table of a chain that was made from one; None for other chains."""
    convention = _CONVENTIONS.get(chain.parameters)
    if convention is None or len(chain.moving_joints) != chain.n_joints:
        return None
    is_standard = convention == "standard"
    origins = chain.link_transforms[1:] if is_standard else chain.link_transforms[:-1]
    rotations, positions = origins[:, :3, :3], origins[:, :3, 3]
    if is_standard:
        theta = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
        alpha = np.arctan2(rotations[:, 2, 1], rotations[:, 2, 2])
        d, a = positions[:, 2], positions[:, 0] * np.cos(theta) + positions[:, 1] * np.sin(theta)
    else:
        theta = np.arctan2(-rotations[:, 0, 1], rotations[:, 0, 0])
        alpha = np.arctan2(-rotations[:, 1, 2], rotations[:, 2, 2])
        d, a = positions[:, 2] * np.cos(alpha) - positions[:, 1] * np.sin(alpha), positions[:, 0]
    rows: tuple[Array, ...] = (theta, d, a, alpha, np.zeros(chain.n_joints))
    table = DHTable(convention, chain.joint_names, chain.prismatic, *rows, chain.lower, chain.upper)
    read = table.origins()[1:] if is_standard else table.origins()[:-1]
    return table if np.allclose(read, origins, 0, _TOLERANCE) else None
