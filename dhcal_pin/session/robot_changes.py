"""Changes of a robot during a session, as conditions of its samples.

Base and tool have one motion per segment between two steps, and may drift in addition. With the motion C of
the base in the measuring frame and D of the tool in its own frame, a measured pose is C·B·F(q)·T·D. The
increments of both act as the parameters of base and tool do: B·exp(ξ) and T·exp(ξ). They have the same
derivatives.

Shapes: m samples, n joints, k moving joints, S segments.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..robot.conditions import Conditions
from ..robot.joint_path import joint_path
from .causes import Cause, Change, Constant, Drift, FreeDrift, Shape, Step
from .timeline import Timeline


@frozen(eq=False)
class Motion:
    """Motion of base or tool over time; the identity at the end."""

    steps: tuple[int, ...] = ()  # Numbers of the first samples of all segments but the first, ascending
    poses: Array = field(default_factory=lambda: np.eye(4)[None])  # Motion of each segment, (S, 4, 4) [m]
    # Drifts with the twists of their functions of time, (F, 6).
    drifts: tuple[tuple[Drift | FreeDrift, Array], ...] = ()

    @property
    def is_identity(self) -> bool:
        """Whether there is no motion."""
        return not self.steps and not self.drifts

    def segments(self, numbers: Array) -> Array:
        """Return the segment of each sample, (m,)."""
        return np.searchsorted(self.steps, numbers, side="right")

    def twists(self, numbers: Array, times: Array) -> Array:
        """Return the twists of the drifts at samples, (m, 6)."""
        parts = [drift.values(numbers, times) @ twists for drift, twists in self.drifts]
        return sum(parts, np.zeros((len(numbers), 6)))

    def with_steps(self, steps: Sequence[int]) -> Motion:
        """Return the motion with other segments, each with the pose of the samples before its end."""
        ordered = tuple(sorted(set(steps)))
        last = np.array([*(step - 1 for step in ordered), np.iinfo(np.int64).max])
        return replace(self, steps=ordered, poses=self.poses[self.segments(last)])


@frozen(eq=False)
class RobotChanges:
    """Changes of a robot during a session."""

    base: Motion = field(default_factory=Motion)  # Motion of the base
    tool: Motion = field(default_factory=Motion)  # Motion of the tool
    # Changes of joint zeros: number of the joint, functions of time, and amplitudes (F,) [rad or m].
    zeros: tuple[tuple[int, Change, Array], ...] = ()
    # Growth of the links: functions of time, and amplitudes of each link, (F, k+1).
    growth: tuple[tuple[Change, Array], ...] = ()
    # Changes of the payload: functions of time, and change of the payload times the compliance of each joint,
    # (n,) [kg·rad/Nm].
    payload: tuple[tuple[Change, Array], ...] = ()
    # Times by which the joint values are too early: functions of time, and amplitudes in the unit of the
    # timeline.
    lag: tuple[tuple[Shape, float], ...] = ()

    @property
    def without_lag(self) -> RobotChanges:
        """The changes without a lag, which is a mistake of the recording and not of the robot."""
        return replace(self, lag=())

    def lag_at(self, numbers: Array, times: Array) -> Array:
        """Return the lag of each sample, (m,), in the unit of the timeline."""
        parts = [amplitude * shape.values(numbers, times)[:, 0] for shape, amplitude in self.lag]
        return sum(parts, np.zeros(len(numbers)))

    @property
    def of_frames(self) -> RobotChanges:
        """The changes of base and tool alone."""
        return RobotChanges(self.base, self.tool)

    def with_motions(self, kinds: Collection[str]) -> RobotChanges:
        """Return the changes with the motions of base and tool that are named, and no others."""
        none = {kind: Motion() for kind in ("base", "tool") if kind not in kinds}
        return replace(self, **none)

    @property
    def is_empty(self) -> bool:
        """Whether nothing changed."""
        return (
            self.base.is_identity
            and self.tool.is_identity
            and not (self.zeros or self.growth or self.payload or self.lag)
        )

    def with_step(self, kind: str, joint: int, old: int, new: int) -> RobotChanges:
        """Return the changes with a step of base, tool, payload, lag or a joint at another sample."""
        if kind == "wire":
            return self
        if kind == "lag":
            return replace(self, lag=tuple((Step(new) if f == Step(old) else f, v) for f, v in self.lag))
        if kind == "joint":
            moved = (i == joint and isinstance(f, Step) and f.number == old for i, f, _ in self.zeros)
            zeros = [
                (i, Step(new) if is_moved else f, value)
                for is_moved, (i, f, value) in zip(moved, self.zeros, strict=True)
            ]
            return replace(self, zeros=tuple(zeros))
        if kind == "payload":
            moved_steps = [(Step(new) if f == Step(old) else f, value) for f, value in self.payload]
            return replace(self, payload=tuple(moved_steps))
        motion: Motion = getattr(self, kind)
        steps = tuple(new if step == old else step for step in motion.steps)
        return replace(self, **{kind: replace(motion, steps=steps)})

    def carried_to(self, base: Array, tool: Array) -> RobotChanges:
        """Return the changes of the same robot with the base M·B and tool T·N⁻¹, M and N (4, 4) [m]."""
        by_tool = se3.adjoint(tool)
        drifts = tuple((shape, twists @ by_tool.T) for shape, twists in self.tool.drifts)
        return replace(
            self,
            base=replace(self.base, poses=base @ self.base.poses @ se3.inverse(base)),
            tool=replace(self.tool, poses=tool @ self.tool.poses @ se3.inverse(tool), drifts=drifts),
        )

    def conditions(
        self, conditions: Conditions, chain: Chain, numbers: Array, times: Array, later: Array | None
    ) -> Conditions:
        """Return the conditions of samples with changes; `later` are their q after the lag, (m, n)."""
        values: dict[str, Any] = {}
        if not self.base.is_identity:
            drift = se3.exp6(self.base.twists(numbers, times))
            values["base_motion"] = (
                self.base.poses[self.base.segments(numbers)] @ chain.base @ drift @ se3.inverse(chain.base)
            )
        if not self.tool.is_identity:
            drift = se3.exp6(self.tool.twists(numbers, times))
            values["tool_motion"] = drift @ self.tool.poses[self.tool.segments(numbers)]
        if self.zeros or self.payload or later is not None:
            zeros = np.zeros(conditions.q.shape)
            for joint, shape, amplitudes in self.zeros:
                zeros[:, joint] += shape.values(numbers, times) @ amplitudes
            for shape, amplitudes in self.payload:
                torque = chain.loads.torques_per_kilogram(conditions.q.T).T
                zeros += shape.values(numbers, times) * amplitudes * torque
            if later is not None:
                zeros += later - conditions.q
            values["zeros"] = zeros
        if self.growth:
            parts = [shape.values(numbers, times) @ amplitudes for shape, amplitudes in self.growth]
            values["growth"] = sum(parts[1:], parts[0])
        return replace(conditions, **values)


class JointPaths:
    """Joint positions over time, as cubic splines through the samples of each file."""

    def __init__(self, timeline: Timeline):
        """Join the samples of fitted and held-out measurements."""
        numbers, times = np.concatenate(timeline.numbers), np.concatenate(timeline.times)
        order = np.argsort(numbers)
        q = np.concatenate([item.q for item in timeline.data])[order]
        times = times[order]
        bounds = [timeline.begin, *timeline.file_starts, len(q)]
        self._starts = np.array(bounds[:-1])
        self._splines = [joint_path(times[a:b], q[a:b]) for a, b in pairwise(bounds)]

    def evaluate(self, numbers: Array, times: Array, lag: Array) -> tuple[Array, Array]:
        """Return the joint positions by the lag of each sample later, and their rates, (m, n) each."""
        files = np.searchsorted(self._starts, numbers, side="right") - 1
        n = self._splines[0](0.0).shape[-1]
        positions, rates = np.zeros((len(numbers), n)), np.zeros((len(numbers), n))
        for i, spline in enumerate(self._splines):
            chosen = files == i
            positions[chosen] = spline(times[chosen] + lag[chosen])
            rates[chosen] = spline(times[chosen] + lag[chosen], 1)
        return positions, rates


def apply_changes(
    changes: RobotChanges, chain: Chain, timeline: Timeline, paths: JointPaths | None
) -> tuple[tuple[Measurement, ...], tuple[Measurement, ...]]:
    """Return fitted and held-out measurements with the changes as conditions; a lag needs the paths."""
    out = []
    for item, numbers, times in zip(timeline.data, timeline.numbers, timeline.times, strict=True):
        later = None
        if paths and changes.lag:
            later = paths.evaluate(numbers, times, changes.lag_at(numbers, times))[0]
        known = item.recorded or Conditions(item.q)
        out.append(item.replace(recorded=changes.conditions(known, chain, numbers, times, later)))
    return tuple(out[: timeline.n_fitted]), tuple(out[timeline.n_fitted :])


def update(
    changes: RobotChanges, causes: Sequence[Cause], steps: Sequence[Array], base: Array, links: Array
) -> RobotChanges:
    """Return the changes after increments (F·c,) of the coefficients of each cause, at a base (4, 4) [m]."""
    motions = {"base": changes.base, "tool": changes.tool}
    zeros: list[tuple[int, Change, Array]] = []
    growth: list[tuple[Change, Array]] = []
    payload: list[tuple[Change, Array]] = []
    lag: list[tuple[Shape, float]] = []
    for kind, motion in motions.items():
        chosen = [(c.shape, d) for c, d in zip(causes, steps, strict=True) if c.block.kind == kind]
        jumps = [(shape.number, d) for shape, d in chosen if isinstance(shape, Step)]
        motion = motion.with_steps([number for number, _ in jumps])
        # A step acts on all segments before it.
        ends = [*motion.steps, np.inf]
        twists = np.array([sum((-d for n, d in jumps if n >= end), np.zeros(6)) for end in ends])
        increments = se3.exp6(twists)
        if kind == "base":
            poses = motion.poses @ base @ increments @ se3.inverse(base)
        else:
            poses = increments @ motion.poses
        before = dict(motion.drifts)
        drifts = [
            (shape, before.get(shape, 0.0) + d.reshape(-1, 6))
            for shape, d in chosen
            if isinstance(shape, Drift | FreeDrift)
        ]
        motions[kind] = replace(motion, poses=poses, drifts=tuple(drifts))
    of_joints = {(joint, shape): values for joint, shape, values in changes.zeros}
    of_links, of_payload, of_lag = dict(changes.growth), dict(changes.payload), dict(changes.lag)
    for cause, d in zip(causes, steps, strict=True):
        shape = cause.shape
        if not isinstance(shape, Constant) and cause.block.kind == "joint":
            joint = int(cause.block.index)
            zeros.append((joint, shape, of_joints.get((joint, shape), 0.0) + d))
        if not isinstance(shape, Constant) and cause.block.kind == "links":
            amplitudes = np.zeros((len(cause.amplitudes), len(links))) + of_links.get(shape, 0.0)
            is_own = np.isin(links, cause.block.columns) if len(cause.block.columns) > 1 else slice(None)
            amplitudes[:, is_own] += d.reshape(len(amplitudes), -1)
            growth.append((shape, amplitudes))
        if not isinstance(shape, Constant) and cause.block.kind == "payload":
            payload.append((shape, of_payload.get(shape, 0.0) + d))
        if cause.block.kind == "lag":
            lag.append((shape, of_lag.get(shape, 0.0) + float(d[0])))
    of_robot = motions["base"], motions["tool"], tuple(zeros), tuple(growth), tuple(payload)
    return RobotChanges(*of_robot, tuple(lag))
