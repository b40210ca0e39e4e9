"""Default output: one screen of 80 x 24, whatever the robot, the kind, the names and the result."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import CALIBRATE, positions_csv, stderr_of, stdout_of, unfolded
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import URDF
from slow_cases import some_slow

from dhcal_pin.cli.screens.screen import HEIGHT, WIDTH, Block, Screen, cell_width, fold, section_blocks
from dhcal_pin.formatting import Table
from dhcal_pin.measurements import KINDS
from dhcal_pin.paper import simulations
from dhcal_pin.report.document import Section

ARMS = ("experiment.dh.toml", "sim_6dof.dh.toml", "scara.urdf", "planar_2r.urdf")
# Folders and names that are much longer than a line.
LONG_FOLDER = "/".join(["measurements of the cell behind the second press"] * 4)


def assert_fits(err):
    """The text has the size of one screen, and nothing in it is cut off."""
    lines = err.splitlines()
    assert len(lines) <= 24, err
    assert max(map(cell_width, lines), default=0) <= 80, err
    assert not re.search(r"\.\.\.|…", err), err


@pytest.mark.parametrize(
    "kind",
    some_slow(list(KINDS), [list(KINDS).index(kind) for kind in ("position", "pose", "point", "camera")]),
)
def test_calibrations_of_all_kinds(run, robot_folder, kind, unsuspected_once):
    arm = URDF / "experiment.dh.toml"
    stdout_of(run("simulate", arm, "--errors", "1mm,0.3deg", "-m", 40, "--kind", kind, "-o", "k.csv"))
    rig = ["--rig", "k.rig.toml"] if Path("k.rig.toml").exists() else []
    command = ("calibrate", arm, "k.csv", *rig, "-o", "o.urdf", "--extend", "none", "--force")
    err = stderr_of(run(*command))
    assert_fits(err)
    lines = err.splitlines()
    assert any(line.startswith("verdict: ") for line in lines)
    assert f"k.csv: {len(Path('k.csv').read_text().splitlines()) - 2} rows, {kind}" in unfolded(err)
    if kind in ("position", "pose", "point"):
        # The screen may have room for the first reason of the verdict only.
        every = unfolded(run(*command, "--verbose")[2])
        assert ("The measurements do not determine the size of the robot:" in every) == (kind == "point")


@pytest.mark.parametrize("arm", some_slow([path.name for path in sorted(URDF.glob("*.urdf"))[:6]], {0, 3}))
def test_calibrations_of_several_robots(run, robot_folder, arm):
    stdout_of(run("simulate", URDF / arm, "--errors", "1mm,0.3deg", "-m", 40, "-o", "d.csv"))
    command = ("calibrate", URDF / arm, "d.csv", "-o", "o.urdf", "--holdout", "0.3", "--force")
    err = stderr_of(run(*command))
    assert_fits(err)


@pytest.mark.parametrize("n_files", some_slow([1, 8, 40], {0, 1}))
def test_long_paths_and_many_files(run, robot_folder, n_files, undrawn, unsuspected_once, inside_only):
    folder = Path(LONG_FOLDER)
    folder.mkdir(parents=True)
    names = [str(folder / f"{'position of the reflector ' * 4}{i}.csv") for i in range(n_files)]
    for i, name in enumerate(names):
        # One row of each file is far off.
        Path(name).write_text(positions_csv(20, seed=i, wrong=(3,)))
    outputs = ("-o", folder / "out.urdf", "--report", folder / "r.html", "--json", folder / "r.json")
    err = stderr_of(run("calibrate", "arm.dh.toml", *names, *outputs))
    assert_fits(err)
    assert "verdict: " in err
    if n_files > 1:
        assert re.search(r"\d+ more files?; see --verbose", err)
        assert re.search(r"\d+ (more )?notes? on rows(, .*)?; see --verbose", unfolded(err))
    for command in (("inspect", *names, "--robot", "arm.dh.toml"), ("validate", "arm.dh.toml", *names)):
        err = stderr_of(run(*command))
        assert_fits(err)


def test_a_refusal_with_many_warnings(run, robot_folder):
    """Forty copied rows, twenty wrong ones, and a column that is not known."""
    lines = positions_csv(60, wrong=range(1, 21)).splitlines()
    rows = [f"{line},x" for line in [*lines[1:], *lines[1:41]]]
    Path("data.csv").write_text("\n".join([f"{lines[0]},remark", *rows]))
    status, _, err = run(*CALIBRATE, "--max-iterations", "1")
    assert status == 3
    assert_fits(err)
    head, reasons = err.split("verdict: refused (no robot written; --force overrides)\n")
    assert "did not converge" in unfolded(reasons)
    assert "wrote" not in head
    # The same command shows the rest.
    full = run(*CALIBRATE, "--max-iterations", "1", "--verbose")[2]
    assert len(full) > 2 * len(err)
    assert "see --verbose" not in full


def test_views(run, robot_folder):
    normal, quiet, verbose = (run(*CALIBRATE, *options)[2] for options in ((), ("--quiet",), ("--verbose",)))
    assert quiet == "verdict: ok\n"
    assert_fits(normal)
    for words in ("arm.dh.toml: tip ", "3 joints from joint_1 to joint_3", "data.csv: 20 rows, position"):
        assert words in normal
        assert words in verbose
    for title in ("parameters", "accuracy", "joint origins in the URDF, in m and rad"):
        assert f"\n{title}\n" in verbose
    # Each parameter has a row with its value, and a place in the table of its frame.
    for name in ("theta1", "alpha3", "base.x", "tool.z"):
        assert len(re.findall(rf"(?<!\w){re.escape(name)}(?!\w)", verbose)) >= 2 or name not in verbose
    assert "theta1" in verbose
    assert run("calibrate", "--quiet", "--verbose")[0] == 2


def test_corrections_are_ordered_by_their_size(run, robot_folder):
    err = run(*CALIBRATE)[2].splitlines()
    start = next(i for i, line in enumerate(err) if line.startswith("largest corrections"))
    rows = [line.split() for line in err[start + 1 : err.index("", start)]]
    assert rows
    assert all(len(row) == 5 for row in rows)
    # Corrections that are zero within their uncertainty are none; both figures are rounded.
    assert all(abs(float(row[1])) >= 1.9 * float(row[3]) for row in rows)
    # Lengths have priors of 5 mm or less and angles of 1 degree or less; the largest come first.
    relative = [abs(float(row[1])) / (5 if row[2] == "mm" else 17.5) for row in rows]
    assert relative[0] == max(relative)


@pytest.mark.parametrize(
    "command",
    [
        ("check", "arm.dh.toml"),
        ("plan", "arm.urdf", "-n", 12, "--candidates", 60, "-o", "poses.csv"),
        ("simulate", "arm.urdf", "-m", 5, "-o", "s.csv"),
        ("convert", "arm.dh.toml", "converted.urdf"),
        ("view", "arm.urdf", "--html", "scene.html"),
        ("demo",),
    ],
    ids=lambda command: command[0],
)
def test_other_commands(run, robot_folder, undrawn, monkeypatch, command):
    rows = simulations.simulation_rows
    monkeypatch.setattr(simulations, "simulation_rows", lambda: rows(seeds=2))
    err = stderr_of(run(*command))
    assert_fits(err)
    # Nothing but the verdict, if there is one.
    assert len(run(*command, "--quiet")[2].splitlines()) <= 1


def test_targets_out_of_reach(run, robot_folder):
    far = "\n".join(f"{1000 + i},{i},9000" for i in range(50))
    Path("targets.csv").write_text(f"x[mm],y[mm],z[mm]\n{far}\n")
    err = stderr_of(run("compensate", "arm.urdf", "arm.urdf", "targets.csv", "-o", "c.csv"))
    assert_fits(err)
    assert "more targets out of reach; see --verbose" in err


TEXTS = st.text("abc/ 你é-=\x1b\u0301", min_size=0, max_size=300)
TABLES = st.integers(1, 4).flatmap(
    lambda n: st.builds(
        Table,
        st.lists(TEXTS, min_size=n + 2, max_size=n + 2),
        st.lists(st.lists(st.text("ab_/.", max_size=60), min_size=n + 2, max_size=n + 2), max_size=30),
        st.integers(1, n),
    )
)
NUMBER_TABLE = Table(["name", "value"], [["a" * i, "1.25 mm"] for i in range(60)])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.one_of(st.lists(TEXTS, max_size=30), st.just(NUMBER_TABLE)), max_size=8))
def test_any_screen_fits(contents):
    blocks = [Block(content, noun="item", rank=i % 3) for i, content in enumerate(contents)]
    lines = Screen([*blocks, Block(["verdict: ok"])]).lines("normal")
    assert len(lines) <= HEIGHT
    assert max(cell_width(line.text) for line in lines) <= WIDTH
    assert lines[-1].text == "verdict: ok"


@given(TEXTS, st.integers(8, 40))
def test_folding_keeps_all_characters(text, width):
    lines = fold(text, width)
    assert all(cell_width(line) <= width for line in lines)
    plain = fold(text, None)[0]
    assert "".join("".join(lines).split()) == "".join(plain.split())


def test_a_table_that_is_too_wide_continues_below():
    table = Table(["name", *(f"column {i}" for i in range(20))], [["arm", *["123.456"] * 20]] * 3)
    lines = [line.text for line in Screen([Block(table)]).lines("verbose", WIDTH)]
    assert max(map(len, lines)) <= WIDTH
    assert sum(line.count("123.456") for line in lines) == 60
    assert sum(line.startswith("arm") for line in lines) == 3 * sum(line.startswith("name") for line in lines)


def test_a_shortened_list_counts_the_others():
    numbers = np.arange(50).astype(str).tolist()
    lines = [line.text for line in Screen([Block(numbers, noun="file")]).lines("normal")]
    assert lines == [*numbers[: HEIGHT - 1], f"  {50 - HEIGHT + 1} more files; see --verbose"]
    everything = Screen([Block(numbers, noun="file")]).lines("verbose")
    assert [line.text for line in everything] == numbers


def test_what_is_left_out_takes_one_line_and_leaves_space_for_the_first_reason():
    blocks = [
        Block(["name " * 8] * 6, noun=noun, rank=rank) for rank, noun in enumerate(("file", "note on rows"))
    ]
    fixed = Block(["."] * 12)
    reasons = Block(["word " * 120, "word " * 120], noun="reason", rank=8)
    lines = [line.text for line in Screen([*blocks, fixed, reasons]).lines("normal")]
    assert len(lines) <= HEIGHT
    assert lines[0] == "6 files, 6 notes on rows; see --verbose"
    assert lines[-1] == "  1 more reason; see --verbose"


@pytest.mark.parametrize(("errors", "is_kept"), [("0mm,0deg", True), ("3mm,1deg", False)])
def test_images_of_a_right_and_of_a_wrong_arm(run, robot_folder, uneventful, errors, is_kept):
    arm = URDF / "experiment.dh.toml"
    simulated = ("--kind", "camera", "--noise", "0.2mm", "-o", "k.csv")
    stdout_of(run("simulate", arm, "--errors", errors, "-m", 30, *simulated))
    command = ("calibrate", arm, "k.csv", "--rig", "k.rig.toml", "-o", "o.urdf", "--force")
    err = stderr_of(run(*command, "--json", "r.json"))
    assert_fits(err)
    document = json.loads(Path("r.json").read_text())
    assert document["camera_stages"][-1]["kept"] != is_kept
    texts = " ".join(document["warnings"])
    assert ("The nominal arm is kept" in texts) == is_kept
    assert ("The nominal arm is kept" in unfolded(err)) == is_kept
    assert ("; the arm is kept" in unfolded(err)) == is_kept
    assert ("estimated: placement" in err) != is_kept
    if is_kept:
        # Nothing is wrong: the rows that are left out name no causes.
        assert "more rows of tried causes; see --verbose" in unfolded(err)
        verbose = run(*command, "--verbose")[2]
        assert "x, RMS" in verbose
        assert "error at the board" in verbose


def test_sections_of_a_document_on_a_terminal():
    table = Table(["name", "value"], [["a", "1 mm"]], caption="caption")
    sections = [
        Section("a", "Title", ["A sentence."], ["an item"], [table], figures=lambda: pytest.fail("drawn")),
        Section("b", "Other", tables=[Table(["name"], [["b"]])]),
    ]
    lines = [line.text for line in Screen([], lambda: section_blocks(sections)).lines("verbose")]
    expected = ["Title", "A sentence.", "an item", "", "caption", "name  value", "a      1 mm"]
    assert lines == [*expected, "", "Other", "name", "b"]
    assert Screen([], lambda: pytest.fail("made")).lines("normal") == []


@pytest.mark.parametrize(
    ("stated", "text"), [(0.5, "sigma 0.5 mm"), (0.05, "sigma 0.05 mm, residuals 10 times")]
)
def test_residuals_above_the_stated_standard_deviation_are_mentioned(run, robot_folder, stated, text):
    arm = URDF / "experiment.dh.toml"
    noise = ("--noise", "0.5mm", "--seed", 1)
    stdout_of(
        run("simulate", arm, "--errors", "1mm,0.3deg", "-m", 400, "--kind", "position", *noise, "-o", "d.csv")
    )
    file = Path("d.csv")
    file.write_text(file.read_text().replace(",0.0005", f",{stated / 1e3:.5f}"))
    _, _, err = run(
        "calibrate", arm, "d.csv", "-o", "o.urdf", "--parameters", "minimal,base,tool", "--extend", "none"
    )
    assert f"d.csv: 400 rows, position, {text}" in unfolded(err)
    assert ("residuals" in err) == (stated < 0.5)
