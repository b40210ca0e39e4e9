"""Confirmation of changes during a session: by mistakes in the file, and by a model with all joint errors.

A mistake in the whole file, such as the sign of a joint, leaves errors that changes during the session reduce
a little. Changes with which no ordinary robot fits the measurements are therefore compared with mistakes in
the measurements as they were read. They are dropped if a mistake explains the measurements better, or if no
robot fits with them.

Errors that the geometry leaves, such as gear errors, differ between configurations. If the configurations at
the begin of a session differ from those at its end, such errors look like a change; and they hide small
changes. The other way round, joint errors imitate a change along a smooth path. Changes are therefore looked
for with the geometry alone first. They are kept if no joint errors are supported beside them and the noise is
not larger than with joint errors in place of the changes. Otherwise changes are looked for with the families
of joint errors that the measurements support without changes, and kept only if the measurements support them
beside all families, too. Where the configurations change along the session, joint errors that were fitted
without a change can have taken most of it. They are therefore fitted again with the changes that were found,
until both stay the same: first from no changes, and from those of the geometry if none are confirmed.

Backlash depends on the direction of the last motion of a joint. A file that states no directions may be in
the order of measurement, from which they follow, or not: then they are those of chance, and explain nothing.
They are taken from the order if backlash then explains a considerable part of the residuals that all other
families of joint errors leave, and if it is supported like other families.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from .._frozen import frozen
from .._typing import Array, Progress
from ..estimation.error_model import ErrorModel
from ..estimation.priors import effective_parameters
from ..estimation.problem import Problem
from ..estimation.qr import rank
from ..estimation.robust import MAD_TO_STD
from ..estimation.solver import minimize
from ..estimation.uncertainty import FamilyGain
from ..measurements.base import Measurement, known_conditions
from ..plausibility.diagnosis import Diagnosis, is_suspicious, leaves_residuals
from ..plausibility.displacement import workspace_radius
from ..plausibility.drawn_samples import fit_drawn_samples
from ..plausibility.evidence import Evidence
from ..plausibility.mixups import diagnose_mixups
from ..robot.chain import BASE_FRAME, Chain
from ..robot.error_families import BACKLASH, FAMILIES
from ..session import Session, find_session
from ..session.causes import Cause, Step
from ..session.robot_changes import RobotChanges
from ..session.search import MAX_SAMPLE_COST, MIN_LOG_EVIDENCE, MIN_NOISE, has_enough_rows
from ..session.timeline import order_samples
from .model_selection import MAX_HINT_RATIO, ExtendedFit, family_gains, outlier_weights, with_joint_errors
from .partition import of_same_files
from .reweighting import Fit
from .verdict import MAX_USUAL_ERROR

# Logarithm of the evidence that each coefficient of a change costs.
COST_PER_COEFFICIENT = 5.0
# Smallest RMS effect of a change beside all joint errors, in standard deviations. Joint errors that take most
# of the effect where configurations were measured can be wrong by many millimetres elsewhere.
MIN_CONFIRMED_EFFECT = 0.25
# Largest number of fits of joint errors with the changes that were found beside the joint errors before.
MAX_REFITS = 4
# Largest number of iterations of the fit of changes and joint errors.
MAX_ITERATIONS = 20
# Smallest share of the degrees of freedom that the noise is estimated with.
MIN_FREEDOM = 0.05
# Robust weight above which a sample is no outlier of the first fit with changes.
MIN_KEPT_WEIGHT = 0.5
# Ratio of the residuals without changes to those with them above which joint errors need not be compared.
MIN_GROSS_RATIO = 10.0
# Condition that backlash depends on.
APPROACH = FAMILIES[BACKLASH].condition
# Warning where the directions were taken from the order.
ASSUMED_ORDER = (
    "the measurements show backlash of the joints, with directions of motion that follow from the order of "
    "the rows; confirm this order by the line '# rows: in order' above the header, or use --unordered"
)

# Largest growth of links, relative to the reach of the robot: ten times that of aluminium at 50 K.
MAX_GROWTH = 0.01
# Largest step and drift of the zero of a joint that is believed if the robot does not fit otherwise [rad].
MAX_ZERO_STEP, MAX_ZERO_DRIFT = np.deg2rad((30.0, 10.0))
# Angles of zeros that differ by less are the same [rad].
SAME_ZERO = np.deg2rad(3.0)
# Largest errors of a robot that is not compared with mistakes, in default standard deviations.
MAX_WIDTH = 8.0

# Function that adds the families of joint errors that the measurements support to a fit.
Extend = Callable[[Fit], ExtendedFit]


@frozen
class SessionFit:
    """First fit of measurements, with what happened during the session."""

    fit: Fit  # First fit, with the changes that are believed
    holdout: tuple[Measurement, ...]  # Measurements that are not fitted, with these changes
    session: Session | None = None  # What happened; None if it was not looked for
    diagnosis: Diagnosis | None = None  # Diagnosis of mistakes in the measurements; None if none was made


@frozen
class SessionModels:
    """Fits that are compared to decide whether changes are believed."""

    errors: ErrorModel  # Errors of the robot that are unknown
    # Fit measurements for the first time, with given errors that are unknown.
    start: Callable[[tuple[Measurement, ...], ErrorModel], Fit]
    reweighted: Callable[[Fit], Fit]  # Fit with robust weights, from a first fit
    # Fit with robust weights and the families of joint errors that are supported among all of them, and among
    # those of the options, from a first fit.
    extended: Extend
    supported: Extend
    sets: str  # Name of the widths of ordinary errors in `plausibility.evidence`


def fit_session(
    fit: Fit,
    data: tuple[Measurement, ...],
    holdout: tuple[Measurement, ...],
    models: SessionModels,
    is_ordered: bool,
    progress: Progress | None,
) -> SessionFit:
    """Find what happened during a session, and fit the measurements of a first fit again with it."""
    extended, extension = models.supported(fit)
    found = _find_confirmed(_Search(fit, data, holdout, models, is_ordered, extended, extension.families))
    session = found.session
    if (
        session is not None
        and session.has_two_robots
        and _has_mistake_on_one_side(session, data, models.sets)
    ):
        session = replace(session, events=()).described()
        found = replace(found, session=session)
    if session is None or not _has_changes(found):
        return found
    is_likely, diagnosis = _compare_with_mistakes(
        session, session.chain, (data, holdout), session.applied(data, holdout), models.sets, progress
    )
    if not is_likely:
        nothing = Session(session.timeline, session.chain, session.is_ordered)
        if session.has_two_robots and not (diagnosis and diagnosis.hypotheses):
            # The other changes do not explain the samples of the second robot.
            nothing = replace(nothing, events=session.events)
        return SessionFit(fit, holdout, nothing, diagnosis)
    return replace(found, diagnosis=diagnosis)


def _has_mistake_on_one_side(session: Session, data: Sequence[Measurement], sets: str) -> bool:
    """Return whether a mistake in the samples of one of two robots explains what differs."""
    start = session.timeline.number_of(session.events[0].after)
    numbers = session.timeline.numbers[: len(data)]
    sides = [
        [
            item.take(mask)
            for item, each in zip(data, numbers, strict=True)
            if (mask := choose(each, start)).any()
        ]
        for choose in (np.less, np.greater_equal)
    ]
    return any(diagnose_mixups(session.chain, side, sets).hypotheses for side in sides)


def _find_confirmed(search: _Search) -> SessionFit:
    """Find what happened during a session, and keep the changes that are confirmed."""
    found = by_geometry = search.find(search.problem, search.fit.solution.x)
    if search.families:
        # Joint errors can imitate a change. They are dropped if none is supported beside the change.
        if _has_changes(found):
            changed, remaining = search.models.supported(found.fit)
            is_kept = _keeps_all_parts(found, changed)
            if is_kept and not remaining.families and _log_noise(changed) <= _log_noise(search.extended):
                return found
        # Joint errors that are not in the model hide small changes, and look like changes.
        found = search.confirmed(search.find_beside(search.extended, found))
        if not _has_changes(found) and _has_changes(by_geometry):
            # Joint errors that were fitted without the changes can have taken them.
            found = search.find_beside(search.refitted(by_geometry), by_geometry)
    return search.confirmed(found)


@frozen(eq=False)
class _Search:
    """Search for changes with the geometry alone, or beside joint errors."""

    fit: Fit  # First fit
    data: tuple[Measurement, ...]
    holdout: tuple[Measurement, ...]
    models: SessionModels
    is_ordered: bool
    extended: Fit  # Fit with the families of joint errors that the measurements support without changes
    families: Sequence[str]  # Names of these families

    @property
    def problem(self) -> Problem:
        """Problem of the geometry, without weights of the samples."""
        return replace(self.fit.problem, data=self.fit.data)

    def find(self, problem: Problem, x: Array) -> SessionFit:
        """Find what happened, from a solution, and fit again with the changes."""
        chain, errors = self.fit.problem.errors.chain, self.models.errors
        if self.relative_base:
            problem, x = _with_held_base(problem, x, self.relative_base)
            placed = chain.with_base_and_tool(problem.errors.chain.base, chain.tool)
            errors = replace(_with_held(errors, self.relative_base), chain=placed)
        session = replace(find_session(problem, x, self.holdout, self.is_ordered), chain=chain)
        if session.changes.is_empty:
            return SessionFit(self.fit, self.holdout, session)
        changed, changed_holdout = session.applied(self.data, self.holdout)
        if not session.changes.tool.is_identity:
            # Changes act in the axes of base and tool, which would turn by chance where no row shows them.
            errors = _with_held(errors, self.unseen_axes)
        return SessionFit(self.models.start(changed, errors), changed_holdout, session)

    @cached_property
    def relative_base(self) -> frozenset[str]:
        """Names of the parameters of a base with which instruments at unknown places can move, or none."""
        # The axes of a motion of the base would then turn by chance.
        problem, r = self.fit.problem, self.fit.solution.system.r
        names = frozenset(p.name for p in problem.errors.parameters if p.error_frame == BASE_FRAME)
        is_base = np.array([p.name in names for p in problem.parameters], bool)
        is_instrument = np.arange(len(is_base)) >= len(problem.errors.parameters)
        is_relative = rank(r[:, is_base | is_instrument]) == rank(r[:, is_instrument])
        return names if names and is_relative else frozenset()

    @property
    def unseen_axes(self) -> frozenset[str]:
        """Names of the parameters of base and tool that no row shows."""
        errors, system = self.models.errors, self.fit.solution.system
        n = len(errors.parameters)
        is_unseen = ~errors.is_of_arm & (system.column_norms[:n] <= system.roundoff)
        return frozenset(errors.parameters[i].name for i in np.flatnonzero(is_unseen))

    def find_beside(self, extended: Fit, found: SessionFit) -> SessionFit:
        """Find what happened beside the joint errors of a fit, which are fitted again with what was found."""
        last = found
        for _ in range(MAX_REFITS):
            with_all, x = with_joint_errors(self.problem, self.fit.solution.x, extended, self.families)
            if not has_enough_rows(with_all, order_samples(self.fit.data, ())):
                return found
            last, found = found, self.find(with_all, x)
            if not _has_changes(found) or _agree(last, found):
                return found
            extended = self.refitted(found)
        # What happened does not come and go with small changes of the joint errors.
        return min(found, last, key=lambda each: len(_causes(each)))

    def refitted(self, found: SessionFit) -> Fit:
        """Fit the joint errors again, with changes."""
        assert found.session is not None
        return _with_changes(self.extended, self.models.reweighted(found.fit), found.session)

    def confirmed(self, found: SessionFit) -> SessionFit:
        """Return what was found, without changes that the measurements do not support beside joint errors."""
        session = found.session
        if session is None or not _has_changes(found) or session.has_two_robots:
            return found
        fit = self.models.reweighted(found.fit)
        # Joint errors that a fit lacks can make half of the samples outliers.
        is_kept = _keeps_all_parts(found, fit) or (
            bool(self.families) and _keeps_all_parts(found, self.refitted(found))
        )
        if is_kept and _confirm_changes(session, self.fit, fit, self.models.extended):
            return found
        return SessionFit(self.fit, self.holdout, without_changes(session))


def _causes(found: SessionFit) -> tuple[Cause, ...]:
    """Return what was found in the order of its discovery."""
    return found.session.causes if found.session else ()


def _agree(first: SessionFit, second: SessionFit) -> bool:
    """Return whether two sessions have the same causes, with values that differ by less than their errors."""
    one, other = _causes(first), _causes(second)
    return len(one) == len(other) and all(
        (a.block.kind, a.block.of) == (b.block.kind, b.block.of)
        and len(a.values) == len(b.values)
        and bool(np.all(np.abs(a.values - b.values) <= np.sqrt(np.diag(b.covariance))))
        for a, b in zip(one, other, strict=True)
    )


def _has_changes(found: SessionFit) -> bool:
    """Return whether anything changed during a session."""
    return found.session is not None and not found.session.changes.is_empty


def _log_noise(fit: Fit) -> float:
    """Return the mean logarithm of the noise of the rows of a fit, corrected for its unknowns."""
    residuals = residuals_of(fit)
    n_rows = sum(r.size for r in residuals)
    freedom = 1 - effective_parameters(fit.problem, fit.solution) / n_rows
    sizes = np.concatenate([size.ravel() for size in _sizes(residuals, 0.5)])
    return float(np.mean(np.log(sizes)) - 0.5 * np.log(max(freedom, MIN_FREEDOM)))


def _with_held(errors: ErrorModel, names: frozenset[str]) -> ErrorModel:
    """Hold parameters that the measurements do not determine."""
    held, free = (tuple(p for p in errors.parameters if (p.name in names) is each) for each in (True, False))
    undetermined = (*errors.undetermined, *held)
    return replace(errors, parameters=free, fixed=(*errors.fixed, *held), undetermined=undetermined)


def _with_held_base(problem: Problem, x: Array, names: frozenset[str]) -> tuple[Problem, Array]:
    """Return a problem and unknowns x (p,) with the base held where it is at x."""
    errors = problem.errors
    chain = errors.chain.with_base_and_tool(problem.chain(x).base, errors.chain.tool)
    kept = np.array([p.name not in names for p in problem.parameters], bool)
    bounds = None if problem.bounds is None else problem.bounds[:, kept]
    errors = replace(_with_held(errors, names), chain=chain)
    return replace(problem, errors=errors, weights=problem.weights[kept], bounds=bounds), x[kept]


def _compare_with_mistakes(
    session: Session,
    chain: Chain,
    as_measured: tuple[Sequence[Measurement], Sequence[Measurement]],
    with_changes: tuple[Sequence[Measurement], Sequence[Measurement]],
    sets: str,
    progress: Progress | None,
) -> tuple[bool, Diagnosis | None]:
    """Return whether changes explain measurements better than mistakes do, and a diagnosis that was made."""
    # Both are fitted and held-out measurements.
    evidence = fit_drawn_samples(chain, with_changes[0], sets)
    grows = any(d.kind == "links" and d.size > MAX_GROWTH * workspace_radius(chain) for d in session.drifts)
    turns = _turns_far(session)
    if not (grows or turns or leaves_residuals(evidence) or evidence.width > MAX_WIDTH):
        return True, None if is_suspicious(evidence) else Diagnosis(evidence)
    as_read = _diagnose(chain, as_measured, sets, progress)
    if grows or (as_read.is_certain and _explains_better(as_read, Diagnosis(evidence))):
        return False, as_read
    changed = _diagnose(chain, with_changes, sets, progress)
    if _is_changed_zero(session, changed):
        changed = Diagnosis(changed.before)
    if as_read.hypotheses and _explains_better(as_read, changed):
        return False, as_read
    is_impossible = leaves_residuals(evidence) and (turns or _fits_no_robot(chain, evidence))
    return (False, as_read) if is_impossible and not changed.hypotheses else (True, changed)


def _diagnose(
    chain: Chain,
    measured: tuple[Sequence[Measurement], Sequence[Measurement]],
    sets: str,
    progress: Progress | None,
) -> Diagnosis:
    """Look for a mistake in fitted measurements; held-out ones of the same files confirm it."""
    data, holdout = measured
    return diagnose_mixups(chain, data, sets, progress, of_same_files(holdout, data))


def _is_changed_zero(session: Session, diagnosis: Diagnosis) -> bool:
    """Return whether the zero of a joint is off by as much as it changed: the file has no mistake."""
    sizes = [(session.chain.joint_names.index(e.of), e.size) for e in session.events if e.kind == "joint"]
    offsets = [each.offsets for each in diagnosis.hypotheses]
    return any(abs(abs(each[j]) - size) < SAME_ZERO for each in offsets for j, size in sizes if j in each)


def _keeps_all_parts(found: SessionFit, fit: Fit) -> bool:
    """Return whether a fit with the changes keeps most samples of each part between two steps."""
    # A part that it rejects shows nothing of what the steps before and after it state.
    assert found.session is not None
    steps = sorted({cause.shape.number for cause in _causes(found) if isinstance(cause.shape, Step)})
    parts = np.searchsorted(steps, found.session.timeline.fitted_numbers, side="right")
    is_kept = np.concatenate(fit.weights) > MIN_KEPT_WEIGHT
    return all(np.mean(is_kept[parts == part]) > 0.5 for part in np.unique(parts))


def _confirm_changes(session: Session, without: Fit, fit: Fit, extended: Extend) -> bool:
    """Return whether changes explain measurements beside all families of joint errors, in first fits."""
    # Joint errors do not imitate changes that are far larger than what they leave. Others are fitted with the
    # families that the measurements support without the changes.
    changes = [cause for cause in session.causes if not cause.block.is_of_recording]
    timeline = session.timeline
    share = min([1.0, *(timeline.shorter_side(c.shape.number) for c in changes if isinstance(c.shape, Step))])
    # Half of the samples on the shorter side of a step have larger residuals.
    sizes = [_sizes(residuals_of(each), 1 - share / 2) for each in (without, fit)]
    if max(np.max(a / b) for a, b in zip(*sizes, strict=True)) > MIN_GROSS_RATIO:
        return True
    unchanged, _ = extended(without)
    residuals = [residuals_of(each) for each in (unchanged, _with_changes(unchanged, fit, session))]
    noise = [MAD_TO_STD * size for size in _sizes(residuals[1], 0.5)]
    costs = [
        sum(
            float(np.sum(np.minimum(np.sum((r / s) ** 2, 0), len(r) + MAX_SAMPLE_COST)))
            for r, s in zip(each, noise, strict=True)
        )
        for each in residuals
    ]
    # Correlated residuals, which joint errors leave along a path, count less.
    gain = (costs[0] - costs[1]) / unchanged.problem.temperature
    n_rows = sum(r.size for r in residuals[1])
    n_coefficients = sum(len(cause.values) for cause in changes)
    needed = 2 * (MIN_LOG_EVIDENCE + COST_PER_COEFFICIENT * n_coefficients)
    return bool(gain > max(needed, MIN_CONFIRMED_EFFECT**2 * n_rows * share))


def _with_changes(fit: Fit, changed: Fit, session: Session) -> Fit:
    """Fit the model of a fit to measurements with changes; what is no outlier with them counts."""
    x, timeline = fit.solution.x, session.timeline
    unweighted = [item.with_weights(1 / w) for item, w in zip(fit.problem.data, fit.weights, strict=True)]
    fitted, _ = session.applied(tuple(unweighted), timeline.data[timeline.n_fitted :])
    problem = fit.problem.with_data(fitted)
    # Samples that were outliers without the changes may be far from x, which was fitted to the others.
    weights = [
        np.where(w > MIN_KEPT_WEIGHT, 1.0, at_x)
        for w, at_x in zip(changed.weights, outlier_weights(problem, x, fit.weights), strict=True)
    ]
    problem = problem.with_data([item.with_weights(w) for item, w in zip(fitted, weights, strict=True)])
    solution = minimize(problem, "lm", x, MAX_ITERATIONS, loose=True)
    return replace(fit, data=changed.data, problem=problem, solution=solution, weights=tuple(weights))


def _sizes(residuals: Sequence[Array], share: float) -> list[Array]:
    """Return the size that a share of the samples does not exceed, of each row of residuals (k, m) each."""
    return [np.fmax(np.quantile(np.abs(r), share, axis=1, keepdims=True), MIN_NOISE) for r in residuals]


def residuals_of(fit: Fit) -> Sequence[Array]:
    """Return the residuals of a fit, (k, m) each, without the weights of the samples."""
    return fit.problem.residuals(fit.solution.x, fit.data)


def _explains_better(as_read: Diagnosis, changed: Diagnosis) -> bool:
    """Return whether a mistake is more likely than changes; a mistake in one file has evidence of its own."""
    return not changed.is_explained if as_read.source else as_read.log > changed.log


def _fits_no_robot(chain: Chain, evidence: Evidence) -> bool:
    """Return whether the residuals are far larger than those of any robot."""
    limits = MAX_USUAL_ERROR["m"] * workspace_radius(chain), MAX_USUAL_ERROR["rad"]
    return evidence.length_scale > limits[0] or evidence.angle_scale > limits[1]


def _turns_far(session: Session) -> bool:
    """Return whether the zero of a joint changed by more than what is believed."""
    changes = [*((e, MAX_ZERO_STEP) for e in session.events), *((d, MAX_ZERO_DRIFT) for d in session.drifts)]
    return any(each.kind == "joint" and each.unit == "rad" and each.size > most for each, most in changes)


def without_changes(session: Session) -> Session:
    """Return a session in which nothing changed, and whose lag is not corrected."""
    kept = tuple(cause for cause in session.causes if cause.block.is_of_recording)
    lag = replace(session.lag, is_corrected=False) if session.lag else None
    return replace(session, changes=RobotChanges(), causes=kept, events=(), lag=lag).described()


def with_directions(begun: SessionFit, supported: Callable[[Fit], ExtendedFit]) -> SessionFit:
    """Return a first fit with the directions of motion if its samples show that these are true."""
    data, holdout = begun.fit.data, begun.holdout
    is_path = all(item.configurations_per_row == 1 for item in (*data, *holdout))
    if not is_path or APPROACH in known_conditions((*data, *holdout)):
        return begun
    directions = order_samples(data, holdout).directions
    gain = _gain(supported(begun.fit)[0], directions)
    if gain is None or not gain.is_significant or gain.ratio > MAX_HINT_RATIO:
        return begun
    of_fit, of_holdout = directions[: len(data)], directions[len(data) :]
    first = replace(
        begun.fit,
        data=_with_directions(data, of_fit),
        problem=begun.fit.problem.with_data(_with_directions(begun.fit.problem.data, of_fit)),
    )
    is_supported = BACKLASH in supported(first)[1].supported
    return replace(begun, fit=first, holdout=_with_directions(holdout, of_holdout)) if is_supported else begun


def _gain(fit: Fit, directions: Sequence[Array]) -> FamilyGain | None:
    """Return what backlash would explain of the residuals of a fit, all other errors unchanged."""
    problem, x = fit.problem, fit.solution.x
    problem = replace(
        problem,
        errors=ErrorModel(problem.chain(x), ()),
        data=_with_directions(problem.data, directions),
        known=problem.instruments(x),
        weights=np.empty(0),
        bounds=None,
    )
    return family_gains(problem, np.empty(0), fit.weights, (BACKLASH,)).get(BACKLASH)


def _with_directions(data: Sequence[Measurement], directions: Sequence[Array]) -> tuple[Measurement, ...]:
    """Return measurements with directions of motion."""
    pairs = zip(data, directions, strict=False)
    return tuple(item.with_conditions(**{APPROACH: each}) for item, each in pairs)


def has_assumed_directions(data: Sequence[Measurement], fitted: Sequence[Measurement]) -> bool:
    """Return whether the directions of fitted measurements were taken from their order."""
    return APPROACH in known_conditions(fitted) and APPROACH not in known_conditions(data)
