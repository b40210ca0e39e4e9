"""Report context: a result, its provenance, and the diagnostics that are computed once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..calibration import summary
from ..calibration.evaluation import Comparison
from ..calibration.result import Result
from ..diagnostics.curves import JointCurve, fitted_coverage, joint_curves
from ..diagnostics.residuals import JointProfile, Outlier, find_outliers, joint_offset_profiles
from ..diagnostics.workspace import WorkspacePrediction, predict_workspace
from ..measurements.base import Measurement
from ..robot.coverage import JointCoverage
from .document import Provenance, short_names
from .samples import Samples, result_samples


@dataclass(frozen=True, eq=False)
class ReportContext:
    """A result with everything that the sections and figures of its report need.

    Attributes:
        fit: Result of the calibration.
        source: Files, settings and other facts that the result does not contain.
        outliers: Outliers among the fitted samples.
        joint_profiles: Residual joint errors over the range of each moving joint.
        workspace: Predicted accuracy over the workspace.
        coverage: Values of each revolute joint that the fitted samples visited.
        joint_curves: Correction curves of the joints with harmonics.
        samples: Fitted and held-out samples with their errors.
    """

    fit: Result
    source: Provenance
    outliers: Sequence[Outlier]
    joint_profiles: Sequence[JointProfile]
    workspace: WorkspacePrediction
    coverage: Sequence[JointCoverage]
    joint_curves: Sequence[JointCurve]
    samples: Samples

    @classmethod
    def from_result(cls, fit: Result, source: Provenance) -> ReportContext:
        """Compute what the report of a result needs."""
        workspace = predict_workspace(fit, fit.data)
        return cls(
            fit=fit,
            source=source,
            outliers=find_outliers(fit),
            joint_profiles=joint_offset_profiles(fit),
            workspace=workspace,
            coverage=fitted_coverage(fit),
            joint_curves=joint_curves(fit),
            samples=result_samples(
                fit,
                measurement_names(source.names, fit.data),
                measurement_names(source.holdout_names, fit.holdout),
            ).limited(),
        )

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
    def generalization_lines(self) -> tuple[str, ...]:
        """Accuracy within the measured region and beyond it, one line each."""
        return summary.generalization_lines(self.fit.generalization, self.comparisons)

    @property
    def robot_name(self) -> str:
        """Name of the robot."""
        return self.fit.chain.model.name or "robot"


def measurement_names(paths: Sequence[str], data: Sequence[Measurement]) -> list[str]:
    """Return short names of measurements."""
    if len(paths) == len(data):
        short = short_names(paths)
        return [short[path] for path in paths]
    return [f"{item.kind} measurements {i}" for i, item in enumerate(data, 1)]
