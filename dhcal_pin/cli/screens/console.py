"""Console output of the commands on stderr: screens, sentences and progress.

Output has colours and progress on a terminal, and is plain text in files and pipes. This is the only module
that uses rich.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.text import Text

from ..._typing import Progress
from ...messages import escape_control_characters
from .screen import Line, Screen, Verbosity


def _console() -> Console:
    """Create a console on stderr."""
    return Console(stderr=True, highlight=False)


def _print(console: Console, lines: Iterable[Line]) -> None:
    """Print lines as they are."""
    for line in lines:
        console.print(Text(line.text, style=line.style), soft_wrap=True)


def show(screen: Screen, verbosity: Verbosity) -> None:
    """Print the result of a command, as wide as the terminal, and not folded in files and pipes."""
    console = _console()
    width = console.width if console.is_terminal else None
    _print(console, screen.lines(verbosity, width))


def print_lines(*texts: str, style: str = "") -> None:
    """Print sentences."""
    _print(_console(), [Line(escape_control_characters(text), style) for text in texts])


@contextmanager
def show_progress(title: str) -> Iterator[Progress | None]:
    """Show the phase of the work in a status line."""
    console = _console()
    if not console.is_terminal:
        yield None
        return

    def update(phase: str, step: int, total: int) -> None:
        status.update(Text(escape_control_characters(f"{phase} {step}/{total}")))

    with console.status(Text(escape_control_characters(title))) as status:
        yield update


def print_progress(phase: str, step: int, total: int) -> None:
    """Print the phase of the work as a line for a program, such as `progress: robust weights 3/30`."""
    print_lines(f"progress: {phase} {step}/{total}")


@contextmanager
def progress_bar(title: str, total: int, n_done: int = 0) -> Iterator[Callable[[int], None]]:
    """Show a progress bar; nothing is shown if stderr is not a terminal."""
    console = _console()
    if not console.is_terminal:
        # A disabled bar of older versions of rich prints an empty line.
        yield lambda count: None
        return
    from rich.progress import Progress as ProgressBar  # lazy import: only on a terminal

    with ProgressBar(console=console) as bar:
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
