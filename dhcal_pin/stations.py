"""The stations of a chain, where errors act: which body an error moves, and how, in that body's frame."""

from __future__ import annotations

import numpy as np

from . import se3
from .chain import Chain
from .kinematics import station_frames
from .se3 import Array


def bodies_at(chain: Chain, stations: Array) -> Array:
    """The bodies (p,) that errors at stations (p,) move."""
    return np.clip((np.asarray(stations, int) - 1) // 2, 0, len(chain.moving))


def twists_at(
    chain: Chain, stations: Array, twists: Array, carry: Array | None = None
) -> tuple[Array, Array]:
    """Bodies (p,) and the same twists (p, 6) in those bodies' frames, of twists at stations (p,).

    `carry` (p, 4, 4) are the frames that the twists are seen in where these are not the stations' own.
    """
    still = np.tile(np.eye(4), (chain.tool_station + 1, 1, 1))
    frames = station_frames(chain.into, chain.origins, chain.tool, still)[stations]
    frames = frames if carry is None else frames @ carry
    return bodies_at(chain, stations), (se3.adjoint(frames) @ np.asarray(twists, float)[..., None])[..., 0]
