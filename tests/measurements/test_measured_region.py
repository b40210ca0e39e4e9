"""Measured regions against known distributions of configurations and a brute-force distance."""

import numpy as np
import pytest
from robots import measured_arm
from scipy.spatial.distance import cdist

from dhcal_pin.measurements import MeasuredRegion
from dhcal_pin.measurements.measured_region import draw_joint_space

REVOLUTE = np.zeros(6, bool)


def uniform(rng, m):
    return rng.uniform(-1, 1, (m, 6))


def clusters(rng, m):
    """Dense clusters with far corners between them, as along the edges of a few cubes."""
    centres = np.random.default_rng(5).uniform(-1.5, 1.5, (30, 6))
    return centres[rng.integers(0, 30, m)] + 0.02 * rng.normal(size=(m, 6))


def pairs(rng, m):
    """Every configuration is measured a second time, nearly the same."""
    first = rng.uniform(-1, 1, (m // 2, 6))
    return np.concatenate([first, first + 1e-4 * rng.normal(size=first.shape)])


@pytest.mark.parametrize(("draw", "m"), [(uniform, 40), (uniform, 1000), (clusters, 300)])
def test_new_configurations_of_the_same_distribution_are_inside(draw, m):
    shares = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        region = MeasuredRegion.from_configurations(draw(rng, m), REVOLUTE)
        shares.append(region.contains(draw(rng, 400)).mean())
    assert 0.9 < np.mean(shares) < 0.99


def test_nearly_repeated_configurations_do_not_shrink_the_region():
    rng = np.random.default_rng(0)
    region = MeasuredRegion.from_configurations(pairs(rng, 400), REVOLUTE)
    assert region.contains(uniform(rng, 400)).mean() > 0.75


def test_region_is_scaled_by_the_spread_of_each_joint():
    rng = np.random.default_rng(0)
    q = uniform(rng, 100) * np.array([1, 1, 1, 1, 1, 0.01])
    region = MeasuredRegion.from_configurations(q, REVOLUTE)
    step = np.zeros(6)
    step[5] = 0.5
    assert region.contains(q).mean() > 0.9
    assert not region.contains(q + step).any()
    assert region.excess(q + step).max(0) == pytest.approx([0, 0, 0, 0, 0, 0.5], abs=0.02)


def test_a_joint_that_stands_still_is_measured_in_milliradians():
    """Its values differ by 1 µrad only; a step of 2 mrad is then not 2,000 spreads away."""
    q = uniform(np.random.default_rng(0), 100)
    q[:, 5] = 1e-6 * np.random.default_rng(1).normal(size=100)
    region = MeasuredRegion.from_configurations(q, REVOLUTE)
    step = np.zeros(6)
    step[5] = 2e-3
    assert region.distances(region.configurations + step) == pytest.approx(2.0, rel=0.01)


def test_distances_are_euclidean_and_periodic_for_revolute_joints():
    rng = np.random.default_rng(0)
    is_prismatic = np.array([False, True, False, False, False, False])
    region = MeasuredRegion.from_configurations(uniform(rng, 50), is_prismatic)
    q = uniform(rng, 20)
    expected = cdist(q / region.spread, region.configurations / region.spread).min(1)
    np.testing.assert_allclose(region.distances(q), expected)
    turns = 2 * np.pi * np.array([1, 0, -2, 1, 0, 3])
    np.testing.assert_allclose(region.distances(q + turns), expected)
    np.testing.assert_allclose(region.excess(q + turns), region.excess(q), atol=1e-12)
    shifted = q + np.array([0, 1.5, 0, 0, 0, 0])
    np.testing.assert_array_equal(
        region.excess(shifted)[:, 1], np.maximum(shifted[:, 1] - region.upper[1], 0)
    )


def test_one_configuration_has_no_surroundings():
    q = np.ones((1, 6))
    region = MeasuredRegion.from_configurations(q, REVOLUTE)
    assert region.radius == 0
    assert region.contains(q).all()
    assert not region.contains(q + 0.1).any()


def test_covered_share_of_a_known_part_of_the_joint_space():
    """Poses over the whole range of all joints but one, which covers a quarter of its range."""
    chain = measured_arm("ur5")
    drawn = draw_joint_space(chain)
    rng = np.random.default_rng(1)
    everywhere = rng.uniform(-np.pi, np.pi, (500, 6))
    quarter = everywhere * np.array([1, 1, 0.25, 1, 1, 1])
    shares = [
        MeasuredRegion.from_configurations(q, chain.is_prismatic).contains(drawn).mean()
        for q in (everywhere, quarter)
    ]
    assert shares[0] == pytest.approx(0.95, abs=0.03)
    assert 0.25 < shares[1] < 0.6


def test_reach_is_the_distance_of_left_out_parts():
    """Two clusters, each left out once: the reach is the distance between them, not the one within them."""
    rng = np.random.default_rng(0)
    q = 0.05 * rng.normal(size=(200, 6))
    q[100:, 0] += 1.0
    is_second = np.arange(200) >= 100
    region = MeasuredRegion.from_configurations(q, REVOLUTE)
    assert region.reach == region.radius
    region = region.with_reach(q, np.stack([is_second, ~is_second]))
    between = 1.0 / region.spread[0]
    assert between < region.reach < between + 3 * region.radius
