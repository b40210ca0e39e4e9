"""Chains of one structure as stacked arrays: kinematics and derivatives of many robots at once.

All chains share joints, error frames and error parameters; base, joint origins, tool and twists may differ.
The kernels take samples in one row: the samples of chain 1, then those of chain 2, and so on, with the same
number for each chain. A measurement of b·m samples therefore evaluates the frames of b chains like those of
one.

Shapes: b chains, p error parameters, k moving joints, n independent joints, m samples per chain, c
configurations per sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..._frozen import frozen
from ..._kernels import cos_sin, perturb_frames, propagate_frames
from ..._kernels.types import FrameBatch, JointState
from ..._typing import Array
from ...exceptions import InvalidArgumentError
from ...robot.chain import Chain
from ...robot.error_families import FAMILIES
from ..error_model import ErrorModel


@frozen(eq=False)
class ChainBatch:
    """b chains with the joints and the p error parameters of one model.

    Arrays that are equal for all chains have an axis of length 1 in place of b.
    """

    model: ErrorModel  # Error model whose joints, limits, parameter names and error frames all chains share
    n_chains: int  # Number b of chains
    base: Array  # Poses of the base links in the measuring frame, shape (b, 4, 4)
    origins: Array  # Joint origins and tip, as `Chain.origins`, shape (b, k+1, 4, 4)
    tool: Array  # Poses of the measured points in the tip frames, shape (b, 4, 4)
    twists: Array  # Twists [v, ω] of the parameters in their error frames, shape (b, p, 6)

    @classmethod
    def from_models(cls, models: Sequence[ErrorModel]) -> ChainBatch:
        """Stack the chains of several error models."""
        first = models[0]
        for number, model in enumerate(models, 1):
            if model.has_transmission:
                raise InvalidArgumentError(
                    f"arm {number} has joint transmission errors ({', '.join(FAMILIES)}); "
                    "calibrate such arms one by one"
                )
            if model is not first and _structure(model) != _structure(first):
                raise InvalidArgumentError(
                    f"arm {number} has other joints or other parameters than arm 1; calibrate it by itself"
                )
        distinct = models if any(model is not first for model in models) else models[:1]
        return cls(
            first,
            len(models),
            np.stack([model.chain.base for model in distinct]),
            np.stack([model.chain.origins for model in distinct]),
            np.stack([model.chain.tool for model in distinct]),
            np.stack([model.twists for model in distinct]),
        )

    def __len__(self) -> int:
        """Number of chains."""
        return self.n_chains

    def take(self, index: Array) -> ChainBatch:
        """Select chains."""
        arrays = {name: getattr(self, name) for name in ("base", "origins", "tool", "twists")}
        return replace(
            self,
            n_chains=len(index),
            **{name: array[index] if len(array) > 1 else array for name, array in arrays.items()},
        )

    def chain(self, number: int) -> Chain:
        """Build one of the chains."""
        base, origins, tool = (array[number % len(array)] for array in (self.base, self.origins, self.tool))
        return replace(self.model.chain, origins=origins, base=base, tool=tool)

    def error_model(self, number: int) -> ErrorModel:
        """Build the error model of one of the chains."""
        twists = self.twists[number % len(self.twists)]
        parameters = [
            replace(p, twist=tuple(twist)) for p, twist in zip(self.model.parameters, twists, strict=True)
        ]
        return replace(self.model, chain=self.chain(number), parameters=tuple(parameters))

    def at(self, x: Array) -> ChainBatch:
        """Build the chains with given errors, shape (b, p)."""
        return self.derivative(x)[0]

    def derivative(self, x: Array) -> tuple[ChainBatch, Array, Array]:
        """Compute the chains at x (b, p), and bodies (p,) and twists (b, p, 6) of their derivatives."""
        model = self.model
        motions, twists = perturb_frames(
            model.chain.body_from_urdf, self.origins, self.tool, model.error_frames, self.twists, x
        )
        # NumPy multiplies contiguous matrices in a third of the time.
        before, behind = (np.ascontiguousarray(part) for part in (motions[:, 1:-1:2], motions[:, 2::2]))
        moved = replace(
            self,
            base=self.base @ motions[:, 0],
            origins=before @ self.origins @ behind,
            tool=self.tool @ motions[:, -1],
        )
        return moved, model.bodies, twists

    def forward_kinematics(self, q: Array) -> FrameBatch:
        """Compute all frames at joint positions (c, b, m, n)."""
        chain = self.model.chain
        independent = np.moveaxis(q, -1, 0).reshape(q.shape[-1], -1)
        positions = chain.mimic_matrix @ independent + chain.mimic_offset[:, None]
        urdf_from_body = np.concatenate([chain.axis_frames[1:], np.eye(4)[None]])
        links = chain.body_from_urdf @ self.origins @ urdf_from_body
        links[:, -1] @= self.tool
        frames = np.empty((len(positions) + 2, 7, 3, *q.shape[:-1]))
        frames[0, :4] = self.base[:, :3].transpose(2, 1, 0)[:, :, None, :, None]
        frames = frames.reshape(*frames.shape[:3], -1)
        # A member of the kernel's batch for each configuration of each chain, or one that is equal for all.
        members = links if len(links) == 1 else np.tile(links, (len(q), 1, 1, 1))
        propagate_frames(members, chain.prismatic, JointState(positions, *cos_sin(positions)), frames)
        return FrameBatch(frames[:-1], frames[-1, :4])


def _structure(model: ErrorModel) -> tuple[object, ...]:
    """Return what all models of a batch must have in common."""
    chain = model.chain
    arrays = (chain.axes, chain.prismatic, chain.mimic_matrix, chain.mimic_offset)
    parameters = [(parameter.name, parameter.error_frame) for parameter in model.parameters]
    return (chain.joint_names, chain.moving_joints, parameters, *(array.tolist() for array in arrays))
