"""Gate of images: whether the arm is estimated, at which temperature, and what the stages say."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from camera_setups import ARMS, placement_fit, simulate, wrong_arm
from scipy.stats import chi2, norm

from dhcal_pin import Chain, select_parameters
from dhcal_pin.calibration.cameras import gate, jitter, joint_errors, target_points
from dhcal_pin.calibration.cameras.arm_types import ARM_TYPES, INDUSTRIAL
from dhcal_pin.calibration.cameras.gate import (
    Gate,
    GatedFit,
    apply_gate,
    cluster_folds,
    judge_stages,
    judge_target_points,
    without_arm,
)
from dhcal_pin.calibration.cameras.jitter import Jitter, estimate_jitter
from dhcal_pin.calibration.cameras.stages import (
    ImageError,
    Stage,
    fitted_error,
    held_out_error,
    held_out_prediction_std,
)
from dhcal_pin.calibration.cameras.target_points import TargetPoints, judged_boards
from dhcal_pin.calibration.model_selection import FamilyTrial
from dhcal_pin.calibration.partition import k_fold
from dhcal_pin.calibration.reweighting import Fit
from dhcal_pin.cameras import Board
from dhcal_pin.estimation.initialization import make_problem
from dhcal_pin.estimation.parameters import LOW_COST
from dhcal_pin.estimation.solver import minimize
from dhcal_pin.measurements import KINDS, CameraCorners, Noise, Pose
from dhcal_pin.measurements.base import errors_of


@pytest.fixture(scope="module")
def right() -> Fit:
    """Twelve images of a right arm."""
    return placement_fit(0.0, 12, 0)


@pytest.fixture(scope="module")
def wrong() -> Fit:
    """Twelve images of an arm that is wrong by 3 mm."""
    return placement_fit(3e-3, 12, 0)


@pytest.fixture(scope="module")
def displaced(wrong) -> GatedFit:
    return apply_gate(wrong, (), 40, INDUSTRIAL)


KEPT = "The nominal arm is kept, as the images do not show that the arm is wrong:"
SHOWN = "The arm is demonstrably wrong: estimating it changes the error of left-out parts of joint space to"


@pytest.mark.parametrize(
    ("changes", "is_open", "sentence"),
    [
        ({"ratio": 0.49}, True, f"{SHOWN} 49 %."),
        ({"ratio": 0.25, "is_complete": False}, False, "to 25 %, not below 25 %."),
        ({"ratio": 0.049, "is_complete": False}, True, f"{SHOWN} 4.9 %."),
        ({"ratio": 0.79, "is_complete": False, "arm_type": ARM_TYPES[LOW_COST]}, True, f"{SHOWN} 79 %."),
        ({"is_right": True, "n_configurations": 5}, False, f"{KEPT} the noise of the corners explains them"),
        ({"is_right": True, "n_configurations": 4, "ratio": np.nan}, False,
         f"{KEPT} 4 configurations are too few to leave out parts of joint space; expected at least 10."),
        ({"ratio": np.nan}, False, f"{KEPT} 20 configurations are too few"),
        ({"is_right": True, "ratio": 0.9, "others_ratio": 0.79}, True, f"{SHOWN} 79 % for the measurements"),
        ({"ratio": 0.9, "others_ratio": 0.8}, False, "to 90 %, not below 50 %."),
    ],
)  # fmt: skip
def test_the_gate_says_why_it_is_open_or_closed(changes, is_open, sentence):
    given = {"ratio": 0.1, "temperature": 1.0, "n_configurations": 20, "is_right": False, "is_complete": True}
    found = Gate(**given | changes)  # type: ignore[arg-type]
    assert found.is_open == is_open
    assert sentence in found.sentence


def test_noise_explains_images_of_a_right_arm(right):
    gated = apply_gate(right, (), 40, INDUSTRIAL)
    assert gated.gate.is_right
    assert gated.gate.is_complete
    assert not gated.gate.is_open
    assert gated.displaced is None
    assert gated.fit.problem.errors.parameters == ()
    assert gated.fit.problem.temperature == gated.gate.temperature == 1.0
    assert gated.with_arm.problem.temperature == pytest.approx(1 + 12 / 5)
    folds = cluster_folds(right.data)
    errors = [held_out_error(each, folds) for each in (gated.with_arm, gated.nominal)]
    assert errors[0] is not None
    assert errors[1] is not None
    assert gated.gate.ratio == pytest.approx(errors[0].pixels / errors[1].pixels, rel=1e-6)
    assert gated.gate.n_configurations == 12


def test_images_of_a_wrong_arm_open_the_gate(displaced):
    gated = displaced
    assert gated.gate.is_open
    assert not gated.gate.is_right
    assert len(gated.fit.problem.errors.parameters) == 36
    # Twelve configurations leave a displacement that the images share.
    assert not gated.gate.is_complete
    assert gated.fit.problem.temperature == gated.gate.temperature == pytest.approx(1 + 12 / 20)
    assert gated.displaced is not None
    assert all(item.has_jitter for item in gated.displaced.problem.data)  # type: ignore[attr-defined]
    assert gated.fit.iterations > gated.displaced.iterations


@pytest.mark.parametrize(
    ("errors", "ratio", "is_open", "has_jitter"),
    [((1.0, 2.0), 0.2, True, False), ((2.0, 1.0), 0.2, True, True), ((2.0, 1.0), 0.3, False, None)],
)
def test_the_model_of_noise_that_predicts_best_is_taken(
    monkeypatch, wrong, errors, ratio, is_open, has_jitter
):
    """Corners that are displaced by themselves count as many as an image has, at a higher temperature."""
    per_image = 2 * len(wrong.data[0].rows) / (6 * 12)
    given = iter(errors)
    temperatures = []

    def judged(model: Fit, groups: Any, temperature: float, *_: Any) -> Any:
        temperatures.append(temperature)
        return gate._Trial(model, replace(model, stage="closed"), next(given), ratio)

    monkeypatch.setattr(gate, "_trial", judged)
    gated = apply_gate(wrong, (), 40, INDUSTRIAL)
    assert temperatures == pytest.approx([per_image * (1 + 12 / 5), 1 + 12 / 5])
    assert gated.gate.is_open == is_open
    assert gated.displaced is not None
    if is_open:
        assert gated.fit.problem.data[0].has_jitter == has_jitter  # type: ignore[attr-defined]
        assert gated.gate.temperature == pytest.approx((1 if has_jitter else per_image) * (1 + 12 / 20))
        assert gated.fit.problem.temperature == gated.gate.temperature
    else:
        assert gated.fit.problem.errors.parameters == ()
        assert gated.with_arm.stage == "closed"


def test_images_that_determine_the_arm_count_in_full():
    gated = apply_gate(placement_fit(3e-3, 24, 0), (), 40, INDUSTRIAL)
    assert gated.gate.is_open
    assert gated.gate.is_complete
    assert gated.fit.problem.temperature == gated.gate.temperature == 1.0
    # Scatter of the joints that the images do not exclude.
    assert gated.fit.problem.data[0].has_jitter  # type: ignore[attr-defined]


def test_a_calibration_without_errors_of_the_arm_has_nothing_to_open(wrong):
    frames = without_arm(wrong, 40)
    gated = apply_gate(frames, (), 40, INDUSTRIAL)
    assert np.isnan(gated.gate.ratio)
    assert not gated.gate.is_open
    assert not gated.gate.is_right
    assert gated.with_arm is gated.fit
    assert gated.fit.problem.temperature == 1.0
    assert [stage.name for stage in judge_stages(frames, gated, None, 40)] == ["frames", "target points"]
    assert judge_target_points(frames, 40) is None


def test_the_fit_of_a_kept_arm_has_the_noise_that_predicts_best(monkeypatch, wrong):
    fits: Any = ["first", "second"]
    for errors, best in (((2.0, 3.0), 0), ((3.0, 2.0), 1), ((None, None), 1)):
        given = iter(errors)
        monkeypatch.setattr(
            gate, "held_out_error", lambda *_, g=given: (e := next(g)) and ImageError(e, e, 1)
        )
        assert gate._best(fits, ()) == fits[best]


def test_held_unknowns_have_their_first_values(wrong):
    names = [p.name for p in wrong.problem.instrument_parameters]
    held = without_arm(wrong, 40, ("camera",))
    left = [p.name for p in held.problem.instrument_parameters]
    assert left == [name for name in names if name.startswith("board")]
    known = held.problem.instruments(held.solution.x)
    first = {p.name: p.nominal for p in wrong.data[0].instrument_parameters}
    assert [known[name] for name in names[:6]] == [first[name] for name in names[:6]]
    assert held.problem.errors.parameters == ()
    # The poses are those of greatest likelihood for the nominal arm.
    free = without_arm(wrong, 40)
    again = minimize(free.problem, "lm", free.solution.x, 40)
    assert fitted_error(free).pixels == pytest.approx(
        fitted_error(replace(free, solution=again)).pixels, rel=1e-2
    )


@pytest.mark.parametrize(("arm_error", "least", "most"), [(3e-3, 0.0, 0.2), (0.0, 1.0, 3.0)])
def test_the_error_of_other_instruments_is_that_of_left_out_configurations(arm_error, least, most):
    rng, chain = np.random.default_rng(3), ARMS["ur10"]()
    truth = wrong_arm(chain, arm_error, rng)
    images = simulate(chain, truth, rng, is_on_wrist=True, n_images=5, sigma=0.2).images.initialized(chain)
    positions = KINDS["position"].simulate(truth, rng.uniform(-2, 2, (30, 6)), Noise(5e-5), rng)
    errors = select_parameters(chain, "placement")
    problem = make_problem(errors, (images, positions), 1 / errors.priors, {})
    solution = minimize(problem, "lm", None, 40)
    fit = Fit((images, positions), problem, solution, (np.ones(len(images.rows)), np.ones(30)))
    found, n_rows = gate._others_ratio(fit, 40)
    assert n_rows == 3 * len(positions.rows)
    assert least < found < most
    squares = []
    for each in (fit, without_arm(fit, 40)):
        total = 0.0
        for (mask,) in cluster_folds([positions]):
            part = each.problem.with_data([images, positions.take(~mask)])
            x = minimize(part, "lm", each.solution.x, 3).x
            left = each.problem.chain(x).poses(positions.q[mask])[:, :3, 3] - positions.values[mask]
            total += np.sum(left**2)
        squares.append(total)
    assert found == pytest.approx(np.sqrt(squares[0] / squares[1]), rel=0.1)
    assert np.isnan(gate._others_ratio(placement_fit(0.0, 4, 0), 40)[0])


@pytest.mark.parametrize(("count", "has_folds"), [(9, False), (10, True)])
def test_ten_configurations_are_divided_into_clusters(count, has_folds):
    q = np.random.default_rng(0).uniform(-1, 1, (count, 6))
    q[:, 3] = 0.5
    poses = Pose(q, np.tile(np.eye(4), (count, 1, 1)))
    folds = cluster_folds([poses.take(np.arange(4)), poses.take(np.arange(4, count))])
    assert bool(folds) == has_folds
    if has_folds:
        assert [len(part) for part in folds[0]] == [4, count - 4]
        np.testing.assert_array_equal(np.sum([np.concatenate(fold) for fold in folds], 0), 1)


def test_an_image_shows_six_components_of_its_displacement(right):
    count = len(right.data[0].rows)
    assert gate.rows_per_displacement(right.data) == pytest.approx(2 * count / (6 * 12))
    few = right.data[0].take(np.unique(right.data[0].configuration_groups, return_index=True)[1])
    assert gate.rows_per_displacement([few]) == 1.0
    assert gate.temperature(20, 5) == 5.0


def lens_and_points_fit(chain: Chain, images: CameraCorners, **changes: Any) -> Fit:
    """Return a fit of arm, poses, lens and every third corner of a board that is changed."""
    board = images.rig.boards[0]
    board = replace(board, type="points", listed_points=board.points[::3], **changes)
    rig, chosen = replace(images.rig, boards=(board,)), images.corner % 3 == 0
    item = CameraCorners(images.q[chosen], images.values[chosen], images.corner[chosen] // 3, rig)
    item, errors = item.initialized(chain), select_parameters(chain, "placement")
    problem = make_problem(errors, (item,), 1 / errors.priors, {})
    x = np.concatenate([np.zeros(len(errors.priors)), problem.instrument_start({})])
    return Fit((item,), problem, minimize(problem, "lm", x, 40), (np.ones(len(item.rows)),))


@pytest.mark.parametrize("has_free_points", [False, True])
def test_stages_free_the_lens_before_the_corners_and_the_arm(has_free_points):
    chain, rng = ARMS["ur10"](), np.random.default_rng(5)
    images = simulate(chain, chain, rng, is_on_wrist=True, n_images=11, sigma=0.2).images
    fit = lens_and_points_fit(chain, images, has_free_points=has_free_points)
    gated = apply_gate(fit, (), 40, INDUSTRIAL)
    frames, lens, points, arm = judge_stages(fit, gated, None, 40)
    assert [s.name for s in (frames, lens, points, arm)] == ["frames", "intrinsics", "target points", "arm"]
    n_points = 3 * len(fit.data[0].rig.boards[0].points)  # type: ignore[union-attr]
    counts = [stage.n_unknowns for stage in (frames, lens, points, arm)]
    assert counts == [12, 21, 21 + n_points, 21 + 36 + n_points * has_free_points]
    assert [stage.is_kept for stage in (frames, lens, points, arm)] == [True, True, has_free_points, False]
    for before, after in ((frames, lens), (lens, points)):
        assert before.by_region is not None
        assert after.by_region is not None
        ratio = after.by_region.pixels / before.by_region.pixels
        assert (
            f"changes the error of left-out parts of joint space to {gate.format_ratio(ratio)}."
            in after.reason
        )
    assert lens.reason.startswith("The rig does not fix them. Estimating them")
    start = "The rig leaves them free." if has_free_points else "The rig fixes them;"
    assert points.reason.startswith(start)
    assert arm.reason == gated.gate.sentence
    # Images of a fold lie between fitted ones, and regions do not.
    assert frames.by_image is not None
    assert frames.by_image.pixels == pytest.approx(
        held_out_error(without_arm(fit, 40, ("intrinsics", gate.POINTS_SET)), k_fold(fit.data, 5)).pixels  # type: ignore[union-attr]
    )


def test_a_trial_of_corners_states_why_they_are_estimated_or_held(wrong, displaced):
    judged = TargetPoints(wrong, 0.89, 0.5)
    assert judged.is_kept
    assert judged.sentence == (
        "The corners are not where the rig states them: estimating them with all other unknowns changes the "
        "error of left-out images to 89 %, and that of left-out parts of joint space to 50 %."
    )
    for held in (replace(judged, by_image=0.9), replace(judged, by_region=0.9)):
        assert not held.is_kept
        assert held.sentence.startswith("The corners are kept as stated: ")
        assert held.sentence.endswith(", not both below 90 %.")
    (stage,) = [each for each in judge_stages(wrong, displaced, judged, 40) if each.name == "target points"]
    assert stage.reason == judged.sentence


def test_corners_that_the_rig_leaves_free_or_knows_are_not_tried():
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3))
    boards = [
        Board("a", "tip", "points", listed_points=points),
        Board("b", "tip", "points", listed_points=points, has_free_points=True),
        Board("c", "tip", "points", listed_points=points, has_exact_points=True),
    ]
    assert judged_boards(boards) == ["a"]
    # A board of two files is one board.
    assert judged_boards([*boards, *boards]) == ["a"]
    assert judged_boards([*boards, replace(boards[0], name="d")]) == []


def test_a_trial_of_corners_compares_left_out_images_and_regions(right):
    judged = judge_target_points(right, 40)
    assert judged is not None
    for folds, found in (
        (k_fold(right.data, 5), judged.by_image),
        (cluster_folds(right.data), judged.by_region),
    ):
        before, after = held_out_error(right, folds), held_out_error(judged.fit, folds)
        assert before is not None
        assert after is not None
        assert found == pytest.approx(after.pixels / before.pixels)
    n_points = 3 * len(right.data[0].rig.boards[0].points)  # type: ignore[union-attr]
    assert len(judged.fit.solution.x) == len(right.solution.x) + n_points
    assert judged.fit.iterations == right.iterations + judged.fit.solution.iterations


def test_errors_of_images_are_those_of_corners_that_are_no_outliers(right):
    """The error at the board is that in the image times the distance over the focal length."""
    item = right.data[0]
    u = right.problem.instruments(right.solution.x)
    chain = right.problem.chain(right.solution.x)
    errors = errors_of(item, chain, u)
    weights = np.ones(len(item.rows))
    weights[::3], weights[1::3] = 0.5, 0.51
    found = fitted_error(replace(right, weights=(weights,)))
    used = weights > 0.5
    assert found.n_corners == used.sum()
    for rms, name in ((found.pixels, "pixels"), (found.distance, "board")):
        assert rms == pytest.approx(np.sqrt(np.sum(errors[name][used] ** 2) / used.sum()))
    assert held_out_error(right, ()) is None
    nothing = fitted_error(replace(right, weights=(np.zeros(len(item.rows)),)))
    assert (nothing.pixels, nothing.distance, nothing.n_corners) == (0.0, 0.0, 0)


def test_the_document_of_a_stage_has_its_errors():
    stage = Stage("arm", True, 48, ImageError(1.0, 1e-4, 9), None, ImageError(2.0, 2e-4, 9), "Why.")
    assert stage.to_dict() == {
        "stage": "arm", "kept": True, "unknowns": 48, "reason": "Why.",
        "fitted": {"residual_rms_px": 1.0, "board_rms_m": 1e-4, "corners": 9},
        "by_image": None,
        "by_region": {"residual_rms_px": 2.0, "board_rms_m": 2e-4, "corners": 9},
    }  # fmt: skip


TRIALS = tuple(FamilyTrial(name, 1.0, 0.5, 20.0, 1.0, True) for name in ("compliance", "gain"))


@pytest.mark.parametrize(
    ("families", "changes"),
    [
        (["harmonics"], {}),
        ([], {}),
        (["compliance"], {"displaced": None}),
        (["compliance"], {"is_right": True}),
        (["compliance"], {"n_configurations": joint_errors.MIN_CONFIGURATIONS - 1}),
        (["compliance"], {"has_others": True}),
    ],
)
def test_joint_errors_need_images_that_share_displacements(monkeypatch, displaced, families, changes):
    monkeypatch.setattr(joint_errors, "select_families", lambda *_: pytest.fail("families are tried"))
    gated = replace(displaced, gate=replace(displaced.gate, n_configurations=joint_errors.MIN_CONFIGURATIONS))
    if "displaced" in changes:
        gated = replace(gated, displaced=None)
    elif "has_others" in changes:
        fit = displaced.displaced
        assert fit is not None
        data = *fit.problem.data, Pose(np.zeros((1, 6)), np.eye(4)[None])
        gated = replace(gated, displaced=replace(fit, problem=replace(fit.problem, data=data)))
    else:
        gated = replace(gated, gate=replace(gated.gate, **changes))
    same, extension = joint_errors.add_joint_errors(gated, families, 40)
    assert same is gated
    assert extension.trials == ()
    assert extension.temperature == gated.gate.temperature
    assert extension.n_configurations == gated.gate.n_configurations


@pytest.mark.parametrize(
    ("was_open", "before", "after", "nominal", "temperature", "is_added"),
    [
        (True, 2.0, 2.0, 9.0, 1.6, True),
        (True, 2.0, 2.01, 9.0, 1.6, False),
        # A closed gate opens if the images determine the arm with the joint errors.
        (False, 2.0, 1.0, 4.1, 1.6, True),
        (False, 2.0, 1.0, 4.0, 1.6, False),
        (False, 2.0, 1.0, 2.1, 1.0, True),
        (False, 2.0, 1.0, 2.0, 1.0, False),
        (False, 2.0, 2.1, 9.0, 1.6, False),
        (False, 2.0, 1.0, None, 1.6, False),
    ],
)
def test_joint_errors_are_added_if_they_predict_left_out_regions(
    monkeypatch, displaced, was_open, before, after, nominal, temperature, is_added
):
    n = joint_errors.MIN_CONFIGURATIONS
    gate_before = replace(displaced.gate, n_configurations=n, ratio=0.1 if was_open else 0.9)
    gated = replace(displaced, gate=gate_before)
    fit = displaced.displaced
    assert fit is not None
    opened, without = replace(fit, stage="opened"), replace(fit, stage="without")
    errors = {gated.with_arm.stage: before, "opened": after, "without": nominal}
    patches: dict[str, Any] = {
        "select_families": lambda *_: (TRIALS, SimpleNamespace(widths=()), 0.7, ["compliance", "gain"]),
        "with_selected": lambda start, *_: (start.problem, start.solution.x, None),
        "prior_weights": lambda problem, *_: problem.weights,
        "minimize": lambda *_, **__: fit.solution,
        "open_fit": lambda *_: (opened, temperature),
        "without_arm": lambda *_: without,
        "held_out_error": lambda each, _: errors[each.stage] and ImageError(errors[each.stage], 1.0, 9),
        "_with_explained": lambda opened, temperature, *_: (opened, temperature + 1),
    }
    for name, function in patches.items():
        monkeypatch.setattr(joint_errors, name, function)
    found, extension = joint_errors.add_joint_errors(gated, ["compliance", "harmonics", "gain"], 40)
    assert len(extension.trials) == 2
    assert set(extension.families) == ({"compliance", "gain"} if is_added else set())
    assert extension.n_configurations == n
    if not is_added:
        assert found is gated
        assert extension.temperature == gate_before.temperature
        assert np.isnan(extension.region_ratio)
        return
    assert found.fit is opened
    assert found.with_arm is (gated.with_arm if was_open else opened)
    assert found.gate.is_open
    assert found.gate.temperature == extension.temperature == temperature + 1
    assert extension.random_ratio == 0.7
    assert extension.region_ratio == pytest.approx(after / before)


@pytest.mark.parametrize("is_same", [True, False])
def test_samples_that_joint_errors_explain_are_no_outliers(monkeypatch, displaced, is_same):
    fit = displaced.displaced
    assert fit is not None
    fit = fit.solved_with_weights((np.where(np.arange(len(fit.weights[0])) < 9, 0.5, 1.0),), 1)
    new = fit.weights if is_same else (np.ones(len(fit.weights[0])),)
    judged = []

    def reweighted(given: Fit, *_: Any) -> Fit:
        judged.append(given)
        return replace(given, weights=new)

    monkeypatch.setattr(joint_errors, "reweight", reweighted)
    monkeypatch.setattr(joint_errors, "open_fit", lambda each, *_: (each, 7.0))
    found, temperature = joint_errors._with_explained(fit, 3.0, displaced.gate, 1)
    assert (found is fit) == is_same
    assert temperature == (3.0 if is_same else 7.0)
    np.testing.assert_array_equal(found.weights[0], new[0])
    # The measurements that are judged have no weights.
    assert displaced.displaced is not None
    np.testing.assert_allclose(judged[0].data[0].sigma, displaced.displaced.problem.data[0].sigma)  # type: ignore[union-attr]


def test_displacements_and_noise_of_images_are_estimated():
    """Each image is displaced at random by 1 mm and 2 mrad; one image has a board behind the camera."""
    chain, rng = ARMS["ur10"](), np.random.default_rng(2)
    setup = simulate(chain, chain, rng, is_on_wrist=True, n_images=60, sigma=0.2)
    exact = setup.exact
    problem = make_problem(select_parameters(chain, "base"), (exact,), np.ones(6), {})
    x = np.concatenate([np.zeros(6), problem.instrument_start({})])
    frames = chain.forward_kinematics(exact.conditions())
    derivative = exact.displacement_derivative(frames, problem.instrument_values_of(exact, x))
    displacements = rng.normal(size=(60, 6)) * ([1e-3] * 3 + [2e-3] * 3)
    moved = np.einsum("mij,mj->mi", derivative, displacements[exact.image])
    images = exact.replace(values=exact.values + moved + 0.2 * rng.standard_normal(moved.shape))
    every = np.ones(len(images.rows))
    found = estimate_jitter(problem, x, [images], [every], 0.0)
    assert found.is_significant
    assert [found.position, found.rotation] == pytest.approx([1e-3, 2e-3], rel=0.15)
    assert found.noise == pytest.approx(0.2, rel=0.05)
    behind = images.replace(values=images.values + 1e6 * (images.image == 3)[:, None])
    assert estimate_jitter(problem, x, [behind], [every], 0.0).position == pytest.approx(1e-3, rel=0.15)
    # Outliers do not count, and images without any corner have no displacement.
    weights = np.where(images.image % 2, 0.5, 0.51)
    half = estimate_jitter(problem, x, [images.replace(values=images.values + (weights == 0.5)[:, None])],
                           [weights], 0.0)  # fmt: skip
    assert half.noise == pytest.approx(0.2, rel=0.05)
    assert estimate_jitter(problem, x, [images], [0 * every], 0.0) == Jitter(1.0, 1e-3, 1e-3, 1e-3)
    # A fit that determines half of the displacements has absorbed half of their squares.
    absorbed = estimate_jitter(problem, x, [images], [every], 180.0)
    assert absorbed.position == pytest.approx(np.sqrt(2) * found.position, rel=0.2)
    still = exact.replace(values=exact.values + 0.2 * rng.standard_normal(moved.shape))
    assert not estimate_jitter(problem, x, [still], [every], 0.0).is_significant


def test_noise_is_no_less_than_a_tenth_of_a_pixel():
    rng = np.random.default_rng(0)
    derivative = rng.normal(size=(20, 6))
    assert jitter._scatter([(1e-3 * rng.normal(size=20), derivative)]) == 0.1
    # Twenty rows less six that a displacement explains.
    residual = np.linalg.svd(derivative)[0][:, 6:].sum(1)
    assert jitter._scatter([(residual, derivative)]) == pytest.approx(1.0)


def test_joints_of_a_low_cost_arm_displace_the_tool():
    chain = ARMS["ur10"]()
    q = np.random.default_rng(1).uniform(-1, 1, (1, 6))
    frames = chain.forward_kinematics(Pose(q, np.eye(4)[None]).conditions())
    assert jitter._joint_motions(chain, frames).shape == (1, 6, 0)
    servo = replace(chain, parameters=LOW_COST)
    found = jitter._joint_motions(servo, frames)[0]
    tool = chain.poses(q)[0]
    for joint in range(6):
        moved = chain.poses(q + 1e-6 * np.eye(6)[joint])[0]
        turn = moved[:3, :3] @ tool[:3, :3].T
        twist = np.array([*(moved - tool)[:3, 3], turn[2, 1], turn[0, 2], turn[1, 0]]) / 1e-6
        np.testing.assert_allclose(found[:, joint], twist, atol=1e-5)


def test_images_have_the_covariance_of_displacements_by_joints():
    servo = replace(ARMS["ur10"](), parameters=LOW_COST)
    images = simulate(servo, servo, np.random.default_rng(2), is_on_wrist=True, n_images=6, sigma=0.2).exact
    problem = make_problem(select_parameters(servo, "base"), (images,), np.ones(6), {})
    x = np.concatenate([np.zeros(6), problem.instrument_start({})])
    (found,) = jitter.with_jitter(problem, x, (images,), Jitter(0.3, 1e-7, 1e-7, 2e-3))
    assert isinstance(found, CameraCorners)
    step, values = 1e-6, problem.instruments(x)
    turns = [images.replace(q=images.q + sign * step * axis) for axis in np.eye(6) for sign in (1, -1)]
    pixels = np.stack([errors_of(turned, servo, values)["pixels"] for turned in turns], -1)
    moved = (pixels[..., ::2] - pixels[..., 1::2]) * 2e-3 / (2 * step)
    covariances = (each @ each.swapaxes(1, 2) for each in (found.jitter, moved))
    np.testing.assert_allclose(*covariances, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("log_ratio", "temperature"), [(9.0, 1.6), (5.0, 1.0)])
def test_images_that_share_no_displacement_with_joint_errors_count_in_full(
    monkeypatch, displaced, log_ratio, temperature
):
    monkeypatch.setattr(
        gate, "residual_jitter", lambda _: Jitter(0.3, 1e-4, 1e-4, log_likelihood_ratio=log_ratio)
    )
    assert displaced.displaced is not None
    opened, found = gate.open_fit(displaced.displaced, displaced.gate, 40)
    assert found == opened.problem.temperature == pytest.approx(temperature)


def test_corners_are_not_tried_without_boards_or_errors(monkeypatch, right):
    folds, images = cluster_folds(right.data), k_fold(right.data, 5)
    assert target_points.try_target_points(right, (), folds, 40) is None
    monkeypatch.setattr(target_points, "held_out_error", lambda *_: ImageError(0.0, 0.0, 9))
    assert target_points.try_target_points(right, images, folds, 40) is None
    monkeypatch.setattr(target_points, "judged_boards", lambda _: [])
    assert target_points.try_target_points(right, images, folds, 40) is None


def test_images_that_cannot_be_left_out_share_their_displacement(monkeypatch, wrong):
    """Without left-out clusters, no model of the noise predicts better."""
    monkeypatch.setattr(gate, "cluster_folds", lambda _: ())
    gated = apply_gate(wrong, (), 40, INDUSTRIAL)
    assert np.isnan(gated.gate.ratio)
    assert not gated.gate.is_open
    assert gated.with_arm.problem.data[0].has_jitter  # type: ignore[attr-defined]
    assert gated.with_arm.problem.temperature == pytest.approx(1 + 12 / 5)
    assert gated.fit.problem.data[0].has_jitter  # type: ignore[attr-defined]


def test_predictions_of_left_out_images_have_the_uncertainty_of_the_fit_of_the_others(right):
    problem, x = right.problem, right.solution.x
    squares = []
    for (is_left_out,) in k_fold(right.data, 5):
        parts = [problem.with_data([problem.data[0].take(mask)]) for mask in (~is_left_out, is_left_out)]
        fitted, left = (
            np.concatenate(
                [part.linearize(x).rows(chunk)[:-1].reshape(len(x), -1) for chunk in part.chunks], 1
            )
            for part in parts
        )
        covariance = np.linalg.inv(fitted @ fitted.T + np.diag(problem.weights**2))
        squares += np.einsum("ik,ij,jk->k", left, covariance, left).tolist()
    found = held_out_prediction_std(right, k_fold(right.data, 5))
    assert found == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-4)


def test_many_rows_of_other_instruments_show_a_small_change():
    """The mean square of normal rows is below the limit with the probability of three standard deviations."""
    gates = {n: Gate(1.0, 1.0, 20, True, True, n_others=n) for n in (0, 100, 900, 3000, 100000)}
    limits = {n: each.max_others_ratio for n, each in gates.items()}
    assert limits[0] == limits[100] == 0.8
    for n in (900, 3000, 100000):
        assert chi2.cdf(n * limits[n] ** 2, n) == pytest.approx(norm.sf(3), rel=0.4)
    for n, each in gates.items():
        for factor, is_open in ((0.999, True), (1.001, False)):
            assert replace(each, others_ratio=factor * limits[n]).is_open == is_open
