"""What a calibration leaves unexplained, by sample and by joint, and where it can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import se3
from .._typing import Array
from ..calibration.evaluation import compute_errors, error_group, instrument_values
from ..calibration.result import Result
from ..estimation.error_model import ErrorModel
from ..estimation.parameters import offset
from ..estimation.uncertainty import Predictor
from ..measurements.base import Measurement, whitened_jacobian
from ..robot.chain import Chain
from ..robot.sampling import joint_range

# Configurations that the workspace is judged by, and bins that a joint's range is parted into.
N_SAMPLES, N_BINS = 16000, 12


# A joint that hardly moves the measured point asks for nothing: its error is known worse than this, rad or m.
MAX_PROFILE_STD = 0.02


@dataclass(frozen=True, eq=False)
class Outlier:
    """A gross error: item of the fitted data, row in its file, size by group in m or rad, and score.

    The score is that of `robust.standardized_residuals`: standard normal for a good sample.
    """

    item: int
    row: int
    sizes: dict[str, float]
    score: float


def outliers(fit: Result) -> list[Outlier]:
    """The gross errors, by item and row."""
    found = compute_errors(fit.chain, fit.data, fit.instruments)
    out = []
    for i, (item, errors) in enumerate(zip(fit.data, found, strict=True)):
        score = fit.studentized_residuals[i]
        for place in np.flatnonzero(np.isin(item.rows, fit.outliers[i])):
            size = {error_group(name): float(np.linalg.norm(error[place])) for name, error in errors.items()}
            out.append(Outlier(i, int(item.rows[place]), size, float(score[place])))
    return out


def sigmas(fit: Result) -> list[dict[str, float]]:
    """Median standard deviation an axis, m or rad, by group of rows that each fitted item went in with."""
    out = []
    for item, weights in zip(fit.problem.data, fit.weights, strict=True):
        frames, u = (
            fit.chain.forward_kinematics(item.configurations()),
            fit.problem.instrument_values_of(item, fit.x),
        )
        whitened, errors = item.residual(frames, u), item.errors(frames, u)
        found = {}
        for name, rows in item.residual_groups.items():
            with np.errstate(divide="ignore", invalid="ignore"):
                # A robust loss widens the sigmas of single samples; that is no noise of the instrument.
                ratio = np.abs(errors[name].T / whitened[rows]) * np.sqrt(weights)
            good = ratio[np.isfinite(ratio)]
            found[name] = float(np.median(good)) if good.size else float("nan")
        out.append(found)
    return out


# --- by joint --------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class JointProfile:
    """What the readings ask of one joint in each part of its range.

    Attributes:
        name: of the joint.
        is_prismatic: whether it is prismatic.
        values: (m,) joint values of the samples, rad or m.
        sizes: (m,) errors of the samples after the calibration, m, or rad where only rotations are measured.
        centres: (b,) middles of the parts with samples.
        before, after: (b,) error of this joint alone, rad or m, that would explain the part's readings best.
        before_std, after_std: (b,) their standard errors.
    """

    name: str
    is_prismatic: bool
    values: Array
    sizes: Array
    centres: Array
    before: Array
    before_std: Array
    after: Array
    after_std: Array


def joint_offset_profiles(fit: Result) -> list[JointProfile]:
    """Each moving joint's trace over the samples held out, or over the fitted where none are.

    Least squares over the joint's own offset in each part of its range, whatever was measured: a wave
    over the range is an error that the joint has and the model lacks. Empty where no reading belongs to
    one configuration.
    """
    data = [item for item in fit.holdout or fit.inliers if item.configurations_per_row == 1]
    if not data:
        return []
    found = compute_errors(fit.chain, data, fit.instruments)
    after, before = (
        _joint_offset_terms(fit.chain, data, fit),
        _joint_offset_terms(fit.nominal_refitted, data, fit),
    )
    q = np.concatenate([item.q for item in data])
    values = q @ fit.chain.mimic_matrix.T + fit.chain.mimic_offset
    sizes = np.concatenate([np.linalg.norm(next(iter(errors.values())), axis=1) for errors in found])
    out = []
    for j, name in enumerate(fit.chain.moving_joints):
        edges = np.linspace(values[:, j].min(), values[:, j].max(), N_BINS + 1)
        part = np.clip(np.searchsorted(edges, values[:, j], side="right") - 1, 0, N_BINS - 1)
        full = np.array([b for b in range(N_BINS) if np.sum(part == b) >= 5], int)
        rows = np.array(
            [row for pull, weight in (before, after) for row in _slope(pull[j], weight[j], part, full)]
        )
        told = (rows[1::2] < MAX_PROFILE_STD).all(0)
        centres = 0.5 * (edges[:-1] + edges[1:])[full[told]]
        slides = bool(fit.chain.prismatic[j])
        out.append(JointProfile(name, slides, values[:, j], sizes, centres, *rows[:, told]))
    return out


def _joint_offset_terms(chain: Chain, data: Sequence[Measurement], fit: Result) -> tuple[Array, Array]:
    """By moving joint and sample (k, m): derivative·residual and derivative·derivative, both whitened."""
    data = [item.initialized(chain) for item in data]
    values = instrument_values(chain, data, fit.instruments if chain is fit.chain else {})
    errors = ErrorModel(chain, tuple(offset(chain)))
    _, bodies, twists = errors.derivative(np.zeros(len(errors.parameters)))
    pulls, weights = [], []
    for item in data:
        u = np.array([values[unknown.name] for unknown in item.instrument_parameters])
        frames = chain.forward_kinematics(item.configurations())
        residual = item.residual(frames, u)
        rows = whitened_jacobian(item, frames, chain.tool_jacobian(frames, bodies, twists), u, residual)
        pulls.append(np.sum(rows * residual, 1))
        weights.append(np.sum(rows**2, 1))
    return np.concatenate(pulls, 1), np.concatenate(weights, 1)


def _slope(pull: Array, weight: Array, part: Array, kept: Array) -> tuple[Array, Array]:
    """Σpull / Σweight of each part, and its standard error from the scatter within the part."""
    value, std = np.zeros(len(kept)), np.zeros(len(kept))
    for i, b in enumerate(kept):
        a, w = pull[part == b], weight[part == b]
        value[i] = a.sum() / w.sum() if w.sum() > 0 else np.nan
        std[i] = np.sqrt(np.sum((a - value[i] * w) ** 2)) / w.sum() if w.sum() > 0 else np.nan
    return value, std


# --- over the workspace ----------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Workspace:
    """Predicted accuracy over the workspace.

    Attributes:
        points: (s, 3) tool points in the base frame, m, of configurations all over the joints' ranges.
        std: (s,) predicted standard deviation of the position there, m; infinite where nothing tells.
        measured: (m, 3) tool points of measured samples in the base frame, m.
        measured_std: (m,) predicted there.
    """

    points: Array
    std: Array
    measured: Array
    measured_std: Array


def workspace(model: Predictor, data: Sequence[Measurement]) -> Workspace:
    """Predicted accuracy at configurations drawn over the joints' ranges, and at measured samples."""
    every = np.random.default_rng(0).uniform(*joint_range(model.chain), (N_SAMPLES, model.chain.n_joints))
    used = [item.configurations() for item in data if item.configurations_per_row > 0]
    there = np.concatenate(used) if used else np.empty((0, model.chain.n_joints))
    into = se3.inverse(model.chain.base)

    def judged(q: Array) -> tuple[Array, Array]:
        if not len(q):
            return np.empty((0, 3)), np.empty(0)
        found = [model.predict(part) for part in np.array_split(q, -(-len(q) // 2000))]
        points = np.concatenate([p.poses[:, :3, 3] for p in found])
        return points @ into[:3, :3].T + into[:3, 3], np.concatenate([p.position_std for p in found])

    return Workspace(*judged(every), *judged(there))
