"""Configurations in which cameras see boards.

Random joint positions hardly ever have a board in view. Candidates therefore come from random views
(`views`): inverse kinematics from a random start brings the camera, or the board, to a view. Only the result
is tested: a robot with few joints may miss the drawn view and still have the board in view.

A view is hidden if a shape of the robot or an obstacle touches the convex hull of the centre of the camera
and the corners in view. A shape that moves with the camera may cover it in every pose, because the pose in
the rig is approximate, or because the camera is in a housing. All shapes that move with the camera are then
ignored, and a note says so. The same holds for the board.

Shapes: m configurations, n joints.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..exceptions import InvalidArgumentError
from ..measurements.images import ViewLimits
from ..robot.inverse_kinematics import characteristic_length, pose_task, solve_ik, wrap_into_limits
from ..robot.sampling import ConfigurationSampler, collect_draws
from .views import PlannedImages, draw_views

# Steps of the inverse kinematics, and configurations that are solved at once.
_IK_STEPS, _BATCH = 40, 1000
# Rounds of draws per batch of configurations, and rounds without any board in view before giving up.
_MAX_ROUNDS, _MAX_EMPTY_ROUNDS = 60, 3
# Errors of all joints together at which a board must still be in view.
_N_ERRORS = 6
# Part of the line of sight next to the board that is not checked: the board has a thickness.
_BOARD_SHARE = 0.05


@frozen(eq=False)
class ViewSampler(ConfigurationSampler):
    """Sampler of configurations in which a camera sees a board."""

    images: PlannedImages  # Cameras and boards

    @classmethod
    def from_sampler(cls, sampler: ConfigurationSampler, images: PlannedImages) -> ViewSampler:
        """Restrict a sampler to configurations in which a camera sees a board."""
        return cls(sampler.chain, sampler.workspace, sampler.low, sampler.high, sampler.collision, images)

    def in_workspace(self, q: Array) -> Array:
        """Return in which configurations the tool is in the workspace and a board is in view."""
        inside = super().in_workspace(q)
        for error in self._joint_errors:
            near = np.flatnonzero(inside)
            inside[near] = self.images.in_view(self.chain.poses(q[near] + error))
        return inside

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Draw joint positions in which a board is in view; collisions and hidden views are not checked."""

        def drawn() -> Array:
            start = rng.uniform(self.low, self.high, (_BATCH, self.chain.n_joints))
            q = self._bring_into_view(start, rng)
            return q[self.in_workspace(q)]

        out = collect_draws(drawn, count, _MAX_ROUNDS * -(-count // _BATCH), _MAX_EMPTY_ROUNDS)
        if len(out) == count:
            return out
        if not len(out):
            raise InvalidArgumentError(
                f"{self.images.where}no camera can see a board in any pose of the robot; check links and "
                "poses (the z axis of a board points away from its printed side), and the limits of distance "
                "and workspace"
            )
        raise InvalidArgumentError(
            f"{self.images.where}only {len(out)} poses with a board in view were found; expected {count}: "
            "relax the limits of distance and workspace, or use fewer candidates"
        )

    def perturb(self, q: Array, step: float, count: int, rng: np.random.Generator) -> Array:
        """Draw configurations around given ones; those without a board in view are brought to a view."""
        out = super().perturb(q, step, count, rng)
        lost = np.flatnonzero(~self.in_workspace(out))
        if lost.size:
            out[lost] = self._bring_into_view(out[lost], rng)
        return out

    def is_feasible(self, q: Array) -> bool:
        """Return whether a configuration has no collision, and no board in view is hidden."""
        return super().is_feasible(q) and not self._is_hidden(q)

    def _bring_into_view(self, start: Array, rng: np.random.Generator) -> Array:
        """Move joint positions (m, n) towards random views, by inverse kinematics."""
        rig, pairs = self.images.rig, self.images.pairs
        targets, chosen = np.empty((len(start), 4, 4)), rng.integers(len(pairs), size=len(start))
        for number, (camera, board) in enumerate(pairs):
            rows = np.flatnonzero(chosen == number)
            if not rows.size:
                continue
            views = draw_views(rig, camera, board, self._limits[camera, board], len(rows), rng)
            camera_pose, board_pose = rig.camera_in_end(camera), rig.board_in_end(board)
            if rig.camera_mounts[camera].moves:
                targets[rows] = board_pose @ se3.inverse(views) @ se3.inverse(camera_pose)
            else:
                targets[rows] = camera_pose @ views @ se3.inverse(board_pose)
        task = pose_task(targets, characteristic_length(self.chain))
        q, _ = solve_ik(self.chain, task, start, _IK_STEPS)
        q, _ = wrap_into_limits(replace(self.chain, lower=self.low, upper=self.high), q)
        return np.clip(q, self.low, self.high)

    @cached_property
    def _joint_errors(self) -> Array:
        """Errors of the joints at which a board is still in view, (e, n); the first one is 0."""
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (_N_ERRORS, self.chain.n_joints))
        errors = self.images.joint_error * signs * ~self.chain.is_prismatic
        return np.concatenate(
            [np.zeros_like(errors[:1]), errors[: _N_ERRORS * bool(self.images.joint_error)]]
        )

    @cached_property
    def _limits(self) -> dict[tuple[int, int], ViewLimits]:
        """Limits of the views of each pair, with the distances that the robot reaches."""
        q = np.random.default_rng(0).uniform(self.low, self.high, (_BATCH, self.chain.n_joints))
        tools, out = self.chain.poses(q), {}
        for pair in self.images.pairs:
            middle = np.append(self.images.rig.boards[pair[1]].points.mean(0), 1.0)
            reached = np.linalg.norm((self.images.rig.board_in_camera(*pair, tools) @ middle)[:, :3], axis=1)
            limits = self.images.limits(*pair)
            low, high = max(limits.min_distance, reached.min()), min(limits.max_distance, reached.max())
            out[pair] = replace(limits, min_distance=low, max_distance=high) if low < high else limits
        return out

    def _is_hidden(self, q: Array) -> bool:
        """Return whether the robot or an obstacle hides a board that is in view at q, shape (n,)."""
        rig, tools, images = self.images.rig, self.chain.poses(q[None]), self.images
        for pair, visible in zip(images.pairs, images.visible_corners(tools), strict=True):
            if not visible.any() or pair not in self._blocking:
                continue
            eye, board = self._in_first_link(tools[0], *pair)
            points = se3.transform_points(board, rig.boards[pair[1]].points[visible[0]])
            ignored = frozenset().union(*self._blocking[pair].values())
            near_board = eye[:3, 3] + (1 - _BOARD_SHARE) * (points - eye[:3, 3])
            if not self.collision.is_view_free(q, eye[:3, 3], near_board, ignored):
                return True
        return False

    def _in_first_link(self, tool: Array, camera: int, board: int) -> tuple[Array, Array]:
        """Return the poses (4, 4) of a camera and a board in the frame of the first link."""
        rig, from_measuring = self.images.rig, se3.inverse(self.chain.base)
        poses = []
        for mount, pose in (
            (rig.camera_mounts[camera], rig.camera_in_end(camera)),
            (rig.board_mounts[board], rig.board_in_end(board)),
        ):
            poses.append(from_measuring @ (tool @ pose if mount.moves else pose))
        return poses[0], poses[1]

    @property
    def notes(self) -> tuple[str, ...]:
        """What is not checked and why."""
        if self.collision.geometry is None:
            text = "whether the robot hides a board is not checked: there is no collision geometry"
            return (*super().notes, text)
        texts = [
            f"whether the robot hides points of {board.name!r} is not checked"
            for board in self.images.rig.boards
            if board.type == "points"
        ]
        names = sorted({name for shapes in self._blocking.values() for name in shapes})
        if names:
            texts.append(
                f"whether the link of {' and '.join(names)} hides a board is not checked: it would hide "
                "every view; check the pose in the rig"
            )
        return (*super().notes, *texts)

    @cached_property
    def _blocking(self) -> dict[tuple[int, int], dict[str, frozenset[int]]]:
        """Shapes that move with a camera or a flat board and hide every view, by pair and by its name."""
        rig, q = self.images.rig, 0.5 * (self.low + self.high)
        tool, out = self.chain.poses(q[None])[0], {}
        for camera, board in self.images.pairs:
            if rig.boards[board].type == "points":
                continue
            eye, plate = self._in_first_link(tool, camera, board)
            limits, is_camera_on_tip = self.images.limits(camera, board), rig.camera_mounts[camera].moves
            length = 0.5 * (limits.min_distance + limits.max_distance)
            # From the camera along its optical axis, and from the middle of the board towards the camera.
            middle = plate[:3, :3] @ rig.boards[board].points.mean(0) + plate[:3, 3]
            start = middle - _BOARD_SHARE * length * plate[:3, 2]
            lines = {
                f"camera {rig.cameras[camera].name!r}": (is_camera_on_tip, eye[:3, 3], eye[:3, 2]),
                f"board {rig.boards[board].name!r}": (not is_camera_on_tip, start, -plate[:3, 2]),
            }
            blocking = out[camera, board] = {}
            for name, (is_tip, start, axis) in lines.items():
                shapes = self.collision.shapes_on_end(is_tip)
                if shapes & self.collision.shapes_on_line(q, start, start + length * axis):
                    blocking[name] = shapes
        return out
