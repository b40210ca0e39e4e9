"""Model selection: families of joint errors that the measurements support, and how much samples count.

A calibration estimates the geometry first. The standard deviations of its priors are then held, and two
questions are asked.

1. Which families of joint errors do the measurements support? Forward selection: the family with the lowest
   cross-validated error is added if

   - the log evidence rises by more than `MIN_LOG_BAYES_FACTOR`. With m whitened rows [J | r] divided by the
     standard deviation s of the residuals, the cost C of rows and priors, and the triangular factor R of
     [J; W],

         log E = -C/2 - m·log s - log|det R| + log|det W|.

     The standard deviation w of the priors of each family, and s, are those of greatest evidence,
     w² = Σ x_i² / Σ γ_i and s² = ‖r‖² / (m - Σ γ_i) (MacKay 1992), but w is never above the expected one;
   - the squared error of random folds falls by more than the rule of the family says. Folds are random,
     not regions of joint space, as fast periodic errors are visible between neighbouring configurations only.
     Neighbours on a recorded path can share noise: if the residuals with families are correlated there, the
     families must not increase the error of left-out regions.

   Correction curves of high order are tried only on top of those of low order. The screening of the lines
   of the residuals spares most trials of curves that are not there.

   Backlash and thermal growth are tried only where the direction of approach or the temperature is known.

   If a family is supported, eccentricity and elasticity are added in any case. Their priors shrink them where
   the measurements do not determine them. The model is then fitted by iteration. Outliers that are set apart
   only from this fit hide smaller families: without them, families are selected again. Many outliers are
   searched as in the fit of the geometry, see `good_samples`.

   Where a robust fit of the geometry rejects many samples, errors of the joints may be the cause, such as
   backlash with two directions of approach. All samples are then fitted with families, too. That fit counts
   if it rejects at most half as many samples with hardly more noise.

2. How many independent samples do the measurements count for? The residuals of a real arm are correlated:
   they are errors of the model, equal in neighbouring configurations. N configurations then contain the
   information of N/T independent ones. The temperature T multiplies the variance of the residuals. It is 1
   unless the residuals of neighbouring configurations are correlated, see
   `identifiability.residual_correlation`. If they are, the result is fitted again with the design effect
   (Kish 1965) of N samples of the mean correlation ρ̄,

       T = 1 + (N - 1)·ρ̄,    ρ̄ = mean of 0.015 + 0.15·exp(-d_ij²/2l²) over all pairs i ≠ j,

   with the distance d_ij of two configurations and l = 0.5 rad. Configurations in a small part of joint space
   thus count as fewer independent ones than as many that are far apart, and no number of them counts as more
   than 67. Predicted variances of the tool are the sum of two parts. The residuals are errors of the model,
   which other configurations have as well: their variance, without the noise of the instrument where it is
   stated, is one part. The other is that of the uncertain parameters, scaled by c such that both together are
   the mean squared errors of left-out regions f of joint space,

       Σ m_f·e_f² = Σ m_f·(1 + c²·v_f),

   with the number m_f of held-out rows, the mean square e_f² of their errors and the variance v_f of their
   prediction by the parameters, both in units of the residual variance.

Without a supported family, and with T = 1, the fit is exactly that of the geometry.

Shapes: p unknowns of the robot with all families and of the instruments, k folds.

References:
    L. Kish, Survey Sampling, Wiley 1965, section 5.4.
    D. J. C. MacKay, Bayesian Interpolation, Neural Computation 4, 1992.
    P. Gruenwald and T. van Ommen, Inconsistency of Bayesian Inference for Misspecified Linear Models, and a
    Proposal for Repairing It, Bayesian Analysis 12, 2017.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, field, replace
from typing import Any

import numpy as np

from .._frozen import frozen
from .._kernels.work_arrays import UnbufferedRows
from .._typing import Array, Progress, no_progress
from ..estimation import robust
from ..estimation.error_model import ErrorModel, ErrorParameter
from ..estimation.folds import (
    Fold,
    NoiseClass,
    NoisyFold,
    NoisyRows,
    count_rows,
    factor_folds,
    factor_partition,
    solve_columns,
)
from ..estimation.parameters import EXTENSIONS, LOW_COST, PARAMETER_SETS
from ..estimation.priors import effective_parameters
from ..estimation.problem import Problem, linearize_and_factor
from ..estimation.solver import minimize
from ..estimation.uncertainty import FamilyGain
from ..exceptions import UnknownNameError
from ..formatting import Table, format_fixed
from ..identifiability.residual_correlation import MAX_WHITE_Z, design_effect, find_residual_correlation
from ..measurements.base import known_conditions
from ..robot.error_families import FAMILIES, HARMONICS
from .good_samples import find_good_samples
from .partition import (
    configuration_groups,
    contact_groups,
    different_configurations,
    k_fold,
    path_folds,
    quadrant_folds,
)
from .reweighting import Fit, leverages, reweight, with_sigma_scales

# Whitened residuals of exact data are smaller, as their standard deviations have a lower limit. They are
# rounding errors, whose correlation says nothing about the model.
MIN_CORRELATED_NOISE = 0.02
# Smallest rise of the log evidence for which a family is added: odds of 250 to 1.
MIN_LOG_BAYES_FACTOR = 5.5
# Largest number of selections; each but the first is without the outliers that the last one shows.
MAX_SELECTIONS = 3
# Share of samples from which on outliers are many, and the largest growth of the noise with which errors of
# joints explain them.
MIN_MANY, MAX_NOISE_GROWTH = 0.1, 1.5
# Number of random folds.
N_FOLDS = 5
# Smallest number of different configurations for a selection.
MIN_CONFIGURATIONS = 2 * N_FOLDS
# Name of this work for the user, and its steps: choose families, fit them, compare left-out regions.
PHASE, _N_STEPS = "joint error families", 3
# Evidence iteration: largest number of rounds, and relative change of a width that ends it.
MAX_EVIDENCE_ROUNDS = 20
EVIDENCE_TOL = 0.05
# Smallest noise, as a fraction of the residuals of the geometry; families explain no more of them.
MIN_NOISE_RATIO = 0.02
# Narrowest prior of a family, as a fraction of the expected one.
MIN_PRIOR_WIDTH = 1e-3
# From this number of rows per line on, the lines of residuals hardly depend on each other and on the fit.
MANY_ROWS_PER_LINE = 2
# Highest of these lines for white residuals, as a square in standard deviations, and largest excess of all.
MAX_WHITE_LINE, SCREENING_SIGMAS = 20.0, 3.0
# Largest excess of the sum for fewer rows. Curves that the measurements support have at least 2.1.
FEW_ROWS_SIGMAS = 1.5
# Limits of the scale of predicted standard deviations. Regions that are left out lie nearer to the others
# than the rest of the workspace does; they may hardly lower a prediction.
MIN_PREDICTION_SCALE, MAX_PREDICTION_SCALE = 0.8, 3.0
# Largest ratio of the errors with and without a family for which a hint is given.
MAX_HINT_RATIO = 0.9
# Smallest number of rows that must remain per parameter of a family for a hint.
MIN_ROWS_PER_PARAMETER = 5
# Largest number of samples of each measurement that a hint is computed from.
MAX_HINT_SAMPLES = 500
# Families that are no correction curves.
LOW_ORDER = tuple(name for name in EXTENSIONS if not FAMILIES[name].is_curve)

# Function that factors the rows of a problem at x, all of them and random folds.
FactorFolds = Callable[[Problem, Array, Sequence[Fold]], tuple[NoisyRows, tuple[NoisyFold, ...]]]

# All parameters that positions and poses can determine, wherever instrument and target are.
FULL_SET = "minimal,base,tool"


@frozen
class FamilyTrial:
    """Effect of a family on top of those selected before it."""

    family: str  #: Name of the family, one of `estimation.EXTENSIONS`
    cv_before: float  #: Error of random held-out folds without the family, in standard deviations
    cv_after: float  #: The same with it; as before if its evidence is too small to try
    log_bayes_factor: float  #: Rise of the log evidence by the family
    #: Standard deviation of its priors of greatest evidence, as a fraction of the default one.
    prior_width: float
    is_selected: bool = False  #: Whether it was added

    @property
    def improvement(self) -> float:
        """Relative reduction of the squared error of the held-out folds."""
        return 1 - (self.cv_after / self.cv_before) ** 2 if self.cv_before else 0.0

    @property
    def is_supported(self) -> bool:
        """Whether the measurements support the family."""
        return (
            self.log_bayes_factor > MIN_LOG_BAYES_FACTOR
            and self.improvement > FAMILIES[self.family].rule.min_improvement
        )

    @property
    def verdict(self) -> str:
        """Whether the family was added, and whether the measurements support it."""
        if not self.is_selected:
            return "not selected"
        return "added" if self.is_supported else "added, not supported"


def trial_table(trials: Sequence[FamilyTrial]) -> Table:
    """Make a table of the effect of each family on the cross-validated error."""
    header = ["family", "verdict", "before", "after", "log evidence", "prior width"]
    rows = [
        [
            trial.family,
            trial.verdict,
            format_fixed(trial.cv_before, 3),
            format_fixed(trial.cv_after, 3),
            f"{trial.log_bayes_factor:+.1f}",
            f"{trial.prior_width:.2g} of default",
        ]
        for trial in trials
    ]
    return Table(header, rows, n_text_columns=2)


@frozen
class Extension:
    """What a calibration added to the geometry, and how much its samples count."""

    #: Trials of the selected families in the order of selection, then of the others.
    trials: tuple[FamilyTrial, ...] = ()
    temperature: float = 1.0  #: Temperature T of the residuals
    n_configurations: int = 0  #: Number N of different fitted configurations
    prediction_scale: float = 1.0  #: Factor to predicted standard deviations of the tool
    #: Error of random left-out samples as a fraction of that of the geometry alone; NaN if no family was
    #: added.
    random_ratio: float = float("nan")
    #: The same of left-out regions of joint space; NaN if none can be left out.
    region_ratio: float = float("nan")

    @property
    def families(self) -> tuple[str, ...]:
        """Names of the added families."""
        return tuple(trial.family for trial in self.trials if trial.is_selected)

    @property
    def supported(self) -> tuple[str, ...]:
        """Names of the added families that the measurements support; the others have a physical cause."""
        return tuple(trial.family for trial in self.trials if trial.is_selected and trial.is_supported)

    @property
    def effective_samples(self) -> float:
        """Number of independent configurations that the measurements count for."""
        return self.n_configurations / self.temperature

    @property
    def sentences(self) -> list[str]:
        """Say what was added, what it improves and how much the samples count."""
        widths = {trial.family: trial.prior_width for trial in self.trials}
        added = ", ".join(
            f"{name} ({'' if name in self.supported else 'not supported, '}"
            f"prior width {widths[name]:.2g} of default)"
            for name in self.families
        )
        changes = [
            f"{kind} {100 * (ratio - 1):+.0f} %"
            for kind, ratio in (("at random", self.random_ratio), ("by region", self.region_ratio))
            if np.isfinite(ratio)
        ]
        first = f"Added to the geometry: {added or 'nothing'}."
        if changes:
            first += f" Change of the error of left-out samples: {', '.join(changes)}."
        second = (
            f"{self.n_configurations} configurations count as {self.effective_samples:.3g} independent ones"
        )
        return [first, f"{second} (temperature of the residuals {self.temperature:.3g})."]

    def to_dict(self) -> dict[str, Any]:
        """Return the content for the JSON document."""
        return {
            "families": list(self.families),
            "supported": list(self.supported),
            "temperature": self.temperature,
            "effective_samples": self.effective_samples,
            "configurations": self.n_configurations,
            "prediction_scale": self.prediction_scale,
            "random_ratio": self.random_ratio,
            "region_ratio": self.region_ratio,
            "trials": [asdict(trial) for trial in self.trials],
        }


# Fit with families of joint errors, and what was added.
ExtendedFit = tuple[Fit, Extension]


@frozen(eq=False)
class Model:
    """Selected families, with the hyperparameters of greatest evidence."""

    # Standard deviation of the priors of each family, as a fraction of the expected one.
    widths: Mapping[str, float]
    noise: float  # Standard deviation of the whitened residuals
    log_evidence: float  # Log evidence, up to a constant
    values: Mapping[str, float]  # Values of its parameters by name


@frozen(eq=False)
class _Candidates:
    """Linear model around a fit with the columns of further families."""

    problem: Problem  # Problem with the parameters and the expected priors of all families
    x: Array  # Point of the linearization, (p,)
    family: Array  # Name of the family of each unknown, "" for the unknowns of the fit, (p,)
    rows: NoisyRows  # Rows of all data
    # Rows of random folds of whole configurations; empty if nothing is selected.
    folds: tuple[NoisyFold, ...] = ()
    # Error of the random folds with the families of each model that was asked for.
    cv_errors: dict[Model, float] = field(default_factory=dict)

    @classmethod
    def with_folds(cls, problem: Problem, x: Array, family: Array, factor: FactorFolds) -> _Candidates:
        """Factor the data in random folds."""
        return cls(problem, x, family, *factor(problem, x, k_fold(problem.data, N_FOLDS)))

    def weights(self, widths: Mapping[str, float]) -> Array:
        """Return the weights of the priors (p,) for prior widths as fractions of the expected ones."""
        return prior_weights(self.problem, self.family, widths)

    def columns(self, widths: Mapping[str, float]) -> Array:
        """Return the mask of the unknowns (p,) of the fit and of some families."""
        return (self.family == "") | np.isin(self.family, list(widths))

    def maximize_evidence(self, widths: Mapping[str, float]) -> Model:
        """Find the prior widths of some families, and the noise, of greatest evidence."""
        columns = self.columns(widths)
        reduced = self.rows.select(columns)
        family, x, expected = self.family[columns], self.x[columns], self.problem.weights[columns]
        # Displacements of images that are smaller than the noise of their corners may leave nothing.
        nothing = np.zeros((len(x), len(x)))
        noise = reduced.noise_after(1.0, np.zeros(len(x)), nothing, 0.0) or MIN_NOISE_RATIO
        smallest = MIN_NOISE_RATIO * noise
        rounds = 0
        while True:
            weights = self.weights(widths)[columns]
            rows = reduced.at(noise)
            root = rows.sqrt_covariance(weights)[0]
            from_priors = np.einsum("ij,ij->i", root, root) * weights**2
            n_determined = root.shape[1] - float(from_priors.sum())
            step, _ = rows.solve(weights, x)
            updated_noise = max(reduced.noise_after(noise, step, root, n_determined), smallest)
            updated = {
                name: _best_width(x + step, 1 - from_priors, expected, family == name) for name in widths
            }
            changes = [np.log(updated_noise / noise)] + [np.log(updated[k] / widths[k]) for k in widths]
            rounds += 1
            if np.abs(changes).max() < EVIDENCE_TOL or rounds == MAX_EVIDENCE_ROUNDS:
                break
            widths, noise = updated, updated_noise
        posterior = rows.with_priors(weights, x)
        log_det = np.sum(np.log(np.abs(np.diag(posterior.r)))) - np.sum(np.log(weights[weights > 0]))
        log_evidence = -0.5 * posterior.min_cost - float(log_det) - reduced.log_det(noise)
        names = np.array(_unknown_names(self.problem))[columns]
        values = dict(zip(names.tolist(), (x + step).tolist(), strict=True))
        return Model(widths, noise, log_evidence, values)

    def cv_error(self, model: Model) -> float:
        """Compute the RMS error of the random folds with the families of a model."""
        if model not in self.cv_errors:
            weights, columns = self.weights(model.widths), self.columns(model.widths)
            squares = [fold.squared_error(model.noise, weights, self.x, columns) for fold in self.folds]
            n_rows = sum(fold.n_rows for fold in self.folds)
            self.cv_errors[model] = float(np.sqrt(sum(squares) / n_rows))
        return self.cv_errors[model]

    def trial(self, name: str, current: Model) -> tuple[FamilyTrial, Model]:
        """Try a family on top of those of a model; return the model with it, too."""
        model = self.maximize_evidence({**current.widths, name: 1.0})
        gain = model.log_evidence - current.log_evidence
        before = after = float("nan")
        if gain > MIN_LOG_BAYES_FACTOR:
            before, after = self.cv_error(current), self.cv_error(model)
        return FamilyTrial(name, before, after, gain, model.widths[name]), model


def _factor_folds(
    problem: Problem, x: Array, folds: Sequence[Fold]
) -> tuple[NoisyRows, tuple[NoisyFold, ...]]:
    """Factor rows of unknown noise."""
    systems, n_rows = tuple(factor_partition(problem, x, folds)), count_rows(problem)
    whole = systems[0].fitted.merged(systems[0].held_out)
    return NoisyRows((NoiseClass(whole, n_rows),)), tuple(
        NoisyFold(NoisyRows((NoiseClass(one.fitted, n_rows - one.n_rows),)), one.held_out, one.n_rows)
        for one in systems
    )


def _unknown_names(problem: Problem) -> list[str]:
    """Return the names of the unknowns of a problem, robot and instruments."""
    return [one.name for one in problem.parameters]


def prior_weights(problem: Problem, family: Array, widths: Mapping[str, float]) -> Array:
    """Return the weights of the priors (p,) of a problem with the expected widths for other widths."""
    factors = np.ones(len(family))
    for name, width in widths.items():
        factors[family == name] = width
    return problem.weights / factors


def _best_width(x: Array, determined: Array, expected: Array, members: Array) -> float:
    """Return the prior width of greatest evidence of some parameters, as a fraction of the expected one."""
    count = max(float(np.sum(determined[members])), EVIDENCE_TOL)
    size = np.sqrt(float(np.sum((x * expected)[members] ** 2)) / count)
    return float(np.clip(size, MIN_PRIOR_WIDTH, 1.0))


def _missing_parameters(problem: Problem, families: Sequence[str]) -> dict[str, list[ErrorParameter]]:
    """Return the parameters of each family of a known condition that are not in the model."""
    errors, conditions = problem.errors, known_conditions(problem.data)
    known = {p.name for p in (*errors.parameters, *errors.fixed)}
    by_family = {
        name: [p for p in PARAMETER_SETS[name](errors.chain) if p.name not in known]
        for name in families
        if FAMILIES[name].condition in conditions
    }
    return {name: parameters for name, parameters in by_family.items() if parameters}


def _with_families(
    problem: Problem, x: Array, families: dict[str, list[ErrorParameter]]
) -> tuple[Problem, Array, Array]:
    """Add the parameters of families to a problem at x; return it with x and the family of each unknown."""
    errors = problem.errors.with_parameters([p for parameters in families.values() for p in parameters])
    robot = len(problem.errors.parameters)
    names = [p.name for p in problem.errors.parameters]
    # x and prior weight of each estimated parameter; the others start from 0 with their expected priors.
    start = dict(zip(names, zip(x[:robot], problem.weights[:robot], strict=True), strict=True))
    values = np.array([start.get(p.name, (0.0, 1 / p.prior)) for p in errors.parameters]).reshape(-1, 2)
    x = np.concatenate([values[:, 0], x[robot:]])
    weights = np.concatenate([values[:, 1], problem.weights[robot:]])
    family_of = {p.name: name for name, parameters in families.items() for p in parameters}
    family = np.array(
        [*(family_of.get(p.name, "") for p in errors.parameters), *[""] * (len(x) - len(values))]
    )
    bounds = problem.bounds
    if bounds is not None:
        free = np.tile([[-np.inf], [np.inf]], len(x))
        free[:, family == ""] = bounds
        bounds = free
    errors = errors.with_current_loads(x[: len(errors.parameters)])
    return replace(problem, errors=errors, weights=weights, bounds=bounds), x, family


def with_joint_errors(
    problem: Problem, x: Array, extended: Fit, families: Sequence[str]
) -> tuple[Problem, Array]:
    """Add families to a problem at x: correction curves as an extended fit has them, others as unknowns."""
    low_order, curves = (
        _missing_parameters(problem, [name for name in families if FAMILIES[name].is_curve == is_curve])
        for is_curve in (False, True)
    )
    known = [parameter for parameters in curves.values() for parameter in parameters]
    model = ErrorModel(problem.errors.chain, ()).with_parameters(known)
    fitted = dict(zip(_unknown_names(extended.problem), extended.solution.x, strict=True))
    chain = model.at(np.array([fitted[p.name] for p in model.parameters]))
    problem = replace(problem, errors=replace(problem.errors, chain=chain))
    return _with_families(problem, x, low_order)[:2]


def _select(candidates: _Candidates, names: Sequence[str], model: Model) -> tuple[list[FamilyTrial], Model]:
    """Select families one after the other."""
    remaining, chosen = list(names), list[FamilyTrial]()
    while True:
        trials = [candidates.trial(name, model) for name in remaining]
        supported = [each for each in trials if each[0].is_supported]
        if not supported:
            return [*chosen, *(trial for trial, _ in trials)], model
        best, model = min(supported, key=lambda each: each[0].cv_after)
        chosen.append(replace(best, is_selected=True))
        remaining.remove(best.family)


def _may_have_curves(problem: Problem, x: Array, curves: Sequence[ErrorParameter], orders: range) -> bool:
    """Check whether curves stand out of the residuals at x; this costs far less than a trial of them."""
    if any(item.configurations_per_row != 1 for item in problem.data):
        return True
    if count_rows(problem) < MANY_ROWS_PER_LINE * len(curves):
        return _line_excess(problem, x, curves) > FEW_ROWS_SIGMAS
    return _have_lines(problem, x, orders)


def _line_excess(problem: Problem, x: Array, curves: Sequence[ErrorParameter]) -> float:
    """Compute by how many standard deviations residuals along the columns of curves exceed white ones."""
    # With M = I - J·(Jᵀ·J + W²)⁻¹·Jᵀ, white noise ε of variance σ² leaves the residuals r = M·ε. Along the
    # unit columns A of the curves, their sum of squares is ‖Aᵀ·r‖². For B = M·A, its mean is σ²·‖B‖² and its
    # variance 2·σ⁴·‖Bᵀ·B‖². The estimate of σ² is ‖r‖²/‖M‖².
    extended, start, family = _with_families(problem, x, {HARMONICS: list(curves)})
    linearization = extended.linearize(start)
    rows = np.concatenate(
        [linearization.rows(chunk).reshape(len(family) + 1, -1) for chunk in extended.chunks], 1
    )
    own, residual = family == HARMONICS, rows[-1]
    jacobian, lines = rows[:-1][~own], rows[:-1][own]
    lines = lines / np.fmax(np.linalg.norm(lines, axis=1, keepdims=True), np.finfo(float).tiny)
    information = jacobian @ jacobian.T + np.diag(extended.weights[~own] ** 2)
    left = np.eye(len(residual)) - jacobian.T @ np.linalg.lstsq(information, jacobian, rcond=None)[0]
    columns = left @ lines.T
    variance = float(residual @ residual) / np.sum(left**2)
    excess = np.sum((lines @ residual) ** 2) / max(variance, np.finfo(float).tiny) - np.sum(columns**2)
    return float(excess / np.sqrt(2 * np.sum((columns.T @ columns) ** 2)))


def _have_lines(problem: Problem, x: Array, orders: range) -> bool:
    """Check whether lines stand out of the spectrum of the residuals over the joint values."""
    # With the whitened column a of a joint and white residuals r of variance 1, (Σ a·r·sin kq)² / Σ |a|²·sin²
    # kq, and the same with the cosine, are distributed as χ²_1, or smaller where the fit has taken up a part.
    robot = len(problem.errors.parameters)
    chain = problem.errors.at(x[:robot])
    first = [p for p in PARAMETER_SETS[HARMONICS](chain) if p.name.endswith(("sin1", "cos1"))]
    n_lines, n_rows = len(first) * len(orders), count_rows(problem)
    # The columns of sin q and cos q give the column a = a·sin q·sin q + a·cos q·cos q of each joint.
    errors = ErrorModel(chain, ()).with_parameters(first)
    instruments = x[robot:]
    spectrum = replace(problem, errors=errors, weights=np.zeros(len(first) + len(instruments)), bounds=None)
    linearization = spectrum.linearize(np.concatenate([np.zeros(len(first)), instruments]))
    joints = [chain.joint_names.index(p.name.rsplit(".", 1)[0]) for p in errors.parameters]
    # Σ a·r·exp(ikq) and Σ |a|²·exp(2ikq) of each order k and joint, and Σ |a|².
    lines = np.zeros((2, len(orders), chain.n_joints), complex)
    sizes, cost = np.zeros(chain.n_joints), 0.0
    for chunk in spectrum.chunks:
        rows, q = linearization.rows(chunk), chunk.data.q.T
        products = np.einsum("pkm,km->pm", rows[: len(first)], rows[-1])
        squares = np.einsum("pkm,pkm->pm", rows[: len(first)], rows[: len(first)])
        both = np.zeros((2, *q.shape))
        for row, parameter, joint in zip(range(len(first)), errors.parameters, joints, strict=True):
            function = np.sin if parameter.name.endswith("sin1") else np.cos
            both[0, joint] += products[row] * function(q[joint])
            both[1, joint] += squares[row]
        sizes += np.sum(both[1], 1)
        cost += float(np.vdot(rows[-1], rows[-1]))
        turn = np.exp(1j * q)
        wave = turn**orders.start
        for index in range(len(orders)):
            lines[0, index] += np.einsum("jm,jm->j", both[0], wave)
            lines[1, index] += np.einsum("jm,jm,jm->j", both[1], wave, wave)
            wave *= turn
    squares = np.stack([sizes - lines[1].real, sizes + lines[1].real]) / 2
    products = np.stack([lines[0].imag, lines[0].real])
    z2 = products**2 / np.maximum(squares * cost / n_rows, np.finfo(float).tiny)
    return bool(z2.max() > MAX_WHITE_LINE or z2.sum() > n_lines + SCREENING_SIGMAS * np.sqrt(2 * n_lines))


@frozen(eq=False)
class _RegionErrors:
    """Errors of left-out regions of joint space, with their prediction."""

    n_rows: Array  # Number of held-out rows of each region, (k,)
    squares: Array  # Mean square of the held-out rows, in units of the residual variance, (k,)
    variances: Array  # Mean variance of these rows by the uncertainty of the fit, in the same units, (k,)
    noise: float  # Standard deviation of the whitened residuals

    @property
    def prediction_scale(self) -> float:
        """Factor to standard deviations of the fit that agrees with the held-out errors."""
        excess = np.sum(self.n_rows * (self.squares - 1)) / np.sum(self.n_rows * self.variances)
        return float(np.sqrt(max(excess, 0.0)))

    @property
    def rms(self) -> float:
        """RMS of all held-out whitened rows."""
        return self.noise * float(np.sqrt(np.sum(self.n_rows * self.squares) / np.sum(self.n_rows)))


def _region_errors(problem: Problem, x: Array, noise: float, temperature: float) -> _RegionErrors | None:
    """Fit the other samples of each region at a temperature; None if no region can be left out."""
    weights, columns = problem.weights * noise * np.sqrt(temperature), np.ones(len(x), bool)
    # Rows, squared error and predicted variance. The systems of one region are in memory at a time.
    found = [
        (fold.n_rows, fold.error(weights, x, columns) ** 2, fold.prediction_std(weights, columns) ** 2)
        for fold in factor_folds(problem, x, quadrant_folds(problem.data, contact_groups(problem, x)))
        if fold.n_rows
    ]
    if not found:
        return None
    n_rows, squares, variances = np.array(found, float).T
    return _RegionErrors(n_rows, squares / noise**2, temperature * variances, noise)


@frozen(eq=False)
class _Selection:
    """Selected families, and the fit with them."""

    fit: Fit  # Fit of the geometry, without the outliers that the families show
    trials: tuple[FamilyTrial, ...]  # Trials of all families
    random_ratio: float  # Error of random folds relative to that of the geometry
    extended: Fit  # Fit with the selected families; that of the geometry without any
    noise: float  # Standard deviation of its whitened residuals


@UnbufferedRows()
def extend(fit: Fit, families: Sequence[str], max_iterations: int, progress: Progress | None) -> ExtendedFit:
    """Add the families of joint errors that the measurements support, and find how much the samples count."""
    if unknown := [name for name in families if name not in EXTENSIONS]:
        raise UnknownNameError(
            f"unknown extension {unknown[0]!r}; choose from {', '.join(EXTENSIONS)}, or auto or none"
        )
    judged = fit.without_rejected()
    n_configurations = len(np.unique(configuration_groups(judged.data)))
    if n_configurations < MIN_CONFIGURATIONS or not _noise(judged) > 0:
        return fit, Extension(n_configurations=n_configurations)
    report = progress or no_progress
    selection = _select_and_fit(fit, families, max_iterations, report)
    trials, extended, noise = selection.trials, selection.extended, selection.noise
    core, is_extended = selection.fit, any(trial.is_selected for trial in trials)
    has_outliers, judged = core is not fit, core.without_rejected()
    report(PHASE, 3, _N_STEPS)
    temperature, scale, region_ratio = 1.0, 1.0, float("nan")
    if _are_residuals_correlated(extended, noise):
        is_prismatic = extended.problem.errors.chain.is_prismatic
        temperature = design_effect(different_configurations(judged.data)[0], is_prismatic)
    if not is_extended and temperature == 1:
        return fit, Extension(trials, n_configurations=n_configurations)
    errors = _region_errors(extended.without_rejected().problem, extended.solution.x, noise, temperature)
    geometry = _region_errors(judged.problem, core.solution.x, _noise(judged), 1.0)
    if errors and geometry:
        region_ratio = errors.rms / geometry.rms
        # Neighbours on a path share noise, so that random folds do not show whether families adapt to it.
        if is_extended and temperature > 1 and region_ratio > 1 and path_folds(judged.data, N_FOLDS):
            return extend(fit, (), max_iterations, progress)
        if temperature > 1:
            scale = float(np.clip(errors.prediction_scale, MIN_PREDICTION_SCALE, MAX_PREDICTION_SCALE))
    extension = Extension(trials, temperature, n_configurations, scale, selection.random_ratio, region_ratio)
    problem = extended.problem
    n_groups = sum(len(item.residual_groups) for item in problem.data)
    problem = problem.with_data(with_sigma_scales(problem.data, np.full(n_groups, noise)))
    problem = problem.at_temperature(temperature)
    # The rows are divided by the noise; they are not linearized again.
    start = replace(extended.solution, system=extended.solution.system.scaled(1 / noise))
    solution = minimize(problem, "lm", start.x, max_iterations, warm_start=start, loose=True)
    extended = replace(extended, problem=problem, solution=solution)
    # Outliers were found already: the last robust stage decides which of them are rejected.
    stage = _rejection_stage(extended) if has_outliers or fit.stage == robust.REJECTED else fit.stage
    if stage == robust.KEPT:
        extended = replace(extended, weights=fit.weights)
    return reweight(extended, (stage,), (), max_iterations, progress, leverages), extension


def _select_and_fit(
    fit: Fit, families: Sequence[str], max_iterations: int, report: Progress, n_left: int = MAX_SELECTIONS
) -> _Selection:
    """Select families and fit them; again without the outliers that they show, which hide other families."""
    judged = fit.without_rejected()
    report(PHASE, 1, _N_STEPS)
    trials, model, random_ratio, selected = select_families(judged, families)
    report(PHASE, 2, _N_STEPS)
    extended, noise = fit, _noise(judged)
    if selected:
        extended, noise = _fit_selected(fit, selected, model, max_iterations)
        weights = _outliers_shown(fit, extended)
        is_new = any(np.any(new < old) for new, old in zip(weights, fit.weights, strict=True))
        if n_left > 1 and is_new:
            without = fit.solved_with_weights(weights, max_iterations)
            return _select_and_fit(without, families, max_iterations, report, n_left - 1)
    return _Selection(fit, trials, random_ratio, extended, noise)


def _outliers_shown(fit: Fit, extended: Fit) -> tuple[Array, ...]:
    """Return the weights of a fit without the outliers that are set apart from an extended one."""
    if _rejection_stage(extended) == robust.REJECTED and _count_rejected(extended)[0]:
        return extended.weights
    data = [item.with_weights(1 / w) for item, w in zip(extended.problem.data, extended.weights, strict=True)]
    groups = configuration_groups(extended.data)
    found, stage = find_good_samples(extended.problem, extended.solution, data, groups, extended.weights)
    # A few are found by their residuals. Many outliers bend the fit towards themselves.
    is_many = np.mean(np.concatenate(found) <= robust.ZERO_WEIGHT) >= MIN_MANY
    return tuple(found) if is_many and stage == robust.REJECTED else fit.weights


def may_mistake_joint_errors(fit: Fit) -> bool:
    """Return whether a robust fit of the geometry may take the errors of joints for outliers."""
    # Samples that were approached from one side agree with each other, and so do those from the other side.
    n_rejected, n_samples = _count_rejected(fit)
    return n_rejected >= MIN_MANY * n_samples


def simpler_explanation(chosen: ExtendedFit, everything: ExtendedFit) -> ExtendedFit:
    """Return the fit of everything if its joint errors explain most of the samples that the other rejects."""
    (few, extension), (many, _) = everything, chosen
    is_better = extension.supported and 2 * _count_rejected(few)[0] <= _count_rejected(many)[0]
    return everything if is_better and _spread(few) <= MAX_NOISE_GROWTH * _spread(many) else chosen


def _count_rejected(fit: Fit) -> tuple[int, int]:
    """Return the number of rejected samples and of all."""
    weights = np.concatenate(fit.weights)
    return int(np.sum(weights <= robust.ZERO_WEIGHT)), len(weights)


def _spread(fit: Fit) -> float:
    """Return the RMS residual of the samples that are not rejected, in their own standard deviations."""
    kept = fit.without_rejected()
    squares = [r**2 for r in kept.problem.residuals(kept.solution.x, kept.data)]
    return float(np.sqrt(sum(each.sum() for each in squares) / sum(each.size for each in squares)))


def with_selected(
    fit: Fit, selected: dict[str, list[ErrorParameter]], model: Model
) -> tuple[Problem, Array, Array]:
    """Add selected families to the problem of a fit; return it with x and the family of each unknown."""
    problem, _, family = _with_families(fit.problem, fit.solution.x, selected)
    x = np.array([model.values[name] for name in _unknown_names(problem)])
    return problem, x if problem.bounds is None else np.clip(x, *problem.bounds), family


def _fit_selected(
    fit: Fit,
    selected: dict[str, list[ErrorParameter]],
    model: Model,
    max_iterations: int,
) -> tuple[Fit, float]:
    """Fit the geometry and selected families at temperature 1."""
    problem, x, family = with_selected(fit, selected, model)
    selected_problem = problem.with_prior_weights(prior_weights(problem, family, model.widths))
    solution = minimize(selected_problem, "lm", x, max_iterations, loose=True)
    trimmed = outlier_weights(problem, solution.x, fit.weights)
    if any((w < 1).any() for w in trimmed):
        problem = problem.with_data(
            [item.with_weights(w) for item, w in zip(problem.data, trimmed, strict=True)]
        )
        selected_problem = problem.with_prior_weights(selected_problem.weights)
        solution = minimize(selected_problem, "lm", solution.x, max_iterations, loose=True)
    weights = tuple(np.maximum(a * b, robust.ZERO_WEIGHT) for a, b in zip(fit.weights, trimmed, strict=True))
    fitted = Fit(fit.data, problem, solution, weights, fit.iterations, fit.stage)
    # `_Candidates` divides the expected weights of its problem by the widths.
    judged = fitted.without_rejected().problem
    rows = NoisyRows((NoiseClass(solution.system, count_rows(judged)),))
    model = _Candidates(judged, solution.x, family, rows).maximize_evidence(model.widths)
    problem = problem.with_prior_weights(prior_weights(problem, family, model.widths))
    return replace(fitted, problem=problem), model.noise


def outlier_weights(problem: Problem, x: Array, previous: Sequence[Array]) -> tuple[Array, ...]:
    """Return the weight of each sample (m,) of each measurement: 1, or hardly any for outliers at x."""
    # Samples of low previous weight do not count for the scale of the residuals.
    weights = []
    for residual, w in zip(problem.residuals(x, problem.data), previous, strict=True):
        is_outlier = robust.standardized_residuals(residual, None, w > 0.5) > robust.OUTLIER_THRESHOLD
        weights.append(np.where(is_outlier, robust.ZERO_WEIGHT, 1.0))
    return tuple(weights)


def _rejection_stage(fit: Fit) -> str:
    """Return the robust stage for outliers that were set apart from the other samples before an extension."""
    # Outliers that only the geometry leaves have all sizes with the families.
    data = [item.with_weights(1 / w) for item, w in zip(fit.problem.data, fit.weights, strict=True)]
    t = [np.empty(0)]
    for residual, w in zip(fit.problem.residuals(fit.solution.x, data), fit.weights, strict=True):
        t.append(robust.standardized_residuals(residual, None, w > 0.5))
    return robust.rejection_stage(np.concatenate(t))


def _noise(fit: Fit) -> float:
    """Return the standard deviation of the whitened residuals of a fit."""
    freedom = count_rows(fit.problem) - effective_parameters(fit.problem, fit.solution)
    return float(np.sqrt(fit.solution.system.cost / max(freedom, 1.0)))


def families_by_stage(names: Iterable[str]) -> list[tuple[str, ...]]:
    """Return the names of families of each stage of selection, in the order of the table of families."""
    chosen = set(names)
    known = [family for family in FAMILIES.values() if family.name in chosen]
    stages = sorted({family.rule.stage for family in known})
    return [tuple(family.name for family in known if family.rule.stage == stage) for stage in stages]


def select_families(
    fit: Fit, names: Sequence[str], factor: FactorFolds = _factor_folds
) -> tuple[tuple[FamilyTrial, ...], Model, float, dict[str, list[ErrorParameter]]]:
    """Select families of joint errors among those of some names."""
    # The function that factors the rows says what is known of their noise. Returned are the trials, the
    # model, the error of random folds relative to that of the geometry, and the parameters of the selected
    # families.
    missing = _missing_parameters(fit.problem, names)
    trials: list[FamilyTrial] = []
    model, random_ratio = Model({}, _noise(fit), float("nan"), {}), float("nan")
    problem, x = fit.problem, fit.solution.x
    low_order = tuple(name for name in missing if not FAMILIES[name].is_curve)
    stages = [(low_order, families_by_stage(low_order))] if low_order else []
    curves = families_by_stage(name for name in missing if FAMILIES[name].is_curve)
    stages += [(names, (names,)) for names in curves]
    physical_families = [family.name for family in FAMILIES.values() if family.rule.is_universal]
    for added, tiers in stages:
        is_curve, orders = FAMILIES[added[0]].is_curve, FAMILIES[added[0]].orders
        if is_curve and not _may_have_curves(problem, x, missing[added[0]], orders):
            break
        families = {
            name: ps for name, ps in missing.items() if name in (*model.widths, *added, *physical_families)
        }
        candidates = _Candidates.with_folds(*_with_families(fit.problem, fit.solution.x, families), factor)
        # From the expected widths: the iteration does not leave a width near zero, which may have been the
        # best one without the families that were added since.
        model = candidates.maximize_evidence(dict.fromkeys(model.widths, 1.0))
        for tier in tiers:
            more, model = _select(candidates, tier, model)
            trials += more
        if model.widths:
            # The arm has errors of its joints: those with a physical cause are shrunk, not selected.
            physical = [name for name in physical_families if name in families and name not in model.widths]
            if physical:
                model = candidates.maximize_evidence({**model.widths, **dict.fromkeys(physical, 1.0)})
            trials = [
                replace(trial, is_selected=True, prior_width=model.widths[trial.family])
                if trial.family in physical
                else trial
                for trial in trials
            ]
            geometry = candidates.cv_error(candidates.maximize_evidence({}))
            random_ratio = candidates.cv_error(model) / geometry if geometry else 1.0
        if is_curve and added[0] not in model.widths:
            break
        problem = replace(candidates.problem, weights=candidates.weights(model.widths) * model.noise)
        x = np.array([model.values.get(name, 0.0) for name in _unknown_names(problem)])
    ordered = tuple(sorted(trials, key=lambda trial: not trial.is_selected))
    return ordered, model, random_ratio, {name: missing[name] for name in model.widths}


def _are_residuals_correlated(fit: Fit, noise: float) -> bool:
    """Check whether neighbouring configurations share an error of the model."""
    if noise < MIN_CORRELATED_NOISE:
        return False
    system = fit.solution.system.scaled(1 / noise)
    return (
        abs(find_residual_correlation(fit.problem, fit.solution.x, system, noise, fit.weights)) > MAX_WHITE_Z
    )


def family_gains(
    solved: Problem, x: Array, weights: Sequence[Array], names: Sequence[str] = LOW_ORDER
) -> dict[str, FamilyGain]:
    """Compute what each of some families that are not in the model would explain of the residuals."""
    data = [item.take(w > robust.ZERO_WEIGHT) for item, w in zip(solved.data, weights, strict=True)]
    data = [item.take(np.s_[:: max(1, -(-len(item.rows) // MAX_HINT_SAMPLES))]) for item in data]
    missing = _missing_parameters(solved, names)
    problem, x, family = _with_families(replace(solved, data=tuple(data)), x, missing)
    system, n_rows = linearize_and_factor(problem, x, small_angle=False), count_rows(problem)
    before = solve_columns(system, problem.weights, x, family == "")[1]
    gains = {}
    for name in missing:
        columns = (family == "") | (family == name)
        added, remaining = int(np.sum(family == name)), n_rows - int(np.sum(columns))
        after = solve_columns(system, problem.weights, x, columns)[1]
        if remaining > 0 and after > 0:
            gain = float(max((before - after) / (after / remaining), 0.0))
            if np.isfinite(gain):
                gains[name] = FamilyGain(gain, added, remaining)
    return gains


def family_hint(solved: Problem, x: Array, weights: Sequence[Array]) -> str:
    """Suggest an extension if one family explains a significant part of the residuals."""
    best = MAX_HINT_RATIO, ""
    for name, each in family_gains(solved, x, weights).items():
        if each.is_significant and each.remaining >= MIN_ROWS_PER_PARAMETER * each.added:
            best = min(best, (each.ratio, name))
    ratio, name = best
    return name and (
        f"residuals vary with the joint values ({FAMILIES[name].description}?); "
        f"--extend auto may reduce them by about {100 * (1 - ratio):.0f} %"
    )


def is_restricted(sets: Sequence[str]) -> bool:
    """Check whether parameter sets describe the robot, but fewer of its errors than `FULL_SET`."""
    chosen, frames = set(sets), {"base", "tool"}
    # The poses of cameras and boards take the place of base and tool.
    has_frames = frames <= chosen or {"camera", "board"} <= chosen
    is_full = has_frames and {"minimal", "placement", LOW_COST} & chosen
    return not is_full and not chosen <= frames
