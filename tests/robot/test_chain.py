"""Chain: kinematics against Pinocchio, the DH product and finite differences; refused arguments."""

import numpy as np
import pytest
from robots import paper, pinocchio_poses, random_joints, random_table

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError, InvalidArgumentError
from dhcal_pin.robot import Chain, Payload, Transmission, parse_urdf
from dhcal_pin.robot.chain import twists_in_bodies
from dhcal_pin.robot.dh import CONVENTIONS


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


def test_base_and_tool_do_not_change_the_origins():
    rng = np.random.default_rng(2)
    table = random_table(rng, size=4)
    chain = Chain.from_dh(table)
    base, tool = se3.exp6(rng.normal(size=6)), se3.exp6(rng.normal(size=6))
    q = rng.uniform(-1, 1, (7, 4))
    placed = chain.perturbed_at({0: base, chain.tool_frame_index: tool})
    np.testing.assert_allclose(placed.poses(q), base @ table.poses(q) @ tool, atol=1e-14)
    np.testing.assert_array_equal(placed.origins, chain.origins)


def test_pinocchio_model_has_the_perturbed_origins():
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


def test_chain_with_any_axes_and_a_joint_named_like_its_link():
    chain = Chain.from_urdf(parse_urdf(ROBOT.format(mimic="").encode(), "r.urdf"))
    assert chain.tip == "end"
    assert chain.joint_names == ("one", "two", "end")
    q = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    np.testing.assert_allclose(chain.poses(q), pinocchio_poses(chain, q), atol=1e-15)
    np.testing.assert_array_equal(chain.upper, [2, 0.3, np.inf])


def test_mimic_joint_moves_with_its_source():
    mimic = '<mimic joint="out" multiplier="-2" offset=".5"/>'
    chain = Chain.from_urdf(parse_urdf(ROBOT.format(mimic=mimic).encode(), "r.urdf"), "end")
    assert chain.joint_names == ("one", "two", "out")
    free = Chain.from_urdf(parse_urdf(ROBOT.format(mimic="").encode(), "r.urdf"), "end")
    q = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    followed = np.column_stack([q[:, :2], 0.5 - 2 * q[:, 2]])
    np.testing.assert_allclose(chain.poses(q), pinocchio_poses(free, followed), atol=1e-15)


def test_mimic_of_an_unknown_joint_is_refused_on_the_chain_only():
    text = ROBOT.format(mimic='<mimic joint="nobody"/>')
    with pytest.raises(
        DhcalError, match=r"r.urdf:9: joint 'end': it mimics 'nobody', which is not a moving joint"
    ):
        Chain.from_urdf(parse_urdf(text.encode(), "r.urdf"), "end")
    assert Chain.from_urdf(parse_urdf(text.encode(), "r.urdf"), "side").joint_names == ("one", "out")


def test_mimic_of_a_fixed_joint_is_refused():
    text = ROBOT.format(mimic='<mimic joint="glue"/>')
    with pytest.raises(
        DhcalError, match=r"r.urdf:9: joint 'end': it mimics 'glue', which is not a moving joint"
    ):
        Chain.from_urdf(parse_urdf(text.encode(), "r.urdf"), "end")


def test_mimic_with_multiplier_zero_is_constant():
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
        (
            '"continuous"',
            '"fixed"',
            "base",
            "no moving joint between 'base' and 'base'; choose a tip behind moving",
        ),
    ],
)
def test_unsupported_paths_are_refused_with_a_remedy(old, new, tip, message):
    text = ROBOT.format(mimic="").replace(old, new)
    with pytest.raises(DhcalError, match=message):
        Chain.from_urdf(parse_urdf(text.encode(), "r.urdf"), tip)


@pytest.mark.parametrize("count", [64, 65])
def test_at_most_64_moving_joints_are_accepted(count):
    """Commands would take minutes on a chain of hundreds of joints."""
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


def test_ambiguous_tip_is_refused_with_the_choices():
    text = ROBOT.format(mimic="").replace(
        'name="out" type="revolute"><parent link="a"', 'name="out" type="revolute"><parent link="c"'
    )
    with pytest.raises(DhcalError, match=r"--tip: end, side"):
        Chain.from_urdf(parse_urdf(text.encode(), "r.urdf"))


@pytest.mark.parametrize("method", ["poses", "forward_kinematics", "configurations", "joint_state"])
def test_joint_positions_of_another_shape_are_refused(sim_6dof, method):
    for q in (np.zeros((3, 5)), np.zeros(6), 0.0, np.zeros((1, 2, 6))):
        with pytest.raises(
            InvalidArgumentError, match=r"shape \(.*expected shape \(m, 6\).*joint_1, joint_2"
        ):
            getattr(sim_6dof, method)(q)
    with pytest.raises(InvalidArgumentError, match="not finite"):
        getattr(sim_6dof, method)(np.full((1, 6), np.nan))


@pytest.mark.parametrize(
    ("method", "arguments", "message"),
    [
        ("from_urdf", (5,), "source has type int; expected a path or a Urdf"),
        ("from_urdf", ("arm.urdf", 5), "tip has type int; expected the name of a link"),
        ("from_dh", ("arm.dh.toml",), "table has type str; expected a DHTable"),
        ("with_payload", (2.0,), "payload has type float; expected a Payload or None"),
        ("with_transmission", (None,), "transmission has type NoneType; expected a Transmission"),
        ("with_base_and_tool", (np.eye(4), np.eye(3)), r"shapes \(4, 4\) and \(3, 3\); expected \(4, 4\)"),
        ("perturbed", (np.zeros((3, 4, 4)),), r"shape \(3, 4, 4\); expected \(16, 4, 4\)"),
        ("perturbed_at", ({16: np.eye(4)},), "error frame 16 does not exist; expected an index from 0 to 15"),
        ("perturbed_at", ({2: np.eye(3)},), r"error frame 2 has shape \(3, 3\); expected \(4, 4\)"),
    ],
)
def test_wrong_arguments_are_refused(sim_6dof, method, arguments, message):
    with pytest.raises(InvalidArgumentError, match=message):
        getattr(sim_6dof, method)(*arguments)


def test_a_transmission_of_another_chain_is_refused(sim_6dof, sim_3dof):
    with pytest.raises(InvalidArgumentError, match=r"shape \(403,\); expected \(823,\)"):
        sim_6dof.with_transmission(Transmission.zero(sim_3dof.loads))
    assert sim_6dof.with_payload(Payload(1.0)).payload == Payload(1.0)


def test_repr_is_short(sim_6dof):
    assert repr(sim_6dof) == "Chain(name='arm', tip='tool0', n_joints=6)"


def test_tool_jacobian_is_the_derivative_of_the_poses(sim_6dof_actual):
    """All six directions at every error frame, by central differences of perturbed chains."""
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
