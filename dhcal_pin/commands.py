"""What the small commands of `dhcal` do, once the command line is read.

Wrong input is found before anything is written or shown; JSON goes to stdout, all else to stderr.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from . import (
    calibration,
    exports,
    report,
    terminal,
    ur_kinematics,
)
from .chain import Chain
from .check import crosscheck
from .configurations import joint_range
from .demo import run as run_demo
from .dh_files import dh_text, is_dh
from .dh_urdf import dh_to_urdf
from .errors import DhcalError
from .evaluation import accuracy
from .files import parse_noise
from .kinds import KINDS
from .measurement_files import Readings, measurement_text, read_readings
from .measurements import Noise
from .outputs import STDOUT, check_outputs, check_urdf_ending, emit, sidecars
from .parameters import extract
from .plausibility import doubts
from .positions import check_targets
from .robot_files import (
    existing_sidecar,
    is_table,
    read_instrument,
    read_robot,
    read_table,
    robot_name,
)
from .saving import save
from .screening import screen
from .uncertainty import Predictor
from .uncertainty_files import read_uncertainty
from .workspace_files import check_map_ending, map_content


def validate(args: Namespace) -> int:
    """The accuracy of a model on measurements."""
    sidecar = args.sidecar or existing_sidecar(args.robot)
    inputs = [args.robot, *args.data, *filter(None, (sidecar, args.columns))]
    check_outputs([args.json, args.map], inputs)
    chain = read_robot(args.robot, args.tip, sidecar)
    model = _trusted(chain, sidecar, args) if args.map else None
    readings = [read_readings(path, chain, args.columns) for path in args.data]
    data = [item.data for item in readings]
    surveyed = read_instrument(sidecar) if sidecar else {}
    there = {unknown.name for item in data for unknown in item.unknowns}
    check_targets(dict(zip(args.data, data, strict=True)), surveyed)
    known = {name: value for name, value in surveyed.items() if name in there}
    given = accuracy(chain, data, known)
    found: dict[str, Mapping[str, Any]] = {"base and tool as given": given}
    if args.fit_frames:
        # Whatever is judged counts.
        fit = calibration.calibrate(chain, data, "base,tool", known=known, loss="linear")
        found["fitted"] = fit.comparisons[-1].after
        document = report.document(fit, {}, report.fingerprints(inputs))
    else:
        document = report.plain_document(chain, data, report.fingerprints(inputs), known)
    document["before"] = report.essentials(given)
    doubtful = {item.source: _doubts(chain, item, args.fit_frames) for item in readings}
    document["doubts"] = {path: texts for path, texts in doubtful.items() if texts}
    document["files"] = {"json": args.json} if args.json and args.json != STDOUT else {}
    if model:
        document["files"]["map"] = args.map
        save({args.map: map_content(args.map, model, data, known)})
    emit(args.json, document)
    for path, texts in doubtful.items():
        terminal.doubts(path, texts)
    terminal.validation(f"{args.robot}: accuracy on {document['samples']} samples", found)
    if model:
        terminal.lines(f"wrote map: {args.map}")
    return 0


def _doubts(chain: Chain, readings: Readings, frames_unknown: bool) -> list[str]:
    """What is hard to believe in a file, impossible rows too; a model that is judged has to bear them all."""
    found = [] if frames_unknown else screen(chain, readings)
    return [*doubts(chain, readings), *(f"row {finding.row}: {finding.reason}" for finding in found)]


def _trusted(chain: Chain, sidecar: str | None, args: Namespace) -> Predictor:
    """How well the arm is known, as its calibration has left it beside the robot."""
    check_map_ending(args.map)
    if args.fit_frames:
        raise DhcalError("--map is of base and tool as calibrated; leave out --fit-frames")
    known = read_uncertainty(sidecar, chain) if sidecar else None
    if known is None:
        raise DhcalError(
            f"{sidecar or args.robot}: holds no [uncertainty] of a calibration to draw --map from; "
            "`dhcal calibrate` writes one beside the new robot where samples are left over to tell it"
        )
    return known


def convert(args: Namespace) -> int:
    """A table to a URDF, or a robot to a table, a list of origins, or UR's YAML."""
    check_outputs([args.output], [args.input])
    low = args.output.lower()
    if low.endswith(".origins.csv"):
        text, notes = exports.origins_text(read_robot(args.input, args.tip)), ()
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
    save({args.output: text})
    terminal.lines(f"wrote {args.output}")
    terminal.notes(notes)
    return 0


def _to_dh(args: Namespace) -> tuple[str, Sequence[str]]:
    chain = read_robot(args.input, args.tip)
    if is_table(args.input):
        table = read_table(args.input)
        if args.convention in (None, table.convention):
            return dh_text(table, args.output), ()
    found = extract(chain, args.convention or "standard")
    left = [f"base, tool and joints in {path} do not go to the table" for path in sidecars([args.input])]
    return dh_text(found.table, args.output), [*found.notes, *left]


def _to_urdf(args: Namespace) -> tuple[str, Sequence[str]]:
    check_urdf_ending(args.output, "or a DH table as .dh.toml or .dh.csv")
    if args.tip is not None or args.convention is not None:
        raise DhcalError(f"{args.input}: a table has one tip and one URDF; leave out --tip and --convention")
    beside = [f"{path} lies beside it and is read with it" for path in sidecars([args.output])]
    return dh_to_urdf(read_table(args.input), robot_name(args.input)), beside


def check(args: Namespace) -> int:
    """All routes to the Jacobian side by side; 1 where they disagree."""
    check_outputs([args.json], [args.robot])
    rows = crosscheck(read_robot(args.robot, args.tip))
    agree = all(row.holds for row in rows)
    emit(args.json, {"agree": agree, "routes": [asdict(row) | {"holds": row.holds} for row in rows]})
    terminal.agreement(args.robot, rows)
    return 0 if agree else 1


def simulate(args: Namespace) -> int:
    """Measurements of a robot that is known to be wrong."""
    robots = [args.robot, *([args.truth] if args.truth else [])]
    check_outputs([args.output], [*robots, *sidecars(robots)])
    noise = Noise(*parse_noise(args.noise))
    if args.kind not in KINDS:
        raise DhcalError(f"--kind {args.kind}: choose from {', '.join(KINDS)}")
    chain = truth = read_robot(args.robot, args.tip)
    if args.truth:
        truth = read_robot(args.truth, None if is_table(args.truth) else args.tip)
        if truth.joint_names != chain.joint_names:
            raise DhcalError(
                f"{args.truth}: its joints are {', '.join(truth.joint_names)}; "
                f"they must be those of {args.robot}: {', '.join(chain.joint_names)}"
            )
    rng = np.random.default_rng(args.seed)
    q = rng.uniform(*joint_range(chain), (args.samples, chain.size))
    data = KINDS[args.kind].simulate(truth, q, noise, rng)
    comments = [f"simulated {args.kind} of {args.truth or args.robot}, noise {args.noise}, seed {args.seed}"]
    save({args.output: measurement_text(data, chain, comments)})
    terminal.lines(f"wrote {args.output}")
    return 0


def demo(args: Namespace) -> int:
    """The paper's arm, end to end."""
    check_outputs([args.json], [])
    document = run_demo(args.out)
    emit(args.json, document)
    if args.open:
        terminal.open_page(document["files"]["report"])
    return 0
