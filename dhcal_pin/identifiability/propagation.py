"""Propagation of error twists along a chain, and relations between its joint axes.

A combination of errors is unobservable for every instrument if its effect can be moved along the chain to a
place where it vanishes. The twist ξ of the combination passes a joint unchanged, for all joint positions, if
it commutes with the joint motion (Khalil & Dombre, Modeling, Identification and Control of Robots, 2002,
chapter 11: grouping of parameters):

* revolute joint about z: rotation about z and translation along z;
* prismatic joint along z: rotation about z and every translation.

From body to body, the twist transforms by the adjoint of the link transform: ξ_(j+1) = Ad(L_j⁻¹)·ξ_j + own
errors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..estimation.error_model import ErrorModel, ErrorParameter
from ..robot.chain import Chain, joint_frame, link_frame

# Two axes are parallel if their angle [rad], and coincident if also their distance [m], is below this value.
PARALLEL_TOL = 1e-6
# Entries of a combination, whose largest entry is 1 [m or rad], below this value count as zero.
NEGLIGIBLE = 1e-3
# Cross products of unit vectors below this value mean that a twist acts along or about an axis.
_ALONG_AXIS_TOL = 1e-9


@frozen(eq=False)
class PlainErrors:
    """Chain with its geometric errors, which are constant twists (no transmission errors)."""

    chain: Chain  # Chain at the current values of the parameters
    parameters: tuple[ErrorParameter, ...]  # Geometric error parameters, shape (r,)
    bodies: Array  # Body that each error moves, shape (r,)
    twists: Array  # Twist of each error in its body frame, shape (r, 6)

    @property
    def error_frames(self) -> Array:
        """Error frame of each error, shape (r,)."""
        return np.array([p.error_frame for p in self.parameters], int)

    @classmethod
    def from_model(cls, errors: ErrorModel, x: Array) -> PlainErrors:
        """Select the geometric errors of a model; they are its first parameters."""
        chain, bodies, twists = errors.derivative(x)
        count = int(np.sum(bodies <= len(chain.moving_joints)))
        return cls(chain, errors.parameters[:count], bodies[:count], twists[:count])


@frozen(eq=False)
class Propagation:
    """Joints that a combination of errors passes unchanged, and its effect on the tool."""

    translation_joints: list[int]  # Joints, from 1, that it passes as a translation along their axis
    rotation_joints: list[int]  # Joints, from 1, that it passes as a rotation about their axis
    # Prismatic joints, from 1, that it passes as a translation across their axis.
    crossed_prismatic_joints: list[int]
    # Twists of the tool at the measured point, shape (c, 6); zero if the tool does not move.
    tool_twists: Array


def propagate_along_chain(errors: PlainErrors, vectors: Array) -> Propagation | None:
    """Propagate combinations of errors along the chain."""
    chain = errors.chain
    translations, rotations, crossings = set[int](), set[int](), set[int]()
    propagated = np.zeros((6, vectors.shape[1]))
    for body, link in enumerate(chain.link_transforms):
        at_body = errors.bodies == body
        propagated = propagated + errors.twists[at_body].T @ vectors[at_body]
        is_last = body == len(chain.moving_joints)
        propagated = se3.adjoint(se3.inverse(link @ chain.tool if is_last else link)) @ propagated
        if is_last:
            break
        is_nonzero = np.abs(propagated).max(1) > NEGLIGIBLE
        if is_nonzero[3:5].any() or (is_nonzero[:2].any() and not chain.prismatic[body]):
            return None
        translations |= {body + 1} if is_nonzero[2] else set()
        rotations |= {body + 1} if is_nonzero[5] else set()
        crossings |= {body + 1} if is_nonzero[:2].any() else set()
    return Propagation(sorted(translations), sorted(rotations), sorted(crossings), propagated.T)


def axis_angle_and_distance(chain: Chain, first: int, second: int) -> tuple[float, float]:
    """Compute the angle of two joint axes, and the distance of the second joint's origin from the first."""
    # The joints between them are at zero; for parallel and coincident axes the result does not depend on
    # that.
    transform = np.eye(4)
    for j in range(first, second):
        transform = transform @ chain.link_transforms[j]
    sine = np.linalg.norm(transform[:2, 2])
    return float(np.arctan2(sine, abs(transform[2, 2]))), float(np.linalg.norm(transform[:2, 3]))


def axes_acted_on(chain: Chain, parameters: Sequence[ErrorParameter]) -> set[int]:
    """Find the joints whose own axes parameters translate along or rotate about."""
    out = set()
    for p in parameters:
        twist = np.array(p.twist).reshape(2, 3)
        for j, axis in enumerate(chain.axes, start=1):
            if (
                p.error_frame in (joint_frame(j), link_frame(j))
                and np.abs(np.cross(twist, axis)).max() < _ALONG_AXIS_TOL
            ):
                out.add(j)
    return out
