"""Mounting of an arm: whether its joints yield to a gravity in another direction than that of its URDF.

A joint j of compliance c_j turns by c_j times the torque of gravity on it. This torque is linear in the unit
vector u that points up in the axes of the root link: c_j·Σ_i u_i·t_ij(q). The measurements are fitted three
times, each time with the geometry and an eccentricity of each joint, a sine and a cosine of its position:

    up along z                c_j·t_zj                as the URDF states
    free                      Σ_i b_ij·t_ij           which shows the direction of u
    up along u                c_j·Σ_i u_i·t_ij        u and c in turns, from the free fit

The last fit must leave clearly less than the first one. A gravity in the opposite direction has the same
effect with compliances of the other sign. Joints yield to gravity, so that the sign of u is that of negative
compliances.

Shapes: N rows, n joints, p unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..estimation.problem import Problem
from ..measurements.base import Measurement
from ..robot.error_families import COMPLIANCE, JOINT_TERMS
from ..robot.transmission import GravityLoads
from ..session.linear_model import Layout, whitened_rows

# Samples that are examined, and fewest rows per unknown.
MAX_EXAMINED, MIN_ROWS_PER_UNKNOWN = 250, 2.0
# Largest ratio of the RMS residuals with u and z, and smallest logarithm of the ratio of the likelihoods.
MAX_RMS_RATIO, MIN_LOG_LIKELIHOOD_RATIO = 0.8, 20.0
# Smaller residuals in standard deviations are rounding errors of simulated measurements without noise.
MIN_RMS = 1e-3
# Smallest angle between u and z [rad].
MIN_TILT = np.deg2rad(15.0)
# Number of times that u and the compliances are fitted in turns.
N_TURNS = 20


@frozen(eq=False)
class Mounting:
    """Direction of gravity that fits measurements better than that of a URDF."""

    up: Array  # Unit vector that points up, in the axes of the root link, (3,)
    root: str  # Name of the root link

    @property
    def angles(self) -> Array:
        """Roll, pitch and yaw of a fixed joint from a link whose z axis points up to the root link [rad]."""
        axis = np.cross(self.up, [0.0, 0.0, 1.0])
        sine, cosine = float(np.linalg.norm(axis)), float(self.up[2])
        rotation = se3.exp3(axis / max(sine, 1e-300) * np.arctan2(sine, cosine))
        return np.asarray(pin.rpy.matrixToRpy(rotation))

    def to_dict(self) -> dict[str, list[float]]:
        """Return the direction and the angles for a JSON document."""
        return {"up": self.up.tolist(), "rpy_rad": self.angles.tolist()}

    @property
    def sentence(self) -> str:
        """State the direction and the remedy."""
        up = ", ".join(f"{0.0 + round(float(value), 2):.2f}" for value in self.up)
        angles = " ".join(f"{0.0 + round(float(value), 3):.3f}" for value in self.angles)
        return (
            f"The joints yield as if ({up}) in the axes of {self.root} pointed up, not z. If the arm "
            "is mounted like this, state it in the URDF: a new root link and a fixed joint from it to "
            f'{self.root} with the exact angles, which are about rpy="{angles}".'
        )


def find_mounting(problem: Problem, x: Array, data: Sequence[Measurement]) -> Mounting | None:
    """Find a direction of gravity that fits measurements clearly better than the z axis of the root link."""
    chain = problem.errors.chain
    is_sampled = all(item.has_joint_values and item.configurations_per_row == 1 for item in data)
    if not (is_sampled and data and JOINT_TERMS[COMPLIANCE].has_effect(chain.loads).any()):
        return None
    total = sum(len(item.rows) for item in data)
    thinned = tuple(item.take(np.s_[:: -(-total // MAX_EXAMINED)]) for item in data)
    effects, residual, n_unknowns = _unexplained(replace(problem, data=thinned), x)
    n_rows = sum(item.residual_dim * len(item.rows) for item in thinned)
    if n_rows < MIN_ROWS_PER_UNKNOWN * (n_unknowns + effects[0].size):
        return None
    rms_z = _fit(effects, residual, np.array([0.0, 0.0, 1.0]))[1]
    if rms_z < MIN_RMS:
        return None
    up, rms = _fit_direction(effects, residual)
    if rms > MAX_RMS_RATIO * rms_z or n_rows * np.log(rms_z / rms) < MIN_LOG_LIKELIHOOD_RATIO:
        return None
    if abs(up[2]) > np.cos(MIN_TILT):
        return None
    return Mounting(up, chain.root)


def _unexplained(problem: Problem, x: Array) -> tuple[Array, Array, int]:
    """Return what the geometry leaves of effects (N, 3, n) of unit compliances and residuals (N,).

    The last value is the number of unknowns of the geometry.
    """
    errors, chain = problem.errors, problem.errors.chain
    layout = Layout.of(problem)
    q = np.concatenate([item.q for item in problem.data])
    rows = whitened_rows(layout, x, problem.data, np.zeros(q.shape))
    model, joints = rows[..., layout.model], rows[..., layout.joints]
    is_joint_error = np.array([p.coefficient_index is not None for p in errors.parameters])
    is_joint_error = np.append(is_joint_error, np.zeros(len(x) - len(is_joint_error), bool))
    residual = rows[..., -1] + model[..., is_joint_error] @ x[is_joint_error]
    turning = ~np.asarray(chain.is_prismatic)
    own, angles = joints[..., turning], q[:, None, turning]
    known = np.concatenate([model[..., ~is_joint_error], own * np.sin(angles), own * np.cos(angles)], -1)
    effects = joints[:, :, None] * _torques(chain.loads, q)[:, None]
    widths = np.append(layout.weights[~is_joint_error], np.zeros(2 * own.shape[-1]))
    basis, _ = np.linalg.qr(np.concatenate([known.reshape(-1, known.shape[-1]), np.diag(widths)]))
    basis = basis[: residual.size]
    flat = np.column_stack([effects.reshape(residual.size, -1), residual.ravel()])
    flat -= basis @ (basis.T @ flat)
    return flat[:, :-1].reshape(residual.size, 3, -1), flat[:, -1], known.shape[-1]


def _torques(loads: GravityLoads, q: Array) -> Array:
    """Return the torques on the joints by gravity against each axis of the root link, (m, 3, n) [N·m]."""
    out = []
    for axis in np.eye(3):
        model = loads.model.copy()
        model.gravity.linear = -np.linalg.norm(loads.model.gravity.linear) * axis
        out.append(replace(loads, model=model, _cache={}).torques(np.ascontiguousarray(q.T)).T)
    return np.stack(out, 1)


def _fit(effects: Array, residual: Array, up: Array) -> tuple[Array, float]:
    """Return the compliances (n,) that fit best with a direction that points up, and the RMS they leave."""
    columns = np.tensordot(effects, up, (1, 0))
    compliance = np.linalg.lstsq(columns, residual)[0]
    return compliance, float(np.sqrt(np.mean((residual - columns @ compliance) ** 2)))


def _fit_direction(effects: Array, residual: Array) -> tuple[Array, float]:
    """Return the direction that points up and fits best, (3,), and the RMS residual that it leaves."""
    free = np.linalg.lstsq(effects.reshape(len(effects), -1), residual)[0].reshape(effects.shape[1:])
    sizes = np.sqrt(np.sum(effects**2, (0, 1)))
    up = np.linalg.svd(free * sizes)[0][:, 0]
    for _ in range(N_TURNS):
        compliance, _ = _fit(effects, residual, up)
        up = np.linalg.lstsq(effects @ compliance, residual)[0]
        up /= np.linalg.norm(up)
    compliance, rms = _fit(effects, residual, up)
    return -np.copysign(1.0, compliance @ sizes) * up, rms
