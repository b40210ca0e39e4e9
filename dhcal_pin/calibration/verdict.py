"""Verdict: whether a calibrated robot may be used, with the reasons.

A verdict is "ok", "caution" (usable, but with a restriction) or "refused" (the calibrated robot must not be
used). Each rule is one function that returns its findings on a result. `judge` lists all rules. The verdict
is the most severe finding.

The limits separate simulated mistakes from honest measurements of robots with errors of up to 2 degrees and
10 mm in every joint, and from real series; see `tests/calibration/test_mistakes.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from .. import se3
from .._frozen import frozen
from ..estimation import robust
from ..estimation.initialization import initialize_frames
from ..estimation.parameters import select_parameters
from ..estimation.problem import Problem
from ..estimation.solver import minimize
from ..exceptions import ConvergenceError
from ..formatting import capitalized, format_below, format_count, format_quantity, join_names
from ..identifiability import explain_unknown_size
from ..identifiability.null_space import ObservabilityProbe
from ..io.measurement_files.fitted_rows import count_fitted_rows, fitted_row_digests
from ..measurements.base import Measurement, residual_of
from ..measurements.camera import select_images
from ..measurements.contact import PointContact, SphereContact
from ..measurements.groups import ERROR_GROUPS, error_group
from ..measurements.images.names import list_images
from ..plausibility.contradictions import MIN_RATIO, own_fit_ratio
from ..plausibility.diagnosis import Diagnosis, is_suspicious
from ..plausibility.displacement import CorrectionSize, measure_correction, workspace_radius
from ..plausibility.drawn_samples import fit_drawn_samples
from ..plausibility.evidence import HAND_BUILT, MANUFACTURED
from ..plausibility.robot_files import LARGEST_ARM, length_of_links
from ..robot.chain import BASE_FRAME
from ..robot.error_families import BACKLASH
from . import cameras
from .evaluation import MIN_SAMPLES, Accuracy, accuracy, compute_errors, fit_nominal
from .evidence import Evidence, count_geometric_directions, diagnose_joint_values
from .model_selection import FULL_SET
from .partition import configuration_groups
from .reweighting import Fit
from .summary import AUTO_OPTIONS, describe_samples, headline, small_sample_note

Status = Literal["ok", "caution", "refused"]

# Statuses, the most severe one last.
STATUSES: tuple[Status, ...] = ("ok", "caution", "refused")

# A joint that moves less than this never moved [rad or m].
MIN_MOTION = 1e-3
# Negative backlash from which on directions of approach are reversed, in standard deviations.
MIN_REVERSED = 5.0
# Displacement by a correction, relative to that of manufacturing errors as the default priors expect them:
# above the first, measurements and robot are to be checked; above the second, no manufacturing error is so
# large. Errors of up to 2 degrees and 10 mm in every joint reach 10.
MAX_USUAL_DISPLACEMENT, MAX_DISPLACEMENT = 12.0, 16.0
# Errors after the fit by their unit: lengths relative to the size of the workspace, rotations [rad], image
# coordinates [px]. Above the first, measurements and robot are to be checked; above the second, they do not
# belong together. The first of image coordinates depends on the type of arm.
MAX_USUAL_ERROR = {"m": 0.02, "rad": 0.1}
MAX_ERROR = {"m": 0.05, "rad": 0.3, "px": 50.0}
# Errors of hold-out samples of this size do not belong to the fit, with the same units. Wrong units
# or rows leave errors as large as the workspace, and wrong zeros of a hand-built arm a tenth of it.
MAX_HOLDOUT_ERROR = {"m": 0.3, "rad": 1.0}
# Longest tool [m] that is believed if measured positions are farther from each other than the tip can be.
MAX_TOOL = 1.0
# More parameters are suggested if they reduce the error at least to this fraction, and not if the error is
# below this fraction of that of the nominal robot: exact data.
MAX_FULL_SET_RATIO, EXACT_FIT_RATIO = 0.8, 1e-6
# Base or tool should be estimated if that alone reduces the RMS error of the nominal robot below this share.
MAX_FRAME_RATIO = 1 / 3
# Positions are wrong by more than the residuals suggest if the predicted error exceeds these by this factor.
# The ratio is at most 0.8 if positions, poses or enough lengths in several directions are measured.
MAX_HIDDEN_RATIO = 2.0
# The same of images, which show two of the three components of an error.
MAX_HIDDEN_IMAGE_RATIO = math.sqrt(3 / 2)
# Reasons for such errors, each with what to measure.
PART_OF_POSITION = (
    "the measurements show only a part of the position",
    "measure the position of the tool in a fixed frame, too",
)
FEW_CONFIGURATIONS = (
    "the measured configurations do not determine the errors between them",
    "measure more poses, in random configurations",
)
FEW_IMAGES = "so few images do not determine the errors between them"
FEW_POINTS = (
    "the measured configurations do not determine the errors between them",
    "touch more points, at known distances from each other",
)
# The placeholder of unstated standard deviations of distances limits the size of the robot.
UNSTATED_DISTANCES = (
    "the standard deviations of the known distances are not stated",
    "state them (column sigma_distance), or touch more points, at known distances from each other",
)
SAME_ORIENTATION = (
    "the tool kept its orientation, so that the measured point on it is hardly determined",
    "measure poses in which the tool is turned",
)
# Largest angle between orientations of the tool that count as one [rad].
MAX_SAME_ORIENTATION = 0.1
# Largest number of iterations of such a fit.
MAX_FRAME_ITERATIONS = 20
# Largest number of further iterations that are tried where a fit did not converge.
MAX_CONTINUED = 500
# A calibrated robot is worse if its squared held-out errors exceed those of the nominal one by this many
# standard errors, and by this many times what the uncertainty of its parameters explains.
MIN_WORSE_T, MIN_WORSE_RATIO = 3.0, 2.0
# RMS error of the nominal robot, as a fraction of the workspace, of values that were computed, not measured.
MAX_COMPUTED_ERROR = 2e-5
# Residuals of touched spheres, relative to their radius, that diameters in place of radii may leave, and the
# smallest factor by which other radii then reduce them.
MAX_RADIUS_ERROR, MIN_RADIUS_GAIN = 0.005, 3.0
# Residuals this many times as large as the stated standard deviations may be the cause of a large correction.
MIN_SIGMA_RATIO = 10.0
# Smallest residuals of a second fit, with the residuals of the first one as standard deviations. If they are
# smaller, the first fit was far from its minimum. They were 1.00 to 1.04 in 29 simulated cases with too small
# standard deviations, and 0.001 and 0.3 in two that did not converge.
MIN_REFITTED_SHARE = 0.5
# Outliers spoil a fit if the error without them is smaller by this factor.
MAX_SPOILED_RATIO = 1.5
# Largest share of hold-out samples that may be equal to fitted ones.
MAX_FITTED_SHARE = 0.1
# Largest error of the zero of a servo that needs no caution [rad].
MAX_ZERO = np.deg2rad(40.0)
# Smaller shares of outliers of a measurement need no caution.
MAX_OUTLIER_SHARE = 0.1
# Smallest error of a measurement that may contradict others, as a fraction of that of the nominal robot.
MIN_CONTRADICTION = 1e-3
# Largest share of outliers of one of several measurements that needs no caution.
MAX_FILE_OUTLIER_SHARE = 0.5
# Smallest number of samples of a measurement for which most of them are called outliers. Beside 60
# inclinations, right positions were called outliers in 2 of 15 simulated cases with 8 positions, in 1 of 21
# with 10, and in none of 21 with 12.
MIN_FILE_SAMPLES = 12
# Share of outliers above which the samples are rather those of two set-ups, tools or robots.
MIN_MIXED_SHARE = 1 / 3
# Largest share of the lines of a file that may disagree with the others, which are then the right ones.
MAX_DEVIATING_SHARE = 0.5
# With fewer independent rows for each direction that they determine, a fit can adapt to 40 % of outliers.
MIN_ROWS_PER_DIRECTION = 2.7
# With fewer, it is examined whether a majority of the samples agrees far better than all of them.
MAX_ROWS_PER_DIRECTION = 4.0
# The first limit where standard deviations are stated. The mean share of an outlier that residuals show, its
# redundancy number (Baarda 1968), is then a third; the fit adapts to the rest. Simulated sets of 8 to 20
# positions with outliers were "ok" with up to 20 times the error of clean samples below this limit, and twice
# above it.
MIN_STATED_ROWS_PER_DIRECTION = 1.5
# Standard deviation of the change of the parameters that leaves special positions, as of a target on an axis
# [m or rad].
GENERIC_CHANGE = 1e-3


@frozen
class Finding:
    """Something about a calibration that its user must know."""

    status: Status  # Verdict that this finding alone leads to
    reason: str  # What was found and what to do, in one or two sentences
    keeps_nominal: bool = False  # Whether the nominal robot should be used in place of the calibrated one
    has_cause: bool = False  # Whether the reason names a verified cause, also of a fit that does not converge


@frozen
class Verdict:
    """Whether a calibrated robot may be used."""

    status: Status  #: "ok", "caution" or "refused"
    #: Sentences, those of the most severe findings first; empty if the status is "ok".
    reasons: tuple[str, ...] = ()
    keeps_nominal: bool = False  #: Whether the nominal robot should be used in place of the calibrated one

    @property
    def is_refused(self) -> bool:
        """Whether the calibrated robot must not be used."""
        return self.status == "refused"

    def to_dict(self) -> dict[str, Any]:
        """Return status and reasons for the JSON document."""
        return {"status": self.status, "reasons": list(self.reasons)}

    @classmethod
    def from_findings(cls, findings: Iterable[Finding]) -> Verdict:
        """Combine findings."""
        ordered = sorted(findings, key=lambda finding: -STATUSES.index(finding.status))
        status = ordered[0].status if ordered else "ok"
        if status == "refused":
            # Whether to keep the nominal robot is decided only by a calibration that may be used.
            ordered = [finding for finding in ordered if not finding.keeps_nominal]
        return cls(
            status,
            tuple(finding.reason for finding in ordered),
            any(finding.keeps_nominal for finding in ordered),
        )


def judge(fit: Evidence) -> Verdict:
    """Judge a calibration by all rules."""
    findings = _unmoved_joints(fit) or _unrelated_images(fit) or _few_images(fit)
    if not any(finding.status == "refused" for finding in findings):
        findings += [
            *(_mixups(fit.diagnosis) or _impossible_size(fit)),
            *_wrong_joint_values(fit),
            *_board_size(fit),
            *_diameters(fit),
            *_signs(fit),
            *_large_zeros(fit),
            *_reversed_directions(fit),
            *_two_robots(fit),
        ]
    if not any(finding.status == "refused" for finding in findings):
        # A mistake in the measurements explains all of these.
        correction, errors = _implausible_correction(fit), _implausible_errors(fit) or _hand_eye_error(fit)
        # A cause of the errors of images explains the correction, too.
        explains_correction = any(error.has_cause for error in errors)
        is_wrong = any(finding.status == "refused" for finding in (*correction, *errors))
        hidden, outliers = _hidden_outliers(fit), _outliers(fit)
        if holdout := [] if is_wrong else _implausible_holdout(fit):
            # The outliers to which the fit did not adapt explain it.
            outliers = [replace(each, status="refused") for each in outliers]
        found = [
            *(outliers if holdout else []),
            *holdout,
            *(_wrong_labels(fit) or _deviating_lines(fit) or _outlying_end(fit)),
            *([*errors, *correction] if explains_correction else [*correction, *errors]),
            *_session(fit),
            *_contradictions(fit),
            *_convergence(fit, [each for each in (*correction, *errors) if each.has_cause]),
            *_hand_eye_images(fit),
            *([] if is_wrong else _far_lenses(fit)),
            *([] if is_wrong else _weak_positions(fit) or _hidden_position_errors(fit)),
            *_fitted_holdout(fit),
            *_held_out_errors(fit),
            *([] if holdout else _unexplained_holdout(fit)),
            *_regional_errors(fit),
            *_few_measurements(fit),
            *(hidden or _few_judged(fit)),
            *([] if holdout else outliers),
            *_outlying_cameras(fit),
        ]
        if any(finding.status == "refused" for finding in found):
            # Outliers to which the fit adapts explain the others.
            found = [replace(each, status="refused") for each in hidden] + [
                f for f in found if f not in hidden
            ]
        else:
            found = [*_small_parameter_set(fit), *found]
        findings += found
    verdict = Verdict.from_findings(findings)
    return Verdict.from_findings([*_other_loss(fit, verdict), *findings])


def _other_loss(fit: Evidence, verdict: Verdict) -> list[Finding]:
    """Return the findings of the loss "auto" if its verdict is more severe, or if outliers spoil the fit."""
    # A loss must not hide mistakes. The method of the paper only asks if there are outliers.
    if fit.with_auto is None or verdict.is_refused or (fit.method != "lm" and not fit.n_outliers):
        return []
    auto = fit.with_auto()
    other = judge(auto)
    option = AUTO_OPTIONS[fit.method]
    if STATUSES.index(other.status) > STATUSES.index(verdict.status):
        return [
            Finding(other.status, f"With {option}: {text}", other.keeps_nominal) for text in other.reasons
        ]
    heads = [headline(each.comparisons) for each in (fit, auto)]
    errors = [head.comparison.after.groups[head.group].rms for head in heads]
    if not fit.n_outliers or errors[0] < MAX_SPOILED_RATIO * errors[1]:
        return []
    text = (
        f"Outliers spoil the fit: {heads[0].after} with them, {heads[1].after} with {option}, which excludes"
    )
    return [Finding("caution", f"{text} those far from the other samples.")]


def _small_parameter_set(fit: Evidence) -> list[Finding]:
    """Advise caution if the default parameters of the robot cannot represent its errors."""
    text = suggest_full_set(fit) if fit.has_default_sets else ""
    reason = f"The default parameters cannot represent the errors: {text}."
    return [Finding("caution", reason)] if text else []


def suggest_full_set(fit: Evidence) -> str:
    """Suggest the full parameter set if it considerably reduces the error on samples that are not fitted."""
    if fit.with_full_set is None:
        return ""
    # The other calibration does not leave out regions.
    current = next(each for each in fit.comparisons if each.title != "region hold-out")
    group, after = next(iter(current.after.groups.items()))
    if current.title == "fitted" or after.rms < EXACT_FIT_RATIO * current.before.groups[group].rms:
        return ""
    full_fit = fit.with_full_set()
    full = full_fit.comparisons[0]
    if not full_fit.converged or full.after.groups[group].rms > MAX_FULL_SET_RATIO * after.rms:
        return ""
    if judge(full_fit).is_refused:
        return ""  # More parameters do not explain the measurements either.
    with_full_set, with_this_set = headline([full]).after, headline([current]).after
    return (
        f"--parameters {FULL_SET} reduces the RMS {ERROR_GROUPS[group].label} on samples that are not "
        f"fitted from {with_this_set} to {with_full_set}"
    )


def _unmoved_joints(fit: Evidence) -> list[Finding]:
    """Refuse measurements in which most joints never moved; advise caution if a few did not."""
    q = [item.configurations() for item in fit.data if item.configurations_per_row]
    if not q:
        return []
    names = fit.chain.joint_names
    moved = np.ptp(np.concatenate(q), 0) > MIN_MOTION
    unmoved = [name for name, has_moved in zip(names, moved, strict=True) if not has_moved]
    if not unmoved:
        return []
    if len(unmoved) == len(names):
        text = "No joint ever moved: all measurements are of one configuration."
        return [Finding("refused", f"{text} Measure configurations that differ in all joints.")]
    text = f"{'Joints' if len(unmoved) > 1 else 'Joint'} {join_names(unmoved)} never moved"
    if (len(names) > 2 and 2 * len(unmoved) > len(names)) or sum(moved) < 2:
        text += ", so the measurements do not show the errors of the robot."
        return [Finding("refused", f"{text} Measure configurations that differ in all joints.")]
    text += ": the calibration holds only where "
    text += "they stand. Move them, too." if len(unmoved) > 1 else "it stands. Move it, too."
    return [Finding("caution", text)]


def _unrelated_images(fit: Evidence) -> list[Finding]:
    """Refuse images that are not those of the joint values or of the robot."""
    sentence = fit.hand_eye_fit.unrelated if fit.hand_eye_fit else ""
    return (_mixups(diagnose_joint_values(fit)) or [Finding("refused", sentence)]) if sentence else []


def _few_images(fit: Evidence) -> list[Finding]:
    """Refuse images that are too few for the type of arm, and say what is missing."""
    needed, advised = fit.arm_type.min_images, fit.arm_type.advised_images
    count = fit.extension.n_configurations if fit.extension else needed
    if count >= needed or (fit.hand_eye and fit.hand_eye.is_noise):
        return []
    n_taken = len(np.unique(configuration_groups(fit.data)))
    if 2 * count < n_taken:
        text = (
            f"Only {count} of {n_taken} different images fit one set-up of camera and board. Check that the "
            "rig file states the board that was photographed."
        )
        return [Finding("refused", text)]
    images = "One image is" if count == 1 else f"{count} different images are"
    text = (
        f"{images} too few for the zeros and signs of this arm. Take at least {needed - count} more, better "
        f"{advised - count}."
    )
    if small := cameras.small_ranges(fit.chain, fit.data):
        text += f" Turn the joints that moved less than half of their range: {', '.join(small)}."
    return [Finding("refused", text)]


def _reversed_directions(fit: Evidence) -> list[Finding]:
    """Advise caution if the backlash of joints is negative, which is impossible."""
    values = zip(fit.errors.parameters, fit.x, fit.std, strict=False)
    names = [
        parameter.name.removesuffix(f".{BACKLASH}")
        for parameter, value, std in values
        if parameter.name.endswith(f".{BACKLASH}") and value < -MIN_REVERSED * std
    ]
    if not names:
        return []
    text = (
        f"The backlash of {join_names(names)} is negative, which is impossible: the directions of approach "
        f"of {'these joints' if len(names) > 1 else 'this joint'} are reversed. Columns approach_JOINT are 1 "
        "if the joint moved towards larger values before it stopped. Without these columns the directions "
        "follow from the order of the rows, which must be that of measurement."
    )
    return [Finding("caution", text)]


def _mixups(diagnosis: Diagnosis) -> list[Finding]:
    """Refuse measurements that another reading explains decisively better, and say how to mend them."""
    if not diagnosis.hypotheses:
        return []
    return [Finding("refused", f"{diagnosis.sentence} {diagnosis.remedy}")]


def _signs(fit: Evidence) -> list[Finding]:
    """Advise caution if signs of joints are open, and say what decides them."""
    return [Finding("caution", question) for question in (fit.signs.questions if fit.signs else ())]


def _large_zeros(fit: Evidence) -> list[Finding]:
    """Advise caution if zeros of servos are far off: the URDF may have other zeros than the servo file."""
    values = zip(fit.errors.parameters, fit.x, strict=False) if fit.signs else ()
    zeros = {p.name.removesuffix(".offset"): x for p, x in values if p.name.endswith(".offset")}
    large = [
        f"{name} by {np.degrees(zeros[name]):.0f}°"
        for name, is_prismatic in zip(fit.chain.moving_joints, fit.chain.prismatic, strict=True)
        if not is_prismatic and abs(zeros.get(name, 0.0)) > MAX_ZERO
    ]
    if not large:
        return []
    text = (
        f"The zeros move farther than usual: {', '.join(large)}. The URDF may have other zeros than the "
        "servo file: with all joints at zero, `dhcal view` has to show the pose that the servos call zero."
    )
    return [Finding("caution", text)]


def _board_size(fit: Evidence) -> list[Finding]:
    """Refuse an arm whose lengths follow from a wrong size of the boards; advise caution if they may."""
    if fit.board_size is None:
        return []
    return [Finding("refused" if fit.board_size.is_decisive else "caution", fit.board_size.sentence)]


def _diameters(fit: Evidence) -> list[Finding]:
    """Refuse spheres that fit far better if the stated radius is a diameter."""
    radii = [item.values for item in fit.data if isinstance(item, SphereContact)]
    if not radii or fit.with_part is None:
        return []
    error = _radius_error(fit)
    limit = MAX_RADIUS_ERROR * np.sqrt(np.mean(np.concatenate(radii) ** 2))
    is_impossible = measure_correction(fit.errors, fit.chain).ratio > MAX_DISPLACEMENT
    if error < limit and not is_impossible:
        return []
    other = fit.with_part([_with_halved_radius(item) for item in fit.data])
    is_better = is_impossible or _radius_error(other) * MIN_RADIUS_GAIN < error
    if not is_better or measure_correction(other.errors, other.chain).ratio > MAX_USUAL_DISPLACEMENT:
        return []
    text = "The column radius probably has the diameters of the spheres: half of these values fit this robot."
    return [Finding("refused", f"{text} State the radii.")]


def _radius_error(fit: Evidence) -> float:
    """Return the median size of the residuals of touched spheres [m]."""
    spheres = [item for item in fit.data if isinstance(item, SphereContact)]
    errors = compute_errors(fit.chain, spheres, fit.instruments)
    return float(np.median(np.abs(np.concatenate([next(iter(each.values())) for each in errors]))))


def _with_halved_radius(item: Measurement) -> Measurement:
    """Return measurements in which the stated radius of spheres is a diameter."""
    return item.replace(values=item.values / 2) if isinstance(item, SphereContact) else item


def _two_robots(fit: Evidence) -> list[Finding]:
    """Refuse samples of two robots."""
    events = [event for event in (fit.session.events if fit.session else ()) if event.kind == "robot"]
    return [Finding("refused", f"{event.finding} {event.consequence}") for event in events]


def _session(fit: Evidence) -> list[Finding]:
    """Advise caution if something happened during the measurement; refuse a robot of an impossible size."""
    if fit.session is None:
        return []
    impossible = [scale for scale in fit.session.scales if scale.is_impossible]
    return [
        Finding("refused" if item in impossible else "caution", text)
        for item, text in zip(fit.session.found, fit.session.sentences, strict=True)
    ]


def _convergence(fit: Evidence, causes: Sequence[Finding]) -> list[Finding]:
    """Refuse a fit that did not converge, and name options with which it does unless causes are known."""
    if fit.converged or any(cause.status == "refused" for cause in causes):
        return []
    text = f"The fit did not converge in {format_count(fit.iterations, 'iteration')}."
    if not causes:
        text += f" {_remedy(fit) or f'It did not in {MAX_CONTINUED} more, either.'}"
    return [Finding("refused", text)]


def _remedy(fit: Evidence) -> str:
    """Name options with which the fit converges; empty if none is known."""
    if limit := _sufficient_iterations(fit):
        return f"Allow more (--max-iterations {limit})."
    if fit.method == "lm" or fit.with_auto is None:
        return ""
    other, option = fit.with_auto(), AUTO_OPTIONS[fit.method]
    if other.converged:
        return f"Use {option}."
    limit = _sufficient_iterations(other)
    return f"Use {option} --max-iterations {limit}." if limit else ""


def _sufficient_iterations(fit: Evidence) -> int | None:
    """Return a limit of iterations, in hundreds, with which the last solution converges; None without one."""
    limit = 100 * math.ceil((fit.solution.iterations + MAX_CONTINUED) / 100)
    options: dict[str, Any] = {"warm_start": fit.solution} if fit.method == "lm" else {}
    with suppress(ConvergenceError):
        if minimize(fit.problem, fit.method, fit.solution.x, limit, **options).converged:
            return limit
    return None


def _impossible_size(fit: Evidence) -> list[Finding]:
    """Refuse a robot that is larger than any arm, whether measurements agree with it or not."""
    if (size := length_of_links(fit.errors.chain)) <= LARGEST_ARM:
        return []
    text = (
        f"The links of the robot are about {size:.0f} m long together. Correct the unit of the lengths in "
        "the robot file, and that of the measurements if it is the same."
    )
    return [Finding("refused", text)]


def _wrong_joint_values(fit: Evidence) -> list[Finding]:
    """Refuse images whose joint values are wrong, if the arm would need a correction of implausible size."""
    if not (fit.camera_stages and fit.errors.has_arm):
        return []
    is_implausible = measure_correction(fit.errors, fit.chain).ratio > MAX_DISPLACEMENT
    return _mixups(diagnose_joint_values(fit)) if is_implausible else []


def _implausible_correction(fit: Evidence) -> list[Finding]:
    """Refuse corrections that are far larger than manufacturing errors."""
    if not fit.errors.has_arm:
        return []
    size = measure_correction(fit.errors, fit.chain)
    if size.ratio <= MAX_USUAL_DISPLACEMENT:
        return []
    status: Status = "refused" if size.ratio > MAX_DISPLACEMENT else "caution"
    sigmas = _too_small_sigmas(fit)
    text = f"The correction {_describe(size)}. {sigmas or _plausible_cause(fit)}"
    return [Finding(status, text, has_cause=bool(sigmas))]


def _too_small_sigmas(fit: Evidence) -> str:
    """Name stated standard deviations as a cause if the correction is plausible with larger ones."""
    ratios = [ratio or 1.0 for ratio in fit.sigma_ratios]
    # Few wrong samples may be the cause as well.
    if max(ratios) < MIN_SIGMA_RATIO or _hidden_outliers(fit):
        return ""
    data = [
        item.with_scaled_sigma(dict.fromkeys(item.residual_groups, ratio))
        for item, ratio in zip(fit.problem.data, ratios, strict=True)
    ]
    solution = minimize(fit.problem.with_data(data))
    share = np.sqrt(solution.system.cost / fit.degrees_of_freedom)
    size = measure_correction(fit.errors, fit.errors.at(solution.x[: len(fit.errors.parameters)]))
    if share < MIN_REFITTED_SHARE or size.ratio > MAX_USUAL_DISPLACEMENT:
        return ""
    return (
        f"The residuals are {max(ratios):.0f} times as large as the stated standard deviations. With larger "
        "ones the correction is plausible: leave the sigma columns out, or correct them."
    )


def _implausible_errors(fit: Evidence) -> list[Finding]:
    """Refuse a robot that does not fit the measurements after the calibration either."""
    for group, after in fit.comparisons[-1].after.groups.items():
        error = after.rms / (_workspace_size(fit) if after.unit == "m" else 1.0)
        if error <= MAX_USUAL_ERROR.get(after.unit, fit.arm_type.max_error):
            continue
        rms = format_quantity(after.rms, after.unit, after.rms_std, small=True)
        text = f"The fit leaves an RMS {ERROR_GROUPS[group].label} of {rms}"
        # With fewer parameters than the robot has errors, the robot is better than before, but not good.
        is_restricted = not fit.camera_stages and _lacks_parameters(fit) and not _missing_frames(fit)
        # Distances alone have no joint values, and say nothing about a robot.
        is_restricted = is_restricted or not any(item.configurations_per_row for item in fit.data)
        has_cause = fit.hand_eye is not None and bool(fit.hand_eye.causes)
        if fit.hand_eye is not None and has_cause:
            text = f"{fit.hand_eye.error_sentence}{fit.hand_eye.likely}"
        else:
            text = f"{text}. {_plausible_cause(fit)}"
        if after.unit == "px":
            error, note = _largest_image_error(fit, error)
            text = f"{note}{text}"
        status: Status = "refused" if error > MAX_ERROR[after.unit] and not is_restricted else "caution"
        return [Finding(status, text, has_cause=has_cause)]
    return []


def _largest_image_error(fit: Evidence, error: float) -> tuple[float, str]:
    """Return the largest error of fitted, left-out and hold-out images [px], and a note on the last ones."""
    if fit.hand_eye is not None and fit.hand_eye.causes:
        error = max(error, fit.hand_eye.error.pixels)
    judged = fit.comparisons[0]
    held_out = judged.after.groups.get("pixels") if judged.title == "hold-out" else None
    if held_out is None or held_out.rms <= max(error, MAX_ERROR["px"]) or fit.holdout_mistake:
        return error, ""
    size = format_quantity(held_out.rms, "px", held_out.rms_std, small=True)
    return held_out.rms, f"Hold-out images have an error of {size}. "


def _workspace_size(fit: Evidence) -> float:
    """Return the RMS distance of the tool from its mean position [m], at most that of tip or measurements."""
    # A fit to measurements of something else can put the tool hundreds of metres away.
    tip = workspace_radius(fit.chain.with_base_and_tool(np.eye(4), np.eye(4)))
    measured = max((se3.rms_radius(p) for item in fit.data if len(p := item.positions())), default=0.0)
    return min(workspace_radius(fit.chain), float(np.clip(measured, tip, tip + MAX_TOOL)) or np.inf)


def _hand_eye_error(fit: Evidence) -> list[Finding]:
    """Advise caution if noise does not explain the error of a hand-eye calibration, and name the cause."""
    if fit.hand_eye is None or fit.hand_eye.is_noise:
        return []
    text = f"{fit.hand_eye.error_sentence}{fit.hand_eye.likely}"
    return [Finding("caution", text, has_cause=bool(fit.hand_eye.causes))]


def _hand_eye_images(fit: Evidence) -> list[Finding]:
    """Advise caution if images of a hand-eye calibration are too few or too similar, or some do not fit."""
    if fit.hand_eye:
        # Images of another camera than they state are named with it.
        n_named = sum(len(found.images) for found in fit.wrong_labels)
        texts = [f"{text}{_hold_stated_poses(fit)}" for text in fit.hand_eye.rotation_sentences]
        texts += fit.hand_eye.wrong_image_sentences if fit.hand_eye.n_wrong_images > n_named else []
        return [Finding("caution", text) for text in texts]
    count = len(np.unique(configuration_groups(fit.data)))
    has_only_images = bool(fit.camera_stages) and all(item.kind == "camera" for item in fit.data)
    if not has_only_images or count >= cameras.MIN_CONFIGURATIONS:
        return []
    text = (
        f"{count} different configurations are too few to judge cameras, boards and arm by left-out images. "
        f"Take images at {cameras.MIN_CONFIGURATIONS} or more."
    )
    return [Finding("caution", text)]


def _far_lenses(fit: Evidence) -> list[Finding]:
    """Advise caution if the lens of a camera is far from the stated one, as in another resolution."""
    return [Finding("caution", text) for text in cameras.describe_far_lenses(fit.data, fit.instruments)]


def _contradictions(fit: Evidence) -> list[Finding]:
    """Advise caution if measurements contradict others: a file of outliers or with another arm, or images."""
    if len(fit.data) < 2 or (fit.hand_eye and not fit.hand_eye.is_noise):
        return []
    texts = [
        _file_of_outliers(item.source or item.kind, int(np.sum(~mask)), len(mask))
        for item, mask in zip(fit.data, fit.is_counted, strict=True)
        if np.mean(~mask) > MAX_FILE_OUTLIER_SHARE
    ]
    texts = texts or _contradicting_files(fit)
    if not texts and fit.camera_stages:
        solved = Fit(fit.data, fit.problem, fit.solution, tuple(fit.weights))
        texts = [cameras.describe_contradiction(solved, fit.comparisons[-1].after)]
    return [Finding("caution", text) for text in texts if text]


def _file_of_outliers(source: str, n_outliers: int, count: int) -> str:
    """Describe a file of which most samples are outliers."""
    if n_outliers < count < MIN_FILE_SAMPLES:
        # Base, tool and a few errors fit the other samples, whether these are right or not.
        return (
            f"{n_outliers} of {count} samples of {source} do not fit the others. So few samples do not show "
            f"which are wrong, if any. Measure at least {MIN_FILE_SAMPLES} different poses of this kind."
        )
    return (
        f"{n_outliers} of {count} samples of {source} are outliers: they contradict the other measurements. "
        "Check the units, the zeros and signs of the joints and the scale of both, and calibrate them by "
        "themselves."
    )


def _contradicting_files(fit: Evidence) -> list[str]:
    """Name the measurements beside images that an arm of their own fits far better than the arm of all."""
    # Points that nothing touches are instruments, too.
    texts, instruments = [], fit.problem.instruments(fit.x)
    for item, comparison in zip(fit.inlier_problem.data, fit.file_comparisons, strict=True):
        if item.rig is not None or not comparison.after.groups:
            continue
        name, after = next(iter(comparison.after.groups.items()))
        if after.rms <= MIN_CONTRADICTION * comparison.before.groups[name].rms:
            continue
        if item.has_stated_sigma and np.mean(residual_of(item, fit.chain, instruments) ** 2) <= 1:
            continue  # The stated noise explains the residuals.
        ratio = own_fit_ratio(fit.inlier_problem, fit.solution.x, item)
        if ratio < MIN_RATIO:
            continue
        both = (after.rms, after.rms / ratio)
        common, own = (format_quantity(rms, after.unit, rms / 10, small=True) for rms in both)
        texts.append(
            f"{item.source or item.kind} contradicts the other measurements: its error is {common} after the "
            f"fit of all, and about {own} after a fit of it alone. Check the zeros and signs of the joints, "
            "the units and the scale of all, and calibrate each by itself."
        )
    return texts


def _weak_positions(fit: Evidence) -> list[Finding]:
    """Advise caution if images of a calibrated arm do not determine the positions of cameras and boards."""
    board = fit.comparisons[-1].after.groups.get("board")
    if fit.hand_eye or not (fit.camera_stages and board) or fit.hand_eye_std is None:
        return []
    rotation = cameras.second_rotation(fit.errors.chain, fit.data)
    text = cameras.describe_weak_positions(fit.hand_eye_std, board.rms, rotation)
    hold = _hold_stated_poses(fit) if rotation < cameras.MIN_ROTATION else ""
    return [Finding("caution", f"{text}{hold}")] if text else []


def _hold_stated_poses(fit: Evidence) -> str:
    """Say how to hold poses that the rig states and the images do not determine; empty without such poses."""
    estimated = {parameter.name for parameter in fit.parameters}
    entries = [entry for entry in cameras.stated_poses(select_images(fit.data)) if f"{entry}.x" in estimated]
    if not entries or not fit.has_joint_values:
        return ""
    kind, entry = entries[0].split("_", 1)
    sets = [name for name in cameras.default_sets(fit.errors.chain, fit.data).split(",") if name != kind]
    return (
        f" The rig file states the pose of {kind} {entry!r}: if it was measured to about 2 mm and 2 mrad, "
        f"hold it with --parameters {','.join(sets)}."
    )


def _describe(size: CorrectionSize) -> str:
    """Describe the size of a correction, to be read after "the correction"."""
    unit = "rad" if size.is_angle else "m"
    moved = format_quantity(size.displacement, unit, 0.1 * size.displacement)
    frame = "the tool" if size.frame == "tool" else f"the axis of {size.frame}"
    return f"moves {frame} by {moved}, {size.ratio:.0f} times what manufacturing errors would"


def _missing_frames(fit: Evidence) -> list[str]:
    """Return which of base and tool are not estimated, if the nominal robot fits much better with them."""
    return needed_frames(fit.problem, fit.data, fit.inliers, fit.comparisons[-1].before)


def needed_frames(
    problem: Problem, data: tuple[Measurement, ...], inliers: Sequence[Measurement], before: Accuracy
) -> list[str]:
    """Return which of base and tool a problem lacks, if the nominal robot fits much better with them."""
    chain, known = problem.errors.chain, problem.known
    frames = {"base": BASE_FRAME, "tool": chain.tool_frame_index}
    estimated = {parameter.error_frame for parameter in problem.errors.parameters}
    missing = [name for name, frame in frames.items() if frame not in estimated]
    if not missing:
        return []
    errors = initialize_frames(select_parameters(chain, "base,tool"), data, known, MAX_FRAME_ITERATIONS)
    nominal, instruments = fit_nominal(errors, inliers, known)
    group, found = next(iter(before.groups.items()))
    is_needed = accuracy(nominal, inliers, instruments).groups[group].rms < MAX_FRAME_RATIO * found.rms
    return missing if is_needed else []


def _lacks_parameters(fit: Evidence) -> bool:
    """Return whether more parameters of the robot than the estimated ones fit the measurements."""
    # Base and tool take the place of some errors of the arm.
    n_minimal = select_parameters(fit.errors.chain, MANUFACTURED).is_of_arm.sum()
    return fit.diagnosis.is_explained and bool(fit.errors.is_of_arm.sum() < n_minimal)


def _is_hand_built(fit: Evidence) -> bool:
    """Return whether the measurements fit a hand-built arm, and its calibration is not refused."""
    if fit.with_low_cost is None:
        return False
    as_hand_built = fit_drawn_samples(fit.errors.chain, fit.data, HAND_BUILT)
    is_explaining = as_hand_built.log > fit.diagnosis.before.log and not is_suspicious(as_hand_built)
    return is_explaining and not judge(fit.with_low_cost()).is_refused


def _configuration_checks(fit: Evidence) -> str:
    """Name what to check of the configurations of images."""
    if fit.has_joint_values:
        return "units, signs and order of the joints, the joint values of each image"
    return "units, notation of rotations and frames of the flange poses, the flange pose of each image"


def _plausible_cause(fit: Evidence) -> str:
    """Name the most plausible cause of an implausible result."""
    if fit.camera_stages:
        return (
            f"Check the links of cameras and boards in the rig file, {_configuration_checks(fit)}, and size, "
            "rows and columns of the boards."
        )
    if fit.session and fit.session.lag:
        return f"{fit.session.lag.finding} {fit.session.lag.consequence}"
    if fit.diagnosis.is_explained:
        if missing := _missing_frames(fit):
            verb = "are" if len(missing) > 1 else "is"
            # The default of a DH table lacks both.
            sets = ",".join([fit.chain.parameters, *missing]) if fit.has_default_sets else FULL_SET
            return (
                f"The measurements fit this robot if its {' and '.join(missing)} {verb} estimated: "
                f"--parameters {sets}."
            )
        if _lacks_parameters(fit):
            return "More parameters of the robot fit the measurements: --parameters minimal,base,tool."
        if fit.rank < len(fit.x) and not fit.problem.weights.any():
            return "Nothing holds the parameters that the measurements do not determine: --priors default."
    if zero := fit.diagnosis.zero:
        return f"{zero.sentence} {zero.remedy}"
    if fit.input_warnings:
        return f"{fit.input_warnings[0]}."
    if fit.session and fit.session.wrong_lengths:
        return fit.session.wrong_lengths[0].finding
    if fit.diagnosis.fits_separately:
        return "Each file fits this robot by itself: base or tool differ between the files."
    if _is_hand_built(fit):
        return (
            "The measurements fit a hand-built arm with larger errors of zeros and lengths: --arm low-cost."
        )
    tried = "No single mistake that is tried explains it, and no pair. " * fit.diagnosis.is_suspicious
    return (
        f"{tried}Check the robot, its tip, the units, order, signs and zeros of the joints, and the notation "
        "of rotations."
    )


def _hidden_position_errors(fit: Evidence) -> list[Finding]:
    """Advise caution if residuals do not show the errors of positions, and state their predicted size."""
    if not (fit.errors.has_arm and fit.shrinkage_factor):
        return []
    unknown = explain_unknown_size(ObservabilityProbe(fit.problem.shown, fit.x))
    std, shown = fit.position_std, _shown_position_error(fit)
    max_ratio = MAX_HIDDEN_IMAGE_RATIO if _has_only_images(fit) else MAX_HIDDEN_RATIO
    if unknown is None and not std > max_ratio * shown:
        return []
    statement, advice = unknown or _wrong_sigmas(fit, max_ratio) or _hidden_cause(fit)
    size = f"of about {format_quantity(std, 'm', 0.1 * std)}" if np.isfinite(std) else "of unknown size"
    text = f"{capitalized(statement)}: errors of positions {size} do not show in the residuals."
    return [Finding("caution", f"{text} {capitalized(advice)}.")]


def _wrong_sigmas(fit: Evidence, max_ratio: float) -> tuple[str, str] | None:
    """Name stated standard deviations as the reason if estimated ones do not hide the errors of positions."""
    stated = fit.stated_noise_factors
    if fit.with_part is None or max(stated.values(), default=0.0) < MIN_SIGMA_RATIO:
        return None
    other = fit.with_part([item.replace(has_stated_sigma=False) for item in fit.data])
    if other.position_std > max_ratio * _shown_position_error(other):
        return None
    name = max(stated, key=lambda name: stated[name])
    errors = f"{ERROR_GROUPS[error_group(name)].label}s"
    return (
        f"the {errors} are {stated[name]:.0f} times as large as their stated standard deviations",
        "leave the sigma columns out, or correct them",
    )


def _hidden_cause(fit: Evidence) -> tuple[str, str]:
    """Return why residuals do not show the errors of positions, and what to measure."""
    of_arm = [item for item in fit.data if item.configurations_per_row]
    if _has_only_images(fit):
        count = f"at least {needed_images(fit)} different" if np.isfinite(fit.position_std) else "more"
        return FEW_IMAGES, f"take {count} images"
    if all(isinstance(item, PointContact) for item in of_arm):
        is_stated = all(item.has_stated_sigma for item in fit.data if not item.configurations_per_row)
        return FEW_POINTS if is_stated else UNSTATED_DISTANCES
    if not all(len(item.positions()) == len(item.rows) for item in fit.data):
        return PART_OF_POSITION
    return SAME_ORIENTATION if _keeps_orientation(fit) else FEW_CONFIGURATIONS


def _has_only_images(fit: Evidence) -> bool:
    """Return whether all measurements are images."""
    return all(item.n_images for item in fit.data)


def needed_images(fit: Evidence) -> int:
    """Return the number of different images with which the residuals show the errors of positions."""
    # The variance of the predicted error falls with the number of images. The error at the board falls with
    # it, but not below that of the fitted images.
    shown = next(each for each in fit.comparisons if each.title == "fitted").after.groups["board"].rms
    n_images = len(np.unique(configuration_groups(fit.data)))
    return math.ceil(n_images * (fit.position_std / (MAX_HIDDEN_IMAGE_RATIO * shown)) ** 2)


def _keeps_orientation(fit: Evidence) -> bool:
    """Return whether the tool has nearly one orientation in all samples."""
    rotations = fit.chain.poses(np.concatenate([item.configurations() for item in fit.data]))[:, :3, :3]
    from_first = rotations @ rotations[0].T
    cosines = (np.trace(from_first, axis1=1, axis2=2) - 1) / 2
    return bool(cosines.min() > np.cos(MAX_SAME_ORIENTATION))


def _shown_position_error(fit: Evidence) -> float:
    """Return the position error that residuals and stated standard deviations suggest [m]; NaN if none."""
    groups = headline(fit.comparisons).comparison.after.groups.values()
    lever = {"m": 1.0, "rad": _workspace_size(fit)}
    for unit in lever:
        errors = [group.rms * lever[unit] for group in groups if group.unit == unit]
        if errors:
            # Stated standard deviations may be larger than the residuals.
            return max(errors) / min(max(fit.unit_weight_std, np.finfo(float).tiny), 1.0)
    return np.nan


def _held_out_errors(fit: Evidence) -> list[Finding]:
    """Refuse a robot that is worse than the nominal one; keep the nominal one if there is no difference."""
    paired = fit.held_out_errors
    if paired is None or fit.holdout_mistake or not (fit.shrinkage_factor and fit.errors.has_arm):
        return []
    if fit.holdout_change and fit.holdout_change.changes[0].kind != "robot":
        return []  # The base or another part moved before these samples, which neither robot contains.
    head = fit.comparisons[0]
    group, after = next(iter(head.after.groups.items()))
    before = head.before.groups[group]
    texts = [format_quantity(side.rms, side.unit, side.rms_std, small=True) for side in (before, after)]
    figures = f"{texts[1]} on {head.title} samples, {texts[0]} for the nominal one"
    if paired.t > MIN_WORSE_T and paired.ratio**2 - 1 > MIN_WORSE_RATIO * _overfitting(fit):
        text = f"The calibrated robot is worse than the nominal one: {figures}. Keep the nominal robot."
        return [Finding("refused", text)]
    # Left-out regions have shown already that the arm is wrong if images change it, and without estimates of
    # cameras and boards the nominal arm would fit worse than before.
    if fit.camera_stages or paired.is_better:
        return []
    text = f"The calibrated robot is not significantly better than the nominal one ({figures})"
    remedy = ", and measure more poses"
    if before.unit == "m" and before.rms < MAX_COMPUTED_ERROR * _workspace_size(fit):
        remedy = (
            ": no real arm fits its nominal model so well, and the measured values were probably computed "
            "with it, such as by the controller. Measure with an independent instrument"
        )
    return [Finding("caution", f"{text}. Keep the nominal robot{remedy}.", True)]


def _fitted_holdout(fit: Evidence) -> list[Finding]:
    """Advise caution if hold-out samples are fitted ones."""
    if not fit.holdout:
        return []
    digests, count = fitted_row_digests(fit.data), sum(len(item.rows) for item in fit.holdout)
    n_fitted = sum(count_fitted_rows(item, digests) for item in fit.holdout)
    if n_fitted <= MAX_FITTED_SHARE * count:
        return []
    text = (
        f"{n_fitted} of {count} hold-out samples are fitted, too, and say nothing about other samples. Hold "
        "out samples that are not fitted."
    )
    return [Finding("caution", text)]


def _unexplained_holdout(fit: Evidence) -> list[Finding]:
    """Advise caution if noise and uncertainty do not explain the errors of hold-out samples."""
    if not fit.is_holdout_unexplained:
        return []
    if mistake := fit.holdout_mistake:
        text = f"The hold-out samples contain a mistake. {mistake.sentence} {mistake.remedy}"
        return [Finding("caution", text)]
    assert fit.holdout_chi_square is not None
    figures = (
        f"hold-out samples have {np.sqrt(fit.holdout_chi_square[0]):.1f} times the errors that the noise of "
        "the fitted ones and the uncertainty of the parameters explain."
    )
    if change := fit.holdout_change:
        text = f"Something changed between the fitted and the hold-out samples: {figures}"
        if change.changes[0].kind == "robot":
            remedy = (
                "More than one part of the robot changed, as by another payload or temperature: state these "
                "for each sample (columns payload[kg] and temperature[degC]), or calibrate again."
            )
        else:
            remedy = f"{change.reasons[0]} Calibrate with both together: the change is then estimated, too."
        return [Finding("caution", f"{text} {remedy}")]
    remedy = "Measure all regions of joint space"
    remedy += ", and allow joint errors (--extend auto)." if fit.extension is None else "."
    return [Finding("caution", f"The model does not explain the arm: {figures} {remedy}")]


def _implausible_holdout(fit: Evidence) -> list[Finding]:
    """Refuse a robot to which hold-out samples do not belong, unless a mistake or a change explains them."""
    judged, change = fit.comparisons[0], fit.holdout_change
    # A base that moved explains large errors, but not several parts that changed a little.
    has_change = change is not None and change.changes[0].kind != "robot"
    if judged.title != "hold-out" or fit.holdout_mistake or has_change:
        return []
    for group, after in judged.after.groups.items():
        size = _workspace_size(fit) if after.unit == "m" else 1.0
        if after.rms > MAX_HOLDOUT_ERROR.get(after.unit, np.inf) * size:
            rms = format_quantity(after.rms, after.unit, after.rms_std, small=True)
            text = (
                f"The fit leaves an RMS {ERROR_GROUPS[group].label} of {rms} on hold-out samples. These or "
                "the fitted ones are wrong: check set-up, units, and order, signs and zeros of the joints in "
                "both."
            )
            return [Finding("refused", text)]
    return []


def _regional_errors(fit: Evidence) -> list[Finding]:
    """Advise caution if the samples of one part of joint space agree better by themselves."""
    is_explained = bool(fit.extension and fit.extension.families) or fit.deviating_lines is not None
    if fit.stage != robust.REGIONAL or is_explained:
        return []
    return [
        Finding(
            "caution",
            "The samples of one part of joint space agree better by themselves than with the others: the arm "
            "has errors that the model does not contain, or the other samples are wrong. Those not very far "
            "off are fitted. Measure more poses in all parts that the arm works in.",
        )
    ]


def _overfitting(fit: Evidence) -> float:
    """Return the relative increase of the squared error that uncertain parameters cause in any robot."""
    return fit.random_folds.prediction_std**2 if fit.random_folds else np.inf


def _few_measurements(fit: Evidence) -> list[Finding]:
    """Advise caution if there are too few measurements to apply the correction in full."""
    if any(finding.keeps_nominal for finding in _held_out_errors(fit)):
        return []  # No part of the correction is applied.
    return [
        Finding("caution", f"{note} {_poses_advice(fit)}", not fit.shrinkage_factor)
        for note in fit.shrinkage_notes
    ]


def _hidden_outliers(fit: Evidence) -> list[Finding]:
    """Advise caution if the measurements could not have revealed outliers; stated errors need fewer rows."""
    is_image = bool(fit.camera_stages or fit.hand_eye)
    if is_image or not fit.shrinkage_factor:
        return []
    limit = _min_rows_per_direction(fit)
    if fit.rows_per_direction >= limit:
        is_searched = not _is_noise_known(fit) and fit.rows_per_direction < MAX_ROWS_PER_DIRECTION
        hidden = fit.hidden_majority if is_searched else None
        if hidden is None:
            return []
        n_good = fit.n_inliers - hidden[0]
        text = (
            f"{n_good} of {fit.n_inliers} samples agree {hidden[1]:.1f} times better by themselves than with"
        )
        return [
            Finding("caution", f"{text} the others, which may be outliers. Measure more poses to see it.")
        ]
    is_contradicted = all(item.has_stated_sigma for item in fit.data) and fit.contradicts_sigma
    found = "The residuals contradict the stated standard deviations. " if is_contradicted else ""
    text = (
        f"{found}So few samples do not reveal outliers: {format_below(fit.rows_per_direction, limit)} "
        f"independent values for each unknown that they determine, {limit:g} are needed. "
        f"{_poses_advice(fit)}"
    )
    return [Finding("caution", text)]


def _min_rows_per_direction(fit: Evidence) -> float:
    """Return the number of independent rows per direction with which outliers show."""
    # Joint errors can explain outliers, too.
    has_families = bool(fit.extension and fit.extension.families)
    is_known = _is_noise_known(fit) and not has_families
    return MIN_STATED_ROWS_PER_DIRECTION if is_known else MIN_ROWS_PER_DIRECTION


def _is_noise_known(fit: Evidence) -> bool:
    """Return whether the standard deviations are stated, and the residuals do not contradict them."""
    return all(item.has_stated_sigma for item in fit.data) and not fit.contradicts_sigma


def _poses_advice(fit: Evidence) -> str:
    """Return the advice to measure the poses that leave no reason about too few samples."""
    if not (count := needed_poses(fit)):
        return "Measure more poses."
    return f"Measure at least {count} different poses{' to be fitted' * bool(fit.holdout)}."


def needed_poses(fit: Evidence) -> int:
    """Return the number of different poses that leaves no reason about too few samples; 0 with enough."""
    # Outliers among images are found in other ways, so that no number is known.
    rows_per_direction = _min_rows_per_direction(fit)
    if fit.camera_stages or fit.hand_eye or fit.rows_per_direction >= rows_per_direction:
        return 0
    # The present rows may be too few to determine all directions that many rows would determine. The
    # parameters are moved: a target that is exactly on an axis hides directions that a fit would determine.
    moved = fit.x + np.random.default_rng(0).normal(0.0, GENERIC_CHANGE, len(fit.x))
    factors = ObservabilityProbe(fit.problem, moved).full_range, fit.solution.system.r
    many, present = (count_geometric_directions(fit, r) for r in factors)
    n_configurations = len(np.unique(configuration_groups(fit.data)))
    growth = max(many / present, 1.0)
    return int(np.ceil(n_configurations * growth * rows_per_direction / fit.rows_per_direction))


def _few_judged(fit: Evidence) -> list[Finding]:
    """Advise caution if all samples together are too few to judge the accuracy."""
    # Few hold-out samples say nothing against the fit of the others.
    judged = headline(fit.comparisons).comparison
    if judged.title in ("fitted", "hold-out") or not small_sample_note(judged):
        return []
    text = f"The accuracy {describe_samples(judged)} is no reliable figure."
    return [Finding("caution", f"{text} Measure at least {MIN_SAMPLES} samples.")]


def _outliers(fit: Evidence) -> list[Finding]:
    """Advise caution if many samples are outliers; refuse images that are mostly outliers."""
    n_outliers = fit.n_outliers
    is_refused = bool(fit.camera_stages) and n_outliers > cameras.MAX_IMAGE_OUTLIER_SHARE * fit.n_samples
    # Images that differ because of a wrong lens or a wrong arm are no outliers.
    is_explained = fit.hand_eye is not None and bool(fit.hand_eye.causes) and not is_refused
    if is_explained:
        return []
    # Those of deviating lines are named with these.
    n_explained = 0 if is_refused or fit.deviating_lines is None else fit.deviating_lines.n_outliers
    n_explained = max(n_explained, sum(len(found.rows) for found in fit.wrong_labels))
    if n_outliers - n_explained < MAX_OUTLIER_SHARE * fit.n_samples:
        return []
    share = f"{100 * n_outliers / fit.n_samples:.0f} %"
    text = f"{n_outliers} of {fit.n_samples} samples ({share}) are outliers{_outlying_images(fit)}"
    remedy = "Check the measurements."
    if n_outliers > MIN_MIXED_SHARE * fit.n_samples:
        remedy = "They may be of another set-up, tool or robot: calibrate them by themselves, too."
    return [Finding("refused" if is_refused else "caution", f"{text}. {remedy}")]


def _outlying_cameras(fit: Evidence) -> list[Finding]:
    """Refuse one of several cameras most of whose images are outliers: it was fitted to others."""
    if not cameras.has_images(fit.data):
        return []
    counts = cameras.count_outlying_images(list(zip(fit.data, fit.is_counted, strict=True)))
    texts = [
        f"{n_outliers} of {n_images} images of camera {name!r} are outliers: it is not calibrated. Check "
        "which camera took its images, and whether it moved."
        for name, n_outliers, n_images in counts
        if 2 * n_outliers > n_images
    ]
    return [Finding("refused", " ".join(texts))] if texts else []


def _wrong_labels(fit: Evidence) -> list[Finding]:
    """Advise caution if outliers fit another touched point, target or camera than they state."""
    if not fit.wrong_labels:
        return []
    text = " ".join(found.sentence for found in fit.wrong_labels)
    text += " Lines with a wrong name are left out of the figures. Correct the names."
    return [Finding("caution", text)]


def _deviating_lines(fit: Evidence) -> list[Finding]:
    """Advise caution if consecutive lines do not agree with the others; refuse if they are the majority."""
    lines = fit.deviating_lines
    if lines is None:
        return []
    parts = [item for item in (*fit.data, *fit.holdout) if item.source == lines.source]
    share = sum(int(np.sum(lines.contains(item))) for item in parts) / sum(len(item.rows) for item in parts)
    status: Status = "refused" if share > MAX_DEVIATING_SHARE else "caution"
    left_out = f"{lines.n_outliers} of {fit.n_samples} fitted"
    if n_held_out := sum(int(np.sum(~mask)) for mask in fit.is_holdout_judged):
        left_out += f" and {n_held_out} of {sum(len(item.rows) for item in fit.holdout)} hold-out"
    note = f"The figures leave out {left_out} samples of these lines."
    if mistake := fit.deviating_mistake:
        return [Finding(status, f"{mistake.sentence} {mistake.remedy} {note}")]
    count = f"{lines.n_outliers} outliers follow each other ({lines.name})"
    if lines.n_outliers < lines.n_fitted:
        count = f"{lines.n_outliers} of {lines.n_fitted} consecutive samples are outliers ({lines.name})"
    text = (
        f"{count}: these lines do not agree with the others. {note} Check what differs in them, such as the "
        "set-up, the units, or signs and order of the joints, and correct them or measure them again."
    )
    return [Finding(status, text)]


def _outlying_end(fit: Evidence) -> list[Finding]:
    """Advise caution if all images from some image on, or up to one, are outliers."""
    if not cameras.has_images((*fit.data, *fit.holdout)):
        return []
    parts = [
        *zip(fit.data, fit.is_counted, strict=True),
        *zip(fit.holdout, fit.is_holdout_counted, strict=True),
    ]
    return [Finding("caution", text) for text in cameras.describe_outlying_end(parts, bool(fit.holdout))]


def _outlying_images(fit: Evidence) -> str:
    """Name the images all of whose corners are outliers; empty without such images."""
    labels = [
        label
        for item, rows in zip(fit.data, fit.outliers, strict=True)
        for label in item.images_within(np.isin(item.rows, rows))
    ]
    if not labels:
        return ""
    images = "one image" if len(labels) == 1 else f"{len(labels)} images"
    return f", among them all corners of {images}{list_images(labels)}"
