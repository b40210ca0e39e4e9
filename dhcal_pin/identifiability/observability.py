"""What the data see, in numbers: rank, unseen and weakly seen directions, observability indices.

All of it comes from the triangle of a QR; the words are in `explanations`.

The triangle is R of the QR of the whitened Jacobian, metres and radians in its columns. Nothing here
forms JᵀJ: at condition 1e7 that is wrong in the third digit.
"""

from __future__ import annotations

import numpy as np

from .._typing import Array
from ..estimation.qr import rank, row_space, singular_values

# A direction is known by the data if they leave less than this share of what was expected before them.
MAX_KNOWN_STD_RATIO = 0.5


def observable_fraction(triangle: Array) -> Array:
    """How far each parameter lies in what the data see, (p,) between 0 (not at all) and 1 (fully)."""
    return np.clip(np.sum(row_space(triangle) ** 2, 0), 0.0, 1.0)


def observability_indices(triangle: Array, samples: int) -> dict[str, float]:
    """Observability indices O1 to O5 over the directions seen; the larger, the better; 0 if there is none.

    With σ₁ ≥ … ≥ σ_L the singular values of the whitened Jacobian (metres and radians) and m samples:

    * O1 = (σ₁…σ_L)^(1/L)/√m: Borm and Menq, Int. J. Robotics Research 10 (1991);
    * O2 = σ_L/σ₁, the inverse condition: Driels and Pathre, J. Robotic Systems 7 (1990);
    * O3 = σ_L: Nahvi, Hollerbach and Hayward, ICRA 1994;
    * O4 = σ_L²/σ₁, noise amplification: Nahvi and Hollerbach, ICRA 1996;
    * O5 = 1/(1/σ₁ + … + 1/σ_L): Sun and Hollerbach, ICRA 2008.

    Args:
        triangle: (p, p).
        samples: m.
    """
    s = singular_values(triangle)[: rank(triangle)]
    if not s.size:
        return dict.fromkeys(("O1", "O2", "O3", "O4", "O5"), 0.0)
    found = (
        np.exp(np.mean(np.log(s))) / np.sqrt(samples),
        s[-1] / s[0],
        s[-1],
        s[-1] ** 2 / s[0],
        1 / np.sum(1 / s),
    )
    return {f"O{i + 1}": float(value) for i, value in enumerate(found)}


def correlation(covariance: Array) -> Array:
    """Correlations (p, p) of a covariance; NaN off the diagonal where a variance is not finite."""
    std = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        out = np.clip(covariance / np.outer(std, std), -1.0, 1.0)
    np.fill_diagonal(out, 1.0)
    return out


def weakly_observable(triangle: Array, expected: Array, noise: float) -> tuple[Array, Array]:
    """Directions that count in the rank but of which the data tell next to nothing.

    Each column of the triangle is scaled by what was expected of its parameter, so that metres and radians
    compare. Of a direction with singular value s there, data of that noise leave 1/√(1 + (s/noise)²) of
    what was expected before; `KNOWN_SHARE` of it or more is not knowledge. Directions not seen at all
    are left out.

    Args:
        triangle: (p, p).
        expected: (p,) standard deviations before any measurement, m and rad.
        noise: standard deviation of the whitened residuals.

    Returns:
        The directions (p, w), each one expected standard deviation long, and the shares (w,) left.
    """
    _, s, vt = np.linalg.svd(triangle * expected)
    s = s[: rank(triangle)]
    left = noise / np.hypot(noise, s)
    weak = np.flatnonzero(left >= MAX_KNOWN_STD_RATIO)
    return expected[:, None] * vt[weak].T, left[weak]


def clusters(linked: Array) -> list[tuple[int, ...]]:
    """Those of p that link to themselves in a symmetric (p, p) table, put together where it links them."""
    out: list[tuple[int, ...]] = []
    todo = set(np.flatnonzero(np.diag(linked)).tolist())
    while todo:
        group, edge = set[int](), {min(todo)}
        while edge:
            group |= edge
            edge = {int(j) for i in edge for j in np.flatnonzero(linked[i])} - group
        todo -= group
        out.append(tuple(sorted(group)))
    return out


def unobservable_groups(triangle: Array) -> list[tuple[tuple[int, ...], int]]:
    """Groups of parameters that cannot be told apart, each with its number of unseen directions."""
    basis = row_space(triangle)
    hidden = np.eye(triangle.shape[1]) - basis.T @ basis
    return [
        (members, round(float(np.trace(hidden[np.ix_(members, members)]))))
        for members in clusters(np.abs(hidden) > 1e-6)
    ]
