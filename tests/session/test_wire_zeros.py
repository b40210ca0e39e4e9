"""A jump of the zero of one wire of a three-wire device, measured at an arm of `robots`."""

import re
from typing import Any

import numpy as np
import pytest
from robots import nominal_arm, with_small_errors
from slow_cases import some_slow

from dhcal_pin import calibrate, se3
from dhcal_pin.exceptions import InvalidArgumentError, UnknownNameError
from dhcal_pin.measurements import Position, Wires
from dhcal_pin.plausibility import mend
from dhcal_pin.plausibility.hypotheses import mend_lines
from dhcal_pin.robot.conditions import Conditions

ANCHORS = np.array([[-1.2, 0.6, 0.2], [-1.2, -0.6, 0.2], [-0.9, 0.0, 1.4]])
NOISE, COUNT, FIRST_LINE = 5e-5, 80, 2


class Device:
    """UR10 with errors, and lengths of three wires to its tool."""

    def __init__(self, seed, count=COUNT):
        self.rng = np.random.default_rng(seed)
        self.nominal = nominal_arm("ur10")
        self.true = with_small_errors(self.nominal, self.rng)
        self.q = self.rng.uniform(-1.5, 1.5, (count, 6))
        self.lengths = self.measured(self.true)

    def measured(self, chain):
        """Return the lengths that the device shows at an arm [m]."""
        points = chain.poses(self.q)[:, :3, 3]
        noise = NOISE * self.rng.standard_normal((len(self.q), len(ANCHORS)))
        return np.linalg.norm(points[:, None] - ANCHORS, axis=2) + noise

    def jump(self, wire, size, rows: Any = np.s_[COUNT // 2 :]):
        """Add an error to the lengths of one wire in some rows [m]."""
        self.lengths[rows, wire] += size

    def data(self, zeros: float | None = 0.0):
        """Return the measurements, with zeros that are stated or estimated."""
        item = Wires(self.q, self.lengths, anchors=ANCHORS, offsets=zeros)
        return item.replace(source="wires.csv", rows=np.arange(len(self.q)) + FIRST_LINE)

    def error(self, fit):
        """Return the RMS position error at new configurations [m]."""
        q = self.rng.uniform(-1.5, 1.5, (300, 6))
        difference = self.true.poses(q)[:, :3, 3] - fit.chain.poses(q)[:, :3, 3]
        return float(np.sqrt(np.mean(np.sum(difference**2, 1))))


def mends(event):
    """Return the key and the lines of each option that a sentence names."""
    found = re.findall(r"--mend (wire:\d:-?[\d.]+)@wires.csv:(\d+)-(\d+)", event.consequence)
    return [(key, (int(first), int(last))) for key, first, last in found]


def found_event(fit):
    assert fit.session
    (event,) = fit.session.found
    assert (event.kind, fit.verdict.status) == ("wire", "caution")
    return event


CASES = [(w, size, s) for w in range(3) for size in (5e-4, -5e-4, 2e-3) for s in range(4)]


@pytest.mark.parametrize(("wire", "size", "seed"), some_slow(CASES, {1, 16}))
@pytest.mark.parametrize("right", ["earlier", "later"])
def test_the_zero_that_the_robot_fits_is_named_and_the_other_one_undone(wire, size, seed, right):
    device = Device(seed)
    rows = np.s_[COUNT // 2 :] if right == "earlier" else np.s_[: COUNT // 2]
    device.jump(wire, size, rows)
    fit = calibrate(device.nominal, device.data())
    event = found_event(fit)
    assert event.of == str(wire + 1)
    assert event.place == "between lines 41 and 42 of wires.csv"
    assert event.size == pytest.approx(abs(size), abs=4 * event.std)
    assert f"The robot fits the {right} zero." in event.consequence
    ((key, lines),) = mends(event)
    assert lines == ((42, 81) if right == "earlier" else (2, 41))
    (mended,) = mend_lines(device.nominal, [device.data()], key, lines)
    again = calibrate(device.nominal, mended)
    assert again.session
    assert again.session.found == ()
    assert again.verdict.status == "ok"
    # The samples before or after a large jump are outliers, so that the others alone were fitted.
    assert device.error(again) < min(1e-4, device.error(fit) / (4 if abs(size) < 1e-3 else 1))


@pytest.mark.parametrize("seed", some_slow(range(12), {0}))
def test_either_option_undoes_the_change_of_a_zero_that_is_estimated(seed):
    device = Device(seed)
    device.jump(1, 5e-4)
    fit = calibrate(device.nominal, device.data(None))
    event = found_event(fit)
    assert "if the earlier zero is right, or add" in event.consequence
    results = [
        calibrate(device.nominal, mend_lines(device.nominal, [device.data(None)], key, lines)[0])
        for key, lines in mends(event)
    ]
    assert [each.verdict.status for each in results] == ["ok", "ok"]
    one, other = (device.error(each) for each in results)
    assert one == pytest.approx(other, rel=0.1)


@pytest.mark.parametrize("seed", some_slow(range(24), {0, 1}))
def test_right_zeros_are_not_named(seed):
    device = Device(seed)
    fit = calibrate(device.nominal, device.data())
    assert fit.session
    assert fit.session.found == ()
    assert fit.verdict.status == "ok"


@pytest.mark.parametrize("seed", some_slow(range(12), {0}))
def test_a_base_that_moved_is_not_taken_for_a_wire(seed):
    device = Device(seed)
    moved = se3.exp6(np.array([5e-4, -3e-4, 6e-4, 0.0, 0.0, 0.0])) @ device.true.base
    later = device.measured(device.true.with_base_and_tool(moved, device.true.tool))
    device.lengths[COUNT // 2 :] = later[COUNT // 2 :]
    fit = calibrate(device.nominal, device.data())
    assert fit.session
    assert [each.kind for each in fit.session.events] == ["base"]


def test_a_zero_that_changed_between_files_is_undone_in_whole_files():
    device = Device(0)
    device.jump(2, 5e-4)
    data = device.data()
    files = [
        data.take(part).replace(source=name)
        for name, part in (("a.csv", np.s_[: COUNT // 2]), ("b.csv", np.s_[COUNT // 2 :]))
    ]
    event = found_event(calibrate(device.nominal, files))
    assert event.place == "between a.csv and b.csv"
    assert event.consequence.endswith(f"or add --mend wire:3:{event.size:.6f}@b.csv.")


def test_no_option_is_named_for_samples_without_lines_of_their_own():
    """The lines of a file that was recorded in another order do not follow each other in time."""
    device = Device(0)
    times = device.rng.permutation(COUNT).astype(float)
    device.jump(0, 5e-4, times >= COUNT // 2)
    data = device.data()
    timed = data.replace(recorded=Conditions(data.q, time=times))
    for item in (timed, device.data().replace(source="")):
        event = found_event(calibrate(device.nominal, item.replace(recorded=timed.recorded)))
        assert event.consequence == "It is not corrected. Check the sensor."


def test_a_change_of_one_wire_alone_is_undone():
    device = Device(0)
    data = device.data()
    mended = mend(device.nominal, data, "wire:2:0.001")
    assert isinstance(mended, Wires)
    np.testing.assert_allclose(data.values - mended.values, np.tile([0, 1e-3, 0], (COUNT, 1)), atol=1e-15)
    with pytest.raises(InvalidArgumentError, match=r"expected a length in m from -0.1 to 0.1"):
        mend(device.nominal, data, "wire:2:0.2")
    with pytest.raises(UnknownNameError, match="does not apply to measurements of kind wires"):
        mend(device.nominal, data, "wire:4:0.001")
    with pytest.raises(UnknownNameError, match="unknown change"):
        mend(device.nominal, data, "wire:0.001")
    positions = Position(data.q, device.true.poses(data.q)[:, :3, 3])
    with pytest.raises(UnknownNameError, match="does not apply to measurements of kind position"):
        mend(device.nominal, positions, "wire:1:0.001")


def test_the_json_document_states_the_event():
    device = Device(3)
    device.jump(1, -8e-4)
    fit = calibrate(device.nominal, device.data())
    assert fit.session
    (event,) = fit.session.to_dict()["events"]
    assert {key: event[key] for key in ("kind", "of", "line", "unit")} == {
        "kind": "wire",
        "of": "2",
        "line": 42,
        "unit": "m",
    }
