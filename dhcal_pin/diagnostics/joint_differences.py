"""Parts of a robot that explain the difference of two calibrations, with the sizes of their differences.

Parameters of joints and links are selected one after the other: each time the parameter that reduces
chi-square most (forward selection). At the end, parameters are removed if the others explain their difference
(backward elimination). All remaining parameters therefore differ by more than three standard deviations.
Zeros may differ by degrees. A selected zero is therefore undone, and the remaining difference is computed
again.

Shapes: m configurations, n joints, p parameters, w whitened displacements.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..estimation.uncertainty import Uncertainty
from ..formatting import SMALL_UNITS, format_fixed, significant_decimals
from ..robot.chain import Chain
from ..robot.conditions import Conditions
from ..robot.error_families import COUPLING, FAMILIES
from ..robot.transmission import Transmission, coefficient_indices

# Smallest reduction of chi-square by a parameter that is named, and its smallest part of chi-square: effects
# of second order of differences of 10 mrad or 10 mm have less.
MIN_REDUCTION, MIN_REDUCTION_PART = 12.0, 1e-3
# A zero is named before other parameters if it reduces chi-square by this part of the largest reduction:
# others have the effects of second order of a large change of a zero.
ZERO_PREFERENCE = 0.9
# Smallest part of the effect of a parameter that those selected before it do not have.
MIN_NEW_EFFECT = 0.05
# Zeros are undone again until they change by less than this [rad or m], at most a few times.
ZERO_TOL, MAX_ITERATIONS = 1e-7, 4


@frozen(eq=False)
class Parameter:
    """Parameter of a joint or link that may differ."""

    part: str  # Name of the joint or link
    name: str  # What of it, such as "zero" or "backlash"
    unit: str  # Its unit
    effects: Array  # Its effects on displacements (m, 6), or on whitened ones (w,)
    joint: int | None = None  # Number of the joint whose zero it is


@frozen
class PartDifference:
    """Difference of a joint or link of two robots."""

    parameter: str  #: Parameter with the largest part of chi-square, such as "zero"
    size: float  #: Its difference, second robot less first one
    std: float  #: Standard deviation of the size
    unit: str  #: Unit of the size
    chi_square: float  #: Part of chi-square of all parameters of the joint or link

    @property
    def text(self) -> str:
        """Parameter with its size and standard deviation."""
        factor, unit = SMALL_UNITS.get(self.unit, (1e6, " µm/m/K") if self.unit == "1/K" else (1e3, " ‰"))
        decimals = significant_decimals(factor * self.std)
        value, std = (format_fixed(factor * number, decimals) for number in (self.size, self.std))
        return f"{self.parameter} {value} ± {std}{unit}"

    def to_dict(self) -> dict[str, Any]:
        """Return the difference for a JSON document."""
        return {key: getattr(self, key) for key in ("chi_square", "parameter", "size", "std", "unit")}


# Names of the errors of families in sentences.
_NAMES = {
    "gain": "gear ratio",
    "harmonics": "eccentricity",
    "compliance": "elasticity",
    "thermal": "thermal growth",
}
_PLACEMENTS = [*((f"position {axis}", "m") for axis in "xyz"), *((f"orientation {a}", "rad") for a in "xyz")]


def parameters(chain: Chain, at: Conditions) -> list[Parameter]:
    """List the parameters of all joints and links with their effects on the tool, zeros first."""
    if chain.transmission is None:
        chain = chain.with_transmission(Transmission.zero(chain.urdf_alone.loads))
    labels = [
        (name, "zero", "m" if chain.is_prismatic[i] else "rad") for i, name in enumerate(chain.joint_names)
    ]
    for name in chain.moving_joints:
        labels += [(name, *placement) for placement in _PLACEMENTS]
    indices, entries = coefficient_indices(*chain.mimic_matrix.shape), []
    for family in FAMILIES.values():
        if family.is_curve or family.name == COUPLING:
            continue
        names = chain.link_names if family.link_term else chain.joint_names
        for each in family.coefficients(chain, indices):
            suffix = f" {each.name}" if family.orders else ""
            labels.append((names[each.owner], _NAMES.get(family.name, family.name) + suffix, each.unit))
            entries.append(each.entry)
    frames, n_bodies = chain.forward_kinematics(at), len(chain.moving_joints) + 1
    # The placement of a joint is a motion of the body in front of it: the last body is in front of none.
    directions = np.delete(np.eye(6 * n_bodies + len(entries)), np.s_[6 * n_bodies - 6 : 6 * n_bodies], 1)
    known = Uncertainty(chain, np.array(entries), directions, directions[:, :0])
    twists = known.tool_twists(frames, directions).transpose(2, 0, 1)
    effects = np.concatenate([chain.joint_jacobian(frames).transpose(0, 2, 1), twists])
    return [
        Parameter(*label, effect, i if i < chain.n_joints else None)
        for i, (label, effect) in enumerate(zip(labels, effects, strict=True))
    ]


def find_part_differences(
    candidates: Sequence[Parameter], remaining: Callable[[Array], Array], n_joints: int
) -> tuple[dict[str, PartDifference], Array]:
    """Return the parts that differ, the largest part of chi-square first, and the zeros (n,) of joints."""
    # `remaining` returns the whitened difference (w,) after zeros (n,) of the second robot are undone.
    chosen: list[Parameter] = []
    zeros, left = np.zeros(n_joints), remaining(np.zeros(n_joints))
    while (best := _best(candidates, chosen, left)) is not None:
        chosen.append(best)
        zeros, left = _undo_zeros(chosen, remaining, zeros, left)
    # The whole difference, with the linear effects of the zeros.
    z = left + sum(
        (each.effects * zeros[each.joint] for each in chosen if each.joint is not None), 0.0 * left
    )
    while chosen and min(gains := _gains(chosen, z)) < MIN_REDUCTION:
        chosen.pop(gains.index(min(gains)))
    return _described(chosen, z), zeros


def _best(candidates: Sequence[Parameter], chosen: Sequence[Parameter], left: Array) -> Parameter | None:
    """Return the parameter that explains most beyond those that are chosen; None if no one is needed."""
    if not candidates:
        return None
    effects, used = _joined(candidates, left), np.linalg.qr(_joined(chosen, left))[0]
    own = effects - used @ (used.T @ effects)
    lengths = np.linalg.norm(own, axis=0)
    is_new = lengths > MIN_NEW_EFFECT * np.linalg.norm(effects, axis=0)
    gains = np.where(is_new, left @ own / np.where(is_new, lengths, 1.0), 0.0) ** 2
    is_zero = np.array([each.joint is not None for each in candidates])
    best = int(np.argmax(np.where(is_zero & (gains >= ZERO_PREFERENCE * gains.max()), np.inf, gains)))
    least = max(MIN_REDUCTION, MIN_REDUCTION_PART * float(left @ left))
    return candidates[best] if gains[best] > least else None


def _joined(chosen: Sequence[Parameter], z: Array) -> Array:
    """Return the effects (w, p) of parameters on a whitened difference (w,)."""
    return np.array([each.effects for each in chosen]).reshape(-1, len(z)).T


def _fitted(chosen: Sequence[Parameter], z: Array) -> tuple[Array, Array]:
    """Return the values (p,) of parameters that explain a difference, and their standard deviations."""
    effects = _joined(chosen, z)
    lengths = np.linalg.norm(effects, axis=0)
    inverse = np.linalg.pinv(effects / lengths) / lengths[:, None]
    return inverse @ z, np.linalg.norm(inverse, axis=1)


def _gains(chosen: Sequence[Parameter], z: Array) -> list[float]:
    """Return by how much chi-square grows without each parameter."""
    values, std = _fitted(chosen, z)
    return ((values / std) ** 2).tolist()


def _undo_zeros(
    chosen: Sequence[Parameter], remaining: Callable[[Array], Array], zeros: Array, left: Array
) -> tuple[Array, Array]:
    """Return the zeros (n,) of joints that are chosen, and the difference (w,) that remains without them."""
    for _ in range(MAX_ITERATIONS):
        step = np.zeros(len(zeros))
        for each, value in zip(chosen, _fitted(chosen, left)[0], strict=True):
            if each.joint is not None:
                step[each.joint] = value
        if np.abs(step).max() < ZERO_TOL:
            break
        moved = remaining(zeros + step)
        if np.linalg.norm(moved) > np.linalg.norm(left):
            break
        zeros, left = zeros + step, moved
    return zeros, left


def _described(chosen: Sequence[Parameter], z: Array) -> dict[str, PartDifference]:
    """Describe the parts that differ, each by the parameter with the largest part of chi-square."""
    if not chosen:
        return {}
    found: dict[str, PartDifference] = {}
    fitted = zip(chosen, *(each.tolist() for each in _fitted(chosen, z)), _gains(chosen, z), strict=True)
    for each, size, std, gain in sorted(fitted, key=lambda item: -item[3]):
        first = found.get(each.part, PartDifference(each.name, size, std, each.unit, 0.0))
        found[each.part] = replace(first, chi_square=first.chi_square + gain)
    return dict(sorted(found.items(), key=lambda item: -item[1].chi_square))
