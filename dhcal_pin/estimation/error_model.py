"""Error model: a nominal chain and its unknown kinematic errors.

Every error is a scalar x_i that scales a constant twist ξ_i = [v, ω] at one error frame of the chain. Errors
at the same frame act in the order of the list, as right perturbations:

    M ← M·exp(x_1·ξ_1)·exp(x_2·ξ_2)·…

- Twist convention: v are the three linear and ω the three angular components, in axes of the error frame.
  A twist with unit v is a translation in metres per unit of x, one with unit ω a rotation in radians.
- Error frames (see `robot.chain`): 0 is the base, 2j the origin of joint j before its motion, 2j+1 link j
  after the motion of joint j, 2k+2 the tip and 2k+3 the tool, for j = 1 … k.
- Values: x is the whole error from the nominal chain, in metres or radians. Since rotations and translations
  about one axis commute, x of a DH parameter is exactly the difference of its table entry.
- Derivative: at any x, the derivative of the chain by x_i is a twist of one body again (`derivative`).

Errors of the joint transmission, such as a gear ratio error or joint elasticity, scale the joint's own twist
by a function of joint position and load. They are entries of the chain's transmission coefficients instead of
constant twists, and come last in the list.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from .._frozen import frozen
from .._kernels import perturb_frames
from .._typing import Array
from ..formatting import format_fixed
from ..robot.chain import BASE_FRAME, Chain, bodies_of_frames
from ..robot.transmission import Transmission

# Difference to 1 of a direction's largest component below which it is named by an axis: 0.08 degrees.
AXIS_NAME_TOL = 1e-6
# Distance from the origin of the frame below which an axis passes through it [m].
AXIS_POINT_TOL = 5e-7


@frozen
class ErrorParameter:
    """Scalar kinematic error.

    `definition` says in which frame and direction it is defined.
    """

    name: str  #: Name for users, such as `d2` or `elbow_joint.rx`
    #: Unit of the value: "m" or "rad" for a geometric error; "1", "rad", "rad/Nm", "rad/rad", "rad/m" or
    #: "1/K" for a transmission coefficient.
    unit: str
    #: Nominal value in that unit: the DH table entry or the transmission coefficient; zero for errors that
    #: are differences.
    nominal: float
    error_frame: int  #: Index of the error frame: 0 base, 2j joint j, 2j+1 link j, 2k+2 tip, 2k+3 tool
    twist: tuple[float, ...]  #: Twist [v, ω] per unit of the error, in axes of the error frame
    prior: float  #: Standard deviation expected before any measurement, in the unit of the value
    #: Index of the transmission coefficient; None for a geometric error.
    coefficient_index: int | None = None
    #: What a transmission coefficient changes: "position" of a joint or "length" of a link.
    quantity: str = ""

    def definition(self, chain: Chain) -> tuple[str, str]:
        """Describe the frame and the direction in which the error is defined."""
        if self.quantity == "position":
            return f"joint {chain.moving_joints[self.error_frame // 2 - 1]}", self.quantity
        return frame_name(chain, self.error_frame), self.quantity or direction_name(self.twist)


@frozen(eq=False)
class ErrorModel:
    """Nominal chain and p unknown errors."""

    chain: Chain  #: Nominal chain
    #: Unknown errors, length p, sorted by error frame; transmission coefficients last.
    parameters: tuple[ErrorParameter, ...]
    #: Parameters of the same sets that are held at their nominal values.
    fixed: tuple[ErrorParameter, ...] = ()
    undetermined: tuple[ErrorParameter, ...] = ()  #: Those of them that no measurement shows

    @cached_property
    def _n_geometric(self) -> int:
        """Number of geometric errors; they precede the transmission coefficients."""
        return sum(parameter.coefficient_index is None for parameter in self.parameters)

    @cached_property
    def _coefficient_indices(self) -> Array:
        """Indices of the unknown transmission coefficients, shape (e,)."""
        return np.array(
            [p.coefficient_index for p in self.parameters if p.coefficient_index is not None], int
        )

    @property
    def n_coefficients(self) -> int:
        """Number of unknown transmission coefficients."""
        return len(self._coefficient_indices)

    @property
    def has_transmission(self) -> bool:
        """Whether the joints have transmission errors, known or unknown."""
        return bool(self._coefficient_indices.size) or self.chain.transmission is not None

    @cached_property
    def twists(self) -> Array:
        """Twists of the geometric errors in their error frames, shape (p-e, 6)."""
        return np.array([parameter.twist for parameter in self.parameters]).reshape(-1, 6)[
            : self._n_geometric
        ]

    @cached_property
    def error_frames(self) -> Array:
        """Error frames of the geometric errors, shape (p-e,)."""
        return np.array([parameter.error_frame for parameter in self.parameters], int)[: self._n_geometric]

    @cached_property
    def bodies(self) -> Array:
        """Bodies that the geometric errors move, shape (p-e,)."""
        return bodies_of_frames(self.chain, self.error_frames)

    @property
    def priors(self) -> Array:
        """Prior standard deviations of shape (p,), each in the unit of its parameter."""
        return np.array([parameter.prior for parameter in self.parameters])

    def _perturb_frames(self, x: Array) -> tuple[Array, Array]:
        """Compute the displacements of all error frames (2k+4, 4, 4) and the body twists (p-e, 6) at x."""
        chain = self.chain
        displacements, twists = perturb_frames(
            chain.body_from_urdf,
            chain.origins[None],
            chain.tool[None],
            self.error_frames,
            self.twists[None],
            x[None, : self._n_geometric],
        )
        return displacements[0], twists[0]

    def at(self, x: Array) -> Chain:
        """Build the chain with given errors; its gravity torques are nominal, see `with_current_loads`."""
        x = np.ascontiguousarray(x, float)
        return self._with_transmission(self.chain.perturbed(self._perturb_frames(x)[0]), x)

    def _with_transmission(self, chain: Chain, x: Array) -> Chain:
        """Return a chain with the transmission coefficients at x (p,)."""
        if not self._coefficient_indices.size:
            return chain
        transmission = self._transmission.with_coefficients_added(
            self._coefficient_indices, x[self._n_geometric :]
        )
        return chain.with_transmission(transmission)

    @cached_property
    def _transmission(self) -> Transmission:
        """Transmission of the nominal chain; zero if it has none."""
        return self.chain.transmission or Transmission.zero(self.chain.loads)

    def with_current_loads(self, x: Array) -> ErrorModel:
        """Return the model with the gravity torques of the chain at x."""
        transmission = replace(self._transmission, loads=self.at(x).loads)
        return replace(self, chain=self.chain.with_transmission(transmission))

    def derivative(self, x: Array) -> tuple[Chain, Array, Array]:
        """Compute the chain at x, and its derivative by each error."""
        # The derivative is the body (p,) that each error moves, and its twist (p, 6) in its own frame, as
        # `Chain.tool_jacobian` takes them. Transmission coefficients have numbers above those of the bodies.
        x = np.ascontiguousarray(x, float)
        displacements, twists = self._perturb_frames(x)
        chain, bodies = self._with_transmission(self.chain.perturbed(displacements), x), self.bodies
        if not self._coefficient_indices.size:
            return chain, bodies, twists
        entries = len(chain.moving_joints) + 1 + self._coefficient_indices
        return chain, np.concatenate([bodies, entries]), np.pad(twists, ((0, len(entries)), (0, 0)))

    def with_parameters(self, parameters: Iterable[ErrorParameter]) -> ErrorModel:
        """Return the model with further unknowns, sorted by error frame."""
        ordered = sorted(
            (*self.parameters, *parameters),
            key=lambda p: (-1 if p.coefficient_index is None else p.coefficient_index, p.error_frame),
        )
        return replace(self, parameters=tuple(ordered))

    @property
    def has_arm(self) -> bool:
        """Whether the arm itself has unknown parameters, besides base and tool."""
        return bool(self.is_of_arm.any())

    @cached_property
    def is_of_arm(self) -> Array:
        """Which parameters are errors of the arm itself, not of base and tool, (p,)."""
        frames = (BASE_FRAME, self.chain.tool_frame_index)
        return np.array([p.error_frame not in frames for p in self.parameters], bool)

    @cached_property
    def only_frames(self) -> ErrorModel | None:
        """Model with the unknowns of base and tool alone; None without any."""
        frame_parameters = tuple(self.parameters[i] for i in np.flatnonzero(~self.is_of_arm))
        return replace(self, parameters=frame_parameters) if frame_parameters else None


def frame_name(chain: Chain, error_frame: int) -> str:
    """Name an error frame for people."""
    if error_frame == chain.tool_frame_index:
        return "tool"
    if error_frame == chain.tip_frame:
        return f"link {chain.tip}"
    number, is_link = divmod(error_frame, 2)
    if number == 0:
        return f"link {chain.root}"
    joint = chain.urdf.joint(chain.moving_joints[number - 1])
    if number <= chain.n_reversed:
        is_link = not is_link
    return f"link {joint.child}" if is_link else f"origin of {joint.name}"


def direction_name(twist: Sequence[float]) -> str:
    """Describe the direction of a translation or rotation."""
    v, w = np.array(twist[:3]), np.array(twist[3:])
    if not w.any():
        return f"along {_axis_name(v)}"
    # Point of the axis next to the origin of the frame.
    point = np.cross(w, v) / (w @ w)
    place = f" through {_vector_text(point)} m" if np.abs(point).max() > AXIS_POINT_TOL else ""
    return f"about {_axis_name(w)}{place}"


def _axis_name(vector: Array) -> str:
    """Return x, y or z with its sign, or the components of the unit vector."""
    vector = vector / np.linalg.norm(vector)
    largest = int(np.argmax(np.abs(vector)))
    if np.abs(vector[largest]) > 1 - AXIS_NAME_TOL:
        return f"{'-' if vector[largest] < 0 else ''}{'xyz'[largest]}"
    return _vector_text(vector)


def _vector_text(vector: Array) -> str:
    return f"({', '.join(format_fixed(component, 3) for component in vector.tolist())})"
