"""How well a calibration can do: simulated over a grid of settings, many seeds each.

A setting is one line of the result. For each of its seeds a true arm, joint sets, readings and test poses are
drawn from that seed alone, so settings differ by what is set and by nothing else, and any way of sharing
out the work gives the same digits. Planned poses are chosen once a setting, by whoever shares out the work.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import astuple, fields, replace
from itertools import groupby
from typing import Any

import numpy as np

from .. import se3
from .._typing import Array
from ..estimation.batch import Batch, solve
from ..estimation.batch_chains import Arms
from ..estimation.parameters import select
from ..measurements import KINDS
from ..measurements.base import Noise, joined
from ..parallel import HERE, Workers
from ..units import parse_noise
from .grid import PLANNED, Case, Setting, Study, configurations

# Configurations at which each calibrated arm is compared with its true one.
TESTS = 100


# Their seeds lie apart from those of what is measured.
_TEST_SEED = 10**6 + 1


# Sets whose nominal values are those of a table, so that two robots' can be compared.
_TABLES = frozenset(("dh", "modified-dh"))


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
            kind.simulate(chain, case.drawn(rng), noise, rng) for chain, rng in zip(chains, rngs, strict=True)
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


def run(study: Study, done: int = 0, where: Workers = HERE) -> Iterator[list[list[float]]]:
    """The blocks of `Study.tasks`, in order, after those that are done."""
    return where.map(calibrations, _ready(study.tasks()[done:]))


def _ready(tasks: Sequence[tuple[Case, int, int]]) -> Iterator[tuple[Case, int, int]]:
    """The tasks with the poses that are planned, each plan made here and once, when its turn has come."""
    for case, blocks in groupby(tasks, lambda task: task[0]):
        if case.setting.choice == PLANNED:
            case = replace(case, poses=case.planned(case.setting.poses))
        yield from ((case, first, count) for _, first, count in blocks)


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
