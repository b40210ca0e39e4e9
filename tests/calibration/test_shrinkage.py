"""Shrinkage: too few measurements do not make a robot worse than nominal."""

from __future__ import annotations

import numpy as np
import pytest
from robots import joint_sample, measured_arm

from dhcal_pin.calibration import calibrate
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Noise, Pose, Position
from dhcal_pin.robot import Chain

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


def two_poses(chain: Chain, rng: np.random.Generator):
    return joint_sample(chain, 2, rng)


def four_poses(chain: Chain, rng: np.random.Generator):
    return joint_sample(chain, 4, rng)


def one_corner(chain: Chain, rng: np.random.Generator):
    return joint_sample(chain, 1, rng) + rng.uniform(-0.2, 0.2, (30, chain.n_joints))


POOR = pytest.mark.parametrize(
    ("name", "sets", "kind", "poses"),
    [
        ("paper", "dh", Pose, two_poses),
        ("paper", "minimal", Pose, two_poses),
        ("paper", "dh", Position, two_poses),
        ("ur5", "minimal", Pose, two_poses),
        ("panda", "minimal", Position, two_poses),
        ("slide", "dh", Position, two_poses),
        ("ur5", "minimal,base,tool", Pose, two_poses),
        ("ur5", "minimal,base,tool", Pose, four_poses),
        ("panda", "minimal,base,tool", Position, four_poses),
        ("paper", "dh", Pose, one_corner),
        ("paper", "minimal", Pose, one_corner),
    ],
)


@POOR
def test_few_measurements_do_no_harm(name, sets, kind, poses):
    assert count_worse_than_nominal(name, sets, kind, poses, range(8)) == 0


@pytest.mark.slow
@POOR
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
