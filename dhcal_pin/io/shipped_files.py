"""Files that ship with the package: the paper's robots and data, a free flange, and example studies.

They are in the folder `urdf` of the source tree, which is installed as the package `dhcal_pin.data`.
"""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from ..exceptions import UnknownNameError
from ..ros_packages import resolve_robot_path

if TYPE_CHECKING:
    from .._typing import PathLike  # loads NumPy, which the parser of the command line does not need


def _folders() -> tuple[Path, Path]:
    """Return the folder in the installed package and the one in the source tree."""
    package = Path(str(resources.files("dhcal_pin")))
    return package / "data", package.parent / "urdf"


def shipped_file(name: str) -> Path:
    """Find a file that ships with the package."""
    for folder in _folders():
        if os.path.isfile(folder / name):
            return folder / name
    raise UnknownNameError(f"{name}: no such file, and none that ships with dhcal-pin; check its name")


def resolve_robot_file(path: PathLike) -> str:
    """Return the path of a robot file, also for `example:NAME` and for a robot that ships."""
    found = resolve_robot_path(path)
    if os.path.dirname(found) or os.path.exists(found):
        return found
    shipped = (os.fspath(folder / found) for folder in _folders() if os.path.isfile(folder / found))
    return next(shipped, found)


def shipped_names(ending: str) -> list[str]:
    """List the files of one type that ship with the package."""
    paths = (path for folder in _folders() for path in folder.glob(f"*{ending}"))
    return sorted({path.name.removesuffix(ending) for path in paths})
