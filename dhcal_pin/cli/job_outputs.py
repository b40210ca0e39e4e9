"""Contents of the output files of a calibration job.

A field of `Job` that names an output file holds its `Output`; `ROBOT_FORMATS` in `run_job` lists the files of
the robot itself. Functions import what they need when they are called, because help pages load no NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .._typing import PathLike
    from ..calibration.result import Result
    from ..report.provenance import Provenance


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Result of a job, from which its output files are made.

    Attributes:
        fit: Result of the calibration.
        source: Files, command and settings.
        robot: Path of the nominal robot.
        reports: Paths of all reports.
        meta: Facts for the certificate, `KEY=VALUE` each.
    """

    fit: Result
    source: Provenance
    robot: str
    reports: tuple[str, ...]
    meta: tuple[str, ...]

    @cached_property
    def report_contents(self) -> dict[PathLike, str | bytes]:
        """Contents of all reports, which have their figures in common."""
        from ..report.calibration_report import report_files  # lazy import: only for reports

        return report_files(self.fit, self.reports, self.source)


def map_content(done: Calibrated, path: str) -> str:
    """Make the map of uncertainty and hold-out errors."""
    from ..report import workspace_map  # lazy import: only for maps

    return workspace_map.map_content(path, done.fit, done.fit.holdout, done.fit.instruments)


def scene_content(done: Calibrated, path: str) -> str:
    """Make the 3-D scene of the nominal and the calibrated robot."""
    from ..io.robot import robot_name  # lazy import, as the following: only for scenes
    from ..visualization import scene

    return scene.scene_html(done.fit.nominal_refitted, done.fit, title=robot_name(done.robot))


def curves_content(done: Calibrated, path: str) -> str:
    """Make the table of joint corrections."""
    from ..io.tabular import csv_text  # lazy import, as the following: they load NumPy
    from ..robot.correction_table import correction_columns, joint_corrections

    return csv_text(correction_columns(joint_corrections(done.fit.chain)))


def residuals_content(done: Calibrated, path: str) -> str:
    """Make the table of all residuals."""
    from ..io.tabular import csv_text  # lazy import: loads NumPy

    return csv_text(done.fit.residuals.file_columns())


def report_content(done: Calibrated, path: str) -> str | bytes:
    """Make one of the reports."""
    return done.report_contents[path]


def certificate_content(done: Calibrated, path: str) -> str:
    """Make the certificate."""
    from ..report import certificate  # lazy import: only for certificates

    return certificate.certificate_page(done.fit, certificate.parse_meta(done.meta), done.source)
