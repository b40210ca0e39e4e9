"""`dhcal check`: compare the Jacobian of the robot with the paper, Pinocchio and finite differences."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict

from ... import paper
from .. import screens
from ..options import JSON, ROBOT, URDF_OPTIONS, Options, read_one_robot

EXAMPLE = "dhcal check arm.dh.toml"

ARGUMENTS: Options = {
    "robot": ROBOT,
    **URDF_OPTIONS,
    "--json": JSON,
}


def run(args: Namespace) -> int:
    """Compute the Jacobian in several ways and show the differences."""
    from ..outputs import require_writable_outputs, write_outputs  # lazy import: loads Pinocchio

    require_writable_outputs([args.json], [args.robot])
    rows = paper.crosscheck(read_one_robot(args.robot, args))
    all_agree = all(row.agrees for row in rows)
    routes = [asdict(row) | {"agrees": row.agrees} for row in rows]
    write_outputs({}, args.json, {"agree": all_agree, "routes": routes})
    screens.show(screens.crosscheck_screen(args.robot, rows), args.verbosity)
    return 0 if all_agree else 1
