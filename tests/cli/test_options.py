"""Help texts that list names from other packages, and types of options."""

from argparse import ArgumentTypeError

import pytest

from dhcal_pin.cli.main import build_parser
from dhcal_pin.cli.options import PLACEHOLDERS, IntegerType, expand_placeholders, robot_path, split_commas
from dhcal_pin.estimation import LOSSES, PARAMETER_SETS, Loss
from dhcal_pin.estimation.parameters import EXTENSIONS
from dhcal_pin.io import FORMATS
from dhcal_pin.measurements import KINDS
from dhcal_pin.planning import CRITERIA, plannable_kinds

NAMES = {
    "correction_formats": [".cfx"],
    "criteria": CRITERIA,
    "error_families": EXTENSIONS,
    "kinds": KINDS,
    "losses": LOSSES,
    "parameter_sets": PARAMETER_SETS,
    "plannable_kinds": plannable_kinds(),
    "robot_formats": [".urdf", ".dh.toml", ".dh.csv", ".yaml", ".xml"],
    "shipped_studies": ["figure3", "figure4", "ur10_poses"],
    "written_formats": [end for each in FORMATS if each.convert for end in each.endings],
}


@pytest.mark.parametrize("placeholder", PLACEHOLDERS)
def test_placeholder_lists_all_names(placeholder):
    text = expand_placeholders(f"{{{placeholder}}}")
    assert [name for name in NAMES[placeholder] if name not in text] == []


def test_new_loss_appears_in_the_help(run, monkeypatch):
    monkeypatch.setitem(LOSSES, "welsch", Loss(("uniform",), "weights of 100 % at zero"))
    status, out, _ = run("calibrate", "--help")
    assert status == 0
    assert "welsch (weights of 100 % at zero)" in " ".join(out.split())


def test_integer_type():
    positive = IntegerType(1)
    assert positive("7") == 7
    for text in ("0", "-1", "1.5", "many", "", str(2**63)):
        with pytest.raises(ArgumentTypeError, match="expected an integer of at least 1"):
            positive(text)


def test_split_commas():
    assert split_commas(" a, b,,c ") == ["a", "b", "c"]
    assert split_commas("") == []


@pytest.mark.parametrize(
    "words",
    [
        "calibrate a.urdf --tip t 1.csv 2.csv -o o.urdf",
        "calibrate a.urdf 1.csv --tip t 2.csv -o o.urdf",
        "validate a.urdf 1.csv --tip t 2.csv",
        "recheck a.urdf --tip t 1.csv 2.csv",
        "inspect 1.csv --robot a.urdf 2.csv --tip t",
    ],
)
def test_options_may_stand_between_names_of_files(words):
    found = build_parser().parse_args(words.split())
    assert (found.robot, found.tip, found.data) == ("a.urdf", "t", ["1.csv", "2.csv"])


@pytest.mark.parametrize(
    "words",
    [
        "calibrate a.urdf 1.csv -o o.urdf",
        "inspect 1.csv --robot a.urdf",
        "validate a.urdf 1.csv",
        "recheck a.urdf 1.csv",
        "plan a.urdf -n 9 -o p.csv --data 1.csv",
        "view a.urdf --data 1.csv",
    ],
)
def test_options_of_measurement_files_have_the_same_names_everywhere(words):
    options = "--columns m.toml --sheet Data --servos s.toml --skip-bad-rows"
    found = build_parser().parse_args([*words.split(), *options.split()])
    assert (found.data, found.columns, found.sheet) == (["1.csv"], "m.toml", "Data")
    assert (found.servos, found.skip_bad_rows) == ("s.toml", True)


@pytest.mark.parametrize("words", ["export a.urdf b.urdf -o m.h", "validate a.urdf 1.csv --tipp t 2.csv"])
def test_words_without_a_meaning_are_refused(words, capsys):
    with pytest.raises(SystemExit):
        build_parser().parse_args(words.split())
    err = capsys.readouterr().err
    assert "unrecognized arguments" in err
    assert err.endswith(f"; see dhcal {words.split()[0]} --help\n")


def test_a_robot_that_ships_is_named(tmp_path, monkeypatch, capsys):
    """A file of this name in the folder is taken without a message."""
    monkeypatch.chdir(tmp_path)
    path = robot_path("flange.urdf")
    line = f"flange.urdf is not in this folder; the file that ships with dhcal is used: {path}\n"
    assert capsys.readouterr().err == line
    (tmp_path / "flange.urdf").touch()
    assert robot_path("flange.urdf") == "flange.urdf"
    assert robot_path("example:ur10").endswith("ur10_robot.urdf")
    assert capsys.readouterr().err == ""
