"""Evidence of a calibration: its accuracy on samples that were not fitted, and signs of mistakes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .._typing import Array
from ..estimation import robust
from ..measurements.measured_region import MeasuredRegion
from ..plausibility.evidence import HAND_BUILT, MANUFACTURED
from ..plausibility.mixups import Diagnosis, diagnose_mixups
from ..plausibility.signs import SignDecision
from ..session import Session
from .cameras.board_size import BoardSize
from .cameras.diagnosis import HandEyeDiagnosis, HandEyeFit
from .cameras.stages import Stage
from .cross_validation import (
    FoldComparison,
    Generalization,
    compare_folds,
    estimate_generalization,
    measured_region,
)
from .evaluation import (
    Accuracy,
    Comparison,
    PairedErrors,
    accuracy,
    compute_errors,
    remove_outliers,
)
from .fitted import FittedModel
from .partition import configuration_groups, k_fold

# Number of random folds of the cross-validation.
N_FOLDS = 5
# So few configurations are held out one by one instead.
MAX_LEAVE_ONE_OUT = 10


@dataclass(frozen=True, eq=False, repr=False)
class Evidence(FittedModel):
    """Fitted model with what the measurements say of its accuracy.

    Attributes:
        region_comparison: Accuracy on regions of joint space that were left out of further calibrations; None
            if there were none, see `leave_regions_out`.
        input_warnings: Warnings about the files of the measurements.
        camera_stages: Unknowns of a calibration from images that were freed in turn, and what each group of
            them improved; empty without images.
        hand_eye_fit: Fit of cameras and boards on the nominal arm; None if the calibrated arm fits the
            images, and without images.
        board_size: Other size of the boards that makes the correction of the arm far smaller, if any.
        is_kept_nominal: Whether the correction was not applied because of the verdict.
        earlier_diagnosis: Mistakes that were looked for in the same measurements with the same nominal robot,
            if they were.
        session: What happened during the measurement; None if this was not examined.
        signs: Joints that turn the other way than in the URDF, and signs that are open; None if the signs are
            those of the URDF.
    """

    region_comparison: Comparison | None = None
    input_warnings: tuple[str, ...] = ()
    camera_stages: tuple[Stage, ...] = ()
    hand_eye_fit: HandEyeFit | None = None
    board_size: BoardSize | None = None
    is_kept_nominal: bool = False
    earlier_diagnosis: Diagnosis | None = None
    session: Session | None = None
    signs: SignDecision | None = None

    @property
    def shrinkage_notes(self) -> list[str]:
        """One sentence if the correction was not applied in full, else empty."""
        if self.shrinkage_factor == 1:
            return []
        applied = f"only {100 * self.shrinkage_factor:.0f} % of the" if self.shrinkage_factor else "no"
        return [f"Too few measurements: {applied} correction applied. Measure more poses."]

    @property
    def hand_eye(self) -> HandEyeDiagnosis | None:
        """Error of cameras and boards on the nominal arm and its likely cause.

        None if the calibrated arm fits the images, without images, and with fewer than five configurations.
        """
        return self.hand_eye_fit.diagnosis if self.hand_eye_fit else None

    @cached_property
    def studentized_residuals(self) -> tuple[Array, ...]:
        """Studentized residual of each fitted sample, one array of shape (m,) per measurement."""
        data = [item.with_weights(1 / w) for item, w in zip(self.problem.data, self.weights, strict=True)]
        return tuple(robust.studentized_residuals(self.problem, self.solution, data, self.weights))

    @cached_property
    def outliers(self) -> tuple[Array, ...]:
        """Lines of the outliers of each fitted measurement; numbers from 1 for samples from Python.

        Outliers are the samples that were rejected and those whose studentized residual is large.
        """
        return tuple(
            item.rows[(residuals > robust.OUTLIER_THRESHOLD) | (weights <= robust.ZERO_WEIGHT)]
            for item, residuals, weights in zip(
                self.data, self.studentized_residuals, self.weights, strict=True
            )
        )

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """Mistakes in the measurements that explain them better than the measurements as they were read."""
        sets = HAND_BUILT if self.signs else MANUFACTURED
        return self.earlier_diagnosis or diagnose_mixups(self.errors.chain, self.data, sets)

    @cached_property
    def comparisons(self) -> tuple[Comparison, ...]:
        """Accuracy before and after: of hold-out or cross-validated samples, then of the fitted ones.

        Regions that were left out, if any, come before the cross-validated samples. Without hold-out samples,
        five-fold cross-validation judges each sample by a fit without it; up to ten configurations are held
        out one by one. Rejected samples are in none of these; outliers among the hold-out samples are in.
        """
        inliers, (nominal, instruments) = self.inliers, self._nominal
        count = sum(len(item.rows) for item in inliers)
        before = accuracy(nominal, inliers, instruments)
        after = accuracy(self.chain, inliers, self.instruments)
        alone = accuracy(self.urdf_alone, inliers, self.instruments) if self.bare else None
        fitted = Comparison("fitted", count, before, after, self.n_samples - count, after_alone=alone)
        found = [self._compare_holdout()] if self.holdout else []
        if self.region_comparison and self.generalization.region_holdout:
            found.append(self.region_comparison)
        # So few samples that no correction is possible cannot judge one either.
        is_judged = bool(self.shrinkage_factor) or self.is_kept_nominal
        if self.random_folds and not self.holdout and is_judged:
            found.append(self.random_folds.comparison)
        return (*found, fitted)

    @cached_property
    def random_folds(self) -> FoldComparison | None:
        """Accuracy of samples that are held out in random folds; None with a single configuration."""
        inliers = self.inliers
        n_configurations = len(np.unique(configuration_groups(inliers)))
        if n_configurations < 2:
            return None
        n_folds = N_FOLDS if n_configurations > MAX_LEAVE_ONE_OUT else n_configurations
        folds = k_fold(inliers, n_folds)
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
        before = compute_errors(nominal, self.holdout, instruments)
        after = compute_errors(self.chain, self.holdout, self.instruments)
        return PairedErrors.from_errors(before, after, configuration_groups(self.holdout)).without_outliers()

    @cached_property
    def generalization(self) -> Generalization:
        """Accuracy within the measured region and beyond it, and the shares of the joint space of both."""
        return estimate_generalization(self, self.random_folds, self._measured_region, self.region_comparison)

    @property
    def measured_region(self) -> MeasuredRegion | None:
        """Region of joint space around the fitted configurations; None without joint values."""
        return self._measured_region

    @cached_property
    def _measured_region(self) -> MeasuredRegion | None:
        return measured_region(self)

    def _compare_holdout(self) -> Comparison:
        """Compare the accuracy before and after on the hold-out samples."""
        errors = compute_errors(self.chain, self.holdout, self.instruments)
        inliers, n_outliers = remove_outliers(errors)
        return Comparison(
            "hold-out",
            sum(len(item.rows) for item in self.holdout),
            accuracy(self._nominal[0], self.holdout, self._nominal[1]),
            Accuracy.from_errors(errors),
            n_outliers=n_outliers,
            after_without_outliers=Accuracy.from_errors(inliers) if n_outliers else Accuracy(),
            after_alone=accuracy(self.urdf_alone, self.holdout, self.instruments) if self.bare else None,
        )
