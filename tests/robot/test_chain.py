"""The vectorised chain against Pinocchio, the plain DH product, and finite differences."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from robots import paper, random_joints, random_table

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.robot.chain import Chain, twists_in_bodies
from dhcal_pin.robot.dh import CONVENTIONS
from dhcal_pin.robot.urdf import parse_urdf


def pinocchio_poses(chain: Chain, q):
    """Base link to tip, a configuration at a time."""
    model = chain.model
    data = model.createData()
    frame = model.getFrameId(chain.tip, pin.FrameType.BODY)
    out = []
    for configuration in chain.configurations(q):
        pin.framesForwardKinematics(model, data, configuration)
        out.append(data.oMf[frame].homogeneous)
    return np.array(out)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_dh_to_urdf_to_pinocchio_is_the_dh_product(convention):
    rng = np.random.default_rng(11)
    worst = 0.0
    for _ in range(100):
        table = random_table(rng, convention)
        chain = Chain.from_dh(table)
        q = random_joints(rng, table, 5)
        plain = table.poses(q)
        worst = max(
            worst, np.abs(pinocchio_poses(chain, q) - plain).max(), np.abs(chain.poses(q) - plain).max()
        )
    assert worst <= 1e-14


def test_base_and_tool_stand_outside():
    rng = np.random.default_rng(2)
    table = random_table(rng, size=4)
    chain = Chain.from_dh(table)
    base, tool = se3.exp6(rng.normal(size=6)), se3.exp6(rng.normal(size=6))
    q = rng.uniform(-1, 1, (7, 4))
    placed = chain.perturbed_at({0: base, chain.tool_frame_index: tool})
    np.testing.assert_allclose(placed.poses(q), base @ table.poses(q) @ tool, atol=1e-14)
    np.testing.assert_array_equal(placed.origins, chain.origins)


def test_model_carries_the_moved_placements():
    rng = np.random.default_rng(3)
    chain = Chain.from_dh(paper("sim_6dof"))
    moved = chain.perturbed_at(
        {s: se3.exp6(0.05 * rng.normal(size=6)) for s in range(1, chain.tool_frame_index)}
    )
    q = rng.uniform(-np.pi, np.pi, (20, 6))
    np.testing.assert_allclose(moved.poses(q), pinocchio_poses(moved, q), atol=1e-14)
    assert np.abs(moved.poses(q) - chain.poses(q)).max() > 1e-3
    np.testing.assert_allclose(moved.model.jointPlacements[3].homogeneous, moved.origins[2], atol=0)


ROBOT = """<robot name="r">
  <link name="base"/><link name="a"/><link name="b"/><link name="c"/><link name="end"/><link name="side"/>
  <joint name="one" type="revolute"><parent link="base"/><child link="a"/><origin xyz="0 0 .3" rpy="0 .2 0"/>
    <axis xyz="1 2 -3"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="two" type="prismatic"><parent link="a"/><child link="b"/><origin xyz=".1 0 0" rpy="1 0 0"/>
    <axis xyz="0 -1 0"/><limit lower="-.2" upper=".3" effort="1" velocity="1"/></joint>
  <joint name="glue" type="fixed"><parent link="b"/><child link="c"/>
    <origin xyz="0 .1 0" rpy="0 0 1"/></joint>
  <joint name="end" type="continuous"><parent link="c"/><child link="end"/><origin xyz="0 0 .2"/>
    <axis xyz="0 1 0"/>{mimic}</joint>
  <joint name="out" type="revolute"><parent link="a"/><child link="side"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""


def test_any_axis_any_joint_and_shared_names():
    chain = Chain.from_urdf(parse_urdf(ROBOT.format(mimic="").encode(), "r.urdf"))
    assert chain.tip == "end"
    assert chain.joint_names == ("one", "two", "end")
    q = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    np.testing.assert_allclose(chain.poses(q), pinocchio_poses(chain, q), atol=1e-15)
    np.testing.assert_array_equal(chain.upper, [2, 0.3, np.inf])


def test_mimic_joint_follows_its_source():
    mimic = '<mimic joint="out" multiplier="-2" offset=".5"/>'
    chain = Chain.from_urdf(parse_urdf(ROBOT.format(mimic=mimic).encode(), "r.urdf"), "end")
    assert chain.joint_names == ("one", "two", "out")
    free = Chain.from_urdf(parse_urdf(ROBOT.format(mimic="").encode(), "r.urdf"), "end")
    q = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    followed = np.column_stack([q[:, :2], 0.5 - 2 * q[:, 2]])
    np.testing.assert_allclose(chain.poses(q), pinocchio_poses(free, followed), atol=1e-15)


def test_mimic_of_nothing_matters_on_the_path_only():
    text = ROBOT.format(mimic='<mimic joint="nobody"/>')
    with pytest.raises(
        DhcalError, match=r"r.urdf:9: joint 'end': it mimics 'nobody', which is no joint that"
    ):
        Chain.from_urdf(parse_urdf(text.encode(), "r.urdf"), "end")
    assert Chain.from_urdf(parse_urdf(text.encode(), "r.urdf"), "side").joint_names == ("one", "out")


def test_a_joint_cannot_mimic_one_that_stands_still():
    text = ROBOT.format(mimic='<mimic joint="glue"/>')
    with pytest.raises(DhcalError, match=r"r.urdf:9: joint 'end': it mimics 'glue', which is no joint that"):
        Chain.from_urdf(parse_urdf(text.encode(), "r.urdf"), "end")


def test_a_mimic_that_takes_nothing_of_its_source_stands_still():
    text = ROBOT.format(mimic='<mimic joint="out" multiplier="0" offset=".5"/>')
    chain = Chain.from_urdf(parse_urdf(text.encode(), "r.urdf"), "end")
    assert chain.joint_names == ("one", "two")
    free = Chain.from_urdf(parse_urdf(ROBOT.format(mimic="").encode(), "r.urdf"), "end")
    q = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    held = np.column_stack([q, np.full(20, 0.5)])
    np.testing.assert_allclose(chain.poses(q), pinocchio_poses(free, held), atol=1e-15)


@pytest.mark.parametrize(
    ("old", "new", "tip", "message"),
    [
        ('"continuous"', '"floating"', "end", "r.urdf:9: joint 'end' is floating.*: make it fixed"),
        ('"continuous"', '"fixed"', "base", "no moving joint between 'base' and 'base'; choose a tip behind"),
    ],
)
def test_paths_that_cannot_be_calibrated_say_what_would(old, new, tip, message):
    text = ROBOT.format(mimic="").replace(old, new)
    with pytest.raises(DhcalError, match=message):
        Chain.from_urdf(parse_urdf(text.encode(), "r.urdf"), tip)


@pytest.mark.parametrize("count", [64, 65])
def test_nobody_calibrates_a_rope(count):
    """Commands take minutes on a path of hundreds of joints; it ends where no arm is."""
    links = "".join(f'<link name="l{i}"/>' for i in range(count + 1))
    joints = "".join(
        f'<joint name="j{i}" type="continuous"><parent link="l{i}"/><child link="l{i + 1}"/></joint>'
        for i in range(count)
    )
    urdf = parse_urdf(f'<robot name="rope">{links}{joints}</robot>'.encode(), "rope.urdf")
    if count == 64:
        assert Chain.from_urdf(urdf).n_joints == 64
        return
    with pytest.raises(DhcalError, match=r"65 moving joints between 'l0' and 'l65'; at most 64.*--tip"):
        Chain.from_urdf(urdf)


def test_tabs_and_newlines_between_numbers():
    text = ROBOT.format(mimic="").replace("0 0 .3", "0\t0\n.3")
    wanted = Chain.from_urdf(parse_urdf(ROBOT.format(mimic="").encode(), "r.urdf"), "end")
    found = Chain.from_urdf(parse_urdf(text.encode(), "r.urdf"), "end")
    np.testing.assert_array_equal(found.origins, wanted.origins)


def test_ambiguous_tip_lists_the_choices():
    text = ROBOT.format(mimic="").replace(
        'name="out" type="revolute"><parent link="a"', 'name="out" type="revolute"><parent link="c"'
    )
    with pytest.raises(DhcalError, match=r"--tip: end, side"):
        Chain.from_urdf(parse_urdf(text.encode(), "r.urdf"))


def test_wrong_joint_values_are_named(sim_6dof):
    with pytest.raises(DhcalError, match=r"needs 6 columns: joint_1"):
        sim_6dof.poses(np.zeros((3, 5)))
    with pytest.raises(DhcalError, match="finite"):
        sim_6dof.poses(np.full((1, 6), np.nan))


def test_velocities_are_the_derivative_of_poses(sim_6dof_actual):
    """Every station, all six directions, by central differences of displaced chains."""
    chain = sim_6dof_actual
    rng = np.random.default_rng(4)
    chain = chain.perturbed_at(
        {0: se3.exp6(rng.normal(size=6)), chain.tool_frame_index: se3.exp6(rng.normal(size=6))}
    )
    q, h = rng.uniform(-np.pi, np.pi, (10, 6)), 1e-6
    stations = np.repeat(np.arange(chain.tool_frame_index + 1), 6)
    twists = np.tile(np.eye(6), (chain.tool_frame_index + 1, 1))
    bodies, moved = twists_in_bodies(chain, stations, twists)
    velocities = chain.tool_jacobian(chain.forward_kinematics(q), bodies, moved)
    for k, (station, twist) in enumerate(zip(stations, twists, strict=True)):
        up, down = (chain.perturbed_at({int(station): se3.exp6(s * h * twist)}).poses(q) for s in (1, -1))
        linear = (up - down)[:, :3, 3] / (2 * h)
        angular = se3.log3(up[:, :3, :3] @ np.swapaxes(down[:, :3, :3], 1, 2)) / (2 * h)
        np.testing.assert_allclose(velocities[k].T, np.concatenate([linear, angular], 1), atol=2e-9)
