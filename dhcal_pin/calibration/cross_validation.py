"""Cross-validation: errors of held-out samples under a fit of the other samples.

Folds are solved by one step from the solution, see `estimation.folds`.

Unknowns that only held-out samples depend on, such as a contact point, are fitted to the held-out samples.

`estimate_generalization` states two figures of a calibration: the error within the measured region, from
random folds, and the error beyond it, from folds that leave out regions of joint space. A figure cannot be
stated if the other samples of a fold do not determine the errors of the held-out ones: with the covariance
Σ = (R_fᵀR_f + W²)⁻¹ of the fold's fit, the held-out errors that uncertain parameters cause have the RMS
‖R_h·S‖/√m_h, S·Sᵀ = Σ. It must not exceed three times the noise, which has the RMS 1.

Shapes: p unknowns, c columns (unknowns that are free), m samples of a measurement, k folds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from .._frozen import frozen
from .._typing import Array, Progress
from ..estimation import robust
from ..estimation.bare_geometry import BareGeometry
from ..estimation.folds import Fold, Refit, factor_folds, solve_fold
from ..estimation.problem import Problem
from ..estimation.solver import complete, minimize
from ..exceptions import DhcalError, InvalidArgumentError, NotObservableError
from ..measurements.base import Measurement
from ..measurements.measured_region import MIN_SPREAD, MeasuredRegion, draw_joint_space
from .evaluation import (
    MIN_SAMPLES,
    Accuracy,
    Comparison,
    PairedErrors,
    Title,
    compute_errors,
    fit_nominal,
    take_errors,
)
from .fitted import FittedModel, take_samples
from .partition import (
    blocked_folds,
    configuration_groups,
    contact_groups,
)

# A fold does not determine the held-out errors if uncertain parameters contribute more to them than this, in
# standard deviations of the measurements.
MAX_PREDICTION_STD = 3.0
# Largest number of iterations of a fold's own fit.
MAX_REFIT_ITERATIONS = 100
# A joint hardly moved if its spread in some of the samples is below this fraction of its spread in all.
_MIN_SPREAD_RATIO = 0.1


@frozen(eq=False)
class FoldErrors:
    """Errors of the held-out samples of a fold."""

    # Errors of each measurement with held-out samples, as from `compute_errors`.
    errors: list[dict[str, Array]]
    errors_alone: list[dict[str, Array]]  # The same of the URDF alone; empty without joint errors
    rms: float  # RMS of the held-out rows in standard deviations
    prediction_std: float  # RMS of these rows that the uncertainty of the fold's fit causes


def cross_validate_folds(
    problem: Problem,
    x: Array,
    data: Sequence[Measurement],
    folds: Sequence[Fold],
    refit: Refit,
    shrinkage_factor: float = 1.0,
    bare: BareGeometry | None = None,
) -> Iterator[FoldErrors]:
    """Generate the errors of the held-out samples of each fold."""
    sizes = [len(item.rows) for item in data]
    if any([len(mask) for mask in fold] != sizes for fold in folds):
        raise InvalidArgumentError(
            f"folds were made for other data; expected masks of {', '.join(map(str, sizes))} samples"
        )
    columns, robot = problem.is_interior(x), len(problem.errors.parameters)
    for fold, systems in zip(folds, factor_folds(problem, x, folds), strict=True):
        solution = shrinkage_factor * solve_fold(problem, fold, systems, x, columns, refit)
        unobserved = {
            parameter.name
            for parameter, is_unobserved in zip(
                problem.instrument_parameters, systems.is_unobserved[robot:], strict=True
            )
            if is_unobserved
        }
        known = {name: v for name, v in problem.instruments(solution).items() if name not in unobserved}
        held_out = take_samples(data, fold)
        chain = problem.errors.at(solution[:robot])
        alone = bare.refitted(chain) if bare else None
        yield FoldErrors(
            compute_errors(chain, held_out, known),
            compute_errors(alone.chain, held_out, known) if alone else [],
            systems.error(problem.weights, x, columns),
            systems.prediction_std(problem.weights, columns),
        )


@frozen(eq=False)
class CrossValidation:
    """Errors of held-out samples."""

    #: Accuracy of the held-out samples of each fold, without outliers of the calibration.
    folds: tuple[Accuracy, ...]
    errors: Array  #: RMS of the held-out rows of each fold in standard deviations, (k,)
    #: The same of all folds together. A sample counts once for each fold that holds it out.
    accuracy: Accuracy


def refit(fit: FittedModel, problem: Problem, start: Array) -> Array:
    """Fit some of the samples by the method of a calibration, from an approximate solution (p,)."""
    # The values of undetermined parameters in x contain information of all samples: without priors, the fit
    # starts from the nominal robot. If the calibration did not converge, it stops after as many iterations.
    nominal = np.zeros_like(fit.x)
    if fit.converged and problem.weights.all():
        loose = minimize(problem, "lm", start, MAX_REFIT_ITERATIONS, loose=True)
        return complete(problem, loose, MAX_REFIT_ITERATIONS)[0]
    if not fit.converged:
        with suppress(DhcalError):  # method "gn" may diverge on few samples
            return minimize(problem, fit.method, nominal, min(fit.iterations, MAX_REFIT_ITERATIONS)).x
    return minimize(problem, "lm", nominal, MAX_REFIT_ITERATIONS).x


def cross_validate(fit: FittedModel, folds: Sequence[Fold] | None = None) -> CrossValidation:
    """Measure how well the model of a calibration predicts samples that it is not fitted to.

    Standard deviations, weights and priors are those of the calibration. As in all figures of a calibration,
    its outliers do not count.

    Args:
        fit: FittedModel of a calibration.
        folds: Folds of `fit.data` from `k_fold`, `leave_one_group_out` or `blocked_folds`. By default those
            of `blocked_folds`, which leave out regions of joint space; samples that touch the same thing
            are held out together.

    Returns:
        Errors of the held-out samples without outliers, and how many there are.

    Raises:
        InvalidArgumentError: The folds are no sequence.
    """
    if not isinstance(folds, Sequence | None):
        raise InvalidArgumentError(
            f"folds has type {type(folds).__name__}; expected folds such as k_fold(fit.data, 5)"
        )
    if folds is None:
        folds = blocked_folds(fit.data, groups=contact_groups(fit.problem, fit.x))
    results = list(cross_validate_folds(fit.problem, fit.solution.x, fit.data, folds, partial(refit, fit)))
    counted = [
        take_errors(result.errors, _counted_in(fold, fit.is_counted))
        for result, fold in zip(results, folds, strict=True)
    ]
    return CrossValidation(
        tuple(map(Accuracy.from_errors, counted)),
        np.array([fold.rms for fold in results]),
        Accuracy.from_errors([item for errors in counted for item in errors]),
    )


def _counted_in(fold: Fold, is_counted: Sequence[Array]) -> list[Array]:
    """Return whether each sample of a fold counts, of each measurement that the fold has samples of."""
    return [counted[mask] for counted, mask in zip(is_counted, fold, strict=True) if mask.any()]


# --- accuracy within and beyond the measured region ------------------------------------------------


@frozen(eq=False)
class FoldComparison:
    """Accuracy of the held-out samples of folds before and after a calibration."""

    comparison: Comparison
    # Largest RMS of the held-out rows of a fold that the uncertainty of its fit causes [σ].
    prediction_std: float
    paired: PairedErrors  # Squared errors of each held-out configuration before and after

    @property
    def is_determined(self) -> bool:
        """Whether the other samples of each fold determine the errors of the held-out ones."""
        return self.prediction_std <= MAX_PREDICTION_STD


def compare_folds(fit: FittedModel, folds: Sequence[Fold], title: Title) -> FoldComparison:
    """Compare the accuracy of held-out samples before and after a calibration."""
    # The nominal robot is judged in the same way: its frames are fitted to the other samples of each fold.
    data = fit.inliers
    nominal = replace(fit.errors, chain=fit.nominal_refitted)
    before: list[dict[str, Array]] = []
    for fold in folds:
        fitted, held_out = (take_samples(data, masks) for masks in ([~mask for mask in fold], fold))
        chain, instruments = fit_nominal(nominal, fitted, fit.problem.known, fit.nominal_instruments)
        before += compute_errors(chain, held_out, instruments)
    # The fits of the folds contain the outliers that the calibration contains, but no figure does.
    is_counted = _counted_in(tuple(w > robust.ZERO_WEIGHT for w in fit.weights), fit.is_counted)
    is_judged = [judged for fold in folds for judged in _counted_in(fold, is_counted)]
    found = list(
        cross_validate_folds(
            fit.inlier_problem,
            fit.solution.x,
            data,
            folds,
            partial(refit, fit),
            fit.shrinkage_factor,
            fit.bare,
        )
    )
    # Without a correction the calibrated robot is the nominal one.
    after = [item for fold in found for item in fold.errors] if fit.shrinkage_factor else before
    alone = [item for fold in found for item in fold.errors_alone]
    labels = configuration_groups(data)
    held_out_labels = np.concatenate([labels[np.concatenate(fold)] for fold in folds])
    before, after = (take_errors(errors, is_judged) for errors in (before, after))
    return FoldComparison(
        _comparison(fit, title, before, after, take_errors(alone, is_judged) if alone else []),
        max(fold.prediction_std for fold in found),
        PairedErrors.from_errors(before, after, held_out_labels[np.concatenate(is_judged)]),
    )


def leave_regions_out(
    fit: FittedModel,
    recalibrate: Callable[[list[Measurement]], FittedModel],
    progress: Progress | None,
) -> Comparison | None:
    """Judge a calibration by further complete ones, each without a region; None without regions."""
    try:
        folds = blocked_folds(fit.data, groups=contact_groups(fit.problem, fit.x))
    except NotObservableError:
        return None
    before: list[dict[str, Array]] = []
    after: list[dict[str, Array]] = []
    alone: list[dict[str, Array]] = []
    for number, fold in enumerate(folds, 1):
        if progress:
            progress("left-out regions", number, len(folds))
        part = recalibrate(take_samples(fit.data, [~mask for mask in fold]))
        is_judged = [mask & counted for mask, counted in zip(fold, fit.is_counted, strict=True)]
        held_out = take_samples(fit.data, is_judged)
        before += compute_errors(part.nominal_refitted, held_out, part.nominal_instruments)
        after += compute_errors(part.chain, held_out, part.instruments)
        if fit.bare:
            alone += compute_errors(part.urdf_alone, held_out, part.instruments)
    return _comparison(fit, "region hold-out", before, after, alone)


def _comparison(
    fit: FittedModel,
    title: Title,
    before: Sequence[Mapping[str, Array]],
    after: Sequence[Mapping[str, Array]],
    alone: Sequence[Mapping[str, Array]],
) -> Comparison:
    """Compare the errors of held-out samples before and after a calibration."""
    n_samples = sum(len(next(iter(item.values()))) for item in after)
    return Comparison(
        title,
        n_samples,
        Accuracy.from_errors(before),
        Accuracy.from_errors(after),
        fit.n_outliers,
        after_alone=Accuracy.from_errors(alone) if alone else None,
    )


@frozen(eq=False)
class Generalization:
    """Accuracy on configurations that are not fitted: within the measured region and beyond it.

    The shares are those of random configurations within the joint limits, see `measurements.measured_region`.
    """

    #: Accuracy within the measured region, from random folds of whole configurations; None if it cannot be
    #: stated.
    cross_validated: Comparison | None
    cross_validated_reason: str  #: Why it cannot be stated; empty if it can
    #: Accuracy beyond the measured region, from folds that leave out regions of joint space, or from
    #: `leave_regions_out` if it was called; None if it cannot be stated.
    region_holdout: Comparison | None
    region_holdout_reason: str  #: Why it cannot be stated; empty if it can
    covered_share: float | None  #: Share of the joint space in the measured region, 0 to 1
    #: Share of the joint space that is no farther from the measured configurations than the left-out regions
    #: are from the others, 0 to 1: there `region_holdout` holds. It is `covered_share` if that cannot be
    #: stated. Nothing is known about the rest. Both shares are None where joint values have no meaning, as
    #: the poses of the tip were measured in their place.
    reached_share: float | None


def estimate_generalization(
    fit: FittedModel,
    inside: FoldComparison | None,
    region: MeasuredRegion | None,
    region_comparison: Comparison | None,
    configurations: tuple[Array, Array],
    folds: tuple[Fold, ...],
) -> Generalization:
    """Estimate the accuracy within the measured region, from random folds, and beyond it."""
    q, samples = configurations
    has_few = 1 < len(q) < MIN_SAMPLES
    beyond = None
    inside_reason = "too few samples" if has_few else "all samples have the same joint values"
    beyond_reason = inside_reason if len(q) else "the samples have no joint values"
    if inside is not None and not has_few:
        inside_reason = "" if inside.is_determined else "too few samples"
    if folds and not has_few:
        beyond = compare_folds(fit, folds, "region hold-out")
        beyond_reason = _unknown_reason(fit, beyond, q, samples_held_out(folds, samples))
    covered = reached = 0.0 if fit.has_joint_values else None
    if region is not None:
        distances = region.distances(draw_joint_space(fit.chain))
        covered = float(np.mean(distances <= region.radius))
        reached = covered if beyond_reason else float(np.mean(distances <= region.reach))
    return Generalization(
        None if inside is None or inside_reason else inside.comparison,
        inside_reason,
        None if beyond is None or beyond_reason else region_comparison or beyond.comparison,
        beyond_reason,
        covered,
        reached,
    )


def region_folds(fit: FittedModel) -> tuple[Fold, ...]:
    """Return the folds of the inliers that leave out regions of joint space."""
    with suppress(NotObservableError):
        return blocked_folds(fit.inliers, groups=contact_groups(fit.inlier_problem, fit.x))
    return ()


def measured_region(
    fit: FittedModel, configurations: tuple[Array, Array], folds: tuple[Fold, ...]
) -> MeasuredRegion | None:
    """Describe the region of joint space of the inliers, of which folds leave out parts."""
    q, samples = configurations
    if not len(q) or not fit.has_joint_values:
        return None
    region = MeasuredRegion.from_configurations(q, fit.chain.is_prismatic)
    known = [item.recorded.payload for item in fit.inliers if item.recorded]
    if len(known) == len(fit.inliers) and (stated := [each for each in known if each is not None]):
        masses = np.concatenate(stated)
        region = replace(region, payloads=(float(masses.min()), float(masses.max())))
    return region.with_reach(q, samples_held_out(folds, samples)) if folds else region


def samples_held_out(folds: Sequence[Fold], samples: Array) -> Array:
    """Return whether each fold holds out each of some samples."""
    return np.stack([np.concatenate(fold)[samples] for fold in folds])


def _unknown_reason(fit: FittedModel, regions: FoldComparison, q: Array, is_held_out: Array) -> str:
    """Say why the error beyond the measured region cannot be stated."""

    def names(mask: Array) -> str:
        return ", ".join(np.array(fit.chain.joint_names)[mask].tolist())

    spread = q.std(0)
    if np.any(spread < MIN_SPREAD):
        return f"{names(spread < MIN_SPREAD)} did not move"
    if regions.is_determined:
        return ""
    others = np.min([q[~mask].std(0) for mask in is_held_out if not mask.all()], 0)
    is_small = others < _MIN_SPREAD_RATIO * spread
    if is_small.any():
        return f"{names(is_small)} hardly moved outside one of the left-out regions"
    return "too few samples outside one of the left-out regions"
