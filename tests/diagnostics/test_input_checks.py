"""Warnings about measurement files: what causes each of them, and what must not."""

import re

import numpy as np
import pytest
from measurement_files import csv_text_of, frames, joint_positions, real_ur10
from robots import URDF, paper
from scipy.spatial.transform import Rotation

from dhcal_pin import se3, select_parameters
from dhcal_pin.cli.main import main
from dhcal_pin.diagnostics import find_payload_notes, find_value_warnings
from dhcal_pin.diagnostics.input_checks import find_payload_warnings
from dhcal_pin.io import measurement_text, read_measurement_file, read_servos
from dhcal_pin.measurements import KINDS, CameraCorners, Noise, Position, Wires
from dhcal_pin.robot import Chain, Payload, parse_urdf
from dhcal_pin.robot.inverse_kinematics import wrap_into_limits


@pytest.mark.parametrize("kind", ["pose", "position"])
@pytest.mark.parametrize("joint", ["rad", "deg"])
@pytest.mark.parametrize("length", ["m", "mm"])
def test_right_units_give_no_warnings(warnings_of, ur10, kind, joint, length):
    for m in (1, 2, 3, 30):
        assert (
            warnings_of(
                ur10, csv_text_of(ur10, joint_positions(ur10, m), joint=joint, length=length, kind=kind)
            )
            == []
        )


@pytest.mark.parametrize("kind", ["pose", "position"])
@pytest.mark.parametrize(
    ("units", "expected"),
    [
        ({"joint": ("rad", "deg")}, "if the values are degrees, write [deg]"),
        ({"joint": ("deg", "rad")}, "if the values are radians, write [rad]"),
        ({"length": ("m", "mm")}, "if they are millimetres, write x[mm]"),
        ({"length": ("mm", "m")}, "if they are metres, write x[m]"),
    ],
)
def test_a_wrong_unit_gives_one_warning(warnings_of, ur10, kind, units, expected):
    declared = {name: pair[0] for name, pair in units.items()}
    wrong = {name: pair[1] for name, pair in units.items()}
    found = warnings_of(ur10, csv_text_of(ur10, joint_positions(ur10), kind=kind, wrong=wrong, **declared))
    assert len(found) == 1
    assert expected in found[0]


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_counts_of_servos_under_another_unit_are_named(warnings_of, ur10, tmp_path, unit):
    q = np.rint(np.random.default_rng(1).uniform(1000, 3000, (30, 6))) * 2 * np.pi / 4096 - np.pi
    header, *rows = csv_text_of(ur10, q, kind="position", joint="rad").splitlines()
    cells = np.array([row.split(",") for row in rows], float)
    counts = np.rint((cells[:, :6] + np.pi) * 4096 / (2 * np.pi)).astype(int)
    body = [
        ",".join(map(repr, (*a, *b))) for a, b in zip(counts.tolist(), cells[:, 6:].tolist(), strict=True)
    ]
    written = header.replace("[rad]", f"[{unit}]")
    (found,) = warnings_of(ur10, "\n".join([written, *body]))
    first, *others = ur10.joint_names
    assert (
        f"whole numbers from 0 to 4095 look like counts of servos; if they are, write {first}[ticks]" in found
    )
    assert f"(also {', '.join(others[:-1])} and {others[-1]})" in found
    assert f"[{unit}]" not in found
    # The advice is followed.
    (tmp_path / "servos.toml").write_text("".join(f"[motor.{name}]\n" for name in ur10.joint_names))
    (tmp_path / "counts.csv").write_text("\n".join([header.replace("[rad]", "[ticks]"), *body]))
    servos = read_servos(tmp_path / "servos.toml")
    file = read_measurement_file(tmp_path / "counts.csv", ur10, servos=servos)
    np.testing.assert_allclose(file.data.q, q, atol=1e-12)
    # Numbers with decimals are no counts.
    (found,) = warnings_of(ur10, "\n".join([written, *(row.replace(",", ".5,", 1) for row in body)]))
    assert "check the values and the unit in the header" in found


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1000.0), ("m", 1e-3)])
def test_the_unit_of_the_header_is_not_advised(warnings_of, ur10, unit, factor):
    header, *rows = csv_text_of(ur10, joint_positions(ur10), kind="position", length=unit).splitlines()
    columns = np.array([row.split(",") for row in rows], float)
    columns[:, [cell[0] in "xyz" for cell in header.split(",")]] *= factor
    (found,) = warnings_of(ur10, "\n".join([header, *(",".join(map(str, row)) for row in columns)]))
    assert "the positions spread" in found
    assert found.endswith("; check the values")


@pytest.mark.parametrize("wrong", ["z", "x,y"])
def test_only_the_coordinates_in_millimetres_are_named(warnings_of, ur10, wrong):
    header, *rows = csv_text_of(ur10, joint_positions(ur10), kind="position", length="m").splitlines()
    names = [cell.split("[")[0] for cell in header.split(",")]
    factors = [1000.0 if name in wrong.split(",") else 1.0 for name in names]
    rows = [
        ",".join(str(factor * float(cell)) for factor, cell in zip(factors, row.split(","), strict=True))
        for row in rows
    ]
    (found,) = warnings_of(ur10, "\n".join([header, *rows]))
    expected = ",".join(f"{axis}[mm]" for axis in wrong.split(","))
    assert found.endswith(f"if they are millimetres, write {expected}")


@pytest.mark.parametrize(
    ("declared", "true", "expected"),
    [
        ("rad", "deg", "more than a turn"),
        ("deg", "rad", "rotation vectors are 57.3 times too small, as if rad had been read as deg"),
    ],
)
def test_rotation_vectors_in_the_wrong_unit(warnings_of, ur10, declared, true, expected):
    (text,) = warnings_of(
        ur10, csv_text_of(ur10, joint_positions(ur10), angle=declared, wrong={"angle": true})
    )
    assert expected in text


def test_euler_angles_read_as_rotation_vectors_give_a_warning(warnings_of, ur10):
    base, tool = frames()
    q = joint_positions(ur10)
    poses = base @ ur10.poses(q) @ tool

    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("XYZ")
    text = csv_text_of(ur10, q)
    lines = text.splitlines()
    rows = [
        ",".join([*line.split(",")[:9], *map(repr, row)])
        for line, row in zip(lines[1:], angles.tolist(), strict=True)
    ]
    (found,) = warnings_of(ur10, "\n".join([lines[0], *rows]))
    assert "The rotations are Euler angles X, Y', Z''" in found


def test_transposed_rotations_give_a_warning(warnings_of, ur10):
    """Angles between rows do not reveal inverse rotations, which keep them."""
    q = joint_positions(ur10)
    base, tool = frames()
    rotvec = se3.log3((base @ ur10.poses(q) @ tool)[:, :3, :3])
    lines = csv_text_of(ur10, q).splitlines()
    rows = [
        ",".join([*line.split(",")[:9], *map(repr, row)])
        for line, row in zip(lines[1:], (-rotvec).tolist(), strict=True)
    ]
    (found,) = warnings_of(ur10, "\n".join([lines[0], *rows]))
    assert "measured rotations are inverse" in found


@pytest.mark.parametrize("moving", [[0], [5], [0, 5], [0, 1, 2, 5]])
def test_few_moving_joints_give_no_warning(warnings_of, ur10, moving):
    """If base or target are not determined, some frames fit the rotations."""
    for seed in range(3):
        q = np.full((30, 6), 0.4)
        q[:, moving] = joint_positions(ur10, 30, seed)[:, moving]
        assert warnings_of(real_ur10(), csv_text_of(real_ur10(), q)) == []


def test_small_motions_give_no_warning(warnings_of, ur10):
    q = np.deg2rad(np.random.default_rng(0).uniform(-5, 5, (30, 6)))
    assert warnings_of(ur10, csv_text_of(ur10, q, joint="deg")) == []


def test_one_outlier_is_not_a_wrong_unit(warnings_of, ur10):
    lines = csv_text_of(ur10, joint_positions(ur10), kind="position").splitlines()
    cells = lines[5].split(",")
    lines[5] = ",".join([*cells[:6], "900000", *cells[7:]])
    assert warnings_of(ur10, "\n".join(lines)) == []


def test_a_tool_point_at_rest_gives_no_warning(warnings_of, ur10):
    """The tip moves around the measured point, which does not mean metres in a column of mm."""
    data = KINDS["point"].simulate(ur10, joint_positions(ur10), Noise(), np.random.default_rng(0))
    data = data.take(data.label == 0)
    positions = ur10.poses(data.q)[:, :3, 3] + 1e-5 * np.random.default_rng(0).normal(size=(len(data.q), 3))
    assert warnings_of(ur10, measurement_text(Position(data.q, positions), ur10)) == []


@pytest.mark.parametrize(
    ("header", "value", "expected"),
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
def test_implausible_lengths_and_sigmas(warnings_of, ur10, header, value, expected):
    names = ",".join(f"{name}[rad]" for name in ur10.joint_names)
    rows = [f"{','.join(map(repr, row))},{value}" for row in joint_positions(ur10, 4).tolist()]
    found = warnings_of(ur10, "\n".join([f"{names},{header}", *rows]))
    assert [expected in text for text in found] == ([True] if expected else [])


@pytest.mark.parametrize(
    ("unit", "value", "expected"),
    [("m", 50, "distance is 50 m"), ("mm", 0.05, "write distance[m]"), ("mm", 50, "")],
)
def test_implausible_known_distances(warnings_of, ur10, unit, value, expected):
    found = warnings_of(ur10, f"point_a,point_b,distance[{unit}]\na,b,{value}\n")
    assert [expected in text for text in found] == ([True] if expected else [])


def test_joints_beyond_their_limits(warnings_of, ur10):
    q = joint_positions(ur10)
    q[[3, 7], 2] = [3.3, -3.15]
    q[11, 2] = np.pi + 1e-5
    (text,) = warnings_of(ur10, csv_text_of(ur10, q))
    assert "joint elbow_joint is beyond its limits, -3.142 rad to 3.142 rad, in lines 5, 9;" in text


@pytest.mark.parametrize(
    ("has_masses", "masses", "payload", "expected"),
    [
        (False, [0, 5], None, "has no effect, because the robot has no masses; state mass and centre"),
        (False, [0, 5], Payload(5.0), ""),
        (
            True,
            [5, 5],
            None,
            "the payload is 5 kg in all rows, but the result holds for the robot without it",
        ),
        (True, [5, 5], Payload(5.0), ""),
        (True, [0, 5], None, ""),
        (True, [0, 0], None, ""),
        (True, [0, 5000], Payload(5.0), "the payload is 5000 kg in lines 3, 5, 7"),
    ],
)
def test_a_payload_that_the_result_does_not_contain(tmp_path, ur10, has_masses, masses, payload, expected):
    data = ur10.urdf.data if has_masses else re.sub(rb"(?s)<inertial>.*?</inertial>", b"", ur10.urdf.data)
    arm = Chain.from_urdf(parse_urdf(data, "arm.urdf"), "tool0").with_payload(payload)
    header, *rows = csv_text_of(ur10, joint_positions(ur10)).splitlines()
    lines = [f"{header},payload[kg]", *(f"{row},{masses[i % 2]}" for i, row in enumerate(rows))]
    path = tmp_path / "data.csv"
    path.write_text("\n".join(lines))
    file = read_measurement_file(path, arm)
    found = [*find_value_warnings(arm, file), *find_payload_warnings(arm, file)]
    assert [expected in text for text in found] == ([True] if expected else [])


@pytest.mark.parametrize(
    ("masses", "payloads", "parameters", "expected"),
    [
        ([5, 0], (0.0, 5.0), "compliance", ""),
        (
            [5, 10],
            (0.0, 5.0),
            "compliance",
            "is 10 kg in lines 3, 5, 7, 9, 11 and 5 more, and the calibration has 0 to 5 kg",
        ),
        (
            [1, 10],
            (2.0, 2.0),
            "compliance",
            "is 1 to 10 kg in lines 2, 3, 4, 5, 6 and 15 more, and the calibration has 2 kg",
        ),
        (
            [0, 5],
            None,
            "compliance",
            "and the calibration has no payload: how far the joints yield is extrapolated",
        ),
        ([0, 5], None, "", ""),
        ([0, 5], (0.0, 1.0), "", "the joints of the model do not yield, so that the column has no effect"),
    ],
)
def test_payloads_beyond_those_of_the_calibration(tmp_path, ur10, masses, payloads, parameters, expected):
    header, *rows = csv_text_of(ur10, joint_positions(ur10)).splitlines()
    lines = [f"{header},payload[kg]", *(f"{row},{masses[i % 2]}" for i, row in enumerate(rows[:20]))]
    errors = select_parameters(ur10, "compliance")
    arm = errors.at(np.full(len(errors.parameters), 1e-5)) if parameters else ur10
    path = tmp_path / "data.csv"
    path.write_text("\n".join(lines))
    found = find_payload_notes(arm, read_measurement_file(path, arm), payloads)
    assert [expected in text for text in found] == ([True] if expected else []), found


def test_repeated_rows_give_a_warning(warnings_of, ur10):
    lines = csv_text_of(ur10, joint_positions(ur10)).splitlines()
    (text,) = warnings_of(ur10, "\n".join([*lines, lines[3], lines[3], lines[9]]))
    assert text.startswith("lines 32, 33, 34: identical to other rows in every digit (line 32 to line 4)")


def test_repeated_measurements_of_one_configuration_give_no_warning(warnings_of, ur10):
    """Their measured values differ."""
    lines = csv_text_of(ur10, joint_positions(ur10)).splitlines()
    again = lines[3].split(",")
    again[6] = repr(float(again[6]) + 0.01)
    assert warnings_of(ur10, "\n".join([*lines, ",".join(again)])) == []


@pytest.fixture
def images(ur10):
    """Simulated images of two cameras, and the lines of their file: a comment, the header and the corners."""
    rng = np.random.default_rng(1)
    data = KINDS["camera"].simulate(ur10, rng.uniform(-2.8, 2.8, (8, 6)), Noise(1e-3, 1e-3), rng)
    assert isinstance(data, CameraCorners)
    text = measurement_text(data, ur10).splitlines()
    first = next(i for i, line in enumerate(text) if "u[px]" in line) + 1
    return data.rig, text[:first], text[first:]


def moved(line, header, pixels):
    """Return a line of corners with another u."""
    column = header[-1].split(",").index("u[px]")
    cells = line.split(",")
    return ",".join([*cells[:column], repr(float(cells[column]) + pixels), *cells[column + 1 :]])


def test_repeated_corners_give_a_warning(warnings_of, ur10, images):
    """Six corners are an image. Copied ones and corners at two places have a warning each."""
    rig, header, lines = images
    first = len(header) + 1
    assert warnings_of(ur10, "\n".join([*header, *lines]), rig) == []
    end = first + len(lines)
    (copied,) = warnings_of(ur10, "\n".join([*header, *lines, *lines[:6]]), rig)
    assert copied.startswith(f"lines {end}, {end + 1}, {end + 2}, {end + 3}, {end + 4} and 1 more: identical")
    more = [moved(lines[3], header, 20.0), moved(lines[2], header, 0.1), moved(lines[13], header, 0.1)]
    (places,) = warnings_of(ur10, "\n".join([*header, *lines, *more]), rig)
    assert places.startswith(
        f"lines {end}, {end + 1}, {end + 2}: another place of a corner that the image has already "
        f"(corner 3 in line {first + 3} and line {end})"
    )
    both = warnings_of(ur10, "\n".join([*header, *lines, more[0], lines[0]]), rig)
    assert [text.split(":")[0] for text in both] == [f"line {end + 1}", f"line {end}"]


def test_two_photographs_in_one_configuration_give_no_warning(warnings_of, ur10, images):
    """The second one may lack corners that were not found in it."""
    rig, header, lines = images
    for again in (lines[:6], lines[1:6], lines[6:9]):
        again = [moved(line, header, 0.05) for line in again]
        assert warnings_of(ur10, "\n".join([*header, *lines, *again]), rig) == []


def test_names_tell_photographs_from_corners_at_two_places(warnings_of, ur10, images):
    """A second photograph may show one corner only; all corners of one photograph may be there twice."""
    rig, header, lines = images
    header = [*header[:-1], f"{header[-1]},image"]
    named = [f"{line},{number // 6}.png" for number, line in enumerate(lines)]
    end = len(header) + 1 + len(lines)
    for again, count in ((lines[:1], 1), (lines[:6], 6)):
        for name, n_wrong in (("0.png", count), ("other.png", 0)):
            more = [f"{moved(line, header, 0.05)},{name}" for line in again]
            found = warnings_of(ur10, "\n".join([*header, *named, *more]), rig)
            assert len(found) == (n_wrong > 0)
            if found:
                assert found[0].startswith(f"line{'s' if n_wrong > 1 else ''} {end}")
                assert "another place of a corner" in found[0]
    (copied,) = warnings_of(ur10, "\n".join([*header, *named, f"{lines[0]},other.png"]), rig)
    assert copied.startswith(f"line {end}: identical")


@pytest.mark.parametrize("kind", KINDS)
def test_simulated_files_give_no_warnings(warnings_of, ur10, sim_6dof, kind):
    for chain, noise in ((ur10, Noise(1e-4, 1e-4)), (sim_6dof, Noise(1e-3, 1e-3))):
        rng = np.random.default_rng(1)
        q = rng.uniform(-2.8, 2.8, (25, chain.n_joints))
        data = KINDS[kind].simulate(chain, q, noise, rng)
        configurations = data.configurations()
        assert wrap_into_limits(chain, configurations)[1].all()
        assert warnings_of(chain, measurement_text(data, chain), getattr(data, "rig", None)) == []


@pytest.mark.parametrize("command", ["calibrate", "validate"])
def test_warnings_on_the_command_line(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    arm = Chain.from_dh(paper("experiment"))
    (tmp_path / "arm.dh.toml").write_bytes((URDF / "experiment.dh.toml").read_bytes())
    q = joint_positions(arm, 12)
    rows = np.hstack([q, 1e3 * arm.poses(q)[:, :3, 3]]).tolist()
    lines = [
        "joint_1[rad],joint_2[rad],joint_3[rad],x[mm],y[mm],z[mm]",
        *(",".join(map(repr, r)) for r in rows),
    ]
    (tmp_path / "data.csv").write_text("\n".join(lines))
    more = ["-o", "out.urdf"] if command == "calibrate" else []
    assert main([command, "arm.dh.toml", "data.csv", *more]) == 0
    assert ": warning: " not in capsys.readouterr().err
    (tmp_path / "data.csv").write_text("\n".join([*lines, lines[1]]))
    assert main([command, "arm.dh.toml", "data.csv", *more]) == 0
    found = [line for line in capsys.readouterr().err.splitlines() if "warning:" in line]
    assert len(found) == 1
    assert found[0].startswith("data.csv: warning: line 14: identical to other rows")


@pytest.mark.usefixtures("unsuspected_once")
def test_two_anchors_with_one_name_give_warnings(tmp_path, monkeypatch, capsys):
    """One estimated anchor cannot fit the lengths of two files that use different anchors."""
    monkeypatch.chdir(tmp_path)
    arm = Chain.from_dh(paper("sim_6dof"))
    (tmp_path / "arm.dh.toml").write_bytes((URDF / "sim_6dof.dh.toml").read_bytes())
    for file, anchor in (("one.csv", [2.0, 1, 0]), ("two.csv", [-1.0, 2, 0.5])):
        q = joint_positions(arm, 60, len(file) + int(anchor[0]))
        length = np.linalg.norm(arm.poses(q)[:, :3, 3] - anchor, axis=1)
        (tmp_path / file).write_text(measurement_text(Wires(q, length[:, None]), arm))
    assert main(["calibrate", "arm.dh.toml", "one.csv", "-o", "out.urdf"]) == 0
    assert ": warning: " not in capsys.readouterr().err
    command = ("calibrate", "arm.dh.toml", "one.csv", "two.csv", "-o", "two.urdf", "--session", "off")
    assert main([*command, "--verbose"]) == 3
    found = [line for line in capsys.readouterr().err.splitlines() if "warning:" in line]
    assert found
    assert all(
        "after the fit, the median length error is" in line and "whether wire1 is" in line for line in found
    )
