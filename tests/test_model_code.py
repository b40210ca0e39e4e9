"""Models as C and Python code: poses, Jacobians and joint positions are those of the package."""

import re
import shutil
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exported_models import (
    STRICT,
    CModel,
    python_model,
    random_conditions,
    with_joint_errors,
    with_payload_and_frames,
)
from robots import nominal_arm, random_table, robot_file, with_masses

from dhcal_pin import se3
from dhcal_pin.cli import main
from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.io import read_robot, write_urdf
from dhcal_pin.model_code import model_code
from dhcal_pin.robot import FAMILIES, Chain

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")


def two_arms(tip: str) -> Chain:
    """Baxter from its left hand to a tip; the joints of the left arm are passed from child to parent."""
    return Chain.from_urdf(robot_file("baxter_description/urdf/baxter.urdf"), tip, "left_hand_link")


def with_slides() -> Chain:
    rng = np.random.default_rng(4)
    return with_masses(Chain.from_dh(random_table(rng, size=7)), rng)


ARMS = {
    "ur10": lambda: nominal_arm("ur10"),
    "slides": with_slides,
    "hand to hand": lambda: two_arms("right_hand_link"),
    "hand to base": lambda: two_arms("torso"),
}


def arm(name: str, mimicking: Chain) -> Chain:
    rng = np.random.default_rng(1)
    bare = with_masses(mimicking, rng) if name == "mimic" else ARMS[name]()
    return with_joint_errors(with_payload_and_frames(bare, rng), rng)


def of_sample(conditions, i):
    return {
        "approach": conditions.approach[i],
        "temperature": conditions.temperature[i],
        "payload": conditions.payload[i],
    }


@needs_gcc
@pytest.mark.parametrize("name", [*ARMS, "mimic"])
def test_poses_and_derivatives_are_those_of_the_package(name, mimicking, tmp_path):
    chain, rng = arm(name, mimicking), np.random.default_rng(2)
    assert {family.name for family in chain.error_families} == set(FAMILIES)
    conditions = random_conditions(chain, 20, rng)
    q, base_to_tip = conditions.q, chain.with_base_and_tool(np.eye(4), np.eye(4))
    wanted, plain = base_to_tip.poses(conditions), base_to_tip.poses(q)
    assert np.abs(wanted - plain).max() > 1e-4
    in_c, in_python = CModel(chain, tmp_path), python_model(chain, tmp_path)
    known = {key: getattr(conditions, key) for key in ("approach", "temperature", "payload")}
    np.testing.assert_allclose(in_python.forward_kinematics(q, **known), wanted, rtol=0, atol=1e-12)
    np.testing.assert_allclose(in_python.forward_kinematics(q), plain, rtol=0, atol=1e-12)
    torques = chain.loads.torques(q.T, conditions.payload).T
    scale = np.abs(torques).max()
    np.testing.assert_allclose(
        in_python.gravity_torques(q, conditions.payload), torques, rtol=0, atol=1e-12 * scale
    )
    poses, jacobians = in_python.pose_and_jacobian(q, **known)
    np.testing.assert_array_equal(poses, in_python.forward_kinematics(q, **known))
    np.testing.assert_allclose(jacobians, differences(base_to_tip, conditions), rtol=0, atol=1e-8)
    for i, row in enumerate(q):
        pose, jacobian = in_c.pose_and_jacobian(row, **of_sample(conditions, i))
        np.testing.assert_allclose(pose, wanted[i], rtol=0, atol=1e-12)
        np.testing.assert_allclose(jacobian, jacobians[i], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(pose, in_c.forward_kinematics(row, **of_sample(conditions, i)))
        np.testing.assert_allclose(in_c.forward_kinematics(row), plain[i], rtol=0, atol=1e-12)
        np.testing.assert_allclose(
            in_c.gravity_torques(row, known["payload"][i]), torques[i], rtol=0, atol=1e-12 * scale
        )


def differences(chain: Chain, conditions) -> np.ndarray:
    """Return the body Jacobians by differences of the package's poses."""
    poses, step, columns = chain.poses(conditions), 3e-6, []
    for i in range(chain.n_joints):
        moved = [
            se3.log6(se3.inverse(poses) @ chain.poses(replace(conditions, q=conditions.q + side)))
            for side in (h * np.eye(chain.n_joints)[i] for h in (step, -step))
        ]
        columns.append((moved[0] - moved[1]) / (2 * step))
    return np.stack(columns, -1)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_is_exported_alone(family, tmp_path):
    rng = np.random.default_rng(3)
    chain = with_joint_errors(nominal_arm("ur10"), rng, [family])
    conditions = random_conditions(chain, 5, rng)
    module = python_model(chain, tmp_path)
    known = {key: getattr(conditions, key) for key in ("approach", "temperature", "payload")}
    poses, jacobians = module.pose_and_jacobian(conditions.q, **known)
    np.testing.assert_allclose(poses, chain.poses(conditions), rtol=0, atol=1e-12)
    np.testing.assert_allclose(jacobians, differences(chain, conditions), rtol=0, atol=2e-9)
    assert np.abs(poses - nominal_arm("ur10").poses(conditions.q)).max() > 1e-6


@needs_gcc
@pytest.mark.parametrize("name", ["ur10", "slides", "hand to hand"])
def test_joint_positions_for_a_target_are_found(name, mimicking, tmp_path):
    """Arms of six, seven and fourteen joints, with conditions."""
    chain, rng = arm(name, mimicking), np.random.default_rng(5)
    conditions = random_conditions(chain, 4, rng)
    targets = chain.with_base_and_tool(np.eye(4), np.eye(4)).poses(conditions)
    in_c, in_python = CModel(chain, tmp_path), python_model(chain, tmp_path)
    for i, (target, row) in enumerate(zip(targets, conditions.q, strict=True)):
        start, known = row + rng.uniform(-0.1, 0.1, len(row)), of_sample(conditions, i)
        found, is_reached = in_c.inverse_kinematics(target, start, **known)
        assert is_reached
        found_in_python, is_reached = in_python.inverse_kinematics(target, start, **known)
        assert is_reached
        np.testing.assert_allclose(found, found_in_python, rtol=0, atol=1e-8)
        for q in (found, found_in_python):
            np.testing.assert_allclose(in_c.forward_kinematics(q, **known), target, rtol=0, atol=5e-9)


@needs_gcc
def test_a_target_out_of_reach_is_not_reached(tmp_path):
    chain, q = nominal_arm("ur10"), np.array([0.3, -1.2, 1.4, -1.6, -1.5, 0.3])
    far = chain.poses(q[None])[0]
    far[0, 3] += 50.0
    for model in (CModel(chain, tmp_path), python_model(chain, tmp_path)):
        for target in (far, np.full((4, 4), np.nan)):
            assert not model.inverse_kinematics(target, q)[1]


@needs_gcc
def test_half_a_turn_from_the_target_is_not_the_target(tmp_path):
    chain = nominal_arm("ur10")
    q = np.array([0.3, -1.2, 1.4, -1.6, -1.5, 0.3])
    turned = chain.poses(q[None])[0] @ np.diag([-1.0, -1.0, 1.0, 1.0])
    for model in (CModel(chain, tmp_path), python_model(chain, tmp_path)):
        found, is_reached = model.inverse_kinematics(turned, q)
        distance = np.abs(chain.poses(found[None])[0] - turned).max()
        assert is_reached == (distance < 1e-8)


@needs_gcc
def test_measured_point_and_tip_target_use_base_and_tool(mimicking, tmp_path):
    chain = arm("ur10", mimicking)
    q = np.random.default_rng(6).uniform(-2, 2, 6)
    wanted = chain.poses(q[None])[0]
    for model in (CModel(chain, tmp_path), python_model(chain, tmp_path)):
        pose = model.forward_kinematics(q)
        np.testing.assert_allclose(model.measured_point(pose), wanted, rtol=0, atol=1e-12)
        np.testing.assert_allclose(model.tip_target(wanted), pose, rtol=0, atol=1e-12)


def compiled(header: Path, compiler: str, *options: str) -> Path:
    """Compile a header alone, and a file that uses every function of it; return the object file."""
    text, use = header.read_text(), header.with_name("use.c")
    uses = ", ".join(
        f"(void (*)(void)){name}" for name in re.findall(r"^ARM_API .*?(\w+)\(", text, re.MULTILINE)
    )
    assert "arm_inverse_kinematics" in uses
    use.write_text(f"{text}\nvoid (*const all[])(void) = {{{uses}}};\nint main(void) {{ return 0; }}\n")
    for arguments in (["-fsyntax-only", header.name], ["-c", use.name, "-o", "use.o"]):
        subprocess.run([compiler, *options, *arguments], cwd=header.parent, check=True)
    return header.with_name("use.o")


@pytest.mark.parametrize("compiler", ["gcc", "clang", "g++"])
def test_header_compiles_without_warnings_and_needs_libm_only(compiler, mimicking, tmp_path):
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    options = [*STRICT, "-O1"]
    if compiler == "g++":
        options = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-O1", "-x", "c++"]
    header = tmp_path / "arm.h"
    for chain in (arm("mimic", mimicking), nominal_arm("ur10")):
        header.write_text(model_code(chain, header))
        built = compiled(header, compiler, *options)
        listed = subprocess.run(["nm", "-u", built], capture_output=True, text=True, check=True).stdout
        needed = {line.split()[-1].partition("@")[0] for line in listed.splitlines()}
        known = {"sin", "cos", "sincos", "sqrt", "atan2", "fmax", "memcpy", "memset"}
        assert needed <= known | {"_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}


@needs_gcc
def test_a_pose_takes_less_than_three_microseconds(tmp_path):
    """Harmonics to order 64 of all six joints; the shortest of many runs, in processor time."""
    chain = with_joint_errors(
        nominal_arm("ur10"), np.random.default_rng(7), ["harmonics", "curves", "fine-curves"]
    )
    assert chain.transmission is not None
    assert chain.transmission.order == 64
    model, q = CModel(chain, tmp_path, optimization="-O2"), np.random.default_rng(8).uniform(-3, 3, (200, 6))
    times = []
    for _ in range(50):
        start = time.process_time()
        model.forward_kinematics_of_all(q)
        times.append((time.process_time() - start) / len(q))
    assert min(times) < 3e-6


HOSTILE = '*/ system("touch hacked"); /* """ \\ ??/ \n \' ${p} é $x'


@needs_gcc
def test_names_of_a_robot_are_no_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    chain = nominal_arm("ur10")
    urdf = replace(chain.urdf, name=HOSTILE, root=HOSTILE)
    names = (HOSTILE, *chain.joint_names[1:])
    chain = replace(chain, joint_names=names, tip=HOSTILE, urdf=urdf, first_link=HOSTILE)
    monkeypatch.setattr(Chain, "loads", nominal_arm("ur10").loads)
    for path in ("model.h", "model.py"):
        comment = model_code(chain, path).split("#ifndef")[0].split("import numpy")[0]
        assert "system_" in comment
        assert comment.count("*/") + comment.count('"""') <= 2
    assert python_model(chain, tmp_path).JOINT_NAMES == list(names)
    Path("model.h").write_text(model_code(chain, "model.h"))
    text = "#include <stdio.h>\nint main(void) { fputs(model_joint_name(0), stdout); return 0; }\n"
    Path("names.c").write_text(f'#include "model.h"\n{text}')
    subprocess.run(["gcc", *STRICT, "-trigraphs", "names.c", "-o", "names", "-lm"], check=True)
    shown = subprocess.run(["./names"], capture_output=True, check=True).stdout
    assert shown.decode() == HOSTILE
    assert not Path("hacked").exists()


@pytest.mark.parametrize(
    ("name", "prefix"),
    [("arm.h", "arm"), ("a b-c*.h", "a_b_c"), ("6dof.h", "model_6dof"), ("é.h", "model"), ("__x.H", "x")],
)
def test_prefix_is_the_name_of_the_file(name, prefix):
    assert f" {prefix}_forward_kinematics(" in model_code(nominal_arm("ur10"), Path("folder") / name)


def test_wrong_shapes_are_named(tmp_path):
    model = python_model(nominal_arm("ur10"), tmp_path)
    for function in (model.forward_kinematics, model.pose_and_jacobian, model.gravity_torques):
        for wrong in (np.zeros(7), np.zeros((6, 2)), 0.5):
            with pytest.raises(ValueError, match=r"joint positions of shape \(.*\); expected \(\.\.\., 6\)"):
                function(wrong)
    for target, start in ((np.eye(4), np.zeros((2, 6))), (np.eye(3), np.zeros(6)), (np.eye(4), np.zeros(5))):
        with pytest.raises(ValueError, match=r"expected \(4, 4\) and \(6,\)"):
            model.inverse_kinematics(target, start)


@pytest.mark.parametrize(("name", "is_noted"), [("3arm.py", True), ("class.py", True), ("arm3.py", False)])
def test_a_name_that_python_does_not_import_is_noted(name, is_noted, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("arm.urdf").write_bytes(nominal_arm("ur10").urdf.data)
    assert main.main(["export", "arm.urdf", "--tip", "tool0", "-o", name]) == 0
    assert ("Python imports no module of this name" in capsys.readouterr().err) == is_noted


def test_unknown_ending_is_refused():
    with pytest.raises(InvalidArgumentError, match=r"model\.cpp: unknown ending; choose from \.h, \.py"):
        model_code(nominal_arm("ur10"), "model.cpp")


def test_the_same_robot_gives_the_same_text(mimicking):
    for path in ("model.h", "model.py"):
        assert model_code(arm("ur10", mimicking), path) == model_code(arm("ur10", mimicking), path)


def test_command_writes_the_robot_with_its_sidecar(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    chain = with_joint_errors(
        with_payload_and_frames(nominal_arm("ur10"), np.random.default_rng(9)), np.random.default_rng(9)
    )
    write_urdf(chain, "arm.urdf")
    assert main.main(["export", "arm.urdf", "--tip", "tool0", "-o", "model.py"]) == 0
    read = read_robot("arm.urdf", "tool0")
    assert Path("model.py").read_text() == model_code(read, "model.py")
    assert {family.name for family in read.error_families} == set(FAMILIES)


@pytest.mark.parametrize(
    ("output", "message"),
    [
        ("model.c", "model.c: unknown ending; write source code as .h or .py"),
        ("no/model.h", "no/model.h: "),
        ("arm.py", "arm.py: is an input file"),
    ],
)
def test_command_refuses_outputs_and_writes_nothing(output, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("arm.urdf").write_bytes(nominal_arm("ur10").urdf.data)
    Path("arm.py").symlink_to("arm.urdf")
    assert main.main(["export", "arm.urdf", "--tip", "tool0", "-o", output]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"dhcal: {message}")
    assert error.count("\n") == 1
    assert sorted(path.name for path in Path().iterdir()) == ["arm.py", "arm.urdf"]
