"""What touching says nothing of: the size of the arm, and which way it is turned.

A tool that touches one thing again and again misses it by less the smaller the arm is modelled, so least
squares would shrink the arm by some tenths of a percent, and by all of it where the sigmas are found with
the fit. And as misses turn with the arm, they look as if they told how it is turned. They are therefore
counted in the arm's size and along axes that turn with it: both are then left to whatever else was read, or
to the priors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._typing import Array
from ..robot.chain import Chain

# Configurations that tell how far an arm reaches.
_SAMPLES = 100


@dataclass(frozen=True, eq=False)
class ScaleGauge:
    """Measures an arm's size: how far the tool spreads about its middle, RMS, in units of the nominal arm's.

    Attributes:
        q: joint values (c, n).
        nominal: the nominal spread, m.
    """

    q: Array
    nominal: float

    @classmethod
    def from_configurations(cls, chain: Chain, q: Array) -> ScaleGauge:
        """For readings at joint values (m, n), which are shuffled joint by joint."""
        rng = np.random.default_rng(0)
        drawn = np.stack([rng.choice(column, _SAMPLES) for column in q.T], 1)
        return cls(drawn, _rms_radius(_centered(chain.forward_kinematics(drawn).tool[3])))

    def size(self, chain: Chain) -> float:
        """Of an arm, the nominal one's being 1."""
        return (
            _rms_radius(_centered(chain.forward_kinematics(self.q).tool[3])) / self.nominal
            if self.nominal
            else 1.0
        )

    def rates(self, chain: Chain, bodies: Array, twists: Array) -> Array:
        """How fast an arm grows, and turns on average in the measuring frame, with each of e errors (e, 4).

        Args:
            chain: the arm.
            bodies: (e,) what each error moves, as `Chain.tool_velocities` takes it.
            twists: (e, 6) how.
        """
        rates = np.zeros((len(bodies), 4))
        if self.nominal:
            frames = chain.forward_kinematics(self.q)
            out = _centered(frames.tool[3])
            moved = chain.tool_jacobian(frames, bodies, twists)[:, :3]
            rates[:, 0] = np.tensordot(moved, out) / (_SAMPLES * _rms_radius(out) * self.nominal)
            inertia = np.vdot(out, out) * np.eye(3) - out @ out.T
            rates[:, 1:] = np.cross(out[None], moved, axis=1).sum(-1) @ np.linalg.pinv(
                inertia, hermitian=True
            )
        return rates


def _centered(points: Array) -> Array:
    return points - points.mean(1, keepdims=True)


def _rms_radius(out: Array) -> float:
    return float(np.sqrt(np.vdot(out, out) / _SAMPLES))


def normalize_by_scale(block: Array, size: float, rates: Array, vectors: slice | None) -> None:
    """Counts whitened misses and their derivatives in the arm's size and along axes that turn with it.

    Args:
        block: (p+1, k, m) derivatives of the whitened model, those by the robot's e errors first, and the
            residual; changed in place.
        size: of the arm.
        rates: (e, 4) of `Ruler.rates`.
        vectors: which of the k rows are a vector's, along the measuring frame's axes.
    """
    block /= size
    missed = block[-1]
    block[: len(rates)] += (rates[:, 0] / size)[:, None, None] * missed
    if vectors is not None:
        block[: len(rates), vectors] += np.cross(rates[:, 1:, None], missed[None, vectors], axis=1)
