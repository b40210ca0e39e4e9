"""Servo files: LeRobot's calibration against its formula, TOML, corrected zeros, and errors."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import yaml
from servo_arms import RANGES, lerobot_degrees, lerobot_text

from dhcal_pin.cli.servo_zeros import describe_moves
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import read_servos
from dhcal_pin.io.servo_file import Servo, ServoFile


def written(tmp_path, name, text):
    path = tmp_path / name
    path.write_bytes(text.encode())
    return path


def servo_of(servos, name):
    """Servo of a motor or joint that the file has."""
    servo = servos.of_column(name)
    assert servo is not None
    return servo


def test_counts_become_the_degrees_of_lerobot(tmp_path):
    servos = read_servos(written(tmp_path, "arm.json", lerobot_text()))
    counts = np.array([0, 1, 2047, 2048, 3100, 4095])
    for name, limits in RANGES.items():
        servo = servo_of(servos, name)
        np.testing.assert_allclose(
            np.rad2deg(servo.angles(counts)), lerobot_degrees(counts, *limits), atol=1e-12
        )


@pytest.mark.parametrize(("make", "sign"), [("feetech", -1), ("dynamixel", 1)])
def test_a_corrected_homing_offset_adds_the_angle(tmp_path, make, sign):
    written(tmp_path, "arm.json", lerobot_text())
    toml = written(tmp_path, "arm.toml", f'lerobot = "arm.json"\nmake = "{make}"\n')
    servos = read_servos(toml)
    wanted = dict(zip(RANGES, np.deg2rad([15.0, -20.0, 3.0, 0.01, 179.0, 0.0]), strict=True))
    corrected, moved = servos.with_zeros_moved(wanted)
    old, new = json.loads(servos.lerobot_text), json.loads(corrected.lerobot_content())
    for name, limits in RANGES.items():
        actual = 2000 - sign * old[name]["homing_offset"]  # The servo is where it reported 2000 counts.
        reported = actual + sign * new[name]["homing_offset"]
        change = lerobot_degrees(reported, *limits) - lerobot_degrees(2000, *limits)
        turns = np.round(change / (4096 / 4095 * 360)) * 4096 / 4095 * 360
        np.testing.assert_allclose(np.deg2rad(change - turns), moved[name], atol=1e-12)
        assert abs(moved[name] - wanted[name]) <= np.pi / 4095 + 1e-12
        assert abs(new[name]["homing_offset"]) <= 2047 or make == "dynamixel"


@pytest.mark.parametrize(
    "text",
    [
        lerobot_text(),
        lerobot_text().replace("\n", "\r\n"),
        json.dumps(json.loads(lerobot_text()), separators=(",", ":")),
        *(
            lerobot_text().replace('"wrist_roll"', name).replace('"id"', '"note": "homing_offset: 3", "id"')
            for name in ('"gr\\u00f6\\"{if"', '"grö\\"{if"')
        ),
    ],
)
def test_lerobot_keeps_every_byte_but_the_homing_offsets(tmp_path, text):
    servos = read_servos(written(tmp_path, "arm.json", text))
    assert servos.with_zeros_moved({})[0].lerobot_content() == text
    last = servos.servos[4].joint
    corrected, _ = servos.with_zeros_moved({"elbow_flex": np.deg2rad(9.0), last: -0.2})
    by_hand = text
    # 9 degrees are 102.4 of 4095 steps, -0.2 rad are -130.3.
    for before, after in ((-50, -152), (150, 280)):
        for space in (" ", ""):
            by_hand = by_hand.replace(f'"homing_offset":{space}{before},', f'"homing_offset":{space}{after},')
    assert corrected.lerobot_content() == by_hand
    assert describe_moves(servos, servos) == []
    (sentence,) = describe_moves(servos, corrected)
    assert "by counts: elbow_flex " in sentence


def test_a_homing_offset_stays_within_the_register_of_a_feetech_motor(tmp_path):
    servos = read_servos(
        written(tmp_path, "arm.json", lerobot_text({"elbow_flex": 2000, "wrist_flex": -2047}))
    )
    step = 2 * np.pi / 4095
    corrected, moved = servos.with_zeros_moved({"elbow_flex": -100 * step, "wrist_flex": 1 * step})
    offsets = {servo.name: servo.homing_offset for servo in corrected.servos}
    assert (offsets["elbow_flex"], offsets["wrist_flex"]) == (2100 - 4096, -2047)
    assert moved["wrist_flex"] == 0.0


def test_toml_files_give_sign_zero_and_joint(tmp_path):
    text = """resolution = 1024
[motor.base]
joint = "pan"
id = 3
sign = -1
zero = 500.5
[motor.lift]
counts_per_turn = 3000
resolution = 4096
"""
    servos = read_servos(written(tmp_path, "arm.toml", text))
    pan, lift = servo_of(servos, "pan"), servo_of(servos, "lift")
    assert servos.of_column("base") is pan
    np.testing.assert_allclose(pan.angles(np.array([500.5, 500.5 - 256])), [0, np.pi / 2])
    np.testing.assert_allclose(lift.angles(np.array([2048, 2048 + 750])), [0, np.pi / 2])
    again = read_servos(written(tmp_path, "again.toml", servos.toml_content()))
    assert again.servos == servos.servos


def test_ros2_control_parameters_give_the_joint_values(tmp_path):
    text = "[motor.pan]\nsign = -1\nzero = 1999\n[motor.lift]\ncounts_per_turn = 4095\nid = 2\n"
    servos = read_servos(written(tmp_path, "arm.toml", text))
    parameters = yaml.safe_load(servos.ros2_control_content())
    assert [parameters[name]["offset_counts"] for name in ("pan", "lift")] == [1999, 2048]
    for name, p in parameters.items():
        counts = np.arange(0, 4096, 65)
        position = (counts - 2048) * 2 * np.pi / 4096
        expected = servo_of(servos, name).angles(counts)
        np.testing.assert_allclose((position - p["offset"]) / p["gear_ratio"], expected, atol=1e-13)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.json", "{", ["not JSON"]),
        ("a.json", "[]", ["not a calibration of LeRobot", "range_min"]),
        ("a.json", '{"homing_offset": [1], "motor_names": ["a"]}', ["old version"]),
        ("a.json", '{"a": 3}', ["motor 'a'", "id is not an integer"]),
        (
            "a.json",
            lerobot_text().replace("741", "741.5"),
            ["motor 'shoulder_pan'", "range_min is not an integer"],
        ),
        (
            "a.json",
            lerobot_text().replace("741", "3465"),
            ["shoulder_pan", "range_min 3465", "range_max 3465"],
        ),
        ("a.toml", "", ["motor is missing"]),
        ("a.toml", "[motor.a]\nsgn = 1", ["[motor.a]", "sgn"]),
        ("a.toml", "[motor.a]\nsign = 2", ["sign = 2", "1 or -1"]),
        ("a.toml", '[motor.a]\njoint = "j"\n[motor.b]\njoint = "j"', ["a and b", "same joint"]),
        ("a.toml", 'lerobot = "missing.json"', ["missing.json"]),
        (
            "a.toml",
            'lerobot = "so101.json"\n[motor.foo]\njoint = "j"',
            ["[motor.foo]", "unknown motor", "elbow_flex"],
        ),
        ("a.toml", 'lerobot = "so101.json"\n[motor.gripper]\nzero = 3', ["[motor.gripper]", "zero"]),
    ],
)
def test_errors_name_file_motor_and_what_is_expected(tmp_path, name, text, words):
    written(tmp_path, "so101.json", lerobot_text())
    with pytest.raises(DhcalError) as caught:
        read_servos(written(tmp_path, name, text))
    message = str(caught.value)
    assert all(word in message for word in words), message
    assert "\n" not in message


def test_a_motor_has_the_usual_values_unless_others_are_stated(tmp_path):
    servos = read_servos(written(tmp_path, "arm.toml", "[motor.pan]\n"))
    assert servos.servos == (Servo("pan", "pan", 2048.0, 4096.0, 4096, 1, None),)
    assert servos.make == "feetech"
    assert servos.servos[0].homing_offset == 0
    assert servos.of_column("lift") is None


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("id = 255", 256),
        ("id = 0", -1),
        ("resolution = 2", 1),
        ("resolution = 16777216", 16777217),
        ("counts_per_turn = 1", 0.9),
        ("counts_per_turn = 16777216", 16777217),
        ("zero = 2147483648", 2147483649),
        ("zero = -2147483648", -2147483649),
        ("sign = -1", "true"),
        ("sign = 1", 0),
    ],
)
def test_limits_of_the_values_of_a_motor(tmp_path, text, number):
    key, value = text.split(" = ")
    (servo,) = read_servos(written(tmp_path, "arm.toml", f"[motor.a]\n{text}\n")).servos
    assert getattr(servo, key) == float(value)
    with pytest.raises(DhcalError, match=rf"\[motor.a\]: {key} = "):
        read_servos(written(tmp_path, "arm.toml", f"[motor.a]\n{key} = {number}\n"))


def test_a_column_has_the_name_of_a_joint_rather_than_of_a_motor(tmp_path):
    text = '[motor.a]\njoint = "b"\n[motor.b]\njoint = "a"\n[motor.c]\njoint = "d"\n'
    servos = read_servos(written(tmp_path, "arm.toml", text))
    assert [servo_of(servos, name).name for name in ("a", "b", "c", "d")] == ["b", "a", "c", "c"]


def test_joints_and_resolutions_are_added_to_a_calibration_of_lerobot(tmp_path):
    (tmp_path / "sub").mkdir()
    written(tmp_path, "sub/so101.JSON", lerobot_text())
    text = 'lerobot = "sub/so101.JSON"\nresolution = 1024\nmake = "dynamixel"\n'
    text += '[motor.gripper]\njoint = "jaw"\nresolution = 2048\n'
    servos = read_servos(written(tmp_path, "arm.toml", text))
    assert servos.make == "dynamixel"
    pan, jaw = servo_of(servos, "shoulder_pan"), servo_of(servos, "jaw")
    assert pan == Servo("shoulder_pan", "shoulder_pan", (741 + 3465) / 2, 1023.0, 1024, 1, 1, -250)
    assert jaw == Servo("gripper", "jaw", (2030 + 3500) / 2, 2047.0, 2048, 1, 6, 250)
    plain = read_servos(tmp_path / "sub" / "so101.JSON")
    assert servo_of(plain, "gripper").counts_per_turn == 4095
    assert plain.lerobot == plain.path == str(tmp_path / "sub" / "so101.JSON")


@pytest.mark.parametrize(
    ("value", "is_valid"), [("2147483647", True), ("2147483648", False), ("true", False)]
)
@pytest.mark.parametrize("key", ["id", "drive_mode", "homing_offset", "range_max"])
def test_integers_of_lerobot_fit_into_a_register(tmp_path, key, value, is_valid):
    motor = {
        "id": 1,
        "drive_mode": 0,
        "homing_offset": 0,
        "range_min": 0,
        "range_max": 4095,
        key: json.loads(value),
    }
    path = written(tmp_path, "arm.json", json.dumps({"a": motor}))
    if is_valid:
        assert read_servos(path).servos[0].name == "a"
    else:
        with pytest.raises(DhcalError, match=f"motor 'a': {key} is not an integer"):
            read_servos(path)


@pytest.mark.parametrize(
    ("make", "before", "counts", "wanted", "after"),
    [
        ("feetech", 100, 30, 30, 70),
        ("feetech", 2000, -47, -47, 2047),
        ("feetech", -2000, 47, 47, -2047),
        # 2048 and -2048 are the same place, which the register cannot hold: one count less.
        ("feetech", 2000, -48, -49, -2047),
        ("feetech", -2047, 1, 0, -2047),
        ("feetech", 2000, -49, -49, -2047),
        ("feetech", -2000, 49, 49, 2047),
        # What the file has stays if nothing moves.
        ("feetech", 2100, 0, 0, 2100),
        ("feetech", -2048, 0, 0, -2048),
        ("dynamixel", 2000, 100, 100, 2100),
        ("dynamixel", -2000, -48, -48, -2048),
    ],
)
def test_moved_zeros_and_homing_offsets(make, before, counts, wanted, after):
    servo = Servo("m", "j", 2000.0, 4095.0, 4096, -1, 1, before)
    step = -2 * np.pi / 4095
    assert servo.step == pytest.approx(step)
    corrected, moved = ServoFile("f", (servo,), make=make).with_zeros_moved({"j": (counts + 0.4) * step})
    assert corrected.servos[0] == replace(servo, zero=2000.0 - wanted, homing_offset=after)
    assert moved == {"j": pytest.approx(wanted * step)}


def test_homing_offsets_that_lerobot_would_write_elsewhere_are_not_written(tmp_path):
    motor = (
        '{"a": {"id": 1, "drive_mode": 0, "more": {}, "homing_offset": 3, "range_min": 0, "range_max": 9}}'
    )
    servos = read_servos(written(tmp_path, "arm.json", motor))
    assert servos.lerobot_content() == motor
    moved, _ = servos.with_zeros_moved({"a": 0.5})
    with pytest.raises(
        DhcalError, match=r"arm\.json: homing offsets were not found; write it as LeRobot does"
    ):
        moved.lerobot_content()


def test_a_joint_that_a_robot_does_not_have_is_named_with_the_remedy():
    servo = Servo("m", "j", 0.0, 4096.0, 4096, 1, None)
    servos = ServoFile("arm.toml", (servo,))
    servos.require_joint(servo, ["i", "j"], "arm.urdf")
    with pytest.raises(DhcalError) as caught:
        servos.require_joint(servo, ["i", "k"], "arm.urdf")
    assert str(caught.value) == (
        "arm.toml: motor 'm' moves joint 'j', which arm.urdf does not have; write joint = NAME in [motor.m] "
        "of a TOML servo file; the joints are i, k"
    )


def test_files_for_drivers_have_the_numbers_of_the_bus_if_they_are_known():
    servos = (Servo("a", "j", 1024.6, 2048.0, 4096, -1, 7), Servo("b", "k", 2048.0, 4096.0, 4096, 1, None))
    parameters = yaml.safe_load(ServoFile("f", servos).ros2_control_content())
    offset = pytest.approx((1024.6 - 2048) * np.pi / 2048)
    first = {"id": 7, "offset": offset, "gear_ratio": -0.5, "offset_counts": 1025, "resolution": 4096}
    second = {"offset": 0.0, "gear_ratio": 1.0, "offset_counts": 2048, "resolution": 4096}
    assert parameters == {"j": first, "k": second}
    motors = tomllib.loads(ServoFile("f", servos).toml_content())["motor"]
    assert (motors["a"]["id"], motors["a"]["sign"], motors["a"]["zero"]) == (7, -1, 1024.6)
    assert "id" not in motors["b"]
