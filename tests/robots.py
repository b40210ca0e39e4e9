"""Robots that tests share: the paper's tables, robots of example-robot-data, random arms."""

import os
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from dhcal_pin import se3
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.io import read_dh
from dhcal_pin.robot import Chain, DHTable, parse_urdf

ROOT = Path(__file__).resolve().parents[1]
URDF = ROOT / "urdf"
# Column maps of real measurements, and the folder beside the project that holds the measurements.
MAPS = ROOT / "tests" / "maps"
DATA = ROOT.parent / "shared" / "data"


# A revolute and a prismatic joint, as a DH file in millimetres and degrees.
SCARA = """convention = "standard"
[units]
length = "mm"
angle = "deg"
[[joint]]
name = "shoulder"
theta = 0
d = 606.8
a = 325.0
alpha = 0.0
lower = -130.0
[[joint]]
name = "lift"
type = "prismatic"
theta = 30.0
d = 12.5
a = 0.25
alpha = 180.0
lower = -210.0
upper = 0.0
"""


def write(folder: Path, name: str, content: str | bytes) -> Path:
    """Write a file into a folder and return its path."""
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def missing(what: str) -> NoReturn:
    """Skip a test, or fail it if DHCAL_REQUIRE_DATA=1."""
    if os.environ.get("DHCAL_REQUIRE_DATA") == "1":
        pytest.fail(f"missing: {what}")
    pytest.skip(f"missing: {what}")


def paper(name: str) -> DHTable:
    return read_dh(URDF / f"{name}.dh.toml")


def robot_file(path: str) -> Path:
    """A URDF of example-robot-data, by its path under robots/."""
    root = metadata.distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data")
    return Path(str(root)) / "robots" / path


# Arms of example-robot-data: file and tip.
ARMS = {
    "ur3": ("ur_description/urdf/ur3_robot.urdf", "tool0"),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", "tool0"),
    "panda": ("panda_description/urdf/panda.urdf", "panda_link8"),
    "panda_finger": ("panda_description/urdf/panda.urdf", "panda_rightfinger"),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", "link_eef"),
    "baxter": ("baxter_description/urdf/baxter.urdf", "left_hand_link"),
    "kinova": ("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "z1": ("z1_description/urdf/z1.urdf", "gripperMover"),
    "so100": ("so_arm_description/urdf/so100.urdf", "gripper"),
    "so101": ("so_arm_description/urdf/so101.urdf", "gripper_link"),
    "hextilt": ("hextilt_description/urdf/hextilt_flying_arm_5.urdf", "flying_arm_5__gripper"),
    "finger_edu": ("finger_edu_description/robots/finger_edu.urdf", "finger_tip_link"),
    "tiago": ("tiago_description/robots/tiago.urdf", "arm_tool_link"),
    "talos": ("talos_data/robots/talos_left_arm.urdf", "wrist_left_ft_tool_link"),
    "romeo": ("romeo_description/urdf/romeo.urdf", "l_wrist"),
}
UR10 = robot_file(ARMS["ur10"][0])


def nominal_arm(name: str, tip: str | None = None) -> Chain:
    """Read an arm of `ARMS`, to another link than its tip on request."""
    path, usual = ARMS[name]
    return Chain.from_urdf(robot_file(path), tip or usual)


def pinocchio_poses(chain: Chain, q: np.ndarray, link: str | None = None) -> np.ndarray:
    """Compute the poses of a link, or of the tip, in the root of a chain, one configuration at a time."""
    model, out = chain.model, []
    data = model.createData()
    for configuration in chain.configurations(q):
        pin.framesForwardKinematics(model, data, configuration)
        names = (chain.root, link or chain.tip)
        root, own = (data.oMf[model.getFrameId(name, pin.FrameType.BODY)] for name in names)
        out.append((root.inverse() * own).homogeneous)
    return np.array(out)


def random_table(rng: np.random.Generator, convention: str = "standard", size: int | None = None) -> DHTable:
    """A table of revolute and prismatic joints, a metre long at most a link."""
    n = size or int(rng.integers(1, 9))
    zero = np.zeros(n)
    return DHTable(
        convention,  # pyright: ignore[reportArgumentType]
        tuple(f"j{i + 1}" for i in range(n)),
        rng.random(n) < 0.3,
        rng.uniform(-np.pi, np.pi, n),
        rng.uniform(-0.5, 0.5, n),
        rng.uniform(-0.5, 0.5, n),
        rng.uniform(-np.pi, np.pi, n),
        zero,
        zero - np.inf,
        zero + np.inf,
    )


def random_joints(rng: np.random.Generator, table: DHTable, m: int) -> np.ndarray:
    """Any angle, and half a metre of slide each way."""
    return rng.uniform(-1, 1, (m, table.n_joints)) * np.where(table.prismatic, 0.5, np.pi)


def with_masses(chain: Chain, rng: np.random.Generator) -> Chain:
    """The same arm with some kilograms on every link, off its axes."""
    root = ElementTree.fromstring(chain.urdf.data)
    for link in root.iter("link"):
        for old in link.findall("inertial"):
            link.remove(old)
        xyz = " ".join(map(repr, rng.uniform(-0.2, 0.2, 3).tolist()))
        link.append(
            ElementTree.fromstring(
                f'<inertial><origin xyz="{xyz}"/><mass value="{rng.uniform(1, 3)}"/>'
                '<inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial>'
            )
        )
    heavy = Chain.from_urdf(parse_urdf(ElementTree.tostring(root), "heavy.urdf"), chain.tip)
    return replace(heavy, parameters=chain.parameters)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Draw a rotation matrix, uniformly distributed."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def with_random_frames(chain: Chain, rng: np.random.Generator) -> Chain:
    """Move the base by up to five metres and the tool by up to half a metre, both turned at random."""
    offset = lambda reach: reach * rng.uniform(-1, 1, 3) / np.sqrt(3)  # noqa: E731
    base = se3.transform(random_rotation(rng), offset(5.0))
    tool = se3.transform(random_rotation(rng), offset(0.5))
    return chain.perturbed_at({0: base, chain.tool_frame_index: tool})


def with_small_errors(chain: Chain, rng: np.random.Generator, size: float = 1e-3) -> Chain:
    """Return an arm with errors of a size [m] and [rad], which nobody takes for mixed-up measurements."""
    errors = select_parameters(chain, chain.parameters)
    return errors.at(size * rng.standard_normal(len(errors.parameters)))


def measured_arm(name: str) -> Chain:
    """Return an arm for statistical tests: "paper", "slide" (with a prismatic joint), "ur5" or "panda"."""
    if name == "paper":
        return Chain.from_dh(paper("sim_6dof"))
    if name == "slide":
        zero, free = np.zeros(5), np.full(5, np.inf)
        return Chain.from_dh(
            DHTable(
                "standard",
                ("j1", "j2", "j3", "j4", "j5"),
                np.array([False, False, True, False, False]),
                np.array([0, 0, np.pi / 2, 0, 0]),
                np.array([0.4, 0.1, 0.5, 0.2, 0.1]),
                np.array([0.1, 0.3, 0, 0.05, 0]),
                np.array([np.pi / 2, np.pi / 2, 0.3, -np.pi / 2, 0]),
                zero,
                -free,
                free,
            )
        )
    return nominal_arm(name)


def joint_sample(chain: Chain, m: int, rng: np.random.Generator) -> np.ndarray:
    """Draw joint positions (m, n) within the limits, at most a full turn or 0.8 m."""
    low = np.where(chain.prismatic, -0.4, np.fmax(chain.lower, -np.pi))
    high = np.where(chain.prismatic, 0.4, np.fmin(chain.upper, np.pi))
    return rng.uniform(low, high, (m, chain.n_joints))
