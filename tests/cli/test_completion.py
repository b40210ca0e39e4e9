"""Completion scripts, in the shells that are installed."""

import shutil
import subprocess

import pytest

from dhcal_pin.cli.commands.completion import SHELLS
from dhcal_pin.cli.main import COMMANDS

pytest.importorskip("shtab")


@pytest.mark.parametrize("shell", SHELLS)
def test_a_script_has_all_commands_and_no_placeholders(run, tmp_path, shell):
    status, out, err = run("completion", shell)
    assert (status, err) == (0, "")
    assert all(name in out for name in COMMANDS)
    assert "--holdout" in out or "holdout" in out
    assert "{error_families}" not in out
    assert "%(default)" not in out
    if program := shutil.which(shell):
        (tmp_path / "script").write_text(out)
        subprocess.run([program, "-n", tmp_path / "script"], check=True)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("cali", "calibrate"),
        ("calibrate --hold", "--holdout"),
        ("calibrate --method l", "lm"),
        ("calibrate ar", "arm.urdf"),
    ],
)
def test_bash_completes_words(run, tmp_path, monkeypatch, words, expected):
    if not shutil.which("bash"):
        pytest.skip("bash is not installed")
    (tmp_path / "script").write_text(run("completion", "bash")[1])
    (tmp_path / "arm.urdf").touch()
    monkeypatch.chdir(tmp_path)
    typed = ["dhcal", *words.split()]
    name = "$(complete -p dhcal | sed 's/.*-F \\([^ ]*\\).*/\\1/')"
    script = (
        f"source ./script; COMP_WORDS=({' '.join(typed)}); COMP_CWORD={len(typed) - 1}; "
        f'{name} dhcal "{typed[-1]}" "{typed[-2]}"; echo "${{COMPREPLY[@]}}"'
    )
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    assert expected in done.stdout.split(), done.stderr
