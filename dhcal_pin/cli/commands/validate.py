"""`dhcal validate`: compute the accuracy of a robot model on measurements."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from ... import calibration, diagnostics, estimation, io, iso9283, report, robot, session
from ...exceptions import InvalidArgumentError
from ...formatting import format_quantity, list_first, texts_by_file
from .. import options, screens
from ..output_table import Makers, Output
from ..servo_zeros import NEW_OFFSETS, other_zeros, other_zeros_warning

if TYPE_CHECKING:
    from ...measurements import MeasuredRegion, Measurement, MountedRig

EXAMPLE = "dhcal validate ur10_calibrated.urdf other.csv --tip tool0 --nominal ur10.urdf --fit-frames"

# Base and tool of two robots are the same if no entry of their poses differs by more than this.
FRAMES_TOL = 1e-9

ARGUMENTS: options.Options = {
    "robot": options.ROBOT,
    "data": options.DATA,
    **options.URDF_OPTIONS,
    **options.TABLE_OPTIONS,
    "--rig": {
        **options.RIG,
        "help": f"{options.RIG['help']} (default: those of the sidecar, as a calibration estimated them)",
    },
    "--skip-bad-rows": options.SKIP_BAD_ROWS,
    "--sidecar S.toml": "file with base, tool and joint errors (default: NAME.calibration.toml beside ROBOT)",
    "--nominal ROBOT": {
        "type": options.ROBOT["type"],
        "help": "robot before the calibration, shown beside ROBOT; its base and tool are fitted to the "
        "measurements if ROBOT has others",
    },
    "--fit-frames": options.FIT_FRAMES,
    "--map MAP": "write the predicted position uncertainty and the measured errors over the workspace (.csv "
    "or .html)",
    "--iso9283": "compute accuracy, repeatability and drift of poses as ISO 9283 defines them; the column "
    "iso_point names the point of each row and its cycle, such as P1:12, as `dhcal plan --iso9283` writes "
    "it (default: visits of one configuration are one point)",
    "--report R.html": "write a report (.html)",
    "--json": options.JSON,
}


class Given(NamedTuple):
    """Robot and measurements of a validation, as the files state them."""

    chain: robot.Chain
    files: list[io.MeasurementFile]
    known: dict[str, float]  # Values of instrument parameters that the calibration estimated [m or rad]
    rig: MountedRig | None
    estimated: list[str]  # Cameras and boards of the rig that the calibration estimated
    region: MeasuredRegion | None  # Measured region of the calibration
    predictor: estimation.Predictor | None  # Uncertainty of the robot, for maps
    calibrated_tip: str  # Link that the tool of the sidecar is on
    servos: io.ServoFile | None

    @property
    def data(self) -> list[Measurement]:
        """Samples of each file."""
        return [file.data for file in self.files]


class Judged(NamedTuple):
    """Robot with the base and tool that it is judged with, and the accuracies that are compared."""

    chain: robot.Chain
    known: Mapping[str, float]  # Values of instrument parameters [m or rad]
    fit: calibration.Result | None  # Fit of base and tool, on request
    before: calibration.Accuracy
    # Accuracy by the name of the model; the last one is that of `chain`.
    accuracies: dict[str, calibration.Accuracy]
    # Accuracy of the URDF alone, with base and tool fitted if the sidecar has joint errors.
    alone: calibration.Accuracy
    # Nominal robot and its instrument parameters.
    reference: tuple[robot.Chain, Mapping[str, float]] | None = None
    remarks: Sequence[str] = ()


OUTPUTS = {
    "json": Output(),
    "map": Output("a map", (".csv", ".html")),
    "report": Output("the report of a validation", (".html",), (".htm",)),
}


def run(args: Namespace) -> int:
    """Compute the accuracy of a model, write it and show it."""
    from ..output_table import file_contents, paths_by_name  # lazy import, as the following
    from ..outputs import checked_files, existing_sidecars, require_workbook, write_outputs

    sidecar = args.sidecar or io.existing_sidecar(args.robot)
    nominal = [args.nominal] if args.nominal else []
    others = filter(None, (sidecar, args.columns, args.rig, args.servos))
    inputs = [args.robot, *nominal, *args.data, *others, *existing_sidecars(nominal)]
    outputs = checked_files(args, OUTPUTS, inputs)
    require_workbook(args.sheet, inputs)
    given = _read_input(args, sidecar)
    judged = _judge(args, given)
    data, accuracies = given.data, judged.accuracies
    characteristics = None
    if args.iso9283:
        points = [file.iso_points for file in given.files]
        characteristics = iso9283.pose_characteristics(judged.chain, data, points, judged.known)
    warnings = _input_warnings(args, given, judged, sidecar)
    payloads = given.region.payloads if given.region else None
    notes = diagnostics.file_notes(given.chain, given.files, payloads)
    extrapolation = given.region and diagnostics.find_extrapolation(
        given.region, judged.chain, data, judged.known
    )
    done = report.Validation(
        io.robot_name(args.robot),
        judged.chain,
        data,
        judged.known,
        args.data,
        accuracies,
        judged.reference,
        [
            *judged.remarks,
            *_outlier_remarks(judged, data),
            *(extrapolation.sentences if extrapolation else ()),
            *_rig_remarks(args, given, sidecar),
        ],
        texts_by_file(warnings),
        notes,
        report.file_digests(inputs),
        characteristics,
    )
    files = paths_by_name(outputs)
    document = _document(done, judged) | {
        "estimated_entries": given.estimated,
        "warnings": [*notes, *done.warnings],
        "measured_region": extrapolation and extrapolation.to_dict(),
        "iso9283": characteristics and characteristics.to_dict(),
        "files": files,
    }

    def map_content(path: str) -> str:
        assert given.predictor is not None
        return report.map_content(path, given.predictor, data, judged.known)

    makers: Makers = {"map": map_content, "report": lambda path: report.validation_page(done)}
    write_outputs(file_contents(outputs, makers), args.json, document)
    title = f"{args.robot}: accuracy on {document['samples']} samples"
    shown = {name: path for name, path in files.items() if name != "json"}
    tables = characteristics.tables() if characteristics else []
    screen = screens.validation_screen(title, accuracies, done.remarks, notes, warnings, shown, tables)
    screens.show(screen, args.verbosity)
    return 0


def _read_input(args: Namespace, sidecar: str | None) -> Given:
    """Read robot and measurements, and what a calibration has written beside the robot."""
    # lazy imports: they load Pinocchio
    from ...measurements.contact import require_touched_points
    from ...measurements.position import require_common_reference_target

    chain = options.read_one_robot(args.robot, args, sidecar)
    servos = io.read_servos(args.servos) if args.servos else None
    rig, estimated = _mounted_rig(args, sidecar, chain, servos)
    predictor = _predictor(chain, sidecar, args) if args.map else None
    files = options.read_data(args, chain, servos, rig)
    instrument = io.read_instrument(sidecar) if sidecar else {}
    require_common_reference_target({file.source: file.data for file in files}, instrument)
    require_touched_points([file.data for file in files], instrument)
    used = {parameter.name for file in files for parameter in file.data.instrument_parameters}
    known = {name: value for name, value in instrument.items() if name in used}
    calibrated_tip = (sidecar and io.read_tip(sidecar)) or chain.tip
    region = io.read_measured_region(sidecar, chain) if sidecar and calibrated_tip == chain.tip else None
    return Given(chain, files, known, rig, estimated, region, predictor, calibrated_tip, servos)


def _judge(args: Namespace, given: Given) -> Judged:
    """Compute the accuracies that are compared, with base and tool as given or fitted."""
    chain, data, known = given.chain, given.data, given.known
    before = calibration.accuracy(chain, data, known)
    name = "fitted to these images" if _unstated_entries(given.rig) else "base and tool as given"
    accuracies, alone = {name: before}, before
    # A sidecar with joint errors makes two models.
    model = "URDF and sidecar, " if chain.error_families else ""
    if chain.error_families:
        alone = _accuracy_on_all(diagnostics.fit_frames(chain.urdf_alone, data, known), data, known)
        accuracies = {"URDF alone, base and tool fitted": alone, f"{model}{name}": before}
    judged = Judged(chain, known, None, before, accuracies, alone)
    if args.fit_frames:
        fit = diagnostics.fit_frames(chain, data, known)
        after = _accuracy_on_all(fit, data, known)
        accuracies = accuracies | {f"{model}base and tool fitted": after}
        alone = alone if chain.error_families else after
        judged = Judged(fit.chain, known | fit.instruments, fit, before, accuracies, alone)
    if not args.nominal:
        return judged
    nominal, reference, remarks = _nominal_accuracy(judged.chain, data, judged.known, args)
    accuracies = {"nominal": nominal, "calibrated": list(judged.accuracies.values())[-1]}
    return judged._replace(before=nominal, accuracies=accuracies, reference=reference, remarks=remarks)


def _accuracy_on_all(
    fit: calibration.Result, data: Sequence[Measurement], known: Mapping[str, float]
) -> calibration.Accuracy:
    """Return the accuracy on all samples, outliers too, with the fitted base and tool."""
    return calibration.accuracy(fit.chain, data, {**known, **fit.instruments})


def _document(done: report.Validation, judged: Judged) -> dict[str, Any]:
    """Create the part of the JSON document that a calibration has, too."""
    models = (judged.before, list(judged.accuracies.values())[-1], judged.alone)
    before, after, alone = map(report.main_statistics, models)
    if judged.fit:
        document = report.result_to_dict(judged.fit, {}, done.inputs, is_calibration=False)
    else:
        document = report.validation_to_dict(done.data, done.inputs, before, after)
    return document | {"before": before, "after": after, "urdf_alone": {"before": before, "after": alone}}


def _outlier_remarks(judged: Judged, data: Sequence[Measurement]) -> list[str]:
    """Name the samples that are far from the others, and state the accuracy without them."""
    from ...calibration.evaluation import compute_errors, find_inliers, take_errors  # lazy import
    from ...calibration.summary import statistic
    from ...measurements.groups import ERROR_GROUPS

    errors = compute_errors(judged.chain, data, judged.known)
    masks = find_inliers(errors)
    rows = [(item.source, item.rows[~mask].tolist()) for item, mask in zip(data, masks, strict=True)]
    texts = [f"{source}: {list_first(lines)}" for source, lines in rows if lines]
    if not texts:
        return []
    group, rest = next(iter(calibration.Accuracy.from_errors(take_errors(errors, masks)).groups.items()))
    return [
        f"Samples far from the others: {sum(len(lines) for _, lines in rows)} (lines in {'; '.join(texts)}). "
        f"RMS {ERROR_GROUPS[group].label} without them: {statistic(rest)}."
    ]


def _rig_remarks(args: Namespace, given: Given, sidecar: str | None) -> list[str]:
    """Say which cameras and boards were fitted to the images, and which a calibration estimated."""
    remarks = []
    if unstated := _unstated_entries(given.rig):
        remarks.append(
            f"Poses or lenses of {', '.join(unstated)} are not stated and were fitted to these images; other "
            "images have larger errors."
        )
    if given.estimated:
        others = f", not those of {args.rig}" if args.rig else ""
        remarks.append(
            f"Poses, lenses and corners of {', '.join(given.estimated)} are the estimates of the calibration "
            f"({sidecar}){others}."
        )
    return remarks


def _mounted_rig(
    args: Namespace, sidecar: str | None, chain: robot.Chain, servos: io.ServoFile | None
) -> tuple[MountedRig | None, list[str]]:
    """Return the cameras and boards of images, of the sidecar without a rig file, and which are estimates."""
    from ...io.measurement_files.reading import has_image_coordinates  # lazy import, as the following
    from ...measurements.mounting import mount_rig

    calibrated = io.read_calibrated_rig(sidecar) if sidecar else None
    if args.rig:
        rig = io.read_rig(args.rig)
    else:
        is_usable = calibrated is not None and calibrated.is_complete
        has_images = is_usable and any(
            has_image_coordinates(path, chain, args.columns, servos, args.sheet) for path in args.data
        )
        rig = calibrated if has_images else None
    if rig is None or calibrated is None:
        return rig and mount_rig(rig, chain), []
    names = [
        *(f"camera.{name}" for name in rig.cameras if name in calibrated.cameras),
        *(f"board.{name}" for name in rig.boards if name in calibrated.boards),
    ]
    ends = {"world": chain.root, "tip": chain.tip}
    return mount_rig(io.with_estimates_of(rig, calibrated, ends), chain), names


def _unstated_entries(rig: MountedRig | None) -> list[str]:
    """Return the cameras without a pose or a lens and the boards without a pose, such as `camera.wrist`."""
    if rig is None:
        return []
    return [
        *(f"camera.{each.name}" for each in rig.cameras if each.pose is None or not each.has_intrinsics),
        *(f"board.{each.name}" for each in rig.boards if each.pose is None),
    ]


def _nominal_accuracy(
    chain: robot.Chain, data: Sequence[Measurement], known: Mapping[str, float], args: Namespace
) -> tuple[calibration.Accuracy, tuple[robot.Chain, Mapping[str, float]], list[str]]:
    """Compute the accuracy of the nominal robot; fit its base and tool if the calibrated robot has others."""
    import numpy as np  # lazy import: slow to load

    nominal = options.read_robot_or_table(args.nominal, args)
    if nominal.joint_names != chain.joint_names:
        raise InvalidArgumentError(
            f"{args.nominal}: joints {', '.join(nominal.joint_names)}; expected the joints of {args.robot}: "
            f"{', '.join(chain.joint_names)}"
        )
    pairs = {"base": (nominal.base, chain.base), "tool": (nominal.tool, chain.tool)}
    others = [name for name, (a, b) in pairs.items() if not np.allclose(a, b, rtol=0, atol=FRAMES_TOL)]
    if not others:
        return calibration.accuracy(nominal, data, known), (nominal, known), []
    fit = diagnostics.fit_frames(nominal, data, known, ",".join(others))
    note = f"nominal: {' and '.join(others)} fitted to these measurements"
    return _accuracy_on_all(fit, data, known), (fit.chain, {**known, **fit.instruments}), [note]


def _input_warnings(
    args: Namespace, given: Given, judged: Judged, sidecar: str | None
) -> dict[str, list[str]]:
    """List the warnings about each file, rows that the robot cannot reach included; no row is excluded."""
    fitted = io.read_fitted(sidecar) if sidecar else io.Fitted()
    digests = report.file_digests(args.data)
    warned = {
        file.source: diagnostics.fitted_warning(file.data, digests.get(file.source, ""), fitted)
        for file in given.files
    }
    are_fitted, are_off = any(warned.values()), False
    warnings = {args.servos: other_zeros_warning(args.robot, given.servos, are_fitted)} if args.servos else {}
    for file in given.files:
        unreachable = [] if args.fit_frames else diagnostics.find_unreachable_rows(judged.chain, file)
        warnings[file.source] = [
            *diagnostics.find_input_warnings(judged.chain, file),
            *(f"line {item.row}: {item.reason}" for item in unreachable),
            *warned[file.source],
        ]
    if args.nominal and not sidecar and (other := io.existing_sidecar(args.nominal)):
        warnings[args.nominal] = [
            f"{other} is that of a calibrated robot, and {args.robot} has none: exchange them"
        ]
    if (tip := given.calibrated_tip) != given.chain.tip:
        warnings[args.robot] = [f"the tool of {sidecar} is that of the tip {tip}: run again with --tip {tip}"]
    elif not args.fit_frames and diagnostics.frames_differ(judged.chain, given.data, judged.known):
        warning = diagnostics.ISO_FRAMES_WARNING if args.iso9283 else diagnostics.FRAMES_WARNING
        warnings[args.robot], are_off = [warning], True
    elif args.fit_frames and args.iso9283:
        warnings[args.robot] = [diagnostics.ISO_FITTED_WARNING]
    elif sidecar and not args.fit_frames:
        excess = _excess_warnings(given, io.read_uncertainty(sidecar, given.chain))
        are_off = bool(excess)
        if not any(warnings.values()):
            warnings[args.robot] = excess
    if are_off and given.servos and not warnings[args.servos]:
        warnings[args.servos] = other_zeros(args.robot, given.servos, NEW_OFFSETS)
    return warnings


def _excess_warnings(given: Given, uncertainty: estimation.Uncertainty | None) -> list[str]:
    """Say if the error in the measured region is larger than that of the calibration."""
    from ...calibration.evaluation import compute_errors, find_inliers  # lazy import

    region, chain = given.region, given.chain
    if region is None or uncertainty is None or any(item.configurations_per_row != 1 for item in given.data):
        return []
    masks = find_inliers(compute_errors(chain, given.data, given.known))
    data = [
        item.take(mask & (region.distances(item.configurations()) <= region.radius))
        for item, mask in zip(given.data, masks, strict=True)
    ]
    data = [item for item in data if len(item.rows)]
    found = session.find_excess_error(chain, data, uncertainty, known=given.known, payloads=region.payloads)
    if found is None:
        return []
    error, usual = found
    lengths = [format_quantity(each, "m", each / 10) for each in found]
    return [
        f"the error of the positions, {lengths[0]} RMS, is {error / usual:.2g} times that of the "
        f"calibration, {lengths[1]}: these measurements have more noise, or something changed; "
        "`dhcal recheck` with `--sigma` finds what"
    ]


def _predictor(chain: robot.Chain, sidecar: str | None, args: Namespace) -> estimation.Predictor:
    """Read the uncertainty that the calibration has written beside the robot."""
    if args.fit_frames:
        raise InvalidArgumentError(
            "--map: not available with --fit-frames; the uncertainty holds for base and tool as calibrated"
        )
    uncertainty = io.read_uncertainty(sidecar, chain) if sidecar else None
    if uncertainty is None:
        raise InvalidArgumentError(
            f"{sidecar or args.robot}: --map needs the table [uncertainty] of a calibration; `dhcal "
            "calibrate` writes it beside the corrected robot if there are more measurements than parameters"
        )
    return uncertainty
