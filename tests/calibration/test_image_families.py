"""Backlash and elasticity of servo arms from photographs: selected where photographs support them."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from camera_setups import ARMS, Setup, exp3, pose_task, simulate, solve_ik
from camera_setups import photograph as take_images
from paper_arms import COMPLIANCE, PLAY, PaperArm, nominal_arm, photograph
from servo_arms import SO101, TIP

from dhcal_pin import read_robot, select_parameters
from dhcal_pin.calibration import Result, calibrate
from dhcal_pin.calibration.cameras.gate import _with_evidence, residual_jitter
from dhcal_pin.calibration.cameras.joint_errors import factor_displacements
from dhcal_pin.calibration.cameras.target_points import with_free_points
from dhcal_pin.calibration.partition import k_fold
from dhcal_pin.calibration.procedure import SessionOption
from dhcal_pin.calibration.reweighting import Fit
from dhcal_pin.estimation.folds import NoisyRows
from dhcal_pin.estimation.initialization import align
from dhcal_pin.estimation.priors import group_default_priors
from dhcal_pin.estimation.problem import Problem, linearize_and_factor
from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.measurements import CameraCorners

pytestmark = pytest.mark.usefixtures("uneventful", "untried", "ordered_axes")


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def calibrated(shot: PaperArm, extend: str = "auto", session: SessionOption = "auto") -> Result:
    turned = ",".join(shot.arm.wrong) or "none"
    return calibrate(shot.nominal, shot.images, turned=turned, extend=extend, session=session)


def tool_errors(shot: PaperArm, fit: Result) -> tuple[float, float]:
    """Held-out errors [m] if the directions of approach are not known, and if they are."""
    state = fit.chain, fit.instruments
    return rms(shot.tool_errors(*state)), rms(shot.tool_errors(*state, is_approach_known=True))


def families(fit: Result) -> set[str]:
    assert fit.extension
    return set(fit.extension.families)


@pytest.fixture(scope="module")
def shot() -> PaperArm:
    """Photographs with directions of an arm with play and sag."""
    return photograph(1, 25).with_approach()


@pytest.fixture(scope="module")
def fit(shot) -> Result:
    return calibrated(shot, session="off")


@pytest.fixture(scope="module")
def plain(shot) -> Result:
    """Calibration without joint errors, which are displacements of the images."""
    return calibrated(shot, "none", "off")


def with_jitter_times(problem: Problem, factor: float) -> Problem:
    """The problem with the displacements of its images times a factor."""
    (images,) = problem.data
    assert isinstance(images, CameraCorners)
    return problem.with_data([images.with_jitter(factor * images.jitter)])


def test_rows_are_those_of_images_with_scaled_displacements(plain):
    problem, x = plain.problem, plain.x
    whole, folds = factor_displacements(problem, x, k_fold(problem.data, 5))
    n_images = problem.data[0].n_images
    assert sum(one.n_rows for one in whole.classes) == 2 * len(problem.data[0].rows)
    assert 4 * n_images < whole.n_scaled <= 6 * n_images
    exact = linearize_and_factor(problem, x, small_angle=False).rows
    rows = whole.at(1.0).rows
    np.testing.assert_allclose(rows.T @ rows, exact.T @ exact, rtol=1e-6, atol=1e-6 * np.abs(exact).max())
    # The shares of the classes stand for displacements within a factor of the square root of two.
    for noise in (0.1, 0.3, 3.0):
        scaled = linearize_and_factor(with_jitter_times(problem, noise), x, small_angle=False)
        assert whole.at(noise).cost == pytest.approx(scaled.cost, rel=0.03)
    for fold in folds:
        both = fold.fitted.at(1.0).merged(fold.held_out)
        assert both.cost < whole.at(1.0).cost
    # The displacements of all folds and the corners are all rows.
    corners = NoisyRows(tuple(one for one in whole.classes if not one.share)).at(1.0).cost
    assert corners + sum(fold.held_out.cost for fold in folds) == pytest.approx(whole.at(1.0).cost)


def test_configurations_of_an_arm_with_play_do_not_count_in_full(plain):
    """The geometry lacks play and sag: the temperature of N configurations is 1 + N/20."""
    assert plain.problem.temperature == 1 + plain.data[0].n_images / 20


@pytest.mark.parametrize("temperature", [1.0, 5.0])
def test_prior_widths_of_the_gate_have_the_greatest_evidence(plain, temperature):
    problem, system, x = plain.problem.at_temperature(1.0), plain.solution.system, plain.x
    errors = problem.errors
    groups = group_default_priors(errors, 1 / errors.priors, np.ones(len(errors.parameters), bool))
    found = _with_evidence(Fit(plain.data, problem, plain.solution, plain.weights), groups, temperature, 1)
    rows, best = system.scaled(temperature**-0.5), found.problem.prior_weights

    def log_evidence(weights):
        """Logarithm of the density of the residuals of the linear model."""
        root = np.abs(np.diag(rows.with_priors(weights, x).r))
        return np.sum(np.log(weights[arm])) - np.sum(np.log(root)) - rows.solve(weights, x)[1] / 2

    arm = [i for group in groups for i in group.members]
    for group, factor in product(groups, (0.8, 1.25)):
        weights = best.copy()
        weights[group.members] *= factor
        assert log_evidence(weights) < log_evidence(best)


def test_corners_that_become_unknowns_have_no_bounds_and_their_priors(plain):
    bounds = np.outer([-1.0, 1.0], 1 + np.abs(plain.x))
    problem = replace(plain.problem, bounds=bounds, temperature=4.0)
    fit = Fit(plain.data, problem, plain.solution, plain.weights)
    freed = with_free_points(fit, [plain.data[0].rig.boards[0].name])
    n_more = len(freed.solution.x) - len(plain.x)
    assert n_more > 0
    expected = np.concatenate([bounds, np.outer([-np.inf, np.inf], np.ones(n_more))], 1)
    np.testing.assert_array_equal(freed.problem.bounds, expected)
    # Their priors are those of boards, at the temperature of the residuals.
    priors = np.array([p.prior for p in freed.problem.parameters[-n_more:]])
    np.testing.assert_allclose(freed.problem.weights[-n_more:], 2 / priors)


def test_play_and_sag_are_selected_and_corrected(shot, plain, fit):
    assert families(fit) == {"backlash", "compliance"}
    values = {p.name: x for p, x in zip(fit.parameters, fit.x, strict=False)}
    play = [value for name, value in values.items() if name.endswith(".backlash")]
    np.testing.assert_allclose(play, np.deg2rad(PLAY), atol=np.deg2rad(0.15))
    assert values["shoulder_lift.compliance"] == pytest.approx(-COMPLIANCE, rel=0.5)
    unknown, known = tool_errors(shot, fit)
    before, _ = tool_errors(shot, plain)
    assert known < 0.3 * before
    assert unknown < 1.1 * before
    # The accuracy holds for stated directions, and without them for the URDF alone.
    inside = fit.generalization.cross_validated
    assert inside
    assert inside.after_alone
    assert 0.7 < inside.after.groups["board"].rms / known < 2.0
    assert 0.6 < inside.after_alone.groups["board"].rms / unknown < 1.5
    # Hardly more than the resolution of the counts is left to the joints.
    left = residual_jitter(Fit(fit.data, fit.problem, fit.solution, fit.weights))
    assert left.joints < np.deg2rad(0.1)


def test_arms_without_play_and_sag_keep_the_geometry():
    shot = photograph(7, 25, play=0.0, compliance=0.0).with_approach()
    fit = calibrated(shot, session="off")
    assert not families(fit)
    assert fit.extension
    assert {trial.family for trial in fit.extension.trials} == {"backlash", "compliance", "gain"}
    assert tool_errors(shot, fit)[0] < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("play", "compliance", "is_approach_known", "shares", "max_ratio"),
    [
        (PLAY, COMPLIANCE, True, {"backlash": (0.95, 1), "compliance": (0.95, 1)}, 0.3),
        (PLAY, COMPLIANCE, False, {"backlash": (0, 0), "compliance": (0.05, 0.8)}, 1.0),
        (0.0, 0.0, True, {"backlash": (0, 0.03), "compliance": (0, 0.03)}, 1.05),
        (PLAY, 0.0, False, {"backlash": (0, 0), "compliance": (0, 0.03)}, 1.05),
    ],
)
def test_shares_of_arms_for_which_families_are_selected(
    play, compliance, is_approach_known, shares, max_ratio
):
    found, ratios = [], []
    for seed in range(500, 540):
        shot = photograph(seed, 25, play=play, compliance=compliance)
        shot = shot.with_approach() if is_approach_known else shot
        fit = calibrated(shot)
        found.append(families(fit))
        if found[-1]:
            before, after = (tool_errors(shot, each) for each in (calibrated(shot, "none"), fit))
            ratios.append(after[int(is_approach_known)] / before[0])
            nominal = rms(shot.tool_errors(fit.nominal_refitted, fit.nominal_instruments))
            assert after[0] < nominal, seed
    print(found, ratios)
    for family, (low, high) in shares.items():
        assert low <= np.mean([family in each for each in found]) <= high, family
    if ratios:
        assert np.exp(np.mean(np.log(ratios))) < max_ratio


def photographs_of_an_elastic_arm(seed: int) -> tuple[Setup, CameraCorners]:
    """Photographs of one board by a UR10, 1 mm wrong and elastic, in several of its configurations."""
    rng, nominal = np.random.default_rng(seed), ARMS["ur10"]()
    errors = select_parameters(nominal, "placement,compliance")
    sizes = {"m": 1e-3, "rad": 3e-3}
    std = [4e-5 if p.name.endswith("compliance") else sizes[p.unit] for p in errors.parameters]
    x = np.array(std) * rng.standard_normal(len(std))
    truth = errors.at(np.where([p.name.endswith("compliance") for p in errors.parameters], -np.abs(x), x))
    setup = simulate(nominal, truth, rng, is_on_wrist=True, n_images=5, sigma=0.2, intrinsics_error=0.01)
    count = 400
    targets = np.repeat(truth.poses(setup.images.q.mean(0)[None]), count, 0)
    targets[:, :3, 3] += rng.uniform(-0.1, 0.1, (count, 3))
    turns = np.array([exp3(angle) for angle in rng.uniform(-0.5, 0.5, (count, 3))])
    targets[:, :3, :3] = targets[:, :3, :3] @ turns
    start = rng.uniform(-np.pi, np.pi, (count, nominal.n_joints))
    q, errors_of_q = solve_ik(truth, pose_task(targets, 0.3), start)
    return setup, take_images(setup, q[errors_of_q < 1e-6], rng, 45)


def test_an_elastic_arm_is_estimated_where_its_geometry_alone_explains_too_little():
    """Without elasticity, left-out parts of joint space are predicted hardly better than nominally."""
    setup, images = photographs_of_an_elastic_arm(3)
    geometry, fit = (calibrate(setup.nominal, images, extend=e, session="off") for e in ("none", "auto"))
    assert (geometry.verdict.status, fit.verdict.status) == ("caution", "ok")
    assert families(fit) == {"compliance"}
    assert [stage.is_kept for stage in (geometry.camera_stages[-1], fit.camera_stages[-1])] == [False, True]
    true = setup.truth.poses(images.q)[:, :3, 3]
    nominal, after = (align(c.poses(images.q)[:, :3, 3], true)[1] for c in (setup.nominal, fit.chain))
    assert after < 0.05 * nominal


def test_priors_of_low_cost_arms_are_wider():
    low_cost, other = nominal_arm(), read_robot(SO101, tip=TIP)
    for sets, expected in (("backlash", np.deg2rad(0.5)), ("compliance", 1e-2)):
        wide, narrow = (select_parameters(arm, sets).priors for arm in (low_cost, other))
        assert np.all(wide == expected)
        assert np.all(narrow < 0.5 * wide)


def test_families_that_images_do_not_show_are_refused(shot):
    with pytest.raises(InvalidArgumentError, match="only compliance, backlash and gain are selected"):
        calibrate(shot.nominal, shot.images, turned="none", extend="coupling")
    with pytest.raises(InvalidArgumentError, match="'backlash' needs the direction"):
        calibrate(shot.nominal, shot.images.replace(recorded=None), turned="none", extend="backlash")
