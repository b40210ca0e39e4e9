"""Prediction of the joint correction curves: filled bins, and the standard deviation that remains.

A joint's curve is c(q) = φ(q)ᵀ·x with the harmonics φ of the parameter set `curves` and their coefficients x.
Measurements leave the covariance C of all unknowns (`information`), hence the variance φ(q)ᵀ·C·φ(q) of the
curve at the joint value q. It is averaged over the bins that the candidates of the plan visit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..robot.coverage import BIN_CENTRES, joint_coverage
from ..robot.error_families import CURVE_ORDERS
from .exchange import compute_sqrt_covariance
from .information import Information


@frozen
class CurvePrediction:
    """Expected knowledge of the joint correction curves after some poses."""

    n_poses: int  #: Number of planned poses
    #: Share of the bins that candidates or existing measurements visit in which there is at least one planned
    #: pose or existing measurement.
    filled_share: float
    curve_std: float  #: Standard deviation of the curves, RMS over these bins of all joints [rad]


def predict_curves(
    information: Information, plans: Sequence[Array], existing: Array, candidates: Array
) -> tuple[CurvePrediction, ...]:
    """Predict what plans of several sizes (n, dof) contain about the joint correction curves, one by one."""
    chain = information.chain
    everywhere = joint_coverage(chain, np.concatenate([existing, candidates]))
    reached = {one.joint: one.counts > 0 for one in everywhere}
    n_reached = sum(int(bins.sum()) for bins in reached.values())
    out = []
    for q in plans:
        coverage = joint_coverage(chain, np.concatenate([existing, q]))
        n_filled = sum(int((one.counts[reached[one.joint]] > 0).sum()) for one in coverage)
        out.append(CurvePrediction(len(q), n_filled / n_reached, _curve_std(information, q, reached)))
    return tuple(out)


def _curve_std(information: Information, q: Array, reached: Mapping[str, Array]) -> float:
    """Compute the RMS standard deviation of the curves in bins (b,) of each joint after measuring at q."""
    rows = np.ascontiguousarray(information.rows(q).transpose(2, 1, 0))
    sqrt_covariance = compute_sqrt_covariance(information.prior_factor, rows)
    columns = {parameter.name: i for i, parameter in enumerate(information.errors.parameters)}
    variances = []
    for joint, bins in reached.items():
        phases = np.outer(BIN_CENTRES[bins], CURVE_ORDERS)
        used = [columns[f"{joint}.{part}{order}"] for part in ("sin", "cos") for order in CURVE_ORDERS]
        harmonics = np.concatenate([np.sin(phases), np.cos(phases)], 1) * information.prior_sigma[used]
        variances.append(np.sum((harmonics @ sqrt_covariance[used]) ** 2, 1))
    return float(np.sqrt(np.mean(np.concatenate(variances))))
