"""The same derivative by six routes: the paper, the fast kernel, Pinocchio three times, differences."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from .. import se3
from .._typing import Array
from ..estimation.error_model import ErrorModel
from ..estimation.parameters import select_parameters
from ..robot.chain import Chain, extract_dh_table, link_frame, without_mimics
from ..robot.dh import DHTable
from .factors import error_factors

ALGEBRAIC, NUMERICAL = 1e-12, 1e-7


_STEP = 1e-5


@dataclass(frozen=True)
class Agreement:
    """One route's largest difference from the paper's R, m and rad, and what is allowed."""

    route: str
    columns: int
    difference: float
    tolerance: float

    @property
    def agrees(self) -> bool:
        """Whether the route agrees."""
        return self.difference <= self.tolerance


def _order(errors: ErrorModel, n: int) -> Array:
    """Where the paper's columns Δθ… Δd… Δa… Δα… stand in the model's order."""
    place = {p.name: i for i, p in enumerate(errors.parameters)}
    return np.array([place[f"{kind}{i + 1}"] for kind in ("theta", "d", "a", "alpha") for i in range(n)])


def vectorised(chain: Chain, errors: ErrorModel, q: Array) -> Array:
    """The kernel's Jacobian (m, 6, p) in the tool frame."""
    _, bodies, twists = errors.derivative(np.zeros(len(errors.parameters)))
    frames = chain.forward_kinematics(q)
    velocities = chain.tool_jacobian(frames, bodies, twists)
    rotation = frames.tool[:3]  # columns, components, samples
    linear = np.einsum("crm,prm->mcp", rotation, velocities[:, :3])
    angular = np.einsum("crm,prm->mcp", rotation, velocities[:, 3:])
    return np.concatenate([linear, angular], 1)


def frame_jacobian(chain: Chain, q: Array) -> Array:
    """Pinocchio's LOCAL frame Jacobian (m, 6, n) at the tip, moving joints in path order."""
    model, frame = chain.model, chain.frame_id
    data = model.createData()
    columns = [model.joints[model.getJointId(name)].idx_v for name in chain.moving_joints]
    found = [
        pin.computeFrameJacobian(model, data, configuration, frame, pin.ReferenceFrame.LOCAL)
        for configuration in chain.configurations(q)
    ]
    # Of a single joint Pinocchio gives a vector.
    return np.array(found).reshape(len(q), 6, model.nv)[:, :, columns]


def augmented_jacobian(table: DHTable, q: Array) -> Array:
    """Pinocchio's Jacobian (m, 6, 4n) of a chain that has a virtual joint for every DH entry."""
    model = pin.Model()
    parent, place = 0, pin.SE3(table.base)
    for i in range(table.n_joints):
        joints = [pin.JointModelRZ(), pin.JointModelPZ(), pin.JointModelPX(), pin.JointModelRX()]
        for joint, name in zip(joints, ("theta", "d", "a", "alpha"), strict=True):
            parent = model.addJoint(parent, joint, place, f"{name}{i + 1}")
            place = pin.SE3.Identity()
        place = pin.SE3(se3.exp6([0, 0, 0, 0, table.beta[i], 0]))
    frame = model.addFrame(pin.Frame("tool", parent, place * pin.SE3(table.tool), pin.FrameType.OP_FRAME))
    data = model.createData()
    values = np.tile(np.stack([table.theta, table.d, table.a, table.alpha], -1), (len(q), 1, 1))
    values[:, :, 0] += np.where(table.prismatic, 0.0, q)
    values[:, :, 1] += np.where(table.prismatic, q, 0.0)
    order = np.arange(4 * table.n_joints).reshape(-1, 4).T.reshape(-1)
    return np.array(
        [
            pin.computeFrameJacobian(model, data, row, frame, pin.ReferenceFrame.LOCAL)[:, order]
            for row in values.reshape(len(q), -1)
        ]
    )


def regressor(chain: Chain, errors: ErrorModel, q: Array) -> Array:
    """Pinocchio's kinematic regressor times K (m, 6, p): placements' right perturbations to errors."""
    model, frame = chain.model, chain.frame_id
    data = model.createData()
    k = len(chain.moving_joints)
    mixing = np.zeros((6 * k + 6, len(errors.parameters)))
    for column, parameter in enumerate(errors.parameters):
        twist = np.array(parameter.twist)
        # Placement j stands between station link j and station joint j+1; the last one is the tip.
        j = (parameter.error_frame - 1) // 2
        if parameter.error_frame == link_frame(j):
            twist = se3.adjoint(se3.inverse(chain.origins[j])) @ twist
        mixing[6 * j : 6 * j + 6, column] = twist
    blocks = np.concatenate([np.arange(6) + 6 * (model.getJointId(name) - 1) for name in chain.moving_joints])
    out = np.empty((len(q), 6, len(errors.parameters)))
    for i, configuration in enumerate(chain.configurations(q)):
        pin.forwardKinematics(model, data, configuration)
        pin.updateFramePlacements(model, data)
        full = pin.computeFrameKinematicRegressor(model, data, frame, pin.ReferenceFrame.LOCAL)
        out[i] = np.concatenate([full[:, blocks], np.eye(6)], 1) @ mixing
    return out


def differences(table: DHTable, q: Array) -> Array:
    """Central differences (m, 6, 4n) of the plain DH product in every table entry."""
    columns = []
    for key in ("theta", "d", "a", "alpha"):
        for i in range(table.n_joints):
            shift = np.eye(table.n_joints)[i] * _STEP
            up, down = (
                replace(table, **{key: getattr(table, key) + sign * shift}).poses(q) for sign in (1.0, -1.0)
            )
            columns.append(se3.log6(se3.inverse(down) @ up) / (2 * _STEP))
    return np.stack(columns, -1)


def crosscheck(chain: Chain, samples: int = 100, seed: int = 0) -> list[Agreement]:
    """All routes against the paper's R at random joint values; base, tool and joints' errors left out.

    A joint that mimics another is a row of the table like any other, and moves by itself here.
    """
    chain = without_mimics(replace(chain, base=np.eye(4), tool=np.eye(4), transmission=None))
    found = extract_dh_table(chain)
    table, n = found.table, found.table.n_joints
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (samples, n))
    paper = error_factors(table, q)
    errors = select_parameters(chain, "dh")
    order = _order(errors, n)
    motion = np.where(table.prismatic, np.arange(n) + n, np.arange(n))
    kernel = vectorised(chain, errors, q)[:, :, order]

    def gap(other: Array, mine: Array = paper) -> float:
        return float(np.abs(other - mine).max())

    return [
        Agreement("DH product = Pinocchio's poses", 0, gap(table.poses(q), _poses(chain, q)), ALGEBRAIC),
        Agreement("vectorised Jacobian", 4 * n, gap(kernel), ALGEBRAIC),
        Agreement(
            "Pinocchio, LOCAL frame Jacobian",
            n,
            gap(frame_jacobian(chain, q), paper[:, :, motion]),
            ALGEBRAIC,
        ),
        Agreement("Pinocchio, augmented chain", 4 * n, gap(augmented_jacobian(table, q)), ALGEBRAIC),
        Agreement(
            "Pinocchio, kinematic regressor times K",
            4 * n,
            gap(regressor(chain, errors, q)[:, :, order]),
            ALGEBRAIC,
        ),
        Agreement("central differences", 4 * n, gap(differences(table, q)), NUMERICAL),
    ]


def _poses(chain: Chain, q: Array) -> Array:
    model, frame = chain.model, chain.frame_id
    data = model.createData()
    out = []
    for configuration in chain.configurations(q):
        pin.framesForwardKinematics(model, data, configuration)
        out.append(data.oMf[frame].homogeneous)
    return np.array(out)
