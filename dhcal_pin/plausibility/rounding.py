"""Joint values with few digits: whether residuals are those of values that are wrong by up to half a step.

Joint values that are multiples of a step u are often rounded, or commanded and not quite reached. The error
of a joint is then uniform in ±u/2, with the standard deviation u/√12. With the derivative of the errors of a
group of samples by the joints, times u/√12, as A, the covariance of these errors is

    s²·I                     by the noise of the instrument alone
    s²·I + A·Aᵀ              by rounded joint values

Commanded values that the robot reached are multiples of a step, too, and the first covariance explains their
residuals. The ratio of the likelihoods with the best s of each tells both apart, even if A·Aᵀ and the
residuals are of one size: rounding displaces the tool farther where the arm is stretched, and along the
motions of the joints only.

Shapes: m samples, n joints, d components of an error, c configurations per sample.
"""

from __future__ import annotations

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..formatting import format_quantity, join_names
from ..measurements.base import Measurement, errors_of
from ..measurements.groups import ERROR_GROUPS, error_group
from ..robot.chain import Chain

# Steps of joint values, the largest one first [deg, rad or mm].
STEPS = (1.0, *(digit * 10.0**-decimals for decimals in range(1, 6) for digit in (5, 1)))
# Largest distance from a multiple, as a fraction of the step: values may be stored as 32-bit numbers.
MAX_REMAINDER = 1e-3
# Fewer different values of a joint may be multiples by chance, or by a plan.
MIN_DIFFERENT = 10
# Range of the expected RMS error relative to the one that the fit leaves. It was 0.81 to 1.29 for rounded
# values of simulated arms whose noise is small beside the rounding.
MIN_SHARE, MAX_SHARE = 0.7, 1.5
# Logarithm of the ratio of the likelihoods: the rounding explains the errors 20 times better. 50 or more
# positions and poses at rounded values have 7 to 910, unless joint errors were added that fit the rounding.
# Commanded values that were reached have -632 to -6 with a noise as large as the effect of the step would be.
MIN_LOG_LIKELIHOOD_RATIO = 3.0
# Samples of a measurement that are examined.
MAX_EXAMINED = 2000
# Variances of the noise that are compared, relative to that of all residuals.
NOISE_VARIANCES = np.geomspace(1e-5, 1.0, 51)


@frozen
class Rounding:
    """Steps of the joint values of a measurement that explain its residuals."""

    joints: tuple[str, ...]  # Joints whose values are multiples of a step; empty for all
    steps: tuple[str, ...]  # Their different steps with the units
    group: str  # Name of the error group of the following figures
    expected: float  # RMS error that values leave that are wrong by up to half a step
    found: float  # RMS error that the fit leaves

    @property
    def sentence(self) -> str:
        """State the steps, both errors and the remedy."""
        errors = ERROR_GROUPS[self.group]
        found, expected = (
            format_quantity(rms, errors.unit, 0.05 * self.found, small=True)
            for rms in (self.found, self.expected)
        )
        names = f" of {join_names(self.joints)}" if self.joints else ""
        return (
            f"The joint values{names} are multiples of {join_names(self.steps)}. The RMS {errors.label} that "
            f"the fit leaves ({found}) is about that of values that are wrong by up to half a step "
            f"({expected}). If they are rounded, or commanded and not quite reached, measured values with "
            "two more digits make the calibration more accurate. If digits were cut off, not rounded, the "
            "zeros of the joints are wrong by half a step, too."
        )


def find_rounding(
    item: Measurement, chain: Chain, instruments: dict[str, float], rows_per_freedom: float
) -> Rounding | None:
    """Find steps of joint values that explain the errors of a measurement; None without such steps."""
    if not (item.has_joint_values and item.configurations_per_row and len(item.rows)):
        return None
    item = item.take(np.arange(0, len(item.rows), -(-len(item.rows) // MAX_EXAMINED)))
    found = [
        _find_step(values, is_prismatic)
        for values, is_prismatic in zip(item.configurations().T, chain.is_prismatic, strict=True)
    ]
    steps = np.array([step for step, _ in found])
    if not steps.any():
        return None
    errors = errors_of(item, chain, instruments)
    # A fit with few degrees of freedom takes a part of the errors.
    std = steps / np.sqrt(12 * rows_per_freedom)
    effects = _effects(item, chain, instruments, std, errors)
    main = next(iter(item.residual_groups))
    rms = {name: float(np.sqrt(np.mean(np.sum(errors[name] ** 2, 1)))) for name in item.residual_groups}
    expected = float(np.sqrt(np.mean(np.sum(effects[main] ** 2, (1, 2)))))
    is_similar = MIN_SHARE * rms[main] <= expected <= MAX_SHARE * rms[main]
    if not (is_similar and min(rms.values()) > 0):
        return None
    scales = {name: np.sqrt(errors[name].shape[1]) / rms[name] for name in rms}
    residuals, scaled_effects = (
        np.concatenate([scale * each[name] for name, scale in scales.items()], 1)
        for each in (errors, effects)
    )
    ratio = _log_likelihood_ratio(residuals, scaled_effects, item.sample_groups)
    if not ratio > MIN_LOG_LIKELIHOOD_RATIO:
        return None
    is_rounded = steps > 0
    return Rounding(
        () if is_rounded.all() else tuple(np.array(chain.joint_names)[is_rounded].tolist()),
        tuple(dict.fromkeys(text for _, text in found if text)),
        error_group(main),
        expected,
        rms[main],
    )


def _find_step(values: Array, is_prismatic: bool) -> tuple[float, str]:
    """Return the largest step of the values (m,) of a joint [rad or m] with its text; 0 without one."""
    if len(np.unique(values)) < MIN_DIFFERENT:
        return 0.0, ""
    units = {" mm": 1e-3} if is_prismatic else {"°": np.deg2rad(1.0), " rad": 1.0}
    for step in STEPS:
        for name, unit in units.items():
            multiples = values / (step * unit)
            if np.abs(multiples - np.rint(multiples)).max() < MAX_REMAINDER:
                return step * unit, f"{step:g}{name}"
    return 0.0, ""


def _effects(
    item: Measurement, chain: Chain, instruments: dict[str, float], std: Array, errors: dict[str, Array]
) -> dict[str, Array]:
    """Return the changes of errors (m, d, c·n) by one standard deviation of each joint value, by group."""
    q, m = item.configurations(), len(item.rows)
    changes: dict[str, list[Array]] = {name: [] for name in item.residual_groups}
    for first in range(0, len(q), m):
        for joint in np.flatnonzero(std):
            moved = q.copy()
            moved[first : first + m, joint] += std[joint]
            changed = errors_of(item.resample(moved), chain, instruments)
            for name, columns in changes.items():
                columns.append(changed[name] - errors[name])
    return {name: np.stack(columns, 2) for name, columns in changes.items()}


def _log_likelihood_ratio(residuals: Array, effects: Array, groups: Array) -> float:
    """Return the logarithm of the likelihood with effects of the joints over that with noise alone.

    The residuals (m, d) have a mean square of 1. Samples of one group share the errors of the joint values.
    """
    out = np.full(len(NOISE_VARIANCES), 0.5 * residuals.size)
    for label in np.unique(groups):
        residual = residuals[groups == label].ravel()
        axes, s, _ = np.linalg.svd(effects[groups == label].reshape(len(residual), -1), full_matrices=False)
        along = (axes.T @ residual) ** 2
        variances = NOISE_VARIANCES[:, None] + s**2
        across = max(float(residual @ residual - along.sum()), 0.0)
        out -= 0.5 * np.sum(along / variances + np.log(variances), 1)
        out -= 0.5 * (across / NOISE_VARIANCES + (len(residual) - len(s)) * np.log(NOISE_VARIANCES))
    return float(out.max())
