"""Random configurations within joint limits and workspace constraints, and a short tour through them.

Configurations are drawn uniformly in joint space. They are rejected if the tool leaves the workspace, if the
robot collides with itself, the floor or an obstacle, or if the tool is hidden from the instrument.

`shortest_tour` orders configurations by 2-opt (Croes 1958), so that a robot moves little from one to the
next.

Shapes: m samples, n joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Self

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..exceptions import InvalidArgumentError
from .chain import Chain

if TYPE_CHECKING:
    from .collision import CollisionChecker, Obstacle

# Number of draws per requested configuration before the workspace is considered too narrow.
MAX_DRAWS_PER_SAMPLE = 200

# Distances of prismatic joints are compared with angles by this factor [rad/m]: half a metre counts as half a
# turn.
RAD_PER_METRE = 2 * np.pi

# Range of a joint without limits, each way from zero [rad and m]. Turns beyond half a turn repeat others.
_MAX_ANGLE, _MAX_STROKE = np.pi, 0.5
# Limits of a prismatic joint that are farther apart [m] are no limits.
_MAX_LENGTH = 100.0

# A change of the tour must shorten it by more than this (rounding).
_MIN_TOUR_GAIN = 1e-9


@frozen(eq=False)
class WorkspaceConstraints:
    """Constraints of the robot's poses.

    The tool is constrained in the measuring frame (by default the frame of the root link), the whole robot in
    the frame of the root link.

    Attributes:
        box: Lowest and highest x, y, z of the tool point, shape (2, 3) [m]; None for any position.
        instrument_position: Position of an instrument that must see the tool point, shape (3,) [m]; None if
            visibility does not matter.
        max_view_angle: Maximum angle between the z axis of the tool and the direction to the instrument
            [rad].
        floor: z of the floor in the frame of the root link [m]; None without a floor.
        obstacles: Obstacles.
    """

    box: Array | None = None
    instrument_position: Array | None = None
    max_view_angle: float = np.pi
    floor: float | None = None
    obstacles: Sequence[Obstacle] = ()

    @property
    def environment(self) -> tuple[Obstacle, ...]:
        """Floor and obstacles."""
        from .collision import Obstacle  # lazy import: only for plans

        floor = () if self.floor is None else (Obstacle.floor(self.floor),)
        return (*floor, *self.obstacles)

    def contains(self, poses: Array) -> Array:
        """Return which tool poses (m, 4, 4) are inside the box and face the instrument, shape (m,)."""
        points = poses[:, :3, 3]
        inside = np.ones(len(poses), bool)
        if self.box is not None:
            inside &= np.all((points >= self.box[0]) & (points <= self.box[1]), 1)
        if self.instrument_position is not None:
            direction = self.instrument_position - points
            along_z = np.einsum("mi,mi->m", poses[:, :3, 2], direction)
            inside &= along_z >= np.cos(self.max_view_angle) * np.linalg.norm(direction, axis=1)
        return inside


def joint_range(chain: Chain, angle: float = 0.0, length: float = 0.0) -> tuple[Array, Array]:
    """Return the range of joint positions within the limits, at most half a turn each way."""
    # The margins to the limits are an angle [rad] for revolute and a length [m] for prismatic joints.
    low, high = limits_with_margin(chain, angle, length)
    stroke = np.where(high - low <= _MAX_LENGTH, np.inf, _MAX_STROKE)
    span = np.where(_is_prismatic(chain), stroke, _MAX_ANGLE)
    return (
        np.where(high > -span, np.maximum(low, -span), np.maximum(low, high - 2 * span)),
        np.where(low < span, np.minimum(high, span), np.minimum(high, low + 2 * span)),
    )


def random_configurations(chain: Chain, count: int) -> Array:
    """Draw configurations (count, n) evenly from the joint range, the same in each call."""
    return np.random.default_rng(0).uniform(*joint_range(chain), (count, chain.n_joints))


def limits_with_margin(chain: Chain, angle: float, length: float) -> tuple[Array, Array]:
    """Return the joint limits, (n,) each, less a margin for revolute [rad] and prismatic [m] joints."""
    # The margin is at most a quarter of the range, so that half of it remains.
    margin = np.minimum(np.where(_is_prismatic(chain), length, angle), (chain.upper - chain.lower) / 4)
    return chain.lower + margin, chain.upper - margin


def _is_prismatic(chain: Chain) -> Array:
    """Return whether each independent joint is prismatic in the URDF, shape (n,)."""
    return np.array([chain.urdf.joint(name).type == "prismatic" for name in chain.joint_names])


@frozen(eq=False)
class ConfigurationSampler:
    """Sampler of configurations that a robot can take."""

    chain: Chain  #: Kinematic chain with base and tool as far as they are known.
    workspace: WorkspaceConstraints  #: Constraints of the tool pose.
    low: Array  #: Lowest joint positions, shape (n,) [rad or m].
    high: Array  #: Highest joint positions, shape (n,) [rad or m].
    collision: CollisionChecker  #: Collision checks of the robot.

    @property
    def notes(self) -> tuple[str, ...]:
        """What is not checked and why."""
        return (self.collision.note,) if self.collision.note else ()

    @classmethod
    def from_chain(cls, chain: Chain, workspace: WorkspaceConstraints, angle: float, length: float) -> Self:
        """Create a sampler with margins to the joint limits."""
        from .collision import CollisionChecker  # lazy import: only for plans

        checker = CollisionChecker.from_chain(chain, workspace.environment)
        return cls(chain, workspace, *joint_range(chain, angle, length), checker)

    def in_workspace(self, q: Array) -> Array:
        """Return in which configurations the tool is in the workspace and above the floor."""
        poses = self.chain.poses(q)
        inside = self.workspace.contains(poses)
        if self.workspace.floor is not None:
            base = self.chain.base
            inside &= (poses[:, :3, 3] - base[:3, 3]) @ base[:3, 2] >= self.workspace.floor
        return inside

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Draw uniform joint positions whose tool poses are in the workspace; collisions are not checked."""

        def drawn() -> Array:
            q = rng.uniform(self.low, self.high, (count, self.chain.n_joints))
            return q[self.in_workspace(q)]

        out = collect_draws(drawn, count, MAX_DRAWS_PER_SAMPLE, MAX_DRAWS_PER_SAMPLE)
        if len(out) < count:
            raise InvalidArgumentError(
                f"only {len(out)} of {MAX_DRAWS_PER_SAMPLE * count} random configurations have the tool in "
                "the workspace; widen the box or the view angle, lower the floor, or reduce the number of "
                "candidates"
            )
        return out

    def perturb(self, q: Array, step: float, count: int, rng: np.random.Generator) -> Array:
        """Draw configurations around given ones, clipped to the joint range."""
        moves = rng.standard_normal((len(q), count, self.chain.n_joints)) * step * (self.high - self.low)
        return np.clip(q[:, None] + moves, self.low, self.high).reshape(-1, self.chain.n_joints)

    def is_feasible(self, q: Array) -> bool:
        """Return whether a configuration has no collision and a free line of sight if one is required."""
        if not self.collision.is_collision_free(q):
            return False
        if self.workspace.instrument_position is None:
            return True
        point = self.chain.poses(q[None])[0, :3, 3]
        ends = np.array([self.workspace.instrument_position, point])
        eye, point = se3.transform_points(se3.inverse(self.chain.base), ends)
        return self.collision.has_line_of_sight(q, eye, point)


def collect_draws(draw: Callable[[], Array], count: int, max_rounds: int, max_empty_rounds: int) -> Array:
    """Repeat random draws until enough of them were accepted."""
    parts: list[Array] = []
    for number in range(1, max_rounds + 1):
        parts.append(draw())
        n_accepted = sum(map(len, parts))
        if n_accepted >= count or (not n_accepted and number >= max_empty_rounds):
            break
    return np.concatenate(parts)[:count]


def scale_joint_units(chain: Chain, q: Array) -> Array:
    """Convert positions of prismatic joints to radians by `RAD_PER_METRE`."""
    return q * np.where(_is_prismatic(chain), RAD_PER_METRE, 1.0)


def shortest_tour(q: Array, detours: Array | None = None) -> Array:
    """Find an order (m,) of configurations (m, n) with short moves, plus detours (m, m), by 2-opt."""
    # It starts from the nearest-neighbour tour. The units must be comparable.
    count = len(q)
    distances = np.zeros((count + 1, count + 1))
    # An additional point at distance 0 from all others turns the closed tour of 2-opt into an open one.
    distances[:count, :count] = np.linalg.norm(q[:, None] - q[None], axis=2)
    if detours is not None:
        distances[:count, :count] += detours
    order, unvisited = [count], set(range(count))
    current = int(np.argmin(np.linalg.norm(q - q.mean(0), axis=1)))
    while unvisited:
        unvisited.remove(current)
        order.append(current)
        current = min(unvisited, key=lambda other: distances[order[-1], other], default=0)
    path = np.array(order)
    while True:
        # Gain of reversing the part of the path from i+1 to j.
        between, successors = distances[path[:, None], path], np.roll(path, -1)
        steps = distances[path, successors]
        gain = steps[:, None] + steps[None] - between - distances[successors[:, None], successors]
        i, j = np.unravel_index(np.argmax(np.triu(gain, 1)), gain.shape)
        if gain[i, j] <= _MIN_TOUR_GAIN or i >= j:
            return np.roll(path, -int(np.flatnonzero(path == count)[0]))[1:]
        path[i + 1 : j + 1] = path[i + 1 : j + 1][::-1].copy()
