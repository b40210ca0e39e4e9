"""Poses of cameras and boards that a rig states the other way round are named, and do no harm."""

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from camera_setups import ARMS, simulate, wrong_arm
from hand_eye_setups import faulty_setup
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.calibration.cameras.mistakes import PoseDifference
from dhcal_pin.measurements import CameraCorners

pytestmark = pytest.mark.usefixtures("own_loss", "uneventful", "ordered_axes")

AS_IT_IS, INVERSE = (lambda pose: pose), se3.inverse
# What is stated of the pose of the camera, and of that of the board.
STATED = {
    "camera": (INVERSE, None),
    "board": (None, INVERSE),
    "both": (INVERSE, INVERSE),
    "camera beside a board": (INVERSE, AS_IT_IS),
    "board beside a camera": (AS_IT_IS, INVERSE),
}


def with_stated(setup, of_camera, of_board):
    """Return images of a set-up whose rig states functions of the true poses."""
    (camera,), (board,) = setup.images.rig.cameras, setup.images.rig.boards
    (true_camera,), (true_board,) = setup.exact.rig.cameras, setup.exact.rig.boards
    camera = replace(camera, pose=of_camera and of_camera(true_camera.pose))
    board = replace(board, pose=of_board and of_board(true_board.pose))
    rig = replace(setup.images.rig, cameras=(camera,), boards=(board,))
    return CameraCorners(setup.images.q, setup.images.values, setup.images.corner, rig)


CASES = list(product([("ur10", 5, True), ("panda", 4, False), ("xarm7", 2, True)], STATED))


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize(("case", "which"), some_slow(CASES, {0, 6}))
def test_inverse_first_values_are_named_and_not_used(case, which):
    name, seed, is_on_wrist = case
    chain = ARMS[name]()
    setup = simulate(
        chain, chain, np.random.default_rng(seed), is_on_wrist=is_on_wrist, n_images=15, sigma=0.2
    )
    fit = dh.calibrate(chain, with_stated(setup, *STATED[which]))
    named = [text for text in fit.input_warnings if "is inverse" in text]
    wrong = {"both": ["camera", "board"]}.get(which, [which.split()[0]])
    assert len(named) == len(wrong)
    for kind, text in zip(wrong, named, strict=True):
        assert f"the stated pose of {kind} '{kind}0' is inverse, of its link in the {kind}" in text
        assert f"State the pose of the {kind} in its link" in text
    assert fit.verdict.status == "ok"
    assert fit.rig is not None
    assert fit.rig.cameras[0].values[:2] == pytest.approx(setup.exact.rig.cameras[0].values[:2], rel=5e-3)
    found, true = (each.camera_in_end(0)[:3, 3] for each in (fit.rig, setup.exact.rig))
    assert found == pytest.approx(true, abs=2e-3)


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize("seed", some_slow(range(20, 32), {0, 1}))
def test_right_first_values_are_never_inverse(seed):
    """An arm with errors of centimetres and degrees displaces the images by hundreds of pixels."""
    rng, chain = np.random.default_rng(seed), ARMS[("ur10", "panda", "xarm7")[seed % 3]]()
    truth = wrong_arm(chain, (0.0, 1e-3, 1e-2)[seed // 3 % 3], rng)
    setup = simulate(chain, truth, rng, is_on_wrist=seed % 2 == 0, n_images=15, sigma=0.2)
    fit = dh.calibrate(chain, with_stated(setup, AS_IT_IS, AS_IT_IS), "camera,board,intrinsics")
    assert not any("inverse" in text for text in fit.input_warnings)


@pytest.mark.parametrize(
    ("case", "kind"),
    some_slow(list(product([("ur10", 5, True), ("panda", 4, False)], ("camera", "board"))), {0}),
)
@pytest.mark.parametrize("has_joint_values", some_slow([True, False], {1}))
def test_inverse_poses_that_are_held_are_the_cause(case, kind, has_joint_values):
    name, seed, is_on_wrist = case
    chain = ARMS[name]()
    setup = simulate(
        chain, chain, np.random.default_rng(seed), is_on_wrist=is_on_wrist, n_images=12, sigma=0.2
    )
    others = {"camera": "board,intrinsics", "board": "camera,intrinsics"}[kind]
    images = with_stated(setup, *STATED[kind]).replace(has_joint_values=has_joint_values)
    fit = dh.calibrate(chain, images, others)
    assert fit.verdict.is_refused
    assert fit.hand_eye is not None
    assert [cause.cause for cause in fit.hand_eye.causes] == ["stated poses"]
    (reason,) = fit.verdict.reasons
    assert f"the stated pose of {kind} '{kind}0' is inverse, of its link in the {kind}" in reason
    assert f"State the pose of the {kind} in its link" in reason
    assert f"Or add {kind} to --parameters." in reason
    assert dh.calibrate(chain, images, f"{others},{kind}").verdict.status == "ok"
    right = {"camera": (AS_IT_IS, None), "board": (None, AS_IT_IS)}[kind]
    assert dh.calibrate(chain, with_stated(setup, *right), others).verdict.status == "ok"


def test_the_difference_of_another_held_pose_is_stated():
    chain, _, setup = faulty_setup("ur10", "nothing", 41, is_on_wrist=True, n_images=15)
    moved = se3.transform(se3.exp3(np.array([0.0, 0.02, 0.0])), np.array([0.006, 0.0, -0.008]))
    images = with_stated(setup, lambda pose: pose @ moved, None)
    fit = dh.calibrate(chain, images, "board,intrinsics")
    assert fit.hand_eye is not None
    (cause,) = fit.hand_eye.causes
    assert cause.cause == "stated poses"
    assert re.search(r"the stated pose of camera 'camera0' is (9.9|10.0)\d* mm and 1.1", cause.text)
    assert cause.remedy.startswith("Correct xyz_m and rotvec_rad of the camera in the rig file.")


OTHERS = [("offsets", "joint offsets"), ("focal", "lens"), ("size", "board size"), ("rows", "pairing")]


@pytest.mark.parametrize(("fault", "cause"), some_slow(OTHERS, {0}))
@pytest.mark.parametrize(("name", "is_on_wrist"), some_slow([("ur10", True), ("panda", False)], {0}))
def test_right_held_poses_are_not_the_cause_of_other_faults(name, is_on_wrist, fault, cause):
    chain, images, setup = faulty_setup(name, fault, 31, is_on_wrist=is_on_wrist, n_images=20)
    true = setup.exact.rig.cameras[0].pose
    rig = replace(images.rig, cameras=(replace(images.rig.cameras[0], pose=true),))
    data = CameraCorners(images.q, images.values, images.corner, rig)
    found = dh.calibrate(chain, data, "board", loss="linear").hand_eye
    assert found is not None
    assert [each.cause for each in found.causes][:1] == [cause]
    assert "stated poses" not in [each.cause for each in found.alternatives]


def test_a_pose_that_is_its_own_inverse_is_not_inverse():
    """Half a turn is its own inverse; a pose near the link is near its inverse."""
    for vector, position in (([np.pi, 0, 0], [0, 0.1, 0.2]), ([0, 0, 0.05], [0.001, 0, 0])):
        pose = se3.transform(se3.exp3(np.array(vector)), np.array(position, float))
        assert not PoseDifference("camera_a", pose, pose).is_inverse
    pose = se3.transform(se3.exp3(np.array([0.3, 0.5, 1.0])), np.array([0.1, 0.05, 0.2]))
    assert PoseDifference("camera_a", se3.inverse(pose), pose).is_inverse
    assert not PoseDifference("camera_a", 2.0 * pose - np.diag([1, 1, 1, 1.0]), pose).is_inverse
