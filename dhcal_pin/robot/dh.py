"""Denavit-Hartenberg tables, standard and modified, revolute and prismatic.

Lengths in metres, angles in radians. With q_i the joint value, row i is

* standard: Rz(θ+q)·Tz(d)·Tx(a)·Rx(α)·Ry(β), which joint i moves about z_{i-1} (equation 1);
* modified: Tx(a)·Rx(α)·Ry(β)·Tz(d)·Rz(θ+q), with a and α those of the link before the joint.

A prismatic joint's value is added to d instead. β is Hayati's angle for (nearly) parallel axes and
zero in a plain table.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from .. import se3
from .._typing import Array
from ..exceptions import DhcalError

Convention = Literal["standard", "modified"]


CONVENTIONS = ("standard", "modified")


def axis_rotation(axis: int, angle: Array) -> Array:
    """Rotations (..., 4, 4) about coordinate axis 0, 1 or 2 by angle (...,) in radians.

    Quarter turns are exact: cos 90° is 0, not 6e-17, so a table's right angles stay right.
    """
    c, s = np.cos(angle), np.sin(angle)
    c, s = np.where(np.abs(c) < 1e-16, 0.0, c), np.where(np.abs(s) < 1e-16, 0.0, s)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros((*np.shape(angle), 4, 4))
    out[..., axis, axis] = out[..., 3, 3] = 1.0
    out[..., i, i], out[..., i, j], out[..., j, i], out[..., j, j] = c, -s, s, c
    return out


def axis_translation(axis: int, length: Array) -> Array:
    """Translations (..., 4, 4) along coordinate axis 0, 1 or 2 by length (...,) in metres."""
    return se3.translation(np.asarray(length)[..., None] * np.eye(3)[axis])


def _identity() -> Array:
    return np.eye(4)


@dataclass(frozen=True)
class DHTable:
    """A serial arm as a DH table of n joints.

    Attributes:
        convention: "standard" or "modified".
        names: the n joints' names.
        prismatic: (n,) True where the joint slides.
        theta, d, a, alpha: (n,) rad, m, m, rad.
        beta: (n,) rad, Hayati's angle about y; zero in a plain table.
        lower, upper: (n,) joint limits, rad or m; infinite where there is none.
        base: (4, 4) pose of the table's frame 0 in the robot's base frame.
        tool: (4, 4) pose of the tool in the table's last frame.
    """

    convention: Convention
    names: tuple[str, ...]
    prismatic: Array
    theta: Array
    d: Array
    a: Array
    alpha: Array
    beta: Array
    lower: Array
    upper: Array
    base: Array = field(default_factory=_identity)
    tool: Array = field(default_factory=_identity)

    def __post_init__(self) -> None:
        n = len(self.names)
        if self.convention not in CONVENTIONS:
            raise DhcalError(f"convention {self.convention!r}: must be 'standard' or 'modified'")
        if n == 0:
            raise DhcalError("a DH table needs at least one joint")
        if len(set(self.names)) != n:
            raise DhcalError(f"joint names must differ: {', '.join(self.names)}")
        for key in ("theta", "d", "a", "alpha", "beta", "lower", "upper", "prismatic"):
            value = np.asarray(getattr(self, key), bool if key == "prismatic" else float)
            if value.shape != (n,):
                raise DhcalError(f"DH column {key!r}: {value.size} values for {n} joints")
            if key in ("theta", "d", "a", "alpha", "beta") and not np.isfinite(value).all():
                raise DhcalError(f"DH column {key!r}: every value must be finite")
            object.__setattr__(self, key, value)

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.names)

    def rows(self, q: Array) -> Array:
        """Link transforms A_i (m, n, 4, 4) at joint values q (m, n) in rad or m (equation 1)."""
        q = np.atleast_2d(np.asarray(q, float))
        if q.shape[1] != self.n_joints:
            raise DhcalError(f"q has {q.shape[1]} columns, the table has {self.n_joints} joints")
        spin = axis_rotation(2, self.theta + np.where(self.prismatic, 0.0, q))
        slide = axis_translation(2, self.d + np.where(self.prismatic, q, 0.0))
        link = axis_translation(0, self.a) @ axis_rotation(0, self.alpha) @ axis_rotation(1, self.beta)
        if self.convention == "standard":
            return spin @ slide @ link
        return link @ slide @ spin

    def poses(self, q: Array) -> Array:
        """Tool poses (m, 4, 4) in the robot's base frame, the plain product (equation 2)."""
        rows = self.rows(q)
        out = np.broadcast_to(self.base, (len(rows), 4, 4))
        for i in range(self.n_joints):
            out = out @ rows[:, i]
        return out @ self.tool

    def origins(self) -> Array:
        """Joint origins and tool (n+1, 4, 4) of the same arm written as a URDF.

        Each joint turns about (or slides along) its own z. Standard: joint 1's origin is the base,
        joint i+1's is row i, the tool carries row n. Modified: joint i's origin is row i. Every
        change of a table entry is exactly a change of one origin.
        """
        rows = self.rows(np.zeros((1, self.n_joints)))[0]
        if self.convention == "standard":
            out = np.concatenate([self.base[None], rows])
            out[-1] = out[-1] @ self.tool
        else:
            out = np.concatenate([rows, self.tool[None]])
            out[0] = self.base @ out[0]
        return out
