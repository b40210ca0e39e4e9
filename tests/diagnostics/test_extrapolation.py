"""Samples outside a measured region, their errors and the sentences about them."""

from dataclasses import replace

import numpy as np
import pytest
from robots import measured_arm

from dhcal_pin.calibration import accuracy
from dhcal_pin.diagnostics import find_extrapolation
from dhcal_pin.measurements import Distance, MeasuredRegion, Noise, PointDistance, Position


@pytest.fixture(scope="module")
def chain():
    return measured_arm("slide")


def test_errors_inside_and_outside_are_those_of_the_samples(chain):
    rng = np.random.default_rng(0)
    near, far = rng.uniform(-0.3, 0.3, (2, 40, 5))
    far[:, 2] += 0.9
    region = MeasuredRegion.from_configurations(rng.uniform(-0.3, 0.3, (400, 5)), chain.is_prismatic)
    data = [Position.simulate(chain, q, Noise(s, s), rng) for q, s in ((near, 1e-4), (far, 1e-3))]
    both = Position(np.concatenate([near, far]), np.concatenate([item.positions() for item in data]))
    found = find_extrapolation(region, chain, [both], {})
    is_outside = ~region.contains(both.q)
    assert is_outside[40:].all()
    for side, mask in ((found.inside, ~is_outside), (found.outside, is_outside)):
        expected = accuracy(chain, [both.take(mask)])
        assert side["position_rms_m"] == pytest.approx(expected["position_rms_m"], rel=1e-12)
    assert found.n_outside == is_outside.sum()
    assert found.max_excess["j3"] == pytest.approx(far[:, 2].max() - region.upper[2])
    assert found.max_distance == pytest.approx(region.distances(both.q).max() / region.radius)
    text = " ".join(found.sentences)
    assert f"{found.n_outside} of 80 samples" in text
    assert f"j3 by {1e3 * found.max_excess['j3']:.0f} mm" in text
    assert "mm inside" in text


def test_a_distance_is_outside_if_one_of_its_configurations_is(chain):
    rng = np.random.default_rng(0)
    region = MeasuredRegion.from_configurations(rng.uniform(-0.3, 0.3, (200, 5)), chain.is_prismatic)
    q = np.zeros((3, 5))
    q_to = np.zeros((3, 5)) + 0.1
    q_to[1, 0] = 2.0
    lengths = np.linalg.norm(np.diff([chain.poses(one)[:, :3, 3] for one in (q, q_to)], axis=0)[0], axis=1)
    found = find_extrapolation(region, chain, [Distance(q, q_to, lengths)], {})
    assert (found.n_samples, found.n_outside) == (3, 1)
    assert found.max_excess == {"j1": pytest.approx(2.0 - region.upper[0])}


def test_new_combinations_of_measured_joint_values_are_outside(chain):
    """Two joints that always moved together in the calibration now move against each other."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-0.3, 0.3, (200, 5))
    q[:, 1] = q[:, 0]
    region = MeasuredRegion.from_configurations(q, chain.is_prismatic)
    against = np.zeros((1, 5))
    against[0, :2] = region.upper[0] - 1e-3, region.lower[1] + 1e-3
    data = Position.simulate(chain, against, Noise(), rng)
    found = find_extrapolation(region, chain, [data], {})
    assert (found.n_outside, found.n_beyond_reach, dict(found.max_excess)) == (1, 1, {})
    assert "no accuracy was stated there" in " ".join(found.sentences)
    found = find_extrapolation(replace(region, reach=100 * region.radius), chain, [data], {})
    assert (found.n_outside, found.n_beyond_reach) == (1, 0)
    assert "combinations of joint values are new or rare" in found.sentences[-1]


def test_samples_without_joint_values_are_ignored(chain):
    region = MeasuredRegion.from_configurations(np.zeros((1, 5)), chain.is_prismatic)
    found = find_extrapolation(region, chain, [PointDistance(5, [("a", "b")], [0.05])], {})
    assert (found.n_samples, found.n_outside, found.sentences) == (0, 0, [])
