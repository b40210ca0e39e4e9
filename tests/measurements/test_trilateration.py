"""Trilateration: closed form, mirror image, noise amplification, and calibration with unknown anchors."""

import numpy as np
import pytest

from dhcal_pin.calibration import calibrate
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.measurements import Noise, Position, Wires
from dhcal_pin.measurements.trilateration import (
    device_anchors,
    locate_point,
    mirror_images,
    position_dilution,
    trilaterate_three_wires,
)

pytestmark = pytest.mark.usefixtures("unsuspected")

A, B, C = 0.3, 0.25, -0.1
# Dimensions and anchors of an equilateral rig of 300 mm in the plane x = 0.
EQUILATERAL = 0.3, 0.3 * np.sqrt(3) / 2, -0.15
RIG = device_anchors(*EQUILATERAL)


def lengths(points, anchors):
    return np.linalg.norm(points[:, None] - anchors, axis=2)


def random_points(m, seed=0):
    """Return points more than 10 mm off the plane of the anchors."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (m, 3))
    points[:, 0] = np.sign(points[:, 0]) * (0.01 + np.abs(points[:, 0]))
    return points


def test_closed_form_is_exact_on_the_given_side():
    points = random_points(1000)
    for side in (1, -1):
        mine = points[np.sign(points[:, 0]) == side]
        found = trilaterate_three_wires(lengths(mine, device_anchors(A, B, C)), A, B, C, side)
        np.testing.assert_allclose(found, mine, atol=1e-9)


def test_equations_as_printed_are_wrong():
    """(41) as printed has the wrong sign of y, and a z that is correct only if a² = b² + c²."""
    points = random_points(5)
    l1, l2, l3 = lengths(points, device_anchors(A, B, C)).T
    np.testing.assert_allclose((l2**2 - l3**2) / (4 * B), -points[:, 1], atol=1e-12)
    printed = (l2**2 + l3**2 - 2 * (l1**2 + A**2 - B**2 - C**2)) / (4 * (A - C))
    assert np.abs(printed - points[:, 2]).min() > 1e-3


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: trilaterate_three_wires([[1, 1, 1]], 0.3, 0.25, 0.3), "on one line"),
        (lambda: trilaterate_three_wires([[1, 1, 1]], 0.3, 0.0, 0.1), "on one line"),
        (
            lambda: trilaterate_three_wires([[1, 1, 1], [0.1, 1, 1]], A, B, C),
            "lengths of sample 2 do not meet",
        ),
        (lambda: trilaterate_three_wires([[np.nan, 1, 1]], A, B, C), "three wires: lengths"),
        (lambda: trilaterate_three_wires([[1, 1, 1], [-1, 1, 1]], A, B, C), "sample 2 is negative"),
        (lambda: trilaterate_three_wires([1, 1, 1], A, B, C), r"has shape \(3,\)"),
    ],
)
def test_impossible_anchors_and_lengths_are_refused(call, message):
    with pytest.raises(DhcalError, match=message):
        call()


def test_noise_near_the_mirror_plane_makes_lengths_that_do_not_meet():
    """At x = 2 mm and 0.1 mm of wire noise 46 % of the radicands are negative."""
    rng = np.random.default_rng(0)
    point = np.tile([0.002, 0.1, 0.05], (4000, 1))
    noisy = lengths(point, device_anchors(A, B, C)) + 1e-4 * rng.standard_normal((4000, 3))
    lost = 0
    for row in noisy:
        try:
            trilaterate_three_wires(row[None], A, B, C)
        except DhcalError:
            lost += 1
    assert lost / 4000 == pytest.approx(0.46, abs=0.05)


@pytest.mark.parametrize(
    ("x", "wanted"), [(1.0, (0.71, 2.84, 2.90)), (0.3, (0.84, 1.14, 1.29)), (0.01, (14.1, 0.80, 1.00))]
)
def test_position_dilution_equals_that_of_simulated_noise(x, wanted):
    """Verified figures of an equilateral device, by the formula and by small noise."""
    point = np.array([[x, 0.12, -0.08]])
    found = position_dilution(point, RIG)[0]
    rng = np.random.default_rng(0)
    noisy = lengths(np.tile(point, (20000, 1)), RIG) + 1e-7 * rng.standard_normal((20000, 3))
    seen = np.std(trilaterate_three_wires(noisy, *EQUILATERAL), axis=0) / 1e-7
    np.testing.assert_allclose(seen, found, rtol=0.03)
    np.testing.assert_allclose(found, wanted, rtol=0.01)


def test_locate_point_is_exact():
    points = random_points(20)
    np.testing.assert_allclose(locate_point(points, lengths(points, RIG[:1])[:, 0]), RIG[0], atol=1e-12)


@pytest.mark.parametrize("extents", [(1, 1, 1e-3), (1, 1e-3, 1e-3)])
def test_points_near_a_plane_or_a_line_locate_a_point(extents):
    """The linear equations are up to a metre off: they know nothing across the plane."""
    rng, right = np.random.default_rng(0), 0
    for _ in range(20):
        points, anchor = 0.2 * rng.uniform(-1, 1, (40, 3)) * extents, rng.normal(size=3)
        measured = lengths(points, anchor[None])[:, 0] + 1e-6 * rng.standard_normal(40)
        found = locate_point(points, measured)
        cost, true_cost = (
            np.sum((lengths(points, each[None])[:, 0] - measured) ** 2) for each in (found, anchor)
        )
        assert cost <= true_cost
        right += np.linalg.norm(found - anchor) < 0.02
    assert right == 20


def test_images_of_a_point_have_nearly_its_distances():
    """One in a plane, three about a line, and none where the points extend in space."""
    rng, anchor = np.random.default_rng(0), np.array([0.3, 0.4, 1.0])
    for extents, count in (((1, 0.7, 1e-3), 1), ((1, 1e-3, 2e-3), 3), ((1, 0.7, 0.4), 0)):
        points = 0.2 * rng.uniform(-1, 1, (40, 3)) * extents
        images = mirror_images(points, anchor)
        assert len(images) == count
        np.testing.assert_allclose(lengths(points, images) - lengths(points, anchor[None]), 0, atol=2e-3)
    plane = 0.2 * rng.uniform(-1, 1, (40, 3)) * [1, 0.7, 0]
    np.testing.assert_allclose(mirror_images(plane, anchor), [anchor * [1, 1, -1]], atol=1e-12)


def test_unknown_anchors_are_estimated_with_the_robot(sim_6dof, sim_6dof_actual):
    """Raw lengths, unknown anchors and zero offsets, and all the arm's errors, noise-free."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-np.pi, np.pi, (60, 6))
    data = Wires.simulate(sim_6dof_actual, q, Noise(), rng)
    fit = calibrate(sim_6dof, data, "dh", priors="none", fix=["theta1", "d1"])
    anchors = np.array([[fit.instruments[f"wire{i}.{axis}"] for axis in "xyz"] for i in (1, 2, 3)])
    np.testing.assert_allclose([fit.instruments[f"wire{i}.zero"] for i in (1, 2, 3)], 0, atol=1e-7)
    # Anchors and base can move together: compare the distances between the anchors.
    truth = np.array([[np.linalg.norm(a - b) for a in RIG] for b in RIG])
    found = np.array([[np.linalg.norm(a - b) for a in anchors] for b in anchors])
    np.testing.assert_allclose(found, truth, rtol=1e-3)
    other = rng.uniform(-np.pi, np.pi, (50, 6))
    gaps = [
        np.linalg.norm(np.diff(chain.poses(other)[:, :3, 3], axis=0), axis=1)
        for chain in (fit.chain, sim_6dof_actual)
    ]
    np.testing.assert_allclose(*gaps, atol=1e-9)


def test_trilaterated_positions_calibrate_like_positions(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    q = rng.uniform(-np.pi, np.pi, (60, 6))
    points = sim_6dof_actual.poses(q)[:, :3, 3]
    device = np.array([-1.2, 0, 0.2])
    found = device + trilaterate_three_wires(lengths(points, RIG + device), *EQUILATERAL)
    np.testing.assert_allclose(found, points, atol=1e-9)
    fit = calibrate(sim_6dof, Position(q, found), "dh", priors="none")
    assert (
        np.linalg.norm(fit.chain.poses(-q)[:, :3, 3] - sim_6dof_actual.poses(-q)[:, :3, 3], axis=1).max()
        < 1e-8
    )


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_points_locate_one_with_their_distances(count):
    rng = np.random.default_rng(count)
    points, anchor = rng.standard_normal((count, 3)), np.array([2.0, -1.0, 3.0])
    distances = np.linalg.norm(points - anchor, axis=1)
    located = locate_point(points, distances)
    np.testing.assert_allclose(np.linalg.norm(points - located, axis=1), distances, atol=1e-9)
    for image in mirror_images(points, located):
        np.testing.assert_allclose(np.linalg.norm(points - image, axis=1), distances, rtol=0.1)
