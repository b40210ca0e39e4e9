"""Stated poses of cameras and boards that contradict the images, such as inverse ones.

The pose of a camera in its link is easily stated the other way round, as that of the link in the camera. A
stated pose that is estimated is only a first value, but from a wrong one a fit can end in the mirror image of
a lens, with a negative focal length. The images alone give other first values (`camera_start`). If these
explain the images far better, the stated poses are not used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .... import se3
from ...._frozen import frozen
from ...._typing import Array
from ....exceptions import DhcalError
from ....formatting import format_quantity
from ....measurements.base import Measurement, errors_of
from ....measurements.camera import CameraCorners, change_images, select_images
from ....measurements.images.camera_parameters import POSE_NAMES
from ....robot.chain import Chain

# Ratio of the median errors of the first values from which stated poses are not used, and smallest error of
# stated ones as a fraction of the size of the image.
MIN_RATIO, MIN_ERROR_SHARE = 3.0, 0.05
# Difference from the inverse of a stated pose below which the stated one is inverse: rotation [rad], or
# distance relative to that from the link.
MAX_INVERSE_DIFFERENCE = 0.3
# Distances from the link below this one count as this [m].
_MIN_DISTANCE = 0.1


@frozen(eq=False)
class PoseDifference:
    """Stated pose of a camera or a board in its link, and the one in the images."""

    entry: str  # Beginning of the names of its parameters, such as "camera_wrist"
    stated: Array  # (4, 4) [m]
    found: Array  # (4, 4) [m]

    @property
    def is_inverse(self) -> bool:
        """Whether the stated pose is the inverse of the one in the images."""
        inverse = _relative_difference(se3.inverse(self.stated), self.found)
        return inverse < MAX_INVERSE_DIFFERENCE < self.size

    @property
    def name(self) -> str:
        """Name for people, such as camera 'wrist'."""
        kind, _, name = self.entry.partition("_")
        return f"{kind} {name!r}"

    @property
    def size(self) -> float:
        """Rotation between both poses [rad], or their distance relative to that from the link, if larger."""
        return _relative_difference(self.stated, self.found)

    @property
    def remedy(self) -> str:
        """What to do about the stated pose."""
        kind = self.entry.partition("_")[0]
        if self.is_inverse:
            return f"State the pose of the {kind} in its link (xyz_m and rotvec_rad in the rig file)."
        return f"Correct xyz_m and rotvec_rad of the {kind} in the rig file."

    @property
    def text(self) -> str:
        """How the stated pose differs, as a clause."""
        if self.is_inverse:
            kind = self.entry.partition("_")[0]
            return f"the stated pose of {self.name} is inverse, of its link in the {kind}"
        change = se3.inverse(self.stated) @ self.found
        distance, angle = (
            float(np.linalg.norm(vector)) for vector in (change[:3, 3], se3.log3(change[:3, :3]))
        )
        return (
            f"the stated pose of {self.name} is {format_quantity(distance, 'm', 0.03 * distance)} and "
            f"{format_quantity(angle, 'rad', 0.03 * angle)} from the one in the images"
        )

    @property
    def sentence(self) -> str:
        """What is wrong, and what to do about it."""
        return f"{self.text}; the pose in the images is used. {self.remedy}"


def _relative_difference(first: Array, second: Array) -> float:
    """Return the rotation between two poses [rad], or their distance relative to that from the link."""
    angle = np.linalg.norm(se3.log3(first[:3, :3].T @ second[:3, :3]))
    distance = np.linalg.norm(first[:3, 3] - second[:3, 3])
    return float(max(angle, distance / max(np.linalg.norm(second[:3, 3]), _MIN_DISTANCE)))


def free_wrong_poses(
    chain: Chain, data: Sequence[Measurement], holdout: Sequence[Measurement], sets: Sequence[str]
) -> tuple[tuple[Measurement, ...], tuple[PoseDifference, ...]]:
    """Remove stated poses of some sets that contradict the images from all measurements."""
    both, images = (*data, *holdout), select_images(data)
    entries = [entry for entry in stated_poses(images) if entry.partition("_")[0] in sets]
    if not entries:
        return both, ()
    try:
        freed = [item.without_poses(entries).initialized(chain) for item in images]
    except DhcalError:  # the images do not determine the poses
        return both, ()
    size = max(max(camera.width, camera.height) for item in images for camera in item.rig.cameras)
    stated = _start_error(chain, [item.initialized(chain) for item in images])
    if stated < max(MIN_ERROR_SHARE * size, MIN_RATIO * _start_error(chain, freed)):
        return both, ()
    values = {p.name: p.nominal for item in freed for p in item.instrument_parameters}
    differences = pose_differences(images, values, entries)
    return change_images(both, lambda item: item.without_poses(entries)), differences


def held_entries(data: Sequence[Measurement], known: Mapping[str, float]) -> list[str]:
    """List the cameras and boards whose stated poses are held."""
    return [entry for entry in stated_poses(select_images(data)) if f"{entry}.x" in known]


def pose_differences(
    images: Sequence[CameraCorners], values: Mapping[str, float], entries: Sequence[str]
) -> tuple[PoseDifference, ...]:
    """Compare the stated poses of cameras and boards with those of parameter values by name."""
    stated = stated_poses(images)
    return tuple(
        PoseDifference(entry, stated[entry], se3.transform(se3.exp3(vector[3:]), vector[:3]))
        for entry in entries
        if np.isfinite(vector := np.array([values.get(f"{entry}.{n}", np.nan) for n in POSE_NAMES])).all()
    )


def stated_poses(images: Sequence[CameraCorners]) -> dict[str, Array]:
    """Return the stated poses of cameras and boards, by the beginnings of the names of their parameters."""
    return {
        f"{kind}_{entry.name}": entry.pose
        for item in images
        for kind, group in (("camera", item.rig.cameras), ("board", item.rig.boards))
        for entry in group
        if entry.pose is not None
    }


def _start_error(chain: Chain, images: Sequence[CameraCorners]) -> float:
    """Return the median distance of corners from those of the first values of their parameters [px]."""
    distances = [
        np.linalg.norm(
            errors_of(item, chain, {p.name: p.nominal for p in item.instrument_parameters})["pixels"], axis=1
        )
        for item in images
    ]
    return float(np.median(np.nan_to_num(np.concatenate(distances), nan=np.inf)))
