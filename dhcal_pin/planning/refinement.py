"""Chosen configurations moved to better ones about them, which no list of candidates holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._typing import Array
from ..robot.sampling import Room, evened
from .criteria import Criterion
from .exchange import Pool, basis
from .information import Information

# Refinement: rounds, each with so many neighbours a pose, nearer from round to round.
ROUNDS, NEIGHBOURS, REACH, NEARER = 8, 24, 0.15, 0.65


@dataclass(frozen=True, eq=False)
class Aim:
    """What is known before, with what a fit will leave out, too, and what is to be known.

    How much of it can be seen at all; places to keep away from; where the robot may stand.
    """

    information: Information
    wide: Information
    criterion: Criterion
    task: Array
    seen: int
    kept: Array
    room: Room | None


def refined(aim: Aim, q: Array, room: Room, apart: float, rng: np.random.Generator) -> Array:
    """The configurations (n, dof) moved to better ones about them, by smaller and smaller steps."""
    information, criterion = aim.wide, aim.criterion
    q = q.copy()
    rows = np.ascontiguousarray(information.rows(q).transpose(2, 1, 0))
    value = criterion.value(basis(information.start, rows))
    for turn in range(ROUNDS):
        near = room.near(q, REACH * NEARER**turn, NEIGHBOURS, rng)
        possible = lambda i, near=near: room.allows(near[i])  # noqa: E731
        pool = Pool.of(information.rows(near), evened(room.chain, near), apart, possible)
        pool.closed[:] = ~room.space.holds(room.chain.poses(near))
        for slot in range(len(q)):
            block = np.arange(slot * NEIGHBOURS, (slot + 1) * NEIGHBOURS)
            rest = basis(information.start, np.delete(rows, slot, 0))
            here = np.concatenate([pool.rows[:, :, block], rows[slot].T[:, :, None]], 2)
            gains = criterion.gains(here, rest)
            better = np.where(gains[:-1] > gains[-1], gains[:-1], -np.inf)
            others = np.concatenate([aim.kept, evened(room.chain, np.delete(q, slot, 0))])
            found = pool.best(better, block, others)
            if found is None:
                continue
            trial = rows.copy()
            trial[slot] = pool.rows[:, :, found].T
            reached = criterion.value(basis(information.start, trial))
            if reached < value:
                rows, value, q[slot] = trial, reached, near[found]
    return q
