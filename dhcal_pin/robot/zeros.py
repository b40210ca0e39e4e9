"""Other zeros of the joints of a chain: the same robot, whose joint values have constant summands.

With q' = q + d, the position q + A·q + Σ_k (S_k·sin(k·q) + C_k·cos(k·q)) of a joint (see `transmission`) is

    q' + A·q' + Σ_k (S'_k·sin(k·q') + C'_k·cos(k·q')) - d - A·d

    S'_k = S_k·cos(k·d) + C_k·sin(k·d)         C'_k = C_k·cos(k·d) - S_k·sin(k·d)

and the constant -d - A·d becomes a rotation of the origin of the joint. Terms of torques, directions of approach
and temperatures do not depend on the zeros.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from .chain import Chain
from .transmission import Transmission, split_coefficients


def with_zeros_moved(chain: Chain, summands: ArrayLike) -> Chain:
    """Return the robot that has the same poses at joint values which are larger by summands, (n,) [rad or m]."""
    d = np.asarray(summands, float)
    constants = -d
    if chain.transmission is not None:
        constants = constants - chain.transmission.linear @ d
    moving = chain.mimic_matrix @ constants
    twists = [
        np.concatenate([axis, np.zeros(3)] if is_prismatic else [np.zeros(3), axis])
        for axis, is_prismatic in zip(chain.axes, chain.prismatic, strict=True)
    ]
    motions = {chain.origin_frame(j + 1): se3.exp6(twist * moving[j]) for j, twist in enumerate(twists)}
    moved = chain.perturbed_at(motions)
    if chain.transmission is None:
        return moved
    return moved.with_transmission(_moved(chain.transmission, d)).with_current_loads()


def _moved(transmission: Transmission, d: np.ndarray) -> Transmission:
    """Return transmission errors as functions of the joint values that are larger by d (n,)."""
    coefficients = transmission.coefficients.copy()
    harmonics = split_coefficients(coefficients, len(d)).harmonics
    sine, cosine = harmonics.swapaxes(0, 1).copy()
    phase = np.arange(1, len(harmonics) + 1)[:, None] * d
    harmonics[:, 0] = sine * np.cos(phase) + cosine * np.sin(phase)
    harmonics[:, 1] = cosine * np.cos(phase) - sine * np.sin(phase)
    return replace(transmission, coefficients=coefficients)
