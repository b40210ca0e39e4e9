"""Commands of `dhcal` in a process of their own, and what they report.

A crash or a lack of memory ends that process only, and it can be stopped at any time. Each function yields
messages for the page, dictionaries that JSON can hold:

- `{"phase": TEXT, "step": N, "total": N}`: progress;
- `{"boards": [...], "notes": [TEXT]}`: in how many photographs each board was found, and notes on them;
- `{"error": TEXT}`: one line that says what is wrong and what is expected; the last message;
- `{"result": DOCUMENT, ...}`: the JSON document of the command; the last message. A calibration adds `status`
  (`done` or `refused`), `screen` (what the command shows) and `files`: name, label, use and content in
  base64.

A request without the files that a command needs raises `InvalidArgumentError`; the server sends it as an
error.
"""

from __future__ import annotations

import asyncio
import base64
import json
import os
import re
import signal
import sys
from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from contextlib import aclosing, asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from ..exceptions import InvalidArgumentError
from .upload import Upload

# Module that is the command `dhcal`, and the one that ends it with the server.
_PROGRAM, _CHILD = f"{__name__.split('.')[0]}.cli", f"{__package__}.child"
# Exit status of invalid input and of a refused calibration.
_INVALID_INPUT, _REFUSED = 2, 3
# Longest line that a command may print [bytes].
_MAX_LINE_BYTES = 1 << 22
_PROGRESS = re.compile(r"progress: (.*) (\d+)/(\d+)")
_PREFIX = re.compile(r"^dhcal( \w+)?: ")
_SEE_HELP = re.compile(r"; see dhcal \w+ --help$")
_REPORT, _SCENE, _RESULT, _RESIDUALS = "report.html", "scene.html", "result.json", "residuals.csv"
# Corners that are found in photographs, and the page with a board.
_CORNERS, _BOARD = "corners.csv", "board.pdf"
# Files of a calibration, by their names or by what follows the name of the robot: what each is, and its use.
OUTPUTS = {
    ".json": ("Corrected calibration of LeRobot", "copy it over the old file of the arm"),
    ".urdf": ("Corrected URDF", "use it in place of the old one; keep the sidecar beside it"),
    ".calibration.toml": ("Sidecar", "base, tool and joint errors, which dhcal reads with the URDF"),
    ".servos.toml": ("Servo file with the new zeros", "for counts of servos with the old homing offsets"),
    _REPORT: ("Report", "accuracy, corrections and warnings, to read and to keep"),
    _SCENE: ("3-D scene", "the robot before and after, to look at"),
    _CORNERS: ("Corners in the photographs", "measurements in place of the photographs"),
    _RESIDUALS: ("Residuals", "the error of each row, to find wrong rows"),
    _RESULT: ("All figures as JSON", "for other programs"),
}
# Phase of a search for corners.
_DETECTING = {"phase": "finding the board in the photographs", "step": 1, "total": 1}


async def inspect(upload: Upload, folder: Path) -> AsyncGenerator[dict[str, Any], None]:
    """Yield messages about what the measurement files in a folder contain."""
    upload.require_data()
    if upload.images:
        if error := await _detect(upload, folder):
            yield error
            return
        found = _read_json(folder)
        yield {key: found[key] for key in ("boards", "notes")}
    robot = [f"--robot={upload.robot}"] if upload.robot else []
    names = ("tip", "columns", "rig", "servos", "sheet") if robot else ("rig", "sheet")
    robot += [word for name in names for word in upload.option(name)]
    run = _Run(folder)
    await run.finish("inspect", *_measurements(upload), *robot, f"--json={_RESULT}")
    yield run.error() or {"result": _read_json(folder)}


def _measurements(upload: Upload) -> tuple[str, ...]:
    """Return the names of the measurement files, with the corners in place of the table of photographs."""
    return (_CORNERS, *upload.data[1:]) if upload.images else upload.data


async def _detect(upload: Upload, folder: Path) -> dict[str, str]:
    """Find the corners in the photographs of a folder; return an error, if there is one."""
    rig = upload.option("rig")
    if not rig:
        return {"error": "photographs need a rig file; add one with a camera and a board (.toml)"}
    run = _Run(folder)
    await run.finish(
        "detect", *upload.images, *rig, f"--joints={upload.data[0]}", "-o", _CORNERS, f"--json={_RESULT}"
    )
    return run.error()


async def calibrate(upload: Upload, folder: Path) -> AsyncGenerator[dict[str, Any], None]:
    """Calibrate the robot with the files in a folder, and yield messages about it."""
    if not upload.robot:
        raise InvalidArgumentError("no robot file; add a URDF or a DH table")
    upload.require_data()
    if upload.images:
        yield _DETECTING
        if error := await _detect(upload, folder):
            yield error
            return
    stem = f"{upload.robot_name}_calibrated"
    is_lerobot = any(word.lower().endswith(".json") for word in upload.option("servos"))
    output = f"{stem}.json" if is_lerobot else f"{stem}.urdf"
    files = [f"--report={_REPORT}", f"--scene={_SCENE}", f"--json={_RESULT}", f"--residuals={_RESIDUALS}"]
    words = [upload.robot, *_measurements(upload), *upload.options, "-o", output, *files, "--progress=lines"]
    run = _Run(folder)
    screen = []
    async with aclosing(run.lines("calibrate", *words)) as lines:
        async for line in lines:
            if match := _PROGRESS.fullmatch(line):
                yield {"phase": match[1], "step": int(match[2]), "total": int(match[3])}
            else:
                screen.append(line)
    if error := run.error(_REFUSED):
        yield error
        return
    result = _read_json(folder)
    written = {*result["files"].values(), *([_CORNERS] if upload.images else [])}
    names = {stem + key if key.startswith(".") else key: about for key, about in OUTPUTS.items()}
    yield {
        "result": result,
        "status": "refused" if run.status == _REFUSED else "done",
        "screen": "\n".join(screen),
        "files": [_content(folder / name, *about) for name, about in names.items() if name in written],
    }


async def board(upload: Upload, folder: Path) -> AsyncGenerator[dict[str, Any], None]:
    """Draw the board of a rig file on a page to print, and yield the page."""
    run = _Run(folder)
    rig = [word.partition("=")[2] for word in upload.option("rig")]
    await run.finish("board", *rig, *upload.option("paper"), "-o", _BOARD)
    yield run.error() or {"result": {}, "files": [_content(folder / _BOARD, "Board to print", "")]}


def _content(path: Path, label: str, use: str) -> dict[str, str]:
    """Return a file for the page."""
    content = base64.b64encode(path.read_bytes()).decode()
    return {"name": path.name, "label": label, "use": use, "content": content}


def _read_json(folder: Path) -> Any:
    """Read the JSON document of a command."""
    return json.loads((folder / _RESULT).read_text(encoding="utf-8"))


class _Run:
    """One run of `dhcal` in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._last_line = ""
        self.status: int | None = None  # Exit status; None before the end

    async def lines(self, *words: str) -> AsyncGenerator[str, None]:
        """Run a command and yield the lines that it prints on stderr; stop it if the caller stops."""
        async with _started(words, self._folder) as process:
            assert process.stderr is not None
            async for data in process.stderr:
                line = data.decode(errors="replace").rstrip("\n")
                self._last_line = line.strip() or self._last_line
                yield line
            self.status = await process.wait()

    async def finish(self, *words: str) -> None:
        """Run a command to its end."""
        async with aclosing(self.lines(*words)) as lines:
            async for _ in lines:
                pass

    def error(self, *accepted: int) -> dict[str, str]:
        """Describe the failure of the command."""
        if self.status in (0, *accepted):
            return {}
        if self.status == _INVALID_INPUT:
            text = _SEE_HELP.sub("", _PREFIX.sub("", self._last_line))
            return {"error": text.replace("choose another output path", "rename it: a result has this name")}
        return {"error": f"the calculation ended unexpectedly (exit status {self.status}); try fewer samples"}


@asynccontextmanager
async def _started(words: Sequence[str], folder: Path) -> AsyncIterator[asyncio.subprocess.Process]:
    """Start `dhcal` in a folder; at the end of the block it and all processes it started are stopped."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", _CHILD, _PROGRAM, *words),
        cwd=folder,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
        limit=_MAX_LINE_BYTES,
        # The command finds the same modules. A file of the folder cannot take the place of one.
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "PYTHONSAFEPATH": "1"},
        start_new_session=True,
    )
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        await process.wait()
