"""Where the instrument stands and where its target sits: starts for base and tool without a guess."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from .. import se3
from .._typing import Array
from ..estimation.error_model import ErrorModel
from ..estimation.problem import Problem, merge_instrument_parameters
from ..estimation.solver import minimize, next_iterate
from ..measurements.base import Measurement
from ..robot.chain import BASE_FRAME, Chain
from ..se3 import nearest_rotation

# Tool offsets tried where the target's place on the tip is unknown, in metres.
_TOOL_OFFSET = 0.25


# Samples of each measurement that a start needs.
_MAX_SAMPLES = 100


# The most promising of them are followed to the end.
_MAX_CANDIDATES = 4


def align(source: Array, target: Array) -> tuple[Array, Array]:
    """Rigid motions (..., 4, 4) that carry points (..., m, 3) best onto others (m, 3); RMS distances, m."""
    centre, goal = source.mean(-2), target.mean(0)
    out, wanted = source - centre[..., None, :], target - goal
    product = wanted.T @ out
    rotation = nearest_rotation(product)
    motion = se3.transform(rotation, goal - (rotation @ centre[..., None])[..., 0])
    # |R·s - t|² of points about their middles.
    rest = np.vdot(wanted, wanted) + np.sum(out**2, (-2, -1)) - 2 * np.sum(rotation * product, (-2, -1))
    return motion, np.sqrt(np.maximum(rest, 0.0) / len(target))


def subsample(item: Measurement) -> Measurement:
    """So many of a measurement's samples as a start needs, drawn so that no order in them matters."""
    return item.take(np.sort(np.random.default_rng(0).permutation(len(item.rows))[:_MAX_SAMPLES]))


def candidate_frames(chain: Chain, data: Sequence[Measurement], base: bool, tool: bool) -> Iterator[Chain]:
    """Chains with base and tool placed from the measured positions, the most promising first.

    Positions alone carry the base; rotations, where there are any, then give the tool's. The target's
    offset is tried at places around the tip. Fewer than three positions tell no start.
    """
    readings = [item for item in data if len(item.positions())]
    bare = chain.with_base_and_tool(np.eye(4), np.eye(4))
    tips = [bare.poses(item.q) for item in readings]
    if sum(len(pose) for pose in tips) < 3 or not (base or tool):
        return
    tip = np.concatenate(tips)
    seen = np.concatenate([item.positions() for item in readings])
    if not base:
        # From a known base the target is seen in the tip's frame directly.
        local = se3.inverse(chain.base @ tip)
        offset = np.mean((local[:, :3, :3] @ seen[..., None])[..., 0] + local[:, :3, 3], 0)
        best = [(chain.base, offset)]
    else:
        steps = [0.0, -_TOOL_OFFSET, _TOOL_OFFSET]
        grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
        offsets = grid if tool else chain.tool[None, :3, 3]
        points = tip[:, :3, 3] + (tip[:, :3, :3] @ offsets.T).transpose(2, 0, 1)
        motions, rests = align(points, seen)
        best = [(motions[k], offsets[k]) for k in np.argsort(rests, kind="stable")[:_MAX_CANDIDATES]]
    for motion, offset in best:
        turn = chain.tool[:3, :3]
        turns = [
            np.swapaxes((motion @ pose)[:, :3, :3], 1, 2) @ item.rotations()
            for pose, item in zip(tips, readings, strict=True)
            if len(item.rotations())
        ]
        if tool and turns:
            turn = nearest_rotation(np.concatenate(turns).sum(0))
        yield chain.with_base_and_tool(motion, se3.transform(turn, offset))


def relative_misfit(chain: Chain, data: Sequence[Measurement]) -> float:
    """RMS distance of the measured positions from the chain's, over that from their own middle."""
    readings = [item for item in data if len(item.positions())]
    seen = np.concatenate([item.positions() for item in readings])
    modelled = np.concatenate([chain.poses(item.q)[:, :3, 3] for item in readings])
    return float(np.linalg.norm(seen - modelled) / np.linalg.norm(seen - seen.mean(0)))


# Starts for the frames are tried until one leaves so small a share of the positions' spread.
GOOD_RELATIVE_MISFIT = 0.01


def make_problem(
    errors: ErrorModel, data: tuple[Measurement, ...], weights: Array, known: Mapping[str, float]
) -> Problem:
    """The problem whose instruments have their own wide priors where the robot has any, weights (p,)."""
    wide = np.array(
        [1 / unknown.prior for unknown in merge_instrument_parameters(data) if unknown.name not in known]
    )
    return Problem(errors, data, np.concatenate([weights, wide * np.any(weights)]), known)


def _fit_frames(
    frames: ErrorModel, data: tuple[Measurement, ...], known: Mapping[str, float], max_iterations: int
) -> tuple[float, Chain]:
    """The chain with the frames that fit the data best, and about the cost that they leave."""
    data = tuple(item.initialized(frames.chain) for item in data)
    problem = make_problem(frames, data, 1 / frames.priors, known)
    solution = minimize(problem, max_iterations=max_iterations, loose=True)
    cost = solution.system.cost + float(np.sum((problem.weights * solution.x) ** 2))
    return cost, frames.at(next_iterate(problem, solution)[: len(frames.parameters)])


def initialize_frames(
    errors: ErrorModel, data: tuple[Measurement, ...], known: Mapping[str, float], max_iterations: int
) -> ErrorModel:
    """The same unknowns on the nominal chain with its unknown base and tool about where the data have them.

    Where positions tell starts, samples enough for one choose among them and carry it on.
    """
    frames = errors.only_frames()
    if frames is None:
        return errors
    stations = {p.error_frame for p in frames.parameters}
    some = tuple(subsample(item) for item in data)
    best: tuple[float, Chain] | None = None
    for start in candidate_frames(
        errors.chain, some, BASE_FRAME in stations, errors.chain.tool_frame_index in stations
    ):
        found = _fit_frames(replace(frames, chain=start), some, known, max_iterations)
        best = found if best is None else min(best, found, key=lambda each: each[0])
        if relative_misfit(best[1], some) < GOOD_RELATIVE_MISFIT:
            break
    best = best or _fit_frames(frames, data, known, max_iterations)
    return replace(errors, chain=best[1])


def fit_frames(errors: ErrorModel, data: tuple[Measurement, ...], known: Mapping[str, float]) -> Chain:
    """The nominal chain with its unknown base and tool where all the data have them."""
    frames = errors.only_frames()
    if frames is None:
        return errors.chain.with_current_loads()
    return _fit_frames(replace(frames, chain=errors.chain.with_current_loads()), data, known, 100)[1]
