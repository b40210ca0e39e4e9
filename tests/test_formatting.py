"""Text of numbers and tables."""

from xml.etree import ElementTree

import numpy as np
import pytest

from dhcal_pin.formatting import (
    Quantity,
    Table,
    escape_markdown,
    format_below,
    format_quantity,
    html_table,
    markdown_table,
)


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        # Examples of the Particle Data Group's review, section 5.3.
        (0.827e-3, 0.119e-3, "0.83 mm"),
        (0.827e-3, 0.367e-3, "0.8 mm"),
        (14.7e-3, 0.96e-3, "14.7 mm"),
        (-0.4e-9, 1e-6, "0.0000 mm"),
        (3.5679, 1.2e-3, "3567.9 mm"),
        (np.inf, 1e-3, "–"),
        (1e-3, np.nan, "1.000 mm"),
        (999.999, 1e-4, "999999.00 mm"),
        (-1.03880402979e41, np.nan, "-1.04e+44 mm"),
    ],
)
def test_quantities_are_rounded_to_their_standard_deviation(value, std, text):
    assert format_quantity(value, "m", std) == text


@pytest.mark.parametrize(
    ("value", "text"), [(1.935, "1.9"), (72 / 27, "2.67"), (2.6999, "2.6999"), (2.3, "2.3")]
)
def test_values_below_a_limit_are_shown_below_it(value, text):
    assert format_below(value, 2.7) == text


def test_rates_and_pure_numbers():
    assert format_quantity(1.2346e-5, "rad/Nm", 1e-7) == "12.35 µrad/Nm"
    assert format_quantity(-2.5e-3, "rad/rad", 4e-4, small=True) == "-2.5 mrad/rad"
    assert format_quantity(-0.00125, "1", 1e-5) == "-0.00125"


def test_cells_are_texts_or_quantities():
    """Each rendering makes its text of them; a title may have the unit."""
    cells = ["a", Quantity(-0.0147, "m", 1e-4), Quantity(2e-3, "rad", 1e-5, is_small=True, has_unit=False)]
    table = Table(["name", "length", "angle, mrad"], [[*cells, Quantity.error(np.nan, "px")]])
    assert table.texts == [["a", "-14.70 mm", "2.000", "–"]]
    assert markdown_table(table).endswith("| a | -14.70 mm | 2.000 | – |")
    assert '<td class="number">−14.70 mm</td>' in html_table(table)


HOSTILE = (
    "<script>alert(1)</script> [x](javascript:alert) ![y](http://e.vil) `z` **b** _i_ &lt; \\ |",
    "a\n# b\n\n- c",
    "snake_case __init__ a_ _b joint_1*",
    "[a]: http://e.vil",
    "![a][b]",
    "<http://e.vil>",
    "<!-- comment",
)


@pytest.mark.parametrize("text", HOSTILE)
def test_markdown_shows_texts_unchanged(text):
    """Compared with a renderer of Markdown."""
    markdown_it = pytest.importorskip("markdown_it")
    table = markdown_table(Table([text], [[text]]))
    page = markdown_it.MarkdownIt().enable("table").render(f"x {escape_markdown(text)}\n\n{table}")
    root = ElementTree.fromstring(f"<page>{page}</page>")
    assert {element.tag for element in root.iter()} == {
        *("page", "p", "table", "thead", "tbody", "tr", "th", "td")
    }
    plain = " ".join(text.split())
    assert [root.findtext(f".//{tag}") for tag in ("p", "th", "td")] == [f"x {plain}", plain, plain]


def test_tables_align_numbers_and_escape_text():
    table = Table(["name", "value"], [["a<b", "-1.5"]], caption="c")
    assert markdown_table(table) == "| name | value |\n| --- | ---: |\n| a&lt;b | -1.5 |"
    text = html_table(table)
    assert '<th scope="row">a&lt;b</th><td class="number">−1.5</td>' in text
    assert "<caption>c</caption>" in text
