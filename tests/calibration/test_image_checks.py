"""Checks of images: what they show of joint ranges, rotations and poses, and whose images they are."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from camera_setups import ARMS, Setup, placement_fit, simulate
from scipy.spatial.transform import Rotation

from dhcal_pin import se3, select_parameters
from dhcal_pin.calibration.cameras import image_checks
from dhcal_pin.calibration.cameras.image_checks import (
    count_outlying_images,
    describe_outlying_end,
    describe_rotation,
    describe_weak_positions,
    find_unrelated_images,
    largest_fixed_std,
    largest_position_std,
    largest_tool_std,
    second_rotation,
    seen_ranges_warning,
    small_ranges,
)
from dhcal_pin.estimation.frame_gauge import tool_gauge_covariance
from dhcal_pin.estimation.uncertainty import Uncertainty
from dhcal_pin.measurements import Pose


@pytest.fixture(scope="module")
def setup() -> Setup:
    chain = ARMS["ur10"]()
    return simulate(
        chain, chain, np.random.default_rng(1), is_on_wrist=True, n_images=9, sigma=0.0, n_cameras=2
    )


def with_order(images, order):
    """Return images whose joint values are those of the images in another order."""
    q = images.q[np.unique(images.image, return_index=True)[1]]
    return images.replace(q=q[np.asarray(order)[images.image]])


@pytest.mark.parametrize(
    ("error", "n_rejected", "degrees", "text"),
    [
        (9.9, 0, 30.0, ""),
        (10.0, 50, 30.0, ""),
        (9.9, 51, 30.0, "differ by 30° (median)"),
        (10.1, 0, 10.01, "differ by 10° (median)"),
        (10.1, 0, 9.99, ""),
    ],
)
def test_images_of_another_robot_are_those_whose_rotations_differ(
    monkeypatch, setup, error, n_rejected, degrees, text
):
    monkeypatch.setattr(image_checks, "fitted_error", lambda _: SimpleNamespace(pixels=error))
    monkeypatch.setattr(image_checks, "_angle_difference", lambda *_: np.deg2rad(degrees))
    weights = np.ones(100)
    weights[:n_rejected] = 0.0
    fit: Any = SimpleNamespace(data=(setup.images,), weights=(weights,))
    found = find_unrelated_images(fit, (), setup.nominal, 10.0)
    assert text in found
    assert bool(found) == bool(text)
    # Other measurements beside the images have angles of their own.
    q = np.zeros((1, 6))
    fit.data = setup.images, Pose(q, np.eye(4)[None])
    assert find_unrelated_images(fit, (), setup.nominal, 10.0) == ""


def test_angles_of_images_are_compared_with_those_of_the_robot(setup):
    """Joint values in a wrong order are compared with the images at five shifts; the best one counts."""
    images = setup.exact.take(setup.exact.camera == 0)
    first = np.unique(images.image, return_index=True)[1]
    mixed = with_order(images, np.random.default_rng(2).permutation(len(first)))
    sequence = np.random.default_rng(0).permutation(mixed.q[first])
    place = [int(np.argmin(np.abs(sequence - q).sum(1))) for q in mixed.q[first]]
    shown, stated = (
        Rotation.from_matrix(setup.nominal.poses(q)[:, :3, :3]) for q in (images.q[first], sequence)
    )
    medians = []
    for shift in (-2, -1, 0, 1, 2):
        inside = [k for k in range(len(first)) if 0 <= place[k] + shift < len(first)]
        medians.append(np.median([
            abs((stated[place[i] + shift].inv() * stated[place[j] + shift]).magnitude()
                - (shown[i].inv() * shown[j]).magnitude())
            for i in inside for j in inside if i < j
        ]))  # fmt: skip
    found = image_checks._angle_difference(setup.nominal, mixed, sequence)
    assert found == pytest.approx(min(medians), abs=1e-6)
    assert found > np.deg2rad(5.0)
    # Five images are too few.
    for count in (5, 6):
        few = mixed.take(mixed.image < count)
        assert (image_checks._angle_difference(setup.nominal, few, sequence) > 0) == (count == 6)


def ranged(limits, moved, prismatic=()) -> tuple[Any, list[Any]]:
    """Return a chain of joints with limits, and data where each moved from one value to another one."""
    low, high = np.array(moved, float).T
    q = np.array([low, (low + high) / 2, high])
    chain = SimpleNamespace(
        is_prismatic=np.isin(np.arange(len(low)), prismatic),
        lower=np.array(limits, float)[:, 0],
        upper=np.array(limits, float)[:, 1],
        joint_names=[f"j{i}" for i in range(len(low))],
    )
    return chain, [Pose(q, np.tile(np.eye(4), (3, 1, 1)))]


PI = np.pi


@pytest.mark.parametrize(
    ("limits", "moved", "prismatic", "names"),
    [
        # Half of the range is enough; a turn is the whole range of a joint with wider limits.
        ([(-2, 2), (-2, 2)], [(-1, 1), (-1, 0.98)], (), ["j1 -57° to 56°"]),
        ([(-9, 9), (-9, 9)], [(0, PI), (0, 3.1)], (), ["j1 0° to 178°"]),
        ([(0, 0.5), (-np.inf, np.inf)], [(0.1, 0.3), (0.1, 0.3)], (0, 1), ["j0 100 to 300 mm"]),
        ([(-1, 1)] * 3, [(0, 0.3), (0, 0.1), (0, 0.2)], (), ["j1 0° to 6°", "j2 0° to 11°", "j0 0° to 17°"]),
    ],
)  # fmt: skip
def test_joints_that_moved_less_than_half_of_their_range_are_listed(limits, moved, prismatic, names):
    assert small_ranges(*ranged(limits, moved, prismatic)) == names


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, ""),
        (1, "half of the range of a joint: j0 0° to 6°. Outside"),
        (3, "half of the range of 3 joints: j0 0° to 6°, j1 0° to 6°, j2 0° to 6°. Outside"),
        (5, "half of the range of 5 joints: j0 0° to 6°, j1 0° to 6°, j2 0° to 6°, and 2 more. Outside"),
    ],
)
def test_three_joints_with_small_ranges_are_named(count, text):
    limits, moved = [(-1, 1)] * (count + 1), [(0, 0.1)] * count + [(-1, 1)]
    warning = seen_ranges_warning(*ranged(limits, moved))
    assert text in warning
    assert bool(warning) == bool(count)


def stds(names, values):
    """Return names of parameters and a covariance with standard deviations of positions [mm]."""
    return [f"{name}.{axis}" for name in names for axis in (*"xyz", "rx")], np.diag(
        np.square(1e-3 * np.array([[*each, 9.0] for each in values]).ravel())
    )


def test_standard_deviations_are_those_of_positions_of_cameras_and_boards(setup):
    rig = setup.exact.rig
    names, covariance = stds(
        ["sphere_a", "camera_camera0", "board_board0"], [(8, 8, 8), (1, 3, 2), (4, 5, 1)]
    )
    assert largest_position_std(names, covariance) == pytest.approx(5e-3)
    assert largest_position_std(names[:8], covariance) == pytest.approx(3e-3)
    # The board stands still, the cameras are on the wrist.
    assert largest_fixed_std(rig, names, covariance) == pytest.approx(5e-3)
    assert largest_fixed_std(rig, names[:8], covariance) is None
    covariance[5, 5] = np.inf
    assert largest_position_std(names, covariance) == np.inf


def test_what_errors_of_the_arm_imitate_is_no_error_of_a_camera(setup):
    """The covariance of the tool displaces a camera, in the axes of its link."""
    chain = setup.nominal
    errors = select_parameters(chain, "placement,offset")
    n = len(errors.parameters)
    priors = Uncertainty.from_errors(errors, np.zeros(n), chain, np.diag(errors.priors), np.empty((n, 0)))
    link = se3.transform(se3.exp3(np.array([0.3, -0.5, 0.2])), np.array([0.1, 0.2, -0.3]))
    rig = setup.exact.rig
    rig = replace(rig, camera_mounts=(replace(rig.camera_mounts[0], link_pose=link), *rig.camera_mounts[1:]))
    pose = rig.cameras[0].pose
    assert pose is not None

    def position(displacement):
        return (np.linalg.inv(link) @ se3.exp6(displacement) @ link @ pose)[:3, 3]

    derivative = np.array([position(1e-6 * axis) - position(-1e-6 * axis) for axis in np.eye(6)]).T / 2e-6
    names, own = stds(["camera_camera0"], [(2, 3, 1)])
    covariance = own.copy()
    covariance[:3, :3] += derivative @ tool_gauge_covariance(priors) @ derivative.T
    assert largest_tool_std(rig, names, covariance, priors) == pytest.approx(3e-3, rel=1e-5)


def test_the_second_rotation_is_that_about_the_axis_with_the_second_largest_one(setup):
    """The tool turns by 0.5 rad about one axis and by 0.2 rad about another one."""
    turn = se3.exp3(np.array([0.4, 0.1, -0.7]))
    first = np.unique(setup.images.image, return_index=True)[1]
    place = np.argsort(np.argsort(first))[setup.images.image]
    angles = np.array([(0.5, 0), (-0.5, 0), (0, 0.2), (0, -0.2)])[place % 4] * np.sqrt(2)
    q = np.zeros_like(setup.images.q)
    q[:, :2] = angles
    data = [setup.images.take(np.isin(place, range(8))).replace(q=q[np.isin(place, range(8))])]
    chain: Any = SimpleNamespace(
        poses=lambda q: np.array(
            [se3.transform(turn @ se3.exp3(np.array([*each[:2], 0])), np.zeros(3)) for each in q]
        )
    )
    assert second_rotation(chain, data) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("rotation", "text"), [(1e-4, "never turned"), (1.1e-4, "0.0063° (RMS)"), (0.5, "turned by 29° (RMS)")]
)
def test_rotations_are_stated_in_degrees(rotation, text):
    assert text in describe_rotation(rotation)


@pytest.mark.parametrize(
    ("std", "error", "rotation", "start"),
    [
        (7.1e-3, 1e-3, 0.01, ""),
        (7.2e-3, 1e-3, 0.01, "Too few rotations"),
        (7.2e-3, 1e-3, np.deg2rad(7.99), "Too few rotations"),
        (7.2e-3, 1e-3, np.deg2rad(8.01), "Too few images"),
        (7.1e-6, 0.0, 0.01, ""),
        (7.2e-6, 0.0, 0.01, "Too few rotations"),
    ],
)
def test_positions_are_weak_if_an_error_at_8_degrees_displaces_them_less(std, error, rotation, start):
    found = describe_weak_positions(std, error, rotation)
    assert found.startswith(start)
    assert bool(found) == bool(start)


def places(images) -> np.ndarray:
    """Return the place of each sample's image among those of its camera, in the order of the file."""
    first = images.rows[np.unique(images.image, return_index=True)[1]]
    return np.argsort(np.argsort(first))[images.image]


@pytest.mark.parametrize(
    ("outlying", "texts"),
    [
        # Two of two outlying images at one end of 46 are there by chance in 1 of 1035 cases.
        ((0, 1), ["first 2"]),
        ((44, 45), ["last 2"]),
        ((0,), []),
        ((0, 2), []),
        ((0, 1, 44, 45), []),
        ((0, 1, 2, 10), ["first 3"]),
        (tuple(range(46)), []),
    ],
)
def test_outlying_images_at_an_end_are_no_chance(outlying, texts):
    chain = ARMS["ur10"]()
    images = simulate(chain, chain, np.random.default_rng(1), is_on_wrist=True, n_images=46, sigma=0.2).images
    found = describe_outlying_end([(images, ~np.isin(places(images), outlying))], False)
    assert [" ".join(text.split()[4:6]) for text in found] == texts
    for text in found:
        assert f"may have moved {'after' if 'first' in text else 'before'} them" in text
        assert text.endswith("Check both, and take the images again.")


def test_outlying_images_are_named_by_the_first_and_the_last_one():
    chain = ARMS["ur10"]()
    images = simulate(chain, chain, np.random.default_rng(1), is_on_wrist=True, n_images=46, sigma=0.2).images
    names = np.array([f"{place:02}.png" for place in places(images)], object)
    named = images.replace(image_names=names)
    (text,) = describe_outlying_end([(named, places(images) > 2)], True)
    assert "camera 'camera0' (00.png to 02.png) are outliers" in text
    assert "Calibrate without hold-out images" in text
    (text,) = describe_outlying_end([(named, places(images) < 43)], True)
    assert "(43.png to 45.png)" in text
    partly = images.replace(image_names=np.where(places(images) == 0, "", names))
    (text,) = describe_outlying_end([(partly, places(images) > 2)], True)
    assert "camera 'camera0' are outliers" in text


def test_outlying_images_are_counted_by_camera(setup):
    images = setup.images
    assert (
        count_outlying_images([(images.take(images.camera == 0), np.ones((images.camera == 0).sum(), bool))])
        == []
    )
    is_good = (images.camera == 0) | (images.image % 2 == 0)
    parts = [(images.take(part), is_good[part]) for part in (images.image < 3, images.image >= 3)]
    parts.append((Pose(np.zeros((1, 6)), np.eye(4)[None]), np.zeros(1, bool)))
    found = {name: counts for name, *counts in count_outlying_images(parts)}
    numbers = {camera: np.unique(images.image[images.camera == camera]) for camera in (0, 1)}
    assert found["camera0"] == [0, len(numbers[0])]
    assert found["camera1"] == [int(np.sum(numbers[1] % 2)), len(numbers[1])]


def test_fits_of_images_with_a_small_error_are_not_questioned():
    fit = placement_fit(0.0, 6, 0)
    assert find_unrelated_images(fit, (), fit.problem.errors.chain, 10.0) == ""
