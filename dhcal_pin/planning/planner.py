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

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .._frozen import frozen
from .._typing import Array, Progress
from ..calibration.cameras import judged_boards, split_sets
from ..estimation.parameters import LOW_COST
from ..estimation.priors import Priors
from ..estimation.qr import null_space
from ..estimation.uncertainty import Uncertainty
from ..exceptions import InvalidArgumentError
from ..measurements.base import Measurement, Noise
from ..measurements.camera import CameraCorners
from ..plausibility.signs import simulate_decision
from ..plots import plot_plan_curve
from ..robot.chain import Chain
from ..robot.collision import CollisionChecker
from ..robot.error_families import CURVES, FINE_CURVES
from ..robot.sampling import ConfigurationSampler, WorkspaceConstraints, limits_with_margin, scale_joint_units
from .curve_prediction import CurvePrediction, predict_curves
from .error_curve import error_curve, plans_for_curves, random_errors, recommended_size
from .exchange import CandidateSet, compute_sqrt_covariance, improve_by_exchange, select_greedily
from .information import Information, PlannedCalibration, add_joint_scatter
from .named_criteria import CriterionOption, parse_criterion
from .refinement import DesignGoal, Selection, refine
from .task_error import TaskError
from .tour import find_tour
from .view_sampler import ViewSampler
from .views import CameraViews, PlannedImages, summarize_views

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Margins to the joint limits [rad] and [m].
MARGIN_ANGLE, MARGIN_LENGTH = np.deg2rad(2.0), 5e-3
# Configurations over which predicted errors are averaged if no task is given.
N_TASK_SAMPLES = 300
# Largest number of candidates; more need too much memory and do not improve the plan.
MAX_CANDIDATES = 50_000
# Smallest distance of two poses, in the units of `scale_joint_units`: the effects that no model describes are
# similar at closer poses. If random poses are closer, their median distance is used.
MIN_DISTANCE_RAD = np.deg2rad(20.0)
# Position errors below this value that no measurement shows are not mentioned [m].
MIN_HIDDEN_ERROR = 1e-6
# Phases of `plan`, in their order.
PHASES = (
    "drawing candidates",
    "selecting poses",
    "exchanging poses",
    "moving poses",
    "predicting errors",
    "path",
)


@frozen(eq=False)
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
            `error_curve.CURVE_SIZES` poses, by size; empty unless the criterion fills bins.
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
    option, fills_bins = parse_criterion(criterion)
    _require_enough(count, candidates)
    phases = _report_phases(progress)
    next(phases)
    rng = np.random.default_rng(seed)
    margin, space = margin or Noise(MARGIN_LENGTH, MARGIN_ANGLE), space or WorkspaceConstraints()
    pool = _collect_pool(chain, images, candidates, task, space, margin, rng)
    if option.omitted_sets and noise is not None:
        noise = add_joint_scatter(chain, pool.q, noise)
    planned = PlannedCalibration(
        chain,
        CameraCorners.kind if images else kind,
        noise,
        parameters,
        priors,
        fix,
        free,
        data,
        known or {},
        prior_uncertainty,
        images,
    )
    bin_columns = _bin_columns(chain, criterion) if fills_bins else np.zeros(0, int)
    searched = _without_curves(planned) if fills_bins else planned
    goal, candidate_set, notes = _prepare(searched, pool, option, bin_columns, count, rng)
    next(phases)
    candidate_set, greedy = _select(goal, candidate_set, count, images)
    next(phases)
    prior_factor = goal.full_information.prior_factor
    selected = improve_by_exchange(candidate_set, prior_factor, greedy, goal.criterion, goal.existing)
    next(phases)
    refined = pool.q[selected]
    if pool.sampler is not None:
        refined = refine(goal, refined, pool.sampler, candidate_set.min_distance, rng)
    found = Selection(candidate_set, pool.q, greedy, selected, refined)
    next(phases)
    curves = _predict_curves(planned, goal, found) if fills_bins else ()
    predicted = _predict(searched, goal, pool, found, notes, rng)
    next(phases)
    limits = limits_with_margin(chain, margin.rotation, margin.position)
    ordered = _in_order_of_tour(replace(predicted, criterion=criterion, curves=curves), pool, limits, rng)
    if LOW_COST in split_sets(parameters or chain.parameters)[0]:
        ordered = replace(ordered, notes=(*ordered.notes, _signs_note(chain, ordered.q, rng)))
    return ordered


def _signs_note(chain: Chain, q: Array, rng: np.random.Generator) -> str:
    """Say whether poses at joint positions (m, n) decide which joints of the arm turn the other way."""
    found = simulate_decision(chain, q, rng)
    if not found.is_compared:
        return "so few poses do not decide which joints turn the other way; plan at least 8"
    undecided = {name for each in found.open for name in each.joints} | set(found.turned)
    if undecided:
        names = ", ".join(name for name in chain.joint_names if name in undecided)
        return f"in a simulation, the poses leave the signs of {names} open; plan more poses"
    return "in a simulation with play of 0.5°, the poses decide which joints turn the other way"


def _require_enough(count: int, candidates: int | Array) -> None:
    """Require at least one pose, and a possible number of candidates to draw."""
    if not isinstance(count, int | np.integer) or count < 1:
        raise InvalidArgumentError(f"{count!r} poses: expected a whole number from 1 on")
    if isinstance(candidates, int) and not count <= candidates <= MAX_CANDIDATES:
        raise InvalidArgumentError(
            f"{candidates} candidates for {count} poses: expected from {count} to {MAX_CANDIDATES}"
        )


def _report_phases(progress: Progress | None) -> Iterator[None]:
    """Report the next phase each time that the iterator is advanced."""
    for number, phase in enumerate(PHASES, 1):
        if progress:
            progress(phase, number, len(PHASES))
        yield


@frozen(eq=False)
class _Pool:
    """Configurations from which the poses are selected."""

    chain: Chain  # Nominal robot
    q: Array  # Joint positions, shape (m, n) [rad or m]
    task_q: Array  # Joint positions of the task, shape (t, n) [rad or m]
    # Cameras and boards; a board must be in view. None for other measurements of the tool.
    images: PlannedImages | None
    sampler: ConfigurationSampler | None  # Sampler that has drawn them; None if they are given
    collision: CollisionChecker  # Collision checks of the robot
    notes: tuple[str, ...]  # What is not checked and why


def _collect_pool(
    chain: Chain,
    images: PlannedImages | None,
    candidates: int | Array,
    task: Array | None,
    space: WorkspaceConstraints,
    margin: Noise,
    rng: np.random.Generator,
) -> _Pool:
    """Draw configurations that can be measured, or take the given ones."""
    if not isinstance(candidates, int):
        q = chain.validated_q(candidates)
        task_q = q if task is None else chain.validated_q(task)
        checker = CollisionChecker.from_chain(chain, space.environment)
        return _Pool(chain, q, task_q, images, None, checker, (checker.note,) if checker.note else ())
    everywhere = ConfigurationSampler.from_chain(chain, space, margin.rotation, margin.position)
    sampler = ViewSampler.from_sampler(everywhere, images) if images else everywhere
    q = sampler.draw(candidates, rng)
    if task is None:
        above_floor = replace(everywhere, workspace=WorkspaceConstraints(floor=space.floor))
        task_q = above_floor.draw(N_TASK_SAMPLES, rng)
    else:
        task_q = chain.validated_q(task)
    return _Pool(chain, q, task_q, images, sampler, sampler.collision, sampler.notes)


def _bin_columns(chain: Chain, criterion: str) -> Array:
    """Return the joints whose bins are filled, shape (j,)."""
    columns = np.flatnonzero(~chain.is_prismatic)
    if not columns.size:
        raise InvalidArgumentError(
            f"criterion {criterion!r}: only revolute joints have correction curves, and the robot has no "
            "revolute joint"
        )
    return columns


def _without_curves(planned: PlannedCalibration) -> PlannedCalibration:
    """Return a calibration without the parameters of the curves, unless there are no others."""
    # The bins determine the curves. As unknowns of the criterion, their hundreds of coefficients would make
    # the selection slow without making it better.
    sets = planned.parameters or planned.chain.parameters
    others = [name for name in sets.split(",") if name.strip() not in (CURVES, FINE_CURVES)]
    return replace(planned, parameters=",".join(others) or sets)


def _prepare(
    planned: PlannedCalibration,
    pool: _Pool,
    option: CriterionOption,
    bin_columns: Array,
    count: int,
    rng: np.random.Generator,
) -> tuple[DesignGoal, CandidateSet, list[str]]:
    """Collect the knowledge before measuring; return the goal, the candidates, and notes."""
    # Unknown corners of boards add many rows and columns, and the same error to all plans of one size. Poses
    # are therefore chosen as if the corners were exact; the errors that are reported contain them.
    exact = planned.with_free_points(())
    full_information = Information.from_prior(exact, pool.q, option.omitted_sets)
    information = full_information.without_omitted()
    candidate_set = _candidate_set(pool, full_information, bin_columns, count, rng)
    every_nth = np.arange(0, len(pool.q), max(1, len(pool.q) // N_TASK_SAMPLES))
    observable = information.observable_directions(
        candidate_set.rows_of(every_nth)[..., full_information.fitted]
    )
    # Parts of the task error that no measurement of this kind determines do not depend on the selection.
    ranking = TaskError.over(information, pool.task_q).observable_part(observable)
    expected, has_free_frames, hidden = _expected_error(information, observable, pool.task_q)
    if hidden > MIN_HIDDEN_ERROR and (complete := _with_redundant_parameters(exact)) is not exact:
        # Where nothing is measured, the errors that the minimal set leaves out as redundant count, too.
        known = Information.from_prior(complete, pool.q)
        observable_of_all = known.observable_directions(known.rows(pool.q[every_nth]).transpose(2, 1, 0))
        expected, has_free_frames, hidden = _expected_error(known, observable_of_all, pool.task_q)
    if exact is not planned:
        expected = TaskError.over(Information.from_prior(planned, pool.q), pool.task_q)
    goal = DesignGoal(
        expected=expected,
        ranking=ranking,
        full_information=full_information,
        criterion=option.create(observable, ranking.combinations, full_information, pool.task_q),
        n_observable=len(observable),
        existing=_existing_coordinates(planned),
        sampler=pool.sampler,
        bin_columns=bin_columns,
    )
    notes = [f"assumed: {assumption}"] if (assumption := information.instrument.assumption) else []
    if has_free_frames:
        notes.append(
            "the predicted error does not contain poses of base and tool that "
            f"{planned.kind} measurements do not determine"
        )
    if hidden > MIN_HIDDEN_ERROR:
        notes.append(
            f"{planned.kind} measurements do not determine positions: {1e3 * hidden:.3g} mm of the predicted "
            "error are those of the priors, whatever the poses"
        )
    return goal, candidate_set, notes


def _expected_error(
    information: Information, observable: Array, task_q: Array
) -> tuple[TaskError, bool, float]:
    """Return the expected error [m], whether base or tool are free, and the part that priors limit."""
    undetermined = null_space(observable)
    combinations, has_free_frames = information.relative_combinations(task_q, undetermined)
    hidden = float(np.linalg.norm(undetermined.T @ combinations))
    return TaskError(information, combinations), has_free_frames, hidden


def _with_redundant_parameters(planned: PlannedCalibration) -> PlannedCalibration:
    """Return a calibration with all errors of the joint origins if it has the minimal ones."""
    sets = [name.strip() for name in (planned.parameters or planned.chain.parameters).split(",")]
    if planned.images is not None or "minimal" not in sets:
        return planned
    return replace(planned, parameters=",".join("placement" if name == "minimal" else name for name in sets))


def _candidate_set(
    pool: _Pool, information: Information, bin_columns: Array, count: int, rng: np.random.Generator
) -> CandidateSet:
    """Create the candidates of the search from the configurations of a pool."""
    q, sampler, coordinates = pool.q, pool.sampler, scale_joint_units(pool.chain, pool.q)
    rows, min_distance = information.rows(q), _min_distance(coordinates, count, rng)
    if sampler is not None:
        return CandidateSet(rows, coordinates, min_distance, lambda i: sampler.is_feasible(q[i]), bin_columns)
    candidate_set = CandidateSet(rows, coordinates, min_distance, bin_columns=bin_columns)
    if pool.images is not None:
        candidate_set.infeasible[:] = ~pool.images.in_view(pool.chain.poses(q))
    return candidate_set


def _existing_coordinates(planned: PlannedCalibration) -> Array:
    """Return the coordinates of existing measurements, to which poses keep their distance, shape (e, n)."""
    measured = [item.q for item in planned.data if item.configurations_per_row == 1]
    empty = np.zeros((0, planned.chain.n_joints))
    return np.concatenate([empty, *(scale_joint_units(planned.chain, q) for q in measured)])


def _min_distance(coordinates: Array, count: int, rng: np.random.Generator) -> float:
    """Choose the smallest distance of `count` poses among coordinates (m, n)."""
    sample = coordinates[rng.permutation(len(coordinates))[:count]]
    if len(sample) < 2:
        return 0.0
    distances = np.linalg.norm(sample[:, None] - sample[None], axis=2)
    distances += np.diag(np.full(len(sample), np.inf))
    return min(MIN_DISTANCE_RAD, float(np.median(distances.min(1))))


def _select(
    goal: DesignGoal, candidates: CandidateSet, count: int, images: PlannedImages | None
) -> tuple[CandidateSet, Array]:
    """Select candidates greedily, near ones only if there are no others; return candidates and selection."""
    prior_factor, criterion, existing = goal.full_information.prior_factor, goal.criterion, goal.existing
    greedy = select_greedily(candidates, prior_factor, count, criterion, np.zeros(0, int), existing)
    if len(greedy) < count:
        # Not enough candidates have the minimum distance, so select the others without it.
        candidates = replace(candidates, min_distance=0.0)
        greedy = select_greedily(candidates, prior_factor, count - len(greedy), criterion, greedy, existing)
    if len(greedy) < count:
        condition = "; a board must be in view, and nothing may hide it" if images else ""
        raise InvalidArgumentError(
            f"only {len(greedy)} of {candidates.rows.shape[2]} candidates are feasible; expected at least "
            f"{count}: relax the constraints or use more candidates{condition}"
        )
    return candidates, greedy


def _predict_curves(
    planned: PlannedCalibration, goal: DesignGoal, found: Selection
) -> tuple[CurvePrediction, ...]:
    """Predict the knowledge of the joint correction curves after plans of several sizes."""
    information = Information.from_prior(planned, found.q, (CURVES,))
    # The search for larger plans finds more candidates that are infeasible.
    plans = plans_for_curves(goal, found)
    measured = np.concatenate([found.q[:0], *(item.configurations() for item in planned.data)])
    return predict_curves(information, plans, measured, found.q[~found.candidates.infeasible])


def _predict(
    planned: PlannedCalibration,
    goal: DesignGoal,
    pool: _Pool,
    found: Selection,
    notes: Sequence[str],
    rng: np.random.Generator,
) -> Plan:
    """Predict errors over the number of poses; return the plan in the order of its selection."""
    sizes, errors = error_curve(goal, found, rng)
    random_sizes, errors_of_random = random_errors(goal, found, sizes[sizes <= len(found.refined)], rng)
    expected = goal.expected.information
    error_with_points = _error_with_points(planned, pool, found.refined)
    notes = [*pool.notes, *notes]
    if error_with_points is not None:
        notes.append(
            "the predicted error takes corners of boards as exact; if the calibration has to estimate them "
            f'(points = "auto" in the rig), it is {1e3 * error_with_points:.4g} mm'
        )
    return Plan(
        q=found.refined,
        index=found.selected if pool.sampler is None else None,
        criterion="",
        information=expected,
        task=goal.expected.combinations,
        sizes=sizes,
        errors=errors,
        random_sizes=random_sizes,
        random_errors=errors_of_random,
        recommended_size=recommended_size(sizes, errors, expected.instrument.position_sigma),
        notes=tuple(notes),
        error_with_points=error_with_points,
    )


def _error_with_points(planned: PlannedCalibration, pool: _Pool, refined: Array) -> float | None:
    """Predict the error of a plan if the calibration finds that corners of boards must be estimated."""
    if planned.images is None:
        return None
    judged = judged_boards(planned.images.rig.boards)
    if not judged:
        return None
    free = planned.with_free_points([*planned.images.free_boards, *judged])
    information = Information.from_prior(free, pool.q)
    if not information.errors.parameters:
        return None
    return TaskError.over(information, pool.task_q).after(refined)


def _in_order_of_tour(plan: Plan, pool: _Pool, limits: tuple[Array, Array], rng: np.random.Generator) -> Plan:
    """Order the poses of a plan as a short tour, and find its ways."""
    # Given candidates stay as they are.
    can_turn = ~pool.chain.is_prismatic & (pool.sampler is not None)
    tour = find_tour(plan.q, pool.collision, *limits, can_turn, rng)
    return replace(
        plan,
        q=tour.q,
        index=None if plan.index is None else plan.index[tour.order],
        ways=tour.ways,
        is_way_free=() if pool.collision.geometry is None else tour.is_way_free,
        views=summarize_views(pool.images, pool.chain.poses(tour.q)) if pool.images else (),
    )
