"""Hold-out and folds: configurations stay together, and different configurations are divided as if alone."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import paper

from dhcal_pin.calibration import (
    Fold,
    blocked_folds,
    calibrate,
    k_fold,
    leave_one_group_out,
    split,
)
from dhcal_pin.calibration.partition import (
    configuration_groups,
    contact_groups,
)
from dhcal_pin.exceptions import DhcalError, InvalidArgumentError, NotObservableError
from dhcal_pin.measurements import Measurement, PointContact, PointDistance, Position, RelativePose
from dhcal_pin.measurements.configurations import (
    CONFIGURATION_TOL,
    group_by_configuration,
    merge_guided_visits,
)
from dhcal_pin.robot import Chain

# Calibrations of arms with large errors, of which nothing asks for mistakes.
pytestmark = pytest.mark.usefixtures("unsuspected")

N_JOINTS = 6


def test_lengths_without_a_configuration_are_in_no_region():
    with pytest.raises(NotObservableError, match="same joint values"):
        blocked_folds(PointDistance(6, [("p1", "p2"), ("p2", "p3")], [0.1, 0.2]))


def positions(q: np.ndarray) -> Position:
    return Position(q, np.zeros((len(q), 3)))


def repeated(rng: np.random.Generator, n_configurations: int, sizes: list[int]) -> Sequence[Measurement]:
    """Draw rows of a set of configurations, equal only within the tolerance."""
    q = rng.uniform(-3, 3, (n_configurations, N_JOINTS))
    jitter = CONFIGURATION_TOL / 2
    return [
        positions(q[rng.integers(0, n_configurations, m)] + rng.uniform(0, jitter, (m, N_JOINTS)))
        for m in sizes
    ]


def are_equal(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compare each row of a with each row of b."""
    return np.abs(a[:, None] - b[None]).max(2) <= CONFIGURATION_TOL


def parts_of(data: Sequence[Measurement], fold: Fold) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint values of the fitted and of the held-out samples."""
    q, mask = np.concatenate([item.q for item in data]), np.concatenate(fold)
    return q[~mask], q[mask]


def drawn_split(data: Sequence[Measurement], fraction: float, seed: int):
    """Split each measurement by rows in the order of their joint values, all of which differ."""
    rng = np.random.default_rng(seed)
    for item in data:
        order = np.array(sorted(range(len(item.rows)), key=lambda i: tuple(item.q[i])))
        order = order[rng.permutation(len(order))]
        count = round(fraction * len(order))
        yield item.rows[np.sort(order[count:])], item.rows[np.sort(order[:count])]


repeats = given(
    seed=st.integers(0, 2**32 - 1),
    n_configurations=st.integers(2, 40),
    sizes=st.lists(st.integers(1, 40), min_size=1, max_size=3),
    fraction=st.floats(0, 0.95),
)


@settings(max_examples=100, deadline=None)
@repeats
def test_split_keeps_configurations_together(seed, n_configurations, sizes, fraction):
    data = repeated(np.random.default_rng(seed), n_configurations, sizes)
    fitted, held_out = split(data, fraction, seed)
    inside, outside = (
        np.concatenate([item.q for item in part] or [np.empty((0, N_JOINTS))]) for part in (fitted, held_out)
    )
    assert not are_equal(inside, outside).any()
    together = np.concatenate([inside, outside])
    every = np.concatenate([item.q for item in data])
    np.testing.assert_array_equal(np.sort(together, 0), np.sort(every, 0))
    # The first measurement is free of earlier decisions: half of its largest configuration is the most that
    # its held-out part can differ by from the fraction.
    largest = np.bincount(group_by_configuration(data[0].q)).max()
    n_held = len(data[0].rows) - len(fitted[0].rows)
    assert abs(n_held - round(fraction * len(data[0].rows))) <= largest / 2


@settings(max_examples=100, deadline=None)
@repeats
def test_folds_keep_configurations_together(seed, n_configurations, sizes, fraction):
    data = repeated(np.random.default_rng(seed), n_configurations, sizes)
    total = sum(sizes)
    count = len(np.unique(configuration_groups(data)))
    if count < 2:
        with pytest.raises(DhcalError, match="the number of different configurations"):
            k_fold(data, 2, seed)
        return
    partitions = [k_fold(data, 1 + int(fraction * (count - 1)) if fraction > 0.5 and count > 3 else 2, seed)]
    labels = np.random.default_rng(seed).integers(0, 3, total)
    with suppress(InvalidArgumentError):  # all labels are equal, or have configurations in common
        partitions.append(leave_one_group_out(data, labels))
    for folds in partitions:
        np.testing.assert_array_equal(np.sum([np.concatenate(fold) for fold in folds], 0), np.ones(total))
    for fold in (*(fold for folds in partitions for fold in folds), *blocked_folds(data)):
        inside, outside = parts_of(data, fold)
        assert len(inside)
        assert len(outside)
        assert not are_equal(inside, outside).any()


@settings(max_examples=100, deadline=None)
@repeats
def test_the_order_of_samples_has_no_influence(seed, n_configurations, sizes, fraction):
    rng = np.random.default_rng(seed)
    data = repeated(rng, n_configurations, sizes)
    order = [rng.permutation(len(item.rows)) for item in data]
    permuted = [item.take(index) for item, index in zip(data, order, strict=True)]
    for parts in zip(split(data, fraction, seed), split(permuted, fraction, seed), strict=True):
        expected, found = ([sorted(item.rows) for item in part if len(item.rows)] for part in parts)
        assert found == expected
    if len(np.unique(configuration_groups(data))) > 1:
        for fold, other in zip(k_fold(data, 2, seed), k_fold(permuted, 2, seed), strict=True):
            for mask, found, index in zip(fold, other, order, strict=True):
                np.testing.assert_array_equal(found, mask[index])


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.3, 0.5, 0.9])
@pytest.mark.parametrize("seed", range(5))
def test_different_configurations_are_split_as_rows(seed, fraction):
    rng = np.random.default_rng(seed)
    data = [positions(rng.uniform(-3, 3, (m, N_JOINTS))) for m in (17, 40, 1)]
    fitted, held_out = split(data, fraction, seed)
    expected = list(drawn_split(data, fraction, seed))
    for item, (rows, _) in zip(fitted, expected, strict=True):
        np.testing.assert_array_equal(item.rows, rows)
    wanted = [rows for _, rows in expected if len(rows)]
    for item, rows in zip(held_out, wanted, strict=True):
        np.testing.assert_array_equal(item.rows, rows)


@pytest.mark.parametrize("seed", range(5))
def test_different_configurations_are_folded_as_rows(seed):
    rng = np.random.default_rng(seed)
    data = [positions(rng.uniform(-3, 3, (m, N_JOINTS))) for m in (17, 40)]
    order = sorted(range(57), key=lambda i: tuple(np.concatenate([item.q for item in data])[i]))
    labels = np.empty(57, int)
    labels[order] = np.random.default_rng(seed).permutation(57) % 10
    for number, fold in enumerate(k_fold(data, 10, seed)):
        np.testing.assert_array_equal(np.concatenate(fold), labels == number)


def test_rows_of_one_configuration_form_one_group_in_the_order_of_appearance():
    q = np.array([[1.0, 2.0], [0.0, 0.0], [1.0, 2.0 + 9e-7], [1.0, 2.0 + 1.8e-6], [1.0, 2.1], [0.0, 0.0]])
    np.testing.assert_array_equal(group_by_configuration(q), [0, 1, 0, 0, 2, 1])
    assert group_by_configuration(np.empty((0, 6))).shape == (0,)


@pytest.mark.parametrize("seed", range(20))
def test_groups_match_a_comparison_of_all_pairs(seed):
    rng = np.random.default_rng(seed)
    # A fine grid: many chains of rows that differ by less than the tolerance.
    q = rng.integers(0, 40, (60, 2)) * 0.7 * CONFIGURATION_TOL
    linked = are_equal(q, q)
    for _ in range(60):
        linked = linked @ linked
    groups = group_by_configuration(q)
    np.testing.assert_array_equal(groups[:, None] == groups[None], linked)


@pytest.mark.parametrize("jitter", [1e-5, 1e-4, 1e-3, 1e-2])
def test_visits_of_taught_poses_are_one_configuration(jitter):
    rng = np.random.default_rng(0)
    poses = rng.uniform(-3, 3, (8, N_JOINTS))
    number = rng.permutation(np.repeat(np.arange(8), 20))
    q = poses[number] + jitter * rng.standard_normal((160, N_JOINTS))
    groups = merge_guided_visits(q, group_by_configuration(q))
    np.testing.assert_array_equal(groups[:, None] == groups[None], number[:, None] == number[None])


@pytest.mark.parametrize("step", [1e-4, 1e-3, 1e-2])
def test_samples_of_a_path_and_random_ones_are_different_configurations(step):
    rng = np.random.default_rng(0)
    path = np.cumsum(step * rng.uniform(0.3, 1, (400, N_JOINTS)), 0)
    for q in (path, rng.uniform(-2, 2, (400, N_JOINTS)), np.linspace(0, 2, 400)[:, None]):
        np.testing.assert_array_equal(group_by_configuration(q), np.arange(400))
        np.testing.assert_array_equal(merge_guided_visits(q, np.arange(400)), np.arange(400))


@pytest.mark.parametrize(
    ("n_poses", "n_visits", "distance", "is_merged"),
    [(8, 6, 1.0, True), (20, 2, 1.0, False), (8, 6, 0.05, False), (8, 1000, 1.0, False)],
)
def test_only_far_groups_of_several_visits_are_merged(n_poses, n_visits, distance, is_merged):
    rng = np.random.default_rng(0)
    poses = distance * np.array([[i % 5, i // 5, 0.0] for i in range(n_poses)])
    q = np.repeat(poses, n_visits, axis=0) + 5e-3 * rng.standard_normal((n_poses * n_visits, 3))
    labels = np.arange(len(q))
    expected = np.repeat(np.arange(n_poses), n_visits) if is_merged else labels
    np.testing.assert_array_equal(merge_guided_visits(q, labels), expected)


def test_a_sample_of_two_configurations_is_compared_by_both():
    a, b, c = np.eye(3)
    poses = np.tile(np.eye(4), (4, 1, 1))
    relative = RelativePose(np.array([a, a, b, a]), np.array([b, c, a, b]), poses)
    single = positions(np.array([a, b]))
    np.testing.assert_array_equal(configuration_groups([relative, single]), [4, 3, 1, 4, 2, 0])


def test_known_distances_between_points_have_no_configuration():
    assert configuration_groups([]).shape == (0,)
    known = PointDistance(3, [("a", "b"), ("b", "c")], [0.1, 0.1])
    np.testing.assert_array_equal(configuration_groups([known, positions(np.eye(3))]), [3, 4, 2, 1, 0])


def test_split_is_a_partition_by_seed():
    data = positions(np.random.default_rng(0).uniform(-3, 3, (10, N_JOINTS)))
    fitted, held_out = split([data], 0.3, seed=4)
    assert sorted([*fitted[0].rows, *held_out[0].rows]) == list(range(1, 11))
    assert len(held_out[0].q) == 3
    np.testing.assert_array_equal(split([data], 0.3, seed=4)[1][0].rows, held_out[0].rows)
    with pytest.raises(DhcalError, match=r"holdout=1\.5: expected a fraction in \[0, 1\)"):
        split([data], 1.5)


def test_folds_hold_out_each_sample_once():
    data = [positions(np.random.default_rng(0).uniform(-3, 3, (40, N_JOINTS)))]
    for folds in (k_fold(data, 5), leave_one_group_out(data, np.arange(40) // 8)):
        assert len(folds) == 5
        np.testing.assert_array_equal(np.sum([fold[0] for fold in folds], 0), np.ones(40))
    with pytest.raises(DhcalError, match="choose from 2 to 40"):
        k_fold(data, 41)
    with pytest.raises(DhcalError, match=r"expected \(40,\)"):
        leave_one_group_out(data, np.arange(3))
    with pytest.raises(DhcalError, match=r"^one group: holding it out leaves nothing"):
        leave_one_group_out(data, np.zeros(40))


def test_blocked_folds_hold_out_the_ends_of_joint_space():
    """One joint moves in steps and another with it: one direction, its lowest and highest quarter."""
    q = np.zeros((8, 6))
    q[:, 1] = np.arange(8)
    q[:, 4] = -2 * np.arange(8)
    low, high = sorted(fold[0].nonzero()[0].tolist() for fold in blocked_folds([positions(q)]))
    assert (low, high) == ([0, 1], [6, 7])
    # Several rows of one configuration count once.
    more = positions(np.concatenate([q, q[:1], q[:1], q[:1]]))
    low, high = sorted(fold[0].nonzero()[0].tolist() for fold in blocked_folds([more]))
    assert (low, high) == ([0, 1, 8, 9, 10], [6, 7])
    with pytest.raises(DhcalError, match="different joint values"):
        blocked_folds([positions(np.ones((8, 6)))])
    with pytest.raises(DhcalError, match="different joint values"):
        blocked_folds([positions(np.ones((8, 6)))], groups=np.arange(8))


def test_contacts_with_one_thing_are_held_out_together():
    """Points a, b are joined by a distance, as c, d are; e stands alone, and i is given and not touched."""
    names = np.array(list("abcde"))
    label = np.repeat(np.arange(5), 4)
    arm = Chain.from_dh(paper("sim_6dof"))
    q = 0.4 * label[:, None] + np.random.default_rng(0).uniform(-0.1, 0.1, (20, 6))
    contacts = PointContact(q, names[label].tolist())
    known = PointDistance(6, [("c", "d"), ("a", "b"), ("a", "i")], [0.1, 0.1, 0.1])
    place = {f"point_i.{axis}": 0.4 for axis in "xyz"}
    problem = calibrate(arm, [contacts, known], "dh", known=place, max_iterations=1).problem
    groups = contact_groups(problem, np.zeros(len(problem.weights)))
    folds = blocked_folds(problem.data, groups=groups)
    for of_contacts, of_distances in folds:
        by_name = {name: set(of_contacts[label == i].tolist()) for i, name in enumerate("abcde")}
        assert all(len(masks) == 1 for masks in by_name.values())
        assert by_name["a"] == by_name["b"] == set(of_distances[1:].tolist())
        assert by_name["c"] == by_name["d"] == set(of_distances[:1].tolist())
    held_out = {tuple(fold[0].tolist()) for fold in folds}
    assert len(held_out) == len(folds) >= 2
    # A single group is no region of its own: its samples are held out one by one.
    one = PointContact(q, ["a"] * 20)
    alone = [fold[0] for fold in blocked_folds([one], groups=np.zeros(20, int))]
    np.testing.assert_array_equal(alone, [fold[0] for fold in blocked_folds([one])])


def test_cross_validation_of_a_result_holds_out_whole_configurations(sim_6dof, sim_6dof_actual):
    """Repeating each row does not make its hold-out errors look like fitted ones."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-3, 3, (14, 6))
    point = sim_6dof_actual.poses(q)[:, :3, 3] + 1e-3 * rng.standard_normal((14, 3))
    once = Position(q, point, 1e-3)
    thrice = Position(np.repeat(q, 3, 0), np.repeat(point, 3, 0), 1e-3)
    plain, repeated_fit = (calibrate(sim_6dof, data, "dh") for data in (once, thrice))
    held_out, fitted = repeated_fit.comparisons
    assert held_out.n_samples == 42
    assert held_out.after["position_rms_m"] > 1.5 * fitted.after["position_rms_m"]
    assert held_out.after["position_rms_m"] == pytest.approx(
        plain.comparisons[0].after["position_rms_m"], rel=0.2
    )
    one = calibrate(sim_6dof, once.take(np.zeros(3, int)), "dh")
    assert [comparison.title for comparison in one.comparisons] == ["fitted"]
