"""Numbers and tables as people read them: millimetres, degrees, digits as far as they are known."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

# Factor and name of a unit for reading: of a value, and of a change or an uncertainty.
RATES = {"rad/Nm": (1e6, " µrad/Nm"), "rad/rad": (1e3, " mrad/rad"), "rad/m": (1e3, " mrad/m")}


UNITS = {"m": (1e3, " mm"), "rad": (180 / math.pi, "°"), **RATES}


SMALL_UNITS = {"m": (1e3, " mm"), "rad": (1e3, " mrad"), **RATES}


# Digits behind the point where no uncertainty says how many are known; and never more than MOST.
DEFAULT_DECIMALS = 3


MAX_DECIMALS = 6


MAX_UNBROKEN_CHARS = 48


def significant_decimals(std: float) -> int:
    """Digits behind the point for an uncertainty: two of its own up to 35, else one (Particle Data Group)."""
    if not (math.isfinite(std) and std > 0):
        return DEFAULT_DECIMALS
    power = math.floor(math.log10(std))
    leading = std / 10.0**power
    return min(
        max((1 if leading < 3.55 or leading >= 9.5 else 0) - power - (leading >= 9.5), 0), MAX_DECIMALS
    )


def format_fixed(value: float, places: int) -> str:
    """A number with so many digits behind the point; a dash where it is unknown, and no minus zero."""
    return f"{round(value, places) + 0.0:.{places}f}" if math.isfinite(value) else "–"


def format_quantity(value: float, unit: str, std: float = math.nan, small: bool = False) -> str:
    """A value with its unit, rounded to its standard deviation where that is known.

    Args:
        value: m, rad, or in another unit and then shown as it is, to three digits.
        unit: of the value; "1" for a pure number.
        std: standard deviation in that unit.
        small: whether it is a change or an uncertainty: then angles are in mrad, not degrees.
    """
    if not math.isfinite(value):
        return "–"
    if unit not in UNITS:
        return f"{value:.3g} {unit}".removesuffix(" 1")
    factor, name = (SMALL_UNITS if small else UNITS)[unit]
    return f"{format_fixed(factor * value, significant_decimals(factor * std))}{name}"


@dataclass(frozen=True)
class Table:
    """A table of texts.

    Attributes:
        header: names of the columns.
        rows: their cells.
        n_text_columns: how many of the first columns are text; the others are numbers.
        caption: what it shows.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    n_text_columns: int = 1
    caption: str = ""


def html_table(table: Table, drawings: Mapping[str, Sequence[str]] | None = None) -> str:
    """A table for a page; `drawings` are further columns of one svg a row, by their header."""
    drawn = drawings or {}

    def cell(tag: str, i: int, text: str) -> str:
        look = (
            ' class="number"'
            if i >= table.n_text_columns
            else ' class="long"'
            if len(text) > MAX_UNBROKEN_CHARS
            else ""
        )
        scope = ' scope="row"' if tag == "th" else ""
        content = html.escape(text).replace("-", "−") if i >= table.n_text_columns else html.escape(text)
        return f"<{tag}{scope}{look}>{content}</{tag}>"

    head = "".join(
        f'<th scope="col"{" class=number" if i >= table.n_text_columns else ""}>{html.escape(name)}</th>'
        for i, name in enumerate(table.header)
    )
    head += "".join(f'<th scope="col">{html.escape(name)}</th>' for name in drawn)
    body = []
    for number, row in enumerate(table.rows):
        cells = "".join(cell("td" if i else "th", i, text) for i, text in enumerate(row))
        cells += "".join(f"<td>{column[number]}</td>" for column in drawn.values())
        body.append(f"<tr>{cells}</tr>")
    caption = f"<caption>{html.escape(table.caption)}</caption>" if table.caption else ""
    return f"<table>{caption}<thead><tr>{head}</tr></thead>\n<tbody>{chr(10).join(body)}</tbody></table>"


def markdown_table(table: Table) -> str:
    """A Markdown table, numbers to the right."""
    rules = [" --- " if i < table.n_text_columns else " ---: " for i in range(len(table.header))]
    lines = ["| " + " | ".join(table.header) + " |", "|" + "|".join(rules) + "|"]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in table.rows]
    return "\n".join(lines)
