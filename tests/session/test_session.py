"""What happens during a session is found, named and accounted for, and nothing is found in clean sets."""

import json
from dataclasses import replace
from itertools import product

import numpy as np
import pinocchio as pin
import pytest
from robots import ARMS, DATA, MAPS, missing, nominal_arm, robot_file
from scipy.stats import multivariate_normal
from sessions import NAMES, Changes, Simulation, search_of, session_of, write_csv
from slow_cases import some_slow

from dhcal_pin import calibrate, se3
from dhcal_pin.cli.main import main
from dhcal_pin.estimation.initialization import make_problem
from dhcal_pin.estimation.parameters import ANGLE_PRIOR, LENGTH_PRIOR, select_parameters
from dhcal_pin.estimation.solver import minimize
from dhcal_pin.io import read_measurements
from dhcal_pin.measurements import Pose, Position
from dhcal_pin.measurements.base import concatenate
from dhcal_pin.plausibility.hypotheses import mend
from dhcal_pin.robot import Chain
from dhcal_pin.robot.conditions import Conditions
from dhcal_pin.session import search as search_module
from dhcal_pin.session.causes import Cause, Drift, FreeDrift, Step
from dhcal_pin.session.facts import Scale, SlowChange
from dhcal_pin.session.linear_model import Layout, inverse, whitened_rows
from dhcal_pin.session.refinement import refine_changes
from dhcal_pin.session.robot_changes import JointPaths, Motion, RobotChanges
from dhcal_pin.session.scale import ANGLE_FACTORS, LENGTH_FACTORS, _responses, find_scale
from dhcal_pin.session.search import FINE_CONSTANTS, TIME_CONSTANTS, find_session
from dhcal_pin.session.timeline import _file_numbers, order_samples

DEGREE = np.deg2rad(1.0)
KINDS = (Position, Pose)


def motions(rng, count, scale):
    """Return random rigid motions."""
    return se3.exp6(scale * rng.normal(size=(count, 6)))


def test_frames_move_with_the_conditions_of_a_sample():
    chain = nominal_arm("ur10").with_base_and_tool(*motions(np.random.default_rng(0), 2, 0.5))
    rng, n = np.random.default_rng(1), chain.n_joints
    q, zeros = rng.uniform(-2, 2, (5, n)), 0.01 * rng.normal(size=(5, n))
    base, tool = motions(rng, 5, 0.1), motions(rng, 5, 0.1)
    growth = 0.01 * rng.normal(size=(5, n + 1))
    conditions = Conditions(q, base_motion=base, tool_motion=tool, zeros=zeros)
    np.testing.assert_allclose(chain.poses(conditions), base @ chain.poses(q + zeros) @ tool, atol=1e-12)
    # Links that grow: the vectors between the joints of the model of Pinocchio, without the tool.
    bare = chain.with_base_and_tool(np.eye(4), np.eye(4))
    grown = bare.poses(Conditions(q, growth=growth))
    for row, each, pose in zip(q, growth, grown, strict=True):
        model = bare.model.copy()
        for j, name in enumerate(bare.moving_joints):
            placement = model.jointPlacements[model.getJointId(name)]
            placement.translation = placement.translation * (1 + each[j])
        data = model.createData()
        pin.framesForwardKinematics(model, data, bare.loads.configurations(row[:, None])[0])
        tip = data.oMf[bare.frame_id]
        last = model.frames[bare.frame_id].placement.translation
        expected = tip.translation + tip.rotation @ bare.origins[-1][:3, :3].T @ last * each[-1]
        np.testing.assert_allclose(pose[:3, 3], expected, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_columns_of_causes_agree_with_finite_differences(kind):
    chain = nominal_arm("ur5").with_base_and_tool(*motions(np.random.default_rng(0), 2, 0.5))
    rng, n, step = np.random.default_rng(2), chain.n_joints, 1e-6
    q = rng.uniform(-2, 2, (4, n))
    exact = chain.poses(q)
    data = Pose(q, exact) if kind is Pose else Position(q, exact[:, :3, 3])
    errors = select_parameters(chain, "minimal,base,tool")
    layout = Layout.of(make_problem(errors, (data,), 1 / errors.priors, {}))
    # A scale of all axes is no cause: the size of the robot imitates it.
    assert [block.of for block in layout.blocks if block.kind == "scale"] == ["x", "y", "z"]
    rates = rng.normal(size=(4, n))
    rows = whitened_rows(layout, np.zeros(len(errors.parameters)), (data,), rates)
    to_base, twists = se3.inverse(chain.base), np.eye(6)
    growth = np.eye(n + 1)
    nominal = Simulation("ur5", 4, 0, errors=(0.0, 0.0))
    torques = nominal.torques(q, np.ones(4)) - nominal.torques(q, np.zeros(4))

    def moved(**changes):
        changed = data.replace(recorded=Conditions(q, **changes))
        frames = chain.forward_kinematics(changed.conditions())
        return changed.residual(frames, np.array([])).T

    by_kind = {
        "base": [
            {"base_motion": np.tile(chain.base @ se3.exp6(h) @ to_base, (4, 1, 1))} for h in step * twists
        ],
        "tool": [{"tool_motion": np.tile(se3.exp6(h), (4, 1, 1))} for h in step * twists],
        "lag": [{"zeros": step * rates}],
        "links": [{"growth": np.tile(step * h, (4, 1))} for h in growth],
        "payload": [{"zeros": step * h * torques} for h in np.eye(n)],
    }
    for block in layout.blocks:
        if block.kind == "joint":
            changes = [{"zeros": np.tile(step * np.eye(n)[block.index], (4, 1))}]
        elif block.kind == "links":
            changes = by_kind["links"] if len(block.columns) > 1 else [{"growth": np.full((4, n + 1), step)}]
            if len(block.columns) > 1:
                changes = [changes[c - layout.links[0]] for c in block.columns]
        elif block.kind in ("scale", "range"):
            continue
        else:
            changes = by_kind[block.kind]
        for column, change in zip(block.columns, changes, strict=True):
            # The rows are the derivative of the model, the residual is measured minus modelled.
            np.testing.assert_allclose(rows[..., column], -moved(**change) / step, atol=2e-3, rtol=1e-4)
    # Longer modelled distances have the effect of shorter measured ones.
    shorter = exact.copy()
    shorter[:, :3, 3] *= 1 - step / np.linalg.norm(exact[:, :3, 3], axis=1)[:, None]
    changed = Pose(q, shorter) if kind is Pose else Position(q, shorter[:, :3, 3])
    of_range = -changed.residual(chain.forward_kinematics(q), np.array([])).T / step
    np.testing.assert_allclose(rows[..., layout.range], of_range, atol=2e-3, rtol=1e-4)


def log_evidence_of(search, cause, noise, applied, others=()):
    """Return the logarithm of the ratio of the marginal likelihoods with and without a step.

    Those of Gaussian data with a noise, whose coefficients have a prior of the best width. The measurements
    are those without the changes `applied` of the step. Other causes belong to the model, with wide priors.
    """
    rows = search.linearize() / noise[..., None]
    model = rows[..., search.layout.model].reshape(rows[..., 0].size, -1)
    step = cause.columns_of(rows, search.numbers, search.times).reshape(len(model), -1)
    values = rows[..., -1].ravel() + model @ search.x + step @ applied
    factor = model / search.layout.weights
    for other in others:
        columns = other.columns_of(rows, search.numbers, search.times).reshape(len(model), -1)
        values, factor = values + columns @ other.values, np.hstack([factor, columns * other.sizes])

    def log_likelihood(width):
        # With Q·R = [F; I], the covariance I + F·Fᵀ has the determinant of RᵀR. Its own condition is 1e11.
        columns = np.hstack([factor, step * (width * cause.sizes)])
        stacked = np.vstack([columns, np.eye(columns.shape[1])])
        q, r = np.linalg.qr(stacked)
        target = np.append(values, np.zeros(columns.shape[1]))
        squares = np.sum((target - q @ (q.T @ target)) ** 2)
        return -np.sum(np.log(np.abs(np.diag(r)))) - 0.5 * squares

    gain = max(map(log_likelihood, np.geomspace(1e-6, 1, 100))) - log_likelihood(0.0)
    n_steps, n_causes = len(search.edges), len(search.layout.blocks)
    return gain - np.log(n_steps * n_causes)


@pytest.mark.parametrize(
    "changes", [Changes("base", 1.5e-4), *(Changes(joint=(j, 0.01 * DEGREE)) for j in (1, 4))]
)
def test_evidence_is_the_ratio_of_marginal_likelihoods(changes):
    search = search_of(changes)
    # The step is proposed without having been fitted, and judged after its fit.
    proposed = search.best_cause(search.first_fit)
    assert proposed is not None
    tolerance = 0.25 * len(proposed.values)
    expected = log_evidence_of(search, proposed, search.first_fit.noise, 0 * proposed.values)
    assert proposed.log_evidence == pytest.approx(expected, abs=tolerance)
    search.run()
    (cause,) = search.causes
    noise = search.solve(search.linearize(), [cause]).noise
    expected = log_evidence_of(search, cause, noise, cause.values)
    assert cause.log_evidence == pytest.approx(expected, abs=tolerance)


def test_evidence_of_each_of_two_causes_is_that_beside_the_other_one():
    search = search_of(Changes("base", 2e-4, joint=(4, 0.015 * DEGREE), at=0.3))
    search.run()
    noise = search.solve(search.linearize(), search.causes).noise
    assert {cause.block.kind for cause in search.causes} == {"base", "joint"}
    for cause, other in (search.causes, search.causes[::-1]):
        expected = log_evidence_of(search, cause, noise, cause.values, [other])
        assert cause.log_evidence == pytest.approx(expected, abs=1)


def test_no_derivative_remains_at_the_fit_even_with_narrow_priors():
    search = search_of(Changes(), prior_factor=0.01)
    fit = search.iterate(search.first_fit)
    assert fit.score @ fit.covariance @ fit.score < 1


@pytest.mark.parametrize(
    ("of", "time_constant", "low", "high"), [("base", 0.25, 0.15, 0.5), ("tool", None, np.inf, np.inf)]
)
def test_a_small_drift_has_its_time_constant(of, time_constant, low, high):
    search = search_of(Changes(of, 5e-4, at=None, time_constant=time_constant))
    search.run()
    (cause,) = search.causes
    assert isinstance(cause.shape, Drift)
    assert low <= cause.shape.time_constant / 59 <= high


@pytest.mark.parametrize(("gain", "constant"), [(2.5, np.inf), (3.5, FINE_CONSTANTS[8])])
def test_a_drift_is_exponential_from_a_gain_of_three(gain, constant):
    """The residuals are those of an exponential drift, of which linear ones leave a part of a known size."""
    search = search_of(Changes())
    linear, exponential = (
        Cause(search.layout.blocks[0], Drift(0.0, 59.0, 59 * ratio), np.zeros(6), np.zeros((6, 6)))
        for ratio in (np.inf, FINE_CONSTANTS[8])
    )
    columns = [
        cause.columns_of(search.rows, search.numbers, search.times).reshape(360, 6)
        for cause in (linear, exponential)
    ]
    explained = np.hstack([search.rows[..., search.layout.model].reshape(360, -1), columns[0]])
    left = columns[1][:, 0] - explained @ np.linalg.lstsq(explained, columns[1][:, 0])[0]
    search.rows[..., -1] = (np.sqrt(2 * gain) * columns[1][:, 0] / np.linalg.norm(left)).reshape(60, 6)
    search.causes = [linear]
    fit = replace(search.first_fit, weights=np.ones(60), noise=np.ones((60, 6)))
    assert search._change_drifts(fit) == (gain > 3)
    assert search.causes[0].shape == Drift(0.0, 59.0, 59 * constant)


def test_a_step_before_the_last_three_samples_is_found():
    """The blocks that are left out are shorter than its shorter side."""
    search = search_of(Changes("tool", 5e-4, at=0.95))
    search.run()
    assert [cause.shape for cause in search.causes] == [Step(57)]


@pytest.mark.parametrize(
    ("arm", "count", "n_after"), some_slow([("ur10", 50, 8), ("panda", 80, 12), ("xarm7", 120, 20)], {0, 1})
)
def test_steps_of_a_joint_and_later_of_the_tool_are_no_drift(arm, count, n_after):
    """A third of the samples behind the first step are outliers of it, until the second one is found."""
    simulation = Simulation(arm, count, 3)
    zeros = DEGREE * np.eye(simulation.chain.n_joints)[2]
    positions = simulation.measure(Position, Changes(joint=(2, DEGREE))).positions().copy()
    poses = simulation.poses(simulation.q[-n_after:] + zeros)
    shift = 1.2e-3 * simulation.direction()
    positions[-n_after:] += [simulation.base.rotation @ pose.rotation @ shift for pose in poses]
    fit = calibrate(simulation.chain, Position(simulation.q, positions), extend="none")
    session = session_of(fit)
    assert not session.drifts
    found = [(event.kind, event.after.line) for event in session.events]
    assert found == [("joint", count // 2 + 1), ("tool", count - n_after + 1)]
    assert fit.n_outliers == 0
    assert simulation.true_error(fit.chain) < 1.5e-4


def test_a_session_has_a_largest_number_of_causes(monkeypatch):
    monkeypatch.setattr(search_module, "MAX_CAUSES", 1)
    search = search_of(Changes("base", 2e-4, joint=(4, 0.015 * DEGREE), at=0.3))
    search.run()
    assert len(search.causes) == 1


def test_what_the_measurements_do_not_show_has_the_prior_of_a_metre():
    search = search_of(Changes())
    base = search.layout.blocks[0]
    rows = search.rows.copy()
    rows[..., base.columns] = 0
    fit = search.solve(rows, [Cause(base, Step(30), np.zeros(6), np.zeros((6, 6)))])
    np.testing.assert_allclose(fit.covariance[-6:, -6:], np.diag(base.sizes**2), atol=1e-9)


def test_passes_of_a_fit_end_where_weights_and_noise_stay(monkeypatch):
    search, calls = search_of(Changes()), []
    monkeypatch.setattr(search_module, "inverse", lambda matrix: [calls.append(1), inverse(matrix)][1])
    search.solve(search.rows, [])
    # The covariances of the result are two more inverse matrices.
    assert len(calls) - 2 < search_module.N_PASSES


def test_steps_lie_between_samples_of_a_cell_but_not_within_files_without_an_order():
    search = search_of(Changes("base", 2e-3, at=0.45), n_cells=10)
    np.testing.assert_array_equal(search.edges, range(0, 61, 6))
    search.run()
    assert [cause.shape for cause in search.causes] == [Step(27)]
    search = search_of(Changes("base", 2e-3, at=0.45), is_ordered=False)
    fit = search.first_fit
    assert search._best_place(fit, fit.residual, 40) == 40


@pytest.mark.parametrize(("place", "found"), [(2, 3), (20, 20), (58, 57)])
def test_a_step_has_three_samples_on_either_side(place, found):
    """The samples show a step at one place; the fit has it at another one."""
    search, change, number = search_of(Changes()), np.ones((60, 6)), np.arange(60)[:, None]
    residual = change * ((number >= place) * 1.0 - (number >= 40))
    fit = replace(search.first_fit, residual=residual)
    assert search._best_place(fit, change, 40) == found


@pytest.mark.parametrize(
    "changes", [Changes("base", 3e-4), Changes("base", 1e-3, at=None), Changes("base", 1e-3, n_outliers=3)]
)
def test_coefficients_of_the_score_test_are_those_of_a_fit(changes):
    search = search_of(changes)
    cause = search.best_cause(search.first_fit)
    assert cause is not None
    fit = search.solve(search.rows, [replace(cause, values=0 * cause.values)])
    expected = fit.step[len(search.x) :]
    assert cause.block.kind == "base"
    np.testing.assert_allclose(cause.values, expected, atol=0.2 * np.abs(expected).max())


def test_a_part_drifts_once_beside_the_drifts_of_other_parts():
    search = search_of(Changes())
    base, tool, *_ = search.layout.blocks
    for shape, left in ((Drift(0.0, 59.0), {Step, FreeDrift}), (FreeDrift(0.0, 59.0), {Step})):
        search.causes = [Cause(base, shape, np.zeros(6), np.zeros((6, 6)))]
        assert set(search._kinds(base)) == left
        assert set(search._kinds(tool)) == {Step, Drift, FreeDrift}
    drifts = search._shapes(Drift, ())
    assert [each.time_constant / 59 for each in drifts] == pytest.approx(TIME_CONSTANTS)
    assert {(each.begin, each.end) for each in drifts} == {(0.0, 59.0)}


@pytest.mark.parametrize("step", [4, 6, 8])
def test_a_further_step_changes_no_pose(step):
    motion = Motion((5,), motions(np.random.default_rng(0), 2, 0.1))
    more, numbers = motion.with_steps([step, 5]), np.arange(10)
    assert more.steps == tuple(sorted([step, 5]))
    np.testing.assert_array_equal(more.poses[more.segments(numbers)], motion.poses[motion.segments(numbers)])


def test_paths_of_joints_are_those_of_each_file():
    times, lag = np.split(0.1 * np.arange(80), 2), 0.05
    paths = [(np.sin, np.cos), (np.cos, lambda t: -np.sin(t))]
    items = [
        Position(np.outer(f(t), [1, 2]), np.zeros((40, 3))).replace(source=f.__name__).with_conditions(time=t)
        for t, (f, _) in zip(times, paths, strict=True)
    ]
    timeline = order_samples(items, ())
    numbers = timeline.fitted_numbers
    found = JointPaths(timeline).evaluate(numbers, timeline.fitted_times, np.full(len(numbers), lag))
    for i, (t, functions) in enumerate(zip(times, paths, strict=True)):
        for each, f in zip(found, functions, strict=True):
            inner = slice(40 * i + 5, 40 * i + 35)
            np.testing.assert_allclose(each[inner, 1], 2 * f(t[5:35] + lag), atol=1e-4)
    assert RobotChanges().is_empty
    # Times are no numbers of samples. The arm hardly moves where it turns back.
    kept = timeline.thinned(100).fitted_numbers
    np.testing.assert_array_equal(np.setdiff1d(numbers, kept), [16, 63])


def test_a_thinned_timeline_has_samples_of_all_measurements():
    data = Simulation("ur10", 30, 1).measure(Position)
    timeline = order_samples([data.take(np.s_[a : a + 10]) for a in (0, 10, 20)], ())
    np.testing.assert_array_equal(timeline.thinned(10).fitted_numbers, np.arange(0, 30, 3))


def test_a_session_of_one_time_has_no_drift():
    for shape in (Drift(2.0, 2.0), FreeDrift(2.0, 2.0)):
        assert np.isfinite(shape.values(np.arange(3), np.full(3, 2.0))).all()


@pytest.mark.parametrize("shape", [Drift(2.0, 6.0), Drift(2.0, 6.0, 1.0), FreeDrift(2.0, 6.0)])
def test_nothing_drifts_before_and_after_a_session(shape):
    begin, before, end, after = shape.values(np.arange(4), np.array([2.0, 0.0, 6.0, 9.0]))
    np.testing.assert_allclose([before, end, after], [begin, 0 * begin, 0 * begin], atol=1e-12)


EVENTS = {
    **{
        f"{of} {1e3 * size:g} mm at {at}": Changes(of, size, angle, at=at)
        for of in ("base", "tool")
        for size, angle in ((3e-4, 0.0), (5e-3, 0.2 * DEGREE), (30e-3, 0.5 * DEGREE))
        for at in (0.1, 0.5, 0.9)
    },
    **{
        f"joint {joint} at {at}": Changes(joint=(joint, size * DEGREE), at=at)
        for joint, size in ((0, 0.2), (1, 0.1), (2, 0.3), (3, 0.5))
        for at in (0.1, 0.5, 0.9)
    },
    **{
        f"drift of {of}, {constant}": Changes(of, 1e-3, at=None, time_constant=constant)
        for of in ("base", "tool")
        for constant in (None, 0.2)
    },
    **{f"drift of joint {joint}": Changes(joint=(joint, 0.1 * DEGREE), at=None) for joint in (1, 2)},
    "growth": Changes(growth=1e-3, at=None),
    **{f"drift of {of} there and back": Changes(of, 1e-3, at=None, periods=1.5) for of in ("base", "tool")},
}
# Events of the fast suite: one of each type.
FAST = [
    list(EVENTS).index(name)
    for name in (
        "base 5 mm at 0.9",
        "tool 0.3 mm at 0.5",
        "joint 2 at 0.1",
        "drift of base, 0.2",
        "growth",
        "drift of tool there and back",
    )
]


def is_named(session, changes, simulation):
    """Return whether an event or a drift is the only one found, with its part, place and size."""
    size = changes.joint[1] if changes.joint else changes.length
    of = simulation.chain.joint_names[changes.joint[0]] if changes.joint else changes.of or "links"
    found = session.events if changes.at is not None else session.drifts
    if len(session.found) != 1 or len(found) != 1:
        return False
    one = found[0]
    if changes.at is not None:
        # The lines of samples from Python begin with 1.
        is_place = abs(one.line - 1 - round(changes.at * simulation.count)) <= 2
        is_place = is_place and (one.of or one.kind) == of
    else:
        is_place = one.of == of
    return is_place and (of == "links" or abs(one.size - size) <= max(0.2 * size, 2 * one.std))


def true_ratio(simulation, fit, kind):
    """Return the true error relative to that of the same arm and number of samples without an event."""
    clean = Simulation(simulation.arm, simulation.count, simulation.seed)
    alone = calibrate(clean.chain, clean.measure(kind), extend="none", session="off")
    return simulation.true_error(fit.chain) / clean.true_error(alone.chain)


@pytest.mark.parametrize("name", some_slow(list(EVENTS), FAST))
def test_events_are_named_and_handled(name, request):
    is_fast = request.node.get_closest_marker("slow") is None
    settings = list(product(NAMES, KINDS, (60, 100, 300), range(5)))
    if is_fast:
        cases = [("ur10", Position, 100, 0), ("panda", Pose, 60, 1), ("xarm7", Position, 100, 2)]
        settings = [cases[list(EVENTS).index(name) % 3]]
    named, ratios = [], []
    for arm, kind, count, seed in settings:
        simulation = Simulation(arm, count, seed)
        fit = calibrate(simulation.chain, simulation.measure(kind, EVENTS[name]), extend="none")
        named.append(is_named(session_of(fit), EVENTS[name], simulation))
        ratios.append(true_ratio(simulation, fit, kind))
        assert fit.verdict.status == "caution" or not session_of(fit).found
    assert np.mean(named) >= (1.0 if is_fast else 0.95), np.round(ratios, 2)
    assert np.median(ratios) <= (2.0 if is_fast else 1.3)


@pytest.mark.parametrize(
    ("name", "size", "measure"),
    some_slow(
        [
            (name, size, measure)
            for name, size in (
                *(("", 0.0), ("tool 5 mm at 0.5", 5e-3)),
                *(("joint 2 at 0.9", 0.3 * DEGREE), ("drift of base, None", 1e-3)),
            )
            for measure in (Simulation.measure_wires, Simulation.measure_targets)
        ],
        {0, 3, 4, 7},
    ),
)
def test_changes_are_found_in_wires_and_several_targets(measure, name, size):
    simulation = Simulation("ur10", 100, 5)
    fit = calibrate(simulation.chain, measure(simulation, EVENTS.get(name)), extend="none")
    assert [found.size for found in session_of(fit).found] == pytest.approx([size] if size else [], rel=0.1)
    of = [getattr(found, "of", "") or getattr(found, "kind", "") for found in session_of(fit).found]
    assert of == {"": [], "j": ["elbow_joint"], "t": ["tool"], "d": ["base"]}[name[:1]]
    assert simulation.true_error(fit.chain) < 5e-5


@pytest.mark.parametrize("count", some_slow([8, 400], {0}))
def test_nothing_is_found_where_nothing_happened(count):
    """Clean sets, and sets of random samples with outliers only."""
    found = []
    for seed in range(count):
        arm, kind, m = NAMES[seed % 4], KINDS[seed // 4 % 2], (60, 100, 300)[seed // 8 % 3]
        simulation = Simulation(arm, m, 1000 + seed)
        fit = calibrate(simulation.chain, simulation.measure(kind), extend="none")
        found.append(bool(session_of(fit).found))
    assert sum(found) <= 0.01 * count
    for seed in range(max(4, count // 4)):
        simulation = Simulation(NAMES[seed % 4], (60, 100)[seed % 2], 2000 + seed)
        share, size = ((0.1, 0.02), (0.2, 5e-3), (0.05, 0.05))[seed % 3]
        changes = Changes(n_outliers=int(share * simulation.count), outlier=size)
        fit = calibrate(simulation.chain, simulation.measure(KINDS[seed % 2], changes), extend="none")
        assert not session_of(fit).found, seed


@pytest.mark.parametrize("sets", some_slow(["minimal,base,tool", "placement,base,tool"], {1}))
def test_an_event_is_found_without_priors_and_with_redundant_parameters(sets):
    simulation = Simulation("ur10", 100, 3)
    changes = Changes("base", 5e-3)
    fit = calibrate(simulation.chain, simulation.measure(Position, changes), sets, priors="none")
    assert is_named(session_of(fit), changes, simulation)


def test_a_large_step_of_a_point_does_not_turn_the_tool():
    """Positions do not show the rotation of the tool, but steps of the point are in its frame."""
    simulation, changes = Simulation("panda", 300, 104), EVENTS["tool 30 mm at 0.5"]
    fit = calibrate(simulation.chain, simulation.measure(Position, changes), extend="none")
    assert is_named(session_of(fit), changes, simulation)


def test_a_small_step_of_a_point_does_not_turn_the_tool_in_the_calibration():
    """The rotation would follow the noise of a step of 0.3 mm by radians, in more than 100 iterations."""
    simulation = Simulation("panda", 60, 1)
    fit = calibrate(
        simulation.chain, simulation.measure(Position, EVENTS["tool 0.3 mm at 0.1"]), extend="none"
    )
    turned = [e.value - e.nominal for e in fit.estimates if e.name in ("tool.rx", "tool.ry", "tool.rz")]
    np.testing.assert_array_equal(turned, np.zeros(3))
    assert fit.converged
    assert fit.verdict.status == "caution"
    # A pose shows the rotation beside the same step.
    poses = calibrate(simulation.chain, simulation.measure(Pose, EVENTS["tool 0.3 mm at 0.1"]), extend="none")
    assert not any(e.fixed for e in poses.estimates)


def test_an_event_is_found_beside_outliers():
    simulation = Simulation("ur10", 100, 5)
    changes = Changes("base", 2e-3, 0.1 * DEGREE, n_outliers=10)
    fit = calibrate(simulation.chain, simulation.measure(Position, changes), extend="none")
    assert is_named(session_of(fit), changes, simulation)
    assert len(fit.outliers[0]) >= 9


@pytest.mark.parametrize("size", some_slow([0.3e-3, 5e-3], {0}))
def test_the_held_out_samples_beside_an_event_have_the_pose_of_their_side(size):
    simulation = Simulation("ur10", 100, 0)
    data = simulation.measure(Position, Changes("base", size))
    is_held_out = np.isin(np.arange(100), [47, 48, 49, 50, 51, *range(0, 40, 3)])
    fit = calibrate(simulation.chain, data.take(~is_held_out), holdout=data.take(is_held_out), extend="none")
    assert abs(session_of(fit).events[0].line - 51) <= (2 if size < 1e-3 else 0)
    assert fit.comparisons[0].after.groups["position"].rms < 2e-4


def test_functions_of_a_free_drift_are_those_of_a_random_walk():
    """Their covariance is that of a Wiener process that ends at 0."""
    times = np.linspace(0, 1, 6)
    values = FreeDrift(0.0, 1.0).values(np.arange(6), times)
    np.testing.assert_allclose(values @ values.T, 1 - np.maximum(times, times[:, None]), atol=0.03)


def test_errors_of_joints_along_a_path_are_no_change():
    """Residuals of a path change slowly; left-out blocks of time show that no cause explains them."""
    simulation = Simulation("ur10", 291, 52, is_path=True)
    simulation.add_eccentricities(2.3e-3)
    fit = calibrate(simulation.chain, simulation.measure(Position), extend="none")
    assert not session_of(fit).found


def test_two_robots_are_refused():
    simulation = Simulation("ur10", 100, 3)
    fit = calibrate(simulation.chain, simulation.measure(Position, Changes(has_second_robot=True)))
    assert fit.verdict.is_refused
    assert "Two robots were measured" in fit.verdict.reasons[0]
    (event,) = [event for event in session_of(fit).events if event.kind == "robot"]
    assert (event.before.line, event.after.line) == (50, 51)


@pytest.mark.parametrize("of", ["base", "tool"])
def test_one_robot_with_several_events_is_not_two(of):
    """No cause was kept, so that a second robot would explain base or tool and the joint at once."""
    search = search_of(Changes(of, 2e-3, joint=(2, DEGREE)))
    assert search.causes == []
    assert search.other_robot() is None


@pytest.mark.parametrize("seed", some_slow([103, 123, 131, 153], {0}))
def test_few_poses_of_one_robot_are_not_those_of_two(seed):
    """Half of 20 poses with noise fit any robot. Gear ratios are wrong, too."""
    rng = np.random.default_rng(seed)
    size = 10 ** rng.uniform(-3.6, -2.5)
    sim = Simulation("xarm7", 20, seed, errors=(size, size))
    gains, poses = 1 + rng.normal(0, size, sim.chain.n_joints), sim.poses
    sim.poses = lambda q, model=None: poses(q * gains, model)
    measured = sim.measure(Pose).poses.copy()
    measured[:, :3, 3] += 1.5e-4 * rng.standard_normal((20, 3))
    turns = [pin.exp3(3e-4 * rng.standard_normal(3)) for _ in measured]
    measured[:, :3, :3] = measured[:, :3, :3] @ np.array(turns)
    fit = calibrate(sim.chain, Pose(sim.q, measured))
    assert not session_of(fit).has_two_robots
    assert fit.verdict.status != "refused", fit.verdict.reasons


TWO_ROBOTS = list(product([1, 2], [(Pose, 3e-4, 25), (Pose, 8e-3, 40), (Position, 8e-3, 60)]))


@pytest.mark.parametrize(("n_files", "case"), some_slow(TWO_ROBOTS, {0, 2, 3}))
def test_two_robots_of_any_difference_are_refused(n_files, case):
    kind, size, count = case
    simulation = Simulation("xarm7", 120, 7, errors=(size, 2 * size))
    first = simulation.measure(kind).take(np.arange(120 - count)).replace(source="1.csv")
    simulation.disturb(simulation.model)
    second = simulation.measure(kind).take(np.arange(120 - count, 120)).replace(source=f"{n_files}.csv")
    data = [first, second] if n_files == 2 else [concatenate([first, second])]
    fit = calibrate(simulation.chain, data)
    assert fit.verdict.is_refused
    assert f"Two robots were measured: from line {121 - count} of {n_files}.csv" in fit.verdict.reasons[0]


def test_a_lag_is_found_and_mended():
    simulation = Simulation("ur10", 200, 4, is_path=True)
    data = simulation.measure(Position, Changes(lag=0.4))
    fit = calibrate(simulation.chain, data, extend="none")
    lag = session_of(fit).lag
    assert lag is not None
    assert lag.value == pytest.approx(0.4, abs=0.01)
    assert fit.verdict.status == "caution"
    assert lag.is_corrected
    clean = Simulation("ur10", 200, 4, is_path=True)
    expected = calibrate(clean.chain, clean.measure(Position), extend="none")
    assert simulation.true_error(fit.chain) <= 1.5 * clean.true_error(expected.chain)
    key = lag.consequence.rsplit(" ", 1)[1].rstrip(".")
    mended = calibrate(simulation.chain, mend(simulation.chain, data, key), extend="none")
    assert session_of(mended).lag is None
    assert simulation.true_error(mended.chain) <= 1.5 * clean.true_error(expected.chain)


def test_a_lag_is_tried_as_the_only_cause():
    with_lag, without = (search_of(Changes("base", 2e-3, lag=lag)) for lag in (0.4, 0.0))
    for search in (with_lag, without):
        search.run()
        assert "base" in [cause.block.kind for cause in search.causes]
    alone = with_lag.with_lag_alone()
    assert alone is not None
    (cause,) = alone.causes
    assert cause.block.kind == "lag"
    assert cause.values == pytest.approx([0.4], abs=0.01)
    assert without.with_lag_alone() is None


@pytest.mark.parametrize(("lag", "seed"), some_slow(list(product([0.02, 0.1, -0.3, 1.6], range(3))), {0, 11}))
def test_no_joint_errors_or_steps_are_fitted_to_a_lag(lag, seed):
    simulation, clean = (Simulation("ur10", 300, seed, is_path=True) for _ in range(2))
    fit = calibrate(simulation.chain, simulation.measure(Position, Changes(lag=lag)))
    assert [found.value for found in session_of(fit).found] == pytest.approx([lag], abs=0.005)
    assert fit.extension is not None
    assert not fit.extension.families
    expected = calibrate(clean.chain, clean.measure(Position), extend="none", session="off")
    assert simulation.true_error(fit.chain) <= 2 * clean.true_error(expected.chain)


@pytest.mark.parametrize(
    ("scales", "seed"),
    some_slow([((1.0, 1.0, 1.003), 6), ((1.0, 1.0, 1.02), 7), ((1.015, 1.015, 1.015), 6)], {0, 2}),
)
def test_a_wrong_scale_is_found_and_mended(scales, seed):
    simulation = Simulation("ur10", 100, seed)
    data = simulation.measure(Position, Changes(scales=scales))
    fit = calibrate(simulation.chain, data, extend="none")
    (scale,) = session_of(fit).scales
    assert ("too long compared with the other axes" in scale.finding) == bool(scale.axis)
    assert scale.finding.startswith("Measured z is" if scale.axis else "The correction makes the whole robot")
    assert scale.axis == ("z" if scales[0] == 1 else "")
    assert scale.factor == pytest.approx(scales[2], abs=3 * scale.std)
    assert fit.verdict.status == "caution"
    before = simulation.true_error(fit.chain)
    key = session_of(fit).scales[0].consequence.rsplit(" ", 1)[1].rstrip(".")
    mended = calibrate(simulation.chain, mend(simulation.chain, data, key), extend="none")
    assert not session_of(mended).scales
    assert simulation.true_error(mended.chain) < 0.3 * before


@pytest.mark.parametrize("factor", some_slow([0.85, 0.95, 1.15], {0}))
def test_a_large_scale_of_all_lengths_is_exact(factor):
    simulation = Simulation("panda", 60, 5)
    data = simulation.measure(Position, Changes(scales=(factor, factor, factor)))
    (scale,) = session_of(calibrate(simulation.chain, data, extend="none")).scales
    assert scale.factor == pytest.approx(factor, abs=3 * scale.std)


def test_a_large_scale_is_the_cause_of_the_errors_that_it_leaves():
    simulation = Simulation("ur10", 100, 6)
    data = simulation.measure(Position, Changes(scales=(1.0, 1.0, 1.1)))
    fit = calibrate(simulation.chain, data, extend="none")
    first, second = fit.verdict.reasons
    assert first.startswith("The fit leaves an RMS position error of")
    assert first.endswith("mm. Measured z is 10 % too long compared with the other axes.")
    assert second.startswith("Measured z is 10 % too long")


@pytest.mark.parametrize("factor", [1, 20])
def test_a_scale_has_the_mean_and_the_scatter_of_its_posterior_distribution(factor):
    """Computed on a grid of scales and of factors of the errors of the arm, also for noisy measurements."""
    simulation = Simulation("ur10", 100, 6)
    data = simulation.measure(Position, Changes(scales=(1.015, 1.015, 1.015)))
    fit = calibrate(simulation.chain, data, extend="none", session="off")
    problem, x = fit.problem, fit.solution.x
    arm = [i for i, p in enumerate(problem.errors.parameters) if p.name[:4] not in ("base", "tool")]
    if factor > 1:
        problem = problem.with_data([each.with_scaled_sigma({"position": factor}) for each in problem.data])
    noise, change, *both = _responses(problem, x, np.array(arm))
    if factor == 1:
        root = fit.solution.system.sqrt_covariance(problem.weights)[0][arm]
        np.testing.assert_allclose(noise, root @ root.T, atol=1e-4 * np.abs(noise).max())
    scale = find_scale(problem, x)
    assert scale is not None
    # Errors of the scale as fractions of the measured lengths.
    found, std = 1 - 1 / scale.factor, scale.std / scale.factor**2
    grid = found + std * np.linspace(-8, 8, 81)
    logs = np.array([
        multivariate_normal(cov=a**2 * both[0] + b**2 * both[1] + noise, allow_singular=True).logpdf(
            x[arm] - np.outer(grid, change)
        )
        for a, b in product(LENGTH_FACTORS, ANGLE_FACTORS)
    ])  # fmt: skip
    density = np.exp(logs - logs.max()).sum(0)
    mean = np.average(grid, weights=density)
    assert found == pytest.approx(mean, rel=1e-3)
    assert std == pytest.approx(np.sqrt(np.average((grid - mean) ** 2, weights=density)), rel=0.01)
    assert find_scale(problem, 0.1 * x) is None


def test_errors_of_origins_change_the_estimates_as_in_calibrations():
    """Each origin of an exact arm has an error in turn."""
    simulation = Simulation("ur10", 40, 6)
    chain = simulation.chain.with_base_and_tool(simulation.base.homogeneous, simulation.tool.homogeneous)
    errors, origins = (select_parameters(chain, f"{name},base,tool") for name in ("minimal", "placement"))
    weights, arm = 1 / errors.priors, np.flatnonzero(errors.is_of_arm)

    def problem_of(truth):
        positions = truth.poses(simulation.q)[:, :3, 3]
        return make_problem(errors, (Position(simulation.q, positions, 1e-4),), weights, {})

    expected = {unit: np.zeros((len(arm), len(arm))) for unit in ("m", "rad")}
    for i, parameter in enumerate(origins.parameters):
        size = {"m": LENGTH_PRIOR, "rad": ANGLE_PRIOR}[parameter.unit]
        x = minimize(problem_of(origins.at(size * np.eye(len(origins.parameters))[i]))).x[arm]
        expected[parameter.unit] += np.outer(x, x)
    _, _, *found = _responses(problem_of(chain), np.zeros(len(weights)), arm)
    for each, unit in zip(found, expected, strict=True):
        np.testing.assert_allclose(each, expected[unit], atol=0.05 * np.abs(expected[unit]).max())


def test_a_scale_is_the_same_with_redundant_parameters_and_without_priors():
    simulation = Simulation("ur10", 100, 6)
    data, found = simulation.measure(Position, Changes(scales=(1.015, 1.015, 1.015))), []
    for fit in (
        calibrate(simulation.chain, data, extend="none", session="off"),
        calibrate(simulation.chain, data, "placement,base,tool", priors="none", extend="none", session="off"),
    ):
        scale = find_scale(fit.problem, fit.solution.x)
        assert scale is not None
        found.append((scale.factor, scale.std))
    np.testing.assert_allclose(*found, rtol=1e-2, atol=0)
    assert found[0][0] == pytest.approx(found[1][0], abs=1e-5)


@pytest.mark.parametrize(("shape", "by"), [("linear", "by 0.300 mm"), ("free", "by up to 0.300 mm")])
def test_only_an_irregular_drift_has_a_largest_size(shape, by):
    for kind in ("base", "links"):
        drift = SlowChange(kind, kind, 3e-4, 2e-5, "m", shape, None, "row")
        assert by in drift.finding


def test_a_scale_is_stated_in_percent():
    assert Scale(1.003, 1e-4, "").finding == "The correction makes the whole robot 0.300 ± 0.010 % longer."
    assert Scale(1.003, 1e-4, "z").finding == "Measured z is 0.3 % too long compared with the other axes."
    assert Scale(0.985, 1e-4, "").finding == "The correction makes the whole robot 1.500 ± 0.010 % shorter."
    assert Scale(0.985, 1e-4, "", ("a.csv", "b.csv")).consequence.endswith(
        "add --mend scale:0.985@a.csv --mend scale:0.985@b.csv."
    )
    # A UR10 measured with the model of a UR5: undoing the scale would make both wrong.
    assert Scale(1.448, 1e-3, "").consequence == (
        "No instrument is so wrong: the robot file is probably that of a robot of another size."
    )


@pytest.mark.parametrize("n_outliers", [0, 6])
def test_changes_are_refined_in_spite_of_outliers(n_outliers):
    """The same samples as those of the search show the same change, about as uncertain as it was."""
    simulation = Simulation("ur10", 60, 3)
    data = simulation.measure(Pose, Changes("base", 1e-3, n_outliers=n_outliers))
    chain = simulation.chain.with_base_and_tool(simulation.base.homogeneous, simulation.tool.homogeneous)
    errors = select_parameters(chain, "minimal,base,tool")
    problem = make_problem(errors, (data,), 1 / errors.priors, {})
    x = np.zeros(len(errors.parameters))
    session = find_session(problem, x, (), is_ordered=True)
    refined = refine_changes(session, problem, x)
    (before,), (after,) = session.causes, refined.causes
    std = np.sqrt(np.diag(before.covariance))
    assert np.all(np.abs(after.values - before.values) < 2 * std)
    # The search has one noise for positions and one for rotations.
    ratio = np.sqrt(np.diag(after.covariance)) / std
    assert 0.8 < ratio.min() <= ratio.max() < 1.6


def test_a_small_scale_is_found_with_an_accurate_arm():
    simulation = Simulation("ur10", 100, 6, errors=(1e-4, 0.02 * DEGREE))
    data = simulation.measure(Position, Changes(scales=(1.003, 1.003, 1.003)))
    (scale,) = session_of(calibrate(simulation.chain, data, extend="none")).scales
    assert scale.factor == pytest.approx(1.003, abs=3 * scale.std)
    assert scale.std < 2e-4


def test_a_coordinate_in_another_unit_is_no_scale():
    """No scale is stated that `--mend` would not undo; the unit is named as a mistake."""
    simulation = Simulation("ur10", 100, 6)
    data = simulation.measure(Position)
    data = data.replace(values=data.positions() * [1, 1, 1e-3])
    fit = calibrate(simulation.chain, data, extend="none")
    assert not session_of(fit).scales
    assert any("--mend z:m-not-mm" in reason for reason in fit.verdict.reasons)


def test_files_are_segments_even_without_an_order():
    simulation = Simulation("ur10", 100, 7)
    changes = Changes("tool", 5e-3)
    data = simulation.measure(Position, changes)
    parts = [data.take(np.s_[:50]).replace(source="a.csv"), data.take(np.s_[50:]).replace(source="b.csv")]
    rng = np.random.default_rng(0)
    shuffled = [part.take(rng.permutation(50)) for part in parts]
    shuffled = [part.replace(rows=np.arange(2, 52)) for part in shuffled]
    fit = calibrate(simulation.chain, shuffled, extend="none", session="unordered")
    (event,) = session_of(fit).events
    assert (event.kind, event.before.file, event.file) == ("tool", "a.csv", "b.csv")
    assert "between a.csv and b.csv" in fit.verdict.reasons[0]
    assert simulation.true_error(fit.chain) < 1e-4
    whole = data.take(rng.permutation(100)).replace(rows=np.arange(2, 102))
    assert not session_of(calibrate(simulation.chain, whole, extend="none", session="unordered")).events


def test_times_order_the_samples():
    simulation = Simulation("ur10", 100, 8)
    data = simulation.measure(Position, Changes("base", 2e-3, at=None, time_constant=0.2))
    shuffled = data.with_conditions(time=10.0 * np.arange(100))
    fit = calibrate(simulation.chain, shuffled, extend="none")
    (drift,) = session_of(fit).drifts
    assert drift.time_unit == "s"
    assert drift.time_constant == pytest.approx(200, rel=0.3)


@pytest.mark.parametrize(
    "series", some_slow(["B/measurements_joint_configurations", "D/measurements_iso_cubes"], ())
)
def test_nothing_happened_in_the_public_series_of_a_ur10(series):
    """Left-out blocks of time of these series are not predicted better by any event or drift."""
    if not DATA.exists():
        missing(f"measurements at {DATA}")
    chain = nominal_arm("ur10")
    data = read_measurements(DATA / f"ipa_ur10/Series_{series}.csv", chain, MAPS / "ipa_ur10.toml")
    assert not session_of(calibrate(chain, data, extend="none")).found


def test_repeated_samples_count_once():
    """Samples of one stop share the error of the model; repeating them is no evidence of an event."""
    simulation = Simulation("ur10", 60, 11)
    data = simulation.measure(Position)
    repeated = Position(np.repeat(data.q, 4, 0), np.repeat(data.positions(), 4, 0))
    assert not session_of(calibrate(simulation.chain, repeated, extend="none")).found
    moved = Simulation("ur10", 60, 11)
    data = moved.measure(Position, Changes("base", 2e-3))
    repeated = Position(np.repeat(data.q, 4, 0), np.repeat(data.positions(), 4, 0))
    (event,) = session_of(calibrate(moved.chain, repeated, extend="none")).events
    assert event.line == 4 * 30 + 1


def test_few_rows_are_not_examined():
    simulation = Simulation("ur10", 8, 0)
    fit = calibrate(simulation.chain, simulation.measure(Pose), extend="none")
    assert session_of(fit).found == ()


def test_commands_state_what_happened(tmp_path, capsys, undrawn):
    simulation = Simulation("ur10", 100, 9)
    robot, file = robot_file(ARMS["ur10"][0]), tmp_path / "bump.csv"
    write_csv(file, simulation, simulation.measure(Position, Changes("base", 5e-3)))
    words = ["calibrate", robot, file, "--tip", "tool0", "-o", tmp_path / "out.urdf"]
    outputs = ["--json", tmp_path / "out.json", "--report", tmp_path / "out.html"]
    assert main([*map(str, words), *map(str, outputs)]) == 0
    document = json.loads((tmp_path / "out.json").read_text())
    (event,) = document["session"]["events"]
    assert (event["kind"], event["line"], event["unit"]) == ("base", 52, "m")
    assert event["file"] == str(file)
    assert event["size"] == pytest.approx(5e-3, abs=3 * event["std"])
    assert document["verdict"]["status"] == "caution"
    assert "Change of base" in (tmp_path / "out.html").read_text()
    assert "The base moved by" in capsys.readouterr().err
    assert main(["inspect", str(file), "--robot", str(robot), "--tip", "tool0"]) in (0, 1)
    assert "The base moved by" in " ".join(capsys.readouterr().err.split())
    assert main([*map(str, words), *map(str, outputs[:2]), "--session", "off"]) == 0
    assert json.loads((tmp_path / "out.json").read_text())["session"]["events"] == []


@pytest.mark.parametrize("key", ["lag:1e9", "lag:-", "scale:0", "scale:z:7", "range:0.2", "range:x:0.01"])
def test_impossible_changes_are_refused(tmp_path, capsys, key):
    simulation = Simulation("ur10", 20, 9)
    file = tmp_path / "data.csv"
    write_csv(file, simulation, simulation.measure(Position))
    robot = str(robot_file(ARMS["ur10"][0]))
    words = ["calibrate", robot, str(file), "--tip", "tool0", "-o", str(tmp_path / "out.urdf"), "--mend", key]
    assert main(words) == 2
    assert key in capsys.readouterr().err
    assert not (tmp_path / "out.urdf").exists()


def test_held_out_samples_without_a_file_belong_to_the_measurements_beside_them():
    data = Simulation("ur10", 30, 1).measure(Position).replace(source="")
    first, second, apart = (data.take(np.s_[a:b]) for a, b in ((0, 10), (10, 20), (20, 30)))
    assert _file_numbers([first, second], [apart, apart]) == [0, 1, 0, 1]
    # Rows that were fitted, too, and further measurements are those of other files.
    assert _file_numbers([first, second], [first, apart, apart]) == [0, 1, 2, 1, 4]
    named = data.replace(source="a.csv")
    assert _file_numbers([named, first, named], [named, apart]) == [0, 1, 0, 0, 1]


def gantry(tmp_path):
    """Return an arm with two revolute joints on three rails."""
    joints = [("x", "prismatic", "1 0 0"), ("y", "prismatic", "0 1 0"), ("z", "prismatic", "0 0 1")]
    joints += [("turn", "revolute", "0 0 1"), ("tilt", "revolute", "0 1 0")]
    text = '<robot name="gantry"><link name="link0"/>'
    for i, (name, kind, axis) in enumerate(joints):
        text += (
            f'<link name="link{i + 1}"/><joint name="{name}" type="{kind}"><parent link="link{i}"/>'
            f'<child link="link{i + 1}"/><origin xyz="0.1 0 0.2"/><axis xyz="{axis}"/>'
            '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        )
    path = tmp_path / "gantry.urdf"
    path.write_text(text + "</robot>")
    return Chain.from_urdf(path, "link5").with_base_and_tool(np.eye(4), se3.translation([0.1, 0.05, 0.2]))


def test_the_zero_of_a_rail_changes_like_the_base(tmp_path):
    """The base moves along a rail, which cannot be distinguished; the zero of a turned joint can."""
    arm, rng = gantry(tmp_path), np.random.default_rng(1)
    q = rng.uniform(-0.9, 0.9, (60, 5))
    positions = arm.poses(q)[:, :3, 3] + 5e-5 * rng.standard_normal((60, 3))
    positions[30:, 0] += 1e-3
    fit = calibrate(arm, Position(q, positions, 5e-5))
    assert fit.session
    (event,) = fit.session.events
    assert event.size == pytest.approx(1e-3, rel=0.1)
    assert (event.kind, event.of) == ("joint", "x")
    assert event.consequence.endswith("A motion of the base has the same effect.")
    wrong = q.copy()
    wrong[30:, 4] += 5e-3
    fit = calibrate(arm, Position(wrong, arm.poses(q)[:, :3, 3] + 5e-5 * rng.standard_normal((60, 3)), 5e-5))
    assert fit.session
    (event,) = fit.session.events
    assert (event.kind, event.of) == ("joint", "tilt")
    assert "base" not in event.consequence
