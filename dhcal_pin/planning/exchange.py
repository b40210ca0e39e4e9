"""Selection of candidates: greedy choice, then exchange of single candidates.

A candidate is a block of k whitened Jacobian rows by p unknowns in units of their prior standard deviations;
m candidates are an array (p, k, m). Prior knowledge is the R factor R₀ of priors and existing measurements. A
selection S has the covariance C = (R₀ᵀR₀ + Σ_S AᵢᵀAᵢ)⁻¹, of which only the square root R⁻¹ is computed, with
R the R factor of [R₀; A_S].

* Greedy: add the feasible candidate of the largest gain, n times.
* Exchange: for each selected candidate in turn, remove it and add the best one of the others, if that
  lowers the criterion; repeat until a pass gains less than `MIN_PASS_GAIN`.

Where joint correction curves are wanted, the bins of the joints are filled evenly first (`bin_filling`): that
term is added to the gains and to the value of the criterion, and is so large that the criterion only decides
between candidates that fill the bins equally well.

References:
    V. V. Fedorov, Theory of Optimal Experiments, Academic Press 1972: exchange.
    T. J. Mitchell, An algorithm for the construction of D-optimal experimental designs, Technometrics 16
    (1974), 203-210: removal and addition of one candidate at a time (DETMAX). R. D. Cook and C. J.
    Nachtsheim, A comparison of algorithms for constructing exact D-optimal designs, Technometrics 22 (1980),
    315-324: exchange of one selected candidate after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import field

import numpy as np

from .._frozen import frozen
from .._kernels import invert_triangular
from .._typing import Array
from .bin_filling import filling_cost, filling_gains
from .criteria import Criterion

# A pass of exchanges that lowers the logarithm of the criterion by less is the last one.
MIN_PASS_GAIN = 1e-3
# Largest number of passes.
MAX_PASSES = 20
# Number of candidates that a pass considers: those of the largest gain for the design as it is.
MAX_EXCHANGE_CANDIDATES = 600


def compute_sqrt_covariance(prior_factor: Array, rows: Array) -> Array:
    """Compute a square root of the covariance, R⁻¹ (p, p), after measurements with rows (n, k, p)."""
    p = prior_factor.shape[1]
    r = np.linalg.qr(np.concatenate([prior_factor, rows.reshape(-1, p)]), mode="r")
    return invert_triangular(np.asarray(r))


@frozen(eq=False)
class CandidateSet:
    """Candidates of a design."""

    # Whitened rows, with the unknowns in units of their prior standard deviations, shape (p, k, m).
    rows: Array
    # Coordinates of the candidates for their distances, shape (m, d). Effects that no model describes are
    # similar for neighbours, so two neighbours contain less information than their rows say.
    coordinates: Array
    min_distance: float = 0.0  # Smallest distance of two selected candidates
    # Expensive test of a candidate by its index; called only for candidates that are about to be selected.
    is_feasible: Callable[[int], bool] = lambda candidate: True
    # Columns of the coordinates that are joint values whose bins are filled evenly; none by default.
    bin_columns: Array | Sequence[int] = field(default_factory=lambda: np.zeros(0, int))
    # Candidates that failed the test so far, shape (m,); updated in place.
    infeasible: Array = field(default_factory=lambda: np.zeros(0, bool))

    def __post_init__(self) -> None:
        """Take all candidates as feasible until one fails the test."""
        if not self.infeasible.size:
            object.__setattr__(self, "infeasible", np.zeros(self.rows.shape[2], bool))

    def rows_of(self, selected: Array) -> Array:
        """Return the rows of selected candidates."""
        return np.ascontiguousarray(self.rows[:, :, selected].transpose(2, 1, 0))

    def filling_gains(self, indices: Array, occupied: Array) -> Array:
        """Rate candidates (w,) by how evenly each fills the bins beside occupied coordinates (n, d)."""
        return filling_gains(self.coordinates[indices][:, self.bin_columns], occupied[:, self.bin_columns])

    def filling_cost(self, occupied: Array) -> float:
        """Compute how unevenly configurations fill the bins of the joints."""
        return filling_cost(occupied[:, self.bin_columns])

    def best_candidate(self, gains: Array, indices: Array, occupied: Array) -> int | None:
        """Find the feasible candidate of the largest gain away from occupied coordinates (n, d), if any."""
        is_excluded = self.infeasible[indices] | self._is_too_close(indices, occupied)
        gains = np.where(is_excluded, -np.inf, gains)
        while gains.size:
            best = int(np.argmax(gains))
            if gains[best] == -np.inf:
                break
            if self.is_feasible(int(indices[best])):
                return int(indices[best])
            self.infeasible[indices[best]] = True
            gains[best] = -np.inf
        return None

    def _is_too_close(self, indices: Array, occupied: Array) -> Array:
        """Return whether candidates (w,) are closer than `min_distance` to any of the coordinates (n, d)."""
        if not self.min_distance:
            return np.zeros(len(indices), bool)
        coordinates = self.coordinates[indices]
        squares = np.sum(coordinates**2, 1)[:, None] + np.sum(occupied**2, 1) - 2 * coordinates @ occupied.T
        return np.any(squares < self.min_distance**2, 1)


def select_greedily(
    candidates: CandidateSet,
    prior_factor: Array,
    count: int,
    criterion: Criterion,
    selected: Array,
    existing: Array,
) -> Array:
    """Add candidates, each the best one to add next; fewer if no more are feasible."""
    # They keep their distance to the coordinates (n, d) of existing measurements.
    every = np.arange(candidates.rows.shape[2])
    out = list(map(int, selected))
    for _ in range(count):
        rows = candidates.rows_of(np.array(out, int))
        gains = criterion.gains(candidates.rows, compute_sqrt_covariance(prior_factor, rows))
        occupied = np.concatenate([existing, candidates.coordinates[out]])
        gains += candidates.filling_gains(every, occupied)
        gains[out] = -np.inf
        best = candidates.best_candidate(gains, every, occupied)
        if best is None:
            break
        out.append(best)
    return np.array(out, int)


def improve_by_exchange(
    candidates: CandidateSet,
    prior_factor: Array,
    selected: Array,
    criterion: Criterion,
    existing: Array,
    max_passes: int = MAX_PASSES,
) -> Array:
    """Exchange selected candidates one at a time for better ones, until a pass gains too little."""
    selected = selected.copy()

    every = np.arange(candidates.rows.shape[2])

    def sqrt_covariance(indices: Array) -> Array:
        return compute_sqrt_covariance(prior_factor, candidates.rows_of(indices))

    def occupied_by(indices: Array) -> Array:
        return np.concatenate([existing, candidates.coordinates[indices]])

    def design_value(indices: Array) -> float:
        return criterion.value(sqrt_covariance(indices)) + candidates.filling_cost(occupied_by(indices))

    value = design_value(selected)
    for _ in range(max_passes):
        value_before = value
        gains = criterion.gains(candidates.rows, sqrt_covariance(selected))
        gains += candidates.filling_gains(every, occupied_by(selected))
        gains[selected] = np.inf
        promising = np.argsort(-gains)[: max(MAX_EXCHANGE_CANDIDATES, 2 * len(selected))]
        rows = np.ascontiguousarray(candidates.rows[:, :, promising])
        for slot in range(len(selected)):
            others = np.delete(selected, slot)
            occupied = occupied_by(others)
            gains = criterion.gains(rows, sqrt_covariance(others))
            gains += candidates.filling_gains(promising, occupied)
            gains[np.isin(promising, others)] = -np.inf
            best = candidates.best_candidate(gains, promising, occupied)
            if best is None or best == selected[slot]:
                continue
            trial = selected.copy()
            trial[slot] = best
            trial_value = design_value(trial)
            if trial_value < value:
                selected, value = trial, trial_value
        if value_before - value < MIN_PASS_GAIN:
            break
    return selected
