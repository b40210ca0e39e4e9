"""Robots, measurements and timing that the benchmarks share."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from robots import nominal_arm, paper

from dhcal_pin import se3
from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.calibration.result import Result
from dhcal_pin.estimation.error_model import ErrorModel
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.estimation.problem import Problem
from dhcal_pin.measurements.base import Measurement, Noise
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.robot.chain import Chain
from dhcal_pin.robot.dh import DHTable


@dataclass(frozen=True)
class Row:
    """Row of the table: what is compared, both times [s], and the wanted ratio."""

    what: str
    ours: float
    theirs: float
    ratio: float
    wanted: str


def fit_geometry(chain: Chain, data: Measurement, sets: str, **options: Any) -> Result:
    """Calibrate the geometry by least squares, as other programs do; no outliers, no joint errors."""
    return calibrate(chain, data, sets, extend="none", loss="linear", session="off", **options)


def clocked(ways: Sequence[Callable[[], object]], repeats: int, turn: float = 5e-3) -> list[float]:
    """Return the median CPU time of each way [s].

    The ways alternate, so that a change of the machine's speed affects all of them. A turn lasts at least
    `turn` seconds, so that the caches hold the data of the present way.
    """
    counts = []
    for way in ways:
        way()
        start = time.process_time()
        way()
        counts.append(max(1, round(turn / max(time.process_time() - start, 1e-7))))
    spent: list[list[float]] = [[] for _ in ways]
    for _ in range(repeats):
        for way, count, times in zip(ways, counts, spent, strict=True):
            start = time.process_time()
            for _ in range(count):
                way()
            times.append((time.process_time() - start) / count)
    return [float(np.median(times)) for times in spent]


def robots() -> dict[str, tuple[Chain, str]]:
    """Return the paper's arm with DH errors, and a UR10 with the minimal set and both frames unknown."""
    return {
        "paper's 6-DOF, dh": (Chain.from_dh(paper("sim_6dof")), "dh"),
        "UR10, minimal,base,tool": (
            nominal_arm("ur10"),
            "minimal,base,tool",
        ),
    }


def serial(joints: int) -> DHTable:
    """Return an arm of revolute joints, of which no two axes are parallel."""
    rng = np.random.default_rng(joints)
    zero = np.zeros(joints)
    return DHTable(
        "standard",
        tuple(f"j{i + 1}" for i in range(joints)),
        zero.astype(bool),
        zero,
        rng.uniform(0.1, 0.3, joints),
        rng.uniform(0.1, 0.3, joints),
        rng.choice([-1, 1], joints) * rng.uniform(0.5, 1.5, joints),
        zero,
        zero - np.pi,
        zero + np.pi,
    )


def measured(chain: Chain, sets: str, m: int, seed: int = 0) -> tuple[ErrorModel, np.ndarray, Pose]:
    """Simulate an arm with errors of 1 mm and 1 mrad in another frame; return model, errors and poses."""
    rng = np.random.default_rng(seed)
    errors = select_parameters(chain, sets)
    truth = 1e-3 * rng.standard_normal(len(errors.parameters))
    real = errors.at(truth)
    if "base" in sets:
        real = real.perturbed_at({0: se3.exp6(np.array([0.4, -0.2, 0.1, 0.2, -0.3, 1.0]))})
    q = rng.uniform(-2.5, 2.5, (m, chain.n_joints))
    return errors, truth, Pose.simulate(real, q, Noise(1e-4, 1e-4), rng)


def problem(chain: Chain, sets: str, m: int) -> tuple[Problem, np.ndarray]:
    """Return the problem of a calibration, and the true errors, at which iterations are timed."""
    rng = np.random.default_rng(0)
    errors = select_parameters(chain, sets)
    truth = 1e-3 * rng.standard_normal(len(errors.parameters))
    data = Pose.simulate(
        errors.at(truth), rng.uniform(-2.5, 2.5, (m, chain.n_joints)), Noise(1e-4, 1e-4), rng
    )
    return Problem(errors, (data,), 1 / errors.priors), truth
