"""Rig files: cameras and boards of a set-up as TOML, as the option `--rig` names them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from .._typing import Array, PathLike
from ..cameras.boards import BOARD_TYPES, Board
from ..cameras.lens import FOCAL_AND_CENTRE, LENSES
from ..cameras.rig import INTRINSICS_CHOICES, Camera, Rig
from ..exceptions import FileFormatError, InvalidArgumentError, UnknownNameError
from .tabular import MAX_SIDECAR_BYTES
from .toml_table import TomlTable, is_number, pose_content, read_pose

# Largest number of squares or tags along a side, and of pixels along a side of an image.
_MAX_COUNT, _MAX_PIXELS = 1000, 100_000
# Largest side of a square and largest coordinate of a point [mm].
_MAX_MM = 100_000
# Keys of a pose.
_POSE_KEYS = ("xyz_m", "rotvec_rad")

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


def _first_pose(table: TomlTable) -> Array | None:
    """Return the first guess of a pose (4, 4), None without one."""
    present = [key for key in _POSE_KEYS if key in table]
    if not present:
        return None
    return read_pose(TomlTable(table.path, {key: table.get(key) for key in present}, table.name))


def _read_camera(table: TomlTable) -> Camera:
    """Read a camera."""
    lens = LENSES[table.choice("model", LENSES, "pinhole")]
    given = [name for name in FOCAL_AND_CENTRE if name in table]
    if given and len(given) < 4:
        missing = next(name for name in FOCAL_AND_CENTRE if name not in given)
        raise FileFormatError(
            f"{table.where}: {', '.join(given)} without {missing}; expected all of fx, fy, cx, cy or none"
        )
    values = np.array([np.nan] * 4 + [0.0] * len(lens.coefficients))
    if given:
        values[:2] = [table.number(name, above=0.0) for name in ("fx", "fy")]
        values[2:4] = [table.number(name) for name in ("cx", "cy")]
        values[4:] = table.vector("distortion", len(lens.coefficients), values[4:].tolist())
    elif "distortion" in table:
        raise FileFormatError(
            f"{table.where}: distortion without fx, fy, cx, cy; expected all of them or none"
        )
    intrinsics = table.choice("intrinsics", INTRINSICS_CHOICES, "prior")
    if intrinsics == "fixed" and not given:
        raise FileFormatError(f'{table.where}: intrinsics = "fixed" without values; expected fx, fy, cx, cy')
    camera = Camera(
        name=_name(table),
        link=table.text("link", expected='a link of the robot, "world" or "tip"'),
        width=_count(table, "width", _MAX_PIXELS),
        height=_count(table, "height", _MAX_PIXELS),
        values=values,
        lens=lens,
        intrinsics=intrinsics,
        pose=_first_pose(table),
    )
    table.finish()
    return camera


def _count(table: TomlTable, key: str, at_most: int) -> int:
    """Return a positive whole number."""
    value = table.value(key, int, expected=f"a whole number from 1 to {at_most}")
    if not 1 <= value <= at_most:
        raise table.error(key, f"expected a whole number from 1 to {at_most}")
    return value


def _read_board(table: TomlTable) -> Board:
    """Read a board."""
    kind = table.choice("type", BOARD_TYPES)
    points = table.choice("points", ("auto", "fixed", "prior"), "auto")
    common: dict[str, Any] = {
        "name": _name(table),
        "link": table.text("link", expected='a link of the robot, "world" or "tip"'),
        "type": kind,
        "has_free_points": points == "prior",
        "has_exact_points": points == "fixed",
        "pose": _first_pose(table),
        "source": table.where,
    }
    if kind == "points":
        board = Board(**common, listed_points=_listed_points(table))
    else:
        smallest = 1 if kind == "aprilgrid" else 2
        size: dict[str, Any] = {key: _count(table, key, _MAX_COUNT) for key in ("columns", "rows")}
        if min(size.values()) < smallest:
            raise FileFormatError(f"{table.where}: columns and rows count squares; expected at least 2 each")
        if kind == "aprilgrid":
            marker = _millimetres(table, "marker_mm")
            board = Board(
                **common,
                **size,
                square=marker,
                marker=marker,
                spacing=_millimetres(table, "spacing_mm"),
                dictionary=table.text("dictionary", "DICT_APRILTAG_36h11"),
            )
        else:
            square = _millimetres(table, "square_mm")
            markers: dict[str, Any] = {}
            if kind == "charuco":
                markers = {
                    "marker": _millimetres(table, "marker_mm"),
                    "dictionary": table.text("dictionary", expected='a dictionary such as "DICT_5X5_100"'),
                    "is_legacy": table.value("legacy", bool, False),
                }
                if markers["marker"] >= square:
                    raise table.error("marker_mm", f"expected less than square_mm = {1e3 * square:g}")
            board = Board(**common, **size, square=square, **markers)
    table.finish()
    return board


def _millimetres(table: TomlTable, key: str) -> float:
    """Return a positive length in millimetres, in metres."""
    expected = f"a length in millimetres above 0 and up to {_MAX_MM:g}"
    return table.number(key, above=0.0, at_most=_MAX_MM, expected=expected) / 1e3


def _listed_points(table: TomlTable) -> Array:
    """Return the points of a board of that type, (c, 3) [m]."""
    points = table.array("points_mm")
    for point in points:
        if not (
            isinstance(point, list)
            and len(point) == 3
            and all(is_number(v) and abs(v) < _MAX_MM for v in point)
        ):
            raise FileFormatError(
                f"{table.where}: points_mm has the entry {point!r}; expected [x, y, z] in millimetres"
            )
    return np.array(points, float) / 1e3


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
    return {} if pose is None else pose_content(pose)
