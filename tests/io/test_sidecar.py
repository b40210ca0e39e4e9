"""Sidecars: written, read back, replaced, and refused if invalid."""

import hashlib
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from robots import write

from dhcal_pin import se3
from dhcal_pin.estimation import PARAMETER_SETS, Uncertainty
from dhcal_pin.estimation.uncertainty import FamilyGain, ModelFit
from dhcal_pin.exceptions import DhcalError, InvalidArgumentError
from dhcal_pin.io import (
    read_instrument,
    read_measured_region,
    read_robot,
    read_uncertainty,
    urdf_files,
)
from dhcal_pin.io.robot import write_urdf
from dhcal_pin.io.sidecar import Findings, sidecar_text
from dhcal_pin.measurements import MeasuredRegion
from dhcal_pin.robot import Transmission
from dhcal_pin.robot.error_families import JOINT_TERMS
from dhcal_pin.robot.transmission import coefficient_indices
from dhcal_pin.robot.urdf import parse_urdf


def test_base_and_tool_are_read_back_from_the_sidecar(tmp_path, scara):
    rng = np.random.default_rng(0)
    placed = replace(scara, base=se3.exp6(rng.normal(size=6)), tool=se3.exp6(rng.normal(size=6)))
    write_urdf(placed, tmp_path / "out.urdf")
    q = rng.uniform(-1, 1, (20, 2))
    np.testing.assert_allclose(read_robot(tmp_path / "out.urdf").poses(q), placed.poses(q), atol=1e-12)


@pytest.mark.parametrize("name", ["x.txt", "x", "x.urdf.xacro", "x.dh.toml", "x.json", "urdf"])
def test_a_robot_is_not_written_under_an_unknown_ending(tmp_path, scara, name):
    with pytest.raises(InvalidArgumentError, match=r"expected \.urdf or \.xml$"):
        write_urdf(scara, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_an_old_sidecar_is_replaced_with_its_robot(tmp_path, scara):
    assert list(urdf_files(scara, tmp_path / "out.urdf")) == [tmp_path / "out.urdf"]
    base = np.eye(4)
    base[:3, 3] = 1.0, 2.0, 3.0
    write_urdf(replace(scara, base=base), tmp_path / "out.urdf")
    side = tmp_path / "out.calibration.toml"
    assert tomllib.loads(side.read_text())["base"]["xyz_m"] == [1.0, 2.0, 3.0]
    write_urdf(scara, tmp_path / "out.urdf")
    assert tomllib.loads(side.read_text())["base"]["xyz_m"] == [0.0, 0.0, 0.0]
    np.testing.assert_array_equal(read_robot(tmp_path / "out.urdf").base, np.eye(4))


def test_elasticity_of_a_joint_that_gravity_does_not_load_is_read_back(tmp_path):
    """Gravity loaded it in the nominal robot."""
    arm = read_robot("example:ur10", "tool0")
    names = [parameter.name for parameter in PARAMETER_SETS["compliance"](arm)]
    assert "wrist_3_joint.compliance" not in names
    terms = coefficient_indices(6, 6).joint_terms[list(JOINT_TERMS).index("compliance")]
    arm = arm.with_transmission(Transmission.zero(arm.loads))
    root = np.random.default_rng(0).normal(size=(6 * 7 + 6, 3))
    known = Uncertainty(arm, terms, root, root[:, :0])
    path = write(
        tmp_path, "a.toml", sidecar_text(arm, np.eye(4), arm.urdf, Findings(uncertainty=known), {}) or ""
    )
    read = read_uncertainty(path, arm)
    assert read is not None
    np.testing.assert_array_equal(read.entries, terms)
    np.testing.assert_array_equal(read.sqrt_covariance, root)


@pytest.mark.parametrize(
    ("text", "words"),
    [("[gripper]\n", "gripper"), ("base = 1\n", "is not a table"), ("[tool]\nxyz_m = [1, 2]\n", "3 numbers")],
)
def test_an_invalid_sidecar_is_an_error(tmp_path, text, words, scara):
    write_urdf(scara, tmp_path / "arm.urdf")
    path = write(tmp_path, "arm.calibration.toml", text)
    with pytest.raises(DhcalError, match=words) as caught:
        read_robot(tmp_path / "arm.urdf")
    assert str(path) in str(caught.value)


def test_sidecar_text_is_toml(scara):
    urdf = b'<robot name="r"><link name="a &quot;b&quot;"/></robot>'
    robot = parse_urdf(urdf, "")
    text = sidecar_text(replace(scara, tip='a "b"'), np.eye(4), robot, Findings(), {}, required=True)
    assert text is not None
    content = tomllib.loads(text)
    assert set(content) == {"tip", "base", "tool", "manifest"}
    assert content["manifest"]["urdf_sha256"] == hashlib.sha256(urdf).hexdigest()


def test_numbers_are_read_back_bit_identical(tmp_path, scara):
    values = {
        "wire1.x": 0.1 + 0.2,
        'a "b"': -0.0,
        "plane.d": 5e-324,
        "é [x]": 1.7e299,
        "n": -1e-7,
    }
    n_rows = 6 * (len(scara.moving_joints) + 1)
    rows = np.random.default_rng(0).normal(size=(2, n_rows, 3))
    stated = ModelFit(12.3, 45.6, {"harmonics": FamilyGain(31.2, 4, 40)}, (5.4e-5, 0.0))
    known = Uncertainty(scara, np.array([], int), rows[0], rows[1], fit=stated)
    q = np.random.default_rng(1).normal(size=(9, scara.n_joints))
    region = MeasuredRegion.from_configurations(q, scara.is_prismatic).with_reach(q, q.T > 0)
    region = replace(region, payloads=(0.0, 0.1 + 0.2))
    for path, content in urdf_files(scara, tmp_path / "out.urdf", Findings(values, known, region)).items():
        write(tmp_path, str(path), content)
    side = tmp_path / "out.calibration.toml"
    assert {name: value.hex() for name, value in read_instrument(side).items()} == {
        name: value.hex() for name, value in values.items()
    }
    again = read_uncertainty(side, scara)
    assert again is not None
    np.testing.assert_array_equal(again.sqrt_covariance, rows[0])
    np.testing.assert_array_equal(again.unbounded_directions, rows[1])
    assert again.fit == stated
    region_again = read_measured_region(side, scara)
    assert region_again is not None
    for name in ("lower", "upper", "spread", "configurations", "radius", "reach", "is_prismatic"):
        np.testing.assert_array_equal(getattr(region_again, name), getattr(region, name))
    assert region_again.payloads == region.payloads
    assert side.read_text().startswith("# ")
    # Texts without escapes are read faster.
    assert "sqrt_covariance = '''\n" in side.read_text()


@pytest.mark.parametrize(
    "left_out", ['[["waves", 1.0, 4, 40]]', '[["gain", 1.0, 4]]', '[["gain", -1.0, 4, 40]]']
)
def test_an_invalid_family_of_an_uncertainty_is_an_error(tmp_path, scara, left_out):
    text = f'[uncertainty]\njoints = ["shoulder", "lift"]\nterms = []\nleft_out = {left_out}\n'
    path = write(tmp_path, "arm.calibration.toml", text)
    with pytest.raises(DhcalError, match=r"left_out.*such as"):
        read_uncertainty(path, scara)


REGION = """[measured]
joints = ["shoulder", "lift"]
lower = [0.0, 0.0]
upper = [1.0, 0.1]
spread = [0.5, 0.05]
radius = 0.2
reach = 0.3
configurations = "AAAAAAAAAAAAAAAAAAAAAA=="
"""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"lift"', '"drop"', "expected the joints of this robot: shoulder, lift"),
        ("0.2", "-0.2", "radius"),
        ("[1.0, 0.1]", "[1.0]", "2 numbers"),
        ("AAAA", "A?AA", "base64"),
        ("AAAAAAAAAAAAAAAAAAAAAA==", "", "at least one configuration"),
        ("radius", "raduis", "raduis"),
    ],
)
def test_an_invalid_measured_region_is_an_error(tmp_path, scara, old, new, words):
    path = write(tmp_path, "arm.calibration.toml", REGION)
    region = read_measured_region(path, scara)
    assert region is not None
    assert region.configurations.shape == (1, 2)
    write(tmp_path, "arm.calibration.toml", REGION.replace(old, new))
    with pytest.raises(DhcalError, match=words) as caught:
        read_measured_region(path, scara)
    assert str(path) in str(caught.value)
