"""`dhcal demo`: reproduce the experiment and the simulations of the paper.

The experiment is the 3-joint robot of the paper with the positions of its Table 5. The files of a calibration
and a summary in Markdown are written into a folder.
"""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from ... import io, paper, report, visualization
from ...exceptions import InvalidArgumentError
from .. import screens
from ..options import JSON, Options, open_option
from ..screens.screen import Block, Screen

if TYPE_CHECKING:
    from ..._typing import PathLike
    from ...formatting import Table

EXAMPLE = "dhcal demo -o demo"

ARGUMENTS: Options = {
    "-o --output --out DIR": {
        "dest": "out",
        "default": "demo",
        "help": "folder for the results (default: %(default)s)",
    },
    **open_option("open the report in the browser"),
    "--json": JSON,
}


def run(args: Namespace) -> int:
    """Run experiment and simulations."""
    from ...calibration.summary import estimate_table  # lazy import, as the following: they load Pinocchio
    from ...formatting import Table
    from ...paper import simulations
    from ..outputs import require_writable_outputs

    require_writable_outputs([args.json], [])
    folder = args.out
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError as error:
        raise InvalidArgumentError(f"{folder}: cannot create this folder: {error.strerror}") from error
    experiment = paper.run_experiment()
    header = ["position RMS in mm", "fitted", "leave-one-out"]
    shown = _Section(
        f"The experiment, {len(experiment.data.q)} of {len(experiment.measurements.data.q)} rows",
        Table(header, experiment.rows),
        experiment_remarks(experiment),
    )
    details = [
        _Section("Parameters, least squares", estimate_table(experiment.fit.estimates)),
        _Section(
            f"The simulations: largest error of {simulations.TESTS} test poses in mm by iteration, median of "
            f"{simulations.SEEDS} seeds; runs with an exact fit and runs with the true parameters",
            Table(simulations.SIMULATION_HEADER, simulations.simulation_rows()),
            simulations.SIMULATION_REMARKS,
        ),
    ]
    document = _write_results(experiment, folder, [shown, *details], args.json)
    excluded = [f"Table 5: row {item.row} is excluded: {item.reason}" for item in experiment.unreachable_rows]
    names = [os.path.basename(path) for path in document["files"].values()]
    blocks = [
        *shown.blocks(),
        Block(excluded, "yellow", noun="excluded row of Table 5", rank=0, n_kept=0, has_space=True),
        Block([f"wrote into {folder}: {', '.join(names)}"], has_space=True),
    ]
    screens.show(
        Screen(blocks, lambda: [block for section in details for block in section.blocks()]), args.verbosity
    )
    if args.open:
        screens.open_page(document["files"]["report"])
    return 0


class _Section(NamedTuple):
    """Table of the demo with its title and remarks."""

    title: str
    table: Table
    remarks: Sequence[str] = ()

    def blocks(self) -> list[Block]:
        """Return the blocks of a screen."""
        return [
            Block(self.table, title=self.title, has_space=True),
            Block(self.remarks, noun="remark", rank=1),
        ]


def experiment_remarks(experiment: paper.PaperExperiment) -> list[str]:
    """Say in sentences what the experiment shows."""
    mm = {key: f"{1e3 * value:.1f} mm" for key, value in experiment.figures.items()}
    n_points, n_parameters = len(experiment.data.q), len(experiment.fit.parameters)
    return [
        f"{3 * n_points} equations for {n_parameters} parameters leave little redundancy: leave-one-out "
        f"{mm['least_squares_left_out']}, fit {mm['least_squares']}.",
        f"{' and '.join(experiment.fixed)} are not observable from these positions and stay at their nominal "
        "values.",
        "The published parameters (Table 4) do not reproduce the measurements of Table 5: their error is "
        f"{mm['published_parameters']} RMS, that of the nominal parameters {mm['before']}. No value was "
        "adjusted to agree with them.",
    ]


def _write_results(
    experiment: paper.PaperExperiment, folder: str, sections: Sequence[_Section], json_target: str | None
) -> dict[str, Any]:
    """Write URDFs, JSON, summary, scene and report; return the JSON document."""
    from ...formatting import markdown_table  # lazy import, as the following: they load Pinocchio
    from ..outputs import write_outputs

    names = {
        "urdf": "experiment_calibrated.urdf",
        "nominal": "experiment.urdf",
        "json": "result.json",
        "summary": "summary.md",
        "scene": "scene.html",
        "report": "report.html",
    }
    files = {key: os.path.join(folder, name) for key, name in names.items()}
    inputs = [io.shipped_file("experiment.dh.toml"), io.shipped_file("experiment_table5.csv")]
    digests = zip(inputs, report.file_digests(inputs).values(), strict=True)
    excluded = {item.row: item.reason for item in experiment.unreachable_rows}
    source = report.Provenance(
        command="dhcal demo",
        inputs={path.name: digest for path, digest in digests},
        names=[inputs[1].name],
        settings={"parameters": "dh"},
        excluded_rows={inputs[1].name: excluded},
        remarks=experiment_remarks(experiment),
        comparison=experiment.comparison,
    )
    document = report.result_to_dict(experiment.fit, files, source.inputs, list(excluded))
    document |= {"experiment_m": experiment.figures}
    summary = ["# The paper's robot, calibrated"]
    summary += [f"Row {row} of Table 5 is excluded: {reason}." for row, reason in excluded.items()]
    for section in sections:
        summary += [f"## {section.title}", markdown_table(section.table), *section.remarks]
    contents: dict[PathLike, str | bytes | None] = {
        **io.urdf_files(experiment.fit.chain, files["urdf"]),
        files["nominal"]: experiment.chain.urdf.data,
        **report.report_files(experiment.fit, [files["report"]], source),
        files["scene"]: visualization.scene_html(
            experiment.chain, experiment.fit, title="The paper's robot, before and after"
        ),
        files["json"]: report.json_text(document),
        files["summary"]: "\n\n".join([*summary, ""]),
    }
    write_outputs(contents, json_target, document)
    return document
