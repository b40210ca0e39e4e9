"""Random mutations of the content of a file."""

import re
from collections.abc import Sequence

from hypothesis import strategies as st

# Grain, kind, two places, size and token of a mutation.
Mutation = tuple[str, str, float, float, int, bytes]
KINDS = ["delete", "repeat", "insert", "replace", "swap", "number", "flip", "truncate"]


def mutation_lists(tokens: st.SearchStrategy[bytes]) -> st.SearchStrategy[list[Mutation]]:
    """Draw one to four mutations that insert some tokens."""
    place = st.floats(0, 1, exclude_max=True)
    grain, kind = st.sampled_from(["words", "bytes"]), st.sampled_from(KINDS)
    return st.lists(st.tuples(grain, kind, place, place, st.integers(1, 12), tokens), min_size=1, max_size=4)


def mutated(data: bytes, mutations: Sequence[Mutation], word: re.Pattern[bytes]) -> bytes:
    """Return bytes after some mutations, whose words are what a pattern finds."""
    for grain, kind, at, to, size, token in mutations:
        parts = word.findall(data) if grain == "words" else [data[i : i + 1] for i in range(len(data))]
        i, j = sorted((int(at * len(parts)), int(to * len(parts))))
        if kind == "delete":
            parts[i : i + size] = []
        elif kind == "repeat":
            parts[j:j] = parts[i : i + size]
        elif kind == "insert":
            parts[i:i] = [token]
        elif kind == "replace":
            parts[i : i + 1] = [token]
        elif kind == "swap" and i + size <= j:
            parts[i : i + size], parts[j : j + size] = parts[j : j + size], parts[i : i + size]
        elif kind == "number":
            numbers = [k for k, part in enumerate(parts) if part[:1].isdigit()]
            if numbers:
                parts[numbers[int(at * len(numbers))]] = token
        elif kind == "flip" and i < len(parts):
            parts[i] = bytes([parts[i][0] ^ (1 << size % 8)]) + parts[i][1:]
        elif kind == "truncate" and at > 0.9:
            parts[i:] = []
        data = b"".join(parts)
    return data
