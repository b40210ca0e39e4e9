"""World joint and tool frame written by the command calibrate."""

import numpy as np
import pytest
from robots import UR10

from dhcal_pin import se3
from dhcal_pin.cli.main import main
from dhcal_pin.io import measurement_text, read_robot
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.robot import Chain


@pytest.fixture
def measured(tmp_path):
    """A UR10 somewhere in a hall, with a reflector somewhere on its flange, and its file of poses."""
    robot = tmp_path / "ur10.urdf"
    robot.write_bytes(UR10.read_bytes())
    chain = Chain.from_urdf(robot, "tool0")
    rng = np.random.default_rng(0)
    truth = chain.perturbed_at(
        {0: se3.exp6([1, 2, 0.5, 0.1, 0.2, 2.0]), chain.tool_frame_index: se3.exp6([0.1, 0, 0.05, 0.3, 0, 0])}
        | {2 * j: se3.exp6(1e-3 * rng.normal(size=6)) for j in range(1, 7)}
    )
    q = rng.uniform(-2, 2, (40, 6))
    data = tmp_path / "laser.csv"
    data.write_text(measurement_text(Pose.simulate(truth, q, Noise(), rng), chain))
    return robot, data, truth


def test_calibrate_writes_both_frames_into_the_urdf(measured, tmp_path):
    robot, data, truth = measured
    out = tmp_path / "out.urdf"
    options = ["--tip", "tool0", "--priors", "none", "--world-joint", "--tool-frame", "reflector"]
    assert main(["calibrate", str(robot), str(data), "-o", str(out), *options]) == 0
    q = np.random.default_rng(1).uniform(-2, 2, (30, 6))
    for tip in ("reflector", "tool0"):
        np.testing.assert_allclose(read_robot(out, tip).poses(q), truth.poses(q), atol=1e-9)
    lines = out.read_bytes().splitlines()
    assert set(robot.read_bytes().splitlines()) - set(lines) <= {
        line for line in robot.read_bytes().splitlines() if b"<origin" in line
    }
