"""Options of a calibration job: declared once, used by the command line, by manifests and in reports."""

import shlex
from dataclasses import fields

import pytest

from dhcal_pin.cli import main
from dhcal_pin.cli.fleet import read_fleet
from dhcal_pin.cli.job import Job
from dhcal_pin.estimation import METHODS

# A value of each option that differs from its default, as in a manifest.
VALUES = {
    "robot": '"arm.urdf"',
    "data": '["a.csv", "b.csv"]',
    "output": '"out.urdf"',
    "tip": '"tool0"',
    "root": '"link0"',
    "package_dir": '["meshes", "more"]',
    "columns": '"map.toml"',
    "sheet": '"Data"',
    "rig": '"rig.toml"',
    "servos": '"servos.toml"',
    "skip_bad_rows": "true",
    "mend": '["sign:a", "rows:above"]',
    "parameters": '"dh"',
    "arm": '"low-cost"',
    "turned": '"none"',
    "extend": '"gain"',
    "fix": '"d2"',
    "free": '"d3"',
    "holdout": "0.3",
    "session": '"off"',
    "unordered": "true",
    "method": '"gn"',
    "loss": '"tukey"',
    "priors": '"none"',
    "bounds": '"bounds.toml"',
    "instrument": '"known.toml"',
    "payload": '"5kg"',
    "max_iterations": "7",
    "seed": "3",
    "in_place": "true",
    "world_joint": "true",
    "tool_frame": '"tcp"',
    "camera_frame": '"eye"',
    "camera_files": '"cam"',
    "force": "true",
    "map": '"map.csv"',
    "scene": '"scene.html"',
    "curves": '"curves.csv"',
    "residuals": '"residuals.csv"',
    "json": '"r.json"',
    "report": '["r.html", "r.md"]',
    "certificate": '"c.html"',
    "bundle": '"all.dhcal.zip"',
    "meta": '["meta.toml"]',
}
ARGUMENTS = (
    "calibrate arm.urdf a.csv b.csv -o out.urdf --tip tool0 --root link0 --package-dir meshes "
    "--package-dir more --columns map.toml --sheet Data --rig rig.toml --servos servos.toml "
    "--skip-bad-rows --mend sign:a --mend rows:above --parameters dh --arm low-cost --turned none "
    "--extend gain --fix d2 --free "
    "d3 --holdout 0.3 --session off --unordered --method gn "
    "--loss tukey "
    "--priors none --bounds bounds.toml --instrument known.toml --payload 5kg --max-iterations 7 --seed 3 "
    "--in-place --world-joint --tool-frame tcp --camera-frame eye --camera-files cam --force "
    "--report r.html --report r.md --certificate c.html --bundle all.dhcal.zip "
    "--meta meta.toml --json r.json "
    "--curves curves.csv --residuals residuals.csv --scene scene.html --map map.csv"
)


def job_of(command_line):
    return Job.from_args(main.build_parser().parse_args(shlex.split(command_line)))


def test_values_of_all_options_are_tested():
    assert [option.name for option in fields(Job)] == list(VALUES)
    defaults = Job("arm.urdf", (), "out.urdf")
    job = job_of(ARGUMENTS)
    assert all(getattr(job, name) != getattr(defaults, name) for name in list(VALUES)[3:])


def test_defaults_of_the_command_line_are_those_of_a_job():
    assert job_of("calibrate arm.urdf a.csv -o out.urdf") == Job("arm.urdf", ("a.csv",), "out.urdf")


@pytest.mark.parametrize("separator", ["-", "_"])
def test_manifest_has_the_options_of_the_command_line(tmp_path, separator):
    lines = [f"{name.replace('_', separator)} = {value}" for name, value in VALUES.items()]
    path = tmp_path / "cells.fleet.toml"
    path.write_text("\n".join(["[[job]]", *lines]))
    (entry,) = read_fleet(path)
    assert entry.job == job_of(ARGUMENTS)


def test_command_parses_to_the_same_job():
    job = job_of(ARGUMENTS)
    text = job.command({"arm.urdf": "robots/arm.urdf"})
    outputs = "-o out.urdf --in-place --report r.html --report r.md --json r.json --map map.csv "
    outputs += "--curves curves.csv --residuals residuals.csv --scene scene.html --camera-files cam "
    outputs += "--certificate c.html --bundle all.dhcal.zip --meta meta.toml"
    assert job_of(f"{text.replace('robots/', '').removeprefix('dhcal ')} {outputs}") == job
    flags = {"-o", "--in-place", "--report", "--json", "--curves", "--residuals", "--scene", "--map"}
    assert not flags & set(text.split())


def test_methods_are_those_of_the_solver():
    (method,) = (option for option in fields(Job) if option.name == "method")
    assert set(method.metadata["choices"]) == set(METHODS)
