"""The kernel's own figures: an iteration against LAPACK, the Jacobian against Pinocchio, growth."""

import numpy as np
import pinocchio as pin
from bench_common import Row, clocked, problem, robots, serial
from robots import nominal_arm
from scipy.linalg import lapack

from dhcal_pin import se3
from dhcal_pin._kernels.work_arrays import work_array
from dhcal_pin.estimation.error_model import ErrorModel
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.estimation.problem import CHUNK_SIZE, linearize_and_factor
from dhcal_pin.estimation.qr import pseudo_inverse
from dhcal_pin.measurements.base import whitened_jacobian
from dhcal_pin.robot.chain import Chain, link_frame


def iteration(chain: Chain, sets: str, m: int, repeats: int) -> tuple[float, float]:
    """Seconds of a whole iteration, and of LAPACK's geqrf of the same whitened rows [J | r]."""
    case, x = problem(chain, sets, m)
    none = np.empty(0)

    def ours() -> np.ndarray:
        free = linearize_and_factor(case, x, small_angle=False).with_priors(case.weights, x)
        return pseudo_inverse(free.r, free.z)

    (data,) = case.data
    model = case.errors.derivative(x)
    frames = model[0].forward_kinematics(data.q)
    residual = data.residual(frames, none)
    rows = whitened_jacobian(data, model, frames, none, residual)
    whole = np.concatenate([rows.reshape(len(x), -1), residual.reshape(1, -1)])
    room = np.empty_like(whole)

    def copy() -> None:
        room[:] = whole

    def theirs() -> None:
        room[:] = whole
        lapack.dgeqrf(room.T, overwrite_a=1)

    mine, geqrf, copying = clocked([ours, theirs, copy], repeats)
    return mine, geqrf - copying


def iterations(sizes: tuple[int, ...], repeats: int) -> list[Row]:
    """An iteration as a multiple of geqrf."""
    wanted = {100: "≤ 6", 1000: "≤ 1.6", 10000: "≤ 1.3"}
    out = []
    for name, (chain, sets) in robots().items():
        for m in sizes:
            ours, theirs = iteration(chain, sets, m, repeats)
            what = f"iteration as a multiple of LAPACK geqrf, {name}, m={m}"
            out.append(Row(what, ours, theirs, ours / theirs, wanted[m]))
    return out


def jacobian(chain: Chain, sets: str, m: int, repeats: int) -> tuple[float, float, float]:
    """Seconds of our kernel and of Pinocchio's loop, and the largest difference of their Jacobians."""
    errors = select_parameters(chain, sets)
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (m, chain.n_joints))
    _, bodies, twists = errors.derivative(np.zeros(len(errors.parameters)))
    out = np.empty((len(bodies), 6, m))

    def ours() -> None:
        # In pieces that stay in the caches, as the solver takes them.
        for at in range(0, m, CHUNK_SIZE):
            motion = chain.joint_state(q[at : at + CHUNK_SIZE])
            k, some = motion.positions.shape
            frames = chain.forward_kinematics(motion, work_array("sweep", k + 2, 7, 3, some))
            chain.tool_jacobian(frames, bodies, twists, out[..., at : at + CHUNK_SIZE])

    model, frame = chain.model, chain.frame_id
    data = model.createData()
    stored, poses = np.empty((m, 6, len(bodies))), np.empty((m, 4, 4))
    rows, (mixing, last) = chain.configurations(q), _mixing(errors, model)

    def theirs() -> None:
        for i, row in enumerate(rows):
            pin.forwardKinematics(model, data, row)
            poses[i] = pin.updateFramePlacement(model, data, frame).homogeneous
            full = pin.computeFrameKinematicRegressor(model, data, frame, pin.LOCAL)
            np.matmul(full, mixing, out=stored[i])
        np.add(stored, last, out=stored)

    mine, loop = clocked([ours, theirs], repeats)
    turns = poses[:, :3, :3]
    seen = np.concatenate([turns @ stored[:, :3], turns @ stored[:, 3:]], 1)
    return mine, loop, float(np.abs(out.transpose(2, 1, 0) - seen).max())


def _mixing(errors: ErrorModel, model: pin.Model) -> tuple[np.ndarray, np.ndarray]:
    """The errors as changes of Pinocchio's joint placements (6·joints, p), and of the tip's (6, p).

    A joint's placement is a right perturbation before the motion, as Pinocchio's regressor has it, and a
    link's motion is one of the next placement seen from the left.
    """
    chain = errors.chain
    out = np.zeros((6 * model.njoints, len(errors.parameters)))
    firsts = [6 * (model.getJointId(name) - 1) for name in chain.moving_joints] + [len(out) - 6]
    for column, parameter in enumerate(errors.parameters):
        j = (parameter.error_frame - 1) // 2
        twist = np.array(parameter.twist)
        if parameter.error_frame == link_frame(j):
            twist = se3.adjoint(se3.inverse(chain.origins[j])) @ twist
        out[firsts[j] : firsts[j] + 6, column] = twist
    return out[:-6], out[-6:]


def jacobians(repeats: int) -> list[Row]:
    """How many times faster the Jacobian is than Pinocchio's loop."""
    arms = robots()
    dh, ur10 = (chain for chain, _ in arms.values())
    cases = [
        ("paper's 6-DOF, dh", dh, "dh", 1000, "≥ 10"),
        ("paper's 6-DOF, dh", dh, "dh", 10000, "≥ 14"),
        ("UR10, six a placement", ur10, "placement", 1000, "≥ 7"),
        ("Panda, six a placement", nominal_arm("panda"), "placement", 1000, "≥ 7"),
    ]
    out = []
    for name, chain, sets, m, wanted in cases:
        ours, theirs, off = jacobian(chain, sets, m, repeats)
        assert off <= 1e-11, off
        what = f"Jacobian against Pinocchio's loop, {name}, m={m} (differ by {off:.0e})"
        out.append(Row(what, ours, theirs, theirs / ours, wanted))
    return out


def growth(sizes: tuple[int, ...], repeats: int) -> list[tuple[str, list[float]]]:
    """Microseconds a sample of an iteration by number of samples, and by number of joints at m=1000."""
    out = []
    for name, (chain, sets) in robots().items():
        out.append((name, [1e6 * _one(chain, sets, m, repeats if m < 1e5 else 3) / m for m in sizes]))
    return out


def by_joints(joints: tuple[int, ...], repeats: int) -> list[float]:
    """Microseconds a sample of an iteration at m=1000 with four errors a joint."""
    return [1e3 * _one(Chain.from_dh(serial(n)), "minimal", 1000, repeats) for n in joints]


def _one(chain: Chain, sets: str, m: int, repeats: int) -> float:
    case, x = problem(chain, sets, m)
    return clocked([lambda: linearize_and_factor(case, x, small_angle=False)], repeats)[0]
