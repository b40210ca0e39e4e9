"""A measurement kind of a user with an angle as residual: all results state it in radians or milliradians."""

import json
from typing import ClassVar

import numpy as np
import pytest

import dhcal_pin as dh
from dhcal_pin.calibration.summary import accuracy_table, headline
from dhcal_pin.cli.screens.result_screens import validation_screen
from dhcal_pin.measurements.columns import angle_columns
from dhcal_pin.measurements.groups import Group
from dhcal_pin.measurements.position import PointMeasurement
from dhcal_pin.measurements.validation import validated_array, validated_joint_positions
from dhcal_pin.report import result_to_dict, write_report

# Calibrations of arms with large errors, of which nothing asks for mistakes.
pytestmark = pytest.mark.usefixtures("unsuspected")

NOISE = 2e-4


class Bearing(PointMeasurement):
    """Angle of the tool point about the z axis of the measuring frame."""

    kind = "bearing"
    residual_groups: ClassVar = {"bearing": Group(slice(0, 1), "rad", "bearing error")}
    COLUMNS = angle_columns("angles", "bearing")

    def __init__(self, q, angles, sigma=None):
        q = validated_joint_positions(q, "Bearing")
        super().__init__(q, validated_array(angles, (len(q), 1), "Bearing: angles", "angle"), sigma)

    def model(self, points, u):
        """Return atan2(y, x) and its derivatives."""
        x, y, _ = points[0]
        square = x**2 + y**2
        derivative = np.stack([-y / square, x / square, 0 * x])[None, None]
        return np.arctan2(y, x)[None], derivative, np.empty((0, 1, len(x)))

    @classmethod
    def _simulate(cls, chain, conditions, noise, rng):
        """Return angles with normal noise."""
        q = conditions.q
        x, y, _ = chain.poses(q)[:, :3, 3].T
        angle = np.arctan2(y, x) + noise.rotation * rng.standard_normal(len(q))
        return cls(q, angle[:, None], noise.rotation or None)


@pytest.fixture(scope="module")
def fit(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(3)
    q = rng.uniform(-1, 1, (160, sim_6dof.n_joints))
    keep = np.abs(np.arctan2(*sim_6dof_actual.poses(q)[:, [1, 0], 3].T)) < 2.5
    noise = dh.Noise(1e-4, NOISE)
    data = [
        Bearing.simulate(sim_6dof_actual, q[keep], noise, rng),
        dh.Position.simulate(sim_6dof_actual, q[:60], noise, rng),
    ]
    return dh.calibrate(sim_6dof, data, "dh", extend="none")


def test_json_states_the_angle_in_radians(fit):
    document = json.loads(json.dumps(result_to_dict(fit, {}, {})["after"]))
    assert document["residual_rms"] == pytest.approx(NOISE, rel=0.3)
    assert document["unit"] == "rad"
    assert document["position_rms_m"] == pytest.approx(np.sqrt(3) * 1e-4, rel=0.3)


def test_texts_and_tables_state_the_angle_in_milliradians(fit, tmp_path):
    rows = [row for row in accuracy_table(fit.comparisons).texts if "bearing" in row[1]]
    assert {row[1] for row in rows} == {"bearing error, mrad"}
    alone = headline([fit.comparisons[-1]])
    assert alone.group == "position"
    write_report(fit, tmp_path / "fit.html")
    assert "bearing error" in (tmp_path / "fit.html").read_text().lower()


def test_terminal_states_the_angle_in_milliradians(fit):
    screen = validation_screen("arm", {"calibrated": fit.comparisons[-1].after}, [], [], {}, {})
    cells = {row[0]: row[1] for row in screen.blocks[0].content.texts}
    assert cells["bearing error, RMS"].endswith(" mrad")
    assert float(cells["bearing error, RMS"].split()[0]) == pytest.approx(1e3 * NOISE, rel=0.3)


def test_residuals_and_plots_have_the_unit(fit):
    assert fit.residuals.units["bearing"] == "rad"
    axes = fit.plot_residuals(group="bearing")
    assert "mrad" in axes.get_xlabel() + axes.get_ylabel()


def test_a_name_has_one_unit():
    groups = {"bearing": Group(slice(0, 1), "m", "bearing error")}
    with pytest.raises(TypeError, match="residual group 'bearing': another kind declares it"):
        type("Other", (PointMeasurement,), {"residual_groups": groups})
