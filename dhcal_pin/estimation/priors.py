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
expected one of its unit. Groups of other parameters state their own count and limits.

References:
    D. J. C. MacKay, Bayesian Interpolation, Neural Computation 4, 1992.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .._typing import Array
from ..exceptions import InvalidArgumentError, UnknownNameError
from .error_model import ErrorModel
from .parameters import fold_harmonics
from .problem import Problem
from .solver import SolverResult

Priors = Literal["default", "none"] | Mapping[str, float]

# Smallest and largest prior standard deviation, in the unit of the parameter. Beyond them the squares of the
# weights lose all digits of the data, or the prior has no effect.
MIN_PRIOR_STD, MAX_PRIOR_STD = 1e-12, 1e6

# Number of determined parameters that the expected standard deviation counts for against smaller errors.
EXPECTATION_COUNT = 0.5
# Smallest positive number.
_SMALLEST = np.finfo(float).tiny


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


@dataclass(frozen=True, eq=False)
class PriorGroups:
    """Groups of parameters whose default priors share one scale: those of one unit and one expected size."""

    members: Array  # Indices of the parameters in any group, shape (n,)
    group_index: Array  # Group of each of them, shape (n,)
    expected_weights: Array  # Reciprocal expected standard deviation of each group, shape (g,)
    min_weights: Array  # Smallest weight of each group, shape (g,)
    max_weights: Array  # Largest weight of each group, shape (g,)
    # Number of determined parameters that the expected standard deviation of each group counts for against
    # smaller errors, shape (g,).
    expectation_counts: Array

    @classmethod
    def from_expected(cls, errors: ErrorModel, expected: Array, default: Array) -> PriorGroups:
        """Group the parameters of the robot that have default priors; base and tool are left out."""
        inside = np.flatnonzero(errors.is_of_arm & default).tolist()
        # Angles of the geometry and of the transmission count as different units.
        units = [(errors.parameters[i].unit, errors.parameters[i].coefficient_index is None) for i in inside]
        keys = list(zip(units, expected[inside].tolist(), strict=True))
        distinct = list(dict.fromkeys(keys))
        max_weights = [max(weight for unit, weight in distinct if unit == own) for own, _ in distinct]
        return cls(
            np.array(inside, int),
            np.array([distinct.index(key) for key in keys], int),
            np.array([weight for _, weight in distinct]),
            np.zeros(len(distinct)),
            np.array(max_weights),
            np.full(len(distinct), EXPECTATION_COUNT),
        )

    @classmethod
    def none(cls) -> PriorGroups:
        """Return no groups: all priors keep their standard deviations."""
        return cls(np.empty(0, int), np.empty(0, int), np.empty(0), np.empty(0), np.empty(0), np.empty(0))

    def joined(self, other: PriorGroups) -> PriorGroups:
        """Return these groups and others."""
        return PriorGroups(
            np.concatenate([self.members, other.members]),
            np.concatenate([self.group_index, other.group_index + len(self.expected_weights)]),
            np.concatenate([self.expected_weights, other.expected_weights]),
            np.concatenate([self.min_weights, other.min_weights]),
            np.concatenate([self.max_weights, other.max_weights]),
            np.concatenate([self.expectation_counts, other.expectation_counts]),
        )

    def groups(self) -> list[tuple[list[int], float]]:
        """List the groups."""
        return [
            (self.members[self.group_index == i].tolist(), weight)
            for i, weight in enumerate(self.expected_weights.tolist())
        ]


def effective_parameters(problem: Problem, solution: SolverResult) -> float:
    """Compute the effective number of parameters that the data determine (MacKay 1992)."""
    root = solution.system.sqrt_covariance(problem.weights)[0]
    return root.shape[1] - float(np.einsum("ij,ij->i", root, root) @ problem.weights**2)


def update_prior_scales(problem: Problem, solution: SolverResult, groups: PriorGroups) -> Array:
    """Estimate the scale of each group's priors from the errors in a solution (evidence procedure)."""
    weights, members, group_index = problem.weights.copy(), groups.members, groups.group_index
    if not len(members):
        return weights
    expected = groups.expected_weights
    root = solution.system.sqrt_covariance(problem.weights)[0][members]
    # γ: fraction of each parameter that the data determine.
    determined = np.fmax(0.0, 1 - np.einsum("ij,ij->i", root, root) * problem.weights[members] ** 2)
    squares = np.bincount(group_index, solution.x[members] ** 2) * expected**2
    count = np.bincount(group_index, determined)
    extra = np.where(squares <= count, groups.expectation_counts, 0.0)
    updated = expected * np.sqrt(np.fmax(count + extra, _SMALLEST) / np.fmax(squares + extra, _SMALLEST))
    updated = np.fmin(np.fmax(updated, groups.min_weights), groups.max_weights)
    weights[members] = updated[group_index]
    return weights
