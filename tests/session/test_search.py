"""Parts of the search for what happened during a session, against linear algebra and known changes."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sessions import NOISE, Changes, Simulation, search_of, searched

from dhcal_pin import se3, select_parameters
from dhcal_pin.estimation.initialization import make_problem
from dhcal_pin.measurements import PointContact, PointDistance, Pose, Position
from dhcal_pin.robot.error_families import MIN_TORQUE
from dhcal_pin.session import search as search_module
from dhcal_pin.session.causes import HELD_SIZE, Block, Cause, Constant, Drift, FreeDrift, Step
from dhcal_pin.session.linear_model import covariance_root, inverse, measures_positions, solve_information
from dhcal_pin.session.robot_changes import Motion, RobotChanges
from dhcal_pin.session.search import (
    FINE_CONSTANTS,
    HUBER_LIMIT,
    MAX_ITERATIONS,
    MAX_MOVES,
    OUTLIER_WEIGHT,
    TIME_CONSTANTS,
    WIDTHS,
    _bounded_cost,
    _cell_products,
    _cost,
    _evidence_of,
    _information,
    _is_part_of_model,
    _is_suspicious,
    _predicted_gain,
    can_have_session,
    find_session,
    has_enough_rows,
)
from dhcal_pin.session.timeline import order_samples


def cause_of(search, kind, shape, values: Any = 0.0, *, index=0):
    """Return a cause of the first block of a kind, or of another one of them."""
    block = [each for each in search.layout.blocks if each.kind == kind][index]
    count = len(block.columns) * shape.values(search.numbers[:1], search.times[:1]).shape[1]
    values = np.broadcast_to(values, count).astype(float)
    return Cause(block, shape, values, np.zeros((count, count)))


def weighted(fit, extra):
    """Return columns and target of a fit in units of noise, with rows of the priors below, and a column."""
    root = 1 / fit.noise
    rows = (fit.columns * root[..., None]).reshape(-1, len(fit.prior))
    return np.vstack([rows, np.diag(fit.prior)]), np.append((extra * root).ravel(), np.zeros(len(fit.prior)))


def files_of(*parts):
    """Return measurements with names of files."""
    return tuple(
        item.replace(source=f"{i}.csv", rows=np.arange(2, 2 + len(item.rows))) for i, item in enumerate(parts)
    )


def test_rows_of_one_unit_have_one_noise_if_it_is_stated_alike():
    simulation = Simulation("ur10", 40, 3)
    poses = simulation.measure(Pose)
    q, points = poses.q, poses.positions()
    data = files_of(
        Position(q[:10], points[:10], NOISE), poses.take(np.s_[10:30]), Position(q[30:], points[30:], NOISE)
    )
    search = searched(simulation, data)
    np.testing.assert_array_equal(search.groups[:10], np.tile([0, 0, 0, -1, -1, -1], (10, 1)))
    np.testing.assert_array_equal(search.groups[10:30], np.tile([1, 1, 1, 2, 2, 2], (20, 1)))
    np.testing.assert_array_equal(search.groups[30:], search.groups[:10])
    for label, members in enumerate(search.members):
        np.testing.assert_array_equal(members, np.flatnonzero(search.groups.ravel() == label))
    # Each of them is estimated, and is that of the rows.
    noise = search.first_fit.noise
    for label in range(3):
        assert np.ptp(noise[search.groups == label]) < 1e-12
    size = noise[0, 0] * NOISE, noise[10, 0] * poses.sigma[0, 0]
    assert size == pytest.approx((NOISE, NOISE), rel=0.5)
    assert search.log_noise(search.first_fit) == pytest.approx(np.mean(np.log(noise[search.groups >= 0])))


def touching(count=30):
    """Return a simulation and touches of three points with distances, which have no time and need not fit."""
    simulation = Simulation("ur10", count, 3)
    contacts = PointContact(simulation.q, ["p1", "p2", "p3"] * (count // 3))
    distances = PointDistance(6, [("p1", "p2"), ("p1", "p3"), ("p2", "p3")], [1.0, 1.0, 1.0])
    return simulation, contacts, distances


def test_distances_have_no_step_and_precede_all_cells():
    simulation, contacts, distances = touching()
    search = searched(simulation, (contacts.initialized(simulation.chain), distances), n_cells=7)
    assert search.begin == 3
    assert (search.edges[0], search.edges[-1], len(search.edges)) == (3, 33, 8)
    np.testing.assert_array_equal(search.numbers, range(33))
    steps = [shape.number for shape in search._shapes(Step, ()) if isinstance(shape, Step)]
    assert steps == search.edges[1:-1].tolist()
    fine = searched(simulation, (contacts.initialized(simulation.chain), distances), n_cells=99)
    assert len(fine.edges) == 31
    steps = [shape.number for shape in fine._shapes(Step, (20,)) if isinstance(shape, Step)]
    assert steps == [*range(6, 18), *range(23, 31)]
    drifts = [shape for shape in search._shapes(Drift, ()) if isinstance(shape, Drift)]
    assert {(drift.begin, drift.end) for drift in drifts} == {(3.0, 32.0)}
    assert [drift.time_constant / 29 for drift in drifts] == pytest.approx(TIME_CONSTANTS)
    # They are no samples of either side, and no outliers.
    assert search._concerned(cause_of(search, "base", Step(3 + 6))) == pytest.approx(0.2)
    weights = np.where(np.arange(33) < 9, 0.4, 1.0)
    fit = replace(search.first_fit, weights=weights)
    for shape, share in (
        (Step(13), 0.6),
        (Step(23), 0.0),
        (Step(18), 0.0),
        (Step(17), 6 / 14),
        (Drift(3.0, 32.0), 0.2),
    ):
        assert search._outlier_share(fit, cause_of(search, "base", shape)) == pytest.approx(share)
    edge = replace(fit, weights=np.full(33, OUTLIER_WEIGHT))
    assert search._outlier_share(edge, cause_of(search, "base", Step(13))) == 0


def test_only_an_order_shows_lags_and_drifts(monkeypatch):
    simulation = Simulation("ur10", 60, 3, is_path=True)
    data = simulation.measure(Pose)
    search = searched(simulation, (data,))
    assert search.paths is not None
    lag, links = (cause_of(search, kind, Constant()).block for kind in ("lag", "links"))
    assert search._kinds(lag) == [Constant]
    # Its linear effect does not say how large it is.
    assert search._can_have_effect(search.first_fit, cause_of(search, "lag", Constant()))
    assert search._kinds(links) == [Drift, FreeDrift]
    search.causes = [cause_of(search, "lag", Constant())]
    assert search._kinds(lag) == [Step, Drift]
    search.rejected = {(lag, Step), (links, Drift)}
    assert (search._kinds(lag), search._kinds(links)) == ([Drift], [FreeDrift])
    unordered = searched(simulation, files_of(data.take(np.s_[:20]), data.take(np.s_[20:])), is_ordered=False)
    assert unordered.paths is None
    kinds = {b.kind: unordered._kinds(b) for b in unordered.layout.blocks if not b.changes_between_files}
    assert (kinds["lag"], kinds["base"], kinds["links"], kinds["scale"]) == ([], [Step], [], [Constant])
    assert [unordered._kinds(b) for b in unordered.layout.blocks if b.changes_between_files] == [[Step]]
    assert unordered._shapes(Step, ()) == [Step(20)]
    monkeypatch.setattr(search_module, "MAX_PATH_SAMPLES", 59)
    assert searched(simulation, (data,)).paths is None
    monkeypatch.setattr(search_module, "MAX_PATH_SAMPLES", 60)
    assert searched(simulation, (data,)).paths is not None


def test_functions_of_time_begin_and_end_with_the_samples():
    search = search_of(Changes())
    assert search._shapes(Constant, ()) == [Constant()]
    assert search._shapes(FreeDrift, ()) == [FreeDrift(0.0, 59.0)]
    steps = [shape.number for shape in search._shapes(Step, (10, 30)) if isinstance(shape, Step)]
    assert steps == [*range(3, 8), *range(13, 28), *range(33, 58)]
    search.causes = [
        cause_of(search, kind, Step(n)) for kind, n in (("base", 10), ("tool", 20), ("base", 30))
    ]
    assert search._taken_steps(search.causes[0].block) == (10, 30)


def test_samples_at_one_time_have_no_drift():
    sim = Simulation("ur10", 20, 0)
    search = searched(sim, (sim.measure(Pose).with_conditions(time=np.full(20, 7.0)),), n_cells=20)
    assert search._shapes(Drift, ()) == search._shapes(FreeDrift, ()) == []
    assert len(search._shapes(Step, ())) > 2


def test_configurations_of_repeated_rows_count_once():
    """A scale and a lag need two rows of different configurations for each unknown."""
    simulation = Simulation("ur10", 60, 3)
    data = simulation.measure(Pose)
    n_unknowns = len(searched(simulation, (data,)).layout.weights)
    for count in (2 * n_unknowns // 6 - 1, 2 * n_unknowns // 6 + 1):
        part = data.take(np.repeat(np.arange(count), 2))
        assert searched(simulation, (part,)).has_different_rows == (6 * count >= 2 * n_unknowns)


@pytest.mark.parametrize("n_outliers", [0, 4])
def test_a_fit_is_the_solution_of_its_weighted_equations(n_outliers):
    search = search_of(Changes("base", 1e-4, n_outliers=n_outliers))
    causes = [cause_of(search, "base", Step(30))]
    fit = search.solve(search.rows, causes)
    left = search.rows[..., -1] - fit.columns @ fit.step
    np.testing.assert_allclose(fit.residual * fit.noise, left, atol=1e-9)
    # Weights bound the influence of samples.
    size = np.sqrt(np.mean(fit.residual**2, 1))
    expected = np.minimum(1.0, HUBER_LIMIT / size)
    np.testing.assert_allclose(fit.weights, expected, atol=0.05)
    assert np.sum(fit.weights < OUTLIER_WEIGHT) == n_outliers
    # Solved with these weights by another method.
    root = np.sqrt(fit.weights)[:, None] / fit.noise
    a = np.vstack([(fit.columns * root[..., None]).reshape(360, -1), np.diag(fit.prior)])
    b = np.append((search.rows[..., -1] * root).ravel(), np.zeros(len(fit.prior)))
    expected = np.linalg.lstsq(a, b)[0]
    std = np.sqrt(np.diag(np.linalg.inv(a.T @ a)))
    assert np.abs((fit.step - expected) / std).max() < 0.1
    np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance)), std, rtol=1e-4)
    # Bounded residuals have unit variance, for as many rows as unknowns leave.
    bounded = fit.residual * fit.weights[:, None]
    freedom = 360 - np.sum((a[:360] @ np.linalg.inv(a.T @ a)) * a[:360])
    assert np.sum(bounded**2) == pytest.approx(freedom, rel=0.05)
    # The score is the derivative by all unknowns.
    score = np.tensordot(bounded / fit.noise, fit.columns, 2) - fit.prior**2 * fit.step
    np.testing.assert_allclose(fit.score, score, atol=1e-6 * np.abs(score).max() + 1e-9)


def test_a_fit_moves_from_the_present_values_with_their_priors():
    """Unknowns that the samples do not show go back to zero."""
    search = search_of(Changes())
    rows = np.zeros_like(search.rows)
    rows[..., -1] = np.random.default_rng(0).normal(size=rows.shape[:2])
    search.x = np.arange(1.0, 1 + len(search.x))
    fit = search.solve(rows, [cause_of(search, "base", Step(30), 0.5)])
    np.testing.assert_allclose(fit.step, -np.append(search.x, np.full(6, 0.5)), rtol=1e-6)
    assert fit.prior[-6:] == pytest.approx(1 / search.layout.blocks[0].sizes)


def test_a_step_of_a_fit_moves_unknowns_and_causes():
    search = search_of(Changes())
    search.causes = [cause_of(search, "joint", Step(30), 1e-4, index=2), cause_of(search, "base", Step(20))]
    fit = search.solve(search.rows, search.causes)
    p, x = len(search.x), search.x
    step = np.append(1e-4 * np.arange(1.0, p + 1), [5e-4, *(1e-4 * np.arange(6))])
    base = search._base()
    search._advance(replace(fit, step=step))
    np.testing.assert_allclose(search.x, x + step[:p])
    np.testing.assert_allclose(search.causes[0].values, [6e-4])
    np.testing.assert_allclose(search.causes[1].values, step[p + 1 :])
    np.testing.assert_array_equal(search.causes[0].covariance, fit.covariance[p : p + 1, p : p + 1])
    np.testing.assert_array_equal(search.causes[1].covariance, fit.covariance[p + 1 :, p + 1 :])
    ((joint, shape, size),) = search.changes.zeros
    assert (joint, shape, size) == (2, Step(30), pytest.approx([5e-4]))
    expected = base @ se3.exp6(-step[p + 1 :]) @ se3.inverse(base)
    np.testing.assert_allclose(search.changes.base.poses[0], expected, atol=1e-12)
    # Without the causes of other parts, their changes remain.
    search._drop_others()
    assert search.changes.base.steps == (20,)
    alone = search._changes_of(search.causes[:1])
    assert (alone.base.is_identity, len(alone.zeros)) == (True, 1)
    del search.causes[0]
    search._drop_others()
    assert search.changes.zeros == ()


def test_rows_without_a_cause_are_those_of_a_robot_that_did_not_change():
    search = search_of(Changes("base", 2e-3))
    search.causes = [cause_of(search, "joint", Step(20), index=1), cause_of(search, "base", Step(30))]
    search.iterate(search._fit())
    rows = search.linearize()
    # In first order, the change of the residuals is that of the columns.
    undone, without = search._undone(rows, search.causes[1]), search._linearized_without(1)
    change = (undone - rows)[..., -1]
    np.testing.assert_allclose((without - rows)[..., -1], change, atol=0.02 * np.abs(change).max())
    assert np.abs(change[:30]).max() > 1
    np.testing.assert_array_equal(undone[..., :-1], rows[..., :-1])
    np.testing.assert_allclose(without[30:, :, -1], rows[30:, :, -1], atol=1e-9)


def test_the_effect_of_a_cause_is_what_other_unknowns_leave_of_it():
    search = search_of(Changes())
    fit = search.first_fit
    for shape, share in ((Step(15), 0.25), (Step(50), 1 / 6), (Drift(0.0, 59.0), 1.0)):
        cause = cause_of(search, "base", shape, 1e-4)
        own = cause.columns_of(search.rows, search.numbers, search.times) @ cause.values
        a, b = weighted(fit, own)
        left = (b - a @ np.linalg.lstsq(a, b)[0])[:360]
        assert search._effect(fit, cause) == pytest.approx(np.sqrt(left @ left / 360 / share), rel=1e-3)


@pytest.mark.parametrize("kind", [Step, Drift, FreeDrift])
@pytest.mark.parametrize(("n_outliers", "noise"), [(0, 1.0), (3, 1.0), (0, 1e4)])
def test_evidence_of_the_score_test_is_that_of_its_formula(kind, n_outliers, noise):
    """With much noise, the samples hardly show a cause."""
    search = search_of(Changes("base", 3e-4, n_outliers=n_outliers))
    fit, shapes = search.first_fit, search._shapes(kind, ())
    fit = replace(fit, noise=noise * fit.noise, score=fit.score / noise)
    blocks = [block for block in search.layout.blocks if block.kind in ("base", "tool")]
    found = list(search._scores(fit, blocks, shapes, search._products(fit)))
    assert [cause.block for cause in found] == blocks
    j = (fit.columns / fit.noise[..., None]).reshape(360, -1)
    residual = (fit.residual * fit.weights[:, None]).ravel()
    for cause in found:
        gains = {}
        for shape in shapes:
            sized = replace(cause, shape=shape)
            columns = sized.columns_of(fit.rows, search.numbers, search.times) / fit.noise[..., None]
            a = columns.reshape(360, -1)
            covariance = fit.test_root @ fit.test_root.T
            m = a.T @ a - a.T @ j @ covariance @ j.T @ a
            v = a.T @ residual - a.T @ j @ covariance @ fit.score
            for width in WIDTHS:
                prior = np.diag((width * cause.sizes) ** -2.0)
                estimate = np.linalg.solve(m + prior, v)
                log_det = np.linalg.slogdet(np.eye(len(m)) + np.linalg.solve(prior, m))[1]
                gains[0.5 * (v @ estimate - log_det)] = shape, estimate
        best = max(gains)
        shape, estimate = gains[best]
        assert cause.shape == shape
        expected = best - np.log(len(shapes)) - np.log(len(search.layout.blocks))
        assert cause.log_evidence == pytest.approx(expected, abs=1e-3 * abs(best) + 1e-3)
        np.testing.assert_allclose(cause.values, estimate, atol=1e-3 * np.abs(estimate).max())


def test_the_best_cause_is_that_of_greatest_evidence():
    search = search_of(Changes("tool", 2e-3))
    found = list(search._candidates(search.first_fit))
    best = search.best_cause(search.first_fit)
    assert best is not None
    assert best.log_evidence == max(cause.log_evidence for cause in found)
    assert (best.block.kind, best.shape) == ("tool", Step(30))
    # Each block with each of its functions of time once.
    pairs = [(id(cause.block), type(cause.shape)) for cause in found]
    assert sorted(map(str, pairs)) == sorted(
        str((id(block), kind)) for block in search.layout.blocks for kind in search._kinds(block)
    )


@pytest.mark.parametrize(
    ("changes", "begun", "shape"),
    [
        (Changes("base", 2e-3), Drift(0.0, 59.0), Step(30)),
        (Changes("base", 2e-3, at=None), FreeDrift(0.0, 59.0), Drift(0.0, 59.0)),
        (Changes("base", 2e-3, at=None), Drift(0.0, 59.0), None),
        (Changes("base", 2e-3, at=None, periods=1.5), FreeDrift(0.0, 59.0), None),
    ],
)
def test_a_drift_becomes_what_fits_best(changes, begun, shape):
    search = search_of(changes)
    search.causes = [cause_of(search, "tool", Step(20)), cause_of(search, "base", begun)]
    fit = search.iterate(search._fit())
    assert search._change_drifts(fit) == (shape is not None)
    assert [cause.shape for cause in search.causes] == [Step(20), shape or begun]
    # What another function of time explained is no longer part of the robot.
    assert (not search.changes.base.drifts) == isinstance(shape, Step)


@pytest.mark.parametrize(
    ("length", "shape", "can_have"),
    [(2e-3, Step(30), True), (2e-3, FreeDrift(0.0, 59.0), True), (0.0, Step(30), False)],
)
def test_a_cause_is_fitted_if_the_linear_model_shows_an_effect(length, shape, can_have):
    search = search_of(Changes("base", length))
    fit = search.iterate(search._fit())
    state = search.x, search.changes, list(search.causes), search.rows
    assert search._can_have_effect(fit, cause_of(search, "base", shape)) == can_have
    assert not search._can_have_effect(fit, cause_of(search, "tool", Step(15)))
    assert (search.x, search.changes, search.causes, search.rows) == state


def test_a_lag_is_found_from_which_a_search_begins():
    """The joint values are 0.3 rows too early; another cause is left out."""
    simulation = Simulation("ur10", 100, 3, is_path=True)
    search = searched(simulation, (simulation.measure(Pose, Changes(lag=0.3)),))
    search.move_lag()
    found = search.changes.lag_at(search.numbers, search.times)
    np.testing.assert_allclose(found[-1], 0.3, atol=0.02)
    assert {cause.block.kind for cause in search.causes} == {"lag"}
    own = list(search.causes)
    search._add(cause_of(search, "tool", Step(50)))
    alone = search.with_lag_alone()
    assert alone is not None
    assert [cause.block.kind for cause in alone.causes] == ["lag"] * len(own)
    assert len(search.causes) == len(own) + 1
    np.testing.assert_allclose(alone.changes.lag_at(search.numbers, search.times)[-1], 0.3, atol=0.02)


@pytest.mark.parametrize(("of", "is_of_configuration"), [("joint", True), ("link", True), ("joint", False)])
def test_errors_that_follow_a_joint_or_a_link_are_no_change_over_time(of, is_of_configuration):
    """A joint or the forearm points upwards in 18 of 60 consecutive samples; or the base moves there."""
    simulation = Simulation("ur10", 60, 3)
    is_high = (np.arange(60) >= 36) & (np.arange(60) < 54)
    angle = np.where(is_high, 1.0, -1.0) + simulation.rng.uniform(-0.5, 0.5, 60)
    # The forearm is turned by two joints.
    simulation.q[:, 2 if of == "link" else 1] = angle - (simulation.q[:, 1] if of == "link" else 0.0)
    data = simulation.measure(Pose)
    poses = data.poses.copy()
    poses[is_high if is_of_configuration else np.arange(60) >= 36, 0, 3] += 2e-3
    search = searched(simulation, (Pose(data.q, poses),))
    search.causes = [cause_of(search, "base", Step(36))]
    search.iterate(search._fit())
    assert search._follows_configuration(0) == is_of_configuration


@pytest.mark.parametrize(("n_low", "is_supported"), [(0, True), (7, True), (8, False), (30, False)])
def test_a_step_is_no_cause_if_a_quarter_of_its_shorter_side_are_outliers(n_low, is_supported):
    search = search_of(Changes("base", 3e-3))
    search.causes = [cause_of(search, "base", Step(30))]
    fit = search.iterate(search._fit())
    weights = np.where(np.arange(60) >= 60 - n_low, 0.4, 1.0)
    judged = search._judge(search.rows, replace(fit, weights=weights), 0)
    assert (judged.log_evidence > -np.inf) == is_supported


@pytest.mark.parametrize("kind", ["base", "joint"])
def test_a_step_moves_to_its_place_with_its_change(kind):
    changes = Changes("base", 2e-3) if kind == "base" else Changes(joint=(1, 2e-3))
    search = search_of(changes)
    search.causes = [
        cause_of(search, "tool", Drift(0.0, 59.0)),
        cause_of(search, kind, Step(24), index=0 if kind == "base" else 1),
    ]
    fit = search.iterate(search._fit())
    assert search._move_steps(fit)
    assert search.causes[1].shape == Step(30)
    if kind == "base":
        assert search.changes.base.steps == (30,)
    else:
        assert search.changes.zeros[0][:2] == (1, Step(30))
    fit = search.iterate(search._fit())
    assert not search._move_steps(fit)


def test_a_payload_is_a_constant_beside_its_steps():
    search = search_of(Changes())
    own = Block("payload", "", search.layout.payload, np.full(6, 1e-3), shapes=(Step,))
    search.layout = replace(search.layout, blocks=(*search.layout.blocks, own))
    for number in (20, 40):
        search._add(Cause(own, Step(number), np.ones(6), np.zeros((6, 6))))
    assert [cause.shape for cause in search.causes] == [Constant(), Step(20), Step(40)]
    assert [_is_part_of_model(cause) for cause in search.causes] == [True, False, False]
    assert not any(cause.values.any() for cause in search.causes)
    assert not _is_part_of_model(cause_of(search, "lag", Constant()))
    assert search._kinds(own) == [Step]
    search._remove(1)
    assert [cause.shape for cause in search.causes] == [Constant(), search.causes[1].shape]
    search._remove(1)
    assert search.causes == []
    search._add(cause_of(search, "tool", Step(20), 1.0))
    assert [cause.block.kind for cause in search.causes] == ["tool"]


def test_each_wire_has_a_constant_beside_its_steps():
    search = search_of(Changes())
    one, other = (Block("wire", name, np.array([0]), np.ones(1), shapes=(Step,)) for name in "12")
    search.layout = replace(search.layout, blocks=(*search.layout.blocks, one, other))
    for block, number in ((one, 20), (other, 30), (one, 40)):
        search._add(Cause(block, Step(number), np.ones(1), np.zeros((1, 1))))
    shapes = [(cause.block.of, cause.shape) for cause in search.causes]
    first = [("1", Constant()), ("1", Step(20)), ("2", Constant()), ("2", Step(30)), ("1", Step(40))]
    assert shapes == first
    search._remove(3)
    assert {cause.block.of for cause in search.causes} == {"1"}


@pytest.mark.parametrize(
    ("kind", "value", "is_negligible"),
    [
        ("lag", 0.009, True),
        ("lag", -0.009, True),
        ("lag", 0.011, False),
        ("lag", -0.011, False),
        ("base", 0.0, False),
    ],
)
def test_a_lag_of_a_hundredth_of_a_row_is_none(kind, value, is_negligible):
    search = search_of(Changes())
    assert search._is_negligible_lag(cause_of(search, kind, Constant(), value)) == is_negligible


def test_a_cause_is_judged_by_its_effect_and_by_left_out_blocks():
    search = search_of(Changes("base", 2e-3))
    for kind, is_right in (("base", True), ("tool", False)):
        search.causes, search.changes = [cause_of(search, kind, Step(30))], RobotChanges()
        fit = search.iterate(search._fit())
        judged = search._judge(search.rows, fit, 0)
        assert judged.shape == Step(30)
        assert (judged.log_evidence > 100) == is_right


@pytest.mark.parametrize("changes", [Changes("base", 2e-3), Changes("tool", 0.03, 0.01, n_outliers=2)])
def test_causes_are_found_confirmed_and_placed(changes):
    search = search_of(changes)
    search.run()
    (cause,) = search.causes
    assert (cause.block.kind, cause.shape) == (changes.of, Step(30))
    size = np.linalg.norm(
        search.changes.base.poses[0, :3, 3] if changes.of == "base" else search.changes.tool.poses[0, :3, 3]
    )
    assert cause.log_evidence > 100
    assert size == pytest.approx(changes.length, rel=0.1) or changes.angle
    assert search.with_lag_alone() is None
    assert search.stated(cause) is cause


def test_the_evidence_of_a_cause_has_the_information_of_the_samples_without_that_of_its_prior():
    search = search_of(Changes())
    cause = cause_of(search, "base", Step(30), 0.1)
    search.causes = [cause]
    fit, information = search.solve(search.rows, search.causes), np.array([0.5, 1.0, 2.0, 3.0, 5.0, 8.0])
    covariance = np.eye(len(fit.prior))
    covariance[-6:, -6:] = np.diag(cause.sizes**2 / (information + 1))
    vars(fit)["covariance"] = covariance
    squares = WIDTHS[:, None] ** 2
    cost = np.log1p(squares * information) + (cause.values / cause.sizes) ** 2 / squares
    expected = -0.5 * cost.sum(1).min() - np.log(len(search.edges)) - np.log(len(search.layout.blocks))
    assert search._log_evidence(cause, 0, fit, fit) == pytest.approx(expected, rel=1e-9)


# ------------------------------------------------------------------------------- fits and their evidence
@pytest.mark.parametrize(
    ("number", "inside", "predicted", "is_supported"),
    [
        (30, 46.0, 18.5, True),
        (30, 46.0, 18.3, False),  # left-out blocks show less than 0.4 of it
        (30, 44.0, 44.0, False),  # an RMS effect below 0.5 on 180 rows
        (54, 10.0, 10.0, True),
        (54, 8.0, 8.0, False),  # on 36 rows
        (None, 91.0, 91.0, True),
        (None, 89.0, 89.0, False),  # on all rows
        (None, -1.0, -1.0, False),
    ],
)
def test_a_cause_needs_an_effect_that_left_out_blocks_show(
    monkeypatch, number, inside, predicted, is_supported
):
    search, given = search_of(Changes("base", 2e-3)), []
    shape = Drift(0.0, 59.0) if number is None else Step(number)
    search.causes = [cause_of(search, "tool", Step(40), 1e-4), cause_of(search, "base", shape, 1e-3)]
    search._drop_others()
    search._advance(replace(search._fit(), step=np.zeros(len(search.x) + 12)))
    full = search._fit()

    def predicted_gain(*args):
        given.append(args)
        return inside, predicted

    monkeypatch.setattr(search_module, "_predicted_gain", predicted_gain)
    monkeypatch.setattr(search, "_log_evidence", lambda *args: 7.0)
    judged = search._judge(search.rows, full, 1)
    assert judged.log_evidence == (7.0 if is_supported else -np.inf)
    # 20 blocks, but 6 on the shorter side of a step.
    (((without, with_it), prior, begin, length),) = given
    assert (begin, length) == (0, pytest.approx({30: 3.0, 54: 1.0, None: 3.0}[number]))
    np.testing.assert_array_equal(prior, full.prior)
    # Both models explain the residuals of a robot without the cause, with the weights of the fit with it.
    root = (np.sqrt(full.weights)[:, None] / full.noise)[..., None]
    rows = search._linearized_without(1)
    other = search.causes[0].columns_of(rows, search.numbers, search.times)
    expected = np.concatenate([rows[..., search.layout.model], other, rows[..., -1:]], -1)
    np.testing.assert_allclose(without, root * expected)
    np.testing.assert_allclose(with_it[..., :-1], root * full.columns)
    own = full.columns[..., -6:] @ search.causes[1].values
    np.testing.assert_allclose(with_it[..., -1], root[..., 0] * (search.rows[..., -1] + own))


@pytest.mark.parametrize("shape", [Step(30), Drift(0.0, 59.0), FreeDrift(0.0, 59.0)])
def test_the_evidence_of_a_cause_has_the_costs_of_both_fits_in_the_noise_of_the_full_one(shape):
    """A sample costs at most the number of its rows and 16."""
    search = search_of(Changes())
    cause, other = cause_of(search, "base", shape), cause_of(search, "tool", Step(20))
    search.causes = [other, cause, other]
    full = search.solve(search.rows, search.causes)
    size = np.full((60, 6), np.sqrt(1 / 6))
    size[:2], size[2:4] = np.sqrt(23 / 6), np.sqrt(21 / 6)
    full = replace(full, residual=np.full((60, 6), 0.1), noise=np.full((60, 6), 2.0))
    without = replace(full, residual=size / 2, noise=np.full((60, 6), 4.0))
    # Samples show nothing of the cause: the covariance is that of its prior.
    own = slice(len(search.x) + 6, len(search.x) + 6 + len(cause.values))
    covariance = np.zeros((len(full.prior), len(full.prior)))
    covariance[own, own] = np.diag(cause.sizes**2)
    vars(full)["covariance"] = covariance
    costs = 2 * 22 + 2 * 21 + 56 * 1, 60 * 6 * 0.01
    n_places = {Step: 61, Drift: 8, FreeDrift: 1}[type(shape)]
    expected = 0.5 * (costs[0] - costs[1]) - np.log(n_places) - np.log(len(search.layout.blocks))
    assert search._log_evidence(cause, 1, full, without) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "begun", "shape"),
    [
        (Changes("base", 2e-3), Step(24), Step(30)),
        (Changes("base", 2e-3), FreeDrift(0.0, 59.0), Step(30)),
        (Changes("base", 2e-3), Step(30), Step(30)),
    ],
)
def test_a_fit_settles_where_no_step_and_no_drift_changes(changes, begun, shape):
    search = search_of(changes)
    search.causes = [cause_of(search, "base", begun)]
    fit = search._settle()
    assert [cause.shape for cause in search.causes] == [shape]
    # It is that of the last place.
    assert np.sqrt(np.mean((search.rows[..., -1] / fit.noise) ** 2)) == pytest.approx(1.0, abs=0.1)
    assert np.linalg.norm(search.causes[0].values[:3]) == pytest.approx(2e-3, rel=0.1)


def test_a_fit_that_does_not_settle_ends(monkeypatch):
    search, fits = search_of(Changes()), []
    first = search.first_fit
    monkeypatch.setattr(search, "_fit", lambda: first)
    monkeypatch.setattr(search, "_move_steps", lambda fit: True)
    monkeypatch.setattr(search, "iterate", lambda fit: [fits.append(fit), fit][1])
    search._settle()
    assert len(fits) == 1 + MAX_MOVES


@pytest.mark.parametrize(
    ("sizes", "count"), [([0.2, 0.06, 0.04, 0.2], 3), ([0.04, 0.2], 1), ([0.06] * 10, MAX_ITERATIONS)]
)
def test_a_fit_is_repeated_until_its_steps_are_negligible(monkeypatch, sizes, count):
    """A step is negligible if it changes the residuals by a twentieth of their noise."""
    search = search_of(Changes())
    unit = search.first_fit
    change = np.sqrt(np.mean((unit.columns[..., 0] / unit.noise) ** 2 * unit.weights[:, None]))
    steps = [np.zeros(len(unit.step)) for _ in sizes]
    for step, size in zip(steps, sizes, strict=True):
        step[0] = size / change
    fits, taken = [replace(unit, step=step) for step in steps], []
    monkeypatch.setattr(search, "_advance", taken.append)
    monkeypatch.setattr(search, "_fit", lambda: fits[len(taken)])
    assert search.iterate(fits[0]) is fits[count]
    assert taken == fits[:count]


# ----------------------------------------------------------------------------------- order of the search
def proposing(monkeypatch, search, causes, evidence):
    """Let a search propose causes, of which those with a value have an effect, and judge them by number."""
    fitted = []

    def ranked(fit):
        used = {id(cause.block) for cause in search.causes}
        used |= {id(block) for block, _ in search.rejected}
        return [cause for cause in causes if id(cause.block) not in used]

    def settle_with(found):
        fitted.append(causes.index(found))
        search.causes = [*search.causes, found]
        search.x, search.changes = search.x + 1.0, RobotChanges(zeros=((0, Step(3), np.zeros(1)),))
        return search.first_fit, evidence[causes.index(found)]

    for name, function in (
        ("_ranked_causes", ranked),
        ("_can_have_effect", lambda fit, found: found.values.any()),
        ("_settle_with", settle_with),
        ("_confirm", lambda: fitted.append("confirmed")),
        ("iterate", lambda fit: fit),
        ("_fit", lambda: search.first_fit),
    ):
        monkeypatch.setattr(search, name, function)
    return fitted


def joints_of(search, proposed, values=(1.0,) * 6):
    """Return steps of the joints with an evidence of the score test."""
    return [
        replace(cause_of(search, "joint", Step(30), value, index=i), log_evidence=evidence)
        for i, (evidence, value) in enumerate(zip(proposed, values, strict=False))
    ]


@pytest.mark.parametrize(
    ("proposed", "values", "evidence", "fitted", "kept"),
    [
        # Causes are kept from an evidence of 12, and the search ends with the third one in vain.
        ([20, 19, 18, 17, 16, 15], [1] * 6, [11.9, 12.0, 11.0, 30.0, -np.inf, 30.0], [0, 1, 2, 3, 4], [1, 3]),
        # A cause without an effect is not fitted, but tried in vain.
        ([20, 19, 18, 17, 16], [0, 1, 0, 0, 1], [30.0] * 5, [1], [1]),
        # Causes are proposed from an evidence of 2.
        ([2.1, 2.0, 1.9], [1, 1, 1], [30.0] * 3, [0, 1], [0, 1]),
        ([], [], [], [], []),
    ],
)
def test_causes_are_tried_in_the_order_of_their_evidence(
    monkeypatch, proposed, values, evidence, fitted, kept
):
    search = search_of(Changes())
    causes, x = joints_of(search, proposed, values), search.x
    found = proposing(monkeypatch, search, causes, evidence)
    search.run()
    assert found == [*fitted, "confirmed"]
    assert search.causes == [causes[i] for i in kept]
    # What was tried in vain leaves no traces.
    np.testing.assert_array_equal(search.x, x + len(kept))
    assert search.changes.is_empty == (not kept)
    in_vain = [i for i in range(len(causes)) if i not in kept and (i in fitted or not values[i])]
    assert search.rejected == {(causes[i].block, Step) for i in in_vain}


@pytest.mark.parametrize(
    ("evidence", "effect", "is_gross"),
    [(60.1, 3.1, True), (59.9, 3.1, False), (60.1, 2.9, False)],
)
def test_a_gross_cause_is_in_the_first_fit(monkeypatch, evidence, effect, is_gross):
    search, causes_of_fits = search_of(Changes()), []
    (gross,) = joints_of(search, [evidence])
    proposing(monkeypatch, search, [gross], [30.0])
    monkeypatch.setattr(search, "_effect", lambda fit, cause: effect)
    monkeypatch.setattr(search, "iterate", lambda fit: causes_of_fits.append(len(search.causes)))
    search.run()
    assert causes_of_fits == [is_gross]
    # It has been fitted from zero.
    assert search.causes[0].values == (0.0 if is_gross else 1.0)


@pytest.mark.parametrize(
    ("evidence", "shares", "outliers", "proposed", "limit", "count"),
    [
        # Nothing else is added to a cause with enough evidence, or without outliers.
        ([12.0], [0.3], [20], 20.0, 8, 1),
        ([11.0], [0.25], [20], 20.0, 8, 1),
        # The evidence is the smallest one of all that were added, the share of outliers the largest.
        ([11.9, 12.0], [0.26, 0.26], [20, 10], 20.0, 8, 2),
        ([5.0, 11.9, 7.0], [0.26, 0.3, 0.25], [20, 10, 5], 20.0, 8, 3),
        # Causes that explain no outliers end it.
        ([5.0, 6.0, 7.0], [0.3, 0.3, 0.3], [20, 20, 5], 20.0, 8, 2),
        ([5.0, 6.0, 7.0], [0.3, 0.3, 0.3], [20, 10, 5], 1.9, 8, 1),
        ([5.0, 6.0, 7.0], [0.3, 0.3, 0.3], [20, 10, 5], None, 8, 1),
        ([5.0, 6.0, 7.0], [0.3, 0.3, 0.3], [20, 10, 5], 20.0, 3, 2),
    ],
)
def test_causes_of_the_outliers_of_a_cause_are_fitted_with_it(
    monkeypatch, evidence, shares, outliers, proposed, limit, count
):
    search = search_of(Changes())
    first, found, *others = joints_of(search, [20.0] * 6)
    search.causes = [first]
    left = [replace(each, log_evidence=proposed) for each in others] if proposed is not None else []

    def settle():
        weights = np.where(np.arange(60) < outliers[len(search.causes) - 2], 0.4, 1.0)
        return replace(search.first_fit, weights=weights)

    def judge(rows, fit, i):
        assert i > 0
        return replace(
            search.causes[i], log_evidence=evidence[len(search.causes) - 2] + (i < len(search.causes) - 1)
        )

    monkeypatch.setattr(search_module, "MAX_CAUSES", limit)
    monkeypatch.setattr(search, "_settle", settle)
    monkeypatch.setattr(search, "_judge", judge)
    monkeypatch.setattr(
        search,
        "_outlier_share",
        lambda fit, c: shares[len(search.causes) - 2] - 0.1 * (c.block is not found.block),
    )
    monkeypatch.setattr(search, "best_cause", lambda fit: left.pop(0) if left else None)
    fit, smallest = search._settle_with(found)
    assert len(search.causes) == 1 + count
    assert smallest == evidence[count - 1]
    assert np.sum(fit.weights < OUTLIER_WEIGHT) == outliers[count - 1]


def test_causes_with_least_evidence_are_removed_until_all_are_confirmed(monkeypatch):
    """Then those that a function of the configuration imitates are removed, but no constant ones."""
    search = search_of(Changes())
    evidence = {0: 11.9, 1: 5.0, 2: 12.0, 3: 40.0, 4: 50.0}
    joints = [cause_of(search, "joint", Step(30), index=i) for i in range(4)]
    search.causes = [*joints, cause_of(search, "lag", Constant())]
    removed, asked = [], []

    def name(cause):
        return cause.block.index if cause.block.kind == "joint" else 4

    def judge(rows, full, i):
        return replace(search.causes[i], log_evidence=evidence[name(search.causes[i])])

    def follows(i):
        asked.append(name(search.causes[i]))
        return name(search.causes[i]) == 3

    def remove(i):
        removed.append(name(search.causes[i]))
        del search.causes[i]

    for each in (judge, remove):
        monkeypatch.setattr(search, f"_{each.__name__}", each)
    monkeypatch.setattr(search, "_follows_configuration", follows)
    search._confirm()
    assert removed == [1, 0, 3]
    assert asked == [2, 3, 2]
    assert [cause.log_evidence for cause in search.causes] == [12.0, 50.0]


def test_positions_of_a_wrong_scale_have_the_rows_of_a_right_one():
    """A scale of an axis is a constant cause of which only the residuals know."""
    simulation, factor = Simulation("ur10", 60, 3, errors=(0.0, 0.0)), 1e-3
    data = simulation.measure(Position)
    search = searched(simulation, (data,))
    along = data.values[:, 1] - data.values[:, 1].mean()
    scaled = data.replace(values=data.values + factor * np.outer(along, [0.0, 1.0, 0.0]))
    wrong = searched(simulation, (scaled,))
    difference = (wrong.rows - search.rows)[..., -1]
    scale = next(block for block in wrong.layout.blocks if (block.kind, block.of) == ("scale", "y"))
    wrong.causes = [Cause(scale, Constant(), np.array([factor]), np.zeros((1, 1)))]
    rows = wrong.linearize()
    assert np.abs(difference).max() > 0.9
    np.testing.assert_allclose(rows[..., -1], search.rows[..., -1], atol=5e-3 * np.abs(difference).max())
    np.testing.assert_array_equal(rows[..., :-1], wrong.rows[..., :-1])
    # A lag is in the joint positions instead.
    wrong.causes = [cause_of(wrong, "lag", Constant(), 0.1)]
    np.testing.assert_array_equal(wrong.linearize(), wrong.rows)


def test_few_rows_for_each_unknown_do_not_make_outliers():
    """The residuals of 60 rows with 36 unknowns are smaller than the noise."""
    simulation = Simulation("ur10", 10, 3)
    data = simulation.measure(Pose)
    fit = searched(simulation, (data,)).first_fit
    assert np.all(fit.weights == 1)
    assert fit.noise[0, 0] * data.sigma[0, 0] == pytest.approx(NOISE, rel=0.5)


@pytest.mark.parametrize(("n_cells", "first"), [(60, 60), (1, None)])
def test_a_search_can_begin_with_a_lag_from_a_sample_on(n_cells, first):
    """The joint values of the last 40 of 100 rows are 0.3 rows too early."""
    simulation = Simulation("ur10", 100, 3, is_path=True)
    before, after = (simulation.measure(Pose, Changes(lag=lag)).poses for lag in (0.0, 0.3))
    poses = np.concatenate([before[:60], after[60:]])
    search = searched(simulation, (Pose(simulation.q, poses),), n_cells=n_cells)
    search.move_lag()
    found = search.changes.lag_at(search.numbers, search.times)
    if first is None:  # no place is left for a step
        assert [cause.shape for cause in search.causes] == [Constant()]
    else:
        assert [cause.shape for cause in search.causes] == [Constant(), Step(first)]
        np.testing.assert_allclose(found, np.where(np.arange(100) < first, 0.0, 0.3), atol=0.02)
    assert search.log_noise(search.first_fit) == search.log_noise(search.solve(search.rows, search.causes))


def test_blocks_that_are_left_out_are_those_of_samples_with_a_time(monkeypatch):
    simulation, contacts, distances = touching()
    search, given = searched(simulation, (contacts.initialized(simulation.chain), distances)), []
    monkeypatch.setattr(search_module, "_predicted_gain", lambda *args: [given.append(args), (0.0, 0.0)][1])
    for shape in (Step(3 + 6), Step(3 + 15), Drift(3.0, 32.0)):
        search.causes = [cause_of(search, "base", shape)]
        search._judge(search.rows, search.solve(search.rows, search.causes), 0)
    assert [args[2] for args in given] == [3, 3, 3]
    assert [args[3] for args in given] == pytest.approx([1.0, 1.5, 1.5])


@pytest.mark.parametrize(("left", "follows"), [(89.0, True), (91.0, False)])
def test_a_true_change_keeps_its_evidence_beside_a_function_of_the_configuration(monkeypatch, left, follows):
    simulation = Simulation("ur10", 60, 3)
    is_high = (np.arange(60) >= 36) & (np.arange(60) < 54)
    simulation.q[:, 1] = np.where(is_high, 1.0, -1.0) + simulation.rng.uniform(-0.5, 0.5, 60)
    data = simulation.measure(Pose)
    poses = data.poses.copy()
    poses[is_high, 0, 3] += 2e-3
    search = searched(simulation, (Pose(data.q, poses),))
    search.causes = [cause_of(search, "base", Step(36))]
    search.iterate(search._fit())
    evidence = iter([100.0])
    monkeypatch.setattr(search_module, "_evidence_of", lambda block, causes: next(evidence, left))
    assert search._follows_configuration(0) == follows


# -------------------------------------------------------------------------------------------- two robots
@pytest.mark.parametrize(
    ("gains", "of_side", "first"),
    [
        ((0.60, 0.61), 0.31, 40),
        ((0.61, 0.60), 0.31, 20),
        ((0.59, 0.60), 0.31, 40),
        ((0.59, 0.59), 0.31, None),
        ((0.60, 0.61), 0.29, None),
    ],
)
def test_a_second_robot_needs_a_gain_on_all_samples_and_on_the_shorter_side(
    monkeypatch, gains, of_side, first
):
    """Each of its parameters costs half of the logarithm of the number of rows."""
    search = search_of(Changes())
    count, p = 360, len(search.layout.model)
    assert 0.59 < 0.5 * p * np.log(count) / count + 0.3 < 0.60
    search.causes = [cause_of(search, "base", Step(20)), cause_of(search, "tool", Step(40))]
    one, given = search.first_fit, []

    def second_robot(rows, others, block, number):
        given.append(([cause.shape for cause in others], number))
        two = replace(
            one, noise=one.noise * np.exp(-gains[number // 40]), step=np.append(1e3, np.arange(1.0, p + 1))
        )
        vars(two)["covariance"] = np.diag(np.append(9.0, np.full(p, 4.0)))
        return number, two

    monkeypatch.setattr(search, "solve", lambda rows, causes: one)
    monkeypatch.setattr(search, "_candidates", lambda fit: iter(()))
    monkeypatch.setattr(search, "_second_robot", second_robot)
    monkeypatch.setattr(search, "_gain_of_side", lambda *args: of_side)
    event = search.other_robot()
    assert given == [([Step(40)], 20), ([Step(20)], 40)]
    if first is None:
        assert event is None
        return
    assert event is not None
    assert (event.before.line, event.after.line) == (first, first + 1)
    # Base and tool, which come last, have no part in the most significant difference of the arm.
    errors = search.layout.problem.errors
    last = int(np.flatnonzero(errors.is_of_arm)[-1])
    assert (event.of, event.size, event.std) == (errors.parameters[last].name, last + 1, 2.0)


# ------------------------------------------------------------------------------------ beginning and end
@pytest.mark.parametrize(
    ("evidence", "n_low", "is_suspicious"),
    [(2.1, 0, True), (1.9, 0, False), (None, 0, False), (None, 6, False), (None, 7, True)],
)
def test_a_search_is_called_for_by_evidence_or_by_outliers(monkeypatch, evidence, n_low, is_suspicious):
    """Outliers are more than a tenth of 60 samples."""
    search = search_of(Changes())
    (found,) = joints_of(search, [evidence])
    fit = replace(search.first_fit, weights=np.where(np.arange(60) < n_low, 0.4, 1.0))
    monkeypatch.setattr(search_module._Search, "solve", lambda self, rows, causes: fit)
    best = found if evidence else None
    monkeypatch.setattr(search_module._Search, "best_cause", lambda self, fit: best)
    problem = search.layout.problem
    errors = select_parameters(problem.errors.chain, "minimal,base,tool")
    problem = make_problem(errors, problem.data, 1 / errors.priors, {})
    assert _is_suspicious(problem, search.x, search.timeline, True) == is_suspicious


def begun_with(noise, of_lag, search, x):
    """Return a stand-in for a search that begins with a noise, or with that of a lag."""
    state = SimpleNamespace(noise=noise, has_run=False, x=x, causes=[], first_fit="first")
    state.chain, state.changes, state.has_different_rows = search.chain, RobotChanges(), True
    state.paths = None if of_lag is None else search.paths
    state.log_noise = lambda fit: state.noise if fit == "first" else -9.0
    state.move_lag = lambda: vars(state).update(noise=of_lag)
    state.move_frames = lambda changes: vars(state).update(noise=state.noise - 1)
    state.run = lambda: vars(state).update(has_run=True)
    state.linearize = state.place_steps = state.other_robot = lambda: None
    state.solve = lambda rows, causes: "last"
    return state


@pytest.mark.parametrize(
    ("noises", "of_lag", "is_placed", "chosen"),
    [
        ((1.0, 1.1), 9.0, False, 0),  # the nominal robot
        ((1.1, 1.0), 9.0, False, 1),  # the solution
        ((1.1, 1.0, 1.9), 9.0, True, 2),  # base and tool of each part
        ((1.1, 1.0, 2.1), 9.0, True, 1),
        ((1.1, 1.0), 0.49, False, 2),  # a lag from some sample on
        ((1.1, 1.0), 0.51, False, 1),
        ((1.1, 1.0), None, False, 1),  # no paths
    ],
)
def test_a_search_begins_with_the_least_noise(monkeypatch, noises, of_lag, is_placed, chosen):
    search, begun, left = search_of(Changes(), is_ordered=True), [], [*noises, 1.0]
    problem = search.layout.problem

    def begin(problem, x, timeline, is_ordered, n_samples, n_cells):
        assert (n_samples, n_cells) == (4000, 400)
        begun.append(begun_with(left.pop(0), of_lag, search, x))
        return begun[-1]

    monkeypatch.setattr(search_module, "_is_suspicious", lambda *args: True)
    monkeypatch.setattr(search_module, "_Search", begin)
    monkeypatch.setattr(search_module, "starts_of_parts", lambda *args: (20,))
    placed = [(problem, RobotChanges())] if is_placed else []
    monkeypatch.setattr(
        search_module, "place_parts", lambda problem, timeline, starts: placed.pop() if placed else None
    )
    x = np.ones(len(problem.weights))
    session = find_session(problem, x, (), is_ordered=True)
    assert [each.has_run for each in begun] == [i == chosen for i in range(len(begun))]
    assert len(begun) == len(noises) + (of_lag is not None)
    assert [each.x.any() for each in begun] == [i == 1 for i in range(len(begun))]
    assert (session.causes, session.events, session.scales) == ((), (), ())


@pytest.mark.parametrize(("factor", "is_free"), [(0.96, False), (1.04, True)])
def test_each_coefficient_of_a_free_drift_costs_the_logarithm_of_the_number_of_rows(factor, is_free):
    """The residuals are its last function, of which other drifts leave the most part."""
    search = search_of(Changes())
    base = cause_of(search, "base", FreeDrift(0.0, 59.0))
    given = base.columns_of(search.rows, search.numbers, search.times).reshape(360, 48)[:, 42]
    model = search.rows[..., search.layout.model].reshape(360, -1)
    costs = []
    for ratio in FINE_CONSTANTS:
        other = replace(base, shape=Drift(0.0, 59.0, 59 * ratio), values=np.zeros(6))
        columns = other.columns_of(search.rows, search.numbers, search.times).reshape(360, 6)
        a = np.hstack([model, columns])
        costs.append(np.sum((given - a @ np.linalg.lstsq(a, given)[0]) ** 2))
    # 42 coefficients more; a linear drift has a bonus of twice the gain of a curvature.
    needed = 42 * np.log(360) + np.array([6.0, *np.zeros(len(costs) - 1)])
    size = np.max(needed / costs)
    search.rows[..., -1] = (np.sqrt(factor * size) * given).reshape(60, 6)
    search.causes, search.rejected = [base], {(base.block, Step)}
    fit = replace(search.first_fit, weights=np.ones(60), noise=np.ones((60, 6)))
    assert search._change_drifts(fit) != is_free
    assert isinstance(search.causes[0].shape, FreeDrift) == is_free


@pytest.mark.parametrize(("taken", "is_near"), [(31, True), (20, False)])
def test_a_part_has_no_two_steps_near_each_other(taken, is_near):
    """The base moves at sample 30."""
    search = search_of(Changes("base", 2e-3))
    search.causes = [cause_of(search, "base", Step(taken))]
    found = [cause.shape for cause in search._candidates(search.first_fit) if cause.block.kind == "base"]
    (number,) = (shape.number for shape in found if isinstance(shape, Step))
    assert abs(number - taken) >= 3
    assert (number == 30) != is_near


@pytest.mark.parametrize("direction", [1, -1])
def test_a_joint_that_moves_one_way_does_not_tell_its_position_from_the_time(direction):
    simulation = Simulation("ur10", 60, 3)
    simulation.q[:, 1] = direction * np.linspace(-1.0, 1.0, 60)
    search = searched(simulation, (simulation.measure(Pose, Changes("base", 2e-3)),))
    search.causes = [cause_of(search, "base", Step(30))]
    search.iterate(search._fit())
    assert not search._follows_configuration(0)


def robot_of(search):
    """Return the parameters of the geometry as a block of a second robot."""
    sizes = np.array([p.prior for p in search.layout.problem.errors.parameters])
    return Block("robot", "", search.layout.model[: len(sizes)], sizes)


def test_the_place_of_a_second_robot_is_found_from_another_one():
    search = search_of(Changes(has_second_robot=True, at=0.4))
    number, fit = search._second_robot(search.rows, [], robot_of(search), 19)
    assert number == 24
    expected = search.solve(search.rows, [Cause(robot_of(search), Step(24), np.zeros(36), np.empty((0, 0)))])
    np.testing.assert_array_equal(fit.step, expected.step)


def test_the_place_of_a_second_robot_is_moved_a_few_times(monkeypatch):
    search, places = search_of(Changes()), []
    monkeypatch.setattr(
        search, "_best_place", lambda fit, change, number: [places.append(number), number + 1][1]
    )
    number, _ = search._second_robot(search.rows, [], robot_of(search), 20)
    assert places == [20, 21, 22, 23]
    assert number == 24


def test_scales_of_up_to_a_half_are_stated(monkeypatch):
    search = search_of(Changes())
    state = begun_with(0.0, None, search, search.x)
    state.causes = [
        replace(cause_of(search, "scale", Constant(), value, index=i), covariance=np.array([[1e-6]]))
        for i, value in enumerate((0.49, 0.51, -0.49))
    ]
    state.stated = lambda cause: cause
    state.with_lag_alone = lambda: None
    monkeypatch.setattr(search_module, "_is_suspicious", lambda *args: True)
    monkeypatch.setattr(search_module, "_Search", lambda *args: state)
    session = find_session(search.layout.problem, search.x, (), is_ordered=False)
    assert [(scale.axis, scale.factor, scale.std) for scale in session.scales] == [
        ("x", 1.49, pytest.approx(1e-3)),
        ("z", 0.51, pytest.approx(1e-3)),
    ]
    assert session.causes == tuple(state.causes)


@pytest.mark.parametrize(
    ("n_causes", "has_lag", "is_suspicious", "is_alone"),
    [(2, True, False, True), (2, True, True, False), (2, False, False, False), (1, True, False, False)],
)
def test_a_lag_alone_is_the_cause_if_nothing_else_remains(
    monkeypatch, n_causes, has_lag, is_suspicious, is_alone
):
    search = search_of(Changes())
    state, alone = (begun_with(0.0, None, search, search.x) for _ in range(2))
    state.causes = [
        replace(cause_of(search, "scale", Constant(), 0.1, index=i), covariance=np.array([[1e-6]]))
        for i in range(n_causes)
    ]
    state.stated = lambda cause: cause
    state.with_lag_alone = lambda: alone if has_lag else None
    alone.corrected_timeline = lambda: "corrected"
    monkeypatch.setattr(
        search_module,
        "_is_suspicious",
        lambda problem, x, timeline, *args: timeline != "corrected" or is_suspicious,
    )
    monkeypatch.setattr(search_module, "_Search", lambda *args: state)
    session = find_session(search.layout.problem, search.x, (), is_ordered=False)
    assert len(session.causes) == (0 if is_alone else n_causes)


@pytest.mark.parametrize(("rise", "is_found"), [(0.09, True), (0.11, False)])
def test_a_search_that_ends_with_more_noise_than_it_began_with_finds_nothing(monkeypatch, rise, is_found):
    def log_noise(self, fit):
        return 0.0 if fit is self.first_fit else rise

    monkeypatch.setattr(search_module._Search, "log_noise", log_noise)
    problem = search_of(Changes("base", 2e-3)).layout.problem
    errors = select_parameters(problem.errors.chain, "minimal,base,tool")
    problem = make_problem(errors, problem.data, 1 / errors.priors, {})
    session = find_session(problem, np.zeros(len(problem.weights)), (), is_ordered=True)
    assert session.changes.is_empty != is_found


def test_steps_are_placed_among_held_out_samples():
    """The change is at sample 30 of 60, and every third sample from 28 on was held out."""
    simulation = Simulation("ur10", 60, 3)
    whole = simulation.measure(Pose, Changes("base", 2e-3)).replace(source="a.csv")
    is_out = np.isin(np.arange(60), [28, 29, 30, 31, 40])
    search = searched(simulation, (whole.take(~is_out),), holdout=(whole.take(is_out),))
    search.run()
    assert [cause.shape for cause in search.causes] == [Step(32)]
    search.place_steps()
    assert [cause.shape for cause in search.causes] == [Step(30)]
    assert search.changes.base.steps == (30,)
    corrected = search.corrected_timeline()
    assert corrected.n_fitted == 1
    motions = [vars(item.conditions())["base_motion"][:, :3, 3] for item in corrected.data]
    found = [np.linalg.norm(each, axis=1) > 1e-9 for each in motions]
    np.testing.assert_array_equal(found[0], np.flatnonzero(~is_out) < 30)
    np.testing.assert_array_equal(found[1], np.flatnonzero(is_out) < 30)


def test_a_search_begins_with_known_motions_of_frames():
    search = search_of(Changes("base", 5e-3))
    rng = np.random.default_rng(0)
    poses = [np.array([*se3.exp6(0.1 * rng.normal(size=(2, 6))), np.eye(4)]) for _ in range(2)]
    changes = RobotChanges(Motion((20, 40), poses[0]), Motion((20, 40), poses[1]))
    search.move_frames(changes)
    assert [(c.block.kind, c.shape) for c in search.causes] == [
        (kind, Step(number)) for kind in ("base", "tool") for number in (20, 40)
    ]
    assert search.changes is changes
    # The values are those of the motions to the next part, in their own frames.
    own = search._base()
    for (before, after), cause in zip(pairwise(poses[1]), search.causes[2:], strict=True):
        np.testing.assert_allclose(cause.values, se3.log6(after) - se3.log6(before), atol=1e-12)
    before, after = (se3.log6(se3.inverse(own) @ pose @ own) for pose in poses[0][:2])
    np.testing.assert_allclose(search.causes[0].values, after - before, atol=1e-12)


def test_a_touched_base_is_stated_by_its_points():
    simulation, contacts, distances = touching()
    search = searched(simulation, (contacts.initialized(simulation.chain), distances))
    found = search.stated(cause_of(search, "base", Step(20))).block.touched
    assert found is not None
    values = search.layout.problem.instruments(search.layout.errors_at(search.x))
    points = np.array([[values[f"point_{name}.{axis}"] for axis in "xyz"] for name in ("p1", "p2", "p3")])
    np.testing.assert_allclose(se3.transform_points(search._base(), found), points, atol=1e-12)
    assert search.stated(cause_of(search, "tool", Step(20))).block.touched is None
    drifting = search.stated(cause_of(search, "base", Drift(3.0, 32.0))).block.touched
    np.testing.assert_array_equal(drifting, found)


def test_two_robots_are_told_from_one():
    search = search_of(Changes(has_second_robot=True, at=0.4))
    event = search.other_robot()
    assert event is not None
    assert (event.kind, event.before.line, event.after.line) == ("robot", 24, 25)
    assert event.size > 3 * event.std > 0
    # The name is that of a parameter of the arm.
    errors = search.layout.problem.errors
    parameter = {p.name: is_arm for p, is_arm in zip(errors.parameters, errors.is_of_arm, strict=True)}
    assert parameter[event.of]
    assert search_of(Changes("base", 2e-3)).other_robot() is None


def test_the_second_robot_is_judged_by_the_shorter_side():
    search = search_of(Changes())
    fit = search.first_fit
    is_after = (search.numbers >= 40)[:, None]
    better = replace(fit, residual=fit.residual * np.where(is_after, 0.5, 3.0))
    found = search._gain_of_side(fit, better, 40, 30)
    assert found == pytest.approx(np.log(2) + 0.5 * np.log(1 - 30 / 120))
    before = replace(fit, residual=fit.residual * np.where(search.numbers < 20, 0.5, 3.0)[:, None])
    assert search._gain_of_side(fit, before, 20, 30) == pytest.approx(found)
    # Few rows for each unknown fit any robot.
    assert search._gain_of_side(fit, better, 40, 48) > -np.inf
    assert search._gain_of_side(fit, better, 40, 49) == -np.inf


def test_costs_are_those_of_least_squares():
    rng = np.random.default_rng(0)
    rows, prior = rng.normal(size=(30, 5)), np.array([0.5, 1.0, 2.0, 0.1])
    for used in (np.arange(4), np.array([0, 2])):
        a, b = np.vstack([rows[:, used], np.diag(prior[used])]), np.append(rows[:, -1], np.zeros(len(used)))
        x = -np.linalg.lstsq(a, b)[0]
        other = rng.normal(size=(7, 5))
        for out in (rows, other):
            left = out[:, -1] + out[:, used] @ x
            assert _cost(rows.T @ rows, out.T @ out, prior, used) == pytest.approx(left @ left)


@pytest.mark.parametrize(
    ("begin", "length", "count"), [(0, 5.0, 8), (4, 12.0, 3), (0, 100.0, 2), (0, 0.1, 40)]
)
def test_gains_are_predicted_for_blocks_that_are_left_out(begin, length, count):
    """Every block is predicted by a fit of the others; samples without a time belong to all fits."""
    rng = np.random.default_rng(0)
    n = 40 + begin
    stacks = rng.normal(size=(n, 2, 4)), rng.normal(size=(n, 2, 6))
    prior = rng.uniform(0.5, 1.0, 5)
    inside, predicted = _predicted_gain(stacks, prior, begin, length)
    expected = np.zeros((2, 2))
    for i, stack in enumerate(stacks):
        p = stack.shape[2] - 1

        def left(kept, out, p=p):
            a = np.vstack([kept.reshape(-1, p + 1)[:, :p], np.diag(prior[:p])])
            b = np.append(kept.reshape(-1, p + 1)[:, p], np.zeros(p))
            flat = out.reshape(-1, p + 1)
            return np.sum((flat[:, p] - flat[:, :p] @ np.linalg.lstsq(a, b)[0]) ** 2)

        expected[i, 0] = left(stack, stack)
        edges = np.unique(np.linspace(0, 40, count + 1).astype(int)) + begin
        expected[i, 1] = sum(left(np.delete(stack, np.s_[a:b], 0), stack[a:b]) for a, b in pairwise(edges))
    assert (inside, predicted) == pytest.approx(tuple(expected[0] - expected[1]))


@pytest.mark.parametrize("edges", [[0, 4, 8, 12], [2, 5, 12], [0, 12]])
def test_products_of_cells(edges):
    rows = np.random.default_rng(0).normal(size=(12, 2, 5))
    for some in (np.s_[:], np.s_[1:4]):
        found = _cell_products(rows, np.array(edges), some)
        expected = [np.einsum("nki,nkj->ij", rows[a:b][..., some], rows[a:b]) for a, b in pairwise(edges)]
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_one_robot_can_change_in_base_tool_payload_and_zeros_at_a_sample():
    steps = search_of(Changes())._steps_of_all(30)
    assert [step.block.kind for step in steps] == ["base", "tool", *["joint"] * 6, "payload"]
    assert {step.shape for step in steps} == {Step(30)}


def test_costs_of_samples_grow_linearly_beyond_the_limit():
    residual = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [10.0, -10.0]])
    np.testing.assert_allclose(_bounded_cost(residual), 2 * np.array([1.0, 4.0, 8.0, 36.0]))


def test_products_of_weighted_columns():
    columns, root = (
        np.random.default_rng(0).normal(size=(6, 2, 3)),
        np.random.default_rng(1).uniform(size=(6, 2)),
    )
    expected = np.einsum("nki,nk,nkj->ij", columns, root**2, columns)
    np.testing.assert_allclose(_information(columns, root), expected)


def test_evidence_of_a_block_is_the_greatest_one():
    search = search_of(Changes())
    base, tool = (cause_of(search, kind, Step(20)) for kind in ("base", "tool"))
    causes = [
        replace(base, log_evidence=3.0),
        replace(base, log_evidence=5.0),
        replace(tool, log_evidence=9.0),
    ]
    assert _evidence_of(base.block, causes) == 5.0
    assert _evidence_of(base.block, [tool]) == -np.inf


def test_sessions_need_samples_of_the_robot():
    q = np.zeros((4, 6))
    contacts, distances = PointContact(q, ["a", "b"] * 2), PointDistance(6, [("a", "b")], [1.0])
    positions = Position(q, np.zeros((4, 3)))
    assert can_have_session([positions])
    assert can_have_session([positions, distances])
    assert can_have_session([contacts])
    assert not can_have_session([distances])
    assert not can_have_session([])
    assert measures_positions([positions])
    assert not measures_positions([positions, contacts])


def test_a_search_needs_more_rows_than_unknowns():
    simulation = Simulation("ur10", 40, 3)
    data = simulation.measure(Pose)
    problem = searched(simulation, (data,)).layout.problem
    count = len(problem.weights)
    for n in (3, 6, 7, 8, 9, 12):
        timeline = order_samples((data.take(np.s_[:n]),), ())
        assert has_enough_rows(problem, timeline) == (6 * n >= 1.5 * count)


# -------------------------------------------------------------------------------------- linear algebra
def test_information_without_a_direction_has_inverses_of_the_others():
    rows = np.random.default_rng(0).normal(size=(20, 4)) * [1.0, 1e3, 1e-3, 0.0]
    information = rows.T @ rows
    right = np.array([1.0, 2.0, 3.0, 0.0])
    expected = np.linalg.inv(information[:3, :3])
    np.testing.assert_allclose(inverse(information)[:3, :3], expected, rtol=1e-6)
    np.testing.assert_allclose(solve_information(information, right)[:3], expected @ right[:3], rtol=1e-6)
    assert solve_information(information, right)[3] == 0


def test_roots_of_covariances_keep_priors():
    rows, prior = np.random.default_rng(0).normal(size=(20, 4)), np.array([0.0, 1.0, 3.0, 10.0])
    root = covariance_root(rows, prior)
    np.testing.assert_allclose(root @ root.T, np.linalg.inv(rows.T @ rows + np.diag(prior**2)), atol=1e-12)
    # Only a prior determines the last one.
    rows[:, 3] = 0
    root = covariance_root(rows, prior)
    assert (root @ root.T)[3, 3] == pytest.approx(0.01)


@pytest.mark.parametrize("kind", [Pose, Position])
def test_causes_have_the_sizes_that_move_the_tool_by_a_metre(kind):
    """The arm has a length, about which turns move the tool."""
    simulation = Simulation("ur10", 30, 3)
    layout = searched(simulation, (simulation.measure(kind),)).layout
    chain = layout.problem.errors.chain
    length = np.linalg.norm(chain.link_vectors, axis=1).sum()
    sizes = {(b.kind, b.of, len(b.columns)): b for b in layout.blocks}
    base, tool = sizes["base", "", 6], sizes["tool", "", 6]
    np.testing.assert_allclose(base.sizes, [1, 1, 1, *[1 / length] * 3])
    turns = [1 / length] * 3 if kind is Pose else [1e-12] * 3
    np.testing.assert_allclose(tool.sizes, [1, 1, 1, *turns])
    for j, name in enumerate(chain.joint_names):
        block = sizes["joint", name, 1]
        assert (block.index, block.sizes[0]) == (j, pytest.approx(1 / length))
        assert block.columns[0] == layout.joints[j]
    for i, axis in enumerate("xyz"):
        block = sizes["scale", axis, 1]
        assert (block.columns[0], block.index, block.is_of_recording) == (layout.scale + 1 + i, i + 1, True)
    assert sizes["lag", "", 1].columns[0] == layout.lag == layout.n_columns - 2
    # A payload bends the joint with the largest torque as if the tool moved by a metre.
    torques = np.abs(chain.loads.torques_per_kilogram(layout.problem.data[0].q.T)).max(1)
    payload = sizes["payload", "", 6].sizes
    np.testing.assert_allclose(
        payload, np.where(torques > MIN_TORQUE, 1 / (length * torques.max()), HELD_SIZE)
    )
    grows = [block for (kind, *_), block in sizes.items() if kind == "links"]
    assert len(grows) == 2
    assert all(block.sizes == pytest.approx(1 / length) for block in grows)
    used = np.concatenate([layout.model, layout.joints, layout.links, layout.payload])
    assert len(set(used.tolist())) == len(used)
    # Turns of a tool that only priors determine are held, beside all others.
    held = layout.weights > 1e11
    assert held.sum() == (0 if kind is Pose else 3)
