"""Column maps: every key, every convention of rotations, and errors that name the problem."""

import itertools
import json

import numpy as np
import pytest
from robots import URDF, paper
from scipy.spatial.transform import Rotation

from dhcal_pin import se3
from dhcal_pin.cli import main
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import measurement_text, read_measurement_file, read_measurements
from dhcal_pin.measurements.euler_angles import angles_to_matrix, euler_notation, matrix_to_angles
from dhcal_pin.measurements.pose import Pose, RelativePose
from dhcal_pin.measurements.position import Position
from dhcal_pin.robot.chain import Chain

JOINTS = ("joint_1", "joint_2", "joint_3")
MAP = """separator = ";"
decimal = ","
skip = 2
[joints]
order = ["A1", "A2", "A3"]
unit = "deg"
[columns]
x = {from = "X pos", unit = "mm"}
y = {from = "Y pos", unit = "mm"}
z = {from = "Z pos", unit = "mm"}
"""
FILE = """A tracker's software, version 7
1;2
Nr;Z pos;A3;A1;A2;X pos;Y pos

1;10,5;30,0;10;-2,0e1;100,25;-7
2;11,5;31,0;11;-2,1e1;101,25;-8
"""


@pytest.fixture(scope="module")
def arm():
    return Chain.from_dh(paper("experiment"))


@pytest.fixture
def read(tmp_path, arm):
    def call(text=FILE, how=MAP, name="theirs.csv", **options):
        (tmp_path / "map.toml").write_text(how)
        (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_measurement_file(tmp_path / name, arm, tmp_path / "map.toml", **options)

    return call


def test_columns_in_another_order_with_decimal_commas(read):
    data = read().data
    assert isinstance(data, Position)
    np.testing.assert_allclose(np.rad2deg(data.q), [[10, -20, 30], [11, -21, 31]], rtol=1e-15)
    assert data.values.tolist() == [[0.10025, -0.007, 0.0105], [0.10125, -0.008, 0.0115]]


def test_signs_offsets_scales_and_other_names(read):
    how = MAP.replace(
        'unit = "deg"',
        'unit = "deg"\nsign = [1, -1, 1]\noffset = [0, 90, -5.5]\nnames = ["joint_3", "joint_1", "joint_2"]',
    ).replace('from = "X pos", unit = "mm"', 'from = 6, unit = "cm", scale = -2, offset = 0.5')
    data = read(how=how).data
    np.testing.assert_allclose(np.rad2deg(data.q), [[110, 24.5, 10], [111, 25.5, 11]], rtol=1e-14)
    np.testing.assert_allclose(data.positions()[:, 0], [-2.0, -2.02], rtol=1e-14)


def test_units_joint_by_joint_and_inches(read):
    how = MAP.replace('unit = "deg"', 'unit = ["deg", "rad", "mrad"]').replace(
        'from = "X pos", unit = "mm"', 'from = "X pos", unit = "in"'
    )
    data = read(how=how).data
    np.testing.assert_allclose(data.q, [[np.deg2rad(10), -20, 0.030], [np.deg2rad(11), -21, 0.031]])
    np.testing.assert_allclose(data.values[:, 0], [100.25 * 0.0254, 101.25 * 0.0254], rtol=1e-15)


@pytest.mark.parametrize(("separator", "sign"), [(",", ","), ("tab", "\t"), ("space", "   "), (";", ";")])
def test_separators_comments_and_no_header(read, separator, sign):
    rows = [["10", "20", "30", "socket-1"], ["11", "21", "31", "socket-2"]]
    text = "% made by hand\n" + "".join(sign.join(row) + "\n" for row in rows)
    how = f"""separator = "{separator}"
header = false
comment = "%"
joints = {{order = [1, 2, 3], unit = "mrad"}}
columns = {{point = {{from = 4}}}}
"""
    data = read(text, how).data
    assert data.kind == "point"
    assert data.q.tolist() == [[0.01, 0.02, 0.03], [0.011, 0.021, 0.031]]
    assert data.to_columns()["point"] == ["socket-1", "socket-2"]


def test_constants_contain_parts_of_the_path(tmp_path, arm):
    folder = tmp_path / "front {stem}"
    folder.mkdir()
    (folder / "hole_0.csv").write_text("0.1,0.2,0.3\n")
    how = (
        'header = false\njoints = {order = [1, 2, 3], unit = "rad"}\nconstant = {point = "p-{parent}/{stem}"}'
    )
    (tmp_path / "map.toml").write_text(how)
    data = read_measurements(folder / "hole_0.csv", arm, tmp_path / "map.toml")
    assert data.to_columns()["point"] == ["p-front {stem}/hole_0"]


def test_encodings_and_separators_at_the_end_of_lines(read):
    text = FILE.replace("Nr", "Temperatur °C").replace("-7", "-7;;").encode("cp1252")
    assert read(text, 'encoding = "cp1252"\n' + MAP).data.q.shape == (2, 3)
    with pytest.raises(DhcalError, match="is not UTF-8; save the file as UTF-8"):
        read(text)


def test_a_file_of_the_own_format_is_read_without_the_map(read, arm):
    own = "point_a,point_b,distance[mm]\np,q,50\n"
    assert read(own).data.kind == "point_distance"
    bare = 'header = false\njoints = {order = [1, 2, 3], unit = "rad"}\nconstant = {point = "p"}'
    assert read(own, bare).data.kind == "point_distance"
    # A file with all columns of the map is read through the map: here the second joint's sign is reversed.
    both = "joint_1[deg],joint_2[deg],joint_3[deg],x[mm],y[mm],z[mm]\n1,2,3,4,5,6\n"
    how = """[joints]
order = ["joint_1[deg]", "joint_2[deg]", "joint_3[deg]"]
unit = "deg"
sign = [1, -1, 1]
[columns]
x = {from = "x[mm]", unit = "mm"}
y = {from = "y[mm]", unit = "mm"}
z = {from = "z[mm]", unit = "mm"}
"""
    np.testing.assert_allclose(np.rad2deg(read(both, how).data.q), [[1, -2, 3]], rtol=1e-15)


# --- rotations -------------------------------------------------------------------------------------


@pytest.mark.parametrize("frame", ["intrinsic", "extrinsic"])
def test_euler_conventions_are_those_of_scipy(frame):
    angles = np.random.default_rng(0).uniform(-7, 7, (40, 3))
    every = [axes for axes in itertools.product("xyz", repeat=3) if axes[0] != axes[1] != axes[2]]
    assert len(every) == 12
    for axes in map("".join, every):
        wanted = Rotation.from_euler(axes.upper() if frame == "intrinsic" else axes, angles).as_matrix()
        notation = euler_notation(axes, frame)
        np.testing.assert_allclose(angles_to_matrix(angles, notation), wanted, atol=5e-15)
        found = angles_to_matrix(matrix_to_angles(wanted, notation), notation)
        np.testing.assert_allclose(found, wanted, atol=5e-15)


@pytest.mark.parametrize(
    ("how", "columns"),
    [
        ('convention = "rotvec"\nunit = "deg"', lambda r: r.as_rotvec(degrees=True)),
        ('convention = "quaternion"\norder = "xyzw"', lambda r: r.as_quat()),
        ('convention = "quaternion"\norder = "wxyz"', lambda r: np.roll(r.as_quat(), 1, 1)),
        ('convention = "matrix"', lambda r: r.as_matrix().reshape(-1, 9)),
        (
            'convention = "euler"\naxes = "XYZ"\nframe = "intrinsic"\nunit = "deg"',
            lambda r: r.as_euler("XYZ", degrees=True),
        ),
        (
            'convention = "euler"\naxes = "xyz"\nframe = "extrinsic"\nunit = "rad"',
            lambda r: r.as_euler("xyz"),
        ),
        (
            'convention = "euler"\naxes = "ZYZ"\nframe = "intrinsic"\nunit = "mrad"',
            lambda r: 1e3 * r.as_euler("ZYZ"),
        ),
    ],
)
def test_rotations_in_every_convention(read, how, columns):
    turns = Rotation.random(20, np.random.default_rng(1))
    values = columns(turns)
    names = [f"r{i}" for i in range(values.shape[1])]
    lines = [",".join(["a", "b", "c", "x", "y", "z", *names])]
    lines += [",".join(map(repr, [0.1, 0.2, 0.3, 1.0, 2.0, 3.0, *row])) for row in values.tolist()]
    text = "\n".join(lines)
    mapped = 'joints = {order = ["a", "b", "c"], unit = "rad"}\n[columns]\n'
    mapped += "".join(f'{axis} = {{from = "{axis}", unit = "m"}}\n' for axis in "xyz")
    mapped += "".join(f'sigma_{axis} = {{from = "x", unit = "mm"}}\n' for axis in ("x", "y", "z"))
    mapped += "".join(f'sigma_{axis} = {{from = "x", unit = "deg"}}\n' for axis in ("rx", "ry", "rz"))
    data = read(text, f"{mapped}[rotation]\n{how}\ncolumns = {json.dumps(names)}\n").data
    assert isinstance(data, Pose)
    assert data.has_stated_sigma
    np.testing.assert_allclose(data.rotations(), turns.as_matrix(), atol=5e-15)
    assert np.isfinite(data.angles).all() == ("euler" in how or "rotvec" in how)
    assert (data.notations == "rotvec").all() == ("rotvec" in how)


def test_euler_angles_are_kept_for_the_rows_that_are_used(read):
    """They say which other notations the rotations may have, see `plausibility`."""
    rows = [f"0.1,0.2,0.3,1,2,3,{10 * i},{'' if i == 1 else 20 + i},{-100 - i}" for i in range(5)]
    how = (
        'joints = {order = ["a", "b", "c"], unit = "rad"}\n[columns]\n'
        + "".join(f'{axis} = {{from = "{axis}", unit = "m"}}\n' for axis in "xyz")
        + '[rotation]\nconvention = "euler"\naxes = "ZYZ"\nframe = "extrinsic"\nunit = "deg"\n'
        + 'columns = ["O", "A", "T"]\n'
    )
    data = read("\n".join(["a,b,c,x,y,z,O,A,T", *rows]), how, skip_bad_rows=True).data.take([0, 2, 3])
    assert list(data.notations) == ["fixed-zyz"] * 3
    np.testing.assert_allclose(np.rad2deg(data.angles), [[0, 20, -100], [30, 23, -103], [40, 24, -104]])


@pytest.mark.parametrize(
    ("header", "axes"),
    [
        ("A1;A2;A3;X;Y;Z;O;A;T", "ZYZ"),
        ("A1;A2;A3;X [mm];Y [mm];Z [mm];O [deg];A [deg];T [deg]", "ZYZ"),
        ("A1;A2;A3;X;Y;Z;A;B;C", "ZYX"),
        # Only beside X, Y and Z, and only these three.
        ("A1;A2;A3;U;V;W;O;A;T", ""),
        ("A1;A2;A3;X;Y;Z;O;T;A", ""),
    ],
)
def test_angles_of_makers_are_proposed_by_their_columns(tmp_path, arm, header, axes):
    row = "10;20;30;400;500;600;70;80;-90"
    (tmp_path / "theirs.csv").write_text("\n".join([header, *[row] * 3]))
    with pytest.raises(DhcalError) as error:
        read_measurements(tmp_path / "theirs.csv", arm)
    names = json.dumps(header.split(";")[6:])
    line = f'axes = "{axes}", frame = "intrinsic", columns = {names}, unit = "deg"'
    assert (line in str(error.value)) == bool(axes)
    assert ("rotation =" in str(error.value)) == bool(axes)


@pytest.mark.parametrize(
    ("names", "order"),
    [
        (["qw", "qx", "qy", "qz"], "wxyz"),
        (["qx", "qy", "qz", "qw"], "xyzw"),
        ([f"/pose/orientation/{letter}" for letter in "xyzw"], "xyzw"),
    ],
)
def test_quaternions_are_proposed_in_the_order_of_their_columns(tmp_path, arm, names, order):
    header = ["A1", "A2", "A3", *(f"/pose/position/{axis}" for axis in "xyz"), *names]
    rows = ["10,20,30,1,2,3,0.5,-0.5,0.5,0.5"] * 3
    (tmp_path / "theirs.csv").write_text("\n".join([",".join(header), *rows]))
    with pytest.raises(DhcalError) as error:
        read_measurements(tmp_path / "theirs.csv", arm)
    assert f'order = "{order}", columns = {json.dumps(names)}' in str(error.value)
    assert 'x = {from = "/pose/position/x"' in str(error.value)


@pytest.mark.parametrize(
    ("names", "unit", "order"),
    [
        ("ABC", "deg", "ZYX"),
        ("ABC", "rad", "ZYX"),
        ("WPR", "deg", "xyz"),
        ("OAT", "deg", "ZYZ"),
        (("roll", "pitch", "yaw"), "deg", "xyz"),
    ],
)
def test_euler_angles_beside_named_joints_propose_a_map_that_reads_them(
    read, arm, tmp_path, names, unit, order
):
    """Without their axes, which the map states, they are no measurement; they are not to be removed."""
    header = [f"{joint}[deg]" for joint in reversed(JOINTS)] + ["x[cm]", "y[cm]", "z[cm]"]
    text = "\n".join(
        [",".join([*header, *(f"{name}[{unit}]" for name in names)]), "1,2,3,40,50,60,0.4,0.5,0.6"]
    )
    (tmp_path / "theirs.csv").write_text(text)
    with pytest.raises(DhcalError, match="are Euler angles without their axes") as error:
        read_measurements(tmp_path / "theirs.csv", arm)
    data = read(text, "\n".join(line for line in str(error.value).split("`")[1::2])).data
    assert isinstance(data, Pose)
    np.testing.assert_allclose(np.rad2deg(data.q), [[3, 2, 1]])
    np.testing.assert_allclose(data.positions(), [[0.4, 0.5, 0.6]])
    expected = Rotation.from_euler(order, [0.4, 0.5, 0.6], degrees=unit == "deg").as_matrix()
    np.testing.assert_allclose(data.rotations(), [expected], atol=1e-12)


def test_a_second_configuration_is_read_back(read, arm):
    rng = np.random.default_rng(0)
    q, q_to = rng.uniform(-1, 1, (2, 4, 3))
    data = RelativePose(q, q_to, se3.inverse(arm.poses(q)) @ arm.poses(q_to))
    text = measurement_text(data, arm)
    how = "".join(
        f'[{key}]\norder = {json.dumps([f"{before}{name}[rad]" for name in JOINTS])}\nunit = "rad"\n'
        for key, before in (("joints", ""), ("to_joints", "to:"))
    )
    how += "[columns]\n" + "".join(
        f'{name} = {{from = "{name}[{unit}]", unit = "{unit}"}}\n'
        for name, unit in [*((f"d{a}", "m") for a in "xyz"), *((f"dr{a}", "rad") for a in "xyz")]
    )
    again = read(text, how).data
    assert isinstance(again, RelativePose)
    assert (again.q.tolist(), again.q_to.tolist()) == (q.tolist(), q_to.tolist())
    np.testing.assert_allclose(again.poses, data.poses, atol=1e-14)


# --- errors -------------------------------------------------------------------------------


def swap(old: str, new: str) -> str:
    """Return the map with one replacement."""
    assert old in MAP
    return MAP.replace(old, new)


ROTATION = '[rotation]\nconvention = "euler"\naxes = "XYZ"\nframe = "intrinsic"\nunit = "deg"\n'


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("a =", ["map.toml", "not TOML", "(at end of document); correct the file"]),
        ("a = 1\nb c", ["map.toml", "not TOML", "(at line 2, column 3); correct that line"]),
        ("seperator = ';'\n" + MAP, ["unknown key 'seperator'", "choose from separator"]),
        (swap('separator = ";"', 'separator = "|"'), ["separator = '|'", '"tab"']),
        (swap("skip = 2", 'skip = "two"'), ["skip = 'two'", "skip = 2"]),
        (swap("skip = 2", "skip = -1"), ["skip = -1"]),
        (swap('separator = ";"', 'separator = ","'), ["separator and decimal are both ','"]),
        ('encoding = "klingon"\n' + MAP, ["'klingon'", "utf-8"]),
        (swap('unit = "deg"', 'unit = "mm"'), ["[joints]: joint_1: unit = 'mm'", '"rad"']),
        (swap('unit = "deg"', ""), ["[joints]: joint_1: unit = ''", '"deg"']),
        (swap('"A1", "A2", "A3"', '"A1", "A2"'), ["order has 2 entries; expected 3"]),
        (swap('"A1", "A2", "A3"', '"A1"'), ["order has 1 entry; expected 3"]),
        (swap('unit = "deg"', 'unit = "deg"\nsign = [1, 2, 1]'), ["sign", "1 or -1"]),
        (swap('unit = "deg"', 'unit = ["deg", "mm"]'), ["unit has 2 entries; expected 3"]),
        (swap('unit = "deg"', 'unit = ["deg", "deg", "mm"]'), ["joint_3", "'mm'", '"deg"']),
        (swap('unit = "deg"', 'unit = "deg"\noffset = ["a", 0, 0]'), ["'a' is not a number"]),
        (swap('"A1"', '"A9"'), ["theirs.csv:3", "no column 'A9'", "map.toml", "'A1'", "semicolons"]),
        (swap('"A1"', "99"), ["no column 99"]),
        (swap('"A1"', "0"), ["0 is not a column"]),
        (
            swap('x = {from = "X pos", unit = "mm"}', 'x = {unit = "mm"}'),
            ["[columns.x]: from is missing", "header"],
        ),
        (swap('x = {from = "X pos", unit = "mm"}', 'x = "X pos"'), ["[columns.x]: 'X pos' is not a table"]),
        (
            swap('{from = "X pos", unit = "mm"}', '{from = "X pos", unit = "deg"}'),
            ["x: unit = 'deg'", '"mm"'],
        ),
        (swap("x = {from", "x_pos = {from"), ["column 'x_pos' is neither a joint"]),
        (MAP + 'set = {from = "Nr", scale = 2}', ["set", "is text"]),
        (MAP + '[constant]\njoint_1 = "0"', ["[constant]: unknown key 'joint_1'", "point"]),
        (MAP + '[constant]\npoint = "{name}"', ["unknown placeholder {name}", "{stem}"]),
        (MAP + "[constant]\npoint = 3", ["point = 3", "{stem}"]),
        (MAP + '[to_joints]\norder = [1]\nnames = ["joint_1"]\nunit="deg"', ["'joint_1' is given twice"]),
        (MAP + ROTATION + "columns = [1, 2]", ["columns has 2 entries; expected 3"]),
        (MAP + ROTATION.replace("XYZ", "XXZ") + "columns = [1, 2, 3]", ["axes = 'XXZ'", "ZYZ"]),
        (MAP + ROTATION.replace("intrinsic", "moving") + "columns = [1, 2, 3]", ["frame = 'moving'"]),
        (
            MAP + ROTATION.replace('frame = "intrinsic"\n', "") + "columns = [1, 2, 3]",
            ["frame is missing", "extrinsic"],
        ),
        (MAP + ROTATION.replace("euler", "rpy") + "columns = [1, 2, 3]", ["convention = 'rpy'", "euler"]),
        (MAP + ROTATION + 'order = "wxyz"\ncolumns = [1, 2, 3]', ["order", "does not go with euler"]),
    ],
)
def test_an_invalid_map_is_an_error(read, how, words):
    with pytest.raises(DhcalError) as caught:
        read(how=how)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            FILE.replace("10,5", "1.010"),
            ["theirs.csv:5", "column 'Z pos'", "'1.010'", "thousands separators"],
        ),
        (FILE.replace("10,5", "ten"), ["theirs.csv:5", "column 'Z pos'", "'ten' is not a finite number"]),
        (FILE.replace("2;11,5;", "2;"), ["theirs.csv:6", "6 values for 7 columns"]),
        (FILE.replace("-8", "-8;9"), ["theirs.csv:6", "8 values for 7 columns"]),
        (FILE.replace("A1;A2", "A1;A1"), ["theirs.csv:3", "'A1' appears twice", "number"]),
        ("one\ntwo\nthree\n", ["no rows under the header"]),
        (FILE.replace("100,25", "1e10"), ["theirs.csv:5", "beyond"]),
    ],
)
def test_a_file_that_contradicts_its_map_is_an_error(read, text, words):
    with pytest.raises(DhcalError) as caught:
        read(text)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("cells", ["1,0,0,0,1,0,0,0,1.1", "1,0,0,0,1,0,0,0,-1"])
def test_a_matrix_that_is_not_a_rotation_is_an_error(read, cells):
    how = 'header = false\njoints = {order = [1, 2, 3], unit = "rad"}\n[columns]\n'
    how += "".join(f'{axis} = {{from = 1, unit = "m"}}\n' for axis in "xyz")
    how += '[rotation]\nconvention = "matrix"\ncolumns = [4, 5, 6, 7, 8, 9, 10, 11, 12]'
    with pytest.raises(DhcalError, match=r"theirs.csv:1: the nine numbers are not a rotation matrix"):
        read(f"0.1,0.2,0.3,{cells}\n", how)


def test_maps_on_the_command_line(tmp_path, arm, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    q = np.random.default_rng(0).uniform(-80, 80, (12, 3))
    seen = 1e3 * arm.poses(np.deg2rad(q))[:, :3, 3]
    rows = [";".join(str(value).replace(".", ",") for value in row) for row in np.hstack([q, seen]).tolist()]
    (tmp_path / "theirs.csv").write_text("\n".join(["A;B", "1", "A1;A2;A3;X pos;Y pos;Z pos", *rows]))
    (tmp_path / "map.toml").write_text(MAP)
    (tmp_path / "arm.dh.toml").write_bytes((URDF / "experiment.dh.toml").read_bytes())
    for command in (("calibrate", "-o", "out.urdf"), ("validate",)):
        name, *more = command
        arguments = [name, "arm.dh.toml", "theirs.csv", "--columns", "map.toml", "--json", "r.json", *more]
        assert main.main(arguments) == 0, capsys.readouterr().err
        result = json.loads((tmp_path / "r.json").read_text())
        assert result["after"]["position_rms_m"] < 1e-12
        assert "map.toml" in result["inputs"]
    with pytest.raises(SystemExit):
        main.main(["calibrate", "arm.dh.toml", "theirs.csv", "--columns"])
    assert (
        main.main(["validate", "arm.dh.toml", "theirs.csv", "--columns", "map.toml", "--json", "map.toml"])
        == 2
    )
    assert main.main(["validate", "arm.dh.toml", "theirs.csv", "--columns", "none.toml"]) == 2
