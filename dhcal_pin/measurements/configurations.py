"""Configurations of samples: which samples share the joint values, and so the error of the robot.

The joint values of a taught pose that the robot visits again differ by the resolution of its encoders and the
error of its controller. Such visits are one configuration: they show the noise, but not the model errors at
other joint values. Neighbouring samples of a path are different configurations. Poses to which a person
guides the robot again differ by some tenths of a degree. The samples show by their groups that they are
visits of few poses.

Shapes: m rows of joint values of n joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._typing import Array

# Joint values that differ by less are the same configuration [rad or m].
CONFIGURATION_TOL = 1e-6
# Joint values that differ by less are visits of one configuration if all of them are within an extent
# [rad or m]. Samples of a path are not. Both are at most these fractions of the range of the joint values.
VISIT_TOL, VISIT_EXTENT = 5e-3, 2e-2
VISIT_FRACTION, EXTENT_FRACTION = 5e-3, 2e-2
# Largest number of pairs of rows that are compared for visits.
MAX_COMPARED = 1_000_000
# Joint values of poses to which a person guides the robot again differ by more. Rows are visits of one pose
# if their joint values differ by less than this [rad or m], at most this fraction of the range of the values.
GUIDED_TOL, GUIDED_FRACTION = 5e-2, 2e-2
# Largest range of the visits of one pose, as a multiple of that difference; smallest distance of two poses,
# as a multiple of the largest range; and smallest mean number of visits of a pose.
GUIDED_EXTENT, GUIDED_DISTANCE, MIN_GUIDED_VISITS = 4.0, 3.0, 3
# Number of rows of which it is checked first whether they have such neighbours, and largest number of rows.
GUIDED_CHECKED, MAX_GUIDED = 10, 5000


def group_by_configuration(q: Array) -> Array:
    """Label rows of joint values (m, n), equal rows by the same label, in the order of first appearance.

    Rows are equal if no joint value differs by more than `CONFIGURATION_TOL`, and also if they are visits of
    one configuration, see `VISIT_TOL`. Equality is transitive: rows that are connected by a chain of equal
    rows get the same label. Of very many rows, visits are only found among those next to each other in their
    projection.

    >>> group_by_configuration(np.array([[0.5, 1.0], [0.0, 1.0], [0.5, 1.0 + 1e-4]]))
    array([0, 1, 0])
    """
    m, n = q.shape
    # Equal rows are close in their projection on any direction: only neighbours along one are compared. The
    # direction is irrational, so that rows of a regular grid do not coincide; its weights sum to 1.
    direction = np.modf(np.arange(1, n + 1) * (1 + np.sqrt(5)) / 2)[0]
    projection = q @ (direction / direction.sum())
    order = np.argsort(projection, kind="stable")
    is_new = np.ones(m, bool)
    is_new[1:] = np.any(q[order[1:]] != q[order[:-1]], 1)
    rows, projection = q[order[is_new]], projection[order[is_new]]
    span = float(np.ptp(rows, axis=0).max(initial=0.0)) if len(rows) else 0.0
    tol = max(CONFIGURATION_TOL, min(VISIT_TOL, VISIT_FRACTION * span))
    extent = min(VISIT_EXTENT, EXTENT_FRACTION * span)
    near = _links(rows, projection, tol, MAX_COMPARED // max(m, 1))
    same = _links(rows, projection, CONFIGURATION_TOL, m)
    if len(rows) == m and not len(near[0]) and not len(same[0]):
        return np.arange(m)
    visits = connect_nodes(len(rows), *map(np.concatenate, zip(near, same, strict=True)))
    equal = connect_nodes(len(rows), *same)
    largest, smallest = _bounds(rows, visits)
    is_visited = np.max(largest - smallest, axis=1) <= extent
    labels = np.empty(m, int)
    labels[order] = np.where(is_visited[visits], visits, len(rows) + equal)[np.cumsum(is_new) - 1]
    return label_by_appearance(labels)


def merge_guided_visits(q: Array, labels: Array) -> Array:
    """Merge the labels (m,) of joint values (m, n) that belong to visits of few poses by hand guiding.

    >>> poses = np.repeat([[0.0, 1.0], [2.0, -1.0]], 3, axis=0)
    >>> scattered = poses + 1e-2 * np.array([[0, 1], [1, 0], [1, 1], [0, 1], [1, 0], [1, 1]])
    >>> merge_guided_visits(scattered, np.arange(6))
    array([0, 0, 0, 1, 1, 1])
    """
    m = len(q)
    if not MIN_GUIDED_VISITS < m <= MAX_GUIDED:
        return labels
    order = order_of_rows(q)
    checked = q[order[:: -(-m // GUIDED_CHECKED)]]
    tol = min(GUIDED_TOL, GUIDED_FRACTION * float(np.ptp(q, axis=0).max()))
    n_near = np.count_nonzero(np.max(np.abs(q - checked[:, None]), axis=-1) <= tol, axis=1)
    if np.median(n_near) < MIN_GUIDED_VISITS:
        return labels
    projection = q.mean(axis=1)
    order = np.argsort(projection, kind="stable")
    rows = q[order]
    visits = connect_nodes(m, *_links(rows, projection[order], tol, m))
    largest, smallest = _bounds(rows, visits)
    n_poses, extent = len(largest), float(np.max(largest - smallest))
    if m < MIN_GUIDED_VISITS * n_poses or extent > GUIDED_EXTENT * tol:
        return labels
    centres = (largest + smallest) / 2
    distances = np.max(np.abs(centres - centres[:, None]), axis=-1) + np.diag(np.full(n_poses, np.inf))
    if distances.min() < GUIDED_DISTANCE * extent:
        return labels
    merged = np.empty(m, int)
    merged[order] = visits
    return label_by_appearance(merged)


def _bounds(rows: Array, labels: Array) -> tuple[Array, Array]:
    """Return the largest and the smallest joint values (k, n) of the rows of each of k labels."""
    order = np.argsort(labels, kind="stable")
    starts = np.flatnonzero(np.diff(labels[order], prepend=-1))
    return np.maximum.reduceat(rows[order], starts), np.minimum.reduceat(rows[order], starts)


def _links(rows: Array, projection: Array, tol: float, max_offset: int) -> tuple[Array, Array]:
    """Return the pairs of rows, sorted by their projection, whose joint values differ by at most tol."""
    first, second = [np.empty(0, int)], [np.empty(0, int)]
    for offset in range(1, min(len(rows), max_offset + 1)):
        (near,) = np.nonzero(projection[offset:] - projection[:-offset] <= tol * (1 + 1e-6))
        if not near.size:
            break
        for joint in rows.T:
            near = near[np.abs(joint[near + offset] - joint[near]) <= tol]
        first.append(near)
        second.append(near + offset)
    return np.concatenate(first), np.concatenate(second)


def connect_nodes(count: int, first: Array, second: Array) -> Array:
    """Label nodes (count,), those that links from `first` to `second` connect by the same label."""
    if not len(first):
        return np.arange(count)
    from scipy.sparse import coo_array  # lazy import: slow, and few data need it
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(first)), (first, second)), shape=(count, count))
    return connected_components(links, directed=False)[1]


def label_by_appearance(labels: Array) -> Array:
    """Number labels (m,), which are not negative, from 0 in the order of their first appearance."""
    numbers = np.arange(len(labels))
    # Of repeated indices the last one counts: the first appearance.
    first = np.zeros(labels.max(initial=-1) + 1, int)
    first[labels[::-1]] = numbers[::-1]
    appearance = first[labels]
    return (np.cumsum(appearance == numbers) - 1)[appearance]


def label_samples(data: Sequence[Any]) -> Array:
    """Label the samples of measurements, those of the same configuration by the same label."""
    # Labels are numbered in the order of the joint values. A sample with several configurations, such as a
    # relative pose, is compared by all of its joint values. A sample without a configuration, such as a known
    # distance between points, has a label of its own; these are the last, in the order of their names.
    counts = [len(item.rows) for item in data]
    starts = np.cumsum([0, *counts])
    labels = np.arange(starts[-1])
    for width in {item.configurations_per_row for item in data} - {0}:
        chosen = [i for i, item in enumerate(data) if item.configurations_per_row == width and counts[i]]
        if not chosen:
            continue
        # One row of joint values per sample: configurations() lists all first ones, then all second ones.
        rows = [np.concatenate(np.split(np.asarray(data[i].configurations()), width), axis=1) for i in chosen]
        samples = np.concatenate([np.arange(starts[i], starts[i + 1]) for i in chosen])
        # The label of a group is the number of its first sample.
        q = np.concatenate(rows)
        groups = merge_guided_visits(q, group_by_configuration(q))
        is_first = np.diff(np.maximum.accumulate(groups), prepend=-1) > 0
        labels[samples] = samples[np.flatnonzero(is_first)[groups]]
    if len(labels):
        order = _order_of_joint_values(data)
        labels[order] = label_by_appearance(labels[order])
    return labels


def _order_of_joint_values(data: Sequence[Any]) -> Array:
    """Return the samples (m,) of measurements in the order of their joint values, or else of their names."""
    keys = []
    for item in data:
        if item.configurations_per_row:
            names = np.zeros((len(item.rows), 0))
            q = np.concatenate(np.split(item.configurations(), item.configurations_per_row), axis=1)
        else:
            texts = item.text_values().values()
            names = np.stack([np.unique(text, return_inverse=True)[1] for text in texts], axis=1)
            q = np.full(item.q.shape, np.inf)
        keys.append(np.concatenate([q, names], axis=1))
    width = max(key.shape[1] for key in keys)
    padded = [np.pad(key, ((0, 0), (0, width - key.shape[1]))) for key in keys]
    return order_of_rows(np.concatenate(padded))


def order_of_rows(rows: Array) -> Array:
    """Return the order of rows (m, n) by their first values, equal ones by the second values, and so on."""
    order = np.argsort(rows[:, 0], kind="stable")
    first = rows[order, 0]
    return order if np.all(first[1:] > first[:-1]) else np.lexsort(rows.T[::-1])
