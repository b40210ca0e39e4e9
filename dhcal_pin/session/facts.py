"""What happened during a session, in words and figures: events, drift, lag and scale."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from .. import se3
from .._typing import Array
from ..formatting import format_fixed, format_quantity
from ..measurements.base import Measurement
from ..robot.chain import Chain
from .causes import Cause, Drift, Step
from .linear_model import growing_links
from .robot_changes import RobotChanges, apply_changes
from .timeline import Timeline

# A motion is stated as an angle if that moves the tool by more than this multiple of its translation.
MIN_ANGLE_RATIO = 10.0


@dataclass(frozen=True)
class Event:
    """Sudden change between two samples.

    Attributes:
        kind: "base", "tool", "joint" or "robot".
        of: Name of the joint or parameter; else empty.
        file: File of the first sample after it.
        line: Line of this sample.
        file_before: File of the last sample before it.
        line_before: Line of that sample.
        size: Size of the change, in `unit`.
        std: Standard deviation of the size.
        unit: "m" or "rad".
    """

    kind: str
    of: str
    file: str
    line: int
    file_before: str
    line_before: int
    size: float
    std: float
    unit: str

    def to_dict(self) -> dict[str, Any]:
        """Return the event for the JSON document."""
        keys = ("kind", "of", "file", "line", "size", "std", "unit")
        return {key: getattr(self, key) for key in keys}

    @property
    def place(self) -> str:
        """Where it happened, such as "between lines 51 and 52"."""
        if self.file_before != self.file:
            return f"between {self.file_before or 'the first'} and {self.file or 'the second set of samples'}"
        where = f" of {self.file}" if self.file else ""
        return f"between lines {self.line_before} and {self.line}{where}"

    @property
    def sentence(self) -> str:
        """What happened, and what the calibration did."""
        size = format_quantity(self.size, self.unit, self.std, small=self.unit == "m")
        if self.kind == "robot":
            return (
                f"The samples before and after line {self.line} are of two robots: {self.of} differs by "
                f"{size}. Calibrate each robot by itself."
            )
        if self.kind == "joint":
            return (
                f"The zero of joint {self.of} changed by {size} {self.place}. The result is the arm after "
                "the change."
            )
        verb = "turned" if self.unit == "rad" else "moved"
        return (
            f"The {self.kind} {verb} by {size} {self.place}. Both parts were fitted with their own "
            f"{self.kind} pose."
        )


@dataclass(frozen=True)
class SlowChange:
    """Drift from the begin to the end.

    Attributes:
        of: "base", "tool", "links", or the name of a joint.
        size: Size of the whole change, in `unit`.
        std: Standard deviation of the size.
        unit: "m" or "rad".
        time_constant: Time constant of an exponential; None for a linear drift.
        time_unit: "row" or "s".
    """

    of: str
    size: float
    std: float
    unit: str
    time_constant: float | None
    time_unit: str

    def to_dict(self) -> dict[str, Any]:
        """Return the drift for the JSON document."""
        keys = ("of", "size", "std", "unit", "time_constant")
        return {key: getattr(self, key) for key in keys}

    @property
    def sentence(self) -> str:
        """What happened, and what the calibration did."""
        size = format_quantity(self.size, self.unit, self.std, small=self.unit == "m")
        how = "during the measurement"
        if self.time_constant is not None:
            unit = "s" if self.time_unit == "s" else "rows"
            how += f", with a time constant of {self.time_constant:.3g} {unit}"
        if self.of in ("base", "tool"):
            return f"The {self.of} drifted by {size} {how}. It was fitted with a pose that changes smoothly."
        if self.of == "links":
            return (
                f"The lengths of the links changed {how}, which moved the tool by {size}. The result is the "
                "arm at the end: let it warm up before the measurement."
            )
        return f"The zero of joint {self.of} drifted by {size} {how}. The result is the arm at the end."


@dataclass(frozen=True)
class Lag:
    """Delay between joint values and measured values.

    Attributes:
        value: Time by which the joint values are too early, in `unit`.
        std: Standard deviation of the value.
        unit: "row" or "s".
    """

    value: float
    std: float
    unit: str

    @property
    def sentence(self) -> str:
        """What was found, and what to do."""
        unit = {"row": "rows"}.get(self.unit, self.unit)
        word = "earlier" if self.value > 0 else "later"
        size = f"{format_fixed(abs(self.value), 3)} {unit}"
        return (
            f"The joint values are {size} {word} than the measured values. Record both at the same time, or "
            f"add --mend lag:{self.value:.4g}."
        )


@dataclass(frozen=True)
class Scale:
    """Factor of measured lengths.

    Attributes:
        factor: Measured over true length.
        std: Standard deviation of the factor.
        axis: "x", "y" or "z" of the measuring frame; empty for all.
    """

    factor: float
    std: float
    axis: str

    @property
    def sentence(self) -> str:
        """What was found, and what to do."""
        percent = f"{abs(100 * (self.factor - 1)):.2g} %"
        word = "long" if self.factor > 1 else "short"
        if self.axis:
            return (
                f"Measured {self.axis} is {percent} too {word} compared with the other axes. Check the "
                f"instrument, or add --mend scale:{self.axis}:{self.factor:.6g}."
            )
        return (
            f"The correction makes the whole robot {percent} {'longer' if self.factor > 1 else 'shorter'}. "
            "Check the scale of the instrument: measurements alone cannot tell it from the size of the "
            f"robot. If the instrument is wrong, add --mend scale:{self.factor:.6g}."
        )


@dataclass(frozen=True, eq=False)
class Session:
    """What happened during a session.

    Attributes:
        changes: Changes of the robot during the session.
        timeline: Timeline of the samples.
        chain: Robot with the base frame in which the base drifts.
        is_ordered: Whether the samples are in the order of measurement.
        causes: What was found, in the order of its discovery.
        events: Sudden changes, in the order of measurement.
        drifts: Slow changes.
        lag: Delay of the joint values; None if there is none.
        scales: Wrong scales of the instrument.
    """

    changes: RobotChanges
    timeline: Timeline
    chain: Chain
    is_ordered: bool = True
    causes: tuple[Cause, ...] = ()
    events: tuple[Event, ...] = ()
    drifts: tuple[SlowChange, ...] = ()
    lag: Lag | None = None
    scales: tuple[Scale, ...] = field(default=())

    def applied(
        self, data: tuple[Measurement, ...], holdout: tuple[Measurement, ...]
    ) -> tuple[tuple[Measurement, ...], tuple[Measurement, ...]]:
        """Return fitted and held-out measurements with the changes as conditions of their samples."""
        timeline = Timeline(
            (*data, *holdout),
            len(data),
            self.timeline.numbers,
            self.timeline.times,
            self.timeline.unit,
            self.timeline.file_starts,
        )
        return apply_changes(self.changes, self.chain, timeline)

    @cached_property
    def sentences(self) -> list[str]:
        """One sentence or two about each finding."""
        found = (*self.events, *self.drifts, *([self.lag] if self.lag else []), *self.scales)
        return [item.sentence for item in found]

    def to_dict(self) -> dict[str, Any]:
        """Return what happened for the JSON document."""
        lag, scale = self.lag, next(iter(self.scales), None)
        return {
            "events": [event.to_dict() for event in self.events],
            "drift": [drift.to_dict() for drift in self.drifts],
            "lag": {"value": lag.value, "std": lag.std, "unit": lag.unit} if lag else None,
            "scale": {"factor": scale.factor, "std": scale.std, "axis": scale.axis} if scale else None,
            "unordered": not self.is_ordered,
        }


def describe_events(
    causes: tuple[Cause, ...], changes: RobotChanges, chain: Chain, timeline: Timeline
) -> tuple[Event, ...]:
    """Describe the sudden changes, in the order of measurement."""
    steps = [(c, c.shape) for c in causes if isinstance(c.shape, Step)]
    events = []
    for cause, shape in sorted(steps, key=lambda pair: pair[1].number):
        size, std, unit = _step_size(cause, shape, changes, chain)
        (file_before, line_before), (file, line) = (timeline.place(shape.number + i) for i in (-1, 0))
        events.append(
            Event(cause.block.kind, cause.block.of, file, line, file_before, line_before, size, std, unit)
        )
    return tuple(events)


def _step_size(cause: Cause, step: Step, changes: RobotChanges, chain: Chain) -> tuple[float, float, str]:
    """Return the size of a step, its standard deviation and its unit."""
    if cause.block.kind == "joint":
        unit = "m" if chain.is_prismatic[cause.block.index] else "rad"
        return abs(float(cause.values[0])), float(np.sqrt(cause.covariance[0, 0])), unit
    motion = getattr(changes, cause.block.kind)
    before, after = motion.poses[motion.segments(np.array([step.number - 1, step.number]))]
    if cause.block.kind == "base":
        moved = (after - before)[:3] @ chain.base[:, 3]
        turned, arm, axes = after @ se3.inverse(before), np.zeros(3), chain.base[:3, :3]
    else:
        moved = (after - before)[:3, 3]
        turned, arm, axes = after @ se3.inverse(before), before[:3, 3], np.eye(3)
    return _motion_size(axes.T @ moved, se3.log3(turned[:3, :3]), arm, cause)


def _motion_size(moved: Array, angles: Array, arm: Array, cause: Cause) -> tuple[float, float, str]:
    """Return the size of a motion: of its translation, unless it mostly turns."""
    distance, angle = float(np.linalg.norm(moved)), float(np.linalg.norm(angles))
    reach = 1 / float(cause.block.sizes[3:].max())
    if angle * reach > MIN_ANGLE_RATIO * distance:
        along = np.concatenate([np.zeros(3), angles / angle])
        return angle, float(np.sqrt(along @ cause.covariance @ along)), "rad"
    direction = moved / max(distance, 1e-300)
    along = np.concatenate([direction, np.cross(arm, direction)])
    return distance, float(np.sqrt(along @ cause.covariance @ along)), "m"


def describe_drifts(causes: tuple[Cause, ...], chain: Chain, timeline: Timeline) -> Iterator[SlowChange]:
    """Describe the slow changes."""
    for cause in causes:
        if not isinstance(cause.shape, Drift):
            continue
        values, kind = cause.values, cause.block.kind
        if kind in ("base", "tool"):
            size, std, unit = _motion_size(values[:3], values[3:], np.zeros(3), cause)
        elif kind == "joint":
            size, std = abs(float(values[0])), float(np.sqrt(cause.covariance[0, 0]))
            unit = "m" if chain.is_prismatic[cause.block.index] else "rad"
        else:
            size, std = _growth_size(cause, chain, timeline)
            unit = "m"
        constant = cause.shape.time_constant
        yield SlowChange(
            cause.block.of or kind, size, std, unit, None if np.isinf(constant) else constant, timeline.unit
        )


def _growth_size(cause: Cause, chain: Chain, timeline: Timeline) -> tuple[float, float]:
    """Return the RMS motion of the tool by a growth of the links, and its standard deviation [m]."""
    q = np.concatenate([item.q for item in timeline.data])
    motions = chain.growth_motions(chain.forward_kinematics(q))[:, :3]
    if len(cause.values) == 1:
        motions = motions.sum(0, keepdims=True)
    else:
        motions = motions[growing_links(chain)]
    moved = np.einsum("jcm,j->cm", motions, cause.values)
    size = float(np.sqrt(np.mean(np.sum(moved**2, 0))))
    gradient = np.einsum("jcm,cm->j", motions, moved) / (moved.shape[1] * max(size, 1e-300))
    return size, float(np.sqrt(gradient @ cause.covariance @ gradient))
