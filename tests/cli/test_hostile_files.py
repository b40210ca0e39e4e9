"""Files that broke a command once: one line that helps, exit status 2, and nothing written."""

import os
import shutil
import time
from pathlib import Path
from xml.sax.saxutils import quoteattr

import pytest
from command_line import CALIBRATE, COLUMN_MAP, positions_csv, stderr_of, ur_kinematics

# 310 digits: more than a double can hold.
HUGE = "9" * 310


@pytest.mark.parametrize(
    "value",
    [
        *(
            "2001-99-99",
            "2001-01-01",
            "0b_",
            "0x_",
            "1:30",
            "!!int x",
            "!!float x",
            "!!bool x",
            "!!timestamp x",
        ),
        *("1" + 400 * "0", ".inf", ".nan", "1_000", "[1]", "{a: 1}", "~", "1,5", "2e5", "-10001"),
    ],
)
def test_yaml_values_that_are_no_numbers(assert_refused, value):
    Path("k.yaml").write_text(ur_kinematics([value] * 6))
    words = ["k.yaml: kinematics: shoulder: x: ", "expected a number in m or rad"]
    assert_refused(words, "convert", "k.yaml", "o.urdf")


@pytest.mark.parametrize("text", ["[" * 3000, "{a: " * 3000, "- " * 30_000, "a: [*b]", "\t- x", "%TAG ! x:"])
def test_text_that_is_no_yaml(assert_refused, text):
    Path("k.yaml").write_text(text)
    assert_refused(["k.yaml: "], "convert", "k.yaml", "o.urdf")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: 1\nb: 2: 3\n", "not YAML: line 2: mapping values are not allowed here; correct that line"),
        ("a: 1\nb: [\n", "not YAML: line 3: expected the node content"),
        (
            "a: \x1b\n",
            "not YAML: unacceptable character #x001b: special characters are not allowed; remove it",
        ),
    ],
)
def test_the_message_about_yaml_has_one_line_number(assert_refused, text, words):
    Path("k.yaml").write_text(text)
    assert_refused([f"k.yaml: {words}"], "convert", "k.yaml", "o.urdf")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('unit = "deg"', 'unit = ["rad", ["m"], "rad"]', ["[joints]", "unit ['m']", "text in quotes"]),
        ('unit = "mm"', "unit = 5", ["[columns.x]", "unit 5", "text in quotes"]),
        ("", '[rotation]\nconvention = ["euler"]\n', ["[rotation]", "convention = ['euler']", "rotvec"]),
        *(
            ("\n[joints]", f'\nencoding = "{name}"\n[joints]', ["unknown encoding", name, "cp1252"])
            for name in ("rot13", "hex", "undefined", "none")
        ),
        ("\n[joints]", '\nencoding = "punycode"\n[joints]', ["data.csv", "is not PUNYCODE"]),
        ("\n[joints]", '\nencoding = "utf\\u00008"\n[joints]', ["map.toml: line 2", "zero character"]),
    ],
)
def test_column_maps(assert_refused, old, new, words):
    # The line with a letter beyond ASCII is not Punycode.
    rows = positions_csv(20).split("\n", 1)[1]
    Path("data.csv").write_text(f"# \u00e4\nA1,A2,A3,X,Y,Z\n{rows}")
    text = COLUMN_MAP.replace(old, new, 1) if old else COLUMN_MAP + new
    Path("map.toml").write_text(text)
    assert_refused(words, *CALIBRATE, "--columns", "map.toml")


@pytest.mark.parametrize(
    ("name", "text", "option"),
    [
        ("bounds.toml", f"d1 = [-{HUGE}, {HUGE}]", "--bounds"),
        ("known.toml", f'[instrument]\n"wire1.x" = {HUGE}', "--instrument"),
        ("known.toml", f'[instrument]\n"wire1.x" = {hex(16**10_000)}', "--instrument"),
        ("priors.toml", f"d1 = {HUGE}", "--priors"),
    ],
)
def test_integers_beyond_doubles(assert_refused, name, text, option):
    Path(name).write_text(text)
    assert_refused([name, "integer of ", "expected"], *CALIBRATE, option, name)


@pytest.mark.parametrize(
    "text",
    [
        f"[payload]\nmass_kg = {HUGE}",
        f"[payload]\nmass_kg = 1\ncentre_m = [{HUGE}, 0, 0]",
        f"[base]\nxyz_m = [{HUGE}, 0, 0]",
        f"[joint.joint_1]\ngain = {HUGE}",
    ],
)
def test_integers_beyond_doubles_in_a_sidecar(assert_refused, text):
    Path("arm.calibration.toml").write_text(text)
    assert_refused(["arm.calibration.toml: [", "integer of 1030 bits"], "validate", "arm.urdf", "data.csv")


@pytest.mark.parametrize("tip", ["5", '"tool"', '"base"'])
def test_a_sidecar_whose_tip_is_no_link(assert_refused, tip):
    """Its tool was ignored silently."""
    Path("arm.calibration.toml").write_text(f"tip = {tip}\n[tool]\nxyz_m = [0, 0, 0.1]\n")
    assert_refused(["arm.calibration.toml", "tip = "], "validate", "arm.urdf", "data.csv")


@pytest.mark.parametrize("value", ["1e-300", "1e-160", "5e-324", "1e160", "1e300"])
def test_prior_standard_deviations_beyond_all_measure(assert_refused, value):
    Path("priors.toml").write_text(f'"a*" = {value}\n')
    assert_refused(
        ["priors.toml: a* = ", "from 1e-12 to 1e+06", "--fix"], *CALIBRATE, "--priors", "priors.toml"
    )


@pytest.mark.parametrize("value", ["1e-12", "1e6"])
def test_prior_standard_deviations_at_the_limits(run, robot_folder, recwarn, value):
    Path("priors.toml").write_text(f'"a*" = {value}\n')
    assert run(*CALIBRATE, "--priors", "priors.toml")[0] == 0
    assert not recwarn.list


@pytest.mark.parametrize(
    "text",
    [
        ".".join(["a"] * 50_000) + " = 1",
        "[" + ' . "b"'.join(["a"] * 50_000) + "]",
        "a = " + "[" * 50_000,
        "a = " + "{a=" * 50_000,
        "a = " + "9" * 50_000,
    ],
)
def test_deep_toml(assert_refused, text):
    Path("priors.toml").write_text(text)
    start = time.perf_counter()
    assert_refused(["priors.toml: "], *CALIBRATE, "--priors", "priors.toml")
    assert time.perf_counter() - start < 5


@pytest.mark.parametrize("option", ["--priors", "--bounds", "--columns", "--instrument"])
def test_large_toml(assert_refused, option):
    """A file of 16 MiB took 15 s and 1.2 GB."""
    limit = 24 if option == "--instrument" else 1
    Path("large.toml").write_text("a = 1\n" * ((limit << 20) // 6 + 1))
    assert_refused([f"large.toml: the file is larger than {limit} MiB"], *CALIBRATE, option, "large.toml")


def test_large_sidecar_without_arrays(assert_refused):
    """A sidecar of 24 MiB with other content than encoded arrays took 20 s."""
    Path("large.toml").write_text("\n".join(f"a{i} = 1" for i in range(1 << 17)))
    words = ["large.toml: more than 1 MiB besides arrays in base64"]
    assert_refused(words, *CALIBRATE, "--instrument", "large.toml")


@pytest.mark.parametrize(
    ("option", "text", "words"),
    [
        ("--priors", "zz = 0.1", "names.toml: prior for 'zz': no such parameter; choose from theta1"),
        ("--bounds", "zz = [0, 1]", "names.toml: bounds for 'zz': no such parameter; choose from theta1"),
        (
            "--instrument",
            "[instrument]\nzz = 1",
            "names.toml: known value of 'zz': no such instrument parameter",
        ),
    ],
)
def test_unknown_names_are_named_with_their_file(assert_refused, option, text, words):
    Path("names.toml").write_text(text)
    assert_refused([words], *CALIBRATE, option, "names.toml")


def test_zero_bytes_in_the_paths_of_a_manifest(assert_refused):
    Path("a.fleet.toml").write_text('[[job]]\nrobot = "a\\u0000.urdf"\ndata = "d.csv"\noutput = "o.urdf"\n')
    assert_refused(["a.fleet.toml: line 2: a zero character"], "calibrate", "a.fleet.toml", "-o", "s.csv")


def test_a_message_does_not_repeat_a_long_value(assert_refused, run):
    Path("priors.toml").write_text(f'd1 = "{"x" * 3000}"')
    assert_refused(["priors.toml: d1 = 'xxx", "..."], *CALIBRATE, "--priors", "priors.toml")
    assert len(run(*CALIBRATE, "--priors", "priors.toml")[2]) < 400


@pytest.mark.parametrize(
    "options", [["--report", "r.html"], ["--report", "r.md"], ["--json", "r.json"], ["--map", "m.csv"]]
)
def test_a_file_name_that_is_not_utf_8(run, robot_folder, options):
    names = [os.fsdecode(b"d\xff.csv"), os.fsdecode(b"r\xff.dh.toml"), os.fsdecode(b"o\xff.urdf")]
    shutil.copy("data.csv", names[0])
    shutil.copy("arm.dh.toml", names[1])
    err = stderr_of(run("calibrate", names[1], names[0], "-o", names[2], *options))
    assert r"wrote urdf: o\udcff.urdf" in err
    assert Path(names[2]).read_bytes().startswith(b"<?xml")
    Path(options[1]).read_text(encoding="utf-8")
    assert run("view", names[1], names[2], "--html", "v.html")[0] == 0
    assert run("simulate", names[1], "-m", "5", "-o", "s.csv")[0] == 0


def test_names_that_a_spreadsheet_or_a_browser_would_execute(run, robot_folder):
    """The name of a job in the summary, and the name of a file in the report."""
    shutil.copy("data.csv", "<script>alert(1)<")
    Path("a.fleet.toml").write_text(
        '[[job]]\nname = "=cmd|\' /C calc\'!A0"\nrobot = "arm.urdf"\ndata = "<script>alert(1)<"\n'
        'output = "o.urdf"\nreport = "r.md"\n'
    )
    assert run("calibrate", "a.fleet.toml", "-o", "s.csv")[0] == 0
    assert Path("s.csv").read_text().splitlines()[1].startswith("'=cmd|' /C calc'!A0,")
    report = Path("r.md").read_text()
    assert r"\<script\>" in report or "&lt;script" in report
    assert "<script" not in report.replace(r"\<script", "")


def test_names_of_joints_that_a_browser_would_execute(run, robot_folder):
    """A joint may be called `<b>`; no page takes its name for markup, and every file is read again."""
    names = ["<b>", "<script>alert(1)</script>", "</script><img src=x onerror=alert(1)>"]
    joints = [f"[[joint]]\nname = '{name}'\ntheta = 0\nd = 0.3\na = 0.2\nalpha = 1.0\n" for name in names]
    units = '[units]\nlength = "m"\nangle = "rad"\n'
    Path("b.dh.toml").write_text(f'convention = "standard"\n{units}' + "".join(joints))
    assert run("simulate", "b.dh.toml", "-m", "20", "--errors", "1mm,1mrad", "-o", "b.csv")[0] == 0
    outputs = [
        "-o",
        "b.urdf",
        "--report",
        "b.html",
        "--scene",
        "s.html",
        "--residuals",
        "r.csv",
        "--json",
        "b.json",
    ]
    assert run("calibrate", "b.dh.toml", "b.csv", "--parameters", "dh", *outputs)[0] == 0
    assert run("inspect", "b.csv", "--robot", "b.urdf")[0] == 0
    for page in ("b.html", "s.html"):
        text = Path(page).read_text(encoding="utf-8")
        assert "&lt;b&gt;" in text or r"\u003cb" in text.lower()
        assert not any(word in text for word in ("<script>alert", "<b>", "<img src=x"))


@pytest.mark.parametrize("name", ["a,b", "a;b", "a[b]", "#a", 'a"b', "a'b", "=1", "a\tb", " a"])
def test_names_of_joints_that_no_column_can_have(assert_refused, name):
    text = Path("arm.urdf").read_text().replace('"joint_1"', quoteattr(name))
    Path("arm.urdf").write_text(text)
    for words in (
        ("calibrate", "arm.urdf", "data.csv", "-o", "o.urdf"),
        ("inspect", "data.csv", "--robot", "arm.urdf"),
    ):
        assert_refused(["joint name", "rename the joint"], *words)
