"""`dhcal inspect`: say what measurement files, or a robot, contain."""

from __future__ import annotations

import os
from argparse import Namespace
from dataclasses import asdict

from ... import diagnostics, io, report
from ...exceptions import InvalidArgumentError
from ...formatting import texts_by_file
from .. import screens
from ..options import DATA, JSON, RIG, ROBOT, TABLE_OPTIONS, URDF_OPTIONS, Options, read_one_robot

EXAMPLE = "dhcal inspect laser.csv --robot ur10.urdf --tip tool0"
# Why some options need the robot.
_ROBOT_REASONS = {
    "columns": "as the map names its joints",
    "rig": "whose links carry the cameras and boards",
    "servos": "whose joints the servos move",
}

ARGUMENTS: Options = {
    "data": {**DATA, "nargs": "*", "help": f"{DATA['help']}; without them, the robot is described"},
    "--robot": {**ROBOT, "help": f"compare with the joints and limits of this {ROBOT['help']}"},
    **TABLE_OPTIONS,
    "--rig": RIG,
    "--skip-bad-rows": "as in other commands: rows that lack a number, a name or a rotation are always "
    "skipped here, and listed",
    **URDF_OPTIONS,
    "--json": JSON,
}


def run(args: Namespace) -> int:
    """Show the content of files."""
    if any(map(io.is_bundle, args.data)):
        return _inspect_bundle(args)
    from ...io.robot import has_robot_ending  # lazy import, as the following: they load Pinocchio
    from ...measurements.mounting import mount_rig
    from ..outputs import existing_sidecars, require_workbook, require_writable_outputs, write_outputs

    for path in args.data:
        if not args.robot and has_robot_ending(path):
            raise InvalidArgumentError(f"{path}: is a robot; state it with --robot {path}")
    if not args.data and not args.robot:
        raise InvalidArgumentError("DATA: expected measurement files, or a robot alone (--robot ROBOT)")
    for option, reason in _ROBOT_REASONS.items():
        if getattr(args, option) and not args.robot:
            raise InvalidArgumentError(f"--{option}: needs --robot, {reason}")
    robots = [args.robot] if args.robot else []
    settings = [path for path in (args.columns, args.rig, args.servos) if path]
    inputs = [*robots, *existing_sidecars(robots), *args.data, *settings]
    require_writable_outputs([args.json], inputs)
    require_workbook(args.sheet, inputs)
    chain = read_one_robot(args.robot, args) if args.robot else None
    rig = mount_rig(io.read_rig(args.rig), chain) if args.rig and chain is not None else None
    servos = io.read_servos(args.servos) if args.servos else None
    inspections = [
        diagnostics.inspect_file(path, chain, args.columns, rig, servos, args.sheet) for path in args.data
    ]
    robot, warnings = None, {}
    if chain is not None:
        warnings = {args.robot: diagnostics.find_robot_warnings(chain)}
        tips = list(chain.urdf.leaves())
        robot = {"path": args.robot, "tip": chain.tip, "joints": list(chain.joint_names), "tips": tips}
    document = {
        "robot": robot,
        "files": [asdict(inspection) for inspection in inspections],
        "warnings": [
            *texts_by_file(warnings),
            *(f"{one.path}: {text}" for one in inspections for text in one.warnings),
        ],
        "inputs": report.file_digests(inputs),
    }
    write_outputs({}, args.json, document)
    if chain is not None and not inspections:
        screens.show(screens.robot_screen(args.robot, chain, warnings), args.verbosity)
        return 0
    about = ""
    if chain is not None:
        about = f"{os.path.basename(args.robot)}: tip {chain.tip}, {chain.n_joints} joints"
    screens.show(screens.inspection_screen(about, warnings, inspections), args.verbosity)
    return 0


def _inspect_bundle(args: Namespace) -> int:
    """Show what a bundle holds."""
    from ..outputs import require_writable_outputs, write_outputs  # lazy import: loads Pinocchio

    if len(args.data) > 1 or args.robot or args.columns or args.rig:
        raise InvalidArgumentError(f"{args.data[0]}: a bundle is inspected alone; leave out other files")
    path = args.data[0]
    require_writable_outputs([args.json], [path])
    bundle = io.read_bundle(path)
    accuracy = {
        key: value
        for key, value in bundle.result.items()
        if key.endswith(("before", "after")) and isinstance(value, dict) and value
    }
    document = {
        "bundle": path,
        "robot": {"path": bundle.options.get("robot"), "tip": bundle.tip, "joints": list(bundle.joints)},
        "data": bundle.options.get("data", []),
        "options": bundle.options,
        "versions": bundle.versions,
        "verdict": bundle.result.get("verdict"),
        "accuracy": accuracy,
        "sha256": bundle.digests,
    }
    write_outputs({}, args.json, document)
    screens.show(screens.bundle_screen(document, bundle.result), args.verbosity)
    return 0
