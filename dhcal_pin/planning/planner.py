"""Which poses to measure: the choice that tells most about a robot's errors with the instrument at hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .._typing import Array
from ..estimation import qr
from ..estimation.priors import Priors
from ..estimation.uncertainty import Uncertainty
from ..exceptions import DhcalError
from ..measurements.base import Measurement, Noise
from ..robot.chain import Chain
from ..robot.sampling import ConfigurationSampler, WorkspaceConstraints, scale_joint_units, shortest_tour
from ..robot.transmission import TERM_FAMILIES
from .criteria import AOptimality, BiasVarianceCriterion, Criterion, DOptimality, EOptimality
from .exchange import MAX_EXCHANGE_CANDIDATES, CandidateSet, exchange, greedy, sqrt_covariance
from .information import Information, with_joint_scatter
from .refinement import DesignGoal, refine

# Joints stay this far from their limits.
MARGIN_ANGLE, MARGIN_LENGTH = np.deg2rad(2.0), 5e-3


# Predicted errors are averaged over so many configurations where no task is given.
N_TASK_SAMPLES = 300


# Random choices that a plan is compared with, at so many numbers of poses, out of so many poses at least.
N_RANDOM_PLANS, N_RANDOM_SIZES, MIN_RANDOM_POSES = 200, 6, 600


# Candidates drawn at the most: with more of them memory ends before the plan gains.
MAX_CANDIDATES = 10**6


# Poses nearer than this are as one to a real robot, whose errors no model holds in full: they repeat there.
# Where poses at random would stand nearer than that, their distance.
MIN_DISTANCE_RAD = np.deg2rad(20.0)


# A share of the task that is unseen and no rounding.
UNOBSERVABLE_RTOL = 1e-6


# More poses stop paying where ten more lower what a check would show by less than a hundredth.
EXTRA_POSES, MIN_EXTRA_GAIN = 10, 0.01


@dataclass(frozen=True, eq=False)
class Plan:
    """Configurations to measure, and what to expect of them.

    Attributes:
        q: (n, dof) joint values in the order of a short tour, rad or m.
        index: (n,) their numbers among given candidates; None where candidates were drawn and refined.
        criterion: what they were chosen for.
        information: what is known before, and what any configurations would tell.
        task: combinations whose variances are the mean squared position error over the task.
        sizes: (c,) numbers of poses, beyond n as if more were added to the plan.
        errors: (c,) predicted RMS position error over the task after a plan of so many, m.
        random_sizes, random_errors: the same for poses at random, the median of several draws.
        recommended_size: number of poses from which on ten more lower what a check with this instrument would show by
            less than a hundredth; None if that is beyond the sizes.
        notes: what was not looked at.
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

    @cached_property
    def log_det(self) -> float:
        """Log det of the information, the unknowns in units of their priors."""
        rows = self.information.rows(self.q).transpose(2, 1, 0)
        return -2 * float(
            np.sum(np.log(np.abs(np.diag(sqrt_covariance(self.information.prior_factor, rows)))))
        )

    @property
    def error(self) -> float:
        """Predicted RMS position error over the task after these poses, m."""
        return self.expected_error(self.q)

    @property
    def random_error(self) -> float:
        """Predicted error of as many poses at random, the median of several draws, m."""
        return float(self.random_errors[-1])

    @property
    def relative_error(self) -> float:
        """Predicted error over that of as many poses at random."""
        return self.error / self.random_error

    def expected_error(self, q: Array) -> float:
        """Predicted RMS position error in m over the plan's task, after measuring at any q (m, dof)."""
        return self.information.error(self.information.rows(q).transpose(2, 1, 0), self.task)


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
    task: Array | None = None,
    candidates: int | Array = 5000,
    space: WorkspaceConstraints | None = None,
    margin: Noise | None = None,
    seed: int = 0,
) -> Plan:
    """Chooses configurations to measure.

    Drawn candidates keep the joints' limits, the space asked for, and do not collide; the chosen ones are
    then moved on between them. Given candidates are chosen from as they are.

    Args:
        chain: the nominal robot; base and tool as far as they are known.
        count: how many.
        kind: of measurement; readings of one configuration each that hang together by nothing.
        noise: sigmas of instrument and robot together, m and rad; without it, those that the data show.
        parameters: what is unknown, as in `calibrate`.
        priors: as in `calibrate`.
        fix: as in `calibrate`.
        free: as in `calibrate`.
        criterion: "D" volume of the unknowns' uncertainty, "A" mean variance, "E" worst variance, each in
            units of the priors; "task" predicted position error over the task; "robust" this and, as much,
            the error over the task by what the model leaves out of gains, harmonics and compliance, of an arm
            whose joints scatter by an arcminute beside the noise given.
        data: readings already taken, to be added to.
        known: values of instruments' unknowns, as in `calibrate`.
        prior_uncertainty: what the calibration that made the chain left uncertain; it takes the priors' place.
        task: (m, n) joint values where the tool is to be right; anywhere without it, or where
            the given candidates are.
        candidates: how many to draw, or joint values (m, n) to choose from.
        space: where the tool may be.
        margin: distance to the joints' limits: `rotation` in rad, `position` in m.
        seed: of all draws.

    Raises:
        DhcalError: an unknown name, no room for the tool, or too few candidates.
    """
    if criterion not in CRITERIA:
        raise DhcalError(f"criterion {criterion!r}: choose from {', '.join(CRITERIA)}")
    if count < 1:
        raise DhcalError(f"{count} poses: plan at least one")
    if isinstance(candidates, int) and not count <= candidates <= MAX_CANDIDATES:
        raise DhcalError(f"{candidates} candidates for {count} poses: draw from {count} to {MAX_CANDIDATES}")
    rng = np.random.default_rng(seed)
    margin = margin or Noise(MARGIN_LENGTH, MARGIN_ANGLE)
    room, notes = None, []
    if isinstance(candidates, int):
        room = ConfigurationSampler.from_chain(
            chain, space or WorkspaceConstraints(), margin.rotation, margin.position
        )
        q = room.draw(candidates, rng)
        notes += [room.collision.note] if room.collision.note else []
        where = (
            replace(room, workspace=WorkspaceConstraints()).draw(N_TASK_SAMPLES, rng)
            if task is None
            else chain.validated_q(task)
        )
    else:
        q = chain.validated_q(candidates)
        where = q if task is None else chain.validated_q(task)
    left_out = ()
    if criterion == "robust":
        left_out, noise = TERM_FAMILIES, noise and with_joint_scatter(chain, q, noise)
    wide = Information.from_prior(
        chain, q, kind, noise, parameters, priors, fix, free, data, known, left_out, prior_uncertainty
    )
    information = wide.without_omitted()
    stands = scale_joint_units(chain, q)
    kept = np.concatenate(
        [stands[:0], *(scale_joint_units(chain, item.q) for item in data if item.configurations_per_row == 1)]
    )
    possible = _always if room is None else lambda i: room.is_feasible(q[i])
    pool = CandidateSet.from_rows(wide.rows(q), stands, _min_distance(stands, count, rng), possible)
    seen = information.observable_directions(
        pool.at(np.arange(0, len(q), max(1, len(q) // N_TASK_SAMPLES)))[..., wide.fitted]
    )
    every = information.task(where)
    # What the instrument cannot see, as where the base is beside wires of unknown anchors, no choice mends.
    combinations = seen.T @ (seen @ every)
    if np.linalg.norm(every - combinations) > UNOBSERVABLE_RTOL * np.linalg.norm(combinations):
        notes.append(f"where the base stands is not counted, as {kind} readings cannot tell")
    goal = CRITERIA[criterion](seen, combinations, wide, where)
    aim = DesignGoal(information, wide, goal, combinations, len(seen), kept, room)
    first = greedy(pool, wide.prior_factor, count, aim.criterion, np.zeros(0, int), kept)
    if len(first) < count:
        # They do not stand so far apart.
        pool = replace(pool, min_distance=0.0)
        first = greedy(pool, wide.prior_factor, count - len(first), aim.criterion, first, kept)
    if len(first) < count:
        raise DhcalError(f"only {len(first)} of {len(q)} candidates are possible, {count} are asked for")
    chosen = exchange(pool, wide.prior_factor, first, aim.criterion, kept)
    best = q[chosen] if room is None else refine(aim, q[chosen], room, pool.min_distance, rng)
    sizes, errors = _error_curve(aim, pool, q, first, chosen, best, rng)
    random_sizes, random_errors = _random_errors(aim, pool, sizes[sizes <= count], rng)
    order = shortest_tour(scale_joint_units(chain, best))
    return Plan(
        q=best[order],
        index=None if room else chosen[order],
        criterion=criterion,
        information=information,
        task=combinations,
        sizes=sizes,
        errors=errors,
        random_sizes=random_sizes,
        random_errors=random_errors,
        recommended_size=_recommended_size(sizes, errors, information.noise.position),
        notes=tuple(notes),
    )


def _robust(seen: Array, task: Array, wide: Information, where: Array) -> Criterion:
    """The compromise over a task at joint values (m, n), if anything is left out at all."""
    kept = wide.fitted
    if kept.all():
        return AOptimality(task)
    every = wide.task(where)
    # Of the displacements over the task, those that a fit can make: what it should put there, and its share.
    ways, size, _ = np.linalg.svd((seen.T @ (seen @ every[kept])).T, full_matrices=False)
    ways = ways[:, size > UNOBSERVABLE_RTOL * size[0]]
    return BiasVarianceCriterion(kept, seen.T @ (seen @ every[kept]) @ ways, ways.T @ every[~kept].T)


CRITERIA: dict[str, Callable[[Array, Array, Information, Array], Criterion]] = {
    "D": lambda seen, task, wide, where: DOptimality(),
    "A": lambda seen, task, wide, where: AOptimality(seen.T),
    "E": lambda seen, task, wide, where: EOptimality(seen),
    "task": lambda seen, task, wide, where: AOptimality(task),
    "robust": _robust,
}


def _always(_: int) -> bool:
    return True


def _min_distance(places: Array, count: int, rng: np.random.Generator) -> float:
    """How far apart `count` of the places (m, n) are to stand."""
    some = places[rng.permutation(len(places))[:count]]
    if len(some) < 2:
        return 0.0
    between = np.linalg.norm(some[:, None] - some[None], axis=2) + np.diag(np.full(len(some), np.inf))
    return min(MIN_DISTANCE_RAD, float(np.median(between.min(1))))


def _error_curve(
    aim: DesignGoal,
    pool: CandidateSet,
    q: Array,
    first: Array,
    chosen: Array,
    best: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Numbers of poses and predicted errors in m: of smaller plans, of the plan, then with candidates added.

    Args:
        aim: what for.
        pool: all candidates.
        q: (m, dof) their joint values.
        first: (n,) the greedy choice in its order, from which smaller plans start.
        chosen: (n,) the exchanged choice.
        best: (n, dof) the refined one.
        rng: for refinement.
    """
    wide, start = aim.full_information, aim.full_information.prior_factor
    own, count = wide.rows(best), len(best)
    known = qr.rank(aim.information.data_factor)
    least = min(count, max(1, -(-(aim.n_observable - known) // own.shape[1])))
    sizes = np.unique(np.rint([least, 1.4 * least, 2 * least, np.sqrt(2 * least * count)]).astype(int))
    sizes = sizes[sizes < count]
    smaller = []
    for size in sizes:
        some = exchange(pool, start, first[:size], aim.criterion, aim.existing, passes=1)
        if aim.sampler is not None and size <= 2 * least:
            # Near the fewest that tell all, refinement counts for much.
            better = refine(aim, q[some], aim.sampler, pool.min_distance, rng)
            smaller.append(wide.rows(better).transpose(2, 1, 0))
        else:
            smaller.append(pool.at(some))
    gains = aim.criterion.gains(
        pool.rows, sqrt_covariance(start, np.ascontiguousarray(own.transpose(2, 1, 0)))
    )
    gains[pool.infeasible] = -np.inf
    gains[chosen] = -np.inf
    left = np.argsort(-gains)[: min(MAX_EXCHANGE_CANDIDATES, int(np.isfinite(gains).sum()))]
    both = CandidateSet.from_rows(
        np.concatenate([own, pool.rows[:, :, left]], 2),
        np.concatenate([scale_joint_units(wide.chain, best), pool.coordinates[left]]),
        pool.min_distance,
        lambda i: i < count or pool.is_feasible(int(left[i - count])),
    )
    order = greedy(both, start, max(count, EXTRA_POSES), aim.criterion, np.arange(count), aim.existing)
    larger = np.arange(count, len(order) + 1)
    rows = [*smaller, *(both.at(order[:size]) for size in larger)]
    errors = [aim.information.error(one[..., wide.fitted], aim.task) for one in rows]
    every = np.arange(least, len(order) + 1)
    between = np.interp(np.log(every), np.log([*sizes, *larger]), np.log(errors))
    return every, np.exp(between)


def _random_errors(
    aim: DesignGoal, pool: CandidateSet, sizes: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Some of the sizes, and the predicted error in m after as many poses at random, the median of draws."""
    if not sizes.size:
        return sizes, np.empty(0)
    order = rng.permutation(pool.rows.shape[2])
    wanted = max(4 * int(sizes[-1]), MIN_RANDOM_POSES)
    open_ones = [i for i in order[: 4 * wanted] if not pool.infeasible[i] and pool.is_feasible(int(i))][
        :wanted
    ]
    rows = pool.at(np.array(open_ones, int))[..., aim.full_information.fitted]
    some = np.unique(np.linspace(0, len(sizes) - 1, N_RANDOM_SIZES).round().astype(int))
    out = [
        np.median([
            aim.information.error(rows[rng.permutation(len(rows))[:size]], aim.task) for _ in range(N_RANDOM_PLANS)
        ])
        for size in sizes[some]
    ]  # fmt: skip
    return sizes[some], np.array(out)


def _recommended_size(sizes: Array, errors: Array, sigma: float) -> int | None:
    """The number of poses from which on MORE lower what a check shows, its own noise included, by < WORTH."""
    shown = np.sqrt(errors**2 + 3 * sigma**2)
    little = np.flatnonzero(shown[EXTRA_POSES:] > (1 - MIN_EXTRA_GAIN) * shown[:-EXTRA_POSES])
    return int(sizes[little[0]]) if little.size else None
