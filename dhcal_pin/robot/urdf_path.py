"""The path through a URDF from a link to a tip: moving joints, independent joints, and joint frames.

The path begins at the root of the URDF, or at any other link. From another link it leads up to the last link
that both ends have in common, through *reversed* joints, from child to parent, and then down to the tip. A
reversed joint moves about its negative axis. With the pose M of each joint in the moving joint before it
towards the root of the URDF, the constant transforms of the path are

    M of the next joint        between two joints that are not reversed,
    M⁻¹ of the joint before    between two reversed joints,
    M⁻¹·M                      at the turn.

The values of the k moving joints follow from those of the n independent joints by the mimic rules of the
URDF, composed along chains of mimics:

    positions = mimic_matrix @ q + mimic_offset

Joint frames and axes come from Pinocchio's model, which merges fixed joints into the origin of the next
moving joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import pinocchio as pin

from .. import se3
from .._typing import Array
from ..exceptions import DhcalError, FileFormatError
from ..messages import quote
from ..native_output import discard_native_messages
from .urdf import Urdf, UrdfJoint, suggest_names

# Maximum number of moving joints. The work grows with the cube of the number of parameters.
_MAX_MOVING_JOINTS = 64


@lru_cache(maxsize=4)
def _parsed_model(urdf: bytes) -> pin.Model:
    """Build Pinocchio's model of a URDF; a calibration needs the same few URDFs many times."""
    # Pinocchio separates numbers at spaces only; XML allows any white space.
    text = urdf.decode("utf-8-sig").translate(dict.fromkeys(b"\t\r\n", " "))
    with discard_native_messages():
        return pin.buildModelFromXML(text)


def build_model(urdf: Urdf) -> pin.Model:
    """Build Pinocchio's model of the whole robot."""
    try:
        return _parsed_model(urdf.data).copy()
    except (ValueError, RuntimeError) as error:
        raise FileFormatError(f"{urdf.source}: Pinocchio does not accept this URDF: {error}") from error


def default_tip(urdf: Urdf) -> str:
    """Choose the leaf behind the most moving joints: `tool0`, or that behind the most links."""
    paths = {leaf: urdf.path(leaf) for leaf in urdf.leaves()}
    depths = {leaf: (sum(j.type != "fixed" for j in path), len(path)) for leaf, path in paths.items()}
    deepest = max(depths.values())
    candidates = [leaf for leaf, depth in depths.items() if depth[0] == deepest[0]]
    if "tool0" in candidates:
        return "tool0"
    tied = [leaf for leaf in candidates if depths[leaf] == deepest]
    if len(tied) > 1:
        shared = set.intersection(*({joint.child for joint in paths[leaf]} for leaf in tied))
        common = [joint.child for joint in paths[tied[0]] if joint.child in shared]
        alternative = f" (or {common[-1]}, the last link they share)" if common else ""
        raise DhcalError(
            f"{urdf.source}: several tips are equally deep; "
            f"choose the tip, --tip: {', '.join(sorted(candidates))}{alternative}"
        )
    return tied[0]


def path_between(urdf: Urdf, root: str, tip: str) -> list[tuple[UrdfJoint, bool]]:
    """Find the joints on the path from one link to another."""
    up, down = urdf.path(root), urdf.path(tip)
    n_common = 0
    while n_common < min(len(up), len(down)) and up[n_common].name == down[n_common].name:
        n_common += 1
    reversed_part = [(joint, True) for joint in reversed(up[n_common:])]
    return reversed_part + [(joint, False) for joint in down[n_common:]]


def find_moving_joints(urdf: Urdf, tip: str, root: str) -> list[tuple[UrdfJoint, bool]]:
    """Find the joints that move between a link and a tip."""
    joints = [(joint, up) for joint, up in path_between(urdf, root, tip) if joint.type != "fixed"]
    for joint, _ in joints:
        if joint.type in ("floating", "planar"):
            raise DhcalError(
                f"{urdf.source}:{joint.line}: joint {joint.name!r} is {joint.type}; expected revolute, "
                f"continuous, prismatic and fixed joints on the path to {tip!r}: make it fixed, at the pose "
                "that it has during the measurement"
            )
    if not joints:
        raise DhcalError(
            f"{urdf.source}: no moving joint between {root!r} and {tip!r}; "
            "choose a tip behind moving joints, --tip"
        )
    if len(joints) > _MAX_MOVING_JOINTS:
        raise DhcalError(
            f"{urdf.source}: {len(joints)} moving joints between {root!r} and {tip!r}; "
            f"at most {_MAX_MOVING_JOINTS} are accepted: choose a tip closer to the root, --tip"
        )
    return joints


def independent_joints(urdf: Urdf, moving: list[str]) -> tuple[list[str], Array, Array]:
    """Find the independent joints behind the moving joints, and the mimic rules between them."""
    movable = [joint.name for joint in urdf.joints if joint.type in ("revolute", "continuous", "prismatic")]
    rules = []
    for name in moving:
        factor, offset = 1.0, 0.0
        while (mimic := urdf.joint(name).mimic) is not None:
            if mimic[0] not in movable:
                raise FileFormatError(
                    f"{urdf.source}:{urdf.joint(name).line}: joint {quote(name)}: it mimics "
                    f"{quote(mimic[0])}, which is not a moving joint; {suggest_names(mimic[0], movable)}"
                )
            name, offset, factor = mimic[0], offset + factor * mimic[2], factor * mimic[1]
        rules.append((name, factor, offset))
    names = list(dict.fromkeys(name for name, factor, _ in rules if factor))
    if not names:
        raise FileFormatError(
            f"{urdf.source}: all joints of the path mimic with multiplier 0; expected a joint that moves"
        )
    mimic_matrix = np.zeros((len(moving), len(names)))
    for row, (name, factor, _) in enumerate(rules):
        if factor:
            mimic_matrix[row, names.index(name)] = factor
    return names, mimic_matrix, np.array([offset for _, _, offset in rules])


def placements(
    model: pin.Model, root: str, tip: str, moving: Sequence[str], is_reversed: Sequence[bool]
) -> tuple[Array, Array]:
    """Return the constant transforms and axes of a path in Pinocchio's model."""
    origins, axes = [], []
    before = se3.inverse(_frame_placement(model, root))
    for name, is_up in zip(moving, is_reversed, strict=True):
        index = model.getJointId(name)
        placement = model.jointPlacements[index].homogeneous
        origins.append(before if is_up else before @ placement)
        before = se3.inverse(placement) if is_up else np.eye(4)
        joint = model.joints[index]
        data = joint.createData()
        joint.calc(data, pin.neutral(model))
        subspace = np.asarray(data.S).reshape(6)
        axis = subspace[:3] if np.any(subspace[:3]) else subspace[3:]
        axes.append(-axis if is_up else axis)
    origins.append(before @ _frame_placement(model, tip))
    return np.array(origins), np.array(axes)


@lru_cache(maxsize=64)
def link_on_path(
    urdf: Urdf, root: str, moving: tuple[str, ...], n_reversed: int, link: str
) -> tuple[int, Array] | None:
    """Return the body of a path that carries a link (0: the root), and the pose of the link in its frame."""
    # None if a joint off the path moves the link.
    model = build_model(urdf)
    frames = [model.frames[model.getFrameId(name, pin.FrameType.BODY)] for name in (root, link)]
    bodies = [(frames[0].parentJoint, se3.inverse(frames[0].placement.homogeneous))]
    for j, name in enumerate(moving):
        index = model.getJointId(name)
        placement = model.jointPlacements[index].homogeneous
        bodies.append(
            (model.parents[index], se3.inverse(placement)) if j < n_reversed else (index, np.eye(4))
        )
    for number, (joint, from_joint) in enumerate(bodies):
        if joint == frames[1].parentJoint:
            return number, from_joint @ frames[1].placement.homogeneous
    return None


def joint_placements(
    model: pin.Model, tip: str, moving: Sequence[str], is_reversed: Sequence[bool], origins: Array
) -> list[Array]:
    """Compute the poses of joints in the moving joints before them from the transforms of a path."""
    # At the turn of the path, the first joint that is not reversed takes up the whole change.
    nominal = [model.jointPlacements[model.getJointId(name)].homogeneous for name in moving]
    out = []
    for i, is_up in enumerate(is_reversed):
        if not is_up:
            turns = i > 0 and is_reversed[i - 1]
            out.append(nominal[i - 1] @ origins[i] if turns else origins[i])
        elif i + 1 < len(moving):
            out.append(se3.inverse(origins[i + 1]) if is_reversed[i + 1] else nominal[i])
        else:
            out.append(_frame_placement(model, tip) @ se3.inverse(origins[i + 1]))
    return out


def _frame_placement(model: pin.Model, link: str) -> Array:
    """Return the pose of a link in its moving joint, (4, 4)."""
    return model.frames[model.getFrameId(link, pin.FrameType.BODY)].placement.homogeneous


@lru_cache(maxsize=256)
def axis_frame(unit: tuple[float, ...]) -> Array:
    """Return a rotation that turns z onto a unit axis; it is a permutation for a coordinate axis."""
    axis = np.array(unit)
    i = int(np.argmax(np.abs(axis)))
    sign = 1.0 if axis[i] > 0 else -1.0
    x = np.eye(3)[(i + 1) % 3] * sign
    x = x - (x @ axis) * axis
    x /= np.linalg.norm(x)
    return se3.transform(np.stack([x, np.cross(axis, x), axis], -1), np.zeros(3))
