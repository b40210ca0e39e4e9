"""A servo arm from counts to LeRobot's calibration, ros2_control parameters and URDF."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import error_of, stderr_of
from servo_arms import (
    JOINTS,
    RANGES,
    SO101,
    TIP,
    ServoArm,
    counts_csv,
    forward_kinematics,
    lerobot_degrees,
    lerobot_text,
)
from touching_arms import JOINTS as TOUCHING_JOINTS
from touching_arms import TouchingArm, urdf

from dhcal_pin.calibration import calibrate
from dhcal_pin.cli import run_job
from dhcal_pin.io import read_measurements, read_robot, read_servos

CALIBRATE = ("calibrate", "so101.urdf", "poses.csv", "--tip", TIP)


@pytest.fixture
def arm(tmp_path, monkeypatch):
    """Folder with a nominal arm, its servo file and 25 measurements; two joints turn the other way."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(5)
    arm = ServoArm.random(rng, wrong=2)
    shutil.copy(SO101, "so101.urdf")
    Path("so101.json").write_text(lerobot_text())
    counts, poses = arm.measure(rng, 25)
    Path("poses.csv").write_text(counts_csv(counts, poses))
    return arm


def test_all_files_give_the_same_poses_for_the_same_counts(arm, run):
    for output in ("arm.json", "arm.ros2_control.yaml"):
        err = stderr_of(
            run(*CALIBRATE, "--servos", "so101.json", "-o", output, "--json", f"{output}.result.json")
        )
        assert "verdict: ok" in err
        # It belongs to the first screen: the arm moves differently with the new file.
        assert "warning: zeros of the servos move by counts: " in err
    result = json.loads(Path("arm.json.result.json").read_text())
    assert set(result["signs"]["turned"]) == set(arm.wrong)
    assert {"lerobot", "urdf", "sidecar", "servos"} <= set(result["files"])
    urdf = Path("arm.urdf").read_text()
    old, new = (json.loads(Path(name).read_text()) for name in ("so101.json", "arm.json"))
    assert max(abs(new[name]["homing_offset"] - old[name]["homing_offset"]) for name in JOINTS) > 40
    drivers = yaml.safe_load(Path("arm.ros2_control.yaml").read_text())
    nominal, servos = read_robot("so101.urdf", TIP), read_servos("so101.json")
    fit = calibrate(nominal, read_measurements("poses.csv", nominal, servos=servos), "low-cost,base,tool")
    calibrated = read_robot("arm.urdf", TIP)
    rng = np.random.default_rng(0)
    for _ in range(5):
        counts = {name: int(rng.integers(1000, 3000)) for name in JOINTS}
        degrees = {n: lerobot_degrees(c, *RANGES[n]) for n, c in counts.items()}
        by_lerobot = {
            n: np.deg2rad(lerobot_degrees(c + old[n]["homing_offset"] - new[n]["homing_offset"], *RANGES[n]))
            for n, c in counts.items()
        }
        by_driver = {
            n: ((c - 2048) * 2 * np.pi / 4096 - drivers[n]["offset"]) / drivers[n]["gear_ratio"]
            for n, c in counts.items()
        }
        pose = forward_kinematics(urdf, by_lerobot)
        np.testing.assert_allclose(forward_kinematics(urdf, by_driver), pose, atol=1e-9)
        expected = fit.chain.poses(np.deg2rad([[degrees[n] for n in JOINTS]]))[0]
        np.testing.assert_allclose(calibrated.base @ pose @ calibrated.tool, expected, atol=1e-9)


def test_the_calibrated_arm_is_accurate_on_other_counts(arm, run):
    assert run(*CALIBRATE, "--servos", "so101.json", "-o", "arm.urdf")[0] == 0
    rng = np.random.default_rng(9)
    q = arm.configurations(rng, 60)
    Path("other.csv").write_text(counts_csv(arm.counts(q), arm.poses(q)))
    options = ("--tip", TIP, "--servos", "arm.servos.toml", "--json", "v.json")
    assert run("validate", "arm.urdf", "other.csv", *options)[0] == 0
    assert json.loads(Path("v.json").read_text())["after"]["position_rms_m"] < 4e-3
    run("recheck", "arm.urdf", "other.csv", *options)
    assert json.loads(Path("v.json").read_text())["samples"] == 60
    assert run("view", "arm.urdf", "--data", "other.csv", *options[:4], "--html", "s.html")[0] == 0
    nominal, calibrated = read_robot("so101.urdf", TIP), read_robot("arm.urdf", TIP)
    turned = np.array([name in arm.wrong for name in JOINTS])
    np.testing.assert_array_equal(calibrated.axes, np.where(turned[:, None], -1, 1) * nominal.axes)
    np.testing.assert_array_equal(calibrated.lower[turned], -nominal.upper[turned])


def test_the_servo_file_with_the_zeros_of_the_calibration_is_named(arm, run):
    assert run(*CALIBRATE, "--servos", "so101.json", "-o", "arm.urdf")[0] == 0
    Path("old.toml").write_text(read_servos("so101.json").toml_content())
    rng = np.random.default_rng(9)
    q = arm.configurations(rng, 20)
    Path("other.csv").write_text(counts_csv(arm.counts(q), arm.poses(q)))

    def validate(data, servos, command="validate"):
        options = ("--tip", TIP, "--servos", servos, "--json", "v.json")
        assert run(command, "arm.urdf", data, *options)[0] in (0, 1)
        document = json.loads(Path("v.json").read_text())
        return [text for text in document["warnings"] if "the zeros are not those" in text], document

    for old in ("so101.json", "old.toml"):
        (found,), before = validate("poses.csv", old)
        assert found.startswith(
            f"{old}: the zeros are not those of this calibration, which are in arm.servos"
        )
        assert found.endswith("state --servos arm.servos.toml")
    (found,), _ = validate("other.csv", "old.toml")
    assert found.endswith("state --servos arm.servos.toml, unless the offsets in the servos have changed")
    assert validate("other.csv", "old.toml", "recheck")[0] == [found]
    # The homing offsets in the servos are not known, but the positions do not fit.
    (found,), _ = validate("other.csv", "so101.json")
    assert found.endswith("state --servos arm.servos.toml, unless the offsets in the servos have changed")
    assert validate("other.csv", "arm.servos.toml")[0] == []
    # The advice is followed.
    found, after = validate("poses.csv", "arm.servos.toml")
    assert found == []
    assert after["after"]["position_rms_m"] < 0.2 * before["after"]["position_rms_m"]


def test_motors_may_have_other_names_than_joints(arm, run):
    text = lerobot_text().replace('"elbow_flex"', '"motor_3"')
    Path("so101.json").write_text(text)
    Path("so101.toml").write_text('lerobot = "so101.json"\n[motor.motor_3]\njoint = "elbow_flex"\n')
    Path("poses.csv").write_text(Path("poses.csv").read_text().replace("elbow_flex[", "motor_3["))
    options = ("--turned", ",".join(arm.wrong), "--extend", "none", "--session", "off")
    assert run(*CALIBRATE, "--servos", "so101.toml", "-o", "arm.json", *options)[0] == 0
    assert json.loads(Path("arm.json").read_text())["motor_3"]["homing_offset"] != -50


def test_signs_can_be_stated(arm, run):
    Path("so101.toml").write_text(read_servos("so101.json").toml_content())
    stated = ",".join(arm.wrong)
    assert (
        run(*CALIBRATE, "--servos", "so101.toml", "--turned", stated, "-o", "arm.urdf", "--json", "r.json")[0]
        == 0
    )
    assert json.loads(Path("r.json").read_text())["signs"] == {
        "compared": True,
        "turned": list(arm.wrong),
        "open": [],
    }


REFUSED = {
    "no servo file": ((), "", ["poses.csv:1", "shoulder_pan[ticks]", "--servos"]),
    "no motor": (("--servos", "few.toml"), "", ["poses.csv:1", "shoulder_lift", "few.toml", "shoulder_pan"]),
    "no joint": (
        ("--servos", "other.toml"),
        "",
        ["other.toml", "'shoulder_pan'", "'pan_joint'", "joint = NAME"],
    ),
    "fraction": (
        ("--servos", "so101.json"),
        "2000.5",
        ["poses.csv:2", "shoulder_pan", "2000.5", "whole number"],
    ),
    "too large": (("--servos", "so101.json"), "4096", ["poses.csv:2", "shoulder_pan", "4096", "0 to 4095"]),
    "negative": (("--servos", "so101.json"), "-1", ["poses.csv:2", "shoulder_pan", "out of range"]),
    "no number": (("--servos", "so101.json"), "x", ["poses.csv:2", "shoulder_pan", "'x'"]),
    "unknown sign": (("--servos", "so101.json", "--turned", "elbow"), "", ["--turned elbow", "elbow_flex"]),
    "mended sign": (("--servos", "so101.json", "--mend", "sign:elbow_flex"), "", ["--mend", "--turned"]),
    "two sets": (("--arm", "low-cost", "--parameters", "dh"), "", ["--arm", "--parameters"]),
}


@pytest.mark.parametrize(("options", "count", "words"), REFUSED.values(), ids=REFUSED)
def test_wrong_input_is_refused_in_one_line(arm, run, options, count, words):
    Path("few.toml").write_text("[motor.shoulder_pan]\n")
    Path("other.toml").write_text('[motor.shoulder_pan]\njoint = "pan_joint"\n')
    lines = Path("poses.csv").read_text().splitlines()
    if count:
        lines[1] = ",".join([count, *lines[1].split(",")[1:]])
    Path("poses.csv").write_text("\n".join([*lines, ""]))
    err = error_of(run(*CALIBRATE, *options, "-o", "arm.urdf"))
    assert all(word in err for word in words), err
    assert not Path("arm.urdf").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("-o", "arm.json"), ["arm.json", "--servos"]),
        (("-o", "arm.ros2_control.yaml"), ["--servos"]),
        (("-o", "arm.json", "--servos", "few.toml"), ["few.toml", "not from LeRobot"]),
        (("-o", "so101.json", "--servos", "so101.json"), ["so101.json: is an input"]),
        (("-o", "so101.ros2_control.yaml", "--servos", "so101.json"), ["so101.urdf: is an input"]),
    ],
)
def test_outputs_that_are_impossible_are_refused(arm, run, options, words):
    Path("few.toml").write_text("[motor.shoulder_pan]\n")
    status, _, err = run(*CALIBRATE, *options)
    assert (status, err.count("\n")) == (2, 1)
    assert all(word in err for word in words), err


def test_remedies_for_touches_by_servos_can_be_followed(tmp_path, monkeypatch, run):
    """`--mend sign:shoulder` was advised, and refused beside --servos."""
    monkeypatch.chdir(tmp_path)
    arm = TouchingArm.random(1, 60, 4, ("shoulder",))
    Path("hobby.urdf").write_text(urdf())
    Path("servos.toml").write_text("".join(f"[motor.{name}]\n" for name in TOUCHING_JOINTS))
    counts = np.round(2048 + arm.data[0].q * 4096 / (2 * np.pi)).astype(int)
    points = arm.data[0].text_values()["point"]
    rows = [",".join([f"{name}[ticks]" for name in TOUCHING_JOINTS] + ["point"])]
    rows += [",".join([*map(str, row), point]) for row, point in zip(counts, points, strict=True)]
    Path("touches.csv").write_text("\n".join([*rows, ""]))
    command = ("calibrate", "hobby.urdf", "touches.csv", "--tip", "l6", "--servos", "servos.toml")
    command = (*command, "--parameters", "placement,tool", "-o", "z.urdf")
    with monkeypatch.context() as patch:
        # More parameters do not explain a mistake that is named.
        patch.setattr(run_job, "suggest_full_set", None)
        status, *streams = run(*command)
    text = " ".join("".join(streams).split())
    assert status
    assert "The sign of joint shoulder is wrong" in text
    assert "Add --turned shoulder." in text
    assert "--mend" not in text
    status, *streams = run(*command, "--turned", "shoulder")
    assert not status
    assert "refused" not in "".join(streams)
