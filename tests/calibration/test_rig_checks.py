"""Sets, lenses, sizes and poses of a rig: what is unknown, what is wrong, and in which words."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from camera_setups import ARMS, Setup, placement_fit, simulate

from dhcal_pin import se3, select_parameters
from dhcal_pin.calibration.cameras import board_size, causes, procedure
from dhcal_pin.calibration.cameras.arm_types import ARM_TYPES, INDUSTRIAL, arm_type
from dhcal_pin.calibration.cameras.board_size import OTHER_ROBOT, BoardSize
from dhcal_pin.calibration.cameras.causes import Causes, HandEyeData, file_sequence
from dhcal_pin.calibration.cameras.lens_priors import (
    describe_far_lenses,
    lens_prior_groups,
    lens_values,
    with_lens_priors,
    with_stated_distortion,
)
from dhcal_pin.calibration.cameras.mistakes import (
    PoseDifference,
    RigMistakes,
    axis_order,
    correct_rig,
    inverse_poses,
    pose_differences,
)
from dhcal_pin.calibration.cameras.mistakes.axis_order import Exchange, axis_stages
from dhcal_pin.calibration.cameras.sets import (
    count_corners,
    default_sets,
    held_values,
    image_sets,
    require_joint_values,
    split_sets,
)
from dhcal_pin.calibration.cameras.stages import ImageError
from dhcal_pin.calibration.reweighting import Fit
from dhcal_pin.cameras import Camera
from dhcal_pin.estimation.initialization import make_problem
from dhcal_pin.estimation.parameters import LOW_COST
from dhcal_pin.estimation.robust import ZERO_WEIGHT
from dhcal_pin.estimation.solver import minimize
from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.measurements import CameraCorners, Pose


@pytest.fixture(scope="module")
def setup() -> Setup:
    """Images whose stated lens is wrong by 5 %."""
    chain = ARMS["ur10"]()
    return simulate(chain, chain, np.random.default_rng(4), is_on_wrist=True, n_images=6, sigma=0.2)


@pytest.fixture(scope="module")
def lens_fit(setup) -> Fit:
    """Fit of poses and lens, with the nominal arm."""
    item = setup.images.initialized(setup.nominal)
    problem = make_problem(select_parameters(setup.nominal, "base"), (item,), np.ones(6), {})
    x = np.concatenate([np.zeros(6), problem.instrument_start({})])
    return Fit((item,), problem, minimize(problem, "lm", x, 40), (np.ones(len(item.rows)),))


def with_camera(images: CameraCorners, **changes: Any) -> CameraCorners:
    camera = replace(images.rig.cameras[0], **changes)
    return images.with_rig(replace(images.rig, cameras=(camera,)))


def poses(chain) -> Pose:
    return Pose(np.zeros((2, chain.n_joints)), np.tile(np.eye(4), (2, 1, 1)))


# --------------------------------------------------------------------------------------------------- sets
def test_sets_of_the_rig_are_separated_from_those_of_the_robot():
    assert split_sets("placement,camera,offset,board") == (["placement", "offset"], ["camera", "board"])


def test_default_sets_depend_on_what_was_measured(setup):
    chain, images = setup.nominal, setup.images
    assert default_sets(chain, [poses(chain)]) == chain.parameters
    assert default_sets(chain, [images]) == "placement,offset,camera,board,intrinsics"
    assert default_sets(chain, [images, poses(chain)]) == "placement,offset,camera,board,intrinsics,base,tool"
    of_flange = images.replace(has_joint_values=False)
    assert default_sets(chain, [of_flange]) == "camera,board,intrinsics"
    servo: Any = SimpleNamespace(parameters=LOW_COST)
    assert image_sets(servo) == f"{LOW_COST},camera,board,intrinsics"
    assert image_sets(chain) == "placement,offset,camera,board,intrinsics"


@pytest.mark.parametrize(
    ("names", "has_poses", "message"),
    [
        (["base", "placement"], False, "parameters 'placement': need joint values"),
        (["base", "tool"], False, None),
        (["base"], True, "measurements of kind pose beside images"),
    ],
)
def test_images_with_poses_of_the_tip_have_no_errors_of_the_arm(setup, names, has_poses, message):
    data = [setup.images.replace(has_joint_values=False), *[poses(setup.nominal)] * has_poses]
    require_joint_values([setup.images], names)
    if message is None:
        require_joint_values(data, names)
        return
    with pytest.raises(InvalidArgumentError, match=message):
        require_joint_values(data, names)


def test_values_of_the_rig_are_held_unless_their_set_is_estimated(setup):
    names = set(held_values([setup.exact], ["camera", "intrinsics"]))
    assert names == {f"board_board0.{name}" for name in ("x", "y", "z", "rx", "ry", "rz")}
    assert held_values([poses(setup.nominal)], []) == {}
    with pytest.raises(InvalidArgumentError, match="parameter set 'camera' needs image coordinates"):
        held_values([poses(setup.nominal)], ["camera", "board"])
    count = len(setup.images.rig.boards[0].points)
    assert count_corners([setup.images, setup.exact]) == count


# ------------------------------------------------------------------------------------------------- lenses
def test_lenses_that_the_rig_fixes_have_no_prior_widths(setup):
    def n_members(images: CameraCorners) -> list[int]:
        errors = select_parameters(setup.nominal, "base")
        groups = lens_prior_groups(make_problem(errors, (images,), np.ones(6), {}))
        return [len(group.members) for group in groups]

    assert n_members(setup.images) == [4, 5]
    assert n_members(with_camera(setup.images, intrinsics="fixed")) == []
    unknown = np.r_[np.full(4, np.nan), np.zeros(5)]
    assert n_members(with_camera(setup.images, intrinsics="prior", values=unknown)) == [5]


def test_the_widths_of_a_fit_are_those_of_later_fits(lens_fit):
    weights = lens_fit.problem.prior_weights
    narrow = replace(lens_fit, problem=lens_fit.problem.with_prior_weights(4 * weights))
    (found,), (before,) = with_lens_priors(narrow).data, lens_fit.data
    for new, old in zip(found.instrument_parameters, before.instrument_parameters, strict=True):
        assert new.prior == pytest.approx(old.prior / (4 if old.unit in ("px", "1") else 1))


def test_priors_of_distortion_are_at_the_values_of_the_rig(setup):
    names = ["camera_camera0.k1", "camera_camera0.p2", "camera_camera0.fx"]
    moved = setup.images.with_values(dict.fromkeys(names, 0.3))
    (found,), first = with_stated_distortion([moved])
    values = {p.name: p.nominal for p in found.instrument_parameters}
    assert [values[name] for name in names] == [0.0, 0.0, 0.3]
    assert {name: first[name] for name in first if first[name]} == dict.fromkeys(names[:2], 0.3)
    assert len(first) == 5
    free = with_camera(setup.images, intrinsics="free").with_values({names[0]: 0.3})
    (held,), none = with_stated_distortion([free])
    assert {p.name: p.nominal for p in held.instrument_parameters}[names[0]] == 0.3
    assert none == {}
    other = poses(setup.nominal)
    assert with_stated_distortion([other]) == ((other,), {})


def test_known_values_of_a_lens_replace_the_stated_ones(setup):
    camera = setup.images.rig.cameras[0]
    found = lens_values(camera, {"camera_camera0.cy": 5.0, "camera_other.cx": 7.0})
    np.testing.assert_array_equal(found, np.r_[camera.values[:3], 5.0, camera.values[4:]])


def test_a_lens_that_is_far_from_the_stated_one_is_described(setup):
    camera = replace(setup.images.rig.cameras[0], values=np.r_[1000.0, 1010.0, 640.0, 480.0, np.zeros(5)])
    images = with_camera(setup.images, values=camera.values)

    def text(fx: float, fy: float, cx: float, cy: float) -> list[str]:
        names = [f"camera_camera0.{name}" for name in ("fx", "fy", "cx", "cy")]
        return describe_far_lenses([images, images], dict(zip(names, (fx, fy, cx, cy), strict=True)))

    assert text(1001, 1011, 641, 481) == []
    (far,) = text(1900, 1950, 700, 400)
    assert (
        "fx, fy 1900, 1950 px, not 1000, 1010 px, and cx, cy 700, 400 px, not 640, 480 px. Check that" in far
    )
    (half,) = text(500, 505, 320, 240)
    assert "The focal length of camera 'camera0' is 0.50 times the stated one" in half


# -------------------------------------------------------------------------------------------------- sizes
@pytest.mark.parametrize(
    ("stated", "log_ratio", "is_decisive"),
    [(1.2, 8.0, True), (1.19, 8.0, False), (1.2, 7.9, False)],
)
def test_a_size_is_wrong_beyond_doubt_if_correction_and_evidence_are_large(stated, log_ratio, is_decisive):
    found = BoardSize({"a": 1.1}, {"a": 0.03}, stated, 0.31, log_ratio)
    assert found.is_decisive == is_decisive
    assert found.sentence == (
        f"The size of the boards {'is probably' if is_decisive else 'may be'} wrong: with 110 % of the "
        "stated size (squares of 33 mm, not 30 mm), the corrections of the lengths of the arm fall from "
        "1.2 to 0.31 times what manufacturing errors would be. Measure the boards over the whole length, "
        "and correct the size in the rig file."
    )


@pytest.mark.parametrize(
    ("sizes", "wrong"),
    [
        ({"a": np.exp(0.02), "b": np.exp(-0.0021)}, "ab"),
        ({"a": np.exp(0.02), "b": np.exp(-0.0019)}, "a"),
        ({"a": np.exp(0.1), "b": np.exp(-0.009)}, "a"),
        ({"a": np.exp(0.1), "b": np.exp(-0.011)}, "ab"),
        ({"a": np.exp(-0.0019), "b": 1.0}, ""),
    ],
)
def test_boards_of_a_wrong_size_are_those_that_differ_by_a_tenth_of_the_largest_difference(sizes, wrong):
    found = BoardSize(sizes, {"a": 0.03, "b": 0.0}, 2.0, 0.3, 9.0)
    assert "".join(found.wrong) == wrong
    if wrong == "ab":
        assert "board 'a' and board 'b' is probably wrong" in found.sentence
        assert f"{100 * sizes['b']:.4g} % of the stated size of board 'b', the corrections" in found.sentence
    if wrong == "a":
        assert "The size of board 'a' is probably wrong" in found.sentence
        assert "of the stated size (squares of" in found.sentence


@pytest.mark.parametrize(("log_size", "is_other"), [(-0.14, False), (-0.16, True), (0.16, True)])
def test_sizes_that_differ_by_more_than_15_percent_may_be_those_of_another_robot(log_size, is_other):
    found = BoardSize({"a": float(np.exp(log_size))}, {"a": 0.0}, 2.0, 0.3, 9.0)
    assert found.sentence.endswith(OTHER_ROBOT) == is_other


@pytest.mark.parametrize(("n_more", "is_whole"), [(0, False), (1, True)])
def test_boards_most_of_whose_corners_are_rejected_count_with_all_of_them(n_more, is_whole):
    fit = placement_fit(0.0, 12, 0)
    weights = np.ones(len(fit.weights[0]))
    assert len(weights) % 2 == 0
    weights[: len(weights) // 2 + n_more] = ZERO_WEIGHT
    weights[-1] = 0.7
    rejected = fit.solved_with_weights((weights,), 1)
    found = board_size._with_whole_boards(rejected)
    assert (found is not rejected) == is_whole
    if is_whole:
        np.testing.assert_array_equal(found.weights[0], 1.0)


# ----------------------------------------------------------------------------------- exchanged axes, poses
def test_exchanges_of_axes_say_where_and_how_they_were_found():
    errors = ImageError(12.0, 1e-2, 9), ImageError(0.5, 1e-3, 9)
    found = Exchange("c", "fx and fy", *errors, 12)
    assert found.sentence == (
        "camera 'c': fx and fy are exchanged in the rig file: with fixed intrinsics the images differ by "
        "12 px as stated, and by 0.5 px if they are exchanged. The exchanged values are used; correct them."
    )
    assert "u and v are exchanged in the measurements: with" in replace(found, what="u and v").sentence
    size = Exchange("c", "width and height", None, None)
    for each in (size, replace(size, stated=errors[0]), replace(size, exchanged=errors[1])):
        assert each.sentence == (
            "camera 'c': width and height are exchanged in the rig file: corners lie outside its images, and "
            "inside if they are exchanged. Correct them."
        )
    (stage,) = axis_stages([found, size])
    assert (stage.name, stage.is_kept, stage.n_unknowns, stage.fitted) == ("axis order", True, 12, errors[0])
    assert stage.reason == found.sentence


@pytest.mark.parametrize(
    ("corners", "is_exchanged"),
    [
        ([(960, 1280)], False),
        ([(961, 960)], True),
        ([(10, 10)], False),
        ([(1280, 960), (5, 5)], True),
        ([(1281, 960)], False),
        ([], False),
    ],
)
def test_width_and_height_are_compared_with_all_corners(corners, is_exchanged):
    camera = Camera("c", "world", 960, 1280, np.zeros(9))
    rig = SimpleNamespace(cameras=(replace(camera, name="other"), camera))
    parts: Any = [SimpleNamespace(values=np.array([corner]), rig=rig) for corner in corners]
    assert axis_order._is_size_exchanged(parts, "c") == is_exchanged


@pytest.mark.parametrize(
    ("stated", "found", "values", "what"),
    [
        # The stated order leaves 2 px at least, and the other one half of that at most, and 64 px of 1280 px.
        (2.0, {"fx and fy": 1.0}, (1000, 1020, 600, 600), "fx and fy"),
        (1.9, {"fx and fy": 0.1}, (1000, 1020, 600, 600), None),
        (10.0, {"fx and fy": 5.1}, (1000, 1020, 600, 600), None),
        (200.0, {"fx and fy": 64.1}, (1000, 1020, 600, 600), None),
        (200.0, {"fx and fy": 63.9}, (1000, 1020, 600, 600), "fx and fy"),
        (10.0, {"fx and fy": 1.0}, (1000, 1005, 600, 600), None),
        (10.0, {"fx and fy": 4.0, "cx and cy": 3.0}, (1000, 1020, 600, 620), "cx and cy"),
        (10.0, {"fx and fy, and cx and cy": 3.0}, (1000, 1020, 600, 603), None),
        (20.0, {"u and v": 9.0}, (1000, 1000, 600, 600), "u and v"),
        (19.9, {"u and v": 9.0}, (1000, 1000, 600, 600), None),
        (None, {"fx and fy": 0.1}, (1000, 1020, 600, 600), None),
    ],
)  # fmt: skip
def test_another_order_of_axes_is_taken_if_it_explains_the_images_far_better(
    monkeypatch, stated, found, values, what
):
    camera = Camera("c", "world", 960, 1280, np.r_[values, np.zeros(5)])
    orders = {axis_order.ORDERS[name]: pixels for name, pixels in found.items()}

    def error(_: Any, parts: Any) -> Any:
        pixels = stated if not isinstance(parts[0], axis_order.AxisOrder) else orders.get(parts[0], stated)
        return None if pixels is None else (ImageError(pixels, 1e-4 * pixels, 9), 12)

    monkeypatch.setattr(axis_order, "_frames_error", error)
    monkeypatch.setattr(axis_order, "_reordered", lambda _, order, __: order)
    part: Any = SimpleNamespace(rig=SimpleNamespace(cameras=(camera,)))
    chain: Any = SimpleNamespace()
    exchange = axis_order._best_order(chain, [part], "c")
    assert (exchange and exchange.what) == what
    if exchange is not None:
        assert exchange.stated is not None
        assert exchange.stated.pixels == stated
        assert exchange.unknowns == 12
    assert axis_order._best_order(chain, [], "c") is None


def test_the_order_of_axes_is_judged_with_the_poses_alone(setup):
    """Noise of 0.2 px along each axis is left with the true lens, and 12 unknowns."""
    camera = replace(setup.exact.rig.cameras[0], pose=None)
    images, rig = setup.images, replace(setup.images.rig, cameras=(camera,))
    item = CameraCorners(images.q, images.values, images.corner, rig)
    error = axis_order._frames_error(setup.nominal, [item])
    assert error is not None
    assert error[0].pixels == pytest.approx(0.2 * np.sqrt(2), rel=0.1)
    assert error[1] == 12
    assert axis_order._frames_error(setup.nominal, [setup.images.take(setup.images.image < 1)]) is None


@pytest.mark.parametrize(("limit", "n_images"), [(10**9, 40), (10**3, 10), (12 * 8 + 1, 10)])
def test_images_are_thinned_evenly(monkeypatch, limit, n_images):
    chain = ARMS["ur10"]()
    images = simulate(chain, chain, np.random.default_rng(4), is_on_wrist=True, n_images=40, sigma=0.2).images
    monkeypatch.setattr(axis_order, "_MAX_CORNERS", limit)
    thinned = axis_order._thinned(images)
    expected = max(10, min(40, 40 * limit // len(images.rows)))
    assert thinned.n_images == expected
    assert (thinned is images) == (limit >= len(images.rows))


def test_exchanged_values_are_put_into_their_order(monkeypatch, setup):
    """The order of one of the cameras is wrong, and the size of its images."""
    camera = setup.images.rig.cameras[0]
    images = with_camera(setup.images, values=np.r_[900.0, 950.0, camera.values[2:]], width=960, height=1280)
    images = images.replace(values=images.values % 959 + np.array([321.0, 0.0]))
    wrong = Exchange("camera0", "fx and fy", ImageError(9.0, 1e-3, 9), ImageError(1.0, 1e-4, 9))
    monkeypatch.setattr(axis_order, "_best_order", lambda *_: wrong)
    other = poses(setup.nominal)
    (fitted, same), (held,), found = correct_rig(setup.nominal, [images, other], [images], ["camera"])
    for item in (fitted, held):
        np.testing.assert_array_equal(item.rig.cameras[0].values[:2], [950.0, 900.0])  # type: ignore[union-attr]
        values = {p.name: p.nominal for p in item.instrument_parameters}
        assert (values["camera_camera0.fx"], values["camera_camera0.fy"]) == (950.0, 900.0)
    assert same is other
    assert [each.what for each in found.exchanges] == ["fx and fy", "width and height"]
    assert found.sentences == [each.sentence for each in found.exchanges]
    assert [stage.name for stage in found.stages] == ["axis order"]
    monkeypatch.setattr(axis_order, "_best_order", lambda *_: None)
    unchanged, found = axis_order.exchange_axes(setup.nominal, [setup.images])
    assert unchanged == (setup.images,)
    assert found == ()


def test_stated_poses_that_are_not_inverse_are_no_mistake_of_the_rig():
    stated = pose([0.4, 0.2, 0.1], [0.05, 0.02, 0.3])
    inverse = PoseDifference("camera_wrist", stated, se3.inverse(stated))
    turned = PoseDifference("board_b", stated, stated @ pose([0.0, 0.5, 0.0], [0.03, 0.0, -0.04]))
    assert RigMistakes(poses=(turned, inverse)).sentences == [inverse.sentence]


def test_the_type_of_an_arm_follows_from_its_sets():
    assert arm_type(["camera", LOW_COST]) is ARM_TYPES[LOW_COST]
    assert arm_type(["placement", "offset"]) is INDUSTRIAL


def pose(vector, position) -> np.ndarray:
    return se3.transform(se3.exp3(np.array(vector, float)), np.array(position, float))


def test_stated_poses_that_differ_are_described():
    stated = pose([0.4, 0.2, 0.1], [0.05, 0.02, 0.3])
    inverse = PoseDifference("camera_wrist", stated, se3.inverse(stated))
    assert inverse.is_inverse
    assert inverse.text == "the stated pose of camera 'wrist' is inverse, of its link in the camera"
    assert inverse.sentence == (
        f"{inverse.text}; the pose in the images is used. State the pose of the camera in its link (xyz_m "
        "and rotvec_rad in the rig file)."
    )
    turned = PoseDifference("board_b", stated, stated @ pose([0.0, 0.5, 0.0], [0.03, 0.0, -0.04]))
    assert not turned.is_inverse
    assert turned.text == "the stated pose of board 'b' is 50.0 mm and 28.6° from the one in the images"
    assert turned.remedy == "Correct xyz_m and rotvec_rad of the board in the rig file."
    assert turned.size == pytest.approx(0.5)
    # A distance counts relative to that from the link, which is 0.1 m at least.
    near = PoseDifference("board_b", pose([0, 0, 0], [0.02, 0, 0]), pose([0, 0, 0], [0.05, 0, 0]))
    assert near.size == pytest.approx(0.3)
    far = PoseDifference("board_b", pose([0, 0, 0], [0.2, 0, 0]), pose([0, 0, 0], [0.5, 0, 0]))
    assert far.size == pytest.approx(0.6)


def test_poses_with_known_values_are_compared(setup):
    images = setup.exact
    values = {p.name: p.nominal for p in images.instrument_parameters}
    values["camera_camera0.z"] += 0.1
    (camera, board) = pose_differences([images], values, ["camera_camera0", "board_board0"])
    np.testing.assert_allclose(board.found, board.stated, atol=1e-12)
    np.testing.assert_allclose((camera.found - camera.stated)[:3, 3], [0, 0, 0.1], atol=1e-12)
    del values["camera_camera0.rz"]
    assert [
        each.entry for each in pose_differences([images], values, ["camera_camera0", "board_board0"])
    ] == ["board_board0"]


@pytest.mark.parametrize(
    ("stated", "freed", "is_used"),
    [(64.1, 20.0, False), (63.9, 1.0, True), (90.0, 30.1, True), (90.1, 30.0, False)],
)
def test_stated_poses_are_not_used_if_the_images_contradict_them(monkeypatch, setup, stated, freed, is_used):
    """Their error is 5 % of 1280 px at least, and three times that of the images alone."""
    errors = iter([stated, freed])
    monkeypatch.setattr(inverse_poses, "_start_error", lambda *_: next(errors))
    data, found = inverse_poses.free_wrong_poses(
        setup.nominal, [setup.exact], [setup.exact], ["camera", "board"]
    )
    assert [each.entry for each in found] == [] if is_used else ["camera_camera0", "board_board0"]
    for item in data:
        assert (item.rig.cameras[0].pose is None) == (not is_used)  # type: ignore[union-attr]
    assert inverse_poses.free_wrong_poses(setup.nominal, [setup.exact], [], ["intrinsics"])[1] == ()


def test_the_error_of_first_values_is_the_median_distance_of_corners(setup):
    assert inverse_poses._start_error(setup.nominal, [setup.exact]) == pytest.approx(0.0, abs=1e-6)
    shifted = setup.exact.replace(values=setup.exact.values + np.array([3.0, 4.0]))
    assert inverse_poses._start_error(setup.nominal, [shifted]) == pytest.approx(5.0, abs=1e-6)


# ------------------------------------------------------------------------------------------------- causes
@pytest.mark.parametrize(
    ("cause", "n_more"),
    [
        (Causes(), 0),
        (Causes(arm="offset"), 6),
        (Causes(has_lens=True), 9),
        (Causes(has_points=True), None),
        (Causes(has_free_poses=True), 6),
        (Causes(sizes={"board0": 1.01}, shift=1.0), 0),
    ],
)
def test_a_cause_frees_its_unknowns_alone(setup, cause, n_more):
    """The rig fixes the lens and the pose of the board."""
    rig = replace(
        setup.exact.rig, cameras=(replace(setup.exact.rig.cameras[0], pose=None, intrinsics="fixed"),)
    )
    images = setup.images.with_rig(rig)
    known = {name: v for name, v in images.stated_values.items() if images.set_of(name) != "camera"}
    base = select_parameters(setup.nominal, "base")
    hand_eye = HandEyeData(replace(base, parameters=()), (images,), known, file_sequence([images]), False)
    fit = causes._first_fit(hand_eye, cause)
    n_points = 3 * len(images.rig.boards[0].points)
    assert len(fit.solution.x) == 6 + (n_points if n_more is None else n_more)
    n_images = fit.data[0].n_images
    assert n_images == 6 - (cause.shift != 0)
    if not cause.shift:
        squares = fit.solution.system.cost / len(images.rows)
        assert causes._cost(hand_eye, cause, None) == pytest.approx(squares)


def test_images_that_do_not_determine_the_poses_have_no_fit(setup):
    image = setup.images.take(setup.images.image < 1)
    base = select_parameters(setup.nominal, "base")
    assert causes._cost(HandEyeData(base, (image,), {}, image.q[:1], False), Causes(), None) == np.inf


def test_joint_values_of_a_file_are_in_the_order_of_its_rows(setup):
    images = setup.images
    parts = [images.take(images.image % 2 == k) for k in (1, 0)]
    sequence = file_sequence(parts)
    first = np.sort(np.unique(images.image, return_index=True)[1])
    np.testing.assert_array_equal(sequence, images.q[first])
    np.testing.assert_array_equal(causes.places_in_sequence(sequence, sequence[[3, 0, 5]]), [3, 0, 5])


def test_the_size_of_each_board_is_found(monkeypatch):
    """The cost is least where board a is 2 % too large and b 1 % too small."""
    least = {"a": np.log(1.02), "b": np.log(0.99)}

    def cost(_: Any, cause: Causes, __: Any) -> float:
        return sum((np.log(cause.sizes[name]) - least[name]) ** 2 for name in least)

    monkeypatch.setattr(causes, "_cost", cost)
    boards = [SimpleNamespace(name=name) for name in "ab"]
    monkeypatch.setattr(
        causes, "select_images", lambda _: [SimpleNamespace(rig=SimpleNamespace(boards=boards))]
    )
    hand_eye: Any = SimpleNamespace(data=())
    assert causes.find_sizes(hand_eye, Causes(), {}) == pytest.approx({"a": 1.02, "b": 0.99}, abs=1e-5)


@pytest.mark.parametrize(
    ("least", "depth", "n_rows", "shift"),
    [
        (-1.04, 10.0, 9, -1.0),
        (0.96, 10.0, 9, 1.0),
        (1.2, 10.0, 9, 1.2),
        (0.3, 10.0, 9, 0.3),
        (-2.0, 10.0, 4, -2.0),
        (-2.0, 10.0, 3, 0.0),
        # The cost without a shift is less than 1/0.7 times the least one.
        (1.0, 0.4, 9, 0.0),
        (1.0, 0.45, 9, 1.0),
    ],
)
def test_a_shift_that_reduces_the_cost_is_found(monkeypatch, least, depth, n_rows, shift):
    monkeypatch.setattr(causes, "_cost", lambda _, cause, __: 1 + depth * (cause.shift - least) ** 2)
    hand_eye: Any = SimpleNamespace(sequence=np.zeros((n_rows, 6)))
    assert causes.find_shift(hand_eye, Causes()) == pytest.approx(shift, abs=1e-3)
    # Without a fit there is no shift.
    monkeypatch.setattr(causes, "_cost", lambda *_: np.inf)
    assert causes.find_shift(hand_eye, Causes()) == 0.0


def test_a_cause_changes_its_part_of_the_rig_alone(setup):
    fixed = with_camera(setup.images, intrinsics="fixed")
    for cause in (Causes(), Causes(has_lens=True), Causes(has_points=True), Causes(has_exchanged_links=True)):
        rig = causes._with_rig(cause, fixed).rig
        assert (rig.cameras[0].intrinsics == "prior") == cause.has_lens
        assert rig.boards[0].has_free_points == cause.has_points
        assert rig.camera_mounts[0].moves != cause.has_exchanged_links
        assert rig.board_mounts[0].moves == cause.has_exchanged_links
    free = with_camera(setup.images, intrinsics="free")
    assert causes._with_rig(Causes(has_lens=True), free).rig.cameras[0].intrinsics == "free"
    larger = causes._with_rig(Causes(sizes={"board0": 1.1}), fixed).rig.boards[0].points
    np.testing.assert_allclose(larger, 1.1 * fixed.rig.boards[0].points)


def test_families_that_images_do_not_show_are_named():
    procedure.require_shown_families("auto", ["harmonics"])
    procedure.require_shown_families(None, ["harmonics"])
    procedure.require_shown_families(["gain"], ["gain"])
    with pytest.raises(InvalidArgumentError, match=r"extend 'harmonics': only compliance, .* are selected"):
        procedure.require_shown_families(["gain", "harmonics"], ["gain", "harmonics"])


@pytest.mark.parametrize(
    ("first", "families", "is_tried_again"),
    [(None, (), False), ("size", procedure.FAMILIES, False), ("size", procedure.FAMILIES[:2], True)],
)
def test_another_size_is_judged_with_all_joint_errors_that_images_show(
    monkeypatch, first, families, is_tried_again
):
    found = iter([first, "size with joint errors"])
    monkeypatch.setattr(procedure, "find_board_size", lambda _: next(found))
    monkeypatch.setattr(procedure, "add_joint_errors", lambda gated, names, _: (gated, names))
    gated: Any = SimpleNamespace(fit=None)
    expected = "size with joint errors" if is_tried_again else first
    assert procedure._judge_board_size(gated, families, 40) == expected


@pytest.mark.parametrize(
    ("arm_error", "size", "is_found"), [(5e-4, 1.0, False), (5e-4, 1.03, True), (3e-3, 1.0, False)]
)
def test_a_size_is_wrong_if_another_one_makes_the_arm_right(arm_error, size, is_found):
    fit = placement_fit(arm_error, 12, 3, size=size)
    found = board_size.find_board_size(fit)
    assert (found is not None) == is_found
    if found is not None:
        assert list(found.sizes.values()) == [pytest.approx(1 / size, abs=3e-3)]
        assert found.found < 0.5 * found.stated
    # Other measurements show lengths themselves.
    data = *fit.problem.data, poses(fit.problem.errors.chain)
    mixed = replace(
        fit, data=data, problem=replace(fit.problem, data=data), weights=(*fit.weights, np.ones(2))
    )
    assert board_size.find_board_size(mixed) is None
