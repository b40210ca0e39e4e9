"""Order of the samples of a session, functions of time, and the changes of a robot that they describe."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from robots import nominal_arm

from dhcal_pin import se3
from dhcal_pin.measurements import PointContact, PointDistance, Position
from dhcal_pin.session.causes import HELD_SIZE, Block, Cause, Constant, Drift, FreeDrift, Step
from dhcal_pin.session.robot_changes import JointPaths, Motion, RobotChanges, apply_changes, update
from dhcal_pin.session.timeline import Place, order_samples

NUMBERS = np.arange(5)
TIMES = 2.0 + 2.0 * NUMBERS


def positions(count, source="", first=2, **conditions):
    """Return positions of an arm with two joints that move by different steps."""
    q = np.random.default_rng(first).normal(size=(count, 2))
    item = Position(q, np.zeros((count, 3))).with_conditions(**conditions)
    return item.replace(source=source, rows=np.arange(first, first + count))


def numbers_of(timeline):
    """Return the numbers of the samples of each measurement as lists."""
    return [each.tolist() for each in timeline.numbers]


def test_samples_are_in_the_order_of_files_and_lines_or_of_their_times():
    first, second = positions(3, "a.csv"), positions(2, "b.csv")
    reversed_lines = first.replace(rows=np.array([7, 5, 6]))
    timeline = order_samples((reversed_lines, second), (first.replace(rows=np.array([8, 1, 9])),))
    assert numbers_of(timeline) == [[3, 1, 2], [6, 7], [4, 0, 5]]
    assert (timeline.n_fitted, timeline.unit, timeline.file_starts, timeline.begin) == (2, "row", (6,), 0)
    np.testing.assert_array_equal(timeline.fitted_numbers, [3, 1, 2, 6, 7])
    np.testing.assert_array_equal(timeline.fitted_times, [3.0, 1.0, 2.0, 6.0, 7.0])
    np.testing.assert_array_equal(timeline.q, np.concatenate([item.q for item in timeline.data]))
    assert not timeline.is_of_contacts
    timed = first.with_conditions(time=[1.0, 3.0, 5.0])
    timeline = order_samples((timed, second.with_conditions(time=[2.0, 3.0])), ())
    # Of two samples at one time, the one of the first file comes first.
    assert numbers_of(timeline) == [[0, 2, 4], [1, 3]]
    assert (timeline.unit, timeline.file_starts) == ("s", (1, 2, 3, 4))
    np.testing.assert_array_equal(timeline.fitted_times, [1.0, 3.0, 5.0, 2.0, 3.0])
    # Without the times of one file, those of the other one do not count.
    for other in (second, second.with_conditions(payload=[0.0, 0.0])):
        assert numbers_of(order_samples((timed, other), ())) == [[0, 1, 2], [3, 4]]


def test_places_are_lines_of_files_and_the_other_way_round():
    repeated = positions(4, "a.csv").replace(rows=np.array([2, 2, 5, 9]))
    timeline = order_samples((repeated, positions(2, "b.csv", 20)), (positions(1, "a.csv", 30),))
    assert timeline.place(2) == Place("a.csv", 5, 5, "")
    assert timeline.place(4) == Place("a.csv", 30, 30, "")
    assert timeline.place(6) == Place("b.csv", 21, 21, "")
    assert [timeline.number_of(timeline.place(i)) for i in range(7)] == [0, 0, 2, 3, 4, 5, 6]
    with pytest.raises(IndexError):
        timeline.place(7)
    # A number may stand for several lines, such as the corners of an image.
    shared = replace(timeline, numbers=(np.array([0, 1, 1, 1]), *timeline.numbers[1:]))
    assert shared.place(1) == Place("a.csv", 2, 9, "")


@pytest.mark.parametrize(
    ("count", "expected"), [(30, 1), (20, 1), (19, 2), (10, 2), (9, 3), (7, 3), (6, 4), (1, 20)]
)
def test_a_thinned_timeline_has_evenly_spaced_samples_and_all_distances(count, expected):
    distances = PointDistance(2, [("p", "r")], [1.0])
    contacts = PointContact(positions(20).q, ["p", "r"] * 10)
    timeline = order_samples((contacts, distances), ()).thinned(count)
    np.testing.assert_array_equal(timeline.numbers[0], np.arange(1, 21, expected))
    np.testing.assert_array_equal(timeline.times[0], timeline.numbers[0])
    np.testing.assert_array_equal(timeline.numbers[1], [0])
    assert len(timeline.data[0].rows) == len(timeline.numbers[0])


@pytest.mark.parametrize(("number", "share"), [(0, 0.0), (2, 0.2), (5, 0.5), (8, 0.2), (10, 0.0)])
def test_the_shorter_side_of_a_step_is_a_share_of_the_fitted_samples(number, share):
    data = positions(10, "a.csv")
    timeline = order_samples((data,), (data.take(np.s_[:4]).replace(rows=np.arange(20, 24)),))
    assert timeline.shorter_side(number) == pytest.approx(share)


def test_joints_move_from_one_sample_of_a_file_to_the_next_one():
    q = np.array([[0.0, 1.0], [1.0, 0.0], [1.0, -1.0], [2.0, 5.0], [3.0, 4.0]])
    items = [
        Position(q[:3], np.zeros((3, 3))).replace(source="a.csv"),
        Position(q[3:], np.zeros((2, 3))).replace(source="b.csv"),
    ]
    first, second = order_samples(items, ()).directions
    assert first.tolist() == [[0.0, 0.0], [1.0, -1.0], [1.0, -1.0]]
    assert second.tolist() == [[0.0, 0.0], [1.0, -1.0]]


def test_points_are_touched_on_both_sides_or_named_all():
    q, labels = positions(6).q, ["a", "b", "b", "b", "c", "c"]
    timeline = order_samples((PointContact(q, labels), PointDistance(2, [("a", "b")], [1.0])), ())
    assert timeline.is_of_contacts
    assert [timeline.touched_points(n) for n in (2, 3, 4)] == [["a", "b", "c"], ["b"], ["b"]]
    assert timeline.touched_points(None) == timeline.touched_points(5) == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        (Step(2), [-1, -1, 0, 0, 0]),
        (Constant(), [1, 1, 1, 1, 1]),
        (Drift(2.0, 10.0), [-1, -0.75, -0.5, -0.25, 0]),
        (Drift(4.0, 8.0), [-1, -1, -0.5, 0, 0]),
        (Drift(2.0, 10.0, 4.0), 1 - np.exp([0.0, -0.5, -1.0, -1.5, -2.0])),
    ],
)
def test_functions_of_time(shape, expected):
    expected = np.array(expected, float)
    if isinstance(shape, Drift) and np.isfinite(shape.time_constant):
        expected = expected / expected[-1] - 1
    np.testing.assert_allclose(shape.values(NUMBERS, TIMES), expected[:, None], atol=1e-12)


def test_columns_of_a_cause_are_those_of_its_block_times_each_function():
    rows, shape = np.random.default_rng(0).normal(size=(5, 3, 7)), FreeDrift(2.0, 10.0)
    block = Block("base", "", np.array([1, 4]), np.array([2.0, HELD_SIZE]))
    cause = Cause(block, shape, np.arange(16.0), np.zeros((16, 16)))
    found = cause.columns_of(rows, NUMBERS, TIMES)
    f = shape.values(NUMBERS, TIMES)
    for i in range(8):
        for j, column in enumerate((1, 4)):
            np.testing.assert_allclose(found[:, :, 2 * i + j], f[:, i, None] * rows[:, :, column])
    np.testing.assert_array_equal(cause.amplitudes[3], [6.0, 7.0])
    np.testing.assert_array_equal(cause.sizes, [2.0, HELD_SIZE] * 8)
    # Columns that are held move nothing.
    np.testing.assert_array_equal(block.levers, [0.5, 0.0])


TWIST = 1e-2 * np.arange(1.0, 7.0)


def test_a_motion_has_a_pose_of_each_segment_and_drifts_that_add_up():
    poses = se3.exp6(np.outer([1.0, 2.0, 0.0], TWIST))
    linear, free = Drift(2.0, 10.0), FreeDrift(2.0, 10.0)
    motion = Motion((1, 3), poses, ((linear, TWIST[None]), (free, np.outer(np.arange(8), TWIST))))
    assert motion.segments(NUMBERS).tolist() == [0, 1, 1, 2, 2]
    share = linear.values(NUMBERS, TIMES)[:, 0] + free.values(NUMBERS, TIMES) @ np.arange(8)
    np.testing.assert_allclose(motion.twists(NUMBERS, TIMES), np.outer(share, TWIST))
    np.testing.assert_array_equal(Motion().twists(NUMBERS, TIMES), np.zeros((5, 6)))
    assert not motion.is_identity
    assert Motion().is_identity
    assert not replace(motion, steps=()).is_identity
    assert not replace(motion, drifts=()).is_identity
    fewer = motion.with_steps([3])
    np.testing.assert_array_equal(fewer.poses, poses[1:])


def test_a_step_moves_to_another_sample():
    drift, old, other = Drift(2.0, 10.0), Step(3), Step(4)
    both = Motion((3, 4), se3.exp6(np.outer([1.0, 2.0, 0.0], TWIST)))
    pairs: Any = ((old, 1.0), (other, 2.0), (drift, 3.0))
    of_joints: Any = ((0, old, 1.0), (1, old, 2.0), (1, other, 3.0), (1, drift, 4.0))
    changes = RobotChanges(
        both,
        both,
        zeros=of_joints,
        payload=pairs,
        lag=pairs,
    )
    moved = ((Step(2), 1.0), (other, 2.0), (drift, 3.0))
    zeros = ((0, old, 1.0), (1, Step(2), 2.0), (1, other, 3.0), (1, drift, 4.0))
    for kind, expected in (("lag", moved), ("payload", moved), ("zeros", zeros)):
        found = changes.with_step("joint" if kind == "zeros" else kind, 1, 3, 2)
        assert getattr(found, kind) == expected
        others = {"base", "tool", "zeros", "payload", "lag"} - {kind}
        assert all(getattr(found, each) is getattr(changes, each) for each in others)
    for kind, other_kind in (("base", "tool"), ("tool", "base")):
        found = changes.with_step(kind, 0, 3, 2)
        assert getattr(found, kind).steps == (2, 4)
        assert getattr(found, other_kind) is both
        assert (found.zeros, found.payload, found.lag) == (changes.zeros, changes.payload, changes.lag)


@pytest.mark.parametrize(
    "changes",
    [
        RobotChanges(base=Motion((1,))),
        RobotChanges(tool=Motion((1,))),
        RobotChanges(zeros=((0, Step(1), np.ones(1)),)),
        RobotChanges(growth=((Step(1), np.ones((1, 7))),)),
        RobotChanges(payload=((Step(1), np.ones(6)),)),
        RobotChanges(lag=((Constant(), 1.0),)),
    ],
)
def test_each_change_alone_is_one(changes):
    assert not changes.is_empty
    assert changes.without_lag.is_empty == bool(changes.lag)
    assert changes.of_frames.is_empty == (changes.base.is_identity and changes.tool.is_identity)


def test_increments_of_causes_add_up_to_the_motions_of_the_robot():
    """Each cause is fitted in two steps: poses are those of products of motions, other values add up."""
    rng, links = np.random.default_rng(0), np.arange(50, 57)
    chain = nominal_arm("ur10").with_base_and_tool(*se3.exp6(0.4 * rng.normal(size=(2, 6))))
    q = rng.uniform(-2, 2, (5, 6))
    data = Position(q, np.zeros((5, 3))).with_conditions(time=TIMES)
    timeline = order_samples((data,), ())
    late, early, drift, free = Step(3), Step(1), Drift(2.0, 10.0), FreeDrift(2.0, 10.0)
    base, tool = (Block(kind, "", np.arange(6), np.ones(6)) for kind in ("base", "tool"))
    joint = Block("joint", "x", np.array([0]), np.ones(1), 2)
    payload = Block("payload", "", np.arange(6), np.ones(6))
    own, every = Block("links", "", links[2:4], np.ones(2)), Block("links", "", np.array([9]), np.ones(1))
    lag = Block("lag", "", np.array([0]), np.ones(1), is_of_recording=True)
    pairs = [
        (base, late), (tool, early), (base, early), (tool, free), (base, drift), (joint, late),
        (joint, drift), (payload, late), (payload, Constant()), (own, early), (every, drift),
        (lag, Constant()), (lag, late),
    ]  # fmt: skip
    causes, steps = [], []
    for block, shape in pairs:
        count = len(block.columns) * shape.values(NUMBERS, TIMES).shape[1]
        causes.append(Cause(block, shape, np.zeros(count), np.zeros((count, count))))
        steps.append([0.01 * rng.normal(size=count) for _ in range(2)])
    changes = RobotChanges()
    for i in range(2):
        changes = update(changes, causes, [step[i] for step in steps], chain.base, links)
    of = {pair: np.sum(step, 0) for pair, step in zip(pairs, steps, strict=True)}
    exp = dict(zip(pairs, steps, strict=True))
    # Before a step, a base has the product of the motions of all steps behind it.
    found = changes.base.poses
    expected = np.eye(4)
    for i in range(2):
        expected = expected @ chain.base @ se3.exp6(-exp[base, late][i]) @ se3.inverse(chain.base)
    np.testing.assert_allclose(found[1], expected, atol=1e-12)
    expected = np.eye(4)
    for i in range(2):
        both = exp[base, late][i] + exp[base, early][i]
        expected = expected @ chain.base @ se3.exp6(-both) @ se3.inverse(chain.base)
    np.testing.assert_allclose(found[0], expected, atol=1e-12)
    np.testing.assert_allclose(found[2], np.eye(4), atol=1e-12)
    assert changes.base.steps == (1, 3)
    expected = se3.exp6(-exp[tool, early][1]) @ se3.exp6(-exp[tool, early][0])
    np.testing.assert_allclose(changes.tool.poses[0], expected, atol=1e-12)
    # The conditions of the samples.
    (changed,), held_out = apply_changes(changes, chain, timeline, None)
    assert held_out == ()
    values = {shape: shape.values(NUMBERS, TIMES) for _, shape in pairs}
    torques = chain.loads.torques_per_kilogram(q.T).T
    zeros = np.zeros((5, 6))
    zeros[:, 2] = values[late][:, 0] * of[joint, late] + values[drift][:, 0] * of[joint, drift]
    zeros += values[late] * of[payload, late] * torques
    growth = np.tile(values[drift] * of[every, drift], (1, 7))
    growth[:, 2:4] += values[early] * of[own, early]
    drifts = se3.exp6(values[drift] * of[base, drift])
    base_motion = changes.base.poses[[0, 1, 1, 2, 2]] @ chain.base @ drifts @ se3.inverse(chain.base)
    drifts = se3.exp6(values[free] @ of[tool, free].reshape(8, 6))
    tool_motion = drifts @ changes.tool.poses[[0, 1, 1, 1, 1]]
    found = vars(changed.conditions())
    expected = {"zeros": zeros, "growth": growth, "base_motion": base_motion, "tool_motion": tool_motion}
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, atol=1e-12, err_msg=name)
    # The lag: the joint positions at later times.
    expected = of[lag, Constant()] + values[late][:, 0] * of[lag, late]
    np.testing.assert_allclose(changes.lag_at(NUMBERS, TIMES), expected)
    paths = JointPaths(timeline)
    (delayed,), _ = apply_changes(changes, chain, timeline, paths)
    later, _ = paths.evaluate(NUMBERS, TIMES, expected)
    np.testing.assert_allclose(vars(delayed.conditions())["zeros"], zeros + later - q, atol=1e-12)
    assert changes.without_lag.lag == ()


def test_changes_are_those_of_the_same_robot_with_another_base_and_tool():
    rng = np.random.default_rng(0)
    chain = nominal_arm("ur10").with_base_and_tool(*se3.exp6(0.4 * rng.normal(size=(2, 6))))
    q, (base, tool) = rng.uniform(-2, 2, (5, 6)), se3.exp6(0.5 * rng.normal(size=(2, 6)))
    motions = [Motion((2,), np.array([se3.exp6(0.1 * rng.normal(size=6)), np.eye(4)])) for _ in range(2)]
    drift = (Drift(0.0, 4.0), 0.1 * rng.normal(size=(1, 6)))
    changes = RobotChanges(motions[0], replace(motions[1], drifts=(drift,)))
    timeline = order_samples((Position(q, np.zeros((5, 3))),), ())
    moved = chain.with_base_and_tool(base @ chain.base, chain.tool @ se3.inverse(tool))
    poses = []
    for each, arm in ((changes, chain), (changes.carried_to(base, tool), moved)):
        (item,), _ = apply_changes(each, arm, timeline, None)
        poses.append(arm.poses(item.conditions()))
    np.testing.assert_allclose(poses[1], base @ poses[0] @ se3.inverse(tool), atol=1e-12)
