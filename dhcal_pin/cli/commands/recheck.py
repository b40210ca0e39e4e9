"""`dhcal recheck`: is a robot still calibrated?"""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from ... import diagnostics, io, report, session
from ...exceptions import InvalidArgumentError
from ...formatting import texts_by_file
from .. import options, screens
from ..output_table import Makers, Output
from ..servo_zeros import other_zeros_warning

EXAMPLE = "dhcal recheck ur10_calibrated.urdf check.csv --tip tool0 --history ur10.jsonl"

# Reason of the verdict if a mistake in a file is the likely reason for the residuals.
_MISTAKE = "The measurements contain a mistake: {}. Correct them, and check again."
# Exit status of each verdict.
STATUS = {"ok": 0, "changed": 1, "cannot say": 2}

OUTPUTS = {
    "json": Output(),
    "history": Output("a history", (".jsonl",)),
    "plot": Output("a plot of the history", (".html",), (".htm",)),
}

ARGUMENTS: options.Options = {
    "robot": {**options.ROBOT, "help": f"calibrated {options.ROBOT['help']}, with its sidecar"},
    "data": options.DATA,
    **options.URDF_OPTIONS,
    **options.TABLE_OPTIONS,
    "--skip-bad-rows": options.SKIP_BAD_ROWS,
    "--sigma LENGTH[,ANGLE]": "standard deviation per axis of instrument and robot repeatability (default: "
    "the columns sigma of DATA, else estimated from the measurements)",
    "--size LENGTH": {
        "default": "1mm",
        "help": "smallest motion of the tool that the check must reveal; if it cannot, the answer is "
        "`cannot say` (default: %(default)s)",
    },
    "--history FILE.jsonl": "add the check to this file, one JSON line each",
    "--plot H.html": "page with the checks of --history over time (.html)",
    "--json": options.JSON,
}


def run(args: Namespace) -> int:
    """Check whether a robot is still calibrated, write the answer and show it."""
    from ...io.check_history import Check, history_text, read_history  # lazy import, as the following
    from ...io.measurement_files.reading import has_image_coordinates
    from ...measurements import Noise
    from ...units import parse_noise
    from ..output_table import file_contents, paths_by_name
    from ..outputs import checked_files, require_workbook, write_outputs

    sidecar = io.existing_sidecar(args.robot)
    inputs = [args.robot, *args.data, *filter(None, (sidecar, args.columns, args.servos))]
    outputs = checked_files(args, OUTPUTS, inputs)
    require_workbook(args.sheet, inputs)
    if args.plot and not args.history:
        raise InvalidArgumentError("--plot: needs --history, the file with the checks that are shown")
    noise = Noise(*parse_noise(args.sigma, "--sigma")) if args.sigma else None
    size = parse_noise(args.size, "--size")[0]
    chain = options.read_one_robot(args.robot, args)
    if sidecar is None:
        raise InvalidArgumentError(
            f"{args.robot}: no sidecar; expected a calibrated robot, which `dhcal calibrate` writes with its "
            "NAME.calibration.toml"
        )
    if (tip := io.read_tip(sidecar) or chain.tip) != chain.tip:
        raise InvalidArgumentError(
            f"{args.robot}: tip {chain.tip}; expected --tip {tip}, on which the tool of {sidecar} is"
        )
    servos = io.read_servos(args.servos) if args.servos else None
    for path in args.data:
        if has_image_coordinates(path, chain, args.columns, servos, args.sheet):
            raise InvalidArgumentError(f"{path}: recheck does not use images; expected positions or poses")
    files = options.read_data(args, chain, servos)
    earlier = read_history(args.history) if args.history and os.path.exists(args.history) else []
    data, known = [file.data for file in files], io.read_instrument(sidecar)
    used = {parameter.name for item in data for parameter in item.instrument_parameters}
    known = {name: value for name, value in known.items() if name in used}
    region = io.read_measured_region(sidecar, chain)
    payloads = region.payloads if region else None
    result = session.recheck(
        chain,
        data,
        io.read_uncertainty(sidecar, chain),
        known=known,
        noise=noise,
        size=size,
        payloads=payloads,
    )
    # Mistakes look like a change of the robot.
    suspects = [] if result.verdict == "ok" else files
    mistakes = {file.source: diagnostics.find_input_warnings(chain, file) for file in suspects}
    texts = texts_by_file(mistakes)
    if texts and any(change.kind == "robot" for change in result.changes):
        # Wrong units and the like change all parts of the robot at once.
        result = replace(
            result, verdict="cannot say", reasons=(_MISTAKE.format(texts[0].rstrip(".")),), changes=()
        )
    warnings = _with_fitted_rows(mistakes, files, io.read_fitted(sidecar))
    if servos is not None:
        are_fitted = any(warnings[file.source] != mistakes.get(file.source, []) for file in files)
        warnings[args.servos] = other_zeros_warning(args.robot, servos, are_fitted)
    notes = diagnostics.file_notes(chain, files, payloads)
    now = Check.of(result, args.robot, args.data)
    document: dict[str, Any] = result.to_dict() | {
        "warnings": [*notes, *texts_by_file(warnings)],
        "time": now.time,
        "robot": args.robot,
        "files": paths_by_name(outputs),
        "inputs": report.file_digests(inputs),
    }
    checks = [*earlier, now]
    makers: Makers = {
        "history": lambda path: history_text(checks),
        "plot": lambda path: report.history_page(io.robot_name(args.robot), checks),
    }
    contents = file_contents(outputs, makers)
    write_outputs(contents, args.json, document)
    screens.show(screens.recheck_screen(result, notes, warnings, contents), args.verbosity)
    return STATUS[result.verdict]


def _with_fitted_rows(
    mistakes: Mapping[str, list[str]], files: Sequence[io.MeasurementFile], fitted: io.Fitted
) -> dict[str, list[str]]:
    """Add warnings about the rows that the calibration fitted to the mistakes in each file."""
    digests = report.file_digests([file.source for file in files])
    return {
        file.source: [
            *mistakes.get(file.source, ()),
            *diagnostics.fitted_warning(file.data, digests.get(file.source, ""), fitted),
        ]
        for file in files
    }
