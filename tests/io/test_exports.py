"""World joint, tool frame, UR's YAML and the plain table: each read back by somebody else."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml
from robots import DATA, paper, robot_file

from dhcal_pin import se3
from dhcal_pin.cli.main import main
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io.dh_file import dh_text
from dhcal_pin.io.measurement_csv import measurement_text
from dhcal_pin.io.origins_file import origins_text
from dhcal_pin.io.robot import read_robot
from dhcal_pin.io.ur_kinematics import read_ur_kinematics, ur_kinematics, ur_kinematics_text
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.robot.chain import Chain
from dhcal_pin.robot.dh import DHTable
from dhcal_pin.robot.urdf import parse_urdf
from dhcal_pin.robot.urdf_edit import with_tool_frame, with_world

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
def test_factory_deltas_become_a_sane_urdf(deltas):
    """Link origins within 5 cm of nominal, and the tool where the plain DH product has it."""
    nominal, actual = Chain.from_dh(ur10()), Chain.from_dh(ur10(deltas))
    assert np.linalg.norm(link_places(actual) - link_places(nominal), axis=1).max() < 0.05
    assert np.linalg.norm((actual.origins - nominal.origins)[:, :3, 3], axis=1).max() < 0.05
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (500, 6))
    np.testing.assert_allclose(actual.poses(q), ur10(deltas).poses(q), atol=1e-9)


def test_tables_without_cancelling_offsets_stay_rows():
    """The paper's arms keep one DH row an origin, nearly parallel axes and all."""
    for name in ("sim_6dof_actual", "experiment_published", "sim_6dof"):
        table = paper(name)
        np.testing.assert_allclose(Chain.from_dh(table).origins, table.origins(), atol=1e-15)


def test_ur_yaml_is_urs_own():
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


def test_ur_yaml_is_accepted_back(tmp_path):
    table = ur10(factory())
    path = tmp_path / "kinematics.yaml"
    path.write_text(ur_kinematics_text(Chain.from_dh(table)))
    assert set(yaml.safe_load(path.read_text())["kinematics"]) == {
        "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3", "hash",
    }  # fmt: skip
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 6))
    np.testing.assert_allclose(read_ur_kinematics(path).poses(q), table.poses(q), atol=1e-12)


def test_ur_yaml_of_a_ros_urdf_keeps_the_tool():
    """Axes along y in the old description; the flange is where its tool0 is."""
    chain = Chain.from_urdf(robot_file("ur_description/urdf/ur10_robot.urdf"), "tool0")
    pose = np.eye(4)
    q = np.random.default_rng(0).uniform(-3, 3, 6)
    for values, angle in zip(ur_kinematics(chain).values(), q, strict=True):
        xyz, rpy = list(values.values())[:3], list(values.values())[3:]
        pose = pose @ se3.transform(pin.rpy.rpyToMatrix(*rpy), xyz) @ se3.exp6([0, 0, 0, 0, 0, angle])
    np.testing.assert_allclose(pose, chain.poses(q[None])[0], atol=1e-12)


def test_ur_yaml_refuses_others(sim_6dof):
    with pytest.raises(DhcalError, match="need the joints shoulder_pan_joint"):
        ur_kinematics(sim_6dof)


@pytest.mark.parametrize("text", ["a: [", "kinematics: 3", "kinematics:\n  shoulder: {x: 1}", "[]", ""])
def test_wrong_yaml_is_one_line(text, tmp_path):
    path = tmp_path / "k.yaml"
    path.write_text(text)
    with pytest.raises(DhcalError, match=r"k\.yaml: ") as caught:
        read_ur_kinematics(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("mark", ["\n", "\r\n"])
def test_world_and_tool_stand_where_they_were_found(mark, sim_6dof):
    rng = np.random.default_rng(0)
    base, tool = se3.exp6(rng.normal(size=6)), se3.exp6(rng.normal(size=6))
    data = sim_6dof.urdf.data.replace(b"\n", mark.encode())
    with_both = with_tool_frame(with_world(data, base), "tool0", "reflector", tool)
    model = pin.buildModelFromXML(with_both.decode())
    pin_data = model.createData()
    q = rng.uniform(-3, 3, (10, 6))
    for row, pose in zip(q, base @ sim_6dof.poses(q) @ tool, strict=True):
        pin.framesForwardKinematics(model, pin_data, row)
        found = pin_data.oMf[model.getFrameId("reflector", pin.FrameType.BODY)].homogeneous
        np.testing.assert_allclose(found, pose, atol=1e-14)
    assert parse_urdf(with_both, "x").root == "world"
    assert with_both.count(mark.encode()) == with_both.count(b"\n")
    assert with_both.startswith(data[: data.rindex(b"</robot>")])


def test_a_world_that_is_there_takes_up_the_base():
    chain = Chain.from_urdf(robot_file("ur_description/urdf/ur10_robot.urdf"), "tool0")
    base = se3.exp6([1.0, 2, 3, 0.1, 0.2, 0.3])
    placed = Chain.from_urdf(parse_urdf(with_world(chain.urdf.data, base), "x"), "tool0")
    q = np.zeros((1, 6))
    np.testing.assert_allclose(placed.poses(q), base @ chain.poses(q), atol=1e-14)


def test_taken_names_are_refused(sim_6dof):
    with pytest.raises(DhcalError, match="--tool-frame link_3"):
        with_tool_frame(sim_6dof.urdf.data, "tool0", "link_3", np.eye(4))


def test_table_of_origins_is_what_pinocchio_reads(sim_6dof_actual):
    rows = list(csv.DictReader(origins_text(sim_6dof_actual).splitlines()))
    assert [row["joint"] for row in rows] == [*sim_6dof_actual.moving_joints, "tool"]
    for row, origin in zip(rows, sim_6dof_actual.origins, strict=True):
        rotation = pin.rpy.rpyToMatrix(*(float(row[f"{k}[rad]"]) for k in ("roll", "pitch", "yaw")))
        np.testing.assert_allclose(rotation, origin[:3, :3], atol=1e-14)
        np.testing.assert_allclose([float(row[f"{k}[m]"]) for k in "xyz"], origin[:3, 3], atol=0)


# --- through the commands --------------------------------------------------------------------------


@pytest.fixture
def measured(tmp_path):
    """A UR10 somewhere in a hall, with a reflector somewhere on its flange, and its file of poses."""
    robot = tmp_path / "ur10.urdf"
    robot.write_bytes(robot_file("ur_description/urdf/ur10_robot.urdf").read_bytes())
    chain = Chain.from_urdf(robot, "tool0")
    rng = np.random.default_rng(0)
    truth = chain.perturbed_at(
        {0: se3.exp6([1, 2, 0.5, 0.1, 0.2, 2.0]), chain.tool_frame_index: se3.exp6([0.1, 0, 0.05, 0.3, 0, 0])}
        | {2 * j: se3.exp6(1e-3 * rng.normal(size=6)) for j in range(1, 7)}
    )
    q = rng.uniform(-2, 2, (40, 6))
    data = tmp_path / "laser.csv"
    data.write_text(measurement_text(Pose.simulate(truth, q, Noise(), rng), chain))
    return robot, data, truth


def test_calibrate_can_put_both_frames_into_the_urdf(measured, tmp_path):
    robot, data, truth = measured
    out = tmp_path / "out.urdf"
    options = ["--tip", "tool0", "--priors", "none", "--world-joint", "--tool-frame", "reflector"]
    assert main(["calibrate", str(robot), str(data), "-o", str(out), *options]) == 0
    q = np.random.default_rng(1).uniform(-2, 2, (30, 6))
    for tip in ("reflector", "tool0"):
        np.testing.assert_allclose(read_robot(out, tip).poses(q), truth.poses(q), atol=1e-9)
    lines = out.read_bytes().splitlines()
    assert set(robot.read_bytes().splitlines()) - set(lines) <= {
        line for line in robot.read_bytes().splitlines() if b"<origin" in line
    }


def test_convert_writes_and_reads_urs_yaml(tmp_path):
    table, yaml_file, urdf = (str(tmp_path / name) for name in ("a.dh.toml", "k.yaml", "b.urdf"))
    Path(table).write_text(dh_text(ur10(factory()), table))
    assert main(["convert", table, yaml_file]) == 0
    assert main(["convert", yaml_file, urdf]) == 0
    q = np.random.default_rng(1).uniform(-2, 2, (30, 6))
    np.testing.assert_allclose(read_robot(urdf).poses(q), ur10(factory()).poses(q), atol=1e-9)


def test_convert_writes_a_table_of_origins(tmp_path):
    out = tmp_path / "ur10.origins.csv"
    source = robot_file("ur_description/urdf/ur10_robot.urdf")
    assert main(["convert", str(source), str(out), "--tip", "tool0"]) == 0
    rows = {row["joint"]: row for row in csv.DictReader(out.read_text().splitlines())}
    assert float(rows["shoulder_pan_joint"]["z[m]"]) == 0.1273
