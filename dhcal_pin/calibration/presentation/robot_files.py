"""Files of a calibrated robot: its URDF or MJCF, and the sidecar with what the calibration found."""

from __future__ import annotations

import os
from collections.abc import Sequence

from ..._typing import PathLike
from ...exceptions import InvalidArgumentError, RefusedCalibrationError
from ...io.measurement_files.fitted_rows import fitted_row_digests
from ...io.robot import urdf_files
from ...io.sidecar import NO_FINDINGS, Findings, Fitted
from ...robot.chain import Chain
from ...saving import write_files
from ..result import Result


def findings_of(fit: Result, digests: Sequence[str] = ()) -> Findings:
    """Return what a sidecar says of a calibration; `digests` are those of the measurement files."""
    fitted = Fitted(digests, fitted_row_digests(fit.data))
    return Findings(fit.transferable_instruments, fit.uncertainty, fit.measured_region, fit.rig, fitted)


def write_urdf(fit: Result | Chain, path: PathLike, force: bool = False) -> None:
    """Write a calibrated URDF and its sidecar.

    Only the origins of joints that moved change; every other byte is that of the nominal file. `urdf_files`
    says when a sidecar is written.

    Args:
        fit: Result of a calibration, or a chain alone.
        path: Path of the file to write, `.urdf`; `.xml` if the nominal robot is an MJCF.
        force: Write the robot even if the verdict on its calibration is "refused".

    Raises:
        InvalidArgumentError: The path is the nominal robot itself, or its ending is another one.
        RefusedCalibrationError: The verdict is "refused".
    """
    if not (force or isinstance(fit, Chain)) and fit.verdict.is_refused:
        reasons = " ".join(fit.verdict.reasons)
        raise RefusedCalibrationError(
            f"{os.fspath(path)}: not written, the calibration was refused: {reasons} Pass force=True to "
            "write it nevertheless."
        )
    chain = fit if isinstance(fit, Chain) else fit.chain
    nominal = chain.urdf.source
    if os.path.exists(path) and os.path.exists(nominal) and os.path.samefile(path, nominal):
        raise InvalidArgumentError(f"{os.fspath(path)}: is the nominal robot itself; write to another file")
    findings = NO_FINDINGS if isinstance(fit, Chain) else findings_of(fit)
    write_files(urdf_files(chain, path, findings))
