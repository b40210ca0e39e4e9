"""Joint corrections: what to add to a joint value before it is commanded, so that the joint stands there.

The actual position of a joint that is commanded to q is q + e(q). Here e contains the errors that depend on
the joint's own position, gain and harmonics; see `transmission`. The correction c of the value v satisfies

    (v + c) + e(v + c) = v,

so a joint that is commanded to v + c stands at v. To first order c is -e(v). Compliance and coupling depend
on the positions of other joints and cannot be part of such a table; `compensation` takes them into account.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..exceptions import ConvergenceError
from .chain import Chain
from .transmission import MAX_CURVE_ORDER, fill_harmonics

# Values of a table, besides the limits, are multiples of this angle [rad].
STEP = np.deg2rad(1.0)
# Limits beyond this angle count as absent, as URDF files write huge numbers for joints without limits [rad].
MAX_LIMIT = 20 * np.pi
# Newton's method ends at steps below this angle [rad]. Realistic curves need four steps.
_STEP_TOL, _MAX_STEPS = 1e-15, 50


@frozen(eq=False)
class JointCorrection:
    """Correction of one joint over its range."""

    joint: str  #: Name of the joint.
    values: Array  #: Joint values that are meant, ascending, shape (m,) [rad].
    corrections: Array  #: Angles to add to them before they are commanded, shape (m,) [rad].


def joint_corrections(chain: Chain) -> list[JointCorrection]:
    """Compute the corrections of revolute joints with harmonics, at multiples of 1° and at the limits."""
    if chain.transmission is None:
        return []
    lower, upper = _value_range(chain)
    has_harmonics = chain.transmission.harmonics.any((0, 1))
    out = []
    for i in np.flatnonzero(has_harmonics).tolist():
        steps = np.arange(np.ceil(lower[i] / STEP), np.floor(upper[i] / STEP) + 1)
        # A limit that is a whole number of steps up to rounding is not listed twice.
        values = STEP * np.unique(np.round([lower[i] / STEP, *steps, upper[i] / STEP], 9))
        gain, harmonics = chain.transmission.linear[i, i], chain.transmission.harmonics[:, :, i]
        name = chain.joint_names[i]
        out.append(JointCorrection(name, values, _correct(name, values, float(gain), harmonics)))
    return out


def correction_columns(corrections: Sequence[JointCorrection]) -> dict[str, list[Any]]:
    """Return the columns of a CSV file with corrections."""
    names, values, angles = [list[Any]() for _ in range(3)]
    for table in corrections:
        names += [table.joint] * len(table.values)
        values += np.rad2deg(table.values).round(9).tolist()
        angles += np.rad2deg(table.corrections).tolist()
    return {"joint": names, "value[deg]": values, "correction[deg]": angles}


def _value_range(chain: Chain) -> tuple[Array, Array]:
    """Return the lowest and the highest value of each joint, each of shape (n,)."""
    has_lower, has_upper = np.abs(chain.lower) <= MAX_LIMIT, np.abs(chain.upper) <= MAX_LIMIT
    below_upper = np.where(has_upper, np.minimum(chain.upper - 2 * np.pi, -np.pi), -np.pi)
    lower = np.where(has_lower, chain.lower, below_upper)
    return lower, np.where(has_upper, chain.upper, np.maximum(lower + 2 * np.pi, np.pi))


def _correct(name: str, values: Array, gain: float, harmonics: Array) -> Array:
    """Solve the equation of the module docstring by Newton's method; harmonics of shape (K, 2)."""
    orders = np.arange(1, MAX_CURVE_ORDER + 1)
    # Derivatives: k·S·cos kq - k·C·sin kq.
    slopes = np.stack([-harmonics[:, 1], harmonics[:, 0]], 1) * orders[:, None]
    commanded, waves = values.copy(), np.empty((MAX_CURVE_ORDER, 2, len(values)))
    for _ in range(_MAX_STEPS):
        fill_harmonics(commanded, waves)
        error = commanded + gain * commanded + np.tensordot(harmonics, waves) - values
        step = error / (1 + gain + np.tensordot(slopes, waves))
        commanded -= step
        if np.abs(step).max() <= _STEP_TOL * max(1.0, np.abs(values).max()):
            return commanded - values
    raise ConvergenceError(f"joint {name!r}: the errors are too large for a table of corrections")
