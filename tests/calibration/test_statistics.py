"""What a result claims of itself, against the truth of many simulated robots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from robots import paper, robot_file

from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.estimation.problem import Problem, linearize_and_factor
from dhcal_pin.estimation.qr import posterior_sqrt_covariance
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.measurements.position import Position
from dhcal_pin.robot.chain import Chain
from dhcal_pin.robot.dh import DHTable

POSITION, ROTATION = 1e-4, np.deg2rad(0.01)


def arm(name: str) -> Chain:
    if name == "paper":
        return Chain.from_dh(paper("sim_6dof"))
    if name == "slide":
        zero, free = np.zeros(5), np.full(5, np.inf)
        return Chain.from_dh(
            DHTable(
                "standard",
                ("j1", "j2", "j3", "j4", "j5"),
                np.array([False, False, True, False, False]),
                np.array([0, 0, np.pi / 2, 0, 0]),
                np.array([0.4, 0.1, 0.5, 0.2, 0.1]),
                np.array([0.1, 0.3, 0, 0.05, 0]),
                np.array([np.pi / 2, np.pi / 2, 0.3, -np.pi / 2, 0]),
                zero,
                -free,
                free,
            )
        )
    files = {"ur5": ("ur_description/urdf/ur5_robot.urdf", "tool0"),
             "panda": ("panda_description/urdf/panda.urdf", "panda_link8")}  # fmt: skip
    path, tip = files[name]
    return Chain.from_urdf(robot_file(path), tip)


def drawn(chain: Chain, m: int, rng: np.random.Generator):
    low = np.where(chain.prismatic, -0.4, np.fmax(chain.lower, -np.pi))
    high = np.where(chain.prismatic, 0.4, np.fmin(chain.upper, np.pi))
    return rng.uniform(low, high, (m, chain.n_joints))


@dataclass
class Tally:
    """Sums over the trials of one arm."""

    inside: int = 0
    count: int = 0
    squares: float = 0.0
    bound: float = 0.0
    claimed: float = 0.0


def trial(nominal: Chain, seed: int, tally: Tally):
    """One robot with errors up to 2° and 10 mm everywhere, 10 to 100 poses, fitted and judged elsewhere."""
    rng = np.random.default_rng(seed)
    errors = select_parameters(nominal, "minimal,base,tool")
    size = np.array([np.deg2rad(2.0) if p.unit == "rad" else 1e-2 for p in errors.parameters])
    x = size * rng.uniform(-1, 1, len(size))
    truth = errors.at(x)
    data = Pose.simulate(
        truth, drawn(nominal, int(rng.integers(10, 101)), rng), Noise(POSITION, ROTATION), rng
    )
    fit = calibrate(nominal, data, "minimal,base,tool")
    assert fit.converged, seed

    # At the truth, the lowest cost and the least variance that any unbiased estimate can have.
    problem = Problem(errors, (data,), np.zeros(len(x)))
    triangle = linearize_and_factor(problem, x, small_angle=False)
    at_truth = triangle.min_cost + triangle.z @ triangle.z
    found = data.residual(fit.chain.forward_kinematics(data.q), np.empty(0))
    assert np.sum(found**2) < at_truth, seed

    links = [
        i for i, p in enumerate(errors.parameters) if "." in p.name and p.name[:4] not in ("base", "tool")
    ]
    scores = (fit.x - x)[links] / fit.std[links]
    tally.inside += int(np.sum(np.abs(scores) < 1.959964))
    tally.count += len(links)

    q = drawn(nominal, 50, rng)
    miss = fit.chain.poses(q)[:, :3, 3] - truth.poses(q)[:, :3, 3]
    chain, bodies, twists = errors.derivative(x)
    velocities = chain.tool_jacobian(chain.forward_kinematics(q), bodies, twists)[:, :3]
    root = posterior_sqrt_covariance(triangle, problem.weights)[0]
    tally.squares += np.mean(np.sum(miss**2, 1))
    tally.bound += np.mean(np.sum(np.einsum("pim,pr->mir", velocities, root) ** 2, (1, 2)))
    tally.claimed += np.mean(fit.predict(q).position_std ** 2)


def judged(name: str, seeds) -> Tally:
    nominal, tally = arm(name), Tally()
    for seed in seeds:
        trial(nominal, seed, tally)
    return tally


ARMS = pytest.mark.parametrize("name", ["paper", "ur5", "panda", "slide"])


@ARMS
def test_intervals_and_predictions_hold(name):
    tally = judged(name, range(12))
    assert 0.90 < tally.inside / tally.count < 0.99
    assert np.sqrt(tally.squares / tally.bound) == pytest.approx(1, abs=0.15)
    assert np.sqrt(tally.squares / tally.claimed) == pytest.approx(1, abs=0.15)


@pytest.mark.slow
@ARMS
def test_intervals_and_predictions_hold_over_1000_robots(name):
    tally = judged(name, range(1000))
    assert 0.93 < tally.inside / tally.count < 0.97
    assert np.sqrt(tally.squares / tally.bound) == pytest.approx(1, abs=0.05)
    assert np.sqrt(tally.squares / tally.claimed) == pytest.approx(1, abs=0.10)


def worse_than_nominal(name: str, sets: str, kind, poses, seeds) -> int:
    """How many arms have their tool farther off after the fit than before, at poses anywhere.

    Before, base and tool stand where they fit the nominal arm if they are unknown.
    """
    nominal, worse = arm(name), 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        errors = select_parameters(nominal, sets)
        size = np.array([np.deg2rad(2.0) if p.unit == "rad" else 1e-2 for p in errors.parameters])
        size = size if seed % 2 else size / 10
        truth = errors.at(size * rng.uniform(-1, 1, len(size)))
        data = kind.simulate(truth, poses(nominal, rng), Noise(POSITION, ROTATION), rng)
        fit = calibrate(nominal, data, sets)
        q = drawn(nominal, 100, rng)
        wanted = truth.poses(q)[:, :3, 3]
        before, after = (
            np.mean(np.sum((chain.poses(q)[:, :3, 3] - wanted) ** 2, 1))
            for chain in (fit.nominal_refitted, fit.chain)
        )
        worse += after > before
        assert bool(fit.shrinkage_notes) == (fit.shrinkage_factor < 1)
    return worse


def two(chain: Chain, rng: np.random.Generator):
    return drawn(chain, 2, rng)


def four(chain: Chain, rng: np.random.Generator):
    return drawn(chain, 4, rng)


def one_corner(chain: Chain, rng: np.random.Generator):
    return drawn(chain, 1, rng) + rng.uniform(-0.2, 0.2, (30, chain.n_joints))


POOR = pytest.mark.parametrize(
    ("name", "sets", "kind", "poses"),
    [
        ("paper", "dh", Pose, two),
        ("paper", "minimal", Pose, two),
        ("paper", "dh", Position, two),
        ("ur5", "minimal", Pose, two),
        ("panda", "minimal", Position, two),
        ("slide", "dh", Position, two),
        ("ur5", "minimal,base,tool", Pose, two),
        ("ur5", "minimal,base,tool", Pose, four),
        ("panda", "minimal,base,tool", Position, four),
        ("paper", "dh", Pose, one_corner),
        ("paper", "minimal", Pose, one_corner),
    ],
)


@POOR
def test_poor_data_do_no_harm(name, sets, kind, poses):
    assert worse_than_nominal(name, sets, kind, poses, range(8)) == 0


@pytest.mark.slow
@POOR
def test_poor_data_do_no_harm_in_200(name, sets, kind, poses):
    assert worse_than_nominal(name, sets, kind, poses, range(200)) <= 2


def test_enough_readings_are_kept_whole():
    nominal = arm("ur5")
    errors, rng = select_parameters(nominal, "minimal,base,tool"), np.random.default_rng(0)
    truth = errors.at(1e-3 * rng.standard_normal(len(errors.parameters)))
    data = Pose.simulate(truth, drawn(nominal, 12, rng), Noise(POSITION, ROTATION), rng)
    fit = calibrate(nominal, data)
    assert fit.shrinkage_factor == 1
    assert fit.shrinkage_notes == []
