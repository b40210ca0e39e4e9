"""Parts of the check of a calibrated robot: its model against the robot, and its answers to findings."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from robots import nominal_arm
from scipy.stats import chi2, multivariate_normal

from dhcal_pin import calibrate, se3
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.estimation.uncertainty import Uncertainty
from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.measurements import Inclination, Noise, Pose, Position
from dhcal_pin.robot.transmission import Payload
from dhcal_pin.session import check, find_excess_error, recheck
from dhcal_pin.session.causes import Block
from dhcal_pin.session.check import Explained, Hypothesis, Recheck, _CheckModel

NOISE, ANGLE_NOISE = 5e-5, 1e-4
RNG = np.random.default_rng(4)
ARM = nominal_arm("ur10").with_base_and_tool(*se3.exp6(0.3 * RNG.normal(size=(2, 6))))
Q = RNG.uniform(-2, 2, (7, 6))
POSES = ARM.poses(Q)
BASE_TURN, TOOL_TURN = (0.02 * RNG.normal(size=6) for _ in range(2))
ZEROS = 0.01 * RNG.normal(size=6)


def positions(q=Q, sigma: Any = NOISE, arm=ARM, **conditions):
    """Return exact positions of an arm."""
    item = Position(q, np.zeros((len(q), 3)), sigma).with_conditions(**conditions)
    return item.replace(values=arm.poses(item.conditions())[:, :3, 3])


def both(sigma: Any = NOISE, angle: Any = ANGLE_NOISE):
    """Return exact positions and poses of an arm."""
    return positions(Q[:3], sigma), Pose(Q[3:], POSES[3:], sigma, angle)


def model_of(*data, uncertainty: Any = None, arm=ARM, payloads=None):
    """Return the model of a check."""
    return _CheckModel(arm, data, uncertainty, {}, payloads)


def covariance_of(model):
    """Return the covariance of the whitened rows."""
    return (model.axes * model.variances[0]) @ model.axes.T


def changes_of(model, base: Any = 0.0, tool: Any = 0.0, zeros: Any = 0.0):
    """Return the changes (p,) of the columns of base, tool and zeros."""
    out = np.zeros(model.layout.n_columns)
    out[model._block("base").columns], out[model._block("tool").columns] = base, tool
    out[model.layout.joints] = zeros
    return out


def test_a_check_needs_a_calibration_that_determines_base_and_tool():
    """The advice is followed."""
    rng, noise = np.random.default_rng(0), Noise(2e-3, 3e-3)
    checked = Pose.simulate(ARM, rng.uniform(-2, 2, (8, 6)), noise, rng)
    found = []
    for count in (1, 200):
        data = Pose.simulate(ARM, rng.uniform(-2, 2, (count, 6)), noise, rng)
        fit = calibrate(nominal_arm("ur10"), data, extend="none", session="off")
        found.append(recheck(fit.chain, [checked], fit.uncertainty, size=0.05))
    few, many = found
    assert (few.verdict, few.hypotheses, few.changes, few.samples) == ("cannot say", (), (), 8)
    assert "calibrate with more poses" in few.reasons[0]
    assert few.expected_rms > 10 * many.expected_rms
    assert many.verdict == "ok"


@pytest.mark.parametrize("kind", [Pose, Position])
def test_a_calibration_without_known_noise_answers_no_check(kind):
    rng = np.random.default_rng(0)
    data, checked = (
        kind.simulate(ARM, rng.uniform(-2, 2, (count, 6)), Noise(1e-4, 1e-4), rng) for count in (1, 8)
    )
    fit = calibrate(nominal_arm("ur10"), data.replace(has_stated_sigma=False), extend="none", session="off")
    assert np.isnan(fit.uncertainty.sqrt_covariance).any()
    assert recheck(fit.chain, [checked], fit.uncertainty).verdict == "cannot say"


def test_noise_that_hides_all_changes_answers_no_check():
    found = recheck(ARM, [positions(Q[:4], 0.05)])
    assert (found.verdict, found.hypotheses) == ("cannot say", ())


def test_rows_after_changes_are_the_residuals_of_the_changed_robot():
    model = model_of(*both())
    other = ARM.with_base_and_tool(ARM.base @ se3.exp6(BASE_TURN), ARM.tool @ se3.exp6(TOOL_TURN))
    found = model._linearize(changes_of(model, BASE_TURN, TOOL_TURN, ZEROS))[:, -1]
    moved = other.poses(Q + ZEROS)
    expected = (POSES - moved)[:, :3, 3] / NOISE
    sizes = np.concatenate([np.arange(9), 9 + (np.arange(12) + 3 * (np.arange(12) // 3))])
    np.testing.assert_allclose(found[sizes], expected.ravel(), rtol=1e-9, atol=1e-9)
    assert len(found) == 9 + 24
    np.testing.assert_array_equal(model.numbers, [*np.repeat(range(3), 3), *np.repeat(range(3, 7), 6)])
    # A further step of base and tool is one in their moved frames.
    robot = model.blocks[-1]
    before = changes_of(model, BASE_TURN, TOOL_TURN, ZEROS)
    step = np.zeros(len(before))
    step[robot.columns] = 0.01 * np.random.default_rng(0).normal(size=len(robot.columns))
    after = model._advanced(before, robot, step[robot.columns])
    for kind in ("base", "tool"):
        own = model._block(kind).columns
        expected = se3.exp6(before[own]) @ se3.exp6(step[own])
        np.testing.assert_allclose(se3.exp6(after[own]), expected, atol=1e-12)
    joints = model.layout.joints
    np.testing.assert_allclose(after[joints], before[joints] + step[joints])


@pytest.mark.parametrize("kind", [Position, Pose])
def test_changes_are_estimated_exactly_without_noise(kind):
    """Those of the base, of the tool, of a joint and of the robot, each for a robot that changed so."""
    true = changes_of(model_of(positions()), BASE_TURN)
    data = positions() if kind is Position else Pose(Q, POSES, NOISE, ANGLE_NOISE)
    model = model_of(data)
    for block in model.blocks[:-1]:
        size = 0.01 * np.random.default_rng(1).normal(size=len(block.columns)) * (block.sizes > 0)
        changes = np.zeros(len(true))
        changes[block.columns] = size
        moved = ARM.poses(model._changed(data, changes).conditions())
        noises = (NOISE, ANGLE_NOISE) if kind is Pose else (NOISE,)
        changed = model_of(kind(Q, moved if kind is Pose else moved[:, :3, 3], *noises))
        values, columns, undone = changed.estimate(block)
        np.testing.assert_allclose(values, size, atol=2e-5)
        assert changed._cost(block, (values, columns, undone)) < 1
        # The residual is as if the change were undone.
        scaled = np.divide(values, block.sizes, out=np.zeros_like(values), where=block.sizes > 0)
        assert np.linalg.norm(undone - columns @ scaled) < 1e-3 * np.linalg.norm(undone)
        fit = changed.explained([block], changes)
        assert fit.chi_square < 0.1
        assert fit.p_value == pytest.approx(1)
        assert fit.rms < 1e-6
        np.testing.assert_allclose(fit.values, size, atol=2e-5)
        assert changed.is_changed(block)


def test_what_two_samples_do_not_determine_is_pulled_to_no_change():
    """An estimate from another start ends at the same change, which only its prior determines in part."""
    model = model_of(positions(Q[:2]))
    block = model._block("base")
    start = changes_of(model, 0.3 * np.arange(1, 7) * block.sizes)
    values, *_ = model.estimate(block, start)
    np.testing.assert_allclose(values / block.sizes, 0, atol=1e-3)


def test_the_covariance_of_a_fit_of_two_changes_is_that_of_normal_equations():
    model = model_of(positions(), uncertainty=uncertainty_of(1e-3))
    joints = [block for block in model.blocks if block.kind == "joint"][1:3]
    fit = model.explained(joints, np.zeros(model.layout.n_columns))
    a = model.rows[:, [block.columns[0] for block in joints]]
    inverse = np.linalg.inv(a.T @ np.linalg.solve(covariance_of(model), a))
    np.testing.assert_allclose(fit.covariance, inverse, rtol=1e-3)


def uncertainty_of(length, model_std=(0.0, 0.0), unbounded=False, residual_std: Any = (1e-4, 2e-4)):
    """Return the uncertainty of one correction of the UR10, or a direction that nothing determines."""
    errors = select_parameters(ARM, "placement")
    root = np.zeros((len(errors.parameters), 1))
    root[7] = length
    none = np.zeros((len(root), 0))
    out = Uncertainty.from_errors(
        errors, np.zeros(len(root)), ARM, *((none, root) if unbounded else (root, none)), 1.0, model_std
    )
    return replace(out, fit=SimpleNamespace(residual_std=residual_std))


@pytest.mark.parametrize("unbounded", [False, True])
def test_what_the_calibration_leaves_open_is_that_of_its_corrections_and_of_its_model(unbounded):
    length, lacking, errors = 1e-4, (3e-5, 2e-4), select_parameters(ARM, "placement")
    model = model_of(*both(), uncertainty=uncertainty_of(length, lacking, unbounded))
    step = 1e-6 * np.eye(len(errors.parameters))[7]
    moved = (errors.at(step).poses(Q) - errors.at(-step).poses(Q))[:, :3, 3] / 2e-6
    factor = 10.0 if unbounded else 1.0
    effects = factor * length * moved.ravel() / NOISE
    own = np.diag(np.full(len(effects), 1 + (lacking[0] / NOISE) ** 2))
    rows, sigma = model._positions
    np.testing.assert_array_equal(sigma, np.full(21, NOISE))
    found = covariance_of(model)[np.ix_(rows, rows)]
    np.testing.assert_allclose(found, np.outer(effects, effects) + own, rtol=1e-4, atol=1e-3)
    turns = np.setdiff1d(np.arange(9, 33), rows)
    assert len(turns) == 12
    assert (covariance_of(model)[turns, turns] > 0.99 * (1 + (2e-4 / ANGLE_NOISE) ** 2)).all()
    # The residual and the expected distance, of positions and poses alike.
    shifted = positions().replace(values=positions().values + 1e-3)
    rms, expected = model_of(shifted, uncertainty=uncertainty_of(length, lacking, unbounded)).position_rms()
    assert rms == pytest.approx(np.sqrt(3) * 1e-3)
    assert expected == pytest.approx(
        NOISE * np.sqrt(np.trace(np.outer(effects, effects) + own) / 7), rel=1e-4
    )


def test_noise_of_unknown_size_has_no_expected_distance():
    model = model_of(positions(sigma=None))
    rms, expected = model.position_rms()
    assert np.isnan(expected)
    assert model.hidden_motion() == rms
    assert len(model.noise_factors) == 2 * model.usual_noise + 1
    stated = model_of(positions())
    assert (len(stated.noise_factors), stated.usual_noise) == (1, 0)
    variances = np.geomspace(1e-6, 100, 17)[:, None]
    np.testing.assert_allclose(model.variances, np.tile(variances, 21))
    np.testing.assert_array_equal(stated.variances, np.ones((1, 21)))
    # One of two measurements without a noise is enough.
    assert len(model_of(positions(Q[:3]), positions(Q[3:], None)).noise_factors) > 1


def test_a_motion_hides_in_the_scatter_of_the_mean_square_of_noise():
    """Of n samples with independent coordinates of one noise, it has the variance 6·σ⁴/n."""
    std = np.sqrt(6 * NOISE**4 / 7)
    for shift in (1e-5, 1e-4, 1e-3):
        values = positions().values + shift * np.array([1.0, 0.0, 0.0])
        found = model_of(positions().replace(values=values)).hidden_motion()
        square = max(shift**2 - 3 * NOISE**2, 0.0) + 3 * std
        assert found == pytest.approx(min(shift, np.sqrt(square)))


def test_a_check_reveals_five_standard_deviations_in_the_worst_direction():
    """A motion of the base along its x axis moves all points by its size."""
    model = model_of(positions())
    block = model._block("base")
    covariance = np.diag([4e-10, 1e-10, 1e-10, 0.0, 0.0, 0.0])
    assert model._revealed(block, covariance) == pytest.approx(5 * 2e-5)
    joint = next(each for each in model.blocks if each.of == "elbow_joint")
    moved = (ARM.poses(Q + 1e-6 * np.eye(6)[2]) - POSES)[:, :3, 3] / 1e-6
    rms = np.sqrt(np.mean(np.sum(moved**2, 1)))
    assert model._revealed(joint, np.array([[9e-8]])) == pytest.approx(5 * 3e-4 * rms, rel=1e-3)


def elastic(*families, mass: float | None = 5.0):
    """Return an arm with errors of families."""
    arm = ARM.with_payload(Payload(mass, (0.0, 0.0, 0.1)) if mass is not None else None)
    errors = select_parameters(arm, ",".join(families))
    sizes = {"compliance": 3e-5, "thermal": 2e-5, "backlash": 1e-3}
    values = [sizes[next(name for name in families if name in p.name)] for p in errors.parameters]
    return errors.at(np.array(values))


@pytest.mark.parametrize(
    ("payloads", "mass", "expected"),
    [
        (None, 5.0, 0.0),
        ((0.0, 12.0), 6.0, 12 / np.sqrt(12)),
        ((4.5, 5.5), 5.0, 1 / np.sqrt(12)),
        ((2.0, 4.0), 5.0, np.hypot(2 / np.sqrt(12), 2)),
    ],
)
def test_an_unknown_payload_spreads_as_those_of_the_calibration(payloads, mass, expected):
    arm = elastic("compliance", "thermal", mass=mass)
    model = model_of(positions(arm=arm), arm=arm, payloads=payloads)
    spreads = model._condition_spreads
    assert spreads["payload"] == (mass, pytest.approx(expected))
    assert spreads["temperature"] == (arm.reference_temperature, check.TEMPERATURE_STD)
    unknown = ["temperature[degC]"] + ["payload[kg]"] * bool(expected)
    assert model.unknown_columns == unknown
    known = positions(arm=arm, temperature=np.full(7, 30.0))
    assert model_of(known, arm=arm, payloads=payloads).unknown_columns == unknown[1:]
    # Conditions that are known are kept beside those that are not.
    for mass in (0.0, 9.0):
        other = positions(arm=arm, temperature=np.full(7, 30.0), payload=np.full(7, mass))
        found = model._residual(known, payload=np.full(7, mass))
        np.testing.assert_allclose(found.T * NOISE, known.values - other.values, atol=1e-12)
    # The effects are those of one standard deviation of each.
    effects = model._unknown_conditions(model.data[0])
    kg, degrees = (np.full(7, spreads[name][0] + spreads[name][1]) for name in ("payload", "temperature"))
    own = model.data[0].positions()
    for i, conditions in enumerate(({"temperature": degrees}, {"payload": kg})):
        moved = positions(arm=arm, **conditions).positions() - own
        np.testing.assert_allclose(np.abs(effects[..., i]), np.abs(moved) / NOISE, atol=1e-6)
    assert not model_of(positions()).unknown_columns
    assert not model_of(positions())._unknown_conditions(positions()).any()


@pytest.mark.parametrize(
    ("payloads", "masses", "is_beyond"),
    [
        (None, 5.0, False), (None, 5.5, True), (None, 4.5, True), ((0.0, 5.0), 5.0, False),
        ((0.0, 5.0), 0.0, False), ((1.0, 5.0), 0.5, True), ((0.0, 5.0), (1.0, 2.0, 6.0), True),
        ((0.0, 5.0), None, False),
    ],
)  # fmt: skip
def test_payloads_beyond_those_of_the_calibration(payloads, masses, is_beyond):
    arm = elastic("compliance")
    conditions: Any = {} if masses is None else {"payload": np.broadcast_to(masses, 3).astype(float)}
    model = model_of(positions(Q[:3], arm=arm, **conditions), arm=arm, payloads=payloads)
    assert model.has_extrapolated_payloads == is_beyond
    assert model.calibrated_payloads == (payloads or (5.0, 5.0))
    rigid = model_of(positions(Q[:3], **conditions), payloads=payloads)
    assert not rigid.has_extrapolated_payloads
    assert rigid.calibrated_payloads == (payloads or (0.0, 0.0))
    effects = model._extrapolated_yielding(model.data[0])
    assert effects.shape == (3, 3, 6 if is_beyond else 0)


def test_the_payload_of_a_rigid_arm_does_not_matter():
    assert not model_of(positions(), payloads=(0.0, 12.0)).unknown_columns
    # An arm without a payload of its own is modelled without any.
    arm = elastic("compliance", mass=None)
    model = model_of(positions(arm=arm), arm=arm, payloads=(0.0, 12.0))
    assert model._condition_spreads["payload"] == (0.0, pytest.approx(np.hypot(12 / np.sqrt(12), 6.0)))


def test_samples_with_known_conditions_are_predicted_with_them():
    arm = elastic("compliance", "thermal", "backlash")
    conditions = {"temperature": np.full(7, 35.0), "payload": np.full(7, 9.0), "approach": np.ones((7, 6))}
    model = model_of(positions(arm=arm, **conditions), arm=arm)
    np.testing.assert_allclose(model.rows[:, -1], 0, atol=1e-6)
    np.testing.assert_allclose(model._unknown_directions(model.data[0]), 0, atol=1e-6)


def test_yielding_to_an_excess_has_the_error_of_a_share_of_it():
    arm = elastic("compliance")
    masses = np.array([5.0, 9.0, 8.0])
    data = positions(Q[:3], arm=arm, payload=masses)
    model = model_of(data, arm=arm, payloads=(0.0, 5.0))
    effects = model._extrapolated_yielding(data)
    np.testing.assert_array_equal(effects[0], np.zeros((3, 6)))
    usual = arm.poses(positions(Q[:3], arm=arm, payload=np.full(3, 5.0)).conditions())
    moved = se3.log6(se3.inverse(usual) @ arm.poses(data.conditions()))[1:]
    size = 0.3 * np.sqrt(np.mean(np.sum(moved[:, :3] ** 2, 1)))
    for each in effects[1:]:
        np.testing.assert_allclose(
            each[:, :3] @ each[:, :3].T, np.eye(3) * (size / NOISE) ** 2, rtol=1e-6, atol=1e-6
        )
        np.testing.assert_allclose(each[:, 3:], 0, atol=1e-9)


def test_an_unknown_direction_may_be_either_one():
    """Of joints whose direction is known, or that have no backlash, none is."""
    arm = elastic("backlash")
    approach = np.ones((7, 6))
    approach[2, 1] = approach[4, 3] = 0
    data = positions(arm=arm, approach=approach)
    model = model_of(data, arm=arm)
    assert model.has_backlash
    effects = model._unknown_directions(data)
    shown = {(i, j) for i, _, j in np.argwhere(np.abs(effects) > 1e-6)}
    assert shown == {(2, 1), (4, 3)}
    for i, j in shown:
        moved = positions(
            arm=arm, approach=np.where(np.arange(7)[:, None] == i, approach + np.eye(6)[j], approach)
        )
        expected = (moved.positions() - data.positions())[i] / NOISE
        np.testing.assert_allclose(np.abs(effects[i, :, j]), np.abs(expected), atol=1e-6)
    assert model_of(positions())._unknown_directions(positions()).shape == (7, 3, 0)
    assert len({i for i, *_ in np.argwhere(model._unknown_directions(positions(arm=arm)))}) == 7


def test_origins_are_those_of_the_joints_between_base_and_tool():
    model = model_of(positions())
    assert len(model.origins) == 5
    errors = select_parameters(ARM, "placement")
    for j, origin in enumerate(model.origins):
        moved = []
        for i, parameter in enumerate(errors.parameters):
            if parameter.name.startswith(ARM.joint_names[j + 1]):
                step = 1e-6 * np.eye(len(errors.parameters))[i]
                moved.append((errors.at(step).poses(Q) - POSES)[:, :3, 3].ravel() / 1e-6 / NOISE)
        columns = np.array(moved).T
        assert columns.shape[1] > 0
        left = columns - origin @ np.linalg.lstsq(origin, columns)[0]
        assert np.abs(left).max() < 1e-3 * np.abs(columns).max()
    # A motion of such an origin explains what it caused, and nothing else does as well.
    parameter = [p.name.startswith(ARM.joint_names[2]) for p in errors.parameters].index(True)
    bent = errors.at(1e-3 * np.eye(len(errors.parameters))[parameter])
    q = np.random.default_rng(0).uniform(-2, 2, (12, 6))
    changed = model_of(positions(q).replace(values=bent.poses(q)[:, :3, 3]))
    assert changed.is_origin(0.0)
    assert not changed.is_origin(-24.0)
    noisy = positions(q).replace(
        values=positions(q).values + 1e-3 * np.random.default_rng(0).normal(size=(12, 3))
    )
    assert not model_of(noisy).is_origin(np.inf)
    # Or up to the largest residuals of noise, which has the freedom of all rows but those of a motion.
    model = model_of(noisy)
    fits = [np.linalg.lstsq(columns, model.rows[:, -1])[1:3] for columns in model.origins]
    largest = max(2.25 * chi2.isf(1e-3, 36 - rank) / square[0] for square, rank in fits if len(square))
    for share, is_explained in ((0.97, True), (1.03, False)):
        scaled, rows = model_of(noisy), model.rows.copy()
        rows[:, -1] *= np.sqrt(share * largest)
        vars(scaled)["rows"] = rows
        assert scaled.is_origin(np.inf) == is_explained


def test_samples_are_named_by_line_or_by_number():
    named = positions(Q[:3]).replace(source="a.csv", rows=np.array([2, 5, 6]))
    model = model_of(named, positions(Q[3:]))
    assert [model.place(i) for i in (0, 2, 3)] == ["line 2 of a.csv", "line 6 of a.csv", "sample 1"]
    hypotheses, *_ = model.judged()
    of = {each.of for each in hypotheses if each.kind == "sample"}
    assert of == {f"in line {i} of a.csv" for i in (2, 5, 6)} | {"1", "2", "3", "4"}
    sizes = {(h.size, h.std, h.unit, h.revealed) for h in hypotheses if h.kind == "sample"}
    assert sizes == {(0.0, 0.0, "m", 0.0)}


def test_likelihoods_without_a_change_are_those_of_each_noise():
    model = model_of(positions(sigma=None), uncertainty=uncertainty_of(1e-3, (1e-4, 1e-4)))
    residual = np.random.default_rng(0).normal(size=21)
    found = model.null_likelihoods(model.scaled_sets(residual[:, None]))[:, 0]
    for value, variances in zip(found, model.variances, strict=True):
        covariance = (model.axes * variances) @ model.axes.T
        expected = multivariate_normal(cov=covariance).logpdf(residual) + 10.5 * np.log(2 * np.pi)
        assert value == pytest.approx(expected)
    assert model.likely_noise == np.argmax(model.null_likelihoods(model.scaled_sets(model.rows[:, -1:])))


def log_densities(model, residuals, columns):
    """Return the log densities of residuals (n, d) without, (σ, d), and with a change, (σ, w, d)."""
    nothing, changed = [], []
    for variances in model.variances:
        covariance = (model.axes * variances) @ model.axes.T
        widths = (w**2 * columns @ columns.T + covariance for w in check.WIDTHS)
        nothing.append(multivariate_normal.logpdf(residuals.T, cov=covariance))
        changed.append([multivariate_normal.logpdf(residuals.T, cov=each) for each in widths])
    return np.array(nothing), np.array(changed)


@pytest.mark.parametrize("sigma", [NOISE, None])
def test_likelihoods_with_a_change_are_those_of_each_noise_and_width(sigma):
    """The columns of two coefficients are those of one direction, whose other eigenvalue is zero or less."""
    model = model_of(positions(Q[:2], sigma), uncertainty=uncertainty_of(1e-4, (1e-6, 1e-4)))
    rng = np.random.default_rng(0)
    residuals = rng.normal(size=(6, 3))
    for columns in (0.1 * rng.normal(size=(6, 2)), 0.1 * rng.normal(size=(6, 1)) @ [[1.0, 0.3, 0.7]]):
        nothing, changed = log_densities(model, residuals, columns)
        sets = model.scaled_sets(residuals)
        found = model.log_likelihoods(columns, sets, model.null_likelihoods(sets)) - 3 * np.log(2 * np.pi)
        assert found.shape == (len(model.noise_factors), 11, 3)
        np.testing.assert_allclose(found, changed, rtol=1e-6, atol=1e-5)
        # Their means are those over all noises and widths alike, in relation to those without a change.
        ratios = check._log_means(found) - check._log_means(nothing[:, None])
        expected = np.mean(np.exp(changed), (0, 1)) / np.mean(np.exp(nothing), 0)
        np.testing.assert_allclose(np.exp(ratios), expected, rtol=1e-4)


def test_changes_of_a_tenth_of_a_millimetre_to_ten_metres_are_equally_likely():
    np.testing.assert_allclose(check.WIDTHS, np.geomspace(1e-4, 10, 11))
    # An assumed noise may be a thousand times too large, and ten times too small.
    np.testing.assert_allclose(check.NOISE_FACTORS, np.geomspace(1e-3, 10, 17))


@pytest.mark.parametrize("sigma", [NOISE, None])
def test_few_robots_that_did_not_change_exceed_the_limit(sigma, monkeypatch):
    """The limit is the quantile of the sum of the weighted ratios for residuals of the most likely noise."""
    monkeypatch.setattr(check, "N_DRAWS", 60)
    monkeypatch.setattr(check, "MAX_FALSE_ALARMS", 0.05)
    item = positions(Q[:2], sigma)
    rng = np.random.default_rng(1)
    noise = (1.0 if sigma else 3e-2) * (sigma or 1e-3) * rng.normal(size=(2, 3))
    model = model_of(item.replace(values=item.values + noise), uncertainty=uncertainty_of(1e-4))
    assert (model.likely_noise == model.usual_noise) == (sigma is not None)
    groups, priors = [0.1 * rng.normal(size=(6, c)) for c in (1, 3)], np.array([0.7, 0.3])
    draws = np.random.default_rng(0).standard_normal((6, 60))
    residuals = model.axes @ (draws * np.sqrt(model.variances[model.likely_noise])[:, None])
    expected = np.zeros(60)
    for columns, prior in zip(groups, priors, strict=True):
        nothing, changed = log_densities(model, residuals, columns)
        expected += prior * np.mean(np.exp(changed), (0, 1)) / np.mean(np.exp(nothing), 0)
    found = model.limit(groups, np.log(priors))
    assert found == pytest.approx(np.log(np.quantile(expected, 0.95)), abs=0.02)


def test_the_evidence_has_the_priors_of_the_hypotheses():
    """Without residuals, the ratio of a change is the root of the determinants, averaged over the widths."""
    model = model_of(positions())
    _, likelihoods, weights, limit = model._evidence
    blocks = model.blocks
    assert len(likelihoods) == len(weights) == len(blocks) + 7
    columns = [model.rows[:, block.columns] * block.sizes for block in blocks]
    columns += [np.eye(21)[:, 3 * i : 3 * i + 3] / NOISE for i in range(7)]
    # All parts together are less likely than a joint, and all samples as likely as one.
    priors = np.array([1.0] * (len(blocks) - 1) + [0.3] + [1 / 7] * 7)
    for a, prior, weight in zip(columns, priors / priors.sum(), weights, strict=True):
        values = np.linalg.svd(a, compute_uv=False)
        ratios = [np.prod(1 / np.sqrt(1 + w**2 * values**2)) for w in check.WIDTHS]
        assert weight == pytest.approx(np.log(prior * np.mean(ratios)), abs=1e-5)
    assert limit == model.limit(columns, np.log(priors / priors.sum()))


@pytest.mark.parametrize(("share", "is_visible"), [(0.97, False), (1.03, True)])
def test_a_joint_is_visible_if_a_tenth_has_an_effect_of_five_standard_deviations(share, is_visible):
    """The noise is such that 0.1 rad at the elbow is a share of that effect."""
    usual = model_of(positions(sigma=1.0))
    column = next(each.columns for each in usual.layout.blocks if each.of == "elbow_joint")
    noise = 0.1 * np.linalg.norm(usual.rows[:, column]) / 5
    model = model_of(positions(sigma=noise / share))
    assert ("elbow_joint" in {block.of for block in model.blocks}) == is_visible
    assert ("elbow_joint" in model.hidden_joints) != is_visible
    *parts, robot = model.blocks
    assert (robot.kind, robot.of) == ("robot", "")
    np.testing.assert_array_equal(robot.columns, np.concatenate([each.columns for each in parts]))
    np.testing.assert_array_equal(robot.sizes, np.concatenate([each.sizes for each in parts]))
    # Directions of base and tool that do not show are held.
    assert not next(block for block in parts if block.kind == "tool").sizes[3:].any()


def test_an_estimate_weighs_residuals_against_its_prior():
    """Noise of 0.3 m leaves most of it to the prior, a third of a metre wide."""
    item = positions(sigma=0.3)
    model = model_of(item.replace(values=item.values + 1e-4 * np.array([2.0, -1.0, 3.0])))
    for kind in ("joint", "base"):
        block = next(each for each in model.layout.blocks if each.kind == kind)
        a, r = model.rows[:, block.columns] * block.sizes, model.rows[:, -1]
        ridge = np.linalg.solve(a.T @ a + 10 * np.eye(a.shape[1]), a.T @ r)
        values, columns, undone = model.estimate(block)
        np.testing.assert_allclose(values, ridge * block.sizes, rtol=1e-2, atol=1e-8)
        np.testing.assert_allclose(columns, a, atol=1e-2)
        left = undone - columns @ ridge
        expected = left @ left + 10 * ridge @ ridge
        assert model._cost(block, (ridge * block.sizes, columns, undone)) == pytest.approx(expected)


SMALL = np.array([3e-3, 0.0, -4e-3, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("kind", "values", "size", "std", "unit"),
    [
        ("joint", [-0.01], -0.01, 1e-4, "rad"), ("base", SMALL, 5e-3, np.hypot(0.6, 2.4) * 1e-4, "m"),
        ("tool", SMALL, 5e-3, np.hypot(0.6, 2.4) * 1e-4, "m"),
        # A screw moves the origin by a chord, not by the arc.
        ("base", [0.0, 0.3, 0.0, 1.0, 0.0, 0.0], 0.3 * 2 * np.sin(0.5), 2e-4, "m"),
        ("base", [0.0, 0.0, 1e-4, 0.6, 0.8, 0.0], 1.0, np.hypot(2.4, 4.0) * 1e-4, "rad"),
    ],
)  # fmt: skip
def test_a_size_is_that_of_the_motion_of_the_origin_or_of_the_turn(kind, values, size, std, unit):
    """The standard deviations of the coefficients are 1 to 6 times 0.0001."""
    model = model_of(positions())
    block = next(each for each in model.layout.blocks if each.kind == kind)
    covariance = np.diag((1e-4 * np.arange(1.0, len(values) + 1)) ** 2)
    found = model._size(block, np.array(values), covariance)
    assert found[:2] == pytest.approx((size, std), rel=1e-6)
    assert found[2] == unit


@pytest.mark.parametrize(("sigma", "noise"), [(NOISE, 0), (None, 3)])
def test_a_hypothesis_states_its_uncertainty_at_the_most_likely_noise(sigma, noise):
    model = model_of(positions(sigma=sigma))
    likelihoods = np.full((len(model.noise_factors), len(check.WIDTHS), 1), -9.0)
    likelihoods[noise, 4] = -1.0
    std = np.sqrt(model.variances[noise, 0])
    joint = next(block for block in model.blocks if block.of == "elbow_joint")
    found = model._hypothesis(joint, np.array([-0.01]), likelihoods, share=0.4)
    of_joint = std / np.linalg.norm(model.rows[:, joint.columns])
    assert (found.kind, found.of, found.share, found.unit) == ("joint", "elbow_joint", 0.4, "rad")
    assert (found.size, found.std) == pytest.approx((-0.01, of_joint))
    assert found.revealed == pytest.approx(model._revealed(joint, np.array([[of_joint**2]])))
    assert (found.angle, found.angle_std) == (0.0, 0.0)
    # The orientation of the tool does not show, and is not uncertain.
    tool = next(block for block in model.blocks if block.kind == "tool")
    found = model._hypothesis(tool, SMALL, likelihoods, share=0.1)
    a = model.rows[:, tool.columns[:3]] / std
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.linalg.inv(a.T @ a)
    along = SMALL / 5e-3
    assert (found.size, found.std) == pytest.approx((5e-3, np.sqrt(along @ covariance @ along)))
    assert found.revealed == pytest.approx(model._revealed(tool, covariance))
    assert (found.angle, found.angle_std) == (0.0, 0.0)
    # Changes of all parts have no size, but an accuracy.
    robot = model.blocks[-1]
    found = model._hypothesis(robot, np.ones(len(robot.columns)), likelihoods, share=0.2)
    assert (found.kind, found.size, found.std, found.unit) == ("robot", 0.0, 0.0, "m")
    assert found.revealed > 0


@pytest.mark.parametrize(("left", "is_imitated"), [(0.9e-3, True), (1.1e-3, False)])
def test_a_change_imitates_another_one_if_it_leaves_a_millionth_of_its_squares(left, is_imitated):
    model = model_of(positions())
    rows = np.zeros((21, 4))
    rows[0, 0] = rows[1, 1] = 1.0
    rows[:3, 2] = 0.6, 0.8, left
    vars(model)["rows"] = rows
    both_columns = Block("base", "", np.array([0, 1]), np.array([2.0, 0.5]))
    joint = Block("joint", "j0", np.array([2]), np.array([30.0]))
    assert model._has_effects_of(both_columns, joint) == is_imitated
    assert not model._has_effects_of(joint, both_columns)
    # All parts together, or a change itself, do not count.
    assert not model._has_effects_of(joint, joint)
    assert not model._has_effects_of(replace(both_columns, kind="robot"), joint)
    assert not model._has_effects_of(both_columns, replace(joint, kind="robot"))


FAR = se3.exp6(np.array([0.5, -0.3, 0.2, 0.0, 0.0, 3.1]))


def test_a_base_that_turned_far_is_found():
    """From the calibrated base it is not; nor is a change of all parts with it."""
    zeros = np.array([0.0, 0.0, 2e-3, 0.0, 0.0, 0.0])
    far = ARM.with_base_and_tool(ARM.base @ FAR, ARM.tool)
    model = model_of(positions(arm=far))
    block = model._block("base")
    found = model._estimate_part(block)
    np.testing.assert_allclose(se3.exp6(found[0]), FAR, atol=1e-6)
    assert model._cost(block, found) == pytest.approx(10 * np.sum((found[0] / block.sizes) ** 2), rel=1e-3)
    assert model._cost(block, model.estimate(block)) > 1e6
    assert model.is_changed(block)
    joint = next(each for each in model.blocks if each.of == "elbow_joint")
    assert not model.is_changed(joint)
    np.testing.assert_array_equal(model._estimate_part(joint)[0], model.estimate(joint)[0])
    changed = model_of(positions().replace(values=far.poses(Q + zeros)[:, :3, 3]))
    *parts, robot = changed.blocks
    estimates = [changed._estimate_part(each) for each in parts]
    assert changed._cost(robot, changed._estimate_robot(robot, parts, estimates)) < 500
    assert changed._cost(robot, changed.estimate(robot)) > 1e6


SLIP_Q = np.random.default_rng(3).uniform(-2, 2, (9, 6))


@pytest.mark.parametrize("cause", ["slip", "slip of one", "joint", "base and joint", "origin", "all"])
def test_a_slip_explains_samples_better_than_all_other_changes_only_if_it_happened(cause):
    """The base moved before the fifth sample, or another change happened before the check."""
    moved = ARM.base @ se3.exp6(np.array([2e-3, -1e-3, 1e-3, 2e-3, 1e-3, 1e-3]))
    zeros = 0.01 * np.eye(6)[2]
    errors = select_parameters(ARM, "placement")
    parameter = [p.name.startswith(ARM.joint_names[2]) for p in errors.parameters].index(True)
    after = {
        "slip": ARM.with_base_and_tool(moved, ARM.tool).poses(SLIP_Q),
        "joint": ARM.poses(SLIP_Q + zeros),
        "base and joint": ARM.with_base_and_tool(moved, ARM.tool).poses(SLIP_Q + zeros),
        "origin": errors.at(2e-3 * np.eye(len(errors.parameters))[parameter]).poses(SLIP_Q),
        "all": ARM.with_base_and_tool(moved, ARM.tool @ se3.exp6(SMALL)).poses(SLIP_Q + 0.003),
    }
    after["slip of one"] = after["slip"]
    values = after[cause][:, :3, 3].copy()
    first = {"slip": 4, "slip of one": 8}.get(cause, 0)
    values[:first] = ARM.poses(SLIP_Q[:first])[:, :3, 3]
    values += 0.2 * NOISE * np.random.default_rng(0).normal(size=values.shape)
    found = model_of(positions(SLIP_Q).replace(values=values)).slip()
    assert (found.lead > 12) == ("slip" in cause)
    if "slip" in cause:
        assert found.first == first
        assert found.is_determined == (cause == "slip")
        assert check._is_possible(found)
    if cause == "slip":
        np.testing.assert_allclose(se3.exp6(found.values), se3.inverse(ARM.base) @ moved, atol=3e-4)


@pytest.mark.parametrize("sigma", [NOISE, None])
def test_shares_are_those_of_all_hypotheses(sigma):
    values = positions().values + NOISE * np.random.default_rng(2).normal(size=(7, 3))
    model = model_of(positions(sigma=sigma).replace(values=values))
    hypotheses, total, limit = model.judged()
    found = [each.share for each in hypotheses]
    assert found == sorted(found, reverse=True)
    assert sum(found) == pytest.approx(1)
    assert total < limit
    kinds = [each.kind for each in hypotheses]
    assert (kinds.count("joint"), kinds.count("sample")) == (6, 7)
    assert {kinds.count(kind) for kind in ("base", "tool", "robot")} == {1}
    # The first joint turns as the base does.
    first = next(each for each in hypotheses if each.of == ARM.joint_names[0])
    assert first.imitators == ("base",)
    assert next(each for each in hypotheses if each.kind == "base").imitators == ()


def test_what_a_fit_leaves_is_that_of_least_squares():
    values = positions().values + 1e-4 * np.random.default_rng(2).normal(size=(7, 3))
    model = model_of(positions().replace(values=values))
    joints = [block for block in model.blocks if block.kind == "joint"][1:3]
    fit = model.explained(joints, np.zeros(model.layout.n_columns))
    a = model.rows[:, [block.columns[0] for block in joints]]
    left = model.rows[:, -1] - a @ np.linalg.lstsq(a, model.rows[:, -1])[0]
    assert fit.chi_square == pytest.approx(left @ left, rel=1e-4)
    assert fit.p_value == pytest.approx(chi2.sf(left @ left / 1.5**2, 21 - 2), rel=1e-2)
    assert fit.rms == pytest.approx(NOISE * np.sqrt(left @ left / 7), rel=1e-4)
    square = np.sum(model.rows[:, -1] ** 2)
    assert model.unchanged_p_value() == pytest.approx(chi2.sf(square / 1.5**2, 21))


def test_samples_are_blamed_only_if_the_others_agree():
    model: Any = model_of(positions())
    n_blocks, asked = len(model.blocks), []
    weights = np.full(n_blocks + 7, -20.0)
    weights[[0, n_blocks, n_blocks + 4, n_blocks + 5]] = -1.0, 0.0, -0.5, -6.0
    for agreeing, left in (({0, 4}, []), ({4}, [0]), (set(), [0, 4])):
        asked.clear()
        model._agrees_without = lambda i, agreeing=agreeing: [asked.append(i), i in agreeing][1]
        found = model._without_right_samples(weights)
        expected = weights.copy()
        expected[[n_blocks + i for i in left]] = -np.inf
        np.testing.assert_array_equal(found, expected)
        # The likely ones are asked about once each, the most likely one first.
        assert asked == [0, 4]


@pytest.mark.parametrize("kind", [Position, Pose])
def test_a_wrong_sample_is_the_most_likely_change(kind):
    values = positions().values + 0.02 * np.eye(7)[:, [3]]
    data: Any = positions().replace(values=values)
    if kind is Pose:
        poses = POSES.copy()
        poses[3, :3, :3] = poses[3, :3, :3] @ se3.exp6(np.array([0, 0, 0, 0.02, 0.01, 0]))[:3, :3]
        data = Pose(Q, poses, NOISE, ANGLE_NOISE)
    model: Any = model_of(data)
    hypotheses, total, limit = model.judged()
    assert total > limit
    assert (hypotheses[0].kind, hypotheses[0].of) == ("sample", "4")
    assert hypotheses[0].share > 0.9
    # The right samples are excluded where something changed only.
    for other, is_asked in ((model, True), (model_of(positions()), False)):
        calls = []
        other._without_right_samples = lambda weights, calls=calls: [calls.append(1), weights][1]
        other.judged()
        assert bool(calls) == is_asked


@pytest.mark.parametrize("sample", [2, 3])
@pytest.mark.parametrize("sigma", [NOISE, None])
def test_others_agree_without_a_wrong_sample_only(sample, sigma, monkeypatch):
    """The fourth sample is wrong, the first one of the second file."""
    monkeypatch.setattr(check, "N_DRAWS", 500)
    values = positions().values + 0.02 * np.eye(7)[:, [3]]
    whole = positions(sigma=sigma).replace(values=values)
    data = [whole.take(part) for part in np.split(np.arange(7), [3])]
    assert model_of(*data)._agrees_without(sample) == (sample == 3)


@pytest.mark.parametrize(("count", "is_enough"), [(5, True), (4, False)])
def test_others_may_agree_with_one_change(count, is_enough):
    """Beside a wrong sample, a joint changed, which needs four right samples."""
    values = ARM.poses(Q[:count] + 0.01 * np.eye(6)[2])[:, :3, 3] + 0.02 * np.eye(count)[:, [3]]
    model = model_of(positions(Q[:count]).replace(values=values))
    assert model._agrees_without(3) == is_enough
    assert not model._agrees_without(2)


@pytest.mark.parametrize(
    ("residual_std", "kind", "expected"),
    [
        (None, Position, None), ((0.0, 1e-3), Position, None), ((1e-4, 0.0), Position, (1e-4, 1e-6)),
        ((1e-4, 0.0), Pose, None), ((1e-4, 2e-3), Pose, (1e-4, 2e-3)), ((1e-9, 1e-9), Pose, (1e-6, 1e-6)),
    ],
)  # fmt: skip
def test_the_noise_of_a_calibration_must_be_known_for_all_that_is_measured(residual_std, kind, expected):
    data = [positions(sigma=None) if kind is Position else Pose(Q, POSES)]
    found = check._calibration_noise(uncertainty_of(1e-4, residual_std=residual_std), data)
    assert (found and (found.position, found.rotation)) == expected
    assert check._calibration_noise(None, data) is None
    assert check._calibration_noise(replace(uncertainty_of(1e-4), fit=None), data) is None


def test_a_least_noise_raises_smaller_ones():
    sigma, angle = np.full((4, 3), 1e-4), np.full((4, 3), 1e-3)
    sigma[1, 2], angle[2, 0] = 5e-4, 1e-5
    item, noise = Pose(Q[3:], POSES[3:], sigma, angle), Noise(2e-4, 5e-4)
    found: Any = check._with_least_noise(item, noise)
    np.testing.assert_array_equal(found.sigma, np.maximum(sigma, 2e-4))
    np.testing.assert_array_equal(found.rotation_sigma, np.maximum(angle, 5e-4))
    given: Any = check._with_noise(item, noise)
    np.testing.assert_array_equal(given.sigma, np.full((4, 3), 2e-4))
    np.testing.assert_array_equal(given.rotation_sigma, np.full((4, 3), 5e-4))
    unstated: Any = check._with_least_noise(Pose(Q[3:], POSES[3:]), noise)
    np.testing.assert_array_equal(unstated.sigma, np.full((4, 3), 2e-4))
    assert given.has_stated_sigma
    assert unstated.has_stated_sigma


def test_a_model_gets_the_noise_of_the_calibration_where_none_is_stated():
    uncertainty = uncertainty_of(1e-5, residual_std=(3e-4, 2e-4))
    stated = model_of(positions(), uncertainty=uncertainty)
    assert stated.with_known_noise() is stated
    assert model_of(positions(sigma=None)).with_known_noise() is None
    judge = model_of(positions(Q[:3]), positions(Q[3:], None), uncertainty=uncertainty).with_known_noise()
    assert judge is not None
    np.testing.assert_array_equal(judge._sigma, [NOISE] * 3 + [3e-4] * 4)


@pytest.mark.parametrize(
    ("noise", "uncertainty", "sigmas"),
    [
        (None, None, (NOISE, 2e-4, None)), (Noise(3e-4, 1e-4), None, (3e-4, 3e-4, 3e-4)),
        (None, uncertainty_of(1e-5), (1e-4, 2e-4, None)),
        (Noise(3e-5, 1e-4), uncertainty_of(1e-5), (3e-5, 3e-5, 3e-5)),
    ],
)  # fmt: skip
def test_a_check_has_the_given_noise_or_at_least_that_of_the_calibration(
    noise, uncertainty, sigmas, monkeypatch
):
    """The errors that the calibration left are in the samples, too; unstated noise is estimated."""
    taken: list[Any] = []
    judged = [], 2.0, 1.0
    model = SimpleNamespace(judged=lambda: judged, parts=[JOINT], position_rms=lambda: (2e-4, np.nan))
    monkeypatch.setattr(check, "_CheckModel", lambda *args: taken.append(args) or model)
    monkeypatch.setattr(check, "_answer", lambda *args: args)
    data = [positions(Q[:2]), positions(Q[2:4], 2e-4), positions(Q[4:], None)]
    known = {"x": 1.0}
    found: Any = recheck(ARM, data, uncertainty, known=known, noise=noise, size=2e-3, payloads=(1.0, 2.0))
    assert found == (model, *judged, 2e-3)
    usual: Any = recheck(ARM, data)
    assert usual[-1] == 1e-3
    (arm, items, given, *rest), (*_, unknown, payloads) = taken
    assert (arm, given, rest, unknown, payloads) == (ARM, uncertainty, [known, (1.0, 2.0)], {}, None)
    assert [item.has_stated_sigma for item in items] == [sigma is not None for sigma in sigmas]
    for item, sigma in zip(items, sigmas, strict=True):
        np.testing.assert_array_equal(
            item.sigma, data[2].sigma if sigma is None else np.full((len(item.q), 3), sigma)
        )


def test_other_kinds_of_measurements_are_refused():
    data = [Inclination.simulate(ARM, Q, Noise(0, 1e-4), np.random.default_rng(0))] * 2
    expected = "recheck: the measurements are of the kind inclination; expected position or pose"
    with pytest.raises(InvalidArgumentError, match=f"^{expected}$"):
        recheck(ARM, data)
    with pytest.raises(InvalidArgumentError, match="of the kind position, inclination; expected position"):
        recheck(ARM, [positions(), *data])


@pytest.mark.parametrize(
    ("shift", "count", "is_larger"), [(0.0, 7, False), (1e-3, 7, True), (1e-3, 4, True), (1e-3, 3, False)]
)
def test_an_excess_error_needs_four_samples(shift, count, is_larger):
    data = positions(Q[:count]).replace(values=positions(Q[:count]).values + shift)
    found = find_excess_error(ARM, [data], uncertainty_of(1e-6))
    assert (found is not None) == is_larger
    if found:
        # The noise is that of the calibration, which is larger than the stated one.
        assert found == pytest.approx((np.sqrt(3) * shift, np.sqrt(3) * 1e-4), rel=1e-3)
    turned = Pose(Q, POSES @ se3.exp6(np.array([0.0, 0.0, 0.0, 0.01, 0.0, 0.0])), NOISE, ANGLE_NOISE)
    assert find_excess_error(ARM, [turned], uncertainty_of(1e-6)) is None
    inclination = Inclination.simulate(ARM, Q, Noise(0, 1e-4), np.random.default_rng(0))
    assert find_excess_error(ARM, [inclination], uncertainty_of(1e-6)) is None
    assert find_excess_error(ARM, [data, inclination], uncertainty_of(1e-6)) is None
    assert find_excess_error(ARM, [data], uncertainty_of(1e-6, residual_std=None)) is None


def test_an_excess_error_of_many_samples_is_that_of_a_part(monkeypatch):
    """A largest number of rows of 6 leaves every fourth of seven positions."""
    monkeypatch.setattr(check, "MAX_ROWS", 6)
    monkeypatch.setattr(check, "MIN_SAMPLES", 2)
    shift = 1e-3 * (np.arange(7) % 4 == 0)[:, None]
    data = positions().replace(values=positions().values + shift)
    found = find_excess_error(ARM, [data], uncertainty_of(1e-6))
    assert found is not None
    assert found[0] == pytest.approx(np.sqrt(3) * 1e-3)


def test_too_many_rows_are_refused():
    data = Position(np.zeros((201, 6)), np.zeros((201, 3)), NOISE)
    with pytest.raises(InvalidArgumentError, match="603 measured values; expected at most 600: five to ten"):
        recheck(ARM, [data])


@pytest.mark.parametrize(("angle", "rank"), [(0.3, 2), (1e-3, 1)])
def test_what_two_changes_cancel_is_left_out(angle, rank):
    first, second = 2.0 * np.eye(4)[:, :1], 3.0 * np.array([[np.cos(angle), np.sin(angle), 0.0, 0.0]]).T
    inverse, found = check._separable_inverse([first, second])
    assert found == rank
    columns = np.hstack([first, second])
    if rank == 2:
        np.testing.assert_allclose(inverse @ columns, np.eye(2), atol=1e-9)
    # What is left is still explained.
    np.testing.assert_allclose(columns @ inverse @ columns, columns, atol=0.01)
    # Multiples of a column count once, whatever their size.
    row = np.random.default_rng(0).normal(size=(4, 1))
    for size in (1e-12, 1.0, 1e12):
        single, count = check._separable_inverse([size * row @ np.array([[1.0, np.pi]])])
        assert (single.shape, count) == ((2, 4), 1)


@pytest.mark.parametrize(("share", "rank"), [(0.98, 1), (1.02, 2)])
def test_two_changes_are_separable_if_two_hundredths_of_them_remain(share, rank):
    """The smaller singular value of two unit vectors is √2·sin(α/2)."""
    angle = 2 * np.arcsin(share * 0.02 / np.sqrt(2))
    columns = [np.array([[1.0], [0.0]]), np.array([[np.cos(angle)], [np.sin(angle)]])]
    assert check._separable_inverse(columns)[1] == rank


@pytest.mark.parametrize(("freedom", "chi_square"), [(1, 9.0), (12, 40.0), (0, 40.0), (-1, 3.0)])
def test_the_probability_is_that_of_the_largest_noise_that_is_possible(freedom, chi_square):
    expected = chi2.sf(chi_square / 1.5**2, freedom) if freedom > 0 else 1.0
    assert check._p_value(freedom, chi_square) == pytest.approx(expected)


def test_sums_and_means_of_large_logarithms():
    values = np.log(np.arange(1.0, 13.0).reshape(2, 3, 2)) + 1000
    np.testing.assert_allclose(check._log_means(values), 1000 + np.log([6.0, 7.0]))
    np.testing.assert_allclose(check._log_sums(values[0]), 1000 + np.log([9.0, 12.0]))


@pytest.mark.parametrize(
    ("value", "text"), [(3.5e-3, "3.50 mm"), (3.6e-3, "3.6 mm"), (1e-4, "0.100 mm"), (2.0, "2000 mm")]
)
def test_an_error_is_stated_with_an_accuracy_of_a_tenth(value, text):
    assert check._text_of_error(value) == text


@pytest.mark.parametrize(
    ("kind", "expected"), [("base", (0.05, 0.2)), ("tool", (0.05, 0.2)), ("joint", (0, 0))]
)
def test_a_turn_has_the_uncertainty_along_its_axis(kind, expected):
    covariance = np.diag([1.0, 1.0, 1.0, 0.04, 0.04, 0.09])
    block = Block(kind, "", np.arange(6), np.ones(6))
    found = check._turn(block, np.array([1.0, 2.0, 3.0, 0.03, -0.04, 0.0]), covariance)
    assert found == pytest.approx(expected)
    assert check._turn(block, np.zeros(6), covariance) == (0.0, 0.0)


# ------------------------------------------------------------------------------------------- answers
JOINT, OTHER = (Block("joint", f"j{i}", np.array([i]), np.ones(1), i) for i in (0, 1))
BASE = Block("base", "", np.arange(2, 8), np.ones(6))
ROBOT = Block("robot", "", np.arange(8), np.ones(8))
GOOD, BAD = 0.5, 1e-6
MORE = "Measure more poses, as `dhcal plan --recheck` chooses them"


def explained(p_value, chi_square=10.0, count=7):
    """Return what some changes leave."""
    values = np.array([0.01, 3e-3, 4e-3, 0.0, 0.3, 0.0, 0.4][:count])
    return Explained(values, 1e-8 * np.eye(count), 2e-3, chi_square, p_value)


def slip(**values):
    """Return a motion of the base from the third sample on, which explains the samples."""
    usual = {"first": 2, "values": np.array([3e-3, 0, 4e-3, 0, 0, 0]), "covariance": 1e-10 * np.eye(6)}
    usual |= {"freedom": 12, "chi_square": 12.0, "lead": 50.0, "is_determined": True}
    return SimpleNamespace(**(usual | values))


class Findings:
    """Findings of a check that are stated."""

    def __init__(self, **values: Any):
        """Take the values that differ from those of samples that nothing but a change of a joint explains."""
        self.numbers = np.repeat(np.arange(8), 3)
        self.parts = [JOINT, OTHER, BASE]
        self.blocks = [*self.parts, ROBOT]
        self.layout = SimpleNamespace(n_columns=9)
        self.unknown_columns, self.hidden_joints = [], []
        self.has_extrapolated_payloads, self.calibrated_payloads = False, (0.0, 5.0)
        self.judge: Any = self
        self.moved, self.unchanged, self.rms = 2e-4, GOOD, (2e-3, 1e-4)
        self.found, self.origin_limit, self.changed = slip(lead=-50.0), -np.inf, []
        self.left: dict[tuple[str, ...], Explained] = {}
        self.judgement: Any = None
        vars(self).update(values)

    def with_known_noise(self):
        """Return the findings with a known noise."""
        return self.judge

    def position_rms(self):
        """Return the distances."""
        return self.rms

    def hidden_motion(self):
        """Return the motion that may be hidden."""
        return self.moved

    def unchanged_p_value(self):
        """Return the probability of larger residuals."""
        return self.unchanged

    def judged(self):
        """Return the hypotheses."""
        return self.judgement

    def slip(self):
        """Return the motion of the base during the check."""
        return self.found

    def place(self, sample):
        """Return the name of a sample."""
        return f"sample {sample + 1}"

    def is_origin(self, chi_square):
        """Return whether an origin explains the residuals as well."""
        return chi_square > self.origin_limit > -np.inf

    def is_changed(self, block):
        """Return whether a block explains the residuals."""
        return block in self.changed

    def estimate(self, block):
        """Return an estimate of a block."""
        return np.full(len(block.columns), 0.5), None, None

    def explained(self, blocks, start):
        """Return what blocks leave, from a start at the first one."""
        expected = np.zeros(9)
        expected[blocks[0].columns] = 0.5
        np.testing.assert_array_equal(start, expected)
        return self.left.get(tuple(f"{b.kind} {b.of}".strip() for b in blocks), explained(BAD, 99.0))

    def _size(self, block, values, covariance):
        """Return the size of a change."""
        std = float(np.sqrt(covariance[0, 0]))
        if block.kind == "joint":
            return float(values[0]), std, "rad"
        return float(np.linalg.norm(values[:3])), std, "m"


def hypothesis(name, share, **values):
    """Return a hypothesis by its name."""
    kind, _, of = name.partition(" ")
    usual = {"size": 5e-3, "std": 1e-4, "unit": "rad" if kind == "joint" else "m", "revealed": 3e-4}
    return Hypothesis(kind, of, share, **(usual | values))


def answer(shares, total=9.0, size=1e-3, **findings: Any):
    """Return the answer to findings, with hypotheses of some shares that begin with the likely one."""
    hypotheses = [
        value if isinstance(value, Hypothesis) else hypothesis(name, value) for name, value in shares.items()
    ]
    if not any(each.kind == "robot" for each in hypotheses):
        hypotheses.append(hypothesis("robot", 0.0))
    model: Any = Findings(**findings)
    return check._answer(model, hypotheses, total, 5.0, size)


CERTAIN = {"joint j0": 0.97, "joint j1": 0.02, "base": 0.01}
ALONE = {("joint j0",): explained(GOOD), ("base",): explained(GOOD)}


def test_an_answer_has_the_figures_of_its_findings():
    found = answer(CERTAIN, left=ALONE)
    assert (found.verdict, found.what, found.has_several) == ("changed", "joint j0", False)
    assert found.reasons == ("The zero of joint j0 changed by 0.286°.",)
    assert (found.log_ratio, found.samples, found.residual_rms, found.expected_rms) == (4.0, 8, 2e-3, 1e-4)
    assert [each.name for each in found.hypotheses] == ["joint j0", "joint j1", "base", "robot"]
    document = found.to_dict()
    assert document["what"] == "joint j0"
    assert (document["size"], document["std"], document["unit"]) == (5e-3, 1e-4, "rad")
    assert document["changes"] == [
        {"kind": "joint", "of": "j0", "size": 5e-3, "std": 1e-4, "unit": "rad", "share": 0.97}
    ]
    assert (document["samples"], document["log_ratio"]) == (8, 4.0)
    assert (document["residual_rms_m"], document["expected_rms_m"]) == (2e-3, 1e-4)
    assert document["hypotheses"][2]["angle"] == document["hypotheses"][2]["angle_std"] == 0
    # Without a known noise, the expected distance is not known, and the change is not compared with it.
    unknown = answer(CERTAIN, judge=None, rms=(2e-3, np.nan)).to_dict()
    assert unknown["expected_rms_m"] is None
    assert unknown["what"] == "joint j0"
    nothing = answer(CERTAIN, total=5.0).to_dict()
    assert (nothing["size"], nothing["changes"], nothing["what"]) == (None, [], "")


@pytest.mark.parametrize(("count", "is_enough"), [(3, False), (4, True)])
def test_an_answer_needs_four_samples(count, is_enough):
    found = answer(CERTAIN, left=ALONE, numbers=np.repeat(np.arange(count), 3))
    assert found.samples == count
    if is_enough:
        assert found.verdict == "changed"
    else:
        assert (found.verdict, found.reasons) == ("cannot say", ("Too few samples: 3; expected at least 4.",))


@pytest.mark.parametrize(("total", "verdict"), [(4.9, "ok"), (5.0, "ok"), (5.1, "changed")])
def test_a_change_needs_more_evidence_than_its_limit(total, verdict):
    assert answer(CERTAIN, total, left=ALONE).verdict == verdict


def test_a_change_with_the_same_effect_is_named_too():
    """The base has all effects of the first joint."""
    imitated = hypothesis("joint j0", 0.6, imitators=("base",))
    found = answer({"": imitated, "base": 0.3, "joint j1": 0.1}, left=ALONE)
    assert found.what == "joint j0 or base"
    assert found.reasons[0].endswith(" A change of base has the same effect.")
    # The other way round, if it is not unlikely.
    for share, what in ((0.1, "base or joint j0"), (0.01, "base")):
        rival = hypothesis("joint j0", share, imitators=("base",))
        found = answer({"base": 0.9 - share, "": rival, "joint j1": 0.1}, left=ALONE)
        assert found.what == what
    assert found.reasons[1] == (
        "The arm itself did not change: with the new base the positions differ by 2.00 mm RMS, as noise and "
        "uncertainty explain."
    )


def test_a_base_within_a_change_of_all_parts():
    found = answer({"robot": 0.5, "base": 0.45, "joint j0": 0.05}, left=ALONE)
    assert found.what == "base"
    found = answer({"base": 0.5, "robot": 0.45, "joint j0": 0.05}, left=ALONE)
    assert found.what == "base"
    found = answer({"robot": 0.4, "base": 0.3, "joint j0": 0.3})
    assert (found.verdict, found.changes) == ("cannot say", ())


def test_it_is_said_which_changes_are_not_distinguished_and_what_helps():
    shares = {"joint j0": 0.5, "joint j1": 0.3, "base": 0.15, "robot": 0.05}
    found = answer(shares)
    assert found.reasons == (
        "Something changed. These samples do not show which of these it is: joint j0 (50 %), joint j1 (30 "
        f"%), base (15 %). {MORE}.",
    )
    found = answer(
        shares, unknown_columns=["payload[kg]", "temperature[degC]"], has_extrapolated_payloads=True
    )
    assert found.reasons[1:] == (
        "State the conditions of the samples: payload[kg] and temperature[degC].",
        "The payload is beyond that of the calibration; measure with 0 to 5 kg.",
    )
    found = answer(shares, has_extrapolated_payloads=True, calibrated_payloads=(5.0, 5.0))
    assert found.reasons[1] == "The payload is beyond that of the calibration; measure with 5 kg."
    # A decided answer needs no more conditions.
    found = answer(CERTAIN, left=ALONE, unknown_columns=["payload[kg]"], has_extrapolated_payloads=True)
    assert len(found.reasons) == 1


def test_a_wrong_sample_is_measured_again():
    found = answer({"sample in line 5 of a.csv": 0.9, "joint j0": 0.1})
    assert (found.verdict, found.changes) == ("cannot say", ())
    assert found.reasons == ("The sample in line 5 of a.csv does not fit to the others; measure it again.",)


SLIPPED = (
    "The base or the instrument moved by 5.000 mm from sample 3 on.",
    "Before and after, the samples fit",
)


@pytest.mark.parametrize(
    ("values", "is_named"),
    [
        ({}, True), ({"lead": 12.0}, True), ({"lead": 11.9}, False), ({"is_determined": False}, False),
        ({"chi_square": 1e3}, False),
    ],
)  # fmt: skip
def test_a_base_that_moved_during_the_check(values, is_named):
    """It is named where no single change is likely, and where a likely one does not explain the samples."""
    for shares in ({"joint j0": 0.5, "joint j1": 0.3, "base": 0.2}, CERTAIN):
        found = answer(shares, found=slip(**values))
        assert (found.what == "base from sample 3 on") == is_named
        if is_named:
            assert found.verdict == "changed"
            assert found.reasons[0].startswith(SLIPPED[0])
            assert found.reasons[1].startswith(SLIPPED[1])
            (change,) = found.changes
            assert (change.size, change.std, change.angle) == pytest.approx((5e-3, 1e-5, 0.0))
            assert (change.share, change.revealed) == (1.0, 0.0)
    unknown = answer({"joint j0": 0.5, "base": 0.5}, found=slip(**values), judge=None)
    assert unknown.verdict == "cannot say"


ORIGIN = "More than one part of the robot changed, or the origin of a joint"


def test_an_origin_is_blamed_if_no_single_part_explains_the_samples():
    shares = {"joint j0": 0.5, "joint j1": 0.3, "base": 0.2}
    found = answer(shares, origin_limit=1.0)
    assert (found.verdict, found.what, found.has_several) == ("changed", "robot", False)
    assert found.reasons == (f"{ORIGIN}: calibrate again.",)
    for part in (JOINT, OTHER, BASE):
        assert answer(shares, origin_limit=1.0, changed=[part]).verdict == "cannot say"
    assert answer(shares, origin_limit=1.0, judge=None).verdict == "cannot say"
    # A change of all parts alone is no single part.
    assert answer(shares, origin_limit=1.0, changed=[ROBOT]).what == "robot"


@pytest.mark.parametrize(
    ("values", "is_possible"),
    [({"lead": -11.0}, True), ({"lead": -12.0}, False), ({"chi_square": 1e3}, False)],
)
def test_a_motion_during_the_check_may_be_the_cause_too(values, is_possible):
    found = answer({"robot": 0.99, "joint j0": 0.01}, found=slip(**({"lead": -11.0} | values)))
    assert (found.verdict, found.what) == ("changed", "robot")
    more = (
        ", or the base or the instrument moved during the check, from sample 3 on. Fasten both, and measure "
        "again; with the same answer, calibrate again."
    )
    assert found.reasons == (ORIGIN + (more if is_possible else ": calibrate again."),)
    # Without a known noise, a motion is not excluded.
    unknown = answer({"robot": 0.99, "joint j0": 0.01}, judge=None)
    assert unknown.reasons[0].startswith(f"{ORIGIN}, or the base or the instrument moved during the check. ")


def test_two_changes_are_named_if_only_one_pair_explains_the_samples():
    left = {("base", "joint j0"): explained(GOOD, 10.0), ("base", "joint j1"): explained(GOOD, 22.0)}
    left = {key: replace(value, values=np.roll(value.values, -1)) for key, value in left.items()}
    for shares in ({"base": 0.97, "joint j0": 0.03}, {"robot": 0.97, "joint j0": 0.03}):
        found = answer(shares, left=left)
        assert (found.verdict, found.what, found.has_several) == ("changed", "base and joint j0", True)
        first, second = found.changes
        assert (first.size, first.std, first.angle) == pytest.approx((5e-3, 1e-4, 0.5))
        assert (first.share, second.share, first.revealed, second.revealed) == (1.0, 1.0, 0.0, 0.0)
        assert (second.size, second.std, second.unit, second.angle) == (0.01, pytest.approx(1e-4), "rad", 0.0)
        assert found.reasons[0].startswith("The base or the instrument moved by 5.00 mm and turned by 28.6")
        assert found.reasons[1].startswith("The zero of joint j0 changed by ")
    # A motion of one origin that explains the samples as well is as likely.
    found = answer({"base": 0.97, "joint j0": 0.03}, left=left, origin_limit=9.0)
    assert (found.what, found.has_several) == ("robot", False)
    assert answer({"base": 0.97, "joint j0": 0.03}, left=left, origin_limit=11.0).has_several


def test_it_is_said_what_two_changes_are_not_distinguished():
    left = {("base", "joint j0"): explained(GOOD, 15.0), ("base", "joint j1"): explained(GOOD, 10.0)}
    found = answer({"base": 0.97, "joint j0": 0.03}, left=left)
    assert (found.verdict, found.changes) == ("cannot say", ())
    assert found.reasons[0].endswith(
        " Something else changed, too: 2.00 mm RMS remain, and noise and uncertainty explain 0.100 mm."
    )
    assert found.reasons[1:] == (
        "These samples do not show which: joint j1, joint j0.",
        f"{MORE}, or calibrate again.",
    )
    # For all parts, they are not named; if no pair explains the samples, none is.
    found = answer({"robot": 0.97, "joint j0": 0.03}, left=left)
    assert (found.what, found.reasons) == ("robot", (f"{ORIGIN}: calibrate again.",))
    assert (found.verdict, found.has_several) == ("changed", False)
    assert len(answer({"base": 0.97, "joint j0": 0.03}).reasons) == 2


@pytest.mark.parametrize("is_stated", [True, False])
def test_residuals_that_are_larger_than_noise_and_uncertainty(is_stated):
    judge = Findings(
        unchanged=BAD,
        judgement=([hypothesis("joint j0", 0.97), hypothesis("robot", 0.03)], 9.0, 5.0),
        left=ALONE,
    )
    findings: Any = {"unchanged": BAD} if is_stated else {"judge": judge}
    found = answer(CERTAIN, total=4.0, **findings)
    assert found.verdict == "cannot say"
    if is_stated:
        assert found.reasons == (
            "The positions differ by 2.00 mm RMS, and the stated noise and the uncertainty of the "
            "calibration explain 0.100 mm. Either the noise is larger, or something changed that is none of "
            "the changes that are compared.",
        )
    else:
        assert found.reasons == (
            "The positions differ by 2.00 mm RMS, and noise and uncertainty of the calibration explain 0.100 "
            "mm. Either these measurements have more noise, or the robot changed: state their noise by "
            "`--sigma`.",
            "With the noise of the calibration, the answer is `changed`: The zero of joint j0 changed by "
            "0.286°.",
        )


REMEDY = "expected 1 mm: measure more poses, as `dhcal plan --recheck` chooses them, or more accurately."


def test_nothing_changed_if_every_change_would_be_revealed():
    found = answer(CERTAIN, total=4.0, moved=3.6e-4)
    assert found.verdict == "ok"
    assert found.reasons == ("Nothing changed that moves the measured point by more than 0.36 mm.",)
    assert "by more than 0.350 mm" in answer(CERTAIN, total=4.0, moved=3.5e-4).reasons[0]
    assert "by more than 0.30" in answer(CERTAIN, total=4.0, moved=1e-4).reasons[0]
    found = answer(CERTAIN, total=4.0, hidden_joints=["j4", "j5"])
    assert found.reasons[1] == "Zeros of j4, j5 do not move it; measure a point off their axes."
    shares = {name: hypothesis(name, 0.3, revealed=r) for name, r in (("joint j0", 2e-3), ("base", 3e-3))}
    found = answer(shares, total=4.0)
    assert (found.verdict, found.reasons) == (
        "cannot say",
        (f"A change of base would be revealed from 3 mm at the tool on; {REMEDY}",),
    )
    # The size that matters is excluded; changes of the robot and of samples do not count.
    others = {name: hypothesis(name, 0.3, revealed=9e-3) for name in ("robot", "sample 1")}
    exact = {"tool": hypothesis("tool", 0.4, revealed=1e-3)}
    assert answer(exact | others, total=4.0).verdict == "ok"
    found = answer(CERTAIN, total=4.0, moved=2e-3)
    assert (found.verdict, found.reasons) == (
        "cannot say",
        (f"Changes of several parts would be revealed from 2 mm at the tool on; {REMEDY}",),
    )


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (hypothesis("joint j0", 1.0, size=-5e-3), "The zero of joint j0 changed by 0.286°."),
        (hypothesis("joint j2", 1.0, unit="m"), "The zero of joint j2 changed by 5.00 mm."),
        (hypothesis("tool", 1.0), "The tool moved by 5.00 mm."),
        (hypothesis("tool", 1.0, unit="rad"), "The tool turned by 0.286°."),
        (hypothesis("tool", 1.0, angle=0.009, angle_std=1e-4), "The tool moved by 5.00 mm."),
        (hypothesis("tool", 1.0, angle=0.02, angle_std=1e-4), "The tool moved by 5.00 mm and turned "
         "by 1.146°."),
        (hypothesis("tool", 1.0, angle=0.02, angle_std=0.0041), "The tool moved by 5.00 mm."),
        (hypothesis("tool", 1.0, angle=0.02, angle_std=0.0039), "The tool moved by 5.00 mm and turned "
         "by 1.15°."),
        (hypothesis("tool", 1.0, unit="rad", angle=0.02, angle_std=1e-4), "The tool turned by 0.286°."),
        (hypothesis("base", 1.0), "The base or the instrument moved by 5.00 mm, as after a new set-up of the "
         "instrument."),
        (hypothesis("base from line 4 on", 1.0), "The base or the instrument moved by 5.00 mm "
         "from line 4 on."),
    ],
)  # fmt: skip
def test_a_change_is_stated_with_its_size(change, text):
    assert check._sentence([change]) == text
    others = [hypothesis("base", 0.5), hypothesis("joint j1", 0.5)]
    assert check._sentence([change, *others]) == f"{text} A change of base or joint j1 has the same effect."


def test_several_changes_are_joined_by_and():
    changes = (hypothesis("base", 1.0), hypothesis("joint j1", 1.0))
    result = Recheck("changed", (), changes, changes, 1.0, 5, 0.0, 0.0)
    assert result.what == "base or joint j1"
    assert replace(result, has_several=True).what == "base and joint j1"
    assert check._names([BASE, JOINT]) == "base, joint j0"
