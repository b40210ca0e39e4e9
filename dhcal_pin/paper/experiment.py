"""The paper's experiment: the measured robot (Tables 3 to 5), calibrated and judged by leave-one-out.

Table 5 is screened first: rows that the robot cannot reach are left out. The remaining rows are fitted in
three ways: the paper's single pseudo-inverse step (37) to (39), least squares with the parameters held that
the positions cannot determine, and the published parameters of Table 4. The error that counts is that of a
row under the fit to all other rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from .. import se3
from .._frozen import frozen
from ..calibration.evaluation import Accuracy, Comparison, accuracy, compute_errors
from ..calibration.procedure import calibrate
from ..calibration.result import Result
from ..diagnostics.reachability import UnreachableRow, find_unreachable_rows
from ..estimation.parameters import select_parameters
from ..estimation.problem import Problem, linearize_and_factor
from ..identifiability import observability
from ..io import MeasurementFile, read_dh, read_measurement_file, shipped_file
from ..measurements.base import Measurement
from ..robot.chain import Chain


def paper_arm(name: str) -> Chain:
    """Read one of the paper's arms."""
    return Chain.from_dh(read_dh(shipped_file(f"{name}.dh.toml")), name)


def parameters_to_fix(chain: Chain, data: Sequence[Measurement]) -> list[str]:
    """Find DH parameters that have to be held so that the others are observable."""
    errors = select_parameters(chain, "dh")
    zero = np.zeros(len(errors.parameters))
    system = linearize_and_factor(Problem(errors, tuple(data), zero), zero, small_angle=False)
    names = [
        errors.parameters[i].name
        for members, n_unobservable in observability.unobservable_groups(system.r)
        for i in members[len(members) - n_unobservable :]
    ]
    return sorted(names)


def leave_one_out(fit: Callable[[Measurement], Result], data: Measurement) -> Accuracy:
    """Compute the accuracy of each sample under the fit to all other samples."""
    rows = np.arange(len(data.q))
    errors = [compute_errors(fit(data.take(rows != row)).chain, [data.take(rows == row)])[0] for row in rows]
    return Accuracy.from_errors(errors)


@frozen(eq=False)
class PaperExperiment:
    """Result of the paper's experiment."""

    chain: Chain  #: Robot as designed (Table 3).
    measurements: MeasurementFile  #: Table 5 as printed.
    unreachable_rows: list[UnreachableRow]  #: Its rows that the robot cannot reach.
    data: Measurement  #: Samples of the other rows.
    fixed: list[str]  #: Parameters that these positions cannot determine, and that are held.
    fit: Result  #: Least-squares calibration with these parameters held.
    comparison: Comparison  #: Its accuracy on each sample under the fit to all others, before and after.
    #: Description, RMS of the fitted samples and leave-one-out RMS of each variant [mm], as text.
    rows: list[list[str]]
    figures: dict[str, float]  #: RMS position error of each variant by name [m].


def run_experiment() -> PaperExperiment:
    """Screen Table 5, calibrate the robot of Table 3 on its good rows, compare with the paper."""
    chain = paper_arm("experiment")
    measurements = read_measurement_file(shipped_file("experiment_table5.csv"), chain)
    # Rows are numbered as in the paper's table.
    table = measurements.data.replace(rows=np.arange(1, len(measurements.data.rows) + 1))
    measurements = replace(measurements, data=table)
    unreachable_rows = find_unreachable_rows(chain, measurements)
    is_reachable = ~np.isin(measurements.data.rows, [unreachable.row for unreachable in unreachable_rows])
    data = measurements.data.take(is_reachable)
    fixed = parameters_to_fix(chain, [data])
    commanded, after = measurements.commanded, measurements.measured_after
    assert commanded is not None
    assert after is not None

    def one_step(samples: Measurement) -> Result:
        return calibrate(chain, samples, "dh", method="gn", max_iterations=1)

    def least_squares(samples: Measurement) -> Result:
        return calibrate(chain, samples, "dh", priors="none", fix=fixed)

    fit = least_squares(data)
    nominal_accuracy = accuracy(chain, [data])
    cross_validated = leave_one_out(least_squares, data)
    measured = measurements.data.positions()
    figures = {
        "before": nominal_accuracy["position_rms_m"],
        "one_step": accuracy(one_step(data).chain, [data])["position_rms_m"],
        "one_step_left_out": leave_one_out(one_step, data)["position_rms_m"],
        "least_squares": accuracy(fit.chain, [data])["position_rms_m"],
        "least_squares_left_out": cross_validated["position_rms_m"],
        "published_parameters": accuracy(paper_arm("experiment_published"), [data])["position_rms_m"],
        "paper_before": se3.rms_length((measured - commanded)[is_reachable]),
        "paper_after": se3.rms_length((after - commanded)[is_reachable]),
        "paper_before_all": se3.rms_length(measured - commanded),
        "paper_after_all": se3.rms_length(after - commanded),
    }
    mm = {key: f"{1e3 * value:.3f}" for key, value in figures.items()}
    rows = [
        ["as designed (Table 3)", mm["before"], ""],
        ["one pseudo-inverse step, (37) to (39)", mm["one_step"], mm["one_step_left_out"]],
        [f"least squares, {' and '.join(fixed)} held", mm["least_squares"], mm["least_squares_left_out"]],
        ["parameters as published (Table 4)", mm["published_parameters"], ""],
        ["the paper's own distance from the object, before", mm["paper_before"], ""],
        ["the paper's own distance from the object, after", mm["paper_after"], ""],
    ]
    comparison = Comparison("cross-validated", len(data.q), nominal_accuracy, cross_validated)
    return PaperExperiment(chain, measurements, unreachable_rows, data, fixed, fit, comparison, rows, figures)
