"""What the small commands of `dhcal` do, once the command line is read.

Wrong input is found before anything is written or shown; JSON goes to stdout, all else to stderr.
"""

from __future__ import annotations

import os
from argparse import Namespace
from typing import Any

from .. import formatting
from .._typing import PathLike
from ..calibration import summary
from ..exceptions import DhcalError
from ..io.atomic import write_files
from ..io.robot import urdf_files
from ..io.shipped_files import shipped_file
from ..paper.experiment import PaperExperiment, run_experiment
from ..paper.simulations import (
    SEEDS,
    SIMULATION_HEADER,
    SIMULATION_REMARKS,
    TESTS,
    simulation_rows,
)
from ..report import html
from ..report.document import Provenance, file_digests, json_text, result_to_dict
from ..visualization.scene import scene_html
from . import console
from .options import require_writable_outputs, write_json


def demo(args: Namespace) -> int:
    """The paper's arm, end to end."""
    require_writable_outputs([args.json], [])
    document = run(args.out)
    write_json(args.json, document)
    if args.open:
        console.open_page(document["files"]["report"])
    return 0


# --- the command -----------------------------------------------------------------------------------
def _verdict(found: PaperExperiment) -> list[str]:
    mm = {key: f"{1e3 * value:.1f} mm" for key, value in found.figures.items()}
    count, unknown = 3 * len(found.data.q), len(found.fit.parameters)
    missed = mm["published_parameters"]
    return [
        f"{len(found.data.q)} points do not determine the parameters: {count} readings stand against "
        f"{unknown} unknowns, and a point that was left out is missed by {mm['least_squares_left_out']} "
        f"where fitted ones are missed by {mm['least_squares']}.",
        f"{' and '.join(found.fixed)} cannot be seen from these positions at the nominal arm, and were held.",
        "The published parameters (Table 4) do not reproduce the measurements of Table 5: with them the "
        f"model misses the measured points by {missed} RMS, the nominal one by {mm['before']}. "
        "Nothing here was adjusted to match them.",
    ]


def run(out: PathLike) -> dict[str, Any]:
    """Runs everything, shows it, and writes URDFs, JSON and a Markdown summary into a folder."""
    folder = os.fspath(out)
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError as error:
        raise DhcalError(f"{folder}: cannot make this folder: {error.strerror}") from error
    found = run_experiment()
    console.print_unreachable_rows("Table 5", found.findings)
    header = ["position RMS in mm", "fitted", "left one out"]
    title = f"The experiment, {len(found.data.q)} of {len(found.readings.data.q)} rows"
    verdict = formatting.Table(header, found.rows)
    console.print_table(title, verdict)
    parameters = summary.estimate_table(found.fit.estimates)
    console.print_table("Parameters, least squares", parameters)
    console.print_lines("", *_verdict(found))
    rows = simulation_rows()
    simulation_title = (
        f"The simulations: worst of {TESTS} test poses in mm by iteration, median of {SEEDS} seeds; how many "
        "end with an exact fit, and how many with the true parameters"
    )
    simulations = formatting.Table(SIMULATION_HEADER, rows)
    console.print_table(simulation_title, simulations)
    console.print_lines(*SIMULATION_REMARKS)
    urdf = os.path.join(folder, "experiment_calibrated.urdf")
    nominal = os.path.join(folder, "experiment.urdf")
    contents = urdf_files(found.fit.chain, urdf) | {nominal: found.chain.urdf.data}
    files = {
        "urdf": urdf,
        "nominal": nominal,
        "json": os.path.join(folder, "result.json"),
        "summary": os.path.join(folder, "summary.md"),
        "scene": os.path.join(folder, "scene.html"),
        "report": os.path.join(folder, "report.html"),
    }
    inputs = [shipped_file("experiment.dh.toml"), shipped_file("experiment_table5.csv")]
    digests = zip(inputs, file_digests(inputs).values(), strict=True)
    source = Provenance(
        command="dhcal demo",
        inputs={path.name: digest for path, digest in digests},
        names=[inputs[1].name],
        settings={"parameters": "dh"},
        excluded_rows={inputs[1].name: {f.row: f.reason for f in found.findings}},
        remarks=_verdict(found),
        comparison=found.comparison,
    )
    rejected = [finding.row for finding in found.findings]
    document = result_to_dict(found.fit, files, source.inputs, rejected) | {"experiment_m": found.figures}
    contents |= html.report_files(found.fit, [files["report"]], source)
    contents[files["scene"]] = scene_html(found.chain, found.fit, title="The paper's robot, before and after")
    contents[files["json"]] = json_text(document)
    contents[files["summary"]] = "\n\n".join(
        [
            "# The paper's robot, calibrated",
            *(f"Row {f.row} of Table 5 is left out: {f.reason}." for f in found.findings),
            f"## {title}",
            formatting.markdown_table(verdict),
            *_verdict(found),
            "## Parameters, least squares",
            formatting.markdown_table(parameters),
            f"## {simulation_title}",
            formatting.markdown_table(simulations),
            *SIMULATION_REMARKS,
            "",
        ]
    )
    write_files(contents)
    console.print_lines("", *(f"wrote {path}" for path in files.values()))
    return document
