"""Prior standard deviations of the errors, and their estimation from the data.

Each parameter error x_i has a normal prior of mean zero and standard deviation σ_i. The prior enters the
least-squares problem as one more row x_i/σ_i; its weight is 1/σ_i.

Default priors state the order of magnitude only. `update_prior_scales` therefore estimates one factor per
group of parameters by the evidence procedure (MacKay 1992). With the posterior variance s_i² of parameter i,
the data determine the fraction γ_i = 1 - s_i²/σ_i² of it. The prior standard deviation of greatest evidence
satisfies, in units of the expected one,

    σ² = Σ x_i² / Σ γ_i

and is iterated together with x. If the errors of the robot are smaller than expected, both sums
get EXPECTATION_COUNT additional parameters with σ = 1, and no prior becomes narrower than the narrowest
expected one of its unit. None becomes wider than MAX_WIDENING times its expected one. Groups of other
parameters state their own count and limits.

References:
    D. J. C. MacKay, Bayesian Interpolation, Neural Computation 4, 1992.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping
from typing import Literal

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..exceptions import InvalidArgumentError, UnknownNameError
from .error_model import ErrorModel
from .parameters import fold_harmonics
from .problem import Problem
from .qr import TriangularSystem
from .solver import SolverResult

Priors = Literal["default", "none"] | Mapping[str, float]

# Smallest and largest prior standard deviation, in the unit of the parameter. Beyond them the squares of the
# weights lose all digits of the data, or the prior has no effect.
MIN_PRIOR_STD, MAX_PRIOR_STD = 1e-12, 1e6

# Number of determined parameters that the expected standard deviation counts for against smaller errors.
EXPECTATION_COUNT = 0.5
# Largest estimated standard deviation as a multiple of the expected one. One error that the data hardly
# determine would otherwise widen the priors of its group without limit, and grow with them.
MAX_WIDENING = 10.0
# Sums of squares below this one count as it, so that ratios of them are finite.
_SMALLEST = 1e-100


def prior_weights(errors: ErrorModel, priors: Priors) -> Array:
    """Compute the reciprocal prior standard deviation of each parameter."""
    if isinstance(priors, str):
        if priors not in ("default", "none"):
            raise UnknownNameError(
                f"unknown priors {priors!r}; choose default, none, or standard deviations by name"
            )
        return 1 / errors.priors if priors == "default" else np.zeros(len(errors.parameters))
    sigma = errors.priors.copy()
    names = [p.name for p in errors.parameters]
    for pattern, value in priors.items():
        matches = [i for i, name in enumerate(names) if fnmatch.fnmatchcase(name, pattern)]
        if not matches:
            choices = ", ".join(fold_harmonics(names))
            raise UnknownNameError(
                f"prior for {pattern!r}: no such parameter; choose from {choices}", "priors"
            )
        if not MIN_PRIOR_STD <= value <= MAX_PRIOR_STD:
            raise InvalidArgumentError(
                f"prior for {pattern!r}: {value} must be positive, from {MIN_PRIOR_STD:g} to "
                f"{MAX_PRIOR_STD:g} in the unit of the parameter; fix a parameter that is known exactly"
            )
        sigma[matches] = value
    return 1 / sigma


def has_default_prior(errors: ErrorModel, priors: Priors) -> Array:
    """Find the parameters that have default priors."""
    if isinstance(priors, str):
        return np.full(len(errors.parameters), priors == "default")
    is_default = (not any(fnmatch.fnmatchcase(p.name, key) for key in priors) for p in errors.parameters)
    return np.fromiter(is_default, bool)


@frozen
class PriorGroup:
    """Parameters whose priors share one scale."""

    members: list[int]  # Indices of the parameters
    expected_weight: float  # Reciprocal of their expected standard deviation
    min_weight: float  # Smallest weight
    max_weight: float  # Largest weight
    # Number of determined parameters that the expected standard deviation counts for against smaller errors.
    expectation_count: float


# Groups of a problem; the priors of all other parameters keep their standard deviations.
PriorGroups = tuple[PriorGroup, ...]


def group_default_priors(errors: ErrorModel, expected: Array, default: Array) -> PriorGroups:
    """Group the default priors of the arm, those of one unit and one expected size together."""
    groups: dict[tuple[tuple[str, bool], float], list[int]] = {}
    for i in np.flatnonzero(errors.is_of_arm & default).tolist():
        parameter = errors.parameters[i]
        # Angles of the geometry and of the transmission count as different units.
        unit = parameter.unit, parameter.coefficient_index is None
        groups.setdefault((unit, float(expected[i])), []).append(i)
    return tuple(
        PriorGroup(
            members,
            weight,
            weight / MAX_WIDENING,
            max(other for own, other in groups if own == unit),
            EXPECTATION_COUNT,
        )
        for (unit, weight), members in groups.items()
    )


def determined_fractions(system: TriangularSystem, weights: Array) -> Array:
    """Return the fraction γ (p,) of each unknown that the data determine, with prior weights (p,)."""
    root = np.ascontiguousarray(system.sqrt_covariance(weights)[0])
    return np.fmax(0.0, 1 - np.einsum("ij,ij->i", root, root) * weights**2)


def effective_parameters(problem: Problem, solution: SolverResult) -> float:
    """Compute the effective number of parameters that the data determine (MacKay 1992)."""
    root = solution.system.sqrt_covariance(problem.weights)[0]
    return root.shape[1] - float(np.einsum("ij,ij->i", root, root) @ problem.weights**2)


def update_prior_scales(problem: Problem, solution: SolverResult, groups: PriorGroups) -> Array:
    """Estimate the scale of each group's priors from the errors in a solution (evidence procedure)."""
    weights = problem.weights.copy()
    determined = determined_fractions(solution.system, problem.weights) if groups else weights
    for group in groups:
        expected, count = group.expected_weight, sum(determined[group.members].tolist())
        square = sum((solution.x[group.members] ** 2).tolist()) * expected**2
        extra = group.expectation_count if square <= count else 0.0
        updated = expected * np.sqrt(max(count + extra, _SMALLEST) / max(square + extra, _SMALLEST))
        weights[group.members] = min(max(updated, group.min_weight), group.max_weight)
    return weights
