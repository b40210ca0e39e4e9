"""Models of what can be wrong with a hand-eye calibration: arm, board, lens, links, or pairing of the images.

A hand-eye calibration holds the arm, the boards and the lenses, and estimates poses only. Each cause frees or
changes one of them:

- `pairing`: an image belongs to the joint values of another row, earlier or later by a number of rows, or to
  values between two rows;
- `links`: the rig states the link of the camera for the board, and that of the board for the camera: a camera
  on the wrist for a fixed one, or the other way round;
- `stated poses`: a pose of a camera or a board that the calibration holds differs from the one in the rig;
- `board size`: all lengths of a board have one factor;
- `lens`: focal lengths, image centre and distortion differ from those of the rig;
- `board corners`: each corner of a board is displaced;
- `joint offsets`: the zeros of the joints differ from the nominal ones;
- `arm geometry`: joint offsets and all link frames differ from the nominal ones.

The last two need joint values; they are not tried if the images have poses of the tip instead.

Causes can be combined. The model of some causes is fitted to the same images as that of none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, replace
from functools import cache, partial

import numpy as np

from ..._frozen import frozen
from ..._typing import Array
from ...estimation.error_model import ErrorModel
from ...estimation.initialization import make_problem
from ...estimation.parameters import select_parameters
from ...estimation.priors import group_default_priors
from ...estimation.robust import KEPT
from ...estimation.solver import minimize
from ...exceptions import DhcalError
from ...measurements.base import Measurement
from ...measurements.camera import CameraCorners, change_images, select_images
from ...measurements.images.camera_parameters import POINTS_SET, POSE_NAMES
from ...measurements.images.camera_start import first_values
from ..reweighting import Fit, reweight
from .lens_priors import lens_prior_groups
from .mistakes import held_entries

# Causes, and parameter sets of those of the arm. Those with fewer unknowns come first.
PAIRING, LINKS, POSES, SIZE, LENS, CORNERS, OFFSETS, GEOMETRY = (
    "pairing",
    "links",
    "stated poses",
    "board size",
    "lens",
    "board corners",
    "joint offsets",
    "arm geometry",
)
ARM_SETS = {OFFSETS: "offset", GEOMETRY: "placement,offset"}
# First step of the logarithm of the size of a board, and largest one.
SIZE_STEP, MAX_SIZE_STEP = 0.01, 0.15
# Shifts of the joint values that are tried first [rows].
SHIFTS = (-2.0, -1.0, -0.5, -0.2, -0.1, -0.05, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
# A first shift goes on if it reduces the cost below this fraction.
MAX_SHIFT_COST = 0.7
_SHIFT_STEP = 0.02
# A shift that differs less from a whole number is one [rows].
MAX_WHOLE_DIFFERENCE = 0.1
# Rounds and accuracy of the search for a size [1] or a shift [rows].
_N_ROUNDS, _TOLERANCE = 8, 1e-5
# Largest number of iterations of one solution.
_MAX_ITERATIONS = 40


@frozen
class Causes:
    """Combination of causes."""

    arm: str = ""  # Parameter sets of the arm that are estimated; empty for the nominal arm
    has_lens: bool = False  # Whether the values of the lenses are estimated
    has_points: bool = False  # Whether the corners of the boards are estimated
    # Size of each board relative to the stated one, by name.
    sizes: Mapping[str, float] = field(default_factory=dict)
    shift: float = 0.0  # Number of rows by which the joint values are shifted; 0.5 is the mean of two rows
    has_exchanged_links: bool = False  # Whether cameras and boards are on each other's links
    has_free_poses: bool = False  # Whether stated poses that the calibration holds are estimated


@frozen(eq=False)
class HandEyeData:
    """What all models of one hand-eye calibration share."""

    errors: ErrorModel  # Nominal chain; base and tool are its only parameters, if any
    # Measurements with their own standard deviations, first values and no outliers.
    data: tuple[Measurement, ...]
    known: Mapping[str, float]  # Values of parameters that the calibration holds, by name [m, rad, px or 1]
    sequence: Array  # Joint values of all images in the order of the file, held-out ones included, (k, n)
    is_arm_tried: bool  # Whether the calibration estimated errors of the arm, too


def apply_causes(hand_eye: HandEyeData, causes: Causes, item: CameraCorners) -> CameraCorners:
    """Return images with the rig and the joint values of some causes."""
    return _shifted(hand_eye, causes, _with_rig(causes, item))


def _with_rig(causes: Causes, item: CameraCorners) -> CameraCorners:
    """Return images with the rig of some causes, default priors and their own joint values."""
    item = with_sizes(causes.sizes, item) if causes.sizes else item
    cameras, boards = item.rig.cameras, item.rig.boards
    if causes.has_lens:
        cameras = tuple(
            replace(camera, intrinsics="prior") if camera.intrinsics == "fixed" else camera
            for camera in cameras
        )
    if causes.has_points:
        boards = tuple(replace(board, has_free_points=True) for board in boards)
    rig = item.rig
    if cameras is not rig.cameras or boards is not rig.boards:
        rig = replace(rig, cameras=cameras, boards=boards)
    if causes.has_exchanged_links:
        rig = rig.with_exchanged_links()
    return item.with_rig(rig)


def with_sizes(sizes: Mapping[str, float], item: CameraCorners) -> CameraCorners:
    """Return images of boards whose sizes are those of the rig times a factor, by name."""
    boards = tuple(
        replace(board, type="points", listed_points=sizes.get(board.name, 1.0) * board.points)
        for board in item.rig.boards
    )
    entries = {f"board_{board.name}": sizes.get(board.name, 1.0) for board in boards}
    points = {
        p.name: entries[p.name.rpartition(".")[0]] * p.nominal
        for p in item.instrument_parameters
        if item.set_of(p.name) == POINTS_SET
    }
    return item.with_rig(replace(item.rig, boards=boards)).with_values(points)


def fit_causes(hand_eye: HandEyeData, causes: Causes, start: Mapping[str, float] | None) -> Fit:
    """Fit the model of some causes; noise and the sizes of errors of arm and lens are estimated."""
    fit = _first_fit(hand_eye, causes, start)
    errors = fit.problem.errors
    has_default = np.ones(len(errors.parameters), bool)
    groups = group_default_priors(errors, fit.problem.weights, has_default) + lens_prior_groups(fit.problem)
    return reweight(fit, (KEPT,), groups, _MAX_ITERATIONS, None)


def _first_fit(hand_eye: HandEyeData, causes: Causes, start: Mapping[str, float] | None = None) -> Fit:
    """Fit the model of some causes with the stated or placeholder noise."""
    errors = hand_eye.errors
    if causes.arm:
        arm = select_parameters(errors.chain, causes.arm)
        # Parameters are in the order of their frames.
        parameters = sorted((*errors.parameters, *arm.parameters), key=lambda p: p.error_frame)
        errors = replace(arm, parameters=tuple(parameters))
    data = change_images(hand_eye.data, partial(_with_rig, causes))
    known = dict(hand_eye.known)
    if causes.has_lens:
        freed = {name for item in select_images(data) for name in _lens_names(item)}
        known = {name: value for name, value in known.items() if name not in freed}
    if causes.has_free_poses:
        held = held_entries(data, known)
        data = change_images(data, lambda item: item.without_poses(held))
        freed = {f"{entry}.{name}" for entry in held for name in POSE_NAMES}
        known = {name: value for name, value in known.items() if name not in freed}
    if start is None:
        data = change_images(data, partial(_without_poses, known))
    data = change_images(data, partial(_shifted, hand_eye, causes))
    data = tuple(item.initialized(errors.chain) for item in data)
    weights = np.array([1 / p.prior for p in errors.parameters])
    problem = make_problem(errors, data, weights, known)
    x = np.concatenate([np.zeros(len(weights)), problem.instrument_start(start or {})])
    solution = minimize(problem, "lm", x, _MAX_ITERATIONS, loose=True)
    return Fit(data, problem, solution, tuple(np.ones(len(item.rows)) for item in data))


def _lens_names(item: CameraCorners) -> list[str]:
    """Return the names of the parameters of lenses."""
    return [p.name for p in item.instrument_parameters if item.set_of(p.name) == "intrinsics"]


def _without_poses(known: Mapping[str, float], item: CameraCorners) -> CameraCorners:
    """Return images without first values of the poses that are estimated."""
    names = [p.name for p in item.instrument_parameters if item.set_of(p.name) in ("camera", "board")]
    return item.with_values({name: np.nan for name in names if name not in known})


def _shifted(hand_eye: HandEyeData, causes: Causes, item: CameraCorners) -> CameraCorners:
    """Return the images for which there are shifted joint values, with these and with first values."""
    if not causes.shift:
        return item
    sequence = hand_eye.sequence
    different, of_row = np.unique(item.q, axis=0, return_inverse=True)
    number = places_in_sequence(sequence, different)
    place = number[of_row] + causes.shift
    low = np.clip(np.floor(place).astype(int), 0, len(sequence) - 2)
    part = (place - low)[:, None]
    is_inside = (place >= 0) & (place <= len(sequence) - 1)
    shifted = item.replace(q=(1 - part) * sequence[low] + part * sequence[low + 1])
    if any(np.isnan(p.nominal) for p in item.instrument_parameters):
        # The boards are where they are in the images, whatever the joint values.
        values = first_values(shifted.corners, item.board_views, hand_eye.errors.chain, is_inside)
        shifted = shifted.with_values(values)
    return shifted.take(is_inside)


def file_sequence(data: Sequence[Measurement]) -> Array:
    """Return the joint values of all images in the order of the rows of their file."""
    images = select_images(data)
    q = np.concatenate([item.q for item in images])
    rows = np.concatenate([item.rows for item in images])
    q = q[np.argsort(rows, kind="stable")]
    is_new = np.ones(len(q), bool)
    is_new[1:] = np.any(q[1:] != q[:-1], 1)
    return q[is_new]


def places_in_sequence(sequence: Array, q: Array) -> Array:
    """Return the places of joint values (m, n) in a sequence (k, n) that contains them."""
    return np.array([int(np.argmin(np.abs(sequence - each).max(1))) for each in q], int)


# ------------------------------------------------------------------------------------ sizes and shifts
def find_sizes(hand_eye: HandEyeData, causes: Causes, start: Mapping[str, float]) -> dict[str, float]:
    """Find the size of each board that fits the images best."""
    names = [b.name for item in select_images(hand_eye.data) for b in item.rig.boards]
    sizes = dict.fromkeys(dict.fromkeys(names), 1.0) | dict(causes.sizes)
    for name in sizes:

        def cost(log_size: float, name: str = name) -> float:
            own = sizes | {name: float(np.exp(log_size))}
            return _cost(hand_eye, replace(causes, sizes=own), start)

        found = find_minimum(cost, float(np.log(sizes[name])), SIZE_STEP, MAX_SIZE_STEP)
        sizes[name] = float(np.exp(found))
    return sizes


def find_shift(hand_eye: HandEyeData, causes: Causes) -> float:
    """Find the shift of the joint values that fits the images best."""
    if len(hand_eye.sequence) < 4:
        return 0.0

    @cache
    def cost(shift: float) -> float:
        return _cost(hand_eye, replace(causes, shift=shift), None)

    best = min(SHIFTS, key=cost)
    if cost(best) >= MAX_SHIFT_COST * cost(0.0):
        return 0.0
    found = find_minimum(cost, best, _SHIFT_STEP, 0.5)
    return best if best.is_integer() and abs(found - best) < MAX_WHOLE_DIFFERENCE else found


def _cost(hand_eye: HandEyeData, causes: Causes, start: Mapping[str, float] | None) -> float:
    """Return the mean cost of a sample in the fit of a model; infinite without a fit."""
    try:
        fit = _first_fit(hand_eye, causes, start)
    except DhcalError:
        return np.inf
    return fit.solution.system.cost / sum(len(item.rows) for item in fit.data)


def find_minimum(cost: Callable[[float], float], start: float, step: float, max_step: float) -> float:
    """Find a minimum of a function by parabolas through three of its values."""
    x, middle = start, cost(start)
    for _ in range(_N_ROUNDS):
        left, right = cost(x - step), cost(x + step)
        curvature = left - 2 * middle + right
        move = 0.5 * step * (left - right) / curvature if curvature > 0 else np.sign(left - right) * max_step
        move = float(np.clip(move, -max_step, max_step))
        value = cost(x + move)
        if not value < middle:
            candidates = {x - step: left, x + step: right}
            other = min(candidates, key=lambda each: candidates[each])
            if candidates[other] < middle:
                move, value = other - x, candidates[other]
            else:
                step *= 0.25
                if step < _TOLERANCE:
                    break
                continue
        x, middle = x + move, value
        if abs(move) < _TOLERANCE:
            break
        step = min(step, max(abs(move), _TOLERANCE))
    return x
