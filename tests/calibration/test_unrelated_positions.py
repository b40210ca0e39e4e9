"""Positions that have nothing to do with the joint values are never `ok`, wherever the fit puts the tool."""

import numpy as np
import pytest
from camera_setups import ARMS
from slow_cases import some_slow

from dhcal_pin import calibrate
from dhcal_pin.measurements import Position
from dhcal_pin.plausibility.displacement import workspace_radius


@pytest.mark.parametrize("seed", some_slow(range(16), {2}))
def test_positions_of_something_else_are_not_ok_if_the_tool_keeps_its_orientation(seed):
    """The best tool is then many metres away. No error is small beside the workspace of that tool."""
    rng = np.random.default_rng(seed)
    chain = ARMS["ur10"]()
    q = rng.uniform([-1, -1.5, 0.5, 0, -1.6, 0], [1, -0.5, 1.8, 0, -1.5, 0], (120, 6))
    # The flange always points down, up to a part of a degree.
    q[:, 3], q[:, 4] = -np.pi / 2 - q[:, 1] - q[:, 2], -np.pi / 2
    q += 10 ** rng.uniform(-4.5, -2.5) * rng.standard_normal(q.shape)
    q[:, 5] = rng.uniform(-np.pi, np.pi, len(q))
    positions = rng.uniform(0.1, 0.4) * rng.standard_normal((len(q), 3))
    result = calibrate(chain, Position(q, positions))
    assert workspace_radius(result.chain) > 1.2 * workspace_radius(chain)
    assert result.verdict.status == "refused" or result.verdict.keeps_nominal
