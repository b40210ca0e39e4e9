"""Bins of joint values against plain counting, lattices against the rank of the harmonics."""

from dataclasses import replace

import numpy as np
import pytest
from robots import DATA, MAPS, SCARA, missing, nominal_arm, write

from dhcal_pin.io import read_dh, read_measurements, read_robot
from dhcal_pin.robot import Chain, JointCoverage, joint_coverage, lattice_warnings
from dhcal_pin.robot.coverage import BIN_CENTRES, BIN_WIDTH_RAD, N_BINS, bin_indices

# Order of the correction curves of the calibration.
ORDER = 32


def one_joint(values: np.ndarray) -> JointCoverage:
    everywhere = np.full(N_BINS, True)
    return JointCoverage("joint", values, np.bincount(bin_indices(values), minlength=N_BINS), everywhere)


def numerical_rank(values: np.ndarray) -> int:
    """Count the singular values of all harmonics that are not negligible."""
    phases = np.outer(values, np.arange(1, ORDER + 1))
    design = np.concatenate([np.ones((len(values), 1)), np.sin(phases), np.cos(phases)], 1)
    std = np.linalg.svd(design, compute_uv=False)
    return int(np.sum(std > 0.03 * std[0]))


def test_counts_equal_those_of_single_values():
    chain, rng = nominal_arm("ur10"), np.random.default_rng(0)
    q = rng.uniform(-7, 7, (200, 6))
    for i, coverage in enumerate(joint_coverage(chain, q)):
        assert coverage.joint == chain.joint_names[i]
        for centre, count in zip(np.arange(-180, 180, 5), coverage.counts, strict=True):
            distance = (np.degrees(q[:, i]) - centre + 180) % 360 - 180
            assert count == np.sum(np.abs(distance) < 2.5)
        assert coverage.counts.sum() == 200
        assert coverage.share == np.mean(coverage.counts > 0)


def test_scatter_around_a_multiple_of_five_degrees_is_in_one_bin():
    values = np.deg2rad(35) + np.random.default_rng(0).normal(0, 1e-3, 50)
    assert np.all(bin_indices(values) == bin_indices(np.deg2rad(np.array([35 - 360]))))


def test_any_finite_value_has_a_bin():
    """The product with a whole number of turns is exact for these values."""
    turns = np.array([0.0, 2.0**20, -(2.0**20), 1e17, -1e300])
    bins = bin_indices(BIN_WIDTH_RAD * N_BINS * turns)
    assert np.all((bins >= 0) & (bins < N_BINS))
    assert len(set(bins[:3].tolist())) == 1
    # Divided by the width of a bin, these are infinite.
    bins = bin_indices(np.array([1.7e308, -1.7e308]))
    assert np.all((bins >= 0) & (bins < N_BINS))


def test_coverage_of_values_near_the_largest_number(recwarn):
    q = np.zeros((3, 6))
    q[1, 0], q[2, 0] = 1.7e308, -1.7e308
    assert [int(one.counts.sum()) for one in joint_coverage(nominal_arm("ur10"), q)] == [3] * 6
    assert not recwarn.list


def test_repeated_configurations_count_once():
    q = np.repeat(np.random.default_rng(0).uniform(-2, 2, (20, 6)), 3, axis=0)
    assert all(coverage.counts.sum() == 20 for coverage in joint_coverage(nominal_arm("ur10"), q))


def test_limits_and_gaps():
    chain = nominal_arm("ur10")
    chain = replace(
        chain,
        lower=np.deg2rad([-170, -360, 90, -20, -180, -1]),
        upper=np.deg2rad([170, 0, 175, 180, 180, 180]),
    )
    q = np.deg2rad([[-170, 0, 100, -20, 0, 0], [170, 0, 110, -15, 90, 0], [100, 5, 120, -10, 10, 0]])
    found = joint_coverage(chain, q)
    assert [one.n_in_range for one in found] == [69, 72, 18, 41, 72, 37]
    assert [one.n_visited for one in found] == [3, 2, 3, 3, 3, 1]
    assert found[2].share == pytest.approx(3 / 18)
    assert np.degrees(found[2].gaps) == pytest.approx(
        np.array([[87.5, 97.5], [102.5, 107.5], [112.5, 117.5], [122.5, 177.5]])
    )
    assert np.degrees(found[4].gaps) == pytest.approx(
        np.array([[-180, -2.5], [2.5, 7.5], [12.5, 87.5], [92.5, 180]])
    )
    low, high = np.array(found[0].gaps).T
    assert np.sum(high - low) == pytest.approx((69 - 3) * BIN_WIDTH_RAD)


def test_prismatic_joints_have_no_bins(tmp_path):
    chain = Chain.from_dh(read_dh(write(tmp_path, "scara.dh.toml", SCARA)))
    q = np.array([[0.1, -0.1], [0.2, -0.1], [0.2, 0.0]])
    (found,) = joint_coverage(chain, q)
    assert found.joint == "shoulder"
    assert list(found.counts[bin_indices(q[:, 0])]) == [1, 2, 2]


@pytest.mark.parametrize("step", [10.0, 15.0, 22.5, 30.0, 45.0, 90.0])
@pytest.mark.parametrize("scatter", [0.0, 2e-4])
def test_harmonics_are_aliases_on_a_lattice(step, scatter):
    """The rank of all harmonics is the number of values, far less than that of spread values."""
    rng = np.random.default_rng(1)
    grid = np.deg2rad(np.arange(-120, 121, step))
    values = np.repeat(grid, 12) + rng.normal(0, scatter, 12 * len(grid))
    coverage = one_joint(values)
    assert coverage.is_lattice(ORDER)
    assert coverage.n_different_values(ORDER) == len(grid)
    assert numerical_rank(values) == len(grid)
    assert numerical_rank(rng.uniform(values.min(), values.max(), len(values))) > 1.5 * len(grid)


@pytest.mark.parametrize("degrees", [5.0, 60.0, 240.0, 360.0])
@pytest.mark.parametrize("count", [10, 50, 200, 1000])
def test_spread_values_are_no_lattice(degrees, count):
    for seed in range(20):
        values = np.deg2rad(np.random.default_rng(seed).uniform(0, degrees, count))
        assert not one_joint(values).is_lattice(ORDER)


def test_fine_lattice_determines_the_curve():
    """Steps of 5 degrees are finer than half the shortest wave, 5.6 degrees."""
    values = np.repeat(BIN_CENTRES, 3)
    assert numerical_rank(values) == 2 * ORDER + 1
    assert not one_joint(values).is_lattice(ORDER)
    assert one_joint(values[::6]).is_lattice(ORDER) is False
    assert one_joint(np.repeat(BIN_CENTRES[::2], 3)).is_lattice(ORDER)


def test_joint_at_rest_is_no_lattice():
    assert not one_joint(np.full(100, 0.3)).is_lattice(ORDER)
    assert not one_joint(np.empty(0)).is_lattice(ORDER)


def test_grid_of_joint_values_gives_one_sentence_for_each_joint():
    chain = nominal_arm("ur10")
    axes = np.deg2rad([-60, -20, 20, 60])
    q = np.stack(np.meshgrid(*[axes] * 4), -1).reshape(-1, 4)
    q = np.concatenate([q, np.random.default_rng(0).uniform(-2, 2, (len(q), 2))], 1)
    texts = lattice_warnings(joint_coverage(chain, q), ORDER)
    assert [text.split()[3] for text in texts] == list(chain.joint_names[:4])
    assert all("form a lattice, 4 different ones in 256 configurations" in text for text in texts)


def test_real_series():
    """The second axis of a positioner was measured in steps of 22.5°; the joints of a UR10 at all values."""
    if not DATA.exists():
        missing(f"measurements at {DATA}")
    positioner = read_robot(DATA / "positioner_2axis/positioner.dh.toml")
    data = read_measurements(DATA / "positioner_2axis/measurements.csv", positioner)
    texts = lattice_warnings(joint_coverage(positioner, data.q), ORDER)
    assert [text.split()[3] for text in texts] == ["joint_2"]
    chain = nominal_arm("ur10")
    folder = DATA / "ipa_ur10/Series_B/measurements_joint_configurations.csv"
    data = read_measurements(folder, chain, MAPS / "ipa_ur10.toml")
    assert not lattice_warnings(joint_coverage(chain, data.q), ORDER)
