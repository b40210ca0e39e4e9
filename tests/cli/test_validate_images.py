"""Command validate with images: the estimates of the calibration count, not the values of an old rig file."""

import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from command_line import error_of, json_of, unfolded
from rig_files import BOARD, CAMERA, draw_views

import dhcal_pin as dh
from dhcal_pin.cameras import Rig
from dhcal_pin.cli import main
from dhcal_pin.io.rig_file import read_calibrated_rig, rig_text
from dhcal_pin.measurements import mount_rig, project_board

pytestmark = pytest.mark.usefixtures("uneventful", "untried", "ordered_axes", "inside_only")

NOISE = 0.1
N_FITTED, N_OTHER = 20, 12
# Angle of a count of the simulated servos [rad].
STEP = 2 * np.pi / 2**20


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    """Calibrate a camera and a board whose corners are 1 mm beside the stated places; other images remain.

    Returns the folder with all files, and the corners.
    """
    folder = tmp_path_factory.mktemp("calibration")
    arm = dh.read_robot("example:ur10", tip="tool0")
    rng = np.random.default_rng(4)
    corners = BOARD.points + rng.normal(0, 1e-3, BOARD.points.shape)
    bent = replace(BOARD, type="points", listed_points=corners)
    rig = mount_rig(Rig({"wrist": CAMERA}, {"table": bent}), arm)
    q = draw_views(arm, rig, rng, 100_000)
    assert len(q) >= N_FITTED + N_OTHER
    for name, rows in (("fitted.csv", q[:N_FITTED]), ("other.csv", q[N_FITTED : N_FITTED + N_OTHER])):
        pixels, _ = project_board(rig, 0, 0, rig.board_in_camera(0, 0, arm.poses(rows)))
        pixels += NOISE * rng.standard_normal(pixels.shape)
        lines = [",".join(f"{joint}[rad]" for joint in arm.joint_names) + ",u[px],v[px],corner"]
        for joints, image in zip(rows.tolist(), pixels.tolist(), strict=True):
            lines += [",".join(map(repr, [*joints, *uv, i])) for i, uv in enumerate(image)]
        (folder / name).write_text("\n".join(lines))
    write_rig(folder / "rig.toml", has_free_points=True)
    inputs = ("example:ur10", str(folder / "fitted.csv"), "--rig", str(folder / "rig.toml"), "--tip", "tool0")
    sets = ("--parameters", "camera,board,intrinsics")
    assert main.main(["calibrate", *inputs, *sets, "-o", str(folder / "arm.urdf")]) == 0
    return folder, corners


@pytest.fixture
def calibrated(calibration, tmp_path, monkeypatch):
    """Working folder with a copy of the calibration; returns the corners."""
    folder, corners = calibration
    monkeypatch.chdir(tmp_path)
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    return corners


def write_rig(path, camera=CAMERA, **changes):
    """Write the rig of a user, without poses and with roughly known lens."""
    values = np.array([720.0, 720, 399.5, 299.5, 0, 0, 0, 0, 0])
    board = replace(BOARD, pose=None, **changes)
    Path(path).write_text(rig_text([replace(camera, pose=None, values=values)], [board]))


def test_estimates_of_the_calibration_replace_an_old_rig(run, calibrated):
    """Lens and corners of the rig file are wrong; the error is the noise, whatever the rig says."""
    rig = read_calibrated_rig("arm.calibration.toml")
    assert rig is not None
    points = rig.boards["table"].points
    assert np.std(points - points.mean(0) - calibrated + calibrated.mean(0)) < 3e-4
    fixed = replace(CAMERA, intrinsics="fixed")
    for path, camera, changes in (
        ("rig.toml", CAMERA, {"has_free_points": True}),
        ("auto.toml", CAMERA, {}),
        ("fixed.toml", fixed, {"has_exact_points": True, "square": 0.041}),
    ):
        write_rig(path, camera, **changes)
        result = run("validate", "arm.urdf", "other.csv", "--tip", "tool0", "--rig", path, "--json", "-")
        document = json_of(result)
        assert document["after"]["residual_rms"] == pytest.approx(np.sqrt(2) * NOISE, rel=0.2)
        assert document["estimated_entries"] == ["camera.wrist", "board.table"]
        assert f"estimates of the calibration (arm.calibration.toml), not those of {path}" in unfolded(
            result[2]
        )


def test_the_sidecar_of_a_calibration_replaces_the_rig_file(run, calibrated):
    """Without --rig, the error is the same number as with the rig file of the calibration."""
    images = ("validate", "arm.urdf", "other.csv", "--tip", "tool0", "--json", "-")
    result = run(*images)
    document, expected = json_of(result), json_of(run(*images, "--rig", "rig.toml"))
    assert document["after"] == expected["after"]
    assert document["after"]["residual_rms"] == pytest.approx(np.sqrt(2) * NOISE, rel=0.2)
    assert document["estimated_entries"] == ["camera.wrist", "board.table"]
    text = unfolded(result[2])
    assert "camera.wrist, board.table are the estimates of the calibration (arm.calibration.toml)." in text


def test_poses_that_nothing_states_are_fitted_to_the_images(run, calibrated):
    """The screen says so: errors of fitted images are no errors of a robot with base and tool as given."""
    fitted = run("validate", "example:ur10", "other.csv", "--tip", "tool0", "--rig", "rig.toml")[2]
    assert "base and tool as given" not in unfolded(fitted)
    assert "lenses of camera.wrist, board.table are not stated and were fitted to these images" in unfolded(
        fitted
    )
    given = run("validate", "arm.urdf", "other.csv", "--tip", "tool0")[2]
    assert "base and tool as given" in unfolded(given)
    assert "fitted to these images" not in unfolded(given)


def test_a_sidecar_without_lens_or_pose_needs_the_rig_file(run, calibrated):
    content = tomllib.loads(Path("arm.calibration.toml").read_text())
    lens = ("fx", "fy", "cx", "cy", "distortion", "intrinsics")
    pose = ("xyz_m", "rotvec_rad")
    for kind, name, keys in (("camera", "wrist", lens), ("camera", "wrist", pose), ("board", "table", pose)):
        entry = {key: value for key, value in content[kind][name].items() if key not in keys}
        Path("arm.calibration.toml").write_text(tomli_w.dumps({**content, kind: {name: entry}}))
        err = error_of(run("validate", "arm.urdf", "other.csv", "--tip", "tool0"))
        assert "other.csv: image coordinates need the cameras and boards of a rig; give --rig" in unfolded(
            err
        )


def test_other_measurements_need_no_camera_of_the_sidecar(run, calibrated):
    """A sidecar with a link that this robot does not have is refused for images only."""
    arm = dh.read_robot("arm.urdf", tip="tool0")
    q = np.random.default_rng(1).uniform(-1, 1, (5, arm.n_joints))
    header = ",".join([*(f"{name}[rad]" for name in arm.joint_names), "x[m],y[m],z[m]"])
    np.savetxt("laser.csv", np.hstack([q, arm.poses(q)[:, :3, 3]]), delimiter=",", header=header, comments="")
    content = tomllib.loads(Path("arm.calibration.toml").read_text())
    content["camera"]["wrist"]["link"] = "other_hand"
    Path("arm.calibration.toml").write_text(tomli_w.dumps(content))
    document = json_of(run("validate", "arm.urdf", "laser.csv", "--tip", "tool0", "--json", "-"))
    assert document["estimated_entries"] == []
    assert document["after"]["position_rms_m"] < 1e-9
    err = error_of(run("validate", "arm.urdf", "other.csv", "--tip", "tool0"))
    assert 'arm.calibration.toml: [camera.wrist]: link = "other_hand" is not a link of' in unfolded(err)


def test_other_names_are_not_those_of_the_calibration(run, calibrated):
    """The poses of a camera under another name are fitted to the images, with its corners as stated."""
    write_rig("rig.toml", replace(CAMERA, name="new"), name="old")
    document = json_of(
        run("validate", "arm.urdf", "other.csv", "--tip", "tool0", "--rig", "rig.toml", "--json", "-")
    )
    assert document["estimated_entries"] == []
    assert document["after"]["residual_rms"] > 5 * NOISE


def test_another_board_of_the_same_name_is_refused(run, calibrated):
    small = replace(CAMERA, width=640, height=480)
    for camera, changes, message in (
        (CAMERA, {"columns": 6}, "[board.table]: number of corners 15, but 12 in arm.calibration.toml"),
        (CAMERA, {"link": "shoulder_link"}, "[board.table]: link shoulder_link, but world in"),
        (small, {}, "[camera.wrist]: images 640 x 480 px, but 800 x 600 px in"),
    ):
        write_rig("rig.toml", camera, **changes)
        err = error_of(run("validate", "arm.urdf", "other.csv", "--tip", "tool0", "--rig", "rig.toml"))
        assert f"rig.toml: {message}" in unfolded(err)


def test_a_plan_reads_the_sidecar_of_estimated_corners(run, calibrated):
    """The pose is that of the calibration; the board is a printed one still, seen from its front."""
    write_rig("rig.toml")
    args = ("plan", "arm.urdf", "-n", "3", "--tip", "tool0", "--rig", "rig.toml", "--candidates", "20")
    document = json_of(run(*args, "-o", "poses.csv", "--json", "-"))
    assert document["views"][0]["angle_max_rad"] < np.deg2rad(60.1)


def test_counts_of_servos_need_no_rig(run, calibrated):
    """The same images with counts in place of joint values have the same error, without --rig."""
    joints = dh.read_robot("arm.urdf", tip="tool0").joint_names
    head, *rows = Path("other.csv").read_text().splitlines()
    values = np.array([row.split(",") for row in rows], float)
    counts = np.round((values[:, :6] + 2 * np.pi) / STEP).astype(int)
    for name, header, cells in (
        ("counts.csv", head.replace("[rad]", "[ticks]"), counts),
        ("rounded.csv", head, counts * STEP - 2 * np.pi),
    ):
        lines = (
            ",".join(map(repr, [*q, u, v, int(i)]))
            for q, (u, v, i) in zip(cells.tolist(), values[:, 6:].tolist(), strict=True)
        )
        Path(name).write_text("\n".join([header, *lines]))
    motors = {name: {"zero": 2**20, "resolution": 2**21, "counts_per_turn": 2**20} for name in joints}
    Path("servos.toml").write_text(tomli_w.dumps({"motor": motors}))
    images = ("--tip", "tool0", "--json", "-")
    by_counts = json_of(run("validate", "arm.urdf", "counts.csv", "--servos", "servos.toml", *images))
    by_angles = json_of(run("validate", "arm.urdf", "rounded.csv", *images))
    figures = [
        [value for value in each["before"].values() if isinstance(value, float)]
        for each in (by_counts, by_angles)
    ]
    assert len(figures[0]) > 2
    assert figures[0] == pytest.approx(figures[1], rel=1e-9)
    err = error_of(run("validate", "arm.urdf", "counts.csv", *images[:2]))
    assert "--servos" in err


def test_joint_names_with_a_suffix_are_explained(run, calibrated):
    """A column map would be wrong: the unit is not known, and image coordinates are not positions."""
    text = Path("fitted.csv").read_text()
    joints = dh.read_robot("arm.urdf", tip="tool0").joint_names
    arguments = ("example:ur10", "theirs.csv", "--rig", "rig.toml", "--tip", "tool0", "-o", "out.urdf")
    Path("theirs.csv").write_text(text.replace("[rad]", ".pos"))
    err = error_of(run("calibrate", *arguments))
    assert f"expected '{joints[0]}[ticks]'" in unfolded(err)
    assert "from =" not in err
    Path("theirs.csv").write_text(text.replace("[rad]", "_measured"))
    err = error_of(run("calibrate", *arguments))
    assert f'order = ["{joints[0]}_measured"' in unfolded(err)
    assert "from =" not in err
