"""Digests of measured rows, by which rows that a calibration fitted are recognized in any file.

The digest of a row is a BLAKE2b hash of 5 bytes of its joint values and measured values, which are rounded to
6 decimals in m, rad or px and written as little-endian 64-bit integers. Joint values come first, in the order
of the chain, then the measured values in the order of the columns of the kind. Standard deviations, texts and
conditions do not count, nor do joint values that were computed from poses of the tip. Two different rows have
the same digest with the probability 1e-12. Known distances between points are no measurements of the robot
and have no digests.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np

from ...measurements.base import Measurement

# Decimals of the values that a digest depends on [m, rad or px]; at most 5e-7 of noise is ignored.
_DECIMALS = 6
# Length of a digest [bytes], and the largest number of rows whose digests are kept: 33 kB of base64 text.
_DIGEST_SIZE, MAX_ROWS = 5, 5000


def fitted_row_digests(data: Sequence[Measurement]) -> bytes:
    """Return the digests of all rows in ascending order, one after the other; empty for too many rows."""
    if sum(len(item.rows) for item in data) > MAX_ROWS:
        return b""
    return b"".join(sorted({digest for item in data for digest in _row_digests(item)}))


def count_fitted_rows(item: Measurement, digests: bytes) -> int:
    """Count the rows whose digests are among those of the fitted rows."""
    known = {digests[i : i + _DIGEST_SIZE] for i in range(0, len(digests), _DIGEST_SIZE)}
    return sum(digest in known for digest in _row_digests(item)) if known else 0


def _row_digests(item: Measurement) -> list[bytes]:
    """Return the digest of each row, (m,)."""
    if not item.configurations_per_row:
        return []
    values = [
        np.asarray(column)
        for name, column in item.to_columns().items()
        if not name.startswith("sigma_") and item.columns[name] not in ("text", "remark")
    ]
    joints = np.split(item.configurations(), item.configurations_per_row)
    parts = [*(joints if item.has_joint_values else []), *(column[:, None] for column in values)]
    numbers = np.rint(np.concatenate(parts, 1) * 10.0**_DECIMALS).astype("<i8")
    return [hashlib.blake2b(row.tobytes(), digest_size=_DIGEST_SIZE).digest() for row in numbers]
