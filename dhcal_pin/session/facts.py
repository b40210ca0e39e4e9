"""What happened during a session, in words and figures: events, drift, lag and scale."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..formatting import format_fixed, format_quantity, join_names, significant_decimals
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..robot.error_families import growing_links
from .causes import Block, Cause, Drift, FreeDrift, Step
from .robot_changes import JointPaths, RobotChanges, apply_changes
from .timeline import Place, Timeline

# A motion is stated as an angle if that moves the tool by more than this multiple of its translation.
MIN_ANGLE_RATIO = 10.0
# Largest change of a scale that is stated and can be undone: beyond it another mistake imitates a scale.
MAX_SCALE_CHANGE = 0.5
# Largest error of measured distances that is stated and can be undone [m].
MAX_RANGE_ERROR = 0.1
# Larger scales of all axes are those of another robot.
MAX_INSTRUMENT_SCALE = 0.1
# Manufacturing does not change the size of a robot by more than this part: printed parts shrink by 1 % or so.
MAX_SIZE_CHANGE = 0.03
# Smallest lag that is stated, in standard deviations.
MIN_STATED_LAG = 4.0
# The zero of a wire is right if its error is at most the first number of standard deviations, and that of the
# wrong one is more than the second one.
MAX_RIGHT_ZERO, MIN_WRONG_ZERO = 3.0, 5.0
# What a robot touches: its motion has the effect of one of the base.
TOUCHED = "touched object"


@frozen
class Event:
    """Sudden change between two samples."""

    kind: str  # "base", "tool", "joint", "payload", "wire" or "robot"
    of: str  # Name of the joint, wire or parameter, or of what moved if not base or tool; else empty
    before: Place  # Place of the last sample before it
    after: Place  # Place of the first sample after it
    size: float  # Size of the change, in `unit`
    std: float  # Standard deviation of the size
    unit: str  # "m" or "rad"
    rivals: tuple[str, ...] = ()  # Parts whose motion has the same effect
    # Options that undo a change of the zero of a wire, in the samples after it or before it, by the zero that
    # is then right: "earlier" or "later"; one if the measurements show which.
    mends: tuple[tuple[str, str], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the event for the JSON document."""
        keys = ("kind", "of", "file", "line", "size", "std", "unit")
        return {key: getattr(self, key) for key in keys}

    @property
    def file(self) -> str:
        """File of the first sample after it."""
        return self.after.file

    @property
    def line(self) -> int:
        """Line of the first sample after it."""
        return self.after.line

    @property
    def place(self) -> str:
        """Where it happened, such as "between lines 51 and 52"."""
        if self.before.photograph and self.after.photograph:
            return f"between {self.before.photograph} and {self.after.photograph}"
        if self.before.file != self.file:
            return f"between {self.before.file or 'the first'} and {self.file or 'the second set of samples'}"
        where = f" of {self.file}" if self.file else ""
        return f"between lines {self.before.last_line} and {self.line}{where}"

    @property
    def finding(self) -> str:
        """What happened."""
        size = format_quantity(self.size, self.unit, self.std, small=self.unit == "m")
        if self.kind == "robot":
            where = f"line {self.line}{f' of {self.file}' if self.file else ''}"
            return f"Two robots were measured: from {where} on, {self.of} differs by {size}."
        if self.kind == "joint":
            return f"The zero of joint {self.of} changed by {size} {self.place}."
        if self.kind == "wire":
            return f"The zero of wire {self.of} changed by {size} {self.place}."
        if self.kind == "payload":
            return f"The load on the arm changed {self.place}, which moved the tool by {size}."
        verb = "turned" if self.unit == "rad" else "moved"
        return f"The {self.of or self.kind} {verb} by {size} {self.place}."

    @property
    def consequence(self) -> str:
        """What the calibration did, or what to do."""
        if self.kind == "robot":
            return "Calibrate each robot by itself."
        if self.kind == "joint":
            return "The result is the arm after the change." + _same_effect(self.rivals)
        if self.kind == "payload":
            return (
                "The result is the arm with the load after the change. State the mass at the tip in each "
                "row, in a column payload[kg]."
            )
        if self.kind == "wire":
            known = f" The robot fits the {self.mends[0][0]} zero." if len(self.mends) == 1 else ""
            choices = [
                f", or add {option}{f' if the {right} zero is right' * (not known)}"
                for right, option in self.mends
            ]
            return f"It is not corrected.{known} Check the sensor{''.join(choices)}."
        pose = f"{self.of or self.kind} pose"
        fitted = f"Both parts were fitted with their own {pose}; the result has that of the later part."
        return fitted + _same_effect(self.rivals)


@frozen
class SlowChange:
    """Drift during a session."""

    kind: str  # "base", "tool", "links" or "joint"
    of: str  # Name of the joint, or of what moved; else the kind
    size: float  # Largest difference from the end, in `unit`
    std: float  # Standard deviation of the size
    unit: str  # "m" or "rad"
    shape: str  # "linear", "exponential" or "free"
    time_constant: float | None  # Time constant of an exponential; else None
    time_unit: str  # "row", "image" or "s"
    rivals: tuple[str, ...] = ()  # Parts whose motion has the same effect

    def to_dict(self) -> dict[str, Any]:
        """Return the drift for the JSON document."""
        keys = ("of", "size", "std", "unit", "shape", "time_constant")
        return {key: getattr(self, key) for key in keys}

    @property
    def finding(self) -> str:
        """What happened."""
        size = format_quantity(self.size, self.unit, self.std, small=self.unit == "m")
        how = "during the measurement"
        if self.time_constant is not None:
            unit = "s" if self.time_unit == "s" else f"{self.time_unit}s"
            how += f", with a time constant of {self.time_constant:.3g} {unit}"
        if self.kind == "links":
            by = f"up to {size}" if self.shape == "free" else size
            return f"The lengths of the links changed {how}, which moved the tool by {by}."
        part = f"zero of joint {self.of}" if self.kind == "joint" else self.of
        by = f"irregularly by up to {size}" if self.shape == "free" else f"by {size}"
        return f"The {part} drifted {by} {how}."

    @property
    def consequence(self) -> str:
        """What the calibration did."""
        if self.kind in ("base", "tool"):
            return "It was fitted with a pose that changes smoothly." + _same_effect(self.rivals)
        return "The result is the arm at the end." + _same_effect(self.rivals)


@frozen
class LagPart:
    """Samples of a session with one lag, or with one that changes steadily."""

    first: Place  # Place of the first sample
    last: Place  # Place of the last sample
    begin: float  # Lag at the first sample, in the unit of the lag
    end: float  # Lag at the last sample


@frozen
class Lag:
    """Delay between joint values and measured values."""

    value: float  # Time by which the joint values are too early at the end, in `unit`
    std: float  # Standard deviation of the value
    unit: str  # "row" or "s"
    is_corrected: bool = True  # Whether the samples are fitted with the joint values of the right time
    parts: tuple[LagPart, ...] = ()  # Parts of the session; several if the lag changed suddenly
    rate: float = 0.0  # Steady change of the lag per unit of time

    @property
    def finding(self) -> str:
        """What was found."""
        if self.rate:
            begin, end = self.parts[0].begin, self.parts[-1].end
            size = f", {format_fixed(1e6 * abs(self.rate), 0)} ppm" if self.unit == "s" else ""
            return (
                "The clocks of joint values and measured values drift apart: the joint values are "
                f"{self._text(begin)} at the beginning, and {self._text(end)} at the end{size}."
            )
        text = f"The joint values are {self._text(self.value)}"
        if len(self.parts) > 1:
            begun, last = self.parts[-2:]
            of_file = f" of {last.first.file}" if last.first.file else ""
            text += f" from line {last.first.line}{of_file} on, and {self._text(begun.end)} before"
        return f"{text}."

    def to_dict(self) -> dict[str, Any]:
        """Return the lag for the JSON document."""
        parts = [{"file": p.first.file, "line": p.first.line, "value": p.begin} for p in self.parts]
        return {"value": self.value, "std": self.std, "unit": self.unit, "parts": parts, "rate": self.rate}

    def _text(self, value: float) -> str:
        """Describe the time of the joint values."""
        if abs(value) < MIN_STATED_LAG * self.std:
            return "at the time of the measured values"
        unit = {"row": "rows"}.get(self.unit, self.unit)
        size = f"{format_fixed(abs(value), 3)} {unit}"
        return f"{size} {'earlier' if value > 0 else 'later'} than the measured values"

    @property
    def consequence(self) -> str:
        """What to do."""
        corrected = "The calibration corrected this. " * self.is_corrected
        if self.rate:
            return f"{corrected}Record both with one clock."
        if len(self.parts) < 2:
            return f"{corrected}Record both at the same time, or add --mend lag:{self.value:.4g}."
        mends = [
            f"--mend lag:{part.end:.4g}@{part.first.file}:{part.first.line}-{part.last.last_line}"
            for part in self.parts
            if abs(part.end) >= MIN_STATED_LAG * self.std
        ]
        is_one_file = len({place.file for part in self.parts for place in (part.first, part.last)}) == 1
        options = f", or add {' '.join(mends)}" if is_one_file and self.parts[0].first.file else ""
        return f"{corrected}Record both with one clock{options}."


@frozen
class Scale:
    """Factor of measured lengths."""

    factor: float  # Measured over true length
    std: float  # Standard deviation of the factor
    axis: str  # "x", "y" or "z" of the measuring frame; empty for all
    files: tuple[str, ...] = ()  # Measurement files with this scale; empty for all
    stated: str = ""  # Stated lengths, which nobody measured with the robot, if there are no others
    others: tuple[str, ...] = ()  # Files with which these files are compared; empty for the nominal robot

    @property
    def finding(self) -> str:
        """What was found."""
        change, std = abs(100 * (self.factor - 1)), 100 * self.std
        if self.axis:
            percent = f"{change:.2g} %"
            word = "long" if self.factor > 1 else "short"
            return f"Measured {self.axis} is {percent} too {word} compared with the other axes."
        word = "longer" if self.factor > 1 else "shorter"
        decimals = significant_decimals(std)
        percent = f"{format_fixed(change, decimals)} ± {format_fixed(std, decimals)} %"
        if self.others:
            files, others = join_names(self.files), join_names(self.others)
            return f"Measured lengths are {percent} {word} in {files} than in {others}."
        return f"The correction makes the whole robot {percent} {word}."

    @property
    def is_impossible(self) -> bool:
        """Whether stated lengths make the robot larger or smaller than any manufacturing error."""
        return bool(self.stated) and abs(self.factor - 1) > MAX_SIZE_CHANGE

    @property
    def consequence(self) -> str:
        """What to do."""
        if self.axis:
            return f"Check the instrument, or add --mend scale:{self.axis}:{self.factor:.6g}."
        if self.stated:
            return (
                f"Check the stated {self.stated}: nothing else shows the size of the robot. If it is wrong, "
                f"correct it, or add --mend scale:{self.factor:.6g}."
            )
        if self.others:
            return (
                "The scale of the instrument changed, or the temperature of the robot: check both. "
                "Measurements alone do not show which size is right. "
                f"Add {_mends(self.factor, self.files)} if it is that in {join_names(self.others)}, or "
                f"{_mends(1 / self.factor, self.others)} if it is that in {join_names(self.files)}."
            )
        if abs(self.factor - 1) > MAX_INSTRUMENT_SCALE:
            return "No instrument is so wrong: the robot file is probably that of a robot of another size."
        return (
            "Check the scale of the instrument: measurements alone do not distinguish it from the size of "
            f"the robot. If the instrument is wrong, add {_mends(self.factor, self.files)}."
        )


def _mends(factor: float, files: Sequence[str]) -> str:
    """Return the options that undo a scale of some files, or of all."""
    key = f"--mend scale:{factor:.6g}"
    return " ".join(f"{key}@{file}" for file in files) or key


@frozen
class RangeError:
    """Constant error of measured distances from the origin of the measuring frame, the tracker."""

    value: float  # Measured less true distance [m]
    std: float  # Standard deviation [m]

    @property
    def finding(self) -> str:
        """What was found."""
        word = "long" if self.value > 0 else "short"
        size = format_quantity(abs(self.value), "m", self.std)
        return f"Measured distances from the origin of the measuring frame are {size} too {word}."

    @property
    def consequence(self) -> str:
        """What to do."""
        return (
            "Check the radius of the reflector and the home position of the tracker, or add "
            f"--mend range:{self.value:.6f}."
        )


@frozen(eq=False)
class Session:
    """What happened during a session."""

    timeline: Timeline  # Timeline of the samples
    chain: Chain  # Robot with the base frame in which the base drifts
    is_ordered: bool  # Whether the samples are in the order of measurement
    changes: RobotChanges = field(default_factory=RobotChanges)  # Changes of the robot during the session
    causes: tuple[Cause, ...] = ()  # What was found, in the order of its discovery
    events: tuple[Event, ...] = ()  # Sudden changes, in the order of measurement
    drifts: tuple[SlowChange, ...] = ()  # Slow changes
    lag: Lag | None = None  # Delay of the joint values; None if there is none
    scales: tuple[Scale, ...] = ()  # Wrong scales of the instrument
    range_error: RangeError | None = None  # Wrong distances from the instrument; None if they are right

    def applied(
        self, data: tuple[Measurement, ...], holdout: tuple[Measurement, ...]
    ) -> tuple[tuple[Measurement, ...], tuple[Measurement, ...]]:
        """Return fitted and held-out measurements with the changes as conditions of their samples."""
        timeline = replace(self.timeline, data=(*data, *holdout))
        paths = JointPaths(timeline) if self.changes.lag else None
        return apply_changes(self.changes, self.chain, timeline, paths)

    def described(self) -> Session:
        """Return the session with events and drifts that describe its causes."""
        parts = self.causes, self.changes, self.chain, self.timeline
        events = self.events if self.has_two_robots else describe_events(*parts)
        return replace(self, events=events, drifts=tuple(describe_drifts(*parts)))

    @property
    def has_two_robots(self) -> bool:
        """Whether the samples are of two robots."""
        return any(event.kind == "robot" for event in self.events)

    @property
    def found(self) -> tuple[Event | SlowChange | Lag | Scale | RangeError, ...]:
        """Everything that was found."""
        return (*self.events, *self.drifts, *([self.lag] if self.lag else []), *self.wrong_lengths)

    @property
    def sentences(self) -> list[str]:
        """Each finding with its consequence."""
        return [f"{item.finding} {item.consequence}" for item in self.found]

    @property
    def wrong_lengths(self) -> tuple[RangeError | Scale, ...]:
        """Wrong lengths of the instrument."""
        return (*([self.range_error] if self.range_error else []), *self.scales)

    def to_dict(self) -> dict[str, Any]:
        """Return what happened for the JSON document."""
        lag, scale, distance = self.lag, next(iter(self.scales), None), self.range_error
        return {
            "events": [event.to_dict() for event in self.events],
            "drift": [drift.to_dict() for drift in self.drifts],
            "lag": lag.to_dict() if lag else None,
            "scale": {"factor": scale.factor, "std": scale.std, "axis": scale.axis} if scale else None,
            "range": {"value": distance.value, "std": distance.std} if distance else None,
            "unordered": not self.is_ordered,
        }


@frozen(eq=False)
class History:
    """Change of one part of a robot over a session, relative to the end."""

    # "base", "tool", "links", or the name of a joint.
    of: str
    # "m" or "rad".
    unit: str
    # Numbers of the samples, their change and its standard deviation, (N,) each.
    numbers: Array
    values: Array
    std: Array


def histories(session: Session) -> Iterator[History]:
    """Yield the changes of base, tool, joint zeros and links over the samples."""
    begin = session.timeline.begin
    by_number = np.argsort(np.concatenate(session.timeline.numbers))[begin:]
    numbers = np.concatenate(session.timeline.numbers)[by_number]
    times = np.concatenate(session.timeline.times)[by_number]
    changes = [cause for cause in session.causes if not cause.block.is_of_recording]
    for of in dict.fromkeys(cause.block.of or cause.block.kind for cause in changes):
        causes = [cause for cause in changes if (cause.block.of or cause.block.kind) == of]
        values, variance, unit = np.zeros(len(numbers)), np.zeros(len(numbers)), "m"
        for cause in causes:
            size, std, unit = cause_size(cause, session.changes, session.chain, session.timeline)
            f = cause.shape.values(numbers, times)
            motion = np.linalg.norm(f @ cause.amplitudes * cause.block.levers, axis=1)
            # The variance along the direction of the largest change.
            peak = int(np.argmax(motion))
            along = f[peak] @ cause.amplitudes * cause.block.levers**2
            at = (f[:, :, None] * along).reshape(len(f), -1)
            spread = np.einsum("ni,ij,nj->n", at, cause.covariance, at)
            values += size * motion / max(float(motion[peak]), 1e-300)
            variance += std**2 * spread / max(float(spread[peak]), 1e-300)
        yield History(of, unit, numbers - begin, values, np.sqrt(variance))


def describe_events(
    causes: tuple[Cause, ...], changes: RobotChanges, chain: Chain, timeline: Timeline
) -> tuple[Event, ...]:
    """Describe the sudden changes, in the order of measurement."""
    steps = [
        (c, c.shape)
        for c in causes
        if isinstance(c.shape, Step) and (c.block.kind == "wire" or not c.block.is_of_recording)
    ]
    events = []
    for cause, shape in sorted(steps, key=lambda pair: pair[1].number):
        size, std, unit = cause_size(cause, changes, chain, timeline)
        before, after = (timeline.place(shape.number + i) for i in (-1, 0))
        rivals = _rivals(cause.block, chain, timeline)
        mends = _mends_of_wire(cause, shape, causes, timeline) if cause.block.kind == "wire" else ()
        events.append(Event(cause.block.kind, cause.block.of, before, after, size, std, unit, rivals, mends))
    return tuple(events)


def _mends_of_wire(
    cause: Cause, step: Step, causes: Sequence[Cause], timeline: Timeline
) -> tuple[tuple[str, str], ...]:
    """Return the options that undo a change of the zero of a wire, by the zero that is right."""
    change = float(cause.values[0])
    key = f"--mend wire:{cause.block.of}"
    options = {
        "earlier": _of_samples(f"{key}:{change:.6f}", timeline, lambda numbers: numbers >= step.number),
        "later": _of_samples(f"{key}:{-change:.6f}", timeline, lambda numbers: numbers < step.number),
    }
    if not all(options.values()):
        return ()
    own = [each for each in causes if (each.block.kind, each.block.of) == (cause.block.kind, cause.block.of)]
    # Error of the zero before and after the step, and its standard deviation.
    numbers = np.array([step.number - 1, step.number])
    errors = np.abs(sum(each.shape.values(numbers, numbers)[:, 0] * each.values[0] for each in own))
    std = max(float(np.sqrt(each.covariance[0, 0])) for each in own)
    if errors.min() <= MAX_RIGHT_ZERO * std < MIN_WRONG_ZERO * std <= errors.max():
        right = ("earlier", "later")[int(np.argmin(errors))]
        options = {right: options[right]}
    return tuple(options.items())


def _of_samples(option: str, timeline: Timeline, is_inside: Callable[[Array], Array]) -> str:
    """Return an option for the files and lines of the samples with some numbers; empty if impossible."""
    options = []
    for source in dict.fromkeys(item.source for item in timeline.of_robot):
        parts = [
            (item.rows, is_inside(numbers))
            for item, numbers in zip(timeline.data, timeline.numbers, strict=True)
            if item.source == source
        ]
        rows, inside = (np.concatenate(each) for each in zip(*parts, strict=True))
        if not inside.any():
            continue
        first, last = int(rows[inside].min()), int(rows[inside].max())
        if not source or ((rows >= first) & (rows <= last) & ~inside).any():
            return ""
        lines = "" if inside.all() else f":{first}-{last}"
        options.append(f"{option}@{source}{lines}")
    return " ".join(options)


def _step_size(cause: Cause, step: Step, changes: RobotChanges, chain: Chain) -> tuple[float, float, str]:
    """Return the size of a step of base or tool, its standard deviation and its unit."""
    motion = getattr(changes, cause.block.kind)
    before, after = motion.poses[motion.segments(np.array([step.number - 1, step.number]))]
    origin = np.array([*cause.block.origin, 1.0])
    if cause.block.kind == "base":
        before, after = before @ chain.base, after @ chain.base
        axes, arm = chain.base[:3, :3], origin[:3]
    else:
        axes, arm = np.eye(3), before[:3] @ origin
    turned = axes.T @ se3.log3((after @ se3.inverse(before))[:3, :3])
    return _motion_size(axes.T @ (after - before)[:3] @ origin, turned, arm, cause.block, cause.covariance)


def _motion_size(
    moved: Array, angles: Array, arm: Array, block: Block, covariance: Array
) -> tuple[float, float, str]:
    """Return the size of a motion: of its translation, unless it mostly turns."""
    distance, angle = float(np.linalg.norm(moved)), float(np.linalg.norm(angles))
    # Turns that the measurements do not show are held at zero.
    reach = float(block.levers[3:].max())
    if angle * reach > MIN_ANGLE_RATIO * distance:
        along = np.concatenate([np.zeros(3), angles / angle])
        return angle, float(np.sqrt(along @ covariance @ along)), "rad"
    direction = moved / max(distance, 1e-300)
    along = np.concatenate([direction, np.cross(arm, direction)])
    return distance, float(np.sqrt(along @ covariance @ along)), "m"


def cause_size(
    cause: Cause, changes: RobotChanges, chain: Chain, timeline: Timeline
) -> tuple[float, float, str]:
    """Return the size of a change, its standard deviation and its unit."""
    block, shape = cause.block, cause.shape
    if block.touched is not None:
        return *_touched_size(block.touched, cause, changes, chain, timeline), "m"
    if isinstance(shape, Step) and block.kind in ("base", "tool"):
        return _step_size(cause, shape, changes, chain)
    values, covariance = _largest_change(cause, timeline)
    if block.kind in ("joint", "wire"):
        unit = "m" if block.kind == "wire" or chain.is_prismatic[block.index] else "rad"
        return abs(float(values[0])), float(np.sqrt(covariance[0, 0])), unit
    if block.kind == "links":
        return *_growth_size(values, covariance, chain, timeline), "m"
    if block.kind == "payload":
        return *_payload_size(values, covariance, chain, timeline), "m"
    origin = np.asarray(block.origin)
    return _motion_size(values[:3] + np.cross(values[3:], origin), values[3:], origin, block, covariance)


def _largest_change(cause: Cause, timeline: Timeline) -> tuple[Array, Array]:
    """Return the largest difference of the columns of a cause (c,) from the end, and its covariance."""
    numbers, times = np.concatenate(timeline.numbers), np.concatenate(timeline.times)
    f = cause.shape.values(numbers, times)
    peak = f[np.argmax(np.linalg.norm(f @ cause.amplitudes * cause.block.levers, axis=1))]
    values = peak @ cause.amplitudes
    by_values = np.kron(peak[None], np.eye(len(values)))
    return values, by_values @ cause.covariance @ by_values.T


def describe_scales_of_files(causes: tuple[Cause, ...], timeline: Timeline) -> list[Scale]:
    """Describe the scales of files, compared with that of the last ones."""
    own = [(c, c.shape.number) for c in causes if c.block.changes_between_files and isinstance(c.shape, Step)]
    starts = sorted({number for _, number in own})
    files: list[tuple[str, ...]] = []
    for first, end in pairwise([timeline.begin, *starts, sum(map(len, timeline.numbers))]):
        items = zip(timeline.data, timeline.numbers, strict=True)
        inside = [item.source for item, numbers in items if ((first <= numbers) & (numbers < end)).any()]
        files.append(tuple(dict.fromkeys(inside)))
    scales = []
    for start, names in zip(starts, files[:-1], strict=True):
        later = [cause for cause, number in own if number >= start]
        change = sum(float(cause.values[0]) for cause in later)
        std = float(np.sqrt(sum(cause.covariance[0, 0] for cause in later)))
        if abs(change) <= MAX_SCALE_CHANGE:
            scales.append(Scale(1 - change, std, "", names, others=files[-1]))
    return scales


def describe_lag(causes: tuple[Cause, ...], changes: RobotChanges, timeline: Timeline) -> Lag | None:
    """Describe the delay of the joint values, which may change suddenly or steadily."""
    own = [cause for cause in causes if cause.block.kind == "lag"]
    if not own:
        return None
    numbers, times = np.concatenate(timeline.numbers), np.concatenate(timeline.times)
    order = np.argsort(numbers)[timeline.begin :]
    numbers, times = numbers[order], times[order]
    values = changes.lag_at(numbers, times)
    steps = sorted({c.shape.number for c in own if isinstance(c.shape, Step)})
    edges = [0, *np.searchsorted(numbers, steps).tolist(), len(numbers)]
    parts = tuple(
        LagPart(
            timeline.place(int(numbers[a])),
            timeline.place(int(numbers[b - 1])),
            float(values[a]),
            float(values[b - 1]),
        )
        for a, b in pairwise(edges)
    )
    has_drift = any(isinstance(cause.shape, Drift) for cause in own)
    rate = (parts[-1].end - parts[-1].begin) / (times[-1] - times[edges[-2]]) if has_drift else 0.0
    std = max(float(np.sqrt(cause.covariance[0, 0])) for cause in own)
    return Lag(parts[-1].end, std, timeline.unit, parts=parts, rate=float(rate))


def describe_drifts(
    causes: tuple[Cause, ...], changes: RobotChanges, chain: Chain, timeline: Timeline
) -> Iterator[SlowChange]:
    """Describe the slow changes."""
    for cause in causes:
        shape = cause.shape
        if isinstance(shape, Drift | FreeDrift) and cause.block.kind != "lag":
            constant = shape.time_constant if isinstance(shape, Drift) else np.inf
            law = "linear" if np.isinf(constant) else "exponential"
            yield SlowChange(
                cause.block.kind,
                cause.block.of or cause.block.kind,
                *cause_size(cause, changes, chain, timeline),
                law if isinstance(shape, Drift) else "free",
                None if np.isinf(constant) else constant,
                timeline.unit,
                _rivals(cause.block, chain, timeline),
            )


def _rivals(block: Block, chain: Chain, timeline: Timeline) -> tuple[str, ...]:
    """Return the parts whose motion moves the arm as a change does: the base, and what the arm touches."""
    # The first joint, or the first rails.
    is_first = block.index == 0 or bool(chain.is_prismatic[: block.index + 1].all())
    like_base = ("base",) if block.kind == "joint" and is_first else ()
    return (
        *like_base,
        *((TOUCHED,) if timeline.is_of_contacts and (like_base or block.kind == "base") else ()),
    )


def _same_effect(rivals: tuple[str, ...]) -> str:
    """Return a sentence about parts whose motion has the same effect as a change; empty without any."""
    return f" A motion of the {' or of the '.join(rivals)} has the same effect." if rivals else ""


def _growth_size(values: Array, covariance: Array, chain: Chain, timeline: Timeline) -> tuple[float, float]:
    """Return the RMS motion of the tool by a growth of the links, and its standard deviation [m]."""
    motions = chain.growth_motions(chain.forward_kinematics(timeline.q))[:, :3]
    if len(values) == 1:
        motions = motions.sum(0, keepdims=True)
    else:
        motions = motions[growing_links(chain.link_vectors)]
    return _rms_motion(motions, values, covariance)


def _payload_size(values: Array, covariance: Array, chain: Chain, timeline: Timeline) -> tuple[float, float]:
    """Return the RMS motion of the tool by a change of the payload, and its standard deviation [m]."""
    torques = chain.loads.torques_per_kilogram(timeline.q.T)
    motions = chain.joint_jacobian(chain.forward_kinematics(timeline.q))[:, :3] * torques[:, None]
    return _rms_motion(motions, values, covariance)


def _touched_size(
    points: Array, cause: Cause, changes: RobotChanges, chain: Chain, timeline: Timeline
) -> tuple[float, float]:
    """Return the RMS motion of touched points by a change of the base, and its standard deviation [m]."""
    # Few points do not show all turns of the base, which may move its origin far.
    values, covariance = _largest_change(cause, timeline)
    if isinstance(cause.shape, Step):
        numbers = np.array([cause.shape.number - 1, cause.shape.number])
        before, after = changes.base.poses[changes.base.segments(numbers)] @ chain.base
        values = se3.log6(se3.inverse(after) @ before)
    turns = np.cross(np.eye(3)[:, None], points)
    moves = np.tile(np.eye(3)[:, None], (1, len(points), 1))
    motions = np.concatenate([moves, turns]).transpose(0, 2, 1)
    return _rms_motion(motions, values, covariance)


def _rms_motion(motions: Array, values: Array, covariance: Array) -> tuple[float, float]:
    """Return the RMS motion by values (c,) of motions (c, 3, m), and its standard deviation [m]."""
    moved = np.einsum("jcm,j->cm", motions, values)
    size = float(np.sqrt(np.mean(np.sum(moved**2, 0))))
    gradient = np.einsum("jcm,cm->j", motions, moved) / (moved.shape[1] * max(size, 1e-300))
    return size, float(np.sqrt(gradient @ covariance @ gradient))
