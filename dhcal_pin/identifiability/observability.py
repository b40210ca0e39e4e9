"""Observability in numbers: indices, observable fractions, weakly observable directions.

All functions take the R factor of the whitened Jacobian J (unknowns in m and rad, rows in units of their
standard deviations). J and R have the same singular values σ₁ ≥ … ≥ σ_p and right singular vectors v_i. JᵀJ
is never formed: at a condition of 1e7 its inverse is wrong in the third digit.

* Rank L: number of σ_i above `estimation.qr.RANK_RTOL` times σ₁.
* Observable subspace: span of v₁ … v_L; its projector is P = V_L·V_Lᵀ. Null space: the orthogonal complement.
* Observability indices O1 to O5, functions of σ₁ … σ_L; see `observability_indices`.

References:
    J.-H. Borm and C.-H. Menq, Determination of optimal measurement configurations for robot calibration based
    on observability measure, Int. J. Robotics Research 10 (1991), 51-63: O1.
    M. R. Driels and U. S. Pathre, Significance of observation strategy on the design of robot calibration
    experiments, J. Robotic Systems 7 (1990), 197-223: O2.
    A. Nahvi, J. M. Hollerbach and V. Hayward, Calibration of a parallel robot using multiple kinematic closed
    loops, IEEE ICRA 1994, 407-412: O3.
    A. Nahvi and J. M. Hollerbach, The noise amplification index for optimal pose selection in robot
    calibration, IEEE ICRA 1996, 647-654: O4.
    Y. Sun and J. M. Hollerbach, Observability index selection for robot calibration, IEEE ICRA 2008, 831-836:
    O5.
"""

from __future__ import annotations

import numpy as np

from .._typing import Array
from ..estimation.qr import TriangularSystem, null_space, right_singular_vectors

# A direction is known if its posterior standard deviation is below this fraction of the prior one.
MAX_KNOWN_STD_RATIO = 0.5
# Entries of the null-space projector above this value connect two parameters.
_MIN_PROJECTOR_ENTRY = 1e-6


def observable_fraction(system: TriangularSystem) -> Array:
    """Compute how much of each parameter lies in the observable subspace.

    The fraction is the diagonal of the projector P: 1 for an identifiable parameter, 0 for one without effect
    on the measurements, and between them for a parameter that is identifiable only in combination with
    others.
    """
    return np.clip(1 - np.sum(system.null_space**2, 1), 0.0, 1.0)


def observability_indices(system: TriangularSystem, samples: int) -> dict[str, float]:
    """Compute the observability indices O1 to O5 over the observable directions; larger is better.

    With the singular values σ₁ ≥ … ≥ σ_L of the whitened Jacobian and m samples:

    * O1 = (σ₁·…·σ_L)^(1/L)/√m: Borm and Menq (1991);
    * O2 = σ_L/σ₁, the inverse condition number: Driels and Pathre (1990);
    * O3 = σ_L: Nahvi, Hollerbach and Hayward (1994);
    * O4 = σ_L²/σ₁, the noise amplification index: Nahvi and Hollerbach (1996);
    * O5 = 1/(1/σ₁ + … + 1/σ_L): Sun and Hollerbach (2008).
    """
    s = system.singular_values[: system.rank]
    if not s.size:
        return dict.fromkeys(("O1", "O2", "O3", "O4", "O5"), 0.0)
    indices = (
        np.exp(np.mean(np.log(s))) / np.sqrt(samples),
        s[-1] / s[0],
        s[-1],
        s[-1] ** 2 / s[0],
        1 / np.sum(1 / s),
    )
    return {f"O{i + 1}": float(value) for i, value in enumerate(indices)}


def correlation(covariance: Array) -> Array:
    """Compute correlation coefficients from a covariance matrix."""
    std = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        out = np.clip(covariance / np.outer(std, std), -1.0, 1.0)
    np.fill_diagonal(out, 1.0)
    return out


def weakly_observable(system: TriangularSystem, prior_std: Array, noise: float) -> tuple[Array, Array]:
    """Find directions that count in the rank but are hardly better known than before the measurement.

    The columns of R are scaled by the prior standard deviations, which makes metres and radians comparable.
    For a direction with singular value s of the scaled factor, measurements with this noise reduce the
    standard deviation to the fraction 1/√(1 + (s/noise)²) of the prior one. Directions with
    `MAX_KNOWN_STD_RATIO` or more are weakly observable. They are one prior standard deviation long, shape (p,
    w), and come with these ratios. Directions in the null space are not included.
    """
    s, vt = right_singular_vectors(system.r * prior_std)
    s = s[: system.rank]
    std_ratios = noise / np.hypot(noise, s)
    weak = np.flatnonzero(std_ratios >= MAX_KNOWN_STD_RATIO)
    return prior_std[:, None] * vt[weak].T, std_ratios[weak]


def connected_components(adjacency: Array) -> list[tuple[int, ...]]:
    """Find the connected components of an undirected graph."""
    out: list[tuple[int, ...]] = []
    remaining = set(np.flatnonzero(np.diag(adjacency)).tolist())
    while remaining:
        component, frontier = set[int](), {min(remaining)}
        while frontier:
            component |= frontier
            frontier = {int(j) for i in frontier for j in np.flatnonzero(adjacency[i])} - component
        remaining -= component
        out.append(tuple(sorted(component)))
    return out


def unobservable_groups(r: Array) -> list[tuple[tuple[int, ...], int]]:
    """Group the parameters that are identifiable only in combination."""
    basis = null_space(r)
    projector = basis @ basis.T
    return [
        (members, round(float(np.trace(projector[np.ix_(members, members)]))))
        for members in connected_components(np.abs(projector) > _MIN_PROJECTOR_ENTRY)
    ]
