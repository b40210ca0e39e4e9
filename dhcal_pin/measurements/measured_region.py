"""Region of joint space that measured configurations cover, and how far other configurations are from it.

The distance of two configurations is the Euclidean norm of their joint differences, each divided by the
standard deviation of the measured values of that joint. Differences of revolute joints are taken modulo one
turn. Up to `MAX_CONFIGURATIONS` of the measured configurations, at most half of them, represent the region.
They are drawn at random. The radius of the region is the 95th percentile of the distances from the others to
the nearest of them. A further configuration that is drawn like the measured ones is thus in the region with a
probability of 95 %, however the measured ones are distributed.

Shapes: m configurations, k representatives, n joints.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..robot.chain import Chain

# Largest number of configurations that represent a region.
MAX_CONFIGURATIONS = 200
# Quantile of the distances between measured configurations that is the radius of a region, and of the
# distances of parts that are left out that is its reach.
RADIUS_QUANTILE = 0.95
# Smallest spread of a joint that distances are divided by [rad or m]: a joint that hardly moved.
MIN_SPREAD = 1e-3
# Largest number of configurations whose distances are computed for a quantile.
MAX_DISTANCES = 1000
# Number of random configurations from which the covered share of the joint space is computed.
N_CONFIGURATIONS = 2000
# Distances are computed for this many configurations at once; those to 200 others then stay in the cache.
_CHUNK_SIZE = 256
# Rounding error of a squared distance of points, relative to their squared distances from the origin.
_ROUNDING = 1e-9


@frozen(eq=False)
class MeasuredRegion:
    """Region of joint space around measured configurations."""

    is_prismatic: Array  #: Whether each joint is prismatic, (n,).
    lower: Array  #: Smallest measured value of each joint, (n,) [rad or m].
    upper: Array  #: Largest measured value of each joint, (n,) [rad or m].
    spread: Array  #: Standard deviation of the measured values of each joint, (n,) [rad or m].
    configurations: Array  #: Configurations that represent the region, (k, n) [rad or m].
    radius: float  #: Largest distance from the nearest of them inside the region.
    #: Largest distance at which the accuracy was judged by leaving out regions; at least the radius.
    reach: float
    #: Smallest and largest payload of the samples [kg]; None if it is not stated.
    payloads: tuple[float, float] | None = None

    @classmethod
    def from_configurations(cls, q: Array, is_prismatic: Array) -> MeasuredRegion:
        """Describe the region of measured configurations."""
        drawn = _is_drawn(len(q))
        # Files have configurations as 32-bit floats.
        centres = q[drawn].astype(np.float32).astype(float)
        region = cls(is_prismatic, q.min(0), q.max(0), q.std(0), centres, 0.0, 0.0)
        if drawn.all():
            return region
        distances = region.distances(_thinned(q[~drawn]))
        radius = float(np.quantile(distances, RADIUS_QUANTILE, method="higher"))
        return replace(region, radius=radius, reach=radius)

    def with_reach(self, q: Array, is_left_out: Array) -> MeasuredRegion:
        """Determine the reach from parts of the region that were left out in turn."""
        points, distances = self._points(q), []
        for mask in is_left_out:
            if not mask.all():
                tested, others = _thinned(np.flatnonzero(mask)), np.flatnonzero(~mask)
                centres = others[_is_drawn(len(others))]
                distances.append(self._nearest(q[tested], points[tested], q[centres], points[centres]))
        reach = float(np.quantile(np.concatenate(distances), RADIUS_QUANTILE)) if distances else 0.0
        return replace(self, reach=max(self.radius, reach))

    def moved(self, summands: Array) -> MeasuredRegion:
        """Return the same region for joint values that are larger by summands, (n,) [rad or m]."""
        return replace(
            self,
            lower=self.lower + summands,
            upper=self.upper + summands,
            configurations=self.configurations + summands,
        )

    def distances(self, q: Array) -> Array:
        """Compute the distances of configurations from the nearest one that represents the region."""
        centres = self.configurations
        return self._nearest(q, self._points(q), centres, self._points(centres))

    def _nearest(self, q: Array, points: Array, centres: Array, of_centres: Array) -> Array:
        """Compute the distances of configurations from the nearest centre, from the points of both."""
        # Points are no farther apart than their configurations: only the nearest points are compared.
        out, sizes = np.empty(len(q)), np.sum(of_centres**2, 1)
        for start in range(0, len(q), _CHUNK_SIZE):
            part, own = q[start : start + _CHUNK_SIZE], points[start : start + _CHUNK_SIZE]
            own_sizes = np.sum(own**2, 1)
            # Squared distances of the points, less the own size of each.
            bounds = own @ (-2 * of_centres.T)
            bounds += sizes
            squares = self._squared_distances(part, centres[bounds.argmin(1)])
            limits = squares - own_sizes + _ROUNDING * (1 + own_sizes + sizes.max())
            row, centre = np.divmod(np.flatnonzero(bounds <= limits[:, None]), len(centres))
            np.minimum.at(squares, row, self._squared_distances(part[row], centres[centre]))
            out[start : start + _CHUNK_SIZE] = np.sqrt(squares)
        return out

    def _points(self, q: Array) -> Array:
        """Return the points (cos q, sin q) of revolute and q of prismatic joints, divided by the spreads."""
        turning, sliding = ~self.is_prismatic, self.is_prismatic
        spread = np.maximum(self.spread, MIN_SPREAD)
        return np.hstack(
            [f(q[:, turning]) / spread[turning] for f in (np.cos, np.sin)] + [q[:, sliding] / spread[sliding]]
        )

    def _squared_distances(self, q: Array, others: Array) -> Array:
        """Compute the squared distance of each configuration from another one."""
        difference = q - others
        turns = np.rint(difference / (2 * np.pi))
        difference -= np.where(self.is_prismatic, 0.0, turns * (2 * np.pi))
        return np.sum(np.square(difference / np.maximum(self.spread, MIN_SPREAD)), 1)

    def contains(self, q: Array) -> Array:
        """Check which configurations are in the region."""
        return self.distances(q) <= self.radius

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Draw configurations of the region: each is near one that represents it."""
        directions = rng.standard_normal((count, len(self.spread)))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        sizes = self.radius * rng.uniform(size=(count, 1)) ** (1 / len(self.spread))
        centres = self.configurations[rng.integers(len(self.configurations), size=count)]
        return centres + sizes * directions * np.maximum(self.spread, MIN_SPREAD)

    def excess(self, q: Array) -> Array:
        """Compute how far joint values are outside the measured range of their joint."""
        width = self.upper - self.lower
        above = q - self.upper
        outside = np.maximum(np.maximum(above, self.lower - q), 0.0)
        above = np.mod(above, 2 * np.pi)
        # From the upper end of the range on, the rest of the turn leads back to the lower end.
        around = np.maximum(np.minimum(above, 2 * np.pi - width - above), 0.0)
        return np.where(self.is_prismatic, outside, np.minimum(outside, around))


def _is_drawn(count: int) -> Array:
    """Draw a random part of `count` configurations that represents all of them; return its mask (count,)."""
    n_drawn = max(1, min(MAX_CONFIGURATIONS, count // 2))
    return np.random.default_rng(0).permutation(count) < n_drawn


def _thinned(q: Array) -> Array:
    """Return evenly spaced rows of q (m, n), at most `MAX_DISTANCES`."""
    return q[:: max(1, -(-len(q) // MAX_DISTANCES))]


def draw_joint_space(chain: Chain) -> Array:
    """Draw configurations evenly from the joint space within the limits."""
    from ..robot.sampling import random_configurations  # lazy import: slow, and few calibrations need it

    return random_configurations(chain, N_CONFIGURATIONS)
