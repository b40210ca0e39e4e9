"""Causes of unobservable directions, and sparse combinations that span the null space.

Let N(D) be the null space of the whitened Jacobian of data D. The null space of the measurements is split by
computing Jacobians of hypothetical measurements, at joint positions drawn at random within the limits:

    N_structure ⊆ N_instrument ⊆ N_poses ⊆ N_data

* N_data: null space of the measurements themselves.
* N_poses: the part that stays unobservable even if all joints move. The rest has the cause "unmoved".
* N_instrument: the part that stays unobservable with the instruments at other poses. The rest has the
  cause "poses".
* N_structure: the part that stays unobservable even if the tool poses are measured. The rest has the cause
  "instrument". N_structure has the cause "structure": the parameters are redundant for every instrument.

Each layer is then spanned by combinations with few parameters on short parts of the chain, by Gaussian
elimination with different column orders. References: Khalil & Dombre, Modeling, Identification and Control of
Robots, 2002, chapter 11 (identifiable parameters); Hollerbach, Khalil & Gautier, Model Identification,
Springer Handbook of Robotics, 2016.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Literal

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..estimation import qr
from ..estimation.contacts.scale_gauge import ScaleGauge
from ..estimation.problem import Problem, linear_system, linearize_and_factor
from ..measurements.base import Measurement
from ..measurements.pose import Pose
from ..measurements.position import Position
from ..robot.chain import Chain
from ..robot.sampling import joint_range
from .propagation import NEGLIGIBLE

Cause = Literal["structure", "instrument", "poses", "unmoved"]
# Half of the range of joint positions around those of an image in which a board stays in view [rad or m].
_IMAGE_RANGE = 0.1
# Rows of hypothetical measurements per unknown.
_ROWS_PER_UNKNOWN = 6
# Singular values below this fraction of the norm of R count as zero.
_RTOL = 1e-8
# Joint positions with a smaller range never moved [rad or m].
_MIN_JOINT_RANGE = 1e-9
# Standard deviations of hypothetical poses and positions [m, rad].
_PROBE_SIGMA = 1e-3
# Displacement of the measured point in `ObservabilityProbe.with_offset_point` [m].
_POINT_OFFSET = (0.11, 0.07, 0.05)


@frozen(eq=False)
class UnobservableGroup:
    """Unobservable directions with the same cause and on the same part of the chain."""

    cause: Cause  # What has to change to make the directions observable; "structure" if nothing can
    # Combinations of the unknowns without effect on the measurements, shape (p, r) [m or rad]. The largest
    # entry of each is 1.
    vectors: Array

    @property
    def members(self) -> list[int]:
        """Indices of the unknowns that take part."""
        return np.flatnonzero(np.abs(self.vectors).max(1) > NEGLIGIBLE).tolist()


def _vanishing_combinations(rows: Array) -> Array:
    """Return a basis of the combinations of columns that vanish in these rows of an orthonormal basis."""
    _, s, vt = qr.singular_value_decomposition(rows)
    return vt[int(np.sum(s > NEGLIGIBLE)) :].T


def _unobservable_part(space: Array, r: Array) -> Array:
    """Return a basis of the part of a space (p, d) that lies in the null space of an R factor."""
    norm = np.linalg.norm(r, 2) if r.size else 0.0
    if not space.shape[1] or norm == 0:
        return space
    _, s, vt = qr.singular_value_decomposition(r @ space)
    return space @ vt[int(np.sum(s > _RTOL * norm)) :].T


@frozen(eq=False)
class ObservabilityProbe:
    """Problem with its measurements, and Jacobians of hypothetical measurements."""

    problem: Problem  # Unknowns and measurements
    x: Array  # Values of the unknowns for all Jacobians, shape (p,) [m or rad]
    known_r: Array | None = None  # R factor of the measurements at x, if it is known

    @cached_property
    def r(self) -> Array:
        """R factor of the measurements at x, (p, p). Even a small last step rotates its null space."""
        if self.known_r is not None:
            return self.known_r
        return linearize_and_factor(self.problem, self.x, small_angle=False).r

    @property
    def chain(self) -> Chain:
        """Chain at x."""
        return self.problem.chain(self.x)

    @property
    def n_repetitions(self) -> int:
        """Number of hypothetical samples per measured sample, so that there are enough rows."""
        return 1 + _ROWS_PER_UNKNOWN * len(self.x) // self.n_equations

    @property
    def n_equations(self) -> int:
        """Number of residual rows of the measurements."""
        return sum(item.residual_dim * len(item.rows) for item in self.problem.data)

    def with_offset_point(self) -> ObservabilityProbe:
        """Return a copy whose measured point is displaced in the tool frame."""
        errors = self.problem.errors
        offset = {errors.chain.tool_frame_index: se3.translation(_POINT_OFFSET)}
        return ObservabilityProbe(
            replace(self.problem, errors=replace(errors, chain=errors.chain.perturbed_at(offset))), self.x
        )

    def draw_configurations(self, rng: np.random.Generator, m: int) -> Array:
        """Draw joint positions within the limits and within half a turn or half a metre."""
        return rng.uniform(*joint_range(self.chain), (m, self.chain.n_joints))

    def _resampled(self, item: Measurement, joints: Sequence[int], rng: np.random.Generator) -> Measurement:
        """Return a measurement with joints drawn anew, in images near the measured ones."""
        if item.is_contact:
            return item
        if len(joints) == self.chain.n_joints and not item.instrument_parameters:
            # All samples are alike; more rows would only take time.
            item = item.take(np.s_[: 1 + _ROWS_PER_UNKNOWN * len(self.x) // item.residual_dim])
        q = item.configurations().copy()
        if item.rig is None:
            q[:, joints] = self.draw_configurations(rng, len(q))[:, joints]
        else:
            q[:, joints] += rng.uniform(-_IMAGE_RANGE, _IMAGE_RANGE, q[:, joints].shape)
        return item.resample(q)

    def hypothetical_r_factor(self, joints: Sequence[int], *extra: type[Pose] | type[Position]) -> Array:
        """Compute the R factor of hypothetical measurements with the same instruments."""
        rng = np.random.default_rng(0)
        measured = self.problem.data
        p = len(self.x)
        data: list[Measurement] = [
            self._resampled(item, joints, rng) for _ in range(self.n_repetitions) for item in measured
        ]
        q = self.draw_configurations(rng, _ROWS_PER_UNKNOWN * p)
        poses = self.chain.poses(q)
        for kind in extra:
            data.append(
                Pose(q, poses, _PROBE_SIGMA, _PROBE_SIGMA)
                if kind is Pose
                else Position(q, poses[:, :3, 3], _PROBE_SIGMA)
            )
        return linear_system(replace(self.problem, data=tuple(data)), self.x).r

    @cached_property
    def full_range(self) -> Array:
        """R factor of hypothetical measurements with all joints drawn anew, (p, p); of images near them."""
        return self.hypothetical_r_factor(range(self.chain.n_joints))

    def unmoved_joints(self) -> list[int]:
        """Find the independent joints that have the same position in all measurements."""
        q = [item.configurations() for item in self.problem.data if item.configurations_per_row]
        if not q:
            return []
        return np.flatnonzero(np.ptp(np.concatenate(q), axis=0) < _MIN_JOINT_RANGE).tolist()

    @property
    def measures_angles_only(self) -> bool:
        """Whether all residuals are angles."""
        return all(
            group.unit == "rad" for item in self.problem.data for group in item.residual_groups.values()
        )

    @cached_property
    def is_scale_unobservable(self) -> bool:
        """Whether a direction of the null space changes the size of the robot, as no length is measured."""
        problem, gauge = self.problem, self.problem.scale_gauge
        if self.measures_angles_only:
            q = np.concatenate([item.q for item in problem.data])
            gauge = ScaleGauge.from_configurations(problem.errors.chain, q)
        if gauge is None:
            return False
        n_robot = len(problem.errors.parameters)
        _, rates = gauge.size_and_rates(*problem.errors.derivative(self.x[:n_robot]))
        return bool(np.abs(rates[:, 0] @ qr.null_space(self.r)[:n_robot]).max(initial=0.0) > NEGLIGIBLE)

    def null_space_layers(self, r: Array) -> list[tuple[Cause, Array]]:
        """Split the null space by cause."""
        all_joints = list(range(self.chain.n_joints))
        data = qr.null_space(r)
        unmoved = self.unmoved_joints()
        poses = _unobservable_part(data, self.hypothetical_r_factor(unmoved)) if unmoved else data
        instrument = _unobservable_part(poses, self.full_range)
        structure = _unobservable_part(instrument, self.hypothetical_r_factor(all_joints, Pose))
        return [("structure", structure), ("instrument", instrument), ("poses", poses), ("unmoved", data)]


def _row_echelon_combinations(space: Array, order: Array) -> Iterator[Array]:
    """Yield combinations that span a space (p, d), from elimination of the columns in this order."""
    rows = space.T.copy()
    n_pivots = 0
    for column in order:
        if n_pivots == len(rows):
            break
        pivot = n_pivots + int(np.argmax(np.abs(rows[n_pivots:, column])))
        if abs(rows[pivot, column]) < NEGLIGIBLE:
            continue
        rows[[n_pivots, pivot]] = rows[[pivot, n_pivots]]
        rows[n_pivots] /= rows[n_pivots, column]
        others = np.arange(len(rows)) != n_pivots
        rows[others] -= np.outer(rows[others, column], rows[n_pivots])
        n_pivots += 1
    for row in rows:
        yield row / row[np.argmax(np.abs(row))]


def _orthogonal_part(basis: Array, vector: Array) -> Array:
    """Return the part of a vector (p,), or of several (p, k), that is orthogonal to a basis (p, d)."""
    return vector - basis @ (basis.T @ vector)


def _sort_key(row: Array) -> tuple[int, int, int]:
    """Sort combinations by number of parameters, then by extent, then by position."""
    members = np.flatnonzero(np.abs(row) > NEGLIGIBLE)
    return len(members), int(members[-1] - members[0]), int(members[0])


def group_directions(layers: Sequence[tuple[Cause, Array]], error_frames: Array) -> list[UnobservableGroup]:
    """Group the unobservable directions by cause and by part of the chain."""
    p = layers[-1][1].shape[0]
    frames = np.unique(error_frames)
    spans = sorted(
        ((i, j) for i in frames for j in frames if i <= j), key=lambda span: (span[1] - span[0], span[0])
    )
    parts = []
    for with_other_unknowns in (False, True)[: 1 + (len(error_frames) < p)]:
        for first, last in spans:
            inside = np.full(p, with_other_unknowns)
            inside[: len(error_frames)] = (error_frames >= first) & (error_frames <= last)
            parts.append(inside)
    # Orthonormal basis of the directions that already belong to a group.
    basis = np.empty((p, 0))
    out = []
    for cause, space in layers:
        for inside in parts:
            if basis.shape[1] == space.shape[1]:
                break
            local = space @ _vanishing_combinations(space[~inside]) if (~inside).any() else space
            if np.abs(_orthogonal_part(basis, local)).max(initial=0) < 10 * NEGLIGIBLE:
                continue
            members = np.flatnonzero(inside)
            combinations = [
                row for order in (members, members[::-1]) for row in _row_echelon_combinations(local, order)
            ]
            combinations.sort(key=_sort_key)
            new = []
            for row in combinations:
                rest = _orthogonal_part(basis, row / np.linalg.norm(row))
                if np.linalg.norm(rest) > 10 * NEGLIGIBLE:
                    new.append(row)
                    rest = _orthogonal_part(basis, rest / np.linalg.norm(rest))
                    basis = np.concatenate([basis, rest[:, None] / np.linalg.norm(rest)], 1)
            if new:
                out.append(UnobservableGroup(cause, np.array(new).T))
    return out
