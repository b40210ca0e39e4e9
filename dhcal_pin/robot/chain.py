"""Serial kinematic chains: the path from one link of a robot to another, for many samples at once.

The chain has n independent joints, the columns of the joint positions q, and k moving joints (k > n only with
mimic joints). Its bodies are numbered 0 (the base link) to k (behind the last moving joint). The tool pose in
the measuring frame is

    T(q) = B · L_0 · Z(q_1) · L_1 · Z(q_2) · … · Z(q_k) · L_k · T_tool

with the base B, the constant link transforms L_j and the motion Z(q_j) about or along the z axis of joint j.

The path begins at the root of the URDF, or at another link if the robot looks at itself. It then passes some
joints from child to parent; see `urdf_path`.

Errors act at *error frames*, as right perturbations M ← M·exp(ξ) by a twist ξ = [v, ω]. Their indices are

    0 base · 1 link 0 · 2 joint 1 · 3 link 1 · 4 joint 2 · … · 2k joint k · 2k+1 link k · 2k+2 tip · 2k+3 tool

where `joint j` is the origin of that joint before its motion and `link j` is the frame after the motion.
For a joint that is passed from child to parent, `link j` is the origin of that joint in the URDF.
`base` is the pose of the base link in the measuring frame. `tool` is the pose of the measured point in the
tip frame. A perturbation of `base` or `tool` stays outside the robot; every other one changes a joint origin
of the URDF.

Pinocchio parses the URDF and provides the joint origins, the whole-body model and gravity torques. Frames and
Jacobians of many samples come from the kernels in `dhcal_pin._kernels`.

Shapes: m samples, n independent joints, k moving joints, p error parameters, t transmission terms.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from .. import _kernels, se3
from .._frozen import frozen
from .._kernels.kinematics import error_frame_poses
from .._kernels.types import FrameBatch, twists_before
from .._typing import Array
from ..exceptions import DhcalError, InvalidArgumentError, UnknownNameError
from ..messages import quote
from .conditions import Conditions, SampleState
from .dh import Convention, DHTable
from .error_families import FAMILIES, ErrorFamily
from .transmission import GravityLoads, Payload, Transmission, coefficient_indices, n_coefficients
from .urdf import Urdf, parse_urdf, read_urdf, suggest_names
from .urdf_path import (
    axis_frame,
    build_model,
    default_tip,
    find_moving_joints,
    independent_joints,
    joint_placements,
    link_on_path,
    placements,
)

if TYPE_CHECKING:
    from .dh_extraction import Extraction

# Index of the error frame of the base.
BASE_FRAME = 0

# Reference temperature of lengths [°C], ISO 1.
REFERENCE_TEMPERATURE = 20.0

_IDENTITY = np.eye(4)


def joint_frame(j: int) -> int:
    """Return the index of the error frame at the origin of a joint, before its motion."""
    return 2 * j


def link_frame(j: int) -> int:
    """Return the index of the error frame after the motion of a joint."""
    return 2 * j + 1


@frozen(eq=False)
class Chain:
    """Kinematic chain from the root link of a robot, or from another link, to a tip link.

    Attributes:
        urdf: URDF file of the robot.
        tip: Name of the tip link.
        joint_names: Names of the n independent joints, the columns of q, in chain order.
        moving_joints: Names of the k moving joints, in chain order.
        origins: Pose of each moving joint in the frame of the moving joint before it (fixed joints are
            merged), then the pose of the tip in the last one, shape (k+1, 4, 4) [m].
        axes: Unit axes in the joint frames, shape (k, 3).
        prismatic: True for prismatic joints, shape (k,).
        mimic_matrix: Matrix (k, n) of the moving joint positions `mimic_matrix @ q + mimic_offset`.
        mimic_offset: Constant part of the moving joint positions, shape (k,) [rad or m].
        lower: Lower joint limits, shape (n,) [rad or m]; -inf if there is none.
        upper: Upper joint limits, shape (n,) [rad or m]; inf if there is none.
        base: Pose of the base link in the measuring frame, shape (4, 4) [m].
        tool: Pose of the measured point in the tip frame, shape (4, 4) [m].
        parameters: Parameter sets that a calibration estimates by default.
        transmission: Transmission errors of the independent joints; None for ideal joints.
        payload: Point mass at the tip that loads compliant joints.
        reference_temperature: Temperature at which the links have their lengths [°C].
        first_link: Name of the link where the chain begins; empty for the root of the URDF.
        n_reversed: Number of joints at the beginning of the chain that are passed from child to parent.
        urdf_origins: Origins, shaped like `origins`, that describe the robot best without its transmission
            errors, and that its URDF has; None if they are `origins`.
    """

    urdf: Urdf
    tip: str
    joint_names: tuple[str, ...]
    moving_joints: tuple[str, ...]
    origins: Array
    axes: Array
    prismatic: Array
    mimic_matrix: Array
    mimic_offset: Array
    lower: Array
    upper: Array
    base: Array = field(default_factory=lambda: np.eye(4))
    tool: Array = field(default_factory=lambda: np.eye(4))
    parameters: str = "minimal,base,tool"
    transmission: Transmission | None = None
    payload: Payload | None = None
    reference_temperature: float = REFERENCE_TEMPERATURE
    first_link: str = ""
    n_reversed: int = 0
    urdf_origins: Array | None = None

    @classmethod
    def from_urdf(
        cls, source: str | os.PathLike[str] | Urdf, tip: str | None = None, root: str | None = None
    ) -> Chain:
        """Build the chain from the root link, or from another link, to a tip link of a URDF.

        A `DhcalError` names file and line if the URDF is invalid, the tip is unknown or ambiguous, or no
        joint moves.

        Args:
            source: Path of a URDF file, or a file that was already read.
            tip: Name of the tip link; by default the leaf behind the most moving joints.
            root: Name of the link where the chain begins; by default the root of the URDF.

        Returns:
            Chain with identity base and tool.

        Raises:
            InvalidArgumentError: The source is neither a path nor a `Urdf`, or a link is no text.
        """
        if not isinstance(source, (str, os.PathLike, Urdf)):
            raise InvalidArgumentError(f"source has type {type(source).__name__}; expected a path or a Urdf")
        for name, link in (("tip", tip), ("root", root)):
            if not isinstance(link, str | None):
                raise InvalidArgumentError(
                    f"{name} has type {type(link).__name__}; expected the name of a link"
                )
        urdf = source if isinstance(source, Urdf) else read_urdf(source)
        tip = tip if tip is not None else default_tip(urdf)
        first_link = urdf.root if root is None else root
        path = find_moving_joints(urdf, tip, first_link)
        joints, is_reversed = [joint for joint, _ in path], [is_up for _, is_up in path]
        names, mimic_matrix, mimic_offset = independent_joints(urdf, [joint.name for joint in joints])
        independent = [urdf.joint(name) for name in names]
        model = build_model(urdf)
        origins, axes = placements(model, first_link, tip, [joint.name for joint in joints], is_reversed)
        return cls(
            urdf=urdf,
            tip=tip,
            joint_names=tuple(names),
            moving_joints=tuple(joint.name for joint in joints),
            origins=origins,
            axes=axes,
            prismatic=np.array([joint.type == "prismatic" for joint in joints]),
            mimic_matrix=mimic_matrix,
            mimic_offset=mimic_offset,
            lower=np.array([joint.lower for joint in independent]),
            upper=np.array([joint.upper for joint in independent]),
            first_link="" if first_link == urdf.root else first_link,
            n_reversed=sum(is_reversed),
        )

    @classmethod
    def from_dh(cls, table: DHTable, name: str = "arm") -> Chain:
        """Build the chain of a DH table through its exact URDF.

        Args:
            table: DH table.
            name: Name of the robot in the URDF.

        Returns:
            Chain with the tip link `tool0`, whose default parameter set is that of the table: `dh` or
            `modified-dh`.

        Raises:
            InvalidArgumentError: The table is not a `DHTable`.
        """
        if not isinstance(table, DHTable):
            raise InvalidArgumentError(f"table has type {type(table).__name__}; expected a DHTable")
        from .dh_urdf import dh_to_urdf  # lazy import: only for DH tables

        text = dh_to_urdf(table, name)
        chain = cls.from_urdf(parse_urdf(text.encode(), f"{name}.urdf"), "tool0")
        return replace(chain, parameters="dh" if table.convention == "standard" else "modified-dh")

    def __repr__(self) -> str:
        return f"Chain(name={self.urdf.name!r}, tip={self.tip!r}, n_joints={self.n_joints})"

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields only: cached models are slow to pickle and quick to rebuild."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    @property
    def root(self) -> str:
        """Name of the link where the chain begins."""
        return self.first_link or self.urdf.root

    @property
    def is_reversed(self) -> list[bool]:
        """Whether each moving joint is passed from child to parent, (k,)."""
        return [j < self.n_reversed for j in range(len(self.moving_joints))]

    def with_added_origins(self, additions: Mapping[str, Array]) -> Chain:
        """Return the complete model of a chain as its URDF describes it.

        Args:
            additions: Pose (4, 4) by the name of a link that is added to the origin of the joint before the
                link, in the frame of that origin [m].

        Returns:
            Copy with these origins, whose `urdf_origins` are those of this chain.
        """
        model, tip = build_model(self.urdf), self.urdf.path(self.tip)
        end = model.frames[model.getFrameId(self.tip, pin.FrameType.BODY)]
        for joint in self.urdf.joints:
            if joint.child not in additions:
                continue
            added = pin.SE3(additions[joint.child])
            if joint.type != "fixed":
                model.jointPlacements[model.getJointId(joint.name)] *= added
            elif joint in tip:
                origin = model.frames[model.getFrameId(joint.child, pin.FrameType.BODY)].placement
                end.placement = origin * added * origin.inverse() * end.placement
        origins, _ = placements(model, self.root, self.tip, self.moving_joints, self.is_reversed)
        return replace(self, origins=origins, urdf_origins=self.origins)

    def nominal(self) -> Chain:
        """Return the chain between the same links as the URDF describes it, with identity base and tool."""
        return Chain.from_urdf(self.urdf, self.tip, self.root)

    @property
    def urdf_alone(self) -> Chain:
        """The chain that the URDF describes without its sidecar, with the base and the tool of this chain."""
        origins = self.origins if self.urdf_origins is None else self.urdf_origins
        return replace(self, origins=origins, transmission=None, urdf_origins=None)

    def origin_frame(self, j: int) -> int:
        """Return the index of the error frame at the URDF origin of the moving joint j, 1 to k.

        It is the frame before the motion of the joint, or after it, if the joint is passed from child to
        parent.
        """
        return link_frame(j) if j <= self.n_reversed else joint_frame(j)

    @property
    def n_joints(self) -> int:
        """Number n of independent joints, the columns of q."""
        return len(self.joint_names)

    @property
    def link_names(self) -> list[str]:
        """Names of the k+1 links between the moving joints, from the first link to that of the tip."""
        behind = [
            self.urdf.joint(name).parent if is_reversed else self.urdf.joint(name).child
            for name, is_reversed in zip(self.moving_joints, self.is_reversed, strict=True)
        ]
        return [self.root, *behind]

    @property
    def is_prismatic(self) -> Array:
        """Whether each independent joint moves a prismatic joint, shape (n,)."""
        return np.any(self.mimic_matrix[self.prismatic] != 0, 0)

    @property
    def tip_frame(self) -> int:
        """Index of the error frame of the tip, before the tool."""
        return 2 * len(self.moving_joints) + 2

    @property
    def tool_frame_index(self) -> int:
        """Index of the error frame of the tool, the measured point."""
        return 2 * len(self.moving_joints) + 3

    @cached_property
    def model(self) -> pin.Model:
        """Pinocchio model of the whole robot with the joint origins, tip frame and payload of this chain."""
        model = build_model(self.urdf)
        for name, placement in zip(self.moving_joints, self.joint_placements, strict=True):
            model.jointPlacements[model.getJointId(name)] = pin.SE3(placement)
        tip = model.frames[model.getFrameId(self.tip, pin.FrameType.BODY)]
        if self.n_reversed < len(self.moving_joints):
            tip.placement = pin.SE3(self.origins[-1])
        if self.payload:
            inertia = pin.Inertia(self.payload.mass, np.array(self.payload.centre), np.zeros((3, 3)))
            model.appendBodyToJoint(tip.parentJoint, inertia, tip.placement)
        return model

    @property
    def joint_placements(self) -> list[Array]:
        """Pose (4, 4) of each moving joint in the moving joint before it, towards the root of the URDF."""
        return joint_placements(
            build_model(self.urdf), self.tip, self.moving_joints, self.is_reversed, self.origins
        )

    @cached_property
    def frame_id(self) -> int:
        """Pinocchio's index of the tip frame; it is of type BODY because a joint may have the same name."""
        return self.model.getFrameId(self.tip, pin.FrameType.BODY)

    @property
    def _link_axes(self) -> Array:
        """Rotation of each link in the axes of its growth, (k+1, 3, 3)."""
        return np.concatenate([self.link_transforms[:-1, :3, :3], _IDENTITY[None, :3, :3]])

    @property
    def link_vectors(self) -> Array:
        """Vector of each link along which it grows, (k+1, 3) [m]."""
        return (self.link_transforms[:, None, :3, 3] @ self._link_axes)[:, 0]

    @cached_property
    def loads(self) -> GravityLoads:
        """Gravity torques of the whole robot with the joint origins of this chain."""
        return GravityLoads(
            self.model,
            self.moving_joints,
            self.mimic_matrix,
            self.mimic_offset,
            self.link_vectors,
            self.reference_temperature,
            self.tip,
            self.payload,
        )

    @property
    def error_families(self) -> list[ErrorFamily]:
        """Families of joint errors with a coefficient that is not zero."""
        if self.transmission is None:
            return []
        values = self.transmission.coefficients
        indices = coefficient_indices(*self.mimic_matrix.shape)
        return [
            family
            for family in FAMILIES.values()
            if values[[c.entry for c in family.coefficients(self, indices)]].any()
        ]

    def configurations(self, q: ArrayLike) -> Array:
        """Return Pinocchio configurations (m, nq) at the actual joint positions.

        Joints that are not on the chain stay at neutral.
        """
        return self.loads.configurations(self.actual_positions(Conditions(self.validated_q(q)))[0])

    def validated_q(self, q: ArrayLike) -> Array:
        """Return joint positions as floats (m, n); another shape or a value not finite is an error."""
        q = np.asarray(q, float)
        n = self.n_joints
        if q.ndim != 2 or q.shape[1] != n:
            raise InvalidArgumentError(
                f"q has shape {q.shape}; expected shape (m, {n}), one row per sample with the {n} columns "
                f"{', '.join(self.joint_names)}"
            )
        if not np.isfinite(q).all():
            raise InvalidArgumentError("q has a value that is not finite; expected finite joint positions")
        return q

    def conditions(self, q: ArrayLike | Conditions) -> Conditions:
        """Return the conditions of m samples from joint positions, which are checked, or conditions."""
        if isinstance(q, Conditions):
            positions = self.validated_q(q.q)
            return q if positions is q.q else replace(q, q=positions)
        return Conditions(self.validated_q(q))

    def actual_positions(self, conditions: Conditions) -> tuple[Array, Array | None]:
        """Compute the actual joint positions, which differ from the commanded ones by transmission errors.

        They have shape (n, m). Transmission terms follow, shape (t, n, m), or None for ideal joints.
        """
        if self.transmission is None or self.transmission.is_zero:
            return np.ascontiguousarray(conditions.q.T), None
        terms = self.transmission.terms(conditions)
        return terms[0] + self.transmission.errors(terms), terms

    def with_transmission(self, transmission: Transmission) -> Chain:
        """Return a copy with other transmission errors of the independent joints; they must fit the chain."""
        shape = (n_coefficients(len(self.moving_joints), self.n_joints),)
        if not isinstance(transmission, Transmission):
            raise InvalidArgumentError(
                f"transmission has type {type(transmission).__name__}; expected a Transmission"
            )
        if transmission.coefficients.shape != shape:
            raise InvalidArgumentError(
                f"transmission coefficients have shape {transmission.coefficients.shape}; expected {shape}"
            )
        return replace(self, transmission=transmission)

    def with_payload(self, payload: Payload | None) -> Chain:
        """Return a copy with another payload, whose weight loads compliant joints, or None."""
        if not (payload is None or isinstance(payload, Payload)):
            raise InvalidArgumentError(
                f"payload has type {type(payload).__name__}; expected a Payload or None"
            )
        return replace(self, payload=payload).with_current_loads()

    def with_current_loads(self) -> Chain:
        """Return a copy whose transmission uses the gravity loads of its URDF and payload."""
        if self.transmission is None:
            return self
        return self.with_transmission(replace(self.transmission, loads=self.urdf_alone.loads))

    @cached_property
    def axis_frames(self) -> Array:
        """Body frame of each body in its URDF frame, shape (k+1, 4, 4); its z axis is the joint axis."""
        return np.stack([np.eye(4), *(axis_frame(tuple(axis)) for axis in self.axes.tolist())])

    @cached_property
    def body_from_urdf(self) -> Array:
        """URDF frame of each body in its body frame, shape (k+1, 4, 4)."""
        return se3.inverse(self.axis_frames)

    @cached_property
    def next_from_body(self) -> Array:
        """URDF frame of each joint, then the tip, in the body frame before it, shape (k+1, 4, 4)."""
        return self.body_from_urdf @ self.origins

    @cached_property
    def _urdf_from_body(self) -> Array:
        """Body frame of each joint in its URDF frame, and the identity for the tip, shape (k+1, 4, 4)."""
        return np.concatenate([self.axis_frames[1:], _IDENTITY[None]])

    @cached_property
    def link_transforms(self) -> Array:
        """Constant transforms L_0 … L_k between the joint motions, shape (k+1, 4, 4)."""
        return self.next_from_body @ self._urdf_from_body

    @cached_property
    def _link_and_tool_transforms(self) -> Array:
        """Link transforms with the tool appended to the last one, shape (k+1, 4, 4)."""
        return np.concatenate([self.link_transforms[:-1], self.link_transforms[-1:] @ self.tool])

    def joint_state(self, q: ArrayLike | Conditions) -> SampleState:
        """Compute positions, cosines and sines of the moving joints from joint positions or conditions.

        `forward_kinematics` accepts this state in the place of q. Errors of the geometry do not change it, so
        one state serves a whole optimization.
        """
        conditions = self.conditions(q)
        return self._joint_state(np.ascontiguousarray(conditions.q.T), conditions)

    def _joint_state(self, independent: Array, conditions: Conditions) -> SampleState:
        """Compute the joint state of actual positions of the independent joints, shape (n, m)."""
        if conditions.zeros is not None:
            independent = independent + conditions.zeros.T
        positions = self.mimic_matrix @ independent + self.mimic_offset[:, None]
        return SampleState(positions, *_kernels.cos_sin(positions), conditions)

    def forward_kinematics(
        self, q: ArrayLike | Conditions | SampleState, out: Array | None = None
    ) -> FrameBatch:
        """Compute all frames of the chain, vectorized over the samples.

        Args:
            q: Joint positions, shape (m, n) [rad or m], conditions, or a joint state of this chain.
            out: Work array of shape (k+2, 7, 3, m) that holds the result.

        Returns:
            Frames in the measuring frame.
        """
        state, terms = q if isinstance(q, SampleState) else self.joint_state(q), None
        if self.transmission is not None:
            actual, terms = self.actual_positions(state.conditions)
            state = self._joint_state(actual, state.conditions)
        k, m = state.positions.shape
        frames = np.empty((k + 2, 7, 3, m)) if out is None else out
        base_motion, tool_motion = state.conditions.base_motion, state.conditions.tool_motion
        if base_motion is None:
            frames[0, :4] = self.base[:3].T[:, :, None]
        else:
            frames[0, :4] = (base_motion @ self.base)[:, :3].transpose(2, 1, 0)
        _kernels.propagate_frames(self._link_and_tool_transforms[None], self.prismatic, state, frames)
        if tool_motion is not None:
            tool = np.einsum("acm,maj->jcm", frames[-1, :3], tool_motion[:, :3])
            tool[3] += frames[-1, 3]
            frames[-1, :4] = tool
        batch = FrameBatch(frames[:-1], frames[-1, :4], terms, state.conditions)
        growth = self._growth(terms, state.conditions)
        if growth is not None:
            shifts = np.cumsum(self.growth_motions(batch)[:, :3] * growth[:, None], 0)
            frames[1:-2, 3] += shifts[:-2]
            frames[-2:, 3] += shifts[-1]
        return batch

    def _growth(self, terms: Array | None, conditions: Conditions) -> Array | None:
        """Compute the relative growth of each link, shape (k+1, m); None if no link grows."""
        growth = None if conditions.growth is None else conditions.growth.T
        if terms is not None and self.transmission is not None and self.transmission.link_terms.any():
            of_temperature = self.transmission.growth(terms)
            return of_temperature if growth is None else growth + of_temperature
        return growth

    @property
    def growth_vectors(self) -> Array:
        """Motion of each link's end per relative growth, in the axes of its body, shape (k+1, 3) [m]."""
        own = self.link_vectors if self.transmission is None else self.transmission.loads.link_vectors
        return (self._link_axes @ own[..., None])[..., 0]

    def growth_motions(self, frames: FrameBatch) -> Array:
        """Compute the tool twist per relative growth of each link, shape (k+1, 6, m).

        The twists [v, ω] are those of the tool point in axes of the measuring frame. Growth moves all that is
        behind a link along the link; it turns nothing. A link grows in front of the next joint, the last one
        behind the motion of the last joint, in front of all errors of its own.
        """
        linear = np.einsum("ja,jacm->jcm", self.growth_vectors, frames.columns[:, :3])
        return np.concatenate([linear, np.zeros_like(linear)], 1)

    def _require_link(self, link: str) -> None:
        """Raise an error if the robot has no such link."""
        if link not in self.urdf.links:
            raise UnknownNameError(
                f"{self.urdf.source}: unknown link {quote(link)}; {suggest_names(link, self.urdf.links)}"
            )

    def pose_in_tip(self, link: str) -> Array:
        """Return the constant pose of another link in the tip link, shape (4, 4) [m].

        An unknown link is an `UnknownNameError`, one that a joint moves against the tip an
        `InvalidArgumentError`.
        """
        self._require_link(link)
        pose = self.fixed_pose(self.tip, link)
        if pose is None:
            raise InvalidArgumentError(
                f"{self.urdf.source}: a joint moves {quote(link)} against the tip {quote(self.tip)}; "
                "expected a link that is fixed to the tip"
            )
        return pose

    def fixed_pose(self, link: str, other: str) -> Array | None:
        """Return the constant pose of a link in another one.

        Links behind the tip move with it if its origin was changed, so the poses are those of the URDF.

        Args:
            link: Name of the link in which the pose counts.
            other: Name of the link whose pose is wanted.

        Returns:
            Pose, shape (4, 4) [m]; None if a joint moves one against the other.
        """
        model = build_model(self.urdf)
        own, wanted = (model.frames[model.getFrameId(name, pin.FrameType.BODY)] for name in (link, other))
        if own.parentJoint != wanted.parentJoint:
            return None
        return (own.placement.inverse() * wanted.placement).homogeneous

    def link_in_body(self, link: str) -> tuple[int, Array]:
        """Find the body of the chain, 1 to k, that carries a link, and the pose of the link in its frame.

        Sensors may be on such a link. An unknown link is an `UnknownNameError`. One that no joint of the
        chain moves, or that a joint off the chain moves, is an `InvalidArgumentError`.
        """
        self._require_link(link)
        found = link_on_path(self.urdf, self.root, self.moving_joints, self.n_reversed, link)
        if not found or not found[0]:
            raise InvalidArgumentError(
                f"{self.urdf.source}: link {quote(link)} is not on the chain to {quote(self.tip)}; "
                "expected a link behind its first joint"
            )
        return found[0], self.body_from_urdf[found[0]] @ found[1]

    def poses(self, q: ArrayLike | Conditions) -> Array:
        """Compute tool poses.

        Args:
            q: Joint positions, shape (m, n) [rad or m], or conditions with joint positions.

        Returns:
            Poses of the tool in the measuring frame, shape (m, 4, 4) [m].
        """
        return self.forward_kinematics(q).poses()

    def tool_jacobian(
        self,
        frames: FrameBatch,
        bodies: Array,
        twists: Array,
        out: Array | None = None,
        body: int | None = None,
    ) -> Array:
        """Compute the tool twist per unit of each body twist or transmission coefficient.

        Args:
            frames: Frames of this chain at m samples.
            bodies: Body numbers in ascending order, shape (p,). The number k+1+e stands for entry e of the
                transmission coefficients.
            twists: Twists [v, ω] in the frames of the bodies, shape (p, 6); not used for coefficients.
            out: Array of shape (p, 6, m) that holds the result.
            body: Observed body, see `ObservationMatrix`; the tool if None.

        Returns:
            Twists [v, ω] of the tool point in axes of the measuring frame, shape (p, 6, m).
        """
        m = frames.tool.shape[-1]
        out = np.empty((len(bodies), 6, m)) if out is None else out
        n_bodies, n_geometric = len(frames.columns), len(bodies)
        if n_geometric and bodies[-1] >= n_bodies:
            n_geometric = int(np.searchsorted(bodies, n_bodies))
            self._fill_transmission_jacobian(frames, bodies[n_geometric:] - n_bodies, out[n_geometric:], body)
            bodies, twists = bodies[:n_geometric], twists[:n_geometric]
        twists = twists_before(body, bodies, twists)
        _kernels.point_jacobian(frames.columns, frames.tool[3], bodies, twists, out[:n_geometric])
        return out

    def _fill_transmission_jacobian(
        self, frames: FrameBatch, entries: Array, out: Array, body: int | None
    ) -> None:
        """Compute the tool twist per unit of transmission coefficients (e,) into an array (e, 6, m)."""
        # All coefficients of a joint share the twist of its motion, which each one scales by its own term.
        numbers, terms = self.transmission_terms(frames, entries)
        motions = self.motions(frames, numbers, body)
        for number, term, column in zip(numbers, terms, out, strict=True):
            np.multiply(motions[number], term, out=column)

    def motions(self, frames: FrameBatch, numbers: Sequence[int], body: int | None = None) -> Array:
        """Compute the tool twists of the motions that transmission coefficients scale.

        Args:
            frames: Frames of this chain at m samples.
            numbers: Numbers of the motions that are used, as `transmission_terms` returns them.
            body: Observed body, see `ObservationMatrix`; the tool if None.

        Returns:
            Twists [v, ω] by number of the motion, shape (n, 6, m), or (n+k+1, 6, m) if a link grows.
        """
        by_joint = self.joint_jacobian(frames, body)
        if max(numbers, default=0) < self.n_joints:
            return by_joint
        growth = self.growth_motions(frames)
        if body is not None and body < len(self.moving_joints):
            growth[body:] = 0.0
        return np.concatenate([by_joint, growth])

    def transmission_terms(self, frames: FrameBatch, entries: Array) -> tuple[list[int], list[Array]]:
        """Return what transmission coefficients scale.

        Args:
            frames: Frames of this chain at m samples.
            entries: Entries of the transmission coefficients, shape (e,).

        Returns:
            The number of the motion that each coefficient scales, see `motions`, and its factor, (m,) each.
        """
        # Coefficients that are all 0 are not stored.
        own = self.transmission or Transmission.zero(self.loads)
        terms, transmission = frames.terms, own.evaluating(entries)
        if terms is None or transmission is not own:
            terms = transmission.terms(frames.conditions)
        joints, numbers, sources = (indices.tolist() for indices in transmission.locate(entries))
        return joints, [terms[term, source] for term, source in zip(numbers, sources, strict=True)]

    def joint_jacobian(self, frames: FrameBatch, body: int | None = None) -> Array:
        """Compute the geometric Jacobian with respect to the actual positions of the independent joints.

        Args:
            frames: Frames of this chain at m samples.
            body: Observed body, see `ObservationMatrix`; the tool if None.

        Returns:
            Twists [v, ω] of the tool point in axes of the measuring frame, shape (n, 6, m).
        """
        k = len(self.moving_joints)
        twists = np.zeros((k, 6))
        twists[np.arange(k), np.where(self.prismatic, 2, 5)] = 1.0
        # The motion of joint j is a twist of body j, and moves its frame.
        twists = twists_before(body, np.arange(k), twists)
        jacobian = self.tool_jacobian(frames, np.arange(1, k + 1), twists)
        return np.tensordot(self.mimic_matrix, jacobian, (0, 0))

    def perturbed_at(self, motions: Mapping[int, Array]) -> Chain:
        """Return a copy with perturbations M ← M·motion of some error frames, given by index, (4, 4) each."""
        every = np.tile(np.eye(4), (self.tool_frame_index + 1, 1, 1))
        for frame, motion in motions.items():
            if not 0 <= frame <= self.tool_frame_index:
                raise InvalidArgumentError(
                    f"error frame {frame} does not exist; expected an index from 0 to {self.tool_frame_index}"
                )
            if np.shape(motion) != (4, 4):
                raise InvalidArgumentError(
                    f"the motion of error frame {frame} has shape {np.shape(motion)}; expected (4, 4)"
                )
            every[frame] = motion
        return self.perturbed(every)

    def perturbed(self, motions: Array) -> Chain:
        """Return a copy with perturbations M ← M·motion of all error frames, shape (2k+4, 4, 4)."""
        if motions.shape != (self.tool_frame_index + 1, 4, 4):
            raise InvalidArgumentError(
                f"motions have shape {motions.shape}; expected ({self.tool_frame_index + 1}, 4, 4)"
            )
        return self._with(
            origins=motions[1:-1:2] @ self.origins @ motions[2::2],
            base=self.base @ motions[0],
            tool=self.tool @ motions[-1],
        )

    def with_zeros_moved(self, summands: ArrayLike) -> Chain:
        """Return the robot that has the same poses at joint positions which are larger by constants.

        With gains and thermal growth together, the poses differ by the product of these errors and the
        constants.

        Args:
            summands: Constant of each joint, shape (n,) [rad or m].

        Returns:
            Copy of the chain with other joint origins.
        """
        d = np.asarray(summands, float)
        linear = np.zeros_like(d) if self.transmission is None else self.transmission.linear @ d
        moved = replace(self._with_joints_turned(-d - linear), urdf_origins=self.urdf_origins)
        if self.urdf_origins is not None:
            moved = replace(moved, urdf_origins=self.urdf_alone._with_joints_turned(-d).origins)
        if self.transmission is None:
            return moved
        return moved.with_transmission(self.transmission.with_zeros_moved(d)).with_current_loads()

    def _with_joints_turned(self, constants: Array) -> Chain:
        """Return a copy whose joint origins are moved along the joints by constants, (n,) [rad or m]."""
        moving = (self.mimic_matrix @ constants)[:, None] * self.axes
        twists = np.concatenate([moving, moving], 1) * np.repeat([self.prismatic, ~self.prismatic], 3, 0).T
        return self.perturbed_at(
            {self.origin_frame(j + 1): se3.exp6(twist) for j, twist in enumerate(twists)}
        )

    def with_base_and_tool(self, base: Array, tool: Array) -> Chain:
        """Return a copy with another base and tool.

        Args:
            base: Pose of the base link in the measuring frame, shape (4, 4).
            tool: Pose of the measured point in the tip frame, shape (4, 4).

        Returns:
            Copy of the chain.

        Raises:
            InvalidArgumentError: A pose does not have shape (4, 4).
        """
        if not np.shape(base) == np.shape(tool) == (4, 4):
            raise InvalidArgumentError(
                f"base and tool have the shapes {np.shape(base)} and {np.shape(tool)}; expected (4, 4)"
            )
        return self._with(base=base, tool=tool)

    def _with(self, **frames: Array) -> Chain:
        """Return a copy with other origins, base or tool that keeps the cached frames of the joint axes."""
        chain = object.__new__(Chain)
        cached = {
            "axis_frames": self.axis_frames,
            "body_from_urdf": self.body_from_urdf,
            "_urdf_from_body": self._urdf_from_body,
        }
        vars(chain).update(self.__getstate__(), **cached, **frames)
        if "origins" in frames:
            vars(chain)["urdf_origins"] = None
        return chain


def bodies_of_frames(chain: Chain, error_frames: ArrayLike) -> Array:
    """Return the bodies that perturbations of error frames move."""
    return np.clip((np.asarray(error_frames, int) - 1) // 2, 0, len(chain.moving_joints))


def twists_in_bodies(
    chain: Chain, error_frames: Array, twists: ArrayLike, frame_transforms: Array | None = None
) -> tuple[Array, Array]:
    """Transform twists at error frames, or relative frames (p, 4, 4), to bodies (p,) and twists there."""
    unperturbed = np.tile(np.eye(4), (chain.tool_frame_index + 1, 1, 1))
    frames = error_frame_poses(chain.body_from_urdf, chain.origins, chain.tool, unperturbed)[error_frames]
    frames = frames if frame_transforms is None else frames @ frame_transforms
    return bodies_of_frames(chain, error_frames), (
        se3.adjoint(frames) @ np.asarray(twists, float)[..., None]
    )[..., 0]


def without_mimics(chain: Chain) -> Chain:
    """Return a copy in which every moving joint is independent."""
    k = len(chain.moving_joints)
    unlimited = np.full(k, np.inf)
    return replace(
        chain,
        joint_names=chain.moving_joints,
        mimic_matrix=np.eye(k),
        mimic_offset=np.zeros(k),
        lower=-unlimited,
        upper=unlimited,
    )


def extract_dh_table(chain: Chain, convention: Convention = "standard", hayati: bool = False) -> Extraction:
    """Extract the DH table of a chain by common normals; base and tool are kept apart.

    Args:
        chain: Kinematic chain without mimic joints.
        convention: "standard" or "modified".
        hayati: Whether to use Hayati's β for axes up to 5° from parallel instead of 1°.

    Returns:
        Table and the frames of its x axes.

    Raises:
        DhcalError: A joint mimics another one.
    """
    if not (np.array_equal(chain.mimic_matrix, np.eye(chain.n_joints)) and not chain.mimic_offset.any()):
        mimic = next(name for name in chain.moving_joints if name not in chain.joint_names)
        raise DhcalError(
            f"{chain.urdf.source}: joint {mimic!r} mimics another joint; a DH table cannot describe mimic "
            "joints, so calibrate the URDF itself"
        )
    from .dh_extraction import extract_dh  # lazy import: only for DH tables

    extraction = extract_dh(
        chain.link_transforms,
        chain.joint_names,
        chain.prismatic,
        chain.lower,
        chain.upper,
        convention,
        hayati,
    )
    continuous = np.array([chain.urdf.joint(name).type == "continuous" for name in chain.joint_names])
    return replace(extraction, table=replace(extraction.table, continuous=continuous))
