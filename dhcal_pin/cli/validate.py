"""`dhcal validate`: compute the accuracy of a robot model on measurements."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from ..exceptions import InvalidArgumentError
from .options import COLUMNS, DATA, JSON, ROBOT, TIP

if TYPE_CHECKING:
    from ..estimation.uncertainty import Predictor
    from ..io import MeasurementFile
    from ..robot import Chain

EXAMPLE = "dhcal validate ur10_calibrated.urdf other.csv --tip tool0 --fit-frames"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the arguments of `dhcal validate`.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument("robot", **ROBOT)
    parser.add_argument("data", **DATA)
    parser.add_argument("--tip", **TIP)
    parser.add_argument("--columns", **COLUMNS)
    parser.add_argument(
        "--sidecar",
        metavar="S.toml",
        help="file with base, tool and joint errors (default: NAME.calibration.toml beside ROBOT)",
    )
    parser.add_argument(
        "--fit-frames", action="store_true", help="fit base and tool to the measurements first"
    )
    parser.add_argument(
        "--map",
        metavar="MAP",
        help="write the predicted position uncertainty and the measured errors over the workspace (.csv or "
        ".html)",
    )
    parser.add_argument("--json", **JSON)


def run(args: Namespace) -> int:
    """Compute the accuracy of a model, write it and show it.

    Args:
        args: Parsed arguments.

    Returns:
        Exit status 0.
    """
    from ..calibration import accuracy, calibrate  # lazy import, as the following: they load Pinocchio
    from ..io import read_measurement_file, read_robot
    from ..io.sidecar import existing_sidecar, read_instrument
    from ..measurements.position import require_common_reference_target
    from ..report.document import file_digests, main_statistics, result_to_dict, validation_to_dict
    from ..report.workspace_map import map_content
    from . import console
    from .outputs import json_path, require_writable_outputs, write_outputs

    sidecar = args.sidecar or existing_sidecar(args.robot)
    inputs = [args.robot, *args.data, *filter(None, (sidecar, args.columns))]
    require_writable_outputs([args.json, args.map], inputs)
    chain = read_robot(args.robot, args.tip, sidecar)
    predictor = _predictor(chain, sidecar, args) if args.map else None
    files = [read_measurement_file(path, chain, args.columns) for path in args.data]
    data = [file.data for file in files]
    instrument = read_instrument(sidecar) if sidecar else {}
    used = {parameter.name for item in data for parameter in item.instrument_parameters}
    require_common_reference_target(dict(zip(args.data, data, strict=True)), instrument)
    known = {name: value for name, value in instrument.items() if name in used}
    nominal = accuracy(chain, data, known)
    accuracies = {"base and tool as given": nominal}
    if args.fit_frames:
        # The loss is linear: validation includes all samples, outliers too.
        fit = calibrate(chain, data, "base,tool", known=known, loss="linear")
        accuracies["base and tool fitted"] = fit.comparisons[-1].after
        document = result_to_dict(fit, {}, file_digests(inputs))
    else:
        document = validation_to_dict(chain, data, file_digests(inputs), known)
    document["before"] = main_statistics(nominal)
    warnings = {file.source: _input_warnings(chain, file, args.fit_frames) for file in files}
    document["warnings"] = [f"{path}: {text}" for path, texts in warnings.items() for text in texts]
    path = json_path(args.json)
    document["files"] = {"json": path} if path else {}
    contents = {}
    if predictor:
        document["files"]["map"] = args.map
        contents[args.map] = map_content(args.map, predictor, data, known)
    write_outputs(contents, args.json, document)
    for path, texts in warnings.items():
        console.print_warnings(path, texts)
    console.print_validation(f"{args.robot}: accuracy on {document['samples']} samples", accuracies)
    console.print_lines(*(f"wrote map: {path}" for path in contents))
    return 0


def _input_warnings(chain: Chain, file: MeasurementFile, has_unknown_frames: bool) -> list[str]:
    """List the warnings about a file, rows that the robot cannot reach included; no row is excluded."""
    from ..diagnostics.input_checks import find_input_warnings  # lazy import: loads Pinocchio
    from ..diagnostics.reachability import find_unreachable_rows

    unreachable = [] if has_unknown_frames else find_unreachable_rows(chain, file)
    return [
        *find_input_warnings(chain, file),
        *(f"row {item.row}: {item.reason}" for item in unreachable),
    ]


def _predictor(chain: Chain, sidecar: str | None, args: Namespace) -> Predictor:
    """Read the uncertainty that the calibration has written beside the robot."""
    from ..io.sidecar import read_uncertainty  # lazy import: loads Pinocchio
    from ..report.workspace_map import check_map_ending

    check_map_ending(args.map)
    if args.fit_frames:
        raise InvalidArgumentError(
            "--map: not available with --fit-frames; the uncertainty holds for base and tool as calibrated"
        )
    uncertainty = read_uncertainty(sidecar, chain) if sidecar else None
    if uncertainty is None:
        raise InvalidArgumentError(
            f"{sidecar or args.robot}: --map needs the table [uncertainty] of a calibration; `dhcal "
            "calibrate` writes it beside the corrected robot if there are more measurements than parameters"
        )
    return uncertainty
