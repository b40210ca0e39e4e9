"""Measurement files as they come: every form of one table gives the same calibration to the last digit."""

import json
import re
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_line import CALIBRATE, json_of, parse_json, positions_csv, stderr_of, unfolded

import dhcal_pin as dh
from dhcal_pin.exceptions import DhcalError

HEADER, *FULL_ROWS = positions_csv(20, seed=3).splitlines()
# Ten digits: openpyxl writes sixteen, one too few for every double.
CELLS = [[f"{float(cell):.10g}" for cell in row.split(",")] for row in FULL_ROWS]
ROWS = [",".join(row) for row in CELLS]
TEXT = "\n".join([HEADER, *ROWS]) + "\n"
NUMBERS = np.array(CELLS, float)
TIMES = [datetime(2026, 5, 4, 10, 0) + timedelta(seconds=7.5 * i) for i in range(len(ROWS))]
GERMAN = ["Nr", "Achse 1 [°]", "Achse 2 [°]", "Achse 3 [°]", "X-Koordinate", "Y-Koordinate", "Z-Koordinate"]
MAP = """[joints]
order = ["Achse 1 [°]", "Achse 2 [°]", "Achse 3 [°]"]
unit = "deg"
[columns]
x = {from = "X-Koordinate", unit = "mm"}
y = {from = "Y-Koordinate", unit = "mm"}
z = {from = "Z-Koordinate", unit = "mm"}
"""


def with_columns(*columns, sign=","):
    """Return the file with further columns: pairs of header and cells."""
    lines = [sign.join([*HEADER.split(","), *(name for name, _ in columns)])]
    lines += [sign.join([*row, *(cells[i] for _, cells in columns)]) for i, row in enumerate(CELLS)]
    return "\n".join(lines) + "\n"


def frame(**others):
    return pd.DataFrame(NUMBERS, columns=pd.Index(HEADER.split(","))).assign(**others)


def write_excel(path, *, as_text=False):
    from openpyxl import Workbook

    workbook = Workbook()
    sheet = workbook.create_sheet("Messung", 0)
    sheet.append(["# FARO"])
    sheet.append([*HEADER.split(","), "measured at"])
    for row, moment in zip(CELLS, TIMES, strict=True):
        numbers = [cell.replace(".", ",") if as_text else float(cell) for cell in row]
        sheet.append([*numbers, moment])
    workbook.create_sheet("Notizen").append(["warm-up 30 min"])
    workbook.save(path)


def write(name, content):
    Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())


# The header with the units in a row of their own.
UNITS_BELOW = "\n".join(
    [re.sub(r"\[.*?\]", "", HEADER), re.sub(r"[^,]*?(?:\[(.*?)\])?(,|$)", r"\1\2", HEADER)]
)
CLOCK = ["time", [moment.strftime("%H:%M:%S") for moment in TIMES]]
FORMS = {
    "semicolons": lambda: write("data.csv", TEXT.replace(",", ";")),
    "semicolons and decimal commas": lambda: write("data.csv", TEXT.replace(",", ";").replace(".", ",")),
    "tabs": lambda: write("data.csv", TEXT.replace(",", "\t")),
    "tabs and decimal commas": lambda: write("data.csv", TEXT.replace(",", "\t").replace(".", ",")),
    "runs of spaces": lambda: write("data.csv", TEXT.replace(",", "   ")),
    "quoted decimal commas": lambda: write(
        "data.csv",
        "\n".join([HEADER, *(",".join(f'"{c.replace(".", ",")}"' for c in row) for row in CELLS)]),
    ),
    "byte order mark": lambda: write("data.csv", b"\xef\xbb\xbf" + TEXT.encode()),
    "CRLF": lambda: write("data.csv", TEXT.replace("\n", "\r\n")),
    "BOM, CRLF, semicolons, decimal commas": lambda: write(
        "data.csv",
        b"\xef\xbb\xbf" + TEXT.replace(",", ";").replace(".", ",").replace("\n", "\r\n").encode(),
    ),
    "separators at the end": lambda: write("data.csv", TEXT.replace("\n", ",,\n")),
    "row of units": lambda: write("data.csv", TEXT.replace(HEADER, UNITS_BELOW)),
    "degree signs": lambda: write("data.csv", TEXT.replace("[deg]", "[°]", 2).replace("[deg]", "[º]")),
    "row of units with degree signs": lambda: write(
        "data.csv", TEXT.replace(HEADER, UNITS_BELOW.replace("deg", "°"))
    ),
    "capitals": lambda: write(
        "data.csv", TEXT.replace("x[mm],y[mm]", "X[mm],Y [mm]").replace("joint_2", "Joint_2")
    ),
    "known time": lambda: write("data.csv", with_columns(["time[s]", [str(7.5 * i) for i in range(20)]])),
}
# Name of the form, function that writes it, and the note on it.
NOTED_FORMS = {
    "time": (lambda: write("data.csv", with_columns(["Timestamp", CLOCK[1]])), "column 'Timestamp' ignored"),
    "unix time": (
        lambda: write("data.csv", with_columns(["t", [str(moment.timestamp()) for moment in TIMES]])),
        "column 't' ignored",
    ),
    "comments": (
        lambda: write("data.csv", with_columns(["remark", ["", "ok, good", *["x"] * 18]], sign=";")),
        "column 'remark' ignored",
    ),
    "names of points": (
        lambda: write("data.csv", with_columns(["Point", [f"P{i}" for i in range(1, 21)]])),
        "column 'Point' ignored",
    ),
    "numbers of points": (
        lambda: write("data.csv", with_columns(["Point", [str(i) for i in range(1, 21)]])),
        "column 'Point' ignored",
    ),
    "temperature and counter": (
        lambda: write(
            "data.csv", with_columns(["temperature[°C]", ["21.5"] * 20], ["No.", [str(i) for i in range(20)]])
        ),
        "column 'No.' ignored",
    ),
    "index without a name": (
        lambda: write("data.csv", frame().to_csv()),
        "column 1 ignored",
    ),
    "Parquet": (
        lambda: frame(at=pd.to_datetime(TIMES), note=["a"] * 20).to_parquet("data.parquet"),
        "columns 'at', 'note' ignored",
    ),
    "Excel": (lambda: write_excel("data.xlsx"), "sheet 'Messung' was read, not 'Notizen'"),
    "Excel with texts": (lambda: write_excel("data.xlsx", as_text=True), "column 'measured at' ignored"),
}


@pytest.mark.parametrize(
    "words",
    [
        "validate out.urdf d.xlsx",
        "recheck out.urdf d.xlsx --sigma 1mm --size 5mm",
        "plan arm.urdf -n 4 -o p.csv --data d.xlsx --kind position --candidates 100",
        "view arm.urdf --data d.xlsx --html s.html",
    ],
)
def test_commands_read_the_chosen_sheet_without_its_bad_rows(run, robot_folder, words):
    from openpyxl import Workbook

    assert run("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf", "--extend", "none")[0] == 0
    workbook = Workbook()
    long = workbook.create_sheet("Long")
    for _ in range(50):
        long.append([1, 2, 3])
    sheet = workbook.create_sheet("Data")
    for line in Path("data.csv").read_text().splitlines():
        cells = line.split(",")
        sheet.append([float(cell) if cell[-1].isdigit() else cell for cell in cells])
    sheet.cell(4, 5).value = "lost"
    workbook.save("d.xlsx")
    status, _, err = run(*words.split(), "--sheet", "Long")
    assert (status, "sheet 'Long' was read, not 'Data'" in err) == (2, True)
    status, _, err = run(*words.split())
    assert (status, "d.xlsx:4: column 'y': 'lost' is not" in err) == (2, True)
    err = stderr_of(run(*words.split(), "--skip-bad-rows", "--verbose"))
    assert "line 4 skipped" in err or words.startswith("plan")


# Parameters of the plain file, which are computed once.
PLAIN = {}


@pytest.fixture
def expected(run, robot_folder):
    """Return the parameters of the plain file; no measurement file is left."""
    if not PLAIN:
        write("data.csv", TEXT)
        PLAIN["parameters"] = json_of(run(*CALIBRATE, "--json", "-"))["parameters"]
    Path("data.csv").unlink()
    return PLAIN["parameters"]


def calibrate(run, *options):
    """Calibrate with the only file data.*; return the JSON document and the output for people."""
    (path,) = [path.name for path in Path().iterdir() if path.name.startswith("data.")]
    status, out, err = run(
        "calibrate", "arm.dh.toml", path, *CALIBRATE[3:], "--json", "-", "--verbose", *options
    )
    assert status == 0, err
    return parse_json(out), err


@pytest.mark.parametrize("form", FORMS)
def test_each_form_gives_the_same_result(run, expected, form):
    FORMS[form]()
    document, err = calibrate(run)
    assert document["parameters"] == expected
    assert "ignored" not in err
    assert not any("ignored" in text for text in document["warnings"])


@pytest.mark.parametrize("form", NOTED_FORMS)
def test_each_form_gives_the_same_result_and_a_note(run, expected, form):
    write_form, note = NOTED_FORMS[form]
    write_form()
    document, err = calibrate(run)
    assert document["parameters"] == expected
    assert note in err
    assert any(text.endswith(note) for text in document["warnings"])


@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("ending", ["csv", "xlsx", "parquet"])
def test_a_header_in_another_language_with_a_map(run, expected, ending, decimal):
    Path("map.toml").write_text(MAP)
    table = pd.DataFrame(NUMBERS, columns=pd.Index(GERMAN[1:]))
    table.insert(0, GERMAN[0], range(1, 21))
    if ending == "csv":
        table.to_csv("data.csv", sep=";", decimal=decimal, index=False, encoding="utf-8-sig")
    elif ending == "xlsx":
        table.to_excel("data.xlsx", index=False, startrow=2, startcol=1)
    else:
        table.to_parquet("data.parquet")
    document, _ = calibrate(run, "--columns", "map.toml")
    assert document["parameters"] == expected


def test_data_frames(run, expected, robot_folder):
    arm = dh.read_robot("arm.dh.toml")
    write("data.csv", TEXT)
    reference = dh.read_measurements("data.csv", arm)
    for table in (frame(), frame().astype(object), frame(note="a"), frame().convert_dtypes()):
        data = dh.read_measurements(table, arm)
        assert (data.source, data.rows.tolist()) == ("DataFrame", list(range(1, 21)))
        assert data.q.tolist() == reference.q.tolist()
        assert data.positions().tolist() == reference.positions().tolist()
    fit = dh.calibrate(arm, dh.read_measurements(frame(), arm), "dh")
    assert [estimate.value for estimate in fit.estimates] == [row["value"] for row in expected]
    Path("map.toml").write_text(MAP)
    german = pd.DataFrame(NUMBERS, columns=pd.Index(GERMAN[1:]))
    assert dh.read_measurements(german, arm, "map.toml").q.tolist() == reference.q.tolist()
    broken = frame()
    broken.loc[4, "x[mm]"] = np.nan
    broken.loc[7, "joint_2[deg]"] = np.inf
    with pytest.raises(DhcalError, match=r"DataFrame:5: column 'x' is empty; 2 rows .* lines 5, 8;"):
        dh.read_measurements(broken.astype(object), arm)
    assert dh.read_measurements(broken, arm, skip_bad_rows=True).rows.tolist() == [
        *range(1, 5),
        *(6, 7),
        *range(9, 21),
    ]


# --- bad rows --------------------------------------------------------------------------------------

# Lines of the file: a comment in line 2 shifts the rows.
BAD = {5: (3, "nan"), 9: (4, ""), 10: (0, "error"), 11: (5, "inf"), 15: (None, "pause, 10 min")}


def with_bad_rows():
    """Return a file in which five lines are no measurement, and the file without these lines."""
    lines = [HEADER, "# laser", *ROWS]
    good = [line for number, line in enumerate(lines, 1) if number not in BAD]
    for number, (index, text) in BAD.items():
        cells = lines[number - 1].split(",")
        lines[number - 1] = text if index is None else ",".join([*cells[:index], text, *cells[index + 1 :]])
    return "\n".join(lines), "\n".join(good)


def test_all_bad_rows_are_listed_in_one_message(assert_refused, run, robot_folder):
    write("data.csv", with_bad_rows()[0])
    words = ["data.csv:5: column 'x': 'nan' is not a finite number; 5 rows", "lines 5, 9-11, 15;"]
    assert_refused([*words, "or use --skip-bad-rows"], *CALIBRATE)
    assert_refused([*words, "or use --skip-bad-rows"], "validate", "arm.urdf", "data.csv")


def test_bad_rows_are_skipped_on_request(run, robot_folder):
    text, good = with_bad_rows()
    write("data.csv", good)
    expected = json_of(run(*CALIBRATE, "--json", "-"))
    write("data.csv", text)
    status, out, err = run(*CALIBRATE, "--skip-bad-rows", "--json", "-", "--residuals", "r.csv")
    document = parse_json(out)
    assert (status, document["samples"]) == (0, 15)
    assert document["parameters"] == expected["parameters"]
    note = "data.csv: 5 lines skipped: 5, 9-11, 15; the first because column 'x': 'nan' is not a finite"
    note += " number"
    assert note in unfolded(err)
    assert note in document["warnings"]
    # The lines of the other rows are those of the file.
    lines = [int(row.split(",")[1]) for row in Path("r.csv").read_text().splitlines()[1:]]
    assert lines == [line for line in range(3, 23) if line not in BAD]
    skipped = json_of(run("validate", "arm.urdf", "data.csv", "--skip-bad-rows", "--json", "-"))
    assert skipped["samples"] == 15


def test_occlusions_as_zeros_are_bad_rows(assert_refused, run, robot_folder):
    """A tracker that loses its target may write zeros, of which none is a rotation."""
    good = [f"{HEADER},qw,qx,qy,qz", *(f"{row},1,0,0,0" for row in ROWS)]
    lost = [",".join([*row.split(",")[:3], *(["0"] * 7)]) for row in ROWS]
    write("data.csv", "\n".join([*good[:5], *lost[4:12], *good[13:]]))
    words = ["data.csv:6: the quaternion's norm is 0, not 1 within a thousandth; 8 rows", "lines 6-13;"]
    assert_refused([*words, "or use --skip-bad-rows"], *CALIBRATE)
    arm = dh.read_robot("arm.dh.toml")
    data = dh.read_measurements("data.csv", arm, skip_bad_rows=True)
    assert data.rows.tolist() == [*range(2, 6), *range(14, 22)]
    write("good.csv", "\n".join([*good[:5], *good[13:]]))
    assert data.q.tolist() == dh.read_measurements("good.csv", arm).q.tolist()


def test_columns_without_rotations_are_no_bad_rows(assert_refused, run, robot_folder):
    """Most rows that are wrong point at the columns."""
    rows = [f"{row},{'1,0,0,0' if i < 9 else '3,0,0,0'}" for i, row in enumerate(ROWS)]
    write("data.csv", "\n".join([f"{HEADER},qw,qx,qy,qz", *rows]))
    words = ["data.csv:11: the quaternion's norm is 3; it must be 1", "(order qw,qx,qy,qz)\n"]
    assert_refused(words, *CALIBRATE, "--skip-bad-rows")


def test_bad_rows_of_excel_and_of_a_mapped_file(assert_refused, run, robot_folder):
    table = pd.DataFrame(NUMBERS, columns=pd.Index(GERMAN[1:])).astype(object)
    table.loc[3, GERMAN[2]] = "?"
    table.loc[9, GERMAN[4]] = None
    table.to_excel("data.xlsx", index=False)
    Path("map.toml").write_text(MAP)
    calibrate = ("calibrate", "arm.dh.toml", "data.xlsx", "-o", "out.urdf", "--columns", "map.toml")
    assert_refused(["data.xlsx:5: column 'Achse 2': '?' is not", "lines 5, 11;"], *calibrate)
    assert json_of(run(*calibrate, "--skip-bad-rows", "--json", "-"))["samples"] == 18


def test_no_usable_row_is_an_error(assert_refused, run, robot_folder):
    """Skipping bad rows is no remedy if all are bad."""
    write("data.csv", "\n".join([HEADER, *(["1,2,3,a,b,c"] * 3)]))
    words = ["data.csv: no row has all numbers (line 2: column 'x': 'a' is not a finite number)"]
    assert_refused(words, *CALIBRATE, "--skip-bad-rows")
    assert_refused(["data.csv:2: column 'x'", "lines 2-4; correct or remove them\n"], *CALIBRATE)


def test_ambiguous_thousands_separators_are_named(assert_refused, robot_folder):
    write("data.csv", "\n".join([HEADER.replace(",", ";"), "1.5;2;3;4,001;5;6", "1;2;3;4;5;6"]))
    words = "data.csv:2: column 'x': '4,001' is not a finite number with decimal points: write it without"
    assert_refused([f"{words} thousands separators; correct"], *CALIBRATE)


# --- column maps that messages propose -------------------------------------------------------------


def proposed_map(err):
    """Return the lines in backticks that contain an equals sign, as a file."""
    return "\n".join(part for part in err.split("`")[1::2] if "=" in part) + "\n"


@pytest.mark.parametrize("sign", [",", ";", "\t"])
def test_a_file_without_header_proposes_a_map_that_reads_it(run, expected, sign):
    write("data.csv", TEXT.split("\n", 1)[1].replace(",", sign))
    status, _, err = run(*CALIBRATE)
    assert (status, err.count("\n")) == (2, 1)
    assert "data.csv:1: numbers where the header must be" in err
    assert 'joints = {order = [1, 2, 3], unit = "deg"}' in err
    Path("map.toml").write_text(proposed_map(err))
    assert calibrate(run, "--columns", "map.toml")[0]["parameters"] == expected


def test_a_proposed_map_has_the_spelling_of_the_file(run, expected):
    """Capital X, Y and Z with units are measured values beside the joints' own names, but not to a map."""
    names = HEADER.replace("joint_", "J").replace("x[", "X[").replace("y[", "Y[").replace("z[", "Z[")
    write("data.csv", TEXT.replace(HEADER, names).replace(",", ";"))
    status, _, err = run(*CALIBRATE)
    assert (status, err.count("\n")) == (2, 1)
    assert "'X[mm]', 'Y[mm]', 'Z[mm]'" in err
    Path("map.toml").write_text(proposed_map(err))
    assert calibrate(run, "--columns", "map.toml")[0]["parameters"] == expected


@pytest.mark.usefixtures("expected")
def test_a_proposed_map_keeps_the_counts_of_servos(run):
    counts = np.rint(2048 + NUMBERS[:, :3] * 4096 / 360).astype(int)
    rows = [[*map(str, row), *cells[3:]] for row, cells in zip(counts, CELLS, strict=True)]
    header = HEADER.replace("[deg]", "[ticks]")
    text = "\n".join([header, *map(",".join, rows)]) + "\n"
    Path("servos.toml").write_text("".join(f"[motor.joint_{i}]\n" for i in (1, 2, 3)))
    write("data.csv", text)
    known, _ = calibrate(run, "--servos", "servos.toml")
    write("data.csv", text.replace("x[", "Px[").replace("y[", "Py[").replace("z[", "Pz["))
    status, _, err = run(*CALIBRATE, "--servos", "servos.toml")
    assert (status, err.count("\n")) == (2, 1)
    Path("map.toml").write_text(proposed_map(err))
    found, _ = calibrate(run, "--servos", "servos.toml", "--columns", "map.toml")
    assert found["parameters"] == known["parameters"]


def test_a_header_in_another_language_proposes_a_map_that_reads_it(run, expected):
    table = pd.DataFrame(NUMBERS, columns=pd.Index(GERMAN[1:]))
    table.insert(0, GERMAN[0], range(1, 21))
    table.to_csv("data.csv", sep=";", decimal=",", index=False)
    status, _, err = run(*CALIBRATE)
    assert (status, err.count("\n")) == (2, 1)
    assert "data.csv:1: no column is a joint of this robot (joint_1, joint_2, joint_3)" in err
    Path("map.toml").write_text(proposed_map(err))
    assert calibrate(run, "--columns", "map.toml")[0]["parameters"] == expected


def columns_of_ros(prefix="/joint_states/"):
    """Return the columns of a recording of ROS in another order of the joints."""
    radians = np.radians(NUMBERS[:, :3])
    out = {"/joint_states/header/stamp/secs": [str(1_700_000_000 + 3 * i) for i in range(20)]}
    for j in (1, 0, 2):
        topic = f"{prefix}joint_{j + 1}"
        out[f"{topic}/velocity"] = ["0.0"] * 20
        out[f"{topic}/position"] = [repr(float(value)) for value in radians[:, j]]
    return out | {f"/leica/point/{axis}": [cells[3 + i] for cells in CELLS] for i, axis in enumerate("xyz")}


def columns_of_names():
    """Return columns of arrays of names and positions, in another order of the joints."""
    order = {f"name[{k}]": [f"joint_{j + 1}"] * 20 for k, j in enumerate((2, 0, 1))}
    order |= {f"position[{k}]": [cells[j] for cells in CELLS] for k, j in enumerate((2, 0, 1))}
    return order | {f"point.{axis}": [cells[3 + i] for cells in CELLS] for i, axis in enumerate("xyz")}


def columns_of_an_export():
    """Return columns with a counter, times, thousands separators and decimal commas."""
    angles = {f"Achse {j + 1}": [cells[j].replace(".", ",") for cells in CELLS] for j in range(3)}
    lengths = {
        f"Mess {axis} [um]": [
            f"{1e3 * value:,.6f}".translate(str.maketrans(",.", ".,")) for value in NUMBERS[:, 3 + i].tolist()
        ]
        for i, axis in enumerate("XYZ")
    }
    counts = {"Messpunkt Nr.": [str(i) for i in range(1, 21)], "Zeitstempel": ["12.03.2025 10:00:00"] * 20}
    return counts | angles | lengths


@pytest.mark.parametrize(
    ("columns", "order", "unit"),
    [
        (columns_of_ros, [f"/joint_states/joint_{j}/position" for j in (1, 2, 3)], "rad"),
        (lambda: columns_of_ros(""), [f"joint_{j}/position" for j in (1, 2, 3)], "rad"),
        (columns_of_names, ["position[1]", "position[2]", "position[0]"], "deg"),
        (columns_of_an_export, ["Achse 1", "Achse 2", "Achse 3"], "deg"),
    ],
)
def test_joints_are_proposed_by_their_names(run, expected, columns, order, unit):
    """Times and counters are no joints."""
    table = columns()
    write("data.csv", "\n".join(map(";".join, [table, *zip(*table.values(), strict=True)])))
    status, _, err = run(*CALIBRATE)
    assert (status, err.count("\n")) == (2, 1)
    assert f'joints = {{order = {json.dumps(order)}, unit = "{unit}"}}' in err
    assert "state the robot" not in err
    Path("map.toml").write_text(proposed_map(err))
    found = calibrate(run, "--columns", "map.toml")[0]["parameters"]
    for one, other in zip(found, expected, strict=True):
        assert one["value"] == pytest.approx(other["value"], abs=1e-6)


@pytest.mark.parametrize(
    "headers", [("rvx", "rvy", "rvz"), ("rvec_x", "rvec_y", "rvec_z"), ("rvec[0]", "rvec[1]", "rvec[2]")]
)
def test_rotation_vectors_of_opencv_are_proposed(run, expected, headers):
    """The rotation of a pose by solvePnP was left out without a word."""
    turns = np.random.default_rng(5).uniform(-2, 2, (20, 3))
    rows = [[*cells, *map(repr, turn)] for cells, turn in zip(CELLS, turns.tolist(), strict=True)]
    names = [*(f"joint_{j}_deg" for j in (1, 2, 3)), "tx_mm", "ty_mm", "tz_mm", *headers]
    write("data.csv", "\n".join(map(";".join, [names, *rows])))
    status, _, err = run(*CALIBRATE)
    assert status == 2
    assert f'rotation = {{convention = "rotvec", columns = {json.dumps(headers)}, unit = "rad"}}' in err


def test_a_counter_is_no_joint_without_names_either(run, expected):
    rows = [[str(i), *cells] for i, cells in enumerate(CELLS, 1)]
    write("data.csv", "\n".join(map(",".join, rows)))
    assert "order = [2, 3, 4]" in run(*CALIBRATE)[2]
    rows = [[str(10 * i), *cells, "0.02"] for i, cells in enumerate(CELLS, 1)]
    write("data.csv", "\n".join(map(",".join, [["k", *"pqruvw", "rms"], *rows])))
    assert 'order = ["p", "q", "r"]' in run(*CALIBRATE)[2]


def write_below_titles(ending, table):
    """Write a table under two lines of titles and an empty line."""
    titles = [["Tracker export"], ["Job", "7", "", "A. B."], []]
    if ending == "csv":
        return write("data.csv", "\n".join(map(";".join, [*titles, *table])) + "\n")
    from openpyxl import Workbook

    workbook = Workbook()
    sheet = workbook.create_sheet("Data", 0)
    for row in [*titles, *table]:
        sheet.append([float(cell) if re.fullmatch(r"[\d.-]+", cell) else cell for cell in row])
    workbook.save("data.xlsx")


@pytest.mark.parametrize("ending", ["csv", "xlsx"])
@pytest.mark.parametrize("header", ["J1,J2,J3,X in mm,Y in mm,Z in mm", HEADER])
def test_a_header_below_titles_is_found(run, expected, ending, header):
    write_below_titles(ending, [header.split(","), *CELLS])
    command = (*CALIBRATE[:2], f"data.{ending}", *CALIBRATE[3:])
    status, _, err = run(*command)
    assert (status, err.count("\n")) == (2, 1)
    assert f"data.{ending}:1: no names of columns in this line; they seem to be in line 4; remove" in err
    lines = proposed_map(err)
    assert lines.startswith("skip = 3\njoints = ")
    Path("map.toml").write_text(lines)
    assert calibrate(run, "--columns", "map.toml")[0]["parameters"] == expected
    (file,) = json_of(run("inspect", f"data.{ending}", "--robot", "arm.dh.toml", "--json", "-"))["files"]
    assert "\n".join(file["column_map"]) == lines.strip()
    assert (file["rows"], file["bad_rows"], len(file["columns"])) == (20, {}, 6)
    Path("map.toml").write_text(lines.replace("skip = 3\n", ""))
    status, _, err = run(*command, "--columns", "map.toml")
    assert (status, "skip = 3 in the map reads the header in line 4" in err) == (2, True)


def test_texts_that_may_be_coordinates_are_named(run, robot_folder):
    write("data.csv", "J1;J2;J3;X;Y;Z\n" + "1.5;2.5;3.5;1,068;2,5;3.5\n" * 5)
    err = unfolded(run("inspect", "data.csv", "--robot", "arm.dh.toml")[2])
    assert "column 'X': '1,068' is not a finite number with decimal points: write it without thousands" in err


def test_no_map_is_proposed_for_the_file_of_a_robot_with_more_joints(run, expected):
    head = ",".join(f"axis{i}[deg]" for i in range(4))
    write("data.csv", f"{head},x[mm],y[mm],z[mm]\n" + "1,2,3,4,500,600,700\n" * 9)
    status, _, err = run(*CALIBRATE)
    assert (status, err.count("\n")) == (2, 1)
    assert "more angles than the robot has joints: give the robot that was measured" in err
    assert "order" not in err


# --- files that cannot be read ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("data.xlsx", b"PK\x03\x04 no zip", ["data.xlsx: not an Excel workbook", "save it as .xlsx"]),
        ("data.xlsx", TEXT.encode(), ["data.xlsx: not an Excel workbook"]),
        ("data.parquet", TEXT.encode(), ["data.parquet: not a Parquet file"]),
        ("data.xls", b"\xd0\xcf\x11\xe0", ["data.xls: .xls files cannot be read; save it as .xlsx"]),
        ("data.bag", b"#ROSBAG V2.0\n", ["data.bag: .bag files cannot be read", "dhcal convert"]),
        ("a.urdf", b"<robot/>", ["a.urdf: .urdf files cannot be read; expected a table of measurements"]),
    ],
)
def test_files_that_are_no_tables(assert_refused, run, robot_folder, name, content, words):
    write(name, content)
    assert_refused(words, "calibrate", "arm.dh.toml", name, "-o", "out.urdf")
    assert_refused(["cannot read it"], "calibrate", "arm.dh.toml", f"none-{name[:8]}.xlsx", "-o", "out.urdf")


def test_optional_packages_are_named(assert_refused, run, robot_folder, monkeypatch):
    for name, package, extra in (("data.xlsx", "openpyxl", "excel"), ("data.parquet", "pyarrow", "parquet")):
        write(name, b"")
        monkeypatch.setitem(__import__("sys").modules, package, None)
        assert_refused([f"needs {package}", f"dhcal-pin[{extra}]"], *CALIBRATE[:2], name, *CALIBRATE[3:])


@pytest.mark.parametrize(
    ("header", "word"),
    [
        ("poinnt", "did you mean 'point'?"),
        ("X[mm]", "'X' is neither"),
        ("flange[deg]", "'flange' is neither"),
        ("offset[mm]", "'offset' is neither"),
        ("weight", "'weight' is neither"),
    ],
)
def test_columns_that_may_be_meant_are_not_ignored(assert_refused, run, robot_folder, header, word):
    """A misspelt name, an angle or a length, and numbers without a unit."""
    text = with_columns([header, [str(i**2) for i in range(20)]])
    write("data.csv", text)
    assert_refused(["data.csv:1:", word], *CALIBRATE)
