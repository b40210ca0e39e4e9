"""Programs of the benchmark `bench_public.py`, one function each.

A program gets a `Task`: the nominal robot and measurements to fit. It answers with the poses that its
calibrated robot takes at other joint positions, in the measuring frame of the fit, or with None if it cannot
read such measurements. To add a program, write its function and a row of `PROGRAMS`.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib import metadata

import bench_rivals
import numpy as np
from scipy.linalg import pinv
from scipy.optimize import approx_fprime, least_squares

from dhcal_pin import se3
from dhcal_pin._typing import Array
from dhcal_pin.calibration import calibrate
from dhcal_pin.measurements import PointContact, Pose
from dhcal_pin.robot import Chain
from dhcal_pin.robot.chain import extract_dh_table

# Method of the paper: most steps, step of differences, smallest relative singular value, and last step.
MAX_STEPS, DIFFERENCE, RANK_CUT, STEP_TOL = 30, 1e-7, 1e-7, 1e-9


@dataclass(frozen=True)
class Task:
    """What a program is given."""

    chain: Chain  # Nominal robot.
    fit: Pose | PointContact  # Measurements to fit.
    sets: str  # Parameter sets of `dhcal_pin`.
    q: Array  # Joint positions at which poses are wanted, shape (k, n) [rad].
    split: str  # Name of the split.

    def frames(self) -> Chain:
        """Return the nominal robot with base and tool fitted: the start of programs that find neither."""
        sets = "base,tool" if isinstance(self.fit, Pose) else "tool"
        return calibrate(self.chain, self.fit, sets, extend="none", loss="linear", session="off").chain


@dataclass(frozen=True)
class Answer:
    """What a program finds."""

    poses: Array  # Poses at `Task.q`, shape (k, 4, 4) [m].
    seconds: float  # Processor time of the calibration.
    has_orientation: bool = True  # Whether the orientation of the poses is identified.
    alone: Array | None = None  # Poses with the URDF alone, if these differ.
    stated: float | None = None  # Stated RMS position error [m]; by default that of the fitted poses.


def nominal(task: Task) -> Answer:
    """Fit base and tool alone."""
    start = time.process_time()
    chain = task.frames()
    return Answer(chain.poses(task.q), time.process_time() - start)


def by_dhcal(task: Task, extend: str = "auto") -> Answer:
    """Calibrate; the stated error is the cross-validated one, or that of left-out regions of joint space."""
    start = time.process_time()
    fit = calibrate(task.chain, task.fit, task.sets, extend=extend)
    seconds = time.process_time() - start
    if task.split == "regions":
        stated = fit.generalization.region_holdout
    else:
        stated = fit.random_folds.comparison if fit.random_folds else None
    return Answer(
        fit.chain.poses(task.q),
        seconds,
        alone=fit.urdf_alone.poses(task.q) if fit.bare else None,
        # Where it states nothing, nothing is compared.
        stated=stated.after.groups["position"].rms if stated else np.nan,
    )


def by_scipy(task: Task) -> Answer | None:
    """Calibrate by the method of Cho, Ha, Lee and Park, Gauss-Newton with the pseudo-inverse, from scipy.

    Unknown are all DH parameters, base and tool; the rows are the position [m] and the rotation vector [rad]
    of each pose, weighted equally. Base and tool start where they fit the nominal robot.
    """
    if not isinstance(task.fit, Pose):
        return None
    started = task.frames()
    start = time.process_time()
    table = extract_dh_table(task.chain).table
    nominal = np.array([table.theta, table.d, table.a, table.alpha])
    base, tool = started.base @ table.base, table.tool @ started.tool
    seen = task.fit.poses

    def poses(x: Array, q: Array) -> Array:
        theta, d, a, alpha = nominal + x[: nominal.size].reshape(4, -1)
        changed = replace(table, theta=theta, d=d, a=a, alpha=alpha, base=np.eye(4), tool=np.eye(4))
        first, last = x[nominal.size :].reshape(2, 6)
        return base @ se3.exp6(first) @ changed.poses(q) @ tool @ se3.exp6(last)

    def rows(x: Array) -> Array:
        found = poses(x, task.fit.q)
        turned = se3.log3(np.swapaxes(found[:, :3, :3], 1, 2) @ seen[:, :3, :3])
        return np.concatenate([(seen[:, :3, 3] - found[:, :3, 3]).ravel(), turned.ravel()])

    # The parameters are redundant; of all steps that fit equally well, the pseudo-inverse gives the shortest.
    x = np.zeros(nominal.size + 12)
    for _ in range(MAX_STEPS):
        inverse: Array = np.asarray(pinv(approx_fprime(x, rows, DIFFERENCE), rtol=RANK_CUT))
        step = -inverse @ rows(x)
        x = x + step
        if np.linalg.norm(step) < STEP_TOL:
            break
    return Answer(poses(x, task.q), time.process_time() - start)


def frames_between(inner: Array, outer: Array) -> tuple[Array, Array]:
    """Return B and T that bring B·inner·T closest to outer, both (m, 4, 4); 1 mrad counts as 1 mm."""
    # Positions give B to start with, for a tool that is nearly the same; orientations then give T.
    a, b = (poses[:, :3, 3] - poses[:, :3, 3].mean(0) for poses in (inner, outer))
    u, _, vt = np.linalg.svd(b.T @ a)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    base = se3.transform(rotation, outer[:, :3, 3].mean(0) - rotation @ inner[:, :3, 3].mean(0))
    u, _, vt = np.linalg.svd((se3.inverse(base @ inner) @ outer)[:, :3, :3].mean(0))
    tool = se3.transform(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, np.zeros(3))

    def rows(x: Array) -> Array:
        found = base @ se3.exp6(x[:6]) @ inner @ tool @ se3.exp6(x[6:])
        return se3.log6(se3.inverse(found) @ outer).ravel()

    x = least_squares(rows, np.zeros(12), method="lm").x
    return base @ se3.exp6(x[:6]), tool @ se3.exp6(x[6:])


def by_figaroh(task: Task) -> Answer | None:
    """Calibrate all geometric parameters by figaroh; it needs a URDF and poses."""
    if not isinstance(task.fit, Pose) or task.chain.urdf.source.endswith(".toml"):
        return None
    found = bench_rivals.figaroh(task.chain, task.fit, Pose(task.q, np.tile(np.eye(4), (len(task.q), 1, 1))))
    return Answer(bench_rivals.read_poses(found), found["seconds"]) if found else None


def by_pybotics(task: Task) -> Answer | None:
    """Calibrate all modified DH parameters, base and tool by pybotics, which fits positions.

    Its loop over the poses is slow, so that it gets 100 of them at most, evenly taken. It fits one distance
    per pose and needs as many poses as unknowns: four per joint, six of the base and six of the tool.
    """
    if not isinstance(task.fit, Pose) or len(task.fit.q) < 4 * task.chain.n_joints + 12:
        return None
    rows = np.unique(np.linspace(0, len(task.fit.q) - 1, 100).astype(int))
    fit = task.fit.take(rows)
    started = task.frames()
    table = extract_dh_table(task.chain, "modified").table
    frames = (started.base @ table.base, table.tool @ started.tool)
    found = bench_rivals.pybotics(
        table,
        (fit.q, fit.poses[:, :3, 3]),
        (task.q, np.zeros((len(task.q), 3))),
        frames,
    )
    return Answer(bench_rivals.read_poses(found), found["seconds"], has_orientation=False) if found else None


@dataclass(frozen=True)
class Program:
    """One row of the leaderboard."""

    title: str
    package: str  # Package whose version is stated.
    calibrate: Callable[[Task], Answer | None]
    has_environment: bool = False  # Whether it has an environment of its own.

    def version(self) -> str:
        """Return the version of the package."""
        if self.has_environment:
            return bench_rivals.installed_version(self.package)
        return metadata.version(self.package)


PROGRAMS = {
    "nominal": Program("nominal robot, base and tool fitted", "dhcal-pin", nominal),
    "scipy": Program("scipy, method of the paper", "scipy", by_scipy),
    "pybotics": Program("pybotics, 100 poses at most", "pybotics", by_pybotics, True),
    "figaroh": Program("figaroh", "figaroh", by_figaroh, True),
    "dhcal_none": Program("dhcal_pin, `--extend none`", "dhcal-pin", partial(by_dhcal, extend="none")),
    "dhcal": Program("dhcal_pin, defaults", "dhcal-pin", by_dhcal),
}
