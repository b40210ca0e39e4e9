"""Partition of samples into a fitted and a held-out part: one split, or the folds of a cross-validation.

A hold-out error is only valid if the held-out samples are independent of the fitted ones. Two kinds of
samples depend on each other and therefore always go to the same part:

- Samples of one configuration, for example several targets, corners or repetitions measured while the robot
  stands still. They share the same joint values and the same error of the robot. This holds for most of the
  error also where the direction of approach, the temperature or the payload differs. The joint values of a
  taught pose that the robot visits again differ by the resolution of its encoders and the error of its
  controller.
- In `blocked_folds`, samples that touch the same unknown point, plane or sphere, or points joined by a known
  distance. A fitted sample would reveal where the held-out one must be.

Random parts measure the error between the measured configurations. A fold of `blocked_folds` holds out one
end of the measured joint space and so measures the error of an extrapolation. Configurations are numbered in
the order of their joint values before parts are drawn: the order of the samples has no influence.

Shapes: m samples of all measurements in a row, n joints.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._typing import Array
from ..estimation.folds import Fold
from ..estimation.problem import Problem, merge_instrument_parameters
from ..exceptions import InvalidArgumentError, NotObservableError
from ..measurements.arguments import as_measurements
from ..measurements.base import Measurement
from ..measurements.configurations import (
    CONFIGURATION_TOL,
    connect_nodes,
    group_by_configuration,
    label_samples,
    order_of_rows,
)

# Fraction of the samples that a blocked fold holds out at either end of a principal direction.
BLOCK_FRACTION = 0.25
# Number of parts that a recorded path is divided into, and numbers of samples of which paths are recognized.
_N_PATH_PARTS, _MIN_PATH_SAMPLES, _MAX_PATH_SAMPLES = 25, 100, 100_000
# Largest cosine of the angle between the directions to the two neighbours on a path, smallest share of such
# samples, and number of samples that are checked. The share is above 0.75 on paths, at most 0.3 of random
# samples of two joints, and 0.1 of more.
_MAX_COSINE, _MIN_BETWEEN, _N_CHECKED = -0.8, 0.6, 40
# Largest distance of neighbours on a path that share noise [rad or m].
_MAX_STEP = 0.15
# Principal directions whose spread is below this fraction of the largest one's are ignored.
_MIN_RELATIVE_SPREAD = 1e-6


def _merge_groups(labels: Array, others: Array) -> Array:
    """Merge groups (m,) that have samples of one group (m,) of the others in common; keep their order."""
    different, others = np.unique(others, return_inverse=True)
    if len(different) == len(others):
        return labels
    values, groups = np.unique(labels, return_inverse=True)
    connected = connect_nodes(len(values) + len(others), groups, len(values) + others)
    _, first, merged = np.unique(connected[: len(values)], return_index=True, return_inverse=True)
    return values[first[merged]][groups]


def is_same_file(item: Measurement, other: Measurement) -> bool:
    """Return whether two measurements are parts of one file."""
    return item.source == other.source and not np.intersect1d(item.rows, other.rows).size


def of_same_files(items: Sequence[Measurement], others: Sequence[Measurement]) -> list[Measurement]:
    """Return the measurements that are parts of the same files as others."""
    return [item for item in items if any(is_same_file(item, other) for other in others)]


def configuration_groups(data: Sequence[Measurement]) -> Array:
    """Label the samples of measurements, those of the same configuration by the same label."""
    # Many parts of a calibration need the labels of one measurement.
    return data[0].configuration_groups if len(data) == 1 else label_samples(data)


def different_configurations(data: Sequence[Measurement]) -> tuple[Array, Array]:
    """Return the different configurations in the order of their joint values, and a sample of each."""
    q, samples, start = [np.empty((0, 0))], [np.empty(0, int)], 0
    for item in data:
        if item.configurations_per_row and len(item.rows):
            q.append(item.configurations())
            samples.append(np.tile(np.arange(start, start + len(item.rows)), item.configurations_per_row))
        start += len(item.rows)
    if len(q) == 1:
        return q[0], samples[0]
    rows, of_rows = np.concatenate(q[1:]), np.concatenate(samples)
    order = order_of_rows(rows)
    rows, of_rows = rows[order], of_rows[order]
    first = np.unique(group_by_configuration(rows), return_index=True)[1]
    return rows[first], of_rows[first]


def split(
    data: Measurement | Sequence[Measurement], fraction: float, seed: int = 0
) -> tuple[tuple[Measurement, ...], tuple[Measurement, ...]]:
    """Split measurements into a fitted and a held-out part at random.

    The fraction is taken of each measurement, as closely as whole configurations allow.

    Args:
        data: One measurement or several of any kinds.
        fraction: Fraction of the samples to hold out, in [0, 1).
        seed: Seed of the random numbers.

    Returns:
        The fitted part of each measurement, and the held-out parts that are not empty.

    Raises:
        InvalidArgumentError: If the fraction is out of range.
    """
    data = as_measurements(data)
    if not 0 <= fraction < 1:
        raise InvalidArgumentError(f"holdout={fraction}: expected a fraction in [0, 1)")
    rng = np.random.default_rng(seed)
    labels = configuration_groups(data)
    # 1 for a configuration that is held out, 0 for a fitted one, -1 if not yet decided.
    state = np.full(len(labels), -1)
    fitted, held_out = [], []
    for item, label in zip(data, _by_measurement(data, labels), strict=True):
        order = np.argsort(label, kind="stable")[rng.permutation(len(item.rows))]
        wanted = round(fraction * len(order)) - np.count_nonzero(state[label] == 1)
        drawn = label[order][state[label[order]] < 0]
        groups, first, size = np.unique(drawn, return_index=True, return_counts=True)
        by_draw = np.argsort(first)
        groups, size = groups[by_draw], size[by_draw]
        # Hold out configurations in the order drawn, as long as more than half of each is still wanted.
        state[groups] = np.cumsum(size) - size / 2 <= wanted
        held = state[label] == 1
        fitted.append(item.take(np.flatnonzero(~held)))
        held_out.append(item.take(np.flatnonzero(held)))
    return tuple(fitted), tuple(item for item in held_out if len(item.rows))


def k_fold(data: Measurement | Sequence[Measurement], count: int, seed: int = 0) -> tuple[Fold, ...]:
    """Divide configurations into folds at random; each fold holds out one share of them.

    Args:
        data: One measurement or several of any kinds.
        count: Number of folds.
        seed: Seed of the random numbers.

    Returns:
        The folds; each sample is held out in exactly one of them. Samples without a configuration, known
        distances, are always fitted, unless there are no others.

    Raises:
        InvalidArgumentError: If there are fewer than two folds or more folds than configurations.
    """
    data = as_measurements(data)
    labels, n_configurations = _label_held_out(data)
    if not 2 <= count <= n_configurations:
        raise InvalidArgumentError(
            f"{count} folds: choose from 2 to {n_configurations}, the number of different configurations"
        )
    # The last entry is that of label -1.
    fold_of = np.append(np.random.default_rng(seed).permutation(n_configurations) % count, -1)
    return tuple(_by_measurement(data, fold_of[labels] == fold) for fold in range(count))


def path_folds(data: Sequence[Measurement], count: int) -> tuple[Fold, ...] | None:
    """Divide the samples of a recorded path into folds; None for other samples.

    Neighbours on a path share vibrations and slow noise of the instrument: a random fold would be judged by
    the neighbours of its samples. Each fold therefore holds out several parts of joint space.
    """
    if any(item.configurations_per_row != 1 for item in data):
        return None
    q = np.concatenate([item.configurations() for item in data])
    if not _MIN_PATH_SAMPLES <= len(q) <= _MAX_PATH_SAMPLES:
        return None
    ordered = q[order_of_rows(q)]
    if not _is_dense_path(ordered):
        return None
    fold_of = np.random.default_rng(0).permutation(_N_PATH_PARTS) % count
    parts = _parts(q, ordered[0])
    return tuple(_by_measurement(data, fold_of[parts] == fold) for fold in range(count))


def _is_dense_path(q: Array) -> bool:
    """Return whether most joint values (m, n) lie between two near neighbours."""
    is_between, steps = [], []
    for row in q[:: -(-len(q) // _N_CHECKED)]:
        sides = q - row
        distances = np.linalg.norm(sides, axis=1)
        distances[distances < CONFIGURATION_TOL] = np.inf
        i, j = np.argpartition(distances, 2)[:2]
        product = distances[i] * distances[j]
        is_between.append(np.isfinite(product) and sides[i] @ sides[j] < _MAX_COSINE * product)
        steps.append(min(distances[i], distances[j]))
    return bool(np.mean(is_between) > _MIN_BETWEEN and np.median(steps) < _MAX_STEP)


def _parts(q: Array, first: Array) -> Array:
    """Divide joint values (m, n) into parts around rows that are far from each other, from the first on."""
    nearest, parts = np.linalg.norm(q - first, axis=1), np.zeros(len(q), int)
    for part in range(1, _N_PATH_PARTS):
        distances = np.linalg.norm(q - q[np.argmax(nearest)], axis=1)
        parts[distances < nearest] = part
        nearest = np.minimum(nearest, distances)
    return parts


def count_held_out(data: Sequence[Measurement]) -> int:
    """Count the configurations that folds can hold out."""
    return _label_held_out(data)[1]


def _label_held_out(data: Sequence[Measurement]) -> tuple[Array, int]:
    """Label the configurations that folds can hold out, and count them; -1 for what is always fitted."""
    labels = configuration_groups(data)
    has_none = [np.full(len(item.rows), not item.configurations_per_row) for item in data]
    is_fitted = np.concatenate([np.empty(0, bool), *has_none])
    if is_fitted.all():
        return labels, int(labels.max(initial=-1)) + 1
    # Few distances state the size of a robot: without some of them, the others would have to.
    names, numbers = np.unique(labels[~is_fitted], return_inverse=True)
    held_out = np.full(len(labels), -1)
    held_out[~is_fitted] = numbers
    return held_out, len(names)


def leave_one_group_out(data: Measurement | Sequence[Measurement], labels: Array) -> tuple[Fold, ...]:
    """Make one fold per group of samples, which holds out that group.

    Groups that have a configuration in common are merged.

    Args:
        data: One measurement or several of any kinds, m samples in all.
        labels: Group of each sample, shape (m,).

    Returns:
        The folds, in the order of the labels; each sample is held out in exactly one of them.

    Raises:
        InvalidArgumentError: If there is not one label per sample, or only one group.
    """
    data = as_measurements(data)
    labels = np.asarray(labels)
    if labels.shape != (samples := sum(len(item.rows) for item in data),):
        raise InvalidArgumentError(f"labels have shape {labels.shape}; expected ({samples},), one per sample")
    merged = _merge_groups(labels, configuration_groups(data))
    groups = np.unique(merged)
    if len(groups) < 2:
        shared = " (all groups have configurations in common)" if len(np.unique(labels)) > 1 else ""
        raise InvalidArgumentError(
            f"one group{shared}: holding it out leaves nothing to fit; expected at least 2"
        )
    return tuple(_by_measurement(data, merged == group) for group in groups)


def blocked_folds(
    data: Measurement | Sequence[Measurement], fraction: float = BLOCK_FRACTION, groups: Array | None = None
) -> tuple[Fold, ...]:
    """Make two folds per principal direction of the joint values, which hold out its ends.

    Joint values are scaled to equal standard deviations first. Samples of one group or of one configuration
    are held out together. If there is only one group, each configuration is its own group.

    Args:
        data: One measurement or several of any kinds, m samples in all.
        fraction: Fraction of the groups that a fold holds out.
        groups: Labels of samples that belong together, shape (m,), as from `contact_groups`; without it each
            configuration is its own group. Samples without a configuration go with their group, or are
            always fitted.

    Returns:
        The different folds.

    Raises:
        NotObservableError: If all samples have the same joint values.
    """
    data = as_measurements(data)
    along, label, is_counted = _principal_coordinates(data, groups)
    folds: dict[bytes, Fold] = {}
    for coordinate in along.T:
        low, high = np.quantile(coordinate, [fraction, 1 - fraction])
        for is_end in (coordinate <= low, coordinate >= high):
            if not is_end.all():
                held_out = np.zeros(len(is_counted), bool)
                held_out[is_counted] = is_end
                folds.setdefault(held_out.tobytes(), _by_measurement(data, held_out[label]))
    if not folds:
        raise NotObservableError(
            "cross-validation by regions: all samples have the same joint values; "
            "expected samples at different joint values"
        )
    return tuple(folds.values())


def quadrant_folds(data: Measurement | Sequence[Measurement], groups: Array) -> tuple[Fold, ...]:
    """Make four folds per pair of principal directions of the joint values, divided by the medians."""
    data = as_measurements(data)
    along, label, is_counted = _principal_coordinates(data, groups)
    made: list[Fold] = []
    for pair in (along[:, i : i + 2] for i in range(0, along.shape[1], 2)):
        side = pair > np.median(pair, 0)
        # Samples without a configuration are never held out: region -1.
        region = np.full(len(is_counted), -1)
        region[is_counted] = side @ (1 << np.arange(side.shape[1]))
        folds = [_by_measurement(data, (region == i)[label]) for i in range(4)]
        folds = [fold for fold in folds if any(mask.any() for mask in fold)]
        made += folds if len(folds) > 1 else []
    return tuple(made)


def _principal_coordinates(data: tuple[Measurement, ...], groups: Array | None) -> tuple[Array, Array, Array]:
    """Return coordinates of groups of samples along the principal directions of the joint values."""
    has_configuration = np.concatenate(
        [np.full(len(item.rows), item.configurations_per_row > 0) for item in data]
    )
    q = np.concatenate([item.q for item in data])
    configurations = configuration_groups(data)
    merged = configurations if groups is None else _merge_groups(groups, configurations)
    label = np.unique(merged, return_inverse=True)[1]
    count = np.bincount(label[has_configuration], minlength=label.max(initial=-1) + 1)
    if not has_configuration.any():
        return np.empty((0, 0)), label, count > 0
    if groups is not None and np.count_nonzero(count) == 1:
        return _principal_coordinates(data, None)
    centre = np.stack(
        [np.bincount(label[has_configuration], column, len(count)) for column in q[has_configuration].T], 1
    )
    centre = centre[count > 0] / count[count > 0, None]
    std = centre.std(0)
    scaled = (centre - centre.mean(0))[:, std > 0] / std[std > 0]
    _, spread, directions = np.linalg.svd(scaled, full_matrices=False)
    along = scaled @ directions[spread > _MIN_RELATIVE_SPREAD * spread.max(initial=0.0)].T
    return along, label, count > 0


def contact_groups(problem: Problem, x: Array) -> Array:
    """Label samples that touch the same thing, or points joined by a known distance, by the same label."""
    chain = problem.chain(x)
    node = {parameter.name: i for i, parameter in enumerate(merge_instrument_parameters(problem.data))}
    # Nodes of the graph: instrument parameters, then samples; a contact links a sample to its parameters.
    start, samples, parameters = len(node), [np.empty(0, int)], [np.empty(0, int)]
    for item in problem.data:
        if (item.is_contact or not item.configurations_per_row) and len(item.rows):
            frames = chain.forward_kinematics(item.conditions())
            depends, sample = np.nonzero(
                item.instrument_jacobian(frames, problem.instrument_values_of(item, x)).any(1)
            )
            nodes = np.array([node[parameter.name] for parameter in item.instrument_parameters], int)
            samples.append(start + sample)
            parameters.append(nodes[depends])
        start += len(item.rows)
    return connect_nodes(start, np.concatenate(samples), np.concatenate(parameters))[len(node) :]


def _by_measurement(data: Sequence[Measurement], values: Array) -> Fold:
    """Cut values (m,) of all samples into one array per measurement."""
    return tuple(np.split(values, np.cumsum([len(item.rows) for item in data])[:-1]))
