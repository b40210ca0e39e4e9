"""Tour through planned poses: their order, and whether the arm can move from one to the next.

A move is a straight line in joint space. It is free if no configuration on it collides; the configurations
that are checked are `MAX_STEP_RAD` apart. The order is a short tour that avoids moves that collide:

1. Find a short tour and check its moves.
2. Add `DETOUR_RAD` to the distance of poses between which a move collides, and start again, until all moves
   are free or `N_ORDERS` orders were tried. The order with the fewest collisions is kept.
3. A move that still collides is made free by a whole turn of a joint in all poses up to the next such move,
   or by way points (RRT-Connect).

Shapes: n poses, dof joints, w way points.

References:
    J. J. Kuffner and S. M. LaValle, RRT-Connect: an efficient approach to single-query path planning,
    ICRA 2000.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..robot.collision import CollisionChecker
from ..robot.sampling import scale_joint_units, shortest_tour

# Largest change of a joint between two configurations that are checked, in the units of `scale_joint_units`.
MAX_STEP_RAD = np.deg2rad(1.0)
# Interval of the steps that are checked first. Most collisions extend over more steps.
COARSE_STRIDE = 8
# Additional distance of two poses between which a move collides: longer than any move.
DETOUR_RAD = 100.0
# Number of orders that are tried.
N_ORDERS = 12
# Number of extensions of the trees that look for way points, and their length in the units above.
N_EXTENSIONS, EXTENSION_RAD = 300, 0.5


@frozen(eq=False)
class Tour:
    """Order of poses and the ways between them."""

    order: Array  # Indices of the poses, shape (n,)
    q: Array  # Joint positions in this order, shape (n, dof) [rad or m]
    ways: tuple[Array, ...]  # Way points before each pose of the tour, shapes (w, dof) [rad or m]
    # Whether the moves to each pose of the tour are free of collisions; true for the first.
    is_way_free: tuple[bool, ...]


def find_tour(
    q: Array,
    checker: CollisionChecker,
    low: Array,
    high: Array,
    can_turn: Array,
    rng: np.random.Generator,
) -> Tour:
    """Find a short order of poses with free moves between them; without geometry, all moves are free."""
    # The positions of joints that `can_turn` may change by a whole turn if that makes a move free.
    order, is_direct = _order_with_fewest_collisions(q, checker)
    q = q[order]
    # Parts of the tour with free moves between their poses; the longest one stays as it is.
    bounds = [0, *(i + 1 for i, free in enumerate(is_direct) if not free), len(q)]
    parts = list(pairwise(bounds))
    longest = max(range(len(parts)), key=lambda i: parts[i][1] - parts[i][0])
    ways, is_way_free = [q[:0]] * len(q), [True] * len(q)
    for first, end in parts[longest + 1 :]:
        found = connected(checker, q[first - 1], q[first:end], low, high, can_turn, rng)
        q[first:end], ways[first], is_way_free[first] = found
    for first, end in parts[:longest][::-1]:
        part, way, is_way_free[end] = connected(checker, q[end], q[first:end][::-1], low, high, can_turn, rng)
        q[first:end], ways[end] = part[::-1], way[::-1]
    return Tour(order, q, tuple(ways), tuple(is_way_free))


def is_move_free(checker: CollisionChecker, start: Array, end: Array) -> bool:
    """Check the configurations of a straight line in joint space."""
    length = np.abs(scale_joint_units(checker.chain, (end - start)[None])).max()
    n_steps = max(1, int(np.ceil(length / MAX_STEP_RAD)))
    shares = np.fromiter(_coarse_first(n_steps), float)[:, None] / n_steps
    return checker.are_collision_free(start + shares * (end - start))


def _coarse_first(n_steps: int) -> Iterator[int]:
    """Yield the steps 0 … n_steps, every `COARSE_STRIDE`-th first."""
    for offset in (0, *range(COARSE_STRIDE // 2, 0, -1), *range(COARSE_STRIDE // 2 + 1, COARSE_STRIDE)):
        yield from range(offset, n_steps + 1, COARSE_STRIDE)


def _order_with_fewest_collisions(q: Array, checker: CollisionChecker) -> tuple[Array, list[bool]]:
    """Return the order (n,) of poses (n, dof) with the fewest collisions, and which moves are free."""
    coordinates = scale_joint_units(checker.chain, q)
    known: dict[tuple[int, int], bool] = {}

    def is_free(i: int, j: int) -> bool:
        key = (min(i, j), max(i, j))
        if key not in known:
            known[key] = is_move_free(checker, q[i], q[j])
        return known[key]

    detours = np.zeros((len(q), len(q)))
    best, best_is_free = np.arange(len(q)), [False] * len(q)
    for _ in range(N_ORDERS):
        order = shortest_tour(coordinates, detours)
        moves = list(pairwise(order.tolist()))
        free_moves = [is_free(i, j) for i, j in moves]
        if free_moves.count(False) < best_is_free.count(False):
            best, best_is_free = order, free_moves
        if all(free_moves):
            break
        for (i, j), is_this_free in zip(moves, free_moves, strict=True):
            if not is_this_free:
                detours[i, j] = detours[j, i] = DETOUR_RAD
    return best, best_is_free


def connected(
    checker: CollisionChecker,
    start: Array,
    part: Array,
    low: Array,
    high: Array,
    can_turn: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array, bool]:
    """Find a free way to a part of a tour; the moves within the part are free."""
    # All poses of the part may turn together. Return it, way points (w, dof), and whether a way was found.
    variants = [part]
    for joint in np.flatnonzero(can_turn):
        for turn in (-2 * np.pi, 2 * np.pi):
            turned = part.copy()
            turned[:, joint] += turn
            variants += [turned] if np.all((turned >= low) & (turned <= high)) else []
    for variant in variants:
        if is_move_free(checker, start, variant[0]):
            return variant, part[:0], True
    for variant in variants:
        if len(way := find_way(checker, start, variant[0], low, high, rng)):
            return variant, way, True
    return part, part[:0], False


@frozen(eq=False)
class _Tree:
    """Tree of configurations with free moves between each node and its parent."""

    checker: CollisionChecker
    nodes: list[Array]  # Joint positions of the nodes, shapes (dof,) [rad or m]; the first is the root
    parents: list[int]  # Index of the parent of each node; -1 for the root

    def extend(self, target: Array) -> bool:
        """Add a node towards a configuration if the move is free; return whether it was added."""
        differences = target - np.array(self.nodes)
        distances = np.linalg.norm(scale_joint_units(self.checker.chain, differences), axis=1)
        nearest = int(np.argmin(distances))
        share = min(1.0, EXTENSION_RAD / max(distances[nearest], 1e-12))
        node = target if share == 1 else self.nodes[nearest] + share * differences[nearest]
        if not is_move_free(self.checker, self.nodes[nearest], node):
            return False
        self.nodes.append(node)
        self.parents.append(nearest)
        return True

    def path_to_root(self) -> list[Array]:
        """Return the configurations from the last node to the root."""
        path, i = [], len(self.nodes) - 1
        while i >= 0:
            path.append(self.nodes[i])
            i = self.parents[i]
        return path


def find_way(
    checker: CollisionChecker, start: Array, end: Array, low: Array, high: Array, rng: np.random.Generator
) -> Array:
    """Find way points (w, dof) between two poses by RRT-Connect, two trees that grow towards each other."""
    first, second = _Tree(checker, [start], [-1]), _Tree(checker, [end], [-1])
    # Joints without limits have a range of two turns.
    low, high = np.maximum(low, -2 * np.pi), np.minimum(high, 2 * np.pi)
    if not (checker.is_collision_free(start) and checker.is_collision_free(end)):
        return np.empty((0, len(start)))
    for _ in range(N_EXTENSIONS):
        if first.extend(rng.uniform(low, high)):
            target = first.nodes[-1]
            while second.extend(target):
                if np.array_equal(second.nodes[-1], target):
                    path = first.path_to_root()[::-1] + second.path_to_root()[1:]
                    path = path if path[0] is start else path[::-1]
                    return np.array(_shortened(checker, path)[1:-1])
        first, second = second, first
    return np.empty((0, len(start)))


def _shortened(checker: CollisionChecker, path: list[Array]) -> list[Array]:
    """Leave out way points wherever the direct move is free, the longest parts first."""
    i = 0
    while i < len(path) - 2:
        for j in range(len(path) - 1, i + 1, -1):
            if is_move_free(checker, path[i], path[j]):
                path = path[: i + 1] + path[j:]
                break
        i += 1
    return path
