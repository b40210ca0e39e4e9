"""Shrinkage: too few measurements do not make a robot worse than nominal."""

import itertools

import numpy as np
import pytest
from robots import joint_sample, measured_arm
from scipy.stats import norm
from slow_cases import some_slow

from dhcal_pin.calibration import accuracy, calibrate, procedure
from dhcal_pin.calibration.shrinkage import compute_shrinkage_factor
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Noise, Pose, Position
from dhcal_pin.robot import Chain
from dhcal_pin.robot.sampling import joint_range

# Calibrations of arms with large errors, of which nothing asks for mistakes.
pytestmark = pytest.mark.usefixtures("unsuspected")

# Standard deviations of the simulated noise [m], [rad].
POSITION_STD, ROTATION_STD = 1e-4, np.deg2rad(0.01)


def count_worse_than_nominal(name: str, sets: str, kind, poses, seeds) -> int:
    """Count the robots whose tool error is larger after the calibration than before, over the joint range.

    Unknown base and tool frames are fitted to the nominal robot before the comparison.
    """
    nominal, worse = measured_arm(name), 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        errors = select_parameters(nominal, sets)
        size = np.array([np.deg2rad(2.0) if p.unit == "rad" else 1e-2 for p in errors.parameters])
        size = size if seed % 2 else size / 10
        truth = errors.at(size * rng.uniform(-1, 1, len(size)))
        data = kind.simulate(truth, poses(nominal, rng), Noise(POSITION_STD, ROTATION_STD), rng)
        fit = calibrate(nominal, data, sets)
        q = joint_sample(nominal, 100, rng)
        wanted = truth.poses(q)[:, :3, 3]
        before, after = (
            np.mean(np.sum((chain.poses(q)[:, :3, 3] - wanted) ** 2, 1))
            for chain in (fit.nominal_refitted, fit.chain)
        )
        worse += after > before
        assert bool(fit.shrinkage_notes) == (fit.shrinkage_factor < 1)
    return worse


def test_gear_ratios_alone_are_shrunk():
    """No unknown is of the geometry."""
    arm, rng = measured_arm("ur10"), np.random.default_rng(0)
    errors = select_parameters(arm, "gain")
    truth = errors.at(np.full(6, 1e-3))
    data = Position.simulate(truth, rng.uniform(-2, 2, (1, 6)), Noise(POSITION_STD), rng)
    fit = calibrate(arm, data, "gain")
    assert 0 <= fit.shrinkage_factor <= 1
    assert fit.validate(data)["position_rms_m"] <= accuracy(arm, [data])["position_rms_m"]


def factor_by_definition(problem, solution, groups) -> float:
    """The largest factor with at most 0.2 % harm, from posteriors of the errors instead of their effects.

    Only for robots whose base and tool are known: nothing has to be eliminated.
    """
    errors, x, r = problem.errors, solution.x, solution.system.r
    measured = solution.system.z + r @ x
    # Derivatives of the tool position by differences, at the documented configurations.
    chain = errors.chain
    q = np.random.default_rng(0).uniform(*joint_range(chain), (32, chain.n_joints))
    step = 1e-6 * np.eye(len(x))
    jacobian = np.stack(
        [(errors.at(x + h).poses(q) - errors.at(x - h).poses(q))[:, :3, 3].ravel() / 2e-6 for h in step], 1
    )
    change = jacobian @ x
    effect = jacobian.T @ change
    widths = 2.0 ** np.arange(-4, 5)
    log_weights, means, stds = [], [], []
    for combination in itertools.product(widths, repeat=len(groups)):
        std = 1 / problem.weights
        for width, group in zip(combination, groups, strict=True):
            std[group.members] = width / group.expected_weight
        covariance = r @ np.diag(std**2) @ r.T + np.eye(len(r))
        # Logarithm of the normal density, up to a constant.
        evidence = -0.5 * np.linalg.slogdet(covariance)[1]
        evidence -= 0.5 * measured @ np.linalg.solve(covariance, measured)
        # ln w has the standard deviation 1.5, and the grid is even in it.
        log_weights.append(evidence + norm.logpdf(np.log(combination), 0, 1.5).sum())
        posterior = np.linalg.inv(r.T @ r + np.diag(std**-2))
        means.append(effect @ posterior @ r.T @ measured)
        stds.append(np.sqrt(effect @ posterior @ effect))
    weights = np.exp(np.array(log_weights) - max(log_weights))
    weights /= weights.sum()
    safe = [
        c
        for c in np.linspace(0, 1, 101)
        if norm.cdf((0.5 * c * change @ change - means) / np.array(stds)) @ weights <= 0.002
    ]
    return max(safe, default=0.0)


@pytest.mark.parametrize(("n", "n_partial"), some_slow([(12, 2), (24, 3)], {0}))
def test_the_factor_follows_from_its_definition(monkeypatch, n, n_partial):
    calls = []

    def record(*args):
        calls.append(args)
        return compute_shrinkage_factor(*args)

    monkeypatch.setattr(procedure, "compute_shrinkage_factor", record)
    nominal, found = measured_arm("paper"), []
    for seed in range(n):
        rng = np.random.default_rng(seed)
        errors = select_parameters(nominal, "dh")
        size = np.array([np.deg2rad(1.0) if p.unit == "rad" else 5e-3 for p in errors.parameters])
        truth = errors.at((0.1, 1.0, 3.0)[seed % 3] * size * rng.uniform(-1, 1, len(size)))
        noise = Noise(2e-3, 2e-2) if seed % 2 else Noise(POSITION_STD, ROTATION_STD)
        data = Position.simulate(truth, joint_sample(nominal, 2 + seed % 5, rng), noise, rng)
        fit = calibrate(nominal, data, "dh", extend="none", session="off")
        found.append((fit.shrinkage_factor, factor_by_definition(*calls[-1])))
    assert len(calls) == n
    for factor, expected in found:
        assert factor == pytest.approx(expected, abs=0.011)
    # Some corrections are applied in part.
    assert sum(0.05 < factor < 0.95 for factor, _ in found) >= n_partial


def two_poses(chain: Chain, rng: np.random.Generator):
    return joint_sample(chain, 2, rng)


def four_poses(chain: Chain, rng: np.random.Generator):
    return joint_sample(chain, 4, rng)


def one_corner(chain: Chain, rng: np.random.Generator):
    return joint_sample(chain, 1, rng) + rng.uniform(-0.2, 0.2, (30, chain.n_joints))


CASES = [
    ("paper", "dh", Pose, two_poses),
    ("paper", "minimal", Pose, two_poses),
    ("paper", "dh", Position, two_poses),
    ("ur5", "minimal", Pose, two_poses),
    ("panda", "minimal", Position, two_poses),
    ("slide", "dh", Position, two_poses),
    ("ur5", "minimal,base,tool", Pose, two_poses),
    ("ur5", "minimal,base,tool", Pose, four_poses),
    ("panda", "minimal,base,tool", Position, four_poses),
    ("paper", "minimal", Pose, one_corner),
    ("paper", "dh", Pose, one_corner),
]
NAMES = ("name", "sets", "kind", "poses")


@pytest.mark.parametrize(NAMES, some_slow(CASES, range(10)))
def test_few_measurements_do_no_harm(name, sets, kind, poses):
    assert count_worse_than_nominal(name, sets, kind, poses, range(2)) == 0


@pytest.mark.slow
@pytest.mark.parametrize(NAMES, CASES)
def test_few_measurements_do_no_harm_in_200_trials(name, sets, kind, poses):
    assert count_worse_than_nominal(name, sets, kind, poses, range(200)) <= 2


def test_enough_measurements_need_no_shrinkage():
    nominal = measured_arm("ur5")
    errors, rng = select_parameters(nominal, "minimal,base,tool"), np.random.default_rng(0)
    truth = errors.at(1e-3 * rng.standard_normal(len(errors.parameters)))
    data = Pose.simulate(truth, joint_sample(nominal, 12, rng), Noise(POSITION_STD, ROTATION_STD), rng)
    fit = calibrate(nominal, data)
    assert fit.shrinkage_factor == 1
    assert fit.shrinkage_notes == []
