"""Uncertainties in sidecars, which follow from samples and priors, against those that they stand for."""

import re
from dataclasses import replace

import numpy as np
import pytest
from robots import DATA, MAPS, missing
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin.estimation.uncertainty import Uncertainty
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import read_measurements, read_robot, read_uncertainty
from dhcal_pin.robot.sampling import joint_range

B, D = "Series_B/measurements_joint_configurations", "Series_D/measurements_iso_cubes"


def stds(uncertainty: Uncertainty) -> np.ndarray:
    """Return the standard deviations of position and orientation at 1000 configurations of the limits."""
    low, high = joint_range(uncertainty.chain)
    found = uncertainty.predict(np.random.default_rng(1).uniform(low, high, (1000, len(low))))
    return np.array([found.position_std, found.orientation_std])


@pytest.mark.parametrize(
    ("series", "part", "kind"), some_slow([(D, 4, "position"), (D, 1, "pose"), (B, 1, "pose")], [0])
)
def test_sidecar_of_a_real_series_is_small_and_exact(series, part, kind, tmp_path):
    if not DATA.exists():
        missing(f"measurements at {DATA}")
    nominal = read_robot("example:ur10", "tool0")
    data = read_measurements(DATA / f"ipa_ur10/{series}.csv", nominal, columns=MAPS / "ipa_ur10.toml")
    data = data.take(np.s_[::part])
    if kind == "position":
        data = dh.Position(data.q, data.positions())
    fit = dh.calibrate(nominal, data, session="off")
    assert fit.uncertainty.sqrt_covariance.shape[1] > 400
    path, sidecar = tmp_path / "arm.urdf", tmp_path / "arm.calibration.toml"
    dh.write_urdf(fit, path)
    assert sidecar.stat().st_size <= 150_000
    chain = read_robot(path, "tool0")
    read = read_uncertainty(sidecar, chain)
    assert read is not None
    np.testing.assert_allclose(stds(read), stds(fit.uncertainty), rtol=2e-3)
    # Errors of the model hide nothing.
    exact, found = (stds(replace(each, model_std=(0.0, 0.0))) for each in (fit.uncertainty, read))
    np.testing.assert_allclose(found, exact, rtol=2e-3)

    # Damaged tables are errors that name the file.
    text = sidecar.read_text()
    for old, new, words in (
        (r"factor = \S+", "factor = 0", "factor"),
        (r"\nq = '''\n[^']*'''", "", "q is missing"),
        (r"\nq = '''\n[^']*'''", "\nq = '''\nabc\n'''", "compressed array"),
        (r"\nprior = ", "\nadded = ", "TOML"),
        (r"\nq = ", "\nwind = ", "q is missing"),
    ):
        sidecar.write_text(re.sub(old, new, text))
        with pytest.raises(DhcalError, match=words) as caught:
            read_uncertainty(sidecar, chain)
        assert str(sidecar) in str(caught.value)
