"""Model selection: families of joint errors are added only if the measurements support them."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from robots import UR10, nominal_arm
from slow_cases import some_slow

from dhcal_pin.calibration import Extension, calibrate
from dhcal_pin.calibration.model_selection import (
    MAX_HINT_SAMPLES,
    families_by_stage,
    family_hint,
    is_restricted,
    trial_table,
)
from dhcal_pin.cli.main import main
from dhcal_pin.cli.screens.calibration_screen import _robot_lines
from dhcal_pin.estimation import select_parameters
from dhcal_pin.estimation.parameters import EXTENSIONS
from dhcal_pin.exceptions import InvalidArgumentError, UnknownNameError
from dhcal_pin.identifiability.residual_correlation import design_effect
from dhcal_pin.io import measurement_text
from dhcal_pin.measurements import Measurement, Noise, Pose, Position
from dhcal_pin.robot import Chain, Conditions
from dhcal_pin.robot.error_families import FAMILIES, ErrorFamily

pytestmark = pytest.mark.usefixtures("unsuspected")


def hint(fit) -> str:
    return family_hint(fit.problem, fit.x, fit.weights)


def simulated(
    sets: str, seed: int, m: int = 60, noise: float = 1e-4, kind: type[Measurement] = Pose
) -> tuple[Chain, Measurement]:
    """Simulate measurements of a UR10 whose errors have the size of their priors."""
    rng = np.random.default_rng(seed)
    arm = nominal_arm("ur10")
    errors = select_parameters(arm, sets)
    truth = errors.at(
        rng.normal(size=len(errors.parameters)) * np.minimum(errors.priors, 0.1)
    ).with_current_loads()
    return arm, kind.simulate(truth, rng.uniform(-2.5, 2.5, (m, 6)), Noise(noise, noise), rng)


@pytest.mark.parametrize("family", ["gain", "harmonics", "compliance", "coupling"])
def test_hint_names_the_missing_family_and_its_effect(family):
    arm, data = simulated(f"{family},minimal,base,tool", seed=1)
    plain = calibrate(arm, data, "minimal,base,tool", extend="none")
    found = re.fullmatch(
        r"residuals vary .* \((.*)\?\); --extend auto may reduce them by about (\d+) %", hint(plain)
    )
    assert found
    assert found[1] == FAMILIES[family].description
    whole = calibrate(arm, data, f"{family},minimal,base,tool", extend="none")
    rms = [np.sqrt(fit.solution.system.cost / (360 - fit.rank)) for fit in (plain, whole)]
    assert 100 - float(found[2]) == pytest.approx(100 * rms[1] / rms[0], abs=2, rel=0.3)
    assert not hint(whole)


@pytest.mark.parametrize("seeds", some_slow([6, 300], {0}))
@pytest.mark.parametrize("kind", [Pose, Position])
def test_geometric_errors_alone_give_no_hint(kind, seeds):
    """Chance gives a hint once in a million, whether or not standard deviations are stated."""
    for seed in range(seeds):
        arm, data = simulated("minimal,base,tool", seed, (20, 40, 80)[seed % 3], kind=kind)
        data = data.replace(has_stated_sigma=bool(seed % 2))
        assert not hint(calibrate(arm, data, "minimal,base,tool", extend="none"))


def test_hint_uses_a_part_of_many_samples():
    arm, data = simulated("harmonics,minimal,base,tool", seed=0, m=3 * MAX_HINT_SAMPLES + 1)
    assert FAMILIES["harmonics"].description in hint(calibrate(arm, data, "minimal,base,tool", extend="none"))


@pytest.mark.parametrize("seed", some_slow(range(2), {0}))
def test_geometric_errors_alone_are_fitted_as_without_extension(seed):
    """Without a supported family and with white residuals, the result is that of the geometry, bit by bit."""
    arm, data = simulated("minimal,base,tool", seed)
    fit, geometry = calibrate(arm, data), calibrate(arm, data, extend="none")
    assert fit.extension is not None
    assert fit.extension.families == ()
    # Curves are tried only if they stand out of the residuals, those of high order only on top of others.
    # Backlash and thermal growth need conditions that these data do not state.
    untried = {"curves", "fine-curves", "backlash", "thermal"}
    assert {trial.family for trial in fit.extension.trials} - {"curves"} == set(EXTENSIONS) - untried
    assert fit.extension.temperature == 1
    assert np.array_equal(fit.x, geometry.x)
    assert np.array_equal(fit.std, geometry.std)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Pose, Position])
def test_hardly_a_family_is_added_to_200_robots_with_geometric_errors(kind):
    """The default costs at most 3 % in the median and 20 % at the 90th percentile; curves in at most 2 %."""
    ratios, n_curves = [], 0
    for seed in range(200):
        m, noise = (20, 40, 60, 100)[seed % 4], (3e-5, 1e-4)[seed // 4 % 2]
        arm, data = simulated("minimal,base,tool", 100 + seed, m, noise, kind)
        _, more = simulated("minimal,base,tool", 100 + seed, 200, 1e-9, kind)
        fit, geometry = calibrate(arm, data), calibrate(arm, data, extend="none")
        rms = [one.validate(more)["position_rms_m"] for one in (fit, geometry)]
        ratios.append(rms[0] / rms[1])
        n_curves += "curves" in (fit.extension.families if fit.extension else ())
    assert np.median(ratios) <= 1.03
    assert np.quantile(ratios, 0.9) <= 1.2
    assert n_curves <= 4


@pytest.mark.parametrize("family", some_slow(["compliance", "harmonics", "gain"], {0, 1}))
def test_simulated_family_is_added(family):
    arm, data = simulated(f"minimal,base,tool,{family}", 3)
    fit, plain = (calibrate(arm, data, extend=each) for each in (None, "none"))
    assert fit.extension is not None
    assert family in fit.extension.families
    one = next(trial for trial in fit.extension.trials if trial.family == family)
    assert one.cv_after < one.cv_before
    _, more = simulated(f"minimal,base,tool,{family}", 3, m=200)
    assert fit.validate(more)["position_rms_m"] < 0.5 * plain.validate(more)["position_rms_m"]


@pytest.mark.parametrize("seed", some_slow(list(range(6)), {0, 1}))
def test_outliers_that_joint_errors_hide_do_not_hide_other_families(seed):
    """The sag of the joints is as large as the outliers; backlash and growth of links are smaller."""
    rng = np.random.default_rng(seed)
    arm = nominal_arm("ur10")
    errors = select_parameters(arm, "minimal,base,tool,compliance,backlash,thermal")
    sizes = {"compliance": 3e-5, "backlash": 4e-4, "thermal": 2e-5}
    widths = np.minimum(errors.priors, 0.1)
    values = rng.normal(size=len(widths)) * widths
    for family, size in sizes.items():
        names = {p.name for p in select_parameters(arm, family).parameters}
        own = np.array([p.name in names for p in errors.parameters])
        values[own] = size * rng.uniform(0.5, 1.5, own.sum())
    truth = errors.at(values).with_current_loads()

    def measured(m: int, noise: float) -> Position:
        q = rng.uniform(-2.5, 2.5, (m, 6))
        conditions = Conditions(
            q, approach=rng.choice([-1.0, 1.0], q.shape), temperature=rng.uniform(18, 32, m)
        )
        return Position.simulate(truth, conditions, Noise(noise), rng)

    data, more = measured(105, 5e-5), measured(200, 1e-9)
    wrong, errors_of_them = data.values.copy(), rng.normal(size=(3, 3))
    wrong[[10, 50, 90]] += 5e-3 * errors_of_them / np.linalg.norm(errors_of_them, axis=1, keepdims=True)
    fit, clean = calibrate(arm, data.replace(values=wrong)), calibrate(arm, data)
    assert fit.extension is not None
    assert {"compliance", "backlash", "thermal"} <= set(fit.extension.supported)
    outliers = set(np.flatnonzero(fit.weights[0] < 0.5))
    # One good sample in four thousand is rejected beside them.
    assert outliers >= {10, 50, 90}
    assert len(outliers) <= 4
    rms = [one.validate(more)["position_rms_m"] for one in (fit, clean)]
    assert rms[0] < 1.3 * rms[1]


@pytest.mark.parametrize(
    ("order", "seed"),
    some_slow([(order, seed) for order in ("mixed", "halves") for seed in range(4)], {0, 4}),
)
def test_samples_approached_from_the_other_side_are_no_outliers(order, seed):
    """All joints come from one side or from the other: half of the samples agree without backlash."""
    rng = np.random.default_rng(seed)
    arm = nominal_arm("ur10")
    errors = select_parameters(arm, "minimal,base,tool,backlash")
    names = {p.name for p in select_parameters(arm, "backlash").parameters}
    own = np.array([p.name in names for p in errors.parameters])
    values = rng.normal(size=len(own)) * np.minimum(errors.priors, 0.1)
    values[own] = rng.uniform(3e-4, 8e-4, own.sum())
    truth = errors.at(values)

    def measured(m: int, noise: float, sides: np.ndarray) -> Position:
        conditions = Conditions(rng.uniform(-2.5, 2.5, (m, 6)), approach=np.tile(sides[:, None], 6))
        return Position.simulate(truth, conditions, Noise(noise), rng)

    sides = rng.choice([-1.0, 1.0], 70) if order == "mixed" else np.repeat([-1.0, 1.0], 35)
    data = measured(70, 5e-5, sides)
    fit = calibrate(arm, data)
    assert fit.extension is not None
    assert "backlash" in fit.extension.supported
    assert fit.n_outliers == 0
    assert fit.verdict.status == "ok"
    assert data.recorded is not None
    assert data.recorded.approach is not None
    turned = data.recorded.approach * np.where(np.arange(6) == 1, -1, 1)
    reversed_fit = calibrate(arm, data.replace(recorded=replace(data.recorded, approach=turned)))
    assert reversed_fit.verdict.status == "caution"
    (reason,) = (text for text in reversed_fit.verdict.reasons if "shoulder_lift_joint is negative" in text)
    assert "approach_JOINT" in reason
    assert "the order of the rows, which must be that of measurement" in reason
    more = measured(200, 1e-9, rng.choice([-1.0, 1.0], 200))
    assert fit.validate(more)["position_rms_m"] < 1e-4


@pytest.mark.parametrize(("family", "other"), [("compliance", "harmonics"), ("harmonics", "compliance")])
def test_a_family_that_is_added_with_another_is_told_from_a_supported_one(family, other):
    arm, data = simulated(f"minimal,base,tool,{family}", 3)
    fit = calibrate(arm, data)
    assert fit.extension is not None
    assert fit.extension.families == (family, other)
    assert fit.extension.supported == (family,)
    verdicts = {row[0]: row[1] for row in trial_table(fit.extension.trials).rows}
    assert (verdicts[family], verdicts[other]) == ("added", "added, not supported")
    assert f"{other} (not supported, prior width" in fit.extension.sentences[0]
    [_, line] = _robot_lines(fit, "ur10.urdf", "minimal,base,tool")
    assert line.endswith(f"joint errors added: {family} (and {other}, shrunk by priors)")


def with_curves(seed: int, m: int, noise: float = 5e-5) -> tuple[Chain, Chain, Pose]:
    """Simulate a UR10 with geometric errors, elastic joints and lines up to the 30th harmonic."""
    rng = np.random.default_rng(seed)
    arm = nominal_arm("ur10")
    errors = select_parameters(arm, "minimal,base,tool,compliance,harmonics,curves")
    size = np.minimum(errors.priors, 0.1)
    order = np.array([int(re.sub(r"\D", "", p.name.split(".")[1]) or 0) for p in errors.parameters])
    is_line = rng.uniform(size=len(order)) < 0.2
    size[order > 0] = np.where(is_line, 1e-4, 1e-5)[order > 0]
    size[order > 30] = 0
    size[[p.unit == "rad/Nm" for p in errors.parameters]] = 2e-5
    truth = errors.at(rng.normal(size=len(order)) * size).with_current_loads()
    q = rng.uniform(-2.5, 2.5, (m, 6))
    return arm, truth, Pose.simulate(truth, q, Noise(noise, 2 * noise), rng)


def joint_errors(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the errors of the joints at commanded positions q, shape (n, m)."""
    return chain.actual_positions(Conditions(q))[0] - q.T


@pytest.mark.parametrize("has_fine_lines", some_slow([True, False], {1}))
def test_curves_of_high_order_have_a_prior_width_of_their_own(has_fine_lines):
    """Lines of order 40 and 55 that are a fifth of those of low order; without them their curves stay out."""
    arm, truth, data = with_curves(0, 220)
    if has_fine_lines:
        errors = select_parameters(truth, "fine-curves")
        is_line = [p.name.endswith(("sin40", "cos55")) for p in errors.parameters]
        truth = errors.at(2e-5 * np.array(is_line))
        data = Pose.simulate(truth, data.q, Noise(2e-5, 4e-5), np.random.default_rng(0))
    fit = calibrate(arm, data, session="off")
    assert fit.extension is not None
    assert ("fine-curves" in fit.extension.families) == has_fine_lines
    if has_fine_lines:
        widths = {trial.family: trial.prior_width for trial in fit.extension.trials}
        assert widths["fine-curves"] < 0.3 * widths["curves"]
        without = calibrate(arm, data, extend="harmonics,compliance,curves", session="off")
        q = np.random.default_rng(1).uniform(-2.5, 2.5, (300, 6))
        offsets = [one.chain.poses(q)[:, :3, 3] - truth.poses(q)[:, :3, 3] for one in (fit, without)]
        assert np.std(offsets[0]) < 0.9 * np.std(offsets[1])


@pytest.mark.parametrize("kind", [Pose, Position])
def test_curves_are_found_in_few_samples(kind):
    """Forty samples have fewer rows than there are lines, and show curves of a tenth of a millimetre."""
    arm, truth, data = with_curves(0, 40)
    data = kind.simulate(truth, data.q, Noise(2e-5, 4e-5), np.random.default_rng(0))
    fit = calibrate(arm, data)
    assert fit.extension is not None
    assert "curves" in fit.extension.families


@pytest.mark.parametrize("seeds", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_recovered_curves_are_within_their_bands(seeds):
    """Differences of the error of a joint between visited positions: 95 % lie within their 95 % interval."""
    inside = []
    for seed in range(seeds):
        arm, truth, data = with_curves(seed, 200)
        fit = calibrate(arm, data, "minimal,base,tool")
        assert fit.extension is not None
        assert {"curves", "compliance"} <= set(fit.extension.families)
        assert "fine-curves" not in fit.extension.families
        assert fit.extension.temperature == 1
        # Positions of the tool depend on the curves of all joints; frames and geometry are part of it.
        q = data.q[np.random.default_rng(seed).permutation(len(data.q))[:100]]
        prediction = fit.predict(q)
        error = truth.poses(q)[:, :3, 3] - prediction.poses[:, :3, 3]
        std = np.sqrt(np.einsum("mii->mi", prediction.covariance)[:, :3])
        inside.append(np.mean(np.abs(error) < 1.96 * std))
    assert 0.93 <= np.mean(inside) <= 0.97 if seeds > 1 else np.mean(inside) > 0.85


def test_residuals_that_are_errors_of_the_model_raise_the_temperature():
    """An error that no family has, equal in neighbouring configurations, is not independent noise."""
    arm, _, data = with_curves(0, 300)
    rng = np.random.default_rng(1)
    centres, offsets = rng.uniform(-2.5, 2.5, (40, 6)), rng.normal(0, 5e-4, (40, 3))
    distance = np.linalg.norm(data.q[:, None] - centres, axis=2)
    poses = data.poses.copy()
    poses[:, :3, 3] += np.exp(-0.5 * (distance / 1.5) ** 2) @ offsets
    fit = calibrate(arm, data.replace(poses=poses), "minimal,base,tool")
    assert fit.extension is not None
    temperature = design_effect(data.q, arm.is_prismatic)
    assert temperature > 2
    assert fit.extension.temperature == temperature
    assert fit.extension.effective_samples == pytest.approx(300 / temperature)
    assert fit.problem.temperature == temperature
    assert np.allclose(fit.problem.prior_weights * np.sqrt(temperature), fit.problem.weights)


def extension_of(arm: Chain, data: Measurement, extend: str | list[str] | None = None) -> Extension:
    """Return what a calibration adds."""
    extension = calibrate(arm, data, extend=extend).extension
    assert extension is not None
    return extension


def test_extension_can_be_restricted_and_is_off_where_it_makes_no_sense():
    arm, data = simulated("minimal,base,tool,compliance", 4)
    assert set(extension_of(arm, data, "harmonics,compliance").families) == {"compliance", "harmonics"}
    assert extension_of(arm, data, ["gain"]).families in ((), ("gain",))
    assert calibrate(arm, data, extend="none").extension is None
    assert calibrate(arm, data, "base,tool").extension is None
    assert calibrate(arm, data, priors="none").extension is None
    with pytest.raises(UnknownNameError, match="unknown extension 'gains'"):
        calibrate(arm, data, extend="gains")
    with pytest.raises(InvalidArgumentError, match="leave out --method gn"):
        calibrate(arm, data, extend="gain", method="gn")
    with pytest.raises(InvalidArgumentError, match="leave out --method gn"):
        calibrate(arm, data, extend="gain", priors="none")


def test_command_reports_the_extension(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arm, data = simulated("minimal,base,tool,compliance", 4)
    (tmp_path / "data.csv").write_text(measurement_text(data, arm, []))
    robot = str(UR10)
    common = ("calibrate", robot, "data.csv", "--tip", "tool0", "-o", "out.urdf", "--json", "r.json")
    assert main([*common, "--extend", "gain,compliance", "--report", "r.md"]) == 0
    found = json.loads((tmp_path / "r.json").read_text())["extension"]
    report = (tmp_path / "r.md").read_text()
    assert found["families"] == ["compliance"]
    assert (found["temperature"], found["effective_samples"]) == (1, 60)
    assert found["random_ratio"] < 0.9
    assert [trial["family"] for trial in found["trials"]] == ["compliance", "gain"]
    assert "| compliance | added |" in report
    assert "Added to the geometry: compliance (prior width" in report
    assert "60 configurations count as 60 independent ones" in report
    assert "compliance_rad_per_nm" in (tmp_path / "out.calibration.toml").read_text()
    assert main([*common, "--extend", "none", "--report", "r.md"]) == 0
    found = json.loads((tmp_path / "r.json").read_text())
    assert found["extension"] is None
    assert FAMILIES["compliance"].description in found["hint"]
    assert found["hint"][1:] in (tmp_path / "r.md").read_text()
    capsys.readouterr()
    assert main([*common, "--extend", "gains"]) == 2
    assert "unknown extension 'gains'; choose from gain, harmonics" in capsys.readouterr().err


def test_a_family_needs_a_rule_of_selection():
    """Without a rule it would never be selected, and nothing would say so."""
    with pytest.raises(TypeError, match="rule"):
        ErrorFamily("backdrive", "errors of a test", "a moving joint")  # pyright: ignore[reportCallIssue]
    first, second = ("harmonics", "compliance", "backlash", "thermal"), ("gain", "coupling")
    # Curves are tried one after the other, on top of those of lower order.
    assert families_by_stage(FAMILIES) == [first, second, ("curves",), ("fine-curves",)]


@pytest.mark.parametrize(
    ("sets", "expected"),
    [
        ("minimal,base,tool", False),
        ("placement,offset,camera,board,intrinsics", False),
        ("base,tool", False),
        ("offset,base,tool", True),
        ("minimal,camera", True),
        ("camera,board", True),
    ],
)
def test_sets_with_fewer_errors_than_the_full_set(sets, expected):
    assert is_restricted(sets.split(",")) == expected
