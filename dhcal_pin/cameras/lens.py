"""Lens models: from points in the frame of a camera to pixels, with exact derivatives.

The camera frame has z forward, x to the right and y down. With a = X/Z and b = Y/Z, both models have the form

    u = fx·a' + cx,    v = fy·b' + cy

with (a', b') the distorted image coordinates:

- `pinhole` (Brown 1971, as in OpenCV), r² = a² + b²:
  a' = a·(1 + k1·r² + k2·r⁴ + k3·r⁶) + 2·p1·a·b + p2·(r² + 2a²),
  b' = b·(1 + k1·r² + k2·r⁴ + k3·r⁶) + p1·(r² + 2b²) + 2·p2·a·b;
- `fisheye` (Kannala and Brandt 2006, as in OpenCV), θ = atan(r):
  (a', b') = (a, b)·θ_d/r with θ_d = θ·(1 + k1·θ² + k2·θ⁴ + k3·θ⁶ + k4·θ⁸).

The values of a lens are a vector: fx, fy, cx, cy [px], then the coefficients of the distortion [1].

References:
    D. C. Brown, Close-Range Camera Calibration, Photogrammetric Engineering 37, 1971.
    J. Kannala and S. S. Brandt, A Generic Camera Model and Calibration Method for Conventional, Wide-Angle,
    and Fish-Eye Lenses, IEEE PAMI 28, 2006.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .._frozen import frozen
from .._typing import Array

# Distortion of image coordinates (2, m) by coefficients (d,): distorted coordinates (2, m), derivatives by
# the coordinates (2, 2, m), and by the coefficients (2, d, m).
Distortion = Callable[[Array, Array], tuple[Array, Array, Array]]

# Smallest depth of a point in front of a camera [m]: a point behind it is projected as if it were this close.
MIN_DEPTH = 1e-6
# Names of the values of every lens before those of the distortion.
FOCAL_AND_CENTRE = ("fx", "fy", "cx", "cy")
# Smallest distance from the axis in the fisheye model, in image coordinates X/Z, Y/Z: nearer points are
# scaled as those at this distance.
_MIN_RADIUS = 1e-8
# Largest number of iterations of the inversion of a distortion.
_N_INVERSIONS = 20
# Largest step that ends it, in image coordinates X/Z, Y/Z.
_INVERSION_TOLERANCE = 1e-14
# Number of pixels that are normalized together.
_BLOCK = 10_000


@frozen(eq=False)
class Lens:
    """Lens model."""

    name: str  # Name in rig files: "pinhole" or "fisheye"
    coefficients: tuple[str, ...]  # Names of the coefficients of the distortion
    distort: Distortion  # Function of the distortion

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all s values: fx, fy, cx, cy, then the coefficients."""
        return FOCAL_AND_CENTRE + self.coefficients

    def project(self, points: Array, values: Array) -> tuple[Array, Array, Array]:
        """Project points in the camera frame [m] to pixels (2, m) by the values of the lens."""
        # The derivatives of the pixels by the points, (2, 3, m) [px/m], and by the values, (2, s, m), follow.
        depth = np.maximum(points[2], MIN_DEPTH)
        plane = points[:2] / depth
        distorted, by_plane, by_coefficients = self.distort(plane, values[4:])
        focal = values[:2]
        pixels = focal[:, None] * distorted + values[2:4, None]
        by_plane = focal[:, None, None] * by_plane
        by_points = np.empty((2, 3, points.shape[1]))
        by_points[:, :2] = by_plane / depth
        by_points[:, 2] = -np.einsum("ijm,jm->im", by_plane, plane) / depth
        by_points[:, 2, points[2] < MIN_DEPTH] = 0.0
        by_values = np.zeros((2, len(values), points.shape[1]))
        by_values[0, 0], by_values[1, 1] = distorted
        by_values[0, 2] = by_values[1, 3] = 1.0
        by_values[:, 4:] = focal[:, None, None] * by_coefficients
        return pixels, by_points, by_values

    def normalize(self, pixels: Array, values: Array) -> Array:
        """Compute undistorted image coordinates X/Z, Y/Z of pixels (2, m) by Newton's method."""
        # They are those of the undistorted lens where the distortion has no inverse. The pixels are computed
        # in blocks that stay in the cache.
        if pixels.shape[1] > _BLOCK:
            starts = range(0, pixels.shape[1], _BLOCK)
            return np.concatenate([self.normalize(pixels[:, k : k + _BLOCK], values) for k in starts], 1)
        distorted = (pixels - values[2:4, None]) / values[:2, None]
        plane = distorted.copy()
        with np.errstate(all="ignore"):
            for _ in range(_N_INVERSIONS):
                found, derivative, _ = self.distort(plane, values[4:])
                (a, b), (c, d) = derivative
                u, v = (distorted - found) / (a * d - b * c)
                step = np.stack([d * u - b * v, a * v - c * u])
                plane = plane + step
                if np.abs(step).max(initial=0.0) < _INVERSION_TOLERANCE:
                    break
            is_inverse = np.abs(self.distort(plane, values[4:])[0] - distorted).max(0) < 1e-6
        return np.where(is_inverse, plane, distorted)


def _distort_brown(plane: Array, coefficients: Array) -> tuple[Array, Array, Array]:
    """Apply the distortion of the pinhole model with k1, k2, p1, p2, k3."""
    k1, k2, p1, p2, k3 = coefficients
    a, b = plane
    r2 = a * a + b * b
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    # Derivative of the radial factor by r².
    slope = k1 + r2 * (2 * k2 + 3 * r2 * k3)
    mixed = 2 * a * b * slope + 2 * p1 * a + 2 * p2 * b
    distorted, by_plane, by_coefficients = (np.empty((*n, len(a))) for n in ((2,), (2, 2), (2, 5)))
    distorted[0] = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    distorted[1] = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    by_plane[0, 0] = radial + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a
    by_plane[0, 1] = by_plane[1, 0] = mixed
    by_plane[1, 1] = radial + 2 * b * b * slope + 6 * p1 * b + 2 * p2 * a
    r4, r6 = r2**2, r2**3
    by_coefficients[:, 0] = plane * r2
    by_coefficients[:, 1] = plane * r4
    by_coefficients[0, 2] = by_coefficients[1, 3] = 2 * a * b
    by_coefficients[0, 3] = r2 + 2 * a * a
    by_coefficients[1, 2] = r2 + 2 * b * b
    by_coefficients[:, 4] = plane * r6
    return distorted, by_plane, by_coefficients


def _distort_fisheye(plane: Array, coefficients: Array) -> tuple[Array, Array, Array]:
    """Apply the distortion of the fisheye model with k1, k2, k3, k4."""
    r = np.maximum(np.sqrt(np.einsum("im,im->m", plane, plane)), _MIN_RADIUS)
    theta = np.arctan(r)
    exponents = np.array([[3], [5], [7], [9]])
    powers = theta**exponents
    angle = theta + coefficients @ powers
    # Derivative of the distorted angle by r.
    rate = (1 + coefficients @ (exponents * theta ** (exponents - 1))) / (1 + r * r)
    scale = angle / r
    # Derivative of scale·plane: scale·I + (rate - scale)·n·nᵀ with the direction n of the point.
    direction = plane / r
    by_plane = scale * np.eye(2)[:, :, None] + (rate - scale) * direction[:, None] * direction[None]
    return scale * plane, by_plane, direction[:, None] * powers[None]


LENSES = {
    lens.name: lens
    for lens in (
        Lens("pinhole", ("k1", "k2", "p1", "p2", "k3"), _distort_brown),
        Lens("fisheye", ("k1", "k2", "k3", "k4"), _distort_fisheye),
    )
}
