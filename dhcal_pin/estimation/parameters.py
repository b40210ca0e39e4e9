"""Parameter sets: which errors of a robot are unknown.

A parameter set is a function from a chain to its `ErrorParameter`s. Sets are combined by name, as in
`--parameters minimal,base,tool`; parameters of the same name count once. `PARAMETER_SETS` lists all sets with
one line of description each. To add a set: write such a function and add a row there.

Geometric sets, for R revolute and P prismatic joints:

- `dh`, `modified_dh`, `hayati`: the entries θ, d, a, α (and β) of Denavit-Hartenberg tables. Each is a twist
  along or about an axis of the row, carried into the frames of the URDF by the adjoint.
- `minimal`: 4R + 2P parameters. With `base` and `tool` this set is complete and free of redundancy: it has
  the 4R + 2P + 6 independent directions of a serial robot (Mooring, Roth & Driels 1991).
- `placement`: 6 parameters for each joint origin; complete, and redundant along and about the joint axes.
- `base`, `tool`: 6 parameters each, outside the robot.
- `offset`: the zero position of each joint.
- `low-cost`: `minimal` and `offset` with the priors of a low-cost arm, whose joints may turn the other way.

Sets of the transmission: one set for each of `robot.error_families.FAMILIES`.

Redundant sets are allowed. The priors, or the rank cut, hold the directions that no data can determine.

References:
    B. W. Mooring, Z. S. Roth and M. R. Driels, Fundamentals of Manipulator Calibration, Wiley 1991.
    S. A. Hayati, Robot Arm Geometric Link Parameter Estimation, CDC 1983.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from .. import se3
from .._frozen import frozen
from ..exceptions import DhcalError, InvalidArgumentError, UnknownNameError
from ..robot.chain import BASE_FRAME, Chain, extract_dh_table, joint_frame, link_frame, without_mimics
from ..robot.dh import Convention
from ..robot.dh_extraction import HAYATI_MAX_RAD
from ..robot.error_families import FAMILIES, ErrorFamily
from ..robot.transmission import coefficient_indices
from .error_model import ErrorModel, ErrorParameter

# Prior standard deviations of manufacturing and assembly errors: lengths [m], angles and joint offsets [rad].
LENGTH_PRIOR = 1e-3
ANGLE_PRIOR = 5e-3
OFFSET_PRIOR = np.deg2rad(2.0)
# The same of low-cost arms, whose plastic links and servos are put together by hand, and of the zeros
# of their prismatic joints.
LOW_COST = "low-cost"
LOW_COST_LENGTH_PRIOR, LOW_COST_ANGLE_PRIOR = 3e-3, np.deg2rad(2.0)
LOW_COST_OFFSET_PRIOR, LOW_COST_SLIDE_PRIOR = np.deg2rad(15.0), 1e-2
# Prior standard deviations of base and tool [m, rad]: the base is anywhere in a room, the measured point near
# the tip. If the tool keeps its orientation, the measurements hardly show where the point is.
FRAME_LENGTH_PRIOR = 10.0
FRAME_ANGLE_PRIOR = 10.0
TOOL_LENGTH_PRIOR = 0.5

# Largest number of harmonics of a joint that messages list one by one.
MAX_LISTED_HARMONICS = 4
_HARMONIC_NAME = re.compile(r"(.+)\.((?:sin|cos)\d+)")

# Difference to 1 of an axis' largest component below which the axis counts as an axis of its frame.
AXIS_ALIGNMENT_TOL = 1e-5

_FRAME_NAMES = ("x", "y", "z", "rx", "ry", "rz")
_FRAME_UNITS = ("m", "m", "m", "rad", "rad", "rad")
_FRAME_TWISTS = tuple(map(tuple, np.eye(6).tolist()))
_ZERO = (0.0, 0.0, 0.0)


@functools.lru_cache(maxsize=16)
def _dh_parameters(chain: Chain, convention: Convention, hayati: bool) -> tuple[ErrorParameter, ...]:
    """Build the parameters of all rows of a chain's DH table."""
    extraction = extract_dh_table(without_mimics(chain), convention, hayati)
    table = extraction.table
    out = []
    k = len(chain.moving_joints)
    # In DH frames the joint axis is z; the twists are carried into the frames of the URDF.
    axis_frames = np.concatenate([chain.axis_frames, np.eye(4)[None]])
    for i in range(k):
        axis = tuple(map(float, chain.axes[i]))
        if convention == "standard":
            axial, lateral = link_frame(i + 1), joint_frame(i + 2)
            carry = axis_frames[i + 2] @ extraction.frames[i]
        else:
            axial = lateral = joint_frame(i + 1)
            carry = axis_frames[i + 1] @ extraction.frames[i]
        # Columns: twists along and about the axes x, y, z of the DH frame.
        twists = se3.adjoint(carry)
        row = i + 1
        theta, d = float(table.theta[i]), float(table.d[i])
        a, alpha, beta = float(table.a[i]), float(table.alpha[i]), float(table.beta[i])
        parameters = [
            ErrorParameter(f"theta{row}", "rad", theta, axial, _ZERO + axis, OFFSET_PRIOR),
            ErrorParameter(f"d{row}", "m", d, axial, axis + _ZERO, LENGTH_PRIOR),
            ErrorParameter(f"a{row}", "m", a, lateral, tuple(twists[:, 0]), LENGTH_PRIOR),
            ErrorParameter(f"alpha{row}", "rad", alpha, lateral, tuple(twists[:, 3]), ANGLE_PRIOR),
        ]
        if hayati and _is_nearly_parallel(chain, i, convention):
            parameters.append(
                ErrorParameter(f"beta{row}", "rad", beta, lateral, tuple(twists[:, 4]), ANGLE_PRIOR)
            )
        out += parameters if convention == "standard" else parameters[2:] + parameters[:2]
    return tuple(out)


def _is_nearly_parallel(chain: Chain, i: int, convention: Convention) -> bool:
    """Check whether the link of row i, counted from 0, joins two nearly parallel axes."""
    link = i + 1 if convention == "standard" else i
    if not 0 < link < len(chain.moving_joints):
        return False
    return abs(chain.link_transforms[link][2, 2]) > np.cos(HAYATI_MAX_RAD)


def dh(chain: Chain) -> list[ErrorParameter]:
    """Build the entries θ, d, a, α of all rows of the standard DH table: the columns of the paper's R."""
    return list(_dh_parameters(chain, "standard", hayati=False))


def modified_dh(chain: Chain) -> list[ErrorParameter]:
    """Build the entries a, α, d, θ of all rows of the modified DH table."""
    return list(_dh_parameters(chain, "modified", hayati=False))


def hayati(chain: Chain) -> list[ErrorParameter]:
    """Build the entries of the standard DH table, with β in place of d between nearly parallel axes."""
    rows = _dh_parameters(chain, "standard", hayati=True)
    replaced = {f"d{row.name[4:]}" for row in rows if row.name.startswith("beta")}
    return [row for row in rows if row.name not in replaced]


def _frame_parameters(prefix: str, error_frame: int, length: float, angle: float) -> list[ErrorParameter]:
    """Build three translations and three rotations of a frame, with prior standard deviations [m, rad]."""
    return [
        ErrorParameter(f"{prefix}.{name}", unit, 0.0, error_frame, twist, prior)
        for name, unit, twist, prior in zip(
            _FRAME_NAMES, _FRAME_UNITS, _FRAME_TWISTS, (length,) * 3 + (angle,) * 3, strict=True
        )
    ]


def placement(chain: Chain) -> list[ErrorParameter]:
    """Build three translations and three rotations of each joint origin, in its own frame."""
    return [
        parameter
        for j, name in enumerate(chain.moving_joints)
        for parameter in _frame_parameters(name, chain.origin_frame(j + 1), LENGTH_PRIOR, ANGLE_PRIOR)
    ]


def minimal(chain: Chain) -> list[ErrorParameter]:
    """Build the independent errors of each joint's axis."""
    # Motions along and about the axis commute with the joint's motion and pass on to the next joint, from the
    # last joint to the tool. So do all translations of a prismatic joint's axis.
    out = []
    for j, (name, axis, is_prismatic) in enumerate(
        zip(chain.moving_joints, chain.axes, chain.prismatic, strict=True)
    ):
        components = [abs(component) for component in axis.tolist()]
        error_frame = chain.origin_frame(j + 1)
        if abs(max(components) - 1) < AXIS_ALIGNMENT_TOL:
            along = components.index(max(components))
            parameters = [
                p
                for i, p in enumerate(_frame_parameters(name, error_frame, LENGTH_PRIOR, ANGLE_PRIOR))
                if i % 3 != along
            ]
        else:
            # Two directions u, v across an axis that is not an axis of its frame.
            rotation = chain.axis_frames[j + 1][:3, :3]
            u, v = (tuple(map(float, rotation[:, i])) for i in (0, 1))
            parameters = [
                ErrorParameter(f"{name}.u", "m", 0.0, error_frame, u + _ZERO, LENGTH_PRIOR),
                ErrorParameter(f"{name}.v", "m", 0.0, error_frame, v + _ZERO, LENGTH_PRIOR),
                ErrorParameter(f"{name}.ru", "rad", 0.0, error_frame, _ZERO + u, ANGLE_PRIOR),
                ErrorParameter(f"{name}.rv", "rad", 0.0, error_frame, _ZERO + v, ANGLE_PRIOR),
            ]
        out += [parameter for parameter in parameters if not (is_prismatic and parameter.unit == "m")]
    return out


def redundant(errors: ErrorModel) -> list[ErrorParameter]:
    """Build the errors of joint origins that the set `minimal` leaves out; none if a model lacks that set."""
    chain = errors.chain
    known = {
        (p.error_frame, tuple(sign * v for v in p.twist)) for p in errors.parameters for sign in (1.0, -1.0)
    }
    if not {p.name for p in minimal(chain)} <= {p.name for p in errors.parameters}:
        return []
    out = []
    for j, (name, axis) in enumerate(zip(chain.moving_joints, chain.axes.tolist(), strict=True)):
        u, v = chain.axis_frames[j + 1][:3, :2].T.tolist()
        twists = [
            ("m", _joint_twist(axis, True), LENGTH_PRIOR),
            ("rad", _joint_twist(axis, False), ANGLE_PRIOR),
        ]
        if chain.prismatic[j]:
            twists += [("m", _joint_twist(across, True), LENGTH_PRIOR) for across in (u, v)]
        out += [
            ErrorParameter(f"{name}.redundant{i}", unit, 0.0, chain.origin_frame(j + 1), twist, prior)
            for i, (unit, twist, prior) in enumerate(twists)
        ]
    return [parameter for parameter in out if (parameter.error_frame, parameter.twist) not in known]


def offset(chain: Chain) -> list[ErrorParameter]:
    """Build the offset of each moving joint's zero position."""
    out = []
    for j, (name, axis, is_prismatic) in enumerate(
        zip(chain.moving_joints, chain.axes, chain.prismatic, strict=True)
    ):
        unit, prior = ("m", LENGTH_PRIOR) if is_prismatic else ("rad", OFFSET_PRIOR)
        twist = _joint_twist(axis.tolist(), is_prismatic)
        out.append(ErrorParameter(f"{name}.offset", unit, 0.0, chain.origin_frame(j + 1), twist, prior))
    return out


def low_cost(chain: Chain) -> list[ErrorParameter]:
    """Build the errors of each joint's axis and zero position, with the priors of a low-cost arm."""
    geometry = {"m": LOW_COST_LENGTH_PRIOR, "rad": LOW_COST_ANGLE_PRIOR}
    zeros = {"m": LOW_COST_SLIDE_PRIOR, "rad": LOW_COST_OFFSET_PRIOR}
    return [
        replace(parameter, prior=priors[parameter.unit])
        for parameters, priors in ((minimal(chain), geometry), (offset(chain), zeros))
        for parameter in parameters
    ]


def _joint_twist(axis: Sequence[float], is_prismatic: bool) -> tuple[float, ...]:
    """Return the twist [v, ω] of a joint's own motion."""
    return (*axis, *_ZERO) if is_prismatic else (*_ZERO, *axis)


def base(chain: Chain) -> list[ErrorParameter]:
    """Build the pose of the robot's base in the measuring frame."""
    return _frame_parameters("base", BASE_FRAME, FRAME_LENGTH_PRIOR, FRAME_ANGLE_PRIOR)


def tool(chain: Chain) -> list[ErrorParameter]:
    """Build the pose of the measured point in the tip frame."""
    return _frame_parameters("tool", chain.tool_frame_index, TOOL_LENGTH_PRIOR, FRAME_ANGLE_PRIOR)


def joint_errors(chain: Chain, family: ErrorFamily) -> list[ErrorParameter]:
    """Build the parameters of a family of joint errors: transmission coefficients."""
    coefficients = family.coefficients(chain, coefficient_indices(*chain.mimic_matrix.shape))
    if term := family.joint_term or family.link_term:
        has_effect = term.has_effect(chain.loads)
        coefficients = [c for c in coefficients if has_effect[c.owner]]
    prior = (LOW_COST in chain.parameters and family.low_cost_prior) or family.prior
    nominal = [0.0] * len(coefficients)
    if chain.transmission is not None:
        nominal = chain.transmission.coefficients[[c.entry for c in coefficients]].tolist()
    if family.link_term:
        names, scale = chain.link_names, "length"
        frames = [link_frame(j) for j in range(len(names))]
        twists = [(*vector, *_ZERO) for vector in chain.loads.link_vectors.tolist()]
    else:
        # The error acts at the first moving joint that the independent joint drives.
        moving = (chain.mimic_matrix != 0).argmax(0).tolist()
        names, scale = chain.joint_names, "position"
        frames = [link_frame(j + 1) for j in moving]
        twists = [_joint_twist(chain.axes[j].tolist(), bool(chain.prismatic[j])) for j in moving]
    return [
        ErrorParameter(
            f"{names[c.owner]}.{c.name}",
            c.unit,
            value,
            frames[c.owner],
            twists[c.owner],
            prior,
            c.entry,
            scale,
        )
        for c, value in zip(coefficients, nominal, strict=True)
    ]


@frozen
class ParameterSet:
    """Parameter set that users select by name; calling it returns its parameters."""

    build: Callable[[Chain], list[ErrorParameter]]  #: Function from a chain to the parameters of the set
    help: str  #: One line for help texts

    def __call__(self, chain: Chain) -> list[ErrorParameter]:
        """Build the parameters of the set."""
        return self.build(chain)


PARAMETER_SETS: dict[str, ParameterSet] = {
    "dh": ParameterSet(dh, "theta, d, a, alpha of the standard DH table"),
    "modified-dh": ParameterSet(modified_dh, "a, alpha, d, theta of the modified DH table"),
    "hayati": ParameterSet(hayati, "standard DH table, with beta in place of d between nearly parallel axes"),
    "minimal": ParameterSet(minimal, "position and direction of each joint axis, without redundancy"),
    "placement": ParameterSet(placement, "position and orientation of each joint origin, six per joint"),
    "base": ParameterSet(base, "pose of the robot's base in the measuring frame"),
    "tool": ParameterSet(tool, "pose of the measured point in the tip frame"),
    "offset": ParameterSet(offset, "zero position of each joint"),
    LOW_COST: ParameterSet(
        low_cost,
        "axes and zeros of a low-cost arm: zeros 15 deg, lengths 3 mm, directions 2 deg",
    ),
    **{
        name: ParameterSet(functools.partial(joint_errors, family=family), family.description)
        for name, family in FAMILIES.items()
    },
}

# Sets that model selection may add.
EXTENSIONS = tuple(FAMILIES)


def set_names(sets: str | Iterable[str]) -> list[str]:
    """Return the names of sets, comma-separated or one by one."""
    return [name.strip() for name in sets.split(",")] if isinstance(sets, str) else list(sets)


def select_parameters(
    chain: Chain, sets: str | Iterable[str], fix: Sequence[str] = (), free: Sequence[str] = ()
) -> ErrorModel:
    """Build the error model of a chain from named parameter sets.

    Args:
        chain: Nominal chain.
        sets: Keys of PARAMETER_SETS, comma-separated or one by one.
        fix: Parameters or whole sets that are held at their nominal values.
        free: Single parameters of any set that are added.

    Returns:
        Error model with the union of the sets.

    Raises:
        DhcalError: If a set has no parameters on this chain.
        InvalidArgumentError: If a parameter is both fixed and freed, or no parameter is left.
        UnknownNameError: If a set or parameter is unknown.
    """
    names = set_names(sets)
    if unknown := [name for name in names if name not in PARAMETER_SETS]:
        raise UnknownNameError(
            f"unknown parameter set {unknown[0]!r}; choose from {', '.join(PARAMETER_SETS)}"
        )
    if both := sorted({*fix} & {*free}):
        raise InvalidArgumentError(f"{both[0]!r} is both fixed and freed; leave out one of the two")
    parameters_by_set = {name: PARAMETER_SETS[name](chain) for name in names}
    if empty := [name for name, parameters in parameters_by_set.items() if not parameters]:
        raise DhcalError(
            f"{chain.urdf.source}: no joint has parameters of the set {empty[0]!r}; "
            f"the set needs {FAMILIES[empty[0]].requirement}"
        )
    pool = {p.name: p for parameters in parameters_by_set.values() for p in parameters}
    fixed = _fixed_names(chain, fix, pool)
    pool |= _freed_parameters(chain, [name for name in free if name not in pool])
    fixed -= set(free)
    free_parameters = [p for p in pool.values() if p.name not in fixed]
    if not free_parameters:
        raise InvalidArgumentError("no parameter is left to identify; fix fewer of them")
    fixed_parameters = tuple(p for p in pool.values() if p.name in fixed)
    return ErrorModel(chain, (), fixed_parameters).with_parameters(free_parameters)


def fold_harmonics(names: Iterable[str]) -> list[str]:
    """Replace the harmonics of each joint by one entry, for messages that list parameters.

    >>> fold_harmonics(["j1.gain", "j1.sin3", "j1.cos3", "j1.sin4", "j1.cos4", "j1.sin5", "j2.sin3"])
    ['j1.gain', 'j1.sin3 ... sin5 (5 harmonics)', 'j2.sin3']
    """
    listed = list(names)
    by_joint: dict[str, list[str]] = {}
    for match in filter(None, map(_HARMONIC_NAME.fullmatch, listed)):
        by_joint.setdefault(match[1], []).append(match[2])
    folded = {
        f"{joint}.{function}": f"{joint}.{functions[0]} ... {functions[-1]} ({len(functions)} harmonics)"
        for joint, functions in by_joint.items()
        if len(functions) > MAX_LISTED_HARMONICS
        for function in functions
    }
    return list(dict.fromkeys(folded.get(name, name) for name in listed))


def _fixed_names(chain: Chain, fix: Sequence[str], pool: dict[str, ErrorParameter]) -> set[str]:
    """Return the names of all fixed parameters; fixed sets are expanded."""
    out = set[str]()
    for name in fix:
        is_set = name in PARAMETER_SETS
        members = {p.name for p in PARAMETER_SETS[name](chain)} if is_set else {name}
        if not members & set(pool):
            problem = "none of its parameters is unknown" if is_set else "no such parameter"
            choices = ", ".join(fold_harmonics(pool))
            raise UnknownNameError(f"cannot fix {name!r}: {problem}; choose from {choices}")
        out |= members
    return out


def _freed_parameters(chain: Chain, names: Sequence[str]) -> dict[str, ErrorParameter]:
    """Find single parameters among all sets."""
    if not names:
        return {}
    parameters = {p.name: p for build in PARAMETER_SETS.values() for p in build(chain)}
    for name in names:
        if name in PARAMETER_SETS:
            raise UnknownNameError(f"cannot free {name!r}: it is a whole set; add it to the parameters")
        if name not in parameters:
            choices = ", ".join(fold_harmonics(parameters))
            raise UnknownNameError(f"cannot free {name!r}: no such parameter; choose from {choices}")
    return {name: parameters[name] for name in names}
