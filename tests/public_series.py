"""Public measurements of real robots and the fixed splits of the benchmark `bench_public.py`.

A split is a list of cases: rows that are fitted, and rows that are judged. All splits are of whole stops:
rows with equal joint positions stay together. They depend on nothing but the joint positions.

    halves       two random halves (seed 0), each judged by a fit of the other
    regions      four regions of joint space, each judged by a fit of the other three; the cuts are the
                 medians of the first two principal components of the joint positions
    other        the other series of the same robot; base and tool are fitted to the judged poses
    20, 50, 100  so many stops of one half (seed 0), judged by the other half, and the same with the halves
                 exchanged
"""

import tomllib
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from robots import MAPS

from dhcal_pin._typing import Array
from dhcal_pin.io import read_measurements, read_robot
from dhcal_pin.measurements import PointContact, Pose
from dhcal_pin.robot import Chain

FEW = (20, 50, 100)
SPLITS = ("halves", "regions", "other", *map(str, FEW))


@dataclass(frozen=True)
class Series:
    """Public measurements of one robot."""

    arm: str  # Name of the robot and of the series.
    instrument: str  # What measured it.
    robot: str  # Robot, relative to the folder of the data if it is a file.
    tip: str | None  # Tip link of a URDF; None for the only one.
    files: str  # Pattern of the measurement files.
    columns: str | None = None  # Column map in tests/maps.
    sets: str = "minimal,base,tool"  # Parameter sets of `dhcal_pin`.
    other: str = ""  # Name of another series of the same robot.

    def read(self, data: Path) -> tuple[Chain, Pose | PointContact] | None:
        """Read the robot and its measurements from the folder of all series; None if they are absent."""
        files = sorted(data.glob(self.files))
        if not files:
            return None
        chain = read_robot(self.robot if self.robot.startswith("example:") else data / self.robot, self.tip)
        columns = MAPS / self.columns if self.columns else None
        parts = [read_measurements(path, chain, columns=columns) for path in files]
        if len(parts) == 1 and isinstance(parts[0], Pose):
            return chain, parts[0]
        names = [name for part in parts for name in part.text_values()["point"]]
        return chain, PointContact(np.concatenate([part.q for part in parts]), names)


SERIES = (
    Series(
        "UR10, series B",
        "laser tracker, pose",
        "example:ur10",
        "tool0",
        "ipa_ur10/Series_B/measurements_joint_configurations.csv",
        "ipa_ur10.toml",
        other="UR10, series D",
    ),
    Series(
        "UR10, series D",
        "laser tracker, pose",
        "example:ur10",
        "tool0",
        "ipa_ur10/Series_D/measurements_iso_cubes.csv",
        "ipa_ur10.toml",
        other="UR10, series B",
    ),
    Series(
        "Franka Research 3",
        "camera on the wrist, pose of the board",
        "example:panda",
        "panda_link8",
        "fr3_d405/camera_in_board.csv",
    ),
    Series(
        "two-axis positioner",
        "metrology camera, pose",
        "positioner_2axis/positioner.dh.toml",
        None,
        "positioner_2axis/measurements.csv",
    ),
    Series(
        "Franka Panda",
        "sockets touched with a ball",
        "mukca_panda/panda_with_ball.urdf",
        "ball_link",
        "mukca_panda/panda_2_clean/*/hole_[01].csv",
        "mukca_panda.toml",
        sets="placement,tool",
    ),
)


def further_series(data: Path) -> tuple[Series, ...]:
    """Read the series that files `series.toml` in a folder describe, with paths relative to each file."""
    found = []
    for path in sorted(data.rglob("series.toml")):
        entries: dict[str, Any] = {"tip": None} | tomllib.loads(path.read_text(encoding="utf-8"))
        place = path.parent.relative_to(data)
        needed = {field.name for field in fields(Series) if field.default is MISSING}
        if wrong := (needed - {*entries}) | ({*entries} - {field.name for field in fields(Series)}):
            raise SystemExit(
                f"{path}: {sorted(wrong)[0]} is missing or unknown; expected {', '.join(sorted(needed))}"
            )
        if not entries["robot"].startswith("example:"):
            entries["robot"] = str(place / entries["robot"])
        if "columns" in entries:
            entries["columns"] = str(path.parent.resolve() / entries["columns"])
        found.append(Series(**entries | {"files": str(place / entries["files"])}))
    return tuple(found)


def random_halves(stops: Array) -> list[Array]:
    """Return the rows of two random halves of the stops; `stops` labels the rows, shape (m,)."""
    count = int(stops.max()) + 1
    drawn = np.random.default_rng(0).permutation(count)
    return [np.flatnonzero(np.isin(stops, part)) for part in (drawn[: count // 2], drawn[count // 2 :])]


def joint_regions(q: Array) -> list[Array]:
    """Return the rows of four regions of the joint positions (m, n)."""
    centred = q - q.mean(0)
    components = centred @ np.linalg.svd(centred, full_matrices=False)[2][:2].T
    first, second = (components > np.median(components, 0)).T
    return [np.flatnonzero((first == a) & (second == b)) for a in (False, True) for b in (False, True)]


def cases(data: Pose | PointContact, split: str) -> Iterator[tuple[Array, Array]]:
    """Yield the fitted and the judged rows of each case of a split, except "other"."""
    stops = np.unique(data.q, axis=0, return_inverse=True)[1].reshape(-1)
    everything = np.arange(len(data.q))
    if split == "regions":
        for region in joint_regions(data.q):
            yield np.setdiff1d(everything, region), region
        return
    for half in random_halves(stops):
        judged = np.setdiff1d(everything, half)
        if split == "halves":
            yield half, judged
            continue
        own = np.random.default_rng(0).permutation(np.unique(stops[half]))
        if len(own) >= int(split):
            yield np.flatnonzero(np.isin(stops, own[: int(split)])), judged
