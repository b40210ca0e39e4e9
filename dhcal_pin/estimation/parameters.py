"""Sets of error parameters, each a function from a chain to its parameters, and the choice among them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from .. import se3
from ..exceptions import DhcalError
from ..robot.chain import BASE_FRAME, Chain, extract_dh_table, joint_frame, link_frame, without_mimics
from ..robot.dh import Convention
from ..robot.error_families import COUPLING, FAMILIES
from ..robot.transmission import COUPLING_PRIOR, COUPLING_TERM, TERM_FAMILIES, TERMS, Transmission
from .error_model import ErrorModel, ErrorParameter

# Standard deviations that manufacturing and assembly lead one to expect, and frames anywhere in a room.
LENGTH_PRIOR, ANGLE_PRIOR, OFFSET_PRIOR = 1e-3, 5e-3, np.deg2rad(2.0)


FRAME_LENGTH_PRIOR, FRAME_ANGLE_PRIOR = 10.0, 10.0


# A term of the transmission that nowhere exceeds this is none, rad or N·m: token masses load no joint.
MIN_TERM = 0.1


# A joint's axis whose largest component is as near to one as this lies along an axis of its frame.
AXIS_ALIGNMENT_TOL = 1e-5


_AXES = np.eye(6)


@functools.lru_cache(maxsize=16)
def _dh_rows(chain: Chain, convention: Convention, hayati: bool) -> tuple[ErrorParameter, ...]:
    found = extract_dh_table(without_mimics(chain), convention, hayati)
    table = found.table
    out = []
    k = len(chain.moving_joints)
    # DH frames are given where the joint's axis is z; carry their twists into the URDF's own frame.
    frames = np.concatenate([chain.axis_frames, np.eye(4)[None]])
    for i in range(k):
        along = chain.axes[i]
        spin = (0.0, 0.0, 0.0, *map(float, along))
        slide = (*map(float, along), 0.0, 0.0, 0.0)
        if convention == "standard":
            axial, lateral = link_frame(i + 1), joint_frame(i + 2)
            carry = frames[i + 2] @ found.frames[i]
        else:
            axial = lateral = joint_frame(i + 1)
            carry = frames[i + 1] @ found.frames[i]
        sideways = se3.adjoint(carry)
        label = i + 1
        rows = [
            ErrorParameter(f"theta{label}", "rad", float(table.theta[i]), axial, spin, OFFSET_PRIOR),
            ErrorParameter(f"d{label}", "m", float(table.d[i]), axial, slide, LENGTH_PRIOR),
            ErrorParameter(f"a{label}", "m", float(table.a[i]), lateral, tuple(sideways[:, 0]), LENGTH_PRIOR),
            ErrorParameter(
                f"alpha{label}", "rad", float(table.alpha[i]), lateral, tuple(sideways[:, 3]), ANGLE_PRIOR
            ),
        ]
        if hayati and _is_nearly_parallel(chain, i, convention):
            rows.append(
                ErrorParameter(
                    f"beta{label}", "rad", float(table.beta[i]), lateral, tuple(sideways[:, 4]), ANGLE_PRIOR
                )
            )
        out += rows if convention == "standard" else rows[2:] + rows[:2]
    return tuple(out)


def _is_nearly_parallel(chain: Chain, i: int, convention: Convention) -> bool:
    """Whether row i (from 0) stands between two axes within 5° of parallel."""
    link = i + 1 if convention == "standard" else i
    return 0 < link < len(chain.moving_joints) and abs(chain.link_transforms[link][2, 2]) > np.cos(
        np.deg2rad(5.0)
    )


def dh(chain: Chain) -> list[ErrorParameter]:
    """Standard DH, 4 a joint: θ, d, a, α of every row; the columns of the paper's R."""
    return list(_dh_rows(chain, "standard", hayati=False))


def modified_dh(chain: Chain) -> list[ErrorParameter]:
    """Modified DH, 4 a joint: a, α of the link before each joint, then d, θ."""
    return list(_dh_rows(chain, "modified", hayati=False))


def hayati(chain: Chain) -> list[ErrorParameter]:
    """Standard DH with β in place of d between (nearly) parallel axes."""
    rows = _dh_rows(chain, "standard", hayati=True)
    swapped = {f"d{row.name[4:]}" for row in rows if row.name.startswith("beta")}
    return [row for row in rows if row.name not in swapped]


_NAMES = ("x", "y", "z", "rx", "ry", "rz")


def _frame_parameters(prefix: str, station: int, length: float, angle: float) -> list[ErrorParameter]:
    return [
        ErrorParameter(f"{prefix}.{name}", unit, 0.0, station, tuple(axis), prior)
        for name, unit, axis, prior in zip(
            _NAMES, ("m",) * 3 + ("rad",) * 3, _AXES, (length,) * 3 + (angle,) * 3, strict=True
        )
    ]


def placement(chain: Chain) -> list[ErrorParameter]:
    """Six a joint: every joint origin moves freely in its own frame."""
    return [
        parameter
        for j, name in enumerate(chain.moving_joints)
        for parameter in _frame_parameters(name, joint_frame(j + 1), LENGTH_PRIOR, ANGLE_PRIOR)
    ]


def minimal(chain: Chain) -> list[ErrorParameter]:
    """The axis line's own freedom: 4 a revolute joint, 2 a prismatic one.

    A joint origin moves in all directions but along and about its axis, which commute with the motion
    and so pass on to the next joint, and at last to the tool. With `base` and `tool` the set is complete
    and has no singular arm: 4R + 2P + 6 directions for R revolute and P prismatic joints.
    """
    out = []
    for j, (name, axis, slides) in enumerate(
        zip(chain.moving_joints, chain.axes, chain.prismatic, strict=True)
    ):
        parts = [abs(part) for part in axis.tolist()]
        if abs(max(parts) - 1) < AXIS_ALIGNMENT_TOL:
            skip = parts.index(max(parts))
            kept = [
                p
                for i, p in enumerate(_frame_parameters(name, joint_frame(j + 1), LENGTH_PRIOR, ANGLE_PRIOR))
                if i % 3 != skip
            ]
        else:
            turn = chain.axis_frames[j + 1][:3, :3]
            zero = (0.0, 0.0, 0.0)
            u, v = (tuple(map(float, turn[:, i])) for i in (0, 1))
            kept = [
                ErrorParameter(f"{name}.u", "m", 0.0, joint_frame(j + 1), u + zero, LENGTH_PRIOR),
                ErrorParameter(f"{name}.v", "m", 0.0, joint_frame(j + 1), v + zero, LENGTH_PRIOR),
                ErrorParameter(f"{name}.ru", "rad", 0.0, joint_frame(j + 1), zero + u, ANGLE_PRIOR),
                ErrorParameter(f"{name}.rv", "rad", 0.0, joint_frame(j + 1), zero + v, ANGLE_PRIOR),
            ]
        out += [parameter for parameter in kept if not (slides and parameter.unit == "m")]
    return out


def offset(chain: Chain) -> list[ErrorParameter]:
    """The zero of each moving joint, rad or m."""
    out = []
    for j, (name, axis, slides) in enumerate(
        zip(chain.moving_joints, chain.axes, chain.prismatic, strict=True)
    ):
        direction = tuple(map(float, axis))
        zero = (0.0, 0.0, 0.0)
        twist = direction + zero if slides else zero + direction
        out.append(
            ErrorParameter(
                f"{name}.offset",
                "m" if slides else "rad",
                0.0,
                joint_frame(j + 1),
                twist,
                LENGTH_PRIOR if slides else OFFSET_PRIOR,
            )
        )
    return out


def base(chain: Chain) -> list[ErrorParameter]:
    """Where the robot stands in the measuring frame, six."""
    return _frame_parameters("base", BASE_FRAME, FRAME_LENGTH_PRIOR, FRAME_ANGLE_PRIOR)


def tool(chain: Chain) -> list[ErrorParameter]:
    """Where the measured point sits on the tip, six."""
    return _frame_parameters("tool", chain.tool_frame_index, FRAME_LENGTH_PRIOR, FRAME_ANGLE_PRIOR)


def _transmission_parameter(
    chain: Chain, coefficient: tuple[int, int, int], name: str, unit: str, prior: float
) -> ErrorParameter:
    """A coefficient of the transmission, at the first joint on the path that the independent one moves."""
    first = int(np.flatnonzero(chain.mimic_matrix[:, coefficient[1]])[0])
    axis, zero = tuple(map(float, chain.axes[first])), (0.0, 0.0, 0.0)
    twist = axis + zero if chain.prismatic[first] else zero + axis
    held = 0.0 if chain.transmission is None else float(chain.transmission.coefficients[coefficient])
    entry = int(np.ravel_multi_index(coefficient, (len(TERMS), chain.n_joints, chain.n_joints)))
    return ErrorParameter(name, unit, held, link_frame(first + 1), twist, prior, entry)


def family(chain: Chain, name: str) -> list[ErrorParameter]:
    """All terms of a family of `transmission.TERMS` at each joint that has them.

    A term that is next to nothing wherever the arm stands, such as a vertical axis' load, is left out.
    """
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (chain.n_joints, 64))
    felt = np.abs(Transmission.zero(chain.loads).terms(q)).max(-1) > MIN_TERM
    return [
        _transmission_parameter(chain, (t, i, i), f"{joint}.{term.name}", term.unit, term.prior)
        for i, joint in enumerate(chain.joint_names)
        for t, term in enumerate(TERMS)
        if term.family == name and felt[t, i] and (term.applies_to_prismatic or not chain.is_prismatic[i])
    ]


def coupling(chain: Chain) -> list[ErrorParameter]:
    """How far each revolute joint turns per unit of every other joint's value."""
    return [
        _transmission_parameter(
            chain,
            (COUPLING_TERM, i, j),
            f"{joint}.{source}",
            "rad/m" if chain.is_prismatic[j] else "rad/rad",
            COUPLING_PRIOR,
        )
        for i, joint in enumerate(chain.joint_names)
        for j, source in enumerate(chain.joint_names)
        if i != j and not chain.is_prismatic[i]
    ]


PARAMETER_SETS: dict[str, Callable[[Chain], list[ErrorParameter]]] = {
    "dh": dh,
    "modified-dh": modified_dh,
    "hayati": hayati,
    "minimal": minimal,
    "placement": placement,
    "base": base,
    "tool": tool,
    "offset": offset,
    **{name: functools.partial(family, name=name) for name in TERM_FAMILIES},
    COUPLING: coupling,
}


EXTENSIONS = tuple(FAMILIES)


def select_parameters(
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
    unknown = [name for name in names if name not in PARAMETER_SETS]
    if unknown:
        raise DhcalError(f"unknown parameter set {unknown[0]!r}; choose from {', '.join(PARAMETER_SETS)}")
    if both := sorted({*fix} & {*free}):
        raise DhcalError(f"{both[0]!r} is both fixed and freed; leave out one of the two")
    found = {name: PARAMETER_SETS[name](chain) for name in names}
    if empty := [name for name, parameters in found.items() if not parameters]:
        raise DhcalError(
            f"{chain.urdf.source}: no joint has parameters of the set {empty[0]!r}; "
            f"the set needs {FAMILIES[empty[0]].requirement}"
        )
    pool = {p.name: p for parameters in found.values() for p in parameters}
    fixed = set[str]()
    for name in fix:
        members = {p.name for p in PARAMETER_SETS[name](chain)} if name in PARAMETER_SETS else {name}
        if not members & set(pool):
            what = (
                "none of its parameters is unknown here" if name in PARAMETER_SETS else "not a parameter here"
            )
            raise DhcalError(f"cannot fix {name!r}: {what}; there are {', '.join(pool)}")
        fixed |= members
    if missing := [name for name in free if name not in pool]:
        every = {p.name: p for build in PARAMETER_SETS.values() for p in build(chain)}
        for name in missing:
            if name in PARAMETER_SETS:
                raise DhcalError(f"cannot free {name!r}: it is a whole set; add it to the parameters")
            if name not in every:
                raise DhcalError(f"cannot free {name!r}: there are {', '.join(every)}")
            pool[name] = every[name]
    fixed -= set(free)
    chosen = [p for p in pool.values() if p.name not in fixed]
    if not chosen:
        raise DhcalError("no parameter is left to identify; fix fewer of them")
    return ErrorModel(chain, (), tuple(p for p in pool.values() if p.name in fixed)).with_parameters(chosen)
