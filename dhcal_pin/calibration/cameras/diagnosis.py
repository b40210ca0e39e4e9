"""Likely cause of the error that a hand-eye calibration leaves.

Images of a right arm, a right board and a right lens differ from the model by the noise of the corners. In
left-out images the noise of the fitted ones is added, through the estimates. If the error of left-out images
is more than `MAX_NOISE_RATIO` times this prediction, something else is wrong. Each cause of `causes` is then
estimated in addition, and judged on left-out images. The cause with the smallest error is the likely one; if
several reach nearly the same error, the one with the fewest unknowns is named first, and the others with it.
The next causes are tried on top of it, as long as the error exceeds the noise.

The noise is the scatter of the corners within an image, or the smallest error that any cause leaves. Corners
of one image that are all displaced together, and by no cause that was tried, are an error of the arm of
another kind, or images with wrong joint values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from ... import se3
from ..._frozen import frozen
from ..._typing import Array
from ...cameras.resolution import describe_resolution
from ...cameras.rig import Camera
from ...estimation.robust import ZERO_WEIGHT
from ...exceptions import DhcalError
from ...formatting import Quantity, Table, format_quantity
from ...measurements.base import Measurement, errors_of, instrument_values
from ...measurements.camera import CameraCorners, select_images
from ...measurements.images.names import list_images
from ...measurements.mounting import Mount
from ...plausibility.displacement import measure_correction
from ...subsampling import evenly_spaced_indices
from ..evaluation import Accuracy
from ..partition import configuration_groups, k_fold
from ..reweighting import Fit
from .arm_types import INDUSTRIAL
from .causes import (
    ARM_SETS,
    CORNERS,
    GEOMETRY,
    LENS,
    LINKS,
    OFFSETS,
    PAIRING,
    POSES,
    SIZE,
    Causes,
    HandEyeData,
    apply_causes,
    file_sequence,
    find_shift,
    find_sizes,
    fit_causes,
)
from .gate import residual_jitter
from .image_checks import MIN_ROTATION, MORE_ROTATIONS, NO_ROTATION, describe_rotation, second_rotation
from .lens_priors import find_image_resolution, lens_values
from .mistakes import held_entries, pose_differences
from .sets import MAX_POINTS, count_corners, describe_configurations, has_joint_values
from .stages import ImageError, fitted_error, held_out_error, held_out_prediction_std

# Displacements that all corners of an image share and that no cause explains.
DISPLACEMENT = "displaced images"
# An error of left-out images above this multiple of the noise is not noise.
MAX_NOISE_RATIO = 1.5
# Error above which the scatter within an image is not noise, as displacements are not linear [px].
MAX_LINEAR_ERROR = 50.0
# Displacement of the board above which images contradict measured lengths, as a multiple of their errors.
MAX_LENGTH_RATIO = 2.0
# A cause is likely if it reduces the error of left-out images below this share, and as likely as the best one
# up to this ratio of their errors.
MAX_ERROR_SHARE, MAX_TIE_RATIO = 0.8, 1.15
# Larger errors are not stated as numbers [px], [m]: boards behind a camera have no place in the image.
MAX_STATED_PIXELS, MAX_STATED_DISTANCE = 5000.0, 10.0
# Largest error of left-out images with exchanged links, as a fraction of the size of the image: links do not
# explain images that are paired with wrong joint values.
MAX_LINKS_ERROR = 0.05
# Correction of the arm in multiples of manufacturing errors above which the arm is no plausible cause.
MAX_ARM_CORRECTION = 6.0
# The error of left-out images is that of one step of the fit. Above this multiple of the error of fitted
# images the step is too long, and the latter is used. Noise is not predicted to grow more than that.
MAX_LEFT_OUT_RATIO = 3.0
# Share of rejected corners above which all corners are examined, too.
MAX_REJECTED_SHARE = 0.03
# Images with errors above this multiple of that of the others are wrong.
MIN_WRONG_RATIO = 5.0
# Number of folds, smallest number of configurations, and largest number of causes.
N_FOLDS, MIN_CONFIGURATIONS, MAX_CAUSES = 5, 5, 3
# Largest number of configurations in which causes are looked for, and of corners in over a third of them:
# more of them do not change the cause.
MAX_CONFIGURATIONS, MAX_CORNERS = 300, 3000


@frozen
class Trial:
    """One cause that was estimated along."""

    cause: str
    error: ImageError  # Error of left-out images
    text: str  # What differs, and by how much
    remedy: str  # What to do about it

    def to_dict(self) -> dict[str, Any]:
        """Return the content for the JSON document."""
        return {
            "cause": self.cause,
            "residual_rms_px": self.error.pixels,
            "board_rms_m": self.error.distance,
            "text": self.text,
            "remedy": self.remedy,
        }


@frozen
class HandEyeDiagnosis:
    """Error of a hand-eye calibration and its likely cause."""

    error: ImageError  # Error of left-out images with the poses alone
    noise: ImageError  # Part of it that noise of the corners explains
    # Likely causes, the most important one first; the error of each is that with the ones before.
    causes: tuple[Trial, ...]
    alternatives: tuple[Trial, ...]  # Causes that explain the images as well as the first one
    trials: tuple[Trial, ...]  # All causes that were tried alone
    rotation: float  # RMS rotation of the tool about the axis with the second largest rotation [rad]
    position_std: float  # Largest standard deviation of the position of a camera or a board [m]
    # Label of each image that does not fit the others, and is left out; empty without names.
    wrong_images: tuple[str, ...]
    stated: str  # What the files state of the robot: "joint values" or "flange poses"

    @property
    def n_wrong_images(self) -> int:
        """Number of images that do not fit the others, and are left out."""
        return len(self.wrong_images)

    @property
    def is_noise(self) -> bool:
        """Whether noise of the corners explains the error."""
        return self.error.pixels <= MAX_NOISE_RATIO * self.noise.pixels

    @property
    def has_few_rotations(self) -> bool:
        """Whether the tool turned too little about a second axis to determine the poses."""
        return self.rotation < MIN_ROTATION

    @property
    def table(self) -> Table:
        """Errors of left-out images with the poses alone, of noise, and with each cause estimated, too."""
        rows = [
            ["poses only", _px(self.error.pixels), _mm(self.error.distance)],
            ["noise of the corners", _px(self.noise.pixels), _mm(self.noise.distance)],
        ]
        for trial in sorted(self.trials, key=lambda each: each.error.pixels):
            rows.append([f"{trial.cause}, too", _px(trial.error.pixels), _mm(trial.error.distance)])
        return Table(["estimated", "left-out images", "at the board"], rows)

    @property
    def image_sentences(self) -> list[str]:
        """What is wrong with the choice of the images, one finding each."""
        return [*self.rotation_sentences, *self.wrong_image_sentences]

    @property
    def rotation_sentences(self) -> list[str]:
        """One sentence if the tool turned too little about a second axis, else empty."""
        if not self.has_few_rotations:
            return []
        size = f"by up to {1 / self.rotation:.2g} mm" if self.rotation > NO_ROTATION else "by metres"
        return [
            f"Too few rotations: {describe_rotation(self.rotation)}. An error of the arm of "
            f"1 mm displaces the camera {size}, and the images do not show it. {MORE_ROTATIONS}"
        ]

    @property
    def wrong_image_sentences(self) -> list[str]:
        """One sentence that names the images that do not fit the others, empty without such images."""
        if not self.n_wrong_images:
            return []
        names = list_images(self.wrong_images)
        if self.n_wrong_images == 1:
            return [
                f"One image does not fit the others and is left out{names}: check the {self.stated} in its "
                "rows, and that the robot stood still."
            ]
        return [
            f"{self.n_wrong_images} images do not fit the others and are left out{names}: check the "
            f"{self.stated} in their rows, and that the robot stood still."
        ]

    @property
    def error_sentence(self) -> str:
        """Error of left-out images and noise, in millimetres and in pixels."""
        at_board = f"{_mm(self.error.distance)} at the board ({_px(self.error.pixels)})"
        # A corner behind its camera has no error at the board.
        size = at_board if np.isfinite(self.error.distance) else _px(self.error.pixels)
        text = f"Error of left-out images: {size}"
        if self.error.pixels > MAX_LINEAR_ERROR:
            return f"{text}."
        noise = f"{_mm(self.noise.distance)} ({_px(self.noise.pixels)})"
        return f"{text}; noise of the corners explains {noise}."

    @property
    def likely(self) -> str:
        """Likely cause, causes that are not distinguishable from it, and what to do; with a space before."""
        if not self.causes:
            return f" No cause that was tried explains it: check the images, the board and the {self.stated}."
        parts = []
        for number, trial in enumerate(self.causes):
            start = "Likely cause" if not number else "In addition"
            parts.append(f" {start}: {trial.text}.")
            if trial.cause != DISPLACEMENT:
                parts.append(f" If that is estimated, too, {_mm(trial.error.distance)} remain.")
        if self.alternatives:
            others = " or ".join(f"{trial.text} ({_mm(trial.error.distance)})" for trial in self.alternatives)
            parts.append(f" Not distinguishable from: {others}.")
        # What is wrong beside the arm is mended first.
        ordered = sorted(self.causes, key=lambda trial: trial.cause in ARM_SETS)
        parts += [f" {remedy}" for remedy in dict.fromkeys(trial.remedy for trial in ordered)]
        return "".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Return the content for the JSON document."""
        return {
            "error": _error_dict(self.error),
            "noise": _error_dict(self.noise),
            "is_noise": self.is_noise,
            "causes": [trial.to_dict() for trial in self.causes],
            "alternatives": [trial.cause for trial in self.alternatives],
            "trials": [trial.to_dict() for trial in self.trials],
            "second_rotation_rad": self.rotation,
            "position_std_m": self.position_std,
            "wrong_images": self.n_wrong_images,
            "wrong_image_names": [label for label in self.wrong_images if label],
            "text": self.error_sentence + ("" if self.is_noise else self.likely),
        }


def _mm(value: float) -> str:
    """Format a length [m] in millimetres, up to the largest one that says something."""
    if value > MAX_STATED_DISTANCE:
        return f"more than {MAX_STATED_DISTANCE:.0f} m"
    return str(Quantity.error(value, "m"))


def _px(value: float) -> str:
    """Format a number of pixels, up to the largest one that says something."""
    if value > MAX_STATED_PIXELS:
        return f"more than {MAX_STATED_PIXELS:.0f} px"
    return str(Quantity.error(value, "px"))


def _error_dict(error: ImageError) -> dict[str, Any]:
    """Return an error for the JSON document."""
    return {"residual_rms_px": error.pixels, "board_rms_m": error.distance, "corners": error.n_corners}


# ---------------------------------------------------------------------------------------------- diagnosis
@frozen(eq=False)
class HandEyeFit:
    """Poses of cameras and boards on the nominal arm, and what their diagnosis needs."""

    fit: Fit  # Fit of the poses with the nominal arm; only base and tool of the robot may be unknown
    position_std: float  # Largest standard deviation of the position of a camera or a board [m]
    holdout: tuple[Measurement, ...]  # Held-out images, for the order of all images
    unrelated: str  # What shows that the images are not those of the joint values or of the robot
    is_arm_tried: bool  # Whether the calibration estimated errors of the arm, too

    @cached_property
    def diagnosis(self) -> HandEyeDiagnosis | None:
        """Likely cause of the error, on first use; None with few configurations or unrelated images."""
        if self.unrelated:
            return None
        return diagnose_hand_eye(self.fit, self.position_std, self.holdout, self.is_arm_tried)


def diagnose_hand_eye(
    fit: Fit, position_std: float, holdout: Sequence[Measurement], is_arm_tried: bool
) -> HandEyeDiagnosis | None:
    """Find the likely cause of the error that a hand-eye calibration leaves."""
    inliers = _search(fit, fit.without_rejected().data, holdout, is_arm_tried)
    if inliers is None:
        return None
    found = inliers
    rejected = np.concatenate([weights <= ZERO_WEIGHT for weights in fit.weights])
    if rejected.mean() > MAX_REJECTED_SHARE:
        # A wrong model makes outliers of right corners. A cause that explains them all is the cause.
        whole = _search(fit, fit.data, holdout, is_arm_tried)
        if whole is not None and whole.causes and whole.remaining <= MAX_NOISE_RATIO * inliers.base.noise:
            found = whole
    base, noise = found.base, found.noise
    share = min(noise / base.error.pixels, 1.0) if base.error.pixels else 1.0
    return HandEyeDiagnosis(
        base.error,
        ImageError(share * base.error.pixels, share * base.error.distance, base.error.n_corners),
        found.causes,
        found.alternatives,
        found.trials,
        second_rotation(fit.problem.errors.chain, found.hand_eye.data),
        position_std,
        tuple(
            label
            for item, weights in zip(fit.data, fit.weights, strict=True)
            if isinstance(item, CameraCorners)
            for label in _wrong_images(found.hand_eye, found.last, item, weights)
        ),
        describe_configurations(fit.data),
    )


def _search(
    fit: Fit, data: Sequence[Measurement], holdout: Sequence[Measurement], is_arm_tried: bool
) -> _Search | None:
    """Search the causes in some of the samples of a fit; None if they have too few configurations."""
    # The scatter within an image is the noise, whatever is stated.
    data = tuple(item.replace(has_stated_sigma=False) for item in data if len(item.rows))
    label = configuration_groups(data)
    count = int(label.max(initial=-1)) + 1
    if count < MIN_CONFIGURATIONS:
        return None
    n_used = _n_examined(count, len(label))
    if count > n_used:
        is_used = np.isin(label, evenly_spaced_indices(count, n_used))
        ends = np.cumsum([len(item.rows) for item in data])[:-1]
        parts = zip(data, np.split(is_used, ends), strict=True)
        data = tuple(item.take(used) for item, used in parts if used.any())
    sequence = file_sequence([*fit.data, *holdout])
    hand_eye = HandEyeData(fit.problem.errors, data, fit.problem.known, sequence, is_arm_tried)
    base = _State.of(hand_eye, Causes(), fit.problem.instruments(fit.solution.x))
    fitted = fitted_error(base.fit)
    if base.error.pixels > MAX_LEFT_OUT_RATIO * fitted.pixels:
        base = replace(base, error=fitted, noise=base.scatter)
    return _Search(hand_eye, base, *_find_causes(hand_eye, base))


def _n_examined(count: int, n_corners: int) -> int:
    """Return the number of configurations in which causes are looked for, of a count with some corners."""
    return min(count, MAX_CONFIGURATIONS, max(MAX_CORNERS * count // n_corners, MAX_CONFIGURATIONS // 3))


def describe_contradiction(fit: Fit, errors: Accuracy) -> str:
    """Say that images contradict measured lengths of the same fit, with its errors; empty if they do not."""
    board, pixels = errors.groups.get("board"), errors.groups.get("pixels")
    lengths = [group.rms for name, group in errors.groups.items() if group.unit == "m" and name != "board"]
    if board is None or pixels is None or not lengths:
        return ""
    jitter = residual_jitter(fit)
    sigma = np.concatenate([item.sigma for item in select_images(fit.data)])
    noise = jitter.noise * se3.rms_length(sigma)
    # Larger errors are refused.
    if not jitter.is_significant or not MAX_NOISE_RATIO * noise < pixels.rms <= MAX_LINEAR_ERROR:
        return ""
    # Errors that both share, such as play, displace the images as much as they change the lengths.
    displacement = board.rms * np.sqrt(1 - (noise / pixels.rms) ** 2)
    if displacement <= MAX_LENGTH_RATIO * max(lengths):
        return ""
    return (
        f"The images contradict the other measurements: they leave {_mm(board.rms)} at the board "
        f"({_px(pixels.rms)}), of which noise of the corners explains {_px(noise)}; the others leave "
        f"{_mm(max(lengths))}. A zero of a joint, the size of the board or the scale of the other instrument "
        "differs. Calibrate images and other measurements by themselves, and compare."
    )


def _wrong_images(hand_eye: HandEyeData, state: _State, item: CameraCorners, weights: Array) -> list[str]:
    """Return the labels of images whose corners were all rejected, and that the causes do not explain."""
    is_rejected = (np.bincount(item.image, weights > 0.5, item.n_images) == 0)[item.image]
    rejected = apply_causes(hand_eye, state.causes, item.take(is_rejected))
    pixels = errors_of(rejected, state.fit.problem.chain(state.fit.solution.x), state.values)["pixels"]
    squares = np.bincount(rejected.image, np.sum(pixels**2, 1)) / np.bincount(rejected.image)
    is_wrong = np.sqrt(squares) > MIN_WRONG_RATIO * state.error.pixels
    first = np.unique(rejected.image, return_index=True)[1]
    return [rejected.image_labels[i] for i in np.argsort(first) if is_wrong[i]]


@frozen(eq=False)
class _State:
    """Fit of a combination of causes."""

    causes: Causes  # Causes that are estimated
    fit: Fit  # Fit of all images
    error: ImageError  # Error of left-out images
    scatter: float  # Noise of the corners, from their scatter within an image [px]
    noise: float  # Error of left-out images that this noise predicts [px]
    is_displaced: bool  # Whether the corners of an image are significantly displaced together

    @classmethod
    def of(cls, hand_eye: HandEyeData, causes: Causes, start: Mapping[str, float] | None) -> _State:
        """Fit a combination of causes."""
        fit = fit_causes(hand_eye, causes, start)
        folds = k_fold(fit.data, N_FOLDS)
        error = held_out_error(fit, folds)
        assert error is not None
        jitter = residual_jitter(fit)
        sigma = np.concatenate([item.sigma for item in select_images(fit.data)])
        scatter = jitter.noise * se3.rms_length(sigma)
        growth = min(float(np.hypot(1.0, held_out_prediction_std(fit, folds))), MAX_LEFT_OUT_RATIO)
        return cls(causes, fit, error, scatter, growth * scatter, jitter.is_significant)

    @property
    def values(self) -> dict[str, float]:
        """Values of the parameters of cameras and boards by name."""
        return self.fit.problem.instruments(self.fit.solution.x)


@frozen(eq=False)
class _Search:
    """Images, fit of the poses alone, and what `_find_causes` returns."""

    hand_eye: HandEyeData
    base: _State
    causes: tuple[Trial, ...]
    alternatives: tuple[Trial, ...]
    trials: tuple[Trial, ...]
    last: _State

    @property
    def remaining(self) -> float:
        """Error of left-out images with all causes [px]."""
        return min(self.base.error.pixels, self.last.error.pixels)

    @property
    def noise(self) -> float:
        """Error that the scatter within an image predicts, or the smallest error of left-out images [px]."""
        return min([self.base.noise, *(trial.error.pixels for trial in (*self.trials, *self.causes))])


def _find_causes(
    hand_eye: HandEyeData, base: _State
) -> tuple[tuple[Trial, ...], tuple[Trial, ...], tuple[Trial, ...], _State]:
    """Return the likely causes in turn, causes like the first one, trials of each alone, and the last fit."""
    state = base
    found: list[Trial] = []
    alternatives: tuple[Trial, ...] = ()
    alone: tuple[Trial, ...] = ()
    while len(found) < MAX_CAUSES:
        states = _try_causes(hand_eye, state)
        trials = {name: _trial(hand_eye, name, each) for name, each in states.items()}
        if state is base:
            alone = tuple(trials.values())
        least = min((each.error.pixels for each in states.values()), default=np.inf)
        noise = min(state.noise, least)
        if state.error.pixels <= MAX_NOISE_RATIO * noise:
            break
        if least > MAX_ERROR_SHARE * state.error.pixels:
            if state.is_displaced:
                found.append(_displacement(hand_eye, state))
            break
        equal = [name for name, each in states.items() if each.error.pixels <= MAX_TIE_RATIO * least]
        plausible = [name for name in equal if _is_plausible(name, states[name])] or equal
        first = plausible[0]
        found.append(trials[first])
        if state is base:
            alternatives = tuple(trials[name] for name in plausible[1:] if not _contains(name, first))
        state = states[first]
    return tuple(found), alternatives, alone, state


def _contains(name: str, first: str) -> bool:
    """Return whether a cause contains another one, and is no alternative to it."""
    return (first, name) in ((SIZE, CORNERS), (OFFSETS, GEOMETRY))


def _is_plausible(name: str, state: _State) -> bool:
    """Return whether errors of the arm are not far larger than manufacturing errors."""
    if name not in ARM_SETS:
        return True
    problem = state.fit.problem
    moved = measure_correction(problem.errors, problem.chain(state.fit.solution.x))
    return moved.ratio < MAX_ARM_CORRECTION


def _try_causes(hand_eye: HandEyeData, state: _State) -> dict[str, _State]:
    """Fit each further cause on top of those of a state, those with few unknowns first."""
    causes, start, out = state.causes, state.values, {}
    is_large = state.error.pixels > INDUSTRIAL.max_error

    def attempt(name: str, more: Causes, values: Mapping[str, float] | None = start) -> None:
        try:
            out[name] = _State.of(hand_eye, more, values)
        except (DhcalError, np.linalg.LinAlgError):
            return

    rig = _rig(hand_eye.data)
    if is_large and not causes.has_exchanged_links and rig.has_links_to_exchange:
        attempt(LINKS, replace(causes, has_exchanged_links=True), None)
        camera = rig.cameras[0]
        if LINKS in out and out[LINKS].error.pixels < MAX_LINKS_ERROR * max(camera.width, camera.height):
            return out
        out.pop(LINKS, None)
    if not causes.has_free_poses and held_entries(hand_eye.data, hand_eye.known):
        attempt(POSES, replace(causes, has_free_poses=True), None)
        # Errors of the arm displace cameras and boards, too, but leave more than noise.
        if POSES in out and out[POSES].error.pixels > MAX_NOISE_RATIO * out[POSES].noise:
            out.pop(POSES)
        elif POSES in out and is_large:
            return out
    if is_large and not causes.shift and (shift := find_shift(hand_eye, causes)):
        attempt(PAIRING, replace(causes, shift=shift), None)
        if PAIRING in out and out[PAIRING].error.pixels < MAX_ERROR_SHARE * state.error.pixels:
            return out
    if not causes.sizes:
        attempt(SIZE, replace(causes, sizes=find_sizes(hand_eye, causes, start)))
    if not causes.has_lens:
        attempt(LENS, replace(causes, has_lens=True))
    if not causes.has_points and count_corners(hand_eye.data) <= MAX_POINTS:
        attempt(CORNERS, replace(causes, has_points=True))
    for name, sets in ARM_SETS.items() if has_joint_values(hand_eye.data) else ():
        if len(sets) > len(causes.arm):
            attempt(name, replace(causes, arm=sets))
    least = min((each.error.pixels for each in out.values()), default=np.inf)
    is_explained = min(least, state.error.pixels) <= MAX_NOISE_RATIO * state.noise
    if not is_large and not causes.shift and not is_explained and (shift := find_shift(hand_eye, causes)):
        attempt(PAIRING, replace(causes, shift=shift), None)
    return out


# ---------------------------------------------------------------------------------------------- texts
def _trial(hand_eye: HandEyeData, name: str, state: _State) -> Trial:
    """Describe a cause with what was estimated."""
    text, remedy = {
        PAIRING: _pairing_text,
        LINKS: _links_text,
        POSES: _poses_text,
        SIZE: _size_text,
        LENS: _lens_text,
        CORNERS: _corner_text,
        OFFSETS: _arm_text,
        GEOMETRY: _arm_text,
    }[name](hand_eye, state)
    return Trial(name, state.error, text, remedy)


def _displacement(hand_eye: HandEyeData, state: _State) -> Trial:
    """Describe displaced images that no cause explains."""
    stated = describe_configurations(hand_eye.data)
    if state.error.pixels > MAX_LINEAR_ERROR:
        checks = (
            "units, order, signs and zeros of the joints, and whether the robot file is that of the robot"
            if has_joint_values(hand_eye.data)
            else "units, signs and frame of the positions, and notation and order of the rotations"
        )
        text = f"wrong {stated}: no deflection, backlash or motion displaces images so far"
        return Trial(DISPLACEMENT, state.error, text, f"Check {checks}, and the image of each row.")
    kind = "of another kind " if has_joint_values(hand_eye.data) else ""
    text = (
        f"all corners of an image are displaced together: errors of the arm {kind}(deflection, backlash, "
        f"periodic errors), a robot that had not stopped, or images with wrong {stated}"
    )
    remedy = f"Check the {stated} of the images, and wait until the arm stands still; take more images."
    return Trial(DISPLACEMENT, state.error, text, remedy)


def _pairing_text(hand_eye: HandEyeData, state: _State) -> tuple[str, str]:
    """Describe a shift of the joint values, or of the flange poses."""
    shift, stated = state.causes.shift, describe_configurations(hand_eye.data)
    side = "before" if shift < 0 else "after"
    if abs(shift - round(shift)) < 0.05 and round(shift):
        count = abs(round(shift))
        rows = f"{count} rows" if count > 1 else "one row"
        mended = f", or add --mend rows:{'below' if shift < 0 else 'above'}" if count == 1 else ""
        return (
            f"the pairing: each image belongs to the {stated} {rows} {side} its own",
            f"Correct the table of {stated}{mended}.",
        )
    return (
        f"the pairing: each image belongs to {stated} {abs(shift):.2g} rows {side} its own, a time "
        "offset between camera and robot",
        "Synchronize the clocks, or let the robot stop for each image.",
    )


def _links_text(hand_eye: HandEyeData, state: _State) -> tuple[str, str]:
    """Describe exchanged links, and beside poses of the flange inverse poses, which show the same images."""
    rig = _rig(hand_eye.data)
    camera, board = rig.cameras[0], rig.boards[0]
    if has_joint_values(hand_eye.data):
        return (
            f"the links: camera {camera.name!r} on link {board.link!r} and board {board.name!r} on link "
            f"{camera.link!r} explain the images",
            "Exchange the links in the rig file.",
        )
    solved = _images(state.fit.data).solved_rig(state.values) or rig
    # The pose of a camera in its end is the same for both explanations, and so is that of a board.
    ends = solved.camera_in_end(0), solved.board_in_end(0)
    stated, exchanged = (
        f"camera {camera.name!r} is {_distance(ends[0], of_camera)} from link {first!r}, and board "
        f"{board.name!r} {_distance(ends[1], of_board)} from link {second!r}"
        for of_camera, first, of_board, second in (
            (rig.camera_mounts[0], camera.link, rig.board_mounts[0], board.link),
            (rig.board_mounts[0], board.link, rig.camera_mounts[0], camera.link),
        )
    )
    return (
        "inverse flange poses (of the base in the flange), or exchanged links; the images do not show which "
        f"of them. If the poses are inverse, {stated}; if the links are exchanged, {exchanged}",
        f"If camera {camera.name!r} is on link {camera.link!r}, invert the poses, or add --mend "
        f"poses:inverse; if it is on link {board.link!r}, exchange the links in the rig file.",
    )


def _distance(pose: Array, mount: Mount) -> str:
    """Format the distance of a pose in the frame of an end from the link of a mount."""
    size = float(np.linalg.norm(pose[:3, 3] - mount.link_pose[:3, 3]))
    return format_quantity(size, "m", 0.03 * size)


def _poses_text(hand_eye: HandEyeData, state: _State) -> tuple[str, str]:
    """Describe the stated poses that are inverse, or else the one that differs most."""
    held = held_entries(hand_eye.data, hand_eye.known)
    found = pose_differences(select_images(hand_eye.data), state.values, held)
    wrong = [each for each in found if each.is_inverse] or [max(found, key=lambda each: each.size)]
    sets = " and ".join(dict.fromkeys(each.entry.partition("_")[0] for each in wrong))
    remedies = " ".join(dict.fromkeys(each.remedy for each in wrong))
    return " and ".join(each.text for each in wrong), f"{remedies} Or add {sets} to --parameters."


def _size_text(hand_eye: HandEyeData, state: _State) -> tuple[str, str]:
    """Describe boards whose size differs most."""
    name = max(state.causes.sizes, key=lambda each: abs(np.log(state.causes.sizes[each])))
    size = state.causes.sizes[name]
    square = next(b.square for b in _rig(hand_eye.data).boards if b.name == name)
    lengths = f": squares of {1e3 * size * square:.4g} mm, not {1e3 * square:.4g} mm" if square else ""
    return (
        f"the size of board {name!r}, {100 * abs(size - 1):.2g} % {'larger' if size > 1 else 'smaller'} than "
        f"stated{lengths}",
        "Measure the board with a ruler over its whole length, and correct its size in the rig file.",
    )


def _lens_text(hand_eye: HandEyeData, state: _State) -> tuple[str, str]:
    """Describe the lenses, and by how much the change of each displaces the corners."""
    values, texts = state.values, []
    item = _images(hand_eye.data)
    for number, camera in enumerate(item.rig.cameras):
        if resolution := find_image_resolution(hand_eye.data, camera, values):
            text = describe_resolution(camera, resolution)
            return f"the resolution: {text} (camera {camera.name!r})", resolution.remedy
        found = lens_values(camera, values)
        if not camera.has_intrinsics or found[:2].min() <= 0:
            continue
        rays = camera.lens.normalize(item.values[item.camera == number].T, found)
        parts = []
        for names, chosen in (("fx, fy", [0, 1]), ("cx, cy", [2, 3]), ("distortion", range(4, len(found)))):
            other = found.copy()
            other[chosen] = camera.values[chosen]
            moved = np.sqrt(np.mean((_project(camera, rays, other) - _project(camera, rays, found)) ** 2))
            parts.append((moved, names, chosen))
        moved, names, chosen = max(parts)
        change = ""
        if names != "distortion":
            before, after = (", ".join(f"{v:.0f}" for v in each[chosen]) for each in (camera.values, found))
            change = f": {after} px, not {before} px"
        texts.append(f"{names} of camera {camera.name!r}{change}")
    return (
        f"the lens, above all {' and '.join(texts)}" if texts else "the lens",
        'Add intrinsics to --parameters, with intrinsics = "prior" in the rig file, or calibrate the camera '
        "first.",
    )


def _project(camera: Camera, rays: Array, values: Array) -> Array:
    """Return the image coordinates (2, m) of directions (2, m) with other values of the lens."""
    return camera.lens.project(np.concatenate([rays, np.ones((1, rays.shape[1]))]), values)[0]


def _corner_text(hand_eye: HandEyeData, state: _State) -> tuple[str, str]:
    """Describe the board whose corners are displaced most."""
    largest = ("", 0.0, 0.0)
    item = _images(state.fit.data)
    u = instrument_values(item, state.values)
    for number, (board, found) in enumerate(zip(_rig(hand_eye.data).boards, item.points(u), strict=True)):
        observed = np.unique(item.corner[item.board == number])
        if len(observed) < 3:
            continue
        moved = _without_rigid_motion(found[observed], board.points[observed])
        rms = se3.rms_length(moved)
        if rms > largest[1]:
            largest = board.name, rms, float(np.sqrt(np.mean(moved[:, 2] ** 2)))
    name, rms, normal = largest
    shape = ", mostly out of its plane: it is not flat" if normal**2 > 0.5 * rms**2 else ""
    return (
        f"the corners of board {name!r}, {_mm(rms)} (RMS) beside the stated places{shape}",
        'Use a flat and stiff board, or estimate its corners: points = "prior" in the rig file.',
    )


def _without_rigid_motion(found: Array, stated: Array) -> Array:
    """Return the differences of points (c, 3) after the best rigid motion, in the axes of the stated ones."""
    a, b = found - found.mean(0), stated - stated.mean(0)
    rotation = se3.nearest_rotation(b.T @ a)
    return a @ rotation.T - b


def _arm_text(hand_eye: HandEyeData, state: _State) -> tuple[str, str]:
    """Describe the errors of the arm."""
    errors = state.fit.problem.errors
    x = state.fit.solution.x[: len(errors.parameters)]
    remedy = "Estimate the arm, too, without --parameters."
    if hand_eye.is_arm_tried:
        remedy = "The arm was estimated, too; left-out images do not show that its correction is right."
    if state.causes.arm == ARM_SETS[OFFSETS]:
        offsets = {p.name: v for p, v in zip(errors.parameters, x, strict=True) if p.name.endswith("offset")}
        name = max(offsets, key=lambda each: abs(offsets[each]))
        largest = format_quantity(offsets[name], "rad", 0.03 * abs(offsets[name]))
        return f"the arm: its joint offsets, {name} {largest}", remedy
    moved = measure_correction(errors, errors.at(x))
    size = format_quantity(moved.displacement, "rad" if moved.is_angle else "m", 0.03 * moved.displacement)
    what = "the tool" if moved.frame == "tool" else f"the axis of {moved.frame}"
    return f"the arm: its geometry or joint offsets, which move {what} by {size} (RMS)", remedy


def _images(data: Sequence[Measurement]) -> CameraCorners:
    """Return the first image coordinates among measurements."""
    return select_images(data)[0]


def _rig(data: Sequence[Measurement]) -> Any:
    """Return the rig of the first image coordinates among measurements."""
    return _images(data).rig
