"""Initialization of unknown base and tool frames from the measurements, without a guess by the user.

The base frame B places the robot in the measuring frame, the tool frame (rotation R_T, offset t) places the
measured target on the tip. With F_i the tip pose of the nominal robot, a sample measures a position p_i,
and for a pose also a rotation R_i:

    p_i ≈ B·(F_i·t),    R_i ≈ R_B·R_Fi·R_T.

1. For a fixed offset t, the base has a closed form: the rigid motion that aligns the points F_i·t with the
   p_i in the least-squares sense, from the singular value decomposition of their covariance (Kabsch 1976;
   Arun, Huang and Blostein 1987).
2. If t is unknown, it is first tried at the tip, then on a grid of 26 points around it, from which the best
   candidates are kept.
3. The tool rotation is the mean of R_Fiᵀ·R_Bᵀ·R_i, projected on the rotations.
4. The first candidate that agrees with the positions is kept. All others are refined by a nonlinear fit of
   the frames alone, and the best one is kept.
5. If even the best candidate disagrees with the positions, some of them may be gross mistakes, which ruin any
   least-squares start. Samples that disagree with a majority are left out then, and steps 1 to 4 repeated.

Step 5 uses that the equations are linear in the entries of A = R_Bᵀ, in c = R_Bᵀ·b with the position b of the
base, and in t, if A need not be a rotation:

    A·p_i - c - R_Fi·t = f_i,       f_i the position of F_i.

The majority is that of least trimmed squares (Rousseeuw and Van Driessen 2006): fits to random subsets, each
followed by fits to the half of the samples with the smallest distances.

Lengths and contacts do not measure positions. Base and tool are then fitted together with the
instruments, from several tool offsets of the same grid (`compare_tools`). If the tool points lie near a
plane, an anchor and its mirror image have nearly the same distances; if they lie near a line, a whole
circle of anchors has. The cost of a fit of all unknowns decides between such images
(`compare_mirror_images`).

Positions come first because they determine the base even if the orientations hardly vary. A start from the
rotations (hand-eye calibration) then ends in a wrong minimum.

`fit_frames` is also used to compare the accuracy before and after a calibration: the nominal robot, with the
base and tool frames that fit the same measurements best.

Shapes: m samples, n joints, p unknowns of the robot.

References:
    W. Kabsch, A Solution for the Best Rotation to Relate Two Sets of Vectors, Acta Cryst. A 32, 1976.
    P. J. Rousseeuw and K. Van Driessen, Computing LTS Regression for Large Data Sets, DMKD 12, 2006.
    K. Arun, T. Huang and S. Blostein, Least-Squares Fitting of Two 3-D Point Sets, IEEE PAMI 9, 1987.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, islice, product

import numpy as np

from .. import se3
from .._typing import Array
from ..measurements.base import Measurement
from ..measurements.position import PointMeasurement
from ..robot.chain import BASE_FRAME, Chain
from ..se3 import nearest_rotation
from .error_model import ErrorModel
from .problem import Problem, linear_system, merge_instrument_parameters
from .qr import sum_of_squares
from .solver import SolverResult, complete, minimize

# Spacing of the grid of tool offsets that are tried [m].
_TOOL_OFFSET = 0.25
# Largest number of samples, or of images, of each measurement that candidates are computed from.
_MAX_SAMPLES = 100
# Number of candidates that are refined by a fit.
_MAX_CANDIDATES = 4
# No further candidates are tried once the relative misfit of the best one is below this.
GOOD_RELATIVE_MISFIT = 0.01
# Number of random subsets of samples, and of fits to the better half of the samples that follow each of them.
_N_SUBSETS, _N_CONCENTRATIONS = 300, 4
# A sample disagrees with a majority if its distance is more than this multiple of the majority's.
_MAX_DISTANCE_RATIO = 10.0
# Fraction of the largest information below which a direction of the linear equations is held at zero.
_MIN_INFORMATION = 1e-10
# Largest number of combinations of mirror images that are compared.
_MAX_MIRRORED = 64
# Smallest relative reduction of the cost by a mirror image; loose solutions of one minimum differ by less.
_MIN_COST_REDUCTION = 0.02
# Largest number of iterations of a fit of the frames to all data.
_MAX_ITERATIONS = 100


def align(source: Array, target: Array) -> tuple[Array, Array]:
    """Return the motions (..., 4, 4) that align points with others (m, 3) best, and RMS distances [m]."""
    source_mean, target_mean = source.mean(-2), target.mean(0)
    a, b = source - source_mean[..., None, :], target - target_mean
    product = b.T @ a
    rotation = nearest_rotation(product)
    motion = se3.transform(rotation, target_mean - (rotation @ source_mean[..., None])[..., 0])
    # Sum of |R·a - b|² of the centred points.
    cost = np.vdot(b, b) + np.sum(a**2, (-2, -1)) - 2 * np.sum(rotation * product, (-2, -1))
    return motion, np.sqrt(np.maximum(cost, 0.0) / len(target))


def subsample(item: Measurement) -> Measurement:
    """Take at most 100 samples or whole images, drawn at random from the order of their joint values."""
    order = np.lexsort(item.q.T[::-1])
    if not item.n_images:
        return item.take(np.sort(_drawn(order)))
    names, first = np.unique(item.sample_groups[order], return_index=True)
    return item.take(np.flatnonzero(np.isin(item.sample_groups, _drawn(names[np.argsort(first)]))))


def _drawn(numbers: Array) -> Array:
    """Return at most 100 numbers (m,), drawn at random."""
    return numbers[np.random.default_rng(0).permutation(len(numbers))[:_MAX_SAMPLES]]


def measured_at_end(item: Measurement) -> tuple[Array, Array]:
    """Return measured positions (m, 3) [m] and rotations (m, 3, 3) as with base and tool of the end."""
    positions, rotations, conditions = item.positions(), item.rotations(), item.conditions()
    # Positions alone do not show where the tool moved.
    if conditions.tool_motion is not None and len(rotations):
        back = se3.inverse(conditions.tool_motion)
        positions = positions + (rotations @ back[:, :3, 3:])[..., 0]
        rotations = rotations @ back[:, :3, :3]
    if conditions.base_motion is not None and len(positions):
        back = se3.inverse(conditions.base_motion)
        positions = (back[:, :3, :3] @ positions[..., None])[..., 0] + back[:, :3, 3]
        rotations = back[: len(rotations), :3, :3] @ rotations
    return positions, rotations


def candidate_frames(
    chain: Chain, data: Sequence[Measurement], is_base_unknown: bool, is_tool_unknown: bool
) -> Iterator[Chain]:
    """Generate chains with frames from at least three measured positions, the best aligned first."""
    with_positions = [item for item in data if len(item.positions())]
    bare = chain.with_base_and_tool(np.eye(4), np.eye(4))
    tips = [bare.poses(item.conditions().of_arm) for item in with_positions]
    if sum(len(pose) for pose in tips) < 3 or not (is_base_unknown or is_tool_unknown):
        return
    tip = np.concatenate(tips)
    positions, measured_rotations = zip(*map(measured_at_end, with_positions), strict=True)
    measured = np.concatenate(positions)
    for base, offset in _aligned_frames(chain, tip, measured, is_base_unknown, is_tool_unknown):
        rotation = chain.tool[:3, :3]
        rotations = [
            np.swapaxes((base @ pose)[:, :3, :3], 1, 2) @ each
            for pose, each in zip(tips, measured_rotations, strict=True)
            if len(each)
        ]
        if is_tool_unknown and rotations:
            rotation = nearest_rotation(np.concatenate(rotations).sum(0))
        yield chain.with_base_and_tool(base, se3.transform(rotation, offset))


def _aligned_frames(
    chain: Chain, tip: Array, measured: Array, is_base_unknown: bool, is_tool_unknown: bool
) -> Iterator[tuple[Array, Array]]:
    """Generate base frames (4, 4) and tool offsets (3,) that align the tip poses (m, 4, 4) with positions."""
    if not is_base_unknown:
        # With a known base the target is measured directly in the tip frame.
        local = se3.inverse(chain.base @ tip)
        yield chain.base, np.mean((local[:, :3, :3] @ measured[..., None])[..., 0] + local[:, :3, 3], 0)
        return
    for offsets in _tool_offsets() if is_tool_unknown else [chain.tool[None, :3, 3]]:
        points = tip[:, :3, 3] + (tip[:, :3, :3] @ offsets.T).transpose(2, 0, 1)
        motions, distances = align(points, measured)
        for k in np.argsort(distances, kind="stable")[:_MAX_CANDIDATES]:
            yield motions[k], offsets[k]


def _tool_offsets() -> Iterator[Array]:
    """Generate the tool offsets (·, 3) that are tried: zero, which is the usual one, and a grid around it."""
    yield np.zeros((1, 3))
    steps = [0.0, -_TOOL_OFFSET, _TOOL_OFFSET]
    yield np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)[1:]


def relative_misfit(chain: Chain, data: Sequence[Measurement]) -> float:
    """Compute the RMS position error relative to the RMS distance of the positions from their mean."""
    with_positions = [item for item in data if len(item.positions())]
    measured = np.concatenate([item.positions() for item in with_positions])
    modelled = np.concatenate([chain.poses(item.conditions())[:, :3, 3] for item in with_positions])
    spread = np.linalg.norm(measured - measured.mean(0))
    return float(np.linalg.norm(measured - modelled) / spread) if spread else np.inf


def agreeing_samples(
    chain: Chain, data: Sequence[Measurement], is_base_unknown: bool, is_tool_unknown: bool
) -> list[Array]:
    """Find the samples whose measured positions agree with those of a majority, by the linear equations."""
    out = [np.ones(len(item.rows), bool) for item in data]
    with_positions = [(k, item) for k, item in enumerate(data) if len(item.positions())]
    if not with_positions or not (is_base_unknown or is_tool_unknown):
        return out
    bare = chain.with_base_and_tool(np.eye(4), np.eye(4))
    tip = np.concatenate([bare.poses(item.conditions().of_arm) for _, item in with_positions])
    measured = np.concatenate([measured_at_end(item)[0] for _, item in with_positions])
    m, columns = len(tip), []
    right = tip[:, :3, 3]
    if is_base_unknown:
        centre = np.median(measured, 0)
        spread = np.median(np.linalg.norm(measured - centre, axis=1)) or 1.0
        scaled = (measured - centre) / spread
        columns += [np.einsum("kl,mi->mkli", np.eye(3), scaled).reshape(m, 3, 9)]
        columns += [np.broadcast_to(-np.eye(3), (m, 3, 3))]
    else:
        local = se3.inverse(chain.base)
        right = right - (local[:3, :3] @ measured[..., None])[..., 0] - local[:3, 3]
    if is_tool_unknown:
        columns.append(-tip[:, :3, :3])
    else:
        right = right + tip[:, :3, :3] @ chain.tool[:3, 3]
    distances = _trimmed_distances(np.concatenate(columns, 2), right)
    if distances is None:
        return out
    is_agreeing = iter(distances <= _largest_distance(distances, measured))
    for k, item in with_positions:
        out[k] = np.array([next(is_agreeing) for _ in item.rows])
    return out


def _trimmed_distances(columns: Array, right: Array) -> Array | None:
    """Return the distances (m,) of equations from their least trimmed squares fit, or None."""
    m, _, u = columns.shape
    majority, size = m // 2 + 1, -(-u // 3) + 1
    if majority <= size:
        return None
    rng = np.random.default_rng(0)
    chosen = np.argsort(rng.random((_N_SUBSETS, m)), axis=1)[:, :size]
    information = np.einsum("mku,mkv->muv", columns, columns).reshape(m, u * u)
    products = np.einsum("mku,mk->mu", columns, right)
    floor = _MIN_INFORMATION * m * np.max(information.reshape(m, u, u).diagonal(0, 1, 2)) * np.eye(u)
    squares = np.empty((0, m))
    for _ in range(_N_CONCENTRATIONS + 1):
        weights = np.zeros((_N_SUBSETS, m))
        np.put_along_axis(weights, chosen, 1.0, 1)
        total = (weights @ information).reshape(-1, u, u) + floor
        solutions = np.linalg.solve(total, (weights @ products)[..., None])[..., 0]
        modelled = (columns.reshape(-1, u) @ solutions.T).reshape(m, 3, -1)
        squares = np.sum((modelled - right[..., None]) ** 2, 1).T
        chosen = np.argpartition(squares, majority - 1, axis=1)[:, :majority]
    best = np.argmin(np.sum(np.take_along_axis(squares, chosen, 1), 1))
    return np.sqrt(squares[best])


def gross_outliers(chain: Chain, data: Sequence[Measurement]) -> list[Array]:
    """Find samples that a fit must begin without: too far from the initialized chain."""
    out = [np.zeros(len(item.rows), bool) for item in data]
    with_positions = [k for k, item in enumerate(data) if len(item.positions())]
    if with_positions:
        measured = [data[k].positions() for k in with_positions]
        distances = [
            np.linalg.norm(chain.poses(data[k].conditions())[:, :3, 3] - each, axis=1)
            for k, each in zip(with_positions, measured, strict=True)
        ]
        limit = _largest_distance(np.concatenate(distances), np.concatenate(measured))
        for k, distance in zip(with_positions, distances, strict=True):
            out[k] = distance > limit
    return out


def _largest_distance(distances: Array, measured: Array) -> float:
    """Return the largest distance of a sample that agrees, from all distances (m,) and positions (m, 3)."""
    spread = np.median(np.linalg.norm(measured - np.median(measured, 0), axis=1))
    return float(max(_MAX_DISTANCE_RATIO * np.median(distances), GOOD_RELATIVE_MISFIT * spread))


def make_problem(
    errors: ErrorModel, data: tuple[Measurement, ...], weights: Array, known: Mapping[str, float]
) -> Problem:
    """Make the least-squares problem of a robot and its instruments, which have priors of their own."""
    wide = np.array(
        [
            1 / parameter.prior
            for parameter in merge_instrument_parameters(data)
            if parameter.name not in known
        ]
    )
    return Problem(errors, data, np.concatenate([weights, wide]), known)


def _fit_frames(
    frames: ErrorModel, data: tuple[Measurement, ...], known: Mapping[str, float], max_iterations: int
) -> tuple[float, Chain]:
    """Fit base and tool alone; return the cost and the chain with them."""
    data = tuple(item.initialized(frames.chain) for item in data)
    problem = make_problem(frames, data, 1 / frames.priors, known)
    solution = minimize(problem, max_iterations=max_iterations, loose=True)
    x, cost = complete(problem, solution, max_iterations)
    return cost, frames.at(x[: len(frames.parameters)])


def initialize_frames(
    errors: ErrorModel, data: tuple[Measurement, ...], known: Mapping[str, float], max_iterations: int
) -> ErrorModel:
    """Initialize unknown base and tool frames from a subsample of the measurements."""
    frames = errors.only_frames
    if frames is None:
        return errors
    unknown_frames = {p.error_frame for p in frames.parameters}
    is_unknown = BASE_FRAME in unknown_frames, errors.chain.tool_frame_index in unknown_frames
    drawn = tuple(subsample(item) for item in data)
    best = _best_frames(frames, drawn, known, max_iterations, is_unknown)
    if best and best[0] >= GOOD_RELATIVE_MISFIT:
        kept = agreeing_samples(errors.chain, drawn, *is_unknown)
        if not all(each.all() for each in kept):
            drawn = tuple(item.take(each) for item, each in zip(drawn, kept, strict=True))
            best = _best_frames(frames, drawn, known, max_iterations, is_unknown) or best
    return replace(errors, chain=(best or _fit_frames(frames, data, known, max_iterations))[1])


def _best_frames(
    frames: ErrorModel,
    data: tuple[Measurement, ...],
    known: Mapping[str, float],
    max_iterations: int,
    is_unknown: tuple[bool, bool],
) -> tuple[float, Chain] | None:
    """Return the relative misfit and the chain of the best candidate; None if there is none."""
    fits: list[tuple[float, float, Chain]] = []
    for start in candidate_frames(frames.chain, data, *is_unknown):
        misfit = relative_misfit(start, data)
        if misfit < GOOD_RELATIVE_MISFIT:
            return misfit, start
        cost, fitted = _fit_frames(replace(frames, chain=start), data, known, max_iterations)
        fits.append((cost, relative_misfit(fitted, data), fitted))
        cost, misfit, fitted = min(fits, key=lambda each: each[0])
        if misfit < GOOD_RELATIVE_MISFIT:
            return misfit, fitted
    return min(fits, key=lambda each: each[0])[1:] if fits else None


def compare_tools(
    started: ErrorModel, data: tuple[Measurement, ...], known: Mapping[str, float], max_iterations: int
) -> ErrorModel:
    """Initialize base and tool from several tool offsets where tool points without positions are measured."""
    has_points = any(isinstance(item, PointMeasurement) for item in data)
    if not has_points or any(len(item.positions()) for item in data):
        return started
    frames = started.only_frames
    is_tool_unknown = any(p.error_frame == started.chain.tool_frame_index for p in started.parameters)
    if frames is None or not is_tool_unknown:
        return started
    drawn = tuple(subsample(item) for item in data)
    costs, chain = [], frames.chain
    offsets = se3.transform(np.eye(3), np.concatenate([*_tool_offsets()]))
    chains = [chain.with_base_and_tool(chain.base, chain.tool @ offset) for offset in offsets]
    for each in chains:
        items = tuple(item.initialized(each) for item in drawn)
        problem = make_problem(ErrorModel(each, ()), items, np.empty(0), known)
        # Each chain is the nominal one of its problem: the size of the robot does not count.
        residuals = problem.residuals(np.zeros(len(problem.weights)), items)
        costs.append(sum(map(sum_of_squares, residuals)))
    best = np.argsort(costs, kind="stable")[:_MAX_CANDIDATES]
    fits = [_fit_frames(replace(frames, chain=chains[k]), drawn, known, max_iterations) for k in best]
    return replace(started, chain=min(fits, key=lambda each: each[0])[1])


def compare_mirror_images(problem: Problem, solution: SolverResult, max_iterations: int) -> SolverResult:
    """Fit mirror images of anchors and centres, too; return the best of these and a loose solution."""
    best, is_better = solution, bool(problem.instrument_parameters)
    while is_better:
        is_better = False
        starts = _mirrored_starts(problem, best.x)
        order = np.argsort([_predicted_cost(problem, start) for start in starts], kind="stable")
        for k in order[:_MAX_CANDIDATES]:
            trial = minimize(problem, "lm", starts[k], max_iterations, loose=True)
            if problem.cost(trial.x) < (1 - _MIN_COST_REDUCTION) * problem.cost(best.x):
                best, is_better = trial, True
    return best


def _mirrored_starts(problem: Problem, x: Array) -> list[Array]:
    """Return solutions (p,) in which one or several instruments are replaced by mirror images."""
    chain, values = problem.chain(x), problem.instruments(x)
    index = {p.name: i for i, p in enumerate(problem.parameters)}
    # Images that change the same parameters exclude each other.
    choices: dict[tuple[str, ...], list[dict[str, float]]] = {}
    for item in problem.data:
        for image in item.mirror_images(chain, values):
            if index.keys() >= image.keys():
                choices.setdefault(tuple(image), []).append(image)
    combined = (
        images
        for n_changed in range(1, len(choices) + 1)
        for group in combinations(choices.values(), n_changed)
        for images in product(*group)
    )
    starts = []
    for images in islice(combined, _MAX_MIRRORED):
        start = x.copy()
        for name, value in ChainMap(*images).items():
            start[index[name]] += value - values[name]
        starts.append(start)
    return starts


def _predicted_cost(problem: Problem, x: Array) -> float:
    """Return the cost that an undamped step from x (p,) would lead to if the model were linear."""
    return linear_system(problem, x).with_priors(problem.weights, x).min_cost


def fit_frames(errors: ErrorModel, data: tuple[Measurement, ...], known: Mapping[str, float]) -> Chain:
    """Fit the unknown base and tool frames of the nominal chain to all measurements."""
    frames = errors.only_frames
    if frames is None:
        return errors.chain.with_current_loads()
    chain = errors.chain.with_current_loads()
    # What does not depend on the data is then computed once for several fits.
    start = frames if chain is errors.chain else replace(frames, chain=chain)
    return _fit_frames(start, data, known, _MAX_ITERATIONS)[1]
