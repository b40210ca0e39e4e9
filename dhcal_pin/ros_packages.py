"""ROS packages of robot descriptions: the robots of example-robot-data, and the folders of meshes.

A mesh in a URDF is named by its package, such as `package://ur_description/meshes/base.stl`. Pinocchio
replaces `package://` by each folder in turn until the file exists. The folders are, in this order:

1. the folders that the user names (`--package-dir`, `Urdf.package_dirs`), each followed by its parent, so
   that the folder of a package serves as well as the folder that contains the package;
2. the folders above the URDF;
3. the share folder of example-robot-data, if it is installed;
4. the folders in the environment variables ROS_PACKAGE_PATH and AMENT_PREFIX_PATH, which Pinocchio appends.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from .exceptions import InvalidArgumentError, UnknownNameError

if TYPE_CHECKING:
    from ._typing import PathLike  # loads NumPy, which the parser of the command line does not need

# Beginning of the names of robots of example-robot-data.
EXAMPLE_PREFIX = "example:"
# Distribution that holds these robots, and its share folder in the installation.
_DISTRIBUTION, _SHARE = "example-robot-data", "cmeel.prefix/share"
# Largest mesh [byte]. The largest one of example-robot-data has 27 MiB.
MAX_MESH_BYTES = 32 << 20
# End of the file names of arms, which is not part of their names: ur10_robot.urdf is the ur10.
_ROBOT_SUFFIX = "_robot"


def _share_folder() -> Path | None:
    """Return the folder that contains the package example-robot-data; None if it is not installed."""
    try:
        folder = Path(str(metadata.distribution(_DISTRIBUTION).locate_file(_SHARE)))
    except metadata.PackageNotFoundError:
        return None
    return folder if (folder / _DISTRIBUTION).is_dir() else None


def example_robots() -> dict[str, Path]:
    """Find the robots of example-robot-data by name: `ur10`, or `anymal_b_simple_description/anymal`."""
    share = _share_folder()
    by_name: dict[str, dict[str, Path]] = {}
    for path in sorted((share / _DISTRIBUTION / "robots").glob("*/*/*.urdf")) if share else ():
        packages = by_name.setdefault(path.stem.removesuffix(_ROBOT_SUFFIX), {})
        package = path.parent.parent.name
        # ur3.urdf beside ur3_robot.urdf is a part of a description and not a robot.
        if package not in packages or path.stem.endswith(_ROBOT_SUFFIX):
            packages[package] = path
    robots = {}
    for name, packages in by_name.items():
        for package, path in packages.items():
            robots[name if len(packages) == 1 else f"{package}/{name}"] = path
    return dict(sorted(robots.items()))


def resolve_robot_path(path: PathLike) -> str:
    """Return the path of a robot file, also for a robot of example-robot-data."""
    text = os.fspath(path)
    if not text.startswith(EXAMPLE_PREFIX):
        return text
    robots, name = example_robots(), text.removeprefix(EXAMPLE_PREFIX)
    if not robots:
        raise UnknownNameError(
            f"{text}: the package {_DISTRIBUTION} is not installed; install it: pip install "
            "'dhcal-pin[robots]'"
        )
    if name not in robots:
        raise UnknownNameError(f"{text}: unknown robot of {_DISTRIBUTION}; choose from {', '.join(robots)}")
    return os.fspath(robots[name])


def mesh_folders(source: PathLike, package_dirs: Iterable[PathLike]) -> list[str]:
    """List the folders in which the meshes of a robot are searched."""
    named = [folder for path in map(Path, package_dirs) for folder in (path, path.absolute().parent)]
    share = _share_folder()
    return [os.fspath(path) for path in (*named, *Path(source).absolute().parents, share) if path]


def validated_package_dirs(folders: Iterable[PathLike]) -> tuple[str, ...]:
    """Check that folders with meshes exist."""
    paths = tuple(os.fspath(folder) for folder in folders)
    for path in paths:
        if not os.path.isdir(path):
            raise InvalidArgumentError(
                f"{path}: no such folder; name a folder that contains packages with meshes"
            )
    return paths


def mesh_files(mesh: str, folders: Iterable[PathLike]) -> list[str]:
    """List the files that a mesh of a URDF may be."""
    path = mesh.rpartition("://")[2]
    variables = "ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"
    more = [folder for name in variables for folder in os.environ.get(name, "").split(os.pathsep) if folder]
    places = [*folders, *more, *(os.path.join(folder, "share") for folder in more)]
    found = (file for file in (path, *(os.path.join(folder, path) for folder in places)))
    return list(filter(os.path.isfile, found))


def is_mesh_too_large(mesh: str, folders: Iterable[PathLike]) -> bool:
    """Return whether a mesh is larger than `MAX_MESH_BYTES`; Pinocchio takes 25 times its size in memory."""
    return any(os.path.getsize(file) > MAX_MESH_BYTES for file in mesh_files(mesh, folders))


def mesh_remedy(mesh: str) -> str:
    """Say how a missing mesh can be found."""
    scheme, _, path = mesh.rpartition("://")
    package = path.split("/")[0]
    folder = f"the folder that contains the package {package}" if scheme else "the folder of the meshes"
    return f"name {folder} with --package-dir, or in ROS_PACKAGE_PATH or AMENT_PREFIX_PATH"
