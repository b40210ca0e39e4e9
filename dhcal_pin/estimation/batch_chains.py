"""Many arms of one structure at once: their kinematics and derivatives as stacked arrays.

Samples lie in one row, arm after arm and as many for each, so that a measurement of b·m samples reads a
sweep over b arms as it reads that of one.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .. import se3
from .._kernels import cos_sin
from .._kernels.types import FrameBatch
from .._typing import Array
from ..exceptions import DhcalError
from ..robot.chain import BASE_FRAME, Chain
from ..robot.error_families import FAMILIES
from .error_model import ErrorModel


@dataclass(frozen=True, eq=False)
class ChainBatch:
    """b arms that have the joints and the p error parameters of one model, each with geometry of its own.

    What all arms share is held once, with an axis of length 1 in place of b.

    Attributes:
        model: whose joints, limits and parameters' names and stations all share.
        n_chains: b.
        base: (b, 4, 4).
        link_transforms: (b, k+1, 4, 4) as in `chain.Chain`: between the motions, every joint turning about its z.
        tool: (b, 4, 4).
        twists: (b, p, 6) of the parameters, [v, ω], in the frames that `links` join.
    """

    model: ErrorModel
    n_chains: int
    base: Array
    link_transforms: Array
    tool: Array
    twists: Array

    @classmethod
    def from_models(cls, models: Sequence[ErrorModel]) -> ChainBatch:
        """The arms of several error models.

        Raises:
            DhcalError: they differ in joints or in parameters, or have gains or other errors of the joints'
                transmission.
        """
        first = models[0]
        if first.chain.transmission is not None or any(
            p.coefficient_index is not None for p in first.parameters
        ):
            raise DhcalError(
                f"arm 1 has joint transmission errors ({', '.join(FAMILIES)}); calibrate such arms one by one"
            )
        for number, model in enumerate(models, 1):
            if model.chain.transmission is not None or any(
                p.coefficient_index is not None for p in model.parameters
            ):
                raise DhcalError(
                    f"arm {number} has joint transmission errors ({', '.join(FAMILIES)}); "
                    "calibrate it by itself"
                )
            if model is not first and _structure(model) != _structure(first):
                raise DhcalError(
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
        return self.n_chains

    def take(self, index: Array) -> ChainBatch:
        """The arms of an index (j,)."""
        parts = {name: getattr(self, name) for name in ("base", "link_transforms", "tool", "twists")}
        return replace(
            self,
            n_chains=len(index),
            **{name: part[index] if len(part) > 1 else part for name, part in parts.items()},
        )

    def chain(self, number: int) -> Chain:
        """One of them, from 0."""
        chain = self.model.chain
        base, links, tool = (
            part[number % len(part)] for part in (self.base, self.link_transforms, self.tool)
        )
        origins = chain.axis_frames @ links
        origins[:-1] = origins[:-1] @ se3.inverse(chain.axis_frames[1:])
        return replace(chain, origins=origins, base=base, tool=tool)

    @cached_property
    def _powers(self) -> tuple[Array, Array]:
        """I, A, A², A³ of the twists' matrices A, (p, b, 4, 16), and their turning rates (p, b)."""
        twists = self.twists.swapaxes(0, 1)
        first = np.zeros((*twists.shape[:2], 4, 4))
        first[..., :3, :3], first[..., :3, 3] = se3.skew(twists[..., 3:]), twists[..., :3]
        second = first @ first
        powers = np.stack([np.broadcast_to(np.eye(4), first.shape), first, second, first @ second], 2)
        return powers.reshape(*powers.shape[:3], 16), np.linalg.norm(twists[..., 3:], axis=-1)

    def _factors(self, x: Array) -> Array:
        """Each parameter's motion exp(x·A) (p, b, 4, 4) at x (b, p); A³ ends it, as A⁴ = -rate²·A²."""
        powers, rate = self._powers
        x = x.T
        _, two, three = se3.exp_coefficients(x * rate)
        terms = np.stack([np.ones_like(x), x, x**2 * two, x**3 * three], -1)
        return (terms[..., None, :] @ powers).reshape(*x.shape, 4, 4)

    def _propagate(self, x: Array) -> tuple[ChainBatch, Array]:
        """The arms at x (b, p), and where each parameter acts, (p, b, 4, 4) in its body's frame."""
        factors = self._factors(x)
        places = np.empty_like(factors)
        stations = [parameter.error_frame for parameter in self.model.parameters]

        def through(station: int, frame: Array) -> Array:
            for i in range(bisect_left(stations, station), bisect_right(stations, station)):
                places[i] = frame
                frame = frame @ factors[i]
            return frame

        moved = through(BASE_FRAME, np.eye(4))
        outside = bisect_right(stations, BASE_FRAME)
        # Body 0 is behind the base's own errors.
        places[:outside] = se3.inverse(moved) @ places[:outside]
        links = np.empty((self.n_chains, *self.link_transforms.shape[1:]))
        for j, link in enumerate(self.link_transforms.swapaxes(0, 1)):
            links[:, j] = through(2 * j + 2, through(2 * j + 1, np.eye(4)) @ link)
        end = through(self.model.chain.tool_frame_index, links[:, -1] @ self.tool)
        tool = se3.inverse(links[:, -1]) @ end
        return replace(self, base=self.base @ moved, link_transforms=links, tool=tool), places

    def at(self, x: Array) -> ChainBatch:
        """The arms with errors x (b, p) in m and rad."""
        return self._propagate(x)[0]

    def derivative(self, x: Array) -> tuple[ChainBatch, Array, Array]:
        """The arms at x (b, p), and each parameter's body (p,) and twist (p, b, 6) there.

        As `parameters.ErrorModel.derivative`, for all arms in one walk along the chain.
        """
        arms, places = self._propagate(x)
        stations = np.array([parameter.error_frame for parameter in self.model.parameters], int)
        twists = self.twists.swapaxes(0, 1)[..., None]
        turn = places[..., :3, :3]
        spin = (turn @ twists[..., 3:, :])[..., 0]
        slide = (turn @ twists[..., :3, :])[..., 0] + np.cross(places[..., :3, 3], spin)
        bodies = np.clip((stations - 1) // 2, 0, self.link_transforms.shape[1] - 1)
        return arms, bodies, np.concatenate([slide, spin], -1)

    def forward_kinematics(self, q: Array) -> FrameBatch:
        """All frames at joint values q (c, b, m, n), the samples in a row (c·b·m)."""
        chain = self.model.chain
        values = np.moveaxis(q @ chain.mimic_matrix.T + chain.mimic_offset, -1, 0).copy()
        shape = values.shape[1:]
        cos, sin = (each.reshape(values.shape) for each in cos_sin(values.reshape(len(values), -1)))
        bodies = np.empty((len(chain.moving_joints) + 1, 7, 3, *shape))
        bodies[0, :4] = self.base[:, :3].transpose(2, 1, 0)[:, :, None, :, None]
        for j in range(len(chain.moving_joints)):
            after = _multiply_columns(bodies[j], self.link_transforms[:, j], bodies[j + 1])
            if chain.prismatic[j]:
                after[3] += after[2] * values[j]
            else:
                x, y = after[0].copy(), after[1].copy()
                after[0] = x * cos[j] + y * sin[j]
                after[1] = y * cos[j] - x * sin[j]
        tool = _multiply_columns(
            bodies[-1], self.link_transforms[:, -1] @ self.tool, np.empty((4, 3, *shape))
        )
        return FrameBatch(bodies.reshape(len(bodies), 7, 3, -1), tool.reshape(4, 3, -1))


def _structure(model: ErrorModel) -> tuple[object, ...]:
    chain = model.chain
    arrays = (chain.axes, chain.prismatic, chain.mimic_matrix, chain.mimic_offset)
    names = [(parameter.name, parameter.error_frame) for parameter in model.parameters]
    return (chain.joint_names, chain.moving_joints, names, *(array.tolist() for array in arrays))


def _twists(model: ErrorModel) -> Array:
    """The parameters' twists (p, 6) in frames whose joint axis is z."""
    chain, out = model.chain, np.array([parameter.twist for parameter in model.parameters]).reshape(-1, 6)
    into = se3.adjoint(se3.inverse(chain.axis_frames))
    for i, parameter in enumerate(model.parameters):
        body = parameter.error_frame // 2
        if body < len(into) and parameter.error_frame != BASE_FRAME:
            out[i] = into[body] @ out[i]
    return out


def _multiply_columns(frames: Array, links: Array, out: Array) -> Array:
    """Columns of F·L (4, 3, …, b, m) of frames F (4, 3, …, b, m) and each arm's link L (b, 4, 4)."""
    for column in range(4):
        mix = links[:, :, column].T[:, :, None]
        np.multiply(frames[0], mix[0], out=out[column])
        out[column] += frames[1] * mix[1]
        out[column] += frames[2] * mix[2]
    out[3] += frames[3]
    return out
