"""Mistakes in a whole file, with and without an event of the session."""

from itertools import product

import numpy as np
import pytest
from sessions import Changes, Simulation, session_of
from slow_cases import some_slow

from dhcal_pin.calibration import Result, calibrate
from dhcal_pin.measurements import Measurement, Pose, Position
from dhcal_pin.plausibility.hypotheses import mend
from dhcal_pin.plausibility.mixups import diagnose_mixups

DEGREE = np.deg2rad(1.0)
NOTHING = Changes()
EVENTS = {
    "base": Changes("base", 20e-3, 0.1 * DEGREE, at=0.4),
    "tool": Changes("tool", 10e-3, 0.2 * DEGREE, at=0.6),
    "joint": Changes(joint=(2, 3 * DEGREE), at=0.5),
}


def with_mistake(data: Measurement, name: str, joint: int) -> tuple[Measurement, str]:
    """Return measurements with a wrong sign or zero of a joint, and the change that undoes it."""
    q = data.configurations().copy()
    if name == "sign":
        q[:, joint] *= -1
    else:
        q[:, joint] += 90 * DEGREE
    return data.resample(q), f"{name}:{{}}" + ":-90deg" * (name == "zero")


def judge(arm: str, seed: int, kind: type[Measurement], name: str, joint: int, event: str) -> Result:
    """Calibrate with a mistake; return the result if the mistake is named and no event is."""
    simulation = Simulation(arm, 80, seed)
    wrong, key = with_mistake(simulation.measure(kind, EVENTS.get(event, NOTHING)), name, joint)
    fit = calibrate(simulation.chain, wrong, extend="none")
    assert key.format(simulation.chain.joint_names[joint]) in [h.key for h in fit.diagnosis.hypotheses]
    assert fit.verdict.is_refused
    assert event or not session_of(fit).found
    return fit


@pytest.mark.parametrize(
    ("arm", "kind", "name", "joint", "event"),
    some_slow(
        [
            ("ur10", Pose, "sign", 3, ""),
            ("panda", Pose, "zero", 3, ""),
            ("panda", Position, "sign", 4, "base"),
        ],
        {0, 2},
    ),
)
def test_a_mistake_is_named_in_place_of_false_events(arm, kind, name, joint, event):
    fit = judge(arm, 0, kind, name, joint, event)
    mended = mend(fit.errors.chain, fit.data[0], fit.diagnosis.hypotheses[0].key)
    session = session_of(calibrate(fit.errors.chain, mended, extend="none"))
    assert [found.kind for found in session.events] == [event] * bool(event)
    assert not session.drifts


@pytest.mark.slow
def test_mistakes_are_named_in_place_of_false_events():
    cases = list(product(("ur10", "panda", "xarm7"), (Pose, Position), ("sign", "zero"), (1, 3)))
    missed = []
    for seed, event in enumerate(("", *EVENTS)):
        for case in cases:
            try:
                judge(case[0], seed, *case[1:], event)
            except AssertionError:
                missed.append((seed, event, *case))
    assert len(missed) <= 0.05 * 4 * len(cases), missed


def test_large_events_are_found_in_a_good_file():
    """A zero that changes by 40 degrees is believed where the robot fits with it."""
    simulation = Simulation("ur10", 60, 1)
    changes = Changes(joint=(3, 40 * DEGREE))
    fit = calibrate(simulation.chain, simulation.measure(Position, changes), extend="none")
    (event,) = session_of(fit).events
    assert (event.kind, event.of) == ("joint", simulation.chain.joint_names[3])
    assert event.size == pytest.approx(40 * DEGREE, rel=1e-3)
    assert not fit.diagnosis.hypotheses


@pytest.mark.parametrize("growth", [1e-3, 30e-3])
def test_links_grow_by_what_is_possible_only(growth):
    """Thermal growth is far below 1 %."""
    simulation = Simulation("ur10", 80, 2)
    fit = calibrate(simulation.chain, simulation.measure(Position, Changes(growth=growth, at=None)))
    assert [drift.kind for drift in session_of(fit).drifts] == ["links"] * (growth < 0.01)
    assert session_of(fit).changes.is_empty == (growth > 0.01)


@pytest.mark.parametrize(("seed", "event"), some_slow(list(product(range(12), EVENTS)), {0}))
def test_an_event_is_not_taken_for_a_mistake(seed, event):
    simulation = Simulation(("ur10", "panda", "xarm7")[seed % 3], 80, seed)
    data = simulation.measure((Pose, Position)[seed % 2], EVENTS[event])
    assert not diagnose_mixups(simulation.chain, [data]).hypotheses
