"""Chains of one structure as stacked arrays: kinematics and derivatives of many robots at once.

All chains share joints, error frames and error parameters; base, links, tool and twists may differ. The
kernels take samples in one row: the samples of chain 1, then those of chain 2, and so on, with the same
number for each chain. A measurement of b·m samples therefore evaluates the frames of b chains like those of
one.

Errors are applied as in `error_model`: M ← M·exp(x_1·ξ_1)·exp(x_2·ξ_2)·… at each error frame. With the 4×4
matrix A of a twist of angular rate ω = |w|, A⁴ = -ω²·A², so that the exponential is a cubic polynomial in A:

    exp(x·A) = 1 + x·A + (1 - cos ωx)/ω²·A² + (ωx - sin ωx)/ω³·A³

The powers of A are computed once per batch.

Shapes: b chains, p error parameters, k moving joints, n independent joints, m samples per chain, c
configurations per sample.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ... import se3
from ..._kernels import cos_sin
from ..._kernels.types import FrameBatch
from ..._typing import Array
from ...exceptions import InvalidArgumentError
from ...robot.chain import BASE_FRAME, Chain
from ...robot.error_families import FAMILIES
from ..error_model import ErrorModel


@dataclass(frozen=True, eq=False)
class ChainBatch:
    """b chains with the joints and the p error parameters of one model.

    Arrays that are equal for all chains have an axis of length 1 in place of b.
    """

    model: ErrorModel  # Error model whose joints, limits, parameter names and error frames all chains share
    n_chains: int  # Number b of chains
    base: Array  # Poses of the base links in the measuring frame, shape (b, 4, 4)
    # Transforms between the joint motions, with joint axes along z, shape (b, k+1, 4, 4).
    link_transforms: Array
    tool: Array  # Poses of the measured points in the tip frames, shape (b, 4, 4)
    twists: Array  # Twists [v, ω] of the parameters in frames with joint axes along z, shape (b, p, 6)

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
            np.stack([model.chain.link_transforms for model in distinct]),
            np.stack([model.chain.tool for model in distinct]),
            np.stack([_twists(model) for model in distinct]),
        )

    def __len__(self) -> int:
        """Number of chains."""
        return self.n_chains

    def take(self, index: Array) -> ChainBatch:
        """Select chains."""
        arrays = {name: getattr(self, name) for name in ("base", "link_transforms", "tool", "twists")}
        return replace(
            self,
            n_chains=len(index),
            **{name: array[index] if len(array) > 1 else array for name, array in arrays.items()},
        )

    def chain(self, number: int) -> Chain:
        """Build one of the chains."""
        chain = self.model.chain
        base, links, tool = (
            array[number % len(array)] for array in (self.base, self.link_transforms, self.tool)
        )
        origins = chain.axis_frames @ links
        origins[:-1] = origins[:-1] @ se3.inverse(chain.axis_frames[1:])
        return replace(chain, origins=origins, base=base, tool=tool)

    @cached_property
    def _powers(self) -> tuple[Array, Array]:
        """Powers 1, A, A², A³ of the twists' matrices (p, b, 4, 16), and their rates ω (p, b)."""
        twists = self.twists.swapaxes(0, 1)
        first = np.zeros((*twists.shape[:2], 4, 4))
        first[..., :3, :3], first[..., :3, 3] = se3.skew(twists[..., 3:]), twists[..., :3]
        second = first @ first
        powers = np.stack([np.broadcast_to(np.eye(4), first.shape), first, second, first @ second], 2)
        return powers.reshape(*powers.shape[:3], 16), np.linalg.norm(twists[..., 3:], axis=-1)

    def _exponentials(self, x: Array) -> Array:
        """Compute exp(x·A) of each parameter, shape (p, b, 4, 4), at x (b, p)."""
        powers, rate = self._powers
        x = x.T
        _, two, three = se3.exp_coefficients(x * rate)
        coefficients = np.stack([np.ones_like(x), x, x**2 * two, x**3 * three], -1)
        return (coefficients[..., None, :] @ powers).reshape(*x.shape, 4, 4)

    def _propagate(self, x: Array) -> tuple[ChainBatch, Array]:
        """Compute the chains at x (b, p), and the frame of each error in its body, shape (p, b, 4, 4)."""
        exponentials = self._exponentials(x)
        frames = np.empty_like(exponentials)
        error_frames = [parameter.error_frame for parameter in self.model.parameters]

        def apply_errors(error_frame: int, frame: Array) -> Array:
            """Multiply a frame by all errors at one error frame, and store the frame before each of them."""
            first, end = bisect_left(error_frames, error_frame), bisect_right(error_frames, error_frame)
            for i in range(first, end):
                frames[i] = frame
                frame = frame @ exponentials[i]
            return frame

        base_error = apply_errors(BASE_FRAME, np.eye(4))
        n_base = bisect_right(error_frames, BASE_FRAME)
        # Body 0 follows the errors of the base.
        frames[:n_base] = se3.inverse(base_error) @ frames[:n_base]
        links = np.empty((self.n_chains, *self.link_transforms.shape[1:]))
        for j, link in enumerate(self.link_transforms.swapaxes(0, 1)):
            # Errors of link j, then those of joint j + 1 or of the tip.
            links[:, j] = apply_errors(2 * j + 2, apply_errors(2 * j + 1, np.eye(4)) @ link)
        end = apply_errors(self.model.chain.tool_frame_index, links[:, -1] @ self.tool)
        tool = se3.inverse(links[:, -1]) @ end
        return replace(self, base=self.base @ base_error, link_transforms=links, tool=tool), frames

    def at(self, x: Array) -> ChainBatch:
        """Build the chains with given errors."""
        return self._propagate(x)[0]

    def derivative(self, x: Array) -> tuple[ChainBatch, Array, Array]:
        """Compute the chains at x (b, p), and bodies (p,) and twists (p, b, 6) of their derivatives."""
        chains, frames = self._propagate(x)
        error_frames = np.array([parameter.error_frame for parameter in self.model.parameters], int)
        twists = self.twists.swapaxes(0, 1)[..., None]
        # The adjoint of the frames, applied to [v, ω].
        rotation = frames[..., :3, :3]
        angular = (rotation @ twists[..., 3:, :])[..., 0]
        linear = (rotation @ twists[..., :3, :])[..., 0] + np.cross(frames[..., :3, 3], angular)
        bodies = np.clip((error_frames - 1) // 2, 0, self.link_transforms.shape[1] - 1)
        return chains, bodies, np.concatenate([linear, angular], -1)

    def forward_kinematics(self, q: Array) -> FrameBatch:
        """Compute all frames."""
        chain = self.model.chain
        positions = np.moveaxis(q @ chain.mimic_matrix.T + chain.mimic_offset, -1, 0).copy()
        shape = positions.shape[1:]
        cos, sin = (part.reshape(positions.shape) for part in cos_sin(positions.reshape(len(positions), -1)))
        bodies = np.empty((len(chain.moving_joints) + 1, 7, 3, *shape))
        bodies[0, :4] = self.base[:, :3].transpose(2, 1, 0)[:, :, None, :, None]
        for j in range(len(chain.moving_joints)):
            frame = _multiply_columns(bodies[j], self.link_transforms[:, j], bodies[j + 1])
            if chain.prismatic[j]:
                frame[3] += frame[2] * positions[j]
            else:
                x, y = frame[0].copy(), frame[1].copy()
                frame[0] = x * cos[j] + y * sin[j]
                frame[1] = y * cos[j] - x * sin[j]
        tool = _multiply_columns(
            bodies[-1], self.link_transforms[:, -1] @ self.tool, np.empty((4, 3, *shape))
        )
        return FrameBatch(bodies.reshape(len(bodies), 7, 3, -1), tool.reshape(4, 3, -1))


def _structure(model: ErrorModel) -> tuple[object, ...]:
    """Return what all models of a batch must have in common."""
    chain = model.chain
    arrays = (chain.axes, chain.prismatic, chain.mimic_matrix, chain.mimic_offset)
    parameters = [(parameter.name, parameter.error_frame) for parameter in model.parameters]
    return (chain.joint_names, chain.moving_joints, parameters, *(array.tolist() for array in arrays))


def _twists(model: ErrorModel) -> Array:
    """Return the parameters' twists (p, 6) in frames whose joint axis is z."""
    chain, out = model.chain, np.array([parameter.twist for parameter in model.parameters]).reshape(-1, 6)
    body_from_urdf = se3.adjoint(se3.inverse(chain.axis_frames))
    for i, parameter in enumerate(model.parameters):
        body = parameter.error_frame // 2
        if body < len(body_from_urdf) and parameter.error_frame != BASE_FRAME:
            out[i] = body_from_urdf[body] @ out[i]
    return out


def _multiply_columns(frames: Array, links: Array, out: Array) -> Array:
    """Multiply frames (4, 3, …, b, m), stored by columns, by one link (b, 4, 4) per chain."""
    for column in range(4):
        coefficients = links[:, :, column].T[:, :, None]
        np.multiply(frames[0], coefficients[0], out=out[column])
        out[column] += frames[1] * coefficients[1]
        out[column] += frames[2] * coefficients[2]
    out[3] += frames[3]
    return out
