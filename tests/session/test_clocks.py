"""Clocks of joint values and measured values that differ from some sample on, or run at different rates."""

import json
import re
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from camera_setups import ARMS, wrong_arm
from scipy.interpolate import CubicSpline
from slow_cases import some_slow

from dhcal_pin import Chain, calibrate
from dhcal_pin.measurements import Position
from dhcal_pin.plausibility.hypotheses import mend_lines

# Time between samples [s], and time between the random configurations that the path leads through [s].
PERIOD, KNOT_PERIOD = 0.05, 2.0
# Noise of the positions [m], and errors of the links [m].
NOISE, ARM_ERROR = 5e-5, 5e-4
SETS = "minimal,base,tool"


def recorded(name: str, seed: int, m: int, lag: Callable[[np.ndarray], np.ndarray]) -> tuple[Chain, Position]:
    """Record positions along a path; the joint values are too early by a function of the time [s]."""
    rng, chain = np.random.default_rng(seed), ARMS[name]()
    truth = wrong_arm(chain, ARM_ERROR, rng)
    time = PERIOD * np.arange(m)
    knots = np.arange(0.0, time[-1] + 3 * KNOT_PERIOD, KNOT_PERIOD)
    low, high = np.maximum(chain.lower, -1.5), np.minimum(chain.upper, 1.5)
    path = CubicSpline(knots, rng.uniform(low, high, (len(knots), chain.n_joints)))
    positions = truth.poses(path(time + lag(time)))[:, :3, 3] + NOISE * rng.standard_normal((m, 3))
    return chain, Position(path(time), positions).with_conditions(time=time)


def lag_of(fit):
    """Return the lag, which is all that was found."""
    assert fit.session is not None
    assert fit.session.lag is not None
    assert fit.session.found == (fit.session.lag,)
    return fit.session.lag


def rms(fit) -> float:
    """Return the RMS distance of the fitted positions [m]."""
    return fit.comparisons[-1].after.groups["position"].rms


STEPS = list(product([("ur10", 1), ("panda", 2), ("xarm7", 3)], (0.005, 0.02, -0.05), (80, 150, 230)))


@pytest.mark.parametrize(("case", "size", "first"), some_slow(STEPS, {4}))
def test_a_lag_from_some_sample_on_is_named_with_its_line(case, size, first):
    chain, data = recorded(case[0], case[1], 300, lambda t: np.where(np.arange(len(t)) < first, 0.0, size))
    fit = calibrate(chain, data, SETS)
    lag = lag_of(fit)
    assert [part.first.line for part in lag.parts][1] == pytest.approx(first + 1, abs=1)
    assert lag.parts[0].end == pytest.approx(0.0, abs=2e-4)
    assert lag.value == pytest.approx(size, abs=2e-4)
    word = "earlier" if size > 0 else "later"
    assert f"{abs(size):.3f} s {word} than the measured values from line " in lag.finding
    assert "and at the time of the measured values before" in lag.finding
    assert "Record both with one clock" in lag.consequence
    assert rms(fit) < 2.5 * NOISE
    assert fit.verdict.status == "caution"
    # The remedy helps.
    mended = calibrate(chain, mend_lines(chain, [data], f"lag:{lag.value:.4g}", (first + 1, 300)), SETS)
    assert mended.verdict.status == "ok"


DRIFTS = list(product([("ur10", 3), ("panda", 4), ("xarm7", 5)], (1e-4, -1e-3)))


@pytest.mark.parametrize(("case", "rate"), some_slow(DRIFTS, {0}))
def test_clocks_that_drift_apart_are_named_with_their_rate(case, rate):
    chain, data = recorded(case[0], case[1], 600, lambda t: rate * t)
    fit = calibrate(chain, data, SETS)
    lag = lag_of(fit)
    assert lag.rate == pytest.approx(rate, rel=0.05)
    assert f", {1e6 * abs(lag.rate):.0f} ppm" in lag.finding
    assert rms(fit) < 2.5 * NOISE


@pytest.mark.parametrize(
    ("case", "size"), some_slow(list(product([("ur10", 6), ("panda", 7), ("xarm7", 8)], (0.0, 0.02))), {0, 3})
)
def test_one_clock_has_no_change(case, size):
    chain, data = recorded(case[0], case[1], 300, lambda t: np.full(len(t), size))
    fit = calibrate(chain, data, SETS)
    assert fit.session is not None
    if not size:
        assert fit.session.found == ()
        return
    assert len(lag_of(fit).parts) == 1
    assert lag_of(fit).rate == 0


def test_the_stated_options_correct_a_file(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    chain, data = recorded("ur10", 1, 300, lambda t: np.where(np.arange(len(t)) < 150, 0.01, -0.02))
    columns = ["time[s]", *(f"{name}[rad]" for name in chain.joint_names), "x[m]", "y[m]", "z[m]"]
    table = np.column_stack([PERIOD * np.arange(300), data.q, data.positions()])
    np.savetxt("path.csv", table, "%.12g", ",", header=",".join(columns), comments="")
    options = ("calibrate", "example:ur10", "path.csv", "--tip", "tool0", "--parameters", SETS)
    status, _, err = run(*options, "-o", "out.urdf", "--json", "fit.json")
    assert status == 0, err
    document = json.loads(Path("fit.json").read_text())
    lag = document["session"]["lag"]
    assert [(part["file"], part["line"]) for part in lag["parts"]] == [("path.csv", 2), ("path.csv", 152)]
    assert [part["value"] for part in lag["parts"]] == pytest.approx([0.01, -0.02], abs=2e-4)
    (reason,) = document["verdict"]["reasons"]
    assert (
        "0.020 s later than the measured values from line 152 of path.csv on, and 0.010 s earlier" in reason
    )
    mends = re.findall(r"--mend (\S+[0-9])", reason)
    assert [mend.partition("@")[2] for mend in mends] == ["path.csv:2-151", "path.csv:152-301"]
    status, _, err = run(
        *options, "-o", "out.urdf", "--json", "fit.json", *(w for m in mends for w in ("--mend", m))
    )
    assert status == 0, err
    document = json.loads(Path("fit.json").read_text())
    assert document["verdict"]["status"] == "ok"
    assert document["session"]["lag"] is None
