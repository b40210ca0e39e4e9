"""One robot to calibrate: what `dhcal calibrate` is told, so that any process can do it."""

from __future__ import annotations

import shlex
from argparse import Namespace
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from ..calibration.procedure import Method

# A manifest of many jobs.
MANIFEST = ".fleet.toml"


# Where a job writes, which changes nothing about what it finds.
_OUTPUTS = ("output", "in_place", "report", "json", "map")


@dataclass(frozen=True)
class Job:
    """The options of `dhcal calibrate`, under the names that they have on the command line.

    Attributes:
        robot: path of a URDF or a DH file.
        data: paths of measurement files.
        output: path of the corrected URDF.
        tip, columns, parameters, extend, fix, free, holdout, method, loss, priors, bounds, instrument,
            payload, max_iterations, seed, in_place, world_joint, tool_frame, report, json, map: as in
            `dhcal calibrate --help`.
    """

    robot: str
    data: tuple[str, ...]
    output: str
    tip: str | None = None
    columns: str | None = None
    parameters: str | None = None
    extend: str = "none"
    fix: str = ""
    free: str = ""
    holdout: str | None = None
    method: Method = "lm"
    loss: str = "auto"
    priors: str | None = None
    bounds: str | None = None
    instrument: str | None = None
    payload: str | None = None
    max_iterations: int = 100
    seed: int = 0
    in_place: bool = False
    world_joint: bool = False
    tool_frame: str | None = None
    report: tuple[str, ...] = ()
    json: str | None = None
    map: str | None = None

    @classmethod
    def from_args(cls, args: Namespace) -> Job:
        """The job that a command line asks for."""
        values: dict[str, Any] = {}
        for option in fields(cls):
            value = getattr(args, option.name)
            values[option.name] = tuple(value) if isinstance(value, list) else value
        return cls(**values)

    def command(self, names: Mapping[str, str]) -> str:
        """The command line of this job, without where it writes, and files under other names.

        >>> Job("in/arm.urdf", ("in/a.csv",), "out.urdf", seed=3).command({"in/arm.urdf": "arm.urdf"})
        'dhcal calibrate arm.urdf in/a.csv --seed 3'
        """
        words = ["dhcal", "calibrate", *(names.get(path, path) for path in (self.robot, *self.data))]
        for option in fields(self):
            value = getattr(self, option.name)
            if option.name not in (*_OUTPUTS, "robot", "data") and value != option.default:
                flag = f"--{option.name.replace('_', '-')}"
                words += [flag] if value is True else [flag, names.get(str(value), str(value))]
        return shlex.join(words)


def is_manifest(path: str) -> bool:
    """Whether a path names a manifest of many robots in a robot's place."""
    return path.lower().endswith(MANIFEST)
