"""`dhcal validate`: compute the accuracy of a robot model on measurements."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from ...exceptions import InvalidArgumentError
from ..options import COLUMNS, DATA, FIT_FRAMES, JSON, RIG, ROBOT, SKIP_BAD_ROWS, add_urdf_options

if TYPE_CHECKING:
    from ...calibration import Accuracy
    from ...estimation.uncertainty import Predictor
    from ...io import MeasurementFile
    from ...measurements import Measurement, MountedRig
    from ...robot import Chain

EXAMPLE = "dhcal validate ur10_calibrated.urdf other.csv --tip tool0 --nominal ur10.urdf --fit-frames"

# Base and tool of two robots are the same if no entry of their poses differs by more than this.
FRAMES_TOL = 1e-9


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the arguments of `dhcal validate`."""
    parser.add_argument("robot", **ROBOT)
    parser.add_argument("data", **DATA)
    add_urdf_options(parser)
    parser.add_argument("--columns", **COLUMNS)
    parser.add_argument(
        "--rig",
        **{**RIG, "help": f"{RIG['help']} (default: those of the sidecar, as a calibration estimated them)"},
    )
    parser.add_argument("--skip-bad-rows", action="store_true", **SKIP_BAD_ROWS)
    parser.add_argument(
        "--sidecar",
        metavar="S.toml",
        help="file with base, tool and joint errors (default: NAME.calibration.toml beside ROBOT)",
    )
    parser.add_argument(
        "--nominal",
        metavar="ROBOT",
        type=ROBOT["type"],
        help="robot before the calibration, shown beside ROBOT; its base and tool are fitted to the "
        "measurements if ROBOT has others",
    )
    parser.add_argument("--fit-frames", action="store_true", **FIT_FRAMES)
    parser.add_argument(
        "--map",
        metavar="MAP",
        help="write the predicted position uncertainty and the measured errors over the workspace (.csv or "
        ".html)",
    )
    parser.add_argument("--report", metavar="R.html", help="write a report (.html)")
    parser.add_argument("--json", **JSON)


def run(args: Namespace) -> int:
    """Compute the accuracy of a model, write it and show it."""
    from ...calibration import accuracy  # lazy import, as the following: they load Pinocchio
    from ...diagnostics import FRAMES_WARNING, find_extrapolation, fit_frames, frames_differ
    from ...io import (
        existing_sidecar,
        read_instrument,
        read_measured_region,
        read_measurement_file,
        read_robot,
    )
    from ...measurements.position import require_common_reference_target
    from ...report.html import check_html_ending
    from ...report.json_document import main_statistics, result_to_dict, validation_to_dict
    from ...report.provenance import file_digests
    from ...report.workspace_map import map_content
    from ..outputs import existing_sidecars, json_path, require_writable_outputs, write_outputs
    from ..screens import console
    from ..screens.result_screens import validation_screen

    sidecar = args.sidecar or existing_sidecar(args.robot)
    robots = [args.robot, args.nominal] if args.nominal else [args.robot]
    given = filter(None, (sidecar, args.columns, args.rig))
    inputs = [*robots, *args.data, *given, *existing_sidecars(robots[1:])]
    require_writable_outputs([args.json, args.map, args.report], inputs)
    if args.report:
        check_html_ending(args.report, "the report of a validation")
    chain = read_robot(args.robot, args.tip, sidecar, args.package_dir, args.root)
    rig, estimated = _mounted_rig(args, sidecar, chain)
    predictor = _predictor(chain, sidecar, args) if args.map else None
    files = [
        read_measurement_file(path, chain, args.columns, skip_bad_rows=args.skip_bad_rows, rig=rig)
        for path in args.data
    ]
    data = [file.data for file in files]
    instrument = read_instrument(sidecar) if sidecar else {}
    used = {parameter.name for item in data for parameter in item.instrument_parameters}
    require_common_reference_target(dict(zip(args.data, data, strict=True)), instrument)
    known = {name: value for name, value in instrument.items() if name in used}
    given = accuracy(chain, data, known)
    unstated = _unstated_entries(rig) if rig else []
    accuracies = {"fitted to these images" if unstated else "base and tool as given": given}
    if args.fit_frames:
        fit = fit_frames(chain, data, known)
        chain, known = fit.chain, known | fit.instruments
        accuracies["base and tool fitted"] = fit.comparisons[-1].after
        document = result_to_dict(fit, {}, file_digests(inputs), is_calibration=False)
    else:
        document = validation_to_dict(chain, data, file_digests(inputs), known)
    document["before"] = main_statistics(given)
    document["estimated_entries"] = estimated
    remarks: list[str] = []
    reference = None
    if args.nominal:
        nominal, reference, remarks = _nominal_accuracy(chain, data, known, args)
        document["before"] = main_statistics(nominal)
        accuracies = {"nominal": nominal, "calibrated": list(accuracies.values())[-1]}
    warnings = {file.source: _input_warnings(chain, file, args.fit_frames) for file in files}
    if not args.fit_frames and frames_differ(chain, data, known):
        warnings[args.robot] = [FRAMES_WARNING]
    notes = [f"{file.source}: {text}" for file in files for text in file.notes]
    document["warnings"] = notes + [f"{path}: {text}" for path, texts in warnings.items() for text in texts]
    region = read_measured_region(sidecar, chain) if sidecar else None
    extrapolation = find_extrapolation(region, chain, data, known) if region else None
    document["measured_region"] = extrapolation and extrapolation.to_dict()
    path = json_path(args.json)
    document["files"] = {"json": path} if path else {}
    contents = {}
    if predictor:
        document["files"]["map"] = args.map
        contents[args.map] = map_content(args.map, predictor, data, known)
    remarks += extrapolation.sentences if extrapolation else ()
    if unstated:
        remarks.append(
            f"Poses or lenses of {', '.join(unstated)} are not stated and were fitted to these images; other "
            "images have larger errors."
        )
    if estimated:
        others = f", not those of {args.rig}" if args.rig else ""
        remarks.append(
            f"Poses, lenses and corners of {', '.join(estimated)} are the estimates of the calibration "
            f"({sidecar}){others}."
        )
    if args.report:
        from ...io.robot import robot_name  # lazy import, as the following: only for reports
        from ...report.validation import Validation, validation_page

        document["files"]["report"] = args.report
        contents[args.report] = validation_page(
            Validation(
                robot_name(args.robot),
                chain,
                data,
                known,
                args.data,
                accuracies,
                reference,
                remarks,
                document["warnings"][len(notes) :],
                notes,
                file_digests(inputs),
            )
        )
    write_outputs(contents, args.json, document)
    screen = validation_screen(
        f"{args.robot}: accuracy on {document['samples']} samples",
        accuracies,
        remarks,
        notes,
        warnings,
        {kind: file for kind, file in document["files"].items() if kind != "json"},
    )
    console.show(screen, args.verbosity)
    return 0


def _mounted_rig(args: Namespace, sidecar: str | None, chain: Chain) -> tuple[MountedRig | None, list[str]]:
    """Return the cameras and boards of the images, with the estimates of a calibration.

    Without a rig file, they are those of the sidecar. Other measurements than images need none.
    """
    from ...io.measurement_files.reading import has_image_coordinates  # lazy import, as the following
    from ...io.rig_file import read_calibrated_rig, read_rig, with_estimates_of
    from ...measurements.mounting import mount_rig

    calibrated = read_calibrated_rig(sidecar) if sidecar else None
    if args.rig:
        rig = read_rig(args.rig)
    else:
        is_usable = calibrated is not None and calibrated.is_complete
        has_images = is_usable and any(has_image_coordinates(path, chain, args.columns) for path in args.data)
        rig = calibrated if has_images else None
    if rig is None or calibrated is None:
        return rig and mount_rig(rig, chain), []
    names = [
        *(f"camera.{name}" for name in rig.cameras if name in calibrated.cameras),
        *(f"board.{name}" for name in rig.boards if name in calibrated.boards),
    ]
    ends = {"world": chain.root, "tip": chain.tip}
    return mount_rig(with_estimates_of(rig, calibrated, ends), chain), names


def _unstated_entries(rig: MountedRig) -> list[str]:
    """Return the cameras without a pose or a lens and the boards without a pose, such as `camera.wrist`."""
    return [
        *(f"camera.{each.name}" for each in rig.cameras if each.pose is None or not each.has_intrinsics),
        *(f"board.{each.name}" for each in rig.boards if each.pose is None),
    ]


def _nominal_accuracy(
    chain: Chain, data: Sequence[Measurement], known: Mapping[str, float], args: Namespace
) -> tuple[Accuracy, tuple[Chain, Mapping[str, float]], list[str]]:
    """Compute the accuracy of the nominal robot; fit its base and tool if the calibrated robot has others."""
    import numpy as np  # lazy import, as the following

    from ...calibration import accuracy
    from ...diagnostics import fit_frames
    from ...io import read_robot

    nominal = read_robot(args.nominal, args.tip, None, args.package_dir, args.root)
    if nominal.joint_names != chain.joint_names:
        raise InvalidArgumentError(
            f"{args.nominal}: joints {', '.join(nominal.joint_names)}; expected the joints of {args.robot}: "
            f"{', '.join(chain.joint_names)}"
        )
    pairs = {"base": (nominal.base, chain.base), "tool": (nominal.tool, chain.tool)}
    others = [name for name, (a, b) in pairs.items() if not np.allclose(a, b, rtol=0, atol=FRAMES_TOL)]
    if not others:
        return accuracy(nominal, data, known), (nominal, known), []
    fit = fit_frames(nominal, data, known, ",".join(others))
    note = f"nominal: {' and '.join(others)} fitted to these measurements"
    return fit.comparisons[-1].after, (fit.chain, {**known, **fit.instruments}), [note]


def _input_warnings(chain: Chain, file: MeasurementFile, has_unknown_frames: bool) -> list[str]:
    """List the warnings about a file, rows that the robot cannot reach included; no row is excluded."""
    from ...diagnostics.input_checks import find_input_warnings  # lazy import: loads Pinocchio
    from ...diagnostics.reachability import find_unreachable_rows

    unreachable = [] if has_unknown_frames else find_unreachable_rows(chain, file)
    return [
        *find_input_warnings(chain, file),
        *(f"line {item.row}: {item.reason}" for item in unreachable),
    ]


def _predictor(chain: Chain, sidecar: str | None, args: Namespace) -> Predictor:
    """Read the uncertainty that the calibration has written beside the robot."""
    from ...io.sidecar import read_uncertainty  # lazy import: loads Pinocchio
    from ...report.workspace_map import check_map_ending

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
