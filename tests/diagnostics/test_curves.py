"""Joint correction curves against the robot that they belong to, and their bands against known truths."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from robots import paper

from dhcal_pin.calibration import Result, calibrate
from dhcal_pin.calibration.presentation.curves import CURVE_VALUES
from dhcal_pin.diagnostics import find_lattices, fitted_coverage, joint_curves
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.robot import Chain, Conditions

SETS = "minimal,base,tool,harmonics,curves"
NOISE = Noise(2e-5, 2e-5)


@lru_cache(1)
def simulated(seed: int, count: int = 120) -> tuple[Chain, Result]:
    """Return a robot with random curves, and its calibration from poses in three quarters of each turn."""
    rng, chain = np.random.default_rng(seed), Chain.from_dh(paper("sim_6dof"))
    errors = select_parameters(chain, SETS)
    truth = errors.at(
        np.where(errors.is_of_arm, errors.priors, 0.0) * rng.standard_normal(len(errors.priors))
    )
    q = rng.uniform(-np.pi, np.pi / 2, (count, 6))
    data = Pose.simulate(truth, q, NOISE, rng)
    return truth, calibrate(chain, data, SETS, extend="none", session="off")


@pytest.fixture(scope="module")
def example() -> tuple[Chain, Result]:
    return simulated(0)


def joint_error(chain: Chain, joint: int, values: np.ndarray) -> np.ndarray:
    """Return actual minus commanded values of one joint, the others at zero."""
    q = np.zeros((chain.n_joints, len(values)))
    q[joint] = values
    return chain.actual_positions(Conditions(q.T))[0][joint] - values


def test_correction_is_what_the_calibrated_joint_misses(example):
    _, fit = example
    curves = joint_curves(fit)
    assert [curve.coverage.joint for curve in curves] == list(fit.chain.joint_names)
    for joint, curve in enumerate(curves):
        error = joint_error(fit.chain, joint, curve.values)
        assert np.ptp(curve.correction) > 1e-4
        np.testing.assert_allclose(curve.correction, -error, atol=1e-12)


def test_standard_deviation_is_that_of_the_covariance(example):
    _, fit = example
    names = [parameter.name for parameter in fit.parameters]
    curve = joint_curves(fit)[2]
    columns, terms = [], []
    for order in range(1, 33):
        for name, function in (("sin", np.sin), ("cos", np.cos)):
            columns.append(names.index(f"{curve.coverage.joint}.{name}{order}"))
            terms.append(function(order * curve.values))
    covariance = fit.covariance[np.ix_(columns, columns)]
    expected = np.sqrt(np.einsum("av,ab,bv->v", terms, covariance, terms))
    np.testing.assert_allclose(curve.std, expected, rtol=1e-7)
    assert np.median(curve.std[curve.is_measured]) < 0.5 * np.median(curve.std[~curve.is_measured])
    assert not curve.is_measured[np.abs(curve.values - np.deg2rad(135)) < np.deg2rad(42)].any()


def covered_shares(seeds: range) -> np.ndarray:
    """Return the shares of measured and of other joint values at which the band contains the true curve."""
    inside: list[list[np.ndarray]] = [[], []]
    for seed in seeds:
        truth, fit = simulated(seed)
        for joint, curve in enumerate(joint_curves(fit)):
            wrong = curve.correction + joint_error(truth, joint, curve.values)
            contains = np.abs(wrong) < 1.96 * curve.std
            inside[0].append(contains[curve.is_measured])
            inside[1].append(contains[~curve.is_measured])
    return np.array([np.mean(np.concatenate(part)) for part in inside])


def test_band_contains_the_true_curve():
    assert np.all(np.abs(covered_shares(range(2)) - 0.95) < 0.04)


@pytest.mark.slow
def test_bands_contain_the_true_curves_at_95_percent():
    assert np.all(np.abs(covered_shares(range(20)) - 0.95) < 0.02)


def test_limits_bound_the_curve(example):
    _, fit = example
    lower, upper = np.full(6, -1.0), np.full(6, 0.5)
    limited = replace(fit, chain=replace(fit.chain, lower=lower, upper=upper))
    for curve in joint_curves(limited):
        assert -1.05 < curve.values[0] < -0.95
        assert 0.45 < curve.values[-1] < 0.55
        assert len(curve.values) < len(CURVE_VALUES) / 4


def test_without_harmonics_there_is_only_the_coverage(example):
    truth, fit = example
    plain = calibrate(Chain.from_dh(paper("sim_6dof")), fit.data, "minimal,base,tool", extend="none")
    assert joint_curves(plain) == []
    coverage = fitted_coverage(plain)
    assert [one.joint for one in coverage] == list(truth.joint_names)
    assert all(44 <= one.n_visited <= 55 for one in coverage)


def test_lattices_are_found_where_curves_are_estimated():
    rng, chain = np.random.default_rng(0), Chain.from_dh(paper("sim_6dof"))
    q = rng.uniform(-np.pi, np.pi, (100, 6))
    q[:, 3] = np.deg2rad(30 * rng.integers(-5, 6, 100))
    data = Pose.simulate(chain, q, NOISE, rng)
    (text,) = find_lattices(calibrate(chain, data, SETS, extend="none"))
    assert f"the values of {chain.joint_names[3]} form a lattice, 11 different ones in 100" in text
    assert find_lattices(calibrate(chain, data, "minimal,base,tool,harmonics", extend="none")) == []
