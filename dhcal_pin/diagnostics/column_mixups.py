"""Mixed-up columns: a joint's sign or zero, two joints swapped, a mirrored frame, rows shifted by one.

If the measured positions z_i do not fit the nominal robot, each hypothesis changes the joint positions or the
measured positions in one way. For each of them base B and target offset t are fitted anew, so that the misfit

    misfit = median_i |z_i - B·(p_i + R_i·t)|

does not depend on where instrument and target are; p_i, R_i is the pose of the tip. A hypothesis explains the
data if its misfit is much smaller than the misfit of the file as it is. Orientations are compared in the same
way, with B and the rotation of the target from the Kronecker product solution of the hand-eye equation (Shah,
J. Mechanisms Robotics 5, 2013).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from .. import se3
from .._typing import Array
from ..calibration.initialization import candidate_frames, subsample
from ..measurements.base import Measurement
from ..measurements.position import MultiTargetPosition, Position
from ..robot.chain import Chain
from ..se3 import nearest_rotation

# A nominal robot leaves less misfit than this share of the spread of the positions, or than this distance
# [m].
_MAX_NOMINAL_MISFIT, _MAX_NOMINAL_MISFIT_M = 0.05, 0.01
# More misfit than this share of the spread means another robot, tip or unit, even if no hypothesis explains
# it.
_WRONG_ROBOT_MISFIT = 0.2
# A hypothesis is reported if its misfit is this many times smaller than that of the file as it is.
_MIN_IMPROVEMENT = 4.0
# Hypotheses whose misfit is within this factor of the best one are reported beside it.
_MAX_TIE_RATIO = 1.5
# Fewer positions fit too many hypotheses.
_MIN_POSITIONS = 10
# Positions for the misfit of the file as it is, and for that of a hypothesis.
_N_SAMPLES, _N_HYPOTHESIS_SAMPLES = 100, 40
# Iterations of a fit, and candidate solutions that are refined.
_N_ITERATIONS, _N_CANDIDATES = 12, 3
# Smallest distance that weights are computed from [m].
_MIN_ERROR = 1e-12
# Positions this many times farther from the centre than the median are outliers.
_OUTLIER_RATIO = 5.0


def median_radius(points: Array) -> float:
    """Compute the median distance of points from their median, which outliers hardly change.

    Args:
        points: Shape (m, 3) [m].

    Returns:
        Distance [m].
    """
    return float(np.median(np.linalg.norm(points - np.median(points, 0), axis=1)))


def position_misfit(chain: Chain, q: Array, positions: Array) -> float:
    """Compute the median position error of a robot after base and target offset are fitted.

    Args:
        chain: Nominal robot.
        q: Joint positions, (m, n) [rad or m].
        positions: Measured positions, (m, 3) [m].

    Returns:
        Distance [m].
    """
    starts = candidate_frames(
        chain, (subsample(Position(q, positions)),), is_base_unknown=True, is_tool_unknown=True
    )
    return min(_position_misfit_from(start, q, positions) for start in starts)


def _position_misfit_from(start: Chain, q: Array, positions: Array) -> float:
    """Return the smallest median error over reweighted Gauss-Newton steps from the frames of `start`."""
    base, offset = start.base, start.tool[:3, 3]
    tip = start.with_base_and_tool(np.eye(4), np.eye(4)).poses(q)
    misfit = np.inf
    for _ in range(_N_ITERATIONS):
        rotation = base[:3, :3] @ tip[:, :3, :3]
        points = (base @ tip)[:, :3, 3] + rotation @ offset
        errors = positions - points
        distances = np.linalg.norm(errors, axis=1)
        misfit = min(misfit, float(np.median(distances)))
        weights = np.sqrt(1 / np.fmax(distances, misfit + _MIN_ERROR))[:, None]
        # Unknowns: translation and rotation of the base in the measuring frame, target offset in the tip
        # frame.
        rows = np.concatenate([np.broadcast_to(np.eye(3), rotation.shape), -se3.skew(points), rotation], 2)
        step = np.linalg.lstsq((weights[:, None] * rows).reshape(-1, 9), (weights * errors).ravel())[0]
        base = se3.transform(se3.exp3(step[3:6]), step[:3]) @ base
        offset = offset + step[6:]
    return misfit


def orientation_misfit(modelled: Array, measured: Array) -> float:
    """Compute the median rotation error of a robot after the rotations of base and target are fitted.

    Args:
        modelled: Rotations of the tip, (m, 3, 3).
        measured: Measured rotations, (m, 3, 3).

    Returns:
        Angle [rad].
    """
    # Base ⊗ target is linear in this product. Its best solutions are made rotations and refined in turn.
    product = np.einsum("mij,mkl->ikjl", measured, modelled).reshape(9, 9)
    misfit = np.inf
    for candidate in np.linalg.svd(product)[0].T[:_N_CANDIDATES].reshape(-1, 3, 3):
        base, tool = nearest_rotation(candidate * np.sign(np.linalg.det(candidate))), np.eye(3)
        for _ in range(_N_ITERATIONS):
            tool = nearest_rotation(np.sum(np.swapaxes(base @ modelled, 1, 2) @ measured, 0))
            base = nearest_rotation(np.sum(measured @ np.swapaxes(modelled @ tool, 1, 2), 0))
        errors = se3.log3(np.swapaxes(base @ modelled @ tool, 1, 2) @ measured)
        misfit = min(misfit, float(np.median(np.linalg.norm(errors, axis=1))))
    return misfit


@dataclass(frozen=True, eq=False)
class MixupHypothesis:
    """Assumption about what was mixed up in a file.

    Attributes:
        description: Change that would correct the file, to be read after "with".
        check: What the user has to check, to be read after "check".
        q: Corrected joint positions, (m, n) [rad or m].
        positions: Corrected positions, (m, 3) [m].
    """

    description: str
    check: str
    q: Array
    positions: Array


def _hypotheses(chain: Chain, data: Measurement, index: Array) -> Iterator[MixupHypothesis]:
    """Yield all hypotheses, with the samples of an index (m,)."""
    all_positions = data.positions()
    q, positions = data.q[index], all_positions[index]
    for step, side in ((-1, "previous"), (1, "next")):
        inside = (index + step >= 0) & (index + step < len(all_positions))
        text, check = f"the measured values of the {side} row", "how joint and measured columns were joined"
        yield MixupHypothesis(text, check, q[inside], all_positions[index[inside] + step])
    check = "the order and the signs of x, y and z"
    yield MixupHypothesis("the measuring frame mirrored", check, q, positions * [1, 1, -1])
    for j, name in enumerate(chain.joint_names):
        is_joint = np.arange(chain.n_joints) == j
        flipped = np.where(is_joint, -q, q)
        yield MixupHypothesis(f"the opposite sign of joint {name}", "its sign", flipped, positions)
        for degrees in (90, -90, 180) if not chain.is_prismatic[j] else ():
            text = f"{degrees} deg added to joint {name}"
            yield MixupHypothesis(text, "its zero", q + np.deg2rad(degrees) * is_joint, positions)
    for i, j in combinations(range(chain.n_joints), 2):
        if chain.is_prismatic[i] == chain.is_prismatic[j]:
            order = np.arange(chain.n_joints)
            order[[i, j]] = j, i
            text = f"joints {chain.joint_names[i]} and {chain.joint_names[j]} swapped"
            yield MixupHypothesis(text, "the order of the joint columns", q[:, order], positions)


def diagnose_mixups(chain: Chain, data: Measurement) -> list[str]:
    """Explain positions that do not fit the robot.

    Args:
        chain: Nominal robot.
        data: Measurements; kinds without positions are not checked.

    Returns:
        One sentence if the positions do not fit, otherwise an empty list.
    """
    if isinstance(data, MultiTargetPosition):
        data = data.take(data.label == np.bincount(data.label).argmax())
    all_positions = data.positions()
    if len(all_positions) < _MIN_POSITIONS:
        return []
    distances = np.linalg.norm(all_positions - np.median(all_positions, 0), axis=1)
    # Outliers would distort the fitted frames.
    rows = np.flatnonzero(distances <= _OUTLIER_RATIO * np.median(distances))
    index = np.sort(np.random.default_rng(0).permutation(rows)[:_N_SAMPLES])
    spread = median_radius(all_positions[index])
    misfit = position_misfit(chain, data.q[index], all_positions[index])
    if misfit <= max(_MAX_NOMINAL_MISFIT * spread, _MAX_NOMINAL_MISFIT_M):
        return []
    problem = (
        f"the measured positions differ from this robot by {1e3 * misfit:.3g} mm (median, with the best base "
        "and target)"
    )
    index = np.sort(np.random.default_rng(1).permutation(index)[:_N_HYPOTHESIS_SAMPLES])
    scored_hypotheses = [
        (position_misfit(chain, one.q, one.positions), one) for one in _hypotheses(chain, data, index)
    ]
    best = min(value for value, _ in scored_hypotheses)
    if best * _MIN_IMPROVEMENT < misfit:
        ties = [hypothesis for value, hypothesis in scored_hypotheses if value <= _MAX_TIE_RATIO * best]
        descriptions = " or ".join(dict.fromkeys(one.description for one in ties))
        checks = " or ".join(dict.fromkeys(one.check for one in ties))
        return [f"{problem}, but by only {1e3 * best:.3g} mm with {descriptions}; check {checks}"]
    if misfit > _WRONG_ROBOT_MISFIT * spread:
        return [
            f"{problem}; check the robot and tip, the units, and the order, signs and zeros of the joints"
        ]
    return []
