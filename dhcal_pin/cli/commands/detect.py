"""`dhcal detect`: find the corners of boards in images and write their image coordinates."""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from ... import detection, io
from ...exceptions import InvalidArgumentError
from .. import screens
from ..options import JSON, POSITIVE_INTEGER, RIG, Options

if TYPE_CHECKING:
    from ..._typing import PathLike
    from ...cameras import Camera
    from ...io.measurement_files import ImageJoints

EXAMPLE = "dhcal detect images --rig rig.toml --joints joints.csv -o corners.csv"

ARGUMENTS: Options = {
    "images IMAGES": {
        "nargs": "+",
        "help": "image files, folders of images, or videos: one still of each pause of the arm is used",
    },
    "--stills DIR": "folder for the stills of videos, VIDEO-001.png, VIDEO-002.png and so on in the order "
    "of the pauses; --joints has these names in the column `image` (default: they are not kept)",
    "--rig": {**RIG, "required": True, "help": "rig file with the camera and the boards"},
    "--joints FILE": "joint values of each image: a table with a column `image` with the file names and one "
    "column per joint, or those of the pose of the flange (x[mm],y[mm],z[mm] and qw,qx,qy,qz or "
    "rx[rad],ry[rad],rz[rad]), or a recording (.bag, .mcap, or the folder of a ROS 2 bag) if the names of "
    "the images are times such as 1700000000.25.png; without it the output has no joint values. Columns "
    "approach_JOINT have the direction in which a joint moved last (-1, 0 or 1); the comment `# rows: in "
    "order` says that the rows are in the order in which the images were taken",
    "--joint-topic TOPIC": "topic of the joint positions in the recording (default: the only one, or "
    "/joint_states)",
    "--camera NAME": "camera of the rig file; only needed if it has several",
    "--overlay DIR": "folder for pictures of the images: circles are the corners that were found, crosses "
    "those reprojected with the board pose of this image and the lens of the rig, or the lens estimated "
    "from the images if the rig states none",
    "--jobs N": {
        "type": POSITIVE_INTEGER,
        "help": "images that are searched at the same time (default: one per processor)",
    },
    "-o --output corners.csv": {"required": True, "help": "image coordinates to write"},
    "--json": JSON,
}


def run(args: Namespace) -> int:
    """Find the corners and write them."""
    with TemporaryDirectory() as folder:
        return _run(args, folder, *_with_stills(args, folder))


def _with_stills(args: Namespace, folder: str) -> tuple[list[str], list[str]]:
    """Return images with the stills of videos, saved in `folder`, in their place, and notes on the videos."""
    paths, notes = [], []
    videos = [path for path in args.images if detection.is_video(path)]
    if args.stills and not videos:
        raise InvalidArgumentError("--stills: needs a video among the images; omit it")
    for path in args.images:
        if path not in videos:
            paths.append(path)
            continue
        if not os.path.isfile(path):
            raise InvalidArgumentError(f"{path}: no such file; expected a video")
        stills = detection.save_stills(path, folder)
        paths += [file for file, _ in stills]
        times = ", ".join(f"{time:.1f}" for _, time in stills)
        notes.append(f"{path}: {len(stills)} pauses, with stills at {times} s")
    return paths, notes


def _run(args: Namespace, folder: str, images: Sequence[str], video_notes: Sequence[str]) -> int:
    """Find the corners in images and write them."""
    from ...io.measurement_files.columns import IN_ORDER  # lazy import, as the following: they load Pinocchio
    from ..output_table import Output
    from ..outputs import checked_files, require_writable_outputs, write_with_json

    # A recording of ROS 2 is a folder.
    files = [args.joints] if args.joints and os.path.isfile(args.joints) else []
    paths = detection.image_files(images)
    stills = [path for path in paths if os.path.dirname(path) == folder]
    videos = [path for path in args.images if os.path.isfile(path) and path not in paths]
    inputs = [args.rig, *files, *(path for path in paths if path not in stills), *videos]
    checked_files(args, {"output": Output("image coordinates", (".csv",)), "json": Output()}, inputs)
    rig = io.read_rig(args.rig)
    camera = io.only_entry(rig.cameras, args.camera, "camera", args.rig)
    read = _joints(args, paths)
    joints, notes = (read.joints, [*video_notes, *read.notes]) if read else (None, [*video_notes])
    comments = [f"corners of boards in images of camera {camera.name}, found by dhcal detect"]
    if read and read.is_ordered:
        place = {name: number for number, name in enumerate(read.joints)}
        paths.sort(key=lambda path: place[os.path.basename(path)])
        comments.append(IN_ORDER)
    with screens.progress_bar("finding boards", len(paths) * len(rig.boards)) as on_progress:
        detections = detection.detect_boards(rig, camera, paths, on_progress, args.jobs)
    columns = detection.corner_columns(rig, camera, detections, joints)
    used = {image.path for each in detections for image in each.used}
    if read and read.is_ordered and (left_out := [path for path in paths if path not in used]):
        notes.append(
            f"{args.joints}: {os.path.basename(left_out[0])} shows no board; directions of approach by the "
            "order of the images are wrong for the next one if a joint turned back in between"
        )
    contents: dict[PathLike, str | bytes] = {args.output: io.csv_text(columns, comments)}
    if args.overlay:
        pictures, remarks = _overlays(args.overlay, camera, detections, paths)
        contents |= pictures
        notes += remarks
    if args.stills:
        kept = {os.path.join(args.stills, os.path.basename(path)): Path(path).read_bytes() for path in stills}
        os.makedirs(args.stills, exist_ok=True)
        require_writable_outputs(list(kept), [])
        contents |= kept
    for each in detections:
        if difference := each.layout.describe(each.board):
            notes.append(f"board {each.board.name} was printed with {difference}; write so in {rig.source}")
    boards = [
        {
            "board": each.board.name,
            "images": len(each.images),
            "used": len(each.used),
            "problems": {
                os.path.basename(image.path): image.problem for image in each.images if image.problem
            },
        }
        for each in detections
    ]
    named = {"output": args.output} | ({"overlay": args.overlay} if args.overlay else {})
    write_with_json(contents, args.json, named, inputs, boards=boards, notes=notes)
    written = [args.output, *([f"{args.overlay} ({len(paths)} pictures)"] if args.overlay else [])]
    screens.show(screens.detection_screen(detections, notes, written), args.verbosity)
    return 0


def _joints(args: Namespace, paths: Sequence[str]) -> ImageJoints | None:
    """Return the joint values of the images, and notes on them."""
    from ...io.measurement_files import read_joint_table, read_recorded_joints  # lazy import: slow to load
    from ...io.measurement_files.bag import is_bag

    is_recording = bool(args.joints) and is_bag(args.joints)
    if args.joint_topic and not is_recording:
        raise InvalidArgumentError("--joint-topic: needs --joints with a recording; omit it")
    if is_recording:
        recorded = read_recorded_joints(args.joints, paths, args.joint_topic)
        return recorded._replace(notes=[f"{args.joints}: {text}" for text in recorded.notes])
    return read_joint_table(args.joints, paths) if args.joints else None


def _overlays(
    folder: str, camera: Camera, detections: Sequence[detection.BoardDetection], paths: Sequence[str]
) -> tuple[Mapping[PathLike, str | bytes], list[str]]:
    """Return the pictures of --overlay, whose folder is created, and notes on them."""
    from ..outputs import require_writable_outputs  # lazy import: loads Pinocchio

    if os.path.exists(folder) and not os.path.isdir(folder):
        raise InvalidArgumentError(f"--overlay {folder}: is a file; expected a folder")
    pictures: dict[PathLike, str | bytes] = {}
    known = detection.camera_with_intrinsics(camera, detections)
    pictures.update(detection.overlay_files(folder, known, detections))
    if len(pictures) < len(paths):
        raise InvalidArgumentError(
            f"--overlay {folder}: two images have the same name but for the ending; rename one of them"
        )
    os.makedirs(folder, exist_ok=True)
    require_writable_outputs([os.fspath(path) for path in pictures], paths)
    if known is not None:
        return pictures, []
    return pictures, [
        f"--overlay {folder}: the pictures have no reprojected corners, as the images do not determine the "
        f"lens of camera {camera.name}; state fx, fy, cx, cy in the rig file, or add images of the board "
        "tilted in different directions"
    ]
