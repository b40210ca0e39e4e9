"""First poses and intrinsics in closed form are exact for exact images."""

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from dhcal_pin import se3
from dhcal_pin.cameras import LENSES, Board, Camera, estimate_pose, intrinsics, solve_hand_eye
from dhcal_pin.cameras.hand_eye import choose_poses, mean_pose
from dhcal_pin.cameras.intrinsics import (
    _in_plane,
    _is_plausible,
    _search,
    _without_centre,
    intrinsics_candidates,
)
from dhcal_pin.cameras.pose_from_points import (
    _orthographic_pose,
    agreeing_points,
    determines_homography,
    direct_linear_transform,
    estimate_poses,
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
    assert values is not None
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
