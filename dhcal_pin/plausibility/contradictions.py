"""Contradictions between measurements: one that an arm of its own fits far better than the arm of all.

The scales of noise hide a contradiction: the standard deviation of the contradicting measurement grows with
its residuals. Its n rows are therefore linearized at the common solution, and fitted by themselves with the
same priors. With the factor R of the rows in units of the prior standard deviations, R = U·S·Vᵀ, right-hand
side b and the unknown noise s, the fit leaves

    C = ρ² + Σ (s²/(S_i² + s²))²·(Uᵀb)_i²,    s² = C / (n - Σ S_i²/(S_i² + s²)).

Errors that the model does not describe remain with both arms. The joint errors of the arm of all are held.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .._typing import Array
from ..estimation.problem import Problem, linearize_and_factor
from ..estimation.qr import left_singular_vectors
from ..measurements.base import Measurement

# Smallest ratio of the residuals with the arm of all and with an arm of its own. It is up to 3.2 for
# simulated measurements that agree, and above 18 if the zero of a joint differs by 0.1° to 1°.
MIN_RATIO = 4.0
# Probability that chance makes the ratio as large.
MAX_CHANCE = 1e-4
# Largest number of rounds of the noise, and change that ends them.
MAX_ROUNDS, MIN_CHANGE = 50, 1e-3
# Smallest number of degrees of freedom of a fit that shows the noise.
MIN_FREEDOM = 1.0
# Smallest weight of a prior, as a fraction of the effect of its unknown on the rows.
MIN_WEIGHT = 1e-9


def own_fit_ratio(problem: Problem, x: Array, item: Measurement) -> float:
    """Return the ratio of the residuals of a measurement with the arm at x (p,) and an arm of its own."""
    errors, n_errors = problem.errors, len(problem.errors.parameters)
    geometric = tuple(p for p in errors.parameters if p.coefficient_index is None)
    # Increments of the geometric errors, which come first, and of the unknowns of the instrument.
    own = replace(
        problem,
        errors=replace(errors, chain=problem.chain(x), parameters=geometric),
        data=(item,),
        bounds=None,
    )
    names = [u.name for u in problem.instrument_parameters]
    used = [n_errors + names.index(u.name) for u in own.instrument_parameters]
    values, weights = (each[[*range(len(geometric)), *used]] for each in (x, problem.weights))
    # Each measurement has first values of its own.
    start = np.concatenate([np.zeros(len(geometric)), own.instrument_start(problem.instruments(x))])
    system = linearize_and_factor(own, start, small_angle=False)
    n_rows, effects = item.residual_dim * len(item.rows), system.column_norms
    smallest = np.where(effects > 0, MIN_WEIGHT * effects, 1.0)
    u, s = left_singular_vectors(system.r / np.maximum(weights, smallest))
    components = u.T @ (system.z + system.r @ values)
    variance, freedom = system.cost / n_rows, float(n_rows)
    common = variance
    for _ in range(MAX_ROUNDS):
        kept = variance / (s**2 + variance)
        freedom = n_rows - float(np.sum(1 - kept))
        if freedom < MIN_FREEDOM:
            return 1.0
        new = (system.min_cost + float(np.sum((kept * components) ** 2))) / freedom
        has_settled = abs(new - variance) <= MIN_CHANGE * variance
        variance = max(new, np.finfo(float).tiny)
        if has_settled:
            break
    from scipy.special import fdtrc  # lazy import: slow

    is_chance = fdtrc(n_rows, freedom, common / variance) > MAX_CHANCE
    return 1.0 if is_chance else float(np.sqrt(common / variance))
