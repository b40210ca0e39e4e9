"""Content of the bundle of a calibration job whose inputs lie in the working folder under their names."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from .._typing import PathLike
from ..io.bundle import Bundle, bundle_bytes
from ..report.json_document import json_text
from ..report.provenance import versions
from ..robot.chain import Chain
from .job import Job
from .options import STDOUT


def bundle_content(
    job: Job,
    chain: Chain,
    inputs: Sequence[str],
    contents: Mapping[PathLike, str | bytes],
    document: Mapping[str, Any],
) -> bytes:
    """Make the bundle of a job from its inputs, the contents of its outputs and its JSON document."""
    bundled = with_output_paths(replace(job, bundle=None, in_place=False), os.path.basename)
    result = {**document, "files": {name: os.path.basename(p) for name, p in document["files"].items()}}
    outputs = {
        os.path.basename(path): content if isinstance(content, bytes) else content.encode()
        for path, content in contents.items()
    }
    if job.json not in (None, STDOUT):
        outputs[os.path.basename(job.json)] = json_text(result).encode()
    return bundle_bytes(
        Bundle(
            options={
                option.name: getattr(bundled, option.name)
                for option in fields(Job)
                if getattr(bundled, option.name) != option.default
            },
            versions=versions(),
            joints=chain.joint_names,
            tip=chain.tip,
            result=result,
            inputs={path: Path(path).read_bytes() for path in inputs},
            outputs=outputs,
        )
    )


def with_output_paths(job: Job, change: Callable[[str], str]) -> Job:
    """Return a job with changed paths of its outputs; standard output stays what it is."""
    names = [
        option.name
        for option in fields(Job)
        if option.name in ("output", "camera_files") or option.metadata.get("output")
    ]
    return with_texts(job, names, lambda path: path if path == STDOUT else change(path))


def with_texts(job: Job, names: Iterable[str], change: Callable[[str], str]) -> Job:
    """Return a job with changed texts of some options, each of which has one text, several or none."""
    changed: dict[str, Any] = {}
    for name in names:
        value = getattr(job, name)
        if isinstance(value, tuple):
            changed[name] = tuple(map(change, value))
        elif isinstance(value, str) and value:
            changed[name] = change(value)
    return replace(job, **changed)
