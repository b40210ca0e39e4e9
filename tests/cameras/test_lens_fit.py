"""Lens and poses of boards from the images of a camera alone, against the truth and OpenCV."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.cameras import LENSES, Board, Camera, lens_fit, pose_from_points
from dhcal_pin.cameras.lens_fit import _lens_widths, _LensProblem, fit_camera, fit_lens, fit_unknown_lens
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


# --- the steps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("intrinsics", "is_known", "wanted"),
    [
        ("fixed", True, (0.0, 0.0)),
        ("prior", True, (50.0, 0.3)),
        # Images alone determine a lens badly, even if the calibration frees it.
        ("free", True, (50.0, 0.3)),
        ("prior", False, (1e5, 0.3)),
    ],
)
@pytest.mark.parametrize("model", LENSES)
def test_first_widths_of_a_lens(model, intrinsics, is_known, wanted):
    values = TRUE[model] if is_known else np.nan * TRUE[model]
    camera = Camera("c", "world", 1280, 960, values, LENSES[model], intrinsics)
    np.testing.assert_array_equal(_lens_widths(camera), np.repeat(wanted, [4, len(values) - 4]))


def test_a_held_lens_has_no_cost_and_no_widths():
    _, views = images(np.random.default_rng(6), "pinhole", count=2)
    fit = fit_lens(views, LENSES["pinhole"], TRUE["pinhole"], np.zeros(9))
    np.testing.assert_array_equal(fit.values, TRUE["pinhole"])
    np.testing.assert_array_equal(fit.std, 0)
    assert np.isnan(fit.cost)
    assert all(rms < 1e-3 for found in fit.poses for _, rms in found[:1])


def small_problem(n_repeats=1):
    """Return a problem of three views and five free values, values of the lens, poses and rows."""
    poses, views = images(np.random.default_rng(7), "pinhole", count=3)
    views = [
        (points[:count], pixels[:count]) for (points, pixels), count in zip(views, (35, 20, 27), strict=True)
    ]
    values, std = stated_lens("pinhole", "stated")
    std[[3, 6, 7, 8]] = 0.0
    problem = _LensProblem(views, LENSES["pinhole"], values, std, n_repeats)
    values = values + 0.1 * std
    known = [(pose, 0.0) for pose in poses]
    return problem, values, known, problem._rows(values, known)


def test_rows_are_derivatives_and_errors_of_each_view():
    """The poses turn and move in the axes of the camera."""
    problem, values, known, rows = small_problem()
    free = np.flatnonzero(problem.std)
    for (points, pixels), (pose, _), part in zip(problem.views, known, rows, strict=True):

        def pixels_of(step, points=points, pose=pose):
            moved = values.copy()
            moved[free] += step[:5]
            local = se3.transform_points(se3.exp6(step[5:]) @ pose, points)
            return LENSES["pinhole"].project(local.T, moved)[0].T.ravel()

        np.testing.assert_allclose(part[:, -1], pixels.ravel() - pixels_of(np.zeros(11)), atol=1e-9)
        for i, step in enumerate(1e-6 * np.eye(11)):
            slope = (pixels_of(step) - pixels_of(-step)) / 2e-6
            np.testing.assert_allclose(part[:, i], slope, atol=1e-5 * max(1, np.abs(slope).max()))


@pytest.mark.parametrize("n_repeats", [1, 3])
def test_a_step_solves_the_least_squares_problem_in_lens_and_poses(n_repeats):
    """By all columns at once; the values of the rig are rows of their own."""
    problem, values, _, rows = small_problem(n_repeats)
    free = problem.std > 0
    errors = np.concatenate([part[:, -1] for part in rows])
    variance = n_repeats * np.mean(errors**2)
    assert problem._variance(rows) == pytest.approx(variance)
    offsets = 0.1 * np.ones(5)
    wanted_cost = len(errors) / n_repeats * np.log(variance) + offsets @ offsets
    assert problem._cost(rows, values) == pytest.approx(wanted_cost)
    matrix = np.zeros((len(errors) + 5, 5 + 18))
    matrix[: len(errors), :5] = np.concatenate([part[:, :5] for part in rows])
    matrix[: len(errors), 5:] = block_diag(*(part[:, 5:-1] for part in rows))
    matrix[: len(errors)] /= np.sqrt(variance)
    matrix[len(errors) :, :5] = np.diag(1 / problem.std[free])
    right = np.concatenate([errors / np.sqrt(variance), -offsets])
    step = problem._step(rows, values, 0.0)
    np.testing.assert_array_equal(step[~free], 0)
    np.testing.assert_allclose(step[free], np.linalg.lstsq(matrix, right, rcond=None)[0][:5], rtol=1e-3)
    normal, _, scale = problem._normal_equations(rows, values)
    wanted = np.linalg.inv(matrix.T @ matrix)[:5, :5]
    np.testing.assert_allclose(np.linalg.inv(normal) / np.outer(scale, scale), wanted, rtol=1e-3)
    # Much damping makes the steps small, along the gradient of the scaled values.
    assert np.linalg.norm(problem._step(rows, values, 1e3) * free) < 0.01 * np.linalg.norm(step)


def test_exact_images_have_a_smallest_variance():
    problem, *_ = small_problem(2)
    assert problem._variance([np.zeros((8, 12))] * 3) == pytest.approx(2 * 1e-6)


@pytest.mark.parametrize(
    ("relative_std", "is_determined"), [((0.09, 0.09), True), ((0.11, 0.09), False), ((0.09, 0.11), False)]
)
def test_without_closed_forms_the_best_start_has_to_determine_the_focal_lengths(
    monkeypatch, relative_std, is_determined
):
    """The starts are multiples of the larger side, with the centre in the middle."""
    starts = []

    def fit(views, lens, values, std, *, repeats_errors):
        starts.append(values)
        cost = abs(values[0] - 1800)
        return lens_fit.LensFit(values, [], cost, np.pad(relative_std * values[:2], (0, 7)))

    monkeypatch.setattr(lens_fit, "fit_lens", fit)
    monkeypatch.setattr(lens_fit, "intrinsics_candidates", lambda *_: [])
    camera, std = without_focal_lengths("pinhole")
    for one in (camera, replace(camera, width=960, height=1280)):
        starts.clear()
        if is_determined:
            found = fit_unknown_lens([], one, std, repeats_errors=False)
            np.testing.assert_allclose(found.values[:2], 1.4 * 1280)
        else:
            with pytest.raises(NotObservableError, match="do not determine its focal length"):
                fit_unknown_lens([], one, std, repeats_errors=False)
        wanted = [
            [1280 * each, 1280 * each, *one.image_centre, *np.zeros(5)] for each in lens_fit._FOCAL_LENGTHS
        ]
        np.testing.assert_allclose(starts, wanted)
    # A closed form determines the focal lengths itself.
    monkeypatch.setattr(lens_fit, "intrinsics_candidates", lambda *_: [(900.0, 910.0, 600.0, 500.0)])
    found = fit_unknown_lens([], camera, std, repeats_errors=False)
    np.testing.assert_array_equal(found.values, [900, 910, 600, 500, 0, 0, 0, 0, 0])


@pytest.mark.parametrize(("intrinsics", "n_fitted"), [("prior", 60), ("fixed", 62)])
def test_a_lens_is_fitted_to_some_of_many_images_that_have_a_pose(monkeypatch, intrinsics, n_fitted):
    calls = []

    def fit(views, lens, values, std, *, repeats_errors=False):
        calls.append((len(views), bool(std.any())))
        return lens_fit.LensFit(values, [[]] * len(views), 0.0, std)

    monkeypatch.setattr(lens_fit, "fit_lens", fit)
    camera = Camera("c", "world", 1280, 960, TRUE["pinhole"], intrinsics=intrinsics)
    views = [(CHECKERBOARD, CHECKERBOARD[:, :2])] * 61 + [(CHECKERBOARD[:3], CHECKERBOARD[:3, :2])]
    assert len(fit_camera(views, camera).poses) == 62
    assert calls[0] == (n_fitted, intrinsics == "prior")
    assert calls[1:] == ([(62, False)] if intrinsics == "prior" else [])
    calls.clear()
    fit_camera(views[1:], camera)
    assert calls == [(61, intrinsics == "prior")]


def test_views_that_count_as_one_determine_a_lens_as_one_does():
    """The standard deviations are those of all views times the root of their number."""
    _, views = images(np.random.default_rng(8), "pinhole", count=6)
    values, std = stated_lens("pinhole", "free")
    fits = [
        fit_lens(views, LENSES["pinhole"], values, std, repeats_errors=repeats) for repeats in (False, True)
    ]
    np.testing.assert_allclose(fits[1].std[:4] / fits[0].std[:4], np.sqrt(6), rtol=0.05)
