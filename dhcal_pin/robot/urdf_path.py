"""The path through a URDF from the root to a tip: moving joints, independent joints, and joint frames.

The values of the k moving joints follow from those of the n independent joints by the mimic rules of the
URDF, composed along chains of mimics:

    positions = mimic_matrix @ q + mimic_offset

Joint frames and axes come from Pinocchio's model, which merges fixed joints into the origin of the next
moving joint.
"""

from __future__ import annotations

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


def build_model(urdf: Urdf) -> pin.Model:
    """Build Pinocchio's model of the whole robot.

    Args:
        urdf: File of the robot.

    Returns:
        Model without geometry.

    Raises:
        FileFormatError: Pinocchio does not accept the file.
    """
    try:
        # Pinocchio separates numbers at spaces only; XML allows any white space.
        text = urdf.data.decode("utf-8-sig").translate(dict.fromkeys(b"\t\r\n", " "))
        with discard_native_messages():
            return pin.buildModelFromXML(text)
    except (ValueError, RuntimeError) as error:
        raise FileFormatError(f"{urdf.source}: Pinocchio does not accept this URDF: {error}") from error


def default_tip(urdf: Urdf) -> str:
    """Choose the leaf behind the most moving joints, and of these the one behind the most links.

    `tool0` is preferred among the leaves behind the most moving joints.

    Args:
        urdf: File of the robot.

    Returns:
        Name of the tip link.

    Raises:
        DhcalError: Several leaves are equally deep; the message lists them.
    """
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


def find_moving_joints(urdf: Urdf, tip: str) -> list[UrdfJoint]:
    """Find the joints that move between the root and a tip.

    Args:
        urdf: File of the robot.
        tip: Name of the tip link.

    Returns:
        Revolute, continuous and prismatic joints in the order from root to tip.

    Raises:
        DhcalError: No joint moves, too many do, or one has more than one degree of freedom.
    """
    joints = [joint for joint in urdf.path(tip) if joint.type != "fixed"]
    for joint in joints:
        if joint.type in ("floating", "planar"):
            raise DhcalError(
                f"{urdf.source}:{joint.line}: joint {joint.name!r} is {joint.type}; expected revolute, "
                f"continuous, prismatic and fixed joints on the path to {tip!r}: make it fixed, at the pose "
                "that it has during the measurement"
            )
    if not joints:
        raise DhcalError(
            f"{urdf.source}: no moving joint between {urdf.root!r} and {tip!r}; "
            "choose a tip behind moving joints, --tip"
        )
    if len(joints) > _MAX_MOVING_JOINTS:
        raise DhcalError(
            f"{urdf.source}: {len(joints)} moving joints between {urdf.root!r} and {tip!r}; "
            f"at most {_MAX_MOVING_JOINTS} are accepted: choose a tip closer to the root, --tip"
        )
    return joints


def independent_joints(urdf: Urdf, moving: list[str]) -> tuple[list[str], Array, Array]:
    """Find the independent joints behind the moving joints, and the mimic rules between them.

    Args:
        urdf: File of the robot.
        moving: Names of the k moving joints.

    Returns:
        Names of the n independent joints, mimic matrix (k, n), and mimic offset (k,) [rad or m].

    Raises:
        FileFormatError: A joint mimics an unknown or fixed joint, or no independent joint remains.
    """
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


def placements(model: pin.Model, tip: str, moving: list[str]) -> tuple[Array, Array]:
    """Return the joint origins and axes of a path in Pinocchio's model.

    Args:
        model: Model of the whole robot.
        tip: Name of the tip link.
        moving: Names of the k moving joints.

    Returns:
        Pose of each moving joint in the moving joint before it, then the tip, shape (k+1, 4, 4) [m], and unit
        axes, shape (k, 3).
    """
    origins, axes = [], []
    for name in moving:
        index = model.getJointId(name)
        origins.append(model.jointPlacements[index].homogeneous)
        joint = model.joints[index]
        data = joint.createData()
        joint.calc(data, pin.neutral(model))
        subspace = np.asarray(data.S).reshape(6)
        axes.append(subspace[:3] if np.any(subspace[:3]) else subspace[3:])
    frame = model.frames[model.getFrameId(tip, pin.FrameType.BODY)]
    origins.append(frame.placement.homogeneous)
    return np.array(origins), np.array(axes)


@lru_cache(maxsize=256)
def axis_frame(unit: tuple[float, ...]) -> Array:
    """Return a rotation that turns z onto a unit axis; it is a permutation for a coordinate axis.

    Args:
        unit: Unit axis, 3 components.

    Returns:
        Rotation as a homogeneous matrix, shape (4, 4).
    """
    axis = np.array(unit)
    i = int(np.argmax(np.abs(axis)))
    sign = 1.0 if axis[i] > 0 else -1.0
    x = np.eye(3)[(i + 1) % 3] * sign
    x = x - (x @ axis) * axis
    x /= np.linalg.norm(x)
    return se3.transform(np.stack([x, np.cross(axis, x), axis], -1), np.zeros(3))
