"""A whole calibration against what people do otherwise, on the same data and the same cost."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
from bench_common import Row, clocked, fit_geometry, measured, robots
from scipy.optimize import least_squares

from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.estimation.error_model import ErrorModel
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.estimation.problem import Problem
from dhcal_pin.measurements.base import Noise, whitened_jacobian
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.robot.chain import Chain

NONE = np.empty(0)


def by_pinocchio(errors: ErrorModel, data: Pose, weights: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """The whitened residuals and priors, Pinocchio called a sample at a time as peers do."""
    model, frame = errors.chain.model.copy(), errors.chain.frame_id
    scratch = model.createData()
    rows = errors.chain.configurations(data.q)
    seen = [pin.SE3(pose) for pose in data.poses]
    joints = [model.getJointId(name) for name in errors.chain.moving_joints]
    sigmas = np.concatenate([data.sigma, data.rotation_sigma], 1)

    def residual(x: np.ndarray) -> np.ndarray:
        chain = errors.at(x)
        for joint, origin in zip(joints, chain.origins[:-1], strict=True):
            model.jointPlacements[joint] = pin.SE3(origin)
        model.frames[frame].placement = pin.SE3(chain.origins[-1])
        base, tool = pin.SE3(chain.base), pin.SE3(chain.tool)
        out = np.empty((len(rows), 6))
        for i, row in enumerate(rows):
            pin.forwardKinematics(model, scratch, row)
            pose = base * pin.updateFramePlacement(model, scratch, frame) * tool
            out[i, :3] = seen[i].translation - pose.translation
            out[i, 3:] = pin.log3(seen[i].rotation @ pose.rotation.T)
        return np.concatenate([(out / sigmas).ravel(), weights * x])

    return residual


def analytic(problem: Problem) -> tuple[Callable[..., np.ndarray], Callable[..., np.ndarray]]:
    """The same residuals and their Jacobian by our kernel, all samples at once."""
    errors, (data,) = problem.errors, problem.data
    motion = errors.chain.joint_state(data.q)

    def residual(x: np.ndarray) -> np.ndarray:
        rows = data.residual(errors.at(x).forward_kinematics(motion), NONE)
        return np.concatenate([rows.ravel(), problem.weights * x])

    def jacobian(x: np.ndarray) -> np.ndarray:
        model = errors.derivative(x)
        frames = model[0].forward_kinematics(motion)
        rows = whitened_jacobian(data, model, frames, NONE, data.residual(frames, NONE)).reshape(len(x), -1)
        return np.concatenate([-rows.T, np.diag(problem.weights)])

    return residual, jacobian


def cases(m: int) -> list[tuple[str, Chain, str, Pose]]:
    """The arms with data of their own, the second in a frame that nobody gave."""
    return [(name, chain, sets, measured(chain, sets, m)[2]) for name, (chain, sets) in robots().items()]


def against_scipy(m: int, repeats: int) -> list[Row]:
    """Scipy's least_squares from the same start, by differences through Pinocchio and by our Jacobian."""
    out = []
    for name, chain, sets, data in cases(m):
        fit = fit_geometry(chain, data, sets)
        # The rivals are given the placed frames for nothing, and the priors that the fit ended with.
        problem = fit.problem
        slow = by_pinocchio(problem.errors, data, problem.weights)
        residual, jacobian = analytic(problem)
        start = np.zeros(len(fit.x))
        found: dict[str, np.ndarray] = {}

        def scipy(way: str, residual: Callable, *jacobian: Any, start=start, found=found) -> None:
            found[way] = least_squares(residual, start, *jacobian, x_scale="jac").x

        mine = partial(fit_geometry, chain, data, sets)
        for way, functions, times, wanted in (
            ("differences through Pinocchio", (slow,), repeats, "≥ 80"),
            ("our Jacobian", (residual, jacobian), 5 * repeats, "≥ 4"),
        ):
            ours, theirs = clocked([mine, partial(scipy, way, *functions)], times)
            out.append(
                Row(f"calibration: scipy with {way}, {name}, m={m}", ours, theirs, theirs / ours, wanted)
            )
        reached = [float(np.sum(residual(x) ** 2)) for x in (fit.x, *found.values())]
        assert reached[0] <= min(reached[1:]) * (1 + 1e-6), reached
    return out


def with_families(chain: Chain, m: int) -> Pose:
    """Measurements of an arm with errors of its joints up to the 32nd harmonic, and elastic joints."""
    rng = np.random.default_rng(0)
    errors = select_parameters(chain, "minimal,base,tool,harmonics,compliance,curves")
    x = rng.standard_normal(len(errors.parameters)) * np.minimum(errors.priors, 0.1)
    q = rng.uniform(-2.5, 2.5, (m, chain.n_joints))
    return Pose.simulate(errors.at(x).with_current_loads(), q, Noise(5e-5, 1e-4), rng)


def against_geometry_only(m: int, repeats: int) -> list[Row]:
    """The default, which tries families of joint errors, against the geometry alone on the same data."""
    chain, sets = robots()["UR10, minimal,base,tool"]
    out = []
    for what, data, wanted in (
        ("no family supported", measured(chain, sets, m)[2], "≤ 10"),
        ("curves added", with_families(chain, m), "≤ 2 s"),
    ):
        ways = [partial(calibrate, chain, data, sets, extend=extend) for extend in ("auto", "none")]
        ours, theirs = clocked(ways, repeats)
        name = f"calibration: default as a multiple of geometry only, {what}, m={m}"
        out.append(Row(name, ours, theirs, ours / theirs, wanted))
    return out
