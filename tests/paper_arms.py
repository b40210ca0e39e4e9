"""Simulated servo arms that are photographed: a printed board and a camera of unknown lens.

The camera stands on the table and the board is on the gripper, or the reverse. The joints have play, zero
errors and wrong signs, links and axes are displaced, and gravity bends the joints. Kinematics and gravity
torques are those of Pinocchio.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin
from camera_setups import look_at
from servo_arms import JOINTS, RANGES, SO101, TIP, ServoArm

from dhcal_pin import Chain, read_robot
from dhcal_pin.cameras import LENSES, Board, Camera, Rig
from dhcal_pin.measurements import CameraCorners
from dhcal_pin.measurements.mounting import MountedRig, mount_rig
from dhcal_pin.plausibility.signs import with_wide_limits
from dhcal_pin.robot import Conditions
from dhcal_pin.se3 import inverse, transform

WIDTH, HEIGHT = 1280, 720
# Play [deg] and compliance [rad/(N·m)] of each joint: the stretched arm sags by some millimetres.
PLAY, COMPLIANCE = 0.5, 0.012
# Corners of the board on the table and of that on the gripper: columns, rows and size of a square [m].
ON_TABLE, ON_GRIPPER = (10, 7, 0.025), (7, 5, 0.012)


@dataclass(frozen=True, eq=False)
class PaperArm:
    """Photographs of a board with counts of the servos, and the truth."""

    arm: ServoArm
    nominal: Chain
    images: CameraCorners
    held_out: tuple[
        np.ndarray, np.ndarray
    ]  # Joint values as read (k, 5), true poses of the board in the camera
    # Directions of approach of the photographs (m, 5) and of the held-out poses (k, 5).
    approach: tuple[np.ndarray, np.ndarray]

    def with_approach(self) -> PaperArm:
        """Return the same photographs with stated directions of approach."""
        return replace(self, images=self.images.with_conditions(approach=self.approach[0]))

    def held_out_errors(
        self, chain: Chain, instruments: dict[str, float], *, is_approach_known: bool = False
    ) -> np.ndarray:
        """Return the distances of the middle of the board in the camera from the truth, (k,) [m]."""
        found, truth = self._middles(chain, instruments, is_approach_known)
        return np.linalg.norm(found - truth, axis=1)

    def tool_errors(
        self, chain: Chain, instruments: dict[str, float], *, is_approach_known: bool = False
    ) -> np.ndarray:
        """Return these distances (k,) [m] for the camera at its best pose: they are errors of the arm alone.

        The image centre of a lens that is not known can be exchanged for a rotation of the camera.
        """
        found, truth = (each - each.mean(0) for each in self._middles(chain, instruments, is_approach_known))
        u, _, v = np.linalg.svd(truth.T @ found)
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
        return np.linalg.norm(found @ rotation.T - truth, axis=1)

    def _middles(
        self, chain: Chain, instruments: dict[str, float], is_approach_known: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the computed and the true middle of the board in the camera, (k, 3) each [m]."""
        q, truth = self.held_out
        conditions = Conditions(q, approach=self.approach[1]) if is_approach_known else q
        rig, tools = self.images.rig, chain.poses(conditions)
        camera, board = (_pose(instruments, name) for name in ("camera_cam", "board_paper"))
        if rig.camera_mounts[0].moves:
            found = inverse(tools @ camera) @ board
        else:
            found = inverse(camera) @ tools @ board
        middle = np.append(rig.boards[0].points.mean(0), 1.0)
        return (found @ middle)[:, :3], (truth @ middle)[:, :3]


def _pose(values: dict[str, float], name: str) -> np.ndarray:
    """Return the pose of a camera or a board of instrument parameters."""
    x = np.array([values[f"{name}.{axis}"] for axis in ("x", "y", "z", "rx", "ry", "rz")])
    return transform(pin.exp3(x[3:]), x[:3])


def nominal_arm() -> Chain:
    """Return the nominal arm with the errors of a low-cost arm."""
    return replace(with_wide_limits(read_robot(SO101, tip=TIP)), parameters="low-cost")


def photograph(
    seed: int,
    n_images: int = 25,
    *,
    is_on_wrist: bool | None = None,
    wrong: int | None = None,
    play: float = PLAY,
    compliance: float = COMPLIANCE,
) -> PaperArm:
    """Simulate the photographs of an arm; a seed gives another arm, camera and board."""
    rng = np.random.default_rng(seed)
    scene = replace(_Scene.random(rng, is_on_wrist, wrong), play=play, compliance=compliance)
    q = scene.arm.configurations(rng, 4000, 0.8)
    sides = rng.choice([-1.0, 1.0], q.shape)
    scene = scene.placed(rng)
    shown = scene.show(q, sides)
    good = shown.good()
    if len(good) < 2 * n_images:
        return photograph(
            seed + 10_000,
            n_images,
            is_on_wrist=scene.camera.link == "tip",
            wrong=wrong,
            play=play,
            compliance=compliance,
        )
    images, approach = scene.detect(shown, good[:n_images], rng)
    return shown.paper_arm(scene.arm, images, approach, good[n_images:])


def photograph_plan(
    seed: int, choose: Callable[[Chain, MountedRig], np.ndarray], *, is_on_wrist: bool
) -> PaperArm:
    """Photograph poses (m, 5) that are chosen with the nominal arm and a rig that is about right.

    The arm is led to the poses by hand, with errors of 3 degrees in each joint. Poses without a view of the
    board are left out.
    """
    rng = np.random.default_rng(seed)
    scene, nominal = _Scene.random(rng, is_on_wrist, None).placed(rng).facing(), nominal_arm()
    camera, board = (
        pose @ transform(pin.exp3(rng.normal(0, 0.05, 3)), rng.normal(0, 0.01, 3))
        for pose in (scene.camera_pose, scene.board_pose)
    )
    lens = np.array([1000.0, 1000.0, 639.5, 359.5, 0, 0, 0, 0, 0])
    rig = Rig(
        {"cam": replace(scene.camera, values=lens, pose=camera)}, {"paper": replace(scene.board, pose=board)}
    )
    q = choose(nominal, mount_rig(rig, nominal))
    q = q + rng.normal(0, np.deg2rad(3), q.shape)
    shown = scene.show(q, rng.choice([-1.0, 1.0], q.shape))
    images, approach = scene.detect(shown, shown.good(8), rng)
    return shown.paper_arm(scene.arm, images, approach, np.arange(len(q)))


@dataclass(frozen=True, eq=False)
class _Shown:
    """Board in images of m configurations."""

    read: np.ndarray  # Joint values as read, (m, 5)
    local: np.ndarray  # Poses in the camera, (m, 4, 4)
    pixels: np.ndarray  # Corners in the image, (m, c, 2)
    is_seen: np.ndarray  # Which corners are found, (m, c)
    approach: np.ndarray  # Directions in which the joints moved last, as read, (m, 5)

    def good(self, n_corners: int = 12) -> np.ndarray:
        """Numbers of the configurations with enough corners."""
        return np.flatnonzero(self.is_seen.sum(1) >= n_corners)

    def paper_arm(
        self, arm: ServoArm, images: CameraCorners, approach: np.ndarray, others: np.ndarray
    ) -> PaperArm:
        """Return photographs with other configurations to judge a calibration by."""
        held_out = self.read[others], self.local[others]
        return PaperArm(arm, nominal_arm(), images, held_out, (approach, self.approach[others]))


@dataclass(frozen=True, eq=False)
class _Scene:
    """Arm, camera and board."""

    arm: ServoArm
    board: Board
    camera: Camera
    lens: np.ndarray
    camera_pose: np.ndarray = field(default_factory=lambda: np.eye(4))
    board_pose: np.ndarray = field(default_factory=lambda: np.eye(4))
    play: float = PLAY
    compliance: float = COMPLIANCE

    @classmethod
    def random(cls, rng: np.random.Generator, is_on_wrist: bool | None, wrong: int | None) -> _Scene:
        arm = ServoArm.random(rng, wrong=wrong)
        arm = replace(arm, base=pin.SE3.Identity(), tool=pin.SE3.Identity())
        is_on_wrist = bool(rng.integers(2)) if is_on_wrist is None else is_on_wrist
        columns, rows, square = ON_TABLE if is_on_wrist else ON_GRIPPER
        board = Board("paper", "world" if is_on_wrist else "tip", "checkerboard", columns=columns, rows=rows,
                      square=square)  # fmt: skip
        focal = rng.uniform(850, 1150)
        lens = np.array([focal, focal * rng.uniform(0.995, 1.005), 639.5 + rng.normal(0, 12),
                         359.5 + rng.normal(0, 12), rng.uniform(-0.2, 0.1), rng.normal(0, 0.03),
                         *rng.normal(0, 5e-4, 2), 0.0])  # fmt: skip
        camera = Camera("cam", "tip" if is_on_wrist else "world", WIDTH, HEIGHT, np.full(9, np.nan),
                        LENSES["pinhole"], "free")  # fmt: skip
        return cls(arm, board, camera, lens)

    def placed(self, rng: np.random.Generator) -> _Scene:
        """Place camera and board in their links."""
        camera, board = _places(rng, self.board, self.camera.link == "tip")
        return replace(self, camera_pose=camera, board_pose=board)

    def facing(self) -> _Scene:
        """Turn the printed side of the board to the camera: its z axis points away from it."""
        if self.camera.link == "tip" and self.board_pose[2, 2] < 0:
            return self
        middle = transform(np.eye(3), self.board.points.mean(0))
        half_turn = transform(pin.exp3(np.array([np.pi, 0.0, 0.0])), np.zeros(3))
        return replace(self, board_pose=self.board_pose @ middle @ half_turn @ inverse(middle))

    def show(self, q: np.ndarray, sides: np.ndarray) -> _Shown:
        """Photograph the board at true joint values (m, 5), on side 1 or -1 of the play of each joint."""
        bent = _sagged(self.arm.model, q + np.deg2rad(self.play) / 2 * sides, self.compliance)
        tools = self.arm.poses(bent)
        if self.camera.link == "tip":
            local = inverse(tools @ self.camera_pose) @ self.board_pose
        else:
            local = inverse(self.camera_pose) @ tools @ self.board_pose
        points = np.einsum("kij,cj->kci", local[:, :3, :3], self.board.points) + local[:, None, :3, 3]
        pixels = LENSES["pinhole"].project(points.reshape(-1, 3).T, self.lens)[0].T
        pixels = pixels.reshape(*points.shape[:2], 2)
        is_seen = np.all((pixels > 5) & (pixels < [WIDTH - 6, HEIGHT - 6]), 2)
        is_seen &= (points[..., 2] > 0.08) & (points[..., 2] < 0.7)
        is_seen &= np.linalg.norm(points[..., :2], axis=2) < 0.8 * points[..., 2]
        # The printed side faces the camera, less than 60 degrees aside.
        facing = np.sum(local[:, :3, 2] * local[:, :3, 3], 1) / np.linalg.norm(local[:, :3, 3], axis=1)
        is_seen &= (np.abs(facing) > 0.5)[:, None]
        middles = np.array([sum(RANGES[name]) / 2 for name in JOINTS])
        read = np.deg2rad(360.0 * (self.arm.counts(q) - middles) / 4095.0)
        # A joint lags behind its motion.
        return _Shown(read, local, pixels, is_seen, -self.arm.signs * sides)

    def detect(
        self, shown: _Shown, chosen: np.ndarray, rng: np.random.Generator
    ) -> tuple[CameraCorners, np.ndarray]:
        """Return the corners of some images with noise, and their directions of approach."""
        image, corner = np.nonzero(shown.is_seen[chosen])
        values = shown.pixels[chosen][image, corner] + rng.normal(0, 0.3, (len(image), 2))
        rig = mount_rig(Rig({"cam": self.camera}, {"paper": self.board}), nominal_arm())
        images = CameraCorners(shown.read[chosen][image], values, corner, rig)
        return images, shown.approach[chosen][image]


def _sagged(model: pin.Model, q: np.ndarray, compliance: float) -> np.ndarray:
    """Return joint values (m, 5) with the deflection by gravity."""
    indices = [model.joints[model.getJointId(name)] for name in JOINTS]
    data, out = model.createData(), q.copy()
    for row, bent in zip(q, out, strict=True):
        values = pin.neutral(model)
        values[[j.idx_q for j in indices]] = row
        torque = pin.computeGeneralizedGravity(model, data, values)
        bent -= compliance * torque[[j.idx_v for j in indices]]
    return out


def _places(rng: np.random.Generator, board: Board, is_on_wrist: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses of camera and board in their links."""
    centre = transform(np.eye(3), -board.points.mean(0))
    small = transform(pin.exp3(rng.normal(0, 0.1, 3)), rng.uniform(-0.01, 0.01, 3))
    if is_on_wrist:
        # Board on the table in front of the arm; camera above the gripper, tilted towards its tip.
        turned = transform(pin.exp3(np.array([np.pi, 0, 0]) * rng.integers(2)), np.zeros(3))
        place = transform(pin.exp3(np.array([0, 0, rng.uniform(-3, 3)])), [rng.uniform(0.18, 0.28), 0.0, 0.0])
        pose = look_at(np.array([-0.06, 0.0, 0.06]), np.array([0.08, 0.0, 0.0]), rng.uniform(-0.2, 0.2))
        return small @ pose, place @ turned @ centre
    # Board on the side or the top of the gripper; camera on the table beside the arm or in front of it.
    side = rng.choice([-1.0, 1.0])
    angle = side * rng.uniform(0.3, 1.2)
    position = np.array([0.15 + 0.4 * np.cos(angle), 0.4 * np.sin(angle), rng.uniform(0.15, 0.35)])
    pose = look_at(position, np.array([0.18, 0.0, 0.15]), rng.uniform(-0.2, 0.2))
    # A board whose normal points forward and up, as on a clip in the gripper.
    normal = pin.exp3(np.array([0, -rng.uniform(0.2, 1.0), 0])) @ pin.exp3(np.array([0, np.pi / 2, 0]))
    return pose, transform(normal, [0.01, 0.0, 0.02]) @ small @ centre
