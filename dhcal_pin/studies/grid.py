"""The grid of a study: settings, their robots, how poses are chosen, and the file that names them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from .._typing import Array, PathLike
from ..estimation.batch import BatchProblem
from ..estimation.batch_chains import ChainBatch
from ..estimation.parameters import select_parameters
from ..estimation.solver import METHODS
from ..exceptions import DhcalError
from ..io.robot import read_robot
from ..io.shipped_files import shipped_file
from ..io.toml_table import TomlTable
from ..measurements import KINDS
from ..measurements.base import Noise
from ..planning.planner import plan
from ..robot.chain import Chain
from ..robot.sampling import joint_range
from ..units import parse_noise

# Calibrations a task: some tenths of a second.
BLOCK_SIZE = 100
# Largest number of calibrations of a setting.
MAX_SEEDS = 10**6


@dataclass(frozen=True)
class Setting:
    """One point of the grid; every entry can be a list in the file.

    Attributes:
        robot: the nominal robot's file, beside the study or shipped.
        tip: the tip link of URDFs; the deepest leaf without it.
        truth: the true robot's file; without it the truth is the nominal robot with errors drawn.
        error_std: standard deviations of the true robot's parameters, length and angle.
        error_parameters: the sets that these errors are in.
        parameters: the sets that are identified.
        kind: of measurement, one without unknowns of its own.
        noise: its standard deviations an axis.
        poses: how many are measured.
        pose_selection: how they are chosen, of `CHOICES`.
        resample_each_iteration: whether the poses are drawn anew at each iteration; planned ones cannot be.
        method: "lm" or "gn".
        priors: "default" or "none".
        iterations: most steps.
    """

    robot: str
    tip: str = ""
    truth: str = ""
    error_std: str = "1mm,0.3deg"
    error_parameters: str = "placement"
    parameters: str = "minimal,base,tool"
    kind: str = "position"
    noise: str = "0.1mm,0.01deg"
    poses: int = 30
    pose_selection: str = "random"
    resample_each_iteration: bool = False
    method: str = "lm"
    priors: str = "default"
    iterations: int = 100


def configurations(chain: Chain, count: int, rng: np.random.Generator, share: float = 1.0) -> Array:
    """Uniform joint values (count, n) in the lower `share` of each joint's range."""
    low, high = joint_range(chain)
    return rng.uniform(low, low + share * (high - low), (count, chain.n_joints))


# How each arm's poses are drawn: all over the joints' ranges, or in their lowest quarter alone.
SAMPLERS: dict[str, Callable[[Chain, int, np.random.Generator], Array]] = {
    "random": configurations,
    "corner": partial(configurations, share=0.25),
}


# Or all arms of a setting take those that `planning` chooses for the nominal one.
PLANNED = "planned"


POSE_SELECTIONS = (*SAMPLERS, PLANNED)


@dataclass(frozen=True, eq=False)
class Case:
    """A setting with its robots.

    Attributes:
        setting: what is simulated.
        nominal: what the robots are thought to be.
        truth: what they are; None where each draws its own errors.
        poses: (poses, n) joint values that all of them take; None where each draws its own.
    """

    setting: Setting
    nominal: Chain
    truth: Chain | None
    poses: Array | None = None

    def planned(self, count: int, candidates: int = 5000) -> Array:
        """Joint values (count, n) planned for the nominal robot, its kind, noise and parameters."""
        setting = self.setting
        return plan(
            self.nominal,
            count,
            kind=setting.kind,
            noise=Noise(*parse_noise(setting.noise)),
            parameters=setting.parameters,
            candidates=max(candidates, count),
        ).q

    def drawn(self, rng: np.random.Generator) -> Array:
        """One arm's joint values (poses, n)."""
        if self.poses is not None:
            return self.poses
        return SAMPLERS[self.setting.pose_selection](self.nominal, self.setting.poses, rng)


@dataclass(frozen=True, eq=False)
class StudyGrid:
    """A grid of settings.

    Attributes:
        title: what it asks.
        seeds: calibrations a setting, seeded 0, 1, ….
        cases: the settings, in the order of the file's lists, the last one fastest.
        digest: of everything that the result depends on.
        robots: the files that the settings' robots were read from.
    """

    title: str
    seeds: int
    cases: tuple[Case, ...]
    digest: str
    robots: tuple[str, ...]

    def tasks(self) -> list[tuple[Case, int, int]]:
        """Blocks of calibrations: case, first seed, and how many."""
        return [
            (case, first, min(BLOCK_SIZE, self.seeds - first))
            for case in self.cases
            for first in range(0, self.seeds, BLOCK_SIZE)
        ]


def read_study(path: PathLike) -> StudyGrid:
    """Read a study and the robots that it names.

    Args:
        path: TOML file with `title`, `seeds`, and `[settings]` with entries of `Setting` or lists of them.

    Returns:
        The grid of all combinations of settings.
    """
    document = TomlTable.read(path)
    where = document.path
    title = str(document.get("title", ""))
    seeds = document.value("seeds", int, 100, expected="a whole number from 1 to 1000000")
    if not 1 <= seeds <= MAX_SEEDS:
        raise document.error("seeds", "expected a whole number from 1 to 1000000")
    table = document.table("settings", required=True)
    document.finish()
    settings = [_validated(setting, where) for setting in _grid(table)]
    arms = {(name, s.tip) for s in settings for name in (s.robot, s.truth) if name}
    files = {name: os.fspath(_find_robot_file(name, path)) for name in sorted({name for name, _ in arms})}
    chains = {(name, tip): read_robot(files[name], tip or None) for name, tip in sorted(arms)}
    cases = [Case(s, chains[s.robot, s.tip], chains.get((s.truth, s.tip))) for s in settings]
    different = {
        (s.robot, s.tip, s.truth, s.kind, s.parameters, s.error_parameters, s.pose_selection, s.noise): case
        for case in cases
        if (s := case.setting)
    }
    for case in different.values():
        _require_runnable(case, where)
    digest = hashlib.sha256(repr((seeds, settings)).encode())
    for chain in chains.values():
        digest.update(chain.urdf.data + chain.origins.tobytes())
    return StudyGrid(title, seeds, tuple(cases), digest.hexdigest(), tuple(files.values()))


def _grid(table: TomlTable) -> Iterator[Setting]:
    """Build all combinations of the entries of [settings]; the last list varies fastest."""
    types = {"str": "a text", "int": "a whole number", "bool": "true or false"}
    known = {field.name: types[str(field.type)] for field in fields(Setting)}
    values: dict[str, list[Any]] = {}
    table.get("robot", expected='a robot, as in robot = "arm.urdf"')
    present = [name for name in known if name in table]
    table.finish()
    for key in sorted(present, key=table.keys().index):
        value = table.get(key)
        values[key] = value if isinstance(value, list) else [value]
        if not values[key]:
            raise table.error(key, "expected at least one value")
        for entry in values[key]:
            if types.get(type(entry).__name__) != known[key]:
                raise table.error(key, f"expected {known[key]}, or a list of such values")
    for combination in product(*values.values()):
        yield Setting(**dict(zip(values, combination, strict=True)))


def _validated(setting: Setting, where: str) -> Setting:
    for key, known in (
        ("kind", KINDS),
        ("pose_selection", POSE_SELECTIONS),
        ("method", METHODS),
        ("priors", ("default", "none")),
    ):
        if getattr(setting, key) not in known:
            raise DhcalError(f"{where}: {key} = {getattr(setting, key)!r}: choose from {', '.join(known)}")
    for key, least in (("poses", 1), ("iterations", 0)):
        if not least <= getattr(setting, key) <= 10**5:
            raise DhcalError(f"{where}: {key} = {getattr(setting, key)}: must be from {least} to 100000")
    if setting.resample_each_iteration and setting.pose_selection == PLANNED:
        raise DhcalError(
            f"{where}: resample_each_iteration = true: planned poses are not drawn anew; set it to false"
        )
    for key in ("noise", "error_std"):
        parse_noise(getattr(setting, key), f"{where}: {key}")
    return setting


def _find_robot_file(name: str, path: PathLike) -> Path:
    """A robot's file beside the study, or one of those shipped."""
    near = Path(path).resolve().parent / name
    return near if near.exists() else shipped_file(name)


def _require_runnable(case: Case, where: str) -> None:
    """Complains about what would only fail in the middle of the work."""
    setting, nominal = case.setting, case.nominal
    errors = select_parameters(nominal, setting.parameters)
    select_parameters(nominal, setting.error_parameters)
    if case.truth is not None:
        ChainBatch.from_models([errors, select_parameters(case.truth, setting.parameters)])
    q = configurations(nominal, 8, np.random.default_rng(0))
    data = KINDS[setting.kind].simulate(nominal, q, Noise(), np.random.default_rng(0))
    try:
        BatchProblem(ChainBatch.from_models([errors]), (data,), np.zeros(len(errors.parameters)))
        if setting.pose_selection == PLANNED:
            case.planned(1, candidates=8)
    except DhcalError as error:
        raise DhcalError(f"{where}: kind = {setting.kind!r}: {error}") from None
