"""`dhcal detect`: find the corners of boards in images and write their image coordinates."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from .options import RIG

EXAMPLE = "dhcal detect images --rig rig.toml --joints joints.csv -o corners.csv"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the arguments of `dhcal detect`.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument("images", metavar="IMAGES", nargs="+", help="image files, or folders of images")
    parser.add_argument(
        "--rig", **{**RIG, "required": True, "help": "rig file with the camera and the boards"}
    )
    parser.add_argument(
        "--joints",
        metavar="JOINTS.csv",
        help="joint values of each image: a column `image` with the file names, and one column per joint; "
        "without it the output has no joint values",
    )
    parser.add_argument(
        "--camera", metavar="NAME", help="camera of the rig file; only needed if it has several"
    )
    parser.add_argument(
        "-o", "--output", metavar="corners.csv", required=True, help="image coordinates to write"
    )


def run(args: Namespace) -> int:
    """Find the corners and write them.

    Args:
        args: Parsed arguments.

    Returns:
        Exit status 0.
    """
    from ..detection import corner_columns, detect_boards, image_files  # lazy import, as the following
    from ..io.measurement_files import read_image_joints
    from ..io.rig_file import only_entry, read_rig
    from ..io.tabular import csv_text
    from . import console
    from .outputs import require_writable_outputs, write_outputs
    from .result_screens import detection_screen

    inputs = [args.rig, *([args.joints] if args.joints else [])]
    paths = image_files(args.images)
    require_writable_outputs([args.output], [*inputs, *paths])
    rig = read_rig(args.rig)
    camera = only_entry(rig.cameras, args.camera, "camera", args.rig)
    joints = read_image_joints(args.joints, paths) if args.joints else None
    with console.progress_bar("finding boards", len(paths) * len(rig.boards)) as on_progress:
        detections = detect_boards(rig, camera, paths, on_progress)
    columns = corner_columns(rig, camera, detections, joints)
    comments = [f"corners of boards in images of camera {camera.name}, found by dhcal detect"]
    write_outputs({args.output: csv_text(columns, comments)})
    console.show(detection_screen(rig, detections, args.output), args.verbosity)
    return 0
