"""A calibrated camera in the files of other programs, and in the URDF and the sidecar."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
import yaml
from robots import URDF

from dhcal_pin import se3
from dhcal_pin.cameras import Camera
from dhcal_pin.cli.main import main
from dhcal_pin.io.camera_files import camera_files, opencv_text
from dhcal_pin.robot.urdf import read_urdf

VALUES = np.array([640.5, 641.25, 639.5, 359.5, 0.1, -0.02, 1e-3, 2e-3, 0.003])
POSE = se3.transform(se3.exp3([0.3, -0.2, 2.0]), [0.1, 0.2, 0.3])
CAMERA = Camera("wrist", "tip", 1280, 720, VALUES, pose=POSE)


def test_ros_files():
    texts = camera_files(CAMERA, "out", "tool0")
    info = yaml.safe_load(str(texts["out.camera_info.yaml"]))
    assert (info["image_width"], info["image_height"], info["distortion_model"]) == (1280, 720, "plumb_bob")
    assert info["camera_matrix"]["data"] == [640.5, 0, 639.5, 0, 641.25, 359.5, 0, 0, 1]
    assert info["distortion_coefficients"]["data"] == VALUES[4:].tolist()
    pose = yaml.safe_load(str(texts["out.handeye.yaml"]))["transformation"]
    np.testing.assert_allclose([pose[k] for k in "xyz"], POSE[:3, 3])
    rotation = se3.quaternion_to_matrix([pose[k] for k in ("qw", "qx", "qy", "qz")])
    np.testing.assert_allclose(rotation, POSE[:3, :3], atol=1e-12)


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
        assert Path(f"cam_{name}.camera_info.yaml").exists()
    assert sidecar["board"]["target"]["link"] == "tip"
    assert main(["validate", "o.urdf", "other.csv", "--rig", "other.rig.toml", "--json", "v.json"]) == 0
    assert yaml.safe_load(Path("v.json").read_text())["after"]["residual_rms"] < 0.2
