"""Parts of a session whose bases or tools differ by large rotations, against the true arm and motions."""

from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from sessions import Changes, Simulation, session_of
from slow_cases import some_slow

from dhcal_pin import calibrate
from dhcal_pin.estimation import initialization
from dhcal_pin.measurements import MultiTargetPosition, Pose, Position, Wires
from dhcal_pin.robot.conditions import Conditions
from dhcal_pin.session import search


def files(sim: Simulation, kind: type, frames: list[pin.SE3]):
    """Return the measurements of an arm in parts, each in another measuring frame."""
    data, out = sim.measure(kind), []
    for i, part in enumerate(np.array_split(np.arange(len(sim.q)), len(frames))):
        moved = [frames[i] * pin.SE3(pose) for pose in sim_poses(data, part)]
        if kind is Position:
            item = Position(data.q[part], np.array([pose.translation for pose in moved]))
        else:
            item = Pose(data.q[part], np.array([pose.homogeneous for pose in moved]))
        out.append(item.replace(source=f"{i}.csv"))
    return out


def sim_poses(data, part: np.ndarray) -> list[np.ndarray]:
    """Return measured poses; those of positions have no rotation."""
    poses = np.tile(np.eye(4), (len(part), 1, 1))
    poses[:, :3, 3] = data.positions()[part]
    if isinstance(data, Pose):
        poses[:, :3, :3] = data.rotations()[part]
    return list(poses)


def for_both_kinds(cases: Sequence[tuple[Any, ...]], fast: Collection[int]) -> list[Any]:
    """Return each case with positions and with poses; those at the given places are not slow."""
    return some_slow([(*case, kind) for case in cases for kind in (Position, Pose)], fast)


@pytest.mark.parametrize(
    ("arm", "angles", "kind"),
    for_both_kinds(
        [("ur10", (20, 0)), ("panda", (180, 0)), ("xarm7", (60, -100, 0)), ("ur10", (5, 12, 0))],
        {0, 3, 4, 7},
    ),
)
def test_each_file_has_its_own_pose_of_the_base(arm, angles, kind):
    rng = np.random.default_rng(len(angles) + abs(angles[0]))
    sim = Simulation(arm, 40 * len(angles), 5)
    axes = rng.standard_normal((len(angles), 3))
    turns = [pin.exp3(np.deg2rad(a) * v / np.linalg.norm(v)) for a, v in zip(angles, axes, strict=True)]
    frames = [pin.SE3(turn, rng.normal(0, 1, 3)) for turn in turns]
    fit = calibrate(sim.chain, files(sim, kind, frames), extend="none")
    assert fit.session is not None
    events = fit.session.events
    assert [(event.kind, event.before.file, event.after.file) for event in events] == [
        ("base", f"{i}.csv", f"{i + 1}.csv") for i in range(len(angles) - 1)
    ]
    motion = fit.session.changes.base.poses
    found = [np.linalg.norm(pin.log3((b @ np.linalg.inv(a))[:3, :3])) for a, b in pairwise(motion)]
    true = [np.linalg.norm(pin.log3((b * a.inverse()).rotation)) for a, b in pairwise(frames)]
    np.testing.assert_allclose(found, true, atol=1e-3)
    assert fit.verdict.status == "caution"
    assert sim.true_error(fit.chain) < 1e-4


@pytest.mark.parametrize(("arm", "count"), some_slow([("ur10", 2), ("panda", 3), ("xarm7", 2)], {0}))
def test_targets_on_the_tool_show_the_base_of_each_file(arm, count):
    """The places of two targets in the tool mean nothing before the base of each file is known."""
    sim = Simulation(arm, 40 * count, 8)
    offsets = np.array([[0.06, 0.0, 0.02], [-0.05, 0.08, -0.03]])
    label = np.arange(len(sim.q)) % 2
    data, items = sim.measure(Pose), []
    poses = data.poses[:, :3, 3] + np.einsum("mij,mj->mi", data.poses[:, :3, :3], offsets[label])
    for i, part in enumerate(np.array_split(np.arange(len(sim.q)), count)):
        frame = pin.SE3(pin.exp3(sim.rng.normal(0, 1, 3)), sim.rng.normal(0, 3, 3))
        values = poses[part] @ frame.rotation.T + frame.translation
        names = [f"r{number + 1}" for number in label[part]]
        items.append(MultiTargetPosition(data.q[part], values, names).replace(source=f"{i}.csv"))
    fit = calibrate(sim.chain, items, extend="none")
    assert [(event.kind, event.after.file) for event in session_of(fit).events] == [
        ("base", f"{i}.csv") for i in range(1, count)
    ]
    assert len(fit.verdict.reasons) == count - 1, fit.verdict.reasons
    found = np.array([fit.instruments[f"target_r2.{axis}"] for axis in "xyz"])
    assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(offsets[1] - offsets[0]), abs=1e-4)


@pytest.mark.parametrize(("seed", "size"), some_slow([(0, 5e-3), (0, 0.3), (1, 5e-3), (1, 0.3)], {3}))
def test_a_device_with_wires_at_unknown_places_that_moved_between_files_is_found(seed, size):
    """Base and device can turn together, which only priors decide; a motion of the base turned with them."""
    sim = Simulation("ur10", 120, seed)
    positions, anchors = sim.measure(Position).positions(), sim.rng.uniform(-2, 2, (3, 3))
    motion, items = size * sim.direction(), []
    for i, part in enumerate(np.array_split(np.arange(120), 2)):
        length = np.linalg.norm(positions[part][:, None] - (anchors + i * motion), axis=2)
        items.append(Wires(sim.q[part], length).replace(source=f"{i}.csv"))
    fit = calibrate(sim.chain, items, extend="none")
    (event,) = session_of(fit).events
    assert (event.kind, event.after.file) == ("base", "1.csv")
    assert event.size == pytest.approx(size, abs=1e-3)
    assert len(fit.verdict.reasons) == 1, fit.verdict.reasons
    assert sim.true_error(fit.chain) < 2e-4


ONE_FILE = [("ur10", 60, (0.6, 1.0), 0), ("panda", 180, (0.25, 1.0), 0), ("xarm7", 100, (0.3, 0.7), 3)]


@pytest.mark.parametrize(
    ("arm", "angle", "shares", "n_outliers", "kind"), for_both_kinds(ONE_FILE, {0, 3, 4})
)
def test_a_base_that_turned_far_within_a_file_is_found(arm, angle, shares, n_outliers, kind):
    """The base turns at a share of the rows and, in one case, back again."""
    sim = Simulation(arm, 80, 6)
    data = sim.measure(kind, Changes(n_outliers=n_outliers, outlier=0.05))
    turned = pin.SE3(pin.exp3(np.deg2rad(angle) * sim.direction()), sim.rng.normal(0, 1, 3))
    first, end = (round(share * 80) for share in shares)
    poses = np.array(sim_poses(data, np.arange(80)))
    poses[first:end] = turned.homogeneous @ poses[first:end]
    moved = Position(data.q, poses[:, :3, 3]) if kind is Position else Pose(data.q, poses)
    fit = calibrate(sim.chain, moved, extend="none")
    events = session_of(fit).events
    places = sorted(place for place in (first, end) if place < 80)
    # Rows count from 1.
    assert [(event.kind, event.after.line) for event in events] == [("base", place + 1) for place in places]
    motion = session_of(fit).changes.base.poses
    found = np.linalg.norm(pin.log3((motion[1] @ np.linalg.inv(motion[0]))[:3, :3]))
    assert found == pytest.approx(np.linalg.norm(pin.log3(turned.rotation)), abs=2e-3)
    assert sim.true_error(fit.chain) < 1e-4


@pytest.mark.parametrize(
    ("arm", "count", "kind"), for_both_kinds([("ur10", 2), ("panda", 3), ("ur5", 5)], {0, 3})
)
def test_equal_parts_of_a_file_have_their_own_pose_of_the_base(arm, count, kind):
    """One base fits no part, so that there are no outliers."""
    sim = Simulation(arm, 40 * count, 7)
    frames = [pin.SE3(pin.exp3(sim.rng.normal(0, 1, 3)), sim.rng.normal(0, 1, 3)) for _ in range(count - 1)]
    parts = files(sim, kind, [*frames, pin.SE3.Identity()])
    values = np.concatenate([part.positions() if kind is Position else part.poses for part in parts])
    fit = calibrate(sim.chain, kind(sim.q, values), extend="none")
    assert [(event.kind, event.after.line) for event in session_of(fit).events] == [
        ("base", 40 * i + 1) for i in range(1, count)
    ]
    assert sim.true_error(fit.chain) < 1e-4


def turned_frame(sim: Simulation, angle: float, distance: float) -> pin.SE3:
    """Return a motion by an angle [deg] and a distance [m]."""
    return pin.SE3(pin.exp3(np.deg2rad(angle) * sim.direction()), distance * sim.direction())


def moved_poses(sim: Simulation, base: pin.SE3, base_from: int, tool: pin.SE3, tool_from: int) -> Pose:
    """Return poses of which those from some row on have another base, and those from another one a tool."""
    data = sim.measure(Pose)
    poses = data.poses.copy()
    poses[base_from:] = base.homogeneous @ poses[base_from:]
    poses[tool_from:] = poses[tool_from:] @ tool.homogeneous
    return Pose(data.q, poses)


@pytest.mark.parametrize(
    ("arm", "angle", "count", "n_files"),
    some_slow(
        [("panda", 93, 30, 1), ("ur10", 41, 40, 2), ("xarm7", 179, 60, 1), ("ur10", 166, 30, 2)], {0, 1}
    ),
)
def test_a_tool_that_turned_far_is_found(arm, angle, count, n_files):
    sim = Simulation(arm, count, 9)
    turned = turned_frame(sim, angle, 0.1)
    first = count // 2 + 2
    data = moved_poses(sim, pin.SE3.Identity(), count, turned, first)
    parts = np.split(np.arange(count), [first] * (n_files - 1))
    fit = calibrate(
        sim.chain,
        [data.take(part).replace(source=f"{i}.csv") for i, part in enumerate(parts)],
        extend="none",
    )
    (event,) = session_of(fit).events
    # Rows count from 1.
    assert (event.kind, event.after.file, event.after.line) == ("tool", f"{n_files - 1}.csv", first + 1)
    assert not fit.n_outliers
    assert len(fit.verdict.reasons) == 1, fit.verdict.reasons
    # The tool of the result is the later one.
    before, after = session_of(fit).changes.tool.poses
    np.testing.assert_allclose(after, np.eye(4), atol=1e-12)
    found = pin.SE3(before).inverse()
    assert np.linalg.norm(pin.log3(found.rotation.T @ turned.rotation)) < 1e-3
    assert np.linalg.norm(found.translation - turned.translation) < 3e-4
    tool = sim.tool * turned
    assert np.linalg.norm(fit.chain.tool[:3, 3] - tool.translation) < 3e-3
    sim.tool = tool
    assert sim.true_error(fit.chain) < 2e-4


@pytest.mark.parametrize(
    ("arm", "base_from", "tool_from"),
    some_slow([("ur10", 20, 42), ("panda", 40, 18), ("xarm7", 30, 30), ("panda", 20, 42)], {0, 1}),
)
def test_base_and_tool_that_turned_far_are_told_apart(arm, base_from, tool_from):
    """The other one of both gets no step where it stayed."""
    sim = Simulation(arm, 60, 3)
    base, tool = turned_frame(sim, 70, 1.5), turned_frame(sim, 120, 0.1)
    fit = calibrate(sim.chain, moved_poses(sim, base, base_from, tool, tool_from), extend="none")
    events = sorted((event.kind, event.after.line) for event in session_of(fit).events)
    assert events == [("base", base_from + 1), ("tool", tool_from + 1)]
    assert not fit.n_outliers
    sim.tool = sim.tool * tool
    assert sim.true_error(fit.chain) < 2e-4


def test_measured_poses_are_carried_to_base_and_tool_of_the_end():
    sim = Simulation("ur10", 5, 0)
    data = sim.measure(Pose)
    base, tool = turned_frame(sim, 60, 1.0).homogeneous, turned_frame(sim, 90, 0.1).homogeneous
    conditions = Conditions(
        data.q, base_motion=np.tile(base, (5, 1, 1)), tool_motion=np.tile(tool, (5, 1, 1))
    )
    moved = Pose(data.q, base @ data.poses @ tool).replace(recorded=conditions)
    positions, rotations = initialization.measured_at_end(moved)
    np.testing.assert_allclose(positions, data.positions(), atol=1e-12)
    np.testing.assert_allclose(rotations, data.rotations(), atol=1e-12)


def test_a_tool_of_rejected_samples_is_not_stated(monkeypatch):
    """A search from no first values, and a fit from a wrong start, reject one of both parts."""
    monkeypatch.setattr(search, "place_parts", lambda *args: None)
    monkeypatch.setattr(initialization, "measured_at_end", lambda item: (item.positions(), item.rotations()))
    sim = Simulation("panda", 40, 0)
    data = moved_poses(sim, pin.SE3.Identity(), 40, turned_frame(sim, 41, 0.1), 25)
    fit = calibrate(sim.chain, data, extend="none")
    assert fit.n_outliers == 15
    assert not session_of(fit).events


@pytest.mark.parametrize(("count", "kind"), for_both_kinds([(1,), (2,), (6,)], {0, 3, 4}))
def test_a_file_with_few_rows_moves_nothing(kind, count):
    sim = Simulation("ur10", 60, 5)
    data = sim.measure(kind)
    parts = [
        data.take(part).replace(source=f"{i}.csv")
        for i, part in enumerate(np.split(np.arange(60), [60 - count]))
    ]
    fit = calibrate(sim.chain, parts, extend="none")
    assert fit.verdict.status == "ok"
    assert fit.session is not None
    assert not fit.session.found
