"""Lens models agree with OpenCV, and their derivatives with finite differences."""

import numpy as np
import pytest

from dhcal_pin.cameras import LENSES
from dhcal_pin.cameras import lens as lens_module

cv2 = pytest.importorskip("cv2")

VALUES = {
    "pinhole": np.array([640.0, 655.0, 630.0, 362.0, -0.11, 0.05, 1e-3, -2e-3, 0.02]),
    "fisheye": np.array([420.0, 431.0, 630.0, 362.0, 0.02, -0.01, 5e-3, -1e-3]),
}
LENS = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)


def points(seed=0, m=40):
    rng = np.random.default_rng(seed)
    return np.stack([*rng.uniform(-0.5, 0.5, (2, m)), rng.uniform(0.5, 2.0, m)])


@LENS
def test_pixels_equal_those_of_opencv(lens):
    x, values = points(), VALUES[lens.name]
    matrix = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1.0]])
    objects = x.T[:, None].copy()
    project = cv2.projectPoints if lens.name == "pinhole" else cv2.fisheye.projectPoints
    wanted = project(objects, np.zeros(3), np.zeros(3), matrix, values[4:])[0][:, 0].T
    np.testing.assert_allclose(lens.project(x, values)[0], wanted, atol=1e-9)


@LENS
def test_derivatives_equal_central_differences(lens):
    x, values, h = points(1), VALUES[lens.name], 1e-6
    _, by_points, by_values = lens.project(x, values)
    for k in range(3):
        step = h * np.eye(3)[:, k : k + 1]
        slope = (lens.project(x + step, values)[0] - lens.project(x - step, values)[0]) / (2 * h)
        np.testing.assert_allclose(by_points[:, k], slope, atol=1e-7 * np.abs(by_points).max())
    for k in range(len(values)):
        step = h * np.eye(len(values))[k]
        slope = (lens.project(x, values + step)[0] - lens.project(x, values - step)[0]) / (2 * h)
        np.testing.assert_allclose(by_values[:, k], slope, atol=1e-7 * np.abs(by_values).max())


@LENS
def test_normalize_is_the_inverse_of_project(lens):
    x, values = points(2), VALUES[lens.name]
    np.testing.assert_allclose(lens.normalize(lens.project(x, values)[0], values), x[:2] / x[2], atol=1e-9)


def test_a_strong_distortion_has_an_inverse():
    lens, x = LENSES["pinhole"], np.array([[0.9, -0.8, 0.7], [0.9, 0.9, -0.9], [1, 1, 1]])
    values = np.array([500.0, 500, 320, 240, 0.8, 0.3, 0, 0, 0])
    np.testing.assert_allclose(lens.normalize(lens.project(x, values)[0], values), x[:2], atol=1e-9)


@LENS
def test_points_on_the_axis_have_finite_derivatives(lens):
    found = lens.project(np.array([[0.0], [0.0], [1.0]]), VALUES[lens.name])
    assert all(np.isfinite(part).all() for part in found)
    np.testing.assert_allclose(found[1][:, :2, 0], np.diag(VALUES[lens.name][:2]), rtol=1e-12)


@LENS
def test_each_value_has_a_name(lens):
    assert lens.names[:4] == ("fx", "fy", "cx", "cy")
    assert len(lens.names) == len(VALUES[lens.name])


@LENS
def test_points_behind_the_camera_are_as_if_just_before_it(lens):
    """Their depth has no effect any more; that of points at the smallest depth has."""
    values = VALUES[lens.name]
    behind, near = (np.array([[2e-7, -1e-7], [1e-7, 3e-7], [z, z]]) for z in (-0.5, 1e-6))
    pixels, by_points, _ = lens.project(behind, values)
    np.testing.assert_array_equal(pixels, lens.project(near, values)[0])
    np.testing.assert_array_equal(by_points[:, 2], 0.0)
    np.testing.assert_array_equal(by_points[:, :2], lens.project(near, values)[1][:, :2])
    assert np.all(lens.project(near, values)[1][:, 2] != 0.0)


@LENS
def test_many_pixels_are_normalized_as_few(lens, monkeypatch):
    values = VALUES[lens.name]
    pixels = lens.project(points(3), values)[0]
    together = lens.normalize(pixels, values)
    for size in (39, 7):
        monkeypatch.setattr(lens_module, "_BLOCK", size)
        np.testing.assert_allclose(lens.normalize(pixels, values), together, atol=1e-12)


def test_pixels_that_no_point_has_are_those_without_distortion():
    """With k1 = -0.5 no distorted radius is above 0.55, and that of 0.2 is 0.2·(1 - 0.02)."""
    values = np.array([500.0, 400, 320, 240, -0.5, 0, 0, 0, 0])
    pixels = np.array([[320 + 500 * 0.9, 320 + 500 * 0.196], [240 + 400 * 0.8, 240]])
    np.testing.assert_allclose(
        LENSES["pinhole"].normalize(pixels, values), [[0.9, 0.2], [0.8, 0]], atol=1e-12
    )
