"""A serial path through a robot: Pinocchio's model, a tip, and kinematics over many samples at once.

The path's bodies are numbered 0 (the base link) to k (behind the last moving joint); its *stations*,
where errors act as right perturbations M ← M·exp(ξ), lie between them in this order:

    0 base · 1 link 0 · 2 joint 1 · 3 link 1 · 4 joint 2 · … · 2k joint k · 2k+1 link k · 2k+2 tip · 2k+3 tool

`joint j` is that joint's origin before its motion, `link j` the same frame after it. `base` is the
base link's pose in the measuring frame, `tool` the measured point's pose in the tip frame. A change at
`base` or `tool` stays outside the robot; every other one belongs into the URDF.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from .. import _kernels, se3
from .._kernels.kinematics import error_frame_poses
from .._kernels.types import FrameBatch, JointState
from .._typing import Array
from ..exceptions import DhcalError
from .dh import Convention, DHTable
from .dh_extraction import Extraction, extract_dh
from .dh_urdf import dh_to_urdf
from .transmission import GravityLoads, Payload, Transmission
from .urdf import Urdf, parse_urdf, read_urdf
from .urdf_path import (
    axis_frame,
    build_model,
    default_tip,
    find_moving_joints,
    independent_joints,
    placements,
)

BASE_FRAME = 0


_EYE = np.eye(4)


def joint_frame(j: int) -> int:
    """Station of the j-th moving joint's origin, j from 1."""
    return 2 * j


def link_frame(j: int) -> int:
    """Station behind the j-th moving joint's motion; 0 is the base link."""
    return 2 * j + 1


@dataclass(frozen=True, eq=False)
class Chain:
    """A base-to-tip path of n independent and k moving joints (k > n only with mimic joints).

    Attributes:
        urdf: the file it came from.
        tip: name of the tip link.
        joint_names: (n,) the columns of q, in path order.
        moving_joints: (k,) names of the joints that move along the path.
        origins: (k+1, 4, 4) each moving joint's frame in the moving frame before it (fixed joints
            merged), then the tip in the last one; metres.
        axes: (k, 3) unit axes in the joints' frames.
        prismatic: (k,) True where a joint slides.
        mimic_matrix, mimic_offset: (k, n), (k,): the moving joints' values are mixing @ q + shift.
        lower, upper: (n,) limits, rad or m; infinite where there is none.
        base: (4, 4) base link in the measuring frame.
        tool: (4, 4) measured point in the tip frame.
        parameters: the sets that are identified when nobody says otherwise.
        transmission: how the independent joints miss their values; None where they do as they are told.
        payload: what the tip carries, for joints that yield to loads.
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

    @classmethod
    def from_urdf(cls, source: str | os.PathLike[str] | Urdf, tip: str | None = None) -> Chain:
        """The path from the root link to `tip` of a URDF file.

        Args:
            source: a path, or a file already read.
            tip: a link; without it the deepest leaf.

        Raises:
            DhcalError: the file is not a sound URDF, the tip is unknown or ambiguous, nothing moves.
        """
        urdf = source if isinstance(source, Urdf) else read_urdf(source)
        tip = tip if tip is not None else default_tip(urdf)
        joints = find_moving_joints(urdf, tip)
        names, rows, shift = independent_joints(urdf, [joint.name for joint in joints])
        sources = [urdf.joint(name) for name in names]
        model = build_model(urdf)
        origins, axes = placements(model, tip, [joint.name for joint in joints])
        return cls(
            urdf=urdf,
            tip=tip,
            joint_names=tuple(names),
            moving_joints=tuple(joint.name for joint in joints),
            origins=origins,
            axes=axes,
            prismatic=np.array([joint.type == "prismatic" for joint in joints]),
            mimic_matrix=rows,
            mimic_offset=shift,
            lower=np.array([joint.lower for joint in sources]),
            upper=np.array([joint.upper for joint in sources]),
        )

    @classmethod
    def from_dh(cls, table: DHTable, name: str = "arm") -> Chain:
        """The arm of a DH table, through its exact URDF; its tip is `tool0`."""
        text = dh_to_urdf(table, name)
        chain = cls.from_urdf(parse_urdf(text.encode(), f"{name}.urdf"), "tool0")
        return replace(chain, parameters="dh")

    def __getstate__(self) -> dict[str, Any]:
        """Without what can be worked out anew: a model is heavy to send to another process."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    @property
    def n_joints(self) -> int:
        """Number n of independent joints, the columns of q."""
        return len(self.joint_names)

    @property
    def is_prismatic(self) -> Array:
        """Which independent joints (n,) move a prismatic one."""
        return np.any(self.mimic_matrix[self.prismatic] != 0, 0)

    @property
    def tip_frame(self) -> int:
        """Station of the tip, before the tool."""
        return 2 * len(self.moving_joints) + 2

    @property
    def tool_frame_index(self) -> int:
        """Station of the measured point."""
        return 2 * len(self.moving_joints) + 3

    @cached_property
    def model(self) -> pin.Model:
        """Pinocchio's model of the whole robot with this chain's joint placements and tip frame."""
        model = build_model(self.urdf)
        for name, origin in zip(self.moving_joints, self.origins[:-1], strict=True):
            model.jointPlacements[model.getJointId(name)] = pin.SE3(origin)
        tip = model.frames[model.getFrameId(self.tip, pin.FrameType.BODY)]
        tip.placement = pin.SE3(self.origins[-1])
        if self.payload:
            carried = pin.Inertia(self.payload.mass, np.array(self.payload.centre), np.zeros((3, 3)))
            model.appendBodyToJoint(tip.parentJoint, carried, tip.placement)
        return model

    @cached_property
    def frame_id(self) -> int:
        """Pinocchio's index of the tip's frame; links and joints may share names."""
        return self.model.getFrameId(self.tip, pin.FrameType.BODY)

    @cached_property
    def loads(self) -> GravityLoads:
        """The masses of the whole robot with this chain's joint placements."""
        return GravityLoads(self.model, self.moving_joints, self.mimic_matrix, self.mimic_offset)

    def configurations(self, q: Array) -> Array:
        """Pinocchio's configurations (m, nq) at q (m, n); joints off the path stay at neutral."""
        return self.loads.configurations(self.actual_positions(self.validated_q(q).T)[0])

    def validated_q(self, q: Array) -> Array:
        """Joint values as a finite (m, n) array, or DhcalError."""
        q = np.atleast_2d(np.asarray(q, float))
        if q.ndim != 2 or q.shape[1] != self.n_joints:
            raise DhcalError(
                f"q has shape {q.shape}; this chain needs {self.n_joints} columns: {', '.join(self.joint_names)}"
            )
        if not np.isfinite(q).all():
            raise DhcalError("q: every joint value must be finite")
        return q

    def actual_positions(self, q: Array) -> tuple[Array, Array | None]:
        """Where commanded values q (n, m) take the independent joints (n, m), and the terms (t, n, m)."""
        if self.transmission is None:
            return q, None
        terms = self.transmission.terms(q)
        return q + self.transmission.errors(terms), terms

    def with_transmission(self, transmission: Transmission) -> Chain:
        """The chain with other joints."""
        return replace(self, transmission=transmission)

    def with_payload(self, payload: Payload | None) -> Chain:
        """The chain with something in its hand, to whose weight its joints yield too."""
        return replace(self, payload=payload).with_current_loads()

    def with_current_loads(self) -> Chain:
        """The chain whose joints yield to its own masses as placed now, not to those it was started with."""
        if self.transmission is None:
            return self
        return self.with_transmission(replace(self.transmission, loads=self.loads))

    @cached_property
    def axis_frames(self) -> Array:
        """(k+1, 4, 4): body frame (joint axis along z) in each body's URDF frame; body 0 as it is."""
        return np.stack([np.eye(4), *(axis_frame(tuple(axis)) for axis in self.axes.tolist())])

    @cached_property
    def body_from_urdf(self) -> Array:
        """(k+1, 4, 4): each body's URDF frame in its body frame."""
        return se3.inverse(self.axis_frames)

    @cached_property
    def next_from_body(self) -> Array:
        """(k+1, 4, 4): each joint's URDF frame, and the tip, in the body frame before it."""
        return self.body_from_urdf @ self.origins

    @cached_property
    def _urdf_from_body(self) -> Array:
        """(k+1, 4, 4): each joint's body frame in its URDF frame, and no change for the tip."""
        return np.concatenate([self.axis_frames[1:], _EYE[None]])

    @cached_property
    def link_transforms(self) -> Array:
        """Constant transforms (k+1, 4, 4) between the motions; every joint moves about its own z.

        The tool's pose is base · links[0] · Z(q_1) · links[1] · … · Z(q_k) · links[k] · tool.
        """
        return self.next_from_body @ self._urdf_from_body

    @cached_property
    def _link_and_tool_transforms(self) -> Array:
        """(k+1, 4, 4): as `links`, but the last one leads on to the tool."""
        return np.concatenate([self.link_transforms[:-1], self.link_transforms[-1:] @ self.tool])

    def joint_state(self, q: Array) -> JointState:
        """The moving joints' values, and their cosines and sines, at joint values q (m, n)."""
        return self._joint_state(np.ascontiguousarray(self.validated_q(q).T))

    def _joint_state(self, joints: Array) -> JointState:
        """The motion of independent joints that stand at (n, m)."""
        values = self.mimic_matrix @ joints + self.mimic_offset[:, None]
        return JointState(joints, values, *_kernels.cos_sin(values))

    def forward_kinematics(self, q: Array | JointState, out: Array | None = None) -> FrameBatch:
        """All frames at joint values q (m, n), or at a motion of this chain, vectorised over the samples.

        `out` (k+2, 7, 3, m) holds them when given.
        """
        motion, terms = q if isinstance(q, JointState) else self.joint_state(q), None
        if self.transmission is not None:
            joints, terms = self.actual_positions(motion.independent)
            motion = self._joint_state(joints)
        k, m = motion.positions.shape
        frames = np.empty((k + 2, 7, 3, m)) if out is None else out
        frames[0, :4] = self.base[:3].T[:, :, None]
        _kernels.propagate_frames(self._link_and_tool_transforms, self.prismatic, motion, frames)
        return FrameBatch(frames[:-1], frames[-1, :4], terms)

    def poses(self, q: Array) -> Array:
        """Tool poses (m, 4, 4) in the measuring frame at joint values q (m, n) in rad or m."""
        return self.forward_kinematics(q).poses()

    def tool_jacobian(
        self, frames: FrameBatch, bodies: Array, twists: Array, out: Array | None = None
    ) -> Array:
        """The tool point's velocity (p, 6, m) per unit of each body twist, axes of the measuring frame.

        Args:
            sweep: frames at m samples.
            bodies: (p,) body numbers, ascending; k+1+e is entry e of the
                transmission's flat coefficients.
            twists: (p, 6) twists in those bodies' frames; an entry needs none.
            out: (p, 6, m) written in place when given.
        """
        m = frames.tool.shape[-1]
        out = np.empty((len(bodies), 6, m)) if out is None else out
        behind = len(bodies)
        if behind and bodies[-1] >= len(frames.columns):
            behind = int(np.searchsorted(bodies, len(frames.columns)))
            out[behind:] = self._transmission_jacobian(frames, bodies[behind:] - len(frames.columns))
            bodies, twists = bodies[:behind], twists[:behind]
        _kernels.point_jacobian(frames.columns, frames.tool[3], bodies, twists, out[:behind])
        return out

    def _transmission_jacobian(self, frames: FrameBatch, entries: Array) -> Array:
        """The same (e, 6, m) per unit of entries (e,) of the flat transmission."""
        assert self.transmission is not None
        assert frames.terms is not None
        term, joint, source = np.unravel_index(entries, self.transmission.coefficients.shape)
        return self.joint_jacobian(frames)[joint] * frames.terms[term, source][:, None]

    def joint_jacobian(self, frames: FrameBatch) -> Array:
        """The tool point's velocity (n, 6, m) per unit of each independent joint's effective value."""
        k = len(self.moving_joints)
        twists = np.zeros((k, 6))
        twists[np.arange(k), np.where(self.prismatic, 2, 5)] = 1.0
        moving = self.tool_jacobian(frames, np.arange(1, k + 1), twists)
        return np.tensordot(self.mimic_matrix, moving, (0, 0))

    def perturbed_at(self, motions: Mapping[int, Array]) -> Chain:
        """The chain with each station's frame moved by a right factor (4, 4), M ← M·motion."""
        every = np.tile(np.eye(4), (self.tool_frame_index + 1, 1, 1))
        for station, motion in motions.items():
            every[station] = motion
        return self.perturbed(every)

    def perturbed(self, motions: Array) -> Chain:
        """The chain with every station's frame moved by a right factor (2k+4, 4, 4), M ← M·motion."""
        return self._with(
            origins=motions[1:-1:2] @ self.origins @ motions[2::2],
            base=self.base @ motions[0],
            tool=self.tool @ motions[-1],
        )

    def with_base_and_tool(self, base: Array, tool: Array) -> Chain:
        """The chain with another base and tool (4, 4)."""
        return self._with(base=base, tool=tool)

    def _with(self, **frames: Array) -> Chain:
        """The chain with other origins, base or tool; the axes stay, and so do the frames made of them."""
        chain = object.__new__(Chain)
        known = {
            "axis_frames": self.axis_frames,
            "body_from_urdf": self.body_from_urdf,
            "_urdf_from_body": self._urdf_from_body,
        }
        vars(chain).update(self.__getstate__(), **known, **frames)
        return chain


def bodies_of_frames(chain: Chain, error_frames: Array) -> Array:
    """The bodies (p,) that errors at stations (p,) move."""
    return np.clip((np.asarray(error_frames, int) - 1) // 2, 0, len(chain.moving_joints))


def twists_in_bodies(
    chain: Chain, error_frames: Array, twists: Array, frame_transforms: Array | None = None
) -> tuple[Array, Array]:
    """Bodies (p,) and the same twists (p, 6) in those bodies' frames, of twists at stations (p,).

    `carry` (p, 4, 4) are the frames that the twists are seen in where these are not the stations' own.
    """
    still = np.tile(np.eye(4), (chain.tool_frame_index + 1, 1, 1))
    frames = error_frame_poses(chain.body_from_urdf, chain.origins, chain.tool, still)[error_frames]
    frames = frames if frame_transforms is None else frames @ frame_transforms
    return bodies_of_frames(chain, error_frames), (
        se3.adjoint(frames) @ np.asarray(twists, float)[..., None]
    )[..., 0]


def without_mimics(chain: Chain) -> Chain:
    """The same path whose every moving joint is commanded by itself, none following another."""
    k = len(chain.moving_joints)
    free = np.full(k, np.inf)
    return replace(
        chain,
        joint_names=chain.moving_joints,
        mimic_matrix=np.eye(k),
        mimic_offset=np.zeros(k),
        lower=-free,
        upper=free,
    )


def extract_dh_table(chain: Chain, convention: Convention = "standard", hayati: bool = False) -> Extraction:
    """The chain's DH table, base and tool apart, by common normals."""
    if not (np.array_equal(chain.mimic_matrix, np.eye(chain.n_joints)) and not chain.mimic_offset.any()):
        follows = next(name for name in chain.moving_joints if name not in chain.joint_names)
        raise DhcalError(
            f"{chain.urdf.source}: joint {follows!r} mimics another, which a DH table cannot hold; "
            "calibrate the URDF itself"
        )
    return extract_dh(
        chain.link_transforms,
        chain.joint_names,
        chain.prismatic,
        chain.lower,
        chain.upper,
        convention,
        hayati,
    )
