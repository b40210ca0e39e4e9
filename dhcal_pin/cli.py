"""The `dhcal` command: argparse, and no heavy import before a command needs it."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, NoReturn

from .errors import DhcalError

if TYPE_CHECKING:
    from .chain import Chain
    from .measurements import Measurement


class _Parser(argparse.ArgumentParser):
    """A parser whose complaint is one line, as every other one is."""

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message}; see {self.prog} --help", file=sys.stderr)
        sys.exit(2)


class _Version(argparse.Action):
    """Looks the version up only when asked for it."""

    def __call__(self, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"dhcal {version('dhcal-pin')}")
        sys.exit(0)


def _add(commands, name: str, summary: str, example: str) -> argparse.ArgumentParser:
    return commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} must be at least 1")
    return value


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    out = _Parser(
        prog="dhcal",
        description="Robot kinematic calibration: a robot and measurements in, the corrected URDF out.",
        epilog="ROBOT is a URDF or a DH file (.toml, .csv). Every command has --help with an example.",
    )
    out.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = out.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)

    demo = _add(
        commands, "demo", "the paper's arm and its measured table, end to end", "dhcal demo --out demo"
    )
    demo.add_argument("--out", default="demo", metavar="DIR", help="folder for the results (default: demo)")
    demo.add_argument("--json", metavar="FILE", help="the result as JSON to one more place; - for stdout")
    demo.set_defaults(run=_demo)

    calibrate = _add(
        commands,
        "calibrate",
        "identify a robot's errors from measurements and write the corrected URDF",
        "dhcal calibrate ur10.urdf laser.csv --tip tool0 --holdout 0.3 -o ur10_calibrated.urdf",
    )
    calibrate.add_argument("robot", metavar="ROBOT")
    calibrate.add_argument("data", metavar="DATA", nargs="+", help="measurement CSV files")
    calibrate.add_argument("-o", "--output", metavar="OUT.urdf", required=True)
    calibrate.add_argument("--tip", metavar="F", help="tip link of a URDF (default: the deepest leaf)")
    calibrate.add_argument(
        "--parameters",
        metavar="SET[,SET]",
        help="what is unknown: dh, modified-dh, hayati, minimal, placement, base, tool, offset "
        "(default: minimal,base,tool for a URDF, dh for a DH file)",
    )
    calibrate.add_argument(
        "--fix", metavar="NAME[,NAME]", default="", help="hold parameters or sets at nominal"
    )
    calibrate.add_argument("--free", metavar="NAME[,NAME]", default="", help="add single parameters")
    calibrate.add_argument("--holdout", metavar="FRACTION|FILE", help="measurements to judge by, not fitted")
    calibrate.add_argument("--method", choices=("lm", "gn"), default="lm", help="gn is the paper's loop")
    calibrate.add_argument("--priors", metavar="default|none|FILE", help="default for lm, none for gn")
    calibrate.add_argument("--max-iterations", metavar="N", type=_count, default=100)
    calibrate.add_argument("--seed", metavar="N", type=int, default=0, help="for the choice of the hold-out")
    calibrate.add_argument("--in-place", action="store_true", help="allow -o to be ROBOT itself")
    calibrate.add_argument("--json", metavar="FILE", help="- for stdout")
    calibrate.set_defaults(run=_calibrate)

    validate = _add(
        commands,
        "validate",
        "the accuracy of a model on measurements; nothing is fitted but, on request, base and tool",
        "dhcal validate ur10_calibrated.urdf other.csv --tip tool0 --fit-frames",
    )
    validate.add_argument("robot", metavar="ROBOT")
    validate.add_argument("data", metavar="DATA", nargs="+")
    validate.add_argument("--tip", metavar="F")
    validate.add_argument("--sidecar", metavar="S.toml", help="base and tool (default: the one beside ROBOT)")
    validate.add_argument("--fit-frames", action="store_true", help="fit base and tool first")
    validate.add_argument("--json", metavar="FILE", help="- for stdout")
    validate.set_defaults(run=_validate)

    convert = _add(
        commands,
        "convert",
        "a DH file to a URDF, or a URDF to a DH file",
        "dhcal convert arm.dh.toml arm.urdf",
    )
    convert.add_argument("input", metavar="IN")
    convert.add_argument("output", metavar="OUT")
    convert.add_argument("--tip", metavar="F")
    convert.add_argument("--convention", choices=("standard", "modified"), default="standard")
    convert.set_defaults(run=_convert)

    check = _add(
        commands,
        "check",
        "paper factors = vectorised Jacobian = Pinocchio = finite differences, with the figures",
        "dhcal check arm.dh.toml",
    )
    check.add_argument("robot", metavar="ROBOT")
    check.add_argument("--tip", metavar="F")
    check.add_argument("--json", metavar="FILE", help="- for stdout")
    check.set_defaults(run=_check)

    simulate = _add(
        commands,
        "simulate",
        "measurements of a robot that is known to be wrong",
        "dhcal simulate arm.dh.toml --truth actual.dh.toml -m 50 --noise 0.1mm,0.01deg -o data.csv",
    )
    simulate.add_argument("robot", metavar="ROBOT", help="the nominal robot")
    simulate.add_argument("-m", "--samples", type=_count, required=True, metavar="M")
    simulate.add_argument(
        "--noise", default="0mm", metavar="LENGTH[,ANGLE]", help="sigma an axis, as 0.1mm,0.01deg"
    )
    simulate.add_argument("-o", "--output", metavar="data.csv", required=True)
    simulate.add_argument("--truth", metavar="T.urdf", help="the robot that is measured (default: ROBOT)")
    simulate.add_argument("--kind", choices=("pose", "position"), default="pose")
    simulate.add_argument("--tip", metavar="F")
    simulate.add_argument("--seed", metavar="N", type=int, default=0)
    simulate.set_defaults(run=_simulate)
    return out


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _distinct(output: str, inputs: Sequence[str]) -> None:
    for path in inputs:
        if os.path.exists(output) and os.path.exists(path) and os.path.samefile(output, path):
            raise DhcalError(f"{output}: is an input; name another output")


def _emit(target: str | None, content: object) -> None:
    """JSON to a file, or alone on stdout for `-`."""
    from .files import save
    from .report import json_text

    if target == "-":
        sys.stdout.write(json_text(content))
    elif target:
        save({target: json_text(content)})


def _calibrate(args: argparse.Namespace) -> int:
    from . import report, terminal
    from .calibration import calibrate, split
    from .files import save
    from .measurement_files import read_readings
    from .robot_files import read_priors, read_robot, urdf_files
    from .screening import screen

    _distinct(args.output, args.data + ([] if args.in_place else [args.robot]))
    chain = read_robot(args.robot, args.tip)
    sets = args.parameters or chain.parameters
    fit_data: list[Measurement] = []
    holdout: list[Measurement] = []
    outliers: list[int] = []
    inputs = [args.robot, *args.data]
    for path in args.data:
        readings = read_readings(path, chain)
        # A row can only be called impossible where base and tool are known.
        bad = [] if {"base", "tool"} & set(_names(sets)) else screen(chain, readings)
        terminal.findings(path, bad)
        outliers += [finding.row for finding in bad]
        fit_data.append(readings.fit.take(~_member(readings.fit, outliers)))
        if len(readings.holdout.q):
            holdout.append(readings.holdout.take(~_member(readings.holdout, outliers)))
    if args.holdout is not None:
        if os.path.exists(args.holdout):
            holdout.append(read_readings(args.holdout, chain).data)
            inputs.append(args.holdout)
        else:
            try:
                fraction = float(args.holdout)
            except ValueError:
                raise DhcalError(
                    f"--holdout {args.holdout}: neither a file nor a share such as 0.3"
                ) from None
            kept, held = split(fit_data, fraction, args.seed)
            fit_data, holdout = list(kept), holdout + list(held)
    with terminal.progress("fitting") as progress:
        fit = calibrate(
            chain,
            fit_data,
            sets,
            method=args.method,
            priors=read_priors(args.priors),
            fix=_names(args.fix),
            free=_names(args.free),
            holdout=holdout,
            max_iterations=args.max_iterations,
            progress=progress,
        )
    contents = urdf_files(fit.chain, args.output)
    names = ["urdf", "sidecar"]
    files = dict(zip(names, map(str, contents), strict=False))
    if args.json and args.json != "-":
        files["json"] = args.json
    document = report.document(fit, files, report.fingerprints(inputs), outliers)
    if args.json and args.json != "-":
        contents[args.json] = report.json_text(document)
    save(contents)
    if args.json == "-":
        _emit("-", document)
    terminal.summary(fit, files)
    return 0


def _member(data: Measurement, rows: Sequence[int]):
    import numpy as np

    return np.isin(data.rows, rows)


def _validate(args: argparse.Namespace) -> int:
    from . import report, terminal
    from .calibration import calibrate
    from .measurement_files import read_measurements
    from .result import accuracy
    from .robot_files import read_robot

    chain = read_robot(args.robot, args.tip, args.sidecar)
    data = [read_measurements(path, chain) for path in args.data]
    inputs = [args.robot, *args.data, *([args.sidecar] if args.sidecar else [])]
    if args.fit_frames:
        fit = calibrate(chain, data, "base,tool")
        document = report.document(fit, {}, report.fingerprints(inputs))
    else:
        document = report.plain_document(chain, data, report.fingerprints(inputs))
    document["before"] = accuracy(chain, data)
    terminal.validation(document, args.fit_frames)
    _emit(args.json, document)
    return 0


def _convert(args: argparse.Namespace) -> int:
    from . import terminal
    from .chain import Chain
    from .dh_files import dh_text, is_dh, read_dh
    from .files import save
    from .parameters import extract

    _distinct(args.output, [args.input])
    if is_dh(args.input):
        table = read_dh(args.input)
        if is_dh(args.output):
            save({args.output: dh_text(table, args.output)})
        else:
            from .dh_urdf import dh_to_urdf

            _ending(args.output)
            save({args.output: dh_to_urdf(table, os.path.basename(args.input).split(".")[0])})
    else:
        if not is_dh(args.output):
            raise DhcalError(f"{args.output}: a URDF converts to .dh.toml or .dh.csv")
        found = extract(Chain.from_urdf(args.input, args.tip), args.convention)
        save({args.output: dh_text(found.table, args.output)})
        terminal.notes(found.notes)
    return 0


def _ending(path: str) -> None:
    if not path.lower().endswith(".urdf"):
        raise DhcalError(f"{path}: write .urdf, .dh.toml or .dh.csv")


def _check(args: argparse.Namespace) -> int:
    from dataclasses import asdict

    from . import terminal
    from .check import crosscheck
    from .robot_files import read_robot

    rows = crosscheck(read_robot(args.robot, args.tip))
    terminal.agreement(args.robot, rows)
    agree = all(row.holds for row in rows)
    _emit(args.json, {"agree": agree, "routes": [asdict(row) | {"holds": row.holds} for row in rows]})
    return 0 if agree else 1


def _simulate(args: argparse.Namespace) -> int:
    import numpy as np

    from .files import parse_noise, save
    from .measurement_files import measurement_text
    from .measurements import KINDS, Noise
    from .robot_files import read_robot

    _distinct(args.output, [args.robot, *([args.truth] if args.truth else [])])
    chain = read_robot(args.robot, args.tip)
    truth = (
        read_robot(args.truth, None if args.truth.endswith((".toml", ".csv")) else args.tip)
        if args.truth
        else chain
    )
    if truth.joint_names != chain.joint_names:
        raise DhcalError(
            f"{args.truth}: its joints are {', '.join(truth.joint_names)}; "
            f"{args.robot} has {', '.join(chain.joint_names)}"
        )
    noise = Noise(*parse_noise(args.noise))
    rng = np.random.default_rng(args.seed)
    q = _configurations(chain, args.samples, rng)
    data = KINDS[args.kind].simulate(truth, q, noise, rng)
    comments = [f"simulated {args.kind} of {args.truth or args.robot}, noise {args.noise}, seed {args.seed}"]
    save({args.output: measurement_text(data, chain, comments)})
    return 0


def _configurations(chain: Chain, count: int, rng):
    """Uniform joint values within the limits, and within a turn."""
    import numpy as np

    return rng.uniform(np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi), (count, chain.size))


def _demo(args: argparse.Namespace) -> int:
    from .demo import run

    _emit(args.json, run(args.out))
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; 0 done, 1 a check that failed, 2 wrong input, 130 interrupted."""
    args = parser().parse_args(argv)
    try:
        return args.run(args)
    except DhcalError as error:
        print(f"dhcal: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("dhcal: interrupted; nothing written", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
