"""Order of poses and moves between them, for an arm whose collisions are computed by hand."""

from itertools import pairwise

import numpy as np
import pytest

from dhcal_pin.measurements import Noise
from dhcal_pin.planning import plan
from dhcal_pin.planning.tour import find_tour, find_way, is_move_free
from dhcal_pin.robot import Chain, CollisionChecker, Obstacle, WorkspaceConstraints, parse_urdf
from dhcal_pin.robot.collision import CLEARANCE
from dhcal_pin.robot.sampling import joint_range, random_configurations

RADIUS = 0.02
# A horizontal bar of 0.8 m that turns about a vertical axis and slides up and down.
ARM = f"""<robot name="r"><link name="base"/><link name="car"/>
<link name="bar"><collision><origin xyz="0.4 0 0" rpy="0 1.5707963267948966 0"/>
<geometry><cylinder radius="{RADIUS}" length="0.8"/></geometry></collision></link>
<joint name="lift" type="prismatic"><parent link="base"/><child link="car"/><axis xyz="0 0 1"/>
<limit lower="0.1" upper="1.1" effort="1" velocity="1"/></joint>
<joint name="turn" type="revolute"><parent link="car"/><child link="bar"/><axis xyz="0 0 1"/>
<limit lower="-6.2" upper="6.2" effort="1" velocity="1"/></joint>
<link name="tip"/><joint name="end" type="fixed"><origin xyz="0.8 0 0"/><parent link="bar"/>
<child link="tip"/></joint></robot>"""
# A wall of 0.6 m height along x.
WALL = ((0.4, -0.05, 0.0), (1.0, 0.05, 0.6))
NO_TURNS, TURNS = np.zeros(2, bool), np.array([False, True])


def checker_of(*boxes) -> CollisionChecker:
    chain = Chain.from_urdf(parse_urdf(ARM.encode(), "r"))
    return CollisionChecker.from_chain(chain, [Obstacle.box(box[0], box[1]) for box in boxes])


def collides(q, samples: int = 400) -> bool:
    """Distance of points on the axis of the bar from the wall; ends of the bar are round by this measure."""
    lift, turn = q
    along = np.linspace(0.0, 0.8, samples)
    points = np.stack([along * np.cos(turn), along * np.sin(turn), np.full(samples, lift)], -1)
    outside = np.maximum(np.maximum(np.array(WALL[0]) - points, points - np.array(WALL[1])), 0)
    return bool(np.linalg.norm(outside, axis=1).min() < RADIUS + CLEARANCE)


def assert_free(path):
    """No configuration on the straight moves of a path collides; a millimetre of rounding is allowed."""
    for start, end in pairwise(path):
        for share in np.linspace(0, 1, 500):
            q = start + share * (end - start)
            assert not (collides(q) and collides(q + np.array([1e-3, 0.0])))


def limits(checker):
    return checker.chain.lower, checker.chain.upper


def test_moves_are_checked_along_the_whole_line():
    checker, rng = checker_of(WALL), np.random.default_rng(0)
    seen = {True: 0, False: 0}
    for _ in range(60):
        start, end = rng.uniform([0.1, -1.5], [1.1, 1.5], (2, 2))
        line = start + np.linspace(0, 1, 300)[:, None] * (end - start)
        hits = [collides(q) for q in line]
        # Cases within the resolution of the check are left out.
        if any(hits) != any(
            collides(q - np.array([0.02, 0])) or collides(q + np.array([0, 0.02])) for q in line
        ):
            continue
        found = is_move_free(checker, start, end)
        assert found == (not any(hits))
        assert is_move_free(checker, end, start) == found
        seen[found] += 1
    assert min(seen.values()) > 10


def test_way_points_lead_over_the_wall():
    checker = checker_of(WALL)
    start, end = np.array([0.2, -0.5]), np.array([0.2, 0.5])
    assert not is_move_free(checker, start, end)
    # The bar could also turn the other way round, by less than a whole turn in total.
    way = find_way(checker, start, end, np.array([0.1, -1.0]), np.array([1.1, 1.0]), np.random.default_rng(0))
    assert len(way) >= 1
    assert way[:, 0].max() > 0.6 + RADIUS
    assert_free([start, *way, end])


def test_way_points_are_within_two_turns_where_a_joint_has_no_limits():
    """Random configurations of an unlimited range would be too far away to lead anywhere."""
    checker = checker_of(WALL)
    start, end = np.array([0.2, -0.5]), np.array([0.2, 0.5])
    low, high = np.array([0.1, -np.inf]), np.array([1.1, np.inf])
    for seed in range(5):
        way = find_way(checker, start, end, low, high, np.random.default_rng(seed))
        assert len(way) >= 1
        assert np.abs(way[:, 1]).max() <= 2 * np.pi
        assert_free([start, *way, end])


def test_no_way_is_found_where_there_is_none():
    checker = checker_of((WALL[0], (1.0, 0.05, 3.0)))
    low, high = np.array([0.1, -1.0]), np.array([1.1, 1.0])
    way = find_way(checker, np.array([0.2, -0.5]), np.array([0.2, 0.5]), low, high, np.random.default_rng(0))
    assert way.shape == (0, 2)


def test_order_avoids_the_wall():
    """Poses on both sides below and above the wall: the tour changes sides above it."""
    checker = checker_of(WALL)
    q = np.array([[z, side * turn] for turn in (0.4, 0.8) for z in (0.2, 0.5, 0.9) for side in (-1, 1)])
    q = q[np.random.default_rng(0).permutation(len(q))]
    tour = find_tour(q, checker, *limits(checker), NO_TURNS, np.random.default_rng(0))
    assert sorted(tour.order.tolist()) == list(range(len(q)))
    np.testing.assert_array_equal(tour.q, q[tour.order])
    assert all(tour.is_way_free)
    assert not any(len(way) for way in tour.ways)
    assert_free(tour.q)


def test_way_points_where_no_order_avoids_the_wall():
    checker = checker_of(WALL)
    q = np.array([[0.2, -0.4], [0.3, -0.6], [0.2, 0.4], [0.3, 0.6]])
    tour = find_tour(q, checker, *limits(checker), NO_TURNS, np.random.default_rng(0))
    assert all(tour.is_way_free)
    assert sum(len(way) > 0 for way in tour.ways) == 1
    assert_free([p for way, pose in zip(tour.ways, tour.q, strict=True) for p in (*way, pose)])


def test_whole_turns_avoid_a_wall_that_has_no_way_over_it():
    """Three poses stand behind the wall as seen from the others, and are reached by the other way round."""
    checker = checker_of((WALL[0], (1.0, 0.05, 3.0)))
    q = np.array([[0.5, turn] for turn in (-1.0, -1.5, -2.0, -2.5, 0.5, 1.0)])
    turned = find_tour(q, checker, *limits(checker), TURNS, np.random.default_rng(0))
    assert all(turned.is_way_free)
    moved = np.round((turned.q - q[turned.order])[:, 1] / (2 * np.pi), 12)
    assert set(moved[np.isin(turned.order, [4, 5])]) == {-1.0}
    assert set(moved[~np.isin(turned.order, [4, 5])]) == {0.0}
    assert not turned.q[:, 1].max() > 0


def test_moves_that_cannot_be_freed_are_named():
    checker = checker_of((WALL[0], (1.0, 0.05, 3.0)), ((-1.0, -0.05, 0.0), (-0.1, 0.05, 3.0)))
    q = np.array([[0.5, turn] for turn in (-1.0, -1.5, 0.8, 1.2)])
    tour = find_tour(q, checker, *limits(checker), TURNS, np.random.default_rng(0))
    assert tour.is_way_free[0]
    assert sum(tour.is_way_free) == 3
    blocked = tour.is_way_free.index(False)
    assert np.sign(tour.q[blocked, 1]) != np.sign(tour.q[blocked - 1, 1])


def test_poses_without_anything_to_collide_with_have_a_short_tour():
    q = np.random.default_rng(0).uniform([0.1, -3], [1.1, 3], (30, 2))
    tour = find_tour(q, checker_of(), *limits(checker_of()), TURNS, np.random.default_rng(0))
    assert all(tour.is_way_free)
    length = np.linalg.norm(np.diff(tour.q, axis=0) * [2 * np.pi, 1], axis=1).sum()
    assert length < 0.5 * np.linalg.norm(np.diff(q, axis=0) * [2 * np.pi, 1], axis=1).sum()


@pytest.mark.parametrize("candidates", [200, "given"])
def test_plans_have_free_moves_around_obstacles(candidates):
    chain = Chain.from_urdf("example:ur10", "tool0")
    space = WorkspaceConstraints(floor=0.0, obstacles=[Obstacle.box([0.4, -1.0, 0.0], [1.2, -0.3, 0.4])])
    checker = CollisionChecker.from_chain(chain, space.environment)
    if candidates == "given":
        q = np.random.default_rng(0).uniform(-3, 3, (400, 6))
        candidates = np.array([pose for pose in q if checker.is_collision_free(pose)])
    result = plan(chain, 8, candidates=candidates, space=space, noise=Noise(1e-4, 2e-4))
    assert len(result.is_way_free) == len(result.ways) == 8
    path = [p for way, pose in zip(result.ways, result.q, strict=True) for p in (*way, pose)]
    if all(result.is_way_free):
        for start, end in pairwise(path):
            for share in np.linspace(0, 1, 40):
                assert checker.is_collision_free(start + share * (end - start))
    if result.index is not None:
        # Given candidates keep their values.
        np.testing.assert_array_equal(result.q, candidates[result.index])


@pytest.mark.parametrize(
    ("limits", "expected"),
    [((0.1, 4.1), (0.1, 4.1)), ((-1e4, 1e4), (-0.5, 0.5)), ((2.0, 1e4), (2.0, 3.0))],
)
def test_configurations_use_the_whole_stroke_within_limits(limits, expected):
    """Limits that are kilometres apart are no limits; a joint without limits moves half a metre."""
    low, high = limits
    text = ARM.replace('lower="0.1" upper="1.1"', f'lower="{low}" upper="{high}"')
    chain = Chain.from_urdf(parse_urdf(text.encode(), "r"))
    found = [each[0] for each in joint_range(chain)]
    np.testing.assert_allclose(found, expected)
    drawn = random_configurations(chain, 1000)[:, 0]
    share = (drawn - expected[0]) / (expected[1] - expected[0])
    assert share.min() < 0.01
    assert share.max() > 0.99
