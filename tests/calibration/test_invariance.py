"""The result depends on neither order nor units nor names: the same to 1e-9 m and 1e-9 rad."""

import csv
import re

import numpy as np
import pytest
from sessions import Simulation
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.calibration import calibrate
from dhcal_pin.calibration.evaluation import compute_errors
from dhcal_pin.estimation import select_parameters
from dhcal_pin.io import measurement_text, read_measurements
from dhcal_pin.measurements import KINDS, Noise, Pose
from dhcal_pin.robot import Chain, parse_urdf

FACTORS = {"m": ("mm", 1e3), "rad": ("deg", 180 / np.pi)}
FRAME = se3.exp6(np.array([3.0, -1, 0.5, 0.4, 1, -2]))
# Distances between points alone have no configurations.
NAMES = [name for name in KINDS if name != "point_distance"]
MOVABLE = ["pose", "position", "targets"]
# Kinds that determine the measured point in the measuring frame. Wide priors hold what the others leave open.
LOCATED = [*MOVABLE, "axes", "camera"]


def permuted_rows(header, rows, rng):
    # The second row is of another target than the first one.
    order = [1, *rng.permutation(np.delete(np.arange(len(rows)), 1))]
    return header, [rows[i] for i in order]


def permuted_columns(header, rows, rng):
    order = rng.permutation(len(header))
    return [header[i] for i in order], [[row[i] for i in order] for row in rows]


def other_units(header, rows, rng):
    """Write millimetres and degrees in place of metres and radians."""
    factors = np.ones(len(header))
    header = list(header)
    for i, name in enumerate(header):
        if (match := re.search(r"\[(m|rad)\]$", name)) is not None:
            unit, factors[i] = FACTORS[match[1]]
            header[i] = name.replace(match[0], f"[{unit}]")
    return header, [
        [repr(float(float(c) * f)) if f != 1 else c for c, f in zip(row, factors, strict=True)]
        for row in rows
    ]


def other_frame(header, rows, rng):
    """Measure in another frame."""
    rows = [list(row) for row in rows]
    x, angle = header.index("x[m]"), header.index("rx[rad]") if "rx[rad]" in header else None
    for row in rows:
        row[x : x + 3] = map(repr, (FRAME[:3, :3] @ np.array(row[x : x + 3], float) + FRAME[:3, 3]).tolist())
        if angle is not None:
            turned = FRAME[:3, :3] @ se3.exp3(np.array(row[angle : angle + 3], float))
            row[angle : angle + 3] = map(repr, se3.log3(turned).tolist())
    return header, rows


def renamed(chain):
    """Return the robot with other names of its joints, in another alphabetical order."""
    text = chain.urdf.data.decode()
    for i, name in enumerate(chain.joint_names):
        text = text.replace(f'"{name}"', f'"axis {9 - i}"')
    other = Chain.from_urdf(parse_urdf(text.encode(), "other.urdf"), chain.tip)
    return other.with_base_and_tool(chain.base, chain.tool)


def stated_errors(result):
    """Return the RMS errors of fitted samples, of left-out ones and of left-out regions, and the shares."""
    left_out = result.generalization.cross_validated, result.generalization.region_holdout
    judged = [*result.comparisons, *filter(None, left_out)]
    shares = [result.generalization.covered_share, result.generalization.reached_share]
    return [*([group.rms for group in each.after.groups.values()] for each in judged), shares]


# Contacts without a length leave directions open, whose prior widths are iterated until they change by less
# than 1 %.
WIDE_PRIORS = [(kind, permuted_rows) for kind in ("point", "plane")]
# Camera: pixels, of a millimetre each.
TOLERANCES = {
    **{("camera", change): 1e-6 for change in (permuted_rows, permuted_columns, other_units, None)},
    **dict.fromkeys(WIDE_PRIORS, 1e-6),
}
CASES = [
    *((kind, change) for kind in NAMES for change in (permuted_rows, permuted_columns, other_units, None)),
    *((kind, other_frame) for kind in MOVABLE),
]
FAST = [i for i, (kind, _) in enumerate(CASES) if kind == "position"]


@pytest.mark.parametrize(("kind", "change"), some_slow(CASES, FAST))
def test_the_robot_is_the_same(kind, change, sim_6dof, tmp_path):
    """Written in another way, measurements of all kinds give the same robot and the same accuracy."""
    rng = np.random.default_rng(list(KINDS).index(kind))
    errors = select_parameters(sim_6dof, "dh")
    std = np.array([1e-3 if p.unit == "m" else 3e-3 for p in errors.parameters])
    truth = errors.at(std * rng.standard_normal(len(std)))
    q = rng.uniform(-2.5, 2.5, (50, 6))
    data = KINDS[kind].simulate(truth, q, Noise(1e-4, 1e-4), rng)
    path, other_path = tmp_path / "data.csv", tmp_path / "other.csv"
    path.write_text(measurement_text(data, sim_6dof, []))
    header, *rows = csv.reader(path.read_text().splitlines())
    other = sim_6dof
    if change is None:
        other = renamed(sim_6dof)
        for old, new in zip(sim_6dof.joint_names, other.joint_names, strict=True):
            header = [re.sub(rf"^(to:)?{old}\b", rf"\g<1>{new}", name) for name in header]
    else:
        header, rows = change(header, rows, rng)
    with other_path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    chains, files = (sim_6dof, other), (path, other_path)
    read = [read_measurements(each, arm, rig=data.rig) for arm, each in zip(chains, files, strict=True)]
    parameters = None if data.rig else "dh,base,tool"
    first, second = (
        calibrate(arm, item, parameters, extend="none", session="unordered")
        for arm, item in zip(chains, read, strict=True)
    )
    assert first.verdict.status == second.verdict.status
    rtol = 1e-3 if (kind, change) in WIDE_PRIORS else 1e-8
    for one, two in zip(*map(stated_errors, (first, second)), strict=True):
        np.testing.assert_allclose(one, two, rtol=rtol, atol=0)
    q = rng.uniform(-2.5, 2.5, (20, 6))
    moved = FRAME if change is other_frame else np.eye(4)
    np.testing.assert_allclose(
        second.chain.poses(q)[:, :3, 3],
        (moved @ first.chain.poses(q))[:, :3, 3],
        rtol=0,
        atol=1e-9 if kind in LOCATED else 1e-5,
    )
    errors = [
        compute_errors(result.chain, [item], result.instruments)[0]
        for result, item in zip((first, second), read, strict=True)
    ]
    for name, values in errors[0].items():
        norms = [np.sort(np.linalg.norm(each, axis=1)) for each in (values, errors[1][name])]
        np.testing.assert_allclose(*norms, rtol=0, atol=TOLERANCES.get((kind, change), 1e-9))


@pytest.mark.parametrize(("arm", "count"), some_slow([("ur10", 150), ("panda", 400)], [0]))
def test_more_samples_than_the_start_needs_may_have_any_order(arm, count):
    """The start takes 100 of the samples: errors before and standard deviations depend on it."""
    sim = Simulation(arm, count, 5)
    data = sim.measure(Pose)
    permuted = data.take(np.random.default_rng(1).permutation(count))
    first, second = (
        calibrate(sim.chain, item, "minimal,base,tool", session="unordered") for item in (data, permuted)
    )
    np.testing.assert_allclose(second.std, first.std, rtol=1e-6)
    before = [fit.comparisons[0].before["position_max_m"] for fit in (first, second)]
    assert before[0] == pytest.approx(before[1], rel=1e-7)
