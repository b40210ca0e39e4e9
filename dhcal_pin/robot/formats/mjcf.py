"""MJCF, the robot files of MuJoCo: a parser that translates bodies, joints and sites to a URDF.

A body becomes a link, and a site a link that is fixed to its body; the world body is the root link `world`.
With the pose T in the file, a body with the joints 1 to k has the pose

    T · A_1 · Z(q_1 - ref_1) · A_1⁻¹ · A_2 · Z(q_2 - ref_2) · A_2⁻¹ · ...

in its parent, where A_i = Trans(pos_i) for a hinge and the identity for a slide, and Z is the motion of the
joint. Z(-ref) is a part of the origin, so joint positions are those of MuJoCo (`qpos`). `mjcf_edit` writes a
changed origin of joint 1 back to T; the origins of the others, and Trans(-pos) behind the last one, cannot be
written (`Urdf.fixed_origins`).

Orientations are read in all forms, in the units and the order of `compiler`, and poses of nested `frame`
elements are applied (https://mujoco.readthedocs.io/en/stable/XMLreference.html). Masses are read from
`inertial`. If MuJoCo computes a part of a robot's masses from its shapes, none is read. Constraints and
meshes are not read. Elements that MuJoCo replaces by others when it compiles the file are refused, and so are
default classes with poses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, fields, replace
from typing import NamedTuple

import numpy as np

from ... import se3
from ..._frozen import frozen
from ..._typing import Array, PathLike
from ...messages import quote
from ..urdf import MAX_MASS, MAX_ORIGIN, Urdf, parse_urdf, suggest_names, xml_attribute
from .xml_tags import XmlTag, number_text, parse_numbers, read_xml, scan

# Attributes of an orientation, with the number of their values.
ORIENTATIONS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
# Elements that MuJoCo replaces by other elements, and what to do with them.
_GENERATORS = {
    "include": "give the file that holds the robot, or write one file with MuJoCo (mj_saveLastXML)",
    "attach": "write one file with MuJoCo (mj_saveLastXML)",
    "replicate": "write out the copies (mj_saveLastXML)",
    "composite": "write out the bodies (mj_saveLastXML)",
    "flexcomp": "remove it from the file of the robot",
}
# URDF types by the type of a joint. A URDF has no balls; like free joints they may be beside the chain only.
_TYPES = {"hinge": "revolute", "slide": "prismatic", "ball": "floating", "free": "floating"}
# Smallest length of a direction or a quaternion.
_MIN_NORM = 1e-9


@frozen(eq=False)
class MjcfTag(XmlTag):
    """Start tag of an element of an MJCF."""

    element: str = ""
    children: list[MjcfTag] = field(default_factory=list)


class Place(NamedTuple):
    """Where the origin of a joint is in an MJCF: the origin is `before @ pose @ after`."""

    tag: MjcfTag  # Body or site with the pose
    before: Array  # Pose of the enclosing `frame` elements, shape (4, 4)
    after: Array  # Pose of the joint frame in the body, shape (4, 4)


@frozen(eq=False)
class Mjcf(Urdf):
    """MJCF that passed all checks, with its translation to a URDF."""

    file: bytes = field(default=b"", repr=False)  #: Bytes of the MJCF; `data` is the translation.
    places: Mapping[str, Place] = field(default_factory=dict, repr=False)  #: Places of origins by joint.
    document: MjcfTag | None = field(default=None, repr=False)  #: Outermost tag, with all others in it.


def read_mjcf(path: PathLike) -> Urdf:
    """Read and check an MJCF file; a URDF with the ending of MJCF is read, too."""
    return parse_mjcf(*read_xml(path, "an MJCF"))


def parse_mjcf(data: bytes, source: str) -> Urdf:
    """Parse and check the bytes of an MJCF, or of a URDF with its ending."""
    stack: list[MjcfTag] = []
    roots: list[MjcfTag] = []

    def on_start(depth: int, element: str, start: XmlTag) -> None:
        name = start.attributes.get("name")
        label = f"{element} {quote(name)}" if name else start.label
        tag = MjcfTag(source, start.line, label, start.start, start.attributes, element)
        del stack[depth - 1 :]
        (stack[-1].children if stack else roots).append(tag)
        stack.append(tag)
        if roots[0].element == "mujoco" and element in _GENERATORS:
            raise tag.error(f"cannot be written back; {_GENERATORS[element]}")

    scan(data, source, "MJCF", "mujoco", on_start)
    root = roots[0]
    if root.element == "robot":
        return parse_urdf(data, source)
    if root.element != "mujoco":
        raise root.error("neither MJCF nor URDF; expected <mujoco> or <robot> as the outermost element")
    translation = _Translation(root)
    worlds = [tag for tag in root.children if tag.element == "worldbody"]
    if not worlds:
        raise root.error("no <worldbody>; expected the bodies of a robot in it")
    translation.add_worlds(worlds)
    name = xml_attribute(root.attributes.get("model") or "robot")
    text = "\n".join([f"<robot name={name}>", *translation.lines, "</robot>", ""])
    urdf = parse_urdf(text.encode(), source)
    return Mjcf(
        **{
            **{item.name: getattr(urdf, item.name) for item in fields(urdf)},
            "joints": tuple(replace(joint, line=translation.tags[joint.name].line) for joint in urdf.joints),
            "fixed_origins": frozenset(translation.fixed_origins),
        },
        file=data,
        places=translation.places,
        document=root,
    )


def _require_finite(tag: MjcfTag, values: Array) -> Array:
    """Return the values of a pose, which must not be larger than a robot."""
    if np.abs(values).max() > MAX_ORIGIN:
        raise tag.error(f"a pose is beyond ±{MAX_ORIGIN:g}; expected metres")
    return values


def _unit(tag: MjcfTag, key: str, vector: Array) -> Array:
    """Return a vector with length 1."""
    # Unlike np.linalg.norm, the squares of large values are no overflow.
    if not _MIN_NORM <= (norm := math.hypot(*vector)) < math.inf:
        raise tag.error(f"{key} has length {norm:g}; expected a direction")
    return vector / norm


class _Scope(NamedTuple):
    """What the elements in a body, or in a `frame` of it, have in common."""

    link: str = "world"  # Link of the body
    frame: Array = np.eye(4)  # Pose of the enclosing `frame` elements in the body, shape (4, 4)
    childclass: str = ""  # Default class; empty for the outermost one
    has_masses: bool = False  # Whether the masses of the kinematic tree are read


class _Translation:
    """Lines of the URDF of an MJCF, and where the origins of its joints are."""

    def __init__(self, root: MjcfTag):
        self.lines: list[str] = []
        self.tags: dict[str, MjcfTag] = {}  # Tags behind the joints by name, for messages
        self.bodies: dict[str, MjcfTag] = {}
        self.places: dict[str, Place] = {}
        self.fixed_origins: set[str] = set()
        self.sites: list[tuple[MjcfTag, _Scope]] = []
        # Later settings of the compiler override earlier ones.
        compilers = [tag for tag in root.children if tag.element == "compiler"]
        self.settings: dict[str, str] = {}
        for tag in compilers:
            self.settings |= tag.attributes
        self.compiler = replace(compilers[-1], attributes=self.settings) if compilers else None
        self._check_compiler()
        self.defaults: dict[str, dict[str, dict[str, str]]] = {"": {}}
        for tag in root.children:
            if tag.element == "default":
                self._add_defaults(tag, "", "")

    # --- settings ------------------------------------------------------------------------------------

    def _check_compiler(self) -> None:
        """Require settings of the compiler that the reader knows."""
        tag = self.compiler
        if tag is None:
            return
        for key, values in {"angle": ("degree", "radian"), "coordinate": ("local",)}.items():
            if self.settings.get(key, values[0]) not in values:
                raise tag.error(f"{key} is {quote(self.settings[key])}; expected {' or '.join(values)}")
        order = self.settings.get("eulerseq", "xyz")
        if len(order) != 3 or set(order) - set("xyzXYZ"):
            raise tag.error(f"eulerseq is {quote(order)}; expected three axes such as xyz or XYZ")

    def _add_defaults(self, tag: MjcfTag, parent: str, name: str) -> None:
        """Add a default class and those in it."""
        defaults = {element: dict(attributes) for element, attributes in self.defaults[parent].items()}
        for child in tag.children:
            if child.element == "default":
                continue
            poses = {"pos", *ORIENTATIONS} & set(child.attributes)
            if poses and child.element in ("joint", "site", "body", "frame"):
                raise child.error(
                    f"a default class with {' and '.join(sorted(poses))} cannot be written back; write the "
                    f"attribute into each {child.element}"
                )
            defaults[child.element] = defaults.get(child.element, {}) | child.attributes
        self.defaults[name] = defaults
        for child in tag.children:
            if child.element == "default":
                if not child.attributes.get("class"):
                    raise child.error('no class; expected class="..."')
                self._add_defaults(child, name, child.attributes["class"])
        if not name and tag.attributes.get("class"):
            self.defaults[tag.attributes["class"]] = defaults
        if not name:
            self.defaults.setdefault("main", defaults)

    def _with_defaults(self, tag: MjcfTag, childclass: str) -> MjcfTag:
        """Return a tag with the attributes of its default class."""
        name = tag.attributes.get("class", childclass)
        if name not in self.defaults:
            raise tag.error(
                f"unknown default class {quote(name)}; {suggest_names(name, filter(None, self.defaults))}"
            )
        element = "joint" if tag.element == "freejoint" else tag.element
        return replace(tag, attributes=self.defaults[name].get(element, {}) | tag.attributes)

    def _angle(self, value: float) -> float:
        """Convert an angle of the file to radians."""
        return math.radians(value) if self.settings.get("angle", "degree") == "degree" else value

    # --- poses ---------------------------------------------------------------------------------------

    def pose(self, tag: MjcfTag) -> Array:
        """Return the pose of a body, a site, a frame or an inertial in its parent, shape (4, 4)."""
        position = parse_numbers(tag, "pos", 3) if "pos" in tag.attributes else [0.0, 0.0, 0.0]
        given = [key for key in ORIENTATIONS if key in tag.attributes]
        if len(given) > 1:
            raise tag.error(f"{' and '.join(given)} state the orientation twice; keep one")
        rotation = np.eye(3)
        if given:
            values = np.array(parse_numbers(tag, given[0], ORIENTATIONS[given[0]]))
            rotation = self._rotation(tag, given[0], values)
        return _require_finite(tag, se3.transform(rotation, position))

    def _rotation(self, tag: MjcfTag, key: str, values: Array) -> Array:
        """Compute the rotation of an orientation attribute, shape (3, 3)."""
        if key == "quat":
            return se3.quaternion_to_matrix(_unit(tag, key, values))
        if key == "axisangle":
            return se3.exp3(_unit(tag, key, values[:3]) * self._angle(values[3]))
        if key == "euler":
            rotation = np.eye(3)
            for axis, value in zip(self.settings.get("eulerseq", "xyz"), values, strict=True):
                turn = se3.exp3(np.eye(3)["xyz".index(axis.lower())] * self._angle(value))
                # Axes in lower case turn with the body.
                rotation = rotation @ turn if axis.islower() else turn @ rotation
            return rotation
        if key == "xyaxes":
            x = _unit(tag, key, values[:3])
            y = _unit(tag, key, values[3:] - (x @ values[3:]) * x)
            return np.stack([x, y, np.cross(x, y)], -1)
        # zaxis: the smallest rotation that turns z there
        z = _unit(tag, key, values)
        axis = np.array([-z[1], z[0], 0.0])
        sine = np.linalg.norm(axis)
        axis = axis / sine if sine > _MIN_NORM else np.array([1.0, 0.0, 0.0])
        return se3.exp3(axis * math.atan2(sine, z[2]))

    # --- bodies --------------------------------------------------------------------------------------

    def add_worlds(self, worlds: list[MjcfTag]) -> None:
        """Translate all bodies, then all sites: a name that a body and a site share means the body."""
        self.bodies["world"] = worlds[0]
        self.lines.append('<link name="world"/>')
        for world in worlds:
            self._add_elements(world, _Scope(childclass=world.attributes.get("childclass", "")))
        for tag, scope in self.sites:
            name = tag.attributes["name"]
            if name not in self.bodies:
                self.bodies[name] = tag
                self._add_link(name, None)
                self.places[f"{name} site"] = Place(tag, scope.frame, np.eye(4))
                origin = scope.frame @ self.pose(tag)
                self._add_joint(f"{name} site", tag, "fixed", scope.link, name, origin)

    def _add_elements(self, parent: MjcfTag, scope: _Scope) -> None:
        """Translate the bodies in a body or a frame, and collect the sites with a name and a pose."""
        for tag in parent.children:
            if tag.element == "frame":
                childclass = tag.attributes.get("childclass", scope.childclass)
                frame = scope.frame @ self.pose(tag)
                self._add_elements(tag, scope._replace(frame=frame, childclass=childclass))
            elif tag.element == "body":
                self._add_elements(tag, self._add_body(tag, scope))
            elif tag.element == "site" and tag.attributes.get("name") and "fromto" not in tag.attributes:
                self.sites.append((tag, scope))

    def _add_body(self, tag: MjcfTag, scope: _Scope) -> _Scope:
        """Translate a body and its joints; return the scope of its elements."""
        name = tag.attributes.get("name") or f"unnamed body {len(self.bodies) + 1}"
        if name in self.bodies:
            raise tag.error(f"the name is already used on line {self.bodies[name].line}; give it another one")
        self.bodies[name] = tag
        childclass = tag.attributes.get("childclass", scope.childclass)
        has_masses = scope.has_masses if scope.link != "world" else self._states_masses(tag, childclass)
        self._add_link(name, tag if has_masses else None)
        joints = [
            self._with_defaults(child, childclass)
            for child in tag.children
            if child.element in ("joint", "freejoint")
        ]
        link, origin = scope.link, scope.frame @ self.pose(tag)
        for number, joint in enumerate(joints):
            joint_name = joint.attributes.get("name") or f"unnamed joint {len(self.tags) + 1}"
            urdf_type, in_body, limits, axis = self._joint(joint)
            after = in_body @ self._at_reference(joint, urdf_type, axis)
            if number:
                self.fixed_origins.add(joint_name)
            else:
                self.places[joint_name] = Place(tag, scope.frame, after)
            is_last = number == len(joints) - 1 and np.array_equal(in_body, np.eye(4))
            child = name if is_last else f"{name} behind {joint_name}"
            if not is_last:
                self._add_link(child, None)
            self._add_joint(joint_name, joint, urdf_type, link, child, origin @ after, axis, limits)
            link, origin = child, se3.inverse(in_body)
        if link != name:
            fixed = f"{name} at its joint" if joints else f"{name} fixed"
            if joints:
                self.fixed_origins.add(fixed)
            else:
                self.places[fixed] = Place(tag, scope.frame, np.eye(4))
            self._add_joint(fixed, tag, "fixed", link, name, origin)
        return _Scope(name, childclass=childclass, has_masses=has_masses)

    def _joint(self, tag: MjcfTag) -> tuple[str, Array, tuple[float, float] | None, Array]:
        """Return the URDF type of a joint, its frame in the body, its limits and its axis."""
        mjcf_type = "free" if tag.element == "freejoint" else tag.attributes.get("type", "hinge")
        if mjcf_type not in _TYPES:
            raise tag.error(f"unknown type {quote(mjcf_type)}; choose from {', '.join(_TYPES)}")
        in_body, axis = np.eye(4), np.array([0.0, 0.0, 1.0])
        if mjcf_type in ("hinge", "ball") and "pos" in tag.attributes:
            in_body = _require_finite(tag, se3.translation(parse_numbers(tag, "pos", 3)))
        if "axis" in tag.attributes and mjcf_type in ("hinge", "slide"):
            axis = _unit(tag, "axis", np.array(parse_numbers(tag, "axis", 3)))
        limits = None
        if "range" in tag.attributes and tag.attributes.get("limited", "auto") != "false":
            lower, upper = parse_numbers(tag, "range", 2)
            if lower > upper:
                raise tag.error(f"range: lower {lower:g} is above upper {upper:g}; swap them")
            if mjcf_type == "hinge":
                lower, upper = self._angle(lower), self._angle(upper)
            limits = (lower, upper) if (lower, upper) != (0.0, 0.0) else None
        urdf_type = _TYPES[mjcf_type]
        if urdf_type == "revolute" and limits is None:
            urdf_type = "continuous"
        return urdf_type, in_body, limits, axis

    def _at_reference(self, tag: MjcfTag, urdf_type: str, axis: Array) -> Array:
        """Return the motion of a joint from its reference position to zero, shape (4, 4)."""
        if "ref" not in tag.attributes or urdf_type == "floating":
            return np.eye(4)
        reference = parse_numbers(tag, "ref", 1)[0]
        if urdf_type == "prismatic":
            return se3.translation(-reference * axis)
        return se3.transform(se3.exp3(-self._angle(reference) * axis), np.zeros(3))

    # --- lines ---------------------------------------------------------------------------------------

    def _add_joint(
        self,
        name: str,
        tag: MjcfTag,
        urdf_type: str,
        parent: str,
        child: str,
        origin: Array,
        axis: Array | None = None,
        limits: tuple[float, float] | None = None,
    ) -> None:
        """Add the line of a joint."""
        if name in self.tags:
            raise tag.error(f"the name is already used on line {self.tags[name].line}; give it another one")
        self.tags[name] = tag
        elements = [
            _pose_element(origin),
            f"<parent link={xml_attribute(parent)}/>",
            f"<child link={xml_attribute(child)}/>",
        ]
        if axis is not None:
            elements.append(f'<axis xyz="{number_text(axis).decode()}"/>')
        if urdf_type in ("revolute", "prismatic"):
            range_text = f'lower="{limits[0]!r}" upper="{limits[1]!r}" ' if limits else ""
            elements.append(f'<limit {range_text}effort="0" velocity="0"/>')
        self.lines.append(f'<joint name={xml_attribute(name)} type="{urdf_type}">{"".join(elements)}</joint>')

    def _add_link(self, name: str, tag: MjcfTag | None) -> None:
        """Add the line of a link, with the masses of a body if it is given."""
        inertials = [child for child in tag.children if child.element == "inertial"] if tag else []
        if not inertials:
            self.lines.append(f"<link name={xml_attribute(name)}/>")
            return
        inertial = inertials[0]
        keys = {"diaginertia": 3, "fullinertia": 6}
        given = [key for key in keys if key in inertial.attributes]
        for key in ("pos", "mass"):
            if key not in inertial.attributes:
                raise inertial.error(f"no {key}; expected {key}=...")
        mass = parse_numbers(inertial, "mass", 1)[0]
        if not 0 <= mass <= MAX_MASS:
            raise inertial.error(f"mass is outside of 0 to {MAX_MASS:g}; expected kilograms")
        # The order of fullinertia is xx, yy, zz, xy, xz, yz.
        moments = parse_numbers(inertial, given[0], keys[given[0]]) if given else [0.0] * 3
        names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        values = " ".join(
            f'{key}="{value!r}"' for key, value in zip(names, [*moments, 0.0, 0.0, 0.0], strict=False)
        )
        self.lines.append(
            f"<link name={xml_attribute(name)}><inertial>{_pose_element(self.pose(inertial))}"
            f'<mass value="{mass!r}"/><inertia {values}/></inertial></link>'
        )

    def _states_masses(self, tree: MjcfTag, childclass: str) -> bool:
        """Return whether the bodies of a kinematic tree that move have masses that the file states."""
        if self.settings.get("inertiafromgeom", "auto") == "true":
            return False
        # Elements with their default class, whether they move, and whether the body states its mass.
        elements = [(tree, childclass, False, False)]
        while elements:
            tag, childclass, moves, is_stated = elements.pop()
            childclass = tag.attributes.get("childclass", childclass)
            kinds = {child.element for child in tag.children}
            if tag.element == "body":
                moves, is_stated = moves or bool({"joint", "freejoint"} & kinds), "inertial" in kinds
            for child in tag.children:
                if child.element in ("body", "frame"):
                    elements.append((child, childclass, moves, is_stated))
                elif (
                    child.element == "geom" and moves and not is_stated and self._has_mass(child, childclass)
                ):
                    return False
        return True

    def _has_mass(self, geom: MjcfTag, childclass: str) -> bool:
        """Return whether a shape has a mass."""
        attributes = self._with_defaults(geom, childclass).attributes
        key = "mass" if "mass" in attributes else "density"
        return parse_numbers(replace(geom, attributes={key: attributes.get(key, "1")}), key, 1)[0] != 0


def _pose_element(pose: Array) -> str:
    """Write the origin of a URDF."""
    numbers = se3.to_xyz_rpy(pose)
    xyz, rpy = (number_text(part).decode() for part in (numbers[:3], numbers[3:]))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'
