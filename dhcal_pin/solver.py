"""Least squares on one small triangle: the paper's pseudo-inverse loop, and Levenberg-Marquardt.

Whitened rows [J | r] are reduced by QR chunk by chunk, so memory does not grow with the samples. Step,
rank and predicted cost come from the triangle. Nothing here knows a kind of measurement or a set of
parameters by name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from . import observability
from .errors import DhcalError
from .measurements import Measurement, Unknown
from .parameters import ErrorModel
from .se3 import Array

Progress = Callable[[int, float], None]

CHUNK = 4096
# A step is the last one when it changes the rows by less than this share of what they are, or by no more
# than the rounding of the model, as a share of the Jacobian's size.
RELATIVE_STEP, ROUNDING = 1e-8, 1e-15
# After so many damped steps Gauss-Newton tries to get farther in a few.
LEAPS, LEAP_STEPS = (8, 16, 32, 64), 6
# An error of so many metres or radians is no error any more.
RUNAWAY = 1e6


@dataclass(frozen=True, eq=False)
class Problem:
    """What is unknown and what was measured.

    The unknowns x are the p errors of the robot, then the s unknowns of the instruments as differences
    from where they start; instruments share what they name alike.

    Attributes:
        errors: the nominal chain and its p errors.
        data: measurements, any mixture of kinds.
        weights: (p+s,) one over the prior's sigma; zero where there is none.
        known: values of instruments' unknowns, by name, that are no unknowns here.
    """

    errors: ErrorModel
    data: tuple[Measurement, ...]
    weights: Array
    known: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def unknowns(self) -> tuple[Unknown, ...]:
        """The instruments' s unknowns, each once."""
        return tuple(u for u in shared_unknowns(self.data) if u.name not in self.known)

    def instruments(self, x: Array) -> dict[str, float]:
        """The values of all the instruments' unknowns at x, by name."""
        found = x[len(self.errors.parameters) :]
        return {u.name: u.nominal + float(v) for u, v in zip(self.unknowns, found, strict=True)} | dict(
            self.known
        )

    def values(self, item: Measurement, x: Array) -> Array:
        """The values u of a measurement's unknowns at x."""
        every = self.instruments(x)
        return np.array([every[unknown.name] for unknown in item.unknowns])

    def places(self, item: Measurement) -> tuple[list[int], list[int]]:
        """Which of a measurement's unknowns are unknown here, and where they stand in x."""
        first = len(self.errors.parameters)
        place = {unknown.name: first + i for i, unknown in enumerate(self.unknowns)}
        free = [i for i, unknown in enumerate(item.unknowns) if unknown.name in place]
        return free, [place[item.unknowns[i].name] for i in free]

    def chunks(self) -> Iterable[Measurement]:
        """The data in pieces of at most CHUNK samples."""
        for data in self.data:
            for start in range(0, len(data.rows), CHUNK):
                yield data if len(data.rows) <= CHUNK else data.take(np.s_[start : start + CHUNK])

    def cost(self, x: Array) -> float:
        """Sum of squared whitened residuals and priors at x (p,)."""
        chain = self.errors.at(x[: len(self.errors.parameters)])
        total = float(np.sum((self.weights * x) ** 2))
        for data in self.chunks():
            residual = data.residual(chain.sweep(data.configurations()), self.values(data, x))
            total += float(np.sum(residual**2))
        return total


def shared_unknowns(data: Sequence[Measurement]) -> tuple[Unknown, ...]:
    """The unknowns of several measurements, each once; a start that is NaN gives way to one that is not."""
    found: dict[str, Unknown] = {}
    for item in data:
        for unknown in item.unknowns:
            if unknown.name not in found or math.isnan(found[unknown.name].nominal):
                found[unknown.name] = unknown
    return tuple(
        replace(unknown, nominal=0.0) if math.isnan(unknown.nominal) else unknown
        for unknown in found.values()
    )


@dataclass(frozen=True, eq=False)
class Triangle:
    """QR of the whitened [J | r] at one x: ‖J·δ - r‖² = ‖R·δ - z‖² + rest.

    Attributes:
        r: (p, p) upper triangular, of the data alone.
        z: (p,) right-hand side.
        rest: the part of the cost that no step removes.
    """

    r: Array
    z: Array
    rest: float


def _qr(rows: Array) -> Array:
    """Upper triangle (c, c) of rows (c, k), a C-order array that LAPACK sees as (k, c)."""
    columns, count = rows.shape
    out = np.zeros((columns, columns))
    if count == 0:
        return out
    packed = lapack.dgeqrf(rows.T, overwrite_a=1)[0]
    top = min(columns, count)
    out[:top] = np.triu(packed[:top])
    return out


def reduce(problem: Problem, x: Array, small_angle: bool) -> Triangle:
    """The data's triangle at x (p,), without the priors; exact or by the paper's rows."""
    errors = len(problem.errors.parameters)
    chain, bodies, twists = problem.errors.derivative(x[:errors])
    p = len(x)
    merged = np.zeros((p + 1, p + 1))
    for data in problem.chunks():
        sweep, u = chain.sweep(data.configurations()), problem.values(data, x)
        velocities = chain.tool_velocities(sweep, bodies, twists)
        if small_angle:
            residual, rows = data.small_angle(sweep, velocities, u)
        else:
            residual, rows = data.residual(sweep, u), data.whiten(sweep, velocities, u)
        block = np.zeros((p + 1, residual.size))
        block[:errors] = rows.reshape(errors, residual.size)
        free, rows_of = problem.places(data)
        block[rows_of] = data.own(sweep, u).reshape(len(u), residual.size)[free]
        block[p] = residual.reshape(-1)
        merged = _qr(np.concatenate([merged.T, _qr(block).T], 1)) if merged.any() else _qr(block)
    return Triangle(merged[:p, :p], merged[:p, p], float(merged[p, p] ** 2))


def with_priors(triangle: Triangle, weights: Array, x: Array, damping: Array) -> Triangle:
    """The triangle with prior rows -x/σ and damping rows below it."""
    p = len(x)
    stacked = np.zeros((p + 1, 3 * p))
    stacked[:p, :p], stacked[p, :p] = triangle.r.T, triangle.z
    stacked[:p, p : 2 * p], stacked[p, p : 2 * p] = np.diag(weights), -weights * x
    stacked[:p, 2 * p :] = np.diag(damping)
    full = _qr(stacked)
    return Triangle(full[:p, :p], full[:p, p], triangle.rest + float(full[p, p] ** 2))


def pseudo_inverse(r: Array, z: Array) -> Array:
    """Shortest least-squares solution of R·δ = z, singular values cut as in `observability`."""
    return np.linalg.lstsq(r, z, rcond=observability.RANK_CUT)[0]


def posterior_root(triangle: Triangle, weights: Array) -> tuple[Array, Array]:
    """A root (p, r) of the covariance with priors of these weights (p,), and a basis (p, p-r) of the rest.

    The rest are directions that neither data nor a prior tell.
    """
    zero = np.zeros_like(weights)
    full = with_priors(triangle, weights, zero, zero).r
    _, s, vt = np.linalg.svd(full)
    keep = s > observability.RANK_CUT * s[0]
    return vt[keep].T / s[keep], vt[~keep].T


def _settled(r: Array, step: Array, cost: float) -> bool:
    """Whether a step changes the whitened rows by nothing that matters."""
    change = float(np.linalg.norm(r @ step))
    return change <= RELATIVE_STEP * math.sqrt(cost) + ROUNDING * float(np.linalg.norm(r))


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a loop ended: x (p,), the data's triangle there, iterations, and every x on the way."""

    x: Array
    triangle: Triangle
    iterations: int
    converged: bool
    path: Array


def gauss_newton(problem: Problem, x: Array, max_iterations: int, progress: Progress | None) -> Solution:
    """The paper's loop (37) to (39): x ← x + R⁺·DX with a rank-revealing pseudo-inverse.

    Rotation errors are (36) and the derivative is R itself, as printed. Priors join only if given.
    """
    path, converged, done = [x], False, 0
    while done < max_iterations and not converged:
        triangle = reduce(problem, x, small_angle=True)
        full = with_priors(triangle, problem.weights, x, np.zeros_like(x))
        step = pseudo_inverse(full.r, full.z)
        cost = full.rest + float(full.z @ full.z)
        converged = _settled(full.r, step, cost)
        x = x + step
        path.append(x)
        done += 1
        if progress:
            progress(done, cost)
        if not np.abs(x).max() < RUNAWAY:
            raise DhcalError("the loop diverged; use --method lm, more poses, or fix parameters")
    return Solution(x, reduce(problem, x, small_angle=False), done, converged, np.array(path))


def _leap(problem: Problem, x: Array, cost: float) -> tuple[Array, float]:
    """A few plain Gauss-Newton steps, uphill ones too; where they end if that is lower, else x."""
    far, ends = x, math.inf
    for _ in range(LEAP_STEPS):
        triangle = with_priors(
            reduce(problem, far, small_angle=False), problem.weights, far, np.zeros_like(x)
        )
        far = far + pseudo_inverse(triangle.r, triangle.z)
        if not np.abs(far).max() < RUNAWAY:
            break
        ends = problem.cost(far)
    return (far, ends) if ends < cost else (x, cost)


def levenberg_marquardt(
    problem: Problem, x: Array, max_iterations: int, progress: Progress | None
) -> Solution:
    """Levenberg-Marquardt; a retry costs forward kinematics only, the triangle stays.

    Along a narrow valley that bends, damped steps downhill are tiny and Gauss-Newton's, far uphill at
    first, arrive: now and then it may try.
    """
    path, damping, growth = [x], 1e-4, 2.0
    converged, done = False, 0
    cost = problem.cost(x)
    scale = np.zeros_like(x)
    triangle = reduce(problem, x, small_angle=False)
    while done < max_iterations and not converged:
        free = with_priors(triangle, problem.weights, x, np.zeros_like(x))
        scale = np.maximum(scale, np.linalg.norm(free.r, axis=0))
        floor = np.where(scale > 0, scale, 1.0)
        rounding = ROUNDING * float(np.linalg.norm(free.r))
        done += 1
        while True:
            damped = with_priors(triangle, problem.weights, x, np.sqrt(damping) * floor)
            step = pseudo_inverse(damped.r, damped.z)
            settled = _settled(free.r, step, cost)
            trial = problem.cost(x + step)
            expected = float(free.z @ free.z - np.sum((free.r @ step - free.z) ** 2))
            gain = (cost - trial) / expected if expected > 0 else 0.0
            # Where all that is left is rounding, costs tell nothing and the step is to be trusted.
            trusted = expected <= (10 * rounding) ** 2 and trial <= (math.sqrt(cost) + 10 * rounding) ** 2
            if trusted or (trial <= cost and gain > 1e-3):
                easier = 1e-2 if trusted or gain > 0.9 else max(1e-3, 1 - (2 * gain - 1) ** 3)
                damping *= easier
                damping, growth = max(damping, 1e-16), 2.0
                x, cost, converged = x + step, trial, settled and damping < 1e-3
                break
            if settled or damping > 1e16:
                # Nothing left to gain beyond rounding.
                converged = settled
                break
            damping, growth = damping * growth, growth * 2
        if done in LEAPS and not converged:
            x, cost = _leap(problem, x, cost)
        path.append(x)
        if progress:
            progress(done, cost)
        if damping > 1e16:
            break
        triangle = reduce(problem, x, small_angle=False)
    return Solution(x, triangle, done, converged, np.array(path))


METHODS: dict[str, Callable[[Problem, Array, int, Progress | None], Solution]] = {
    "lm": levenberg_marquardt,
    "gn": gauss_newton,
}
