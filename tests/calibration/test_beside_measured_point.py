"""Predicted error beside the measured point of a tool, against the known truth of simulated arms."""

import numpy as np
import pytest
from robots import nominal_arm
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.calibration import Result, calibrate
from dhcal_pin.calibration.evidence import BESIDE
from dhcal_pin.calibration.summary import beside_notes, position_error_beside
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import MultiTargetPosition, Noise, Pose, Position
from dhcal_pin.robot import Chain

SETS = "minimal,base,tool"
NOISE = Noise(1e-4, 1e-4)
KEY = "position_rms_m"


def with_tool(chain: Chain, offset) -> Chain:
    """Return an arm whose measured point lies at an offset from its present one, in the axes of the tool."""
    return chain.with_base_and_tool(chain.base, chain.tool @ se3.transform(np.eye(3), offset))


def measured(
    kind, seed: int, offset, name: str = "ur10", sizes: tuple[float, float] = (1e-3, 5e-3)
) -> tuple[Result, Chain]:
    """Calibrate an arm from measurements of a point at an offset from its tip; return also the true arm."""
    arm, rng = with_tool(nominal_arm(name), offset), np.random.default_rng(seed)
    errors = select_parameters(arm, "placement")
    size = np.array([sizes[p.unit == "rad"] for p in errors.parameters])
    truth = errors.at(size * rng.standard_normal(len(size)))
    data = kind.simulate(truth, rng.uniform(-2, 2, (60, arm.n_joints)), NOISE, rng)
    return calibrate(arm, data, SETS, extend="none", session="off"), truth


def true_error(fit: Result, truth: Chain) -> float:
    """Return the largest true error at `BESIDE` from the measured point, with base and tool fitted [m]."""
    rng = np.random.default_rng(99)
    q, exact = rng.uniform(-2, 2, (200, truth.n_joints)), Noise(1e-6)
    errors = []
    for offset in BESIDE * np.eye(3):
        data = Position.simulate(with_tool(truth, offset), q, exact, rng)
        frames = calibrate(with_tool(fit.chain, offset), data, "base,tool", extend="none", session="off")
        errors.append(frames.comparisons[-1].after[KEY])
    return max(errors)


# Sizes of the errors of an arm: in the proportion of the default priors, and with smaller angles.
@pytest.mark.parametrize(
    ("name", "sizes", "count"),
    some_slow(
        [
            ("ur10", (1e-3, 5e-3), 4),
            ("ur10", (1e-3, 5e-3), 20),
            ("panda", (1e-3, 5e-3), 20),
            ("ur10", (2e-3, 2e-3), 20),
        ],
        {0},
    ),
)
def test_error_beside_a_point_on_the_last_axis_is_predicted_and_falls_off_the_axis(name, sizes, count):
    stated, on_axis, off_axis = [], [], []
    for seed in range(count):
        fit, truth = measured(Position, seed, [0.0, 0.0, 0.05], name, sizes)
        stated.append(position_error_beside(fit))
        on_axis.append(true_error(fit, truth))
        (note,) = beside_notes(fit)
        assert f"the axis of {fit.chain.joint_names[-1]} and hardly shows" in note
        assert "at least 100 mm from the axis" in note
        advised, truth = measured(Position, seed, [0.1, 0.0, 0.05], name, sizes)
        assert beside_notes(advised) == []
        off_axis.append(true_error(advised, truth))
        assert off_axis[-1] < advised.comparisons[0].after[KEY]
    on, off, predicted = (np.sqrt(np.mean(np.square(each))) for each in (on_axis, off_axis, stated))
    assert 0.3 < on / predicted < 1.5
    assert off < on / 3


@pytest.mark.parametrize("kind", [Pose, MultiTargetPosition])
def test_orientation_and_several_points_show_it(kind):
    fit, truth = measured(kind, 0, np.zeros(3))
    assert position_error_beside(fit) is None
    assert true_error(fit, truth) < 2 * NOISE.position
