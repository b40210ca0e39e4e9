"""Every kind of measurement there is; tests and `dhcal simulate` walk this list."""

from __future__ import annotations

from .base import Measurement
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
