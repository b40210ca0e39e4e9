"""Images of an arm that hardly turns its tool, while the arm is calibrated, too.

Camera and board can then move by the same displacement against the arm, and no image changes. The true error
is that of the position of the camera relative to the tool, in arms whose last link is right: images do not
show errors of the last link that move the tool and what it carries together.
"""

from dataclasses import replace

import numpy as np
import pytest
from camera_setups import ARMS, Setup, photograph, simulate, turned_configurations
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.calibration import Result, summary
from dhcal_pin.calibration.cameras.image_checks import (
    _largest_std,
    describe_weak_positions,
    largest_tool_std,
)
from dhcal_pin.estimation.frame_gauge import tool_gauge_covariance
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.estimation.uncertainty import Uncertainty
from dhcal_pin.formatting import Quantity
from dhcal_pin.measurements import CameraCorners
from dhcal_pin.report.json_document import result_to_dict

pytestmark = pytest.mark.usefixtures("uneventful", "untried", "ordered_axes")

AXES = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
# Rotations of the tool: none, up to ±20° about one axis, and up to ±40° about two axes.
NONE, ONE_AXIS, TWO_AXES = np.zeros((1, 3)), np.deg2rad(20) * AXES[:1], np.deg2rad(40) * AXES[:2]


class Photographer:
    """Set-up of a wrong arm with a camera near the pose that its rig states, and images of it."""

    def __init__(self, name: str, seed: int, is_on_wrist: bool):
        self.rng, chain = np.random.default_rng(seed), ARMS[name]()
        errors = select_parameters(chain, "placement")
        last = chain.joint_names[-1]
        std = [
            0.0 if p.name.startswith(f"{last}.") else 1e-3 if p.unit == "m" else 3e-3
            for p in errors.parameters
        ]
        truth = errors.at(std * self.rng.standard_normal(len(std)))
        self.setup: Setup = simulate(
            chain, truth, self.rng, is_on_wrist=is_on_wrist, n_images=1, sigma=0.2, spread=0.05,
            intrinsics_error=0.01,
        )  # fmt: skip
        self.is_on_wrist = is_on_wrist
        self.home = self.setup.images.q[0]

    def take(self, turns: np.ndarray, n_images: int) -> CameraCorners:
        """Take images with rotations up to these, with the pose of the camera as a user measures it."""
        q = turned_configurations(self.setup.nominal, self.home, self.rng, turns)
        images = photograph(self.setup, q, self.rng, n_images)
        true = self.setup.exact.rig.cameras[0].pose
        assert true is not None
        near = true @ se3.transform(se3.exp3(np.array([0.02, -0.01, 0.02])), np.array([0.02, -0.01, 0.01]))
        return images.replace(rig=replace(images.rig, cameras=(replace(images.rig.cameras[0], pose=near),)))

    def camera_error(self, fit: Result) -> float:
        """Return the RMS error of the position of the camera relative to the tool [m]."""
        q = np.unique(fit.data[0].q, axis=0)
        places = []
        for chain, rig in ((fit.chain, fit.rig), (self.setup.truth, self.setup.exact.rig)):
            assert rig is not None
            position = rig.camera_in_end(0)[:3, 3]
            tools = np.tile(np.eye(4), (len(q), 1, 1)) if self.is_on_wrist else chain.poses(q)
            moved = np.swapaxes(tools[:, :3, :3], 1, 2) @ (position - tools[:, :3, 3])[:, :, None]
            places.append(moved[..., 0])
        return float(np.sqrt(np.mean(np.sum((places[0] - places[1]) ** 2, 1))))


@pytest.mark.parametrize("is_on_wrist", some_slow([False, True], {0}))
def test_rotations_mend_what_the_reason_names(is_on_wrist):
    photographer = Photographer("ur10", 0, is_on_wrist)
    images = photographer.take(NONE, 15)
    weak = dh.calibrate(photographer.setup.nominal, images)
    assert weak.hand_eye is None
    assert weak.verdict.status == "caution"
    (reason,) = weak.verdict.reasons
    error = photographer.camera_error(weak)
    assert error > 5e-3
    assert weak.hand_eye_std is not None
    assert 0.4 < error / weak.hand_eye_std < 2.5
    assert reason.startswith("Too few rotations: the tool never turned about a second axis. ")
    assert f"have a standard deviation of {Quantity.error(weak.hand_eye_std, 'm')}, " in reason
    assert "turned by 30° or more about two axes" in reason
    mended = dh.calibrate(photographer.setup.nominal, [images, photographer.take(TWO_AXES, 15)])
    assert mended.verdict.status == "ok"
    assert mended.hand_eye_std is not None
    assert mended.hand_eye_std < 5e-4
    assert photographer.camera_error(mended) < 1e-3
    assert result_to_dict(mended, {}, {})["hand_eye_std_m"] == mended.hand_eye_std
    (note,) = summary.position_notes(mended.hand_eye_std)
    assert f"standard deviation {Quantity.error(mended.hand_eye_std, 'm')}, without" in note


CASES = [(name, is_on_wrist) for name in ("panda", "ur10", "xarm7") for is_on_wrist in (False, True)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "is_on_wrist"), CASES)
def test_verdicts_of_many_set_ups(name, is_on_wrist):
    """Weak rotations are always found, with a standard deviation like the error; large ones never are."""
    ratios = []
    for seed in range(4):
        photographer = Photographer(name, seed, is_on_wrist)
        for turns in (NONE, ONE_AXIS):
            fit = dh.calibrate(photographer.setup.nominal, photographer.take(turns, 20))
            assert any("Too few rotations" in reason for reason in fit.verdict.reasons)
            if fit.hand_eye_std is not None:
                ratios.append(photographer.camera_error(fit) / fit.hand_eye_std)
        fit = dh.calibrate(photographer.setup.nominal, photographer.take(TWO_AXES, 20))
        assert not any("Too few" in reason for reason in fit.verdict.reasons)
        assert photographer.camera_error(fit) < 2e-3
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 2


@pytest.mark.parametrize(("name", "lever"), [("ur10", 0.0), ("panda", 0.088)])
def test_errors_of_the_last_links_imitate_another_tool_pose(name, lever):
    """Only a shift along the last axis and a rotation about it can be imitated.

    The shift is that of the last link, or a rotation about the axis before it, at a distance, that a tilt of
    the last link takes back.
    """
    chain = ARMS[name]()
    errors = select_parameters(chain, "placement,offset")
    std = np.array([p.prior for p in errors.parameters])
    x = np.zeros(len(std))
    found = tool_gauge_covariance(
        Uncertainty.from_errors(errors, x, chain, np.diag(std), np.empty((len(x), 0)))
    )
    length, tilt, zero = (next(p.prior for p in errors.parameters[-7:] if p.name.endswith(end))
                          for end in (".z", ".rz", ".offset"))  # fmt: skip
    rotation = tilt**2 + zero**2
    shift = length**2 + lever**2 / (1 / tilt**2 + 1 / rotation)
    np.testing.assert_allclose(found, np.diag([0, 0, shift, 0, 0, rotation]), rtol=1e-6, atol=1e-12)


def test_known_board_on_the_tool_determines_the_camera():
    photographer = Photographer("ur10", 0, False)
    images = photographer.take(NONE, 20)
    images = images.replace(rig=replace(images.rig, boards=photographer.setup.exact.rig.boards))
    fit = dh.calibrate(photographer.setup.nominal, images, "placement,offset,camera,intrinsics")
    assert fit.hand_eye_std is None
    assert fit.verdict.status == "ok"
    assert photographer.camera_error(fit) < 2e-3


def test_reasons_name_what_is_missing():
    assert describe_weak_positions(1e-3, 2e-4, 0.0) == ""
    assert describe_weak_positions(1e-9, 1e-12, 0.0) == ""
    assert "are unknown" in describe_weak_positions(np.inf, 2e-4, 0.0)
    assert "turned by 2.9° (RMS)" in describe_weak_positions(0.1, 2e-4, 0.05)
    few = describe_weak_positions(0.1, 2e-4, 0.5)
    assert few.startswith("Too few images. ")
    assert few.endswith("Take more images.")
    assert summary.position_notes(None) == summary.position_notes(np.inf) == []


def test_the_largest_standard_deviation_is_that_of_any_direction():
    turn = se3.exp3(np.array([0.4, -0.3, 1.0]))
    blocks = [turn @ np.diag(np.square(std)) @ turn.T for std in ([1e-3, 2e-3, 5e-3], [3e-3, 3e-3, 3e-3])]
    assert _largest_std(blocks) == pytest.approx(5e-3)


def test_poses_that_are_not_estimated_have_no_standard_deviation():
    arm = ARMS["ur10"]()
    rig = simulate(arm, arm, np.random.default_rng(0), is_on_wrist=True, n_images=1, sigma=0.2).exact.rig
    errors = select_parameters(arm, "placement")
    n = len(errors.parameters)
    priors = Uncertainty.from_errors(errors, np.zeros(n), arm, np.diag(errors.priors), np.empty((n, 0)))
    assert largest_tool_std(rig, [], np.empty((0, 0)), priors) is None
