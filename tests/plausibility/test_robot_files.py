"""Mistakes in the file of a robot: its unit of length, or the convention, columns and angles of a table."""

from dataclasses import replace

import numpy as np
import pytest
from measurement_files import frames
from robots import paper
from slow_cases import some_slow

from dhcal_pin.calibration import calibrate
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Noise, Pose, Position
from dhcal_pin.plausibility import diagnose_mixups
from dhcal_pin.robot import Chain, DHTable
from dhcal_pin.units import LENGTHS

QUARTER = np.pi / 2


def table(convention, rows, slides=()):
    """Table of rows θ, d, a, α [rad, m]."""
    theta, d, a, alpha = np.array(rows, float).T
    names, free = tuple(f"j{i + 1}" for i in range(len(rows))), np.full(len(rows), np.inf)
    is_slide = np.isin(range(len(rows)), slides)
    return DHTable(convention, names, is_slide, theta, d, a, alpha, 0 * d, -free, free)


# From the tables in the literature: UR10 and KUKA, Panda and PUMA, and a SCARA.
UR10 = (0, 0.1273, 0, QUARTER), (0, 0, -0.612, 0), (0, 0, -0.5723, 0), (0, 0.163941, 0, QUARTER)
KUKA = (0, 0.4, 0.025, -QUARTER), (0, 0, 0.56, 0), (-QUARTER, 0, 0.035, -QUARTER), (0, 0.515, 0, QUARTER)
PANDA = (0, 0.333, 0, 0), (0, 0, 0, -QUARTER), (0, 0.316, 0, QUARTER), (0, 0, 0.0825, QUARTER)
PUMA = (0, 0.67, 0, 0), (0, 0, 0, -QUARTER), (0, 0.15, 0.4318, 0), (0, 0.4318, 0.0203, -QUARTER)
SCARA = (0, 0.4, 0.325, 0), (0, 0, 0.275, np.pi), (0, 0, 0, 0), (0, 0.1, 0, 0)
TABLES = {
    "ur10": table("standard", [*UR10, (0, 0.1157, 0, -QUARTER), (0, 0.0922, 0, 0)]),
    "kuka": table("standard", [*KUKA, (0, 0, 0, -QUARTER), (0, 0.08, 0, 0)]),
    "panda": table("modified", [*PANDA, (0, 0.384, -0.0825, -QUARTER), (0, 0, 0, QUARTER)]),
    "puma": table("modified", [*PUMA, (0, 0, 0, QUARTER), (0, 0, 0, -QUARTER)]),
    "scara": table("standard", SCARA, [2]),
    "paper": paper("sim_6dof"),
}


def other_convention(right):
    return replace(right, convention="modified" if right.convention == "standard" else "standard")


# The wrong table, and words of the remedy.
MISTAKES = (
    (other_convention, 'Correct convention in the robot file to "{}"'),
    (lambda right: replace(right, a=right.d, d=right.a), "Correct a and d in the robot file."),
    (
        lambda right: replace(right, theta=np.deg2rad(right.theta), alpha=np.deg2rad(right.alpha)),
        "Correct the angles in the robot file.",
    ),
)
CASES = [(*mistake, name, kind) for mistake in MISTAKES for name in TABLES for kind in (Pose, Position)]
# A SCARA with a tool of 6 m explains these positions.
CASES.remove((*MISTAKES[1], "scara", Position))
FRAMES = frames()


def measured(right, kind, seed, base=FRAMES[0], tool=FRAMES[1]):
    """Measurements of a robot with errors of millimetres."""
    errors = select_parameters(right, right.parameters)
    rng = np.random.default_rng(seed)
    truth = errors.at(0.3 * errors.priors * rng.standard_normal(len(errors.parameters)))
    q = rng.uniform(-2, 2, (60, right.n_joints)) * np.where(right.is_prismatic, 0.1, 1)
    return kind.simulate(truth.with_base_and_tool(base, tool), q, Noise(1e-4, 1e-4), rng)


@pytest.mark.parametrize(("make_wrong", "remedy", "name", "kind"), some_slow(CASES, {0, 5, 14, 25}))
def test_a_mistake_in_a_dh_table_is_named(make_wrong, remedy, name, kind):
    right = Chain.from_dh(TABLES[name])
    data = measured(right, kind, 0)
    assert not diagnose_mixups(right, [data]).is_suspicious
    found = diagnose_mixups(Chain.from_dh(make_wrong(TABLES[name])), [data])
    assert found.remedy.startswith(remedy.format(TABLES[name].convention))


def test_the_calibration_is_refused_with_the_mistake_and_ok_without():
    right = Chain.from_dh(TABLES["kuka"])
    data = measured(right, Pose, 1, np.eye(4), np.eye(4))
    verdict = calibrate(Chain.from_dh(other_convention(TABLES["kuka"])), data).verdict
    assert verdict.status == "refused"
    assert "The DH table is in the standard convention, but was read in the other one" in verdict.reasons[0]
    assert calibrate(right, data).verdict.status == "ok"


@pytest.mark.parametrize(("true", "read", "size"), [("m", "mm", "small"), ("mm", "m", "large")])
@pytest.mark.parametrize("name", ["kuka", "scara"])
@pytest.mark.parametrize("kind", [Pose, Position])
def test_a_robot_of_impossible_size_has_a_wrong_unit(kind, name, true, read, size):
    right = Chain.from_dh(TABLES[name])
    data = measured(right, kind, 0)
    factor = LENGTHS[true] / LENGTHS[read]
    wrong = Chain.from_dh(replace(TABLES[name], a=factor * TABLES[name].a, d=factor * TABLES[name].d))
    found = diagnose_mixups(wrong, [data])
    words = f"The lengths of the robot are 1000 times too {size}, as if {true} had been read as {read}"
    assert found.sentence.startswith(words)
    assert found.remedy == "Correct the lengths in the robot file."


def test_a_robot_and_measurements_of_kilometres_are_refused():
    """Metres in the file were millimetres, and so were the measurements: they agree with each other."""
    right = TABLES["kuka"]
    data = measured(Chain.from_dh(right), Position, 0)
    wrong = Chain.from_dh(replace(right, a=1e3 * right.a, d=1e3 * right.d))
    found = calibrate(
        wrong, data.replace(values=1e3 * data.values), "minimal,base,tool", session="off"
    ).verdict
    assert found.status == "refused"
    assert found.reasons[0].startswith("The links of the robot are about 1832 m long together")


@pytest.mark.parametrize("name", ["kuka", "panda", "scara"])
def test_a_dh_table_with_an_unknown_base_is_calibrated_with_the_named_sets(name):
    right = Chain.from_dh(TABLES[name])
    data = measured(right, Pose, 2)
    (sets,) = {
        word
        for text in calibrate(right, data).verdict.reasons
        for word in text.split()
        if "base" in word and "," in word
    }
    assert calibrate(right, data, sets.strip(".")).verdict.status == "ok"
    assert sets == f"{right.parameters},base,tool."
