"""The stations of a chain, where errors act: which body an error moves, and how, in that body's frame."""

from __future__ import annotations

import numpy as np

from . import se3
from .chain import Chain
from .loops import carry_twists
from .se3 import Array


def bodies_at(chain: Chain, stations: Array) -> Array:
    """The bodies (p,) that errors at stations (p,) move."""
    return np.clip((np.asarray(stations, int) - 1) // 2, 0, len(chain.moving))


def frames_before(chain: Chain, motions: Array, moved: Chain) -> Array:
    """Each station's frame (2k+4, 4, 4) in its body as `moved` has it, before the station's own motion.

    Args:
        chain: before all of them.
        motions: (2k+4, 4, 4) of the stations, by which the chain becomes `moved`.
        moved: that chain.
    """
    frames = np.empty(motions.shape)
    # Body 0 is behind the base's motion.
    frames[0] = se3.inverse(motions[0])
    frames[1:-1:2] = chain.into
    np.matmul(chain.into @ motions[1:-1:2], chain.origins, out=frames[2::2])
    frames[-1] = moved.reached[-1] @ chain.tool
    return frames


def twists_at(
    chain: Chain, stations: Array, twists: Array, carry: Array | None = None
) -> tuple[Array, Array]:
    """Bodies (p,) and the same twists (p, 6) in those bodies' frames, of twists at stations (p,).

    `carry` (p, 4, 4) are the frames that the twists are seen in where these are not the stations' own.
    """
    still = np.tile(np.eye(4), (chain.tool_station + 1, 1, 1))
    frames = frames_before(chain, still, chain)[stations]
    frames = frames if carry is None else frames @ carry
    return bodies_at(chain, stations), carry_twists(frames, np.asarray(twists, float))
