"""Messages: one short line that does not control the terminal."""

import pytest

from dhcal_pin.messages import (
    MAX_MESSAGE_CHARS,
    MAX_QUOTED_CHARS,
    escape_control_characters,
    message_line,
    quote,
    similar_words,
)

# Escape sequence, bell, C1 control, bidirectional marks, line and paragraph separator, surrogate, zero width.
HOSTILE = "a\x1b[2J\x07\x9b31m\u202e\u2066\u200f\u2028\u2029\udcff\u200b\r\n\tb"


def test_no_control_character_is_left():
    assert escape_control_characters(HOSTILE) == (
        r"a\x1b[2J\x07\x9b31m\u202e\u2066\u200f\u2028\u2029\udcff\u200b\r\n\tb"
    )
    assert escape_control_characters("Größe µm → 漢字 \u00a0") == "Größe µm → 漢字 \u00a0"


def test_a_message_is_one_short_line():
    text = message_line(ValueError(f"{HOSTILE} {'x' * 100_000} end"))
    assert text.startswith(r"a\x1b[2J")
    assert text.endswith("xxx end")
    assert len(text) <= MAX_MESSAGE_CHARS + 10
    assert message_line("two\n  lines") == "two lines"


@pytest.mark.parametrize(
    "value",
    ["x" * 10_000, [16**100_000], [-(10**400)], {"a": ["y" * 1000] * 1000}, [[10**5000]], [*range(10**6)]],
    ids=["text", "hex", "negative", "table", "nested", "list"],
)
def test_quoted_values_are_short(value):
    assert 0 < len(quote(value)) <= MAX_QUOTED_CHARS + 2


def test_deep_values_are_quoted():
    """The repr of Python raises RecursionError here."""
    deep: dict = {}
    for _ in range(100_000):
        deep = {"a": deep}
    assert len(quote(deep)) <= MAX_QUOTED_CHARS
    while deep:
        deep = deep.pop("a")


def test_short_values_are_quoted_in_full():
    assert quote("it's") == '"it\'s"'
    assert quote([1, 2.5, "a", True]) == "[1, 2.5, 'a', True]"


OPTIONS = [
    *("--arm", "--bounds", "--bundle", "--columns", "--curves", "--extend", "--fix", "--free", "--holdout"),
    *(
        "--json",
        "--loss",
        "--max-iterations",
        "--mend",
        "--output",
        "--package-dir",
        "--parameters",
        "--quiet",
    ),
    *("--report", "--root", "--scene", "--seed", "--session", "--skip-bad-rows", "--tip", "--tool-frame"),
]


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("--sed", "--seed"),
        ("--joson", "--json"),
        ("--tpi", "--tip"),
        ("--outptu", "--output"),
        ("--coloumns", "--columns"),
        ("--paramters", "--parameters"),
        ("--hold-out", "--holdout"),
        ("--boundle", "--bundle"),
        ("--extends", "--extend"),
        ("--quit", "--quiet"),
        ("--max_iter", "--max-iterations"),
        ("--iterations", "--max-iterations"),
        ("--bad-rows", "--skip-bad-rows"),
        ("--tool", "--tool-frame"),
        ("--ROOT", "--root"),
    ],
)
def test_misspelt_and_abbreviated_words_are_recognized(word, expected):
    assert similar_words(word, OPTIONS) == [expected]


@pytest.mark.parametrize(
    "word",
    [
        "--",
        *"speed fit-frames tolerance plot robot data scale time version count cores model units x".split(),
    ],
)
def test_other_words_are_not_taken_for_misspelt_ones(word):
    assert similar_words(word, OPTIONS) == []
