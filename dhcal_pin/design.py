"""Optimal design of experiments: which of many candidates' readings tell most about p unknowns.

A candidate is k whitened rows of a Jacobian by the unknowns, each in units of its prior's sigma; a pool of m
of them is (p, k, m), components first. What is known beforehand, priors included, is a triangle R, and
C = R⁻¹R⁻ᵀ the covariance. A criterion weighs C: smaller is better, a hundredth less is one per cent better.

Greedy choice, then exchange (Fedorov 1972; Cook and Nachtsheim 1980), with each candidate's k×k determinant
in place of a p×p one. C never appears, only its root: squaring would lose half the digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.linalg import lapack

from .se3 import Array

# A pass of exchanges that gains less than this is the last one: a thousandth of efficiency.
ENOUGH = 1e-3
MOST_PASSES = 20
# Exchange looks at so many candidates, those which would add most to the design as it is.
PROMISING = 600


def basis(start: Array, rows: Array) -> Array:
    """R⁻¹ (p, p) of the QR of a triangle (p, p) and rows (n, k, p) below it: a root of the covariance."""
    p = start.shape[1]
    triangle = np.linalg.qr(np.concatenate([start, rows.reshape(-1, p)]), mode="r")
    return lapack.dtrtri(triangle)[0]


class Criterion(Protocol):
    """What a design is chosen for."""

    def value(self, root: Array) -> float:
        """Log of what is to be small, of a root (p, p) of the covariance."""
        ...

    def gains(self, rows: Array, root: Array) -> Array:
        """How much each candidate (m,) of a pool (p, k, m) would help, by a measure that ranks them."""
        ...


def _turned(rows: Array, by: Array) -> Array:
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


@dataclass(frozen=True)
class Determinant:
    """D: the volume of the unknowns' uncertainty, as the geometric mean of p standard deviations, squared."""

    def value(self, root: Array) -> float:
        """Log of det(C)^(1/p)."""
        return 2 * float(np.mean(np.log(np.abs(np.diag(root)))))

    def gains(self, rows: Array, root: Array) -> Array:
        """By how much log det of the information grows: det(I + A·C·Aᵀ)."""
        factor = _factor(_turned(rows, root))
        return 2 * np.log(np.einsum("iim->im", factor)).sum(0)


@dataclass(frozen=True, eq=False)
class Spread:
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
        turned = _turned(rows, root)
        factor = _factor(turned)
        left = _turned(turned, root.T @ self.combinations)
        for j in range(rows.shape[1]):
            for i in range(j):
                left[:, j] -= factor[j, i] * left[:, i]
            left[:, j] /= factor[j, j]
        return np.einsum("wkm,wkm->m", left, left)


@dataclass(frozen=True, eq=False)
class Worst:
    """E: the variance of the worst known among the combinations that can be known at all.

    Attributes:
        seen: (r, p) orthonormal directions that the candidates see.
    """

    seen: Array

    def value(self, root: Array) -> float:
        """Log of the largest variance."""
        return 2 * float(np.log(np.linalg.norm(self.seen @ root, 2)))

    def gains(self, rows: Array, root: Array) -> Array:
        """By how much a sum of variances falls in which the worst ones count nearly alone."""
        directions, size, _ = np.linalg.svd(self.seen @ root, full_matrices=False)
        return Spread(self.seen.T @ directions * (size / size[0]) ** 6).gains(rows, root)


def _free(_: int) -> bool:
    return True


@dataclass(frozen=True, eq=False)
class Pool:
    """Candidates to choose from.

    Attributes:
        rows: (p, k, m) whitened, the unknowns in units of their priors.
        places: (m, d) where they stand. What no model holds is alike for neighbours, so two of them tell less
            than their rows say.
        apart: the distance that two chosen ones keep.
        possible: tells of a candidate whether it can be measured at all; asked only of those that are wanted.
        closed: (m,) candidates known to be impossible; grows as they are asked about.
    """

    rows: Array
    places: Array
    apart: float = 0.0
    possible: Callable[[int], bool] = _free
    closed: Array = field(default_factory=lambda: np.zeros(0, bool))

    @classmethod
    def of(
        cls, rows: Array, places: Array, apart: float = 0.0, possible: Callable[[int], bool] = _free
    ) -> Pool:
        """Candidates none of which is known to be impossible."""
        return cls(rows, places, apart, possible, np.zeros(rows.shape[2], bool))

    def at(self, chosen: Array) -> Array:
        """The chosen ones' rows (n, k, p)."""
        return np.ascontiguousarray(self.rows[:, :, chosen].transpose(2, 1, 0))

    def best(self, gains: Array, among: Array, others: Array) -> int | None:
        """The possible one of the largest gain (w,), or None.

        Args:
            gains: (w,), -inf for what is out of the question.
            among: (w,) their numbers.
            others: (n, d) places to keep away from.
        """
        gains = np.where(self.closed[among] | self._crowded(among, others), -np.inf, gains)
        while gains.size:
            at = int(np.argmax(gains))
            if gains[at] == -np.inf:
                break
            if self.possible(int(among[at])):
                return int(among[at])
            self.closed[among[at]] = True
            gains[at] = -np.inf
        return None

    def _crowded(self, among: Array, others: Array) -> Array:
        """Which of the candidates (w,) stand too near to other places (n, d)."""
        if not self.apart:
            return np.zeros(len(among), bool)
        here = self.places[among]
        squares = np.sum(here**2, 1)[:, None] + np.sum(others**2, 1) - 2 * here @ others.T
        return np.any(squares < self.apart**2, 1)


def greedy(pool: Pool, start: Array, count: int, criterion: Criterion, chosen: Array, kept: Array) -> Array:
    """Numbers of the chosen ones and of `count` more, each the best to add; fewer if no more are possible.

    Args:
        pool: candidates.
        start: (p, p) triangle of what is known.
        count: how many to add.
        criterion: what for.
        chosen: (c,) numbers.
        kept: (n, d) further places to keep away from.
    """
    every = np.arange(pool.rows.shape[2])
    out = list(map(int, chosen))
    for _ in range(count):
        gains = criterion.gains(pool.rows, basis(start, pool.at(np.array(out, int))))
        gains[out] = -np.inf
        found = pool.best(gains, every, np.concatenate([kept, pool.places[out]]))
        if found is None:
            break
        out.append(found)
    return np.array(out, int)


def exchange(
    pool: Pool, start: Array, chosen: Array, criterion: Criterion, kept: Array, passes: int = MOST_PASSES
) -> Array:
    """The chosen ones (n,) after exchanging each for the best in its place, until that gains next to nothing.

    Args:
        pool: candidates.
        start: (p, p) triangle of what is known.
        chosen: (n,) numbers.
        criterion: what for.
        kept: (c, d) further places to keep away from.
        passes: the most of them.
    """
    chosen = chosen.copy()
    value = criterion.value(basis(start, pool.at(chosen)))
    for _ in range(passes):
        before = value
        gains = criterion.gains(pool.rows, basis(start, pool.at(chosen)))
        gains[chosen] = np.inf
        near = np.argsort(-gains)[: max(PROMISING, 2 * len(chosen))]
        rows = np.ascontiguousarray(pool.rows[:, :, near])
        for slot in range(len(chosen)):
            others = np.delete(chosen, slot)
            gains = criterion.gains(rows, basis(start, pool.at(others)))
            gains[np.isin(near, others)] = -np.inf
            found = pool.best(gains, near, np.concatenate([kept, pool.places[others]]))
            if found is None or found == chosen[slot]:
                continue
            trial = chosen.copy()
            trial[slot] = found
            reached = criterion.value(basis(start, pool.at(trial)))
            if reached < value:
                chosen, value = trial, reached
        if before - value < ENOUGH:
            break
    return chosen
