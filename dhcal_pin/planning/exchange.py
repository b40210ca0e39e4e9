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

import numpy as np
from scipy.linalg import lapack

from .._typing import Array
from .criteria import Criterion

# A pass of exchanges that gains less than this is the last one: a thousandth of efficiency.
MIN_PASS_GAIN = 1e-3


MAX_PASSES = 20


# Exchange looks at so many candidates, those which would add most to the design as it is.
MAX_EXCHANGE_CANDIDATES = 600


def sqrt_covariance(prior_factor: Array, rows: Array) -> Array:
    """R⁻¹ (p, p) of the QR of a triangle (p, p) and rows (n, k, p) below it: a root of the covariance."""
    p = prior_factor.shape[1]
    triangle = np.linalg.qr(np.concatenate([prior_factor, rows.reshape(-1, p)]), mode="r")
    return lapack.dtrtri(triangle)[0]


def _always(_: int) -> bool:
    return True


@dataclass(frozen=True, eq=False)
class CandidateSet:
    """Candidates to choose from.

    Attributes:
        rows: (p, k, m) whitened, the unknowns in units of their priors.
        coordinates: (m, d) where they stand. What no model holds is alike for neighbours, so two of them tell less
            than their rows say.
        min_distance: the distance that two chosen ones keep.
        is_feasible: tells of a candidate whether it can be measured at all; asked only of those that are wanted.
        infeasible: (m,) candidates known to be impossible; grows as they are asked about.
    """

    rows: Array
    coordinates: Array
    min_distance: float = 0.0
    is_feasible: Callable[[int], bool] = _always
    infeasible: Array = field(default_factory=lambda: np.zeros(0, bool))

    @classmethod
    def from_rows(
        cls, rows: Array, places: Array, apart: float = 0.0, possible: Callable[[int], bool] = _always
    ) -> CandidateSet:
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
        gains = np.where(self.infeasible[among] | self._is_too_close(among, others), -np.inf, gains)
        while gains.size:
            at = int(np.argmax(gains))
            if gains[at] == -np.inf:
                break
            if self.is_feasible(int(among[at])):
                return int(among[at])
            self.infeasible[among[at]] = True
            gains[at] = -np.inf
        return None

    def _is_too_close(self, among: Array, others: Array) -> Array:
        """Which of the candidates (w,) stand too near to other places (n, d)."""
        if not self.min_distance:
            return np.zeros(len(among), bool)
        here = self.coordinates[among]
        squares = np.sum(here**2, 1)[:, None] + np.sum(others**2, 1) - 2 * here @ others.T
        return np.any(squares < self.min_distance**2, 1)


def greedy(
    pool: CandidateSet, prior_factor: Array, count: int, criterion: Criterion, chosen: Array, existing: Array
) -> Array:
    """Numbers of the chosen ones and of `count` more, each the best to add; fewer if no more are possible.

    Args:
        pool: candidates.
        prior_factor: (p, p) triangle of what is known.
        count: how many to add.
        criterion: what for.
        chosen: (c,) numbers.
        existing: (n, d) further places to keep away from.
    """
    every = np.arange(pool.rows.shape[2])
    out = list(map(int, chosen))
    for _ in range(count):
        gains = criterion.gains(pool.rows, sqrt_covariance(prior_factor, pool.at(np.array(out, int))))
        gains[out] = -np.inf
        found = pool.best(gains, every, np.concatenate([existing, pool.coordinates[out]]))
        if found is None:
            break
        out.append(found)
    return np.array(out, int)


def exchange(
    pool: CandidateSet,
    prior_factor: Array,
    chosen: Array,
    criterion: Criterion,
    existing: Array,
    passes: int = MAX_PASSES,
) -> Array:
    """The chosen ones (n,) after exchanging each for the best in its place, until that gains next to nothing.

    Args:
        pool: candidates.
        prior_factor: (p, p) triangle of what is known.
        chosen: (n,) numbers.
        criterion: what for.
        existing: (c, d) further places to keep away from.
        passes: the most of them.
    """
    chosen = chosen.copy()
    value = criterion.value(sqrt_covariance(prior_factor, pool.at(chosen)))
    for _ in range(passes):
        before = value
        gains = criterion.gains(pool.rows, sqrt_covariance(prior_factor, pool.at(chosen)))
        gains[chosen] = np.inf
        near = np.argsort(-gains)[: max(MAX_EXCHANGE_CANDIDATES, 2 * len(chosen))]
        rows = np.ascontiguousarray(pool.rows[:, :, near])
        for slot in range(len(chosen)):
            others = np.delete(chosen, slot)
            gains = criterion.gains(rows, sqrt_covariance(prior_factor, pool.at(others)))
            gains[np.isin(near, others)] = -np.inf
            found = pool.best(gains, near, np.concatenate([existing, pool.coordinates[others]]))
            if found is None or found == chosen[slot]:
                continue
            trial = chosen.copy()
            trial[slot] = found
            reached = criterion.value(sqrt_covariance(prior_factor, pool.at(trial)))
            if reached < value:
                chosen, value = trial, reached
        if before - value < MIN_PASS_GAIN:
            break
    return chosen
