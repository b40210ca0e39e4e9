"""Simulated touches of a small planar arm with a turning base and wrist, as hobby arms are built."""

from dataclasses import dataclass

import numpy as np

from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Noise, PointContact, PointDistance
from dhcal_pin.robot import Chain, parse_urdf

JOINTS = ("yaw", "shoulder", "elbow", "pitch", "roll")
_ORIGINS = ("0 0 0.06", "0.03 0 0.055", "0.03 0 0.115", "0.135 0 0.005", "0.06 0 0", "0.09 0 0")
_AXES = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "1 0 0")


def urdf() -> str:
    """Return the nominal arm."""
    parts = ["".join(f'<link name="l{i}"/>' for i in range(7))]
    for i, name in enumerate(JOINTS):
        parts.append(
            f'<joint name="{name}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/>'
            f'<origin xyz="{_ORIGINS[i]}"/><axis xyz="{_AXES[i]}"/>'
            '<limit lower="-1.6" upper="1.6" effort="5" velocity="3"/></joint>'
        )
    parts.append(
        '<joint name="tip_fixed" type="fixed"><parent link="l5"/><child link="l6"/>'
        f'<origin xyz="{_ORIGINS[5]}"/></joint>'
    )
    return f'<robot name="hobby">{"".join(parts)}</robot>'


NOMINAL = Chain.from_urdf(parse_urdf(urdf().encode(), "hobby.urdf"), "l6")


@dataclass(frozen=True, eq=False)
class TouchingArm:
    """Arm with errors of lengths and zeros, some joints of which turn the other way."""

    truth: Chain
    signs: np.ndarray  # (5,)
    data: list[PointContact | PointDistance]  # Touches at the values that the joints report, and distances

    @classmethod
    def random(
        cls, seed: int, m: int, n_points: int = 4, turned: tuple[str, ...] = (), noise: float = 5e-4
    ) -> "TouchingArm":
        """Draw an arm with zeros within 12° and lengths of 2 mm, and touches of points [m]."""
        rng = np.random.default_rng(seed)
        errors = select_parameters(NOMINAL, "low-cost")
        sizes = [
            rng.uniform(-0.2, 0.2) if p.name.endswith("offset") else 2e-3 * rng.normal() * (p.unit == "m")
            for p in errors.parameters
        ]
        truth = errors.at(np.array(sizes))
        signs = np.where(np.isin(JOINTS, turned), -1.0, 1.0)
        sets = [
            PointContact.simulate(truth, rng.uniform(-1.4, 1.4, (4 * m // n_points, 5)), Noise(noise), rng)
            for _ in range(n_points // 4)
        ]
        points = [truth.poses(c.q[c.label == i])[:, :3, 3].mean(0) for c in sets for i in range(4)]
        names = [f"p{4 * k + label}" for k, c in enumerate(sets) for label in c.label]
        q = signs * np.concatenate([c.q for c in sets])
        pairs = [(i, j) for i in range(n_points) for j in range(i)]
        lengths = [np.linalg.norm(points[i] - points[j]) for i, j in pairs]
        # Servos report whole counts.
        counts = np.round(q * 4096 / (2 * np.pi))
        touches = PointContact(counts * 2 * np.pi / 4096, names)
        distances = PointDistance(5, [(f"p{i}", f"p{j}") for i, j in pairs], lengths, noise)
        return cls(truth, signs, [touches, distances])

    def error(self, chain: Chain, q: np.ndarray) -> float:
        """Return the RMS error at reported joint values (m, 5), on the base that fits best [m]."""
        found, true = chain.poses(q)[:, :3, 3], self.truth.poses(q * self.signs)[:, :3, 3]
        move = _motion(found, true)
        return float(np.sqrt(np.mean(np.sum((found @ move[:3, :3].T + move[:3, 3] - true) ** 2, 1))))


def _motion(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the rigid motion (4, 4) of points to others (m, 3), by Kabsch's method."""
    means = points.mean(0), others.mean(0)
    u, _, vt = np.linalg.svd((others - means[1]).T @ (points - means[0]))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, means[1] - rotation @ means[0]
    return out
