"""Characteristics of poses as ISO 9283:1998 defines them.

Each of the p points has m cycles. With the attained positions x_j, their barycentre x̄, the commanded position
x_c, and the rotation vectors φ_j of the attained against the commanded orientation (all in axes of the
measuring frame):

    AP_p = |x̄ - x_c|,  AP_x,y,z = x̄ - x_c,  AP_a,b,c = φ̄         pose accuracy, 7.2.1
    RP_l = l̄ + 3 S_l,  l_j = |x_j - x̄|,  RP_a,b,c = 3 S_a,b,c    pose repeatability, 7.2.2
    AD = D̄ - D_c,  RD = 3 S_D,  D_j = |x_1j - x_2j|              distance accuracy and repeatability, 7.3
    dAP_p = max_k |AP_p,k - AP_p,1|, and so on for the others    drift of pose characteristics, 7.6

S is the standard deviation with divisor m - 1. For errors of some degrees or less, the components of the
rotation vector are the rotations about x, y and z. The drift compares groups k of cycles with the first one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..calibration.evaluation import compute_errors
from ..exceptions import InvalidArgumentError
from ..formatting import Quantity, Table
from ..measurements.base import Measurement
from ..measurements.configurations import group_by_configuration
from ..measurements.pose import Pose
from ..measurements.position import Position
from ..robot.chain import Chain

# Clause of the standard for each group of characteristics.
CLAUSES = {
    "pose accuracy": "7.2.1",
    "pose repeatability": "7.2.2",
    "distance accuracy and repeatability": "7.3",
    "drift of pose characteristics": "7.6",
}
# Cycles of each group whose characteristics are compared for the drift.
DRIFT_CYCLES = 10
# Largest difference of the joint values of one point [rad or m]: those of an encoder differ by less.
MAX_JOINT_DIFFERENCE = 1e-3
# Commanded distances that differ by less are equal [m].
DISTANCE_TOL = 1e-6


@frozen(eq=False)
class PointCycles:
    """Attained poses of one point, in the order of the cycles."""

    name: str  #: Name, such as "P1".
    cycles: Array  #: Number of each cycle, (m,).
    commanded: Array  #: Commanded position, (3,) [m].
    attained: Array  #: Attained positions, (m, 3) [m].
    #: Rotation vectors from the commanded to the attained orientations, (m, 3) [rad]; None without.
    rotations: Array | None

    def characteristics(self) -> dict[str, float]:
        """Return AP and RP by their names with units, such as `AP_p_m`."""
        barycentre = self.attained.mean(0)
        offset, lengths = barycentre - self.commanded, np.linalg.norm(self.attained - barycentre, axis=1)
        found = {
            "AP_p_m": float(np.linalg.norm(offset)),
            **{f"AP_{axis}_m": float(value) for axis, value in zip("xyz", offset, strict=True)},
            "RP_l_m": float(lengths.mean() + 3 * lengths.std(ddof=1)),
        }
        if self.rotations is not None:
            mean, spread = self.rotations.mean(0), 3 * self.rotations.std(0, ddof=1)
            found |= {f"AP_{axis}_rad": float(value) for axis, value in zip("abc", mean, strict=True)}
            found |= {f"RP_{axis}_rad": float(value) for axis, value in zip("abc", spread, strict=True)}
        return found

    def drift(self) -> dict[str, float]:
        """Return the drift of each characteristic, such as `dAP_p_m`; empty with too few cycles."""
        n_groups = len(self.cycles) // DRIFT_CYCLES
        groups = np.array_split(np.arange(len(self.cycles)), max(n_groups, 1))
        first, *others = (self._take(group).characteristics() for group in groups)
        return {
            f"d{name}": max(abs(other[name] - value) for other in others)
            for name, value in first.items()
            if others
        }

    def _take(self, index: Array) -> PointCycles:
        """Return some of the cycles."""
        rotations = None if self.rotations is None else self.rotations[index]
        return PointCycles(self.name, self.cycles[index], self.commanded, self.attained[index], rotations)


@frozen(eq=False)
class PoseCharacteristics:
    """Test of pose characteristics according to ISO 9283."""

    points: Sequence[PointCycles]  #: Points, in the order of their first cycle.

    def distances(self) -> list[dict[str, Any]]:
        """Return AD and RD of each pair of points that have at least two common cycles."""
        found = []
        for a, b in combinations(self.points, 2):
            _, i, j = np.intersect1d(a.cycles, b.cycles, return_indices=True)
            attained = np.linalg.norm(a.attained[i] - b.attained[j], axis=1)
            commanded = float(np.linalg.norm(a.commanded - b.commanded))
            if len(i) >= 2:
                found.append(
                    {
                        "points": [a.name, b.name],
                        "cycles": len(i),
                        "commanded_m": commanded,
                        "AD_m": float(attained.mean() - commanded),
                        "RD_m": float(3 * attained.std(ddof=1)),
                    }
                )
        return found

    def longest_distance(self) -> dict[str, Any]:
        """Return the pair of points with the longest commanded distance, the first of equal ones."""
        distances = self.distances()
        return max(distances, key=lambda each: round(each["commanded_m"] / DISTANCE_TOL), default={})

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the JSON document [m and rad]."""
        found = [point.characteristics() | point.drift() for point in self.points]
        points = [
            {
                "point": point.name,
                "cycles": len(point.cycles),
                "commanded_m": point.commanded.tolist(),
                **values,
            }
            for point, values in zip(self.points, found, strict=True)
        ]
        names = dict.fromkeys(name for each in found for name in each)
        largest = {name: max(abs(each[name]) for each in found if name in each) for name in names}
        longest = self.longest_distance()
        return {
            "standard": "ISO 9283:1998",
            "clauses": CLAUSES,
            "points": points,
            "distances": self.distances(),
            "overall": largest | {name: longest.get(name) for name in ("AD_m", "RD_m")},
        }

    def tables(self) -> list[Table]:
        """Return one table of the points and one of the longest distance."""
        document = self.to_dict()
        rows = [*document["points"], {"point": "largest"} | document["overall"]]
        columns = [(name, unit) for name, unit in _SHOWN.items() if all(name in row for row in rows)]
        header = [f"{name.rpartition('_')[0]}, {'mm' if unit == 'm' else 'mrad'}" for name, unit in columns]
        cells = [[row["point"], *(_cell(row[name], unit) for name, unit in columns)] for row in rows]
        clauses = ", ".join(f"{name} {clause}" for name, clause in CLAUSES.items())
        tables = [Table(["point", *header], cells, caption=f"ISO 9283:1998: {clauses}")]
        if longest := self.longest_distance():
            row = [" – ".join(longest["points"]), *(_cell(longest[name], "m") for name in _DISTANCES)]
            tables.append(Table(["distance", "commanded, mm", "AD, mm", "RD, mm"], [row]))
        return tables


# Characteristics that tables show, with their units.
_SHOWN = {
    **dict.fromkeys(("AP_p_m", "RP_l_m"), "m"),
    **{f"{kind}_{axis}_rad": "rad" for kind in ("AP", "RP") for axis in "abc"},
    **dict.fromkeys(("dAP_p_m", "dRP_l_m"), "m"),
}
_DISTANCES = ("commanded_m", "AD_m", "RD_m")


def _cell(value: float, unit: str) -> Quantity:
    """Return a cell with three decimals, whose unit stands in the header."""
    return Quantity(value, unit, is_small=True, has_unit=False)


def pose_characteristics(
    chain: Chain,
    data: Sequence[Measurement],
    points: Sequence[Sequence[tuple[str, int]] | None],
    known: Mapping[str, float] | None = None,
) -> PoseCharacteristics:
    """Compute the characteristics of ISO 9283 from points and cycles such as ("P1", 12) of the samples."""
    # The commanded poses are those of the chain at the joint positions of the samples. Without points, visits
    # of one configuration are one.
    attained = np.concatenate([_positions(item) for item in data])
    errors = compute_errors(chain, data, known or {})
    q = np.concatenate([item.q for item in data])
    commanded = attained - np.concatenate([each["position"] for each in errors])
    has_rotations = all("orientation" in each for each in errors)
    rotations = np.concatenate([each["orientation"] for each in errors]) if has_rotations else None
    samples = [sample for part in points for sample in part or ()]
    if any(part is None for part in points):
        samples = [(f"P{label + 1}", 0) for label in group_by_configuration(q).tolist()]
    found = []
    for name in dict.fromkeys(name for name, _ in samples):
        index = np.array([i for i, (other, _) in enumerate(samples) if other == name])
        _require_cycles(name, q[index])
        cycles = np.array([samples[i][1] for i in index])
        if len(np.unique(cycles)) < len(cycles):
            cycles = np.arange(1, len(index) + 1)
        in_order = np.argsort(cycles)
        index, cycles = index[in_order], cycles[in_order]
        turned = None if rotations is None else rotations[index]
        found.append(PointCycles(name, cycles, commanded[index].mean(0), attained[index], turned))
    return PoseCharacteristics(found)


def _positions(item: Measurement) -> Array:
    """Return the measured positions (m, 3) [m]."""
    if isinstance(item, Pose):
        return item.poses[:, :3, 3]
    if isinstance(item, Position):
        return item.positions()
    raise InvalidArgumentError(
        f"{item.source}: kind {item.kind}; expected positions (x, y, z) or poses for ISO 9283"
    )


def _require_cycles(name: str, q: Array) -> None:
    """Require several samples of a point, visits of one configuration with joint values (m, n)."""
    if len(q) < 2:
        raise InvalidArgumentError(
            f"--iso9283: point {name} has one cycle; expected at least 2 at each point (the standard has 30)"
        )
    if (difference := float(np.ptp(q, axis=0).max())) > MAX_JOINT_DIFFERENCE:
        raise InvalidArgumentError(
            f"--iso9283: the joint values of point {name} differ by {difference:.3g} rad or m; expected the "
            "commanded joint values, equal in each cycle"
        )
