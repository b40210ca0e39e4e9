"""Stacked calibrations against single ones and against finite differences through Pinocchio.

One table of ratios, medians of interleaved repeats on one thread: `python tests/bench_batch.py`. The paper's
6-DOF study, ten poses, noise of 0.1 mm and 0.1 mrad; CPU time, but for two processes against one.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"

import statistics
import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin
from conftest import paper
from scipy.optimize import least_squares

from dhcal_pin.arms import Arms
from dhcal_pin.batch import Batch, Solutions, joined, solve
from dhcal_pin.calibration import calibrate
from dhcal_pin.chain import Chain
from dhcal_pin.executors import HERE, Workers, workers
from dhcal_pin.measurements import Noise
from dhcal_pin.parameters import select
from dhcal_pin.poses import Pose

MANY, FEW, SLOW = 1000, 20, 4
NOMINAL, ACTUAL = (Chain.from_dh(paper(name)) for name in ("sim_6dof", "sim_6dof_actual"))
ERRORS = select(NOMINAL, "dh")


def measured(seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose.simulate(ACTUAL, rng.uniform(-np.pi, np.pi, (10, 6)), Noise(1e-4, 1e-4), rng)


def differences(data: Pose) -> np.ndarray:
    """What people do: SciPy, two-point differences, and Pinocchio a sample at a time."""
    model, k = NOMINAL.model.copy(), len(NOMINAL.moving)
    state = model.createData()
    joints = [model.getJointId(name) for name in NOMINAL.moving]
    origins = [model.jointPlacements[i].copy() for i in joints]
    tip = model.frames[NOMINAL.frame_id].placement.copy()
    goals = [pin.SE3(pose) for pose in data.poses]
    twists = [(p.station, np.array(p.twist)) for p in ERRORS.parameters]

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


def main() -> None:
    """Prints the table."""
    data = [measured(seed) for seed in range(MANY)]
    batch = Batch(Arms.of([ERRORS] * MANY), (joined(data),), np.zeros(len(ERRORS.parameters)))

    def stacked(method: str, where: Workers = HERE) -> Solutions:
        return solve(batch, method, where=where)

    def singles(method: str) -> None:
        for item in data[:FEW]:
            calibrate(NOMINAL, item, "dh", method=method, priors="none")  # pyright: ignore[reportArgumentType]

    runs: dict[str, tuple[int, Callable[[], object]]] = {
        "stacked, lm": (MANY, lambda: stacked("lm")),
        "stacked, gn": (MANY, lambda: stacked("gn")),
        "single calls, lm": (FEW, lambda: singles("lm")),
        "single calls, gn": (FEW, lambda: singles("gn")),
        "finite differences": (SLOW, lambda: [differences(item) for item in data[:SLOW]]),
    }
    taken: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(5):
        for name, (count, run) in runs.items():
            start = time.process_time()
            run()
            taken[name].append((time.process_time() - start) / count)
    medians = {name: statistics.median(times) for name, times in taken.items()}
    print(f"{'':22}{'µs each':>10}{'/ stacked lm':>14}{'/ stacked gn':>14}")
    for name, value in medians.items():
        ratios = (value / medians[f"stacked, {method}"] for method in ("lm", "gn"))
        print(f"{name:22}{1e6 * value:10.0f}" + "".join(f"{ratio:14.1f}" for ratio in ratios))
    with workers(jobs=2) as two:
        stacked("lm", two)
        shared: list[float] = []
        alone: list[float] = []
        for _ in range(5):
            for where, times in ((two, shared), (HERE, alone)):
                start = time.perf_counter()
                stacked("lm", where)
                times.append(time.perf_counter() - start)
    print(f"two processes: {statistics.median(alone) / statistics.median(shared):.2f} × one")


if __name__ == "__main__":
    main()
