"""Images of another resolution than stated, and lenses that are far from the stated ones, are named."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from camera_setups import ARMS, simulate, wrong_arm
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin.calibration.verdict import _largest_image_error
from dhcal_pin.cameras import Camera
from dhcal_pin.cameras.resolution import (
    FACTORS,
    Resolution,
    describe_resolution,
    find_resolution,
    is_far,
)
from dhcal_pin.measurements import CameraCorners

pytestmark = pytest.mark.usefixtures("own_loss", "uneventful", "ordered_axes")

STATED = np.array([1000.0, 1000.0, 640.0, 480.0, 0, 0, 0, 0, 0])


def photograph(seed, intrinsics_error, n_images=20):
    """Simulate images of 1280 x 960 px of an arm that is wrong by 1 mm."""
    rng, arm = np.random.default_rng(seed), list(ARMS.values())[seed % 3]()
    truth = wrong_arm(arm, 1e-3, rng)
    setup = simulate(
        arm,
        truth,
        rng,
        is_on_wrist=seed % 2 == 0,
        n_images=n_images,
        sigma=0.1,
        spread=0.8,
        intrinsics_error=intrinsics_error,
    )
    return arm, setup.images


def resized(images, factor):
    """Return images of another resolution; pixel centres have whole coordinates."""
    return images.replace(values=factor * (images.values + 0.5) - 0.5)


def with_camera(images, **changes):
    """Return images with another camera in their rig, whose poses are unknown."""
    camera = replace(images.rig.cameras[0], **changes)
    rig = replace(images.rig, cameras=(camera,))
    return CameraCorners(images.q, images.values, images.corner, rig)


def corrected(images, factor):
    """Return images with the camera that a user states who follows the advice."""
    camera = images.rig.cameras[0]
    values = np.concatenate([factor * camera.values[:4], camera.values[4:]])
    width, height = round(factor * camera.width), round(factor * camera.height)
    return with_camera(images, width=width, height=height, values=values)


@cache
def verdict_of_right_lens(seed, intrinsics_error):
    """Return the verdict of images whose rig states their resolution and their lens."""
    arm, images = photograph(seed, intrinsics_error)
    return dh.calibrate(arm, images, loss="linear").verdict.status


@pytest.mark.parametrize("factor", FACTORS)
def test_a_resolution_scales_focal_lengths_and_image_centre(factor):
    camera = Camera("c", "tip", 1280, 960, STATED)
    found = factor * np.pad([1020.0, 1020.0, 660.0, 460.0], (0, 5))
    seen = np.array([[10.0, 10.0], [1270.0, 950.0]])
    corners = factor * seen
    assert find_resolution(camera, found, corners) == (pytest.approx(factor), False)
    # The images have the stated size, and the lens is that of another one.
    assert find_resolution(camera, found, seen) == (pytest.approx(factor), True)
    assert find_resolution(camera, found, 1.1 * max(factor, 1.0) * seen) is None
    only_focal = np.concatenate([found[:2], STATED[2:]])
    assert find_resolution(camera, only_focal, corners) is None


@pytest.mark.parametrize(
    ("focal", "shift", "is_expected"), [(1.02, 20.0, False), (1.2, 0, False), (1.3, 0, True), (1, 300, True)]
)
def test_a_usual_lens_is_neither_another_resolution_nor_far(focal, shift, is_expected):
    camera = Camera("c", "tip", 1280, 960, STATED)
    found = np.concatenate([focal * STATED[:2], STATED[2:4] - shift, STATED[4:]])
    assert find_resolution(camera, found, np.zeros((0, 2))) is None
    assert is_far(camera, found) == is_expected
    assert not is_far(replace(camera, intrinsics="free"), found)


@pytest.mark.parametrize("factor", [1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2, 3, 4])
def test_factors_between_usual_resolutions_are_known(factor):
    camera = Camera("c", "tip", 1280, 960, STATED)
    found = find_resolution(camera, np.concatenate([factor * STATED[:4], STATED[4:]]), np.zeros((1, 2)))
    assert found is not None
    assert found.factor == pytest.approx(factor)


@pytest.mark.parametrize(
    ("index", "ratio", "is_found"),
    [
        *((i, r, True) for i in range(4) for r in (0.91, 1.09)),
        *((i, r, False) for i in range(4) for r in (0.86, 1.14)),
    ],
)
def test_each_value_of_another_resolution_differs_by_up_to_a_tenth(index, ratio, is_found):
    camera, found = Camera("c", "tip", 1280, 960, STATED), 2 * STATED
    found[index] *= ratio
    assert (find_resolution(camera, found, np.zeros((0, 2))) is not None) == is_found


@pytest.mark.parametrize("place", range(4))
def test_a_lens_that_is_not_known_or_not_possible_has_no_resolution(place):
    camera = Camera("c", "tip", 1280, 960, STATED)
    for value in (0.0, -1.0):
        found = 2 * STATED
        found[place] = value
        assert find_resolution(camera, found, np.zeros((0, 2))) is None
        assert find_resolution(replace(camera, values=found), 2 * STATED, np.zeros((0, 2))) is None
        # Opposite signs on both sides are no factor.
        assert find_resolution(replace(camera, values=found), 2 * found, np.zeros((0, 2))) is None
    unknown = np.where(np.arange(9) < 4, np.nan, 0.0)
    assert find_resolution(replace(camera, values=unknown), 2 * STATED, np.zeros((0, 2))) is None


@pytest.mark.parametrize(
    ("factor", "corner", "is_of_lens"),
    [
        # Within the stated size of larger images: those of the lens. Otherwise the images are larger.
        (2, (1279, 959), True),
        (2, (1280, 500), False),
        (2, (500, 960), False),
        (2, (2559, 1919), False),
        (2, (2560, 500), None),
        (2, (500, 1920), None),
        # Within the smaller images: the images are smaller. Otherwise the lens is of smaller ones.
        (0.5, (639, 479), False),
        (0.5, (640, 100), True),
        (0.5, (100, 480), True),
        (0.5, (1280, 100), None),
    ],
)
def test_corners_tell_another_resolution_of_the_images_from_that_of_the_lens(factor, corner, is_of_lens):
    camera = Camera("c", "tip", 1280, 960, STATED)
    found = find_resolution(camera, factor * STATED, np.array([[10.0, 10.0], corner], float))
    assert found == (None if is_of_lens is None else (factor, is_of_lens))


def test_resolutions_are_described_with_their_remedy():
    camera = Camera("c", "tip", 1280, 960, STATED)
    images, lens = Resolution(1.5, False), Resolution(1.5, True)
    assert describe_resolution(camera, images) == "the images are 1920 x 1440 px, not 1280 x 960 px"
    assert (
        describe_resolution(camera, lens)
        == "fx, fy, cx and cy are those of images of 853 x 640 px, not of 1280 x 960 px"
    )
    assert images.remedy == "Correct width, height, fx, fy, cx and cy of the camera."
    assert lens.remedy == "Correct fx, fy, cx and cy of the camera."


@pytest.mark.parametrize(("change", "is_expected"), [(250.0, False), (251.0, True), (-251.0, True)])
@pytest.mark.parametrize("index", range(4))
def test_a_change_above_five_standard_deviations_of_the_prior_is_far(index, change, is_expected):
    camera, found = Camera("c", "tip", 1280, 960, STATED), STATED.copy()
    found[index] += change
    assert is_far(camera, found) == is_expected
    # Coefficients of the distortion do not count.
    assert not is_far(camera, STATED + 1e3 * (np.arange(9) >= 4))
    assert not is_far(replace(camera, intrinsics="fixed"), found)


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize(
    ("seed", "factor", "size"),
    some_slow(
        [(0, 1 / 2, "640 x 480"), (1, 2 / 3, "853 x 640"), (2, 3 / 4, "960 x 720"), (3, 1 / 4, "320 x 240")],
        {0},
    ),
)
def test_another_resolution_is_named_and_its_correction_helps(seed, factor, size):
    arm, images = photograph(seed, intrinsics_error=0.02)
    images = resized(images, factor)
    fit, right = (dh.calibrate(arm, data, loss="linear") for data in (images, corrected(images, factor)))
    assert fit.verdict.status == "caution"
    (reason,) = [text for text in fit.verdict.reasons if "resolution" in text or "the images are" in text]
    assert f"the images are {size} px, not 1280 x 960 px" in reason
    assert right.verdict.status == "ok"


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize(
    ("seed", "factor", "size"), some_slow([(0, 1 / 2, "640 x 480"), (1, 2.0, "2560 x 1920")], {0})
)
def test_a_lens_of_another_resolution_is_named_and_its_correction_helps(seed, factor, size):
    """The size of the images was right: the advice to change it made the rig wrong."""
    arm, images = photograph(seed, intrinsics_error=0.02)
    lens = images.rig.cameras[0].values
    wrong = with_camera(images, values=np.concatenate([factor * lens[:4], lens[4:]]))
    fit = dh.calibrate(arm, wrong, loss="linear")
    reasons = [text for text in fit.verdict.reasons if "fx, fy, cx and cy are those of images" in text]
    assert len(reasons) == 1
    assert f"of images of {size} px, not of 1280 x 960 px" in reasons[0]
    assert reasons[0].endswith("Correct fx, fy, cx and cy of the camera.")
    assert verdict_of_right_lens(seed, 0.02) == "ok"


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize("seed", some_slow(range(6), {0}))
def test_a_lens_that_is_wrong_by_2_percent_is_no_reason(seed):
    assert verdict_of_right_lens(seed, 0.02) == "ok"


@pytest.mark.usefixtures("untried")
def test_a_lens_of_another_camera_is_named():
    """The rig states a lens with a focal length that is 1.4 times the true one."""
    arm, images = photograph(0, intrinsics_error=0.0)
    lens = images.rig.cameras[0].values
    wrong = with_camera(images, values=np.concatenate([1.4 * lens[:2], lens[2:]]))
    fit = dh.calibrate(arm, wrong, loss="linear")
    assert fit.verdict.status == "caution"
    (reason,) = [text for text in fit.verdict.reasons if "far from the stated one" in text]
    assert f"not {1.4 * lens[0]:.0f}, {1.4 * lens[1]:.0f} px" in reason
    assert verdict_of_right_lens(0, 0.0) == "ok"


@pytest.mark.parametrize("seed", some_slow([3, 1, 2], {1}))
def test_another_resolution_with_a_held_lens_is_the_likely_cause(seed):
    arm, images = photograph(seed, intrinsics_error=0.0, n_images=16)
    images = with_camera(resized(images, 0.5), intrinsics="fixed")
    parts = images.image % 4 > 0, images.image % 4 == 0
    fit, right = (
        dh.calibrate(arm, data.take(parts[0]), "camera,board", holdout=data.take(parts[1]), loss="linear")
        for data in (images, corrected(images, 0.5))
    )
    assert fit.hand_eye is not None
    assert any("the images are 640 x 480 px, not 1280 x 960 px" in text for text in fit.verdict.reasons)
    errors = [fit.comparisons[i].after.groups["pixels"].rms for i in (0, -1)]
    assert (fit.verdict.status == "refused") == (max(*errors, fit.hand_eye.error.pixels) > 50)
    assert right.verdict.status != "refused"
    assert not any("the images are" in text for text in right.verdict.reasons)


@pytest.mark.parametrize(
    ("fitted", "left_out", "held_out", "error", "has_note"),
    [(36, 41, 62, 62, True), (36, 55, 49, 55, False), (36, 41, 49, 41, False), (70, 55, 62, 70, False)],
)
def test_the_largest_error_of_images_decides(fitted, left_out, held_out, error, has_note):
    groups = {"pixels": SimpleNamespace(rms=held_out, rms_std=1.0)}
    comparison = SimpleNamespace(title="hold-out", after=SimpleNamespace(groups=groups))
    hand_eye = SimpleNamespace(causes=["lens"], error=SimpleNamespace(pixels=left_out))
    fit: Any = SimpleNamespace(comparisons=[comparison], hand_eye=hand_eye, holdout_mistake=None)
    largest, note = _largest_image_error(fit, fitted)
    assert largest == error
    assert ("Hold-out images have an error of 62" in note) == has_note
