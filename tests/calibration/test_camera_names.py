"""Images that state another camera than the one that took them are named, with the camera that they fit."""

import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from camera_setups import ARMS, Setup, simulate, wrong_arm
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin.io.rig_file import rig_text
from dhcal_pin.measurements import CameraCorners

pytestmark = pytest.mark.usefixtures("own_loss", "uneventful", "untried", "ordered_axes")

SETS = "camera,board,intrinsics"


def two_cameras(
    name: str,
    seed: int,
    is_on_wrist: bool,
    n_stops: int = 16,
    arm_error: float = 0.0,
    lens_error: float = 0.02,
) -> Setup:
    """Simulate images of one board by two cameras."""
    rng, chain = np.random.default_rng(seed), ARMS[name]()
    size = {"n_images": n_stops, "n_cameras": 2, "intrinsics_error": lens_error}
    truth = wrong_arm(chain, arm_error, rng) if arm_error else chain
    return simulate(chain, truth, rng, is_on_wrist=is_on_wrist, sigma=0.2, **size)


def stops(setup: Setup) -> np.ndarray:
    """Return the number of the stop of the arm of each corner, in the order of the file."""
    changes = np.any(np.diff(setup.images.q, axis=0) != 0, 1)
    return np.concatenate([[0], np.cumsum(changes)])


def with_exchanged(setup: Setup, is_exchanged: np.ndarray) -> CameraCorners:
    """Return images of which some state the other camera."""
    images = setup.images
    camera = np.where(is_exchanged, 1 - images.camera, images.camera)
    names = [f"c{true}_{stop:02}.png" for true, stop in zip(images.camera, stops(setup), strict=True)]
    stated = [f"camera{number}" for number in camera]
    return CameraCorners(images.q, images.values, images.corner, images.rig, stated, image_names=names)


def check_named(fit, setup: Setup, is_exchanged: np.ndarray) -> None:
    """Check that exchanged images, and no others, are named with the camera that took them: all but one."""
    images = setup.images
    named = {}
    for found in fit.wrong_labels:
        assert found.column == "camera"
        named |= dict.fromkeys(found.rows, (found.stated, found.fitting))
    true = {
        int(row): (f"camera{1 - camera}", f"camera{camera}")
        for row, camera in zip(np.flatnonzero(is_exchanged) + 1, images.camera[is_exchanged], strict=True)
    }
    assert named.items() <= true.items()
    photographs = zip(images.camera[is_exchanged], stops(setup)[is_exchanged], strict=True)
    exchanged = {f"c{camera}_{stop:02}.png" for camera, stop in photographs}
    images_named = {image for found in fit.wrong_labels for image in found.images}
    # A few corners near the border of an image may be far from a camera with fewer images.
    assert images_named <= exchanged
    assert len(images_named) >= max(1, len(exchanged) - 1)


CASES = list(product([("ur10", 5, True), ("panda", 4, False), ("xarm7", 7, True)], (1, 3, 5), (True, False)))


@pytest.mark.parametrize(("case", "n_exchanged", "has_both"), some_slow(CASES, {2, 7}))
def test_exchanged_cameras_are_named(case, n_exchanged, has_both):
    """Of some stops, the images of both cameras are exchanged, or one camera took both of them."""
    setup = two_cameras(*case)
    shown = np.unique(stops(setup)[setup.images.camera == 0])
    chosen = np.random.default_rng(case[1]).choice(shown, n_exchanged, replace=False)
    is_exchanged = np.isin(stops(setup), chosen) & (has_both | (setup.images.camera == 0))
    fit = dh.calibrate(setup.nominal, with_exchanged(setup, is_exchanged), SETS)
    check_named(fit, setup, is_exchanged)
    assert fit.verdict.status == "caution"
    assert "Correct the names." in fit.verdict.reasons[0]
    # The remedy helps, and the figures without the images are right.
    right = dh.calibrate(setup.nominal, with_exchanged(setup, np.zeros_like(is_exchanged)), SETS)
    assert right.verdict.status == "ok"
    assert right.wrong_labels == ()
    for rig in (fit.rig, right.rig):
        assert rig is not None
        for camera, true in zip(rig.cameras, setup.exact.rig.cameras, strict=True):
            assert camera.values[:2] == pytest.approx(true.values[:2], rel=5e-3)


@pytest.mark.parametrize("seed", some_slow(range(60, 72), {0}))
def test_right_names_of_an_arm_with_errors_are_not_doubted(seed):
    name = ("ur10", "panda", "xarm7")[seed % 3]
    setup = two_cameras(name, seed, seed % 2 == 0, arm_error=(0.0, 1e-3, 5e-3)[seed // 3 % 3])
    nothing = np.zeros(len(setup.images.rows), bool)
    assert dh.calibrate(setup.nominal, with_exchanged(setup, nothing), SETS).wrong_labels == ()


def test_other_wrong_images_state_the_right_camera():
    setup = two_cameras("panda", 4, False)
    images = with_exchanged(setup, np.zeros(len(setup.images.rows), bool))
    q, numbers = images.q.copy(), stops(setup)
    for first, second in ((2, 9), (5, 12)):
        q[numbers == first], q[numbers == second] = (
            images.q[numbers == second][0],
            images.q[numbers == first][0],
        )
    fit = dh.calibrate(setup.nominal, images.replace(q=q), SETS)
    assert fit.hand_eye is not None
    assert fit.hand_eye.n_wrong_images > 3
    assert fit.wrong_labels == ()
    assert any("do not fit the others" in text for text in fit.verdict.reasons)


def test_a_camera_most_of_whose_images_are_outliers_is_not_written(run, tmp_path, monkeypatch):
    """The fit puts it where the other camera is; the images that led there are named."""
    monkeypatch.chdir(tmp_path)
    setup = two_cameras("panda", 4, False, 24, lens_error=0.05)
    is_exchanged = stops(setup) >= 16
    images = with_exchanged(setup, is_exchanged)
    joints = ",".join(f"{name}[rad]" for name in setup.nominal.joint_names)
    lines = [f"{joints},u[px],v[px],corner,camera,image"]
    for q, pixels, corner, camera, image in zip(
        images.q, images.values, images.corner, images.camera, images.image_names, strict=True
    ):
        numbers = ",".join(repr(float(value)) for value in (*q, *pixels))
        lines.append(f"{numbers},{corner},camera{camera},{image}")
    Path("images.csv").write_text("\n".join(lines))
    boards = [replace(board, type="points", listed_points=board.points) for board in images.rig.boards]
    Path("rig.toml").write_text(rig_text(images.rig.cameras, boards))
    status, _, err = run(
        *("calibrate", "example:panda", "images.csv", "--tip", "panda_link8", "--rig", "rig.toml"),
        *("-o", "out.urdf", "--camera-files", "cam", "--json", "fit.json"),
    )
    assert status == 3, err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fit.json", "images.csv", "rig.toml"]
    first, second, *_ = json.loads(Path("fit.json").read_text())["verdict"]["reasons"]
    assert "images of camera 'camera0' are outliers: it is not calibrated" in first
    assert "state camera camera0 and fit camera1" in second
