"""Tables and figures of the pages on evidence, made from the JSON files of the benchmarks.

docs/evidence/leaderboard/*.json   tests/bench_public.py
docs/evidence/studies/*.json       tests/bench_studies.py
docs/evidence/tour/*.json          tests/bench_tour.py

They are written into docs/_build/evidence, from where the pages include them. The figures of the tour are
drawn by docs/evidence/tour.py, which calibrates the robot of the tour.
"""

from __future__ import annotations

import json
import runpy
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator
from sphinx.application import Sphinx

from dhcal_pin.plots import STUDY_COLORS, new_axes

# Programs in the order of the tables; files of other programs come after them.
_ORDER = ("nominal", "scipy", "pybotics", "figaroh", "dhcal_none", "dhcal")
_SPLITS = {
    "20": "20 poses",
    "50": "50 poses",
    "100": "100 poses",
    "halves": "half",
    "regions": "regions left out",
    "other": "other series",
}
_NO_VALUE = "–"


def pooled(cases: Sequence[dict], key: str) -> float | None:
    """Return the root of the mean square of a value over the cases, weighted by the judged rows."""
    values = [(case["judged"], case[key]) for case in cases if case.get(key) is not None]
    if not values:
        return None
    counts, errors = np.array(values).T
    return float(np.sqrt(np.average(errors**2, weights=counts)))


def read_leaderboard(folder: Path) -> dict[str, dict]:
    """Return the JSON documents by the names of their files, in the order of the tables."""
    names = {path.stem for path in folder.glob("*.json")}
    ordered = [name for name in _ORDER if name in names] + sorted(names - set(_ORDER))
    return {name: json.loads((folder / f"{name}.json").read_text(encoding="utf-8")) for name in ordered}


def alone(cases: Sequence[dict]) -> list[dict]:
    """Return the cases with the errors of the URDF alone."""
    return [case | case["urdf_alone"] for case in cases if "urdf_alone" in case]


def leaderboard_rows(programs: dict[str, dict]) -> list[tuple[str, dict]]:
    """Return title and series of each row: the programs, and those with more than a URDF also without."""
    rows = []
    for document in programs.values():
        title, series = f"{document['program']} {document['version']}", document["series"]
        rows.append((title, series))
        bare = {
            arm: {split: alone(cases) for split, cases in splits.items()} for arm, splits in series.items()
        }
        if any(cases for splits in bare.values() for cases in splits.values()):
            rows.append((f"{document['program']}, URDF alone", bare))
    return rows


def markdown_table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Write a table in Markdown."""
    lines = [list(header), *map(list, rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def cell(value: float | None, factor: float = 1e3, digits: int = 3) -> str:
    """Format a value in another unit; a dash if there is none."""
    return _NO_VALUE if value is None else f"{factor * value:.{digits}f}"


def leaderboard_tables(programs: dict[str, dict]) -> str:
    """Return a section per series: errors by split, and details of the halves."""
    rows = leaderboard_rows(programs)
    arms = list(dict.fromkeys(arm for _, series in rows for arm in series))
    parts = []
    for arm in arms:
        present = [(title, series[arm]) for title, series in rows if series.get(arm)]
        splits = [split for split in _SPLITS if any(found.get(split) for _, found in present)]
        parts += [f"### {arm}", "RMS position error [mm] by what was fitted:"]
        parts.append(
            markdown_table(
                ["program", *(_SPLITS[split] for split in splits)],
                (
                    [
                        title,
                        *(cell(pooled(found.get(split, []), "position_rms_m")) for split in splits),
                    ]
                    for title, found in present
                ),
            )
        )
        parts.append("Half of the poses fitted, the other half judged:")
        parts.append(
            markdown_table(
                [
                    "program",
                    "position, 95th percentile [mm]",
                    "orientation, RMS [mrad]",
                    "orientation, 95th percentile [mrad]",
                    "stated RMS [mm]",
                    "true / stated",
                    "processor time [s]",
                ],
                (_details(title, found["halves"]) for title, found in present if found.get("halves")),
            )
        )
    return "\n\n".join(parts) + "\n"


def _details(title: str, cases: list[dict]) -> list[str]:
    """Return the cells of one program on the halves."""
    keys = ("position_p95_m", "orientation_rms_rad", "orientation_p95_rad")
    is_alone = "urdf_alone" in cases[0] and title.endswith("URDF alone")
    stated = None if is_alone else pooled(cases, "stated_position_rms_m")
    rms = pooled(cases, "position_rms_m")
    seconds = None if is_alone else float(np.mean([case["seconds"] for case in cases]))
    return [
        title,
        *(cell(pooled(cases, key)) for key in keys),
        cell(stated),
        cell(rms / stated if stated and rms else None, 1, 2),
        cell(seconds, 1, 1),
    ]


def summary_table(programs: dict[str, dict]) -> str:
    """Return the table of the README: RMS position errors [mm] on rows that were not fitted."""
    dhcal = programs["dhcal"]["series"]
    header = ["arm", "nominal", "dhcal_pin", "URDF alone", "regions left out", "scipy", "figaroh", "pybotics"]
    rows = []
    for arm, splits in dhcal.items():
        halves = {
            name: document["series"].get(arm, {}).get("halves", []) for name, document in programs.items()
        }
        found = [
            halves["nominal"],
            halves["dhcal"],
            alone(halves["dhcal"]) or halves["dhcal"],
            splits.get("regions", []),
            *(halves.get(name, []) for name in ("scipy", "figaroh", "pybotics")),
        ]
        rows.append([arm, *(cell(pooled(cases, "position_rms_m"), digits=2) for cases in found)])
    return markdown_table(header, rows)


def draw_leaderboard(programs: dict[str, dict], folder: Path) -> None:
    """Draw the errors by split, and the true error over the stated one."""
    rows = leaderboard_rows(programs)
    arms = list(dict.fromkeys(arm for _, series in rows for arm in series))
    panels = new_axes(len(arms) + 1, (4.2, 3.2))
    panels[-1].set_axis_off()
    for arm, ax in zip(arms, panels, strict=False):
        splits = [split for split in _SPLITS if any(series.get(arm, {}).get(split) for _, series in rows)]
        for number, (title, series) in enumerate(rows):
            values = [pooled(series.get(arm, {}).get(split, []), "position_rms_m") for split in splits]
            y = [np.nan if value is None else 1e3 * value for value in values]
            ax.plot(range(len(splits)), y, **_style(number), label=title.replace("`", ""))
        ax.set(title=arm, ylabel="RMS position error [mm]", yscale="log")
        ax.set_xticks(range(len(splits)), [_SPLITS[split].replace(" ", "\n", 1) for split in splits])
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("{x:g}")
        ax.tick_params(axis="both", which="both", labelsize=7)
    handles, labels = panels[0].get_legend_handles_labels()
    panels[-1].legend(handles, labels, loc="center", frameon=False, fontsize="small")
    _save(panels[0], folder / "leaderboard.svg")
    (ax,) = new_axes(1, (6.4, 4.6))
    for number, document in enumerate(programs.values()):
        cases = [
            case
            for splits in document["series"].values()
            for split, found in splits.items()
            if split != "other"
            for case in found
            if case["stated_position_rms_m"]
        ]
        x, y = ([1e3 * case[key] for case in cases] for key in ("stated_position_rms_m", "position_rms_m"))
        style = _style(number) | {"linestyle": ""}
        ax.plot(x, y, **style, label=document["program"].replace("`", ""))
    limits = np.array([0.04, 12])
    ax.plot(limits, limits, color="#51606e", linewidth=0.8)
    ax.set(xlabel="stated RMS position error [mm]", ylabel="true RMS position error [mm]")
    ax.set(xscale="log", yscale="log", xlim=limits, ylim=limits)
    ax.legend(frameon=False, fontsize="small", loc="upper left")
    _save(ax, folder / "stated.svg")


def _style(number: int) -> dict[str, Any]:
    """Return colour and marker of one line."""
    markers = "osD^vPX<>"
    return {
        "color": STUDY_COLORS[number % len(STUDY_COLORS)],
        "marker": markers[number % len(markers)],
        "markersize": 4,
        "linewidth": 1,
    }


def _save(ax: Axes, path: Path) -> None:
    """Write the figure as SVG, the same bytes for the same data."""
    with mpl.rc_context({"svg.hashsalt": "dhcal"}):
        ax.figure.savefig(path, metadata={"Date": None})


_STUDY_AXES = {
    "poses": "measured poses",
    "planned": "measured poses",
    "spread": "covered part of each joint range",
    "reflectors": "measured poses",
}


def study_lines(rows: Sequence[dict], key: str) -> dict[str, dict[float, list[float]]]:
    """Return the values of all arms by line and abscissa."""
    lines: dict[str, dict[float, list[float]]] = {}
    for row in rows:
        lines.setdefault(row["line"], {}).setdefault(row["value"], []).append(row[key])
    return lines


def study_table(rows: Sequence[dict], title: str) -> str:
    """Return the median over the arms and their range, in mm, and the largest 90 % quantile."""
    medians, high = study_lines(rows, "median_m"), study_lines(rows, "p90_m")
    values = list(dict.fromkeys(row["value"] for row in rows))
    body = []
    for value in values:
        texts = []
        for line, found in medians.items():
            arms = 1e3 * np.array(found[value])
            most = 1e3 * max(high[line][value])
            texts.append(f"{np.median(arms):.3f} ({arms.min():.3f} to {arms.max():.3f}; {most:.3f})")
        body.append([f"{value:g}", *texts])
    return markdown_table([title, *medians], body) + "\n"


def draw_study(rows: Sequence[dict], title: str, path: Path) -> None:
    """Draw the median of the arms as a line and their range as a band."""
    (ax,) = new_axes(1, (6.4, 4.0))
    for number, (line, found) in enumerate(study_lines(rows, "median_m").items()):
        x = np.array(list(found))
        y = 1e3 * np.array(list(found.values()))
        style = _style(number)
        ax.plot(x, np.median(y, 1), **style, label=line)
        ax.fill_between(x, y.min(1), y.max(1), color=style["color"], alpha=0.15, linewidth=0)
    ax.set(xlabel=title, ylabel="RMS position error [mm]", xscale="log", yscale="log")
    ax.set_xticks(x, [f"{value:g}" for value in x])
    ax.minorticks_off()
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.legend(frameon=False, fontsize="small")
    _save(ax, path)


def write_evidence(app: Sphinx) -> None:
    """Write tables and figures before the pages are read."""
    source = Path(app.srcdir)
    folder, evidence = source / "_build" / "evidence", source / "evidence"
    folder.mkdir(parents=True, exist_ok=True)
    programs = read_leaderboard(evidence / "leaderboard")
    (folder / "leaderboard.md").write_text(leaderboard_tables(programs), encoding="utf-8")
    (folder / "summary.md").write_text(summary_table(programs) + "\n", encoding="utf-8")
    draw_leaderboard(programs, folder)
    for name, title in _STUDY_AXES.items():
        rows = json.loads((evidence / "studies" / f"{name}.json").read_text(encoding="utf-8"))
        (folder / f"{name}.md").write_text(study_table(rows, title), encoding="utf-8")
        draw_study(rows, title, folder / f"{name}.svg")
    runpy.run_path(str(evidence / "tour.py"))["draw"](folder)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension."""
    mpl.use("agg")
    app.connect("builder-inited", write_evidence)
    return {"parallel_read_safe": True}
