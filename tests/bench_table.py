# ruff: noqa: E402
"""All benchmarks in one table of ratios, measured side by side on one core: `python tests/bench_table.py`.

Rivals from PyPI get environments of their own in a folder under the system's temporary one, built once.
CPU time, medians of turns; `--quick` takes fewer turns and smaller cases.
"""

import os

# Before NumPy is loaded: one thread for everybody.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import bench_batch
import bench_calibration
import bench_kernel
import bench_rivals
import numpy as np
from bench_common import Row, clocked, fit_geometry, measured, robots, serial
from bench_rivals import HERE, environment, spoken
from robots import UR10

from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.io import measurement_text
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.position import Position
from dhcal_pin.robot.chain import Chain


def against_ceres(m: int, repeats: int) -> list[Row]:
    """Ceres through pyceres, given our Jacobian, against all of a calibration and against our loop alone."""
    if (python := environment("pyceres")) is None:
        return []
    theirs = subprocess.run(
        [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    # Our own packages first: pyceres needs nothing but NumPy.
    path = os.pathsep.join([str(HERE.parent), str(HERE), sysconfig.get_path("purelib"), theirs])
    found = spoken([sys.executable, HERE / "bench_ceres.py", str(m), str(repeats)], HERE, PYTHONPATH=path)
    assert isinstance(found, list)
    out = []
    for name, whole, alone, by_samples, by_block in found:
        for what, ours, other, wanted in (
            ("calibration: Ceres, a block a sample, our Jacobian", whole, by_samples, "≥ 8"),
            ("calibration: Ceres, one block, our Jacobian", whole, by_block, "≥ 8"),
            ("least squares alone: Ceres, one block, our Jacobian", alone, by_block, "≥ 8"),
        ):
            out.append(Row(f"{what}, {name}, m={m}", ours, other, other / ours, wanted))
    return out


def against_figaroh(m: int, repeats: int) -> list[Row]:
    """Figaroh on a UR10 in a frame that nobody gave, and both errors on 200 poses held out."""
    chain, sets = robots()["UR10, minimal,base,tool"]
    _, _, data = measured(chain, sets, m + 200)
    fit, held = data.take(np.s_[:m]), data.take(np.s_[m:])
    if (found := bench_rivals.figaroh(chain, fit, held)) is None:
        return []
    (ours,) = clocked([lambda: fit_geometry(chain, fit, sets)], repeats)
    mine = 1e3 * fit_geometry(chain, fit, sets).validate(held)["position_rms_m"]
    other = 1e3 * found["holdout"]
    what = f"calibration: figaroh, UR10, m={m} (held out {mine:.3f} mm, figaroh {other:.3f} mm)"
    return [Row(what, ours, found["seconds"], found["seconds"] / ours, "≥ 100")]


def against_pybotics(m: int, repeats: int) -> list[Row]:
    """Pybotics on positions of an arm whose modified DH parameters are unknown; both errors held out."""
    rng = np.random.default_rng(0)
    table = replace(serial(6), convention="modified")
    chain = Chain.from_dh(table)
    errors = select_parameters(chain, "modified-dh")
    real = errors.at(1e-3 * rng.standard_normal(len(errors.parameters)))
    data = Position.simulate(real, rng.uniform(-2.5, 2.5, (m + 200, 6)), Noise(1e-4), rng)
    fit, held = data.take(np.s_[:m]), data.take(np.s_[m:])
    found = bench_rivals.pybotics(table, (fit.q, fit.values), (held.q, held.values), None)
    if found is None:
        return []
    (ours,) = clocked([lambda: fit_geometry(chain, fit, "modified-dh")], repeats)
    mine = 1e3 * fit_geometry(chain, fit, "modified-dh").validate(held)["position_rms_m"]
    other = 1e3 * found["holdout"]
    what = f"calibration: pybotics, modified DH, m={m} (held out {mine:.3f} mm, pybotics {other:.3f} mm)"
    return [Row(what, ours, found["seconds"], found["seconds"] / ours, "≥ 100")]


def start_up(repeats: int) -> list[Row]:
    """`dhcal calibrate` on 1,000 rows against importing pinocchio, numpy and scipy.linalg."""
    chain, sets = robots()["UR10, minimal,base,tool"]
    _, _, data = measured(chain, sets, 1000)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(UR10, folder / "arm.urdf")
        (folder / "data.csv").write_text(measurement_text(data, chain))
        whole = "-m dhcal_pin.cli calibrate arm.urdf data.csv --tip tool0 -o out.urdf".split()
        imports = ["-c", "import pinocchio, numpy, scipy.linalg"]
        times: dict[str, list[float]] = {"ours": [], "theirs": []}
        for _ in range(repeats):
            for key, arguments in (("ours", whole), ("theirs", imports)):
                before = os.times()
                subprocess.run(
                    [sys.executable, *arguments],
                    cwd=folder,
                    env=os.environ | {"PYTHONPATH": str(HERE.parent)},
                    stderr=subprocess.DEVNULL,
                    check=True,
                )
                after = os.times()
                times[key].append(
                    after.children_user
                    - before.children_user
                    + after.children_system
                    - before.children_system
                )
    ours, theirs = (float(np.median(times[key])) for key in ("ours", "theirs"))
    what = "`dhcal calibrate` on 1,000 rows as a multiple of importing pinocchio, numpy and scipy.linalg"
    return [Row(what, ours, theirs, ours / theirs, "≤ 1.8")]


def streamed(samples: int) -> float:
    """Peak memory in MB of a process that calibrates with so many samples, never all in memory."""
    parts = -(-samples // 4096)
    found = spoken([sys.executable, HERE / "bench_stream.py", str(parts)], HERE, PYTHONPATH=str(HERE.parent))
    assert isinstance(found, float)
    return found


def line(row: Row) -> str:
    """A row of the table in Markdown."""
    times = (f"{1e3 * seconds:.3g} ms" for seconds in (row.ours, row.theirs))
    return f"| {row.what} | {' | '.join(times)} | {row.ratio:.3g} | {row.wanted} |"


def main() -> None:
    """Prints the table as it grows, then the growth of an iteration with samples and joints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer turns, smaller cases")
    quick = parser.parse_args().quick
    turns, began = (5 if quick else 15), time.time()
    print("| What | dhcal_pin | other | ratio | wanted |\n| --- | --- | --- | --- | --- |")
    parts: list[tuple[Callable[..., Iterable[Row]], tuple[Any, ...]]] = [
        (bench_kernel.iterations, ((100, 1000, 10000), turns)),
        (bench_kernel.jacobians, (turns,)),
        (bench_calibration.against_scipy, (1000, 1 if quick else 3)),
        (bench_calibration.against_geometry_only, (1000, 1 if quick else 3)),
        (against_ceres, (1000, turns)),
        (against_figaroh, (100 if quick else 1000, turns)),
        (against_pybotics, (100, turns)),
        (bench_batch.rows, (3 if quick else 5,)),
        (start_up, (3 if quick else 7,)),
    ]
    for part, arguments in parts:
        for row in part(*arguments):
            print(line(row), flush=True)
    sizes = (100, 1000, 10000, 100000) if quick else (100, 1000, 10000, 100000, 1000000)
    print(f"\n| µs a sample, Jacobian to triangle | {' | '.join(f'm={m:,}' for m in sizes)} |")
    print("| --- |" + " --- |" * len(sizes))
    for name, micros in bench_kernel.growth(sizes, turns):
        print(f"| {name} | {' | '.join(f'{value:.2f}' for value in micros)} |", flush=True)
    joints = (3, 6, 10, 14)
    print(f"\n| Joints, m=1000 | {' | '.join(map(str, joints))} |\n| --- |" + " --- |" * len(joints))
    print(f"| µs a sample | {' | '.join(f'{v:.2f}' for v in bench_kernel.by_joints(joints, turns))} |")
    many = 1_000_000 if quick else 10_000_000
    few, most = (streamed(samples) for samples in (100_000, many))
    print(f"\nPeak memory of a stream: {few:.0f} MB with 100,000 samples, {most:.0f} MB with {many:,}")
    print(f"\n{time.time() - began:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
