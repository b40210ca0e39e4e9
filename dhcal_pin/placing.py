"""Base and tool alone, fitted to measurements: where a calibration starts, and what it is compared with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from .chain import BASE, Chain
from .error_model import ErrorModel
from .frames import few, misfit, starts
from .measurements import Measurement
from .problem import Problem, shared_unknowns
from .se3 import Array
from .solver import last_step, levenberg_marquardt

# Starts for the frames are tried until one leaves so small a share of the positions' spread.
GOOD_FIT = 0.01


def problem_of(
    errors: ErrorModel, data: tuple[Measurement, ...], weights: Array, known: Mapping[str, float]
) -> Problem:
    """The problem whose instruments have their own wide priors where the robot has any, weights (p,)."""
    wide = np.array([1 / unknown.prior for unknown in shared_unknowns(data) if unknown.name not in known])
    return Problem(errors, data, np.concatenate([weights, wide * np.any(weights)]), known)


def _fitted(
    frames: ErrorModel, data: tuple[Measurement, ...], known: Mapping[str, float], max_iterations: int
) -> tuple[float, Chain]:
    """The chain with the frames that fit the data best, and about the cost that they leave."""
    data = tuple(item.started(frames.chain) for item in data)
    problem = problem_of(frames, data, 1 / frames.priors, known)
    nominal = np.zeros(len(problem.weights))
    solution = levenberg_marquardt(problem, nominal, max_iterations, None, nearly=True)
    cost = solution.triangle.cost + float(np.sum((problem.weights * solution.x) ** 2))
    return cost, frames.at(last_step(problem, solution)[: len(frames.parameters)])


def placed(
    errors: ErrorModel, data: tuple[Measurement, ...], known: Mapping[str, float], max_iterations: int
) -> ErrorModel:
    """The same unknowns on the nominal chain with its unknown base and tool about where the data have them.

    Where positions tell starts, samples enough for one choose among them and carry it on.
    """
    frames = errors.frames()
    if frames is None:
        return errors
    stations = {p.station for p in frames.parameters}
    some = tuple(few(item) for item in data)
    best: tuple[float, Chain] | None = None
    for start in starts(errors.chain, some, BASE in stations, errors.chain.tool_station in stations):
        found = _fitted(replace(frames, chain=start), some, known, max_iterations)
        best = found if best is None else min(best, found, key=lambda each: each[0])
        if misfit(best[1], some) < GOOD_FIT:
            break
    best = best or _fitted(frames, data, known, max_iterations)
    return replace(errors, chain=best[1])


def refitted(errors: ErrorModel, data: tuple[Measurement, ...], known: Mapping[str, float]) -> Chain:
    """The nominal chain with its unknown base and tool where all the data have them."""
    frames = errors.frames()
    if frames is None:
        return errors.chain.loaded()
    return _fitted(replace(frames, chain=errors.chain.loaded()), data, known, 100)[1]
