"""Backlash of the joints of files that state no directions of motion, from the order of their samples."""

import json

import numpy as np
import pytest
from robots import nominal_arm, with_small_errors
from slow_cases import some_slow

from dhcal_pin import calibrate
from dhcal_pin.cli import main
from dhcal_pin.measurements import Position

NOISE = 5e-5
BACKLASH = np.deg2rad(0.03)


def measure(seed, width=BACKLASH, m=120):
    """Return a nominal UR10, the true one, and positions in order; its joints lag by half of the width."""
    rng = np.random.default_rng(seed)
    nominal = nominal_arm("ur10")
    true = with_small_errors(nominal, rng)
    q = rng.uniform(-2, 2, (m, 6))
    lag = 0.5 * width * np.sign(np.diff(q, axis=0, prepend=rng.uniform(-2, 2, (1, 6))))
    positions = true.poses(q - lag)[:, :3, 3] + NOISE * rng.standard_normal((m, 3))
    return nominal, true, Position(q, positions)


def families(fit):
    return fit.extension.families if fit.extension else ()


@pytest.mark.parametrize("seed", some_slow(range(6), {0}))
def test_backlash_follows_from_the_order_of_the_samples(seed):
    nominal, true, data = measure(seed)
    fit = calibrate(nominal, data)
    assert "backlash" in families(fit)
    assert fit.verdict.status == "ok"
    is_width = np.array([p.name.endswith(".backlash") for p in fit.parameters])
    # The last joint hardly moves the measured point.
    widths, std = fit.x[is_width][:5], fit.std[is_width][:5]
    assert np.all(np.abs(widths - BACKLASH) < 4 * std)
    assert np.all(std[:3] < 0.1 * BACKLASH)
    # In the middle of the backlash, as in the truth.
    q = np.random.default_rng(99).uniform(-2, 2, (200, 6))
    error = np.linalg.norm(fit.chain.poses(q)[:, :3, 3] - true.poses(q)[:, :3, 3], axis=1)
    assert np.sqrt(np.mean(error**2)) < 1.5e-4


@pytest.mark.parametrize("seed", some_slow(range(6), {1}))
def test_samples_in_another_order_show_no_backlash(seed):
    nominal, _, data = measure(seed)
    order = np.random.default_rng(seed).permutation(len(data.rows))
    shuffled = Position(data.q[order], data.positions()[order])
    for fit in (calibrate(nominal, shuffled), calibrate(nominal, data, session="unordered")):
        assert "backlash" not in families(fit)
        assert fit.data[0].recorded is None


@pytest.mark.parametrize("seed", some_slow(range(20), {2, 3}))
def test_an_arm_without_backlash_keeps_its_samples(seed):
    nominal, _, data = measure(seed, width=0.0, m=50)
    fit = calibrate(nominal, data)
    assert "backlash" not in families(fit)
    assert fit.data[0].recorded is None


def test_held_out_samples_have_the_directions_of_the_same_order():
    nominal, _, data = measure(4)
    is_held_out = np.random.default_rng(4).random(len(data.rows)) < 0.3
    fit = calibrate(nominal, data.take(~is_held_out), holdout=data.take(is_held_out))
    assert "backlash" in families(fit)
    (comparison,) = (each for each in fit.comparisons if each.title == "hold-out")
    assert comparison.after.groups["position"].rms < 1.5e-4


def test_the_warning_asks_for_the_order_and_stating_it_gives_the_same(tmp_path, capsys):
    _, _, data = measure(0)
    header = ",".join([*(f"{name}[rad]" for name in nominal_arm("ur10").joint_names), "x[m]", "y[m]", "z[m]"])
    path, results = tmp_path / "data.csv", []
    for comment in ("", "# rows: in order\n"):
        path.write_text(f"{comment}{header}\n")
        with path.open("a") as file:
            np.savetxt(file, np.hstack([data.q, data.positions()]), "%.12f", ",")
        result = tmp_path / "r.json"
        command = ["calibrate", "example:ur10", path, "--tip", "tool0", "-o", tmp_path / "c.urdf"]
        assert main.main([*map(str, command), "--json", str(result)]) == 0
        results.append(json.loads(result.read_text()))
        capsys.readouterr()
    warned, stated = results
    assert [text for text in warned["warnings"] if "# rows: in order" in text]
    assert stated["warnings"] == []
    after, again = (each["cross_validated_after"]["position_rms_m"] for each in (warned, stated))
    assert again == pytest.approx(after, rel=1e-9)
