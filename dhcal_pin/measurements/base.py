"""What an instrument reads of the tool, and how that changes with the tool.

A kind of measurement holds joint values and readings in SI. Given a sweep of frames and the values u of
its own unknowns (an anchor, a touched point) it returns whitened residuals, measured minus modelled over
sigma, as (k, m). It says how they mix the tool's velocities (p, 6, c·m), of which `derivatives` makes those
of the whitened model (p, k, m), and gives the derivative (s, k, m) by its s unknowns. Components come first,
so that samples are contiguous. A step solves derivative·Δx = residual.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Protocol, Self, TypeVar

import numpy as np

from .._kernels import apply_observation_matrix
from .._kernels.types import FrameBatch, ObservationMatrix
from .._typing import Array
from ..exceptions import DhcalError
from ..robot.chain import Chain

# Without a sigma a millimetre weighs as much as a milliradian.
LENGTH_SIGMA, ANGLE_SIGMA = 1e-3, 1e-3


# An anchor or a touched point may be anywhere in a hall; a wire's zero within arm's length.
POINT_PRIOR, ZERO_PRIOR = 10.0, 1.0


@dataclass(frozen=True)
class InstrumentParameter:
    """A scalar that an instrument brings with it.

    Attributes:
        name: what users call it; measurements share the unknowns that they name alike.
        unit: "m" or "rad".
        nominal: where the search starts.
        prior: standard deviation about that, in its unit.
        is_local: whether its value only means something to the very measurement that started it.
    """

    name: str
    unit: str
    nominal: float
    prior: float
    is_local: bool = False


@dataclass(frozen=True)
class Noise:
    """Standard deviations an axis: `position` in m, `rotation` in rad."""

    position: float = 0.0
    rotation: float = 0.0


class Measurement(Protocol):
    """What the solver asks of a kind with m samples, c configurations a sample and s unknowns."""

    kind: ClassVar[str]
    residual_groups: ClassVar[Mapping[str, slice]]
    # The kind's columns in a file and what they hold: "length", "angle" or "text"; sigmas included.
    columns: ClassVar[Mapping[str, str]]
    # A file is of this kind if it has all columns of one of these.
    required_columns: ClassVar[tuple[frozenset[str], ...]]
    # Configurations a row: 0, 1, or 2, the second under to:JOINT.
    configurations_per_row: ClassVar[int]
    # Fields with an entry a sample.
    sample_fields: ClassVar[tuple[str, ...]]
    # Whether the tool must be on something for a sample; if not, any configuration can be measured.
    is_contact: ClassVar[bool]
    # Whether a reading holds a length; if not, an arm of any size fits as well.
    has_length_scale: ClassVar[bool]

    @property
    def q(self) -> Array:
        """Joint values (m, n) of the samples' first configurations, rad or m."""
        ...

    @property
    def rows(self) -> Array:
        """Row numbers (m,), the first reading of a file being 1."""
        ...

    @property
    def residual_dim(self) -> int:
        """Number k of residuals a sample."""
        ...

    @property
    def has_stated_sigma(self) -> bool:
        """Whether the sigmas are the instrument's own, not a placeholder to be estimated."""
        ...

    @property
    def instrument_parameters(self) -> tuple[InstrumentParameter, ...]:
        """The s unknowns, in the order of u."""
        ...

    def configurations(self) -> Array:
        """Joint values (c·m, n) that a sweep for this measurement has, one configuration after the other."""
        ...

    def initialized(self, chain: Chain) -> Self:
        """The same readings with unknowns that start where a chain puts them."""
        ...

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """Whitened residuals (k, m); `groups` names its rows."""
        ...

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """How the k rows of the whitened model follow from the tool's velocities where residual is."""
        ...

    def instrument_jacobian(self, frames: FrameBatch, u: Array) -> Array:
        """Derivatives (s, k, m) of the whitened model by the unknowns."""
        ...

    def small_angle(self, frames: FrameBatch, u: Array) -> tuple[Array, ObservationMatrix]:
        """The paper's rows: residual (k, m) by (35) and (36), and what makes its R of velocities."""
        ...

    def errors(self, frames: FrameBatch, u: Array) -> dict[str, Array]:
        """Unweighted errors (m, ·): "position" in m, "orientation" in rad, or the kind's own in m."""
        ...

    def positions(self) -> Array:
        """Measured positions (m, 3) of the tool point, or (0, 3) where the kind has none."""
        ...

    def rotations(self) -> Array:
        """Measured rotations (m, 3, 3) of the tool, or (0, 3, 3) where the kind has none."""
        ...

    def with_scaled_sigma(self, scales: Mapping[str, float]) -> Self:
        """The same readings with each group's sigmas multiplied."""
        ...

    def with_weights(self, weights: Array) -> Self:
        """The same readings with each sample counting for a weight (m,), by wider sigmas."""
        ...

    def take(self, index: Array | slice) -> Self:
        """The samples of an index or mask."""
        ...

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> Self:
        """Readings of a chain with normal noise, the instrument standing somewhere sensible."""
        ...

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> Self:
        """The readings of a file: joint values (m, n) an end, and its columns (m,) in SI or as text."""
        ...

    def to_columns(self) -> dict[str, Any]:
        """The columns (m,) that a file of these readings has, in SI or as text."""
        ...


def whitened_jacobian(
    item: Measurement, frames: FrameBatch, velocities: Array, u: Array, residual: Array
) -> Array:
    """Of the whitened model (p, k, m), from tool velocities (p, 6, c·m) where the residual (k, m) is."""
    out = np.empty((len(velocities), *residual.shape))
    return apply_observation_matrix(velocities, item.observation_matrix(frames, u, residual), out)


_Kind = TypeVar("_Kind", bound=Measurement)


def concatenate(items: Sequence[_Kind]) -> _Kind:
    """The samples of several measurements as one measurement's, in this order.

    Raises:
        DhcalError: they are of different kinds, or differ in more than their samples.
    """
    first = items[0]
    common = [f.name for f in fields(first) if f.name not in first.sample_fields]  # pyright: ignore[reportArgumentType]
    for item in items[1:]:
        if type(item) is not type(first) or not all(
            _is_equal(getattr(item, name), getattr(first, name)) for name in common
        ):
            raise DhcalError(f"{item.kind}: differs from the first {first.kind} in more than its samples")
    samples = {name: np.concatenate([getattr(item, name) for item in items]) for name in first.sample_fields}
    return replace(first, **samples)  # pyright: ignore[reportArgumentType]


def _is_equal(a: Any, b: Any) -> bool:
    return np.array_equal(a, b, equal_nan=True) if isinstance(a, np.ndarray) else a == b


def columns_together(*names: str) -> frozenset[str]:
    """Columns that go together."""
    return frozenset(names)


def stack_columns(values: Mapping[str, Any], names: Sequence[str]) -> Any:
    """Columns (m, k), or None where they are not all there."""
    return np.stack([values[name] for name in names], -1) if all(name in values for name in names) else None


def length_columns(*names: str) -> dict[str, str]:
    """Columns of lengths and their sigmas."""
    return {**dict.fromkeys(names, "length"), **{f"sigma_{name}": "length" for name in names}}


def validated_sigma(value: Any, shape: tuple[int, int], what: str) -> Array:
    """Sigmas of that shape from one number or as many, positive and finite; or DhcalError."""
    value = np.asarray(value, float)
    try:
        value = np.array(np.broadcast_to(value, shape))
    except ValueError:
        raise DhcalError(f"{what} has shape {value.shape}; give one number or {shape}") from None
    if not (np.isfinite(value).all() and (value > 0).all()):
        raise DhcalError(f"{what} must be positive and finite")
    return value


def validated_array(value: Any, shape: tuple[int | None, ...], what: str) -> Array:
    """A finite array of that shape, None being any size; or DhcalError."""
    value = np.asarray(value, float)
    fits = value.ndim == len(shape) and all(w in (None, g) for w, g in zip(shape, value.shape, strict=True))
    if not fits:
        raise DhcalError(f"{what} has shape {value.shape}, needs {shape}".replace("None", "m"))
    if not np.isfinite(value).all():
        raise DhcalError(f"{what}: every value must be finite")
    return value


def point_parameters(prefix: str, at: Array) -> tuple[InstrumentParameter, ...]:
    """Three unknown coordinates of a point that is at about (3,) m."""
    return tuple(
        InstrumentParameter(f"{prefix}.{axis}", "m", float(value), POINT_PRIOR)
        for axis, value in zip("xyz", at, strict=True)
    )
