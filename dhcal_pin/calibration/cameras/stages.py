"""Stages of a calibration from images: which unknowns were freed in turn, and what each of them improved.

The stages in their order are "axis order" (exchanged axes of the intrinsics), "frames" (poses of cameras and
boards), "intrinsics" (lenses), "target points" (corners of the boards) and "arm" (errors of the arm). Each
stage is judged on images that its fit did not see: on random ones, and on whole regions of joint space.
Random images lie between fitted ones, and a wrong model may predict them well. Regions show whether the model
holds elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from ..._frozen import frozen
from ..._typing import Array
from ...estimation.folds import Fold, factor_partition, solve_columns
from ...measurements.base import errors_of
from ...measurements.camera import CameraCorners
from ..reweighting import Fit


@frozen
class ImageError:
    """Error of corners in images."""

    pixels: float  # RMS distance between the measured and the modelled corner in the image [px]
    # RMS distance of the corner from the line of sight through its measured image, at the board [m].
    distance: float
    n_corners: int  # Number of corners


@frozen
class Stage:
    """Accuracy after one more group of unknowns was freed."""

    name: str  # One of the stages above
    is_kept: bool  # Whether the unknowns of this stage are free in the result
    n_unknowns: int  # Number of unknowns of the fit of this stage
    fitted: ImageError  # Error of the fitted images
    by_image: ImageError | None  # Error of random images that were held out; None if there are too few
    # Error of regions of joint space that were held out; None if there are too few images.
    by_region: ImageError | None
    reason: str  # Sentence that says why the unknowns are free or held

    def to_dict(self) -> dict[str, Any]:
        """Return the content for the JSON document."""
        keys = {"pixels": "residual_rms_px", "distance": "board_rms_m", "n_corners": "corners"}
        out = {"stage": self.name, "kept": self.is_kept, "unknowns": self.n_unknowns, "reason": self.reason}
        for name in ("fitted", "by_image", "by_region"):
            error = getattr(self, name)
            out[name] = error and {keys[key]: value for key, value in asdict(error).items()}
        return out


def format_ratio(ratio: float) -> str:
    """Format an error relative to another one.

    >>> format_ratio(1.138), format_ratio(0.0213)
    ('114 %', '2.1 %')
    """
    return f"{100 * ratio:.0f} %" if ratio >= 0.1 else f"{100 * ratio:.2g} %"


def fitted_error(fit: Fit) -> ImageError:
    """Compute the error of the fitted images that are not outliers."""
    return _image_error(fit, [(fit.solution.x, [np.ones(len(item.rows), bool) for item in fit.data])])


def held_out_error(fit: Fit, folds: Sequence[Fold]) -> ImageError | None:
    """Compute the error of images under fits of the other images, by one step from the fit of all."""
    if not folds:
        return None
    problem, x = fit.problem, fit.solution.x
    columns = np.ones(len(x), bool)
    systems = factor_partition(problem, x, folds)
    return _image_error(
        fit,
        [
            (x + solve_columns(system.fitted, problem.weights, x, columns)[0], fold)
            for fold, system in zip(folds, systems, strict=True)
        ],
    )


def held_out_prediction_std(fit: Fit, folds: Sequence[Fold]) -> float:
    """Compute the error of images that the uncertainty of fits of the other images causes."""
    columns = np.ones(len(fit.solution.x), bool)
    systems = tuple(factor_partition(fit.problem, fit.solution.x, folds))
    variances = [system.prediction_std(fit.problem.weights, columns) ** 2 for system in systems]
    return float(np.sqrt(np.average(variances, weights=[system.n_rows for system in systems])))


def _image_error(fit: Fit, parts: Sequence[tuple[Array, Sequence[Array]]]) -> ImageError:
    """Compute the error of parts of the images, each at its own solution x (p,)."""
    problem, squares, distances, count = fit.problem, 0.0, 0.0, 0
    for x, fold in parts:
        chain = problem.chain(x)
        for item, mask, weights in zip(fit.data, fold, fit.weights, strict=True):
            if isinstance(item, CameraCorners):
                errors = errors_of(item.take(mask & (weights > 0.5)), chain, problem.instruments(x))
                squares += float(np.sum(errors["pixels"] ** 2))
                distances += float(np.sum(errors["board"] ** 2))
                count += len(errors["pixels"])
    squares, distances = squares / max(count, 1), distances / max(count, 1)
    return ImageError(float(np.sqrt(squares)), float(np.sqrt(distances)), count)
