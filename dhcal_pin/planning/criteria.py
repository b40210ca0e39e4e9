"""What a design of experiments is chosen for, weighed by a root of the unknowns' covariance.

Smaller is better, a hundredth less is one per cent better. Candidates are as in `design`: a pool of m of
them is (p, k, m), whitened rows by p unknowns in units of their priors. Of their covariance C there is only
a root, C = H·Hᵀ: squaring would lose half the digits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .._typing import Array


class Criterion(Protocol):
    """What a design is chosen for."""

    def value(self, root: Array) -> float:
        """Log of what is to be small, of a root (p, p) of the covariance."""
        ...

    def gains(self, rows: Array, root: Array) -> Array:
        """How much each candidate (m,) of a pool (p, k, m) would help, by a measure that ranks them."""
        ...


def _transform_rows(rows: Array, by: Array) -> Array:
    """Rows (p, k, m) in coordinates by (p, w): (w, k, m)."""
    p, k, m = rows.shape
    return (by.T @ rows.reshape(p, k * m)).reshape(-1, k, m)


def _factor(rows: Array) -> Array:
    """Cholesky factors (k, k, m), lower, of I + rowsᵀ·rows for rows (p, k, m), all candidates at once."""
    k, m = rows.shape[1:]
    out = np.empty((k, k, m))
    for i in range(k):
        for j in range(i + 1):
            np.einsum("pm,pm->m", rows[:, i], rows[:, j], out=out[i, j])
        out[i, i] += 1.0
    for j in range(k):
        for i in range(j):
            out[j:, j] -= out[j:, i] * out[j, i]
        np.sqrt(out[j, j], out=out[j, j])
        out[j + 1 :, j] /= out[j, j]
    return out


def _solve_factor(rows: Array, factor: Array) -> Array:
    """Rows (w, k, m) times the inverse transposes of lower factors (k, k, m), in place."""
    for j in range(rows.shape[1]):
        for i in range(j):
            rows[:, j] -= factor[j, i] * rows[:, i]
        rows[:, j] /= factor[j, j]
    return rows


@dataclass(frozen=True)
class DOptimality:
    """D: the volume of the unknowns' uncertainty, as the geometric mean of p standard deviations, squared."""

    def value(self, root: Array) -> float:
        """Log of det(C)^(1/p)."""
        return 2 * float(np.mean(np.log(np.abs(np.diag(root)))))

    def gains(self, rows: Array, root: Array) -> Array:
        """By how much log det of the information grows: det(I + A·C·Aᵀ)."""
        factor = _factor(_transform_rows(rows, root))
        return 2 * np.log(np.einsum("iim->im", factor)).sum(0)


@dataclass(frozen=True, eq=False)
class AOptimality:
    """A and task: the sum of the variances of some combinations of the unknowns.

    Attributes:
        combinations: (p, w).
    """

    combinations: Array

    def value(self, root: Array) -> float:
        """Log of the sum."""
        return float(np.log(np.sum((self.combinations.T @ root) ** 2)))

    def gains(self, rows: Array, root: Array) -> Array:
        """By how much the sum falls: tr((I + A·C·Aᵀ)⁻¹·A·C·W·C·Aᵀ)."""
        turned = _transform_rows(rows, root)
        factor = _factor(turned)
        left = _solve_factor(_transform_rows(turned, root.T @ self.combinations), factor)
        return np.einsum("wkm,wkm->m", left, left)


@dataclass(frozen=True, eq=False)
class EOptimality:
    """E: the variance of the worst known among the combinations that can be known at all.

    Attributes:
        observable: (r, p) orthonormal directions that the candidates see.
    """

    observable: Array

    def value(self, root: Array) -> float:
        """Log of the largest variance."""
        return 2 * float(np.log(np.linalg.norm(self.observable @ root, 2)))

    def gains(self, rows: Array, root: Array) -> Array:
        """By how much a sum of variances falls in which the worst ones count nearly alone."""
        directions, size, _ = np.linalg.svd(self.observable @ root, full_matrices=False)
        return AOptimality(self.observable.T @ directions * (size / size[0]) ** 6).gains(rows, root)


@dataclass(frozen=True, eq=False)
class BiasVarianceCriterion:
    """Robust: the error of some combinations by noise and by what the fit's model leaves out, both alike.

    A fit that takes f of the unknowns for zero while they are not puts them down to the others: with rows A
    of those that it finds and Φ of those left out, C·Aᵀ·Φ of them (the alias matrix of Box and Draper 1959).
    What that adds to the mean squared error, beyond what a fit to the task itself would suffer, counts as
    much as the variance, whatever the ratio of their sizes, which nobody knows before measuring: what is
    small is the geometric mean of the two (compound designs, Läuter 1974).

    Attributes:
        fitted: (p+f,) which unknowns a fit finds.
        combinations: (p, w) of these, orthogonal ones over the task.
        wanted: (w, f) what of those left out a fit to the task itself would show in the combinations.
    """

    fitted: Array
    combinations: Array
    wanted: Array

    def _known(self, root: Array) -> tuple[Array, Array]:
        """With those left out held at zero: root (p, p) of the others' covariance, and their bias (p, f)."""
        own, lost = root[self.fitted], root[~self.fitted]
        q, triangle = np.linalg.qr(lost.T)
        shared = own @ q
        held = np.linalg.qr((own - shared @ q.T).T, mode="r").T
        return held, -np.linalg.solve(triangle, shared.T).T

    def value(self, root: Array) -> float:
        """Log of the geometric mean of variance and squared bias."""
        held, bias = self._known(root)
        variance = np.sum((self.combinations.T @ held) ** 2)
        return float(np.log(variance * np.sum((self.combinations.T @ bias - self.wanted) ** 2)) / 2)

    def gains(self, rows: Array, root: Array) -> Array:
        """By how much the mean of both falls, up to what is the same for all candidates."""
        held, bias = self._known(root)
        own, lost = rows[self.fitted], rows[~self.fitted]
        turned = _transform_rows(own, held)
        factor = _factor(turned)
        seen = _solve_factor(_transform_rows(turned, held.T @ self.combinations), factor)
        news = _solve_factor(lost - _transform_rows(own, bias), factor)
        off = self.combinations.T @ bias - self.wanted
        variance = np.sum((self.combinations.T @ held) ** 2) - np.einsum("wkm,wkm->m", seen, seen)
        square = np.sum(off**2) + 2 * np.einsum("fkm,fkm->m", _transform_rows(seen, off), news)
        for i in range(rows.shape[1]):
            for j in range(rows.shape[1]):
                both = np.einsum("wm,wm->m", seen[:, i], seen[:, j])
                square += both * np.einsum("fm,fm->m", news[:, i], news[:, j])
        return -np.log(variance * square) / 2
