"""The path through a URDF: its tip, its independent joints, and the joints' frames as Pinocchio sees them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pinocchio as pin

from .. import se3
from .._typing import Array
from ..exceptions import DhcalError
from .urdf import Urdf, UrdfJoint, quote, suggest

_MAX_MOVING = 64  # what is unknown grows with the path, and work with its cube; no arm comes near


def build_model(urdf: Urdf) -> pin.Model:
    """Pinocchio's model of the whole robot; DhcalError where it takes none."""
    try:
        # Pinocchio splits numbers at spaces only; XML allows any white space.
        return pin.buildModelFromXML(urdf.data.decode("utf-8-sig").translate(dict.fromkeys(b"\t\r\n", " ")))
    except (ValueError, RuntimeError) as error:
        raise DhcalError(f"{urdf.source}: Pinocchio does not accept this URDF: {error}") from error


def default_tip(urdf: Urdf) -> str:
    """The leaf behind the most moving joints, then behind the most links; `tool0` breaks a tie."""
    depth = {leaf: urdf.path(leaf) for leaf in urdf.leaves()}
    rank = {leaf: (sum(j.type != "fixed" for j in path), len(path)) for leaf, path in depth.items()}
    best = max(rank.values())
    deepest = [leaf for leaf, value in rank.items() if value[0] == best[0]]
    if "tool0" in deepest:
        return "tool0"
    farthest = [leaf for leaf in deepest if rank[leaf] == best]
    if len(farthest) > 1:
        shared = set.intersection(*({joint.child for joint in depth[leaf]} for leaf in farthest))
        common = [joint.child for joint in depth[farthest[0]] if joint.child in shared]
        also = f" (or {common[-1]}, the last link they share)" if common else ""
        raise DhcalError(
            f"{urdf.source}: several tips are equally deep; "
            f"choose the tip, --tip: {', '.join(sorted(deepest))}{also}"
        )
    return farthest[0]


def find_moving_joints(urdf: Urdf, tip: str) -> list[UrdfJoint]:
    """The joints that move between the root and a tip, in that order.

    Raises:
        DhcalError: there is no such tip, none moves, too many do, or one has more than one freedom.
    """
    joints = [joint for joint in urdf.path(tip) if joint.type != "fixed"]
    for joint in joints:
        if joint.type in ("floating", "planar"):
            raise DhcalError(
                f"{urdf.source}:{joint.line}: joint {joint.name!r} is {joint.type}; "
                f"the path to {tip!r} may only have revolute, continuous, prismatic and fixed joints: "
                "make it fixed, as the robot stands while it is measured"
            )
    if not joints:
        raise DhcalError(
            f"{urdf.source}: no moving joint between {urdf.root!r} and {tip!r}; "
            "choose a tip behind joints that move, --tip"
        )
    if len(joints) > _MAX_MOVING:
        raise DhcalError(
            f"{urdf.source}: {len(joints)} moving joints between {urdf.root!r} and {tip!r}; "
            f"at most {_MAX_MOVING} are accepted: choose a nearer tip, --tip"
        )
    return joints


def independent_joints(urdf: Urdf, moving: list[str]) -> tuple[list[str], Array, Array]:
    """Independent joints behind the moving ones, with the (k, n) mixing and (k,) shift of mimics.

    Raises:
        DhcalError: a joint follows one that is not there or cannot move, or none is left to command.
    """
    free = [joint.name for joint in urdf.joints if joint.type in ("revolute", "continuous", "prismatic")]
    entries = []
    for name in moving:
        factor, shift = 1.0, 0.0
        while (mimic := urdf.joint(name).mimic) is not None:
            if mimic[0] not in free:
                raise DhcalError(
                    f"{urdf.source}:{urdf.joint(name).line}: joint {quote(name)}: it mimics {quote(mimic[0])}, "
                    f"which is no joint that moves; {suggest(mimic[0], free)}"
                )
            name, shift, factor = mimic[0], shift + factor * mimic[2], factor * mimic[1]
        entries.append((name, factor, shift))
    names = list(dict.fromkeys(name for name, factor, _ in entries if factor))
    if not names:
        raise DhcalError(
            f"{urdf.source}: all joints of the path mimic with multiplier 0; none is left to move"
        )
    mixing = np.zeros((len(moving), len(names)))
    for row, (name, factor, _) in enumerate(entries):
        if factor:
            mixing[row, names.index(name)] = factor
    return names, mixing, np.array([shift for _, _, shift in entries])


def placements(model: pin.Model, tip: str, moving: list[str]) -> tuple[Array, Array]:
    """Origins (k+1, 4, 4) and axes (k, 3) of the path as Pinocchio sees it."""
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
    """A rotation (4, 4) that carries z onto a unit axis (3,); a permutation for coordinate axes."""
    axis = np.array(unit)
    i = int(np.argmax(np.abs(axis)))
    sign = 1.0 if axis[i] > 0 else -1.0
    x = np.eye(3)[(i + 1) % 3] * sign
    x = x - (x @ axis) * axis
    x /= np.linalg.norm(x)
    return se3.transform(np.stack([x, np.cross(axis, x), axis], -1), np.zeros(3))
