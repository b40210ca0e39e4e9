"""Extraction of DH tables from joint origins by common normals.

Any rigid motion O between two joint axes can be written as

    O = Rz(t1)·Tz(d1) · Tx(a)·Rx(α)·Ry(β) · Tz(d2)·Rz(t2).

Rotations about z and translations along z commute with the motion of the joint on that axis. Therefore (t1,
d1) belong to θ and d of the joint before the origin, and (t2, d2) to those of the joint after it. With β = 0
the other numbers are those of the common normal of the two axes.

Where two axes are nearly parallel, the common normal lies far outside the robot (hundreds of metres for a
milliradian) and jumps with every correction. There β takes up the tilt (Hayati & Mirmirani 1985), and the row
passes through an origin of the robot description instead of the foot of the common normal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..exceptions import InvalidArgumentError
from .dh import CONVENTIONS, Convention, DHTable, axis_rotation, axis_translation

# Below this tilt [rad] two axes are regarded as parallel up to tolerances. A plain row may have acceptable
# offsets by chance, but they change by a / tilt per radian of correction.
NEARLY_PARALLEL_RAD = np.radians(1.0)

# The larger threshold [rad] that applies where Hayati's β is requested.
HAYATI_MAX_RAD = np.radians(5.0)

# Plain rows with offsets above this multiple of the arm length are replaced by rows with β. A foot of a
# common normal is never farther than |p| / sin(tilt), so 2 is exceeded only below 30° of tilt, where β is
# safe.
MAX_OFFSET_RATIO = 2.0

# A tool axis that passes the last joint axis within this fraction of the arm length is regarded as
# coincident.
COINCIDENT_RTOL = 0.01

# Offsets are regarded as cancelling if moving the frames along their axes shortens the chain to this
# fraction.
SHORTER_RATIO = 2 / 3

# Tolerance for rounding: radians from a quarter turn, and lengths as a fraction of the arm length.
QUARTER_TURN_TOL = 5e-15

# Rotations within this distance of 90° [rad] rank equally, so that tolerances do not choose between two rows.
_RIGHT_ANGLE_BAND = 0.05


@frozen
class Extraction:
    """DH table and the frames of its x axes in the robot.

    Frame F_i is the point of row i between Tx(a)·Rx(α) and Ry(β). It is given in the frame whose origin row i
    determines: ``origins[i+1]`` (joint i+2 or the tool, counted from 1) in the standard convention and
    ``origins[i]`` (joint i+1) in the modified one. A change of a, α or β of row i by ε, of any size, is

        origins[·] ← origins[·] · F_i · exp(ε ξ) · F_i⁻¹

    with ξ along x, about x or about y. Changes of θ and d act about and along z of the joint's own frame.
    """

    table: DHTable  #: Table with base and tool; its poses are those of the origins at every q.
    frames: Array  #: Frames F_i, shape (n, 4, 4) [m].
    notes: tuple[str, ...]  #: One sentence for every pair of axes whose row has β.


@frozen
class _OriginParameters:
    """The seven parameters of an origin [rad and m]; see the module docstring."""

    t1: float = 0.0
    d1: float = 0.0
    a: float = 0.0
    alpha: float = 0.0
    beta: float = 0.0
    d2: float = 0.0
    t2: float = 0.0
    plain_offset: float = 0.0  # Largest offset that a row without β would need [m]

    @property
    def before(self) -> Array:
        """Rz(t1)·Tz(d1), shape (4, 4)."""
        return _screw_transform(self.t1, self.d1)

    @property
    def link(self) -> Array:
        """Tx(a)·Rx(α)·Ry(β), shape (4, 4)."""
        return axis_translation(0, np.array(self.a)) @ axis_rotation(0, np.array(self.alpha)) @ self.tilt

    @property
    def tilt(self) -> Array:
        """Ry(β), shape (4, 4)."""
        return axis_rotation(1, np.array(self.beta))

    @property
    def after(self) -> Array:
        """Tz(d2)·Rz(t2), shape (4, 4)."""
        return _screw_transform(self.t2, self.d2)


def extract_dh(
    origins: ArrayLike,
    names: Sequence[str],
    prismatic: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    convention: Convention = "standard",
    hayati: bool = False,
) -> Extraction:
    """Extract the DH table of a chain whose joints all move about or along their own z axes.

    A pair of axes gets a plain row, unless it is tilted by less than 1° (5° with ``hayati``), or the offsets
    of the plain row exceed twice the sum of all distances in the chain; then the row has β. Exactly parallel
    axes need no β: α is 0 or π, and the offset along the axes goes to the row of its own origin.

    The base contains the origin of joint 1, except for the offset along an axis that is upright. The tool is
    treated in the same way if it is in line with the last axis up to tolerances. Rotating x by half a turn
    negates a, α and β; of these two forms of a row, the one with the smaller residual rotation is chosen. The
    origins of a table with identity base and tool therefore give that table back.

    The origins are the pose of joint 1 in the base, of joint i+1 in the moving frame of joint i, and of the
    tool in the moving frame of joint n, shape (n+1, 4, 4) [m].
    """
    origins = np.asarray(origins, float)
    n = len(names)
    if convention not in CONVENTIONS:
        raise InvalidArgumentError(f"unknown convention {convention!r}; choose from {', '.join(CONVENTIONS)}")
    if origins.shape != (n + 1, 4, 4):
        raise InvalidArgumentError(
            f"origins have shape {origins.shape}; expected ({n + 1}, 4, 4) for {n} joints and the tool"
        )
    if not np.isfinite(origins).all():
        raise InvalidArgumentError("origins have a value that is not finite; expected finite numbers")
    arm_length = float(np.linalg.norm(origins[:, :3, 3], axis=1).sum()) or 1.0
    max_tilt = HAYATI_MAX_RAD if hayati else NEARLY_PARALLEL_RAD
    standard = convention == "standard"
    # A standard row ends with Ry(β), so t2 and d2 should vanish; a modified row begins with Tx(a), so t1 and
    # d1 should vanish.
    base, first = _base_transform(origins[0], arm_length, max_tilt, standard)
    parts = [first]
    for origin in origins[1:] if standard else origins[1:-1]:
        parts.append(_split_origin(origin, parts[-1].t2, arm_length, max_tilt, offset_first=standard))
    tool = origins[-1]
    if standard and _is_tool_aligned(parts[-1], arm_length):
        parts[-1] = _aligned_tool_row(parts[-1])
        tool = se3.inverse(parts[-1].before @ parts[-1].link) @ tool
    elif standard:
        tool = parts[-1].after
    links = parts[1:] if standard else parts
    # θ and d of joint i are the end of parts[i] plus the beginning of the next origin.
    theta = [part.t2 for part in parts[:n]]
    d = [part.d2 for part in parts[:n]]
    for i, next_part in enumerate(parts[1:]):
        theta[i] += next_part.t1
        d[i] += next_part.d1
    table = DHTable(
        convention,
        tuple(names),
        np.asarray(prismatic, bool),
        np.array([_angle(t) for t in theta]),
        np.array([_length(x, arm_length) for x in d]),
        np.array([part.a for part in links]),
        np.array([part.alpha for part in links]),
        np.array([part.beta for part in links]),
        np.asarray(lower, float),
        np.asarray(upper, float),
        base,
        tool,
    )
    after = [link.after for link in links[:-1]] + [tool if standard else links[-1].after]
    frames = [se3.inverse(link.tilt @ motion) for link, motion in zip(links, after, strict=True)]
    axes = ["the base's z axis", *(f"the axis of {name}" for name in names), "the tool's z axis"]
    pairs = zip(axes[standard:], axes[standard + 1 :], strict=False)
    notes = [_note(link, pair) for link, pair in zip(links, pairs, strict=False) if link.beta]
    return Extraction(table, np.array(frames), tuple(notes))


def normalize_offsets(table: DHTable) -> DHTable:
    """Remove large offsets that only cancel each other; most tables are returned unchanged."""
    # Plain rows of axes that are parallel up to a milliradian have their common normals far outside the
    # robot. Each joint frame is moved along its own axis, back to where the axis passes the frame before;
    # this changes no pose. The result is used if it shortens the whole chain by a third or more; its rows
    # then have β.
    origins = table.origins()
    moved = origins.copy()
    shift = 0.0
    for i in range(1, len(origins)):
        moved[i] = axis_translation(2, np.array(-shift)) @ moved[i]
        is_last = i == len(origins) - 1
        shift = 0.0
        if not is_last and QUARTER_TURN_TOL < _tilt(moved[i]) < NEARLY_PARALLEL_RAD:
            shift = -moved[i][2, 3] / moved[i][2, 2]
            moved[i] = moved[i] @ axis_translation(2, np.array(shift))
    before, after = (np.linalg.norm(chain[:, :3, 3], axis=1).sum() for chain in (origins, moved))
    if after > SHORTER_RATIO * before:
        return table
    extraction = extract_dh(moved, table.names, table.prismatic, table.lower, table.upper, table.convention)
    return replace(extraction.table, continuous=table.continuous)


def _base_transform(
    origin: Array, arm_length: float, max_tilt: float, standard: bool
) -> tuple[Array, _OriginParameters]:
    """Split the origin of joint 1 between base and row 1."""
    # The base can contain any motion, so it takes everything except the offset along an upright axis 1. Only
    # an origin that already is a modified row goes to the table.
    row = _split_origin(origin, 0.0, arm_length, max_tilt, offset_first=False)
    if not standard and row.t1 == 0 and row.d1 == 0:
        return np.eye(4), row
    offset = _OriginParameters(d2=row.d2 if _tilt(origin) < max_tilt else 0.0)
    return origin @ se3.inverse(offset.after), offset


def _split_origin(
    origin: Array, previous_t2: float, arm_length: float, max_tilt: float, offset_first: bool
) -> _OriginParameters:
    """Split an origin (4, 4) into its seven parameters, behind a joint with the rotation `previous_t2`."""
    # For a row with β, the free offset goes to d1 if `offset_first`, else to d2.
    tilt = _tilt(origin)
    t1, d2 = _common_normal(origin) if tilt > QUARTER_TURN_TOL else (0.0, 0.0)
    offset = max(abs(origin[2, 3] - d2 * origin[2, 2]), abs(d2))
    if tilt < max_tilt or offset > MAX_OFFSET_RATIO * arm_length:
        t1, d2 = _row_through_origin(origin, arm_length, offset_first)

    def preference(part: _OriginParameters) -> tuple[int, int, bool, bool]:
        residual = part.t2 if offset_first else part.t1
        return _rotation_rank(residual), _rotation_rank(previous_t2 + part.t1), part.a < 0, part.alpha < 0

    # Rotating x by half a turn negates a, α and β. Tables are written in the form with the smaller residual
    # rotation; ties are decided by the smaller θ, then by positive a and α.
    forms = (_remaining_parameters(origin, t, d2, arm_length, offset) for t in (t1, t1 + np.pi))
    return min(forms, key=preference)


def _tilt(origin: Array) -> float:
    """Return the angle between the lines of the two z axes, 0 to π/2 [rad]."""
    return float(np.arctan2(np.hypot(origin[0, 2], origin[1, 2]), abs(origin[2, 2])))


def _rotation_rank(angle: float) -> int:
    """Return 0, 1 or 2 for a rotation below, about or above 90°."""
    excess = abs(math.remainder(angle, 2 * np.pi)) - np.pi / 2
    return 1 if abs(excess) < _RIGHT_ANGLE_BAND else 2 * int(excess > 0)


def _common_normal(origin: Array) -> tuple[float, float]:
    """Return t1 and d2 of the plain row: x along z × z_next, and d2 from the foot to the next origin."""
    sine = np.hypot(origin[0, 2], origin[1, 2])
    t1 = np.arctan2(origin[0, 2], -origin[1, 2])
    distance = np.cos(t1) * origin[1, 3] - np.sin(t1) * origin[0, 3]
    return float(t1), float(-distance / sine)


def _row_through_origin(origin: Array, arm_length: float, offset_first: bool) -> tuple[float, float]:
    """Return t1 and d2 of a row with β through the next origin (`offset_first`: d2 = 0) or the first one."""
    rotation, p = origin[:3, :3], origin[:3, 3]
    d2 = 0.0 if offset_first else float(p[2] / rotation[2, 2])
    x, y, _ = p - d2 * rotation[:, 2]
    if np.hypot(x, y) > QUARTER_TURN_TOL * arm_length:
        return float(np.arctan2(y, x)), d2
    if offset_first:  # The axes meet at this point, so x is arbitrary; this choice makes t2 zero.
        sign = np.sign(rotation[2, 2])
        return float(np.arctan2(-sign * rotation[0, 1], sign * rotation[1, 1])), d2
    return 0.0, d2


def _remaining_parameters(
    origin: Array, t1: float, d2: float, arm_length: float, offset: float
) -> _OriginParameters:
    """Compute the other five parameters from t1 and d2, each after removing the ones before it."""
    rotation = axis_rotation(2, np.array(-t1))[:3, :3] @ origin[:3, :3]
    foot = origin[:3, 3] - d2 * origin[:3, 2]
    beta = np.arctan2(rotation[0, 2], np.hypot(rotation[1, 2], rotation[2, 2]))
    return _OriginParameters(
        t1=_angle(t1),
        d1=_length(foot[2], arm_length),
        a=_length(np.cos(t1) * foot[0] + np.sin(t1) * foot[1], arm_length),
        alpha=_angle(np.arctan2(-rotation[1, 2], rotation[2, 2])),
        beta=_angle(beta),
        d2=_length(d2, arm_length),
        t2=_angle(np.arctan2(-rotation[0, 1], rotation[0, 0])),
        plain_offset=offset,
    )


def _is_tool_aligned(part: _OriginParameters, arm_length: float) -> bool:
    """Return whether the z axis of the tool is the last joint axis up to tolerances."""
    return part.beta != 0 and abs(part.a) < COINCIDENT_RTOL * arm_length


def _aligned_tool_row(part: _OriginParameters) -> _OriginParameters:
    """Return the row of an aligned tool: only d1 and α, so that tolerances do not determine x."""
    return _OriginParameters(d1=part.d1, alpha=_angle(round(part.alpha / np.pi) * np.pi))


def _angle(value: float) -> float:
    """Wrap an angle into (-π, π], with exact quarter turns and without negative zero [rad]."""
    value = float(value)
    quarters = round(value / (np.pi / 2))
    if abs(value - quarters * (np.pi / 2)) < QUARTER_TURN_TOL:
        return ((quarters + 1) % 4 - 1) * (np.pi / 2)
    return math.remainder(value, 2 * np.pi)


def _length(value: float, arm_length: float) -> float:
    """Return a length, or zero if it is below rounding [m]."""
    return 0.0 if abs(value) < QUARTER_TURN_TOL * arm_length else float(value)


def _screw_transform(angle: float, offset: float) -> Array:
    """Compute Rz(angle)·Tz(offset), shape (4, 4)."""
    return axis_rotation(2, np.array(angle)) @ axis_translation(2, np.array(offset))


def _note(part: _OriginParameters, axes: tuple[str, str]) -> str:
    """Explain why a row has β."""
    return (
        f"{axes[0]} and {axes[1]} are {1e3 * _tilt(part.link):.3g} mrad from parallel: the row between them "
        f"has Hayati's beta, because a row without beta would need an offset of {part.plain_offset:.3g} m"
    )
