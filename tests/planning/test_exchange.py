"""Optimal choice: gains against determinants and traces formed outright, small sets against all."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from dhcal_pin.planning.criteria import AOptimality, BiasVarianceCriterion, DOptimality, EOptimality
from dhcal_pin.planning.exchange import CandidateSet, exchange, greedy, sqrt_covariance

NONE = np.empty((0, 1))


def draw(p: int, k: int, m: int, seed: int = 0) -> CandidateSet:
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((p, k, m)) * rng.lognormal(size=m)
    return CandidateSet.from_rows(rows, np.arange(m, dtype=float)[:, None])


def information(pool: CandidateSet, chosen) -> np.ndarray:
    rows = pool.at(np.array(chosen, int)).reshape(-1, len(pool.rows))
    return np.eye(len(pool.rows)) + rows.T @ rows


def measures(pool: CandidateSet, chosen, weights: np.ndarray) -> dict[str, float]:
    """What each criterion weighs, formed from the covariance itself."""
    covariance = np.linalg.inv(information(pool, chosen))
    return {
        "D": np.linalg.slogdet(covariance)[1] / len(covariance),
        "A": np.log(np.trace(weights.T @ covariance @ weights)),
        "E": np.log(np.linalg.eigvalsh(covariance)[-1]),
    }


CRITERIA = {"D": DOptimality(), "A": AOptimality(np.eye(5)[:, :3]), "E": EOptimality(np.eye(5))}
WEIGHTS = np.eye(5)[:, :3]


@pytest.mark.parametrize("name", CRITERIA)
def test_values_are_those_of_the_covariance(name):
    pool = draw(5, 2, 30)
    root = sqrt_covariance(np.eye(5), pool.at(np.arange(4)))
    assert CRITERIA[name].value(root) == pytest.approx(measures(pool, range(4), WEIGHTS)[name], rel=1e-12)


def test_gains_are_what_another_candidate_brings():
    pool, chosen = draw(5, 3, 20), [0, 3]
    root = sqrt_covariance(np.eye(5), pool.at(np.array(chosen)))
    before = np.linalg.inv(information(pool, chosen))
    after = [np.linalg.inv(information(pool, [*chosen, i])) for i in range(20)]
    determinant = [np.linalg.slogdet(before)[1] - np.linalg.slogdet(one)[1] for one in after]
    spread = [np.trace(WEIGHTS.T @ (before - one) @ WEIGHTS) for one in after]
    assert DOptimality().gains(pool.rows, root) == pytest.approx(determinant, rel=1e-10)
    assert AOptimality(WEIGHTS).gains(pool.rows, root) == pytest.approx(spread, rel=1e-10)


def test_a_compromise_weighs_noise_and_what_is_left_out():
    """Mean squared errors of a fit that takes two of seven unknowns for zero, formed outright."""
    pool, rng = draw(7, 2, 30), np.random.default_rng(1)
    fitted = np.array([True, True, False, True, True, False, True])
    wanted = rng.standard_normal((3, 2))
    criterion = BiasVarianceCriterion(fitted, WEIGHTS, wanted)

    def expected(chosen) -> float:
        every = information(pool, chosen)
        covariance = np.linalg.inv(every[np.ix_(fitted, fitted)])
        bias = covariance @ every[np.ix_(fitted, ~fitted)]
        variance = np.trace(WEIGHTS.T @ covariance @ WEIGHTS)
        return 0.5 * float(np.log(variance * np.sum((WEIGHTS.T @ bias - wanted) ** 2)))

    chosen = [0, 3, 4]
    root = sqrt_covariance(np.eye(7), pool.at(np.array(chosen)))
    assert criterion.value(root) == pytest.approx(expected(chosen), rel=1e-12)
    after = [expected([*chosen, i]) for i in range(30)]
    assert criterion.gains(pool.rows, root) == pytest.approx(-np.array(after), rel=1e-10)


@pytest.mark.parametrize("name", CRITERIA)
@pytest.mark.parametrize("seed", range(5))
def test_exchange_comes_near_the_best_of_all_sets(name, seed):
    pool = draw(5, 2, 14, seed)
    found = greedy(pool, np.eye(5), 4, CRITERIA[name], np.zeros(0, int), NONE)
    found = exchange(pool, np.eye(5), found, CRITERIA[name], NONE)
    every = [measures(pool, chosen, WEIGHTS)[name] for chosen in combinations(range(14), 4)]
    reached = measures(pool, found, WEIGHTS)[name]
    assert len(set(found)) == 4
    # One-by-one exchange may end beside the best of all 1001 sets, but never far down the list.
    assert np.mean(np.array(every) < reached - 1e-12) <= 0.01


def test_impossible_and_crowded_candidates_are_left_out():
    rng = np.random.default_rng(0)
    places = rng.uniform(0, 1, (200, 2))
    pool = CandidateSet.from_rows(rng.standard_normal((5, 2, 200)), places, 0.15, lambda i: i % 3 > 0)
    found = greedy(pool, np.eye(5), 8, DOptimality(), np.zeros(0, int), places[:1])
    found = exchange(pool, np.eye(5), found, DOptimality(), places[:1])
    assert (found % 3 > 0).all()
    there = np.concatenate([places[:1], places[found]])
    between = np.linalg.norm(there[:, None] - there, axis=2) + np.eye(9)
    assert between.min() >= 0.15


def test_fewer_are_chosen_where_no_more_are_possible():
    pool = CandidateSet.from_rows(draw(5, 2, 20).rows, np.zeros((20, 1)), 0.0, lambda i: i < 3)
    assert sorted(greedy(pool, np.eye(5), 8, DOptimality(), np.zeros(0, int), NONE)) == [0, 1, 2]


def test_a_weak_prior_takes_no_digits():
    """Unknowns known to 10 m before and to 1e-6 m after: squared, that is beyond a double's digits."""
    pool = draw(5, 3, 10)
    scaled = np.concatenate([1e8 * pool.rows[:3], pool.rows[3:]])
    chosen = np.arange(6)
    root = sqrt_covariance(np.eye(5), CandidateSet.from_rows(scaled, pool.coordinates).at(chosen))
    wide = information(pool, chosen) - np.eye(5) + np.diag([1e-16] * 3 + [1.0] * 2)
    expected = -(np.linalg.slogdet(wide)[1] + 2 * 3 * np.log(1e8)) / 5
    assert DOptimality().value(root) == pytest.approx(expected, rel=1e-9)
