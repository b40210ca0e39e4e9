"""Simulated set-ups of cameras: they converge without a guess, and errors agree with their predictions."""

from dataclasses import replace

import camera_setups
import numpy as np
import pytest
from camera_setups import ARMS, polyhedron_setup, random_setup, simulate, wrong_arm
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin import select_parameters
from dhcal_pin.calibration.evaluation import compute_errors
from dhcal_pin.cameras import Board
from dhcal_pin.measurements import CameraCorners

pytestmark = pytest.mark.usefixtures("own_loss", "uneventful", "untried", "ordered_axes")


def image_rms(fit, data):
    """Return the RMS of the image coordinates under a calibration [px]."""
    return np.sqrt(np.mean(compute_errors(fit.chain, [data], fit.instruments)[0]["pixels"] ** 2))


def converges(seed):
    """Calibrate a set-up without a guess; the residuals are the noise.

    Arms that are wrong by 0.3 mm may be kept, as few images show that they are wrong. The residuals are then
    smaller than with the true cameras and boards on the nominal arm.
    """
    setup = random_setup(seed)
    fit = dh.calibrate(setup.nominal, setup.images, extend="none", loss="linear")
    limit = 1.1 * setup.sigma
    if not fit.camera_stages[-1].is_kept:
        true_values = {p.name: p.nominal for p in setup.exact.instrument_parameters}
        errors = compute_errors(setup.nominal, [setup.images], true_values)[0]["pixels"]
        limit = max(limit, np.sqrt(np.mean(errors**2)))
    assert fit.solution.converged
    assert image_rms(fit, setup.images) < limit


@pytest.mark.parametrize("seed", some_slow([0, 5, 8, 13, 18, 23], {2, 5}))
def test_setups_converge_without_a_guess(seed):
    converges(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(24, 200))
def test_all_setups_converge_without_a_guess(seed):
    converges(seed)


@pytest.mark.parametrize(("depth", "is_lens_known"), [(1e-3, False), (5e-3, True)])
def test_boards_of_points_near_a_plane_converge_without_a_guess(depth, is_lens_known, monkeypatch):
    """Points of a board with a depth of some millimetres, with and without focal lengths in the rig."""

    def board(rng, name, link):
        points = rng.uniform(-0.1, 0.1, (16, 3)) * [1, 1, 5 * depth]
        return Board(name, link, "points", listed_points=points)

    monkeypatch.setattr(camera_setups, "make_board", board)
    arm = ARMS["ur10"]()
    setup = simulate(arm, arm, np.random.default_rng(5), is_on_wrist=True, n_images=15, sigma=0.2)
    images, rig = setup.images, setup.images.rig
    if not is_lens_known:
        camera = replace(rig.cameras[0], values=np.array([np.nan] * 4 + [0.0] * 5))
        images = CameraCorners(images.q, images.values, images.corner, replace(rig, cameras=(camera,)))
    fit = dh.calibrate(arm, images, "camera,board,intrinsics", loss="linear")
    assert image_rms(fit, images) < 1.1 * setup.sigma


@pytest.mark.parametrize("seed", some_slow(range(21), {3}))
def test_small_boards_of_wrong_points_converge(seed, monkeypatch):
    """Eight points of a small board, flat or not, that are 1 to 3 mm from where the rig states them."""
    error, depth = (1e-3, 2e-3, 3e-3)[seed // 2 % 3], (0.8, 0.1, 0.0)[seed % 3]

    def board(rng, name, link):
        points = rng.uniform(-0.06, 0.06, (8, 3)) * [1, 1, depth]
        return Board(name, link, "points", listed_points=points)

    monkeypatch.setattr(camera_setups, "make_board", board)
    rng, arm = np.random.default_rng(6000 + seed), list(ARMS.values())[seed % 4]()
    truth = wrong_arm(arm, (0.0, 3e-3)[seed // 6 % 2], rng)
    n_images = int(rng.integers(12, 30))
    is_on_wrist = seed // 4 % 2 == 0
    setup = simulate(arm, truth, rng, is_on_wrist=is_on_wrist, n_images=n_images, sigma=0.2, spread=0.35)
    exact = setup.images.rig.boards[0]
    points = exact.points + error * rng.standard_normal(exact.points.shape)
    stated = replace(exact, listed_points=points, has_free_points=True)
    rig = replace(setup.images.rig, boards=(stated,))
    images = CameraCorners(setup.images.q, setup.images.values, setup.images.corner, rig)
    fit = dh.calibrate(arm, images, extend="none", loss="linear")
    assert fit.solution.converged
    assert image_rms(fit, images) < 1.1 * setup.sigma


@pytest.mark.parametrize("seed", some_slow([50, 76, *range(30)], {1}))
def test_strong_distortion_without_focal_lengths_converges(seed, monkeypatch):
    true_lens = camera_setups.true_lens

    def distorted(rng, model, aspect):
        lens = true_lens(rng, model, aspect)
        lens[4:6] = rng.uniform(-0.33, -0.27), rng.uniform(0.05, 0.12)
        return lens

    monkeypatch.setattr(camera_setups, "true_lens", distorted)
    rng, arm = np.random.default_rng(4000 + seed), list(ARMS.values())[seed % 4]()
    n_images, n_cameras = int(rng.integers(12, 50)), 1 + seed // 2 % 2
    is_on_wrist = seed // 4 % 2 == 0
    setup = simulate(
        arm, arm, rng, is_on_wrist=is_on_wrist, n_images=n_images, sigma=0.2, n_cameras=n_cameras
    )
    images, rig = setup.images, setup.images.rig
    unknown = np.array([np.nan] * 4 + [0.0] * 5)
    cameras = tuple(replace(camera, values=unknown) for camera in rig.cameras)
    names = [f"camera{i}" for i in images.camera], [f"board{i}" for i in images.board]
    images = CameraCorners(images.q, images.values, images.corner, replace(rig, cameras=cameras), *names)
    fit = dh.calibrate(arm, images, "camera,board,intrinsics", loss="linear")
    assert fit.solution.converged
    assert image_rms(fit, images) < 1.1 * setup.sigma


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 8))])
def test_few_images_of_two_cameras_and_two_boards_converge(seed):
    """Images with many corners are more than the samples that the search for outliers draws."""
    rng, arm = np.random.default_rng(seed), ARMS["ur10"]()
    setup = simulate(arm, arm, rng, is_on_wrist=False, n_images=12, sigma=0.2, n_cameras=2, n_boards=2)
    fit = dh.calibrate(arm, setup.images)
    assert image_rms(fit, setup.images) < 1.1 * setup.sigma


@pytest.mark.parametrize(
    "seed", [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (0, 1, 2, *range(4, 12)))]
)
@pytest.mark.parametrize("point_error", [pytest.param(0.0, marks=pytest.mark.slow), 5e-4])
def test_few_visible_markers_of_a_small_body_far_from_the_cameras_converge(seed, point_error):
    """Few images show the six markers that a projection matrix needs, and hardly any perspective."""
    setup = polyhedron_setup(seed, point_error=point_error)
    fit = dh.calibrate(setup.nominal, setup.images, "camera,board,intrinsics", loss="linear")
    # Markers that are off by 0.5 mm are off by about 2 px.
    assert image_rms(fit, setup.images) < (1.1 * setup.sigma if not point_error else 2.5)


def true_values(setup, truth_errors, fit):
    """Return the true value of each parameter of a fit, in its order."""
    exact = setup.exact
    instruments = dict(zip((p.name for p in exact.instrument_parameters), exact_values(exact), strict=True))
    arm = dict(zip((p.name for p in fit.errors.parameters), truth_errors, strict=False))
    nominal = {p.name: p.nominal for p in fit.problem.instrument_parameters}
    return np.array(
        [arm[p.name] if p.name in arm else instruments[p.name] - nominal[p.name] for p in fit.parameters]
    )


def exact_values(item):
    """Return the true values of all instrument parameters."""
    return np.array([p.nominal for p in item.instrument_parameters])


def split_setup(seed, *, is_arm_free):
    """Simulate one or two cameras and boards; return set-up, errors, fitted samples and parameter sets."""
    rng = np.random.default_rng(1000 + seed)
    chain = list(ARMS.values())[seed % len(ARMS)]()
    errors = select_parameters(chain, "placement,offset")
    std = np.array([2e-3 if p.unit == "m" else 6e-3 for p in errors.parameters])
    x = std * rng.standard_normal(len(std)) if is_arm_free else np.zeros(len(std))
    truth = errors.at(x) if is_arm_free else chain
    setup = simulate(chain, truth, rng, is_on_wrist=seed // 4 % 2 == 0, n_images=60, sigma=0.2,
                     n_cameras=1 + seed // 2 % 2, n_boards=1 + seed % 2)  # fmt: skip
    labels = np.unique(setup.images.q, axis=0, return_inverse=True)[1].reshape(-1)
    sets = "placement,offset,camera,board,intrinsics" if is_arm_free else "camera,board,intrinsics"
    return setup, x, labels % 3 != 0, sets


@pytest.mark.parametrize(
    "seed", [pytest.param(seed, marks=pytest.mark.slow) for seed in (26, *range(32, 61))]
)
def test_wrong_arms_converge_without_a_guess(seed):
    """Two cameras with distortion see boards, most of which appear tilted the other way without it."""
    setup, _, is_fitted, sets = split_setup(seed, is_arm_free=True)
    images = setup.images.take(is_fitted)
    fit = dh.calibrate(setup.nominal, images, sets, extend="none", loss="linear")
    assert fit.solution.converged
    assert image_rms(fit, images) < 1.1 * setup.sigma


def statistics(seed, *, is_arm_free):
    """Calibrate two thirds of the images of a set-up.

    Returns:
        Errors of all parameters in standard deviations, squared errors of held-out image coordinates, and
        their predicted variances by the Cramér-Rao bound, averages in units of the noise.
    """
    setup, x, is_fitted, sets = split_setup(seed, is_arm_free=is_arm_free)
    fit = dh.calibrate(setup.nominal, setup.images.take(is_fitted), sets, extend="none", loss="linear")
    values = true_values(setup, x, fit)
    held_out = setup.images.take(~is_fitted)
    pixels = compute_errors(fit.chain, [held_out], fit.instruments)[0]["pixels"]
    own = held_out.with_values({p.name: p.nominal for p in fit.data[0].instrument_parameters})
    other = fit.problem.with_data([own])
    model = other.linearize(fit.x)
    rows = np.concatenate([model.rows(chunk)[:-1].copy() for chunk in other.chunks], 2)
    root = fit.solution.system.sqrt_covariance(fit.problem.weights)[0]
    # Whitened rows of the fit are in units of its noise; those of the other images have the sigma of 1 px.
    variance = np.sum(np.tensordot(root, rows, (0, 0)) ** 2, 0)
    return (fit.x - values) / fit.std, np.mean(pixels**2), setup.sigma**2 + np.mean(variance)


def check_statistics(seeds, coverage, *, is_arm_free):
    """Compare intervals of 95 % with the truth, and held-out images with the Cramér-Rao prediction."""
    scores, squares, predicted = zip(
        *(statistics(seed, is_arm_free=is_arm_free) for seed in seeds), strict=True
    )
    share = np.mean(np.abs(np.concatenate(scores)) < 1.96)
    assert coverage[0] < share < coverage[1]
    assert np.sqrt(np.mean(np.divide(squares, predicted))) == pytest.approx(1, abs=0.05)


def test_cameras_and_boards_are_as_uncertain_as_predicted():
    """The bounds are wide, as the parameters of a few set-ups are correlated."""
    check_statistics(range(3), (0.88, 1.0), is_arm_free=False)


@pytest.mark.slow
@pytest.mark.parametrize(("is_arm_free", "least"), [(False, 0.93), (True, 0.92)])
def test_intervals_cover_the_truth(is_arm_free, least):
    check_statistics(range(32), (least, 0.97), is_arm_free=is_arm_free)
