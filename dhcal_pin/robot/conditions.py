"""Conditions of samples: what the model of a robot depends on.

The tool pose depends on the joint positions q and, for some joint errors, on the direction in which each
joint moved last, on the temperature and on the payload. A condition that is not known has no effect: a joint
has no direction, the links have the lengths of the model, and the payload is that of the model.

Base, tool, joint zeros and links may also change during a measurement. A calibration finds such changes, and
states for each sample how the robot differs from that at the end of the measurement.

Shapes: m samples, n independent joints, k moving joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace

import numpy as np

from .._frozen import frozen
from .._kernels.types import JointState
from .._typing import Array
from ..units import UNITS

# Plausible temperatures of a robot [°C], and heaviest payload [kg].
TEMPERATURE_RANGE = -50.0, 150.0
MAX_PAYLOAD = 1e5
# Largest difference of simulated temperatures from the reference temperature [K].
MAX_RISE = 10.0
# Smallest motion of a joint between two samples [rad or m]; smaller ones are noise of its encoder.
MIN_MOTION = 1e-4


@frozen
class Condition:
    """Condition of a sample that a measurement file can state."""

    name: str  #: Name of the column and of the attribute of `Conditions`
    quantity: str  #: "time" [s], "temperature" [°C], "mass" [kg] or "direction" (-1, 0 or 1)
    description: str  #: What it is, for messages
    low: float  #: Lowest value, in the unit of the quantity
    high: float  #: Highest value
    is_per_joint: bool = False  #: Whether each joint has a column `NAME_JOINT`
    #: Function that draws the values of simulated samples from a random generator, the shape (m, n) of their
    #: joint positions and the reference temperature [°C]; None if no joint error depends on it.
    draw: Callable[[np.random.Generator, tuple[int, ...], float], Array] | None = None
    #: Samples of one configuration are repetitions if they are equal in multiples of this step, in the unit
    #: of the quantity; 0 for a condition that no model depends on.
    resolution: float = 0.0

    @property
    def header(self) -> str:
        """Header of its column, for messages: `NAME[unit]`, or `NAME_JOINT` for one column per joint."""
        unit = next(iter(UNITS[self.quantity]), "")
        return self.name + "_JOINT" * self.is_per_joint + (f"[{unit}]" if unit else "")

    def find_problem(self, values: Array) -> tuple[int, str] | None:
        """Return the first sample with a value (m,) that is not possible, and what is wrong with it."""
        if self.quantity == "direction" and (wrong := np.flatnonzero(~np.isin(values, (-1, 0, 1)))).size:
            return int(wrong[0]), f"{values[wrong[0]]:g} is not a direction; expected -1, 0 or 1"
        if (wrong := np.flatnonzero(~((values >= self.low) & (values <= self.high)))).size:
            limits = f"a number from {self.low:g} to {self.high:g}"
            return int(wrong[0]), f"{values[wrong[0]]:g} is not plausible; expected {limits}"
        if self.quantity == "time" and (wrong := np.flatnonzero(np.diff(values) < 0)).size:
            return int(wrong[0]) + 1, "is earlier than the row before; expected rows in the order of time"
        return None


CONDITIONS = {
    condition.name: condition
    for condition in (
        Condition("time", "time", "time of the measurement", -np.inf, np.inf),
        Condition(
            "approach",
            "direction",
            "direction of the last motion of a joint",
            -1,
            1,
            is_per_joint=True,
            draw=lambda rng, shape, reference: rng.choice([-1.0, 1.0], shape),
            resolution=1,
        ),
        Condition(
            "temperature",
            "temperature",
            "temperature of the robot",
            *TEMPERATURE_RANGE,
            draw=lambda rng, shape, reference: reference + rng.uniform(-MAX_RISE, MAX_RISE, shape[0]),
            resolution=1,
        ),
        Condition("payload", "mass", "mass at the tip", 0, MAX_PAYLOAD, resolution=0.01),
    )
}


@frozen(eq=False)
class Conditions:
    """Conditions of m samples; None for a condition that is not known."""

    q: Array  #: Commanded positions of the independent joints, shape (m, n) [rad or m]
    order: Array | None = None  #: Number of each sample in the order of measurement, shape (m,)
    time: Array | None = None  #: Time of each sample, shape (m,) [s]
    #: Direction of the last motion of each joint, -1, 0 or 1, shape (m, n); 0 if it is not known.
    approach: Array | None = None
    temperature: Array | None = None  #: Temperature of the robot, shape (m,) [°C]
    payload: Array | None = None  #: Mass at the tip, shape (m,) [kg]
    #: Motion C of the base in the measuring frame: its pose is C·B with the pose B of the chain, shape (m, 4,
    #: 4) [m].
    base_motion: Array | None = None
    #: Motion D of the tool in its own frame: its pose is T·D with the pose T of the chain, shape (m, 4, 4)
    #: [m].
    tool_motion: Array | None = None
    zeros: Array | None = None  #: Differences of the joint positions from q, shape (m, n) [rad or m]
    growth: Array | None = None  #: Relative growth of each link, shape (m, k+1)

    def __getitem__(self, index: Array | slice) -> Conditions:
        """Return the samples of an index, mask or slice."""
        return Conditions(**{name: values[index] for name, values in self._known.items()})

    @property
    def _known(self) -> dict[str, Array]:
        """Known conditions by name."""
        pairs = ((field.name, getattr(self, field.name)) for field in fields(self))
        return {name: values for name, values in pairs if values is not None}

    def equals(self, other: Conditions) -> bool:
        """Check whether the same conditions are known, with the same values."""
        own, others = self._known, other._known
        return own.keys() == others.keys() and all(
            np.array_equal(values, others[name]) for name, values in own.items()
        )

    def copy(self) -> Conditions:
        """Return a copy that does not change if an array of this object is written to."""
        return Conditions(**{name: values.copy() for name, values in self._known.items()})

    @property
    def names(self) -> frozenset[str]:
        """Names of the known conditions besides q."""
        return frozenset(self._known) - {"q"}

    @property
    def steps(self) -> Array:
        """Values of the conditions that models depend on besides q, in multiples of their steps, (m, ·)."""
        columns = [
            np.rint(self._known[name].reshape(len(self.q), -1) / condition.resolution)
            for name, condition in CONDITIONS.items()
            if condition.resolution and name in self._known
        ]
        return np.hstack([np.empty((len(self.q), 0)), *columns])

    @property
    def of_arm(self) -> Conditions:
        """The conditions of the arm alone, as if base and tool had not moved."""
        return replace(self, base_motion=None, tool_motion=None)

    @property
    def of_joints(self) -> Conditions:
        """The conditions that joint errors depend on."""
        return Conditions(self.q, approach=self.approach, temperature=self.temperature, payload=self.payload)

    def at(self, q: Array) -> Conditions:
        """Return the same conditions at other joint positions (c·m, n), all samples of each configuration."""
        count = len(q) // max(len(self.q), 1)
        if count <= 1:
            return replace(self, q=q)
        repeated = {name: np.concatenate([values] * count) for name, values in self._known.items()}
        if self.approach is not None:
            # The direction of the second configuration is not known.
            repeated["approach"][len(self.q) :] = 0.0
        return Conditions(**repeated | {"q": q})


@frozen(eq=False)
class SampleState(JointState):
    """Positions of a chain's joints at samples, with the conditions of the samples."""

    conditions: Conditions


def concatenate_conditions(parts: Sequence[Conditions | None]) -> Conditions | None:
    """Join the conditions of several sets of samples; a condition has to be known of all of them."""
    if any(part is None for part in parts):
        return None
    values = {field.name: [getattr(part, field.name) for part in parts] for field in fields(Conditions)}
    known = {name: each for name, each in values.items() if not any(value is None for value in each)}
    return Conditions(**{name: np.concatenate(each) for name, each in known.items()})


def directions_in_order(q: Array) -> Array:
    """Return the direction of the last motion of each joint (m, n), samples in order; 0 before the first."""
    steps = np.diff(q, axis=0, prepend=q[:1])
    directions = np.where(np.abs(steps) < MIN_MOTION, 0.0, np.sign(steps))
    rows = np.arange(len(q))[:, None]
    last_motion = np.maximum.accumulate(np.where(directions == 0, 0, rows), 0)
    return np.take_along_axis(directions, last_motion, 0)
