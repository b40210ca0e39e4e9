"""A mistake that begins or ends within a file is stated for its lines only, with a remedy for these."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from robots import robot_file
from sessions import ARMS as ARMS_OF_SESSIONS
from sessions import Changes, Simulation, write_csv
from slow_cases import some_slow

from dhcal_pin import Result, calibrate, split
from dhcal_pin.cli.main import main
from dhcal_pin.measurements import Measurement, Position
from dhcal_pin.plausibility import diagnose_mixups, mend_lines

ARMS = ["ur10", "panda", "xarm7", "ur5"]
COUNT = 100
# Mistakes: the change that undoes each, with names of the joints by number, and what it makes of the samples.
MISTAKES = {
    "lengths:m-not-mm": lambda q, p: (q, 1e-3 * p),
    "lengths:in-not-mm": lambda q, p: (q, p / 25.4),
    "sign:{2}": lambda q, p: (q * np.where(np.arange(q.shape[1]) == 2, -1, 1), p),
    "swap:{1}:{2}": lambda q, p: (q[:, [0, 2, 1, *range(3, q.shape[1])]], p),
}
CASES = [(arm, key, seed) for seed in range(5) for arm in ARMS for key in MISTAKES]
FAST = [0, 6, 11]


def at_places(places: Sequence[slice | np.ndarray]) -> list[Any]:
    """Return all cases at all places, which are slow, and fast ones at one place each."""
    fast = [(*CASES[i], [place]) for i, place in zip(FAST, places[-3:], strict=True)]
    return some_slow([*fast, *((*case, places) for case in CASES)], range(3))


def spoiled(
    sim: Simulation, data: Measurement, key: str, inside: slice | np.ndarray
) -> tuple[str, Measurement]:
    """Return the change that undoes a mistake, and samples with this mistake in some rows."""
    q, positions = data.q.copy(), data.positions().copy()
    q[inside], positions[inside] = MISTAKES[key](q[inside], positions[inside])
    return key.format(*sim.chain.joint_names), Position(q, positions).replace(source="m.csv")


def remedies(fit: Result) -> list[tuple[str, tuple[int, int]]]:
    """Return the changes of lines of m.csv that the verdict names."""
    found = re.findall(r"--mend (\S+)@m\.csv:(\d+)-(\d+)", " ".join(fit.verdict.reasons))
    return [(key, (int(first), int(last))) for key, first, last in found]


def calibrate_parts(sim: Simulation, data: Measurement) -> Result:
    """Calibrate with a part of the samples held out."""
    fitted, holdout = split(data, 0.3, 0)
    return calibrate(sim.chain, fitted, holdout=holdout)


@pytest.mark.parametrize(("arm", "key", "seed"), some_slow(CASES, FAST[::2]))
def test_a_mistake_in_most_rows_is_stated_for_their_lines(arm, key, seed):
    sim = Simulation(arm, COUNT, seed)
    name, wrong = spoiled(sim, sim.measure(), key, slice(30, None))
    fit = calibrate_parts(sim, wrong)
    assert fit.verdict.status == "refused"
    reason = fit.verdict.reasons[0]
    assert reason.startswith("In lines 31 to 100 of m.csv, ")
    assert (name, (31, 100)) in remedies(fit)
    # The advice, each of several.
    for change, lines in remedies(fit):
        (mended,) = mend_lines(sim.chain, [wrong], change, lines)
        again = calibrate_parts(sim, mended)
        assert again.verdict.status == "ok"
        assert sim.true_error(again.chain) < 2e-4


@pytest.mark.parametrize(
    ("arm", "key", "seed", "places"),
    at_places([slice(50, None), slice(0, 50), slice(20, 70), np.arange(COUNT) % 2 == 0]),
)
def test_no_change_of_a_whole_file_is_advised_if_a_part_is_right(arm, key, seed, places):
    sim = Simulation(arm, COUNT, seed)
    for inside in places:
        _, wrong = spoiled(sim, sim.measure(), key, inside)
        text = " ".join(calibrate_parts(sim, wrong).verdict.reasons)
        rows = np.arange(1, COUNT + 1)[inside]
        allowed = f"@m.csv:{rows[0]}-{rows[-1]}" if isinstance(inside, slice) else None
        for mend in re.findall(r"--mend (\S+)", text):
            assert allowed is not None, text
            assert mend.rstrip(".").endswith(allowed), text


def test_the_command_names_lines_and_mends_them(tmp_path, capsys):
    sim = Simulation("ur10", COUNT, 1)
    name, wrong = spoiled(sim, sim.measure(), "sign:{2}", slice(50, None))
    path = tmp_path / "m.csv"
    write_csv(path, sim, wrong)
    robot, tip = ARMS_OF_SESSIONS["ur10"]
    command = ["calibrate", str(robot_file(robot)), str(path), "--tip", tip, "--holdout", "0.3"]
    command += ["-o", str(tmp_path / "out.urdf")]
    # The header is line 1.
    mend = f"{name}@{path}:52-101"
    main(command)
    out = "".join("".join(capsys.readouterr()).split())
    assert "".join(f"In lines 52 to 101 of {path}, the sign of joint".split()) in out
    assert f"--mend{mend}." in out
    assert main([*command, "--mend", mend]) == 0
    assert "verdict: ok" in "".join(capsys.readouterr())
    for target, text in (
        (f"{path}:200-300", "no samples in lines 200 to 300"),
        ("x.csv:1-9", "unknown file"),
    ):
        assert main([*command, "--mend", f"{name}@{target}"]) != 0
        assert text in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("arm", "key", "seed", "places"), at_places([slice(55, None), slice(0, 40), slice(30, 70)])
)
def test_a_mistake_in_some_rows_is_found_by_the_fit_of_the_others(arm, key, seed, places):
    sim = Simulation(arm, COUNT, seed)
    for inside in places:
        name, wrong = spoiled(sim, sim.measure(), key, inside)
        first, last, _ = inside.indices(COUNT)
        fit = calibrate_parts(sim, wrong)
        assert fit.verdict.status == "caution"
        reason, text = fit.verdict.reasons[0], " ".join(fit.verdict.reasons)
        assert reason.startswith(f"In lines {first + 1} to {last} of m.csv, ")
        assert (name, (first + 1, last)) in remedies(fit)
        assert not re.search("Measure more|measure more|all regions", text)
        # No figure contains these lines, and the reason says so.
        rows = np.arange(first + 1, last + 1)
        counts = re.findall(r"leave out (\d+) of 70 fitted and (\d+) of 30 hold-out samples of", reason)[0]
        for item, count in zip((*fit.data, *fit.holdout), counts, strict=True):
            # A sign has no effect at zero.
            assert 0 <= np.isin(item.rows, rows).sum() - int(count) <= 2
        for comparison in (fit.comparisons[0], fit.generalization.cross_validated):
            assert comparison is not None
            assert comparison.after["position_rms_m"] < 2e-4
        assert sim.true_error(fit.chain) < 5e-4
        # The advice, each of several.
        for change, lines in remedies(fit):
            (mended,) = mend_lines(sim.chain, [wrong], change, lines)
            assert calibrate_parts(sim, mended).verdict.status == "ok"


@pytest.mark.parametrize("step", [1, -1])
@pytest.mark.parametrize("inside", some_slow([slice(60, None), slice(0, 40), slice(30, 70)], {0, 2}))
@pytest.mark.parametrize("seed", some_slow(range(5), [0]))
def test_a_shift_of_some_rows_is_named_for_their_lines(step, inside, seed):
    sim = Simulation(ARMS[seed % 4], COUNT, seed)
    data, key = sim.measure(), {1: "rows:above", -1: "rows:below"}[step]
    q = data.q.copy()
    q[inside] = np.roll(q[inside], step, 0)
    wrong = Position(q, data.positions()).replace(source="m.csv")
    fit = calibrate_parts(sim, wrong)
    assert fit.verdict.status == "caution"
    first, last, _ = inside.indices(COUNT)
    ((found, lines),) = remedies(fit)
    assert (found, lines) == (key, (first + 1, last))
    # The sample without joint values is left out.
    (mended,) = mend_lines(sim.chain, [wrong], found, lines)
    kept = np.delete(np.arange(COUNT), last - 1 if step > 0 else first)
    np.testing.assert_array_equal(mended.rows, kept + 1)
    np.testing.assert_array_equal(mended.q, data.q[kept])
    assert calibrate_parts(sim, mended).verdict.status == "ok"


UNKNOWN = {
    "random signs": lambda rng, q, p: (q * rng.choice([-1, 1], q.shape), p),
    "joint values of other rows": lambda rng, q, p: (np.roll(q, 7, 0), p),
    "5 mm": lambda rng, q, p: (q, p + 5e-3 * rng.normal(size=p.shape)),
}


@pytest.mark.parametrize("what", UNKNOWN)
@pytest.mark.parametrize("seed", some_slow(range(10), [0]))
def test_lines_with_an_unknown_mistake_are_named_without_a_cause(what, seed):
    sim = Simulation(ARMS[seed % 4], COUNT, seed)
    data = sim.measure()
    q, positions = data.q.copy(), data.positions().copy()
    q[60:], positions[60:] = UNKNOWN[what](sim.rng, q[60:], positions[60:])
    fit = calibrate_parts(sim, Position(q, positions).replace(source="m.csv"))
    reason, text = fit.verdict.reasons[0], " ".join(fit.verdict.reasons)
    assert fit.verdict.status == "caution"
    assert "these lines do not agree with the others" in reason
    first, last = map(int, re.findall(r"lines (\d+) to (\d+) of m.csv", reason)[0])
    assert 61 <= first <= 65
    assert 96 <= last <= 100
    assert "--mend" not in text
    assert not re.search("Measure more|measure more|all regions", text)
    assert fit.comparisons[0].after["position_rms_m"] < 1e-3


@pytest.mark.parametrize("seed", some_slow(range(20), [0, 1]))
def test_random_outliers_and_clean_samples_are_no_deviating_lines(seed):
    sim = Simulation(ARMS[seed % 4], COUNT, seed)
    data = sim.measure()
    for share, size in ((0.0, 0.0), (0.01, 0.02), (0.05, 5e-3), (0.2, 0.01), (0.2, 0.5)):
        positions = data.positions().copy()
        rows = sim.rng.permutation(COUNT)[: round(share * COUNT)]
        positions[rows] += size * sim.rng.normal(size=(len(rows), 3))
        fit = calibrate_parts(sim, Position(data.q, positions).replace(source="m.csv"))
        assert fit.deviating_lines is None
        assert all(mask.all() for mask in fit.is_holdout_judged)
        assert "--mend" not in " ".join(fit.verdict.reasons)


@pytest.mark.parametrize("seed", some_slow(range(10), [0]))
def test_a_moved_base_is_no_mistake_in_lines(seed):
    sim = Simulation(ARMS[seed % 4], COUNT, seed)
    for size in (5e-4, 5e-3):
        data = sim.measure(Position, Changes("base", size)).replace(source="m.csv")
        fit = calibrate_parts(sim, data)
        text = " ".join(fit.verdict.reasons)
        assert "The base" in text
        assert fit.deviating_lines is None
        assert "--mend" not in text


@pytest.mark.parametrize("seed", some_slow(range(10), [0]))
def test_joint_errors_are_no_deviating_lines(seed):
    sim = Simulation(ARMS[seed % 4], COUNT, seed, is_path=bool(seed % 2))
    sim.add_eccentricities(5e-4)
    fit = calibrate_parts(sim, sim.measure().replace(source="m.csv"))
    assert fit.deviating_lines is None


@pytest.mark.parametrize("seed", some_slow(range(10), [0]))
def test_right_samples_far_from_wrong_ones_are_counted(seed):
    """Positions in mm beside those in m are far away, and are not drawn for the evidence."""
    sim = Simulation("ur10", COUNT, seed)
    _, wrong = spoiled(sim, sim.measure(), "lengths:m-not-mm", slice(40, None))
    found = diagnose_mixups(sim.chain, [wrong])
    assert [each.key for each in found.hypotheses] == ["lengths:m-not-mm"]
    assert found.lines == (41, 100)
    # Every other row is right: no range of lines has the mistake.
    _, wrong = spoiled(sim, sim.measure(), "lengths:m-not-mm", np.arange(COUNT) % 3 > 0)
    assert not diagnose_mixups(sim.chain, [wrong]).hypotheses


@pytest.mark.parametrize("seed", some_slow(range(10), [0]))
def test_outliers_do_not_restrict_a_mistake(seed):
    sim = Simulation("panda", COUNT, seed)
    data = sim.measure()
    positions = data.positions().copy()
    positions[sim.rng.permutation(COUNT)[:20]] += 0.3 * sim.rng.normal(size=(20, 3))
    _, wrong = spoiled(sim, Position(data.q, positions), "sign:{2}", slice(None))
    found = diagnose_mixups(sim.chain, [wrong])
    assert found.lines is None
    assert found.hypotheses[0].key == f"sign:{sim.chain.joint_names[2]}"
