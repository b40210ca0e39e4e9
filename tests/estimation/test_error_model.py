"""Definitions of the parameters: the frame and the direction that are stated, against the written URDF."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from robots import paper

from dhcal_pin import se3
from dhcal_pin.calibration import calibrate
from dhcal_pin.estimation import PARAMETER_SETS, select_parameters
from dhcal_pin.estimation.error_model import direction_name
from dhcal_pin.io import urdf_files
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.robot import Chain

STEP = 1e-4


def stated_twist(direction: str) -> np.ndarray:
    """Twist [v, w] of a direction as it is stated, such as "about -z" or "along (0.000, 0.707, 0.707)"."""
    kind, text = direction.split(" ", 1)
    text, _, place = text.partition(" through ")
    if text.startswith("("):
        vector = np.array(text.strip("()").split(","), float)
        vector /= np.linalg.norm(vector)
    else:
        vector = np.eye(3)["xyz".index(text[-1])] * (-1 if text.startswith("-") else 1)
    if kind == "along":
        return np.concatenate([vector, np.zeros(3)])
    point = np.array(place.removesuffix(" m").strip("()").split(","), float) if place else np.zeros(3)
    return np.concatenate([np.cross(point, vector), vector])


def joint_poses(chain: Chain) -> dict[str, np.ndarray]:
    """Pose of each joint in its parent joint, as Pinocchio reads them from the written URDF."""
    data = urdf_files(chain, Path("out.urdf"))[Path("out.urdf")]
    model = pin.buildModelFromXML(data if isinstance(data, str) else data.decode())
    return {name: model.jointPlacements[model.getJointId(name)].homogeneous for name in chain.moving_joints}


@pytest.mark.parametrize("sets", ["minimal", "placement", "offset"])
def test_an_error_moves_the_origin_of_its_joint_as_it_is_stated(sets):
    chain = Chain.from_urdf("example:ur10", "tool0")
    errors = select_parameters(chain, sets)
    nominal = joint_poses(chain)
    for i, parameter in enumerate(errors.parameters):
        frame, direction = parameter.definition(chain)
        joint = parameter.name.split(".")[0]
        assert frame == f"origin of {joint}"
        x = np.zeros(len(errors.parameters))
        x[i] = STEP
        moved = joint_poses(errors.at(x))
        expected = nominal[joint] @ se3.exp6(STEP * stated_twist(direction))
        np.testing.assert_allclose(moved[joint], expected, atol=1e-12)
        for other in set(nominal) - {joint}:
            np.testing.assert_allclose(moved[other], nominal[other], atol=1e-12)


@pytest.mark.parametrize("sets", ["dh", "modified-dh", "hayati"])
def test_an_error_of_a_table_moves_the_links_behind_its_frame_as_it_is_stated(sets):
    chain = Chain.from_urdf("example:ur10", "tool0")
    q = np.array([[0.3, -1.1, 0.8, 0.4, -0.9, 0.2]])
    data = chain.model.createData()
    pin.framesForwardKinematics(chain.model, data, chain.configurations(q)[0])
    errors = select_parameters(chain, sets)
    for i, parameter in enumerate(errors.parameters):
        frame, direction = parameter.definition(chain)
        kind, name = frame.removeprefix("origin of ").removeprefix("link "), frame.split(" ")[0]
        if name == "origin":
            # The frame of the joint before its motion.
            joint = chain.model.getJointId(kind)
            pose = (data.oMi[chain.model.parents[joint]] * chain.model.jointPlacements[joint]).homogeneous
        else:
            pose = data.oMf[chain.model.getFrameId(kind, pin.FrameType.BODY)].homogeneous
        x = np.zeros(len(errors.parameters))
        x[i] = STEP
        expected = pose @ se3.exp6(STEP * stated_twist(direction)) @ se3.inverse(pose) @ chain.poses(q)[0]
        # Directions that are no axes, and points, are stated with three decimals.
        np.testing.assert_allclose(errors.at(x).poses(q)[0], expected, atol=3e-3 * STEP)


def test_every_parameter_of_a_calibration_has_its_frame():
    arm = Chain.from_dh(paper("sim_6dof"))
    rng = np.random.default_rng(0)
    data = Pose.simulate(arm, rng.uniform(-2, 2, (40, 6)), Noise(1e-4, 1e-4), rng)
    fit = calibrate(arm, data, "minimal,base,tool,gain")
    frames = {e.name: (e.frame, e.direction) for e in fit.estimates}
    assert frames["base.x"] == ("measuring frame", "along x")
    assert frames["base.rz"] == ("measuring frame", "about z")
    assert frames["tool.y"] == ("link tool0", "along y")
    assert frames["joint_3.gain"] == ("joint joint_3", "position")
    assert frames["joint_3.rx"] == ("origin of joint_3", "about x")
    assert all(frame and direction for frame, direction in frames.values())


def test_every_set_defines_its_parameters():
    chain = Chain.from_urdf("example:ur10", "tool0")
    for build in PARAMETER_SETS.values():
        for parameter in build(chain):
            assert all(parameter.definition(chain))


def test_directions_are_named_by_axes_or_by_numbers():
    assert direction_name((0, 0, 0, 0, -1, 0)) == "about -y"
    assert direction_name((0, 3, 4, 0, 0, 0)) == "along (0.000, 0.600, 0.800)"
    assert direction_name((0, 0, 0.2, 0, 1, 0)) == "about y through (0.200, 0.000, 0.000) m"
    # Half a degree from an axis is not the axis.
    assert direction_name((1, 0.01, 0, 0, 0, 0)) == "along (1.000, 0.010, 0.000)"
