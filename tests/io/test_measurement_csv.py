"""DH files, measurement files, and writing all files or none."""

from __future__ import annotations

import json
import os
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io.atomic import require_writable, write_files
from dhcal_pin.io.dh_file import dh_text, read_dh
from dhcal_pin.io.measurement_csv import measurement_text, read_measurement_file, read_measurements
from dhcal_pin.io.robot import read_robot, urdf_files, write_urdf
from dhcal_pin.io.settings import read_priors
from dhcal_pin.io.sidecar import sidecar_text
from dhcal_pin.io.tabular import read_csv_table, read_toml
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.measurements.position import Position
from dhcal_pin.report.document import json_text
from dhcal_pin.robot.chain import Chain
from dhcal_pin.robot.dh import DHTable
from dhcal_pin.units import parse_noise

TABLE = ("theta", "d", "a", "alpha", "beta", "lower", "upper")
SCARA = """convention = "standard"
[units]
length = "mm"
angle = "deg"
[[joint]]
name = "shoulder"
theta = 0
d = 606.8
a = 325.0
alpha = 0.0
lower = -130.0
[[joint]]
name = "lift"
type = "prismatic"
theta = 30.0
d = 12.5
a = 0.25
alpha = 180.0
lower = -210.0
upper = 0.0
"""
SCARA_CSV = """# convention: standard
joint, type, theta[deg], d[mm], a[mm], alpha[deg], lower[deg|mm], upper[deg|mm]
shoulder, revolute, 0, 606.8, 325.0, 0.0, -130.0,
lift, prismatic, 30.0, 12.5, 0.25, 180.0, -210.0, 0.0
"""


def write(folder, name, text):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def scara(folder):
    return Chain.from_dh(read_dh(write(folder, "scara.dh.toml", SCARA)))


# --- DH files --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "text"), [("arm.dh.toml", SCARA), ("arm.dh.csv", SCARA_CSV)])
def test_a_dh_file_is_read_in_its_units(tmp_path, name, text):
    table = read_dh(write(tmp_path, name, text))
    assert table.convention == "standard"
    assert table.names == ("shoulder", "lift")
    assert table.prismatic.tolist() == [False, True]
    assert table.d.tolist() == [0.6068, 0.0125]
    assert table.a.tolist() == [0.325, 0.00025]
    np.testing.assert_allclose(table.theta, [0, np.pi / 6], rtol=2e-16)
    assert table.alpha.tolist() == [0, np.pi]
    np.testing.assert_allclose(table.lower, [-130 * np.pi / 180, -0.21], rtol=2e-16)
    assert table.upper.tolist() == [np.inf, 0.0]


@pytest.mark.parametrize(
    ("unit", "value", "metres"),
    [
        ("m", "0.6068", 0.6068),
        ("cm", "60.68", 0.6068),
        ("mm", "606.8", 0.6068),
        ("um", "606800", 0.6068),
        ("\u00b5m", "606800", 0.6068),
        ("\u03bcm", "606800", 0.6068),
    ],
)
def test_lengths_are_the_nearest_doubles(tmp_path, unit, value, metres):
    text = SCARA_CSV.replace("d[mm]", f"d[{unit}]").replace("606.8", value)
    assert read_dh(write(tmp_path, "a.csv", text)).d[0] == metres


@pytest.mark.parametrize(
    ("unit", "value", "radians"),
    [("deg", "90", np.pi / 2), ("deg", "-45", -np.pi / 4), ("mrad", "250", 0.25)],
)
def test_angles_are_the_nearest_doubles(tmp_path, unit, value, radians):
    text = SCARA_CSV.replace("alpha[deg]", f"alpha[{unit}]").replace("325.0, 0.0", f"325.0, {value}")
    assert read_dh(write(tmp_path, "a.csv", text)).alpha[0] == radians


def tables():
    """Any table: both conventions, both kinds of joint, frames, limits on some sides, names of any script."""
    number = st.floats(-9, 9)
    limit = st.one_of(st.none(), st.floats(0, 9))

    @st.composite
    def build(draw):
        n = draw(st.integers(1, 4))
        column = st.lists(number, min_size=n, max_size=n).map(np.array)
        letters = st.characters(categories=("L", "N"))
        names = draw(st.lists(st.text(letters, min_size=1), min_size=n, max_size=n, unique=True))
        sides = [[draw(limit) for _ in range(n)] for _ in range(2)]
        frame = st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6).map(se3.exp6)
        return DHTable(
            draw(st.sampled_from(("standard", "modified"))),
            tuple(names),
            np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n))),
            *(draw(column) for _ in range(4)),
            draw(st.one_of(st.just(np.zeros(n)), column)),
            np.array([-np.inf if x is None else -x for x in sides[0]]),
            np.array([np.inf if x is None else x for x in sides[1]]),
            *(draw(st.one_of(st.just(np.eye(4)), frame)) for _ in range(2)),
        )

    return build()


@settings(max_examples=60, deadline=None)
@given(table=tables())
def test_a_written_dh_file_reads_back_to_the_last_digit(tmp_path_factory, table):
    folder = tmp_path_factory.mktemp("dh")
    for name in ("arm.dh.toml", "arm.dh.csv"):
        again = read_dh(write(folder, name, dh_text(table, folder / name)))
        assert (again.convention, again.names) == (table.convention, table.names)
        assert again.prismatic.tolist() == table.prismatic.tolist()
        for key in TABLE:
            assert getattr(again, key).tolist() == getattr(table, key).tolist(), key
        for key in ("base", "tool"):
            assert getattr(again, key)[:3, 3].tolist() == getattr(table, key)[:3, 3].tolist()
            np.testing.assert_allclose(getattr(again, key), getattr(table, key), atol=3e-15)


def change(old, new):
    assert old in SCARA or old in SCARA_CSV
    return old, new


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (change('convention = "standard"', ""), ["convention is missing", '"standard"']),
        (change('"standard"', '"classic"'), ["convention = 'classic'", '"standard"']),
        (change('"standard"', "[1]"), ["convention = [1]"]),
        (change('length = "mm"', ""), ["[units]: length", "mm"]),
        (change('length = "mm"', 'length = "inch"'), ["[units]: length", "mm"]),
        (change('length = "mm"', 'length = ["mm"]'), ["[units]: length = ['mm']"]),
        (change('angle = "deg"', ""), ["[units]: angle is missing", "deg"]),
        (change("a = 325.0", "r = 325.0"), ["'shoulder'", "a is missing", "theta, d, r, alpha"]),
        (change("[units]", "[unit]"), ["unknown key 'unit'", "units"]),
        (change("a = 325.0", ""), ["'shoulder'", "a is missing", "a = 0.0"]),
        (change("a = 325.0", "a = nan"), ["'shoulder'", "a = nan", "finite"]),
        (change("a = 325.0", "a = true"), ["'shoulder'", "a = True", "finite"]),
        (change("a = 325.0", 'a = "325"'), ["'shoulder'", "a = '325'", "finite"]),
        (change("a = 325.0", f"a = 1{'0' * 400}"), ["'shoulder'", "finite"]),
        (change("a = 325.0", f"a = 1{'0' * 5000}"), ["not TOML"]),
        (change("a = 325.0", "a = 3.25e9"), ["'shoulder'", "a is 3.25e+06 m", "unit"]),
        (change("upper = 0.0", "upper = nan"), ["'lift'", "upper = nan", "finite"]),
        (change("upper = 0.0", "upper = -300.0"), ["'lift'", "lower is above upper", "swap"]),
        (change('"prismatic"', '"linear"'), ["'lift'", "'linear'", '"revolute", "prismatic"']),
        (change('name = "lift"', 'name = "shoulder"'), ["occurs twice", "shoulder"]),
        (change('name = "lift"', "name = 3"), ["3", "quotes"]),
        (change('name = "lift"', 'name = "a,b"'), ["'a,b'", "rename"]),
        (change("[units]", "[units"), ["not TOML", "line 2"]),
        (change("[units]", "base = 3\n[units]"), ["[base]: 3 is not a table"]),
        (change("[units]", 'base = {xyz_m = ["1", "2", "3"]}\n[units]'), ["[base]", "xyz_m"]),
        (change("[units]", "tool = {xyz_m = [0, 0, nan]}\n[units]"), ["[tool]", "xyz_m"]),
        (change("[units]", "tool = {xyz = [0, 0, 1]}\n[units]"), ["[tool]", "unknown key 'xyz'", "xyz_m"]),
        (change(SCARA[SCARA.index("[[joint]]") :], ""), ["no [[joint]]"]),
        (change(SCARA[SCARA.index("[[joint]]") :], "[joint]\n"), ["no [[joint]]"]),
    ],
    ids=lambda value: str(value)[:40],
)
def test_a_wrong_dh_toml_is_refused_in_words(tmp_path, edit, words):
    path = write(tmp_path, "arm.dh.toml", SCARA.replace(*edit, 1))
    with pytest.raises(DhcalError) as caught:
        read_dh(path)
    assert str(caught.value).startswith(f"{path}: ")
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("edit", "line", "words"),
    [
        (change("# convention: standard", "# an arm"), None, ["no convention", "# convention: standard"]),
        (change(": standard", ": Craig"), None, ["unknown convention 'Craig'", "# convention: standard"]),
        (change("d[mm]", "d"), 2, ["'d' has no unit", "d[mm]"]),
        (change("d[mm]", "d[deg]"), 2, ["'d' has unit 'deg'", "d[mm]"]),
        (change("d[mm]", "offset[mm]"), 2, ["unknown column 'offset'", "theta"]),
        (change("606.8", "nan"), 3, ["'d'", "'nan' is not a finite number"]),
        (change("606.8", ""), 3, ["'d'", "is empty"]),
        (change("606.8", "606,8"), 3, ["9 values under a header of 8 columns"]),
        (change("606.8", "6e7"), None, ["'shoulder'", "d is 60000 m", "unit"]),
        (change("lift", "shoulder"), None, ["occurs twice"]),
        (change("lift", ""), None, ["joint name ''"]),
        (change("prismatic", "slide"), 4, ["'lift'", "'slide'", "revolute, prismatic"]),
        (change("lower[deg|mm]", "lower[deg]"), 2, ["'lower'", "prismatic", "lower[deg|mm]"]),
        (change("lower[deg|mm]", "lower[mm]"), 2, ["'lower'", "revolute", "lower[deg|mm]"]),
        (change("-130.0", "none"), 3, ["'lower'", "'none'", "empty"]),
        (change("\nshoulder", "\n# base: 0 0 1\nshoulder"), None, ["'# base:' needs six numbers"]),
        (change("\nshoulder", "\n# tool: 0 0 1 0 0 x\nshoulder"), None, ["'# tool:' needs six numbers"]),
        (change("\nshoulder", "\n# tool: 0 0 1 0 0 nan\nshoulder"), None, ["[tool]", "3 numbers"]),
    ],
    ids=lambda value: str(value)[:40],
)
def test_a_wrong_dh_csv_is_refused_in_words(tmp_path, edit, line, words):
    path = write(tmp_path, "arm.dh.csv", SCARA_CSV.replace(*edit, 1))
    with pytest.raises(DhcalError) as caught:
        read_dh(path)
    assert str(caught.value).startswith(f"{path}:{line}: " if line else f"{path}: ")
    for word in words:
        assert word in str(caught.value)


def test_a_dh_csv_needs_all_four_columns(tmp_path):
    lines = SCARA_CSV.splitlines()
    for gone, name in ((2, "theta"), (3, "d"), (4, "a"), (5, "alpha"), (0, "joint"), (1, "type")):
        cut = [",".join(line.split(",")[:gone] + line.split(",")[gone + 1 :]) for line in lines[1:]]
        with pytest.raises(
            DhcalError, match=rf"a\.csv:2: column '{name}' is missing; write joint,type,theta"
        ):
            read_dh(write(tmp_path, "a.csv", "\n".join([lines[0], *cut])))


def test_a_name_that_no_table_can_hold_is_not_written(tmp_path):
    table = read_dh(write(tmp_path, "a.dh.toml", SCARA))
    for name in ("a,b", "a[b]", "#1", 'say "x"', " a", "a\nb", ""):
        with pytest.raises(DhcalError, match="rename the joint"):
            dh_text(replace(table, names=("shoulder", name)), "out.dh.csv")


# --- measurement files -----------------------------------------------------------------------------

HEADER = "shoulder[deg],lift[mm],x[mm],y[mm],z[mm]\n"


def test_readings_come_in_si_and_in_the_file_s_order(tmp_path):
    text = "# FARO\n\n" + HEADER + "90,-100,606.8,1,2\n\n# pause\n45,0,3,4,5\n"
    readings = read_measurement_file(write(tmp_path, "a.csv", text), scara(tmp_path))
    assert readings.data.q.tolist() == [[np.pi / 2, -0.1], [np.pi / 4, 0.0]]
    assert readings.data.positions().tolist() == [[0.6068, 0.001, 0.002], [0.003, 0.004, 0.005]]
    assert readings.data.rows.tolist() == [1, 2]
    assert not readings.data.has_stated_sigma
    assert readings.commanded is None
    assert readings.measured_after is None


@pytest.mark.parametrize(
    ("header", "row"),
    [("x[m],y[m],z[m]", "0.6068,0.001,0.002"), ("z[um],x[cm],y[mm]", "2000,60.68,1")],
)
def test_any_unit_and_order_of_columns(tmp_path, header, row):
    text = f"lift[m],{header},shoulder[mrad]\n-0.1,{row},250\n"
    data = read_measurements(write(tmp_path, "a.csv", text), scara(tmp_path))
    assert data.q.tolist() == [[0.25, -0.1]]
    assert data.positions().tolist() == [[0.6068, 0.001, 0.002]]


def test_bom_and_windows_line_ends(tmp_path):
    text = b"\xef\xbb\xbf" + HEADER.replace("\n", "\r\n").encode() + b"90,0,1,2,3\r\n"
    data = read_measurements(write(tmp_path, "a.csv", text), scara(tmp_path))
    assert data.positions().tolist() == [[0.001, 0.002, 0.003]]


def test_quaternions_and_rotation_vectors_say_the_same(tmp_path):
    # A turn by 120° about (1, 1, 1) takes x to y, y to z, z to x.
    third = 2 * np.pi / 3 / np.sqrt(3)
    cycle = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    chain, head = scara(tmp_path), HEADER.strip()
    for columns, cells in (
        ("qw,qx,qy,qz", "0.5,0.5,0.5,0.5"),
        ("qw,qx,qy,qz", "-0.5,-0.5,-0.5,-0.5"),
        ("qw,qx,qy,qz", "0.5001,0.5001,0.5001,0.5001"),
        ("rx[rad],ry[rad],rz[rad]", f"{third},{third},{third}"),
        ("rx[deg],ry[deg],rz[deg]", ",".join([f"{120 / np.sqrt(3)}"] * 3)),
    ):
        text = f"{head},{columns}\n0,0,1,2,3,{cells}\n"
        data = read_measurements(write(tmp_path, "a.csv", text), chain)
        np.testing.assert_allclose(data.rotations()[0], cycle, atol=1e-15)


def test_sigmas_and_sets_and_commanded_positions(tmp_path):
    text = (
        HEADER.strip()
        + ",sigma_x[um],sigma_y[um],sigma_z[um],set,pose_id,commanded_x[mm],commanded_y[mm],commanded_z[mm]\n"
        + "0,0,1,2,3,10,20,30,fit,a,7,8,9\n90,0,1,2,3,10,20,40,holdout,b,7,8,9\n"
    )
    readings = read_measurement_file(write(tmp_path, "a.csv", text), scara(tmp_path))
    assert isinstance(readings.data, Position)
    assert readings.data.has_stated_sigma
    assert readings.data.sigma.tolist() == [[1e-5, 2e-5, 3e-5], [1e-5, 2e-5, 4e-5]]
    assert readings.fit.rows.tolist() == [1]
    assert readings.holdout.rows.tolist() == [2]
    assert readings.holdout.q[0, 0] == np.pi / 2
    assert readings.commanded is not None
    assert readings.commanded.tolist() == [[0.007, 0.008, 0.009]] * 2


def doubles(limit):
    return st.floats(-limit, limit)


@settings(max_examples=80, deadline=None)
@given(rows=st.lists(st.lists(doubles(1e3), min_size=5, max_size=5), min_size=1, max_size=4), data=st.data())
def test_positions_are_written_to_the_last_digit(tmp_path_factory, rows, data):
    folder, rows = tmp_path_factory.mktemp("csv"), np.array(rows)
    chain = scara(folder)
    sigma = data.draw(st.one_of(st.none(), st.floats(1e-9, 1.0)))
    wrote = Position(rows[:, :2], rows[:, 2:], sigma)
    again = read_measurements(write(folder, "a.csv", measurement_text(wrote, chain, ["a", "b"])), chain)
    assert isinstance(again, Position)
    assert again.q.tolist() == wrote.q.tolist()
    assert again.values.tolist() == wrote.values.tolist()
    assert again.has_stated_sigma == (sigma is not None)
    assert again.sigma.tolist() == wrote.sigma.tolist()


@settings(max_examples=80, deadline=None)
@given(
    rows=st.lists(st.lists(doubles(1e3), min_size=5, max_size=5), min_size=1, max_size=4),
    axis=st.lists(doubles(1.0), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1),
    angle=st.one_of(st.floats(0, np.pi), st.sampled_from([0.0, 1e-12, np.pi / 2, np.pi - 1e-9, np.pi])),
)
def test_poses_keep_their_rotation(tmp_path_factory, rows, axis, angle):
    folder, rows = tmp_path_factory.mktemp("csv"), np.array(rows)
    chain = scara(folder)
    turn = se3.exp3(angle * np.array(axis) / np.linalg.norm(axis))
    poses = se3.transform(np.tile(turn, (len(rows), 1, 1)), rows[:, 2:])
    wrote = Pose(rows[:, :2], poses, 1e-4, 1e-5)
    again = read_measurements(write(folder, "a.csv", measurement_text(wrote, chain)), chain)
    assert isinstance(again, Pose)
    assert again.q.tolist() == wrote.q.tolist()
    assert again.positions().tolist() == rows[:, 2:].tolist()
    # Rounding of the rotation handed in is up to 1e-15 by itself.
    np.testing.assert_allclose(again.rotations(), wrote.rotations(), rtol=0, atol=2e-15)
    assert again.rotation_sigma.tolist() == wrote.rotation_sigma.tolist()


def test_a_joint_named_like_a_reading_is_refused(tmp_path):
    gantry = Chain.from_dh(read_dh(write(tmp_path, "g.dh.toml", SCARA.replace('"lift"', '"x"'))))
    for act in (
        lambda: read_measurement_file(write(tmp_path, "a.csv", HEADER + "0,0,1,2,3\n"), gantry),
        lambda: measurement_text(Position(np.zeros((1, 2)), np.zeros((1, 3))), gantry),
    ):
        with pytest.raises(DhcalError, match="'x' has the name of a measurement column; rename"):
            act()


def test_a_stray_quote_stays_in_its_row(tmp_path):
    path = write(tmp_path, "a.csv", 'a,b\n1,2\n"3,4\n5,6\n')
    with pytest.raises(DhcalError, match=r"a\.csv:3: 1 values under a header of 2 columns"):
        read_csv_table(path)


def test_a_cell_beyond_all_bounds_is_a_message(tmp_path):
    with pytest.raises(DhcalError, match=r"a\.csv:2: not comma-separated text"):
        read_csv_table(write(tmp_path, "a.csv", f"a,b\n1,{'2' * 200_000}\n"))


# --- noise, priors, TOML ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "metres", "radians"),
    [
        ("0.1mm", 1e-4, 0.0),
        ("0.1 mm , 0.01deg", 1e-4, 0.01 * np.pi / 180),
        ("2mrad,50um", 5e-5, 2e-3),
        ("5µm", 5e-6, 0.0),
        ("0mm", 0.0, 0.0),
    ],
)
def test_noise(text, metres, radians):
    assert parse_noise(text) == pytest.approx((metres, radians), rel=1e-15, abs=0)


@pytest.mark.parametrize("text", ["", "0.1", "mm", "0.1inch", "-1mm", "1-2mm", "nanmm", "1e999mm", "1mm,2um"])
def test_wrong_noise(text):
    with pytest.raises(DhcalError, match="noise"):
        parse_noise(text)


def test_endless_toml_is_a_message(tmp_path):
    with pytest.raises(DhcalError, match="not TOML"):
        read_toml(write(tmp_path, "a.toml", "a = " + "[" * 100_000))


def test_priors_by_name(tmp_path):
    path = write(tmp_path, "p.toml", 'd1 = 0.002\n"theta*" = 1\n')
    assert read_priors(str(path)) == {"d1": 0.002, "theta*": 1.0}
    assert (read_priors(None), read_priors("none"), read_priors("default")) == (None, "none", "default")


# --- writing ---------------------------------------------------------------------------------------


def test_all_files_are_written(tmp_path):
    write_files({tmp_path / "a": "ä", str(tmp_path / "b"): b"\xff"})
    assert (tmp_path / "a").read_bytes() == "ä".encode()
    assert (tmp_path / "b").read_bytes() == b"\xff"
    assert sorted(os.listdir(tmp_path)) == ["a", "b"]


def test_a_written_file_has_the_usual_rights(tmp_path):
    (tmp_path / "usual").touch()
    write_files({tmp_path / "a": ""})
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_what_a_link_leads_to_is_written_and_keeps_its_rights(tmp_path):
    """So a robot behind a link is calibrated in place where it is, and no more people may read it."""
    (tmp_path / "far").mkdir()
    real, link = write(tmp_path / "far", "real", "old"), tmp_path / "link"
    real.chmod(0o600)
    link.symlink_to(real)
    write_files({link: "new"})
    assert link.is_symlink()
    assert real.read_text() == "new"
    assert real.stat().st_mode & 0o777 == 0o600
    assert sorted(os.listdir(tmp_path / "far")) == ["real"]


@pytest.mark.parametrize(
    ("bad", "words"), [("none/b", "make it first"), ("folder", "name a file in it"), ("a/b", "make it first")]
)
def test_a_second_file_that_cannot_be_leaves_nothing_of_the_first(tmp_path, bad, words):
    (tmp_path / "folder").mkdir()
    before = sorted(os.listdir(tmp_path))
    with pytest.raises(DhcalError, match=f"{bad}: .*{words}"):
        write_files({tmp_path / "a": "new", tmp_path / bad: "new"})
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failing_rename_brings_back_what_was_there(tmp_path, monkeypatch, error):
    write(tmp_path, "a", "old")
    rename, places = os.replace, []

    def failing(source, target):
        places.append(target)
        if len(places) == 3:
            raise error
        rename(source, target)

    monkeypatch.setattr(os, "replace", failing)
    with pytest.raises(DhcalError if isinstance(error, OSError) else KeyboardInterrupt):
        write_files({tmp_path / "a": "new", tmp_path / "b": "new", tmp_path / "c": "new"})
    assert places[:3] == [str((tmp_path / name).resolve()) for name in "abc"]
    assert os.listdir(tmp_path) == ["a"]
    assert (tmp_path / "a").read_text() == "old"


def test_without_links_a_copy_is_kept(tmp_path, monkeypatch):
    def none(*_):
        raise PermissionError(1, "no links here")

    monkeypatch.setattr(os, "link", none)
    write(tmp_path, "a", "old")
    write_files({tmp_path / "a": "new"})
    assert os.listdir(tmp_path) == ["a"]
    assert (tmp_path / "a").read_text() == "new"


def test_a_reader_never_sees_half_a_file(tmp_path):
    write(tmp_path, "a", "old")
    with open(tmp_path / "a") as reader:
        write_files({tmp_path / "a": "new"})
        assert reader.read() == "old"
    assert (tmp_path / "a").read_text() == "new"


def test_a_place_in_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    require_writable("a.urdf")
    with pytest.raises(DhcalError, match="no folder sub; make it first"):
        require_writable("sub/a.urdf")


def test_json_has_no_nan_and_any_file_name(tmp_path):
    text = json_text({"a": [float("nan"), -float("inf"), 1.5], "name": os.fsdecode(b"\xff.csv"), "°": True})

    def never(name):
        raise AssertionError(name)

    content = json.loads(text.encode(), parse_constant=never)
    assert content == {"a": [None, None, 1.5], "name": "\udcff.csv", "°": True}


# --- sidecars --------------------------------------------------------------------------------------


def test_base_and_tool_come_back_from_the_sidecar(tmp_path):
    rng = np.random.default_rng(0)
    arm = scara(tmp_path)
    placed = replace(arm, base=se3.exp6(rng.normal(size=6)), tool=se3.exp6(rng.normal(size=6)))
    write_urdf(placed, tmp_path / "out.urdf")
    q = rng.uniform(-1, 1, (20, 2))
    np.testing.assert_allclose(read_robot(tmp_path / "out.urdf").poses(q), placed.poses(q), atol=1e-12)


def test_an_old_sidecar_does_not_outlive_its_robot(tmp_path):
    arm = scara(tmp_path)
    assert list(urdf_files(arm, tmp_path / "out.urdf")) == [tmp_path / "out.urdf"]
    base = np.eye(4)
    base[:3, 3] = 1.0, 2.0, 3.0
    write_urdf(replace(arm, base=base), tmp_path / "out.urdf")
    side = tmp_path / "out.calibration.toml"
    assert tomllib.loads(side.read_text())["base"]["xyz_m"] == [1.0, 2.0, 3.0]
    write_urdf(arm, tmp_path / "out.urdf")
    assert tomllib.loads(side.read_text())["base"]["xyz_m"] == [0.0, 0.0, 0.0]
    np.testing.assert_array_equal(read_robot(tmp_path / "out.urdf").base, np.eye(4))


@pytest.mark.parametrize(
    ("text", "words"),
    [("[gripper]\n", "gripper"), ("base = 1\n", "is not a table"), ("[tool]\nxyz_m = [1, 2]\n", "3 numbers")],
)
def test_a_wrong_sidecar_is_refused(tmp_path, text, words):
    write_urdf(scara(tmp_path), tmp_path / "arm.urdf")
    path = write(tmp_path, "arm.calibration.toml", text)
    with pytest.raises(DhcalError, match=words) as caught:
        read_robot(tmp_path / "arm.urdf")
    assert str(path) in str(caught.value)


def test_sidecar_text_is_toml(tmp_path):
    text = sidecar_text(replace(scara(tmp_path), tip='a "b"'), np.eye(4), required=True)
    assert text is not None
    assert set(tomllib.loads(text)) == {"tip", "base", "tool"}
