"""Pictures in the Python API: the example of each plot method is executed, and its file is shown.

The docstring of a plot method has one example that saves its plot, such as
`fit.plot_accuracy().figure.savefig("accuracy.png")`. `fit` is the calibration of a simulated UR10, `plan` a
plan for it, and `study` a small study.
"""

from __future__ import annotations

import contextlib
import re
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from sphinx.application import Sphinx

import dhcal_pin as dh
from dhcal_pin.estimation import select_parameters
from dhcal_pin.ros_packages import resolve_robot_path
from dhcal_pin.studies import plot_study, read_study, run

_FOLDER = Path("reference/api/pictures")
_EXAMPLE = re.compile(r"`(.+\.savefig\(\"(\w+\.png)\"\))`")
_DOTS_PER_INCH = 110

_STUDY = """
title = "Position error by number of poses"
seeds = 20
[settings]
robot = "sim_6dof.dh.toml"
poses = [10, 20, 40]
noise = ["0.05mm,0.01deg", "0.2mm,0.01deg"]
"""


@cache
def _namespace(folder: Path) -> dict[str, Any]:
    """Return the names that the examples use."""
    nominal = dh.Chain.from_urdf(resolve_robot_path("example:ur10"), "tool0")
    errors = select_parameters(nominal, "minimal,harmonics")
    rng = np.random.default_rng(0)
    truth = errors.at(0.3 * errors.priors * rng.standard_normal(len(errors.parameters)))
    q = rng.uniform(-1.5, 2.2, (250, nominal.n_joints))
    data = dh.Pose.simulate(truth, q, dh.Noise(5e-5, 1e-4), rng)
    study = folder / "example.study.toml"
    study.write_text(_STUDY, encoding="utf-8")
    return {
        "fit": dh.calibrate(nominal, data.take(np.s_[:170]), holdout=data.take(np.s_[170:])),
        "plan": dh.plan(nominal, 20, noise=dh.Noise(1e-4, 1e-4), candidates=500),
        "study": read_study(study),
        "run": run,
        "plot_study": plot_study,
    }


def _add_picture(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Execute the example of a docstring and add its picture after the docstring."""
    match = _EXAMPLE.search("\n".join(lines))
    if not match:
        return
    expression, file = match.groups()
    folder = Path(app.srcdir) / _FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / file).exists():
        with contextlib.chdir(folder), matplotlib.rc_context({"savefig.dpi": _DOTS_PER_INCH}):
            eval(expression, _namespace(folder))
    lines += [
        "",
        f".. image:: /{(_FOLDER / file).as_posix()}",
        f"   :alt: Plot by {name.rpartition('.')[2]}",
        "",
    ]


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension."""
    matplotlib.use("agg")
    # The docstring is read before napoleon makes sections of it.
    app.connect("autodoc-process-docstring", _add_picture, priority=50)
    return {"parallel_read_safe": True}
