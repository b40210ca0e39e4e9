"""`dhcal convert`: write a robot file in another format."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from .options import ROBOT, TIP

EXAMPLE = "dhcal convert arm.dh.toml arm.urdf"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the arguments of `dhcal convert`.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument("input", metavar="IN", help=ROBOT["help"])
    parser.add_argument(
        "output", metavar="OUT", help="file to write; its ending selects the format: {written_formats}"
    )
    parser.add_argument("--tip", **TIP)
    parser.add_argument(
        "--convention", choices=("standard", "modified"), help="DH convention of the file to write"
    )


def run(args: Namespace) -> int:
    """Convert a robot file to the format that the ending of the output selects.

    Args:
        args: Parsed arguments.

    Returns:
        Exit status 0.
    """
    from ..io.robot import convert_robot  # lazy import, as the following: they load Pinocchio
    from . import console
    from .outputs import require_writable_outputs, write_outputs

    require_writable_outputs([args.output], [args.input])
    text, notes = convert_robot(args.input, args.output, args.tip, args.convention)
    write_outputs({args.output: text})
    console.print_lines(f"wrote {args.output}")
    console.print_notes(notes)
    return 0
