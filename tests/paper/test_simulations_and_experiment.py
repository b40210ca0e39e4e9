"""The paper's simulations and experiment against the figures that were verified by hand."""

from __future__ import annotations

import numpy as np
import pytest

from dhcal_pin.calibration.evaluation import accuracy
from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.cli import demo
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.measurements.position import Position
from dhcal_pin.paper import simulations
from dhcal_pin.paper.experiment import paper_arm, run_experiment

# Medians over 50 seeds: largest angle error in degrees, largest length error in mm, as printed, and the
# test poses' error in mm, whose poses are free.
FIGURES = {
    2: [("2.1", "10", 35.1), ("1.70", "6.23", 17.1), ("1.65", "5.85", 17.5)],
    10: [
        ("2.1", "10", 35.1),
        ("1.13", "4.40", 2.54),
        ("0.0192", "0.567", 0.0106),
        ("2.9e-06", "6.9e-05", 1.7e-6),
    ],
}


def rounded(value: float, like: str) -> str:
    """A value to as many digits as a printed one."""
    digits = len(like.split("e")[0].lstrip("0.").replace(".", ""))
    return f"{float(f'{value:.{digits - 1}e}'):.10g}"


@pytest.fixture(scope="module")
def six_two():
    return simulations.simulate("sim_6dof", "pose", 2, resample_each_iteration=False)


@pytest.fixture(scope="module")
def six_ten():
    return simulations.simulate("sim_6dof", "pose", 10, resample_each_iteration=False)


@pytest.mark.parametrize("poses", FIGURES)
def test_six_dof_medians_by_iteration(poses, six_two, six_ten):
    run = {2: six_two, 10: six_ten}[poses]
    for step, (angle, length, test) in enumerate(FIGURES[poses]):
        assert rounded(np.rad2deg(np.median(run.angle[:, step])), angle) == f"{float(angle):.10g}"
        assert rounded(1e3 * np.median(run.length[:, step]), length) == f"{float(length):.10g}"
        assert 1e3 * np.median(run.test[:, step]) == pytest.approx(test, rel=0.2)


def test_six_dof_ten_sets_find_the_truth(six_ten):
    assert (six_ten.rank, six_ten.rank_found) == (21, 24)
    assert not six_ten.null_space.any()
    assert np.all(np.rad2deg(six_ten.angle[:, 6]) < 1e-6)
    assert np.all(1e3 * six_ten.length[:, 6] < 1e-6)


def test_six_dof_two_sets_fit_and_are_wrong(six_two):
    assert (six_two.rank, six_two.rank_found) == (12, 12)
    assert np.all(six_two.residual < 1e-9)
    assert np.all(six_two.angle[:, -1] > np.deg2rad(0.1))


@pytest.mark.parametrize(
    ("poses", "nominal", "actual"), [(2, 12, {12}), (3, 18, {18}), (4, 21, {23, 24}), (5, 21, {24})]
)
def test_rank_by_number_of_poses(poses, nominal, actual, sim_6dof, sim_6dof_actual):
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (poses, 6))
    for chain, wanted in ((sim_6dof, {nominal}), (sim_6dof_actual, actual)):
        data = Pose.simulate(chain, q, Noise(), np.random.default_rng(0))
        assert calibrate(chain, data, "dh", method="gn", max_iterations=1).rank in wanted


def test_condition_in_metres(sim_6dof, sim_6dof_actual):
    """249 at Table 2 and 880 at Table 1, for many poses."""
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (2000, 6))
    for chain, wanted in ((sim_6dof, 249), (sim_6dof_actual, 880)):
        data = Pose.simulate(chain, q, Noise(), np.random.default_rng(0))
        assert calibrate(chain, data, "dh", method="gn", max_iterations=1).condition == pytest.approx(
            wanted, rel=0.1
        )


def test_unseen_directions_are_named(sim_6dof, sim_6dof_actual):
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (30, 6))
    at_nominal = Pose.simulate(sim_6dof, q, Noise(), np.random.default_rng(0))
    said = calibrate(sim_6dof, at_nominal, "dh", method="gn", max_iterations=1).unobservable
    assert len(said) == 2
    assert "only d2 + d3 + d4 is identifiable" in said[0]
    assert "only d5 + d6 is identifiable" in said[1]
    at_actual = Pose.simulate(sim_6dof_actual, q, Noise(), np.random.default_rng(0))
    assert calibrate(sim_6dof_actual, at_actual, "dh", method="gn", max_iterations=1).unobservable == []


def test_redrawn_sets_creep_to_the_truth():
    run = simulations.simulate("sim_6dof", "pose", 2, resample_each_iteration=True)
    medians = 1e3 * np.median(run.test, 0)
    for step, wanted in ((1, 17.1), (2, 10.2), (3, 7.0), (4, 3.9), (5, 2.3), (10, 0.43)):
        assert medians[step] == pytest.approx(wanted, rel=0.35)


def test_three_dof_ten_positions():
    run = simulations.simulate("sim_3dof", "position", 10, resample_each_iteration=False)
    assert (run.rank, run.rank_found) == (10, 11)
    names = [p.name for p in select_parameters(paper_arm("sim_3dof"), "dh").parameters]
    assert [name for name, unseen in zip(names, run.null_space, strict=True) if unseen] == ["alpha3"]
    medians = 1e3 * np.median(run.test, 0)
    for step, wanted in ((0, 18.8), (1, 0.705), (2, 0.00168), (3, 1.6e-6)):
        assert medians[step] == pytest.approx(wanted, rel=0.2)
    assert np.all(run.length[:, -1] < 1e-9)
    assert np.all(run.angle[:, -1] < np.deg2rad(1e-6))


def test_three_dof_three_positions():
    run = simulations.simulate("sim_3dof", "position", 3, resample_each_iteration=False)
    assert np.all(run.residual < 1e-9)
    assert 1e3 * np.median(run.test[:, -1]) == pytest.approx(2.59, rel=0.2)


def test_levenberg_marquardt_finds_the_truth_too(sim_6dof, sim_6dof_actual):
    for seed in range(50):
        q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (10, 6))
        data = Pose.simulate(sim_6dof_actual, q, Noise(), np.random.default_rng(0))
        fit = calibrate(sim_6dof, data, "dh", priors="none")
        assert fit.converged
        assert (
            fit.validate(Pose.simulate(sim_6dof_actual, -q, Noise(), np.random.default_rng(0)))[
                "position_max_m"
            ]
            < 1e-9
        )


@pytest.mark.parametrize(("poses", "wanted"), [(10, 0.241), (30, 0.111), (100, 0.064)])
def test_noise_is_averaged_out(poses, wanted, sim_6dof, sim_6dof_actual):
    """0.1 mm and 0.01° an axis: worst of 100 test poses in mm, median of 30 seeds."""
    worst = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        q = rng.uniform(-np.pi, np.pi, (poses, 6))
        data = Pose.simulate(sim_6dof_actual, q, Noise(1e-4, np.deg2rad(0.01)), rng)
        fit = calibrate(sim_6dof, Pose(q, data.poses), "dh", method="gn")
        test = Pose.simulate(sim_6dof_actual, rng.uniform(-np.pi, np.pi, (100, 6)), Noise(), rng)
        worst.append(1e3 * fit.validate(test)["position_max_m"])
    assert np.median(worst) == pytest.approx(wanted, rel=0.15)


# --- the experiment --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def experiment():
    return run_experiment()


def test_experiment_figures(experiment):
    mm = {key: 1e3 * value for key, value in experiment.figures.items()}
    assert mm["before"] == pytest.approx(25.547, abs=5e-4)
    assert mm["one_step"] == pytest.approx(5.629, abs=5e-4)
    assert mm["one_step_left_out"] == pytest.approx(11.4, abs=0.05)
    assert mm["least_squares"] == pytest.approx(4.724, abs=5e-4)
    assert mm["least_squares_left_out"] == pytest.approx(13.1, abs=0.05)
    assert mm["published_parameters"] == pytest.approx(51.58, abs=5e-3)
    assert mm["paper_before"] == pytest.approx(25.574, abs=5e-4)
    assert mm["paper_after"] == pytest.approx(18.208, abs=5e-4)
    assert mm["paper_before_all"] == pytest.approx(26.716, abs=5e-4)
    assert mm["paper_after_all"] == pytest.approx(20.174, abs=5e-4)


@pytest.mark.parametrize(
    ("options", "fitted", "left_out"),
    [
        ({"priors": "none", "fix": ["d3", "alpha3"]}, 4.724, 13.133),
        ({"method": "gn", "max_iterations": 1}, 5.629, 11.441),
    ],
)
def test_a_result_alone_says_the_same_of_points_left_out(experiment, options, fitted, left_out):
    """Folds so far from linear that they are fitted again, one step of the paper's loop included."""
    first, second = calibrate(experiment.chain, experiment.data, "dh", **options).comparisons
    assert (first.title, second.title) == ("cross-validated", "fitted")
    assert 1e3 * second.after["position_rms_m"] == pytest.approx(fitted, abs=5e-4)
    assert 1e3 * first.after["position_rms_m"] == pytest.approx(left_out, abs=2e-3)


def test_impossible_rows_are_found_with_their_reasons(experiment):
    assert [finding.row for finding in experiment.unreachable_rows] == [7, 8]
    seven, eight = experiment.unreachable_rows
    assert 1e3 * seven.error == pytest.approx(1095, abs=0.5)
    assert 1e3 * eight.error == pytest.approx(767, abs=0.5)
    assert "(29.95°, 29.69°, -29.39°)" in seven.reason
    assert "1305.8 mm" in eight.reason
    assert "745.0 mm" in eight.reason


def test_rows_are_found_wherever_they_stand(experiment, tmp_path):
    """Shuffled, and without the columns that say where the arm was sent."""
    from dhcal_pin.diagnostics.reachability import find_unreachable_rows
    from dhcal_pin.io.measurement_csv import measurement_text, read_measurement_file

    data = experiment.measurements.data.take(np.array([7, 0, 1, 6, 2, 3, 4, 5]))
    path = tmp_path / "t.csv"
    path.write_text(measurement_text(data, experiment.chain))
    assert [
        f.row for f in find_unreachable_rows(experiment.chain, read_measurement_file(path, experiment.chain))
    ] == [1, 4]


def test_held_parameters_are_those_that_cannot_be_seen(experiment):
    assert experiment.fixed == ["alpha3", "d3"]
    assert "little redundancy" in demo.experiment_remarks(experiment)[0]
    assert "51.6 mm" in demo.experiment_remarks(experiment)[2]


def test_good_rows_are_not_called_impossible(sim_6dof, sim_6dof_actual):
    """An arm as wrong as the paper's, with noise, in any pose."""
    from dhcal_pin.diagnostics.reachability import find_unreachable_rows
    from dhcal_pin.io.measurement_csv import MeasurementFile

    for seed in range(20):
        rng = np.random.default_rng(seed)
        q = rng.uniform(-np.pi, np.pi, (40, 6))
        data = Position.simulate(sim_6dof_actual, q, Noise(1e-4), rng)
        commanded = sim_6dof.poses(q)[:, :3, 3]
        readings = MeasurementFile("t", data, data, data.take(np.array([], int)), commanded, None)
        assert find_unreachable_rows(sim_6dof, readings) == []


def test_an_arm_right_at_its_reference_is_not_impossible_elsewhere(sim_6dof, sim_6dof_actual):
    """Thirty readings of the pose that the arm was set up by are exact to 10 µm, the others 40 mm off.

    And nothing is impossible about a controller that once stops 2 mm early.
    """
    from dhcal_pin.diagnostics.reachability import find_unreachable_rows
    from dhcal_pin.io.measurement_csv import MeasurementFile

    rng = np.random.default_rng(0)
    q = np.concatenate([np.tile(0.3, (30, 6)), rng.uniform(-2, 2, (20, 6))])
    measured = Position.simulate(sim_6dof_actual, q, Noise(1e-5), rng).positions()
    measured += (sim_6dof.poses(q[:1]) - sim_6dof_actual.poses(q[:1]))[0, :3, 3]
    commanded = sim_6dof.poses(q)[:, :3, 3]
    commanded[40] += [0.002, 0.0, 0.0]
    data = Position(q, measured)

    def found(told):
        return [
            f.row for f in find_unreachable_rows(sim_6dof, MeasurementFile("t", data, data, data, told, None))
        ]

    assert np.linalg.norm(measured - sim_6dof.poses(q)[:, :3, 3], axis=1).max() > 0.02
    assert found(None) == found(commanded) == []
    commanded[40] += [0.0, 0.02, 0.0]
    assert found(commanded) == [41]


def test_only_angle_offsets_fit_worse(experiment):
    """Δθ alone: 13.124 mm."""
    fit = calibrate(experiment.chain, experiment.data, "dh", priors="none",
                    fix=[f"{key}{i}" for key in ("d", "a", "alpha") for i in (1, 2, 3)])  # fmt: skip
    assert 1e3 * accuracy(fit.chain, [experiment.data])["position_rms_m"] == pytest.approx(13.124, abs=5e-4)
