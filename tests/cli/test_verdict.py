"""Verdict of dhcal calibrate: exit status, files that are written, and reasons."""

import re
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from command_line import CALIBRATE, error_of, json_of, parse_json, positions_csv, stderr_of, unfolded
from measurement_files import frames, joint_positions, real_ur10
from robots import UR10, nominal_arm
from scipy.spatial.transform import Rotation
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin.estimation import select_parameters
from dhcal_pin.exceptions import RefusedCalibrationError
from dhcal_pin.measurements import Noise, Position

OUTPUTS = ("--json", "r.json", "--report", "r.html", "--report", "r.md", "--map", "m.csv")
# One iteration does not solve the problem.
UNFINISHED = ("--max-iterations", "1")


def test_refused_robot_is_not_written(run, robot_folder, undrawn):
    status, _, err = run(*CALIBRATE, *OUTPUTS, "--residuals", "e.csv", "--bundle", "b.dhcal.zip", *UNFINISHED)
    assert status == 3
    document = parse_json(Path("r.json").read_text())
    assert document["verdict"]["status"] == "refused"
    (reason,) = document["verdict"]["reasons"]
    assert "did not converge" in reason
    assert unfolded(err).endswith(f"verdict: refused (no robot written; --force overrides) {reason}")
    assert {path.name for path in robot_folder.iterdir()} == {
        *("arm.dh.toml", "arm.urdf", "data.csv", "r.json", "r.html", "r.md", "e.csv", "b.dhcal.zip")
    }
    assert set(document["files"]) == {"json", "report", "report_2", "residuals"}
    page, text = Path("r.html").read_text(), Path("r.md").read_text()
    assert page.index("Verdict: refused") < page.index("<h1>")
    assert text.split("\n\n")[1:3] == ["**Verdict: refused**", reason]


def test_a_copy_of_the_fitted_file_is_no_holdout(run, robot_folder):
    Path("copy.csv").write_bytes(Path("data.csv").read_bytes())
    err = stderr_of(run(*CALIBRATE, "--holdout", "copy.csv"))
    assert "verdict: caution" in err
    assert "hold-out samples are fitted, too" in unfolded(err)


@pytest.mark.parametrize(("words", "expected"), [((), 0), (("--strict",), 3)])
def test_force_writes_a_refused_robot(run, robot_folder, undrawn, words, expected):
    status, _, _ = run(*CALIBRATE, *OUTPUTS, *UNFINISHED, "--force", *words)
    assert status == expected
    document = parse_json(Path("r.json").read_text())
    assert document["verdict"]["status"] == "refused"
    assert all(Path(name).exists() for name in ("out.urdf", "out.calibration.toml", "m.csv"))


def test_accepted_robot_is_written(run, robot_folder):
    err = stderr_of(run(*CALIBRATE, *OUTPUTS))
    assert parse_json(Path("r.json").read_text())["verdict"] == {"status": "ok", "reasons": []}
    assert err.splitlines()[-1] == "verdict: ok"
    assert Path("out.urdf").exists()


@pytest.mark.parametrize(("force", "words"), [(False, ()), (True, ()), (True, ("--strict",))])
def test_refused_robot_fails_a_fleet(run, robot_folder, force, words):
    job = '[[job]]\nrobot = "arm.dh.toml"\ndata = "data.csv"\n'
    more = f"max_iterations = 1\nforce = {str(force).lower()}\n"
    text = f'{job}output = "a.urdf"\n{job}output = "b.urdf"\n{more}'
    Path("all.fleet.toml").write_text(text)
    status, _, err = run(
        "calibrate", "all.fleet.toml", "-o", "s.csv", "--json", "s.json", "--jobs", "1", *words
    )
    assert status == (0 if force and not words else 1)
    assert "did not converge" in err
    document = parse_json(Path("s.json").read_text())
    assert [one["status"] for one in document["jobs"]] == ["ok", "refused"]
    assert (document["failed"], document["refused"]) == (0, 1)
    assert Path("a.urdf").exists()
    assert Path("b.urdf").exists() == force


def test_python_refuses_to_write(robot_folder):
    Path("data.csv").write_text(positions_csv(20))
    arm = dh.read_robot("arm.dh.toml")
    fit = dh.calibrate(arm, dh.read_measurements("data.csv", arm), max_iterations=1)
    assert fit.verdict.status == "refused"
    with pytest.raises(RefusedCalibrationError, match="did not converge"):
        dh.write_urdf(fit, "out.urdf")
    assert not Path("out.urdf").exists()
    dh.write_urdf(fit, "out.urdf", force=True)
    assert Path("out.urdf").exists()


# --- results that must not be written --------------------------------------------------------------

JOINTS = [f"{name}_joint" for name in "shoulder_pan shoulder_lift elbow wrist_1 wrist_2 wrist_3".split()]


def tracker_columns(count=60):
    """Columns of a file of a tracker in front of a UR10 with errors of millimetres, by their headers."""
    base, tool = frames()
    arm = real_ur10().with_base_and_tool(base, tool)
    q = 0.5 * joint_positions(arm, count)
    rng = np.random.default_rng(1)
    poses = arm.poses(q)
    positions = 1e3 * poses[:, :3, 3] + 0.1 * rng.normal(size=(count, 3))
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    values = np.concatenate([np.degrees(q), positions, quaternions], 1)
    headers = [f"{name}[deg]" for name in JOINTS] + ["x[mm]", "y[mm]", "z[mm]", "qw", "qx", "qy", "qz"]
    return dict(zip(headers, values.T, strict=True))


def write_columns(columns):
    rows = zip(*(map(repr, column.tolist()) for column in columns.values()), strict=True)
    Path("data.csv").write_text("\n".join([",".join(columns), *map(",".join, rows)]) + "\n")


def positions_only(columns):
    return {header: column for header, column in columns.items() if not header.startswith("q")}


def mirrored(columns):
    return columns | {"y[mm]": -columns["y[mm]"]}


def flipped(columns):
    return columns | {"elbow_joint[deg]": -columns["elbow_joint[deg]"]}


def metres(columns):
    """Millimetres under a header that says metres."""
    return {header.replace("[mm]", "[m]"): column for header, column in columns.items()}


def millimetres(columns):
    """Metres under a header that says millimetres."""
    return {h: column / 1e3 if "[mm]" in h else column for h, column in columns.items()}


def radians(columns):
    """Degrees under a header that says radians."""
    return {header.replace("[deg]", "[rad]"): column for header, column in columns.items()}


def degrees(columns):
    """Radians under a header that says degrees."""
    return {h: np.radians(column) if "[deg]" in h else column for h, column in columns.items()}


def shifted(columns):
    """Each row has the joint values of the row above."""
    return {h: column[:-1] if "[deg]" in h else column[1:] for h, column in columns.items()}


def swapped(columns):
    a, b = "wrist_1_joint[deg]", "wrist_2_joint[deg]"
    return columns | {a: columns[b], b: columns[a]}


def turned(columns):
    return columns | {"shoulder_lift_joint[deg]": columns["shoulder_lift_joint[deg]"] + 90}


def reordered(columns):
    names = ("qw", "qx", "qy", "qz")
    return columns | {name: columns[other] for name, other in zip(names, (*names[1:], "qw"), strict=True)}


def inverted(columns):
    names = ("qx", "qy", "qz", "qw")
    rotation = Rotation.from_quat(np.stack([columns[name] for name in names], 1)).inv()
    axes = ("x[mm]", "y[mm]", "z[mm]")
    position = -rotation.apply(np.stack([columns[name] for name in axes], 1))
    return columns | dict(zip((*axes, *names), [*position.T, *rotation.as_quat().T], strict=True))


MISTAKES = [
    (mirrored, positions_only, "the measuring frame is mirrored", "axes:x,y,-z"),
    (mirrored, dict, "the sign of measured y is wrong", "axes:x,-y,z"),
    (flipped, positions_only, "the sign of joint elbow_joint is wrong", "sign:elbow_joint"),
    (turned, dict, "the zero of joint shoulder_lift_joint is off by 90 deg",
     "zero:shoulder_lift_joint:-90deg"),
    (metres, dict, "measured lengths are 1000 times too large, as if mm had been read as m",
     "lengths:mm-not-m"),
    (millimetres, positions_only,
     "measured lengths are 1000 times too small, as if m had been read as mm",
     "lengths:m-not-mm"),
    (radians, dict, "all revolute joints are 57.3 times too large, as if deg had been read as rad",
     "joints:deg-not-rad"),
    (degrees, positions_only, "all revolute joints are 57.3 times too small, as if rad had been read as deg",
     "joints:rad-not-deg"),
    (shifted, dict, "each row holds the joint values of the row above", "rows:above"),
    (swapped, positions_only, "the columns of joints wrist_1_joint and wrist_2_joint are exchanged",
     "swap:wrist_1_joint:wrist_2_joint"),
    (reordered, dict, "quaternions are in the order x y z w", "quaternions:xyzw"),
    (inverted, dict, "the poses are inverse", "poses:inverse"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("mistake", "columns", "reason", "key"),
    some_slow(MISTAKES, {0, 5}),
    ids=[f"{m.__name__}-{k}" for m, _, _, k in MISTAKES],
)
def test_mistakes_are_refused_with_the_remedy(run, robot_folder, mistake, columns, reason, key):
    write_columns(mistake(columns(tracker_columns())))
    command = ("calibrate", UR10, "data.csv", "--tip", "tool0", "-o", "out.urdf")
    status, out, err = run(*command, "--json", "-")
    assert status == 3
    assert not {"out.urdf", "out.calibration.toml"} & {path.name for path in robot_folder.iterdir()}
    (text,) = parse_json(out)["verdict"]["reasons"]
    assert reason in text.lower()
    assert f"--mend {key}" in text
    # The diagnosis is the last thing on the screen.
    assert unfolded(err).endswith(unfolded(text))
    # The remedy mends the measurements.
    document = json_of(run(*command, "--mend", key, "--json", "-"))
    assert document["verdict"]["status"] == "ok"
    assert document["after"]["position_rms_m"] < 0.25e-3


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            ["sign:joint_2"],
            "joint values changed by --mend sign:joint_2; the robot is for joint values with this change",
        ),
        (["sign:joint_2@data.csv:2-9"], "joint values changed by --mend sign:joint_2@data.csv:2-9"),
        (["rows:above"], "joint values changed by --mend rows:above"),
        (["scale:x:1.001"], "measured values changed by --mend scale:x:1.001"),
    ],
)
def test_changes_of_the_measurements_are_beside_the_verdict(run, robot_folder, undrawn, words, text):
    outputs = ("--json", "r.json", "--report", "r.html", "--report", "r.md", "--certificate", "c.html")
    _, _, err = run(*CALIBRATE, *outputs, "--force", "--mend", *words)
    assert f"data.csv: {text} verdict: " in unfolded(err)
    assert f"data.csv: {text}" in parse_json(Path("r.json").read_text())["warnings"]
    for name in ("r.html", "r.md", "c.html"):
        assert f"data.csv: {text}." in Path(name).read_text().replace("\\", ""), name
    certificate = Path("c.html").read_text()
    assert certificate.index("Verdict:") < certificate.index(text) < certificate.index("</section>")


@pytest.mark.parametrize(
    ("moving", "reason"),
    [
        ([], "No joint ever moved"),
        ([0], f"Joints {', '.join(JOINTS[1:5])} and {JOINTS[5]} never moved"),
    ],
)
def test_joints_that_never_moved_are_refused(run, robot_folder, moving, reason):
    arm = real_ur10()
    q = np.full((30, 6), 0.3)
    q[:, moving] = joint_positions(arm, 30)[:, moving]
    positions = 1e3 * arm.poses(q)[:, :3, 3] + 0.1 * np.random.default_rng(0).normal(size=(30, 3))
    headers = [f"{name}[rad]" for name in JOINTS] + ["x[mm]", "y[mm]", "z[mm]"]
    write_columns(dict(zip(headers, np.concatenate([q, positions], 1).T, strict=True)))
    status, out, _ = run("calibrate", UR10, "data.csv", "--tip", "tool0", "-o", "out.urdf", "--json", "-")
    assert status == 3
    assert parse_json(out)["verdict"]["reasons"][0].startswith(reason)
    assert not Path("out.urdf").exists()


def test_a_tip_inside_the_chain_is_refused_and_the_ignored_joints_are_named(run, robot_folder):
    write_columns(tracker_columns())
    command = ("calibrate", UR10, "data.csv", "--tip", "wrist_1_link", "-o", "out.urdf", "--json", "-")
    status, out, err = run(*command)
    assert status == 3
    document = parse_json(out)
    cause = "data.csv: moving joints behind the tip wrist_1_link are ignored: wrist_2_joint, wrist_3_joint; "
    assert cause in document["verdict"]["reasons"][0]
    assert "--tip" in document["verdict"]["reasons"][0]
    assert "data.csv: columns 'wrist_2_joint', 'wrist_3_joint' ignored" in document["warnings"]
    assert "tip wrist_1_link, 4 joints from shoulder_pan_joint to wrist_1_joint" in unfolded(err)
    assert not Path("out.urdf").exists()


@pytest.mark.parametrize(
    ("has_moved", "change"), [(True, {}), (False, {"wrist_3_joint[deg]": np.full(3, 3.0)})]
)
def test_joints_behind_the_tip_are_named_if_they_move(run, robot_folder, has_moved, change):
    # Three rows are too few for the search for mistakes.
    write_columns(tracker_columns(3) | change)
    out = run("inspect", "data.csv", "--robot", UR10, "--tip", "wrist_2_link", "--json", "-")[1]
    assert ("behind the tip wrist_2_link are ignored: wrist_3_joint" in out) == has_moved


def test_six_positions_give_no_accuracy_and_no_correction(run, robot_folder):
    write_columns(positions_only(tracker_columns(6)))
    command = ("calibrate", UR10, "data.csv", "--tip", "tool0", "-o", "out.urdf", "--json", "-")
    status, out, err = run(*command)
    document = parse_json(out)
    assert status == 0
    assert document["verdict"]["status"] == "caution"
    (reason,) = document["verdict"]["reasons"]
    assert "no correction applied" in reason
    # The advice is followed, and the note on the parameters gives no other number.
    count = int(re.search(r"Measure at least (\d+) different poses\.", reason)[1])  # pyright: ignore
    assert not any(re.search(r"\d+ more pose", text) for text in document["unobservable"])
    write_columns(positions_only(tracker_columns(count)))
    reasons = parse_json(run(*command[:5], "-o", "more.urdf", "--json", "-")[1])["verdict"]["reasons"]
    assert not any("few" in text for text in reasons)
    write_columns(positions_only(tracker_columns(count - 1)))
    (reason,) = parse_json(run(*command[:5], "-o", "less.urdf", "--json", "-")[1])["verdict"]["reasons"]
    assert f"Measure at least {count} different poses." in reason
    for key in ("cross_validated_before", "cross_validated_after", "holdout_region_after"):
        assert document[key] is None
    # No figure on the screen that these data cannot support, and no robot that differs from the nominal one.
    assert "cross-validated" not in err
    assert "worse" not in err
    origins = re.compile(r"<origin[^>]*>")
    assert origins.findall(Path("out.urdf").read_text()) == origins.findall(UR10.read_text())


def test_robot_that_is_worse_elsewhere_is_refused(run, robot_folder):
    """Errors of the instrument in a small region are taken for errors of the robot, which has none."""
    arm = dh.Chain.from_urdf(UR10, "tool0").with_base_and_tool(*frames())
    rng = np.random.default_rng(1)
    headers = [f"{name}[deg]" for name in JOINTS] + ["x[mm]", "y[mm]", "z[mm]"]
    for reach, slope in ((0.5, 0.0), (0.1, 0.03)):
        q = reach * joint_positions(arm, 80, 3)
        positions = 1e3 * arm.poses(q)[:, :3, 3] + 0.1 * rng.normal(size=(80, 3))
        positions[:, 2] += slope * np.degrees(q[:, 1] + q[:, 2])
        write_columns(dict(zip(headers, np.concatenate([np.degrees(q), positions], 1).T, strict=True)))
        Path("data.csv").rename("held.csv" if not slope else "small.csv")
    command = ("calibrate", UR10, "small.csv", "--tip", "tool0", "-o", "out.urdf", "--holdout", "held.csv")
    status, out, _ = run(*command, "--json", "-")
    assert status == 3
    document = parse_json(out)
    assert document["verdict"]["reasons"][0].startswith("The calibrated robot is worse than the nominal one")
    assert document["holdout_after"]["position_rms_m"] > 1.1 * document["holdout_before"]["position_rms_m"]
    # Within the small region it looks perfect.
    assert document["cross_validated_after"]["position_rms_m"] < 0.3e-3


def test_corrections_that_no_manufacturing_error_explains_are_refused(run, robot_folder):
    """Zeros of two joints that are off by any angle are not among the mistakes that are tried."""
    columns = tracker_columns()
    columns["elbow_joint[deg]"] = columns["elbow_joint[deg]"] + 30
    columns["wrist_2_joint[deg]"] = columns["wrist_2_joint[deg]"] - 25
    write_columns(columns)
    status, out, err = run("calibrate", UR10, "data.csv", "--tip", "tool0", "-o", "out.urdf", "--json", "-")
    assert status == 3, err
    assert "times what manufacturing errors would" in parse_json(out)["verdict"]["reasons"][0]


def test_many_outliers_advise_caution(run, robot_folder):
    columns = positions_only(tracker_columns())
    columns["x[mm]"][::7] += 20 * np.random.default_rng(0).normal(size=len(columns["x[mm]"][::7]))
    write_columns(columns)
    command = ("calibrate", UR10, "data.csv", "--tip", "tool0", "-o", "out.urdf", "--loss", "tukey")
    status, out, _ = run(*command, "--json", "-", "--strict")
    assert status == 4
    assert Path("out.urdf").exists()
    verdict = parse_json(out)["verdict"]
    assert verdict["status"] == "caution"
    assert "are outliers" in verdict["reasons"][0]


def test_validate_is_never_refused(run, robot_folder):
    write_columns(flipped(positions_only(tracker_columns())))
    document = json_of(run("validate", UR10, "data.csv", "--tip", "tool0", "--fit-frames", "--json", "-"))
    assert "the sign of joint elbow_joint is wrong" in document["warnings"][0].lower()
    assert document["verdict"]["status"] == "refused"


@pytest.mark.parametrize("keys", [["sign:nothing"], ["poses:inverse"]])
def test_changes_that_do_not_apply_are_wrong_input(run, robot_folder, keys):
    write_columns(positions_only(tracker_columns(12)))
    mend = [word for key in keys for word in ("--mend", key)]
    err = error_of(run("calibrate", UR10, "data.csv", "--tip", "tool0", "-o", "out.urdf", *mend))
    assert "--mend" in err


def test_a_named_mistake_is_undone_in_the_files_that_have_it(run, robot_folder):
    """Touches whose joint has the wrong sign, beside known distances, which have no joint values."""
    for kind in ("point", "point_distance"):
        words = ("-n", "30", "--errors", "1mm,0.3deg", "--kind", kind, "--seed", "4", "-o", f"{kind}.csv")
        assert run("simulate", "arm.urdf", *words)[0] == 0
    table = [line.split(",") for line in Path("point.csv").read_text().splitlines()]
    column = next(i for row in table for i, cell in enumerate(row) if cell.startswith("joint_3"))
    for row in table:
        with suppress(ValueError, IndexError):
            row[column] = repr(-float(row[column]))
    Path("point.csv").write_text("\n".join(map(",".join, table)) + "\n")
    files = ("point.csv", "point_distance.csv", "--parameters", "minimal,tool", "--extend", "none")
    command = ("calibrate", "arm.urdf", *files, "--session", "off", "-o", "out.urdf")
    status, _, err = run(*command)
    assert status == 3
    # Another sign is equivalent for this arm.
    keys = re.findall(r"--mend (\S+[^.\s])", unfolded(err))
    key = "sign:joint_3"
    assert key in keys
    for each in keys:
        assert run(*command, "--mend", each)[0] == 0
    assert run(*command, "--mend", f"{key}@point.csv")[0] == 0
    status, _, err = run(*command, "--mend", f"{key}@point_distance.csv")
    assert (status, "does not apply to measurements of kind point_distance" in err) == (2, True)
    status, _, err = run(*command, "--mend", f"{key}@points.csv")
    assert (status, "unknown file; choose from point.csv, point_distance.csv" in err) == (2, True)


@pytest.mark.parametrize(("seed", "converges"), [(0, True), (1, True), (2, False)])
def test_too_small_sigmas_are_named_as_the_cause_of_a_large_correction(seed, converges):
    """Noise of 0.3 mm with stated 0.01 mm; without stated standard deviations the result is ok.

    More iterations do not help, so they are not advised.
    """
    chain = nominal_arm("ur10")
    rng, errors = np.random.default_rng(seed), select_parameters(chain, "placement")
    sizes = np.array([1e-3 if p.unit == "m" else 5e-3 for p in errors.parameters])
    truth = errors.at(rng.normal(size=len(sizes)) * sizes)
    q = rng.uniform(chain.lower, chain.upper, (80, 6))
    measured = Position.simulate(truth, q, Noise(3e-4), rng).positions()
    fit = dh.calibrate(chain, Position(q, measured, sigma=1e-5))
    reasons = fit.verdict.reasons
    assert fit.converged == converges
    assert not any("iteration" in reason for reason in reasons)
    assert "times as large as the stated standard deviations" in reasons[0]
    assert "leave the sigma columns out" in reasons[0]
    assert dh.calibrate(chain, Position(q, measured)).verdict.status == "ok"
