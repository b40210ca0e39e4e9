"""Compact form of a large uncertainty, for files: it predicts the tool like the full one.

The covariance of hundreds of harmonics has no few leading directions. Its parts are kept by what each of them
contributes to predictions at joint positions q:

    C ≈ L·Lᵀ + diag(G·Gᵀ, C_1, ..., C_n),    C_i = B_i·B_iᵀ + Σ_m v_im·κ_m·κ_mᵀ

- L, the leading directions, has the covariances between joints, and between joints and geometry. It is found
  by factor analysis with correlated specific errors: the eigenvectors of C without the blocks on the
  diagonal of what L leaves, repeated. Errors are measured by their effects on the tool at configurations of
  the joint space, relative to the standard deviations there.
- G is the exact rest of all rows that are no harmonics.
- B_i has the leading directions of the rest of joint i. What is left is described by independent errors at
  angles θ_m with the variances v_im, where κ_m has the harmonics cos k(θ - θ_m) that peak there. A prediction
  depends on the variance of the error curve at one angle at a time only. Its values at all angles
  determine v_im (Richardson-Lucy iteration).

Harmonics are rounded to multiples of a step far below the standard deviations. The predicted standard
deviations are compared before the form is used.

Where measurements leave base or tool free (`frame_gauge`), the gauge coordinates of each column are further
rows of the geometry, so that both uncertainties, with and without free frames, follow from the same columns.

Reference: H. H. Harman, Modern Factor Analysis, 3rd ed., 1976, chapter 8.

Shapes: c rows, b of them geometry, h harmonics, r leading directions, n joints, g gauge directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._typing import Array
from ..robot.chain import Chain
from ..robot.sampling import joint_range
from ..robot.transmission import coefficient_indices, harmonic_orders
from .uncertainty import Uncertainty

# An uncertainty of at most this many columns is kept as it is.
MAX_COLUMNS = 120
# Columns per leading direction, and number of directions of each joint.
COLUMNS_PER_LEADING, N_OF_JOINT = 5, 32
# Largest relative error of the standard deviations of position and orientation at the configurations that
# are compared; beyond it the form is not used. Two series of a UR10 with 807 terms: 99 % of the
# configurations are below 0.8 %, the largest error is 1.5 %.
MAX_ERROR = 3e-2
# Largest number of columns of an array that is read.
MAX_COMPACT_COLUMNS = 4096
# Smallest number of harmonics of a joint that are described by angles; fewer belong to the geometry.
MIN_HARMONICS = 24
# Step of the harmonics, relative to the 1 % quantile of the standard deviations [per rad].
RELATIVE_STEP = 1e-3
# Numbers of configurations for the effects: drawn from the joint space, and with measured values of each
# joint; number of configurations at which predictions are compared.
N_DRAWN, N_MEASURED, N_COMPARED = 600, 400, 1000
# Rounds of the factor analysis, and of those in which the rest is made positive semidefinite.
N_ROUNDS, N_BETWEEN_CORRECTIONS = 15, 5
# Iterations of the variances at angles.
N_ANGLE_ROUNDS = 300
# Smaller parts of a variance are rounding errors.
RTOL = 1e-12


@dataclass(frozen=True, eq=False)
class CompactUncertainty:
    """Arrays that determine an uncertainty up to the tolerance."""

    step: float  #: Unit of the harmonics [rad].
    geometry: Array  #: Rows of the geometry in the leading directions, and the rest of them, (b, 2b).
    leading: Array  #: Harmonics of the leading directions in steps, (h, r).
    of_joint: Array  #: Harmonics of the directions of their joint in steps, (h, N_OF_JOINT).
    angle_std: Array  #: Standard deviations of the independent errors at angles, (n, number of angles) [rad].
    gauge: Array  #: Gauge directions, (c, g).

    @property
    def problem(self) -> tuple[str, str] | None:
        """Name an array whose shape does not fit, and say what is expected; None if all fit."""
        if self.geometry.shape[1] != 2 * len(self.geometry):
            return "geometry", f"expected {2 * len(self.geometry)} columns"
        if self.of_joint.shape[1] != N_OF_JOINT:
            return "of_joint", f"expected {N_OF_JOINT} columns"
        return None

    def expand(self, known: Uncertainty) -> Uncertainty:
        """Return an uncertainty with the columns of this form, (c, r+b+h), in place of its own."""
        n_rows = len(known.sqrt_covariance)
        labels = _joint_of_rows(known.chain, known.entries, n_rows)
        is_harmonic = np.append(labels > 0, np.zeros(self.gauge.shape[1], bool))
        n_geometry, n_leading = len(self.geometry), self.leading.shape[1]
        columns = [np.zeros((len(is_harmonic), n_leading)), np.zeros((len(is_harmonic), n_geometry))]
        n_shared = min(n_geometry, n_leading)
        columns[0][~is_harmonic, :n_shared] = self.geometry[:, :n_shared]
        columns[0][is_harmonic] = self.step * self.leading
        columns[1][~is_harmonic] = self.geometry[:, n_geometry:]
        angles = _angles(self.angle_std.shape[1])
        for std, (joint, rows) in zip(self.angle_std, _rows_by_joint(labels), strict=True):
            own = self.step * self.of_joint[labels[labels > 0] == joint]
            peaks = _waves(known, rows, angles).T * std
            columns.append(np.zeros((len(is_harmonic), len(rows))))
            columns[-1][rows] = _root(own @ own.T + peaks @ peaks.T)
        return _from_columns(known, np.concatenate(columns, 1), self.gauge)


def compact_rows(known: Uncertainty) -> dict[str, int]:
    """Return the number of rows of each array, of `geometry` without gauge coordinates."""
    n_rows = len(known.sqrt_covariance)
    labels = _joint_of_rows(known.chain, known.entries, n_rows)
    n_harmonics, n_joints = int(np.sum(labels > 0)), len(_rows_by_joint(labels))
    return {
        "gauge": n_rows,
        "geometry": n_rows - n_harmonics,
        "leading": n_harmonics,
        "of_joint": n_harmonics,
        "angle_std": n_joints,
    }


def compact(known: Uncertainty, measured: Array) -> CompactUncertainty | None:
    """Return the compact form of an uncertainty; None if it is small or no compact form agrees with it.

    Effects count in the joint space and at measured configurations (k, n), predictions are compared in the
    joint space.
    """
    if known.sqrt_covariance.shape[1] <= MAX_COLUMNS or known.unbounded_directions.shape[1]:
        return None
    labels = _joint_of_rows(known.chain, known.entries, len(known.sqrt_covariance))
    if not labels.any():
        return None
    rng = np.random.default_rng(0)
    used = _configurations(known.chain, measured, rng)
    compared = rng.uniform(*joint_range(known.chain), (N_COMPARED, known.chain.n_joints))
    gauge, coordinates = _gauge(known)
    relative = known.relative.sqrt_covariance
    columns = np.concatenate([relative, coordinates])
    labels = np.append(labels, np.zeros(len(coordinates), int))
    scaled = _Scaled.of(_effects(known, used, gauge), columns, labels, known.model_std)
    expected = _stds(known, compared)
    step = RELATIVE_STEP * float(np.min(np.quantile(expected, 0.01, axis=1)))
    count = columns.shape[1] // COLUMNS_PER_LEADING
    found = _approximate(known, labels, scaled, count, step, gauge)
    error = np.abs(_stds(found.expand(known), compared) / expected - 1).max()
    return found if error <= MAX_ERROR else None


# --- parts of the form -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Scaled:
    """Covariance of the rows in units of their effects, (c+g, c+g)."""

    covariance: Array  # Covariance of scaled rows
    to_rows: Array  # Matrix from scaled rows to rows
    blocks: list[Array]  # Indices of the rows of each block

    @classmethod
    def of(
        cls, effects: Sequence[Array], columns: Array, labels: Array, model: tuple[float, float]
    ) -> _Scaled:
        """Scale each block of rows by the root of its mean squared effects, relative to the tool's errors."""
        squares, own = np.zeros((len(columns), len(columns))), 3 * np.square(model)
        for effect in effects:
            root = (effect.reshape(-1, len(columns)) @ columns).reshape(len(effect), 2, -1)
            weight = 1 / np.sqrt(np.sum(root**2, 2) + own)
            rows = (effect.reshape(len(effect), 2, 3, -1) * weight[:, :, None, None]).reshape(
                -1, len(columns)
            )
            squares += rows.T @ rows / len(effect)
        to_scaled, to_rows = np.zeros_like(squares), np.zeros_like(squares)
        blocks = [np.flatnonzero(labels == label) for label in np.unique(labels)]
        for block in blocks:
            values, axes = np.linalg.eigh(squares[np.ix_(block, block)])
            root = np.sqrt(np.maximum(values, RTOL * values[-1]))
            to_scaled[np.ix_(block, block)] = axes * root @ axes.T
            to_rows[np.ix_(block, block)] = axes / root @ axes.T
        scaled = to_scaled @ columns
        return cls(scaled @ scaled.T, to_rows, blocks)

    def factors(self, count: int) -> tuple[Array, Array]:
        """Return leading directions (c+g, count) and the block-diagonal rest, in rows."""
        values, axes = np.linalg.eigh(self.covariance)
        axes = axes[:, -count:]
        leading = axes * np.sqrt(np.maximum(values[-count:], 0.0))
        for number in range(N_ROUNDS):
            rest = self._rest(leading, (number + 1) % N_BETWEEN_CORRECTIONS == 0)
            common = self.covariance - rest
            axes = np.linalg.qr(common @ axes)[0]
            values, turn = np.linalg.eigh(axes.T @ common @ axes)
            leading = axes @ turn * np.sqrt(np.maximum(values, 0.0))
        return self.to_rows @ leading, self.to_rows @ self._rest(leading, True) @ self.to_rows

    def _rest(self, leading: Array, is_semidefinite: bool) -> Array:
        """Return the blocks on the diagonal that leading directions leave."""
        rest = np.zeros_like(self.covariance)
        for block in self.blocks:
            part = leading[block]
            left = self.covariance[np.ix_(block, block)] - part @ part.T
            if is_semidefinite:
                root = _root(left)
                left = root @ root.T
            rest[np.ix_(block, block)] = left
        return rest


def _approximate(
    known: Uncertainty, labels: Array, scaled: _Scaled, count: int, step: float, gauge: Array
) -> CompactUncertainty:
    """Return the compact form with a number of leading directions."""
    leading, rest = scaled.factors(count)
    is_geometry = labels == 0
    n_geometry = int(is_geometry.sum())
    # Turn the directions so that the geometry is in the first of them only, and the others have an order.
    leading = leading @ np.linalg.qr(leading[is_geometry].T, mode="complete")[0]
    if count > n_geometry:
        u, s, _ = np.linalg.svd(leading[:, n_geometry:], full_matrices=False)
        leading[:, n_geometry:] = u * s
    geometry = np.zeros((n_geometry, 2 * n_geometry))
    n_shared = min(n_geometry, count)
    geometry[:, :n_shared] = leading[is_geometry, :n_shared]
    geometry[:, n_geometry:] = _triangular_root(rest[np.ix_(is_geometry, is_geometry)])
    of_joint = np.zeros((len(labels), N_OF_JOINT))
    angle_std = []
    curves = _rows_by_joint(labels)
    n_angles = 2 * max(len(rows) for _, rows in curves) + 1
    for _, rows in curves:
        values, axes = np.linalg.eigh(rest[np.ix_(rows, rows)])
        root = axes * np.sqrt(np.maximum(values, 0.0))
        of_joint[rows, : min(N_OF_JOINT, len(rows))] = root[:, : -N_OF_JOINT - 1 : -1]
        peaks, points = (_waves(known, rows, _angles(number)) for number in (n_angles, 2 * n_angles))
        angle_std.append(_angle_std(points @ peaks.T, np.sum((points @ root[:, :-N_OF_JOINT]) ** 2, 1)))
    largest = max(np.abs(leading[~is_geometry]).max(), np.abs(of_joint).max())
    step = max(step, largest / np.iinfo(np.int16).max)
    return CompactUncertainty(
        step,
        geometry,
        np.rint(leading[~is_geometry] / step),
        np.rint(of_joint[~is_geometry] / step),
        np.array(angle_std),
        gauge,
    )


def _joint_of_rows(chain: Chain, entries: Array, n_rows: int) -> Array:
    """Return the joint, from 1, of each row that is a harmonic of many, and 0 for the geometry, (c,)."""
    _, harmonics, *_ = coefficient_indices(*chain.mimic_matrix.shape)
    labels = np.zeros(n_rows, int)
    for joint in range(harmonics.shape[2]):
        members = n_rows - len(entries) + np.flatnonzero(np.isin(entries, harmonics[:, :, joint]))
        if len(members) >= MIN_HARMONICS:
            labels[members] = joint + 1
    return labels


def _rows_by_joint(labels: Array) -> list[tuple[int, Array]]:
    """Return the joints, from 1, whose harmonics are described by angles, and their rows."""
    return [(joint, np.flatnonzero(labels == joint)) for joint in np.unique(labels[labels > 0]).tolist()]


def _waves(known: Uncertainty, rows: Array, angles: Array) -> Array:
    """Compute the harmonics of one joint at angles, (number of angles, number of rows)."""
    entries = known.entries[rows - (len(known.sqrt_covariance) - len(known.entries))]
    n = known.chain.n_joints
    phase = np.outer(angles, harmonic_orders(entries, n))
    # The rows of sines and cosines of one order follow each other.
    return np.where((entries // n - n) % 2 == 0, np.sin(phase), np.cos(phase))


def _angles(number: int) -> Array:
    """Return angles that divide a turn."""
    return 2 * np.pi * np.arange(number) / number


def _angle_std(overlap: Array, variance: Array) -> Array:
    """Compute standard deviations of independent errors at angles that cause variances at other angles."""
    gains = overlap**2
    variance = np.maximum(variance, 1e-6 * max(variance.max(), np.finfo(float).tiny))
    found = np.full(gains.shape[1], variance.mean() / gains.sum(1).mean())
    for _ in range(N_ANGLE_ROUNDS):
        found *= gains.T @ (variance / (gains @ found)) / gains.sum(0)
    return np.sqrt(found)


def _root(matrix: Array) -> Array:
    """Compute a square root of the positive semidefinite part of a matrix."""
    values, axes = np.linalg.eigh(matrix)
    return axes * np.sqrt(np.maximum(values, 0.0))


def _triangular_root(matrix: Array) -> Array:
    """Compute a lower triangular root of the positive semidefinite part of a matrix."""
    return np.linalg.qr(_root(matrix).T, mode="r").T


def _gauge(known: Uncertainty) -> tuple[Array, Array]:
    """Divide the part of free frames (c, r) into gauge directions (c, g) and their coordinates (g, r)."""
    n_rows, n_columns = known.sqrt_covariance.shape
    if not known.has_free_frames:
        return np.empty((n_rows, 0)), np.empty((0, n_columns))
    u, s, vt = np.linalg.svd(known.frame_part, full_matrices=False)
    count = int(np.sum(s > RTOL * s[0]))
    return u[:, :count], s[:count, None] * vt[:count]


def _from_columns(known: Uncertainty, columns: Array, gauge: Array) -> Uncertainty:
    """Return an uncertainty with other columns (c+g, r), the gauge coordinates below the rows."""
    relative, frame_part = columns[: len(gauge)], gauge @ columns[len(gauge) :]
    if not gauge.shape[1]:
        return replace(known, sqrt_covariance=relative)
    return replace(known, sqrt_covariance=relative + frame_part, frame_part=frame_part)


# --- predictions -----------------------------------------------------------------------------------


def _configurations(chain: Chain, measured: Array, rng: np.random.Generator) -> Array:
    """Draw configurations of the joint space, and others with measured values (k, n) of each joint."""
    drawn = rng.uniform(*joint_range(chain), (N_DRAWN, chain.n_joints))
    mixed = [rng.permutation(np.resize(values, N_MEASURED)) for values in measured.T] if len(measured) else []
    return np.concatenate([drawn, *([np.stack(mixed, 1)] if mixed else []), measured])


def _effects(known: Uncertainty, q: Array, gauge: Array) -> list[Array]:
    """Compute the twists of the tool by all rows (m, 6, c+g), with and without the free frames."""
    of_rows = known.tool_twists(known.chain.forward_kinematics(q), np.eye(len(known.sqrt_covariance)))
    of_frames = of_rows @ gauge
    effects = [np.concatenate([of_rows, of_frames], 2)]
    return [*effects, np.concatenate([of_rows, 0 * of_frames], 2)] if gauge.shape[1] else effects


def _stds(known: Uncertainty, q: Array) -> Array:
    """Predict the standard deviations of position and orientation, with and without the free frames."""
    predictions = [each.predict(q) for each in (known, known.relative)[: 1 + known.has_free_frames]]
    return np.array([std for each in predictions for std in (each.position_std, each.orientation_std)])
