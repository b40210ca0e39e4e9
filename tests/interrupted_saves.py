"""Saves that are interrupted or killed at a chosen instruction, and what they leave behind.

Run as a script in a process of its own, because it forks: `interrupted_saves.py FOLDER SIGNAL START STRIDE`.
"""

import json
import os
import signal
import sys
from pathlib import Path

from signal_steps import count_steps, run_in_child

from dhcal_pin.saving import complete_interrupted_save, write_files

# Files by path, before and after. One is new, one is removed, one lies behind a link in a third folder.
OLD = {"a/robot.urdf": b"old robot", "a/robot.toml": b"old sidecar", "a/journal": b"journal", "c/far": b"far"}
NEW = {
    "a/robot.urdf": b"new robot",
    "a/robot.toml": b"new sidecar",
    "b/report": b"report",
    "c/far": b"new far",
}
CONTENTS = {
    "a/robot.urdf": "new robot",
    "a/robot.toml": b"new sidecar",
    "b/report": "report",
    "b/link": b"new far",
}


def begin(root: Path) -> None:
    """Make the old files, and nothing else."""
    for folder in "abc":
        (root / folder).mkdir(exist_ok=True)
        for path in (root / folder).iterdir():
            path.unlink()
    for name, content in OLD.items():
        (root / name).write_bytes(content)
    (root / "b/link").symlink_to(root / "c/far")


def files(root: Path) -> dict[str, bytes]:
    """Return all files, without links."""
    paths = (path for folder in "abc" for path in (root / folder).iterdir() if not path.is_symlink())
    return {str(path.relative_to(root)): path.read_bytes() for path in paths}


def save(root: Path) -> None:
    """Write the new files."""
    write_files({**{root / name: content for name, content in CONTENTS.items()}, root / "a/journal": None})


def targets(root: Path) -> dict[str, bytes]:
    """Return the files without temporary files and records."""
    return {name: content for name, content in files(root).items() if "/.dhcal-" not in name}


def check(root: Path, step: int, number: int) -> str:
    """Interrupt a save at a step, check all files, and return how they were left."""
    begin(root)
    status = run_in_child(lambda: save(root), step, number)
    left = "old" if targets(root) == OLD else "new" if targets(root) == NEW else "mixed"
    if number != signal.SIGKILL:
        # An interrupted run leaves nothing behind, whether it is killed by the signal or ends itself.
        assert left != "mixed", (step, status, files(root))
        assert files(root) == (OLD if left == "old" else NEW), (step, status, files(root))
        assert status == (130 if number == signal.SIGINT else -number) or left == "new", (step, status)
    # The next command reads in one of the folders.
    complete_interrupted_save(root / ("a/robot.urdf", "b/report", "c/far")[step % 3])
    assert targets(root) in (OLD, NEW), (step, status, files(root))
    if left == "new":
        assert targets(root) == NEW, (step, status, files(root))
    # The next run leaves its own files only.
    save(root)
    assert files(root) == NEW, (step, status, files(root))
    assert (root / "b/link").is_symlink()
    return left


def main(folder: str, name: str, start: str, stride: str) -> None:
    """Interrupt saves at every so many steps, and print how many left what."""
    os.fsync = lambda descriptor: None  # the disk takes most of the time and does not matter here
    root = Path(folder)
    begin(root)
    save(root)  # also loads modules
    begin(root)
    steps = count_steps(lambda: save(root))
    left = [check(root, step, signal.Signals[name]) for step in range(int(start), steps, int(stride))]
    print(json.dumps({"steps": steps} | {key: left.count(key) for key in ("old", "mixed", "new")}))


if __name__ == "__main__":
    main(*sys.argv[1:])
