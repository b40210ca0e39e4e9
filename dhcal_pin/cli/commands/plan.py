"""`dhcal plan`: choose the poses to measure and predict the resulting accuracy."""

from __future__ import annotations

from argparse import Namespace

from ... import planning, report
from .. import screens
from ..options import forbid_options, read_one_robot
from ..plan_options import ARGUMENTS as ARGUMENTS

EXAMPLE = "dhcal plan ur10.urdf -n 40 --tip tool0 --sigma 0.1mm,0.01deg -o poses.csv"


def run(args: Namespace) -> int:
    """Choose poses, write them and show the predicted accuracy."""
    if args.iso9283:
        from ..iso_plan import run_iso_plan  # lazy import: slow to load

        return run_iso_plan(args)
    forbid_options(args, "cube cycles", "needs --iso9283")
    from ..arm_types import with_arm_type  # lazy import, as the following: they load Pinocchio
    from ..output_table import file_contents
    from ..outputs import checked_files, require_workbook, write_outputs
    from ..plan_input import input_paths, planned_count, planned_kind, read_input
    from ..plan_outputs import OUTPUTS, Planned, content_makers, plan_document

    count, n_repeated = planned_count(args)
    kind, inputs = planned_kind(args), input_paths(args)
    files = checked_files(args, OUTPUTS, inputs)
    require_workbook(args.sheet, inputs)
    chain = with_arm_type(read_one_robot(args.robot, args), args.arm, args.servos, args.parameters)
    given, rows = read_input(args, chain, kind)
    with screens.show_progress(f"choosing {count} poses") as progress:
        result = planning.plan(chain, count, progress=progress, **given)
    if n_repeated:
        result = planning.with_repeats(result, chain, n_repeated, given["space"], given["margin"])
    done = Planned(result, chain, given, rows, args, report.file_digests(inputs))
    contents = file_contents(files, content_makers(done))
    write_outputs(contents, args.json, plan_document(done))
    screens.show(screens.plan_screen(result, done.moves, contents), args.verbosity)
    return 0
