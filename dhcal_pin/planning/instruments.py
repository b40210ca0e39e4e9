"""Instruments of a plan: what a measurement anywhere says about errors of robot and instrument.

An instrument returns the whitened Jacobian A(q) of one measurement with respect to p errors of the robot and
s parameters of the instrument, and the displacement of its measured point that these cause anywhere.

The rows of an image are reduced. The c corners of a board in an image depend on the unknowns only by the pose
of the board in the camera and the l values of the lens. The columns of A therefore lie in the space of 6 + l
columns B (2c, 6+l), and with the QR decomposition B = Q·R the rows QᵀA say the same as A:

    (QᵀA)ᵀ(QᵀA) = AᵀA.

If corners are unknowns, too, their columns are not in this space, and all 2c rows are kept.

Shapes: m configurations, n joints, k rows of a measurement.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..estimation.frame_gauge import position_frame_effects
from ..exceptions import InvalidArgumentError
from ..measurements.base import Measurement, Noise, whitened_jacobian
from ..measurements.camera import CameraCorners, exp_and_jacobian
from ..measurements.images import rig_parameters
from ..robot.chain import Chain
from .views import PlannedImages

# Configurations whose images are computed at once.
_CHUNK = 200
# The same if corners are unknowns, of which there may be hundreds.
_FREE_CHUNK = 10


@frozen(eq=False)
class PresentModel:
    """Robot and instrument at the present values of their parameters."""

    chain: Chain
    bodies: Array  # Bodies of its p errors, shape (p,)
    twists: Array  # Twists of its errors, shape (p, 6)
    values: Array  # Values of the s instrument parameters, shape (s,) [m, rad, px or 1]


@frozen(eq=False)
class SimulatedInstrument:
    """Instrument of a kind of measurement, in a sensible place."""

    kind: type[Measurement]
    noise: Noise  # Standard deviations that measurements of different configurations do not share [m, rad]

    @property
    def position_sigma(self) -> float:
        """Standard deviation along each axis of a position [m]."""
        return self.noise.position

    @property
    def assumption(self) -> str:
        """What is assumed about this instrument, for messages; empty if all of it is stated."""
        return self.kind.simulated_instrument

    def template(self, chain: Chain, q: Array) -> Measurement:
        """Return measurements whose instrument parameters have initial values."""
        return self.kind.simulate(chain, q, self.noise, np.random.default_rng(0)).initialized(chain)

    def jacobians(self, model: PresentModel, q: Array) -> tuple[Array, Array]:
        """Compute the whitened Jacobian of measurements."""
        chain, u = model.chain, model.values
        data = self.kind.simulate(chain, q, self.noise, np.random.default_rng(0))
        frames = chain.forward_kinematics(q)
        linear = chain, model.bodies, model.twists
        by_errors = whitened_jacobian(data, linear, frames, u, data.residual(frames, u))
        return by_errors, data.instrument_jacobian(frames, u)

    def displacements(self, model: PresentModel, q: Array) -> tuple[Array, Array]:
        """Compute derivatives of d coordinates of the measured points by errors and instrument parameters.

        Their shapes are (p, d, m) and (s, d, m) [m]. The sum of their squares is the mean square over the
        measured points: here the tool point in the measuring frame.
        """
        frames = model.chain.forward_kinematics(q)
        jacobian = model.chain.tool_jacobian(frames, model.bodies, model.twists)[:, :3]
        return jacobian, np.zeros((len(model.values), 3, len(q)))

    def frame_displacements(self, model: PresentModel, q: Array) -> Array:
        """Compute derivatives (c, d, m) of these coordinates by poses of base and tool."""
        return position_frame_effects(model.chain, q).transpose(2, 1, 0)


@frozen(eq=False)
class CameraInstrument:
    """Cameras that see boards; a measurement is all images of one configuration."""

    assumption = ""
    images: PlannedImages  # Cameras, boards, and limits of their views
    # Standard deviations of the displacement of the tool that all corners of a configuration share.
    noise: Noise

    @property
    def position_sigma(self) -> float:
        """Standard deviation across the line of sight of a corner, at the middle distance [m]."""
        sizes = []
        for camera, board in self.images.pairs:
            limits, values = self.images.limits(camera, board), self.images.rig.cameras[camera].values
            sizes.append(0.5 * (limits.min_distance + limits.max_distance) / values[:2].mean())
        return float(np.hypot(self.noise.position, self.images.sigma * np.mean(sizes)))

    def template(self, chain: Chain, q: Array) -> CameraCorners:
        """Return all corners at the first configuration, in view or not."""
        return self._corners.replace(q=np.repeat(q[:1], len(self._corners.rows), 0))

    @cached_property
    def _corners(self) -> CameraCorners:
        """All corners of all pairs of a camera and a board in one configuration, without joint values."""
        rig = self.images.rig
        pairs = [(c, b, len(rig.boards[b].points)) for c, b in self.images.pairs]
        count = sum(size for *_, size in pairs)
        corners = CameraCorners(
            np.zeros((count, 1)),
            np.concatenate([np.tile(rig.cameras[c].image_centre, (size, 1)) for c, _, size in pairs]),
            np.concatenate([np.arange(size) for *_, size in pairs]),
            rig,
            [rig.cameras[c].name for c, _, size in pairs for _ in range(size)],
            [rig.boards[b].name for _, b, size in pairs for _ in range(size)],
            self.images.sigma,
        )
        return corners.replace(instrument_parameters=rig_parameters(corners.rig))

    def images_of(self, chain: Chain, q: Array) -> CameraCorners:
        """Return the corners of all images; those out of view have an infinite standard deviation."""
        one, m = self._corners, len(q)
        visible = np.concatenate(self.images.visible_corners(chain.poses(q)), 1).reshape(-1)
        tiled = {name: np.tile(getattr(one, name), m) for name in ("camera", "board", "corner")}
        return one.replace(
            q=np.repeat(q, len(one.rows), 0),
            rows=np.arange(len(visible)),
            values=np.tile(one.values, (m, 1)),
            sigma=np.where(visible[:, None], self.images.sigma, np.inf) * np.ones(2),
            jitter=np.zeros((len(visible), 2, 6)),
            **tiled,
        )

    def existing(self, item: Measurement, chain: Chain) -> Measurement:
        """Return existing images as this instrument would measure them."""
        if item.rig is None:
            raise InvalidArgumentError(
                f"{item.source or item.kind}: a plan of images complements images; expected the columns u, v "
                "and corner"
            )
        item = item.replace(
            rig=self._corners.rig,
            instrument_parameters=self._corners.instrument_parameters,
            sigma=np.full_like(item.sigma, self.images.sigma),
            has_stated_sigma=True,
        )
        return self.with_shared_noise(item, chain, np.array([p.nominal for p in item.instrument_parameters]))

    def with_shared_noise(self, item: Measurement, chain: Chain, u: Array) -> Measurement:
        """Return image coordinates whose corners share a displacement of the tool."""
        std = np.array([self.noise.position] * 3 + [self.noise.rotation] * 3)
        return item.with_jitter(item.displacement_derivative(chain.forward_kinematics(item.q), u) * std)

    def jacobians(self, model: PresentModel, q: Array) -> tuple[Array, Array]:
        """Compute the whitened and reduced Jacobian of images."""
        size = _FREE_CHUNK if self.images.free_boards else _CHUNK
        starts = range(0, max(len(q), 1), size)
        parts = [self._reduced_jacobian(model, q[start : start + size]) for start in starts]
        both = np.concatenate(parts).transpose(2, 1, 0)
        return both[: len(model.bodies)], both[len(model.bodies) :]

    def _reduced_jacobian(self, model: PresentModel, q: Array) -> Array:
        """Compute the rows (m, k, p+s) of images of a few configurations, reduced if no corner is unknown."""
        chain, u = model.chain, model.values
        m, n_corners = len(q), len(self._corners.rows)
        plain = self.images_of(chain, q)
        frames = chain.forward_kinematics(plain.q)
        data = self.with_shared_noise(plain, chain, u)
        linear = chain, model.bodies, model.twists
        by_errors = whitened_jacobian(data, linear, frames, u, data.residual(frames, u))
        rows = np.concatenate([by_errors, data.instrument_jacobian(frames, u)])
        rows = rows.reshape(len(rows), 2, m, n_corners).transpose(2, 1, 3, 0)
        rows = rows.reshape(m, 2 * n_corners, rows.shape[-1])
        if self.images.free_boards:
            return rows
        by_instrument = plain.instrument_jacobian(frames, u)
        basis = self._basis(by_instrument.reshape(len(u), 2, m, n_corners))
        return np.linalg.qr(basis)[0].swapaxes(1, 2) @ rows

    def _basis(self, by_instrument: Array) -> Array:
        """Return columns (m, 2c, b) that span those of every Jacobian, from derivatives (s, 2, m, c)."""
        names = [parameter.name for parameter in self._corners.instrument_parameters]
        rig, corners, blocks = self._corners.rig, self._corners, []
        for camera, board in self.images.pairs:
            prefixes = (f"camera_{rig.cameras[camera].name}.", f"board_{rig.boards[board].name}.")
            is_pose = [name.startswith(prefixes[1]) for name in names]
            is_lens = [
                name.startswith(prefixes[0]) and corners.set_of(name) == "intrinsics" for name in names
            ]
            of_pair = (corners.camera == camera) & (corners.board == board)
            blocks.append(by_instrument[np.logical_or(is_pose, is_lens)] * of_pair)
        columns = np.concatenate(blocks).transpose(2, 1, 3, 0)
        return columns.reshape(len(columns), 2 * len(corners.rows), columns.shape[-1])

    def displacements(self, model: PresentModel, q: Array) -> tuple[Array, Array]:
        """Compute displacements between cameras and boards.

        The measured point is the middle of a board on the tool, in the frame of a camera that stands still;
        or a point in front of a camera on the tool, in the frame of a board that stands still. The frame of a
        board is where its corners are: a motion that all of them share moves it.
        """
        frames = model.chain.forward_kinematics(q)
        jacobian = model.chain.tool_jacobian(frames, model.bodies, model.twists)
        tools, by_errors, by_instrument = frames.poses(), [], []
        for pair in self.images.pairs:
            moving, fixed = self._ends(*pair, model.values)
            offset = moving.pose[:3, :3] @ moving.point
            lever = np.einsum("mij,j->mi", tools[:, :3, :3], offset + moving.pose[:3, 3])
            by_errors.append(jacobian[:, :3] + np.cross(jacobian[:, 3:], lever.T[None], axis=1))
            part = np.zeros((len(model.values), 3, len(q)))
            on_tool = moving.linear - se3.skew(offset) @ moving.angular
            part[moving.columns] = np.einsum("mij,jk->kim", tools[:, :3, :3], on_tool)
            arm = tools[:, :3, 3] + lever - fixed.pose[:3, 3]
            turned = np.einsum("mij,jk->kim", se3.skew(arm), fixed.angular)
            part[fixed.columns] = turned - fixed.linear.T[:, :, None]
            by_instrument.append(part)
        scale = 1 / np.sqrt(len(self.images.pairs))
        return scale * np.concatenate(by_errors, 1), scale * np.concatenate(by_instrument, 1)

    def frame_displacements(self, model: PresentModel, q: Array) -> Array:
        """Return none: displacements between cameras and boards do not depend on where the robot stands."""
        return np.zeros((0, 3 * len(self.images.pairs), len(q)))

    def _ends(self, camera: int, board: int, u: Array) -> tuple[_End, _End]:
        """Return the moving and the standing one of a camera and a board."""
        rig, limits = self.images.rig, self.images.limits(camera, board)
        names = [parameter.name for parameter in self._corners.instrument_parameters]
        depth = 0.5 * (limits.min_distance + limits.max_distance)
        points = rig.boards[board].points
        eye = _End.of_pose(
            rig.camera_in_end(camera),
            rig.camera_mounts[camera].link_pose[:3, :3],
            np.array([0.0, 0.0, depth]),
            names.index(f"camera_{rig.cameras[camera].name}.x"),
            u,
        )
        prefix = f"board_{rig.boards[board].name}."
        plate = _End.of_pose(
            rig.board_in_end(board),
            rig.board_mounts[board].link_pose[:3, :3],
            points.mean(0),
            names.index(f"{prefix}x"),
            u,
        )
        if rig.boards[board].has_free_points:
            plate = plate.with_points(points, names.index(f"{prefix}p0x"))
        return (eye, plate) if rig.camera_mounts[camera].moves else (plate, eye)


@frozen(eq=False)
class _End:
    """Camera or board at an end of the robot, and how k instrument parameters move it."""

    pose: Array  # Pose in the frame of the end, shape (4, 4) [m]
    point: Array  # Measured point in its own frame, shape (3,) [m]
    columns: Array  # Instrument parameters that move it, shape (k,)
    linear: Array  # Derivatives of its position by them, in axes of the end, shape (3, k)
    angular: Array  # Derivatives of its rotation by them, in axes of the end, shape (3, k)

    @classmethod
    def of_pose(cls, pose: Array, link: Array, point: Array, first: int, u: Array) -> _End:
        """Return an end that the parameters of its pose move; `first` is the first of these six."""
        turn = link @ exp_and_jacobian(u[first + 3 : first + 6])[1]
        zero = np.zeros((3, 3))
        return cls(pose, point, first + np.arange(6), np.hstack([link, zero]), np.hstack([zero, turn]))

    def with_points(self, points: Array, first: int) -> _End:
        """Return an end that its corners move, too: by the motion nearest to their displacements."""
        count = len(points)
        motion = np.concatenate([np.tile(np.eye(3), (count, 1, 1)), -se3.skew(points)], 2)
        by_points = np.linalg.pinv(motion.reshape(-1, 6))
        rotation = self.pose[:3, :3]
        return replace(
            self,
            columns=np.concatenate([self.columns, first + np.arange(3 * count)]),
            linear=np.hstack([self.linear, rotation @ by_points[:3]]),
            angular=np.hstack([self.angular, rotation @ by_points[3:]]),
        )


# Source of the measurements that are planned.
Instrument = SimulatedInstrument | CameraInstrument
