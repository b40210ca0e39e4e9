"""Leaderboard: accuracy of calibration programs on public measurements of real robots.

    python tests/bench_public.py [--data DIR] [--programs NAME,...] [--series TEXT] [--splits NAME,...]

Each program calibrates the same rows of each series and is judged by the same other rows, see
`public_series.py` for series and splits, `public_programs.py` for the programs. One JSON file per program is
written into docs/evidence/leaderboard (`-o FOLDER`: elsewhere), after each split; the documentation makes its
tables and figures from them. Two runs give equal files except for `seconds`. The folder DIR has the layout of
shared/data beside the project; each file `series.toml` in it describes a further series. Series and splits
that are absent or not chosen keep the entries that the JSON file has.

The error of a judged row is the distance of the measured position from that of the program, and the angle
between their orientations; all rows count, outliers too. For contacts it is the distance from the mean of the
positions that touch the same socket.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from public_programs import PROGRAMS, Answer, Program, Task, frames_between
from public_series import SERIES, SPLITS, Series, cases, further_series
from robots import DATA, ROOT

from dhcal_pin import se3
from dhcal_pin._typing import Array
from dhcal_pin.measurements import PointContact, Pose

FOLDER = ROOT / "docs" / "evidence" / "leaderboard"


def errors(
    data: Pose | PointContact, poses: Array, *, fits_frames: bool = False
) -> tuple[Array, Array | None]:
    """Return the position errors [m] and the orientation errors [rad] of modelled poses, shape (k,) each."""
    if not isinstance(data, Pose):
        touched = data.label
        counts = np.bincount(touched, minlength=len(data.names))
        mean = np.zeros((len(counts), 3))
        np.add.at(mean, touched, poses[:, :3, 3] / counts[touched, None])
        return np.linalg.norm(poses[:, :3, 3] - mean[touched], axis=1)[counts[touched] > 1], None
    if fits_frames:
        base, tool = frames_between(poses, data.poses)
        poses = base @ poses @ tool
    position = np.linalg.norm(data.poses[:, :3, 3] - poses[:, :3, 3], axis=1)
    turned = np.swapaxes(poses[:, :3, :3], 1, 2) @ data.poses[:, :3, :3]
    return position, np.linalg.norm(se3.log3(turned), axis=1)


def statistics(data: Pose | PointContact, poses: Array, has_orientation: bool, *, fits_frames: bool) -> dict:
    """Return RMS and 95th percentile of the errors of modelled poses."""
    position, orientation = errors(data, poses, fits_frames=fits_frames)
    groups = {"position": (position, "m"), "orientation": (orientation if has_orientation else None, "rad")}
    found = {}
    for name, (values, unit) in groups.items():
        if values is not None:
            found[f"{name}_rms_{unit}"] = _rounded(np.sqrt(np.mean(values**2)))
            found[f"{name}_p95_{unit}"] = _rounded(np.quantile(values, 0.95))
    return found


def _rounded(value: float) -> float | None:
    """Round to four digits, so that linear algebra of other processors gives the same file."""
    return float(f"{value:.4g}") if np.isfinite(value) else None


def judge(
    program: Program, task: Task, judged: Pose | PointContact, *, fits_frames: bool = False
) -> dict | None:
    """Calibrate by a program and return its errors on the judged rows; None if it cannot."""
    q = np.concatenate([judged.q, task.fit.q])
    answer: Answer | None = program.calibrate(Task(task.chain, task.fit, task.sets, q, task.split))
    # Base and tool are fitted to poses; positions without orientation do not give the tool.
    if answer is None or (fits_frames and not answer.has_orientation):
        return None
    count = len(judged.q)
    stated = answer.stated
    if stated is None:
        stated = float(np.sqrt(np.mean(errors(task.fit, answer.poses[count:])[0] ** 2)))
    found = {
        "fitted": len(task.fit.q),
        "judged": count,
        **statistics(judged, answer.poses[:count], answer.has_orientation, fits_frames=fits_frames),
        "stated_position_rms_m": _rounded(stated),
    }
    if answer.alone is not None:
        alone = statistics(judged, answer.alone[:count], answer.has_orientation, fits_frames=fits_frames)
        found["urdf_alone"] = alone
    return found | {"seconds": round(answer.seconds, 2)}


def run_series(
    program: Program, series: Series, data: Path, splits: Sequence[str]
) -> Iterator[tuple[str, list[dict]]]:
    """Yield each split of a series and the results of its cases; no split that the program cannot do."""
    read = series.read(data)
    if read is None:
        return
    chain, measured = read
    for split in splits:
        found: list[dict | None] = []
        if split == "other":
            every = (*SERIES, *further_series(data))
            others = [each.read(data) for each in every if each.arm == series.other]
            for other in filter(None, others):
                task = Task(chain, measured, series.sets, measured.q, split)
                found.append(judge(program, task, other[1], fits_frames=True))
        else:
            for fit, judged in cases(measured, split):
                task = Task(chain, measured.take(fit), series.sets, measured.q, split)
                found.append(judge(program, task, measured.take(judged)))
        if done := [case for case in found if case]:
            yield split, done


def main() -> None:
    """Run the chosen programs on the chosen series and write one JSON file per program."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="folder of the measurements")
    parser.add_argument("--programs", default=",".join(PROGRAMS), help="default: all")
    parser.add_argument("--series", default="", metavar="TEXT", help="series whose name contains TEXT")
    parser.add_argument("--splits", default=",".join(SPLITS), help="default: all")
    parser.add_argument("-o", "--out", type=Path, default=FOLDER, metavar="FOLDER")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.programs.split(","):
        program, path = PROGRAMS[name], args.out / f"{name}.json"
        document = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"series": {}}
        for series in (*SERIES, *further_series(args.data)):
            if args.series not in series.arm:
                continue
            for split, found in run_series(program, series, args.data, args.splits.split(",")):
                document["series"].setdefault(series.arm, {})[split] = found
                errors_mm = ", ".join(f"{1e3 * case['position_rms_m']:.3f}" for case in found)
                print(f"{name}: {series.arm}, {split}: {errors_mm} mm", file=sys.stderr, flush=True)
                write(program, document["series"], path)


def write(program: Program, series: dict[str, dict], path: Path) -> None:
    """Write the results of a program; series and splits are in a fixed order."""
    ordered = {
        each.arm: {split: series[each.arm][split] for split in SPLITS if split in series[each.arm]}
        for each in SERIES
        if each.arm in series
    }
    document = {"program": program.title, "version": program.version(), "series": ordered}
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
