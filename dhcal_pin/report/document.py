"""Document: what a page, a text, a screen or a certificate shows, as data.

A document has a head and sections. A section has sentences, a list, tables and figures. Cells of tables are
texts or values with units (`formatting.Table`). `html`, `markdown` and `cli/screens/screen.py` render it, and
know nothing of calibrations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from typing import Any

from .._frozen import frozen
from ..formatting import Table
from ..plots import PANEL


@frozen
class IntervalBar:
    """Mark with an interval around it, on a scale from -1 to 1."""

    low: float  # Lower end of the interval
    middle: float  # Position of the mark
    high: float  # Upper end of the interval


@frozen
class BarTable(Table):
    """Table with columns of bars and groups of rows, which only the HTML page shows."""

    # Additional columns by title, with one bar per row: a share from 0 to 1, an interval, or None.
    bars: Mapping[str, Sequence[float | IntervalBar | None]] = field(default_factory=dict)
    # Indices of the rows of each group by its heading; none if the rows are not grouped.
    groups: Mapping[str, Sequence[int]] = field(default_factory=dict)
    unchanged: Sequence[int] = ()  # Indices of rows that the page folds, as they report no change


@frozen
class Panel:
    """One figure, which is drawn when the page is written."""

    key: str  # Prefix of its identifiers, unique in the document
    caption: str  # Text above the figure
    description: str  # What the figure shows, in words, for screen readers
    plot: Callable[..., object]  # Function of `plots` with all its arguments except `ax`
    size: tuple[float, float] = PANEL  # Width and height [px]
    # Horizontal and vertical coordinate of the dots of samples, so that a reader can select them: "number",
    # "joint:I" (position of joint I), "base:K" (component K of the tool position in the base frame) or
    # "error:GROUP"; empty without such dots.
    points: tuple[str, ...] = ()
    role: str = ""  # Role of the samples, if the figure shows the samples of one role only


@frozen
class LegendEntry:
    """Meaning of a colour."""

    text: str  # What is drawn in this way
    color: str  # Name of the colour in `plots.COLORS`
    mark: str  # Shape of the sample: "area", "cell", "dashes", "dots" or "line"


@frozen
class FigureGroup:
    """Figures that belong together and share a legend."""

    panels: Sequence[Panel]
    title: str = ""  # Heading of the group; may be empty
    legend: Sequence[LegendEntry] = ()  # Meaning of the colours
    layout: str = "narrow"  # Columns of panels on a wide page: "narrow" (three) or "wide" (two)
    # Page of a 3-D scene as `figures.packed_scene` returns it, shown on screens; the panels then appear in
    # print only.
    scene: str = ""
    # What the scene shows, for screen readers.
    scene_title: str = "The robot before and after calibration, in three dimensions"


@frozen
class Section:
    """Section of a document; one without content is not shown."""

    key: str  # Identifier of the section on the page
    title: str  # Heading
    sentences: Sequence[str] = ()  # Paragraphs
    items: Sequence[str] = ()  # List below the paragraphs
    tables: Sequence[Table] = ()  # Tables below the list
    # Makes the figures, at the end of the section; called by renderings with figures.
    figures: Callable[[], Sequence[FigureGroup]] | None = None


@frozen(eq=False)
class Document:
    """Head and sections of a document."""

    title: str
    sections: Sequence[Section]
    heading: str = ""  # What the values are, as the heading of a page
    eyebrow: str = ""  # Line above the heading
    status: str = ""  # Verdict: "ok", "caution" or "refused"; empty if there is none
    reasons: Sequence[str] = ()  # Reasons of the verdict
    headline: str = ""  # The most important value as a sentence, for renderings without heading and values
    # State ("before", "after" or empty), name and text of the most important values.
    values: Sequence[tuple[str, str, str]] = ()
    details: Sequence[tuple[str, str, str]] = ()  # State, name and text of further values
    remarks: Sequence[str] = ()  # Paragraphs below the values
    note: str = ""  # How far the values can be trusted; the headline says so, too
    warnings: Sequence[str] = ()  # What a reader must know before relying on the document
    # Makes the samples that a reader can select on a page, as JSON-compatible values.
    samples: Callable[[], Mapping[str, Any]] | None = None
    # Names and values of a certificate; a reader fills in those without a value by hand.
    facts: Sequence[tuple[str, str]] = ()
    records: Sequence[tuple[str, str]] = ()  # Names and values at the end of a certificate
