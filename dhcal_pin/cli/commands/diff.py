"""`dhcal diff`: compare two calibrations of one robot."""

from __future__ import annotations

from argparse import Namespace

from ... import diagnostics, io, report
from .. import screens
from ..options import JSON, ROBOT, URDF_OPTIONS, Options, read_robot_or_table
from ..output_table import Output

EXAMPLE = "dhcal diff ur10_may.urdf ur10_june.urdf --tip tool0 --report difference.html"

OUTPUTS = {"json": Output(), "report": Output("the report of a difference", (".html",), (".htm",))}


_HELP = "{} robot: a calibrated robot with its sidecar, or the nominal one"
ARGUMENTS: Options = {
    "first A": {"type": ROBOT["type"], "help": _HELP.format("one")},
    "second B": {"type": ROBOT["type"], "help": _HELP.format("the other")},
    **URDF_OPTIONS,
    "--report F.html": "report with maps and both robots in 3-D (.html)",
    "--json": JSON,
}


def run(args: Namespace) -> int:
    """Compare two robots, write the difference and show it."""
    from ..output_table import file_contents, paths_by_name  # lazy import, as the following
    from ..outputs import checked_files, existing_sidecars, write_outputs

    robots = [args.first, args.second]
    inputs = [*robots, *existing_sidecars(robots)]
    outputs = checked_files(args, OUTPUTS, inputs)
    difference = diagnostics.compare(*(_read(path, args) for path in robots))
    names, digests = [io.robot_name(path) for path in robots], report.file_digests(inputs)
    document = difference.to_dict() | {"files": paths_by_name(outputs), "inputs": digests}
    contents = file_contents(
        outputs, {"report": lambda path: report.difference_page(names, difference, digests)}
    )
    write_outputs(contents, args.json, document)
    screens.show(screens.difference_screen(difference, contents), args.verbosity)
    return 0


def _read(path: str, args: Namespace) -> diagnostics.Calibrated:
    """Read a robot and what its sidecar says of its calibration."""
    chain, sidecar = read_robot_or_table(path, args), io.existing_sidecar(path)
    if sidecar is None:
        return diagnostics.Calibrated(chain, source=path)
    return diagnostics.Calibrated(
        chain, io.read_uncertainty(sidecar, chain), io.read_measured_region(sidecar, chain), path
    )
