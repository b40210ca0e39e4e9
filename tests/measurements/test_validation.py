"""Constructors of measurements: what they accept, and what they say about wrong arguments."""

from typing import Any

import numpy as np
import pytest

import dhcal_pin
from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.measurements import (
    KINDS,
    Distance,
    MultiTargetPosition,
    PlaneContact,
    PointContact,
    PointDistance,
    Pose,
    Position,
    PositionComponents,
    RelativePose,
    SphereContact,
    Wires,
)

M = 5
Q = np.linspace(-1, 1, M * 6).reshape(M, 6)
POSES = np.tile(np.eye(4), (M, 1, 1))
POINTS = np.linspace(0, 1, M * 3).reshape(M, 3)
WRONG_TYPE: Any = type("WrongType", (), {})()
LEFT_HANDED = POSES * np.array([[-1], [1], [1], [1]])
SCALED = POSES * np.array([[2], [2], [2], [1]])


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (Pose(Q, POSES), "Pose(5 samples, sigma not stated)"),
        (
            Pose(Q, POSES, sigma=1e-4, rotation_sigma=np.deg2rad(0.01)),
            "Pose(5 samples, sigma 0.1 mm, 0.01 deg)",
        ),
        (Pose(Q.tolist(), POSES.tolist()), "Pose(5 samples, sigma not stated)"),
        (Position(Q, POINTS, sigma=[1e-4, 1e-4, 3e-4]), "Position(5 samples, sigma 0.1 to 0.3 mm)"),
        (Position(Q[:0], POINTS[:0], sigma=1e-4), "Position(0 samples, sigma stated)"),
        (PositionComponents(Q, POINTS[:, 0], [2]), "PositionComponents(5 samples, sigma not stated)"),
        (
            MultiTargetPosition(Q, POINTS, ["a", "b", "a", "b", "a"]),
            "MultiTargetPosition(5 samples, 2 targets, sigma not stated)",
        ),
        (Wires(Q, np.ones(M)), "Wires(5 samples, 1 wire, sigma not stated)"),
        (Wires(Q, np.ones((M, 3)), 1e-4), "Wires(5 samples, 3 wires, sigma 0.1 mm)"),
        (Distance(Q, -Q, np.ones(M), np.full(M, 1e-4)), "Distance(5 samples, sigma 0.1 mm)"),
        (PointContact(Q, points=list("abcab")), "PointContact(5 samples, 3 points, sigma not stated)"),
        (PointDistance(6, [("a", "b")], [0.1], 1e-5), "PointDistance(1 sample, sigma 0.01 mm)"),
        (PlaneContact(Q), "PlaneContact(5 samples, sigma not stated)"),
        (SphereContact(Q, 0.15), "SphereContact(5 samples, sigma not stated)"),
        (RelativePose(Q, -Q, POSES), "RelativePose(5 samples, sigma not stated)"),
    ],
)
def test_kinds_are_constructed_directly(data, text):
    assert repr(data) == text
    assert data.rows.tolist() == list(range(1, len(data.rows) + 1))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Pose(POSES, Q), r"Pose: q has shape \(5, 4, 4\); expected .*poses, which come after q"),
        (lambda: Pose(Q[0], POSES), r"Pose: q has shape \(6,\); expected shape \(m, n\).*q\[None\]"),
        (lambda: Pose(Q, POINTS), r"Pose: poses has shape \(5, 3\); expected shape \(5, 4, 4\)"),
        (lambda: Pose(Q, POSES[:4]), "Pose: poses has 4 entries for 5 samples; expected"),
        (lambda: Pose("arm.csv", POSES), "Pose: q of type str is not an array of numbers; expected"),
        (lambda: Pose(Q, WRONG_TYPE), "Pose: poses of type WrongType is not an array of numbers"),
        (lambda: Pose([[0.0, 1.0], [0.0]], POSES), "Pose: q of type list is not an array of numbers"),
        (lambda: Pose(Q + 0j, POSES), "Pose: q of type ndarray is not an array of numbers"),
        (lambda: Pose(Q, SCALED), "R of sample 1 is not a rotation .*; expected orthonormal"),
        (lambda: Pose(Q, LEFT_HANDED), "det R is -1.*right-handed"),
        (lambda: Pose(Q, POSES, 1e-3), "only one of sigma and rotation_sigma is given; expected both"),
        (lambda: Position(POINTS, Q), r"Position: positions has shape \(5, 6\); expected shape \(5, 3\)"),
        (lambda: Position(Q, POINTS[:3]), "Position: positions has 3 entries for 5 samples"),
        (lambda: Position(Q, POINTS * np.nan), "Position: positions is not finite in row 1"),
        (lambda: Position(Q, POINTS, -1e-3), "sigma has a value that is not positive and finite"),
        (lambda: Position(Q, POINTS, np.ones(4)), r"sigma has shape \(4,\); expected one number or shape"),
        (lambda: PositionComponents(Q, POINTS, (0, 1, 1)), "axes are .*; expected some of 0, 1, 2"),
        (lambda: MultiTargetPosition(Q, POINTS, ["a"]), "targets has 1 names for 5 samples"),
        (lambda: Wires(Q, np.ones((M, 3)), anchors=np.ones((2, 3))), "anchors has 2 entries for 3 wires"),
        (lambda: Wires(Q, np.ones((M, 3)), offsets=[0.0, 0.1]), "offsets has shape .*one per wire"),
        (lambda: Distance(Q, Q[:4], np.ones(M)), "Distance: q_to has 4 entries for 5 samples"),
        (lambda: PointContact(Q, "abcde"), "points is 'abcde'; expected a sequence of 5 names"),
        (lambda: PointContact(Q, WRONG_TYPE), "points is .*; expected a sequence of 5 names"),
        (lambda: PointDistance(6, [("a", "b")], [0.1, 0.2]), "distances has 2 entries for 1 samples"),
        (lambda: SphereContact(Q, np.ones(4)), "radius has 4 entries for 5 samples"),
        (lambda: RelativePose(Q, -Q, SCALED), "RelativePose: poses: .* is not a rotation"),
    ],
)
def test_wrong_arguments_are_named_with_what_is_expected(make, message):
    with pytest.raises(InvalidArgumentError, match=message):
        make()


def test_all_kinds_are_public_names():
    for kind in KINDS.values():
        assert getattr(dhcal_pin, kind.__name__) is kind
