"""Why directions stay unseen: what would show them, and short combinations that span them.

The unseen directions of a data set are peeled in four layers by asking what the same model would see
otherwise, with Jacobians that are really computed: at other joint values, and with the tool's whole pose
read. What nothing shows lies in the arm; what poses would show lies in the instrument; what other joint
values would show lies in the poses, and some of that in joints that never moved.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from .. import se3
from .._typing import Array
from ..estimation import qr
from ..estimation.problem import Problem, linearize_and_factor
from ..measurements.base import Measurement
from ..measurements.pose import Pose
from ..measurements.position import Position
from ..robot.chain import Chain
from .propagation import NEGLIGIBLE

Cause = Literal["arm", "instrument", "poses", "still"]


# Joint values drawn to see what other poses would show: this many rows an unknown.
_ROWS_PER_UNKNOWN = 6


# A direction that other readings show stands out from their rounding by far more than this.
_RTOL = 1e-8


@dataclass(frozen=True, eq=False)
class UnobservableGroup:
    """Unseen directions that share a cause and a part of the arm.

    Attributes:
        cause: who would have to change for them to be seen.
        vectors: (p, r) changes of the unknowns that the data do not see, the largest entry of each 1.
    """

    cause: Cause
    vectors: Array

    @property
    def members(self) -> list[int]:
        """The unknowns that take part."""
        return np.flatnonzero(np.abs(self.vectors).max(1) > NEGLIGIBLE).tolist()


def _vanishing_combinations(rows: Array) -> Array:
    """Orthonormal basis of the combinations of columns that vanish in rows of an orthonormal basis."""
    _, s, vt = np.linalg.svd(rows)
    return vt[int(np.sum(s > NEGLIGIBLE)) :].T


def _unseen_part(space: Array, triangle: Array) -> Array:
    """Basis of the part of a space (p, d) that a triangle does not see either."""
    size = np.linalg.norm(triangle, 2) if triangle.size else 0.0
    if not space.shape[1] or size == 0:
        return space
    _, s, vt = np.linalg.svd(triangle @ space)
    return space @ vt[int(np.sum(s > _RTOL * size)) :].T


@dataclass(frozen=True, eq=False)
class ObservabilityProbe:
    """What was measured, and what could be measured instead.

    Attributes:
        problem: the unknowns and the data.
        x: (p,) where the Jacobian is taken.
    """

    problem: Problem
    x: Array

    @property
    def chain(self) -> Chain:
        """The chain at x."""
        return self.problem.errors.at(self.x[: len(self.problem.errors.parameters)])

    @property
    def n_repetitions(self) -> int:
        """How many times the data's samples are drawn anew, so that there are enough of them."""
        return 1 + _ROWS_PER_UNKNOWN * len(self.x) // sum(len(item.rows) for item in self.problem.data)

    def count_rows(self) -> int:
        """How many numbers were read."""
        return sum(item.residual_dim * len(item.rows) for item in self.problem.data)

    def with_offset_point(self) -> ObservabilityProbe:
        """The same with the measured point some way off."""
        errors = self.problem.errors
        off = {errors.chain.tool_frame_index: se3.translation([0.11, 0.07, 0.05])}
        return ObservabilityProbe(
            replace(self.problem, errors=replace(errors, chain=errors.chain.perturbed_at(off))), self.x
        )

    def draw(self, rng: np.random.Generator, m: int) -> Array:
        """Joint values (m, n) anywhere within the limits and within half a turn or π metres each way."""
        chain = self.chain
        low, high = np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi)
        return rng.uniform(low, high, (m, chain.n_joints))

    def _resampled(self, item: Measurement, joints: Sequence[int], rng: np.random.Generator) -> Measurement:
        """The same readings with some joints anywhere; who touches something must stay on it."""
        if item.is_contact:
            return item
        q = item.configurations().copy()
        q[:, joints] = self.draw(rng, len(q))[:, joints]
        return item.resample(q)

    def hypothetical_r_factor(self, joints: Sequence[int], *extra: type[Pose] | type[Position]) -> Array:
        """What the same instruments would see with some joints drawn anew, and with more readings."""
        rng = np.random.default_rng(0)
        data = self.problem.data
        p = len(self.x)
        every: list[Measurement] = [
            self._resampled(item, joints, rng) for _ in range(self.n_repetitions) for item in data
        ]
        q = self.draw(rng, _ROWS_PER_UNKNOWN * p)
        pose = self.chain.poses(q)
        for kind in extra:
            every.append(Pose(q, pose, 1e-3, 1e-3) if kind is Pose else Position(q, pose[:, :3, 3], 1e-3))
        return linearize_and_factor(replace(self.problem, data=tuple(every)), self.x, small_angle=False).r

    def unmoved_joints(self) -> list[int]:
        """Independent joints, from 0, that have one value in all the data."""
        moved = [item.configurations() for item in self.problem.data if item.configurations_per_row]
        return np.flatnonzero(np.ptp(np.concatenate(moved), axis=0) < 1e-9).tolist() if moved else []

    def is_scale_unobservable(self, triangle: Array) -> bool:
        """Whether a direction that a triangle does not see makes the arm larger."""
        if self.problem.scale_gauge is None:
            return False
        robot = len(self.problem.errors.parameters)
        growth = self.problem.scale_gauge.rates(*self.problem.errors.derivative(self.x[:robot]))[:, 0]
        return bool(np.abs(growth @ qr.null_space(triangle)[:robot]).max(initial=0.0) > NEGLIGIBLE)

    def layers(self, triangle: Array) -> list[tuple[Cause, Array]]:
        """Bases (p, ·) of what stays unseen, each within the next: by the arm, and by all that was done."""
        joints = list(range(self.chain.n_joints))
        data = qr.null_space(triangle)
        still = self.unmoved_joints()
        poses = _unseen_part(data, self.hypothetical_r_factor(still)) if still else data
        instrument = _unseen_part(poses, self.hypothetical_r_factor(joints))
        arm = _unseen_part(instrument, self.hypothetical_r_factor(joints, Pose))
        return [("arm", arm), ("instrument", instrument), ("poses", poses), ("still", data)]


def _echelon(space: Array, order: Array) -> Iterator[Array]:
    """Combinations that span a space (p, d), each the only one with an entry at its pivot."""
    rows = space.T.copy()
    done = 0
    for column in order:
        if done == len(rows):
            break
        pivot = done + int(np.argmax(np.abs(rows[done:, column])))
        if abs(rows[pivot, column]) < NEGLIGIBLE:
            continue
        rows[[done, pivot]] = rows[[pivot, done]]
        rows[done] /= rows[done, column]
        others = np.arange(len(rows)) != done
        rows[others] -= np.outer(rows[others, column], rows[done])
        done += 1
    for row in rows:
        yield row / row[np.argmax(np.abs(row))]


def _orthogonal_part(known: Array, vector: Array) -> Array:
    """What of a unit vector (p,), or of several (p, k), lies outside an orthonormal basis (p, d)."""
    return vector - known @ (known.T @ vector)


def _sort_key(row: Array) -> tuple[int, int, int]:
    """Short combinations of neighbours come first."""
    taking = np.flatnonzero(np.abs(row) > NEGLIGIBLE)
    return len(taking), int(taking[-1] - taking[0]), int(taking[0])


def group_directions(layers: Sequence[tuple[Cause, Array]], error_frames: Array) -> list[UnobservableGroup]:
    """Every unseen direction once: short combinations, each on as short a piece of the arm as it can be.

    Args:
        layers: of `Experiment.layers`.
        error_frames: (r,) where each of the robot's plain errors acts; they are the first of the unknowns.
    """
    p = layers[-1][1].shape[0]
    at = np.unique(error_frames)
    spans = sorted(((i, j) for i in at for j in at if i <= j), key=lambda span: (span[1] - span[0], span[0]))
    parts = []
    for with_others in (False, True)[: 1 + (len(error_frames) < p)]:
        for first, end in spans:
            inside = np.full(p, with_others)
            inside[: len(error_frames)] = (error_frames >= first) & (error_frames <= end)
            parts.append(inside)
    known = np.empty((p, 0))
    out = []
    for cause, space in layers:
        for inside in parts:
            if known.shape[1] == space.shape[1]:
                break
            local = space @ _vanishing_combinations(space[~inside]) if (~inside).any() else space
            if np.abs(_orthogonal_part(known, local)).max(initial=0) < 10 * NEGLIGIBLE:
                continue
            members = np.flatnonzero(inside)
            found = [row for order in (members, members[::-1]) for row in _echelon(local, order)]
            found.sort(key=_sort_key)
            new = []
            for row in found:
                rest = _orthogonal_part(known, row / np.linalg.norm(row))
                if np.linalg.norm(rest) > 10 * NEGLIGIBLE:
                    new.append(row)
                    rest = _orthogonal_part(known, rest / np.linalg.norm(rest))
                    known = np.concatenate([known, rest[:, None] / np.linalg.norm(rest)], 1)
            if new:
                out.append(UnobservableGroup(cause, np.array(new).T))
    return out
