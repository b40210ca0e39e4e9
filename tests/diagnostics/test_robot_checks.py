"""Warnings about robot files: lengths in a wrong unit, and arms that are as they should be."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import json_of, unfolded
from robots import ARMS, nominal_arm, paper, robot_file

from dhcal_pin.diagnostics import find_robot_warnings
from dhcal_pin.exceptions import FileFormatError
from dhcal_pin.io import measurement_text
from dhcal_pin.measurements import Noise, Position
from dhcal_pin.robot import Chain, parse_urdf, read_urdf


def in_millimetres(chain: Chain, joint: str) -> bytes:
    """Return the URDF with the origin of one joint in millimetres."""
    text = chain.urdf.data.decode()
    start = text.index("<origin", chain.urdf.joint(joint).start)
    end = text.index(">", start)
    xyz = [repr(1000 * float(x)) for x in re.search(r'xyz="(.*?)"', text[start:end])[1].split()]  # pyright: ignore
    return (
        text[:start] + re.sub(r'xyz=".*?"', f'xyz="{" ".join(xyz)}"', text[start:end]) + text[end:]
    ).encode()


@pytest.mark.parametrize("name", ["ur10", "panda", "so101"])
def test_the_joint_in_millimetres_is_named(name):
    chain = nominal_arm(name)
    for joint in chain.moving_joints[1:]:
        distance = float(np.linalg.norm(chain.urdf.joint(joint).origin[:3, 3]))
        if distance < 0.1:
            continue
        wrong = Chain.from_urdf(parse_urdf(in_millimetres(chain, joint), "arm.urdf"), chain.tip)
        (found,) = find_robot_warnings(wrong)
        assert found.startswith(f"the origin of joint {joint} is {1000 * distance:.4g} m away from the joint")


def test_two_joints_in_millimetres_are_both_named():
    chain = nominal_arm("ur10")
    once = Chain.from_urdf(parse_urdf(in_millimetres(chain, "elbow_joint"), "arm.urdf"), "tool0")
    twice = Chain.from_urdf(parse_urdf(in_millimetres(once, "wrist_1_joint"), "arm.urdf"), "tool0")
    assert [text.split()[4] for text in find_robot_warnings(twice)] == ["elbow_joint", "wrist_1_joint"]


def check_all_tips(path: Path) -> int:
    """Require that no chain of a URDF gets a warning; return the number of chains."""
    try:
        urdf, count = read_urdf(path), 0
    except FileFormatError:  # a few are no valid URDF
        return 0
    for tip in set(urdf.links) - {joint.parent for joint in urdf.joints}:
        if any(joint.type not in ("fixed", "floating", "planar") for joint in urdf.path(tip)):
            assert find_robot_warnings(Chain.from_urdf(urdf, tip)) == []
            count += 1
    return count


@pytest.mark.parametrize("name", ["ur10", "panda", "so101", "talos", "tiago"])
def test_arms_get_no_warning(name):
    assert find_robot_warnings(nominal_arm(name)) == []


@pytest.mark.slow
def test_no_robot_of_example_robot_data_gets_a_warning():
    paths = {path for name, _ in ARMS.values() for path in robot_file(name).parent.rglob("*.urdf")}
    assert sum(map(check_all_tips, paths)) > 100


def test_long_offsets_of_parallel_axes_that_cancel_get_no_warning():
    """Controllers describe small tilts of parallel axes with offsets of many metres."""
    table = paper("sim_6dof")
    parallel = next(i for i in range(5) if abs(np.sin(table.alpha[i])) < 1e-12)
    d = table.d.copy()
    d[parallel] += 58.0
    assert find_robot_warnings(Chain.from_dh(replace(table, d=d))) != []
    d[parallel + 1] -= 58.0 * np.cos(table.alpha[parallel])
    assert find_robot_warnings(Chain.from_dh(replace(table, d=d))) == []


def test_commands_name_the_joint(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    chain = nominal_arm("ur10")
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (12, 6))
    data = Position.simulate(chain, q, Noise(1e-4), np.random.default_rng(1))
    Path("data.csv").write_text(measurement_text(data, chain))
    Path("arm.urdf").write_bytes(in_millimetres(chain, "wrist_1_joint"))
    warning = "arm.urdf: the origin of joint wrist_1_joint is 572.3 m away"
    document = json_of(run("inspect", "data.csv", "--robot", "arm.urdf", "--tip", "tool0", "--json", "-"))
    assert document["warnings"][0].startswith(warning)
    assert "arm.urdf: warning: the origin of joint wrist_1_joint" in unfolded(
        run("inspect", "data.csv", "--robot", "arm.urdf", "--tip", "tool0")[2]
    )
    status, _, said = run(
        "calibrate", "arm.urdf", "data.csv", "--tip", "tool0", "-o", "out.urdf", "--extend", "none"
    )
    assert status == 3
    assert warning in unfolded(said).split("verdict: refused")[1]
