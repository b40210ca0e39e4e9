"""Console output of the commands: tables, sentences and progress on stderr.

Output has colours and progress bars on a terminal, and is plain text in files and pipes. This is the only
module that uses rich.
"""

from __future__ import annotations

import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress as ProgressBar
from rich.table import Table as ConsoleTable
from rich.text import Text

from ..calibration.evaluation import GROUP_UNITS, Accuracy
from ..calibration.model_selection import Extension
from ..calibration.result import Result
from ..calibration.summary import (
    GROUP_LABELS,
    STATISTIC_LABELS,
    accuracy_table,
    estimate_table,
    generalization_lines,
    headline,
    regressions,
)
from ..calibration.verdict import Verdict
from ..diagnostics.inspection import FileInspection, column_table
from ..diagnostics.reachability import UnreachableRow
from ..estimation.solver import Progress
from ..formatting import Table, format_quantity
from ..identifiability import label_unobservable
from ..io.tables import format_lines
from ..messages import escape_control_characters

if TYPE_CHECKING:
    from .._typing import Array
    from ..compensation import Compensation
    from ..io import TargetPoses
    from ..paper.jacobian_check import Agreement
    from ..planning import Plan
    from ..robot import Chain
    from ..studies import StudyGrid

# Longest list of rows in a sentence; the files that are written contain all of them.
MAX_LISTED_ROWS = 12

# Reasons why rows cannot be used that are listed; the JSON document has all of them.
MAX_LISTED_REASONS = 5

# Width of tables in files and pipes, in characters: wide enough not to fold them.
_FILE_WIDTH = 140


# --- basic output ----------------------------------------------------------------------------------


def _console() -> Console:
    """Create a console on stderr."""
    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        console.width = _FILE_WIDTH
    return console


def _text(text: str, style: str = "") -> Text:
    """Create a text; names and labels of files in it cannot control the terminal."""
    return Text(escape_control_characters(text), style=style)


def print_table(title: str, content: Table) -> None:
    """Print a table under its title.

    Args:
        title: Title.
        content: Table.
    """
    console = _console()
    table = ConsoleTable(header_style="bold", box=None, pad_edge=False)
    for i, name in enumerate(content.header):
        table.add_column(_text(name), justify="left" if i < content.n_text_columns else "right")
    for row in content.rows:
        table.add_row(*map(_text, row))
    console.print()
    # The title of a rich table would be folded to the width of the table.
    console.print(_text(title, "bold"), soft_wrap=True)
    console.print(table)


def print_lines(*texts: str, style: str = "") -> None:
    """Print sentences, one per line.

    Args:
        *texts: Sentences.
        style: Style of rich, such as "yellow" or "bold".
    """
    console = _console()
    for text in texts:
        console.print(_text(text, style), soft_wrap=True)


def print_notes(texts: Sequence[str]) -> None:
    """Print notes on a result.

    Args:
        texts: Notes.
    """
    print_lines(*(f"note: {text}" for text in texts))


def print_warnings(path: str, texts: Sequence[str]) -> None:
    """Print warnings about a file, one line each.

    Args:
        path: Path of the file.
        texts: Warnings.
    """
    for text in texts:
        print_lines(f"{path}: warning: {text}", style="yellow")


def print_hint(text: str) -> None:
    """Print a suggestion.

    Args:
        text: Suggestion; nothing is printed if it is empty.
    """
    if text:
        print_lines(f"hint: {text}", style="yellow")


def _listed(items: Sequence[object]) -> str:
    """Join the first items of a list and count the others."""
    text = ", ".join(map(str, items[:MAX_LISTED_ROWS]))
    return text + (f" and {len(items) - MAX_LISTED_ROWS} more" if len(items) > MAX_LISTED_ROWS else "")


@contextmanager
def show_progress(title: str) -> Iterator[Progress | None]:
    """Show the progress of a solver in a status line.

    Args:
        title: Description of the work.

    Yields:
        Callback with iteration and cost; None if stderr is not a terminal.
    """
    console = _console()
    if not console.is_terminal:
        yield None
        return
    with console.status(_text(title)) as status:
        yield lambda iteration, cost: status.update(_text(f"{title}: iteration {iteration}, cost {cost:.6g}"))


@contextmanager
def progress_bar(title: str, total: int, n_done: int = 0) -> Iterator[Callable[[int], None]]:
    """Show a progress bar; nothing is shown if stderr is not a terminal.

    Args:
        title: Description of the work.
        total: Number of tasks.
        n_done: Number of tasks that are already done.

    Yields:
        Callback with the number of tasks done.
    """
    console = _console()
    with ProgressBar(console=console, disable=not console.is_terminal) as bar:
        # The bar reads markup such as [bold] in its description.
        task = bar.add_task(escape(escape_control_characters(title)), total=total, completed=n_done)
        yield lambda count: bar.update(task, completed=count)


def open_page(path: str) -> None:
    """Open a page in the browser; without a browser print its address.

    Args:
        path: Path of the page.
    """
    open_url(Path(path).resolve().as_uri())


def open_url(url: str) -> None:
    """Open an address in the browser; without a browser print it.

    Args:
        url: Address.
    """
    if not webbrowser.open(url):
        print_lines(f"no browser found; open {url}")


# --- calibrate, validate ---------------------------------------------------------------------------


def print_unreachable_rows(path: str, unreachable: Sequence[UnreachableRow]) -> None:
    """Print the rows that are excluded because the robot cannot reach them.

    Args:
        path: Path of the measurement file.
        unreachable: Rows with the reason.
    """
    for item in unreachable:
        print_lines(f"{path}: line {item.row} is excluded: {item.reason}", style="yellow")


def print_outliers(path: str, rows: Sequence[int], rejected: Sequence[int]) -> None:
    """Print the outliers of a file: one line for those excluded from the fit, one for the others.

    Args:
        path: Path of the measurement file.
        rows: Lines of the outliers.
        rejected: Lines with zero weight in the fit.
    """
    excluded = [row for row in rows if row in rejected]
    included = [row for row in rows if row not in rejected]
    if excluded:
        print_lines(f"{path}: {_count_outliers(excluded)} excluded from the fit", style="yellow")
    if included:
        text = f"{path}: {_count_outliers(included)} kept in the fit; use --loss tukey to down-weight them"
        print_lines(text, style="yellow")


def _count_outliers(rows: Sequence[int]) -> str:
    """Count outliers and name their lines."""
    plural = "s" if len(rows) > 1 else ""
    return f"{len(rows)} outlier{plural} (line{plural} {_listed(rows)})"


def print_extension(extension: Extension | None) -> None:
    """Print what was added to the geometry, and how much the samples count.

    Args:
        extension: Families of joint errors and their effect; nothing is printed if none was tried.
    """
    for sentence in extension.sentences if extension else []:
        print_lines(sentence)


def print_summary(fit: Result, files: Mapping[str, str]) -> None:
    """Print parameters, accuracy, limits of the identification, and the files written.

    Args:
        fit: Result of a calibration.
        files: Paths of the files, by what they are.
    """
    print_table("parameters", estimate_table(fit.estimates))
    print_table("accuracy", accuracy_table(fit.comparisons))
    state = "converged" if fit.converged else "NOT converged"
    print_lines(
        "",
        f"{state} after {fit.iterations} iterations; {fit.n_samples} samples; "
        f"rank {fit.rank} of {len(fit.parameters)}; condition {fit.condition:.3g}",
    )
    print_lines(
        *fit.shrinkage_notes,
        *(label_unobservable(text) for text in fit.unobservable),
        *(f"poorly identified: {text}" for text in fit.weakly_observable),
        style="yellow",
    )
    print_lines(*(f"wrote {name}: {path}" for name, path in files.items()))


def print_headline(fit: Result) -> None:
    """Print the accuracy, and where it holds; called last, so that it stays visible in the terminal.

    Args:
        fit: Result of a calibration.
    """
    print_lines("", *generalization_lines(fit.generalization, fit.comparisons))
    print_lines(*regressions(fit.comparisons), style="yellow")
    print_lines("", headline(fit.comparisons).text, style="bold")


def print_verdict(verdict: Verdict, is_forced: bool) -> None:
    """Print the verdict and its reasons.

    Args:
        verdict: Verdict on a calibration.
        is_forced: Whether a refused robot is written.
    """
    style = {"ok": "green", "caution": "yellow", "refused": "red"}[verdict.status]
    if verdict.is_refused:
        outcome = "written because of --force" if is_forced else "no robot written; --force overrides"
        print_lines(f"verdict: refused ({outcome})", style=style)
    else:
        print_lines(f"verdict: {verdict.status}", style=style)
    print_lines(*(f"  {reason}" for reason in verdict.reasons), style=style)


def print_validation(title: str, accuracies: Mapping[str, Accuracy]) -> None:
    """Print the accuracy of a model.

    Args:
        title: Title.
        accuracies: Accuracy by the column that shows it.
    """
    rows = []
    for group in GROUP_UNITS:
        columns = [accuracy.groups[group] for accuracy in accuracies.values() if group in accuracy.groups]
        for key, label in STATISTIC_LABELS.items():
            cells = [
                format_quantity(getattr(column, key), column.unit, column.rms_std, small=True)
                for column in columns
            ]
            rows += [[f"{GROUP_LABELS[group]}, {label}", *cells]] if cells else []
    print_table(title, Table(["error", *accuracies], rows))


# --- inspect ---------------------------------------------------------------------------------------


def print_inspection(inspection: FileInspection) -> None:
    """Print what a measurement file contains.

    Args:
        inspection: Content of the file.
    """
    print_table(_inspection_title(inspection), column_table(inspection.columns))
    for column in inspection.columns:
        if column.counts and column.role != "ignored":
            texts = [f"{text} ({count} rows)" for text, count in column.counts.items()]
            print_lines(f"{column.name}: {_listed(texts)}")
    ignored = [column.name for column in inspection.columns if column.role == "ignored"]
    if len(ignored) == len(inspection.columns) and not inspection.problem:
        print_lines("No column is known. With --robot a column map is proposed.")
    elif ignored and not inspection.column_map:
        print_lines(f"not used: {', '.join(ignored)}")
    print_notes(inspection.notes)
    # With a robot, a warning names them.
    if inspection.repeated_lines and inspection.configurations is None:
        print_lines(f"lines equal to earlier ones: {format_lines(inspection.repeated_lines)}", style="yellow")
    if bad := inspection.bad_rows:
        rows = f"{len(bad)} row{'s' if len(bad) > 1 else ''} cannot be used"
        reasons = [f"  line {line}: {reason}" for line, reason in bad.items()]
        print_lines(f"{rows}, line{'s' if len(bad) > 1 else ''} {format_lines(bad)}:", style="yellow")
        print_lines(*reasons[:MAX_LISTED_REASONS], style="yellow")
    print_lines(*(f"warning: {text}" for text in inspection.warnings), style="yellow")
    if inspection.problem:
        print_lines(f"problem: {inspection.problem}", style="red")
    if inspection.column_map:
        print_lines("", "Lines of a column map (--columns); check columns and units:", *inspection.column_map)
    elif not (bad or inspection.warnings or inspection.problem or inspection.configurations is None):
        print_lines("No problems found.")


def _inspection_title(inspection: FileInspection) -> str:
    """Return the most important facts on a file in one line."""
    facts = [
        inspection.kind or "unknown kind",
        f"{inspection.rows} rows (lines {inspection.first_line}-{inspection.last_line})",
    ]
    if inspection.configurations is not None:
        facts.append(f"{inspection.configurations} configurations")
    return f"{inspection.path}: {', '.join([*facts, inspection.form])}"


# --- check, plan, compensate, study ----------------------------------------------------------------


def print_crosscheck(robot: str, agreements: Sequence[Agreement]) -> None:
    """Print how well other computations agree with the error factors of the paper.

    Args:
        robot: Path of the robot.
        agreements: One comparison per computation.
    """
    rows = [
        [
            agreement.route,
            str(agreement.columns) if agreement.columns else "",
            f"{agreement.difference:.1e}",
            f"{agreement.tolerance:.0e}",
            "agrees" if agreement.agrees else "DISAGREES",
        ]
        for agreement in agreements
    ]
    header = ["computation", "columns", "difference", "tolerance", "verdict"]
    print_table(
        f"{robot}: largest difference from the error factors of the paper [m, rad]", Table(header, rows)
    )


def print_plan(plan: Plan) -> None:
    """Print the predicted error over the number of poses, and how a plan compares with random poses.

    Args:
        plan: Plan.
    """
    sizes, count = plan.sizes.tolist(), len(plan.q)
    random_errors = dict(zip(plan.random_sizes.tolist(), plan.random_errors.tolist(), strict=True))
    selected = {*random_errors, count, sizes[-1]}
    selected |= {plan.recommended_size} if plan.recommended_size else set()
    rows = [
        [
            str(size),
            f"{1e3 * error:.4f}",
            f"{1e3 * random_errors[size]:.4f}" if size in random_errors else "",
        ]
        for size, error in zip(sizes, plan.errors.tolist(), strict=True)
        if size in selected
    ]
    table = Table(["poses", "planned, mm", "random, mm"], rows, n_text_columns=0)
    print_table("predicted RMS position error over the task", table)
    percent = round(100 * (1 - plan.relative_error))
    change = f"{abs(percent)} % {'lower' if percent > 0 else 'higher'}" if percent else "About the same"
    print_lines("", f"{change} predicted error {'than' if percent else 'as'} {count} random poses.")
    if plan.recommended_size:
        print_lines(f"Diminishing returns beyond {plan.recommended_size} poses (less than 1 % per ten).")
    else:
        print_lines(f"No diminishing returns up to {sizes[-1]} poses (still at least 1 % per ten).")
    if plan.curves:
        rows = [
            [str(one.n_poses), f"{100 * one.filled_share:.0f} %", f"{1e6 * one.curve_std:.0f}"]
            for one in plan.curves
        ]
        table = Table(["poses", "bins filled", "curve std, µrad"], rows, n_text_columns=0)
        print_table("joint correction curves, RMS of all joints", table)
    print_notes(plan.notes)


def print_compensation(result: Compensation, chain: Chain, targets: TargetPoses) -> None:
    """Print how many targets have which status, and the lines of those that are not corrected exactly.

    Args:
        result: Corrected targets.
        chain: Calibrated robot.
        targets: Targets as read.
    """
    from ..compensation import SINGULAR  # lazy import: only this command needs it

    for status in dict.fromkeys(result.status):
        rows = [row for row, other in enumerate(result.status) if other == status]
        text = f"{targets.source}: {len(rows)} of {len(result.status)} {status}"
        if status == "ok":
            print_lines(text)
            continue
        items = [
            f"line {targets.lines[row]}"
            if status == SINGULAR
            else f"line {targets.lines[row]} ({_distance(result.residual_error[row])} away)"
            for row in rows
        ]
        print_lines(f"{text}: {_listed(items)}", style="yellow")
    if chain.n_joints > 6:
        print_notes(
            [
                f"{chain.n_joints} joints reach a target in many ways, and the corrected targets hold only "
                "for these joint values; send the joint values to the controller"
            ]
        )
    elif chain.n_joints < 6 and targets.values.ndim == 3 and not result.reached.all():
        print_notes(
            [f"{chain.n_joints} joints cannot reach every orientation; omit the orientation from the targets"]
        )


def _distance(error: Array) -> str:
    """Format a position and an orientation error, shape (2,) [m, rad]."""
    angle = np.rad2deg(error[1])
    return f"{1e3 * error[0]:.3g} mm" + (f", {angle:.3g}°" if angle > 0 else "")


def print_study(study: StudyGrid, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print the results of a study in mm and degrees, with the settings that differ.

    Args:
        study: Study.
        header: Names of the columns, the settings first.
        rows: Values of the columns, one row per setting.
    """
    from ..studies import Setting  # lazy import: only this command needs it

    n_settings = len(fields(Setting))
    varied = [i for i in range(n_settings) if len({row[i] for row in rows}) > 1]
    # The column behind the settings is the number of calibrations, which is in the title.
    known = [i for i in range(n_settings + 1, len(header)) if any(row[i] is not None for row in rows)]
    names = [name.replace("[m]", ", mm").replace("[rad]", ", °").replace("_", " ") for name in header]
    scales = [1e3 if "[m]" in name else np.rad2deg(1.0) if "[rad]" in name else 1.0 for name in header]
    cells = [
        [str(row[i]) for i in varied] + ["" if row[i] is None else f"{row[i] * scales[i]:.3g}" for i in known]
        for row in rows
    ]
    title = f"{study.title or 'study'}: medians over {study.seeds} calibrations per setting"
    print_table(title, Table([names[i] for i in (*varied, *known)], cells, n_text_columns=len(varied)))
