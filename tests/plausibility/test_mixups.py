"""Diagnosis of mixed-up joints, frames, rows and notations."""

import re
from dataclasses import replace
from functools import reduce
from types import SimpleNamespace

import numpy as np
import pytest
from measurement_files import frames, joint_positions, real_ur10
from robots import nominal_arm, paper
from scipy.spatial.transform import Rotation
from sessions import NAMES as SESSIONS
from sessions import Simulation
from slow_cases import some_slow

from dhcal_pin import se3, split
from dhcal_pin.calibration import calibrate
from dhcal_pin.estimation import select_parameters
from dhcal_pin.exceptions import UnknownNameError
from dhcal_pin.io import read_robot
from dhcal_pin.measurements import Distance, Noise, PointContact, PointDistance, Pose, Position, Wires
from dhcal_pin.measurements.euler_angles import euler_notation
from dhcal_pin.plausibility import diagnose_mixups, fit_evidence, list_hypotheses, mend, mixups, trials
from dhcal_pin.plausibility.diagnosis import NO_EVIDENCE, Diagnosis, is_fitted
from dhcal_pin.plausibility.evidence import MANUFACTURED, Evidence
from dhcal_pin.plausibility.hypotheses import both, ratio_hypothesis
from dhcal_pin.plausibility.misfit import nominal_misfits
from dhcal_pin.plausibility.signs import known_signs
from dhcal_pin.robot import Chain, DHTable


def measured(kind, m=60, seed=0, reach=0.4):
    """Measurements of a UR10 with errors, by an instrument somewhere; no joint limit is exceeded."""
    arm = real_ur10()
    base, tool = frames()
    arm = arm.with_base_and_tool(base, tool)
    rng = np.random.default_rng(seed)
    return kind.simulate(arm, reach * joint_positions(arm, m, seed), Noise(1e-4, 1e-4), rng)


def with_joints(data, change):
    return data.resample(change(data.configurations()))


def swapped(i, j):
    order = np.arange(6)
    order[[i, j]] = j, i
    return lambda q: q[:, order]


def shifted(j, degrees):
    return lambda q: q + np.deg2rad(degrees) * (np.arange(6) == j)


def flipped(j):
    return lambda q: q * np.where(np.arange(6) == j, -1, 1)


def coupled(i, j, multiple):
    return lambda q: q + multiple * q[:, [i]] * (np.arange(6) == j)


NAMES = [
    f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
]
MIXUPS = [
    *((flipped(j), f"sign:{name}") for j, name in enumerate(NAMES)),
    (lambda q: -q, "sign:all"),
    (shifted(1, 90), "zero:shoulder_lift_joint:-90deg"),
    (shifted(4, -90), "zero:wrist_2_joint:+90deg"),
    (shifted(2, 180), "zero:elbow_joint:-180deg"),
    (swapped(0, 2), "swap:shoulder_pan_joint:elbow_joint"),
    (swapped(3, 4), "swap:wrist_1_joint:wrist_2_joint"),
    (lambda q: np.roll(q, 1, 1), "columns:-1"),
    (lambda q: q[:, ::-1], "columns:reversed"),
    (np.rad2deg, "joints:deg-not-rad"),
    (np.deg2rad, "joints:rad-not-deg"),
    (lambda q: np.where(np.arange(6) == 3, np.rad2deg(q), q), "joint:wrist_1_joint:deg-not-rad"),
    (coupled(1, 2, 1), "coupling:elbow_joint:-shoulder_lift_joint"),
    (coupled(4, 5, -1), "coupling:wrist_3_joint:+wrist_2_joint"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("mixup", "key", "kind"),
    some_slow([(*mixup, kind) for mixup in MIXUPS for kind in (Pose, Position)], {0, 16, 22, 31}),
    ids=[f"{key}-{kind.__name__}" for _, key in MIXUPS for kind in (Pose, Position)],
)
def test_mixed_up_joints_are_named_and_mended(ur10, kind, mixup, key):
    """The robot has errors of millimetres."""
    data = measured(kind)
    wrong = with_joints(data, mixup)
    found = diagnose_mixups(ur10, [wrong])
    assert key in [hypothesis.key for hypothesis in found.hypotheses]
    assert f"--mend {key}" in found.remedy
    np.testing.assert_allclose(mend(ur10, wrong, key).q, data.q, atol=1e-12)
    assert not diagnose_mixups(ur10, [data]).is_suspicious


@pytest.mark.parametrize(
    ("scales", "factor", "stated", "expected"),
    [
        ((1.9e-3, 9e-3), 1.0, (0.0, 0.0), True),
        ((2.1e-3, 9e-3), 1.0, (0.0, 0.0), False),
        ((1.9e-3, 1.1e-2), 1.0, (0.0, 0.0), False),
        ((3.9e-3, 1.9e-2), 2.0, (0.0, 0.0), True),
        ((4.1e-3, 1.9e-2), 2.0, (0.0, 0.0), False),
        ((5.9e-3, 2.9e-2), 1.0, (3e-3, 1.5e-2), True),
        ((6.1e-3, 2.9e-2), 1.0, (3e-3, 1.5e-2), False),
        ((5.9e-3, 3.1e-2), 1.0, (3e-3, 1.5e-2), False),
        ((1.9e-3, 9e-3), 1.0, (1e-5, 1e-5), True),
    ],
)
def test_a_robot_fits_with_usual_residuals_or_twice_the_stated_noise(scales, factor, stated, expected):
    """Usual residuals are 2 mm and 10 mrad."""
    evidence = Evidence(0.0, 1.0, *scales, residual_factor=factor, stated_noise=stated)
    assert is_fitted(evidence) == expected


@pytest.mark.parametrize("kind", [Pose, Position])
def test_evidence_knows_the_stated_noise(ur10, kind):
    data = measured(kind, 20)
    noise = (1e-4, 1e-4 if kind is Pose else 0.0)
    assert fit_evidence(ur10, [data], MANUFACTURED).stated_noise == pytest.approx(noise)
    unknown = kind(data.q, data.poses if kind is Pose else data.values)
    assert fit_evidence(ur10, [unknown], MANUFACTURED).stated_noise == (0.0, 0.0)


@pytest.mark.parametrize("kind", [Pose, Position])
def test_joint_values_in_alphabetical_order_are_named_and_mended(kind):
    """ROS publishes the joints of an arm in this order, which four of these names change."""
    names = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
    arm = Chain.from_dh(replace(paper("sim_6dof"), names=names))
    rng = np.random.default_rng(5)
    true = replace(arm, origins=arm.origins @ se3.exp6(1e-3 * rng.normal(size=(len(arm.origins), 6))))
    data = kind.simulate(true, rng.uniform(-2, 2, (40, 6)), Noise(1e-4, 1e-4), rng)
    wrong = with_joints(data, lambda q: q[:, np.argsort(names)])
    found = diagnose_mixups(arm, [wrong])
    assert [hypothesis.key for hypothesis in found.hypotheses] == ["columns:alphabetical"]
    np.testing.assert_allclose(mend(arm, wrong, "columns:alphabetical").q, data.q, atol=1e-12)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("abc", ["columns:-1", "columns:+1"]),
        ("abcd", ["columns:-1", "columns:+1", "columns:reversed"]),
        ("cbda", ["columns:-1", "columns:+1", "columns:reversed", "columns:alphabetical"]),
        ("acbd", ["columns:-1", "columns:+1", "columns:reversed"]),
        ("dcba", ["columns:-1", "columns:+1", "columns:reversed"]),
        ("ba", []),
    ],
)
def test_each_order_of_the_joints_is_tried_once(names, expected):
    """An order in which two joints are exchanged is a hypothesis of its own."""
    n = len(names)
    zero, limits = np.zeros(n), np.full(n, 3.0)
    arm = Chain.from_dh(
        DHTable("standard", tuple(names), zero > 0, zero, zero, zero, zero, zero, -limits, limits)
    )
    data = Position(np.zeros((3, n)), np.zeros((3, 3)))
    keys = [each.key for each in list_hypotheses(arm, [data])]
    assert [key for key in keys if key.startswith("columns:")] == expected


def scara(theta, d, a):
    """SCARA whose third joint is a slide [m, rad]."""
    alpha, zero = np.array([0.0, np.pi, 0.0, 0.0]), np.zeros(4)
    names, is_slide, limits = ("j1", "j2", "j3", "j4"), np.arange(4) == 2, np.full(4, np.inf)
    rows = theta, np.array(d), np.array(a), alpha, zero
    return Chain.from_dh(DHTable("standard", names, is_slide, *rows, -limits, limits))


@pytest.mark.parametrize("other", [0, 1, 3])
def test_the_exchanged_column_of_a_slide_is_named_and_mended(other):
    actual = scara(np.array([0.0, 0.01, 0.0, 0.0]), (0.401, 0, 0, 0.1), (0.3005, 0.2491, 0, 0))
    base, tool = frames()
    rng = np.random.default_rng(other)
    q = rng.uniform([-2, -2, 0, -3], [2, 2, 0.2, 3], (40, 4))
    data = Pose.simulate(actual.with_base_and_tool(base, tool), q, Noise(1e-4, 1e-4), rng)
    order = np.arange(4)
    order[[2, other]] = other, 2
    nominal = scara(np.zeros(4), (0.4, 0, 0, 0.1), (0.3, 0.25, 0, 0))
    wrong = with_joints(data, lambda q: q[:, order])
    keys = [each.key for each in diagnose_mixups(nominal, [wrong]).hypotheses]
    key = ":".join(["swap", *(f"j{j + 1}" for j in sorted((2, other)))])
    assert key in keys
    np.testing.assert_allclose(mend(nominal, wrong, key).q, data.q)


def test_a_reversed_axis_of_the_robot_has_the_effect_of_a_wrong_sign(ur10):
    """The remedies give a robot for the joint values, or one for those with the change."""
    data = measured(Position)
    wrong = known_signs(ur10, ["elbow_joint"]).apply(ur10)
    found = diagnose_mixups(wrong, [data])
    assert found.hypotheses[0].key == "sign:elbow_joint"
    assert found.remedy == (
        "Correct the joint values, or the axis of joint elbow_joint in the robot file: the data do not show "
        "which of them is wrong. To get a robot for joint values with this change, add "
        "--mend sign:elbow_joint."
    )
    assert not diagnose_mixups(ur10, [data]).is_suspicious
    changed = mend(wrong, data, "sign:elbow_joint")
    fit = calibrate(wrong, changed, "minimal,base,tool", extend="none")
    errors = [
        np.linalg.norm(fit.chain.poses(q)[:, :3, 3] - data.positions(), axis=1).max()
        for q in (changed.q, data.q)
    ]
    assert errors[0] < 1e-3
    assert errors[1] > 0.1


def test_measured_lengths_in_another_unit_may_be_those_of_the_robot(ur10):
    data = measured(Position)
    found = diagnose_mixups(ur10, [data.replace(values=1e3 * data.values)])
    assert found.sentence.startswith("Measured lengths are 1000 times too large, as if mm had been read as m")
    assert found.remedy == (
        "Correct the measurements, or the lengths in the robot file: the data do not show which of them is "
        "wrong. To keep the robot's lengths, add --mend lengths:mm-not-m."
    )


VALUES = "To get a robot for joint values with this change, add --mend"


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        (["sign:all"], ["or the axes of all joints in the robot file:", VALUES]),
        (["swap:elbow_joint:wrist_1_joint"], ["the order of joints elbow_joint and wrist_1_joint", VALUES]),
        (["columns:reversed"], ["or the order of the joints in the robot file:", VALUES]),
        (["zero:elbow_joint:+90deg"], ["or the zero of joint elbow_joint in the robot file:", VALUES]),
        (["sign:elbow_joint", "lengths:mm-not-m"], ["in the robot file and the lengths in", VALUES]),
        (["sign:elbow_joint", "rows:above"], ["Correct the measurements, or add --mend sign:elbow_joint+"]),
        (["joints:deg-not-rad"], ["Correct the measurements, or add --mend joints:deg-not-rad."]),
        (["quaternions:xyzw"], ["Correct the measurements, or add --mend quaternions:xyzw."]),
    ],
)  # fmt: skip
def test_the_remedy_names_what_may_be_wrong_instead(ur10, keys, words):
    known = {each.key: each for each in list_hypotheses(ur10, [measured(Pose)])}
    found = Diagnosis(NO_EVIDENCE, (reduce(both, [known[key] for key in keys]),))
    assert all(text in found.remedy for text in words)
    # Measurements without the mistake fit the robot.
    in_lines = replace(found, source="a.csv", lines=(3, 9)).remedy
    assert in_lines == f"Correct the measurements, or add --mend {'+'.join(keys)}@a.csv:3-9."


def test_the_remedy_of_a_ratio_names_the_controller(ur10):
    found = Diagnosis(NO_EVIDENCE, (ratio_hypothesis(ur10, [2], 1.1),))
    assert "or the gear ratio of joint elbow_joint in the controller: the data do not show" in found.remedy
    assert found.remedy.endswith(f"{VALUES} ratio:elbow_joint:1.1.")


@pytest.mark.parametrize(
    ("kind", "joint", "degrees"),
    some_slow([(Pose, 2, -60), (Position, 3, 50), (Wires, 1, 75), (Pose, 4, 20), (Position, 1, -70)], {0, 1}),
)
def test_the_zero_of_a_joint_is_off_by_a_measured_angle(ur10, kind, joint, degrees):
    """A robot with large errors fits the measurements after a wrong quarter turn, too."""
    data = measured(kind)
    wrong = with_joints(data, shifted(joint, degrees))
    found = diagnose_mixups(ur10, [wrong])
    (hypothesis,) = found.hypotheses
    assert found.is_certain
    mended = mend(ur10, wrong, hypothesis.key)
    difference = np.rad2deg(mended.configurations() - data.configurations())
    # The robot has errors of 4 mrad.
    assert np.abs(difference).max() < 1.01
    assert not np.delete(difference, joint, 1).any()


@pytest.mark.parametrize("seed", some_slow([2, 9, 12, 13], {0}))
def test_errors_of_the_robot_do_not_hide_the_angle_of_a_zero(sim_3dof, seed):
    """The nominal robot of three joints fits best with an angle that is up to 4° off."""
    rng, errors = np.random.default_rng(seed), select_parameters(sim_3dof, "minimal")
    sizes = np.array([{"m": 1e-3, "rad": 5e-3}[parameter.unit] for parameter in errors.parameters])
    truth = errors.at(sizes * rng.standard_normal(len(sizes)))
    data = Position.simulate(truth, rng.uniform(-2, 2, (50, 3)), Noise(5e-5), rng)
    wrong = data.resample(data.q + np.deg2rad([0, 13, 0]))
    found = diagnose_mixups(sim_3dof, [wrong])
    assert found.is_certain
    (hypothesis,) = found.hypotheses
    mended = mend(sim_3dof, wrong, hypothesis.key)
    np.testing.assert_allclose(np.rad2deg(mended.q - data.q), 0, atol=3)


@pytest.mark.parametrize(
    "name",
    # The correction makes the UR10 1 % longer, which is no scale of the instrument.
    some_slow(["ur3", "ur10", "panda"], {1}),
)
def test_a_zero_that_the_calibration_corrects_is_named_if_the_correction_is_large(name):
    """The zero is off by 8.5°, the correction by as much; with the named change it is of ordinary size."""
    arm = nominal_arm(name)
    rng, errors = np.random.default_rng(71), select_parameters(arm, "minimal,base,tool")
    truth = errors.at(0.5 * np.minimum(errors.priors, 0.1) * rng.standard_normal(len(errors.parameters)))
    q = rng.uniform(-2, 2, (50, len(arm.joint_names)))
    data = Position.simulate(truth, q, Noise(5e-5), rng)
    wrong = data.resample(data.q + np.deg2rad(8.5) * np.eye(q.shape[1])[1])
    found = calibrate(arm, wrong, "minimal,base,tool")
    assert not found.diagnosis.hypotheses
    (reason,) = found.verdict.reasons
    (key,) = re.findall(r"add --mend (\S+)\.$", reason)
    assert key.startswith(f"zero:{arm.joint_names[1]}:-")
    mended = mend(arm, wrong, key)
    np.testing.assert_allclose(np.rad2deg(mended.q - data.q), 0, atol=1.0)
    assert calibrate(arm, mended, "minimal,base,tool").verdict.status == "ok"


@pytest.mark.parametrize(
    ("name", "joints", "factor", "seed"),
    some_slow(
        [
            ("ur10", "elbow_joint", 1.1, 0),
            ("panda", "all", 1.2, 1),
            *(("panda", "panda_joint4", 1.1, seed) for seed in range(5)),
            *(("ur10", "shoulder_pan_joint", 0.8, seed) for seed in range(5)),
            *(("ur10", "wrist_2_joint", 1.25, seed) for seed in range(5)),
            *(("ur10", "all", 300 / 360, seed) for seed in range(5)),
        ],
        range(2),
    ),
)
def test_a_wrong_gear_ratio_is_named_and_mended(name, joints, factor, seed):
    """The Panda, whose fit left 7 mm with a gain far from its true one, was "ok"."""
    arm = nominal_arm(name)
    rng, errors = np.random.default_rng(seed), select_parameters(arm, "minimal,base,tool")
    truth = errors.at(0.5 * np.minimum(errors.priors, 0.1) * rng.standard_normal(len(errors.parameters)))
    data = Position.simulate(truth, rng.uniform(-2, 2, (100, arm.n_joints)), Noise(5e-5), rng)
    is_wrong = np.isin(arm.joint_names, joints) | (joints == "all")
    wrong = data.resample(data.q / np.where(is_wrong, factor, 1))
    verdict = calibrate(arm, wrong, "minimal,base,tool").verdict
    assert verdict.status == "refused"
    (key,) = re.findall(r"add --mend (\S+)\.$", verdict.reasons[0])
    mended = mend(arm, wrong, key)
    assert key.startswith(f"ratio:{joints}:")
    # The calibration corrects the rest.
    np.testing.assert_allclose(mended.q, data.q, rtol=3e-3)
    after = calibrate(arm, mended, "minimal,base,tool")
    assert after.verdict.status == "ok"
    fresh = Position.simulate(truth, rng.uniform(-2, 2, (200, arm.n_joints)), Noise(0), rng)
    read = mend(arm, fresh.resample(fresh.q / np.where(is_wrong, factor, 1)), key)
    error = after.chain.poses(read.q)[:, :3, 3] - truth.poses(fresh.q)[:, :3, 3]
    assert np.sqrt(np.mean(np.sum(error**2, 1))) < 2e-4


@pytest.mark.parametrize("joint", [1, 3])
def test_a_ratio_of_the_only_revolute_joint_or_of_a_slide_is_named_once(joint):
    up, free = np.array([np.pi / 2, np.pi / 2, 0, 0]), np.full(4, np.inf)
    names, slides = ("x", "y", "z", "turn"), np.array([True, True, True, False])
    table = DHTable("standard", names, slides, up, np.full(4, 0.2), np.full(4, 0.1), up, 0 * up, -free, free)
    arm = Chain.from_dh(table)
    rng = np.random.default_rng(joint)
    q = rng.uniform(-1, 1, (60, 4)) * np.where(slides, 0.5, 2.5)
    data = Position.simulate(arm.with_base_and_tool(*frames()), q, Noise(5e-5), rng)
    found = diagnose_mixups(arm, [data.resample(data.q / np.where(np.arange(4) == joint, 1.2, 1))])
    (hypothesis,) = found.hypotheses
    kind, name, factor = hypothesis.key.split(":")
    assert (kind, name) == ("ratio", names[joint])
    assert float(factor) == pytest.approx(1.2, abs=5e-3)


def test_zeros_of_any_angle_are_mended_beside_other_mistakes(ur10):
    data = measured(Pose)
    wrong = with_joints(with_joints(data, flipped(0)), shifted(2, 12.5))
    mended = mend(ur10, wrong, "zero:elbow_joint:-12.5deg+sign:shoulder_pan_joint")
    np.testing.assert_allclose(mended.q, data.q, atol=1e-12)
    with pytest.raises(
        UnknownNameError,
        match=r"unknown change.*kinds of changes are sign, zero, .*, lag, scale, range, wire$",
    ):
        mend(ur10, wrong, "zero:elbow:-12.5deg")


def with_rotations(data, change):
    poses = data.poses.copy()
    poses[:, :3, :3] = change(poses[:, :3, :3])
    return data.replace(poses=poses)


def quaternions_in_another_order(rotations):
    """Rotations of quaternions x, y, z, w that are read as w, x, y, z; from the eigenvectors of K."""
    out = []
    for r in rotations:
        k = np.array([
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ])  # fmt: skip
        w, x, y, z = np.linalg.eigh(k)[1][:, -1]
        out.append([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
    return np.array(out)


def with_positions(data, change):
    if isinstance(data, Position):
        return data.replace(values=change(data.values))
    poses = data.poses.copy()
    poses[:, :3, 3] = change(poses[:, :3, 3])
    return data.replace(poses=poses)


def read_as(true, read):
    """Return the change of rotations whose Euler angles of one order are read in another one."""
    return lambda r: Rotation.from_euler(read, Rotation.from_matrix(r).as_euler(true)).as_matrix()


POSE_MIXUPS = [
    (lambda d: with_rotations(d, quaternions_in_another_order), "quaternions:xyzw"),
    (lambda d: with_rotations(d, lambda r: np.swapaxes(r, 1, 2)), "rotations:inverse"),
    (lambda d: with_rotations(d, lambda r: se3.exp3(np.deg2rad(se3.log3(r)))), "rotations:rad-not-deg"),
    (lambda d: with_rotations(d, read_as("ZYX", "XYZ")), "rotations:zyx-not-xyz"),
    (lambda d: with_rotations(d, read_as("xyz", "XYZ")), "rotations:rpy-not-xyz"),
    (lambda d: d.replace(poses=np.linalg.inv(d.poses)), "poses:inverse"),
    (lambda d: with_positions(d, lambda p: p * [1, -1, 1]), "axes:x,-y,z"),
    (lambda d: with_positions(d, lambda p: p[:, [1, 0, 2]]), "axes:y,x,z"),
    (lambda d: with_positions(d, lambda p: p / 1e3), "lengths:m-not-mm"),
    (lambda d: with_positions(d, lambda p: p * 25.4), "lengths:mm-not-in"),
    (lambda d: with_positions(d, lambda p: p / [1, 1, 1e3]), "z:m-not-mm"),
    (lambda d: with_positions(d, lambda p: p * [1, 1e3, 1]), "y:mm-not-m"),
]


# The others of the fast suite are those of `calibration/test_mistakes.py`.
@pytest.mark.parametrize(
    ("mixup", "key"), some_slow(POSE_MIXUPS, {3, 4, 6, 9, 10}), ids=[key for _, key in POSE_MIXUPS]
)
def test_mixed_up_poses_are_named_and_mended(ur10, mixup, key):
    data = measured(Pose)
    wrong = mixup(data)
    found = diagnose_mixups(ur10, [wrong])
    assert key in [hypothesis.key for hypothesis in found.hypotheses]
    np.testing.assert_allclose(mend(ur10, wrong, key).poses, data.poses, atol=1e-9)


def with_angles_read_as(data, true, read):
    """Return poses whose Euler angles of one notation of SciPy were read from a file in another one."""
    angles = Rotation.from_matrix(data.rotations()).as_euler(true)
    wrong = with_rotations(data, lambda _: Rotation.from_euler(read, angles).as_matrix())
    return wrong.with_euler_angles(notation_of(read), angles)


def notation_of(name):
    return euler_notation(name.lower(), "intrinsic" if name.isupper() else "extrinsic")


@pytest.mark.parametrize(
    ("true", "read", "others"),
    some_slow(
        [
            # Another first axis of ZYZ angles turns the frame of the rotations.
            ("ZYZ", "ZXZ", ["axes:y,-x,z"]),
            ("YZX", "XYZ", ["axes:y,z,x"]),
            # The second angles of both notations have different ranges.
            ("ZYZ", "ZYX", []),
            ("YXZ", "XYX", []),
            ("xyz", "ZYX", []),
            ("zyz", "ZYZ", []),
        ],
        {0, 2, 4},
    ),
)
def test_the_notation_of_euler_angles_is_named_as_the_file_was_read(ur10, true, read, others):
    data = measured(Pose)
    wrong = with_angles_read_as(data, true, read)
    key = f"rotations:{notation_of(true)}-not-{notation_of(read)}"
    found = diagnose_mixups(ur10, [wrong])
    assert [hypothesis.key for hypothesis in found.hypotheses] == [key, *others]
    mended = mend(ur10, wrong, key)
    np.testing.assert_allclose(mended.poses, data.poses, atol=1e-9)
    assert not diagnose_mixups(ur10, [mended]).is_suspicious
    keys = [each.key for each in list_hypotheses(ur10, [wrong])]
    assert not [each for each in keys if each.startswith("quaternions")]
    others = [each for each in keys if each.startswith("rotations:") and "-not-" in each]
    assert {each.partition("-not-")[2] for each in others} == {"deg", notation_of(read)}


def test_euler_angles_in_radians_that_were_read_as_degrees_are_named(ur10):
    data = measured(Pose)
    angles = Rotation.from_matrix(data.rotations()).as_euler("ZYX")
    small = np.deg2rad(angles)
    wrong = with_rotations(data, lambda _: Rotation.from_euler("ZYX", small).as_matrix())
    wrong = wrong.with_euler_angles("zyx", small)
    found = diagnose_mixups(ur10, [wrong])
    assert [hypothesis.key for hypothesis in found.hypotheses] == ["rotations:rad-not-deg"]
    assert "Euler angles are 57.3 times too small, as if rad" in found.sentence
    np.testing.assert_allclose(mend(ur10, wrong, "rotations:rad-not-deg").poses, data.poses, atol=1e-9)


@pytest.mark.parametrize(("true", "key"), [("xyz", "rpy"), ("ZYX", "zyx")])
def test_euler_angles_that_were_read_as_rotation_vectors_are_mended_in_all_rows(ur10, true, key):
    """The file has longer vectors than rotations have: their matrices do not show the angles."""
    data = measured(Pose)
    angles = Rotation.from_matrix(data.rotations()).as_euler(true)
    assert np.linalg.norm(angles, axis=1).max() > np.pi
    wrong = with_rotations(data, lambda _: Rotation.from_rotvec(angles).as_matrix())
    wrong = wrong.with_euler_angles("rotvec", angles)
    (found,) = diagnose_mixups(ur10, [wrong]).hypotheses
    assert found.key == f"rotations:{key}-not-rotvec"
    assert found.description.endswith("but were read as rotation vectors")
    np.testing.assert_allclose(mend(ur10, wrong, found.key).poses, data.poses, atol=1e-9)


def test_rotation_vectors_of_another_program_may_come_from_quaternions(ur10):
    wrong = with_rotations(measured(Pose), quaternions_in_another_order)
    wrong = wrong.with_euler_angles("rotvec", Rotation.from_matrix(wrong.rotations()).as_rotvec())
    (found,) = diagnose_mixups(ur10, [wrong]).hypotheses
    assert found.description.startswith("the rotation vectors come from quaternions: ")
    np.testing.assert_allclose(mend(ur10, wrong, found.key).poses, measured(Pose).poses, atol=1e-9)


def test_a_turn_of_the_frame_is_one_mistake_and_not_two_about_the_axes(ur10):
    """Rotations from elsewhere, whose notation is not known."""
    wrong = with_rotations(measured(Pose), read_as("ZYZ", "ZXZ"))
    found = diagnose_mixups(ur10, [wrong])
    assert [hypothesis.key for hypothesis in found.hypotheses] == ["axes:y,-x,z"]
    assert found.sentence.startswith(
        "The frame of the positions is turned: their y, -x, z are x, y, z of the"
    )
    assert not diagnose_mixups(ur10, [mend(ur10, wrong, "axes:y,-x,z")]).is_suspicious


def test_a_notation_and_a_sign_are_named(ur10):
    wrong = mend(ur10, with_angles_read_as(measured(Pose), "ZYZ", "ZYX"), "sign:elbow_joint")
    (found,) = diagnose_mixups(ur10, [wrong]).hypotheses
    assert found.key == "sign:elbow_joint+rotations:zyz-not-zyx"


def test_a_sign_and_the_unit_of_one_coordinate_are_named(ur10):
    data = with_positions(measured(Position), lambda p: p / [1, 1, 1e3])
    wrong = mend(ur10, data, "sign:elbow_joint")
    (found,) = diagnose_mixups(ur10, [wrong]).hypotheses
    assert found.key == "sign:elbow_joint+z:m-not-mm"


@pytest.mark.parametrize("change", [lambda p: p[:, [1, 0, 2]], lambda p: p * [1, -1, 1]])
def test_a_mirrored_frame_of_positions_is_named(ur10, change):
    found = diagnose_mixups(ur10, [with_positions(measured(Position), change)])
    assert [hypothesis.key for hypothesis in found.hypotheses] == ["axes:x,y,-z"]
    assert "the measuring frame is mirrored" in found.sentence.lower()


@pytest.mark.parametrize(
    ("kind", "step", "key"),
    some_slow(
        [
            (Pose, 1, "rows:below"),
            (Position, -1, "rows:above"),
            (Pose, -1, "rows:above"),
            (Position, 1, "rows:below"),
        ],
        {0, 1},
    ),
)
def test_rows_shifted_by_one_are_named(ur10, kind, step, key):
    data = measured(kind, 150, reach=1.0)
    upper, lower = np.arange(149), np.arange(1, 150)
    joints, values = (lower, upper) if step > 0 else (upper, lower)
    wrong = data.take(values).replace(q=data.q[joints], rows=np.arange(1, 150))
    found = diagnose_mixups(ur10, [wrong])
    assert [hypothesis.key for hypothesis in found.hypotheses] == [key]
    # A random part of the rows, as of a hold-out split, is enough.
    part = wrong.take(np.random.default_rng(1).permutation(149)[:100])
    assert [hypothesis.key for hypothesis in diagnose_mixups(ur10, [part]).hypotheses] == [key]
    mended = mend(ur10, wrong, key)
    assert len(mended.rows) == 148
    np.testing.assert_allclose(mended.q, data.take(np.isin(data.rows, mended.rows + (step < 0))).q)


@pytest.mark.parametrize("seed", some_slow([15, 17, 22, 25, 38, 47, 48, 51, 54, 55], {0, 3}))
def test_few_rows_that_fit_any_pairing_show_no_shift(seed):
    """Eight of twelve positions are fitted; half of them have a neighbouring row."""
    sim = Simulation(SESSIONS[seed % 4], 12, seed, errors=(8e-3, 8e-3))
    rounded = np.deg2rad(np.round(np.rad2deg(sim.q), 1))
    (fitted,), (holdout,) = split([sim.measure().replace(q=rounded)], 0.3, 0)
    found = diagnose_mixups(sim.chain, [fitted], holdout=[holdout])
    assert not [each.key for each in found.hypotheses if "rows:" in each.key]


@pytest.mark.parametrize("count", [12, 15, 20])
@pytest.mark.parametrize(("kind", "step"), [(Pose, 1), (Position, -1), (Position, 1)])
@pytest.mark.parametrize("seed", some_slow(list(range(5)), {0}))
def test_a_shift_of_few_rows_is_named(count, kind, step, seed):
    sim = Simulation(SESSIONS[seed % 4], count, seed)
    wrong = sim.measure(kind).replace(q=np.roll(sim.q, step, 0))
    found = diagnose_mixups(sim.chain, [wrong])
    assert [each.key for each in found.hypotheses] == [{1: "rows:above", -1: "rows:below"}[step]]


@pytest.mark.parametrize("seed", some_slow([2, 19, 27, 40], {0}))
def test_an_exact_fit_of_few_rows_is_no_evidence_of_a_mistake(seed):
    """The evidence of 24 values fell with the noise, so that a wrong ratio seemed to explain them better."""
    sim = Simulation(SESSIONS[seed % 4], 12, seed, errors=(8e-3, 8e-3))
    rounded = np.deg2rad(np.round(np.rad2deg(sim.q), 1))
    (fitted,), _ = split([sim.measure().replace(q=rounded)], 0.3, 0)
    assert not diagnose_mixups(sim.chain, [fitted]).hypotheses


@pytest.mark.parametrize("kind", some_slow([Distance, Wires, PointContact], {0}))
def test_other_instruments_show_mixed_up_joints(ur10, kind):
    data = measured(kind)
    wrong = with_joints(data, flipped(2))
    assert "sign:elbow_joint" in [hypothesis.key for hypothesis in diagnose_mixups(ur10, [wrong]).hypotheses]
    assert not diagnose_mixups(ur10, [data]).hypotheses


def test_distances_between_points_that_no_drawn_sample_touches_say_nothing(ur10):
    rng = np.random.default_rng(0)
    data = PointContact.simulate(ur10, rng.uniform(-2, 2, (24, 6)), Noise(1e-4), rng)
    pairs = [(f"a{i}", f"b{i}") for i in range(20)]
    found = diagnose_mixups(ur10, [data, PointDistance(6, pairs, np.ones(20))])
    assert not found.hypotheses
    assert found.zero is None
    assert not found.is_suspicious


@pytest.mark.parametrize("seed", some_slow(list(range(10)), {2}))
def test_noise_of_a_joint_that_measures_a_contact_is_no_wrong_unit(seed):
    """The lift of a SCARA alone determines the height of a point: in another unit it has no noise."""
    rng = np.random.default_rng(seed)
    lower, upper = np.array([-2.2, -2.2, 0, -3]), np.array([2.2, 2.2, 0.2, 3])
    arm = Chain.from_dh(
        DHTable(
            "standard",
            ("shoulder", "elbow", "lift", "wrist"),
            np.array([False, False, True, False]),
            np.zeros(4),
            np.array([0.4, 0, 0, 0.1]),
            np.array([0.35, 0.25, 0, 0]),
            np.array([0, np.pi, 0, 0]),
            np.zeros(4),
            lower,
            upper,
        )
    )
    errors = select_parameters(arm, "placement,base,tool")
    sizes = np.array([{"m": 1e-3, "rad": 5e-3}[parameter.unit] for parameter in errors.parameters])
    truth = errors.at(sizes * rng.standard_normal(len(sizes)))
    data = PointContact.simulate(truth, rng.uniform(lower, upper, (60, 4)), Noise(5e-5), rng)
    assert not diagnose_mixups(arm, [data]).hypotheses
    wrong = data.resample(data.q * [1, 1, 1e3, 1])
    (hypothesis,) = diagnose_mixups(arm, [wrong]).hypotheses
    assert hypothesis.key == "joint:lift:mm-not-m"


@pytest.mark.parametrize(
    ("is_found", "n_parts"), [([False, False], 2), ([False, True], 3), ([True, False], 3)]
)
def test_the_last_part_is_left_out_where_it_decides_nothing(ur10, is_found, n_parts, monkeypatch):
    """A mistake is common if two of three parts show it."""
    found = iter([SimpleNamespace(hypotheses=["a mistake"] * each) for each in [*is_found, True]])
    monkeypatch.setattr(mixups, "_find_alone", lambda *_: next(found))
    assert len(mixups._find_in_parts(ur10, measured(Pose, 24), "minimal", lambda *_: None)) == n_parts


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_zeros_of_a_hobby_arm_are_no_wrong_unit_of_contacts(seed):
    """All joints in radians instead of degrees would move 57 times less, and so would the noise."""
    arm = read_robot("example:so101", tip="gripper_frame_link")
    rng = np.random.default_rng(seed)
    zeros = np.deg2rad(rng.uniform(3, 8, arm.n_joints) * rng.choice([-1, 1], arm.n_joints))
    q = rng.uniform(np.maximum(arm.lower, -1.2), np.minimum(arm.upper, 1.2), (90, arm.n_joints))
    data = PointContact.simulate(arm.with_zeros_moved(zeros), q, Noise(2e-4), rng)
    assert not diagnose_mixups(arm, [data]).hypotheses


@pytest.mark.parametrize("kind", [Pose, Position])
def test_misfit_of_the_nominal_robot_is_that_of_its_errors(ur10, kind):
    """The frames of the instrument do not count, the unit does."""
    data = measured(kind)
    (misfit,) = nominal_misfits(ur10, [[data]])
    fitted = calibrate(ur10, data, "base,tool", loss="linear", extend="none")
    poses = fitted.chain.poses(data.q)
    tips = poses[:, :3, 3]
    squares = np.sum((tips - data.positions()) ** 2) / np.sum((tips - tips.mean(0)) ** 2)
    for r, m in zip(poses[:, :3, :3], data.rotations(), strict=False):
        squares += np.arccos(np.clip((np.trace(r.T @ m) - 1) / 2, -1, 1)) ** 2 / 3 / len(poses)
    # The samples with the largest errors do not count.
    assert 0.5 * np.sqrt(squares) < misfit < 1.1 * np.sqrt(squares)
    is_wrong = np.arange(60) % 10 == 3
    moved, few = with_positions(data, lambda p: p + is_wrong[:, None]), data.take(np.s_[:9])
    in_millimetres = with_positions(data, lambda p: 1e3 * p)
    same, with_outliers, in_another_unit, of_few = nominal_misfits(
        ur10, [[data], [moved], [in_millimetres], [few]]
    )
    assert same == misfit
    assert with_outliers < 0.01
    assert in_another_unit > 0.5
    assert of_few == 0 == nominal_misfits(ur10, [[measured(Wires)]])[0]
    assert nominal_misfits(real_ur10(), [[data]])[0] < 5e-4


def test_hypotheses_that_add_errors_are_not_tried(ur10, monkeypatch):
    """Measurements of a robot with large joint errors are suspicious; most hypotheses make them far worse."""
    arm, rng = real_ur10(), np.random.default_rng(0)
    errors = select_parameters(arm, "harmonics")
    truth = errors.at(4e-3 * rng.normal(size=len(errors.parameters)))
    data = Pose.simulate(truth, 0.4 * joint_positions(arm, 60), Noise(1e-4, 1e-4), rng)
    calls = []

    def counted(*arguments):
        calls.append(arguments)
        return fit_evidence(*arguments)

    monkeypatch.setattr(trials, "fit_evidence", counted)
    found = diagnose_mixups(ur10, [data])
    assert found.is_suspicious
    assert not found.hypotheses
    assert len(calls) < 0.35 * len(list(list_hypotheses(ur10, [data])))


def test_the_file_of_a_mistake_is_named(ur10):
    good = [measured(Position, 40, seed).replace(source=f"{seed}.csv") for seed in range(3)]
    wrong = with_joints(good[1], flipped(3))
    found = diagnose_mixups(ur10, [good[0], wrong, good[2]])
    assert found.source == "1.csv"
    assert found.remedy.endswith("--mend sign:wrist_1_joint@1.csv.")


def test_files_with_different_frames_fit_separately(ur10):
    arm = real_ur10()
    rng = np.random.default_rng(2)
    items = [
        Position.simulate(
            arm.with_base_and_tool(base, np.eye(4)), joint_positions(arm, 40, seed), Noise(1e-4), rng
        )
        for seed, base in enumerate((np.eye(4), frames()[0]))
    ]
    found = diagnose_mixups(ur10, items)
    assert found.fits_separately
    assert not found.hypotheses


def test_wrong_joint_errors_of_the_robot_are_no_mistake_in_the_measurements(ur10):
    """A coupling of 0.05 moves the other joints with the last one, whose axis the target is on."""
    errors = select_parameters(ur10, "coupling")
    wrong = errors.at(np.array([0.05 * p.name.endswith(".wrist_3_joint") for p in errors.parameters]))
    base, tool = frames()
    tool[:2, 3] = 0.0
    arm = real_ur10().with_base_and_tool(base, tool)
    q = 0.4 * joint_positions(arm, 60)
    data = Position.simulate(arm, q, Noise(1e-4), np.random.default_rng(0))
    assert not diagnose_mixups(wrong, [data]).hypotheses


def test_another_robot_gives_no_hypothesis(ur10):
    other = nominal_arm("ur3")
    data = Position.simulate(other, joint_positions(other, 60), Noise(1e-4), np.random.default_rng(1))
    found = diagnose_mixups(ur10, [data.replace(q=data.q)])
    assert found.is_suspicious
    assert not found.hypotheses


@pytest.mark.parametrize("kind", [Pose, Position])
def test_outliers_are_not_mixed_up_columns(ur10, kind):
    rng = np.random.default_rng(5)
    data = measured(kind, 80)
    is_wrong = np.isin(np.arange(80), rng.permutation(80)[:8])
    data = with_positions(data, lambda p: p + is_wrong[:, None] * rng.normal(size=p.shape))
    assert not diagnose_mixups(ur10, [data]).hypotheses


def test_keys_are_unique_and_unknown_ones_refused(ur10):
    data = measured(Pose, 12)
    keys = [hypothesis.key for hypothesis in list_hypotheses(ur10, [data])]
    assert len(keys) == len(set(keys)) > 60
    with pytest.raises(ValueError, match="sign:elbow_joint"):
        mend(ur10, data, "sign:elbow")
    with pytest.raises(ValueError, match="does not apply"):
        mend(ur10, measured(Position, 12), "poses:inverse")
