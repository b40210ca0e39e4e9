"""Measurements of a part of the position: the verdict states the position errors that residuals do not show.

The true arms and their errors are those of `sessions`, without the model of the project.
"""

import re

import numpy as np
import pytest
from sessions import ANGLE_NOISE, NOISE, Simulation
from slow_cases import some_slow

from dhcal_pin import calibrate, read_robot, se3
from dhcal_pin.calibration.summary import sigma_notes
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import (
    Inclination,
    Noise,
    Pose,
    Position,
    PositionComponents,
    SphereContact,
)

REASON = "The measurements show only a part of the position: errors of positions of about"


def points(simulation, q):
    """Return the measured points of the true arm, with a level base."""
    return np.array([(pose * simulation.tool).translation for pose in simulation.poses(q)])


def heights(simulation):
    """Return heights by a gauge."""
    z = points(simulation, simulation.q)[:, 2]
    return [PositionComponents(simulation.q, z + simulation.rng.normal(0, NOISE, len(z)), (2,))]


def touches(simulation, n_spheres=1):
    """Return contacts with spheres, by Newton steps in joint space from random configurations."""
    rng, q, step = simulation.rng, simulation.q.copy(), 1e-5
    centres = points(simulation, simulation.test_q[:n_spheres])
    which = np.arange(len(q)) % n_spheres
    radius = 0.15 + rng.normal(0, NOISE, len(q))

    def height(q):
        return np.linalg.norm(points(simulation, q) - centres[which], axis=1) - radius

    for _ in range(30):
        now = height(q)
        slopes = np.stack([(height(q + step * axis) - now) / step for axis in np.eye(q.shape[1])], 1)
        moves = now[:, None] * slopes / np.maximum(np.sum(slopes**2, 1), 1e-3)[:, None]
        q -= np.clip(moves, -0.5, 0.5)
    touching = np.abs(height(q)) < 1e-7
    assert touching.mean() > 0.8
    return [
        SphereContact(q[touching & (which == i)], np.full(np.sum(touching & (which == i)), 0.15), name=str(i))
        for i in range(n_spheres)
    ]


def inclinations(simulation):
    """Return the directions of gravity in a sensor on the tip."""
    up = np.array([pose.rotation[2] for pose in simulation.poses(simulation.q)])
    up += simulation.rng.normal(0, ANGLE_NOISE, up.shape)
    return [Inclination.from_acceleration(simulation.q, up)]


@pytest.mark.parametrize("measure", [heights, touches])
def test_errors_of_positions_that_residuals_do_not_show_are_stated(measure):
    simulation = Simulation("ur10", 100, 0)
    fit = calibrate(simulation.chain, measure(simulation), extend="none", session="off")
    assert fit.verdict.status == "caution"
    (reason,) = fit.verdict.reasons
    assert reason.startswith(REASON)
    assert reason.endswith("Measure the position of the tool in a fixed frame, too.")
    stated = 1e-3 * float(re.findall(r"of about ([\d.]+) mm", reason)[0])
    (after,) = fit.comparisons[0].after.groups.values()
    assert stated > 2 * after.rms
    assert 1 / 3 < stated / true_error(simulation, fit) < 3


def true_error(simulation, fit):
    """Return the RMS position error in the measured region, with the best base and tool point [m]."""
    simulation.end_model, simulation.end_zeros = simulation.model, 0.0
    simulation.test_q = fit.measured_region.draw(np.random.default_rng(1), 200)
    return simulation.true_error(fit.chain)


@pytest.mark.parametrize("seed", some_slow(range(8), {0}))
def test_far_too_small_stated_deviations_of_rotations_are_named(seed):
    """Following the advice reduces the true error, and the caution ends."""
    simulation, noise = Simulation("ur10", 80, seed), np.deg2rad(0.1)
    poses = np.array([(pose * simulation.tool).homogeneous for pose in simulation.poses(simulation.q)])
    turns = simulation.rng.normal(0, noise, (80, 3))
    poses[:, :3, :3] = poses[:, :3, :3] @ se3.exp3(turns)
    poses[:, :3, 3] += simulation.rng.normal(0, NOISE, (80, 3))
    fits = [
        calibrate(simulation.chain, Pose(simulation.q, poses, *sigmas), extend="none", session="off")
        for sigmas in ((NOISE, 0.01 * noise), (None, None), (NOISE, noise))
    ]
    (reason,) = fits[0].verdict.reasons
    ratio = re.match(r"The orientation errors are (\d+) times as large as their stated standard dev", reason)
    assert ratio
    assert 70 < float(ratio[1]) < 140
    assert reason.endswith("Leave the sigma columns out, or correct them.")
    true = [true_error(simulation, fit) for fit in fits]
    assert [fit.verdict.status for fit in fits] == ["caution", "ok", "ok"]
    assert max(true[1:]) < true[0] / 3


@pytest.mark.parametrize("seed", some_slow(range(8), {0}))
def test_far_too_large_stated_deviations_are_named(seed):
    """The measurements count too little beside the priors: following the advice reduces the true error."""
    simulation = Simulation("ur10", 80, seed)
    positions = points(simulation, simulation.q) + simulation.rng.normal(0, NOISE, (80, 3))
    fits = [
        calibrate(simulation.chain, Position(simulation.q, positions, sigma), extend="none", session="off")
        for sigma in (30 * NOISE, None, 2 * NOISE)
    ]
    notes = [sigma_notes(fit) for fit in fits]
    assert [len(each) for each in notes] == [1, 0, 0]
    assert notes[0][0].endswith("Leave the sigma columns out, or correct them.")
    found = re.search(r"deviations are (\d+) times as large as the position errors", notes[0][0])
    # The fit leaves more than the noise, as the priors hold it back.
    assert found
    assert 7 <= float(found[1]) <= 30
    true = [true_error(simulation, fit) for fit in fits]
    assert true[1] < 0.3 * true[0]


@pytest.mark.slow
@pytest.mark.parametrize("measure", [heights, touches])
def test_predicted_errors_are_those_of_many_arms(measure):
    """No position error is far above the residual without a caution."""
    ratios = []
    for seed in range(24):
        simulation = Simulation("ur10", 100, seed)
        fit = calibrate(simulation.chain, measure(simulation), extend="none", session="off")
        true = true_error(simulation, fit)
        ratios.append(fit.position_std / true)
        (after,) = fit.comparisons[0].after.groups.values()
        assert fit.verdict.status == "caution" or true < 2.5 * after.rms
    assert 0.5 < np.median(ratios) < 2.0


@pytest.mark.parametrize("arm", some_slow(["ur10", "panda"], {0}))
def test_predicted_errors_contain_those_that_the_minimal_set_leaves_out(arm):
    """The set `placement` has all errors of the joint origins."""
    found = []
    for parameters in ("minimal,base,tool", "placement,base,tool"):
        simulation = Simulation(arm, 100, 0)
        fit = calibrate(simulation.chain, inclinations(simulation), parameters, extend="none", session="off")
        found.append(fit.position_std)
    assert found[0] == pytest.approx(found[1], rel=0.01)


@pytest.mark.parametrize("seed", some_slow(range(4), {0}))
def test_poses_of_an_arm_with_correction_curves_show_the_whole_position(seed):
    """Beyond the measured ranges of the joints, curves are unknown, whatever is measured."""
    chain, rng = read_robot("example:ur10", "tool0"), np.random.default_rng(seed)
    errors = select_parameters(chain, "minimal,base,tool,harmonics,compliance,curves")
    x = rng.standard_normal(len(errors.parameters)) * np.minimum(errors.priors, 0.1)
    q, test_q = (rng.uniform(-2.5, 2.5, (m, 6)) for m in (400, 1000))
    truth = errors.at(x).with_current_loads()
    fit = calibrate(chain, Pose.simulate(truth, q, Noise(5e-5, 1e-4), rng), session="off")
    assert fit.extension
    assert "curves" in fit.extension.families
    assert (fit.verdict.status, fit.verdict.reasons) == ("ok", ())
    true = truth.poses(test_q)[:, :3, 3] - fit.chain.poses(test_q)[:, :3, 3]
    assert 0.5 < fit.position_std / np.sqrt(np.mean(np.sum(true**2, 1))) < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("arm", ["ur10", "panda"])
def test_predicted_errors_of_inclinations_are_those_of_many_arms(arm):
    errors = []
    for seed in range(16):
        simulation = Simulation(arm, 100, seed)
        fit = calibrate(simulation.chain, inclinations(simulation), extend="none", session="off")
        errors.append((fit.position_std, true_error(simulation, fit)))
    predicted, true = np.sqrt(np.mean(np.square(errors), 0))
    assert 0.8 < predicted / true < 1.25


SETUPS = {
    "few positions": (25, 2.8, lambda s: [s.measure(Position)]),
    "local positions": (60, 0.2, lambda s: [s.measure(Position)]),
    "local poses": (40, 0.3, lambda s: [s.measure(Pose)]),
    "wires": (60, 2.8, lambda s: [s.measure_wires()]),
    "targets": (30, 2.8, lambda s: [s.measure_targets()]),
    "spheres": (400, 2.8, lambda s: touches(s, 4)),
    "heights with positions": (150, 2.8, lambda s: [*heights(s), *some_positions(s)]),
}


def some_positions(simulation):
    """Return positions at a fifth of the configurations, in the frame of the heights."""
    q = simulation.q[::5]
    return [Position(q, points(simulation, q) + simulation.rng.normal(0, NOISE, (len(q), 3)))]


@pytest.mark.parametrize("name", some_slow(list(SETUPS), {1}))
def test_measurements_that_determine_positions_are_ok(name):
    count, half, measure = SETUPS[name]
    for seed in range(3):
        simulation = Simulation("ur10", count, seed)
        if half < 1:
            simulation.q = [0.3, -1.2, 1.3, -0.5, 0.6, 0.2] + half * simulation.rng.uniform(-1, 1, (count, 6))
        fit = calibrate(simulation.chain, measure(simulation), extend="none", session="off")
        assert not fit.verdict.reasons
