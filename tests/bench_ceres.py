"""A whole calibration by Ceres through pyceres: a residual block a sample, and all samples in one block.

Both are given our Jacobian, which is worked out for all samples at once; Ceres sees a part of it or all.

Run by `bench_table.py` where pyceres can be imported; prints seconds as JSON.
"""

import json
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pyceres  # pyright: ignore[reportMissingImports]
from bench_calibration import analytic, cases
from bench_common import clocked, fit_geometry

from dhcal_pin.estimation.problem import Problem
from dhcal_pin.estimation.solver import levenberg_marquardt


class Rows:
    """Residuals and Jacobian of all the rows, worked out once for each x."""

    def __init__(self, residual, jacobian):
        self.functions, self.known = (residual, jacobian), [(b"", np.empty(0))] * 2

    def at(self, which: int, x: np.ndarray) -> np.ndarray:
        """The residuals (0) or the Jacobian (1)."""
        if self.known[which][0] != x.tobytes():
            self.known[which] = x.tobytes(), self.functions[which](x)
        return self.known[which][1]


class Block(pyceres.CostFunction):
    """Some of the rows."""

    def __init__(self, rows: Rows, index, count: int, columns: int):
        super().__init__()
        self.rows, self.index = rows, index
        self.set_num_residuals(count)
        self.set_parameter_block_sizes([columns])

    def Evaluate(self, parameters, residuals, jacobians):  # noqa: D102
        x = np.array(parameters[0])
        residuals[:] = self.rows.at(0, x)[self.index]
        if jacobians is not None:
            jacobians[0][:] = self.rows.at(1, x)[self.index].ravel()
        return True


def solved(residual, jacobian, start: np.ndarray, parts: list) -> np.ndarray:
    """Where Ceres ends with dense QR and its usual tolerances, the rows in parts."""
    x = start.copy()
    problem, options, summary = pyceres.Problem(), pyceres.SolverOptions(), pyceres.SolverSummary()
    rows, every = Rows(residual, jacobian), np.arange(len(residual(x)))
    # Ceres does not keep them.
    blocks = [Block(rows, part, len(every[part]), len(x)) for part in parts]
    for block in blocks:
        problem.add_residual_block(block, None, [x])
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_QR
    options.num_threads = 1
    pyceres.solve(options, problem, summary)
    return x


def alone(problem: Problem, start: np.ndarray) -> np.ndarray:
    """Where our own loop ends on the same least squares."""
    return levenberg_marquardt(problem.with_data(problem.data), start, 100, None).x


def main(m: int, repeats: int) -> None:
    """Prints [name, our whole calibration, our loop alone, Ceres by samples and by one block] of each arm."""
    out = []
    for name, chain, sets, data in cases(m):
        fit = fit_geometry(chain, data, sets)
        residual, jacobian = analytic(fit.problem)
        start, fresh = np.zeros(len(fit.x)), replace(fit.problem)
        ways = [
            partial(fit_geometry, chain, data, sets),
            partial(alone, fresh, start),
            # A reading's rows lie m apart; the priors' come last.
            partial(
                solved, residual, jacobian, start, [*(np.s_[i : 6 * m : m] for i in range(m)), np.s_[6 * m :]]
            ),
            partial(solved, residual, jacobian, start, [np.s_[:]]),
        ]
        ends = [float(np.sum(residual(x) ** 2)) for x in (fit.x, *(way() for way in ways[1:]))]
        assert max(ends[:2]) <= min(ends[2:]) * (1 + 1e-6), ends
        out.append([name, *clocked(ways, repeats)])
    print(json.dumps(out))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
