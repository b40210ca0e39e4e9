"""Prior widths of lenses: how wrong the stated intrinsics are, from the images.

The prior of stated intrinsics is wide, so that a lens that is wrong by 5 % is found. If the stated values are
right, so wide a prior lets the lens imitate other errors, above all through the distortion near the border of
the image, where few corners are. The widths are therefore those of greatest evidence, see
`estimation.priors`: one for focal lengths and image centre of a camera, and one for its distortion.

An estimated lens that is far from the stated one is rather that of another resolution or of another camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..._typing import Array
from ...cameras.resolution import Resolution, describe_resolution, find_resolution, is_far
from ...cameras.rig import Camera
from ...estimation.priors import PriorGroup, PriorGroups
from ...estimation.problem import Problem
from ...measurements.base import Measurement
from ...measurements.camera import CameraCorners, change_images, select_images
from ..reweighting import Fit

# Narrowest prior as a fraction of the default one: half a pixel, and 0.003 for distortion.
MIN_LENS_WIDTH = 1e-2


def lens_prior_groups(problem: Problem) -> PriorGroups:
    """Group the values of the lenses that the rig states with a prior."""
    stated = {
        (f"camera_{camera.name}", unit)
        for item in select_images(problem.data)
        for camera in item.rig.cameras
        if camera.intrinsics == "prior"
        for unit in (("px", "1") if camera.has_intrinsics else ("1",))
    }
    n_errors = len(problem.errors.parameters)
    groups: dict[tuple[str, str], list[int]] = {}
    for i, parameter in enumerate(problem.instrument_parameters, n_errors):
        camera = parameter.name.rpartition(".")[0]
        if (camera, parameter.unit) in stated:
            groups.setdefault((camera, parameter.unit), []).append(i)
    weights = [1 / problem.instrument_parameters[each[0] - n_errors].prior for each in groups.values()]
    return tuple(
        PriorGroup(members, weight, weight, weight / MIN_LENS_WIDTH, 0.0)
        for members, weight in zip(groups.values(), weights, strict=True)
    )


def with_stated_distortion(data: Sequence[Measurement]) -> tuple[tuple[Measurement, ...], dict[str, float]]:
    """Centre the priors of distortion at the values of the rig, not at first values from the images."""
    first: dict[str, float] = {}
    out = []
    for item in data:
        if isinstance(item, CameraCorners):
            stated = {
                f"camera_{camera.name}.{name}": float(value)
                for camera in item.rig.cameras
                if camera.intrinsics == "prior"
                for name, value in zip(camera.lens.names, camera.values, strict=True)
                if name in camera.lens.coefficients
            }
            first |= {p.name: p.nominal for p in item.instrument_parameters if p.name in stated}
            item = item.with_values(stated)
        out.append(item)
    return tuple(out), first


def with_lens_priors(fit: Fit) -> Fit:
    """Return a fit whose measurements state the prior widths of its lenses, for fits of the nominal robot."""
    first = len(fit.problem.errors.parameters)
    prior = {
        p.name: 1 / weight
        for p, weight in zip(
            fit.problem.instrument_parameters, fit.problem.prior_weights[first:], strict=True
        )
        if p.unit in ("px", "1")
    }

    def with_priors(item: CameraCorners) -> CameraCorners:
        parameters = (replace(p, prior=prior.get(p.name, p.prior)) for p in item.instrument_parameters)
        return item.replace(instrument_parameters=tuple(parameters))

    return replace(fit, data=change_images(fit.data, with_priors))


def lens_values(camera: Camera, values: Mapping[str, float]) -> Array:
    """Return the values of the lens of a camera: those that are known by name, else the stated ones."""
    names = [f"camera_{camera.name}.{name}" for name in camera.lens.names]
    return np.array([values.get(name, v) for name, v in zip(names, camera.values, strict=True)])


def find_image_resolution(
    data: Sequence[Measurement], camera: Camera, values: Mapping[str, float]
) -> Resolution | None:
    """Find the resolution of the images or of the lens of a camera, if one of them is not the stated one."""
    corners = [
        item.values[item.camera == number]
        for item in select_images(data)
        for number, each in enumerate(item.rig.cameras)
        if each.name == camera.name
    ]
    return find_resolution(camera, lens_values(camera, values), np.concatenate(corners))


def describe_far_lenses(data: Sequence[Measurement], values: Mapping[str, float]) -> list[str]:
    """Describe each camera whose estimated lens is far from the stated one, and say what to do."""
    cameras = {camera.name: camera for item in select_images(data) for camera in item.rig.cameras}
    texts = []
    for camera in cameras.values():
        found = lens_values(camera, values)
        if resolution := find_image_resolution(data, camera, values):
            texts.append(
                f"The focal length of camera {camera.name!r} is {np.mean(found[:2] / camera.values[:2]):.2f} "
                "times the stated one, and its image centre as well: "
                f"{describe_resolution(camera, resolution)}. {resolution.remedy}"
            )
        elif is_far(camera, found):
            before, after = ([f"{v:.0f}" for v in each[:4]] for each in (camera.values, found))
            texts.append(
                f"The lens of camera {camera.name!r} is far from the stated one: fx, fy "
                f"{', '.join(after[:2])} px, not {', '.join(before[:2])} px, and cx, cy "
                f"{', '.join(after[2:])} px, not {', '.join(before[2:])} px. Check that the rig states the "
                "camera, its zoom and focus, and the resolution of these images."
            )
    return texts
