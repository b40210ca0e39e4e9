"""A whole calibration by Ceres through pyceres, all samples in one vectorised block with our Jacobian.

Run by `bench_table.py` where pyceres can be imported; prints seconds as JSON.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pyceres  # pyright: ignore[reportMissingImports]
from bench_calibration import analytic, cases
from bench_common import clocked

from dhcal_pin.calibration import calibrate
from dhcal_pin.problem import Problem
from dhcal_pin.solver import levenberg_marquardt


class Block(pyceres.CostFunction):
    """Residuals and Jacobian of all the rows."""

    def __init__(self, residual, jacobian, rows: int, columns: int):
        super().__init__()
        self.residual, self.jacobian = residual, jacobian
        self.set_num_residuals(rows)
        self.set_parameter_block_sizes([columns])

    def Evaluate(self, parameters, residuals, jacobians):  # noqa: D102
        x = np.array(parameters[0])
        residuals[:] = self.residual(x)
        if jacobians is not None:
            jacobians[0][:] = self.jacobian(x).ravel()
        return True


def solved(residual, jacobian, start: np.ndarray) -> np.ndarray:
    """Where Ceres ends with dense QR and its usual tolerances."""
    x = start.copy()
    problem, options, summary = pyceres.Problem(), pyceres.SolverOptions(), pyceres.SolverSummary()
    cost = Block(residual, jacobian, len(residual(x)), len(x))
    problem.add_residual_block(cost, None, [x])
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_QR
    options.num_threads = 1
    pyceres.solve(options, problem, summary)
    return x


def alone(problem: Problem, start: np.ndarray) -> np.ndarray:
    """Where our own loop ends on the same least squares."""
    return levenberg_marquardt(problem.of(problem.data), start, 100, None).x


def main(m: int, repeats: int) -> None:
    """Prints [name, our whole calibration, our loop alone, Ceres] of each arm, in seconds."""
    out = []
    for name, chain, sets, data in cases(m):
        fit = calibrate(chain, data, sets)
        residual, jacobian = analytic(fit.problem)
        start, fresh = np.zeros(len(fit.x)), replace(fit.problem)
        ways = [
            partial(calibrate, chain, data, sets),
            partial(alone, fresh, start),
            partial(solved, residual, jacobian, start),
        ]
        ends = [float(np.sum(residual(x) ** 2)) for x in (fit.x, ways[1](), ways[2]())]
        assert max(ends[:2]) <= ends[2] * (1 + 1e-6), ends
        out.append([name, *clocked(ways, repeats)])
    print(json.dumps(out))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
