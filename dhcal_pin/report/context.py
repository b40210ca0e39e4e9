"""Report context: a result, its provenance, and what several sections need, computed when it is used."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from .._frozen import frozen
from ..calibration.evaluation import Comparison
from ..calibration.presentation.curves import JointCurve, joint_curves
from ..calibration.presentation.workspace import WorkspacePrediction, predict_workspace
from ..calibration.result import Result
from ..diagnostics.residuals import JointProfile, Outlier, find_outliers, joint_offset_profiles
from .provenance import Provenance, measurement_names
from .samples import Samples, result_samples


@frozen(eq=False)
class ReportContext:
    """A result with everything that its sections and figures need."""

    fit: Result  #: Result of the calibration.
    source: Provenance  #: Files, settings and other facts that the result does not contain.

    @cached_property
    def outliers(self) -> Sequence[Outlier]:
        """Outliers among the fitted samples, then among the held-out ones."""
        return find_outliers(self.fit)

    @cached_property
    def joint_profiles(self) -> Sequence[JointProfile]:
        """Residual joint errors over the range of each moving joint."""
        return joint_offset_profiles(self.fit)

    @cached_property
    def workspace(self) -> WorkspacePrediction:
        """Predicted accuracy over the workspace."""
        return predict_workspace(self.fit, self.fit.data)

    @cached_property
    def joint_curves(self) -> Sequence[JointCurve]:
        """Correction curves of the joints with harmonics."""
        return joint_curves(self.fit)

    @cached_property
    def samples(self) -> Samples:
        """Fitted and held-out samples with their errors."""
        return result_samples(self.fit, self.data_names, self.holdout_names).limited()

    @property
    def data_names(self) -> list[str]:
        """Name of each measurement of the fitted data."""
        return measurement_names(self.source.names, self.fit.data)

    @property
    def holdout_names(self) -> list[str]:
        """Name of each measurement of the hold-out data."""
        return measurement_names(self.source.holdout_names, self.fit.holdout)

    @property
    def comparisons(self) -> tuple[Comparison, ...]:
        """Accuracy before and after, beginning with the samples that say most about other measurements."""
        cross_validated, own = self.source.comparison, self.fit.comparisons
        if cross_validated is None or self.fit.holdout:
            return own
        return (cross_validated, *(c for c in own if c.title == "fitted"))

    @property
    def robot_name(self) -> str:
        """Name of the robot."""
        return self.fit.chain.model.name or "robot"
