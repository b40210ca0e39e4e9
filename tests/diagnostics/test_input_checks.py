"""Doubts about a file: what brings each up, and what must not."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from robots import URDF, paper, robot_file
from scipy.spatial.transform import Rotation

from dhcal_pin import se3
from dhcal_pin.cli import main
from dhcal_pin.diagnostics.input_checks import find_input_warnings
from dhcal_pin.io.measurement_csv import measurement_text, read_measurement_file
from dhcal_pin.measurements import KINDS
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.length import Wires
from dhcal_pin.measurements.position import Position
from dhcal_pin.robot.chain import Chain, joint_frame
from dhcal_pin.robot.inverse_kinematics import wrap_into_limits


@pytest.fixture(scope="module")
def ur10():
    return Chain.from_urdf(robot_file("ur_description/urdf/ur10_robot.urdf"), "tool0")


@pytest.fixture
def told(tmp_path):
    def call(chain, text):
        path = tmp_path / "data.csv"
        path.write_text(text)
        return find_input_warnings(chain, read_measurement_file(path, chain))

    return call


def joints(chain, m=30, seed=0):
    return np.random.default_rng(seed).uniform(-2.5, 2.5, (m, chain.n_joints))


def frames():
    """An instrument three metres away, and a reflector at arm's length."""
    return se3.exp6(np.array([3.0, -1, 1, 0.4, 1, -2])), se3.exp6(np.array([0.1, 0.05, 0.2, 1, 1, 0]))


def sheet(chain, q, *, joint="rad", length="mm", kind="pose", angle="rad", wrong=None):
    """A file with the units that a header declares; wrong = {"joint" | "length" | "angle": true unit}."""
    factor = {"rad": 1.0, "deg": 180 / np.pi, "m": 1.0, "mm": 1e3}
    true = {"joint": joint, "length": length, "angle": angle} | (wrong or {})
    base, tool = frames()
    poses = base @ chain.poses(q) @ tool
    header = [f"{name}[{joint}]" for name in chain.joint_names] + [f"{axis}[{length}]" for axis in "xyz"]
    columns = [factor[true["joint"]] * q, factor[true["length"]] * poses[:, :3, 3]]
    if kind == "pose":
        header += [f"{axis}[{angle}]" for axis in ("rx", "ry", "rz")]
        columns.append(factor[true["angle"]] * se3.log3(poses[:, :3, :3]))
    rows = np.concatenate(columns, 1).tolist()
    return "\n".join([",".join(header), *(",".join(map(repr, row)) for row in rows)]) + "\n"


@pytest.mark.parametrize("kind", ["pose", "position"])
@pytest.mark.parametrize("joint", ["rad", "deg"])
@pytest.mark.parametrize("length", ["m", "mm"])
def test_right_units_bring_up_nothing(told, ur10, kind, joint, length):
    for m in (1, 2, 3, 30):
        assert told(ur10, sheet(ur10, joints(ur10, m), joint=joint, length=length, kind=kind)) == []


@pytest.mark.parametrize("kind", ["pose", "position"])
@pytest.mark.parametrize(
    ("units", "word"),
    [
        ({"joint": ("rad", "deg")}, "if the values are degrees, write [deg]"),
        ({"joint": ("deg", "rad")}, "if the values are radians, write [rad]"),
        ({"length": ("m", "mm")}, "if they are millimetres, write x[mm]"),
        ({"length": ("mm", "m")}, "if they are metres, write x[m]"),
    ],
)
def test_a_wrong_unit_is_told_once(told, ur10, kind, units, word):
    said = {name: pair[0] for name, pair in units.items()}
    wrong = {name: pair[1] for name, pair in units.items()}
    found = told(ur10, sheet(ur10, joints(ur10), kind=kind, wrong=wrong, **said))
    assert len([text for text in found if word in text]) == len(found) > 0
    assert len(found) <= (6 if word.startswith("if the values are degrees") else 1)


@pytest.mark.parametrize(
    ("said", "true", "word"),
    [("rad", "deg", "more than a turn"), ("deg", "rad", "rotations differ from this robot by")],
)
def test_rotation_vectors_in_the_wrong_unit(told, ur10, said, true, word):
    (text,) = told(ur10, sheet(ur10, joints(ur10), angle=said, wrong={"angle": true}))
    assert word in text


def test_euler_angles_are_no_rotation_vector(told, ur10):
    base, tool = frames()
    q = joints(ur10)
    poses = base @ ur10.poses(q) @ tool

    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("XYZ")
    text = sheet(ur10, q)
    lines = text.splitlines()
    rows = [
        ",".join([*line.split(",")[:9], *map(repr, row)])
        for line, row in zip(lines[1:], angles.tolist(), strict=True)
    ]
    (found,) = told(ur10, "\n".join([lines[0], *rows]))
    assert "axes and frame of Euler angles" in found


def test_matrices_by_columns_are_told(told, ur10):
    """The inverse rotation turns from row to row by the same angles."""
    q = joints(ur10)
    base, tool = frames()
    turned = se3.log3((base @ ur10.poses(q) @ tool)[:, :3, :3])
    lines = sheet(ur10, q).splitlines()
    rows = [
        ",".join([*line.split(",")[:9], *map(repr, row)])
        for line, row in zip(lines[1:], (-turned).tolist(), strict=True)
    ]
    (found,) = told(ur10, "\n".join([lines[0], *rows]))
    assert "rows of a matrix" in found


@pytest.mark.parametrize("moving", [[0], [5], [0, 5], [0, 1, 2, 5]])
def test_few_moving_joints_are_believed(told, ur10, moving):
    """Motions that leave base or target open turn as the joints do in some frames."""
    for seed in range(3):
        q = np.full((30, 6), 0.4)
        q[:, moving] = joints(ur10, 30, seed)[:, moving]
        assert told(real_ur10(), sheet(real_ur10(), q)) == []


def test_small_motions_are_believed(told, ur10):
    q = np.deg2rad(np.random.default_rng(0).uniform(-5, 5, (30, 6)))
    assert told(ur10, sheet(ur10, q, joint="deg")) == []


def test_one_gross_error_is_no_wrong_unit(told, ur10):
    lines = sheet(ur10, joints(ur10), kind="position").splitlines()
    cells = lines[5].split(",")
    lines[5] = ",".join([*cells[:6], "900000", *cells[7:]])
    assert told(ur10, "\n".join(lines)) == []


def test_a_tool_point_that_stays_is_believed(told, ur10):
    """The tip moves about a fixed point that the instrument reads: no metres in a column of mm."""
    data = KINDS["point"].simulate(ur10, joints(ur10), Noise(), np.random.default_rng(0))
    data = data.take(data.label == 0)
    seen = ur10.poses(data.q)[:, :3, 3] + 1e-5 * np.random.default_rng(0).normal(size=(len(data.q), 3))
    assert told(ur10, measurement_text(Position(data.q, seen), ur10)) == []


@pytest.mark.parametrize(
    ("header", "value", "word"),
    [
        ("length[m]", 1500, "length is 1500 m"),
        ("length[mm]", 1.5, "write length[m]"),
        ("length[mm]", 1500, ""),
        ("plane,sigma_plane[m]", "a,0.1", "sigma_plane is 0.1 m"),
        ("plane,sigma_plane[mm]", "a,0.1", ""),
        ("sphere,radius[m]", "a,150", "radius is 150 m"),
        ("sphere,radius[mm]", "a,150", ""),
    ],
)
def test_lengths_and_sigmas(told, ur10, header, value, word):
    names = ",".join(f"{name}[rad]" for name in ur10.joint_names)
    rows = [f"{','.join(map(repr, row))},{value}" for row in joints(ur10, 4).tolist()]
    found = told(ur10, "\n".join([f"{names},{header}", *rows]))
    assert [word in text for text in found] == ([True] if word else [])


@pytest.mark.parametrize(
    ("unit", "value", "word"),
    [("m", 50, "distance is 50 m"), ("mm", 0.05, "write distance[m]"), ("mm", 50, "")],
)
def test_known_distances(told, ur10, unit, value, word):
    found = told(ur10, f"point_a,point_b,distance[{unit}]\na,b,{value}\n")
    assert [word in text for text in found] == ([True] if word else [])


def test_joints_beyond_their_limits(told, ur10):
    q = joints(ur10)
    q[[3, 7], 2] = [3.3, -3.15]
    q[11, 2] = np.pi + 1e-5
    (text,) = told(ur10, sheet(ur10, q))
    assert "joint elbow_joint is beyond its limits, -3.142 rad to 3.142 rad, in rows 4, 8;" in text


def swapped(i, j):
    order = np.arange(6)
    order[[i, j]] = j, i
    return lambda q: q[:, order]


def off(j, degrees):
    return lambda q: q + np.deg2rad(degrees) * (np.arange(6) == j)


def flipped(j):
    return lambda q: q * np.where(np.arange(6) == j, -1, 1)


MISTAKES = [
    *((flipped(j), f"the opposite sign of joint {name}_joint") for j, name in enumerate(
        ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))),
    (off(1, 90), "with -90 deg added to joint shoulder_lift_joint; check its zero"),
    (off(4, -90), "with 90 deg added to joint wrist_2_joint; check its zero"),
    (swapped(0, 2), "joints shoulder_pan_joint and elbow_joint swapped; check the order of the joint"),
    (swapped(3, 4), "joints wrist_1_joint and wrist_2_joint swapped"),
]  # fmt: skip


@pytest.mark.parametrize("kind", ["pose", "position"])
@pytest.mark.parametrize(("mistake", "words"), MISTAKES)
def test_joints_that_were_mixed_up_are_named(told, ur10, kind, mistake, words):
    """Joint values within half their range, so that no limit tells; an arm that is millimetres off."""
    real = real_ur10()
    q = 0.4 * joints(ur10, 60)
    lines = sheet(real, q, kind=kind).splitlines()
    written = sheet(real, mistake(q), kind=kind).splitlines()
    # The joints' columns of one, the readings of the other.
    rows = [",".join((*w.split(",")[:6], *t.split(",")[6:])) for w, t in zip(written, lines, strict=True)]
    (text,) = told(ur10, "\n".join(rows))
    assert words in text


def real_ur10():
    """A UR10 off by two millimetres and four milliradians at every joint."""
    rng = np.random.default_rng(3)
    arm = Chain.from_urdf(robot_file("ur_description/urdf/ur10_robot.urdf"), "tool0")
    scale = np.repeat([2e-3, 4e-3], 3)
    return arm.perturbed_at({joint_frame(j): se3.exp6(scale * rng.uniform(-1, 1, 6)) for j in range(1, 7)})


@pytest.mark.parametrize("swap", [("x", "y"), ("y", "z")])
def test_a_mirrored_frame_is_named(told, ur10, swap):
    text = sheet(real_ur10(), joints(ur10, 60))
    head, body = text.split("\n", 1)
    a, b = (f"{axis}[mm]" for axis in swap)
    head = head.replace(a, "?").replace(b, a).replace("?", b)
    (said,) = told(ur10, f"{head}\n{body}")
    assert "with the measuring frame mirrored; check the order and the signs of x, y and z" in said


def test_readings_of_another_row_are_named(told, ur10):
    lines = sheet(real_ur10(), joints(ur10, 150)).splitlines()
    pairs = pairwise(lines[1:])
    rows = [",".join((*q.split(",")[:6], *reading.split(",")[6:])) for q, reading in pairs]
    (said,) = told(ur10, "\n".join([lines[0], *rows]))
    assert (
        "with the measured values of the previous row; check how joint and measured columns were joined"
        in said
    )


def test_another_robot_is_told_but_nothing_guessed(told, ur10):
    other = Chain.from_urdf(robot_file("ur_description/urdf/ur3_robot.urdf"), "tool0")
    (said,) = told(ur10, sheet(other, joints(ur10, 60), kind="position"))
    assert said.endswith("check the robot and tip, the units, and the order, signs and zeros of the joints")


def test_gross_errors_are_no_mistaken_column(told, ur10):
    rng = np.random.default_rng(5)
    real, q = real_ur10(), joints(ur10, 80)
    rows = sheet(real, q, kind="position").splitlines()
    for i in rng.permutation(80)[:8] + 1:
        cells = rows[i].split(",")
        cells[6:] = [repr(float(cell) + 1e3 * rng.normal()) for cell in cells[6:]]
        rows[i] = ",".join(cells)
    assert told(ur10, "\n".join(rows)) == []


def test_rows_given_twice(told, ur10):
    lines = sheet(ur10, joints(ur10)).splitlines()
    (text,) = told(ur10, "\n".join([*lines, lines[3], lines[3], lines[9]]))
    assert text.startswith("rows 31, 32, 33: identical to other rows in every digit (row 31 to row 3)")


def test_the_same_configuration_read_again_is_believed(told, ur10):
    """Repeated standstills differ in what was read."""
    lines = sheet(ur10, joints(ur10)).splitlines()
    again = lines[3].split(",")
    again[6] = repr(float(again[6]) + 0.01)
    assert told(ur10, "\n".join([*lines, ",".join(again)])) == []


@pytest.mark.parametrize("kind", KINDS)
def test_simulated_files_bring_up_nothing(told, ur10, sim_6dof, kind):
    for chain, noise in ((ur10, Noise(1e-4, 1e-4)), (sim_6dof, Noise(1e-3, 1e-3))):
        rng = np.random.default_rng(1)
        q = rng.uniform(-2.8, 2.8, (25, chain.n_joints))
        data = KINDS[kind].simulate(chain, q, noise, rng)
        configurations = data.configurations()
        assert wrap_into_limits(chain, configurations)[1].all()
        assert told(chain, measurement_text(data, chain)) == []


@pytest.mark.parametrize("command", ["calibrate", "validate"])
def test_the_command_line_says_so(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    arm = Chain.from_dh(paper("experiment"))
    (tmp_path / "arm.dh.toml").write_bytes((URDF / "experiment.dh.toml").read_bytes())
    q = joints(arm, 12)
    rows = np.hstack([q, 1e3 * arm.poses(q)[:, :3, 3]]).tolist()
    lines = [
        "joint_1[rad],joint_2[rad],joint_3[rad],x[mm],y[mm],z[mm]",
        *(",".join(map(repr, r)) for r in rows),
    ]
    (tmp_path / "data.csv").write_text("\n".join(lines))
    more = ["-o", "out.urdf"] if command == "calibrate" else []
    assert main.main([command, "arm.dh.toml", "data.csv", *more]) == 0
    assert ": warning: " not in capsys.readouterr().err
    (tmp_path / "data.csv").write_text("\n".join([*lines, lines[1]]))
    assert main.main([command, "arm.dh.toml", "data.csv", *more]) == 0
    found = [line for line in capsys.readouterr().err.splitlines() if "warning:" in line]
    assert len(found) == 1
    assert found[0].startswith("data.csv: warning: row 13: identical to other rows")


def test_two_wires_of_one_name_are_told(tmp_path, monkeypatch, capsys):
    """Files that call two anchors alike cannot both be met."""
    monkeypatch.chdir(tmp_path)
    arm = Chain.from_dh(paper("sim_6dof"))
    (tmp_path / "arm.dh.toml").write_bytes((URDF / "sim_6dof.dh.toml").read_bytes())
    for file, anchor in (("one.csv", [2.0, 1, 0]), ("two.csv", [-1.0, 2, 0.5])):
        q = joints(arm, 60, len(file) + int(anchor[0]))
        length = np.linalg.norm(arm.poses(q)[:, :3, 3] - anchor, axis=1)
        (tmp_path / file).write_text(measurement_text(Wires(q, length[:, None]), arm))
    assert main.main(["calibrate", "arm.dh.toml", "one.csv", "-o", "out.urdf"]) == 0
    assert ": warning: " not in capsys.readouterr().err
    assert main.main(["calibrate", "arm.dh.toml", "one.csv", "two.csv", "-o", "out.urdf"]) == 0
    found = [line for line in capsys.readouterr().err.splitlines() if "warning:" in line]
    assert found
    assert all(
        "after the fit, the median length error is" in line and "whether wire1 is" in line for line in found
    )
