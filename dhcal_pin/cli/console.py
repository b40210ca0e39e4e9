"""What the command line shows a person: tables and progress on stderr, plain where it is no terminal."""

from __future__ import annotations

import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import Progress as Bar
from rich.table import Table as Grid
from rich.text import Text

from ..calibration.evaluation import GROUP_UNITS, Accuracy
from ..calibration.model_selection import FamilyTrial, trial_table
from ..calibration.result import Result
from ..calibration.summary import (
    GROUP_LABELS,
    STATISTIC_LABELS,
    accuracy_table,
    estimate_table,
    headline,
    regressions,
)
from ..diagnostics.reachability import UnreachableRow
from ..estimation.solver import Progress
from ..formatting import Table, format_quantity

if TYPE_CHECKING:
    from ..paper.jacobian_check import Agreement


def _console() -> Console:
    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        # A file or a pipe has no width of its own: never fold a table there.
        console.width = 140
    return console


def print_table(title: str, content: Table) -> None:
    """A table under its title."""
    console = _console()
    out = Grid(header_style="bold", box=None, pad_edge=False)
    for i, name in enumerate(content.header):
        out.add_column(name, justify="left" if i < content.n_text_columns else "right")
    for row in content.rows:
        out.add_row(*map(Text, row))
    console.print()
    # Not the table's own title, which would be folded to the table's width.
    console.print(Text(title, style="bold"), soft_wrap=True)
    console.print(out)


def print_lines(*texts: str, style: str = "") -> None:
    """Plain sentences."""
    console = _console()
    for text in texts:
        console.print(Text(text, style=style), soft_wrap=True)


@contextmanager
def show_progress(title: str) -> Iterator[Progress | None]:
    """A status line while a loop runs; nothing where stderr is not a terminal."""
    console = _console()
    if not console.is_terminal:
        yield None
        return
    with console.status(title) as status:
        yield lambda iteration, cost: status.update(f"{title}: iteration {iteration}, cost {cost:.6g}")


@contextmanager
def progress_bar(title: str, total: int, done: int = 0) -> Iterator[Callable[[int], None]]:
    """A bar for so many pieces of work, told how many are done; nothing where it is no terminal."""
    console = _console()
    with Bar(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=total, completed=done)
        yield lambda count: bar.update(task, completed=count)


def print_unreachable_rows(path: str, found: Sequence[UnreachableRow]) -> None:
    """Impossible rows, one line each."""
    for finding in found:
        print_lines(f"{path}: row {finding.row} is left out: {finding.reason}", style="yellow")


def print_warnings(path: str, texts: Sequence[str]) -> None:
    """What is hard to believe in a file, one line each."""
    for text in texts:
        print_lines(f"{path}: warning: {text}", style="yellow")


def print_outliers(path: str, rows: Sequence[int], aside: Sequence[int]) -> None:
    """Gross errors, on a line those that take no part in the fit, on another those that do."""
    left, others = [row for row in rows if row in aside], [row for row in rows if row not in aside]
    for some, hint in (
        (left, "no part in the fit"),
        (others, "part in the fit; --loss tukey would leave out such"),
    ):
        listed = ", ".join(map(str, some[:12])) + (f" and {len(some) - 12} more" if len(some) > 12 else "")
        if len(some) == 1:
            print_lines(f"{path}: a gross error, row {listed}: takes {hint}", style="yellow")
        elif some:
            print_lines(f"{path}: {len(some)} gross errors, rows {listed}: take {hint}", style="yellow")


def print_notes(texts: Sequence[str]) -> None:
    """Remarks on a conversion."""
    print_lines(*(f"note: {text}" for text in texts))


def print_crosscheck(robot: str, rows: Sequence[Agreement]) -> None:
    """The routes of `dhcal check` against the paper's factors."""
    cells = [
        [
            row.route,
            str(row.columns) if row.columns else "",
            f"{row.difference:.1e}",
            f"{row.tolerance:.0e}",
            "agrees" if row.agrees else "DISAGREES",
        ]
        for row in rows
    ]
    header = ["route", "columns", "difference", "allowed", "verdict"]
    print_table(f"{robot}: largest difference from the paper's factors (m, rad)", Table(header, cells))


def print_summary(fit: Result, files: Mapping[str, str]) -> None:
    """Parameters, accuracy, what could not be seen, and where it all is."""
    print_table("parameters", estimate_table(fit.estimates))
    print_table("accuracy", accuracy_table(fit.comparisons))
    state = "converged" if fit.converged else "NOT converged"
    print_lines(
        "",
        f"{state} after {fit.iterations} iterations; {fit.n_samples} samples; "
        f"rank {fit.rank} of {len(fit.parameters)}; condition {fit.condition:.3g}",
    )
    for text in fit.shrinkage_notes:
        print_lines(f"held back: {text}", style="yellow")
    for text in fit.unobservable:
        print_lines(f"not observable: {text}", style="yellow")
    for text in fit.weakly_observable:
        print_lines(f"weakly seen: {text}", style="yellow")
    for name, path in files.items():
        print_lines(f"wrote {name}: {path}")


def print_verdict(fit: Result) -> None:
    """The headline: last, where the eye is."""
    print_lines(*regressions(fit.comparisons), style="yellow")
    print_lines("", headline(fit.comparisons).text, style="bold")


def print_trials(found: Sequence[FamilyTrial]) -> None:
    """What each family of joints' transmission errors brought, or would bring."""
    if not found:
        return
    title = "extensions: error on left-out regions of joint space, in standard deviations"
    print_table(title, trial_table(found))


def print_hint(text: str) -> None:
    """What one might try next, if anything."""
    if text:
        print_lines(f"hint: {text}", style="yellow")


def open_page(path: str) -> None:
    """Shows a page in the browser, or says where it lies."""
    open_url(Path(path).resolve().as_uri())


def open_url(url: str) -> None:
    """Shows an address in the browser, or says it."""
    if not webbrowser.open(url):
        print_lines(f"no browser here; open {url}")


def print_validation(title: str, found: Mapping[str, Accuracy]) -> None:
    """Accuracies of a model on data, by what was done before."""
    rows = []
    for group in GROUP_UNITS:
        measured = [one.groups[group] for one in found.values() if group in one.groups]
        for key, word in STATISTIC_LABELS.items():
            cells = [
                format_quantity(getattr(one, key), one.unit, one.rms_std, small=True) for one in measured
            ]
            rows += [[f"{GROUP_LABELS[group]}, {word}", *cells]] if cells else []
    print_table(title, Table(["error", *found], rows))
