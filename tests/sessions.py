"""Independent simulator of measuring sessions: Pinocchio and NumPy only, without the model of the project.

The true arm has errors of every joint origin. During a session the base, the tool, a joint zero or the links
change, joint values are late, or lengths are too long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin
from robots import ARMS, nominal_arm, robot_file
from scipy.interpolate import CubicSpline

from dhcal_pin.calibration import Result
from dhcal_pin.estimation.initialization import make_problem
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.measurements import (
    Measurement,
    MultiTargetPosition,
    PointContact,
    PointDistance,
    Pose,
    Position,
    Wires,
)
from dhcal_pin.robot import Chain
from dhcal_pin.se3 import nearest_rotation
from dhcal_pin.session import Session
from dhcal_pin.session.search import _Search
from dhcal_pin.session.timeline import order_samples

# Names of the arms whose sessions are simulated.
NAMES = ("ur10", "ur5", "panda", "xarm7")
NOISE, ANGLE_NOISE = 5e-5, 1e-4
ERRORS = 1e-3, np.deg2rad(0.2)


@dataclass
class Simulation:
    """Arm with errors and samples of it; `measure` returns measurements of one session."""

    arm: str
    count: int
    seed: int
    is_path: bool = False
    errors: tuple[float, float] = ERRORS
    q: np.ndarray = field(init=False)

    def __post_init__(self):
        """Draw the true arm, its frames and the configurations."""
        rng = self.rng = np.random.default_rng([self.seed, self.count])
        self.chain = nominal_arm(self.arm)
        self.model = pin.buildModelFromUrdf(str(robot_file(ARMS[self.arm][0])))
        self.ids = [self.model.getJointId(name) for name in self.chain.moving_joints]
        self.nominal = [self.model.jointPlacements[i].copy() for i in self.ids]
        self.disturb(self.model)
        self.base = _motion(rng.uniform(-2, 2, 3), rng.uniform(-1, 1, 3))
        self.tool = _motion(rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.5, 0.5, 3))
        low, high = np.maximum(self.chain.lower, -2.8), np.minimum(self.chain.upper, 2.8)
        if self.is_path:
            knots = self.count // 12 + 2
            path = CubicSpline(np.arange(knots), rng.uniform(0.2 * low, 0.2 * high, (knots, len(low))))
            self.q = path(np.linspace(0, knots - 1, self.count))
        else:
            self.q = rng.uniform(low, high, (self.count, len(low)))
        self.test_q = np.random.default_rng(1).uniform(low, high, (200, len(low)))

    def disturb(self, model: pin.Model) -> None:
        """Give a model errors of every joint origin."""
        for i, placement in zip(self.ids, self.nominal, strict=True):
            draw = [self.rng.normal(0, std, 3) for std in self.errors]
            model.jointPlacements[i] = placement * _motion(*draw)

    def poses(self, q: np.ndarray, model: pin.Model | None = None) -> list[pin.SE3]:
        """Return the tip poses in the base frame."""
        model = self.model if model is None else model
        assert model is not None
        data, out = model.createData(), []
        frame = model.getFrameId(self.chain.tip, pin.FrameType.BODY)
        for row in q:
            pin.framesForwardKinematics(model, data, self.configuration(row))
            out.append(data.oMf[frame].copy())
        return out

    def configuration(self, row: np.ndarray) -> np.ndarray:
        """Return the configuration of Pinocchio at joint positions (n,)."""
        configuration = pin.neutral(self.model)
        for i, value in zip(self.ids, row, strict=True):
            joint = self.model.joints[i]
            is_unbounded = joint.nq == 2
            values = (np.cos(value), np.sin(value)) if is_unbounded else (value,)
            configuration[joint.idx_q : joint.idx_q + joint.nq] = values
        return configuration

    def torques(self, q: np.ndarray, payload: np.ndarray) -> np.ndarray:
        """Return the gravity torques on the joints (m, n) under a payload (m,) at the tip [N·m]."""
        data = self.model.createData()
        frame = self.model.getFrameId(self.chain.tip, pin.FrameType.BODY)
        columns = [self.model.joints[i].idx_v for i in self.ids]
        out = []
        for row, mass in zip(q, payload, strict=True):
            at = self.configuration(row)
            own = pin.computeGeneralizedGravity(self.model, data, at)
            jacobian = pin.computeFrameJacobian(self.model, data, at, frame, pin.LOCAL_WORLD_ALIGNED)
            out.append((own + 9.81 * mass * jacobian[2])[columns])
        return np.array(out)

    def add_eccentricities(self, size: float) -> None:
        """Add errors with random sines and cosines of q to each joint [rad], and half as large ones of 2q."""
        factors = (
            self.rng.normal(0, size, (4, 1, self.chain.n_joints)) / np.array([1, 1, 2, 2])[:, None, None]
        )
        poses = self.poses

        def with_errors(q: np.ndarray, model: pin.Model | None = None) -> list[pin.SE3]:
            waves = np.array([np.sin(q), np.cos(q), np.sin(2 * q), np.cos(2 * q)])
            return poses(q + np.sum(factors * waves, 0), model)

        self.poses = with_errors

    def add_compliance(self, size: float) -> None:
        """Turn each joint by a compliance [rad/Nm] times its gravity torque."""
        poses = self.poses

        def bent(q: np.ndarray, model: pin.Model | None = None) -> list[pin.SE3]:
            return poses(q - size * self.torques(q, np.zeros(len(q))), model)

        self.poses = bent

    def direction(self) -> np.ndarray:
        """Draw a unit vector."""
        vector = self.rng.normal(size=3)
        return vector / np.linalg.norm(vector)

    def measure(self, kind: type[Measurement] = Position, changes: Changes | None = None) -> Measurement:
        """Return the measurements of a session in which something changes."""
        changes = changes or Changes()
        m, share = self.count, np.arange(self.count) / (self.count - 1)
        f = changes.shape(share)
        q, models = self.q.copy(), [self.model] * m
        if changes.joint is not None:
            q[:, changes.joint[0]] += changes.joint[1] * f
        if changes.lag:
            q = CubicSpline(np.arange(m), self.q)(np.arange(m) + changes.lag)
        if changes.growth:
            models = [self._grown(changes.growth * value) for value in f]
        along, about = self.direction(), self.direction()
        still = _motion(np.zeros(3), np.zeros(3))
        moved = [_motion(changes.length * v * along, changes.angle * v * about) for v in f]
        base = moved if changes.of == "base" else [still] * m
        tool = moved if changes.of == "tool" else [still] * m
        arms = [self.poses(row[None], model)[0] for row, model in zip(q, models, strict=True)]
        if changes.has_second_robot:
            other = self.model.copy()
            self.disturb(other)
            arms = [
                self.poses(row[None], other)[0] if v else pose
                for row, v, pose in zip(q, f, arms, strict=True)
            ]
        poses = [self.base * b * arm * self.tool * t for b, arm, t in zip(base, arms, tool, strict=True)]
        positions = np.array([pose.translation for pose in poses]) * np.array(changes.scales)
        positions += self.rng.normal(0, NOISE, (m, 3))
        for i in self.rng.permutation(m)[: changes.n_outliers]:
            positions[i] += changes.outlier * self.direction()
        self.end_model, self.end_zeros = models[-1], q[-1] - self.q[-1] if changes.joint else 0.0
        if kind is Position:
            return Position(self.q, positions)
        matrices = np.tile(np.eye(4), (m, 1, 1))
        matrices[:, :3, 3] = positions
        noise = self.rng.normal(0, ANGLE_NOISE, (m, 3))
        matrices[:, :3, :3] = [pose.rotation @ pin.exp3(w) for pose, w in zip(poses, noise, strict=True)]
        return Pose(self.q, matrices)

    def measure_wires(self, changes: Changes | None = None) -> Wires:
        """Return the lengths of four wires from known anchors."""
        pose = self.measure(Pose, changes)
        around = np.array([[1.5, 0, -1], [-1.2, 1.3, -1], [-1, -1.4, -1], [0.2, 0.3, 2.2]])
        anchors = self.base.translation + around
        lengths = np.linalg.norm(pose.positions()[:, None] - anchors, axis=2)
        return Wires(self.q, lengths, anchors=anchors, offsets=0.0)

    def measure_targets(self, changes: Changes | None = None) -> MultiTargetPosition:
        """Return the positions of three targets on the tool, one after the other at each configuration."""
        pose = self.measure(Pose, changes)
        offsets = np.array([[0.05, 0, 0], [0, 0.06, 0], [-0.04, -0.03, 0.02]])
        points = pose.positions()[:, None] + np.einsum("mij,tj->mti", pose.rotations(), offsets)
        points += self.rng.normal(0, NOISE, points.shape)
        labels = ["a", "b", "c"] * self.count
        return MultiTargetPosition(np.repeat(self.q, 3, 0), points.reshape(-1, 3), labels)

    def measure_contacts(
        self, changes: Changes | None = None, n_points: int = 4, visit: int = 1, plate: float = 0.0
    ) -> tuple[PointContact, PointDistance]:
        """Return touches of points and the distances of all pairs of them.

        The arm touches each point several times in a row, then the next one, and begins again. Base or tool
        or the touched points move by `changes`; the latter, by a length `plate`, in the opposite direction.
        """
        changes = changes or Changes()
        f = changes.shape(np.arange(self.count) / (self.count - 1))
        along, about = self.direction(), self.direction()
        zeros = np.zeros_like(self.q)
        if changes.joint is not None:
            zeros[:, changes.joint[0]] = changes.joint[1] * f
        points = np.array(
            [(self.base * pose * self.tool).translation for pose in self.poses(self.q[:n_points])]
        )
        label = np.arange(self.count) // visit % n_points
        q = np.empty_like(self.q)
        for i in range(self.count):
            moved = _motion(changes.length * f[i] * along, changes.angle * f[i] * about)
            tool = self.tool * moved if changes.of == "tool" else self.tool
            base = self.base * moved if changes.of == "base" else self.base
            target = points[label[i]] + plate * f[i] * along + self.rng.normal(0, NOISE, 3)
            q[i] = self._touching(target, base, tool, zeros[i])
        self.end_model, self.end_zeros = self.model, zeros[-1]
        pairs = [(i, j) for i in range(n_points) for j in range(i + 1, n_points)]
        distances = [np.linalg.norm(points[i] - points[j]) for i, j in pairs]
        distances += self.rng.normal(0, NOISE / 2, len(pairs))
        names = [(f"p{i + 1}", f"p{j + 1}") for i, j in pairs]
        contacts = PointContact(q, [f"p{i + 1}" for i in label])
        return contacts, PointDistance(q.shape[1], names, distances)

    def _touching(self, target: np.ndarray, base: pin.SE3, tool: pin.SE3, zeros: np.ndarray) -> np.ndarray:
        """Return joint values within the limits with which the tool point is at a target."""
        low, high = np.maximum(self.chain.lower, -2.8), np.minimum(self.chain.upper, 2.8)
        step = 1e-6

        def points(q: np.ndarray) -> np.ndarray:
            return np.array([(base * pose * tool).translation for pose in self.poses(q + zeros)])

        for _ in range(200):
            q, error = self.rng.uniform(low, high), np.full(3, np.inf)
            for _ in range(60):
                at, *moved = points(np.vstack([q, q + step * np.eye(len(q))]))
                error = at - target
                if np.linalg.norm(error) < 1e-9:
                    break
                jacobian = (np.array(moved) - at).T / step
                move = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-6 * np.eye(3), error)
                q = q - move * min(1.0, 0.5 / np.abs(move).max())
            if np.linalg.norm(error) < 1e-9 and np.all((q >= low) & (q <= high)):
                return q
        raise AssertionError("no configuration touches the point")

    def _grown(self, growth: float) -> pin.Model:
        """Return the arm with longer links."""
        model = self.model.copy()
        for i in self.ids:
            placement = model.jointPlacements[i].copy()
            placement.translation = placement.translation * (1 + growth)
            model.jointPlacements[i] = placement
        return model

    def true_error(self, chain: Chain) -> float:
        """Return the RMS error of an arm [m] at the end of the session, with the best base and tool point."""
        true = np.array(
            [
                (pose * self.tool).translation
                for pose in self.poses(self.test_q + self.end_zeros, self.end_model)
            ]
        )
        arm = chain.with_base_and_tool(np.eye(4), np.eye(4)).poses(self.test_q)
        tool = chain.tool[:3, 3].copy()
        errors = np.empty((0, 3))
        for _ in range(100):
            points = arm[:, :3, 3] + arm[:, :3, :3] @ tool
            turned = nearest_rotation((true - true.mean(0)).T @ (points - points.mean(0)))
            errors = true - true.mean(0) - (points - points.mean(0)) @ turned.T
            tool += 1.5 * np.einsum("mij,mi->j", arm[:, :3, :3], errors @ turned) / len(true)
        return float(np.sqrt(np.mean(np.sum(errors**2, 1))))


@dataclass(frozen=True)
class Changes:
    """What happens in a session: a step at a share of it, or a linear, exponential or periodic drift."""

    of: str = ""
    length: float = 0.0
    angle: float = 0.0
    joint: tuple[int, float] | None = None
    growth: float = 0.0
    lag: float = 0.0
    scales: tuple[float, float, float] = (1.0, 1.0, 1.0)
    n_outliers: int = 0
    outlier: float = 0.02
    has_second_robot: bool = False
    at: float | None = 0.5
    time_constant: float | None = None
    periods: float = 0.0

    def shape(self, share: np.ndarray) -> np.ndarray:
        """Return the change over the session, from 0 to about 1."""
        if self.at is not None:
            return (np.arange(len(share)) >= round(self.at * len(share))).astype(float)
        if self.periods:
            return 0.5 - 0.5 * np.cos(2 * np.pi * self.periods * share)
        if self.time_constant is None:
            return share
        return 1 - np.exp(-share / self.time_constant)


def _motion(v: np.ndarray, w: np.ndarray) -> pin.SE3:
    """Return the rigid motion of a twist."""
    return pin.exp6(np.concatenate([v, w]))


def write_csv(path: Path, simulation: Simulation, data: Measurement) -> None:
    """Write positions as a measurement file."""
    header = ",".join([*(f"{name}[rad]" for name in simulation.chain.joint_names), "x[m],y[m],z[m]"])
    np.savetxt(path, np.hstack([data.q, data.positions()]), "%.9f", ",", header=header, comments="")


def session_of(fit: Result) -> Session:
    """Return what was found in a calibration."""
    assert fit.session is not None
    return fit.session


def search_of(
    changes: Changes, n_cells: int = 60, is_ordered: bool = True, prior_factor: float = 1.0
) -> _Search:
    """Return the search of a session of 60 poses."""
    simulation = Simulation("ur10", 60, 3)
    data = simulation.measure(Pose, changes)
    return searched(simulation, (data,), n_cells=n_cells, is_ordered=is_ordered, prior_factor=prior_factor)


def searched(
    simulation: Simulation,
    data: Sequence[Measurement],
    *,
    holdout: Sequence[Measurement] = (),
    n_cells: int = 60,
    is_ordered: bool = True,
    prior_factor: float = 1.0,
) -> _Search:
    """Return the search of measurements of an arm from its true base and tool."""
    chain = simulation.chain.with_base_and_tool(simulation.base.homogeneous, simulation.tool.homogeneous)
    errors = select_parameters(chain, "minimal,base,tool")
    problem = make_problem(errors, tuple(data), 1 / (prior_factor * errors.priors), {})
    start, timeline = np.zeros(len(problem.weights)), order_samples(data, holdout)
    return _Search(problem, start, timeline, is_ordered, 200, n_cells)
