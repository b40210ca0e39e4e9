"""World joint and tool frame in a URDF, as Pinocchio reads them."""

import numpy as np
import pinocchio as pin
import pytest
from robots import nominal_arm

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.robot import Chain, parse_urdf
from dhcal_pin.robot.urdf_edit import with_tool_frame, with_world


@pytest.mark.parametrize("mark", ["\n", "\r\n"])
def test_world_joint_and_tool_frame_have_the_given_poses(mark, sim_6dof):
    rng = np.random.default_rng(0)
    base, tool = se3.exp6(rng.normal(size=6)), se3.exp6(rng.normal(size=6))
    data = sim_6dof.urdf.data.replace(b"\n", mark.encode())
    with_both = with_tool_frame(with_world(data, base), "tool0", "reflector", tool)
    model = pin.buildModelFromXML(with_both.decode())
    pin_data = model.createData()
    q = rng.uniform(-3, 3, (10, 6))
    for row, pose in zip(q, base @ sim_6dof.poses(q) @ tool, strict=True):
        pin.framesForwardKinematics(model, pin_data, row)
        found = pin_data.oMf[model.getFrameId("reflector", pin.FrameType.BODY)].homogeneous
        np.testing.assert_allclose(found, pose, atol=1e-14)
    assert parse_urdf(with_both, "x").root == "world"
    assert with_both.count(mark.encode()) == with_both.count(b"\n")
    assert with_both.startswith(data[: data.rindex(b"</robot>")])


def test_an_existing_world_joint_takes_up_the_base():
    chain = nominal_arm("ur10")
    base = se3.exp6([1.0, 2, 3, 0.1, 0.2, 0.3])
    placed = Chain.from_urdf(parse_urdf(with_world(chain.urdf.data, base), "x"), "tool0")
    q = np.zeros((1, 6))
    np.testing.assert_allclose(placed.poses(q), base @ chain.poses(q), atol=1e-14)


def test_a_tool_frame_with_the_name_of_a_link_is_an_error(sim_6dof):
    with pytest.raises(DhcalError, match="--tool-frame link_3"):
        with_tool_frame(sim_6dof.urdf.data, "tool0", "link_3", np.eye(4))
