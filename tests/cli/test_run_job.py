"""Command calibrate with one robot: JSON, files, hold-out data and warnings."""

import csv
import hashlib
import json
import os
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import (
    ACCURACY,
    CALIBRATE,
    KEYS,
    folder_contents,
    json_of,
    parse_json,
    positions_csv,
    stderr_of,
    stdout_of,
    tool_positions,
    unfolded,
    with_column,
)
from robots import URDF
from scipy.spatial.transform import Rotation

from dhcal_pin.calibration.summary import format_share
from dhcal_pin.estimation import select_parameters
from dhcal_pin.io import measurement_text, read_dh
from dhcal_pin.measurements import Noise, Pose, Position
from dhcal_pin.robot import Chain, read_urdf
from dhcal_pin.se3 import exp3, transform


def test_json_of_a_calibration(run, robot_folder):
    out = stdout_of(
        run(*CALIBRATE, "--holdout", "0.25", "--json", "-", "--parameters", "dh", "--fix", "theta1,d2")
    )
    document = parse_json(out)
    assert document.keys() >= KEYS
    assert document["converged"] is True
    assert (document["samples"], document["samples_holdout"]) == (15, 5)
    assert document["parameters_total"] == 10
    assert document["rank"] <= 10
    assert document["outliers"] == []
    for key in ("before", "after", "holdout_before", "holdout_after"):
        assert document[key].keys() == {"position_rms_m", "position_max_m"}
    for row in document["parameters"]:
        assert row.keys() == {
            "name",
            "unit",
            "nominal",
            "value",
            "std",
            "frame",
            "direction",
            "observability",
            "posterior_to_prior_std",
            "fixed",
        }
        assert 0 <= row["observability"] <= 1
    nominal = {row["name"]: (row["nominal"], row["unit"]) for row in document["parameters"]}
    assert nominal == {
        **{f"theta{i}": (0.0, "rad") for i in (1, 2, 3)},
        **{f"d{i}": (d, "m") for i, d in ((1, 0.433), (2, 0.0), (3, 0.0))},
        **{f"a{i}": (a, "m") for i, a in ((1, 0.0), (2, 0.4), (3, 0.345))},
        **{f"alpha{i}": (alpha, "rad") for i, alpha in ((1, np.pi / 2), (2, 0.0), (3, 0.0))},
    }
    fixed = {row["name"]: (row["value"], row["std"]) for row in document["parameters"] if row["fixed"]}
    assert fixed == {"theta1": (0.0, 0.0), "d2": (0.0, 0.0)}
    assert any("alpha3" in text for text in document["unobservable"])
    assert document["files"] == {"urdf": "out.urdf", "sidecar": "out.calibration.toml"}
    assert document["inputs"] == {
        name: hashlib.sha256(Path(name).read_bytes()).hexdigest() for name in ("arm.dh.toml", "data.csv")
    }
    assert document["versions"].keys() >= {"dhcal-pin", "pin", "numpy"}
    assert set(os.listdir(robot_folder)) == {*document["inputs"], *document["files"].values(), "arm.urdf"}


def test_nominal_error_equals_closed_form(run, robot_folder):
    document = json_of(run(*CALIBRATE, "--json", "-"))
    rows = np.loadtxt("data.csv", delimiter=",", skiprows=1)
    off = np.linalg.norm(tool_positions(rows[:, :3]) - rows[:, 3:], axis=1) / 1e3
    assert document["before"]["position_rms_m"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-9)
    assert document["before"]["position_max_m"] == pytest.approx(off.max(), rel=1e-9)
    assert document["after"]["position_rms_m"] < document["before"]["position_rms_m"]


def test_json_file_equals_json_on_stdout(run, robot_folder):
    on_stdout = json_of(run(*CALIBRATE, "--json", "-"))
    assert stdout_of(run(*CALIBRATE, "--json", robot_folder / "r.json")) == ""
    in_file = parse_json(Path("r.json").read_text())
    assert in_file.pop("files") == on_stdout.pop("files") | {"json": str(robot_folder / "r.json")}
    assert in_file == on_stdout


def test_single_measurement_gives_finite_json(run, robot_folder):
    Path("data.csv").write_text(positions_csv(1))
    for method in ("lm", "gn"):
        status, out, _ = run(*CALIBRATE, "--json", "-", "--method", method)
        document = parse_json(out)
        assert status == 3
        assert document["verdict"]["reasons"][0].startswith("No joint ever moved")
        assert document["samples"] == 1
        assert document["rank"] == 3


def test_nominal_robot_is_not_changed(run, robot_folder):
    before = folder_contents(robot_folder)
    stdout_of(run("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf"))
    after = folder_contents(robot_folder)
    assert {name: after[name] for name in before} == before
    assert set(after) - set(before) == {"out.urdf", "out.calibration.toml"}


def test_in_place_replaces_the_robot(run, robot_folder):
    before = Path("arm.urdf").read_bytes()
    stdout_of(run("calibrate", "arm.urdf", "data.csv", "-o", "arm.urdf", "--in-place"))
    assert Path("arm.urdf").read_bytes() != before
    assert Path("arm.calibration.toml").exists()
    stdout_of(run("calibrate", "arm.urdf", "data.csv", "-o", "arm.urdf", "--in-place"))


def test_existing_output_is_replaced_atomically(run, robot_folder):
    Path("out.urdf").write_text("old")
    with open("out.urdf") as reader:
        stdout_of(run(*CALIBRATE))
        assert reader.read() == "old"
    assert read_urdf("out.urdf").name == "arm"


def test_only_joint_origins_change(run, robot_folder):
    stdout_of(run("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf"))
    trees = [ET.parse(name).getroot() for name in ("arm.urdf", "out.urdf")]
    assert ET.tostring(trees[0]) != ET.tostring(trees[1])
    for tree in trees:
        for origin in tree.findall("joint/origin"):
            origin.attrib.clear()
    assert ET.tostring(trees[0]) == ET.tostring(trees[1])


def test_sidecar_of_an_earlier_run_is_replaced(run, robot_folder):
    """Base and tool of a DH file go into the URDF; an old sidecar would be applied in addition."""
    Path("out.calibration.toml").write_text("[base]\nxyz_m = [1.0, 0.0, 0.0]\n")
    document = json_of(run(*CALIBRATE, "--json", "-"))
    again = json_of(run("validate", "out.urdf", "data.csv", "--json", "-"))
    assert again["after"]["position_rms_m"] == pytest.approx(document["after"]["position_rms_m"], rel=1e-9)
    assert document["files"] == {"urdf": "out.urdf", "sidecar": "out.calibration.toml"}


def test_the_sidecar_of_another_robot_is_not_replaced(run, assert_refused, robot_folder):
    """Robots that differ in their ending only, such as out.urdf and out.xml, have one sidecar."""
    stdout_of(run("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf"))
    Path("out.urdf").rename("out.xml")
    text = "out.calibration.toml: is the sidecar of out.xml; choose another name for the output"
    assert_refused([text], "calibrate", "arm.urdf", "data.csv", "-o", "out.urdf")
    # The sidecar of the robot that is replaced is replaced, too.
    Path("out.xml").rename("out.urdf")
    stdout_of(run("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf"))


def test_holdout_fraction_depends_on_the_seed(run, robot_folder):
    def calibrate(seed, fraction="0.3"):
        return json_of(run(*CALIBRATE, "--holdout", fraction, "--seed", seed, "--json", "-"))

    first = calibrate(1)
    assert (first["samples"], first["samples_holdout"]) == (14, 6)
    assert calibrate(1) == first
    assert calibrate(2)["holdout_before"] != first["holdout_before"]
    none = calibrate(1, "0")
    assert (none["samples"], none["samples_holdout"], none["holdout_after"]) == (20, 0, {})


def test_accuracy_within_and_beyond_the_measured_region(run, robot_folder):
    Path("data.csv").write_text(positions_csv(60))
    status, out, err = run(*CALIBRATE, "--json", "-")
    assert status == 0
    document = parse_json(out)
    figures = {}
    for name in ("cross_validated", "holdout_region"):
        assert document[f"{name}_reason"] == ""
        for stage in ("before", "after"):
            figures[name, stage] = document[f"{name}_{stage}"]["position_rms_m"]
            assert document[f"{name}_{stage}"].keys() <= {"position_rms_m", "position_max_m"}
    # The calibrated robot leaves the noise of 1 mm along each axis and a little more.
    for (_, stage), value in figures.items():
        assert bool(np.sqrt(3) * 0.9e-3 < value < np.sqrt(3) * 1.3e-3) is (stage == "after")
    assert 0 <= document["covered_share"] <= document["reached_share"] <= 1
    rows = [line.split() for line in err.splitlines() if line.startswith("position ")]
    # Numbers with their unit in the last two columns: before and after.
    shown = [float(row[i]) for row in rows for i in (-4, -2)]
    expected = [1e3 * value for value in figures.values()]
    assert shown == pytest.approx(expected, rel=0.05)
    assert "position inside   60 cross-validated" in err
    assert f"Inside: measured region, {format_share(document['covered_share'])} of joint space." in err


def test_regions_are_left_out_of_complete_calibrations(run, robot_folder):
    Path("data.csv").write_text(positions_csv(60))
    plain = json_of(run(*CALIBRATE, "--json", "-"))
    status, out, err = run(*CALIBRATE, "--holdout", "region", "--report", "report.md", "--json", "-")
    assert status == 0
    document = parse_json(out)
    # All rows are fitted.
    assert document["parameters"] == plain["parameters"]
    assert (document["samples"], document["samples_holdout"], document["holdout_after"]) == (60, 0, {})
    for stage in ("holdout_region_before", "holdout_region_after"):
        assert document[stage]["position_rms_m"] == pytest.approx(plain[stage]["position_rms_m"], rel=0.05)
    assert document["holdout_region_after"] != plain["holdout_region_after"]
    assert document["comparisons"][0]["title"] == "region hold-out"
    assert "position outside left-out regions" in " ".join(err.split())
    assert "regions of joint space in turn" in Path("report.md").read_text()


def test_figures_that_cannot_be_stated_are_null(run, robot_folder):
    Path("data.csv").write_text(positions_csv(4))
    status, out, err = run(*CALIBRATE, "--json", "-")
    assert status == 0
    document = parse_json(out)
    for name in ("cross_validated", "holdout_region"):
        assert (document[f"{name}_before"], document[f"{name}_after"]) == (None, None)
        assert "too few samples" in document[f"{name}_reason"]
    assert err.count("cannot be said, too few samples") == 2


def test_robot_without_errors_is_kept(run, robot_folder, unsuspected_once):
    """The calibration of an exact robot fits noise only, so nothing of it is applied."""
    for truth, is_kept in ((), True), (("--truth", URDF / "sim_6dof_actual.dh.toml"), False):
        arm = URDF / "sim_6dof.dh.toml"
        stdout_of(run("simulate", arm, *truth, "-m", "30", "--noise", "0.1mm,0.01deg", "-o", "exact.csv"))
        _, out, err = run("calibrate", arm, "exact.csv", "-o", "calibrated.urdf", "--json", "-")
        document = parse_json(out)
        reasons = document["verdict"]["reasons"]
        assert document["verdict"]["status"] == ("caution" if is_kept else "ok")
        assert ("; the nominal robot is kept" in unfolded(err)) is is_kept
        assert any("not significantly better than the nominal one" in text for text in reasons) is is_kept
        assert (document["after"] == document["before"]) is is_kept


def test_holdout_file(run, robot_folder):
    Path("held.csv").write_text(positions_csv(7, 1))
    document = json_of(run(*CALIBRATE, "--holdout", "held.csv", "--json", "-"))
    assert (document["samples"], document["samples_holdout"]) == (20, 7)
    assert set(document["inputs"]) == {"arm.dh.toml", "data.csv", "held.csv"}
    alone = json_of(run("validate", "arm.urdf", "held.csv", "--json", "-"))
    assert document["holdout_before"]["position_rms_m"] == pytest.approx(
        alone["after"]["position_rms_m"], rel=1e-9
    )
    assert document["holdout_before"] != document["before"]


def test_set_column_selects_the_holdout(run, robot_folder):
    words = ["holdout" if row % 4 == 0 else "fit" for row in range(20)]
    Path("data.csv").write_text(with_column("set", words))
    document = json_of(run(*CALIBRATE, "--json", "-"))
    assert (document["samples"], document["samples_holdout"]) == (15, 5)
    both = json_of(run(*CALIBRATE, "--json", "-", "--holdout", "0.2"))
    assert (both["samples"], both["samples_holdout"]) == (12, 8)
    assert json_of(run("validate", "arm.urdf", "data.csv", "--json", "-"))["samples"] == 20


def test_one_of_two_files_can_be_held_out(run, robot_folder):
    Path("held.csv").write_text(with_column("set", ["holdout"] * 6))
    document = json_of(run(*CALIBRATE[:3], "held.csv", *CALIBRATE[3:], "--json", "-"))
    assert (document["samples"], document["samples_holdout"]) == (20, 6)


def test_unreachable_rows_are_excluded_by_file(run, robot_folder):
    Path("one.csv").write_text(positions_csv(12, 1, wrong=[3]))
    Path("two.csv").write_text(positions_csv(10, 2, wrong=[5, 9]))
    Path("three.csv").write_text(positions_csv(8, 3))
    status, out, err = run(
        *("calibrate", "arm.dh.toml", "one.csv", "two.csv", "three.csv", "-o", "out.urdf", "--json", "-"),
        "--verbose",
    )
    document = parse_json(out)
    assert status == 0
    assert document["samples"] == (12 - 1) + (10 - 2) + 8
    assert document["outliers"] == [4, 6, 10]
    assert document["outliers_by_file"] == {"one.csv": [4], "two.csv": [6, 10]}
    assert document["before"]["position_max_m"] < 0.01
    for text in ("one.csv: line 4", "two.csv: line 6", "two.csv: line 10"):
        assert f"{text} is excluded" in unfolded(err)


def test_residuals_are_written_with_files_and_lines(run, robot_folder):
    """Comments and blank lines count as in a text editor; outliers are the same lines in JSON and console."""
    head, *rows = positions_csv(30, 1, error=0.1).splitlines()
    cells = rows[20].split(",")
    rows[20] = ",".join([*cells[:3], str(float(cells[3]) + 40), *cells[4:]])
    Path("one.csv").write_text("\n".join(["# laser", head, "", *rows[:10], "# pause", *rows[10:]]))
    Path("two.csv").write_text(positions_csv(8, 2, error=0.1))
    args = (
        "calibrate",
        "arm.dh.toml",
        "one.csv",
        "--holdout",
        "two.csv",
        "-o",
        "out.urdf",
        "--loss",
        "tukey",
    )
    status, out, err = run(*args, "--parameters", "dh,base", "--residuals", "r.csv", "--json", "-")
    document = parse_json(out)
    assert status == 0, err
    assert document["files"]["residuals"] == "r.csv"
    with open("r.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [(row["file"], int(row["line"]), row["set"]) for row in table] == [
        *(("one.csv", line, "fit") for line in [*range(4, 14), *range(15, 35)]),
        *(("two.csv", line, "holdout") for line in range(2, 10)),
    ]
    outliers = [int(row["line"]) for row in table if row["outlier"] == "1"]
    assert outliers == document["outliers"] == document["outliers_by_file"]["one.csv"] == [25]
    assert "one.csv: 1 outlier (line 25)" in err
    assert [row["line"] for row in table if row["weight"] == "0.0"] == ["25"]
    assert {row["weight"] for row in table if row["set"] == "holdout"} == {""}


def test_residuals_of_a_refused_calibration_are_written(run, robot_folder):
    rows = positions_csv(40, error=0.1).splitlines()
    Path("data.csv").write_text("\n".join([rows[0], *(mirrored(row) for row in rows[1:])]))
    status, _, err = run(*CALIBRATE, "--residuals", "r.csv")
    assert (status, Path("out.urdf").exists()) == (3, False), err
    assert len(Path("r.csv").read_text().splitlines()) == 41


@pytest.mark.parametrize(
    ("option", "path", "expected"),
    [
        ("--curves", "c.txt", "c.txt: unknown ending; write a table of corrections as .csv"),
        ("--residuals", "r.xlsx", "r.xlsx: unknown ending; write a table of residuals as .csv"),
        ("--scene", "scene.png", "scene.png: unknown ending; write a scene as .html"),
    ],
)
def test_endings_of_outputs_are_checked_before_any_work(run, robot_folder, option, path, expected):
    before = folder_contents(robot_folder)
    status, out, err = run(*CALIBRATE, option, path)
    assert (status, out, err) == (2, "", f"dhcal: {expected}\n")
    assert folder_contents(robot_folder) == before


def mirrored(row):
    """A row of a measurement file with y in the opposite direction."""
    *joints, x, y, z = row.split(",")
    return ",".join([*joints, x, str(-float(y)), z])


def test_unreachable_rows_of_a_holdout_file_are_listed(run, robot_folder):
    Path("held.csv").write_text(positions_csv(9, 1, wrong=[4]))
    document = json_of(run(*CALIBRATE, "--holdout", "held.csv", "--json", "-"))
    assert (document["samples"], document["samples_holdout"], document["outliers"]) == (20, 8, [5])


def test_poses_and_positions_are_fitted_together(run, robot_folder, unsuspected_once):
    sim = URDF / "sim_6dof.dh.toml"
    for kind, seed in (("pose", 1), ("position", 2)):
        args = ("--truth", URDF / "sim_6dof_actual.dh.toml", "-m", "15", "--kind", kind, "--seed", seed)
        stdout_of(run("simulate", sim, *args, "-o", f"{kind}.csv"))
    args = ("calibrate", sim, "pose.csv", "position.csv", "-o", "out.urdf", "--priors", "none", "--json", "-")
    document = json_of(run(*args, "--extend", "none"))
    assert document["samples"] == 30
    assert document["after"].keys() == ACCURACY
    assert document["after"]["position_rms_m"] < 1e-9
    assert document["after"]["orientation_rms_rad"] < 1e-9


@pytest.mark.usefixtures("unsuspected_once", "inside_only")
def test_exact_data_give_the_true_parameters(run, robot_folder):
    sim, actual = URDF / "sim_6dof.dh.toml", URDF / "sim_6dof_actual.dh.toml"
    stdout_of(run("simulate", sim, "--truth", actual, "-m", "20", "-o", "fit.csv"))
    stdout_of(run("simulate", sim, "--truth", actual, "-m", "30", "--seed", "7", "-o", "other.csv"))
    document = parse_json(
        stdout_of(run("calibrate", sim, "fit.csv", "-o", "o.urdf", "--priors", "none", "--json", "-"))
    )
    assert document["after"]["position_rms_m"] < 1e-9
    assert document["before"]["position_rms_m"] > 1e-2
    other = json_of(run("validate", "o.urdf", "other.csv", "--json", "-"))
    assert other["after"]["position_rms_m"] < 1e-9
    assert other["after"]["orientation_rms_rad"] < 1e-9
    truth = read_dh(actual)
    values = {row["name"]: row["value"] for row in document["parameters"]}
    for key in ("theta", "d", "a", "alpha"):
        np.testing.assert_allclose([values[f"{key}{i}"] for i in range(1, 7)], getattr(truth, key), atol=1e-8)


def test_restricted_parameters_are_reported(run, tmp_path, monkeypatch):
    """With a small tilt between the parallel axes 2 and 3, modified DH needs offsets of metres."""
    monkeypatch.chdir(tmp_path)
    rows = [
        (0, 675, 0, 180),
        (0, 0, 350, 90),
        (-90, 0, 1150, 0),
        (0, -1000, -41, 90),
        (0, 0, 0, -90),
        (0, -240, 0, 90),
    ]
    keys = ("theta", "d", "a", "alpha")
    joints = [
        f'[[joint]]\nname = "A{i}"\ntype = "revolute"\n'
        + "".join(f"{k} = {v}.0\n" for k, v in zip(keys, row, strict=True))
        for i, row in enumerate(rows, 1)
    ]
    Path("arm.dh.toml").write_text(
        'convention = "modified"\n[units]\nlength = "mm"\nangle = "deg"\n' + "".join(joints)
    )
    rng = np.random.default_rng(0)
    arm = Chain.from_dh(read_dh("arm.dh.toml"))
    q = rng.uniform(-2, 2, (40, 6))
    pose = np.tile(np.eye(4), (40, 1, 1))
    for i, (theta, d, a, alpha) in enumerate(rows):
        tilt = Rotation.from_rotvec([0, 2e-3, 0] if i == 2 else [0, 0, 0]).as_matrix()
        fixed = Rotation.from_euler("x", alpha, degrees=True).as_matrix()
        spun = Rotation.from_rotvec((q[:, i, None] + np.deg2rad(theta)) * [0, 0, 1]).as_matrix()
        step = np.tile(np.eye(4), (40, 1, 1))
        step[:, :3, :3] = fixed @ tilt @ spun
        step[:, :3, 3] = [a * 1e-3, 0, 0] + step[:, :3, 2] * d * 1e-3
        pose = pose @ step
    point = pose[:, :3, 3] + 0.1 * pose[:, :3, 0] + [3, 1, 0] + rng.normal(0, 1e-4, (40, 3))
    Path("data.csv").write_text(measurement_text(Position(q, point), arm))
    for sets, is_reported in (
        ("modified-dh,base,tool", True),
        ("minimal,base,tool", False),
        ("base,tool", False),
    ):
        err = stderr_of(run("calibrate", "arm.dh.toml", "data.csv", "--parameters", sets, "-o", "out.urdf"))
        assert ("arm.dh.toml: warning: --parameters minimal,base,tool reduces" in err) is is_reported
    # Priors of parameters that are not in the full set are ignored.
    Path("priors.toml").write_text('"theta*" = 0.01\n"base.*" = 2.0\n')
    sets = ("--parameters", "modified-dh,base,tool", "--priors", "priors.toml")
    err = stderr_of(run("calibrate", "arm.dh.toml", "data.csv", *sets, "-o", "out.urdf"))
    assert "arm.dh.toml: warning: --parameters minimal,base,tool reduces" in err


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_default_parameters_of_a_dh_file(run, tmp_path, monkeypatch, inside_only, convention):
    """They are those of its convention. An error of the base is a reason for caution; the remedy helps."""
    monkeypatch.chdir(tmp_path)
    rows = [
        (0, 433, 0, 0),
        (0, 150, 0, -90),
        (0, 0, 432, 0),
        (0, 432, 20, -90),
        (0, 0, 0, 90),
        (0, 56, 0, -90),
    ]
    if convention == "standard":
        rows = [(*row[:2], *after[2:]) for row, after in zip(rows, [*rows[1:], (0, 0, 0, 0)], strict=True)]
    text = f'convention = "{convention}"\n[units]\nlength = "mm"\nangle = "deg"\n'
    for i, row in enumerate(rows, 1):
        entries = "".join(
            f"{key} = {v}.0\n" for key, v in zip(("theta", "d", "a", "alpha"), row, strict=True)
        )
        text += f'[[joint]]\nname = "j{i}"\ntype = "revolute"\n{entries}'
    Path("arm.dh.toml").write_text(text)
    arm, rng = Chain.from_dh(read_dh("arm.dh.toml")), np.random.default_rng(3)
    errors = select_parameters(arm, "dh" if convention == "standard" else "modified-dh")
    truth = errors.at(rng.normal(size=len(errors.parameters)) * 2e-3)
    base = transform(exp3([1e-3, 2e-3, -3e-3]), [5e-3, -3e-3, 4e-3])
    for moved, verdict, largest in ((np.eye(4), "ok", 2e-4), (base, "caution", 0.02)):
        q = rng.uniform(-2.5, 2.5, (100, 6))
        data = Pose.simulate(replace(truth, base=moved), q, Noise(5e-5, 1e-4), rng)
        Path("data.csv").write_text(measurement_text(data, arm))
        command = ("calibrate", "arm.dh.toml", "data.csv", "-o", "out.urdf", "--json", "r.json", "--force")
        status, _, err = run(*command)
        found = json.loads(Path("r.json").read_text())
        assert (status, found["verdict"]["status"]) == (0, verdict), err
        assert found["cross_validated_after"]["position_rms_m"] < largest
    expected = "The default parameters cannot represent the errors: --parameters minimal,base,tool reduces"
    assert found["verdict"]["reasons"][0].startswith(expected)
    assert run(*command, "--parameters", "minimal,base,tool")[0] == 0
    found = json.loads(Path("r.json").read_text())
    assert found["verdict"]["status"] == "ok"
    assert found["cross_validated_after"]["position_rms_m"] < 2e-4


def test_the_screen_says_whether_outliers_in_the_fit_do_harm(run, robot_folder):
    head, *rows = positions_csv(200, 1, error=0.1).splitlines()
    cells = rows[20].split(",")
    rows[20] = ",".join([*cells[:3], str(float(cells[3]) + 40), *cells[4:]])
    Path("data.csv").write_text("\n".join([head, *rows]))
    err = run(*CALIBRATE, "--loss", "linear", "--verbose")[2]
    text = "1 outlier (line 22) kept in the fit; --loss auto excludes those far from the others"
    assert text in " ".join(err.split())


def test_a_camera_frame_without_images_is_refused(assert_refused):
    words = ["--camera-frame: the measurements have no camera", "--tool-frame NAME"]
    assert_refused(words, *CALIBRATE, "--camera-frame", "eye")


def test_camera_files_without_images_are_refused(assert_refused):
    words = ["--camera-files: the measurements have no camera", "expected image coordinates and --rig"]
    assert_refused(words, *CALIBRATE, "--camera-files", "cam")


def test_the_screen_names_the_error_of_images(run, robot_folder):
    assert (
        run("simulate", "arm.dh.toml", "-m", "30", "--kind", "camera", "--noise", "0.2px", "-o", "a.csv")[0]
        == 0
    )
    err = run(
        "calibrate", "arm.dh.toml", "a.csv", "--rig", "a.rig.toml", "-o", "out.urdf", "--extend", "none"
    )[2]
    assert "image error inside" in " ".join(err.split())
    assert "pixels in the" not in err


def test_images_that_the_hold_out_takes_are_counted(run, assert_refused):
    """Four images of a camera and a board without known poses; three are needed."""
    assert run("simulate", "arm.dh.toml", "-m", "8", "--kind", "camera", "-o", "a.csv")[0] == 0
    rows = Path("a.csv").read_text().splitlines()
    Path("a.csv").write_text("\n".join(row for row in rows if ",right," not in row))
    rig = Path("a.rig.toml").read_text()
    left, board = rig.split("[camera.right]")[0], rig[rig.index("[board.target]") : rig.rindex("xyz_m")]
    Path("a.rig.toml").write_text(left + board)
    command = ("calibrate", "arm.dh.toml", "a.csv", "--rig", "a.rig.toml", "-o", "out.urdf")
    words = ["2 usable images; expected at least 3", "the hold-out has 2 of 4 images"]
    assert_refused(words, *command, "--holdout", "0.5")
    assert "usable images" not in run(*command)[2]
