"""Causes that a calibration can show, first values of parts, and changes refined without a search."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from sessions import NOISE, Changes, Simulation

from dhcal_pin import se3
from dhcal_pin.estimation.initialization import make_problem
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.measurements import Pose, Position
from dhcal_pin.session import part_frames
from dhcal_pin.session.causes import Cause, Step
from dhcal_pin.session.facts import Session
from dhcal_pin.session.linear_model import Layout, _largest_torques, _scale_motions, whitened_rows
from dhcal_pin.session.part_frames import (
    _can_turn,
    _mean_squares,
    _motion,
    _placed,
    _samples_between,
    place_parts,
    starts_of_parts,
)
from dhcal_pin.session.refinement import refine_changes
from dhcal_pin.session.robot_changes import RobotChanges
from dhcal_pin.session.timeline import order_samples


def problem_of(data, sets="minimal,base,tool", simulation=None, priors=1.0):
    """Return the problem of a calibration from the true base and tool, or from others."""
    simulation = simulation or Simulation("ur10", 40, 3)
    chain = simulation.chain.with_base_and_tool(simulation.base.homogeneous, simulation.tool.homogeneous)
    errors = select_parameters(chain, sets)
    return make_problem(errors, tuple(data), 1 / (priors * errors.priors), {})


@pytest.mark.parametrize(
    ("sets", "kinds", "joints"),
    [
        ("minimal,base,tool", {"base", "tool", "links"}, range(6)),
        ("base,tool", {"base", "tool"}, (0, 5)),
        ("minimal,base", {"base"}, range(5)),
    ],
)
def test_only_what_has_a_constant_error_changes(sets, kinds, joints):
    """The first and the last joint turn as base and tool do."""
    problem = problem_of([Simulation("ur10", 40, 3).measure(Pose)], sets)
    layout, n = Layout.of(problem), len(problem.weights)
    rows = whitened_rows(layout, np.zeros(n), problem.data, np.zeros((40, 6)))
    blocks = layout.restricted_to(rows).blocks
    assert {b.kind for b in blocks if not b.is_of_recording} == {"joint", "payload", *kinds}
    assert [b.index for b in blocks if b.kind == "joint"] == list(joints)
    assert {b.kind for b in blocks if b.is_of_recording} == {"scale", "range", "lag"}


def test_torques_of_an_unstated_payload_are_the_largest_ones():
    simulation = Simulation("ur10", 40, 3, errors=(0.0, 0.0))
    data = simulation.measure(Position)
    q, one = data.q, np.ones(40)
    expected = np.abs(simulation.torques(q, one) - simulation.torques(q, 0 * one)).max(0)
    parts = [data.take(np.s_[:10]), data.take(np.s_[10:])]
    found = _largest_torques(problem_of(parts, simulation=simulation))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)
    stated = [parts[0], parts[1].with_conditions(payload=np.zeros(30))]
    assert not _largest_torques(problem_of(stated, simulation=simulation)).any()
    # Other conditions say nothing of the payload.
    warm = [parts[0], parts[1].with_conditions(temperature=np.full(30, 20.0))]
    np.testing.assert_array_equal(_largest_torques(problem_of(warm, simulation=simulation)), found)


def test_scales_move_points_from_their_mean_or_the_origin():
    points = np.array([[1.0, 3.0], [0.0, 4.0], [5.0, 5.0]])
    x, y, zero = [-1.0, 1.0], [-2.0, 2.0], [0.0, 0.0]
    expected = np.zeros((5, 6, 2))
    expected[0, :3], expected[1, 0], expected[2, 1], expected[3, 2] = [x, y, zero], x, y, zero
    expected[4, :3] = points
    np.testing.assert_array_equal(_scale_motions(points), expected)


@pytest.mark.parametrize(("degrees", "has_turned"), [(9.9, False), (10.1, True), (-10.1, True)])
def test_parts_are_placed_if_one_of_them_turned_by_ten_degrees(degrees, has_turned):
    poses = se3.exp6(np.array([[5.0, 0, 0, 0, 0, 0], [0, 0, 0, 0, np.deg2rad(degrees), 0], np.zeros(6)]))
    motion = _motion((10, 20), poses)
    assert motion.steps == ((10, 20) if has_turned else ())
    assert motion.is_identity != has_turned


def turned(simulation, kind, first, end):
    """Return measurements whose base turned by 60° from a sample on, the motion, and files of both parts."""
    motion = se3.exp6(np.array([0.3, -0.2, 0.5, 0.0, np.deg2rad(60), 0.0]))
    data = simulation.measure(Pose)
    poses = data.poses.copy()
    poses[first:end] = motion @ poses[first:end]
    whole = Pose(data.q, poses) if kind is Pose else Position(data.q, poses[:, :3, 3])
    return whole, motion


@pytest.mark.parametrize("kind", [Pose, Position])
@pytest.mark.parametrize(("first", "is_placed"), [(5, False), (6, True), (20, True), (34, True), (35, False)])
def test_base_and_tool_of_each_file_are_placed(kind, first, is_placed):
    """A file needs six samples. The problem begins with the base of the last one."""
    simulation = Simulation("ur10", 40, 3, errors=(0.0, 0.0))
    whole, motion = turned(simulation, kind, first, 40)
    data = [whole.take(np.s_[:first]).replace(source="a"), whole.take(np.s_[first:]).replace(source="b")]
    problem, timeline = problem_of(data, simulation=simulation), order_samples(data, ())
    assert place_parts(problem, timeline, ()) is None
    found = place_parts(problem, timeline, timeline.file_starts)
    if not is_placed:
        assert found is None
        return
    assert found is not None
    placed, changes = found
    assert changes.base.steps == (first,)
    np.testing.assert_allclose(changes.base.poses[0], np.linalg.inv(motion), atol=0.02)
    base = placed.errors.chain.base
    np.testing.assert_allclose(base, motion @ simulation.base.homogeneous, atol=0.02)
    assert changes.tool.is_identity
    # Without the poses of base and tool among the unknowns, nothing can be placed.
    assert place_parts(problem_of(data, "minimal", simulation), timeline, timeline.file_starts) is None


@pytest.mark.parametrize(("first", "end", "starts"), [(20, 40, (20,)), (13, 28, (13, 28)), (40, 40, ())])
def test_parts_begin_where_the_base_turned(first, end, starts):
    simulation = Simulation("ur10", 40, 3, errors=(0.0, 0.0))
    whole, _ = turned(simulation, Position, first, end)
    problem, timeline = problem_of([whole], simulation=simulation), order_samples([whole], ())
    n = len(problem.weights)
    assert starts_of_parts(problem, np.zeros(n), timeline) == starts
    assert starts_of_parts(problem_of([whole], "minimal", simulation), np.zeros(n), timeline) == ()
    assert not _can_turn(problem_of([whole], "minimal", simulation))
    # Residuals are in the order of measurement.
    shuffled = [whole.take(np.s_[20:]), whole.take(np.s_[:20])]
    shuffled = [part.replace(source=name) for part, name in zip(shuffled, "ab", strict=True)]
    of_files = replace(order_samples(shuffled, ()), numbers=(np.arange(20, 40), np.arange(20)))
    sizes = _mean_squares(problem_of(shuffled, simulation=simulation), np.zeros(n), of_files)
    (residual,) = problem.residuals(np.zeros(n), problem.data)
    np.testing.assert_allclose(sizes, np.mean(residual**2, 0))


@pytest.mark.parametrize(
    ("far", "ratio", "n_unfit", "starts"),
    [
        (range(20, 40), 10.1, 40, (20,)),
        (range(20, 40), 9.9, 40, ()),
        (range(20, 23), 10.1, 40, (20,)),
        (range(20, 22), 10.1, 40, ()),  # two samples are outliers
        (range(5, 8), 10.1, 40, ()),
        (range(6, 9), 10.1, 40, (6,)),
        (range(37, 40), 10.1, 40, (37,)),
        (range(20, 40), 10.1, 4, (20,)),
        (range(20, 40), 10.1, 3, ()),  # one solution fits nine tenths of the samples
    ],
)
def test_a_part_begins_with_three_samples_that_are_far(monkeypatch, far, ratio, n_unfit, starts):
    simulation = Simulation("ur10", 40, 3)
    data = simulation.measure(Position)
    problem, timeline = problem_of([data], simulation=simulation), order_samples([data], ())
    begun, number = [], np.arange(40)

    def initialize(errors, part, known, n_iterations):
        begun.append(part[0].q)
        return SimpleNamespace(chain=errors.chain)

    def mean_squares(problem, x, timeline):
        of_solution = np.where(number < n_unfit, 1e3, 0.0)
        is_far = np.isin(number, far) & (len(begun) == 1)
        return np.where(is_far, ratio**2, 1.0) if begun else of_solution

    monkeypatch.setattr(part_frames, "initialize_frames", initialize)
    monkeypatch.setattr(part_frames, "_mean_squares", mean_squares)
    assert starts_of_parts(problem, np.zeros(len(problem.weights)), timeline) == starts
    # Base and tool are fitted to the first samples of each part.
    np.testing.assert_array_equal(begun[0], data.q[:16])
    assert len(begun) == 1 + (starts != () and starts[0] <= 34)
    for first, q in zip(starts, begun[1:], strict=False):
        np.testing.assert_array_equal(q, data.q[first : first + 16])


def test_a_session_has_a_largest_number_of_parts(monkeypatch):
    """Nine samples after the other fit by themselves."""
    simulation = Simulation("ur10", 126, 3)
    data = simulation.measure(Position)
    problem, timeline = problem_of([data], simulation=simulation), order_samples([data], ())
    begun = []

    def initialize(errors, part, known, n_iterations):
        begun.append(part[0].q)
        return SimpleNamespace(chain=errors.chain)

    def mean_squares(problem, x, timeline):
        return np.where(np.arange(126) < 9 * len(begun), 1.0, 1e3)

    monkeypatch.setattr(part_frames, "initialize_frames", initialize)
    monkeypatch.setattr(part_frames, "_mean_squares", mean_squares)
    found = starts_of_parts(problem, np.zeros(len(problem.weights)), timeline)
    assert found == tuple(range(9, 9 * 13, 9))


def test_a_placed_problem_has_the_instruments_of_a_part():
    """First values of targets are those in the last part, where base and tool are known."""
    simulation = Simulation("ur10", 12, 3, errors=(0.0, 0.0))
    data = simulation.measure_targets()
    moved = data.replace(values=data.values + np.array([1.0, 0.0, 0.0]))
    parts = data.take(np.s_[:18]).replace(source="a"), moved.take(np.s_[18:]).replace(source="b")
    problem = problem_of(parts, "base,tool", simulation)
    base, tool = simulation.base.homogeneous, simulation.tool.homogeneous
    chain = problem.errors.chain.with_base_and_tool(se3.exp6(np.array([1.0, 0, 0, 0, 0, 0])) @ base, tool)
    placed = _placed(problem, chain, parts[1:])
    np.testing.assert_array_equal(placed.errors.chain.base, chain.base)
    np.testing.assert_array_equal(placed.errors.chain.tool, tool)
    expected = {p.name: p.nominal for p in parts[1].initialized(chain).instrument_parameters}
    for item, own in zip(placed.data, problem.data, strict=True):
        assert [p.name for p in item.instrument_parameters] == [p.name for p in own.instrument_parameters]
        assert {p.name: p.nominal for p in item.instrument_parameters} == expected
    assert any(value for value in expected.values())


@pytest.mark.parametrize(
    ("first", "end", "counts"), [(0, 4, [4]), (3, 10, [3, 4]), (6, 20, [4]), (0, np.inf, [6, 4])]
)
def test_samples_between_two_numbers(first, end, counts):
    whole = Position(np.zeros((10, 6)), np.zeros((10, 3)))
    data = tuple(whole.take(part).replace(source=name) for part, name in ((np.s_[:6], "a"), (np.s_[6:], "b")))
    found = _samples_between(data, order_samples(data, ()), first, end)
    assert [len(item.rows) for item in found] == counts


@pytest.mark.parametrize("n_outliers", [0, 3])
def test_changes_are_refined_to_the_true_ones(n_outliers):
    """Steps of the base and of a joint, whose sizes are unknown, and of a joint that did not change."""
    simulation = Simulation("ur10", 60, 3, errors=(1e-4, 1e-4))
    data = simulation.measure(Pose, Changes("base", 1e-3, joint=(2, 2e-3), n_outliers=n_outliers))
    data = Pose(data.q, data.poses, NOISE, 1e-4)
    problem, timeline = problem_of([data], simulation=simulation), order_samples([data], ())
    layout = Layout.of(problem)
    blocks = [block for block in layout.blocks if block.kind in ("base", "joint")]
    base, joint, still = blocks[0], *(next(b for b in blocks if b.index == i) for i in (2, 4))
    causes = tuple(
        Cause(block, Step(30), np.zeros(len(block.columns)), np.eye(len(block.columns)))
        for block in (joint, base, still)
    )
    session = Session(timeline, problem.errors.chain, True, RobotChanges(), causes)
    refined = refine_changes(session, problem, np.zeros(len(problem.weights)))
    of_joint, of_base, of_still = refined.causes
    std = np.sqrt(of_joint.covariance[0, 0])
    assert of_joint.values[0] == pytest.approx(2e-3, abs=4 * std)
    assert std < 1e-4
    assert of_still.values[0] == pytest.approx(0, abs=4 * np.sqrt(of_still.covariance[0, 0]))
    assert of_base.covariance.shape == (6, 6)
    event = refined.events[1]
    assert (event.kind, event.size) == ("base", pytest.approx(1e-3, abs=4 * event.std))
    assert event.std < 1e-4
    (number, shape, value), _ = refined.changes.zeros
    assert (number, shape, value[0]) == (2, Step(30), pytest.approx(of_joint.values[0]))
    # The uncertainty is that of the normal equations with the noise of the residuals.
    if not n_outliers:
        rows = whitened_rows(layout, np.zeros(len(problem.weights)), [data], np.zeros((60, 6)))
        columns = [each.columns_of(rows, np.arange(60), np.arange(60.0)) for each in causes]
        a = np.concatenate([rows[..., layout.model], *columns], -1).reshape(360, -1)
        prior = np.concatenate([problem.weights, *(1 / each.sizes for each in causes)])
        covariance = np.linalg.inv(a.T @ a + np.diag(prior**2))
        expected = np.sqrt(np.diag(covariance))[-8:]
        found = np.sqrt(np.concatenate([np.diag(each.covariance) for each in refined.causes]))
        np.testing.assert_allclose(found, expected, rtol=0.3)
