"""Whether images belong to the joint values and to the robot, and what they show of joints and poses.

A rotation between two poses of the camera or of the board has the same angle as the rotation of the tool, for
any pose of both on the robot: in T·B and T'·B the tool turns by T⁻¹·T', and what is on it by B⁻¹·(T⁻¹·T')·B.
The angles that images show, each from the image alone, are compared with those of the nominal arm. Zeros that
are wrong by 15° in every joint change half of them by less than 4°; joint values of other images, wrong signs
or another robot by 10° to 60°.

If the tool keeps its orientation in all images, camera and board can move by any common displacement against
the arm, and no image changes. With small rotations φ of the tool, an error e at the board displaces them by
e/φ. Errors of the arm can imitate another pose of the tool, too, such as another length of the last link.
Rotations do not help, but camera and board are right relative to the calibrated arm all the same. This part
of their covariance is that of the priors (`tool_gauge_covariance`), and is subtracted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import comb

import numpy as np

from ... import se3
from ..._typing import Array
from ...estimation.frame_gauge import tool_gauge_covariance
from ...estimation.robust import ZERO_WEIGHT
from ...estimation.uncertainty import Uncertainty
from ...formatting import Quantity
from ...measurements.base import Measurement
from ...measurements.camera import CameraCorners, select_images
from ...measurements.images.names import whole_images
from ...measurements.mounting import Mount, MountedRig
from ...plausibility.evidence import usual_errors
from ...plausibility.mixups import diagnose_images
from ...robot.chain import Chain
from ..partition import different_configurations
from ..reweighting import Fit
from .causes import file_sequence, places_in_sequence
from .sets import describe_configurations
from .stages import fitted_error

# Median difference of the angles from which images are unrelated [rad], and smallest and largest number of
# images that are compared.
MIN_DIFFERENCE, MIN_IMAGES, MAX_IMAGES = np.deg2rad(10.0), 6, 200
# Shifts of the joint values by rows that are a mistake of their own, and are named as such.
SHIFTS = (-2, -1, 1, 2)
# Outlying images at an end of a file are named if images that are wrong at random are there with a lower
# probability.
MAX_CHANCE = 1e-3
# Smallest share of outliers among them: after a motion, few images agree by chance.
MIN_OUTLYING_SHARE = 0.8
# Share of outliers above which a fit says nothing.
MAX_IMAGE_OUTLIER_SHARE = 0.5
# RMS rotation about the second axis [rad] below which an error of the arm displaces the camera far more than
# the images show, and the ratio of both errors at this rotation.
MIN_ROTATION = np.deg2rad(8.0)
MAX_ERROR_RATIO = 1 / MIN_ROTATION
# Rotation about a second axis that is none [rad].
NO_ROTATION = 1e-4
# Smaller errors at the board count as this one [m]: those of simulated images without noise are rounding.
MIN_BOARD_ERROR = 1e-6
# What to do about too few rotations.
MORE_ROTATIONS = "Add images that are turned by 30° or more about two axes that are not parallel."


def find_unrelated_images(fit: Fit, holdout: Sequence[Measurement], chain: Chain, max_error: float) -> str:
    """Return what shows that images are not those of the joint values or robot of a fit, else nothing."""
    rejected = np.concatenate([weights <= ZERO_WEIGHT for weights in fit.weights])
    # Corners within `max_error` [px] of the model, and not mostly rejected, are not questioned.
    if fitted_error(fit).pixels <= max_error and rejected.mean() <= MAX_IMAGE_OUTLIER_SHARE:
        return ""
    images = select_images(fit.data)
    if len(images) < len(fit.data):
        return ""
    differences = [
        _angle_difference(
            chain, item, file_sequence([item, *(held for held in holdout if held.source == item.source)])
        )
        for item in images
    ]
    if min(differences) < MIN_DIFFERENCE:
        return ""
    stated = describe_configurations(fit.data)
    return (
        f"The boards in the images do not move as the {stated} say: the rotations between images differ by "
        f"{np.degrees(min(differences)):.0f}° (median) from those of the robot, wherever camera and board "
        f"are. Use the {stated} of the same images with right units, signs and order, and the URDF of the "
        "robot in the images, and check the resolution and the lens that the rig states."
    )


def find_wrong_joint_values(fit: Fit) -> str:
    """Return what is wrong with the joint values of a fit of images alone, if a mistake explains them."""
    images, chain = select_images(fit.data), fit.problem.errors.chain
    if len(images) < len(fit.data):
        return ""
    found = diagnose_images(chain, images, usual_errors(chain, images))
    return found.sentence if found.hypotheses else ""


def _angle_difference(chain: Chain, item: CameraCorners, sequence: Array) -> float:
    """Return the median difference of angles between images and robot [rad], for the best shift of rows."""
    # The sequence (k, n) has the joint values of all images of the file. The result is 0 with few images.
    samples, poses = (each[:MAX_IMAGES] for each in item.shown_poses)
    if len(samples) < MIN_IMAGES:
        return 0.0
    of_images, places = _angles(poses), places_in_sequence(sequence, item.q[samples])
    differences = []
    for shift in (0, *SHIFTS):
        inside = np.flatnonzero((places + shift >= 0) & (places + shift < len(sequence)))
        of_robot = _angles(chain.poses(sequence[places[inside] + shift]))
        pairs = of_robot - of_images[np.ix_(inside, inside)]
        differences.append(np.median(np.abs(pairs[np.triu_indices(len(inside), 1)])))
    return float(min(differences))


def _angles(poses: Array) -> Array:
    """Return the angles of the rotations between poses (n, 4, 4), shape (n, n) [rad]."""
    rotations = poses[:, :3, :3]
    return se3.angles_of_traces(np.einsum("aij,bij->ab", rotations, rotations))


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


def largest_position_std(names: Sequence[str], covariance: Array) -> float:
    """Return the largest standard deviation of the position of any camera or board in any direction [m]."""
    first = [name for name in names if name.startswith(("camera_", "board_")) and name.endswith(".x")]
    return _largest_std([_position_block(name.removesuffix(".x"), names, covariance) for name in first])


def largest_tool_std(
    rig: MountedRig, names: Sequence[str], covariance: Array, priors: Uncertainty
) -> float | None:
    """Return the largest standard deviation of the position of a camera or board relative to the tool [m]."""
    gauge, blocks = tool_gauge_covariance(priors), []
    for entry, mount, pose in _entries(rig):
        if mount.moves and f"{entry}.x" in names:
            link_pose = mount.link_pose
            axes = link_pose[:3, :3]
            by_tool = np.concatenate([np.eye(3), -se3.skew(link_pose[:3, 3] + axes @ pose[:3, 3])], 1)
            # What errors of the arm with these `priors` imitate is not contained.
            imitated = axes.T @ by_tool @ gauge @ by_tool.T @ axes
            blocks.append(_position_block(entry, names, covariance) - imitated)
    return _largest_std(blocks) if blocks else None


def largest_fixed_std(rig: MountedRig, names: Sequence[str], covariance: Array) -> float | None:
    """Return the largest standard deviation of the position of a camera or board that stands still [m]."""
    # Such positions are in the measuring frame.
    blocks = [
        _position_block(entry, names, covariance)
        for entry, mount, _ in _entries(rig)
        if not mount.moves and f"{entry}.x" in names
    ]
    return _largest_std(blocks) if blocks else None


def _entries(rig: MountedRig) -> Iterator[tuple[str, Mount, Array]]:
    """Yield the prefix of the names, the mount, and the pose of each camera and board whose pose is known."""
    for kind, entries, mounts in (
        ("camera", rig.cameras, rig.camera_mounts),
        ("board", rig.boards, rig.board_mounts),
    ):
        for entry, mount in zip(entries, mounts, strict=True):
            if entry.pose is not None:
                yield f"{kind}_{entry.name}", mount, entry.pose


def _position_block(entry: str, names: Sequence[str], covariance: Array) -> Array:
    """Return the covariance (3, 3) of the position of a camera or a board."""
    position = [names.index(f"{entry}.{axis}") for axis in "xyz"]
    return covariance[np.ix_(position, position)]


def _largest_std(blocks: Sequence[Array]) -> float:
    """Return the largest standard deviation in any direction of positions with these covariances (3, 3)."""
    if not all(np.isfinite(block).all() for block in blocks):
        return np.inf
    return float(np.sqrt(max([0.0, *(np.linalg.eigvalsh(block)[-1] for block in blocks)])))


def second_rotation(chain: Chain, data: Sequence[Measurement]) -> float:
    """Return the RMS rotation of the tool about the axis with the second largest rotation [rad]."""
    q = np.unique(np.concatenate([item.q for item in select_images(data)]), axis=0)
    rotations = chain.poses(q)[:, :3, :3]
    mean = se3.nearest_rotation(rotations.mean(0))
    turns = np.array([se3.log3(mean.T @ rotation) for rotation in rotations])
    return float(np.linalg.svd(turns, compute_uv=False)[1] / np.sqrt(len(turns)))


def describe_rotation(rotation: float) -> str:
    """Say how far the tool turned about a second axis [rad]."""
    if rotation <= NO_ROTATION:
        return "the tool never turned about a second axis"
    return f"the tool turned by {np.degrees(rotation):.2g}° (RMS) about a second axis"


def describe_weak_positions(std: float, error: float, rotation: float) -> str:
    """Say that the images do not determine camera and board relative to the arm; empty if they do."""
    # `std` [m] is that of these positions, `error` [m] that at the board, `rotation` [rad] that about the
    # second axis.
    if std <= MAX_ERROR_RATIO * max(error, MIN_BOARD_ERROR):
        return ""
    size = f"have a standard deviation of {Quantity.error(std, 'm')}" if np.isfinite(std) else "are unknown"
    found = f"The positions of camera and board relative to the arm {size}, and the images do not show it: "
    found += f"the error at the board is {Quantity.error(error, 'm')}."
    if rotation >= MIN_ROTATION:
        return f"Too few images. {found} Take more images."
    return f"Too few rotations: {describe_rotation(rotation)}. {found} {MORE_ROTATIONS}"


def describe_outlying_end(parts: Sequence[tuple[Measurement, Array]], has_holdout: bool) -> list[str]:
    """Say that the images of a camera from some image on, or up to one, are outliers, as after a motion.

    Each part of a file, fitted or held out, has a mask (m,) of the samples that are no outliers.
    """
    texts = []
    for (_, camera), images in _images_of_cameras(parts).items():
        ordered = sorted(images)
        for which, motion, each in (("last", "before", ordered[::-1]), ("first", "after", ordered)):
            count, n_outlying, chance = _outlying_end([outlying for _, _, outlying in each])
            if n_outlying < 2 or n_outlying < MIN_OUTLYING_SHARE * count or chance > MAX_CHANCE:
                continue
            labels = sorted(each[:count])
            part = f"{n_outlying} of the {which}" if n_outlying < count else f"the {which}"
            name = f" ({labels[0][1]} to {labels[-1][1]})" if labels[0][1] and labels[-1][1] else ""
            remedy = "Check both, and take the images again."
            if has_holdout:
                remedy = "Calibrate without hold-out images: a motion that enough images show is estimated."
            texts.append(
                f"All corners of {part} {count} images of camera {camera!r}{name} are outliers: camera "
                f"or board may have moved {motion} them. The result holds for the other images. {remedy}"
            )
    return texts


def _outlying_end(is_outlying: Sequence[bool]) -> tuple[int, int, float]:
    """Return how many images precede the change point, how many of them are outliers, and a probability.

    The change point separates outliers from other images with the fewest exceptions. The probability is that
    of as many outliers before it, or more, if the outliers were at random places.
    """
    n_images, n_outliers = len(is_outlying), sum(is_outlying)
    found = np.cumsum(is_outlying)
    count = 1 + int(np.argmax(2 * found - np.arange(1, n_images + 1)))
    ways = sum(
        comb(n_outliers, n) * comb(n_images - n_outliers, count - n)
        for n in range(int(found[count - 1]), min(count, n_outliers) + 1)
    )
    return count, int(found[count - 1]), ways / comb(n_images, count)


def count_outlying_images(parts: Sequence[tuple[Measurement, Array]]) -> list[tuple[str, int, int]]:
    """Count the images of each of several cameras all of whose corners are outliers, and all of its images.

    Each part of a file has a mask (m,) of the samples that are no outliers. One camera has no count.
    """
    counts: dict[str, list[int]] = {}
    for (_, camera), images in _images_of_cameras(parts).items():
        count = counts.setdefault(camera, [0, 0])
        count[0] += sum(is_outlying for _, _, is_outlying in images)
        count[1] += len(images)
    return (
        [(name, n_outliers, n_images) for name, (n_outliers, n_images) in counts.items()]
        if len(counts) > 1
        else []
    )


def _images_of_cameras(
    parts: Sequence[tuple[Measurement, Array]],
) -> dict[tuple[str, str], list[tuple[int, str, bool]]]:
    """Return first line, label and whether all corners are outliers of each image, by file and camera."""
    out: dict[tuple[str, str], list[tuple[int, str, bool]]] = {}
    for item, is_counted in parts:
        if not isinstance(item, CameraCorners):
            continue
        outlying = set(whole_images(item.image, ~is_counted))
        for number, first in enumerate(np.unique(item.image, return_index=True)[1]):
            camera = item.rig.cameras[item.camera[first]].name
            image = int(item.rows[first]), item.image_labels[number], number in outlying
            out.setdefault((item.source, camera), []).append(image)
    return out
