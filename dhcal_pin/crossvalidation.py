"""Errors on what was left out: at random, by groups, or by whole regions of joint space.

A random split leaves neighbours of every sample in the fit, so a term that runs away where nobody measured
looks good. Leaving out the ends of the samples' principal directions in joint space shows it.

The model is nearly linear around a fit, so every fold is solved exactly from two triangles: that of its
fitted rows and that of its left-out rows. Nothing is iterated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import lstsq

from .errors import DhcalError
from .measurements import Measurement
from .problem import Problem, Triangle, reduce
from .result import Result, accuracy
from .se3 import Array

# The share of the samples at either end of a principal direction that a fold leaves out.
SHARE = 0.25
# Directions with less than this share of the widest one's spread are none.
_FLAT = 1e-6

# For each measurement of a fit which of its samples (m,) a fold leaves out.
Fold = tuple[Array, ...]


def random_folds(data: Sequence[Measurement], count: int, seed: int = 0) -> tuple[Fold, ...]:
    """Each sample left out in one of `count` folds at random: k-fold.

    Raises:
        DhcalError: fewer than two folds, or more than samples.
    """
    samples = sum(len(item.rows) for item in data)
    if not 2 <= count <= samples:
        raise DhcalError(f"{count} folds: choose from 2 to {samples}, the number of samples")
    labels = np.random.default_rng(seed).permutation(samples) % count
    return group_folds(data, labels)


def group_folds(data: Sequence[Measurement], labels: Array) -> tuple[Fold, ...]:
    """A fold a group: leave one group out.

    Args:
        data: measurements, m samples in all.
        labels: (m,) the group of each sample.

    Raises:
        DhcalError: not one label a sample, or one group only.
    """
    labels = np.asarray(labels)
    if labels.shape != (samples := sum(len(item.rows) for item in data),):
        raise DhcalError(f"labels have shape {labels.shape}; {samples} samples need ({samples},)")
    if len(groups := np.unique(labels)) < 2:
        raise DhcalError("one group: leaving it out leaves nothing to fit")
    return tuple(_parted(data, labels == group) for group in groups)


def region_folds(data: Sequence[Measurement], share: float = SHARE) -> tuple[Fold, ...]:
    """Two folds a principal direction of the joint values: its lowest and its highest share of samples.

    Joint values are scaled to equal spread first. Readings without joint values are always fitted.

    Raises:
        DhcalError: all samples have the same joint values.
    """
    moved = [np.full(len(item.rows), item.ends > 0) for item in data]
    moving = np.concatenate(moved)
    q = np.concatenate([item.q for item in data])[moving]
    spread = q.std(0)
    scaled = (q - q.mean(0))[:, spread > 0] / spread[spread > 0]
    _, size, directions = np.linalg.svd(scaled, full_matrices=False)
    found = []
    for along in (scaled @ directions[size > _FLAT * size.max(initial=0.0)].T).T:
        low, high = np.quantile(along, [share, 1 - share])
        for left in (along <= low, along >= high):
            if not left.all():
                mask = np.zeros(len(moving), bool)
                mask[moving] = left
                found.append(_parted(data, mask))
    if not found:
        raise DhcalError("cross-validation by regions needs samples at different joint values")
    return tuple(found)


def _parted(data: Sequence[Measurement], mask: Array) -> Fold:
    return tuple(np.split(mask, np.cumsum([len(item.rows) for item in data])[:-1]))


@dataclass(frozen=True, eq=False)
class Parts:
    """A fold's triangles around one x: of what it fits and of what it leaves out, and the latter's rows."""

    fitted: Triangle
    left: Triangle
    rows: int

    @property
    def unseen(self) -> Array:
        """Columns (p,) that the fitted rows do not depend on, such as a point that was touched elsewhere."""
        return np.logical_not(self.fitted.r.any(0))

    def error(self, weights: Array, x: Array, columns: Array) -> float:
        """RMS of the left-out whitened rows after a fit of some columns (p,) with priors of weights about 0.

        What only the left-out rows depend on is fitted to them.
        """
        step, _ = solved(self.fitted, weights, x, columns)
        own = self.left.r[:, columns]
        rest = self.left.z - own @ step
        alone = self.unseen[columns] & own.any(0)
        if alone.any():
            basis = np.linalg.qr(own[:, alone])[0]
            rest = rest - basis @ (basis.T @ rest)
        return float(np.sqrt((rest @ rest + self.left.rest) / self.rows))


def solved(triangle: Triangle, weights: Array, x: Array, columns: Array) -> tuple[Array, float]:
    """The step (c,) of the columns that count (p,) with priors of weights (p,) about 0, and its cost."""
    held = weights[columns]
    a = np.concatenate([triangle.r[:, columns], np.diag(held)])
    b = np.concatenate([triangle.z, -held * x[columns]])
    found = lstsq(a, b, lapack_driver="gelsy", check_finite=False)
    assert found is not None
    return found[0], triangle.rest + float(np.sum((a @ found[0] - b) ** 2))


def rows(problem: Problem, x: Array) -> int:
    """Number of whitened rows."""
    chain = problem.errors.at(x[: len(problem.errors.parameters)])
    return sum(
        item.residual(chain.sweep(item.configurations()), problem.values(item, x)).size
        for item in problem.data
        if len(item.rows)
    )


def parts(
    problem: Problem, x: Array, folds: Sequence[Fold], progress: Callable[[int, float], None] | None = None
) -> tuple[Parts, ...]:
    """Each fold's triangles around x (p,)."""
    found = []
    for fold in folds:
        kept, left = (
            replace(
                problem, data=tuple(item.take(side) for item, side in zip(problem.data, sides, strict=True))
            )
            for sides in ([~mask for mask in fold], fold)
        )
        inside = reduce(kept, x, small_angle=False)
        found.append(Parts(inside, reduce(left, x, small_angle=False), rows(left, x)))
        if progress:
            progress(len(found), inside.rest)
    return tuple(found)


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Errors on what was left out.

    Attributes:
        folds: of each fold what `accuracy` says of its left-out samples, m and rad.
        errors: (k,) RMS of each fold's left-out rows in standard deviations as the fit used them.
    """

    folds: tuple[dict[str, Any], ...]
    errors: Array

    @property
    def accuracy(self) -> dict[str, Any]:
        """All folds together: RMS of the RMS, and the largest of all."""
        out = {}
        for key in dict.fromkeys(key for fold in self.folds for key in fold):
            values = [fold[key] for fold in self.folds if key in fold]
            if key == "unit":
                out[key] = values[0]
            else:
                out[key] = float(max(values) if "max" in key else np.sqrt(np.mean(np.square(values))))
        return out


def standard_error(values: Array) -> float:
    """Standard error of the mean of values (k,); infinite for one."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else np.inf


def cross_validate(fit: Result, folds: Sequence[Fold] | None = None) -> CrossValidation:
    """How well a result's model predicts what it is not fitted to.

    Args:
        fit: a calibration; its sigmas, weights and priors are kept.
        folds: of `random_folds`, `group_folds` or `region_folds`; the last without it.

    Raises:
        DhcalError: folds that were not made for the fitted data.
    """
    problem, weights, x = fit.problem, fit.problem.weights, fit.x
    folds = folds if folds is not None else region_folds(problem.data)
    sizes = [len(item.rows) for item in problem.data]
    if any([len(mask) for mask in fold] != sizes for fold in folds):
        raise DhcalError(f"folds were made for other data; {len(sizes)} measurements have {sizes} samples")
    every = np.ones(len(x), bool)
    robot = len(problem.errors.parameters)
    errors, judged = [], []
    for fold, part in zip(folds, parts(problem, x, folds), strict=True):
        errors.append(part.error(weights, x, every))
        moved = x + solved(part.fitted, weights, x, every)[0]
        unseen = {u.name for u, alone in zip(problem.unknowns, part.unseen[robot:], strict=True) if alone}
        known = {name: value for name, value in problem.instruments(moved).items() if name not in unseen}
        left = [item.take(mask) for item, mask in zip(fit.data, fold, strict=True) if mask.any()]
        judged.append(accuracy(problem.errors.at(moved[:robot]), left, known))
    return CrossValidation(tuple(judged), np.array(errors))
