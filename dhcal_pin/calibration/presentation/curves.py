"""Joint correction curves of a calibration with their standard deviation, and the coverage of the joints.

The harmonics of a joint change its position by e(q) = Σ_k (S_k·sin kq + C_k·cos kq), see
`robot.transmission`. To first order, the correction of a commanded joint value is -e(q). Its variance is
φ(q)ᵀ·C·φ(q) with the covariance C of the identified coefficients and their harmonics φ.

Where no configuration was measured, a curve continues harmonics that were fitted to other joint values.

Shapes: v joint values, n independent joints, e uncertain coefficients, b bins of a turn.
"""

from __future__ import annotations

import numpy as np

from ..._frozen import frozen
from ..._typing import Array
from ...estimation.uncertainty import UNBOUNDED_TOL, Uncertainty
from ...robot.coverage import JointCoverage, bin_indices, joint_coverage, lattice_warnings
from ...robot.error_families import CURVE_ORDERS
from ...robot.transmission import MAX_CURVE_ORDER, coefficient_indices, fill_harmonics
from ..evidence import Evidence
from ..partition import different_configurations

# Joint values of a curve: every degree of a turn [rad].
CURVE_VALUES = np.deg2rad(np.arange(-180.0, 181.0))


@frozen(eq=False)
class JointCurve:
    """Correction curve of a joint."""

    coverage: JointCoverage  # Joint values that were measured
    values: Array  # Joint values within the joint limits, in steps of a degree, shape (v,) [rad]
    correction: Array  # Angle to add to each joint value before it is commanded, shape (v,) [rad]
    std: Array  # Standard deviation of the correction, shape (v,) [rad]; infinite if it is not determined

    @property
    def is_measured(self) -> Array:
        """Whether each joint value is in a bin that was visited, shape (v,)."""
        return self.coverage.counts[bin_indices(self.values)] > 0


def fitted_coverage(fit: Evidence) -> tuple[JointCoverage, ...]:
    """Compute which joint values the fitted samples visited."""
    q, _ = different_configurations(fit.inliers)
    return joint_coverage(fit.chain, q) if len(q) and fit.has_joint_values else ()


def joint_curves(fit: Evidence) -> list[JointCurve]:
    """Compute the correction curves of the joints that have harmonics."""
    if fit.chain.transmission is None:
        return []
    harmonics = fit.chain.transmission.harmonics
    numbers = {name: i for i, name in enumerate(fit.chain.joint_names)}
    out = []
    for coverage in fitted_coverage(fit):
        joint = numbers[coverage.joint]
        if not harmonics[:, :, joint].any():
            continue
        values = CURVE_VALUES[coverage.is_in_range[bin_indices(CURVE_VALUES)]]
        waves = np.empty((MAX_CURVE_ORDER, 2, len(values)))
        fill_harmonics(values, waves)
        correction = -np.tensordot(harmonics[:, :, joint], waves)
        out.append(JointCurve(coverage, values, correction, _curve_std(fit.uncertainty, joint, waves)))
    return out


def find_lattices(fit: Evidence) -> list[str]:
    """Find joints whose estimated correction curve is not determined because their values form a lattice."""
    _, indices, *_ = coefficient_indices(*fit.chain.mimic_matrix.shape)
    orders, joints = np.nonzero(np.isin(indices, fit.uncertainty.entries).any(1))
    estimated = {fit.chain.joint_names[i] for i in joints[orders + 1 >= CURVE_ORDERS.start]}
    if not estimated:
        return []
    highest = int(orders.max()) + 1
    return lattice_warnings([c for c in fitted_coverage(fit) if c.joint in estimated], highest)


def _curve_std(uncertainty: Uncertainty, joint: int, waves: Array) -> Array:
    """Return the standard deviation of a joint's curve (v,) from the harmonics (K, 2, v) at its values."""
    _, indices, *_ = coefficient_indices(*uncertainty.chain.mimic_matrix.shape)
    is_of_joint = np.isin(uncertainty.entries, indices[:, :, joint])
    by_index = dict(
        zip(indices[:, :, joint].ravel().tolist(), waves.reshape(-1, waves.shape[-1]), strict=True)
    )
    terms = np.array([by_index[entry] for entry in uncertainty.entries[is_of_joint].tolist()])
    first = len(uncertainty.sqrt_covariance) - len(uncertainty.entries)
    rows = first + np.flatnonzero(is_of_joint)
    variance, undetermined = (
        np.sum((terms.reshape(len(rows), waves.shape[-1]).T @ part[rows]) ** 2, 1)
        for part in (uncertainty.sqrt_covariance, uncertainty.unbounded_directions)
    )
    return np.where(undetermined > UNBOUNDED_TOL, np.inf, np.sqrt(variance))
