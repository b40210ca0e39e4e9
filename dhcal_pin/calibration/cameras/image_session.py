"""What happened while photographs were taken.

Each image shows the pose of the moving one of camera and board in the other one, without the joint values.
These poses are measurements of the same robot with a base pose B and a tool pose T of their own; a change of
the base is a motion of the one that stands still, a change of the tool a motion of the one on the robot. The
images have the base pose B' and the tool pose T'. A motion C of the base and D of the tool are there

    C' = M·C·M⁻¹ with M = B'·B⁻¹,        D' = N·D·N⁻¹ with N = T'⁻¹·T.

The first fit of all corners refines the motions. They are kept if the images then fit better than without.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ... import se3
from ..._typing import Array
from ...exceptions import DhcalError
from ...measurements.base import Measurement
from ...measurements.camera import CameraCorners, select_images
from ...measurements.pose import Pose
from ...robot.chain import Chain
from ...session import Session, refine_changes
from ...session.causes import Cause
from ...session.search import MAX_SAMPLE_COST, MIN_LOG_EVIDENCE, MIN_NOISE
from ...session.timeline import Timeline, order_samples
from ..result import Result
from ..reweighting import Fit
from ..session_check import SessionFit, residuals_of, without_changes
from .arm_types import ArmType


def fit_image_session(
    chain: Chain,
    data: tuple[Measurement, ...],
    holdout: tuple[Measurement, ...],
    calibrated: Callable[[Sequence[Pose]], Result],
    start: Callable[[tuple[Measurement, ...]], Fit],
    arm: ArmType,
) -> SessionFit:
    """Find what happened while images were taken, and fit them with the changes that are believed."""
    # `calibrated` calibrates poses of the tool for some base and some tool; `start` fits images.
    found = find_image_session(chain, data, holdout, calibrated, arm)
    if found is None or found.changes.is_empty:
        return SessionFit(start(data), holdout, found)
    try:
        fit = start(found.applied(data, holdout)[0])
        found = refine_changes(found, replace(fit.problem, data=fit.data), fit.solution.x)
        changed, held_out = found.applied(data, holdout)
        fit = start(changed)
    except DhcalError:
        return SessionFit(start(data), holdout, without_changes(found))
    try:
        without = start(data)
    except DhcalError:
        return SessionFit(fit, held_out, found)
    if found.has_two_robots or _explains_better(fit, without):
        return SessionFit(fit, held_out, found)
    return SessionFit(without, holdout, without_changes(found))


def find_image_session(
    chain: Chain,
    data: Sequence[Measurement],
    holdout: Sequence[Measurement],
    calibrated: Callable[[Sequence[Pose]], Result],
    arm: ArmType,
) -> Session | None:
    """Find what happened while images were taken; None if it is unknown."""
    images = select_images(data)
    if len(images) < len(data):
        return None
    try:
        # The images of the camera and board that were photographed most often show it.
        shown = {pair for item in images for pair in _pairs(item, item.shown_poses[0])}
        if len(shown) != 1:
            return None
        poses = [item.image_poses() for item in images]
        result = calibrated(poses)
    except DhcalError:
        return None
    found = result.session
    if found is None:
        return None
    base, tool = chain.base @ se3.inverse(result.chain.base), se3.inverse(chain.tool) @ result.chain.tool
    camera_moves = images[0].rig.camera_mounts[next(iter(shown))[0]].moves
    fixed, moving = ("board", "camera") if camera_moves else ("camera", "board")
    blocks = {
        "base": {"of": fixed, "origin": se3.inverse(result.chain.base)[:3, 3]},
        "tool": {"of": moving, "origin": tool[:3, 3]},
    }
    # A motion of one of several cameras or boards changes the images of the others differently.
    pairs = {pair for item in images for pair in _pairs(item, slice(None))}
    several = {of for i, of in enumerate(("camera", "board")) if len({pair[i] for pair in pairs}) > 1}
    motions = {kind for kind, block in blocks.items() if block["of"] not in several}
    causes = [
        replace(cause, block=replace(cause.block, **blocks.get(cause.block.kind, {})))
        for cause in found.causes
        if not cause.block.is_of_recording
        and (cause.block.kind in motions if cause.block.kind in blocks else arm.shows_joint_changes)
    ]
    changes = found.changes.carried_to(base, tool).with_motions(motions)
    return replace(
        found,
        changes=changes.without_lag if arm.shows_joint_changes else changes.of_frames,
        timeline=_timeline_of_images(images, holdout, poses, found.timeline.unit),
        chain=chain,
        causes=tuple(_carried_cause(cause, tool) for cause in causes),
        lag=None,
        scales=(),
        range_error=None,
    ).described()


def _pairs(item: CameraCorners, samples: Array | slice) -> set[tuple[int, int]]:
    """Return the numbers of camera and board of samples."""
    return set(zip(item.camera[samples].tolist(), item.board[samples].tolist(), strict=True))


def _explains_better(fit: Fit, other: Fit) -> bool:
    """Return whether one fit explains images so much better than another one that this is evidence."""
    squares = [_image_squares(each) for each in (fit, other)]
    noise = max(min(float(np.median(each)) for each in squares), MIN_NOISE**2)
    # An image has six degrees of freedom, and counts no more than an outlier does.
    limit = 1 + MAX_SAMPLE_COST / 6
    costs = [6 * float(np.sum(np.minimum(each / noise, limit))) for each in squares]
    return costs[1] - costs[0] > 2 * MIN_LOG_EVIDENCE


def _image_squares(fit: Fit) -> Array:
    """Return the mean square of the residuals of each image."""
    groups = [item.sample_groups for item in fit.data]
    parts = zip(groups, residuals_of(fit), strict=True)
    return np.concatenate([np.bincount(g, np.mean(r**2, 0)) / np.bincount(g) for g, r in parts])


def _carried_cause(cause: Cause, tool: Array) -> Cause:
    """Return a cause for another tool pose; see `RobotChanges.carried_to`."""
    if cause.block.kind != "tool":
        return cause
    by_tool = np.kron(np.eye(len(cause.amplitudes)), se3.adjoint(tool))
    covariance = by_tool @ cause.covariance @ by_tool.T
    return replace(cause, values=by_tool @ cause.values, covariance=covariance)


def _timeline_of_images(
    data: Sequence[CameraCorners], holdout: Sequence[Measurement], poses: Sequence[Pose], unit: str
) -> Timeline:
    """Give all corners of an image its number among the images that show a pose."""
    corners = order_samples(data, holdout)
    parts = zip(data, poses, corners.numbers, strict=False)
    first = np.concatenate([_first_corners(item, pose, numbers) for item, pose, numbers in parts])
    order = np.argsort(first)
    before = [np.searchsorted(first[order], of_item, side="right") - 1 for of_item in corners.numbers]
    q = np.concatenate([pose.q for pose in poses])[order]
    numbers = tuple(
        _of_same_configuration(q, item.q, np.fmax(found, 0))
        for item, found in zip(corners.data, before, strict=True)
    )
    if unit == "s":
        return replace(corners, numbers=numbers)
    return replace(
        corners, numbers=numbers, times=tuple(each.astype(float) for each in numbers), unit="image"
    )


def _of_same_configuration(shown: Array, q: Array, before: Array) -> Array:
    """Return the numbers of images with the joint positions of samples (m, n): those before, or the next."""
    # Another camera may have photographed the same configuration before the one that shows it.
    after = np.fmin(before + 1, len(shown) - 1)
    is_of_next = np.all(shown[after] == q, axis=1) & np.any(shown[before] != q, axis=1)
    return np.where(is_of_next, after, before)


def _first_corners(item: CameraCorners, pose: Pose, numbers: Array) -> Array:
    """Return the smallest number of the corners of the image of each pose, (k,), from those of all (m,)."""
    order = np.argsort(item.rows)
    first = np.full(item.n_images, np.iinfo(np.int64).max)
    np.minimum.at(first, item.image, numbers)
    return first[item.image[order[np.searchsorted(item.rows[order], pose.rows)]]]
