"""A whole calibration by pybotics, in the environment where it is installed.

Run by `bench_rivals.py` in a folder that holds arm.csv, fit.csv and holdout.csv; prints JSON with CPU
seconds, the RMS distance in metres on the held-out positions, and the modelled positions there. With a file
frames.csv, the initial poses (4, 4) of base and tool, both are unknown, too.
"""

import json
import time
from pathlib import Path

import numpy as np
from pybotics.kinematic_chain import MDHKinematicChain  # pyright: ignore[reportMissingImports]
from pybotics.optimization import (  # pyright: ignore[reportMissingImports]
    OptimizationHandler,
    compute_absolute_errors,
    optimize_accuracy,
)
from pybotics.robot import Robot  # pyright: ignore[reportMissingImports]
from scipy.optimize import leastsq


def main() -> None:
    """Fits fit.csv, rows of joint values and x, y, z, and judges by holdout.csv."""
    robot = Robot(MDHKinematicChain(np.loadtxt("arm.csv", delimiter=",")))
    fit, held = (np.loadtxt(name, delimiter=",") for name in ("fit.csv", "holdout.csv"))
    joints = len(robot)
    if are_frames_unknown := Path("frames.csv").exists():
        robot.world_frame, robot.tool.matrix = np.loadtxt("frames.csv", delimiter=",").reshape(2, 4, 4)
    start = time.process_time()
    handler = OptimizationHandler(
        robot, kinematic_chain_mask=True, tool_mask=are_frames_unknown, world_mask=are_frames_unknown
    )
    vector = handler.generate_optimization_vector()
    found, _ = leastsq(optimize_accuracy, vector, args=(handler, fit[:, :joints], fit[:, joints:]))
    spent = time.process_time() - start
    handler.apply_optimization_vector(found)
    errors = compute_absolute_errors(held[:, :joints], held[:, joints:], handler.robot)
    poses = [handler.robot.fk(q)[:3, 3].tolist() for q in held[:, :joints]]
    print(json.dumps({"seconds": spent, "holdout": float(np.sqrt(np.mean(errors**2))), "poses": poses}))


if __name__ == "__main__":
    main()
