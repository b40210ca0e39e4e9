"""Inclinations of a sensor on any link: derivatives, what they identify, and files.

Measurements are simulated with the link poses of Pinocchio, which has kinematics of its own.
"""

import numpy as np
import pytest
from robots import URDF, pinocchio_poses, with_masses, write

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin._kernels import factor_jacobian
from dhcal_pin._kernels.qr import factor_jacobian as numpy_factor_jacobian
from dhcal_pin.estimation import Problem, select_parameters
from dhcal_pin.estimation import problem as problem_module
from dhcal_pin.estimation.batch.solver import BatchProblem
from dhcal_pin.estimation.problem import linearize_and_factor
from dhcal_pin.io import measurement_text, read_measurements
from dhcal_pin.measurements.base import whitened_jacobian

pytestmark = pytest.mark.usefixtures("unsuspected")

NOISE = 1e-4
LEVEL = dh.Noise(1e-4, NOISE)
SENSOR = se3.exp3([0.3, -0.2, 0.4])
UR10_LINKS = [
    "shoulder_link",
    "upper_arm_link",
    "forearm_link",
    "wrist_1_link",
    "wrist_2_link",
    "wrist_3_link",
]


def accelerations(chain, q, link, up, rng=None):
    """Return what an accelerometer on a link sees, in g; `up` is a direction in the measuring frame."""
    rotations = chain.base[:3, :3] @ pinocchio_poses(chain, q, link or chain.tip)[:, :3, :3] @ SENSOR
    return np.asarray(up) @ rotations + (NOISE * rng.standard_normal((len(q), 3)) if rng else 0.0)


def inclinations(chain, q, link, rng, up=(0, 0, 1)):
    return dh.Inclination.from_acceleration(q, accelerations(chain, q, link, up, rng), NOISE, link)


# ------------------------------------------------------------------------------------------- links of a chain
@pytest.mark.parametrize(("robot", "tip", "root"), [
    ("example:ur10", "tool0", None),
    ("example:talos_full_v2", "gripper_left_base_link", "head_2_link"),
    ("example:talos_full_v2", "head_2_link", "gripper_left_base_link"),
])  # fmt: skip
def test_links_lie_where_pinocchio_has_them(robot, tip, root):
    chain = dh.Chain.from_urdf(dh.Chain.from_urdf(robot, tip).urdf, tip, root)
    q = np.random.default_rng(0).uniform(-1, 1, (5, chain.n_joints))
    bodies = chain.forward_kinematics(q).bodies
    found = set()
    for link in chain.urdf.links:
        try:
            body, pose = chain.link_in_body(link)
        except dh.DhcalError:
            continue
        found.add(body)
        frames = np.zeros((5, 4, 4))
        frames[:, :3], frames[:, 3, 3] = bodies[body].transpose(2, 1, 0), 1.0
        np.testing.assert_allclose(frames @ pose, pinocchio_poses(chain, q, link), atol=1e-12)
    assert found == set(range(1, len(chain.moving_joints) + 1))


# ---------------------------------------------------------------------------------------------- derivatives
def check_derivatives(chain, link, sets, seed):
    """Compare the derivatives with central differences, in radians per unit of the unknowns."""
    rng, h = np.random.default_rng(seed), 1e-5
    errors = select_parameters(chain, sets)
    scale = np.array([1e-3 if p.unit == "rad/Nm" else 2e-2 for p in errors.parameters])
    x = scale * rng.normal(size=len(errors.parameters))
    q, u = rng.uniform(-2, 2, (7, chain.n_joints)), rng.uniform(-1, 1, 5)
    model = errors.derivative(x)
    frames = model[0].forward_kinematics(q)
    level = dh.Inclination(q, np.zeros((7, 2)), 1.0, link).mounted(chain)
    # Measured directions near the modelled ones, and far away.
    axes = rng.normal(size=(7, 3))
    turns = axes * (np.array([0, 1e-4, 1e-2, 0.1, 1, 2, 2.5]) / np.linalg.norm(axes, axis=1))[:, None]
    seen = (se3.exp3(turns) @ level._model(frames, u)[0].T[..., None])[..., 0]
    data = dh.Inclination.from_acceleration(q, seen, 1.0, link).mounted(chain)
    residual = data.residual(frames, u)
    own = data.instrument_jacobian(frames, u)
    rows = whitened_jacobian(data, model, frames, u, residual)

    def check(row, change, name):
        size = max(1.0, np.abs(row).max())
        up, down = change(h / size), change(-h / size)
        np.testing.assert_allclose(row / size, -(up - down) / (2 * h), atol=1e-7, err_msg=name)

    for k, parameter in enumerate(errors.parameters):
        unit = np.eye(len(x))[k]
        check(
            rows[k],
            lambda step, unit=unit: data.residual(errors.at(x + step * unit).forward_kinematics(q), u),
            parameter.name,
        )
    for k, parameter in enumerate(data.instrument_parameters):
        unit = np.eye(5)[k]
        check(own[k], lambda step, unit=unit: data.residual(frames, u + step * unit), parameter.name)
    return errors, data, rows, np.concatenate([x, u])


SETS = "placement,dh,base,tool,offset,gain,harmonics,compliance,coupling"


@pytest.mark.parametrize("link", [*UR10_LINKS, ""])
def test_derivatives_equal_central_differences_on_every_link(ur10, link):
    """With errors of all families; those behind the link have none."""
    chain = with_masses(ur10, np.random.default_rng(1))
    errors, data, rows, _ = check_derivatives(chain, link, SETS, seed=2)
    behind = np.array([2 * data.body < p.error_frame for p in errors.parameters])
    behind &= [p.coefficient_index is None or p.error_frame > 2 * data.body + 1 for p in errors.parameters]
    geometric_at_link = [
        p.coefficient_index is None and p.error_frame == 2 * data.body + 1 for p in errors.parameters
    ]
    assert np.any(behind)
    assert not rows[behind].any()
    assert not rows[geometric_at_link].any()
    before = [p.unit == "rad" and 0 < p.error_frame < 2 * data.body for p in errors.parameters]
    assert np.abs(rows[before]).max(initial=1.0) > 0.1


@pytest.mark.parametrize("link", ["link_1", "link_2", "link_3", ""])
def test_mimic_joints_before_the_link_alone_move_it(mimicking, link):
    """One column may move a joint before the sensor and another one behind it."""
    links = [joint.child for joint in mimicking.urdf.joints if joint.type != "fixed"]
    check_derivatives(
        mimicking, links[int(link[-1]) - 1] if link else "", "placement,gain,harmonics,coupling", 3
    )


def test_links_of_a_reversed_chain_are_differentiated():
    urdf = dh.Chain.from_urdf("example:talos_full_v2", "gripper_left_base_link").urdf
    chain = dh.Chain.from_urdf(urdf, "gripper_left_base_link", "head_2_link")
    for link in ("head_1_link", "torso_2_link", "arm_left_4_link"):
        check_derivatives(chain, link, "placement,base,gain", 4)


@pytest.mark.parametrize("kernel", [factor_jacobian, numpy_factor_jacobian])
@pytest.mark.parametrize("link", ["upper_arm_link", "wrist_2_link", ""])
def test_r_factor_equals_that_of_the_rows(ur10, link, kernel, monkeypatch):
    """The kernels that never store the rows observe the same body; transmission columns included."""
    monkeypatch.setattr(problem_module, "factor_jacobian", kernel)
    errors, data, _, values = check_derivatives(ur10, link, "minimal,base,gain,harmonics", seed=5)
    nominal = np.array([p.nominal for p in data.instrument_parameters])
    at = np.concatenate([values[:-5], values[-5:] - nominal])
    problem = Problem(errors, (data,), np.zeros(len(at)))
    (chunk,) = problem.chunks
    rows = problem.linearize(at).rows(chunk).reshape(len(at) + 1, -1)
    found = linearize_and_factor(problem, at, small_angle=False)
    np.testing.assert_allclose(found.r.T @ found.r, rows[:-1] @ rows[:-1].T, atol=1e-10)
    structured = problem.linearize(at).structured_rows(chunk).products()
    np.testing.assert_allclose(structured, rows @ rows.T, atol=1e-10)


# ------------------------------------------------------------------------------------------------ convention
def test_roll_and_pitch_are_those_of_the_acceleration():
    """By hand, and by the rotation Ry(pitch)·Rx(roll) of the sensor."""
    angles = np.deg2rad([[0, 0], [90, 0], [0, 90], [-90, 0], [180, 0], [30, 20]])
    seen = [*np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1]])]
    roll, pitch = angles[5]
    seen.append((se3.exp3([0, pitch, 0]) @ se3.exp3([roll, 0, 0])).T @ [0, 0, 1])
    found = dh.Inclination.from_acceleration(np.zeros((6, 6)), 9.81 * np.array(seen)).angles
    assert np.abs(np.angle(np.exp(1j * (found - angles)))).max() < 1e-12


def test_gross_mistakes_are_outliers(ur10):
    """Rows that were exchanged have the weight zero."""
    rng = np.random.default_rng(0)
    data = inclinations(ur10, rng.uniform(-2, 2, (60, 6)), "", rng)
    angles = data.angles.copy()
    angles[[5, 20, 40]] = angles[[20, 40, 5]]
    fit = dh.calibrate(ur10, dh.Inclination(data.q, angles, NOISE), "minimal", extend="none")
    assert np.flatnonzero(fit.weights[0] < 0.01).tolist() == [5, 20, 40]
    assert fit.validate(data)["residual_rms"] < 2 * NOISE


def test_residual_is_the_angle_between_the_directions(ur10):
    rng = np.random.default_rng(0)
    q = rng.uniform(-2, 2, (50, 6))
    angles = rng.uniform([-3, -1.5], [3, 1.5], (50, 2))
    data, u = dh.Inclination(q, angles).mounted(ur10), np.array([*se3.log3(SENSOR), 0, 0])
    residual = data.errors(ur10.forward_kinematics(q), u)["inclination"]
    seen = accelerations(ur10, q, "", [0, 0, 1])
    (sin_r, sin_p), (cos_r, cos_p) = np.sin(angles.T), np.cos(angles.T)
    cosines = np.sum(seen * np.stack([-sin_p, sin_r * cos_p, cos_r * cos_p], 1), 1)
    np.testing.assert_allclose(np.linalg.norm(residual, axis=1), np.arccos(cosines), atol=1e-9)


def test_standard_deviations_of_accelerations_become_those_of_the_direction():
    """Against the spread of simulated angles, near level, where roll and pitch are components."""
    rng = np.random.default_rng(0)
    sigma = np.array([0.01, 0.03, 0.02])
    seen = np.array([0.02, -0.01, 9.8]) + sigma * rng.standard_normal((4000, 3))
    data = dh.Inclination.from_acceleration(np.zeros((4000, 1)), seen, sigma)
    np.testing.assert_allclose(data.angles.std(0), data.sigma[0], rtol=0.05)


@pytest.mark.parametrize("turn", [[0, 0, 0], [0.3, 0.2, 0], [np.pi / 2, 0, 0], [0, -2, 0.5], [np.pi, 0, 0]])
@pytest.mark.parametrize("link", ["", "forearm_link"])
def test_sensor_and_gravity_are_found_in_any_measuring_frame(ur10, link, turn):
    """Robots on walls and ceilings, and trackers that are not level.

    The forearm turns about two axes only, so that up and down can be exchanged if one of them is vertical.
    """
    rng = np.random.default_rng(0)
    up = se3.exp3(turn) @ [0, 0, 1]
    data = inclinations(ur10, rng.uniform(-2, 2, (40, 6)), link, rng, up).initialized(ur10)
    u = np.array([p.nominal for p in data.instrument_parameters])
    residual = data.residual(ur10.forward_kinematics(data.q), u)
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(1, abs=0.2)
    if not link:
        np.testing.assert_allclose(data._model(ur10.forward_kinematics(data.q), u)[2], up, atol=3e-4)
    fit = dh.calibrate(ur10, data, "minimal", extend="none")
    other = inclinations(ur10, rng.uniform(-2, 2, (40, 6)), link, rng, up)
    # Two components, 40 samples for 16 observable unknowns.
    assert fit.validate(other)["residual_rms"] < 2 * NOISE


# ------------------------------------------------------------------------------------------- identification
def identified(chain, link, m, seed):
    """Return errors of the identified parameters in standard deviations by name, and the fit."""
    errors = select_parameters(chain, "minimal")
    rng = np.random.default_rng(seed)
    scale = np.array([3e-3 if p.unit == "rad" else 1e-3 for p in errors.parameters])
    x = scale * rng.normal(size=len(scale))
    data = inclinations(errors.at(x), rng.uniform(-2.5, 2.5, (m, 6)), link, rng)
    fit = dh.calibrate(chain, data, "minimal", priors="none", loss="linear")
    found = {
        p.name: (fit.x[i] - x[i]) / fit.std[i] for i, p in enumerate(errors.parameters) if fit.std[i] < 1e-4
    }
    assert (
        np.abs([value for p, value in zip(fit.parameters, fit.x, strict=False) if p.unit == "m"]).max() < 1e-9
    )
    return found, fit


def test_inclinations_alone_identify_all_joint_directions_but_those_about_gravity(ur10):
    """Over 20 robots, with errors as large as the standard deviations.

    The first axis is along gravity: `shoulder_lift_joint.rx` turns the robot about it, and the tilt of
    `shoulder_pan_joint` is that of gravity.
    """
    joints = ("elbow_joint.rx", "elbow_joint.rz", "wrist_1_joint.rx", "wrist_1_joint.rz", "wrist_2_joint.rx",
              "wrist_2_joint.ry", "wrist_3_joint.rx", "wrist_3_joint.rz")  # fmt: skip
    ratios = []
    for seed in range(20):
        found, fit = identified(ur10, "", 60, seed)
        assert found.keys() == {"shoulder_lift_joint.rz", *joints}
        # Beside these, sensor and gravity.
        assert fit.rank == len(found) + 5
        ratios.append(list(found.values()))
    square = np.mean(np.square(ratios))
    print(f"mean square of 180 errors in standard deviations: {square:.2f}")
    assert 0.75 < square < 1.3


def test_an_inner_sensor_identifies_the_joints_before_it(ur10):
    """The sensor on the fourth link sees nothing of the joints 5 and 6."""
    found, _ = identified(ur10, "wrist_1_link", 100, 0)
    joints = ("elbow_joint.rx", "elbow_joint.rz", "wrist_1_joint.rx", "wrist_1_joint.rz")
    assert found.keys() == {"shoulder_lift_joint.rz", *joints}
    assert np.abs(list(found.values())).max() < 4


def test_explanations_name_lengths_gravity_and_links_behind_the_sensor(ur10):
    rng = np.random.default_rng(0)
    q = rng.uniform(-2, 2, (60, 6))
    alone = dh.calibrate(ur10, inclinations(ur10, q, "forearm_link", rng), "minimal", extend="none")

    def sentence(fit, name):
        (found,) = [text for text in fit.unobservable if name in text.split(":")[0]]
        return found

    assert "only angles are measured" in sentence(alone, "elbow_joint.x")
    assert "turns the tool about gravity" in sentence(alone, "shoulder_lift_joint.rx")
    assert "links are before this part of the robot" in sentence(alone, "wrist_2_joint.rx")
    assert all("measure the po" in text for text in alone.unobservable)
    assert not any("distance between contact" in text for text in alone.unobservable)
    whole = dh.calibrate(ur10, inclinations(ur10, q, "", rng), "minimal,base,tool", extend="none")
    together = sentence(whole, "up.x")
    assert "base.rx" in together
    assert "the robot and the instrument can move together" in together
    assert "when the whole robot moves in this way" in sentence(whole, "and base.rz")
    positions = dh.Position.simulate(ur10, q[:30], LEVEL, rng)
    both = dh.calibrate(ur10, [positions, inclinations(ur10, q, "", rng)], "minimal,base,tool", extend="none")
    assert [text for text in both.unobservable if not text.startswith("Expected")] == [
        sentence(both, "tool.rx")
    ]
    # In a level measuring frame, the tilt of the base is estimated.
    level = {"up.x": 0.0, "up.y": 0.0}
    tilted = dh.calibrate(ur10, inclinations(ur10, q, "", rng), "base", known=level)
    assert not any("base.rx" in text for text in tilted.unobservable)


@pytest.mark.parametrize("links", [("",), ("wrist_1_link", "")])
def test_inclinations_improve_an_arm_with_few_positions(ur10, links):
    """12 positions by a tracker that is not level; the error is that of 100 other positions."""
    errors = select_parameters(ur10, "minimal")
    std = np.array([3e-3 if parameter.unit == "rad" else 1e-3 for parameter in errors.parameters])
    base = se3.transform(se3.exp3([0.5, -0.4, 1.0]), np.array([2.0, -1.0, 0.5]))
    up = base[:3, :3] @ se3.exp3([0.01, -0.02, 0]) @ [0, 0, 1]
    ratios = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        truth = errors.at(std * rng.standard_normal(len(std))).with_base_and_tool(base, ur10.tool)
        q = rng.uniform(-2, 2, (172, 6))
        positions = dh.Position.simulate(truth, q[:12], LEVEL, rng)
        angles = [inclinations(truth, q[12:72], link, rng, up) for link in links]
        test = dh.Position.simulate(truth, q[72:], dh.Noise(), rng)
        alone, both = (
            dh.calibrate(ur10, data, "minimal,base,tool", extend="none")
            for data in ([positions], [positions, *angles])
        )
        ratios.append(both.validate(test)["position_rms_m"] / alone.validate(test)["position_rms_m"])
    print(f"error with inclinations over error without: {np.round(ratios, 2)}")
    assert max(ratios) < 1
    assert np.median(ratios) < 0.8


def test_rows_of_a_batch_are_those_of_single_problems(sim_6dof):
    """Batches of chains observe the same body."""
    errors = select_parameters(sim_6dof, "dh")
    rng = np.random.default_rng(0)
    link = [joint.child for joint in sim_6dof.urdf.joints if joint.type != "fixed"][3]
    data = inclinations(sim_6dof, rng.uniform(-2, 2, (30, 6)), link, rng).initialized(sim_6dof)
    known = {p.name: p.nominal for p in data.instrument_parameters}
    batch = BatchProblem.from_models([errors] * 2, [[data]] * 2, np.zeros(24), known)
    x = 1e-2 * rng.normal(size=(2, 24))
    found = batch.linearize_and_factor(x, np.zeros(24), small_angle=False)
    for i in range(2):
        wanted = linearize_and_factor(Problem(errors, (data,), np.zeros(24), known), x[i], small_angle=False)
        np.testing.assert_allclose(found.r[i].T @ found.r[i], wanted.r.T @ wanted.r, atol=1e-3, rtol=1e-9)


# ----------------------------------------------------------------------------------------------------- files
def read(tmp_path, chain, header, *rows, joints=None):
    names = joints or ",".join(f"{name}[deg]" for name in chain.joint_names)
    lines = [",".join(["10"] * chain.n_joints) + "," + row for row in rows]
    return read_measurements(write(tmp_path, "a.csv", "\n".join([f"{names},{header}", *lines])), chain)


def test_files_have_angles_or_accelerations_and_a_link(ur10, tmp_path):
    angles = read(tmp_path, ur10, "roll[deg],pitch[deg],link", "30,20,forearm_link")
    vector = se3.exp3(np.deg2rad([30, 0, 0])).T @ se3.exp3(np.deg2rad([0, 20, 0])).T @ [0, 0, 1]
    for unit, factor in (("g", 1.0), ("m/s2", 9.80665), ("mg", 1e3)):
        header = f"ax[{unit}],ay[{unit}],az[{unit}],sigma_ax[mg],sigma_ay[mg],sigma_az[mg],link"
        row = ",".join(map(str, factor * vector)) + ",1,1,1,forearm_link"
        other = read(tmp_path, ur10, header, row)
        np.testing.assert_allclose(other.angles, angles.angles, atol=1e-12)
        np.testing.assert_allclose(other.sigma, 1e-3, rtol=1e-12)
    assert (other.link, other.body, angles.body) == ("forearm_link", 3, 3)
    again = read_measurements(write(tmp_path, "b.csv", measurement_text(other, ur10)), ur10)
    np.testing.assert_allclose(again.angles, other.angles, atol=1e-14)
    assert again.body == 3


@pytest.mark.parametrize(("header", "row", "message"), [
    ("roll[deg],pitch[deg]", "190,0", r"a\.csv:2: roll is 190 deg; expected -180 to 180 deg"),
    ("roll[deg],pitch[deg]", "0,-91", r"a\.csv:2: pitch is -91 deg; expected -90 to 90 deg"),
    ("roll[deg]", "1", r"a\.csv:1: .*roll alone is not enough; kind inclination needs pitch, too"),
    ("ax[g],az[g]", "1,1", r"a\.csv:1: .*ax, az alone is not enough; kind inclination needs ay, too"),
    ("ax,ay,az", "0,0,1", r"a\.csv:1: column 'ax' has no unit; write one of ax\[m/s2\], ax\[g\]"),
    ("ax[mm],ay[g],az[g]", "0,0,1", r"a\.csv:1: column 'ax' has unit 'mm'; write one of ax\[m/s2\]"),
    ("ax[g],ay[g],az[g]", "0,0,0", r"a\.csv:2: the acceleration is zero"),
    ("roll[deg],pitch[deg],ax[g],ay[g],az[g]", "0,0,0,0,1", "either roll and pitch, or ax"),
    ("roll[deg],pitch[deg],sigma_roll[deg]", "0,0,1", "sigma_roll without 'sigma_pitch'"),
    ("roll[deg],pitch[deg],link", "0,0,forearm", r"unknown link 'forearm'; did you mean 'forearm_link'\?"),
    ("roll[deg],pitch[deg],link", "0,0,base_link", "'base_link' is not on the chain.*behind its first joint"),
    ("roll[deg],pitch[deg],link", "0,0,", r"a\.csv:2: column 'link' is empty"),
    ("roll[deg],pitch[deg],x[mm],y[mm],z[mm]", "0,0,1,1,1", "'pitch' does not go with x, y, z"),
])  # fmt: skip
def test_wrong_files_are_refused_in_one_line(ur10, tmp_path, header, row, message):
    with pytest.raises(dh.DhcalError, match=message) as caught:
        read(tmp_path, ur10, header, row)
    assert "\n" not in str(caught.value)


def test_one_file_has_one_link(ur10, tmp_path):
    with pytest.raises(dh.DhcalError, match=r"'link' has the names forearm_link, tool0.*split the file"):
        read(tmp_path, ur10, "roll[deg],pitch[deg],link", "0,0,forearm_link", "0,0,tool0")


def test_a_column_that_names_a_joint_belongs_to_the_joint(tmp_path):
    """The shipped flange has joints called roll and pitch."""
    flange = dh.Chain.from_urdf(URDF / "flange.urdf")
    joints = "slide_x[mm],slide_y[mm],slide_z[mm],yaw[deg],pitch[deg],roll[deg]"
    assert isinstance(read(tmp_path, flange, "x[mm],y[mm],z[mm]", "1,2,3", joints=joints), dh.Position)
    assert read(tmp_path, flange, "x[mm]", "1", joints=joints).kind == "axes"
    data = read(tmp_path, flange, "ax[g],ay[g],az[g]", "0,1,1", joints=joints)
    assert data.kind == "inclination"
    np.testing.assert_allclose(np.rad2deg(data.angles), [[45, 0]])
    np.testing.assert_allclose(np.rad2deg(data.q[0, 3:]), 10)
    with pytest.raises(dh.DhcalError, match=r"'pitch' appears twice.*write the measured values as ax,ay,az"):
        read(tmp_path, flange, "roll[deg],pitch[deg]", "1,2", joints=joints)
    with pytest.raises(dh.DhcalError, match="no measured values"):
        read(tmp_path, flange, "time", "1", joints=joints)
    with pytest.raises(dh.DhcalError, match="joint 'pitch' has the name of a column of kind inclination"):
        measurement_text(data, flange)


def test_a_joint_off_the_chain_keeps_its_column(tmp_path):
    """A camera head beside the arm, with joints called roll and pitch."""
    flange = dh.Chain.from_urdf(URDF / "flange.urdf", tip="yaw_link")
    joints = "slide_x[mm],slide_y[mm],slide_z[mm],yaw[deg]"
    data = read(tmp_path, flange, "pitch[deg],roll[deg],x[mm],y[mm],z[mm]", "5,6,1,2,3", joints=joints)
    assert isinstance(data, dh.Position)


def test_wrong_arrays_are_refused():
    q = np.zeros((4, 6))
    with pytest.raises(dh.DhcalError, match="Inclination: angles"):
        dh.Inclination(q, np.zeros((4, 3)))
    with pytest.raises(dh.DhcalError, match="sample 2: pitch is 100 deg"):
        dh.Inclination(q, np.deg2rad([[0, 0], [0, 100], [0, 0], [0, 0]]))
    with pytest.raises(dh.DhcalError, match="sample 1: the acceleration is zero"):
        dh.Inclination.from_acceleration(q, np.zeros((4, 3)))
    chain = dh.Chain.from_dh(dh.read_dh(URDF / "sim_6dof.dh.toml"))
    with pytest.raises(dh.DhcalError, match="unknown link 'nowhere'"):
        dh.calibrate(chain, dh.Inclination(q, np.zeros((4, 2)), link="nowhere"))
