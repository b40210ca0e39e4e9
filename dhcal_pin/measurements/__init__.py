"""Measurement models: residuals and Jacobians of all supported instruments and contacts.

A measurement kind is one class in a module of this package and one entry of `KINDS`. Files, simulation,
calibration and planning take the kinds from `KINDS`. Units, files and robots are the concern of other
packages; here lengths are metres, angles radians, and a robot is a `Chain`. `measured_region` describes which
part of the joint space measurements cover.
"""

from .base import InstrumentParameter, Measurement, Noise
from .camera import CameraCorners
from .contact import PlaneContact, PointContact, PointDistance, SphereContact
from .images import ViewLimits, is_board_in_view, project_board
from .inclination import Inclination
from .length import Distance, Wires
from .measured_region import MeasuredRegion
from .mounting import MountedRig, mount_rig
from .pose import Pose, RelativePose
from .position import MultiTargetPosition, Position, PositionComponents

# Measurement kinds by name.
KINDS: dict[str, type[Measurement]] = {
    kind.kind: kind
    for kind in (
        Pose,
        Position,
        PositionComponents,
        MultiTargetPosition,
        Wires,
        Distance,
        PointContact,
        PointDistance,
        PlaneContact,
        SphereContact,
        RelativePose,
        CameraCorners,
        Inclination,
    )
}

__all__ = [
    "KINDS",
    "CameraCorners",
    "Distance",
    "Inclination",
    "InstrumentParameter",
    "MeasuredRegion",
    "Measurement",
    "MountedRig",
    "MultiTargetPosition",
    "Noise",
    "PlaneContact",
    "PointContact",
    "PointDistance",
    "Pose",
    "Position",
    "PositionComponents",
    "RelativePose",
    "SphereContact",
    "ViewLimits",
    "Wires",
    "is_board_in_view",
    "mount_rig",
    "project_board",
]
