"""Denavit-Hartenberg tables: standard and modified, with revolute and prismatic joints.

With the joint position q_i, row i of a table with n joints is the link transform

* standard: A_i = Rz(θ_i + q_i) · Tz(d_i) · Tx(a_i) · Rx(α_i) · Ry(β_i); joint i moves about z_{i-1};
* modified: A_i = Tx(a_i) · Rx(α_i) · Ry(β_i) · Tz(d_i) · Rz(θ_i + q_i); a_i and α_i belong to the link before
  the joint.

The position of a prismatic joint is added to d_i instead of θ_i. β is Hayati's angle for nearly parallel axes
(Hayati & Mirmirani 1985) and zero in a plain table. The tool pose is base · A_1 · … · A_n · tool.

Lengths are in metres and angles in radians. Shapes: m samples, n joints.
"""

from __future__ import annotations

from dataclasses import field
from typing import Literal

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..exceptions import InvalidArgumentError

Convention = Literal["standard", "modified"]

CONVENTIONS = ("standard", "modified")


def axis_rotation(axis: int, angle: Array) -> Array:
    """Compute rotations about a coordinate axis; those by quarter turns are exact."""
    c, s = np.cos(angle), np.sin(angle)
    c, s = np.where(np.abs(c) < 1e-16, 0.0, c), np.where(np.abs(s) < 1e-16, 0.0, s)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros((*np.shape(angle), 4, 4))
    out[..., axis, axis] = out[..., 3, 3] = 1.0
    out[..., i, i], out[..., i, j], out[..., j, i], out[..., j, j] = c, -s, s, c
    return out


def axis_translation(axis: int, length: Array) -> Array:
    """Compute translations along a coordinate axis."""
    return se3.translation(np.asarray(length)[..., None] * np.eye(3)[axis])


@frozen
class DHTable:
    """Denavit-Hartenberg table of a serial arm with n joints.

    Attributes:
        convention: "standard" or "modified".
        names: Names of the n joints.
        prismatic: True for prismatic joints, shape (n,).
        theta: Joint angles, shape (n,) [rad].
        d: Link offsets, shape (n,) [m].
        a: Link lengths, shape (n,) [m].
        alpha: Link twists, shape (n,) [rad].
        beta: Hayati's angles about y, shape (n,) [rad]; zero in a plain table.
        lower: Lower joint limits, shape (n,) [rad or m]; -inf if there is none.
        upper: Upper joint limits, shape (n,) [rad or m]; inf if there is none.
        base: Pose of frame 0 of the table in the base frame of the robot, shape (4, 4) [m].
        tool: Pose of the tool in the last frame of the table, shape (4, 4) [m].
        continuous: True for revolute joints that turn without end, shape (n,); by default none.
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
    base: Array = field(default_factory=lambda: np.eye(4))
    tool: Array = field(default_factory=lambda: np.eye(4))
    continuous: Array = field(default_factory=lambda: np.array(False))

    def __post_init__(self) -> None:
        n = len(self.names)
        if self.convention not in CONVENTIONS:
            raise InvalidArgumentError(
                f"unknown convention {self.convention!r}; choose from {', '.join(CONVENTIONS)}"
            )
        if n == 0:
            raise InvalidArgumentError("the DH table is empty; expected at least one joint")
        if len(set(self.names)) != n:
            raise InvalidArgumentError(
                f"a joint name occurs twice in {', '.join(self.names)}; expected unique names"
            )
        object.__setattr__(self, "continuous", np.broadcast_to(np.asarray(self.continuous, bool), n))
        for key in ("theta", "d", "a", "alpha", "beta", "lower", "upper", "prismatic"):
            value = np.asarray(getattr(self, key), bool if key == "prismatic" else float)
            if value.shape != (n,):
                raise InvalidArgumentError(f"DH column {key!r} has shape {value.shape}; expected ({n},)")
            if key in ("theta", "d", "a", "alpha", "beta") and not np.isfinite(value).all():
                raise InvalidArgumentError(
                    f"DH column {key!r} has a value that is not finite; expected finite numbers"
                )
            object.__setattr__(self, key, value)

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.names)

    @property
    def joint_types(self) -> list[str]:
        """Type of each joint as in a URDF: "revolute", "prismatic" or "continuous"."""
        return np.where(
            self.prismatic, "prismatic", np.where(self.continuous, "continuous", "revolute")
        ).tolist()

    def rows(self, q: Array) -> Array:
        """Compute the link transforms A_i, shape (m, n, 4, 4) (equation 1 of the paper)."""
        q = np.asarray(q, float)
        if q.ndim != 2 or q.shape[1] != self.n_joints:
            raise InvalidArgumentError(f"q has shape {q.shape}; expected shape (m, {self.n_joints})")
        rotation = axis_rotation(2, self.theta + np.where(self.prismatic, 0.0, q))
        offset = axis_translation(2, self.d + np.where(self.prismatic, q, 0.0))
        link = axis_translation(0, self.a) @ axis_rotation(0, self.alpha) @ axis_rotation(1, self.beta)
        if self.convention == "standard":
            return rotation @ offset @ link
        return link @ offset @ rotation

    def poses(self, q: Array) -> Array:
        """Compute tool poses as the product of the link transforms (equation 2 of the paper).

        Args:
            q: Joint positions, shape (m, n) [rad or m].

        Returns:
            Poses of the tool in the base frame of the robot, shape (m, 4, 4) [m].
        """
        rows = self.rows(q)
        out = np.broadcast_to(self.base, (len(rows), 4, 4))
        for i in range(self.n_joints):
            out = out @ rows[:, i]
        return out @ self.tool

    def origins(self) -> Array:
        """Compute the joint origins and the tool of the equivalent URDF, shape (n+1, 4, 4) [m].

        Each pose is given in the frame before it. Each joint moves about or along its own z axis. In the
        standard convention, the origin of joint 1 is the base, the origin of joint i+1 is row i, and the tool
        contains row n. In the modified convention, the origin of joint i is row i. Each entry of the table
        thus changes exactly one origin.
        """
        rows = self.rows(np.zeros((1, self.n_joints)))[0]
        if self.convention == "standard":
            out = np.concatenate([self.base[None], rows])
            out[-1] = out[-1] @ self.tool
        else:
            out = np.concatenate([rows, self.tool[None]])
            out[0] = self.base @ out[0]
        return out
