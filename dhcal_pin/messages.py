"""Text of messages: values of files are quoted and shortened, and cannot control the terminal."""

from __future__ import annotations

import reprlib
import unicodedata
from collections.abc import Iterable

# Longest value that a message quotes in full, and longest message [characters].
MAX_QUOTED_CHARS = 60
MAX_MESSAGE_CHARS = 1500
# Unicode categories of characters that a terminal does not print but acts on: control characters, format
# characters such as bidirectional marks, surrogates, and separators of lines and paragraphs.
_CONTROL_CATEGORIES = frozenset(("Cc", "Cf", "Cs", "Zl", "Zp"))


class _ShortRepr(reprlib.Repr):
    """Short `repr` of nested values; that of Python fails for deep values and for very long integers."""

    def repr_int(self, x: int, level: int) -> str:
        # The decimal digits of a long integer take quadratic time.
        return repr(x) if x.bit_length() <= 64 else f"integer of {x.bit_length()} bits"


_SHORT_REPR = _ShortRepr()


def escape_control_characters(text: str) -> str:
    r"""Replace characters that a terminal acts on by their escapes in Python, such as `\x1b`.

    >>> escape_control_characters("red: \x1b[31m")
    'red: \\x1b[31m'
    """
    if text.isprintable():
        return text
    return "".join(
        char.encode("unicode_escape").decode() if unicodedata.category(char) in _CONTROL_CATEGORIES else char
        for char in text
    )


def message_line(error: object) -> str:
    """Write an error as one line for the console."""
    text = escape_control_characters(" ".join(str(error).split()))
    if len(text) <= MAX_MESSAGE_CHARS:
        return text
    half = MAX_MESSAGE_CHARS // 2
    return f"{text[:half]} ... {text[-half:]}"


def similar_words(word: str, known: Iterable[str]) -> list[str]:
    """Return the known words that an unknown one may be: an abbreviation, a derived or a misspelt word.

    >>> similar_words("--iterations", ["--max-iterations", "--method"])
    ['--max-iterations']
    >>> similar_words("calibration", ["calibrate", "validate"]), similar_words("holdut", ["holdout"])
    (['calibrate'], ['holdout'])
    >>> similar_words("speed", ["seed"])
    []
    """
    word = word.strip("-").replace("_", "-").lower()[:MAX_QUOTED_CHARS]
    plain = {name: name.strip("-").lower() for name in known}
    if word and (abbreviated := [name for name, text in plain.items() if f"-{word}" in f"-{text}"]):
        return abbreviated
    costs = {name: _misspelling_cost(word, text) for name, text in plain.items()}
    nearest = min(plain, key=lambda name: costs[name])
    if costs[nearest] <= max(1, len(plain[nearest]) / 4):
        return [nearest]
    return [name for name, text in plain.items() if word.startswith(text[: max(4, len(text) - 1)])]


def _misspelling_cost(word: str, known: str) -> float:
    """Count the changes that turn a known word into a misspelt one.

    Changes are letters that are omitted, replaced, exchanged with the next one, or added. A letter that the
    known word does not have is added in other words (`speed`, `seed`) more often than in misspelt ones.
    """
    word, known = word.replace("-", ""), known.replace("-", "")
    added = [1.0 if letter in known else 1.5 for letter in word]
    before: list[float] = []
    costs = [float(j) for j in range(len(known) + 1)]
    for i, letter in enumerate(word):
        new = [costs[0] + added[i]]
        for j, other in enumerate(known):
            new.append(min(costs[j + 1] + added[i], new[j] + 1, costs[j] + (letter != other)))
            if i and j and (letter, word[i - 1]) == (known[j - 1], other):
                new[-1] = min(new[-1], before[j - 1] + 1)
        before, costs = costs, new
    return costs[-1]


def quote(value: object) -> str:
    """Quote a value for a message, on one line and shortened."""

    def shorten(text: str) -> str:
        return text if len(text) <= MAX_QUOTED_CHARS else text[: MAX_QUOTED_CHARS - 3] + "..."

    return repr(shorten(value)) if isinstance(value, str) else shorten(_SHORT_REPR.repr(value))
