"""Images do not show where base and tool are: cameras and boards take their place, and nobody has to act."""

import numpy as np
import pytest
from camera_setups import ARMS, random_setup, wrong_arm

import dhcal_pin as dh
from dhcal_pin.estimation.qr import rank
from dhcal_pin.identifiability import EXPECTED
from dhcal_pin.identifiability.null_space import ObservabilityProbe
from dhcal_pin.measurements import Noise


def simulated(sets: str, unmoved: int | None = None, known: dict[str, float] | None = None) -> dh.Result:
    """Calibrate a UR10 with two cameras that stand still and markers on the tool."""
    arm, rng = ARMS["ur10"](), np.random.default_rng(6)
    q = rng.uniform(-1, 1, (25, 6))
    if unmoved is not None:
        q[:, unmoved] = 0.3
    images = dh.CameraCorners.simulate(wrong_arm(arm, 1e-3, rng), q, Noise(2e-4), rng)
    return dh.calibrate(arm, images, sets, extend="none", known=known)


@pytest.mark.parametrize("robot", ["placement,offset", "minimal,base,tool"])
def test_poses_of_cameras_take_the_place_of_those_of_base_and_tool(robot):
    fit = simulated(f"{robot},camera,board")
    assert fit.rank < len(fit.parameters)
    assert all(text.startswith(EXPECTED) for text in fit.unobservable)
    base, tool = (text for text in fit.unobservable if "by images" in text)
    cameras = "the poses of camera_left and camera_right can take the place of the pose of the base"
    assert cameras in base
    assert "6 combinations" in base
    assert "the pose of board_target can take the place of the pose of the tool" in tool


def test_a_base_that_nothing_replaces_is_observable():
    """With known poses of cameras and board the images show where base and tool are."""
    known = simulated("minimal,camera,board").instruments
    fit = simulated("minimal,base,tool", known=known)
    assert not any("place of the pose" in text for text in fit.unobservable)
    assert not fit.has_free_frames
    assert np.sqrt(np.mean(fit.predict(np.zeros((1, 6))).position_std ** 2)) < 2e-3


def test_a_joint_that_never_moved_still_asks_for_action():
    fit = simulated("minimal,base,tool,camera,board", unmoved=3)
    actions = [text for text in fit.unobservable if not text.startswith(EXPECTED)]
    assert any("wrist_1_joint never moved; " in text and "move this joint" in text for text in actions)


@pytest.mark.parametrize("seed", [8, 20])
def test_more_images_of_the_same_kind_determine_at_least_as_much(seed):
    """Configurations in which no board is in view would say nothing of what images determine."""
    setup = random_setup(seed)
    fit = dh.calibrate(setup.nominal, setup.images, "placement,offset,camera,board,intrinsics")
    system = fit.solution.system
    probe = ObservabilityProbe(fit.problem, fit.x)
    assert rank(probe.full_range) == rank(system.r) == fit.rank
    # The full range of the joints is no remedy for a distortion that images do not determine.
    assert not any("full range of the joints" in text for text in fit.weakly_observable)
