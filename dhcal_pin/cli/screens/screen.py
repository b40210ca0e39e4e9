"""Layout of what a command shows: all of it, or as much as fits on one screen.

A command describes its result as a `Screen`. The default view has at most `HEIGHT` lines of at most `WIDTH`
columns. Nothing in it is cut off: long texts continue on the next line, and blocks with many items show the
first ones and the number of the others, which --verbose shows. This module does not print.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Literal, NamedTuple

from ..._frozen import frozen
from ...formatting import Table
from ...messages import escape_control_characters

if TYPE_CHECKING:
    from ...report.document import Section
    from ...robot import Chain

# Views of a screen: the verdict only, one screen, everything.
Verbosity = Literal["quiet", "normal", "verbose"]

# Size of a small terminal, without the line of the next prompt.
WIDTH, HEIGHT = 80, 23

# Indentation of continuation lines.
_INDENT = "  "
# Spaces between the columns of a table.
_GAP = "  "
# Smallest width of a column whose texts are folded.
_MIN_COLUMN = 12
# A word that is longer than a line continues after one of these characters, if possible.
_BREAKS = "/\\_-.,:="


class Line(NamedTuple):
    """Line of output with its style, such as "yellow" or "bold"."""

    text: str
    style: str = ""


@frozen
class Block:
    """Part of a screen: texts or a table."""

    content: Sequence[str] | Table  # Texts, each on a line of its own, or a table
    style: str = ""  # Style, such as "yellow" or "bold"
    title: str = ""  # Line above the content; it is not shown without content
    # What an item is, such as "note on the files", for the number of items that are left out; a block without
    # it is never shortened.
    noun: str = ""
    rank: int = 0  # Blocks of the lowest rank are shortened first
    n_kept: int = 1  # Number of items that remain until all blocks are shortened
    is_verdict: bool = False  # Whether the block is also shown if only the verdict is asked for
    has_space: bool = False  # Whether an empty line precedes the block if there is space for it
    is_verbatim: bool = False  # Whether the texts are to be copied, so that no line of them is folded


@frozen
class Screen:
    """Result of a command as it is shown."""

    blocks: Sequence[Block]  # What is always shown, shortened to one screen unless everything is asked for
    # Makes what is shown above the blocks if everything is asked for.
    details: Callable[[], Sequence[Block]] = tuple

    def lines(self, verbosity: Verbosity, width: int | None = WIDTH) -> list[Line]:
        """Lay out the screen."""
        if verbosity == "quiet":
            return _full_lines([block for block in self.blocks if block.is_verdict], width)
        if verbosity == "verbose":
            return _full_lines([*self.details(), *self.blocks], width)
        return _shortened_lines(self.blocks, min(width or WIDTH, WIDTH), HEIGHT)


def robot_line(path: str, chain: Chain) -> str:
    """Describe a robot by its tip and its joints."""
    first, *_, last = chain.joint_names * 2
    joints = f"{chain.n_joints} joints from {first} to {last}" if chain.n_joints > 1 else f"joint {first}"
    return f"{path}: tip {chain.tip}, {joints}"


def section_blocks(sections: Sequence[Section]) -> list[Block]:
    """Return the sentences, lists and tables of sections of a document; a terminal has no figures."""
    blocks = []
    for section in sections:
        texts = [*section.sentences, *section.items]
        blocks.append(Block([section.title, *texts] if section.title else texts, has_space=True))
        for number, table in enumerate(section.tables):
            follows_title = section.title and not texts and not number
            blocks.append(Block(table, title=table.caption, has_space=not follows_title))
    return blocks


# --- blocks ----------------------------------------------------------------------------------------


class _Part(NamedTuple):
    """Block that is folded to the width of the screen: heading and items, each several lines of text."""

    block: Block
    heading: list[str]
    items: list[list[str]]

    def lines(self, count: int) -> list[Line]:
        """Return the heading, the first items, and the number of the others; nothing without items."""
        if not count:
            return []
        texts = [*self.heading, *(text for item in self.items[:count] for text in item)]
        if n_hidden := len(self.items) - count:
            texts.append(f"{_INDENT}{n_hidden} more {self._noun(n_hidden)}; see --verbose")
        return [Line(text, self.block.style) for text in texts]

    @property
    def summary(self) -> str:
        """Number of all items, such as "3 notes"."""
        return f"{len(self.items)} {self._noun(len(self.items))}"

    def _noun(self, count: int) -> str:
        """Return what items are, in the plural if there are several."""
        first, *rest = self.block.noun.split(" ")
        return " ".join([first if count == 1 else f"{first}s", *rest])


def _part(block: Block, width: int | None) -> _Part:
    """Fold a block."""
    title = fold(block.title, width) if block.title else []
    if isinstance(block.content, Table):
        header, rows = fold_table(block.content, width)
        return _Part(block, [*title, *header] if rows else [], rows)
    items = [fold(text, None if block.is_verbatim else width) for text in block.content]
    return _Part(block, title if items else [], items)


def _full_lines(blocks: Sequence[Block], width: int | None) -> list[Line]:
    """Lay out blocks with all items and empty lines."""
    parts = [_part(block, width) for block in blocks]
    return _joined(parts, [len(part.items) for part in parts], has_spaces=True, width=width)


def _shortened_lines(blocks: Sequence[Block], width: int, height: int) -> list[Line]:
    """Lay out blocks; leave out items, then empty lines, then more items, until they fit."""
    parts = [_part(block, width) for block in blocks]
    # An item has at least one line.
    counts = [min(len(part.items), height) if part.block.noun else len(part.items) for part in parts]
    by_rank = sorted((part.block.rank, i) for i, part in enumerate(parts) if part.block.noun)
    has_spaces = True
    for is_last in (False, True):
        for _, i in by_rank:
            n_kept = 0 if is_last else parts[i].block.n_kept
            while counts[i] > n_kept and len(_joined(parts, counts, has_spaces, width)) > height:
                counts[i] -= 1
        has_spaces = has_spaces and len(_joined(parts, counts, has_spaces, width)) <= height
    return _joined(parts, counts, has_spaces, width)


def _joined(parts: Sequence[_Part], counts: Sequence[int], has_spaces: bool, width: int | None) -> list[Line]:
    """Join the first items of each block; `counts` has their numbers. One line names what is left out."""
    lines: list[Line] = []
    left_out = [part for part, count in zip(parts, counts, strict=True) if part.items and not count]
    for part, count in zip(parts, counts, strict=True):
        new = part.lines(count)
        if left_out and part is left_out[0]:
            text = f"{', '.join(each.summary for each in left_out)}; see --verbose"
            new = [Line(each) for each in fold(text, width)]
        if new and lines and has_spaces and part.block.has_space:
            lines.append(Line(""))
        lines += new
    return lines


# --- folding ---------------------------------------------------------------------------------------


def cell_width(text: str) -> int:
    """Count the columns of a terminal that a text takes."""
    return len(text) if text.isascii() else sum(map(_char_width, text))


def _char_width(char: str) -> int:
    if unicodedata.combining(char):
        return 0
    return 2 if unicodedata.east_asian_width(char) in "WF" else 1


def fold(text: str, width: int | None, indent: str = _INDENT) -> list[str]:
    """Fold a text into lines; characters that control a terminal are escaped.

    >>> fold("wrote measurements/a.csv", 16)
    ['wrote', '  measurements/', '  a.csv']
    """
    text = escape_control_characters(text)
    margin = text[: len(text) - len(text.lstrip(" "))]
    if width is None or cell_width(text) <= width:
        return [text]
    lines, line = [], margin
    for word in text.split():
        separator = " " if line.strip() else ""
        if cell_width(line + separator + word) <= width:
            line += separator + word
            continue
        if separator:
            lines.append(line)
            line = margin + indent
        *full, rest = _split_word(word, width - cell_width(margin + indent))
        for piece in full:
            lines.append(line + piece)
            line = margin + indent
        line += rest
    return [*lines, line]


def _split_word(word: str, width: int) -> list[str]:
    """Split a long word into pieces of at most `width` columns, preferably after a character of `_BREAKS`."""
    pieces = []
    while cell_width(word) > width:
        end = 1
        while cell_width(word[: end + 1]) <= width:
            end += 1
        after_break = 1 + max(word.rfind(char, 0, end) for char in _BREAKS)
        end = after_break if after_break > end // 3 else end
        pieces.append(word[:end])
        word = word[end:]
    return [*pieces, word]


def fold_table(table: Table, width: int | None) -> tuple[list[str], list[list[str]]]:
    """Lay out a table.

    The texts of the header are folded. If the table is still too wide, its text columns are folded; if that
    is not enough, the last columns follow in a further table below.
    """
    n_text = table.n_text_columns
    header = [escape_control_characters(name) for name in table.header]
    rows = [[escape_control_characters(cell) for cell in row] for row in table.texts]
    widths = [max(map(cell_width, column)) for column in zip(header, *rows, strict=True)]
    if width is None:
        return _header_lines(header, widths, n_text), [_row_lines(row, widths, n_text) for row in rows]
    if sum(widths) + len(_GAP) * (len(widths) - 1) > width:
        words = [max(name.split() or [""], key=cell_width) for name in header]
        widths = [max(map(cell_width, column)) for column in zip(words, *rows, strict=True)]
    n_columns = len(header)
    while n_columns > n_text + 1 and _fixed_width(widths[:n_columns], n_text) > width:
        n_columns -= 1
    _narrow(widths, n_text, width - _fixed_width(widths[:n_columns], 0) + sum(widths[:n_text]))
    heading = _header_lines(header[:n_columns], widths, n_text)
    items = [_row_lines(row[:n_columns], widths, n_text) for row in rows]
    if n_columns < len(header):
        kept = [*range(n_text), *range(n_columns, len(header))]
        rest = Table([header[i] for i in kept], [[row[i] for i in kept] for row in rows], n_text)
        below, more = fold_table(rest, width)
        items += [["", *below, *more[0]], *more[1:]]
    return heading, items


def _fixed_width(widths: Sequence[int], n_text: int) -> int:
    """Return the width of a table whose text columns are folded as far as possible."""
    columns = [min(one, _MIN_COLUMN) for one in widths[:n_text]] + list(widths[n_text:])
    return sum(columns) + len(_GAP) * (len(columns) - 1)


def _narrow(widths: list[int], n_text: int, available: int) -> None:
    """Reduce the widest text columns until all of them take the available columns."""
    while n_text and sum(widths[:n_text]) > available and max(widths[:n_text]) > _MIN_COLUMN:
        widths[widths.index(max(widths[:n_text]))] -= 1


def _header_lines(header: Sequence[str], widths: Sequence[int], n_text: int) -> list[str]:
    """Fold the cells of a header; their last lines stand above the rows."""
    cells = [fold(cell, width, "") for cell, width in zip(header, widths, strict=False)]
    height = max(map(len, cells))
    return _grid_lines([[""] * (height - len(cell)) + cell for cell in cells], widths, n_text)


def _row_lines(row: Sequence[str], widths: Sequence[int], n_text: int) -> list[str]:
    """Fold the cells of a row; their first lines stand side by side."""
    cells = [fold(cell, width, "") for cell, width in zip(row, widths, strict=False)]
    return _grid_lines(cells, widths, n_text)


def _grid_lines(cells: Sequence[Sequence[str]], widths: Sequence[int], n_text: int) -> list[str]:
    """Join the lines of cells; texts are aligned to the left and numbers to the right."""
    lines = []
    for texts in zip_longest(*cells, fillvalue=""):
        padded = []
        for i, (text, width) in enumerate(zip(texts, widths, strict=False)):
            space = " " * (width - cell_width(text))
            padded.append(text + space if i < n_text else space + text)
        lines.append(_GAP.join(padded).rstrip())
    return lines
