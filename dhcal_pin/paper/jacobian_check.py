"""Cross-check of the Jacobian: the same derivative by six independent routes.

The paper's matrix R (see `factors`) is compared with

1. the DH product itself, whose poses must be Pinocchio's poses,
2. the Jacobian of the compiled kernels that calibrate,
3. Pinocchio's frame Jacobian, whose columns are those of Δθ, or of Δd for a prismatic joint,
4. Pinocchio's Jacobian of a chain with four virtual joints Rz, Tz, Tx, Rx per link,
5. Pinocchio's kinematic regressor: derivatives with respect to a right perturbation of every joint placement,
6. central differences of the DH product.

Shapes: m configurations, n joints, p parameters. Jacobians are (m, 6, p), twists [v, ω] in the tool frame.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..estimation.error_model import ErrorModel
from ..estimation.parameters import select_parameters
from ..robot.chain import Chain, extract_dh_table, link_frame, without_mimics
from ..robot.dh import DHTable
from .factors import error_factors

# Largest allowed difference [m or rad]: of exact derivatives, and of central differences.
EXACT_TOL, NUMERICAL_TOL = 1e-12, 1e-7
# Step of the central differences [rad or m].
_STEP = 1e-5
# Columns of the paper's R: the parameters of all joints, one kind after the other.
_KINDS = ("theta", "d", "a", "alpha")


@frozen
class Agreement:
    """Agreement of one route with the paper's R."""

    route: str  #: Name of the route
    columns: int  #: Number of columns of R that were compared; 0 for a comparison of poses
    difference: float  #: Largest absolute difference [m or rad]
    tolerance: float  #: Largest allowed difference [m or rad]

    @property
    def agrees(self) -> bool:
        """Whether the difference is allowed."""
        return self.difference <= self.tolerance


def _paper_order(errors: ErrorModel, n_joints: int) -> Array:
    """Return the index in the error model of each column Δθ…, Δd…, Δa…, Δα…, shape (4n,)."""
    index = {parameter.name: i for i, parameter in enumerate(errors.parameters)}
    return np.array([index[f"{kind}{i + 1}"] for kind in _KINDS for i in range(n_joints)])


def kernel_jacobian(chain: Chain, errors: ErrorModel, q: Array) -> Array:
    """Compute the Jacobian with the kernels that calibrate."""
    _, bodies, twists = errors.derivative(np.zeros(len(errors.parameters)))
    frames = chain.forward_kinematics(q)
    jacobian = chain.tool_jacobian(frames, bodies, twists)
    rotation = frames.tool[:3]  # columns, components, samples
    linear = np.einsum("crm,prm->mcp", rotation, jacobian[:, :3])
    angular = np.einsum("crm,prm->mcp", rotation, jacobian[:, 3:])
    return np.concatenate([linear, angular], 1)


def frame_jacobian(chain: Chain, q: Array) -> Array:
    """Compute Pinocchio's LOCAL frame Jacobian at the tip."""
    model, frame = chain.model, chain.frame_id
    data = model.createData()
    columns = [model.joints[model.getJointId(name)].idx_v for name in chain.moving_joints]
    jacobians = [
        pin.computeFrameJacobian(model, data, configuration, frame, pin.ReferenceFrame.LOCAL)
        for configuration in chain.configurations(q)
    ]
    # Pinocchio returns a vector for a single joint.
    return np.array(jacobians).reshape(len(q), 6, model.nv)[:, :, columns]


def augmented_jacobian(table: DHTable, q: Array) -> Array:
    """Compute Pinocchio's Jacobian of a chain with one virtual joint for each DH parameter."""
    model = pin.Model()
    parent, placement = 0, pin.SE3(table.base)
    for i in range(table.n_joints):
        joints = [pin.JointModelRZ(), pin.JointModelPZ(), pin.JointModelPX(), pin.JointModelRX()]
        for joint, kind in zip(joints, _KINDS, strict=True):
            parent = model.addJoint(parent, joint, placement, f"{kind}{i + 1}")
            placement = pin.SE3.Identity()
        placement = pin.SE3(se3.exp6([0, 0, 0, 0, table.beta[i], 0]))
    tool = pin.Frame("tool", parent, placement * pin.SE3(table.tool), pin.FrameType.OP_FRAME)
    frame = model.addFrame(tool)
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


def regressor_jacobian(chain: Chain, errors: ErrorModel, q: Array) -> Array:
    """Compute the Jacobian from Pinocchio's kinematic regressor of each joint placement, and the matrix K."""
    model, frame = chain.model, chain.frame_id
    data = model.createData()
    n_moving = len(chain.moving_joints)
    perturbations = np.zeros((6 * n_moving + 6, len(errors.parameters)))
    for column, parameter in enumerate(errors.parameters):
        twist = np.array(parameter.twist)
        # Placement j lies between the error frames of link j and joint j+1; the last one is that of the tip.
        j = (parameter.error_frame - 1) // 2
        if parameter.error_frame == link_frame(j):
            twist = se3.adjoint(se3.inverse(chain.origins[j])) @ twist
        perturbations[6 * j : 6 * j + 6, column] = twist
    columns = np.concatenate(
        [np.arange(6) + 6 * (model.getJointId(name) - 1) for name in chain.moving_joints]
    )
    out = np.empty((len(q), 6, len(errors.parameters)))
    for i, configuration in enumerate(chain.configurations(q)):
        pin.forwardKinematics(model, data, configuration)
        pin.updateFramePlacements(model, data)
        regressor = pin.computeFrameKinematicRegressor(model, data, frame, pin.ReferenceFrame.LOCAL)
        out[i] = np.concatenate([regressor[:, columns], np.eye(6)], 1) @ perturbations
    return out


def numerical_jacobian(table: DHTable, q: Array) -> Array:
    """Compute central differences of the DH product."""
    columns = []
    for kind in _KINDS:
        for i in range(table.n_joints):
            shift = np.eye(table.n_joints)[i] * _STEP
            up, down = (
                replace(table, **{kind: getattr(table, kind) + sign * shift}).poses(q) for sign in (1.0, -1.0)
            )
            columns.append(se3.log6(se3.inverse(down) @ up) / (2 * _STEP))
    return np.stack(columns, -1)


def crosscheck(chain: Chain, samples: int = 100, seed: int = 0) -> list[Agreement]:
    """Compare all routes with the paper's R at random joint positions.

    Base, tool and joint errors are left out. A joint that mimics another one is a row of the DH table like
    any other, and moves independently here.

    Args:
        chain: Robot to check.
        samples: Number of random configurations.
        seed: Seed of the configurations.

    Returns:
        Agreement of each route.
    """
    chain = without_mimics(replace(chain, base=np.eye(4), tool=np.eye(4), transmission=None))
    table = extract_dh_table(chain).table
    n = table.n_joints
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (samples, n))
    paper = error_factors(table, q)
    errors = select_parameters(chain, "dh")
    order = _paper_order(errors, n)
    # Columns of R that are the derivative with respect to the joint positions.
    joint_columns = np.where(table.prismatic, np.arange(n) + n, np.arange(n))

    def compare(
        route: str, columns: int, actual: Array, expected: Array = paper, tolerance: float = EXACT_TOL
    ) -> Agreement:
        return Agreement(route, columns, float(np.abs(actual - expected).max()), tolerance)

    kernel = kernel_jacobian(chain, errors, q)[:, :, order]
    regressor = regressor_jacobian(chain, errors, q)[:, :, order]
    return [
        compare("DH product = Pinocchio's poses", 0, table.poses(q), _pinocchio_poses(chain, q)),
        compare("vectorised Jacobian", 4 * n, kernel),
        compare("Pinocchio, LOCAL frame Jacobian", n, frame_jacobian(chain, q), paper[:, :, joint_columns]),
        compare("Pinocchio, augmented chain", 4 * n, augmented_jacobian(table, q)),
        compare("Pinocchio, kinematic regressor times K", 4 * n, regressor),
        compare("central differences", 4 * n, numerical_jacobian(table, q), tolerance=NUMERICAL_TOL),
    ]


def _pinocchio_poses(chain: Chain, q: Array) -> Array:
    """Return Pinocchio's poses of the tip, shape (m, 4, 4)."""
    model, frame = chain.model, chain.frame_id
    data = model.createData()
    poses = []
    for configuration in chain.configurations(q):
        pin.framesForwardKinematics(model, data, configuration)
        poses.append(data.oMf[frame].homogeneous)
    return np.array(poses)
