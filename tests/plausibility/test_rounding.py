"""Joint values with few digits: named if they explain the errors, and more digits help as promised."""

import json
import re

import numpy as np
import pytest
from robots import measured_arm, robot_file, with_small_errors
from slow_cases import some_slow

from dhcal_pin import calibrate
from dhcal_pin.cli import main
from dhcal_pin.measurements import KINDS, Noise, Position
from dhcal_pin.plausibility.rounding import MIN_DIFFERENT, _find_step

DEG = np.deg2rad(1.0)
NOISE = Noise(5e-5, 1e-4)
# Arm, kind, number of samples, step [rad or m] and its text.
ROUNDED = [
    ("ur5", "position", 80, 0.1 * DEG, "0.1°"),
    ("ur5", "pose", 50, 0.001, "0.001 rad"),
    ("panda", "position", 100, 0.5 * DEG, "0.5°"),
    ("panda", "pose", 60, 0.1 * DEG, "0.1°"),
    ("paper", "position", 100, DEG, "1°"),
    ("paper", "wires", 100, 0.1 * DEG, "0.1°"),
    ("ur5", "inclination", 100, 0.1 * DEG, "0.1°"),
    ("ur5", "plane", 150, 0.01, "0.01 rad"),
]


def multiples(q, step):
    """Round joint values to multiples of a step."""
    return np.round(q / step) * step


def draw(name, m, seed):
    """Return a nominal and a true arm, configurations (m, n), and the generator that drew them."""
    rng = np.random.default_rng([seed, m])
    nominal = measured_arm(name)
    q = rng.uniform(np.maximum(nominal.lower, -2.5), np.minimum(nominal.upper, 2.5), (m, nominal.n_joints))
    return nominal, with_small_errors(nominal, rng), q, rng


def true_error(fit, true, rng):
    """Return the RMS error of predicted positions at 300 other configurations [m]."""
    lower, upper = np.maximum(true.lower, -2.5), np.minimum(true.upper, 2.5)
    q = rng.uniform(lower, upper, (300, true.n_joints))
    errors = fit.chain.poses(q)[:, :3, 3] - true.poses(q)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(errors**2, 1))))


def lengths_of(note):
    """Return the two RMS errors of a note in its unit."""
    return [float(text) for text in re.findall(r"\(([0-9.]+) (?:mm|mrad)\)", note)]


@pytest.mark.parametrize(("name", "kind", "m", "step", "text"), some_slow(ROUNDED, {0, 1}))
def test_rounded_values_are_named_and_two_more_digits_help(name, kind, m, step, text):
    nominal, true, q, rng = draw(name, m, 1)
    exact = KINDS[kind].simulate(true, q, NOISE, rng).replace(has_stated_sigma=False)

    def with_step(size):
        return calibrate(nominal, exact.resample(multiples(exact.configurations(), size)), session="off")

    rounded, finer = with_step(step), with_step(step / 100)
    (note,) = rounded.rounding_notes
    assert note.startswith(f"The joint values are multiples of {text}. ")
    found, expected = lengths_of(note)
    assert found == pytest.approx(expected, rel=0.35)
    assert finer.rounding_notes == []
    before, after = (next(iter(fit.comparisons[-1].after.groups.values())).rms for fit in (rounded, finer))
    assert after < 0.5 * before
    if kind in ("position", "pose"):
        # The accuracy of the rounded values is stated rightly, so that the verdict is "ok".
        assert rounded.verdict.status == "ok"
        error = true_error(rounded, true, rng)
        assert error < rounded.comparisons[0].after.groups["position"].rms
        assert true_error(finer, true, rng) < 0.5 * error


@pytest.mark.parametrize("seed", some_slow([0, 2, 3, 4, 5], {0}))
def test_values_that_are_cut_off_leave_zeros_that_are_wrong_by_half_a_step(seed):
    step = 0.1 * DEG
    nominal, true, q, rng = draw("ur5", 80, seed)
    exact = Position.simulate(true, q, NOISE, rng).replace(has_stated_sigma=False)
    fit = calibrate(nominal, exact.resample(np.floor(exact.q / step) * step), session="off")
    (note,) = fit.rounding_notes
    assert note.endswith(
        "If digits were cut off, not rounded, the zeros of the joints are wrong by half a step, too."
    )
    q = rng.uniform(-2.5, 2.5, (300, 6))
    errors = [
        np.sqrt(np.mean(np.sum((fit.chain.poses(values)[:, :3, 3] - true.poses(q)[:, :3, 3]) ** 2, 1)))
        for values in (q, q - step / 2)
    ]
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize(
    ("name", "kind", "seed"),
    some_slow(
        [
            (name, kind, seed)
            for name in ("ur5", "panda")
            for kind in ("position", "pose")
            for seed in range(5)
        ],
        {0, 15},
    ),
)
def test_commanded_values_that_were_reached_are_not_named(name, kind, seed):
    nominal, true, q, rng = draw(name, 80, seed)
    q = multiples(q, 0.1 * DEG)
    small = KINDS[kind].simulate(true, q, NOISE, rng).replace(has_stated_sigma=False)
    assert calibrate(nominal, small, session="off").rounding_notes == []
    # The noise is as large as the effect of rounding.
    moved = true.poses(q + 0.1 * DEG * rng.uniform(-0.5, 0.5, q.shape)) - true.poses(q)
    position = float(np.sqrt(np.mean(moved[:, :3, 3] ** 2)))
    rotation = float(np.sqrt(np.mean(moved[:, :3, :3] ** 2) * 1.5))
    large = KINDS[kind].simulate(true, q, Noise(position, rotation), rng).replace(has_stated_sigma=False)
    assert calibrate(nominal, large, session="off").rounding_notes == []


def test_joints_with_a_step_are_named():
    nominal, true, q, rng = draw("slide", 120, 2)
    measured = Position.simulate(true, q, NOISE, rng).replace(has_stated_sigma=False)
    steps = np.array([0.1 * DEG, 0.1 * DEG, 1e-4, 0, 0])
    rounded = np.where(steps, multiples(q, np.where(steps, steps, 1.0)), q)
    (note,) = calibrate(nominal, measured.resample(rounded), session="off").rounding_notes
    assert note.startswith("The joint values of j1, j2 and j3 are multiples of 0.1° and 0.1 mm.")


def test_steps_of_joint_values():
    rng = np.random.default_rng(0)
    q = rng.uniform(-3, 3, 40)
    assert _find_step(q, False) == (0.0, "")
    for step, text in ((DEG, "1°"), (0.5 * DEG, "0.5°"), (0.01 * DEG, "0.01°"), (0.001, "0.001 rad")):
        found = _find_step(multiples(q, step), False)
        assert found == (pytest.approx(step), text)
    assert _find_step(np.deg2rad(np.round(np.rad2deg(q), 1).astype(np.float32)), False)[1] == "0.1°"
    assert _find_step(multiples(q, 5e-4), True) == (pytest.approx(5e-4), "0.5 mm")
    # Steps of an encoder are no decimal numbers.
    assert _find_step(multiples(q, 2 * np.pi / 4096), False) == (0.0, "")
    assert _find_step(np.linspace(0, 0.9, MIN_DIFFERENT - 1), False) == (0.0, "")


def test_screen_report_and_json_name_the_file(tmp_path, capsys):
    nominal, true, q, rng = draw("ur5", 60, 3)
    p = true.poses(q)[:, :3, 3] + 5e-5 * rng.standard_normal((60, 3))
    header = ",".join([*(f"{name}[deg]" for name in nominal.joint_names), "x[m]", "y[m]", "z[m]"])
    paths = {}
    for name, values in (("rounded", np.round(np.rad2deg(q), 1)), ("exact", np.rad2deg(q))):
        paths[name] = tmp_path / f"{name}.csv"
        np.savetxt(paths[name], np.hstack([values, p]), "%.9f", ",", header=header, comments="")
    robot = robot_file("ur_description/urdf/ur5_robot.urdf")
    result, report = tmp_path / "r.json", tmp_path / "r.md"
    command = ["calibrate", robot, *paths.values(), "--tip", "tool0", "-o", tmp_path / "c.urdf"]
    command += ["--json", result, "--report", report, "--session", "off"]
    assert main.main([*map(str, command)]) == 0
    (note,) = json.loads(result.read_text())["rounding_notes"]
    assert note.split(": ")[0].endswith("rounded.csv")
    sentence = "The joint values are multiples of 0.1°."
    assert sentence in note
    for text in (capsys.readouterr().err, report.read_text()):
        assert sentence in " ".join(text.split())
