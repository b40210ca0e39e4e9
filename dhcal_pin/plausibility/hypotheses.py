"""Hypotheses about what was mixed up in measurements, each with the change that undoes it.

A change maps measurements as they were read to measurements as they would be without the mistake. It is
described by data, so that a remedy for the file can be derived from it.

Only changes that base and tool cannot absorb are listed: neither the zero of the first and of the last joint,
nor another right-handed order of the axes of measured positions.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import combinations, pairwise, permutations, product
from typing import Literal, Protocol

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..exceptions import InvalidArgumentError, UnknownNameError
from ..measurements.base import Measurement, concatenate, label_stops
from ..measurements.contact import PointContact
from ..measurements.euler_angles import (
    EULER_NOTATIONS,
    ROTATION_VECTOR,
    angles_to_matrix,
    matrix_to_angles,
)
from ..measurements.length import Wires
from ..measurements.pose import Pose, PoseMeasurement
from ..measurements.position import MultiTargetPosition, PointMeasurement, Position
from ..robot.chain import Chain
from ..robot.inverse_kinematics import MAX_POSE_DIFFERENCE, reach_poses, tool_pose_and_jacobian
from ..robot.joint_path import joint_path
from ..session.facts import MAX_RANGE_ERROR, MAX_SCALE_CHANGE
from ..units import ANGLES, LENGTHS

QuaternionNotation = Literal["xyzw", "wxyz"]
QUATERNION_ORDERS: tuple[QuaternionNotation, ...] = ("xyzw", "wxyz")
# Beginnings of the keys of hypotheses about the joint columns.
JOINT_CHANGES = ("sign", "zero", "ratio", "coupling", "swap", "columns", "joint", "joints")
# Kinds of changes that the controller may keep: the robot is then for joint values with the change.
LASTING_CHANGES = ("sign", "zero", "ratio", "coupling", "swap", "columns")
# Sign between the keys of two mistakes.
_AND = "+"
# Name of all joints in a key.
ALL = "all"
# Place of what may be wrong in place of the measurements.
_IN_ROBOT = " in the robot file"
# Number of coordinates of the instrument and of the target.
N_PLACES = 6
# Motion of the tool per unit of a joint that counts as none [m].
_MIN_MOTION = 1e-3
# Largest lag that can be undone [rows or s].
MAX_LAG = 100.0
# Smaller distances from the origin are rounding [m].
_MIN_DISTANCE = 1e-9
# Share of touches from which on a shift of the rows renames the touched points: the others have wrong names.
_MIN_RENAMED_SHARE = 0.75
# Largest rotation vector [rad] of which a smaller unit can be undone: longer ones have lost whole turns.
_MAX_SMALL_ROTATION = np.pi / ANGLES["deg"]


class Change(Protocol):
    """Change of measurements that undoes a mistake."""

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the changed measurements; None if the change does not apply to this kind."""
        ...


@frozen
class JointChange:
    """Other joint values: q becomes M·q + o."""

    matrix: tuple[tuple[float, ...], ...]  # M, shape (n, n)
    offsets: tuple[float, ...]  # o, shape (n,) [rad or m]

    @classmethod
    def of(
        cls,
        n: int,
        *,
        sources: Sequence[int] | None = None,
        factors: Sequence[float] | None = None,
        offsets: Sequence[float] | None = None,
        coupling: tuple[int, int, float] | None = None,
    ) -> JointChange:
        """Make a change of n joints in which everything that is not given stays as it is.

        `sources` (n,) are the columns that hold the joints. `coupling` is a joint, another one, and the
        multiple of the other one's values that is added.
        """
        matrix = np.eye(n)[list(sources if sources is not None else range(n))]
        matrix *= np.reshape(factors if factors is not None else np.ones(n), (n, 1))
        if coupling:
            joint, other, multiple = coupling
            matrix[joint, other] = multiple
        return cls(tuple(map(tuple, matrix.tolist())), tuple(offsets if offsets is not None else [0.0] * n))

    @cached_property
    def joints(self) -> frozenset[int]:
        """Numbers of the joints that change or are used; changes of different joints commute."""
        is_changed = np.array(self.matrix) != np.eye(len(self.offsets))
        used = is_changed.any(0) | is_changed.any(1) | (np.array(self.offsets) != 0)
        return frozenset(np.flatnonzero(used).tolist())

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the measurements at the changed joint positions."""
        if not item.configurations_per_row:
            return None
        return item.resample(item.configurations() @ np.transpose(self.matrix) + self.offsets)


@frozen
class RowShift:
    """Joint positions belong to the measured values `step` rows below them; of images, `step` images."""

    step: int  # 1 or -1

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the measured values with the joint positions of neighbouring rows."""
        if not item.configurations_per_row or len(item.rows) < 2:
            return None
        order = np.argsort(item.rows, kind="stable")
        if item.n_images:
            # The arm may return to a configuration: that is another stop.
            is_new = np.diff(label_stops(item)[order], prepend=-1) != 0
            places = np.empty(len(order), int)
            places[order] = np.cumsum(is_new) - 1 - self.step
            inside = (places >= 0) & (places < np.count_nonzero(is_new))
            return item.take(inside).resample(item.q[order[is_new]][places[inside]])
        gaps = np.diff(item.rows[order])
        if not np.any(gaps > 0):
            return None
        first = np.flatnonzero(gaps == gaps[gaps > 0].min())
        upper, lower = order[first], order[first + 1]
        joints, values = (upper, lower) if self.step > 0 else (lower, upper)
        if isinstance(item, PointContact) and _are_renamed(item.label[joints], item.label[values]):
            # The points are touched in turn: this changes their names only.
            return None
        q = item.configurations().reshape(item.configurations_per_row, len(item.rows), -1)[:, joints]
        return item.take(values).resample(q.reshape(-1, q.shape[-1]))


def _are_renamed(before: Array, after: Array) -> bool:
    """Return whether labels (m,) are the same ones with other names, but for a few samples."""
    counts = np.zeros((int(before.max()) + 1, int(after.max()) + 1), int)
    np.add.at(counts, (before, after), 1)
    pairs = zip(range(len(counts)), counts.argmax(1).tolist(), strict=True)
    # Label `i` becomes `j`, and no other label does.
    renamed = [counts[i, j] for i, j in pairs if counts[i, j] and counts[:, j].argmax() == i]
    return sum(renamed) >= _MIN_RENAMED_SHARE * len(before)


@frozen
class LengthChange:
    """Other unit of measured lengths."""

    factor: float  # Factor to all measured lengths and positions

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the measurements with scaled lengths."""
        if isinstance(item, PoseMeasurement):
            return _with_positions(item, self.factor * item.poses[:, :3, 3])
        if isinstance(item, PointMeasurement) and item.has_length_scale:
            return item.replace(values=self.factor * item.values)
        return None


@frozen
class AxisScale:
    """Measured coordinate that is too long by a factor."""

    axis: int  # Number of the coordinate
    factor: float  # Measured over true length

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the measurements with a scaled coordinate."""
        if not isinstance(item, Pose | Position | MultiTargetPosition):
            return None
        factors = np.ones(3)
        factors[self.axis] = 1 / self.factor
        return _with_positions(item, item.positions() * factors)


@frozen
class RangeChange:
    """Constant error of measured distances from the origin of the measuring frame."""

    error: float  # Measured less true distance [m]

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the measurements without this error."""
        if not isinstance(item, Pose | Position | MultiTargetPosition):
            return None
        distances = np.maximum(np.linalg.norm(item.positions(), axis=1), _MIN_DISTANCE)
        return _with_positions(item, item.positions() * (1 - self.error / distances)[:, None])


@frozen
class WireChange:
    """Constant error of the lengths of a wire."""

    wire: int  # Number of the wire
    error: float  # Measured less true length [m]

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the measurements without this error."""
        if not isinstance(item, Wires) or self.wire >= item.values.shape[1]:
            return None
        values = item.values.copy()
        values[:, self.wire] -= self.error
        return item.replace(values=values)


@frozen
class LagChange:
    """Joint positions that are earlier than the measured values."""

    lag: float  # Time between them, in seconds if the samples have times, else in rows

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the measured values with the joint positions at their time."""
        if item.configurations_per_row != 1:
            return None
        order = np.argsort(item.rows, kind="stable")
        times = np.empty(len(order))
        times[order] = np.arange(len(order))
        if item.recorded is not None and item.recorded.time is not None:
            times = item.recorded.time
        return item.resample(joint_path(times[order], item.q[order])(times + self.lag))


@frozen
class AxisChange:
    """Other axes of measured positions, rotations unchanged: axis i is sign_i times axis source_i as read."""

    sources: tuple[int, int, int]  # Column that holds each axis
    signs: tuple[int, int, int]  # 1 or -1 for each axis

    @property
    def is_right_handed(self) -> bool:
        """Whether the change is a rotation of the frame."""
        return bool(np.linalg.det(np.eye(3)[list(self.sources)]) * np.prod(self.signs) > 0)

    @property
    def is_turn(self) -> bool:
        """Whether the change is a rotation other than another order of the columns."""
        return self.is_right_handed and min(self.signs) < 0

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the measurements with changed positions."""
        if not isinstance(item, Pose | Position | MultiTargetPosition):
            return None
        return _with_positions(item, item.positions()[:, self.sources] * np.array(self.signs))


@frozen
class MirroredPoses:
    """Positions and rotations in a left-handed measuring frame."""

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the poses with the sign of z changed."""
        mirror = np.diag([1.0, 1.0, -1.0, 1.0])
        return _with_poses(item, mirror @ item.poses @ mirror) if isinstance(item, Pose) else None


@frozen
class QuaternionOrder:
    """Other order of the components of measured quaternions."""

    order: QuaternionNotation  # True order of the columns that were read in the other one

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the poses with the rotations of the reordered quaternions."""
        if not _notations([item]) <= _COMPUTED:
            return None
        # Read as w, x, y, z, the columns x, y, z, w have to move by one; the other way round, back.
        step = 1 if self.order == "xyzw" else -1
        return _with_rotations(
            item,
            lambda old: se3.quaternion_to_matrix(np.roll(se3.rotvec_to_quaternion(se3.log3(old)), step, 1)),
        )


@frozen
class InversePose:
    """Poses of one frame in another, in place of the other way round.

    The measured poses, or those of the flange that images have in place of joint values.
    """

    chain: Chain  # Robot that was measured

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the inverse poses."""
        if isinstance(item, PoseMeasurement):
            return _with_poses(item, se3.inverse(item.poses))
        return None if item.has_joint_values else _with_inverse_flange(self.chain, item)


def _with_inverse_flange(chain: Chain, item: Measurement) -> Measurement:
    """Return images with the inverse poses of the flange."""
    arm = chain.with_base_and_tool(np.eye(4), np.eye(4))
    different, number = np.unique(item.q, axis=0, return_inverse=True)
    q, differences = reach_poses(arm, se3.inverse(arm.poses(different)))
    if np.any(differences > MAX_POSE_DIFFERENCE):
        raise InvalidArgumentError(
            f"{item.source}: the robot does not reach the inverse poses; expected one that reaches them, "
            "such as flange.urdf"
        )
    return item.resample(q[number.reshape(-1)])


@frozen
class InverseRotation:
    """Inverse rotations beside correct positions."""

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the poses with inverse rotations."""
        return _with_rotations(item, lambda rotations: np.swapaxes(rotations, 1, 2))


@frozen
class RotationUnit:
    """Rotation vectors or Euler angles in radians that were read as degrees."""

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the poses with the numbers in radians."""
        if not isinstance(item, PoseMeasurement) or len(notations := _notations([item])) != 1:
            return None
        if notation := notations.pop():
            angles = ANGLES["deg"] * _numbers(item, notation)
            if np.abs(angles).max(initial=0.0) > 2 * np.pi:
                return None
            changed = _with_rotations(item, lambda _: _rotations(angles, notation))
            return changed and changed.with_euler_angles(notation, angles)
        vectors = se3.log3(item.poses[:, :3, :3])
        if np.linalg.norm(vectors, axis=1).max(initial=0.0) > _MAX_SMALL_ROTATION:
            return None
        return _with_rotations(item, lambda _: se3.exp3(ANGLES["deg"] * vectors))


# Notations of a rotation by three numbers.
_NOTATIONS: dict[str, str] = {ROTATION_VECTOR: "rotation vectors", **EULER_NOTATIONS}
# Notations of rotations that another program may have computed from Euler angles or quaternions.
_COMPUTED = {"", ROTATION_VECTOR}
# Notations that are tried both ways for these.
_USUAL_NOTATIONS = (ROTATION_VECTOR, "xyz", "zyx", "rpy", "zyz")


@frozen
class OtherNotation:
    """Rotations by three numbers of one notation that were read in another one."""

    read: str  # Keys of `_NOTATIONS`
    true: str

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the poses with the rotations of the true notation."""
        if not isinstance(item, PoseMeasurement) or not _notations([item]) <= {*_COMPUTED, self.read}:
            return None
        numbers = _numbers(item, self.read)
        changed = _with_rotations(item, lambda _: _rotations(numbers, self.true))
        if changed is None or self.read not in _notations([item]):
            return changed
        return changed.with_euler_angles(self.true, numbers)


def _rotations(numbers: Array, notation: str) -> Array:
    """Return the rotations (m, 3, 3) of three numbers each, (m, 3) [rad], in a notation."""
    return se3.exp3(numbers) if notation == ROTATION_VECTOR else angles_to_matrix(numbers, notation)


def _numbers(item: PoseMeasurement, notation: str) -> Array:
    """Return the numbers (m, 3) of rotations in a notation; those of the file where they are known."""
    rotations = item.poses[:, :3, :3]
    computed = se3.log3(rotations) if notation == ROTATION_VECTOR else matrix_to_angles(rotations, notation)
    # Other angles can give the same rotation in this notation, and another one in the true notation.
    is_known = (item.notations == notation)[:, None] & ~np.isnan(item.angles)
    return np.where(is_known, item.angles, computed)


def _notations(data: Sequence[Measurement]) -> set[str]:
    """Return the notations of rotations that were read from three numbers, and "" for other rotations."""
    return {text for item in data if isinstance(item, PoseMeasurement) for text in set(item.notations)}


def _with_positions(item: Measurement, positions: Array) -> Measurement:
    """Return measurements with other positions, (m, 3) [m]."""
    if isinstance(item, PoseMeasurement):
        poses = item.poses.copy()
        poses[:, :3, 3] = positions
        return item.replace(poses=poses)
    return item.replace(values=positions)


def _with_rotations(item: Measurement, change: Callable[[Array], Array]) -> PoseMeasurement | None:
    """Return poses whose rotations (m, 3, 3) are changed by a function."""
    if not isinstance(item, PoseMeasurement):
        return None
    poses = item.poses.copy()
    poses[:, :3, :3] = change(item.poses[:, :3, :3])
    return _with_poses(item, poses)


def _with_poses(item: PoseMeasurement, poses: Array) -> PoseMeasurement:
    """Return measurements with other poses (m, 4, 4), whose Euler angles are not known."""
    return item.replace(poses=poses, angles=np.full_like(item.angles, np.nan))


@frozen
class Hypothesis:
    """Assumption about what was mixed up."""

    key: str  #: Short name, by which users select the change; empty if only the robot file may be wrong.
    description: str  #: What was mixed up, as a clause.
    change: Change  #: Change that undoes it.
    #: What may be wrong instead of the measurements, with the same effect; empty if nothing may.
    instead: str = ""

    @property
    def offsets(self) -> dict[int, float]:
        """Summands of the joints whose zeros are changed, by their numbers [rad or m]."""
        offsets = self.change.offsets if isinstance(self.change, JointChange) else ()
        return {j: offset for j, offset in enumerate(offsets) if offset}

    def apply(self, data: Sequence[Measurement]) -> list[Measurement] | None:
        """Undo the mistake in measurements."""
        changed = [self.change.apply(item) for item in data]
        if all(item is None for item in changed):
            return None
        return [old if new is None else new for new, old in zip(changed, data, strict=True)]

    @property
    def concerns_joints(self) -> bool:
        """Whether only the joint positions of the samples are changed."""
        if isinstance(self.change, BothChanges):
            return self.change.first.concerns_joints and self.change.second.concerns_joints
        return isinstance(self.change, JointChange | RowShift)

    @property
    def parts(self) -> tuple[Hypothesis, ...]:
        """Single mistakes that it consists of."""
        if isinstance(self.change, BothChanges):
            return (*self.change.first.parts, *self.change.second.parts)
        return (self,)

    @property
    def changes_joints(self) -> bool:
        """Whether one of its mistakes is about the joint columns."""
        return any(isinstance(part.change, JointChange) for part in self.parts)

    @property
    def row_step(self) -> int:
        """Number of rows by which the joint positions are moved."""
        return sum(part.change.step for part in self.parts if isinstance(part.change, RowShift))

    def log_jacobian(self, chain: Chain, data: Sequence[Measurement]) -> float:
        """Return the logarithm of the determinant of the change of the measured values."""
        if isinstance(self.change, BothChanges):
            first, second = self.change.first, self.change.second
            changed = first.apply(data) or data
            return first.log_jacobian(chain, data) + second.log_jacobian(chain, changed)
        if isinstance(self.change, JointChange):
            return sum(_log_contact_jacobian(chain, item, self.change) for item in data if item.is_contact)
        if isinstance(self.change, AxisScale):
            n_values = sum(len(item.rows) for item in data if self.change.apply(item) is not None)
            return float(max(0, n_values - 1) * -np.log(self.change.factor))
        if not isinstance(self.change, LengthChange):
            return 0.0
        n_lengths = sum(_count_lengths(item) for item in data if self.change.apply(item) is not None)
        # The places of instrument and target scale with the lengths.
        return float(max(0, n_lengths - N_PLACES) * np.log(self.change.factor))


def _log_contact_jacobian(chain: Chain, item: Measurement, change: JointChange) -> float:
    """Return the logarithm of the change of the joint values that hold the tool at touched points."""
    # Joint values are what a contact measures: a small factor makes their noise small, too. The combinations
    # of them that move the tool count, but for those that determine the points.
    matrix = np.array(change.matrix)
    if np.allclose(matrix @ matrix.T, np.eye(len(matrix))):
        return 0.0
    jacobian = tool_pose_and_jacobian(chain, item.configurations() @ matrix.T)[1][:, :3]
    before, after = (
        np.linalg.slogdet(each @ np.swapaxes(each, 1, 2) + _MIN_MOTION**2 * np.eye(3))[1]
        for each in (jacobian, jacobian @ matrix)
    )
    share = 1 - len(item.instrument_parameters) / (item.residual_dim * len(item.rows))
    return 0.5 * max(0.0, share) * float(np.sum(after - before))


def _count_lengths(item: Measurement) -> int:
    """Return the number of measured lengths; the size of a touched object is given, not measured."""
    if item.is_contact:
        return 0
    return 3 * len(item.rows) if isinstance(item, PoseMeasurement) else item.residual_dim * len(item.rows)


@frozen
class BothChanges:
    """Two changes, one after the other."""

    first: Hypothesis
    second: Hypothesis

    def apply(self, item: Measurement) -> Measurement | None:
        """Return the measurements after both changes; None if neither applies."""
        changed = self.first.change.apply(item)
        both = self.second.change.apply(item if changed is None else changed)
        return changed if both is None else both


def both(first: Hypothesis, second: Hypothesis) -> Hypothesis:
    """Return the hypothesis that two mistakes were made; the changes are undone in this order."""
    return Hypothesis(
        f"{first.key}{_AND}{second.key}",
        f"{first.description}, and {second.description}",
        BothChanges(first, second),
        # If only one of them may be elsewhere, the measurements have to be corrected all the same.
        f"{first.instead} and {second.instead}" if first.instead and second.instead else "",
    )


def list_hypotheses(chain: Chain, data: Sequence[Measurement]) -> Iterator[Hypothesis]:
    """List the hypotheses about measurements of a robot, the simpler ones first."""
    yield from _joint_hypotheses(chain)
    yield from _order_hypotheses(chain)
    yield from _unit_hypotheses(chain, data)
    yield from _axis_unit_hypotheses(data)
    for step, side in ((1, "above"), (-1, "below")):
        yield Hypothesis(
            f"rows:{side}", f"each row holds the joint values of the row {side}", RowShift(-step)
        )
    if any(isinstance(item, Pose) for item in data):
        # The notation of angles is mistaken more often than a frame that turns with it.
        yield from _rotation_hypotheses(data)
        yield from _pose_hypotheses()
        yield from _turn_hypotheses()
    else:
        # Positions alone are the same in all left-handed frames, up to a rotation of the base.
        yield Hypothesis("axes:x,y,-z", "the measuring frame is mirrored", AxisChange((0, 1, 2), (1, 1, -1)))
    text = "the poses are inverse, of the measuring frame in the tool frame"
    yield Hypothesis("poses:inverse", text, InversePose(chain))
    yield Hypothesis("rotations:inverse", "the measured rotations are inverse", InverseRotation())


def mend(chain: Chain, data: Measurement, key: str) -> Measurement:
    """Undo a mistake in measurements, such as the wrong sign of a joint, or several with + between them."""
    return mend_files(chain, [data], key)[0]


def mend_files(chain: Chain, data: Sequence[Measurement], key: str) -> list[Measurement]:
    """Undo a mistake in all measurements to which it applies."""
    change = _change_of_size(key) or _change_of_joint(chain, key)
    if change is None:
        by_key = {hypothesis.key: hypothesis for hypothesis in list_hypotheses(chain, data)}
        if key not in by_key:
            for at in re.finditer(re.escape(_AND), key):
                first, rest = key[: at.start()], key[at.end() :]
                if first in by_key or _change_of_joint(chain, first):
                    return mend_files(chain, mend_files(chain, data, first), rest)
            near = difflib.get_close_matches(key, by_key, 3, 0.0)
            sizes = "ratio", "lag", "scale", "range", "wire"
            kinds = dict.fromkeys([*(known.partition(":")[0] for known in by_key), *sizes])
            raise UnknownNameError(
                f"--mend {key!r}: unknown change; choose one such as {', '.join(near)}; kinds of changes are "
                f"{', '.join(kinds)}"
            )
        change = by_key[key].change
    changed = Hypothesis(key, "", change).apply(data)
    if changed is None:
        kinds = " and ".join(dict.fromkeys(item.kind for item in data))
        raise UnknownNameError(f"--mend {key!r}: does not apply to measurements of kind {kinds}")
    return changed


def mend_lines(
    chain: Chain, data: Sequence[Measurement], key: str, lines: tuple[int, int]
) -> list[Measurement]:
    """Undo a mistake in the samples from the first to the last of two lines of a file."""
    first, last = lines
    inside = [(item.rows >= first) & (item.rows <= last) for item in data]
    if not any(mask.any() for mask in inside):
        raise InvalidArgumentError(f"--mend {key!r}: no samples in lines {first} to {last}")
    parts = mend_files(chain, [item.take(mask) for item, mask in zip(data, inside, strict=True)], key)
    mended = []
    for item, part, mask in zip(data, parts, inside, strict=True):
        # A shift of the rows leaves out the sample at one end.
        whole = concatenate([part, item.take(~mask)])
        mended.append(whole.take(np.argsort(whole.rows, kind="stable")))
    return mended


def _change_of_size(key: str) -> Change | None:
    """Return the change of a key such as `lag:TIME` or `scale:AXIS:FACTOR`, or None."""
    for pattern, middle, limit, what, change_of in _SIZES:
        if found := re.fullmatch(f"{pattern}:([-+0-9.e]+)", key):
            *of, number = found.groups()
            with suppress(ValueError):
                value = float(number)
                if abs(value - middle) <= limit:
                    return change_of(value, *of)
            expected = f"{what} from {middle - limit:g} to {middle + limit:g}"
            raise InvalidArgumentError(f"--mend {key!r}: {number} is not possible; expected {expected}")
    return None


# Changes of a size: pattern of the key, size without an effect, largest change of the size, what it is,
# and the change.
_SIZES: tuple[tuple[str, float, float, str, Callable[..., Change]], ...] = (
    ("lag", 0.0, MAX_LAG, "a time", LagChange),
    ("range", 0.0, MAX_RANGE_ERROR, "a length in m", RangeChange),
    ("wire:([1-9])", 0.0, MAX_RANGE_ERROR, "a length in m", lambda x, of: WireChange(int(of) - 1, x)),
    ("scale", 1.0, MAX_SCALE_CHANGE, "a factor", lambda x: LengthChange(1 / x)),
    ("scale:([xyz])", 1.0, MAX_SCALE_CHANGE, "a factor", lambda x, of: AxisScale("xyz".index(of), x)),
)


def _change_of_joint(chain: Chain, key: str) -> Change | None:
    """Return the change `zero:JOINT:ANGLEdeg` or `ratio:JOINT:FACTOR`; None for other keys."""
    found = re.fullmatch(r"(?:(zero)|ratio):(.+):([-+]?[0-9.]+)(?(1)deg)", key)
    joints = {chain.joint_names[j]: [j] for j in range(chain.n_joints)}
    if found and not found[1]:
        joints[ALL] = revolute_joints(chain)
    if found is None or found[2] not in joints:
        return None
    members = joints[found[2]]
    with suppress(ValueError):
        size = float(found[3])
        if not found[1]:
            return ratio_hypothesis(chain, members, size).change if size > 0 else None
        if members[0] in revolute_joints(chain):
            return zero_hypothesis(chain, members[0], -size).change
    return None


def zero_hypothesis(chain: Chain, joint: int, wrong: float) -> Hypothesis:
    """Return the hypothesis that the zero of a revolute joint is off by an angle [deg]."""
    name, n = chain.joint_names[joint], chain.n_joints
    offsets = [np.deg2rad(-wrong) if i == joint else 0.0 for i in range(n)]
    text = f"the zero of joint {name} is off by {wrong:g} deg"
    change = JointChange.of(n, offsets=offsets)
    return Hypothesis(f"zero:{name}:{-wrong:+g}deg", text, change, f"the zero of joint {name}{_IN_ROBOT}")


def ratio_hypothesis(chain: Chain, joints: Sequence[int], factor: float) -> Hypothesis:
    """Return the hypothesis that the values of a joint, or of all revolute ones, need a factor."""
    name = chain.joint_names[joints[0]] if len(joints) == 1 else ALL
    of_joints = f"joint {name}" if len(joints) == 1 else "all revolute joints"
    text = f"the values of {of_joints} are {_times(factor)}, as with a wrong gear ratio"
    factors = [factor if j in joints else 1.0 for j in range(chain.n_joints)]
    change = JointChange.of(chain.n_joints, factors=factors)
    instead = f"the gear ratio of {of_joints} in the controller"
    return Hypothesis(f"ratio:{name}:{factor:.4g}", text, change, instead)


def revolute_joints(chain: Chain) -> list[int]:
    """Return the numbers of the revolute joints."""
    return [j for j in range(chain.n_joints) if not chain.is_prismatic[j]]


def inner_revolute_joints(chain: Chain) -> list[int]:
    """Return the numbers of the joints whose zeros base and tool cannot absorb."""
    return [j for j in revolute_joints(chain) if 0 < j < chain.n_joints - 1]


def _joint_hypotheses(chain: Chain) -> Iterator[Hypothesis]:
    """Yield wrong signs, zeros and couplings."""
    n = chain.n_joints
    for j, name in enumerate(chain.joint_names):
        signs = [-1 if i == j else 1 for i in range(n)]
        text = f"the sign of joint {name} is wrong"
        change = JointChange.of(n, factors=signs)
        yield Hypothesis(f"sign:{name}", text, change, f"the axis of joint {name}{_IN_ROBOT}")
    change = JointChange.of(n, factors=[-1] * n)
    text = "the signs of all joints are wrong"
    yield Hypothesis(f"sign:{ALL}", text, change, f"the axes of all joints{_IN_ROBOT}")
    for j, wrong in product(inner_revolute_joints(chain), (90, -90, 180)):
        yield zero_hypothesis(chain, j, wrong)
    revolute = revolute_joints(chain)
    for (other, j), (sign, done) in product(pairwise(revolute), ((1, "subtracted from"), (-1, "added to"))):
        name, text = chain.joint_names[j], "-+"[sign > 0] + chain.joint_names[other]
        yield Hypothesis(
            f"coupling:{name}:{text}",
            f"the values of joint {text[1:]} are {done} those of joint {name}, as with coupled joints",
            JointChange.of(n, coupling=(j, other, sign)),
            f"the coupling of joint {name} in the controller",
        )


def _order_hypotheses(chain: Chain) -> Iterator[Hypothesis]:
    """Yield exchanged and shifted joint columns."""
    n, names = chain.n_joints, chain.joint_names
    for i, j in combinations(range(n), 2):
        sources = list(range(n))
        sources[i], sources[j] = j, i
        text = f"the columns of joints {names[i]} and {names[j]} are exchanged"
        change = JointChange.of(n, sources=sources)
        instead = f"the order of joints {names[i]} and {names[j]}{_IN_ROBOT}"
        yield Hypothesis(f"swap:{names[i]}:{names[j]}", text, change, instead)
    orders = {
        "-1": ((*range(1, n), 0), "shifted by one"),
        "+1": ((n - 1, *range(n - 1)), "shifted by one"),
        "reversed": (tuple(range(n))[::-1], "in reverse order"),
        # As the joint states of ROS.
        "alphabetical": (tuple(map(sorted(names).index, names)), "in alphabetical order"),
    }
    tried = {tuple(range(n))}
    for key, (sources, text) in orders.items():
        # An order that exchanges two columns is listed above.
        if sources in tried or np.sum(np.array(sources) != np.arange(n)) == 2:
            continue
        tried.add(sources)
        change = JointChange.of(n, sources=sources)
        instead = f"the order of the joints{_IN_ROBOT}"
        yield Hypothesis(f"columns:{key}", f"the joint columns are {text}", change, instead)


def _unit_hypotheses(chain: Chain, data: Sequence[Measurement]) -> Iterator[Hypothesis]:
    """Yield wrong units of joints, lengths, and rotation vectors or Euler angles."""
    n, revolute = chain.n_joints, revolute_joints(chain)
    # A servo file states the unit of counts.
    has_units = not any(item.has_counts for item in data)
    for members, kind, large, small, factor in (
        (revolute if has_units else [], "revolute", "deg", "rad", ANGLES["deg"]),
        ([j for j in range(n) if j not in revolute], "prismatic", "mm", "m", LENGTHS["mm"]),
    ):
        groups = [members, *([j] for j in members if len(members) > 1)] if members else []
        for group in groups:
            is_single = len(group) == 1
            name = chain.joint_names[group[0]] if is_single else ""
            key, label = (f"joint:{name}", f"joint {name}") if is_single else ("joints", f"all {kind} joints")
            for true, read, value in ((large, small, 1 / factor), (small, large, factor)):
                factors = [value if i in group else 1.0 for i in range(n)]
                text = f"the values of {label} are {describe_misread(true, read, value)}"
                yield Hypothesis(f"{key}:{true}-not-{read}", text, JointChange.of(n, factors=factors))
    for true, read in (*permutations(("m", "mm", "in"), 2), *permutations(("mm", "cm"), 2)):
        factor = LENGTHS[read] / LENGTHS[true]
        text = f"measured lengths are {describe_misread(true, read, factor)}"
        yield Hypothesis(f"lengths:{true}-not-{read}", text, LengthChange(factor), f"the lengths{_IN_ROBOT}")
    numbers = "rotation vectors" if _notations(data) & _COMPUTED else "Euler angles"
    text = f"measured {numbers} are {describe_misread('rad', 'deg', ANGLES['deg'])}"
    yield Hypothesis("rotations:rad-not-deg", text, RotationUnit())


def describe_misread(true: str, read: str, factor: float) -> str:
    """Describe values that a factor corrects; their unit in the file may be another one than `read`."""
    return f"{_times(factor)}, as if {true} had been read as {read}"


def _times(factor: float) -> str:
    """Describe the size of values that a factor corrects."""
    return f"{factor:.4g} times too small" if factor > 1 else f"{1 / factor:.4g} times too large"


def _axis_unit_hypotheses(data: Sequence[Measurement]) -> Iterator[Hypothesis]:
    """Yield another unit of one measured coordinate, if it spreads far less or far more than the others."""
    spreads = np.sum([item.positions().std(0) for item in data if len(item.positions())] or [np.ones(3)], 0)
    for (i, axis), (true, read) in product(enumerate("xyz"), (("m", "mm"), ("mm", "m"))):
        factor = LENGTHS[true] / LENGTHS[read]
        expected = max(np.delete(spreads, i)) * np.sqrt(factor)
        if (spreads[i] < expected) if factor < 1 else (spreads[i] > expected):
            text = f"measured {axis} is {describe_misread(true, read, 1 / factor)}"
            yield Hypothesis(f"{axis}:{true}-not-{read}", text, AxisScale(i, factor))


def _pose_hypotheses() -> Iterator[Hypothesis]:
    """Yield other axes of the positions beside the rotations."""
    for i, axis in enumerate("xyz"):
        x, y, z = (-1 if j == i else 1 for j in range(3))
        yield _axis_hypothesis((0, 1, 2), (x, y, z), f"the sign of measured {axis} is wrong")
    yield Hypothesis("frame:left-handed", "positions and rotations are mirrored", MirroredPoses())
    yield _axis_hypothesis((0, 1, 2), (-1, -1, -1), "the signs of measured x, y and z are wrong")
    for sources, text in (
        ((1, 0, 2), "measured x and y are exchanged"),
        ((2, 1, 0), "measured x and z are exchanged"),
        ((0, 2, 1), "measured y and z are exchanged"),
        ((1, 2, 0), "measured x, y and z are shifted by one column"),
        ((2, 0, 1), "measured x, y and z are shifted by one column"),
    ):
        yield _axis_hypothesis(sources, (1, 1, 1), text)


def _rotation_hypotheses(data: Sequence[Measurement]) -> Iterator[Hypothesis]:
    """Yield the other notations that the rotations may have; they start from the notation that was read."""
    notations = _notations(data)
    known = sorted(notations - {""})
    pairs = [(read, true) for read in known for true in _NOTATIONS if true != read]
    if notations & _COMPUTED:
        for order in QUATERNION_ORDERS:
            text = f"quaternions are in the order {' '.join(order)}, but were read in the other one"
            if "" not in notations:
                text = f"the rotation vectors come from quaternions: {text}"
            yield Hypothesis(f"quaternions:{order}", text, QuaternionOrder(order))
        pairs += permutations(_USUAL_NOTATIONS, 2)
    for read, true in dict.fromkeys(pairs):
        verb = "read" if read in known else "taken"
        text = f"the rotations are {_NOTATIONS[true]}, but were {verb} as {_NOTATIONS[read]}"
        yield Hypothesis(f"rotations:{true}-not-{read}", text, OtherNotation(read, true))


def _turn_hypotheses() -> Iterator[Hypothesis]:
    """Yield frames of the positions that are turned against that of the rotations."""
    # Such a turn has the same effect as some orders of Euler angles, and as two mistakes about the axes.
    for (x, y, z), (i, j, k) in product(permutations(range(3)), product((1, -1), repeat=3)):
        sources, signs = (x, y, z), (i, j, k)
        if AxisChange(sources, signs).is_turn:
            axes = _axes_text(sources, signs, ", ")
            text = f"the frame of the positions is turned: their {axes} are x, y, z of the rotations"
            yield _axis_hypothesis(sources, signs, text)


def _axis_hypothesis(
    sources: tuple[int, int, int], signs: tuple[int, int, int], description: str
) -> Hypothesis:
    """Return a hypothesis about the axes of measured positions; its key lists the true x, y and z."""
    return Hypothesis(f"axes:{_axes_text(sources, signs, ',')}", description, AxisChange(sources, signs))


def _axes_text(sources: Sequence[int], signs: Sequence[int], separator: str) -> str:
    """Return axes with their signs, such as y,-x,z."""
    return separator.join(
        "-" * (sign < 0) + "xyz"[source] for source, sign in zip(sources, signs, strict=True)
    )
