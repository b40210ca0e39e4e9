"""The command line of `dhcal`: its commands, their arguments and their help."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Any, NoReturn

from ..robot.error_families import FAMILIES


class _Parser(argparse.ArgumentParser):
    """A parser whose complaint is one line, as every other one is.

    Attributes:
        details: Function that returns text for the end of the help. It is called only when the help is
            printed, so that it can import modules that are slow to import.
    """

    details: Callable[[], str] | None = None

    def format_help(self) -> str:
        """Return the help, with the details before the example."""
        if self.details is not None:
            self.epilog = f"{self.details()}\n\n{self.epilog}"
            self.details = None
        return super().format_help()

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {' '.join(message.split())}; see {self.prog} --help", file=sys.stderr)
        sys.exit(2)


class _Version(argparse.Action):
    """Looks the version up only when asked for it."""

    def __call__(self, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"dhcal {version('dhcal-pin')}")
        sys.exit(0)


class _Help(argparse.RawDescriptionHelpFormatter):
    """Help with room for the longest name beside its text."""

    def __init__(self, prog: str, **options: Any):
        super().__init__(prog, max_help_position=30, **options)


def _add(commands, name: str, summary: str, example: str) -> _Parser:
    return commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog=f"example:\n  {example}",
        formatter_class=_Help,
    )


_ROBOT: dict[str, Any] = {"metavar": "ROBOT", "help": "URDF, or DH file (.toml, .csv)"}


_DATA: dict[str, Any] = {"metavar": "DATA", "nargs": "+", "help": "measurement CSV files"}


_TIP: dict[str, Any] = {"metavar": "F", "help": "tip link of a URDF (default: the deepest leaf)"}


_COLUMNS: dict[str, Any] = {"metavar": "MAP.toml", "help": "how to read files of another maker"}


_JSON: dict[str, Any] = {"metavar": "FILE", "help": "the result as JSON; - for stdout"}


_SCHEDULER: dict[str, Any] = {"metavar": "ADDRESS", "help": "a Dask cluster, as tcp://host:8786"}


def _robot_formats() -> str:
    from ..io.robot import formats_help  # lazy import: Pinocchio is slow to import

    return formats_help()


def _count(text: str) -> int:
    return _whole(text, 1)


def _seed(text: str) -> int:
    return _whole(text, 0)


def _whole(text: str, least: int) -> int:
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None
    if not least <= value < 2**63:
        raise argparse.ArgumentTypeError(f"{text} must be a whole number from {least} on")
    return value


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    out = _Parser(
        prog="dhcal",
        description="Robot kinematic calibration: a robot and measurements in, the corrected URDF out.",
        epilog="ROBOT is a URDF or a DH file (.toml, .csv). Every command has --help with an example.",
        formatter_class=_Help,
    )
    out.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = out.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)

    demo = _add(
        commands, "demo", "the paper's arm and its measured table, end to end", "dhcal demo --out demo"
    )
    demo.add_argument("--out", default="demo", metavar="DIR", help="folder for the results (default: demo)")
    demo.add_argument("--open", action="store_true", help="open the report, scene included, in the browser")
    demo.add_argument("--json", metavar="FILE", help="the result as JSON to one more place; - for stdout")

    calibrate = _add(
        commands,
        "calibrate",
        "identify a robot's errors from measurements and write the corrected URDF",
        "dhcal calibrate ur10.urdf laser.csv --tip tool0 --holdout 0.3 -o ur10_calibrated.urdf",
    )
    calibrate.add_argument("robot", metavar="ROBOT", help=f"{_ROBOT['help']}; or a manifest, NAME.fleet.toml")
    calibrate.add_argument("data", metavar="DATA", nargs="*", help=f"{_DATA['help']}; none with a manifest")
    calibrate.add_argument(
        "-o",
        "--output",
        metavar="OUT.urdf",
        required=True,
        help="the corrected URDF; a manifest's summary.csv",
    )
    calibrate.add_argument("--tip", **_TIP)
    calibrate.add_argument("--columns", **_COLUMNS)
    calibrate.add_argument(
        "--parameters",
        metavar="SET[,SET]",
        help="what is unknown: dh, modified-dh, hayati, minimal, placement, base, tool, offset, "
        f"{', '.join(FAMILIES)} (default: minimal,base,tool for a URDF, dh for a DH file)",
    )
    calibrate.add_argument(
        "--extend",
        metavar="auto|none|FAMILY[,FAMILY]",
        default="none",
        help="add families of joint errors that lower the error cross-validated by regions of joint space: "
        "any of them (auto), none (default), or some of those named. Families: "
        f"{'; '.join(f'{f.name} ({f.description})' for f in FAMILIES.values())}",
    )
    calibrate.add_argument(
        "--fix", metavar="NAME[,NAME]", default="", help="hold parameters or sets at nominal"
    )
    calibrate.add_argument("--free", metavar="NAME[,NAME]", default="", help="add single parameters")
    calibrate.add_argument(
        "--holdout",
        metavar="FRACTION|FILE",
        help="what is judged by, not fitted: a share such as 0.3, or a measurement file",
    )
    calibrate.add_argument("--method", choices=("lm", "gn"), default="lm", help="gn is the paper's loop")
    calibrate.add_argument(
        "--loss",
        metavar="LOSS",
        default="auto",
        help="what gross errors count: auto (default) nothing, linear as all others; huber, cauchy, tukey "
        "weigh every sample by its size",
    )
    calibrate.add_argument("--priors", metavar="default|none|FILE", help="default for lm, none for gn")
    calibrate.add_argument("--bounds", metavar="FILE.toml", help="least and largest values by parameter name")
    calibrate.add_argument(
        "--instrument", metavar="FILE", help="TOML whose [instrument] table holds surveyed values, as wire1.x"
    )
    calibrate.add_argument(
        "--payload", metavar="KG[@X,Y,Z]", help="what the tip carries, for compliance: 5kg or 5kg@0,0,80mm"
    )
    calibrate.add_argument("--max-iterations", metavar="N", type=_count, default=100, help="most steps (100)")
    calibrate.add_argument(
        "--seed", metavar="N", type=_seed, default=0, help="for the choice of the hold-out"
    )
    calibrate.add_argument("--in-place", action="store_true", help="allow -o to be ROBOT itself")
    calibrate.add_argument(
        "--world-joint", action="store_true", help="put the base into the URDF, as a joint from `world`"
    )
    calibrate.add_argument(
        "--tool-frame", metavar="NAME", help="put the tool into the URDF, as a link fixed to the tip"
    )
    calibrate.add_argument(
        "--map",
        metavar="MAP",
        help="predicted position uncertainty over the workspace, and held-out errors, as .csv or .html",
    )
    calibrate.add_argument(
        "--report",
        metavar="R.html",
        action="append",
        default=[],
        help="the report, as .html or .md; may repeat",
    )
    calibrate.add_argument("--json", **_JSON)
    where = calibrate.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs", metavar="N", type=_count, help="processes (default: one, or one a processor for a manifest)"
    )
    where.add_argument("--scheduler", **_SCHEDULER)

    validate = _add(
        commands,
        "validate",
        "the accuracy of a model on measurements; nothing is fitted but, on request, base and tool",
        "dhcal validate ur10_calibrated.urdf other.csv --tip tool0 --fit-frames",
    )
    validate.add_argument("robot", **_ROBOT)
    validate.add_argument("data", **_DATA)
    validate.add_argument("--tip", **_TIP)
    validate.add_argument("--columns", **_COLUMNS)
    validate.add_argument(
        "--sidecar", metavar="S.toml", help="base, tool and joints (default: the one beside ROBOT)"
    )
    validate.add_argument("--fit-frames", action="store_true", help="fit base and tool first")
    validate.add_argument(
        "--map",
        metavar="MAP",
        help="predicted uncertainty over the workspace beside the errors measured, as .csv or .html",
    )
    validate.add_argument("--json", **_JSON)

    convert = _add(
        commands,
        "convert",
        "a robot file in another format, such as a DH table as a URDF",
        "dhcal convert arm.dh.toml arm.urdf",
    )
    convert.details = _robot_formats
    convert.add_argument("input", metavar="IN", help="robot file in one of the formats below")
    convert.add_argument("output", metavar="OUT", help="file to write; its ending selects the format")
    convert.add_argument("--tip", **_TIP)
    convert.add_argument(
        "--convention", choices=("standard", "modified"), help="of a DH file that is written"
    )

    view = _add(
        commands,
        "view",
        "nominal and calibrated arm in one offline web page, errors enlarged by a slider",
        "dhcal view ur10.urdf ur10_calibrated.urdf --tip tool0 --data laser.csv --html scene.html",
    )
    view.add_argument("nominal", metavar="NOMINAL.urdf", help="URDF or DH file")
    view.add_argument("calibrated", metavar="CALIBRATED.urdf", nargs="?", help="the same robot, calibrated")
    view.add_argument("--data", metavar="DATA", nargs="+", default=[], help="measurements to draw and play")
    view.add_argument("--html", metavar="FILE", help="where to write the page (default: open it)")
    view.add_argument("--open", action="store_true", help="open the page in the browser")
    view.add_argument(
        "--magnification", metavar="S", type=float, default=1.0, help="errors at first, 1 to 500 (1)"
    )
    view.add_argument(
        "--simplify",
        metavar="N",
        type=_count,
        nargs="?",
        default=60_000,
        const=15_000,
        help="most triangles that the meshes keep, for a smaller page (60000; 15000 without N)",
    )
    view.add_argument(
        "--live", action="store_true", help="serve a moving scene on this computer instead, until Ctrl-C"
    )
    view.add_argument("--tip", **_TIP)

    check = _add(
        commands,
        "check",
        "paper factors = vectorised Jacobian = Pinocchio = finite differences, with the figures",
        "dhcal check arm.dh.toml",
    )
    check.add_argument("robot", **_ROBOT)
    check.add_argument("--tip", **_TIP)
    check.add_argument("--json", **_JSON)

    plan = _add(
        commands,
        "plan",
        "which poses to measure, and what accuracy to expect of them",
        "dhcal plan ur10.urdf -n 40 --tip tool0 --sigma 0.1mm,0.01deg -o poses.csv",
    )
    plan.add_argument("robot", **_ROBOT)
    plan.add_argument("-n", "--count", type=_count, required=True, metavar="N", help="how many poses")
    plan.add_argument("-o", "--output", metavar="poses.csv", required=True, help="joint values, short tour")
    plan.add_argument("--tip", **_TIP)
    plan.add_argument("--kind", metavar="KIND", default="pose", help="what is measured (pose)")
    plan.add_argument(
        "--sigma",
        metavar="LENGTH[,ANGLE]",
        help="of instrument and repeatability, an axis (what --data show, else 0.1mm,0.01deg)",
    )
    plan.add_argument(
        "--criterion",
        metavar="C",
        default="D",
        help="D volume of the errors' uncertainty, A mean, E worst, task position error, robust this and "
        "what the model leaves out (D)",
    )
    plan.add_argument(
        "--task", metavar="FILE", help="where the tool must be right: joint values, or x[mm],y[mm],z[mm]"
    )
    plan.add_argument("--parameters", metavar="SET[,SET]", help="what is unknown, as in calibrate")
    plan.add_argument("--fix", metavar="NAME[,NAME]", default="", help="hold parameters or sets at nominal")
    plan.add_argument("--free", metavar="NAME[,NAME]", default="", help="add single parameters")
    plan.add_argument(
        "--priors",
        metavar="default|FILE",
        help="sigmas of the errors, as in calibrate (what a calibrated robot's sidecar knows, else default)",
    )
    plan.add_argument("--instrument", metavar="FILE", help="surveyed values, as in calibrate")
    plan.add_argument("--data", metavar="DATA", nargs="+", help="measurements already taken, to add to")
    plan.add_argument("--columns", **_COLUMNS)
    plan.add_argument(
        "--candidates", type=_count, default=5000, metavar="N", help="how many to choose from (5000)"
    )
    plan.add_argument(
        "--from", dest="candidates_from", metavar="FILE", help="choose among a file's joint values instead"
    )
    plan.add_argument("--box", metavar="X,Y,Z:X,Y,ZUNIT", help="where the tool may be, measuring frame")
    plan.add_argument("--visible-from", metavar="X,Y,ZUNIT", help="the instrument; nothing may hide the tool")
    plan.add_argument(
        "--cone", metavar="ANGLE", help="the instrument is within this of the tool's z axis, as 30deg"
    )
    plan.add_argument(
        "--margin", default="5mm,2deg", metavar="LENGTH,ANGLE", help="to the joints' limits (5mm,2deg)"
    )
    plan.add_argument("--seed", metavar="N", type=_seed, default=0, help="of the candidates (0)")
    plan.add_argument("--json", **_JSON)

    simulate = _add(
        commands,
        "simulate",
        "measurements of a robot that is known to be wrong",
        "dhcal simulate arm.dh.toml --truth actual.dh.toml -m 50 --noise 0.1mm,0.01deg -o data.csv",
    )
    simulate.add_argument("robot", metavar="ROBOT", help="the nominal robot")
    simulate.add_argument("-m", "--samples", type=_count, required=True, metavar="M", help="how many poses")
    simulate.add_argument(
        "--noise", default="0mm", metavar="LENGTH[,ANGLE]", help="sigma an axis, as 0.1mm,0.01deg"
    )
    simulate.add_argument("-o", "--output", metavar="data.csv", required=True, help="measurement CSV file")
    simulate.add_argument("--truth", metavar="T.urdf", help="the robot that is measured (default: ROBOT)")
    simulate.add_argument("--kind", metavar="KIND", default="pose", help="what is measured (pose)")
    simulate.add_argument("--tip", **_TIP)
    simulate.add_argument("--seed", metavar="N", type=_seed, default=0, help="of joint values and noise (0)")

    compensate = _add(
        commands,
        "compensate",
        "joint values, and corrected targets for a nominal controller, that land where asked",
        "dhcal compensate ur10.urdf ur10_calibrated.urdf targets.csv --tip tool0 -o corrected.csv",
    )
    compensate.add_argument("nominal", metavar="NOMINAL.urdf", help="what the controller knows")
    compensate.add_argument("calibrated", metavar="CALIBRATED.urdf", help="the same robot, calibrated")
    compensate.add_argument("targets", metavar="targets.csv", help="positions or poses of the tool")
    compensate.add_argument("-o", "--output", metavar="corrected.csv", required=True, help="a row a target")
    compensate.add_argument("--tip", **_TIP)
    study = _add(
        commands,
        "study",
        "how accuracy depends on poses, noise, errors, instrument and parameters, by simulation",
        "dhcal study ur10_poses --jobs 2 -o results.csv",
    )
    study.add_argument(
        "study", metavar="STUDY.toml", help="the grid, or one that ships: figure3, figure4, ur10_poses"
    )
    study.add_argument("-o", "--output", metavar="results.csv", required=True, help="a line a setting")
    where = study.add_mutually_exclusive_group()
    where.add_argument("--jobs", metavar="N", type=_count, default=1, help="processes on this machine (1)")
    where.add_argument("--scheduler", **_SCHEDULER)
    return out
