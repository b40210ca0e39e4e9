"""Plans that reveal changes of a robot: of a calibrated one, and during a session.

The likely changes of a calibrated robot are those of the zero of each joint and of the poses of base and
tool. Poses with the smallest mean variance of these changes, in units of the sizes that must be seen, reveal
them.

A session reveals changes if some poses are measured several times: at its begin, middle and end.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..estimation.parameters import select_parameters
from ..exceptions import InvalidArgumentError
from ..measurements.base import Noise
from ..robot.chain import Chain
from ..robot.collision import CollisionChecker
from ..robot.sampling import WorkspaceConstraints, limits_with_margin, scale_joint_units
from .criteria import DOptimality
from .exchange import CandidateSet, select_greedily
from .planner import Plan
from .tour import connected

# Sizes of changes that a check must reveal [m, rad].
CHANGE = Noise(5e-4, np.deg2rad(0.05))
# Number of poses that are repeated, times that they are measured, and fewest measurements for each.
N_REPEATED, N_VISITS, MIN_PER_REPEATED = 3, 3, 6


def change_options(chain: Chain) -> dict[str, Any]:
    """Return the keyword arguments of `plan` for poses that reveal changes of a calibrated robot."""
    sets = "offset,base,tool"
    sizes = {"m": CHANGE.position, "rad": CHANGE.rotation}
    priors = {p.name: sizes[p.unit] for p in select_parameters(chain, sets).parameters}
    return {"parameters": sets, "priors": priors, "criterion": "A", "prior_uncertainty": None}


def repeated_count(count: int) -> int:
    """Return how many of the poses of a session of `count` measurements are repeated."""
    if count < MIN_PER_REPEATED:
        raise InvalidArgumentError(
            f"{count} poses: expected at least {MIN_PER_REPEATED} to repeat some of them"
        )
    return min(N_REPEATED, count // MIN_PER_REPEATED)


def with_repeats(
    plan: Plan,
    chain: Chain,
    n_repeated: int,
    space: WorkspaceConstraints,
    margin: Noise,
) -> Plan:
    """Return a plan with its most informative poses at the beginning, in the middle and at the end."""
    rows, none = plan.information.rows(plan.q), np.zeros(0, int)
    candidates = CandidateSet(rows, scale_joint_units(chain, plan.q), 0.0)
    chosen = select_greedily(
        candidates,
        plan.information.prior_factor,
        n_repeated,
        DOptimality(),
        none,
        np.zeros((0, chain.n_joints)),
    )
    chosen, rest = np.sort(chosen), np.setdiff1d(np.arange(len(plan.q)), chosen)
    halves = np.array_split(rest, N_VISITS - 1)
    order = np.concatenate([part for half in halves for part in (chosen, half)] + [chosen])
    limits = limits_with_margin(chain, margin.rotation, margin.position)
    checker = CollisionChecker.from_chain(chain, space.environment)
    ways, is_free, rng = [plan.q[:0]], [True], np.random.default_rng(0)
    can_turn = np.zeros(chain.n_joints, bool)
    for start, end in zip(plan.q[order[:-1]], plan.q[order[1:]], strict=True):
        _, way, is_this_free = connected(checker, start, end[None], *limits, can_turn, rng)
        ways.append(way)
        is_free.append(is_this_free)
    firsts = np.flatnonzero(order == chosen[0]) + 1
    ranges = [str(i) if n_repeated == 1 else f"{i} to {i + n_repeated - 1}" for i in firsts]
    return replace(
        plan,
        notes=(*plan.notes, f"poses measured again: {ranges[0]} as {' and '.join(ranges[1:])}"),
        q=plan.q[order],
        index=None if plan.index is None else plan.index[order],
        ways=tuple(ways),
        is_way_free=tuple(is_free) if plan.is_way_free else (),
    )
