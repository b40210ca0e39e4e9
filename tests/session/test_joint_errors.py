"""Sessions of an arm with gear errors and elastic joints: changes are found, and none are invented."""

from itertools import product

import numpy as np
import pytest
from robots import nominal_arm
from slow_cases import some_slow

from dhcal_pin import calibrate, se3
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Pose, Position
from dhcal_pin.robot import Conditions

SETS = "minimal,base,tool,harmonics,compliance"
NOISE, ANGLE_NOISE = 5e-5, 1e-4
# Standard deviations of harmonics [rad], compliance [rad/(N·m)], lengths [m] and angles [rad].
HARMONIC, COMPLIANCE, LENGTH, ANGLE = 3e-4, 1e-5, 5e-4, 1e-3


def arm_with_joint_errors(rng):
    """Return a nominal UR10 and a true one."""
    chain = nominal_arm("ur10")
    errors = select_parameters(chain, SETS)
    sizes = [
        COMPLIANCE if "compliance" in p.name
        else HARMONIC if ".sin" in p.name or ".cos" in p.name
        else LENGTH if p.unit == "m" else ANGLE
        for p in errors.parameters
    ]  # fmt: skip
    return chain, errors.at(sizes * rng.standard_normal(len(sizes))).with_current_loads()


def measured(kind, q, poses, rng):
    """Return measurements of poses with noise."""
    poses = poses.copy()
    poses[:, :3, 3] += NOISE * rng.standard_normal((len(q), 3))
    if kind is Position:
        return Position(q, poses[:, :3, 3], NOISE)
    turns = se3.exp3(ANGLE_NOISE * rng.standard_normal((len(q), 3)))
    poses[:, :3, :3] = turns @ poses[:, :3, :3]
    return Pose(q, poses, NOISE, ANGLE_NOISE)


def rms_error(chain, truth, q):
    """Return the RMS distance of the tool from the true one [m]."""
    difference = chain.poses(q)[:, :3, 3] - truth.poses(q)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(difference**2, 1))))


@pytest.mark.parametrize(
    ("kind", "seed", "drift"),
    some_slow([(k, s, d) for d in (1e-3, 4e-4) for k in (Pose, Position) for s in range(4)], {0}),
)
def test_a_slow_motion_of_the_base_is_found_beside_joint_errors(kind, seed, drift):
    """The result is the arm at the end. Any fixed base leaves 0.3 times the drift."""
    rng = np.random.default_rng(seed)
    chain, truth = arm_with_joint_errors(rng)
    q, test_q = (rng.uniform(-1.9, 1.9, (m, 6)) for m in (150, 300))
    poses = truth.poses(q)
    poses[:, 2, 3] += drift * np.linspace(1, 0, len(q))
    fit = calibrate(chain, measured(kind, q, poses, rng))
    assert fit.session
    (found,) = fit.session.drifts
    assert (found.kind, found.size) == ("base", pytest.approx(drift, rel=0.15))
    assert fit.verdict.status == "caution"
    assert rms_error(fit.chain, truth, test_q) < 6e-5


def test_repeated_configurations_are_searched_without_joint_errors_if_they_are_too_few():
    """Thirty configurations, three times each; the base moves before the second half."""
    rng = np.random.default_rng(0)
    chain, truth = arm_with_joint_errors(rng)
    q = np.repeat(rng.uniform(-1.9, 1.9, (30, 6)), 3, 0)
    poses = truth.poses(q)
    poses[:45, :3, 3] += [1e-3, 0, 5e-4]
    fit = calibrate(chain, measured(Position, q, poses, rng))
    assert fit.session
    (found,) = fit.session.events
    assert found.kind == "base"


@pytest.mark.parametrize(
    ("kind", "seed"), some_slow([(kind, seed) for kind in (Position, Pose) for seed in range(6)], {0})
)
def test_groups_of_neighbouring_configurations_show_no_scale_and_no_change(kind, seed):
    """Ten groups, in mixed order for positions and one after the other for poses."""
    rng = np.random.default_rng(seed)
    chain, truth = arm_with_joint_errors(rng)
    centres = rng.uniform(-1.9, 1.9, (10, 1, 6))
    q = (centres + 0.02 * rng.standard_normal((10, 10, 6))).reshape(-1, 6)
    q = q[rng.permutation(100)] if kind is Position else q
    fit = calibrate(chain, measured(kind, q, truth.poses(q), rng))
    assert fit.session
    assert (fit.session.events, fit.session.drifts, fit.session.scales) == ((), (), ())
    assert rms_error(fit.chain, truth, q) < 6e-5


@pytest.mark.parametrize(
    ("kind", "seed"), some_slow([(kind, seed) for kind in (Position, Pose) for seed in range(6)], {0})
)
def test_two_values_per_joint_do_not_determine_joint_errors_and_random_configurations_do(kind, seed):
    rng = np.random.default_rng(seed)
    chain, truth = arm_with_joint_errors(rng)
    lattice = np.array(list(product((-1.2, 1.0), repeat=6))) + rng.uniform(-0.3, 0.3, 6)
    fits = []
    for q in (lattice, np.concatenate([lattice, rng.uniform(-1.5, 1.3, (10, 6))])):
        fits.append(calibrate(chain, measured(kind, q, truth.poses(q), np.random.default_rng(seed))))
        reason = "The measured configurations do not determine the errors between them"
        statement = next((each for each in fits[-1].verdict.reasons if reason in each), "")
        assert (fits[-1].verdict.status == "caution") == bool(statement)
    region = fits[0].measured_region
    test_q = np.clip(region.draw(rng, 300), region.lower, region.upper)
    errors = [rms_error(fit.chain, truth, test_q) for fit in fits]
    if fits[0].verdict.status == "caution":
        assert 1 / 3 < fits[0].position_std / errors[0] < 3
    # The advice of the first one was followed.
    assert errors[1] < 0.5 * errors[0]
    assert fits[1].verdict.status == "ok"


@pytest.mark.parametrize("seed", some_slow(list(range(24)), {0}))
def test_backlash_is_no_lag(seed):
    """The directions of approach are not stated; those of the path from row to row are the true ones."""
    rng = np.random.default_rng(seed)
    chain = nominal_arm("ur5")
    errors = select_parameters(chain, "minimal,base,tool,backlash")
    sizes = [3e-3 if "backlash" in p.name else LENGTH if p.unit == "m" else ANGLE for p in errors.parameters]
    truth = errors.at(np.abs(sizes) * rng.uniform(0.3, 1, len(sizes)))
    q = rng.uniform(-1.9, 1.9, (150, 6))
    directions = np.sign(np.diff(q, axis=0, prepend=q[:1] - 1))
    poses = truth.poses(Conditions(q, approach=directions))
    fit = calibrate(chain, measured(Position, q, poses, rng))
    assert fit.session
    assert fit.session.lag is None
