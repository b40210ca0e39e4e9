"""Sets of error parameters, each a function from a chain to its parameters, and the choice among them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from .. import se3
from ..exceptions import DhcalError
from ..robot.chain import BASE, Chain, extract, joint_station, link_station, unlinked
from ..robot.dh import Convention
from ..robot.transmission import COUPLED, COUPLING_PRIOR, FAMILIES, TERMS, Transmission
from .error_model import ErrorModel, Parameter

# Standard deviations that manufacturing and assembly lead one to expect, and frames anywhere in a room.
LENGTH, ANGLE, OFFSET = 1e-3, 5e-3, np.deg2rad(2.0)


WIDE_LENGTH, WIDE_ANGLE = 10.0, 10.0


# A term of the transmission that nowhere exceeds this is none, rad or N·m: token masses load no joint.
LEAST_TERM = 0.1


# A joint's axis whose largest component is as near to one as this lies along an axis of its frame.
ALONG = 1e-5


_AXES = np.eye(6)


@functools.lru_cache(maxsize=16)
def _dh_rows(chain: Chain, convention: Convention, hayati: bool) -> tuple[Parameter, ...]:
    found = extract(unlinked(chain), convention, hayati)
    table = found.table
    out = []
    k = len(chain.moving)
    # DH frames are given where the joint's axis is z; carry their twists into the URDF's own frame.
    frames = np.concatenate([chain.axis_frames, np.eye(4)[None]])
    for i in range(k):
        along = chain.axes[i]
        spin = (0.0, 0.0, 0.0, *map(float, along))
        slide = (*map(float, along), 0.0, 0.0, 0.0)
        if convention == "standard":
            axial, lateral = link_station(i + 1), joint_station(i + 2)
            carry = frames[i + 2] @ found.frames[i]
        else:
            axial = lateral = joint_station(i + 1)
            carry = frames[i + 1] @ found.frames[i]
        sideways = se3.adjoint(carry)
        label = i + 1
        rows = [
            Parameter(f"theta{label}", "rad", float(table.theta[i]), axial, spin, OFFSET),
            Parameter(f"d{label}", "m", float(table.d[i]), axial, slide, LENGTH),
            Parameter(f"a{label}", "m", float(table.a[i]), lateral, tuple(sideways[:, 0]), LENGTH),
            Parameter(f"alpha{label}", "rad", float(table.alpha[i]), lateral, tuple(sideways[:, 3]), ANGLE),
        ]
        if hayati and _parallel(chain, i, convention):
            rows.append(
                Parameter(f"beta{label}", "rad", float(table.beta[i]), lateral, tuple(sideways[:, 4]), ANGLE)
            )
        out += rows if convention == "standard" else rows[2:] + rows[:2]
    return tuple(out)


def _parallel(chain: Chain, i: int, convention: Convention) -> bool:
    """Whether row i (from 0) stands between two axes within 5° of parallel."""
    link = i + 1 if convention == "standard" else i
    return 0 < link < len(chain.moving) and abs(chain.links[link][2, 2]) > np.cos(np.deg2rad(5.0))


def dh(chain: Chain) -> list[Parameter]:
    """Standard DH, 4 a joint: θ, d, a, α of every row; the columns of the paper's R."""
    return list(_dh_rows(chain, "standard", hayati=False))


def modified_dh(chain: Chain) -> list[Parameter]:
    """Modified DH, 4 a joint: a, α of the link before each joint, then d, θ."""
    return list(_dh_rows(chain, "modified", hayati=False))


def hayati(chain: Chain) -> list[Parameter]:
    """Standard DH with β in place of d between (nearly) parallel axes."""
    rows = _dh_rows(chain, "standard", hayati=True)
    swapped = {f"d{row.name[4:]}" for row in rows if row.name.startswith("beta")}
    return [row for row in rows if row.name not in swapped]


_NAMES = ("x", "y", "z", "rx", "ry", "rz")


def _six(prefix: str, station: int, length: float, angle: float) -> list[Parameter]:
    return [
        Parameter(f"{prefix}.{name}", unit, 0.0, station, tuple(axis), prior)
        for name, unit, axis, prior in zip(
            _NAMES, ("m",) * 3 + ("rad",) * 3, _AXES, (length,) * 3 + (angle,) * 3, strict=True
        )
    ]


def placement(chain: Chain) -> list[Parameter]:
    """Six a joint: every joint origin moves freely in its own frame."""
    return [
        parameter
        for j, name in enumerate(chain.moving)
        for parameter in _six(name, joint_station(j + 1), LENGTH, ANGLE)
    ]


def minimal(chain: Chain) -> list[Parameter]:
    """The axis line's own freedom: 4 a revolute joint, 2 a prismatic one.

    A joint origin moves in all directions but along and about its axis, which commute with the motion
    and so pass on to the next joint, and at last to the tool. With `base` and `tool` the set is complete
    and has no singular arm: 4R + 2P + 6 directions for R revolute and P prismatic joints.
    """
    out = []
    for j, (name, axis, slides) in enumerate(zip(chain.moving, chain.axes, chain.prismatic, strict=True)):
        parts = [abs(part) for part in axis.tolist()]
        if abs(max(parts) - 1) < ALONG:
            skip = parts.index(max(parts))
            kept = [p for i, p in enumerate(_six(name, joint_station(j + 1), LENGTH, ANGLE)) if i % 3 != skip]
        else:
            turn = chain.axis_frames[j + 1][:3, :3]
            zero = (0.0, 0.0, 0.0)
            u, v = (tuple(map(float, turn[:, i])) for i in (0, 1))
            kept = [
                Parameter(f"{name}.u", "m", 0.0, joint_station(j + 1), u + zero, LENGTH),
                Parameter(f"{name}.v", "m", 0.0, joint_station(j + 1), v + zero, LENGTH),
                Parameter(f"{name}.ru", "rad", 0.0, joint_station(j + 1), zero + u, ANGLE),
                Parameter(f"{name}.rv", "rad", 0.0, joint_station(j + 1), zero + v, ANGLE),
            ]
        out += [parameter for parameter in kept if not (slides and parameter.unit == "m")]
    return out


def offset(chain: Chain) -> list[Parameter]:
    """The zero of each moving joint, rad or m."""
    out = []
    for j, (name, axis, slides) in enumerate(zip(chain.moving, chain.axes, chain.prismatic, strict=True)):
        direction = tuple(map(float, axis))
        zero = (0.0, 0.0, 0.0)
        twist = direction + zero if slides else zero + direction
        out.append(
            Parameter(
                f"{name}.offset",
                "m" if slides else "rad",
                0.0,
                joint_station(j + 1),
                twist,
                LENGTH if slides else OFFSET,
            )
        )
    return out


def base(chain: Chain) -> list[Parameter]:
    """Where the robot stands in the measuring frame, six."""
    return _six("base", BASE, WIDE_LENGTH, WIDE_ANGLE)


def tool(chain: Chain) -> list[Parameter]:
    """Where the measured point sits on the tip, six."""
    return _six("tool", chain.tool_station, WIDE_LENGTH, WIDE_ANGLE)


def _scaled(chain: Chain, place: tuple[int, int, int], name: str, unit: str, prior: float) -> Parameter:
    """A coefficient of the transmission, at the first joint on the path that the independent one moves."""
    first = int(np.flatnonzero(chain.mixing[:, place[1]])[0])
    axis, zero = tuple(map(float, chain.axes[first])), (0.0, 0.0, 0.0)
    twist = axis + zero if chain.prismatic[first] else zero + axis
    held = 0.0 if chain.transmission is None else float(chain.transmission.coefficients[place])
    entry = int(np.ravel_multi_index(place, (len(TERMS), chain.size, chain.size)))
    return Parameter(name, unit, held, link_station(first + 1), twist, prior, entry)


def family(chain: Chain, name: str) -> list[Parameter]:
    """All terms of a family of `transmission.TERMS` at each joint that has them.

    A term that is next to nothing wherever the arm stands, such as a vertical axis' load, is left out.
    """
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (chain.size, 64))
    felt = np.abs(Transmission.ideal(chain.loads).terms(q)).max(-1) > LEAST_TERM
    return [
        _scaled(chain, (t, i, i), f"{joint}.{term.name}", term.unit, term.prior)
        for i, joint in enumerate(chain.joint_names)
        for t, term in enumerate(TERMS)
        if term.family == name and felt[t, i] and (term.sliding or not chain.sliding[i])
    ]


def coupling(chain: Chain) -> list[Parameter]:
    """How far each revolute joint turns per unit of every other joint's value."""
    return [
        _scaled(
            chain,
            (COUPLED, i, j),
            f"{joint}.{source}",
            "rad/m" if chain.sliding[j] else "rad/rad",
            COUPLING_PRIOR,
        )
        for i, joint in enumerate(chain.joint_names)
        for j, source in enumerate(chain.joint_names)
        if i != j and not chain.sliding[i]
    ]


SETS: dict[str, Callable[[Chain], list[Parameter]]] = {
    "dh": dh,
    "modified-dh": modified_dh,
    "hayati": hayati,
    "minimal": minimal,
    "placement": placement,
    "base": base,
    "tool": tool,
    "offset": offset,
    **{name: functools.partial(family, name=name) for name in FAMILIES},
    "coupling": coupling,
}


EXTENSIONS = (*FAMILIES, "coupling")


def select(
    chain: Chain, sets: str | Iterable[str], fix: Sequence[str] = (), free: Sequence[str] = ()
) -> ErrorModel:
    """The union of named sets on a chain.

    Args:
        chain: the nominal chain.
        sets: names, as a comma-separated text or one by one.
        fix: parameters or whole sets held at nominal.
        free: parameters of any set added one by one.

    Raises:
        DhcalError: an unknown set or parameter, one both fixed and freed, or nothing left to identify.
    """
    names = [s.strip() for s in sets.split(",")] if isinstance(sets, str) else list(sets)
    unknown = [name for name in names if name not in SETS]
    if unknown:
        raise DhcalError(f"unknown parameter set {unknown[0]!r}; choose from {', '.join(SETS)}")
    if both := sorted({*fix} & {*free}):
        raise DhcalError(f"{both[0]!r} is both fixed and freed; leave out one of the two")
    found = {name: SETS[name](chain) for name in names}
    if empty := [name for name, parameters in found.items() if not parameters]:
        raise DhcalError(
            f"{chain.urdf.source}: no joint of {empty[0]!r}: it takes a joint that turns, "
            "for coupling another joint, and for compliance a URDF whose links have masses"
        )
    pool = {p.name: p for parameters in found.values() for p in parameters}
    fixed = set[str]()
    for name in fix:
        members = {p.name for p in SETS[name](chain)} if name in SETS else {name}
        if not members & set(pool):
            what = "none of its parameters is unknown here" if name in SETS else "not a parameter here"
            raise DhcalError(f"cannot fix {name!r}: {what}; there are {', '.join(pool)}")
        fixed |= members
    if missing := [name for name in free if name not in pool]:
        every = {p.name: p for build in SETS.values() for p in build(chain)}
        for name in missing:
            if name in SETS:
                raise DhcalError(f"cannot free {name!r}: it is a whole set; add it to the parameters")
            if name not in every:
                raise DhcalError(f"cannot free {name!r}: there are {', '.join(every)}")
            pool[name] = every[name]
    fixed -= set(free)
    chosen = [p for p in pool.values() if p.name not in fixed]
    if not chosen:
        raise DhcalError("no parameter is left to identify; fix fewer of them")
    return ErrorModel(chain, (), tuple(p for p in pool.values() if p.name in fixed)).joined(chosen)
