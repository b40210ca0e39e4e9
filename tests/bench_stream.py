"""Peak memory, in MB, of a calibration that streams so many parts: `python tests/bench_stream.py PARTS`."""

import sys
from functools import partial
from pathlib import Path

import numpy as np
from robots import paper

from dhcal_pin.calibration.streaming import calibrate_stream
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.position import Position
from dhcal_pin.robot.chain import Chain

PART = 4096
NOMINAL, ACTUAL = (Chain.from_dh(paper(name)) for name in ("sim_6dof", "sim_6dof_actual"))


def part(seed: int) -> Position:
    """Positions of the paper's arm, made when they are asked for."""
    rng = np.random.default_rng(seed)
    return Position.simulate(ACTUAL, rng.uniform(-3, 3, (PART, 6)), Noise(1e-4), rng)


def main() -> None:
    """Prints the peak."""
    parts = int(sys.argv[1])
    found = calibrate_stream(NOMINAL, lambda: (partial(part, i) for i in range(parts)), "dh")
    assert found.converged
    assert found.n_samples == PART * parts
    # Not getrusage, which counts what the parent held before this program was loaded.
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    print(int(status["VmHWM"].split()[0]) / 1024)


if __name__ == "__main__":
    main()
