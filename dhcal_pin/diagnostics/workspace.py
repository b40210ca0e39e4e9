"""Predicted accuracy as public names of this package; see `calibration.presentation.workspace`."""

from ..calibration.presentation.workspace import WorkspaceMap as WorkspaceMap
from ..calibration.presentation.workspace import WorkspacePrediction as WorkspacePrediction
from ..calibration.presentation.workspace import predict_workspace as predict_workspace
from ..calibration.presentation.workspace import workspace_map as workspace_map
