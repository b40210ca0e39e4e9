"""Predictions from a sidecar file, against those of the fit and of the parameter covariance."""

import json
from dataclasses import replace

import numpy as np
import pytest
from robots import URDF

from dhcal_pin import se3
from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.calibration.result import Result
from dhcal_pin.cli.main import main
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.estimation.problem import StructuredRows
from dhcal_pin.estimation.uncertainty import MAX_COLUMNS, UNBOUNDED_TOL, Prediction
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import measurement_text, read_measurements
from dhcal_pin.io.dh_file import read_dh
from dhcal_pin.io.robot import read_robot, write_urdf
from dhcal_pin.io.sidecar import Findings, read_uncertainty, sidecar_path, sidecar_text
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.measurements.position import Position
from dhcal_pin.robot import Transmission
from dhcal_pin.robot.chain import Chain

pytestmark = pytest.mark.usefixtures("unsuspected")

AWAY = se3.exp6(np.array([2.0, -1.0, 0.5, 0.3, -0.2, 2.0]))


def covariance_by_differences(fit: Result, q: np.ndarray) -> np.ndarray:
    """Propagate the parameter covariance to the tool by central differences, shape (m, 6, 6)."""
    robot, h = len(fit.errors.parameters), 1e-5
    x, at = fit.x[:robot], fit.chain.poses(q)
    errors = fit.errors
    if fit.chain.transmission is not None:
        # The torques of gravity are those of the written URDF.
        transmission = errors.chain.transmission or Transmission.zero(fit.chain.loads)
        transmission = replace(transmission, loads=fit.chain.transmission.loads)
        errors = replace(errors, chain=errors.chain.with_transmission(transmission))
    columns = []
    for i in range(robot):
        step = np.zeros(robot)
        step[i] = h
        up, down = (errors.at(x + sign * step).poses(q) for sign in (1, -1))
        rotation = (up - down)[:, :3, :3] @ np.swapaxes(at[:, :3, :3], 1, 2)
        angular = np.stack([rotation[:, 2, 1], rotation[:, 0, 2], rotation[:, 1, 0]], -1)
        columns.append(np.concatenate([(up - down)[:, :3, 3], angular], 1) / (2 * h))
    jacobian = np.stack(columns, -1)
    return jacobian @ fit.covariance[:robot, :robot] @ np.swapaxes(jacobian, 1, 2)


def fitted(chain: Chain, sets: str, kind: type = Pose, count: int = 40, **options) -> Result:
    rng = np.random.default_rng(0)
    errors = select_parameters(chain, sets)
    truth = replace(chain, base=AWAY, tool=se3.translation([0.02, 0.01, 0.1]))
    truth = replace(errors, chain=truth).at(
        np.minimum(errors.priors, 1e-3) * rng.standard_normal(len(errors.priors))
    )
    data = kind.simulate(truth, rng.uniform(-1.5, 1.5, (count, 6)), Noise(1e-4, 1e-4), rng)
    return calibrate(chain, data, sets, **options)


SETS = (
    "minimal,base,tool",
    "dh,base,tool",
    "placement,base,tool",
    "minimal,base,tool,gain,harmonics,compliance,coupling",
    "minimal,base,tool,curves",
)


@pytest.mark.parametrize("sets", SETS)
def test_predictions_from_a_file_agree_with_those_of_the_fit(ur10, tmp_path, sets):
    fit = fitted(ur10, sets)
    write_urdf(fit, tmp_path / "out.urdf")
    again = read_robot(tmp_path / "out.urdf", "tool0")
    known = read_uncertainty(sidecar_path(tmp_path / "out.urdf"), again)
    assert known is not None
    q = np.random.default_rng(1).uniform(-3, 3, (200, 6))
    # Joints that moved by less than 10 nm keep their bytes in the URDF.
    mine, theirs = fit.predict(q), known.predict(q)
    np.testing.assert_allclose(theirs.poses, mine.poses, atol=1e-8)
    # Hundreds of columns follow from rounded samples.
    rtol = 1e-7 if len(fit.x) <= MAX_COLUMNS else 1e-5
    np.testing.assert_allclose(theirs.position_std, mine.position_std, rtol=rtol)
    np.testing.assert_allclose(theirs.orientation_std, mine.orientation_std, rtol=rtol)
    size = np.sqrt(np.einsum("mii->mi", mine.covariance))
    assert np.max(np.abs(theirs.covariance - mine.covariance) / (size[:, :, None] * size[:, None])) <= rtol
    # And with the parameter covariance, without body twists.
    wanted = covariance_by_differences(fit, q[:20])
    gap = np.abs(mine.covariance[:20] - wanted) / (size[:20, :, None] * size[:20, None])
    assert gap.max() < 1e-4


def test_errors_that_the_model_lacks_are_added_and_kept_in_the_sidecar(ur10, tmp_path):
    plain = fitted(ur10, "minimal,base,tool").uncertainty
    with_model = replace(plain, model_std=(2e-4, 3e-4))
    q = np.random.default_rng(1).uniform(-3, 3, (20, 6))
    added = with_model.predict(q).covariance - plain.predict(q).covariance
    expected = np.diag([4e-8, 4e-8, 4e-8, 9e-8, 9e-8, 9e-8])
    np.testing.assert_allclose(added, np.tile(expected, (20, 1, 1)), atol=1e-15)
    text = sidecar_text(plain.chain, np.eye(4), plain.chain.urdf, Findings(uncertainty=with_model), {})
    assert text is not None
    (tmp_path / "arm.calibration.toml").write_text(text)
    known = read_uncertainty(tmp_path / "arm.calibration.toml", plain.chain)
    assert known is not None
    assert known.model_std == (2e-4, 3e-4)


def test_undetermined_directions_have_infinite_variance(sim_6dof, tmp_path):
    fit = fitted(sim_6dof, "dh,base", Position, 4, priors="none")
    write_urdf(fit, tmp_path / "out.urdf")
    known = read_uncertainty(sidecar_path(tmp_path / "out.urdf"), read_robot(tmp_path / "out.urdf"))
    assert known is not None
    assert np.sum(known.unbounded_directions**2) > UNBOUNDED_TOL
    q = np.random.default_rng(1).uniform(-3, 3, (50, 6))
    assert np.isinf(known.predict(q).position_std).any()
    np.testing.assert_array_equal(np.isinf(known.predict(q).covariance), np.isinf(fit.predict(q).covariance))


@pytest.fixture
def calibrated(tmp_path, monkeypatch) -> Result:
    """Write a calibrated robot and further measurements of it to a working folder."""
    monkeypatch.chdir(tmp_path)
    fit = fitted(Chain.from_dh(read_dh(URDF / "sim_6dof.dh.toml")), "minimal,base,tool", count=30)
    other = Pose.simulate(fit.chain, np.random.default_rng(5).uniform(-1, 1, (50, 6)), Noise(1e-4, 1e-4),
                          np.random.default_rng(6))  # fmt: skip
    (tmp_path / "other.csv").write_text(measurement_text(other, fit.chain))
    write_urdf(fit, tmp_path / "out.urdf")
    return fit


def test_the_map_of_validate_contains_predicted_and_measured_errors(calibrated, tmp_path):
    assert main(["validate", "out.urdf", "other.csv", "--map", "map.csv", "--json", "v.json"]) == 0
    names, *rows = [line for line in (tmp_path / "map.csv").read_text().splitlines() if line[0] != "#"]
    columns = dict(zip(names.split(","), zip(*(row.split(",") for row in rows), strict=True), strict=True))
    readings = np.array(columns["readings"], int)
    assert readings.sum() == 50
    some = readings > 0
    measured, there = (
        np.array(columns[name])[some].astype(float) for name in ("measured_rms[mm]", "predicted_there[mm]")
    )
    # The cells together have the RMS of all measurements, and the prediction of the fit.
    data = read_measurements("other.csv", calibrated.chain)
    found = json.loads((tmp_path / "v.json").read_text())
    assert found["files"] == {"json": "v.json", "map": "map.csv"}
    whole = 1e3 * found["after"]["position_rms_m"]
    assert np.sqrt(np.average(measured**2, weights=readings[some])) == pytest.approx(whole, rel=1e-9)
    mine = 1e3 * np.sqrt(np.mean(calibrated.predict(data.q).position_std ** 2))
    assert np.sqrt(np.average(there**2, weights=readings[some])) == pytest.approx(mine, rel=1e-9)
    assert {text for text, seen in zip(columns["measured_rms[mm]"], some, strict=True) if not seen} == {""}


def test_validate_writes_the_map_as_html_and_refuses_invalid_options(calibrated, tmp_path, capsys):
    assert main(["validate", "out.urdf", "other.csv", "--map", "map.html"]) == 0
    page = (tmp_path / "map.html").read_text()
    assert page.count("<svg") >= 2
    assert "At the 50 measured positions" in page
    capsys.readouterr()
    before = sorted(tmp_path.iterdir())
    for words, options in (
        ("ending", ["--map", "map.txt"]),
        ("--fit-frames", ["--map", "m.csv", "--fit-frames"]),
        ("is an input", ["--map", "other.csv"]),
    ):
        assert main(["validate", "out.urdf", "other.csv", *options]) == 2
        said = capsys.readouterr().err
        assert words in said
        assert len(said.splitlines()) == 1
    (tmp_path / "out.calibration.toml").rename("away.toml")
    assert main(["validate", "out.urdf", "other.csv", "--map", "m.csv"]) == 2
    assert "[uncertainty]" in capsys.readouterr().err
    (tmp_path / "away.toml").rename("out.calibration.toml")
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("sqrt_covariance = '''", "sqrt_covariance = '''!", "is not base64 text"),
        ("sqrt_covariance = '''", "sqrt_covariance = '''\nAAAA", "does not hold 42 rows"),
        ('"joint_1"', '"shoulder"', "expected the joints of this robot"),
        ("terms = []", 'terms = ["elbow.play"]', "elbow.play"),
        ("terms = []", "", "terms is missing"),
    ],
)
def test_an_invalid_uncertainty_table_is_refused(calibrated, tmp_path, old, new, words):
    side = tmp_path / "out.calibration.toml"
    head, table = side.read_text().split("[uncertainty]")
    assert old in table
    side.write_text(f"{head}[uncertainty]{table.replace(old, new, 1)}")
    with pytest.raises(DhcalError, match=words) as caught:
        read_uncertainty(side, read_robot(tmp_path / "out.urdf"))
    assert str(side) in str(caught.value)


def test_a_world_joint_does_not_change_the_prediction(calibrated, tmp_path):
    """The base link of the written robot is then the link `world`."""
    data = measurement_text(calibrated.data[0], calibrated.chain)
    (tmp_path / "data.csv").write_text(data)
    robot = str(URDF / "sim_6dof.dh.toml")
    args = ["calibrate", robot, "data.csv", "--parameters", "minimal,base,tool", "-o"]
    assert main([*args, "plain.urdf"]) == 0
    assert main([*args, "world.urdf", "--world-joint"]) == 0
    q = np.random.default_rng(2).uniform(-3, 3, (50, 6))
    found = []
    for name in ("plain", "world"):
        known = read_uncertainty(f"{name}.calibration.toml", read_robot(f"{name}.urdf"))
        assert known is not None
        found.append(known.predict(q))
    np.testing.assert_allclose(found[1].poses, found[0].poses, atol=1e-10)
    np.testing.assert_allclose(found[1].position_std, found[0].position_std, rtol=1e-8)


def test_view_draws_the_uncertainty_ellipsoids_of_a_file(calibrated, tmp_path):
    robot = str(URDF / "sim_6dof.dh.toml")
    assert main(["view", robot, "out.urdf", "--data", "other.csv", "--html", "s.html"]) == 0
    scene = json.loads(
        (tmp_path / "s.html").read_text().split('type="application/json">')[1].split("</script>")[0]
    )
    assert len(scene["ellipsoids"]) == 50
    squares = [np.sum(np.square(each["axes"])) for each in scene["ellipsoids"]]
    q = np.array([each["q"] for each in scene["ellipsoids"]])
    np.testing.assert_allclose(np.sqrt(squares), calibrated.predict(q).position_std, rtol=1e-3)


def test_a_variance_below_zero_by_rounding_has_the_root_zero():
    covariance = np.diag([1e-6, 4e-6, 4e-6, -1e-24, 0.0, 0.0])[None]
    found = Prediction(np.eye(4)[None], np.concatenate([covariance, -1e-24 * np.eye(6)[None]]))
    np.testing.assert_allclose(found.position_std, [3e-3, 0.0])
    np.testing.assert_array_equal(found.orientation_std, 0.0)


def test_rows_without_transmission_coefficients_are_their_dense_columns():
    dense = np.random.default_rng(0).normal(size=(4, 3, 5))
    rows = StructuredRows.of(dense, np.empty((0, 3, 5)), [], [], 3)
    flat = dense.reshape(4, -1)
    np.testing.assert_allclose(rows.products(), flat @ flat.T)
