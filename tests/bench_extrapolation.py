"""Benchmark of extrapolation: 70 subsets of two real series of a UR10, each judged on the other samples.

    python tests/bench_extrapolation.py [--rule none|auto|FAMILY,...] [--every N] [--data DIR]

60 subsets are narrow: a quarter of the samples nearest to one in joint space or in Cartesian space, half
spaces, one configuration of the elbow, one octant of the workspace. 10 are wide or small. A subset is
calibrated by a rule (an argument of `calibrate(extend=...)`) and by the geometry alone. Both are judged on
the rest of the series and on the other series, with base and tool fitted to the judged samples. The table
has the ratios of the position RMS, rule to geometry: of both judged series together, as in a root mean square
over all of their samples, and of each judged series. `coverage` is the share of the position components of
the rest of the series that lie in their predicted 95 % interval, with the frames of the subset.

The data lie beside the project: shared/data/ipa_ur10 (MIT licence).
"""

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from robots import DATA, MAPS, nominal_arm

from dhcal_pin.calibration import Result, accuracy, calibrate
from dhcal_pin.io import read_measurements
from dhcal_pin.measurements import Measurement
from dhcal_pin.robot import Chain

FILES = {"B": "Series_B/measurements_joint_configurations.csv", "D": "Series_D/measurements_iso_cubes.csv"}
SETS = "minimal,base,tool"
WIDE = ("wide", "few")


@dataclass(frozen=True)
class Case:
    """Judged calibration of one subset."""

    kind: str  # Kind of the subset
    # Position RMS of the rule over that of the geometry, on the rest and on the other series.
    ratios: tuple[float, float]
    coverage: float  # Share of the errors on the rest that lie in their 95 % interval
    seconds: float  # Processor time of the calibration


def read_series(folder: Path) -> tuple[Chain, dict[str, Measurement]]:
    """Read the nominal robot and both series."""
    arm = nominal_arm("ur10")
    columns = MAPS / "ipa_ur10.toml"
    return arm, {name: read_measurements(folder / path, arm, columns=columns) for name, path in FILES.items()}


def judged_rms(fit: Result, data: Measurement) -> float:
    """Return the position RMS of a calibrated arm on measurements, base and tool fitted to them [m]."""
    refitted = calibrate(fit.chain, data, "base,tool", loss="linear")
    return accuracy(refitted.chain, data)["position_rms_m"]


def covered_share(fit: Result, data: Measurement) -> float:
    """Return the share of position components that lie in their predicted 95 % interval."""
    prediction = fit.predict(data.q)
    std = np.sqrt(np.einsum("mii->mi", prediction.covariance)[:, :3])
    return float(np.mean(np.abs(data.positions() - prediction.poses[:, :3, 3]) < 1.96 * std))


def judge(arm: Chain, series: dict[str, Measurement], case: dict, rule: str) -> Case:
    """Calibrate one subset by a rule and by the geometry alone, and judge both."""
    own, other = series[case["series"]], series["D" if case["series"] == "B" else "B"]
    rows = np.array(case["rows"])
    rest = own.take(np.setdiff1d(np.arange(len(own.rows)), rows))
    geometry = calibrate(arm, own.take(rows), SETS, extend="none")
    start = time.process_time()
    fit = calibrate(arm, own.take(rows), SETS, extend=rule)
    seconds = time.process_time() - start
    ratios = tuple(judged_rms(fit, data) / judged_rms(geometry, data) for data in (rest, other))
    return Case(case["kind"], (ratios[0], ratios[1]), covered_share(fit, rest), seconds)


def table(cases: list[Case]) -> str:
    """Make a Markdown table of the ratios of narrow and of wide subsets."""
    lines = ["| subsets | judged | number | mean | 90th percentile | largest | coverage | time |"]
    lines.append("|" + " --- |" * 8)
    for title, is_wide in (("narrow", False), ("wide or small", True)):
        chosen = [case for case in cases if (case.kind in WIDE) == is_wide]
        if not chosen:
            continue
        single = np.array([case.ratios for case in chosen])
        for judged, ratios in (("both series", np.sqrt(np.mean(single**2, 1))), ("each series", single)):
            lines.append(
                f"| {title} | {judged} | {len(chosen)} | {np.exp(np.mean(np.log(ratios))):.3f} "
                f"| {np.quantile(ratios, 0.9):.3f} | {ratios.max():.3f} "
                f"| {np.mean([case.coverage for case in chosen]):.3f} "
                f"| {np.median([case.seconds for case in chosen]):.1f} s |"
            )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rule", default="auto", help="argument of calibrate(extend=...)")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="judge every N-th subset only")
    parser.add_argument("--data", type=Path, default=DATA / "ipa_ur10", help="folder of the series")
    args = parser.parse_args()
    arm, series = read_series(args.data)
    cases = json.loads((args.data / "extrapolation_cases.json").read_text())[:: args.every]
    judged = []
    for number, case in enumerate(cases, 1):
        judged.append(judge(arm, series, case, args.rule))
        print(f"{number}/{len(cases)} {judged[-1]}", flush=True)
    print(table(judged))


if __name__ == "__main__":
    main()
