"""Predicted errors of arms that are calibrated with cameras, relative to base and tool.

The predicted errors are compared with true ones. Base and tool of the calibrated robot are fitted to the true
robot at the measured configurations by an optimizer of SciPy, with the freedom that images leave: all of the
base, and the translation along and the rotation about the last axis, in front of the camera or the board.
"""

import numpy as np
import pytest
from camera_setups import ARMS, Setup, simulate, wrong_arm
from scipy.optimize import least_squares
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.calibration import Result
from dhcal_pin.io.sidecar import read_uncertainty

pytestmark = pytest.mark.usefixtures("uneventful", "untried", "ordered_axes")

SETS = "placement,offset,camera,board,intrinsics"


def simulated(seed: int, is_on_wrist: bool) -> tuple[Result, Setup, np.ndarray]:
    """Calibrate a UR10 with errors of 1 mm and 3 mrad; also return the measured configurations."""
    rng, chain = np.random.default_rng(seed), ARMS["ur10"]()
    setup = simulate(
        chain,
        wrong_arm(chain, 1e-3, rng),
        rng,
        is_on_wrist=is_on_wrist,
        n_images=40,
        sigma=0.2,
        intrinsics_error=0.02,
    )
    return dh.calibrate(chain, setup.images, SETS, extend="none"), setup, np.unique(setup.images.q, axis=0)


def true_errors(fit: Result, setup: Setup, measured: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the distances (m,) [m] at q after base and tool are fitted at the measured configurations."""
    found, truth = fit.chain.poses(measured), setup.truth.poses(measured)
    lever = np.sqrt(np.mean(np.sum((found[:, :3, 3] - found[:, :3, 3].mean(0)) ** 2, 1)))

    def moved(y: np.ndarray, poses: np.ndarray) -> np.ndarray:
        base = se3.transform(se3.exp3(y[3:6]), y[:3])
        return base @ poses @ se3.transform(se3.exp3(np.array([0, 0, y[7]])), [0, 0, y[6]])

    def misfit(y: np.ndarray) -> np.ndarray:
        poses = moved(y, found)
        turns = [se3.log3(a.T @ b) for a, b in zip(poses[:, :3, :3], truth[:, :3, :3], strict=True)]
        return np.concatenate([(poses - truth)[:, :3, 3].ravel(), lever * np.ravel(turns)])

    y = least_squares(misfit, np.zeros(8), x_scale=1e-3, method="lm").x
    return np.linalg.norm((moved(y, fit.chain.poses(q)) - setup.truth.poses(q))[:, :3, 3], axis=1)


@pytest.mark.parametrize(
    ("n_seeds", "bounds"), [(2, (0.5, 2.0)), pytest.param(12, (0.8, 1.25), marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("is_on_wrist", some_slow([True, False], {0}))
def test_predicted_errors_are_true_ones(is_on_wrist, n_seeds, bounds):
    """RMS of true over predicted errors, at the measured configurations and all over the workspace."""
    everywhere = np.random.default_rng(9).uniform(-np.pi, np.pi, (300, 6))
    true, predicted = np.zeros((2, n_seeds)), np.zeros((2, n_seeds))
    for seed in range(n_seeds):
        fit, setup, measured = simulated(100 + seed, is_on_wrist)
        assert fit.has_free_frames
        for i, q in enumerate((measured, everywhere)):
            true[i, seed] = np.mean(true_errors(fit, setup, measured, q) ** 2)
            predicted[i, seed] = np.mean(fit.relative.predict(q).position_std ** 2)
            # Relative to the base link, the prediction is that of priors, which images do not reduce.
            assert np.sqrt(np.mean(fit.predict(q).position_std ** 2)) > 5e-3
    ratios = np.sqrt(true.mean(1) / predicted.mean(1))
    assert np.all((ratios > bounds[0]) & (ratios < bounds[1])), ratios


def test_the_prediction_does_not_depend_on_priors_of_the_base(tmp_path):
    """Ten times wider priors of the first joint's origin move base and cameras, and nothing else."""
    arm, truth = ARMS["ur10"](), wrong_arm(ARMS["ur10"](), 1e-3, np.random.default_rng(3))
    q = np.random.default_rng(4).uniform(-1, 1, (25, 6))
    images = dh.CameraCorners.simulate(truth, q, dh.measurements.Noise(2e-4), np.random.default_rng(5))
    priors = {f"shoulder_pan_joint.{axis}": 0.01 for axis in "xyz"}
    fits = [dh.calibrate(arm, images, SETS, extend="none", priors=each) for each in ("default", priors)]
    absolute, relative = (
        [np.sqrt(np.mean(each.predict(q).position_std ** 2)) for each in sides]
        for sides in (fits, [fit.relative for fit in fits])
    )
    assert absolute[1] > 1.2 * absolute[0]
    assert relative[0] < 5e-4
    assert relative[1] == pytest.approx(relative[0], rel=0.02)
    # The sidecar predicts the same.
    dh.write_urdf(fits[0], tmp_path / "out.urdf")
    found = read_uncertainty(tmp_path / "out.calibration.toml", dh.read_robot(tmp_path / "out.urdf", "tool0"))
    assert found is not None
    assert found.has_free_frames
    np.testing.assert_allclose(
        found.relative.predict(q).position_std, fits[0].relative.predict(q).position_std, rtol=1e-6
    )


def test_a_joint_that_never_moved_is_not_taken_for_a_pose_of_the_tool():
    """The images do not determine the zero of such a joint: elsewhere the tool is as unknown as before."""
    arm, rng = ARMS["ur10"](), np.random.default_rng(4)
    q = rng.uniform(-1, 1, (25, 6))
    q[:, 4] = 0.3
    truth = wrong_arm(arm, 1e-3, rng)
    images = dh.CameraCorners.simulate(truth, q, dh.measurements.Noise(2e-4), rng)
    fit = dh.calibrate(arm, images, SETS, extend="none")
    elsewhere = q.copy()
    elsewhere[:, 4] = -1.2
    assert fit.has_free_frames
    assert fit.relative.predict(q).position_std.max() < 5e-4
    assert fit.relative.predict(elsewhere).position_std.max() > 1e-3


def test_poses_in_a_measuring_frame_leave_no_frame_free():
    arm, rng = ARMS["ur10"](), np.random.default_rng(4)
    data = dh.Pose.simulate(arm, rng.uniform(-2, 2, (40, 6)), dh.measurements.Noise(1e-4, 1e-4), rng)
    fit = dh.calibrate(arm, data, "placement,offset,base,tool", extend="none")
    assert fit.rank < len(fit.parameters)
    assert not fit.has_free_frames
    assert fit.relative is fit.uncertainty
