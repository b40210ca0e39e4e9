"""Calibration procedure: from a nominal chain and measurements to a calibrated one.

`calibrate` runs these stages in sequence:

1. Select the parameters x of the robot that are unknown (`estimation.select_parameters`). Before that, decide
   which joints of a low-cost arm turn the other way (`plausibility.signs`).
2. Initialize unknown base and tool frames and instrument parameters (`estimation.initialization`).
   Find what happened during the measurement, such as a base that moved, and account for it (`session`). It
   is looked for with the joint errors of stage 6, as these would hide small changes otherwise.
3. Minimize the cost (`estimation.minimize`)

       C(x) = Σ ‖r_i(x)‖² + ‖W·x‖²,

   with r_i the residual of a sample, divided by its standard deviation, and W one over the standard
   deviations of the priors.
4. Estimate noise scales, prior widths and robust weights from the fit, and repeat (`reweighting`).
5. Reduce the correction if there are too few measurements to determine it (`shrinkage`).
6. Add families of joint errors that the measurements support, and reduce the weight of the measurements
   against the priors where residuals are correlated (`model_selection`).
7. Return the evidence together with the calibrated chain (`result`).
"""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from numbers import Integral
from typing import Any, Literal, get_args

import numpy as np

from .. import plausibility
from .._frozen import frozen
from .._typing import Array, Progress
from ..estimation import robust
from ..estimation.error_model import ErrorModel
from ..estimation.initialization import (
    compare_mirror_images,
    compare_tools,
    gross_outliers,
    initialize_frames,
    make_problem,
)
from ..estimation.parameters import EXTENSIONS, LOW_COST, fold_harmonics, select_parameters
from ..estimation.priors import (
    PriorGroups,
    Priors,
    group_default_priors,
    has_default_prior,
    prior_weights,
)
from ..estimation.problem import Problem, merge_instrument_parameters
from ..estimation.solver import METHODS, minimize
from ..estimation.trimmed_squares import find_initial_outliers
from ..exceptions import InvalidArgumentError, UnknownNameError
from ..formatting import join_names
from ..measurements.arguments import as_measurements, require_chain
from ..measurements.base import Measurement, known_conditions
from ..measurements.camera import with_shown_entries
from ..measurements.contact import require_touched_points
from ..parallel import SERIAL, TaskExecutor, one_blas_thread
from ..plausibility.diagnosis import Diagnosis
from ..plausibility.displacement import workspace_radius
from ..plausibility.drawn_samples import has_enough_rows
from ..plausibility.evidence import HAND_BUILT, usual_errors
from ..robot.chain import Chain
from ..robot.conditions import CONDITIONS
from ..robot.error_families import BACKLASH, FAMILIES
from ..session import Session, can_have_session, find_scale
from ..session.timeline import order_samples
from . import cameras, model_selection
from .cameras import (
    arm_type,
    default_sets,
    has_images,
    has_joint_values,
    held_values,
    require_joint_values,
    split_sets,
)
from .cross_validation import leave_regions_out
from .evaluation import accuracy
from .evidence import diagnose, positions_beside_images
from .result import Result, make_result
from .reweighting import Fit, reweight
from .session_check import SessionFit, SessionModels, fit_session, with_directions
from .shrinkage import compute_shrinkage_factor
from .verdict import MAX_USUAL_ERROR, needed_frames

# Decimals of the reference temperature of a model [°C].
REFERENCE_DECIMALS = 1

Method = Literal["lm", "gn"]
# Robust stages of the default loss.
AUTO = robust.LOSSES["auto"].stages
SessionOption = Literal["auto", "unordered", "off"]


def calibrate(
    chain: Chain,
    data: Measurement | Sequence[Measurement],
    parameters: str | Iterable[str] | None = None,
    *,
    method: Method = "lm",
    priors: Priors | None = None,
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    holdout: Measurement | Sequence[Measurement] | Literal["region"] = (),
    known: Mapping[str, float] | None = None,
    loss: str = "auto",
    extend: str | Sequence[str] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    max_iterations: int = 100,
    session: SessionOption = "auto",
    turned: str | Sequence[str] = "auto",
    progress: Progress | None = None,
    executor: TaskExecutor = SERIAL,
) -> Result:
    """Identify the kinematic errors of a robot from measurements.

    Standard deviations that an instrument does not state are estimated with the fit, one per group of
    residuals. Default priors take the size of the identified errors. Measurements without a length scale,
    such as contacts with unknown points, leave the size of the robot to other measurements and to the priors.

    Unknown names and values raise `UnknownNameError`, arguments of a wrong type or contradicting options
    `InvalidArgumentError`, and a diverging Gauss-Newton iteration `ConvergenceError`.

    Args:
        chain: Nominal robot.
        data: One measurement or several of any kinds.
        parameters: Names of parameter sets, keys of `estimation.PARAMETER_SETS` and, for image coordinates,
            of `calibration.cameras.RIG_SETS`; if not given, the chain's own default set, or for image
            coordinates six errors per joint, cameras, boards and lenses, without the errors of the joints if
            the images have poses of the tip in place of joint values.
        method: "lm" (Levenberg-Marquardt), or "gn" for the Gauss-Newton iteration of the paper, which weights
            metres and radians equally.
        priors: "default", "none", or standard deviations by parameter name or pattern on top of the default
            ones, each in the unit of its parameter; "default" for "lm" and "none" for "gn" if not given.
        fix: Names of parameters or sets to hold at their nominal values.
        free: Names of single parameters of any set to identify as well.
        holdout: Measurements that are not fitted but used to judge the result. "region" fits all samples and
            judges the result by further calibrations, each of which leaves out a region of joint space.
        known: Values of instrument parameters by name, such as a surveyed anchor `wire1.x` [m or rad].
        loss: "auto" rejects samples that disagree with a majority and weights all others equally; "linear"
            weights all samples equally; "huber", "cauchy" and "tukey" reduce the weight with the residual.
            Method "gn" always weights all samples equally.
        extend: Families of joint errors that are added where the measurements support them: "auto" for all,
            "none", or names of `estimation.EXTENSIONS`; see `model_selection`. The default is "auto", but
            "none" for method "gn", without priors, and where only base and tool are unknown. Image
            coordinates show backlash and elasticity; other families are named among the parameters.
        bounds: Lowest and highest values by name or pattern of the robot's parameters [m or rad]; base and
            tool have no bounds.
        max_iterations: Largest number of iterations of one solution.
        session: "auto" looks for what happened during the measurement and accounts for it, see `session`, and
            takes the directions of motion from the order of the samples if backlash shows that they are true;
            "unordered" does so for samples that are not in the order of measurement, where only files may
            differ; "off" does not. Method "gn" does not either.
        turned: Names of the joints that turn the other way than in the URDF, or "none": their axes are
            reversed. "auto" compares the signs by evidence for the parameter set "low-cost", and keeps them
            for others.
        progress: Called with the name of the current phase, such as "robust weights", the number of its step
            and the largest number of steps.
        executor: Executor of the chunks of many samples.

    Returns:
        Calibrated chain with uncertainty and accuracy.
    """
    require_chain(chain)
    options = _Options(
        parameters, method, priors, fix, free, known, loss, extend, bounds, max_iterations, session, executor
    )
    if isinstance(holdout, str) and holdout == "region":
        result = _calibrate(chain, as_measurements(data), (), options, turned, progress)
        return with_left_out_regions(result, progress)
    data, holdout = as_measurements(data), as_measurements(holdout, "holdout")
    return _calibrate(chain, data, holdout, options, turned, progress)


def with_left_out_regions(result: Result, progress: Progress | None) -> Result:
    """Return a calibration with its accuracy in regions that are left out of further calibrations."""
    assert result.with_part is not None
    return replace(result, region_comparison=leave_regions_out(result, result.with_part, progress))


@one_blas_thread()
def _calibrate(
    chain: Chain,
    data: tuple[Measurement, ...],
    holdout: tuple[Measurement, ...],
    options: _Options,
    turned: str | Sequence[str],
    progress: Progress | None,
    diagnosis: Diagnosis | None = None,
) -> Result:
    """Identify the errors of a robot, with a diagnosis of mistakes in the measurements if it is known."""
    _check_options(options, data)
    method, loss, max_iterations = options.method, options.loss, options.max_iterations
    for item in (*data, *holdout):
        chain.validated_q(item.configurations())
    require_touched_points((*data, *holdout), options.known or {})
    setup = _set_up(_at_measured_temperature(chain, data), data, holdout, turned, options, progress)
    is_ordered = options.session == "auto"
    begun = _begin(setup)
    # The confirmation of changes and the calibration itself often need the same fits.
    groups_of = cache(partial(_prior_groups, priors=setup.priors))
    reweighted = cache(lambda fit, stages: reweight(fit, stages, groups_of(fit), max_iterations, progress))
    extended = cache(lambda fit, names: model_selection.extend(fit, names, max_iterations, progress))

    @cache
    def supported(fit: Fit, stages: tuple[str, ...], names: Sequence[str]) -> model_selection.ExtendedFit:
        """Fit with robust weights and the families that are supported, from a first fit."""
        chosen = extended(reweighted(fit, stages), names)
        if stages != AUTO or not model_selection.may_mistake_joint_errors(reweighted(fit, stages)):
            return chosen
        everything = extended(reweighted(fit, (robust.KEPT,)), names)
        return model_selection.simpler_explanation(chosen, everything)

    if setup.finds_session and can_have_session((*setup.data, *setup.holdout)):
        models = SessionModels(
            setup.errors,
            partial(_first_fit, setup),
            lambda fit: reweighted(fit, AUTO),
            lambda fit: supported(fit, AUTO, EXTENSIONS),
            lambda fit: (
                supported(fit, AUTO, setup.families) if setup.families else (fit, model_selection.Extension())
            ),
            usual_errors(setup.chain, setup.data),
        )
        begun = fit_session(begun.fit, setup.data, setup.holdout, models, is_ordered, progress)
    if diagnosis:
        begun = replace(begun, diagnosis=diagnosis)
    groups = groups_of(begun.fit)
    if method != "lm":
        result = make_result(begun.fit, 1.0, begun.holdout, method)
    elif has_images(setup.data) and setup.priors != "none":
        result = _calibrate_images(setup, begun, groups)
    else:
        stages = robust.LOSSES[loss].stages
        if is_ordered and setup.finds_session and BACKLASH in setup.families:
            begun = with_directions(begun, lambda fit: supported(fit, stages, setup.families))
        found = begun.session
        fitted = replace(begun, fit=reweighted(begun.fit, stages))
        with_families = partial(supported, begun.fit, stages, setup.families)
        result = _calibrate_samples(setup, fitted, groups, with_families)
        # The scale of one axis and a zero far off make the robot longer or shorter, too.
        is_examined = setup.finds_session and not (found and found.wrong_lengths)
        scale = find_scale(result.problem, result.x) if is_examined else None
        if scale and not result.diagnosis.zero:
            found = found or Session(order_samples(setup.data, setup.holdout), setup.chain, is_ordered)
            found = replace(found, scales=(scale,))
        result = replace(result, session=found)
    result = replace(
        result,
        signs=setup.signs,
        has_default_sets=options.parameters is None,
        with_part=partial(_calibrate_part, chain, setup, turned, result.earlier_diagnosis),
    )
    again = partial(_calibrate, chain, data, holdout, turned=turned, progress=None)
    return replace(result, **_other_calibrations(setup, begun, result, again))


def _calibrate_part(
    chain: Chain,
    setup: _Setup,
    turned: str | Sequence[str],
    diagnosis: Diagnosis | None,
    data: Sequence[Measurement],
) -> Result:
    """Calibrate some samples of a result, with what is known of all: changes, signs and mistakes."""
    # The samples of a result contain the changes during the session.
    options = replace(setup.options, session="off")
    turned = setup.signs.turned if setup.signs else turned
    return _calibrate(chain, tuple(data), (), options, turned, None, diagnosis)


def _other_calibrations(
    setup: _Setup, begun: SessionFit, result: Result, recalibrate: Callable[..., Result]
) -> dict[str, Callable[[], Result]]:
    """Return calibrations of the same samples with other options, which are made when they are needed."""
    options, others = setup.options, {}
    is_lm = options.method == "lm"
    if options.parameters is None and is_lm and not setup.signs and not has_images(setup.data):
        others["with_low_cost"] = partial(recalibrate, options=replace(options, parameters=HAND_BUILT))
    if setup.signs:
        recalibrate = partial(recalibrate, turned=setup.signs.turned)
    if not (is_lm and options.loss == "auto"):
        auto, known = replace(options, method="lm", loss="auto"), result.earlier_diagnosis
        others["with_auto"] = partial(recalibrate, options=auto, diagnosis=known)
    if _suggests_full_set(setup):
        # If nothing happened during the measurement, the search for it is not repeated.
        has_changes = begun.session is not None and not begun.session.changes.is_empty
        full = replace(options, session=options.session if has_changes else "off", **_full_set(setup))
        others["with_full_set"] = partial(recalibrate, options=full)
    return others


@frozen
class _Options:
    """Options of `calibrate`."""

    parameters: str | Iterable[str] | None
    method: Method
    priors: Priors | None
    fix: Sequence[str]
    free: Sequence[str]
    known: Mapping[str, float] | None
    loss: str
    extend: str | Sequence[str] | None
    bounds: Mapping[str, tuple[float, float]] | None
    max_iterations: int
    session: SessionOption
    executor: TaskExecutor


@frozen(eq=False)
class _Setup:
    """Robot, measurements and unknowns of a calibration, which its options determine."""

    chain: Chain  # Nominal robot, its joints turned as decided
    data: tuple[Measurement, ...]
    holdout: tuple[Measurement, ...]
    robot_sets: tuple[str, ...]  # Names of the parameter sets of the robot
    rig_sets: tuple[str, ...]  # Names of those of cameras and boards
    options: _Options
    priors: Priors  # Priors of the options, or those of the method
    progress: Progress | None
    signs: plausibility.SignDecision | None  # Signs of the joints; None if they are those of the URDF
    mistakes: cameras.RigMistakes | None  # Mistakes in the rig, which are corrected; None without images
    known: Mapping[str, float]  # Values of the instrument parameters that are held
    errors: ErrorModel  # Unknown errors of the robot
    first: Mapping[str, float]  # Errors at which a low-cost arm starts, by name
    families: tuple[str, ...]  # Families of joint errors that may be added

    @property
    def finds_session(self) -> bool:
        """Whether what happened during the measurement is looked for."""
        return self.options.session != "off" and self.options.method == "lm"


def _set_up(
    chain: Chain,
    data: tuple[Measurement, ...],
    holdout: tuple[Measurement, ...],
    turned: str | Sequence[str],
    options: _Options,
    progress: Progress | None,
) -> _Setup:
    """Decide the signs of the joints, prepare images, and select the unknown errors."""
    method, priors, free, extend = options.method, options.priors, options.free, options.extend
    priors = priors if priors is not None else ("none" if method == "gn" else "default")
    chosen = options.parameters if options.parameters is not None else default_sets(chain, data)
    robot_sets, rig_sets = split_sets(chosen)
    is_low_cost = LOW_COST in robot_sets
    if is_low_cost:
        chain = replace(chain, parameters=HAND_BUILT)
    require_joint_values((*data, *holdout), [*robot_sets, *free])
    signs = _joint_signs(chain, data, turned, is_low_cost, progress)
    chain = signs.apply(chain) if signs else chain
    mistakes = None
    stated = _validated_known(data, options.known or {})
    if has_images(data):
        shown = with_shown_entries((*data, *holdout))
        data, holdout = shown[: len(data)], shown[len(data) :]
        # With another base or tool, the frames of stated poses are not known yet.
        checked = [] if {"base", "tool"} & {*robot_sets} else rig_sets
        data, holdout, mistakes = cameras.correct_rig(chain, data, holdout, checked)
    # Cameras and boards that no image shows are not part of the problem.
    shown_names = {parameter.name for parameter in merge_instrument_parameters(data)}
    stated = {name: value for name, value in stated.items() if name in shown_names}
    known = {**held_values(data, rig_sets), **stated}
    errors = (
        select_parameters(chain, robot_sets, options.fix, free)
        if robot_sets or free
        else ErrorModel(chain, ())
    )
    families = _extension_families(extend, errors, method, priors)
    _require_conditions([*robot_sets, *(families if extend not in (None, "auto") else ())], data)
    if has_images(data):
        cameras.require_shown_families(extend, families)
    return _Setup(
        chain, data, holdout, tuple(robot_sets), tuple(rig_sets), options, priors, progress, signs, mistakes,
        known, errors, plausibility.first_errors(chain, data) if is_low_cost else {}, families,
    )  # fmt: skip


def _begin(setup: _Setup) -> SessionFit:
    """Fit for the first time; before that, find what happened while images were taken."""
    start = partial(_first_fit, setup)
    if not has_images(setup.data):
        return SessionFit(start(setup.data, setup.errors), setup.holdout)
    if setup.finds_session:
        of_poses = partial(
            calibrate,
            setup.chain,
            parameters=list(dict.fromkeys([*setup.robot_sets, "base", "tool"])),
            priors=setup.priors,
            extend="none",
            max_iterations=setup.options.max_iterations,
            session=setup.options.session,
            turned="none",
            executor=setup.options.executor,
        )
        begun = cameras.fit_image_session(
            setup.chain,
            setup.data,
            setup.holdout,
            of_poses,
            partial(start, errors=setup.errors),
            arm_type(setup.robot_sets),
        )
    else:
        begun = SessionFit(start(setup.data, setup.errors), setup.holdout)
    _require_frames(begun.fit, [*setup.robot_sets, *setup.rig_sets])
    return begun


def _joint_signs(
    chain: Chain,
    data: Sequence[Measurement],
    turned: str | Sequence[str],
    is_low_cost: bool,
    progress: Progress | None,
) -> plausibility.SignDecision | None:
    """Return which joints turn the other way: those that are named, or by evidence for a low-cost arm."""
    if turned != "auto":
        names = turned.split(",") if isinstance(turned, str) else turned
        return plausibility.known_signs(chain, [name.strip() for name in names if name != "none"])
    if not is_low_cost:
        return None
    if progress:
        progress("signs of the joints", 1, 1)
    return plausibility.decide_signs(chain, data)


def _suggests_full_set(setup: _Setup) -> bool:
    """Return whether all errors of the arm may be suggested in place of the chosen parameters."""
    options = setup.options
    is_deliberate = options.method != "lm" or bool(options.fix or options.free or options.bounds)
    if is_deliberate or not has_joint_values((*setup.data, *setup.holdout)):
        return False
    return model_selection.is_restricted([*setup.robot_sets, *setup.rig_sets])


def _full_set(setup: _Setup) -> dict[str, Any]:
    """Return the options that estimate all errors of the arm, without the priors of other parameters."""
    priors = setup.priors
    if isinstance(priors, Mapping):
        names = [p.name for p in select_parameters(setup.chain, model_selection.FULL_SET).parameters]
        priors = {key: std for key, std in priors.items() if fnmatch.filter(names, key)}
    return {"parameters": model_selection.FULL_SET, "priors": priors, "extend": "none"}


def _require_frames(fit: Fit, sets: Sequence[str]) -> None:
    """Raise an error if measurements beside images fit only if base or tool are estimated, too."""
    # Images fit nevertheless, and their errors do not show the cause.
    problem, x = fit.problem, fit.solution.x
    others = tuple(item for item in fit.data if item.rig is None)
    if not has_enough_rows(others):
        return
    fitted = accuracy(problem.chain(x), others, problem.instruments(x))
    found = next(iter(fitted.groups.values()))
    size = workspace_radius(problem.errors.chain) if found.unit == "m" else 1.0
    if found.rms <= MAX_USUAL_ERROR[found.unit] * size:
        return
    if missing := needed_frames(problem, others, others, fitted):
        sources = list(dict.fromkeys(item.source or item.kind for item in others))
        raise InvalidArgumentError(
            f"{join_names(sources)}: the measurements fit this arm only with another {join_names(missing)}; "
            f"add {','.join(missing)} to the parameters: {','.join([*sets, *missing])}"
        )


def _prior_groups(fit: Fit, priors: Priors) -> PriorGroups:
    """Return the groups of parameters whose prior widths are estimated."""
    errors = fit.problem.errors
    return group_default_priors(errors, fit.problem.weights, has_default_prior(errors, priors))


def _first_fit(setup: _Setup, data: tuple[Measurement, ...], errors: ErrorModel) -> Fit:
    """Initialize base, tool and instruments, and solve for the first time, from first errors of the robot."""
    options, first = setup.options, setup.first
    started = replace(errors, chain=errors.at(_start(errors, first))) if first else errors
    if has_images(data):
        data = cameras.with_common_start(errors.chain, data)
    started, data, weights = _initialize(started, data, setup.known, options)
    if not first:
        errors = started
    distortion: Mapping[str, float] = {}
    if has_images(data):
        data, distortion = cameras.with_stated_distortion(data)
    problem = make_problem(errors, data, prior_weights(errors, setup.priors), setup.known)
    problem = replace(problem, executor=options.executor)
    if setup.priors == "none":
        problem = problem.with_prior_weights(np.zeros(len(problem.weights)))
    if options.bounds:
        problem = replace(problem, bounds=_bounds(problem, options.bounds))
    start = np.concatenate([_start(errors, first), problem.instrument_start(distortion)])
    return _solve(problem, start, weights, options, setup.progress)


def _at_measured_temperature(chain: Chain, data: Sequence[Measurement]) -> Chain:
    """Return the chain whose links have the lengths of its model at the mean measured temperature."""
    parts = [item.recorded.temperature for item in data if item.recorded is not None]
    measured = [part for part in parts if part is not None]
    is_known = chain.transmission is not None and chain.transmission.link_terms.any()
    if is_known or not sum(map(len, measured)):
        return chain
    reference = round(float(np.mean(np.concatenate(measured))), REFERENCE_DECIMALS)
    return replace(chain, reference_temperature=reference)


def _require_conditions(sets: Sequence[str], data: Sequence[Measurement]) -> None:
    """Raise an error if a named family of joint errors needs a condition that no sample states."""
    known = known_conditions(data)
    for name in sets:
        if name in FAMILIES and FAMILIES[name].condition not in known:
            condition = CONDITIONS[FAMILIES[name].condition]
            raise InvalidArgumentError(
                f"{name!r} needs the {condition.description}, which no measurement states; expected "
                f"{condition.header} in the measurement file"
            )


def _start(errors: ErrorModel, first: Mapping[str, float]) -> Array:
    """Return the start (p,) of the errors of the robot: the nominal robot, or first values by name."""
    return np.array([first.get(p.name, 0.0) for p in errors.parameters])


def _calibrate_samples(
    setup: _Setup,
    begun: SessionFit,
    groups: PriorGroups,
    with_families: Callable[[], model_selection.ExtendedFit],
) -> Result:
    """Shrink the correction of a fit where the data are too few, and add families of joint errors."""
    fit, holdout, families = begun.fit, begun.holdout, setup.families
    inliers = fit.without_rejected().problem
    shrinkage_factor = compute_shrinkage_factor(inliers, fit.solution, groups)
    result = make_result(fit, shrinkage_factor, holdout, "lm")
    result = replace(result, signs=setup.signs, earlier_diagnosis=begun.diagnosis)
    # Residuals of mixed-up measurements say nothing about other errors.
    if families and shrinkage_factor == 1:
        result = replace(result, earlier_diagnosis=diagnose(result, setup.progress))
    if not families or shrinkage_factor < 1 or result.diagnosis.hypotheses:
        return result
    fit, extension = with_families()
    result_with_families = make_result(fit, shrinkage_factor, holdout, "lm")
    return replace(
        result_with_families, signs=setup.signs, extension=extension, earlier_diagnosis=result.diagnosis
    )


def _calibrate_images(setup: _Setup, begun: SessionFit, groups: PriorGroups) -> Result:
    """Calibrate from images, and look for the scale of the positions beside them."""
    options, found = setup.options, begun.session
    assert setup.mistakes is not None
    stages = robust.LOSSES[options.loss].stages
    fitting = cameras.ImageFitting(
        groups, stages, options.max_iterations, setup.progress, arm_type(setup.robot_sets)
    )
    result = cameras.calibrate_images(
        fitting, begun.fit, setup.chain, begun.holdout, setup.mistakes, setup.families
    )
    if setup.finds_session and (others := positions_beside_images(setup.data)):
        alone = _first_fit(setup, others, setup.errors)
        groups = _prior_groups(alone, setup.priors)
        alone = reweight(alone, stages, groups, options.max_iterations, setup.progress)
        # Images beside them do not show a scale: the corners of a board can take part of it.
        if scale := find_scale(alone.problem, alone.solution.x):
            found = found or Session(order_samples(others, ()), setup.chain, options.session == "auto")
            files = tuple(dict.fromkeys(item.source for item in others if item.source))
            found = replace(found, scales=(replace(scale, files=files),))
    return replace(result, session=found)


def _initialize(
    errors: ErrorModel,
    data: tuple[Measurement, ...],
    known: Mapping[str, float],
    options: _Options,
) -> tuple[ErrorModel, tuple[Measurement, ...], list[Array]]:
    """Initialize base, tool and instruments."""
    started = _initialize_base_and_tool(errors, data, known, options)
    items = tuple(item.initialized(started.chain) for item in data)
    weights = [np.ones(len(item.rows)) for item in data]
    if options.method != "lm" or options.loss == "linear":
        return started, items, weights
    if all(len(item.positions()) == len(item.rows) for item in data):
        is_gross = gross_outliers(started.chain, data)
    else:
        has_positions = any(len(item.positions()) for item in data)
        is_gross = find_initial_outliers(started if has_positions else errors, data, known, started.chain)
        if any(each.any() for each in is_gross):
            kept = tuple(item.take(~each) for item, each in zip(data, is_gross, strict=True))
            started = _initialize_base_and_tool(errors, kept, known, options)
            items = tuple(
                item.initialized_from(started.chain, ~each) for item, each in zip(data, is_gross, strict=True)
            )
    return started, items, [np.where(each, robust.ZERO_WEIGHT, 1.0) for each in is_gross]


def _initialize_base_and_tool(
    errors: ErrorModel, data: tuple[Measurement, ...], known: Mapping[str, float], options: _Options
) -> ErrorModel:
    """Initialize base and tool, from several tool offsets where no position is measured."""
    started = initialize_frames(errors, data, known, options.max_iterations)
    return compare_tools(started, data, known, options.max_iterations)


def _check_options(options: _Options, data: Sequence[Measurement]) -> None:
    """Raise an error if there are no data, an option is unknown, or options contradict each other."""
    parameters, method, loss = options.parameters, options.method, options.loss
    if not sum(len(item.rows) for item in data):
        raise InvalidArgumentError("no measurements to fit; expected at least one sample")
    if not isinstance(parameters, Iterable | None):
        raise InvalidArgumentError(
            f"parameters has type {type(parameters).__name__}; expected names of parameter sets"
        )
    if method not in METHODS:
        raise UnknownNameError(f"unknown method {method!r}; choose from {', '.join(METHODS)}")
    if loss not in robust.LOSSES:
        raise UnknownNameError(f"unknown loss {loss!r}; choose from {', '.join(robust.LOSSES)}")
    if options.session not in get_args(SessionOption):
        choices = ", ".join(get_args(SessionOption))
        raise UnknownNameError(f"unknown session option {options.session!r}; choose from {choices}")
    if not isinstance(options.max_iterations, Integral) or options.max_iterations < 1:
        raise InvalidArgumentError(
            f"max_iterations is {options.max_iterations}; expected at least 1, a whole number"
        )
    if loss not in ("auto", "linear") and method != "lm":
        raise InvalidArgumentError(
            f"loss {loss!r} requires method 'lm'; method {method!r} weights all samples equally"
        )
    if options.bounds and method != "lm":
        raise InvalidArgumentError(f"bounds require method 'lm'; method {method!r} does not support bounds")


def _extension_families(
    extend: str | Sequence[str] | None, errors: ErrorModel, method: str, priors: Priors
) -> tuple[str, ...]:
    """Return the families that may be added, by default none if method, priors or parameters forbid it."""
    if extend in ("none", ""):
        return ()
    is_possible = method == "lm" and priors != "none"
    if extend is None or extend == "auto":
        frames = errors.only_frames
        is_frames_only = frames is not None and len(frames.parameters) == len(errors.parameters)
        return EXTENSIONS if is_possible and not is_frames_only else ()
    if not is_possible:
        raise InvalidArgumentError(
            "an extension requires method lm and priors; leave out --method gn and --priors none"
        )
    return tuple(name.strip() for name in extend.split(",")) if isinstance(extend, str) else tuple(extend)


def _validated_known(data: tuple[Measurement, ...], known: Mapping[str, float]) -> Mapping[str, float]:
    """Return the known values after a check that each belongs to an instrument parameter of the data."""
    names = [parameter.name for parameter in merge_instrument_parameters(data) if not parameter.is_local]
    for name, value in known.items():
        if name not in names:
            choice = f"choose from {', '.join(names)}" if names else "these measurements have none"
            raise UnknownNameError(
                f"known value of {name!r}: no such instrument parameter; {choice}", "known"
            )
        if not np.isfinite(value):
            raise InvalidArgumentError(f"known {name!r}: {value} is not a finite number; expected m or rad")
    return known


def _bounds(problem: Problem, bounds: Mapping[str, tuple[float, float]]) -> Array:
    """Return the lowest and highest x, shape (2, p), from bounds of values by name or pattern."""
    errors = problem.errors
    robot = [p for p, is_of_arm in zip(errors.parameters, errors.is_of_arm, strict=True) if is_of_arm]
    limits = np.tile([[-np.inf], [np.inf]], len(problem.weights))
    for pattern, (low, high) in bounds.items():
        bounded = [p for p in robot if fnmatch.fnmatchcase(p.name, pattern)]
        if not bounded:
            choices = ", ".join(fold_harmonics(p.name for p in robot))
            raise UnknownNameError(
                f"bounds for {pattern!r}: no such parameter; choose from {choices}", "bounds"
            )
        for p in bounded:
            if not low <= p.nominal <= high:
                raise InvalidArgumentError(
                    f"bounds for {pattern!r}: [{low}, {high}] must contain the nominal value {p.nominal:g} "
                    f"of {p.name}"
                )
            limits[:, problem.errors.parameters.index(p)] = low - p.nominal, high - p.nominal
    return limits


def _solve(
    problem: Problem,
    start: Array,
    weights: Sequence[Array],
    options: _Options,
    progress: Progress | None,
) -> Fit:
    """Solve a problem with given weights; `reweight` iterates method "lm" to full convergence later."""
    data = problem.data
    if any((w != 1).any() for w in weights):
        problem = problem.with_data([item.with_weights(w) for item, w in zip(data, weights, strict=True)])
    method, max_iterations = options.method, options.max_iterations
    further: dict[str, Any] = {"loose": True} if method == "lm" else {}
    if progress:
        further["progress"] = lambda iteration, cost: progress("fit", iteration, max_iterations)
    solution = minimize(problem, method, start, max_iterations, **further)
    if method == "lm":
        solution = compare_mirror_images(problem, solution, max_iterations)
    fit = Fit(data, problem, solution, tuple(weights))
    errors = problem.errors
    if not errors.has_transmission:
        return fit
    # Gravity torques depend on the identified robot: solve again with those of the solution.
    problem = replace(problem, errors=errors.with_current_loads(solution.x[: len(errors.parameters)]))
    second = minimize(problem, method, solution.x, max_iterations, **further)
    return replace(fit, problem=problem, solution=second, previous_iterations=solution.iterations)
