"""Command validate."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import (
    CALIBRATE,
    HEADER,
    KEYS,
    error_of,
    json_of,
    parse_json,
    positions_csv,
    stderr_of,
    stdout_of,
    tool_positions,
    unfolded,
)
from robots import UR10, URDF


def test_sidecar_is_an_input(run, robot_folder):
    Path("arm.calibration.toml").write_text("[base]\nxyz_m = [0.5, 0.0, 0.0]\n")
    document = json_of(run("validate", "arm.urdf", "data.csv", "--json", "-"))
    assert set(document["inputs"]) == {"arm.urdf", "data.csv", "arm.calibration.toml"}
    assert document["after"]["position_rms_m"] == pytest.approx(0.5, abs=0.01)
    Path("other.toml").write_text("[base]\nxyz_m = [0.0, 0.0, 0.25]\n")
    args = ("validate", "arm.urdf", "data.csv", "--sidecar", "other.toml", "--json", "-")
    assert json_of(run(*args))["after"]["position_rms_m"] == pytest.approx(0.25, abs=0.01)


def test_json_of_a_validation(run, robot_folder):
    document = json_of(run("validate", "arm.urdf", "data.csv", "--json", "-"))
    assert document.keys() >= KEYS
    assert document["samples"] == 20
    assert document["before"] == document["after"]
    assert document["parameters"] == []
    rows = np.loadtxt("data.csv", delimiter=",", skiprows=1)
    off = np.linalg.norm(tool_positions(rows[:, :3]) - rows[:, 3:], axis=1) / 1e3
    assert document["after"]["position_rms_m"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-9)


def test_another_tip_than_that_of_the_calibration_is_named(run, robot_folder):
    """The tool of a UR10 is calibrated; with the link before the tip, the tool does not count."""
    Path("ur10.urdf").write_text(UR10.read_text())
    simulate = [
        "simulate",
        "ur10.urdf",
        "--tip",
        "tool0",
        "-m",
        "40",
        "--errors",
        "1mm,0.2deg",
        "--noise",
        "0.05mm",
    ]
    assert run(*simulate, "--kind", "position", "-o", "ur10.csv")[0] == 0
    assert run("calibrate", "ur10.urdf", "ur10.csv", "--tip", "tool0", "-o", "out.urdf")[0] == 0
    validate = ["validate", "out.urdf", "ur10.csv", "--json", "-", "--tip"]
    other, same = (parse_json(run(*validate, tip)[1]) for tip in ("wrist_2_link", "tool0"))
    (warning,) = [text for text in other["warnings"] if "the tool of" in text]
    assert warning.endswith("is that of the tip tool0: run again with --tip tool0")
    assert not any("the tool of" in text for text in same["warnings"])
    assert same["after"]["position_rms_m"] < 0.01 * other["after"]["position_rms_m"]


def test_fit_frames_finds_the_measuring_frame(run, robot_folder):
    rows = np.loadtxt("data.csv", delimiter=",", skiprows=1)
    # The tracker is rotated by 90° about z and translated by 2 m.
    moved = np.stack([-rows[:, 4] + 2000, rows[:, 3], rows[:, 5] - 300], -1)
    np.savetxt("far.csv", np.concatenate([rows[:, :3], moved], 1), "%.9f", ",", header=HEADER, comments="")
    near = json_of(run("validate", "arm.urdf", "data.csv", "--fit-frames", "--json", "-"))
    status, out, err = run("validate", "arm.urdf", "far.csv", "--fit-frames", "--json", "-")
    assert status == 0
    far = parse_json(out)
    assert far["before"]["position_rms_m"] > 1
    # The weak priors on base and tool change the results by less than this.
    assert far["after"]["position_rms_m"] == pytest.approx(near["after"]["position_rms_m"], rel=1e-4)
    assert "base and tool as given" in err


def test_unreachable_rows_are_reported_and_included(run, robot_folder, unsuspected_once):
    """Rows 7 and 8 of Table 5, as printed, raise the RMS error from 25.5 mm to 473 mm."""
    table = str(URDF / "experiment_table5.csv")
    status, out, err = run("validate", URDF / "experiment.dh.toml", table, "--json", "-")
    rows = np.loadtxt(table, delimiter=",", comments=("#", "j"))
    off = np.linalg.norm(tool_positions(rows[:, :3]) - rows[:, 3:6], axis=1) / 1e3
    document = parse_json(out)
    assert (status, document["samples"]) == (0, 8)
    assert document["after"]["position_rms_m"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-9)
    assert [text.split(": ")[1] for text in document["warnings"]][-2:] == ["line 11", "line 12"]
    assert "warning: line 11: its joint positions lead 1095 mm away" in unfolded(err)
    assert run("validate", URDF / "experiment.dh.toml", table, "--fit-frames")[2].count("warning: line") == 0


def calibrated_and_new_data(run, degrees, frame=None):
    """Calibrate the robot of the folder; write new measurements of it at joint values (m, 3) [deg]."""
    stdout_of(run(*CALIBRATE))
    rng = np.random.default_rng(7)
    positions = tool_positions(degrees) + rng.normal(size=(len(degrees), 3))
    positions = positions if frame is None else positions @ frame[0].T + frame[1]
    rows = np.concatenate([degrees, positions], 1)
    np.savetxt("new.csv", rows, "%.9f", ",", header=HEADER, comments="")


def test_nominal_and_calibrated_robot_side_by_side(run, robot_folder):
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    degrees = np.random.default_rng(3).uniform(-70, 70, (40, 3))
    calibrated_and_new_data(run, degrees, (rotation, np.array([2000.0, 0, -300])))
    args = ("validate", "out.urdf", "new.csv", "--nominal", "arm.dh.toml", "--json", "-")
    status, out, err = run(*args, "--fit-frames")
    document = parse_json(out)
    assert status == 0
    assert document.keys() >= KEYS
    assert set(document["inputs"]) == {"out.urdf", "new.csv", "arm.dh.toml", "out.calibration.toml"}
    # The simulated robot is the nominal one: its error is the noise of 1 mm along each axis.
    assert document["before"]["position_rms_m"] == pytest.approx(np.sqrt(3) * 1e-3, rel=0.2)
    assert document["after"]["position_rms_m"] == pytest.approx(np.sqrt(3) * 1e-3, rel=0.2)
    header = next(line for line in err.splitlines() if line.startswith("error"))
    assert header.split() == ["error", "nominal", "calibrated"]
    assert "base and tool fitted to these measurements" in err
    # Both robots have the same frames, which do not hold for these measurements, and the command says so.
    status, out, err = run(*args)
    document = parse_json(out)
    assert status == 0
    assert document["before"]["position_rms_m"] > 1
    assert document["after"]["position_rms_m"] > 1
    assert "the frames (base, tool) differ: run again with --fit-frames" in err
    assert any("--fit-frames" in text for text in document["warnings"])
    assert "exchange them" not in err
    err = stderr_of(run("validate", "arm.dh.toml", "new.csv", "--nominal", "out.urdf", "--fit-frames"))
    assert (
        "out.calibration.toml is that of a calibrated robot, and arm.dh.toml has none: exchange"
        in unfolded(err)
    )


def test_frames_of_the_nominal_robot_are_fitted_if_those_of_the_calibrated_one_were(run, robot_folder):
    degrees = np.random.default_rng(3).uniform(-70, 70, (40, 3))
    far = (np.eye(3), np.array([2000.0, 0, -300]))
    calibrated_and_new_data(run, degrees, far)
    options = ("--parameters", "dh,base", "-o", "far.urdf")
    stdout_of(run("calibrate", "arm.dh.toml", "new.csv", *options))
    args = ("validate", "far.urdf", "new.csv", "--nominal", "arm.dh.toml", "--json", "-")
    status, out, err = run(*args)
    document = parse_json(out)
    assert status == 0
    assert "nominal: base fitted to these measurements" in err
    for stage in ("before", "after"):
        assert document[stage]["position_rms_m"] == pytest.approx(np.sqrt(3) * 1e-3, rel=0.2)
    # A robot without errors gets no correction.
    assert document["after"]["position_rms_m"] == pytest.approx(document["before"]["position_rms_m"])


def test_equal_frames_are_not_reported(run, robot_folder):
    calibrated_and_new_data(run, np.random.default_rng(3).uniform(-70, 70, (40, 3)))
    document = json_of(run("validate", "out.urdf", "new.csv", "--json", "-"))
    assert document["warnings"] == []


def test_nominal_robot_with_other_joints_is_refused(run, robot_folder):
    calibrated_and_new_data(run, np.zeros((4, 3)))
    other = URDF / "sim_6dof.dh.toml"
    err = error_of(run("validate", "out.urdf", "new.csv", "--nominal", other))
    assert "expected the joints of out.urdf" in err


def test_samples_outside_the_measured_region(run, robot_folder):
    """Joint 2 was measured up to 80°; half of the new samples are about 80° beyond."""
    rng = np.random.default_rng(3)
    inside, outside = rng.uniform(-60, 60, (2, 30, 3))
    outside[:, 1] = rng.uniform(150, 170, 30)
    calibrated_and_new_data(run, np.concatenate([inside, outside]))
    status, out, err = run("validate", "out.urdf", "new.csv", "--json", "-")
    assert status == 0
    region = parse_json(out)["measured_region"]
    assert 30 <= region["samples_outside"] <= 36
    largest = np.max(outside[:, 1]) - np.max(np.loadtxt("data.csv", delimiter=",", skiprows=1)[:, 1])
    assert region["largest_excess"] == {"joint_2": pytest.approx(np.radians(largest), abs=1e-6)}
    assert region["outside"]["position_samples"] == region["samples_outside"]
    assert region["inside"]["position_samples"] == 60 - region["samples_outside"]
    assert f"{region['samples_outside']} of 60 samples" in err
    assert f"Beyond the measured range: joint_2 by {largest:.0f}°." in err


def test_a_robot_without_a_measured_region_has_none(run, robot_folder):
    document = json_of(run("validate", "arm.urdf", "data.csv", "--json", "-"))
    assert document["measured_region"] is None
    assert document["holdout_region_after"] is None
    assert document["cross_validated_after"] is None


def test_a_file_that_was_fitted_is_named(run, robot_folder):
    assert run("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf")[0] in (0, 3)
    assert run("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf", "--force")[0] == 0
    sidecar = Path("out.calibration.toml")
    sidecar.write_text(re.sub(r"(?s)fitted_rows = (\W{3}).*?\1\n", "", sidecar.read_text()))
    assert "fitted_rows" not in sidecar.read_text()
    Path("other.csv").write_text(Path("data.csv").read_text() + "\n")
    warned = "this file or a part of it was fitted by the calibration"
    assert [len(fitted_warnings(run, name, warned)) for name in ("data.csv", "other.csv")] == [1, 0]


def fitted_warnings(run, name, text):
    """Return the warnings of a validation with a text."""
    document = json_of(run("validate", "out.urdf", name, "--json", "-"))
    return [warning for warning in document["warnings"] if text in warning]


def test_rows_that_were_fitted_are_counted_in_any_file(run, robot_folder):
    """A comment, another order of rows and columns, other units and other digits make no difference."""
    header, *rows = Path("data.csv").read_text().splitlines()
    status = run("calibrate", "arm.urdf", "data.csv", "--holdout", "0.25", "-o", "out.urdf", "--force")[0]
    assert status == 0
    moved = [row.rpartition(",")[0] + ",0.5" for row in rows[:3]]
    numbers = np.loadtxt("data.csv", delimiter=",", skiprows=1)[:, ::-1]
    in_metres = [f"{z / 1e3:.9f},{y},{x},{c},{b},{a}" for z, y, x, c, b, a in numbers[::-1]]
    joints = header.split(",")[:3]
    texts = {
        "copy.csv": ["# renamed", header, *rows],
        "moved.csv": [header, *moved],
        "units.csv": [",".join(["z[m]", "y[mm]", "x[mm]", *joints[::-1]]), *in_metres],
    }
    for name, lines in texts.items():
        Path(name).write_text("\n".join(lines) + "\n")
    found = {name: fitted_warnings(run, name, "fitted") for name in ("data.csv", *texts)}
    assert {name: len(texts) for name, texts in found.items()} == dict.fromkeys(found, 1) | {"moved.csv": 0}
    for name in ("data.csv", "copy.csv", "units.csv"):
        assert f"{name}: 15 of 20 rows were fitted by the calibration of this robot" in found[name][0]
    # A part of the rows.
    counts = []
    for row in rows:
        Path("one.csv").write_text(f"{header}\n{row}\n")
        counts.append(len(fitted_warnings(run, "one.csv", "1 of 1 row was fitted")))
    assert sum(counts) == 15


def test_digests_that_are_not_base64_are_refused(run, robot_folder):
    assert run("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf", "--force")[0] == 0
    sidecar = Path("out.calibration.toml")
    sidecar.write_text(
        re.sub(r"(?s)fitted_rows = (\W{3}).*?\1\n", 'fitted_rows = "?"\n', sidecar.read_text())
    )
    err = error_of(run("validate", "out.urdf", "data.csv"))
    assert "[manifest] fitted_rows is not base64 text" in unfolded(err)


def test_all_columns_count_the_same_samples_and_outliers_are_named(run, robot_folder):
    """Six of 60 positions are 20 mm wrong: the fitted base and tool are nearly those of the others."""
    simulate = [
        "simulate",
        "example:ur5",
        "--tip",
        "tool0",
        "-n",
        "60",
        "--errors",
        "0.5mm,0.1deg",
        "--kind",
        "position",
    ]
    assert run(*simulate, "--sigma", "0.05mm", "--seed", "31", "-o", "clean.csv")[0] == 0
    assert run("calibrate", "example:ur5", "clean.csv", "--tip", "tool0", "-o", "arm.urdf")[0] == 0
    lines = Path("clean.csv").read_text().splitlines()
    wrong = range(10, 60, 9)
    for i in wrong:
        cells = lines[i].split(",")
        cells[6] = repr(float(cells[6]) + 0.02)
        lines[i] = ",".join(cells)
    Path("wrong.csv").write_text("\n".join(lines) + "\n")
    listed = ", ".join(str(i + 1) for i in wrong)
    validate = ["validate", "arm.urdf", "wrong.csv", "--tip", "tool0", "--json", "v.json"]
    for options in ([], ["--nominal", "example:ur5"], ["--fit-frames"]):
        err = stderr_of(run(*validate, *options))
        text = " ".join(err.split())
        assert f"Samples far from the others: 6 (lines in wrong.csv: {listed})" in text
        (rest,) = re.findall(r"RMS position error without them: ([\d.]+) mm", text)
        assert 0.06 < float(rest) < 0.1
        document = json.loads(Path("v.json").read_text())
        # √(6/60)·20 mm
        assert document["after"]["position_rms_m"] == pytest.approx(6.3e-3, rel=0.03)
        assert "frames (base, tool) differ" not in text


@pytest.mark.parametrize(("count", "is_said"), [(5, False), (8, True)])
def test_frames_of_few_samples_are_compared(run, robot_folder, count, is_said):
    """Five positions have fewer values than needed; eight of a tracker that moved by 2 m show it."""
    rows = np.loadtxt("data.csv", delimiter=",", skiprows=1)[:count]
    for shift in (0.0, 2000.0):
        moved = rows + np.repeat([0.0, shift], 3)
        np.savetxt("few.csv", moved, "%.9f", ",", header=HEADER, comments="")
        warnings = json_of(run("validate", "arm.urdf", "few.csv", "--json", "-"))["warnings"]
        assert any("--fit-frames" in text for text in warnings) == (is_said and shift > 0)


def test_tip_of_a_urdf_does_not_concern_a_nominal_dh_table(run, robot_folder):
    """The nominal robot may be a DH table, which has no option --tip."""
    Path("data.csv").write_text(positions_csv(20))
    words = ("validate", "arm.urdf", "data.csv", "--tip", "tool0", "--nominal", "arm.dh.toml")
    stdout_of(run(*words))
    assert run("diff", "arm.urdf", "arm.dh.toml", "--tip", "tool0")[0] == 0
