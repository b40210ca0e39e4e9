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
from ..robot.sampling import Room, Space, evened, tour
from ..robot.transmission import FAMILIES
from .criteria import Compromise, Criterion, Determinant, Spread, Worst
from .exchange import PROMISING, Pool, basis, exchange, greedy
from .information import Information, unsteady
from .refinement import Aim, refined

# Joints stay this far from their limits.
MARGIN_ANGLE, MARGIN_LENGTH = np.deg2rad(2.0), 5e-3


# Predicted errors are averaged over so many configurations where no task is given.
TASK = 300


# Random choices that a plan is compared with, at so many numbers of poses, out of so many poses at least.
DRAWS, SIZES, DRAWN = 200, 6, 600


# Candidates drawn at the most: with more of them memory ends before the plan gains.
MOST_CANDIDATES = 10**6


# Poses nearer than this are as one to a real robot, whose errors no model holds in full: they repeat there.
# Where poses at random would stand nearer than that, their distance.
APART = np.deg2rad(20.0)


# A share of the task that is unseen and no rounding.
UNSEEN = 1e-6


# More poses stop paying where ten more lower what a check would show by less than a hundredth.
MORE, WORTH = 10, 0.01


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
        enough: number of poses from which on ten more lower what a check with this instrument would show by
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
    enough: int | None
    notes: tuple[str, ...]

    @cached_property
    def log_det(self) -> float:
        """Log det of the information, the unknowns in units of their priors."""
        rows = self.information.rows(self.q).transpose(2, 1, 0)
        return -2 * float(np.sum(np.log(np.abs(np.diag(basis(self.information.start, rows))))))

    @property
    def error(self) -> float:
        """Predicted RMS position error over the task after these poses, m."""
        return self.expected(self.q)

    @property
    def random(self) -> float:
        """Predicted error of as many poses at random, the median of several draws, m."""
        return float(self.random_errors[-1])

    @property
    def ratio(self) -> float:
        """Predicted error over that of as many poses at random."""
        return self.error / self.random

    def expected(self, q: Array) -> float:
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
    learnt: Uncertainty | None = None,
    task: Array | None = None,
    candidates: int | Array = 5000,
    space: Space | None = None,
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
        learnt: what the calibration that made the chain left uncertain; it takes the priors' place.
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
    if isinstance(candidates, int) and not count <= candidates <= MOST_CANDIDATES:
        raise DhcalError(f"{candidates} candidates for {count} poses: draw from {count} to {MOST_CANDIDATES}")
    rng = np.random.default_rng(seed)
    margin = margin or Noise(MARGIN_LENGTH, MARGIN_ANGLE)
    room, notes = None, []
    if isinstance(candidates, int):
        room = Room.of(chain, space or Space(), margin.rotation, margin.position)
        q = room.draw(candidates, rng)
        notes += [room.clearance.note] if room.clearance.note else []
        where = replace(room, space=Space()).draw(TASK, rng) if task is None else chain.checked(task)
    else:
        q = chain.checked(candidates)
        where = q if task is None else chain.checked(task)
    left_out = ()
    if criterion == "robust":
        left_out, noise = FAMILIES, noise and unsteady(chain, q, noise)
    wide = Information.before(
        chain, q, kind, noise, parameters, priors, fix, free, data, known, left_out, learnt
    )
    information = wide.narrowed()
    stands = evened(chain, q)
    kept = np.concatenate([stands[:0], *(evened(chain, item.q) for item in data if item.ends == 1)])
    possible = _anything if room is None else lambda i: room.allows(q[i])
    pool = Pool.of(wide.rows(q), stands, _apart(stands, count, rng), possible)
    seen = information.seen(pool.at(np.arange(0, len(q), max(1, len(q) // TASK)))[..., wide.fitted])
    every = information.task(where)
    # What the instrument cannot see, as where the base is beside wires of unknown anchors, no choice mends.
    combinations = seen.T @ (seen @ every)
    if np.linalg.norm(every - combinations) > UNSEEN * np.linalg.norm(combinations):
        notes.append(f"where the base stands is not counted, as {kind} readings cannot tell")
    goal = CRITERIA[criterion](seen, combinations, wide, where)
    aim = Aim(information, wide, goal, combinations, len(seen), kept, room)
    first = greedy(pool, wide.start, count, aim.criterion, np.zeros(0, int), kept)
    if len(first) < count:
        # They do not stand so far apart.
        pool = replace(pool, apart=0.0)
        first = greedy(pool, wide.start, count - len(first), aim.criterion, first, kept)
    if len(first) < count:
        raise DhcalError(f"only {len(first)} of {len(q)} candidates are possible, {count} are asked for")
    chosen = exchange(pool, wide.start, first, aim.criterion, kept)
    best = q[chosen] if room is None else refined(aim, q[chosen], room, pool.apart, rng)
    sizes, errors = _curve(aim, pool, q, first, chosen, best, rng)
    random_sizes, random_errors = _random(aim, pool, sizes[sizes <= count], rng)
    order = tour(evened(chain, best))
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
        enough=_enough(sizes, errors, information.noise.position),
        notes=tuple(notes),
    )


def _robust(seen: Array, task: Array, wide: Information, where: Array) -> Criterion:
    """The compromise over a task at joint values (m, n), if anything is left out at all."""
    kept = wide.fitted
    if kept.all():
        return Spread(task)
    every = wide.task(where)
    # Of the displacements over the task, those that a fit can make: what it should put there, and its share.
    ways, size, _ = np.linalg.svd((seen.T @ (seen @ every[kept])).T, full_matrices=False)
    ways = ways[:, size > UNSEEN * size[0]]
    return Compromise(kept, seen.T @ (seen @ every[kept]) @ ways, ways.T @ every[~kept].T)


CRITERIA: dict[str, Callable[[Array, Array, Information, Array], Criterion]] = {
    "D": lambda seen, task, wide, where: Determinant(),
    "A": lambda seen, task, wide, where: Spread(seen.T),
    "E": lambda seen, task, wide, where: Worst(seen),
    "task": lambda seen, task, wide, where: Spread(task),
    "robust": _robust,
}


def _anything(_: int) -> bool:
    return True


def _apart(places: Array, count: int, rng: np.random.Generator) -> float:
    """How far apart `count` of the places (m, n) are to stand."""
    some = places[rng.permutation(len(places))[:count]]
    if len(some) < 2:
        return 0.0
    between = np.linalg.norm(some[:, None] - some[None], axis=2) + np.diag(np.full(len(some), np.inf))
    return min(APART, float(np.median(between.min(1))))


def _curve(
    aim: Aim, pool: Pool, q: Array, first: Array, chosen: Array, best: Array, rng: np.random.Generator
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
    wide, start = aim.wide, aim.wide.start
    own, count = wide.rows(best), len(best)
    known = qr.rank(aim.information.taken)
    least = min(count, max(1, -(-(aim.seen - known) // own.shape[1])))
    sizes = np.unique(np.rint([least, 1.4 * least, 2 * least, np.sqrt(2 * least * count)]).astype(int))
    sizes = sizes[sizes < count]
    smaller = []
    for size in sizes:
        some = exchange(pool, start, first[:size], aim.criterion, aim.kept, passes=1)
        if aim.room is not None and size <= 2 * least:
            # Near the fewest that tell all, refinement counts for much.
            better = refined(aim, q[some], aim.room, pool.apart, rng)
            smaller.append(wide.rows(better).transpose(2, 1, 0))
        else:
            smaller.append(pool.at(some))
    gains = aim.criterion.gains(pool.rows, basis(start, np.ascontiguousarray(own.transpose(2, 1, 0))))
    gains[pool.closed] = -np.inf
    gains[chosen] = -np.inf
    left = np.argsort(-gains)[: min(PROMISING, int(np.isfinite(gains).sum()))]
    both = Pool.of(
        np.concatenate([own, pool.rows[:, :, left]], 2),
        np.concatenate([evened(wide.chain, best), pool.places[left]]),
        pool.apart,
        lambda i: i < count or pool.possible(int(left[i - count])),
    )
    order = greedy(both, start, max(count, MORE), aim.criterion, np.arange(count), aim.kept)
    larger = np.arange(count, len(order) + 1)
    rows = [*smaller, *(both.at(order[:size]) for size in larger)]
    errors = [aim.information.error(one[..., wide.fitted], aim.task) for one in rows]
    every = np.arange(least, len(order) + 1)
    between = np.interp(np.log(every), np.log([*sizes, *larger]), np.log(errors))
    return every, np.exp(between)


def _random(aim: Aim, pool: Pool, sizes: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Some of the sizes, and the predicted error in m after as many poses at random, the median of draws."""
    if not sizes.size:
        return sizes, np.empty(0)
    order = rng.permutation(pool.rows.shape[2])
    wanted = max(4 * int(sizes[-1]), DRAWN)
    open_ones = [i for i in order[: 4 * wanted] if not pool.closed[i] and pool.possible(int(i))][:wanted]
    rows = pool.at(np.array(open_ones, int))[..., aim.wide.fitted]
    some = np.unique(np.linspace(0, len(sizes) - 1, SIZES).round().astype(int))
    out = [
        np.median([
            aim.information.error(rows[rng.permutation(len(rows))[:size]], aim.task) for _ in range(DRAWS)
        ])
        for size in sizes[some]
    ]  # fmt: skip
    return sizes[some], np.array(out)


def _enough(sizes: Array, errors: Array, sigma: float) -> int | None:
    """The number of poses from which on MORE lower what a check shows, its own noise included, by < WORTH."""
    shown = np.sqrt(errors**2 + 3 * sigma**2)
    little = np.flatnonzero(shown[MORE:] > (1 - WORTH) * shown[:-MORE])
    return int(sizes[little[0]]) if little.size else None
