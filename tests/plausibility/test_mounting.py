"""An arm on a wall or a slope: gravity acts against the z axis of the root link of the URDF."""

import re

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from robots import UR10, nominal_arm
from slow_cases import some_slow

from dhcal_pin import calibrate, se3, select_parameters
from dhcal_pin.calibration.summary import accuracy_notes
from dhcal_pin.measurements import Noise, Position
from dhcal_pin.plausibility.mounting import Mounting
from dhcal_pin.robot.chain import Chain

MOUNT = """<link name="ground"/><joint name="mount" type="fixed"><parent link="ground"/>
<child link="{}"/><origin xyz="0 0 1" rpy="{}"/></joint>"""
PLACE = np.array([2.0, 1.0, -0.4, 0.1, -0.2, 0.9])
COMPLIANCE = 3e-6


def mounted(folder, angles):
    """Return a UR10 whose URDF contains a fixed joint with these angles between the ground and the base."""
    root = Chain.from_urdf(UR10, "tool0").root
    mount = MOUNT.format(root, angles)
    path = folder / f"{angles.replace(' ', '_')}.urdf"
    path.write_text(re.sub(r"<robot[^>]*>", lambda tag: tag[0] + mount, UR10.read_text(), count=1))
    return Chain.from_urdf(path, "tool0")


class ElasticArm:
    """A UR10 with errors whose joints yield, and measured positions of it."""

    def __init__(self, nominal, seed, sets="minimal,compliance", count=100):
        rng = np.random.default_rng(seed)
        errors = select_parameters(nominal, sets)
        size = np.array([_size(parameter.name) for parameter in errors.parameters])
        draw = rng.standard_normal(len(size))
        x = np.where(size > 0, size * draw, size * (1 + rng.random(len(size))))
        true = errors.at(x).with_current_loads()
        self.true = true.with_base_and_tool(se3.exp6(PLACE), true.tool)
        self.data = Position.simulate(self.true, rng.uniform(-2.5, 2.5, (count, 6)), Noise(5e-5), rng)
        self.q = rng.uniform(-2.5, 2.5, (300, 6))

    def calibrated(self, nominal):
        """Return a calibration and its RMS position error at new configurations [m]."""
        fit = calibrate(nominal, self.data)
        difference = self.true.poses(self.q)[:, :3, 3] - fit.chain.poses(self.q)[:, :3, 3]
        return fit, float(np.sqrt(np.mean(np.sum(difference**2, 1))))


def _size(name):
    """Return the size of an error; negative for a compliance, which has this sign."""
    if "compliance" in name:
        return -COMPLIANCE
    return 2e-4 if re.search(r"\.(sin|cos|curve)", name) else 1e-3


@pytest.mark.parametrize(
    ("angles", "up", "seed"),
    some_slow(
        [
            (angles, up, seed)
            for angles, up in (
                ("0 1.5707963 0", (-1.0, 0.0, 0.0)),
                ("1.5707963 0 0", (0.0, 1.0, 0.0)),
                ("0.7853982 0 0", (0.0, np.sqrt(0.5), np.sqrt(0.5))),
                ("2.5 0.3 0", None),
            )
            for seed in range(6)
        ],
        {0, 12},
    ),
)
def test_the_named_fixed_joint_makes_an_arm_accurate(tmp_path, angles, up, seed):
    right = mounted(tmp_path, angles)
    arm = ElasticArm(right, seed)
    upright = nominal_arm("ur10")
    fit, error = arm.calibrated(upright)
    assert fit.mounting
    if up is not None:
        assert np.dot(fit.mounting.up, up) > np.cos(np.deg2rad(12))
    note = accuracy_notes(fit)[-1]
    assert note == fit.mounting.sentence
    (named,) = re.findall(r'rpy="([-\d. ]+)"', note)
    np.testing.assert_allclose(fit.mounting.to_dict()["rpy_rad"], np.array(named.split(), float), atol=6e-4)
    stated, mended_error = arm.calibrated(mounted(tmp_path, named))
    assert stated.mounting is None
    assert stated.verdict.status == "ok"
    assert mended_error < error / 2.5
    # The right angles are hardly better.
    known, known_error = arm.calibrated(right)
    assert known.mounting is None
    assert mended_error < max(2 * known_error, 6e-5)


@pytest.mark.parametrize(
    ("sets", "seed"),
    some_slow(
        [
            (sets, seed)
            for sets in ("minimal,compliance", "minimal,harmonics", "minimal,harmonics,compliance,curves")
            for seed in range(8)
        ],
        {0, 8, 16},
    ),
)
def test_an_upright_arm_gets_no_note(sets, seed):
    upright = nominal_arm("ur10")
    fit, _ = ElasticArm(upright, seed, sets, 200).calibrated(upright)
    assert fit.extension
    assert fit.extension.families
    assert fit.mounting is None


def test_without_elasticity_or_masses_nothing_is_found():
    upright = nominal_arm("ur10")
    fit, _ = ElasticArm(upright, 0, "minimal").calibrated(upright)
    assert fit.extension
    assert fit.extension.families == ()
    assert fit.mounting is None
    panda = nominal_arm("panda")
    rng = np.random.default_rng(0)
    errors = select_parameters(panda, "minimal,harmonics")
    true = errors.at(3e-4 * rng.standard_normal(len(errors.parameters)))
    data = Position.simulate(true, rng.uniform(-2, 2, (200, 7)), Noise(5e-5), rng)
    assert calibrate(panda, data).mounting is None


@pytest.mark.parametrize("sets", ["minimal", "minimal,compliance"])
def test_measurements_without_noise_show_nothing_by_rounding_errors(sets):
    upright = nominal_arm("ur10")
    arm = ElasticArm(upright, 1, sets)
    exact = Position(arm.data.q, arm.true.poses(arm.data.q)[:, :3, 3])
    assert calibrate(upright, exact).mounting is None


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: 0.1 < np.hypot(v[0], v[1])))
def test_the_angles_turn_the_direction_up_to_the_z_axis(vector):
    up = np.array(vector) / np.linalg.norm(vector)
    turned = pin.rpy.rpyToMatrix(Mounting(up, "base").angles) @ up
    np.testing.assert_allclose(turned, [0, 0, 1], atol=1e-12)
