"""Criteria against explicit determinants and traces, selections against all sets of a small problem."""

from itertools import combinations

import numpy as np
import pytest

from dhcal_pin.planning.criteria import AOptimality, BiasVarianceCriterion, DOptimality, EOptimality
from dhcal_pin.planning.exchange import (
    CandidateSet,
    compute_sqrt_covariance,
    improve_by_exchange,
    select_greedily,
)

NONE = np.empty((0, 1))


def draw_candidates(p: int, k: int, m: int, seed: int = 0) -> CandidateSet:
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((p, k, m)) * rng.lognormal(size=m)
    return CandidateSet(rows, np.arange(m, dtype=float)[:, None])


def information(candidates: CandidateSet, selected) -> np.ndarray:
    rows = candidates.rows_of(np.array(selected, int)).reshape(-1, len(candidates.rows))
    return np.eye(len(candidates.rows)) + rows.T @ rows


def criterion_values(candidates: CandidateSet, selected, weights: np.ndarray) -> dict[str, float]:
    """Compute each criterion from the covariance itself."""
    covariance = np.linalg.inv(information(candidates, selected))
    return {
        "D": np.linalg.slogdet(covariance)[1] / len(covariance),
        "A": np.log(np.trace(weights.T @ covariance @ weights)),
        "E": np.log(np.linalg.eigvalsh(covariance)[-1]),
    }


def test_e_optimality_prefers_rows_that_lower_the_largest_variance():
    """The second candidate knows much more, but about a direction that is not the worst."""
    criterion = EOptimality(np.eye(2))
    sqrt_covariance = np.diag([1.0, 0.9])
    rows = np.zeros((2, 1, 2))
    rows[0, 0, 0], rows[1, 0, 1] = 0.8, 2.5
    gains = criterion.gains(rows, sqrt_covariance)
    before = criterion.value(sqrt_covariance)
    after = [
        criterion.value(np.linalg.inv(np.linalg.cholesky(np.diag([1.0, 0.9**-2]) + np.outer(row, row)).T))
        for row in rows[:, 0].T
    ]
    # Only the first candidate lowers the criterion.
    assert after[0] < before - 0.1
    assert after[1] == pytest.approx(before)
    assert gains[0] > gains[1] > 0


CRITERIA = {"D": DOptimality(), "A": AOptimality(np.eye(5)[:, :3]), "E": EOptimality(np.eye(5))}
WEIGHTS = np.eye(5)[:, :3]


@pytest.mark.parametrize("name", CRITERIA)
def test_values_equal_those_of_the_covariance(name):
    candidates = draw_candidates(5, 2, 30)
    root = compute_sqrt_covariance(np.eye(5), candidates.rows_of(np.arange(4)))
    assert CRITERIA[name].value(root) == pytest.approx(
        criterion_values(candidates, range(4), WEIGHTS)[name], rel=1e-12
    )


def test_gains_are_the_improvements_by_one_more_candidate():
    candidates, selected = draw_candidates(5, 3, 20), [0, 3]
    root = compute_sqrt_covariance(np.eye(5), candidates.rows_of(np.array(selected)))
    before = np.linalg.inv(information(candidates, selected))
    after = [np.linalg.inv(information(candidates, [*selected, i])) for i in range(20)]
    determinant = [np.linalg.slogdet(before)[1] - np.linalg.slogdet(one)[1] for one in after]
    variance_change = [np.trace(WEIGHTS.T @ (before - one) @ WEIGHTS) for one in after]
    assert DOptimality().gains(candidates.rows, root) == pytest.approx(determinant, rel=1e-10)
    assert AOptimality(WEIGHTS).gains(candidates.rows, root) == pytest.approx(variance_change, rel=1e-10)


def test_gains_of_candidates_beside_which_nothing_else_counts_are_finite():
    """Rounding hides the 1 of the determinant beside products of 1e18."""
    row = 1e9 * np.arange(1.0, 6.0)
    rows = np.stack([row, row], 1)[:, :, None]
    assert DOptimality().gains(rows, np.eye(5)) == pytest.approx(np.log1p(2 * row @ row), rel=0.03)


def test_bias_variance_criterion_equals_its_definition():
    """Variance and bias of a fit that takes two of seven unknowns as zero, from the information matrix."""
    candidates, rng = draw_candidates(7, 2, 30), np.random.default_rng(1)
    fitted = np.array([True, True, False, True, True, False, True])
    target_bias = rng.standard_normal((3, 2))
    criterion = BiasVarianceCriterion(fitted, WEIGHTS, target_bias)

    def expected(selected) -> float:
        every = information(candidates, selected)
        covariance = np.linalg.inv(every[np.ix_(fitted, fitted)])
        bias = covariance @ every[np.ix_(fitted, ~fitted)]
        variance = np.trace(WEIGHTS.T @ covariance @ WEIGHTS)
        return 0.5 * float(np.log(variance * np.sum((WEIGHTS.T @ bias - target_bias) ** 2)))

    selected = [0, 3, 4]
    root = compute_sqrt_covariance(np.eye(7), candidates.rows_of(np.array(selected)))
    assert criterion.value(root) == pytest.approx(expected(selected), rel=1e-12)
    after = [expected([*selected, i]) for i in range(30)]
    assert criterion.gains(candidates.rows, root) == pytest.approx(-np.array(after), rel=1e-10)


@pytest.mark.parametrize("name", CRITERIA)
@pytest.mark.parametrize("seed", range(5))
def test_exchange_comes_close_to_the_best_of_all_sets(name, seed):
    candidates = draw_candidates(5, 2, 14, seed)
    selection = select_greedily(candidates, np.eye(5), 4, CRITERIA[name], np.zeros(0, int), NONE)
    selection = improve_by_exchange(candidates, np.eye(5), selection, CRITERIA[name], NONE)
    every = [criterion_values(candidates, selected, WEIGHTS)[name] for selected in combinations(range(14), 4)]
    reached = criterion_values(candidates, selection, WEIGHTS)[name]
    assert len(set(selection)) == 4
    # The exchange may miss the best of all 1001 sets, but the result is among the best per cent.
    assert np.mean(np.array(every) < reached - 1e-12) <= 0.01


def test_infeasible_and_close_candidates_are_not_selected():
    rng = np.random.default_rng(0)
    coordinates = rng.uniform(0, 1, (200, 2))
    candidates = CandidateSet(rng.standard_normal((5, 2, 200)), coordinates, 0.15, lambda i: i % 3 > 0)
    selection = select_greedily(candidates, np.eye(5), 8, DOptimality(), np.zeros(0, int), coordinates[:1])
    selection = improve_by_exchange(candidates, np.eye(5), selection, DOptimality(), coordinates[:1])
    assert (selection % 3 > 0).all()
    occupied = np.concatenate([coordinates[:1], coordinates[selection]])
    distances = np.linalg.norm(occupied[:, None] - occupied, axis=2) + np.eye(9)
    assert distances.min() >= 0.15


def test_fewer_are_selected_if_no_more_are_feasible():
    candidates = CandidateSet(draw_candidates(5, 2, 20).rows, np.zeros((20, 1)), 0.0, lambda i: i < 3)
    assert sorted(select_greedily(candidates, np.eye(5), 8, DOptimality(), np.zeros(0, int), NONE)) == [
        0,
        1,
        2,
    ]


def test_weak_priors_do_not_cost_digits():
    """Unknowns known to 10 m before and to 1e-6 m after; squared, the ratio exceeds double precision."""
    candidates = draw_candidates(5, 3, 10)
    scaled = np.concatenate([1e8 * candidates.rows[:3], candidates.rows[3:]])
    selected = np.arange(6)
    root = compute_sqrt_covariance(np.eye(5), CandidateSet(scaled, candidates.coordinates).rows_of(selected))
    wide = information(candidates, selected) - np.eye(5) + np.diag([1e-16] * 3 + [1.0] * 2)
    expected = -(np.linalg.slogdet(wide)[1] + 2 * 3 * np.log(1e8)) / 5
    assert DOptimality().value(root) == pytest.approx(expected, rel=1e-9)
