"""Accuracy within the measured region and beyond it, against the known truth of simulated arms."""

from dataclasses import replace

import numpy as np
import pytest
from robots import measured_arm, with_random_frames
from slow_cases import some_slow

from dhcal_pin.calibration import Result, accuracy, blocked_folds, calibrate, k_fold
from dhcal_pin.calibration.cross_validation import compare_folds
from dhcal_pin.calibration.summary import generalization_lines
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Noise, PointContact, Pose, Position
from dhcal_pin.robot import Chain

# Calibrations of arms with large errors, of which nothing asks for mistakes.
pytestmark = pytest.mark.usefixtures("unsuspected")

SETS = "minimal,base,tool"
NOISE = Noise(5e-5, 5e-5)
KEY = "position_rms_m"


def wrong_arm(seed: int, families: str = "minimal") -> tuple[Chain, Chain, np.random.Generator]:
    """Return a UR5, the same arm with random errors and frames, and a generator."""
    arm, rng = measured_arm("ur5"), np.random.default_rng(seed)
    errors = select_parameters(arm, families)
    sizes = {"m": 1e-3, "rad": 2e-3}
    size = np.array([sizes[p.unit] if p.coefficient_index is None else 5e-4 for p in errors.parameters])
    return arm, with_random_frames(errors.at(size * rng.normal(size=len(size))), rng), rng


def simulated(m: int, seed: int, spread: float = 1.5, families: str = "minimal") -> tuple[Result, Chain]:
    """Calibrate the geometry of an arm from positions within ± spread [rad]; return also the true arm."""
    arm, truth, rng = wrong_arm(seed, families)
    data = Position.simulate(truth, rng.uniform(-spread, spread, (m, 6)), NOISE, rng)
    return calibrate(arm, data, SETS, extend="none"), truth


def true_error(fit: Result, truth: Chain, q: np.ndarray) -> float:
    """Return the RMS position error at joint values (m, 6), measured with the same noise [m]."""
    rng = np.random.default_rng(1)
    return accuracy(fit.chain, Position.simulate(truth, q, NOISE, rng))[KEY]


def test_nominal_robot_is_fitted_to_the_other_samples_of_each_fold():
    fit, _ = simulated(60, 0)
    (data,) = fit.inliers
    for folds in (k_fold(data, 5), blocked_folds(data)):
        squares = []
        for (mask,) in folds:
            alone = calibrate(fit.errors.chain, data.take(~mask), "base,tool", loss="linear")
            held_out = accuracy(alone.chain, data.take(mask))
            squares.append((held_out[KEY] ** 2, mask.sum()))
        errors, counts = np.transpose(squares)
        before = compare_folds(fit, folds, "cross-validated").comparison.before
        assert before[KEY] == pytest.approx(np.sqrt(np.average(errors, weights=counts)), rel=1e-3)


def test_one_step_per_region_agrees_with_complete_calibrations():
    arm, truth, rng = wrong_arm(3)
    data = Pose.simulate(truth, rng.uniform(-1.5, 1.5, (60, 6)), NOISE, rng)
    one_step, complete = (
        calibrate(arm, data, SETS, extend="none", holdout=holdout) for holdout in ((), "region")
    )
    np.testing.assert_array_equal(one_step.x, complete.x)
    assert one_step.region_comparison is None
    assert complete.comparisons[0] is complete.generalization.region_holdout
    for stage in ("before", "after"):
        errors = [getattr(fit.generalization.region_holdout, stage)[KEY] for fit in (one_step, complete)]
        assert errors[0] == pytest.approx(errors[1], rel=0.05)
    by_hand = []
    for (mask,) in blocked_folds(data):
        part = calibrate(arm, data.take(~mask), SETS, extend="none")
        by_hand += [accuracy(part.chain, data.take(mask), part.instruments)[KEY]] * int(mask.sum())
    after = complete.comparisons[0].after
    assert after[KEY] == pytest.approx(np.sqrt(np.mean(np.square(by_hand))), rel=1e-12)


def test_families_are_selected_again_without_each_region():
    arm, truth, rng = wrong_arm(4, "minimal,harmonics")
    data = Position.simulate(truth, rng.uniform(-2, 2, (80, 6)), NOISE, rng)
    fit = calibrate(arm, data, SETS, extend=["harmonics"], holdout="region")
    assert fit.extension is not None
    assert fit.extension.families == ("harmonics",)
    after = fit.comparisons[0].after[KEY]
    parts = [
        accuracy(calibrate(arm, data.take(~mask), SETS, extend="harmonics").chain, data.take(mask))[KEY]
        for (mask,) in blocked_folds(data)
    ]
    assert min(parts) < after < max(parts)


def figures_and_truth(seed: int, m: int) -> list[float]:
    """Return the true error in the measured region over the stated one, for both figures."""
    fit, truth = simulated(m, seed)
    found = fit.generalization
    assert found.cross_validated is not None
    assert found.region_holdout is not None
    true = true_error(fit, truth, np.random.default_rng(seed).uniform(-1.5, 1.5, (1000, 6)))
    return [true / found.cross_validated.after[KEY], true / found.region_holdout.after[KEY]]


@pytest.mark.parametrize(("n", "off"), some_slow([(3, 0.15), (6, 0.12)], {0}))
def test_cross_validated_figure_is_the_true_error_in_the_measured_region(n, off):
    inside, beyond = np.median([figures_and_truth(seed, 50) for seed in range(n)], 0)
    assert inside == pytest.approx(1, abs=off)
    assert 0.75 < beyond < 1.05


@pytest.mark.slow
@pytest.mark.parametrize(("m", "spread"), [(30, 0.35), (60, 0.2), (120, 0.12)])
def test_cross_validated_figure_is_the_true_error_in_the_measured_region_many(m, spread):
    ratios = np.array([figures_and_truth(seed, m) for seed in range(60)])
    inside, beyond = np.median(ratios, 0)
    assert inside == pytest.approx(1, abs=0.12 if m == 30 else 0.06)
    assert np.quantile(np.abs(ratios[:, 0] - inside), 0.9) < spread
    assert beyond < 1.02


def beyond_the_region(seed: int) -> tuple[float, float, float]:
    """Return both figures and the true error beyond the measured region, of geometry for an eccentric arm."""
    fit, truth = simulated(80, seed, 0.8, "minimal,harmonics")
    found, region = fit.generalization, fit.measured_region
    assert found.cross_validated is not None
    assert found.region_holdout is not None
    assert region is not None
    q = np.random.default_rng(seed).uniform(-1.4, 1.4, (2000, 6))
    return (
        found.cross_validated.after[KEY],
        found.region_holdout.after[KEY],
        true_error(fit, truth, q[~region.contains(q)]),
    )


@pytest.mark.parametrize("n", some_slow([2, 4], {0}))
def test_errors_that_the_model_lacks_make_the_figure_beyond_the_region_larger(n):
    inside, beyond, true = np.transpose([beyond_the_region(seed) for seed in range(n)])
    assert np.all(beyond > inside)
    assert np.median(true / inside) > np.median(true / beyond) > 0.7


def test_a_joint_that_did_not_move_leaves_the_rest_unknown():
    arm, truth, rng = wrong_arm(0)
    q = rng.uniform(-1.5, 1.5, (60, 6))
    q[:, 4] = 0.3
    fit = calibrate(arm, Position.simulate(truth, q, NOISE, rng), SETS, extend="none")
    found = fit.generalization
    assert found.cross_validated is not None
    assert found.region_holdout is None
    assert found.region_holdout_reason == "wrist_2_joint did not move"
    assert found.reached_share is not None
    assert found.reached_share < 0.01
    lines = generalization_lines(found, fit.comparisons)
    assert lines[1] == "Beyond it: cannot be said, wrist_2_joint did not move."


def test_a_joint_that_moves_in_one_region_only_leaves_the_rest_unknown():
    """Without the poses in which the last joint moved, nothing determines the tool."""
    arm, truth, rng = wrong_arm(0)
    q = rng.uniform(-1.5, 1.5, (80, 6))
    q[:70, 5] = 0.0
    q[70:, 5] = rng.uniform(2.0, 2.2, 10)
    fit = calibrate(arm, Position.simulate(truth, q, NOISE, rng), SETS, extend="none")
    found = fit.generalization
    assert found.region_holdout is None
    assert found.region_holdout_reason == "wrist_3_joint hardly moved outside one of the left-out regions"
    repeated = calibrate(arm, fit.data, SETS, extend="none", holdout="region")
    assert repeated.generalization.region_holdout is None
    assert repeated.comparisons[0].title == "cross-validated"


def test_few_samples_give_no_figures():
    fit, truth = simulated(7, 0)
    found = fit.generalization
    assert found.cross_validated is None
    assert found.region_holdout is None
    assert found.cross_validated_reason == "too few samples"
    assert found.region_holdout_reason.startswith("too few samples")
    # The error of this calibration is indeed many times the noise of the measurement.
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (200, 6))
    assert true_error(fit, truth, q) > 10 * 5e-5


def test_equal_configurations_give_no_figures():
    arm, truth, rng = wrong_arm(0)
    fit = calibrate(arm, Position.simulate(truth, np.zeros((20, 6)), NOISE, rng), SETS)
    found = fit.generalization
    assert (found.cross_validated, found.region_holdout) == (None, None)
    assert found.cross_validated_reason == found.region_holdout_reason
    assert "same joint values" in found.region_holdout_reason
    assert (found.covered_share, found.reached_share) == (0, 0)


def test_shares_of_the_joint_space():
    """Poses over the whole joint space cover it; poses in a part of it cover and reach less."""
    arm, truth, rng = wrong_arm(0)
    shares = []
    for spread in (np.pi, 2.0, 1.0):
        data = Position.simulate(truth, rng.uniform(-spread, spread, (300, 6)), NOISE, rng)
        found = calibrate(arm, data, SETS, extend="none").generalization
        assert found.covered_share is not None
        assert found.reached_share is not None
        assert found.covered_share <= found.reached_share
        shares.append((found.covered_share, found.reached_share))
    assert shares[0][0] == pytest.approx(0.95, abs=0.04)
    assert shares[0][1] > 0.98
    assert np.all(np.diff(shares, axis=0) < 0)
    # Within ±1 rad of each joint lie 0.1 % of the joint space.
    assert shares[2][0] < 0.02


def touched(truth: Chain, rng: np.random.Generator, n_places: int, m: int) -> PointContact:
    """Touch four points at each of some places, (m) times in all at a place."""
    q, points = [], []
    for place in range(n_places):
        around = rng.uniform(-0.8, 0.8, 6)
        item = PointContact.simulate(truth, around + rng.uniform(-0.7, 0.7, (m, 6)), NOISE, rng)
        q.append(item.q)
        points += [f"place{place}_{item.names[label]}" for label in item.label]
    return PointContact(np.concatenate(q), points)


@pytest.mark.parametrize("holdout", some_slow([((),), "region"], {0}))
def test_points_that_are_left_out_are_fitted_to_their_own_samples(holdout):
    arm, truth, rng = wrong_arm(0)
    fit = calibrate(arm, touched(truth, rng, 6, 20), "minimal,tool", extend="none", holdout=holdout)
    found, fitted = fit.generalization, fit.comparisons[-1]
    assert found.region_holdout is not None
    for stage in ("before", "after"):
        left_out, own = (getattr(each, stage)[KEY] for each in (found.region_holdout, fitted))
        assert 0.9 * own < left_out < 2.5 * own
    assert found.region_holdout.after[KEY] > fitted.after[KEY]


def test_points_that_only_hold_out_samples_touch_are_fitted_to_them():
    arm, truth, rng = wrong_arm(0)
    data = touched(truth, rng, 4, 20)
    is_held_out = np.array([data.names[label].startswith("place3") for label in data.label])
    fit = calibrate(
        arm, data.take(~is_held_out), "minimal,tool", extend="none", holdout=data.take(is_held_out)
    )
    assert not any("place3" in name for name in fit.instruments)
    assert sum("place2" in name for name in fit.instruments) == 12
    held_out, fitted = fit.comparisons
    for stage in ("before", "after"):
        assert getattr(held_out, stage)[KEY] < 3 * getattr(fitted, stage)[KEY]


def test_no_correction_has_the_same_error_before_and_after():
    fit, _ = simulated(40, 0)
    refused = replace(fit, x=0 * fit.x, chain=fit.nominal_refitted, shrinkage_factor=0.0)
    for comparison in refused.comparisons:
        assert comparison.before[KEY] == pytest.approx(comparison.after[KEY], rel=1e-12)


def test_hold_out_samples_take_the_place_of_the_cross_validated_ones():
    arm, truth, rng = wrong_arm(0)
    data, held = (Position.simulate(truth, rng.uniform(-1.5, 1.5, (m, 6)), NOISE, rng) for m in (50, 30))
    fit = calibrate(arm, data, SETS, extend="none", holdout=held)
    assert [each.title for each in fit.comparisons] == ["hold-out", "fitted"]
    first, _ = generalization_lines(fit.generalization, fit.comparisons)
    shown = 1e3 * fit.comparisons[0].after[KEY]
    assert f"{shown:.3f} mm after" in first
    assert fit.generalization.cross_validated is not None
