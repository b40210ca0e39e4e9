"""Joint origins that fit best without joint errors: what the URDF alone describes.

Programs that read no sidecar use the joint origins alone. Joint origins that were estimated together with
joint errors make sense only with these. The origins of the URDF are therefore other ones: geometric errors x
that minimize the distance to the complete model T(q) without joint errors,

    Σ w_i·‖t_i(x) - t_i‖² + Σ w_i·ℓ²·‖log(R_i(x)ᵀ·R_i)‖²,

over the measured configurations, and with a small weight over the joint space. The sidecar holds what the
complete model adds to these origins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..measurements.base import Measurement
from ..measurements.measured_region import draw_joint_space
from ..measurements.pose import Pose
from ..robot.chain import Chain
from .error_model import ErrorModel
from .problem import Problem
from .solver import minimize

# Largest numbers of configurations, measured and of the joint space; measured ones are thinned evenly.
MAX_MEASURED, MAX_DRAWN = 600, 200
# Weight of the joint space as a whole, relative to the measured configurations.
JOINT_SPACE_WEIGHT = 0.01
# Lever ℓ by which differences of the orientation count as distances, if no orientation was measured [m].
LEVER = 0.1
# Distance that counts as one [m]. It is far below the priors, which only hold what no pose depends on.
UNIT = 1e-5


@frozen(eq=False)
class BareGeometry:
    """Geometric errors that fit best without joint errors."""

    errors: ErrorModel  # Nominal chain without joint errors, and its unknown geometric errors
    x: Array  # Identified geometric errors, shape (g,) [m or rad]
    configurations: Array  # Measured configurations, then those of the joint space, shape (m, n)
    weights: Array  # Weight of each of them, shape (m,)
    lever: float  # Lever ℓ by which differences of the orientation count as distances [m]

    @cached_property
    def chain(self) -> Chain:
        """Chain without joint errors, with the base and the tool that fit best."""
        return self.errors.at(self.x)

    def with_frames_of(self, complete: Chain) -> Chain:
        """Return the same model with base and tool of the complete one, and other outer joint origins."""
        chain = self.chain
        origins = chain.origins.copy()
        origins[0] = se3.inverse(complete.base) @ chain.base @ origins[0]
        origins[-1] = origins[-1] @ chain.tool @ se3.inverse(complete.tool)
        return replace(chain, origins=origins, base=complete.base, tool=complete.tool)

    def refitted(self, complete: Chain) -> BareGeometry:
        """Fit the geometric errors to another complete model."""
        sigma = UNIT / np.sqrt(self.weights)[:, None] * np.ones(3)
        poses = Pose(self.configurations, complete.poses(self.configurations), sigma, sigma / self.lever)
        problem = Problem(self.errors, (poses,), 1 / self.errors.priors, {})
        return replace(self, x=minimize(problem, "lm", self.x).x)


def fit_bare_geometry(
    errors: ErrorModel, x: Array, complete: Chain, data: Sequence[Measurement]
) -> BareGeometry | None:
    """Fit the geometry without joint errors to a complete model with errors x; None without joint errors."""
    # Distances and angles have the weights that they have in the measurements.
    if not complete.error_families:
        return None
    geometric = tuple(p for p in errors.parameters if p.coefficient_index is None)
    bare = replace(errors, chain=replace(errors.chain, transmission=None), parameters=geometric)
    measured = np.unique(np.concatenate([item.configurations() for item in data]), axis=0)
    measured = measured[np.linspace(0, len(measured) - 1, min(len(measured), MAX_MEASURED)).astype(int)]
    drawn = draw_joint_space(complete)[:MAX_DRAWN]
    shares = (1.0, measured), (JOINT_SPACE_WEIGHT, drawn)
    weights = np.concatenate([np.full(len(q), share / len(q)) for share, q in shares])
    levers = [
        np.median(item.sigma) / np.median(item.rotation_sigma) for item in data if isinstance(item, Pose)
    ]
    lever = float(np.median(levers or [LEVER]))
    start = BareGeometry(bare, x[: len(geometric)], np.concatenate([measured, drawn]), weights, lever)
    return start.refitted(complete)
