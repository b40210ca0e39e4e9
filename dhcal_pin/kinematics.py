"""Frames and velocities of a serial arm over many samples, components first: samples are contiguous."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from .scratch import LongRows, scratch
from .se3 import Array

# So many samples of all bodies stay in a processor's cache.
BLOCK = 2048


@dataclass(frozen=True, eq=False)
class Motion:
    """What m configurations ask of a chain's joints; errors do not change it, so one serves a whole search.

    Attributes:
        joints: (n, m) values of the independent joints, rad or m.
        values: (k, m) of the moving joints, rad or m.
        cos, sin: (k, m) of the values.
    """

    joints: Array
    values: Array
    cos: Array
    sin: Array


@dataclass(frozen=True, eq=False)
class Sweep:
    """Frames of a chain at m samples, components first so that the samples are contiguous.

    Attributes:
        bodies: (k+1, 4, 3, m) columns x, y, z, p of each body's frame in the measuring frame. A body's
            frame has its joint's axis along z.
        tool: (4, 3, m) columns of the tool's frame.
        terms: (t, n, m) of the independent joints' transmission, where the chain has one.
    """

    bodies: Array
    tool: Array
    terms: Array | None = None

    def poses(self) -> Array:
        """Tool poses (m, 4, 4) in the measuring frame."""
        out = np.zeros((self.tool.shape[-1], 4, 4))
        out[:, :3, :] = self.tool.transpose(2, 1, 0)
        out[:, 3, 3] = 1.0
        return out


def motion(joints: Array, values: Array) -> Motion:
    """The motion of moving joints that stand at values (k, m) when the independent ones do at (n, m)."""
    # One tangent of half the angle costs a fifth of a cosine and a sine.
    half = np.tan(0.5 * values)
    square = half * half
    return Motion(joints, values, (1 - square) / (1 + square), 2 * half / (1 + square))


@LongRows()
def carry_frames(links: Array, prismatic: Array, motion: Motion, frames: Array) -> None:
    """Fills frames (k+2, 4, 3, m), whose first is the base's, with every body's and the tool's.

    Args:
        links: (k+1, 4, 4) constant transforms between the motions; the last one leads to the tool.
        prismatic: (k,) True where a joint slides along its z; the others turn about it.
        motion: of the joints.
        frames: columns x, y, z, p of each frame.
    """
    turned = scratch("turned", 2, *frames.shape[2:])
    mixing = np.swapaxes(links, 1, 2)
    for j, (after, slides) in enumerate(zip(frames[1:-1], prismatic, strict=True)):
        # The columns of F·L are the columns of F mixed by L: one small product for all samples.
        before = frames[j].reshape(4, -1)
        np.matmul(mixing[j, :2], before, out=turned.reshape(2, -1))
        np.matmul(mixing[j, 2:], before, out=after[2:].reshape(2, -1))
        if slides:
            after[:2] = turned
            after[3] += after[2] * motion.values[j]
        else:
            np.multiply(turned, motion.cos[j], out=after[:2])
            turned *= motion.sin[j]
            after[0] += turned[1]
            after[1] -= turned[0]
    np.matmul(mixing[-1], frames[-2].reshape(4, -1), out=frames[-1].reshape(4, -1))


@LongRows()
def point_velocities(bodies: Array, point: Array, at: Array, twists: Array, out: Array) -> Array:
    """A point's velocity (p, 6, m) per unit of each twist of a body, axes of the measuring frame.

    Args:
        bodies: (b, 4, 3, m) columns x, y, z, p of each body's frame.
        point: (3, m).
        at: (p,) body numbers, ascending.
        twists: (p, 6) twists in those bodies' frames.
        out: (p, 6, m), written in place.
    """
    counts = np.bincount(at, minlength=len(bodies))
    used = np.flatnonzero(counts)
    groups = list(itertools.pairwise([0, *np.cumsum(counts[used]).tolist()]))
    frames = bodies if len(used) == len(bodies) else bodies[used]
    for start in range(0, point.shape[-1], BLOCK):
        some = np.s_[..., start : start + BLOCK]
        axes, moved = frames[:, :3][some], _moved_point(frames[some], point[some])
        # A twist mixes what its body's axes do, one small product for all samples and components.
        for (first, last), turn, move in zip(groups, axes, moved, strict=True):
            rows = out[first:last][some].transpose(1, 0, 2)
            np.matmul(twists[first:last], move.transpose(1, 0, 2), out=rows[:3])
            np.matmul(twists[first:last, 3:], turn.transpose(1, 0, 2), out=rows[3:])
    return out


def _moved_point(bodies: Array, point: Array) -> Array:
    """How a point (3, m) moves when it slides along each body's axes and turns about them, (b, 6, 3, m)."""
    count, _, _, m = bodies.shape
    axes, out = bodies[:, :3], scratch("moved", count, 6, 3, m)
    lever, product = scratch("lever", count, 1, 3, m), scratch("product", count, 3, m)
    np.subtract(point, bodies[:, 3:], out=lever)
    out[:, :3] = axes
    # The cross products of all bodies at once, a component at a time.
    for x, y, z in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        turned = out[:, 3:, x]
        np.multiply(axes[:, :, y], lever[:, :, z], out=turned)
        turned -= np.multiply(axes[:, :, z], lever[:, :, y], out=product)
    return out
