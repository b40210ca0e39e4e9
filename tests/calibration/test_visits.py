"""Few taught poses that the robot visits often; the joint values differ a little from visit to visit."""

import numpy as np
import pytest
from sessions import ANGLE_NOISE, NOISE, Changes, Simulation
from slow_cases import some_slow

from dhcal_pin import Result, calibrate
from dhcal_pin.measurements import Pose

# Standard deviations of the joint values of a visit [rad]: resolution of the encoders of an industrial arm,
# of a servo with 4,096 steps per turn, and of a person who guides the arm back.
JITTERS = (1e-4, 1e-3, 1e-2)
ORDERS = ("by pose", "by cycle")


def visited(
    n_poses: int, n_visits: int, jitter: float, order: str, seed: int, changes: Changes | None = None
) -> tuple[Simulation, Result]:
    """Calibrate an arm with eccentric gears from visits of taught poses."""
    sim = Simulation("ur10", n_poses * n_visits, seed)
    sim.add_eccentricities(3e-4)
    poses = np.random.default_rng(seed).uniform(-2, 2, (n_poses, 6))
    number = np.arange(len(sim.q))
    number = number // n_visits if order == "by pose" else number % n_poses
    sim.q = poses[number] + jitter * sim.rng.standard_normal(sim.q.shape)
    measured = sim.measure(Pose, changes)
    return sim, calibrate(sim.chain, Pose(measured.q, measured.poses, NOISE, ANGLE_NOISE))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("jitter", JITTERS)
@pytest.mark.parametrize(("n_poses", "n_visits"), [(5, 30), (8, 10)])
@pytest.mark.parametrize("seed", some_slow(range(10), [0]))
def test_visits_of_few_poses_are_few_configurations(n_poses, n_visits, jitter, order, seed):
    _, fit = visited(n_poses, n_visits, jitter, order, seed)
    assert fit.verdict.status != "ok"
    text = " ".join(fit.verdict.reasons)
    # Nothing changed, and the instrument is right.
    assert "moved by" not in text
    assert "--mend scale" not in text
    # Visits of fitted poses would leave the noise only.
    assert fit.comparisons[0].after.groups["position"].rms > 5 * NOISE


@pytest.mark.parametrize("jitter", JITTERS)
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("seed", some_slow(range(10), [0]))
def test_many_visited_poses_are_enough(jitter, order, seed):
    sim, fit = visited(30, 4, jitter, order, seed)
    assert fit.verdict.status == "ok"
    assert sim.true_error(fit.chain) < 2e-4


@pytest.mark.parametrize("seed", some_slow(range(10), [0]))
def test_visits_show_a_drift(seed):
    _, fit = visited(15, 10, 1e-4, "by cycle", seed, Changes("base", 1e-3, at=None))
    assert "The base" in " ".join(fit.verdict.reasons)
