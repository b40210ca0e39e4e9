"""Signs of simulated servo arms: decided, or stated as open."""

import re
from dataclasses import replace

import numpy as np
import pytest
from paper_arms import photograph
from servo_arms import JOINTS, RANGES, SO101, TIP, ServoArm, lerobot_degrees
from slow_cases import some_slow
from touching_arms import NOMINAL as TOUCHING
from touching_arms import TouchingArm

from dhcal_pin.calibration import calibrate
from dhcal_pin.calibration.evidence import _usual_errors
from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.io.servo_file import read_servos
from dhcal_pin.measurements import Noise, Pose, Position, Wires
from dhcal_pin.plausibility import decide_signs
from dhcal_pin.plausibility.diagnosis import NO_EVIDENCE, Diagnosis
from dhcal_pin.plausibility.evidence import HAND_BUILT, MANUFACTURED, fit_evidence
from dhcal_pin.plausibility.hypotheses import list_hypotheses, mend, ratio_hypothesis
from dhcal_pin.plausibility.mixups import diagnose_mixups
from dhcal_pin.plausibility.signs import known_signs
from dhcal_pin.robot import Chain, parse_urdf

NOMINAL = Chain.from_urdf(SO101, TIP)


def joint_values(counts: np.ndarray) -> np.ndarray:
    """Joint values as LeRobot reports them (m, 5) [rad]."""
    columns = zip(counts.T, (RANGES[name] for name in JOINTS), strict=True)
    return np.deg2rad(np.stack([lerobot_degrees(column, *limits) for column, limits in columns], -1))


def measured(
    arm: ServoArm, rng: np.random.Generator, m: int, kind: str, share: float = 1.0
) -> Position | Pose:
    counts, poses = arm.measure(rng, m, share=share)
    q = joint_values(counts)
    return Pose(q, poses) if kind == "pose" else Position(q, poses[:, :3, 3])


def rms_error(chain: Chain, arm: ServoArm, rng: np.random.Generator) -> float:
    """True RMS error of the tool over the joint range [m]."""
    q = arm.configurations(rng, 60)
    read = arm.signs * (q - arm.zeros)
    error = chain.poses(read)[:, :3, 3] - arm.poses(q)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(error**2, 1))))


# Kind, number of poses, share of the joint range, largest zero error [deg], seeds, and smallest number of
# arms whose signs are decided and right.
SERIES = [
    ("position", 25, 1.0, 15.0, range(2), 2),
    pytest.param("position", 25, 1.0, 15.0, range(50), 49, marks=pytest.mark.slow),
    pytest.param("position", 25, 1.0, 20.0, range(50, 70), 19, marks=pytest.mark.slow),
    pytest.param("position", 12, 0.8, 15.0, range(50), 40, marks=pytest.mark.slow),
    pytest.param("pose", 12, 0.8, 15.0, range(20), 18, marks=pytest.mark.slow),
    pytest.param("position", 8, 0.6, 15.0, range(20), 0, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("kind", "m", "share", "zero", "seeds", "n_decided"), SERIES)
def test_signs_are_right_or_open_and_no_accepted_arm_is_worse(kind, m, share, zero, seeds, n_decided):
    decided, ratios = 0, []
    for seed in seeds:
        rng = np.random.default_rng(1000 * m + seed)
        arm = ServoArm.random(rng, zero)
        fit = calibrate(NOMINAL, measured(arm, rng, m, kind, share), "low-cost,base,tool")
        assert fit.signs is not None
        is_right = fit.signs.turned == arm.wrong
        different = {*fit.signs.turned} ^ {*arm.wrong}
        is_open = any(set(each.joints) == different for each in fit.signs.open)
        assert is_right or is_open or fit.verdict.is_refused, (seed, arm.wrong, fit.signs)
        if fit.signs.open:
            assert fit.verdict.status != "ok"
            assert any(fit.signs.open[0].joints[0] in reason for reason in fit.verdict.reasons)
        decided += is_right and not fit.signs.open
        if fit.verdict.status == "ok":
            calibrated, nominal = (
                rms_error(chain, arm, np.random.default_rng(0)) for chain in (fit.chain, fit.nominal_refitted)
            )
            ratios.append(calibrated / nominal)
    worst = max(ratios, default=0.0)
    print(f"{decided} of {len(seeds)} decided, {len(ratios)} ok, largest error over nominal {worst:.2f}")
    assert decided >= n_decided
    assert worst < 1.0


def straight_arm(path):
    """Write the arm with all joints on one line at zero, which looks the same upside down."""
    text = SO101.read_text()
    text = re.sub(r'<origin xyz="([0-9.]+) [0-9.]+ -?[0-9.]+" rpy', r'<origin xyz="\1 0.0 0.0" rpy', text)
    path.write_text(text)
    return path


@pytest.mark.parametrize("wrong", [0, 2])
def test_a_mirrored_arm_is_an_open_question(tmp_path, wrong):
    path = straight_arm(tmp_path / "straight.urdf")
    rng = np.random.default_rng(wrong)
    arm = ServoArm.random(rng, 15.0, wrong=wrong, path=path)
    nominal = Chain.from_urdf(path, TIP)
    fit = calibrate(
        nominal, measured(arm, rng, 25, "position"), "low-cost,base,tool", extend="none", session="off"
    )
    signs = fit.signs
    assert signs is not None
    mirrored = {"shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex"}
    assert [set(each.joints) for each in signs.open] == [mirrored]
    assert {*signs.turned} in ({*arm.wrong}, {*arm.wrong} ^ mirrored)
    assert fit.verdict.status == "caution"
    reason = next(text for text in fit.verdict.reasons if "open" in text)
    assert "right-hand rule" in reason
    # The answer to the question is one of two options, and one of them is right.
    options = re.findall(r"add --turned (\S+?)[.;]", reason)
    assert (",".join(name for name in JOINTS if name in arm.wrong) or "none") in options
    known = calibrate(nominal, fit.data, "low-cost,base,tool", turned=arm.wrong, extend="none", session="off")
    assert known.verdict.status == "ok"
    assert known.signs is not None
    assert known.signs.turned == arm.wrong


def test_the_stated_pose_tells_two_arms_apart():
    # Eight poses near each other leave a sign open.
    rng = np.random.default_rng(8003)
    arm = ServoArm.random(rng, 15.0, wrong=1)
    data = measured(arm, rng, 8, "position", 0.4)
    signs = decide_signs(NOMINAL, [data])
    assert signs.open
    pose = np.array(signs.open[0].configuration)
    # Three measurements there, and at its neighbours, decide the question.
    true = arm.signs * (pose + 0.02 * rng.normal(size=(3, 5))) + arm.zeros
    counts, positions = arm.counts(true), arm.poses(true)[:, :3, 3]
    more = Position(np.vstack([data.q, joint_values(counts)]), np.vstack([data.positions(), positions]))
    again = decide_signs(NOMINAL, [more])
    first = {*signs.open[0].joints}
    assert first not in [{*each.joints} for each in again.open]


def test_images_and_few_samples_leave_all_signs_open():
    rng = np.random.default_rng(0)
    arm = ServoArm.random(rng)
    signs = decide_signs(NOMINAL, [measured(arm, rng, 5, "position")])
    assert not signs.is_compared
    assert "--turned" in signs.questions[0]


@pytest.mark.parametrize("seed", some_slow(range(6), {1}))
def test_signs_from_touched_points_are_right_or_open(seed):
    turned = [(), ("shoulder",), ("elbow", "roll")][seed % 3]
    arm = TouchingArm.random(seed, 100, 4, turned)
    signs = decide_signs(TOUCHING, arm.data)
    assert signs.is_compared
    # The base turns little while the arm touches one point, and nobody sees where it stands.
    free = {"yaw", "roll"}
    assert {*signs.turned} ^ {*turned} <= free
    assert {name for each in signs.open for name in each.joints} <= free
    for each, question in zip(signs.open, signs.questions, strict=False):
        assert each.distance is None
        assert "measurement at" not in question
        assert "right-hand rule" in question


def test_touched_points_without_known_distances_decide_no_sign():
    arm = TouchingArm.random(1, 100, 4, ("shoulder",))
    signs = decide_signs(TOUCHING, arm.data[:1])
    assert not signs.is_compared
    assert "known distances" in signs.questions[0]
    assert decide_signs(TOUCHING, arm.data).is_compared


def test_a_urdf_with_other_zeros_is_named():
    """Followed advice helps: with the zeros of the servos in the URDF nothing is said."""
    rng = np.random.default_rng(4)
    arm = ServoArm.random(rng, 10.0, 0)
    poses = measured(arm, rng, 25, "pose")
    other = poses.replace(q=poses.q + np.deg2rad([0, 90, -90, 0, 0]))
    reasons = [
        " ".join(calibrate(NOMINAL, data, "low-cost,base,tool", session="off").verdict.reasons)
        for data in (poses, other)
    ]
    assert "zeros" not in reasons[0]
    assert re.search(r"shoulder_lift by -(8|9|10)\d?°, elbow_flex by (8|9|10)\d?°.*servo file", reasons[1])


@pytest.mark.parametrize("seed", [2, *(pytest.param(i, marks=pytest.mark.slow) for i in range(3, 15))])
def test_exchanged_links_of_camera_and_board_are_named(seed):
    shot = photograph(seed, 12 if seed % 2 else 25)
    images = shot.images.with_rig(shot.images.rig.with_exchanged_links())
    camera, board = shot.images.rig.camera_mounts[0].moves, shot.images.rig.board_mounts[0].moves
    links = ["tip" if moves else "world" for moves in (board, camera)]
    stated = replace(images.rig, **{
        name: tuple(replace(each, link=link) for each in getattr(images.rig, name))
        for name, link in zip(("cameras", "boards"), links, strict=True)
    })  # fmt: skip
    message = (
        f"camera 'cam' on link '{links[1]}' and board 'paper' on link '{links[0]}'; expected these links"
    )
    with pytest.raises(InvalidArgumentError, match=message):
        decide_signs(shot.nominal, [images.with_rig(stated)])


@pytest.mark.parametrize(("parameters", "expected"), [(None, MANUFACTURED), (HAND_BUILT, HAND_BUILT)])
def test_known_signs_do_not_make_an_arm_hand_built(parameters, expected):
    rng = np.random.default_rng(0)
    data = Position.simulate(NOMINAL, rng.uniform(-1, 1, (30, 5)), Noise(1e-4), rng)
    fit = calibrate(NOMINAL, data, parameters, turned="none", extend="none", session="off")
    assert _usual_errors(fit) == expected


def test_turned_joints_turn_the_other_way_in_the_urdf():
    urdf = SO101.read_text()
    urdf = urdf.replace('<axis xyz="1 0 0"/>', "").replace('upper="1.66"', 'upper="1.2"')
    chain = Chain.from_urdf(parse_urdf(urdf.encode(), "arm.urdf"), TIP)
    arm = known_signs(chain, ["wrist_flex", "wrist_roll"]).apply(chain)
    read_back = Chain.from_urdf(arm.urdf, TIP)
    q = np.random.default_rng(0).uniform(-1, 1, (4, 5))
    signs = [1, 1, 1, -1, -1]
    np.testing.assert_allclose(read_back.poses(q), chain.poses(q * signs), atol=1e-14)
    np.testing.assert_allclose(arm.poses(q), chain.poses(q * signs), atol=1e-14)
    np.testing.assert_array_equal(read_back.lower, [*chain.lower[:3], *-chain.upper[3:]])
    np.testing.assert_array_equal(read_back.upper, [*chain.upper[:3], *-chain.lower[3:]])


@pytest.mark.parametrize(
    ("key", "remedy"),
    [
        ("sign:shoulder_lift", "Add --turned elbow_flex,shoulder_lift."),
        ("sign:elbow_flex", "Add --turned none."),
        ("zero:elbow_flex:+90deg", "Correct the motors of elbow_flex in the servo file."),
        ("swap:elbow_flex:wrist_flex", "Correct the measurements."),
        ("rows:above", "Correct the measurements, or add --mend rows:above."),
    ],
)
def test_remedies_of_servos_are_allowed_beside_their_file(key, remedy):
    data = Position(np.zeros((2, 5)), np.zeros((2, 3)))
    hypothesis = next(each for each in list_hypotheses(NOMINAL, [data]) if each.key == key)
    found = Diagnosis(NO_EVIDENCE, (hypothesis,))
    assert found.for_servos(("elbow_flex",)).remedy == remedy
    assert f"--mend {key}" in found.remedy


def string_lengths(seed: int, wrong: float = 0.0) -> Wires:
    """Return lengths of a string to a hobby arm; values of its shoulder are too large by an angle [rad]."""
    rng = np.random.default_rng(seed)
    truth, q = TouchingArm.random(seed, 8).truth, rng.uniform(-1.4, 1.4, (40, 5))
    lengths = np.linalg.norm(truth.poses(q)[:, :3, 3] - [0.4, -0.1, 0.2], axis=1)
    return Wires(q + wrong * np.eye(5)[1], (lengths + 5e-4 * rng.standard_normal(40))[:, None])


@pytest.mark.parametrize("angle", some_slow([90, -90], {0}))
def test_a_quarter_turn_of_a_zero_is_no_reversed_joint(angle):
    """Reversed joints with zeros of 85° fitted the string about as well, and the zero was named nowhere."""
    data = string_lengths(1, np.deg2rad(angle))
    signs = decide_signs(TOUCHING, [data])
    assert (signs.turned, signs.questions) == ((), [])
    (found,) = diagnose_mixups(TOUCHING, [data], HAND_BUILT).hypotheses
    assert found.key == f"zero:shoulder:{-angle:+}deg"
    # The remedy gives the values of the arm back.
    np.testing.assert_allclose(mend(TOUCHING, data, found.key).configurations(), string_lengths(1).q)


def test_each_of_several_open_sets_of_signs_is_an_option_that_fits():
    """Three sentences assumed different answers; an option taken literally was a mirrored arm."""
    data = string_lengths(0)
    signs = decide_signs(TOUCHING, [data])
    (question,) = signs.questions
    options = re.findall(r"--turned (\S+?)[,.]?(?= |$)", question)
    assert len(options) == len(signs.open) + 1 > 2
    assert options[0] == (",".join(signs.turned) or "none")
    for option in options:
        arm = known_signs(TOUCHING, [] if option == "none" else option.split(",")).apply(TOUCHING)
        assert fit_evidence(arm, [data], HAND_BUILT).length_scale < 1e-3


def test_a_wrong_ratio_of_a_servo_states_the_factor_of_its_counts(tmp_path):
    """Values times 0.8 are true: q = (c - zero)·2π/counts_per_turn needs 1.25 times the counts per turn."""
    found = Diagnosis(NO_EVIDENCE, (ratio_hypothesis(NOMINAL, [2], 0.8),)).for_servos(())
    assert found.remedy.startswith("Multiply counts_per_turn of elbow_flex by 1.25 in the servo file (")
    (factor,) = map(float, re.findall(r"by (\S+) in", found.remedy))
    written = [tmp_path / f"{i}.toml" for i in range(2)]
    for path, count in zip(written, (4096, 4096 * factor), strict=True):
        path.write_text(f"[motor.elbow_flex]\nresolution = 4096\ncounts_per_turn = {count}\n")
    wrong, right = (read_servos(path).servos[0].step for path in written)
    assert right / wrong == pytest.approx(0.8)


RATIOS = [
    (joint, factor, play, seed)
    for seed in range(4)
    for joint, factor, play in ((2, 1.1, 0.5), (3, 1.3, 1.0), (1, 0.9, 1.0))
]


@pytest.mark.parametrize(("joint", "factor", "play", "seed"), some_slow(RATIOS, {0, 1}))
def test_a_wrong_gear_ratio_of_a_hand_built_arm_is_named(joint, factor, play, seed):
    """The zeros of the arm are unknown, and its joints have play."""
    rng = np.random.default_rng(seed)
    arm = ServoArm.random(rng, zero_deg=8.0, wrong=0)
    q = arm.configurations(rng, 30, 0.8)
    poses = arm.poses(q + np.deg2rad(play) / 2 * rng.choice([-1.0, 1.0], q.shape))
    reported = q - arm.zeros
    reported[:, joint] *= factor
    data = Position(reported, poses[:, :3, 3] + rng.normal(0, 5e-4, (30, 3)))
    (found,) = diagnose_mixups(NOMINAL, [data], HAND_BUILT).hypotheses
    kind, name, size = found.key.split(":")
    assert (kind, name) == ("ratio", JOINTS[joint])
    assert float(size) == pytest.approx(1 / factor, rel=0.02)


@pytest.mark.parametrize("seed", some_slow(range(8), {0, 1}))
def test_play_of_a_hand_built_arm_is_no_gear_ratio(seed):
    rng = np.random.default_rng(seed)
    arm = ServoArm.random(rng, zero_deg=8.0, wrong=0)
    q = arm.configurations(rng, 30, 0.8)
    poses = arm.poses(q + np.deg2rad(2.0) / 2 * rng.choice([-1.0, 1.0], q.shape))
    data = Position(q - arm.zeros, poses[:, :3, 3] + rng.normal(0, 5e-4, (30, 3)))
    assert not diagnose_mixups(NOMINAL, [data], HAND_BUILT).hypotheses


def test_counts_of_servos_have_no_wrong_unit():
    data = Position(np.zeros((2, 5)), np.zeros((2, 3)))
    keys = [
        [each.key for each in list_hypotheses(NOMINAL, [item])]
        for item in (data, data.replace(has_counts=True))
    ]
    assert {key.partition(":")[0] for key in {*keys[0]} - {*keys[1]}} == {"joint", "joints"}
