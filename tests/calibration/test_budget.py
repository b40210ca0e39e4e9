"""Uncertainty budget of a certificate against known contributions."""

import numpy as np
import pytest
from robots import paper

import dhcal_pin as dh
from dhcal_pin.calibration.presentation.budget import UncertaintyBudget

pytestmark = pytest.mark.usefixtures("unsuspected")

# Standard deviations per axis of the instrument, the arm at equal joint values and the configuration [m].
INSTRUMENT, ARM, MODEL = 5e-5, 1e-4, 2e-4
N_CONFIGURATIONS, N_REPEATS = 80, 3


def budget(sigma, repeats=N_REPEATS, spread=0.0):
    """Return the budget and the error of a calibration; joint values of visits differ by a spread [rad]."""
    rng = np.random.default_rng(1)
    nominal, actual = (dh.Chain.from_dh(paper(name)) for name in ("sim_6dof", "sim_6dof_actual"))
    q = rng.uniform(-2, 2, (N_CONFIGURATIONS, 6))
    errors = MODEL * rng.standard_normal((N_CONFIGURATIONS, 3))
    q = np.repeat(q, repeats, axis=0)
    q += rng.uniform(-spread, spread, q.shape)
    positions = actual.poses(q)[:, :3, 3] + np.repeat(errors, repeats, axis=0)
    for std in (ARM, INSTRUMENT):
        positions += std * rng.standard_normal(positions.shape)
    data = dh.Position(q, positions, sigma)
    fit = dh.calibrate(nominal, data, extend="none", session="off")
    found = UncertaintyBudget.from_fit(fit, fit.comparisons[0])
    assert found is not None
    return found, fit.comparisons[0]


@pytest.mark.parametrize("spread", [0.0, 1e-4])
def test_contributions_are_those_of_the_simulation(spread):
    found, comparison = budget(INSTRUMENT, spread=spread)
    assert comparison.title == "cross-validated"
    assert found.instrument == pytest.approx(np.sqrt(3) * INSTRUMENT, rel=1e-9)
    # 160 degrees of freedom on three axes: the standard deviation of the scatter is 3 %.
    assert found.repeatability == pytest.approx(np.sqrt(3) * ARM, rel=0.15)
    # 80 configurations on three axes, of which a part is fitted.
    assert found.model == pytest.approx(np.sqrt(3) * MODEL, rel=0.2)
    assert 0 < found.parameters < found.model
    assert found.combined == pytest.approx(comparison.after.groups["position"].rms, rel=1e-9)
    rows = found.table(comparison.title).texts
    assert [row[0] for row in rows][1:4] == [
        "sampling: repeatability of the arm",
        "parameters",
        "model error",
    ]
    assert rows[0][1:] == ["0.087 mm", "0.173 mm"]


def test_contributions_that_are_not_known_apart_are_named():
    found, comparison = budget(None, repeats=1)
    assert (found.instrument, found.repeatability) == (None, None)
    rows = found.table(comparison.title).texts
    assert rows[0][1:] == rows[1][1:] == ["not known apart"] * 2
    assert rows[3][0] == "model error, with repeatability and instrument"
    total = np.sqrt(3 * (INSTRUMENT**2 + ARM**2 + MODEL**2))
    assert found.combined == pytest.approx(total, rel=0.25)
    found, comparison = budget(INSTRUMENT, repeats=1)
    rest = found.table(comparison.title).texts[3][0]
    assert rest == "model error, with repeatability and noise above that of the instrument"


def test_json_has_the_contributions_in_metres():
    found, _ = budget(INSTRUMENT)
    assert found.to_dict() == {
        "instrument_m": found.instrument,
        "repeatability_m": found.repeatability,
        "parameters_m": found.parameters,
        "model_m": found.model,
        "combined_m": found.combined,
    }
