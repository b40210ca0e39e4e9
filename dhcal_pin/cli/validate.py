"""What the small commands of `dhcal` do, once the command line is read.

Wrong input is found before anything is written or shown; JSON goes to stdout, all else to stderr.
"""

from __future__ import annotations

from argparse import Namespace

from ..calibration import procedure
from ..calibration.evaluation import Accuracy, accuracy
from ..diagnostics.input_checks import find_input_warnings
from ..diagnostics.reachability import find_unreachable_rows
from ..estimation.uncertainty import Predictor
from ..exceptions import DhcalError
from ..io.atomic import write_files
from ..io.measurement_csv import MeasurementFile, read_measurement_file
from ..io.robot import read_robot
from ..io.sidecar import existing_sidecar, read_instrument, read_uncertainty
from ..measurements.position import require_common_reference_target
from ..report.document import (
    file_digests,
    main_statistics,
    result_to_dict,
    validation_to_dict,
)
from ..report.workspace_map import check_map_ending, map_content
from ..robot.chain import Chain
from . import console
from .options import STDOUT, require_writable_outputs, write_json


def validate(args: Namespace) -> int:
    """The accuracy of a model on measurements."""
    sidecar = args.sidecar or existing_sidecar(args.robot)
    inputs = [args.robot, *args.data, *filter(None, (sidecar, args.columns))]
    require_writable_outputs([args.json, args.map], inputs)
    chain = read_robot(args.robot, args.tip, sidecar)
    model = _trusted(chain, sidecar, args) if args.map else None
    readings = [read_measurement_file(path, chain, args.columns) for path in args.data]
    data = [item.data for item in readings]
    surveyed = read_instrument(sidecar) if sidecar else {}
    there = {unknown.name for item in data for unknown in item.instrument_parameters}
    require_common_reference_target(dict(zip(args.data, data, strict=True)), surveyed)
    known = {name: value for name, value in surveyed.items() if name in there}
    given = accuracy(chain, data, known)
    found: dict[str, Accuracy] = {"base and tool as given": given}
    if args.fit_frames:
        # Whatever is judged counts.
        fit = procedure.calibrate(chain, data, "base,tool", known=known, loss="linear")
        found["fitted"] = fit.comparisons[-1].after
        document = result_to_dict(fit, {}, file_digests(inputs))
    else:
        document = validation_to_dict(chain, data, file_digests(inputs), known)
    document["before"] = main_statistics(given)
    doubtful = {item.source: _input_warnings(chain, item, args.fit_frames) for item in readings}
    document["warnings"] = [f"{path}: {text}" for path, texts in doubtful.items() for text in texts]
    document["files"] = {"json": args.json} if args.json and args.json != STDOUT else {}
    if model:
        document["files"]["map"] = args.map
        write_files({args.map: map_content(args.map, model, data, known)})
    write_json(args.json, document)
    for path, texts in doubtful.items():
        console.print_warnings(path, texts)
    console.print_validation(f"{args.robot}: accuracy on {document['samples']} samples", found)
    if model:
        console.print_lines(f"wrote map: {args.map}")
    return 0


def _input_warnings(chain: Chain, readings: MeasurementFile, frames_unknown: bool) -> list[str]:
    """What is hard to believe in a file, impossible rows too; a model that is judged has to bear them all."""
    found = [] if frames_unknown else find_unreachable_rows(chain, readings)
    return [
        *find_input_warnings(chain, readings),
        *(f"row {finding.row}: {finding.reason}" for finding in found),
    ]


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
