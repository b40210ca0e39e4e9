"""Digests of fitted rows."""

import hashlib
import struct

import numpy as np
from robots import nominal_arm

from dhcal_pin.io.measurement_files.fitted_rows import MAX_ROWS, count_fitted_rows, fitted_row_digests
from dhcal_pin.measurements import KINDS, Noise, Position


def test_a_digest_is_that_of_the_documented_numbers():
    data = Position([[0.1234564, -2.0], [0.0, 1e-9]], [[1.0, -0.25, 3.0000004], [0.0, 0.0, -0.0]], 1e-4)
    rows = [(123456, -2000000, 1000000, -250000, 3000000), (0,) * 5]
    expected = sorted(hashlib.blake2b(struct.pack("<5q", *row), digest_size=5).digest() for row in rows)
    assert fitted_row_digests([data]) == b"".join(expected)


def test_rows_of_every_kind_are_recognized_by_their_values():
    """Known distances between points are no measurements of the robot."""
    chain = nominal_arm("ur10")
    rng = np.random.default_rng(0)
    for kind in KINDS.values():
        is_of_robot = kind.configurations_per_row > 0
        q = rng.uniform(-1, 1, (12 * max(kind.configurations_per_row, 1), 6))
        data = kind.simulate(chain, q, Noise(1e-4, 1e-4), rng)
        m = len(data.rows)
        digests = fitted_row_digests([data.take(np.arange(m) % 3 > 0)])
        expected = np.sum(np.arange(m) % 3 > 0) * is_of_robot
        assert count_fitted_rows(data, digests) == expected, kind
        assert count_fitted_rows(data.with_weights(np.full(m, 0.5)), digests) == expected
        assert count_fitted_rows(kind.simulate(chain, q, Noise(1e-4, 1e-4), rng), digests) == 0, kind
        assert count_fitted_rows(data, b"") == 0


def test_digests_of_too_many_rows_are_not_kept():
    rng = np.random.default_rng(0)
    data = Position(rng.uniform(size=(MAX_ROWS, 3)), rng.uniform(size=(MAX_ROWS, 3)))
    assert len(fitted_row_digests([data])) == 5 * MAX_ROWS
    assert fitted_row_digests([data, data.take(np.s_[:1])]) == b""
