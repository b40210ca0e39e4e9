"""Maps of the workspace as files: predicted position uncertainty beside measured errors.

A map is a CSV table with one row per cell of the workspace, or a page with two projections of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from .. import se3
from ..calibration.evaluation import position_errors
from ..calibration.presentation.workspace import RELATIVE_TEXT, WorkspaceMap, predict_workspace, workspace_map
from ..estimation.uncertainty import Predictor
from ..io.tabular import csv_text
from ..measurements.base import Measurement
from .document import Document, Section
from .figures import workspace_maps
from .html import html_page


def map_content(
    path: str, model: Predictor, data: Sequence[Measurement], known: Mapping[str, float] | None = None
) -> str:
    """Compute a map and render it as a table or a page, according to the ending of the path."""
    if path.lower().endswith(".csv"):
        return map_text(workspace_map(model, data, known))
    sentences = [
        "Standard deviation of the tool position that follows from the uncertainty of the parameters, for "
        "configurations drawn within the joint limits. Unmodelled errors come in addition."
    ]
    if not np.concatenate([model.relative.sqrt_covariance, model.relative.unbounded_directions], 1).any():
        text = "No parameter of the robot was estimated, so that no uncertainty of the tool follows."
        return _map_page(model, Section("map", "", [text]))
    if model.has_free_frames:
        sentences.append(RELATIVE_TEXT)
    q, errors = position_errors(model.chain, data, known)
    if len(errors):
        std = model.relative.predict(q).position_std
        rms = [
            f"{1e3 * np.sqrt(np.mean(part**2)):.3g} mm" for part in (errors, std) if np.isfinite(part).all()
        ]
        predicted = f" The predicted RMS error without this noise is {rms[1]}." if len(rms) > 1 else ""
        sentences.append(
            f"At the {len(errors)} measured positions the RMS error is {rms[0]}, including the noise of the "
            f"instrument.{predicted}"
        )
    points = (se3.inverse(model.chain.base) @ model.chain.poses(q))[:, :3, 3]
    draw = partial(workspace_maps, predict_workspace(model, data), points, errors)
    return _map_page(model, Section("map", "", sentences, figures=draw))


def _map_page(model: Predictor, section: Section) -> str:
    title = f"Predicted accuracy of {model.chain.model.name or 'the robot'}"
    return html_page(Document(title, [section], heading=title))


def map_text(workspace: WorkspaceMap) -> str:
    """Render a map as CSV in millimetres; columns of measurements exist only if there are any."""
    names = ("x[mm]", "y[mm]", "z[mm]")
    columns = {name: (1e3 * workspace.centre[:, i]).round(6).tolist() for i, name in enumerate(names)}
    columns |= {
        "position_std[mm]": (1e3 * workspace.std).tolist(),
        "worst[mm]": (1e3 * workspace.worst).tolist(),
        "configurations": workspace.count.tolist(),
    }
    if workspace.readings.any():
        columns["readings"] = workspace.readings.tolist()
        for name, values in (
            ("measured_rms[mm]", workspace.measured),
            ("predicted_there[mm]", workspace.expected),
        ):
            columns[name] = ["" if np.isnan(value) else value for value in (1e3 * values).tolist()]
    return csv_text(columns, ["predicted position uncertainty by cells of the workspace, measuring frame"])
