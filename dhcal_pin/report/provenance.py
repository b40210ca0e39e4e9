"""Provenance of a result: files with hashes, command and settings, and versions of the packages."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import field
from functools import cache
from importlib import metadata
from pathlib import Path

from .._frozen import frozen
from .._typing import PathLike
from ..calibration.evaluation import Comparison
from ..formatting import Table
from ..measurements.base import Measurement


@frozen
class Provenance:
    """Facts about a calibration that its result does not contain.

    Attributes:
        command: Command line, without the paths of the outputs.
        inputs: SHA-256 of each input file by path.
        outputs: SHA-256 of each file of the calibrated robot by path.
        names: File of each measurement of the fitted data; empty for data from Python.
        holdout_names: File of each measurement of the hold-out data.
        settings: Further choices as text, by name.
        excluded_rows: Reasons why rows were not used, by file and row.
        warnings: Warnings about the input data by file.
        notes: What of the input data is not used, by file.
        remarks: Sentences that are shown beside the headline.
        hint: Improvement to expect from transmission errors, if they were not tried.
        comparison: Cross-validated accuracy, if there are no hold-out samples.
    """

    command: str = ""
    inputs: Mapping[str, str] = field(default_factory=dict)
    outputs: Mapping[str, str] = field(default_factory=dict)
    names: Sequence[str] = ()
    holdout_names: Sequence[str] = ()
    settings: Mapping[str, str] = field(default_factory=dict)
    excluded_rows: Mapping[str, Mapping[int, str]] = field(default_factory=dict)
    warnings: Mapping[str, Sequence[str]] = field(default_factory=dict)
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict)
    remarks: Sequence[str] = ()
    hint: str = ""
    comparison: Comparison | None = None


def file_digests(paths: Sequence[PathLike]) -> dict[str, str]:
    """Compute the SHA-256 of files."""
    return {str(path): hashlib.sha256(Path(path).read_bytes()).hexdigest() for path in paths}


def content_digests(contents: Mapping[PathLike, str | bytes]) -> dict[str, str]:
    """Compute the SHA-256 of files that are not written yet."""
    return {
        str(path): hashlib.sha256(content if isinstance(content, bytes) else content.encode()).hexdigest()
        for path, content in contents.items()
    }


@cache
def versions() -> dict[str, str]:
    """Return the versions of the packages that compute results."""
    return {name: metadata.version(name) for name in ("dhcal-pin", "pin", "numpy", "scipy")}


def short_names(paths: Sequence[PathLike]) -> dict[str, str]:
    """Shorten paths to as many of their last parts as make them unique.

    >>> short_names(["a/front/hole.csv", "a/back/hole.csv", "arm.urdf"])
    {'a/front/hole.csv': 'front/hole.csv', 'a/back/hole.csv': 'back/hole.csv', 'arm.urdf': 'arm.urdf'}
    """
    parts = {os.fspath(path): Path(path).parts for path in paths}

    def shortest_unique_end(path: str) -> str:
        for count in range(1, len(parts[path])):
            end = parts[path][-count:]
            if all(other[-count:] != end for name, other in parts.items() if name != path):
                return "/".join(end)
        return path

    return {path: shortest_unique_end(path) for path in parts}


def measurement_names(paths: Sequence[str], data: Sequence[Measurement]) -> list[str]:
    """Return short names of measurements."""
    if len(paths) == len(data):
        short = short_names(paths)
        return [short[path] for path in paths]
    return [f"{item.kind} measurements {i}" for i, item in enumerate(data, 1)]


def origin_tables(inputs: Mapping[str, str]) -> list[Table]:
    """List the input files with their hashes, and the versions of the packages."""
    short = short_names(list(inputs))
    digests = [[short[path], digest] for path, digest in inputs.items()]
    return [
        Table(["file", "SHA-256"], digests, n_text_columns=2),
        Table(["software", "version"], [list(pair) for pair in versions().items()], n_text_columns=2),
    ]
