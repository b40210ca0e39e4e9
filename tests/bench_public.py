"""Accuracy on public measurements of real robots: the table of the README and of the documentation.

    python tests/bench_public.py [--data DIR] [--alone]

Each series is calibrated by `dhcal calibrate` with its defaults, once with a random half held out and once
with the regions of joint space left out (`--holdout region`). "Nominal" is the error of the robot as
designed, with base and tool fitted to the same samples. The folder DIR has the layout of shared/data beside
the project. A series that is absent is left out.

figaroh and pybotics calibrate the same half and are judged by the same other half, where they can: both need
poses or positions of a robot with revolute joints, figaroh also a URDF. `--alone` leaves them out. pybotics
starts from the base and the tool that fit the nominal robot, because it does not find them.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import bench_rivals
from robots import DATA, MAPS

from dhcal_pin.calibration import split
from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.io import read_robot
from dhcal_pin.io.measurement_files import read_measurement_file
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.robot.chain import extract_dh_table


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


def run_command(series: Series, data: Path, holdout: str) -> dict:
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


def rivals(series: Series, data: Path) -> list[float | None]:
    """Return the RMS position errors [m] of figaroh and pybotics on the half that is held out.

    Args:
        series: Measurements of the robot.
        data: Folder of all series.

    Returns:
        Errors; None where a program cannot calibrate the series.
    """
    options = dict(zip(series.options[::2], series.options[1::2], strict=True))
    is_example = series.robot.startswith("example:")
    chain = read_robot(series.robot if is_example else data / series.robot, options.get("--tip"))
    if chain.prismatic.any():
        return [None, None]
    files = sorted(data.glob(series.files))
    measured = [read_measurement_file(path, chain, options.get("--columns")).fit for path in files]
    if len(measured) != 1 or not isinstance(measured[0], Pose):
        return [None, None]
    (fit,), (held,) = split(measured, 0.5)
    assert isinstance(fit, Pose)
    assert isinstance(held, Pose)
    is_urdf = is_example or series.robot.endswith(".urdf")
    by_figaroh = bench_rivals.figaroh(chain, fit, held) if is_urdf else None
    started = calibrate(chain, fit, "base,tool", extend="none").chain
    table = extract_dh_table(chain, "modified").table
    halves = [(part.q, part.poses[:, :3, 3]) for part in (fit, held)]
    frames = (started.base @ table.base, table.tool @ started.tool)
    by_pybotics = bench_rivals.pybotics(table, halves[0], halves[1], frames)
    return [found["holdout"] if found else None for found in (by_figaroh, by_pybotics)]


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
    parser.add_argument("--alone", action="store_true", help="without figaroh and pybotics")
    args = parser.parse_args()
    data = args.data
    header = "arm, instrument, samples, nominal, calibrated, held out, regions left out".split(", ")
    header += [] if args.alone else ["figaroh, held out", "pybotics, held out"]
    print(f"| {' | '.join(header)} |")
    print(f"| {' | '.join('---' for _ in header)} |")
    for series in SERIES:
        if not list(data.glob(series.files)):
            continue
        half, regions = (run_command(series, data, holdout) for holdout in ("0.5", "region"))
        cells = [series.arm, series.instrument, str(half["samples"] + half["samples_holdout"])]
        cells += map(millimetres, (half["holdout_before"], half["after"], half["holdout_after"]))
        cells.append(millimetres(regions["holdout_region_after"]))
        if not args.alone:
            cells += [f"{1e3 * error:.2f}" if error is not None else "–" for error in rivals(series, data)]
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
