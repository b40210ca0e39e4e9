"""How small errors at one place of an arm pass along it, joint by joint, and what its axes have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import se3
from .._typing import Array
from ..estimation.error_model import ErrorModel, ErrorParameter
from ..robot.chain import Chain, joint_frame, link_frame

# Axes within this of each other, rad and m, are parallel, or the same line.
PARALLEL_TOL = 1e-6


# Entries of a combination, the largest 1 in m and rad, below which a parameter has no part worth a word.
NEGLIGIBLE = 1e-3


@dataclass(frozen=True, eq=False)
class PlainErrors:
    """A chain and the errors that are plain twists in it, those that no joint's value scales.

    Attributes:
        chain: at the values of the unknowns.
        parameters: (r,).
        bodies, twists: (r,), (r, 6) what they move there, see `stations.twists_at`.
    """

    chain: Chain
    parameters: tuple[ErrorParameter, ...]
    bodies: Array
    twists: Array

    @property
    def error_frames(self) -> Array:
        """Where they act (r,)."""
        return np.array([p.error_frame for p in self.parameters], int)

    @classmethod
    def from_model(cls, errors: ErrorModel, x: Array) -> PlainErrors:
        """The plain errors of a model at x (p,); they come first in it."""
        chain, bodies, twists = errors.derivative(x)
        count = int(np.sum(bodies <= len(chain.moving_joints)))
        return cls(chain, errors.parameters[:count], bodies[:count], twists[:count])


@dataclass(frozen=True, eq=False)
class Propagation:
    """How a combination of errors passes along the chain without a joint taking notice.

    Attributes:
        translation_joints, rotation_joints: the joints, from 1, along and about whose axes it passes.
        crossed_prismatic_joints: the prismatic joints that it passes across their axis.
        tool_twists: (r, 6) what is left at the measured point; zero if the whole tool stays where it is.
    """

    translation_joints: list[int]
    rotation_joints: list[int]
    crossed_prismatic_joints: list[int]
    tool_twists: Array


def propagate_along_chain(path: PlainErrors, vectors: Array) -> Propagation | None:
    """How combinations (r, c) of a path's errors pass along it; None if a joint changes them.

    A motion passes a joint unchanged if it commutes with the joint's own: a turn about and a shift along a
    revolute joint's axis, a turn about a prismatic joint's axis and any shift.
    """
    chain = path.chain
    shifts, turns, slides = set[int](), set[int](), set[int]()
    carried = np.zeros((6, vectors.shape[1]))
    for body, link in enumerate(chain.link_transforms):
        mine = path.bodies == body
        carried = carried + path.twists[mine].T @ vectors[mine]
        last = body == len(chain.moving_joints)
        carried = se3.adjoint(se3.inverse(link @ chain.tool if last else link)) @ carried
        if last:
            break
        size = np.abs(carried).max(1) > NEGLIGIBLE
        if size[3:5].any() or (size[:2].any() and not chain.prismatic[body]):
            return None
        shifts |= {body + 1} if size[2] else set()
        turns |= {body + 1} if size[5] else set()
        slides |= {body + 1} if size[:2].any() else set()
    return Propagation(sorted(shifts), sorted(turns), sorted(slides), carried.T)


def axis_angle_and_distance(chain: Chain, first: int, second: int) -> tuple[float, float]:
    """Angle in rad between two axes, from 1, and distance in m of the second's origin from the first.

    The joints between them are at zero; for parallel and for coincident axes that does not matter.
    """
    between = np.eye(4)
    for j in range(first, second):
        between = between @ chain.link_transforms[j]
    sine = np.linalg.norm(between[:2, 2])
    return float(np.arctan2(sine, abs(between[2, 2]))), float(np.linalg.norm(between[:2, 3]))


def axes_acted_on(chain: Chain, parameters: Sequence[ErrorParameter]) -> set[int]:
    """Joints, from 1, along or about whose own axes parameters act."""
    out = set()
    for p in parameters:
        twist = np.array(p.twist).reshape(2, 3)
        for j, axis in enumerate(chain.axes, start=1):
            if (
                p.error_frame in (joint_frame(j), link_frame(j))
                and np.abs(np.cross(twist, axis)).max() < 1e-9
            ):
                out.add(j)
    return out
