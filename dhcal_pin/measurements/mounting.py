"""Mounting of a rig: which cameras and boards move with the tip of a chain, and which stand still.

A chain has two ends: the measuring frame and the tool. Every camera and board of a rig is fixed to one of
them, directly or by a link that no joint moves against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..cameras.boards import Board
from ..cameras.rig import TIP, WORLD, Camera, Rig
from ..exceptions import InvalidArgumentError
from ..robot.chain import Chain


@frozen(eq=False)
class Mount:
    """How a camera or a board is fixed to a chain."""

    moves: bool  # Whether it moves with the tool; otherwise it is fixed in the measuring frame
    link_pose: Array  # Pose of its link in the tool frame or in the measuring frame, shape (4, 4) [m]


@frozen(eq=False)
class MountedRig:
    """Rig on a chain."""

    cameras: tuple[Camera, ...]  #: Cameras in the order of their numbers
    boards: tuple[Board, ...]  #: Boards in the order of their numbers
    camera_mounts: tuple[Mount, ...]  #: Mount of each camera
    board_mounts: tuple[Mount, ...]  #: Mount of each board
    source: str  #: Name of the rig file; empty for a rig from Python

    @property
    def has_links_to_exchange(self) -> bool:
        """Whether all cameras are on one end of the chain, and all boards on the other."""
        cameras, boards = (
            {mount.moves for mount in each} for each in (self.camera_mounts, self.board_mounts)
        )
        return len(cameras) == len(boards) == 1 and cameras != boards

    def with_exchanged_links(self) -> MountedRig:
        """Return the rig with cameras on the link of the first board, boards on that of the first camera."""
        camera, board = self.camera_mounts[0], self.board_mounts[0]
        return replace(
            self,
            camera_mounts=(board,) * len(self.cameras),
            board_mounts=(camera,) * len(self.boards),
        )

    def take(self, cameras: Sequence[int], boards: Sequence[int]) -> MountedRig:
        """Return the rig with some of its cameras and boards, given by their numbers."""
        return replace(
            self,
            cameras=tuple(self.cameras[i] for i in cameras),
            boards=tuple(self.boards[i] for i in boards),
            camera_mounts=tuple(self.camera_mounts[i] for i in cameras),
            board_mounts=tuple(self.board_mounts[i] for i in boards),
        )

    def camera_in_end(self, camera: int) -> Array:
        """Return the pose of a camera in the frame of its end, shape (4, 4) [m]."""
        return self.camera_mounts[camera].link_pose @ _stated_pose(self.cameras[camera])

    def board_in_end(self, board: int) -> Array:
        """Return the pose of a board in the frame of its end, shape (4, 4) [m]."""
        return self.board_mounts[board].link_pose @ _stated_pose(self.boards[board])

    def board_in_camera(self, camera: int, board: int, tools: Array) -> Array:
        """Compute poses of a board in a camera."""
        moves = self.camera_mounts[camera].moves
        if moves == self.board_mounts[board].moves:
            raise InvalidArgumentError(
                f"no joint moves board {self.boards[board].name!r} against camera "
                f"{self.cameras[camera].name!r}; expected one of them on the tool"
            )
        between = se3.inverse(tools) if moves else tools
        return se3.inverse(self.camera_in_end(camera)) @ between @ self.board_in_end(board)


def _stated_pose(entry: Camera | Board) -> Array:
    """Return the pose of a camera or a board in its link, (4, 4) [m], if the rig states it."""
    if entry.pose is None:
        raise InvalidArgumentError(
            f"the pose of {entry.name!r} in its link is not known; expected xyz_m and rotvec_rad in the rig"
        )
    return entry.pose


def mount_rig(rig: Rig, chain: Chain) -> MountedRig:
    """Find the end of the chain that each camera and board of a rig is fixed to.

    Args:
        rig: Cameras and boards.
        chain: Chain whose ends carry them.

    Returns:
        Mounted rig.

    Raises:
        InvalidArgumentError: A joint moves a link against both ends, or a link is unknown.
    """
    where = f"{rig.source}: " if rig.source else ""
    return MountedRig(
        tuple(rig.cameras.values()),
        tuple(rig.boards.values()),
        tuple(_mount(f"{where}[camera.{c.name}]", c.link, chain) for c in rig.cameras.values()),
        tuple(_mount(f"{where}[board.{b.name}]", b.link, chain) for b in rig.boards.values()),
        rig.source,
    )


def _mount(where: str, link: str, chain: Chain) -> Mount:
    """Return the mount of a link."""
    if link == TIP:
        return Mount(True, np.eye(4))
    if link == WORLD and WORLD not in chain.urdf.links:
        return Mount(False, np.eye(4))
    if link not in chain.urdf.links:
        raise InvalidArgumentError(
            f'{where}: link = "{link}" is not a link of {chain.urdf.source}; expected a link of the robot, '
            '"world" or "tip"'
        )
    if (pose := chain.fixed_pose(chain.tip, link)) is not None:
        return Mount(True, pose)
    if (pose := chain.fixed_pose(chain.root, link)) is not None:
        return Mount(False, pose)
    raise InvalidArgumentError(
        f'{where}: a joint moves link = "{link}" against {chain.root!r} and against {chain.tip!r}; expected '
        "a link that is fixed to one of these ends of the chain: choose them with --root and --tip"
    )
