"""A wrong scale of an instrument that measures lengths, or that measures an arm of prismatic joints."""

import numpy as np
import pytest
from robots import nominal_arm, with_small_errors
from slow_cases import some_slow

from dhcal_pin import calibrate
from dhcal_pin.measurements import Distance, Noise, Position, Wires
from dhcal_pin.robot import Chain
from dhcal_pin.robot.urdf import parse_urdf

FACTOR = 1.01
CASES = [(kind, seed) for kind in (Distance, Wires) for seed in range(6)]

GANTRY = """<robot name="gantry"><link name="base"/>
{joints}</robot>"""
JOINT = """<joint name="{name}" type="prismatic"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="0 0 0.1"/><axis xyz="{axis}"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<link name="{child}"/>
"""


def measured(kind, seed, factor):
    """Return a nominal UR10 and lengths that are too long by a factor."""
    rng = np.random.default_rng(seed)
    nominal = nominal_arm("ur10")
    true = with_small_errors(nominal, rng)
    q = rng.uniform(-2, 2, (120, 6))
    configurations = np.concatenate([q, rng.uniform(-2, 2, (120, 6))]) if kind is Distance else q
    item = kind.simulate(true, configurations, Noise(5e-5, 1e-4), rng)
    return nominal, item.replace(values=factor * item.values)


@pytest.mark.parametrize(("kind", "seed"), some_slow(CASES, {0}))
def test_a_wrong_scale_of_lengths_is_found_and_mended(kind, seed):
    nominal, data = measured(kind, seed, FACTOR)
    fit = calibrate(nominal, data)
    assert fit.session
    (scale,) = fit.session.scales
    assert (scale.axis, scale.factor) == ("", pytest.approx(FACTOR, abs=3 * scale.std))
    assert fit.verdict.status == "caution"
    mended = calibrate(nominal, data.replace(values=data.values / scale.factor))
    assert not (mended.session and mended.session.scales)
    assert mended.verdict.status == "ok"


@pytest.mark.parametrize(("kind", "seed"), some_slow(CASES, {7}))
def test_lengths_of_a_right_scale_show_none(kind, seed):
    fit = calibrate(*measured(kind, seed, 1.0))
    assert not (fit.session and fit.session.scales)
    assert fit.verdict.status == "ok"


@pytest.mark.parametrize("factor", [1.0, FACTOR])
def test_a_scale_is_not_taken_for_gears_of_prismatic_joints(factor):
    rng = np.random.default_rng(3)
    links = ["base", "x", "y", "z"]
    joints = "".join(
        JOINT.format(name=f"slide_{child}", parent=parent, child=child, axis=axis)
        for parent, child, axis in zip(links[:-1], links[1:], ("1 0 0", "0 1 0", "0 0 1"), strict=True)
    )
    nominal = Chain.from_urdf(parse_urdf(GANTRY.format(joints=joints).encode(), "gantry"), "z")
    true = with_small_errors(nominal, rng)
    q = rng.uniform(-0.8, 0.8, (100, 3))
    positions = true.poses(q)[:, :3, 3] * factor + 5e-5 * rng.standard_normal((100, 3))
    fit = calibrate(nominal, Position(q, positions))
    assert fit.session
    found = [scale.factor for scale in fit.session.scales]
    assert found == ([pytest.approx(FACTOR, abs=1e-3)] if factor > 1 else [])
