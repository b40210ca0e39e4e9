"""Criteria of optimal experimental design, computed from a square root of the covariance.

Notation: p unknowns in units of their prior standard deviations, M = RᵀR the information matrix of priors and
measurements, and C = M⁻¹ = H·Hᵀ the covariance with H = R⁻¹. A candidate is a block A (k, p) of k whitened
Jacobian rows; measuring it changes M to M + AᵀA. Every criterion is minimized:

* D: det(C)^(1/p), the geometric mean of the variances along the principal axes. Gain: log det(I + A·C·Aᵀ).
* A: tr(Wᵀ·C·W) with orthonormal observable directions W, the sum of variances.
  Gain: tr((I + A·C·Aᵀ)⁻¹·A·C·W·Wᵀ·C·Aᵀ) (Woodbury identity).
* I, or task: the same with W such that tr(Wᵀ·C·W) is the mean squared position error over a task.
* E: largest eigenvalue of V·C·Vᵀ over the observable directions V.
* Bias and variance: √(tr(Wᵀ·C·W)·‖Wᵀ·B - G‖²), where B is the bias of the fitted parameters by omitted
  ones; see `BiasVarianceCriterion`.

`value` returns the logarithm of the criterion: a difference of 0.01 is one per cent. `gains` ranks candidates
and uses k×k determinants in place of p×p ones. C is never formed from M: that would lose half the digits.

References:
    A. C. Atkinson, A. N. Donev and R. D. Tobias, Optimum Experimental Designs, with SAS, Oxford 2007,
    chapters 10 and 11: D, A, E and I optimality. F. Pukelsheim, Optimal Design of Experiments, SIAM 2006,
    chapters 5 and 6: information functions. G. E. P. Box and N. R. Draper, A basis for the selection of a
    response surface design, J. American Statistical Association 54 (1959), 622-654: bias by omitted terms,
    the alias matrix. E. Läuter, Experimental design in a class of models, Math. Operationsforschung und
    Statistik 5 (1974), 379-398: compound criteria.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from .._frozen import frozen
from .._typing import Array

# Exponent that makes the weighted sum of variances in the gains of `EOptimality` follow the largest one.
_E_WEIGHT_POWER = 6
# Part of a sum that rounding hides.
_ROUNDING = 1e-15


class Criterion(Protocol):
    """Optimality criterion of a design; smaller values are better."""

    def value(self, sqrt_covariance: Array) -> float:
        """Compute the logarithm of the criterion."""
        ...

    def gains(self, rows: Array, sqrt_covariance: Array) -> Array:
        """Rate m candidates with whitened rows (p, k, m) by the improvement that each would bring alone."""
        ...


def _transform_rows(rows: Array, basis: Array) -> Array:
    """Return the products (w, k, m) of rows (p, k, m) with the columns of a basis (p, w)."""
    p, k, m = rows.shape
    return (basis.T @ rows.reshape(p, k * m)).reshape(-1, k, m)


def _factor(rows: Array) -> Array:
    """Return the lower Cholesky factors (k, k, m) of I + A·Aᵀ for m candidates with rows A (p, k, m)."""
    k, m = rows.shape[1:]
    out = np.empty((k, k, m))
    for i in range(k):
        for j in range(i + 1):
            np.einsum("pm,pm->m", rows[:, i], rows[:, j], out=out[i, j])
        out[i, i] += 1.0
    least = _ROUNDING * np.einsum("iim->im", out)
    for j in range(k):
        for i in range(j):
            out[j:, j] -= out[j:, i] * out[j, i]
        # Rounding hides the 1 of a row that depends on others, in directions that nothing determines.
        is_hidden = out[j, j] <= least[j]
        out[j, j] = np.sqrt(np.where(is_hidden, 1.0, out[j, j]))
        out[j + 1 :, j] *= ~is_hidden / out[j, j]
    return out


def _solve_factor(rows: Array, factor: Array) -> Array:
    """Multiply rows (w, k, m) by the inverse transposes of lower factors (k, k, m), in place."""
    for j in range(rows.shape[1]):
        for i in range(j):
            rows[:, j] -= factor[j, i] * rows[:, i]
        rows[:, j] /= factor[j, j]
    return rows


@frozen
class DOptimality:
    """D-optimality: volume of the confidence ellipsoid of all unknowns."""

    def value(self, sqrt_covariance: Array) -> float:
        """Compute log det(C)^(1/p); see `Criterion.value`."""
        return 2 * float(np.mean(np.log(np.abs(np.diag(sqrt_covariance)))))

    def gains(self, rows: Array, sqrt_covariance: Array) -> Array:
        """Compute log det(I + A·C·Aᵀ); see `Criterion.gains`."""
        factor = _factor(_transform_rows(rows, sqrt_covariance))
        return 2 * np.log(np.einsum("iim->im", factor)).sum(0)


@frozen(eq=False)
class AOptimality:
    """A- or I-optimality: sum of the variances of combinations of the unknowns."""

    # Combinations W, shape (p, w). Observable directions give A-optimality, the combinations of
    # `Information.task_combinations` I-optimality over a task.
    combinations: Array

    def value(self, sqrt_covariance: Array) -> float:
        """Compute log tr(Wᵀ·C·W); see `Criterion.value`."""
        return float(np.log(np.sum((self.combinations.T @ sqrt_covariance) ** 2)))

    def gains(self, rows: Array, sqrt_covariance: Array) -> Array:
        """Compute the decrease of the sum, tr((I + A·C·Aᵀ)⁻¹·A·C·W·Wᵀ·C·Aᵀ); see `Criterion.gains`."""
        scaled = _transform_rows(rows, sqrt_covariance)
        factor = _factor(scaled)
        change = _solve_factor(_transform_rows(scaled, sqrt_covariance.T @ self.combinations), factor)
        return np.einsum("wkm,wkm->m", change, change)


@frozen(eq=False)
class EOptimality:
    """E-optimality: largest variance of any observable direction."""

    observable: Array  # Orthonormal observable directions V, shape (r, p)

    def value(self, sqrt_covariance: Array) -> float:
        """Compute the logarithm of the largest eigenvalue of V·C·Vᵀ; see `Criterion.value`."""
        return 2 * float(np.log(np.linalg.norm(self.observable @ sqrt_covariance, 2)))

    def gains(self, rows: Array, sqrt_covariance: Array) -> Array:
        """Compute the decrease of a smooth substitute; see `Criterion.gains`."""
        # The sum of the variances of the principal axes of V·C·Vᵀ, weighted by a high power of their standard
        # deviations, so that the largest ones dominate.
        directions, std, _ = np.linalg.svd(self.observable @ sqrt_covariance, full_matrices=False)
        weighted = self.observable.T @ directions * (std / std[0]) ** _E_WEIGHT_POWER
        return AOptimality(weighted).gains(rows, sqrt_covariance)


@frozen(eq=False)
class BiasVarianceCriterion:
    """Robust design: variance, and bias by unknowns that the fit omits, in equal parts.

    The unknowns are split into fitted ones with rows A and omitted ones with rows Φ, which the fit takes as
    zero. The fitted ones then absorb the effect of the omitted ones: their bias is B = C_f·Aᵀ·Φ per unit of
    the omitted ones (the alias matrix of Box and Draper), with the covariance C_f of the fit. A fit to the
    task itself would have the bias G in the combinations W. The criterion is the geometric mean of variance
    and squared additional bias,

        √(tr(Wᵀ·C_f·W)·‖Wᵀ·B - G‖²).

    The geometric mean (a compound criterion, Läuter) weighs relative changes of both equally. Hence no
    assumption on the ratio of noise to omitted effects is needed.
    """

    fitted: Array  # Whether the fit estimates each unknown, shape (p+f,)
    combinations: Array  # Combinations W of the fitted unknowns, orthogonal over the task, shape (p, w)
    target_bias: Array  # Bias G of a fit to the task itself, shape (w, f)

    def _fit_covariance_and_bias(self, sqrt_covariance: Array) -> tuple[Array, Array]:
        """Compute the square root (p, p) of the covariance C_f of the fit, and the bias B (p, f)."""
        # Both follow from the joint covariance of all unknowns: C_f is the conditional covariance of the
        # fitted ones for known omitted ones, and -B is the regression matrix of the fitted on the omitted
        # ones.
        fitted, omitted = sqrt_covariance[self.fitted], sqrt_covariance[~self.fitted]
        q, r = np.linalg.qr(omitted.T)
        shared = fitted @ q
        conditional = np.linalg.qr((fitted - shared @ q.T).T, mode="r").T
        return conditional, -np.linalg.solve(r, shared.T).T

    def value(self, sqrt_covariance: Array) -> float:
        """Compute the logarithm of the geometric mean of variance and squared bias; see `Criterion.value`."""
        conditional, bias = self._fit_covariance_and_bias(sqrt_covariance)
        variance = np.sum((self.combinations.T @ conditional) ** 2)
        return float(np.log(variance * np.sum((self.combinations.T @ bias - self.target_bias) ** 2)) / 2)

    def gains(self, rows: Array, sqrt_covariance: Array) -> Array:
        """Compute the negative logarithm of the criterion after each candidate; see `Criterion.gains`."""
        conditional, bias = self._fit_covariance_and_bias(sqrt_covariance)
        fitted, omitted = rows[self.fitted], rows[~self.fitted]
        scaled = _transform_rows(fitted, conditional)
        factor = _factor(scaled)
        change = _solve_factor(_transform_rows(scaled, conditional.T @ self.combinations), factor)
        innovation = _solve_factor(omitted - _transform_rows(fitted, bias), factor)
        excess = self.combinations.T @ bias - self.target_bias
        variance = np.sum((self.combinations.T @ conditional) ** 2) - np.einsum("wkm,wkm->m", change, change)
        square = np.sum(excess**2) + 2 * np.einsum("fkm,fkm->m", _transform_rows(change, excess), innovation)
        for i in range(rows.shape[1]):
            for j in range(rows.shape[1]):
                product = np.einsum("wm,wm->m", change[:, i], change[:, j])
                square += product * np.einsum("fm,fm->m", innovation[:, i], innovation[:, j])
        return -np.log(variance * square) / 2
