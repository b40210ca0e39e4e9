"""Run of a study: many simulated calibrations of each setting, and statistics of their errors.

For each seed a true robot, measured poses, measurements and test poses are drawn from that seed alone.
Settings therefore differ by their entries only, and the results do not depend on the distribution of tasks to
processes or on interruptions. Planned poses are chosen once per setting by the process that distributes the
tasks.

Calibrations of a block are solved together as a batch. Shapes: b robots of a block, p parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import astuple, fields, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import se3
from .._typing import Array
from ..estimation.batch import BatchProblem, ChainBatch, solve_batch
from ..estimation.parameters import select_parameters
from ..measurements import KINDS
from ..measurements.base import Noise, concatenate
from ..parallel import SERIAL, TaskExecutor
from ..units import column_header, parse_noise
from .grid import MAX_SEEDS, PLANNED, Case, Setting, StudyGrid, Task, draw_configurations

# Number of test poses at which each calibrated robot is compared with its true robot.
N_TEST_POSES = 100

# First seed of the test poses; the seeds of the measurements are below it.
_TEST_SEED = MAX_SEEDS + 1

# Parameter sets whose nominal values are table entries, so that the true errors are differences of two
# tables.
_TABLE_SETS = frozenset(("dh", "modified-dh"))

# Quantile of the position error in the last column of the table.
_UPPER_QUANTILE = 0.9

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Results of each calibration, and their units.
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


def run(study: StudyGrid, done: int = 0, executor: TaskExecutor = SERIAL) -> Iterator[list[list[float]]]:
    """Run the tasks of a study in order."""
    return executor.map(run_block, _with_planned_poses(study.tasks()[done:]))


def run_block(task: Task) -> list[list[float]]:
    """Simulate and calibrate the robots of a block."""
    case, first, count = task
    setting, nominal, seeds = case.setting, case.nominal, range(first, first + count)
    errors = select_parameters(nominal, setting.parameters)
    true_chains, true_x = _draw_true_chains(case, seeds)
    chains = [true_chains.chain(i) for i in range(count)]
    rngs = [np.random.default_rng(seed) for seed in seeds]
    noise, kind = Noise(*parse_noise(setting.noise)), KINDS[setting.kind]
    weights = np.zeros(len(errors.parameters)) if setting.priors == "none" else 1 / errors.priors

    def simulate() -> BatchProblem:
        items = [
            kind.simulate(chain, case.draw_poses(rng), noise, rng)
            for chain, rng in zip(chains, rngs, strict=True)
        ]
        return BatchProblem(ChainBatch.from_models([errors] * count), (concatenate(items),), weights)

    batch = simulate()
    if setting.resample_each_iteration:
        result = solve_batch(batch, setting.method, min(setting.iterations, 1))
        for _ in range(1, setting.iterations):
            batch = simulate()
            result = solve_batch(batch, setting.method, 1, start=result.x)
        iterations = np.full(count, setting.iterations)
    else:
        result = solve_batch(batch, setting.method, setting.iterations)
        iterations = result.iterations
    test_rngs = [np.random.default_rng(_TEST_SEED + seed) for seed in seeds]
    test_q = np.array([draw_configurations(nominal, N_TEST_POSES, rng) for rng in test_rngs])
    true, before, after = (
        chains_at.forward_kinematics(test_q[None]).tool.reshape(4, 3, count, N_TEST_POSES)
        for chains_at in (true_chains, batch.chains, batch.chains.at(result.x))
    )
    error_before, error_after = (np.linalg.norm(frames[3] - true[3], axis=0) for frames in (before, after))
    rotation = np.linalg.norm(se3.log3(np.einsum("cibt,cjbt->btij", true[:3], after[:3])), axis=-1)
    parameter_errors = np.abs(result.x - true_x)
    is_angle = np.array([parameter.unit == "rad" for parameter in errors.parameters])
    columns = [
        result.converged,
        iterations,
        result.rank,
        np.sqrt(result.cost / batch.count_rows()),
        np.sqrt(np.mean(error_before**2, 1)),
        np.sqrt(np.mean(error_after**2, 1)),
        error_after.max(1),
        np.sqrt(np.mean(rotation**2, 1)),
        parameter_errors[:, ~is_angle].max(1, initial=0.0),
        parameter_errors[:, is_angle].max(1, initial=0.0),
    ]
    return np.stack(columns, 1).astype(float).tolist()


def result_table(study: StudyGrid, blocks: Sequence[list[list[float]]]) -> tuple[list[str], list[list[Any]]]:
    """Summarize the results of a study, one row per setting.

    The columns are the entries of the setting, the number of calibrations, the fraction that converged, the
    medians of the other results, and the 90 % quantile of the position error. Values that are not defined for
    a setting are None.
    """
    names = [field.name for field in fields(Setting)]
    measures = [column_header(name, unit) for name, unit in MEASURE_UNITS.items()]
    header = [*names, "calibrations", *measures, "position_rms_p90[m]"]
    results = np.array([row for block in blocks for row in block]).reshape(len(study.cases), study.seeds, -1)
    rows = []
    for case, values in zip(study.cases, results, strict=True):
        statistics = np.median(values, 0)
        statistics[0] = np.mean(values[:, 0])
        quantile = np.quantile(values[:, list(MEASURE_UNITS).index("position_rms")], _UPPER_QUANTILE)
        finite = [float(value) if np.isfinite(value) else None for value in (*statistics, quantile)]
        rows.append([*astuple(case.setting), study.seeds, *finite])
    return header, rows


def plot_study(
    study: StudyGrid,
    blocks: Sequence[list[list[float]]],
    ax: Axes | None = None,
    *,
    column: str = "position_rms[m]",
) -> Axes:
    """Plot one result of a study over the numeric setting with the most values.

    Example:
        `plot_study(study, list(run(study))).figure.savefig("study.png")`
    """
    from .. import plots  # lazy import: slow to load

    header, rows = result_table(study, blocks)
    ax = plots.plot_study(header, rows, len(fields(Setting)), column, ax)
    if len(ax.get_lines()) > 1:
        ax.legend(frameon=False, fontsize="small")
    return ax


def _draw_true_chains(case: Case, seeds: range) -> tuple[ChainBatch, Array]:
    """Draw the true robots of a block."""
    setting, b = case.setting, len(seeds)
    estimated = select_parameters(case.nominal, setting.parameters)
    undefined = np.full((b, len(estimated.parameters)), np.nan)
    if case.truth is not None:
        true = select_parameters(case.truth, setting.parameters)
        x = [t.nominal - n.nominal for t, n in zip(true.parameters, estimated.parameters, strict=True)]
        is_table = set(setting.parameters.split(",")) <= _TABLE_SETS
        return ChainBatch.from_models([true] * b), np.tile(x, (b, 1)) if is_table else undefined
    errors = select_parameters(case.nominal, setting.error_parameters)
    length, angle = parse_noise(setting.error_std)
    std = np.array([length if parameter.unit == "m" else angle for parameter in errors.parameters])
    # A separate generator, so that the robot of a seed does not depend on the number of poses.
    x = np.array([std * np.random.default_rng([seed, 1]).standard_normal(len(std)) for seed in seeds])
    is_same_set = [p.name for p in errors.parameters] == [p.name for p in estimated.parameters]
    return ChainBatch.from_models([errors] * b).at(x), x if is_same_set else undefined


def _with_planned_poses(tasks: Sequence[Task]) -> Iterator[Task]:
    """Generate the tasks, with the poses of each planned case computed once before its first task."""
    for case, blocks in groupby(tasks, lambda task: task[0]):
        if case.setting.pose_selection == PLANNED:
            case = replace(case, poses=case.plan_poses(case.setting.poses))
        yield from ((case, first, count) for _, first, count in blocks)
