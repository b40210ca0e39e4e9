"""Prior widths of lenses: stated values that are right are used, and wrong ones do no harm."""

import numpy as np
import pytest
from camera_setups import ARMS, simulate
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin.calibration.cameras import procedure
from dhcal_pin.calibration.cameras.lens_priors import lens_prior_groups
from dhcal_pin.calibration.evaluation import compute_errors
from dhcal_pin.estimation.initialization import make_problem

pytestmark = pytest.mark.usefixtures("own_loss", "uneventful", "untried", "ordered_axes")

SETS = "camera,board,intrinsics"


def other_images_error(seed, is_right):
    """Return the RMS error of other images after a calibration from eight images [px]."""
    rng, arm = np.random.default_rng(seed), ARMS["paper"]()
    setup = simulate(arm, arm, rng, is_on_wrist=seed % 2 == 0, n_images=40, sigma=0.3)
    rig = setup.exact.rig if is_right else setup.images.rig
    is_fitted = setup.images.image < 8
    fit = dh.calibrate(arm, setup.images.with_rig(rig).take(is_fitted), SETS, loss="linear")
    others = setup.exact.with_rig(rig).take(~is_fitted)
    return np.sqrt(np.mean(compute_errors(fit.chain, [others], fit.instruments)[0]["pixels"] ** 2))


def test_widths_of_a_stated_lens_lie_between_half_a_pixel_and_the_prior():
    arm = ARMS["ur10"]()
    images = simulate(arm, arm, np.random.default_rng(0), is_on_wrist=True, n_images=5, sigma=0.3).images
    assert images.rig.cameras[0].intrinsics == "prior"
    problem = make_problem(dh.select_parameters(arm, "base"), (images,), np.ones(6), {})
    groups = lens_prior_groups(problem)
    np.testing.assert_allclose([1 / group.min_weight for group in groups], [50, 0.3])
    np.testing.assert_allclose([1 / group.max_weight for group in groups], [0.5, 3e-3])


@pytest.mark.parametrize("n_seeds", some_slow([5, 10], {0}))
@pytest.mark.parametrize(("is_right", "most"), [(True, 0.95), (False, 1.05)])
def test_widths_from_the_images_reduce_the_error_of_other_images(is_right, most, n_seeds, monkeypatch):
    """The stated lens is right, or 5 % wrong and without distortion."""
    seeds = range(n_seeds)
    found = [other_images_error(seed, is_right) for seed in seeds]
    monkeypatch.setattr(procedure, "lens_prior_groups", lambda problem: ())
    wide = [other_images_error(seed, is_right) for seed in seeds]
    ratio = np.exp(np.mean(np.log(found) - np.log(wide)))
    assert ratio < most
