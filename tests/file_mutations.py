"""Small files of every format that commands read, their mutations, and how a command must take them."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from command_line import positions_csv
from hypothesis import strategies as st
from recordings import JOINTS, POSES, Recording, write_bag
from robots import URDF

from dhcal_pin.cli.main import main
from dhcal_pin.io import read_robot

MAP = """
separator = ";"
[joints]
order = ["A1", "A2", "A3"]
unit = "deg"
[columns]
x = {from = "X", unit = "mm"}
y = {from = "Y", unit = "mm"}
z = {from = "Z", unit = "mm"}
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
NAMES = "shoulder upper_arm forearm wrist_1 wrist_2 wrist_3".split()
STUDY = 'seeds = 2\n[settings]\nrobot = "arm.dh.toml"\nkind = ["pose", "position"]\nposes = 8\n'
FLEET = '[[job]]\nrobot = "arm.urdf"\ndata = "data.csv"\noutput = "o.urdf"\njson = "j.json"\n'
CALIBRATE = ("calibrate", "arm.urdf", "data.csv", "-o", "o.urdf", "--max-iterations", "3", "--extend", "none")


@dataclass(frozen=True)
class Case:
    """File that is mutated, and commands that read it.

    Attributes:
        name: Name of the file.
        data: Its content.
        commands: Words of the commands.
    """

    name: str
    data: bytes
    commands: Sequence[Sequence[str]]


def ur_kinematics() -> str:
    """Return a UR kinematics file."""
    lines = ["kinematics:"]
    for i, name in enumerate(NAMES):
        values = zip("x y z roll pitch yaw".split(), (0, 0.1 * i, 0.2, 0, 1.5, -3.1e-5), strict=True)
        lines += [f"  {name}:", *(f"    {key}: {value}" for key, value in values)]
    return "\n".join([*lines, "  hash: calib_1", ""])


def _bag(folder: Path, name: str) -> bytes:
    chain = read_robot(URDF / "experiment.urdf")
    q = np.random.default_rng(0).uniform(-1, 1, (5, chain.n_joints))
    path = write_bag(folder / name, Recording(chain, q, joint_rate=20, pose_rate=20, stop=1, move=0.5))
    found = path if path.is_file() else next(path.with_suffix("").glob("*.mcap"))
    return found.read_bytes()


def _tables() -> list[bytes]:
    """Return measurement files of several kinds."""
    q, lengths = "joint_1[deg],joint_2[deg],joint_3[deg]", "L1[mm],L2[mm],L3[mm]"
    sigmas = "sigma_L1[mm],sigma_L2[mm],sigma_L3[mm]"
    rows = [f"{7 * i},{2 * i},{-i}" for i in range(12)]
    poses = [f"{row},{400 + i},{50 - i},{i},1,0,0,0,fit" for i, row in enumerate(rows)]
    wires = [f"{row},{900 + i},{950 - i},{990},0.1,0.1,0.1" for i, row in enumerate(rows)]
    points = [f"{row},{'ab'[i % 2]}" for i, row in enumerate(rows)]
    return [
        positions_csv(8).encode(),
        "\n".join([f"{q},x[mm],y[mm],z[mm],qw,qx,qy,qz,set", *poses, ""]).encode(),
        "\n".join([f"{q},{lengths},{sigmas}", *wires, ""]).encode(),
        "\n".join([f"{q},point", *points, ""]).encode(),
    ]


def _foreign_table() -> bytes:
    """Return a measurement file of another maker."""
    rows = positions_csv(8).split("\n", 1)[1].replace(",", ";").replace(".", ",")
    return f"A1;A2;A3;X;Y;Z\n{rows}".encode()


def cases() -> list[Case]:
    """Return a file of each format."""
    measured = [CALIBRATE, ("inspect", "data.csv", "--robot", "arm.urdf")]
    of_table = ("calibrate", "arm.dh.toml", *CALIBRATE[2:])
    mapped = ("calibrate", "arm.urdf", "foreign.csv", *CALIBRATE[3:], "--columns", "map.toml")
    of_wires = ("calibrate", "arm.urdf", "wires.csv", *CALIBRATE[3:], "--instrument", "i.toml")
    compensate = ("compensate", "arm.urdf", "arm.urdf", "t.csv", "-o", "c.csv")
    topics = ("--robot", "arm.urdf", "--pose-topic", POSES, "--joint-topic", JOINTS)
    dh_csv = (
        b"# convention: standard\njoint,type,theta[deg],d[mm],a[mm],alpha[deg]\n"
        b"a,revolute,0,433,0,90\nb,revolute,0,0,400,0\nc,prismatic,0,12.5,345,0\n"
    )
    dh_toml = (URDF / "experiment.dh.toml").read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        bags = [
            Case(name, _bag(Path(folder), name), [("convert", name, "m.csv", *topics)])
            for name in ("r.bag", "r.mcap")
        ]
    return [
        *(Case("data.csv", table, measured) for table in _tables()),
        Case("foreign.csv", _foreign_table(), [mapped]),
        Case("map.toml", MAP.encode(), [mapped]),
        Case("arm.dh.toml", dh_toml, [("convert", "arm.dh.toml", "o.urdf"), ("check", "arm.dh.toml")]),
        Case("t.dh.csv", dh_csv, [("convert", "t.dh.csv", "o.urdf")]),
        Case("t.dh.csv", dh_csv, [("simulate", "t.dh.csv", "-m", "4", "-o", "s.csv")]),
        Case("k.yaml", ur_kinematics().encode(), [("convert", "k.yaml", "o.urdf")]),
        Case("arm.calibration.toml", SIDECAR.encode(), [("validate", "arm.urdf", "data.csv")]),
        Case("p.toml", b'"a*" = 0.001\n"alpha1" = 0.01\n', [(*of_table, "--priors", "p.toml")]),
        Case("b.toml", b"a2 = [0.3, 0.5]\n'alpha*' = [-2, 2.0]\n", [(*of_table, "--bounds", "b.toml")]),
        Case("i.toml", b'[instrument]\n"wire1.x" = 0.5\n', [of_wires]),
        Case("s.study.toml", STUDY.encode(), [("study", "s.study.toml", "-o", "s.csv")]),
        Case("f.fleet.toml", FLEET.encode(), [("calibrate", "f.fleet.toml", "-o", "f.csv", "--jobs", "1")]),
        Case("t.csv", b"x[mm],y[mm],z[mm]\n500,100,600\n400,-50,500\n", [compensate]),
        *bags,
    ]


CASES = cases()
TOKENS = [
    *("1e309", "-1e-320", "nan", "inf", "0x10", "1_000", "1,5", "9" * 400, "-0", "1e5", "true", "''", '""'),
    *("[", "]", "{", "}", "=", ":", ";", ",", "\t", "#", '"', "'''", "\\u0000", "&a", "*a", "!!int", "|"),
    *("[mm]", "[m]", "[deg]", "[rad]", "[in]", "[]", "set", "holdout", "point", "sigma_x[mm]", "time[s]"),
    *("\x00", "\r", "\n\n", "\u2028", "\ufeff", "\u202e", "\x1b[31m", "\ud7ff", "é", "../", "/dev/null"),
]
WORD = re.compile(rb"\w+|\s+|[^\w\s]")
MUTATION = st.tuples(
    st.sampled_from(["words", "bytes"]),
    st.sampled_from(["delete", "repeat", "insert", "replace", "swap", "number", "flip"]),
    st.floats(0, 1, exclude_max=True),
    st.floats(0, 1, exclude_max=True),
    st.integers(1, 12),
    st.sampled_from(TOKENS) | st.floats().map(repr) | st.integers(-(10**6), 10**6).map(str),
)
EXAMPLES = {"case": st.sampled_from(CASES), "mutations": st.lists(MUTATION, min_size=1, max_size=4)}


def mutated(data: bytes, mutations: Sequence[tuple[str, str, float, float, int, str]]) -> bytes:
    """Return bytes after some mutations."""
    for grain, what, at, to, size, text in mutations:
        token = text.encode(errors="surrogatepass")
        parts = WORD.findall(data) if grain == "words" else [data[i : i + 1] for i in range(len(data))]
        i, j = sorted((int(at * len(parts)), int(to * len(parts))))
        if what == "delete":
            parts[i : i + size] = []
        elif what == "repeat":
            parts[j:j] = parts[i : i + size]
        elif what == "insert":
            parts[i:i] = [token]
        elif what == "replace":
            parts[i : i + 1] = [token]
        elif what == "swap" and i + size <= j:
            parts[i : i + size], parts[j : j + size] = parts[j : j + size], parts[i : i + size]
        elif what == "number":
            numbers = [k for k, part in enumerate(parts) if part[:1].isdigit()]
            if numbers:
                parts[numbers[int(at * len(numbers))]] = token
        elif what == "flip" and i < len(parts):
            parts[i] = bytes([parts[i][0] ^ (1 << size % 8)]) + parts[i][1:]
        data = b"".join(parts)
    return data


def survive(case: Case, data: bytes, heard: set[str] | None = None) -> None:
    """Run the commands on a mutated file: done, or refused in one line with nothing written.

    Args:
        case: File and commands.
        data: Content of the file.
        heard: Receives the messages.
    """
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        shutil.copy(URDF / "experiment.urdf", "arm.urdf")
        shutil.copy(URDF / "experiment.dh.toml", "arm.dh.toml")
        Path("data.csv").write_text(positions_csv(8))
        Path("map.toml").write_text(MAP)
        Path("foreign.csv").write_bytes(_foreign_table())
        Path("wires.csv").write_bytes(_tables()[2])
        Path(case.name).write_bytes(data)
        for words in case.commands:
            before = {path: path.read_bytes() for path in Path().iterdir()}
            said, out = io.StringIO(), io.StringIO()
            start = time.process_time()
            with contextlib.redirect_stderr(said), contextlib.redirect_stdout(out):
                status = main(words)
            assert time.process_time() - start < 20
            assert status in (0, 1, 2, 3), words
            if status == 2:
                message = said.getvalue()
                assert message.startswith("dhcal: "), message
                assert message.count("\n") == 1, message
                assert message[:-1].isprintable(), message
                assert len(message) < 1500, message
                if heard is not None:
                    heard.add(message)
                assert {path: path.read_bytes() for path in Path().iterdir()} == before
