"""Which families of joints' transmission errors the data ask for: forward selection by cross-validation.

A family is added where two things hold: the error on left-out regions of joint space falls by more than its
standard error and by a share that is worth it, and an F-test on all data says that chance would hardly do
it. Cross-validation also chooses how wide the family's priors are, as a term that runs away under wide ones
may serve under narrow ones: as narrow as does no harm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._typing import Array
from ..estimation.error_model import ErrorParameter
from ..estimation.parameters import EXTENSIONS, PARAMETER_SETS
from ..estimation.problem import Problem, linearize_and_factor
from ..estimation.qr import TriangularSystem
from ..estimation.solver import Progress
from ..exceptions import DhcalError
from ..formatting import Table, format_fixed
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..robot.error_families import FAMILIES
from . import procedure
from .cross_validation import (
    FoldSystems,
    count_rows,
    factor_folds,
    solve_columns,
    standard_error,
)
from .partition import blocked_folds, contact_groups
from .result import Result

# Widths of a family's priors that are tried, as shares of the default ones.
PRIOR_WIDTHS = (1.0, 0.3, 0.1, 0.03)


# A family that lowers the error by a smaller share is not worth its unknowns.
MIN_IMPROVEMENT = 0.01


# A family that chance alone would make look so good more often than this is not added.
MAX_P_VALUE = 0.01


# A hint is given of one that leaves less than this share of the error, with so many rows left over for each
# of its unknowns; so many samples tell.
MAX_HINT_RATIO, MIN_ROWS_PER_PARAMETER, MAX_HINT_SAMPLES = 0.9, 5, 500


# Smaller chances differ by nothing that one could believe.
MIN_SHOWN_P_VALUE = 1e-6


@dataclass(frozen=True)
class FamilyTrial:
    """What a family would bring on top of those kept before it.

    Attributes:
        family: a set of `parameters.EXTENSIONS`.
        cv_before, cv_after: cross-validated error without and with it, in standard deviations.
        standard_error: of the difference.
        p_value: how often chance alone would lower the fit's own cost as much.
        prior_width: its priors, as a share of the default ones.
        is_selected: whether it was added.
    """

    family: str
    cv_before: float
    cv_after: float
    standard_error: float
    p_value: float
    prior_width: float
    is_selected: bool = False

    @property
    def is_significant(self) -> bool:
        """Whether the data ask for it."""
        gained = self.cv_before - self.cv_after
        return (
            gained > max(self.standard_error, MIN_IMPROVEMENT * self.cv_before) and self.p_value < MAX_P_VALUE
        )


def trial_table(found: Sequence[FamilyTrial]) -> Table:
    """What each family brought, or would bring on top of those added before it."""
    header = ["family", "verdict", "before", "after"]
    header += ["standard error of the change", "by chance", "prior width"]
    rows = [
        [
            one.family,
            "added" if one.is_selected else "not selected",
            format_fixed(one.cv_before, 3),
            format_fixed(one.cv_after, 3),
            format_fixed(one.standard_error, 3),
            f"{one.p_value:.1g}" if one.p_value > MIN_SHOWN_P_VALUE else f"< {MIN_SHOWN_P_VALUE:g}",
            f"{one.prior_width:g} of default",
        ]
        for one in found
    ]
    return Table(header, rows, n_text_columns=2)


@dataclass(frozen=True, eq=False)
class _LinearizedFit:
    """Everything around the fit without extensions: linear, and columns for all families at once.

    Attributes:
        problem: with all families, and default priors of theirs.
        system: triangle of all its data.
        x: (p,) where it is linear.
        family: (p,) the family of each column, or "".
        folds: triangles of every fold.
    """

    problem: Problem
    system: TriangularSystem
    x: Array
    family: Array
    folds: tuple[FoldSystems, ...] = ()

    def with_prior_widths(self, kept: dict[str, float]) -> tuple[Array, Array]:
        """Weights (p,) with the priors of some families narrowed, and which columns (p,) count."""
        width = np.array([kept.get(name, 1.0) for name in self.family])
        return self.problem.weights / width, (self.family == "") | np.isin(self.family, list(kept))

    def errors(self, kept: dict[str, float]) -> Array:
        """Each fold's error (k,) with some families at prior widths."""
        weights, columns = self.with_prior_widths(kept)
        return np.array([part.error(weights, self.x, columns) for part in self.folds])

    def cost(self, kept: dict[str, float]) -> float:
        """The least cost of all data and priors."""
        weights, columns = self.with_prior_widths(kept)
        return solve_columns(self.system, weights, self.x, columns)[1]

    def degrees_of_freedom(self, name: str, kept: dict[str, float]) -> tuple[int, int]:
        """How many unknowns a family adds to those that are kept, and how many rows are left over then."""
        more = int(np.sum(self.family == name))
        return more, count_rows(self.problem) - int(np.sum(self.with_prior_widths(kept)[1])) - more

    def trial(self, name: str, kept: dict[str, float]) -> FamilyTrial:
        """A family at the narrowest width that is no more than a standard error worse than the best one."""
        before = self.errors(kept)
        tried = [(self.errors(kept | {name: width}), width) for width in PRIOR_WIDTHS]
        best = min((errors for errors, _ in tried), key=np.mean)
        after, width = next(
            (errors, width)
            for errors, width in reversed(tried)
            if np.mean(errors - best) <= standard_error(errors - best)
        )
        more, left = self.degrees_of_freedom(name, kept)
        without, with_it = self.cost(kept), self.cost(kept | {name: 1.0})
        chance = 1.0
        if left > 0 and with_it > 0:
            from scipy.special import (
                fdtrc,  # a good part of the start-up, and few fits are extended
            )

            chance = float(fdtrc(more, left, (without - with_it) / more / (with_it / left)))
        error = standard_error(before - after)
        return FamilyTrial(name, float(before.mean()), float(after.mean()), error, chance, width)


def _missing_parameters(fit: Result, families: Sequence[str]) -> dict[str, list[ErrorParameter]]:
    """The parameters of families that have some which the fit does not."""
    there = {p.name for p in fit.errors.parameters}
    found = {name: PARAMETER_SETS[name](fit.errors.chain) for name in families}
    return {name: ps for name, ps in found.items() if any(p.name not in there for p in ps)}


def _linearize_fit(
    fit: Result, data: Sequence[Measurement], families: dict[str, list[ErrorParameter]]
) -> _LinearizedFit:
    """The stage of a fit and some of its data, which nothing has parted yet."""
    names = {p.name for p in fit.errors.parameters}
    new = [p for parameters in families.values() for p in parameters if p.name not in names]
    errors = fit.errors.with_parameters(new)
    robot = len(fit.errors.parameters)
    at = dict(
        zip(
            (p.name for p in fit.errors.parameters),
            zip(fit.x, fit.problem.weights, strict=False),
            strict=False,
        )
    )
    start = [at.get(p.name, (0.0, 1 / p.prior)) for p in errors.parameters]
    x = np.array([*(value for value, _ in start), *fit.x[robot:]])
    weights = np.array([*(weight for _, weight in start), *fit.problem.weights[robot:]])
    home = {p.name: name for name, parameters in families.items() for p in parameters if p.name not in names}
    problem = replace(fit.problem, errors=errors, weights=weights, data=tuple(data))
    return _LinearizedFit(
        problem,
        linearize_and_factor(problem, x, small_angle=False),
        x,
        np.array([home.get(p.name, "") for p in errors.parameters] + [""] * len(fit.x[robot:])),
    )


def select_error_families(
    fit: Result, families: Sequence[str] = EXTENSIONS, progress: Progress | None = None
) -> tuple[FamilyTrial, ...]:
    """Tries families on top of a fit and keeps the best that helps, until none does.

    Args:
        fit: a calibration without them, by method lm and with priors.
        families: of `parameters.EXTENSIONS`; one without a parameter on this robot is passed over.
        progress: called with the number of folds done.

    Returns:
        The kept ones in the order they were added, then the others as they would come on top of those.

    Raises:
        DhcalError: an unknown family.
    """
    if unknown := [name for name in families if name not in EXTENSIONS]:
        raise DhcalError(f"no extension {unknown[0]!r}: choose from {', '.join(EXTENSIONS)}, or auto or none")
    found = _missing_parameters(fit, families)
    if not found:
        return ()
    stage = _linearize_fit(fit, fit.problem.data, found)
    folds = blocked_folds(stage.problem.data, groups=contact_groups(stage.problem, stage.x))
    stage = replace(stage, folds=factor_folds(stage.problem, stage.x, folds, progress))
    kept: dict[str, float] = {}
    out: list[FamilyTrial] = []
    while True:
        trials = [stage.trial(name, kept) for name in found if name not in kept]
        helping = [trial for trial in trials if trial.is_significant]
        if not helping:
            return (*out, *trials)
        best = min(helping, key=lambda trial: trial.cv_after)
        kept[best.family] = best.prior_width
        out.append(replace(best, is_selected=True))


def family_hint(fit: Result) -> str:
    """A sentence on the family that would take up most of what a fit leaves; "" if little, or by chance.

    Around the fit, without another one, and from `MOST` samples of each measurement at most.
    """
    some = [item.take(np.s_[:: max(1, -(-len(item.rows) // MAX_HINT_SAMPLES))]) for item in fit.problem.data]
    found = _missing_parameters(fit, EXTENSIONS)
    stage = _linearize_fit(fit, some, found)
    now, best = stage.cost({}), (MAX_HINT_RATIO, "")
    for name in found:
        more, left = stage.degrees_of_freedom(name, {})
        then = stage.cost({name: 1.0})
        if left < MIN_ROWS_PER_PARAMETER * more or not then > 0:
            continue
        # Beyond this, a χ² of so many degrees is once in a million times (Laurent and Massart 2000).
        chance = more + 2 * np.sqrt(14 * more) + 28
        if (now - then) / (then / left) > chance:
            best = min(best, (float(np.sqrt(then / left / (now / (left + more)))), name))
    share, name = best
    return name and (
        f"what is left goes with the joints' values as {FAMILIES[name].description} would; "
        f"--extend auto may leave about {100 * share:.0f} % of it"
    )


def extend(
    chain: Chain,
    data: Measurement | Sequence[Measurement],
    parameters: str | None = None,
    families: Sequence[str] = EXTENSIONS,
    **options: Any,
) -> tuple[Result, tuple[FamilyTrial, ...]]:
    """`calibrate`, with those families of joints' transmission errors added that the data ask for.

    All unknowns are solved together in the end, as an extension shares directions with the geometry.

    Args:
        chain: the nominal robot.
        data: one measurement or several of any kinds.
        parameters: sets of `parameters.SETS`; the chain's own default without it.
        families: those that may be added.
        options: of `calibrate`; method lm and priors are needed.

    Raises:
        DhcalError: as `calibrate`, or an unknown family, no priors, or another method than lm.
    """
    priors = options.get("priors") or "default"
    if families and (options.get("method", "lm") != "lm" or priors == "none"):
        raise DhcalError(
            "an extension is chosen by method lm with priors: leave out --method gn, --priors none"
        )
    parameters = chain.parameters if parameters is None else parameters
    fit = procedure.calibrate(chain, data, parameters, **options)
    trials = select_error_families(fit, families, options.get("progress"))
    widths = {trial.family: trial.prior_width for trial in trials if trial.is_selected}
    if not widths:
        return fit, trials
    narrowed = {
        p.name: p.prior * width for name, width in widths.items() for p in PARAMETER_SETS[name](chain)
    }
    own = {} if isinstance(priors, str) else dict(priors)
    options["priors"] = narrowed | own
    return procedure.calibrate(chain, data, ",".join([parameters, *widths]), **options), trials


# All that positions and poses can tell of any arm, wherever instrument and target are.
FULL_SET = "minimal,base,tool"


def is_restricted(sets: Sequence[str]) -> bool:
    """Whether sets are of the robot, and fewer than EVERYTHING."""
    frames = {"base", "tool"}
    full = frames <= set(sets) and {"minimal", "placement"} & set(sets)
    return not full and not set(sets) <= frames
