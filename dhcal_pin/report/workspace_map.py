"""Workspace maps as files: predicted position uncertainty beside measured errors.

A map is written as CSV, one row per cell of the workspace, or as an HTML page with drawings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..calibration.evaluation import position_errors
from ..diagnostics.workspace import WorkspaceMap, predict_workspace, workspace_map
from ..estimation.uncertainty import Predictor
from ..exceptions import DhcalError
from ..io.tabular import csv_text
from ..measurements.base import Measurement
from .html import map_page


def check_map_ending(path: str) -> None:
    """Raise DhcalError if a path ends neither in .csv nor in .html."""
    if not path.lower().endswith((".csv", ".html")):
        raise DhcalError(f"{path}: unknown ending; expected .csv or .html")


def map_content(
    path: str, model: Predictor, data: Sequence[Measurement], known: Mapping[str, float] | None = None
) -> str:
    """Compute a workspace map as CSV or HTML.

    Args:
        path: Path of the file; its ending selects the format.
        model: Calibrated robot with its uncertainty.
        data: Measurements to compare with.
        known: Known instrument parameters by name [m or rad]; the others are fitted to the data.

    Returns:
        Text of the file.
    """
    if path.lower().endswith(".csv"):
        return map_text(workspace_map(model, data, known))
    sentences = [
        "Predicted standard deviation of the tool position for random configurations within the joint limits. "
        "It follows from the uncertainty of the parameters. Unmodelled errors are not included."
    ]
    q, errors = position_errors(model.chain, data, known)
    if len(errors):
        std = model.predict(q).position_std
        rms = [
            f"{1e3 * np.sqrt(np.mean(part**2)):.3g} mm" for part in (errors, std) if np.isfinite(part).all()
        ]
        sentences.append(
            f"At the {len(errors)} measured positions the RMS error is {rms[0]} including the noise of the "
            + (f"instrument; the prediction without it is {rms[1]}." if len(rms) > 1 else "instrument.")
        )
    title = f"Predicted accuracy of {model.chain.model.name or 'the robot'} over the workspace"
    return map_page(title, predict_workspace(model, data), sentences)


def map_text(found: WorkspaceMap) -> str:
    """Return the CSV text of a map: one row per cell, in millimetres."""
    names = ("x[mm]", "y[mm]", "z[mm]")
    columns = {name: (1e3 * found.centre[:, i]).round(6).tolist() for i, name in enumerate(names)}
    columns |= {"position_std[mm]": (1e3 * found.std).tolist(), "worst[mm]": (1e3 * found.worst).tolist()}
    columns["configurations"] = found.count.tolist()
    if found.readings.any():
        columns["readings"] = found.readings.tolist()
        for name, part in (("measured_rms[mm]", found.measured), ("predicted_there[mm]", found.expected)):
            columns[name] = ["" if np.isnan(value) else value for value in (1e3 * part).tolist()]
    return csv_text(columns, ["predicted position uncertainty by cell of the workspace, measuring frame"])
