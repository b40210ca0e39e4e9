"""Times of common tasks, relative to a reference of NumPy in the same run, against the tracked ratios.

    python tests/bench_baseline.py            exit status 1 if a ratio has grown by more than a third
    python tests/bench_baseline.py --write    write the ratios of this run to bench_baseline.json

The reference is the QR decomposition of a random matrix (6000, 36), as large as the Jacobian of 1,000 poses
of an arm with six joints. Ratios depend less on the machine than times do, but they are compared best on the
same class of machine.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

import numpy as np
from bench_common import clocked, measured, robots

from dhcal_pin import Noise, calibrate, plan, read_measurements
from dhcal_pin.io import measurement_text

BASELINE = Path(__file__).with_name("bench_baseline.json")
# Allowed growth of a ratio.
THRESHOLD = 1 / 3
REPEATS = 9


def tasks(folder: Path) -> dict[str, Callable[[], object]]:
    """Return the tasks by name; the first is the reference."""
    matrix = np.random.default_rng(0).standard_normal((6000, 36))
    found: dict[str, Callable[[], object]] = {"numpy.linalg.qr": lambda: np.linalg.qr(matrix, mode="r")}
    chain, sets = robots()["UR10, minimal,base,tool"]
    _, _, poses = measured(chain, sets, 1000)
    file = folder / "poses.csv"
    file.write_text(measurement_text(poses, chain), encoding="utf-8")
    return found | {
        "forward kinematics of 1,000 poses": lambda: chain.poses(poses.q),
        "read 1,000 poses": lambda: read_measurements(file, chain),
        "calibrate 1,000 poses, geometry, linear": lambda: calibrate(
            chain, poses, sets, extend="none", loss="linear", session="off"
        ),
        "calibrate 1,000 poses, geometry": lambda: calibrate(
            chain, poses, sets, extend="none", session="off"
        ),
        "calibrate 1,000 poses": lambda: calibrate(chain, poses, sets, session="off"),
        "calibrate 1,000 poses, with session": lambda: calibrate(chain, poses, sets),
        "plan 20 poses of 500 candidates": lambda: plan(chain, 20, noise=Noise(1e-4, 1e-4), candidates=500),
    }


def main() -> int:
    """Measure the ratios and compare or write them; return 1 if a ratio has grown too much, else 0."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--write", action="store_true", help="write the ratios as the new baseline")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        named = tasks(Path(folder))
        seconds = clocked(list(named.values()), REPEATS)
    ratios = {name: time / seconds[0] for name, time in list(zip(named, seconds, strict=True))[1:]}
    if args.write:
        rounded = {name: float(f"{ratio:.3g}") for name, ratio in ratios.items()}
        BASELINE.write_text(json.dumps(rounded, indent=2) + "\n", encoding="utf-8")
    baseline = json.loads(BASELINE.read_text(encoding="utf-8"))
    print(f"reference: {next(iter(named))}, {1e3 * seconds[0]:.3g} ms")
    for name, ratio in ratios.items():
        change = ratio / baseline[name] - 1
        print(f"{name:44} {ratio:10.3g}  baseline {baseline[name]:10.3g}  {100 * change:+6.0f} %")
    slower = [name for name, ratio in ratios.items() if ratio > (1 + THRESHOLD) * baseline[name]]
    print(f"slower than the baseline: {', '.join(slower) or 'none'}")
    return bool(slower)


if __name__ == "__main__":
    sys.exit(main())
