"""Without a measured length, the verdict states the errors of positions that residuals do not show."""

import re

import numpy as np
import pytest
from robots import nominal_arm
from slow_cases import some_slow

from dhcal_pin import calibrate
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import KINDS, Noise, Position

ADVICE = {
    "inclination": "Measure the position of the tool in a fixed frame.",
    "plane": "Add a known distance between contact points.",
    "point": "Add a known distance between contact points.",
}


def simulated(arm, kind, seed):
    """Return a nominal arm, a true one, 60 measurements of it, and joint values for a test."""
    rng, nominal = np.random.default_rng(seed), nominal_arm(arm)
    errors = select_parameters(nominal, "placement")
    size = np.array([2e-3 if p.unit == "rad" else 1e-3 for p in errors.parameters])
    truth = errors.at(size * rng.standard_normal(len(size)))
    q = rng.uniform(np.maximum(nominal.lower, -2.8), np.minimum(nominal.upper, 2.8), (60, nominal.n_joints))
    return nominal, truth, KINDS[kind].simulate(truth, q, Noise(5e-5, 1e-4), rng)


def position_error(chain, truth, q):
    """Return the RMS position error, with the best base and the best tool [m]."""
    fit = calibrate(chain, Position(q, truth.poses(q)[:, :3, 3]), "base,tool", loss="linear", session="off")
    return fit.comparisons[-1].after["position_rms_m"]


CASES = [
    ("xarm7", "inclination"),
    ("xarm7", "plane"),
    ("ur10", "inclination"),
    ("panda", "point"),
    ("ur5", "plane"),
]


# Few arms say little about an RMS.
@pytest.mark.parametrize(
    ("arm", "kind", "n_seeds"), some_slow([(*CASES[0], 3), *((*case, 12) for case in CASES)], {0})
)
def test_errors_of_positions_that_residuals_do_not_show_are_stated(arm, kind, n_seeds):
    """The stated size is the RMS of the true errors of many arms."""
    stated, true = [], []
    for seed in range(n_seeds):
        nominal, truth, data = simulated(arm, kind, seed)
        fit = calibrate(nominal, data, extend="none", session="off")
        assert fit.verdict.status == "caution"
        reason = fit.verdict.reasons[0]
        assert reason.startswith("The measurements do not determine the size of the robot: errors of")
        assert reason.endswith(ADVICE[kind])
        assert any("do not determine the size of the robot" in text for text in fit.unobservable)
        stated.append(1e-3 * float(re.findall(r"of about ([\d.]+) mm", reason)[0]))
        true.append(position_error(fit.chain, truth, data.q))
        (after,) = fit.comparisons[0].after.groups.values()
        assert after.rms < 5e-4
    assert 0.5 < np.linalg.norm(stated) / np.linalg.norm(true) < 2.0


@pytest.mark.parametrize("kind", some_slow(["position", "distance", "relative", "wires", "pose"], {0, 1}))
def test_measured_lengths_determine_the_size(kind):
    nominal, truth, data = simulated("ur10", kind, 4)
    fit = calibrate(nominal, data, extend="none", session="off")
    assert fit.verdict.status == "ok"
    assert position_error(fit.chain, truth, data.q) < 2e-4


def test_a_few_positions_determine_the_lengths_beside_inclinations():
    nominal, truth, data = simulated("ur10", "inclination", 5)
    positions = Position(data.q[:20], truth.poses(data.q[:20])[:, :3, 3], 5e-5)
    fit = calibrate(nominal, [data, positions], extend="none", session="off")
    assert not any("size of the robot" in reason for reason in fit.verdict.reasons)
