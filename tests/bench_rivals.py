"""Other programs for calibration, from PyPI, in environments of their own.

The environments are built once, in a folder under the system's temporary one.
"""

import json
import os
import subprocess
import tempfile
import venv
from pathlib import Path

import numpy as np
import pinocchio as pin

from dhcal_pin import se3
from dhcal_pin._typing import Array
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.robot.chain import Chain
from dhcal_pin.robot.dh import DHTable

HERE = Path(__file__).resolve().parent
CACHE = Path(tempfile.gettempdir()) / "dhcal-bench"


def environment(package: str) -> Path | None:
    """Return the Python of an environment with a package from PyPI, or None if it does not install."""
    folder = CACHE / package
    python = folder / "bin" / "python"
    if not (folder / "ready").exists():
        venv.create(folder, with_pip=True, clear=True)
        if subprocess.run([python, "-m", "pip", "install", "-q", package], check=False).returncode:
            return None
        (folder / "ready").touch()
    return python


def installed_version(package: str) -> str:
    """Return the version of a package in its environment."""
    code = f"import json, importlib.metadata as m; print(json.dumps(m.version({package!r})))"
    return str(spoken([environment(package), "-c", code], HERE, PYTHONPATH=""))


def read_poses(found: dict) -> Array:
    """Return the poses (k, 4, 4) of an answer [m]; identity rotations if it has positions only."""
    columns = np.array(found["poses"])
    turned = [pin.rpy.rpyToMatrix(row) for row in columns[:, 3:]] if columns.shape[1] > 3 else np.eye(3)
    return se3.transform(turned, columns[:, :3])


def spoken(command: list, folder: Path, **environ: str) -> object:
    """Return the JSON in the last line that a command prints."""
    done = subprocess.run(
        command, cwd=folder, env=os.environ | environ, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout.strip().splitlines()[-1])


def figaroh(chain: Chain, fit: Pose, held: Pose) -> dict | None:
    """Calibrate an arm by figaroh, base and tool unknown; None if figaroh does not install.

    The keys are "seconds" of the processor, the RMS position error on held-out poses [m] as "holdout", and
    positions, roll, pitch and yaw there as "poses".
    """
    if (python := environment("figaroh")) is None:
        return None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "robot.urdf").write_bytes(chain.urdf.data)
        for file, part in (("fit.csv", fit), ("holdout.csv", held)):
            rpy = np.array([pin.rpy.matrixToRpy(pose[:3, :3]) for pose in part.poses])
            head = ",".join(["x1", "y1", "z1", "phix1", "phiy1", "phiz1", *chain.joint_names])
            rows = np.hstack([part.poses[:, :3, 3], rpy, part.q])
            np.savetxt(folder / file, rows, "%.17g", ",", header=head, comments="")
        command = [python, HERE / "bench_figaroh.py", chain.urdf.root, chain.tip, str(len(fit.q))]
        found = spoken(command, folder, PYTHONPATH="")
    assert isinstance(found, dict)
    return found


def pybotics(
    table: DHTable, fit: tuple[Array, Array], held: tuple[Array, Array], frames: tuple[Array, Array] | None
) -> dict | None:
    """Calibrate an arm by pybotics, with the keys of `figaroh`; None if pybotics does not install.

    The table has modified DH parameters of revolute joints. Joint positions (m, n) [rad] and measured
    positions (m, 3) [m] are fitted, and others judged. With frames, the initial poses of base and measured
    point, these are unknown, too.
    """
    if (python := environment("pybotics")) is None:
        return None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savetxt(
            folder / "arm.csv", np.stack([table.alpha, table.a, table.theta, table.d], 1), "%.17g", ","
        )
        for file, part in (("fit.csv", fit), ("holdout.csv", held)):
            np.savetxt(folder / file, np.hstack(part), "%.17g", ",")
        if frames is not None:
            np.savetxt(folder / "frames.csv", np.vstack(frames), "%.17g", ",")
        found = spoken([python, HERE / "bench_pybotics.py"], folder, PYTHONPATH="")
    assert isinstance(found, dict)
    return found
