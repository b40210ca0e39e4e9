"""Conditions of samples: from the file to backlash and thermal growth, and back to the sidecar."""

import json
import tomllib
from collections.abc import Sequence

import numpy as np
import pytest
from robots import UR10, nominal_arm

import dhcal_pin as dh
from dhcal_pin.cli.main import main
from dhcal_pin.estimation import select_parameters
from dhcal_pin.estimation.robust import ZERO_WEIGHT, reject_groups, standardized_residuals
from dhcal_pin.exceptions import DhcalError, FileFormatError, InvalidArgumentError, UnknownNameError
from dhcal_pin.io import (
    measurement_text,
    read_measurement_file,
    read_measurements,
    read_robot,
    write_urdf,
)
from dhcal_pin.measurements import Noise, Position
from dhcal_pin.measurements.base import concatenate
from dhcal_pin.robot import Chain, Conditions
from dhcal_pin.robot.conditions import CONDITIONS, concatenate_conditions, directions_in_order

# Arms of the slow tests, and their tips.
TIPS = {"ur10": "tool0", "panda": "panda_hand", "ur5": "tool0"}


@pytest.fixture(scope="module")
def arm() -> Chain:
    return nominal_arm("ur10")


def drawn(arm: Chain, m: int, rng: np.random.Generator) -> Conditions:
    """Random joint positions, directions of approach and temperatures."""
    q = rng.uniform(-2.5, 2.5, (m, arm.n_joints))
    return Conditions(q, approach=rng.choice([-1.0, 1.0], q.shape), temperature=rng.uniform(20, 40, m))


def with_errors(arm: Chain, family: str, size: float, rng: np.random.Generator) -> Chain:
    """The arm with random geometric errors and coefficients of one family."""
    geometry = select_parameters(arm, "minimal,base,tool")
    std = np.array([1e-3 if parameter.unit == "m" else 3e-3 for parameter in geometry.parameters])
    moved = geometry.at(std * rng.normal(size=len(std)))
    errors = select_parameters(moved, family)
    x = size * np.ones(len(errors.parameters))
    return errors.with_current_loads(x).at(x)


# --- the model -------------------------------------------------------------------------------------


def test_backlash_moves_a_joint_by_half_its_width(arm):
    errors = select_parameters(arm, "backlash")
    width = 1e-3 * np.arange(1, 7)
    rng = np.random.default_rng(0)
    conditions = drawn(arm, 20, rng)
    assert conditions.approach is not None
    wanted = arm.poses(conditions.q - width * conditions.approach / 2)
    np.testing.assert_allclose(errors.at(width).poses(conditions), wanted, atol=1e-14)
    np.testing.assert_array_equal(errors.at(width).poses(conditions.q), arm.poses(conditions.q))


def test_thermal_growth_is_that_of_longer_links(arm):
    """By a chain whose joint origins are farther apart."""
    errors = select_parameters(arm, "thermal")
    rate, rise = 1e-5 * np.arange(1, 1 + len(errors.parameters)), 15.0
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (20, arm.n_joints))
    temperature = np.full(len(q), arm.reference_temperature + rise)
    growth = dict(zip([p.name.rsplit(".", 1)[0] for p in errors.parameters], rate * rise, strict=True))
    origins = arm.origins.copy()
    for name, origin in zip(arm.link_names, origins, strict=True):
        origin[:3, 3] *= 1 + growth.get(name, 0.0)
    longer = Chain(**{**arm.__getstate__(), "origins": origins})
    found = errors.at(rate).poses(Conditions(q, temperature=temperature))
    np.testing.assert_allclose(found, longer.poses(q), atol=1e-14)


@pytest.mark.parametrize("family", ["backlash", "thermal"])
def test_derivatives_agree_with_finite_differences(arm, family):
    """By geometric errors and coefficients, at an arm with errors of all kinds."""
    rng = np.random.default_rng(2)
    errors = select_parameters(arm, f"minimal,base,tool,harmonics,{family}")
    x = 1e-3 * rng.normal(size=len(errors.parameters))
    conditions, step = drawn(arm, 10, rng), 1e-6
    chain, bodies, twists = errors.derivative(x)
    found = chain.tool_jacobian(chain.forward_kinematics(conditions), bodies, twists)
    for i, change in enumerate(step * np.eye(len(x))):
        moved = [errors.at(x + sign * change).poses(conditions)[:, :3, 3] for sign in (1, -1)]
        np.testing.assert_allclose(found[i, :3].T, (moved[0] - moved[1]) / (2 * step), atol=1e-7)


def test_payload_of_a_sample_loads_compliant_joints(arm):
    """As the payload of the robot does."""
    errors = select_parameters(arm, "compliance")
    soft = errors.at(np.full(len(errors.parameters), 1e-4))
    q = np.random.default_rng(3).uniform(-2, 2, (5, arm.n_joints))
    carrying = soft.with_payload(dh.robot.Payload(4.0))
    wanted = carrying.with_transmission(
        dh.robot.Transmission(carrying.transmission.coefficients, carrying.loads)  # pyright: ignore
    ).poses(q)
    np.testing.assert_allclose(soft.poses(Conditions(q, payload=np.full(5, 4.0))), wanted, atol=1e-12)


def test_a_joint_that_does_not_move_keeps_its_direction():
    q = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, -0.2], [0.1 + 1e-6, 0.3]])
    np.testing.assert_array_equal(directions_in_order(q), [[0, 0], [1, 0], [1, -1], [1, 1]])


@pytest.mark.parametrize(
    ("condition", "same", "other"),
    [("temperature", 0.2, 4.0), ("payload", 1e-4, 2.0), ("approach", 0.0, 1.0)],
)
def test_samples_of_one_group_have_the_same_conditions(arm, condition, same, other):
    """Six samples of each configuration: two stops of three."""
    rng = np.random.default_rng(2)
    data = Position.simulate(arm, np.repeat(rng.uniform(-2, 2, (9, 6)), 6, 0), Noise(1e-4), rng)
    configurations = data.sample_groups
    timed = data.with_conditions(time=np.arange(54.0))
    np.testing.assert_array_equal(timed.sample_groups, configurations)
    stop = np.arange(54) // 3
    values = 20 * (condition == "temperature") + other * (stop % 2) + same * (np.arange(54) % 2)
    if condition == "approach":
        values = np.repeat(values[:, None], 6, 1)
    groups = timed.with_conditions(**{condition: values}).sample_groups
    np.testing.assert_array_equal(groups, 2 * configurations + stop % 2)


def test_a_wrong_stop_is_rejected_without_the_other_samples_of_its_configuration(arm):
    """Of 40 configurations with two directions of approach, five samples each, one stop is wrong."""
    rng = np.random.default_rng(0)
    q = np.repeat(rng.uniform(-3, 3, (40, 6)), 10, axis=0)
    approach = np.tile(np.repeat([1.0, -1.0], 5)[:, None], (40, 6))
    data = Position.simulate(arm, q, Noise(1e-4), rng).with_conditions(approach=approach)
    residual = rng.normal(size=(3, 400))
    residual[:, :5] += 3.0
    weights = np.where(np.arange(400) < 3, ZERO_WEIGHT, 1.0)
    rejected = np.flatnonzero(reject_groups(weights, standardized_residuals(residual), data) <= ZERO_WEIGHT)
    np.testing.assert_array_equal(rejected, range(5))


def test_joined_samples_keep_the_conditions_that_all_of_them_have(arm):
    conditions = drawn(arm, 4, np.random.default_rng(13))
    positions = arm.poses(conditions.q)[:, :3, 3]
    plain = Position(conditions.q, positions)
    assert conditions.temperature is not None
    warm = plain.with_conditions(temperature=conditions.temperature)
    both = concatenate([warm, warm.with_conditions(time=np.arange(4))])
    assert both.recorded is not None
    assert both.recorded.names == {"temperature"}
    np.testing.assert_array_equal(both.recorded.temperature, np.tile(conditions.temperature, 2))
    assert concatenate([warm, plain]).recorded is None


# --- selection -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("family", "size"), [("backlash", 3.5e-4), ("thermal", 2e-5)])
def test_family_is_selected_and_improves_the_arm(arm, family, size):
    rng = np.random.default_rng(4)
    truth = with_errors(arm, family, size, rng)
    data = Position.simulate(truth, drawn(arm, 100, rng), Noise(5e-5), rng)
    more = Position.simulate(truth, drawn(arm, 400, rng), Noise(1e-9), rng)
    fit, plain = dh.calibrate(arm, data), dh.calibrate(arm, data, extend="none")
    assert fit.extension is not None
    assert family in fit.extension.families
    errors = [one.validate(more)["position_rms_m"] for one in (fit, plain)]
    assert errors[0] < 0.4 * errors[1]


@pytest.mark.slow
@pytest.mark.parametrize("robot", TIPS)
@pytest.mark.parametrize(("family", "size"), [("backlash", 3.5e-4), ("backlash", 3.5e-3), ("thermal", 2e-5)])
def test_families_are_selected_in_95_percent_and_remove_80_percent_of_their_error(robot, family, size):
    """The error that the family causes is what is above that of the same arm without it, in squares."""
    arm = nominal_arm(robot, TIPS[robot])
    selected, removed = 0, []
    for seed in range(20):
        errors = []
        for scale in (size, 0.0):
            rng = np.random.default_rng(seed)
            truth = with_errors(arm, family, scale, rng)
            data = Position.simulate(truth, drawn(arm, 100, rng), Noise(5e-5), rng)
            more = Position.simulate(truth, drawn(arm, 400, rng), Noise(1e-9), rng)
            fits = [dh.calibrate(arm, data, extend=extend) for extend in ("auto", "none")]
            errors.append([fit.validate(more)["position_rms_m"] ** 2 for fit in fits])
            if scale:
                extension = fits[0].extension
                selected += extension is not None and family in extension.families
        caused = errors[0][1] - errors[1][1]
        left = max(errors[0][0] - errors[1][1], 0.0)
        removed.append(1 - np.sqrt(left / caused))
    assert selected >= 19
    assert np.median(removed) >= 0.8


@pytest.mark.slow
def test_neither_family_is_selected_on_200_arms_without_them():
    for seed in range(200):
        robot, rng = [*TIPS][seed % 3], np.random.default_rng(seed)
        arm = nominal_arm(robot, TIPS[robot])
        truth = with_errors(arm, "backlash", 0.0, rng)
        data = Position.simulate(truth, drawn(arm, 100, rng), Noise(5e-5), rng)
        extension = dh.calibrate(arm, data).extension
        assert extension is None or not {"backlash", "thermal"} & set(extension.families), seed


@pytest.mark.parametrize("family", ["backlash", "thermal"])
def test_a_named_family_without_its_condition_is_refused(arm, family):
    q = np.random.default_rng(5).uniform(-2, 2, (30, 6))
    data = Position(q, arm.poses(q)[:, :3, 3])
    with pytest.raises(InvalidArgumentError, match=f"'{family}' needs the .* which no measurement states"):
        dh.calibrate(arm, data, extend=family)
    with pytest.raises(InvalidArgumentError, match=f"'{family}' needs the"):
        dh.calibrate(arm, data, f"minimal,base,tool,{family}")


# --- files -----------------------------------------------------------------------------------------


def test_files_and_sidecar_preserve_conditions_and_coefficients(arm, tmp_path):
    rng = np.random.default_rng(6)
    conditions = drawn(arm, 60, rng)
    truth = with_errors(with_errors(arm, "backlash", 1e-3, rng), "thermal", 2e-5, rng)
    data = Position.simulate(truth, conditions, Noise(5e-5), rng)
    (tmp_path / "data.csv").write_text(measurement_text(data, arm))
    read = read_measurements(tmp_path / "data.csv", arm)
    assert read.recorded is not None
    np.testing.assert_array_equal(read.recorded.approach, conditions.approach)
    np.testing.assert_array_equal(read.recorded.temperature, conditions.temperature)
    write_urdf(truth, tmp_path / "truth.urdf")
    again = read_robot(tmp_path / "truth.urdf", "tool0")
    np.testing.assert_allclose(again.poses(conditions), truth.poses(conditions), atol=1e-9)
    sidecar = tomllib.loads((tmp_path / "truth.calibration.toml").read_text())
    assert sidecar["joint"]["elbow_joint"]["backlash_rad"] == 1e-3
    assert sidecar["thermal"]["per_kelvin"]["forearm_link"] == 2e-5
    assert sidecar["thermal"]["reference_degc"] == arm.reference_temperature


def text(arm: Chain, **columns: Sequence[object]) -> str:
    """A file of positions with further columns."""
    q = np.random.default_rng(7).uniform(-2, 2, (3, 6))
    positions = arm.poses(q)[:, :3, 3]
    names = [f"{name}[rad]" for name in arm.joint_names]
    lines = [",".join([*names, "x[m]", "y[m]", "z[m]", *columns])]
    for i in range(3):
        lines.append(",".join(map(str, [*q[i], *positions[i], *(values[i] for values in columns.values())])))
    return "\n".join(lines) + "\n"


def test_rows_with_a_time_are_in_order(arm, tmp_path):
    (tmp_path / "data.csv").write_text(text(arm, **{"time[ms]": [0, 500, 1500]}))
    recorded = read_measurements(tmp_path / "data.csv", arm).recorded
    assert recorded is not None
    assert recorded.time is not None
    assert recorded.approach is not None
    np.testing.assert_allclose(recorded.time, [0, 0.5, 1.5])
    np.testing.assert_array_equal(recorded.approach[1:], np.sign(np.diff(recorded.q, axis=0)))
    (tmp_path / "data.csv").write_text("# rows: in order\n" + text(arm))
    recorded = read_measurements(tmp_path / "data.csv", arm).recorded
    assert recorded is not None
    assert recorded.order is not None
    assert recorded.order.tolist() == [0, 1, 2]
    (tmp_path / "data.csv").write_text(text(arm))
    assert read_measurements(tmp_path / "data.csv", arm).recorded is None


def test_directions_come_from_skipped_rows_too(arm, tmp_path):
    """The instrument lost the target in some rows; in one row the joint values are missing."""
    rng = np.random.default_rng(8)
    data = Position.simulate(arm, rng.uniform(-2, 2, (12, 6)), Noise(5e-5), rng)
    wanted = directions_in_order(data.q)
    names, *rows = (line.split(",") for line in measurement_text(data, arm).splitlines())
    for row in (3, 4, 7):
        rows[row][names.index("y[m]")] = "nan"
    rows[9][0] = "nan"
    lines = [",".join(row) for row in (names, *rows)]
    (tmp_path / "data.csv").write_text("\n".join(["# rows: in order", *lines]))
    recorded = read_measurement_file(tmp_path / "data.csv", arm, skip_bad_rows=True).data.recorded
    assert recorded is not None
    kept = [0, 1, 2, 5, 6, 8, 10, 11]
    # Nobody knows from where the arm came to the row behind missing joint values.
    wanted[10] = 0
    np.testing.assert_array_equal(recorded.approach, wanted[kept])


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        (
            {"approach_elbow_joint": [1, 0, 2]},
            "data.csv:4: column 'approach_elbow_joint': 2 is not a direction",
        ),
        (
            {"approach_elbow_joint": [0.5, 0, 1]},
            "data.csv:2: column 'approach_elbow_joint': 0.5 is not a dir",
        ),
        ({"time[s]": [0, 2, 1]}, "data.csv:4: column 'time': is earlier than the row before"),
        ({"temperature[degC]": [20, 151, 20]}, "data.csv:3: column 'temperature': 151 is not plausible"),
        ({"temperature[degC]": [20, "", 20]}, "data.csv:3: column 'temperature' is empty"),
        (
            {"temperature[K]": [290, 290, 290]},
            "column 'temperature' has unit 'K'; write one of temperature[degC]",
        ),
        (
            {"payload[kg]": [1, 1e5, 1.1e5]},
            "data.csv:4: column 'payload': 110000 is not plausible; expected a number from 0 to 100000",
        ),
        (
            {"payload[kg]": [1, -1, 1]},
            "data.csv:3: column 'payload': -1 is not plausible; expected a number from 0",
        ),
        (
            {"approach_elbow": [1, 1, 1]},
            "column 'approach_elbow' is not a condition; the conditions are time[s],",
        ),
        ({"temperatur[degC]": [20, 20, 20]}, "did you mean 'temperature'?"),
    ],
)
def test_wrong_conditions_are_named_in_one_line(arm, columns, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data.csv").write_text(text(arm, **columns))
    with pytest.raises((FileFormatError, UnknownNameError)) as caught:
        read_measurements("data.csv", arm)
    assert words in str(caught.value)
    robot = str(UR10)
    assert main(["calibrate", robot, "data.csv", "--tip", "tool0", "-o", "out.urdf"]) == 2
    err = capsys.readouterr().err
    assert words in " ".join(err.split())
    assert not (tmp_path / "out.urdf").exists()


def test_unknown_conditions_of_python_are_refused(arm):
    q = np.zeros((2, 6))
    data = Position(q, arm.poses(q)[:, :3, 3])
    with pytest.raises(UnknownNameError, match="unknown condition 'humidity'; choose from time, approach"):
        data.with_conditions(humidity=[1, 2])
    with pytest.raises(InvalidArgumentError, match=r"temperature has shape \(3,\); expected \(2,\)"):
        data.with_conditions(temperature=[1, 2, 3])
    with pytest.raises(InvalidArgumentError, match="approach in row 2: 3 is not a direction"):
        data.with_conditions(approach=[[0] * 6, [3] * 6])
    with pytest.raises(InvalidArgumentError, match="time in row 2: is earlier than the row before"):
        data.with_conditions(time=[1.0, 0.0])
    # Several targets are measured at the same time.
    np.testing.assert_array_equal(data.with_conditions(time=[1.0, 1.0]).conditions().time, 1.0)


def test_conditions_go_through_the_command_line(arm, tmp_path, monkeypatch, capsys):
    """Calibrated and validated with temperatures, the arm is as good as its noise."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(8)
    truth = with_errors(arm, "thermal", 3e-5, rng)
    for name, m in (("fit.csv", 100), ("other.csv", 50)):
        data = Position.simulate(truth, drawn(arm, m, rng), Noise(2e-5), rng)
        (tmp_path / name).write_text(measurement_text(data, arm))
    robot = str(UR10)
    assert main(["calibrate", robot, "fit.csv", "--tip", "tool0", "-o", "out.urdf", "--quiet"]) == 0
    assert main(["validate", "out.urdf", "other.csv", "--json", "v.json", "--quiet"]) == 0
    assert json.loads((tmp_path / "v.json").read_text())["after"]["position_rms_m"] < 6e-5
    sidecar = tomllib.loads((tmp_path / "out.calibration.toml").read_text())
    assert abs(sidecar["thermal"]["per_kelvin"]["forearm_link"] - 3e-5) < 1e-5
    capsys.readouterr()


def test_kinds_that_move_the_joints_cannot_be_simulated_with_conditions(arm):
    rng = np.random.default_rng(9)
    with pytest.raises(DhcalError, match="point: cannot be simulated with conditions"):
        dh.measurements.KINDS["point"].simulate(arm, drawn(arm, 8, rng), Noise(), rng)


# --- compensation ----------------------------------------------------------------------------------


def test_compensated_targets_are_reached_under_their_conditions(arm):
    rng = np.random.default_rng(10)
    truth = with_errors(with_errors(arm, "backlash", 2e-3, rng), "thermal", 2e-5, rng)
    conditions = drawn(arm, 12, rng)
    wanted = truth.poses(0.5 * conditions.q)
    found = dh.compensate(arm, truth, wanted, 0.5 * conditions.q, conditions=conditions)
    reached = np.flatnonzero(found.reached)
    assert len(reached) >= 10
    there = Conditions(found.q, approach=conditions.approach, temperature=conditions.temperature)[reached]
    np.testing.assert_allclose(truth.poses(there), wanted[reached], atol=1e-9)
    # Without its conditions a solution misses its target.
    assert np.abs(truth.poses(found.q[reached])[:, :3, 3] - wanted[reached, :3, 3]).max() > 1e-4


def test_targets_in_a_file_have_conditions(arm, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    truth = with_errors(arm, "backlash", 2e-3, np.random.default_rng(11))
    write_urdf(truth, tmp_path / "truth.urdf")
    robot = str(UR10)
    # Targets are in the base link, and the tip reaches them.
    free = truth.with_base_and_tool(np.eye(4), np.eye(4))
    wanted = arm.poses(np.random.default_rng(7).uniform(-2, 2, (3, 6)))[:, :3, 3]
    for direction in (-1, 1):
        names = [f"approach_{name}" for name in arm.joint_names]
        (tmp_path / "targets.csv").write_text(text(arm, **{name: [direction] * 3 for name in names}))
        command = ["compensate", robot, "truth.urdf", "targets.csv", "--tip", "tool0", "-o", "out.csv"]
        assert main([*command, "--quiet"]) == 0
        lines = (tmp_path / "out.csv").read_text().splitlines()[1:]
        q = np.array([line.split(",")[:6] for line in lines], float)
        reached = free.poses(Conditions(q, approach=np.full(q.shape, float(direction))))[:, :3, 3]
        np.testing.assert_allclose(reached, wanted, atol=1e-8)
        assert np.abs(free.poses(q)[:, :3, 3] - wanted).max() > 1e-4
    capsys.readouterr()


@pytest.mark.parametrize(
    ("family", "size", "column"), [("backlash", 2e-3, "approach"), ("thermal", 3e-5, "temp")]
)
def test_simulate_draws_the_conditions_that_the_robot_depends_on(
    arm, family, size, column, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    write_urdf(with_errors(arm, family, size, np.random.default_rng(12)), tmp_path / "truth.urdf")
    robot = str(UR10)
    command = [
        "simulate",
        robot,
        "--tip",
        "tool0",
        "--truth",
        "truth.urdf",
        "-m",
        "100",
        "--kind",
        "position",
    ]
    assert main([*command, "--kind", "position", "--noise", "0.02mm", "-o", "data.csv"]) == 0
    header = (tmp_path / "data.csv").read_text().splitlines()[1]
    assert column in header
    assert main(["calibrate", robot, "data.csv", "--tip", "tool0", "-o", "out.urdf", "--json", "r.json"]) == 0
    assert family in json.loads((tmp_path / "r.json").read_text())["extension"]["families"]
    capsys.readouterr()


# --- the table of conditions -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "header"),
    [
        ("time", "time[s]"),
        ("approach", "approach_JOINT"),
        ("temperature", "temperature[degC]"),
        ("payload", "payload[kg]"),
    ],
)
def test_headers_of_conditions(name, header):
    assert CONDITIONS[name].header == header


@pytest.mark.parametrize(
    ("name", "values", "wanted"),
    [
        ("time", [-1e9, 2.0, 2.0, 1e12], None),
        (
            "time",
            [3.0, 5.0, 4.0, 1.0],
            (2, "is earlier than the row before; expected rows in the order of time"),
        ),
        ("time", [np.nan, 1.0], (0, "nan is not plausible; expected a number from -inf to inf")),
        ("approach", [-1, 0, 1], None),
        ("approach", [1, -2, 3], (1, "-2 is not a direction; expected -1, 0 or 1")),
        ("temperature", [-50.0, 150.0, 20.0], None),
        ("temperature", [20, 150.1], (1, "150.1 is not plausible; expected a number from -50 to 150")),
        ("temperature", [-50.1], (0, "-50.1 is not plausible; expected a number from -50 to 150")),
        ("payload", [0.0, 1e5, 3.0], None),
        ("payload", [1.0, 2.0, np.nan], (2, "nan is not plausible; expected a number from 0 to 100000")),
    ],
)
def test_first_value_that_is_not_possible(name, values, wanted):
    assert CONDITIONS[name].find_problem(np.array(values, float)) == wanted


def test_drawn_conditions_are_possible_and_near_the_reference():
    rng = np.random.default_rng(0)
    found = {name: each.draw(rng, (500, 6), 31.0) for name, each in CONDITIONS.items() if each.draw}
    assert set(found) == {"approach", "temperature"}
    assert np.unique(found["approach"]).tolist() == [-1, 1]
    assert found["approach"].shape == (500, 6)
    assert found["temperature"].shape == (500,)
    assert 21.0 <= found["temperature"].min() < 22.0
    assert 40.0 < found["temperature"].max() <= 41.0


def test_steps_of_conditions():
    """Whole degrees, tens of grams and directions; a time is no condition of a model."""
    q = np.zeros((2, 2))
    known = {
        "time": np.array([0.0, 1.0]),
        "approach": np.array([[1.0, -1], [0, 1]]),
        "temperature": np.array([20.4, 21.6]),
        "payload": np.array([1.234, 0.004]),
    }
    wanted = [[1, -1, 20, 123], [0, 1, 22, 0]]
    np.testing.assert_array_equal(Conditions(q, **known).steps, wanted)
    assert Conditions(q, time=known["time"]).steps.shape == (2, 0)


def all_conditions(m: int) -> Conditions:
    """Return conditions of two joints of which everything is known."""
    rows = np.arange(float(m))
    poses = np.tile(np.eye(4), (m, 1, 1)) + rows[:, None, None]
    return Conditions(
        rows[:, None] * [1, 2],
        rows,
        10 * rows,
        np.ones((m, 2)),
        20 + rows,
        0.1 * rows,
        poses,
        2 * poses,
        rows[:, None] * [3, 4],
        rows[:, None] * [5, 6, 7],
    )


def test_chosen_copied_and_joined_conditions_are_equal():
    conditions = all_conditions(5)
    names = {"order", "time", "approach", "temperature", "payload", "base_motion", "tool_motion", "zeros"}
    assert conditions.names == names | {"growth"}
    parts = [conditions[:2], conditions[np.array([2, 3, 4])]]
    joined = concatenate_conditions(parts)
    assert joined is not None
    assert joined.equals(conditions)
    copy = conditions.copy()
    assert copy.equals(conditions)
    copy.q[0, 0] += 1.0
    assert not copy.equals(conditions)
    assert not conditions.equals(conditions[:4])
    assert not conditions.equals(Conditions(conditions.q))
    assert not Conditions(conditions.q).equals(conditions)
    assert concatenate_conditions([*parts, None]) is None
    some = concatenate_conditions([Conditions(conditions.q, temperature=conditions.temperature), conditions])
    assert some is not None
    assert some.names == {"temperature"}
    assert conditions.of_arm.names == names - {"base_motion", "tool_motion"} | {"growth"}
    assert conditions.of_joints.names == {"approach", "temperature", "payload"}


def test_conditions_at_other_positions():
    """All samples of each configuration; from the second one on, the arm comes from another direction."""
    conditions = all_conditions(3)
    q = np.arange(18.0).reshape(9, 2)
    moved = conditions.at(q)
    np.testing.assert_array_equal(moved.q, q)
    np.testing.assert_array_equal(moved.temperature, [20, 21, 22] * 3)
    np.testing.assert_array_equal(moved.approach, [[1, 1]] * 3 + [[0, 0]] * 6)
    np.testing.assert_array_equal(conditions.approach, 1.0)
    same = conditions.at(q[:3])
    np.testing.assert_array_equal(same.approach, 1.0)
    np.testing.assert_array_equal(same.q, q[:3])
    assert Conditions(conditions.q, temperature=conditions.temperature).at(q).approach is None
    assert len(Conditions(np.empty((0, 2))).at(np.empty((0, 2))).q) == 0


def test_motions_below_the_noise_of_an_encoder_are_none():
    """A joint that has not moved yet has no direction; others keep theirs."""
    q = np.array([[0.0, 0, 0], [0.5e-4, -2e-4, 0.3], [0.0, -2e-4, 0.29999], [0.2, -3.5e-4, 0.1]])
    wanted = [[0, 0, 0], [0, -1, 1], [0, -1, 1], [1, -1, -1]]
    np.testing.assert_array_equal(directions_in_order(q), wanted)
    np.testing.assert_array_equal(directions_in_order(q[:1]), [[0, 0, 0]])
