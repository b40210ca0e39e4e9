"""What the small commands of `dhcal` do, once the command line is read.

Wrong input is found before anything is written or shown; JSON goes to stdout, all else to stderr.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence

from ..exceptions import DhcalError
from ..io import robot, ur_kinematics
from ..io.atomic import write_files
from ..io.dh_file import dh_text, is_dh
from ..io.robot import is_table, read_robot, read_table, robot_name
from ..robot.chain import extract_dh_table
from ..robot.dh_urdf import dh_to_urdf
from . import console
from .options import require_urdf_ending, require_writable_outputs, sidecars


def convert(args: Namespace) -> int:
    """A table to a URDF, or a robot to a table, a list of origins, or UR's YAML."""
    require_writable_outputs([args.output], [args.input])
    low = args.output.lower()
    if low.endswith(".origins.csv"):
        text, notes = robot.origins_text(read_robot(args.input, args.tip)), ()
    elif low.endswith((".yaml", ".yml")):
        text, notes = ur_kinematics.ur_kinematics_text(read_robot(args.input, args.tip)), ()
    elif is_dh(args.output):
        text, notes = _to_dh(args)
    elif is_table(args.input):
        text, notes = _to_urdf(args)
    else:
        raise DhcalError(
            f"{args.output}: unknown ending; "
            "a URDF converts to .dh.toml, .dh.csv, .origins.csv, or UR's .yaml"
        )
    write_files({args.output: text})
    console.print_lines(f"wrote {args.output}")
    console.print_notes(notes)
    return 0


def _to_dh(args: Namespace) -> tuple[str, Sequence[str]]:
    chain = read_robot(args.input, args.tip)
    if is_table(args.input):
        table = read_table(args.input)
        if args.convention in (None, table.convention):
            return dh_text(table, args.output), ()
    found = extract_dh_table(chain, args.convention or "standard")
    left = [f"base, tool and joints in {path} do not go to the table" for path in sidecars([args.input])]
    return dh_text(found.table, args.output), [*found.notes, *left]


def _to_urdf(args: Namespace) -> tuple[str, Sequence[str]]:
    require_urdf_ending(args.output, "or a DH table as .dh.toml or .dh.csv")
    if args.tip is not None or args.convention is not None:
        raise DhcalError(f"{args.input}: a table has one tip and one URDF; leave out --tip and --convention")
    beside = [f"{path} lies beside it and is read with it" for path in sidecars([args.output])]
    return dh_to_urdf(read_table(args.input), robot_name(args.input)), beside
