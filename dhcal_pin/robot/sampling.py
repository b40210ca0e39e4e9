"""A robot's joint space: where it may stand, drawn at random, and an order to go through."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import se3
from .._typing import Array
from ..exceptions import DhcalError
from .chain import Chain
from .collision import Clearance

# Draws for each configuration before the space is called too narrow.
PATIENCE = 200


# Half a metre of a slide is as much of the arm's motion as half a turn.
SLIDE = 2 * np.pi


@dataclass(frozen=True, eq=False)
class Space:
    """Where the tool may be; places in the measuring frame, which is the base link's own if nobody said more.

    Attributes:
        box: (2, 3) least and most x, y, z of the tool point, m; None for anywhere.
        eye: (3,) the instrument, m, which must see the tool point past the robot; None for anywhere.
        cone: half angle about the tool's z axis in which the instrument must stand, rad; π for any.
    """

    box: Array | None = None
    eye: Array | None = None
    cone: float = np.pi

    def holds(self, poses: Array) -> Array:
        """Which tool poses (m, 4, 4) are inside the box and look at the instrument, (m,)."""
        point = poses[:, :3, 3]
        good = np.ones(len(poses), bool)
        if self.box is not None:
            good &= np.all((point >= self.box[0]) & (point <= self.box[1]), 1)
        if self.eye is not None:
            away = self.eye - point
            towards = np.einsum("mi,mi->m", poses[:, :3, 2], away)
            good &= towards >= np.cos(self.cone) * np.linalg.norm(away, axis=1)
        return good


def joint_range(chain: Chain, angle: float = 0.0, length: float = 0.0) -> tuple[Array, Array]:
    """Lowest and highest values (n,) inside the limits, and inside a turn or half a metre each way.

    Args:
        chain: the robot.
        angle: margin to the limits of joints that turn, rad.
        length: margin to the limits of joints that slide, m.
    """
    slides = np.array([chain.urdf.joint(name).type == "prismatic" for name in chain.joint_names])
    span, margin = np.where(slides, 0.5, np.pi), np.where(slides, length, angle)
    # A margin that leaves a joint nothing is cut to a quarter of its way.
    margin = np.minimum(margin, (chain.upper - chain.lower) / 4)
    low, high = chain.lower + margin, chain.upper - margin
    return (
        np.where(high > -span, np.maximum(low, -span), np.maximum(low, high - 2 * span)),
        np.where(low < span, np.minimum(high, span), np.minimum(high, low + 2 * span)),
    )


@dataclass(frozen=True, eq=False)
class Room:
    """Where a robot may stand.

    Attributes:
        chain: the robot; base and tool as far as they are known.
        space: where its tool may be.
        low, high: (n,) its joints' range, rad or m.
        clearance: its collision geometry.
    """

    chain: Chain
    space: Space
    low: Array
    high: Array
    clearance: Clearance

    @classmethod
    def of(cls, chain: Chain, space: Space, angle: float, length: float) -> Room:
        """A chain's room with margins to its limits, rad and m."""
        return cls(chain, space, *joint_range(chain, angle, length), Clearance.of(chain))

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Uniform joint values (count, n) whose tool the space holds.

        Raises:
            DhcalError: there are next to none.
        """
        out = np.empty((0, self.chain.size))
        for _ in range(PATIENCE):
            q = rng.uniform(self.low, self.high, (count, self.chain.size))
            out = np.concatenate([out, q[self.space.holds(self.chain.poses(q))]])
            if len(out) >= count:
                return out[:count]
        raise DhcalError(
            f"the tool is in the space asked for in {len(out)} of {PATIENCE * count} configurations; "
            "widen the box or the cone, or ask for fewer candidates"
        )

    def near(self, q: Array, step: float, count: int, rng: np.random.Generator) -> Array:
        """Configurations (m·count, n) about each of q (m, n), a step being a share of the joints' range."""
        moves = rng.standard_normal((len(q), count, self.chain.size)) * step * (self.high - self.low)
        return np.clip(q[:, None] + moves, self.low, self.high).reshape(-1, self.chain.size)

    def allows(self, q: Array) -> bool:
        """Whether the robot can stand at q (n,), and the instrument sees the tool if it must."""
        if not self.clearance.free(q):
            return False
        if self.space.eye is None:
            return True
        into = se3.inverse(self.chain.base)
        point = self.chain.poses(q)[0, :3, 3]
        eye, point = (into[:3, :3] @ at + into[:3, 3] for at in (self.space.eye, point))
        return self.clearance.sees(q, eye, point)


def evened(chain: Chain, q: Array) -> Array:
    """Joint values (m, n) in which a step of any joint counts alike, a slide's metres as radians."""
    slides = np.array([chain.urdf.joint(name).type == "prismatic" for name in chain.joint_names])
    return q * np.where(slides, SLIDE, 1.0)


def tour(q: Array) -> Array:
    """An order (n,) of configurations (n, dof) with little motion from each to the next, by 2-opt."""
    count = len(q)
    way = np.zeros((count + 1, count + 1))
    # The last one is nowhere, as near to all: a closed tour through it is an open one.
    way[:count, :count] = np.linalg.norm(q[:, None] - q[None], axis=2)
    order, left = [count], set(range(count))
    at = int(np.argmin(np.linalg.norm(q - q.mean(0), axis=1)))
    while left:
        left.remove(at)
        order.append(at)
        at = min(left, key=lambda other: way[order[-1], other], default=0)
    path = np.array(order)
    while True:
        first, after = way[path[:, None], path], np.roll(path, -1)
        steps = way[path, after]
        gain = steps[:, None] + steps[None] - first - way[after[:, None], after]
        i, j = np.unravel_index(np.argmax(np.triu(gain, 1)), gain.shape)
        if gain[i, j] <= 1e-9 or i >= j:
            return np.roll(path, -int(np.flatnonzero(path == count)[0]))[1:]
        path[i + 1 : j + 1] = path[i + 1 : j + 1][::-1].copy()
