"""First poses and intrinsics in closed form are exact for exact images."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from dhcal_pin import se3
from dhcal_pin.cameras import LENSES, Board, Camera, estimate_pose, intrinsics, solve_hand_eye
from dhcal_pin.cameras.hand_eye import _angles, _require_two_axes, choose_poses, mean_pose
from dhcal_pin.cameras.intrinsics import (
    _drawn,
    _from_homographies,
    _in_plane,
    _is_plausible,
    _search,
    _square_sum,
    _with_centre,
    _without_centre,
    intrinsics_candidates,
)
from dhcal_pin.cameras.pose_from_points import (
    _first_poses,
    _flat_poses,
    _jacobian,
    _line_distances,
    _mirror,
    _mirror_plane,
    _orthographic_pose,
    _projection_poses,
    _refine,
    _residuals,
    _transfer_distances,
    agreeing_points,
    determines_homography,
    direct_linear_transform,
    estimate_poses,
    normalizing_transform,
    pose_information,
)
from dhcal_pin.exceptions import NotObservableError
from dhcal_pin.measurements.images.camera_start import _well_fitting

CAMERA = Camera("c", "world", 1280, 720, np.array([np.nan] * 4 + [0.0] * 5))
CHECKERBOARD = Board("b", "world", "checkerboard", columns=8, rows=6, square=0.03).points


def random_pose(rng, angle=0.6):
    return se3.transform(
        se3.exp3(rng.uniform(-angle, angle, 3)), [*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.5, 0.9)]
    )


def image_of(points, pose):
    """Return the image (n, 2) of points in front of a camera with a focal length of one."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    return local[:, :2] / local[:, 2:]


def check_pose(points, pose, atol=1e-7):
    """Compare the pose that the exact image of points gives with the true one."""
    estimate = estimate_pose(points, image_of(points, pose))
    assert estimate is not None
    np.testing.assert_allclose(estimate[0], pose, atol=atol)
    assert estimate[1] < 1e-2 * atol


@pytest.mark.parametrize("seed", range(20))
def test_pose_of_a_flat_board(seed):
    check_pose(CHECKERBOARD, random_pose(np.random.default_rng(seed)))


@pytest.mark.parametrize("seed", range(20))
def test_pose_of_points_that_are_not_flat(seed):
    rng = np.random.default_rng(seed)
    check_pose(rng.uniform(-0.2, 0.2, (7, 3)), random_pose(rng, 2.0))


@pytest.mark.parametrize(("count", "seed"), [(8, 20), (20, 117)])
def test_pose_of_points_from_nearer_than_their_extent(count, seed):
    """The view is far from an orthographic one."""
    rng = np.random.default_rng(seed)
    points, turn = rng.uniform(-0.1, 0.1, (count, 3)), se3.exp3(rng.normal(0, 2, 3))
    check_pose(points, se3.transform(turn, [*rng.uniform(-0.1, 0.1, 2), 0.15]), atol=1e-6)


def test_a_small_body_has_an_orthographic_image():
    """The errors are those of second order: of the depth by the square of size over depth."""
    rng = np.random.default_rng(3)
    points = 1e-3 * rng.standard_normal((20, 3))
    pose = se3.transform(se3.exp3(rng.normal(0, 2, 3)), [0.3, -0.2, 1.0])
    np.testing.assert_allclose(_orthographic_pose(points, image_of(points, pose)), pose, atol=5e-3)


@pytest.mark.parametrize("d", [2, 3])
def test_projective_maps_do_not_depend_on_the_origin(d):
    rng = np.random.default_rng(d)
    matrix, points = rng.uniform(0.5, 1, (3, d + 1)), rng.uniform(2, 3, (12, d))
    image = points @ matrix[:, :d].T + matrix[:, d]
    found = direct_linear_transform(points, image[:, :2] / image[:, 2:])
    np.testing.assert_allclose(found / found[0, 0], matrix / matrix[0, 0], rtol=1e-9)


@pytest.mark.parametrize("count", [6, 8])
@pytest.mark.parametrize("error", [0.0, 1e-3])
def test_pose_of_a_small_body_far_from_the_camera(count, error):
    """Points on a sphere of 7 cm in radius face a camera 0.3 to 3 m away, and are not quite in their places.

    The errors turn the body by some degrees. Another minimum would be tens of degrees away.
    """
    rng, angles = np.random.default_rng(count), []
    for _ in range(100):
        depth = rng.uniform(0.3, 3)
        pose = se3.transform(se3.exp3(rng.normal(0, 2, 3)), [*rng.uniform(-0.3, 0.3, 2) * depth, depth])
        points = rng.standard_normal((40, 3))
        points *= 0.07 / np.linalg.norm(points, axis=1)[:, None]
        facing = np.argsort(points @ pose[:3, :3].T @ pose[:3, 3])[:count]
        image = image_of((points + error * rng.standard_normal(points.shape))[facing], pose)
        image += 2e-4 * error / 1e-3 * rng.standard_normal((count, 2))
        estimate = estimate_pose(points[facing], image)
        assert estimate is not None
        angles.append(np.linalg.norm(se3.log3(estimate[0][:3, :3].T @ pose[:3, :3])))
    assert np.mean(np.array(angles) > 0.5) <= (0.1 if error else 0.0)


def test_a_tag_of_four_corners_has_a_pose():
    points = 0.05 * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    check_pose(points, se3.transform(se3.exp3(np.array([0.6, -0.4, 1.0])), [0.02, -0.03, 0.2]))


def test_five_points_that_are_not_flat_have_a_pose():
    points = 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0.5]])
    check_pose(points, se3.transform(se3.exp3(np.array([0.4, -0.3, 1.0])), [0.1, -0.05, 0.8]))


def test_a_far_flat_board_has_two_poses_that_mirror_each_other():
    points = CHECKERBOARD - CHECKERBOARD.mean(0)
    pose = se3.transform(se3.exp3(np.array([0.5, 0.2, 0.1])), [0.1, -0.2, 4.0])
    (first, _), (second, rms) = estimate_poses([(points, image_of(points, pose))])[0]
    np.testing.assert_allclose(first, pose, atol=1e-6)
    sight, normal = pose[:3, 3] / np.linalg.norm(pose[:3, 3]), pose[:3, 2]
    np.testing.assert_allclose(second[:3, 2], 2 * (normal @ sight) * sight - normal, atol=0.05)
    assert rms < 1e-3


def test_too_few_points_or_points_in_a_line_have_no_pose():
    line = np.outer(np.arange(5.0), [0.01, 0.02, 0])
    assert estimate_pose(line, line[:, :2]) is None
    assert estimate_pose(CHECKERBOARD[:3], CHECKERBOARD[:3, :2]) is None


def test_hand_eye_is_exact():
    rng = np.random.default_rng(0)
    camera, board = (se3.exp6(rng.uniform(-2, 2, 6)) for _ in range(2))
    links = se3.exp6(rng.uniform(-1.5, 1.5, (6, 6)))
    found = solve_hand_eye(links, se3.inverse(camera) @ links @ board, "camera 'c' and board 'b'")
    np.testing.assert_allclose(found[0], camera, atol=1e-10)
    np.testing.assert_allclose(found[1], board, atol=1e-10)


@pytest.mark.parametrize("seed", range(10))
def test_poses_that_agree_are_chosen(seed):
    """In six of ten images the board appears tilted the other way."""
    rng = np.random.default_rng(seed)
    camera, board = (se3.exp6(rng.uniform(-2, 2, 6)) for _ in range(2))
    links = se3.exp6(rng.uniform(-1, 1, (25, 6)))
    right = se3.inverse(camera) @ links @ board @ se3.exp6(0.03 * rng.standard_normal((25, 6)))
    tilts = rng.choice([-1, 1], (25, 1)) * rng.uniform(0.5, 1.2, (25, 1))
    wrong = right @ se3.exp6(np.pad(tilts, ((0, 0), (3, 2))) + 0.03 * rng.standard_normal((25, 6)))
    is_right = (rng.random(25) < 0.4)[:, None, None]
    candidates = np.stack([np.where(is_right, right, wrong), np.where(is_right, wrong, right)], 1)
    np.testing.assert_array_equal(choose_poses(links, candidates), right)
    found = mean_pose((se3.inverse(links) @ camera)[:, None] @ candidates)
    np.testing.assert_allclose(found, board, atol=0.1)


def test_a_line_and_one_more_point_determine_no_homography():
    row = np.outer(np.arange(7.0), [0.03, 0.01])
    assert not determines_homography(np.vstack([row, [[0.1, 0.2]]]))
    assert not determines_homography(np.vstack([[[0.2, 0.3]], row]))
    assert determines_homography(np.vstack([row, [[0.1, 0.2], [0.1, 0.3]]]))
    # The origin of the plane does not matter.
    assert not determines_homography(np.vstack([row, [[0.1, 0.2]]]) + np.array([0.4, -0.7]))
    points = np.pad(np.vstack([row, [[0.1, 0.2]]]), ((0, 0), (0, 1)))
    assert estimate_pose(points, points[:, :2] + [0.1, 0.1]) is None


@pytest.mark.parametrize("error", [1e-3, 2e-3, 3e-3])
@pytest.mark.parametrize("depth", [0.0, 0.01, 0.1])
def test_points_that_are_millimetres_off_still_give_a_pose(depth, error):
    """All but one of eight points of a small board are kept, and they give a pose."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points = rng.uniform(-0.06, 0.06, (8, 3)) * [1, 1, depth / 0.12]
        pose = random_pose(rng)
        stated = points + error * rng.standard_normal((8, 3))
        image = image_of(points, pose)
        agrees = agreeing_points(stated, image)
        assert agrees.sum() >= 6
        assert estimate_pose(stated[agrees], image[agrees]) is not None


def test_rotations_about_one_axis_are_refused():
    rng = np.random.default_rng(0)
    links = se3.transform(se3.exp3(np.outer(rng.uniform(-1, 1, 8), [0, 0, 1])), rng.uniform(-1, 1, (8, 3)))
    with pytest.raises(
        NotObservableError, match=r"one axis only.*non-parallel axes.*state the pose of the camera"
    ):
        solve_hand_eye(links, links, "camera 'c' and board 'b'")


@pytest.mark.parametrize("count", [6, 8, 24])
@pytest.mark.parametrize("depth", [0.0, 1e-4, 1e-3, 5e-3, 2e-2])
def test_pose_of_points_near_a_plane(depth, count):
    """The pose explains the image as well as the true one, and is near it, for any depth."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points = rng.uniform(-0.1, 0.1, (count, 3)) * [1, 1, 5 * depth]
        pose = random_pose(rng)
        exact = image_of(points, pose)
        image = exact + 2e-4 * rng.standard_normal(exact.shape)
        estimate = estimate_pose(points, image)
        assert estimate is not None
        assert estimate[1] <= np.sqrt(np.mean(np.sum((image - exact) ** 2, 1)))
        assert np.linalg.norm(se3.log3(estimate[0][:3, :3].T @ pose[:3, :3])) < 0.1


@pytest.mark.parametrize("depth", [0.0, 1e-3, 2e-2])
def test_wrong_points_near_a_plane_do_not_agree(depth):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points = rng.uniform(-0.1, 0.1, (24, 3)) * [1, 1, 5 * depth]
        pose = random_pose(rng)
        image = image_of(points, pose)
        image[:3] += [0.2, 0.1]
        agrees = agreeing_points(points, image)
        assert not agrees[:3].any()
        assert agrees[3:].mean() > 0.9
        # A shift of the image is a projective map, too.
        np.testing.assert_array_equal(agreeing_points(points, image + np.array([3.0, 2.0])), agrees)


@pytest.mark.parametrize("seed", range(5))
def test_half_of_the_points_beside_those_of_a_map_are_enough(seed):
    """Seven of ten points are right: four determine a map, and half of the other six agree with it."""
    rng = np.random.default_rng(seed)
    points, pose = np.pad(rng.uniform(-0.1, 0.1, (10, 2)), ((0, 0), (0, 1))), random_pose(rng)
    image = image_of(points, pose)
    image[:3] += rng.uniform(0.05, 0.2, (3, 2))
    np.testing.assert_array_equal(np.flatnonzero(~agreeing_points(points, image)), range(3))


def test_a_point_beside_the_plane_of_all_others_may_have_a_wrong_image():
    """A map of points in space explains any image of it."""
    points, pose = CHECKERBOARD.copy(), random_pose(np.random.default_rng(0))
    points[7, 2] = 1e-3
    image = image_of(points, pose)
    image[7] += [0.05, -0.03]
    np.testing.assert_array_equal(np.flatnonzero(~agreeing_points(points, image)), [7])


def views(rng, count, points=CHECKERBOARD, centre=(650.0, 350.0)):
    values = np.array([640.0, 660.0, *centre, 0, 0, 0, 0, 0])
    out = []
    for _ in range(count):
        pose = random_pose(rng)
        local = points @ pose[:3, :3].T + pose[:3, 3]
        out.append((points, LENSES["pinhole"].project(local.T, values)[0].T))
    return values, out


def test_intrinsics_from_views_of_a_board():
    values, seen = views(np.random.default_rng(1), 6)
    np.testing.assert_allclose(intrinsics_candidates(seen, CAMERA)[0], values[:4], rtol=1e-6)


@pytest.mark.parametrize("centre", [(1100.0, 350.0), (200.0, 350.0), (650.0, 650.0), (650.0, 100.0)])
def test_the_centre_of_a_lens_is_near_the_middle_of_the_image(centre):
    _, seen = views(np.random.default_rng(1), 6, centre=centre)
    for found in intrinsics_candidates(seen, CAMERA):
        np.testing.assert_array_equal(found[2:], CAMERA.image_centre)


@pytest.mark.parametrize("depth", [1e-3, 2e-2, 0.2])
def test_focal_length_from_views_of_points_that_are_not_flat(depth):
    """The image centre is taken for the middle of the image: the focal length is approximate."""
    rng = np.random.default_rng(2)
    values, seen = views(rng, 6, rng.uniform(-0.1, 0.1, (20, 3)) * [1, 1, 5 * depth])
    (found,) = intrinsics_candidates(seen, CAMERA)
    np.testing.assert_allclose(found[:2], values[:2], rtol=0.1)


def test_views_without_tilt_do_not_determine_the_focal_length():
    points = CHECKERBOARD - CHECKERBOARD.mean(0)
    rng = np.random.default_rng(0)
    seen = [
        (points, 640 / depth * points[:, :2] + [640, 360] + 0.1 * rng.standard_normal((len(points), 2)))
        for depth in (0.5, 0.7, 0.9)
    ]
    assert intrinsics_candidates(seen, CAMERA) == []


def test_intrinsics_need_three_views():
    _, seen = views(np.random.default_rng(1), 2)
    with pytest.raises(NotObservableError, match=r"2 images of a board .* expected at least 3"):
        intrinsics_candidates(seen, CAMERA)


def test_wrong_corners_of_a_target_that_is_not_flat_are_left_out():
    rng = np.random.default_rng(4)
    points = rng.uniform(-0.05, 0.05, (20, 3))
    image = image_of(points, se3.transform(se3.exp3(np.array([0.4, -0.3, 0.2])), [0.02, 0.01, 0.5]))
    image[[3, 11]] += [[0.06, -0.05], [-0.07, 0.06]]
    np.testing.assert_array_equal(np.flatnonzero(~agreeing_points(points, image)), [3, 11])


def test_views_that_fit_badly_are_not_used():
    rms = np.array([0.01] * 6 + [0.04, 0.06])
    np.testing.assert_array_equal(_well_fitting(rms, np.arange(1, 8)), range(1, 7))
    np.testing.assert_array_equal(_well_fitting(1e-3 * rms, np.arange(1, 8)), range(1, 8))


def test_focal_length_with_the_centre_in_the_middle():
    rng = np.random.default_rng(6)
    turns = se3.exp3(rng.uniform(-0.6, 0.6, (4, 3)))
    views = [np.diag([1.3, 1.3, 1]) @ np.column_stack([r[:, 0], r[:, 1], [0.1, 0.2, 2.0]]) for r in turns]
    values = _without_centre(views)
    np.testing.assert_allclose(values, [1.3, 1.3, 0, 0], atol=1e-9)


def test_a_flat_board_keeps_its_distances_in_its_plane():
    points = (CHECKERBOARD + np.array([0.1, -0.2, 0.3])) @ se3.exp3(np.array([0.3, 0.5, 0.1])).T
    plane = _in_plane(points)
    assert plane is not None
    np.testing.assert_allclose(pdist(plane), pdist(points), atol=1e-12)


def test_a_long_and_narrow_board_is_flat_relative_to_its_length():
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3)) * [0.5, 0.02, 2e-4]
    plane = _in_plane(points)
    assert plane is not None
    np.testing.assert_allclose(pdist(plane), pdist(points), atol=1e-5)
    assert _in_plane(points * [1, 1, 10]) is None


@pytest.mark.parametrize(("increase", "is_determined"), [(20.0, False), (30.0, True)])
def test_twice_the_focal_length_is_25_variances_worse(monkeypatch, increase, is_determined):
    """Five views of ten points leave 70 of 100 rows, whose sum of squares of 70 has the variance 1."""
    focal, views = 1024.0, [(np.zeros((10, 3)), np.zeros((10, 2)))] * 5
    monkeypatch.setattr(
        intrinsics,
        "_square_sum",
        lambda views, camera, values: 70 + increase * np.log2(values[0] / focal) ** 2,
    )
    found = _search(views, CAMERA)
    assert (found is not None) == is_determined
    if found:
        assert found == pytest.approx((focal, focal, *CAMERA.image_centre))


@pytest.mark.parametrize(
    "values",
    [(0.01, 0.01, 0, 0), (1, 1e-2, 0, 0), (1, 10, 0, 0), (10, 1, 0, 0), (1, 1, 0.3, 0), (1, 1, 0, -0.2)],
)
def test_lenses_that_are_not_built_are_implausible(values):
    assert not _is_plausible(values, 1.0, 0.75)
    assert _is_plausible((1.0, 1.05, 0.05, -0.05), 1.0, 0.75)


# --- the steps ---------------------------------------------------------------------------------------


def test_views_are_drawn_from_the_first_to_the_last():
    views = [(np.full((4, 3), i), np.zeros((4, 2))) for i in range(30)]
    for count, wanted in (
        (3, [0, 1, 2]),
        (12, range(12)),
        (30, [0, 2, 5, 7, 10, 13, 15, 18, 21, 23, 26, 29]),
    ):
        assert [int(points[0, 0]) for points, _ in _drawn(views[:count])] == list(wanted)


def test_errors_in_the_images_are_those_of_the_poses_of_each_view():
    """In pixels, f² times those in the image at unit distance; images without a pose do not count."""
    rng = np.random.default_rng(7)
    values, seen = views(rng, 2)
    lens = (650.0, 650.0, 640.0, 360.0)
    seen[1] = seen[1][0][:20], seen[1][1][:20]
    noisy = [(points, pixels + rng.standard_normal(pixels.shape)) for points, pixels in seen]
    found = [estimate_pose(points, (pixels - lens[2:]) / 650) for points, pixels in noisy]
    wanted = sum(
        650**2 * len(view[0]) * pose[1] ** 2 for view, pose in zip(noisy, found, strict=True) if pose
    )
    noisy.append((CHECKERBOARD[:3], np.zeros((3, 2))))
    assert _square_sum(noisy, CAMERA, lens) == pytest.approx(wanted)
    assert _square_sum(seen, CAMERA, tuple(values[:4])) < 1e-3 * wanted


def test_a_board_behind_the_camera_has_the_errors_of_a_point(monkeypatch):
    pose = se3.transform(np.eye(3), [0, 0, -1.0])
    monkeypatch.setattr(intrinsics, "estimate_poses", lambda views: [[(pose, np.inf)] for _ in views])
    pixels = np.array([[630.0, 350], [650, 350], [630, 370], [650, 370]])
    view = 0.01 * np.pad(pixels, ((0, 0), (0, 1))), pixels
    assert _square_sum([view, view], CAMERA, (640.0, 640, 640, 360)) == pytest.approx(2 * 800)


@pytest.mark.parametrize(("index", "is_inside"), [(1, False), (2, True), (10, True), (11, False)])
def test_a_focal_length_at_the_end_of_the_search_is_not_determined(monkeypatch, index, is_inside):
    """Half and twice of it have to be among the 13 that are tried, and worse."""
    wanted = 1280 * 0.2 * 2 ** (index / 2)
    monkeypatch.setattr(
        intrinsics, "_square_sum", lambda views, camera, values: 1 + 1e3 * np.log2(values[0] / wanted) ** 2
    )
    found = _search([(np.zeros((10, 3)), np.zeros((10, 2)))] * 3, CAMERA)
    assert found == (pytest.approx((wanted, wanted, 639.5, 359.5)) if is_inside else None)


@pytest.mark.parametrize("focal", [700.0, 850.0, 1100.0, 1500.0])
@pytest.mark.parametrize("worse", [0.5, 2.0])
def test_the_search_refines_the_focal_length_and_needs_both_sides(monkeypatch, focal, worse):
    for penalty in (1e3, 1e-3):

        def square_sum(views, camera, values, penalty=penalty):
            distance = np.log2(values[0] / focal)
            return 1 + (penalty if (distance > 0) == (worse > 1) else 1e3) * distance**2

        monkeypatch.setattr(intrinsics, "_square_sum", square_sum)
        found = _search([(np.zeros((10, 3)), np.zeros((10, 2)))] * 3, replace(CAMERA, width=720, height=1280))
        assert (found is not None) == (penalty > 1)
        if found:
            assert found == pytest.approx((focal, focal, 359.5, 639.5), rel=0.02)


def test_intrinsics_of_an_upright_image():
    """The focal lengths differ, and the centre is not in the middle."""
    camera = replace(CAMERA, width=720, height=1280)
    values, seen = views(np.random.default_rng(1), 4, centre=(350.0, 650.0))
    for count in (3, 4):
        found = _from_homographies(seen[:count], camera)
        assert found is not None
        np.testing.assert_allclose(found, values[:4], rtol=1e-6)
    assert _from_homographies(seen[:2], camera) is None
    body = np.random.default_rng(2).uniform(-0.1, 0.1, (20, 3)), seen[0][1][:20]
    assert _from_homographies([*seen[:2], body], camera) is None


def test_three_views_of_four_corners_are_enough_to_try():
    _, seen = views(np.random.default_rng(1), 3)
    corners = [0, 6, 28, 34]
    assert len(intrinsics_candidates([(p[corners], u[corners]) for p, u in seen], CAMERA)) >= 1
    with pytest.raises(NotObservableError, match=r"camera 'c': 2 images of a board with at least 4 corners"):
        intrinsics_candidates([*seen[:2], (seen[2][0][:3], seen[2][1][:3])], CAMERA)


def homographies(focal_lengths, centre, count=4):
    """Return homographies of tilted planes in the images of a lens."""
    matrix = np.array([[focal_lengths[0], 0, centre[0]], [0, focal_lengths[1], centre[1]], [0, 0, 1]])
    turns = se3.exp3(np.random.default_rng(6).uniform(-0.6, 0.6, (count, 3)))
    return [-3 * matrix @ np.column_stack([r[:, 0], r[:, 1], [0.1, 0.2, 2.0]]) for r in turns]


def test_homographies_determine_both_focal_lengths_and_the_centre():
    lens = (1.3, 1.1, 0.05, -0.08)
    found = _with_centre(homographies(lens[:2], lens[2:], 3))
    np.testing.assert_allclose(found, lens, atol=1e-9)


def test_frontal_and_contradicting_views_have_no_plausible_lens():
    """Frontal views do not determine ω; with those of a hyperbolic ω, the square of f is negative."""
    frontal = [np.diag([1.0, 1.0, depth]) for depth in (1, 2, 3)]
    hyperbolic = [np.array([[1, 0, 0], [0, 1 + k * k, 0], [0, k, 1]]) for k in (0.1, 0.2, 0.3)]
    for found in (_with_centre(frontal), _without_centre(frontal), _without_centre(hyperbolic)):
        assert not _is_plausible(found, 1.0, 0.75)


@pytest.mark.parametrize(
    ("values", "is_plausible"),
    [
        ((0.21, 0.21, 0, 0), True),
        ((0.19, 0.21, 0, 0), False),
        ((0.21, 0.19, 0, 0), False),
        ((19, 19, 0, 0), True),
        ((21, 19, 0, 0), False),
        ((1.45, 1, 0, 0), True),
        ((1, 1.45, 0, 0), True),
        ((1.55, 1, 0, 0), False),
        ((1, 1.55, 0, 0), False),
        ((1, 1, -0.24, 0.18), True),
        ((1, 1, -0.26, 0), False),
        ((1, 1, 0, 0.2), False),
    ],
)
def test_limits_of_plausible_lenses(values, is_plausible):
    """The focal lengths are 0.2 to 20 times the larger side, and the centre is within a quarter of a side."""
    assert _is_plausible(values, 1.0, 0.75) == is_plausible


def test_normalized_points_have_the_mean_zero_and_unit_size():
    """Each set by itself; equal points are moved only."""
    points = np.random.default_rng(0).uniform(2, 5, (3, 7, 2))
    points[2] = [3.0, 4.0]
    transforms = normalizing_transform(points)
    moved = points @ transforms[:, :2, :2] + transforms[:, None, :2, 2]
    np.testing.assert_allclose(moved.mean(1), 0, atol=1e-12)
    np.testing.assert_allclose(np.mean(moved[:2] ** 2, (1, 2)), 1)
    np.testing.assert_array_equal(transforms[2], [[1, 0, -3], [0, 1, -4], [0, 0, 1]])


def test_distances_from_the_line_through_two_points():
    points = np.array([[1.0, 1], [4, 5], [0, 1], [1, 6], [2.5, 3]])
    np.testing.assert_allclose(_line_distances(points, 0, 1), [0, 0, 0.8, 3, 0], atol=1e-12)


def test_four_corners_determine_a_homography():
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    assert determines_homography(square)
    assert not determines_homography(square[:3])
    # Two points beside the line, as far as the tolerance of a flat board does not reach.
    line = np.outer(np.arange(5.0), [1, 0])
    for offset, is_determined in ((0.003, False), (0.006, True)):
        points = np.vstack([line, [[1, offset], [3, -offset]]])
        assert determines_homography(points) == is_determined


@pytest.mark.parametrize(("count", "depth"), [(8, 0.0), (8, 0.1), (12, 0.1)])
def test_all_points_agree_if_few_are_more_than_those_of_a_map(count, depth):
    """With one more, a wrong point is found: four points determine a map of a plane, six one of space."""
    rng = np.random.default_rng(1)
    points, pose = rng.uniform(-0.1, 0.1, (13, 3)) * [1, 1, depth / 0.1], random_pose(rng)
    image = image_of(points, pose)
    image[0] += 0.1
    assert agreeing_points(points[:count], image[:count]).all()
    one_more = 13 if depth else 9
    assert not agreeing_points(points[:one_more], image[:one_more])[0]


def test_points_in_a_line_agree():
    line = np.outer(np.arange(12.0), [0.01, 0.02, 0.03])
    assert agreeing_points(line, np.random.default_rng(0).uniform(-1, 1, (12, 2))).all()


def test_distances_from_a_projective_map():
    """The map of the chosen points is a shift by (1, 2); the last point is 5 units away from it."""
    source = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [3, 2]])
    image = source + np.array([1.0, 2])
    image[4] += [3, -4]
    found = _transfer_distances(source, image, np.array([[0, 1, 2, 3], [3, 2, 1, 0]]))
    np.testing.assert_allclose(found, [[0, 0, 0, 0, 5]] * 2, atol=1e-9)


def test_a_plane_tilted_the_other_way_has_its_normal_mirrored_at_the_line_of_sight():
    position = np.array([0.0, 0, 2])
    tilted = se3.transform(se3.exp3([0.3, 0, 0]), position)
    (mirrored,) = _mirror_plane(tilted)
    np.testing.assert_allclose(mirrored, se3.transform(se3.exp3([-0.3, 0, 0]), position), atol=1e-12)
    assert _mirror_plane(se3.transform(se3.exp3([0, 0, 0.5]), position)) == []
    # Of points, the plane through their middle is turned about it.
    points = CHECKERBOARD - CHECKERBOARD.mean(0) + [0.1, 0.2, 0.3]
    away = se3.transform(np.eye(3), [-0.1, -0.2, -0.3])
    (mirrored,) = _mirror(tilted @ away, points)
    np.testing.assert_allclose(mirrored, se3.transform(se3.exp3([-0.3, 0, 0]), position) @ away, atol=1e-12)


def test_a_known_pose_is_refined_and_tried_with_its_mirror_image():
    pose = se3.transform(se3.exp3([0.4, 0.1, 0.2]), [0.02, 0.01, 0.6])
    centred = CHECKERBOARD - CHECKERBOARD.mean(0)
    view, near = (centred, image_of(centred, pose)), pose @ se3.exp6(np.full(6, 1e-3))
    ((best, rms), (other, larger)) = estimate_poses([view], [near])[0]
    np.testing.assert_allclose(best, pose, atol=1e-6)
    assert rms < 1e-9 < larger
    assert np.linalg.norm(se3.log3(other[:3, :3].T @ pose[:3, :3])) > 0.3
    # Three points have no closed form, and both poses explain them.
    three = centred[[0, 6, 28]], view[1][[0, 6, 28]]
    found = estimate_poses([three], [near])[0]
    assert len(found) == 2
    assert all(rms < 1e-6 for _, rms in found)


def test_distance_in_the_image_is_the_rms_of_the_corners():
    """Corners of a tag far apart, alternately 1e-3 above and below their places along x, fit no better."""
    points = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    points = np.vstack([points, points])
    image = points[:, :2] + np.repeat([[3e-3, 4e-3], [-3e-3, -4e-3]], 4, 0)
    found = estimate_pose(points, image)
    assert found is not None
    np.testing.assert_allclose(found[0], se3.transform(np.eye(3), [0, 0, 1]), atol=1e-6)
    assert found[1] == pytest.approx(5e-3)


def test_residuals_and_derivatives_of_points():
    rng, h = np.random.default_rng(3), 1e-6
    pose, points = random_pose(rng), rng.uniform(-0.1, 0.1, (5, 3))
    image = image_of(points, pose) + np.array([0.01, -0.02])
    residuals, local = _residuals(pose[None], points[None], image[None])
    np.testing.assert_allclose(residuals[0], np.tile([0.01, -0.02], (5, 1)), atol=1e-12)
    np.testing.assert_allclose(local[0], se3.transform_points(pose, points))
    slopes = np.stack(
        [
            (image_of(points, se3.exp6(step) @ pose) - image_of(points, se3.exp6(-step) @ pose)) / (2 * h)
            for step in h * np.eye(6)
        ],
        -1,
    )
    np.testing.assert_allclose(_jacobian(local)[0], slopes, atol=1e-8)
    rows = slopes.reshape(-1, 6)
    np.testing.assert_allclose(pose_information(pose, points), rows.T @ rows, atol=1e-6)


def test_a_pose_behind_the_camera_explains_nothing():
    """Points behind the camera are mirrored; their image is that of no pose before it."""
    points = CHECKERBOARD[:8]
    behind = se3.transform(np.eye(3), [0, 0, -0.5])
    ((_, rms), *_) = estimate_poses([(points, image_of(points, behind))], [behind])[0]
    assert rms == np.inf


@pytest.mark.parametrize(("count", "images"), [(1, "1 usable image;"), (2, "2 usable images;")])
def test_hand_eye_needs_three_images(count, images):
    links = se3.exp6(np.random.default_rng(0).uniform(-1, 1, (3, 6)))
    with pytest.raises(NotObservableError, match=f"^camera: {images} expected at least 3 at different"):
        solve_hand_eye(links[:count], links[:count], "camera")
    candidates = np.stack([links, se3.inverse(links)], 1)
    np.testing.assert_array_equal(choose_poses(links[:count], candidates[:count]), links[:count])
    camera = se3.exp6(np.random.default_rng(1).uniform(-1, 1, 6))
    found = solve_hand_eye(links, se3.inverse(camera) @ links @ camera, "camera")
    np.testing.assert_allclose(found, [camera, camera], atol=1e-9)


@pytest.mark.parametrize(("turn", "is_enough"), [(0.015, False), (0.03, True)])
def test_rotations_about_a_second_axis_are_stated(turn, is_enough):
    """The RMS of the turns about the second axis counts."""
    rotations = se3.exp3(np.array([[0.5, 0, 0], [-0.5, 0, 0], [0, turn, 0], [0, -turn, 0]]))
    if is_enough:
        _require_two_axes(rotations, "c")
    else:
        # 0.015 rad of two in four images are 0.0106 rad.
        with pytest.raises(NotObservableError, match=r"^c: .* one axis only \(second axis 0\.61 deg\)"):
            _require_two_axes(rotations, "c")


def test_angles_to_the_predicted_rotations():
    """The board in the camera is C⁻¹·A·B; candidates turn on from there."""
    rng = np.random.default_rng(2)
    camera, board, links = (
        se3.exp3(rng.normal(size=3)),
        se3.exp3(rng.normal(size=3)),
        se3.exp3(rng.normal(size=(50, 3))),
    )
    turned = se3.exp3(np.outer([0, 0.2, np.pi], [0.6, 0, 0.8]))
    candidates = (camera.T @ links @ board)[:, None] @ turned
    found = _angles(links, candidates, camera, board)
    np.testing.assert_allclose(found, np.tile([0, 0.2, np.pi], (50, 1)), atol=1e-6)


def test_mean_of_the_poses_that_agree():
    """The rotations 0.1, 0.2 and 0.3 rad about z have the mean 0.2, and the places their medians."""
    angles, places = [0.1, 0.2, 0.3], [[1.0, 5, 7], [2, 4, 9], [9, 6, 8]]
    right = se3.transform(se3.exp3(np.outer(angles, [0, 0, 1])), places)
    wrong = se3.transform(se3.exp3([[2.0, 0, 0], [0, -2, 0], [1, 1, 1.5]]), np.zeros((3, 3)))
    found = mean_pose(np.stack([wrong, right], 1))
    np.testing.assert_allclose(found, se3.transform(se3.exp3([0, 0, 0.2]), [2, 5, 8]), atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_closed_forms_of_exact_images_are_exact(seed):
    rng = np.random.default_rng(seed)
    pose, body = random_pose(rng), rng.uniform(-0.1, 0.1, (6, 3))
    first, mirrored = _flat_poses(CHECKERBOARD[:, :2], image_of(CHECKERBOARD, pose))
    np.testing.assert_allclose(first, pose, atol=1e-9)
    np.testing.assert_allclose(mirrored, _mirror_plane(pose)[0], atol=1e-8)
    (found,) = _projection_poses(body, image_of(body, pose))
    np.testing.assert_allclose(found, pose, atol=1e-8)


CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


@pytest.mark.parametrize(
    ("points", "count"),
    [
        (CHECKERBOARD[[0, 6, 28]], 0),
        (CHECKERBOARD[[0, 6, 28, 34]], 2),
        (CHECKERBOARD[:7], 0),
        (CHECKERBOARD[[*range(7), 20]], 0),
        (np.ones((6, 3)), 0),
        # As thick as half a thousandth of the length, and as three thousandths.
        (np.vstack([[[0, 0, 2.5e-4], [0.5, 0, -2.5e-4]], 0.5 * CORNERS]), 2),
        (np.vstack([[[0, 0, 1.5e-3], [0.5, 0, -1.5e-3]], 0.5 * CORNERS]), 4),
        (np.vstack([np.zeros(3), 0.1 * np.eye(3)]), 3),
        (np.vstack([np.zeros(3), 0.1 * np.eye(3), [[0.1, 0.1, 0.05]]]), 3),
        (np.vstack([np.zeros(3), 0.1 * np.eye(3), [[0.1, 0.1, 0.05], [0.05, 0.1, 0.1]]]), 4),
    ],
)
def test_number_of_closed_forms(points, count):
    """Two of a plane, one of an orthographic image, and one of a projection matrix for six points."""
    pose = se3.transform(se3.exp3([0.4, 0.3, 0.1]), [0.02, 0.01, 0.6])
    assert len(_first_poses(points, image_of(points, pose))) == count


def test_views_of_few_points_are_refined_with_those_of_many():
    """The copies that fill up a view do not count, in its pose and in its distance."""
    rng = np.random.default_rng(8)
    start = np.array([random_pose(rng) for _ in range(3)])
    views = []
    for pose, count in zip(start, (35, 4, 9), strict=True):
        points = rng.permutation(CHECKERBOARD)[:count]
        views.append(
            (points, image_of(points, pose @ se3.exp6(np.full(6, 0.02))) + 1e-3 * rng.normal(size=(count, 2)))
        )
    poses, distances = _refine(start, views)
    for pose, distance, view, first in zip(poses, distances, views, start, strict=True):
        (alone,), (alone_distance,) = _refine(first[None], [view])
        np.testing.assert_allclose(pose, alone, atol=1e-9)
        assert distance == pytest.approx(alone_distance)
        errors = image_of(view[0], pose) - view[1]
        assert distance == pytest.approx(np.sqrt(np.mean(np.sum(errors**2, 1))))
        # No small motion explains the image better.
        slopes = _jacobian(se3.transform_points(pose, view[0]))
        assert np.abs(np.einsum("mi,mij->j", errors, slopes)).max() < 1e-3 * np.abs(errors).sum()


@pytest.mark.parametrize("depth", [0.03, 0.08])
def test_exact_points_near_a_plane_agree_as_far_as_a_map_of_the_plane_describes_them(depth):
    for seed in range(15):
        rng = np.random.default_rng(seed)
        points = rng.uniform(-0.1, 0.1, (24, 3)) * [1, 1, depth]
        pose = se3.transform(se3.exp3(rng.uniform(-0.6, 0.6, 3)), [0, 0, rng.uniform(0.25, 0.5)])
        assert agreeing_points(points, image_of(points, pose)).all()
