"""Differences of two calibrations of simulated arms, against what was changed between them."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from robots import paper
from scipy import stats
from sessions import ANGLE_NOISE, NOISE, Simulation
from slow_cases import some_slow

from dhcal_pin import Result, calibrate, se3
from dhcal_pin.cli.main import main
from dhcal_pin.diagnostics import Calibrated, Difference, compare
from dhcal_pin.diagnostics.difference import STATISTICS
from dhcal_pin.diagnostics.joint_differences import find_part_differences
from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.io import write_urdf
from dhcal_pin.measurements import Measurement, Pose, Position
from dhcal_pin.robot import Chain

pytestmark = pytest.mark.usefixtures("unsuspected")


def calibration(sim: Simulation, data: Measurement) -> Calibrated:
    """Calibrate an arm without curves."""
    return of(calibrate(sim.chain, data, extend="none", session="off"))


def of(fit: Result) -> Calibrated:
    """Return what a sidecar holds of a calibration."""
    return Calibrated(fit.chain, fit.uncertainty, fit.measured_region, "arm.urdf")


@dataclass(frozen=True)
class Case:
    """Two halves of one set of measurements."""

    arm: str
    kind: type[Measurement]
    is_stated: bool = True
    is_by_region: bool = False  # Small and large angles of the second joint, else random halves
    curves: float = 0.0  # Standard deviation of the sine and cosine of q of each joint [rad]; half for 2q
    count: int = 100

    def compare(self, seed: int) -> Difference:
        """Calibrate both halves without joint errors and compare them."""
        sim = Simulation(self.arm, self.count, seed)
        if self.curves:
            sim.add_eccentricities(self.curves)
        data = sim.measure(self.kind)
        if self.is_stated:
            data = with_noise(data)
        order = np.argsort(sim.q[:, 1]) if self.is_by_region else np.arange(self.count)
        return compare(*(calibration(sim, data.take(np.sort(part))) for part in np.array_split(order, 2)))


def with_noise(data: Measurement) -> Measurement:
    """State the noise of simulated measurements."""
    return (
        Position(data.q, data.positions(), NOISE)
        if isinstance(data, Position)
        else Pose(data.q, data.poses, NOISE, ANGLE_NOISE)
    )


def reduced(found: Difference) -> float:
    """Return the reduced chi-square of residuals and parameters."""
    assert found.overall is not None
    return found.overall.reduced


@pytest.mark.parametrize("arm", some_slow(["ur10", "panda", "xarm7"], {0}))
def test_a_calibrated_robot_differs_from_the_nominal_one(arm):
    """Positions do not determine the orientation of the tool, which no distance depends on."""
    sim = Simulation(arm, 60, 3)
    fit = calibration(sim, sim.measure(Position))
    found = compare(Calibrated(sim.chain), fit)
    assert found.verdict == "different"
    assert found.everywhere.expected is not None
    rms = STATISTICS["rms"](found.everywhere.position)
    assert found.everywhere.expected < 5 * NOISE < rms
    # The measured point is compared in both orders.
    exchanged = compare(fit, Calibrated(sim.chain)).everywhere
    assert STATISTICS["rms"](exchanged.position) == pytest.approx(rms, rel=0.01)
    assert exchanged.expected == pytest.approx(found.everywhere.expected, rel=0.01)


# Reduced chi-square of robots that the model describes.
LOW, HIGH = 0.8, 1.25
CASES = [
    Case(arm, kind, is_stated, is_by_region)
    for arm, kind in (("ur10", Position), ("panda", Pose))
    for is_stated in (True, False)
    for is_by_region in (False, True)
]


def test_halves_without_model_error_are_equal():
    found = [CASES[0].compare(seed) for seed in range(3)]
    assert [each.verdict for each in found] == ["equal"] * 3
    assert all(LOW < reduced(each) < HIGH for each in found)


def test_curves_that_the_model_lacks_are_named_in_random_halves():
    for is_stated in (True, False):
        found = Case("ur10", Position, is_stated, curves=2e-4).compare(0)
        assert found.verdict == "different"
        assert "harmonics" in found.lacking
        assert "The model does not explain the arm" in " ".join(found.sentences)
        assert (reduced(found) > HIGH) == is_stated


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=str)
def test_chi_square_of_halves_has_its_distribution(case):
    found = [case.compare(seed) for seed in range(100)]
    values = np.array([reduced(each) for each in found])
    assert np.mean((values > LOW) & (values < HIGH)) >= 0.95
    assert np.mean([each.verdict == "equal" for each in found]) >= 0.97
    of_parameters = [each.of_parameters for each in found if each.of_parameters]
    assert np.mean([each.usual[0] < each.reduced < each.usual[1] for each in of_parameters]) >= 0.85
    assert stats.kstest([each.p_value for each in of_parameters], "uniform").pvalue > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=str)
def test_curves_that_the_model_lacks_are_named(case):
    found = [replace(case, curves=2e-4).compare(seed) for seed in range(40)]
    assert np.mean([each.verdict == "different" and "harmonics" in each.lacking for each in found]) >= 0.95


def test_a_changed_joint_is_named_whatever_base_and_tool_are():
    sim = Simulation("ur10", 60, 3)
    first = calibration(sim, sim.measure(Pose))
    sim.base, sim.tool = sim.tool, sim.base.inverse()
    poses = sim.poses
    sim.poses = lambda q, model=None: poses(q + np.array([0, 0, np.deg2rad(0.1), 0, 0, 0]), model)
    found = compare(first, calibration(sim, sim.measure(Pose)))
    assert found.verdict == "different"
    assert next(iter(found.joints)) == "elbow_joint"
    # The tool moves as the joint turns it, less what base and tool take up.
    assert 0.1e-3 < np.sqrt(np.mean(found.everywhere.position**2)) < 1.5e-3


def test_distances_do_not_depend_on_base_and_tool():
    nominal, actual = (Chain.from_dh(paper(name)) for name in ("sim_6dof", "sim_6dof_actual"))
    found = compare(Calibrated(nominal), Calibrated(actual))
    turn = se3.exp6(np.array([0.3, -0.2, 0.5, 0.1, 2.0, -0.4]))
    moved = compare(Calibrated(nominal), Calibrated(replace(actual, base=turn, tool=turn)))
    np.testing.assert_allclose(moved.everywhere.position, found.everywhere.position, atol=1e-7)
    assert found.verdict == "unknown"
    # No other base and tool are nearer.
    rms = np.sqrt(np.mean(found.everywhere.position**2))
    assert (
        0 < rms < np.sqrt(np.mean(np.sum((nominal.poses(found.q) - actual.poses(found.q))[:, :3, 3] ** 2, 1)))
    )


def test_calibrations_of_base_and_tool_alone_do_not_say_whether_arms_differ():
    sim = Simulation("ur10", 40, 5)
    placed = [of(calibrate(sim.chain, sim.measure(Pose), "base,tool", session="off")) for _ in range(2)]
    arm = calibration(sim, sim.measure(Pose))
    for first, second in (placed, (replace(arm, uncertainty=None), placed[0])):
        found = compare(first, second)
        assert (found.verdict, found.of_parameters, found.everywhere.expected) == ("unknown", None, None)
    assert compare(arm, placed[0]).verdict == "different"


def test_nothing_is_named_if_no_parameter_explains_a_difference():
    parts, zeros = find_part_differences([], lambda zeros: np.ones(4), 6)
    assert parts == {}
    np.testing.assert_array_equal(zeros, np.zeros(6))


def test_joint_errors_that_are_estimated_as_zero_are_compared():
    """A file does not hold coefficients of 0, but their uncertainty."""
    chain = Chain.from_dh(paper("sim_6dof"))
    q = np.random.default_rng(0).uniform(-2, 2, (60, 6))
    fit = calibrate(chain, Pose(q, chain.poses(q), 1e-4, 1e-4), "minimal,base,tool,harmonics", extend="none")
    found = compare(Calibrated(chain), Calibrated(chain, replace(fit.uncertainty, chain=chain)))
    assert found.verdict == "equal"
    assert found.everywhere.expected is not None


def test_other_robots_are_refused(sim_6dof, sim_3dof):
    with pytest.raises(InvalidArgumentError, match="another robot: its joints"):
        compare(Calibrated(sim_6dof), Calibrated(sim_3dof))
    table = paper("sim_6dof")
    other = Chain.from_dh(replace(table, a=np.array(table.a)[::-1] * 2))
    with pytest.raises(InvalidArgumentError, match="mm RMS from that of"):
        compare(Calibrated(sim_6dof), Calibrated(other))


def test_command(tmp_path: Path, capsys):
    sim = Simulation("ur10", 40, 3)
    names = [str(tmp_path / name) for name in ("a.urdf", "b.urdf")]
    for name in names:
        data = sim.measure(Position)
        write_urdf(
            calibrate(sim.chain, Position(data.q, data.positions(), NOISE), extend="none", session="off"),
            name,
        )
    report = tmp_path / "d.html"
    assert main(["diff", *names, "--tip", "tool0", "--report", str(report), "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "equal"
    # Both sidecars state the residuals.
    assert found["degrees_of_freedom"] > found["parameters"]["degrees_of_freedom"] + 100
    assert LOW < found["reduced_chi_square"] < HIGH
    assert found["lacking"] == []
    assert found["joint_space"]["position_rms_m"] < 5 * NOISE
    assert "Distance of the tools" in report.read_text()
    (tmp_path / "other.urdf").write_bytes(
        (Path(__file__).parents[2] / "urdf" / "experiment.urdf").read_bytes()
    )
    assert main(["diff", names[0], str(tmp_path / "other.urdf"), "--json", str(tmp_path / "d.json")]) == 2
    assert not (tmp_path / "d.json").exists()
