"""Characteristics of ISO 9283 against an example that is calculated by hand."""

from math import sqrt

import numpy as np
import pytest

from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.io import read_robot
from dhcal_pin.iso9283 import pose_characteristics
from dhcal_pin.measurements import Distance, Pose, Position
from dhcal_pin.se3 import exp3, transform

# Three slides along x, y and z: the joint positions are the commanded position.
GANTRY = (
    """<robot name="gantry"><link name="base"/><link name="a"/><link name="b"/><link name="c"/>{}</robot>"""
)
SLIDE = """<joint name="{0}" type="prismatic"><parent link="{1}"/><child link="{2}"/><axis xyz="{3}"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>"""
SLIDES = (("jx", "base", "a", "1 0 0"), ("jy", "a", "b", "0 1 0"), ("jz", "b", "c", "0 0 1"))

# Commanded positions, then for each of four cycles the attained minus the commanded position [mm].
EXAMPLE = {
    "P1": ((500, 0, 500), [(0.5, -0.1, 0.2), (-0.1, -0.1, 0.2), (0.2, 0.0, 0.2), (0.2, -0.2, 0.2)]),
    "P2": ((500, 0, 100), [(0, 0, 0.9), (0, 0, 0.3), (0, 0, 0.7), (0, 0, 0.5)]),
    "P3": ((500, 300, 300), [(0, 0, 0.4)] * 4),
    "P4": ((500, 0, 900), [(0, 0, 0.5), (0, 0, -0.1), (0, 0, 0.5), (0, 0, -0.1)]),
    "P5": ((500, -300, 700), [(0.6, 0.2, 0.7), (0.6, 0.2, -0.1), (0.6, 0.2, 0.3), (0.6, 0.2, 0.3)]),
}
# P1: barycentre off by (0.2, -0.1, 0.2), |.| = sqrt(0.04 + 0.01 + 0.04) = 0.3; distances from it 0.3, 0.3,
# 0.1, 0.1 with mean 0.2 and S = sqrt(4 · 0.1² / 3). P2: off by 0.6, the same distances. P3: no scatter. P4:
# off by 0.2, distances all 0.3. P5: off by (0.6, 0.2, 0.3), |.| = 0.7; distances 0.4, 0.4, 0, 0 with mean 0.2
# and S = sqrt(4 · 0.2² / 3).
ACCURACY = {"P1": 0.3, "P2": 0.6, "P3": 0.4, "P4": 0.2, "P5": 0.7}
REPEATABILITY = {
    "P1": 0.2 + 3 * sqrt(0.04 / 3),
    "P2": 0.2 + 3 * sqrt(0.04 / 3),
    "P3": 0.0,
    "P4": 0.3,
    "P5": 0.2 + 3 * sqrt(0.16 / 3),
}
# P2 to P4: commanded 800; attained 800 + 0.5 - 0.9, 800 - 0.1 - 0.3, 800 + 0.5 - 0.7, 800 - 0.1 - 0.5, which
# are 799.6, 799.6, 799.8, 799.4 with mean 799.6 and S = sqrt(2 · 0.2² / 3).
DISTANCE_ACCURACY, DISTANCE_REPEATABILITY = -0.4, 3 * sqrt(0.08 / 3)


@pytest.fixture(scope="module")
def gantry(tmp_path_factory):
    path = tmp_path_factory.mktemp("gantry") / "gantry.urdf"
    path.write_text(GANTRY.format("".join(SLIDE.format(*slide) for slide in SLIDES)))
    return read_robot(path)


def samples(cycles=4):
    """Return joint positions, attained positions [m] and labels in the order of measurement."""
    rows = [
        (np.array(commanded) / 1e3, (np.array(commanded) + errors[cycle]) / 1e3, (name, cycle + 1))
        for cycle in range(cycles)
        for name, (commanded, errors) in EXAMPLE.items()
    ]
    q, attained, labels = zip(*rows, strict=True)
    return np.array(q), np.array(attained), list(labels)


@pytest.mark.parametrize("is_named", [True, False])
def test_hand_example(gantry, is_named):
    q, attained, labels = samples()
    found = pose_characteristics(gantry, [Position(q, attained)], [labels if is_named else None]).to_dict()
    assert [point["point"] for point in found["points"]] == list(EXAMPLE)
    for point in found["points"]:
        name = point["point"]
        assert point["cycles"] == 4
        assert 1e3 * point["AP_p_m"] == pytest.approx(ACCURACY[name], abs=1e-9)
        assert 1e3 * point["RP_l_m"] == pytest.approx(REPEATABILITY[name], abs=1e-9)
        assert "AP_a_rad" not in point
    first = found["points"][0]
    assert [1e3 * first[f"AP_{axis}_m"] for axis in "xyz"] == pytest.approx([0.2, -0.1, 0.2], abs=1e-9)
    (pair,) = [each for each in found["distances"] if each["points"] == ["P2", "P4"]]
    assert 1e3 * pair["AD_m"] == pytest.approx(DISTANCE_ACCURACY, abs=1e-9)
    assert 1e3 * pair["RD_m"] == pytest.approx(DISTANCE_REPEATABILITY, abs=1e-9)
    overall = {name: 1e3 * value for name, value in found["overall"].items()}
    assert overall["AP_p_m"] == pytest.approx(0.7, abs=1e-9)
    assert overall["RP_l_m"] == pytest.approx(REPEATABILITY["P5"], abs=1e-9)
    assert overall["AD_m"] == pytest.approx(DISTANCE_ACCURACY, abs=1e-9)


def test_visits_with_the_joint_values_of_encoders_are_one_point(gantry):
    q, attained, _ = samples()
    read = q + np.random.default_rng(0).uniform(-1e-4, 1e-4, q.shape)
    found = pose_characteristics(gantry, [Position(read, attained)], [None]).to_dict()
    for point in found["points"]:
        assert point["cycles"] == 4
        assert 1e3 * point["RP_l_m"] == pytest.approx(REPEATABILITY[point["point"]], abs=1e-9)
        assert 1e3 * point["AP_p_m"] == pytest.approx(ACCURACY[point["point"]], abs=0.1)


def test_orientations_of_the_hand_example(gantry):
    """P1 turns about z by 1, 3, 1, 3 mrad: mean 2, S = sqrt(4 / 3)."""
    q, attained, labels = samples()
    turns = np.array([[0, 0, 1e-3 * (1 + 2 * (cycle % 2 == 0))] for _, cycle in labels])
    turns[[name != "P1" for name, _ in labels]] = 0
    data = Pose(q, transform(exp3(turns), attained))
    found = pose_characteristics(gantry, [data], [labels]).to_dict()["points"]
    assert [found[0][f"AP_{axis}_rad"] for axis in "abc"] == pytest.approx([0, 0, 2e-3], abs=1e-12)
    assert [found[0][f"RP_{axis}_rad"] for axis in "abc"] == pytest.approx(
        [0, 0, 3e-3 * sqrt(4 / 3)], abs=1e-12
    )
    assert found[1]["RP_c_rad"] == pytest.approx(0, abs=1e-12)
    assert 1e3 * found[0]["RP_l_m"] == pytest.approx(REPEATABILITY["P1"], abs=1e-9)


def test_drift_compares_groups_of_ten_cycles(gantry):
    """The first ten cycles are off by 0.1 mm, the others by 0.4 mm and then 0.2 mm, without scatter."""
    q = np.tile([0.5, 0.0, 0.5], (30, 1))
    attained = q + np.repeat([[1e-4, 0, 0], [4e-4, 0, 0], [2e-4, 0, 0]], 10, axis=0)
    (point,) = pose_characteristics(gantry, [Position(q, attained)], [None]).to_dict()["points"]
    assert 1e3 * point["dAP_p_m"] == pytest.approx(0.3, abs=1e-9)
    assert 1e3 * point["dRP_l_m"] == pytest.approx(0, abs=1e-9)


def test_lines_that_miss_a_point_do_not_shift_the_cycles(gantry):
    q, attained, labels = samples()
    kept = [i for i, label in enumerate(labels) if label != ("P2", 2)]
    data = Position(q[kept], attained[kept])
    found = pose_characteristics(gantry, [data], [[labels[i] for i in kept]]).to_dict()
    (pair,) = [each for each in found["distances"] if each["points"] == ["P2", "P4"]]
    # Without the second distance: 799.6, 799.8, 799.4 with S = 0.2.
    assert 1e3 * pair["RD_m"] == pytest.approx(0.6, abs=1e-9)


def test_unsuitable_measurements_are_refused(gantry):
    q, attained, labels = samples()
    with pytest.raises(InvalidArgumentError, match="point P1 has one cycle"):
        pose_characteristics(gantry, [Position(q[:5], attained[:5])], [labels[:5]])
    with pytest.raises(InvalidArgumentError, match=r"joint values of point P1 differ by 0\.8"):
        pose_characteristics(gantry, [Position(q, attained)], [[("P1", 0)] * len(q)])
    lengths = Distance(q, q, np.ones(len(q)))
    with pytest.raises(InvalidArgumentError, match=r"kind distance; expected positions"):
        pose_characteristics(gantry, [lengths], [labels])
