"""How large errors are expected to be, before any measurement and after a fit."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .._typing import Array
from ..exceptions import DhcalError
from ..robot.chain import BASE_FRAME
from .error_model import ErrorModel
from .problem import Problem
from .qr import posterior_sqrt_covariance
from .solver import SolverResult

Priors = Literal["default", "none"] | Mapping[str, float]


# Against narrower priors the expected size counts as much as so many errors that were found.
EXPECTATION_COUNT = 0.5


def prior_weights(errors: ErrorModel, priors: Priors) -> Array:
    """One over each prior's sigma (p,), zero where there is none.

    Raises:
        DhcalError: an unknown choice or name, or a sigma that is not positive.
    """
    if isinstance(priors, str):
        if priors not in ("default", "none"):
            raise DhcalError(f"priors {priors!r}: choose default, none, or sigmas by name")
        return 1 / errors.priors if priors == "default" else np.zeros(len(errors.parameters))
    sigma = errors.priors.copy()
    names = [p.name for p in errors.parameters]
    for pattern, value in priors.items():
        hit = [i for i, name in enumerate(names) if fnmatch.fnmatchcase(name, pattern)]
        if not hit:
            raise DhcalError(f"prior for {pattern!r}: no such parameter; there are {', '.join(names)}")
        if not value > 0:
            raise DhcalError(f"prior for {pattern!r}: {value} must be positive, in its parameter's unit")
        sigma[hit] = value
    return 1 / sigma


def has_default_prior(errors: ErrorModel, priors: Priors) -> Array:
    """Which parameters (p,) have default priors."""
    if isinstance(priors, str):
        return np.full(len(errors.parameters), priors == "default")
    return np.array([not any(fnmatch.fnmatchcase(p.name, key) for key in priors) for p in errors.parameters])


@dataclass(frozen=True, eq=False)
class PriorGroups:
    """Parameters whose default priors share one scale: those of one unit and one expected size.

    Attributes:
        members: (n,) the parameters.
        group_index: (n,) which family each is of.
        expected_weights: (f,) one over the size that a family's errors are expected to have.
        max_weights: (f,) the largest of those in its unit.
    """

    members: Array
    group_index: Array
    expected_weights: Array
    max_weights: Array

    @classmethod
    def from_expected(cls, errors: ErrorModel, expected: Array, default: Array) -> PriorGroups:
        """Of parameters (p,) with such expected weights that have default priors."""
        outside = (BASE_FRAME, errors.chain.tool_frame_index)
        inside = [i for i, p in enumerate(errors.parameters) if default[i] and p.error_frame not in outside]
        units = [(errors.parameters[i].unit, errors.parameters[i].coefficient_index is None) for i in inside]
        sizes = list(zip(units, expected[inside].tolist(), strict=True))
        families = list(dict.fromkeys(sizes))
        narrowest = [max(weight for unit, weight in families if unit == mine) for mine, _ in families]
        return cls(
            np.array(inside, int),
            np.array([families.index(size) for size in sizes], int),
            np.array([weight for _, weight in families]),
            np.array(narrowest),
        )

    def groups(self) -> list[tuple[list[int], float]]:
        """The members of each and its expected weight."""
        return [
            (self.members[self.group_index == i].tolist(), w)
            for i, w in enumerate(self.expected_weights.tolist())
        ]


def update_prior_scales(problem: Problem, solution: SolverResult, families: PriorGroups) -> Array:
    """The weights (p+s,) of priors as wide as the errors that were found.

    Default priors of one unit and one expected size have one scale, the one of greatest evidence
    (MacKay 1992): the mean square of the errors over as many as the data and not the prior determine.
    None gets narrower than the narrowest expectation of its unit, as offsets of no more than tilts' size.
    Priors that are not default stay.
    """
    weights, members, family = problem.weights.copy(), families.members, families.group_index
    if not len(members):
        return weights
    expected, root = (
        families.expected_weights,
        posterior_sqrt_covariance(solution.system, problem.weights)[0][members],
    )
    told = 1 - np.einsum("ij,ij->i", root, root) * problem.weights[members] ** 2
    found = np.bincount(family, solution.x[members] ** 2) * expected**2
    count = np.bincount(family, told)
    share = np.where(found <= count, EXPECTATION_COUNT, 0.0)
    scaled = np.fmin(expected * np.sqrt((count + share) / (found + share)), families.max_weights)
    weights[members] = scaled[family]
    return weights
