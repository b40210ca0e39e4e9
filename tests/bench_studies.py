"""Studies that answer questions before a measurement, on six simulated arms: docs/evidence/studies.

    python tests/bench_studies.py [--studies poses,spread,planned,reflectors] [-o FOLDER]

Each true arm has random errors of every joint origin (1 mm, 0.3°). Base, tool and the minimal geometric
parameters are estimated. The error is the RMS distance of the calibrated from the true arm at 100 random
configurations of the whole joint space; per setting it is the median and the 90 % quantile over the simulated
arms. One JSON file per study is written; two runs give equal files. All take about five minutes of processor
time.

    poses        how many poses, for four instruments
    spread       how large a part of each joint range the poses cover
    planned      planned against random poses
    reflectors   a second reflector on the tool, and its distance from the first one
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_common import fit_geometry
from robots import ROOT

from dhcal_pin.estimation import select_parameters
from dhcal_pin.io import read_robot
from dhcal_pin.measurements import MultiTargetPosition, Noise
from dhcal_pin.planning import plan
from dhcal_pin.robot import Chain
from dhcal_pin.robot.sampling import joint_range
from dhcal_pin.ros_packages import resolve_robot_path
from dhcal_pin.studies import read_study
from dhcal_pin.studies.grid import StudyGrid, draw_configurations
from dhcal_pin.studies.runner import result_table, run, run_block

FOLDER = ROOT / "docs" / "evidence" / "studies"
ARMS = {
    "UR10": ("example:ur10", "tool0"),
    "Panda": ("example:panda", "panda_link8"),
    "xArm 7": ("example:xarm7", "link_eef"),
    "Z1": ("example:z1", "link06"),
    "Kinova j2s6s200": ("example:kinova", "j2s6s200_end_effector"),
    "Baxter, left": ("example:baxter", "left_gripper"),
}
INSTRUMENTS = {
    "laser tracker, position": ("position", "0.02mm"),
    "laser tracker, pose": ("pose", "0.02mm,0.005deg"),
    "optical tracker, position": ("position", "0.1mm"),
    "optical tracker, pose": ("pose", "0.1mm,0.03deg"),
}
POSES = (8, 10, 12, 15, 20, 30, 50, 100, 200)
SEEDS = 100
# Parts of each joint range that the poses cover, and the number of random places of that part.
PARTS, PLACES = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0), 5
# Distances of the second reflector [m], arms of each setting, and the noise of each axis [m].
DISTANCES, REFLECTOR_SEEDS, NOISE = (0.05, 0.1, 0.2, 0.4), 12, 2e-5
# Number of random configurations from which poses are planned.
N_CANDIDATES = 2000


def grid(arm: str, seeds: int = SEEDS, **settings: Any) -> StudyGrid:
    """Read the study of one arm with these settings."""
    robot, tip = ARMS[arm]
    lines = [
        f"{key} = {json.dumps(value)}" for key, value in ({"robot": robot, "tip": tip} | settings).items()
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "arm.study.toml")
        path.write_text("\n".join([f"seeds = {seeds}", "[settings]", *lines]), encoding="utf-8")
        return read_study(path)


def simulated(arm: str, label: str, varied: str, **settings: Any) -> Iterator[dict]:
    """Run the study of one arm and yield one row per value of the varied setting."""
    study = grid(arm, **settings)
    header, rows = result_table(study, list(run(study)))
    for row in rows:
        cells = dict(zip(header, row, strict=True))
        yield result_row(arm, label, cells[varied], cells["position_rms[m]"], cells["position_rms_p90[m]"])


def result_row(arm: str, label: str, value: float, median: float, high: float) -> dict:
    """Return a row of a JSON file; four digits, so that other processors give the same file."""
    median, high = (float(f"{error:.4g}") for error in (median, high))
    return {"arm": arm, "line": label, "value": value, "median_m": median, "p90_m": high}


def by_poses(arm: str) -> Iterator[dict]:
    """Error by number of random poses, for each instrument."""
    for label, (kind, noise) in INSTRUMENTS.items():
        yield from simulated(arm, label, "poses", kind=kind, noise=noise, poses=list(POSES))


def by_planning(arm: str) -> Iterator[dict]:
    """Error of random poses and of those that `plan` chooses from random ones, measured by a laser tracker.

    Collisions are not checked, neither of random nor of planned poses.
    """
    counts = [10, 15, 30]
    kind, noise = "position", "0.02mm"
    yield from simulated(arm, "random", "poses", kind=kind, noise=noise, poses=counts)
    study = grid(arm, kind=kind, noise=noise, poses=counts)
    for case in study.cases:
        candidates = draw_configurations(case.nominal, N_CANDIDATES, np.random.default_rng(0))
        planned = plan(
            case.nominal,
            case.setting.poses,
            kind="position",
            noise=Noise(NOISE),
            parameters=case.setting.parameters,
            candidates=candidates,
        )
        block = run_block((replace(case, poses=planned.q), 0, study.seeds))
        errors = [row[5] for row in block]
        median, high = float(np.median(errors)), float(np.quantile(errors, 0.9))
        yield result_row(arm, "planned", case.setting.poses, median, high)


def by_spread(arm: str) -> Iterator[dict]:
    """Error everywhere in joint space of 30 poses that cover a part of each joint range."""
    for label, (kind, noise) in list(INSTRUMENTS.items())[:2]:
        study = grid(arm, SEEDS // PLACES, kind=kind, noise=noise, poses=30)
        (case,) = study.cases
        low, high = joint_range(case.nominal)
        for part in PARTS:
            errors: list[float] = []
            for place in range(PLACES):
                rng = np.random.default_rng(place)
                width = part * (high - low)
                start = low + rng.random(len(low)) * (high - low - width)
                poses = rng.uniform(start, start + width, (30, case.nominal.n_joints))
                # Other arms at each place.
                block = run_block((replace(case, poses=poses), place * study.seeds, study.seeds))
                errors += [row[5] for row in block]
            yield result_row(arm, label, part, float(np.median(errors)), float(np.quantile(errors, 0.9)))


def by_reflectors(arm: str) -> Iterator[dict]:
    """Error of the first reflector, with and without a second one at some distance, by number of poses."""
    robot, tip = ARMS[arm]
    chain = read_robot(resolve_robot_path(robot), tip)
    settings = [("one reflector", 0.0), *((f"second one at {1e3 * each:.0f} mm", each) for each in DISTANCES)]
    for label, distance in settings:
        for poses in (15, 30):
            errors = [_reflector_error(chain, poses, distance, seed) for seed in range(REFLECTOR_SEEDS)]
            yield result_row(arm, label, poses, float(np.median(errors)), float(np.quantile(errors, 0.9)))


def _reflector_error(chain: Chain, poses: int, distance: float, seed: int) -> float:
    """Calibrate one simulated arm and return its RMS position error at the first reflector [m]."""
    rng = np.random.default_rng(seed)
    errors = select_parameters(chain, "placement")
    std = np.array([1e-3 if parameter.unit == "m" else np.radians(0.3) for parameter in errors.parameters])
    true = errors.at(std * rng.standard_normal(len(std)))
    low, high = joint_range(chain)
    q, test = (rng.uniform(low, high, (count, chain.n_joints)) for count in (poses, 100))
    direction = rng.standard_normal(3)
    frames = true.poses(q)
    first = frames[:, :3, 3]
    second = first + frames[:, :3, :3] @ (distance * direction / np.linalg.norm(direction))
    positions, names = [first], ["a"] * poses
    if distance:
        positions, names = [first, second], names + ["b"] * poses
    seen = np.concatenate(positions)
    seen += NOISE * rng.standard_normal(seen.shape)
    data = MultiTargetPosition(np.tile(q, (len(positions), 1)), seen, names)
    fit = fit_geometry(chain, data, "minimal,base,tool")
    miss = fit.chain.poses(test)[:, :3, 3] - true.poses(test)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(miss**2, 1))))


STUDIES = {"poses": by_poses, "spread": by_spread, "planned": by_planning, "reflectors": by_reflectors}


def main() -> None:
    """Run the chosen studies and write one JSON file for each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--studies", default=",".join(STUDIES), help="default: all")
    parser.add_argument("-o", "--out", type=Path, default=FOLDER, metavar="FOLDER")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.studies.split(","):
        rows: list[dict] = []
        for arm in ARMS:
            print(f"{name}: {arm}", file=sys.stderr, flush=True)
            rows += STUDIES[name](arm)
            lines = ",\n".join(f"  {json.dumps(row)}" for row in rows)
            (args.out / f"{name}.json").write_text(f"[\n{lines}\n]\n", encoding="utf-8")


if __name__ == "__main__":
    main()
