"""Time per call of the models that `dhcal export` writes, in C and in Python.

    python tests/bench_export.py [COMPILER ...]          default: gcc, and clang where it is installed

A UR10 with a payload and all joint errors: harmonics of the orders 1 to 10 (about 64 in all six joints, as sine
or cosine counts), and of the orders 1 to 64 of each joint. Inverse kinematics starts 0.05 rad beside the solution.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path

os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

import numpy as np
from bench_common import clocked
from exported_models import CModel, python_model, with_joint_errors, with_payload_and_frames
from robots import robot_file

from dhcal_pin.robot import FAMILIES, Chain
from dhcal_pin.robot.transmission import Transmission, split_coefficients

SAMPLES, REPEATS = 1000, 15


def robots() -> dict[str, Chain]:
    """Return the arm without joint errors, with few and with many harmonics, and with them and the other families."""
    rng = np.random.default_rng(0)
    bare = Chain.from_urdf(robot_file("ur_description/urdf/ur10_robot.urdf"), "tool0")
    bare = with_payload_and_frames(bare, rng)
    waves = with_joint_errors(bare, rng, ["harmonics", "curves", "fine-curves"])
    few = waves.transmission.coefficients.copy()
    split_coefficients(few, 6).harmonics[11:] = 0.0
    return {
        "no joint errors": bare,
        "harmonics to order 11 of each joint (66)": bare.with_transmission(Transmission(few, bare.loads)),
        "harmonics to order 64 of each joint (384)": waves,
        f"all {len(FAMILIES)} families, 384 harmonics": with_joint_errors(bare, rng),
    }


def main() -> int:
    """Measure and print the times.

    Returns:
        Exit status: 0.
    """
    rng = np.random.default_rng(1)
    compilers = sys.argv[1:] or [name for name in ("gcc", "clang") if shutil.which(name)]
    print(f"{'time per call [us]':44} {'pose':>10} {'Jacobian':>10} {'inverse':>10}")
    for what, chain in robots().items():
        q = rng.uniform(-2.5, 2.5, (SAMPLES, chain.n_joints))
        start = q + rng.uniform(-0.05, 0.05, q.shape)
        with tempfile.TemporaryDirectory() as folder:
            module = python_model(chain, Path(folder))
            targets = module.forward_kinematics(q)
            models = {}
            for compiler in compilers:
                (Path(folder) / compiler).mkdir()
                models[compiler] = CModel(chain, Path(folder) / compiler, compiler, "-O2")
        for compiler, model in models.items():
            times = clocked(
                [
                    lambda model=model: model.forward_kinematics_of_all(q),
                    lambda model=model: model.pose_and_jacobian_of_all(q),
                    lambda model=model: model.inverse_kinematics_of_all(targets, start),
                ],
                REPEATS,
            )
            reached = model.inverse_kinematics_of_all(targets, start)
            row = " ".join(f"{1e6 * time / SAMPLES:10.2f}" for time in times)
            print(f"{what:44} {row}   {compiler} -O2, {100 * reached / SAMPLES:.1f} % reached")
        times = clocked(
            [
                lambda: module.forward_kinematics(q[0]),
                lambda: module.pose_and_jacobian(q[0]),
                lambda: module.inverse_kinematics(targets[0], start[0]),
                lambda: module.forward_kinematics(q),
                lambda: module.pose_and_jacobian(q),
            ],
            REPEATS,
        )
        print(f"{what:44} {' '.join(f'{1e6 * time:10.0f}' for time in times[:3])}   NumPy, one sample")
        row = " ".join(f"{1e6 * time / SAMPLES:10.2f}" for time in times[3:])
        print(f"{what:44} {row} {'':10}   NumPy, {SAMPLES} samples together")
    return 0


if __name__ == "__main__":
    sys.exit(main())
