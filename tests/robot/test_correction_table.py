"""Tables of joint corrections: a corrected command brings the joint to the value that is meant."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robots import UR10, nominal_arm, random_table

from dhcal_pin.cli.main import main
from dhcal_pin.estimation import select_parameters
from dhcal_pin.exceptions import ConvergenceError
from dhcal_pin.io import measurement_text, read_robot
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.robot import Chain, Conditions, joint_corrections
from dhcal_pin.robot.correction_table import correction_columns

SETS = "gain,harmonics,curves"


def drawn(chain: Chain, sets: str, seed: int = 0) -> Chain:
    errors = select_parameters(chain, sets)
    x = np.random.default_rng(seed).normal(size=len(errors.parameters)) * errors.priors
    return errors.at(x).with_current_loads()


def with_limits(chain: Chain, lower, upper) -> Chain:
    return replace(chain, lower=np.array(lower, float), upper=np.array(upper, float))


@pytest.fixture
def arm() -> Chain:
    return nominal_arm("ur10")


def test_corrected_command_reaches_the_value(arm):
    """By the chain, which evaluates all joints at once."""
    found = drawn(arm, SETS)
    tables = joint_corrections(found)
    assert [table.joint for table in tables] == list(arm.joint_names)
    largest = 0.0
    for i, table in enumerate(tables):
        q = np.zeros((6, len(table.values)))
        q[i] = table.values + table.corrections
        actual = found.actual_positions(Conditions(q.T))[0][i]
        np.testing.assert_allclose(actual, table.values, rtol=0, atol=1e-14)
        largest = max(largest, np.abs(actual - q[i]).max())
    assert largest > 5e-3


def test_table_covers_the_range_in_steps_of_one_degree(arm):
    """Whole degrees and the limits; without usable limits one turn."""
    inf, degree = np.inf, np.deg2rad(1.0)
    lower = [-2 * np.pi, -1.5 * degree, -inf, -1e9, -inf, 3.5]
    upper = [2 * np.pi, 2 * degree, inf, 1e9, 1.0, inf]
    tables = joint_corrections(drawn(with_limits(arm, lower, upper), SETS))
    values = [np.rad2deg(table.values) for table in tables]
    np.testing.assert_allclose(values[0], np.arange(-360, 361), rtol=0, atol=1e-9)
    np.testing.assert_allclose(values[1], [-1.5, -1, 0, 1, 2], rtol=0, atol=1e-9)
    for i in (2, 3):
        np.testing.assert_allclose(values[i], np.arange(-180, 181), rtol=0, atol=1e-9)
    assert values[4][-1] == pytest.approx(np.rad2deg(1.0))
    assert values[5][0] == pytest.approx(np.rad2deg(3.5))
    assert np.ptp(values[5]) == pytest.approx(360)


def test_only_revolute_joints_with_harmonics_have_a_table(arm):
    assert joint_corrections(arm) == []
    assert joint_corrections(drawn(arm, "gain,compliance,coupling")) == []
    table = replace(random_table(np.random.default_rng(0), size=3), prismatic=np.array([False, True, False]))
    found = drawn(Chain.from_dh(table), "gain,curves")
    assert [table.joint for table in joint_corrections(found)] == ["j1", "j3"]


def test_a_curve_that_turns_back_is_refused(arm):
    errors = select_parameters(arm, "curves")
    x = np.zeros(len(errors.parameters))
    x[[p.name for p in errors.parameters].index("elbow_joint.sin32")] = 0.2
    with pytest.raises(ConvergenceError, match="joint 'elbow_joint': the errors are too large"):
        joint_corrections(errors.at(x))
    # This one always rises, by 0.36 at least.
    (table,) = joint_corrections(errors.at(0.1 * x))
    commanded = table.values + table.corrections
    np.testing.assert_allclose(commanded + 0.02 * np.sin(32 * commanded), table.values, atol=1e-14)


def read(path: str) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_calibrate_writes_the_table(capsys, tmp_path, monkeypatch, arm):
    """The table agrees with the sidecar; without harmonics it has only a header, and a warning says why."""
    monkeypatch.chdir(tmp_path)
    robot = str(UR10)
    rng = np.random.default_rng(1)
    truth = drawn(arm, "harmonics")
    data = Pose.simulate(truth, rng.uniform(-2, 2, (60, 6)), Noise(1e-5, 1e-5), rng)
    Path("a.csv").write_text(measurement_text(data, arm, []))

    def run(*args: str) -> tuple[int, str]:
        return main(args), capsys.readouterr().err

    command = (
        "calibrate",
        robot,
        "a.csv",
        "--extend",
        "none",
        "--tip",
        "tool0",
        "-o",
        "out.urdf",
        "--curves",
        "curves.csv",
    )
    status, err = run(*command, "--parameters", "minimal,base,tool,harmonics")
    assert status == 0, err
    text = "use the table of --curves with curves.with_table.urdf: out.urdf is best without it"
    assert text in " ".join(err.split())
    table = read("curves.csv")
    assert list(table[0]) == ["joint", "value[deg]", "correction[deg]"]
    assert len(table) == 5 * 721 + 361
    found = read_robot("out.urdf", "tool0")
    for i, name in enumerate(arm.joint_names):
        rows = [row for row in table if row["joint"] == name]
        value, correction = (np.array([float(row[key]) for row in rows]) for key in list(table[0])[1:])
        q = np.zeros((6, len(rows)))
        q[i] = np.deg2rad(value + correction)
        actual = found.actual_positions(Conditions(q.T))[0][i]
        np.testing.assert_allclose(np.rad2deg(actual), value, rtol=0, atol=1e-11)
    # The robot beside the table, with corrected joint values, is the complete one; that of --output is not.
    pairs = [(float(row["value[deg]"]), float(row["correction[deg]"])) for row in table]
    q = rng.uniform(-2, 2, (50, 6))
    commanded = np.empty_like(q)
    for i, name in enumerate(arm.joint_names):
        own = np.deg2rad([pair for row, pair in zip(table, pairs, strict=True) if row["joint"] == name])
        commanded[:, i] = q[:, i] + np.interp(q[:, i], *own.T)
    Path("out.calibration.toml").rename("sidecar.toml")
    places = [read_robot(path, "tool0").poses(q)[:, :3, 3] for path in ("curves.with_table.urdf", "out.urdf")]
    actual = found.with_base_and_tool(np.eye(4), np.eye(4)).poses(commanded)[:, :3, 3]
    largest = [np.linalg.norm(each - actual, axis=1).max() for each in places]
    assert largest[0] < 1e-6
    assert largest[1] > 1e-4
    status, err = run(*command)
    assert status == 0, err
    assert Path("curves.csv").read_text() == "joint,value[deg],correction[deg]\n"
    assert "warning: the table of --curves has no rows, because no joint has harmonics" in " ".join(
        err.split()
    )
    before = Path("a.csv").read_text()
    status, err = run(*command[:-1], "a.csv")
    assert status == 2
    assert "a.csv: is an input file" in err
    assert Path("a.csv").read_text() == before


def test_columns_have_degrees(arm):
    columns = correction_columns(joint_corrections(drawn(with_limits(arm, [-1] * 6, [1] * 6), "harmonics")))
    assert {len(column) for column in columns.values()} == {6 * (2 + 115)}
    assert columns["value[deg]"][1:4] == [-57.0, -56.0, -55.0]
