"""Output files of a calibration job: their endings and the functions that make their contents.

A field of `Job` that names an output file holds an `Output`; `ROBOT_FORMATS` in `run_job` lists those
of the robot itself. Functions import what they need when they are called, because help pages load no NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from ..exceptions import InvalidArgumentError

if TYPE_CHECKING:
    from .._typing import PathLike
    from ..calibration.result import Result
    from ..report.document import Provenance


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
        from ..report.html import report_files  # lazy import: only for reports

        return report_files(self.fit, self.reports, self.source)


@dataclass(frozen=True)
class Output:
    """Output file of a job.

    Attributes:
        content: Function that makes the content for a path; None for the JSON document, which is made last.
        noun: What the file is, in the message on an unknown ending.
        endings: Endings of its name; any if there are none.
        other_endings: Endings that are accepted, too.
        is_written_if_refused: Whether the file is written for a refused calibration, too.
    """

    content: Callable[[Calibrated, str], str | bytes] | None
    noun: str = ""
    endings: tuple[str, ...] = ()
    other_endings: tuple[str, ...] = ()
    is_written_if_refused: bool = False

    def require_ending(self, path: str) -> None:
        """Require one of the endings of this output."""
        if self.endings and not path.lower().endswith((*self.endings, *self.other_endings)):
            endings = " or ".join(self.endings)
            raise InvalidArgumentError(f"{path}: unknown ending; write {self.noun} as {endings}")


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
