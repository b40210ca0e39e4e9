"""The paper's arms, and the robot it measured, calibrated on its own table with an honest verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .._typing import Array
from ..calibration.evaluation import Accuracy, Comparison, accuracy, compute_errors
from ..calibration.procedure import calibrate
from ..calibration.result import Result
from ..diagnostics.reachability import UnreachableRow, find_unreachable_rows
from ..estimation.parameters import select_parameters
from ..estimation.problem import Problem, linearize_and_factor
from ..identifiability import observability
from ..io.dh_file import read_dh
from ..io.measurement_csv import MeasurementFile, read_measurement_file
from ..io.shipped_files import shipped_file
from ..measurements.base import Measurement
from ..robot.chain import Chain


def paper_arm(name: str) -> Chain:
    """One of the paper's arms by the name of its DH file, such as `sim_6dof`."""
    return Chain.from_dh(read_dh(shipped_file(f"{name}.dh.toml")), name)


def parameters_to_fix(chain: Chain, data: Sequence[Measurement]) -> list[str]:
    """Parameters to hold so that no direction is unseen at the nominal arm: the last of each group."""
    errors = select_parameters(chain, "dh")
    zero = np.zeros(len(errors.parameters))
    triangle = linearize_and_factor(Problem(errors, tuple(data), zero), zero, small_angle=False)
    held = [
        errors.parameters[i].name
        for members, unseen in observability.unobservable_groups(triangle.r)
        for i in members[len(members) - unseen :]
    ]
    return sorted(held)


def leave_one_out(fit: Callable[[Measurement], Result], data: Measurement) -> Accuracy:
    """Accuracy, as from `accuracy`, on each sample under the fit to all the others."""
    rows = np.arange(len(data.q))
    found = [compute_errors(fit(data.take(rows != row)).chain, [data.take(rows == row)])[0] for row in rows]
    return Accuracy.from_errors(found)


def _rms(difference: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(difference**2, 1))))


@dataclass(frozen=True, eq=False)
class PaperExperiment:
    """The paper's measured robot.

    Attributes:
        chain: as designed (Table 3).
        readings: Table 5 as printed.
        findings: its impossible rows.
        data: the rows that remain.
        fixed: parameters that these poses cannot see.
        fit: least squares on the rest.
        comparison: its accuracy on each sample left out of the fit to the others.
        rows: the comparison for people, numbers in mm.
        figures: the same numbers in m.
    """

    chain: Chain
    readings: MeasurementFile
    findings: list[UnreachableRow]
    data: Measurement
    fixed: list[str]
    fit: Result
    comparison: Comparison
    rows: list[list[str]]
    figures: dict[str, float]


def run_experiment() -> PaperExperiment:
    """Screens Table 5, calibrates Table 3 on what is left, and compares with what the paper printed."""
    chain = paper_arm("experiment")
    readings = read_measurement_file(shipped_file("experiment_table5.csv"), chain)
    findings = find_unreachable_rows(chain, readings)
    good = ~np.isin(readings.data.rows, [finding.row for finding in findings])
    data = readings.data.take(good)
    held = parameters_to_fix(chain, [data])
    commanded, after = readings.commanded, readings.measured_after
    assert commanded is not None
    assert after is not None

    def one_step(part: Measurement) -> Result:
        return calibrate(chain, part, "dh", method="gn", max_iterations=1)

    def least_squares(part: Measurement) -> Result:
        return calibrate(chain, part, "dh", priors="none", fix=held)

    fit = least_squares(data)
    left_out = leave_one_out(least_squares, data)
    step = one_step(data)
    measured = readings.data.positions()
    figures = {
        "before": accuracy(chain, [data])["position_rms_m"],
        "one_step": accuracy(step.chain, [data])["position_rms_m"],
        "one_step_left_out": leave_one_out(one_step, data)["position_rms_m"],
        "least_squares": accuracy(fit.chain, [data])["position_rms_m"],
        "least_squares_left_out": left_out["position_rms_m"],
        "published_parameters": accuracy(paper_arm("experiment_published"), [data])["position_rms_m"],
        "paper_before": _rms((measured - commanded)[good]),
        "paper_after": _rms((after - commanded)[good]),
        "paper_before_all": _rms(measured - commanded),
        "paper_after_all": _rms(after - commanded),
    }
    mm = {key: f"{1e3 * value:.3f}" for key, value in figures.items()}
    rows = [
        ["as designed (Table 3)", mm["before"], ""],
        ["one pseudo-inverse step, (37) to (39)", mm["one_step"], mm["one_step_left_out"]],
        [f"least squares, {' and '.join(held)} held", mm["least_squares"], mm["least_squares_left_out"]],
        ["parameters as published (Table 4)", mm["published_parameters"], ""],
        ["the paper's own distance from the object, before", mm["paper_before"], ""],
        ["the paper's own distance from the object, after", mm["paper_after"], ""],
    ]
    judged = Comparison("cross-validated", len(data.q), accuracy(chain, [data]), left_out)
    return PaperExperiment(chain, readings, findings, data, held, fit, judged, rows, figures)
