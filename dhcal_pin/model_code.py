"""Source code of a robot's model for other programs: a C header, or a Python module that needs NumPy only.

The code computes the pose of the tip in the frame of the base link with all joint errors, its body Jacobian
by the commanded joint positions, and joint positions for a pose. Base and tool are constants of it, with
functions between the tip and the measured point. The ending of the file name selects the language, one row
of `LANGUAGES` with its template.

Joint terms and link terms are the formulas in the rows of `robot.error_families`. The actual joint
positions q + Δ(q) of `robot.transmission` have the derivatives

    ∂q_i/∂q_j = δ_ij + A_ij + δ_ij·Σ_k k·(S_ki·cos(k·q_i) - C_ki·sin(k·q_i)) + Σ_f c_fi·∂t_fi/∂q_j.

The derivative of compliance is that of the gravity torques. With the first moment m_j of the mass M_j
behind joint j, its axis z_j through p_j, and v_j = z_j × (m_j - M_j·p_j), the torque of joint j is g times
the vertical component of v_j. Its derivative by a joint i before it is g times that of z_i × v_j.

Names are data of the robot file. They appear as literals in which every other character is escaped, and in
comments without special characters.
"""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import pinocchio as pin

from . import se3
from ._frozen import frozen
from ._typing import Array, PathLike
from .exceptions import InvalidArgumentError
from .robot.chain import Chain
from .robot.error_families import JOINT_TERMS, LINK_TERMS, Term
from .robot.inverse_kinematics import characteristic_length
from .robot.transmission import GravityLoads, Transmission
from .robot.urdf_path import axis_frame

# Steps after which the inverse kinematics gives up.
MAX_STEPS = 100
# Constants of the code by name: arrays, numbers, and trees, which are tables of arrays.
_Constants = Mapping[str, Array | float | Mapping[str, Array]]
# Length of the lines of numbers [characters].
_LINE_LENGTH = 120


@frozen
class Language:
    """How a language states constants and the terms of joint errors."""

    template: str  # Name of the file with the template
    constants: Callable[[_Constants, str], str]  # States the constants, whose names begin with a prefix
    names: Callable[[Sequence[str]], str]  # States a list of names
    torques: str  # Statement that computes the gravity torques
    # Statement that adds a joint term with its `{formula}`, of the family `{name}` or `{NAME}`.
    joint_term: str
    derivative: str  # Statement that adds its derivative
    link_term: str  # Statement that adds a link term


def model_code(chain: Chain, path: PathLike) -> str:
    """Write the model of a robot as source code in the language of the ending of a file name."""
    stem, ending = os.path.splitext(os.path.basename(os.fspath(path)))
    language = LANGUAGES.get(ending.lower())
    if language is None:
        raise InvalidArgumentError(f"{os.fspath(path)}: unknown ending; choose from {', '.join(LANGUAGES)}")
    prefix = re.sub(r"\W", "_", stem, flags=re.ASCII).strip("_")
    if not prefix[:1].isalpha():
        prefix = f"model_{prefix}".strip("_")
    transmission = chain.transmission or Transmission.zero(chain.loads)
    constants = _constants(chain, transmission)
    template = Path(__file__).with_name(language.template).read_text(encoding="utf-8")
    plain = {"robot": chain.urdf.name, "root": chain.root, "tip": chain.tip}
    return Template(template).substitute(
        {key: re.sub(r"[^\w .-]", "_", name, flags=re.ASCII) for key, name in plain.items()},
        p=prefix,
        P=prefix.upper(),
        version=metadata.version("dhcal-pin"),
        n=chain.n_joints,
        k=len(chain.moving_joints),
        orders=len(constants["waves"]),
        max_steps=MAX_STEPS,
        names=language.names(chain.joint_names),
        constants=language.constants(constants, prefix),
        terms=_terms(transmission, language).replace("PREFIX", prefix),
    )


def _constants(chain: Chain, transmission: Transmission) -> dict[str, Any]:
    """Return the constants of a robot."""
    loads, k = transmission.loads, len(chain.moving_joints)
    tree = {
        "parent": np.arange(k + 1),
        "is_prismatic": chain.prismatic.astype(int),
        "mimic": chain.mimic_matrix,
        "offset": chain.mimic_offset,
        "link": chain.link_transforms,
    }
    weights, mass, moment = _weights(chain, loads)
    return {
        "chain": tree,
        "weights": weights,
        "mass": mass,
        "moment": moment,
        "gravity": -float(loads.model.gravity.linear[2]),
        "payload": float(loads.payload.mass if loads.payload else 0.0),
        "temperature": float(loads.reference_temperature),
        "linear": transmission.linear,
        "waves": transmission.harmonics[: max(transmission.order, 1)],
        **{name: values for name, _, values in _used_terms(transmission)},
        "growth_vectors": chain.growth_vectors,
        "base": chain.base,
        "tool": chain.tool,
        "length": characteristic_length(chain.with_base_and_tool(np.eye(4), np.eye(4))),
    }


def _weights(chain: Chain, loads: GravityLoads) -> tuple[dict[str, Array], Array, Array]:
    """Return the tree of the moving joints in Pinocchio's order, and masses and first moments of bodies."""
    # Joints that are not on the chain stay at neutral. The payload is the last body.
    model = loads.model
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    placed = [placement.homogeneous for placement in data.oMi]
    numbers = [model.getJointId(name) for name in loads.moving_joints]
    order = np.argsort(numbers)
    axes = np.where(np.array(chain.is_reversed)[:, None], -chain.axes, chain.axes)
    bodies, frames, parents = [0], [np.eye(4)], []
    for joint in range(1, model.njoints):
        bodies.append(bodies[model.parents[joint]])
        if joint in numbers:
            parents.append(bodies[joint])
            bodies[joint] = len(frames)
            frames.append(placed[joint] @ axis_frame(tuple(axes[numbers.index(joint)].tolist())))
    mass, moment = np.zeros(len(frames)), np.zeros((len(frames), 3))
    for body, placement, inertia in zip(bodies, placed, model.inertias, strict=True):
        mass[body] += inertia.mass
        centre = se3.inverse(frames[body]) @ placement @ np.append(inertia.lever, 1.0)
        moment[body] += inertia.mass * centre[:3]
    tip = model.frames[model.getFrameId(loads.tip, pin.FrameType.BODY)]
    centre = se3.transform(np.eye(3), np.array(loads.payload.centre if loads.payload else (0.0, 0.0, 0.0)))
    parents.append(bodies[tip.parentJoint])
    frames.append(placed[tip.parentJoint] @ tip.placement.homogeneous @ centre)
    tree = {
        "parent": np.array(parents),
        "is_prismatic": chain.prismatic[order].astype(int),
        "mimic": loads.mimic_matrix[order],
        "offset": loads.mimic_offset[order],
        "link": se3.inverse(np.array(frames)[parents]) @ np.array(frames[1:]),
    }
    return tree, mass, moment


def _used_terms(transmission: Transmission) -> list[tuple[str, Term, Array]]:
    """List families with a joint term or a link term that is not zero: name, term and coefficients."""
    rows = (*transmission.joint_terms, *transmission.link_terms)
    pairs = zip((JOINT_TERMS | LINK_TERMS).items(), rows, strict=True)
    return [(name, term, values) for (name, term), values in pairs if values.any()]


def _terms(transmission: Transmission, language: Language) -> str:
    """Write the statements of the joint terms and link terms."""
    used = _used_terms(transmission)
    lines = [language.torques] if any("torque" in term.formula for _, term, _ in used) else []
    for name, term, _ in used:
        statements = [(language.link_term, term.formula)]
        if name in JOINT_TERMS:
            statements = [(language.joint_term, term.formula), (language.derivative, term.derivative)]
        lines += [
            statement.format(name=name, NAME=name.upper(), formula=formula.format(i="i", j="j"))
            for statement, formula in statements
            if formula != "0"
        ]
    return textwrap.indent("".join(f"{line}\n" for line in lines), "    ")


def _literal(values: Any, brackets: str = "[]") -> str:
    """Write numbers with all digits, in lines."""
    text = repr(np.asarray(values).tolist()).translate(str.maketrans("[]", brackets))
    return textwrap.fill(text, _LINE_LENGTH, subsequent_indent="    ")


def _c_constants(constants: _Constants, prefix: str) -> str:
    """State constants in C; arrays are flat."""
    lines = []
    for name, values in constants.items():
        if isinstance(values, Mapping):
            parts = ",\n    ".join(_literal(np.ravel(part), "{}") for part in values.values())
            lines.append(f"static const {prefix}_tree {prefix}_{name} = {{{parts}}};")
        elif np.ndim(values):
            flat = np.ravel(values)
            lines.append(f"static const double {prefix}_{name}[{flat.size}] = {_literal(flat, '{}')};")
        else:
            lines.append(f"static const double {prefix}_{name} = {values!r};")
    return "\n".join([*lines, ""])


def _python_constants(constants: _Constants, prefix: str) -> str:
    """State constants in Python."""
    lines = []
    for name, values in constants.items():
        if isinstance(values, Mapping):
            parts = [f'    "{key}": np.array({_literal(part)}),' for key, part in values.items()]
            lines.append("\n".join([f"{name.upper()} = {{", *parts, "}"]))
        else:
            value = f"np.array({_literal(values)})" if np.ndim(values) else repr(values)
            lines.append(f"{name.upper()} = {value}")
    return "\n".join([*lines, ""])


def _c_names(names: Sequence[str]) -> str:
    """State names in C, with all bytes but letters, digits and some signs as octal numbers."""
    texts = (re.sub(rb"[^\w .-]", lambda match: b"\\%03o" % match[0][0], name.encode()) for name in names)
    return "{\n        " + ",\n        ".join(f'"{text.decode()}"' for text in texts) + "}"


LANGUAGES = {
    ".h": Language(
        "model_code.h.in",
        _c_constants,
        _c_names,
        "double torque[N], torque_by_q[N][N];\n"
        "PREFIX_gravity_torques(q, known->payload, torque, by_q ? torque_by_q : NULL);",
        "for (int i = 0; i < N; i++)\n    actual[i] += PREFIX_{name}[i] * ({formula});",
        "for (int i = 0; by_q && i < N; i++)\n    for (int j = 0; j < N; j++)\n"
        "        by_q[i][j] += PREFIX_{name}[i] * ({formula});",
        "for (int j = 0; j <= K; j++)\n    growth[j] += PREFIX_{name}[j] * ({formula});",
    ),
    ".py": Language(
        "model_code.py.in",
        _python_constants,
        lambda names: ascii(list(names)),
        "torque, torque_by_q = _gravity(q, payload)",
        "for i in range(n):\n    actual[i] += {NAME}[i] * ({formula})",
        "for i in range(n):\n    for j in range(n):\n        by_q[i][j] += {NAME}[i] * ({formula})",
        "for j in range(len(growth)):\n    growth[j] += {NAME}[j] * ({formula})",
    ),
}
