"""Measurement models: residuals and Jacobians of every supported instrument.

A measurement kind is one class in a module of this package and one entry of `KINDS`. Files, simulation,
calibration and planning take the kinds from `KINDS` alone.
"""

from .base import Measurement, Noise, Unknown
from .contact import Plane, PointDistance, Sphere, Touch
from .length import Distance, Wires
from .pose import Pose, RelativePose
from .position import Axes, Position, Targets

KINDS: dict[str, type[Measurement]] = {
    kind.kind: kind
    for kind in (
        Pose,
        Position,
        Axes,
        Targets,
        Wires,
        Distance,
        Touch,
        PointDistance,
        Plane,
        Sphere,
        RelativePose,
    )
}

__all__ = [
    "KINDS",
    "Axes",
    "Distance",
    "Measurement",
    "Noise",
    "Plane",
    "PointDistance",
    "Pose",
    "Position",
    "RelativePose",
    "Sphere",
    "Targets",
    "Touch",
    "Unknown",
    "Wires",
]
