"""Residuals of all samples: values against the modelled poses, normalization against the known noise."""

import numpy as np
import pytest
from scipy import stats

from dhcal_pin import se3
from dhcal_pin.calibration import calibrate, split
from dhcal_pin.measurements import Distance, Noise, PlaneContact, Pose, Position, PositionComponents

# Calibrations of arms with large errors, of which nothing asks for mistakes.
pytestmark = pytest.mark.usefixtures("unsuspected")

NOISE = Noise(2e-4, 1e-3)


def joint_positions(chain, m, seed=0):
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (m, chain.n_joints))


@pytest.fixture(scope="module")
def data(sim_6dof_actual):
    rng = np.random.default_rng(1)
    pose, position, components = (
        kind.simulate(sim_6dof_actual, joint_positions(sim_6dof_actual, m, m), NOISE, rng)
        for kind, m in ((Pose, 60), (Position, 80), (PositionComponents, 40))
    )
    return pose, position, components


def test_components_are_measured_minus_modelled(sim_6dof, data):
    fitted, held = split(data, 0.3)
    fit = calibrate(sim_6dof, fitted, "dh", holdout=held)
    table, start = fit.residuals, 0
    assert len(table) == 180
    assert table.is_holdout.tolist() == [False] * fit.n_samples + [True] * (180 - fit.n_samples)
    for item in (*fit.data, *fit.holdout):
        rows, frames = np.arange(start, start := start + len(item.rows)), fit.chain.poses(item.q)
        assert set(table.kind[rows]) == {item.kind}
        np.testing.assert_array_equal(table.line[rows], item.rows)
        residuals = {name: values[rows] for name, values in table.components.items()}
        if isinstance(item, PositionComponents):
            for i, axis in enumerate("xyz"):
                expected = item.values[:, item.axes.index(i)] - frames[:, i, 3] if i in item.axes else np.nan
                np.testing.assert_allclose(residuals[f"position_{axis}"], expected, atol=1e-14)
            continue
        position = np.stack([residuals[f"position_{axis}"] for axis in "xyz"], -1)
        np.testing.assert_allclose(position, item.positions() - frames[:, :3, 3], atol=1e-14)
        np.testing.assert_allclose(table.norms("position")[rows], np.linalg.norm(position, axis=1))
        orientation = np.stack([residuals[f"orientation_{axis}"] for axis in "xyz"], -1)
        if isinstance(item, Pose):
            turned = se3.exp3(orientation) @ frames[:, :3, :3]
            np.testing.assert_allclose(turned, item.poses[:, :3, :3], atol=1e-9)
        else:
            assert np.isnan(orientation).all()
    with pytest.raises(KeyError):
        table.norms("length")


def test_columns_for_a_table_library(sim_6dof, data):
    fit = calibrate(sim_6dof, data[:2], "dh")
    columns = fit.residuals.to_columns()
    assert list(columns) == [
        *("file", "line", "set", "kind", "position_x[m]", "position_y[m]", "position_z[m]"),
        *(
            "orientation_x[rad]",
            "orientation_y[rad]",
            "orientation_z[rad]",
            "normalised",
            "weight",
            "outlier",
        ),
    ]
    assert {len(values) for values in columns.values()} == {140}
    assert set(columns["set"]) == {"fit"}
    assert repr(fit.residuals).startswith("ResidualTable(140 fitted, 0 held out; position_x, ")


@pytest.mark.parametrize("is_stated", [True, False])
def test_normalized_residuals_follow_the_noise(is_stated, sim_6dof, sim_6dof_actual):
    """The squares of the held-out ones sum up to chi squared, whether the noise is stated or estimated."""
    rng = np.random.default_rng(5)
    q = joint_positions(sim_6dof_actual, 400, 7)
    positions = Position.simulate(sim_6dof_actual, q, NOISE, rng).positions()
    data = Position(q, positions, NOISE.position if is_stated else None)
    fitted, held = split(data, 0.5)
    table = calibrate(sim_6dof, fitted, "dh", holdout=held).residuals
    sums = 3 * float(np.sum(table.normalised[table.is_holdout] ** 2))
    # The estimated noise and parameters make the sum uncertain by some percent more than chi squared.
    low, high = stats.chi2(600).ppf([1e-4, 1 - 1e-4])
    assert 0.9 * low < sums < 1.15 * high
    assert np.isnan(table.weight[table.is_holdout]).all()


def test_rejected_samples_have_no_weight(sim_6dof, sim_6dof_actual):
    data = Position.simulate(sim_6dof_actual, joint_positions(sim_6dof, 60), NOISE, np.random.default_rng(2))
    data.values[[7, 30]] += 0.05
    table = calibrate(sim_6dof, data, "dh", loss="tukey").residuals
    assert table.line[table.is_outlier].tolist() == [8, 31]
    assert np.flatnonzero(table.weight == 0).tolist() == [7, 30]
    assert table.normalised[[7, 30]].min() > 100
    assert np.median(table.normalised) == pytest.approx(1, abs=0.3)


def test_kinds_without_a_common_component(sim_6dof, sim_6dof_actual):
    """A plane found anew for its hold-out samples, and distances between two configurations."""
    rng = np.random.default_rng(3)
    data = [
        kind.simulate(sim_6dof_actual, joint_positions(sim_6dof, 40, i), NOISE, rng)
        for i, kind in enumerate((Position, PlaneContact, Distance))
    ]
    fitted, held = split(data, 0.25)
    table = calibrate(sim_6dof, fitted, "dh", holdout=held).residuals
    assert set(table.components) == {*(f"position_{axis}" for axis in "xyz"), "height", "length"}
    for name in ("height", "length"):
        given = ~np.isnan(table.components[name])
        assert given.sum() == 40
        assert np.std(table.components[name][given]) < 5 * NOISE.position
    assert np.isfinite(table.normalised).all()
