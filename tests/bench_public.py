"""Accuracy on public measurements of real robots: the table of the README and of the documentation.

    python tests/bench_public.py [--data DIR]

Each series is calibrated by `dhcal calibrate` with its defaults, once with a random half held out and once
with the regions of joint space left out (`--holdout region`). "Nominal" is the error of the robot as
designed, with base and tool fitted to the same samples. The folder DIR has the layout of shared/data beside
the project. A series that is absent is left out.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from robots import DATA, MAPS


@dataclass(frozen=True)
class Series:
    """Public measurements of one robot.

    Attributes:
        arm: Name of the robot and of the series.
        instrument: What measured it.
        robot: Robot, relative to the folder of the data if it is a file.
        files: Pattern of the measurement files.
        options: Further options of `dhcal calibrate`.
    """

    arm: str
    instrument: str
    robot: str
    files: str
    options: tuple[str, ...] = ()


SERIES = (
    Series(
        "UR10, series B",
        "laser tracker, pose",
        "example:ur10",
        "ipa_ur10/Series_B/measurements_joint_configurations.csv",
        ("--tip", "tool0", "--columns", str(MAPS / "ipa_ur10.toml")),
    ),
    Series(
        "UR10, series D",
        "laser tracker, pose",
        "example:ur10",
        "ipa_ur10/Series_D/measurements_iso_cubes.csv",
        ("--tip", "tool0", "--columns", str(MAPS / "ipa_ur10.toml")),
    ),
    Series(
        "Franka Research 3",
        "camera on the wrist, pose of the board",
        "example:panda",
        "fr3_d405/camera_in_board.csv",
        ("--tip", "panda_link8"),
    ),
    Series(
        "two-axis positioner",
        "metrology camera, pose",
        "positioner_2axis/positioner.dh.toml",
        "positioner_2axis/measurements.csv",
        ("--parameters", "minimal,base,tool"),
    ),
    Series(
        "Franka Panda",
        "sockets touched with a ball",
        "mukca_panda/panda_with_ball.urdf",
        "mukca_panda/panda_2_clean/*/hole_[01].csv",
        ("--tip", "ball_link", "--columns", str(MAPS / "mukca_panda.toml"), "--parameters", "placement,tool"),
    ),
)


def calibrate(series: Series, data: Path, holdout: str) -> dict:
    """Calibrate a robot by the command line.

    Args:
        series: Measurements of the robot.
        data: Folder of all series.
        holdout: Option `--holdout`.

    Returns:
        JSON document of the calibration.
    """
    robot = series.robot if series.robot.startswith("example:") else str(data / series.robot)
    files = sorted(map(str, data.glob(series.files)))
    with tempfile.TemporaryDirectory() as folder:
        words = ["calibrate", robot, *files, *series.options, "--holdout", holdout, "--force"]
        words += ["-o", f"{folder}/out.urdf", "--json", f"{folder}/out.json"]
        run = subprocess.run([sys.executable, "-m", "dhcal_pin.cli", *words], capture_output=True, text=True)
        if run.returncode:
            raise SystemExit(f"{series.arm}: {run.stderr}")
        return json.loads(Path(folder, "out.json").read_text(encoding="utf-8"))


def millimetres(accuracy: dict | None) -> str:
    """Format the RMS error of an accuracy; a dash if it is unknown."""
    value = (accuracy or {}).get("position_rms_m", (accuracy or {}).get("residual_rms"))
    return f"{1e3 * value:.2f}" if value is not None else "–"


def main() -> None:
    """Print one row per series as Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="folder of the measurements")
    data = parser.parse_args().data
    print("| arm | instrument | samples | nominal | calibrated | held out | regions left out |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for series in SERIES:
        if not list(data.glob(series.files)):
            continue
        half, regions = (calibrate(series, data, holdout) for holdout in ("0.5", "region"))
        cells = [series.arm, series.instrument, str(half["samples"] + half["samples_holdout"])]
        cells += map(millimetres, (half["holdout_before"], half["after"], half["holdout_after"]))
        cells.append(millimetres(regions["holdout_region_after"]))
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
