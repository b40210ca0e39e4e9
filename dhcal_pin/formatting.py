"""Text of numbers with units and of tables, for reports and the console.

Lengths are shown in mm and angles in degrees or mrad. The standard deviation of a value decides how many
decimals are shown (rounding rule of the Particle Data Group).
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ._frozen import frozen

if TYPE_CHECKING:
    import jinja2
    from markupsafe import Markup

# SI unit -> (factor, text of the shown unit).
RATE_UNITS = {"rad/Nm": (1e6, " µrad/Nm"), "rad/rad": (1e3, " mrad/rad"), "rad/m": (1e3, " mrad/m")}
# Shown units of values.
UNITS = {"m": (1e3, " mm"), "rad": (180 / math.pi, "°"), "px": (1.0, " px"), **RATE_UNITS}
# Shown units of changes and standard deviations.
SMALL_UNITS = {"m": (1e3, " mm"), "rad": (1e3, " mrad"), "px": (1.0, " px"), **RATE_UNITS}
# Decimals of a value without standard deviation.
DEFAULT_DECIMALS = 3
# Largest number of decimals.
MAX_DECIMALS = 6
# Numbers from here on are shown with an exponent.
MIN_EXPONENT_VALUE = 1e6
# Table cells with more characters get the CSS class "long", which allows line breaks.
MAX_UNBROKEN_CHARS = 48
# Longest list in a sentence; the files that are written contain all items.
MAX_LISTED = 12
# Tables of a page with more columns become lists on medium pages already.
MAX_NARROW_COLUMNS = 6
# Largest number of runs of lines that a message lists.
MAX_LISTED_RUNS = 100


def significant_decimals(std: float) -> int:
    """Choose the number of decimals for a value with a standard deviation.

    The standard deviation keeps two significant digits if these are at most 35, otherwise one (rounding rule
    of the Particle Data Group).
    """
    if not (math.isfinite(std) and std > 0):
        return DEFAULT_DECIMALS
    power = math.floor(math.log10(std))
    leading = std / 10.0**power
    return min(
        max((1 if leading < 3.55 or leading >= 9.5 else 0) - power - (leading >= 9.5), 0), MAX_DECIMALS
    )


def format_fixed(value: float, decimals: int) -> str:
    """Format a number with a fixed number of decimals, without negative zero."""
    if not math.isfinite(value):
        return "–"
    if abs(value) >= MIN_EXPONENT_VALUE:
        return f"{value:.2e}"
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def round_up(value: float) -> float:
    """Return the smallest number 1, 2 or 5 times a power of ten that is not below a value."""
    return next(each for each in _round_numbers(value) if each >= value * (1 - 1e-9))


def round_down(value: float) -> float:
    """Return the largest number 1, 2 or 5 times a power of ten that is not above a value."""
    return max(each for each in _round_numbers(value) if each <= value * (1 + 1e-9))


def _round_numbers(value: float) -> list[float]:
    """Return the numbers 1, 2 or 5 times a power of ten around a value."""
    power = 10.0 ** math.floor(math.log10(value))
    return [k * power for k in (1, 2, 5, 10)]


def join_names(names: Sequence[str]) -> str:
    """Join names with commas and a final "and"."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def list_first(items: Sequence[object], most: int = MAX_LISTED, noun: str = "") -> str:
    """Join the first items of a list with commas, and count the others by a noun whose plural ends in s.

    >>> list_first([2, 5, 7], 2), list_first(["a", "b"]), list_first("abc", 2, "letter")
    ('2, 5 and 1 more', 'a, b', 'a, b and 1 more letter')
    """
    n_more = len(items) - most
    more = f" and {format_count(n_more, f'more {noun}') if noun else f'{n_more} more'}" if n_more > 0 else ""
    return ", ".join(map(str, items[:most])) + more


def texts_by_file(by_file: Mapping[str, Iterable[str]], kind: str = "") -> list[str]:
    """List the texts about each file behind its name, and behind what they are, such as "warning: "."""
    return [f"{name}: {kind}{text}" for name, texts in by_file.items() for text in texts]


def format_count(count: int, noun: str) -> str:
    """Return a count with a noun whose plural ends in s.

    >>> format_count(1, "sample"), format_count(3, "sample")
    ('1 sample', '3 samples')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def capitalized(text: str) -> str:
    """Return a text with its first letter in upper case."""
    return text[:1].upper() + text[1:]


def format_quantity(value: float, unit: str, std: float, small: bool = False) -> str:
    """Format a value with its unit, rounded according to its standard deviation."""
    if not math.isfinite(value):
        return "–"
    if unit not in UNITS:
        return f"{value:.3g} {unit}".removesuffix(" 1")
    factor, name = (SMALL_UNITS if small else UNITS)[unit]
    return f"{format_fixed(factor * value, significant_decimals(factor * std))}{name}"


def format_below(value: float, limit: float) -> str:
    """Format a value below a limit with as few decimals as show that it is below.

    >>> format_below(1.93, 2.7), format_below(2.67, 2.7)
    ('1.9', '2.67')
    """
    return next(text for decimals in itertools.count(1) if float(text := f"{value:.{decimals}f}") < limit)


@frozen
class Quantity:
    """Value with its unit; its text is rounded according to its standard deviation."""

    value: float  # Value in its unit
    unit: str  # SI unit, such as "m"
    std: float = math.nan  # Standard deviation of the value
    is_small: bool = False  # Whether it is a change or an error; angles are then shown in mrad
    has_unit: bool = True  # Whether the unit is shown; the title of a column may have it

    @classmethod
    def error(cls, value: float, unit: str) -> Quantity:
        """Return an error, which is shown with two or three digits."""
        return cls(value, unit, value / 10, is_small=True)

    def __str__(self) -> str:
        """Return the text of the value."""
        text = format_quantity(self.value, self.unit, self.std, self.is_small)
        return text if self.has_unit else text.removesuffix(SMALL_UNITS[self.unit][1])


@frozen
class Table:
    """Table of texts and quantities; it can be rendered as HTML, Markdown or console text."""

    header: Sequence[str]  # Column titles
    rows: Sequence[Sequence[str | Quantity]]  # Cells, one sequence per row
    n_text_columns: int = 1  # Number of leading columns with text; the other columns contain numbers
    caption: str = ""  # Title of the table

    @property
    def texts(self) -> list[list[str]]:
        """Texts of the cells, one list per row."""
        return [list(map(str, row)) for row in self.rows]


@cache
def html_templates() -> jinja2.Environment:
    """Return the HTML templates of the package, named by their paths in it."""
    # Lazy import: only reports and notebooks need it.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("dhcal_pin", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["MAX_UNBROKEN_CHARS"] = MAX_UNBROKEN_CHARS
    environment.globals["MAX_NARROW_COLUMNS"] = MAX_NARROW_COLUMNS
    environment.globals["resource"] = _resource
    return environment


def _resource(path: str) -> Markup:
    """Return a style sheet or script of the package, which a template inserts unchanged."""
    from markupsafe import Markup

    return Markup((Path(__file__).parent / path).read_text("utf-8"))


def json_for_html(content: Any) -> str:
    """Format a document as compact JSON that can stand in a script element of a page."""
    text = json.dumps(content, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    # A file name need not be UTF-8. Python keeps its other bytes as surrogates, which become JSON escapes.
    return text.replace("<", "\\u003c").encode(errors="backslashreplace").decode()


def html_table(table: Table) -> str:
    """Render a table as HTML."""
    return str(html_templates().get_template("table.html").make_module().render_table(table))  # pyright: ignore


def escape_markdown(text: str) -> str:
    """Escape a text so that Markdown shows it unchanged: no HTML, links or emphasis come from it."""
    text = " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    # An underscore within a word is plain text.
    return re.sub(r"([\\`*\[\]|]|(?<![^\W_])_|_(?![^\W_]))", r"\\\1", text)


def markdown_table(table: Table) -> str:
    """Render a table as Markdown with numbers aligned to the right."""
    rules = [" --- " if i < table.n_text_columns else " ---: " for i in range(len(table.header))]
    header, *rows = (
        "| " + " | ".join(map(escape_markdown, row)) + " |" for row in (table.header, *table.texts)
    )
    return "\n".join([header, "|" + "|".join(rules) + "|", *rows])


def format_lines(lines: Iterable[int], n_listed: int = MAX_LISTED_RUNS) -> str:
    """Return line numbers as text: the first runs of them, then how many lines follow.

    >>> format_lines([2, 5, 6, 7, 11])
    '2, 5-7, 11'
    """
    groups = itertools.groupby(enumerate(lines), lambda pair: pair[1] - pair[0])
    runs = [[line for _, line in pairs] for _, pairs in groups]
    parts = [str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs[:n_listed]]
    n_more = sum(map(len, runs[n_listed:]))
    return ", ".join(parts) + f" and {n_more} more" * bool(n_more)
