"""What the small commands of `dhcal` do, once the command line is read.

Wrong input is found before anything is written or shown; JSON goes to stdout, all else to stderr.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict

from ..io.robot import read_robot
from ..paper.jacobian_check import crosscheck
from . import console
from .options import require_writable_outputs, write_json


def check(args: Namespace) -> int:
    """All routes to the Jacobian side by side; 1 where they disagree."""
    require_writable_outputs([args.json], [args.robot])
    rows = crosscheck(read_robot(args.robot, args.tip))
    agree = all(row.agrees for row in rows)
    write_json(args.json, {"agree": agree, "routes": [asdict(row) | {"agrees": row.agrees} for row in rows]})
    console.print_crosscheck(args.robot, rows)
    return 0 if agree else 1
