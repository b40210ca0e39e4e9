"""Rows of which a part of the noise is known: evidence and its best noise, compared with dense matrices."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from dhcal_pin.estimation.folds import NoiseClass, NoisyRows, join_classes
from dhcal_pin.estimation.qr import TriangularSystem, merge_r_factors

SHARES, COUNTS, P = (0.0, 0.4, 0.98), (40, 25, 30), 4


def system(rows: np.ndarray) -> TriangularSystem:
    return TriangularSystem(merge_r_factors([rows]))


def simulated(noise: float, seed: int = 0) -> tuple[NoisyRows, list[np.ndarray]]:
    """Rows [J | r] of classes whose noise is scaled."""
    rng = np.random.default_rng(seed)
    blocks = []
    for share, count in zip(SHARES, COUNTS, strict=True):
        j = rng.normal(size=(count, P))
        r = j @ np.arange(1.0, P + 1) + rng.normal(size=count) * np.sqrt(1 - share + share * noise**2)
        blocks.append(np.column_stack([j, r]))
    classes = [NoiseClass(system(b), len(b), t) for b, t in zip(blocks, SHARES, strict=True)]
    return NoisyRows(tuple(classes)), blocks


def dense_log_evidence(blocks: list[np.ndarray], weights: np.ndarray, noise: float) -> float:
    """Log density of r ~ N(0, V + J·W⁻²·Jᵀ), up to a constant."""
    variance = np.repeat([1 - t + t * noise**2 for t in SHARES], COUNTS)
    rows = np.concatenate(blocks)
    j, r = rows[:, :-1], rows[:, -1]
    covariance = np.diag(variance) + (j / weights**2) @ j.T
    return -0.5 * float(r @ np.linalg.solve(covariance, r) + np.linalg.slogdet(covariance)[1])


def test_evidence_and_its_best_noise_are_those_of_dense_matrices():
    rows, blocks = simulated(0.3)
    weights = np.full(P, 0.2)

    def log_evidence(noise: float) -> float:
        posterior = rows.at(noise).with_priors(weights, 0.0)
        log_det = np.sum(np.log(np.abs(np.diag(posterior.r)))) - np.sum(np.log(weights))
        return -0.5 * posterior.min_cost - float(log_det) - rows.log_det(noise)

    for noise in (0.1, 0.5, 2.0):
        change = log_evidence(noise) - log_evidence(1.0)
        dense = dense_log_evidence(blocks, weights, noise) - dense_log_evidence(blocks, weights, 1.0)
        assert change == pytest.approx(dense, abs=1e-9)
    best = minimize_scalar(
        lambda s: -dense_log_evidence(blocks, weights, s), bounds=(0.05, 3), method="bounded"
    ).x
    noise = 1.0
    for _ in range(100):
        fitted = rows.at(noise)
        root = fitted.sqrt_covariance(weights)[0]
        n_determined = P - np.sum((root * weights[:, None]) ** 2)
        noise = rows.noise_after(noise, fitted.solve(weights, 0.0)[0], root, n_determined)
    assert noise == pytest.approx(best, rel=1e-3)


def test_rows_of_unknown_noise_alone_have_that_of_their_residuals():
    rng = np.random.default_rng(1)
    block = rng.normal(size=(50, P + 1))
    rows = NoisyRows((NoiseClass(system(block), 50),))
    fitted = rows.at(0.7)
    step, root = fitted.solve(np.zeros(P), 0.0)[0], fitted.sqrt_covariance(np.zeros(P))[0]
    misfit = np.sum((block[:, -1] - block[:, :-1] @ step) ** 2)
    assert rows.noise_after(0.7, step, root, P) == pytest.approx(np.sqrt(misfit / (50 - P)))


def test_joined_parts_are_all_rows_class_by_class():
    rows, blocks = simulated(1.0)
    halves = [
        NoisyRows(
            tuple(NoiseClass(system(b[part]), len(b[part]), t) for b, t in zip(blocks, SHARES, strict=True))
        )
        for part in (np.s_[::2], np.s_[1::2])
    ]
    joined = join_classes(halves)
    assert joined.n_scaled == rows.n_scaled == 55
    for noise in (0.2, 1.5):
        r, other = (each.at(noise).rows for each in (rows, joined))
        np.testing.assert_allclose(r.T @ r, other.T @ other, atol=1e-9)
