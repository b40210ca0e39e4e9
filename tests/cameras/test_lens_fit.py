"""Lens and poses of boards from the images of a camera alone, against the truth and OpenCV."""

import numpy as np
import pytest
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.cameras import LENSES, Board, Camera, lens_fit, pose_from_points
from dhcal_pin.cameras.lens_fit import _LensProblem, fit_camera, fit_lens, fit_unknown_lens
from dhcal_pin.cameras.pose_from_points import estimate_pose, estimate_poses
from dhcal_pin.exceptions import NotObservableError

cv2 = pytest.importorskip("cv2")
CHECKERBOARD = Board("b", "world", "checkerboard", columns=8, rows=6, square=0.03).points
MIDDLE = CHECKERBOARD.mean(0)
# True lenses with the values that a rig states, and standard deviations of these.
TRUE = {
    "pinhole": np.array([1040.0, 1050.0, 650.0, 490.0, -0.28, 0.08, 5e-4, -5e-4, 0.0]),
    "fisheye": np.array([1040.0, 1050.0, 650.0, 490.0, -0.05, 0.01, 0.0, 0.0]),
}
STATED = np.array([1000.0, 1000.0, 639.5, 479.5])
WIDTHS = {"stated": (50.0, 0.3), "free": (1e5, 1e2)}


def stated_lens(model, widths):
    """Return the values of a rig without distortion, and their standard deviations."""
    n_coefficients = len(TRUE[model]) - 4
    return np.pad(STATED, (0, n_coefficients)), np.repeat(WIDTHS[widths], [4, n_coefficients])


def images(rng, model, count=25, sigma=0.2, tilt=0.35):
    """Return poses of a little tilted board all over the image, and its views."""
    poses, views = [], []
    while len(views) < count:
        turn = se3.exp3(np.array([*rng.normal(0, tilt, 2), rng.uniform(-3, 3)]))
        position = np.array([*rng.uniform(-0.25, 0.25, 2), rng.uniform(0.5, 0.9)])
        pose = se3.transform(turn, position - turn @ MIDDLE)
        local = CHECKERBOARD @ pose[:3, :3].T + pose[:3, 3]
        pixels = LENSES[model].project(local.T, TRUE[model])[0].T
        if np.all((pixels > 0) & (pixels < [1280, 960])):
            poses.append(pose)
            views.append((CHECKERBOARD, pixels + sigma * rng.standard_normal(pixels.shape)))
    return np.array(poses), views


def angles(found, poses):
    """Return the angles of found poses to the true ones [rad]."""
    return np.array(
        [
            np.linalg.norm(se3.log3(each[0][0][:3, :3].T @ pose[:3, :3]))
            for each, pose in zip(found, poses, strict=True)
        ]
    )


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("seed", range(5))
def test_distorted_images_of_little_tilted_boards_give_the_right_poses(seed, model):
    """With the lens of the rig, boards appear tilted the other way."""
    poses, views = images(np.random.default_rng(seed), model)
    values, std = stated_lens(model, "stated")
    fit = fit_lens(views, LENSES[model], values, std)
    np.testing.assert_allclose(fit.values[:4], TRUE[model][:4], atol=10)
    assert angles(fit.poses, poses).max() < 0.05
    if model == "pinhole":
        assert angles(fit_lens(views, LENSES[model], values, 0 * std).poses, poses).max() > 0.2


@pytest.mark.parametrize("model", LENSES)
def test_exact_images_give_the_true_lens(model):
    poses, views = images(np.random.default_rng(0), model, sigma=0.0)
    fit = fit_lens(views, LENSES[model], *stated_lens(model, "free"))
    np.testing.assert_allclose(fit.values[:4], TRUE[model][:4], atol=0.05)
    assert angles(fit.poses, poses).max() < 1e-4


def test_a_frontal_board_has_one_pose():
    local = CHECKERBOARD - MIDDLE + [0, 0, 0.6]
    view = CHECKERBOARD, LENSES["pinhole"].project(local.T, TRUE["pinhole"])[0].T
    ((found,),) = fit_lens([view], LENSES["pinhole"], TRUE["pinhole"], np.zeros(9)).poses
    np.testing.assert_allclose(found[0], se3.transform(np.eye(3), [0, 0, 0.6] - MIDDLE), atol=1e-6)


@pytest.mark.parametrize("model", LENSES)
def test_a_focal_length_that_is_half_too_long_is_corrected(model):
    """The first steps are too large."""
    _, views = images(np.random.default_rng(0), model, count=6, sigma=0.0)
    values, std = stated_lens(model, "free")
    values[:2] *= 1.5
    fit = fit_lens(views, LENSES[model], values, std)
    np.testing.assert_allclose(fit.values[:4], TRUE[model][:4], atol=1)


def test_lens_agrees_with_opencv():
    _, views = images(np.random.default_rng(1), "pinhole", sigma=0.3)
    fit = fit_lens(views, LENSES["pinhole"], *stated_lens("pinhole", "free"))
    points, pixels = ([view[i].astype(np.float32) for view in views] for i in range(2))
    _, matrix, distortion, *_ = cv2.calibrateCamera(points, pixels, (1280, 960), None, None)
    expected = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    np.testing.assert_allclose(fit.values[:4], expected, atol=0.3)
    np.testing.assert_allclose(fit.values[4:8], distortion.ravel()[:4], atol=0.01)


def test_values_without_width_are_held():
    _, views = images(np.random.default_rng(2), "pinhole")
    values, std = stated_lens("pinhole", "stated")
    std[[2, 3, 8]] = 0.0
    fit = fit_lens(views, LENSES["pinhole"], values, std)
    np.testing.assert_array_equal(fit.values[[2, 3, 8]], values[[2, 3, 8]])
    np.testing.assert_allclose(fit.values[4], TRUE["pinhole"][4], atol=0.05)


def test_views_that_repeat_the_errors_of_one_count_as_one():
    values, std = stated_lens("pinhole", "stated")
    rows = np.random.default_rng(0).standard_normal((8, 10))
    gains = []
    for count in (1, 3):
        problem = _LensProblem([], LENSES["pinhole"], values, std, count)
        gains.append(problem._cost([rows] * count, values) - problem._cost([rows / 2] * count, values))
    assert gains[0] == pytest.approx(gains[1])


def test_a_value_one_standard_deviation_off_costs_one():
    """The cost is minus twice the logarithm of the density, here with the same errors of the images."""
    values, std = stated_lens("pinhole", "stated")
    std[8] = 0.0
    problem = _LensProblem([], LENSES["pinhole"], values, std, 1)
    before, after = (problem._cost([np.ones((8, 10))], values + k * std) for k in (0, 1))
    assert after - before == pytest.approx(8)


def test_images_without_a_pose_are_left_out():
    poses, views = images(np.random.default_rng(3), "pinhole")
    views.insert(4, (CHECKERBOARD[:3], views[0][1][:3]))
    fit = fit_lens(views, LENSES["pinhole"], *stated_lens("pinhole", "stated"))
    assert fit.poses[4] == []
    assert angles(fit.poses[:4] + fit.poses[5:], poses).max() < 0.05
    assert fit_lens([], LENSES["pinhole"], *stated_lens("pinhole", "stated")).poses == []


def test_poses_of_several_images_are_those_of_each():
    rng = np.random.default_rng(4)
    views = []
    for count in (10, 14, 35, 35, 21):
        points = rng.permutation(CHECKERBOARD)[:count]
        local = points @ se3.exp3(rng.uniform(-0.6, 0.6, 3)).T + [0.05, -0.1, 0.7]
        views.append((points, local[:, :2] / local[:, 2:] + 3e-4 * rng.standard_normal((count, 2))))
    for view, found in zip(views, estimate_poses(views), strict=True):
        alone = estimate_pose(*view)
        assert alone is not None
        np.testing.assert_allclose(found[0][0], alone[0], atol=1e-6)
        assert found[0][1] == pytest.approx(alone[1], rel=1e-6)


def without_focal_lengths(model):
    """Return a camera whose lens is not known, and standard deviations of first values."""
    n_coefficients = len(TRUE[model]) - 4
    values = np.repeat([np.nan, 0.0], [4, n_coefficients])
    return Camera("c", "world", 1280, 960, values, LENSES[model]), np.repeat([1e5, 0.3], [4, n_coefficients])


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("seed", some_slow(range(3), {0}))
def test_unknown_lenses_are_found_with_their_distortion(seed, model):
    poses, views = images(np.random.default_rng(seed), model)
    fit = fit_unknown_lens(views, *without_focal_lengths(model), repeats_errors=False)
    np.testing.assert_allclose(fit.values[:4], TRUE[model][:4], atol=15)
    assert np.all(np.abs(fit.values - TRUE[model])[:4] < 4 * fit.std[:4])
    assert angles(fit.poses, poses).max() < 0.05


def test_three_images_determine_a_lens_without_closed_forms(monkeypatch):
    _, views = images(np.random.default_rng(0), "pinhole", count=3, tilt=0.2)
    # The closed forms give nothing for these images, and take long.
    monkeypatch.setattr(lens_fit, "intrinsics_candidates", lambda *_: [])
    monkeypatch.setattr(lens_fit, "_FOCAL_LENGTHS", (0.7,))
    fit = fit_unknown_lens(views, *without_focal_lengths("pinhole"), repeats_errors=False)
    np.testing.assert_allclose(fit.values[:2], TRUE["pinhole"][:2], rtol=0.05)


def test_images_without_tilt_do_not_determine_an_unknown_lens():
    rng = np.random.default_rng(0)
    points = CHECKERBOARD - MIDDLE
    views = [
        (points, 1000 / depth * points[:, :2] + [640, 480] + 0.3 * rng.standard_normal((len(points), 2)))
        for depth in (0.5, 0.7, 0.9)
    ]
    with pytest.raises(NotObservableError, match="do not determine its focal length"):
        fit_unknown_lens(views, *without_focal_lengths("pinhole"), repeats_errors=False)


def test_wrong_points_do_not_change_the_lens():
    """The same errors of the points in all views are no evidence of a lens."""
    rng = np.random.default_rng(5)
    _, views = images(rng, "pinhole")
    chosen = np.array([0, 3, 6, 14, 20, 28, 31, 34])
    stated = CHECKERBOARD[chosen] + 2e-3 * rng.standard_normal((8, 3))
    views = [(stated, pixels[chosen]) for _, pixels in views]
    values, std = stated_lens("pinhole", "stated")
    errors = [
        np.abs(
            fit_lens(views, LENSES["pinhole"], values, std, repeats_errors=repeats).values - TRUE["pinhole"]
        )
        for repeats in (False, True)
    ]
    assert errors[1][2:4].max() < 30
    assert errors[1][2:4].max() < 0.5 * errors[0][2:4].max()


def test_many_images_have_the_lens_of_some_and_a_pose_each(monkeypatch):
    """The closed forms are evaluated once for each image, and not for every lens that is tried."""
    poses, views = images(np.random.default_rng(5), "pinhole", count=150)
    views.insert(70, (CHECKERBOARD[:3], views[0][1][:3]))
    closed_forms = pose_from_points._first_poses
    calls: list[int] = []
    monkeypatch.setattr(
        pose_from_points, "_first_poses", lambda *view: [calls.append(len(view)), closed_forms(*view)][1]
    )
    fit = fit_camera(views, without_focal_lengths("pinhole")[0])
    np.testing.assert_allclose(fit.values[:4], TRUE["pinhole"][:4], atol=15)
    assert fit.poses[70] == []
    assert angles(fit.poses[:70] + fit.poses[71:], poses).max() < 0.05
    # Some hundred for the search of the focal length, 60 for each of two first lenses, and all views.
    assert len(calls) < 600
