"""Robot kinematic calibration on Pinocchio: a robot and measurements in, the corrected URDF out.

Lengths are metres and angles radians everywhere. Joint values q are (m, n), one row a sample; poses are
(m, 4, 4); twists are [v, ω]; T_ab is the pose of frame b in frame a.

Names load on first use, so that importing the package (and `dhcal --help`) costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .calibration.cross_validation import cross_validate as cross_validate
    from .calibration.cross_validation import group_folds as group_folds
    from .calibration.cross_validation import random_folds as random_folds
    from .calibration.cross_validation import region_folds as region_folds
    from .calibration.evaluation import accuracy as accuracy
    from .calibration.model_selection import extend as extend
    from .calibration.procedure import calibrate as calibrate
    from .calibration.procedure import split as split
    from .calibration.result import Result as Result
    from .calibration.streaming import calibrate_stream as calibrate_stream
    from .compensation import Compensation as Compensation
    from .compensation import compensate as compensate
    from .diagnostics.workspace import workspace_map as workspace_map
    from .estimation.batch import Batch as Batch
    from .estimation.batch import solve as solve
    from .estimation.parameters import select as select
    from .estimation.uncertainty import Prediction as Prediction
    from .exceptions import DhcalError as DhcalError
    from .io.dh_file import read_dh as read_dh
    from .io.measurement_csv import file_parts as file_parts
    from .io.measurement_csv import read_measurements as read_measurements
    from .io.measurement_csv import read_targets as read_targets
    from .io.robot import read_robot as read_robot
    from .io.robot import write_urdf as write_urdf
    from .measurements.base import Noise as Noise
    from .measurements.contact import PointDistance as PointDistance
    from .measurements.contact import Touch as Touch
    from .measurements.pose import Pose as Pose
    from .measurements.position import Position as Position
    from .paper.error_factors import error_factors as error_factors
    from .paper.jacobian_check import crosscheck as crosscheck
    from .planning.planner import Plan as Plan
    from .planning.planner import plan as plan
    from .report.document import Provenance as Provenance
    from .report.html import write_report as write_report
    from .robot.chain import Chain as Chain
    from .robot.chain import extract as extract
    from .robot.dh import DHTable as DHTable
    from .robot.dh_urdf import dh_to_urdf as dh_to_urdf
    from .robot.sampling import Space as Space
    from .robot.transmission import Payload as Payload
    from .visualization.live import Live as Live
    from .visualization.live import serve as serve
    from .visualization.scene import scene_html as scene_html
    from .visualization.scene import show as show

_HOMES = {
    "Batch": "estimation.batch",
    "solve": "estimation.batch",
    "calibrate": "calibration.procedure",
    "split": "calibration.procedure",
    "Chain": "robot.chain",
    "crosscheck": "paper.jacobian_check",
    "PointDistance": "measurements.contact",
    "Touch": "measurements.contact",
    "cross_validate": "calibration.cross_validation",
    "group_folds": "calibration.cross_validation",
    "random_folds": "calibration.cross_validation",
    "region_folds": "calibration.cross_validation",
    "Compensation": "compensation",
    "compensate": "compensation",
    "Space": "robot.sampling",
    "DHTable": "robot.dh",
    "read_dh": "io.dh_file",
    "dh_to_urdf": "robot.dh_urdf",
    "DhcalError": "exceptions",
    "extend": "calibration.model_selection",
    "accuracy": "calibration.evaluation",
    "error_factors": "paper.error_factors",
    "Live": "visualization.live",
    "serve": "visualization.live",
    "read_measurements": "io.measurement_csv",
    "read_targets": "io.measurement_csv",
    "Noise": "measurements.base",
    "Plan": "planning.planner",
    "plan": "planning.planner",
    "Pose": "measurements.pose",
    "Position": "measurements.position",
    "Provenance": "report.document",
    "write_report": "report.html",
    "extract": "robot.chain",
    "select": "estimation.parameters",
    "Result": "calibration.result",
    "read_robot": "io.robot",
    "write_urdf": "io.robot",
    "calibrate_stream": "calibration.streaming",
    "file_parts": "io.measurement_csv",
    "Payload": "robot.transmission",
    "Prediction": "estimation.uncertainty",
    "scene_html": "visualization.scene",
    "show": "visualization.scene",
    "workspace_map": "diagnostics.workspace",
}
__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f".{_HOMES[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
