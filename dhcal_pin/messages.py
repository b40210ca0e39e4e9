"""Text of messages: values of files are quoted and shortened, and cannot control the terminal."""

from __future__ import annotations

import reprlib
import unicodedata

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


def quote(value: object) -> str:
    """Quote a value for a message, on one line and shortened."""

    def shorten(text: str) -> str:
        return text if len(text) <= MAX_QUOTED_CHARS else text[: MAX_QUOTED_CHARS - 3] + "..."

    return repr(shorten(value)) if isinstance(value, str) else shorten(_SHORT_REPR.repr(value))
