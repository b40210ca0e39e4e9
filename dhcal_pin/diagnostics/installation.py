"""Checks of an installation: versions, compiled kernels, BLAS, browser, example robots, extras, a self-test.

The self-test calibrates the paper's robot from simulated poses without noise, writes the URDF and reads it
back. The tool of the written robot must then be where that of the true robot is.
"""

from __future__ import annotations

import os
import platform
import re
import tempfile
import time
import webbrowser
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Literal

import numpy as np

from .. import _kernels
from .._frozen import frozen
from ..calibration.procedure import calibrate
from ..io import read_dh, read_robot, shipped_file, write_urdf
from ..measurements import Noise, Pose
from ..robot import Chain
from ..ros_packages import example_robots

Status = Literal["ok", "note", "failed"]

# Distribution of this package, and its extras that serve only its development.
_DISTRIBUTION, _DEVELOPMENT = "dhcal-pin", ("dev", "docs")
_PACKAGES = (_DISTRIBUTION, "pin", "numpy", "scipy", "meshcat", "matplotlib")
_EXTRA = re.compile(r"""([\w.-]+).*;\s*extra\s*==\s*['"](\w+)['"]""")
# Largest distance between the tools of the calibrated and of the true robot in the self-test [m].
MAX_SELF_TEST_ERROR = 1e-7
# Number of poses of the self-test.
_N_POSES = 40


@frozen
class InstallationCheck:
    """Result of one check."""

    name: str  #: What was checked.
    #: "ok"; "note" if something optional is missing or slow; "failed" if the installation is broken.
    status: Status
    text: str  #: What was found, and what to do about it.


def check_installation() -> Iterator[InstallationCheck]:
    """Check the installation, the quick checks first."""
    yield _check_versions()
    yield _check_kernels()
    yield _check_blas()
    yield _check_browser()
    yield _check_example_robots()
    yield from _check_extras()
    yield check_calibration()


def _check_versions() -> InstallationCheck:
    versions = [f"{name} {metadata.version(name)}" for name in _PACKAGES]
    python = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    return InstallationCheck("versions", "ok", ", ".join([python, *versions]))


def _check_kernels() -> InstallationCheck:
    if _kernels.r_factor.__module__.endswith("native"):
        return InstallationCheck("kernels", "ok", "compiled")
    text = "NumPy: fits take about four times as long; install a C compiler, then install dhcal-pin again"
    return InstallationCheck("kernels", "note", text)


def _check_blas() -> InstallationCheck:
    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    threads = os.environ.get("OMP_NUM_THREADS", "1")
    text = f"{blas['name']} {blas['version']}, {os.cpu_count()} processors"
    if threads == "1":
        return InstallationCheck("BLAS", "ok", f"{text}, one thread")
    text = f"{text}, OMP_NUM_THREADS={threads}"
    return InstallationCheck("BLAS", "note", f"{text}; one thread is fastest: OMP_NUM_THREADS=1")


def _check_browser() -> InstallationCheck:
    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        text = "none found; open the pages of --html and --report on another computer"
        return InstallationCheck("browser", "note", text)
    return InstallationCheck("browser", "ok", getattr(browser, "name", "") or "default browser of the system")


def _check_example_robots() -> InstallationCheck:
    robots = example_robots()
    if robots:
        return InstallationCheck("example robots", "ok", f"{len(robots)}, such as example:ur10")
    return InstallationCheck("example robots", "note", "none; pip install example-robot-data")


def _check_extras() -> Iterator[InstallationCheck]:
    """Check the packages of the optional extras."""
    for requirement in metadata.requires(_DISTRIBUTION) or []:
        match = _EXTRA.match(requirement)
        if match is None or match[2] in _DEVELOPMENT:
            continue
        package, extra = match.groups()
        try:
            check = InstallationCheck(f"extra {extra}", "ok", f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            text = f"{package} is not installed; pip install {package}"
            check = InstallationCheck(f"extra {extra}", "note", text)
        yield check


def check_calibration() -> InstallationCheck:
    """Calibrate a small robot from simulated poses, write it, and compare it with the true one."""
    start = time.perf_counter()
    try:
        error = _calibration_error()
    except Exception as failure:  # whatever a broken installation raises
        return InstallationCheck("self-test", "failed", f"{type(failure).__name__}: {failure}")
    seconds = time.perf_counter() - start
    text = f"calibrated robot within {error:.1e} m of the true one, {seconds:.1f} s"
    if error <= MAX_SELF_TEST_ERROR:
        return InstallationCheck("self-test", "ok", text)
    return InstallationCheck("self-test", "failed", f"{text}; expected at most {MAX_SELF_TEST_ERROR:g} m")


def _calibration_error() -> float:
    """Return the largest distance of the tools of the written robot and of the true one [m]."""
    nominal, actual = (
        Chain.from_dh(read_dh(shipped_file(f"{name}.dh.toml"))) for name in ("sim_6dof", "sim_6dof_actual")
    )
    rng = np.random.default_rng(0)
    q, test = (rng.uniform(-np.pi, np.pi, (_N_POSES, nominal.n_joints)) for _ in range(2))
    fit = calibrate(nominal, Pose.simulate(actual, q, Noise(), rng), "dh", priors="none")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "calibrated.urdf"
        write_urdf(fit, path)
        written = read_robot(path)
    return float(np.abs(written.poses(test)[:, :3, 3] - actual.poses(test)[:, :3, 3]).max())
