"""A scale of the instrument that differs between two files, with positions of `robots` and another base."""

import re
from dataclasses import replace

import numpy as np
import pytest
from robots import nominal_arm, with_small_errors
from slow_cases import some_slow

from dhcal_pin import calibrate, se3
from dhcal_pin.measurements import Noise, Pose, Position
from dhcal_pin.plausibility import mend
from dhcal_pin.robot.conditions import Conditions

NOISE = Noise(5e-5, 1e-4)
# Place of the robot in the frame of the tracker, and a second one, as twists.
BASE, MOVED = np.array([2.0, 1.0, -0.4, 0.1, -0.2, 0.9]), np.array([1.0, 2.0, -0.3, 0.0, 0.1, 2.0])


class Robot:
    """UR10 with errors, measured in files of their own scale."""

    def __init__(self, seed, arm="ur10"):
        self.rng = np.random.default_rng(seed)
        self.nominal = nominal_arm(arm)
        self.true = with_small_errors(self.nominal, self.rng)

    def measure(self, scales, bases=(BASE,), count=50, kind=Position):
        """Return a file for each scale, at a base each or at the same."""
        files = []
        for i, scale in enumerate(scales):
            true = self.true.with_base_and_tool(se3.exp6(bases[i % len(bases)]), self.true.tool)
            q = self.rng.uniform(-2, 2, (count, self.nominal.n_joints))
            item = kind.simulate(true, q, NOISE, self.rng)
            if kind is Pose:
                poses = item.poses.copy()
                poses[:, :3, 3] *= scale
                item = item.replace(poses=poses)
            else:
                item = item.replace(values=item.values * scale)
            files.append(item.replace(source=f"{i}.csv"))
        return files

    def error(self, fit):
        """Return the RMS position error at new configurations with the base that fits them best [m]."""
        q = self.rng.uniform(-2, 2, (300, self.nominal.n_joints))
        a, b = (chain.poses(q)[:, :3, 3] for chain in (self.true, fit.chain))
        a, b = a - a.mean(0), b - b.mean(0)
        u, _, vt = np.linalg.svd(a.T @ b)
        turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        return float(np.sqrt(np.mean(np.sum((a - b @ turn.T) ** 2, 1))))


def mends(sentence):
    """Return the mends that a sentence names, a pair of key and file each."""
    return re.findall(r"--mend (scale:[\d.e-]+\d)@([\w.]+\w)", sentence)


@pytest.mark.parametrize(
    ("factor", "kind", "seed"),
    some_slow(
        [(f, k, s) for f in (1.0008, 0.9995, 1.003) for k in (Position, Pose) for s in range(6)], {0, 9}
    ),
)
def test_either_scale_is_a_mend_after_which_nothing_is_found(factor, kind, seed):
    robot = Robot(seed)
    data = robot.measure((1.0, factor), kind=kind)
    fit = calibrate(robot.nominal, data)
    assert fit.session
    (scale,) = fit.session.found
    assert 1 / scale.factor == pytest.approx(factor, abs=4 * scale.std)
    assert (scale.files, scale.others) == (("0.csv",), ("1.csv",))
    assert fit.verdict.status == "caution"
    before = robot.error(fit)
    named = mends(scale.consequence)
    assert [file for _, file in named] == ["0.csv", "1.csv"]
    for key, file in named:
        mended = [mend(robot.nominal, item, key) if item.source == file else item for item in data]
        again = calibrate(robot.nominal, mended)
        assert again.session
        assert [each for each in again.session.found if getattr(each, "others", ())] == []
        assert (again.session.events, again.session.drifts) == ((), ())
        assert again.validate(mended)["position_rms_m"] < fit.validate(data)["position_rms_m"] / 1.5
        if file == "1.csv":
            assert again.verdict.status == "ok"
            assert robot.error(again) < before / 2


@pytest.mark.parametrize("seed", some_slow(range(12), {0}))
def test_files_of_one_scale_show_none(seed):
    robot = Robot(seed)
    fit = calibrate(robot.nominal, robot.measure((1.0, 1.0)))
    assert fit.session
    assert fit.session.found == ()
    assert fit.verdict.status == "ok"


@pytest.mark.parametrize("seed", some_slow(range(12), {0}))
def test_a_base_that_moved_between_files_is_no_scale(seed):
    robot = Robot(seed)
    fit = calibrate(robot.nominal, robot.measure((1.0, 1.0), (BASE, MOVED)))
    assert fit.session
    (event,) = fit.session.found
    assert event.kind == "base"


@pytest.mark.parametrize("seed", some_slow(range(6), {0}))
def test_a_scale_is_found_beside_a_base_that_moved(seed):
    robot = Robot(seed)
    fit = calibrate(robot.nominal, robot.measure((1.0, 1.001), (BASE, MOVED)))
    assert fit.session
    event, scale = fit.session.found
    assert event.kind == "base"
    assert 1 / scale.factor == pytest.approx(1.001, abs=4 * scale.std)


@pytest.mark.parametrize("seed", some_slow(range(4), {0}))
def test_each_of_three_files_is_compared_with_the_last_one(seed):
    robot = Robot(seed)
    data = robot.measure((1.0, 1.001, 1.002), count=40)
    fit = calibrate(robot.nominal, data)
    assert fit.session
    first, second = fit.session.found
    assert [each.files for each in (first, second)] == [("0.csv",), ("1.csv",)]
    assert {first.others, second.others} == {("2.csv",)}
    for scale, factor in ((first, 1 / 1.002), (second, 1.001 / 1.002)):
        assert scale.factor == pytest.approx(factor, abs=4 * scale.std)


@pytest.mark.parametrize(
    ("distance", "seed"), some_slow([(d, s) for d in (0.0, 2.0) for s in range(6)], {0, 6})
)
def test_a_robot_that_grew_looks_like_a_scale_only_where_its_base_is_the_origin(distance, seed):
    """A scale is one about the origin of the measuring frame, and the sentence names the temperature, too."""
    robot = Robot(seed)
    base = np.array([distance, 0.0, 0.0, 0.1, -0.2, 0.9])
    cold = robot.measure((1.0,), (base,))
    origins = robot.true.origins.copy()
    origins[:, :3, 3] *= 1.0006
    robot.true = replace(robot.true, origins=origins)
    warm = robot.measure((1.0,), (base,))[0].replace(source="1.csv")
    fit = calibrate(robot.nominal, [*cold, warm])
    assert fit.session
    (found,) = fit.session.found
    if distance:
        assert (found.kind, found.of) == ("links", "links")
    else:
        assert 1 / found.factor == pytest.approx(1.0006, abs=1e-4)
        assert "or the temperature of the robot" in found.consequence


def test_files_that_were_measured_in_turns_have_one_scale():
    """Their samples are not before and after a step."""
    robot = Robot(0)
    data = [
        item.replace(recorded=Conditions(item.q, time=2.0 * np.arange(50) + i))
        for i, item in enumerate(robot.measure((1.0, 1.001)))
    ]
    fit = calibrate(robot.nominal, data)
    assert fit.session
    assert fit.session.scales == ()


def test_files_without_an_order_show_it_as_well():
    robot = Robot(1)
    fit = calibrate(robot.nominal, robot.measure((1.0, 1.0008)), session="unordered")
    assert fit.session
    (scale,) = fit.session.found
    assert 1 / scale.factor == pytest.approx(1.0008, abs=4 * scale.std)
