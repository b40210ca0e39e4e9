"""Exchanged axes of images: fx with fy, or cx with cy, or width with height, or u with v.

Programs differ in the order in which they write image axes, and rows and columns of an array are v and u.
Exchanged values look like an error of the arm of many pixels, and no prior of the intrinsics reaches the
right ones. Each camera is therefore calibrated alone, with the nominal arm and fixed intrinsics, as they are
stated and in every other order. Another order is taken if it explains the images far better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ...._frozen import frozen
from ...._typing import Array
from ....estimation.error_model import ErrorModel
from ....estimation.problem import Problem, merge_instrument_parameters
from ....estimation.solver import minimize
from ....exceptions import DhcalError
from ....measurements.base import Measurement
from ....measurements.camera import CameraCorners, change_images, select_images
from ....robot.chain import Chain
from ...reweighting import Fit
from ..stages import ImageError, Stage, fitted_error


@frozen
class AxisOrder:
    """Order of the values of a camera and of its image coordinates."""

    intrinsics: tuple[int, ...] = (0, 1, 2, 3)  # Order of fx, fy, cx, cy
    pixels: tuple[int, ...] = (0, 1)  # Order of u, v
    place: str = "rig file"  # Where the exchanged values are written
    min_error: float = 2.0  # Error of the stated order from which this one is tried [px]


# Orders besides the stated one, by what they exchange. Exchanged image coordinates make mirror images, whose
# error is large.
ORDERS = {
    "fx and fy": AxisOrder((1, 0, 2, 3)),
    "cx and cy": AxisOrder((0, 1, 3, 2)),
    "fx and fy, and cx and cy": AxisOrder((1, 0, 3, 2)),
    "u and v": AxisOrder(pixels=(1, 0), place="measurements", min_error=20.0),
}
# Smallest change of a value that is tried [px].
MIN_CHANGE = 5.0
# Largest ratio of the errors for which another order is taken, and largest error with it as a fraction of the
# size of the image: no order explains images that are paired with wrong joint values.
MAX_RATIO, MAX_ERROR_SHARE = 0.5, 0.05
# Largest number of iterations of one solution, and of corners and images of a camera that are compared.
_MAX_ITERATIONS, _MAX_CORNERS, _MAX_IMAGES = 30, 2000, 100


@frozen
class Exchange:
    """Values of a camera that are exchanged in the rig, or image coordinates in the measurements."""

    camera: str
    what: str
    stated: ImageError | None  # Error with the values as they are stated
    exchanged: ImageError | None  # Error with the exchanged values; None if it is the size of the images
    unknowns: int = 0  # Number of unknowns of the comparison

    @property
    def sentence(self) -> str:
        """What is exchanged, how it was found, and what to do about it."""
        place = ORDERS.get(self.what, AxisOrder()).place
        start = f"camera {self.camera!r}: {self.what} are exchanged in the {place}"
        if self.stated is None or self.exchanged is None:
            return f"{start}: corners lie outside its images, and inside if they are exchanged. Correct them."
        return (
            f"{start}: with fixed intrinsics the images differ by {self.stated.pixels:.3g} px as stated, and "
            f"by {self.exchanged.pixels:.3g} px if they are exchanged. The exchanged values are used; "
            "correct them."
        )


def exchange_axes(
    chain: Chain, data: Sequence[Measurement]
) -> tuple[tuple[Measurement, ...], tuple[Exchange, ...]]:
    """Find exchanged values of cameras, and put intrinsics into the order that explains the images."""
    out = tuple(data)
    found: list[Exchange] = []
    names = dict.fromkeys(camera.name for item in select_images(data) for camera in item.rig.cameras)
    for name in names:
        best = _best_order(chain, _images_of(data, name), name)
        if best is not None:
            found.append(best)
            out = reorder(out, [best])
        if _is_size_exchanged(_images_of(out, name), name):
            found.append(Exchange(name, "width and height", None, None))
    return out, tuple(found)


def reorder(data: Sequence[Measurement], exchanges: Sequence[Exchange]) -> tuple[Measurement, ...]:
    """Exchange the same values of the cameras of measurements."""
    out = tuple(data)
    for exchange in exchanges:
        if exchange.what in ORDERS:
            out = change_images(out, partial(_reordered, exchange.camera, ORDERS[exchange.what]))
    return out


def axis_stages(exchanges: Sequence[Exchange]) -> tuple[Stage, ...]:
    """Return the stages of exchanged intrinsics: their errors are those of the values as they are stated."""
    return tuple(
        Stage("axis order", True, each.unknowns, each.stated, None, None, each.sentence)
        for each in exchanges
        if each.stated is not None
    )


def _images_of(data: Sequence[Measurement], name: str) -> list[CameraCorners]:
    """Return the images of one camera in measurements."""
    out = []
    for item in select_images(data):
        numbers = [i for i, camera in enumerate(item.rig.cameras) if camera.name == name]
        mask = np.isin(item.camera, numbers)
        out += [item.take(mask)] if mask.any() else []
    return out


def _is_size_exchanged(parts: Sequence[CameraCorners], name: str) -> bool:
    """Return whether corners lie outside the images, and all inside if width and height are exchanged."""
    values = np.concatenate([np.empty((0, 2)), *(part.values for part in parts)])
    for part in parts:
        camera = next(camera for camera in part.rig.cameras if camera.name == name)
        size = np.array([camera.width, camera.height])
        return bool(np.any(values > size)) and bool(np.all(values <= size[::-1]))
    return False


def _best_order(chain: Chain, parts: Sequence[CameraCorners], name: str) -> Exchange | None:
    """Return the exchange that explains the images of a camera far better."""
    cameras = [camera for part in parts for camera in part.rig.cameras if camera.name == name]
    if not cameras or not cameras[0].has_intrinsics:
        return None
    stated = _frames_error(chain, parts)
    if stated is None:
        return None
    values, errors = cameras[0].values[:4], {}
    for what, order in ORDERS.items():
        changed = [i for i, other in enumerate(order.intrinsics) if other != i]
        is_change = np.all(np.abs(values[list(order.intrinsics)] - values)[changed] > MIN_CHANGE)
        if is_change and stated[0].pixels >= order.min_error:
            found = _frames_error(chain, [_reordered(name, order, part) for part in parts])
            if found is not None:
                errors[what] = found[0]
    what = min(errors, key=lambda each: errors[each].pixels, default="")
    size = max(cameras[0].width, cameras[0].height)
    if not what or errors[what].pixels > min(MAX_RATIO * stated[0].pixels, MAX_ERROR_SHARE * size):
        return None
    return Exchange(name, what, stated[0], errors[what], stated[1])


def _frames_error(chain: Chain, parts: Sequence[CameraCorners]) -> tuple[ImageError, int] | None:
    """Return the error of images with fixed intrinsics and the nominal arm, and the number of unknowns."""
    try:
        data = tuple(_thinned(part).initialized(chain) for part in parts)
    except DhcalError:  # the images do not determine the poses
        return None
    known = {
        p.name: p.nominal
        for item in data
        for p in item.instrument_parameters
        if item.set_of(p.name) not in ("camera", "board")
    }
    unknown = [p for p in merge_instrument_parameters(data) if p.name not in known]
    weights: Array = np.array([1 / p.prior for p in unknown])
    problem = Problem(ErrorModel(chain, ()), data, weights, known)
    solution = minimize(problem, "lm", None, _MAX_ITERATIONS, loose=True)
    fit = Fit(data, problem, solution, tuple(np.ones(len(item.rows)) for item in data))
    return fitted_error(fit), len(unknown)


def _thinned(item: CameraCorners) -> CameraCorners:
    """Return a limited number of images and corners."""
    n_kept = min(item.n_images * _MAX_CORNERS // len(item.rows), _MAX_IMAGES)
    if n_kept >= item.n_images:
        return item
    chosen = np.unique(np.linspace(0, item.n_images - 1, max(n_kept, 10)).astype(int))
    return item.take(np.isin(item.image, chosen))


def _reordered(name: str, order: AxisOrder, item: CameraCorners) -> CameraCorners:
    """Return a measurement with another order of the values of a camera."""
    cameras, values = [], {}
    pixels, sigma = item.values.copy(), item.sigma.copy()
    for number, camera in enumerate(item.rig.cameras):
        if camera.name == name:
            of_camera = item.camera == number
            pixels[of_camera] = pixels[of_camera][:, order.pixels]
            sigma[of_camera] = sigma[of_camera][:, order.pixels]
            lens = np.concatenate([camera.values[list(order.intrinsics)], camera.values[4:]])
            values = {f"camera_{name}.{key}": v for key, v in zip(camera.lens.names, lens, strict=True)}
            camera = replace(camera, values=lens)
        cameras.append(camera)
    exchanged = item.replace(values=pixels, sigma=sigma)
    return exchanged.with_rig(replace(item.rig, cameras=tuple(cameras))).with_values(values)
