"""Command inspect: ranges, limits, coverage, bad rows and suspected mistakes without a fit."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_line import HEADER, json_of, positions_csv, stderr_of, tool_positions, unfolded
from robots import DATA, MAPS, missing

from dhcal_pin.io import measurement_text
from dhcal_pin.measurements import Noise, Pose, Position

ALONE = "a calibration with this file alone"


def inspect(run, *args):
    return json_of(run("inspect", *args, "--json", "-"))


@pytest.fixture
def pose_file(ur10, robot_folder):
    """Poses of a UR10 with sigmas, a set and a time, in metres and radians; returns joint values (m, n)."""
    q = np.random.default_rng(4).uniform(-2.5, 2.5, (60, 6))
    data = Pose.simulate(ur10, q, Noise(1e-4, 1e-4), np.random.default_rng(5))
    lines = measurement_text(data, ur10).splitlines()
    lines = [
        f"{line},{'set,time[s]' if i == 0 else ('holdout' if i % 4 == 0 else 'fit') + f',{i}'}"
        for i, line in enumerate(lines)
    ]
    Path("poses.csv").write_text("\n".join(["# laser", *lines]))
    return q


def test_a_robot_is_an_option(run, pose_file, ur10):
    """Other commands take it first."""
    robot = ur10.urdf.source
    status, out, err = run("inspect", robot, "poses.csv")
    assert (status, out, unfolded(err)) == (
        2,
        "",
        f"dhcal: {robot}: is a robot; state it with --robot {robot}",
    )


def test_a_robot_alone_lists_its_joints_and_tips(run, robot_folder):
    """It is what the message about a robot in place of data advises."""
    Path("arm.urdf").write_text(
        """<robot name="arm"><link name="base"/><link name="a"/><link name="tip"/><link name="jaw"/>
        <joint name="j1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
        <limit lower="-1.5707963267948966" upper="0.7853981633974483" effort="1" velocity="1"/></joint>
        <joint name="f" type="fixed"><parent link="a"/><child link="tip"/><origin xyz="0.1 0 0"/></joint>
        <joint name="grip" type="prismatic"><parent link="a"/><child link="jaw"/><axis xyz="1 0 0"/>
        <limit lower="0" upper="0.03" effort="1" velocity="1"/></joint></robot>"""
    )
    advice = unfolded(run("inspect", "arm.urdf")[2]).split("state it with ")[1]
    screen = unfolded(stderr_of(run("inspect", *advice.split())))
    for text in (
        "arm.urdf: tip jaw, 2 joints from j1 to grip",
        "j1 revolute deg -90 45",
        "grip prismatic mm 0 30",
        "tip, 1 joint jaw, 2 joints (chosen)",
    ):
        assert text in screen
    document = inspect(run, "--robot", "arm.urdf", "--tip", "tip")
    assert document["robot"] == {
        "path": "arm.urdf",
        "tip": "tip",
        "joints": ["j1"],
        "tips": ["tip", "jaw"],
    }
    assert document["files"] == []
    status, _, err = run("inspect")
    assert (status, err) == (2, "dhcal: DATA: expected measurement files, or a robot alone (--robot ROBOT)\n")


def test_a_normal_file_fits_one_screen(run, pose_file, ur10):
    args = ("inspect", "poses.csv", "--robot", ur10.urdf.source, "--tip", "tool0")
    status, out, err = run(*args)
    assert (status, out) == (0, "")
    lines = err.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert lines[0] == "ur10_robot.urdf: tip tool0, 6 joints"
    assert "poses.csv: pose, 60 rows (lines 3-62), 60 configurations, commas" in lines
    assert "set: fit (45 rows), holdout (15 rows)" in lines
    assert lines[-1] == "No problems found."


@pytest.mark.parametrize(
    ("count", "still", "expected"),
    [
        (60, 4, [f"joint wrist_2_joint never moved; {ALONE} holds only where it stands"]),
        (8, None, [f"too few poses for {ALONE}; measure at least 14 different ones"]),
        (14, None, []),
    ],
)
def test_what_a_calibration_lacks_is_noted(run, robot_folder, ur10, count, still, expected):
    rng = np.random.default_rng(2)
    q = rng.uniform(-2.5, 2.5, (count, 6))
    if still is not None:
        q[:, still] = 1.2
    data = Position.simulate(ur10, q, Noise(1e-4), rng)
    Path("positions.csv").write_text(measurement_text(data, ur10))
    args = ("positions.csv", "--robot", ur10.urdf.source, "--tip", "tool0")
    (file,) = inspect(run, *args)["files"]
    assert (file["notes"], file["warnings"]) == (expected, [])
    screen = stderr_of(run("inspect", *args))
    assert ("No problems found." in screen) == (not expected)
    # A calibration says the same.
    calibrated = ("calibrate", args[2], args[0], *args[3:], "-o", "out.urdf", "--json", "-", "--force")
    reasons = " ".join(json_of(run(*calibrated))["verdict"]["reasons"])
    assert ("wrist_2_joint never moved" in reasons) == (still is not None)
    assert ("Measure at least 14 different poses" in reasons) == (count == 8)


def test_columns_ranges_and_coverage(run, pose_file, ur10):
    document = inspect(run, "poses.csv", "--robot", ur10.urdf.source, "--tip", "tool0")
    (file,) = document["files"]
    assert document["robot"]["joints"] == list(ur10.joint_names)
    assert (file["kind"], file["rows"], file["configurations"]) == ("pose", 60, 60)
    assert (file["first_line"], file["last_line"]) == (3, 62)
    assert (file["warnings"], file["problem"], file["bad_rows"], file["repeated_lines"]) == ([], "", {}, [])
    columns = {column["name"]: column for column in file["columns"]}
    assert {name: column["role"] for name, column in columns.items() if name in ("x", "qw", "sigma_rx")} == {
        **{"x": "measured", "sigma_rx": "sigma"}
    }
    for j, name in enumerate(ur10.joint_names):
        column, values = columns[name], pose_file[:, j]
        assert (column["role"], column["unit"]) == ("joint", "rad")
        assert (column["minimum"], column["maximum"]) == (values.min(), values.max())
        assert (column["lower"], column["upper"]) == (ur10.lower[j], ur10.upper[j])
        # Bins of 5° within the limits: all 72 of a turn, or those within ±180° of the elbow.
        visited = len({round(value / 5) % 72 for value in np.rad2deg(values).tolist()})
        assert column["coverage"] == pytest.approx(visited / 72)
    assert columns["set"]["counts"] == {"fit": 45, "holdout": 15}
    assert columns["time"]["role"] == "other"


@pytest.mark.parametrize("options", [(), ("--robot", "arm.dh.toml")])
def test_conditions_are_used(run, robot_folder, options):
    names = ["temperature[degC]", "payload[kg]", "approach_joint_2", "remark"]
    lines = [f"{line},20.5,1.5,1,ok" for line in positions_csv(12).splitlines()[1:]]
    Path("data.csv").write_text("\n".join([",".join([HEADER, *names]), *lines]))
    (file,) = inspect(run, "data.csv", *options)["files"]
    roles = [column["role"] for column in file["columns"][6:]]
    assert roles == ["condition", "condition", "condition", "ignored"]
    err = run("inspect", "data.csv", *options)[2]
    assert "conditions: temperature, payload, approach_joint_2" in err
    assert "not used: remark\n" in err


@pytest.mark.parametrize("options", [(), ("--robot", "arm.dh.toml")])
def test_the_table_below_titles_is_shown(run, robot_folder, options):
    Path("data.csv").write_text(f"Report;7\n\n{positions_csv(12).replace('[mm]', '').replace('joint_', 'A')}")
    (file,) = inspect(run, "data.csv", *options)["files"]
    assert [column["name"] for column in file["columns"]] == ["A1", "A2", "A3", "x", "y", "z"]
    assert (file["rows"], file["bad_rows"], file["first_line"]) == (12, {}, 4)
    assert "line 3; in a column map, skip = 2 skips the lines above it" in file["notes"][0]


def test_names_in_capitals_are_known_without_a_robot(run, robot_folder):
    Path("data.csv").write_text(positions_csv(12).replace("x[mm],y[mm],z[mm]", "X[mm],Y[mm],Z[mm]"))
    assert inspect(run, "data.csv")["files"][0]["kind"] == "position"


def test_ranges_are_in_the_units_of_the_file(run, robot_folder):
    Path("data.csv").write_text(positions_csv(30))
    (file,) = inspect(run, "data.csv", "--robot", "arm.dh.toml")["files"]
    values = np.loadtxt("data.csv", delimiter=",", skiprows=1)
    for i, column in enumerate(file["columns"]):
        assert (column["minimum"], column["maximum"]) == (values[:, i].min(), values[:, i].max())


def test_without_a_robot(run, robot_folder):
    """Joints are the columns with the unit of an angle or a length that are no measured values."""
    text = positions_csv(12).splitlines()
    Path("data.csv").write_text(
        "\n".join([f"{text[0]},remark", *(f"{row},ok" for row in text[1:]), text[3] + ",ok"])
    )
    (file,) = inspect(run, "data.csv")["files"]
    roles = {column["name"]: column["role"] for column in file["columns"]}
    assert roles == {
        **dict.fromkeys(("joint_1", "joint_2", "joint_3"), "joint"),
        **dict.fromkeys("xyz", "measured"),
        "remark": "ignored",
    }
    assert (file["kind"], file["configurations"], file["repeated_lines"]) == ("position", None, [14])
    degrees = np.array([float(row.split(",")[0]) for row in text[1:]])
    bins = np.unique(np.round(degrees / 5))
    assert file["columns"][0]["coverage"] == pytest.approx(len(bins) / (bins[-1] - bins[0] + 1))
    assert "lines equal to earlier ones: 14" in run("inspect", "data.csv")[2]


def test_rows_that_cannot_be_used_are_listed_with_their_lines(run, robot_folder):
    lines = positions_csv(20).splitlines()
    lines[4] = lines[4].replace(lines[4].split(",")[3], "nan")
    lines[9] = ",".join(["", *lines[9].split(",")[1:]])
    lines[15] = "pause"
    Path("data.csv").write_text("\n".join(lines))
    for options in ((), ("--robot", "arm.dh.toml")):
        (file,) = inspect(run, "data.csv", *options)["files"]
        assert file["bad_rows"] == {
            "5": "column 'x': 'nan' is not a finite number",
            "10": "column 'joint_1' is empty",
            "16": "1 value for 6 columns, with commas between them and decimal points",
        }
        assert file["rows"] == 20
        err = run("inspect", "data.csv", *options)[2]
        assert "3 rows cannot be used, lines 5, 10, 16:" in err
        assert "  line 10: column 'joint_1' is empty" in err


def test_suspected_mistakes_are_warnings(run, robot_folder):
    """A joint with the wrong sign, rows beyond the limits, and copied rows."""
    rng = np.random.default_rng(0)
    degrees = rng.uniform(-80, 80, (40, 3))
    rows = np.concatenate([degrees * [1, -1, 1], tool_positions(degrees)], 1)
    rows[7] = rows[3]
    Path("data.csv").write_text("\n".join([HEADER, *(",".join(map(repr, row)) for row in rows.tolist())]))
    document = inspect(run, "data.csv", "--robot", "arm.dh.toml")
    (file,) = document["files"]
    sign, repeated = file["warnings"]
    assert "joint_2" in sign
    assert repeated.startswith("line 9: identical to other rows in every digit (line 9 to line 5)")
    assert file["repeated_lines"] == [9]
    assert document["warnings"] == [f"data.csv: {text}" for text in file["warnings"]]
    err = run("inspect", "data.csv", "--robot", "arm.dh.toml")[2]
    assert f"warning: {sign}" in unfolded(err)
    assert "No problems found" not in err


def test_several_files(run, robot_folder):
    Path("two.csv").write_text(positions_csv(5).replace(",", ";"))
    pd.DataFrame({"point_a": ["p"], "point_b": ["q"], "distance[mm]": [50.0]}).to_excel(
        "three.xlsx", index=False
    )
    files = inspect(run, "data.csv", "two.csv", "three.xlsx", "--robot", "arm.dh.toml")["files"]
    assert [(file["path"], file["kind"], file["rows"], file["form"]) for file in files] == [
        ("data.csv", "position", 20, "commas"),
        ("two.csv", "position", 5, "semicolons"),
        ("three.xlsx", "point_distance", 1, "Excel sheet 'Sheet1'"),
    ]
    assert [file["configurations"] for file in files] == [20, 5, None]


def test_a_file_without_header_proposes_the_lines_of_a_map(run, robot_folder):
    Path("data.csv").write_text(positions_csv(20).split("\n", 1)[1])
    err = stderr_of(run("inspect", "data.csv", "--robot", "arm.dh.toml"))
    assert "problem: data.csv:1: numbers where the header must be" in err
    *_, first, second, third = err.splitlines()
    assert first == "header = false"
    Path("map.toml").write_text("\n".join([first, second, third]))
    (file,) = inspect(run, "data.csv", "--robot", "arm.dh.toml", "--columns", "map.toml")["files"]
    assert (file["kind"], file["rows"], file["problem"]) == ("position", 20, "")
    assert inspect(run, "data.csv")["files"][0]["kind"] == ""


def test_a_misspelt_column_is_a_problem(run, robot_folder):
    Path("data.csv").write_text(positions_csv(5).replace("joint_2", "joint_two"))
    (file,) = inspect(run, "data.csv", "--robot", "arm.dh.toml")["files"]
    assert "did you mean 'joint_2'?" in file["problem"]


def test_invalid_arguments(assert_refused):
    assert_refused(["--columns: needs --robot"], "inspect", "data.csv", "--columns", "map.toml")
    assert_refused(["none.csv: cannot read it"], "inspect", "none.csv")
    assert_refused(["data.csv: is an input file"], "inspect", "data.csv", "--json", "data.csv")


def test_the_proposed_map_of_a_real_file_is_the_one_written_by_hand(run, robot_folder, ur10):
    """Rotations, separators and decimal commas of the laser tracker's file, with 20 other columns."""
    source = DATA / "ipa_ur10" / "Series_B" / "measurements_joint_configurations.csv"
    if not source.exists():
        missing(str(source))
    path = Path("series.csv")
    path.write_bytes(b"".join(source.read_bytes().splitlines(keepends=True)[:150]))
    robot = ("--robot", ur10.urdf.source, "--tip", "tool0")
    (file,) = inspect(run, path, *robot)["files"]
    Path("map.toml").write_text("\n".join(file["column_map"]))
    (proposed,) = inspect(run, path, *robot, "--columns", "map.toml")["files"]
    (expected,) = inspect(run, path, *robot, "--columns", MAPS / "ipa_ur10.toml")["files"]
    assert proposed == expected
    assert expected["warnings"] == []


def test_images_need_a_rig_with_a_robot(run, assert_refused):
    """With the rig, the images are counted and judged; without robot, nothing is missing."""
    assert run("simulate", "arm.dh.toml", "-m", "20", "--kind", "camera", "-o", "corners.csv")[0] == 0
    (file,) = inspect(run, "corners.csv", "--robot", "arm.dh.toml", "--rig", "corners.rig.toml")["files"]
    assert (file["kind"], file["problem"], file["configurations"]) == ("camera", "", 20)
    (file,) = inspect(run, "corners.csv", "--robot", "arm.dh.toml")["files"]
    assert "give --rig RIG.toml" in file["problem"]
    assert inspect(run, "corners.csv")["files"][0]["problem"] == ""
    assert_refused(["--rig", "needs --robot"], "inspect", "corners.csv", "--rig", "corners.rig.toml")
