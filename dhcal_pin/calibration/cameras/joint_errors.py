"""Joint errors of an arm in images: families that the displacements of the images support.

They are selected as for other measurements, see `model_selection`. The rows are those of `displacement_rows`:
the displacements that images have besides the noise of their corners. Families are tried only if the gate
lets images change the arm. What remains of the displacements is then estimated again. Families that raise the
error of left-out clusters of joint space are not added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ...estimation.solver import minimize
from ...robot.error_families import BACKLASH, COMPLIANCE
from ..model_selection import (
    MIN_CONFIGURATIONS,
    Extension,
    prior_weights,
    select_families,
    with_selected,
)
from .displacement_rows import factor_displacements
from .gate import GatedFit, cluster_folds, open_fit
from .stages import held_out_error

# Families that images show: displacements follow from the direction of approach and from gravity. Periodic
# errors of the joints are imitated by errors of the links where images were taken.
FAMILIES = (COMPLIANCE, BACKLASH)


def add_joint_errors(
    gated: GatedFit, families: Sequence[str], max_iterations: int
) -> tuple[GatedFit, Extension]:
    """Add the families of joint errors that the displacements of images support."""
    gate, fit = gated.gate, gated.fit
    extension = Extension(temperature=gate.temperature, n_configurations=gate.n_configurations)
    chosen = [name for name in families if name in FAMILIES]
    has_displacements = all(item.n_images and item.has_jitter for item in fit.problem.data)
    if not (gate.is_open and chosen and has_displacements) or gate.n_configurations < MIN_CONFIGURATIONS:
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
    errors = [held_out_error(each, folds) for each in (fit, opened)]
    before, after = (error.pixels if error else float("nan") for error in errors)
    if after > before:
        trials = tuple(replace(trial, is_selected=False) for trial in trials)
        return gated, replace(extension, trials=trials)
    extension = Extension(
        trials,
        temperature,
        gate.n_configurations,
        random_ratio=random_ratio,
        region_ratio=after / before if before else float("nan"),
    )
    return replace(gated, fit=opened, gate=replace(gate, temperature=temperature)), extension
