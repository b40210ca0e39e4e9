"""An arm that keeps the orientation of its tool: the measured point on the tool is hardly determined."""

import numpy as np
import pytest
from robots import nominal_arm, with_small_errors
from slow_cases import some_slow

from dhcal_pin import calibrate, se3
from dhcal_pin.measurements import Position

NOISE = 5e-5


def with_tool_down(rng, m):
    """Return configurations (m, 6) of a UR10 whose tool points down and turns by less than 1°."""
    pan, lift, elbow = (rng.uniform(a, b, m) for a, b in ((-1.2, 1.2), (-1.8, -0.8), (0.6, 1.6)))
    down = np.full(m, -np.pi / 2)
    q = np.stack([pan, lift, elbow, down - lift - elbow, down, pan], 1)
    return q + rng.uniform(-0.003, 0.003, q.shape)


@pytest.mark.parametrize("seed", some_slow(range(6), {0, 1}))
def test_the_orientation_is_named_and_turned_poses_help(seed):
    rng = np.random.default_rng(seed)
    nominal = nominal_arm("ur10")
    true = with_small_errors(nominal, rng)
    tool = se3.exp6(np.array([0.06, 0.03, 0.08, 0, 0, 0]))

    def measured(q):
        return Position(q, (true.poses(q) @ tool)[:, :3, 3] + NOISE * rng.standard_normal((len(q), 3)))

    q = with_tool_down(rng, 80)
    fit = calibrate(nominal, measured(q))
    assert fit.is_converged()
    assert fit.verdict.status == "caution"
    assert fit.verdict.reasons[0].startswith("The tool kept its orientation")
    assert np.linalg.norm(fit.chain.tool[:3, 3]) < 1.5
    turned = np.concatenate([q, rng.uniform(-2, 2, (40, 6))])
    helped = calibrate(nominal, measured(turned))
    assert helped.verdict.status == "ok"
    np.testing.assert_allclose(helped.chain.tool[:3, 3], tool[:3, 3], atol=3e-3)
