"""A hand-eye calibration names the likely cause of its error: each fault alone, and nothing wrong."""

from dataclasses import replace
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from camera_setups import ARMS
from hand_eye_setups import SIGMA, faulty_setup
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.calibration.cameras.causes import (
    ARM_SETS,
    GEOMETRY,
    OFFSETS,
    Causes,
    HandEyeData,
    apply_causes,
    file_sequence,
    find_minimum,
    find_shift,
)
from dhcal_pin.calibration.cameras.diagnosis import (
    HandEyeDiagnosis,
    Trial,
    _arm_text,
    _lens_text,
    _n_examined,
    _px,
    _without_rigid_motion,
)
from dhcal_pin.calibration.cameras.stages import ImageError, held_out_error
from dhcal_pin.calibration.evaluation import compute_errors
from dhcal_pin.calibration.partition import k_fold
from dhcal_pin.estimation import select_parameters
from dhcal_pin.estimation.solver import minimize
from dhcal_pin.measurements import CameraCorners
from dhcal_pin.plausibility.hypotheses import mend
from dhcal_pin.report.json_document import json_text, result_to_dict

pytestmark = pytest.mark.usefixtures("own_loss", "uneventful", "ordered_axes")

# Cause that should be named for each fault.
CAUSES = {
    "arm": "arm geometry",
    "offsets": "joint offsets",
    "size": "board size",
    "warped": "board corners",
    "corners": "board corners",
    "focal": "lens",
    "centre": "lens",
    "distortion": "lens",
    "lag": "pairing",
    "rows": "pairing",
}


def hand_eye(name, fault, seed, is_on_wrist, sets="camera,board", loss="linear", **options):
    """Calibrate the poses of a set-up with one fault."""
    chain, images, _ = faulty_setup(name, fault, seed, is_on_wrist=is_on_wrist, **options)
    return dh.calibrate(chain, images, sets, loss=loss)


def check_cause(fit, fault):
    """Check that the cause of a fault is named, as the reason of caution, with the error in millimetres."""
    found = fit.hand_eye
    assert [cause.cause for cause in found.causes][:1] == [CAUSES[fault]]
    assert not found.is_noise
    # Half of the error is explained, or all but the noise of two image coordinates.
    assert found.causes[0].error.pixels < max(0.5 * found.error.pixels, 1.1 * np.sqrt(2) * SIGMA)
    assert fit.verdict.status != "ok"
    (reason,) = (text for text in fit.verdict.reasons if "Likely cause" in text)
    assert found.causes[0].text in reason
    assert found.causes[0].remedy in reason
    # A cause that contains the first one is no alternative to it.
    containing = {"offsets": "arm geometry", "size": "board corners"}.get(fault)
    assert containing not in [each.cause for each in found.alternatives]
    assert "mm at the board" in reason


@pytest.mark.parametrize(
    ("name", "fault", "seed", "is_on_wrist"),
    some_slow(
        [("panda", "offsets", 22, False), ("xarm7", "distortion", 26, True), ("ur10", "lag", 27, True)], {2}
    ),
)
def test_the_cause_of_a_fault_is_named(name, fault, seed, is_on_wrist):
    # Images close together, between which a lag causes a small error.
    spread = 0.02 if fault == "lag" else 0.5
    check_cause(hand_eye(name, fault, seed, is_on_wrist, n_images=20, spread=spread), fault)


@pytest.mark.parametrize("sets", [None, "camera,board"])
def test_the_arm_is_proposed_only_if_it_was_not_estimated(sets):
    """Eight images are too few to decide whether the arm is wrong."""
    fit = hand_eye("panda", "offsets", 22, False, sets, n_images=8)
    check_cause(fit, "offsets")
    (reason,) = fit.verdict.reasons
    assert ("Estimate the arm, too, without --parameters." in reason) == (sets is not None)
    assert ("The arm was estimated, too;" in reason) == (sets is None)


def test_rejected_corners_do_not_hide_a_bent_board():
    """The corners at the ends of the board disagree with the majority; they are right."""
    fit = hand_eye("panda", "warped", 11, True, loss="auto", n_images=20)
    check_cause(fit, "warped")
    assert fit.hand_eye is not None
    assert "it is not flat" in fit.hand_eye.causes[0].text


@pytest.mark.slow
@pytest.mark.parametrize("seed", [31, 32, 33])
@pytest.mark.parametrize("is_on_wrist", [True, False])
@pytest.mark.parametrize("name", ["ur10", "panda", "xarm7"])
@pytest.mark.parametrize("fault", CAUSES)
def test_the_cause_of_every_fault_is_named(name, fault, seed, is_on_wrist):
    check_cause(hand_eye(name, fault, seed, is_on_wrist), fault)


def check_nothing(fit):
    """Check that a right hand-eye calibration has no cause."""
    assert fit.verdict.status == "ok"
    assert fit.hand_eye.is_noise
    assert fit.hand_eye.causes == ()
    assert fit.hand_eye.noise.distance == pytest.approx(fit.hand_eye.error.distance, rel=0.1)


@pytest.mark.parametrize(
    ("name", "is_on_wrist", "sigma"), some_slow([("ur10", True, SIGMA), ("panda", False, 2.0)], {1})
)
def test_noise_has_no_cause(name, is_on_wrist, sigma):
    check_nothing(hand_eye(name, "nothing", 41, is_on_wrist, n_images=20, sigma=sigma))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(42, 47))
@pytest.mark.parametrize("is_on_wrist", [True, False])
@pytest.mark.parametrize("name", ["ur10", "panda", "xarm7", "paper"])
def test_noise_never_has_a_cause(name, is_on_wrist, seed):
    check_nothing(hand_eye(name, "nothing", seed, is_on_wrist))


@pytest.mark.parametrize(("n_seeds", "step"), some_slow([(2, 2), (12, 1)], {0}))
def test_noise_of_few_images_is_predicted(n_seeds, step):
    """Six images: the noise of the fitted ones adds to the error of a left-out one."""
    found = []
    for name, is_on_wrist, seed in list(product(("ur10", "panda"), (True, False), range(n_seeds)))[::step]:
        result = hand_eye(name, "nothing", 160 + seed, is_on_wrist, n_images=6)
        assert result.hand_eye is not None
        found.append(result.hand_eye)
    assert np.median([each.error.pixels / each.noise.pixels for each in found]) < 1.15
    assert np.mean([each.is_noise for each in found]) > 0.85


def test_figures_of_the_causes_are_true():
    """The size of a board and the focal length are those of the simulation; the document names the cause."""
    chain, images, setup = faulty_setup("ur10", "size", 51, is_on_wrist=True, n_images=20, severity=0.1)
    fit = dh.calibrate(chain, images, "camera,board", loss="linear")
    check_cause(fit, "size")
    found = fit.hand_eye
    assert found is not None
    # Errors of the arm explain the images as well, with more unknowns.
    assert [cause.cause for cause in found.alternatives] == ["arm geometry"]
    value = float(found.causes[0].text.split("squares of ")[1].split(" ")[0])
    change = 1e-3 * value / setup.images.rig.boards[0].square - 1
    assert abs(change) == pytest.approx(0.003, rel=0.1)
    chain, images, setup = faulty_setup("ur10", "focal", 52, is_on_wrist=True, n_images=20)
    fit = dh.calibrate(chain, images, "camera,board", loss="linear")
    check_cause(fit, "focal")
    found = fit.hand_eye
    assert found is not None
    value = float(found.causes[0].text.split(": ")[1].split(",")[0])
    assert value == pytest.approx(setup.exact.rig.cameras[0].values[0], rel=2e-3)
    assert found.noise.pixels == pytest.approx(np.sqrt(2) * SIGMA, rel=0.05)
    document = result_to_dict(fit, {}, {})["hand_eye"]
    assert document["causes"][0]["cause"] == "lens"
    assert document["error"]["board_rms_m"] > 2 * document["noise"]["board_rms_m"]
    assert document["text"] in fit.verdict.reasons
    assert "Infinity" not in json_text(document)


def test_two_faults_are_named_in_turn():
    """The lens and the arm are wrong: the poses alone, the lens alone and the arm alone leave an error."""
    chain, images, setup = faulty_setup("ur10", "arm", 53, is_on_wrist=False, n_images=20)
    camera = images.rig.cameras[0]
    values = camera.values.copy()
    values[2:4] += 40
    rig = dh.mount_rig(
        dh.cameras.Rig(
            {camera.name: dh.cameras.Camera(camera.name, camera.link, 1280, 960, values, camera.lens)},
            {board.name: board for board in images.rig.boards},
        ),
        chain,
    )
    data = CameraCorners(images.q, images.values, images.corner, rig)
    found = dh.calibrate(chain, data, "camera,board", loss="linear").hand_eye
    assert found is not None
    assert {cause.cause for cause in found.causes} == {"lens", "arm geometry"}
    assert found.causes[-1].error.pixels < 2.5 * setup.sigma


@pytest.mark.parametrize("has_names", some_slow([True, False], ()))
def test_images_with_wrong_joint_values_are_counted(has_names):
    chain, images, _ = faulty_setup("panda", "nothing", 54, is_on_wrist=True, n_images=16)
    q = np.unique(images.q, axis=0)
    swapped = images.q.copy()
    for first, second in ((3, 13), (8, 15)):
        swapped[np.all(images.q == q[first], 1)] = q[second]
        swapped[np.all(images.q == q[second], 1)] = q[first]
    # The camera moved in one image, and in another one by less than five times the error of the others.
    moved = images.values + sum(px * np.all(images.q == q[i], 1)[:, None] for i, px in ((6, 4.0), (10, 0.9)))
    names = [f"{np.flatnonzero(np.all(q == each, 1))[0]:04}.png" for each in images.q]
    image_names = names if has_names else None
    data = CameraCorners(swapped, moved, images.corner, images.rig, image_names=image_names)
    fit = dh.calibrate(chain, data, "camera,board")
    assert fit.hand_eye is not None
    assert fit.hand_eye.n_wrong_images == 5
    assert fit.hand_eye.is_noise
    (text,) = [text for text in fit.verdict.reasons if "5 images do not fit the others" in text]
    listed = fit.hand_eye.to_dict()["wrong_image_names"]
    if image_names is None:
        assert "left out: check" in text
        assert listed == []
    else:
        assert sorted(listed) == ["0003.png", "0006.png", "0008.png", "0013.png", "0015.png"]
        assert f"left out ({', '.join(listed[:3])} and 2 more): check" in text


@pytest.mark.parametrize("has_joint_values", some_slow([True, False], {0}))
def test_joint_values_that_are_wrong_at_random_displace_images(has_joint_values):
    """As of an arm that had not stopped; no cause that is tried explains the images."""
    chain, images, _ = faulty_setup("ur10", "nothing", 61, is_on_wrist=True, n_images=8)
    wrong = np.random.default_rng(0).normal(0, 2e-3, (images.n_images, chain.n_joints))
    data = images.replace(q=images.q + wrong[images.image], has_joint_values=has_joint_values)
    found = dh.calibrate(chain, data, "camera,board", loss="linear").hand_eye
    assert found is not None
    assert [cause.cause for cause in found.causes] == ["displaced images"]
    assert "all corners of an image are displaced together" in found.likely
    # With joint values, errors of the geometry were tried.
    assert ("errors of the arm of another kind" in found.likely) == has_joint_values


@pytest.mark.parametrize("has_joint_values", some_slow([True, False], {1}))
def test_poses_with_systematic_mistakes_are_no_errors_of_the_arm(has_joint_values):
    """Neither deflection nor an arm that had not stopped displaces images by hundreds of pixels."""
    chain, images, _ = faulty_setup("ur10", "nothing", 61, is_on_wrist=True, n_images=10)
    factors = np.where(np.arange(chain.n_joints) == 1, 0.6, 1.0)
    data = images.replace(q=images.q * factors, has_joint_values=has_joint_values)
    fit = dh.calibrate(chain, data, "camera,board", loss="linear")
    found = fit.hand_eye
    assert found is not None
    assert fit.verdict.status == "refused"
    assert found.error.pixels > 50
    stated = "joint values" if has_joint_values else "flange poses"
    assert f"Likely cause: wrong {stated}: no deflection" in found.likely
    assert ("zeros of the joints" in found.likely) == has_joint_values
    assert "take more images" not in found.likely


@pytest.mark.usefixtures("untried")
def test_similar_rotations_are_named():
    """An arm that is wrong and turns little: the camera is wrong by more than the images show."""
    chain, images, setup = faulty_setup(
        "panda", "arm", 55, is_on_wrist=True, n_images=20, severity=0.5, spread=0.06
    )
    fit = dh.calibrate(chain, images, "camera,board", loss="linear")
    assert fit.hand_eye is not None
    assert fit.rig is not None
    found, true = fit.rig.cameras[0].pose, setup.exact.rig.cameras[0].pose
    assert found is not None
    assert true is not None
    assert np.linalg.norm(found[:3, 3] - true[:3, 3]) > 5 * fit.hand_eye.error.distance
    assert fit.hand_eye.has_few_rotations
    assert any("turned by 30° or more" in text for text in fit.verdict.reasons)


@pytest.mark.parametrize("sets", some_slow(["base,tool,camera", "camera", "base,camera,board"], {1}))
def test_other_names_of_the_poses(sets):
    """Base and tool move camera and board along: the error and its cause are the same."""
    found, alone = (
        hand_eye("ur10", "arm", 56, True, names, n_images=12).hand_eye for names in (sets, "camera,board")
    )
    assert found is not None
    assert alone is not None
    assert found.error.pixels == pytest.approx(alone.error.pixels, rel=0.05)
    assert found.causes[0].cause == "arm geometry"
    assert not found.has_few_rotations


def test_a_calibrated_arm_has_no_hand_eye_diagnosis():
    chain, images, _ = faulty_setup("ur10", "arm", 57, is_on_wrist=True, n_images=20)
    fit = dh.calibrate(chain, images, loss="linear")
    assert fit.hand_eye is None
    assert result_to_dict(fit, {}, {})["hand_eye"] is None


def test_four_images_cannot_be_left_out():
    chain, images, _ = faulty_setup("ur10", "nothing", 58, is_on_wrist=True, n_images=20)
    fit = dh.calibrate(chain, images.take(images.image < 4), "camera,board", loss="linear")
    assert fit.hand_eye is None


def test_one_step_leads_to_the_fit_of_the_other_images():
    chain, images, _ = faulty_setup("ur10", "nothing", 58, is_on_wrist=True, n_images=8)
    hand_eye_fit = dh.calibrate(chain, images, "camera,board", loss="linear", session="off").hand_eye_fit
    assert hand_eye_fit is not None
    fit, squares = hand_eye_fit.fit, []
    folds = k_fold(fit.data, 4)
    for (is_left_out,) in folds:
        others = fit.problem.with_data([fit.problem.data[0].take(~is_left_out)])
        known = others.instruments(minimize(others, "lm", fit.solution.x, 30).x)
        squares.append(compute_errors(chain, [fit.data[0].take(is_left_out)], known)[0]["pixels"] ** 2)
    expected = np.sqrt(np.concatenate(squares).sum(1).mean())
    error = held_out_error(fit, folds)
    assert error is not None
    assert error.pixels == pytest.approx(expected, rel=0.02)


def test_causes_are_stated_in_turn():
    lens, size = (Trial(name, ImageError(e, 1e-4 * e, 99), f"the {name}", f"Measure the {name}.")
                  for name, e in (("lens", 4.0), ("size", 0.6)))  # fmt: skip
    error, noise = ImageError(9.0, 9e-4, 99), ImageError(0.5, 5e-5, 99)
    found = HandEyeDiagnosis(error, noise, (lens, size), (), (lens,), 0.05, 1e-3, (), "joint values")
    assert found.likely.startswith(" Likely cause: the lens.")
    assert " In addition: the size." in found.likely
    assert found.likely.endswith(" Measure the lens. Measure the size.")
    assert "displaces the camera by up to 20 mm" in found.image_sentences[0]
    assert "displaces the camera by metres" in replace(found, rotation=0.0).image_sentences[0]
    assert replace(found, causes=()).likely.startswith(" No cause that was tried explains it")


@pytest.mark.usefixtures("untried")
def test_messages_speak_of_flange_poses_where_the_files_state_them():
    chain, images, _ = faulty_setup("ur10", "nothing", 27, is_on_wrist=True, n_images=9)
    # One image is paired with the configuration of another one.
    q = images.q.copy()
    q[images.image == 3] = images.q[images.image == 7][0] + 0.05
    fit = dh.calibrate(chain, images.replace(q=q, has_joint_values=False), "camera,board")
    assert fit.hand_eye is not None
    assert fit.hand_eye.n_wrong_images == 1
    assert "check the flange poses in its rows" in fit.hand_eye.image_sentences[0]
    assert "joint values" not in " ".join([*fit.verdict.reasons, fit.hand_eye.likely])


def test_a_shift_of_flange_poses_is_named():
    chain, images, _ = faulty_setup("ur10", "rows", 27, is_on_wrist=True, n_images=15)
    fit = dh.calibrate(chain, images.replace(has_joint_values=False), "camera,board", loss="linear")
    check_cause(fit, "rows")
    assert fit.hand_eye is not None
    assert "belongs to the flange poses one row" in fit.hand_eye.likely
    assert "Correct the table of flange poses, or add --mend rows:below." in fit.hand_eye.likely
    mended = mend(chain, images, "rows:below").replace(has_joint_values=False)
    after = dh.calibrate(chain, mended, "camera,board", loss="linear")
    assert after.hand_eye is not None
    assert after.hand_eye.is_noise
    # No other cause is tried.
    assert [trial.cause for trial in fit.hand_eye.trials] == ["pairing"]
    with pytest.raises(dh.DhcalError, match="'minimal': need joint values"):
        dh.calibrate(chain, images.replace(has_joint_values=False), "minimal,camera,board")


def test_shifted_joint_values_lie_between_those_of_two_images():
    chain, images, _ = faulty_setup("ur10", "focal", 27, is_on_wrist=True, n_images=9)
    sequence = file_sequence([images])
    hand_eye = HandEyeData(select_parameters(chain, "base"), (images,), {}, sequence, False)
    number = np.argmax((images.q[:, None] == sequence).all(-1), 1)
    for shift in (-1.25, -1.0, 0.4, 2.0):
        found = apply_causes(hand_eye, Causes(shift=shift), images)
        place = number + shift
        inside = (place >= 0) & (place <= 8)
        expected = [np.interp(place[inside], np.arange(9), column) for column in sequence.T]
        np.testing.assert_allclose(found.q, np.transpose(expected), atol=1e-12)
    # The size of another board changes nothing.
    (board,) = apply_causes(hand_eye, Causes(sizes={"other": 1.1}), images).rig.boards
    np.testing.assert_array_equal(board.points, images.rig.boards[0].points)


@pytest.mark.parametrize("shift", some_slow([1.0, 2.0], {1}))
def test_images_of_the_rows_before_are_paired_again(shift):
    """`test_a_shift_of_flange_poses_is_named` has a shift in the other direction."""
    chain, images, _ = faulty_setup("ur10", "nothing", 27, is_on_wrist=True, n_images=8)
    right = HandEyeData(select_parameters(chain, "base"), (images,), {}, file_sequence([images]), False)
    shifted = replace(right, data=(apply_causes(right, Causes(shift=shift), images),))
    assert find_shift(shifted, Causes()) == -shift
    # Three images are too few to show one.
    (later,) = shifted.data
    assert isinstance(later, CameraCorners)
    few = later.take(np.isin(later.image, np.unique(later.image)[:3]))
    assert find_shift(replace(shifted, data=(few,), sequence=file_sequence([few])), Causes()) == 0.0


@pytest.mark.parametrize(
    ("name", "change", "text"),
    [("k1", 0.1, "distortion of camera"), ("cy", 50.0, "cx, cy of camera"), ("fy", 90.0, "fx, fy of camera")],
)
def test_the_values_of_the_lens_that_change_are_named(name, change, text):
    chain, images, _ = faulty_setup("ur10", "nothing", 27, is_on_wrist=True, n_images=5)
    camera = images.rig.cameras[0]
    found = dict(zip(camera.lens.names, camera.values, strict=True))
    found[name] += change
    state: Any = SimpleNamespace(values={f"camera_{camera.name}.{name}": v for name, v in found.items()})
    hand_eye = HandEyeData(select_parameters(chain, "base"), (images,), {}, file_sequence([images]), False)
    assert text in _lens_text(hand_eye, state)[0]


@pytest.mark.parametrize(
    ("sets", "parameter", "text"),
    [
        (GEOMETRY, "shoulder_pan_joint.x", "move the axis of shoulder_pan_joint by 1.000 mm"),
        (GEOMETRY, "wrist_3_joint.y", "move the tool by 1.000 mm"),
        (OFFSETS, "elbow_joint.offset", "its joint offsets, elbow_joint.offset 0.0573°"),
    ],
)
def test_the_largest_error_of_the_arm_is_named(sets, parameter, text):
    """The last axis of a UR10 is the y axis of its frame: a shift along it moves the tool only."""
    errors = select_parameters(ARMS["ur10"](), ARM_SETS[sets])
    x = np.array([1e-3 * (p.name == parameter) for p in errors.parameters])
    fit = SimpleNamespace(problem=SimpleNamespace(errors=errors), solution=SimpleNamespace(x=x))
    state: Any = SimpleNamespace(fit=fit, causes=Causes(arm=ARM_SETS[sets]))
    for is_arm_tried, remedy in ((False, "Estimate the arm, too"), (True, "The arm was estimated, too")):
        hand_eye: Any = SimpleNamespace(is_arm_tried=is_arm_tried)
        found, what_to_do = _arm_text(hand_eye, state)
        assert text in found
        assert what_to_do.startswith(remedy)


def test_a_rigid_motion_does_not_bend_a_board():
    rng = np.random.default_rng(0)
    stated = rng.uniform(-0.1, 0.1, (12, 3)) + np.array([0.3, 0.1, 0.2])
    moved = stated @ se3.exp3(np.array([0.2, -0.1, 0.4])).T + [0.5, -0.2, 0.1]
    np.testing.assert_allclose(_without_rigid_motion(moved, stated), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("cost", "least"),
    [
        (lambda x: (x - 0.3) ** 2, 0.3),
        (lambda x: (x + 0.02) ** 2, -0.02),
        (lambda x: np.exp(x) - 1.2 * x, np.log(1.2)),
        (lambda x: -np.cos(3 * (x - 0.25)), 0.25),
        (lambda x: abs(x - 0.012), 0.012),
        (lambda x: max(x - 0.0137, 3 * (0.0137 - x)), 0.0137),
        (lambda x: np.inf if x > 0.105 else (x - 0.1) ** 2, 0.1),
    ],
)
def test_a_minimum_of_a_function_is_found(cost, least):
    assert find_minimum(cost, 0.0, 0.01, 0.15) == pytest.approx(least, abs=1e-3)


@pytest.mark.parametrize(
    ("count", "per_image", "n_examined"), [(90, 100, 90), (400, 5, 300), (400, 20, 150), (400, 100, 100)]
)
def test_causes_are_looked_for_in_3000_corners_of_at_least_100_configurations(count, per_image, n_examined):
    assert _n_examined(count, count * per_image) == n_examined


@pytest.mark.parametrize(
    ("pixels", "text"), [(4990.0, "4990 px"), (5000.0, "5000 px"), (5010.0, "more than 5000 px")]
)
def test_errors_above_5000_pixels_are_not_stated(pixels, text):
    assert _px(pixels) == text


@pytest.mark.parametrize(("pixels", "has_noise"), [(4.0, True), (254.0, False)])
def test_large_errors_say_nothing_about_noise(pixels, has_noise):
    """Displacements of hundreds of pixels are not linear, and their rest within an image is not noise."""
    errors = ImageError(pixels, 0.01 * pixels, 100), ImageError(0.2 * pixels, 0.002 * pixels, 100)
    diagnosis = HandEyeDiagnosis(*errors, (), (), (), 1.0, 0.0, (), "joint values")
    assert ("noise" in diagnosis.error_sentence) == has_noise
