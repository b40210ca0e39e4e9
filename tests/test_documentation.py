"""The documentation: commands and Python blocks run, names and messages exist, examples follow the schemas.

Blocks of a page run in the order of the page, in a folder of their own with the files of the examples:

- ```sh: commands `dhcal …`, and those of programs that the page compiles;
- ```python: Python, one namespace per page;
- ```toml, ```text and ```c that start with `# file: NAME` or `// file: NAME`: written to this file.

Other blocks of text are not executed. A block of text behind a line `<!-- output: last N -->` shows the last
N lines of the command before it, and one behind `<!-- start of: FILE -->` the first lines of a file. Numbers
may differ, and … stands for any text.
"""

import ast
import json
import re
import shlex
import shutil
import subprocess
import textwrap
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import schema_files
import tomli_w
from camera_setups import visible_corners, wrong_arm
from command_line import assert_shows
from robots import ROOT, nominal_arm

import dhcal_pin
from dhcal_pin import se3
from dhcal_pin.cameras import Camera, Rig
from dhcal_pin.cli import main
from dhcal_pin.estimation import parameters
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import measurement_text, read_dh
from dhcal_pin.io.rig_file import read_rig
from dhcal_pin.io.tables import sources
from dhcal_pin.measurements import CameraCorners
from dhcal_pin.measurements.images.camera_parameters import camera_parameters
from dhcal_pin.measurements.mounting import mount_rig
from dhcal_pin.studies import read_study

DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if "_build" not in path.parts)
SCHEMAS = {
    **schema_files.schemas(),
    "result": json.loads((DOCS / "reference" / "schemas" / "result.schema.json").read_text()),
}
_FENCE = re.compile(r"^( *)```(\w+)\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)
_OUTPUT = re.compile(r"<!-- output: last (\d+) -->\s*$")
_START = re.compile(r"<!-- start of: (\S+) -->\s*$")
# Fewer photographs are enough for the same commands.
SMALLER = {"howto/paper_arm.md": ("[:25]", "[:12]")}
# Pages that take long; `docs/evidence/tour.py` draws the figures of the tour whenever the pages are built.
SLOW = {"evidence/tour.md"}
_SIMULATE = "simulate ur10.urdf --tip tool0 -m"


def page_name(path: Path) -> str:
    return path.relative_to(DOCS).as_posix()


def run(command: str) -> None:
    """Run a command that must succeed."""
    assert main.main(shlex.split(command)) == 0, command


def run_program(command: str) -> list[str]:
    """Run a compiler or what it made, and return the lines that it prints."""
    if shutil.which("gcc") is None:
        pytest.skip("gcc is not installed")
    return subprocess.run(
        shlex.split(command), check=True, capture_output=True, text=True
    ).stdout.splitlines()


def blocks(page: Path) -> list[tuple[str, str, str]]:
    """Return the language, the text and the preceding text of each block of a page."""
    text = page.read_text(encoding="utf-8")
    return [
        (match[2], textwrap.dedent(match[3]), text[: match.start()].rstrip(" "))
        for match in _FENCE.finditer(text)
    ]


@pytest.fixture(scope="session")
def examples(tmp_path_factory):
    """Folder with the robots and measurements that the examples name."""
    folder = tmp_path_factory.mktemp("examples")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        shutil.copy(ROOT / "urdf" / "sim_3dof.dh.toml", "arm.dh.toml")
        shutil.copy(ROOT / "urdf" / "sim_3dof_actual.dh.toml", "arm_actual.dh.toml")
        run("convert example:ur10 ur10.urdf")
        run(f"{_SIMULATE} 100 --errors 1mm,0.3deg --noise 0.05mm --kind position -o laser.csv")
        shutil.copy("laser.csv", "other_day.csv")
        run("simulate arm.dh.toml --truth arm_actual.dh.toml -m 30 --noise 0.1mm,0.01deg -o arm.csv")
        run("calibrate ur10.urdf laser.csv --tip tool0 --extend none -o ur10_calibrated.urdf")
        run(f"{_SIMULATE} 60 --truth ur10_calibrated.urdf --noise 0.05mm,0.01deg --seed 1 -o pose.csv")
        for name in ("Series_D/measurements_iso_cubes.csv", "columns.toml"):
            shutil.copy(ROOT / "notebooks" / "data" / "ipa_ur10" / name, ".")
        Path("targets.csv").write_text("x[mm],y[mm],z[mm]\n600,200,500\n500,-300,400\n")
        lines = [line for line in Path("laser.csv").read_text().splitlines() if not line.startswith("#")]
        header = lines[0].split(",")
        rows = np.array([line.split(",") for line in lines[1:]], float)
        _write_foreign_file(header, rows)
        _write_images()
        rows[:, [name.startswith("elbow_joint") for name in header]] *= -1
        np.savetxt("wrong_sign.csv", rows, delimiter=",", header=lines[0], comments="")
    return folder


def _write_images() -> None:
    """Write the rig file of the guide to cameras, and 28 images of its board by a UR10 with errors."""
    texts = [text for _, text, _ in blocks(ROOT / "docs" / "howto" / "camera.md")]
    Path("charuco_rig.toml").write_text(next(text for text in texts if text.startswith("# file:")))
    rng = np.random.default_rng(0)
    arm = dhcal_pin.Chain.from_urdf("ur10.urdf", tip="tool0")
    actual = wrong_arm(arm, 1e-3, rng)
    rig = read_rig("charuco_rig.toml")
    (camera,), (board,) = rig.cameras.values(), rig.boards.values()
    home = np.array([0.4, -1.2, 1.4, -1.6, -1.5, 0.3])
    tool = actual.poses(home[None])[0]
    mounted = se3.transform(se3.exp3(np.array([0.1, -0.1, 0.5])), np.array([0.05, 0.0, 0.03]))
    middle = se3.transform(se3.exp3(np.array([0.2, 0.1, 0.0])), np.array([0.0, 0.0, 0.4]))
    corner = se3.transform(np.eye(3), -board.points.mean(0))
    values = camera.values * np.array([1.03, 1.03, 1.01, 0.99, *[1.0] * (len(camera.values) - 4)])
    placed = Rig(
        {camera.name: replace(camera, pose=mounted, values=values)},
        {board.name: replace(board, pose=tool @ mounted @ middle @ corner)},
    )
    rows = visible_corners(actual, mount_rig(placed, arm), home + 0.35 * rng.standard_normal((400, 6)))
    q, _, _, corners, pixels = (np.concatenate(each) for each in zip(*rows[:20], strict=True))
    pixels = pixels + 0.1 * rng.standard_normal(pixels.shape)
    images = CameraCorners(q, pixels, corners, mount_rig(rig, arm))
    Path("corners.csv").write_text(measurement_text(images, arm))


def _write_foreign_file(header: list[str], rows: np.ndarray) -> None:
    """Write measurements with another header, semicolons, decimal commas, degrees and millimetres."""
    factors = [180 / np.pi if "[rad]" in name else 1e3 if name.endswith("[m]") else 1.0 for name in header]
    names = [*(f"A{i}" for i in range(1, 7)), "X pos", "Y pos", "Z pos"]
    lines = [";".join(repr(x).replace(".", ",") for x in row) for row in (rows * factors)[:, :9].tolist()]
    Path("tracker.csv").write_text("\n".join([";".join(names), *lines]) + "\n")


@pytest.mark.usefixtures("uneventful", "untried", "ordered_axes")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.slow if page_name(page) in SLOW else ())
        for page in PAGES
        if blocks(page)
    ],
    ids=page_name,
)
def test_blocks_of_a_page_run_in_order(page, examples, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(shutil.copytree(examples, tmp_path / "page"))
    monkeypatch.syspath_prepend(tmp_path / "page")
    # What a page adds to the tables of the package is removed after its test.
    monkeypatch.setattr(parameters, "PARAMETER_SETS", dict(parameters.PARAMETER_SETS))
    monkeypatch.setattr(sources, "FORMATS", sources.FORMATS)
    namespace: dict = {}
    output: list[str] = []
    for _, text, _ in blocks(page):
        if name := re.match(r"(?:#|//) file: (\S+)\n", text):
            Path(name[1]).write_text(text, encoding="utf-8")
    old, new = SMALLER.get(page_name(page), ("", ""))
    for language, text, before in blocks(page):
        if old and language == "python":
            text = text.replace(old, new)
        if language == "sh":
            for line in text.replace("\\\n", " ").splitlines():
                if line.startswith(("gcc ", "./")):
                    output = run_program(line)
                    continue
                assert line.startswith("dhcal "), f"{line}: mark it as text, or begin it with dhcal"
                capsys.readouterr()
                words = shlex.split(line, comments=True)[1:]
                if words[0] == "plan" and "--candidates" not in words:
                    words += ["--candidates", "100"]  # Fewer than without the option, to save time.
                status = main.main(words)
                captured = capsys.readouterr()
                assert status == 0, f"{line}: {captured.err}"
                output = [one for one in (captured.out + captured.err).splitlines() if one.strip()]
        elif language == "python":
            exec(compile(text, page_name(page), "exec"), namespace)
        elif language == "toml":
            tomllib.loads(text)
        if shown := _OUTPUT.search(before):
            assert_shows(text, output[-int(shown[1]) :])
        if shown := _START.search(before):
            assert_shows(text, Path(shown[1]).read_text(encoding="utf-8").splitlines()[: text.count("\n")])


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_names_of_the_code_exist(page):
    missing = []
    for name in set(re.findall(r"`(dhcal_pin(?:\.\w+)+)`", page.read_text(encoding="utf-8"))):
        parts = name.split(".")
        value = dhcal_pin
        for i, part in enumerate(parts[1:], 1):
            try:
                value = getattr(value, part)
            except AttributeError:
                try:
                    value = import_module(".".join(parts[: i + 1]))
                except ImportError:
                    missing.append(name)
                    break
    assert missing == []


def source_texts() -> str:
    """Return all texts of the package; placeholders of messages become a gap."""
    out = []
    for path in Path(dhcal_pin.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                out.append(node.value)
            elif isinstance(node, ast.JoinedStr):
                parts = (part.value if isinstance(part, ast.Constant) else "…" for part in node.values)
                out.append("".join(map(str, parts)))
    return "\n".join(out)


def test_messages_of_the_troubleshooting_page_exist():
    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8").split("## No error")[0]
    messages = re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE)
    texts = source_texts()
    assert len(messages) > 40
    assert [message for message in messages if message not in texts] == []


def test_priors_are_those_of_their_page():
    page = (DOCS / "explanation" / "priors.md").read_text(encoding="utf-8")
    stated = {name: float(value) for name, value in re.findall(r"^\| (.*?) \| (\d[\d.e-]*)", page, re.M)}
    sets = "placement,offset,gain,harmonics,compliance,base,tool"
    errors = dhcal_pin.select_parameters(nominal_arm("ur10"), sets).parameters
    camera = Camera("c", "tip", 640, 480, np.pad([500.0, 500.0, 319.5, 239.5], (0, 5)))
    found = {p.name: p.prior for p in (*errors, *camera_parameters(camera))}
    for row, name, unit in (
        ("lengths", "elbow_joint.x", 1e-3),
        ("angles", "elbow_joint.rx", 1e-3),
        ("joint offsets, θ", "elbow_joint.offset", np.deg2rad(1)),
        ("base", "base.x", 1),
        ("tool", "tool.x", 1),
        ("gain, coupling", "elbow_joint.gain", 1),
        ("harmonics of order 1 and 2", "elbow_joint.sin1", 1e-3),
        ("compliance", "elbow_joint.compliance", 1),
        ('focal lengths, image centre (`intrinsics = "prior"`)', "camera_c.fx", 1),
        ('distortion (`intrinsics = "prior"`)', "camera_c.k1", 1),
    ):
        assert found[name] == pytest.approx(unit * stated[row]), row


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_examples_follow_the_schemas(page):
    for language, text, _ in blocks(page):
        if name := re.search(r"^# schema: (\w+)$", text, re.MULTILINE):
            assert language == "toml"
            jsonschema.validate(tomllib.loads(text), SCHEMAS[name[1]])


def test_shipped_studies_follow_the_schema():
    for path in (ROOT / "urdf").glob("*.study.toml"):
        jsonschema.validate(tomllib.loads(path.read_text()), SCHEMAS["study"])


def changed_tables(content: Any) -> Iterator[Any]:
    """Yield copies of a TOML document with one key absent, unknown, or of another type."""
    if isinstance(content, list):
        for i, entry in enumerate(content):
            yield from ([*content[:i], other, *content[i + 1 :]] for other in changed_tables(entry))
    elif isinstance(content, dict):
        for key, value in content.items():
            rest = {other: content[other] for other in content if other != key}
            yield from (rest, {**rest, f"{key}_": value})
            yield from ({**content, key: wrong} for wrong in (True, -7.5, "no such text", [], {"a": 1}))
            yield from ({**content, key: other} for other in changed_tables(value))


@pytest.mark.parametrize(
    ("name", "source", "read"),
    [
        ("dh", "arm.dh.toml", read_dh),
        ("rig", "charuco_rig.toml", read_rig),
        ("study", ROOT / "urdf" / "figure3.study.toml", read_study),
    ],
)
def test_readers_refuse_what_the_schemas_refuse(name, source, read, examples, tmp_path):
    validator = jsonschema.Draft202012Validator(SCHEMAS[name])
    content = tomllib.loads((examples / source).read_text())
    validator.validate(content)
    wrong = [each for each in changed_tables(content) if not validator.is_valid(each)]
    assert len(wrong) > 20
    path = tmp_path / f"wrong.{name}.toml"
    for each in wrong:
        path.write_text(tomli_w.dumps(each), encoding="utf-8")
        with pytest.raises(DhcalError, match=r"wrong\."):
            read(path)


def test_files_of_a_run_follow_the_schemas(examples, tmp_path, monkeypatch):
    monkeypatch.chdir(shutil.copytree(examples, tmp_path / "run"))
    run("calibrate ur10.urdf laser.csv --tip tool0 --holdout 0.3 -o out.urdf --json out.json")
    run("validate out.urdf laser.csv --tip tool0 --json validation.json")
    run("convert ur10.urdf ur10.dh.toml --tip tool0")
    documents = {
        "result": [json.loads(Path(name).read_text()) for name in ("out.json", "validation.json")],
        "sidecar": [tomllib.loads(Path("out.calibration.toml").read_text())],
        "rig": [tomllib.loads(Path("charuco_rig.toml").read_text())],
        "dh": [tomllib.loads(Path(name).read_text()) for name in ("ur10.dh.toml", "arm.dh.toml")],
        "column_map": [tomllib.loads(path.read_text()) for path in (ROOT / "tests" / "maps").glob("*.toml")],
    }
    for name, contents in documents.items():
        for content in contents:
            jsonschema.validate(content, SCHEMAS[name])
    broken = documents["result"][0] | {"verdict": {"status": "perfect", "reasons": []}}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(broken, SCHEMAS["result"])
