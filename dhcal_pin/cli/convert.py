"""`dhcal convert`: write a robot file in another format."""

from __future__ import annotations

from argparse import Namespace

from ..io.atomic import write_files
from ..io.robot import convert_robot
from . import console
from .options import require_writable_outputs


def convert(args: Namespace) -> int:
    """Convert a robot file to the format that the ending of the output names."""
    require_writable_outputs([args.output], [args.input])
    text, notes = convert_robot(args.input, args.output, args.tip, args.convention)
    write_files({args.output: text})
    console.print_lines(f"wrote {args.output}")
    console.print_notes(notes)
    return 0
