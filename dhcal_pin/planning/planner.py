"""Planning of measurements: which poses to measure, and which accuracy to expect.

Steps of `plan`:

1. Draw candidates within the joint limits and the workspace, or take the given ones.
2. Collect the knowledge before measuring (`information`), and the whitened Jacobian rows of all candidates.
3. Select poses greedily, improve the selection by exchange (`exchange`), and move the poses to
   better ones between the candidates (`refinement`), all for one criterion (`criteria`).
4. Predict the error over the number of poses, for the plan and for random poses.
5. Order the poses as a short tour whose moves are free of collisions (`tour`).

For joint correction curves the poses fill the bins of each joint evenly (`bin_filling`) before the criterion
decides, and step 4 also predicts the standard deviation of the curves (`curve_prediction`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .._typing import Array, Progress
from ..calibration.cameras import judged_boards
from ..estimation import qr
from ..estimation.priors import Priors
from ..estimation.uncertainty import Uncertainty
from ..exceptions import InvalidArgumentError, UnknownNameError
from ..measurements.base import Measurement, Noise
from ..robot.chain import Chain
from ..robot.collision import CollisionChecker
from ..robot.error_families import COMPLIANCE, CURVES, FINE_CURVES, GAIN, HARMONICS
from ..robot.sampling import ConfigurationSampler, WorkspaceConstraints, limits_with_margin, scale_joint_units
from .criteria import AOptimality, BiasVarianceCriterion, Criterion, DOptimality, EOptimality
from .curve_prediction import CurvePrediction, predict_curves
from .exchange import (
    MAX_EXCHANGE_CANDIDATES,
    CandidateSet,
    compute_sqrt_covariance,
    improve_by_exchange,
    select_greedily,
)
from .information import Information, PlannedCalibration, add_joint_scatter
from .refinement import DesignGoal, refine
from .sources import ImageSource, ToolSource
from .task_error import TaskError
from .tour import find_tour
from .views import CameraViews, PlannedImages

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Margins to the joint limits [rad] and [m].
MARGIN_ANGLE, MARGIN_LENGTH = np.deg2rad(2.0), 5e-3
# Configurations over which predicted errors are averaged if no task is given.
N_TASK_SAMPLES = 300
# Part of the task, relative to its norm, that may be unobservable without a note.
UNOBSERVABLE_RTOL = 1e-6
# Random plans per number of poses, numbers of poses, and smallest number of poses that they are drawn from.
N_RANDOM_PLANS, N_RANDOM_SIZES, MIN_RANDOM_POSES = 200, 6, 600
# Largest number of candidates; more need too much memory and do not improve the plan.
MAX_CANDIDATES = 50_000
# Smallest distance of two poses, in the units of `scale_joint_units`: the effects that no model describes are
# similar at closer poses. If random poses are closer, their median distance is used.
MIN_DISTANCE_RAD = np.deg2rad(20.0)
# Diminishing returns: this many more poses lower the error that a check shows by less than this fraction.
EXTRA_POSES, MIN_EXTRA_GAIN = 10, 0.01
# Phases of `plan`, in their order.
PHASES = (
    "drawing candidates",
    "selecting poses",
    "exchanging poses",
    "moving poses",
    "predicting errors",
    "path",
)
# A measurement of one configuration says at most as much about the geometry as the pose of the tool.
MAX_POSE_COMPONENTS = 6
# Numbers of poses for which the knowledge of the joint correction curves is predicted.
CURVE_SIZES = (50, 100, 200)


@dataclass(frozen=True, eq=False)
class Plan:
    """Configurations to measure, and the accuracy to expect.

    Attributes:
        q: Joint positions in the order of a short tour, shape (n, dof) [rad or m].
        index: Indices of the poses among given candidates, shape (n,); None if candidates were drawn and
            refined.
        criterion: Name of the criterion.
        information: Knowledge before the measurement.
        task: Combinations of the unknowns whose variances sum to the mean squared position error over the
            task, shape (p, w) [m].
        sizes: Numbers of poses, shape (c,); numbers above n add poses to the plan.
        errors: Predicted RMS position error over the task for each number of poses, shape (c,) [m].
        random_sizes: Numbers of random poses, shape (d,).
        random_errors: Predicted error of random poses, median of several draws, shape (d,) [m].
        recommended_size: Number of poses with diminishing returns: ten more lower the error that a check with
            this instrument shows by less than 1 %. None if it is larger than all sizes.
        notes: Sentences on what was not considered.
        curves: Expected knowledge of the joint correction curves without the plan, with it and with plans of
            `CURVE_SIZES` poses, by size; empty unless the criterion fills bins.
        ways: Way points before each pose, shapes (w, dof) [rad or m]; most are empty.
        is_way_free: Whether the moves to each pose are free of collisions, see `tour`; true for the first.
            Empty if there is nothing to collide with.
        views: Planned images of each camera; empty for other kinds of measurement.
        error_with_points: Predicted RMS position error over the task if the calibration finds that corners of
            boards are not where the rig states them, and estimates them [m]; None if it does not judge them.
    """

    q: Array
    index: Array | None
    criterion: str
    information: Information
    task: Array
    sizes: Array
    errors: Array
    random_sizes: Array
    random_errors: Array
    recommended_size: int | None
    notes: tuple[str, ...]
    curves: tuple[CurvePrediction, ...] = ()
    ways: tuple[Array, ...] = ()
    is_way_free: tuple[bool, ...] = ()
    views: tuple[CameraViews, ...] = ()
    error_with_points: float | None = None

    @cached_property
    def log_det(self) -> float:
        """Logarithm of the determinant of the information matrix, with unknowns in units of their priors."""
        rows = self.information.rows(self.q).transpose(2, 1, 0)
        sqrt_covariance = compute_sqrt_covariance(self.information.prior_factor, rows)
        return -2 * float(np.sum(np.log(np.abs(np.diag(sqrt_covariance)))))

    @property
    def error(self) -> float:
        """Predicted RMS position error over the task after these poses [m]."""
        return self.expected_error(self.q)

    @property
    def random_error(self) -> float:
        """Predicted error of as many random poses, median of several draws [m]."""
        return float(self.random_errors[-1])

    @property
    def relative_error(self) -> float:
        """Predicted error divided by that of as many random poses."""
        return self.error / self.random_error

    def plot_curve(self, ax: Axes | None = None) -> Axes:
        """Plot the predicted error over the number of poses, of planned and of random ones.

        Example:
            `plan.plot_curve().figure.savefig("poses.png")`

        Args:
            ax: Axes to draw into; a new figure if None.

        Returns:
            The axes.
        """
        from ..visualization.plots import plot_plan_curve  # lazy import: matplotlib is slow to load

        return plot_plan_curve(
            (self.sizes, self.errors),
            (self.random_sizes, self.random_errors),
            (len(self.q), self.error),
            self.recommended_size,
            ax,
        )

    def expected_error(self, q: Array) -> float:
        """Predict the RMS position error over the task after measuring at other configurations.

        Args:
            q: Joint positions, shape (m, dof) [rad or m].

        Returns:
            RMS position error [m].
        """
        return self.information.predict_error(self.information.rows(q).transpose(2, 1, 0), self.task)


def plan(
    chain: Chain,
    count: int,
    *,
    kind: str = "pose",
    noise: Noise | None = None,
    parameters: str | None = None,
    priors: Priors = "default",
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    criterion: str = "D",
    data: Sequence[Measurement] = (),
    known: Mapping[str, float] | None = None,
    prior_uncertainty: Uncertainty | None = None,
    images: PlannedImages | None = None,
    task: Array | None = None,
    candidates: int | Array = 5000,
    space: WorkspaceConstraints | None = None,
    margin: Noise | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Plan:
    """Select configurations to measure.

    Drawn candidates are within the joint limits and the workspace and free of collisions; the selected poses
    are then moved to better ones between the candidates. Given candidates are not moved.

    Args:
        chain: Nominal robot with base and tool as far as they are known.
        count: Number of poses.
        kind: Kind of measurement with one configuration per sample.
        noise: Standard deviations of instrument and robot together [m, rad]; None for those of `data`.
        parameters: Parameter sets to identify, as in `calibrate`.
        priors: Prior standard deviations, as in `calibrate`.
        fix: Parameters to fix, as in `calibrate`.
        free: Parameters to free, as in `calibrate`.
        criterion: "D" volume of the uncertainty, "A" mean variance, "E" largest variance, all in units of the
            priors; "task" predicted position error over the task; "robust" this and, in equal parts, the
            error by joint gains, harmonics and compliance that the fit omits, with an additional joint
            scatter of one arcminute; "curves" fills the bins of each joint evenly (see `robot.coverage`), and
            "D" decides between poses that do so equally well; "curves,task" and the like name another
            criterion for that.
        data: Existing measurements to complement.
        known: Values of known instrument parameters, as in `calibrate`.
        prior_uncertainty: Uncertainty of the calibration that made the chain; it replaces the priors.
        images: Cameras, boards and limits of their views, for images in place of another kind; `noise` is
            then the scatter of the tool from configuration to configuration.
        task: Joint positions where the tool must be accurate, shape (m, n) [rad or m]; None for the given
            candidates, or for the whole joint space.
        candidates: Number of candidates to draw, or joint positions to choose from, shape (m, n) [rad or m].
        space: Constraints of drawn candidates; floor and obstacles also hold for the moves between poses.
        margin: Margins to the joint limits: `rotation` [rad], `position` [m].
        seed: Seed of all random draws.
        progress: Called at the start of each of `PHASES` with its name, its number and the number of phases.

    Returns:
        Poses and predicted errors.

    Raises:
        UnknownNameError: The criterion is unknown.
        InvalidArgumentError: The number of poses or candidates is out of range, too few candidates are
            feasible, or the criterion is `curves` and no joint is revolute.
    """
    main_criterion, fills_bins = _split_criterion(criterion)
    if count < 1:
        raise InvalidArgumentError(f"{count} poses: expected at least 1")
    if isinstance(candidates, int) and not count <= candidates <= MAX_CANDIDATES:
        raise InvalidArgumentError(
            f"{candidates} candidates for {count} poses: expected from {count} to {MAX_CANDIDATES}"
        )
    phases = _report_phases(progress)
    next(phases)
    rng = np.random.default_rng(seed)
    margin = margin or Noise(MARGIN_LENGTH, MARGIN_ANGLE)
    space = space or WorkspaceConstraints()
    sampler, notes = None, []
    source = ToolSource(kind) if images is None else ImageSource(images)
    if isinstance(candidates, int):
        everywhere = ConfigurationSampler.from_chain(chain, space, margin.rotation, margin.position)
        sampler = source.restrict(everywhere)
        q = sampler.draw(candidates, rng)
        notes += sampler.notes
        task_q = (
            replace(everywhere, workspace=WorkspaceConstraints(floor=space.floor)).draw(N_TASK_SAMPLES, rng)
            if task is None
            else chain.validated_q(task)
        )
    else:
        q = chain.validated_q(candidates)
        task_q = q if task is None else chain.validated_q(task)
    omitted_sets = ()
    if main_criterion == "robust":
        omitted_sets, noise = (GAIN, HARMONICS, COMPLIANCE), noise and add_joint_scatter(chain, q, noise)
    bin_columns, sets = np.zeros(0, int), parameters
    if fills_bins:
        bin_columns = np.flatnonzero(~chain.is_prismatic)
        sets = _without_curves(parameters or chain.parameters)
        if not bin_columns.size:
            raise InvalidArgumentError(
                f"criterion {criterion!r}: only revolute joints have correction curves, and the robot has no "
                "revolute joint"
            )
    planned = PlannedCalibration(
        chain, source.kind, noise, sets, priors, fix, free, data, known or {}, prior_uncertainty, images
    )
    # Unknown corners of boards add many rows and columns, and the same error to all plans of one size. Poses
    # are therefore chosen as if the corners were exact; the errors that are reported contain them.
    exact = planned.with_free_points(())
    full_information = Information.from_prior(exact, q, omitted_sets)
    information = full_information.without_omitted()
    coordinates = scale_joint_units(chain, q)
    existing = np.concatenate(
        [
            coordinates[:0],
            *(scale_joint_units(chain, item.q) for item in data if item.configurations_per_row == 1),
        ]
    )
    candidate_set = CandidateSet.from_rows(
        full_information.rows(q),
        coordinates,
        _min_distance(coordinates, count, rng),
        _always_feasible if sampler is None else lambda i: sampler.is_feasible(q[i]),
        bin_columns,
    )
    if sampler is None:
        candidate_set.infeasible[:] = ~source.can_measure(chain.poses(q))
    every_nth = np.arange(0, len(q), max(1, len(q) // N_TASK_SAMPLES))
    observable = information.observable_directions(
        candidate_set.rows_of(every_nth)[..., full_information.fitted]
    )
    whole = TaskError.over(information, task_q)
    # Parts of the task error that no measurement of this kind determines, such as the base pose with wires of
    # unknown anchors, do not depend on the selection.
    ranking = whole.observable_part(observable)
    # With unknown corners, the scale of robot and board together is such a part, but the priors limit it.
    expected = ranking if exact is planned else TaskError.over(Information.from_prior(planned, q), task_q)
    unobservable = np.linalg.norm(whole.combinations - ranking.combinations)
    if unobservable > UNOBSERVABLE_RTOL * np.linalg.norm(ranking.combinations):
        notes.append(
            f"the predicted error does not contain the base pose, which {source.kind} measurements do not "
            "determine"
        )
    goal = DesignGoal(
        expected=expected,
        ranking=ranking,
        full_information=full_information,
        criterion=CRITERIA[main_criterion].create(observable, ranking.combinations, full_information, task_q),
        n_observable=len(observable),
        existing=existing,
        sampler=sampler,
        bin_columns=bin_columns,
    )
    prior_factor = full_information.prior_factor
    next(phases)
    greedy = select_greedily(candidate_set, prior_factor, count, goal.criterion, np.zeros(0, int), existing)
    if len(greedy) < count:
        # Not enough candidates have the minimum distance, so select the others without it.
        candidate_set = replace(candidate_set, min_distance=0.0)
        greedy = select_greedily(
            candidate_set, prior_factor, count - len(greedy), goal.criterion, greedy, existing
        )
    if len(greedy) < count:
        raise InvalidArgumentError(
            f"only {len(greedy)} of {len(q)} candidates are feasible; expected at least {count}: "
            f"relax the constraints or use more candidates{source.condition}"
        )
    next(phases)
    selected = improve_by_exchange(candidate_set, prior_factor, greedy, goal.criterion, existing)
    next(phases)
    if sampler is None:
        refined = q[selected]
    else:
        refined = refine(goal, q[selected], sampler, candidate_set.min_distance, rng)
    next(phases)
    curves = ()
    if fills_bins:
        curve_information = Information.from_prior(replace(planned, parameters=parameters), q, (CURVES,))
        plans = _plans_of_sizes(goal, candidate_set, q, greedy, refined)
        measured = np.concatenate([q[:0], *(item.configurations() for item in data)])
        curves = predict_curves(curve_information, plans, measured, q[~candidate_set.infeasible])
    sizes, errors = _error_curve(goal, candidate_set, q, greedy, selected, refined, rng)
    random_sizes, random_errors = _random_errors(goal, candidate_set, q, sizes[sizes <= count], rng)
    next(phases)
    checker = CollisionChecker.from_chain(chain, space.environment) if sampler is None else sampler.collision
    notes += [checker.note] if sampler is None and checker.note else []
    limits = limits_with_margin(chain, margin.rotation, margin.position)
    # Given candidates stay as they are.
    can_turn = ~chain.is_prismatic & (sampler is not None)
    tour = find_tour(refined, checker, *limits, can_turn, rng)
    error_with_points = _error_with_points(planned, q, task_q, refined)
    if error_with_points is not None:
        notes.append(
            "the predicted error takes corners of boards as exact; if the calibration has to estimate them "
            f'(points = "auto" in the rig), it is {1e3 * error_with_points:.4g} mm'
        )
    return Plan(
        q=tour.q,
        index=selected[tour.order] if sampler is None else None,
        criterion=criterion,
        information=expected.information,
        task=expected.combinations,
        sizes=sizes,
        errors=errors,
        random_sizes=random_sizes,
        random_errors=random_errors,
        recommended_size=_recommended_size(sizes, errors, expected.information.instrument.position_sigma),
        notes=tuple(notes),
        curves=curves,
        ways=tour.ways,
        is_way_free=() if checker.geometry is None else tour.is_way_free,
        views=source.summarize(chain.poses(tour.q)),
        error_with_points=error_with_points,
    )


def _error_with_points(planned: PlannedCalibration, q: Array, task_q: Array, refined: Array) -> float | None:
    """Predict the error of a plan if the calibration finds that corners of boards must be estimated.

    Args:
        planned: Calibration that is planned.
        q: Joint positions of all candidates, shape (m, n) [rad or m].
        task_q: Joint positions of the task, shape (t, n) [rad or m].
        refined: Joint positions of the plan, shape (c, n) [rad or m].

    Returns:
        RMS position error [m]; None if the rig says for each board whether its corners are estimated, or if
        the calibration does not judge them.
    """
    if planned.images is None:
        return None
    judged = judged_boards(planned.images.rig.boards)
    if not judged:
        return None
    information = Information.from_prior(planned.with_free_points([*planned.images.free_boards, *judged]), q)
    if not information.errors.parameters:
        return None
    return TaskError.over(information, task_q).after(refined)


def _report_phases(progress: Progress | None) -> Iterator[None]:
    """Report the next phase each time that the iterator is advanced."""
    for number, phase in enumerate(PHASES, 1):
        if progress:
            progress(phase, number, len(PHASES))
        yield


def _robust_criterion(
    observable: Array, combinations: Array, full_information: Information, task_q: Array
) -> Criterion:
    """Create the criterion of bias and variance over a task; without omitted unknowns, that of the variance.

    Args:
        observable: Observable directions of the fitted unknowns, shape (r, p).
        combinations: Observable combinations of the task, shape (p, w).
        full_information: Knowledge about fitted and omitted unknowns.
        task_q: Joint positions of the task, shape (m, n).

    Returns:
        Criterion on all unknowns.
    """
    fitted = full_information.fitted
    if fitted.all():
        return AOptimality(combinations)
    all_combinations = full_information.task_combinations(task_q)
    fitted_combinations = observable.T @ (observable @ all_combinations[fitted])
    # Displacements over the task that a fit can produce, and their share of the effect of the omitted
    # unknowns.
    displacements, std, _ = np.linalg.svd(fitted_combinations.T, full_matrices=False)
    displacements = displacements[:, std > UNOBSERVABLE_RTOL * std[0]]
    return BiasVarianceCriterion(
        fitted, fitted_combinations @ displacements, displacements.T @ all_combinations[~fitted].T
    )


@dataclass(frozen=True)
class CriterionOption:
    """Criterion that users select by name.

    Attributes:
        create: Function from observable directions, task combinations, knowledge and joint positions of the
            task to the criterion.
        help: One line for help texts.
    """

    create: Callable[[Array, Array, Information, Array], Criterion]
    help: str


# Criterion that fills the bins of the joints evenly before another one decides.
FILLS_BINS = "curves"

CRITERIA: dict[str, CriterionOption] = {
    "D": CriterionOption(
        lambda observable, combinations, full_information, task_q: DOptimality(),
        "volume of the confidence ellipsoid of all parameters",
    ),
    "A": CriterionOption(
        lambda observable, combinations, full_information, task_q: AOptimality(observable.T),
        "mean variance of the parameters",
    ),
    "E": CriterionOption(
        lambda observable, combinations, full_information, task_q: EOptimality(observable),
        "largest variance of any combination of parameters",
    ),
    "task": CriterionOption(
        lambda observable, combinations, full_information, task_q: AOptimality(combinations),
        "mean position error over the task",
    ),
    "robust": CriterionOption(
        _robust_criterion, "as `task`, and also limits the bias from unmodelled effects"
    ),
    FILLS_BINS: CriterionOption(
        lambda observable, combinations, full_information, task_q: DOptimality(),
        "fills each joint's bins of 5° evenly, for joint correction curves; then as `D`, or as another "
        "criterion in `curves,task`",
    ),
}


def _split_criterion(text: str) -> tuple[str, bool]:
    """Split the name of a criterion, or two names joined by a comma of which one is `curves`."""
    names = text.split(",")
    main = [name for name in names if name != FILLS_BINS] or [FILLS_BINS]
    if len(names) > 2 or len(main) > 1 or main[0] not in CRITERIA:
        raise UnknownNameError(
            f"unknown criterion {text!r}; choose from {', '.join(CRITERIA)}, or combine {FILLS_BINS} with "
            f"another one as in {FILLS_BINS},task"
        )
    return main[0], FILLS_BINS in names


def _without_curves(sets: str) -> str:
    """Return names of parameter sets without that of the curves, unless there is no other."""
    # The bins determine the curves. As unknowns of the criterion, their hundreds of coefficients would make
    # the selection slow without making it better.
    others = [name for name in sets.split(",") if name.strip() not in (CURVES, FINE_CURVES)]
    return ",".join(others) or sets


def _always_feasible(_: int) -> bool:
    """Accept every candidate."""
    return True


def _min_distance(coordinates: Array, count: int, rng: np.random.Generator) -> float:
    """Choose the smallest distance of `count` poses among coordinates (m, n)."""
    sample = coordinates[rng.permutation(len(coordinates))[:count]]
    if len(sample) < 2:
        return 0.0
    distances = np.linalg.norm(sample[:, None] - sample[None], axis=2)
    distances += np.diag(np.full(len(sample), np.inf))
    return min(MIN_DISTANCE_RAD, float(np.median(distances.min(1))))


def _plans_of_sizes(
    goal: DesignGoal, candidates: CandidateSet, q: Array, greedy: Array, refined: Array
) -> list[Array]:
    """Select plans of several sizes that fill the bins of the joints.

    Args:
        goal: What to optimize.
        candidates: All candidates.
        q: Their joint positions, shape (m, dof) [rad or m].
        greedy: Greedy selection in its order, shape (n,).
        refined: Joint positions of the plan, shape (n, dof) [rad or m].

    Returns:
        Joint positions of an empty plan, of `refined` and of plans of `CURVE_SIZES` poses, by size.
    """
    prior_factor, nearby = goal.full_information.prior_factor, replace(candidates, min_distance=0.0)
    n_more = max(0, CURVE_SIZES[-1] - len(greedy))
    order = select_greedily(nearby, prior_factor, n_more, goal.criterion, greedy, goal.existing)
    plans = {size: q[order[:size]] for size in (0, *CURVE_SIZES) if size <= len(order)}
    return [plan for _, plan in sorted((plans | {len(refined): refined}).items())]


def _error_curve(
    goal: DesignGoal,
    candidates: CandidateSet,
    q: Array,
    greedy: Array,
    selected: Array,
    refined: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Predict the error of smaller plans, of the plan, and of the plan with more poses.

    Args:
        goal: What to optimize.
        candidates: All candidates.
        q: Their joint positions, shape (m, dof) [rad or m].
        greedy: Greedy selection in its order, from which smaller plans start, shape (n,).
        selected: Selection after exchange, shape (n,).
        refined: Joint positions after refinement, shape (n, dof) [rad or m].
        rng: Random generator for the refinement of smaller plans.

    Returns:
        Numbers of poses and predicted RMS errors [m].
    """
    information, prior_factor = goal.full_information, goal.full_information.prior_factor
    plan_rows, count = information.rows(refined), len(refined)
    n_known = qr.rank(goal.ranking.information.data_factor)
    n_rows = min(plan_rows.shape[1], MAX_POSE_COMPONENTS)
    smallest = min(count, max(1, -(-(goal.n_observable - n_known) // n_rows)))
    sizes = np.unique(
        np.rint([smallest, 1.4 * smallest, 2 * smallest, np.sqrt(2 * smallest * count)]).astype(int)
    )
    sizes = sizes[sizes < count]
    errors = []
    for size in sizes:
        selection = improve_by_exchange(
            candidates, prior_factor, greedy[:size], goal.criterion, goal.existing, max_passes=1
        )
        if goal.sampler is not None and size <= 2 * smallest:
            # With few redundant measurements, refinement lowers the error considerably.
            better = refine(goal, q[selection], goal.sampler, candidates.min_distance, rng)
            errors.append(goal.expected.after(better))
        else:
            errors.append(goal.expected.after(q[selection]))
    sqrt_covariance = compute_sqrt_covariance(
        prior_factor, np.ascontiguousarray(plan_rows.transpose(2, 1, 0))
    )
    coordinates = scale_joint_units(information.chain, refined)
    gains = goal.criterion.gains(candidates.rows, sqrt_covariance)
    gains += candidates.filling_gains(np.arange(len(gains)), np.concatenate([goal.existing, coordinates]))
    gains[candidates.infeasible] = -np.inf
    gains[selected] = -np.inf
    promising = np.argsort(-gains)[: min(MAX_EXCHANGE_CANDIDATES, int(np.isfinite(gains).sum()))]
    # The plan's poses come first and are feasible.
    extended = CandidateSet.from_rows(
        np.concatenate([plan_rows, candidates.rows[:, :, promising]], 2),
        np.concatenate([coordinates, candidates.coordinates[promising]]),
        candidates.min_distance,
        lambda i: i < count or candidates.is_feasible(int(promising[i - count])),
        candidates.bin_columns,
    )
    order = select_greedily(
        extended, prior_factor, max(count, EXTRA_POSES), goal.criterion, np.arange(count), goal.existing
    )
    larger_sizes = np.arange(count, len(order) + 1)
    errors += goal.expected.after_first(np.concatenate([refined, q[promising]])[order], larger_sizes)
    all_sizes = np.arange(smallest, len(order) + 1)
    log_errors = np.interp(np.log(all_sizes), np.log([*sizes, *larger_sizes]), np.log(errors))
    return all_sizes, np.exp(log_errors)


def _random_errors(
    goal: DesignGoal, candidates: CandidateSet, q: Array, sizes: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Predict the error of random poses for some numbers of poses."""
    if not sizes.size:
        return sizes, np.empty(0)
    order = rng.permutation(candidates.rows.shape[2])
    n_poses = max(4 * int(sizes[-1]), MIN_RANDOM_POSES)
    feasible = [
        i for i in order[: 4 * n_poses] if not candidates.infeasible[i] and candidates.is_feasible(int(i))
    ][:n_poses]
    poses = np.array(feasible, int)
    rows = candidates.rows_of(poses)[..., goal.full_information.fitted]
    selected_sizes = sizes[np.unique(np.linspace(0, len(sizes) - 1, N_RANDOM_SIZES).round().astype(int))]

    def median_error(size: int) -> float:
        plans = [rng.permutation(len(rows))[:size] for _ in range(N_RANDOM_PLANS)]
        information, combinations = goal.ranking.information, goal.ranking.combinations
        errors = [information.predict_error(rows[plan], combinations) for plan in plans]
        median = plans[int(np.argsort(errors)[N_RANDOM_PLANS // 2])]
        return goal.expected.after(q[poses[median]])

    return selected_sizes, np.array([median_error(size) for size in selected_sizes])


def _recommended_size(sizes: Array, errors: Array, sigma: float) -> int | None:
    """Find the number of poses with diminishing returns for an instrument of this standard deviation."""
    shown = np.sqrt(errors**2 + 3 * sigma**2)
    is_diminishing = np.flatnonzero(shown[EXTRA_POSES:] > (1 - MIN_EXTRA_GAIN) * shown[:-EXTRA_POSES])
    return int(sizes[is_diminishing[0]]) if is_diminishing.size else None
