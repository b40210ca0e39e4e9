"""Poses of a test according to ISO 9283:1998: five points in a cube of the workspace.

The edges of the cube are parallel to the axes of the measuring frame. The measuring plane is the inclined one
through the lower edge at small x and the upper edge at large x. P1 is its centre; P2 to P5 follow each other
around it, on its diagonals, a tenth of their length away from the corners (clause 6.8). The tool has the same
orientation at all points, unless the arm cannot keep it in any of the cubes. A grid of 27 points of the cube
is within reach of the tool point, the axis of the first joint is outside of the cube, and the straight moves
in joint space from point to point are free of collisions.

Of the cubes that fit, the one is chosen whose points are farthest from singularities: the smallest singular
value of the Jacobian, with angles times the characteristic length of the arm, is largest.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise, product

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..exceptions import InvalidArgumentError
from ..measurements.base import Noise
from ..planning.tour import is_move_free
from ..robot.chain import Chain
from ..robot.inverse_kinematics import (
    REACHED_TOL,
    characteristic_length,
    pose_task,
    position_task,
    solve_ik,
    tool_pose_and_jacobian,
)
from ..robot.sampling import ConfigurationSampler, WorkspaceConstraints, limits_with_margin

# Preferred sides of the cube, the largest first [m].
SIDES = (1.0, 0.63, 0.4, 0.25)
# Cycles of the standard.
CYCLES = 30
# Points P1 to P5 in units of half the side, from the centre of the cube.
POINTS = 0.8 * np.array([[0, 0, 0], [-1, -1, -1], [-1, 1, -1], [1, 1, 1], [1, -1, 1]])
# Corners, middles of edges and faces, and centre, in the same units.
GRID = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
# Random configurations whose tool poses are tried as centre and orientation, by default.
N_CENTRES = 1500
# Steps of the inverse kinematics from the centre to a point of the cube.
_IK_STEPS = 60
# Points of the axis of the first joint that are checked.
_N_AXIS_STEPS = 101
# Note on a cube in which the arm cannot keep the orientation of the tool.
TURNING_NOTE = "the orientation of the tool differs from point to point: the arm cannot keep it in the cube"


@frozen(eq=False)
class IsoCube:
    """Cube of a test according to ISO 9283, with its points."""

    side: float  #: Side [m].
    centre: Array  #: Centre in the measuring frame, (3,) [m].
    q: Array  #: Joint positions at P1 to P5, (5, n) [rad or m].
    notes: tuple[str, ...]  #: What is not checked and why.


def find_iso_cube(
    chain: Chain,
    sides: Iterable[float],
    space: WorkspaceConstraints,
    margin: Noise,
    candidates: int,
    seed: int,
) -> IsoCube:
    """Find a cube of the first side [m] that fits into the workspace; tool poses of candidates are tried."""
    rng = np.random.default_rng(seed)
    sampler = ConfigurationSampler.from_chain(chain, space, margin.rotation, margin.position)
    low, high = limits_with_margin(chain, margin.rotation, margin.position)
    limited, starts, sides = replace(chain, lower=low, upper=high), sampler.draw(candidates, rng), list(sides)
    for is_turning, side in product((False, True), sides):
        for q in _reachable(limited, starts, side, sampler, is_turning):
            # Every point is approached from the one before, P1 from P5.
            moves = pairwise([q[-1], *q])
            if all(map(sampler.is_feasible, q)) and all(is_move_free(sampler.collision, *m) for m in moves):
                notes = (*sampler.notes, *([TURNING_NOTE] if is_turning else []))
                return IsoCube(side, chain.poses(q[:1])[0, :3, 3], q, notes)
    raise InvalidArgumentError(
        f"no cube with a side of {', '.join(f'{1e3 * side:g}' for side in sides)} mm fits into the "
        "workspace; choose a smaller side (--cube), another tool, or fewer constraints"
    )


def _contains_first_axis(chain: Chain, centres: Array, side: float) -> Array:
    """Return whether each cube contains a part of the axis of the first joint, if it is revolute, (m,)."""
    if chain.prismatic[0]:
        return np.zeros(len(centres), bool)
    frame = chain.base @ chain.origins[0]
    axis = frame[:3, :3] @ chain.axes[0]
    offsets = centres - frame[:3, 3]
    # The part within the sphere around the cube is sampled.
    along = offsets @ axis
    steps = np.linspace(-side, side, _N_AXIS_STEPS)
    points = (along[:, None] + steps)[..., None] * axis - offsets[:, None]
    return np.any(np.all(np.abs(points) <= side / 2, 2), 1)


def _reachable(
    chain: Chain, starts: Array, side: float, sampler: ConfigurationSampler, is_turning: bool
) -> list[Array]:
    """Return the joint positions (5, n) at the points of cubes within reach, best first; tools may turn."""
    centres, length = chain.poses(starts), characteristic_length(chain)
    is_inside = ~_contains_first_axis(chain, centres[:, :3, 3], side)
    q = np.zeros((len(starts), len(POINTS), chain.n_joints))
    for offsets in (POINTS, GRID):
        index = np.repeat(np.flatnonzero(is_inside), len(offsets))
        if not len(index):
            return []
        targets = centres[index]
        targets[:, :3, 3] += np.tile(side / 2 * offsets, (len(index) // len(offsets), 1))
        is_free = is_turning or offsets is GRID
        task = position_task(targets[:, :3, 3]) if is_free else pose_task(targets, length)
        found, misses = solve_ik(chain, task, starts[index], _IK_STEPS)
        is_reached = (misses <= REACHED_TOL) & sampler.in_workspace(found)
        shape = (-1, len(offsets))
        if offsets is POINTS:
            q[is_inside] = found.reshape(*shape, chain.n_joints)
        is_inside[is_inside] = is_reached.reshape(shape).all(1)
    q = q[is_inside]
    jacobians = tool_pose_and_jacobian(chain, q.reshape(-1, chain.n_joints))[1]
    jacobians = jacobians * np.array([1, 1, 1, length, length, length])[:, None]
    if is_turning:
        jacobians = jacobians[:, :3]
    smallest = np.linalg.svd(jacobians, compute_uv=False)[:, -1].reshape(-1, len(POINTS)).min(1)
    return list(q[np.argsort(-smallest)])
