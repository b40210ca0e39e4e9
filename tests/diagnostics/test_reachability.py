"""Rows that a robot cannot reach."""

import numpy as np

from dhcal_pin.diagnostics import find_unreachable_rows
from dhcal_pin.io import MeasurementFile
from dhcal_pin.measurements import Noise, Position


def test_good_rows_are_not_reported(sim_6dof, sim_6dof_actual):
    """An arm with errors as large as the paper's, with noise, in any pose."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        q = rng.uniform(-np.pi, np.pi, (40, 6))
        data = Position.simulate(sim_6dof_actual, q, Noise(1e-4), rng)
        commanded = sim_6dof.poses(q)[:, :3, 3]
        readings = MeasurementFile("t", data, data, data.take(np.array([], int)), commanded, None)
        assert find_unreachable_rows(sim_6dof, readings) == []


def test_an_arm_that_is_exact_at_its_reference_pose_is_not_reported(sim_6dof, sim_6dof_actual):
    """Thirty measurements of one pose are exact to 10 µm, the others are 40 mm off; all rows are reachable.

    A controller that stops 2 mm early once is not reported either.
    """
    rng = np.random.default_rng(0)
    q = np.concatenate([np.tile(0.3, (30, 6)), rng.uniform(-2, 2, (20, 6))])
    measured = Position.simulate(sim_6dof_actual, q, Noise(1e-5), rng).positions()
    measured += (sim_6dof.poses(q[:1]) - sim_6dof_actual.poses(q[:1]))[0, :3, 3]
    commanded = sim_6dof.poses(q)[:, :3, 3]
    commanded[40] += [0.002, 0.0, 0.0]
    data = Position(q, measured)

    def reported(goals):
        return [
            f.row
            for f in find_unreachable_rows(sim_6dof, MeasurementFile("t", data, data, data, goals, None))
        ]

    assert np.linalg.norm(measured - sim_6dof.poses(q)[:, :3, 3], axis=1).max() > 0.02
    assert reported(None) == reported(commanded) == []
    commanded[40] += [0.0, 0.02, 0.0]
    assert reported(commanded) == [41]
