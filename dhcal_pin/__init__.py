"""Robot kinematic calibration on Pinocchio: a robot and measurements in, the corrected URDF out.

Lengths are metres and angles radians everywhere. Joint positions q have shape (m, n), one row per sample;
poses have shape (m, 4, 4); twists are [v, ω]; T_ab is the pose of frame b in frame a.

The public names are listed in `__init__.pyi`. Each is loaded on first use, so that `import dhcal_pin` and
`dhcal --help` are fast.
"""

from typing import Any

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("dhcal-pin")
    return _load(name)
