"""Text files: CSV tables and TOML."""

import csv
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import SCARA, write

from dhcal_pin.exceptions import DhcalError, FileFormatError, UnknownNameError
from dhcal_pin.formatting import format_lines
from dhcal_pin.io import read_dh, read_measurements, read_toml
from dhcal_pin.io.tables import DataTable, TextLayout, read_table
from dhcal_pin.io.tables import table as tables
from dhcal_pin.io.tabular import csv_text, require_usable_names
from dhcal_pin.robot import Chain


def test_an_unbalanced_quote_affects_its_row_only(tmp_path):
    path = write(tmp_path, "a.csv", 'a,b\n1,2\n"3,4\n5,6\n')
    with pytest.raises(DhcalError, match=r"a\.csv:3: 1 value for 2 columns"):
        read_table(path).require_good_rows()


def test_a_cell_that_is_too_long_is_an_error(tmp_path):
    with pytest.raises(DhcalError, match=r"a\.csv:2: not text separated by commas"):
        read_table(write(tmp_path, "a.csv", f"a,b\n1,{'2' * 200_000}\n")).require_good_rows()


def test_deeply_nested_toml_is_an_error(tmp_path):
    with pytest.raises(DhcalError, match="not TOML"):
        read_toml(write(tmp_path, "a.toml", "a = " + "[" * 100_000))


@pytest.mark.parametrize("text", ["=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(A1)", " =1", "\t=1", "\r=1"])
def test_a_text_is_no_formula_of_a_spreadsheet(text):
    rows = list(csv.reader(csv_text({"a": [text], "b": ["-1.5"], "c": [-2.5]}).splitlines()[1:]))
    cell = " ".join(",".join(rows[0]).split())
    assert cell.startswith("'")
    assert csv_text({"b": ["-1.5", "+2e5"], "c": [-2.5, None]}) == "b,c\n-1.5,-2.5\n+2e5,\n"


def test_a_comment_is_one_line():
    assert csv_text({"a": [1]}, ["b\nc,\r\u2028d"]) == "# b\\nc,\\r\\u2028d\na\n1\n"


def test_the_sheet_with_numbers_is_read(tmp_path):
    workbook = pytest.importorskip("openpyxl").Workbook()
    workbook.active.title = "Info"
    workbook.active.append(["Date", "2026-01-02"])
    workbook.active.append(["Operator", "A. B."])
    for title, numbers in (("Data", [1, 2.5, 3]), ("Other", [4, 5, 6])):
        sheet = workbook.create_sheet(title)
        sheet.append(["a", "b", "c"])
        sheet.append(numbers)
    workbook.save(tmp_path / "a.xlsx")
    table = read_table(tmp_path / "a.xlsx")
    assert table.headers == ("a", "b", "c")
    assert table.notes == ("sheet 'Data' was read, not 'Info', 'Other'",)
    other = read_table(tmp_path / "a.xlsx", TextLayout(sheet="Other"))
    assert other.values(1).tolist() == [5]
    with pytest.raises(UnknownNameError, match=r"a\.xlsx: no sheet 'data' .*'Info', 'Data', 'Other'"):
        read_table(tmp_path / "a.xlsx", TextLayout(sheet="data"))


def test_the_sheet_with_the_most_known_columns_or_rows_is_read_and_errors_name_the_others(tmp_path):
    workbook = pytest.importorskip("openpyxl").Workbook()
    workbook.active.title = "Info"
    workbook.active.append(["Temperature", 21.5, 20.3, 19.1])
    workbook.active.append(["Remark"])
    sheet = workbook.create_sheet("Data")
    for row in (["a", "b", "c"], [1, 2, 3], [4, 5, 6]):
        sheet.append(row)
    workbook.save(tmp_path / "a.xlsx")
    assert read_table(tmp_path / "a.xlsx").headers == ("a", "b", "c")
    arm = Chain.from_dh(read_dh(write(tmp_path, "scara.dh.toml", SCARA)))
    chosen = read_table(tmp_path / "a.xlsx", TextLayout(names={"Temperature"}))
    assert chosen.headers == ("Temperature", "21.5", "20.3", "19.1")
    with pytest.raises(FileFormatError, match=r"a\.xlsx:1: .*; sheet 'Info' was read, not 'Data'$"):
        read_measurements(tmp_path / "a.xlsx", arm, sheet="Info")


@pytest.mark.parametrize("units", ["deg,mm,-", "[deg],(mm),", "deg,mm"])
def test_a_row_of_units_is_understood_as_in_the_header(tmp_path, units):
    table = read_table(write(tmp_path, "a.csv", f"q,x,n\n{units}\n1,2,3\n4,5,6\n"))
    assert {name: column.unit for name, column in table.columns.items()} == {"q": "deg", "x": "mm", "n": ""}
    assert (table.values(1).tolist(), table.lines) == ([2, 5], [3, 4])


def test_indices_in_headers_are_no_units(tmp_path):
    header = "name[0],name[1],q[0].position[rad],x [mm],a [°],b[º]"
    table = read_table(write(tmp_path, "a.csv", f"{header}\n1,2,3,4,5,6\n"))
    assert {name: column.unit for name, column in table.columns.items()} == {
        **{"name[0]": "", "name[1]": "", "q[0].position": "rad"},
        **{"x": "mm", "a": "deg", "b": "deg"},
    }
    assert [table.column_label(i) for i in (1, 2, 3)] == [
        *("column 'name[1]'", "column 'q[0].position'", "column 'x'")
    ]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("Tracker export;;\n# c\nJob: UR10\n\nP,J1,J2,x\nP1,1,2,3\n", 5),
        ("UR10;7;8\nJ1;J2;x\ndeg;deg;mm\n1,5;2;1.003,5\n", 2),
        ("J1,J2,x\n1,2,3\n", 0),
        ("J1,J2,x,note\n1,2,,lost\nlost,lost,lost,lost\n1,2,3,\n", 3),
        ("a,b\n1,2\n3,4\n", 0),
        ("1,2,3\n4,5,6\n", 0),
    ],
)
def test_a_header_below_titles_is_found(tmp_path, text, line):
    below = read_table(write(tmp_path, "a.csv", text)).below_titles
    assert (below.header_line if below else 0) == line
    if below:
        assert below.bad_rows == {}


def test_units_of_two_places_must_agree(tmp_path):
    table = read_table(write(tmp_path, "a.csv", "q[deg],x[mm]\ndeg,mm\n1,2\n"))
    assert [column.unit for column in table.columns.values()] == ["deg", "mm"]
    with pytest.raises(
        DhcalError, match=r"a\.csv:1: column 'x' has unit 'mm' in the header and 'm' in the row"
    ):
        _ = read_table(write(tmp_path, "a.csv", "q[deg],x[mm]\ndeg,m\n1,2\n")).columns


def test_a_thinned_table_has_rows_of_all_kinds_in_their_order(tmp_path):
    """Every second row would be of one kind only."""
    text = "a,b,c\n" + "".join(f"{i},{2 * i},{'fh'[i % 2]}\n" for i in range(400))
    table = read_table(write(tmp_path, "a.csv", text))
    assert table.thinned(400) is table
    few = table.thinned(200)
    values = few.values(1)
    assert len(values) == 200
    assert np.all(np.diff(values) > 0)
    assert few.lines == (values / 2 + 2).tolist()
    kinds = few.text(few.columns["c"])
    assert kinds == ["fh"[int(value / 2) % 2] for value in values]
    # The number of rows of one kind is hypergeometric, 100 with a standard deviation of 5.
    assert 80 < kinds.count("f") < 120
    assert few.notes == ("200 of 400 rows are used, drawn at random, as more do not improve a calibration",)
    by_columns = DataTable.from_columns(
        "a", {"b": table.values(1), "c": table.text(table.columns["c"])}, table.lines
    )
    assert by_columns.thinned(200).text(by_columns.columns["c"]) == kinds


@pytest.mark.parametrize("row", ["deg,1", "furlong,fathom", "deg,mm\ndeg,mm"])
def test_other_rows_are_not_units(tmp_path, row):
    table = read_table(write(tmp_path, "a.csv", f"q,x\n{row}\n1,2\n"))
    with pytest.raises(DhcalError, match=r"a\.csv:[23]: column 'q': '(deg|furlong)' is not a finite number"):
        table.without_bad_rows([0]).require_good_rows()


@pytest.mark.parametrize("name", ["=1", "+a", "@b", "-c"])
def test_no_joint_name_heads_a_column_as_a_formula(name):
    with pytest.raises(DhcalError, match=r"arm\.urdf: joint name .*rename the joint"):
        require_usable_names([name], "arm.urdf")


def test_spaces_at_the_ends_of_a_joint_name_are_named():
    with pytest.raises(DhcalError, match="without spaces at its ends"):
        require_usable_names([" a b"], "arm.urdf")


# --- detection -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "headers", "numbers", "description"),
    [
        ("a,b\n1,2\n", ("a", "b"), [[1, 2]], "commas"),
        ("a, b, c\n1, 2, 3\n", ("a", "b", "c"), [[1, 2, 3]], "commas"),
        ("X, mm;Y, mm\n1,5;2\n3;4\n", ("X, mm", "Y, mm"), [[1.5, 2], [3, 4]], "semicolons, decimal commas"),
        ("X, mm\tY, mm\n1,5\t2,5\n", ("X, mm", "Y, mm"), [[1.5, 2.5]], "tabs, decimal commas"),
        ("a\tb\n1.5\t2\n", ("a", "b"), [[1.5, 2]], "tabs"),
        ("a   b\tc\n 1  2.5   -3e-2\n", ("a", "b", "c"), [[1, 2.5, -0.03]], "spaces"),
        ('a,b\n"1,5","2,5e-3"\n', ("a", "b"), [[1.5, 0.0025]], "commas, decimal commas"),
        ("a;b\n1,5;2\n,5;-3,\n", ("a", "b"), [[1.5, 2], [0.5, -3]], "semicolons, decimal commas"),
        ("a;b\n1;2\n", ("a", "b"), [[1, 2]], "semicolons"),
        ("a;b\n1.5;2\n", ("a", "b"), [[1.5, 2]], "semicolons"),
        # With points as well, commas are not decimal: the cell is no number.
        ("a;b\n1.5;2,5\n", ("a", "b"), [[1.5, np.nan]], "semicolons"),
        # The other sign separates thousands only before decimals, and in groups of three digits.
        ("a;b\n1.234,5;2,5\n", ("a", "b"), [[1234.5, 2.5]], "semicolons, decimal commas"),
        ("a;b\n-1.234.567,8;1.068\n", ("a", "b"), [[-1234567.8, np.nan]], "semicolons, decimal commas"),
        ("a;b\n2,601.229;-0.5\n", ("a", "b"), [[2601.229, -0.5]], "semicolons"),
        ('a,b\n"2,601.229",1.5\n', ("a", "b"), [[2601.229, 1.5]], "commas"),
        ("a;b\n12.34,5;2,5\n", ("a", "b"), [[np.nan, 2.5]], "semicolons, decimal commas"),
        ("a;b\n0.123,5;2,5\n", ("a", "b"), [[np.nan, 2.5]], "semicolons, decimal commas"),
        ("a,b,c,\n1,2,3,\n4,5,6,\n", ("a", "b", "c"), [[1, 2, 3], [4, 5, 6]], "commas"),
        ("a\n1\n2\n", ("a",), [[1], [2]], "commas"),
        ('a;b\n1;"two; three"\n4;5\n', ("a", "b"), [[1, np.nan], [4, 5]], "semicolons"),
    ],
)
def test_separator_and_decimal_sign_are_detected(tmp_path, text, headers, numbers, description):
    table = read_table(write(tmp_path, "a.csv", text))
    assert (table.headers, table.description, table.bad_rows) == (headers, description, {})
    np.testing.assert_array_equal(np.stack([table.values(i) for i in range(len(headers))], -1), numbers)


@settings(max_examples=150, deadline=None)
@given(
    rows=st.lists(st.lists(st.floats(-1e6, 1e6), min_size=4, max_size=4), min_size=1, max_size=6),
    separator=st.sampled_from([",", ";", "\t", "  "]),
    decimal=st.sampled_from([".", ","]),
    ending=st.sampled_from(["\n", "\r\n"]),
    mark=st.sampled_from(["", "\ufeff"]),
)
def test_numbers_read_back_bit_identical(tmp_path_factory, rows, separator, decimal, ending, mark):
    """Any numbers under any separator, decimal sign, line end and byte order mark."""
    cells = [[repr(value).replace(".", decimal) for value in row] for row in rows]
    if separator == decimal:
        cells = [[f'"{cell}"' for cell in row] for row in cells]
    text = ending.join(separator.join(row) for row in [["a", "b", "c", "d"], *cells])
    table = read_table(write(tmp_path_factory.mktemp("text"), "a.csv", mark + text))
    values = np.stack([table.values(i) for i in range(4)], -1)
    assert values.tolist() == rows
    assert table.lines == list(range(2, len(rows) + 2))


def test_a_decimal_comma_between_commas_is_a_bad_row(tmp_path):
    """Also where an empty last cell hides that the row has one cell more."""
    path = write(tmp_path, "a.csv", "a,b,c\n1,2,3\n1,2,\n1,5,2,\n4,5,6\n")
    table = read_table(path)
    assert list(table.bad_rows) == [4]
    assert table.lines == [2, 3, 5]
    with pytest.raises(DhcalError, match=r"a\.csv:4: 4 values for 3 columns, with commas .* decimal points"):
        table.require_good_rows()


def test_a_list_of_many_lines_is_shortened():
    assert format_lines(range(2, 40, 2)).endswith("36, 38")
    text = format_lines([*range(1, 301, 3), 500, 501, 502, 600])
    assert text.endswith("295, 298 and 4 more")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a,b\n" + "1,2\n" * 201, r"a\.csv: 201 rows, more than 200; keep one in 2 of them"),
        ("# a comment\na,b\n" + "1,2\n" * 201, r"a\.csv: 201 rows, more than 200"),
        ("a,b\n" + "1," * 10**6 + "\n", r"a\.csv:2: a line of 2000000 characters, more than 1048576"),
    ],
)
def test_tables_that_are_too_large(tmp_path, monkeypatch, text, words):
    monkeypatch.setattr(tables, "MAX_ROWS", 200)
    with pytest.raises(DhcalError, match=words):
        read_table(write(tmp_path, "a.csv", text))


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
def test_only_comments_may_be_in_the_encoding_of_windows(tmp_path, end):
    path = tmp_path / "a.csv"
    lines = ["# Müller, 20 °C", "punkt,größe[mm]", "ä,1.5", " # café", "ö,2.5", ""]
    comments = [line.encode("cp1252" if "#" in line else "utf-8") for line in lines]
    path.write_bytes(end.join(comments))
    table = read_table(path)
    assert table.comments == ("Müller, 20 °C", "café")
    assert table.headers == ("punkt", "größe[mm]")
    assert [row[0] for row in table.cells] == ["ä", "ö"]
    assert list(table.lines) == [3, 5]
    for i in (1, 2):
        wrong = [*comments[:i], lines[i].encode("cp1252"), *comments[i + 1 :]]
        path.write_bytes(end.join(wrong))
        with pytest.raises(DhcalError, match="is not UTF-8; save the file as UTF-8"):
            read_table(path)


def test_comments_are_no_rows(tmp_path, monkeypatch):
    """A table of as many rows as are read at the most, as `simulate` writes it."""
    monkeypatch.setattr(tables, "MAX_ROWS", 200)
    table = read_table(write(tmp_path, "a.csv", "# simulated\na,b\n" + "1,2\n# a remark\n" * 200))
    assert len(table.lines) == 200


def test_a_parquet_file_that_is_too_large(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "MAX_ROWS", 200)
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    pandas.DataFrame({"a": np.zeros(201)}).to_parquet(tmp_path / "a.parquet")
    with pytest.raises(DhcalError, match=r"a\.parquet: 201 rows, more than 200"):
        read_table(tmp_path / "a.parquet")


def test_a_workbook_that_is_too_large(tmp_path):
    """A file of 35 kB whose sheet has 33 MiB."""
    with zipfile.ZipFile(tmp_path / "a.xlsx", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/worksheets/sheet1.xml", b" " * (33 << 20))
    pytest.importorskip("openpyxl")
    with pytest.raises(
        DhcalError, match=r"^[^:]*a\.xlsx: a workbook of 33 MiB when unpacked, more than 32 MiB"
    ):
        read_table(tmp_path / "a.xlsx")
