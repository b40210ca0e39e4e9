"""Kinematics files of Universal Robots, and DH tables with the factory deltas of a UR arm."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml
from robots import DATA, nominal_arm, paper

from dhcal_pin import se3
from dhcal_pin.cli.main import main
from dhcal_pin.exceptions import DhcalError, InvalidArgumentError
from dhcal_pin.io import dh_text, read_robot
from dhcal_pin.io.makers.ur_kinematics import (
    convert_to_ur_kinematics,
    read_ur_kinematics,
    ur_kinematics,
    ur_kinematics_text,
)
from dhcal_pin.io.robot_format import RobotSource
from dhcal_pin.io.tabular import yaml_number
from dhcal_pin.robot import Chain, DHTable

FACTORY = DATA / "ur_factory/ur10_delta_dh.csv"
JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
# Deltas of the size that makers ship: metres of offset that cancel, hiding milliradians of tilt.
LIKE_FACTORY = {
    "d": [6.6e-4, 1.4, 0.85, -2.26, -1.6e-5, 1.9e-5],
    "a": [4.6e-5, -1.3e-4, 1.9e-3, 9.9e-5, 4.2e-6, 0],
    "theta": [-7.3e-5, -1.7e-2, -3.7e-2, 5.4e-2, 1.5e-7, 1.6e-5],
    "alpha": [2.1e-4, -7.3e-3, -1.35e-2, 1.3e-3, -1.3e-3, 0],
}


def ur10(deltas: dict | None = None) -> DHTable:
    """UR's own table of the UR10, with deltas."""
    zero = np.zeros(6)
    delta = {key: np.array((deltas or {}).get(key, zero), float) for key in ("theta", "d", "a", "alpha")}
    return DHTable(
        "standard", JOINTS, zero, delta["theta"],
        np.array([0.1273, 0, 0, 0.163941, 0.1157, 0.0922]) + delta["d"],
        np.array([0, -0.612, -0.5723, 0, 0, 0]) + delta["a"],
        np.array([np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0]) + delta["alpha"],
        zero, zero - np.inf, zero + np.inf,
    )  # fmt: skip


def factory() -> dict:
    if not FACTORY.exists():
        return LIKE_FACTORY
    with FACTORY.open() as file:
        rows = list(csv.DictReader(file))
    units = {"d": "m", "a": "m", "theta": "rad", "alpha": "rad"}
    return {key: [float(row[f"delta_{key}_{unit}"]) for row in rows] for key, unit in units.items()}


def link_places(chain: Chain):
    """Each link's position in the base at zero, (k+1, 3)."""
    model = chain.model
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    return np.array([pose.translation for pose in data.oMi])


@pytest.mark.parametrize("deltas", [factory(), LIKE_FACTORY], ids=["shipped", "alike"])
def test_factory_deltas_become_a_urdf_with_nearly_nominal_links(deltas):
    """Link origins within 5 cm of nominal, and the tool where the plain DH product has it."""
    nominal, actual = Chain.from_dh(ur10()), Chain.from_dh(ur10(deltas))
    assert np.linalg.norm(link_places(actual) - link_places(nominal), axis=1).max() < 0.05
    assert np.linalg.norm((actual.origins - nominal.origins)[:, :3, 3], axis=1).max() < 0.05
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (500, 6))
    np.testing.assert_allclose(actual.poses(q), ur10(deltas).poses(q), atol=1e-9)


def test_tables_without_cancelling_offsets_keep_one_row_per_origin():
    """The paper's arms keep one DH row an origin, nearly parallel axes and all."""
    for name in ("sim_6dof_actual", "experiment_published", "sim_6dof"):
        table = paper(name)
        np.testing.assert_allclose(Chain.from_dh(table).origins, table.origins(), atol=1e-15)


def test_a_nominal_ur10_has_the_numbers_of_urs_description():
    """The numbers that UR's description ships for a nominal UR10."""
    found = ur_kinematics(Chain.from_dh(ur10()))
    wanted = {
        "shoulder": [0, 0, 0.1273, 0, 0, 0],
        "upper_arm": [0, 0, 0, np.pi / 2, 0, 0],
        "forearm": [-0.612, 0, 0, 0, 0, 0],
        "wrist_1": [-0.5723, 0, 0.163941, 0, 0, 0],
        "wrist_2": [0, -0.1157, 0, np.pi / 2, 0, 0],
    }
    for name, values in wanted.items():
        np.testing.assert_allclose(list(found[name].values()), values, atol=1e-12)
    # UR writes the last turn as (90°, 180°, 180°).
    last = found["wrist_3"]
    np.testing.assert_allclose([last["x"], last["y"], last["z"]], [0, 0.0922, 0], atol=1e-12)
    np.testing.assert_allclose(
        pin.rpy.rpyToMatrix(last["roll"], last["pitch"], last["yaw"]),
        pin.rpy.rpyToMatrix(np.pi / 2, np.pi, np.pi),
        atol=1e-12,
    )


def test_written_files_are_read_back(tmp_path):
    table = ur10(factory())
    path = tmp_path / "kinematics.yaml"
    path.write_text(ur_kinematics_text(Chain.from_dh(table)))
    assert set(yaml.safe_load(path.read_text())["kinematics"]) == {
        "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3", "hash",
    }  # fmt: skip
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 6))
    np.testing.assert_allclose(read_ur_kinematics(path).poses(q), table.poses(q), atol=1e-12)


@pytest.mark.parametrize("value", [1e-5, -1e-5, 1e-300, 5e-324, 1.0000000000000002e-7, 1e16, 1e22, 0.25, 0.0])
def test_written_numbers_are_numbers_of_yaml(tmp_path, value):
    """YAML 1.1 reads 1e-05 as a text."""
    entry = "".join(f"\n    {key}: {yaml_number(value)}" for key in ("x", "y", "z", "roll", "pitch", "yaw"))
    assert yaml.safe_load(f"shoulder: {entry}")["shoulder"]["x"] == value


def test_small_offsets_are_read_back(tmp_path):
    table = ur10({"theta": np.full(6, 1e-5), "d": np.full(6, 1e-7)})
    path = tmp_path / "kinematics.yaml"
    path.write_text(ur_kinematics_text(Chain.from_dh(table)))
    content = yaml.safe_load(path.read_text())["kinematics"]
    content.pop("hash")
    assert {type(value) for origin in content.values() for value in origin.values()} == {float}
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 6))
    np.testing.assert_allclose(read_ur_kinematics(path).poses(q), table.poses(q), atol=1e-12)


def test_numbers_of_yaml_1_2_are_read(tmp_path):
    """Other programs write 1e-05, which is a number in YAML 1.2."""
    path = tmp_path / "kinematics.yaml"
    text = ur_kinematics_text(Chain.from_dh(ur10()))
    path.write_text(text.replace("z: 0.1273", "z: 1273e-04"))
    assert "1273e-04" in path.read_text()
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (20, 6))
    np.testing.assert_allclose(read_ur_kinematics(path).poses(q), ur10().poses(q), atol=1e-12)


def test_the_flange_of_a_ros_urdf_stays():
    """Axes along y in the old description; the flange is where its tool0 is."""
    chain = nominal_arm("ur10")
    pose = np.eye(4)
    q = np.random.default_rng(0).uniform(-3, 3, 6)
    for values, angle in zip(ur_kinematics(chain).values(), q, strict=True):
        xyz, rpy = list(values.values())[:3], list(values.values())[3:]
        pose = pose @ se3.transform(pin.rpy.rpyToMatrix(*rpy), xyz) @ se3.exp6([0, 0, 0, 0, 0, angle])
    np.testing.assert_allclose(pose, chain.poses(q[None])[0], atol=1e-12)


def test_other_robots_are_an_error(sim_6dof):
    with pytest.raises(DhcalError, match="need the joints shoulder_pan_joint"):
        ur_kinematics(sim_6dof)


@pytest.mark.parametrize("text", ["a: [", "kinematics: 3", "kinematics:\n  shoulder: {x: 1}", "[]", ""])
def test_invalid_files_are_an_error_of_one_line(text, tmp_path):
    path = tmp_path / "k.yaml"
    path.write_text(text)
    with pytest.raises(DhcalError, match=r"k\.yaml: ") as caught:
        read_ur_kinematics(path)
    assert "\n" not in str(caught.value)


def test_a_large_file_is_refused_with_its_limit(tmp_path):
    path = tmp_path / "k.yaml"
    path.write_text("x: 1\n" * 30_000)
    with pytest.raises(DhcalError, match=r"k\.yaml: the file is larger than 128 KiB"):
        read_ur_kinematics(path)


def test_convert_writes_and_reads_ur_kinematics(tmp_path):
    table, yaml_file, urdf = (str(tmp_path / name) for name in ("a.dh.toml", "k.yaml", "b.urdf"))
    Path(table).write_text(dh_text(ur10(factory()), table))
    assert main(["convert", table, yaml_file]) == 0
    assert main(["convert", yaml_file, urdf]) == 0
    q = np.random.default_rng(1).uniform(-2, 2, (30, 6))
    np.testing.assert_allclose(read_robot(urdf).poses(q), ur10(factory()).poses(q), atol=1e-9)


@pytest.mark.parametrize(("offset", "is_held"), [(5e-5, True), (1e-3, False)])
def test_small_offsets_of_the_tip_from_the_last_axis_are_left_out(tmp_path, offset, is_held):
    """A URDF whose joint errors are in its sidecar has small offsets, which the file cannot hold."""
    chain = Chain.from_dh(ur10(factory()))
    motion = se3.exp6(np.array([offset, 0, 0, 0, offset, 0]))
    moved = replace(chain, origins=np.concatenate([chain.origins[:-1], [chain.origins[-1] @ motion]]))
    robot = RobotSource(moved, None, None)
    if not is_held:
        with pytest.raises(InvalidArgumentError, match="end on the axis of wrist_3"):
            convert_to_ur_kinematics(robot, tmp_path / "k.yaml")
        return
    converted = convert_to_ur_kinematics(robot, tmp_path / "k.yaml")
    assert converted.notes == [
        "the offset of the tip from the axis of wrist_3, 0.05 mm and 0.05 mrad, is left out"
    ]
    path = tmp_path / "k.yaml"
    path.write_text(converted.text)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 6))
    difference = read_ur_kinematics(path).poses(q) - moved.poses(q)
    assert 0.5 * offset < np.abs(difference).max() <= 1.01 * offset
