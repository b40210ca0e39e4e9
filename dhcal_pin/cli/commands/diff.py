"""`dhcal diff`: compare two calibrations of one robot."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from ..options import JSON, ROBOT, add_urdf_options, read_one_robot
from ..output_table import Output

if TYPE_CHECKING:
    from ...diagnostics import Calibrated

EXAMPLE = "dhcal diff ur10_may.urdf ur10_june.urdf --tip tool0 --report difference.html"


OUTPUTS = {"json": Output(), "report": Output("the report of a difference", (".html",), (".htm",))}


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the arguments of `dhcal diff`."""
    text = "{} robot: a calibrated robot with its sidecar, or the nominal one"
    parser.add_argument("first", metavar="A", type=ROBOT["type"], help=text.format("one"))
    parser.add_argument("second", metavar="B", type=ROBOT["type"], help=text.format("the other"))
    add_urdf_options(parser)
    parser.add_argument("--report", metavar="F.html", help="report with maps and both robots in 3-D (.html)")
    parser.add_argument("--json", **JSON)


def run(args: Namespace) -> int:
    """Compare two robots, write the difference and show it."""
    from ... import report  # lazy import, as the following: they load Pinocchio
    from ...diagnostics import compare
    from ...io import robot_name
    from ...report.provenance import file_digests
    from ..output_table import file_contents, paths_by_name
    from ..outputs import checked_files, existing_sidecars, write_outputs
    from ..screens import console
    from ..screens.result_screens import difference_screen

    robots = [args.first, args.second]
    inputs = [*robots, *existing_sidecars(robots)]
    outputs = checked_files(args, OUTPUTS, inputs)
    difference = compare(*(_read(path, args) for path in robots))
    names, digests = [robot_name(path) for path in robots], file_digests(inputs)
    document = difference.to_dict() | {"files": paths_by_name(outputs), "inputs": digests}
    contents = file_contents(
        outputs, {"report": lambda path: report.difference_page(names, difference, digests)}
    )
    write_outputs(contents, args.json, document)
    console.show(difference_screen(difference, contents), args.verbosity)
    return 0


def _read(path: str, args: Namespace) -> Calibrated:
    """Read a robot and what its sidecar says of its calibration."""
    from ...diagnostics import Calibrated  # lazy import, as the following: they load Pinocchio
    from ...io import existing_sidecar, read_measured_region, read_uncertainty

    chain, sidecar = read_one_robot(path, args), existing_sidecar(path)
    if sidecar is None:
        return Calibrated(chain, source=path)
    return Calibrated(chain, read_uncertainty(sidecar, chain), read_measured_region(sidecar, chain), path)
