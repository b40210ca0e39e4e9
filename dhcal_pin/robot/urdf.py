"""URDF files: a safe parser that checks everything about the kinematics before any library reads the file.

The XML is parsed by `xml_tags`, and unexpanded xacro is refused. The byte offset of every tag is recorded, so
that `urdf_edit` can rewrite single attributes. Errors name file and line. A `Urdf` is a tree of links and
joints without cycles, whose numbers are finite.

Lengths are in metres and angles in radians. The origin of a joint is the pose of its frame in the frame of
its parent link, T = Trans(xyz) · Rz(yaw) · Ry(pitch) · Rx(roll), as in the URDF specification
(https://wiki.ros.org/urdf/XML/joint).
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import field
from functools import cached_property

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array, PathLike
from ..exceptions import UnknownNameError
from ..messages import quote
from ..ros_packages import mesh_folders
from .formats.xml_tags import XmlTag, parse_numbers, read_xml, scan

# Maximum number of links and of joints.
_MAX_ELEMENTS = 20_000

# Maximum number of joints in a row. Pinocchio recurses along the chain and overflows its stack at thousands.
_MAX_CHAIN = 500

# Maximum magnitude of an origin's numbers [m or rad]; larger ones are typing errors.
MAX_ORIGIN = 1e4

# Maximum mass of a link [kg].
MAX_MASS = 1e6

_JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")

# Elements of which a joint, a link or an inertial may have one.
_UNIQUE_ELEMENTS = {
    "joint": ("origin", "axis", "parent", "child", "limit", "mimic"),
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
}

# Attributes that Pinocchio requires; it reports a missing one without a line number.
_REQUIRED_ATTRIBUTES = {
    "axis": ("xyz",),
    "parent": ("link",),
    "child": ("link",),
    "limit": ("effort", "velocity"),
    "mimic": ("joint",),
    "safety_controller": ("k_velocity",),
}

# Attributes that must be one finite number.
_NUMERIC_ATTRIBUTES = {
    "limit": ("lower", "upper", "effort", "velocity"),
    "mimic": ("multiplier", "offset"),
    "dynamics": ("damping", "friction"),
    "calibration": ("rising", "falling"),
    "safety_controller": ("soft_lower_limit", "soft_upper_limit", "k_position", "k_velocity"),
}

# What other files are, by their outermost element.
_OTHER_FORMATS = {
    "sdf": "this is SDF, not URDF",
    "mujoco": "this is MJCF, which is read by read_robot from files that end with .xml",
}


@frozen(eq=False)
class UrdfTag(XmlTag):
    """Start tag of an element of a URDF."""

    children: dict[str, UrdfTag] = field(default_factory=dict)  # Tags of the direct children by element name


@frozen(eq=False)
class UrdfJoint:
    """Joint of a URDF."""

    name: str  #: Name, unique among the joints.
    type: str  #: "revolute", "continuous", "prismatic", "fixed", "floating" or "planar".
    parent: str  #: Name of the parent link.
    child: str  #: Name of the child link.
    #: Pose of the joint frame in the parent link, shape (4, 4) [m]; identity if the file has none.
    origin: Array
    #: Roll, pitch and yaw of the origin as in the file, shape (3,) [rad]; zeros if the file has none.
    rpy: Array
    axis: Array  #: Unit axis in the joint frame, shape (3,); (1, 0, 0) if the file has none.
    lower: float  #: Lower limit [rad or m]; -inf if the file has none and for continuous joints.
    upper: float  #: Upper limit [rad or m]; inf if the file has none and for continuous joints.
    #: Name of the joint that this joint mimics, multiplier and offset; None if it mimics none.
    mimic: tuple[str, float, float] | None
    line: int  #: Line of the tag, from 1.
    start: int = field(repr=False)  #: Byte offset of the tag.
    first_child: int = field(repr=False)  #: Byte offset of the first child element.
    #: Byte offset of the <origin> tag; None if the file has none.
    origin_start: int | None = field(repr=False)


@frozen(eq=False)
class Urdf:
    """URDF file that passed all checks: its links and joints form one tree."""

    source: str  #: Path of the file, or another name for messages.
    data: bytes = field(repr=False)  #: Bytes of the file.
    name: str  #: Name of the robot.
    links: tuple[str, ...]  #: Names of the links in the order of the file.
    joints: tuple[UrdfJoint, ...]  #: Joints in the order of the file.
    root: str  #: Name of the link without a parent.
    #: Folders in which packages with meshes are searched first, see `mesh_folders`.
    package_dirs: tuple[str, ...] = ()
    #: Names of joints whose origins the file cannot hold, see `mjcf`.
    fixed_origins: frozenset[str] = frozenset()

    @cached_property
    def _joints_by_name(self) -> dict[str, UrdfJoint]:
        return {joint.name: joint for joint in self.joints}

    @cached_property
    def _joints_by_child(self) -> dict[str, UrdfJoint]:
        return {joint.child: joint for joint in self.joints}

    def joint(self, name: str) -> UrdfJoint:
        """Return a joint by name."""
        if name not in self._joints_by_name:
            suggestion = suggest_names(name, self._joints_by_name)
            raise UnknownNameError(f"{self.source}: unknown joint {quote(name)}; {suggestion}")
        return self._joints_by_name[name]

    def mesh_folders(self) -> list[str]:
        """List the folders in which the meshes of the robot are searched, see `ros_packages`."""
        return mesh_folders(self.source, self.package_dirs)

    def leaves(self) -> tuple[str, ...]:
        """Return the links without children, in the order of the file."""
        parents = {joint.parent for joint in self.joints}
        return tuple(link for link in self.links if link not in parents)

    def path(self, tip: str) -> tuple[UrdfJoint, ...]:
        """Return the joints between the root and a link."""
        if tip != self.root and tip not in self._joints_by_child:
            raise UnknownNameError(
                f"{self.source}: unknown link {quote(tip)}; {suggest_names(tip, self.links)}"
            )
        joints = []
        while tip in self._joints_by_child:
            joints.append(self._joints_by_child[tip])
            tip = joints[-1].parent
        return tuple(reversed(joints))


def read_urdf(path: PathLike) -> Urdf:
    """Read and check a URDF file."""
    return parse_urdf(*read_xml(path, "a URDF"))


def parse_urdf(data: bytes, source: str) -> Urdf:
    """Parse and check the bytes of a URDF."""
    robot, link_tags, joint_tags = scan_tags(data, source)
    for tag in link_tags.values():
        if "inertial" in tag.children:
            _check_inertial(tag.children["inertial"])
    joints = {name: _parse_joint(tag) for name, tag in joint_tags.items()}
    root = _find_root(robot, link_tags, joints, joint_tags)
    return Urdf(source, data, robot.attributes["name"], tuple(link_tags), tuple(joints.values()), root)


def scan_tags(data: bytes, source: str) -> tuple[UrdfTag, dict[str, UrdfTag], dict[str, UrdfTag]]:
    """Find the tags of the robot, its links and its joints; a `FileFormatError` names the line."""
    robot: UrdfTag | None = None
    # Link or joint and which of both it is, and in a link its inertial, whose children are collected.
    parent: UrdfTag | None = None
    inertial: UrdfTag | None = None
    kind = ""
    tags_by_kind: dict[str, dict[str, UrdfTag]] = {"link": {}, "joint": {}}

    def urdf_tag(tag: XmlTag, label: str) -> UrdfTag:
        return UrdfTag(source, tag.line, label, tag.start, tag.attributes)

    def add_child(tag: UrdfTag, kind: str, element: str, start: XmlTag) -> UrdfTag:
        child = urdf_tag(start, f"{tag.label} {start.label}")
        if element in _UNIQUE_ELEMENTS[kind] and element in tag.children:
            raise child.error("a second element of this kind; keep one")
        return tag.children.setdefault(element, child)

    def on_start(depth: int, element: str, start: XmlTag) -> None:
        nonlocal robot, parent, inertial, kind
        attributes = start.attributes
        if element.startswith("xacro:") or any("${" in text or "$(" in text for text in attributes.values()):
            raise start.error("unexpanded xacro; expand it first: xacro FILE > out.urdf")
        if depth == 1:
            robot = urdf_tag(start, start.label)
            if element != "robot":
                format_name = _OTHER_FORMATS.get(element, "this is not a URDF")
                raise robot.error(f"{format_name}; expected <robot> as the outermost element")
            if not attributes.get("name"):
                raise robot.error('no name; expected name="..."')
        elif depth == 2:
            parent = inertial = None
            if element not in tags_by_kind:
                return
            name, siblings = attributes.get("name", ""), tags_by_kind[element]
            tag = urdf_tag(start, f"{element} {quote(name)}")
            if not name:
                raise tag.error('no name; expected name="..."')
            if name in siblings:
                raise tag.error(
                    f"the name is already used on line {siblings[name].line}; give it another one"
                )
            if len(siblings) > _MAX_ELEMENTS:
                raise tag.error(f"too many; at most {_MAX_ELEMENTS} are accepted")
            siblings[name] = tag
            parent, kind = tag, element
        elif depth == 3 and parent is not None:
            child = add_child(parent, kind, element, start)
            inertial = child if kind == "link" and element == "inertial" else None
        elif depth == 4 and inertial is not None:
            add_child(inertial, "inertial", element, start)

    scan(data, source, "URDF", "robot", on_start)
    assert robot is not None, "expat refuses a document without an element"
    return robot, tags_by_kind["link"], tags_by_kind["joint"]


def suggest_names(name: str, known: Iterable[str]) -> str:
    """Suggest names that are similar to an unknown one, or list the known names."""
    # Matching takes quadratic time in the length of a name, and the names come from a file.
    short = [other for other in known if len(other) <= 100]
    if not short:
        return "the file has none"
    similar = difflib.get_close_matches(name[:100], short, 3)
    if similar:
        return f"did you mean {' or '.join(map(quote, similar))}?"
    return f"choose from {', '.join(map(quote, short[:12]))}{', ...' if len(short) > 12 else ''}"


def xml_attribute(text: str) -> str:
    """Write an XML attribute with quotes, as `xml.sax.saxutils.quoteattr`, which imports an HTTP client."""
    from html import escape  # lazy import: its table of names is large

    return f'"{escape(text)}"'


def _rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Compute Rz(yaw)·Ry(pitch)·Rx(roll), shape (3, 3), of angles [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos((roll, pitch, yaw)), np.sin((roll, pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _parse_origin(tag: UrdfTag | None) -> tuple[Array, Array]:
    """Parse an <origin> to a pose, shape (4, 4), and its roll, pitch and yaw, shape (3,)."""
    if tag is None:
        return np.eye(4), np.zeros(3)
    if "quat_xyzw" in tag.attributes:
        raise tag.error("quat_xyzw is ignored by most readers of URDF; write the rotation as rpy")
    values = {key: [0.0, 0.0, 0.0] for key in ("xyz", "rpy")}
    for key in [key for key in values if key in tag.attributes]:
        values[key] = parse_numbers(tag, key, 3)
        if max(map(abs, values[key])) > MAX_ORIGIN:
            raise tag.error(f"{key} is beyond ±{MAX_ORIGIN:g}; expected metres in xyz and radians in rpy")
    return se3.transform(_rotation(*values["rpy"]), values["xyz"]), np.array(values["rpy"])


def _parse_axis(tag: UrdfTag, moving: bool) -> Array:
    """Parse an <axis> to a unit vector, shape (3,); the axis of a joint that does not move may be zero."""
    axis = np.array(parse_numbers(tag, "xyz", 3))
    norm = math.hypot(*axis)
    if 1e-6 <= norm <= 1e6:
        return axis / norm
    if moving:
        raise tag.error(f"the axis has length {norm:g}; expected a direction of length 1, such as 0 0 1")
    return np.array([1.0, 0.0, 0.0])


def _check_inertial(tag: UrdfTag) -> None:
    """Require valid numbers in an <inertial>; Pinocchio would leave out its mass and only print a message."""
    if "mass" not in tag.children:
        raise tag.error('no <mass>; expected <mass value="..."/>, or remove the inertial')
    mass = tag.children["mass"]
    if "value" not in mass.attributes:
        raise mass.error("no value; expected value=...")
    if not 0 <= parse_numbers(mass, "value", 1)[0] <= MAX_MASS:
        raise mass.error(f"value is outside of 0 to {MAX_MASS:g}; expected kilograms")
    if "origin" in tag.children:
        _parse_origin(tag.children["origin"])
    if inertia := tag.children.get("inertia"):
        for key in sorted({"ixx", "ixy", "ixz", "iyy", "iyz", "izz"} & set(inertia.attributes)):
            parse_numbers(inertia, key, 1)


def _parse_joint(tag: UrdfTag) -> UrdfJoint:
    """Parse a joint from its tag."""
    joint_type, children = tag.attributes.get("type"), tag.children
    if joint_type is None:
        raise tag.error(f"no type; expected one of {', '.join(_JOINT_TYPES)}")
    if joint_type not in _JOINT_TYPES:
        raise tag.error(f"unknown type {quote(joint_type)}; choose from {', '.join(_JOINT_TYPES)}")
    for element in ("parent", "child"):
        if element not in children:
            raise tag.error(f'no <{element}>; expected <{element} link="..."/>')
    for element, keys in _REQUIRED_ATTRIBUTES.items():
        for key in keys:
            if element in children and key not in children[element].attributes:
                raise children[element].error(f"no {key}; expected {key}=...")
    values = {
        (element, key): parse_numbers(children[element], key, 1)[0]
        for element, keys in _NUMERIC_ATTRIBUTES.items()
        for key in keys
        if element in children and key in children[element].attributes
    }
    if "dynamics" in children and not any(element == "dynamics" for element, _ in values):
        raise children["dynamics"].error("neither damping nor friction; add one or remove the element")
    lower, upper = -math.inf, math.inf
    if joint_type in ("revolute", "prismatic"):
        if "limit" not in children:
            raise tag.error(
                f"a {joint_type} joint has no <limit>; expected lower, upper, effort and velocity"
            )
        lower, upper = values.get(("limit", "lower"), lower), values.get(("limit", "upper"), upper)
        if lower > upper:
            raise children["limit"].error(f"lower {lower:g} is above upper {upper:g}; swap them")
    mimic = None
    if "mimic" in children:
        factor, offset = values.get(("mimic", "multiplier"), 1.0), values.get(("mimic", "offset"), 0.0)
        mimic = children["mimic"].attributes["joint"], factor, offset
    moving = joint_type in ("revolute", "continuous", "prismatic")
    origin, rpy = _parse_origin(children.get("origin"))
    return UrdfJoint(
        name=tag.attributes["name"],
        type=joint_type,
        parent=children["parent"].attributes["link"],
        child=children["child"].attributes["link"],
        origin=origin,
        rpy=rpy,
        axis=_parse_axis(children["axis"], moving) if "axis" in children else np.array([1.0, 0.0, 0.0]),
        lower=lower,
        upper=upper,
        mimic=mimic,
        line=tag.line,
        start=tag.start,
        first_child=next(iter(children.values())).start,
        origin_start=children["origin"].start if "origin" in children else None,
    )


def _find_cycle(successors: Mapping[str, str]) -> str | None:
    """Return a name on a cycle of a graph with one successor per name, or None."""
    acyclic: set[str] = set()
    for name in successors:
        visited: set[str] = set()
        while name in successors and name not in acyclic and name not in visited:
            visited.add(name)
            name = successors[name]
        if name in visited:
            return name
        acyclic |= visited
    return None


def _find_root(
    robot: UrdfTag,
    link_tags: dict[str, UrdfTag],
    joints: dict[str, UrdfJoint],
    joint_tags: dict[str, UrdfTag],
) -> str:
    """Return the root link after checking that the links form a tree and that mimics have no cycle."""
    by_child: dict[str, UrdfJoint] = {}
    for joint in joints.values():
        tag = joint_tags[joint.name]
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in link_tags:
                raise tag.children[role].error(
                    f"unknown link {quote(link)}; {suggest_names(link, link_tags)}"
                )
        if joint.child in by_child:
            other = by_child[joint.child].name
            raise tag.error(
                f"its child {quote(joint.child)} is already the child of joint {quote(other)}; "
                "a link has one parent, so remove one of the joints"
            )
        by_child[joint.child] = joint
    mimics = {joint.name: joint.mimic[0] for joint in joints.values() if joint.mimic}
    if (name := _find_cycle(mimics)) is not None:
        raise (
            joint_tags[name]
            .children["mimic"]
            .error("the joint mimics itself in a cycle; remove one <mimic> of the cycle")
        )
    if (link := _find_cycle({link: joint.parent for link, joint in by_child.items()})) is not None:
        raise joint_tags[by_child[link].name].error(
            "the joint closes a loop of links; links must form a tree"
        )
    roots = [link for link in link_tags if link not in by_child]
    if not roots:
        raise robot.error('no links; expected at least one <link name="..."/>')
    if len(roots) > 1:
        raise link_tags[roots[1]].error(
            f"neither this link nor link {quote(roots[0])} is the child of a joint; a robot has one root, so "
            "connect them by a joint"
        )
    depth = {roots[0]: 0}
    for link in by_child:
        ancestors = []
        while link not in depth:
            ancestors.append(link)
            link = by_child[link].parent
        for descendant in reversed(ancestors):
            depth[descendant] = depth[by_child[descendant].parent] + 1
            if depth[descendant] > _MAX_CHAIN:
                raise joint_tags[by_child[descendant].name].error(
                    f"more than {_MAX_CHAIN} joints in a row; check the file"
                )
    return roots[0]
