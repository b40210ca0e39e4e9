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
from ..estimation.batch import BatchProblem, solve_batch
from ..estimation.batch_chains import ChainBatch
from ..estimation.parameters import select_parameters
from ..measurements import KINDS
from ..measurements.base import Noise, concatenate
from ..parallel import SERIAL, TaskExecutor
from ..units import parse_noise
from .grid import PLANNED, Case, Setting, StudyGrid, configurations

# Configurations at which each calibrated arm is compared with its true one.
N_TEST_POSES = 100


# Their seeds lie apart from those of what is measured.
_TEST_SEED = 10**6 + 1


# Sets whose nominal values are those of a table, so that two robots' can be compared.
_TABLES = frozenset(("dh", "modified-dh"))


# What is kept of each calibration, and its unit.
MEASURE_UNITS = {
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


def _true_chains(case: Case, seeds: range) -> tuple[ChainBatch, Array]:
    """The true arms, and their errors (b, p) in what is identified; NaN where that cannot express them."""
    setting, b = case.setting, len(seeds)
    identified = select_parameters(case.nominal, setting.parameters)
    unknown = np.full((b, len(identified.parameters)), np.nan)
    if case.truth is not None:
        true = select_parameters(case.truth, setting.parameters)
        off = [t.nominal - n.nominal for t, n in zip(true.parameters, identified.parameters, strict=True)]
        known = set(setting.parameters.split(",")) <= _TABLES
        return ChainBatch.from_models([true] * b), np.tile(off, (b, 1)) if known else unknown
    wrong = select_parameters(case.nominal, setting.error_parameters)
    length, angle = parse_noise(setting.error_std)
    sizes = np.array([length if parameter.unit == "m" else angle for parameter in wrong.parameters])
    # Apart from what is drawn for the measurement, so that more poses do not mean another robot.
    x = np.array([sizes * np.random.default_rng([seed, 1]).standard_normal(len(sizes)) for seed in seeds])
    same = [p.name for p in wrong.parameters] == [p.name for p in identified.parameters]
    return ChainBatch.from_models([wrong] * b).at(x), x if same else unknown


def calibrations(task: tuple[Case, int, int]) -> list[list[float]]:
    """A block of calibrations: a row of `MEASURES` for each seed."""
    case, first, count = task
    setting, nominal, seeds = case.setting, case.nominal, range(first, first + count)
    errors = select_parameters(nominal, setting.parameters)
    truths, true = _true_chains(case, seeds)
    chains = [truths.chain(i) for i in range(count)]
    rngs = [np.random.default_rng(seed) for seed in seeds]
    noise, kind = Noise(*parse_noise(setting.noise)), KINDS[setting.kind]
    weights = np.zeros(len(errors.parameters)) if setting.priors == "none" else 1 / errors.priors

    def measured() -> BatchProblem:
        items = [
            kind.simulate(chain, case.drawn(rng), noise, rng) for chain, rng in zip(chains, rngs, strict=True)
        ]
        return BatchProblem(ChainBatch.from_models([errors] * count), (concatenate(items),), weights)

    batch = measured()
    most = min(setting.iterations, 1) if setting.resample_each_iteration else setting.iterations
    found = solve_batch(batch, setting.method, most)
    for _ in range(most, setting.iterations if setting.resample_each_iteration else most):
        batch = measured()
        found = solve_batch(batch, setting.method, 1, start=found.x)
    checks = [np.random.default_rng(_TEST_SEED + seed) for seed in seeds]
    tests = np.array([configurations(nominal, N_TEST_POSES, rng) for rng in checks])
    goal, start, end = (
        arms.forward_kinematics(tests[None]).tool.reshape(4, 3, count, N_TEST_POSES)
        for arms in (truths, batch.chains, batch.chains.at(found.x))
    )
    before, off = (np.linalg.norm(frames[3] - goal[3], axis=0) for frames in (start, end))
    turn = np.linalg.norm(se3.log3(np.einsum("cibt,cjbt->btij", goal[:3], end[:3])), axis=-1)
    gap = np.abs(found.x - true)
    angles = np.array([parameter.unit == "rad" for parameter in errors.parameters])
    rows = [
        found.converged,
        found.iterations if not setting.resample_each_iteration else np.full(count, setting.iterations),
        found.rank,
        np.sqrt(found.cost / batch.count_rows()),
        np.sqrt(np.mean(before**2, 1)),
        np.sqrt(np.mean(off**2, 1)),
        off.max(1),
        np.sqrt(np.mean(turn**2, 1)),
        gap[:, ~angles].max(1, initial=0.0),
        gap[:, angles].max(1, initial=0.0),
    ]
    return np.stack(rows, 1).astype(float).tolist()


def run(study: StudyGrid, done: int = 0, executor: TaskExecutor = SERIAL) -> Iterator[list[list[float]]]:
    """The blocks of `Study.tasks`, in order, after those that are done."""
    return executor.map(calibrations, _ready(study.tasks()[done:]))


def _ready(tasks: Sequence[tuple[Case, int, int]]) -> Iterator[tuple[Case, int, int]]:
    """The tasks with the poses that are planned, each plan made here and once, when its turn has come."""
    for case, blocks in groupby(tasks, lambda task: task[0]):
        if case.setting.pose_selection == PLANNED:
            case = replace(case, poses=case.planned(case.setting.poses))
        yield from ((case, first, count) for _, first, count in blocks)


def table(study: StudyGrid, blocks: Sequence[list[list[float]]]) -> tuple[list[str], list[list[Any]]]:
    """Header and a row a setting: the setting, the share that converged, medians, and a 90 % quantile.

    What a setting cannot tell is None.
    """
    names = [field.name for field in fields(Setting)]
    shown = {name: f"{name}[{unit}]" if unit else name for name, unit in MEASURE_UNITS.items()}
    header = [*names, "calibrations", *shown.values(), "position_rms_p90[m]"]
    every = np.array([row for block in blocks for row in block]).reshape(len(study.cases), study.seeds, -1)
    rows = []
    for case, part in zip(study.cases, every, strict=True):
        middle = np.median(part, 0)
        middle[0] = np.mean(part[:, 0])
        most = np.quantile(part[:, list(MEASURE_UNITS).index("position_rms")], 0.9)
        figures = [float(value) if np.isfinite(value) else None for value in (*middle, most)]
        rows.append([*astuple(case.setting), study.seeds, *figures])
    return header, rows
