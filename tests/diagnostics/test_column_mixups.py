"""Warnings about mixed-up columns: joints, frames and rows."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from measurement_files import csv_text_of, joint_positions, real_ur10
from robots import robot_file

from dhcal_pin.robot import Chain


def swapped(i, j):
    order = np.arange(6)
    order[[i, j]] = j, i
    return lambda q: q[:, order]


def shifted(j, degrees):
    return lambda q: q + np.deg2rad(degrees) * (np.arange(6) == j)


def flipped(j):
    return lambda q: q * np.where(np.arange(6) == j, -1, 1)


MIXUPS = [
    *((flipped(j), f"the opposite sign of joint {name}_joint") for j, name in enumerate(
        ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))),
    (shifted(1, 90), "with -90 deg added to joint shoulder_lift_joint; check its zero"),
    (shifted(4, -90), "with 90 deg added to joint wrist_2_joint; check its zero"),
    (swapped(0, 2), "joints shoulder_pan_joint and elbow_joint swapped; check the order of the joint"),
    (swapped(3, 4), "joints wrist_1_joint and wrist_2_joint swapped"),
]  # fmt: skip


@pytest.mark.parametrize("kind", ["pose", "position"])
@pytest.mark.parametrize(("mixup", "words"), MIXUPS)
def test_mixed_up_joints_are_named(warnings_of, ur10, kind, mixup, words):
    """No joint limit is exceeded, and the robot has errors of millimetres."""
    real = real_ur10()
    q = 0.4 * joint_positions(ur10, 60)
    lines = csv_text_of(real, q, kind=kind).splitlines()
    written = csv_text_of(real, mixup(q), kind=kind).splitlines()
    # Joint columns of one file, measured columns of the other.
    rows = [",".join((*w.split(",")[:6], *t.split(",")[6:])) for w, t in zip(written, lines, strict=True)]
    (text,) = warnings_of(ur10, "\n".join(rows))
    assert words in text


@pytest.mark.parametrize("swap", [("x", "y"), ("y", "z")])
def test_a_mirrored_frame_is_named(warnings_of, ur10, swap):
    text = csv_text_of(real_ur10(), joint_positions(ur10, 60))
    head, body = text.split("\n", 1)
    a, b = (f"{axis}[mm]" for axis in swap)
    head = head.replace(a, "?").replace(b, a).replace("?", b)
    (warning,) = warnings_of(ur10, f"{head}\n{body}")
    assert "with the measuring frame mirrored; check the order and the signs of x, y and z" in warning


def test_rows_shifted_by_one_are_named(warnings_of, ur10):
    lines = csv_text_of(real_ur10(), joint_positions(ur10, 150)).splitlines()
    pairs = pairwise(lines[1:])
    rows = [",".join((*q.split(",")[:6], *reading.split(",")[6:])) for q, reading in pairs]
    (warning,) = warnings_of(ur10, "\n".join([lines[0], *rows]))
    assert (
        "with the measured values of the previous row; check how joint and measured columns were joined"
        in warning
    )


def test_another_robot_gives_a_warning_without_a_hypothesis(warnings_of, ur10):
    other = Chain.from_urdf(robot_file("ur_description/urdf/ur3_robot.urdf"), "tool0")
    (warning,) = warnings_of(ur10, csv_text_of(other, joint_positions(ur10, 60), kind="position"))
    assert warning.endswith(
        "check the robot and tip, the units, and the order, signs and zeros of the joints"
    )


def test_outliers_are_not_mixed_up_columns(warnings_of, ur10):
    rng = np.random.default_rng(5)
    real, q = real_ur10(), joint_positions(ur10, 80)
    rows = csv_text_of(real, q, kind="position").splitlines()
    for i in rng.permutation(80)[:8] + 1:
        cells = rows[i].split(",")
        cells[6:] = [repr(float(cell) + 1e3 * rng.normal()) for cell in cells[6:]]
        rows[i] = ",".join(cells)
    assert warnings_of(ur10, "\n".join(rows)) == []
