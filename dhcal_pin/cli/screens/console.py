"""Console output of the commands on stderr: screens, sentences and progress.

Output has colours and progress on a terminal, and is plain text in files and pipes. This is the only module
that uses rich.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ..._typing import Progress
from ...messages import escape_control_characters
from .screen import Line, Screen, Verbosity
from .streams import print_message

if TYPE_CHECKING:
    from rich.console import Console


def _terminal() -> Console | None:
    """Return the terminal of stderr, None if it is a file or a pipe."""
    if not ((sys.stderr and sys.stderr.isatty()) or os.environ.get("FORCE_COLOR")):
        return None
    from rich.console import Console  # lazy import, as the following: only on a terminal

    console = Console(stderr=True, highlight=False)
    return console if console.is_terminal else None


def _print(terminal: Console | None, lines: Sequence[Line]) -> None:
    """Print lines as they are."""
    if terminal is None:
        if lines:
            print_message("\n".join(line.text for line in lines))
        return
    from rich.text import Text

    for line in lines:
        terminal.print(Text(line.text, style=line.style), soft_wrap=True)


def show(screen: Screen, verbosity: Verbosity) -> None:
    """Print the result of a command, as wide as the terminal, and not folded in files and pipes."""
    terminal = _terminal()
    _print(terminal, screen.lines(verbosity, terminal and terminal.width))


def print_lines(*texts: str, style: str = "") -> None:
    """Print sentences."""
    _print(_terminal(), [Line(escape_control_characters(text), style) for text in texts])


@contextmanager
def show_progress(title: str) -> Iterator[Progress | None]:
    """Show the phase of the work in a status line."""
    terminal = _terminal()
    if terminal is None:
        yield None
        return
    from rich.live import Live
    from rich.spinner import Spinner
    from rich.text import Text

    spinner = Spinner("dots", Text(escape_control_characters(title)), style="status.spinner")

    def update(phase: str, step: int, total: int) -> None:
        spinner.update(text=Text(escape_control_characters(f"{phase} {step}/{total}")))

    with Live(spinner, console=terminal, transient=True, redirect_stdout=_is_on_terminal()):
        yield update


def _is_on_terminal() -> bool:
    """Return whether standard output is a terminal; else nothing may change what is written to it."""
    return sys.stdout is not None and sys.stdout.isatty()


def print_progress(phase: str, step: int, total: int) -> None:
    """Print the phase of the work as a line for a program, such as `progress: robust weights 3/30`."""
    print_lines(f"progress: {phase} {step}/{total}")


@contextmanager
def progress_bar(title: str, total: int, n_done: int = 0) -> Iterator[Callable[[int], None]]:
    """Show a progress bar; nothing is shown if stderr is not a terminal."""
    terminal = _terminal()
    if terminal is None:
        # A disabled bar of older versions of rich prints an empty line.
        yield lambda count: None
        return
    from rich.markup import escape
    from rich.progress import Progress as ProgressBar

    with ProgressBar(console=terminal, redirect_stdout=_is_on_terminal()) as bar:
        # The bar reads markup such as [bold] in its description.
        task = bar.add_task(escape(escape_control_characters(title)), total=total, completed=n_done)
        yield lambda count: bar.update(task, completed=count)


def open_page(path: str) -> None:
    """Open a page in the browser; without a browser print its address."""
    open_url(Path(path).resolve().as_uri())


def open_url(url: str) -> None:
    """Open an address in the browser; without a browser print it."""
    import webbrowser  # lazy import: only for pages

    if not webbrowser.open(url):
        print_lines(f"no browser found; open {url}")
