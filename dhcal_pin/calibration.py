"""From a nominal chain and measurements to a calibrated one."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from . import observability
from .chain import BASE, Chain
from .errors import DhcalError
from .frames import starts
from .measurements import Measurement
from .parameters import ErrorModel, select
from .result import Result
from .se3 import Array
from .solver import METHODS, Problem, Progress, Solution, levenberg_marquardt, shared_unknowns

Method = Literal["lm", "gn"]
Priors = Literal["default", "none"] | Mapping[str, float]

# Sigmas are not estimated below a nanometre and a nanoradian.
LEAST_SCALE = 1e-6


def _prior_weights(errors: ErrorModel, priors: Priors) -> Array:
    if isinstance(priors, str):
        if priors not in ("default", "none"):
            raise DhcalError(f"priors {priors!r}: choose default, none, or sigmas by name")
        return 1 / errors.priors if priors == "default" else np.zeros(len(errors.parameters))
    sigma = errors.priors.copy()
    names = [p.name for p in errors.parameters]
    for pattern, value in priors.items():
        hit = [i for i, name in enumerate(names) if fnmatch.fnmatchcase(name, pattern)]
        if not hit:
            raise DhcalError(f"prior for {pattern!r}: no such parameter; there are {', '.join(names)}")
        if not value > 0:
            raise DhcalError(f"prior for {pattern!r}: {value} must be positive, in m or rad")
        sigma[hit] = value
    return 1 / sigma


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


def _place(errors: ErrorModel, data: tuple[Measurement, ...], max_iterations: int) -> Chain:
    """The nominal chain with its unknown base and tool as they fit the data best."""
    frames = errors.frames()
    if frames is None:
        return errors.chain
    stations = {p.station for p in frames.parameters}
    best: tuple[float, Chain] | None = None
    for start in starts(errors.chain, data, BASE in stations, errors.chain.tool_station in stations):
        placed = replace(frames, chain=start)
        problem = _problem(placed, tuple(item.started(start) for item in data), 1 / placed.priors)
        solution = levenberg_marquardt(problem, np.zeros(len(problem.weights)), max_iterations, None)
        cost = problem.cost(solution.x)
        if best is None or cost < best[0]:
            best = cost, placed.at(solution.x[: len(placed.parameters)])
    assert best is not None
    return best[1]


def _problem(errors: ErrorModel, data: tuple[Measurement, ...], weights: Array) -> Problem:
    """The problem whose instruments have their own wide priors where the robot has any."""
    wide = np.array([1 / unknown.prior for unknown in shared_unknowns(data)])
    return Problem(errors, data, np.concatenate([weights, wide * np.any(weights)]))


def _scatter(problem: Problem, solution: Solution, data: tuple[Measurement, ...]) -> Array:
    """How many of its sigmas each group of rows scatters in the fit, all items' groups in a row (g,).

    One where the instrument states its sigmas, or where there are not more rows than directions seen.
    """
    chain = problem.errors.at(solution.x[: len(problem.errors.parameters)])
    residuals = [
        item.residual(chain.sweep(item.configurations()), problem.values(item, solution.x)) for item in data
    ]
    share = 1 - observability.rank(solution.triangle.r) / sum(r.size for r in residuals)
    return np.array(
        [
            1.0
            if item.stated or share <= 0
            else max(float(np.sqrt(np.mean(residual[rows] ** 2) / share)), LEAST_SCALE)
            for item, residual in zip(data, residuals, strict=True)
            for rows in item.groups.values()
        ]
    )


def _scaled(data: tuple[Measurement, ...], scales: Array) -> tuple[Measurement, ...]:
    left = iter(scales.tolist())
    return tuple(item.scaled({name: next(left) for name in item.groups}) for item in data)


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
    max_iterations: int = 100,
    progress: Progress | None = None,
) -> Result:
    """Identify a chain's errors from measurements.

    Args:
        chain: the nominal robot.
        data: one measurement or several of any kinds.
        parameters: sets of `parameters.SETS`; the chain's own default without it.
        method: "lm", or "gn" for the paper's loop, which weighs metres and radians alike.
        priors: "default", "none", or sigmas in m and rad by parameter name or pattern over the default
            ones. Without it "default" for lm and "none" for gn.
        fix: parameters or sets held at nominal.
        free: single parameters of any set added.
        holdout: measurements to judge by, not fitted.
        max_iterations: most steps of a loop.
        progress: called with the iteration and the cost.

    Sigmas that no instrument states are estimated with the fit, a group of rows at a time, so that
    data and priors weigh right against each other.

    Raises:
        DhcalError: no data, unknown names, or a plain Gauss-Newton loop that runs away.
    """
    data = tuple(data) if isinstance(data, Sequence) else (data,)
    if not sum(len(item.rows) for item in data):
        raise DhcalError("no measurements to fit")
    if method not in METHODS:
        raise DhcalError(f"method {method!r}: choose from {', '.join(METHODS)}")
    for item in (*data, *holdout):
        chain.checked(item.configurations())
    priors = priors if priors is not None else ("none" if method == "gn" else "default")
    errors = select(chain, parameters if parameters is not None else chain.parameters, fix, free)
    reference = _place(errors, data, max_iterations)
    errors = replace(errors, chain=reference)
    data = tuple(item.started(reference) for item in data)
    problem = _problem(errors, data, _prior_weights(errors, priors))
    solution = METHODS[method](problem, np.zeros(len(problem.weights)), max_iterations, progress)
    if method == "lm":
        # Weights that the fit itself tells: a few rounds settle them.
        scales = np.ones(sum(len(item.groups) for item in data))
        for _ in range(8):
            found = _scatter(problem, solution, data)
            if np.abs(np.log(found / scales)).max() < 0.01:
                break
            scales = found
            problem = replace(problem, data=_scaled(data, scales))
            again = levenberg_marquardt(problem, solution.x, max_iterations, progress)
            solution = replace(again, iterations=solution.iterations + again.iterations)
    return Result(
        errors=errors,
        x=solution.x,
        chain=errors.at(solution.x[: len(errors.parameters)]),
        reference=reference,
        data=data,
        holdout=tuple(holdout),
        problem=problem,
        solution=solution,
        method=method,
    )
