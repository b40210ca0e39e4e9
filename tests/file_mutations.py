"""Small files of every format that commands read, their mutations, and how a command must take them.

Run as a script, it tries mutations for some minutes, and appends to a file their number, what was wrong, and
all messages: `file_mutations.py SEED MINUTES FILE`.
"""

import contextlib
import csv
import io
import json
import math
import os
import re
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from unittest import mock

import numpy as np
from command_line import COLUMN_MAP, assert_harmless, positions_csv, ur_kinematics
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from mjcf_robots import BENCH, UR5E
from mutations import Mutation, mutated, mutation_lists
from recordings import JOINTS, POSES, Recording, write_bag
from robots import URDF

from dhcal_pin.cli import fleet
from dhcal_pin.cli.main import main
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import read_measurements, read_robot
from dhcal_pin.measurements import KINDS
from dhcal_pin.studies import read_study

MAP = f'separator = ";"\n{COLUMN_MAP}'
ARM_CFX = """<?xml version="1.0" encoding="utf-8" ?>
<arm>
  <DhArray name="dhOffset" >
    <DH index="0" theta="0.1" d="0" a="0" b="0" alpha="0" beta="0" />
    <DH index="1" theta="-0.2" d="0" a="0" b="0" alpha="0" beta="0" />
    <DH index="2" theta="0" d="0" a="0" b="0" alpha="0" beta="0" />
  </DhArray>
  <Float name="flangeLengthOffset" value="0" />
</arm>
"""
SIDECAR = """
tip = "tool0"
[base]
xyz_m = [0.1, 0, 0.2]
rotvec_rad = [0, 0, 0.1]
[tool]
xyz_m = [0, 0, 0.1]
[payload]
mass_kg = 1.5
centre_m = [0, 0, 0.05]
[joint.joint_1]
gain = 0.001
harmonics = [[1, 1e-4, 2e-4], [2, 0, 1e-5]]
compliance_rad_per_nm = 1e-6
[joint.joint_1.coupling]
joint_2 = 0.001
"""
STUDY = 'seeds = 2\n[settings]\nrobot = "arm.dh.toml"\nkind = ["pose", "position"]\nposes = 8\n'
FLEET = '[[job]]\nrobot = "arm.urdf"\ndata = "data.csv"\noutput = "o.urdf"\njson = "j.json"\n'
RIG = """
[camera.left]
link = "world"
model = "pinhole"
width = 640
height = 480
fx = 500.0
fy = 501.0
cx = 319.5
cy = 239.5
distortion = [0.1, 0, 0, 0, 0]
intrinsics = "prior"
xyz_m = [0, 0, -2]
[board.target]
link = "tip"
type = "charuco"
columns = 4
rows = 3
square_mm = 30.0
marker_mm = 22.0
dictionary = "DICT_5X5_100"
[board.spots]
link = "tip"
type = "points"
points_mm = [[0, 0, 1], [2, 0, 0]]
[board.tags]
link = "world"
type = "aprilgrid"
columns = 2
rows = 3
marker_mm = 40
spacing_mm = 12
"""
SCENE = """<robot name="s">
<link name="table"><collision><origin xyz="0 0 -2" rpy="0 0 0.1"/>
<geometry><box size="0.1 0.2 0.3"/></geometry></collision></link>
<link name="post"><collision><geometry><cylinder radius="0.1" length="0.2"/></geometry></collision></link>
<joint name="j" type="fixed"><origin xyz="2 0 0"/><parent link="table"/><child link="post"/></joint></robot>
"""
RECORD = """{"token": "0123456789abcdef", "folders": ["/nowhere/a", "/nowhere/b"],
 "renames": [[".dhcal-0123456789abcdef-0.new", "o.urdf"]], "removals": ["o.toml"]}"""
TRIANGLES = """solid s
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0.5
endloop
endfacet
endsolid s
"""
CALIBRATE = ("calibrate", "arm.urdf", "data.csv", "-o", "o.urdf", "--max-iterations", "3", "--extend", "none")
# The rules about outliers take most of the time; they do not depend on the format of a file.
SHORT = ("--loss", "linear", "--priors", "none", "--parameters", "offset,tool")
# Largest number of simulated poses of a study, over all its calibrations.
MAX_POSES_OF_STUDY = 10_000


@dataclass(frozen=True)
class Case:
    """File that is mutated, and a command that reads it."""

    name: str  # Name of the file
    data: bytes  # Its content
    words: Sequence[str]  # Words of the command
    # Other files that the command reads, beside those that all cases have.
    others: Mapping[str, bytes] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"{self.words[0]} {self.name}"


def _bags() -> dict[str, bytes]:
    """Return the files of recordings of ROS 1, MCAP and ROS 2."""
    chain = read_robot(URDF / "experiment.urdf")
    q = np.random.default_rng(0).uniform(-1, 1, (5, chain.n_joints))
    recording = Recording(chain, q, joint_rate=20, pose_rate=20, stop=1, move=0.5)
    with tempfile.TemporaryDirectory() as folder:
        for name in ("r.bag", "r.mcap", "ros2"):
            write_bag(Path(folder) / name, recording)
        files = [path for path in Path(folder).rglob("*") if path.is_file() and path.parent.name != "r"]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@cache
def _simulated(kind: str) -> dict[str, bytes]:
    """Return a measurement file of a kind, and the rig file of images."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        Path("arm.urdf").write_bytes((URDF / "experiment.urdf").read_bytes())
        words = (
            "simulate",
            "arm.urdf",
            "-m",
            "6" if kind == "camera" else "10",
            "--kind",
            kind,
            "--noise",
            "0.1mm,0.1deg",
            "--quiet",
        )
        main([*words, "--errors", "1mm,0.3deg", "-o", f"{kind}.csv"])
        return {path.name: path.read_bytes() for path in Path().iterdir() if path.name != "arm.urdf"}


def _robot_with_meshes() -> dict[str, bytes]:
    """Return a robot whose links have meshes, and the meshes."""
    text = (URDF / "experiment.urdf").read_text()
    for link, name in (("link_1", "m.stl"), ("link_2", "m.obj")):
        visual = f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
        text = text.replace(f'<link name="{link}">', f'<link name="{link}">{visual}')
    shape = b"v 0 0 0\nv 1 0 0\nv 0 1 0.5\nvn 0 0 1\nf 1 2 3\nf 1//1 2//1 3//1\n"
    return {"robot.urdf": text.encode(), "m.stl": TRIANGLES.encode(), "m.obj": shape}


def _journal() -> bytes:
    """Return the journal of a study that was interrupted."""
    with _folder({}), contextlib.redirect_stderr(io.StringIO()):
        with mock.patch("dhcal_pin.cli.commands.study._write_results", side_effect=KeyboardInterrupt):
            main(["study", "s.study.toml", "-o", "s.csv", "--quiet"])
        return Path("s.csv.part").read_bytes()


def _foreign_table() -> bytes:
    """Return a measurement file of another maker."""
    rows = positions_csv(8).split("\n", 1)[1].replace(",", ";").replace(".", ",")
    return f"A1;A2;A3;X;Y;Z\n{rows}".encode()


def _common_files() -> dict[str, bytes]:
    """Return the files that all commands find."""
    return {
        "arm.urdf": (URDF / "experiment.urdf").read_bytes(),
        "arm.dh.toml": (URDF / "experiment.dh.toml").read_bytes(),
        "data.csv": positions_csv(8).encode(),
        "map.toml": MAP.encode(),
        "foreign.csv": _foreign_table(),
        "wires.csv": _simulated("wires")["wires.csv"],
        "t.csv": b"x[mm],y[mm],z[mm]\n500,100,600\n",
        "s.study.toml": STUDY.encode(),
        **_simulated("camera"),
    }


COMMON = _common_files()


@contextlib.contextmanager
def _folder(files: Mapping[str, bytes]) -> Iterator[None]:
    """Work in a new folder with some files."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for name, data in (COMMON | dict(files)).items():
            Path(name).parent.mkdir(exist_ok=True)
            Path(name).write_bytes(data)
        yield


def cases() -> list[Case]:
    """Return a file of each format and each command that reads it."""
    inspect = ("inspect", "data.csv", "--robot", "arm.urdf")
    of_table = ("calibrate", "arm.dh.toml", *CALIBRATE[2:], "--loss", "linear")
    mapped = ("calibrate", "arm.urdf", "foreign.csv", *CALIBRATE[3:], "--columns", "map.toml", *SHORT)
    inspect_mapped = ("inspect", "foreign.csv", "--robot", "arm.urdf", "--columns", "map.toml")
    of_wires = ("calibrate", "arm.urdf", "wires.csv", *CALIBRATE[3:], "--instrument", "i.toml", *SHORT)
    compensate = ("compensate", "arm.urdf", "arm.urdf", "t.csv", "-o", "c.csv")
    topics = ("--robot", "arm.urdf", "--pose-topic", POSES, "--joint-topic", JOINTS)
    plan = ("plan", "arm.urdf", "-n", "6", "-o", "plan.csv", "--kind", "position", "--candidates", "20")
    of_images = ("validate", "arm.urdf", "camera.csv", "--rig", "camera.rig.toml")
    dh_csv = (
        b"# convention: standard\njoint,type,theta[deg],d[mm],a[mm],alpha[deg]\n"
        b"a,revolute,0,433,0,90\nb,revolute,0,0,400,0\nc,prismatic,0,12.5,345,0\n"
    )
    dh_toml = (URDF / "experiment.dh.toml").read_bytes()
    targets = b"x[mm],y[mm],z[mm]\n500,100,600\n400,-50,500\n"
    angles = b"joint_1[deg],joint_2[deg],joint_3[deg]\n" + b"".join(b"%d,%d,9\n" % (i, -i) for i in range(12))
    meshes = _robot_with_meshes()
    bags = _bags()
    in_folder = {name: data for name, data in bags.items() if "/" in name}
    images = _simulated("camera")
    tables = [_simulated(kind)[f"{kind}.csv"] for kind in KINDS if kind != "camera"]
    return [
        Case("data.csv", positions_csv(8).encode(), inspect),
        Case("data.csv", positions_csv(8).encode(), CALIBRATE),
        *(Case("data.csv", table, words) for table in tables for words in (inspect, (*CALIBRATE, *SHORT))),
        Case("foreign.csv", _foreign_table(), mapped),
        Case("foreign.csv", _foreign_table(), inspect_mapped),
        Case("map.toml", MAP.encode(), mapped),
        Case("map.toml", MAP.encode(), inspect_mapped),
        Case("arm.dh.toml", dh_toml, ("convert", "arm.dh.toml", "o.urdf")),
        Case("arm.dh.toml", dh_toml, ("check", "arm.dh.toml")),
        Case("t.dh.csv", dh_csv, ("convert", "t.dh.csv", "o.urdf")),
        Case("t.dh.csv", dh_csv, ("simulate", "t.dh.csv", "-m", "4", "-o", "s.csv")),
        Case(
            "k.yaml", ur_kinematics((0, 0.1, 0.2, 0, 1.5, -3.1e-5)).encode(), ("convert", "k.yaml", "o.urdf")
        ),
        Case("m.xml", BENCH.encode(), ("convert", "m.xml", "o.urdf")),
        Case("m.xml", UR5E.encode(), ("convert", "m.xml", "o.origins.csv", "--tip", "attachment_site")),
        Case("m.xml", BENCH.encode(), ("convert", "m.xml", "o.xml", "--template", "m.xml")),
        Case("a.cfx", ARM_CFX.encode(), ("convert", "a.cfx", "o.urdf", "--template", "arm.urdf")),
        Case("arm.calibration.toml", SIDECAR.encode(), ("validate", "arm.urdf", "data.csv")),
        Case("arm.calibration.toml", SIDECAR.encode(), compensate),
        Case("p.toml", b'"a*" = 0.001\n"alpha1" = 0.01\n', (*of_table, "--priors", "p.toml")),
        Case("b.toml", b"a2 = [0.3, 0.5]\n'alpha*' = [-2, 2.0]\n", (*of_table, "--bounds", "b.toml")),
        Case("i.toml", b'[instrument]\n"wire1.x" = 0.5\n', of_wires),
        Case("s.study.toml", STUDY.encode(), ("study", "s.study.toml", "-o", "s.csv")),
        Case("s.csv.part", _journal(), ("study", "s.study.toml", "-o", "s.csv")),
        Case("f.fleet.toml", FLEET.encode(), ("calibrate", "f.fleet.toml", "-o", "f.csv", "--jobs", "1")),
        Case("t.csv", targets, compensate),
        Case(
            "tcp.toml", b"xyz_m = [0, 0, 0.1]\nrotvec_rad = [0, 0.2, 0]\n", (*compensate, "--tcp", "tcp.toml")
        ),
        Case("task.csv", targets, (*plan, "--task", "task.csv")),
        Case("from.csv", angles, (*plan, "--from", "from.csv")),
        Case("scene.urdf", SCENE.encode(), (*plan, "--obstacle", "scene.urdf")),
        Case("rig.toml", RIG.encode(), ("board", "rig.toml", "--board", "target", "-o", "b.pdf")),
        *(Case(name, data, of_images) for name, data in images.items()),
        Case(".dhcal-save.json", RECORD.encode(), inspect),
        *(
            Case("robot.urdf", meshes["robot.urdf"], words)
            for words in (
                ("convert", "robot.urdf", "o.dh.toml"),
                ("convert", "robot.urdf", "o.origins.csv"),
                ("simulate", "robot.urdf", "-m", "4", "-o", "s.csv"),
            )
        ),
        *(
            Case(
                name,
                meshes[name],
                ("view", "robot.urdf", "--html", "v.html"),
                {"robot.urdf": meshes["robot.urdf"]},
            )
            for name in meshes
        ),
        *(
            Case(
                name,
                data,
                ("convert", name.split("/")[0], "m.csv", *topics),
                in_folder if "/" in name else {},
            )
            for name, data in bags.items()
        ),
    ]


CASES = cases()
TOKENS = [
    *("1e309", "-1e-320", "nan", "inf", "0x10", "1_000", "1,5", "9" * 400, "-0", "1e5", "true", "''", '""'),
    *("[", "]", "{", "}", "=", ":", ";", ",", "\t", "#", '"', "'''", "\\u0000", "&a", "*a", "!!int", "|"),
    *("[mm]", "[m]", "[deg]", "[rad]", "[in]", "[]", "set", "holdout", "point", "sigma_x[mm]", "time[s]"),
    *("\x00", "\r", "\n\n", "\u2028", "\ufeff", "\u202e", "\x1b[31m", "\ud7ff", "é", "../", "/dev/null"),
]
WORD = re.compile(rb"\w+|\s+|[^\w\s]")
MUTATIONS = mutation_lists(
    (st.sampled_from(TOKENS) | st.floats().map(repr) | st.integers(-(10**6), 10**6).map(str)).map(
        lambda text: text.encode(errors="surrogatepass")
    )
)
# Commands that only read are tried more often than those that compute for a tenth of a second.
WEIGHTED = [
    case for case in CASES for _ in range(1 if case.words[0] in ("calibrate", "validate", "plan") else 4)
]
EXAMPLES = {"case": st.sampled_from(WEIGHTED), "mutations": MUTATIONS}


def _files() -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in Path().rglob("*") if path.is_file()}


def _run_fleet_here(
    entries: list[fleet.FleetJob],
    path: str,
    runner: fleet.JobRunner,
    n_processes: int,
    on_done: Callable[[int, fleet.FleetJobOutcome], None],
) -> list[fleet.FleetJobOutcome]:
    """Run the jobs of a manifest in this process, where unexpected errors are seen and no time is lost."""
    del path, n_processes
    outcomes = []
    for i, entry in enumerate(entries):
        try:
            document = runner(entry.job)
            outcomes.append(fleet.FleetJobOutcome(document["verdict"]["status"], "", document))
        except DhcalError as error:
            outcomes.append(fleet.FleetJobOutcome(fleet.FAILED, str(error)))
        on_done(i, outcomes[-1])
    return outcomes


@contextlib.contextmanager
def _no_output_of_libraries() -> Iterator[None]:
    """Assert that no library writes to the descriptors of stdout and stderr."""
    kept = {number: os.dup(number) for number in (1, 2)}
    with tempfile.TemporaryFile() as file:
        for number in kept:
            os.dup2(file.fileno(), number)
        try:
            yield
        finally:
            for number, copy in kept.items():
                os.dup2(copy, number)
                os.close(copy)
        file.seek(0)
        assert file.read() == b""


def _is_long_study(path: str) -> bool:
    """Return whether a study takes longer than a few seconds, as its file asks for."""
    try:
        study = read_study(path)
    except DhcalError:
        return False
    return study.seeds * sum(case.setting.poses for case in study.cases) > MAX_POSES_OF_STUDY


def survive(case: Case, data: bytes, heard: set[str] | None = None) -> None:
    """Run a command on a mutated file: done, or refused in one line, which is added to `heard`."""
    with _folder({**case.others, case.name: data}):
        if case.name == "s.study.toml" and _is_long_study(case.name):
            return
        before = _files()
        said, out = io.StringIO(), io.StringIO()
        start = time.process_time()
        with (
            contextlib.redirect_stderr(said),
            contextlib.redirect_stdout(out),
            _no_output_of_libraries(),
            # The disk takes most of the time, and nothing is interrupted here.
            mock.patch("os.fsync", return_value=None),
            mock.patch.object(fleet, "run_fleet", _run_fleet_here),
        ):
            status = main(case.words)
        assert time.process_time() - start < 20
        message = said.getvalue()
        assert status in (0, 1, 2, 3), (status, message)
        assert "report this error" not in message + out.getvalue(), message
        after = _files()
        if status == 2:
            assert message.startswith("dhcal: "), message
            assert message.count("\n") == 1, message
            assert_harmless(message)
            assert len(message) < 1500, message
            if heard is not None:
                heard.add(message)
            # An interrupted save of an earlier run may have been completed or discarded.
            assert {k: v for k, v in after.items() if k != ".dhcal-save.json"} == {
                k: v for k, v in before.items() if k != ".dhcal-save.json"
            }
        else:
            temporary = [name for name in after.keys() - before.keys() if ".dhcal-" in name]
            assert not temporary
            if case.name == "data.csv":
                assert_units_of_header(data)


# Largest value of a measurement file [m or rad].
MAX_SI_VALUE = 1e6
# Factors to metres and radians, from the definitions of the units.
SI = {"m": 1, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "rad": 1, "deg": math.pi / 180, "mrad": 1e-3, "in": 0.0254}


def assert_units_of_header(data: bytes) -> None:
    """Assert that an accepted table of positions is read as another parser reads it.

    Only plain tables are compared: separated by commas, without quotes and comments, and all cells numbers.
    """
    rows = list(csv.reader(data.decode(errors="replace").removeprefix("\ufeff").splitlines()))
    if any(sign in data for sign in b'"#;\t'):
        return
    rows = [row for row in rows if any(map(str.strip, row))]
    columns = [re.fullmatch(r"\s*(\w+)\s*\[(\w+)\]\s*", cell) for cell in rows[0]]
    if not all(columns) or not all(column and column[2] in SI for column in columns):
        return
    names = [column[1] for column in columns if column]
    if sorted(names) != ["joint_1", "joint_2", "joint_3", "x", "y", "z"]:
        return
    try:
        # Python reads numbers with underscores, which are none in a table.
        table = np.array([[float(cell.replace("_", "?")) for cell in row] for row in rows[1:]])
    except ValueError:
        return
    expected = table * [SI[column[2]] for column in columns if column]
    # `inspect` accepts a table with such rows, and names them.
    if not np.all(np.abs(expected) <= MAX_SI_VALUE):
        return
    measured = read_measurements("data.csv", read_robot("arm.urdf"))
    found = np.hstack([measured.q, measured.values])  # pyright: ignore
    order = [names.index(name) for name in ("joint_1", "joint_2", "joint_3", "x", "y", "z")]
    np.testing.assert_allclose(found, expected[:, order], rtol=1e-12)


def _try_hundred(number: int) -> dict[str, object]:
    """Try a hundred mutations; return their number, what was wrong, and the messages."""
    heard, wrong, count = set[str](), list[str](), 0

    @seed(number)
    @settings(
        max_examples=100,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=[
            HealthCheck.too_slow,
            HealthCheck.data_too_large,
            HealthCheck.large_base_example,
        ],
    )
    @given(**EXAMPLES)
    def attempt(case: Case, mutations: Sequence[Mutation]) -> None:
        nonlocal count
        count += 1
        try:
            survive(case, mutated(case.data, mutations, WORD), heard)
        except Exception:
            wrong.append(f"{case} {mutations}\n{traceback.format_exc()}")

    attempt()
    return {"seed": number, "cases": count, "wrong": wrong, "heard": sorted(heard)}


def _run(number: str, minutes: str, path: str) -> None:
    """Try mutations for some minutes, and append the outcome of every hundred to a file."""
    end, part = time.monotonic() + 60 * float(minutes), 0
    while time.monotonic() < end:
        part += 1
        outcome = _try_hundred(int(number) * 10_000 + part)
        with open(path, "a") as file:
            file.write(json.dumps(outcome) + "\n")


if __name__ == "__main__":
    _run(*sys.argv[1:])
