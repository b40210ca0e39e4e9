"""DH tables from origins, against the chains they came from and against published tables."""

import numpy as np
import pinocchio as pin
import pytest
from robots import ARMS, robot_file
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.robot import DHTable, Extraction, extract_dh
from dhcal_pin.robot.dh import CONVENTIONS


def product(origins, prismatic, q):
    """Base to tool (m, 4, 4), joint by joint, from the origins alone."""
    q = np.atleast_2d(q)
    out = np.broadcast_to(origins[0], (len(q), 4, 4))
    for i in range(q.shape[1]):
        twist = np.zeros((len(q), 6))
        twist[:, 2 if prismatic[i] else 5] = q[:, i]
        out = out @ se3.exp6(twist) @ origins[i + 1]
    return out


def extract(origins, prismatic=None, **options) -> Extraction:
    n = len(origins) - 1
    prismatic = np.zeros(n, bool) if prismatic is None else prismatic
    names = tuple(f"j{i + 1}" for i in range(n))
    return extract_dh(origins, names, prismatic, np.full(n, -np.inf), np.full(n, np.inf), **options)


def worst(extraction, origins, prismatic, q):
    return np.abs(extraction.table.poses(q) - product(origins, prismatic, q)).max()


def random_origin(rng, kind):
    """An origin whose z axis is skew to, parallel to, meets, or coincides with the one before it."""
    spin = se3.exp6([0, 0, rng.uniform(-0.3, 0.3), 0, 0, rng.uniform(-np.pi, np.pi)])
    back = se3.exp6([0, 0, rng.uniform(-0.3, 0.3), 0, 0, rng.uniform(-np.pi, np.pi)])
    flip = se3.exp6([0, 0, 0, np.pi * rng.integers(2), 0, 0])
    turn = se3.exp6([0, 0, 0, rng.uniform(-np.pi, np.pi), 0, 0])
    side = se3.exp6([rng.uniform(-0.5, 0.5), 0, 0, 0, 0, 0])
    middle = {"skew": side @ turn, "parallel": side @ flip, "meets": turn, "coincides": flip}[kind]
    if kind == "skew" and rng.random() < 0.5:
        middle = se3.exp6(np.concatenate([rng.uniform(-0.4, 0.4, 3), rng.uniform(-3, 3, 3)]))
    return spin @ middle @ back


def random_chain(rng):
    n = int(rng.integers(2, 9))
    kinds = rng.choice(["skew", "parallel", "meets", "coincides"], n + 1, p=[0.4, 0.25, 0.25, 0.1])
    return np.array([random_origin(rng, kind) for kind in kinds]), rng.random(n) < 0.3


def random_table(rng, convention, n=None):
    """A table with plenty of zeros and quarter turns, and with small angles that are meant."""
    n = n or int(rng.integers(2, 8))
    angles = np.where(rng.random((2, n)) < 0.4, rng.uniform(-3.1, 3.1, (2, n)), 0.0)
    alpha = np.where(
        rng.random(n) < 0.4, rng.choice([0, np.pi / 2, -np.pi / 2, np.pi, 0.01, -0.03], n), angles[0]
    )
    d, a = np.where(rng.random((2, n)) < 0.6, rng.uniform(-0.6, 0.6, (2, n)), 0.0)
    prismatic = rng.random(n) < 0.2
    beta = np.zeros(n)
    return DHTable(
        convention,
        tuple(f"j{i + 1}" for i in range(n)),
        prismatic,
        angles[1],
        d,
        a,
        alpha,
        beta,
        np.full(n, -1.0),
        np.full(n, 2.0),
    )


def read_robot(path, tip):
    """Origins with every joint along its z, up to the tip, of a robot of example-robot-data."""
    model = pin.buildModelFromUrdf(str(robot_file(path)))
    frame = model.frames[model.getFrameId(tip)]
    chain = [j for j in model.supports[frame.parentJoint] if j]
    data = model.createData()
    placements, before = [], np.eye(4)
    for j in chain:
        model.joints[j].calc(joint := model.joints[j].createData(), np.array([0.0]))
        axis = np.asarray(joint.S).ravel()[3:]
        turn = np.eye(4)
        turn[:3, :3] = pin.Quaternion.FromTwoVectors(np.array([0.0, 0, 1]), axis).toRotationMatrix()
        placements.append(before @ model.jointPlacements[j].homogeneous @ turn)
        before = se3.inverse(turn)
    placements.append(before @ frame.placement.homogeneous)
    names = [model.names[j] for j in chain]
    q = np.random.default_rng(5).uniform(-2, 2, (20, len(chain)))
    poses = []
    for values in q:
        full = pin.neutral(model)
        for j, value in zip(chain, values, strict=True):
            full[model.joints[j].idx_q] = value
        pin.framesForwardKinematics(model, data, full)
        poses.append(data.oMf[model.getFrameId(tip)].homogeneous)
    return np.array(placements), names, q, np.array(poses)


def perturb(origins, rng):
    """Every origin tilted by 1 mrad and moved by 1 mm, in a random direction each."""
    v, w = rng.normal(size=(2, len(origins), 3))
    size = np.linalg.norm([v, w], axis=-1, keepdims=True)
    return origins @ se3.exp6(1e-3 * np.concatenate([v / size[0], w / size[1]], -1))


COUNT = pytest.mark.parametrize("count", some_slow([30, 500], {0}))


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("hayati", [False, True])
@COUNT
def test_tables_of_random_chains_give_their_poses(convention, hayati, count):
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(count):
        origins, prismatic = random_chain(rng)
        q = rng.uniform(-3, 3, (5, len(prismatic)))
        found = extract(origins, prismatic, convention=convention, hayati=hayati)
        errors.append(worst(found, origins, prismatic, q))
    assert max(errors) < 1e-13


@pytest.mark.parametrize("convention", CONVENTIONS)
@COUNT
def test_tables_of_nearly_parallel_chains_give_their_poses(convention, count):
    """Tilts from rounding up to degrees, at every size, through every branch."""
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(count):
        origins, prismatic = random_chain(rng)
        tilt = 10.0 ** rng.uniform(-16, -1, (len(origins), 1)) * rng.normal(size=(len(origins), 6))
        origins = origins @ se3.exp6(tilt)
        q = rng.uniform(-3, 3, (5, len(prismatic)))
        found = extract(origins, prismatic, convention=convention)
        errors.append(worst(found, origins, prismatic, q))
        reach = np.linalg.norm(origins[:, :3, 3], axis=1).sum()
        assert np.abs(found.table.d).max() <= 4 * reach
        assert np.abs(found.table.a).max() <= reach
    assert max(errors) < 2e-13


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("hayati", [False, True])
@COUNT
def test_extraction_inverts_the_conversion_of_a_table(convention, hayati, count):
    rng = np.random.default_rng(3)
    for _ in range(count):
        table = random_table(rng, convention)
        found = extract(table.origins(), table.prismatic, convention=convention, hayati=hayati)
        for key in ("d", "a", "alpha", "theta", "beta", "base", "tool"):
            np.testing.assert_allclose(
                getattr(found.table, key), getattr(table, key), atol=1e-12, err_msg=key
            )
        assert found.notes == ()


@pytest.mark.parametrize("convention", CONVENTIONS)
@COUNT
def test_extraction_inverts_the_conversion_of_a_table_with_beta(convention, count):
    rng = np.random.default_rng(4)
    n = 6
    z = np.zeros(n)
    for _ in range(count):
        table = DHTable(
            convention,
            tuple("abcdef"),
            z > 0,
            rng.uniform(-1, 1, n),
            rng.uniform(-0.3, 0.3, n),
            rng.uniform(0.2, 0.5, n) * rng.choice([-1, 1], n),
            rng.uniform(-0.01, 0.01, n),
            rng.uniform(-0.01, 0.01, n),
            z - 1,
            z + 1,
        )
        found = extract(table.origins(), convention=convention)
        for key in ("theta", "d", "a", "alpha", "beta", "base", "tool"):
            np.testing.assert_allclose(
                getattr(found.table, key), getattr(table, key), atol=1e-12, err_msg=key
            )
        assert len(found.notes) == n


def test_negative_entries_are_preserved():
    """The two ways of writing a row differ in the signs of a and α; the table's own is found."""
    z = np.zeros(2)
    alpha, a = np.array([-np.pi / 2, np.pi / 2]), np.array([-1.0, -0.5])
    table = DHTable("standard", ("a", "b"), z > 0, z, z, a, alpha, z, z - 1, z + 1)
    found = extract(table.origins()).table
    assert found.a.tolist() == a.tolist()
    assert found.alpha.tolist() == alpha.tolist()
    assert np.array_equal(found.theta, z)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("source", ["table", "chain", "nearly parallel"])
@pytest.mark.parametrize("count", some_slow([8, 30], {0}))
def test_frames_transform_changes_of_a_row(convention, source, count):
    """Finite changes, not derivatives: both sides are products of exact motions."""
    rng = np.random.default_rng(6)
    for _ in range(count):
        origins, prismatic = random_chain(rng)
        if source == "table":
            table = random_table(rng, convention)
            origins, prismatic = table.origins(), table.prismatic
        elif source == "nearly parallel":
            origins = perturb(origins, rng)
        found = extract(origins, prismatic, convention=convention)
        n = len(prismatic)
        q = rng.uniform(-2, 2, (3, n))
        for i in range(n):
            for key, axis in (("a", 0), ("alpha", 3), ("beta", 4)):
                step = rng.uniform(-0.2, 0.2)
                values = {k: getattr(found.table, k).copy() for k in ("a", "alpha", "beta")}
                values[key][i] += step
                t = found.table
                changed = DHTable(
                    t.convention, t.names, t.prismatic, t.theta, t.d, **values,
                    lower=t.lower, upper=t.upper, base=t.base, tool=t.tool,
                )  # fmt: skip
                frame = found.frames[i]
                moved = origins.copy()
                station = i + 1 if convention == "standard" else i
                moved[station] = (
                    moved[station] @ frame @ se3.exp6(step * np.eye(6)[axis]) @ se3.inverse(frame)
                )
                np.testing.assert_allclose(changed.poses(q), product(moved, prismatic, q), atol=1e-12)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("robot", ["ur3", "ur5", "ur10"])
@pytest.mark.parametrize("count", some_slow([15, 50], {0}))
def test_ur_arms_have_plain_rows_under_small_errors(robot, convention, count):
    origins, names, q, poses = read_robot(*ARMS[robot])
    np.testing.assert_allclose(product(origins, np.zeros(6, bool), q), poses, atol=1e-14)
    reach = np.linalg.norm(origins[:, :3, 3], axis=1).sum()
    assert names[0] == "shoulder_pan_joint"
    nominal = extract(origins, convention=convention)
    assert worst(nominal, origins, np.zeros(6, bool), q) < 1e-14
    rng = np.random.default_rng(7)
    for _ in range(count):
        shaken = perturb(origins, rng)
        found = extract(shaken, convention=convention)
        assert worst(found, shaken, np.zeros(6, bool), q) < 2e-14
        assert np.abs(found.table.d).max() < min(2.0, reach)
        assert np.abs(found.table.a).max() < reach
        # Axes 2, 3 and 4 are meant to be parallel.
        for pair in ("j2 and the axis of j3", "j3 and the axis of j4"):
            assert any(f"the axis of {pair} are " in note for note in found.notes)
        # Nothing but tolerances separates the rows from the nominal ones, signs and turns included.
        for key in ("d", "a"):
            np.testing.assert_allclose(getattr(found.table, key), getattr(nominal.table, key), atol=0.01)
        for key in ("theta", "alpha"):
            turns = getattr(found.table, key) - getattr(nominal.table, key)
            np.testing.assert_allclose(np.exp(1j * turns), 1, atol=0.03)


@pytest.mark.parametrize(
    ("robot", "d1", "a2", "a3", "d4", "d5", "d6"),
    [
        ("ur3", 0.1519, 0.24365, 0.21325, 0.11235, 0.08535, 0.0819),
        ("ur5", 0.089159, 0.425, 0.39225, 0.10915, 0.09465, 0.0823),
        ("ur10", 0.1273, 0.612, 0.5723, 0.163941, 0.1157, 0.0922),
    ],
)
def test_ur_lengths_agree_with_the_published_ones(robot, d1, a2, a3, d4, d5, d6):
    table = extract(read_robot(*ARMS[robot])[0]).table
    np.testing.assert_allclose(np.abs(table.a), [0, a2, a3, 0, 0, 0], atol=1e-8)
    # The maker gives one length along the three parallel axes; the URDF spreads it over brackets.
    found = np.abs([table.d[0], table.d[1:4].sum(), table.d[4], table.d[5]])
    np.testing.assert_allclose(found, [d1, d4, d5, d6], atol=1e-4)


def test_panda_agrees_with_the_published_modified_table():
    origins, _, q, poses = read_robot(*ARMS["panda"])
    table = extract(origins, convention="modified").table
    np.testing.assert_allclose(table.poses(q), poses, atol=1e-14)
    np.testing.assert_allclose(table.d, [0.333, 0, 0.316, 0, 0.384, 0, 0], atol=1e-15)
    np.testing.assert_allclose(table.a, [0, 0, 0, 0.0825, -0.0825, 0, 0.088], atol=1e-15)
    quarter = np.array([0, -1, 1, 1, -1, 1, 1]) * np.pi / 2
    np.testing.assert_allclose(table.alpha, quarter, atol=1e-15)
    np.testing.assert_allclose(table.theta, np.zeros(7), atol=1e-15)
    assert np.array_equal(table.base, np.eye(4))
    np.testing.assert_allclose(table.tool, se3.translation([0, 0, 0.107]), atol=1e-15)


def test_note_names_joints_tilt_and_offset():
    """1 mrad between axes 0.4 m apart: the common normal is 0.4 m / 1 mrad = 400 m away."""
    tilted = se3.exp6([0.4, 0, 0, 0, 0, 0]) @ se3.exp6([0, 0, 0, 0, 1e-3, 0])
    end = se3.exp6([0, 0.1, 0, 0.5, 0, 0])
    found = extract(np.array([np.eye(4), tilted, end]))
    assert found.notes == (
        "the axis of j1 and the axis of j2 are 1 mrad from parallel: the row between them has "
        "Hayati's beta, because a row without beta would need an offset of 400 m",
    )
    np.testing.assert_allclose([found.table.a[0], found.table.beta[0]], [0.4, 1e-3], atol=1e-15)
    assert found.table.d[0] == 0.0


def test_hayati_raises_the_tilt_up_to_which_beta_is_used():
    """3° is a plain row's business unless β is asked for, or unless the plain row would leave the robot."""
    tilted = se3.exp6([0.02, 0.01, 0, 0, 0, 0]) @ se3.exp6([0, 0, 0, 0.0, np.radians(3), 0])
    far = se3.exp6([0, 0, 1.0, 0.5, 0, 0])
    assert np.all(extract(np.array([np.eye(4), tilted, far])).table.beta == 0)
    assert extract(np.array([np.eye(4), tilted, far]), hayati=True).table.beta[0] != 0
    near = se3.exp6([0, 0, 0.01, 0.5, 0, 0])
    assert extract(np.array([np.eye(4), tilted, near])).table.beta[0] != 0


def test_wrong_arguments_are_refused():
    one = np.array([np.eye(4)] * 2)
    with pytest.raises(DhcalError, match=r"origins have shape \(2, 4, 4\); expected \(3, 4, 4\)"):
        extract_dh(one, ("a", "b"), [False] * 2, [0, 0], [1, 1])
    with pytest.raises(DhcalError, match="convention 'craig'"):
        extract(one, convention="craig")
    with pytest.raises(DhcalError, match="finite"):
        extract(one * np.nan)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_mounting_pose_does_not_change_the_other_rows(convention):
    """Wherever the base stands, rows 2 and on are the same, and row 1 has no length of the room in it."""
    origins = read_robot(*ARMS["ur5"])[0]
    table = extract(origins, convention=convention).table
    for mount in ([1, 2, 0, 0, 0, 1.0], [1, 2, 0, 1e-3, 0, 0.5], [0.3, 2, 1, 0.4, 0.3, 0.2]):
        moved = origins.copy()
        moved[0] = se3.exp6(mount) @ moved[0]
        found = extract(moved, convention=convention).table
        for key in ("theta", "d", "a", "alpha", "beta"):
            got, want = getattr(found, key), getattr(table, key)
            np.testing.assert_allclose(got[1:], want[1:], atol=1e-14, err_msg=key)
        # An upright arm keeps d1 to what 1 mrad does over 2 m; a tilted one leaves it to the base.
        np.testing.assert_allclose(found.d[0], table.d[0] if mount[3] < 0.1 else 0.0, atol=3e-3)
        if convention == "modified":
            assert (found.a[0], found.alpha[0]) == (0, 0)
