"""Robot kinematic calibration on Pinocchio: a robot and measurements in, the corrected URDF out.

Lengths are metres and angles radians everywhere. Joint values q are (m, n), one row a sample; poses are
(m, 4, 4); twists are [v, ω]; T_ab is the pose of frame b in frame a.

Names load on first use, so that importing the package (and `dhcal --help`) costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .batch import Batch as Batch
    from .batch import solve as solve
    from .calibration import calibrate as calibrate
    from .calibration import split as split
    from .chain import Chain as Chain
    from .check import crosscheck as crosscheck
    from .compensation import Compensation as Compensation
    from .compensation import compensate as compensate
    from .configurations import Space as Space
    from .contacts import PointDistance as PointDistance
    from .contacts import Touch as Touch
    from .crossvalidation import cross_validate as cross_validate
    from .dh import DHTable as DHTable
    from .dh_files import read_dh as read_dh
    from .dh_urdf import dh_to_urdf as dh_to_urdf
    from .errors import DhcalError as DhcalError
    from .evaluation import accuracy as accuracy
    from .extension import extend as extend
    from .factors import error_factors as error_factors
    from .folds import group_folds as group_folds
    from .folds import random_folds as random_folds
    from .folds import region_folds as region_folds
    from .live import Live as Live
    from .live import serve as serve
    from .measurement_files import read_measurements as read_measurements
    from .measurement_files import read_targets as read_targets
    from .measurements import Noise as Noise
    from .parameters import extract as extract
    from .parameters import select as select
    from .planning import Plan as Plan
    from .planning import plan as plan
    from .poses import Pose as Pose
    from .positions import Position as Position
    from .report import Provenance as Provenance
    from .report_page import write_report as write_report
    from .result import Result as Result
    from .robot_files import read_robot as read_robot
    from .robot_files import write_urdf as write_urdf
    from .stream import calibrate_stream as calibrate_stream
    from .stream import file_parts as file_parts
    from .transmission import Payload as Payload
    from .uncertainty import Prediction as Prediction
    from .viewer import scene_html as scene_html
    from .viewer import show as show
    from .workspace import workspace_map as workspace_map

_HOMES = {
    "Batch": "batch",
    "solve": "batch",
    "calibrate": "calibration",
    "split": "calibration",
    "Chain": "chain",
    "crosscheck": "check",
    "PointDistance": "contacts",
    "Touch": "contacts",
    "cross_validate": "crossvalidation",
    "group_folds": "folds",
    "random_folds": "folds",
    "region_folds": "folds",
    "Compensation": "compensation",
    "compensate": "compensation",
    "Space": "configurations",
    "DHTable": "dh",
    "read_dh": "dh_files",
    "dh_to_urdf": "dh_urdf",
    "DhcalError": "errors",
    "extend": "extension",
    "accuracy": "evaluation",
    "error_factors": "factors",
    "Live": "live",
    "serve": "live",
    "read_measurements": "measurement_files",
    "read_targets": "measurement_files",
    "Noise": "measurements",
    "Plan": "planning",
    "plan": "planning",
    "Pose": "poses",
    "Position": "positions",
    "Provenance": "report",
    "write_report": "report_page",
    "extract": "parameters",
    "select": "parameters",
    "Result": "result",
    "read_robot": "robot_files",
    "write_urdf": "robot_files",
    "calibrate_stream": "stream",
    "file_parts": "stream",
    "Payload": "transmission",
    "Prediction": "uncertainty",
    "scene_html": "viewer",
    "show": "viewer",
    "workspace_map": "workspace",
}
__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f".{_HOMES[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
