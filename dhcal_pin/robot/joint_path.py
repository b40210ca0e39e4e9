"""Joint positions over time, as a smooth path through samples.

The path is a cubic spline. Its second derivatives M_i at the times t_i, with intervals h_i = t_{i+1} - t_i
and slopes s_i = (q_{i+1} - q_i) / h_i, solve a tridiagonal system:

    h_{i-1} M_{i-1} + 2 (h_{i-1} + h_i) M_i + h_i M_{i+1} = 6 (s_i - s_{i-1})

The third derivative is continuous at the second and the last but one time ("not-a-knot"). `scipy.interpolate`
has the same spline, and `scipy.linalg` solves such systems. Their imports take as long as many calibrations.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .._frozen import frozen
from .._typing import Array


@frozen(eq=False)
class JointPath:
    """Cubic spline through joint positions; before and after the samples its end pieces go on."""

    times: Array  # Increasing times, (m,)
    q: Array  # Joint positions at these times, (m, n)
    curvature: Array  # Second derivatives at these times, (m, n)

    def __call__(self, times: ArrayLike, derivative: int = 0) -> Array:
        """Return the joint positions at times (k,), or with `derivative` 1 their rates: (k, n)."""
        times = np.asarray(times, float)
        if len(self.times) == 1:
            return np.broadcast_to(
                np.zeros_like(self.q[0]) if derivative else self.q[0], (*times.shape, self.q.shape[1])
            )
        i = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        h, t = np.diff(self.times)[i][..., None], (times - self.times[i])[..., None]
        first, last = self.curvature[i], self.curvature[i + 1]
        linear = (self.q[i + 1] - self.q[i]) / h - h * (2 * first + last) / 6
        cubic = (last - first) / (6 * h)
        if derivative:
            return linear + t * (first + 3 * t * cubic)
        return self.q[i] + t * (linear + t * (first / 2 + t * cubic))


def joint_path(times: Array, q: Array) -> JointPath:
    """Return a cubic spline through joint positions (m, n) at times (m,); constant with a single time."""
    kept = np.diff(times, prepend=-np.inf) > 0
    times, q = times[kept], q[kept]
    curvature = np.zeros_like(q, dtype=float)
    if len(times) > 2:
        h = np.diff(times)
        jumps = 6 * np.diff(np.diff(q, axis=0) / h[:, None], axis=0)
        diagonal, upper, lower = 2 * (h[:-1] + h[1:]), h[1:].copy(), h[:-1].copy()
        if len(times) == 3:
            curvature[:] = jumps / (3 * (h[0] + h[1]))  # a parabola
        else:
            # M_0 and M_{m-1} follow from the inner ones, and are eliminated.
            start, end = h[0] / h[1], h[-1] / h[-2]
            diagonal[0] += h[0] * (1 + start)
            upper[0] -= h[0] * start
            diagonal[-1] += h[-1] * (1 + end)
            lower[-1] -= h[-1] * end
            lower[0] = upper[-1] = 0.0
            curvature[1:-1] = _solve_tridiagonal(lower, diagonal, upper, jumps)
            curvature[0] = (1 + start) * curvature[1] - start * curvature[2]
            curvature[-1] = (1 + end) * curvature[-2] - end * curvature[-3]
    return JointPath(times, q, curvature)


def _solve_tridiagonal(lower: Array, diagonal: Array, upper: Array, right: Array) -> Array:
    """Solve the rows lower[i]·x[i-1] + diagonal[i]·x[i] + upper[i]·x[i+1] = right[i], right and x (m, n)."""
    # Cyclic reduction: multiples of the rows i - step and i + step leave unknowns 2·step apart. It is stable
    # as the diagonal is larger than the others together.
    step = 1
    while step < len(diagonal):
        above, below = slice(step, None), slice(None, -step)
        before, after = np.zeros_like(lower), np.zeros_like(upper)
        before[above] = -lower[above] / diagonal[below]
        after[below] = -upper[below] / diagonal[above]
        next_diagonal, next_right = diagonal.copy(), right.copy()
        next_diagonal[above] += before[above] * upper[below]
        next_diagonal[below] += after[below] * lower[above]
        next_right[above] += before[above, None] * right[below]
        next_right[below] += after[below, None] * right[above]
        before[above] *= lower[below]
        after[below] *= upper[above]
        lower, diagonal, upper, right = before, next_diagonal, after, next_right
        step *= 2
    return right / diagonal[:, None]
