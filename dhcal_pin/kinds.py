"""Every kind of measurement there is; tests and `dhcal simulate` walk this list."""

from __future__ import annotations

from .contacts import Plane, PointDistance, Sphere, Touch
from .lengths import Distance, Wires
from .measurements import Measurement
from .poses import Pose
from .positions import Axes, Position, Targets
from .relative import RelativePose

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
