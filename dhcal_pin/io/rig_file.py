"""Rig files: cameras and boards of a set-up as TOML, as the option `--rig` names them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from .._typing import Array, PathLike
from ..cameras.boards import BOARD_TYPES, RULER, Board
from ..cameras.lens import FOCAL_AND_CENTRE, LENSES, Lens
from ..cameras.rig import INTRINSICS_CHOICES, Camera, Rig
from ..exceptions import FileFormatError, InvalidArgumentError, UnknownNameError
from . import toml_table as toml
from .tabular import MAX_SIDECAR_BYTES
from .toml_table import Key, TomlTable

# Largest number of squares or tags along a side, and of pixels along a side of an image.
_MAX_COUNT, _MAX_PIXELS = 1000, 100_000
# Largest side of a square and largest coordinate of a point [mm].
_MAX_MM = 100_000

_LINK = toml.text('a link of the robot, "world" or "tip"')
_LENGTH = toml.number(
    above=0.0, at_most=_MAX_MM, description=f"a length in millimetres above 0 and up to {_MAX_MM:g}"
)
# A first guess of a pose needs one of its keys only.
_FIRST_POSE = {
    key: replace(declared, default=None, is_optional=True) for key, declared in toml.POSE_KEYS.items()
}
# Measured length of the ruler line of a page that `dhcal board --paper` drew. Printers change lengths by 1 %.
_MAX_PRINT_CHANGE = 0.1
_RULER = replace(
    toml.number(
        above=1e3 * RULER * (1 - _MAX_PRINT_CHANGE),
        at_most=1e3 * RULER * (1 + _MAX_PRINT_CHANGE),
        description=f"the measured length of the ruler line, which is drawn {1e3 * RULER:g} mm long",
    ),
    is_optional=True,
)
_SIZE = {"columns": toml.whole(1, _MAX_COUNT), "rows": toml.whole(1, _MAX_COUNT)}
# Keys of each type of board, in addition to those of all boards.
_TYPE_KEYS: dict[str, dict[str, Key]] = {
    "points": {"points_mm": toml.list_of(toml.vector(3, _MAX_MM, "[x, y, z] in millimetres"))},
    "checkerboard": {**_SIZE, "square_mm": _LENGTH, "ruler_mm": _RULER},
    "charuco": {
        **_SIZE,
        "square_mm": _LENGTH,
        "marker_mm": _LENGTH,
        "dictionary": toml.text('a dictionary such as "DICT_5X5_100"'),
        "legacy": toml.flag(False),
        "ruler_mm": _RULER,
    },
    "aprilgrid": {
        **_SIZE,
        "marker_mm": _LENGTH,
        "spacing_mm": _LENGTH,
        "dictionary": toml.text(default="DICT_APRILTAG_36h11"),
        "ruler_mm": _RULER,
    },
}


def camera_keys(lens: Lens) -> dict[str, Key]:
    """Declare the keys of a camera with a lens."""
    return {
        "model": toml.choice(LENSES, default="pinhole"),
        "fx": toml.number(above=0.0, is_optional=True),
        "fy": toml.number(above=0.0, is_optional=True),
        "cx": toml.number(is_optional=True),
        "cy": toml.number(is_optional=True),
        "distortion": toml.vector(len(lens.coefficients), is_optional=True),
        "intrinsics": toml.choice(INTRINSICS_CHOICES, default="prior"),
        "link": _LINK,
        "width": toml.whole(1, _MAX_PIXELS),
        "height": toml.whole(1, _MAX_PIXELS),
        **_FIRST_POSE,
    }


def board_keys(board_type: str) -> dict[str, Key]:
    """Declare the keys of a board of a type."""
    return {
        "type": toml.choice(BOARD_TYPES),
        "points": toml.choice(("auto", "fixed", "prior"), default="auto"),
        "link": _LINK,
        **_FIRST_POSE,
        **_TYPE_KEYS[board_type],
    }


Entry = TypeVar("Entry", Camera, Board)


def read_rig(path: PathLike) -> Rig:
    """Read the cameras and boards of a rig file.

    Args:
        path: TOML file with tables `[camera.NAME]` and `[board.NAME]`.

    Returns:
        The rig.

    Raises:
        FileFormatError: There is no camera or no board.
    """
    table = TomlTable.read(path)
    rig = _read_tables(table)
    table.finish()
    for kind, entries in (("camera", rig.cameras), ("board", rig.boards)):
        if not entries:
            raise FileFormatError(f"{os.fspath(path)}: no [{kind}.NAME] table; expected at least one")
    return rig


def read_calibrated_rig(path: PathLike) -> Rig | None:
    """Read the cameras and boards of the sidecar of a calibrated robot."""
    rig = _read_tables(TomlTable.read(path, MAX_SIDECAR_BYTES))
    return rig if rig.cameras and rig.boards else None


def _read_tables(table: TomlTable) -> Rig:
    """Return the cameras and boards of a rig file or of a sidecar."""
    groups = [table.table(kind) for kind in ("camera", "board")]
    for kind, group in zip(("camera", "board"), groups, strict=True):
        for key in group.keys():
            if not isinstance(group.get(key), dict):
                raise FileFormatError(
                    f"{group.where}: no name; expected a table [{kind}.NAME] with {key} and others"
                )
    cameras, boards = ([group.table(name) for name in group.keys()] for group in groups)
    return Rig(
        {camera.name: camera for camera in map(_read_camera, cameras)},
        {board.name: board for board in map(_read_board, boards)},
        os.fspath(table.path),
    )


def with_poses_of(rig: Rig, other: Rig) -> Rig:
    """Return a rig whose entries without a pose have those of the same names in another rig."""
    return replace(
        rig,
        cameras={
            name: other.cameras.get(name, e) if e.pose is None else e for name, e in rig.cameras.items()
        },
        boards={
            # Estimated corners are a list of points, of which nothing says that they are printed on a plane.
            name: replace(e, link=other.boards[name].link, pose=other.boards[name].pose)
            if e.pose is None and name in other.boards
            else e
            for name, e in rig.boards.items()
        },
    )


def with_estimates_of(rig: Rig, calibrated: Rig, ends: Mapping[str, str]) -> Rig:
    """Return a rig whose entries have the estimated poses, lenses and corners of the same names."""
    pairs = [
        ("camera", rig.cameras, calibrated.cameras, _camera_properties),
        ("board", rig.boards, calibrated.boards, _board_properties),
    ]
    for kind, entries, others, properties in pairs:
        for name in entries.keys() & others.keys():
            stated, estimated = (properties(group[name], ends) for group in (entries, others))
            for what, value in stated.items():
                if value != estimated[what]:
                    raise InvalidArgumentError(
                        f"{rig.source}: [{kind}.{name}]: {what} {value}, but {estimated[what]} in "
                        f"{calibrated.source}; expected the {kind} of the calibration, or another name"
                    )
    return replace(
        rig,
        cameras={name: calibrated.cameras.get(name, entry) for name, entry in rig.cameras.items()},
        boards={name: calibrated.boards.get(name, entry) for name, entry in rig.boards.items()},
    )


def _camera_properties(camera: Camera, ends: Mapping[str, str]) -> dict[str, Any]:
    """Return what the calibration of a camera does not change."""
    size = f"{camera.width} x {camera.height} px"
    return {"link": ends.get(camera.link, camera.link), "model": camera.lens.name, "images": size}


def _board_properties(board: Board, ends: Mapping[str, str]) -> dict[str, Any]:
    """Return what the calibration of a board does not change."""
    return {"link": ends.get(board.link, board.link), "number of corners": len(board.points)}


def only_entry(entries: Mapping[str, Entry], name: str | None, kind: str, source: PathLike) -> Entry:
    """Return a camera or a board of a rig by name, or the only one."""
    if name is None and len(entries) == 1:
        return next(iter(entries.values()))
    if name is None:
        raise InvalidArgumentError(
            f"{os.fspath(source)}: has several entries [{kind}.NAME]; choose one with --{kind}: "
            f"{', '.join(entries)}"
        )
    if name not in entries:
        raise UnknownNameError(
            f"--{kind} {name}: {os.fspath(source)} has no [{kind}.{name}]; choose from {', '.join(entries)}"
        )
    return entries[name]


def _name(table: TomlTable) -> str:
    """Return the name of a camera or a board from its table."""
    return table.name.removeprefix("[").removesuffix("]").split(".", 1)[1]


def _first_pose(values: Mapping[str, Any]) -> Array | None:
    """Return the first guess of a pose (4, 4), None without one."""
    given = {key: values[key] for key in toml.POSE_KEYS if values[key] is not None}
    return (
        toml.pose_of({key: declared.default for key, declared in toml.POSE_KEYS.items()} | given)
        if given
        else None
    )


def _read_camera(table: TomlTable) -> Camera:
    """Read a camera."""
    lens = LENSES[toml.choice(LENSES, default="pinhole").read(table, "model")]
    given = [name for name in FOCAL_AND_CENTRE if name in table]
    if given and len(given) < 4:
        missing = next(name for name in FOCAL_AND_CENTRE if name not in given)
        raise FileFormatError(
            f"{table.where}: {', '.join(given)} without {missing}; expected all of fx, fy, cx, cy or none"
        )
    if "distortion" in table and not given:
        raise FileFormatError(
            f"{table.where}: distortion without fx, fy, cx, cy; expected all of them or none"
        )
    values = table.values(camera_keys(lens))
    if values["intrinsics"] == "fixed" and not given:
        raise FileFormatError(f'{table.where}: intrinsics = "fixed" without values; expected fx, fy, cx, cy')
    stated = [values[name] if given else np.nan for name in FOCAL_AND_CENTRE]
    return Camera(
        name=_name(table),
        link=values["link"],
        width=values["width"],
        height=values["height"],
        values=np.array(stated + (values["distortion"] or [0.0] * len(lens.coefficients))),
        lens=lens,
        intrinsics=values["intrinsics"],
        pose=_first_pose(values),
    )


def _read_board(table: TomlTable) -> Board:
    """Read a board."""
    kind = toml.choice(BOARD_TYPES).read(table, "type")
    values = table.values(board_keys(kind))
    smallest = 1 if kind == "aprilgrid" else 2
    if kind != "points" and min(values["columns"], values["rows"]) < smallest:
        raise FileFormatError(f"{table.where}: columns and rows count squares; expected at least 2 each")
    if kind == "charuco" and values["marker_mm"] >= values["square_mm"]:
        raise table.error("marker_mm", f"expected less than square_mm = {values['square_mm']:g}")
    # A square of an AprilGrid is a tag.
    lengths = {"square": "marker_mm" if kind == "aprilgrid" else "square_mm", "marker": "marker_mm"}
    lengths |= {"spacing": "spacing_mm"}
    names = {"columns": "columns", "rows": "rows", "dictionary": "dictionary", "is_legacy": "legacy"}
    own: dict[str, Any] = {field: values[key] for field, key in names.items() if key in values}
    print_scale = (values.get("ruler_mm") or 1e3 * RULER) / (1e3 * RULER)
    own |= {field: print_scale * values[key] / 1e3 for field, key in lengths.items() if key in values}
    if kind == "points":
        own["listed_points"] = np.array(values["points_mm"]) / 1e3
    return Board(
        name=_name(table),
        link=values["link"],
        type=kind,
        has_free_points=values["points"] == "prior",
        has_exact_points=values["points"] == "fixed",
        pose=_first_pose(values),
        source=table.where,
        print_scale=print_scale,
        **own,
    )


def rig_text(cameras: Sequence[Camera], boards: Sequence[Board]) -> str:
    """Return the text of a rig file."""
    import tomli_w  # lazy import: only for writing

    return tomli_w.dumps(rig_content(cameras, boards))


def rig_content(cameras: Sequence[Camera], boards: Sequence[Board]) -> dict[str, Any]:
    """Return the tables of a rig file."""
    content: dict[str, Any] = {"camera": {}, "board": {}}
    for camera in cameras:
        entry: dict[str, Any] = {
            "link": camera.link,
            "model": camera.lens.name,
            "width": camera.width,
            "height": camera.height,
        }
        if camera.has_intrinsics:
            values = camera.values.tolist()
            entry |= dict(zip(FOCAL_AND_CENTRE, values[:4], strict=True))
            entry |= {"distortion": values[4:], "intrinsics": camera.intrinsics}
        content["camera"][camera.name] = entry | _pose_entry(camera.pose)
    for board in boards:
        entry = {"link": board.link, "type": board.type}
        if board.type == "points":
            entry["points_mm"] = (1e3 * board.points).tolist()
        else:
            entry |= {"columns": board.columns, "rows": board.rows}
            key = "marker_mm" if board.type == "aprilgrid" else "square_mm"
            entry[key] = 1e3 * board.square
        if board.type == "charuco":
            entry |= {"marker_mm": 1e3 * board.marker, "legacy": board.is_legacy}
        if board.type == "aprilgrid":
            entry["spacing_mm"] = 1e3 * board.spacing
        if board.dictionary and board.type != "points":
            entry["dictionary"] = board.dictionary
        if board.has_free_points:
            entry["points"] = "prior"
        if board.has_exact_points:
            entry["points"] = "fixed"
        content["board"][board.name] = entry | _pose_entry(board.pose)
    return content


def _pose_entry(pose: Array | None) -> dict[str, list[float]]:
    """Return the keys of a first guess of a pose."""
    return {} if pose is None else toml.pose_content(pose)
