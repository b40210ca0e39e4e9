"""Changes that are added to real measurements of a robot are found, and nothing is found without them.

No model has all errors of a real robot. Its joints move in other regions when the series begins than at
its end, so that errors of the joints imitate a change of their zeros, and the other way round.
"""

import functools

import numpy as np
import pytest
from public_series import SERIES
from robots import DATA, missing
from slow_cases import some_slow

from dhcal_pin import Result, calibrate
from dhcal_pin.measurements import Pose, Position
from dhcal_pin.robot import Chain

COUNT, JUDGED = 200, 300


@functools.cache
def series() -> tuple[Chain, Pose]:
    """Return the robot and the poses of series B."""
    found = SERIES[0].read(DATA)
    if found is None:
        missing("series B of ipa_ur10")
    assert isinstance(found[1], Pose)
    return found[0], found[1]


def with_changed_zero(seed: int, size: float) -> tuple[int, int, Result, float]:
    """Calibrate with a zero [rad] added from a sample on; return joint, sample, result and true error [m]."""
    chain, data = series()
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.permutation(len(data.q))[: COUNT + JUDGED])
    is_judged = np.isin(np.arange(len(rows)), rng.permutation(len(rows))[:JUDGED])
    # The reflector is on the last axis: positions do not show the last zero, nor the first one in the base.
    joint, begin = int(rng.integers(1, chain.n_joints - 1)), int(COUNT * rng.uniform(0.3, 0.7))
    fitted, judged = (
        Pose(data.q[chosen], data.poses[chosen]) for chosen in (rows[~is_judged], rows[is_judged])
    )
    fitted, judged = fitted.replace(q=fitted.q.copy()), judged.replace(q=judged.q.copy())
    fitted.q[begin:, joint] += size
    judged.q[:, joint] += size
    item = fitted if seed % 2 else Position(fitted.q, fitted.positions())
    fit = calibrate(chain, item)
    frames = calibrate(fit.chain, judged, "base,tool", session="off")
    return joint, begin, fit, frames.comparisons[-1].after["position_rms_m"]


@pytest.mark.parametrize("seed", some_slow(range(16), {1}))
def test_nothing_is_found_in_a_real_series(seed):
    *_, fit, error = with_changed_zero(seed, 0.0)
    assert fit.verdict.status == "ok"
    assert fit.session is not None
    assert not fit.session.found
    assert error < 0.25e-3


@pytest.mark.parametrize(
    ("seed", "degrees"), some_slow([(seed, size) for seed in range(12) for size in (0.1, 0.2, 0.4)], {7})
)
def test_a_zero_that_changes_in_a_real_series_is_found_with_its_size(seed, degrees):
    """A wrong size is left in the robot: 0.05° of one of the first joints are errors of 0.5 to 1 mm."""
    joint, begin, fit, error = with_changed_zero(seed, np.deg2rad(degrees))
    assert fit.session is not None
    (event,) = fit.session.events
    assert (event.kind, event.of) == ("joint", fit.chain.joint_names[joint])
    assert abs(event.line - (begin + 1)) <= 3
    assert np.rad2deg(event.size) == pytest.approx(degrees, abs=0.02, rel=0.05)
    assert error < 0.25e-3
