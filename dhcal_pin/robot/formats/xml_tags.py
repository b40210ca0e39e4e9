"""Safe XML parser of robot files: start tags with their lines and byte offsets, and edits of attributes.

The parser accepts plain XML in UTF-8 of bounded size and depth. It refuses document types and entities. A
format reads the tags in the order of the file; edits replace attributes at their byte offsets, so that every
other byte of the file stays.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple
from xml.parsers import expat

from ..._frozen import frozen
from ..._typing import PathLike
from ...exceptions import FileFormatError
from ...formatting import format_count
from ...messages import quote
from ...ros_packages import resolve_robot_path

# Maximum size of a file [byte], and depth of nested elements.
_MAX_BYTES = 16 << 20
_MAX_DEPTH = 64

# float() also accepts '1_0', 'nan' and digits of other scripts.
_NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")

_ELEMENT = re.compile(rb"<[^ \t\r\n/>]+")

_ATTRIBUTE = re.compile(rb"""[ \t\r\n]+([^ \t\r\n=/>]+)[ \t\r\n]*=[ \t\r\n]*("[^"]*"|'[^']*')""")


@frozen(eq=False)
class XmlTag:
    """Start tag of an XML element."""

    source: str  # Name of the file for messages
    line: int
    label: str  # Name of the element for messages
    start: int  # Byte offset of the tag
    attributes: dict[str, str]  # Values of the attributes by name

    def error(self, text: str) -> FileFormatError:
        """Create an error that names the file, the line and the element."""
        return FileFormatError(f"{self.source}:{self.line}: {self.label}: {text}")


class Edit(NamedTuple):
    """Replacement of some bytes of a file."""

    start: int
    end: int
    text: bytes


class AttributeSpan(NamedTuple):
    """Byte offsets of an attribute: its name, and its value without the quotes."""

    name: tuple[int, int]
    value: tuple[int, int]


def read_xml(path: PathLike, kind: str) -> tuple[bytes, str]:
    """Read the bytes of an XML file, not more than `scan` accepts; return them and the path found."""
    source = resolve_robot_path(path)
    try:
        with open(source, "rb") as file:
            return file.read(_MAX_BYTES + 1), source
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise FileFormatError(f"{source}: cannot be read: {reason}; give the path of {kind} file") from None


def scan(
    data: bytes,
    source: str,
    kind: str,
    root: str,
    on_start: Callable[[int, str, XmlTag], None],
) -> None:
    """Call a function for each start tag, with its depth from 1 and its element; errors name the line."""
    if len(data) > _MAX_BYTES:
        raise FileFormatError(
            f"{source}: the file is larger than {_MAX_BYTES >> 20} MiB, which no {kind} is; check the path"
        )
    if not data.strip():
        raise FileFormatError(f"{source}:1: the file is empty; expected a <{root}> element")
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise FileFormatError(f"{source}:{line}: not UTF-8; convert the file to UTF-8") from None
    if b"\0" in data:
        raise FileFormatError(f"{source}:1: zero bytes as in UTF-16; convert the file to UTF-8")
    parser = expat.ParserCreate("utf-8")
    depth = 0

    def current_tag(label: str, attributes: dict[str, str]) -> XmlTag:
        return XmlTag(source, parser.CurrentLineNumber, label, parser.CurrentByteIndex, attributes)

    def on_declaration(_version: str, encoding: str | None, _standalone: int) -> None:
        name = (encoding or "utf-8").lower()
        if name not in ("utf-8", "utf8") and not (name in ("us-ascii", "ascii") and data.isascii()):
            tag = current_tag("<?xml>", {})
            raise tag.error(f"the encoding is {quote(name)}; convert the file to UTF-8")

    def on_doctype(*_: object) -> None:
        raise current_tag("<!DOCTYPE>", {}).error("document types and entities are not accepted; remove it")

    def on_instruction(target: str, _: str) -> None:
        # Before the robot, instructions are common and harmless; inside, Pinocchio fails on them.
        if depth > 0:
            tag = current_tag(f"<?{target[:60]}?>", {})
            raise tag.error("processing instructions are not accepted; remove it")

    def on_end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def on_element(element: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        tag = current_tag(f"<{element[:60]}>", attributes)
        if depth > _MAX_DEPTH:
            raise tag.error(f"nested too deep; at most {_MAX_DEPTH} levels are accepted")
        on_start(depth, element, tag)

    parser.XmlDeclHandler, parser.StartDoctypeDeclHandler = on_declaration, on_doctype
    parser.StartElementHandler, parser.EndElementHandler = on_element, on_end
    parser.ProcessingInstructionHandler = on_instruction
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise FileFormatError(
            f"{source}:{error.lineno}: broken XML: {reason}; repair this line or export the file again"
        ) from None


def parse_numbers(tag: XmlTag, key: str, count: int) -> list[float]:
    """Parse the finite numbers of an attribute; a `FileFormatError` with the line if it has none."""
    if key not in tag.attributes:
        raise tag.error(f"{key} is missing; expected {'a number' if count == 1 else f'{count} numbers'}")
    # Expat replaces white space by spaces, except for character references such as &#9;, which do not
    # separate.
    words = [word for word in tag.attributes[key].split(" ") if word]
    if len(words) != count:
        separated = ", separated by spaces" if count > 1 else ""
        raise tag.error(f"{key} has {format_count(len(words), 'number')}; expected {count}{separated}")
    for word in words:
        if not _NUMBER.fullmatch(word) or not math.isfinite(float(word)):
            raise tag.error(f"{key} has {quote(word)}; expected a finite number such as 0.25 or -1e-3")
    return [float(word) for word in words]


def attribute_spans(data: bytes, start: int) -> tuple[dict[bytes, AttributeSpan], int, bytes]:
    """Find the attributes of the well-formed tag at a byte offset, their end, and the last quotes."""
    # Expat reports the offset of a tag, but values only after normalization.
    element = _ELEMENT.match(data, start)
    assert element is not None, "expat found a tag at this offset"
    spans, end, last_quote = {}, element.end(), b""
    while attribute := _ATTRIBUTE.match(data, end):
        spans[attribute[1]] = AttributeSpan(attribute.span(1), (attribute.start(2) + 1, attribute.end(2) - 1))
        end, last_quote = attribute.end(), attribute[2][:1]
    return spans, end, last_quote


def attribute_text(name: bytes, value: bytes, quotes: bytes) -> bytes:
    """Write an attribute with the space before it."""
    return b" " + name + b"=" + quotes + value + quotes


def attribute_edit(
    spans: Mapping[bytes, AttributeSpan], end: int, key: bytes, text: bytes, quotes: bytes
) -> Edit:
    """Return the edit that gives a tag an attribute: another value, or a new one behind the others."""
    if key in spans:
        return Edit(*spans[key].value, text)
    return Edit(end, end, attribute_text(key, text, quotes))


def number_text(values: Iterable[float]) -> bytes:
    """Write numbers with all digits, separated by spaces."""
    return " ".join(repr(float(x) + 0.0) for x in values).encode()  # + 0.0 turns -0.0 into 0.0


def edited(data: bytes, edits: Iterable[Edit]) -> bytes:
    """Return a file after replacements that do not overlap."""
    parts, end_of_last = [], 0
    # The sort is stable: two attributes inserted at one offset keep their order.
    for start, end, text in sorted(edits, key=lambda edit: edit.start):
        parts += [data[end_of_last:start], text]
        end_of_last = end
    return b"".join([*parts, data[end_of_last:]])
