"""Outliers are in no figure, no loss hides them, and few samples that cannot show them are not "ok"."""

import json
import re

import numpy as np
import pytest
from robots import ARMS, nominal_arm, robot_file
from sessions import Changes, Simulation, write_csv
from slow_cases import some_slow

from dhcal_pin import calibrate, split
from dhcal_pin.calibration.evaluation import compute_errors
from dhcal_pin.calibration.summary import headline
from dhcal_pin.calibration.verdict import (
    MIN_ROWS_PER_DIRECTION,
    MIN_STATED_ROWS_PER_DIRECTION,
    STATUSES,
    Finding,
    Verdict,
)
from dhcal_pin.cli.main import main
from dhcal_pin.estimation import select_parameters
from dhcal_pin.estimation.robust import LOSSES
from dhcal_pin.measurements import KINDS, Noise, Pose, Position
from dhcal_pin.measurements.length import Wires
from dhcal_pin.measurements.position import PointMeasurement

# Samples that are 20 mm wrong, and those that are held out.
WRONG, HELD_OUT = [3, 24, 40, 61, 75], np.arange(80) % 4 == 0


def shifted(data, samples, offset):
    """Return positions, some of which are shifted by an offset (3,) or by one each."""
    positions = data.positions().copy()
    positions[samples] += offset
    return Position(data.q, positions)


def with_outliers(arm="ur10", count=80, seed=31):
    """Return a simulation and its positions, five of which are wrong by 20 mm."""
    simulation = Simulation(arm, count, seed)
    data = simulation.measure(Position)
    return simulation, shifted(data, WRONG, [0.02 * simulation.direction() for _ in WRONG])


def test_no_figure_contains_outliers():
    """All figures are those of the samples that are not outliers, computed here from single errors."""
    simulation, data = with_outliers()
    fit = calibrate(
        simulation.chain, data.take(~HELD_OUT), holdout=data.take(HELD_OUT), extend="none", session="off"
    )
    is_wrong = np.isin(np.arange(80), WRONG)
    np.testing.assert_array_equal(fit.is_counted[0], ~is_wrong[~HELD_OUT])
    np.testing.assert_array_equal(fit.is_holdout_counted[0], ~is_wrong[HELD_OUT])
    assert fit.n_outliers == 3
    for comparison, item, mask in (
        (fit.comparisons[0], fit.holdout, fit.is_holdout_counted[0]),
        (fit.comparisons[-1], fit.data, fit.is_counted[0]),
        (fit.file_comparisons[0], fit.data, fit.is_counted[0]),
    ):
        (errors,) = compute_errors(fit.chain, item, fit.instruments)
        norms = np.linalg.norm(errors["position"], axis=1)
        expected = np.sqrt(np.mean(norms[mask] ** 2))
        assert comparison.after["position_rms_m"] == pytest.approx(expected)
        assert comparison.after["position_max_m"] == pytest.approx(norms[mask].max())
        assert (comparison.n_samples, comparison.n_outliers) == (mask.sum(), np.sum(~mask))
    text = headline(fit.comparisons).text
    assert "18 hold-out samples" in text
    assert re.search(r"without 2 outliers \([\d.]+ mm with them\)\.", text)
    regions, folds = fit.generalization.region_holdout, fit.generalization.cross_validated
    assert regions is not None
    assert folds is not None
    assert folds.n_samples == 57
    for comparison in (regions, folds):
        assert comparison.n_outliers == 3
        assert comparison.after["position_max_m"] < 1e-3
    assert fit.residuals.is_outlier.sum() == len(WRONG)


def test_outliers_that_a_fit_contains_are_in_no_figure_either():
    simulation, data = with_outliers()
    fit = calibrate(simulation.chain, data, loss="linear", extend="none", session="off")
    assert (fit.weights[0] == 1).all()
    assert fit.n_outliers > 0
    for comparison in fit.comparisons:
        assert comparison.n_samples == 80 - fit.n_outliers
    # The folds are fitted with them, as the robot was: the figure does not hide the harm that they do.
    assert fit.comparisons[0].after["position_rms_m"] > simulation.true_error(fit.chain)


def test_commands_name_outliers_and_the_error_of_each_file(tmp_path, capsys):
    simulation, data = with_outliers()
    files = [tmp_path / name for name in ("a.csv", "b.csv")]
    for file, part in zip(files, (slice(0, 40), slice(40, 80)), strict=True):
        write_csv(file, simulation, data.take(np.arange(80)[part]))
    words = ["calibrate", robot_file(ARMS["ur10"][0]), *files, "--tip", "tool0", "-o", tmp_path / "out.urdf"]
    # With this seed some of the wrong samples are held out.
    words += [
        "--json",
        tmp_path / "out.json",
        "--report",
        tmp_path / "out.md",
        "--holdout",
        "0.25",
        "--seed",
        1,
    ]
    assert main(list(map(str, words))) == 0
    document = json.loads((tmp_path / "out.json").read_text())
    # Line 1 has the names of the columns.
    expected = {str(files[0]): [5, 26], str(files[1]): [2, 23, 37]}
    assert document["outliers_by_file"] == expected
    by_file = document["accuracy_by_file"]
    assert list(by_file) == list(map(str, files))
    left_out = sum(each["outliers"] for each in by_file.values())
    left_out += document["comparisons"][0]["n_outliers"]
    assert left_out == len(WRONG)
    for key in ("after", "holdout_after", "cross_validated_after"):
        assert document[key]["position_rms_m"] < 2e-4
    assert all(each["after"]["position_rms_m"] < 2e-4 for each in by_file.values())
    shown = " ".join(capsys.readouterr().err.split())
    assert "error of each file, RMS" in shown
    assert "without" in shown
    assert "| a.csv |" in (tmp_path / "out.md").read_text()


def test_files_with_different_bases_have_their_own_pose(tmp_path):
    """A base that is 5 mm elsewhere in the second of two files."""
    simulation = Simulation("panda", 80, 33)
    data = simulation.measure(Position, Changes("base", 5e-3))
    parts = [data.take(np.arange(80)[part]) for part in (slice(0, 40), slice(40, 80))]
    parts = [part.replace(source=name) for part, name in zip(parts, ("a.csv", "b.csv"), strict=True)]
    fit = calibrate(simulation.chain, parts, extend="none")
    assert fit.verdict.status == "caution"
    assert "The base moved by" in fit.verdict.reasons[0]
    assert "between a.csv and b.csv" in fit.verdict.reasons[0]
    assert all(each.after["position_rms_m"] < 2e-4 for each in fit.file_comparisons)
    assert simulation.true_error(fit.chain) < 1e-4


# Number of outliers of 100 samples, and their size [m]; the same offset if it is negative.
MISTAKES = [(45, 2e-3), (35, -1e-3), (12, 2e-2), (5, 5e-2), (48, -3e-3), (25, 5e-4), (0, 0.0)]


@pytest.mark.parametrize(("n_outliers", "size"), some_slow(MISTAKES, {0}))
def test_no_loss_lifts_the_verdict(n_outliers, size):
    """45 outliers bend a fit with equal weights so much that few of them show."""
    simulation = Simulation("ur10", 100, 62)
    data = simulation.measure(Position, Changes(n_outliers=n_outliers, outlier=max(size, 0.0)))
    if size < 0:
        data = shifted(data, simulation.rng.permutation(100)[:n_outliers], [0.0, size, size])
    fits = {
        loss: calibrate(simulation.chain, data, loss=loss, extend="none", session="off") for loss in LOSSES
    }
    severity = {loss: STATUSES.index(fit.verdict.status) for loss, fit in fits.items()}
    assert min(severity.values()) == severity["auto"]
    if n_outliers > 10:
        assert severity["auto"] > 0
    if n_outliers == 45:
        assert fits["linear"].verdict.reasons[0].startswith("With --loss auto: 45 of 100 samples")


def test_samples_of_two_tools_need_no_more_poses():
    """Two tools in one file, in a random order: two halves of the samples agree with each other only."""
    simulation = Simulation("panda", 60, 36)
    data = simulation.measure(Pose, Changes("tool", 4e-2, 0.1))
    mixed = data.take(simulation.rng.permutation(60)).replace(rows=np.arange(1, 61))
    (reason,) = calibrate(simulation.chain, mixed, extend="none").verdict.reasons
    assert "30 of 60 samples (50 %) are outliers" in reason
    assert "another set-up, tool or robot" in reason


def test_outliers_that_follow_each_other_are_an_event():
    simulation = Simulation("ur10", 100, 11)
    data = simulation.measure(Position)
    run = shifted(data, np.arange(40, 48), [3e-3, 2e-3, 3e-3])
    fit = calibrate(simulation.chain, run, extend="none")
    assert fit.verdict.status == "caution"
    assert "8 outliers follow each other (lines 41 to 48)" in fit.verdict.reasons[0]
    scattered = shifted(data, simulation.rng.permutation(100)[:8], [3e-3, 2e-3, 3e-3])
    fit = calibrate(simulation.chain, scattered, extend="none")
    assert fit.n_outliers == 8
    assert fit.verdict.status == "ok"


@pytest.mark.parametrize("kind", [Position, Pose])
def test_few_samples_that_cannot_show_outliers_are_not_ok(kind):
    """20 positions of seven joints have 1.9 values for each unknown, 20 poses 3.5."""
    simulation = Simulation("panda", 20, 34)
    fit = calibrate(simulation.chain, simulation.measure(kind), extend="none")
    rows = 20 * (3 if kind is Position else 6)
    assert fit.rows_per_direction == pytest.approx(rows / fit.rank)
    if kind is Pose:
        assert fit.verdict.status == "ok"
        return
    (reason,) = fit.verdict.reasons
    assert reason.startswith("So few samples do not reveal outliers: 1.9 independent values")
    needed = int(reason.split(" different poses")[0].rsplit(" ", 1)[1])
    assert needed * 3 / fit.rank >= MIN_ROWS_PER_DIRECTION > (needed - 1) * 3 / fit.rank
    more = Simulation("panda", needed, 34)
    assert calibrate(more.chain, more.measure(Position), extend="none").verdict.status == "ok"


def test_needed_poses_do_not_count_those_that_are_held_out():
    simulation = Simulation("ur10", 24, 35)
    data = simulation.measure(Position)
    held_out, fitted = data.take(np.s_[-8:]), data.take(np.s_[:-8])
    for holdout, end in ((held_out, " different poses to be fitted."), ((), " different poses.")):
        reasons = calibrate(simulation.chain, fitted, holdout=holdout, extend="none").verdict.reasons
        (reason,) = (text for text in reasons if text.startswith("So few samples"))
        assert reason.endswith(end)


def test_a_kept_robot_has_no_part_of_the_correction():
    simulation = Simulation("ur10", 9, 2)
    data = simulation.measure(Position)
    held_out, fitted = data.take(np.s_[-2:]), data.take(np.s_[:-2])
    fit = calibrate(simulation.chain, fitted, holdout=held_out, extend="none")
    assert fit.verdict.keeps_nominal
    # The chain of the fit has the correction: only the accepted result says that it has none.
    assert fit.shrinkage_factor
    assert np.any(fit.chain.poses(fitted.q) != simulation.chain.poses(fitted.q))
    (reason,) = (text for text in fit.verdict.reasons if "nominal robot" in text)
    assert reason.endswith("Keep the nominal robot, and measure more poses.")
    assert "correction" not in " ".join(fit.verdict.reasons)
    assert fit.accepted.verdict.reasons == (*fit.verdict.reasons, "No correction is applied.")
    assert "Not significantly better" in fit.accepted.shrinkage_notes[0]


@pytest.mark.parametrize(("noise", "is_computed"), [(2e-6, True), (5e-5, False)])
def test_positions_that_the_controller_computed_are_named(noise, is_computed):
    """More of them show nothing."""
    arm, rng = nominal_arm("ur10"), np.random.default_rng(1)
    q = rng.uniform(-2.5, 2.5, (60, 6))
    points = arm.poses(q)[:, :3, 3] + noise * rng.standard_normal((60, 3))
    verdict = calibrate(arm, Position(q, points), extend="none").verdict
    assert verdict.keeps_nominal
    (reason,) = (text for text in verdict.reasons if "Keep the nominal robot" in text)
    assert ("probably computed with it" in reason) == is_computed
    assert ("measure more poses" in reason) == (not is_computed)


@pytest.mark.parametrize("zero", [0.0, 0.015])
def test_a_kept_robot_has_the_instruments_that_fit_it(zero):
    """The anchor and the zero of a wire were those before the fit: 8 mm in place of 0.2."""
    arm, rng = nominal_arm("ur10"), np.random.default_rng(4)
    q, anchor = rng.uniform(-2.3, 2.3, (60, 6)), np.array([1.2, -0.3, 0.9])
    lengths = np.linalg.norm(arm.poses(q)[:, :3, 3] - anchor, axis=1) + zero
    fit = calibrate(arm, Wires(q, (lengths + 2e-4 * rng.standard_normal(60))[:, None]), extend="none")
    assert fit.verdict.keeps_nominal
    kept = fit.accepted
    assert kept.instruments["wire1.zero"] == pytest.approx(zero, abs=2e-3)
    assert kept.validate(kept.data)["residual_rms"] < 2.5e-4


def test_repeated_samples_do_not_show_outliers_but_stated_noise_does():
    simulation = Simulation("ur10", 18, 35)
    data = simulation.measure(Position)
    repeated = Position(np.repeat(data.q, 3, 0), np.repeat(data.positions(), 3, 0))
    fit = calibrate(simulation.chain, repeated, extend="none")
    assert fit.rows_per_direction == pytest.approx(54 / fit.rank, abs=0.1)
    assert "So few samples" in fit.verdict.reasons[0]
    stated = Position(data.q, data.positions(), 5e-5)
    assert calibrate(simulation.chain, stated, extend="none").verdict.status == "ok"
    wrong = Position(data.q, shifted(data, [2, 9], [0.0, 2e-3, 0.0]).positions(), 5e-5)
    assert calibrate(simulation.chain, wrong, extend="none").verdict.status == "caution"


def stated(data):
    """Return positions with their standard deviations."""
    return Position(data.q, data.positions(), 5e-5)


@pytest.mark.parametrize(
    ("arm", "count", "values"),
    some_slow([("ur10", 8, "1.0"), ("ur10", 12, "1.3"), ("panda", 14, "1.4"), ("panda", 10, "1.0")], {0, 1}),
)
def test_stated_noise_shows_outliers_only_with_redundant_samples(arm, count, values):
    """Residuals show the mean share 1 - rank/rows of an outlier: less than a third is too little."""
    simulation = Simulation(arm, count, 901)
    fit = calibrate(simulation.chain, stated(simulation.measure(Position)), extend="none")
    assert not fit.contradicts_sigma
    assert 1 - fit.rank / (3 * count) < 1 / 3
    assert fit.verdict.status == "caution"
    reason = fit.verdict.reasons[0]
    assert reason.startswith(f"So few samples do not reveal outliers: {values} independent values")
    assert "1.5 are needed" in reason
    needed = int(reason.split(" different poses")[0].rsplit(" ", 1)[1])
    # Rows of the advised number of poses determine more directions than the present ones.
    for n_poses, is_enough in ((needed, True), (needed - 1, False)):
        more = Simulation(arm, n_poses, 902)
        advised = calibrate(simulation.chain, stated(more.measure(Position)), extend="none")
        assert advised.rank >= fit.rank
        assert is_enough == (not any("do not reveal outliers" in text for text in advised.verdict.reasons))


@pytest.mark.parametrize(("arm", "count"), some_slow([("ur10", 20), ("panda", 20), ("xarm7", 24)], {0}))
def test_twenty_samples_of_stated_noise_are_ok(arm, count):
    simulation = Simulation(arm, count, 901)
    data = simulation.measure(Position)
    assert calibrate(simulation.chain, stated(data), extend="none").verdict.status == "ok"
    wrong = shifted(data, [2, 3, 9, 11], [[1e-2, 0, 0], [0, -1e-2, 0], [0, 0, 1e-2], [-1e-2, 0, 0]])
    assert calibrate(simulation.chain, stated(wrong), extend="none").verdict.status == "caution"


def test_few_samples_are_the_first_reason_of_a_correction_that_is_too_large():
    """The fit adapts to two wrong samples of twelve: nothing is wrong with the robot."""
    simulation = Simulation("ur10", 12, 950)
    data = simulation.measure(Position)
    wrong = shifted(data, [2, 9], [[0.0, 0.08, 0.04], [-0.06, 0.0, 0.08]])
    fit = calibrate(simulation.chain, stated(wrong), extend="none")
    assert fit.contradicts_sigma
    assert fit.verdict.status == "refused"
    first, second = fit.verdict.reasons[:2]
    assert first.startswith("The residuals contradict the stated standard deviations. So few samples")
    assert second.startswith("The correction moves")
    assert "Check the robot" in second


@pytest.mark.parametrize(("arm", "seed"), [("panda", 7050), ("panda", 7054), ("xarm7", 7171)])
def test_joint_errors_that_explain_outliers_do_not_hide_them(arm, seed):
    """Three of 20 positions are wrong by 1.5 mm; joint errors or correlated residuals explain them, too."""
    simulation = Simulation(arm, 20, seed)
    data = simulation.measure(Position)
    wrong = seed % 1000 % 15 + np.arange(3)
    data = shifted(data, wrong, [1.5e-3 * simulation.direction() for _ in wrong])
    fit = calibrate(simulation.chain, Position(data.q, data.positions(), 5e-5))
    assert fit.extension
    assert fit.extension.families or fit.extension.temperature > 1
    assert fit.verdict.status == "caution"
    assert "So few samples do not reveal outliers" in fit.verdict.reasons[0]


def test_few_samples_of_which_a_tenth_are_outliers_need_caution():
    simulation = Simulation("ur10", 20, 30)
    data = simulation.measure(Position)
    data = shifted(data, [4, 11], [0.01 * simulation.direction() for _ in range(2)])
    fit = calibrate(simulation.chain, Position(data.q, data.positions(), 5e-5))
    assert fit.n_outliers == 2
    assert fit.verdict.reasons == ("2 of 20 samples (10 %) are outliers. Check the measurements.",)


@pytest.mark.parametrize(("n_poses", "seed"), [(9, 901), (10, 2054)])
def test_fewer_rows_than_the_unknowns_of_two_robots_do_not_show_two(n_poses, seed):
    simulation = Simulation("ur10", n_poses, seed)
    data = simulation.measure(Pose)
    fit = calibrate(simulation.chain, Pose(data.q, data.poses, 5e-5, 1e-4), extend="none")
    assert fit.session
    assert not fit.session.events
    assert not fit.verdict.is_refused


def test_a_figure_that_is_not_reliable_is_not_ok():
    """Nine poses with stated noise have enough redundancy, but too few to judge the accuracy."""
    simulation = Simulation("ur10", 9, 901)
    data = simulation.measure(Pose)
    fit = calibrate(simulation.chain, Pose(data.q, data.poses, 5e-5, 1e-4), extend="none")
    assert fit.rows_per_direction > MIN_STATED_ROWS_PER_DIRECTION
    assert "So few samples give no reliable figure." in headline(fit.comparisons).text
    assert fit.verdict.status == "caution"
    (reason,) = fit.verdict.reasons
    assert reason == (
        "The accuracy on 9 cross-validated samples is no reliable figure. Measure at least 10 samples."
    )


def true_errors(simulation, mode, share):
    """Return the verdict of positions with outliers, and their true error relative to that of clean ones."""
    data = simulation.measure(Position)
    clean = calibrate(simulation.chain, data, extend="none", session="off")
    rng, count = simulation.rng, max(1, round(share * simulation.count))
    first, size = rng.integers(simulation.count - count + 1), 10 ** rng.uniform(-3, -1)
    samples = first + np.arange(count) if mode == "block" else rng.permutation(simulation.count)[:count]
    offsets = [simulation.direction() for _ in samples] if mode == "scattered" else simulation.direction()
    fit = calibrate(simulation.chain, shifted(data, samples, size * np.array(offsets)), extend="none")
    ratio = simulation.true_error(fit.accepted.chain) / simulation.true_error(clean.chain)
    return fit.verdict.status, ratio


@pytest.mark.parametrize("seeds", some_slow([2, 60], {0}))
def test_no_outlier_among_few_samples_is_ok_and_harmful(seeds):
    """10 to 40 % of 20 positions are outliers: scattered, of one offset, or in a block."""
    for seed in range(seeds):
        for arm in ("ur10", "panda", "xarm7") if seeds > 2 else ("panda",):
            for mode in ("scattered", "same", "block"):
                share = (0.1, 0.2, 0.3, 0.4)[seed % 4]
                status, ratio = true_errors(Simulation(arm, 20, 800 + seed), mode, share)
                assert status != "ok" or ratio < 1.5, (arm, mode, seed)


@pytest.mark.parametrize("seed", some_slow([0, 2, 4], {2}))
def test_all_samples_are_no_majority_of_them(seed):
    """Only the scales of the noise differ from those of the fit: the sentence named 40 of 40 samples."""
    simulation = Simulation(("ur10", "panda")[seed % 4 // 2], 40, seed, errors=(2e-2, 4e-2))
    simulation.add_eccentricities(1e-2)
    data = simulation.measure(Position)
    stated = data.replace(sigma=np.full_like(data.sigma, 1.4e-4), has_stated_sigma=True)
    fit = calibrate(simulation.chain, stated)
    assert fit.hidden_majority is None
    assert "by themselves" not in " ".join(fit.verdict.reasons)


def test_a_majority_that_agrees_far_better_shows_outliers_to_which_a_fit_adapts():
    """10 of 26 positions of a UR10 are 1.2 mm away, though no sample has a large residual."""
    simulation = Simulation("ur10", 26, 704)
    data = simulation.measure(Position)
    clean = calibrate(simulation.chain, data, extend="none")
    assert clean.verdict.status == "ok"
    assert clean.hidden_majority is None
    n_hidden = 0
    for seed in range(4):
        samples = np.random.default_rng(seed).permutation(26)[:10]
        wrong = shifted(data, samples, 1.2e-3 * np.array([0.6, 0.0, 0.8]))
        fit = calibrate(simulation.chain, wrong, extend="none")
        assert fit.verdict.status == "caution"
        if not fit.n_outliers:
            n_hidden += 1
            assert fit.hidden_majority is not None
            assert abs(fit.hidden_majority[0] - 10) <= 2
            assert "samples agree" in fit.verdict.reasons[0]
    assert n_hidden


@pytest.mark.parametrize("kind", ["position", "wires"])
@pytest.mark.parametrize("seed", some_slow(range(10), range(4)))
def test_wrong_hold_out_samples_do_not_keep_the_nominal_robot(kind, seed):
    """Errors of 10 mm are no outliers beside those of 3 to 5 mm of the nominal robot."""
    arm, rng = nominal_arm("ur10"), np.random.default_rng(seed)
    errors = select_parameters(arm, "minimal")
    std = np.array([1e-3 if p.unit == "m" else 5e-3 for p in errors.parameters])
    truth = errors.at(std * rng.standard_normal(len(std)))
    data = KINDS[kind].simulate(truth, rng.uniform(-2.5, 2.5, (80, 6)), Noise(5e-5), rng)
    assert isinstance(data, PointMeasurement)
    values, wrong = data.values.copy(), rng.permutation(80)[:7]
    values[wrong] += 0.01 * rng.standard_normal((7, values.shape[1]))
    (fitted,), held_out = split(data.replace(values=values), 0.25, seed)
    fit = calibrate(arm, fitted, extend="none", session="off", holdout=held_out)
    assert "significantly" not in " ".join(fit.verdict.reasons)
    assert fit.shrinkage_factor == 1
    found = {line - 1 for lines in (*fit.outliers, *fit.holdout_outliers) for line in lines.tolist()}
    assert found <= set(wrong.tolist())


@pytest.mark.parametrize(("options", "advice"), [({"method": "gn"}, "lm"), ({"loss": "linear"}, "auto")])
def test_outliers_that_spoil_a_fit_are_a_caution(options, advice):
    """The advised option brings the stated error."""
    simulation, data = with_outliers()
    fit = calibrate(simulation.chain, data, session="off", **options)
    assert fit.verdict.status == "caution"
    reason = fit.verdict.reasons[0]
    assert reason.startswith("Outliers spoil the fit: ")
    assert f" {advice}, which excludes those far from the other samples." in reason
    advised = calibrate(simulation.chain, data, session="off")
    assert headline(advised.comparisons).after in reason
    assert simulation.true_error(advised.chain) < 0.5 * simulation.true_error(fit.chain)
    clean = calibrate(simulation.chain, simulation.measure(Position), session="off", **options)
    assert "Outliers spoil" not in " ".join(clean.verdict.reasons)


def test_a_refused_calibration_says_nothing_about_the_use_of_the_nominal_robot():
    keep, wrong = Finding("caution", "No correction is applied.", True), Finding("refused", "Wrong sign.")
    assert Verdict.from_findings([keep]) == Verdict("caution", ("No correction is applied.",), True)
    assert Verdict.from_findings([keep, wrong]) == Verdict("refused", ("Wrong sign.",))
