"""Scale of all measured lengths, which the size of the robot imitates.

Positions, poses and lengths do not distinguish a scale of the instrument from the size of the robot. A wrong
scale changes all lengths of the estimated arm, and the gains of its prismatic joints, by one factor, which
manufacturing errors do not. The corrections x of the arm are therefore

    x = k·s + M·e + n,

with the error k of the scale as a fraction of the measured lengths, the corrections s that a unit of it
causes, errors e of base, tool and all joint origins, which the fit carries into its own parameters by M, and
the noise n of the fit. The errors
of the lengths and of the angles are normal with their prior standard deviations times two unknown factors,
whose logarithms have a uniform prior. The posterior distribution of k is a mixture of normal distributions
over both factors. With one factor it is Student's t distribution. The factor 1/(1 - k) of the true lengths
is reported if the probability of the other sign of k is negligible.

Reference: A. Gelman et al., Bayesian Data Analysis, 3rd edition 2013, section 14.2.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from .._typing import Array
from ..estimation.error_model import ErrorModel, ErrorParameter
from ..estimation.parameters import ANGLE_PRIOR, LENGTH_PRIOR, base, placement, tool
from ..estimation.problem import Problem
from ..robot.error_families import FAMILIES, GAIN
from .facts import MAX_SCALE_CHANGE, Scale
from .linear_model import Layout, inverse, whitened_rows

# Lengths that are stated and not measured with the robot, by the kind of measurement.
STATED_LENGTHS = {
    "point_distance": "length between the points",
    "sphere": "radius of the spheres, which includes that of the ball on the tool",
}
# Smallest RMS correction of lengths in prior standard deviations, and relative error of the scale.
MIN_CORRECTION, MIN_CHANGE = 0.5, 1e-3
# Smallest number of lengths that the measurements determine, and largest share of the largest factors.
MIN_LENGTHS, EDGE = 2.5, 1e-2
# Smallest norm of the corrections by a scale of 1, in standard deviations.
MIN_PATTERN = 1e-2
# Probability that chance makes the correction of an arm look like a change of scale.
MAX_CHANCE = 5e-4
# Factors of the prior standard deviations of lengths and of angles.
LENGTH_FACTORS, ANGLE_FACTORS = np.geomspace(0.1, 30, 14), np.geomspace(0.1, 30, 8)
# Prior standard deviations of unknowns without a prior, as a multiple of the expected ones.
WIDE = 10.0
# Smallest relative variance of a correction: redundant parameters have none in some directions.
MIN_VARIANCE = 1e-6
# Largest number of samples that are examined.
MAX_SAMPLES = 100


def find_scale(problem: Problem, x: Array) -> Scale | None:
    """Look for one factor of all lengths that explains most of the correction x (p,) of an arm."""
    errors = problem.errors
    slide_gains = _slide_gains(errors)
    is_size = np.array([p.coefficient_index is None or p in slide_gains for p in errors.parameters], bool)
    is_arm = errors.is_of_arm & is_size
    is_length = is_arm & np.array([p.unit != "rad" for p in errors.parameters], bool)
    sizes = (x[: len(is_arm)] / errors.priors)[is_length]
    # Contacts and inclinations do not depend on the size; boards in images can take part of it.
    with_lengths = [item for item in problem.data if item.has_length_scale]
    shows_size = bool(with_lengths) and all(item.rig is None for item in problem.data)
    if not shows_size or not sizes.size or np.sqrt(np.mean(sizes**2)) < MIN_CORRECTION:
        return None
    (arm,) = np.nonzero(is_arm)
    noise, by_scale, by_lengths, by_angles = _responses(problem, x, arm)
    unit = 1 / np.sqrt(np.diag(by_lengths + by_angles + noise))
    if np.linalg.norm(by_scale * unit) < MIN_PATTERN:
        return None
    by_both = unit * unit[:, None]
    lengths, angles = (
        each[:, None, None] ** 2 * matrix * by_both
        for each, matrix in ((LENGTH_FACTORS, by_lengths), (ANGLE_FACTORS, by_angles))
    )
    rounding = MIN_VARIANCE * np.eye(len(arm))
    covariances = lengths[:, None] + angles + noise * by_both + rounding
    factors = np.linalg.cholesky(covariances)
    both = np.linalg.solve(factors, np.stack([x[arm] * unit, by_scale * unit], -1))
    z, column = both[..., 0], both[..., 1]
    information = np.sum(column**2, -1)
    changes = np.sum(column * z, -1) / information
    likelihood = -np.log(np.diagonal(factors, axis1=-2, axis2=-1)).sum(-1) - 0.5 * np.sum(z**2, -1)
    likelihood += 0.5 * (changes**2 * information - np.log(information))
    weights = np.exp(likelihood - likelihood.max())
    weights /= weights.sum()
    change = float(np.sum(weights * changes))
    best = np.unravel_index(np.argmax(weights), weights.shape)
    n_lengths = float(np.trace(np.linalg.solve(covariances[best], lengths[best[0]])))
    if (
        not MIN_CHANGE <= abs(change) < 1
        or abs((factor := 1 / (1 - change)) - 1) > MAX_SCALE_CHANGE
        or n_lengths < MIN_LENGTHS
        or max(weights[-1].sum(), weights[:, -1].sum()) > EDGE
    ):
        return None
    # Probability that the change has the other sign, of both tails.
    z = np.sign(change) * changes * np.sqrt(information)
    chance = float(sum(w * math.erfc(t / math.sqrt(2)) for w, t in zip(weights.flat, z.flat, strict=True)))
    if chance > MAX_CHANCE:
        return None
    variance = float(np.sum(weights * (1 / information + (changes - change) ** 2)))
    kinds = {item.kind for item in with_lengths}
    stated = " and ".join(STATED_LENGTHS[kind] for kind in STATED_LENGTHS if kind in kinds)
    std = factor**2 * float(np.sqrt(variance))
    return Scale(factor, std, "", stated=stated if kinds <= STATED_LENGTHS.keys() else "")


def _slide_gains(errors: ErrorModel) -> list[ErrorParameter]:
    """Return the gains of prismatic joints, which are sizes of an arm as its lengths are."""
    name, chain = FAMILIES[GAIN].name, errors.chain
    joints = zip(chain.moving_joints, chain.prismatic, strict=True)
    slides = {f"{joint}.{name}" for joint, is_prismatic in joints if is_prismatic}
    return [parameter for parameter in errors.parameters if parameter.name in slides]


def _responses(problem: Problem, x: Array, arm: Array) -> tuple[Array, Array, Array, Array]:
    """Return the covariances of estimates `arm` by noise, lengths and angles, and their change by a scale."""
    names = [parameter.name for parameter in problem.errors.parameters]
    chain = problem.errors.chain
    # A calibration without base or tool carries their errors into the arm.
    origins = [
        replace(p, prior=LENGTH_PRIOR if p.unit == "m" else ANGLE_PRIOR)
        for p in (*placement(chain), *base(chain), *tool(chain))
    ]
    slide_gains = _slide_gains(problem.errors)
    origins += slide_gains
    extended = problem.errors.with_parameters(p for p in origins if p.name not in names)
    all_names = [parameter.name for parameter in extended.parameters]
    n_instrument = len(x) - len(names)
    own = np.array([*map(all_names.index, names), *range(len(all_names), len(all_names) + n_instrument)])
    expected = np.array([*problem.errors.priors, *(u.prior for u in problem.instrument_parameters)])
    weights = np.where(problem.weights > 0, problem.weights, 1 / (WIDE * expected))
    all_weights, values = np.ones(len(all_names) + n_instrument), np.zeros(len(all_names) + n_instrument)
    all_weights[own], values[own] = weights, x
    layout = Layout.of(replace(problem, errors=extended, weights=all_weights))
    data = [item.take(np.s_[:: max(1, -(-len(item.rows) // MAX_SAMPLES))]) for item in problem.data]
    rates = np.zeros((sum(len(item.rows) for item in data), extended.chain.n_joints))
    rows = whitened_rows(layout, values, data, rates).reshape(-1, layout.n_columns)
    model = rows[:, layout.model]
    information = model[:, own].T @ model[:, own] + np.diag(weights**2)
    covariance = inverse(information)
    gain = (covariance @ model[:, own].T)[arm]
    carried = gain @ model[:, [all_names.index(p.name) for p in origins]] * [p.prior for p in origins]
    is_length = np.array([p.unit == "m" or p in slide_gains for p in origins], bool)
    lengths, angles = carried[:, is_length], carried[:, ~is_length]
    # The sum of these two is the covariance. In spite of rounding it has no negative eigenvalue.
    priors = covariance[arm] * weights
    noise = gain @ gain.T + priors @ priors.T
    return noise, gain @ rows[:, layout.scale], lengths @ lengths.T, angles @ angles.T
