"""Results of a fixed set of cases, to show that a change of the structure changes no number.

Run it before and after a change, and compare all files that the cases wrote:

    python tests/frozen_results.py write BEFORE
    python tests/frozen_results.py write AFTER
    python tests/frozen_results.py compare BEFORE AFTER

Numbers are equal if they differ by at most 1e-12, relative to the larger one of the two or to 1. Texts are equal
if all characters but those of the numbers are.
"""

import argparse
import base64
import contextlib
import io
import os
import re
import shlex
import sys
from pathlib import Path

# More threads would change the order of summation; NumPy reads this when it is loaded.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", COLUMNS="120")

import numpy as np

TOLERANCE = 1e-12
DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
URDF = Path(__file__).resolve().parents[1] / "urdf"
MAPS = Path(__file__).resolve().parent / "maps"
NUMBER = re.compile(r"(?<![\w.#])[-+−]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?!\w)")
BASE64 = re.compile(r'"""\n?((?:[A-Za-z0-9+/]{60,}\n)*[A-Za-z0-9+/]+={0,2}\s*)"""')
# What differs between two runs of the same code: element numbers of drawings, the date.
VOLATILE = re.compile(r"\d{4}-\d\d-\d\d(?:[T ]\d\d:\d\d(?::\d\d)?)?|(?<=[\"'#])m?[0-9a-f]{10,64}(?=[\"')])")

SIMULATED = """
simulate example:ur10 --tip tool0 -m 60 --errors 1mm,0.3deg --noise 0.05mm --kind position --seed 1 -o position.csv
simulate example:ur10 --tip tool0 -m 40 --errors 1mm,0.3deg --noise 0.05mm,0.01deg --kind pose --seed 2 -o pose.csv
simulate example:panda --tip panda_hand -m 60 --errors 1mm,0.3deg --noise 0.05mm --kind wires --seed 3 -o wires.csv
simulate example:ur5 --tip tool0 -m 60 --errors 1mm,0.3deg --noise 0.05mm --kind distance --seed 4 -o distance.csv
simulate example:ur5 --tip tool0 -m 60 --errors 1mm,0.3deg --noise 0.05mm --kind point --seed 4 -o point.csv
simulate example:ur5 --tip tool0 -m 60 --errors 1mm,0.3deg --noise 0.05mm --kind point_distance --seed 5 -o pair.csv
simulate example:ur5 --tip tool0 -m 60 --errors 1mm,0.3deg --noise 0.05mm --kind plane --seed 5 -o plane.csv
simulate example:ur5 --tip tool0 -m 60 --errors 1mm,0.3deg --noise 0.05mm --kind sphere --seed 6 -o sphere.csv
simulate example:ur5 --tip tool0 -m 60 --errors 1mm,0.3deg --noise 0.05mm,0.01deg --kind relative --seed 6 -o relative.csv
simulate example:ur5 --tip tool0 -m 60 --errors 1mm,0.3deg --noise 0.05mm --kind axes --seed 7 -o axes.csv
simulate example:ur5 --tip tool0 -m 60 --errors 1mm,0.3deg --noise 0.05mm --kind targets --seed 7 -o targets.csv
simulate example:ur5 --tip tool0 -m 50 --errors 1mm,0.3deg --noise 0.2px --kind camera --seed 8 -o camera.csv
simulate {urdf}/sim_6dof.dh.toml --truth {urdf}/sim_6dof_actual.dh.toml -m 20 --noise 0.1mm,0.01deg -o dh.csv
"""
ALL = "--json c.json --residuals c.csv --report c.html --report c.md --certificate c_cert.html --verbose"
PLACES = (
    "back_left",
    "back_right",
    "front_center",
    "front_left",
    "front_right",
    "mid-high",
    "mid_left",
    "mid_right",
)
# Folder of the case and its commands. Files of the simulations are in the folder above.
CASES = {
    "simulated": SIMULATED,
    "position": "calibrate example:ur10 ../simulated/position.csv --tip tool0 --holdout 0.3 -o c.urdf --curves c_curves.csv "
    f"--scene c_scene.html {ALL}\n"
    "validate c.urdf ../simulated/pose.csv --tip tool0 --nominal example:ur10 --json v.json\n"
    "plan c.urdf --tip tool0 -n 12 --candidates 200 -o plan.csv --json plan.json\n"
    "inspect ../simulated/position.csv --robot example:ur10 --tip tool0",
    "pose": f"calibrate example:ur10 ../simulated/pose.csv --tip tool0 --extend none --holdout region -o c.urdf {ALL}",
    "families": "calibrate example:ur10 ../simulated/pose.csv --tip tool0 --parameters "
    f"minimal,base,tool,gain,harmonics,compliance,coupling --extend none --loss linear -o c.urdf {ALL}",
    "tukey": "calibrate example:ur10 ../simulated/position.csv --tip tool0 --loss tukey --extend compliance "
    f"--parameters placement,base,tool --tool-frame probe --world-joint -o c.urdf {ALL}",
    **{
        kind: f"calibrate example:{robot} ../simulated/{kind}.csv --tip {tip} -o c.urdf {ALL}"
        for kind, robot, tip in (
            ("wires", "panda", "panda_hand"),
            ("distance", "ur5", "tool0"),
            ("point", "ur5", "tool0"),
            ("pair", "ur5", "tool0"),
            ("plane", "ur5", "tool0"),
            ("sphere", "ur5", "tool0"),
            ("relative", "ur5", "tool0"),
            ("axes", "ur5", "tool0"),
            ("targets", "ur5", "tool0"),
        )
    },
    "camera": f"calibrate example:ur5 ../simulated/camera.csv --rig ../simulated/camera.rig.toml --tip tool0 -o c.urdf {ALL}",
    "mixed": f"calibrate example:ur5 ../simulated/point.csv ../simulated/targets.csv --tip tool0 -o c.urdf {ALL}",
    "dh": "calibrate {urdf}/sim_6dof.dh.toml ../simulated/dh.csv -o c.urdf " + ALL + "\n"
    "calibrate {urdf}/sim_6dof.dh.toml ../simulated/dh.csv --method gn --priors none -o g.urdf --json g.json\n"
    "check {urdf}/sim_6dof.dh.toml --json check.json",
    "demo": "demo --out demo",
    "ur10_d": "calibrate example:ur10 {data}/ipa_ur10/Series_D/measurements_iso_cubes.csv --columns {maps}/ipa_ur10.toml "
    f"--tip tool0 --holdout 0.5 -o c.urdf {ALL} --curves c_curves.csv --scene c_scene.html",
    "panda": "calibrate {data}/mukca_panda/panda_with_ball.urdf "
    + " ".join(f"{{data}}/mukca_panda/panda_2_clean/{place}/hole_{i}.csv" for place in PLACES for i in (0, 1))
    + " --columns {maps}/mukca_panda.toml --tip ball_link --parameters placement,tool -o c.urdf "
    + ALL,
    "positioner": "calibrate {data}/positioner_2axis/positioner.dh.toml {data}/positioner_2axis/measurements.csv "
    "--parameters minimal,base,tool -o c.urdf " + ALL,
    "refused": "calibrate example:ur5 ../simulated/position.csv --tip tool0 -o c.urdf",
}


def write(folder: Path, names: list[str]) -> None:
    """Run all cases in this process and keep what they print and write."""
    from dhcal_pin.cli.main import main

    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    for source in (DATA, URDF, MAPS):
        if not (folder / source.name).exists():
            (folder / source.name).symlink_to(source)
    for name, commands in CASES.items():
        if names and name not in names and not (name == "simulated" and not (folder / name).exists()):
            continue
        case = folder / name
        case.mkdir(parents=True, exist_ok=True)
        os.chdir(case)
        text = []
        for line in commands.strip().splitlines():
            words = shlex.split(line.format(urdf="../urdf", data="../data", maps="../maps"))
            out, err = io.StringIO(), io.StringIO()
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                try:
                    status = main(words)
                except SystemExit as stop:
                    status = stop.code
            lines = err.getvalue().replace("\r", "\n").splitlines()
            text.append(f"status {status}\n{out.getvalue()}\n" + "\n".join(lines))
        (case / "printed.txt").write_text("\n".join(text), encoding="utf-8")
        print(name, flush=True)


def split(path: Path) -> tuple[list[str], list[float]]:
    """Split a file into its texts and its numbers."""
    text = path.read_text(encoding="utf-8")
    numbers: list[float] = []
    for match in BASE64.finditer(text):
        raw = base64.b64decode("".join(match[1].split()))
        numbers += np.frombuffer(raw[: len(raw) // 8 * 8]).tolist()
    text = VOLATILE.sub("", BASE64.sub("", text))
    numbers += [float(match.replace("−", "-")) for match in NUMBER.findall(text)]
    return NUMBER.sub("\0", text).split("\n"), numbers


def compare(before: Path, after: Path) -> int:
    """Compare all files of two folders; return the number of files that differ."""
    paths = sorted(
        {
            p.relative_to(root)
            for root in (before, after)
            for p in root.glob("*/**/*")
            if p.is_file() and p.parts[len(root.parts)] in CASES
        }
    )
    n_numbers = n_different = 0
    for path in paths:
        if not (before / path).exists() or not (after / path).exists():
            print(f"{path}: only in {before if (before / path).exists() else after}")
            n_different += 1
            continue
        (texts, numbers), (new_texts, new_numbers) = split(before / path), split(after / path)
        n_numbers += len(numbers)
        a, b = np.array(numbers), np.array(new_numbers)
        problems = []
        if texts != new_texts:
            first = next(
                (pair for pair in zip(texts, new_texts, strict=False) if pair[0] != pair[1]), ("", "")
            )
            problems.append(f"texts differ: {first[0][:300]!r} and {first[1][:300]!r}")
        if a.shape != b.shape:
            problems.append(f"{len(a)} and {len(b)} numbers")
        else:
            scale = np.maximum(1, np.maximum(np.abs(a), np.abs(b)))
            with np.errstate(invalid="ignore"):
                error = np.where((a == b) | np.isnan(a) & np.isnan(b), 0, np.abs(a - b) / scale)
            if len(error) and not error.max() <= TOLERANCE:
                problems.append(
                    f"{np.sum(~(error <= TOLERANCE))} numbers differ, by up to {np.nanmax(error):.2g}"
                )
        n_different += bool(problems)
        for problem in problems:
            print(f"{path}: {problem}")
    print(f"{len(paths)} files, {n_numbers} numbers, {n_different} files differ")
    return n_different


def run() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("action", choices=("write", "compare"))
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--cases", nargs="+", default=[], choices=list(CASES))
    args = parser.parse_args()
    if args.action == "write":
        write(args.folders[0], args.cases)
        return 0
    return int(compare(*args.folders) > 0)


if __name__ == "__main__":
    sys.exit(run())
