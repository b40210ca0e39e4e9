"""Noise of corners in the image and at the board, estimated from residuals."""

from dataclasses import replace

import numpy as np
import pytest
from camera_setups import ARMS, placement_fit, simulate

from dhcal_pin.calibration import calibrate
from dhcal_pin.calibration.cameras.corner_noise import _with_corner_noise, estimate_corner_variances
from dhcal_pin.measurements import KINDS, CameraCorners, Noise
from dhcal_pin.se3 import transform

N_ROWS, N_SEEDS = 2000, 20


def simulated_rows(rng, sigma, displacement):
    """Return squared residuals [px²] and squared slopes [px²/m²] of corners 0.2 to 1 m from a camera."""
    slopes = (1000 / rng.uniform(0.2, 1.0, N_ROWS)) ** 2
    variance = sigma**2 + displacement**2 * slopes
    return variance * rng.standard_normal(N_ROWS) ** 2, slopes


@pytest.mark.parametrize("is_stated", [False, True])
@pytest.mark.parametrize(("sigma", "displacement"), [(0.2, 1e-4), (0.3, 0.0), (0.05, 2e-4)])
def test_variances_agree_with_the_truth(sigma, displacement, is_stated):
    """The mean of 20 simulations is within 4 of its standard errors, and 2 % of the total variance."""
    rng, found = np.random.default_rng(1), []
    placeholder = np.full(N_ROWS, sigma**2 if is_stated else 0.3)
    for _ in range(N_SEEDS):
        squares, slopes = simulated_rows(rng, sigma, displacement)
        factor, variance = estimate_corner_variances(squares, placeholder, slopes, 0.0, is_stated)
        found.append([factor * placeholder[0], variance])
    error = np.std(found, 0) / np.sqrt(N_SEEDS)
    mean_slope = simulated_rows(rng, sigma, displacement)[1].mean()
    total = sigma**2 + displacement**2 * mean_slope
    tolerance = 4 * error + 0.02 * total / np.array([1, mean_slope])
    assert np.all(np.abs(np.mean(found, 0) - [sigma**2, displacement**2]) < tolerance)
    if is_stated:
        assert np.allclose(np.array(found)[:, 0], sigma**2)


def test_determined_parameters_do_not_count_as_noise():
    """A fit of p parameters to m rows leaves residuals of the variance 1 - p/m."""
    squares, slopes = simulated_rows(np.random.default_rng(2), 0.2, 0.0)
    n_determined = 0.4 * N_ROWS
    factor, variance = estimate_corner_variances(0.6 * squares, np.ones(N_ROWS), slopes, n_determined, False)
    assert factor + variance * slopes.mean() == pytest.approx(0.04, rel=0.1)


def test_derivative_by_the_corner_agrees_with_differences():
    """Boards are moved by small steps along the axes of a camera that stands still."""
    arm = ARMS["ur10"]()
    images = simulate(arm, arm, np.random.default_rng(4), is_on_wrist=False, n_images=5, sigma=0.2).exact
    frames = arm.forward_kinematics(images.q)
    u = np.array([p.nominal for p in images.instrument_parameters])
    slopes = images.corner_derivative(frames, u)
    camera = images.rig.cameras[0].pose
    for axis in range(3):
        step = 1e-5 * np.eye(3)[axis]
        # Moving the camera by -step is moving all corners by step.
        shifted = []
        for sign in (1, -1):
            pose = camera @ transform(np.eye(3), -sign * step)
            moved = u.copy()
            moved[:3] = pose[:3, 3]
            shifted.append(-images.errors(frames, moved)["pixels"])
        difference = (shifted[0] - shifted[1]) / 2e-5
        np.testing.assert_allclose(slopes[:, :, axis], difference, atol=1e-6 * np.abs(slopes).max())


def test_a_stated_noise_is_the_least_one(sim_6dof):
    rng = np.random.default_rng(3)
    images = KINDS["camera"].simulate(sim_6dof, rng.uniform(-2, 2, (30, 6)), Noise(3e-4), rng)
    fit = calibrate(sim_6dof, images.replace(sigma=2 * images.sigma), "camera,board").hand_eye_fit
    assert fit is not None
    (found,) = _with_corner_noise(replace(fit.fit, data=(images.replace(sigma=2 * images.sigma),)))
    assert isinstance(found, CameraCorners)
    assert np.all(found.sigma >= 0.6 - 1e-9)


@pytest.mark.parametrize("is_stated", [True, False])
def test_noise_of_corners_without_displacements_is_that_of_the_simulation(sim_6dof, is_stated):
    """The standard deviation is 0.3 px; without a stated one it is estimated."""
    rng = np.random.default_rng(3)
    images = KINDS["camera"].simulate(sim_6dof, rng.uniform(-2, 2, (30, 6)), Noise(3e-4), rng)
    if not is_stated:
        images = images.replace(sigma=np.ones_like(images.sigma), has_stated_sigma=False)
    fit = calibrate(sim_6dof, images, "camera,board").hand_eye_fit
    assert fit is not None
    (found,) = _with_corner_noise(fit.fit)
    assert isinstance(found, CameraCorners)
    np.testing.assert_allclose(np.mean(found.sigma**2), 0.3**2, rtol=0.1)


def test_corners_that_are_displaced_at_the_board_have_more_noise_the_nearer_they_are():
    fit, rng = placement_fit(0.0, 20, 0), np.random.default_rng(3)
    (item,) = fit.problem.data
    assert isinstance(item, CameraCorners)
    frames = fit.problem.chain(fit.solution.x).forward_kinematics(item.conditions())
    slopes = item.corner_derivative(frames, fit.problem.instrument_values_of(item, fit.solution.x))
    moved = np.einsum("mij,mj->mi", slopes, 5e-4 * rng.standard_normal((len(item.rows), 3)))
    data = (item.replace(values=item.values + moved),)
    fit = replace(fit, data=data, problem=replace(fit.problem, data=data)).solved(20)
    (found,) = _with_corner_noise(fit)
    assert isinstance(found, CameraCorners)
    expected = np.sqrt(0.2**2 + 5e-4**2 * np.sum(slopes**2, 2))
    assert expected.max() > 1.5 * expected.min()
    np.testing.assert_allclose(found.sigma, expected, rtol=0.15)
