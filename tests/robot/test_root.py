"""Chains that begin at any link: the path leads up to the last common link and down to the tip."""

import numpy as np
import pytest
from robots import pinocchio_poses

from dhcal_pin import Chain, select_parameters
from dhcal_pin.io import write_urdf
from dhcal_pin.robot.urdf import read_urdf
from dhcal_pin.ros_packages import resolve_robot_path

HEAD, HAND = "head_2_link", "gripper_left_base_link"


@pytest.fixture(scope="module")
def talos():
    return read_urdf(resolve_robot_path("example:talos_full_v2"))


def test_poses_equal_those_of_pinocchio(talos):
    for root, tip in ((HEAD, HAND), (HAND, HEAD), (HEAD, "base_link"), ("torso_2_link", HAND)):
        chain = Chain.from_urdf(talos, tip, root)
        q = np.random.default_rng(0).uniform(-1, 1, (20, chain.n_joints))
        np.testing.assert_allclose(chain.poses(q), pinocchio_poses(chain, q), atol=1e-12)


def test_a_chain_from_the_root_is_as_before(talos):
    ours, default = Chain.from_urdf(talos, HAND, talos.root), Chain.from_urdf(talos, HAND)
    np.testing.assert_array_equal(ours.origins, default.origins)
    assert ours.n_reversed == 0


@pytest.mark.parametrize(("root", "tip"), [(HEAD, HAND), (HAND, HEAD), (HEAD, "torso_2_link")])
def test_errors_of_reversed_joints_are_written_back(talos, root, tip, tmp_path):
    """The written URDF is the same robot, and a joint offset acts as a change of the joint value."""
    nominal = Chain.from_urdf(talos, tip, root)
    errors = select_parameters(nominal, "placement,offset")
    rng = np.random.default_rng(1)
    chain = errors.at(1e-3 * rng.normal(size=len(errors.parameters)))
    write_urdf(chain, tmp_path / "out.urdf")
    again = Chain.from_urdf(tmp_path / "out.urdf", tip, root)
    q = rng.uniform(-1, 1, (10, chain.n_joints))
    np.testing.assert_allclose(again.poses(q), chain.poses(q), atol=1e-12)
    np.testing.assert_allclose(pinocchio_poses(chain, q), chain.poses(q), atol=1e-12)
    offsets = select_parameters(nominal, "offset")
    x = 1e-2 * rng.normal(size=len(offsets.parameters))
    by_name = {p.name.removesuffix(".offset"): v for p, v in zip(offsets.parameters, x, strict=True)}
    moved = q + np.array([by_name[name] for name in nominal.joint_names])
    np.testing.assert_allclose(offsets.at(x).poses(q), nominal.poses(moved), atol=1e-12)


def test_jacobian_of_reversed_joints_equals_central_differences(talos):
    errors = select_parameters(Chain.from_urdf(talos, HAND, HEAD), "placement,gain")
    rng, h = np.random.default_rng(2), 1e-6
    x = 1e-2 * rng.normal(size=len(errors.parameters))
    chain, bodies, twists = errors.derivative(x)
    q = rng.uniform(-1, 1, (5, chain.n_joints))
    jacobian = chain.tool_jacobian(chain.forward_kinematics(q), bodies, twists)
    for k in range(len(x)):
        step = h * np.eye(len(x))[k]
        up, down = (errors.at(x + s * step).poses(q)[:, :3, 3] for s in (1, -1))
        np.testing.assert_allclose(jacobian[k, :3].T, (up - down) / (2 * h), atol=1e-8)
