"""Corners files with poses of the tip in place of joint values."""

from dataclasses import replace

import numpy as np
import pytest
from camera_setups import ARMS, simulate

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.diagnostics.frames import fit_frames, frames_differ
from dhcal_pin.diagnostics.input_checks import find_input_warnings
from dhcal_pin.exceptions import DhcalError, FileFormatError, InvalidArgumentError
from dhcal_pin.io.measurement_files import read_measurement_file, read_measurements
from dhcal_pin.io.shipped_files import resolve_robot_file

POSE = "x[mm],y[mm],z[mm],qw,qx,qy,qz"
CORNER = "u[px],v[px],corner,camera,board"


def pose_cells(poses, *, is_rotvec=False):
    """Return the cells of poses (m, 4, 4) in millimetres with a quaternion or a rotation vector."""
    rotvec = np.array([se3.log3(pose[:3, :3]) for pose in poses])
    if is_rotvec:
        return np.column_stack([1e3 * poses[:, :3, 3], rotvec])
    angle = np.linalg.norm(rotvec, axis=1, keepdims=True)
    quaternion = np.column_stack([np.cos(angle / 2), np.sinc(angle / 2 / np.pi) * rotvec / 2])
    return np.column_stack([1e3 * poses[:, :3, 3], quaternion])


def write_corners(path, data, header, cells):
    """Write a corners file with given columns in place of the joints."""
    names = [[camera.name for camera in data.rig.cameras], [board.name for board in data.rig.boards]]
    rows = [f"{header},{CORNER}"]
    for row, cell in enumerate(cells):
        numbers = [*cell, *data.values[row]]
        texts = [data.corner[row], names[0][data.camera[row]], names[1][data.board[row]]]
        rows.append(",".join([*(repr(float(number)) for number in numbers), *map(str, texts)]))
    path.write_text("\n".join(rows) + "\n")
    return path


def small_setup(name="ur10", *, is_on_wrist=True, n_images=8, seed=3):
    """Return images without noise of an arm that is as its model."""
    chain = ARMS[name]()
    rng = np.random.default_rng(seed)
    setup = simulate(
        chain, chain, rng, is_on_wrist=is_on_wrist, n_images=n_images, sigma=0.0, intrinsics_error=0.0
    )
    exact = setup.exact.rig.cameras[0]
    camera = replace(setup.images.rig.cameras[0], values=exact.values, intrinsics="fixed")
    return replace(setup, images=setup.images.with_rig(replace(setup.images.rig, cameras=(camera,))))


@pytest.mark.parametrize(("name", "is_on_wrist"), [("ur10", True), ("panda", False)])
def test_poses_give_the_same_cameras_and_boards_as_joint_values(tmp_path, name, is_on_wrist):
    """The poses of camera and board are also the true ones, as there is no noise."""
    setup = small_setup(name, is_on_wrist=is_on_wrist, n_images=12)
    arm, images = setup.nominal, setup.images
    cells = pose_cells(arm.poses(images.q))
    by_pose = read_measurements(write_corners(tmp_path / "c.csv", images, POSE, cells), arm, rig=images.rig)
    assert by_pose.n_images == images.n_images
    assert images.has_joint_values
    assert not by_pose.has_joint_values
    fits = [dh.calibrate(arm, images, "camera,board"), dh.calibrate(arm, by_pose, "camera,board")]
    assert fits[0].instruments.keys() == fits[1].instruments.keys()
    truth = {p.name: p.nominal for p in setup.exact.instrument_parameters}
    for key, value in fits[0].instruments.items():
        assert fits[1].instruments[key] == pytest.approx(value, abs=1e-6)
        assert value == pytest.approx(truth[key], abs=1e-6)


@pytest.mark.parametrize("is_rotvec", [False, True])
@pytest.mark.parametrize("name", ["ur10", "panda"])
def test_joint_positions_reach_the_poses(tmp_path, name, is_rotvec):
    setup = small_setup(name)
    arm, images = setup.nominal, setup.images
    poses = arm.poses(images.q)
    header = "x[mm],y[mm],z[mm],rx[rad],ry[rad],rz[rad]" if is_rotvec else POSE
    path = write_corners(tmp_path / "c.csv", images, header, pose_cells(poses, is_rotvec=is_rotvec))
    data = read_measurements(path, arm, rig=images.rig)
    np.testing.assert_allclose(arm.poses(data.q), poses, atol=1e-9)
    assert np.all((data.q >= arm.lower) & (data.q <= arm.upper))
    assert len(np.unique(data.q, axis=0)) == images.n_images


def test_poses_are_those_of_the_tip_in_the_base_frame(tmp_path):
    """Base and tool of a sidecar are not part of the poses of a controller."""
    setup = small_setup()
    moved = replace(
        setup.nominal,
        base=se3.transform(se3.exp3([0.1, 0, 0.3]), [1, 2, 3]),
        tool=se3.transform(np.eye(3), [0, 0, 0.2]),
    )
    poses = setup.nominal.poses(setup.images.q)
    path = write_corners(tmp_path / "c.csv", setup.images, POSE, pose_cells(poses))
    data = read_measurements(path, moved, rig=setup.images.rig)
    np.testing.assert_allclose(setup.nominal.poses(data.q), poses, atol=1e-9)


def flange_poses(case):
    """Return poses (100, 4, 4) of a flange: anywhere, or with a pitch of 90 degrees, exactly or nearly."""
    rng = np.random.default_rng(0)
    turns = np.array([se3.exp3(v) for v in rng.normal(0, 1.5, (100, 3))])
    if case != "anywhere":
        yaw, roll, sign = rng.uniform(-3, 3, 100), rng.uniform(-3, 3, 100), rng.choice([-1, 1], 100)
        for i in range(100):
            pitch = sign[i] * np.pi / 2
            turns[i] = se3.exp3([0, 0, yaw[i]]) @ se3.exp3([0, pitch, 0]) @ se3.exp3([roll[i], 0, 0])
            if case == "near":
                turns[i] = turns[i] @ se3.exp3(rng.normal(size=3) * 10.0 ** rng.uniform(-9, -2))
    return se3.transform(turns, rng.uniform(-9.9, 9.9, (100, 3)))


@pytest.mark.parametrize("case", ["anywhere", "singular", "near"])
def test_flange_reaches_every_pose(tmp_path, case):
    arm, poses = dh.read_robot("flange.urdf"), flange_poses(case)
    setup = small_setup()
    images = setup.images.take(np.arange(len(poses)) % len(setup.images.rows))
    path = write_corners(tmp_path / "c.csv", images, POSE, pose_cells(poses))
    data = read_measurements(path, arm, rig=setup.images.rig)
    reached = arm.poses(data.q)
    np.testing.assert_allclose(reached[:, :3, 3], poses[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(reached[:, :3, :3], poses[:, :3, :3], atol=1e-8)


def test_shipped_flange_is_used_unless_there_is_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert dh.read_robot("flange.urdf").tip == "flange"
    assert resolve_robot_file("other.urdf") == "other.urdf"
    (tmp_path / "flange.urdf").write_text("own")
    assert resolve_robot_file("flange.urdf") == "flange.urdf"


def test_unreachable_pose_names_line_and_distance(tmp_path):
    setup = small_setup()
    arm = setup.nominal
    poses = arm.poses(setup.images.q)
    tip = poses[0, :3, 3].copy()
    is_far = np.all(setup.images.q == setup.images.q[0], 1)
    poses[is_far, :3, 3] = 5 * tip / np.linalg.norm(tip)
    path = write_corners(tmp_path / "c.csv", setup.images, POSE, pose_cells(poses))
    line = int(np.flatnonzero(is_far)[0]) + 2
    with pytest.raises(FileFormatError) as caught:
        read_measurements(path, arm, rig=setup.images.rig)
    message = str(caught.value)
    assert f"c.csv:{line}: this robot does not reach the pose, the nearest one is " in message
    assert "expected the pose of link tool0 in the frame of link world; the robot file flange.urdf" in message
    # A UR10 reaches 1.3 m and its flange a little farther, from a shoulder 0.13 m above the base.
    distance = float(message.split("nearest one is ")[1].split(" mm")[0])
    assert 3400 < distance < 3900
    assert "\n" not in message


def test_joint_values_and_poses_together_are_refused(tmp_path):
    setup = small_setup()
    arm = setup.nominal
    header = f"{arm.joint_names[0]}[rad],{POSE}"
    cells = np.column_stack([setup.images.q[:, 0], pose_cells(arm.poses(setup.images.q))])
    path = write_corners(tmp_path / "c.csv", setup.images, header, cells)
    with pytest.raises(FileFormatError, match="does not go with x, y, z, qw, qx, qy, qz"):
        read_measurements(path, arm, rig=setup.images.rig)


@pytest.mark.parametrize("columns", ["x[mm],y[mm],z[mm]", "qw,qx,qy,qz", "x[mm],y[mm],z[mm],qw,qx,qy"])
def test_incomplete_poses_are_refused(tmp_path, columns):
    setup = small_setup()
    cells = pose_cells(setup.nominal.poses(setup.images.q))
    chosen = [POSE.split(",").index(name) for name in columns.split(",")]
    path = write_corners(tmp_path / "c.csv", setup.images, columns, cells[:, chosen])
    with pytest.raises(DhcalError, match=r"c\.csv:1: "):
        read_measurements(path, setup.nominal, rig=setup.images.rig)


@pytest.fixture(scope="module")
def by_pose(tmp_path_factory):
    """Return an arm, the file of its images with poses, and an image measurement of it."""
    setup = small_setup()
    cells = pose_cells(setup.nominal.poses(setup.images.q))
    path = write_corners(tmp_path_factory.mktemp("poses") / "c.csv", setup.images, POSE, cells)
    return setup, read_measurement_file(path, setup.nominal, rig=setup.images.rig)


def test_right_poses_get_no_warning(by_pose):
    setup, file = by_pose
    assert find_input_warnings(setup.nominal, file) == []


@pytest.mark.parametrize("parameters", ["placement,camera", "offset,board", "minimal", "base,minimal"])
def test_arm_is_not_estimated_without_joint_values(by_pose, parameters):
    setup, file = by_pose
    name = next(name for name in parameters.split(",") if name != "base")
    with pytest.raises(InvalidArgumentError, match=f"'{name}': need joint values") as caught:
        dh.calibrate(setup.nominal, file.data, parameters)
    assert "\n" not in str(caught.value)
    dh.calibrate(setup.nominal, setup.images, "offset,camera,board", loss="linear")


def test_single_parameters_and_other_measurements_are_refused(by_pose):
    setup, file = by_pose
    offset = dh.select_parameters(setup.nominal, "offset").parameters[0].name
    with pytest.raises(InvalidArgumentError, match="need joint values"):
        dh.calibrate(setup.nominal, file.data, "camera,board", free=(offset,))
    q = setup.images.q[:5]
    positions = dh.Position(q, setup.nominal.poses(q)[:, :3, 3])
    with pytest.raises(InvalidArgumentError, match="kind position beside images"):
        dh.calibrate(setup.nominal, [file.data, positions], "camera,board")


def test_cameras_boards_and_lenses_are_estimated_by_default(by_pose):
    setup, file = by_pose
    fit = dh.calibrate(setup.nominal, file.data)
    assert not fit.errors.parameters
    assert {name.split(".")[0] for name in fit.instruments} >= {"camera_camera0", "board_board0"}
    assert fit.hand_eye is not None
    assert not {trial.cause for trial in fit.hand_eye.trials} & {"joint offsets", "arm geometry"}


def test_validation_finds_a_moved_base(by_pose):
    """A validation asks whether base and tool are those of another set-up, which needs no joint values."""
    setup, file = by_pose
    known = {p.name: p.nominal for p in setup.exact.instrument_parameters}
    known = {p.name: known[p.name] for p in file.data.instrument_parameters}
    assert not frames_differ(setup.nominal, [file.data], known)
    moved = replace(setup.nominal, base=se3.transform(se3.exp3([0, 0, 0.02]), [0.01, 0.02, 0]))
    assert frames_differ(moved, [file.data], known)
    np.testing.assert_allclose(fit_frames(moved, [file.data], known, "base").chain.base, np.eye(4), atol=1e-6)
