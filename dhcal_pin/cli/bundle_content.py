"""Content of the bundle of a calibration job whose inputs lie in the working folder under their names."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
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


def with_output_paths(job: Job, change: Any) -> Job:
    """Return a job with changed paths of its outputs; standard output stays what it is."""
    changed: dict[str, Any] = {}
    for option in fields(Job):
        value = getattr(job, option.name)
        is_path = option.name in ("output", "camera_files") or option.metadata.get("output")
        if value and is_path:
            paths = value if isinstance(value, tuple) else (value,)
            new = tuple(path if path == STDOUT else change(path) for path in paths)
            changed[option.name] = new if isinstance(value, tuple) else new[0]
    return replace(job, **changed)
