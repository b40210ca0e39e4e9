"""Document: what a page, a text, a screen or a certificate shows, as data.

A document has a head and sections. A section has sentences, a list, tables and figures. Cells of tables are
texts or values with units (`formatting.Table`). `html`, `markdown` and `cli/screens/screen.py` render it, and
know nothing of calibrations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..formatting import Table
from ..plots import PANEL


@dataclass(frozen=True)
class IntervalBar:
    """Mark with an interval around it, on a scale from -1 to 1.

    Attributes:
        low: Lower end of the interval.
        middle: Position of the mark.
        high: Upper end of the interval.
    """

    low: float
    middle: float
    high: float


@dataclass(frozen=True)
class BarTable(Table):
    """Table with columns of bars and groups of rows, which only the HTML page shows.

    Attributes:
        bars: Additional columns by title, with one bar per row: a share from 0 to 1, an interval, or None.
        groups: Indices of the rows of each group by its heading; none if the rows are not grouped.
        unchanged: Indices of rows that the page folds, as they report no change.
    """

    bars: Mapping[str, Sequence[float | IntervalBar | None]] = field(default_factory=dict)
    groups: Mapping[str, Sequence[int]] = field(default_factory=dict)
    unchanged: Sequence[int] = ()


@dataclass(frozen=True)
class Panel:
    """One figure, which is drawn when the page is written.

    Attributes:
        key: Prefix of its identifiers, unique in the document.
        caption: Text above the figure.
        description: What the figure shows, in words, for screen readers.
        plot: Function of `plots` with all its arguments except `ax`.
        size: Width and height [px].
        points: Horizontal and vertical coordinate of the dots of samples, so that a reader can select them:
            "number", "joint:I" (position of joint I), "base:K" (component K of the tool position in the base
            frame) or "error:GROUP"; empty without such dots.
        role: Role of the samples, if the figure shows the samples of one role only.
    """

    key: str
    caption: str
    description: str
    plot: Callable[..., object]
    size: tuple[float, float] = PANEL
    points: tuple[str, ...] = ()
    role: str = ""


@dataclass(frozen=True)
class LegendEntry:
    """Meaning of a colour.

    Attributes:
        text: What is drawn in this way.
        color: Name of the colour in `plots.COLORS`.
        mark: Shape of the sample: "area", "cell", "dashes", "dots" or "line".
    """

    text: str
    color: str
    mark: str


@dataclass(frozen=True)
class FigureGroup:
    """Figures that belong together and share a legend.

    Attributes:
        panels: The figures.
        title: Heading of the group; may be empty.
        legend: Meaning of the colours.
        layout: Columns of panels on a wide page: "narrow" (three) or "wide" (two).
        scene: Page of a 3-D scene as `figures.packed_scene` returns it, shown on screens; the panels then
            appear in print only.
        scene_title: What the scene shows, for screen readers.
    """

    panels: Sequence[Panel]
    title: str = ""
    legend: Sequence[LegendEntry] = ()
    layout: str = "narrow"
    scene: str = ""
    scene_title: str = "The robot before and after calibration, in three dimensions"


@dataclass(frozen=True)
class Section:
    """Section of a document; one without content is not shown.

    Attributes:
        key: Identifier of the section on the page.
        title: Heading.
        sentences: Paragraphs.
        items: List below the paragraphs.
        tables: Tables below the list.
        figures: Makes the figures, at the end of the section; called by renderings with figures.
    """

    key: str
    title: str
    sentences: Sequence[str] = ()
    items: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Callable[[], Sequence[FigureGroup]] | None = None


@dataclass(frozen=True, eq=False)
class Document:
    """Head and sections of a document.

    Attributes:
        title: Title of the document.
        sections: Sections.
        heading: What the values are, as the heading of a page.
        eyebrow: Line above the heading.
        status: Verdict: "ok", "caution" or "refused"; empty if there is none.
        reasons: Reasons of the verdict.
        headline: The most important value as a sentence, for renderings without heading and values.
        values: State ("before", "after" or empty), name and text of the most important values.
        details: State, name and text of further values.
        remarks: Paragraphs below the values.
        note: How far the values can be trusted; the headline says so, too.
        warnings: What a reader must know before relying on the document.
        samples: Makes the samples that a reader can select on a page, as JSON-compatible values.
        facts: Names and values of a certificate; a reader fills in those without a value by hand.
        records: Names and values at the end of a certificate.
    """

    title: str
    sections: Sequence[Section]
    heading: str = ""
    eyebrow: str = ""
    status: str = ""
    reasons: Sequence[str] = ()
    headline: str = ""
    values: Sequence[tuple[str, str, str]] = ()
    details: Sequence[tuple[str, str, str]] = ()
    remarks: Sequence[str] = ()
    note: str = ""
    warnings: Sequence[str] = ()
    samples: Callable[[], Mapping[str, Any]] | None = None
    facts: Sequence[tuple[str, str]] = ()
    records: Sequence[tuple[str, str]] = ()
