"""Evidence of a calibration: its accuracy on samples that were not fitted, and signs of mistakes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .. import plausibility, se3
from .._frozen import frozen
from .._typing import Array, Progress
from ..estimation.contacts import contact_bias
from ..estimation.folds import Fold
from ..estimation.frame_gauge import best_frames_std
from ..estimation.problem import CHUNK_SIZE
from ..estimation.qr import TriangularSystem, rank
from ..estimation.uncertainty import Uncertainty
from ..measurements.base import Measurement, residual_of
from ..measurements.groups import error_group
from ..measurements.measured_region import MeasuredRegion
from ..plausibility.deviating_lines import DeviatingLines, extend, find_deviating_lines, find_mistake
from ..plausibility.diagnosis import Diagnosis
from ..plausibility.drawn_samples import has_enough_rows
from ..plausibility.evidence import usual_errors
from ..plausibility.labels import WrongLabel, find_wrong_labels
from ..plausibility.mixups import diagnose_images, diagnose_mixups
from ..plausibility.mounting import Mounting, find_mounting
from ..plausibility.rounding import find_rounding
from ..session import Session
from ..session.linear_model import measures_positions
from ..session.search import can_have_session
from . import cameras
from .cameras.arm_types import INDUSTRIAL, ArmType
from .cross_validation import (
    FoldComparison,
    Generalization,
    compare_folds,
    estimate_generalization,
    measured_region,
    region_folds,
)
from .evaluation import (
    Accuracy,
    Comparison,
    PairedErrors,
    accuracy,
    compute_errors,
    error_norms,
    find_inliers,
    take_errors,
)
from .fitted import FittedModel, take_samples
from .good_samples import find_hidden_majority, independent_rows
from .partition import configuration_groups, count_held_out, is_same_file, k_fold, of_same_files, path_folds

if TYPE_CHECKING:
    from ..session.check import Recheck

# Largest number of hold-out samples with which is checked what changed before them.
MAX_CHECKED = 60
# Number of random folds of the cross-validation.
N_FOLDS = 5
# So few configurations are held out one by one instead.
MAX_LEAVE_ONE_OUT = 10
# Configurations of the measured region at which errors are predicted.
N_PREDICTED = 300
# Distance of other points of the tool from the measured one [m], a usual size of tools.
BESIDE = 0.1
# Of more configurations, each counts as one sample.
MAX_EXAMINED = 1000
# Held-out samples beside deviating lines belong to them if their errors exceed the largest one of the fitted
# samples by this factor.
MIN_FAR_RATIO = 2.0
# Reduced chi-square of hold-out samples that the model does not explain, and the largest probability of it.
MIN_UNEXPLAINED, MAX_UNEXPLAINED_CHANCE = 1.25, 1e-3


def _is_geometric(fit: FittedModel) -> Array:
    """Return which unknowns (p,) are no joint errors."""
    return np.array([getattr(p, "coefficient_index", None) is None for p in fit.parameters], bool)


def count_geometric_directions(fit: FittedModel, r: Array) -> int:
    """Count the directions of the geometry that an R factor of its parameters determines; at least 1."""
    return max(rank(r[:, _is_geometric(fit)]), 1)


def _rows_of_visits(data: Sequence[Measurement], groups: Array) -> int:
    """Count the rows of one visit of each configuration: an error that all visits share does not show."""
    total, first = 0, 0
    for item in data:
        labels, first = groups[first : first + len(item.rows)], first + len(item.rows)
        _, group, counts = np.unique(labels, return_inverse=True, return_counts=True)
        n_visits = np.ones(len(counts))
        if item.configurations_per_row:
            # Several targets are measured at equal joint values; visits by hand guiding differ a little.
            q = np.concatenate(np.split(item.configurations(), item.configurations_per_row), axis=1)
            n_visits = np.bincount(np.unique(np.column_stack([group, q]), axis=0)[:, 0].astype(int))
        total += item.residual_dim * int(np.sum(np.ceil(counts / n_visits)))
    return total


@frozen(eq=False)
class Evidence(FittedModel):
    """Fitted model with what the measurements say of its accuracy."""

    #: Accuracy on regions of joint space that were left out of further calibrations; None if there were none,
    #: see `leave_regions_out`.
    region_comparison: Comparison | None = None
    input_warnings: tuple[str, ...] = ()  #: Warnings about the files of the measurements
    #: Unknowns of a calibration from images that were freed in turn, and what each group of them improved;
    #: empty without images.
    camera_stages: tuple[cameras.Stage, ...] = ()
    #: Fit of cameras and boards on the nominal arm; None if the calibrated arm fits the images, and without
    #: images.
    hand_eye_fit: cameras.HandEyeFit | None = None
    #: Other size of the boards that makes the correction of the arm far smaller, if any.
    board_size: cameras.BoardSize | None = None
    is_kept_nominal: bool = False  #: Whether the correction was not applied because of the verdict
    #: Mistakes that were looked for in the same measurements with the same nominal robot, if they were.
    earlier_diagnosis: Diagnosis | None = None
    session: Session | None = None  #: What happened during the measurement; None if this was not examined
    #: Function that calibrates with the loss "auto", whose verdict counts, too; None if this calibration did.
    with_auto: Callable[[], Evidence] | None = None
    #: Function that calibrates with all parameters of the arm, base and tool; None if this calibration did,
    #: or if a smaller choice was deliberate.
    with_full_set: Callable[[], Evidence] | None = None
    #: Function that calibrates as a hand-built arm; None if this calibration did, or with chosen parameters.
    with_low_cost: Callable[[], Evidence] | None = None
    #: Function that calibrates some of the samples of `data` by the same options, with what is known of all:
    #: changes during the session, signs of the joints and mistakes in the measurements.
    with_part: Callable[[Sequence[Measurement]], Evidence] | None = None
    has_default_sets: bool = False  #: Whether the parameter sets are the default ones of the robot
    #: Joints that turn the other way than in the URDF, and signs that are open; None if the signs are those
    #: of the URDF.
    signs: plausibility.SignDecision | None = None
    arm_type: ArmType = INDUSTRIAL  #: Limits by which images are judged

    @cached_property
    def rows_per_direction(self) -> float:
        """Number of independent rows for each direction that the geometry determines.

        Repeated rows of one configuration show the noise, but no outlier that they share. Joint errors that
        were added to the geometry do not count: outliers were found before.
        """
        problem, groups = self.problem, configuration_groups(self.data)
        directions = count_geometric_directions(self, self.solution.system.r)
        n_groups = len(np.unique(groups))
        if n_groups == len(groups):
            return sum(item.residual_dim * len(item.rows) for item in self.data) / directions
        if n_groups > MAX_EXAMINED:
            return n_groups * min(item.residual_dim for item in self.data) / directions
        is_geometric = _is_geometric(self)
        system = TriangularSystem(self.solution.system.rows).select(is_geometric)
        root = system.sqrt_covariance(problem.weights[is_geometric])[0]
        linearization, chunks = problem.linearize(self.solution.x), iter(problem.chunks)
        columns = []
        for item in self.data:
            parts = [
                np.tensordot(root, linearization.rows(next(chunks))[:-1][is_geometric], (0, 0))
                for _ in range(0, len(item.rows), CHUNK_SIZE)
            ]
            columns.append(np.concatenate([np.empty((root.shape[1], item.residual_dim, 0)), *parts], 2))
        return min(independent_rows(columns, groups), _rows_of_visits(self.data, groups)) / directions

    @cached_property
    def hidden_majority(self) -> tuple[int, float] | None:
        """Number of samples that a majority does not agree with, and by what ratio; None without one."""
        return find_hidden_majority(self.inlier_problem, self.solution.x, configuration_groups(self.inliers))

    @cached_property
    def deviating_lines(self) -> DeviatingLines | None:
        """Consecutive lines of a file that do not agree with the fit of the others; None without them."""
        if self.session is None or not self.session.is_ordered:
            return None
        found = []
        for item, is_counted in zip(self.data, self.is_counted, strict=True):
            # Samples of one configuration are often wrong together.
            _, first = np.unique(configuration_groups([item]), return_index=True)
            order = np.sort(first)
            order = order[np.argsort(item.rows[order], kind="stable")]
            lines = find_deviating_lines(
                item.take(order), ~is_counted[order], self.n_outliers / self.n_samples, self.n_samples
            )
            found += [(_with_all_samples(lines, item, is_counted), item)] if lines else []
        if not found:
            return None
        lines, item = max(found, key=lambda each: each[0].n_outliers)
        for held_out, is_far in zip(self.holdout, self._is_holdout_far, strict=True):
            if is_same_file(item, held_out):
                lines = extend(lines, item, held_out, is_far)
        return lines

    @cached_property
    def _is_holdout_far(self) -> tuple[Array, ...]:
        """Whether each held-out sample is farther from the model than all that were fitted, by a factor."""
        errors = compute_errors(self.chain, self.counted, self.instruments)
        largest = {group: norms.max() for group, norms in error_norms(errors).items()}
        held_out = compute_errors(self.chain, self.holdout, self.instruments)
        norms = [np.linalg.norm(next(iter(each.values())), axis=1) for each in held_out]
        groups = [error_group(next(iter(each))) for each in held_out]
        return tuple(
            each > MIN_FAR_RATIO * largest.get(group, np.inf)
            for each, group in zip(norms, groups, strict=True)
        )

    @cached_property
    def is_holdout_judged(self) -> tuple[Array, ...]:
        """Whether each held-out sample is outside the deviating lines of its file, or agrees with the fit."""
        everything = tuple(np.ones(len(item.rows), bool) for item in self.holdout)
        if (lines := self.deviating_lines) is None:
            return everything
        fitted = [item for item in self.data if item.source == lines.source]
        masks = tuple(
            ~(lines.contains(item) & is_far) if of_same_files([item], fitted) else mask
            for item, is_far, mask in zip(self.holdout, self._is_holdout_far, everything, strict=True)
        )
        # Figures need samples.
        return masks if any(mask.any() for mask in masks) else everything

    @cached_property
    def is_holdout_counted(self) -> tuple[Array, ...]:
        """Whether figures of the accuracy contain each held-out sample, shape (m,) per measurement.

        They contain all but outliers, which are far from most other samples of their measurement, and samples
        of consecutive lines that do not agree with the others, see `deviating_lines`.
        """
        out = []
        errors = compute_errors(self.chain, self.holdout, self.instruments)
        for each, is_judged in zip(errors, self.is_holdout_judged, strict=True):
            is_counted = is_judged.copy()
            if is_judged.any():
                is_counted[is_judged] = find_inliers(take_errors([each], [is_judged]))[0]
            out.append(is_counted)
        return tuple(out)

    @cached_property
    def deviating_mistake(self) -> Diagnosis | None:
        """Mistake in the deviating lines that the fit of the others confirms; None without one."""
        if (lines := self.deviating_lines) is None:
            return None
        fitted = [item for item in self.data if item.source == lines.source]
        held_out = of_same_files(self.holdout, fitted)
        found = find_mistake(
            self.errors.chain,
            (self.chain, self.instruments),
            lines,
            [*fitted, *held_out],
            self.counted,
            _usual_errors(self),
        )
        return _with_servos(self, found) if found else None

    @cached_property
    def wrong_labels(self) -> tuple[WrongLabel, ...]:
        """Outliers that fit another touched point, target or camera than they state."""
        return tuple(
            found
            for item, is_counted in zip(self.data, self.is_counted, strict=True)
            for found in find_wrong_labels(item, is_counted, self.chain, self.instruments)
        )

    @property
    def shrinkage_notes(self) -> list[str]:
        """One sentence if the correction was not applied in full, else empty."""
        if self.is_kept_nominal:
            return ["Not significantly better than the nominal robot: no correction applied."]
        if self.shrinkage_factor == 1:
            return []
        applied = f"only {100 * self.shrinkage_factor:.0f} % of the" if self.shrinkage_factor else "no"
        return [f"Too few measurements: {applied} correction applied."]

    @cached_property
    def rounding_notes(self) -> list[str]:
        """One note for each measurement whose errors are those of joint values with too few digits."""
        instruments, notes = self.problem.instruments(self.x), []
        for item, mask in zip(self.data, self.is_counted, strict=True):
            found = find_rounding(item.take(mask), self.chain, instruments, self._rows_per_freedom)
            if found:
                notes.append(f"{item.source}: {found.sentence}" if len(self.data) > 1 else found.sentence)
        return notes

    @cached_property
    def mounting(self) -> Mounting | None:
        """Direction of gravity that fits better than that of the URDF; None without one."""
        if not self.errors.has_arm or cameras.has_images(self.data):
            return None
        items = zip(self.problem.data, self.is_counted, strict=True)
        return find_mounting(self.problem, self.x, [item.take(mask) for item, mask in items if mask.any()])

    @property
    def hand_eye(self) -> cameras.HandEyeDiagnosis | None:
        """Error of cameras and boards on the nominal arm and its likely cause.

        None if the calibrated arm fits the images, without images, and with fewer than five configurations.
        """
        return self.hand_eye_fit.diagnosis if self.hand_eye_fit else None

    @cached_property
    def hand_eye_std(self) -> float | None:
        """Largest standard deviation of the position of a camera or a board relative to the arm [m].

        It is that along the worst direction, relative to the tool. Errors of the arm that no image shows,
        such as that of the length of the last link, are not contained. If the tool frame is estimated, too,
        it is that of what stands still, in the frame of the measurements beside the images. None without
        images, if the arm is kept, whose errors displace the camera by more, if no position is estimated,
        and if nothing determines that frame.
        """
        tool_frame = self.errors.chain.tool_frame_index
        has_tool = any(p.error_frame == tool_frame for p in self.errors.parameters)
        if self.rig is None or not self.errors.has_arm:
            return None
        names = [p.name for p in self.parameters]
        if has_tool:
            is_determined = positions_beside_images(self.data)
            return cameras.largest_fixed_std(self.rig, names, self.covariance) if is_determined else None
        count = len(self.errors.parameters)
        priors = Uncertainty.from_errors(
            self.errors, self.x[:count], self.chain, np.diag(self.prior_std[:count]), np.empty((count, 0))
        )
        return cameras.largest_tool_std(self.rig, names, self.covariance, priors)

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """Mistakes in the measurements that explain them better than the measurements as they were read."""
        return diagnose(self, None)

    @cached_property
    def comparisons(self) -> tuple[Comparison, ...]:
        """Accuracy before and after: of hold-out or cross-validated samples, then of the fitted ones.

        Regions that were left out, if any, come before the cross-validated samples. Without hold-out samples,
        five-fold cross-validation judges each sample by a fit without it; up to ten configurations are held
        out one by one. Outliers are in none of these, see `is_counted`.
        """
        counted, (nominal, instruments) = self.counted, self._nominal
        before = accuracy(nominal, counted, instruments)
        after = accuracy(self.chain, counted, self.instruments)
        alone = accuracy(self.urdf_alone, counted, self.instruments) if self.bare else None
        n_counted = self.n_samples - self.n_outliers
        fitted = Comparison("fitted", n_counted, before, after, self.n_outliers, after_alone=alone)
        found = [self._compare_holdout()] if self.holdout else []
        if self.region_comparison and self.generalization.region_holdout:
            found.append(self.region_comparison)
        # So few samples that no correction is possible cannot judge one either.
        is_judged = bool(self.shrinkage_factor) or self.is_kept_nominal
        if self.random_folds and not self.holdout and is_judged:
            found.append(self.random_folds.comparison)
        return (*found, fitted)

    @cached_property
    def file_comparisons(self) -> tuple[Comparison, ...]:
        """Accuracy before and after of the fitted samples of each measurement; those of a file share it."""
        nominal, instruments = self._nominal
        sides = [
            compute_errors(nominal, self.data, instruments),
            compute_errors(self.chain, self.data, self.instruments),
        ]
        out = []
        for *errors, mask in zip(*sides, self.is_counted, strict=True):
            before, after = (Accuracy.from_errors(take_errors([each], [mask])) for each in errors)
            out.append(Comparison("fitted", int(mask.sum()), before, after, int(np.sum(~mask))))
        return tuple(out)

    @cached_property
    def random_folds(self) -> FoldComparison | None:
        """Accuracy of samples that are held out in random folds; None with a single configuration."""
        inliers = self.inliers
        n_configurations = count_held_out(inliers)
        if n_configurations < 2:
            return None
        n_folds = N_FOLDS if n_configurations > MAX_LEAVE_ONE_OUT else n_configurations
        is_correlated = self.problem.temperature > 1
        folds = (path_folds(inliers, n_folds) if is_correlated else None) or k_fold(inliers, n_folds)
        return compare_folds(self, folds, "cross-validated")

    @cached_property
    def held_out_errors(self) -> PairedErrors | None:
        """Squared errors of held-out or cross-validated configurations; None with a single configuration.

        Configurations that are outliers before and after the calibration are wrong measurements. They are
        left out.
        """
        if not self.holdout:
            return self.random_folds.paired if self.random_folds else None
        nominal, instruments = self._nominal
        judged = take_samples(self.holdout, self.is_holdout_judged)
        before = compute_errors(nominal, judged, instruments)
        after = compute_errors(self.chain, judged, self.instruments)
        return PairedErrors.from_errors(before, after, configuration_groups(judged)).without_outliers()

    @cached_property
    def noise_factors(self) -> dict[tuple[str, bool, str], float]:
        """Noise over standard deviations, by kind, whether these are stated, and residual group."""
        freedom = self.degrees_of_freedom
        if not freedom:
            return {}
        per_freedom = sum(count for _, _, count in self._row_counts) / freedom
        squares = _mean_squares(self, self.counted)
        return {key: float(np.sqrt(per_freedom * square)) for key, square in squares.items()}

    @property
    def stated_noise_factors(self) -> dict[str, float]:
        """Noise over stated standard deviations, by residual group."""
        return {name: ratio for (_, is_stated, name), ratio in self.noise_factors.items() if is_stated}

    @cached_property
    def holdout_chi_square(self) -> tuple[float, float] | None:
        """Reduced chi-square of the hold-out samples, and the probability of one at least as large by chance.

        The covariance of their residuals r is that of the noise, which the fitted samples show, and of the
        uncertain parameters, I + A·Aᵀ in standard deviations of the noise. None without hold-out samples, or
        if the uncertainty of the model contains its errors (correlated residuals).
        """
        matched = [item.matched_to(self.instruments).mounted(self.chain) for item in self.counted_holdout]
        holdout = [
            item
            for item in matched
            if all(p.name in self.instruments and not p.is_local for p in item.instrument_parameters)
            and {(item.kind, item.has_stated_sigma, name) for name in item.residual_groups}
            <= set(self.noise_factors)
        ]
        freedom = self.degrees_of_freedom
        if not holdout or not freedom or self.problem.temperature > 1 or self.shrinkage_factor < 1:
            return None
        root, unbounded = self._scaled_sqrt_covariance
        # The unknowns are those of the fitted samples.
        linearization, blocks = self.problem.linearize(self.x), []
        for chunk in self.problem.with_data(holdout).chunks:
            rows = linearization.rows(chunk)
            for name, group in chunk.data.residual_groups.items():
                noise = self.noise_factors[chunk.data.kind, chunk.data.has_stated_sigma, name]
                blocks.append(rows[:, group.rows].reshape(len(rows), -1).T / noise)
        rows = np.concatenate(blocks)
        if unbounded.size or not (np.isfinite(root).all() and np.isfinite(rows).all()):
            return None
        a, r = rows[:, :-1] @ root, rows[:, -1]
        along = a.T @ r
        chi_square = float(r @ r - along @ np.linalg.solve(np.eye(len(along)) + a.T @ a, along))
        from scipy.special import fdtrc  # lazy import: slow

        reduced = chi_square / len(r)
        return reduced, float(fdtrc(len(r), freedom, reduced))

    @property
    def is_holdout_unexplained(self) -> bool:
        """Whether noise and uncertainty do not explain the errors of the hold-out samples."""
        found = self.holdout_chi_square
        return found is not None and found[0] >= MIN_UNEXPLAINED and found[1] <= MAX_UNEXPLAINED_CHANCE

    @cached_property
    def holdout_mistake(self) -> Diagnosis | None:
        """Mistake in hold-out samples whose errors are not explained; None without one."""
        if not self.is_holdout_unexplained:
            return None
        # A remedy changes the fitted samples of the same file, too.
        others = of_same_files(self.data, self.holdout)
        found = diagnose_mixups(self.errors.chain, self.holdout, _usual_errors(self), holdout=others)
        sources = {item.source for item in self.holdout}
        source = found.source or (sources.pop() if len(sources) == 1 else "")
        # The fitted samples show that the robot file is right.
        hypotheses = tuple(replace(each, instead="") for each in found.hypotheses if each.key)
        found = replace(found, source=source, hypotheses=hypotheses)
        return _with_servos(self, found) if hypotheses else None

    @cached_property
    def holdout_change(self) -> Recheck | None:
        """What changed between fitted and hold-out samples; None if they show no change."""
        holdout = self.holdout
        if not self.is_holdout_unexplained or self.holdout_mistake:
            return None
        is_drawn = any(_alternate(item, other) for item in holdout for other in self.data)
        if is_drawn or not can_have_session(holdout) or not measures_positions(holdout):
            return None
        step = -(-sum(len(item.rows) for item in holdout) // MAX_CHECKED)
        data = [_with_noise(self, item.take(np.arange(0, len(item.rows), step))) for item in holdout]
        from ..session.check import recheck  # lazy import: only for hold-out samples

        found = recheck(self.chain, data, self.uncertainty, known=self.instruments)
        return found if found.verdict == "changed" else None

    @cached_property
    def generalization(self) -> Generalization:
        """Accuracy within the measured region and beyond it, and the shares of the joint space of both."""
        region, comparison = self.measured_region, self.region_comparison
        configurations, folds = self._different_configurations, self._region_folds
        return estimate_generalization(self, self.random_folds, region, comparison, configurations, folds)

    @cached_property
    def position_std(self) -> float:
        """Predicted RMS position error in the measured region with the best base and tool [m].

        The configurations are within the measured ranges of the joints. It contains the bias of contacts, see
        `estimation.contacts`. NaN if the errors of the arm are not estimated.
        """
        return self._predicted_position_std((0.0, 0.0, 0.0))

    @cached_property
    def position_std_beside(self) -> float:
        """Largest `position_std` at points `BESIDE` from the measured one along the tool axes [m]."""
        return max(self._predicted_position_std(offset) for offset in BESIDE * np.eye(3))

    def _predicted_position_std(self, offset: Sequence[float] | Array) -> float:
        """Predict the RMS position error of a point of the tool at an offset from the measured one [m]."""
        if not self.errors.has_arm:
            return float("nan")
        parts = [self._complete_uncertainty]
        if any(item.is_contact for item in self.data):
            parts.append(self._contact_bias)
        chain = parts[0].chain
        chain = chain.with_base_and_tool(chain.base, chain.tool @ se3.transform(np.eye(3), offset))
        q = self._predicted_configurations
        return float(np.linalg.norm([best_frames_std(replace(part, chain=chain), q) for part in parts]))

    @cached_property
    def _predicted_configurations(self) -> Array:
        """Configurations in the measured region at which errors are predicted, (m, n)."""
        q, _ = self._different_configurations
        if (region := self.measured_region) is not None:
            # The errors of joints grow beyond their measured ranges, whatever is measured.
            q = np.clip(region.draw(np.random.default_rng(0), N_PREDICTED), region.lower, region.upper)
        return q[:: -(-len(q) // N_PREDICTED) or 1]

    @property
    def _contact_bias(self) -> Uncertainty:
        """Bias of contacts as the only direction of an uncertainty."""
        count = len(self.errors.parameters)
        bias = contact_bias(self.problem, self.solution.x, self._sqrt_covariance[0])[:count, None]
        return Uncertainty.from_errors(self.errors, self.x[:count], self.chain, bias, bias[:, :0])

    @cached_property
    def measured_region(self) -> MeasuredRegion | None:
        """Region of joint space around the fitted configurations; None without joint values."""
        return measured_region(self, self._different_configurations, self._region_folds)

    @cached_property
    def _region_folds(self) -> tuple[Fold, ...]:
        """Folds that leave out regions of joint space; empty without different joint values."""
        return region_folds(self) if len(self._different_configurations[0]) else ()

    def _compare_holdout(self) -> Comparison:
        """Compare the accuracy before and after on the hold-out samples."""
        masks, (nominal, instruments) = self.is_holdout_counted, self._nominal
        chains = [(nominal, instruments), (self.chain, self.instruments)]
        chains += [(self.urdf_alone, self.instruments)] if self.bare else []
        errors = [compute_errors(chain, self.holdout, known) for chain, known in chains]
        before, after, *alone = (Accuracy.from_errors(take_errors(each, masks)) for each in errors)
        n_counted, n_outliers = (int(np.sum(np.concatenate(masks) == counted)) for counted in (True, False))
        everything = Accuracy.from_errors(errors[1]) if n_outliers else Accuracy()
        return Comparison("hold-out", n_counted, before, after, n_outliers, everything, *alone)


def positions_beside_images(data: Sequence[Measurement]) -> tuple[Measurement, ...]:
    """Return the measurements beside images if they measure positions and can determine frames, else none."""
    others = tuple(item for item in data if item.rig is None)
    return others if measures_positions(others) and has_enough_rows(others) else ()


def diagnose(fit: Evidence, progress: Progress | None) -> Diagnosis:
    """Look for mistakes in the measurements of a calibration, if this was not done before."""
    if fit.earlier_diagnosis:
        return fit.earlier_diagnosis
    held_out = of_same_files(fit.holdout, fit.data)
    found = diagnose_mixups(fit.errors.chain, fit.data, _usual_errors(fit), progress, held_out)
    return _with_servos(fit, found)


def diagnose_joint_values(fit: Evidence) -> Diagnosis:
    """Look for mistakes in the joint values of images without other measurements."""
    images = fit.data if all(item.n_images for item in fit.data) else ()
    return _with_servos(fit, diagnose_images(fit.errors.chain, images, _usual_errors(fit)))


def _with_servos(fit: Evidence, found: Diagnosis) -> Diagnosis:
    """Return a diagnosis whose remedies are those of a servo file if joint values come from counts."""
    if not any(item.has_counts for item in fit.data):
        return found
    return found.for_servos(fit.signs.turned if fit.signs else ())


def _usual_errors(fit: Evidence) -> str:
    """Return the parameter sets of the errors that such a robot usually has."""
    return usual_errors(fit.errors.chain, fit.data)


def _mean_squares(fit: FittedModel, data: Sequence[Measurement]) -> dict[tuple[str, bool, str], float]:
    """Return the mean squared residuals, by kind, whether sigma is stated, and residual group."""
    parts: dict[tuple[str, bool, str], list[Array]] = {}
    for item in data:
        residual = residual_of(item, fit.chain, fit.problem.instruments(fit.x))
        for name, group in item.residual_groups.items():
            key = item.kind, item.has_stated_sigma, name
            parts.setdefault(key, []).append(residual[group.rows].ravel())
    squares = {key: float(np.mean(np.concatenate(each) ** 2)) for key, each in parts.items()}
    return {key: value for key, value in squares.items() if value > 0}


def _with_noise(fit: Evidence, item: Measurement) -> Measurement:
    """Return positions or poses with the noise that the fitted samples show."""
    fields = {"position": "sigma", "orientation": "rotation_sigma"}
    values = {
        field: fit.noise_factors.get((item.kind, item.has_stated_sigma, group), 1.0) * getattr(item, field)
        for group, field in fields.items()
        if group in item.residual_groups
    }
    return item.replace(**values, has_stated_sigma=True)


def _with_all_samples(lines: DeviatingLines, item: Measurement, is_counted: Array) -> DeviatingLines:
    """Return lines that were found by the first sample of each configuration, with all of its samples."""
    order = np.argsort(item.rows, kind="stable")
    order = order[item.rows[order] >= lines.last]
    group = configuration_groups([item])[order]
    is_same = np.logical_and.accumulate(group == group[0])
    lines = replace(lines, last=int(item.rows[order[is_same][-1]]))
    inside = lines.contains(item)
    return replace(lines, n_outliers=int(np.sum(inside & ~is_counted)), n_fitted=int(np.sum(inside)))


def _alternate(item: Measurement, other: Measurement) -> bool:
    """Return whether samples of one file were measured between those of the other part of it."""
    if not is_same_file(item, other):
        return False
    return bool(item.rows.min() < other.rows.max() and other.rows.min() < item.rows.max())
