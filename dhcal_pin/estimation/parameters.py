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
from dataclasses import dataclass

import numpy as np

from .. import se3
from .._typing import Array
from ..exceptions import DhcalError, InvalidArgumentError, UnknownNameError
from ..robot.chain import BASE_FRAME, Chain, extract_dh_table, joint_frame, link_frame, without_mimics
from ..robot.dh import Convention
from ..robot.error_families import COMPLIANCE, COUPLING, FAMILIES, GAIN, HARMONICS
from ..robot.transmission import n_coefficients, split_coefficients
from .error_model import ErrorModel, ErrorParameter

# Prior standard deviations of manufacturing and assembly errors: lengths [m], angles and joint offsets [rad].
LENGTH_PRIOR = 1e-3
ANGLE_PRIOR = 5e-3
OFFSET_PRIOR = np.deg2rad(2.0)
# Prior standard deviations of base and tool [m, rad]: anywhere in a room.
FRAME_LENGTH_PRIOR = 10.0
FRAME_ANGLE_PRIOR = 10.0

# Prior standard deviations of transmission coefficients, typical of industrial arms: gear ratios are off by
# 0.2 % [1]; eccentricity is about 1 mrad, and a higher harmonic about 0.1 mrad [rad]; a joint yields by about
# 0.1 mrad/Nm [rad/Nm]; coupling [rad/rad or rad/m].
GAIN_PRIOR = 2e-3
HARMONIC_PRIOR, CURVE_PRIOR = 1e-3, 1e-4
COMPLIANCE_PRIOR = 1e-4
COUPLING_PRIOR = 2e-3

# Orders of the harmonics of the set `harmonics`: eccentricity and its second harmonic.
HARMONIC_ORDERS = range(1, 3)

# Smallest maximum [N·m] of the gravity torque on a compliant joint. A joint that is loaded less has no
# compliance: some URDFs have links with token masses.
MIN_TORQUE = 0.1
# Largest number of harmonics of a joint that messages list one by one.
MAX_LISTED_HARMONICS = 4
_HARMONIC_NAME = re.compile(r"(.+)\.((?:sin|cos)\d+)")

# Difference to 1 of an axis' largest component below which the axis counts as an axis of its frame.
AXIS_ALIGNMENT_TOL = 1e-5
# Angle [rad] between joint axes below which `hayati` replaces d by β.
MAX_PARALLEL_ANGLE = np.deg2rad(5.0)

_FRAME_NAMES = ("x", "y", "z", "rx", "ry", "rz")
_FRAME_UNITS = ("m", "m", "m", "rad", "rad", "rad")
_FRAME_TWISTS = np.eye(6)
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
    return abs(chain.link_transforms[link][2, 2]) > np.cos(MAX_PARALLEL_ANGLE)


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
        ErrorParameter(f"{prefix}.{name}", unit, 0.0, error_frame, tuple(twist), prior)
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
    """Build the independent errors of each joint's axis.

    A joint origin moves in all directions but along and about its axis. Those two commute with the joint's
    motion; they pass on to the next joint, and from the last joint to the tool. A translation of a prismatic
    joint's axis passes on in the same way.
    """
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


def _joint_twist(axis: Sequence[float], is_prismatic: bool) -> tuple[float, ...]:
    """Return the twist [v, ω] of a joint's own motion."""
    return (*axis, *_ZERO) if is_prismatic else (*_ZERO, *axis)


def base(chain: Chain) -> list[ErrorParameter]:
    """Build the pose of the robot's base in the measuring frame."""
    return _frame_parameters("base", BASE_FRAME, FRAME_LENGTH_PRIOR, FRAME_ANGLE_PRIOR)


def tool(chain: Chain) -> list[ErrorParameter]:
    """Build the pose of the measured point in the tip frame."""
    return _frame_parameters("tool", chain.tool_frame_index, FRAME_LENGTH_PRIOR, FRAME_ANGLE_PRIOR)


def _transmission_parameters(
    chain: Chain, joint: int, coefficients: Sequence[tuple[int, str, str]], prior: float
) -> list[ErrorParameter]:
    """Build the parameters of transmission coefficients that move an independent joint."""
    # The error acts at the first moving joint that the independent joint drives.
    moving_joint = int(np.flatnonzero(chain.mimic_matrix[:, joint])[0])
    twist = _joint_twist(chain.axes[moving_joint].tolist(), chain.prismatic[moving_joint])
    nominal = None if chain.transmission is None else chain.transmission.coefficients
    frame, joint_name = link_frame(moving_joint + 1), chain.joint_names[joint]
    return [
        ErrorParameter(
            f"{joint_name}.{name}",
            unit,
            0.0 if nominal is None else float(nominal[index]),
            frame,
            twist,
            prior,
            index,
        )
        for index, name, unit in coefficients
    ]


def _coefficient_indices(chain: Chain) -> tuple[Array, Array, Array]:
    """Return the indices of linear coefficients (n, n), harmonics (K, 2, n) and compliance (n,)."""
    return split_coefficients(np.arange(n_coefficients(chain.n_joints)), chain.n_joints)


def _revolute_joints(chain: Chain) -> list[int]:
    """Return the numbers of the independent joints that are revolute."""
    return np.flatnonzero(~chain.is_prismatic).tolist()


def gain(chain: Chain) -> list[ErrorParameter]:
    """Build the relative error of each joint's gear ratio."""
    linear, _, _ = _coefficient_indices(chain)
    return [
        parameter
        for i in range(chain.n_joints)
        for parameter in _transmission_parameters(chain, i, [(int(linear[i, i]), "gain", "1")], GAIN_PRIOR)
    ]


def harmonics(
    chain: Chain, orders: Sequence[int] = HARMONIC_ORDERS, prior: float = HARMONIC_PRIOR
) -> list[ErrorParameter]:
    """Build the periodic errors of each revolute joint: sine and cosine of multiples of its position."""
    _, indices, _ = _coefficient_indices(chain)
    out = []
    for i in _revolute_joints(chain):
        coefficients = [
            (int(indices[k - 1, part, i]), f"{function}{k}", "rad")
            for k in orders
            for part, function in enumerate(("sin", "cos"))
        ]
        out += _transmission_parameters(chain, i, coefficients, prior)
    return out


def compliance(chain: Chain) -> list[ErrorParameter]:
    """Build the rotation of each revolute joint per unit of its gravity torque."""
    _, _, indices = _coefficient_indices(chain)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (chain.n_joints, 64))
    is_loaded = np.abs(chain.loads.torques(q)).max(-1) > MIN_TORQUE
    out = []
    for i in _revolute_joints(chain):
        if is_loaded[i]:
            coefficients = [(int(indices[i]), "compliance", "rad/Nm")]
            out += _transmission_parameters(chain, i, coefficients, COMPLIANCE_PRIOR)
    return out


def coupling(chain: Chain) -> list[ErrorParameter]:
    """Build the rotation of each revolute joint per unit of every other joint's position."""
    linear, _, _ = _coefficient_indices(chain)
    units = ["rad/m" if is_prismatic else "rad/rad" for is_prismatic in chain.is_prismatic]
    out = []
    for i in _revolute_joints(chain):
        coefficients = [
            (int(linear[i, j]), source, units[j]) for j, source in enumerate(chain.joint_names) if i != j
        ]
        out += _transmission_parameters(chain, i, coefficients, COUPLING_PRIOR)
    return out


@dataclass(frozen=True)
class ParameterSet:
    """Parameter set that users select by name; calling it returns its parameters.

    Attributes:
        build: Function from a chain to the parameters of the set.
        help: One line for help texts.
    """

    build: Callable[[Chain], list[ErrorParameter]]
    help: str

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
    **{
        name: ParameterSet(build, FAMILIES[name].description)
        for name, build in (
            (GAIN, gain),
            (HARMONICS, harmonics),
            *(
                (family.name, functools.partial(harmonics, orders=family.orders, prior=CURVE_PRIOR))
                for family in FAMILIES.values()
                if family.orders
            ),
            (COMPLIANCE, compliance),
            (COUPLING, coupling),
        )
    },
}

# Sets that model selection may add.
EXTENSIONS = tuple(FAMILIES)


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
    names = [s.strip() for s in sets.split(",")] if isinstance(sets, str) else list(sets)
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
