"""Section of the report on images: the stages of the calibration, and the errors of corners in the images."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..calibration import summary
from ..calibration.cameras import ImageError, Stage
from ..calibration.evaluation import compute_errors
from ..cameras.rig import Camera
from ..formatting import Table, format_fixed, round_down
from ..visualization import image_plots
from .context import ReportContext
from .document import FigureGroup, LegendEntry, Panel, Section

# Images of the table, and of the figures of single images: those with the largest errors.
MAX_LISTED_IMAGES, MAX_DRAWN_IMAGES = 10, 6
# Part of the width of an image that a large error should take, and the percentile of a large error.
_DRAWN_PART, _LARGE_PERCENTILE = 0.06, 95.0
# Width of the figure of a camera and of an image, and space that its labels take beside and below it [px].
_WIDTH, _NARROW, _BESIDE, _BELOW = 420.0, 320.0, 60.0, 46.0


@frozen(eq=False)
class _Image:
    """Corners of one image."""

    number: int  # Number in the report, from 1
    name: str  # Name of its photograph, or the number if it has none
    source: str  # Name of the file and lines of its rows
    camera: Camera  # Camera that took it
    role: str  # "fitted" or "hold-out"
    pixels: Array  # Measured corners, (c, 2) [px]
    before: Array  # Errors with the nominal arm, (c, 2) [px]
    after: Array  # Errors after the calibration, (c, 2) [px]
    distance: Array  # Errors at the board after the calibration, (c,) [m]

    @property
    def rms(self) -> float:
        """RMS distance in the image after the calibration [px]."""
        return se3.rms_length(self.after)


def image_section(context: ReportContext) -> Section | None:
    """Describe stages, causes of the errors of left-out images, and the images with the largest errors."""
    if not any(item.rig is not None for item in context.fit.data):
        return None
    stages, sentences, items = context.fit.camera_stages, [], []
    tables: list[Table] = []
    if stages:
        sentences.append(
            "Unknowns are freed in stages. Each stage is judged on images that its fit did not see: random "
            "ones, and whole regions of joint space. An error in mm is the distance of a corner of the board "
            "from the line of sight through its image."
        )
        items = [f"{stage.name}: {stage.reason}" for stage in stages if stage.reason]
        tables.append(stage_table(stages))
    sentences += summary.position_notes(context.fit.hand_eye_std)
    sentences += summary.position_error_notes(context.fit)
    hand_eye = context.fit.hand_eye
    if hand_eye is not None:
        likely = "" if hand_eye.is_noise else hand_eye.likely
        sentences += [f"{hand_eye.error_sentence}{likely}", *hand_eye.image_sentences]
        if hand_eye.trials:
            sentences.append(
                "The table of causes shows the error of left-out images if one thing more than the poses is "
                "estimated."
            )
        tables.append(hand_eye.table)
    tables.append(image_table(context))
    return Section("images", "Images", sentences, items, tables, partial(image_figures, context))


def stage_table(stages: Sequence[Stage]) -> Table:
    """Return the accuracy after each stage of a calibration from images."""

    def cells(error: ImageError | None) -> list[str]:
        if error is None:
            return ["", ""]
        return [f"{error.pixels:.3g}", f"{1e3 * error.distance:.3g}"]

    rows = [
        [stage.name, "yes" if stage.is_kept else "no", str(stage.n_unknowns)]
        + [cell for error in (stage.fitted, stage.by_image, stage.by_region) for cell in cells(error)]
        for stage in stages
    ]
    errors = [
        f"{name}, {unit}"
        for name in ("fitted", "left-out images", "left-out regions")
        for unit in ("px", "mm")
    ]
    return Table(["stage", "free in the result", "unknowns", *errors], rows, n_text_columns=2)


def image_table(context: ReportContext) -> Table:
    """Return the images with the largest errors."""
    images = sorted(_images(context), key=lambda image: -image.rms)[:MAX_LISTED_IMAGES]
    rows = [
        [
            image.name,
            image.source,
            image.camera.name,
            image.role,
            str(len(image.pixels)),
            f"{se3.rms_length(image.before):.3g}",
            f"{image.rms:.3g}",
            format_fixed(1e3 * float(np.sqrt(np.mean(image.distance**2))), 3),
        ]
        for image in images
    ]
    header = ["image", "lines", "camera", "samples", "corners", "before, px", "after, px", "after, mm"]
    return Table(header, rows, n_text_columns=4)


def _images(context: ReportContext) -> list[_Image]:
    """Return all images, fitted ones first."""
    fit, out = context.fit, []
    parts = (
        ("fitted", context.data_names, fit.data),
        ("hold-out", context.holdout_names, fit.holdout),
    )
    for role, names, data in parts:
        for name, item in zip(names, data, strict=True):
            if item.rig is None:
                continue
            before = compute_errors(fit.nominal_refitted, [item], fit.nominal_instruments)[0]
            after = compute_errors(fit.chain, [item], fit.instruments)[0]
            first = np.unique(item.image, return_index=True)[1]
            for label in np.argsort(first):
                samples = np.flatnonzero(item.image == label)
                lines = item.rows[samples]
                out.append(
                    _Image(
                        number=len(out) + 1,
                        name=item.image_labels[label] or str(len(out) + 1),
                        source=f"{name}, {lines.min()}-{lines.max()}",
                        camera=item.rig.cameras[item.camera[samples[0]]],
                        role=role,
                        pixels=item.values[samples],
                        before=before["pixels"][samples],
                        after=after["pixels"][samples],
                        distance=np.linalg.norm(after["board"][samples].reshape(len(samples), -1), axis=1),
                    )
                )
    return out


def image_figures(context: ReportContext) -> list[FigureGroup]:
    """Draw the errors of corners over the images of each camera, of each image, and of the worst images."""
    images = _images(context)
    before, after = (np.array([se3.rms_length(e) for e in side]) for side in
                     ([i.before for i in images], [i.after for i in images]))  # fmt: skip
    text = (
        f"RMS error of the corners of {len(images)} images: median {np.median(before):.3g} px before, "
        f"{np.median(after):.3g} px after."
    )
    plot = partial(image_plots.plot_image_errors, before, after)
    legend = [LegendEntry(state, state, "dots") for state in ("before", "after")]
    groups = [
        FigureGroup(
            [Panel("image-errors", "Error of each image", text, plot)], "Images", legend=legend, layout="wide"
        )
    ]
    by_camera = {image.camera.name: image.camera for image in images}
    legend = [LegendEntry("corner", "sample", "dots"), LegendEntry("error", "after", "line")]
    panels = []
    for number, (name, camera) in enumerate(by_camera.items()):
        chosen = [image for image in images if image.camera.name == name]
        pixels, errors = (np.concatenate([getattr(i, key) for i in chosen]) for key in ("pixels", "after"))
        panels.append(_reprojection_panel(f"reprojection-{number}", f"Camera {name}", camera, pixels, errors))
    groups.append(FigureGroup(panels, "Errors of all corners", legend=legend, layout="wide"))
    worst = sorted(images, key=lambda image: -image.rms)[:MAX_DRAWN_IMAGES]
    panels = [
        _reprojection_panel(
            f"image-{image.number}",
            f"Image {image.name}: {image.rms:.3g} px",
            image.camera,
            image.pixels,
            image.after,
            _NARROW,
        )
        for image in worst
    ]
    groups.append(FigureGroup(panels, "Images with the largest errors", legend=legend))
    return groups


def _reprojection_panel(
    key: str, title: str, camera: Camera, pixels: Array, errors: Array, width: float = _WIDTH
) -> Panel:
    """Return the figure of corners of a camera with their errors."""
    large = max(float(np.percentile(np.linalg.norm(errors, axis=1), _LARGE_PERCENTILE)), 1e-9)
    magnification = round_down(_DRAWN_PART * camera.width / large)
    text = (
        f"{len(pixels)} corners in an image plane of {camera.width} x {camera.height} px, RMS error "
        f"{se3.rms_length(errors):.3g} px, drawn {magnification:g} times larger."
    )
    plot = partial(
        image_plots.plot_reprojection, pixels, errors, (camera.width, camera.height), magnification
    )
    height = (width - _BESIDE) * camera.height / camera.width + _BELOW
    return Panel(key, f"{title}, errors × {magnification:g}", text, plot, (width, height))
