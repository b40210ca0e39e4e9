"""Residuals of a calibration by sample and by joint.

The joint profile of joint j answers which offset of this joint alone would explain the residuals in each part
of its range. With the whitened derivative a_i of sample i by the offset of the joint, and the whitened
residual r_i,

    offset = Σ a_i·r_i / Σ a_i·a_i              over the samples i of the part
    std    = √Σ (a_i·r_i - offset·a_i·a_i)² / Σ a_i·a_i

A wave over the range is an error of the joint that the model lacks, such as an eccentric gear.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..calibration.evaluation import compute_errors, fit_instrument_parameters
from ..calibration.result import Result
from ..estimation.error_model import ErrorModel
from ..estimation.parameters import offset
from ..measurements.base import Measurement, instrument_values, whitened_jacobian
from ..measurements.groups import error_group
from ..robot.chain import Chain

# Parts that the range of a joint is divided into, and the fewest samples of a part that is used.
N_BINS, MIN_BIN_SAMPLES = 12, 5
# Parts whose offset is known worse than this are left out [rad or m]: the joint hardly moves the measured
# point.
MAX_PROFILE_STD = 0.02


@frozen(eq=False)
class Outlier:
    """Sample whose residual is too large for its standard deviation."""

    item: int  #: Index of the measurement object in the fitted data, followed by the held-out data.
    row: int  #: Line in its file; for data from Python the number of the sample, from 1.
    error_norms: dict[str, float]  #: Error by group, "position" [m], "orientation" [rad] or "residual" [m].
    #: Studentized residual; standard normal for a sample that is not an outlier. NaN if it was held out.
    score: float


def find_outliers(fit: Result) -> list[Outlier]:
    """Return the outliers of a calibration, by measurement object and row."""
    all_errors = [
        e for data in (fit.data, fit.holdout) for e in compute_errors(fit.chain, data, fit.instruments)
    ]
    masks = (*fit.is_counted, *fit.is_holdout_counted)
    unknown = [np.full(len(item.rows), np.nan) for item in fit.holdout]
    all_scores, out = (*fit.studentized_residuals, *unknown), []
    for i, (item, errors) in enumerate(zip((*fit.data, *fit.holdout), all_errors, strict=True)):
        scores = all_scores[i]
        for k in np.flatnonzero(~masks[i]):
            norms = {error_group(name): float(np.linalg.norm(error[k])) for name, error in errors.items()}
            out.append(Outlier(i, int(item.rows[k]), norms, float(scores[k])))
    return out


def median_sigmas(fit: Result) -> list[dict[str, float]]:
    """Compute the median standard deviations that the fitted measurements were weighted with."""
    out = []
    for item, weights in zip(fit.problem.data, fit.weights, strict=True):
        frames = fit.chain.forward_kinematics(item.conditions())
        u = fit.problem.instrument_values_of(item, fit.x)
        whitened, errors = item.residual(frames, u), item.errors(frames, u)
        medians = {}
        for name, group in item.residual_groups.items():
            with np.errstate(divide="ignore", invalid="ignore"):
                # A robust loss enlarges the sigmas of single samples, which is not noise of the instrument.
                ratio = np.abs(errors[name].T / whitened[group.rows]) * np.sqrt(weights)
            finite = ratio[np.isfinite(ratio)]
            medians[name] = float(np.median(finite)) if finite.size else float("nan")
        out.append(medians)
    return out


@frozen(eq=False)
class JointProfile:
    """Residual joint error over the joint position."""

    name: str  #: Name of the joint.
    is_prismatic: bool  #: Whether it is prismatic.
    centres: Array  #: Centres of the b parts of the range that have enough samples, (b,) [rad or m].
    #: Offset of this joint alone that would explain the residuals of a part best, for the nominal robot, (b,)
    #: [rad or m].
    before: Array
    before_std: Array  #: Standard errors of `before`, (b,).
    after: Array  #: The same for the calibrated robot, (b,) [rad or m].
    after_std: Array  #: Standard errors of `after`, (b,).


def joint_offset_profiles(fit: Result) -> list[JointProfile]:
    """Compute the residual error of each moving joint over its position, of held-out or of fitted samples."""
    data = [item for item in fit.counted_holdout or fit.counted if item.configurations_per_row == 1]
    if not data or not fit.has_joint_values:
        return []
    after = _offset_equations(fit.chain, data, fit)
    before = _offset_equations(fit.nominal_refitted, data, fit)
    q = np.concatenate([item.q for item in data])
    values = q @ fit.chain.mimic_matrix.T + fit.chain.mimic_offset
    out = []
    for j, name in enumerate(fit.chain.moving_joints):
        edges = np.linspace(values[:, j].min(), values[:, j].max(), N_BINS + 1)
        part = np.clip(np.searchsorted(edges, values[:, j], side="right") - 1, 0, N_BINS - 1)
        parts = np.array([b for b in range(N_BINS) if np.sum(part == b) >= MIN_BIN_SAMPLES], int)
        # Rows before, before_std, after, after_std.
        rows = np.array(
            [row for ar, aa in (before, after) for row in _offsets_by_part(ar[j], aa[j], part, parts)]
        )
        is_known = (rows[1::2] < MAX_PROFILE_STD).all(0)
        centres = 0.5 * (edges[:-1] + edges[1:])[parts[is_known]]
        is_prismatic = bool(fit.chain.prismatic[j])
        out.append(JointProfile(name, is_prismatic, centres, *rows[:, is_known]))
    return out


def _offset_equations(chain: Chain, data: Sequence[Measurement], fit: Result) -> tuple[Array, Array]:
    """Return a·r and a·a of each moving joint and sample, (k, m) each."""
    data = [item.initialized(chain) for item in data]
    known = fit_instrument_parameters(chain, data, fit.instruments if chain is fit.chain else {})
    errors = ErrorModel(chain, tuple(offset(chain)))
    model = errors.derivative(np.zeros(len(errors.parameters)))
    ar, aa = [], []
    for item in data:
        u = instrument_values(item, known)
        frames = chain.forward_kinematics(item.conditions())
        residual = item.residual(frames, u)
        a = whitened_jacobian(item, model, frames, u, residual)
        ar.append(np.sum(a * residual, 1))
        aa.append(np.sum(a**2, 1))
    return np.concatenate(ar, 1), np.concatenate(aa, 1)


def _offsets_by_part(ar: Array, aa: Array, part: Array, parts: Array) -> tuple[Array, Array]:
    """Return the offset and its standard error for each of `parts`; `part` (m,) is that of each sample."""
    value, std = np.zeros(len(parts)), np.zeros(len(parts))
    for i, b in enumerate(parts):
        numerator, denominator = ar[part == b], aa[part == b]
        total = denominator.sum()
        value[i] = numerator.sum() / total if total > 0 else np.nan
        std[i] = np.sqrt(np.sum((numerator - value[i] * denominator) ** 2)) / total if total > 0 else np.nan
    return value, std
