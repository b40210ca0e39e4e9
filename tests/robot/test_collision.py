"""Collisions with floor and obstacles, against geometry by hand."""

import numpy as np
import pytest

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.robot import Chain, CollisionChecker, Obstacle, obstacles_from_urdf, parse_urdf
from dhcal_pin.robot.collision import CLEARANCE

# Two links of 0.5 m that turn about y, on a column of 0.3 m: q = 0 points along x, positive angles downwards.
LINK = """<link name="{name}">{shape}</link>
<joint name="j_{name}" type="revolute"><origin xyz="{xyz}"/><parent link="{parent}"/><child link="{name}"/>
<axis xyz="{axis}"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>"""
BAR = """<collision><origin xyz="0.25 0 0" rpy="0 1.5707963267948966 0"/>
<geometry><cylinder radius="0.02" length="0.5"/></geometry></collision>"""
COLUMN = """<collision><origin xyz="0 0 -0.15"/><geometry><box size="0.1 0.1 0.3"/></geometry></collision>"""


def arm(with_shapes: bool = True) -> Chain:
    links = [
        ("turret", "base", "0 0 0.3", "0 0 1", COLUMN),
        ("upper", "turret", "0 0 0", "0 1 0", BAR),
        ("lower", "upper", "0.5 0 0", "0 1 0", BAR),
    ]
    body = "".join(
        LINK.format(name=name, parent=parent, xyz=xyz, axis=axis, shape=shape if with_shapes else "")
        for name, parent, xyz, axis, shape in links
    )
    end = """<link name="tip"/><joint name="end" type="fixed"><origin xyz="0.5 0 0"/><parent link="lower"/>
<child link="tip"/></joint>"""
    return Chain.from_urdf(
        parse_urdf(f'<robot name="r"><link name="base"/>{body}{end}</robot>'.encode(), "r")
    )


def lowest_point(q: np.ndarray) -> float:
    """Lowest z of the ends of both bars of the arm, in the plane of the arm."""
    elbow = 0.3 - 0.5 * np.sin(q[1])
    return min(elbow, elbow - 0.5 * np.sin(q[1] + q[2]))


@pytest.mark.parametrize("with_shapes", [True, False])
@pytest.mark.parametrize("height", [-0.2, 0.0])
def test_floor_against_the_lowest_point(with_shapes, height):
    """The column stands on the floor or in it, which is no collision."""
    checker = CollisionChecker.from_chain(arm(with_shapes), [Obstacle.floor(height)])
    seen = set()
    for q in np.random.default_rng(0).uniform(-1.4, 1.4, (400, 3)):
        gap = lowest_point(q) - height - CLEARANCE
        # The bars are 20 mm thick, and so are the lines in their place.
        if abs(gap) > 0.0225:
            assert checker.is_collision_free(q) == (gap > 0)
            seen.add(gap > 0)
    assert seen == {True, False}


def test_box_against_the_distance_of_segments():
    """A pillar beside the arm: the horizontal arm touches it within an interval of the first joint."""
    pillar = Obstacle.box([0.6, -0.05, 0.0], [0.7, 0.05, 1.0])
    checker = CollisionChecker.from_chain(arm(), [pillar])
    # The corner (0.6, 0.05) of the pillar is reached at atan(0.05 / 0.6) plus radius and clearance.
    touching = np.arctan2(0.05, 0.6) + np.arcsin((0.02 + CLEARANCE) / np.hypot(0.6, 0.05))
    angles = np.linspace(-0.5, 0.5, 1001)
    free = np.array([checker.is_collision_free(np.array([angle, 0.0, 0.0])) for angle in angles])
    assert np.abs(angles[~free]).max() == pytest.approx(touching, abs=2e-3)
    assert free.sum() == (np.abs(angles) > np.abs(angles[~free]).max()).sum()


def test_obstacles_are_fixed_and_the_base_is_not_checked():
    """An obstacle around the base, which does not move, is none; the same obstacle farther out is one."""
    around_base = Obstacle.box([-0.1, -0.1, -0.1], [0.1, 0.1, 0.2])
    assert CollisionChecker.from_chain(arm(), [around_base]).is_collision_free(np.array([0.0, -1.2, 0.3]))
    far = Obstacle.box([0.85, -0.1, 0.2], [1.2, 0.1, 0.4])
    checker = CollisionChecker.from_chain(arm(), [around_base, far])
    assert not checker.is_collision_free(np.zeros(3))
    assert checker.is_collision_free(np.array([0.0, -1.2, 0.3]))


def test_the_tool_is_checked_too():
    """A tool beyond the tip is not in the URDF; a line leads to it."""
    chain = arm().with_base_and_tool(np.eye(4), se3.translation([0.4, 0, 0]))
    beyond = Obstacle.box([1.2, -0.1, 0.2], [1.3, 0.1, 0.4])
    assert not CollisionChecker.from_chain(chain, [beyond]).is_collision_free(np.zeros(3))
    assert CollisionChecker.from_chain(arm(), [beyond]).is_collision_free(np.zeros(3))


def test_middle_of_limits_beyond_half_a_turn():
    """A bar to both sides of the elbow collides with the column at 0 and pi, but not at 4.75 rad."""
    text = arm().urdf.data.decode().split('<link name="lower">')
    lower = text[1].replace('xyz="0.25 0 0"', 'xyz="0 0 0"').replace("0.5", "1.1", 1)
    lower = lower.replace('lower="-3" upper="3"', 'lower="3.5" upper="6"')
    chain = Chain.from_urdf(parse_urdf('<link name="lower">'.join([text[0], lower]).encode(), "r"))
    checker = CollisionChecker.from_chain(chain)
    assert checker.is_collision_free(np.array([0.0, 0.0, 4.75]))
    assert not checker.is_collision_free(np.array([0.0, 0.0, np.pi]))


@pytest.mark.parametrize("height", [0.0, 0.3])
def test_line_of_sight_counts_in_the_frame_of_the_chosen_root(height):
    """Instrument and tool are given in the frame of the turret, 0.3 m above that of the obstacles."""
    chain = Chain.from_urdf(arm().urdf, tip="tip", root="turret")
    wall = Obstacle.box([1.4, -0.5, height - 0.1], [1.5, 0.5, height + 0.1])
    checker = CollisionChecker.from_chain(chain, [wall])
    eye, tip = np.array([2.0, 0.0, 0.0]), chain.poses(np.zeros((1, 2)))[0, :3, 3]
    np.testing.assert_allclose(tip, [1.0, 0, 0], atol=1e-12)
    assert checker.has_line_of_sight(np.zeros(2), eye, tip) == (height == 0)


def test_obstacles_block_the_line_of_sight_and_the_floor_does_not():
    eye, point = np.array([3.0, 0, 0.3]), np.array([1.0, 0, 0.3])
    wall = Obstacle.box([1.9, -0.5, 0.0], [2.0, 0.5, 1.0])
    for obstacles, is_visible in (([wall], False), ([Obstacle.floor(0.5)], True)):
        checker = CollisionChecker.from_chain(arm(), obstacles)
        assert checker.has_line_of_sight(np.zeros(3), eye, point) == is_visible


def test_a_scene_has_its_shapes_where_pinocchio_places_them():
    scene = """<robot name="cell"><link name="cell"/><link name="post"><collision><origin xyz="0 0 0.5"/>
<geometry><cylinder radius="0.05" length="1"/></geometry></collision></link><joint name="a" type="fixed">
<origin xyz="0.7 0.2 0" rpy="0 0 1"/><parent link="cell"/><child link="post"/></joint></robot>"""
    (post,) = obstacles_from_urdf(parse_urdf(scene.encode(), "cell.urdf"))
    assert post.name == "post"
    np.testing.assert_allclose(post.placement[:3, 3], [0.7, 0.2, 0.5], atol=1e-15)
    checker = CollisionChecker.from_chain(arm(), [post])
    towards = np.arctan2(0.2, 0.7)
    assert not checker.is_collision_free(np.array([towards, 0.0, 0.0]))
    assert checker.is_collision_free(np.array([-towards, 0.0, 0.0]))


def test_scenes_without_shapes_are_refused():
    with pytest.raises(
        DhcalError, match=r"^cell.urdf: the URDF has no collision geometry; expected obstacles"
    ):
        obstacles_from_urdf(parse_urdf(b'<robot name="c"><link name="c"/></robot>', "cell.urdf"))
    text = """<robot name="c"><link name="c"><collision><geometry><mesh filename="package://cell/wall.stl"/>
</geometry></collision></link></robot>"""
    with pytest.raises(DhcalError, match=r"^cell.urdf: a mesh is missing.*package cell with --package-dir"):
        obstacles_from_urdf(parse_urdf(text.encode(), "cell.urdf"))
