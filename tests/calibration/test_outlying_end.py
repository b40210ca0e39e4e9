"""All images from some image on that are outliers are named, as after a camera that was bumped."""

from math import comb

import numpy as np
import pytest
from camera_setups import ARMS, simulate
from scipy.stats import hypergeom
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin.calibration.cameras import describe_outlying_end
from dhcal_pin.calibration.cameras.image_checks import _outlying_end
from dhcal_pin.calibration.evaluation import compute_errors

pytestmark = pytest.mark.usefixtures("own_loss", "untried", "ordered_axes")


def photograph(seed, n_moved, at_begin=False, n_images=40):
    """Simulate images of which the first or last ones are taken after a motion of the camera by 3 mm."""
    rng, arm = np.random.default_rng(seed), list(ARMS.values())[seed % 3]()
    setup = simulate(arm, arm, rng, is_on_wrist=True, n_images=n_images, sigma=0.2, spread=0.8)
    exact = setup.exact
    true = {p.name: p.nominal for p in exact.instrument_parameters}
    moved = true | {"camera_camera0.x": true["camera_camera0.x"] + 3e-3}
    # Measured minus modelled: what the motion of the camera takes from the image coordinates.
    change = (
        compute_errors(arm, [exact], moved)[0]["pixels"] - compute_errors(arm, [exact], true)[0]["pixels"]
    )
    order = order_of(setup.images)
    chosen = order < n_moved if at_begin else order >= n_images - n_moved
    return arm, setup.images.replace(values=setup.images.values - chosen[:, None] * change)


def order_of(item):
    """Return the place of each sample's image in the order of the rows."""
    first = np.unique(item.image, return_index=True)[1]
    return np.argsort(np.argsort(first))[item.image]


def motions(reasons):
    return [text for text in reasons if "may have moved" in text]


@pytest.mark.parametrize(("count", "is_named"), [(0, False), (1, False), (2, True), (5, True)])
@pytest.mark.parametrize("at_begin", [False, True])
def test_outliers_at_an_end_are_named_unless_chance_explains_them(count, is_named, at_begin):
    _, item = photograph(0, 0, n_images=46)
    place = order_of(item)
    is_outlier = place < count if at_begin else place >= 46 - count
    is_held_out = place % 3 == 1
    parts = [(item.take(part), ~is_outlier[part]) for part in (~is_held_out, is_held_out)]
    found = describe_outlying_end(parts, True)
    assert bool(found) == is_named
    if is_named:
        assert f"the {'first' if at_begin else 'last'} {count} images of camera 'camera0'" in found[0]
        # One of the corners agrees: the image is no outlier.
        agrees = is_outlier & (np.arange(len(place)) == np.flatnonzero(is_outlier)[-1 if at_begin else 0])
        parts = [(item, ~(is_outlier & ~agrees))]
        assert not any(f" {count} images" in text for text in describe_outlying_end(parts, False))


@pytest.mark.parametrize("n_images", [40, 3000])
def test_a_few_images_after_a_motion_may_agree(n_images):
    """One in ten of the images after the motion is no outlier, and one in ten before it is one."""
    place = np.arange(n_images)
    n_moved = n_images // 2
    is_outlying = (place < n_moved) != (place % 10 == 4)
    count, found, chance = _outlying_end(is_outlying.tolist())
    assert (count, found) == (n_moved, n_moved - n_moved // 10)
    expected = hypergeom.sf(found - 1, n_images, is_outlying.sum(), n_moved)
    assert chance == pytest.approx(expected, rel=1e-6)
    assert chance < 1e-5


def test_most_of_the_images_at_an_end_are_named_with_their_number():
    _, item = photograph(0, 0, n_images=46)
    place = order_of(item)
    for n_agreeing, is_named in ((1, True), (2, True), (3, False)):
        is_outlier = (place >= 36) & ~((place < 44) & (place >= 44 - n_agreeing))
        found = "".join(describe_outlying_end([(item, ~is_outlier)], False))
        assert found.startswith(f"All corners of {10 - n_agreeing} of the last 10 images of") == is_named


def test_outliers_everywhere_are_no_motion():
    """Every third image is an outlier, the last two among them."""
    _, item = photograph(0, 0, n_images=40)
    place = order_of(item)
    is_outlier = (place % 3 == 0) | (place >= 38)
    assert comb(15, 2) / comb(40, 2) > 0.1
    assert describe_outlying_end([(item, ~is_outlier)], False) == []


@pytest.mark.parametrize(
    ("seed", "n_moved", "at_begin", "is_estimated"),
    some_slow([(0, 4, False, True), (6, 4, False, True), (2, 4, True, False), (3, 5, False, False)], {0}),
)
def test_a_camera_bumped_near_an_end_is_named_and_its_motion_is_estimated_if_shown(
    seed, n_moved, at_begin, is_estimated
):
    """Half of the images is held out, then none, as the sentence advises."""
    arm, images = photograph(seed, n_moved, at_begin)
    is_held_out = order_of(images) % 2 == 1
    bumped, right = (
        dh.calibrate(
            arm, data.take(~is_held_out), "camera,board,intrinsics", holdout=data.take(is_held_out)
        ).verdict
        for data in (images, photograph(seed, 0)[1])
    )
    assert bumped.status == "caution"
    (found,) = motions(bumped.reasons)
    assert f"{n_moved} images of camera 'camera0'" in found
    assert "Calibrate without hold-out images" in found
    assert right.status == "ok"
    whole = dh.calibrate(arm, images, "camera,board,intrinsics").verdict
    assert whole.status == "caution"
    assert any("The camera moved by" in text for text in whole.reasons) == is_estimated
    assert bool(motions(whole.reasons)) != is_estimated
