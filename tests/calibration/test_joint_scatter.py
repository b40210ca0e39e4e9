"""Errors of arms that few images correct, and whose joints have errors that the model lacks."""

import re
from dataclasses import replace

import numpy as np
import pytest
from camera_setups import ARMS, Setup, placement_fit, simulate, uneven_arm
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import least_squares

import dhcal_pin as dh
from dhcal_pin.calibration import Result
from dhcal_pin.calibration.cameras.joint_scatter import CONFIDENCE, _scattered, estimate_scatter
from dhcal_pin.calibration.reweighting import Fit
from dhcal_pin.calibration.summary import position_error_of_images
from dhcal_pin.se3 import exp3

pytestmark = pytest.mark.usefixtures("own_loss", "uneventful", "untried", "ordered_axes")


def uneven_setup(seed: int, n_images: int) -> Setup:
    """Simulate images of an arm whose joints are eccentric and elastic."""
    rng = np.random.default_rng(seed)
    chain = list(ARMS.values())[seed % 3]()
    truth = uneven_arm(chain, 1e-3, rng)
    return simulate(
        chain,
        truth,
        rng,
        is_on_wrist=seed // 3 % 2 == 0,
        n_images=n_images,
        sigma=0.15,
        spread=0.7,
        intrinsics_error=0.02,
    )


def true_error(fit: Result, truth: dh.Chain) -> float:
    """Return the RMS position error in the measured region with the base and the tool that fit best [m]."""
    region = fit.measured_region
    assert region is not None
    q = np.clip(region.draw(np.random.default_rng(7), 200), region.lower, region.upper)
    found, wanted = fit.chain.poses(q), truth.poses(q)[:, :3, 3]

    def misfit(y: np.ndarray) -> np.ndarray:
        points = found[:, :3, 3] + found[:, :3, :3] @ y[6:]
        return np.ravel(points @ exp3(y[3:6]).T + y[:3] - wanted)

    y = least_squares(misfit, np.zeros(9), x_scale=1e-3, method="lm").x
    return float(np.sqrt(3 * np.mean(misfit(y) ** 2)))


def open_fits(seeds, n_images: int) -> list[tuple[Result, Setup, int]]:
    """Return the calibrations that correct the arm, with their set-ups and seeds."""
    out = []
    for seed in seeds:
        setup = uneven_setup(seed, n_images)
        fit = dh.calibrate(setup.nominal, setup.images, session="off")
        if fit.camera_stages[-1].is_kept:
            out.append((fit, setup, seed))
    return out


@pytest.mark.parametrize(
    ("seeds", "n_images"),
    [
        ((2, 6, 14), 15),
        pytest.param(range(50), 15, marks=pytest.mark.slow),
        pytest.param(range(20), 45, marks=pytest.mark.slow),
    ],
)
def test_stated_accuracy_covers_the_true_one(seeds, n_images):
    """With independent corners, predictions from 15 images were up to 2.5 times too small."""
    fits = open_fits(seeds, n_images)
    true = np.array([true_error(fit, setup.truth) for fit, setup, _ in fits])
    ratios = true / [position_error_of_images(fit) for fit, *_ in fits]
    assert np.mean(ratios <= 1.5) >= 0.95, ratios
    assert np.median(ratios) > 0.4, ratios
    if n_images == 15:
        ratios = true / [fit.position_std for fit, *_ in fits]
        assert np.sqrt(np.mean(ratios**2)) < 1.2, ratios


@pytest.mark.parametrize("seeds", [(12,), pytest.param((18, 27, 37, 48), marks=pytest.mark.slow)])
def test_as_many_images_as_the_verdict_names_are_enough(seeds):
    n_found = 0
    for fit, setup, seed in open_fits(seeds, 15):
        if fit.verdict.status == "ok":
            continue
        found = re.fullmatch(
            r"So few images do not determine the errors between them: errors of positions of about "
            r"([\d.]+) mm do not show in the residuals. Take at least (\d+) different images.",
            fit.verdict.reasons[0],
        )
        assert found is not None, fit.verdict.reasons
        assert float(found[1]) == pytest.approx(1e3 * fit.position_std, rel=0.1)
        more = dh.calibrate(setup.nominal, uneven_setup(seed, int(found[2])).images, session="off")
        assert more.verdict.status == "ok"
        assert true_error(more, setup.truth) < 1.5 * more.comparisons[0].after.groups["board"].rms
        n_found += 1
    assert n_found


def densely_integrated(fit: Fit, scatters: np.ndarray) -> tuple[float, float, float]:
    """Return RMS and quantile of the scatter, and the logarithm of the likelihood of its best value over 0.

    They follow from the covariance matrix of all image coordinates.
    """
    (images,), x, weights = fit.data, fit.solution.x, fit.problem.prior_weights
    chain = fit.problem.chain(x)
    frames = chain.forward_kinematics(images.q)
    linearization = fit.problem.linearize(x)
    rows = np.concatenate([linearization.rows(chunk) for chunk in fit.problem.chunks], 2)
    j, r = rows[:-1].reshape(len(x), -1).T, rows[-1].ravel()
    by_tool = images.displacement_derivative(frames, fit.problem.instrument_values_of(images, x))
    by_joints = by_tool @ chain.joint_jacobian(frames).transpose(2, 1, 0) / images.sigma[:, :, None]
    is_same = np.all(images.q[:, None] == images.q[None], 2)
    products = np.einsum("aik,bjk->iajb", by_joints, by_joints) * is_same[None, :, None, :]
    unit = products.reshape(len(r), len(r))
    logs = []
    for scatter in scatters:
        inverse = np.linalg.inv(np.eye(len(r)) + scatter**2 * unit)
        information = j.T @ inverse @ j + np.diag(weights**2)
        gradient = j.T @ inverse @ r - weights**2 * x
        cost = (
            r @ inverse @ r + np.sum((weights * x) ** 2) - gradient @ np.linalg.solve(information, gradient)
        )
        logs.append(np.linalg.slogdet(inverse)[1] / 2 - np.linalg.slogdet(information)[1] / 2 - cost / 2)
    density = np.exp(np.array(logs) - max(logs))
    cumulated = cumulative_trapezoid(density, scatters, initial=0)
    square = np.trapezoid(density * scatters**2, scatters) / cumulated[-1]
    largest = np.interp(CONFIDENCE * cumulated[-1], cumulated, scatters)
    return np.sqrt(square), largest, max(logs) - logs[0]


def test_the_scatter_is_that_of_the_restricted_likelihood():
    fit = placement_fit(1e-3, 6, 0)
    found = estimate_scatter(_scattered(fit, 0.2, 1e-3).problem, fit.solution.x)
    data = tuple(item.with_scaled_sigma({"pixels": 0.2}) for item in fit.data)
    plain = replace(fit.with_sigmas(data), data=data)
    scatters = np.append(0, np.geomspace(1e-6, 1e-2, 400))
    *expected, log_ratio = densely_integrated(plain, scatters)
    assert (found.expected, found.largest) == pytest.approx(expected, rel=0.01)
    assert found.log_likelihood_ratio == pytest.approx(log_ratio, abs=1e-3)


def test_images_of_even_joints_exclude_more_the_more_they_are():
    largest = []
    for n_images in (10, 40):
        fit = placement_fit(1e-3, n_images, 0)
        unit = _scattered(fit, 0.2, 1e-3)
        largest.append(estimate_scatter(unit.problem, fit.solution.x).largest)
    assert largest[1] < largest[0] / 2
    assert largest[1] < 2e-5
