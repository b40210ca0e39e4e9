"""Images of another arm than the one of the joint values are refused for this reason."""

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from camera_setups import ARMS, simulate, wrong_arm
from slow_cases import some_slow

from dhcal_pin import calibrate
from dhcal_pin.calibration.cameras import procedure
from dhcal_pin.calibration.cameras.arm_types import ARM_TYPES
from dhcal_pin.calibration.cameras.image_checks import MIN_DIFFERENCE, _angle_difference
from dhcal_pin.calibration.verdict import _few_images, judge
from dhcal_pin.measurements import Position
from dhcal_pin.plausibility.hypotheses import mend

MESSAGE = r"do not move as the joint values say: the rotations between images differ by [1-9]\d°"


def require_refusal(fit):
    """Check that a result is refused for one reason, and says nothing about causes."""
    assert fit.verdict.status == "refused"
    (reason,) = fit.verdict.reasons
    assert re.search(MESSAGE, reason)
    assert fit.hand_eye is None
    # A correction is made smaller, if at all.
    assert 0 <= fit.shrinkage_factor <= 1


@pytest.mark.parametrize("shift", [-2, -1, 0, 1, 2])
def test_images_that_are_shifted_by_rows_are_related(shift):
    chain = ARMS["ur10"]()
    q = np.random.default_rng(0).uniform(-2, 2, (14, 6))
    # Two rows in three are fitted, and the others held out.
    of_robot, of_images = q[2 + shift : 12 + shift], q[2:12]
    is_fitted = np.arange(10) % 3 < 2
    samples = np.flatnonzero(is_fitted)
    images: Any = SimpleNamespace(q=of_robot, shown_poses=(samples, chain.poses(of_images)[samples]))
    assert _angle_difference(chain, images, of_robot) < 1e-6
    images = SimpleNamespace(q=q, shown_poses=(np.arange(7), chain.poses(q[7:])))
    assert _angle_difference(chain, images, q[:7]) > MIN_DIFFERENCE


@pytest.mark.usefixtures("uneventful", "untried", "ordered_axes")
@pytest.mark.parametrize(("seed", "n_images"), some_slow([(2, 8), (1, 6), (0, 12), (1, 12)], {3}))
def test_images_of_another_arm_are_refused(seed, n_images):
    rng = np.random.default_rng(seed)
    chain = ARMS["ur10"]()
    other = wrong_arm(chain, 1.0, rng)
    setup = simulate(chain, other, rng, is_on_wrist=seed % 2 == 0, n_images=n_images, sigma=0.3)
    require_refusal(calibrate(chain, setup.images))


def with_wrong_joint_values(images, change):
    """Return images with other joint values, which a function makes of those of all images in turn."""
    order = np.unique(images.q, axis=0, return_index=True)[1]
    q = images.q[np.sort(order)]
    changed = {tuple(old): new for old, new in zip(q, change(q), strict=True)}
    return images.resample(np.array([changed[tuple(old)] for old in images.q]))


@pytest.mark.usefixtures("ordered_axes")
@pytest.mark.parametrize(
    ("change", "is_in_order", "cause", "key"),
    [
        (
            lambda q: q * [1, 1, 1, -1, 1, 1],
            False,
            "The sign of joint wrist_1_joint is wrong",
            "sign:wrist_1_joint",
        ),
        pytest.param(
            lambda q: q[:, [0, 1, 2, 4, 3, 5]],
            False,
            "wrist_1_joint and wrist_2_joint are exchanged",
            "swap:wrist_1_joint:wrist_2_joint",
            marks=pytest.mark.slow,
        ),
        (lambda q: np.roll(q, -1, 0), True, "belongs to the joint values one row before", "rows:below"),
        pytest.param(
            lambda q: np.roll(q, 1, 0),
            True,
            "belongs to the joint values one row after",
            "rows:above",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_wrong_joint_values_of_images_are_named_and_mended(change, is_in_order, cause, key):
    """A third of the images is held out; the option that the reason names leads to a good calibration."""
    chain, rng = ARMS["ur10"](), np.random.default_rng(0)
    images = simulate(chain, chain, rng, is_on_wrist=True, n_images=20, sigma=0.2).images
    wrong = with_wrong_joint_values(images, change)
    is_held_out = np.unique(wrong.q, axis=0, return_inverse=True)[1] % 3 == 0
    fit = calibrate(chain, wrong.take(~is_held_out), holdout=wrong.take(is_held_out))
    assert fit.verdict.status == "refused"
    (reason,) = [reason for reason in fit.verdict.reasons if cause in reason]
    # Its consequences are no causes and no reasons of their own.
    assert "In addition" not in reason
    assert not [text for text in fit.verdict.reasons if "converge" in text or "more images" in text]
    assert re.search(rf"--mend {key}[ .]", reason)
    mended = mend(chain, wrong, key)
    assert calibrate(chain, mended).verdict.status == "ok"
    if not is_in_order:
        np.testing.assert_allclose(mended.q, images.q)


@pytest.mark.usefixtures("ordered_axes")
@pytest.mark.parametrize(("name", "joint"), some_slow([("panda", 4), ("ur10", 2), ("xarm7", 5)], {0}))
def test_a_wrong_sign_is_named_where_images_show_six_corners(monkeypatch, name, joint):
    """A pose from six corners has an error of ten milliradians, which no other instrument has."""

    def refuse_to_fit(*args: Any) -> None:
        raise AssertionError("an arm with wrong joint values was fitted again")

    monkeypatch.setattr(procedure, "reweight", refuse_to_fit)
    chain, rng = ARMS[name](), np.random.default_rng(joint)
    arm = wrong_arm(chain, 5e-4, rng)
    images = simulate(chain, arm, rng, is_on_wrist=False, n_images=30, sigma=0.2, n_cameras=2).images
    shown = [
        rng.permutation(np.flatnonzero(images.image == number))[:6] for number in np.unique(images.image)
    ]
    few = images.take(np.sort(np.concatenate(shown)))
    sign = np.where(np.arange(chain.n_joints) == joint, -1, 1)
    fit = calibrate(chain, with_wrong_joint_values(few, lambda q: q * sign))
    assert fit.verdict.status == "refused"
    (reason,) = fit.verdict.reasons
    assert f"The sign of joint {chain.joint_names[joint]} is wrong" in reason
    assert "Something else" not in reason


def test_joint_values_are_moved_by_images_where_the_arm_returns_to_a_configuration():
    chain, visits = ARMS["ur10"](), [0, 1, 0, 2, 3, 0, 4]
    images = simulate(chain, chain, np.random.default_rng(0), is_on_wrist=True, n_images=5, sigma=0.2).images
    q, stops = np.unique(images.q, axis=0, return_inverse=True)
    rows = [np.flatnonzero(stops.reshape(-1) == visit) for visit in visits]
    right = images.take(np.concatenate(rows))
    right = right.replace(rows=np.arange(len(right.rows)))
    place = np.repeat(np.arange(len(visits)), [len(each) for each in rows])
    wrong = right.resample(q[np.roll(visits, -1)][place])
    mended = mend(chain, wrong, "rows:below")
    np.testing.assert_array_equal(mended.q, right.q[place > 0])
    np.testing.assert_array_equal(mended.rows, right.rows[place > 0])


@pytest.mark.usefixtures("untried", "ordered_axes")
def test_lines_of_images_that_do_not_agree_count_their_corners():
    chain, rng = ARMS["ur10"](), np.random.default_rng(3)
    images = simulate(chain, chain, rng, is_on_wrist=True, n_images=40, sigma=0.2).images
    number = np.cumsum(np.any(np.diff(images.q, axis=0, prepend=images.q[:1]) != 0, 1))
    is_wrong = (number >= 15) & (number < 23)
    q = images.q.copy()
    q[is_wrong] += rng.normal(0, 0.3, (40, chain.n_joints))[number[is_wrong]]
    fit = calibrate(chain, images.replace(q=q))
    reason = fit.verdict.reasons[0]
    first, last = images.rows[is_wrong][[0, -1]]
    assert reason.startswith(f"{is_wrong.sum()} outliers follow each other (lines {first} to {last}): ")
    assert f"leave out {is_wrong.sum()} of {len(q)} fitted samples" in reason


@pytest.mark.usefixtures("uneventful", "untried", "ordered_axes")
def test_images_that_are_mostly_outliers_are_refused(monkeypatch):
    chain = ARMS["ur10"]()
    rng = np.random.default_rng(3)
    fit = calibrate(chain, simulate(chain, chain, rng, is_on_wrist=True, n_images=10, sigma=0.3).images)
    for share, status in ((0.4, "caution"), (0.6, "refused")):
        monkeypatch.setattr(type(fit), "n_outliers", int(share * fit.n_samples))
        assert judge(fit).status == status


@pytest.mark.usefixtures("uneventful", "untried", "ordered_axes")
def test_joint_values_of_other_images_are_refused():
    rng = np.random.default_rng(2)
    chain = ARMS["ur10"]()
    images = simulate(chain, chain, rng, is_on_wrist=True, n_images=12, sigma=0.3).images
    q, of_row = np.unique(images.q, axis=0, return_inverse=True)
    require_refusal(calibrate(chain, images.replace(q=rng.uniform(-1.5, 1.5, q.shape)[of_row.reshape(-1)])))


@pytest.mark.parametrize(
    ("n_taken", "n_good", "text"),
    [
        (20, 1, "Only 1 of 20 different images fit"),
        (1, 1, "One image is too few"),
        (6, 5, "5 different images"),
    ],
)
def test_refusal_counts_the_images_that_fit(sim_6dof, n_taken, n_good, text):
    q = np.random.default_rng(0).uniform(-2, 2, (n_taken, 6))
    fit = SimpleNamespace(
        arm_type=ARM_TYPES["low-cost"],
        extension=SimpleNamespace(n_configurations=n_good),
        hand_eye=None,
        chain=sim_6dof,
        data=(Position(q, np.zeros((n_taken, 3))),),
    )
    (finding,) = _few_images(fit)  # pyright: ignore[reportArgumentType]
    assert finding.reason.startswith(text)
