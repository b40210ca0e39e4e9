"""Robot kinematic calibration on Pinocchio: a robot and measurements in, the corrected URDF out.

Lengths are metres and angles radians everywhere. Joint positions q have shape (m, n), one row per sample;
poses have shape (m, 4, 4); twists are [v, ω]; T_ab is the pose of frame b in frame a.

The public names of a package are listed in its `__init__.pyi`. Each name is loaded on first use, so that
`import dhcal_pin` and `dhcal --help` are fast.
"""

from functools import cache
from typing import Any


@cache
def _public() -> tuple[Any, Any, list[str]]:
    """Return the module functions __getattr__ and __dir__, and __all__, as the stub file declares them."""
    import lazy_loader

    return lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("dhcal-pin")
    load, _, names = _public()
    return names if name == "__all__" else load(name)


def __dir__() -> list[str]:
    return _public()[1]()
