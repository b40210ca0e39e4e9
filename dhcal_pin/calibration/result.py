"""Result of a calibration: the fitted model, the evidence of its accuracy and the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from .. import formatting
from .._frozen import frozen
from .._typing import Array
from ..estimation.bare_geometry import fit_bare_geometry
from ..estimation.initialization import fit_frames
from ..estimation.normal_equations import NormalEquations
from ..estimation.problem import Problem, UnfactoredSystem
from ..estimation.solver import remaining_change
from ..identifiability import explanations
from ..identifiability.null_space import ObservabilityProbe
from ..io.origins_file import without_negligible_moves
from ..measurements.arguments import as_measurements
from ..measurements.base import Measurement
from ..measurements.groups import ERROR_GROUPS
from . import cameras, summary
from .cross_validation import refit
from .estimates import Estimate, make_estimates
from .evaluation import Accuracy, accuracy, aligned_norms, compute_errors
from .evidence import Evidence
from .presentation import ResultPlots
from .presentation.residual_table import ResidualTable, residual_table
from .reweighting import Fit
from .verdict import Verdict, judge


@frozen(eq=False)
class Result(Evidence, ResultPlots):
    """Calibrated robot with the uncertainty of its parameters and its accuracy.

    Attributes:
        decision: Verdict that led to this result, if it has no correction for that reason.
    """

    decision: Verdict | None = None

    @cached_property
    def unobservable(self) -> list[str]:
        """One sentence per group of parameters that the data cannot distinguish, with the reason."""
        return explanations.explain_unobservable(self._probe, self._shown_system)

    @cached_property
    def weakly_observable(self) -> list[str]:
        """One sentence per group of parameters that are hardly better known than before the measurement."""
        return explanations.explain_weakly_observable(
            self._probe, self._shown_system, self.prior_std, self._sigma_scale
        )

    @cached_property
    def _probe(self) -> ObservabilityProbe:
        known_r = self._system_at_x.r if self.rank < len(self.x) else None
        return ObservabilityProbe(self.problem.shown, self.x, known_r)

    @cached_property
    def verdict(self) -> Verdict:
        """Whether the calibrated robot may be used, with the reasons."""
        return self.decision or judge(self)

    @property
    def accepted(self) -> Result:
        """This result, without the correction if the verdict keeps the nominal robot."""
        if not (self.verdict.keeps_nominal and self.shrinkage_factor):
            return self
        instruments = self.problem.instrument_start(self.nominal_instruments)
        regions = self.region_comparison
        return replace(
            self,
            x=np.append(np.zeros(len(self.errors.parameters)), instruments),
            chain=self.nominal_refitted,
            shrinkage_factor=0.0,
            bare=None,
            region_comparison=replace(regions, after_alone=None) if regions else None,
            is_kept_nominal=True,
            decision=replace(self.verdict, reasons=(*self.verdict.reasons, "No correction is applied.")),
        )

    @property
    def sample_count(self) -> str:
        """Number of samples that the fit used, such as "60 samples" or "57 of 60 samples"."""
        return summary.describe_sample_count(self.n_inliers, self.n_samples)

    @property
    def pose_std(self) -> float:
        """Largest standard deviation of the position of a camera or a board in its link [m].

        It is that along the worst direction; 0 if all of these positions are known, or if they are not
        distinguishable from an unknown base or tool.
        """
        if self.errors.only_frames:
            return 0.0
        return cameras.largest_position_std([p.name for p in self.parameters], self.covariance)

    def validate(self, data: Measurement | Sequence[Measurement]) -> Accuracy:
        """Compute the accuracy of the calibrated chain on other measurements.

        All samples count. Nothing tells outliers of other measurements from errors of the robot.

        Args:
            data: One measurement or several, in the frames of the fitted ones.

        Returns:
            Error statistics, which can also be indexed by the keys of the JSON document, such as
            "position_rms_m" [m] and "orientation_rms_rad" [rad].
        """
        return accuracy(self.chain, as_measurements(data), self.instruments)

    def refit(self, problem: Problem, start: Array) -> Array:
        """Fit some of the samples by the same method, see `cross_validation.refit`.

        Args:
            problem: `self.problem` with a part of its samples.
            start: Approximate solution, shape (p,) [m or rad].

        Returns:
            Solution x, shape (p,) [m or rad].
        """
        return refit(self, problem, start)

    def is_converged(self, eps: float = 1e-6) -> bool:
        """Check convergence with a fresh Gauss-Newton step from the solution.

        Args:
            eps: Largest RMS change of the whitened rows by that step, in standard deviations.

        Returns:
            Whether the step changes them by less.
        """
        change = remaining_change(self.problem, self.solution.x)
        return change <= eps * np.sqrt(max(1, self.n_samples))

    @cached_property
    def residuals(self) -> ResidualTable:
        """Residuals of all fitted and held-out samples with their files, lines and weights."""
        return residual_table(self)

    @cached_property
    def error_norms(self) -> dict[str, tuple[Array, Array]]:
        """Error norms of all samples before and after, shape (N,) each, by group [m or rad].

        The samples are in the order of `residuals`: first the fitted ones, outliers included, then the
        held-out ones. Samples without a group have NaN.
        """
        sides = []
        for chain, known in (self._nominal, (self.chain, self.instruments)):
            errors = [e for data in (self.data, self.holdout) for e in compute_errors(chain, data, known)]
            sides.append(aligned_norms(errors, (*self.data, *self.holdout)))
        return {group: (before, sides[1][group]) for group, before in sides[0].items()}

    @cached_property
    def estimates(self) -> tuple[Estimate, ...]:
        """Estimates of all identified parameters, then of the fixed ones."""
        with np.errstate(divide="ignore"):
            priors = 1 / self.problem.prior_weights
        figures = np.stack(
            [self.x, self.std, priors, self.observable_fraction, self.posterior_to_prior_std], 1
        )
        return make_estimates(self.chain, self.parameters, figures, self.errors.fixed)

    def __repr__(self) -> str:
        """Return the size of the fit and its most important figure in one line."""
        head = summary.headline(self.comparisons)
        label = ERROR_GROUPS[head.group].label
        return (
            f"Result({len(self.parameters)} parameters, {self.sample_count}, "
            f"RMS {label} {head.before} before, {head.after} after, {head.comparison.title})"
        )

    def _repr_html_(self) -> str:
        """Return the headline, the accuracy and the estimates, as a notebook shows them."""
        notes = [*([] if self.converged else ["It did not converge."]), *self.shrinkage_notes]
        paragraphs = [f"<strong>{summary.headline(self.comparisons).text}</strong>", *notes]
        tables = (summary.accuracy_table(self.comparisons), summary.estimate_table(self.estimates))
        html = "".join(f"<p>{text}</p>" for text in paragraphs)
        return "\n".join([html, *map(formatting.html_table, tables)])


def make_result(
    fit: Fit,
    shrinkage_factor: float,
    holdout: tuple[Measurement, ...],
    method: str,
) -> Result:
    """Apply the shrinkage factor to the solution of a fit and build the result."""
    problem, errors = fit.problem, fit.problem.errors
    solution = replace(fit.solution, iterations=fit.iterations)
    if isinstance(solution.system, NormalEquations):
        solution = replace(solution, system=UnfactoredSystem(solution.system, problem, solution.x))
    x = shrinkage_factor * fit.solution.x
    bare = None
    if shrinkage_factor:
        calibrated = errors.at(x[: len(errors.parameters)]).with_current_loads()
        bare = fit_bare_geometry(errors, x, calibrated, fit.without_rejected().problem.data)
        if bare:
            origins = without_negligible_moves(bare.with_frames_of(calibrated)).origins
            calibrated = replace(calibrated, urdf_origins=origins).with_current_loads()
    else:
        calibrated = fit_frames(errors, fit.data, problem.known)
    return Result(
        errors=errors,
        x=x,
        chain=calibrated,
        data=fit.data,
        holdout=holdout,
        problem=problem,
        solution=solution,
        method=method,
        weights=fit.weights,
        shrinkage_factor=shrinkage_factor,
        bare=bare,
        stage=fit.stage,
    )
