"""Gains, harmonics, compliance and coupling: the formula, the sidecar, and what simulations give back."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from exported_models import random_conditions
from robots import UR10, nominal_arm, paper, random_table, with_masses

from dhcal_pin.calibration import calibrate
from dhcal_pin.cli.main import main
from dhcal_pin.estimation import PARAMETER_SETS, select_parameters
from dhcal_pin.estimation.batch import ChainBatch
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import measurement_text, read_robot, write_urdf
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.robot import FAMILIES, Chain, Conditions, Payload, parse_urdf
from dhcal_pin.robot.error_families import JOINT_TERMS, growing_links
from dhcal_pin.robot.transmission import (
    MAX_CURVE_ORDER,
    Transmission,
    coefficient_indices,
    fill_harmonics,
    harmonic_orders,
    n_coefficients,
)

# Calibrations of arms with large errors, of which nothing asks for mistakes.
pytestmark = pytest.mark.usefixtures("unsuspected")


def drawn(chain: Chain, sets: str, rng: np.random.Generator):
    """A chain with errors of the size of the priors, frames a little off, and those errors by name."""
    errors = select_parameters(chain, sets)
    x = rng.normal(size=len(errors.parameters)) * np.minimum(errors.priors, 0.01)
    return errors.at(x).with_current_loads(), dict(zip([p.name for p in errors.parameters], x, strict=True))


@pytest.mark.parametrize(
    "sets", ["gain,coupling,harmonics,curves,backlash,compliance", "harmonics,compliance,thermal"]
)
def test_moved_zeros_keep_the_poses(sets):
    rng = np.random.default_rng(0)
    arm, _ = drawn(nominal_arm("ur10"), f"{sets},minimal,offset", rng)
    alone, _ = drawn(nominal_arm("ur10"), "minimal,offset", rng)
    arm = replace(arm, urdf_origins=alone.origins).with_current_loads()
    conditions = random_conditions(arm, 6, rng)
    summands = rng.uniform(-0.4, 0.4, arm.n_joints)
    moved, q = arm.with_zeros_moved(summands), conditions.q
    same = replace(conditions, q=q + summands)
    np.testing.assert_allclose(moved.poses(same), arm.poses(conditions), atol=1e-12)
    np.testing.assert_allclose(moved.urdf_alone.poses(q + summands), arm.urdf_alone.poses(q), atol=1e-12)


def test_actual_positions_follow_the_formula():
    """By a fresh Pinocchio model and plain arithmetic, a joint at a time."""
    rng = np.random.default_rng(0)
    plain = nominal_arm("ur10")
    arm, x = drawn(plain, "gain,harmonics,curves,fine-curves,compliance,coupling", rng)
    model = pin.buildModelFromUrdf(str(UR10))
    data = model.createData()
    q = rng.uniform(-2, 2, (10, 6))
    wanted = q.copy()
    for row, found in zip(q, wanted, strict=True):
        torque = pin.computeGeneralizedGravity(model, data, row)
        for i, name in enumerate(plain.joint_names):
            v = row[i]
            found[i] += x[f"{name}.gain"] * v
            for k in range(1, MAX_CURVE_ORDER + 1):
                found[i] += x[f"{name}.sin{k}"] * np.sin(k * v) + x[f"{name}.cos{k}"] * np.cos(k * v)
            found[i] += x.get(f"{name}.compliance", 0.0) * torque[i]
            found[i] += sum(x[f"{name}.{o}"] * row[j] for j, o in enumerate(plain.joint_names) if j != i)
    assert sum(name.endswith(".compliance") for name in x) >= 2
    assert np.abs(wanted - q).max() > 1e-3
    np.testing.assert_allclose(arm.poses(q), plain.poses(wanted), atol=1e-13)
    placed = [pin.SE3(pose) for pose in plain.poses(wanted)]
    model, frame = arm.model, arm.frame_id
    data = model.createData()
    for configuration, pose in zip(arm.configurations(q), placed, strict=True):
        pin.framesForwardKinematics(model, data, configuration)
        assert data.oMf[frame].isApprox(pose, 1e-12)


def test_harmonics_agree_with_direct_evaluation():
    q = np.random.default_rng(0).uniform(-2 * np.pi, 2 * np.pi, (3, 1000))
    out = np.empty((MAX_CURVE_ORDER, 2, *q.shape))
    fill_harmonics(q, out)
    for k, (sine, cosine) in enumerate(out, 1):
        np.testing.assert_allclose(sine, np.sin(k * q), rtol=0, atol=1e-12)
        np.testing.assert_allclose(cosine, np.cos(k * q), rtol=0, atol=1e-12)


def test_every_coefficient_is_a_parameter_of_one_set():
    """Only the compliance of joints that gravity does not load is no parameter."""
    sets = {name: PARAMETER_SETS[name](nominal_arm("ur10")) for name in FAMILIES}
    indices = [p.coefficient_index for parameters in sets.values() for p in parameters]
    assert len(set(indices)) == len(indices)
    counts = {
        "gain": 6,
        "harmonics": 6 * 2 * 2,
        "curves": 6 * 2 * 30,
        "fine-curves": 6 * 2 * 32,
        "coupling": 6 * 5,
        "backlash": 6,
        "thermal": 7,
    }
    assert {name: len(sets[name]) for name in counts} == counts
    assert set(indices) < set(range(n_coefficients(6, 6)))
    assert n_coefficients(6, 6) == len(indices) + 6 - len(sets["compliance"])


MIMIC = """<robot name="r"><link name="base"/><link name="a"/><link name="b"/>
  <joint name="lead" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="follower" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 .3"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/>
    <mimic joint="lead" multiplier="-2" offset="0.1"/></joint></robot>"""


def test_mimic_joint_follows_the_actual_position_of_its_source():
    arm = Chain.from_urdf(parse_urdf(MIMIC.encode(), "mimic.urdf"))
    errors = select_parameters(arm, "gain")
    assert [p.name for p in errors.parameters] == ["lead.gain"]
    q = np.linspace(-1, 1, 5)[:, None]
    np.testing.assert_allclose(errors.at(np.array([0.01])).poses(q), arm.poses(1.01 * q), atol=1e-15)
    placed, bodies, twists = errors.derivative(np.array([0.01]))
    frames = placed.forward_kinematics(q)
    step = 1e-6
    change = arm.poses((1.01 + step) * q)[:, :3, 3] - arm.poses((1.01 - step) * q)[:, :3, 3]
    velocity = placed.tool_jacobian(frames, bodies, twists)[0, :3].T
    np.testing.assert_allclose(velocity, change / (2 * step), atol=1e-9)


def test_gravity_on_a_mimic_joint_loads_its_source():
    """By the work of gravity: the generalised force is the slope of the potential energy."""
    arm = with_masses(Chain.from_urdf(parse_urdf(MIMIC.encode(), "mimic.urdf")), np.random.default_rng(3))
    q, h = np.array([[0.3, -0.7]]), 1e-6
    data = arm.model.createData()

    def energy(value):
        return pin.computePotentialEnergy(arm.model, data, arm.configurations(np.array([[value]]))[0])

    slope = [(energy(v + h) - energy(v - h)) / (2 * h) for v in q[0]]
    np.testing.assert_allclose(arm.loads.torques(q)[0], slope, atol=1e-8)


@pytest.mark.parametrize("robot", ["ur10", "mimic"])
def test_derivatives_by_the_highest_harmonics_agree_with_finite_differences(robot):
    """At any coefficients, and at a transmission that does not evaluate these orders itself."""
    arm = (
        nominal_arm("ur10") if robot == "ur10" else Chain.from_urdf(parse_urdf(MIMIC.encode(), "mimic.urdf"))
    )
    rng, step = np.random.default_rng(4), 1e-6
    errors = select_parameters(arm, "curves,fine-curves")
    q = rng.uniform(-2, 2, (5, arm.n_joints))
    for x in (np.zeros(len(errors.parameters)), 1e-2 * rng.normal(size=len(errors.parameters))):
        chain, bodies, twists = errors.derivative(x)
        velocities = chain.tool_jacobian(chain.forward_kinematics(q), bodies, twists)
        for i, parameter in enumerate(errors.parameters):
            if parameter.name.endswith(("sin64", "cos64", "sin17")):
                change = step * np.eye(len(x))[i]
                moved = errors.at(x + change).poses(q) - errors.at(x - change).poses(q)
                np.testing.assert_allclose(velocities[i, :3].T, moved[:, :3, 3] / (2 * step), atol=1e-9)
        if not x.any():
            ideal = arm.with_transmission(Transmission.zero(arm.loads))
            unevaluated = ideal.tool_jacobian(ideal.forward_kinematics(q), bodies, twists)
            np.testing.assert_allclose(unevaluated, velocities, rtol=0, atol=1e-15)


def test_single_harmonics_are_fixed_and_freed(ur10):
    names = {p.name for p in select_parameters(ur10, "base", free=["elbow_joint.sin17"]).parameters}
    assert names == {*(f"base.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz")), "elbow_joint.sin17"}
    errors = select_parameters(ur10, "curves", fix=["elbow_joint.cos32", "elbow_joint.sin3"])
    assert len(errors.parameters) == 6 * 60 - 2
    assert [p.name for p in errors.fixed] == ["elbow_joint.sin3", "elbow_joint.cos32"]
    with pytest.raises(DhcalError, match=r"cannot free 'elbow_joint.sin65': no such parameter") as caught:
        select_parameters(nominal_arm("ur10"), "base", free=["elbow_joint.sin65"])
    # The choices name the 768 harmonics by joint.
    assert "elbow_joint.sin1 ... cos64 (128 harmonics), wrist_1_joint.sin1" in str(caught.value)


def test_empty_sets_are_refused_with_their_requirement(sim_6dof):
    with pytest.raises(DhcalError, match=r"set 'compliance'.*masses"):
        select_parameters(sim_6dof, "base,compliance")
    slides = replace(random_table(np.random.default_rng(0), size=2), prismatic=np.array([True, True]))
    with pytest.raises(DhcalError, match=r"set 'harmonics'.*revolute joint"):
        select_parameters(Chain.from_dh(slides), "harmonics")
    assert [p.name for p in select_parameters(Chain.from_dh(slides), "gain").parameters] == [
        "j1.gain",
        "j2.gain",
    ]


def test_batches_refuse_transmission_errors():
    arm = nominal_arm("ur10")
    driven, _ = drawn(arm, "gain", np.random.default_rng(0))
    for errors in (select_parameters(arm, "base,gain"), select_parameters(driven, "base")):
        with pytest.raises(DhcalError, match=r"gain, harmonics.*one by one"):
            ChainBatch.from_models([errors])


# --- the sidecar -----------------------------------------------------------------------------------


def test_sidecar_preserves_the_robot(tmp_path):
    rng = np.random.default_rng(1)
    arm, x = drawn(
        nominal_arm("ur10"), "minimal,base,tool,gain,harmonics,curves,fine-curves,compliance,coupling", rng
    )
    x = {name: float(value) for name, value in x.items()}
    write_urdf(arm, tmp_path / "out.urdf")
    q = rng.uniform(-2, 2, (20, 6))
    np.testing.assert_allclose(read_robot(tmp_path / "out.urdf", "tool0").poses(q), arm.poses(q), atol=1e-12)
    table = tomllib.loads((tmp_path / "out.calibration.toml").read_text())["joint"]["elbow_joint"]
    assert set(table) == {"gain", "harmonics", "compliance_rad_per_nm", "coupling"}
    assert table["harmonics"] == [
        [k, x[f"elbow_joint.sin{k}"], x[f"elbow_joint.cos{k}"]] for k in range(1, MAX_CURVE_ORDER + 1)
    ]
    text = (tmp_path / "out.calibration.toml").read_text()
    assert f"    [17, {x['elbow_joint.sin17']!r}, {x['elbow_joint.cos17']!r}],\n" in text
    assert table["coupling"]["wrist_1_joint"] == x["elbow_joint.wrist_1_joint"]
    # Seen to another tip, the joints are the same.
    elbow = read_robot(tmp_path / "out.urdf", "forearm_link")
    assert elbow.transmission is not None
    assert elbow.transmission.linear[2, 2] == x["elbow_joint.gain"]
    assert elbow.transmission.harmonics[16, 1, 2] == x["elbow_joint.cos17"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("joint = 1", r"\[joint\]: 1 is not a table"),
        ("[joint.elbow]\ngain = 0.1", "unknown joint 'elbow'.*elbow_joint"),
        ("[joint.elbow_joint]\nsine = 0.1", "unknown key 'sine'.*harmonics"),
        ("[joint.elbow_joint]\ngain = true", "gain = True; expected a finite number"),
        (
            "[joint.elbow_joint]\nsin2_rad = 0.1",
            r"unknown key 'sin2_rad'; write harmonics = \[\[order, sin_rad, cos_rad\], ...\]$",
        ),
        ("[joint.elbow_joint]\nharmonics = 1", r"harmonics = 1; expected a list"),
        ("[joint.elbow_joint]\nharmonics = [[1, nan, 0.0]]", r"entry \[1, nan, 0.0\]; expected \[order"),
        ("[joint.elbow_joint]\nharmonics = [[65, 0.0, 0.0]]", "an order from 1 to 64"),
        ("[joint.elbow_joint]\nharmonics = [[1.0, 0.0, 0.0]]", "an order from 1 to 64"),
        ("[joint.elbow_joint]\nharmonics = [1, 0.0, 0.0]", "entry 1; expected"),
        (
            "[joint.elbow_joint]\nharmonics = [[3, 0.1, 0.0], [3, 0.0, 0.0]]",
            "the order 3 twice; write it once",
        ),
        ("[joint.elbow_joint]\ngain = [1.0]", "expected a finite number"),
        ("[joint]\nelbow_joint = 1", "1 is not a table"),
        (
            "[joint.elbow_joint.coupling]\nelbow_joint = 0.1",
            "is not another joint; choose from shoulder_pan_joint",
        ),
        ("[joint.elbow_joint]\ncoupling = 0.1", r"coupling\]: 0.1 is not a table"),
    ],
)
def test_invalid_joint_table_is_refused(tmp_path, text, words):
    write_urdf(nominal_arm("ur10"), tmp_path / "arm.urdf")
    (tmp_path / "arm.calibration.toml").write_text(text)
    with pytest.raises(DhcalError, match=words) as caught:
        read_robot(tmp_path / "arm.urdf", "tool0")
    assert "arm.calibration.toml" in str(caught.value)


def test_prismatic_joint_has_only_a_gain(tmp_path):
    table = replace(random_table(np.random.default_rng(0), size=2), prismatic=np.array([True, False]))
    write_urdf(Chain.from_dh(table), tmp_path / "arm.urdf")
    (tmp_path / "arm.calibration.toml").write_text("[joint.j1]\nsin_rad = 0.1")
    with pytest.raises(DhcalError, match=r"\(prismatic\): unknown key 'sin_rad'; choose from gain$"):
        read_robot(tmp_path / "arm.urdf")


def test_commands_read_the_sidecar_of_calibrate(tmp_path, monkeypatch, capsys):
    """A drooping arm: calibrated, validated, calibrated again; its root stays where gravity counts on it."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(2)
    plain = nominal_arm("ur10")
    truth, _ = drawn(plain, "tool,compliance", rng)
    write_urdf(plain, "arm.urdf")
    for name in ("one", "two"):
        data = Pose.simulate(truth, rng.uniform(-2, 2, (60, 6)), Noise(1e-6, 1e-6), rng)
        (tmp_path / f"{name}.csv").write_text(measurement_text(data, plain, []))

    def dhcal(*args):
        status = main([*args, "--tip", "tool0"])
        return status, capsys.readouterr().err

    assert dhcal("calibrate", "arm.urdf", "one.csv", "--extend", "none", "-o", "rigid.urdf")[0] == 0
    sets = ("--parameters", "minimal,base,tool,compliance", "--extend", "none")
    assert dhcal("calibrate", "arm.urdf", "one.csv", *sets, "-o", "found.urdf")[0] == 0
    errors = {}
    for robot in ("rigid.urdf", "found.urdf"):
        assert dhcal("validate", robot, "two.csv", "--json", "v.json")[0] == 0
        errors[robot] = json.loads((tmp_path / "v.json").read_text())["after"]["position_rms_m"]
    assert errors["found.urdf"] < 5e-6 < 50e-6 < errors["rigid.urdf"]
    # Calibrated again without the set: its compliance is kept.
    assert dhcal("calibrate", "found.urdf", "two.csv", "-o", "again.urdf")[0] == 0
    first, second = (
        tomllib.loads((tmp_path / f"{n}.calibration.toml").read_text()) for n in ("found", "again")
    )
    assert first["joint"] == second["joint"]
    status, said = dhcal("calibrate", "found.urdf", "two.csv", "-o", "w.urdf", "--world-joint")
    assert status == 2
    assert "--world-joint: not available with errors that depend on gravity" in said
    assert not (tmp_path / "w.urdf").exists()


# --- what simulations give back --------------------------------------------------------------------


# One arm is enough for families with many coefficients.
MANY = ("curves", "fine-curves", "coupling")


@pytest.mark.parametrize(
    ("family", "n_arms"),
    [
        *((family, 1 if family in MANY else 2) for family in FAMILIES),
        *(pytest.param(family, 2, marks=pytest.mark.slow) for family in MANY),
    ],
)
def test_simulated_family_is_recovered(family, n_arms):
    """All coefficients within 3 σ but for those that chance may put beyond, and their spread as claimed."""
    off, arm = [], nominal_arm("ur10")
    for seed in range(n_arms):
        rng = np.random.default_rng(seed)
        truth, x = drawn(arm, f"minimal,base,tool,{family}", rng)
        data = Pose.simulate(truth, random_conditions(arm, 80, rng), Noise(1e-4, 1e-4), rng)
        fit = calibrate(arm, data, f"minimal,base,tool,{family}")
        assert fit.converged
        for p, value, std in zip(fit.parameters, fit.x, fit.std, strict=True):
            if getattr(p, "coefficient_index", None) is not None:
                off.append((value - x[p.name]) / std)
    assert np.sum(np.abs(off) > 3) <= max(1, 0.01 * len(off))
    assert np.abs(off).max() < 4.5
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.4


def test_nominal_values_are_those_of_the_given_robot(tmp_path):
    rng = np.random.default_rng(5)
    arm = Chain.from_dh(paper("sim_6dof"))
    had, x = drawn(arm, "gain", rng)
    data = Pose.simulate(had, rng.uniform(-2, 2, (40, 6)), Noise(1e-6, 1e-6), rng)
    fit = calibrate(had, data, "gain")
    assert [p.nominal for p in fit.errors.parameters] == list(x.values())
    assert np.abs(fit.x).max() < 1e-5


CARRIED = Payload(4.0, (0.02, -0.01, 0.15))


def carried_in_the_file() -> bytes:
    """The UR10 with the payload as a link of its own behind the tip."""
    text = UR10.read_text()
    x, y, z = CARRIED.centre
    more = f"""<link name="held"><inertial><origin xyz="{x} {y} {z}"/><mass value="{CARRIED.mass}"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
      <joint name="hold" type="fixed"><parent link="tool0"/><child link="held"/></joint></robot>"""
    return text.replace("</robot>", more).encode()


def test_payload_has_the_torques_of_a_link_in_the_file():
    q = np.random.default_rng(0).uniform(-2, 2, (6, 20))
    wanted = Chain.from_urdf(parse_urdf(carried_in_the_file(), "held.urdf"), "tool0").loads.torques(q)
    bare, carrying = nominal_arm("ur10"), nominal_arm("ur10").with_payload(CARRIED)
    np.testing.assert_allclose(carrying.loads.torques(q), wanted, atol=1e-10)
    assert np.abs(bare.loads.torques(q) - wanted).max() > 20
    np.testing.assert_array_equal(carrying.poses(q.T), bare.poses(q.T))


def test_compliance_under_a_payload_is_recovered_and_saved(tmp_path, monkeypatch, capsys):
    """Told of the payload, calibrate finds the compliance that the truth has, and the sidecar says so."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.urdf").write_bytes(UR10.read_bytes())
    rng = np.random.default_rng(2)
    truth, x = drawn(nominal_arm("ur10").with_payload(CARRIED), "minimal,compliance", rng)
    for name, m in (("fit", 60), ("other", 30)):
        data = Pose.simulate(truth, rng.uniform(-2, 2, (m, 6)), Noise(1e-5, 1e-5), rng)
        (tmp_path / f"{name}.csv").write_text(measurement_text(data, truth, []))
    common = ["calibrate", "arm.urdf", "fit.csv", "--tip", "tool0", "--parameters", "minimal,compliance"]
    carried = ["--payload", "4kg@20,-10,150mm"]
    assert main([*common, *carried, "-o", "out.urdf", "--json", "r.json"]) == 0
    found = {p["name"]: p for p in json.loads((tmp_path / "r.json").read_text())["parameters"]}
    for name, value in x.items():
        if name.endswith(".compliance"):
            assert abs(found[name]["value"] - value) < 4 * found[name]["std"]
    sidecar = tomllib.loads((tmp_path / "out.calibration.toml").read_text())
    assert sidecar["payload"] == {"mass_kg": 4.0, "centre_m": list(CARRIED.centre)}
    assert main([*common, "-o", "without.urdf"]) == 0

    def judged(robot: str) -> float:
        assert main(["validate", robot, "other.csv", "--tip", "tool0", "--json", "v.json"]) == 0
        return json.loads((tmp_path / "v.json").read_text())["after"]["position_rms_m"]

    assert judged("out.urdf") < 5e-5 < 2 * judged("without.urdf")
    again = read_robot("out.urdf", "tool0")
    assert again.payload == CARRIED
    q = rng.uniform(-2, 2, (5, 6))
    write_urdf(again, "again.urdf")
    np.testing.assert_allclose(read_robot("again.urdf", "tool0").poses(q), again.poses(q), atol=1e-12)
    capsys.readouterr()
    assert main([*common, "--payload", "4lb", "-o", "no.urdf"]) == 2
    assert "as 5kg or 5kg@0,0,80mm" in capsys.readouterr().err
    assert main([*common, "--payload", "0kg", "-o", "no.urdf"]) == 2
    assert "the mass must be positive" in capsys.readouterr().err
    assert not (tmp_path / "no.urdf").exists()


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("mass_kg = -1", "mass_kg = -1; expected a number above 0"),
        ("centre_m = [0.0, 0.0, 0.1]", "mass_kg is missing"),
        ("mass_kg = 2\ncentre_m = [0, 1]", "expected 3 numbers"),
        ("mass_kg = 2\ncentre_m = [0, 0, 150]", "expected 3 numbers up to ±100"),
        ("mass_kg = 2\nmass = 2", "unknown key 'mass'; choose from mass_kg"),
    ],
)
def test_invalid_payload_is_refused(tmp_path, table, words):
    (tmp_path / "arm.urdf").write_bytes(UR10.read_bytes())
    (tmp_path / "arm.calibration.toml").write_text(f"[payload]\n{table}\n")
    with pytest.raises(DhcalError, match=words):
        read_robot(tmp_path / "arm.urdf", "tool0")


def test_only_coefficients_of_sines_and_cosines_have_an_order():
    """Rows of couplings come first, then a sine and a cosine of each order, then the other terms."""
    n = 6
    orders = np.repeat(np.arange(1, MAX_CURVE_ORDER + 1), 2 * n)
    wanted = np.concatenate([np.zeros(n * n), orders])
    found = harmonic_orders(np.arange(n_coefficients(n, n)), n)
    np.testing.assert_array_equal(found[: len(wanted)], wanted)
    assert not found[len(wanted) :].any()


def test_terms_are_those_of_the_given_conditions():
    """They are kept from one call to the next, but not for other positions, temperatures, orders or loads."""
    chain = nominal_arm("ur10")
    transmission, rng = Transmission.zero(chain.loads), np.random.default_rng(0)
    q = rng.uniform(-2, 2, (5, 6))
    first = transmission.terms(Conditions(q))
    assert transmission.terms(Conditions(q.copy())) is first
    changed = [
        (transmission, Conditions(q + 1e-9)),
        (transmission, Conditions(q[:4])),
        (transmission, Conditions(q, temperature=np.full(5, 30.0))),
        (replace(transmission, min_order=3), Conditions(q)),
        (replace(transmission, loads=chain.with_payload(Payload(3.0)).loads), Conditions(q)),
    ]
    for other, conditions in changed:
        found = other.terms(conditions)
        np.testing.assert_array_equal(found, other._terms(conditions))
        assert found.shape != first.shape or np.any(found != first)
    transmission.terms(conditions := Conditions(q))
    q[:, 4] += 0.1
    np.testing.assert_array_equal(transmission.terms(conditions), transmission._terms(conditions))


# --- the parts of a transmission --------------------------------------------------------------------

GRAVITY = 9.81
PENDULUM = """<robot name="r"><link name="base"/>
  <link name="arm"><inertial><origin xyz="0 0 0.4"/><mass value="3"/>
    <inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial></link>
  <joint name="swing" type="TYPE"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-7" upper="7" effort="1" velocity="1"/></joint>
  <link name="tip"/><joint name="end" type="fixed"><parent link="arm"/><child link="tip"/>
    <origin xyz="0 0 0.5"/></joint></robot>"""


@pytest.mark.parametrize("joint_type", ["revolute", "continuous"])
def test_torques_of_a_pendulum(joint_type):
    """The energy of a mass m at the height l·cos q has the slope -m·g·l·sin q."""
    bare = Chain.from_urdf(parse_urdf(PENDULUM.replace("TYPE", joint_type).encode(), "p.urdf"))
    carrying = bare.with_payload(Payload(2.0, (0.0, 0.0, 0.2)))
    angles = np.array([[0.0, 0.5, -1.2, 3.0]])
    unit = -GRAVITY * np.sin(angles)
    payload = np.array([2.0, 0.0, 5.0, 1.0])
    for _ in range(2):
        np.testing.assert_allclose(bare.loads.torques(angles), 3 * 0.4 * unit, atol=1e-12)
        np.testing.assert_allclose(carrying.loads.torques(angles), (1.2 + 1.4) * unit, atol=1e-12)
        # Without a payload in the model, masses are at the tip.
        found = bare.loads.torques(angles, payload)
        np.testing.assert_allclose(found, (1.2 + 0.5 * payload) * unit, atol=1e-12)
        found = carrying.loads.torques(angles, payload)
        np.testing.assert_allclose(found, (1.2 + 0.7 * payload) * unit, atol=1e-12)
        np.testing.assert_allclose(carrying.loads.torques_per_kilogram(angles), 0.7 * unit, atol=1e-12)
    assert Payload(1.0).centre == (0.0, 0.0, 0.0)


def test_few_torques_are_kept(monkeypatch):
    monkeypatch.setattr("dhcal_pin.robot.transmission.MAX_CACHED_TORQUES", 2)
    loads = Chain.from_urdf(parse_urdf(PENDULUM.replace("TYPE", "revolute").encode(), "p.urdf")).loads
    first, second, third = np.arange(12.0).reshape(3, 1, 4)
    kept = loads.torques(first)
    loads.torques(second)
    assert loads.torques(first.copy()) is kept
    wanted = loads.torques(third)
    assert loads.torques(first) is not kept
    assert loads.torques(third) is wanted


def test_each_coefficient_moves_its_joint_or_link_by_its_term():
    """Of all families and orders: a joint by term and joint of the term, a link by a term of the sample."""
    arm, rng = nominal_arm("ur10"), np.random.default_rng(0)
    conditions = random_conditions(arm, 3, rng)
    n, entries = arm.n_joints, np.arange(n_coefficients(6, 6))
    zero = Transmission.zero(arm.loads).evaluating(entries)
    terms = zero.terms(conditions)
    assert len(terms) == 1 + 2 * MAX_CURVE_ORDER + 2 + 1
    for entry, motion, term, joint in zip(entries, *zero.locate(entries), strict=True):
        moved = zero.with_coefficients_added(np.array([entry]), np.array([2.0]))
        assert not moved.is_zero
        wanted, grown = np.zeros((n, 3)), np.zeros((7, 3))
        (wanted if motion < n else grown)[motion - n * (motion >= n)] = 2 * terms[term, joint]
        np.testing.assert_array_equal(moved.errors(terms), wanted)
        np.testing.assert_array_equal(moved.growth(terms), grown)
    assert zero.is_zero
    assert not zero.errors(terms).any()
    # The places and terms of some coefficients, by their meaning.
    parts = coefficient_indices(6, 6)
    terms_of = {
        parts.linear[2, 4]: (2, 0, 4),
        parts.linear[5, 5]: (5, 0, 5),
        parts.harmonics[0, 0, 0]: (0, 1, 0),
        parts.harmonics[6, 1, 3]: (3, 14, 3),
        parts.harmonics[63, 1, 5]: (5, 128, 5),
        parts.joint_terms[0, 1]: (1, 129, 1),
        parts.joint_terms[1, 5]: (5, 130, 5),
        parts.link_terms[0, 0]: (6, 131, 0),
        parts.link_terms[0, 6]: (12, 131, 0),
    }
    found = np.transpose(zero.locate(np.array([*terms_of])))
    np.testing.assert_array_equal(found, [*terms_of.values()])
    # With fewer orders, the terms after the harmonics come earlier.
    few = np.transpose(replace(zero, min_order=2).locate(np.array([*terms_of][5:])))
    np.testing.assert_array_equal(few[:, 1], [5, 6, 7, 7])


def test_terms_are_those_of_the_formula():
    arm, rng = nominal_arm("ur10"), np.random.default_rng(1)
    conditions = random_conditions(arm, 4, rng)
    assert conditions.approach is not None
    assert conditions.temperature is not None
    q = conditions.q.T
    terms = replace(Transmission.zero(arm.loads), min_order=2).terms(conditions)
    torques = arm.loads.torques(q, conditions.payload)
    rise = np.tile(conditions.temperature - arm.reference_temperature, (6, 1))
    wanted = [
        q,
        np.sin(q),
        np.cos(q),
        np.sin(2 * q),
        np.cos(2 * q),
        torques,
        -conditions.approach.T / 2,
        rise,
    ]
    np.testing.assert_allclose(terms, wanted, atol=1e-14)


@pytest.mark.parametrize(
    ("order", "min_order", "wanted"), [(0, 0, 0), (1, 0, 1), (5, 2, 5), (5, 9, 9), (0, 3, 3)]
)
def test_order_is_the_highest_one_in_use(order, min_order, wanted):
    transmission = replace(Transmission.zero(nominal_arm("ur10").loads), min_order=min_order)
    parts = coefficient_indices(6, 6)
    if order:
        transmission.harmonics[order - 1, order % 2, 4] = 1e-3
    assert transmission.order == wanted
    same = transmission.evaluating(parts.harmonics[:wanted].ravel()) if wanted else transmission
    assert same is transmission
    assert transmission.evaluating(parts.harmonics[wanted, 1, :1]).order == wanted + 1
    assert transmission.evaluating(parts.joint_terms.ravel()) is transmission
    assert transmission.evaluating(np.zeros(0, int)) is transmission


def test_compliance_is_the_joint_term_of_gravity():
    transmission, parts = Transmission.zero(nominal_arm("ur10").loads), coefficient_indices(6, 6)
    assert not transmission.has_compliance
    row = [*JOINT_TERMS].index("compliance")
    soft = transmission.with_coefficients_added(parts.joint_terms[row], 1e-4 * np.arange(6))
    np.testing.assert_array_equal(soft.compliance, 1e-4 * np.arange(6))
    assert soft.has_compliance
    other = transmission.with_coefficients_added(parts.joint_terms[1 - row], 1e-4 * np.arange(6))
    assert not other.has_compliance


def test_families_list_their_coefficients_with_name_unit_and_formula():
    arm = Chain.from_dh(replace(random_table(np.random.default_rng(0), size=3), prismatic=np.arange(3) == 1))
    parts = coefficient_indices(3, 3)
    found = {
        name: [each[1:] for each in family.coefficients(arm, parts)] for name, family in FAMILIES.items()
    }
    assert found["gain"] == [(i, "gain", "1", f"q[{i}]") for i in range(3)]
    assert found["harmonics"][:4] == [
        (0, "sin1", "rad", "sin(1 * q[0])"),
        (0, "cos1", "rad", "cos(1 * q[0])"),
        (0, "sin2", "rad", "sin(2 * q[0])"),
        (0, "cos2", "rad", "cos(2 * q[0])"),
    ]
    assert [each[0] for each in found["harmonics"]] == [0, 0, 0, 0, 2, 2, 2, 2]
    for name, first, last in (("curves", 3, 32), ("fine-curves", 33, 64)):
        assert found[name][0] == (0, f"sin{first}", "rad", f"sin({first} * q[0])")
        assert found[name][-1] == (2, f"cos{last}", "rad", f"cos({last} * q[2])")
        assert FAMILIES[name].is_curve
    assert found["coupling"] == [
        (0, "j2", "rad/m", "q[1]"),
        (0, "j3", "rad/rad", "q[2]"),
        (2, "j1", "rad/rad", "q[0]"),
        (2, "j2", "rad/m", "q[1]"),
    ]
    assert found["compliance"] == [(i, "compliance", "rad/Nm", f"torque[{i}]") for i in (0, 2)]
    assert found["backlash"] == [(i, "backlash", "rad", f"-0.5 * approach[{i}]") for i in (0, 2)]
    formula = "temperature - reference_temperature"
    assert found["thermal"] == [(i, "thermal", "1/K", formula) for i in range(4)]
    assert [name for name, family in FAMILIES.items() if family.is_curve] == ["curves", "fine-curves"]
    # Each coefficient is at the place of its part.
    for name, wanted in (
        ("gain", np.diag(parts.linear)),
        ("coupling", parts.linear[[0, 0, 2, 2], [1, 2, 0, 1]]),
        ("harmonics", parts.harmonics[:2, :, [0, 2]].transpose(2, 0, 1).ravel()),
        ("backlash", parts.joint_terms[[*JOINT_TERMS].index("backlash"), [0, 2]]),
        ("thermal", parts.link_terms[0]),
    ):
        assert [each.entry for each in FAMILIES[name].coefficients(arm, parts)] == wanted.tolist()


@pytest.mark.parametrize(("mass", "is_loaded"), [(0.02, False), (0.04, True)])
def test_a_joint_is_compliant_under_a_tenth_of_a_newton_metre(mass, is_loaded):
    """A mass at 0.4 m from the axis: 0.078 and 0.157 Nm."""
    text = PENDULUM.replace("TYPE", "revolute").replace('mass value="3"', f'mass value="{mass}"')
    arm = Chain.from_urdf(parse_urdf(text.encode(), "p.urdf"))
    term = FAMILIES["compliance"].joint_term
    assert term is not None
    np.testing.assert_array_equal(term.has_effect(arm.loads), [is_loaded])


def test_links_longer_than_a_millimetre_grow():
    vectors = np.array([[0, 0, 0], [0.8e-3, 0, 0], [0.8e-3, 0, -0.8e-3], [0, -0.3, 0]])
    np.testing.assert_array_equal(growing_links(vectors), [False, False, True, True])


def test_unknown_conditions_have_no_effect():
    arm = nominal_arm("ur10")
    terms = Transmission.zero(arm.loads).terms(Conditions(np.ones((2, 6))))
    np.testing.assert_array_equal(terms[2:], 0.0)


def test_a_follower_stands_at_its_multiple_and_offset():
    """It turns by 0.1 - 2·q. A mass at 0.2 m from it is 0.3·cos q + 0.2·cos(0.1 - q) high."""
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
    inertial = f'<inertial><origin xyz="0 0 .2"/><mass value="2"/>{inertia}</inertial>'
    text = MIMIC.replace('<link name="b"/>', f'<link name="b">{inertial}</link>')
    loads = Chain.from_urdf(parse_urdf(text.encode(), "mimic.urdf")).loads
    q = np.array([[0.3, -0.7, 1.1]])
    assert loads.n_joints == 1
    np.testing.assert_allclose(loads.configurations(q), np.transpose([q[0], 0.1 - 2 * q[0]]), atol=1e-15)
    wanted = 2 * GRAVITY * (0.2 * np.sin(0.1 - q) - 0.3 * np.sin(q))
    np.testing.assert_allclose(loads.torques(q), wanted, atol=1e-12)


def test_families_are_tried_in_the_order_of_their_stages():
    """Physical causes first, then families that could imitate others, then curves of growing order."""
    stages: dict[int, set[str]] = {}
    for name, family in FAMILIES.items():
        stages.setdefault(family.rule.stage, set()).add(name)
    wanted = [
        {"harmonics", "compliance", "backlash", "thermal"}, {"gain", "coupling"}, {"curves"}, {"fine-curves"}
    ]  # fmt: skip
    assert [names for _, names in sorted(stages.items())] == wanted
    universal = {name for name, family in FAMILIES.items() if family.rule.is_universal}
    assert universal == {"harmonics", "compliance"}
    # Universal families need no improvement; all others have to improve the error by a part of it.
    needed = {name: family.rule.min_improvement for name, family in FAMILIES.items()}
    assert {name for name, improvement in needed.items() if improvement == 0.0} == universal
    assert max(needed.values()) < 1.0
    assert {name: family.condition for name, family in FAMILIES.items() if family.condition} == {
        "backlash": "approach",
        "thermal": "temperature",
    }


def test_terms_that_were_used_last_are_kept(monkeypatch):
    monkeypatch.setattr("dhcal_pin.robot.transmission._MAX_CACHED_TERMS", 2)
    transmission = Transmission.zero(nominal_arm("ur10").loads)
    first, second, third = (Conditions(np.full((2, 6), value)) for value in (0.1, 0.2, 0.3))
    kept = [transmission.terms(each) for each in (first, second)]
    assert transmission.terms(first) is kept[0]
    newest = transmission.terms(third)
    assert transmission.terms(first) is kept[0]
    assert transmission.terms(third) is newest
    assert transmission.terms(second) is not kept[1]
