"""`dhcal calibrate`: estimate the errors of one robot, or of all robots of a manifest."""

from __future__ import annotations

import atexit
import gc
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

from ...exceptions import InvalidArgumentError
from .. import screens
from ..job import BUNDLE_ENDING, DOUBTFUL, Job, is_manifest, job_options
from ..options import Options, execution_options

# Exit status of a refused calibration.
REFUSED = 3

EXAMPLE = "dhcal calibrate ur10.urdf laser.csv --tip tool0 --holdout 0.3 -o ur10_calibrated.urdf"

ARGUMENTS: Options = {
    **job_options(),
    "--from": {
        "dest": "source",
        "metavar": f"NAME{BUNDLE_ENDING}",
        "help": "repeat the calibration of a bundle; a ROBOT and options that are named replace its own, "
        "and DATA is added to its measurements",
    },
    **execution_options("processes (default: 1; with a manifest, one per processor)", jobs=None),
    "--progress": {
        "choices": ("status", "lines"),
        "default": "status",
        "help": "status: a status line on a terminal (default); lines: a line `progress: PHASE STEP/TOTAL` "
        "on stderr for each step, for programs that run this command",
    },
    "--strict": "exit status 4 for the verdict caution, and 3 for a refused robot with --force; the files "
    "are written",
}


def run(args: Namespace) -> int:
    """Calibrate one robot or all robots of a manifest, and show the results."""
    if args.source:
        return _calibrate_robot(args)
    robot = args.robot or ""
    if is_manifest(robot):
        if args.scheduler:
            raise InvalidArgumentError("--scheduler: not available with a manifest; use --jobs")
        from ..fleet import run_manifest  # lazy import: loads Pinocchio

        return run_manifest(args)
    if robot and not args.data:
        raise InvalidArgumentError(_missing_input(robot))
    Job.from_args(args)  # names an option that is missing, before heavy modules are loaded
    return _calibrate_robot(args)


def _missing_input(path: str) -> str:
    """Say which input is missing beside the only one."""
    from ...io.robot import has_robot_ending  # lazy import, as the following: they load Pinocchio
    from ...io.tables.sources import has_table_ending

    if has_table_ending(path) and not has_robot_ending(path):
        return f"{path}: ROBOT is required; name the file of the robot before that of the measurements"
    return f"{path}: DATA is required; name at least one measurement file"


@contextmanager
def _without_collections() -> Iterator[None]:
    """Collect no cyclic garbage: a calibration leaves little; to examine loaded modules takes 0.1 s."""
    was_enabled = gc.isenabled()
    gc.disable()
    # The interpreter collects once more when it exits.
    atexit.register(gc.freeze)
    try:
        yield
    finally:
        # All objects become old ones, which are not examined at once.
        gc.freeze()
        gc.unfreeze()
        if was_enabled:
            gc.enable()


@_without_collections()
def _calibrate_robot(args: Namespace) -> int:
    """Calibrate one robot and show its result."""
    from ...parallel import open_executor  # lazy import, as the following: they load Pinocchio
    from ..bundled_job import job_source, run_any_job
    from ..screens.calibration_screen import calibration_screen

    shown = {
        "status": screens.show_progress("reading the files"),
        "lines": nullcontext(screens.print_progress),
    }
    with (
        job_source(args) as (job, folder),
        open_executor(args.jobs or 1, args.scheduler) as executor,
        shown[args.progress] as progress,
    ):
        outcome = run_any_job(job, folder, progress, executor)
    screens.show(calibration_screen(outcome, job), args.verbosity)
    verdict = outcome.fit.verdict
    if verdict.is_refused and (args.strict or not job.force):
        return REFUSED
    return DOUBTFUL if args.strict and verdict.status != "ok" else 0
