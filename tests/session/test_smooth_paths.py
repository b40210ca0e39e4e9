"""Sessions along smooth paths: errors that the model of an arm does not contain are no change over time."""

import re

import numpy as np
import pinocchio as pin
import pytest
from robots import robot_file, with_small_errors
from slow_cases import some_slow

from dhcal_pin import calibrate, se3
from dhcal_pin.measurements import Position
from dhcal_pin.robot import Chain
from dhcal_pin.robot.urdf import parse_urdf

NOISE = 5e-5
N_SAMPLES = 120
# Periods of the joints during the session.
PERIODS = np.array([1.0, 1.7, 2.3, 3.1, 2.9, 4.3])
# Largest compliance of the joints [rad/(N·m)]: 1 to 3 mm at the tool.
COMPLIANCE = {"ur5": 5e-5, "ur10": 3e-5}


class ElasticArm:
    """Arm whose joints yield to gravity, and a smooth path through most of its joint space."""

    def __init__(self, name: str, seed: int, is_rigid: bool = False):
        rng = np.random.default_rng(seed)
        text = robot_file(f"ur_description/urdf/{name}_robot.urdf").read_text()
        self.model = pin.buildModelFromXML(text)
        without_masses = re.sub(r"<inertial>.*?</inertial>", "", text, flags=re.DOTALL)
        self.nominal = Chain.from_urdf(parse_urdf(without_masses.encode(), name), "tool0")
        self.true = with_small_errors(self.nominal, rng, 5e-4)
        self.compliance = (not is_rigid) * COMPLIANCE[name] * rng.uniform(0.3, 1.0, 6)
        self.rng = rng
        self.phase = rng.uniform(0, 2 * np.pi, 6)
        self.centre = rng.uniform(-1.5, 1.5, 6)

    def path(self, times: np.ndarray) -> np.ndarray:
        """Return the joint positions (m, 6) [rad] at times from 0 to 1."""
        return 2.6 * np.sin(2 * np.pi * PERIODS * times[:, None] + self.phase)

    def short_path(self, times: np.ndarray) -> np.ndarray:
        """Return the same of a path through a part of joint space."""
        return self.centre + 0.8 * np.sin(2 * np.pi * PERIODS * times[:, None] + self.phase)

    def poses(self, q: np.ndarray) -> np.ndarray:
        """Return the true poses of the tool (m, 4, 4) [m]."""
        data = self.model.createData()
        torques = [pin.computeGeneralizedGravity(self.model, data, row).copy() for row in q]
        poses = self.true.poses(q - self.compliance * np.array(torques))
        return poses @ se3.exp6(np.array([0.06, 0.03, 0.08, 0, 0, 0]))

    def measure(self, q: np.ndarray, poses: np.ndarray) -> Position:
        """Measure the tool with noise."""
        return Position(q, poses[:, :3, 3] + NOISE * self.rng.standard_normal((len(q), 3)))


CASES = [(name, seed) for seed in range(20) for name in ("ur5", "ur10")]


@pytest.mark.parametrize(("name", "seed"), some_slow(CASES, {1}))
def test_nothing_changes_along_a_smooth_path(name, seed):
    arm = ElasticArm(name, seed)
    times = np.linspace(0, 1, N_SAMPLES)
    q, between = arm.path(times), arm.path((times[1:] + times[:-1]) / 2)
    fit = calibrate(arm.nominal, arm.measure(q, arm.poses(q)))
    assert fit.session is not None
    assert (fit.session.events, fit.session.drifts) == ((), ())
    true_error = np.linalg.norm(fit.chain.poses(between)[:, :3, 3] - arm.poses(between)[:, :3, 3], axis=1)
    assert fit.random_folds
    stated = fit.random_folds.comparison.after.groups["position"].rms
    assert np.sqrt(np.mean(true_error**2)) < 1.5 * stated


def find_changes(name, seed, change):
    """Return the kinds of changes that are found if one changed in the middle of the session."""
    arm = ElasticArm(name, seed)
    q = arm.path(np.linspace(0, 1, N_SAMPLES))
    is_after = np.arange(N_SAMPLES) >= N_SAMPLES // 2
    poses = arm.poses(q + (change == "joint") * is_after[:, None] * 5e-3 * np.eye(6)[2])
    if change == "base":
        poses[is_after, :3, 3] += [1e-3, 1e-3, 5e-4]
    elif change == "tool":
        poses[is_after] = poses[is_after] @ se3.exp6(np.array([2e-3, -2e-3, 1e-3, 0, 0, 0]))
    fit = calibrate(arm.nominal, arm.measure(q, poses))
    assert fit.session is not None
    return [each.kind for each in (*fit.session.events, *fit.session.drifts)]


@pytest.mark.parametrize(
    ("name", "seed", "change"), [("ur5", 1, "tool"), ("ur10", 2, "base"), ("ur5", 2, "joint")]
)
def test_a_change_is_found_along_a_smooth_path(name, seed, change):
    assert find_changes(name, seed, change) == [change]


@pytest.mark.slow
def test_most_changes_are_found_along_smooth_paths():
    cases = [(*case, change) for case in CASES[:12] for change in ("base", "tool", "joint")]
    found = [find_changes(*case) == [case[2]] for case in cases]
    # Some arms bend by more than the change.
    assert np.mean(found) >= 0.75


@pytest.mark.parametrize("seed", some_slow(range(8), {0}))
def test_no_joint_errors_explain_what_the_reflector_did_along_a_short_path(seed):
    """The tool moves by 0.54 mm; harmonics and coupling of the joints explain most of it, too."""
    arm = ElasticArm("ur10", seed, is_rigid=True)
    q = arm.short_path(np.linspace(0, 1, 100))
    poses = arm.poses(q)
    poses[50:] = poses[50:] @ se3.exp6(np.array([4e-4, -3e-4, 2e-4, 0, 0, 0]))
    fit = calibrate(arm.nominal, arm.measure(q, poses))
    assert fit.session
    assert not fit.session.drifts
    (event,) = fit.session.events
    assert (event.kind, event.size) == ("tool", pytest.approx(5.4e-4, rel=0.2))
    assert fit.extension is None or not fit.extension.families


@pytest.mark.parametrize("seed", some_slow(range(8), {3}))
def test_a_lag_is_exact_beside_joint_errors_that_explain_a_part_of_it(seed):
    arm = ElasticArm("ur10", seed, is_rigid=True)
    times = np.linspace(0, 1, 100)
    q = arm.path(times)
    fit = calibrate(arm.nominal, arm.measure(q, arm.poses(arm.path(times + 1 / 3 / 99))))
    assert fit.session
    assert fit.session.lag
    assert fit.session.lag.value == pytest.approx(1 / 3, abs=1e-3)
    assert fit.extension is None or not fit.extension.families
