"""Correlation of residuals between configurations, and the design effect."""

import numpy as np
import pytest
from robots import nominal_arm

from dhcal_pin.calibration import Result, calibrate
from dhcal_pin.estimation import select_parameters
from dhcal_pin.estimation.problem import Chunk
from dhcal_pin.identifiability import residual_correlation
from dhcal_pin.identifiability.residual_correlation import (
    CORRELATION_LENGTH,
    FAR_CORRELATION,
    LENGTHS,
    MAX_WHITE_Z,
    MIN_PAIRS,
    NEAR_CORRELATION,
    design_effect,
    find_residual_correlation,
)
from dhcal_pin.measurements import Measurement, Noise, Pose, Position

SETS = "minimal,base,tool"


def fitted(seed: int, m: int, kind: type[Measurement] = Pose, size: float = 0.0) -> Result:
    """Calibrate a UR10 with geometric errors, noise of 0.1 mm, and a smooth error of a size [m]."""
    rng = np.random.default_rng(seed)
    arm = nominal_arm("ur10")
    errors = select_parameters(arm, SETS)
    truth = errors.at(rng.normal(size=len(errors.parameters)) * np.minimum(errors.priors, 0.1))
    q = rng.uniform(-2.5, 2.5, (m, 6))
    data = kind.simulate(truth, q, Noise(1e-4, 1e-4), rng)
    # Random waves: a Gaussian field with correlation length 3 rad.
    waves = np.cos(q @ rng.normal(size=(6, 300)) / 3 + rng.uniform(0, 2 * np.pi, 300))
    offsets = size * np.sqrt(2 / 300) * waves @ rng.normal(size=(300, 3))
    if isinstance(data, Pose):
        poses = data.poses.copy()
        poses[:, :3, 3] += offsets
        data = data.replace(poses=poses)
    return calibrate(arm, data, SETS, extend="none")


def score_of(fit: Result) -> float:
    """Return the score of the correlation of the residuals of a fit."""
    return find_residual_correlation(fit.problem, fit.solution.x, fit.solution.system, 1.0, fit.weights)


def test_score_is_that_of_full_matrices():
    fit = fitted(0, 30, size=3e-4)
    root = fit.solution.system.sqrt_covariance(fit.problem.weights)[0]
    item = fit.problem.data[0]
    rows = fit.problem.linearize(fit.solution.x).rows(Chunk(item, fit.problem.errors.chain))
    # The rows of one sample after the other.
    flat = rows.transpose(2, 1, 0).reshape(-1, len(rows))
    jacobian, residual = flat[:, :-1], flat[:, -1]
    covariance = np.eye(len(flat)) - jacobian @ root @ root.T @ jacobian.T
    distances = np.linalg.norm(np.exp(1j * item.q)[:, None] - np.exp(1j * item.q), axis=2)
    expected = []
    for length in LENGTHS:
        similar = np.exp(-0.5 * (distances / length) ** 2)
        np.fill_diagonal(similar, 0.0)
        if np.sum(similar) ** 2 <= MIN_PAIRS * np.sum(similar**2):
            continue
        kernel = np.kron(similar, np.eye(6))
        product = kernel @ covariance
        excess, variance = (
            residual @ kernel @ residual - np.trace(product),
            2 * np.trace(product @ product),
        )
        expected.append(excess / np.sqrt(variance))
    assert score_of(fit) == pytest.approx(max(expected, key=abs))


@pytest.mark.parametrize("seeds", [15, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", [Pose, Position])
def test_independent_residuals_are_not_significant(kind, seeds):
    found = [score_of(fitted(seed, (20, 40, 80)[seed % 3], kind)) for seed in range(seeds)]
    assert np.abs(found).max() < MAX_WHITE_Z
    assert abs(np.mean(found)) < 1


@pytest.mark.parametrize("m", [40, 100])
def test_smooth_error_of_the_model_is_significant(m):
    for seed in range(4):
        assert abs(score_of(fitted(seed, m, size=3e-4))) > MAX_WHITE_Z


def test_neighbours_with_opposite_residuals_are_significant(monkeypatch):
    """Independent noise has equal signs as often as opposite ones."""
    rng = np.random.default_rng(0)
    truth, q = fitted(0, 40).chain, rng.uniform(-2.5, 2.5, (60, 6))
    q = np.concatenate([q, q + 0.02])
    poses, offsets = truth.poses(q).copy(), 1e-4 * rng.normal(size=(60, 3))
    poses[:, :3, 3] += np.concatenate([offsets, -offsets])
    fit = calibrate(truth, Pose(q, poses), SETS, extend="none")
    assert score_of(fit) < -MAX_WHITE_Z
    # The effect of the fit, which lowers the score, is left out for many samples.
    monkeypatch.setattr(residual_correlation, "MAX_PRODUCTS", 0)
    assert abs(score_of(fit)) < MAX_WHITE_Z


def test_samples_without_neighbours_have_no_correlation():
    fit = fitted(0, 12)
    problem = fit.problem.with_data([fit.problem.data[0].take(np.s_[:1])])
    assert find_residual_correlation(problem, fit.solution.x, fit.solution.system, 1.0, [np.ones(1)]) == 0.0


def test_design_effect_is_the_variance_of_a_mean_of_correlated_samples():
    """Kish's design effect: variance of the mean of N samples over that of N independent ones."""
    q = np.random.default_rng(0).uniform(-2.5, 2.5, (200, 6))
    distances = np.linalg.norm(np.exp(1j * q)[:, None] - np.exp(1j * q), axis=2)
    covariance = FAR_CORRELATION + NEAR_CORRELATION * np.exp(-0.5 * (distances / CORRELATION_LENGTH) ** 2)
    np.fill_diagonal(covariance, 1.0)
    expected = covariance.sum() / 200**2 / (1 / 200)
    assert design_effect(q, np.zeros(6, bool)) == pytest.approx(expected)


def test_configurations_in_a_small_part_of_joint_space_count_for_fewer():
    revolute = np.zeros(6, bool)
    q = np.random.default_rng(0).uniform(-2.5, 2.5, (400, 6))
    wide, narrow = design_effect(q, revolute), design_effect(0.1 * q, revolute)
    assert 1 < wide < 10
    assert 3 * wide < narrow < 1 + 400 * (FAR_CORRELATION + NEAR_CORRELATION)
    # Many configurations are thinned.
    many = np.random.default_rng(0).uniform(-2.5, 2.5, (6000, 6))
    part = design_effect(many[::3], revolute)
    assert design_effect(many, revolute) - 1 == pytest.approx(3 * (part - 1), rel=0.01)
    assert design_effect(q[:1], revolute) == 1
