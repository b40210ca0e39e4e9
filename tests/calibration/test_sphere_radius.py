"""Touches of spheres whose stated radius is wrong, against the known truth of simulated arms."""

import numpy as np
import pytest
from robots import nominal_arm
from slow_cases import some_slow

from dhcal_pin.calibration import Result, calibrate
from dhcal_pin.calibration.summary import RADIUS_ERROR, size_notes
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Noise, Position, SphereContact
from dhcal_pin.robot import Chain

RADIUS = 0.15  # Radius of simulated spheres [m]


def touched(seed: int, stated: float) -> tuple[Chain, Chain, list[SphereContact]]:
    """Return a nominal UR10, the true one, and 100 touches of each of four spheres with a stated radius."""
    rng, nominal = np.random.default_rng(seed), nominal_arm("ur10")
    errors = select_parameters(nominal, "placement,tool")
    size = np.array([3e-3 if p.unit == "rad" else 1e-3 for p in errors.parameters])
    truth = errors.at(size * rng.standard_normal(len(size)))
    spheres = [
        SphereContact.simulate(truth, rng.uniform(-2.5, 2.5, (100, 6)), Noise(5e-5), rng) for _ in range(4)
    ]
    return nominal, truth, [SphereContact(s.q, stated, name=f"s{i}") for i, s in enumerate(spheres)]


def fitted(seed: int, stated: float, scale: float = 1.0) -> tuple[Result, Chain]:
    """Calibrate from touches with a stated radius, divided by a scale; return also the true arm."""
    nominal, truth, data = touched(seed, stated)
    data = [item.replace(values=item.values / scale) for item in data]
    return calibrate(nominal, data, "placement,tool", extend="none"), truth


def true_error(fit: Result, truth: Chain) -> float:
    """Return the RMS position error in random configurations, with base and tool fitted [m]."""
    rng = np.random.default_rng(9)
    data = Position.simulate(truth, rng.uniform(-2.5, 2.5, (200, 6)), Noise(1e-6), rng)
    frames = calibrate(fit.chain, data, "base,tool", extend="none", session="off")
    return frames.comparisons[-1].after["position_rms_m"]


@pytest.mark.parametrize("seed", some_slow(range(8), {0}))
def test_a_diameter_in_place_of_a_radius_is_refused(seed):
    fit, _ = fitted(seed, 2 * RADIUS)
    assert fit.verdict.status == "refused"
    assert fit.verdict.reasons[0].startswith("The column radius probably has the diameters of the spheres")


@pytest.mark.parametrize("seed", some_slow(range(8), {0}))
def test_a_right_radius_is_not_questioned(seed):
    fit, truth = fitted(seed, RADIUS)
    assert fit.verdict.status == "ok"
    assert true_error(fit, truth) < 2e-4


@pytest.mark.parametrize(
    ("forgotten", "seed"), some_slow([(b, s) for s in range(4) for b in (3e-3, 10e-3)], {1})
)
def test_a_forgotten_radius_of_the_ball_on_the_tool_is_named(forgotten, seed):
    """10 mm of 150 mm make the robot 7 % smaller, which no manufacturing error does."""
    fit, truth = fitted(seed, RADIUS - forgotten)
    assert fit.verdict.status == ("refused" if forgotten > 5e-3 else "caution")
    (reason,) = fit.verdict.reasons
    assert "Check the stated radius of the spheres, which includes that of the ball on the tool" in reason
    assert fit.session
    (scale,) = fit.session.scales
    assert scale.factor == pytest.approx(1 - forgotten / RADIUS, abs=4 * scale.std)
    mended, _ = fitted(seed, RADIUS - forgotten, scale.factor)
    assert not mended.verdict.is_refused
    assert true_error(mended, truth) < 0.2 * true_error(fit, truth)


@pytest.mark.parametrize("seed", some_slow(range(8), {0}))
def test_the_error_by_a_wrong_radius_is_stated(seed):
    """What is too little to be found makes the robot larger by the same part as the spheres."""
    fit, truth = fitted(seed, RADIUS + RADIUS_ERROR)
    (note,) = size_notes(fit)
    stated = 1e-3 * float(note.rsplit("about ", 1)[1].removesuffix(" mm."))
    assert 0.6 * stated < true_error(fit, truth) < 1.4 * stated
    _, _, data = touched(seed, RADIUS)
    positions = Position.simulate(truth, data[0].q, Noise(1e-4), np.random.default_rng(seed))
    both = calibrate(nominal_arm("ur10"), [*data, positions], "placement,tool,base", extend="none")
    assert not size_notes(both)
