"""Random robots, measurements and options through chains of commands: they end with a documented status."""

import json
from pathlib import Path

import numpy as np
import pytest
from robots import URDF
from slow_cases import some_slow

from dhcal_pin.measurements import KINDS

ROBOTS = (
    *("example:ur5", "example:ur10", "example:z1", "example:xarm7", "example:double_pendulum"),
    *(str(URDF / name) for name in ("sim_6dof.dh.toml", "sim_3dof.dh.toml", "experiment.urdf")),
)
# Chances of options of `calibrate`, and their values.
OPTIONS = {
    "--parameters": (0.2, "minimal placement offset base,tool tool low-cost gain minimal,tool,harmonics"),
    "--extend": (0.3, "none auto harmonics gain compliance,curves coupling"),
    "--holdout": (0.3, "0.3 0.5 region test.csv"),
    "--loss": (0.2, "linear huber cauchy tukey"),
    "--priors": (0.2, "none default"),
    "--arm": (0.1, "low-cost"),
    "--session": (0.1, "off"),
    "--max-iterations": (0.1, "1 5"),
    "--payload": (0.1, "2kg@0,0,80mm"),
    "--report": (0.1, "r.html r.md"),
    "--map": (0.1, "m.csv m.html"),
    "--curves": (0.1, "curves.csv"),
    "--residuals": (0.1, "residuals.csv"),
    "--bundle": (0.1, "b.dhcal.zip"),
}
FLAGS = ("--unordered", "--world-joint", "--force", "--strict", "--verbose", "--skip-bad-rows")
# Commands on a calibrated robot `out.urdf`.
FURTHER = (
    "recheck out.urdf test.csv",
    "diff {robot} out.urdf",
    "export out.urdf -o model.py",
    "convert out.urdf other.dh.toml",
    "view {robot} out.urdf --html scene.html --no-open",
    "plan out.urdf -n 6 -o plan.csv --candidates 100",
    "check out.urdf",
    "inspect train.csv --robot {robot}",
    "validate out.urdf test.csv --fit-frames",
)


def disturbed(rows: list[str], rng: np.random.Generator) -> list[str]:
    """Return rows of a file of which some are permuted, repeated, rounded, or all equal."""
    kind = rng.choice(["none", "none", "none", "permuted", "repeated", "rounded", "equal"])
    if kind == "permuted":
        return list(rng.permutation(rows))
    if kind == "repeated":
        return [*rows, *rows[: len(rows) // 3 + 1]]
    if kind == "rounded":
        # Standard deviations keep their digits, as 0 is refused.
        return [
            ",".join(v[:6] if "." in v and abs(float(v)) > 1e-2 else v for v in r.split(",")) for r in rows
        ]
    return [rows[0]] * len(rows) if kind == "equal" else rows


def random_options(rng: np.random.Generator) -> list[str]:
    """Draw options of a calibration."""
    out = [each for each in FLAGS if rng.random() < 0.1]
    for name, (chance, values) in OPTIONS.items():
        if rng.random() < chance:
            out += [name, str(rng.choice(values.split()))]
    return out


def check_commands(seed: int, run) -> None:
    """Simulate, calibrate, and use the result: no traceback, valid JSON, and a refusal writes nothing."""
    rng = np.random.default_rng(seed)
    robot, kind = str(rng.choice(ROBOTS)), str(rng.choice(list(KINDS)))
    count = int(rng.choice([1, 2, 3, 5, 8, 12, 20, 35, 60]))
    noise = "0.2px" if kind == "camera" else str(rng.choice(["0mm", "0.1mm,0.1mrad", "2mm,3mrad"]))
    errors = str(rng.choice(["0mm,0mrad", "0.5mm,0.5mrad", "2mm,5mrad", "20mm,30mrad"]))
    command = f"simulate {robot} -n {count + 40} --sigma {noise} --errors {errors} --kind {kind}"
    status, _, err = run(*command.split(), "--seed", seed, "-o", "data.csv")
    if "out of reach" in err:
        return
    assert status == 0
    comment, head, *rows = Path("data.csv").read_text().splitlines()
    Path("train.csv").write_text("\n".join([comment, head, *disturbed(rows[:count], rng), ""]))
    Path("test.csv").write_text("\n".join([comment, head, *(rows[count:] or rows), ""]))
    rig = ["--rig", "data.rig.toml"] if kind == "camera" else []

    def call(line: str, *options: str) -> None:
        before = sorted(Path().iterdir())
        status, out, err = run(*line.format(robot=robot).split(), *options, "--json", "-")
        assert status in (0, 1, 2, 3, 4), line
        if status == 2 and not out:
            assert (err.count("\n"), sorted(Path().iterdir())) == (1, before), err
        else:
            json.loads(out, parse_constant=pytest.fail)

    call("calibrate {robot} train.csv -o out.urdf", *rig, *random_options(rng))
    if Path("out.urdf").exists():
        call("validate out.urdf test.csv", *rig)
        for line in rng.choice(FURTHER, 2, replace=False):
            call(str(line), *(rig if "train.csv" in line or "--fit-frames" in line else []))


@pytest.mark.parametrize("start", some_slow(range(0, 300, 5), [0]))
def test_commands_end_with_a_result_or_one_line(start, run, tmp_path, monkeypatch):
    for seed in range(start, start + 5):
        (folder := tmp_path / str(seed)).mkdir()
        monkeypatch.chdir(folder)
        check_commands(seed, run)
