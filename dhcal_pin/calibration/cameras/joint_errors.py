"""Joint errors of an arm in images: families that the displacements of the images support.

They are selected as for other measurements, see `model_selection`, but of the rows: all corners of an image
share the displacement of the arm that the model lacks (`jitter`). With the whitened derivative
A = U·diag(σ)·Vᵀ of its corners by the displacement in standard deviations, the components of its rows along a
column of U have the variance 1 + σ² before they are whitened by the displacement, and all others the variance
1 of the noise of the corners. A family of joint errors explains displacements: it scales their variance by
s², and that of the components to 1 + s²·σ². The share of the noise s in the variance is t = σ²/(1 + σ²), see
`estimation.folds`. An image thus counts as six rows however many corners it has.

What remains of the displacements is then estimated again. Families that raise the error of left-out clusters
of joint space are not added. If the gate keeps the nominal arm, it is judged again with the families: an arm
with elastic joints is demonstrably wrong where geometry and elasticity together explain the images up to the
noise of the corners. Families are tried even if corners that are displaced independently are the better model
of the geometry alone (`gate`). Images that only the geometry does not explain are no outliers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..._typing import Array
from ...estimation.folds import Fold, NoiseClass, NoisyFold, NoisyRows, count_rows, join_classes
from ...estimation.problem import Problem
from ...estimation.qr import TriangularSystem, merge_r_factors
from ...estimation.solver import minimize
from ...measurements.camera import CameraCorners
from ...robot.error_families import BACKLASH, COMPLIANCE, GAIN
from ..model_selection import (
    MIN_CONFIGURATIONS,
    Extension,
    prior_weights,
    select_families,
    with_selected,
)
from ..reweighting import Fit, reweight
from .gate import Gate, GatedFit, cluster_folds, open_fit, without_arm
from .stages import held_out_error

# Families that images show: displacements follow from gravity, from the direction of approach, and from the
# joint positions in proportion. Errors of the links and gains imitate periodic errors of the joints where
# images were taken.
FAMILIES = (COMPLIANCE, BACKLASH, GAIN)
# Smallest displacement σ of the rows that the noise of the corners does not hide, in standard deviations of
# the corners, and number of classes, each of twice the σ of the one before.
MIN_DISPLACEMENT, N_CLASSES = 0.5, 10


def add_joint_errors(
    gated: GatedFit, families: Sequence[str], max_iterations: int
) -> tuple[GatedFit, Extension]:
    """Add the families of joint errors that the displacements of images support."""
    gate, fit = gated.gate, gated.displaced
    extension = Extension(temperature=gate.temperature, n_configurations=gate.n_configurations)
    chosen = [name for name in families if name in FAMILIES]
    if not (fit and chosen) or gate.is_right or gate.n_configurations < MIN_CONFIGURATIONS:
        return gated, extension
    if not all(item.n_images and item.has_jitter for item in fit.problem.data):
        return gated, extension
    judged = fit.without_rejected()
    judged = replace(judged, problem=judged.problem.at_temperature(1.0))
    trials, model, random_ratio, selected = select_families(judged, chosen, factor_displacements)
    if not selected:
        return gated, replace(extension, trials=trials)
    start = replace(fit, problem=fit.problem.at_temperature(1.0))
    problem, x, family = with_selected(start, selected, model)
    problem = problem.with_prior_weights(prior_weights(problem, family, model.widths))
    solution = minimize(problem, "lm", x, max_iterations, loose=True)
    opened, temperature = open_fit(replace(fit, problem=problem, solution=solution), gate, max_iterations)
    folds = cluster_folds(fit.data)
    errors = [held_out_error(each, folds) for each in (gated.with_arm, opened)]
    before, after = (error.pixels if error else float("nan") for error in errors)
    if not gate.is_open:
        nominal = held_out_error(without_arm(opened, max_iterations), folds)
        ratio = after / nominal.pixels if nominal else float("nan")
        # The temperature is 1 if no displacement of the images is left.
        gate = replace(gate, ratio=ratio, is_complete=temperature == 1)
    if not gate.is_open or after > before:
        trials = tuple(replace(trial, is_selected=False) for trial in trials)
        return gated, replace(extension, trials=trials)
    opened, temperature = _with_explained(opened, temperature, gate, max_iterations)
    extension = Extension(
        trials,
        temperature,
        gate.n_configurations,
        random_ratio=random_ratio,
        region_ratio=after / before,
    )
    with_arm = gated.with_arm if gated.gate.is_open else opened
    gate = replace(gate, temperature=temperature)
    return replace(gated, fit=opened, with_arm=with_arm, gate=gate), extension


def _with_explained(opened: Fit, temperature: float, gate: Gate, max_iterations: int) -> tuple[Fit, float]:
    """Fit with the samples, too, that were outliers of the geometry and are none with the joint errors."""
    data = [item.with_weights(1 / w) for item, w in zip(opened.problem.data, opened.weights, strict=True)]
    judged = replace(opened, data=tuple(data), problem=opened.problem.at_temperature(1.0))
    weights = reweight(judged, (opened.stage,), (), max_iterations, None).weights
    if all(np.array_equal(new, old) for new, old in zip(weights, opened.weights, strict=True)):
        return opened, temperature
    return open_fit(opened.solved_with_weights(weights, max_iterations), gate, max_iterations)


def factor_displacements(
    problem: Problem, x: Array, folds: Sequence[Fold]
) -> tuple[NoisyRows, tuple[NoisyFold, ...]]:
    """Factor the rows of images that have a displacement each; the folds divide all images."""
    parts = [
        _split(problem.with_data([item.take(mask) for item, mask in zip(problem.data, fold, strict=True)]), x)
        for fold in folds
    ]
    whole = join_classes(parts)
    out = []
    for part in parts:
        held_out = NoisyRows(tuple(one for one in part.classes if one.share))
        fitted = join_classes([other for other in parts if other is not part])
        out.append(NoisyFold(fitted, held_out.at(1.0), held_out.n_scaled))
    return whole, tuple(out)


def _split(problem: Problem, x: Array) -> NoisyRows:
    """Divide the rows of images into classes of the share of their displacement."""
    linearization, n_columns = problem.linearize(x), len(x) + 1
    parts: list[list[Array]] = [[] for _ in range(N_CLASSES + 1)]
    for chunk in problem.chunks:
        images, rows = chunk.data, linearization.rows(chunk)
        assert isinstance(images, CameraCorners)
        for along, size in images.take_displacements(rows):
            numbers = np.floor(np.log2(np.fmax(size, 1e-9) / MIN_DISPLACEMENT)).astype(int) + 1
            numbers = np.clip(numbers, 0, N_CLASSES)
            for number in np.unique(numbers):
                parts[number].append(along[:, numbers == number].T)
        parts[0].append(rows.reshape(n_columns, -1).T)
    shares = [0.0, *(1 - 1 / (1 + (MIN_DISPLACEMENT * 2.0 ** (k + 0.5)) ** 2) for k in range(N_CLASSES))]
    counts = [sum(map(len, rows)) for rows in parts]
    # The rows of the corners keep their number when the displacements are taken out of them.
    counts[0] = count_rows(problem) - sum(counts[1:])
    systems = [TriangularSystem(merge_r_factors(rows or [np.zeros((1, n_columns))])) for rows in parts]
    return NoisyRows(tuple(map(NoiseClass, systems, counts, shares)))
