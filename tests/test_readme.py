"""Commands of the README, as they are printed."""

import re
import shlex
from pathlib import Path

from command_line import assert_shows
from robots import ROOT

from dhcal_pin.cli import main

TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.DOTALL | re.MULTILINE)


def test_commands_of_the_readme_run_one_after_another(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    commands = [line for block in blocks("sh") for line in block.splitlines()]
    run = [shlex.split(command)[1:] for command in commands if command.startswith("dhcal ")]
    assert {"convert", "simulate", "calibrate"} <= {words[0] for words in run}
    for words in run:
        capsys.readouterr()
        assert main.main(words) == 0, capsys.readouterr().err
    *_, measurements, result = blocks("text")
    assert_shows(measurements, Path("laser.csv").read_text().splitlines()[:3])
    assert_shows(result, capsys.readouterr().err.splitlines()[-2:])
    assert Path("report.html").stat().st_size > 1e5
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), {})


def test_links_of_the_readme_exist():
    links = re.findall(r"\]\(([^)#]+)\)", TEXT)
    assert len(links) > 20
    assert [link for link in links if not (ROOT / link).exists()] == []
