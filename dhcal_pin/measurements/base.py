"""Measurement models: the interface of all measurement kinds, and what the kinds share.

A measurement object holds m samples of one kind: joint positions q, measured values z and their standard
deviations sigma, in metres and radians. Let h(q, u) be the value that the chain and the s instrument
parameters u predict, such as the unknown anchor of a wire. With the frames of the chain at q, a kind returns

    r = (z - h) / sigma                     whitened residuals, (k, m)
    (∂h/∂V) / sigma                         observation matrix; V are the velocities of the tool, (6, c·m)
    (∂h/∂u) / sigma                         instrument Jacobian, (s, k, m)

With the tool Jacobian J, (p, 6, c·m), of p error parameters x, the Jacobian of the whitened model is the
product of observation matrix and J, (p, k, m). A least-squares step Δ makes J_w·Δ ≈ r with this Jacobian J_w.

Letters in shapes: m samples, n joints, k residuals per sample, c configurations per sample (1 or 2),
s instrument parameters, p error parameters. Components come first and samples last, so that the samples of
one component are contiguous in memory.

A new kind derives from `PointMeasurement`, if it depends on the position of the tool point alone, or from
`Measurement`. It declares its columns in `COLUMNS`, has a constructor that checks its arguments, and is
entered in `measurements.KINDS`. Files, simulation, calibration and planning take it from there.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from numbers import Real
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from .._frozen import frozen
from .._kernels import apply_observation_matrix
from .._kernels.types import FrameBatch, ObservationMatrix
from .._typing import Array
from ..exceptions import InvalidArgumentError, UnknownNameError
from ..formatting import format_count
from ..robot.chain import Chain
from ..robot.conditions import CONDITIONS, Conditions, concatenate_conditions, directions_in_order
from .columns import Column, common_text, file_columns, stack_columns, stack_sigmas
from .configurations import label_samples
from .groups import ErrorGroup, Group, declare
from .mounting import MountedRig

# Standard deviations [m], [rad] of measurements that state none: a millimetre weighs as much as a
# milliradian.
LENGTH_SIGMA, ANGLE_SIGMA = 1e-3, 1e-3
# Prior standard deviation [m] of an anchor or touched point: it may be anywhere in a hall.
POINT_PRIOR = 10.0
# Prior standard deviation [m] of the zero of a wire or of a target on the tool: within arm's length.
OFFSET_PRIOR = 1.0


@frozen
class InstrumentParameter:
    """Unknown scalar of an instrument, which is estimated together with the robot."""

    #: Name that users see. Measurements share the parameters that have the same name.
    name: str
    unit: str  #: "m", "rad", "px" or "1"
    nominal: float  #: Initial value; NaN if another measurement has to provide it
    prior: float  #: Prior standard deviation of the difference from `nominal`, in `unit`
    #: Whether the value only has a meaning for the measurement object that initialized it.
    is_local: bool = False


@frozen
class Noise:
    """Standard deviations of simulated measurement noise.

    Attributes:
        position: Of each axis of a position, or of a length [m].
        rotation: Of each component of a rotation vector [rad].
    """

    position: float = 0.0
    rotation: float = 0.0

    def __post_init__(self) -> None:
        """Check the standard deviations."""
        for name, value in vars(self).items():
            if not (isinstance(value, Real) and 0 <= float(value) < np.inf):
                raise InvalidArgumentError(
                    f"Noise: {name} is {value!r}; expected a finite number of at least 0, in m or rad"
                )


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Measurement(ABC):
    """Samples of one measurement kind.

    Objects are immutable. Constructors check their arguments; `take`, `replace` and the methods `with_...`
    return copies without checking again, as solvers call them for each chunk of samples.
    """

    q: Array  #: Joint positions of the first configuration of each sample, (m, n) [rad or m]
    #: Line of each sample in its file, (m,), as text editors count; samples from Python are numbered from 1.
    rows: Array
    sigma: Array  #: Standard deviations of the measured values, (m, k) [m, rad or px]
    #: Whether the standard deviations are those of the instrument, not placeholders that are estimated with
    #: the fit.
    has_stated_sigma: bool
    instrument_parameters: tuple[InstrumentParameter, ...]  #: The s instrument parameters, in the order of u
    source: str  #: Name of the file; empty for samples from Python
    #: Whether the joint positions were measured. Otherwise they only reproduce measured poses of the tip, and
    #: say nothing about the joint space of a robot.
    has_joint_values: bool
    has_counts: bool  #: Whether the joint positions come from counts of servos, through a servo file
    rig: MountedRig | None  #: Cameras and boards of image coordinates; None for all other kinds
    recorded: Conditions | None  #: Conditions that were recorded with the samples; None without

    # Name of the kind in files, on the command line and in studies.
    kind: ClassVar[str]
    # Columns of files, except those of the joints.
    COLUMNS: ClassVar[tuple[Column, ...]]
    # Quantity of each column of files, standard deviations included; see `Column`.
    columns: ClassVar[Mapping[str, str]]
    # A file is of this kind if it has all columns of one of these sets.
    required_columns: ClassVar[tuple[frozenset[str], ...]]
    # Rows of the residual by name, with their unit.
    residual_groups: ClassVar[Mapping[str, Group]]
    # Errors that `errors` returns besides those of the residual.
    further_errors: ClassVar[Mapping[str, ErrorGroup]] = {}
    # Configurations per row of a file: 0, 1, or 2, the second one in columns `to:JOINT`.
    configurations_per_row: ClassVar[int] = 1
    # Attributes with one entry per sample.
    sample_fields: ClassVar[tuple[str, ...]] = ("q", "rows")
    # Whether the tool must be in contact with an object; otherwise any configuration can be measured.
    is_contact: ClassVar[bool] = False
    # False if residuals are lengths that shrink with the robot, and no measured length opposes.
    has_length_scale: ClassVar[bool] = True
    # Name of the direction about which the measuring frame can turn without changing a measurement.
    symmetry_axis: ClassVar[str] = ""
    # Whether each sample depends on the tool point in all directions: it shows changes during a session.
    shows_changes: ClassVar[bool] = False
    # Whether a file may have poses of the tip in place of joint values.
    accepts_tool_poses: ClassVar[bool] = False
    # Column of the names that samples state, see `label_names`; empty without names.
    label_column: ClassVar[str] = ""
    # What `simulate` assumes about the instrument and its place, for plans; empty without any choice.
    simulated_instrument: ClassVar[str] = ""

    def __init_subclass__(cls, **options: Any) -> None:
        """Derive the columns of files from `COLUMNS`, and enter the residual groups."""
        super().__init_subclass__(**options)
        declare(cls.__dict__.get("residual_groups", {}))
        declare(cls.__dict__.get("further_errors", {}))
        if "COLUMNS" in cls.__dict__:
            cls.columns = file_columns(cls.COLUMNS)
            if "required_columns" not in cls.__dict__:
                cls.required_columns = (frozenset(c.name for c in cls.COLUMNS if not c.is_implied),)

    def _initialize(self, q: Array, **values: Any) -> None:
        """Set attributes of an immutable object, some by default; for constructors only."""
        defaults = {"rows": np.arange(1, len(q) + 1), "source": "", "instrument_parameters": ()}
        defaults |= {"has_joint_values": True, "has_counts": False, "rig": None, "recorded": None}
        self.__dict__.update(defaults | {"q": q} | values)

    def __repr__(self) -> str:
        """Return the kind, the number of samples and the standard deviations."""
        parts = [format_count(len(self.rows), "sample"), *self.description()]
        return f"{type(self).__name__}({', '.join(parts)})"

    def description(self) -> list[str]:
        """Return what `repr` says besides the number of samples."""
        return []

    def _sigma_text(self, *sigmas: tuple[Array, float, str]) -> str:
        """Return a text with standard deviations for `repr`."""
        if not self.has_stated_sigma:
            return "sigma not stated"
        texts = []
        for values, factor, unit in sigmas:
            extremes = (values.min(), values.max()) if values.size else ()
            # One number if both are written alike.
            numbers = dict.fromkeys(f"{factor * value:.3g}" for value in extremes)
            texts += [f"{' to '.join(numbers)} {unit}"] if numbers else []
        return " ".join(["sigma", ", ".join(texts)]) if texts else "sigma stated"

    @cached_property
    def configuration_groups(self) -> Array:
        """Labels of the samples, (m,), equal for samples of the same configuration; read-only."""
        labels = label_samples([self])
        labels.flags.writeable = False
        return labels

    # ------------------------------------------------------------------------------------------- copies
    def with_conditions(self, **conditions: ArrayLike) -> Self:
        """Return a copy with conditions of the samples besides the joint positions.

        Args:
            **conditions: Values by name: `time` (m,) [s], `temperature` (m,) [°C], `payload` (m,) [kg], and
                `approach` (m, n), the direction of the last motion of each joint, which is -1, 0 or 1.

        Returns:
            Copy with these conditions; others that were known before are kept.

        Raises:
            InvalidArgumentError: A shape is wrong, or a value is not plausible.
            UnknownNameError: There is no such condition.
        """
        values = {name: self._validated_condition(name, value) for name, value in conditions.items()}
        return self.replace(recorded=replace(self.recorded or Conditions(self.q), **values))

    def in_order(self) -> Self:
        """Return a copy whose samples are declared to be in the order of measurement.

        It has the number of each sample, and the direction of the last motion of each joint, from the sample
        before, unless the directions are known.
        """
        known = self.recorded or Conditions(self.q)
        approach = known.approach if known.approach is not None else directions_in_order(self.q)
        return self.replace(recorded=replace(known, order=np.arange(len(self.rows)), approach=approach))

    def _validated_condition(self, name: str, value: ArrayLike) -> Array:
        """Return the values of a condition after checking them."""
        if name not in CONDITIONS:
            raise UnknownNameError(
                f"{self.kind}: unknown condition {name!r}; choose from {', '.join(CONDITIONS)}"
            )
        condition, values = CONDITIONS[name], np.asarray(value, float)
        shape = self.q.shape if condition.is_per_joint else self.q.shape[:1]
        if values.shape != shape:
            raise InvalidArgumentError(f"{self.kind}: {name} has shape {values.shape}; expected {shape}")
        for column in values.reshape(len(values), -1).T:
            if problem := condition.find_problem(column):
                raise InvalidArgumentError(f"{self.kind}: {name} in row {problem[0] + 1}: {problem[1]}")
        return values

    def replace(self, **values: Any) -> Self:
        """Return a copy with other values of some attributes, given by their names, which are not checked."""
        copy = object.__new__(type(self))
        known = self.__dict__
        # Attributes only: cached properties must not be copied.
        copy.__dict__.update({name: known[name] for name in _field_names(type(self))} | values)
        return copy

    def take(self, index: Array | slice) -> Self:
        """Return the samples of an index, mask or slice; this object if these are all samples in order."""
        m = len(self.rows)
        if isinstance(index, slice):
            if range(m)[index] == range(m):
                return self
            parts = {name: getattr(self, name)[index] for name in self.sample_fields}
        else:
            # Rows are taken by number in less time than by mask.
            chosen = np.arange(m)[index]
            if len(chosen) == m and np.array_equal(chosen, np.arange(m)):
                return self
            parts = {name: getattr(self, name).take(chosen, 0) for name in self.sample_fields}
        return self.replace(**parts, recorded=self.recorded[index] if self.recorded else None)

    def resample(self, q: Array) -> Self:
        """Return the same measurement at other joint positions, (c·m, n) as `configurations` returns them."""
        return self.replace(q=q)

    def with_scaled_sigma(self, scales: Mapping[str, float]) -> Self:
        """Return a copy with standard deviations times a factor for each name in `residual_groups`."""
        (scale,) = scales.values()
        return self.replace(sigma=self.sigma * scale)

    def at_largest_noise(self) -> Self:
        """Return a copy with the largest noise that the measurement does not exclude, for uncertainties."""
        return self

    def with_weights(self, weights: Array) -> Self:
        """Return a copy whose standard deviations are divided by the square roots of sample weights, (m,)."""
        return self.replace(sigma=self.sigma / np.sqrt(weights)[:, None])

    @cached_property
    def _weights(self) -> Array:
        """1 / sigma, (k, m), contiguous along the samples."""
        return 1 / np.ascontiguousarray(self.sigma.T)

    # ------------------------------------------------------------------------------------------- model
    @property
    @abstractmethod
    def residual_dim(self) -> int:
        """Number k of residuals per sample."""

    @property
    def residual_names(self) -> tuple[str, ...]:
        """Names of the k residuals of a sample, such as "position_x" or "length_2"."""
        names: list[str] = []
        for name, group in self.residual_groups.items():
            count = len(range(self.residual_dim)[group.rows])
            endings = group.axes or range(1, count + 1)
            names += [f"{name}_{ending}" for ending in endings] if count > 1 else [name]
        return tuple(names)

    def configurations(self) -> Array:
        """Return the joint positions (c·m, n) of all samples, one configuration after the other."""
        return self.q

    def conditions(self) -> Conditions:
        """Return the conditions of the samples at `configurations()`."""
        q = self.configurations()
        return Conditions(q) if self.recorded is None else self.recorded.at(q)

    @property
    def sample_groups(self) -> Array:
        """Label of the group of each sample, (m,): samples that are often wrong together.

        These are the samples of one stop of the arm.
        """
        return label_stops(self)

    @property
    def label_names(self) -> tuple[str, ...]:
        """Names that the samples state in the column `label_column`, such as those of touched points."""
        return ()

    @property
    def label_numbers(self) -> Array:
        """Number of the name of each sample in `label_names`, (m,)."""
        return np.zeros(len(self.rows), int)

    def with_label(self, number: int) -> Self:
        """Return the same samples, all of which state one name."""
        return self

    @property
    def n_images(self) -> int:
        """Number of images."""
        return 0

    def images_within(self, is_chosen: Array) -> list[str]:
        """Return the names of the images all of whose corners are among the chosen samples, a mask (m,).

        Names are empty for images without a name.
        """
        return []

    def photographs(self) -> Array:
        """Return the name of the photograph of each sample, (m,); empty texts without photographs."""
        return np.full(len(self.rows), "", object)

    def tool_poses(self) -> Measurement:
        """Return images as poses of the tool for some base and some tool; other kinds as they are."""
        return self

    def solved_rig(self, values: Mapping[str, float]) -> MountedRig | None:
        """Return the rig with estimated poses, lenses and corners; None for kinds without a rig."""
        return None

    def set_of(self, name: str) -> str:
        """Return the parameter set of the instrument parameter of a name; empty if it belongs to none."""
        return ""

    @property
    def observed_body(self) -> int | None:
        """Number of the body that is observed, see `ObservationMatrix`; None for the tool."""
        return None

    def mounted(self, chain: Chain) -> Self:
        """Return a copy that knows the body that it observes; unchanged if it observes the tool."""
        return self

    def initialized(self, chain: Chain) -> Self:
        """Return a copy whose instrument parameters are initialized from the tool poses of a robot."""
        return self

    def mirror_images(self, chain: Chain, values: Mapping[str, float]) -> list[dict[str, float]]:
        """Return other values of instrument parameters that explain the samples nearly as well.

        Args:
            chain: Robot.
            values: Values of the instrument parameters by name.

        Returns:
            Changed values by name, one mapping per image; none if the instrument has no mirror images.
        """
        return []

    def initialized_from(self, chain: Chain, is_used: Array, is_kept: Array | None = None) -> Self:
        """Return a copy with initial values of the instrument parameters from a part of the samples.

        Args:
            chain: Robot whose tool poses the initial values are fitted to.
            is_used: Whether each sample is used, (m,).
            is_kept: Whether the copy has each sample, (m,); all of them if not given.
        """
        part = self.take(is_used).initialized(chain)
        per_sample = (*self.sample_fields, "recorded")
        common = [field.name for field in fields(self) if field.name not in per_sample]
        kept = self if is_kept is None else self.take(is_kept)
        return kept.replace(**{name: getattr(part, name) for name in common})

    def matched_to(self, known: Mapping[str, float]) -> Self:
        """Return a copy with the unknowns of a calibration, if its known values decide on them."""
        return self

    @abstractmethod
    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """Return the whitened residuals (k, m); `residual_groups` names the rows.

        Args:
            frames: Frames of the chain at `configurations()`.
            u: Values of the instrument parameters, (s,).
        """

    @abstractmethod
    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """Return the derivatives of the whitened model with respect to the velocities of the tool.

        Args:
            frames: Frames of the chain at `configurations()`.
            u: Values of the instrument parameters, (s,).
            residual: Whitened residuals at these frames and values, (k, m).
        """

    @abstractmethod
    def instrument_jacobian(self, frames: FrameBatch, u: Array) -> Array:
        """Return the derivatives (s, k, m) of the whitened model with respect to u.

        Args:
            frames: Frames of the chain at `configurations()`.
            u: Values of the instrument parameters, (s,).
        """

    def small_angle(self, frames: FrameBatch, u: Array) -> tuple[Array, ObservationMatrix]:
        """Return residuals and observation matrix of the paper, which assume small rotation errors.

        They are exact for kinds without a measured rotation.

        Args:
            frames: Frames of the chain at `configurations()`.
            u: Values of the instrument parameters, (s,).

        Returns:
            Residuals (k, m) by the paper's (35) and (36), and the matching observation matrix.
        """
        residual = self.residual(frames, u)
        return residual, self.observation_matrix(frames, u, residual)

    @abstractmethod
    def errors(self, frames: FrameBatch, u: Array) -> dict[str, Array]:
        """Return measured minus modelled values, not whitened.

        Args:
            frames: Frames of the chain at `configurations()`.
            u: Values of the instrument parameters, (s,).

        Returns:
            Errors (m, ·) by the names in `residual_groups` and `further_errors`, in the units stated there.
        """

    def positions(self) -> Array:
        """Return measured positions (m, 3) of the tool point [m]; (0, 3) for kinds without."""
        return np.empty((0, 3))

    def rotations(self) -> Array:
        """Return measured rotations (m, 3, 3) of the tool; (0, 3, 3) for kinds without."""
        return np.empty((0, 3, 3))

    @classmethod
    def simulate(
        cls, chain: Chain, q: ArrayLike | Conditions, noise: Noise, rng: np.random.Generator
    ) -> Self:
        """Return measurements of a chain with normal noise, by an instrument in a sensible place.

        Args:
            chain: Robot that is measured.
            q: Joint positions, (m, n) [rad or m], or conditions with joint positions. Kinds with contact move
                the joints onto the touched object.
            noise: Standard deviations of the noise.
            rng: Random generator of the noise.

        Returns:
            Measurements with the conditions, if these are more than joint positions.

        Raises:
            InvalidArgumentError: There are conditions, but the kind moves the joints, or it has two
                configurations per sample.
        """
        conditions = chain.conditions(q)
        if conditions.names and (cls.is_contact or cls.configurations_per_row != 1):
            raise InvalidArgumentError(
                f"{cls.kind}: cannot be simulated with conditions; expected joint positions alone"
            )
        data = cls._simulate(chain, conditions, noise, rng)
        return data.replace(recorded=data.recorded or conditions) if conditions.names else data

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Self:
        """Return measurements at given conditions; kinds that can be simulated define it."""
        raise NotImplementedError

    # ------------------------------------------------------------------------------------------- files
    @classmethod
    def from_columns(
        cls, q: Sequence[Array], values: Mapping[str, Any], rig: MountedRig | None = None
    ) -> Self:
        """Return the measurements of a file.

        Args:
            q: Joint positions of each configuration, (m, n) [rad or m].
            values: Columns by name: numbers (m,) in m, rad or px, or texts.
            rig: Cameras and boards on the chain; not used by other instruments.
        """
        return cls(*q[: cls.configurations_per_row], **cls._arguments(values))  # pyright: ignore[reportCallIssue]

    @classmethod
    def _arguments(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the arguments of the constructor that the columns of a file fill."""
        columns = cls.present_columns(values)
        out: dict[str, Any] = {}
        for column in columns:
            if not column.is_numeric:
                text = values[column.name]
                out[column.argument] = common_text(text, column.name) if column.is_common else text
            elif not column.is_implied and column.argument not in out:
                names = [other.name for other in columns if other.argument == column.argument]
                out[column.argument] = stack_columns(values, names)
        return out | {"sigma": stack_sigmas(values, [column for column in columns if column.is_numeric])}

    @classmethod
    def present_columns(cls, values: Mapping[str, Any]) -> tuple[Column, ...]:
        """Return those of `COLUMNS` that a file of this kind with these columns uses."""
        return tuple(column for column in cls.COLUMNS if column.is_implied or column.name in values)

    def to_columns(self) -> dict[str, Any]:
        """Return the columns (m,) of a file with these measurements: numbers in m or rad, or texts."""
        values, sigmas = self._columns_and_sigmas()
        known = values | (sigmas if self.has_stated_sigma else {})
        return {name: known[name] for name in self.columns if name in known}

    @abstractmethod
    def _columns_and_sigmas(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the columns with measured values and texts, and those with standard deviations."""

    @classmethod
    def plausible_range(cls, name: str, reach: float) -> tuple[float, float] | None:
        """Return the smallest and largest plausible value of a column [m].

        Args:
            name: Name of a column.
            reach: Radius of the sphere that the tip can reach [m].

        Returns:
            None if the column is not checked by itself.
        """
        for column in cls.COLUMNS:
            if column.name == name and column.plausible_range:
                return column.plausible_range(reach)
        return None


@cache
def _field_names(kind: type[Measurement]) -> tuple[str, ...]:
    """Return the names of the attributes of a kind."""
    return tuple(field.name for field in fields(kind))


def instrument_values(item: Measurement, values: Mapping[str, float]) -> Array:
    """Return the instrument parameters of a measurement from values by name."""
    return np.array([values[parameter.name] for parameter in item.instrument_parameters])


def residual_of(item: Measurement, chain: Chain, values: Mapping[str, float]) -> Array:
    """Compute the whitened residuals (k, m) for a chain and instrument parameters by name."""
    return item.residual(chain.forward_kinematics(item.conditions()), instrument_values(item, values))


def errors_of(item: Measurement, chain: Chain, values: Mapping[str, float]) -> dict[str, Array]:
    """Compute the errors by group for a chain and instrument parameters by name."""
    return item.errors(chain.forward_kinematics(item.conditions()), instrument_values(item, values))


def whitened_jacobian(
    item: Measurement, model: tuple[Chain, Array, Array], frames: FrameBatch, u: Array, residual: Array
) -> Array:
    """Compute the Jacobian (p, k, m) of the whitened model with respect to the error parameters."""
    # The model is the chain with bodies and twists of the errors; see `Chain.tool_jacobian`.
    chain, bodies, twists = model
    observation = item.observation_matrix(frames, u, residual)
    jacobian = chain.tool_jacobian(frames, bodies, twists, body=observation.body)
    return apply_observation_matrix(jacobian, observation, np.empty((len(bodies), *residual.shape)))


def label_stops(item: Measurement) -> Array:
    """Label samples (m,); those of one stop of the arm have equal configurations and conditions."""
    if not len(item.rows):
        return np.zeros(0, int)
    parts = np.split(item.configurations(), max(item.configurations_per_row, 1))
    conditions = [] if item.recorded is None else [item.recorded.steps]
    return np.unique(np.concatenate([*parts, *conditions], 1), axis=0, return_inverse=True)[1].reshape(-1)


def known_conditions(data: Iterable[Measurement]) -> frozenset[str]:
    """Return the names of the conditions that are known of any samples, and "" for the joint positions."""
    return frozenset(("",)).union(*(item.recorded.names for item in data if item.recorded))


_Kind = TypeVar("_Kind", bound=Measurement)


def concatenate(items: Sequence[_Kind]) -> _Kind:
    """Join the samples of several measurement objects."""
    first = items[0]
    per_sample = (*first.sample_fields, "recorded")
    common = [field.name for field in fields(first) if field.name not in per_sample]
    for item in items[1:]:
        if type(item) is not type(first) or not all(
            _is_equal(getattr(item, name), getattr(first, name)) for name in common
        ):
            raise InvalidArgumentError(
                f"{item.kind}: differs from the first measurements ({first.kind}) in more than its samples; "
                "expected the same kind, names and instrument"
            )
    return first.replace(
        **{name: np.concatenate([getattr(item, name) for item in items]) for name in first.sample_fields},
        recorded=concatenate_conditions([item.recorded for item in items]),
    )


def _is_equal(a: Any, b: Any) -> bool:
    """Return whether two values of an attribute are equal; NaN equals NaN."""
    return np.array_equal(a, b, equal_nan=True) if isinstance(a, np.ndarray) else a == b


def point_parameters(prefix: str, point: Array) -> tuple[InstrumentParameter, ...]:
    """Return the three coordinates of an unknown point as instrument parameters."""
    return tuple(
        InstrumentParameter(f"{prefix}.{axis}", "m", float(value), POINT_PRIOR)
        for axis, value in zip("xyz", point, strict=True)
    )
