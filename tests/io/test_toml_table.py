"""Tables of TOML files: types, ranges, and errors that name file, table, key and expected value."""

import pytest
from robots import write

from dhcal_pin.exceptions import FileFormatError
from dhcal_pin.io import TomlTable
from dhcal_pin.io import toml_table as toml

TEXT = """
number = 2
name = "arm"
count = 3
flag = true
vector = [1, 2.5, -3]
[outer.inner]
key = 1
[[job]]
robot = "a"
[[job]]
robot = "b"
"""


@pytest.fixture
def table(tmp_path) -> TomlTable:
    return TomlTable.read(write(tmp_path, "t.toml", TEXT))


def test_values_have_the_type_that_was_asked_for(table):
    inner = toml.table_of({"key": toml.number()})
    keys = {
        "number": toml.number(0, 2),
        "name": toml.choice(["arm", "leg"]),
        "count": toml.whole(1, 3),
        "flag": toml.flag(False),
        "vector": toml.vector(3),
        "outer": toml.table_by_name(inner),
        "job": toml.Key(),
    }
    jobs = table.tables("job", expected="")
    assert [job.values({"robot": toml.text()}) for job in jobs] == [{"robot": "a"}, {"robot": "b"}]
    assert toml.list_of(toml.number(), 3).read(table, "vector") == [1.0, 2.5, -3.0]
    values = table.values(keys)
    assert [type(values[key]) for key in ("number", "count")] == [float, int]
    assert list(values.values())[:-1] == [2.0, "arm", 3, True, [1.0, 2.5, -3.0], {"inner": {"key": 1.0}}]


def test_absent_keys_have_their_default(table):
    keys = {
        "x": toml.number(default=1.5),
        "y": toml.text(default=""),
        "z": toml.flag(False),
        "v": toml.vector(2, default=(0.0, 1.0)),
        "l": toml.list_of(toml.number(), default=()),
        "o": toml.table_of({"key": toml.number()}),
        "n": toml.table_by_name(toml.number()),
    }
    assert list(table.some_values(keys).values()) == [1.5, "", False, [0.0, 1.0], [], None, {}]
    assert table.table("t").keys() == []
    assert "x" not in table


@pytest.mark.parametrize(
    ("declared", "key", "message"),
    [
        (toml.number(), "name", "name = 'arm'; expected a finite number"),
        (toml.number(), "flag", "flag = True; expected a finite number"),
        (toml.number(above=2), "number", "number = 2; expected a number above 2"),
        (toml.number(3), "number", "number = 2; expected a number of at least 3"),
        (toml.number(at_most=1), "number", "number = 2; expected a number of at most 1"),
        (toml.number(), "x", "x is missing; expected a finite number; the keys given are number, name"),
        (toml.number(), "numbr", "unknown key 'number'; did you mean 'numbr'?"),
        (toml.text(), "count", "count = 3; expected a text in quotes"),
        (toml.text("a letter", "[a-z]"), "name", "name = 'arm'; expected a letter"),
        (toml.whole(1, 9), "flag", "flag = True; expected a whole number from 1 to 9"),
        (toml.whole(5, 9), "count", "count = 3; expected a whole number from 5 to 9"),
        (toml.flag(False), "count", "count = 3; expected true or false"),
        (toml.choice(["left", "right"]), "name", 'name = \'arm\'; choose from "left", "right"'),
        (toml.choice(["left", "right"]), "x", 'x is missing; expected one of "left", "right"'),
        (toml.vector(2), "vector", "vector = [1, 2.5, -3]; expected 2 numbers, such as [0.0, 0.0]"),
        (toml.vector(3, 2), "vector", "expected 3 numbers up to ±2"),
        (toml.list_of(toml.Key(), 2), "vector", "vector has 3 entries; expected 2"),
        (toml.list_of(toml.number(0)), "vector", "vector has the entry -3; expected a number of at least 0"),
        (toml.list_of(toml.Key()), "name", "name = 'arm'; expected a list in brackets"),
        (toml.table_of({}), "name", "[name]: 'arm' is not a table"),
        (toml.table_of({}, is_optional=False), "x", "x is missing; expected a table [x]"),
        (
            toml.table_of({"inner": toml.table_of({"key": toml.text()})}),
            "outer",
            "[outer.inner]: key = 1; expected a text",
        ),
        (
            toml.table_by_name(toml.table_of({"gain": toml.number()})),
            "outer",
            "[outer.inner]: gain is missing",
        ),
    ],
)
def test_errors_name_file_table_key_and_expected_value(table, declared, key, message):
    with pytest.raises(FileFormatError) as caught:
        declared.read(table, key)
    assert str(caught.value).startswith(f"{table.path}: ")
    assert message in str(caught.value)


def test_errors_of_arrays_of_tables(table):
    with pytest.raises(FileFormatError, match=r"no \[\[outer\]\] table; write one per arm"):
        table.tables("outer", expected="one per arm")
    second = table.tables("job", expected="")[1]
    with pytest.raises(FileFormatError, match="job 2: robot = 'b'; expected a finite number"):
        second.values({"robot": toml.number()})


def test_unknown_keys_are_an_error_at_the_end(table):
    inner = table.table("outer").table("inner")
    with pytest.raises(
        FileFormatError, match=r"\[outer\.inner\]: unknown key 'key'; choose from gain, offset$"
    ):
        inner.values({"gain": toml.number(default=0.0), "offset": toml.number(default=0.0)})
