"""Two real robots, each calibrated with one command and without an edited file.

The measurements are stored beside the project; see their own licences.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from robots import DATA, MAPS, missing, robot_file

from dhcal_pin.calibration import blocked_folds, calibrate, cross_validate, k_fold
from dhcal_pin.cli import main
from dhcal_pin.io import read_measurement_file, read_measurements, read_robot
from dhcal_pin.measurements import Noise
from dhcal_pin.planning import plan
from dhcal_pin.robot import Chain

SERIES = {
    "B": DATA / "ipa_ur10/Series_B/measurements_joint_configurations.csv",
    "D": DATA / "ipa_ur10/Series_D/measurements_iso_cubes.csv",
}
FOLDS = (lambda data: k_fold(data, 5), blocked_folds)
PANDA = DATA / "mukca_panda/panda_with_ball.urdf"
PANDA_2 = "back_left back_right front_center front_left front_right mid-high mid_left mid_right".split()
EXTEND = ("--extend", "auto")
PANDA_1 = "back-high front right".split()


@pytest.fixture(autouse=True)
def measurements():
    """Skip, or fail where nothing may be skipped, if the real measurements are missing."""
    if not DATA.exists():
        missing(f"measurements at {DATA}")


@pytest.fixture
def dhcal(tmp_path, capsys):
    def call(command, robot, *args):
        """Run a command that must succeed; return its JSON."""
        out = tmp_path / "result.json"
        status = main.main([command, *map(str, (robot, *args, "--json", out))])
        captured = capsys.readouterr()
        assert status == 0, captured.err
        assert ": warning: " not in captured.err, captured.err
        return json.loads(out.read_text())

    return call


def ur10(dhcal, series, sets, folder, *more):
    robot = robot_file("ur_description/urdf/ur10_robot.urdf")
    output = folder / f"{series}.urdf"
    options = ("--columns", MAPS / "ipa_ur10.toml", "--tip", "tool0", "--parameters", sets, "-o", output)
    return dhcal("calibrate", robot, SERIES[series], *options, *more), output


@pytest.mark.parametrize(("series", "frames", "best"), [("B", 1.083e-3, 0.450e-3), ("D", 0.774e-3, 0.412e-3)])
def test_tracker_series_of_a_ur10(dhcal, tmp_path, series, frames, best):
    placed, _ = ur10(dhcal, series, "base,tool", tmp_path, "--holdout", "0.5")
    # The reference is one split; another draws other rows.
    assert placed["holdout_after"]["position_rms_m"] == pytest.approx(frames, rel=0.05)
    for sets in ("minimal,base,tool", "placement,base,tool"):
        fit, _ = ur10(dhcal, series, sets, tmp_path, "--holdout", "0.5")
        assert fit["converged"]
        assert fit["rank"] == 30
        assert fit["holdout_after"]["position_rms_m"] <= best
        assert fit["holdout_after"]["orientation_rms_rad"] < 0.0012


@pytest.mark.parametrize(("series", "other", "most"), [("B", "D", 0.53e-3), ("D", "B", 0.50e-3)])
def test_links_of_one_series_are_accurate_on_another(dhcal, tmp_path, series, other, most):
    _, output = ur10(dhcal, series, "minimal,base,tool", tmp_path)
    columns = ("--columns", MAPS / "ipa_ur10.toml", "--tip", "tool0")
    moved = dhcal("validate", output, SERIES[other], *columns, "--fit-frames")
    assert moved["after"]["position_rms_m"] <= most


@pytest.mark.parametrize(
    ("series", "other", "held", "moved"), [("B", "D", 0.425e-3, 0.52e-3), ("D", "B", 0.36e-3, 0.49e-3)]
)
def test_extensions_are_accurate_on_hold_out_and_on_another_series(
    dhcal, tmp_path, series, other, held, moved
):
    fit, _ = ur10(dhcal, series, "minimal,base,tool", tmp_path, "--holdout", "0.5", "--extend", "auto")
    assert fit["holdout_after"]["position_rms_m"] <= held
    assert "compliance" in [trial["family"] for trial in fit["extension"] if trial["is_selected"]]
    _, output = ur10(dhcal, series, "minimal,base,tool", tmp_path, "--extend", "auto")
    columns = ("--columns", MAPS / "ipa_ur10.toml", "--tip", "tool0")
    validated = dhcal("validate", output, SERIES[other], *columns, "--fit-frames")
    assert validated["after"]["position_rms_m"] <= moved


def test_split_by_regions_shows_overfitting_that_a_random_split_hides():
    """Harmonics without priors are better between measured poses and worse outside the measured region."""
    chain = Chain.from_urdf(robot_file("ur_description/urdf/ur10_robot.urdf"), "tool0")
    data = read_measurement_file(SERIES["B"], chain, MAPS / "ipa_ur10.toml").data.take(np.s_[::4])
    free = {"*.sin*": 1e3, "*.cos*": 1e3}
    fits = [
        calibrate(chain, data, "minimal,base,tool"),
        calibrate(chain, data, "minimal,base,tool,harmonics", priors=free),
    ]
    plain, wild = ([cross_validate(fit, folds(fit.data)) for folds in FOLDS] for fit in fits)
    key = "position_rms_m"
    random, regions = (b.accuracy[key] / a.accuracy[key] for a, b in zip(plain, wild, strict=True))
    assert random < 0.95
    assert regions > 1.2


def known_distances(path, places):
    rows = [f"{place}/hole_0,{place}/hole_1,50" for place in places]
    path.write_text("\n".join(["point_a,point_b,distance[mm]", *rows]) + "\n")
    return path


def hold_out_errors(dhcal, folder, arm, places, left, *more):
    """Return point consistency and distance error [mm] at a hold-out place, calibrated and nominal."""
    holes = {
        place: [DATA / "mukca_panda" / arm / place / f"hole_{i}.csv" for i in (0, 1)] for place in places
    }
    kept = [place for place in places if place != left]
    common = ("--columns", MAPS / "mukca_panda.toml", "--tip", "ball_link")
    touched = [path for place in kept for path in holes[place]]
    output = folder / "panda.urdf"
    known = known_distances(folder / "known.csv", kept)
    options = ("--parameters", "placement,tool", "-o", output, *more)
    assert dhcal("calibrate", PANDA, *touched, known, *common, *options)["converged"]
    judge = (*holes[left], known_distances(folder / "left.csv", [left]), *common)
    found = [dhcal("validate", robot, *judge)["after"] for robot in (output, PANDA)]
    return [[1e3 * one[key] for key in ("position_rms_m", "residual_rms")] for one in found]


def test_contacts_of_a_panda_with_sockets_at_eight_places(dhcal, tmp_path):
    fitted, nominal = np.array(
        [hold_out_errors(dhcal, tmp_path, "panda_2_clean", PANDA_2, left) for left in PANDA_2]
    ).swapaxes(0, 1)
    assert 7 < np.sqrt(np.mean(nominal[:, 0] ** 2)) < 11
    consistency, distance = fitted.mean(0)
    assert consistency <= 0.34
    assert distance <= 0.2
    auto = [
        hold_out_errors(dhcal, tmp_path, "panda_2_clean", PANDA_2, left, *EXTEND)[0] for left in PANDA_2[::2]
    ]
    extended, plain = (np.sqrt(np.mean(np.square(found), 0)) for found in (auto, fitted[::2]))
    assert extended[0] < plain[0]
    assert extended[1] < 1.05 * plain[1]


@pytest.mark.parametrize("left", ["front_center", "mid_left"])
def test_known_distances_determine_the_scale_of_the_robot(dhcal, tmp_path, left):
    """A smaller robot would reduce hundreds of contact errors; seven known distances prevent it."""
    (consistency, distance), _ = hold_out_errors(
        dhcal, tmp_path, "panda_2_clean", PANDA_2, left, "--parameters", "minimal,base,tool"
    )
    assert consistency <= 0.34
    assert distance <= 0.34


@pytest.mark.parametrize(("left", "most"), [("back-high", 1.05), ("front", 0.74), ("right", 0.86)])
def test_contacts_of_a_panda_with_sockets_at_three_places(dhcal, tmp_path, left, most):
    """Two places do not predict a third one, so no extension is added."""
    (fitted, distance), (nominal, _) = hold_out_errors(dhcal, tmp_path, "panda_1", PANDA_1, left)
    assert nominal > 7
    assert fitted <= most
    extended = hold_out_errors(dhcal, tmp_path, "panda_1", PANDA_1, left, *EXTEND)[0]
    assert np.all(np.array(extended) <= [fitted + 1e-9, distance + 1e-9])


def planned_and_random(criterion: str, seeds: int, choices: int) -> np.ndarray:
    """Return ratios (seeds, 2) of hold-out errors: forty planned and forty random poses to half a series.

    The plan uses joint values alone. The ratio of a single choice of forty poses scatters by 0.025.
    """
    chain = read_robot(robot_file("ur_description/urdf/ur10_robot.urdf"), "tool0")
    data = read_measurements(SERIES["B"], chain, MAPS / "ipa_ur10.toml")
    sets, noise = "minimal,base,tool", Noise(1e-4, np.deg2rad(0.01))
    out = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        order = rng.permutation(len(data.rows))
        half = len(order) // 2
        first, second = data.take(np.sort(order[:half])), data.take(np.sort(order[half:]))

        def held_out(part, second=second) -> float:
            return calibrate(chain, part, sets).validate(second)["position_rms_m"]

        all_poses = held_out(first)
        planned = plan(chain, 40, noise=noise, parameters=sets, criterion=criterion, candidates=first.q)
        assert planned.index is not None
        drawn = [held_out(first.take(rng.choice(half, 40, replace=False))) for _ in range(choices)]
        out.append([held_out(first.take(planned.index)) / all_poses, np.median(drawn) / all_poses])
    return np.array(out)


@pytest.mark.parametrize("criterion", ["D", "robust"])
def test_planned_poses_of_a_series_are_as_good_as_all_of_it(criterion):
    assert planned_and_random(criterion, 2, 1)[:, 0].max() <= 1.10


@pytest.mark.slow
@pytest.mark.parametrize(("criterion", "most"), [("D", 1.10), ("robust", 1.06)])
def test_planned_poses_of_a_series_are_better_than_random_ones(criterion, most):
    """On the mean of several halves; on a single one chance decides which set of forty is better."""
    planned, random = planned_and_random(criterion, 12, 100).T
    assert planned.mean() <= most
    assert planned.mean() <= random.mean()
