"""Maps of the workspace as files: predicted position uncertainty beside measured errors."""

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
    """Complains about a map's path that is neither a table nor a page."""
    if not path.lower().endswith((".csv", ".html")):
        raise DhcalError(f"{path}: unknown ending; write a map as .csv or .html")


def map_content(
    path: str, model: Predictor, data: Sequence[Measurement], known: Mapping[str, float] | None = None
) -> str:
    """The text of a map, a table or a page as its path ends.

    Args:
        path: where it will be written.
        model: a calibration, or what a file has kept of it.
        data: measurements to judge it by.
        known: values of their instruments' unknowns; others are fitted to the data.
    """
    if path.lower().endswith(".csv"):
        return map_text(workspace_map(model, data, known))
    sentences = [
        "The predicted standard deviation of the tool's position, for configurations drawn over the joints' "
        "limits: what follows from the parameters' own uncertainty. What the model lacks comes on top of it."
    ]
    q, errors = position_errors(model.chain, data, known)
    if len(errors):
        std = model.predict(q).position_std
        rms = [
            f"{1e3 * np.sqrt(np.mean(part**2)):.3g} mm" for part in (errors, std) if np.isfinite(part).all()
        ]
        sentences.append(
            f"At the {len(errors)} measured positions the RMS error is {rms[0]}, the instrument's noise "
            + (f"included; {rms[1]} are predicted without it." if len(rms) > 1 else "included.")
        )
    title = f"Where {model.chain.model.name or 'the robot'} can be trusted"
    return map_page(title, predict_workspace(model, data), sentences)


def map_text(found: WorkspaceMap) -> str:
    """The CSV text of a map: a row a cell, millimetres; columns of readings only where there are any."""
    names = ("x[mm]", "y[mm]", "z[mm]")
    columns = {name: (1e3 * found.centre[:, i]).round(6).tolist() for i, name in enumerate(names)}
    columns |= {"position_std[mm]": (1e3 * found.std).tolist(), "worst[mm]": (1e3 * found.worst).tolist()}
    columns["configurations"] = found.count.tolist()
    if found.readings.any():
        columns["readings"] = found.readings.tolist()
        for name, part in (("measured_rms[mm]", found.measured), ("predicted_there[mm]", found.expected)):
            columns[name] = ["" if np.isnan(value) else value for value in (1e3 * part).tolist()]
    return csv_text(columns, ["predicted position uncertainty by cells of the workspace, measuring frame"])
