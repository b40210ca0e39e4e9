"""Image coordinates of the corners of boards that cameras see while the robot stands still.

One end of the chain carries the camera and the other one the board. With the pose G of the tool in the
measuring frame, the pose C of the camera and B of the board in the frames of their ends, and a corner p of
the board, the corner is in the frame of the camera at

    X = C⁻¹·G·B·p      for a camera that stands still and a board that moves with the tool,
    X = C⁻¹·G⁻¹·B·p    for a camera that moves with the tool and a board that stands still,

and in the image at h = lens(X). The instrument parameters are the positions and rotation vectors of all
cameras and boards in their links, the values of the lenses that are not fixed, and the corners of boards
whose points are not fixed.

All corners of one image share the error of the arm in that configuration: a displacement d of the tool, which
is called jitter. Its distribution is normal with given standard deviations. It is marginalized: with the
derivative A (2c, 6) of the c whitened corners of the image by d in units of its standard deviations, their
covariance is I + A·Aᵀ, and residuals and Jacobians are multiplied by its inverse square root,

    (I + A·Aᵀ)^(-1/2) = I - U·diag(1 - 1/√(1 + s²))·Uᵀ,    A = U·diag(s)·Vᵀ.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from .._frozen import frozen
from .._kernels.types import FrameBatch, ObservationMatrix
from .._typing import Array
from ..cameras.boards import Board
from ..cameras.rig import WORLD, Camera, Rig
from ..exceptions import InvalidArgumentError, NotObservableError, SampleError
from ..formatting import format_count
from ..robot.chain import Chain
from ..robot.conditions import Conditions
from . import images
from .base import Measurement, Noise, label_stops
from .columns import Column
from .groups import ErrorGroup, Group
from .images.camera_parameters import (
    POINTS_SET,
    POSE_NAMES,
    board_parameters,
    camera_parameters,
    rig_parameters,
)
from .images.names import label_images, name_array, whole_images
from .mounting import MountedRig, mount_rig
from .pose import Pose
from .validation import validated_array, validated_joint_positions, validated_sigma

# Standard deviation [px] of image coordinates that state none.
PIXEL_SIGMA = 1.0
# Rows and velocity components of the terms: each image coordinate by all six velocities of the tool.
_TERMS = (np.repeat([0, 1], 6), np.tile(np.arange(6), 2))
# Errors of poses that images show with a lens that is not calibrated yet, relative to those by noise.
_SHOWN_NOISE_FACTOR = 2.5
# Set-up of simulations: distance of the cameras from the robot as a multiple of its reach, image scale [px/m]
# at the robot, and half the diagonals of the board [m].
_DISTANCE, _SCALE, _BOARD_SIZE = 1.5, 1000.0, 0.3
# Half the usual width of their images [px], and the factor by which larger images exceed what they show.
_HALF_IMAGE, _IMAGE_MARGIN = 2048, 1.05


@frozen(eq=False)
class _Projection:
    """Model of all corners at one state; derivatives by the unknowns are computed on first use."""

    # What belongs to a camera or a board has shape (..., 1) if the rig has only one, else (..., m).

    pixels: Array  # Image coordinates, (2, m) [px]
    by_local: Array  # Derivative by the corner in the frame of the camera, (2, 3, m) [px/m]
    # Derivative by the values of the lens of each camera, (2, s, m) for the samples of the camera.
    by_lens: list[Array]
    moves: Array  # Whether the camera moves with the tool, (m,)
    to_camera: Array  # Rotation from the frame of the camera's end to that of the camera, (3, 3, m)
    between: Array  # Rotation from the frame of the board's end to that of the camera's end, (3, 3, m)
    board_axes: Array  # Axes of the board in the frame of its end, (3, 3, m)
    arm: Array  # Corner relative to the camera in the frame of the camera's end, (3, m) [m]
    turned: Array  # Corner relative to the board in the frame of the board's end, (3, m) [m]
    lever: Array  # Corner relative to the tool in the measuring frame, (3, m) [m]
    camera_links: Array  # Axes of the link of each camera in the frame of its end, (c, 3, 3)
    board_links: Array  # Axes of the link of each board in the frame of its end, (b, 3, 3)
    # Derivative of the rotation of each camera by its rotation vector, (c, 3, 3); see `_end_poses`.
    camera_turns: Array
    board_turns: Array  # Derivative of the rotation of each board by its rotation vector, (b, 3, 3)

    @cached_property
    def by_velocity(self) -> Array:
        """Derivative by the velocity of the tool, (2, 6, m)."""
        by_linear = np.where(self.moves, -self._by_board_end, self._by_camera_end)
        return np.concatenate([by_linear, -_cross(by_linear, self.lever)], 1)

    def by_camera(self, number: int, samples: slice | Array) -> Array:
        """Derivative of samples of a camera by its position and rotation vector, (2, 6, k)."""
        by_position = -self._by_camera_end[:, :, samples]
        # d = R_cᵀ·[arm]×·Jl·δ for a change δ of the rotation vector of the camera in its end.
        by_rotation = -_cross(by_position, self.arm[:, samples])
        return _by_pose(by_position, self.camera_links[number], by_rotation, self.camera_turns[number])

    def by_board(self, number: int, samples: slice | Array) -> Array:
        """Derivative of samples of a board by its position and rotation vector, (2, 6, k)."""
        by_position = self._by_board_end[:, :, samples]
        by_rotation = -_cross(by_position, self.turned[:, samples])
        return _by_pose(by_position, self.board_links[number], by_rotation, self.board_turns[number])

    @cached_property
    def by_point(self) -> Array:
        """Derivative by the corner in its board, (2, 3, m)."""
        return _product(self._by_board_end, self.board_axes)

    @cached_property
    def _by_camera_end(self) -> Array:
        """Derivative by the corner in the frame of the camera's end, (2, 3, m)."""
        return _product(self.by_local, self.to_camera)

    @cached_property
    def _by_board_end(self) -> Array:
        """Derivative by the corner in the frame of the board's end, (2, 3, m)."""
        return _product(self._by_camera_end, self.between)


@dataclass(frozen=True, eq=False, init=False, repr=False)
class CameraCorners(Measurement):
    """Image coordinates of board corners; one sample is one corner in one image.

    Attributes:
        rig: Cameras and boards on the chain.
        values: Image coordinates, (m, 2) [px].
        sigma: Standard deviations, (m, 2) [px].
        camera: Number of each sample's camera in the rig, (m,).
        board: Number of each sample's board, (m,).
        corner: Number of each sample's corner on its board, (m,).
        image_names: Name of each sample's photograph, (m,); empty if it is not known.
        jitter: Derivative of the image coordinates by the displacement of the tool, in units of its standard
            deviations, (m, 2, 6) [px]; zero without jitter.
        largest_jitter: Largest jitter that the images do not exclude, relative to `jitter`.
    """

    rig: MountedRig
    values: Array
    sigma: Array
    camera: Array
    board: Array
    corner: Array
    image_names: Array
    jitter: Array
    largest_jitter: float

    kind = "camera"
    residual_groups: ClassVar = {
        "pixels": Group.of(ErrorGroup("pixels", "px", "image error", 3), slice(0, 2))
    }
    further_errors: ClassVar = {"board": ErrorGroup("board", "m", "error at the board", 4)}
    COLUMNS = (
        Column("u", "pixel", "pixels"),
        Column("v", "pixel", "pixels"),
        Column("corner", "text", "corner"),
        Column("camera", "text", "camera"),
        Column("board", "text", "board"),
        Column("image", "remark", "image_names"),
    )
    required_columns = (frozenset(("u", "v", "corner")),)
    accepts_tool_poses = True
    label_column = "camera"
    sample_fields = (
        *Measurement.sample_fields,
        *("values", "sigma", "camera", "board", "corner", "image_names", "jitter"),
    )

    def __init__(
        self,
        q: ArrayLike,
        pixels: ArrayLike,
        corner: Sequence[int] | Sequence[str] | Array,
        rig: MountedRig,
        camera: Sequence[str] | None = None,
        board: Sequence[str] | None = None,
        sigma: ArrayLike | None = None,
        image_names: Sequence[str] | None = None,
    ) -> None:
        """Check and store image coordinates.

        Args:
            q: Joint positions, (m, n) [rad or m].
            pixels: Image coordinates u to the right and v down, (m, 2) [px].
            corner: Number of each corner on its board, (m,).
            rig: Cameras and boards on the chain.
            camera: Name of each sample's camera, (m,); not needed if there is only one.
            board: Name of each sample's board, (m,); not needed if there is only one.
            sigma: Standard deviations, one number or (m, 2) [px]; estimated with the fit if None.
            image_names: Name of each sample's photograph, (m,), for messages and reports. Images are the
                samples of one configuration and one camera, whatever their names.
        """
        q = validated_joint_positions(q, "CameraCorners")
        m = len(q)
        camera_index = _numbers(camera, [c.name for c in rig.cameras], m, "camera")
        board_index = _numbers(board, [b.name for b in rig.boards], m, "board")
        values = validated_array(pixels, (m, 2), "CameraCorners: pixels", "pair of image coordinates")
        self._initialize(
            q=q,
            rig=rig,
            values=values,
            sigma=validated_sigma(PIXEL_SIGMA if sigma is None else sigma, (m, 2), "CameraCorners: sigma"),
            camera=camera_index,
            board=board_index,
            corner=_corner_numbers(corner, rig, board_index),
            image_names=name_array(image_names, m),
            jitter=np.zeros((m, 2, 6)),
            largest_jitter=1.0,
            has_stated_sigma=sigma is not None,
            instrument_parameters=rig_parameters(rig),
        )
        _require_opposite_ends(self)
        _require_inside_images(self)

    @classmethod
    def from_columns(
        cls, q: Sequence[Array], values: Mapping[str, Any], rig: MountedRig | None = None
    ) -> Self:
        """Return the measurements of a file, which need a rig."""
        if rig is None:
            raise InvalidArgumentError(
                "image coordinates need the cameras and boards of a rig; give --rig RIG.toml"
            )
        return cls(q[0], rig=rig, **cls._arguments(values))

    def with_rig(self, rig: MountedRig) -> Self:
        """Return a copy with other properties of the same cameras and boards.

        Names, links and lenses are the same. Values of parameters that both rigs have are kept.
        """
        known = {p.name: p.nominal for p in self.instrument_parameters}
        parameters = tuple(
            replace(p, nominal=known[p.name]) if np.isfinite(known.get(p.name, np.nan)) else p
            for p in rig_parameters(rig)
        )
        return self.replace(rig=rig, instrument_parameters=parameters)

    def with_values(self, values: Mapping[str, float]) -> Self:
        """Return a copy whose instrument parameters start from the values that are given by name."""
        parameters = tuple(
            replace(p, nominal=float(values.get(p.name, p.nominal))) for p in self.instrument_parameters
        )
        return self.replace(instrument_parameters=parameters)

    def without_poses(self, entries: Collection[str]) -> Self:
        """Return a copy in which the poses of cameras and boards, such as `camera_wrist`, are not known."""
        cameras, boards = (
            tuple(replace(e, pose=None) if f"{kind}_{e.name}" in entries else e for e in group)
            for kind, group in (("camera", self.rig.cameras), ("board", self.rig.boards))
        )
        unknown = {f"{entry}.{name}": np.nan for entry in entries for name in POSE_NAMES}
        return self.with_rig(replace(self.rig, cameras=cameras, boards=boards)).with_values(unknown)

    def matched_to(self, known: Mapping[str, float]) -> Self:
        """Return a copy whose boards have free corners where the calibration estimated them."""
        boards = tuple(
            replace(board, has_free_points=f"board_{board.name}.p0x" in known)
            if f"board_{board.name}.x" in known
            else board
            for board in self.rig.boards
        )
        if all(
            new.has_free_points == old.has_free_points
            for new, old in zip(boards, self.rig.boards, strict=True)
        ):
            return self
        return self.with_rig(replace(self.rig, boards=boards))

    @property
    def stated_values(self) -> dict[str, float]:
        """Values of the parameters of poses and lenses that the rig states, by name [m, rad, px or 1]."""
        unknown = tuple(f"camera_{camera.name}." for camera in self.rig.cameras if not camera.has_intrinsics)
        return {
            p.name: p.nominal
            for p in rig_parameters(self.rig)
            if np.isfinite(p.nominal)
            and self.set_of(p.name) != POINTS_SET
            and not (self.set_of(p.name) == "intrinsics" and p.name.startswith(unknown))
        }

    def set_of(self, name: str) -> str:
        """Return the parameter set of an instrument parameter such as `camera_wrist.fx`.

        It is "camera" or "board" for a component of a pose, "intrinsics" for a value of a lens, "points" for
        a coordinate of a corner.
        """
        entry, _, component = name.rpartition(".")
        kind = entry.partition("_")[0]
        if component in POSE_NAMES:
            return kind
        return "intrinsics" if kind == "camera" else POINTS_SET

    def solved_rig(self, values: Mapping[str, float]) -> MountedRig | None:
        """Return the rig with estimated poses, lenses and corners, without entries that no image shows."""
        u = np.array([values.get(p.name, p.nominal) for p in self.instrument_parameters])
        parts = self._split(u)
        poses = [[se3.transform(se3.exp3(part[3:6]), part[:3]) for part in group] for group in parts]
        lenses, points = self.lens_values(u), self.points(u)
        cameras = tuple(
            replace(camera, pose=pose, values=lens)
            for camera, pose, lens in zip(self.rig.cameras, poses[0], lenses, strict=True)
        )
        boards = tuple(
            replace(
                board,
                pose=pose,
                type="points" if board.has_free_points else board.type,
                listed_points=corners,
            )
            for board, pose, corners in zip(self.rig.boards, poses[1], points, strict=True)
        )
        shown = [
            [i for i, entry in enumerate(entries) if f"{kind}_{entry.name}.x" in values]
            for kind, entries in (("camera", cameras), ("board", boards))
        ]
        return replace(self.rig, cameras=cameras, boards=boards).take(*shown) if all(shown) else None

    def _with_entries(self, cameras: Collection[str], boards: Collection[str]) -> Self:
        """Return a copy whose rig has some of its cameras and boards only; the images show no others."""
        of_cameras, of_boards = (
            [i for i, entry in enumerate(entries) if entry.name in names]
            for entries, names in ((self.rig.cameras, cameras), (self.rig.boards, boards))
        )
        kept = self.with_rig(self.rig.take(of_cameras, of_boards))
        return kept.replace(
            camera=np.searchsorted(of_cameras, self.camera), board=np.searchsorted(of_boards, self.board)
        )

    @property
    def has_jitter(self) -> bool:
        """Whether the corners of an image share a displacement."""
        return bool(self.jitter.any())

    def with_jitter(self, jitter: Array, largest: float = 1.0) -> Self:
        """Return a copy with another jitter.

        Args:
            jitter: Derivative of the image coordinates by the displacement of the tool, in units of its
                standard deviations, (m, 2, 6) [px].
            largest: Largest jitter that the images do not exclude, relative to `jitter`.

        Returns:
            The copy.
        """
        return self.replace(jitter=jitter, largest_jitter=largest)

    def at_largest_noise(self) -> Self:
        """Return a copy with the largest jitter that the images do not exclude, for uncertainties."""
        return self if self.largest_jitter == 1 else self.with_jitter(self.largest_jitter * self.jitter)

    def description(self) -> list[str]:
        """Return what `repr` says besides the number of samples."""
        return [format_count(self.n_images, "image"), self._sigma_text((self.sigma, 1.0, "px"))]

    @property
    def label_names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(camera.name for camera in self.rig.cameras)

    @property
    def label_numbers(self) -> Array:
        """Number of each sample's camera, (m,)."""
        return self.camera

    def with_label(self, number: int) -> Self:
        """Return the same corners in images of one camera."""
        return self.replace(camera=np.full(len(self.rows), number))

    @property
    def n_images(self) -> int:
        """Number of images."""
        return int(self.image.max(initial=-1)) + 1

    @property
    def corners(self) -> images.Corners:
        """Data of the corners for the first values of cameras and boards."""
        parts = self.rig, self.camera, self.board, self.corner, self.image
        return images.Corners(self.conditions(), self.values, *parts)

    def photographs(self) -> Array:
        """Return the name of the photograph of each sample, (m,); empty texts without photographs."""
        return self.image_names

    def images_within(self, is_chosen: Array) -> list[str]:
        """Return the names of the images all of whose corners are among the chosen samples."""
        return [self.image_labels[number] for number in whole_images(self.image, is_chosen)]

    @cached_property
    def image(self) -> Array:
        """Number of each sample's image, (m,): samples of one stop of the arm and one camera."""
        keys = np.column_stack([label_stops(self), self.camera])
        return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)

    @cached_property
    def image_labels(self) -> tuple[str, ...]:
        """Name of each image for people, in the order of the numbers of `image`; empty if it has none."""
        return label_images(self.image, self.image_names)

    @property
    def sample_groups(self) -> Array:
        """Number of each sample's image, (m,): a wrong image is wrong in all its corners."""
        return self.image

    @property
    def residual_dim(self) -> int:
        """Number of residuals per sample: u and v."""
        return 2

    @property
    def residual_names(self) -> tuple[str, ...]:
        """Names of the residuals of a sample."""
        return ("pixels_u", "pixels_v")

    # ------------------------------------------------------------------------------------------- model
    @cached_property
    def _parameter_ends(self) -> Array:
        """Number of the parameters of the cameras and boards up to each one, (c + b,)."""
        sizes = [len(camera_parameters(camera)) for camera in self.rig.cameras]
        sizes += [len(board_parameters(board)) for board in self.rig.boards]
        return np.cumsum(sizes)

    def _split(self, u: Array) -> tuple[list[Array], list[Array]]:
        """Split u into the parameters of each camera and of each board."""
        parts = np.split(u, self._parameter_ends[:-1])
        return parts[: len(self.rig.cameras)], parts[len(self.rig.cameras) :]

    def lens_values(self, u: Array) -> list[Array]:
        """Return the values of the lens of each camera from the instrument parameters u."""
        parts = self._split(u)[0]
        return [
            part[6:] if camera.intrinsics != "fixed" else camera.values
            for camera, part in zip(self.rig.cameras, parts, strict=True)
        ]

    def points(self, u: Array) -> list[Array]:
        """Return the corners of each board in its frame, (c, 3) [m], from the instrument parameters u."""
        parts = self._split(u)[1]
        return [
            part[6:].reshape(-1, 3) if board.has_free_points else board.points
            for board, part in zip(self.rig.boards, parts, strict=True)
        ]

    def _project(self, frames: FrameBatch, u: Array) -> _Projection:
        """Project all corners; the last result is kept, as residuals and both Jacobians need it."""
        last = getattr(self, "_last_projection", None)
        if last is None or last[0] is not frames or not np.array_equal(last[1], u):
            last = frames, u.copy(), self._compute_projection(frames, u)
            object.__setattr__(self, "_last_projection", last)
        return last[2]

    def _compute_projection(self, frames: FrameBatch, u: Array) -> _Projection:
        """Project all corners."""
        m = len(self.rows)
        camera_parts, board_parts = self._split(u)
        mounts, n_cameras = self.rig.camera_mounts, len(camera_parts)
        poses, turns = _end_poses([*camera_parts, *board_parts], [*mounts, *self.rig.board_mounts])
        camera_poses, board_poses = poses[:n_cameras], poses[n_cameras:]
        points = np.zeros((3, m))
        for number, corners in enumerate(self.points(u)):
            of_board = _samples_of(self.board, number)
            points[:, of_board] = corners[self.corner[of_board]].T
        moves = _of_samples(np.array([mount.moves for mount in mounts], bool), self.camera)
        tool = frames.tool
        r_camera, r_board = (
            _of_samples(poses[:, :3, :3].transpose(1, 2, 0), numbers)
            for poses, numbers in ((camera_poses, self.camera), (board_poses, self.board))
        )
        turned = _rotate(r_board, points)
        on_end = turned + _of_samples(board_poses[:, :3, 3].T, self.board)
        # Rotation of the tool [columns are axes], and of the link of the board in the link of the camera.
        r_tool = tool[:3].swapaxes(0, 1)
        r_between = np.where(moves, r_tool.swapaxes(0, 1), r_tool)
        # The corner in the frame of the camera's end.
        lever = np.where(moves, on_end - tool[3], _rotate(r_tool, on_end))
        in_end = np.where(moves, _rotate(r_between, on_end - tool[3]), lever + tool[3])
        arm = in_end - _of_samples(camera_poses[:, :3, 3].T, self.camera)
        to_camera = r_camera.swapaxes(0, 1)
        local = _rotate(to_camera, arm)
        pixels, by_local, by_lens = np.empty((2, m)), np.empty((2, 3, m)), []
        for number, (camera, values) in enumerate(zip(self.rig.cameras, self.lens_values(u), strict=True)):
            of_camera = _samples_of(self.camera, number)
            found = camera.lens.project(local[:, of_camera], values)
            pixels[:, of_camera], by_local[:, :, of_camera] = found[:2]
            by_lens.append(found[2])
        # The frames are a work array; only copies of their values are kept.
        return _Projection(
            pixels=pixels,
            by_local=by_local,
            by_lens=by_lens,
            moves=moves,
            to_camera=to_camera,
            between=r_between,
            board_axes=r_board,
            arm=arm,
            turned=turned,
            lever=lever,
            camera_links=np.array([mount.link_pose[:3, :3] for mount in mounts]),
            board_links=np.array([mount.link_pose[:3, :3] for mount in self.rig.board_mounts]),
            camera_turns=turns[:n_cameras],
            board_turns=turns[n_cameras:],
        )

    @cached_property
    def _jitter_bases(self) -> list[tuple[Array, Array, Array]]:
        """Images with jitter by their number c of corners."""
        # Samples (g, c), basis U (g, 2c, 6) and factors 1 - 1/√(1 + s²) (g, 6) of g images with c corners.
        out: list[tuple[Array, Array, Array]] = []
        if not self.has_jitter:
            return out
        whitened = self.jitter.transpose(1, 0, 2) * self._weights[:, :, None]
        group = label_stops(self)
        order, counts = np.argsort(group, kind="stable"), np.bincount(group)
        images = np.split(order, np.cumsum(counts)[:-1])
        for count in np.unique(counts):
            samples = np.array([image for image in images if len(image) == count])
            stacked = whitened[:, samples].swapaxes(0, 1).reshape(len(samples), -1, 6)
            u, s, _ = np.linalg.svd(stacked, full_matrices=False)
            out.append((samples, u, 1 - 1 / np.sqrt(1 + s**2)))
        return out

    def _whiten(self, rows: Array) -> Array:
        """Divide rows (..., 2, m) by sigma, and remove what the jitter explains."""
        rows = rows * self._weights
        for samples, basis, factors in self._jitter_bases:
            part = rows[..., samples].swapaxes(-3, -2)
            flat = part.reshape(*part.shape[:-2], -1)[..., None]
            explained = basis @ (factors[..., None] * (basis.swapaxes(-1, -2) @ flat))
            rows[..., samples] -= explained.reshape(part.shape).swapaxes(-3, -2)
        return rows

    def take_displacements(self, rows: Array) -> Iterator[tuple[Array, Array]]:
        """Take the components along the jitter out of whitened rows.

        Args:
            rows: Whitened rows of c columns, (c, 2, m), from which the components are subtracted.

        Yields:
            For the g images of each number of corners, their components (c, 6·g), and the standard deviations
            by the jitter that these had before they were whitened, relative to those of the corners, (6·g,).
        """
        for samples, basis, factors in self._jitter_bases:
            part = rows[..., samples].swapaxes(-3, -2)
            components = basis.swapaxes(-1, -2) @ part.reshape(*part.shape[:-2], -1)[..., None]
            rows[..., samples] -= (basis @ components).reshape(part.shape).swapaxes(-3, -2)
            yield components.reshape(len(rows), -1), np.sqrt(1 / (1 - factors) ** 2 - 1).ravel()

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """Return the whitened residuals (2, m)."""
        return self._whiten(self.values.T - self._project(frames, u).pixels)

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """Return the derivatives of both image coordinates by all velocities of the tool."""
        rows = self._whiten(self._project(frames, u).by_velocity.swapaxes(0, 1))
        return ObservationMatrix(*_TERMS, rows.swapaxes(0, 1).reshape(12, -1))

    def instrument_jacobian(self, frames: FrameBatch, u: Array) -> Array:
        """Return the derivatives (s, 2, m) of the whitened model with respect to u."""
        found, m = self._project(frames, u), len(self.rows)
        out = np.zeros((len(self.instrument_parameters), 2, m))
        start = 0
        for number, camera in enumerate(self.rig.cameras):
            of_camera = _samples_of(self.camera, number)
            out[start : start + 6, :, of_camera] = found.by_camera(number, of_camera).swapaxes(0, 1)
            start += 6
            if camera.intrinsics != "fixed":
                size = len(camera.values)
                out[start : start + size, :, of_camera] = found.by_lens[number].swapaxes(0, 1)
                start += size
        for number, board in enumerate(self.rig.boards):
            of_board = _samples_of(self.board, number)
            out[start : start + 6, :, of_board] = found.by_board(number, of_board).swapaxes(0, 1)
            start += 6
            if board.has_free_points:
                for axis in range(3):
                    columns = start + 3 * self.corner[of_board] + axis
                    out[columns, :, np.arange(m)[of_board]] = found.by_point[:, axis, of_board].T
                start += 3 * len(board.points)
        return self._whiten(out)

    def errors(self, frames: FrameBatch, u: Array) -> dict[str, Array]:
        """Return the errors "pixels" (m, 2) [px] and "board" (m, 3) [m].

        The error at the board is the smallest displacement of the corner, in axes of the camera, that
        explains the error e in the image to first order: Bᵀ·(B·Bᵀ)⁻¹·e with the derivative B of the image.
        """
        found = self._project(frames, u)
        pixels = self.values - found.pixels.T
        by_local = found.by_local.transpose(2, 0, 1)
        board = (
            by_local.swapaxes(1, 2) @ _solve_symmetric(by_local @ by_local.swapaxes(1, 2), pixels)[..., None]
        )
        return {"pixels": pixels, "board": board[..., 0]}

    def displacement_derivative(self, frames: FrameBatch, u: Array) -> Array:
        """Return the derivative of the image coordinates by a displacement of the tool.

        Args:
            frames: Frames of the chain at `configurations()`.
            u: Values of the instrument parameters, (s,).

        Returns:
            Derivatives by [v, ω] in axes of the measuring frame, (m, 2, 6) [px/m and px/rad].
        """
        return self._project(frames, u).by_velocity.transpose(2, 0, 1)

    def corner_derivative(self, frames: FrameBatch, u: Array) -> Array:
        """Return the derivative of the image coordinates by a displacement of the corner.

        Args:
            frames: Frames of the chain at `configurations()`.
            u: Values of the instrument parameters, (s,).

        Returns:
            Derivatives in axes of the camera, (m, 2, 3) [px/m].
        """
        return self._project(frames, u).by_local.transpose(2, 0, 1)

    def initialized(self, chain: Chain) -> Self:
        """Return a copy with first values of all parameters that have none, from the images themselves."""
        return self.initialized_from(chain, np.ones(len(self.rows), bool))

    def initialized_from(self, chain: Chain, is_used: Array, is_kept: Array | None = None) -> Self:
        """Return a copy with first values from some of the images; lenses are those of all images."""
        kept = self if is_kept is None else self.take(is_kept)
        if all(np.isfinite(p.nominal) for p in self.instrument_parameters):
            return kept
        try:
            return kept.with_values(images.first_values(self.corners, self.board_views, chain, is_used))
        except NotObservableError as error:
            where = f"{self.source}: " if self.source else ""
            raise NotObservableError(f"{where}{error}") from None

    @cached_property
    def board_views(self) -> images.BoardViews:
        """Poses of the boards in the cameras, from each image alone."""
        return images.estimate_views(self.corners)

    @property
    def shown_poses(self) -> tuple[Array, Array]:
        """One corner (k,) of each image that shows a pose, and these poses of the tool (k, 4, 4)."""
        return images.moving_poses(self.corners, self.board_views)

    def tool_poses(self) -> Pose:
        """Return the poses of the tool, for some base and some tool, that the images show one by one.

        Their standard deviations contain the errors of a lens that is not calibrated yet.
        """
        samples, poses = self.shown_poses
        information = images.moving_information(self.corners, self.board_views, samples)
        variances = np.einsum("mii->mi", images.pose_covariances(poses, information))
        sigma = _SHOWN_NOISE_FACTOR * np.sqrt(variances)
        return Pose(self.q[samples], poses, sigma[:, :3], sigma[:, 3:])

    def image_poses(self) -> images.ImagePose:
        """Return the same poses with their covariances, lines and conditions."""
        samples, poses = self.shown_poses
        information = images.moving_information(self.corners, self.board_views, samples)
        return images.ImagePose.of(self.q[samples], poses, information).replace(
            rows=self.rows[samples],
            source=self.source,
            recorded=self.recorded and self.recorded[samples],
            has_joint_values=self.has_joint_values,
        )

    # ------------------------------------------------------------------------------------------- files
    def _columns_and_sigmas(self) -> tuple[dict[str, Any], dict[str, Any]]:
        values = {
            "u": self.values[:, 0],
            "v": self.values[:, 1],
            "corner": [str(number) for number in self.corner],
            "camera": [self.rig.cameras[number].name for number in self.camera],
            "board": [self.rig.boards[number].name for number in self.board],
        }
        if any(self.image_names):
            values["image"] = self.image_names
        return values, {"sigma_u": self.sigma[:, 0], "sigma_v": self.sigma[:, 1]}

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Self:
        """Return images of six points on the tool, by two cameras in turn that look at the robot."""
        q = conditions.q
        rig = mount_rig(simulated_rig(chain, q), chain)
        corner = np.tile(np.arange(6), len(q))
        camera = [rig.cameras[i % 2].name for i in range(len(q)) for _ in range(6)]
        # The scale is one pixel per millimetre at the robot: noise of a millimetre is noise of a pixel.
        sigma = _SCALE * noise.position
        shown = conditions[np.repeat(np.arange(len(q)), 6)]
        exact = cls(shown.q, np.full((len(corner), 2), 2048.0), corner, rig, camera)
        u = np.array([parameter.nominal for parameter in exact.instrument_parameters])
        pixels = exact._project(chain.forward_kinematics(shown), u).pixels.T
        pixels = pixels + sigma * rng.standard_normal(pixels.shape)
        # The place of the points on the tool is known, that of the cameras is not.
        without_guess = tuple(replace(camera, pose=None) for camera in rig.cameras)
        seen = cls(exact.q, pixels, corner, replace(rig, cameras=without_guess), camera, None, sigma or None)
        return seen.replace(recorded=shown if shown.names else None)


def simulated_rig(chain: Chain, q: Array) -> Rig:
    """Return two fixed cameras, large enough for the robot, that look at six points on the tool in turn."""
    poses = chain.poses(q) if len(q) else np.eye(4)[None]
    centre = poses[:, :3, 3].mean(0)
    distance = _DISTANCE * max(1.0, float(np.abs(poses[:, :3, 3] - centre).max()))
    points = _BOARD_SIZE * np.array(
        [[1, 0.1, 0], [-1, 0, 0.2], [0.1, 1, -0.1], [0, -1, 0.1], [0.2, 0.1, 1], [0, 0.2, -1]]
    )
    tips = (poses @ se3.inverse(chain.tool))[:, None]
    corners = (tips[..., :3, :3] @ points[..., None])[..., 0] + tips[..., :3, 3]
    cameras = {}
    for i, (name, direction) in enumerate((("left", [1.0, 0.2, 0.1]), ("right", [-0.1, 1.0, 0.3]))):
        forward = np.array(direction) / np.linalg.norm(direction)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose = se3.transform(
            np.column_stack([right, np.cross(forward, right), forward]), centre - distance * forward
        )
        right, down, depth = np.moveaxis((corners[i::2] - pose[:3, 3]) @ pose[:3, :3], -1, 0)
        offset = _SCALE * distance * np.maximum(np.abs(right), np.abs(down)) / depth
        half = math.ceil(max(_HALF_IMAGE, _IMAGE_MARGIN * offset.max(initial=0.0)))
        values = np.array([_SCALE * distance] * 2 + [half - 0.5] * 2 + [0.0] * 5)
        cameras[name] = Camera(name, WORLD, 2 * half, 2 * half, values, intrinsics="fixed", pose=pose)
    board = Board("target", "tip", "points", listed_points=points, pose=np.eye(4))
    return Rig(cameras, {"target": board})


def _end_poses(parts: Sequence[Array], mounts: Sequence[Any]) -> tuple[Array, Array]:
    """Return poses in the frames of the ends (c, 4, 4), and derivatives by rotation vectors (c, 3, 3)."""
    values = np.array([part[:6] for part in parts])
    links = np.array([mount.link_pose for mount in mounts])
    rotations, jacobians = exp_and_jacobian(values[:, 3:])
    # A change δ of the rotation vector turns the pose by exp([L·δ]×), in axes of the end, with L = R_link·Jl.
    return links @ se3.transform(rotations, values[:, :3]), links[:, :3, :3] @ jacobians


def exp_and_jacobian(rotvec: Array) -> tuple[Array, Array]:
    """Compute exp(φ) and the left Jacobian of SO(3): exp(φ + δ) = exp(Jl·δ)·exp(φ) to first order."""
    first, second, third = (c[..., None, None] for c in se3.exp_coefficients(np.linalg.norm(rotvec, axis=-1)))
    k = se3.skew(rotvec)
    square = k @ k
    return np.eye(3) + first * k + second * square, np.eye(3) + second * k + third * square


def select_images(data: Sequence[Measurement]) -> list[CameraCorners]:
    """Return the image coordinates among measurements."""
    return [item for item in data if isinstance(item, CameraCorners)]


def change_images(
    data: Sequence[Measurement], change: Callable[[CameraCorners], CameraCorners]
) -> tuple[Measurement, ...]:
    """Return measurements whose image coordinates are changed by a function."""
    return tuple(change(item) if isinstance(item, CameraCorners) else item for item in data)


def with_shown_entries(data: Sequence[Measurement]) -> tuple[Measurement, ...]:
    """Return measurements whose rigs have the cameras and boards that any of their images shows."""
    images = select_images(data)
    cameras = {item.rig.cameras[i].name for item in images for i in np.unique(item.camera)}
    boards = {item.rig.boards[i].name for item in images for i in np.unique(item.board)}
    return change_images(data, lambda item: item._with_entries(cameras, boards))


def _solve_symmetric(matrices: Array, right: Array) -> Array:
    """Solve A·x = b for positive matrices (m, 2, 2), which rounding may make singular, and b (m, 2)."""
    a, b, c = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    # Corners far outside of the image of a wrong model have squares that overflow.
    scale = np.fmax(np.maximum(a, c), np.finfo(float).tiny)
    a, b, c = a / scale, b / scale, c / scale
    determinant = np.maximum(a * c - b * b, np.finfo(float).eps * a * c)
    x, y = right.T / scale
    numerators, is_known = np.stack([c * x - b * y, a * y - b * x], 1), determinant[:, None] > 0
    # NaN for a matrix of zeros, such as that of a corner behind the camera.
    return np.divide(numerators, determinant[:, None], np.full_like(numerators, np.nan), where=is_known)


def _samples_of(numbers: Array, number: int) -> slice | Array:
    """Return the index of the samples with a number, a slice without copies if all samples have it."""
    return slice(None) if np.all(numbers == number) else np.flatnonzero(numbers == number)


def _of_samples(values: Array, numbers: Array) -> Array:
    """Return values (..., c) of cameras or boards for each sample, (..., m); for all of them if c is 1."""
    return values if values.shape[-1] == 1 else values.take(numbers, axis=-1)


def _by_pose(by_position: Array, link: Array, by_rotation: Array, turn: Array) -> Array:
    """Return derivatives (2, 6, k) by a pose from those by its position and rotation in its end."""
    return np.concatenate([link.T @ by_position, turn.T @ by_rotation], 1)


def _rotate(rotations: Array, vectors: Array) -> Array:
    """Return R·v of rotations (3, 3, m) and vectors (3, m)."""
    return rotations[:, 0] * vectors[0] + rotations[:, 1] * vectors[1] + rotations[:, 2] * vectors[2]


def _product(a: Array, b: Array) -> Array:
    """Return the products of matrices (i, 3, m) and (3, k, m)."""
    # Sums of three products take less than half the time of np.einsum.
    return a[:, :1] * b[0] + a[:, 1:2] * b[1] + a[:, 2:] * b[2]


def _cross(rows: Array, vectors: Array) -> Array:
    """Return rows·[v]× of rows (i, 3, m) and vectors (3, m)."""
    (a, b, c), (x, y, z) = rows.swapaxes(0, 1), vectors
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], 1)


def _numbers(names: Sequence[str] | None, known: Sequence[str], m: int, what: str) -> Array:
    """Return the number (m,) of each sample's camera or board."""
    if names is None:
        if len(known) != 1:
            raise InvalidArgumentError(
                f"the rig has {len(known)} entries [{what}.NAME]; expected a column {what!r} that names one "
                "per row"
            )
        return np.zeros(m, int)
    if len(names) != m:
        raise InvalidArgumentError(f"CameraCorners: {what} has {len(names)} names for {m} samples")
    numbers = {name: i for i, name in enumerate(known)}
    for i, name in enumerate(names):
        if name not in numbers:
            raise SampleError(
                i, f"column {what!r}: {name!r} is not in the rig; choose from {', '.join(known)}"
            )
    return np.array([numbers[name] for name in names], int)


def _corner_numbers(corner: Sequence[Any] | Array, rig: MountedRig, board: Array) -> Array:
    """Return the numbers (m,) of the corners after a check that the boards have them."""
    if len(corner) != len(board):
        raise InvalidArgumentError(
            f"CameraCorners: corner has {len(corner)} numbers for {len(board)} samples"
        )
    counts = [len(each.points) for each in rig.boards]
    out = np.empty(len(board), int)
    for i, (value, number) in enumerate(zip(corner, board.tolist(), strict=True)):
        text = str(value).strip()
        if not text.isdecimal() or int(text) >= counts[number]:
            raise SampleError(
                i,
                f"column 'corner': {text!r} is not a corner of board {rig.boards[number].name!r}; expected a "
                f"whole number from 0 to {counts[number] - 1}",
            )
        out[i] = int(text)
    return out


def _require_opposite_ends(item: CameraCorners) -> None:
    """Raise an error if a camera sees a board that does not move against it."""
    for camera, board in np.unique(np.stack([item.camera, item.board], 1), axis=0):
        if item.rig.camera_mounts[camera].moves == item.rig.board_mounts[board].moves:
            raise InvalidArgumentError(
                f"camera {item.rig.cameras[camera].name!r} sees board {item.rig.boards[board].name!r}, which "
                "no joint moves against it; expected one on the moving end of the robot and the other one "
                f"not: correct a link in {item.rig.source or 'the rig'}"
            )


def _require_inside_images(item: CameraCorners) -> None:
    """Raise an error if a corner lies far outside the images that the rig states."""
    sizes = np.array([[camera.width, camera.height] for camera in item.rig.cameras])[item.camera]
    outside = np.any((item.values < -0.5 * sizes) | (item.values > 1.5 * sizes), 1)
    if outside.any():
        first = int(np.flatnonzero(outside)[0])
        camera = item.rig.cameras[item.camera[first]]
        u, v = item.values[first]
        of_camera = item.camera == item.camera[first]
        is_exchanged = np.all(item.values[of_camera] <= [camera.height, camera.width])
        hint = "check width and height"
        if is_exchanged:
            hint = "u and v are exchanged, or width and height are exchanged"
        raise SampleError(
            first,
            f"u = {u:.6g}, v = {v:.6g} px is far outside the images of camera {camera.name!r} of "
            f"{camera.width} x {camera.height} px; {hint} in {item.rig.source or 'the rig'}",
        )
