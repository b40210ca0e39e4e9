"""Cameras and boards that move while photographs are taken."""

from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from camera_setups import ARMS, random_setup, simulate, tool_error, visible_corners, wrong_arm
from paper_arms import photograph as photograph_servo_arm
from scipy.spatial.transform import Rotation
from slow_cases import some_slow

from dhcal_pin import calibrate, read_robot, se3
from dhcal_pin.calibration.cameras import image_session
from dhcal_pin.calibration.cameras.arm_types import ARM_TYPES, INDUSTRIAL
from dhcal_pin.calibration.cameras.gate import Gate, open_fit
from dhcal_pin.calibration.cameras.image_session import find_image_session
from dhcal_pin.calibration.reweighting import Fit
from dhcal_pin.cameras import Rig
from dhcal_pin.estimation.parameters import LOW_COST, select_parameters
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.measurements import CameraCorners, Pose
from dhcal_pin.measurements.base import whitened_jacobian
from dhcal_pin.measurements.images import image_pose
from dhcal_pin.measurements.mounting import mount_rig
from dhcal_pin.session import Session
from dhcal_pin.session.causes import Block, Cause, Constant, Step
from dhcal_pin.session.robot_changes import Motion, RobotChanges
from dhcal_pin.session.timeline import order_samples

pytestmark = pytest.mark.usefixtures("untried", "ordered_axes")

NOISE = 0.3
NONE = np.empty(0)


def photograph(seed, is_on_wrist, is_fixed, motion, share=0.5, count=24, arm="ur10"):
    """Return a nominal arm, the true one and images between which a camera or a board moved."""
    rng = np.random.default_rng([seed, 77])
    nominal = ARMS[arm]()
    truth = wrong_arm(nominal, 1e-3, rng)
    setup = simulate(nominal, truth, rng, is_on_wrist=is_on_wrist, n_images=count, sigma=NOISE)
    rig = setup.exact.rig
    entries = "boards" if is_on_wrist == is_fixed else "cameras"
    (entry,) = getattr(rig, entries)
    moved = replace(rig, **{entries: (replace(entry, pose=entry.pose @ se3.exp6(motion)),)})
    q = setup.exact.q[np.sort(np.unique(setup.exact.image, return_index=True)[1])]
    first = int(share * len(q))
    parts = visible_corners(truth, rig, q[:first]), visible_corners(truth, moved, q[first:])
    rows, camera, board, corner, pixels = (
        np.concatenate(each) for each in zip(*parts[0], *parts[1], strict=True)
    )
    numbers = np.repeat(
        np.arange(len(parts[0]) + len(parts[1])), [len(each[0]) for each in (*parts[0], *parts[1])]
    )
    images = CameraCorners(
        rows,
        pixels + NOISE * rng.standard_normal(pixels.shape),
        corner,
        setup.images.rig,
        [f"camera{i}" for i in camera],
        [f"board{i}" for i in board],
        image_names=[f"{number}.png" for number in numbers],
    )
    return nominal, truth, images, len(parts[0])


def arm_error(chain, truth, images):
    """Return the RMS error of an arm near the photographed configurations [m], with fitted base and tool."""
    rng = np.random.default_rng(0)
    q = images.q[rng.integers(len(images.q), size=100)]
    q = np.clip(q + 0.1 * rng.standard_normal(q.shape), chain.lower, chain.upper)
    return tool_error(chain, truth, q)


MOTION = np.array([5e-3, 0, 0, 0, 5e-3, 0])
CASES = [(is_on_wrist, is_fixed, scale, share) for scale, share in product((1.0, 20.0), (0.5, 0.3, 0.7))
         for is_on_wrist in (True, False) for is_fixed in (True, False)]  # fmt: skip


@pytest.mark.parametrize(("is_on_wrist", "is_fixed", "scale", "share"), some_slow(CASES, {0, 3}))
def test_what_moved_is_named_and_handled(is_on_wrist, is_fixed, scale, share, request):
    is_slow = request.node.get_closest_marker("slow") is not None
    named, ratios = [], []
    for seed in range(5 if is_slow else 1):
        arm = list(ARMS)[seed % 3]
        photographed = photograph(seed, is_on_wrist, is_fixed, scale * MOTION, share, 24 + 6 * is_slow, arm)
        nominal, truth, images, first = photographed
        fit = calibrate(nominal, images)
        assert fit.session is not None
        of = "board" if is_on_wrist == is_fixed else "camera"
        named.append(
            [(e.kind, e.of, e.place) for e in fit.session.events]
            == [("base" if is_fixed else "tool", of, f"between {first - 1}.png and {first}.png")]
            and abs(fit.session.events[0].size / (scale * 5e-3) - 1) < 0.2
            and fit.session.events[0].std < scale * 3e-4
        )
        assert fit.verdict.status == "caution" or not named[-1]
        # The error without a motion, or at most a quarter of the nominal one.
        if is_slow:
            still = photograph(seed, is_on_wrist, is_fixed, 0 * MOTION, share, 30, arm)[2]
            limit = arm_error(calibrate(nominal, still).chain, truth, images)
        else:
            limit = 0.25 * arm_error(nominal, truth, images)
        ratios.append(arm_error(fit.chain, truth, images) / limit)
    assert np.mean(named) >= (0.8 if is_slow else 1.0)
    assert np.median(ratios) < (2.0 if is_slow else 1.0)


def test_a_motion_between_many_images_is_handled():
    """More images than the search for a start draws, each with its conditions."""
    nominal, truth, images, first = photograph(1, False, True, MOTION, count=60)
    fit = calibrate(nominal, images)
    assert fit.session is not None
    (event,) = fit.session.events
    assert (event.kind, event.of, event.place) == (
        "base",
        "camera",
        f"between {first - 1}.png and {first}.png",
    )
    assert event.size == pytest.approx(5e-3, rel=0.1)
    assert arm_error(fit.chain, truth, images) < 0.25 * arm_error(nominal, truth, images)


def test_changes_need_images_alone():
    nominal, _, images, _ = photograph(1, True, True, MOTION, count=10)

    def calibrated(_):
        raise AssertionError

    data = [images, Pose(images.q, nominal.poses(images.q))]
    assert find_image_session(nominal, data, (), calibrated, INDUSTRIAL) is None


def in_order(images, cameras):
    """Return images with those of each configuration in the order of these numbers of cameras."""
    visit = np.cumsum(np.any(np.diff(images.q, axis=0, prepend=images.q[:1]) != 0, 1))
    taken = images.take(np.lexsort([np.argsort(cameras)[images.camera], visit]))
    return taken.replace(rows=np.arange(len(taken.rows)))


@pytest.mark.parametrize("cameras", [(0,), (0, 1), (1, 0)])
def test_a_zero_that_changes_is_found(cameras):
    rng, nominal = np.random.default_rng(12), ARMS["ur10"]()
    truth = wrong_arm(nominal, 1e-3, rng)
    setup = simulate(nominal, truth, rng, is_on_wrist=False, n_images=40, sigma=0.2, n_cameras=len(cameras))
    images = in_order(setup.images, cameras)
    first = int(np.flatnonzero(np.any(np.diff(images.q, axis=0) != 0, 1))[19]) + 1
    size, q = np.deg2rad(1.0), images.q.copy()
    q[:first, 4] += size
    fit = calibrate(nominal, images.replace(q=q))
    assert fit.session is not None
    (event,) = fit.session.events
    assert (event.kind, event.of) == ("joint", nominal.joint_names[4])
    assert event.size == pytest.approx(size, rel=0.02)
    assert event.before.line <= first <= event.after.line
    assert arm_error(fit.chain, truth, images) < 0.4 * arm_error(nominal, truth, images)
    assert not any(mask.any() for mask in fit.outliers)


def test_a_motion_of_one_of_two_cameras_is_not_that_of_both():
    rng, nominal = np.random.default_rng(12), ARMS["ur10"]()
    images = simulate(nominal, nominal, rng, is_on_wrist=False, n_images=12, sigma=0.2, n_cameras=2).images
    twist = np.full(6, 1e-3)
    motion = Motion((5,), se3.exp6(np.array([twist, 0 * twist])))

    def found_of(kind, images):
        timeline = order_samples([images.image_poses()], ())
        changes = RobotChanges(motion, Motion()) if kind == "base" else RobotChanges(Motion(), motion)
        cause = Cause(Block(kind, "", np.arange(6), np.ones(6)), Step(5), twist, 1e-8 * np.eye(6))
        session = Session(timeline, nominal, True, changes, (cause,))
        result: Any = SimpleNamespace(chain=nominal, session=session)
        found = find_image_session(nominal, [images], (), lambda _: result, INDUSTRIAL)
        assert found is not None
        return [(event.kind, event.of) for event in found.events], found.changes.is_empty

    assert found_of("tool", images) == ([("tool", "board")], False)
    assert found_of("base", images) == ([], True)
    of_one = images.take(images.camera == images.camera[images.shown_poses[0][0]])
    assert found_of("base", of_one) == ([("base", "camera")], False)


@pytest.mark.parametrize("variance", [1e-2, 1.0, 1e2])
def test_images_are_evidence_relative_to_their_noise(monkeypatch, variance):
    """Twenty worse images are, four are not, and a wrong image counts no more than three of these."""
    monkeypatch.setattr(image_session, "_image_squares", lambda squares: variance * squares)
    explains_better: Any = image_session._explains_better
    for worse, is_evidence in (
        (np.full(20, 2.0), True),
        (np.full(4, 2.0), False),
        (np.r_[1e6, np.ones(19)], False),
        (np.r_[1e6, 2.0, np.ones(18)], False),
    ):
        assert explains_better(np.ones(len(worse)), worse) == is_evidence


def test_play_is_no_change_of_a_joint():
    """The play of a servo arm displaces images like a change of a joint zero, which is not looked for."""
    nominal, _, images, _ = photograph(1, True, True, 0 * MOTION)
    is_second_half = images.rows >= images.image_poses().rows[12]
    q = images.q + np.deg2rad([0, 0, 1, 0, 0, 0]) * is_second_half[:, None]
    calibrated = partial(calibrate, nominal, extend="none")
    found = [
        find_image_session(nominal, [images.replace(q=q)], (), calibrated, arm)
        for arm in (INDUSTRIAL, ARM_TYPES[LOW_COST])
    ]
    events = [[event.kind for event in each.events] for each in found if each]
    assert events == [["joint"], []]
    assert not any(each.changes.zeros for each in found[1:] if each)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [403, 539])
def test_clean_servo_arms_have_no_session(seed):
    shot = photograph_servo_arm(seed)
    fit = calibrate(shot.nominal, shot.images)
    assert not (fit.session and fit.session.sentences)


@pytest.mark.parametrize("is_on_wrist", some_slow([True, False], {1}))
def test_what_moved_is_named_from_poses_of_the_flange(is_on_wrist):
    nominal, _, images, first = photograph(1, is_on_wrist, True, MOTION)
    poses, flange = nominal.poses(images.q), read_robot("flange.urdf")
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX")
    rig = Rig(
        {each.name: each for each in images.rig.cameras}, {each.name: each for each in images.rig.boards}
    )
    names = list(images.image_names)
    q = np.concatenate([poses[:, :3, 3], angles], 1)
    shown = CameraCorners(q, images.values, images.corner, mount_rig(rig, flange), image_names=names)
    fit = calibrate(flange, shown.replace(has_joint_values=False))
    assert fit.session is not None
    (event,) = fit.session.events
    assert (event.of, event.place) == (
        "board" if is_on_wrist else "camera",
        f"between {first - 1}.png and {first}.png",
    )
    # The arm has errors of some millimetres that the poses of the flange do not show.
    assert event.size == pytest.approx(5e-3, rel=0.4)


@pytest.mark.parametrize("seeds", some_slow([range(40), range(1)], {1}))
def test_nothing_moved(seeds):
    for seed in seeds:
        setup = random_setup(seed)
        fit = calibrate(setup.nominal, setup.images)
        assert fit.session is not None
        assert not fit.session.found, seed
        # Noise alone is left, so that each image counts in full, unless a wrong arm is kept.
        state, gate = Fit(fit.data, fit.problem, fit.solution, fit.weights), Gate(0.1, 1.0, 20, False, False)
        is_arm_exact = seed // 8 % 3 == 0
        if is_arm_exact or any(stage.name == "arm" and stage.is_kept for stage in fit.camera_stages):
            assert open_fit(state, gate, 1)[1] == 1.0


def test_derivatives_of_poses_with_covariance():
    rng = np.random.default_rng(1)
    nominal = ARMS["ur10"]()
    setup = simulate(nominal, nominal, rng, is_on_wrist=True, n_images=8, sigma=NOISE)
    poses = setup.images.image_poses()
    base = poses.poses[0] @ se3.inverse(nominal.poses(poses.q[:1])[0])
    errors = select_parameters(nominal.with_base_and_tool(base, np.eye(4)), "minimal,base,tool")
    x = 0.01 * rng.standard_normal(len(errors.parameters))

    def residual(x):
        return poses.residual(errors.at(x).forward_kinematics(poses.conditions()), NONE).ravel()

    model = errors.derivative(x)
    frames = model[0].forward_kinematics(poses.conditions())
    rows = whitened_jacobian(poses, model, frames, NONE, poses.residual(frames, NONE)).reshape(len(x), -1)
    steps = 1e-6 * np.eye(len(x))
    expected = np.array([(residual(x + step) - residual(x - step)) / 2e-6 for step in steps])
    np.testing.assert_allclose(-rows, expected, atol=1e-8 * np.abs(rows).max())


def test_covariances_of_poses_agree_with_their_scatter(monkeypatch):
    monkeypatch.setattr(image_pose, "ARM_STD", (1e-6, 1e-6))
    rng = np.random.default_rng(2)
    nominal = ARMS["ur10"]()
    exact = simulate(nominal, nominal, rng, is_on_wrist=True, n_images=4, sigma=NOISE).exact
    cameras = tuple(replace(camera, intrinsics="fixed") for camera in exact.rig.cameras)
    exact = exact.with_rig(replace(exact.rig, cameras=cameras))
    truth, scaled = exact.image_poses().poses, []
    for _ in range(30):
        noisy = exact.replace(values=exact.values + NOISE * rng.standard_normal(exact.values.shape))
        found = noisy.image_poses()
        turned = found.poses[:, :3, :3] @ truth[:, :3, :3].swapaxes(1, 2)
        errors = np.concatenate([found.poses[:, :3, 3] - truth[:, :3, 3], se3.log3(turned)], 1)
        scaled.append(np.einsum("mij,mj->mi", found.roots, errors))
    spread = np.std(scaled, (0, 1))
    assert np.all((spread > 0.8) & (spread < 1.2)), spread


@pytest.mark.parametrize("n_corners", [6, 54])
def test_poses_state_their_noise_and_some_of_the_errors_of_the_lens(n_corners):
    """The lens is right here, so that the errors are smaller than those that are stated."""
    rng, nominal = np.random.default_rng(3), ARMS["ur10"]()
    exact = simulate(nominal, nominal, rng, is_on_wrist=True, n_images=6, sigma=NOISE).exact
    exact = exact.take(np.concatenate([np.flatnonzero(exact.image == i)[:n_corners] for i in range(6)]))
    cameras = tuple(replace(camera, intrinsics="fixed") for camera in exact.rig.cameras)
    exact = exact.with_rig(replace(exact.rig, cameras=cameras))
    truth = exact.tool_poses()
    assert truth.sigma == pytest.approx(2.5 * image_pose.ARM_STD[0], rel=1e-2)
    found = exact.replace(values=exact.values + NOISE * rng.standard_normal(exact.values.shape)).tool_poses()
    turns = se3.log3(found.poses[:, :3, :3] @ truth.poses[:, :3, :3].swapaxes(1, 2))
    for error, sigma in (
        (found.positions() - truth.positions(), found.sigma),
        (turns, found.rotation_sigma),
    ):
        assert np.sqrt(np.mean((error / sigma) ** 2)) < 0.8
    assert found.has_stated_sigma


@dataclass(frozen=True)
class Fitted:
    """Stand-in of a fit of some measurements."""

    data: tuple[str, ...]
    problem: Any = None
    solution: Any = None


@pytest.mark.parametrize(
    ("is_empty", "failing", "has_two_robots", "is_better", "fitted", "holdout", "has_changes"),
    [
        (True, (), False, True, "read", "held", None),
        (False, (), False, True, "refined", "refined held", True),
        (False, (), False, False, "read", "held", False),
        (False, (), True, False, "refined", "refined held", True),
        (False, ("found",), False, True, "read", "held", False),
        (False, ("refined",), False, True, "read", "held", False),
        (False, ("read",), False, False, "refined", "refined held", True),
    ],
)
def test_changes_are_kept_if_images_fit_better_with_them(
    monkeypatch, is_empty, failing, has_two_robots, is_better, fitted, holdout, has_changes
):
    def session(name: str) -> Any:
        changes = SimpleNamespace(is_empty=is_empty)
        applied = (name,), (f"{name} held",)
        return SimpleNamespace(
            name=name, changes=changes, has_two_robots=has_two_robots, applied=lambda *_: applied
        )

    def start(data: Any) -> Any:
        if data[0] in failing:
            raise DhcalError("no fit")
        return Fitted(data, Fitted(data), SimpleNamespace(x=None))

    found = session("found")
    monkeypatch.setattr(image_session, "find_image_session", lambda *_: found)
    monkeypatch.setattr(image_session, "refine_changes", lambda *_: session("refined"))
    monkeypatch.setattr(image_session, "without_changes", lambda each: f"{each.name} without changes")
    monkeypatch.setattr(image_session, "_explains_better", lambda *_: is_better)
    fit_session: Any = image_session.fit_image_session
    result = fit_session(None, ("read",), ("held",), None, start, INDUSTRIAL)
    assert result.fit.data == (fitted,)
    assert result.holdout == (holdout,)
    if has_changes is None:
        assert result.session is found
    else:
        assert isinstance(result.session, str) != has_changes


def test_the_square_of_an_image_is_the_mean_of_its_coordinates(monkeypatch):
    images = photograph(1, True, True, MOTION, count=6)[2]
    residuals = np.random.default_rng(0).normal(size=(2, len(images.rows)))
    monkeypatch.setattr(image_session, "residuals_of", lambda _: [residuals])
    fit: Any = SimpleNamespace(data=(images,))
    found = image_session._image_squares(fit)
    expected = [np.mean(residuals[:, images.sample_groups == k] ** 2) for k in range(6)]
    np.testing.assert_allclose(found, expected)


def test_corners_have_the_number_of_their_image_among_those_with_a_pose():
    """The first and the fourth image in the order of the rows show no pose."""
    images = photograph(1, True, True, MOTION, count=6)[2]
    order = np.argsort(images.rows)
    number = np.zeros(len(order), int)
    number[order] = np.cumsum(np.r_[0, np.diff(images.image[order]) != 0])
    poses = images.image_poses()
    shown = poses.take(~np.isin(np.argsort(np.argsort(poses.rows)), (0, 3)))
    expected = np.array([0, 0, 1, 1, 2, 3])[number]
    found = image_session._timeline_of_images([images], (), [shown], "row")
    np.testing.assert_array_equal(found.numbers[0], expected)
    np.testing.assert_array_equal(found.times[0], expected)
    assert found.unit == "image"
    in_seconds = image_session._timeline_of_images([images], (), [shown], "s")
    assert in_seconds.unit != "image"
    np.testing.assert_array_equal(in_seconds.numbers[0], expected)


def test_a_motion_of_the_tool_is_that_of_another_tool_pose():
    """A twist ξ at one frame is M·ξ·M⁻¹ at another one, with the same displacement."""
    rng = np.random.default_rng(3)
    tool, twist = se3.exp6(rng.normal(0, 0.5, 6)), rng.normal(0, 1, 6)
    covariance = np.diag(rng.uniform(1, 2, 6))
    cause = Cause(Block("tool", "", np.arange(6), np.ones(6)), Constant(), twist, covariance)
    found = image_session._carried_cause(cause, tool)
    size = 1e-6
    expected = tool @ se3.exp6(size * twist) @ se3.inverse(tool)
    np.testing.assert_allclose(se3.exp6(size * found.values), expected, atol=1e-11)
    each = [image_session._carried_cause(replace(cause, values=axis), tool).values for axis in np.eye(6)]
    np.testing.assert_allclose(found.covariance, np.transpose(each) @ covariance @ np.array(each))
    two = replace(cause, values=np.tile(twist, 2), covariance=np.eye(12))
    np.testing.assert_allclose(image_session._carried_cause(two, tool).values, np.tile(found.values, 2))
    of_base = replace(cause, block=replace(cause.block, kind="base"))
    assert image_session._carried_cause(of_base, tool) is of_base


@pytest.mark.parametrize("is_on_wrist", [True, False])
def test_changes_of_poses_are_those_of_camera_and_board(is_on_wrist):
    """Images calibrate the arm with a base and a tool of their own; constant causes are left out."""
    nominal, _, images, _ = photograph(1, is_on_wrist, True, 0 * MOTION, count=10)
    base, tool = (
        se3.exp6(np.array(each)) for each in ([0.3, -0.2, 0.1, 0.2, 0.1, 0.4], [0.1, 0, 0.2, 0, 0.5, 0])
    )
    posed = nominal.with_base_and_tool(base, nominal.tool @ tool)
    block = Block("base", "", np.arange(6), np.ones(6))
    step, covariance = Step(5), np.eye(6)
    kinds: list[tuple[Any, bool]] = [("base", False), ("tool", False), ("joint", False), ("lag", True)]
    causes = tuple(
        Cause(replace(block, kind=kind, is_of_recording=is_of_recording), step, np.full(6, 1e-3), covariance)
        for kind, is_of_recording in kinds
    )
    pose = images.image_poses()
    session = Session(order_samples([pose], ()), posed, True, causes=causes)
    result: Any = SimpleNamespace(session=session, chain=posed)
    for arm, expected in ((INDUSTRIAL, ["base", "tool", "joint"]), (ARM_TYPES[LOW_COST], ["base", "tool"])):
        found = find_image_session(nominal, [images], (), lambda _: result, arm)
        assert found is not None
        assert [cause.block.kind for cause in found.causes] == expected
        fixed, moving = (cause.block for cause in found.causes[:2])
        assert (fixed.of, moving.of) == (("board", "camera") if is_on_wrist else ("camera", "board"))
        # The origins are those of the frame of the board in the one of the camera, or the other way round.
        np.testing.assert_allclose(fixed.origin, np.linalg.inv(base)[:3, 3])
        np.testing.assert_allclose(moving.origin, tool[:3, 3], atol=1e-12)
        np.testing.assert_allclose(found.causes[1].values, se3.adjoint(tool) @ causes[1].values)
        assert found.chain is nominal
        assert found.timeline.unit == "image"
    nothing: Any = SimpleNamespace(session=None)
    assert find_image_session(nominal, [images], (), lambda _: nothing, INDUSTRIAL) is None

    def failing(_):
        raise DhcalError("too few images")

    assert find_image_session(nominal, [images], (), failing, INDUSTRIAL) is None
