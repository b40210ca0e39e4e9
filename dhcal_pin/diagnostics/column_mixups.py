"""Columns that were mixed up: a joint's sign or zero, two joints in each other's place, a mirrored frame.

Each guess changes the joint values or the positions in one way. Instrument and target are placed anew for it,
so what stays unexplained tells it from the file as it stands, wherever the two are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from .. import se3
from .._typing import Array
from ..calibration.initialization import candidate_frames, subsample
from ..measurements.base import Measurement
from ..measurements.position import MultiTargetPosition, Position
from ..robot.chain import Chain
from ..se3 import nearest_rotation

# So much of the positions' spread may stay unexplained by a nominal arm, and in any case so many metres;
# so much by no arm but another.
_MAX_NOMINAL_MISFIT, _MAX_NOMINAL_MISFIT_M, _WRONG_ROBOT_MISFIT = 0.05, 0.01, 0.2


# A guess is one if it leaves so many times less; others that leave as little are told beside it.
_MIN_IMPROVEMENT, _MAX_TIE_RATIO = 4.0, 1.5


# Fewer positions fit too many guesses.
_MIN_POSITIONS = 10


# Positions that the arm is tried on, and that a guess is.
_SAMPLE, _PROBES = 100, 40


_ROUNDS, _MAX_SOLUTIONS = 12, 3


# Positions so many times as far from their middle as is usual are gross errors.
_OUTLIER_RATIO = 5.0


def median_radius(points: Array) -> float:
    """The usual distance of points (m, 3) from their middle, whatever a few of them are."""
    return float(np.median(np.linalg.norm(points - np.median(points, 0), axis=1)))


def position_misfit(chain: Chain, q: Array, seen: Array) -> float:
    """The usual distance in m of positions (m, 3) from an arm's at q (m, n), base and tool placed to fit."""
    begun = candidate_frames(chain, (subsample(Position(q, seen)),), base=True, tool=True)
    return min(_fit_from(start, q, seen) for start in begun)


def _fit_from(start: Chain, q: Array, seen: Array) -> float:
    """The same from one start, by reweighted Gauss-Newton steps on base and target."""
    base, offset = start.base, start.tool[:3, 3]
    tip = start.with_base_and_tool(np.eye(4), np.eye(4)).poses(q)
    usual = np.inf
    for _ in range(_ROUNDS):
        turn = base[:3, :3] @ tip[:, :3, :3]
        points = (base @ tip)[:, :3, 3] + turn @ offset
        away = seen - points
        far = np.linalg.norm(away, axis=1)
        usual = min(usual, float(np.median(far)))
        weights = np.sqrt(1 / np.fmax(far, usual + 1e-12))[:, None]
        # A shift and a turn of the base about the measuring frame's axes, and the target in the tip's.
        rows = np.concatenate([np.broadcast_to(np.eye(3), turn.shape), -se3.skew(points), turn], 2)
        step = np.linalg.lstsq((weights[:, None] * rows).reshape(-1, 9), (weights * away).ravel())[0]
        base = se3.transform(se3.exp3(step[3:6]), step[:3]) @ base
        offset = offset + step[6:]
    return usual


def orientation_misfit(modelled: Array, seen: Array) -> float:
    """The usual angle in rad of rotations (m, 3, 3) from an arm's (m, 3, 3), base and target turned to fit.

    Both enter a Kronecker product linearly (Shah, J. Mechanisms Robotics 5, 2013); its best few solutions,
    made rotations, are followed to the end.
    """
    product = np.einsum("mij,mkl->ikjl", seen, modelled).reshape(9, 9)
    usual = np.inf
    for found in np.linalg.svd(product)[0].T[:_MAX_SOLUTIONS].reshape(-1, 3, 3):
        base, tool = nearest_rotation(found * np.sign(np.linalg.det(found))), np.eye(3)
        for _ in range(_ROUNDS):
            tool = nearest_rotation(np.sum(np.swapaxes(base @ modelled, 1, 2) @ seen, 0))
            base = nearest_rotation(np.sum(seen @ np.swapaxes(modelled @ tool, 1, 2), 0))
        off = np.linalg.norm(se3.log3(np.swapaxes(base @ modelled @ tool, 1, 2) @ seen), axis=1)
        usual = min(usual, float(np.median(off)))
    return usual


@dataclass(frozen=True, eq=False)
class MixupHypothesis:
    """What may have been mixed up.

    Attributes:
        description: what is otherwise than in the file.
        check: what to look at then.
        q, positions: joint values (m, n) and positions (m, 3) without the mistake.
    """

    description: str
    check: str
    q: Array
    positions: Array


def _hypotheses(chain: Chain, data: Measurement, index: Array) -> Iterator[MixupHypothesis]:
    """What may be otherwise with the rows of an index."""
    every = data.positions()
    q, seen = data.q[index], every[index]
    for step, side in ((-1, "before"), (1, "after")):
        there = (index + step >= 0) & (index + step < len(every))
        words = f"the readings of the row {side}"
        yield MixupHypothesis(words, "how rows were put together", q[there], every[index[there] + step])
    yield MixupHypothesis("the frame mirrored", "the order and the signs of x, y and z", q, seen * [1, 1, -1])
    for j, name in enumerate(chain.joint_names):
        one = np.arange(chain.n_joints) == j
        yield MixupHypothesis(f"joint {name} moving the other way", "its sign", np.where(one, -q, q), seen)
        for degrees in (90, -90, 180) if not chain.is_prismatic[j] else ():
            words = f"{degrees} deg added to joint {name}"
            yield MixupHypothesis(words, "its zero", q + np.deg2rad(degrees) * one, seen)
    for i, j in combinations(range(chain.n_joints), 2):
        if chain.is_prismatic[i] == chain.is_prismatic[j]:
            order = np.arange(chain.n_joints)
            order[[i, j]] = j, i
            words = f"joints {chain.joint_names[i]} and {chain.joint_names[j]} in each other's place"
            yield MixupHypothesis(words, "the joints' order", q[:, order], seen)


def diagnose_mixups(chain: Chain, data: Measurement) -> list[str]:
    """A sentence on positions that do not fit the arm, and on what would; none for most files."""
    if isinstance(data, MultiTargetPosition):
        data = data.take(data.label == np.bincount(data.label).argmax())
    if len(data.positions()) < _MIN_POSITIONS:
        return []
    every = data.positions()
    near = np.linalg.norm(every - np.median(every, 0), axis=1)
    # Gross errors would draw the frames away.
    rows = np.flatnonzero(near <= _OUTLIER_RATIO * np.median(near))
    index = np.sort(np.random.default_rng(0).permutation(rows)[:_SAMPLE])
    q, seen = data.q[index], every[index]
    size, left = median_radius(seen), position_misfit(chain, q, seen)
    if left <= max(_MAX_NOMINAL_MISFIT * size, _MAX_NOMINAL_MISFIT_M):
        return []
    off = f"the positions are usually {1e3 * left:.3g} mm off this arm wherever instrument and target are"
    guesses = _hypotheses(chain, data, np.sort(np.random.default_rng(1).permutation(index)[:_PROBES]))
    found = [(position_misfit(chain, guess.q, guess.positions), guess) for guess in guesses]
    best = min(rest for rest, _ in found)
    if best * _MIN_IMPROVEMENT < left:
        alike = [guess for rest, guess in found if rest <= _MAX_TIE_RATIO * best]
        words, checks = (
            dict.fromkeys(part) for part in zip(*((g.description, g.check) for g in alike), strict=True)
        )
        return [f"{off}, but {1e3 * best:.3g} mm with {' or '.join(words)}; check {' or '.join(checks)}"]
    if left > _WRONG_ROBOT_MISFIT * size:
        return [f"{off}; check robot and tip, units, and the joints' order, signs and zeros"]
    return []
