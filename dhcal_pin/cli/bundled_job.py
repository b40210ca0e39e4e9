"""Jobs with a bundle: inputs are copied to a temporary folder under the names that the bundle has for them.

The first calibration and its repetition therefore run in equal folders and name equal paths in all
outputs. Only the paths of outputs are those of the command line.
"""

from __future__ import annotations

import os
import tempfile
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from contextlib import chdir, contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from .._typing import Progress
from ..exceptions import FileFormatError, InvalidArgumentError
from ..io.bundle import Bundle, read_bundle
from ..io.robot import has_robot_ending, read_robot
from ..io.sidecar import sidecar_path
from ..io.tabular import read_bytes
from ..parallel import SERIAL, TaskExecutor
from ..report.provenance import short_names
from .bundle_content import with_output_paths, with_texts
from .job import Job, given_options
from .job_outputs import companion_paths
from .run_job import CalibrationOutcome, checked_inputs, run_job


@contextmanager
def job_source(args: Namespace) -> Iterator[tuple[Job, str | None]]:
    """Return the job of a command line, and the folder with the files of the bundle that it names."""
    if not args.source:
        yield Job.from_args(args), None
        return
    bundle = read_bundle(args.source)
    with tempfile.TemporaryDirectory(prefix="dhcal-") as folder:
        for name, data in bundle.inputs.items():
            path = Path(folder, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        job = _continued(args, bundle, folder)
        if os.path.dirname(job.robot) != folder:
            _require_same_joints(job, bundle, args.source)
        yield job, folder


def run_any_job(
    job: Job,
    folder: str | None = None,
    progress: Progress | None = None,
    executor: TaskExecutor = SERIAL,
) -> CalibrationOutcome:
    """Run a job, under the names of a bundle if it writes one or if it continues that in a folder."""
    if folder is None and not job.bundle:
        return run_job(job, progress, executor)
    inputs = checked_inputs(job)
    names = _names(inputs, job.robot, folder)
    with tempfile.TemporaryDirectory(prefix="dhcal-") as copies:
        for path, name in names.items():
            copy = Path(copies, name)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(read_bytes(path))
        outputs = [*job.output_paths, *companion_paths(job.output, job.curves, job.servos is not None)]
        shown = {os.path.abspath(path): path for path in outputs}
        moved = with_output_paths(_renamed(job, names), os.path.abspath)
        moved = replace(moved, package_dir=tuple(map(os.path.abspath, job.package_dir)))
        with chdir(copies):
            return run_job(moved, progress, executor, shown)


def _continued(args: Namespace, bundle: Bundle, folder: str) -> Job:
    """Return the job of a bundle with the options, the robot and the data of a command line."""
    given = given_options(args)
    words = [given.pop("robot", None), *given.pop("data", ())]
    if words[0] and has_robot_ending(words[0]):
        given["robot"] = words.pop(0)
    known = {option.name for option in fields(Job)}
    if unknown := sorted(set(bundle.options) - known):
        raise FileFormatError(f"{args.source}: unknown option {unknown[0]!r}; use the version that wrote it")
    options: dict[str, Any] = {
        key: tuple(v) if isinstance(v, list) else v for key, v in bundle.options.items()
    }
    job = _renamed(Job(**options), {name: os.path.join(folder, name) for name in bundle.inputs})
    target = os.path.dirname(given.get("output", ""))
    job = with_output_paths(job, lambda path: os.path.join(target, os.path.basename(path)))
    job = replace(job, package_dir=tuple(path for path in job.package_dir if os.path.isdir(path)), **given)
    return replace(job, data=(*job.data, *(word for word in words if word)))


def _require_same_joints(job: Job, bundle: Bundle, source: str) -> None:
    """Require that another robot has the joints of the bundle."""
    joints = read_robot(job.robot, job.tip, package_dirs=job.package_dir, root=job.root).joint_names
    if tuple(joints) != bundle.joints:
        raise InvalidArgumentError(
            f"{job.robot}: its joints are {', '.join(joints)}; expected those of {source}: "
            f"{', '.join(bundle.joints)}"
        )


def _names(inputs: Sequence[str], robot: str, folder: str | None) -> dict[str, str]:
    """Return a different relative path for each input; files of a bundle in a folder keep theirs."""
    short = short_names(inputs)
    found: dict[str, str] = {}
    for path in inputs:
        if path == sidecar_path(robot):
            name = sidecar_path(found[robot])
        elif folder and os.path.commonpath([folder, os.path.abspath(path)]) == folder:
            name = os.path.relpath(path, folder)
        else:
            parts = [part for part in Path(short[path]).parts if part not in (os.sep, os.pardir, os.curdir)]
            name = os.path.join(*parts)
        while name in found.values():
            name = os.path.join("added", name)
        found[path] = name
    return found


def _renamed(job: Job, names: Mapping[str, str]) -> Job:
    """Return a job with other paths of its inputs."""
    inputs = [option.name for option in fields(Job) if "output" not in option.metadata]
    return with_texts(job, inputs, lambda path: names.get(path, path))
