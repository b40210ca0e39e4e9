"""The tags of a URDF from its bytes, with the place of each; nothing but plain, bounded XML is let in."""

from __future__ import annotations

import difflib
import html
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from xml.parsers import expat

from .errors import DhcalError

_MAX_JOINTS, _MAX_DEPTH = 20_000, 64
_ONCE = ("origin", "axis", "parent", "child", "limit", "mimic")
# float() would also take '1_0', 'nan' and the digits of other scripts.
_NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


@dataclass(frozen=True, eq=False)
class Tag:
    """A start tag: where it is, what to call it, what it says, its direct children by element name."""

    source: str
    line: int
    label: str
    start: int
    attributes: dict[str, str]
    children: dict[str, Tag] = field(default_factory=dict)

    def bad(self, text: str) -> DhcalError:
        """The error that says what is wrong here, with file and line."""
        return DhcalError(f"{self.source}:{self.line}: {self.label}: {text}")


def show(text: str) -> str:
    """The text quoted, on one line and not too long for a message."""
    return repr(text if len(text) <= 60 else text[:57] + "...")


def instead(name: str, known: Iterable[str]) -> str:
    """A hint at the names that would have been right."""
    # Matching is quadratic in the length of a name, and names come from a file.
    short = [other for other in known if len(other) <= 100]
    close = difflib.get_close_matches(name[:100], short, 3)
    if close:
        return f"did you mean {' or '.join(map(show, close))}?"
    return f"there are {', '.join(map(show, short[:12]))}{', ...' if len(short) > 12 else ''}"


def numbers(tag: Tag, key: str, count: int) -> list[float]:
    """The finite numbers of one attribute."""
    # Expat has made spaces of all blanks but those written as &#9; and the like, which are no separators.
    words = [word for word in tag.attributes[key].split(" ") if word]
    if len(words) != count:
        plural = "number" if len(words) == 1 else "numbers"
        raise tag.bad(f"{key} has {len(words)} {plural}; it needs {count}, with blanks between them")
    for word in words:
        if not _NUMBER.fullmatch(word) or not math.isfinite(float(word)):
            raise tag.bad(f"{key} has {show(word)}; it needs a finite number such as 0.25 or -1e-3")
    return [float(word) for word in words]


def scan(data: bytes, source: str) -> tuple[Tag, dict[str, Tag], dict[str, Tag]]:
    """The tags of the robot, its links and its joints by name, from well-formed XML without entities."""
    parser = expat.ParserCreate("utf-8")
    depth, robot, joint = 0, None, None
    named: dict[str, dict[str, Tag]] = {"link": {}, "joint": {}}

    def tag(label: str, attributes: dict[str, str]) -> Tag:
        return Tag(source, parser.CurrentLineNumber, label, parser.CurrentByteIndex, attributes)

    def declaration(_version: str, encoding: str | None, _standalone: int) -> None:
        name = (encoding or "utf-8").lower()
        if name not in ("utf-8", "utf8") and not (name in ("us-ascii", "ascii") and data.isascii()):
            raise tag("<?xml>", {}).bad(f"the encoding is {show(name)}; convert the file to UTF-8")

    def doctype(*_: object) -> None:
        raise tag("<!DOCTYPE>", {}).bad("document types and entities are not accepted; remove it")

    def instruction(target: str, _: str) -> None:
        if depth > 0:  # before the robot they are common and harmless; inside, Pinocchio fails on them
            raise tag(f"<?{target[:60]}?>", {}).bad("processing instructions are not accepted; remove it")

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, robot, joint
        depth, label = depth + 1, f"<{name[:60]}>"
        if depth > _MAX_DEPTH:
            raise tag(label, {}).bad(f"nested too deep; at most {_MAX_DEPTH} levels are accepted")
        if name.startswith("xacro:") or any("${" in text or "$(" in text for text in attributes.values()):
            raise tag(label, {}).bad("unexpanded xacro; expand it first: xacro FILE > out.urdf")
        if depth == 1:
            robot = tag(label, attributes)
            if name != "robot":
                hint = "this is SDF, not URDF" if name == "sdf" else "this is no URDF"
                raise robot.bad(f"{hint}; the outermost element must be <robot>")
            if not attributes.get("name"):
                raise robot.bad('no name; it needs name="..."')
        elif depth == 2:
            joint = None
            if name not in named:
                return
            called, known = attributes.get("name", ""), named[name]
            one = tag(f"{name} {show(called)}", attributes)
            if not called:
                raise one.bad('no name; it needs name="..."')
            if called in known:
                raise one.bad(f"the name is taken on line {known[called].line}; give it another")
            if len(known) > _MAX_JOINTS:
                raise one.bad(f"too many; at most {_MAX_JOINTS} are accepted")
            known[called] = one
            joint = one if name == "joint" else None
        elif depth == 3 and joint is not None:
            child = tag(f"{joint.label} {label}", attributes)
            if name in _ONCE and name in joint.children:
                raise child.bad("a second one; keep one")
            joint.children.setdefault(name, child)

    parser.XmlDeclHandler, parser.StartDoctypeDeclHandler = declaration, doctype
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.ProcessingInstructionHandler = instruction
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        what = expat.ErrorString(error.code)
        raise DhcalError(
            f"{source}:{error.lineno}: broken XML: {what}; export or copy the file again, or mend this line"
        ) from None
    assert robot is not None, "expat refuses a document without an element"
    return robot, named["link"], named["joint"]


def quoted(text: str) -> str:
    """An attribute's value as XML has it, quotes included; `xml.sax.saxutils` would import an HTTP client."""
    return f'"{html.escape(text)}"'
