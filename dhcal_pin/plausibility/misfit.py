"""Misfit of the nominal robot: how far it is from measured poses, with any base and tool.

A position p of a target at t in the tip frame, which has the rotation R and the position p_tip, fulfils

    Q·p + b = p_tip + R·t

with the rotation Q and the position b of the instrument. A measured rotation M fulfils Q·M = R·B with the
rotation B of the tool. All sums of squares follow from the Gram matrix G of the columns (p, p_tip, R) about
their means. If Q may be any matrix A, the equation is linear; its solution gives the start of t and a lower
bound of the error. Then Q (Kabsch 1976) and t are computed from each other, from the half of the samples with
the smallest errors: the others may be outliers. The mean square of the error per degree of freedom counts
relative to that of p about its mean. B is the rotation nearest to the mean of C = Rᵀ·Q·M, and the mean of
1 - trace(Bᵀ·C)/3 is a third of the mean square of the angles between both sides; again half of the samples
count. The two mean squares are added.

Shapes: v variants of the data, m samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .._typing import Array
from ..estimation.initialization import measured_at_end
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..robot.conditions import concatenate_conditions
from ..se3 import nearest_rotation

# A robot with a larger misfit is another robot, or the data are mixed up.
MAX_MISFIT = 0.7
# Smallest number of samples, with two rows for each of the fifteen unknowns of the linear equation.
_MIN_SAMPLES = 10
# Unknowns of Q, b and t.
_N_UNKNOWNS = 9
# Number of rotations Q that are computed in turn with t, and share of the samples, those with the smallest
# errors, that all but the first are computed from.
_N_ROUNDS, _KEPT_SHARE = 5, 0.5
# Number of variants, those with the smallest lower bounds, that are computed even if their bounds exceed
# `MAX_MISFIT`: outliers may be the reason.
_N_NEAREST = 64
# Fraction of the largest information that holds directions without information at zero.
_MIN_INFORMATION = 1e-13
# Positive number in place of a divisor of zero.
_TINY = 1e-300


def nominal_misfits(chain: Chain, variants: Sequence[Sequence[Measurement]]) -> Array:
    """Compute the relative misfit (v,) of variants of the same measurements; 0 without measured positions."""
    arm = chain.with_base_and_tool(np.eye(4), np.eye(4))
    # Sum of the squared errors, their spread, the errors of rotations and the number of samples.
    sums = np.zeros((4, len(variants)))
    for items in zip(*variants, strict=True):
        sizes = np.array([len(item.rows) for item in items])
        is_comparable = items[0].configurations_per_row == 1 and len(items[0].positions()) == sizes[0]
        for size in np.unique(sizes[sizes >= _MIN_SAMPLES]) if is_comparable else ():
            index = np.flatnonzero(sizes == size)
            sums[:, index] += _sums_of_errors(arm, [items[i] for i in index])
    squares, spreads, turns, counts = sums
    # Above `MAX_MISFIT` it may be too small.
    return np.sqrt(squares / np.fmax(spreads, _TINY) + turns / np.fmax(counts, 1))


def _sums_of_errors(arm: Chain, items: Sequence[Measurement]) -> Array:
    """Return the sums (4, v) of variants of one measurement with m samples each."""
    v, m = len(items), len(items[0].rows)
    conditions = concatenate_conditions([item.conditions() for item in items])
    assert conditions is not None
    tip = arm.poses(conditions.of_arm).reshape(v, m, 4, 4)
    p, rotations = map(np.stack, zip(*map(measured_at_end, items), strict=True))
    z = np.concatenate([p, tip[..., :3, 3], tip[..., :3, :3].reshape(v, m, 9)], -1)
    gram = _gram(z, np.ones((v, m)))
    # Without the part that A·p explains.
    cross = gram[:, :3, 3:]
    t, squares = _solve_offsets(gram[:, 3:, 3:] - np.swapaxes(cross, 1, 2) @ _solve(gram[:, :3, :3], cross))
    squares, spread = squares * 3 / (3 * m - 15), np.einsum("vii->v", gram[:, 3:6, 3:6]) / m
    bounds, turns = np.sqrt(squares / np.fmax(spread, _TINY)), np.zeros(v)
    near = np.flatnonzero(bounds <= max(MAX_MISFIT, *np.sort(bounds)[:_N_NEAREST]))
    fit = _fit_rotations(z[near], t[near])
    squares[near], spread[near] = fit.square, fit.spread
    if rotations.size:
        turned = np.swapaxes(tip[near, :, :3, :3], 2, 3) @ fit.rotation[:, None]
        turns[near] = _mean_turns(turned @ rotations[near])
    return m * np.stack([squares, spread, turns, np.ones(v)])


class _Fit(NamedTuple):
    """Frames of v variants and what remains."""

    t: Array  # Position of the target, (v, 3) [m]
    rotation: Array  # Q, (v, 3, 3)
    errors: Array  # Squared error of each sample, (v, m) [m²]
    square: Array  # Mean square of the errors of the samples that were used, per degree of freedom, (v,) [m²]
    spread: Array  # Mean square of their positions p about the mean, (v,) [m²]


def _fit_rotations(z: Array, t: Array) -> _Fit:
    """Fit Q and t in turn, from the columns (v, m, 15) and starts (v, 3) of t."""
    v, m, _ = z.shape
    fit = _fit_rotation(z, t, np.ones((v, m)))
    for _ in range(_N_ROUNDS - 1):
        fit = _fit_rotation(z, fit.t, _smallest(fit.errors))
    return fit


def _fit_rotation(z: Array, t: Array, kept: Array) -> _Fit:
    """Fit Q at given t, and then t at Q, to the samples that are kept."""
    v, m, _ = z.shape
    k, gram, columns = kept.sum(1), _gram(z, kept), np.zeros((v, 12, 15))
    of_target = gram[:, 6:, :3].reshape(v, 3, 3, 3)
    rotation = nearest_rotation(gram[:, 3:6, :3] + np.einsum("vilj,vl->vij", of_target, t))
    # Columns of p_tip - Q·p and of R.
    columns[:, :3, :3], columns[:, :3, 3:6], columns[:, 3:, 6:] = -rotation, np.eye(3), np.eye(9)
    t, squares = _solve_offsets(columns @ gram @ np.swapaxes(columns, 1, 2))
    y = z @ np.swapaxes(columns, 1, 2)
    e = y[..., :3] + (y[..., 3:].reshape(v, m, 3, 3) @ t[:, None, :, None])[..., 0]
    errors = np.sum((e - (kept[:, None] @ e) / k[:, None, None]) ** 2, -1)
    spread = np.einsum("vii->v", gram[:, :3, :3]) / k
    return _Fit(t, rotation, errors, squares * 3 / (3 * k - _N_UNKNOWNS), spread)


def _mean_turns(rotations: Array) -> Array:
    """Return the mean of 1 - trace(Bᵀ·C)/3 of rotations C (v, m, 3, 3) with their mean rotation B."""
    kept, errors = np.ones(rotations.shape[:2]), np.zeros(rotations.shape[:2])
    for _ in range(_N_ROUNDS):
        mean = nearest_rotation(np.einsum("vm,vmij->vij", kept, rotations))
        errors = np.fmax(0, 1 - np.einsum("vij,vmij->vm", mean, rotations) / 3)
        kept = _smallest(errors)
    return np.sum(kept * errors, 1) / kept.sum(1)


def _smallest(errors: Array) -> Array:
    """Return 1 for the samples with the smallest errors (v, m) and 0 for the others."""
    k, kept = int(_KEPT_SHARE * errors.shape[1]), np.zeros(errors.shape)
    np.put_along_axis(kept, np.argpartition(errors, k - 1, 1)[:, :k], 1.0, 1)
    return kept


def _gram(z: Array, kept: Array) -> Array:
    """Return the Gram matrices of columns (v, m, 15) about their means over the samples that are kept."""
    z = kept[..., None] * (z - (kept[:, None] @ z) / kept.sum(1)[:, None, None])
    return np.swapaxes(z, 1, 2) @ z


def _solve_offsets(gram: Array) -> tuple[Array, Array]:
    """Return t (v, 3) and the smallest sum of squares of y + R·t, from the Gram matrix of (y, R)."""
    information = np.einsum("vikil->vkl", gram[:, 3:, 3:].reshape(-1, 3, 3, 3, 3))
    right = -np.einsum("viil->vl", gram[:, :3, 3:].reshape(-1, 3, 3, 3))
    t = _solve(information, right[..., None])[..., 0]
    squares = np.einsum("vii->v", gram[:, :3, :3]) - np.sum(right * t, 1)
    return t, np.fmax(squares, 0)


def _solve(information: Array, right: Array) -> Array:
    """Solve normal equations (v, 3, 3); directions without information are zero."""
    floor = _MIN_INFORMATION * np.einsum("vii->v", information)
    return np.linalg.solve(information + np.fmax(floor, _TINY)[:, None, None] * np.eye(3), right)
