"""What the command line shows a person: tables and progress on stderr, plain where it is no terminal."""

from __future__ import annotations

import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import Progress as Bar
from rich.table import Table as Grid
from rich.text import Text

from ..calibration.evaluation import ENDINGS
from ..calibration.model_selection import Trial, trial_table
from ..calibration.result import Result
from ..calibration.summary import (
    MEASURES,
    WORDS,
    accuracy_table,
    estimate_table,
    headline,
    setbacks,
)
from ..diagnostics.reachability import Finding
from ..estimation.solver import Progress
from ..formatting import Table, shown

if TYPE_CHECKING:
    from ..paper.jacobian_check import Agreement


def _console() -> Console:
    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        # A file or a pipe has no width of its own: never fold a table there.
        console.width = 140
    return console


def table(title: str, content: Table) -> None:
    """A table under its title."""
    console = _console()
    out = Grid(header_style="bold", box=None, pad_edge=False)
    for i, name in enumerate(content.header):
        out.add_column(name, justify="left" if i < content.texts else "right")
    for row in content.rows:
        out.add_row(*map(Text, row))
    console.print()
    # Not the table's own title, which would be folded to the table's width.
    console.print(Text(title, style="bold"), soft_wrap=True)
    console.print(out)


def lines(*texts: str, style: str = "") -> None:
    """Plain sentences."""
    console = _console()
    for text in texts:
        console.print(Text(text, style=style), soft_wrap=True)


@contextmanager
def progress(title: str) -> Iterator[Progress | None]:
    """A status line while a loop runs; nothing where stderr is not a terminal."""
    console = _console()
    if not console.is_terminal:
        yield None
        return
    with console.status(title) as status:
        yield lambda iteration, cost: status.update(f"{title}: iteration {iteration}, cost {cost:.6g}")


@contextmanager
def counted(title: str, total: int, done: int = 0) -> Iterator[Callable[[int], None]]:
    """A bar for so many pieces of work, told how many are done; nothing where it is no terminal."""
    console = _console()
    with Bar(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=total, completed=done)
        yield lambda count: bar.update(task, completed=count)


def findings(path: str, found: Sequence[Finding]) -> None:
    """Impossible rows, one line each."""
    for finding in found:
        lines(f"{path}: row {finding.row} is left out: {finding.reason}", style="yellow")


def doubts(path: str, texts: Sequence[str]) -> None:
    """What is hard to believe in a file, one line each."""
    for text in texts:
        lines(f"{path}: check: {text}", style="yellow")


def gross(path: str, rows: Sequence[int], aside: Sequence[int]) -> None:
    """Gross errors, on a line those that take no part in the fit, on another those that do."""
    left, others = [row for row in rows if row in aside], [row for row in rows if row not in aside]
    for some, hint in (
        (left, "no part in the fit"),
        (others, "part in the fit; --loss tukey would leave out such"),
    ):
        listed = ", ".join(map(str, some[:12])) + (f" and {len(some) - 12} more" if len(some) > 12 else "")
        if len(some) == 1:
            lines(f"{path}: a gross error, row {listed}: takes {hint}", style="yellow")
        elif some:
            lines(f"{path}: {len(some)} gross errors, rows {listed}: take {hint}", style="yellow")


def notes(texts: Sequence[str]) -> None:
    """Remarks on a conversion."""
    lines(*(f"note: {text}" for text in texts))


def agreement(robot: str, rows: Sequence[Agreement]) -> None:
    """The routes of `dhcal check` against the paper's factors."""
    cells = [
        [
            row.route,
            str(row.columns) if row.columns else "",
            f"{row.difference:.1e}",
            f"{row.allowed:.0e}",
            "agrees" if row.holds else "DISAGREES",
        ]
        for row in rows
    ]
    header = ["route", "columns", "difference", "allowed", "verdict"]
    table(f"{robot}: largest difference from the paper's factors (m, rad)", Table(header, cells))


def summary(fit: Result, files: Mapping[str, str]) -> None:
    """Parameters, accuracy, what could not be seen, and where it all is."""
    table("parameters", estimate_table(fit.estimates))
    table("accuracy", accuracy_table(fit.comparisons))
    state = "converged" if fit.converged else "NOT converged"
    lines(
        "",
        f"{state} after {fit.iterations} iterations; {fit.samples} samples; "
        f"rank {fit.rank} of {len(fit.parameters)}; condition {fit.condition:.3g}",
    )
    for text in fit.held_back:
        lines(f"held back: {text}", style="yellow")
    for text in fit.unobservable:
        lines(f"not observable: {text}", style="yellow")
    for text in fit.weakly_seen:
        lines(f"weakly seen: {text}", style="yellow")
    for name, path in files.items():
        lines(f"wrote {name}: {path}")


def verdict(fit: Result) -> None:
    """The headline: last, where the eye is."""
    lines(*setbacks(fit.comparisons), style="yellow")
    lines("", headline(fit.comparisons).text, style="bold")


def trials(found: Sequence[Trial]) -> None:
    """What each family of joints' transmission errors brought, or would bring."""
    if not found:
        return
    title = "extensions: error on left-out regions of joint space, in standard deviations"
    table(title, trial_table(found))


def hint(text: str) -> None:
    """What one might try next, if anything."""
    if text:
        lines(f"hint: {text}", style="yellow")


def open_page(path: str) -> None:
    """Shows a page in the browser, or says where it lies."""
    open_url(Path(path).resolve().as_uri())


def open_url(url: str) -> None:
    """Shows an address in the browser, or says it."""
    if not webbrowser.open(url):
        lines(f"no browser here; open {url}")


def validation(title: str, found: Mapping[str, Mapping[str, Any]]) -> None:
    """Accuracies of a model on data, by what was done before."""
    rows = []
    for group, end in ENDINGS.items():
        for key, word in MEASURES.items():
            name, spread = f"{group}_{key}{end}", f"{group}_rms_std{end}"
            cells = [
                shown(one[name], end.strip("_") or "m", one[spread], small=True)
                for one in found.values()
                if name in one
            ]
            rows += [[f"{WORDS[group]}, {word}", *cells]] if cells else []
    table(title, Table(["error", *found], rows))
