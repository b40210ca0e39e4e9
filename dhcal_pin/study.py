"""How well a calibration can do: simulated over a grid of settings, many seeds each.

A setting is one line of the result. For each of its seeds a true arm, joint sets, readings and test poses are
drawn from that seed alone, so settings differ by what is set and by nothing else, and any way of sharing
out the work gives the same digits.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from . import se3
from .arms import Arms
from .batch import Batch, joined, solve
from .chain import Chain
from .configurations import joint_range
from .errors import DhcalError
from .executors import HERE, Workers
from .files import PathLike, parse_noise, read_toml
from .kinds import KINDS
from .measurements import Noise
from .parameters import select
from .robot_files import paper_file, read_robot
from .se3 import Array
from .solver import METHODS

# Calibrations a task: some tenths of a second.
BLOCK = 100
# Configurations at which each calibrated arm is compared with its true one.
TESTS = 100
# Their seeds lie apart from those of what is measured.
_TEST_SEED = 10**6 + 1
# Sets whose nominal values are those of a table, so that two robots' can be compared.
_TABLES = frozenset(("dh", "modified-dh"))


@dataclass(frozen=True)
class Setting:
    """One point of the grid; every entry can be a list in the file.

    Attributes:
        robot: the nominal robot's file, beside the study or shipped.
        truth: the true robot's file; without it the truth is the nominal robot with errors drawn.
        errors: standard deviations of the true robot's parameters, length and angle.
        wrong: the sets that these errors are in.
        parameters: the sets that are identified.
        kind: of measurement, one without unknowns of its own.
        noise: its standard deviations an axis.
        poses: how many are measured.
        choice: how they are chosen, of `CHOICES`.
        redrawn: whether the poses are drawn anew at each iteration.
        method: "lm" or "gn".
        priors: "default" or "none".
        iterations: most steps.
    """

    robot: str
    truth: str = ""
    errors: str = "1mm,0.3deg"
    wrong: str = "placement"
    parameters: str = "minimal,base,tool"
    kind: str = "position"
    noise: str = "0.1mm,0.01deg"
    poses: int = 30
    choice: str = "random"
    redrawn: bool = False
    method: str = "lm"
    priors: str = "default"
    iterations: int = 100


def configurations(chain: Chain, count: int, rng: np.random.Generator, share: float = 1.0) -> Array:
    """Uniform joint values (count, n) in the lower `share` of each joint's range."""
    low, high = joint_range(chain)
    return rng.uniform(low, low + share * (high - low), (count, chain.size))


# How poses are chosen: all over the joints' ranges, or in their lowest quarter alone.
CHOICES: dict[str, Callable[[Chain, int, np.random.Generator], Array]] = {
    "random": configurations,
    "corner": partial(configurations, share=0.25),
}
# What is kept of each calibration, and its unit.
MEASURES = {
    "converged": "",
    "steps": "",
    "rank": "",
    "residual_rms": "",
    "before_rms": "m",
    "position_rms": "m",
    "position_max": "m",
    "orientation_rms": "rad",
    "length_error": "m",
    "angle_error": "rad",
}


@dataclass(frozen=True, eq=False)
class Case:
    """A setting with its robots."""

    setting: Setting
    nominal: Chain
    truth: Chain | None


@dataclass(frozen=True, eq=False)
class Study:
    """A grid of settings.

    Attributes:
        title: what it asks.
        seeds: calibrations a setting, seeded 0, 1, ….
        cases: the settings, in the order of the file's lists, the last one fastest.
        digest: of everything that the result depends on.
    """

    title: str
    seeds: int
    cases: tuple[Case, ...]
    digest: str

    def tasks(self) -> list[tuple[Case, int, int]]:
        """Blocks of calibrations: case, first seed, and how many."""
        return [
            (case, first, min(BLOCK, self.seeds - first))
            for case in self.cases
            for first in range(0, self.seeds, BLOCK)
        ]


# --- reading ---------------------------------------------------------------------------------------


def read_study(path: PathLike) -> Study:
    """A study's TOML file: `title`, `seeds`, and `[settings]` with `Setting`'s entries or lists of them.

    Raises:
        DhcalError: an unknown key, a value that does not fit, a robot that cannot be read.
    """
    document = read_toml(path)
    where = os.fspath(path)
    if odd := sorted(set(document) - {"title", "seeds", "settings"}):
        raise DhcalError(f"{where}: {odd[0]!r} is not known; a study has title, seeds and [settings]")
    seeds, table = document.get("seeds", 100), document.get("settings")
    if isinstance(seeds, bool) or not isinstance(seeds, int) or not 1 <= seeds <= 10**6:
        raise DhcalError(f"{where}: seeds = {seeds!r}: must be a whole number from 1 to 1000000")
    if not isinstance(table, dict) or "robot" not in table:
        raise DhcalError(f'{where}: no robot; write [settings] with robot = "arm.urdf" in it')
    settings = [_checked(setting, where) for setting in _grid(table, where)]
    chains: dict[str, Chain] = {}
    for name in {name for setting in settings for name in (setting.robot, setting.truth) if name}:
        chains[name] = read_robot(_beside(name, path))
    cases = [Case(setting, chains[setting.robot], chains.get(setting.truth)) for setting in settings]
    different = {
        (s.robot, s.truth, s.kind, s.parameters, s.wrong): case for case in cases if (s := case.setting)
    }
    for case in different.values():
        _tried(case, where)
    digest = hashlib.sha256(repr((seeds, settings)).encode())
    for name in sorted(chains):
        digest.update(chains[name].urdf.data + chains[name].origins.tobytes())
    return Study(str(document.get("title", "")), seeds, tuple(cases), digest.hexdigest())


def _grid(table: Mapping[str, Any], where: str) -> Iterator[Setting]:
    types = {field.name: field.type for field in fields(Setting)}
    lists = {}
    for key, value in table.items():
        if key not in types:
            raise DhcalError(f"{where}: setting {key!r} is not known; there are {', '.join(types)}")
        lists[key] = value if isinstance(value, list) else [value]
        for entry in lists[key]:
            if type(entry).__name__ != types[key]:
                kind = {"str": "a text", "int": "a whole number", "bool": "true or false"}[str(types[key])]
                raise DhcalError(f"{where}: setting {key} = {entry!r}: must be {kind}, or a list of such")
        if not lists[key]:
            raise DhcalError(f"{where}: setting {key} = []: give at least one value")
    for values in product(*lists.values()):
        yield Setting(**dict(zip(lists, values, strict=True)))


def _checked(setting: Setting, where: str) -> Setting:
    for key, known in (
        ("kind", KINDS),
        ("choice", CHOICES),
        ("method", METHODS),
        ("priors", ("default", "none")),
    ):
        if getattr(setting, key) not in known:
            raise DhcalError(f"{where}: {key} = {getattr(setting, key)!r}: choose from {', '.join(known)}")
    for key, least in (("poses", 1), ("iterations", 0)):
        if not least <= getattr(setting, key) <= 10**5:
            raise DhcalError(f"{where}: {key} = {getattr(setting, key)}: must be from {least} to 100000")
    for key in ("noise", "errors"):
        parse_noise(getattr(setting, key), f"{where}: {key}")
    return setting


def _beside(name: str, path: PathLike) -> Path:
    """A robot's file beside the study, or one of those shipped."""
    near = Path(path).resolve().parent / name
    return near if near.exists() else paper_file(name)


def _tried(case: Case, where: str) -> None:
    """Complains about what would only fail in the middle of the work."""
    setting, nominal = case.setting, case.nominal
    errors = select(nominal, setting.parameters)
    select(nominal, setting.wrong)
    if case.truth is not None:
        Arms.of([errors, select(case.truth, setting.parameters)])
    q = configurations(nominal, 8, np.random.default_rng(0))
    data = KINDS[setting.kind].simulate(nominal, q, Noise(), np.random.default_rng(0))
    try:
        Batch(Arms.of([errors]), (data,), np.zeros(len(errors.parameters)))
    except DhcalError as error:
        raise DhcalError(f"{where}: kind = {setting.kind!r}: {error}") from None


# --- one block -------------------------------------------------------------------------------------


def _truths(case: Case, seeds: range) -> tuple[Arms, Array]:
    """The true arms, and their errors (b, p) in what is identified; NaN where that cannot express them."""
    setting, b = case.setting, len(seeds)
    identified = select(case.nominal, setting.parameters)
    unknown = np.full((b, len(identified.parameters)), np.nan)
    if case.truth is not None:
        true = select(case.truth, setting.parameters)
        off = [t.nominal - n.nominal for t, n in zip(true.parameters, identified.parameters, strict=True)]
        known = set(setting.parameters.split(",")) <= _TABLES
        return Arms.of([true] * b), np.tile(off, (b, 1)) if known else unknown
    wrong = select(case.nominal, setting.wrong)
    length, angle = parse_noise(setting.errors)
    sizes = np.array([length if parameter.unit == "m" else angle for parameter in wrong.parameters])
    # Apart from what is drawn for the measurement, so that more poses do not mean another robot.
    x = np.array([sizes * np.random.default_rng([seed, 1]).standard_normal(len(sizes)) for seed in seeds])
    same = [p.name for p in wrong.parameters] == [p.name for p in identified.parameters]
    return Arms.of([wrong] * b).at(x), x if same else unknown


def calibrations(task: tuple[Case, int, int]) -> list[list[float]]:
    """A block of calibrations: a row of `MEASURES` for each seed."""
    case, first, count = task
    setting, nominal, seeds = case.setting, case.nominal, range(first, first + count)
    errors = select(nominal, setting.parameters)
    truths, true = _truths(case, seeds)
    chains = [truths.chain(i) for i in range(count)]
    rngs = [np.random.default_rng(seed) for seed in seeds]
    noise, kind = Noise(*parse_noise(setting.noise)), KINDS[setting.kind]
    weights = np.zeros(len(errors.parameters)) if setting.priors == "none" else 1 / errors.priors

    def measured() -> Batch:
        items = [
            kind.simulate(chain, CHOICES[setting.choice](nominal, setting.poses, rng), noise, rng)
            for chain, rng in zip(chains, rngs, strict=True)
        ]
        return Batch(Arms.of([errors] * count), (joined(items),), weights)

    batch = measured()
    most = min(setting.iterations, 1) if setting.redrawn else setting.iterations
    found = solve(batch, setting.method, most)
    for _ in range(most, setting.iterations if setting.redrawn else most):
        batch = measured()
        found = solve(batch, setting.method, 1, start=found.x)
    checks = [np.random.default_rng(_TEST_SEED + seed) for seed in seeds]
    tests = np.array([configurations(nominal, TESTS, rng) for rng in checks])
    goal, start, end = (
        arms.sweep(tests[None]).tool.reshape(4, 3, count, TESTS)
        for arms in (truths, batch.arms, batch.arms.at(found.x))
    )
    before, off = (np.linalg.norm(sweep[3] - goal[3], axis=0) for sweep in (start, end))
    turn = np.linalg.norm(se3.log3(np.einsum("cibt,cjbt->btij", goal[:3], end[:3])), axis=-1)
    gap = np.abs(found.x - true)
    angles = np.array([parameter.unit == "rad" for parameter in errors.parameters])
    rows = [
        found.converged,
        found.iterations if not setting.redrawn else np.full(count, setting.iterations),
        found.rank,
        np.sqrt(found.cost / batch.rows()),
        np.sqrt(np.mean(before**2, 1)),
        np.sqrt(np.mean(off**2, 1)),
        off.max(1),
        np.sqrt(np.mean(turn**2, 1)),
        gap[:, ~angles].max(1, initial=0.0),
        gap[:, angles].max(1, initial=0.0),
    ]
    return np.stack(rows, 1).astype(float).tolist()


# --- the table -------------------------------------------------------------------------------------


def run(study: Study, done: int = 0, where: Workers = HERE) -> Iterator[list[list[float]]]:
    """The blocks of `Study.tasks`, in order, after those that are done."""
    return where.map(calibrations, study.tasks()[done:])


def table(study: Study, blocks: Sequence[list[list[float]]]) -> tuple[list[str], list[list[Any]]]:
    """Header and a row a setting: the setting, the share that converged, medians, and a 90 % quantile.

    What a setting cannot tell is None.
    """
    names = [field.name for field in fields(Setting)]
    shown = {name: f"{name}[{unit}]" if unit else name for name, unit in MEASURES.items()}
    header = [*names, "calibrations", *shown.values(), "position_rms_p90[m]"]
    every = np.array([row for block in blocks for row in block]).reshape(len(study.cases), study.seeds, -1)
    rows = []
    for case, part in zip(study.cases, every, strict=True):
        middle = np.median(part, 0)
        middle[0] = np.mean(part[:, 0])
        most = np.quantile(part[:, list(MEASURES).index("position_rms")], 0.9)
        figures = [float(value) if np.isfinite(value) else None for value in (*middle, most)]
        rows.append([*astuple(case.setting), study.seeds, *figures])
    return header, rows
