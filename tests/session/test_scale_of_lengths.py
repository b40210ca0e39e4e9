"""A wrong scale of an instrument that measures lengths, or that measures an arm of prismatic joints."""

from dataclasses import replace

import numpy as np
import pytest
from robots import nominal_arm, with_small_errors
from slow_cases import some_slow

from dhcal_pin import calibrate
from dhcal_pin.estimation.initialization import make_problem
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.measurements import Distance, Noise, PointContact, PointDistance, Position, Wires
from dhcal_pin.robot import Chain
from dhcal_pin.robot.urdf import parse_urdf
from dhcal_pin.session import scale as scale_module
from dhcal_pin.session.scale import find_scale

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


# ------------------------------------------------------------------------------------- decision by its parts
@pytest.fixture(scope="module")
def problem():
    """Return the calibration of a UR10 from 20 positions."""
    rng = np.random.default_rng(0)
    chain = nominal_arm("ur10")
    errors = select_parameters(chain, "minimal,base,tool")
    q = rng.uniform(-2, 2, (20, 6))
    data = Position(q, chain.poses(q)[:, :3, 3], 1e-4)
    return make_problem(errors, (data,), 1 / errors.priors, {})


def corrections(problem, change, *, errors=1.0, of_angles=1.0, n_shown=24, pattern=2e3):
    """Return corrections of an arm by a scale and by errors, and what `_responses` returns.

    The errors are in expected ones; those of angles have another factor. A scale of 1 causes `pattern`
    standard deviations of each length. Noise hides all but some corrections.
    """
    rng = np.random.default_rng(0)
    (arm,) = np.nonzero(problem.errors.is_of_arm)
    prior = problem.errors.priors[arm]
    is_length = np.array([problem.errors.parameters[i].unit == "m" for i in arm])
    by_scale = np.where(is_length, pattern, 0.0) * prior * rng.choice([-1, 1], len(arm))
    x = np.zeros(len(problem.weights))
    drawn = errors * np.where(is_length, 1.0, of_angles) * rng.permutation(np.linspace(-1.5, 1.5, len(arm)))
    x[arm] = change * by_scale + drawn * prior
    is_hidden = np.isin(np.arange(len(arm)), np.flatnonzero(is_length)[n_shown:])
    noise = np.diag(prior**2 * np.where(is_hidden, 1e8, 1e-6))
    by_lengths, by_angles = (np.diag(np.where(chosen, prior**2, 0.0)) for chosen in (is_length, ~is_length))
    return x, (noise, by_scale, by_lengths, by_angles)


@pytest.mark.parametrize(
    ("change", "is_found"),
    [(0.9e-3, False), (1.1e-3, True), (-1.1e-3, True), (-0.9e-3, False), (0.32, True), (0.34, False),
     (-0.98, True), (-1.02, False)],
)  # fmt: skip
def test_a_scale_is_stated_from_a_thousandth_to_a_half(problem, monkeypatch, change, is_found):
    x, responses = corrections(problem, change, errors=0.2, pattern=2e4)
    monkeypatch.setattr(scale_module, "_responses", lambda *args: responses)
    found = find_scale(problem, x)
    assert (found is not None) == is_found
    if found is not None:
        assert 1 - 1 / found.factor == pytest.approx(change, abs=3e-5)
        assert (found.axis, found.stated) == ("", "")


@pytest.mark.parametrize(
    ("options", "is_found"),
    [
        ({}, True),
        ({"n_shown": 3}, True),
        ({"n_shown": 2, "pattern": 2e5}, False),  # two lengths hardly show their own size
        ({"errors": 100.0, "pattern": 2e5}, False),  # larger errors than any arm has
        ({"errors": 10.0, "pattern": 2e5}, True),
        ({"of_angles": 100.0}, False),
        ({"of_angles": 10.0}, True),
        ({"errors": 1.0, "pattern": 80.0}, False),  # chance explains it
        ({"pattern": 0.0}, False),  # a scale changes no correction
    ],
)
def test_a_scale_needs_several_lengths_of_plausible_errors(problem, monkeypatch, options, is_found):
    x, responses = corrections(problem, 0.01, **options)
    monkeypatch.setattr(scale_module, "_responses", lambda *args: responses)
    assert (find_scale(problem, x) is not None) == is_found


@pytest.mark.parametrize(("size", "is_found"), [(0.49, False), (0.51, True)])
def test_corrections_of_half_of_the_expected_ones_show_no_scale(problem, monkeypatch, size, is_found):
    x, responses = corrections(problem, 0.01, errors=0.0)
    lengths = [
        i for i, p in enumerate(problem.errors.parameters) if p.unit == "m" and problem.errors.is_of_arm[i]
    ]
    x *= size / np.sqrt(np.mean((x / problem.errors.priors)[lengths] ** 2))
    monkeypatch.setattr(scale_module, "_responses", lambda *args: responses)
    monkeypatch.setattr(scale_module, "MIN_CHANGE", 1e-6)
    assert (find_scale(problem, x) is not None) == is_found


def test_measurements_without_lengths_show_no_scale(problem, monkeypatch):
    x, responses = corrections(problem, 0.01)
    monkeypatch.setattr(scale_module, "_responses", lambda *args: responses)
    contacts = PointContact(problem.data[0].q, ["a", "b"] * 10)
    (positions,) = problem.data
    distances = PointDistance(6, [("a", "b")], [1.0])
    for data, is_found, stated in (
        ([contacts], False, ""),
        ([contacts, positions], True, ""),
        ([contacts, distances], True, "length between the points"),
        ([positions, distances], True, ""),
    ):
        found = find_scale(replace(problem, data=tuple(data)), x)
        assert (found is not None) == is_found
        if found is not None:
            assert found.stated == stated
