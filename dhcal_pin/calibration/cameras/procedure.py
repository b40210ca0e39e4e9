"""Calibration from images: cameras, boards and lenses first, then the arm where left-out images demand it.

After the first fit these stages follow:

1. Widths of the priors of lenses and noise of the corners (`lens_priors`, `reweighting`).
2. Corners of boards as unknowns, where they improve left-out images (`target_points`).
3. The gate decides how far the arm is corrected (`gate`).
4. Errors of gear ratios, elasticity and backlash are added if the displacements of the images support them
   (`joint_errors`).
5. A wrong size of the boards, or the cause of a large error of a hand-eye calibration, is looked for
   (`board_size`, `diagnosis`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..._frozen import frozen
from ..._typing import Progress
from ...estimation.priors import PriorGroups
from ...estimation.robust import KEPT
from ...exceptions import ConvergenceError, InvalidArgumentError, NotObservableError
from ...formatting import join_names
from ...measurements.base import Measurement
from ...measurements.camera import change_images, select_images
from ...robot.chain import Chain
from ..result import Result, make_result
from ..reweighting import Fit, reweight
from .arm_types import CORNERS, IMAGES, ArmType
from .board_size import BoardSize, find_board_size
from .diagnosis import HandEyeFit
from .gate import GatedFit, apply_gate, judge_stages, judge_target_points, residual_jitter, without_arm
from .image_checks import find_unrelated_images, find_wrong_joint_values, seen_ranges_warning
from .jitter import with_jitter
from .joint_errors import FAMILIES, add_joint_errors
from .lens_priors import lens_prior_groups, with_lens_priors
from .mistakes import RigMistakes, stated_poses
from .sets import DEFAULT_SETS, has_images
from .stages import fitted_error


def require_shown_families(extend: str | Sequence[str] | None, families: Sequence[str]) -> None:
    """Raise an error if families of joint errors shall be selected that images do not show."""
    others = [name for name in families if name not in FAMILIES]
    if others and extend not in (None, "auto"):
        raise InvalidArgumentError(
            f"extend {others[0]!r}: only {join_names(FAMILIES)} are selected from images; name other "
            f"families among the parameters, as in {DEFAULT_SETS.replace('offset', f'offset,{others[0]}', 1)}"
        )


def with_common_start(chain: Chain, data: tuple[Measurement, ...]) -> tuple[Measurement, ...]:
    """Return images of several files with first values from all of them, if one file alone has too few."""
    images = select_images(data)
    names = {tuple(p.name for p in item.instrument_parameters) for item in images}
    if len(images) < 2 or len(names) > 1:
        return data
    try:
        for item in images:
            item.initialized(chain)
    except NotObservableError:
        columns = {n: np.concatenate([getattr(item, n) for item in images]) for n in images[0].sample_fields}
        joined = images[0].replace(**columns, recorded=None).initialized(chain)
        start = {p.name: p.nominal for p in joined.instrument_parameters}
        return change_images(data, lambda item: item.with_values(start))
    return data


@frozen
class ImageFitting:
    """Settings of the fits of images."""

    groups: PriorGroups  # Groups of priors of the robot, whose widths are estimated
    stages: tuple[str, ...]  # Stages of the robust loss
    max_iterations: int  # Largest number of iterations of one solution
    progress: Progress | None  # Function that is called with the progress, if any
    arm_type: ArmType  # Limits by which the images are judged

    def reweight(self, fit: Fit) -> Fit:
        """Estimate noise, weights and widths of priors, those of lenses included."""
        groups = (*self.groups, *lens_prior_groups(fit.problem))
        fit = reweight(fit, self.stages, groups, self.max_iterations, self.progress)
        images = [(item, w) for item, w in zip(fit.data, fit.weights, strict=True) if has_images([item])]
        if not any((weights > 0.5).any() for _, weights in images):
            raise InvalidArgumentError(
                f"{images[0][0].source or 'images'}: no image agrees with the other measurements; expected "
                "joint values and a rig of the same arm, and base and tool among the parameters if another "
                "instrument measures in a frame of its own"
            )
        return fit


def _reweight(fitting: ImageFitting, fit: Fit) -> tuple[ImageFitting, Fit]:
    """Reweight a fit of independent corners."""
    return fitting, fitting.reweight(fit)


def _reweight_displaced(fitting: ImageFitting, fit: Fit) -> tuple[ImageFitting, Fit]:
    """Reweight with the outliers among images that have a displacement each, and keep these outliers."""
    data = with_jitter(fit.problem, fit.solution.x, fit.data, residual_jitter(fit))
    displaced = replace(fit.solved_with(data, 0), data=data, start=fit.solution.x)
    kept = replace(fit, weights=fitting.reweight(displaced).weights)
    fitting = replace(fitting, stages=(KEPT,))
    return fitting, fitting.reweight(kept)


# First estimate of noise, weights and widths, by the model of errors of images with which outliers are found.
_FIRST_REWEIGHT = {CORNERS: _reweight, IMAGES: _reweight_displaced}


def calibrate_images(
    fitting: ImageFitting,
    fit: Fit,
    chain: Chain,
    holdout: tuple[Measurement, ...],
    mistakes: RigMistakes,
    families: Sequence[str],
) -> Result:
    """Calibrate from images, starting from a first fit."""
    max_error = fitting.arm_type.max_error
    is_far = fitted_error(fit).pixels > max_error
    is_stuck = is_far and not (fit.solution.converged or fit.solution.iterations)
    unrelated = find_unrelated_images(fit, holdout, chain, max_error)
    has_arm = fit.problem.errors.has_arm
    if has_arm and is_far and not unrelated:
        # Further fits of an arm with wrong joint values take many iterations.
        unrelated = find_wrong_joint_values(fit)
    if is_stuck and not unrelated and stated_poses(select_images(fit.data)):
        raise ConvergenceError(
            "images: no step from the first values brings the model nearer to the corners; check the poses "
            "in the rig file (xyz_m, rotvec_rad), or omit those of the cameras or those of the boards, and "
            "check the joint values, or the servo file of the counts"
        )
    if not unrelated:
        fitting, fit = _FIRST_REWEIGHT[fitting.arm_type.noise_models[0]](fitting, fit)
        unrelated = find_unrelated_images(fit, holdout, chain, max_error)
    if unrelated:
        frames = without_arm(fit, fitting.max_iterations) if has_arm else fit
        result = replace(make_result(frames, 1.0, holdout, "lm"), arm_type=fitting.arm_type)
        return replace(result, hand_eye_fit=HandEyeFit(frames, np.inf, holdout, unrelated, has_arm))
    points = judge_target_points(fit, fitting.max_iterations)
    if points is not None and points.is_kept:
        fit = fitting.reweight(points.fit)
    ungated = with_lens_priors(fit)
    gated = apply_gate(ungated, fitting.groups, fitting.max_iterations, fitting.arm_type)
    gated, extension = add_joint_errors(gated, families, fitting.max_iterations)
    stages = judge_stages(ungated, gated, points, fitting.max_iterations)
    gate = gated.gate
    warnings = mistakes.sentences
    if has_arm:
        warning = seen_ranges_warning(chain, gated.fit.data) if gate.is_open else gate.sentence
        warnings += [warning] if warning else []
    result = replace(
        make_result(gated.fit, 1.0, holdout, "lm"),
        extension=extension,
        input_warnings=tuple(warnings),
        camera_stages=(*mistakes.stages, *stages),
        arm_type=fitting.arm_type,
    )
    if gate.is_open and fitted_error(gated.fit).pixels < max_error:
        return replace(result, board_size=_judge_board_size(gated, families, fitting.max_iterations))
    frames = gated.nominal if has_arm else ungated
    unrelated = find_unrelated_images(frames, holdout, chain, max_error)
    return replace(result, hand_eye_fit=HandEyeFit(frames, result.pose_std, holdout, unrelated, has_arm))


def _judge_board_size(gated: GatedFit, families: Sequence[str], max_iterations: int) -> BoardSize | None:
    """Look for another size of the boards that no supported joint errors explain, selected or not."""
    found = find_board_size(gated.fit)
    if found is None or set(FAMILIES) <= set(families):
        return found
    return find_board_size(add_joint_errors(gated, FAMILIES, max_iterations)[0].fit)
