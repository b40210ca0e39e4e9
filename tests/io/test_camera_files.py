"""A calibrated camera in the files of other programs, and in the URDF and the sidecar."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from robots import URDF

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.cameras import LENSES, Board, Camera, Rig
from dhcal_pin.cli.main import main
from dhcal_pin.io.camera_files import (
    camera_files,
    camera_frames,
    camera_info_text,
    hand_eye_text,
    opencv_text,
)
from dhcal_pin.measurements import mount_rig
from dhcal_pin.robot.urdf import read_urdf

VALUES = np.array([640.5, 641.25, 639.5, 359.5, 1e-5, -0.02, 1e-3, 2e-3, 0.003])
POSE = se3.transform(se3.exp3([0.3, -0.2, 2.0]), [0.1, 0.2, 0.3])
CAMERA = Camera("wrist", "tip", 1280, 720, VALUES, pose=POSE)
BASE = se3.transform(se3.exp3([0.1, 0.0, 0.4]), [0.2, -0.1, 0.05])
TOOL = se3.transform(se3.exp3([0.2, 0.3, -0.1]), [0.01, 0.02, 0.12])


def published(text):
    """Return what the publisher of easy_handeye sends: frame, frame of the child and transform (4, 4)."""
    content = yaml.safe_load(text)
    assert set(content) == {"parameters", "transformation"}
    parameters, values = content["parameters"], content["transformation"]
    frames = ["robot_base_frame", "robot_effector_frame", "tracking_base_frame", "tracking_marker_frame"]
    assert set(parameters) == {"namespace", "eye_on_hand", *frames}
    assert all(type(parameters[key]) is str for key in frames)
    assert type(parameters["eye_on_hand"]) is bool
    assert parameters["namespace"].startswith("/")
    assert parameters["namespace"].endswith("/")
    parent = parameters["robot_effector_frame" if parameters["eye_on_hand"] else "robot_base_frame"]
    rotation = se3.quaternion_to_matrix([values[key] for key in ("qw", "qx", "qy", "qz")])
    return (
        parent,
        parameters["tracking_base_frame"],
        se3.transform(rotation, [values[key] for key in ("x", "y", "z")]),
    )


def frames_on(link: str, name: str | None = "eye"):
    """Return a robot with base and tool poses, and the frames of a camera on a link of it."""
    arm = replace(dh.read_robot("example:ur10", tip="tool0"), base=BASE, tool=TOOL)
    end = "world" if link in {"tip", "wrist_3_link"} else "tip"
    far = Board("far", end, "checkerboard", columns=5, rows=4, square=0.04, pose=np.eye(4))
    near = replace(far, name="near", link="tip" if end == "world" else "world")
    rig = mount_rig(Rig({"wrist": replace(CAMERA, link=link)}, {"near": near, "far": far}), arm)
    return arm, rig, camera_frames(rig, arm, name)


def test_ros_files():
    _, _, (frame,) = frames_on("tip")
    info = yaml.safe_load(str(camera_files(frame, "out")["out.camera_info.yaml"]))
    assert (info["image_width"], info["image_height"], info["distortion_model"]) == (1280, 720, "plumb_bob")
    assert info["camera_matrix"]["data"] == [640.5, 0, 639.5, 0, 641.25, 359.5, 0, 0, 1]
    assert info["distortion_coefficients"]["data"] == VALUES[4:].tolist()


@pytest.mark.parametrize(
    ("link", "parent", "moves"),
    [
        ("tip", "tool0", True),
        ("wrist_3_link", "wrist_3_link", True),
        ("world", "world", False),
        ("base_link", "base_link", False),
    ],
)
def test_easy_handeye_publishes_the_pose_of_the_camera(link, parent, moves):
    """The published frame is where the robot has the camera, with base and tool that are not in the URDF."""
    arm, rig, (frame,) = frames_on(link)
    text = str(camera_files(frame, "out")["out.handeye.yaml"])
    assert published(text)[:2] == (parent, "eye")
    parameters = yaml.safe_load(text)["parameters"]
    assert parameters["eye_on_hand"] is moves
    assert parameters["namespace"].endswith("_eye_on_hand/" if moves else "_eye_on_base/")
    assert parameters["tracking_marker_frame"] == "far"
    assert parameters["robot_base_frame" if moves else "robot_effector_frame"] == (
        "world" if moves else "tool0"
    )
    q = np.random.default_rng(0).uniform(-2, 2, (4, arm.n_joints))
    if moves:
        expected = arm.poses(q) @ rig.camera_in_end(0)
        links = BASE @ dh.read_robot("example:ur10", tip=parent).poses(q)
    else:
        expected = rig.camera_in_end(0)
        links = BASE @ arm.fixed_pose("world", parent)
    np.testing.assert_allclose(links @ published(text)[2], expected, atol=1e-12)


def test_frames_have_the_names_of_the_rig_without_another_name():
    """A name that is a number stays a name."""
    _, _, (frame,) = frames_on("tip", None)
    assert frame.name == "wrist"
    text = str(camera_files(replace(frame, name="2"), "out")["out.handeye.yaml"])
    assert published(text)[1] == "2"


def test_the_standard_deviation_is_a_comment():
    _, _, (frame,) = frames_on("tip")
    plain, stated = (str(camera_files(frame, "out", std)["out.handeye.yaml"]) for std in (None, 0.0123))
    comment = "# standard deviation of the position relative to the arm: 12.3 mm\n"
    assert stated == comment + plain
    assert published(stated)[:2] == ("tool0", "eye")


def test_opencv_reads_its_file(tmp_path):
    cv2 = pytest.importorskip("cv2")
    (tmp_path / "c.yaml").write_text(opencv_text(CAMERA))
    storage = cv2.FileStorage(str(tmp_path / "c.yaml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat()[[0, 1], [0, 1]], VALUES[:2])
    np.testing.assert_array_equal(storage.getNode("distortion_coefficients").mat().ravel(), VALUES[4:])


def test_camera_in_urdf_and_sidecar(tmp_path, monkeypatch):
    """The link of a camera has the pose of the sidecar; held-out images are judged by `validate`."""
    monkeypatch.chdir(tmp_path)
    nominal, actual = str(URDF / "sim_6dof.dh.toml"), str(URDF / "sim_6dof_actual.dh.toml")
    for name, seed in (("fit", 1), ("other", 1)):
        assert main(["simulate", nominal, "--truth", actual, "-m", "20", "--kind", "camera",
                     "--noise", "0.1mm", "--seed", str(seed), "-o", f"{name}.csv"]) == 0  # fmt: skip
    assert main(["calibrate", nominal, "fit.csv", "--rig", "fit.rig.toml", "-o", "o.urdf",
                 "--extend", "none", "--camera-frame", "eye", "--camera-files", "cam",
                 "--json", "o.json"]) == 0  # fmt: skip
    files = json.loads(Path("o.json").read_text())["files"]
    written = [str(path) for path in sorted(Path().glob("cam_*"))]
    assert len(written) == 6
    assert sorted(path for name, path in files.items() if name.startswith("camera_file")) == written
    sidecar = tomllib.loads(Path("o.calibration.toml").read_text())
    urdf = read_urdf("o.urdf")
    for name in ("left", "right"):
        origin = urdf.joint(f"eye_{name}_joint").origin
        np.testing.assert_allclose(origin[:3, 3], sidecar["camera"][name]["xyz_m"], atol=1e-12)
        rotation = se3.exp3(sidecar["camera"][name]["rotvec_rad"])
        np.testing.assert_allclose(origin[:3, :3], rotation, atol=1e-12)
        parent, child, pose = published(Path(f"cam_{name}.handeye.yaml").read_text())
        assert (parent, child) == ("base_link", f"eye_{name}")
        np.testing.assert_allclose(pose, origin, atol=1e-12)
    assert sidecar["board"]["target"]["link"] == "tip"
    assert main(["validate", "o.urdf", "other.csv", "--rig", "other.rig.toml", "--json", "v.json"]) == 0
    assert yaml.safe_load(Path("v.json").read_text())["after"]["residual_rms"] < 0.2


def test_each_camera_of_several_has_its_own_name_and_files():
    arm, _, (frame,) = frames_on("tip")
    assert frame.name == "eye"
    rig = mount_rig(
        Rig({"left": replace(CAMERA, name="left"), "right": replace(CAMERA, name="right", link="world")},
            {"b": Board("b", "world", "checkerboard", columns=5, rows=4, square=0.04, pose=np.eye(4))}),
        arm,
    )  # fmt: skip
    assert [each.name for each in camera_frames(rig, arm, "eye")] == ["eye_left", "eye_right"]
    left, right = camera_frames(rig, arm, None)
    assert (left.name, right.name) == ("left", "right")
    assert (left.moves, left.parent, left.base, left.effector) == (True, "tool0", "world", "tool0")
    assert (right.moves, right.parent, right.base, right.effector) == (False, "world", "world", "tool0")
    endings = ["camera_info", "opencv", "handeye"]
    assert [*camera_files(left, "out")] == [f"out.{ending}.yaml" for ending in endings]


@pytest.mark.parametrize(("model", "name"), [("pinhole", "plumb_bob"), ("fisheye", "equidistant")])
def test_ros_matrices_have_their_sizes(model, name):
    values = VALUES[: 4 + len(LENSES[model].coefficients)]
    info = yaml.safe_load(camera_info_text(replace(CAMERA, lens=LENSES[model], values=values)))
    assert (info["camera_name"], info["distortion_model"]) == ("wrist", name)
    data = {
        "camera_matrix": [[640.5, 0, 639.5], [0, 641.25, 359.5], [0, 0, 1]],
        "distortion_coefficients": [values[4:].tolist()],
        "rectification_matrix": np.eye(3).tolist(),
        "projection_matrix": [[640.5, 0, 639.5, 0], [0, 641.25, 359.5, 0], [0, 0, 1, 0]],
    }
    for key, rows in data.items():
        matrix = info[key]
        assert (matrix["rows"], matrix["cols"]) == (len(rows), len(rows[0]))
        assert matrix["data"] == np.ravel(rows).tolist()


def test_matrices_of_opencv_have_their_sizes():
    lines = opencv_text(CAMERA).splitlines()
    assert lines[:4] == ["%YAML:1.0", "---", "image_width: 1280", "image_height: 720"]
    assert [line for line in lines if "rows" in line or "cols" in line] == [
        "   rows: 3", "   cols: 3", "   rows: 1", "   cols: 5"
    ]  # fmt: skip
    assert "   data: [640.5, 0.0, 639.5, 0.0, 641.25, 359.5, 0.0, 0.0, 1.0]" in lines


@pytest.mark.parametrize("std", [None, np.inf, np.nan])
def test_a_standard_deviation_that_is_not_known_is_left_out(std):
    _, _, (frame,) = frames_on("tip")
    assert hand_eye_text(frame, std).startswith("parameters:\n  namespace: ")
