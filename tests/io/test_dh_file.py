"""DH files: units, digits, and errors that name the problem."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import SCARA, write

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import dh_text, read_dh, read_measurements, read_robot
from dhcal_pin.robot import DHTable

TABLE = ("theta", "d", "a", "alpha", "beta", "lower", "upper")
SCARA_CSV = """# convention: standard
joint, type, theta[deg], d[mm], a[mm], alpha[deg], lower[deg|mm], upper[deg|mm]
shoulder, revolute, 0, 606.8, 325.0, 0.0, -130.0,
lift, prismatic, 30.0, 12.5, 0.25, 180.0, -210.0, 0.0
"""


@pytest.mark.parametrize(("name", "text"), [("arm.dh.toml", SCARA), ("arm.dh.csv", SCARA_CSV)])
def test_entries_are_converted_from_the_units_of_the_file(tmp_path, name, text):
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


def test_messages_on_the_robot_of_a_table_name_its_file(tmp_path):
    path = write(tmp_path, "arm.dh.toml", SCARA.replace('"lift"', '"z"'))
    assert read_robot(path).urdf.source == str(path)
    with pytest.raises(DhcalError, match=r"arm\.dh\.toml: joint 'z' has the name of a measurement column"):
        read_measurements(write(tmp_path, "m.csv", "shoulder,z,x,y,z\n"), read_robot(path))


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
    """Random tables: conventions, joint types, poses, limits on one side, names in any script."""
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
        types = draw(
            st.lists(st.sampled_from(("revolute", "prismatic", "continuous")), min_size=n, max_size=n)
        )
        is_continuous = np.array(types) == "continuous"
        return DHTable(
            draw(st.sampled_from(("standard", "modified"))),
            tuple(names),
            np.array(types) == "prismatic",
            continuous=is_continuous,
            **{key: draw(column) for key in ("theta", "d", "a", "alpha")},
            beta=draw(st.one_of(st.just(np.zeros(n)), column)),
            lower=np.where(is_continuous, -np.inf, [-np.inf if x is None else -x for x in sides[0]]),
            upper=np.where(is_continuous, np.inf, [np.inf if x is None else x for x in sides[1]]),
            **{key: draw(st.one_of(st.just(np.eye(4)), frame)) for key in ("base", "tool")},
        )

    return build()


@settings(max_examples=60, deadline=None)
@given(table=tables())
def test_written_files_read_back_bit_identical(tmp_path_factory, table):
    folder = tmp_path_factory.mktemp("dh")
    for name in ("arm.dh.toml", "arm.dh.csv"):
        again = read_dh(write(folder, name, dh_text(table, folder / name)))
        assert (again.convention, again.names) == (table.convention, table.names)
        assert again.joint_types == table.joint_types
        for key in TABLE:
            assert getattr(again, key).tolist() == getattr(table, key).tolist(), key
        for key in ("base", "tool"):
            assert getattr(again, key)[:3, 3].tolist() == getattr(table, key)[:3, 3].tolist()
            np.testing.assert_allclose(getattr(again, key), getattr(table, key), atol=3e-15)


def change(old: str, new: str) -> tuple[str, str]:
    """Return a replacement, after a check that there is something to replace."""
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
        (
            change("[[joint]]", "[[joint]]\ntheta = 0\nd = 1\na = 1\nalpha = 0\n" * 249 + "[[joint]]"),
            ["251 joints, more than 250"],
        ),
        (change("a = 325.0", "a = 3.25e9"), ["'shoulder'", "a is 3.25e+06 m", "unit"]),
        (change('angle = "deg"', 'angle = "rad"'), ["'lift'", "theta is 30 rad, more than two turns"]),
        (change("upper = 0.0", "upper = nan"), ["'lift'", "upper = nan", "finite"]),
        (change("upper = 0.0", "upper = -300.0"), ["'lift'", "lower is above upper", "swap"]),
        (change('"prismatic"', '"linear"'), ["'lift'", "'linear'", '"revolute", "prismatic"']),
        (change('"prismatic"', '"continuous"'), ["'lift'", "continuous joint has limits", "revolute"]),
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
def test_invalid_toml_files_raise_an_error_that_names_the_problem(tmp_path, edit, words):
    path = write(tmp_path, "arm.dh.toml", SCARA.replace(edit[0], edit[1], 1))
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
        (change("theta[deg], d[mm]", "theta, d"), 2, ["'theta' has no unit", "without a unit, too: 'd'"]),
        (change("d[mm]", "d[deg]"), 2, ["'d' has unit 'deg'", "d[mm]"]),
        (change("d[mm]", "offset[mm]"), 2, ["unknown column 'offset'", "theta"]),
        (change("606.8", "nan"), 3, ["'d'", "'nan' is not a finite number"]),
        (change("606.8", ""), 3, ["'d'", "is empty"]),
        (change("606.8", "606,8"), 3, ["9 values for 8 columns", "decimal commas need semicolons"]),
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
def test_invalid_csv_files_raise_an_error_that_names_the_problem(tmp_path, edit, line, words):
    path = write(tmp_path, "arm.dh.csv", SCARA_CSV.replace(edit[0], edit[1], 1))
    with pytest.raises(DhcalError) as caught:
        read_dh(path)
    assert str(caught.value).startswith(f"{path}:{line}: " if line else f"{path}: ")
    for word in words:
        assert word in str(caught.value)


def test_the_convention_of_a_csv_file_has_any_case(tmp_path):
    text = SCARA_CSV.replace(": standard", ": Standard")
    assert text != SCARA_CSV
    assert read_dh(write(tmp_path, "arm.dh.csv", text)).convention == "standard"


@pytest.mark.parametrize("rows", ["", "1,2,3\n4,5,6\n"])
def test_a_csv_file_without_a_header_is_answered_with_that_of_a_dh_table(tmp_path, rows):
    with pytest.raises(DhcalError, match=r"such as joint,type,theta\[deg\],d\[mm\],a\[mm\],alpha\[deg\]"):
        read_dh(write(tmp_path, "arm.dh.csv", "# convention: standard\n" + rows))


def test_csv_files_need_all_required_columns(tmp_path):
    lines = SCARA_CSV.splitlines()
    for gone, name in ((2, "theta"), (3, "d"), (4, "a"), (5, "alpha"), (0, "joint"), (1, "type")):
        cut = [",".join(line.split(",")[:gone] + line.split(",")[gone + 1 :]) for line in lines[1:]]
        with pytest.raises(
            DhcalError, match=rf"a\.csv:2: column '{name}' is missing; write joint,type,theta"
        ):
            read_dh(write(tmp_path, "a.csv", "\n".join([lines[0], *cut])))


def test_joint_names_that_cannot_be_headers_are_not_written(tmp_path):
    table = read_dh(write(tmp_path, "a.dh.toml", SCARA))
    for name in ("a,b", "a[b]", "#1", 'say "x"', " a", "a\nb", ""):
        with pytest.raises(DhcalError, match="rename the joint"):
            dh_text(replace(table, names=("shoulder", name)), "out.dh.csv")
