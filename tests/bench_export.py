"""Time per call of the models that `dhcal export` writes, in C and in Python.

    python tests/bench_export.py [COMPILER ...]          default: gcc, and clang where it is installed

A UR10 with a payload: without joint errors, with harmonics to order 11 of each joint (66 in all), to order
64 of each joint (384 in all), and with all families. Inverse kinematics starts 0.05 rad beside the solution.
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path
from types import ModuleType

os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

import numpy as np
from bench_common import clocked
from exported_models import CModel, python_model, with_joint_errors, with_payload_and_frames
from robots import nominal_arm

from dhcal_pin.robot import FAMILIES, Chain
from dhcal_pin.robot.transmission import Transmission, split_coefficients

SAMPLES, REPEATS = 1000, 15


def robots() -> dict[str, Chain]:
    """Return the arm without joint errors, with few and many harmonics, and with all families."""
    rng = np.random.default_rng(0)
    bare = nominal_arm("ur10")
    bare = with_payload_and_frames(bare, rng)
    waves = with_joint_errors(bare, rng, ["harmonics", "curves", "fine-curves"])
    assert waves.transmission is not None
    few = waves.transmission.coefficients.copy()
    split_coefficients(few, 6).harmonics[11:] = 0.0
    return {
        "no joint errors": bare,
        "harmonics to order 11 of each joint (66)": bare.with_transmission(Transmission(few, bare.loads)),
        "harmonics to order 64 of each joint (384)": waves,
        f"all {len(FAMILIES)} families, 384 harmonics": with_joint_errors(bare, rng),
    }


def print_row(what: str, times: list[float], samples: int, text: str) -> None:
    """Print times [s] per sample."""
    row = "".join(f"{1e6 * time / samples:10.3g} " for time in times)
    print(f"{what:44}{row:33}  {text}")


def time_compiled(what: str, model: CModel, q: np.ndarray, start: np.ndarray, targets: np.ndarray) -> str:
    """Print the times of a model in C, and return the share of targets that it reaches."""
    ways = [
        lambda: model.forward_kinematics_of_all(q),
        lambda: model.pose_and_jacobian_of_all(q),
        lambda: model.inverse_kinematics_of_all(targets, start),
    ]
    print_row(what, clocked(ways, REPEATS), SAMPLES, f"{model.compiler} -O2")
    return f"{100 * model.inverse_kinematics_of_all(targets, start) / SAMPLES:.1f} %"


def time_python(what: str, model: ModuleType, q: np.ndarray, start: np.ndarray, targets: np.ndarray) -> None:
    """Print the times of a model in Python."""
    ways = [
        lambda: model.forward_kinematics(q[0]),
        lambda: model.pose_and_jacobian(q[0]),
        lambda: model.inverse_kinematics(targets[0], start[0]),
    ]
    print_row(what, clocked(ways, REPEATS), 1, "NumPy, one sample")
    ways = [lambda: model.forward_kinematics(q), lambda: model.pose_and_jacobian(q)]
    print_row(what, clocked(ways, REPEATS), SAMPLES, f"NumPy, {SAMPLES} samples together")


def main() -> int:
    """Measure and print the times."""
    rng = np.random.default_rng(1)
    compilers = sys.argv[1:] or [name for name in ("gcc", "clang") if shutil.which(name)]
    print(f"{'time per call [us]':44}{'pose':>10} {'Jacobian':>10} {'inverse':>10}")
    for what, chain in robots().items():
        q = rng.uniform(-2.5, 2.5, (SAMPLES, chain.n_joints))
        start = q + rng.uniform(-0.05, 0.05, q.shape)
        reached = "-"
        with tempfile.TemporaryDirectory() as folder:
            in_python = python_model(chain, Path(folder))
            targets = in_python.forward_kinematics(q)
            for compiler in compilers:
                model = CModel(chain, Path(folder), compiler, "-O2")
                reached = time_compiled(what, model, q, start, targets)
        time_python(what, in_python, q, start, targets)
        print(f"{what:44}targets reached: {reached}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
