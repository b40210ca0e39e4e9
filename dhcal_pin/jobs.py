"""One robot to calibrate: what `dhcal calibrate` is told, so that any process can do it."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass, fields
from typing import Any

from .calibration import Method


@dataclass(frozen=True)
class Job:
    """The options of `dhcal calibrate`, under the names that they have on the command line.

    Attributes:
        robot: path of a URDF or a DH file.
        data: paths of measurement files.
        output: path of the corrected URDF.
        tip, columns, parameters, extend, fix, free, holdout, method, loss, priors, instrument,
            max_iterations, seed, in_place, world_joint, tool_frame, json, map: as in
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
    loss: str = "linear"
    priors: str | None = None
    instrument: str | None = None
    max_iterations: int = 100
    seed: int = 0
    in_place: bool = False
    world_joint: bool = False
    tool_frame: str | None = None
    json: str | None = None
    map: str | None = None

    @classmethod
    def of(cls, args: Namespace) -> Job:
        """The job that a command line asks for."""
        values: dict[str, Any] = {}
        for option in fields(cls):
            value = getattr(args, option.name)
            values[option.name] = tuple(value) if isinstance(value, list) else value
        return cls(**values)
