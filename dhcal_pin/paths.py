"""The path through a URDF: its tip, its independent joints, and the joints' frames as Pinocchio sees them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pinocchio as pin

from . import se3
from .errors import DhcalError
from .se3 import Array
from .urdf import Urdf


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


def independent_joints(urdf: Urdf, moving: list[str]) -> tuple[list[str], Array, Array]:
    """Independent joints behind the moving ones, with the (k, n) mixing and (k,) shift of mimics."""
    names: list[str] = []
    entries = []
    for name in moving:
        factor, shift = 1.0, 0.0
        while (mimic := urdf.joint(name).mimic) is not None:
            name, shift, factor = mimic[0], shift + factor * mimic[2], factor * mimic[1]
        if name not in names:
            names.append(name)
        entries.append((names.index(name), factor, shift))
    mixing = np.zeros((len(moving), len(names)))
    for row, (column, factor, _) in enumerate(entries):
        mixing[row, column] = factor
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
