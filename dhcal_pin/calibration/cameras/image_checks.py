"""Whether images belong to the joint values and to the robot, and which joint ranges they show.

A rotation between two poses of the camera or of the board has the same angle as the rotation of the tool, for
any pose of both on the robot: in T·B and T'·B the tool turns by T⁻¹·T', and what is on it by B⁻¹·(T⁻¹·T')·B.
The angles that images show, each from the image alone, are compared with those of the nominal arm. Zeros that
are wrong by 15° in every joint change half of them by less than 4°; joint values of other images, wrong signs
or another robot by 10° to 60°.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..._typing import Array
from ...estimation.robust import ZERO_WEIGHT
from ...measurements.base import Measurement
from ...measurements.camera import CameraCorners
from ...robot.chain import Chain
from ..partition import different_configurations
from ..reweighting import Fit
from .sets import describe_configurations
from .stages import fitted_error

# Median difference of the angles from which images are unrelated [rad], and smallest and largest number of
# images that are compared.
MIN_DIFFERENCE, MIN_IMAGES, MAX_IMAGES = np.deg2rad(10.0), 6, 200
# Shifts of the joint values by rows that are a mistake of their own, and are named as such.
SHIFTS = (-2, -1, 1, 2)
# Share of outliers above which a fit says nothing.
MAX_IMAGE_OUTLIER_SHARE = 0.5


def find_unrelated_images(fit: Fit, chain: Chain, max_error: float) -> str:
    """Return what shows that images are not those of the joint values or robot of a fit, else nothing.

    A fit whose corners are within `max_error` [px] of the model, and not mostly rejected, is not questioned.
    """
    rejected = np.concatenate([weights <= ZERO_WEIGHT for weights in fit.weights])
    if fitted_error(fit).pixels <= max_error and rejected.mean() <= MAX_IMAGE_OUTLIER_SHARE:
        return ""
    images = [item for item in fit.data if isinstance(item, CameraCorners)]
    if len(images) < len(fit.data):
        return ""
    differences = [_angle_difference(chain, item) for item in images]
    if min(differences) < MIN_DIFFERENCE:
        return ""
    stated = describe_configurations(fit.data)
    return (
        f"The boards in the images do not move as the {stated} say: the rotations between images differ by "
        f"{np.degrees(min(differences)):.0f}° (median) from those of the robot, wherever camera and board "
        f"are. Use the {stated} of the same images with right units, signs and order, and the URDF of the "
        "robot in the images."
    )


def _angle_difference(chain: Chain, item: CameraCorners) -> float:
    """Return the median difference of angles between images and robot [rad], for the best shift of rows.

    It is zero if there are too few images.
    """
    shown = item.tool_poses()
    # Consecutive images, so that shifts can be seen.
    shown = shown.take(np.arange(min(len(shown.rows), MAX_IMAGES)))
    n = len(shown.rows)
    if n < MIN_IMAGES:
        return 0.0
    of_robot, of_images = _angles(chain.poses(shown.q)), _angles(shown.poses)
    places = np.arange(n)
    differences = []
    for shift in (0, *SHIFTS):
        inside = places[(places + shift >= 0) & (places + shift < n)]
        pairs = of_robot[np.ix_(inside + shift, inside + shift)] - of_images[np.ix_(inside, inside)]
        differences.append(np.median(np.abs(pairs[np.triu_indices(len(inside), 1)])))
    return float(min(differences))


def _angles(poses: Array) -> Array:
    """Return the angles of the rotations between poses (n, 4, 4), shape (n, n) [rad]."""
    rotations = poses[:, :3, :3]
    trace = np.einsum("aij,bij->ab", rotations, rotations)
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


# Share of the range of a joint below which a warning names it, and largest number of joints that it names.
MIN_SHARE, MAX_JOINTS = 0.5, 3


def small_ranges(chain: Chain, data: Sequence[Measurement]) -> list[str]:
    """List the joints that moved in a small part of their range, with their values, smallest part first."""
    q = different_configurations(data)[0]
    limit = np.where(chain.is_prismatic, np.inf, np.pi)
    ranges = np.minimum(chain.upper, limit) - np.maximum(chain.lower, -limit)
    low, high = q.min(0), q.max(0)
    shares = (high - low) / ranges
    few = [int(i) for i in np.argsort(shares, kind="stable") if shares[i] < MIN_SHARE and ranges[i] < np.inf]
    return [
        f"{chain.joint_names[i]} {1e3 * low[i]:.0f} to {1e3 * high[i]:.0f} mm"
        if chain.is_prismatic[i]
        else f"{chain.joint_names[i]} {np.rad2deg(low[i]):.0f}° to {np.rad2deg(high[i]):.0f}°"
        for i in few
    ]


def seen_ranges_warning(chain: Chain, data: Sequence[Measurement]) -> str:
    """Warn of joints that moved in a small part of their range only."""
    names = small_ranges(chain, data)
    if not names:
        return ""
    more = f", and {len(names) - MAX_JOINTS} more" if len(names) > MAX_JOINTS else ""
    count = "a joint" if len(names) == 1 else f"{len(names)} joints"
    return (
        f"The images show less than half of the range of {count}: {', '.join(names[:MAX_JOINTS])}{more}. "
        "Outside of what they show, the corrections of the arm are not verified."
    )
