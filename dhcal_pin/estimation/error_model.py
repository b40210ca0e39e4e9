"""A chain's unknown errors: each is a twist at a station, some scaled by what the joint does.

Changes at one station act in the order of the list, M ← M·exp(x₁ξ₁)·exp(x₂ξ₂)…, so a parameter's value
is always its whole error from the nominal chain, DH's changes are exact (its rotations and translations
about one axis commute), and the derivative at any value is a twist again. A scaled one, such as a gain or
a compliance, is an entry of the chain's transmission: its twist is the joint's own, times a term of the
joint's value and load.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .._kernels import perturb_frames
from .._typing import Array
from ..robot.chain import BASE_FRAME, Chain, bodies_of_frames
from ..robot.transmission import Transmission


@dataclass(frozen=True)
class ErrorParameter:
    """One scalar error.

    Attributes:
        name: what users call it, as `d2` or `elbow_joint.rx`.
        unit: "m" or "rad"; of a scaled one "1", "rad", "rad/Nm", "rad/rad", "rad/m".
        nominal: the value that a drawing would show; zero for a pure error.
        error_frame: where it acts (see `chain`).
        twist: (6,) [v, ω] in the station's frame.
        prior: standard deviation expected before any measurement, in its unit.
        coefficient_index: of a scaled one, where its coefficient stands in the transmission's flat coefficients.
    """

    name: str
    unit: str
    nominal: float
    error_frame: int
    twist: tuple[float, ...]
    prior: float
    coefficient_index: int | None = None


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """A nominal chain and p unknown errors, sorted by station.

    Attributes:
        chain: nominal.
        parameters: (p,) the unknowns.
        fixed: parameters of the same sets that are held at nominal.
    """

    chain: Chain
    parameters: tuple[ErrorParameter, ...]
    fixed: tuple[ErrorParameter, ...] = ()

    @cached_property
    def _n_geometric(self) -> int:
        """How many parameters, the first ones, are plain twists."""
        return sum(parameter.coefficient_index is None for parameter in self.parameters)

    @cached_property
    def _coefficient_indices(self) -> Array:
        return np.array(
            [p.coefficient_index for p in self.parameters if p.coefficient_index is not None], int
        )

    @property
    def has_transmission(self) -> bool:
        """Whether its joints may miss their values."""
        return bool(self._coefficient_indices.size) or self.chain.transmission is not None

    @cached_property
    def _twists(self) -> Array:
        return np.array([parameter.twist for parameter in self.parameters]).reshape(-1, 6)[
            : self._n_geometric
        ]

    @cached_property
    def _error_frames(self) -> Array:
        return np.array([parameter.error_frame for parameter in self.parameters], int)[: self._n_geometric]

    @cached_property
    def _bodies(self) -> Array:
        return bodies_of_frames(self.chain, self._error_frames)

    @property
    def priors(self) -> Array:
        """Prior standard deviations (p,), each in its parameter's unit."""
        return np.array([parameter.prior for parameter in self.parameters])

    def _frame_motions(self, x: Array) -> tuple[Array, Array]:
        """Motions of all stations (2k+4, 4, 4), and the plain twists (p, 6) as those of bodies."""
        chain = self.chain
        return perturb_frames(
            chain.body_from_urdf,
            chain.origins,
            chain.tool,
            self._error_frames,
            self._twists,
            x[: self._n_geometric],
        )

    def at(self, x: Array) -> Chain:
        """The chain with errors x (p,) in SI; its joints yield to the nominal arm's masses."""
        x = np.ascontiguousarray(x, float)
        return self._with_transmission(self.chain.perturbed(self._frame_motions(x)[0]), x)

    def _with_transmission(self, chain: Chain, x: Array) -> Chain:
        """A chain with the transmission at x (p,)."""
        if not self._coefficient_indices.size:
            return chain
        held = self._transmission.with_coefficients_added(self._coefficient_indices, x[self._n_geometric :])
        return chain.with_transmission(held)

    @cached_property
    def _transmission(self) -> Transmission:
        return self.chain.transmission or Transmission.zero(self.chain.loads)

    def with_current_loads(self, x: Array) -> ErrorModel:
        """The same unknowns, with joints that yield to the masses as they are placed at x."""
        held = replace(self._transmission, loads=self.at(x).loads)
        return replace(self, chain=self.chain.with_transmission(held))

    def derivative(self, x: Array) -> tuple[Chain, Array, Array]:
        """The chain at x, and for each parameter the body (p,) and twist (p, 6) it moves there.

        Entries of the transmission come last, numbered behind the bodies (see `Chain.tool_velocities`).
        """
        x = np.ascontiguousarray(x, float)
        motions, twists = self._frame_motions(x)
        chain, bodies = self._with_transmission(self.chain.perturbed(motions), x), self._bodies
        if not self._coefficient_indices.size:
            return chain, bodies, twists
        entries = len(chain.moving_joints) + 1 + self._coefficient_indices
        return chain, np.concatenate([bodies, entries]), np.pad(twists, ((0, len(entries)), (0, 0)))

    def with_parameters(self, parameters: Iterable[ErrorParameter]) -> ErrorModel:
        """With more unknowns, each where it belongs: by station, entries of the transmission last."""
        both = (*self.parameters, *parameters)
        ordered = sorted(
            both, key=lambda p: (-1 if p.coefficient_index is None else p.coefficient_index, p.error_frame)
        )
        return replace(self, parameters=tuple(ordered))

    def only_frames(self) -> ErrorModel | None:
        """Base and tool alone, if any of them is unknown."""
        outside = (BASE_FRAME, self.chain.tool_frame_index)
        kept = tuple(p for p in self.parameters if p.error_frame in outside)
        return replace(self, parameters=kept) if kept else None
