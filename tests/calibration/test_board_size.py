"""Wrong sizes of boards and exchanged links are found where the arm is estimated, too."""

from dataclasses import replace
from itertools import product

import camera_setups
import numpy as np
import pytest
from camera_setups import ARMS, placement_fit, simulate, wrong_arm
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin.calibration.cameras.board_size import BoardSize, _rms_correction, find_board_size
from dhcal_pin.calibration.cameras.causes import with_sizes
from dhcal_pin.calibration.model_selection import family_hint
from dhcal_pin.cameras import Board
from dhcal_pin.estimation.initialization import align
from dhcal_pin.estimation.problem import whitened_residuals
from dhcal_pin.measurements import CameraCorners

pytestmark = pytest.mark.usefixtures("own_loss", "uneventful", "untried", "ordered_axes")


def photograph(seed, error, is_on_wrist=True):
    """Simulate 40 images of an arm whose links are wrong by a size [m]."""
    rng, arm = np.random.default_rng(seed), list(ARMS.values())[seed % 3]()
    truth = wrong_arm(arm, error, rng)
    return arm, simulate(arm, truth, rng, is_on_wrist=is_on_wrist, n_images=40, sigma=0.1, spread=0.8).images


def with_rig(images, **changes):
    """Return images with another rig, whose poses are unknown."""
    rig = replace(images.rig, **changes)
    return CameraCorners(images.q, images.values, images.corner, rig)


@pytest.mark.parametrize(("seed", "size"), some_slow([(0, 1.1), (1, 0.97), (2, 0.98)], {1}))
def test_a_wrong_size_of_the_board_is_not_taken_for_errors_of_the_arm(seed, size):
    arm, images = photograph(seed, 1e-3)
    (board,) = images.rig.boards
    stated = replace(board, type="points", listed_points=size * board.points)
    fit = dh.calibrate(arm, with_rig(images, boards=(stated,)), loss="linear")
    assert fit.camera_stages[-1].is_kept
    assert fit.verdict.status == "refused"
    assert "size of the boards is probably wrong" in fit.verdict.reasons[0]
    assert fit.board_size is not None
    assert fit.board_size.wrong == {board.name: pytest.approx(1 / size, rel=5e-3)}


@pytest.mark.parametrize("seed", some_slow(range(8), {2}))
def test_a_wrong_size_of_one_of_two_boards_is_named(seed, monkeypatch):
    """Most corners of the wrong board, or of the right one, may be outliers of an arm that fits the other."""

    def board(rng, name, link):
        return Board(name, link, "checkerboard", columns=8, rows=6, square=0.03)

    monkeypatch.setattr(camera_setups, "make_board", board)
    rng, arm = np.random.default_rng(seed), ARMS["ur10"]()
    truth, is_on_wrist = wrong_arm(arm, 1e-3, rng), seed % 2 == 0
    images = simulate(arm, truth, rng, is_on_wrist=is_on_wrist, n_images=40, sigma=0.2, n_boards=2).images
    first, second = images.rig.boards
    second = replace(second, type="points", listed_points=1.03 * second.points)
    rig = replace(images.rig, boards=(first, second))
    names = [rig.boards[number].name for number in images.board]
    fit = dh.calibrate(arm, CameraCorners(images.q, images.values, images.corner, rig, board=names))
    assert fit.verdict.status != "ok"
    assert "board 'board1'" in fit.verdict.reasons[0]
    assert fit.board_size is not None
    assert fit.board_size.wrong == {"board1": pytest.approx(1 / 1.03, rel=3e-3)}


@pytest.mark.parametrize("seed", [21, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(20))])
def test_large_errors_of_the_arm_are_not_taken_for_a_wrong_size(seed):
    arm, images = photograph(seed, 6e-3, is_on_wrist=seed % 2 == 0)
    fit = dh.calibrate(arm, images, loss="linear")
    assert fit.camera_stages[-1].is_kept
    assert fit.board_size is None


def photograph_wrong_gear_ratio(seed, is_on_wrist=True):
    """Simulate a UR10 whose elbow turns by 1 % more than reported; return it, the truth and images."""
    rng, arm = np.random.default_rng(seed), ARMS["ur10"]()
    errors = dh.select_parameters(arm, "placement,gain")
    std = {"m": 5e-4, "rad": 1.5e-3, "1": 0.0}
    x = np.array([std[p.unit] * rng.standard_normal() for p in errors.parameters])
    x[[p.name for p in errors.parameters].index("elbow_joint.gain")] = 0.01
    home, truth = np.array([0.2, -1.3, 1.6, -1.9, -1.5, 0.3]), errors.at(x)
    setup = simulate(arm, truth, rng, is_on_wrist=is_on_wrist, n_images=40, sigma=0.15, spread=0.35,
                     intrinsics_error=0.01, home=home)  # fmt: skip
    return arm, truth, setup.images


def tool_error(arm, truth, images):
    """Return the RMS error [m] of a point 0.1 m in front of the flange where images were taken."""
    poses, true_poses = (each.poses(images.q) for each in (arm, truth))
    points, true_points = (each[:, :3, :3] @ [0, 0, 0.1] + each[:, :3, 3] for each in (poses, true_poses))
    return align(points, true_points)[1]


@pytest.mark.parametrize(("seed", "is_on_wrist"), some_slow(list(product(range(6), (True, False))), {6}))
def test_a_wrong_gear_ratio_is_not_taken_for_a_wrong_size(seed, is_on_wrist):
    """A board of 99 % of its size would shorten the arm by as much as the geometry imitates the gear."""
    arm, truth, images = photograph_wrong_gear_ratio(seed, is_on_wrist)
    nominal = tool_error(arm, truth, images)
    geometry = dh.calibrate(arm, images, extend="none", session="off")
    assert geometry.board_size is None
    hint = family_hint(geometry.problem, geometry.x, geometry.weights)
    assert "gear ratio errors" in hint
    assert "--extend auto" in hint
    fit = dh.calibrate(arm, images, extend="auto", session="off")
    assert fit.extension is not None
    assert "gain" in fit.extension.supported
    assert fit.board_size is None
    assert fit.verdict.status == "ok"
    error = tool_error(fit.chain, truth, images)
    assert error < 0.1 * nominal
    assert error < 0.5 * tool_error(geometry.chain, truth, images)


def test_a_wrong_size_is_named_beside_a_wrong_gear_ratio():
    arm, _, images = photograph_wrong_gear_ratio(3)
    (board,) = images.rig.boards
    stated = replace(board, type="points", listed_points=board.points / 0.99)
    fit = dh.calibrate(arm, with_rig(images, boards=(stated,)), session="off")
    assert fit.extension is not None
    assert "gain" in fit.extension.supported
    assert fit.verdict.status == "refused"
    assert fit.board_size is not None
    assert fit.board_size.wrong == {board.name: pytest.approx(0.99, abs=2e-3)}


@pytest.mark.slow
@pytest.mark.parametrize("is_on_wrist", [True, False])
def test_exchanged_links_are_named(is_on_wrist):
    """The rig states a camera on the wrist for a fixed one, or the other way round."""
    arm, images = photograph(0, 1e-3, is_on_wrist)
    images = images.take(images.image < 12)
    images = with_rig(images.with_rig(images.rig.with_exchanged_links()))
    fit = dh.calibrate(arm, images, loss="linear", max_iterations=20)
    assert fit.verdict.status == "refused"
    assert "Likely cause: the links" in fit.verdict.reasons[0]


@pytest.mark.parametrize(("size", "status"), [(1.0, "ok"), (1.005, "caution")])
def test_a_size_that_is_slightly_wrong_needs_caution(size, status):
    """A board 0.5 % too large lengthens a UR10 by 6 mm at full reach, which pixels do not show."""
    arm, images = photograph(3, 5e-4)
    (board,) = images.rig.boards
    stated = replace(board, type="points", listed_points=size * board.points)
    fit = dh.calibrate(arm, with_rig(images, boards=(stated,)), loss="linear")
    assert fit.camera_stages[-1].is_kept
    assert fit.verdict.status == status
    assert (fit.board_size is not None) == (status == "caution")
    # The estimated arm explains the images.
    assert fit.problem.temperature == 1
    if fit.board_size:
        assert "size of the boards may be wrong" in fit.verdict.reasons[0]
        assert fit.board_size.wrong == {board.name: pytest.approx(1 / size, rel=2e-3)}


@pytest.mark.parametrize(("log_ratio", "is_decisive"), [(6.0, False), (20.0, True)])
def test_strong_evidence_of_another_size_is_decisive(log_ratio, is_decisive):
    found = BoardSize({"board": 1.1}, {"board": 0.03}, 2.0, 0.3, log_ratio)
    assert found.is_decisive == is_decisive


def test_the_evidence_of_a_size_counts_the_lengths_that_images_determine_beside_default_priors():
    """The priors of the calibration are far wider. The rows are those of finite differences."""
    fit = placement_fit(5e-4, 20, 3, size=1.02)
    problem, x, n = fit.problem, fit.solution.x, len(fit.problem.errors.parameters)
    wide = problem.with_prior_weights(np.append(problem.weights[:n] / 100, problem.weights[n:]))
    found = find_board_size(replace(fit, problem=wide))
    assert found is not None
    assert list(found.wrong.values()) == [pytest.approx(1 / 1.02, abs=2e-3)]
    steps = 1e-6 * np.eye(len(x))
    residuals = [
        np.concatenate([np.ravel(each) for each in whitened_residuals(problem, x + sign * step)])
        for step in steps
        for sign in (1, -1)
    ]
    rows = (np.array(residuals[::2]) - residuals[1::2]) / 2e-6
    covariance = np.linalg.inv(rows @ rows.T + np.diag(problem.weights**2))
    lengths = [i for i, parameter in enumerate(problem.errors.parameters) if parameter.unit == "m"]
    count = np.sum(1 - np.diag(covariance)[lengths] * problem.weights[lengths] ** 2)
    assert found.log_ratio == pytest.approx(count * np.log(found.stated / found.found), rel=1e-3)


def test_an_arm_without_unknown_lengths_has_no_correction_of_lengths():
    errors = dh.select_parameters(ARMS["ur10"](), "offset")
    assert _rms_correction(errors, np.ones(len(errors.parameters))) == 0


def test_estimated_corners_have_the_size_of_their_board():
    arm, images = photograph(3, 5e-4)
    (board,) = images.rig.boards
    images = with_rig(images, boards=(replace(board, has_free_points=True),)).initialized(arm)
    larger = with_sizes({board.name: 1.1}, images)
    (points,) = larger.points(np.array([p.nominal for p in larger.instrument_parameters]))
    np.testing.assert_allclose(points, 1.1 * board.points, atol=1e-12)


def test_a_board_that_no_image_shows_needs_no_known_pose():
    """Images that show one of two calibrated boards were an error: its pose belongs to no measurement."""
    arm, images = photograph(0, 1e-3)
    (board,) = images.rig.boards
    rig = replace(images.rig, boards=(board, replace(board, name="other")))
    names = [board.name] * len(images.rows)
    shown = CameraCorners(images.q, images.values, images.corner, rig, board=names)
    known = {"board_other.x": 0.1, "board_other.rz": 0.2}
    fit = dh.calibrate(arm, shown, "base,tool", known=known)
    assert not any("other" in name for name in fit.instruments)
    alone = dh.calibrate(arm, images, "base,tool")
    assert fit.problem.cost(fit.x) == pytest.approx(alone.problem.cost(alone.x), rel=1e-9)
    with pytest.raises(dh.exceptions.UnknownNameError, match=r"board_none\.x"):
        dh.calibrate(arm, shown, "base,tool", known={"board_none.x": 0.1})
