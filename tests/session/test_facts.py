"""Sizes, places and texts of what happened during a session, against the motions of the robot."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from robots import nominal_arm

from dhcal_pin import se3
from dhcal_pin.measurements import PointContact, PointDistance, Position
from dhcal_pin.robot import Chain, parse_urdf
from dhcal_pin.robot.error_families import growing_links
from dhcal_pin.robot.transmission import Payload
from dhcal_pin.session.causes import Block, Cause, Constant, Drift, FreeDrift, Step
from dhcal_pin.session.facts import (
    Event,
    Lag,
    LagPart,
    RangeError,
    Scale,
    Session,
    SlowChange,
    cause_size,
    describe_drifts,
    describe_events,
    describe_lag,
    histories,
)
from dhcal_pin.session.robot_changes import RobotChanges, apply_changes, update
from dhcal_pin.session.timeline import Place, order_samples

COUNT, N = 12, 6
LINKS = np.arange(20, 27)
RNG = np.random.default_rng(5)
CHAIN = nominal_arm("ur10").with_base_and_tool(*se3.exp6(0.5 * RNG.normal(size=(2, 6))))
CHAIN = CHAIN.with_payload(Payload(2.0, (0.0, 0.0, 0.1)))
GROWS = growing_links(CHAIN.link_vectors)
DATA = Position(RNG.uniform(-2, 2, (COUNT, N)), np.zeros((COUNT, 3)))
TIMELINE = order_samples((DATA,), ())
SIZES = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
ORIGIN = np.array([0.3, -0.2, 0.1])
TOUCHED = np.array([[0.4, 0.1, 0.0], [-0.2, 0.5, 0.3], [0.1, -0.3, 0.2]])
TURN = np.array([1e-6, 0.0, 0.0, 2e-3, -1e-3, 2e-3])
MOVE = np.array([3e-3, -2e-3, 1e-3, 2e-3, 1e-3, -1.5e-3])
BLOCKS = {
    "base": Block("base", "", np.arange(6), SIZES, origin=ORIGIN),
    "tool": Block("tool", "", np.arange(6), SIZES, origin=ORIGIN),
    "turned base": Block("base", "", np.arange(6), SIZES),
    "turned tool": Block("tool", "", np.arange(6), SIZES),
    "touched": Block("base", "", np.arange(6), SIZES, touched=TOUCHED),
    "joint": Block("joint", "elbow_joint", np.array([8]), np.array([0.5]), 2),
    "all links": Block("links", "", np.array([30]), np.array([0.5])),
    "links": Block("links", "", LINKS[GROWS], np.full(GROWS.sum(), 0.5)),
    "payload": Block("payload", "", np.arange(40, 46), np.full(6, 1e-3)),
}
VALUES = {
    "base": MOVE,
    "tool": MOVE,
    "touched": MOVE,
    "turned base": TURN,
    "turned tool": TURN,
    "joint": np.array([-2e-3]),
    "all links": np.array([-1e-3]),
    "links": 1e-3 * RNG.normal(size=GROWS.sum()),
    "payload": np.array([0.0, 3e-5, -2e-5, 1e-5, 0.0, 1e-5]),
}


def cause_of(name, shape):
    """Return a cause whose uncertainty is small."""
    values, rng = VALUES[name], np.random.default_rng(1)
    count = len(shape.values(np.zeros(1), np.zeros(1))[0])
    values = np.concatenate([values * (-0.4) ** i for i in range(count)])
    root = 0.01 * np.abs(VALUES[name]).max() * rng.normal(size=(len(values), len(values)))
    return Cause(BLOCKS[name], shape, values, root @ root.T)


def changes_of(*causes):
    """Return the changes of a robot by causes."""
    return update(RobotChanges(), causes, [cause.values for cause in causes], CHAIN.base, LINKS)


def size_of(cause, values):
    """Return the size of a cause with other values."""
    other = replace(cause, values=values)
    return cause_size(other, changes_of(other), CHAIN, TIMELINE)[0]


def poses_of(cause):
    """Return the poses with a change, and those at the end."""
    (changed,), _ = apply_changes(changes_of(cause), CHAIN, TIMELINE, None)
    return CHAIN.poses(changed.conditions()), CHAIN.poses(DATA.q)


def moved_size(name, cause):
    """Return the size of a change in all samples from the poses of the tool."""
    before, after = poses_of(cause)
    motion = before[0] @ se3.inverse(after[0]) if "tool" not in name else se3.inverse(after[0]) @ before[0]
    if name == "joint":
        return abs(cause.values[0])
    if "turned" in name:
        return np.linalg.norm(se3.log3(motion[:3, :3]))
    if "links" in name or name == "payload":
        return np.sqrt(np.mean(np.sum((before - after)[:, :3, 3] ** 2, 1)))
    points = ORIGIN[None] if name == "tool" else np.array([ORIGIN]) if name == "base" else TOUCHED
    at = points if name == "tool" else se3.transform_points(CHAIN.base, points)
    return np.sqrt(np.mean(np.sum((se3.transform_points(motion, at) - at) ** 2, 1)))


@pytest.mark.parametrize("name", BLOCKS)
def test_sizes_of_steps_are_those_of_motions_of_the_robot(name):
    cause = cause_of(name, Step(COUNT))
    size, std, unit = cause_size(cause, changes_of(cause), CHAIN, TIMELINE)
    assert unit == ("rad" if name == "joint" or "turned" in name else "m")
    assert size == pytest.approx(moved_size(name, cause), rel=5e-3)
    assert std == pytest.approx(numeric_std(cause), rel=0.02)


def numeric_std(cause):
    """Return the standard deviation of the size of a change by finite differences."""
    steps = 1e-3 * np.abs(cause.values).max() * np.eye(len(cause.values))
    gradient = np.array([size_of(cause, cause.values + h) - size_of(cause, cause.values - h) for h in steps])
    gradient /= 2 * steps[0, 0]
    return np.sqrt(gradient @ cause.covariance @ gradient)


@pytest.mark.parametrize("shape", [Drift(0.0, COUNT - 1.0, 4.0), FreeDrift(0.0, COUNT - 1.0)])
@pytest.mark.parametrize("name", BLOCKS)
def test_sizes_of_drifts_are_the_largest_differences_from_the_end(name, shape):
    """They are those of a step by the amplitude at the sample that differs most."""
    cause = cause_of(name, shape)
    f = shape.values(TIMELINE.numbers[0], TIMELINE.times[0])
    changes = f @ cause.amplitudes
    largest = changes[np.argmax(np.linalg.norm(changes / cause.block.sizes, axis=1))]
    size, std, unit = cause_size(cause, changes_of(cause), CHAIN, TIMELINE)
    step = replace(cause_of(name, Step(COUNT)), values=-largest)
    assert unit == ("rad" if name == "joint" or "turned" in name else "m")
    assert size == pytest.approx(moved_size(name, step), rel=5e-3)
    assert std == pytest.approx(numeric_std(cause), rel=0.02)


RAIL = """<robot name="rail"><link name="a"/><link name="b"/><link name="c"/>
<joint name="x" type="prismatic"><parent link="a"/><child link="b"/><origin xyz="0 0 0.1"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="turn" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.3 0 0"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def rail():
    """Return an arm with a revolute joint on a rail."""
    return Chain.from_urdf(parse_urdf(RAIL.encode(), "rail"), "c")


def gantry():
    """Return an arm with a revolute joint on two rails."""
    rails = (
        '<link name="d"/><joint name="y" type="prismatic"><parent link="d"/><child link="a"/>'
        '<origin xyz="0 0 0"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )
    return Chain.from_urdf(parse_urdf(RAIL.replace("</robot>", f"{rails}</robot>").encode(), "gantry"), "c")


def joint_step(index, number, *, size=2e-3, std=1e-4):
    """Return a step of the zero of a joint."""
    block = Block("joint", f"j{index}", np.array([index]), np.array([0.5]), index)
    return Cause(block, Step(number), np.array([size]), np.array([[std**2]]))


def files_of(*counts, kind: type = Position, **conditions):
    """Return measurements of the arm on a rail in files of some rows, which begin with line 2."""
    q = np.linspace(-0.5, 0.5, sum(counts))[:, None] * [1.0, 0.3]
    whole = Position(q, np.zeros((len(q), 3))) if kind is Position else PointContact(q, ["p1"] * len(q))
    whole = whole.with_conditions(**conditions)
    ends = np.cumsum(counts)
    return [
        whole.take(np.s_[end - m : end]).replace(source=f"{i}.csv", rows=np.arange(2, m + 2))
        for i, (end, m) in enumerate(zip(ends, counts, strict=True))
    ]


@pytest.mark.parametrize(
    ("kind", "index", "rivals"),
    [
        (Position, 0, ("base",)),
        (Position, 1, ()),
        (PointContact, 0, ("base", "touched object")),
        (PointContact, 1, ()),
    ],
)
def test_events_are_in_the_order_of_measurement_with_their_places_and_rivals(kind, index, rivals):
    arm, timeline = rail(), order_samples(files_of(8, 4, kind=kind), ())
    causes = (joint_step(index, 8), joint_step(index, 3, size=-1e-3, std=2e-4))
    first, second = describe_events(causes, RobotChanges(), arm, timeline)
    unit = "rad" if index else "m"
    assert (first.kind, first.of, first.unit, first.rivals) == ("joint", f"j{index}", unit, rivals)
    assert (first.size, first.std) == pytest.approx((1e-3, 2e-4))
    assert (first.before, first.after) == (Place("0.csv", 4, 4, ""), Place("0.csv", 5, 5, ""))
    assert (second.size, second.std) == pytest.approx((2e-3, 1e-4))
    assert (second.before, second.after) == (Place("0.csv", 9, 9, ""), Place("1.csv", 2, 2, ""))
    assert (second.file, second.line) == ("1.csv", 2)
    block = Block("base", "", np.arange(6), SIZES)
    (of_base,) = describe_events(
        (Cause(block, Step(3), MOVE, np.eye(6)),),
        update(RobotChanges(), [Cause(block, Step(3), MOVE, np.eye(6))], [MOVE], np.eye(4), LINKS),
        arm,
        timeline,
    )
    assert of_base.rivals == (("touched object",) if kind is PointContact else ())


def test_rails_before_the_first_revolute_joint_move_the_arm_as_the_base_does():
    (item,) = files_of(9)
    timeline = order_samples((item.replace(q=np.pad(item.q, ((0, 0), (0, 1)))),), ())
    for index, rivals in enumerate([("base",), ("base",), ()]):
        (event,) = describe_events((joint_step(index, 3),), RobotChanges(), gantry(), timeline)
        assert event.rivals == rivals
    for index, rivals in enumerate([("base",), (), ()]):
        (event,) = describe_events((joint_step(index, 3),), RobotChanges(), CHAIN, TIMELINE)
        assert event.rivals == rivals


def test_a_lag_is_no_event_and_no_drift():
    block = Block("lag", "", np.array([0]), np.ones(1), is_of_recording=True)
    parts = RobotChanges(), rail(), order_samples(files_of(9), ())
    for shape in (Step(3), Drift(0.0, 8.0)):
        cause = Cause(block, shape, np.ones(1), np.ones((1, 1)))
        assert describe_events((cause,), *parts) == ()
        assert list(describe_drifts((cause,), *parts)) == []


@pytest.mark.parametrize(
    ("shape", "law", "constant"),
    [
        (Drift(0.0, 8.0), "linear", None),
        (Drift(0.0, 8.0, 3.0), "exponential", 3.0),
        (FreeDrift(0.0, 8.0), "free", None),
    ],
)
def test_drifts_have_their_law_and_the_unit_of_the_times(shape, law, constant):
    cause = replace(joint_step(0, 0), shape=shape, values=np.full(8 if law == "free" else 1, 1e-3))
    cause = replace(cause, covariance=1e-8 * np.eye(len(cause.values)))
    by_unit = {
        "row": order_samples(files_of(9), ()),
        "s": order_samples(files_of(9, time=np.arange(9.0)), ()),
    }
    for unit, timeline in by_unit.items():
        drifts = describe_drifts((joint_step(0, 3), cause), RobotChanges(), rail(), timeline)
        (found,) = drifts
        assert (found.kind, found.of, found.unit) == ("joint", "j0", "m")
        assert (found.shape, found.time_constant, found.time_unit) == (law, constant, unit)
        assert found.rivals == ("base",)
    base = Cause(BLOCKS["base"], Drift(0.0, 8.0), MOVE, np.eye(6))
    (found,) = describe_drifts((base,), RobotChanges(), rail(), by_unit["s"])
    assert found.of == "base"


def test_histories_are_the_changes_from_the_end_with_their_uncertainty():
    """A step and a drift of one joint add up; another joint and a lag are apart."""
    timeline = order_samples(files_of(6, 5), ())
    drift = replace(joint_step(0, 0, size=1e-3, std=3e-4), shape=Drift(0.0, 10.0))
    block = Block("lag", "", np.array([0]), np.ones(1), is_of_recording=True)
    lag = Cause(block, Constant(), np.ones(1), np.ones((1, 1)))
    causes = (joint_step(0, 4), lag, drift, joint_step(1, 6))
    first, second = histories(Session(timeline, rail(), True, causes=causes))
    share = 1 - np.arange(11) / 10
    is_before = np.arange(11) < 4
    assert (first.of, first.unit, second.of, second.unit) == ("j0", "m", "j1", "rad")
    np.testing.assert_array_equal(first.numbers, range(11))
    np.testing.assert_allclose(first.values, 2e-3 * is_before + 1e-3 * share)
    np.testing.assert_allclose(first.std, np.sqrt((1e-4 * is_before) ** 2 + (3e-4 * share) ** 2))
    np.testing.assert_allclose(second.values, 2e-3 * (np.arange(11) < 6))


def test_histories_begin_with_the_first_sample_of_the_robot():
    """Distances have no time, and precede the touches."""
    data = (*files_of(9, kind=PointContact), PointDistance(2, [("p1", "p2"), ("p1", "p3")], [1.0, 1.0]))
    (found,) = histories(Session(order_samples(data, ()), rail(), True, causes=(joint_step(0, 6),)))
    np.testing.assert_array_equal(found.numbers, range(9))
    np.testing.assert_allclose(found.values, 2e-3 * (np.arange(9) < 4))


def test_the_history_of_a_frame_has_the_uncertainty_along_its_motion():
    covariance = np.diag([4e-8, 1e-8, 1e-8, 1e-10, 1e-10, 1e-10])
    cause = Cause(BLOCKS["turned base"], Drift(0.0, 11.0), 3e-3 * np.eye(6)[0], covariance)
    session = Session(TIMELINE, CHAIN, True, changes_of(cause), (cause,))
    (found,) = histories(session)
    share = 1 - np.arange(COUNT) / 11
    assert (found.of, found.unit) == ("base", "m")
    np.testing.assert_allclose(found.values, 3e-3 * share, atol=1e-12)
    np.testing.assert_allclose(found.std, 2e-4 * share, atol=1e-12)


def test_the_history_of_an_irregular_drift_has_the_uncertainty_along_its_largest_motion():
    """Each column of the root of the covariance is an error, whose part along that motion counts."""
    shape = FreeDrift(0.0, COUNT - 1.0)
    cause = cause_of("base", shape)
    values, *root = 1e-3 * np.random.default_rng(2).normal(size=(6, 6 * 8))
    root = 0.01 * np.transpose(root)
    cause = replace(cause, values=values, covariance=root @ root.T)
    changes = changes_of(cause)
    (found,) = histories(Session(TIMELINE, CHAIN, True, changes, (cause,)))
    f = shape.values(TIMELINE.numbers[0], TIMELINE.times[0])
    moved = f @ cause.amplitudes / SIZES
    lengths = np.linalg.norm(moved, axis=1)
    peak = lengths.argmax()
    size, std, _ = cause_size(cause, changes, CHAIN, TIMELINE)
    np.testing.assert_allclose(found.values, size * lengths / lengths[peak])
    errors = [f @ column.reshape(8, 6) / SIZES @ moved[peak] for column in root.T]
    spread = np.linalg.norm(errors, axis=0)
    np.testing.assert_allclose(found.std, std * spread / spread[peak])


def test_a_history_of_nothing_is_zero():
    (found,) = histories(Session(TIMELINE, CHAIN, True, causes=(joint_step(2, 4, size=0.0, std=0.0),)))
    np.testing.assert_array_equal(found.values, np.zeros(COUNT))
    np.testing.assert_array_equal(found.std, np.zeros(COUNT))


def test_without_a_lag_none_is_described():
    assert describe_lag((joint_step(0, 5),), RobotChanges(), order_samples(files_of(9), ())) is None


def test_a_lag_begins_with_the_first_sample_of_the_robot():
    """Distances have no time, and precede the touches."""
    distances = PointDistance(2, [("p1", "p2"), ("p1", "p3")], [1.0, 1.0])
    lag = lag_of(
        [(Constant(), 0.5), (Step(6), 0.2)], order_samples((*files_of(9, kind=PointContact), distances), ())
    )
    places = [(p.first.line, p.last.line) for p in lag.parts]
    assert places == [(2, 5), (6, 10)]
    assert [p.begin for p in lag.parts] == pytest.approx([0.3, 0.5])


def lag_of(shapes, timeline):
    """Return the description of a lag with amplitudes by function of time, each 1 % uncertain at most."""
    block = Block("lag", "", np.array([0]), np.ones(1), is_of_recording=True)
    causes = [Cause(block, f, np.array([v]), np.array([[(0.01 * v) ** 2]])) for f, v in shapes]
    changes = update(RobotChanges(), causes, [cause.values for cause in causes], np.eye(4), LINKS)
    found = describe_lag((*causes, joint_step(0, 5)), changes, timeline)
    assert found is not None
    return found


def test_parts_of_a_lag_begin_at_its_steps():
    timeline = order_samples(files_of(6, 4), ())
    assert describe_lag((joint_step(0, 5),), RobotChanges(), timeline) is None
    (part,) = lag_of([(Constant(), 0.5)], timeline).parts
    assert part == LagPart(Place("0.csv", 2, 2, ""), Place("1.csv", 5, 5, ""), 0.5, 0.5)
    lag = lag_of([(Constant(), 0.5), (Step(7), 0.2), (Step(3), 0.1)], timeline)
    assert (lag.value, lag.std, lag.unit, lag.rate) == (0.5, pytest.approx(0.005), "row", 0.0)
    places = [(p.first.file, p.first.line, p.last.file, p.last.line) for p in lag.parts]
    assert places == [("0.csv", 2, "0.csv", 4), ("0.csv", 5, "1.csv", 2), ("1.csv", 3, "1.csv", 5)]
    assert [p.begin for p in lag.parts] == [p.end for p in lag.parts] == pytest.approx([0.2, 0.3, 0.5])


def test_the_rate_of_a_lag_is_that_of_its_last_part():
    timeline = order_samples(files_of(11, time=3.0 + 2.0 * np.arange(11)), ())
    lag = lag_of([(Constant(), 0.5), (Drift(3.0, 23.0), 0.1)], timeline)
    assert (lag.unit, lag.value, lag.rate) == ("s", pytest.approx(0.5), pytest.approx(0.1 / 20))
    assert (lag.parts[0].begin, lag.parts[0].end) == pytest.approx((0.4, 0.5))
    lag = lag_of([(Constant(), 0.5), (Drift(3.0, 23.0), 0.1), (Step(4), 0.3)], timeline)
    assert lag.rate == pytest.approx(0.1 / 20)


BEFORE, AFTER = Place("a.csv", 50, 51, ""), Place("a.csv", 52, 53, "")
OTHER, ONE, TWO = Place("b.csv", 2, 2, ""), Place("", 51, 51, ""), Place("", 52, 52, "")


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        (BEFORE, AFTER, "between lines 51 and 52 of a.csv"),
        (ONE, TWO, "between lines 51 and 52"),
        (BEFORE, OTHER, "between a.csv and b.csv"),
        (ONE, OTHER, "between the first and b.csv"),
        (BEFORE, ONE, "between a.csv and the second set of samples"),
        (replace(BEFORE, photograph="1.png"), replace(AFTER, photograph="2.png"), "between 1.png and 2.png"),
        (replace(BEFORE, photograph="1.png"), AFTER, "between lines 51 and 52 of a.csv"),
    ],
)
def test_events_lie_between_two_places(before, after, text):
    event = Event("base", "", before, after, 5e-3, 1e-4, "m")
    assert event.place == text
    assert event.finding == f"The base moved by 5.00 mm {text}."
    assert (event.file, event.line) == (after.file, after.line)


LATER = "Both parts were fitted with their own {0} pose; the result has that of the later part."


@pytest.mark.parametrize(
    ("kind", "of", "unit", "rivals", "finding", "consequence"),
    [
        ("base", "", "m", (), "The base moved by 5.00 mm {}.", LATER.format("base")),
        ("tool", "", "rad", (), "The tool turned by 0.286° {}.", LATER.format("tool")),
        ("base", "camera", "m", (), "The camera moved by 5.00 mm {}.", LATER.format("camera")),
        ("joint", "j2", "rad", ("base", "table"), "The zero of joint j2 changed by 0.286° {}.",
         "The result is the arm after the change. A motion of the base or of the table has the same effect."),
        ("payload", "", "m", (), "The load on the arm changed {}, which moved the tool by 5.00 mm.",
         "The result is the arm with the load after the change. State the mass at the tip in each row, in a "
         "column payload[kg]."),
        ("robot", "j2.z", "m", (), "Two robots were measured: from line 52 of a.csv on, j2.z differs by "
         "5.00 mm.", "Calibrate each robot by itself."),
    ],
)  # fmt: skip
def test_events_say_what_happened_and_what_was_done(kind, of, unit, rivals, finding, consequence):
    event = Event(kind, of, BEFORE, AFTER, 5e-3, 1e-4, unit, rivals)
    assert event.finding == finding.format("between lines 51 and 52 of a.csv")
    assert event.consequence == consequence
    assert event.to_dict() == {
        "kind": kind, "of": of, "file": "a.csv", "line": 52, "size": 5e-3, "std": 1e-4, "unit": unit,
    }  # fmt: skip


def test_the_first_sample_of_a_second_robot_may_have_no_file():
    event = Event("robot", "j2.z", ONE, TWO, 5e-3, 1e-4, "m")
    assert event.finding == "Two robots were measured: from line 52 on, j2.z differs by 5.00 mm."


SMOOTH, END = "It was fitted with a pose that changes smoothly.", "The result is the arm at the end."


@pytest.mark.parametrize(
    ("kind", "of", "shape", "constant", "time_unit", "finding", "consequence"),
    [
        ("base", "base", "linear", None, "row", "The base drifted by 1.000 mm during the "
         "measurement.", SMOOTH),
        ("tool", "camera", "exponential", 25.04, "row", "The camera drifted by 1.000 mm during the "
         "measurement, with a time constant of 25 rows.", SMOOTH),
        ("joint", "j2", "exponential", 120.0, "s", "The zero of joint j2 drifted by 1.000 mm during the "
         "measurement, with a time constant of 120 s.", END),
        ("links", "links", "linear", None, "row", "The lengths of the links changed during the measurement, "
         "which moved the tool by 1.000 mm.", END),
        ("links", "links", "free", None, "row", "The lengths of the links changed during the measurement, "
         "which moved the tool by up to 1.000 mm.", END),
        ("base", "base", "free", None, "row", "The base drifted irregularly by up to 1.000 mm during the "
         "measurement.", SMOOTH),
    ],
)  # fmt: skip
def test_drifts_say_what_happened(kind, of, shape, constant, time_unit, finding, consequence):
    drift = SlowChange(kind, of, 1e-3, 1e-5, "m", shape, constant, time_unit)
    assert drift.finding == finding
    assert drift.consequence == consequence
    rival = replace(drift, rivals=("base",))
    assert rival.consequence == f"{consequence} A motion of the base has the same effect."
    assert drift.to_dict() == {
        "of": of, "size": 1e-3, "std": 1e-5, "unit": "m", "shape": shape, "time_constant": constant,
    }  # fmt: skip


FIRST = LagPart(Place("a.csv", 2, 2, ""), Place("a.csv", 40, 41, ""), 0.2, 0.2)
SECOND = LagPart(Place("a.csv", 42, 42, ""), Place("a.csv", 90, 91, ""), -0.3, -0.3)
CORRECTED = "The calibration corrected this. "


@pytest.mark.parametrize(
    ("lag", "finding", "consequence"),
    [
        (Lag(0.2, 0.01, "s", parts=(FIRST,)), "The joint values are 0.200 s earlier than the measured "
         "values.",
         CORRECTED + "Record both at the same time, or add --mend lag:0.2."),
        (Lag(-1.5, 0.01, "row", False), "The joint values are 1.500 rows later than the measured values.",
         "Record both at the same time, or add --mend lag:-1.5."),
        (Lag(0.03, 0.01, "s"), "The joint values are at the time of the measured values.",
         CORRECTED + "Record both at the same time, or add --mend lag:0.03."),
        (Lag(-0.3, 0.01, "s", parts=(FIRST, SECOND)), "The joint values are 0.300 s later than the measured "
         "values from line 42 of a.csv on, and 0.200 s earlier than the measured values before.",
         CORRECTED + "Record both with one clock, or add --mend lag:0.2@a.csv:2-41 --mend "
         "lag:-0.3@a.csv:42-91."),
        (Lag(-0.3, 0.06, "s", parts=(FIRST, SECOND)), "The joint values are 0.300 s later than the measured "
         "values from line 42 of a.csv on, and at the time of the measured values before.",
         CORRECTED + "Record both with one clock, or add --mend lag:-0.3@a.csv:42-91."),
        (Lag(-0.3, 0.01, "s", parts=(FIRST, replace(SECOND, last=Place("b.csv", 5, 5, "")))),
         "The joint values are 0.300 s later than the measured values from line 42 of a.csv on, and 0.200 s "
         "earlier than the measured values before.", CORRECTED + "Record both with one clock."),
        (Lag(-0.3, 0.01, "row", parts=(replace(FIRST, first=ONE, last=ONE), replace(SECOND, first=TWO,
         last=TWO))), "The joint values are 0.300 rows later than the measured values from line 52 on, and "
         "0.200 rows earlier than the measured values before.", CORRECTED + "Record both with one clock."),
        (Lag(0.4, 0.01, "s", parts=(replace(FIRST, end=0.4),), rate=-2.5e-4), "The clocks of joint values "
         "and measured values drift apart: the joint values are 0.200 s earlier than the measured values at "
         "the beginning, and 0.400 s earlier than the measured values at the end, 250 ppm.",
         CORRECTED + "Record both with one clock."),
        (Lag(0.4, 0.01, "row", parts=(replace(FIRST, end=0.4),), rate=2.5e-4), "The clocks of joint values "
         "and measured values drift apart: the joint values are 0.200 rows earlier than the measured values "
         "at the beginning, and 0.400 rows earlier than the measured values at the end.",
         CORRECTED + "Record both with one clock."),
    ],
)  # fmt: skip
def test_a_lag_is_stated_with_its_parts_and_what_corrects_it(lag, finding, consequence):
    assert lag.finding == finding
    assert lag.consequence == consequence
    parts = [{"file": p.first.file, "line": p.first.line, "value": p.begin} for p in lag.parts]
    assert lag.to_dict() == {
        "value": lag.value, "std": lag.std, "unit": lag.unit, "parts": parts, "rate": lag.rate,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("scale", "consequence"),
    [
        (Scale(1.003, 1e-4, "z"), "Check the instrument, or add --mend scale:z:1.003."),
        (Scale(0.985, 1e-4, "", ("a.csv",), stated="length between the points"), "Check the stated length "
         "between the points: nothing else shows the size of the robot. If it is wrong, correct it, or add "
         "--mend scale:0.985."),
        (Scale(0.985, 1e-4, ""), "Check the scale of the instrument: measurements alone do not distinguish "
         "it from the size of the robot. If the instrument is wrong, add --mend scale:0.985."),
    ],
)  # fmt: skip
def test_a_scale_says_what_undoes_it(scale, consequence):
    assert scale.consequence == consequence


@pytest.mark.parametrize(
    ("scale", "finding"),
    [
        (Scale(1.003, 1e-4, ""), "The correction makes the whole robot 0.300 ± 0.010 % longer."),
        (Scale(0.985, 2.3e-3, ""), "The correction makes the whole robot 1.50 ± 0.23 % shorter."),
        (Scale(0.985, 1e-4, "x"), "Measured x is 1.5 % too short compared with the other axes."),
        (Scale(1.01234, 1e-4, "z"), "Measured z is 1.2 % too long compared with the other axes."),
    ],
)
def test_a_scale_says_what_is_too_long(scale, finding):
    assert scale.finding == finding


def test_an_error_of_distances_says_what_undoes_it():
    too_short = RangeError(-2e-3, 1e-5)
    assert too_short.finding.endswith("from the origin of the measuring frame are 2.000 mm too short.")
    assert too_short.consequence.endswith("or add --mend range:-0.002000.")
    assert RangeError(2e-3, 1e-5).finding.endswith("too long.")


@pytest.mark.parametrize(
    ("factor", "is_possible"), [(1.09, True), (0.91, True), (1.11, False), (0.89, False), (2.0, False)]
)
def test_an_instrument_is_wrong_by_a_tenth_at_most(factor, is_possible):
    found = Scale(factor, 1e-4, "", ("a.csv", "b.csv")).consequence
    if is_possible:
        assert found.endswith(f" add --mend scale:{factor}@a.csv --mend scale:{factor}@b.csv.")
    else:
        assert found == (
            "No instrument is so wrong: the robot file is probably that of a robot of another size."
        )
    # Known lengths, or a single axis, may be wrong by more.
    for other in (Scale(factor, 1e-4, "", stated="length"), Scale(factor, 1e-4, "x")):
        assert "--mend scale:" in other.consequence


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.039, "at the time of the measured values"), (-0.039, "at the time of the measured values"),
        (0.041, "0.041 s earlier than the measured values"),
        (-0.041, "0.041 s later than the measured values"),
    ],
)  # fmt: skip
def test_a_lag_is_stated_from_four_standard_deviations_on(value, text):
    assert Lag(value, 0.01, "s").finding == f"The joint values are {text}."
    parts = (FIRST, replace(SECOND, begin=value, end=value))
    mends = f" --mend lag:{value}@a.csv:42-91" if abs(value) > 0.04 else ""
    lag = Lag(value, 0.01, "s", parts=parts)
    assert lag.finding.startswith(
        f"The joint values are {text} from line 42 of a.csv on, and 0.200 s earlier"
    )
    assert lag.consequence.endswith(f"or add --mend lag:0.2@a.csv:2-41{mends}.")


def test_the_last_of_three_parts_of_a_lag_is_compared_with_the_one_before():
    third = LagPart(Place("a.csv", 92, 92, ""), Place("a.csv", 99, 99, ""), 0.5, 0.5)
    lag = Lag(0.5, 0.01, "s", parts=(FIRST, SECOND, third))
    assert lag.finding == (
        "The joint values are 0.500 s earlier than the measured values from line 92 of a.csv on, and 0.300 s "
        "later than the measured values before."
    )
    assert lag.consequence.endswith(
        "add --mend lag:0.2@a.csv:2-41 --mend lag:-0.3@a.csv:42-91 --mend lag:0.5@a.csv:92-99."
    )
    assert lag.is_corrected


@pytest.mark.parametrize("lever", [2.0, 0.5])
@pytest.mark.parametrize(("share", "unit"), [(0.9, "m"), (1.1, "rad")])
def test_a_motion_is_a_turn_if_that_moves_the_tool_ten_times_farther(share, unit, lever):
    values = np.array([0.0, 1e-3, 0.0, 0.0, 0.0, share * 10 * 1e-3 / lever])
    block = replace(BLOCKS["turned base"], sizes=np.repeat([1.0, 1 / lever], 3))
    cause = Cause(block, Drift(0.0, COUNT - 1.0), values, np.diag(np.arange(1.0, 7) ** 2))
    expected = (1e-3, 2.0, "m") if unit == "m" else (values[5], 6.0, "rad")
    assert cause_size(cause, RobotChanges(), CHAIN, TIMELINE) == pytest.approx(expected)


@pytest.mark.parametrize("name", BLOCKS)
def test_a_change_of_nothing_has_the_size_zero(name):
    for shape in (Step(COUNT), Drift(0.0, COUNT - 1.0)):
        cause = replace(cause_of(name, shape), values=np.zeros(len(VALUES[name])))
        size, std, _ = cause_size(cause, changes_of(cause), CHAIN, TIMELINE)
        assert size == 0
        assert np.isfinite(std)


def test_a_session_applies_its_changes_to_its_samples():
    """Those of the held-out measurements, too; a lag moves the joints along their paths."""
    first, second = files_of(6, 6)
    timeline = order_samples((first,), (second,))
    step = joint_step(0, 9)
    block = Block("lag", "", np.array([0]), np.ones(1), is_of_recording=True)
    lag = Cause(block, Constant(), np.array([0.5]), np.ones((1, 1)))
    rate = first.q[1] - first.q[0]
    before = [[-2e-3, 0.0]]
    for cause, zeros in ((step, before * 9 + [[0.0, 0.0]] * 3), (lag, [0.5 * rate] * 12)):
        changes = update(RobotChanges(), [cause], [cause.values], np.eye(4), LINKS)
        applied: Any = Session(timeline, rail(), True, changes).applied((first,), (second,))
        found = np.concatenate([item.conditions().zeros for (item,) in applied])
        np.testing.assert_allclose(found, zeros, rtol=1e-6)


def test_a_session_describes_its_causes():
    timeline = order_samples(files_of(8, 4), ())
    drift = replace(joint_step(1, 0), shape=Drift(0.0, 11.0))
    session = Session(timeline, rail(), True, causes=(joint_step(0, 8), drift)).described()
    assert [(each.of, each.place) for each in session.events] == [("j0", "between 0.csv and 1.csv")]
    assert [(each.of, each.shape) for each in session.drifts] == [("j1", "linear")]


def test_a_session_lists_what_was_found():
    event = Event("base", "", BEFORE, AFTER, 5e-3, 1e-4, "m")
    drift = SlowChange("tool", "tool", 1e-3, 1e-5, "m", "linear", None, "row")
    lag, scale = Lag(0.2, 0.01, "s"), Scale(1.003, 1e-4, "z")
    empty = Session(TIMELINE, CHAIN, True)
    assert empty.found == ()
    nothing = {"events": [], "drift": [], "lag": None, "scale": None, "range": None, "unordered": False}
    assert empty.to_dict() == nothing
    distance = RangeError(-2e-3, 1e-5)
    full = replace(
        empty,
        events=(event,),
        drifts=(drift,),
        lag=lag,
        scales=(scale,),
        range_error=distance,
        is_ordered=False,
    )
    assert full.found == (event, drift, lag, distance, scale)
    assert full.sentences == [f"{each.finding} {each.consequence}" for each in full.found]
    assert full.to_dict() == {
        "events": [event.to_dict()],
        "drift": [drift.to_dict()],
        "lag": lag.to_dict(),
        "scale": {"factor": 1.003, "std": 1e-4, "axis": "z"},
        "range": {"value": -2e-3, "std": 1e-5},
        "unordered": True,
    }
    # Two robots stay, and what belongs to one of them is no event.
    assert not full.has_two_robots
    assert full.described().events == ()
    two = replace(full, events=(replace(event, kind="robot", of="j2.z"),))
    assert two.has_two_robots
    assert two.described().events == two.events
