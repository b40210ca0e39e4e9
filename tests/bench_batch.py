"""Stacked calibrations against single ones and against finite differences through Pinocchio.

The paper's 6-DOF study, ten poses, noise of 0.1 mm and 0.1 mrad.
"""

import statistics
import time

import numpy as np
import pinocchio as pin
from bench_common import Row, clocked, fit_geometry
from robots import paper
from scipy.optimize import least_squares

from dhcal_pin.estimation.batch import BatchProblem, BatchResult, ChainBatch, solve_batch
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.measurements.base import Noise, concatenate
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.parallel import SERIAL, TaskExecutor, open_executor
from dhcal_pin.robot.chain import Chain

MANY, FEW, SLOW = 1000, 20, 4
NOMINAL, ACTUAL = (Chain.from_dh(paper(name)) for name in ("sim_6dof", "sim_6dof_actual"))
ERRORS = select_parameters(NOMINAL, "dh")


def measured(seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose.simulate(ACTUAL, rng.uniform(-np.pi, np.pi, (10, 6)), Noise(1e-4, 1e-4), rng)


def differences(data: Pose) -> np.ndarray:
    """What people do: SciPy, two-point differences, and Pinocchio a sample at a time."""
    model, k = NOMINAL.model.copy(), len(NOMINAL.moving_joints)
    state = model.createData()
    joints = [model.getJointId(name) for name in NOMINAL.moving_joints]
    origins = [model.jointPlacements[i].copy() for i in joints]
    tip = model.frames[NOMINAL.frame_id].placement.copy()
    goals = [pin.SE3(pose) for pose in data.poses]
    twists = [(p.error_frame, np.array(p.twist)) for p in ERRORS.parameters]

    def residual(x: np.ndarray) -> np.ndarray:
        left = [pin.SE3.Identity() for _ in range(k + 1)]
        right = [pin.SE3.Identity() for _ in range(k + 1)]
        for (station, twist), value in zip(twists, x, strict=True):
            motion = pin.exp6(pin.Motion(twist * value))
            if station % 2:
                left[(station - 1) // 2] *= motion
            else:
                right[station // 2 - 1] *= motion
        for j, joint in enumerate(joints):
            model.jointPlacements[joint] = left[j] * origins[j] * right[j]
        end = left[k] * tip * right[k]
        out = np.empty((len(goals), 6))
        for i, (q, goal) in enumerate(zip(data.q, goals, strict=True)):
            pin.forwardKinematics(model, state, q)
            pose = state.oMi[joints[-1]] * end
            out[i, :3] = goal.translation - pose.translation
            out[i, 3:] = pin.log3(goal.rotation @ pose.rotation.T)
        return out.ravel() / 1e-4

    return least_squares(residual, np.zeros(len(twists))).x


def rows(repeats: int) -> list[Row]:
    """Stacked calibrations against single ones and differences, and two processes against one."""
    data = [measured(seed) for seed in range(MANY)]
    batch = BatchProblem(
        ChainBatch.from_models([ERRORS] * MANY), (concatenate(data),), np.zeros(len(ERRORS.parameters))
    )

    def stacked(where: TaskExecutor = SERIAL) -> BatchResult:
        return solve_batch(batch, "lm", executor=where)

    def singles() -> None:
        for item in data[:FEW]:
            fit_geometry(NOMINAL, item, "dh", priors="none")

    def slow() -> None:
        for item in data[:SLOW]:
            differences(item)

    ours, single, other = clocked([stacked, singles, slow], repeats)
    ours, single, other = ours / MANY, single / FEW, other / SLOW
    with open_executor(jobs=2) as two:
        stacked(two)
        spent: tuple[list[float], list[float]] = ([], [])
        for _ in range(repeats):
            for where, times in zip((two, SERIAL), spent, strict=True):
                start = time.perf_counter()
                stacked(where)
                times.append(time.perf_counter() - start)
    shared, alone = map(statistics.median, spent)
    study = "1,000 calibrations of ten poses, stacked"
    return [
        Row(f"{study}: single calls, each", ours, single, single / ours, "≥ 8"),
        Row(f"{study}: differences through Pinocchio, each", ours, other, other / ours, "≥ 100"),
        Row(f"{study}: two processes against one, wall clock", shared, alone, alone / shared, "≥ 1.5"),
    ]
