"""Least-squares estimation: error models, problems, solvers, robust weights, priors and uncertainty.

A `Problem` joins an error model, measurements and priors. `minimize` solves it by one of `METHODS` and
returns a `SolverResult`:

    >>> import numpy as np
    >>> from dhcal_pin.estimation import Problem, minimize, select_parameters
    >>> from dhcal_pin.io import read_dh, shipped_file
    >>> from dhcal_pin.measurements import Noise, Position
    >>> from dhcal_pin.robot import Chain
    >>> nominal = Chain.from_dh(read_dh(shipped_file("sim_6dof.dh.toml")))
    >>> actual = Chain.from_dh(read_dh(shipped_file("sim_6dof_actual.dh.toml")))
    >>> rng = np.random.default_rng(0)
    >>> data = Position.simulate(actual, rng.uniform(-3, 3, (30, 6)), Noise(position=1e-4), rng)
    >>> errors = select_parameters(nominal, "dh")
    >>> result = minimize(Problem(errors, (data,), weights=1 / errors.priors))
    >>> result.converged
    True
    >>> calibrated = errors.at(result.x)

`solve_batch` does the same for many small problems at once. `initialization` finds base and tool frames to
start from. Everything here follows from the triangular
system of one linearization (`TriangularSystem`).

The choice of noise scales and hold-out data belongs to `calibration`. Reports on parameters
that the data do not determine belong to `identifiability`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
