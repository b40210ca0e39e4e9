"""Study grids: the settings of simulated calibrations, their robots, and the TOML file that describes them.

A study file lists values of `Setting`; the grid contains every combination. Each setting becomes a `Case`
with its robots. A study is checked completely before it starts, including one small simulated calibration
problem of each kind of setting.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import Field, fields
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from .._frozen import frozen
from .._typing import Array, PathLike
from ..estimation.batch import BatchProblem, ChainBatch
from ..estimation.parameters import select_parameters
from ..estimation.solver import METHODS
from ..exceptions import DhcalError, FileFormatError
from ..io import toml_table as toml
from ..io.robot import read_robot
from ..io.shipped_files import shipped_file
from ..io.toml_table import Key, TomlTable
from ..measurements import KINDS
from ..measurements.base import Noise
from ..messages import quote
from ..planning.planner import plan
from ..robot.chain import Chain
from ..robot.sampling import joint_range
from ..ros_packages import EXAMPLE_PREFIX, resolve_robot_path
from ..units import parse_noise

# Number of calibrations of a task, which takes some tenths of a second.
BLOCK_SIZE = 100

# Maximum number of calibrations of a setting, and maximum of its numbers of poses and of iterations.
MAX_SEEDS = 10**6
_MAX_COUNT = 10**5

# Number of configurations of the problem that checks a setting.
_N_CHECK_POSES = 8

# Number of candidates from which poses are planned.
_N_CANDIDATES = 5000

# Value of `pose_selection` for poses that are planned once for the nominal robot of a setting.
PLANNED = "planned"


@frozen
class Setting:
    """One combination of the grid; every entry can be a list in the file."""

    #: File of the nominal robot, in the folder of the study or part of the package, or a robot of
    #: example-robot-data, written as `example:NAME`.
    robot: str
    tip: str = ""  #: Tip link of URDFs; by default the deepest leaf.
    truth: str = ""  #: File of the true robot; by default true robots are nominal robots with random errors.
    error_std: str = "1mm,0.3deg"  #: Standard deviations of the random errors, length and angle.
    error_parameters: str = "placement"  #: Parameter sets of the random errors.
    parameters: str = "minimal,base,tool"  #: Parameter sets that are estimated.
    kind: str = "position"  #: Measurement kind without instrument parameters.
    noise: str = "0.1mm,0.01deg"  #: Standard deviations of the measurement noise per axis, length and angle.
    poses: int = 30  #: Number of measured poses.
    pose_selection: str = "random"  #: Selection of the poses, one of `POSE_SELECTIONS`.
    #: Whether new poses are drawn for each iteration; not for planned poses.
    resample_each_iteration: bool = False
    method: str = "lm"  #: "lm" or "gn".
    priors: str = "default"  #: "default" or "none".
    iterations: int = 100  #: Maximum number of iterations.


def _setting_key(field: Field[Any]) -> Key:
    """Declare the key of a setting: a value of its type, or a list of such values."""
    kind, name, schema = {
        "str": (str, "a text", "string"),
        "int": (int, "a whole number", "integer"),
        "bool": (bool, "true or false", "boolean"),
    }[str(field.type)]
    return Key(
        f"{name}, or a list of such values",
        {"anyOf": [{"type": schema}, {"type": "array", "minItems": 1, "items": {"type": schema}}]},
        lambda value: all(type(entry) is kind for entry in (value if isinstance(value, list) else [value])),
        lambda value: value if isinstance(value, list) else [value],
        is_optional=True,
    )


# Keys of the table [settings] of a study, and those before it.
SETTING_KEYS = {field.name: _setting_key(field) for field in fields(Setting)}
HEAD_KEYS = {
    "title": Key(default=""),
    "seeds": toml.whole(1, MAX_SEEDS, default=100),
}


def draw_configurations(chain: Chain, count: int, rng: np.random.Generator, fraction: float = 1.0) -> Array:
    """Draw uniform joint positions from the lower part of the joint ranges."""
    low, high = joint_range(chain)
    return rng.uniform(low, low + fraction * (high - low), (count, chain.n_joints))


# Poses that are drawn for each robot: from the whole joint ranges, or from their lowest quarter.
SAMPLERS: dict[str, Callable[[Chain, int, np.random.Generator], Array]] = {
    "random": draw_configurations,
    "corner": partial(draw_configurations, fraction=0.25),
}

POSE_SELECTIONS = (*SAMPLERS, PLANNED)


@frozen(eq=False)
class Case:
    """Setting with its robots."""

    setting: Setting  #: Setting to simulate.
    nominal: Chain  #: Nominal robot.
    truth: Chain | None  #: True robot; None if the errors of each robot are random.
    #: Joint positions that all robots take, shape (poses, n) [rad or m]; None if each draws its own.
    poses: Array | None = None

    def plan_poses(self, count: int, candidates: int = _N_CANDIDATES) -> Array:
        """Plan poses for the nominal robot with the kind, noise and parameters of the setting."""
        setting = self.setting
        return plan(
            self.nominal,
            count,
            kind=setting.kind,
            noise=Noise(*parse_noise(setting.noise)),
            parameters=setting.parameters,
            candidates=max(candidates, count),
        ).q

    def draw_poses(self, rng: np.random.Generator) -> Array:
        """Return the measured joint positions of one robot."""
        if self.poses is not None:
            return self.poses
        return SAMPLERS[self.setting.pose_selection](self.nominal, self.setting.poses, rng)


# Block of calibrations: case, first seed, and number of seeds.
Task = tuple[Case, int, int]


@frozen(eq=False)
class StudyGrid:
    """Grid of settings with the number of calibrations of each."""

    title: str  #: Question that the study answers.
    seeds: int  #: Number of calibrations of each setting, with the seeds 0, 1, ….
    cases: tuple[Case, ...]  #: Settings in the order of the lists in the file; the last list varies fastest.
    digest: str  #: Hash of everything that determines the result.
    robots: tuple[str, ...]  #: Paths of the robot files.

    def tasks(self) -> list[Task]:
        """Return the blocks of calibrations, in the order of the cases."""
        return [
            (case, first, min(BLOCK_SIZE, self.seeds - first))
            for case in self.cases
            for first in range(0, self.seeds, BLOCK_SIZE)
        ]


def read_study(path: PathLike) -> StudyGrid:
    """Read a study and the robots that it names."""
    document = TomlTable.read(path)
    where = document.path
    head = document.some_values(HEAD_KEYS)
    table = document.table("settings", required=True)
    document.finish()
    seeds = head["seeds"]
    settings = [_validated(setting, where) for setting in _grid(table)]
    robots = {(name, s.tip) for s in settings for name in (s.robot, s.truth) if name}
    files = {name: os.fspath(_find_robot_file(name, path)) for name in sorted({name for name, _ in robots})}
    chains = {(name, tip): read_robot(files[name], tip or None) for name, tip in sorted(robots)}
    cases = [Case(s, chains[s.robot, s.tip], chains.get((s.truth, s.tip))) for s in settings]
    # Settings that differ in other values only need one check.
    distinct = {
        (s.robot, s.tip, s.truth, s.kind, s.parameters, s.error_parameters, s.pose_selection, s.noise): case
        for case in cases
        if (s := case.setting)
    }
    for case in distinct.values():
        _require_runnable(case, where)
    digest = hashlib.sha256(repr((seeds, settings)).encode())
    for chain in chains.values():
        digest.update(chain.urdf.data + chain.origins.tobytes())
    return StudyGrid(str(head["title"]), seeds, tuple(cases), digest.hexdigest(), tuple(files.values()))


def _grid(table: TomlTable) -> Iterator[Setting]:
    """Build all combinations of the entries of [settings]; the last list varies fastest."""
    table.get("robot", expected='a robot, as in robot = "arm.urdf"')
    values = table.values(SETTING_KEYS)
    present = [key for key in table.keys() if key in values]
    for key in present:
        if not values[key]:
            raise table.error(key, "expected at least one value")
    for combination in product(*(values[key] for key in present)):
        yield Setting(**dict(zip(present, combination, strict=True)))


def _validated(setting: Setting, where: str) -> Setting:
    """Return a setting after checking its values."""
    for key, known in (
        ("kind", KINDS),
        ("pose_selection", POSE_SELECTIONS),
        ("method", METHODS),
        ("priors", ("default", "none")),
    ):
        if getattr(setting, key) not in known:
            raise FileFormatError(
                f"{where}: unknown {key} {quote(getattr(setting, key))}; choose from {', '.join(known)}"
            )
    for key, minimum in (("poses", 1), ("iterations", 0)):
        if not minimum <= getattr(setting, key) <= _MAX_COUNT:
            raise FileFormatError(
                f"{where}: {key} = {getattr(setting, key)}; expected a whole number from "
                f"{minimum} to {_MAX_COUNT}"
            )
    if setting.resample_each_iteration and setting.pose_selection == PLANNED:
        raise FileFormatError(
            f"{where}: resample_each_iteration = true; planned poses are not resampled, so set it to false"
        )
    for key in ("noise", "error_std"):
        parse_noise(getattr(setting, key), f"{where}: {key}")
    return setting


def _find_robot_file(name: str, path: PathLike) -> Path:
    """Return the path of a robot file in the folder of the study, in the package or in example-robot-data."""
    if name.startswith(EXAMPLE_PREFIX):
        return Path(resolve_robot_path(name))
    in_folder = Path(path).resolve().parent / name
    return in_folder if os.path.exists(in_folder) else shipped_file(name)


def _require_runnable(case: Case, where: str) -> None:
    """Set up a small problem of a case, so that invalid settings are reported before the study starts."""
    setting, nominal = case.setting, case.nominal
    errors = select_parameters(nominal, setting.parameters)
    select_parameters(nominal, setting.error_parameters)
    if case.truth is not None:
        ChainBatch.from_models([errors, select_parameters(case.truth, setting.parameters)])
    q = draw_configurations(nominal, _N_CHECK_POSES, np.random.default_rng(0))
    data = KINDS[setting.kind].simulate(nominal, q, Noise(), np.random.default_rng(0))
    try:
        BatchProblem(ChainBatch.from_models([errors]), (data,), np.zeros(len(errors.parameters)))
        if setting.pose_selection == PLANNED:
            case.plan_poses(1, candidates=_N_CHECK_POSES)
    except DhcalError as error:
        raise FileFormatError(f"{where}: kind = {setting.kind!r}: {error}") from None
