"""Calibrations with two measurement kinds at once, for all pairs of `KINDS`."""

import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from camera_setups import ARMS, simulate, tracked_setup, wrong_arm
from scipy.stats import chi2, norm
from slow_cases import some_slow

from dhcal_pin import read_robot
from dhcal_pin.calibration import calibrate
from dhcal_pin.calibration.cameras import jitter, procedure
from dhcal_pin.calibration.cameras.jitter import (
    Jitter,
    _log_likelihood,
    _maximize_likelihood,
    _scatter,
    estimate_jitter,
)
from dhcal_pin.estimation import select_parameters
from dhcal_pin.estimation.initialization import align, make_problem, subsample
from dhcal_pin.exceptions import ConvergenceError, InvalidArgumentError, NotObservableError
from dhcal_pin.measurements import KINDS, CameraCorners, Noise, mount_rig
from dhcal_pin.measurements.camera import simulated_rig
from dhcal_pin.report import write_report
from dhcal_pin.se3 import exp6

pytestmark = pytest.mark.usefixtures("uneventful", "untried", "ordered_axes")

# Known distances between points need contacts with these points: see `test_kinds`.
PAIRS = list(combinations([name for name in KINDS if name != "point_distance"], 2))
FAST = [PAIRS.index(pair) for pair in (("position", "camera"), ("wires", "plane"), ("position", "plane"))]


def placed(chain):
    """Return the robot in a measuring frame of its own, with a target beside its flange."""
    return chain.with_base_and_tool(
        exp6(np.array([2.0, 1, 0.3, 0.3, 0.2, 1])), exp6(np.array([0.05, 0.02, 0.1, 0.3, 0.1, 0.2]))
    )


def small_errors(chain, rng):
    """Return a robot with errors of about 1 mm and 3 mrad."""
    errors = select_parameters(chain, "dh")
    std = np.array([1e-3 if p.unit == "m" else 3e-3 for p in errors.parameters])
    return errors.at(std * rng.standard_normal(len(std)))


@pytest.mark.parametrize(("first", "second"), some_slow(PAIRS, FAST))
def test_two_kinds_predict_what_they_did_not_see(first, second, sim_6dof):
    """Held-out samples of both kinds are predicted up to the noise, whatever the other kind is."""
    rng = np.random.default_rng(PAIRS.index((first, second)))
    truth = placed(small_errors(sim_6dof, rng))
    noise = Noise(1e-4, 1e-4)
    draw = lambda: rng.uniform(-2.5, 2.5, (40, 6))  # noqa: E731
    data = [KINDS[kind].simulate(truth, draw(), noise, rng) for kind in (first, second)]
    fitted, left_out = [], []
    for item in data:
        is_fitted = item.sample_groups % 4 < 3
        fitted.append(item.take(is_fitted))
        left_out.append(item.take(~is_fitted))
    parameters = None if "camera" in (first, second) else "dh,base,tool"
    result = calibrate(sim_6dof, fitted, parameters, extend="none")
    assert result.converged
    for item, weights in zip(left_out, result.weights, strict=True):
        assert np.mean(weights > 0.5) > 0.9, item.kind
        found = result.validate(item)
        for key in ("position_rms_m", "orientation_rms_rad", "residual_rms"):
            assert found.get(key, 0.0) < (0.5 if found.get("unit") == "px" else 1e-3), (item.kind, key)


def test_images_that_turn_about_one_axis_only_use_the_poses_of_another_file(sim_6dof):
    """The first joint alone does not determine camera and board; images of all joints beside it do."""
    rng = np.random.default_rng(5)
    truth = small_errors(sim_6dof, rng)
    q = rng.uniform(-2.5, 2.5, (90, 6))
    q[:30, 1:] = q[0, 1:]
    images = KINDS["camera"].simulate(truth, q, Noise(1e-4), rng)
    assert images.rig is not None
    poses = tuple(replace(board, pose=None) for board in images.rig.boards)
    images = images.with_rig(replace(images.rig, boards=poses))
    number = np.repeat(np.arange(90), 6)
    one_axis, other, left_out = (images.take(number // 30 == i) for i in range(3))
    with pytest.raises(NotObservableError, match="one axis only"):
        calibrate(sim_6dof, one_axis)
    result = calibrate(sim_6dof, [one_axis, other])
    assert result.verdict.status == "ok"
    assert result.validate(left_out)["residual_rms"] < 0.3


def test_images_that_turn_about_one_axis_only_use_stated_poses(sim_6dof):
    rng = np.random.default_rng(6)
    q = rng.uniform(-2.5, 2.5, (30, 6))
    q[:, 1:] = q[0, 1:]
    images = KINDS["camera"].simulate(sim_6dof, q, Noise(1e-4), rng)
    assert images.rig is not None
    cameras = mount_rig(simulated_rig(sim_6dof, q), sim_6dof).cameras
    assert images.rig is not None
    boards = tuple(replace(board, pose=None) for board in images.rig.boards)
    rig = replace(images.rig, cameras=cameras, boards=boards)
    names = [cameras[i].name for i in images.camera]
    images = CameraCorners(images.q, images.values, images.corner, rig, names, None, images.sigma)
    result = calibrate(sim_6dof, images, "camera,board")
    assert result.converged
    assert result.comparisons[-1].after["residual_rms"] < 0.3


@pytest.fixture(scope="module")
def of_one_camera():
    """An arm, images of one board by one camera, and the calibration with them."""
    rng, chain = np.random.default_rng(7), ARMS["paper"]()
    images = simulate(chain, small_errors(chain, rng), rng, is_on_wrist=True, n_images=20, sigma=0.2).images
    return chain, images, calibrate(chain, images)


@pytest.mark.parametrize("has_pose", [False, True])
def test_cameras_and_boards_that_no_image_shows_change_nothing(has_pose, of_one_camera):
    chain, images, expected = of_one_camera
    rig = images.rig
    place = exp6(np.full(6, 0.3)) if has_pose else None
    spare = [replace(entry, name="spare", pose=place) for entry in (rig.cameras[0], rig.boards[0])]
    more = replace(
        rig,
        cameras=(spare[0], *rig.cameras),
        boards=(*rig.boards, spare[1]),
        camera_mounts=(rig.camera_mounts[0], *rig.camera_mounts),
        board_mounts=(*rig.board_mounts, rig.board_mounts[0]),
    )
    of_camera, of_board = [rig.cameras[0].name] * len(images.q), [rig.boards[0].name] * len(images.q)
    parts = images.q, images.values, images.corner, more, of_camera, of_board
    found = calibrate(chain, CameraCorners(*parts))
    assert found.verdict == expected.verdict
    assert found.hand_eye_std == pytest.approx(expected.hand_eye_std)
    for name, value in expected.instruments.items():
        assert found.instruments[name] == pytest.approx(value, abs=1e-6)
    assert found.rig is not None
    assert [entry.name for entry in (*found.rig.cameras, *found.rig.boards)] == [
        entry.name for entry in (*rig.cameras, *rig.boards)
    ]


@pytest.mark.slow
def test_a_wrong_sign_of_positions_is_named_beside_images(tmp_path):
    """The images do not fit the robot of these positions, so that no pose of the camera is known."""
    rng = np.random.default_rng(8)
    chain = ARMS["paper"]()
    truth = small_errors(chain, rng)
    images = simulate(chain, truth, rng, is_on_wrist=True, n_images=8, sigma=0.2).images
    positions = KINDS["position"].simulate(truth, rng.uniform(-1.5, 1.5, (30, 6)), Noise(5e-5), rng)
    q = positions.q * np.where(np.arange(6) == 2, -1, 1)
    fit = calibrate(chain, [positions.replace(q=q), images], session="off")
    assert fit.verdict.status == "refused"
    assert "sign of joint joint_3 is wrong" in fit.verdict.reasons[0]
    write_report(fit, tmp_path / "report.html")


def images_and_positions(seed, is_on_wrist):
    """Return a UR10, images and positions of one with errors, and exact positions to test with."""
    rng, chain = np.random.default_rng(seed), ARMS["ur10"]()
    truth = wrong_arm(chain, 1e-3, rng)
    images = simulate(chain, truth, rng, is_on_wrist=is_on_wrist, n_images=20, sigma=0.2).images
    truth = placed(truth)
    positions, exact = (
        KINDS["position"].simulate(truth, rng.uniform(-2, 2, (m, 6)), Noise(sigma), rng)
        for m, sigma in ((40, 5e-5), (200, 0.0))
    )
    return chain, images, positions, exact


def other_zero(images):
    """Return images with another zero of the third joint."""
    return images.replace(q=images.q + np.deg2rad([0, 0, 1.0, 0, 0, 0]))


CASES = [
    (0, False, lambda p, i: (p, i), "ok"),
    (1, True, lambda p, i: (p.replace(values=1.03 * p.positions()), i), "caution"),
    (2, False, lambda p, i: (p, other_zero(i)), "caution"),
    (3, True, lambda p, i: (p, i), "ok"),
    (4, False, lambda p, i: (p.replace(values=1.03 * p.positions()), i), "caution"),
    (5, True, lambda p, i: (p, other_zero(i)), "caution"),
]


@pytest.mark.parametrize(("seed", "is_on_wrist", "change", "status"), some_slow(CASES, {0, 1}))
def test_images_that_contradict_positions_need_caution(seed, is_on_wrist, change, status):
    chain, images, positions, exact = images_and_positions(seed, is_on_wrist)
    changed = change(positions, images)
    fit = calibrate(chain, changed)
    assert fit.verdict.status == status
    if status == "ok":
        assert fit.validate(exact)["position_rms_m"] < 1e-4
        return
    if changed[0] is not positions:
        assert fit.session is not None
        (scale,) = fit.session.scales
        assert scale.factor == pytest.approx(1.03, abs=3e-3)
        return
    assert any("contradict" in text or "Likely cause" in text for text in fit.verdict.reasons)


def images_by_two_located_cameras(truth, noise, rng, turn):
    """Return images of a UR10 whose tool turns by up to ± an angle; the rig states the cameras' poses."""
    pan, lift, elbow = rng.uniform([-0.5, -1.8, 1.2], [0.5, -1.2, 2.2], (25, 3)).T
    down = np.full(25, -np.pi / 2)
    q = np.stack([pan, lift, elbow, down - lift - elbow, down, pan], 1)
    q[:, 3:] += turn * rng.uniform(-1, 1, (25, 3))
    images = KINDS["camera"].simulate(truth, q, noise, rng)
    assert images.rig is not None
    cameras = mount_rig(simulated_rig(truth, q), truth).cameras
    assert images.rig is not None
    boards = tuple(replace(board, pose=None) for board in images.rig.boards)
    rig = replace(images.rig, cameras=cameras, boards=boards)
    names = [cameras[i].name for i in images.camera]
    return CameraCorners(images.q, images.values, images.corner, rig, names, None, images.sigma)


@pytest.mark.parametrize("image_noise", [1e-4, 3e-3])
def test_positions_place_the_robot_for_images_that_keep_the_orientation_of_the_tool(image_noise):
    """Images of this noise show little of the arm; positions of a tracker show that it is wrong."""
    rng = np.random.default_rng(9)
    arm = read_robot("example:ur10", tip="tool0")
    truth = placed(small_errors(arm, rng))
    images = images_by_two_located_cameras(truth, Noise(image_noise), rng, 0.0)
    positions, left_out = (
        KINDS["position"].simulate(truth, rng.uniform(-2, 2, (60, 6)), Noise(5e-5), rng) for _ in range(2)
    )
    result = calibrate(arm, [positions, images], extend="none", session="off")
    assert result.validate(left_out)["position_rms_m"] < 1.4 * np.sqrt(3) * 5e-5
    assert result.validate(images)["residual_rms"] < 1.2 * np.sqrt(2) * 1e3 * image_noise
    # A shift of cameras and target together shows in no image.
    assert result.verdict.status == "caution"
    (reason,) = result.verdict.reasons
    assert reason.startswith("Too few rotations: ")
    assert result.hand_eye_std is not None
    assert result.hand_eye_std > 0.02
    assert camera_error(result, images) < 4 * result.hand_eye_std


@pytest.mark.parametrize("size", [0.0, 1e-4])
def test_many_positions_of_a_noisy_tracker_beside_images_correct_the_arm(size):
    """The arm is as good as with the positions alone; their noise is as large as the errors of the arm."""
    rng, arm = np.random.default_rng(21), ARMS["panda"]()
    truth = wrong_arm(arm, size, rng) if size else arm
    images = simulate(arm, truth, rng, is_on_wrist=True, n_images=20, sigma=0.5).images
    q = rng.uniform(np.maximum(arm.lower, -2.2), np.minimum(arm.upper, 2.2), (400, 7))
    positions = KINDS["position"].simulate(placed(truth), q, Noise(3e-4), rng)
    left_out = KINDS["position"].simulate(placed(truth), q, Noise(), rng)
    mixed, alone = (
        calibrate(arm, data, extend="none", session="off") for data in ([positions, images], positions)
    )
    if size:
        errors = [fit.validate(left_out)["position_rms_m"] for fit in (mixed, alone)]
        assert errors[0] < 1.2 * errors[1]
        assert errors[0] < 0.4 * positions_error(arm, left_out)
    assert mixed.camera_stages[-1].is_kept == bool(size)


def positions_error(arm, left_out):
    """Return the error of the nominal arm with fitted base and tool [m]."""
    fit = calibrate(arm, left_out, "base,tool", extend="none", session="off")
    return fit.validate(left_out)["position_rms_m"]


def camera_error(result, images):
    """Return the largest error of the position of a camera whose true pose the rig states [m]."""
    pairs = zip(result.rig.cameras, images.rig.cameras, strict=True)
    return max(float(np.linalg.norm((found.pose - true.pose)[:3, 3])) for found, true in pairs)


def test_images_of_a_tool_that_turns_determine_the_cameras_beside_a_tracker():
    """This follows the advice where the tool keeps its orientation."""
    rng = np.random.default_rng(9)
    arm = read_robot("example:ur10", tip="tool0")
    truth = placed(small_errors(arm, rng))
    positions = KINDS["position"].simulate(truth, rng.uniform(-2, 2, (60, 6)), Noise(5e-5), rng)
    images = images_by_two_located_cameras(truth, Noise(1e-4), rng, 0.8)
    result = calibrate(arm, [positions, images], extend="none", session="off")
    assert result.verdict.status == "ok"
    assert result.hand_eye_std is not None
    assert result.hand_eye_std < 1e-3
    assert camera_error(result, images) < 4 * result.hand_eye_std


@pytest.mark.parametrize("has_tracker", [False, True])
def test_stated_poses_are_held_where_the_tool_keeps_its_orientation(has_tracker):
    """The option that the verdict names determines cameras, board and arm."""
    rng = np.random.default_rng(9)
    arm = read_robot("example:ur10", tip="tool0")
    truth = placed(small_errors(arm, rng)) if has_tracker else small_errors(arm, rng)
    images = images_by_two_located_cameras(truth, Noise(1e-4), rng, 0.0)
    positions = KINDS["position"].simulate(truth, rng.uniform(-2, 2, (60, 6)), Noise(5e-5), rng)
    data = [positions, images] if has_tracker else images
    fit = calibrate(arm, data, extend="none", session="off")
    (reason,) = (text for text in fit.verdict.reasons if text.startswith("Too few rotations: "))
    assert "The rig file states the pose of camera 'left': if it was measured to about 2 mm" in reason
    (sets,) = re.findall(r"hold it with --parameters (\S+)\.$", reason)
    held = calibrate(arm, data, sets, extend="none", session="off")
    assert camera_error(held, images) == 0
    assert camera_error(fit, images) > 0.02
    assert fit.hand_eye_std is not None
    assert (held.hand_eye_std or 0.0) < 0.1 * fit.hand_eye_std
    # Base and tool of the tracker are those of its own frame, and rotations of the tool are small.
    tips = [chain.poses(images.q)[:, :3, 3] for chain in (truth, held.chain, arm)]
    found, nominal = (align(tip, tips[0])[1] for tip in tips[1:])
    assert found < 0.2 * nominal


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), [("xarm7", 6211), ("panda", 3), ("ur10", 2)])
def test_wrong_arms_beside_a_tracker_converge_where_the_tool_keeps_its_orientation(name, seed):
    """The position of board and cameras is hardly known, and the rotation of the tool is not."""
    setup = tracked_setup(name, 1e-3, seed)
    result = calibrate(setup.nominal, setup.data)
    low, high = np.maximum(setup.nominal.lower, -2.2), np.minimum(setup.nominal.upper, 2.2)
    rng = np.random.default_rng(0)
    left_out = KINDS["position"].simulate(setup.truth, rng.uniform(low, high, (300, len(low))), Noise(), rng)
    assert result.converged
    (reason,) = result.verdict.reasons
    assert reason.startswith("Too few rotations: ")
    assert result.validate(left_out)["position_rms_m"] < 8e-5
    validation = result.generalization.cross_validated
    assert validation is not None
    assert validation.after.groups["pixels"].rms < 1.2 * np.sqrt(2) * 0.2


@pytest.mark.parametrize(
    ("sets", "missing"),
    [("camera,board", "base,tool"), ("minimal,camera,board", "base,tool"), ("base,camera,board", "tool")],
)
def test_base_and_tool_are_named_where_a_tracker_beside_images_needs_them(sim_6dof, sets, missing):
    """With the sets that the message names, the calibration works."""
    rng = np.random.default_rng(3)
    truth = placed(small_errors(sim_6dof, rng) if "minimal" in sets else sim_6dof)
    data = [
        KINDS[kind].simulate(truth, rng.uniform(-2.5, 2.5, (40, 6)), Noise(1e-4), rng)
        for kind in ("camera", "position")
    ]
    with pytest.raises(InvalidArgumentError, match=f"add {missing} to the parameters: ") as caught:
        calibrate(sim_6dof, data, sets, session="off")
    named = str(caught.value).rpartition(": ")[2]
    assert set(named.split(",")) == {*sets.split(","), *missing.split(",")}
    result = calibrate(sim_6dof, data, named, session="off", extend="none")
    assert result.comparisons[-1].after["position_rms_m"] < 1.1 * np.sqrt(3) * 1e-4


def test_poses_in_the_rig_that_are_far_from_the_true_ones_are_named():
    """The rig states the cameras in the measuring frame; without positions its place is not known."""
    rng = np.random.default_rng(9)
    arm = read_robot("example:ur10", tip="tool0")
    images = images_by_two_located_cameras(placed(small_errors(arm, rng)), Noise(1e-4), rng, 0.0)
    assert images.rig is not None
    boards = tuple(replace(board, pose=np.eye(4)) for board in images.rig.boards)
    cameras = tuple(replace(camera, intrinsics="free") for camera in images.rig.cameras)
    images = images.with_rig(replace(images.rig, cameras=cameras))
    stated = images.with_rig(replace(images.rig, cameras=cameras, boards=boards))
    with pytest.raises(ConvergenceError, match=r"check the poses .* or omit those of the cameras"):
        calibrate(arm, stated, extend="none", session="off")
    assert calibrate(arm, images, extend="none", session="off").converged


def test_whole_images_are_drawn_for_the_start(sim_6dof):
    """The frames are found from a part of the samples; single corners would not show where a board is."""
    rng = np.random.default_rng(10)
    images = KINDS["camera"].simulate(sim_6dof, rng.uniform(-2.5, 2.5, (150, 6)), Noise(1e-4), rng)
    drawn = subsample(images)
    assert drawn.n_images == 100
    assert len(drawn.rows) == 600


def test_images_without_weight_are_refused(sim_6dof, monkeypatch):
    """No result is made from the other measurements alone if the robust loss rejects all images."""
    rng = np.random.default_rng(7)
    positions, images = (
        KINDS[kind].simulate(sim_6dof, rng.uniform(-2.5, 2.5, (20, 6)), Noise(1e-4), rng)
        for kind in ("position", "camera")
    )
    rejected = (np.ones(len(positions.rows)), np.zeros(len(images.rows)))
    monkeypatch.setattr(procedure, "reweight", lambda fit, *_: replace(fit, weights=rejected))
    with pytest.raises(InvalidArgumentError, match=r"images: no image agrees .* base and tool"):
        calibrate(sim_6dof, [positions, images], session="off")


def test_displacements_are_as_large_as_those_of_which_the_fit_absorbed_a_half():
    rng, m = np.random.default_rng(11), 2000
    derivatives = 3e4 * rng.normal(size=(m, 12, 6))
    displacements = rng.normal(size=(m, 6)) * ([7e-4] * 3 + [3e-4] * 3) * (rng.random((m, 6)) < 0.5)
    residuals = np.einsum("mij,mj->mi", derivatives, displacements) + rng.normal(size=(m, 12))
    images = list(zip(residuals, derivatives, strict=True))
    found = _maximize_likelihood(images, 1.0, n_determined=3 * m)
    np.testing.assert_allclose([found.position, found.rotation], [7e-4, 3e-4], rtol=0.04)
    # What six displacements do not explain is the noise, 1 here; they explain all of three corners.
    assert _scatter(images) == pytest.approx(1, rel=0.02)
    assert _scatter([(residuals[0, :6], derivatives[0, :6])]) == 1.0


def test_chance_hardly_makes_images_show_a_displacement():
    """Twice the logarithm of the ratio of likelihoods has a chi-square distribution (Wilks)."""
    ratios = 0.5 * chi2.isf([0.05, 1e-4], 3)
    found = [Jitter(1.0, 0.0, 0.0, log_likelihood_ratio=ratio).is_significant for ratio in ratios]
    assert found == [False, True]


def test_likelihood_of_a_displacement_is_that_of_the_normal_distribution():
    rng = np.random.default_rng(8)
    residual, derivative = rng.normal(size=12), rng.normal(size=(12, 6))
    jitter = Jitter(1.0, 0.7, 0.3)
    scaled = derivative * ([0.7] * 3 + [0.3] * 3)

    def log_density(covariance: np.ndarray) -> float:
        log_determinant = np.linalg.slogdet(2 * np.pi * covariance)[1]
        return float(-(log_determinant + residual @ np.linalg.solve(covariance, residual)) / 2)

    with_it, without = (log_density(np.eye(12) + extra) for extra in (scaled @ scaled.T, 0))
    assert _log_likelihood([(residual, derivative)], jitter) == pytest.approx(with_it - without, rel=1e-12)
    huge = 1e12 * derivative[:, [0, 0, 1, 1, 2, 2]]
    assert np.isfinite(_log_likelihood([(residual, huge)], jitter))


@pytest.mark.parametrize("n_determined", [0.0, 20.0, 116.5])
def test_noise_of_images_without_a_displacement_fits_the_residuals_unless_it_is_stated(
    sim_6dof, n_determined, monkeypatch
):
    rng = np.random.default_rng(12)
    q = rng.uniform(-2.5, 2.5, (10, 6))
    images = KINDS["camera"].simulate(sim_6dof, q, Noise(1e-4), rng)
    images = images.with_rig(mount_rig(simulated_rig(sim_6dof, q), sim_6dof)).replace(sigma=images.sigma / 4)
    is_used = np.arange(len(images.rows)) != 7
    problem = make_problem(select_parameters(sim_6dof, "base"), (images,), np.ones(1), {})
    x = np.zeros(len(problem.errors.parameters) + len(problem.instrument_parameters))
    # The same noise, stated and estimated.
    stated, images = images.replace(sigma=2 * images.sigma), images.replace(has_stated_sigma=False)
    monkeypatch.setattr(jitter, "_scatter", lambda images: 2.0)
    given, found = (
        estimate_jitter(problem, x, [item], [is_used.astype(float)], n_determined)
        for item in (stated, images)
    )
    assert (given.noise, found.noise) == (1.0, 2.0)
    np.testing.assert_allclose([found.position, found.rotation], [given.position, given.rotation])
    frames = sim_6dof.forward_kinematics(images.conditions())
    residual = stated.residual(frames, problem.instrument_values_of(stated, x))[:, is_used]
    # Independent residuals of this sum of squares, as many as the fit leaves, with the noise that fits and 1.
    n_free = residual.size - n_determined
    size = np.sqrt(np.sum(residual**2) / n_free)
    gain = n_free * (norm.logpdf(size, scale=size) - norm.logpdf(size))
    assert gain > 1
    assert given.log_likelihood_ratio - found.log_likelihood_ratio == pytest.approx(gain, rel=1e-9)
    # A fit may determine as many parameters as there are rows.
    alone = estimate_jitter(problem, x, [images], [is_used.astype(float)], residual.size)
    assert np.isfinite(alone.log_likelihood_ratio)


def test_few_right_positions_beside_inclinations_are_not_called_outliers(sim_6dof):
    """Five of eight right positions do not fit the others."""
    rng, errors = np.random.default_rng(8), select_parameters(sim_6dof, "minimal")
    sizes = np.array([{"m": 1e-3, "rad": 5e-3}[parameter.unit] for parameter in errors.parameters])
    truth = errors.at(sizes * rng.standard_normal(len(sizes)))
    few = KINDS["position"].simulate(truth, rng.uniform(-2, 2, (8, 6)), Noise(5e-5), rng)
    many = KINDS["inclination"].simulate(truth, rng.uniform(-2, 2, (60, 6)), Noise(5e-5, 1e-4), rng)
    reasons = " ".join(calibrate(sim_6dof, [few, many]).verdict.reasons)
    assert "outliers" not in reasons
    assert (
        "So few samples do not show which are wrong, if any. Measure at least 12 different poses" in reasons
    )


def is_correction_applied(arm, seed):
    """Calibrate with few positions and many inclinations, of which four positions are held out."""
    rng, errors = np.random.default_rng(seed), select_parameters(arm, "minimal")
    sizes = np.array([{"m": 1e-3, "rad": 5e-3}[parameter.unit] for parameter in errors.parameters])
    truth = errors.at(sizes * rng.standard_normal(len(sizes)))
    few, held_out = (
        KINDS["position"].simulate(truth, rng.uniform(-2, 2, (n, 6)), Noise(1e-4), rng) for n in (12, 4)
    )
    many = KINDS["inclination"].simulate(truth, rng.uniform(-2, 2, (100, 6)), Noise(5e-5, 1e-4), rng)
    fit = calibrate(arm, [few, many], "minimal,base,tool", holdout=held_out)
    before, after = fit.comparisons[0].before, fit.comparisons[0].after
    assert after["position_rms_m"] < before["position_rms_m"] / 5
    return not fit.verdict.keeps_nominal


@pytest.mark.parametrize(
    ("seeds", "least"), [(range(2), 2), pytest.param(range(2, 22), 18, marks=pytest.mark.slow)]
)
def test_four_hold_out_positions_show_that_the_robot_is_better(sim_6dof, seeds, least):
    """The correction was kept in half of these cases only."""
    assert sum(is_correction_applied(sim_6dof, seed) for seed in seeds) >= least
