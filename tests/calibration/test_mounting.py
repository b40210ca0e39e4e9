"""An arm on a wall: gravity acts against the z axis of the root link of the URDF."""

import re

import numpy as np
import pytest
from robots import UR10
from slow_cases import some_slow

from dhcal_pin import calibrate, se3, select_parameters
from dhcal_pin.measurements import Noise, Position
from dhcal_pin.robot.chain import Chain

MOUNT = """<link name="ground"/><joint name="mount" type="fixed"><parent link="ground"/>
<child link="{}"/><origin xyz="0 0 1" rpy="0 1.5707963 0"/></joint>"""
PLACE = np.array([2.0, 1.0, -0.4, 0.1, -0.2, 0.9])


@pytest.fixture(scope="module")
def on_wall(tmp_path_factory):
    """UR10 whose URDF contains the fixed joint between the ground and the base."""
    text = UR10.read_text()
    root = Chain.from_urdf(UR10, "tool0").root
    path = tmp_path_factory.mktemp("wall") / "wall.urdf"
    path.write_text(re.sub(r"<robot[^>]*>", lambda tag: tag[0] + MOUNT.format(root), text, count=1))
    return Chain.from_urdf(path, "tool0")


@pytest.mark.parametrize("seed", some_slow(range(8), {0}))
def test_the_fixed_joint_of_the_mounting_makes_an_elastic_arm_accurate(on_wall, seed):
    rng = np.random.default_rng(seed)
    errors = select_parameters(on_wall, "minimal,compliance")
    is_compliance = np.array(["compliance" in parameter.name for parameter in errors.parameters])
    n = len(is_compliance)
    x = np.where(is_compliance, -3e-6 * (1 + rng.random(n)), 1e-3 * rng.standard_normal(n))
    true = errors.at(x).with_current_loads()
    true = true.with_base_and_tool(se3.exp6(PLACE), true.tool)
    data = Position.simulate(true, rng.uniform(-2.5, 2.5, (100, 6)), Noise(5e-5), rng)
    q = rng.uniform(-2.5, 2.5, (300, 6))

    def error(nominal):
        fit = calibrate(nominal, data)
        assert fit.verdict.status == "ok"
        difference = true.poses(q)[:, :3, 3] - fit.chain.poses(q)[:, :3, 3]
        return np.sqrt(np.mean(np.sum(difference**2, 1)))

    right, upright = error(on_wall), error(Chain.from_urdf(UR10, "tool0"))
    assert right < 4e-5
    assert upright > 4 * right
