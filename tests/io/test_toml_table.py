"""Tables of TOML files: types, ranges, and errors that name file, table, key and expected value."""

from __future__ import annotations

import pytest
from robots import write

from dhcal_pin.exceptions import FileFormatError
from dhcal_pin.io import TomlTable

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
    number = table.number("number", at_least=0, at_most=2)
    assert (number, type(number)) == (2.0, float)
    assert table.text("name") == "arm"
    assert table.choice("name", ["arm", "leg"]) == "arm"
    assert table.value("count", int) == 3
    assert table.value("flag", bool) is True
    assert table.vector("vector", 3) == [1.0, 2.5, -3.0]
    assert table.array("vector", size=3) == [1, 2.5, -3]
    assert table.table("outer").table("inner").number("key") == 1.0
    assert [job.text("robot") for job in table.tables("job", expected="")] == ["a", "b"]
    table.finish()


def test_absent_keys_have_their_default(table):
    assert table.number("x", 1.5) == 1.5
    assert table.text("y", "") == ""
    assert table.value("z", bool, False) is False
    assert table.vector("v", 2, (0.0, 1.0)) == [0.0, 1.0]
    assert table.table("t").keys() == []
    assert "x" not in table


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda t: t.number("name"), "name = 'arm'; expected a finite number"),
        (lambda t: t.number("flag"), "flag = True; expected a finite number"),
        (lambda t: t.number("number", above=2), "number = 2; expected a number above 2"),
        (lambda t: t.number("number", at_least=3), "number = 2; expected a number of at least 3"),
        (lambda t: t.number("number", at_most=1), "number = 2; expected a number of at most 1"),
        (lambda t: t.number("x"), "x is missing; expected a finite number; the keys given are number, name"),
        (lambda t: t.number("numbr"), "unknown key 'number'; did you mean 'numbr'?"),
        (lambda t: t.text("count"), "count = 3; expected a text in quotes"),
        (lambda t: t.value("flag", int), "flag = True; expected a whole number"),
        (lambda t: t.value("count", bool), "count = 3; expected true or false"),
        (lambda t: t.choice("name", ["left", "right"]), 'name = \'arm\'; choose from "left", "right"'),
        (lambda t: t.vector("vector", 2), "vector = [1, 2.5, -3]; expected 2 numbers, such as [0.0, 0.0]"),
        (lambda t: t.vector("vector", 3, at_most=2), "expected 3 numbers up to ±2"),
        (lambda t: t.array("vector", size=2), "vector has 3 entries; expected 2"),
        (lambda t: t.array("name"), "name = 'arm'; expected a list in brackets"),
        (lambda t: t.table("name"), "[name]: 'arm' is not a table"),
        (lambda t: t.table("outer").table("inner").text("key"), "[outer.inner]: key = 1; expected a text"),
        (lambda t: t.tables("outer", expected="one per arm"), "no [[outer]] table; write one per arm"),
        (lambda t: t.tables("job", expected="")[1].number("robot"), "job 2: robot = 'b'; expected a finite"),
    ],
)
def test_errors_name_file_table_key_and_expected_value(table, ask, message):
    with pytest.raises(FileFormatError) as caught:
        ask(table)
    assert str(caught.value).startswith(f"{table.path}: ")
    assert message in str(caught.value)


def test_unknown_keys_are_an_error_at_the_end(table):
    inner = table.table("outer").table("inner")
    inner.number("gain", 0.0)
    inner.number("offset", 0.0)
    with pytest.raises(
        FileFormatError, match=r"\[outer\.inner\]: unknown key 'key'; choose from gain, offset$"
    ):
        inner.finish()
