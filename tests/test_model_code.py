"""Models as C and Python code: poses, Jacobians and joint positions are those of the package."""

from __future__ import annotations

import re
import shutil
import subprocess
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
from robots import paper, random_table, robot_file, with_masses

from dhcal_pin import se3
from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.model_code import model_code
from dhcal_pin.robot import FAMILIES, Chain

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")


def ur10() -> Chain:
    return Chain.from_urdf(robot_file("ur_description/urdf/ur10_robot.urdf"), "tool0")


def two_arms(tip: str) -> Chain:
    """Baxter from its left hand to a tip; the joints of the left arm are passed from child to parent."""
    return Chain.from_urdf(robot_file("baxter_description/urdf/baxter.urdf"), tip, "left_hand_link")


def with_slides() -> Chain:
    rng = np.random.default_rng(4)
    return with_masses(Chain.from_dh(random_table(rng, size=7)), rng)


ARMS = {
    "ur10": ur10,
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
    slopes = differences(base_to_tip, conditions)
    np.testing.assert_allclose(jacobians, slopes, rtol=0, atol=1e-8)
    for i, row in enumerate(q):
        pose, jacobian = in_c.pose_and_jacobian(row, **of_sample(conditions, i))
        np.testing.assert_allclose(pose, wanted[i], rtol=0, atol=1e-12)
        np.testing.assert_allclose(jacobian, jacobians[i], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(pose, in_c.forward_kinematics(row, **of_sample(conditions, i)))
        np.testing.assert_allclose(in_c.forward_kinematics(row), plain[i], rtol=0, atol=1e-12)
        np.testing.assert_allclose(
            in_c.gravity_torques(row, conditions.payload[i]), torques[i], rtol=0, atol=1e-12 * scale
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
    chain = with_joint_errors(ur10(), rng, [family])
    conditions = random_conditions(chain, 5, rng)
    module = python_model(chain, tmp_path)
    known = {key: getattr(conditions, key) for key in ("approach", "temperature", "payload")}
    poses, jacobians = module.pose_and_jacobian(conditions.q, **known)
    np.testing.assert_allclose(poses, chain.poses(conditions), rtol=0, atol=1e-12)
    np.testing.assert_allclose(jacobians, differences(chain, conditions), rtol=0, atol=2e-9)
    assert np.abs(poses - ur10().poses(conditions.q)).max() > 1e-6
