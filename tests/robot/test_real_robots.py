"""Real arms of example-robot-data: kinematics against other engines, write-back, DH, ranks, calibration."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from robots import ARMS, nominal_arm, pinocchio_poses, robot_file

from dhcal_pin import se3
from dhcal_pin.calibration import calibrate
from dhcal_pin.estimation import PARAMETER_SETS, Problem, linearize_and_factor, qr, select_parameters
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import read_robot, write_urdf
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.paper import crosscheck
from dhcal_pin.paper.jacobian_check import kernel_jacobian, regressor_jacobian
from dhcal_pin.robot import Chain, Conditions, extract_dh_table, read_urdf

pytestmark = pytest.mark.usefixtures("unsuspected")

TIPS = {name: tip for name, (_, tip) in ARMS.items()} | {"ur10": "ee_link", "panda": "panda_hand"}
ARM = pytest.mark.parametrize("arm", TIPS)


def load(arm: str) -> Chain:
    return nominal_arm(arm, TIPS[arm])


def draw(chain: Chain, m: int, seed: int = 0):
    """Joint values within limits and within a turn."""
    low, high = np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi)
    return np.random.default_rng(seed).uniform(low, high, (m, chain.n_joints))


def stripped(arm: str) -> str:
    """The URDF without meshes and masses, with what MuJoCo wants."""
    text = read_urdf(robot_file(ARMS[arm][0])).data.decode()
    text = re.sub(r"<!--.*?-->", "", text, flags=re.S)
    text = re.sub(r"<(visual|collision|inertial)\b.*?</\1>", "", text, flags=re.S)
    compiler = (
        '<mujoco><compiler fusestatic="false" boundmass="1e-6" boundinertia="1e-9" '
        'balanceinertia="true"/></mujoco>'
    )
    return re.sub(r"(<robot\b[^>]*>)", r"\1" + compiler, text, count=1, flags=re.S)


@ARM
def test_poses_agree_with_pinocchio(arm):
    chain = load(arm)
    q = draw(chain, 200)
    assert np.abs(chain.poses(q) - pinocchio_poses(chain, q)).max() <= 1e-12


@ARM
def test_poses_agree_with_mujoco(arm):
    import mujoco

    chain = load(arm)
    q = draw(chain, 200)
    model = mujoco.MjModel.from_xml_string(stripped(arm))  # pyright: ignore[reportAttributeAccessIssue]
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    root = model.body(chain.urdf.root).id if chain.urdf.root != "world" else 0
    values = q @ chain.mimic_matrix.T + chain.mimic_offset
    worst = 0.0
    for row, pose in zip(values, chain.poses(q), strict=True):
        for name, value in zip(chain.moving_joints, row, strict=True):
            data.joint(name).qpos[0] = value
        mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
        base, body = (
            se3.transform(data.xmat[i].reshape(3, 3), data.xpos[i]) for i in (root, model.body(chain.tip).id)
        )
        worst = max(worst, np.abs(se3.inverse(base) @ body - pose).max())
    assert worst <= 1e-9


@ARM
def test_poses_agree_with_kinpy(arm):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what it imports
        import kinpy

        tree = kinpy.build_chain_from_urdf(stripped(arm).encode())  # pyright: ignore[reportArgumentType]
    chain = load(arm)
    q = draw(chain, 200)
    values = q @ chain.mimic_matrix.T + chain.mimic_offset
    for row, pose in zip(values, chain.poses(q), strict=True):
        found = tree.forward_kinematics(dict(zip(chain.moving_joints, row, strict=True)))[chain.tip]
        assert np.abs(found.matrix() - pose).max() <= 1e-9


@ARM
def test_jacobian_agrees_with_the_regressor_of_pinocchio(arm):
    chain = load(arm)
    errors = select_parameters(chain, "placement")
    q = draw(chain, 50)
    assert np.abs(kernel_jacobian(chain, errors, q) - regressor_jacobian(chain, errors, q)).max() <= 1e-11


@ARM
def test_model_of_a_perturbed_chain_has_its_poses(arm):
    chain = load(arm)
    rng = np.random.default_rng(1)
    moved = chain.perturbed_at(
        {s: se3.exp6(0.02 * rng.normal(size=6)) for s in range(1, chain.tool_frame_index)}
    )
    q = draw(chain, 50)
    np.testing.assert_allclose(moved.poses(q), pinocchio_poses(moved, q), atol=1e-12)


@ARM
def test_written_urdf_is_the_same_robot_and_changes_only_origins(arm, tmp_path):
    chain = load(arm)
    rng = np.random.default_rng(2)
    moved = chain.perturbed_at(
        {2 * j: se3.exp6(0.02 * rng.normal(size=6)) for j in range(1, len(chain.moving_joints) + 1)}
    )
    path = tmp_path / "out.urdf"
    write_urdf(moved, path)
    again = read_robot(path, chain.tip)
    q = draw(chain, 50)
    assert np.abs(again.poses(q) - moved.poses(q)).max() <= 1e-12
    before, after = chain.urdf.data.splitlines(), path.read_bytes().splitlines()
    changed = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    assert len(changed) == len(chain.moving_joints)
    assert all(b"<origin" in a and b"<origin" in b for a, b in changed)
    write_urdf(chain, tmp_path / "same.urdf")
    assert (tmp_path / "same.urdf").read_bytes() == chain.urdf.data


@ARM
def test_factors_agree_through_the_extracted_table(arm):
    for row in crosscheck(load(arm), 50):
        assert row.agrees, row


@pytest.mark.parametrize("convention", ["standard", "modified"])
@ARM
def test_extracted_dh_table_has_the_same_poses(arm, convention):
    chain = load(arm)
    table = extract_dh_table(chain, convention).table
    q = draw(chain, 100)
    assert np.abs(table.poses(q) - chain.poses(q)).max() <= 1e-12
    assert np.abs(Chain.from_dh(table).poses(q) - chain.poses(q)).max() <= 1e-12


def rank(errors, q) -> int:
    zero = np.zeros(len(errors.parameters))
    data = Pose.simulate(errors.chain, q, Noise(), np.random.default_rng(0))
    return qr.rank(linearize_and_factor(Problem(errors, (data,), zero), zero, False).r)


def counts(chain: Chain) -> tuple[int, int]:
    slides = int(chain.prismatic.sum())
    return len(chain.moving_joints) - slides, slides


@ARM
def test_complete_sets_have_the_rank_of_theory(arm):
    """4R + 2P + 6; a pair of coaxial or parallel axes does not matter, as frames move with the arm."""
    chain = load(arm)
    revolute, slides = counts(chain)
    theory = 4 * revolute + 2 * slides + 6
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (100, chain.n_joints))
    for sets in ("minimal,base,tool", "placement,base,tool", "dh,hayati,minimal,base,tool,offset"):
        assert rank(select_parameters(chain, sets), q) == theory, sets


def recovered(chain: Chain, sets: str, seed: int) -> float:
    """Largest held-out position error in m after fitting noise-free poses of an arm off by 2° and 10 mm."""
    rng = np.random.default_rng(seed)
    errors = select_parameters(chain, sets)
    size = np.array([np.deg2rad(2) if p.unit == "rad" else 0.01 for p in errors.parameters])
    truth = errors.at(size * rng.uniform(-1, 1, len(size)))
    shape = (80, chain.n_joints)
    conditions = Conditions(
        rng.uniform(-np.pi, np.pi, shape),
        approach=rng.choice([-1.0, 1.0], shape),
        temperature=chain.reference_temperature + np.tile(np.linspace(-10, 10, 40), 2),
    )
    data = Pose.simulate(truth, conditions[:40], Noise(), rng)
    fit = calibrate(chain, data, sets, priors="none")
    return fit.validate(Pose.simulate(truth, conditions[40:], Noise(), rng))["position_max_m"]


WITH_FRAMES = [f"{s},base,tool" for s in ("dh", "modified-dh", "hayati", "minimal", "placement", "offset")]
# Few samples do not determine the curves.
EVERY_SET = [*(name for name in PARAMETER_SETS if "curves" not in name), *WITH_FRAMES]


# Three sets or more of each arm, two arms or more of each set; the slow test has all.
SOME = [(arm, sets) for i, arm in enumerate(ARMS) for j, sets in enumerate(EVERY_SET) if (i + j) % 6 == 0]


@pytest.mark.parametrize(("arm", "sets"), SOME)
def test_every_set_recovers_a_noise_free_arm(arm, sets):
    assert recovered(load(arm), sets, 0) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("sets", EVERY_SET)
@ARM
def test_every_set_recovers_a_noise_free_arm_for_all_seeds(arm, sets):
    chain = load(arm)
    worst = max(recovered(chain, sets, seed) for seed in range(100))
    assert worst < 1e-9


def test_ur10_agrees_with_the_published_lengths():
    table = extract_dh_table(load("ur10"), "standard").table
    np.testing.assert_allclose(np.sort(np.abs(table.a))[-2:], [0.5723, 0.612], atol=1e-9)
    np.testing.assert_allclose(
        [abs(table.d[4]), abs(table.d[5] + table.tool[2, 3])], [0.1157, 0.0922], atol=2e-4
    )
    assert abs(np.sum(table.d[1:4])) == pytest.approx(0.163941, abs=1e-6)


def test_tables_of_perturbed_ur_arms_have_no_large_offsets():
    for arm in ("ur3", "ur5", "ur10"):
        chain = load(arm)
        length = np.linalg.norm(chain.origins[:, :3, 3], axis=1).sum()
        for seed in range(20):
            rng = np.random.default_rng(seed)
            shake = {s: se3.exp6(1e-3 * rng.uniform(-1, 1, 6)) for s in range(2, chain.tip_frame, 2)}
            moved = chain.perturbed_at(shake)
            for convention in ("standard", "modified"):
                table = extract_dh_table(moved, convention).table
                assert np.abs(np.concatenate([table.d, table.a])).max() < length
                q = draw(chain, 10)
                np.testing.assert_allclose(table.poses(q), moved.poses(q), atol=1e-12)


def test_ambiguous_tips_are_listed_with_their_last_shared_link():
    with pytest.raises(DhcalError, match=r"--tip: panda_leftfinger, panda_rightfinger .*panda_hand"):
        Chain.from_urdf(robot_file(ARMS["panda"][0]))


def test_default_tips():
    assert Chain.from_urdf(robot_file(ARMS["ur10"][0])).tip == "tool0"
    assert Chain.from_urdf(robot_file(ARMS["xarm7"][0])).tip == "link_eef"


def test_joints_that_are_not_on_the_path_stay_neutral():
    chain = load("tiago")
    assert chain.joint_names[0] == "torso_lift_joint"
    assert chain.prismatic.tolist() == [True] + [False] * 7
    assert chain.n_joints < chain.model.nv


def test_base_and_tool_are_not_written_to_the_urdf(tmp_path):
    chain = load("ur10")
    base = se3.exp6([1.0, 2, 3, 0.4, 0.5, 0.6])
    placed = replace(chain, base=base, tool=se3.exp6([0.1, 0, 0.2, 0, 0.3, 0]))
    write_urdf(placed, tmp_path / "out.urdf")
    assert (tmp_path / "out.urdf").read_bytes() == chain.urdf.data
    np.testing.assert_allclose(read_robot(tmp_path / "out.urdf", chain.tip).base, base, atol=1e-15)
