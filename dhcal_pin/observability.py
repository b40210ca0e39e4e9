"""What the data see: rank, unseen directions and their words, all from the triangle of a QR.

The triangle is R of the QR of the whitened Jacobian, metres and radians in its columns. Nothing here
forms JᵀJ: at condition 1e7 that is wrong in the third digit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .measurements import Unknown
from .parameters import Parameter
from .se3 import Array

# Singular values below this share of the largest are rounding. The paper's arms keep what they see
# above 1e-4; a cut of 1e-3 or more would already block its loop.
RANK_CUT = 1e-9


def singular_values(triangle: Array) -> Array:
    """Singular values (p,) of a triangle (p, p), falling."""
    return np.linalg.svd(triangle, compute_uv=False)


def row_space(triangle: Array) -> Array:
    """Orthonormal basis (rank, p) of the directions in parameter space that the data see."""
    _, s, vt = np.linalg.svd(triangle)
    return vt[: int(np.sum(s > RANK_CUT * s[0]))] if s.size and s[0] > 0 else vt[:0]


def rank(triangle: Array) -> int:
    """Number of independent directions that the data see."""
    return len(row_space(triangle))


def condition(triangle: Array) -> float:
    """Largest over smallest singular value among the seen directions; 0 if there is none."""
    s = singular_values(triangle)
    seen = s[s > RANK_CUT * s[0]] if s.size else s
    return float(seen[0] / seen[-1]) if seen.size else 0.0


def seen_share(triangle: Array) -> Array:
    """How far each parameter lies in what the data see, (p,) between 0 (not at all) and 1 (fully)."""
    return np.clip(np.sum(row_space(triangle) ** 2, 0), 0.0, 1.0)


def unseen_groups(triangle: Array) -> list[tuple[tuple[int, ...], int]]:
    """Groups of parameters that cannot be told apart, each with its number of unseen directions."""
    basis = row_space(triangle)
    hidden = np.eye(triangle.shape[1]) - basis.T @ basis
    linked = np.abs(hidden) > 1e-6
    groups: list[tuple[tuple[int, ...], int]] = []
    todo = set(np.flatnonzero(np.diag(linked)).tolist())
    while todo:
        group, edge = set[int](), {min(todo)}
        while edge:
            group |= edge
            edge = {int(j) for i in edge for j in np.flatnonzero(linked[i])} - group
        todo -= group
        members = tuple(sorted(group))
        groups.append((members, round(float(np.trace(hidden[np.ix_(members, members)])))))
    return groups


def unobservable(triangle: Array, parameters: Sequence[Parameter | Unknown]) -> list[str]:
    """One sentence a group of parameters that the data cannot tell apart; empty when all is seen."""
    out = []
    for members, unseen in unseen_groups(triangle):
        names = [parameters[i].name for i in members]
        if len(names) == 1:
            out.append(f"{names[0]}: the measurements do not depend on it")
            continue
        listed = f"{', '.join(names[:-1])} and {names[-1]}"
        if unseen == len(names):
            out.append(f"{listed}: the measurements depend on none of them")
        else:
            seen = len(names) - unseen
            only = "only one combination" if seen == 1 else f"only {seen} combinations"
            out.append(f"{listed} move the measured point alike: {only} of the {len(names)} can be seen")
    return out
