"""Differences of calibrations at other conditions, against what was changed in simulated arms."""

from dataclasses import replace

import numpy as np
import pytest
from robots import nominal_arm
from scipy import stats
from sessions import NOISE, Simulation

from dhcal_pin import Chain, calibrate, select_parameters
from dhcal_pin.diagnostics import Calibrated, Difference, compare
from dhcal_pin.measurements import Position
from dhcal_pin.robot.conditions import Conditions
from dhcal_pin.robot.transmission import Payload

SIZES = {"backlash": 4e-4, "thermal": 2e-5, "compliance": -3e-5}
CENTRE = (0.02, -0.03, 0.08)


def true_arm(family: str, number: int | None = None, change: float = 0.0) -> Chain:
    """Return a UR10 with errors of its geometry and of a family, one of which is changed."""
    chain = nominal_arm("ur10").with_payload(Payload(5.0, CENTRE))
    geometry = select_parameters(chain, "minimal")
    chain = geometry.at(np.random.default_rng(7).normal(0, 3e-4, len(geometry.parameters)))
    errors = select_parameters(chain, family)
    values = np.full(len(errors.parameters), SIZES[family])
    if number is not None:
        values[number] += change
    return errors.at(values)


def calibrated(
    truth: Chain,
    family: str,
    seed: int,
    *,
    temperatures: tuple[float, float] = (15.0, 35.0),
    masses: tuple[float, ...] = (0.0, 5.0, 10.0),
    payload: float = 5.0,
    count: int = 60,
) -> Calibrated:
    """Measure an arm and calibrate it with a family of joint errors."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-2.5, 2.5, (count, 6))
    conditions = {
        "backlash": {"approach": rng.choice([-1.0, 1.0], q.shape)},
        "thermal": {"temperature": rng.uniform(*temperatures, count)},
        "compliance": {"payload": rng.choice(masses, count)},
    }[family]
    tool = np.eye(4)
    tool[:3, 3] = 0.05, -0.04, 0.1
    points = truth.with_base_and_tool(np.eye(4), tool).poses(Conditions(q, **conditions))[:, :3, 3]
    data = Position(q, points + rng.normal(0, NOISE, points.shape), NOISE).with_conditions(**conditions)
    fit = calibrate(
        nominal_arm("ur10").with_payload(Payload(payload, CENTRE)),
        data,
        f"minimal,base,tool,{family}",
        extend="none",
        session="off",
    )
    return Calibrated(fit.chain, fit.uncertainty, fit.measured_region, f"{seed}.urdf")


def named(found: Difference) -> str:
    """Return the first joint or link that differs, with its parameter."""
    name, part = next(iter(found.joints.items()))
    return f"{name} {part.parameter}"


@pytest.mark.parametrize(
    ("family", "number", "change", "name"),
    [
        ("backlash", 2, 7e-4, "elbow_joint backlash"),
        ("thermal", 3, 3e-5, "forearm_link thermal growth"),
        ("compliance", 1, -3e-5, "elbow_joint elasticity"),
    ],
)
def test_a_changed_error_that_depends_on_conditions_is_named(family, number, change, name):
    first = calibrated(true_arm(family), family, 1)
    assert compare(first, calibrated(true_arm(family), family, 2)).verdict == "equal"
    found = compare(first, calibrated(true_arm(family, number, change), family, 2))
    assert found.verdict == "different"
    assert named(found) == name
    part = next(iter(found.joints.values()))
    assert abs(part.size - change) < 4 * part.std
    assert part.std < abs(change) / 5
    assert found.unexplained == 0


def test_arms_are_compared_at_one_temperature():
    truth = true_arm("thermal")
    first, second = (
        calibrated(truth, "thermal", int(mean), temperatures=(mean - 5, mean + 5)) for mean in (20.0, 32.0)
    )
    found = compare(first, second)
    assert found.verdict == "equal"
    references = [each.chain.reference_temperature for each in (first, second)]
    assert np.mean(references) == pytest.approx(26, abs=1)
    assert found.sentences[-1] == (
        f"Both are compared at {references[0]:.1f} °C, the reference temperature of 20.urdf; that of 32.urdf "
        f"is {references[1]:.1f} °C."
    )
    # Without the growth over 12 K, the arms are different.
    moved = replace(second.chain, reference_temperature=references[0]).with_current_loads()
    assert compare(first, replace(second, chain=moved)).verdict == "different"


def test_arms_are_compared_with_one_payload():
    truth = true_arm("compliance")
    first = calibrated(truth, "compliance", 1, masses=(0.0, 5.0), payload=1.0)
    second = calibrated(truth, "compliance", 2, masses=(5.0, 10.0), payload=10.0)
    found = compare(first, second)
    assert found.verdict == "equal"
    assert found.sentences[-1] == (
        "Both are compared with the payload of 1.urdf, 1 kg at 20, -30, 80 mm; that of 2.urdf is 10 kg at "
        "20, -30, 80 mm."
    )


def test_errors_that_only_one_arm_states_are_named():
    first = calibrated(true_arm("backlash"), "backlash", 1)
    without = replace(first.chain, transmission=None)
    found = compare(first, Calibrated(without, source="nominal.urdf"))
    assert found.verdict == "different"
    assert "Only 1.urdf states backlash of the joints." in found.sentences
    assert {part.parameter for part in found.joints.values()} == {"backlash"}


def test_a_zero_that_is_off_by_degrees_is_named_alone():
    sim = Simulation("ur10", 60, 3)
    first, second = (
        calibrate(sim.chain, sim.measure(Position), extend="none", session="off") for _ in range(2)
    )
    angle = np.deg2rad(4.0)
    turned = second.chain.with_zeros_moved(np.eye(6)[3] * angle)
    found = compare(
        *(
            Calibrated(chain, fit.uncertainty, fit.measured_region)
            for chain, fit in ((first.chain, first), (turned, second))
        )
    )
    assert list(found.joints) == ["wrist_1_joint"]
    part = found.joints["wrist_1_joint"]
    assert (part.parameter, part.unit) == ("zero", "rad")
    assert abs(part.size + angle) < 4 * part.std + 2e-5
    # Both are models of the geometry.
    assert found.unexplained == 0
    assert "These parts differ: wrist_1_joint (zero -69.8" in " ".join(found.sentences)


def test_only_a_large_chi_square_is_unusual():
    first = calibrated(true_arm("backlash"), "backlash", 1)
    found = compare(first, first)
    assert found.of_parameters is not None
    assert found.of_parameters.value == 0
    limit = stats.chi2.isf(0.005, found.of_parameters.freedom) / found.of_parameters.freedom
    assert found.sentences[0].endswith(f"equal robots have less than {limit:.2f}.")
    assert found.to_dict()["reduced_chi_square_limit"] > 1
