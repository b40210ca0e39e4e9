"""Commands of the README, as they are printed."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from robots import ROOT

from dhcal_pin.cli import main


def test_commands_of_the_readme_run_one_after_another(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "README.md").read_text()
    blocks = re.findall(r"^ *```sh\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)
    commands = [line.strip() for block in blocks for line in block.splitlines()]
    run = [shlex.split(command)[1:] for command in commands if command.startswith("dhcal ")]
    assert {"convert", "simulate", "calibrate"} <= {words[0] for words in run}
    for words in run:
        assert main.main(words) == 0, capsys.readouterr().err
    assert Path("report.html").stat().st_size > 1e5
