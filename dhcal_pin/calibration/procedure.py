"""From a nominal chain and measurements to a calibrated one."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from .._typing import Array
from ..estimation import robust
from ..estimation.parameters import select_parameters
from ..estimation.priors import PriorGroups, Priors, has_default_prior, prior_weights
from ..estimation.problem import Problem, merge_instrument_parameters
from ..estimation.solver import METHODS, Progress, minimize
from ..exceptions import DhcalError
from ..measurements.base import Measurement
from ..parallel import SERIAL, TaskExecutor
from ..robot.chain import BASE_FRAME, Chain
from .initialization import fit_frames, initialize_frames, make_problem
from .result import Result
from .reweighting import Fit, reweight
from .shrinkage import compute_shrinkage_factor

Method = Literal["lm", "gn"]


def _bounds(problem: Problem, bounds: Mapping[str, tuple[float, float]]) -> Array:
    """Least and largest x (2, p+s) of values that are bounded by name."""
    outside = (BASE_FRAME, problem.errors.chain.tool_frame_index)
    inside = [p for p in problem.errors.parameters if p.error_frame not in outside]
    out = np.tile([[-np.inf], [np.inf]], len(problem.weights))
    for pattern, (low, high) in bounds.items():
        hit = [p for p in inside if fnmatch.fnmatchcase(p.name, pattern)]
        if not hit:
            raise DhcalError(
                f"bounds for {pattern!r}: no such parameter; there are {', '.join(p.name for p in inside)}"
            )
        for p in hit:
            if not low <= p.nominal <= high:
                raise DhcalError(
                    f"bounds for {pattern!r}: {low} to {high} must hold the nominal {p.nominal:g} of {p.name}"
                )
            out[:, problem.errors.parameters.index(p)] = low - p.nominal, high - p.nominal
    return out


def _validated_known(data: tuple[Measurement, ...], known: Mapping[str, float]) -> Mapping[str, float]:
    """The known values, after checking that each belongs to an unknown of the data."""
    names = [unknown.name for unknown in merge_instrument_parameters(data) if not unknown.is_local]
    for name, value in known.items():
        if name not in names:
            there = f"there are {', '.join(names)}" if names else "these measurements bring none"
            raise DhcalError(f"known {name!r}: no unknown of an instrument; {there}")
        if not np.isfinite(value):
            raise DhcalError(f"known {name!r}: {value} is not a finite number")
    return known


def calibrate(
    chain: Chain,
    data: Measurement | Sequence[Measurement],
    parameters: str | Iterable[str] | None = None,
    *,
    method: Method = "lm",
    priors: Priors | None = None,
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    holdout: Sequence[Measurement] = (),
    known: Mapping[str, float] | None = None,
    loss: str = "auto",
    bounds: Mapping[str, tuple[float, float]] | None = None,
    max_iterations: int = 100,
    progress: Progress | None = None,
    executor: TaskExecutor = SERIAL,
) -> Result:
    """Identify a chain's errors from measurements.

    Args:
        chain: the nominal robot.
        data: one measurement or several of any kinds.
        parameters: sets of `parameters.SETS`; the chain's own default without it.
        method: "lm", or "gn" for the paper's loop, which weighs metres and radians alike.
        priors: "default", "none", or sigmas by parameter name or pattern over the default ones, each in
            its parameter's unit. Without it "default" for lm and "none" for gn.
        fix: parameters or sets held at nominal.
        free: single parameters of any set added.
        holdout: measurements to judge by, not fitted.
        known: values in m and rad of instruments' unknowns by name, such as a surveyed anchor
            `wire1.x`; they are held.
        loss: "auto" lets every sample count alike but gross errors, which count for nothing; "linear" lets
            them count, "huber", "cauchy" and "tukey" weigh by size. "auto" is "linear" with the paper's loop.
        bounds: least and largest values in m and rad by the names or patterns of the robot's parameters;
            base and tool stay free.
        max_iterations: most steps of a loop.
        progress: called with the iteration and the cost.
        executor: what chunks of many samples are shared out to.

    Sigmas that no instrument states are estimated with the fit, a group of rows at a time, and default
    priors take the size of the errors that are found, so that data and priors weigh right against each
    other. Readings without a length leave the arm's size to others, and to the priors.

    Raises:
        DhcalError: no data, unknown names, or a plain Gauss-Newton loop that runs away.
    """
    data = tuple(data) if isinstance(data, Sequence) else (data,)
    _check_options(data, method, loss, bounds)
    for item in (*data, *holdout):
        chain.validated_q(item.configurations())
    priors = priors if priors is not None else ("none" if method == "gn" else "default")
    errors = select_parameters(chain, parameters if parameters is not None else chain.parameters, fix, free)
    known = _validated_known(data, known or {})
    errors = initialize_frames(errors, data, known, max_iterations)
    data = tuple(item.initialized(errors.chain) for item in data)
    problem = replace(make_problem(errors, data, prior_weights(errors, priors), known), executor=executor)
    if bounds:
        problem = replace(problem, bounds=_bounds(problem, bounds))
    fit = _solve(problem, method, max_iterations, progress)
    kept = 1.0
    if method == "lm":
        families = PriorGroups.from_expected(errors, problem.weights, has_default_prior(errors, priors))
        fit = reweight(fit, loss, families, max_iterations, progress)
        kept = compute_shrinkage_factor(fit.problem, fit.solution, families.groups())
    return _result(fit, kept, tuple(holdout), method)


def _check_options(
    data: Sequence[Measurement],
    method: str,
    loss: str,
    bounds: Mapping[str, tuple[float, float]] | None,
) -> None:
    """Raise DhcalError if there are no data or options contradict each other."""
    if not sum(len(item.rows) for item in data):
        raise DhcalError("no measurements to fit")
    if method not in METHODS:
        raise DhcalError(f"method {method!r}: choose from {', '.join(METHODS)}")
    if loss not in robust.LOSSES:
        raise DhcalError(f"loss {loss!r}: choose from {', '.join(robust.LOSSES)}")
    if loss not in ("auto", "linear") and method != "lm":
        raise DhcalError(f"loss {loss!r} needs method lm; the paper's loop weighs all rows alike")
    if bounds and method != "lm":
        raise DhcalError("bounds need method lm; the paper's loop knows none")


def _solve(problem: Problem, method: Method, max_iterations: int, progress: Progress | None) -> Fit:
    """Solve a problem with unit weights; `reweight` iterates method "lm" to full convergence later."""
    options = {"loose": True} if method == "lm" else {}
    solution = minimize(problem, method, None, max_iterations, progress, **options)
    weights = tuple(np.ones(len(item.rows)) for item in problem.data)
    fit = Fit(problem.data, problem, solution, weights)
    errors = problem.errors
    if not errors.has_transmission:
        return fit
    # The gravity torques depend on the arm that was found: solve again with those.
    problem = replace(problem, errors=errors.with_current_loads(solution.x[: len(errors.parameters)]))
    again = minimize(problem, method, solution.x, max_iterations, progress, **options)
    return replace(fit, problem=problem, solution=again, previous_iterations=solution.iterations)


def _result(fit: Fit, kept: float, holdout: tuple[Measurement, ...], method: str) -> Result:
    """Build the result from a fit and the fraction of its correction that is kept."""
    problem, errors = fit.problem, fit.problem.errors
    x = kept * fit.solution.x
    if kept:
        found = errors.at(x[: len(errors.parameters)]).with_current_loads()
    else:
        found = fit_frames(errors, fit.data, problem.known)
    return Result(
        errors=errors,
        x=x,
        chain=found,
        data=fit.data,
        holdout=holdout,
        problem=problem,
        solution=replace(fit.solution, iterations=fit.iterations),
        method=method,
        weights=fit.weights,
        shrinkage_factor=kept,
    )
