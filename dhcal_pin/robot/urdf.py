"""The tags of a URDF from its bytes, with the place of each; nothing but plain, bounded XML is let in."""

from __future__ import annotations

import difflib
import html
import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from xml.parsers import expat

import numpy as np

from .. import se3
from .._typing import Array
from ..exceptions import DhcalError

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

    def error(self, text: str) -> DhcalError:
        """The error that says what is wrong here, with file and line."""
        return DhcalError(f"{self.source}:{self.line}: {self.label}: {text}")


def quote(text: str) -> str:
    """The text quoted, on one line and not too long for a message."""
    return repr(text if len(text) <= 60 else text[:57] + "...")


def suggest(name: str, known: Iterable[str]) -> str:
    """A hint at the names that would have been right."""
    # Matching is quadratic in the length of a name, and names come from a file.
    short = [other for other in known if len(other) <= 100]
    close = difflib.get_close_matches(name[:100], short, 3)
    if close:
        return f"did you mean {' or '.join(map(quote, close))}?"
    return f"there are {', '.join(map(quote, short[:12]))}{', ...' if len(short) > 12 else ''}"


def numbers(tag: Tag, key: str, count: int) -> list[float]:
    """The finite numbers of one attribute."""
    # Expat has made spaces of all blanks but those written as &#9; and the like, which are no separators.
    words = [word for word in tag.attributes[key].split(" ") if word]
    if len(words) != count:
        plural = "number" if len(words) == 1 else "numbers"
        raise tag.error(f"{key} has {len(words)} {plural}; it needs {count}, with blanks between them")
    for word in words:
        if not _NUMBER.fullmatch(word) or not math.isfinite(float(word)):
            raise tag.error(f"{key} has {quote(word)}; it needs a finite number such as 0.25 or -1e-3")
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
            raise tag("<?xml>", {}).error(f"the encoding is {quote(name)}; convert the file to UTF-8")

    def doctype(*_: object) -> None:
        raise tag("<!DOCTYPE>", {}).error("document types and entities are not accepted; remove it")

    def instruction(target: str, _: str) -> None:
        if depth > 0:  # before the robot they are common and harmless; inside, Pinocchio fails on them
            raise tag(f"<?{target[:60]}?>", {}).error("processing instructions are not accepted; remove it")

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, robot, joint
        depth, label = depth + 1, f"<{name[:60]}>"
        if depth > _MAX_DEPTH:
            raise tag(label, {}).error(f"nested too deep; at most {_MAX_DEPTH} levels are accepted")
        if name.startswith("xacro:") or any("${" in text or "$(" in text for text in attributes.values()):
            raise tag(label, {}).error("unexpanded xacro; expand it first: xacro FILE > out.urdf")
        if depth == 1:
            robot = tag(label, attributes)
            if name != "robot":
                hint = "this is SDF, not URDF" if name == "sdf" else "this is no URDF"
                raise robot.error(f"{hint}; the outermost element must be <robot>")
            if not attributes.get("name"):
                raise robot.error('no name; it needs name="..."')
        elif depth == 2:
            joint = None
            if name not in named:
                return
            called, known = attributes.get("name", ""), named[name]
            one = tag(f"{name} {quote(called)}", attributes)
            if not called:
                raise one.error('no name; it needs name="..."')
            if called in known:
                raise one.error(f"the name is taken on line {known[called].line}; give it another")
            if len(known) > _MAX_JOINTS:
                raise one.error(f"too many; at most {_MAX_JOINTS} are accepted")
            known[called] = one
            joint = one if name == "joint" else None
        elif depth == 3 and joint is not None:
            child = tag(f"{joint.label} {label}", attributes)
            if name in _ONCE and name in joint.children:
                raise child.error("a second one; keep one")
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


def xml_attribute(text: str) -> str:
    """An attribute's value as XML has it, quotes included; `xml.sax.saxutils` would import an HTTP client."""
    return f'"{html.escape(text)}"'


_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")


_MAX_BYTES = 16 << 20


MAX_ORIGIN = 1e4  # metres or radians: nobody's robot, somebody's typing error


_MAX_CHAIN = 500  # Pinocchio recurses along the chain: thousands of joints overflow its stack


# What Pinocchio insists on and would refuse without a line number.
_NEEDED = {
    "axis": ("xyz",),
    "parent": ("link",),
    "child": ("link",),
    "limit": ("effort", "velocity"),
    "mimic": ("joint",),
    "safety_controller": ("k_velocity",),
}


_NUMBERS = {
    "limit": ("lower", "upper", "effort", "velocity"),
    "mimic": ("multiplier", "offset"),
    "dynamics": ("damping", "friction"),
    "calibration": ("rising", "falling"),
    "safety_controller": ("soft_lower_limit", "soft_upper_limit", "k_position", "k_velocity"),
}


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """One joint of a URDF.

    Attributes:
        name: unique among the joints.
        type: revolute, continuous, prismatic, fixed, floating or planar.
        parent, child: names of the links it connects.
        origin: (4, 4) pose of the joint frame in the parent link, m; identity if the file has none.
        axis: (3,) unit axis in the joint frame; (1, 0, 0) if the file has none.
        lower, upper: limits in rad or m; infinite where the file has none and on a continuous joint.
        mimic: (joint, multiplier, offset) that this joint follows, or None.
        line: its line in the file, from 1.
        start, first_child, origin_start: byte offsets of its tag, its first child and its <origin>.
    """

    name: str
    type: str
    parent: str
    child: str
    origin: Array
    axis: Array
    lower: float
    upper: float
    mimic: tuple[str, float, float] | None
    line: int
    start: int = field(repr=False)
    first_child: int = field(repr=False)
    origin_start: int | None = field(repr=False)


@dataclass(frozen=True, eq=False)
class Urdf:
    """A URDF file that passed all checks: its links and joints are one tree.

    Attributes:
        source: what to call it in messages.
        data: the exact bytes.
        name: the robot's name.
        links, joints: in the order of the file.
        root: the link without a parent.
    """

    source: str
    data: bytes = field(repr=False)
    name: str
    links: tuple[str, ...]
    joints: tuple[UrdfJoint, ...]
    root: str

    @cached_property
    def _named(self) -> dict[str, UrdfJoint]:
        return {joint.name: joint for joint in self.joints}

    @cached_property
    def _above(self) -> dict[str, UrdfJoint]:
        return {joint.child: joint for joint in self.joints}

    def joint(self, name: str) -> UrdfJoint:
        """The joint of that name.

        Raises:
            DhcalError: there is none; the message names the nearest ones.
        """
        if name not in self._named:
            raise DhcalError(f"{self.source}: no joint {quote(name)}; {suggest(name, self._named)}")
        return self._named[name]

    def leaves(self) -> tuple[str, ...]:
        """Links without children, in the order of the file."""
        inner = {joint.parent for joint in self.joints}
        return tuple(link for link in self.links if link not in inner)

    def path(self, tip: str) -> tuple[UrdfJoint, ...]:
        """Joints from the root to the link `tip`, in that order; empty for the root itself.

        Raises:
            DhcalError: there is no such link; the message names the nearest ones.
        """
        if tip != self.root and tip not in self._above:
            raise DhcalError(f"{self.source}: no link {quote(tip)}; {suggest(tip, self.links)}")
        joints = []
        while tip in self._above:
            joints.append(self._above[tip])
            tip = joints[-1].parent
        return tuple(reversed(joints))


def _rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Rz(yaw)·Ry(pitch)·Rx(roll) (3, 3) of angles in radians."""
    (cr, cp, cy), (sr, sp, sy) = np.cos((roll, pitch, yaw)), np.sin((roll, pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _origin(tag: Tag) -> Array:
    """The pose (4, 4) that an <origin> gives."""
    if "quat_xyzw" in tag.attributes:
        raise tag.error("quat_xyzw is ignored by most readers of URDF; write the rotation as rpy")
    values = {key: [0.0, 0.0, 0.0] for key in ("xyz", "rpy")}
    for key in [key for key in values if key in tag.attributes]:
        values[key] = numbers(tag, key, 3)
        if max(map(abs, values[key])) > MAX_ORIGIN:
            raise tag.error(f"{key} is beyond ±{MAX_ORIGIN:g}; it needs metres in xyz and radians in rpy")
    return se3.transform(_rotation(*values["rpy"]), values["xyz"])


def _axis(tag: Tag, moving: bool) -> Array:
    """The unit axis (3,) that an <axis> gives; x, which has no meaning, where nothing moves."""
    axis = np.array(numbers(tag, "xyz", 3))
    norm = math.hypot(*axis)
    if 1e-6 <= norm <= 1e6:
        return axis / norm
    if moving:
        raise tag.error(f"its length is {norm:g}; it needs a direction of length 1, such as 0 0 1")
    return np.array([1.0, 0.0, 0.0])


def _joint(tag: Tag) -> UrdfJoint:
    """A joint from its tag."""
    kind, inside = tag.attributes.get("type"), tag.children
    if kind is None:
        raise tag.error(f"no type; it needs one of {', '.join(_TYPES)}")
    if kind not in _TYPES:
        raise tag.error(f"unknown type {quote(kind)}; it needs one of {', '.join(_TYPES)}")
    for name in ("parent", "child"):
        if name not in inside:
            raise tag.error(f'no <{name}>; it needs <{name} link="..."/>')
    for name, keys in _NEEDED.items():
        for key in keys:
            if name in inside and key not in inside[name].attributes:
                raise inside[name].error(f"no {key}; it needs {key}=...")
    values = {
        (name, key): numbers(inside[name], key, 1)[0]
        for name, keys in _NUMBERS.items()
        for key in keys
        if name in inside and key in inside[name].attributes
    }
    if "dynamics" in inside and not any(name == "dynamics" for name, _ in values):
        raise inside["dynamics"].error("neither damping nor friction; add one or remove it")
    lower, upper = -math.inf, math.inf
    if kind in ("revolute", "prismatic"):
        if "limit" not in inside:
            raise tag.error(f"a {kind} joint has no <limit>; it needs lower, upper, effort and velocity")
        lower, upper = values.get(("limit", "lower"), lower), values.get(("limit", "upper"), upper)
        if lower > upper:
            raise inside["limit"].error(f"lower {lower:g} is above upper {upper:g}; swap them")
    mimic = None
    if "mimic" in inside:
        factor, offset = values.get(("mimic", "multiplier"), 1.0), values.get(("mimic", "offset"), 0.0)
        mimic = inside["mimic"].attributes["joint"], factor, offset
    moving = kind in ("revolute", "continuous", "prismatic")
    return UrdfJoint(
        name=tag.attributes["name"],
        type=kind,
        parent=inside["parent"].attributes["link"],
        child=inside["child"].attributes["link"],
        origin=_origin(inside["origin"]) if "origin" in inside else np.eye(4),
        axis=_axis(inside["axis"], moving) if "axis" in inside else np.array([1.0, 0.0, 0.0]),
        lower=lower,
        upper=upper,
        mimic=mimic,
        line=tag.line,
        start=tag.start,
        first_child=next(iter(inside.values())).start,
        origin_start=inside["origin"].start if "origin" in inside else None,
    )


def _on_loop(after: Mapping[str, str]) -> str | None:
    """A name from which following `after` comes back to it, if there is any."""
    settled: set[str] = set()
    for name in after:
        trail: set[str] = set()
        while name in after and name not in settled and name not in trail:
            trail.add(name)
            name = after[name]
        if name in trail:
            return name
        settled |= trail
    return None


def _root(robot: Tag, links: dict[str, Tag], joints: dict[str, UrdfJoint], tags: dict[str, Tag]) -> str:
    """The root link, after checking that links, joints and mimics are a tree."""
    above: dict[str, UrdfJoint] = {}
    for joint in joints.values():
        tag = tags[joint.name]
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                raise tag.children[role].error(f"no link {quote(link)}; {suggest(link, links)}")
        if joint.child in above:
            other = above[joint.child].name
            raise tag.error(
                f"its child {quote(joint.child)} already hangs on joint {quote(other)}; "
                "a link has one parent, so remove one of them"
            )
        above[joint.child] = joint
    mimics = {joint.name: joint.mimic[0] for joint in joints.values() if joint.mimic}
    if (name := _on_loop(mimics)) is not None:
        raise tags[name].children["mimic"].error("it mimics itself in a circle; let one joint of it be free")
    if (link := _on_loop({link: joint.parent for link, joint in above.items()})) is not None:
        raise tags[above[link].name].error("its child is also above its parent; links must form a tree")
    roots = [link for link in links if link not in above]
    if not roots:
        raise robot.error('no links; it needs at least one <link name="..."/>')
    if len(roots) > 1:
        raise links[roots[1]].error(
            f"no joint leads here nor to link {quote(roots[0])}; join them: a robot has one root"
        )
    depth = {roots[0]: 0}
    for link in above:
        trail = []
        while link not in depth:
            trail.append(link)
            link = above[link].parent
        for below in reversed(trail):
            depth[below] = depth[above[below].parent] + 1
            if depth[below] > _MAX_CHAIN:
                raise tags[above[below].name].error(f"more than {_MAX_CHAIN} joints in a row; check the file")
    return roots[0]


def parse_urdf(data: bytes, source: str) -> Urdf:
    """A URDF from its bytes, refused unless everything about its kinematics is sound.

    Args:
        data: the file's bytes, UTF-8.
        source: what to call it in messages.

    Raises:
        DhcalError: it is not a sound URDF; the message names the line.
    """
    if len(data) > _MAX_BYTES:
        raise DhcalError(f"{source}: larger than {_MAX_BYTES >> 20} MiB; no URDF is: check the file")
    if not data.strip():
        raise DhcalError(f"{source}:1: the file is empty; it needs a <robot> element")
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise DhcalError(f"{source}:{line}: not UTF-8; convert the file to UTF-8") from None
    if b"\0" in data:
        raise DhcalError(f"{source}:1: zero bytes as in UTF-16; convert the file to UTF-8")
    robot, links, tags = scan(data, source)
    joints = {name: _joint(tag) for name, tag in tags.items()}
    root = _root(robot, links, joints, tags)
    return Urdf(source, data, robot.attributes["name"], tuple(links), tuple(joints.values()), root)


def read_urdf(path: str | os.PathLike[str]) -> Urdf:
    """A URDF from a file, refused unless everything about its kinematics is sound.

    Raises:
        DhcalError: the file cannot be read or is not a sound URDF; the message names the line.
    """
    source = os.fspath(path)
    try:
        with open(source, "rb") as file:
            data = file.read(_MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        what = getattr(error, "strerror", None) or str(error)
        raise DhcalError(f"{source}: cannot be read: {what}; give the path of a URDF file") from None
    return parse_urdf(data, source)
