"""Pages of the command line, written from the parsers of the commands before the build starts."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

from dhcal_pin.cli.main import COMMANDS, command_parsers
from dhcal_pin.cli.options import expand_placeholders

_FOLDER = Path("reference/cli")
_EXIT_STATUS = """\
Exit status
-----------

=====  ==========================================================================================
0      done
1      a check disagrees, or a robot of a fleet failed or was refused
2      the input is wrong: one line on stderr names file, line or column, the problem and what is expected;
       nothing is written
3      the calibration is refused and no robot is written; with ``--force`` the robot is written and the
       status is 0, with ``--force --strict`` it is written and the status is 3
4      with ``--strict``: the robot is written with the verdict caution
130    interrupted; the message says which files are written
=====  ==========================================================================================
"""


def _option(action: argparse.Action, parser: argparse.ArgumentParser) -> list[str]:
    """Describe one option or positional argument."""
    help_text = expand_placeholders(action.help or "") % _help_values(action, parser)
    help_text = help_text.replace("*", r"\*").replace("`", "``").replace("|", r"\|")
    names = ", ".join(_signature(action, name) for name in action.option_strings)
    if not names:
        metavar = action.metavar or action.dest
        names = metavar if isinstance(metavar, str) else " ".join(metavar)
    return [f".. option:: {names}", "", f"   {help_text}", ""]


def _help_values(action: argparse.Action, parser: argparse.ArgumentParser) -> dict[str, Any]:
    return vars(action) | {"prog": parser.prog}


def _signature(action: argparse.Action, name: str) -> str:
    """Write an option with its value."""
    if action.nargs == 0:
        return name
    if action.choices:
        return f"{name} {{{','.join(map(str, action.choices))}}}"
    metavar = action.metavar or action.dest.upper()
    return f"{name} {metavar if isinstance(metavar, str) else ' '.join(metavar)}"


def _page(name: str, parser: argparse.ArgumentParser) -> list[str]:
    title = f"dhcal {name}"
    usage = parser.format_usage().removeprefix("usage: ").splitlines()
    example = (parser.epilog or "").removeprefix("example:").strip("\n").splitlines()
    lines = [title, "=" * len(title), "", parser.description or "", "", ".. code-block:: text", ""]
    lines += [*(f"   {line}" for line in usage), "", "Example:", "", ".. code-block:: text", ""]
    lines += [*(f"   {line.strip()}" for line in example), "", f".. program:: {title}", ""]
    for action in parser._actions:  # argparse has no public list
        if action.help != argparse.SUPPRESS:
            lines += _option(action, parser)
    return lines


def write_pages(app: Sphinx) -> None:
    """Write one page per command and their index."""
    folder = Path(app.srcdir) / _FOLDER
    folder.mkdir(exist_ok=True, parents=True)
    for name, parser in command_parsers().items():
        (folder / f"{name}.rst").write_text("\n".join(_page(name, parser)) + "\n", encoding="utf-8")
    table = [f"   * - :doc:`dhcal {name} <{name}>`\n     - {text}" for name, text in COMMANDS.items()]
    lines = [
        "Command line",
        "============",
        "",
        ".. list-table::",
        "   :widths: 25 75",
        "",
        *table,
        "",
        _EXIT_STATUS,
    ]
    lines += [".. toctree::", "   :hidden:", "", *(f"   {name}" for name in COMMANDS)]
    (folder / "index.rst").write_text("\n".join(lines) + "\n", encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension."""
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True}
