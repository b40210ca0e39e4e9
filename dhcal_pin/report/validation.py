"""Page of a validation: the accuracy of a robot on measurements, beside that of its nominal model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from .._frozen import frozen
from ..calibration.evaluation import Accuracy, aligned_norms, compute_errors
from ..calibration.summary import STATISTIC_LABELS, statistic
from ..formatting import Table, format_count
from ..iso9283.characteristics import PoseCharacteristics
from ..measurements.base import Measurement
from ..measurements.groups import ERROR_GROUPS
from ..robot.chain import Chain
from ..visualization import scene
from . import figures
from .document import Document, FigureGroup, LegendEntry, Section
from .html import html_page
from .provenance import measurement_names, origin_tables
from .samples import Samples, measured_samples, samples_section


@frozen(eq=False)
class Validation:
    """Accuracy of a robot on measurements."""

    name: str  #: Name of the robot.
    chain: Chain  #: Robot, with the base and tool that it was judged with.
    data: Sequence[Measurement]  #: Measurements.
    #: Values of their instrument parameters by name [m or rad]; others are fitted to the data.
    known: Mapping[str, float]
    paths: Sequence[str]  #: File of each measurement.
    accuracies: Mapping[str, Accuracy]  #: Accuracy by the name of the model; the last one is that of `chain`.
    #: Nominal robot and the instrument parameters it was judged with, if there is one.
    reference: tuple[Chain, Mapping[str, float]] | None
    remarks: Sequence[str]  #: Sentences on the figures.
    warnings: Sequence[str]  #: What a reader must know before relying on the figures.
    notes: Sequence[str]  #: What of the input is not used.
    inputs: Mapping[str, str]  #: SHA-256 of each input file by path.
    #: Characteristics of poses according to ISO 9283, if they were asked for.
    characteristics: PoseCharacteristics | None


def validation_page(validation: Validation) -> str:
    """Render the page of a validation."""
    samples = _samples(validation)
    group, errors = next(iter(list(validation.accuracies.values())[-1].groups.items()))
    values = [
        (
            "before" if i + 1 < len(validation.accuracies) else "after",
            f"{name}, RMS",
            str(statistic(accuracy.groups[group])),
        )
        for i, (name, accuracy) in enumerate(validation.accuracies.items())
    ]
    details = [("", STATISTIC_LABELS[key], str(statistic(errors, key))) for key in ("mean", "p95", "max")]
    label, count = ERROR_GROUPS[group].label, len(samples)
    shown = samples.limited()
    return html_page(
        Document(
            title=f"Validation of {validation.name}",
            heading=f"{label.capitalize()} on {format_count(count, 'sample')}",
            sections=_sections(validation, shown),
            eyebrow=f"Validation of {validation.name}",
            values=values,
            details=details,
            remarks=validation.remarks,
            warnings=validation.warnings,
            samples=shown.page_data,
        )
    )


def _samples(validation: Validation) -> Samples:
    """Collect the samples of a validation."""
    data, chain = validation.data, validation.chain
    fits = {"after": (chain, validation.known)}
    if validation.reference:
        fits = {"before": validation.reference} | fits
    norms = {side: aligned_norms(compute_errors(of, data, known), data) for side, (of, known) in fits.items()}
    return measured_samples(chain, measurement_names(validation.paths, data), data, norms)


def _sections(validation: Validation, samples: Samples) -> list[Section]:
    """Return the sections of the page."""
    return [
        Section(
            "accuracy",
            "Accuracy",
            tables=[_accuracy_table(validation.accuracies)],
            figures=partial(_histograms, samples),
        ),
        *(
            [Section("iso9283", "Poses according to ISO 9283", tables=validation.characteristics.tables())]
            if validation.characteristics
            else []
        ),
        Section("residuals", "Residual errors", figures=partial(figures.sample_figures, samples)),
        Section("scene", "Robot and measurements", figures=partial(_scene_figures, validation)),
        samples_section(samples),
        Section("notes", "Data that are not used", items=validation.notes),
        Section("provenance", "Provenance", tables=_provenance_tables(validation)),
    ]


def _accuracy_table(accuracies: Mapping[str, Accuracy]) -> Table:
    """Return one row per model and group of errors."""
    rows = [
        [
            name,
            ERROR_GROUPS[group].label,
            *(statistic(each, key) for key in STATISTIC_LABELS),
        ]
        for name, accuracy in accuracies.items()
        for group, each in accuracy.groups.items()
    ]
    return Table(["robot", "error", *STATISTIC_LABELS.values()], rows, n_text_columns=2)


def _histograms(samples: Samples) -> list[FigureGroup]:
    """Draw histograms of the errors, if there is a nominal robot to compare with."""
    panels = []
    for group, states in samples.errors.items():
        if "before" in states:
            is_shown = np.isfinite(states["after"])
            panels += figures.histogram_panels(
                group, {"measured": (states["before"][is_shown], states["after"][is_shown])}
            )
    legend = [
        LegendEntry(text, state, "area") for state, text in (("before", "nominal"), ("after", "calibrated"))
    ]
    return [FigureGroup(panels, legend=legend, layout="wide")] if panels else []


def _scene_figures(validation: Validation) -> list[FigureGroup]:
    """Draw the robot with the measurements in 3-D."""
    nominal = validation.reference[0] if validation.reference else validation.chain
    page = scene.scene_html(
        nominal,
        validation.chain if validation.reference else None,
        measurements=validation.data,
        known=validation.known,
        title=validation.name,
        triangles=figures.MAX_SCENE_TRIANGLES,
    )
    title = "The robot and the measurements, in three dimensions"
    return [FigureGroup((), scene=figures.packed_scene(page), scene_title=title)]


def _provenance_tables(validation: Validation) -> list[Table]:
    names = measurement_names(validation.paths, validation.data)
    rows = [[name, item.kind, str(len(item.rows))] for name, item in zip(names, validation.data, strict=True)]
    data = Table(["data", "kind", "samples"], rows, n_text_columns=2)
    return [data, *origin_tables(validation.inputs)]
