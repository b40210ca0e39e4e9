"""Why hold-out samples have larger errors: a change before them, an unstated payload, a mistake in them."""

import numpy as np
import pinocchio as pin
import pytest
from sessions import Changes, Simulation
from slow_cases import some_slow

from dhcal_pin import Result, calibrate, split
from dhcal_pin.measurements import Measurement, Pose, Position
from dhcal_pin.plausibility import mend

CHANGES = {
    "The base moved": Changes("base", 5e-4),
    "The tool moved": Changes("tool", 5e-4),
    "The zero of joint elbow_joint changed": Changes(joint=(2, 5e-4)),
}
MISTAKES = {
    "sign:elbow_joint": lambda q, p: (q * [1, 1, -1, 1, 1, 1], p),
    "lengths:mm-not-m": lambda q, p: (q, 1e3 * p),
    "joints:deg-not-rad": lambda q, p: (np.rad2deg(q), p),
    "rows:above": lambda q, p: (np.roll(q, 1, 0), p),
}


def halves(data: Measurement) -> tuple[Measurement, Measurement]:
    """Return the first half of the samples and the second half, as two files."""
    first, second = (data.take(part) for part in np.array_split(np.arange(len(data.rows)), 2))
    return first.replace(source="fitted.csv"), second.replace(source="holdout.csv")


def text_of(fit: Result) -> str:
    """Return the reasons of the verdict, which is caution."""
    assert fit.verdict.status == "caution"
    return " ".join(fit.verdict.reasons)


@pytest.mark.parametrize(("what", "changes"), CHANGES.items())
@pytest.mark.parametrize("seed", some_slow(range(10), [0]))
def test_a_change_before_the_hold_out_samples_is_named(what, changes, seed):
    sim = Simulation("ur10", 160, seed)
    fitted, holdout = halves(sim.measure(Pose, changes))
    text = text_of(calibrate(sim.chain, fitted, holdout=holdout))
    # Hold-out samples may be of another set-up of the instrument.
    assert what in text.replace("The base or the instrument", "The base")
    # Nothing says whether the instrument was set up anew.
    assert (", as after a new set-up of the instrument." in text) == ("base" in what)
    assert "Measure all regions" not in text
    # The advice: both together.
    both = calibrate(sim.chain, [fitted, holdout])
    assert what in text_of(both)
    assert sim.true_error(both.chain) < 2e-4


@pytest.mark.parametrize("kind", [Pose, Position])
def test_hold_out_samples_of_another_set_up_do_not_judge_the_robot(kind):
    """They fit neither robot, so that the nominal one was kept."""
    sim = Simulation("xarm7", 90, 3)
    fitted, holdout = halves(sim.measure(kind, Changes("base", 1.0)))
    fit = calibrate(sim.chain, fitted, holdout=holdout)
    assert "The base or the instrument moved" in text_of(fit)
    assert not fit.verdict.keeps_nominal
    assert sim.true_error(fit.chain) < 2e-4


@pytest.mark.parametrize("seed", some_slow(range(10), [0]))
def test_an_unstated_payload_of_the_hold_out_samples_is_proposed(seed):
    sim = Simulation("ur10", 160, seed)
    compliance, kilograms = 2e-5, 8.0
    poses = sim.poses

    def bent(q, model=None):
        """Return the tip poses of elastic joints; the second half of the samples carries a payload."""
        assert model is not None
        loaded = model.copy()
        inertia = pin.Inertia(kilograms, np.zeros(3), np.zeros((3, 3)))
        frame = loaded.frames[loaded.getFrameId(sim.chain.tip, pin.FrameType.BODY)]
        loaded.appendBodyToJoint(frame.parentJoint, inertia, frame.placement)
        out = []
        for row in q:
            is_loaded = np.any(np.all(sim.q[80:] == row, 1))
            used = loaded if is_loaded else model
            torques = pin.computeGeneralizedGravity(
                used, used.createData(), sim.chain.loads.configurations(row[:, None])[0]
            )
            out += poses((row + compliance * torques)[None], model)
        return out

    sim.poses = bent
    fitted, holdout = halves(sim.measure(Pose))
    assert "columns payload[kg]" in text_of(calibrate(sim.chain, fitted, holdout=holdout))
    # The advice.
    stated = [
        item.with_conditions(payload=np.full(len(item.rows), value))
        for item, value in ((fitted, 0.0), (holdout, kilograms))
    ]
    assert calibrate(sim.chain, stated[0], holdout=stated[1]).verdict.status == "ok"


@pytest.mark.parametrize(("key", "spoil"), MISTAKES.items())
@pytest.mark.parametrize("seed", some_slow(range(10), [0]))
def test_a_mistake_in_the_hold_out_samples_is_named_and_the_correction_is_applied(key, spoil, seed):
    sim = Simulation("ur10", 160, seed)
    fitted, holdout = halves(sim.measure())
    q, positions = spoil(holdout.q, holdout.positions())
    wrong = Position(q, positions).replace(source="holdout.csv")
    fit = calibrate(sim.chain, fitted, holdout=wrong)
    text = text_of(fit)
    assert f"--mend {key}@holdout.csv" in text
    assert "No correction" not in text
    assert sim.true_error(fit.chain) < 2e-4
    # The advice.
    mended = mend(sim.chain, wrong, key)
    assert calibrate(sim.chain, fitted, holdout=mended).verdict.status == "ok"


def test_a_mistake_in_all_hold_out_files_is_none_of_the_robot():
    """The fitted samples show that the robot file is right."""
    sim = Simulation("ur10", 160, 0)
    fitted, holdout = halves(sim.measure())
    turned = holdout.resample(holdout.q * [1, 1, -1, 1, 1, 1])
    files = [turned.take(np.arange(i, len(turned.rows), 2)).replace(source=f"{i}.csv") for i in range(2)]
    text = text_of(calibrate(sim.chain, fitted, holdout=files, extend="none"))
    assert "Correct the measurements, or add --mend sign:elbow_joint." in text
    assert "robot file" not in text


@pytest.mark.parametrize("seed", some_slow(range(20), [0]))
def test_random_hold_out_samples_of_one_session_show_no_change(seed):
    sim = Simulation("ur10", 160, seed)
    data = sim.measure(Pose, Changes("base", 1e-3))
    (fitted,), holdout = split(data, 0.4, seed)
    fit = calibrate(sim.chain, fitted, holdout=holdout, session="off")
    assert "Something changed between" not in " ".join(fit.verdict.reasons)


@pytest.mark.parametrize("seed", some_slow(range(4), [0]))
def test_a_file_half_in_other_units_is_refused_or_named(seed):
    """The fit adapts to one half, and the errors of the other half are as large as the robot."""
    sim = Simulation("ur10", 40, seed)
    data = sim.measure(Position)
    values = data.values.copy()
    values[20:] /= 25.4
    is_held_out = np.random.default_rng(seed).permutation(40) < 12
    spoilt = data.replace(values=values)
    fitted, holdout = (spoilt.take(np.flatnonzero(mask)) for mask in (~is_held_out, is_held_out))
    verdict = calibrate(sim.chain, fitted, holdout=holdout).verdict
    is_named = "as if in had been read as mm" in verdict.reasons[0]
    assert is_named or (verdict.status == "refused" and "samples (" in verdict.reasons[0])


def test_hold_out_samples_of_something_else_are_refused():
    sim = Simulation("ur10", 60, 0)
    fitted, holdout = halves(sim.measure(Position))
    rng = np.random.default_rng(0)
    fit = calibrate(sim.chain, fitted, holdout=holdout.replace(values=rng.uniform(-1, 1, (30, 3))))
    assert fit.verdict.status == "refused"
    assert "on hold-out samples. These or the fitted ones are wrong" in fit.verdict.reasons[0]
