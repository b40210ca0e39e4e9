"""Cross-validation against real refits, and families added only where the data ask for them."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from robots import paper, robot_file

from dhcal_pin.calibration.cross_validation import cross_validate, standard_error
from dhcal_pin.calibration.evaluation import accuracy
from dhcal_pin.calibration.model_selection import MAX_HINT_SAMPLES, extend, family_hint
from dhcal_pin.calibration.partition import k_fold
from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.cli.main import main
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.estimation.solver import levenberg_marquardt
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io.measurement_csv import measurement_text
from dhcal_pin.measurements.base import Measurement, Noise
from dhcal_pin.measurements.contact import PointContact
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.measurements.position import Position
from dhcal_pin.robot.chain import Chain
from dhcal_pin.robot.error_families import FAMILIES


def simulated(sets: str, seed: int, m: int = 60, noise: float = 1e-4, kind=Pose):
    """A UR10 with errors of the size of the priors, and what is measured of it."""
    rng = np.random.default_rng(seed)
    arm = Chain.from_urdf(robot_file("ur_description/urdf/ur10_robot.urdf"), "tool0")
    errors = select_parameters(arm, sets)
    truth = errors.at(
        rng.normal(size=len(errors.parameters)) * np.minimum(errors.priors, 0.1)
    ).with_current_loads()
    return arm, kind.simulate(truth, rng.uniform(-2.5, 2.5, (m, 6)), Noise(noise, noise), rng)


def fitted(kind: type[Measurement] = Position, m: int = 40):
    arm = Chain.from_dh(paper("sim_6dof"))
    rng = np.random.default_rng(0)
    data = kind.simulate(
        Chain.from_dh(paper("sim_6dof_actual")), rng.uniform(-1, 1, (m, 6)), Noise(1e-4, 1e-4), rng
    )
    return calibrate(arm, data, "dh")


@pytest.mark.parametrize("family", ["gain", "harmonics", "compliance", "coupling"])
def test_a_hint_names_what_is_missing_and_how_much_it_takes_up(family):
    arm, data = simulated(f"{family},minimal,base,tool", seed=1)
    plain = calibrate(arm, data, "minimal,base,tool")
    found = re.fullmatch(
        r"residuals vary .* \((.*)\?\); --extend auto may reduce them by about (\d+) %", family_hint(plain)
    )
    assert found
    assert found[1] == FAMILIES[family].description
    whole = calibrate(arm, data, f"{family},minimal,base,tool")
    left = [np.sqrt(fit.solution.system.cost / (360 - fit.rank)) for fit in (plain, whole)]
    assert 100 - float(found[2]) == pytest.approx(100 * left[1] / left[0], abs=2, rel=0.3)
    assert not family_hint(whole)


@pytest.mark.parametrize("seeds", [20, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", [Pose, Position])
def test_geometry_alone_gives_no_hint(kind, seeds):
    """One false one in a million by chance, whether or not the instrument states its sigmas."""
    for seed in range(seeds):
        arm, data = simulated("minimal,base,tool", seed, (20, 40, 80)[seed % 3], kind=kind)
        data = data.replace(has_stated_sigma=bool(seed % 2))
        assert not family_hint(calibrate(arm, data, "minimal,base,tool"))


def test_a_hint_looks_at_some_of_many_samples():
    arm, data = simulated("harmonics,minimal,base,tool", seed=0, m=3 * MAX_HINT_SAMPLES + 1)
    assert FAMILIES["harmonics"].description in family_hint(calibrate(arm, data, "minimal,base,tool"))


def test_folds_equal_fits_without_what_they_leave_out():
    fit = fitted(Pose)
    folds = k_fold(fit.data, 4, seed=1)
    found = cross_validate(fit, folds)
    for fold, judged, error in zip(folds, found.folds, found.errors, strict=True):
        kept = replace(
            fit.problem, data=tuple(d.take(~m) for d, m in zip(fit.problem.data, fold, strict=True))
        )
        x = levenberg_marquardt(kept, np.zeros(len(fit.x)), 100, None).x
        left = [d.take(m) for d, m in zip(fit.problem.data, fold, strict=True)]
        chain = fit.errors.at(x)
        assert judged["position_rms_m"] == pytest.approx(accuracy(chain, left)["position_rms_m"], rel=2e-3)
        rows = left[0].residual(chain.forward_kinematics(left[0].q), np.empty(0))
        assert error == pytest.approx(np.sqrt(np.mean(rows**2)), rel=2e-3)
    counts = [fold["position_samples"] for fold in found.folds]
    whole = np.sqrt(np.average([fold["position_rms_m"] ** 2 for fold in found.folds], weights=counts))
    assert found.accuracy["position_rms_m"] == pytest.approx(whole)
    assert whole > 1.1 * fit.validate(fit.data)["position_rms_m"]


def test_folds_of_other_data_are_refused():
    with pytest.raises(DhcalError, match="made for other data"):
        cross_validate(fitted(m=30), k_fold(fitted().data, 5))


def test_few_folds_must_agree_more():
    """Student's t that a normal deviate passes one sigma as often: 1.84 for two folds, 1.32 for three."""
    assert standard_error(np.array([0.0, 1.0])) == pytest.approx(0.5 * 1.837, rel=1e-3)
    assert standard_error(np.array([0.0, 1.0, 2.0])) == pytest.approx(1.321 / np.sqrt(3), rel=1e-3)
    assert standard_error(np.array([1.0])) == np.inf


def test_a_point_that_only_left_out_samples_touch_is_fitted_to_them():
    fit = fitted(PointContact, 60)
    groups = [item.kind for item in fit.data]
    assert groups == ["point"]
    found = cross_validate(fit)
    assert found.accuracy["position_rms_m"] < 0.05


@pytest.mark.parametrize("seed", range(2))
def test_nothing_is_added_to_an_arm_without(seed):
    _, trials = extend(*simulated("minimal,base,tool", seed))
    assert len(trials) == 4
    assert not [trial.family for trial in trials if trial.is_selected]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Pose, Position])
def test_nothing_is_added_to_two_hundred_arms_without(kind):
    added = 0
    for seed in range(200):
        m = (30, 60, 120)[seed % 3]
        _, trials = extend(*simulated("minimal,base,tool", 100 + seed, m, kind=kind))
        added += any(trial.is_selected for trial in trials)
    assert added <= 10


@pytest.mark.parametrize("family", ["compliance", "harmonics"])
def test_what_is_there_is_added(family):
    arm, data = simulated(f"minimal,base,tool,{family}", 3)
    fit, trials = extend(arm, data)
    assert next(trial.family for trial in trials if trial.is_selected) == family
    one = trials[0]
    assert one.cv_after < one.cv_before - one.standard_error
    plain = calibrate(arm, data)
    _, more = simulated(f"minimal,base,tool,{family}", 3, m=200)
    assert fit.validate(more)["position_rms_m"] < 0.5 * plain.validate(more)["position_rms_m"]


def test_the_command_says_what_each_family_brought(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arm, data = simulated("minimal,base,tool,compliance", 4)
    (tmp_path / "data.csv").write_text(measurement_text(data, arm, []))
    robot = str(robot_file("ur_description/urdf/ur10_robot.urdf"))
    common = ("calibrate", robot, "data.csv", "--tip", "tool0", "-o", "out.urdf", "--json", "r.json")
    assert main([*common, "--extend", "gain,compliance", "--report", "r.md"]) == 0
    said = capsys.readouterr().err
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
    assert "gain        not selected" in said
    assert "hint:" not in said
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
