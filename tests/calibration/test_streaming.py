"""Streaming: same results as in memory, constant memory, same digits in other processes."""

import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from dhcal_pin.calibration import accuracy, calibrate, calibrate_stream
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import iter_measurements, measurement_text
from dhcal_pin.measurements import Noise, Pose, Position, Wires
from dhcal_pin.parallel import open_executor

pytestmark = pytest.mark.usefixtures("unsuspected")


@pytest.fixture
def laser(tmp_path, sim_6dof_actual):
    """Write a file of 1,000 positions with comments and blank lines; return it and the same data."""
    rng = np.random.default_rng(0)
    data = Position.simulate(sim_6dof_actual, rng.uniform(-3, 3, (1000, 6)), Noise(1e-4), rng)
    lines = measurement_text(data, sim_6dof_actual, ["a tracker"]).splitlines()
    for place in (900, 500, 120, 2):
        lines[place:place] = ["# a pause", ""]
    path = tmp_path / "laser.csv"
    path.write_text("\n".join(lines) + "\n")
    return path, data


def test_stream_gives_the_result_of_the_same_samples_in_memory(laser, sim_6dof):
    path, data = laser
    parts = partial(iter_measurements, path, sim_6dof, 64)
    assert [len(part().rows) for part in parts()] == [64] * 15 + [40]
    found = calibrate_stream(sim_6dof, parts, "minimal,base,tool", priors="none")
    fit = calibrate(sim_6dof, data, "minimal,base,tool", priors="none")
    assert found.converged
    assert found.n_samples == 1000
    assert found.rank == fit.rank
    assert any("tool.rx, tool.ry and tool.rz" in text for text in found.unobservable)
    q = np.random.default_rng(1).uniform(-3, 3, (100, 6))
    off = np.linalg.norm(found.chain.poses(q)[:, :3, 3] - fit.chain.poses(q)[:, :3, 3], axis=1)
    assert np.all(off < 1e-3 * fit.predict(q).position_std)
    assert found.after["position"] == pytest.approx(accuracy(found.chain, [data])["position_rms_m"], rel=1e-9)
    assert 1e-3 < found.before["position"] < 0.1


def test_first_part_determines_unstated_standard_deviations(sim_6dof, sim_6dof_actual):
    """Rotations a hundred times better than the placeholder are weighted as in memory."""
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (2000, 6)), Noise(2e-3, 1e-5), rng)
    plain = Pose(data.q, data.poses)
    parts = [plain.take(np.s_[i : i + 500]) for i in range(0, 2000, 500)]
    found = calibrate_stream(sim_6dof, lambda: parts, "dh", priors="none")
    best = calibrate(sim_6dof, data, "dh", priors="none")
    assert np.abs((found.x - best.x) / best.std).max() < 0.2
    np.testing.assert_allclose(found.std, best.std, rtol=0.1)


def test_other_processes_give_the_same_digits(laser, sim_6dof):
    path, data = laser
    parts = partial(iter_measurements, path, sim_6dof, 100)
    alone = calibrate_stream(sim_6dof, parts, "dh")
    with open_executor(jobs=2) as where:
        np.testing.assert_array_equal(calibrate_stream(sim_6dof, parts, "dh", executor=where).x, alone.x)
        few = data.take(np.s_[:200])
        np.testing.assert_array_equal(
            calibrate(sim_6dof, few, "dh", executor=where).x, calibrate(sim_6dof, few, "dh").x
        )


MEMORY = """
import sys
import numpy as np
sys.path.insert(0, "tests")
from robots import paper
from dhcal_pin import Chain, Noise, Position, calibrate_stream
nominal, actual = (Chain.from_dh(paper(name)) for name in ("sim_6dof", "sim_6dof_actual"))
def part(seed):
    rng = np.random.default_rng(seed)
    return Position.simulate(actual, rng.uniform(-3, 3, (4096, 6)), Noise(1e-4), rng)
from functools import partial
found = calibrate_stream(nominal, lambda: (partial(part, i) for i in range(int(sys.argv[1]))), "dh")
assert found.converged and found.n_samples == 4096 * int(sys.argv[1])
# Not getrusage, which counts what the parent held before this program was loaded.
status = dict(line.split(":", 1) for line in open("/proc/self/status").read().splitlines())
print(int(status["VmHWM"].split()[0]) / 1024)
"""


def peak_memory(parts: int) -> float:
    """Measure the peak memory [MB] of a process that streams this many parts of 4096 positions."""
    run = subprocess.run(
        [sys.executable, "-c", MEMORY, str(parts)], check=True, capture_output=True, text=True
    )
    return float(run.stdout)


def test_memory_does_not_grow():
    assert peak_memory(12) - peak_memory(3) < 4


@pytest.mark.slow
def test_memory_does_not_grow_to_ten_million():
    assert peak_memory(2442) - peak_memory(25) < 16


def test_wrong_streams_are_named(laser, tmp_path, sim_6dof, sim_6dof_actual):
    path, _ = laser
    with pytest.raises(DhcalError, match="no measurements"):
        calibrate_stream(sim_6dof, tuple, "dh")
    with pytest.raises(DhcalError, match="cannot read it"):
        calibrate_stream(sim_6dof, partial(iter_measurements, tmp_path / "none.csv", sim_6dof), "dh")
    rng = np.random.default_rng(0)
    wires = Wires.simulate(sim_6dof_actual, rng.uniform(-3, 3, (40, 6)), Noise(1e-4), rng)
    with pytest.raises(DhcalError, match=r"wire1\.x is unknown; a stream needs"):
        calibrate_stream(sim_6dof, lambda: [wires], "dh")
    lines = path.read_text().splitlines()
    number = next(i for i, line in enumerate(lines) if i > 600 and line[:1] not in "#" and line)
    lines[number] = "x" + lines[number]
    path.write_text("\n".join(lines))
    with pytest.raises(DhcalError, match=rf"laser\.csv:{number + 1}: column 'joint_1'"):
        calibrate_stream(sim_6dof, partial(iter_measurements, path, sim_6dof, 64), "dh")
    path.write_bytes(path.read_bytes().replace(b"\nx", b"\n\xfc"))
    with pytest.raises(DhcalError, match=rf"laser\.csv:{number + 1}: byte 0xfc is not UTF-8; save"):
        calibrate_stream(sim_6dof, partial(iter_measurements, path, sim_6dof, 64), "dh")
