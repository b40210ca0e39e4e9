"""URDF text of DH tables, as other libraries read it."""

import re
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from dhcal_pin import se3
from dhcal_pin.robot import DHTable, dh_to_urdf
from dhcal_pin.robot.dh import CONVENTIONS

ORIGINS = re.compile(r'<joint name="[^"]*" type="[a-z]+">\n +<origin xyz="([^"]*)" rpy="([^"]*)"/>')


def arm(alpha, a, d, convention="standard", theta=None, prismatic=None, lower=None, upper=None, **frames):
    """A table from degrees and millimetres."""
    n = len(alpha)
    return DHTable(
        convention,  # pyright: ignore[reportArgumentType]
        tuple(f"joint_{i + 1}" for i in range(n)),
        np.zeros(n, bool) if prismatic is None else prismatic,
        np.radians(np.zeros(n) if theta is None else theta),
        np.divide(d, 1e3),
        np.divide(a, 1e3),
        np.radians(alpha),
        np.zeros(n),
        np.full(n, -np.inf) if lower is None else lower,
        np.full(n, np.inf) if upper is None else upper,
        **frames,
    )


def paper_arm():
    return arm((90, 0, 0, -90, 0, 90), (100, 100, 100, 0, 10, 0), (200, 0, 100, 10, 100, 0))


def random_arm(rng):
    """Up to 7 joints within about a metre; quarter turns, zeros, β, base and tool now and then."""
    n = int(rng.integers(1, 8))
    angles = rng.uniform(-np.pi, np.pi, (2, n))
    quarters = rng.integers(-1, 3, (2, n)) * (np.pi / 2)
    theta, alpha = np.where(rng.random((2, n)) < 0.5, quarters, angles)
    d, a = np.where(rng.random((2, n)) < 0.7, rng.uniform(-1, 1, (2, n)) / n, 0.0)
    beta = np.where(rng.random(n) < 0.2, rng.normal(0, 1e-3, n), 0.0)
    frames = {
        k: se3.exp6(np.r_[rng.uniform(-0.3, 0.3, 3), rng.uniform(-1.5, 1.5, 3)]) for k in ("base", "tool")
    }
    prismatic = rng.random(n) < 0.3
    names = tuple(f"j{i}" for i in range(n))
    limits = np.sort(rng.uniform(-0.5, 0.5, (2, n)), axis=0)
    convention = CONVENTIONS[int(rng.integers(2))]
    return DHTable(
        convention,
        names,
        prismatic,
        theta,
        d,
        a,
        alpha,
        beta,
        *limits,
        **(frames if rng.random() < 0.3 else {}),
    )


def pinocchio_poses(text, q):
    model = pin.buildModelFromXML(text)
    data = model.createData()
    tip = model.getFrameId("tool0", pin.FrameType.BODY)
    poses = []
    for values in q:
        pin.framesForwardKinematics(model, data, values)
        poses.append(data.oMf[tip].homogeneous)
    return np.array(poses)


def test_pinocchio_gives_the_poses_of_the_table():
    rng = np.random.default_rng(0)
    worst = 0.0
    for _ in range(200):
        table = random_arm(rng)
        q = rng.uniform(-np.pi, np.pi, (5, table.n_joints))
        q[:, table.prismatic] = rng.uniform(-0.3, 0.3, (5, int(table.prismatic.sum())))
        worst = max(worst, np.abs(pinocchio_poses(dh_to_urdf(table, "arm"), q) - table.poses(q)).max())
    assert worst < 1e-14


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_mujoco_gives_the_poses_of_the_table(convention):
    """No compiler setting is needed to load it; fusestatic keeps the tool's frame apart."""
    table = arm(
        (90, 0, 0, -90, 0, 90),
        (100, 100, 100, 0, 10, 0),
        (200, 0, 100, 10, 100, 0),
        convention,
        theta=(0, 30, 0, 90, 0, 0),
        prismatic=[False, False, True, False, False, False],
    )
    text = dh_to_urdf(table, "arm")
    assert mujoco.MjModel.from_xml_string(text).nq == 6
    kept = text.replace("</robot>", '<mujoco><compiler fusestatic="false"/></mujoco></robot>')
    model = mujoco.MjModel.from_xml_string(kept)
    data = mujoco.MjData(model)
    for q in np.random.default_rng(1).uniform(-1, 1, (10, 6)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        tool = data.body("tool0")
        pose = table.poses(q[None])[0]
        np.testing.assert_allclose(tool.xpos, pose[:3, 3], atol=1e-14)
        np.testing.assert_allclose(tool.xmat.reshape(3, 3), pose[:3, :3], atol=1e-14)


def test_links_joints_and_limits():
    table = arm(
        (0, 0, 0, 0), (100,) * 4, (0,) * 4,
        prismatic=[False, False, True, True],
        lower=[-np.inf, -0.1, -np.inf, 0.2],
        upper=[np.inf, 1 / 3, np.inf, np.inf],
    )  # fmt: skip
    model = pin.buildModelFromXML(dh_to_urdf(table, "arm"))
    assert list(model.names)[1:] == list(table.names)
    bodies = [f.name for f in model.frames if f.type == pin.FrameType.BODY]
    assert bodies == ["base_link", "link_1", "link_2", "link_3", "link_4", "tool0"]
    assert model.lowerPositionLimit.tolist() == [-2 * np.pi, -0.1, -10.0, 0.2]
    assert model.upperPositionLimit.tolist() == [2 * np.pi, 1 / 3, 10.0, 10.2]
    assert model.nq == model.nv == 4


def test_one_sided_limits_are_completed_in_order():
    table = arm((0, 0), (100, 100), (0, 0), lower=[8.0, -np.inf], upper=[np.inf, -8.0])
    model = pin.buildModelFromXML(dh_to_urdf(table, "arm"))
    assert np.all(model.lowerPositionLimit < model.upperPositionLimit)
    assert (model.lowerPositionLimit[0], model.upperPositionLimit[1]) == (8.0, -8.0)


def test_numbers_have_no_rounding_errors_or_negative_zeros():
    """Right angles and zeros as people write them, and every origin a row of the table."""
    found = ORIGINS.findall(dh_to_urdf(paper_arm(), "arm"))
    quarter = "1.5707963267948966"
    assert found == [
        ("0.0 0.0 0.0", "0.0 0.0 0.0"),
        ("0.1 0.0 0.2", f"{quarter} 0.0 0.0"),
        ("0.1 0.0 0.0", "0.0 0.0 0.0"),
        ("0.1 0.0 0.1", "0.0 0.0 0.0"),
        ("0.0 0.0 0.01", f"-{quarter} 0.0 0.0"),
        ("0.01 0.0 0.1", "0.0 0.0 0.0"),
        ("0.0 0.0 0.0", f"{quarter} 0.0 0.0"),
    ]


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_quarter_turns_are_exact(convention):
    """All combinations of right angles, pitch ±90° among them, read back to rounding and are never -0.0."""
    turns = np.array([(t, a) for t in (-90, 0, 90, 180) for a in (-90, 0, 90, 180)])
    table = arm(turns[:, 1], [100] * 16, [50] * 16, convention, theta=turns[:, 0])
    text = dh_to_urdf(table, "arm")
    numbers = [float(v) for _, rpy in ORIGINS.findall(text) for v in rpy.split()]
    assert set(numbers) <= {0.0, np.pi / 2, -np.pi / 2, np.pi, -np.pi}
    assert not re.search(r'[" ]-0(\.0)?[" ]', text)
    q = np.random.default_rng(2).uniform(-1, 1, (5, 16))
    np.testing.assert_allclose(pinocchio_poses(text, q), table.poses(q), atol=1e-14)


def test_pitch_near_a_quarter_turn_loses_no_digits():
    """Modified rows put θ behind α: pitch is ±90° to within any small angle."""
    for angle in (1e-3, 1e-6, 1e-8, 1e-12):
        near = 90 - np.degrees(angle)
        table = arm((near, -near), (100, 100), (50, 50), "modified", theta=(near, 90))
        q = np.array([[0.3, -0.4]])
        np.testing.assert_allclose(pinocchio_poses(dh_to_urdf(table, "arm"), q), table.poses(q), atol=2e-15)


def test_names_are_escaped_and_unique():
    """A joint called tool, one called like a link, and characters that XML reserves."""
    names = ("tool", "link_1", 'a<b>&"c"')
    plain = arm((90, 0, 0), (0, 400, 345), (433, 0, 0))
    table = DHTable(
        plain.convention, names, plain.prismatic, plain.theta, plain.d, plain.a, plain.alpha, plain.beta,
        plain.lower, plain.upper,
    )  # fmt: skip
    text = dh_to_urdf(table, 'R&D -- "arm"')
    model = pin.buildModelFromXML(text)
    assert list(model.names)[1:] == list(names)
    assert ET.fromstring(text).get("name") == 'R&D -- "arm"'
    q = np.array([[0.1, 0.2, 0.3]])
    np.testing.assert_allclose(pinocchio_poses(text, q), table.poses(q), atol=1e-15)


def attributes(element: ET.Element, path: str) -> dict[str, str]:
    """The attributes of the first descendant on a path."""
    child = element.find(path)
    assert child is not None, path
    return child.attrib


def test_drawing_follows_the_rows():
    """Every segment of the drawing starts where the last one ended; zero lengths draw nothing."""
    robot = ET.fromstring(dh_to_urdf(paper_arm(), "arm"))
    materials = {m.get("name") for m in robot.findall("material")}
    used = [m.get("name") for m in robot.findall("link/visual/material")]
    assert set(used) <= materials
    # d: 200, 100, 10 and 100 mm; a: four of them; one drum a joint; three arrows at the tool.
    counts = [used.count(m) for m in ("along_d", "along_a", "revolute", "x_axis", "y_axis", "z_axis")]
    assert counts == [4, 4, 6, 1, 1, 1]
    lengths = [float(c.attrib["length"]) for c in robot.findall("link/visual/geometry/cylinder")]
    assert min(lengths) > 0
    shapes = {g[0].tag for g in robot.findall("link/visual/geometry")}
    assert shapes == {"cylinder", "sphere"}
    ends = []
    for link in robot.findall("link")[1:-1]:
        corner = np.zeros(3)
        for visual in link.findall("visual"):
            if attributes(visual, "material")["name"] in ("along_d", "along_a"):
                origin = attributes(visual, "origin")
                middle = np.array(origin["xyz"].split(), float)
                rpy = np.array(origin["rpy"].split(), float)
                length = float(attributes(visual, "geometry/cylinder")["length"])
                half = pin.rpy.rpyToMatrix(*rpy)[:, 2] * length / 2
                np.testing.assert_allclose(middle - half, corner, atol=1e-5)
                corner = middle + half
        ends.append(corner)
    np.testing.assert_allclose(ends, paper_arm().origins()[1:, :3, 3], atol=1e-5)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_prismatic_joint_is_drawn_on_the_link_before_it(convention):
    slide = [False, True, False]
    limits = {"lower": [-1, 0, -1], "upper": [1, 0.3, 1]}
    table = arm((0, 180, 0), (300, 200, 0), (400, 0, 50), convention, prismatic=slide, **limits)
    robot = ET.fromstring(dh_to_urdf(table, "arm"))
    links = {
        link.get("name"): [m.get("name") for m in link.findall("visual/material")]
        for link in robot.findall("link")
    }
    assert [name for name, used in links.items() if "prismatic" in used] == ["link_1"]
    assert "revolute" not in links["link_2"]
    assert links["link_2"].count("along_d") == 1 + (convention == "modified")


def test_table_of_zeros_can_be_loaded():
    model = pin.buildModelFromXML(dh_to_urdf(arm((0, 90), (0, 0), (0, 0)), "point"))
    assert model.nq == 2
