"""Derivatives of image coordinates by every unknown agree with differences of sixth order to 1e-7."""

from dataclasses import replace

import numpy as np
import pytest
from camera_setups import ARMS, simulate

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.calibration.cameras.jitter import Jitter, with_jitter
from dhcal_pin.estimation.problem import Problem
from dhcal_pin.measurements import CameraCorners
from dhcal_pin.measurements.camera import _solve_symmetric
from dhcal_pin.measurements.images.camera_parameters import camera_parameters
from dhcal_pin.robot.conditions import Conditions

# Weights of f(x + k·h) - f(x - k·h), k = 1, 2, 3, in the derivative of sixth order (Fornberg 1988).
WEIGHTS = np.array([3 / 4, -3 / 20, 1 / 60])
# Steps of the differences by the unit of an unknown: [m], [rad], [px] and coefficients of distortion [1].
STEPS = {"m": 1e-3, "rad": 2e-3, "px": 1.0, "1": 1e-2, "rad/Nm": 1e-5}


def setting(name, model, *, is_on_wrist, seed):
    """Return a problem with all unknowns of arm, cameras, boards, lenses and corners, away from zero."""
    rng = np.random.default_rng(seed)
    chain = ARMS[name]()
    setup = simulate(
        chain,
        chain,
        rng,
        is_on_wrist=is_on_wrist,
        n_images=6,
        sigma=0.2,
        model=model,
        n_cameras=2,
        n_boards=2,
    )
    rig = setup.exact.rig
    boards = tuple(replace(board, has_free_points=True) for board in rig.boards)
    images = setup.exact.with_rig(replace(rig, boards=boards))
    images = images.take(rng.permutation(len(images.rows))[:120])
    images = images.with_jitter(rng.normal(0, 0.1, images.jitter.shape))
    errors = dh.select_parameters(chain, "placement,offset,gain,harmonics,compliance")
    problem = Problem(errors, (images,), np.zeros(len(errors.parameters) + len(images.instrument_parameters)))
    units = [p.unit for p in (*errors.parameters, *problem.instrument_parameters)]
    size = np.array([{"px": 1.0, "1": 1e-3, "rad/Nm": 1e-6}.get(unit, 1e-3) for unit in units])
    return problem, units, size * rng.standard_normal(len(size))


@pytest.mark.parametrize(
    ("name", "model", "is_on_wrist"),
    [
        ("ur10", "pinhole", True),
        ("panda", "fisheye", False),
        pytest.param("xarm7", "pinhole", False, marks=pytest.mark.slow),
        pytest.param("ur10", "fisheye", True, marks=pytest.mark.slow),
    ],
)
def test_derivatives_of_every_unknown(name, model, is_on_wrist):
    problem, units, x = setting(name, model, is_on_wrist=is_on_wrist, seed=3)
    (chunk,) = problem.chunks

    def residual(at):
        frames = chunk.frames(problem.errors.at(at[: len(problem.errors.parameters)]))
        return chunk.data.residual(frames, problem.instrument_values_of(chunk.data, at))

    jacobian = problem.linearize(x).rows(chunk)[:-1].copy()
    n_checked = 0
    for k, unit in enumerate(units):
        step = STEPS[unit] * np.eye(len(x))[k]
        slope = (
            sum(w * (residual(x + i * step) - residual(x - i * step)) for i, w in enumerate(WEIGHTS, 1))
            / STEPS[unit]
        )
        largest = np.abs(jacobian[k]).max()
        np.testing.assert_allclose(jacobian[k], -slope, atol=1e-7 * largest, err_msg=str(k))
        n_checked += largest > 0
    # Corners that are not seen in the drawn samples, and joints without gravity torque, have no effect.
    assert n_checked > 0.6 * len(x)


def test_small_displacements_hardly_change_the_residuals():
    problem, _, x = setting("ur10", "pinhole", is_on_wrist=True, seed=3)
    (images,) = problem.data
    frames = problem.errors.at(x[: len(problem.errors.parameters)]).forward_kinematics(images.conditions())
    u = problem.instrument_values_of(images, x)
    plain, small = (images.with_jitter(k * images.jitter).residual(frames, u) for k in (0.0, 1e-6))
    np.testing.assert_allclose(small, plain, atol=1e-9 * np.abs(plain).max())


def test_jitter_is_that_of_images_from_a_displaced_tool():
    problem, _, x = setting("ur10", "pinhole", is_on_wrist=True, seed=3)
    (images,), chain = problem.data, problem.chain(x)
    (found,) = with_jitter(problem, x, problem.data, Jitter(2.0, 1e-3, 3e-3))
    assert isinstance(found, CameraCorners)
    plain, u = images.with_jitter(np.zeros_like(images.jitter)), problem.instrument_values_of(images, x)

    def pixels(twist):
        motion = np.tile(se3.exp6(twist), (len(images.q), 1, 1))
        moved = plain.replace(recorded=Conditions(images.q, tool_motion=motion))
        return moved.residual(chain.forward_kinematics(moved.conditions()), u).T * plain.sigma

    slopes = np.stack([(pixels(h) - pixels(-h)) / 2e-6 for h in 1e-6 * np.eye(6)], -1)
    scaled = slopes * np.repeat([1e-3, 3e-3], 3)
    covariance = scaled @ scaled.swapaxes(1, 2)
    np.testing.assert_allclose(found.jitter @ found.jitter.swapaxes(1, 2), covariance, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found.sigma, 2 * images.sigma)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_images_are_counted(count):
    images = setting("ur10", "pinhole", is_on_wrist=True, seed=3)[0].data[0]
    assert images.take(images.image < count).n_images == count


def test_units_and_priors_of_cameras_follow_from_their_names():
    camera = dh.cameras.Camera("c", "tip", 1280, 960, np.array([900.0, 900, 640, 480, 0, 0, 0, 0, 0]))
    found = {p.name.split(".")[1]: (p.unit, p.prior) for p in camera_parameters(camera)}
    for alike in ("x y z", "rx ry rz", "fx fy cx cy", "k1 k2 p1 p2 k3"):
        assert len({found[name] for name in alike.split()}) == 1
    units = "m m m rad rad rad px px px px 1 1 1 1 1".split()
    assert [unit for unit, _ in found.values()] == units


@pytest.mark.parametrize("size", [1e-170, 1.0, 1e170])
def test_errors_at_the_board_are_solved_for_images_of_any_size(size):
    rng = np.random.default_rng(0)
    roots, right = rng.normal(size=(9, 2, 3)), rng.normal(size=(9, 2))
    matrices = roots @ roots.swapaxes(1, 2)
    expected = np.linalg.solve(matrices, right[:, :, None])[:, :, 0]
    np.testing.assert_allclose(size * _solve_symmetric(size * matrices, right), expected, rtol=1e-9)
    assert np.isnan(_solve_symmetric(0 * matrices, right)).all()
