"""From a nominal chain and measurements to a calibrated one."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from .._typing import Array
from ..estimation import robust
from ..estimation.parameters import select
from ..estimation.priors import Families, Priors, are_default, prior_weights, rescaled
from ..estimation.problem import Problem, shared_unknowns
from ..estimation.robust import studentized_residuals
from ..estimation.solver import METHODS, Progress, levenberg_marquardt
from ..exceptions import DhcalError
from ..measurements.base import Measurement
from ..parallel import HERE, Workers
from ..robot.chain import BASE, Chain
from .initialization import placed, problem_of, refitted
from .result import Result
from .reweighting import MOST_ROUNDS, estimate_variance_components, with_sigma_scales
from .shrinkage import kept_share

Method = Literal["lm", "gn"]


def _bounds(problem: Problem, bounds: Mapping[str, tuple[float, float]]) -> Array:
    """Least and largest x (2, p+s) of values that are bounded by name."""
    outside = (BASE, problem.errors.chain.tool_station)
    inside = [p for p in problem.errors.parameters if p.station not in outside]
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


def split(
    data: Sequence[Measurement], fraction: float, seed: int = 0
) -> tuple[tuple[Measurement, ...], tuple[Measurement, ...]]:
    """Fit and hold-out parts of each measurement, at random by seed."""
    if not 0 <= fraction < 1:
        raise DhcalError(f"holdout {fraction}: must be a share between 0 and 1")
    rng = np.random.default_rng(seed)
    fit, held = [], []
    for item in data:
        order = rng.permutation(len(item.rows))
        count = round(fraction * len(order))
        held.append(item.take(np.sort(order[:count])))
        fit.append(item.take(np.sort(order[count:])))
    return tuple(fit), tuple(item for item in held if len(item.rows))


def _known(data: tuple[Measurement, ...], known: Mapping[str, float]) -> Mapping[str, float]:
    """The known values, after checking that each belongs to an unknown of the data."""
    names = [unknown.name for unknown in shared_unknowns(data) if not unknown.local]
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
    where: Workers = HERE,
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
        where: what chunks of many samples are shared out to.

    Sigmas that no instrument states are estimated with the fit, a group of rows at a time, and default
    priors take the size of the errors that are found, so that data and priors weigh right against each
    other. Readings without a length leave the arm's size to others, and to the priors.

    Raises:
        DhcalError: no data, unknown names, or a plain Gauss-Newton loop that runs away.
    """
    data = tuple(data) if isinstance(data, Sequence) else (data,)
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
    for item in (*data, *holdout):
        chain.checked(item.configurations())
    priors = priors if priors is not None else ("none" if method == "gn" else "default")
    errors = select(chain, parameters if parameters is not None else chain.parameters, fix, free)
    known = _known(data, known or {})
    errors = placed(errors, data, known, max_iterations)
    data = tuple(item.started(errors.chain) for item in data)
    problem = replace(problem_of(errors, data, prior_weights(errors, priors), known), where=where)
    if bounds:
        problem = replace(problem, bounds=_bounds(problem, bounds))
    default = are_default(errors, priors)
    # Until sigmas and priors are settled, too, where the loop nearly ends is enough.
    loop = partial(levenberg_marquardt, nearly=True) if method == "lm" else METHODS[method]
    solution, earlier = loop(problem, np.zeros(len(problem.weights)), max_iterations, progress), 0
    if errors.is_driven:
        # Gravity's torques follow the arm as found: once more with those.
        errors = errors.loaded(solution.x[: len(errors.parameters)])
        problem = replace(problem, errors=errors)
        earlier = solution.iterations
        solution = loop(problem, solution.x, max_iterations, progress)
    weights, kept = [np.ones(len(item.rows)) for item in data], 1.0
    if method == "lm":
        # Sigmas and weights that the fit itself tells: a few rounds settle them.
        scales = np.ones(sum(len(item.groups) for item in data))
        expected, ended = problem.weights, False
        families = Families.of(errors, expected, default)
        (how, *later), moved = robust.LOSSES[loss], np.inf
        for left in reversed(range(MOST_ROUNDS)):
            found = estimate_variance_components(problem, solution, data, weights)
            weighed = with_sigma_scales(data, found)
            if how == "all":
                moved = 0.0
            else:
                score = studentized_residuals(problem, solution, weighed, weights)
                weights, moved = robust.reweighted(weights, score, how, moved)
                weighed = tuple(item.weighted(w) for item, w in zip(weighed, weights, strict=True))
            priors_now = rescaled(problem, solution, families)
            changes = np.log(found / scales), (priors_now - problem.weights) / np.fmax(expected, 1e-300)
            settled = max(moved, *(np.abs(change).max(initial=0.0) for change in changes)) < 0.01
            if settled and later:
                if how != "all" or any(
                    map(robust.suspect, studentized_residuals(problem, solution, weighed, weights))
                ):
                    (how, *later), moved = later, np.inf
                    continue
                later = []
            if settled and ended:
                break
            ended = settled or left < 2
            if settled or all(new is old for new, old in zip(weighed, problem.data, strict=True)):
                problem, going_on = problem.held(priors_now), solution
            else:
                problem = problem.of(weighed).held(priors_now)
                scales, going_on, earlier = found, None, earlier + solution.iterations
            loop = partial(levenberg_marquardt, before=going_on, nearly=not ended)
            solution = loop(problem, solution.x, max_iterations, progress)
        kept = kept_share(problem, solution, families.groups())
    x = kept * solution.x
    found = errors.at(x[: len(errors.parameters)]).loaded() if kept else refitted(errors, data, known)
    return Result(
        errors=errors,
        x=x,
        chain=found,
        data=data,
        holdout=tuple(holdout),
        problem=problem,
        solution=replace(solution, iterations=earlier + solution.iterations),
        method=method,
        weights=tuple(weights),
        kept=kept,
    )
