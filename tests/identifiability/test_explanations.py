"""Explanations are compared with theory, exact poses and Pinocchio's axes, and their advice is followed."""

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from robots import nominal_arm, paper
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.calibration import calibrate
from dhcal_pin.estimation import Problem, linearize_and_factor, qr, select_parameters
from dhcal_pin.identifiability import EXPECTED, explanations
from dhcal_pin.identifiability.null_space import ObservabilityProbe, UnobservableGroup, group_directions
from dhcal_pin.identifiability.propagation import PlainErrors
from dhcal_pin.measurements import KINDS, Measurement, Noise, Pose, Position
from dhcal_pin.robot import Chain, DHTable

pytestmark = pytest.mark.usefixtures("unsuspected")


def table(theta, d, a, alpha, prismatic=()):
    zero = np.zeros(len(theta))
    theta, d, a, alpha = (np.array(column, float) for column in (theta, d, a, alpha))
    names = tuple(f"j{i + 1}" for i in range(len(theta)))
    is_prismatic = np.isin(np.arange(len(theta)), prismatic)
    return DHTable("standard", names, is_prismatic, theta, d, a, alpha, zero, zero - np.inf, zero + np.inf)


RIGHT = np.pi / 2
TABLES = {
    "scara": table([0] * 4, [0.4, 0, 0, 0.1], [0.3, 0.25, 0, 0], [0, np.pi, 0, 0], prismatic=[2]),
    "prismatic": table(
        [0, 0.3, 0, 0.2, 0], [0.4, 0.1, 0.2, 0.1, 0.1], [0.1, 0.3, 0, 0.1, 0.05],
        [RIGHT, RIGHT, 0.4, -RIGHT, 0.3], prismatic=[2],
    ),
    "gantry": table([0, 0, 0, 0.1], [0.3, 0.4, 0.5, 0.1], [0, 0, 0, 0.1], [RIGHT, RIGHT, 0.2, 0], [0, 1, 2]),
    "coaxial": table([0, 0, 0], [0.4, 0.2, 0.1], [0, 0.3, 0.2], [0, RIGHT, 0.2]),
    "intersecting": table([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [0.4, 0, 0, 0.4, 0, 0.1], [0, 0.4, 0.02, 0, 0, 0],
                          [-RIGHT, 0, -RIGHT, RIGHT, -RIGHT, 0]),
    "antiparallel": table([0.1, 0.2, 0.3], [0.4, 0.1, 0.1], [0.2, 0.3, 0.2], [np.pi, RIGHT, 0.2]),
}  # fmt: skip
# Tips of arms of example-robot-data.
TIPS = {"ur5": "tool0", "ur10": "tool0", "panda": "panda_hand", "tiago": "arm_tool_link"}
PAPER = ("sim_6dof", "sim_6dof_actual", "sim_3dof", "sim_3dof_actual", "experiment")


def load(arm: str) -> Chain:
    if arm in TIPS:
        return nominal_arm(arm, TIPS[arm])
    return Chain.from_dh(TABLES[arm] if arm in TABLES else paper(arm))


def draw_q(chain: Chain, m: int, seed: int = 0):
    return np.random.default_rng(seed).uniform(-3, 3, (m, chain.n_joints))


def problem(chain: Chain, sets: str, kind: type[Measurement] = Pose, q=None, m: int = 40) -> Problem:
    q = draw_q(chain, m) if q is None else q
    data = kind.simulate(chain, q, Noise(), np.random.default_rng(0)).initialized(chain)
    found = Problem(select_parameters(chain, sets), (data,), np.empty(0))
    return replace(found, weights=np.zeros(len(found.errors.parameters) + len(found.instrument_parameters)))


def explain(of: Problem) -> list[str]:
    zero = np.zeros(len(of.weights))
    return explanations.explain_unobservable(
        ObservabilityProbe(of, zero), linearize_and_factor(of, zero, False)
    )


def rank(of: Problem) -> int:
    return qr.rank(linearize_and_factor(of, np.zeros(len(of.weights)), False).r)


def unobservable_groups(of: Problem) -> list[UnobservableGroup]:
    zero = np.zeros(len(of.weights))
    layers = ObservabilityProbe(of, zero).null_space_layers(linearize_and_factor(of, zero, False).r)
    return group_directions(
        layers, PlainErrors.from_model(of.errors, zero[: len(of.errors.parameters)]).error_frames
    )


def named(of: Problem, text: str) -> set[str]:
    names = {p.name for p in (*of.errors.parameters, *of.instrument_parameters)}
    return names & set(re.findall(r"[\w.]+", text))


# --- the paper's arms ------------------------------------------------------------------------------

ORIENTATION = "only the orientation of the tool depends on this, and the orientation is not measured"
ALPHA3 = (
    f"alpha3: {ORIENTATION}; the measurements do not depend on it; "
    "measure the orientation of the tool in a fixed frame"
)
THEORY = [
    ("sim_6dof", Pose, 21, [
        f"{EXPECTED}axes 2, 3 and 4 are parallel, so only d2 + d3 + d4 is identifiable by any measurement",
        f"{EXPECTED}axes 5 and 6 are parallel, so only d5 + d6 is identifiable by any measurement",
    ]),
    ("sim_6dof_actual", Pose, 24, []),
    *[(arm, Position, 10, [
        f"{EXPECTED}axes 2 and 3 are parallel, so only d2 + d3 is identifiable by any measurement",
        ALPHA3,
    ]) for arm in ("sim_3dof", "experiment")],
    ("sim_3dof_actual", Position, 11, [ALPHA3]),
]  # fmt: skip


@pytest.mark.parametrize(("arm", "kind", "expected_rank", "sentences"), THEORY)
def test_explanations_of_the_papers_robots_agree_with_theory(arm, kind, expected_rank, sentences):
    of = problem(load(arm), "dh", kind)
    assert rank(of) == expected_rank
    assert explain(of) == sentences


@pytest.mark.parametrize(("poses", "more"), [(2, 2), (3, 1)])
def test_too_few_equations_are_named(poses, more):
    """With Table 2 the ranks of 2, 3 and 4 poses are 12, 18 and 21, the largest possible."""
    chain = load("sim_6dof")
    texts = explain(problem(chain, "dh", m=poses))
    assert "only d2 + d3 + d4 can be identified" in texts[0]
    assert f"{6 * poses} equations for 24 parameters" in texts[-1]
    assert texts[-1].endswith("; measure more poses")
    assert rank(problem(chain, "dh", m=poses + more)) == 21
    assert rank(problem(chain, "dh", m=poses + more - 1)) < 21


# --- every direction has one group, and all claims are true --------------------------------------

ARMS = (*PAPER, *TABLES, *TIPS)
CASES = [
    *((arm, sets) for arm in ARMS for sets in ("dh", "minimal,base,tool")),
    *((arm, "placement,base,tool") for arm in ("scara", "ur10", "panda")),
    *(
        pytest.param(arm, sets, marks=pytest.mark.slow)
        for arm in ARMS
        for sets in ("placement,base,tool", "modified-dh,tool", "hayati,tool", "offset")
    ),
]


def changes(of: Problem, q, direction):
    """Exact change of the tool's poses per unit of a direction, by central differences."""
    errors, step = of.errors, 1e-5
    return (errors.at(step * direction).poses(q) - errors.at(-step * direction).poses(q)) / (2 * step)


@pytest.mark.parametrize(("arm", "sets"), CASES)
def test_each_unobservable_direction_is_in_one_group_and_does_not_move_the_tool(arm, sets):
    of = problem(load(arm), sets)
    p = len(of.weights)
    found = unobservable_groups(of)
    vectors = np.concatenate([np.empty((p, 0)), *(group.vectors for group in found)], 1)
    assert vectors.shape[1] == p - rank(of)
    assert np.linalg.matrix_rank(vectors, 1e-4) == vectors.shape[1]
    q = draw_q(of.errors.chain, 30, seed=5)
    for vector in vectors.T:
        assert np.abs(changes(of, q, vector)).max() < 1e-7
    assert {group.cause for group in found} <= {"structure"}


def lines(chain: Chain, q):
    """Directions and points (k, 3) of the joints' axes as Pinocchio sees them."""
    model = chain.model
    data = model.createData()
    pin.forwardKinematics(model, data, chain.configurations(q[None])[0])
    at = [data.oMi[model.getJointId(name)] for name in chain.moving_joints]
    return np.array([m.rotation @ a for m, a in zip(at, chain.axes, strict=True)]), np.array(
        [m.translation for m in at]
    )


@pytest.mark.parametrize(("arm", "sets"), CASES)
def test_claims_of_sentences_are_true(arm, sets):
    """Parallel and coincident axes by Pinocchio, sums against the null space of exact differences."""
    of = problem(load(arm), sets)
    chain, q = of.errors.chain, draw_q(of.errors.chain, 30, seed=6)
    names = [p.name for p in of.errors.parameters]
    jacobian = np.stack([changes(of, q, unit).ravel() for unit in np.eye(len(names))], 1)
    _, s, vt = np.linalg.svd(jacobian, full_matrices=False)
    null_space = vt[s < 1e-6 * s[0]].T
    texts = explain(of)
    assert bool(texts) == bool(null_space.shape[1])
    for text in texts:
        assert text.startswith(EXPECTED)
        if axes := re.search(r"axes ([\d, and]+?)(?: \([^)]*\))? (are parallel|lie on one line)", text):
            numbers = [int(n) - 1 for n in re.findall(r"\d+", axes[1])]
            assert len(numbers) > 1
            for one in q[:5]:
                along, at = (values[numbers] for values in lines(chain, one))
                assert np.abs(np.cross(along[0], along)).max() < 1e-9
                if "line" in axes[2]:
                    assert np.abs(np.cross(along[0], at - at[0])).max() < 1e-9
        if total := re.search(r"only ([-+\w. ]+) is identifiable", text):
            terms = re.findall(r"([-+]?) ?(?:([\d.]+) )?([A-Za-z_][\w.]*)", total[1])
            if terms[0][2] in names:
                weights = np.zeros(len(names))
                for sign, size, name in terms:
                    weights[names.index(name)] = float(size or 1) * (-1 if sign == "-" else 1)
                taking = np.flatnonzero(weights)
                assert np.abs(weights @ null_space).max() < 5e-3 * np.abs(null_space[taking]).max()
                assert np.linalg.matrix_rank(null_space[taking], 1e-6) == len(taking) - 1
    # All parameters of the null space are named and no others; long lists are summarized.
    participation, named_in_texts = (
        np.abs(null_space).max(1, initial=0),
        set().union(*(named(of, text) for text in texts)),
    )
    assert named_in_texts <= {names[i] for i in np.flatnonzero(participation > 1e-6)}
    if not any(" more:" in text for text in texts):
        assert named_in_texts >= {names[i] for i in np.flatnonzero(participation > 1e-2)}


def test_expected_redundancies_have_their_own_label():
    texts = explain(problem(load("sim_3dof"), "dh", Position))
    assert [explanations.label_unobservable(text) for text in texts] == [
        texts[0],
        f"not observable: {texts[1]}",
    ]


def test_signs_of_sums_follow_the_axes():
    """If the second axis is antiparallel to the first, their offsets subtract."""
    (text,) = explain(problem(load("antiparallel"), "dh"))
    assert text == f"{EXPECTED}axes 1 and 2 are parallel, so only d1 - d2 is identifiable by any measurement"


def test_offsets_of_coincident_axes():
    assert explain(problem(load("coaxial"), "offset")) == [
        f"{EXPECTED}axes 1 and 2 lie on one line, so only j1.offset + j2.offset is identifiable "
        "by any measurement"
    ]


def test_redundancies_of_a_ur10_have_one_reason_each():
    """Base pose and first joint, and what passes the first axis: 6 directions in two sentences."""
    texts = explain(problem(load("ur10"), "minimal,base,tool"))
    assert len(texts) == 2
    redundant = "base pose and the origin of joint 1 (shoulder_pan_joint) are redundant"
    assert texts[0].startswith(f"{EXPECTED}{redundant}, because no joint moves between them; ")
    assert "only 4 combinations of base.x, base.y, base.rx" in texts[0]
    assert "shoulder_pan_joint.ry are identifiable" in texts[0]
    assert "a rotation about and a translation along axis 1 (shoulder_pan_joint)" in texts[1]
    assert {"base.z", "base.rz"} <= named(problem(load("ur10"), "minimal,base,tool"), texts[1])


# --- instruments and poses: the advice is followed --------------------------------------------------


@pytest.mark.parametrize("kind", [kind for name, kind in KINDS.items() if name != "point_distance"])
def test_every_kind_explains_all_unobservable_directions(kind):
    of = problem(load("sim_6dof_actual"), "minimal,base,tool", kind)
    p = len(of.weights)
    found = unobservable_groups(of)
    assert sum(group.vectors.shape[1] for group in found) == p - rank(of)
    # Six directions are redundant for every instrument.
    assert sum(group.vectors.shape[1] for group in found if group.cause == "structure") == 6
    advice = re.compile("; (measure the|add a known distance) ")
    assert all(text.startswith(EXPECTED) or advice.search(text) for text in explain(of))


BASE = "the measurements do not change when the whole robot moves in this way"
TOGETHER = "the robot and the instrument can move together without changing a measurement"


@pytest.mark.parametrize(
    ("kind", "reasons"),
    [
        ("position", [ORIENTATION]),
        ("distance", [BASE, ORIENTATION]),
        ("relative", [BASE]),
        ("wires", [ORIENTATION, TOGETHER]),
        ("point", [ORIENTATION, TOGETHER, "the size of the robot"]),
    ],
)
def test_reasons_for_each_instrument(kind, reasons):
    texts = explain(problem(load("sim_6dof_actual"), "minimal,base,tool", KINDS[kind]))
    instrument = [text for text in texts if not text.startswith(EXPECTED)]
    assert len(instrument) == len(reasons)
    assert all(reason in text for reason, text in zip(reasons, instrument, strict=True))


class Orientation(Pose):
    """Poses of which only the rotation counts."""

    kind = "orientation"
    has_length_scale = False


def test_advice_for_an_unknown_size_fits_the_measurements(sim_6dof_actual):
    """A distance between contact points helps where there are contacts."""
    q = np.random.default_rng(0).uniform(-1, 1, (60, 6))
    turned = Orientation(q, sim_6dof_actual.poses(q), 1e14, 1e-4)
    touched = KINDS["point"].simulate(sim_6dof_actual, q[:4], Noise(1e-4), np.random.default_rng(1))
    advice = {
        "measure the position of the tool in a fixed frame": [turned],
        "add a known distance between contact points": [turned, touched],
    }
    for expected, data in advice.items():
        first = calibrate(sim_6dof_actual, data, "dh", extend="none").unobservable[0]
        assert first.startswith("all lengths together: the measurements do not determine the size")
        assert first.endswith(f"; {expected}")


def test_orientation_determines_what_position_does_not():
    chain = load("ur10")
    texts = explain(problem(chain, "minimal,base,tool", Position))
    last = [text for text in texts if text.endswith("measure the orientation of the tool in a fixed frame")]
    assert len(last) == 2
    assert "the measured point lies on axis 6 (wrist_3_joint) and does not move with that joint" in last[0]
    # Follow the advice: poses determine all but the redundancies, a point beside the axis all but rotations.
    assert rank(problem(chain, "minimal,base,tool", Pose)) == 30
    offset = replace(chain, tool=np.array([[1.0, 0, 0, 0.1], [0, 1, 0, 0.05], [0, 0, 1, 0], [0, 0, 0, 1]]))
    assert rank(problem(offset, "minimal,base,tool", Position)) == 27


def test_a_joint_that_never_moved_is_named():
    chain = load("ur10")
    q = draw_q(chain, 40)
    q[:, 3] = 0.3
    (text,) = [
        text for text in explain(problem(chain, "minimal,base,tool", q=q)) if not text.startswith(EXPECTED)
    ]
    assert "wrist_1_joint never moved" in text
    assert text.endswith("; move this joint")
    q[:, 3] = draw_q(chain, 40, seed=1)[:, 3]
    assert rank(problem(chain, "minimal,base,tool", q=q)) == 30


def test_similar_poses_name_the_joint_to_move():
    """A joint at two positions half a turn apart determines less than one over its full range."""
    chain = load("sim_6dof_actual")
    q = draw_q(chain, 40)
    q[:, 4] = np.where(q[:, 4] > 0, 0.2, 0.2 + np.pi)
    before = rank(problem(chain, "dh", Position, q=q))
    texts = [text for text in explain(problem(chain, "dh", Position, q=q)) if "too similar" in text]
    q[:, 4] = draw_q(chain, 40, seed=1)[:, 4]
    assert bool(texts) == (before < rank(problem(chain, "dh", Position, q=q)))
    assert all("joint_5" in text for text in texts)


@pytest.mark.parametrize(("low", "high"), [(3.5, 6.0), (-7.0, -3.3)])
def test_a_joint_whose_range_lies_beyond_half_a_turn_is_drawn_within_it(low, high):
    """Ranges such as 3.5 to 6 rad raised an error of NumPy."""
    limits = np.full(6, np.pi)
    lower, upper = np.append(-limits[1:], low), np.append(limits[1:], high)
    chain = Chain.from_dh(replace(paper("sim_6dof"), lower=lower, upper=upper))
    of = problem(chain, "dh", q=np.random.default_rng(0).uniform(lower, upper, (40, 6)))
    drawn = ObservabilityProbe(of, np.zeros(len(of.weights))).draw_configurations(
        np.random.default_rng(0), 50
    )
    assert np.all((drawn >= lower) & (drawn <= upper))
    assert explain(of) == THEORY[0][3]


@pytest.mark.parametrize("seeds", some_slow([1, 3], {0}))
@pytest.mark.parametrize("arm", [*TABLES, "ur10", "tiago", "sim_6dof_actual"])
def test_poses_over_the_full_range_need_no_advice(arm, seeds):
    """The rank is 4 per revolute joint, 2 per prismatic joint and 6, wherever the tracker is."""
    chain = load(arm)
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        placed = replace(chain, base=se3.exp6(rng.normal(0, 1, 6)), tool=se3.exp6(rng.normal(0, 0.5, 6)))
        data = Pose.simulate(placed, draw_q(chain, 60, seed), Noise(1e-4, 1e-4), rng)
        fit = calibrate(chain, data, "minimal,base,tool")
        assert fit.rank == 6 + sum(2 if is_prismatic else 4 for is_prismatic in chain.prismatic)
        assert [text for text in fit.unobservable if not text.startswith(EXPECTED)] == []


def test_identifiable_robot_needs_no_explanation():
    assert explain(problem(load("panda"), "dh")) == []


CURVES_TEXT = re.compile(
    r"correction curves: (.*); (\d+) of (\d+) combinations of harmonics are not identifiable \((.*)\); (.*)"
)


def curve_parts(text: str) -> tuple[str, ...]:
    """Reason, number of open combinations, their total, joints and advice of a sentence."""
    match = CURVES_TEXT.fullmatch(text)
    assert match is not None, text
    return match.groups()


def test_open_combinations_of_curves_are_counted_by_joint():
    """Joint 5 covers 20°: the rank falls by this number; the other sentences are those without curves."""
    arm = load("ur10")
    q = draw_q(arm, 250)
    q[:, 4] = 0.5 + 0.06 * q[:, 4]
    of, plain = problem(arm, "minimal,base,tool,curves", q=q), problem(arm, "minimal,base,tool", q=q)
    *others, text = explain(of)
    assert others == explain(plain)
    reason, count, total, joints, advice = curve_parts(text)
    assert (reason, total) == ("the poses are too similar", "360")
    assert int(count) == rank(plain) + 360 - rank(of)
    shares = dict(part.split() for part in joints.split(", "))
    assert list(shares) == ["wrist_2_joint"]
    assert 40 < int(shares["wrist_2_joint"]) <= 60
    # The advice is followed.
    assert advice == "measure poses over the full range of the joints"
    q[:, 4] = draw_q(arm, 250, 1)[:, 4]
    assert not any("curves" in text for text in explain(problem(arm, "minimal,base,tool,curves", q=q)))


def test_too_few_equations_for_curves():
    of = problem(load("ur10"), "minimal,base,tool,curves", m=50)
    text = explain(of)[-1]
    reason, count, _, _, advice = curve_parts(text)
    assert reason == "300 equations for 396 parameters"
    assert int(count) == 396 - 300 - 6
    assert advice == f"measure at least {-(-int(count) // 6)} more poses"


def test_weakly_observable_curve_of_a_joint_is_one_sentence():
    arm = load("ur10")
    q = draw_q(arm, 250)
    q[:, 4] = 0.5 + 0.5 * q[:, 4]
    of = problem(arm, "minimal,base,tool,curves", q=q)
    zero = np.zeros(len(of.weights))
    system = linearize_and_factor(of, zero, False)
    probe = ObservabilityProbe(of, zero)
    texts = explanations.explain_weakly_observable(probe, system, of.errors.priors, 0.05)
    about = [text for text in texts if "wrist_2_joint.sin" in text or "wrist_2_joint.cos" in text]
    assert len(about) == 1
    assert re.match(
        r"wrist_2_joint\.\w+ \.\.\. \w+ \(\d+ harmonics\): standard deviation of \d+ comb", about[0]
    )
