"""Rigid transformations against Pinocchio and against the group laws."""

import mpmath
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dhcal_pin import se3

twists = arrays(float, 6, elements=st.floats(-1.5, 1.5))
ANGLES = [0.0, 1e-12, 1e-8, 1e-4, 0.099, 0.101, 1.0, 2.0, 3.0, 3.1415, np.pi - 1e-9]


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_logarithm_and_adjoint_equal_pinocchio(angle):
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(50, 3))
    twist = np.concatenate(
        [rng.normal(size=(50, 3)), angle * axes / np.linalg.norm(axes, axis=1)[:, None]], 1
    )
    for x, pose in zip(twist, se3.exp6(twist), strict=True):
        np.testing.assert_allclose(pose, pin.exp6(x).homogeneous, atol=4e-15)
        np.testing.assert_allclose(se3.adjoint(pose), pin.SE3(pose).action, atol=4e-15)
        np.testing.assert_allclose(se3.log6(pose), x, atol=1e-14 * max(1, 1e-9 / (np.pi - angle)))
        wanted = pin.Jlog3(pin.exp3(x[3:]))
        np.testing.assert_allclose(se3.right_jacobian_inverse(x[3:]), wanted, atol=1e-13)


@pytest.mark.parametrize("square", [1e-8, 1e-4, 9.99e-4, 1.01e-3, 3e-3, 1e-2, 0.03, 0.1, 1.0])
def test_right_jacobian_inverse_near_the_limit_of_its_series(square):
    """The factor f = 1/θ² - 1/(2θ·tan(θ/2)) with forty digits."""
    axis = np.array([0.36, 0.48, -0.8])
    with mpmath.workdps(40):
        angle = mpmath.sqrt(mpmath.mpf(square))
        factor = float(1 / angle**2 - 1 / (2 * angle * mpmath.tan(angle / 2)))
    rotvec = np.sqrt(square) * axis
    cross = np.cross(np.eye(3), rotvec)
    wanted = np.eye(3) + 0.5 * cross + factor * cross @ cross
    np.testing.assert_allclose(se3.right_jacobian_inverse(rotvec), wanted, rtol=0, atol=3e-15)


def test_logarithm_of_half_turns_has_norm_pi():
    for axis in (*np.eye(3), np.ones(3) / np.sqrt(3), np.array([0.6, -0.8, 0.0])):
        turn = 2 * np.outer(axis, axis) - np.eye(3)
        rotvec = se3.log3(turn)
        assert np.linalg.norm(rotvec) == pytest.approx(np.pi, abs=1e-14)
        np.testing.assert_allclose(pin.exp3(rotvec), turn, atol=1e-14)


@given(twists, twists)
@settings(max_examples=100, deadline=None)
def test_adjoint_transforms_twists(x, y):
    pose = se3.exp6(x)
    np.testing.assert_allclose(
        se3.exp6(se3.adjoint(pose) @ y), pose @ se3.exp6(y) @ se3.inverse(pose), atol=1e-13
    )


@given(arrays(float, 3, elements=st.floats(-1.5, 1.5)))
@settings(max_examples=100, deadline=None)
def test_right_jacobian_inverse_is_the_derivative_of_the_logarithm(rotvec):
    h = 1e-6
    rotation = se3.exp3(rotvec)
    numeric = np.stack(
        [
            (se3.log3(rotation @ se3.exp3(h * e)) - se3.log3(rotation @ se3.exp3(-h * e))) / (2 * h)
            for e in np.eye(3)
        ],
        -1,
    )
    np.testing.assert_allclose(se3.right_jacobian_inverse(rotvec), numeric, atol=1e-8)


@given(
    arrays(float, 3, elements=st.floats(-3.1, 3.1)),
    arrays(float, 3, elements=st.floats(-7.0, 7.0)),
    st.sampled_from([None, np.pi / 2, -np.pi / 2]),
)
@settings(max_examples=300, deadline=None)
def test_nearest_rpy_is_the_nearest_of_all_that_give_the_rotation(angles, near, pitch):
    angles[1] = angles[1] if pitch is None else pitch
    rotation = pin.rpy.rpyToMatrix(*angles)
    found = se3.nearest_rpy(rotation, near)
    np.testing.assert_allclose(pin.rpy.rpyToMatrix(*found), rotation, atol=1e-14)
    # Another triple is never nearer: the given one up to whole turns, or near itself if it is the rotation.
    turns = near + np.mod(angles - near + np.pi, 2 * np.pi) - np.pi
    assert np.linalg.norm(found - near) <= np.linalg.norm(turns - near) + 1e-7
    np.testing.assert_allclose(se3.nearest_rpy(pin.rpy.rpyToMatrix(*near), near), near, atol=1e-7)


def test_nearest_rpy_at_a_quarter_turn_keeps_roll_and_yaw():
    """Roll and yaw share one axis there: a rotation about it by 0.2 is halved between them."""
    for sign in (1.0, -1.0):
        near = np.array([0.3, sign * np.pi / 2, -0.4])
        rotation = pin.rpy.rpyToMatrix(0.5, sign * np.pi / 2, -0.4)
        np.testing.assert_allclose(
            se3.nearest_rpy(rotation, near), near + np.array([0.1, 0.0, -sign * 0.1]), atol=1e-15
        )


def test_functions_broadcast_over_leading_axes():
    twist = np.random.default_rng(1).normal(size=(2, 3, 6))
    stacked = se3.inverse(se3.exp6(twist))
    assert stacked.shape == (2, 3, 4, 4)
    np.testing.assert_allclose(stacked[1, 2], np.linalg.inv(pin.exp6(twist[1, 2]).homogeneous), atol=1e-14)
