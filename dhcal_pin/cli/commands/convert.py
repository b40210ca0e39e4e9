"""`dhcal convert`: write a robot file in another format, or the stops of recordings as measurements."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence

from ... import io
from ...exceptions import InvalidArgumentError
from .. import screens
from ..options import COLUMNS, JSON, ROBOT, URDF_OPTIONS, Options, forbid_options, read_one_robot

EXAMPLE = "dhcal convert arm.dh.toml arm.urdf"

ARGUMENTS: Options = {
    "input IN": {
        "type": ROBOT["type"],
        "help": f"{ROBOT['help']}; with --template, corrections of a maker: {{correction_formats}}; or a "
        "recording: .bag, .mcap, or the folder of a ROS 2 bag; with --poses, a table of joint values over "
        "time",
    },
    "output OUT": "file to write; its ending selects the format: {written_formats}; of a recording, a "
    "measurement file (.csv)",
    **URDF_OPTIONS,
    "--convention": {"choices": ("standard", "modified"), "help": "DH convention of the file to write"},
    "--template FILE": {
        "type": ROBOT["type"],
        "help": "write this URDF or MJCF of the same robot with the kinematics of IN; joints are matched by "
        "their names, and all else stays",
    },
    "--template-tip LINK": "link, body or site of the template that is the tip of IN (default: the one of "
    "the same name)",
    "--pose-topic TOPIC": "topic of the measured poses or points of a recording, TOPIC:FRAME for a child "
    "frame of transforms; without it the candidates are listed",
    "--joint-topic TOPIC": "topic of the joint positions of a recording (default: the only one of its type, "
    "or /joint_states)",
    "--poses FILE": "table of measured positions or poses over time, recorded beside the joint values of IN; "
    "needs --robot",
    "--columns": COLUMNS,
    "--robot": {
        **ROBOT,
        "help": "write the joints of this robot only; needed for prismatic joints of a recording",
    },
    "--json": JSON,
}


def run(args: Namespace) -> int:
    """Convert a robot file to the format that the ending of the output selects, or a recording."""
    from ...io.measurement_files.bag import is_bag  # lazy import, as the following: they load Pinocchio
    from ..outputs import require_writable_outputs, write_with_json

    others = [path for path in (args.robot, args.template, args.poses, args.columns) if path]
    inputs = [args.input, *others]
    require_writable_outputs([args.output, args.json], inputs)
    convert = _convert_tables if args.poses else _convert_bag if is_bag(args.input) else _convert_robot
    text, notes = convert(args)
    write_with_json({args.output: text}, args.json, {"output": args.output}, inputs, notes=list(notes))
    screens.show(screens.files_screen([args.output], notes), args.verbosity)
    return 0


def _convert_robot(args: Namespace) -> tuple[str, Sequence[str]]:
    """Return the text of a robot in another format, and notes on it."""
    reason = f"{args.input} is no recording; expected .bag, .mcap or a folder"
    forbid_options(args, "pose_topic joint_topic", reason)
    forbid_options(args, "robot columns", "only for a recording; omit it, or add --poses")
    if args.template_tip and not args.template:
        raise InvalidArgumentError("--template-tip: needs --template, the file that it is in")
    return io.convert_robot(
        args.input, args.output, args.tip, args.convention, args.template, args.template_tip, args.root
    )


def _convert_tables(args: Namespace) -> tuple[str, Sequence[str]]:
    """Return the text of the stops of two recorded tables, and notes on them."""
    from ...io.measurement_files.recorded_tables import convert_tables  # lazy import: loads Pinocchio

    _require_measurement_file(args)
    forbid_options(args, "pose_topic joint_topic", "the tables of --poses have no topics; omit it")
    if not args.robot:
        raise InvalidArgumentError("--poses: needs --robot, whose joints the columns of IN name")
    return convert_tables(args.input, args.poses, read_one_robot(args.robot, args), args.columns)


def _convert_bag(args: Namespace) -> tuple[str, Sequence[str]]:
    """Return the text of the stops of a recording, and notes on them."""
    from ...io.measurement_files.bag import convert_bag  # lazy import: loads Pinocchio

    _require_measurement_file(args)
    chain = read_one_robot(args.robot, args) if args.robot else None
    return convert_bag(args.input, args.pose_topic, args.joint_topic, chain)


def _require_measurement_file(args: Namespace) -> None:
    """Require the output and the options of a recording."""
    if not args.output.lower().endswith(".csv"):
        raise InvalidArgumentError(f"{args.output}: a recording becomes a measurement file; expected .csv")
    forbid_options(args, "convention template", "a recording has none; omit it")
