"""Cases of a test of which the fast suite runs some."""

from collections.abc import Collection, Sequence
from typing import Any

import pytest


def some_slow(cases: Sequence[Any], fast: Collection[int]) -> list[Any]:
    """Mark all cases as slow but those at the given places; a case with several values is a tuple."""
    out = []
    for i, case in enumerate(cases):
        values = case if isinstance(case, tuple) else (case,)
        out.append(pytest.param(*values, marks=() if i in fast else pytest.mark.slow))
    return out
