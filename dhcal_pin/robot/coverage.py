"""Coverage of the revolute joints: which parts of a turn the measured configurations visited.

A correction curve of a joint is determined only near the joint values that were measured. A turn is therefore
divided into bins of 5°, and a bin counts as visited if one configuration lies in it. Joint values that differ
by a turn are the same, as correction curves have a period of one turn. The bins are centred on multiples of
5°, so that scatter around a commanded value such as 30° does not distribute it over two bins.

If a joint took few different values and each of them in many configurations (a lattice), different harmonics
have the same values at all of them. A curve with harmonics up to order K over a range S has 1 + K·S/π degrees
of freedom (Shannon number). `JointCoverage.is_lattice` compares the number of different values with it.

Shapes: m configurations, n independent joints, b bins of a turn.

Reference:
    D. Slepian and H. O. Pollak, Prolate spheroidal wave functions, Fourier analysis and uncertainty I, Bell
    System Technical Journal 40 (1961), 43-63: degrees of freedom of band-limited functions over a range.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._frozen import frozen
from .._typing import Array
from .chain import Chain

# Number of bins of a turn, and the width of a bin [rad].
N_BINS = 72
BIN_WIDTH_RAD = 2 * np.pi / N_BINS
# Centres of the bins, from minus half a turn on [rad].
BIN_CENTRES = BIN_WIDTH_RAD * (np.arange(N_BINS) - N_BINS // 2)

# Joint values count as equal if no harmonic of a curve changes its phase by more than this [rad].
_SAME_PHASE_RAD = 0.1
# Configurations that differ by less than about this in every joint count once [rad or m].
_SAME_CONFIGURATION = 1e-3
# Rounding of joint limits [rad].
_LIMIT_TOL = 1e-6
# The values of a lattice occur in at least this number of configurations each, on average.
_MIN_REPETITIONS = 2


@frozen(eq=False)
class JointCoverage:
    """Parts of a turn that a revolute joint visited."""

    joint: str  #: Name of the joint.
    values: Array  #: Joint values of the different configurations, shape (m,) [rad].
    counts: Array  #: Number of configurations in each bin, shape (b,).
    is_in_range: Array  #: Whether each bin is within the joint limits, shape (b,).

    @property
    def n_in_range(self) -> int:
        """Number of bins within the joint limits."""
        return int(self.is_in_range.sum())

    @property
    def n_visited(self) -> int:
        """Number of bins within the joint limits with at least one configuration."""
        return int((self.is_in_range & (self.counts > 0)).sum())

    @property
    def share(self) -> float:
        """Share of the bins within the joint limits that were visited."""
        return self.n_visited / self.n_in_range if self.n_in_range else 0.0

    @property
    def gaps(self) -> list[tuple[float, float]]:
        """Ranges within the joint limits and half a turn that were not visited, lowest first [rad]."""
        is_gap = self.is_in_range & (self.counts == 0)
        # The first bin is half at the lower end and half at the upper one.
        changes = np.flatnonzero(np.diff([False, *is_gap, is_gap[0], False]))
        edges = np.clip(BIN_CENTRES[0] + BIN_WIDTH_RAD * (changes - 0.5), -np.pi, np.pi)
        return [(float(low), float(high)) for low, high in edges.reshape(-1, 2)]

    def n_different_values(self, order: int) -> int:
        """Count the joint values that a curve can distinguish."""
        tolerance, count, last = _SAME_PHASE_RAD / order, 0, -np.inf
        for value in self._from_widest_gap():
            if value - last > tolerance:
                count, last = count + 1, value
        return count

    def is_lattice(self, order: int) -> bool:
        """Return whether the joint took so few different values that harmonics are not distinguishable."""
        count = self.n_different_values(order)
        if count < 2 or _MIN_REPETITIONS * count > len(self.values):
            return False
        return count < 1 + order * self._from_widest_gap()[-1] / np.pi

    def _from_widest_gap(self) -> Array:
        """Return the joint values from the end of the widest gap of the turn, ascending (m,) [rad]."""
        values = np.sort(np.mod(self.values, 2 * np.pi))
        if not len(values):
            return values
        gaps = np.diff(values, append=values[0] + 2 * np.pi)
        first = values[(np.argmax(gaps) + 1) % len(values)]
        return np.sort(np.mod(values - first, 2 * np.pi))


def bin_indices(values: Array) -> Array:
    """Compute the bins of joint values."""
    # Whole turns are removed first: a value of 1e308 overflows if it is divided by the width.
    within_turn = np.fmod(values, 2 * np.pi)
    return np.mod(np.rint(within_turn / BIN_WIDTH_RAD) + N_BINS // 2, N_BINS).astype(int)


def joint_coverage(chain: Chain, q: Array) -> tuple[JointCoverage, ...]:
    """Compute which parts of a turn the revolute joints visited."""
    # Quotients that overflow count as one value.
    with np.errstate(over="ignore"):
        rounded = np.rint(q / _SAME_CONFIGURATION)
    _, first = np.unique(rounded, axis=0, return_index=True)
    different = q[np.sort(first)]
    return tuple(coverage_of(chain, i, different[:, i]) for i in np.flatnonzero(~chain.is_prismatic).tolist())


def coverage_of(chain: Chain, i: int, values: Array) -> JointCoverage:
    """Compute which parts of a turn the values (m,) [rad] of a revolute joint visited."""
    return JointCoverage(
        joint=chain.joint_names[i],
        values=values,
        counts=np.bincount(bin_indices(values), minlength=N_BINS),
        is_in_range=_bins_in_range(float(chain.lower[i]), float(chain.upper[i])),
    )


def _bins_in_range(lower: float, upper: float) -> Array:
    """Return whether the centres of the bins, or values whole turns away, are within joint limits (b,)."""
    if upper - lower >= 2 * np.pi:
        return np.full(N_BINS, True)
    return np.mod(BIN_CENTRES - lower + _LIMIT_TOL, 2 * np.pi) <= upper - lower + 2 * _LIMIT_TOL


def lattice_warnings(coverage: Sequence[JointCoverage], order: int) -> list[str]:
    """Describe joints whose values do not determine a correction curve because they form a lattice."""
    return [
        f"the values of {one.joint} form a lattice, {one.n_different_values(order)} different ones in "
        f"{len(one.values)} configurations: the correction curve is not determined between them; measure at "
        "other values too"
        for one in coverage
        if one.is_lattice(order)
    ]
