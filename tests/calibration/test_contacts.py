"""Contacts with sockets at known distances."""

import numpy as np
import pytest
from robots import nominal_arm
from sessions import Simulation
from slow_cases import some_slow
from touching_arms import JOINTS, NOMINAL, TouchingArm

from dhcal_pin import calibrate
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import MultiTargetPosition, Noise, PointContact, PointDistance
from dhcal_pin.plausibility import diagnose_mixups
from dhcal_pin.plausibility.evidence import HAND_BUILT, MANUFACTURED
from dhcal_pin.plausibility.hypotheses import RowShift, mend


def touched(distance_factor=1.0, zero=0.0, sigma=None):
    """Return a nominal arm, contacts of a true one with four points, and distances between them.

    The values of the second joint are larger than the true ones by `zero` [rad].
    """
    rng, nominal = np.random.default_rng(0), nominal_arm("ur10")
    errors = select_parameters(nominal, "placement,tool")
    size = np.array([1e-3 if p.unit == "rad" else 5e-4 for p in errors.parameters])
    truth = errors.at(size * rng.standard_normal(len(size)))
    contacts = PointContact.simulate(truth, rng.uniform(-2, 2, (80, 6)), Noise(1e-4), rng)
    points = [truth.poses(contacts.q[contacts.label == i])[:, :3, 3].mean(0) for i in range(4)]
    pairs = [(i, (i + 1) % 4) for i in range(4)]
    lengths = [distance_factor * np.linalg.norm(points[i] - points[j]) for i, j in pairs]
    names = contacts.names
    distances = PointDistance(6, [(names[i], names[j]) for i, j in pairs], lengths, sigma)
    return nominal, contacts.resample(contacts.q + zero * np.eye(6)[1]), distances


@pytest.fixture(scope="module")
def right():
    nominal, *data = touched()
    return calibrate(nominal, data)


def test_right_distances_are_not_refused(right):
    assert right.comparisons[-1].after.groups["position"].rms < 3e-4
    assert right.verdict.status != "refused"
    assert not (right.session and right.session.scales)


@pytest.mark.parametrize("zero", some_slow([0.0, np.deg2rad(5)], {0}))
def test_a_calibration_does_not_need_decompositions_that_converge(monkeypatch, right, zero):
    """LAPACK's divide and conquer failed for a system of 88 unknowns of a Panda that touched sockets."""
    nominal, *data = touched(zero=zero)
    expected = calibrate(nominal, data) if zero else right
    assert expected.diagnosis.is_suspicious == (zero > 0)
    decompose = np.linalg.svd
    failed = []

    def fail(a, full_matrices=True, compute_uv=True, hermitian=False):
        if compute_uv and np.ndim(a) == 2 and min(np.shape(a)) > 6:
            failed.append(np.shape(a))
            raise np.linalg.LinAlgError("SVD did not converge")
        return decompose(a, full_matrices, compute_uv, hermitian)

    monkeypatch.setattr(np.linalg, "svd", fail)
    fit = calibrate(nominal, data)
    assert failed
    assert fit.verdict == expected.verdict
    assert fit.diagnosis.is_suspicious == expected.diagnosis.is_suspicious
    np.testing.assert_allclose(fit.x, expected.x, atol=1e-7)


@pytest.mark.parametrize("factor", some_slow([1.1, 0.98], {1}))
def test_wrong_distances_between_sockets_are_named(factor):
    """The robot takes their size: with 10 % it was caution with an error of 0.3 mm stated and 30 mm true."""
    nominal, *data = touched(distance_factor=factor)
    fit = calibrate(nominal, data)
    assert fit.session is not None
    assert [scale.factor for scale in fit.session.scales] == [pytest.approx(factor, abs=5e-3)]


@pytest.mark.parametrize(("joint", "factor"), some_slow([(2, 1.1), (1, 0.95), (3, 1.05)], {0}))
def test_a_wrong_gear_ratio_among_contacts_is_named(joint, factor):
    nominal, contacts, distances = touched()
    wrong = contacts.resample(contacts.q * np.where(np.arange(6) == joint, factor, 1.0))
    (found,) = diagnose_mixups(nominal, [wrong, distances]).hypotheses
    kind, name, ratio = found.key.split(":")
    assert (kind, name) == ("ratio", nominal.joint_names[joint])
    assert float(ratio) == pytest.approx(1 / factor, rel=0.003)


@pytest.fixture(scope="module")
def with_right_names():
    nominal, *data = touched(sigma=1e-4)
    return calibrate(nominal, data)


@pytest.mark.parametrize("is_run", some_slow([False, True], {0}))
def test_outliers_that_fit_another_name_are_named(is_run, with_right_names):
    nominal, contacts, distances = touched(sigma=1e-4)
    names = np.array(contacts.text_values()["point"])
    # Every row of a run, or four rows somewhere, with exchanged names.
    changed = np.arange(60, 80) if is_run else np.array([5, 6, 40, 72])
    other = {"p1": "p2", "p2": "p1", "p3": "p4", "p4": "p3"}
    wrong = names.copy()
    wrong[changed] = [other[name] for name in names[changed]]
    fit = calibrate(nominal, [PointContact(contacts.q, wrong.tolist(), contacts.sigma), distances])
    found = {row: (each.stated, each.fitting) for each in fit.wrong_labels for row in each.rows}
    assert found == {i + 1: (wrong[i], names[i]) for i in changed}
    (reason,) = [reason for reason in fit.verdict.reasons if "Correct the names" in reason]
    assert reason.count(" state") == len(fit.wrong_labels)
    # The remedy helps.
    assert with_right_names.verdict.reasons == ()
    assert with_right_names.n_outliers == 0


def with_wrong_name(touches, row):
    """Return touches one of which has the name of another point."""
    names = list(touches.text_values()["point"])
    names[row] = "p0" if names[row] == "p1" else "p1"
    return PointContact(touches.q, names)


@pytest.mark.parametrize("seed", some_slow(range(4), {1}))
def test_one_wrong_name_among_points_touched_in_turn_is_no_mistake_in_all_rows(seed):
    """Rows that are shifted by one have other names, too, and were named."""
    touches, distances = TouchingArm.random(seed, 48, 8).data
    wrong = with_wrong_name(touches, 7 + 3 * seed)
    for sets in (HAND_BUILT, MANUFACTURED) if seed == 0 else (HAND_BUILT,):
        assert diagnose_mixups(NOMINAL, [wrong, distances], sets).hypotheses == ()
    # A shift renames all points but those of two rows.
    assert RowShift(1).apply(wrong) is None


def test_one_wrong_name_among_points_touched_in_turn_is_named():
    touches, distances = TouchingArm.random(1, 48, 8).data
    fit = calibrate(NOMINAL, [with_wrong_name(touches, 10), distances], HAND_BUILT, turned="none")
    assert fit.verdict.status == "caution"
    (found,) = fit.wrong_labels
    assert (found.fitting, found.rows) == (touches.text_values()["point"][10], (11,))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("joint", "factor", "sets"),
    [
        (1, 1.06, HAND_BUILT),
        (0, 1.06, HAND_BUILT),
        (2, 0.94, HAND_BUILT),
        (3, 1.1, HAND_BUILT),
        (3, 0.94, MANUFACTURED),
    ],
)
def test_a_wrong_gear_ratio_of_a_hand_built_arm_among_contacts_is_named(joint, factor, sets):
    """The arm touched unknown points with other lengths: "ok" with 8 mm of error."""
    arm = TouchingArm.random(3, 48, 8)
    touches, distances = arm.data
    wrong = touches.resample(touches.q * np.where(np.arange(5) == joint, factor, 1.0))
    (found,) = diagnose_mixups(NOMINAL, [wrong, distances], sets).hypotheses
    kind, name, ratio = found.key.split(":")
    assert (kind, name) == ("ratio", JOINTS[joint])
    assert float(ratio) == pytest.approx(1 / factor, rel=0.01)


@pytest.mark.parametrize("seed", some_slow([*range(6), *range(7, 10)], {0, 1}))
def test_touches_of_a_right_hand_built_arm_have_no_wrong_ratio(seed):
    found = diagnose_mixups(NOMINAL, TouchingArm.random(seed, 48, 8).data, HAND_BUILT)
    assert (found.hypotheses, found.zero) == ((), None)


@pytest.mark.parametrize(
    ("joint", "angle"), some_slow([(2, 20), (1, 8), (1, -25), (2, 40), (3, -20), (4, 12)], {0})
)
def test_a_wrong_zero_among_contacts_is_named(joint, angle):
    """An arm with other errors touched unknown points as well, and no mistake was named."""
    nominal, contacts, distances = touched()
    wrong = contacts.resample(contacts.q + np.deg2rad(angle) * np.eye(6)[joint])
    found = diagnose_mixups(nominal, [wrong, distances])
    named = found if abs(angle) > 9 else found.zero
    assert named is not None
    (hypothesis,) = named.hypotheses
    kind, name, size = hypothesis.key.split(":")
    assert (kind, name) == ("zero", nominal.joint_names[joint])
    # The calibration corrects the rest.
    assert float(size.removesuffix("deg")) == pytest.approx(-angle, abs=1.5)
    mended = mend(nominal, wrong, hypothesis.key)
    assert calibrate(nominal, [mended, distances]).verdict.status != "refused"


def test_several_wrong_zeros_lead_to_a_hand_built_arm():
    """The parameters that were suggested were estimated already."""
    data = TouchingArm.random(0, 48, 8).data
    (reason,) = calibrate(NOMINAL, data).verdict.reasons
    assert reason.endswith("--arm low-cost.")
    assert "--parameters" not in reason
    # Nothing is suggested that does not help.
    assert calibrate(NOMINAL, data, HAND_BUILT, turned="none").verdict.status == "ok"


def test_other_outliers_have_no_wrong_name():
    nominal, contacts, distances = touched()
    q = contacts.q.copy()
    q[[3, 30, 55], 1] += [0.02, -0.05, 0.1]
    fit = calibrate(nominal, [contacts.resample(q), distances])
    assert fit.n_outliers >= 3
    assert not fit.wrong_labels


def test_targets_with_exchanged_names_are_named():
    simulation = Simulation("ur10", 40, 2)
    data = simulation.measure_targets()
    names = list(data.text_values()["target"])
    names[3], names[4] = names[4], names[3]
    wrong = MultiTargetPosition(data.q, data.positions(), names)
    fit = calibrate(simulation.chain, wrong, "minimal,base,tool")
    assert [(each.column, each.stated, each.fitting, each.rows) for each in fit.wrong_labels] == [
        ("target", "a", "b", (5,)),
        ("target", "b", "a", (4,)),
    ]


# Seeds of arms whose touches of four points leave a combination of zeros and lengths nearly free.
WEAK = (4, 5, 6)


def touched_by_low_cost_arm(seed, n_points):
    """Return an arm that touched points, its calibration, and the true error in the measured region [m]."""
    arm = TouchingArm.random(seed, 200, n_points, ("shoulder",))
    fit = calibrate(NOMINAL, arm.data, "low-cost,base,tool", turned=("shoulder",), session="off")
    assert fit.measured_region is not None
    return fit, arm.error(fit.chain, fit.measured_region.draw(np.random.default_rng(1), 300))


@pytest.mark.parametrize("seed", some_slow(WEAK, {0}))
def test_errors_that_few_points_do_not_show_are_stated_and_more_points_determine_them(seed):
    """The cross-validated error was 0.9 mm with verdict ok beside a true error of 3 to 4 mm."""
    fit, true = touched_by_low_cost_arm(seed, 4)
    (reason,) = fit.verdict.reasons
    assert fit.verdict.status == "caution"
    assert reason.startswith("The measured configurations do not determine the errors between them")
    assert reason.endswith("Touch more points, at known distances from each other.")
    assert fit.comparisons[0].after.groups["position"].rms < 0.5 * true
    assert 0.7 < fit.position_std / true < 3
    # The advice helps.
    fit, less = touched_by_low_cost_arm(seed, 8)
    assert (fit.verdict.status, fit.verdict.reasons) == ("ok", ())
    assert less < 1e-3 < true


def test_touches_that_determine_an_arm_are_ok():
    """Without the standard deviations of the distances, the size of the arm is not known as well."""
    nominal, *data = touched()
    (reason,) = calibrate(nominal, data).verdict.reasons
    assert reason.startswith("The standard deviations of the known distances are not stated")
    assert "column sigma_distance" in reason
    fit = calibrate(nominal, touched(sigma=1e-4)[1:])
    assert (fit.verdict.status, fit.verdict.reasons) == ("ok", ())
    assert fit.position_std < 2e-4


def test_known_distances_are_not_held_out(right):
    """Without some of few distances, nothing else states the size of the arm."""
    held_out = right.comparisons[0]
    assert held_out.title == "cross-validated"
    assert "length" not in held_out.after.groups
    assert any(item.kind == "point_distance" for item in right.data)


def test_two_files_of_distances_alone_have_a_verdict(sim_6dof):
    """Nothing touches their points."""
    data = [PointDistance(6, [("p1", "p2"), ("p2", "p3")], lengths) for lengths in ([0.2, 0.3], [0.25, 0.35])]
    fit = calibrate(sim_6dof, [item.replace(has_stated_sigma=True) for item in data])
    assert fit.verdict.status != "ok"
