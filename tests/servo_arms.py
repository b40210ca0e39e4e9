"""Simulated servo arms: counts and measured tool poses, computed with Pinocchio and NumPy alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from robots import URDF

SO101 = URDF / "so101.urdf"
TIP = "gripper_frame_link"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
# Range of each motor as LeRobot records it; those of the first four are not symmetric about count 2047.
RANGES = {
    "shoulder_pan": (741, 3465),
    "shoulder_lift": (850, 3241),
    "elbow_flex": (900, 3100),
    "wrist_flex": (812, 3208),
    "wrist_roll": (0, 4095),
    "gripper": (2030, 3500),
}


def lerobot_degrees(count: Any, low: int, high: int) -> Any:
    """Return what LeRobot reports in degrees: 4095 steps a turn, zero in the middle of the range."""
    middle = low + 0.5 * (high - low)
    return 360.0 * (count - middle) / 4095.0


def forward_kinematics(urdf: str, q: Mapping[str, float], tip: str = TIP) -> np.ndarray:
    """Return the pose of the tip (4, 4) of a URDF text with Pinocchio."""
    model = pin.buildModelFromXML(urdf)
    return _tip_pose(model, q, tip)


def _tip_pose(model: pin.Model, q: Mapping[str, float], tip: str = TIP) -> np.ndarray:
    data, values = model.createData(), pin.neutral(model)
    for name, value in q.items():
        values[model.joints[model.getJointId(name)].idx_q] = value
    pin.framesForwardKinematics(model, data, values)
    return data.oMf[model.getFrameId(tip)].homogeneous.copy()


@dataclass(frozen=True, eq=False)
class ServoArm:
    """Servo arm with errors: joint = sign·(degrees of LeRobot) + zero, on a base somewhere."""

    model: pin.Model
    base: pin.SE3
    tool: pin.SE3
    zeros: np.ndarray  # Zero errors, (5,) [rad]
    signs: np.ndarray  # (5,)

    @classmethod
    def random(
        cls, rng: np.random.Generator, zero_deg: float = 15.0, wrong: int | None = None, path: Path = SO101
    ) -> ServoArm:
        """Draw an arm with errors of links, axes and zeros."""
        model = pin.buildModelFromUrdf(str(path))
        for name in JOINTS:
            error = np.concatenate([rng.normal(0, 1.5e-3, 3), rng.normal(0, np.deg2rad(1.0), 3)])
            j = model.getJointId(name)
            model.jointPlacements[j] = model.jointPlacements[j] * pin.exp6(error)
        signs, count = np.ones(5), int(rng.integers(0, 3)) if wrong is None else wrong
        signs[rng.choice(5, count, replace=False)] = -1
        return cls(
            model,
            pin.exp6(np.concatenate([rng.uniform(-1, 1, 3), rng.uniform(-1.5, 1.5, 3)])),
            pin.exp6(np.concatenate([rng.uniform(-0.03, 0.03, 3), rng.uniform(-1, 1, 3)])),
            np.deg2rad(rng.uniform(-zero_deg, zero_deg, 5)),
            signs,
        )

    @property
    def wrong(self) -> tuple[str, ...]:
        """Names of the joints that turn the other way."""
        return tuple(name for name, sign in zip(JOINTS, self.signs, strict=True) if sign < 0)

    def poses(self, q: np.ndarray) -> np.ndarray:
        """Return poses of the tool (m, 4, 4) at true joint values (m, 5) [rad]."""
        tips = [pin.SE3(_tip_pose(self.model, dict(zip(JOINTS, row, strict=True)))) for row in q]
        return np.stack([(self.base * tip * self.tool).homogeneous for tip in tips])

    def configurations(self, rng: np.random.Generator, m: int, share: float = 1.0) -> np.ndarray:
        """Draw true joint values (m, 5) from a share of the joint range."""
        indices = [self.model.joints[self.model.getJointId(name)].idx_q for name in JOINTS]
        lower, upper = self.model.lowerPositionLimit[indices], self.model.upperPositionLimit[indices]
        return rng.uniform(share * np.fmax(lower, -2.0), share * np.fmin(upper, 2.0), (m, 5))

    def counts(self, q: np.ndarray) -> np.ndarray:
        """Return the counts that the servos report, (m, 5)."""
        degrees = np.rad2deg(self.signs * (q - self.zeros))
        middles = np.array([sum(RANGES[name]) / 2 for name in JOINTS])
        return np.clip(np.round(degrees * 4095 / 360 + middles), 0, 4095).astype(int)

    def measure(
        self, rng: np.random.Generator, m: int, play_deg: float = 0.5, share: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return counts (m, 5) and poses (m, 4, 4) with play of the joints and noise of 0.5 mm and 2 mrad."""
        q = self.configurations(rng, m, share)
        poses = self.poses(q + np.deg2rad(play_deg) / 2 * rng.choice([-1.0, 1.0], q.shape))
        poses[:, :3, 3] += rng.normal(0, 5e-4, (m, 3))
        poses[:, :3, :3] @= np.stack([pin.exp3(v) for v in rng.normal(0, 2e-3, (m, 3))])
        return self.counts(q), poses


def lerobot_text(offsets: dict[str, int] | None = None) -> str:
    """Return a calibration as LeRobot writes it."""
    return json.dumps(
        {
            name: {
                "id": number,
                "drive_mode": 0,
                "homing_offset": (offsets or {}).get(name, 100 * number - 350),
                "range_min": low,
                "range_max": high,
            }
            for number, (name, (low, high)) in enumerate(RANGES.items(), 1)
        },
        indent=4,
    )


def counts_csv(counts: np.ndarray, poses: np.ndarray) -> str:
    """Return a measurement file with counts and positions."""
    rows = [",".join(f"{name}[ticks]" for name in JOINTS) + ",gripper[ticks],x[mm],y[mm],z[mm]"]
    rows += [
        ",".join([*map(str, c), "2100", *(f"{1e3 * v:.4f}" for v in pose[:3, 3])])
        for c, pose in zip(counts.tolist(), poses, strict=True)
    ]
    return "\n".join([*rows, ""])
