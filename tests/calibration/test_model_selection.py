"""Model selection: families of joint errors are added only if the measurements support them."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from robots import robot_file

from dhcal_pin.calibration import calibrate, extend
from dhcal_pin.calibration.model_selection import MAX_HINT_SAMPLES, family_hint
from dhcal_pin.cli.main import main
from dhcal_pin.estimation import select_parameters
from dhcal_pin.io import measurement_text
from dhcal_pin.measurements import Measurement, Noise, Pose, Position
from dhcal_pin.robot import Chain
from dhcal_pin.robot.error_families import FAMILIES


def simulated(
    sets: str, seed: int, m: int = 60, noise: float = 1e-4, kind: type[Measurement] = Pose
) -> tuple[Chain, Measurement]:
    """Simulate measurements of a UR10 whose errors have the size of their priors."""
    rng = np.random.default_rng(seed)
    arm = Chain.from_urdf(robot_file("ur_description/urdf/ur10_robot.urdf"), "tool0")
    errors = select_parameters(arm, sets)
    truth = errors.at(
        rng.normal(size=len(errors.parameters)) * np.minimum(errors.priors, 0.1)
    ).with_current_loads()
    return arm, kind.simulate(truth, rng.uniform(-2.5, 2.5, (m, 6)), Noise(noise, noise), rng)


@pytest.mark.parametrize("family", ["gain", "harmonics", "compliance", "coupling"])
def test_hint_names_the_missing_family_and_its_effect(family):
    arm, data = simulated(f"{family},minimal,base,tool", seed=1)
    plain = calibrate(arm, data, "minimal,base,tool")
    found = re.fullmatch(
        r"residuals vary .* \((.*)\?\); --extend auto may reduce them by about (\d+) %", family_hint(plain)
    )
    assert found
    assert found[1] == FAMILIES[family].description
    whole = calibrate(arm, data, f"{family},minimal,base,tool")
    rms = [np.sqrt(fit.solution.system.cost / (360 - fit.rank)) for fit in (plain, whole)]
    assert 100 - float(found[2]) == pytest.approx(100 * rms[1] / rms[0], abs=2, rel=0.3)
    assert not family_hint(whole)


@pytest.mark.parametrize("seeds", [20, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", [Pose, Position])
def test_geometric_errors_alone_give_no_hint(kind, seeds):
    """Chance gives a hint once in a million, whether or not standard deviations are stated."""
    for seed in range(seeds):
        arm, data = simulated("minimal,base,tool", seed, (20, 40, 80)[seed % 3], kind=kind)
        data = data.replace(has_stated_sigma=bool(seed % 2))
        assert not family_hint(calibrate(arm, data, "minimal,base,tool"))


def test_hint_uses_a_part_of_many_samples():
    arm, data = simulated("harmonics,minimal,base,tool", seed=0, m=3 * MAX_HINT_SAMPLES + 1)
    assert FAMILIES["harmonics"].description in family_hint(calibrate(arm, data, "minimal,base,tool"))


@pytest.mark.parametrize("seed", range(2))
def test_no_family_is_added_to_geometric_errors(seed):
    _, trials = extend(*simulated("minimal,base,tool", seed))
    assert len(trials) == 4
    assert not [trial.family for trial in trials if trial.is_selected]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Pose, Position])
def test_hardly_a_family_is_added_to_200_robots_with_geometric_errors(kind):
    added = 0
    for seed in range(200):
        m = (30, 60, 120)[seed % 3]
        _, trials = extend(*simulated("minimal,base,tool", 100 + seed, m, kind=kind))
        added += any(trial.is_selected for trial in trials)
    assert added <= 10


@pytest.mark.parametrize("family", ["compliance", "harmonics"])
def test_simulated_family_is_added(family):
    arm, data = simulated(f"minimal,base,tool,{family}", 3)
    fit, trials = extend(arm, data)
    assert next(trial.family for trial in trials if trial.is_selected) == family
    one = trials[0]
    assert one.cv_after < one.cv_before - one.standard_error
    plain = calibrate(arm, data)
    _, more = simulated(f"minimal,base,tool,{family}", 3, m=200)
    assert fit.validate(more)["position_rms_m"] < 0.5 * plain.validate(more)["position_rms_m"]


def test_command_reports_the_effect_of_each_family(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arm, data = simulated("minimal,base,tool,compliance", 4)
    (tmp_path / "data.csv").write_text(measurement_text(data, arm, []))
    robot = str(robot_file("ur_description/urdf/ur10_robot.urdf"))
    common = ("calibrate", robot, "data.csv", "--tip", "tool0", "-o", "out.urdf", "--json", "r.json")
    assert main([*common, "--extend", "gain,compliance", "--report", "r.md"]) == 0
    err = capsys.readouterr().err
    rows = json.loads((tmp_path / "r.json").read_text())["extension"]
    report = (tmp_path / "r.md").read_text()
    for row in rows:
        verdict = "added" if row["is_selected"] else "not selected"
        assert f"| {row['family']} | {verdict} | {row['cv_before']:.3f} | {row['cv_after']:.3f} |" in report
    assert "µrad/Nm" in report
    assert not re.search(r"\b(nan|inf|infinity)\b", report, re.IGNORECASE)
    assert [(row["family"], row["is_selected"]) for row in rows] == [("compliance", True), ("gain", False)]
    assert {"cv_before", "cv_after", "standard_error"} <= set(rows[0])
    assert "compliance_rad_per_nm" in (tmp_path / "out.calibration.toml").read_text()
    assert "gain        not selected" in err
    assert "hint:" not in err
    assert main([*common, "--report", "r.md"]) == 0
    found = json.loads((tmp_path / "r.json").read_text())
    assert found["extension"] == []
    assert FAMILIES["compliance"].description in found["hint"]
    assert f"hint: {found['hint']}" in capsys.readouterr().err
    assert found["hint"][1:] in (tmp_path / "r.md").read_text()
    for wrong, words in (
        (
            ("--extend", "gains"),
            "unknown extension 'gains'; choose from gain, harmonics, compliance, coupling",
        ),
        (("--extend", "auto", "--method", "gn"), "leave out --method gn"),
        (("--extend", "auto", "--priors", "none"), "leave out"),
    ):
        capsys.readouterr()
        assert main([*common, *wrong]) == 2
        assert words in capsys.readouterr().err
