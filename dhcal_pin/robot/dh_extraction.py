"""DH tables from joint origins, by common normals.

Any origin between two axes is a row with a turn and a slide on either side,

    O = Rz(t1)·Tz(d1) · Tx(a)·Rx(α)·Ry(β) · Tz(d2)·Rz(t2),

and as turns and slides about z commute with the joint that moves there, they belong to the rows of
the two joints they lie next to. With β = 0 the six numbers are those of the common normal. Where
two axes are nearly parallel the common normal lies far outside the robot (hundreds of metres for a
milliradian) and jumps with every correction; there β takes the tilt, and the foot of the row is put
where the axis passes the origin that the robot's description names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from .._typing import Array
from ..exceptions import DhcalError
from .dh import CONVENTIONS, Convention, DHTable, axis_rotation, axis_translation

# Below this tilt a pair of axes is meant to be parallel and tilted by tolerances. Its plain row may
# have offsets that look sane by luck, but they move by a / tilt per radian of correction.
NEARLY_PARALLEL_RAD = np.radians(1.0)


# The wider window that is used where Hayati's β is asked for.
HAYATI_MAX_RAD = np.radians(5.0)


# Plain offsets beyond this many times the robot's whole length are not lengths of the robot. A foot is never
# farther than |p| / sin(tilt), so 2 is only exceeded below 30° of tilt, where the form with β is safe.
MAX_OFFSET_RATIO = 2.0


# Metres per metre of robot: a tool whose z passes the last axis this closely is meant to be in line with it.
COINCIDENT_RTOL = 0.01


# A chain that sliding its frames shortens to this share had offsets that cancel.
SHORTER_RATIO = 2 / 3


# Radians, and metres per metre of robot. Smaller differences from 0 or a quarter turn are rounding.
QUARTER_TURN_TOL = 5e-15


@dataclass(frozen=True)
class Extraction:
    """A DH table and where its x axes sit in the robot that it was taken from.

    Attributes:
        table: the table, with base and tool: its poses are those of the origins at every q.
        frames: (n, 4, 4), poses F_i in metres. Row i's point behind Tx(a)·Rx(α) and before Ry(β), seen
            from the frame of the station that row i shapes: ``origins[i+1]`` (joint i+2 or the
            tool, counting joints from 1) in the standard convention, ``origins[i]`` (joint i+1) in the
            modified one. Changing a, α or β of row i by ε, however large, is exactly
            ``origins[station] @ F_i @ exp6(ε·ξ) @ inverse(F_i)`` with ξ along x, about x or about y.
            (θ and d move about and along z of the joint's own frame and need none.)
        notes: a sentence for every pair of axes whose row has β.
    """

    table: DHTable
    frames: Array
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _OriginParameters:
    """The seven numbers of an origin, in radians and metres, and the offset that a plain row would need."""

    t1: float = 0.0
    d1: float = 0.0
    a: float = 0.0
    alpha: float = 0.0
    beta: float = 0.0
    d2: float = 0.0
    t2: float = 0.0
    plain_offset: float = 0.0

    @property
    def before(self) -> Array:
        """Rz(t1)·Tz(d1), (4, 4)."""
        return _screw_transform(self.t1, self.d1)

    @property
    def link(self) -> Array:
        """Tx(a)·Rx(α)·Ry(β), (4, 4)."""
        return axis_translation(0, np.array(self.a)) @ axis_rotation(0, np.array(self.alpha)) @ self.tilt

    @property
    def tilt(self) -> Array:
        """Ry(β), (4, 4)."""
        return axis_rotation(1, np.array(self.beta))

    @property
    def after(self) -> Array:
        """Tz(d2)·Rz(t2), (4, 4)."""
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
    """DH table of a chain whose joints all move about or along their own z.

    A pair of axes gets a plain row, unless it is tilted by less than a degree, or the offsets of the plain
    row exceed twice the sum of all distances in the chain; then it gets β. With ``hayati`` the first
    limit is five degrees. Exactly parallel axes need no β: α is 0 or π, and the offset along them goes to
    the row of its own origin. The base holds all of joint 1's origin but the offset along an upright
    axis; so does the tool where it is in line with the last axis but for tolerances. Turning x by
    half a turn negates a, α and β: of these two ways to write a row the one with the smaller
    residual turn is taken. So the origins of a table with identity base and tool give back that table.

    Args:
        origins: (n+1, 4, 4) in metres: joint 1 in the base; joint i+1 in joint i's moving frame; the
            tool in joint n's moving frame.
        names: the n joints' names.
        prismatic: (n,) True where the joint slides.
        lower: (n,) lower limits, rad or m.
        upper: (n,) upper limits, rad or m.
        convention: "standard" or "modified".
        hayati: use β up to five degrees of tilt.

    Returns:
        The table, the frames of its x axes, and what was done about nearly parallel axes.

    Raises:
        DhcalError: shapes that do not fit, numbers that are not finite, an unknown convention.
    """
    origins = np.asarray(origins, float)
    n = len(names)
    if convention not in CONVENTIONS:
        raise DhcalError(f"convention {convention!r}: must be 'standard' or 'modified'")
    if origins.shape != (n + 1, 4, 4):
        raise DhcalError(f"origins of shape {origins.shape}: {n} joints need ({n + 1}, 4, 4)")
    if not np.isfinite(origins).all():
        raise DhcalError("origins: every number must be finite")
    reach = float(np.linalg.norm(origins[:, :3, 3], axis=1).sum()) or 1.0
    window = HAYATI_MAX_RAD if hayati else NEARLY_PARALLEL_RAD
    standard = convention == "standard"
    # A standard row ends with its x axis, so nothing should be left behind it; a modified row
    # begins with it, so nothing should be left before it.
    base, first = _base_transform(origins[0], reach, window, standard)
    splits = [first]
    for origin in origins[1:] if standard else origins[1:-1]:
        splits.append(_split_origin(origin, splits[-1].t2, reach, window, leading=standard))
    tool = origins[-1]
    if standard and _is_tool_aligned(splits[-1], reach):
        splits[-1] = _aligned_tool_row(splits[-1])
        tool = se3.inverse(splits[-1].before @ splits[-1].link) @ tool
    elif standard:
        tool = splits[-1].after
    links = splits[1:] if standard else splits
    # Behind joint i: what splits[i] left, then what the next origin begins with.
    theta = [s.t2 for s in splits[:n]]
    d = [s.d2 for s in splits[:n]]
    for i, after in enumerate(splits[1:]):
        theta[i] += after.t1
        d[i] += after.d1
    table = DHTable(
        convention,
        tuple(names),
        np.asarray(prismatic, bool),
        np.array([_angle(t) for t in theta]),
        np.array([_length(x, reach) for x in d]),
        np.array([s.a for s in links]),
        np.array([s.alpha for s in links]),
        np.array([s.beta for s in links]),
        np.asarray(lower, float),
        np.asarray(upper, float),
        base,
        tool,
    )
    behind = [link.after for link in links[:-1]] + [tool if standard else links[-1].after]
    frames = [se3.inverse(link.tilt @ rest) for link, rest in zip(links, behind, strict=True)]
    axes = ["the base's z axis", *(f"the axis of {name}" for name in names), "the tool's z axis"]
    pairs = zip(axes[standard:], axes[standard + 1 :], strict=False)
    notes = [_note(link, pair) for link, pair in zip(links, pairs, strict=False) if link.beta]
    return Extraction(table, np.array(frames), tuple(notes))


def normalize_offsets(table: DHTable) -> DHTable:
    """The same arm without offsets of metres that only cancel each other; most tables come back as they are.

    Plain rows hide a milliradian between parallel axes behind feet far outside the robot. Sliding each
    joint's frame along its own axis, back to where the axis passes the frame before, changes no pose. It
    is done where it shortens the whole chain by a third or more; the rows then have β. Parallel axes stay
    as written.
    """
    origins = table.origins()
    slid = origins.copy()
    back = 0.0
    for i in range(1, len(origins)):
        slid[i] = axis_translation(2, np.array(-back)) @ slid[i]
        last = i == len(origins) - 1
        back = 0.0
        if not last and QUARTER_TURN_TOL < _tilt(slid[i]) < NEARLY_PARALLEL_RAD:
            back = -slid[i][2, 3] / slid[i][2, 2]
            slid[i] = slid[i] @ axis_translation(2, np.array(back))
    before, after = (np.linalg.norm(chain[:, :3, 3], axis=1).sum() for chain in (origins, slid))
    if after > SHORTER_RATIO * before:
        return table
    return extract_dh(slid, table.names, table.prismatic, table.lower, table.upper, table.convention).table


def _base_transform(
    origin: Array, reach: float, window: float, standard: bool
) -> tuple[Array, _OriginParameters]:
    """The base (4, 4) and what is left of joint 1's origin for row 1.

    The base can hold any motion, so it takes all but the offset along axis 1 where that is upright.
    Only an origin that is a modified row as it stands goes to the table.
    """
    row = _split_origin(origin, 0.0, reach, window, leading=False)
    if not standard and row.t1 == 0 and row.d1 == 0:
        return np.eye(4), row
    slide = _OriginParameters(d2=row.d2 if _tilt(origin) < window else 0.0)
    return origin @ se3.inverse(slide.after), slide


def _split_origin(
    origin: Array, carry: float, reach: float, window: float, leading: bool
) -> _OriginParameters:
    """The seven numbers of an origin (4, 4) behind a joint that already has the turn ``carry`` from before.

    What is free goes to t1 and d1 if ``leading``, else to t2 and d2.
    """
    tilt = _tilt(origin)
    t1, d2 = _common_normal(origin) if tilt > QUARTER_TURN_TOL else (0.0, 0.0)
    offset = max(abs(origin[2, 3] - d2 * origin[2, 2]), abs(d2))
    if tilt < window or offset > MAX_OFFSET_RATIO * reach:
        t1, d2 = _through_origin(origin, reach, leading)

    def ugliness(way: _OriginParameters) -> tuple[int, int, bool, bool]:
        left = way.t2 if leading else way.t1
        return _turned(left), _turned(carry + way.t1), way.a < 0, way.alpha < 0

    # Half a turn more negates a, α and β. The way that leaves less turn on the other side is the
    # one in which a table was written; ties go to the smaller θ, then to positive a and α.
    return min((_remaining_parameters(origin, t, d2, reach, offset) for t in (t1, t1 + np.pi)), key=ugliness)


def _tilt(origin: Array) -> float:
    """Angle in radians, 0 to π/2, between the lines of the two z axes."""
    return float(np.arctan2(np.hypot(origin[0, 2], origin[1, 2]), abs(origin[2, 2])))


def _turned(angle: float) -> int:
    """0, 1, 2 for a turn below, about, or beyond 90°: "about" is wide, so tolerances decide no tie."""
    size = abs(math.remainder(angle, 2 * np.pi)) - np.pi / 2
    return 1 if abs(size) < 0.05 else 2 * int(size > 0)


def _common_normal(origin: Array) -> tuple[float, float]:
    """t1 and d2 of the plain row: x along z × z_next, d2 from the foot on the next axis to its origin."""
    sine = np.hypot(origin[0, 2], origin[1, 2])
    t1 = np.arctan2(origin[0, 2], -origin[1, 2])
    across = np.cos(t1) * origin[1, 3] - np.sin(t1) * origin[0, 3]
    return float(t1), float(-across / sine)


def _through_origin(origin: Array, reach: float, leading: bool) -> tuple[float, float]:
    """t1 and d2 of a row with β, whose plane goes through one of the two origins.

    ``leading``: through the next one, so d1 is the robot's own offset along the first axis and d2 is 0.
    Otherwise through the first one, so d1 is 0 and d2 the offset along the next axis.
    """
    rotation, p = origin[:3, :3], origin[:3, 3]
    d2 = 0.0 if leading else float(p[2] / rotation[2, 2])
    x, y, _ = p - d2 * rotation[:, 2]
    if np.hypot(x, y) > QUARTER_TURN_TOL * reach:
        return float(np.arctan2(y, x)), d2
    if leading:  # the axes meet in the plane: any x will do, and this one leaves t2 = 0
        sign = np.sign(rotation[2, 2])
        return float(np.arctan2(-sign * rotation[0, 1], sign * rotation[1, 1])), d2
    return 0.0, d2


def _remaining_parameters(
    origin: Array, t1: float, d2: float, reach: float, offset: float
) -> _OriginParameters:
    """The other five numbers, once t1 and d2 are known; each is read behind the ones before it."""
    rotation = axis_rotation(2, np.array(-t1))[:3, :3] @ origin[:3, :3]
    foot = origin[:3, 3] - d2 * origin[:3, 2]
    beta = np.arctan2(rotation[0, 2], np.hypot(rotation[1, 2], rotation[2, 2]))
    return _OriginParameters(
        t1=_angle(t1),
        d1=_length(foot[2], reach),
        a=_length(np.cos(t1) * foot[0] + np.sin(t1) * foot[1], reach),
        alpha=_angle(np.arctan2(-rotation[1, 2], rotation[2, 2])),
        beta=_angle(beta),
        d2=_length(d2, reach),
        t2=_angle(np.arctan2(-rotation[0, 1], rotation[0, 0])),
        plain_offset=offset,
    )


def _is_tool_aligned(split: _OriginParameters, reach: float) -> bool:
    """Whether the tool's z is meant to be the last axis, but for tolerances."""
    return split.beta != 0 and abs(split.a) < COINCIDENT_RTOL * reach


def _aligned_tool_row(split: _OriginParameters) -> _OriginParameters:
    """The row of such a tool: its slide alone, so that x need not turn the way of a tolerance."""
    return _OriginParameters(d1=split.d1, alpha=_angle(round(split.alpha / np.pi) * np.pi))


def _angle(value: float) -> float:
    """An angle in (-π, π], quarter turns within rounding made exact, zero without a sign."""
    value = float(value)
    turns = round(value / (np.pi / 2))
    if abs(value - turns * (np.pi / 2)) < QUARTER_TURN_TOL:
        return ((turns + 1) % 4 - 1) * (np.pi / 2)
    return math.remainder(value, 2 * np.pi)


def _length(value: float, reach: float) -> float:
    return 0.0 if abs(value) < QUARTER_TURN_TOL * reach else float(value)


def _screw_transform(turn: float, slide: float) -> Array:
    return axis_rotation(2, np.array(turn)) @ axis_translation(2, np.array(slide))


def _note(split: _OriginParameters, axes: tuple[str, str]) -> str:
    return (
        f"{axes[0]} and {axes[1]} are {1e3 * _tilt(split.link):.3g} mrad from parallel: "
        f"the row between them has Hayati's beta, "
        f"as a plain one would need an offset of {split.plain_offset:.3g} m"
    )
