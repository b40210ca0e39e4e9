"""A robot's joint space: where it may stand, drawn at random, and an order to go through."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import se3
from .._typing import Array
from ..exceptions import DhcalError
from .chain import Chain
from .collision import CollisionChecker

# Draws for each configuration before the space is called too narrow.
MAX_DRAWS_PER_SAMPLE = 200


# Half a metre of a slide is as much of the arm's motion as half a turn.
RAD_PER_METRE = 2 * np.pi


@dataclass(frozen=True, eq=False)
class WorkspaceConstraints:
    """Where the tool may be; places in the measuring frame, which is the base link's own if nobody said more.

    Attributes:
        box: (2, 3) least and most x, y, z of the tool point, m; None for anywhere.
        instrument_position: (3,) the instrument, m, which must see the tool point past the robot; None for anywhere.
        max_view_angle: half angle about the tool's z axis in which the instrument must stand, rad; π for any.
    """

    box: Array | None = None
    instrument_position: Array | None = None
    max_view_angle: float = np.pi

    def contains(self, poses: Array) -> Array:
        """Which tool poses (m, 4, 4) are inside the box and look at the instrument, (m,)."""
        point = poses[:, :3, 3]
        good = np.ones(len(poses), bool)
        if self.box is not None:
            good &= np.all((point >= self.box[0]) & (point <= self.box[1]), 1)
        if self.instrument_position is not None:
            away = self.instrument_position - point
            towards = np.einsum("mi,mi->m", poses[:, :3, 2], away)
            good &= towards >= np.cos(self.max_view_angle) * np.linalg.norm(away, axis=1)
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
class ConfigurationSampler:
    """Where a robot may stand.

    Attributes:
        chain: the robot; base and tool as far as they are known.
        workspace: where its tool may be.
        low, high: (n,) its joints' range, rad or m.
        collision: its collision geometry.
    """

    chain: Chain
    workspace: WorkspaceConstraints
    low: Array
    high: Array
    collision: CollisionChecker

    @classmethod
    def from_chain(
        cls, chain: Chain, space: WorkspaceConstraints, angle: float, length: float
    ) -> ConfigurationSampler:
        """A chain's room with margins to its limits, rad and m."""
        return cls(chain, space, *joint_range(chain, angle, length), CollisionChecker.from_chain(chain))

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Uniform joint values (count, n) whose tool the space holds.

        Raises:
            DhcalError: there are next to none.
        """
        out = np.empty((0, self.chain.n_joints))
        for _ in range(MAX_DRAWS_PER_SAMPLE):
            q = rng.uniform(self.low, self.high, (count, self.chain.n_joints))
            out = np.concatenate([out, q[self.workspace.contains(self.chain.poses(q))]])
            if len(out) >= count:
                return out[:count]
        raise DhcalError(
            f"the tool is in the space asked for in {len(out)} of {MAX_DRAWS_PER_SAMPLE * count} configurations; "
            "widen the box or the cone, or ask for fewer candidates"
        )

    def perturb(self, q: Array, step: float, count: int, rng: np.random.Generator) -> Array:
        """Configurations (m·count, n) about each of q (m, n), a step being a share of the joints' range."""
        moves = rng.standard_normal((len(q), count, self.chain.n_joints)) * step * (self.high - self.low)
        return np.clip(q[:, None] + moves, self.low, self.high).reshape(-1, self.chain.n_joints)

    def is_feasible(self, q: Array) -> bool:
        """Whether the robot can stand at q (n,), and the instrument sees the tool if it must."""
        if not self.collision.is_collision_free(q):
            return False
        if self.workspace.instrument_position is None:
            return True
        into = se3.inverse(self.chain.base)
        point = self.chain.poses(q[None])[0, :3, 3]
        eye, point = (into[:3, :3] @ at + into[:3, 3] for at in (self.workspace.instrument_position, point))
        return self.collision.has_line_of_sight(q, eye, point)


def scale_joint_units(chain: Chain, q: Array) -> Array:
    """Joint values (m, n) in which a step of any joint counts alike, a slide's metres as radians."""
    slides = np.array([chain.urdf.joint(name).type == "prismatic" for name in chain.joint_names])
    return q * np.where(slides, RAD_PER_METRE, 1.0)


def shortest_tour(q: Array) -> Array:
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
