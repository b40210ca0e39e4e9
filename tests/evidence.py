"""Freeze numerical evidence before a refactoring, and compare it afterwards.

    python tests/evidence.py freeze OUTDIR          # with the interpreter whose dhcal_pin is to be frozen
    python tests/evidence.py compare BEFORE AFTER   # exit status 1 if any number differs

`freeze` runs the command line on many cases, and the problems below through the Python interface, with the
compiled kernels and then without them (a third of the cases), and keeps all outputs below OUTDIR. `compare`
reports each number that is not exactly the same. Texts may change and are counted; the numbers in HTML,
Markdown, SVG and console output are listed for information, but for the three-dimensional scenes.

A new name is added to one table as `old=new`, or as `old=new|other` with several candidates: RENAMES holds
Python names (of the module, attributes and arguments), KEY_RENAMES keys of JSON and TOML and CSV columns,
WORD_RENAMES keys of the studies and manifests below, which are used where the old ones are refused.
"""

from __future__ import annotations

import argparse
import csv
import html
import importlib.util
import inspect
import json
import math
import os
import platform
import random
import re
import subprocess
import sys
import time
import tomllib
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from glob import glob
from importlib import metadata
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
# Real measurements lie beside the project, as in test_real_data.py.
DATA = ROOT.parent / "shared" / "data"
# The compiled kernels under their old and new name; None in their place makes the import fail.
KERNELS = ("dhcal_pin._kernel", "dhcal_pin._kernels._native")
VARIANTS = ("compiled", "numpy")


def table(text: str) -> dict[str, list[str]]:
    """Parse words `old=new|other` into lists of new names by old name."""
    return {old: new.split("|") for old, new in (word.split("=") for word in text.split())}


RENAMES = table("""
chance=p_value Batch=BatchProblem Space=WorkspaceConstraints Touch=PointContact
extend=select_error_families extract=extract_dh_table|extract_dh iter_measurements=iter_measurements
group_folds=leave_one_group_out random_folds=k_fold region_folds=blocked_folds select=select_parameters
solve=solve_batch aside=n_rejected at=perturbed carrying=with_payload chain=robot enough=recommended_size
expected=prior_std freedom=degrees_of_freedom frames=row_frames gross=n_outliers helps=is_significant
hidden=unbounded_directions holds=agrees kept=shrinkage_factor|shrinkage|is_selected|is_kept
miss=residual_error noise=unit_weight_std of=from_arrays|from_models portable=transferable_instruments
random=random_error ratio=relative_error reference=nominal_refitted remaining=posterior_to_prior_std
rest=min_cost|residual_cost targets=values unknowns=instrument_parameters root=sqrt_covariance
samples=n_samples scores=standardized_residuals|studentized_residuals seen=observable_fraction
triangle=system|triangular_system weakly_seen=weakly_observable without=after_without_outliers
learnt=prior_uncertainty space=constraints|workspace
""")
KEY_RENAMES = table("""
mixing=mimic_multipliers slides=is_prismatic shift=mimic_offset poses=configurations compared=has_calibrated
arms=transmissions loads=gravity_bodies centre=centre_of_mass value=coefficient of=input_joint
kept=shrinkage_factor|shrinkage|is_selected|is_kept held_back=shrinkage_notes doubts=warnings
samples=n_samples samples_holdout=n_holdout parameters_total=n_parameters before=nominal after=calibrated
remaining=posterior_to_prior_std weakly_seen=weakly_observable aside=n_rejected gross=n_outliers
without=after_without_outliers allowed=tolerance chance=p_value ratio_to_random=relative_error
enough=recommended_size holds=agrees root=sqrt_covariance hidden=unbounded_directions
wrong=error_parameters redrawn=resample_each_iteration choice=pose_selection errors=error_std
stands=base_in_measuring_frame
""")
WORD_RENAMES = table("""
wrong=error_parameters redrawn=resample_each_iteration choice=pose_selection errors=error_std
""")
# Keys whose values belong to a run or to its files: versions, paths, digests; and warnings, which are texts.
IGNORED_KEYS = {"versions", "files", "inputs", "doubts", "warnings"}
# Compared for information only: what is drawn or said.
INFORMATIVE = {".html", ".md", ".svg", ".txt"}

# ------------------------------------------------------------------------------------------------ input files

MIMIC = """<robot name="mimic"><link name="base"/><link name="a"/><link name="b"/><link name="c"/>
<joint name="lead" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="follower" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 0.3"/>
<axis xyz="0 1 0"/><limit lower="-4" upper="4" effort="1" velocity="1"/>
<mimic joint="lead" multiplier="-1.5" offset="0.1"/></joint>
<joint name="last" type="prismatic"><parent link="b"/><child link="c"/><origin xyz="0.1 0 0.2"/>
<axis xyz="0.6 0 0.8"/><limit lower="-0.3" upper="0.3" effort="1" velocity="1"/></joint></robot>
"""
SLIDER = """convention = "standard"
units = {length = "mm", angle = "deg"}
joint = [
 {name="turn", type="revolute", theta=10.0, d=300.0, a=50.0, alpha=-90.0, lower=-170.0, upper=170.0},
 {name="slide", type="prismatic", theta=90.0, d=120.0, a=20.0, alpha=90.0, lower=-200.0, upper=200.0},
 {name="elbow", type="revolute", theta=0.0, d=30.0, a=250.0, alpha=1.0, lower=-150.0, upper=150.0},
 {name="wrist", type="revolute", theta=-30.0, d=80.0, a=0.0, alpha=85.0, lower=-170.0, upper=170.0},
]
"""
SIDECAR = """base = {xyz_m = [1.2, -0.4, 0.3], rotvec_rad = [0.02, -0.01, 0.7]}
tool = {xyz_m = [0.01, 0.02, 0.08], rotvec_rad = [0.0, 0.0, 0.0]}
joint."shoulder_lift_joint".compliance_rad_per_nm = -2.0e-05
joint."elbow_joint" = {gain = 0.002, compliance_rad_per_nm = -3.0e-05}
"""
# Files that are written into the folder of the case that names them.
LOCAL = {
    "small.study.toml": """seeds = 6
[settings]
robot = "../../inputs/sim_6dof.dh.toml"
kind = ["position", "pose"]
noise = "0.1mm,0.01deg"
errors = "1mm,0.3deg"
wrong = "placement"
parameters = "minimal,base,tool"
poses = [10, 16]
choice = ["random", "corner", "planned"]
""",
    "gn.study.toml": """seeds = 5
[settings]
robot = "../../inputs/sim_3dof.dh.toml"
truth = "../../inputs/sim_3dof_actual.dh.toml"
parameters = "dh"
noise = "0mm"
method = "gn"
priors = "none"
redrawn = [false, true]
poses = [3, 10]
iterations = [0, 1, 3]
""",
    "cells.fleet.toml": """holdout = 0.3
robot = "../../inputs/sim_6dof.dh.toml"
parameters = "minimal,base,tool"
job = [
 {name="one", data=["../simulate-pose/data.csv"], output="one.urdf", json="one.json"},
 {name="two", data=["../simulate-position/data.csv"], output="two.urdf", seed=5, loss="huber"},
 {name="three", data=["missing.csv"], output="three.urdf"},
]
""",
}
# Input files by the name that stands for them in a command line.
PATHS = {
    name: path
    for name, (path,) in table("""
six=sim_6dof.dh.toml six_true=sim_6dof_actual.dh.toml three=sim_3dof.dh.toml ur10_dh=ur10.dh.toml
three_true=sim_3dof_actual.dh.toml experiment=experiment.dh.toml published=experiment_published.dh.toml
paper_targets=experiment_targets.csv ipa_map=ipa_ur10.toml mukca_map=mukca_panda.toml
ur10_true=ur10_true.urdf slider=slider.dh.toml modified=modified.dh.toml mimic=mimic.urdf
mimic_true=mimic_true.urdf priors=priors.toml bounds=bounds.toml anchors=anchors.toml targets=targets.csv
goals=goals.csv sockets=sockets.csv no_unit=no_unit.csv missing=missing.dh.toml
ur10=example-robot-data/robots/ur_description/urdf/ur10_robot.urdf
panda=example-robot-data/robots/panda_description/urdf/panda.urdf
talos=example-robot-data/robots/talos_data/robots/talos_full_v2.urdf
ipa_b=data/ipa_ur10/Series_B/measurements_joint_configurations.csv holes=data/mukca_panda/panda_2_clean
ipa_d=data/ipa_ur10/Series_D/measurements_iso_cubes.csv mukca=data/mukca_panda/panda_with_ball.urdf
camera=data/fr3_d405/camera_in_board.csv positioner=data/positioner_2axis/positioner.dh.toml
positions=data/positioner_2axis/measurements.csv
""").items()
}
SHIPPED = "six six_true three three_true ur10_dh experiment published paper_targets ipa_map mukca_map"


def write_inputs(folder: Path) -> None:
    """Write or link all input files, without the help of dhcal_pin, so that they are always the same."""
    folder.mkdir(parents=True)
    for name in (PATHS[word] for word in SHIPPED.split()):
        # Wherever it lies in the project.
        found = [path for path in sorted(ROOT.rglob(name)) if not {".venv", "build"} & {*path.parts}]
        (folder / name).write_bytes(found[0].read_bytes())
    package = metadata.distribution("example-robot-data")
    share = Path(str(package.locate_file("cmeel.prefix/share/example-robot-data")))
    (folder / "example-robot-data").symlink_to(share)
    if DATA.exists():
        (folder / "data").symlink_to(DATA)
    elif os.environ.get("DHCAL_REQUIRE_DATA") or os.environ.get("CI") == "true":
        sys.exit(f"the measurements are missing: {DATA}")
    rng = random.Random(0)
    places = [[rng.uniform(*side) for side in ((500, 900), (-500, 500), (200, 700))] for _ in range(12)]
    turned = [[*place, *(rng.uniform(-1.5, 1.5) for _ in range(3))] for place in places]
    sockets = [[f"{p}/hole_0", f"{p}/hole_1", 50] for p in ("back_left", "front_left", "mid_left")]
    tables = {
        "targets.csv": ["x[mm],y[mm],z[mm]", *places],
        "goals.csv": ["x[mm],y[mm],z[mm],rx[rad],ry[rad],rz[rad]", *turned],
        "sockets.csv": ["point_a,point_b,distance[mm]", *sockets],
        "no_unit.csv": ["joint_1,joint_2,joint_3,joint_4,joint_5,joint_6,x,y,z", range(9)],
    }
    texts = {
        "mimic.urdf": MIMIC,
        "mimic_true.urdf": perturbed(MIMIC, rng),
        "slider.dh.toml": SLIDER,
        "modified.dh.toml": SLIDER.replace("standard", "modified"),
        "ur10_true.urdf": perturbed((folder / PATHS["ur10"]).read_text(), rng),
        "ur10_true.calibration.toml": SIDECAR,
        "priors.toml": '"theta*" = 0.01\n"d?" = 0.002\n"alpha3" = 0.0005\n',
        "bounds.toml": '"d2" = [-0.001, 0.001]\n"a3" = [0.0, 1.0]\n',
        "anchors.toml": '[instrument]\n"wire1.x" = -1.48\n"wire2.y" = 0.29\n',
        **{
            name: "\n".join([head, *(",".join(map(str, r)) for r in rows)])
            for name, (head, *rows) in tables.items()
        },
    }
    for name, text in texts.items():
        (folder / name).write_text(text)


def perturbed(urdf: str, rng: random.Random) -> str:
    """Return a URDF whose joint origins are off by about 1 mm and 3 mrad."""
    root = ElementTree.fromstring(urdf)
    for joint in root.findall("joint"):
        origin = joint.find("origin")
        origin = ElementTree.SubElement(joint, "origin") if origin is None else origin
        for name, size in (("xyz", 1e-3), ("rpy", 3e-3)):
            values = [float(word) + rng.gauss(0, size) for word in origin.get(name, "0 0 0").split()]
            origin.set(name, " ".join(map(repr, values)))
    return ElementTree.tostring(root, encoding="unicode")


# ----------------------------------------------------------------------------------------- command line cases

LOSSES = "auto linear huber cauchy tukey".split()
KINDS = "pose position axes targets wires distance point point_distance plane sphere relative".split()
# A name and a command line each; those with * run without the compiled kernels, too. `{fit}` stands for what
# a calibration writes, `{json}` for its JSON, `{tool0}` for the tip, `@NAME` for the data of simulate-NAME.
CASES = """
simulate-three: simulate {three} --truth {three_true} -m 12 --kind position --noise 0.1mm -o data.csv
simulate-hayati: simulate {ur10_dh} -m 25 --noise 0.3mm,0.03deg --seed 9 -o data.csv
simulate-ur10: simulate {ur10} {tool0} --truth {ur10_true} -m 80 --noise 0.1mm,0.02deg --seed 3 -o data.csv
*simulate-tracker: simulate {ur10} {tool0} --truth {ur10_true} -m 60 --kind position --noise 0.1mm -o data.csv
simulate-other: simulate {ur10} {tool0} --truth {ur10_true} -m 40 --noise 0.1mm,0.02deg -o data.csv
*simulate-few: simulate {six} --truth {six_true} -m 2 --noise 0.1mm,0.01deg --seed 6 -o data.csv
simulate-mimic: simulate {mimic} --truth {mimic_true} -m 30 --noise 0.1mm,0.01deg --seed 7 -o data.csv
simulate-slider: simulate {slider} -m 30 --noise 0.2mm,0.02deg --seed 8 -o data.csv
*check-six: check {six} {json}
check-ur10: check {ur10} {tool0} {json}
*check-slider: check {slider} --json -
check-mimic: check {mimic} {json}
*demo: demo --out demo {json}
three-gn: calibrate {three} @three {fit} --method gn
six-gn: calibrate {six} @pose {fit} --method gn --max-iterations 6
*ur10: calibrate {ur10} @tracker {tool0} {fit} --holdout 0.3 --map map.csv --report r.html --report r.md
ur10-two: calibrate {ur10} @ur10 @tracker {tool0} {fit} --world-joint --tool-frame target --map map.html
ur10-holdout: calibrate {ur10} @ur10 {tool0} {fit} --holdout @other --report r.html
*extend-auto: calibrate {ur10} @tracker {tool0} {fit} --extend auto --report r.html
extend-some: calibrate {ur10} @ur10 {tool0} {fit} --extend gain,compliance --payload 2kg@0,10,80mm
families: calibrate {ur10} @ur10 {tool0} {fit} --parameters minimal,base,tool,compliance,gain,harmonics
placement: calibrate {ur10} @ur10 {tool0} -o out.urdf --json - --parameters placement,base,tool
offset: calibrate {ur10} @ur10 {tool0} {fit} --parameters offset,base,tool
hayati: calibrate {ur10_dh} @hayati {fit} --parameters hayati,base,tool
modified: calibrate {six} @pose {fit} --parameters modified-dh
*priors-none: calibrate {six} @pose {fit} --priors none
priors-file: calibrate {six} @pose {fit} --priors {priors} --fix d1
bounds: calibrate {six} @pose {fit} --bounds {bounds}
fix-free: calibrate {six} @position {fit} --fix d3,alpha3 --free tool.x
instrument: calibrate {six} @wires {fit} --instrument {anchors}
*few: calibrate {six} @few {fit} --map map.csv
mimic: calibrate {mimic} @mimic {fit}
slider: calibrate {slider} @slider {fit} --parameters dh,base,tool
jobs: calibrate {ur10} @ur10 {tool0} {fit} --jobs 2
*real-ipa: calibrate {ur10} {ipa_d} {tool0} {fit} --columns {ipa_map} --holdout 0.5 --report r.html
real-extend: calibrate {ur10} {ipa_d} {tool0} {fit} --columns {ipa_map} --holdout 0.5 --extend auto --seed 1
*real-moved: validate ../real-ipa/out.urdf {ipa_b} {tool0} {json} --columns {ipa_map} --fit-frames
*real-mukca: calibrate {mukca} {holes}/[bfm]*_left/hole_[01].csv {sockets} --tip ball_link {fit} \
    --columns {mukca_map} --parameters placement,tool
real-left: validate ../real-mukca/out.urdf {holes}/back_r*/hole_[01].csv --tip ball_link {json} \
    --columns {mukca_map}
real-camera: calibrate {panda} {camera} --tip panda_link8 {fit} --holdout 0.5
real-axes: calibrate {positioner} {positions} {fit} --parameters dh,base,tool
*validate: validate ../ur10/out.urdf @tracker {tool0} {json} --map map.csv
validate-true: validate {ur10_true} @other {tool0} --json -
*compensate: compensate {ur10} ../ur10/out.urdf {targets} {tool0} -o out.csv
compensate-paper: compensate {experiment} {published} {paper_targets} -o out.csv
compensate-poses: compensate {ur10} {ur10_true} {goals} {tool0} -o out.csv
*plan-d: plan {six} -n 12 --candidates 400 -o out.csv {json}
plan-a: plan {six} -n 12 --candidates 400 --criterion A --kind position --parameters dh,base -o out.csv {json}
plan-e: plan {six} -n 12 --candidates 400 --criterion E --sigma 0.2mm,0.02deg -o out.csv {json}
plan-task: plan {ur10} {tool0} -n 8 --candidates 200 --criterion task --task {targets} --kind position \
    --sigma 0.05mm -o out.csv {json}
*plan-robust: plan {ur10_dh} -n 10 --candidates 300 --criterion robust -o out.csv {json}
plan-box: plan {ur10_dh} -n 8 --candidates 200 --box 0,-800,100:1200,800,1000mm --seed 2 -o out.csv {json} \
    --visible-from 2500,0,1000mm --cone 80deg
plan-data: plan {six} -n 6 --candidates 300 --data @pose -o out.csv {json}
*plan-more: plan ../ur10/out.urdf {tool0} -n 5 --candidates 200 -o out.csv {json}
plan-from: plan {ur10} {tool0} -n 10 --from @ur10 -o out.csv {json}
*study: study small.study.toml -o out.csv
study-gn: study gn.study.toml -o out.csv --jobs 2
*fleet: calibrate cells.fleet.toml -o summary.csv --jobs 1 {json}
*convert-urdf: convert {six} out.urdf
convert-slider: convert {slider} out.urdf
convert-modified: convert {modified} out.urdf
*convert-dh: convert {ur10} out.dh.toml {tool0}
convert-to-modified: convert {ur10} out.dh.csv {tool0} --convention modified
convert-panda: convert {panda} out.dh.toml --tip panda_link8
convert-csv: convert {slider} out.dh.csv
convert-from-csv: convert ../convert-csv/out.dh.csv out.dh.toml --convention modified
convert-yaml: convert {ur10_dh} out.yaml
convert-from-yaml: convert ../convert-yaml/out.yaml out.dh.toml
convert-yaml-urdf: convert ../convert-yaml/out.yaml out.urdf
convert-origins: convert ../ur10/out.urdf out.origins.csv {tool0}
*view-six: view {six} {six_true} --data @pose --html scene.html
view-ur10: view {ur10} ../ur10/out.urdf {tool0} --data @tracker --simplify 2000 --html scene.html
wrong-unit: calibrate {six} {no_unit} -o out.urdf
wrong-file: check {missing}
"""


def cases(variant: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the name and the command line of each case, in an order in which each finds what it needs."""
    lines = []
    for kind in KINDS:
        star = "*" if kind in ("pose", "position", "wires", "point", "sphere") else ""
        simulate = (
            f"simulate {{six}} --truth {{six_true}} -m 30 --noise 0.1mm,0.01deg --kind {kind} -o data.csv"
        )
        points = "@point" if kind == "point_distance" else ""
        lines += [
            f"{star}simulate-{kind}: {simulate}",
            f"{star}{kind}: calibrate {{six}} {points} @{kind} {{fit}}",
        ]
    real = "calibrate {ur10} {ipa_d} {tool0} {fit} --columns {ipa_map} --holdout 0.8 --seed 2 --loss"
    lines += [*CASES.strip().splitlines(), *(f"loss-{x}: {real} {x}" for x in LOSSES)]
    known = {name: f"../../inputs/{path}" for name, path in PATHS.items()}
    known |= {"json": "--json out.json", "fit": "-o out.urdf --json out.json", "tool0": "--tip tool0"}
    for line in lines:
        name, words = line.removeprefix("*").format(**known).split(": ", 1)
        words = re.sub(r" @(\w+)", r" ../simulate-\1/data.csv", words)
        needs_data = "inputs/data/" in words or "real-" in words
        if (variant == "compiled" or line.startswith("*")) and (DATA.exists() or not needs_data):
            yield name, words.split()


def run_case(folder: Path, words: list[str], environment: Mapping[str, str]) -> int:
    """Run a command line in a folder of its own, keep what it says, and return its exit status.

    Where a file of LOCAL is refused, it is written again with the new words.
    """
    folder.mkdir(parents=True)
    command = [str(Path(sys.executable).with_name("dhcal"))]
    for word in words:
        found = sorted(os.path.relpath(path, folder) for path in glob(str(folder / word)))
        command += found if "[" in word else [word]
    local = [word for word in words if word in LOCAL]
    done = None
    for renames in ({}, WORD_RENAMES) if local else ({},):
        for name in local:
            keys = [(line.partition(" ")[0], line) for line in LOCAL[name].splitlines(keepends=True)]
            text = "".join(line.replace(key, renames.get(key, [key])[0], 1) for key, line in keys)
            (folder / name).write_text(text)
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode != 2:
            break
    assert done is not None
    (folder / ("stdout.json" if words[-2:] == ["--json", "-"] else "stdout.txt")).write_text(done.stdout)
    (folder / "stderr.txt").write_text(done.stderr)
    (folder / "status.json").write_text(json.dumps({"status": done.returncode}))
    return done.returncode


# -------------------------------------------------------------------------------------------- Python problems

FIT = """x std covariance correlation rank condition observability_indices kept expected remaining freedom
noise seen weights outliers scores instruments portable iterations converged samples unobservable weakly_seen
solution.x solution.triangle.r solution.triangle.z solution.triangle.rest problem.weights chain.base
chain.tool chain.origins uncertainty.root uncertainty.hidden"""
ESTIMATE = "name nominal value std prior observability remaining fixed"
COMPARISON = "samples before after aside gross without"
PLAN = """q index criterion task sizes errors random_sizes random_errors enough notes log_det error random
ratio"""
PROBLEMS: list[Callable[[Lab], dict[str, Any]]] = []


def get(owner: Any, path: str) -> Any:
    """Return an attribute by its dotted old name, whether it has that name or the new one."""
    for name in path.split("."):
        words = [name, *RENAMES.get(name, ())]
        known = [word for word in words if hasattr(owner, word)]
        if not known:
            raise AttributeError(f"{owner!r:.80} has none of {words}; add its new name to RENAMES")
        owner = getattr(owner, known[0])
    return owner


def pick(owner: Any, names: str) -> dict[str, Any]:
    """Return attributes by their old names."""
    return {name: get(owner, name) for name in names.split()}


def make(kind: Any, *args: Any) -> Any:
    """Make an object by its checked constructor, be that a class method or the class."""
    names = [name for name in ("of", *RENAMES["of"]) if hasattr(kind, name)]
    return getattr(kind, names[0])(*args) if names else kind(*args)


def call(function: Callable[..., Any], *args: Any, **options: Any) -> Any:
    """Call a function whose arguments are given by their old names."""
    known, spelled = inspect.signature(function).parameters, {}
    for name, value in options.items():
        spelled[next((word for word in (name, *RENAMES.get(name, ())) if word in known), name)] = value
    return function(*args, **spelled)


class Names:
    """A module whose names are given by the old ones."""

    def __init__(self, module: Any) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        """Return what has that name or the new one."""
        return get(self._module, name)


class Lab:
    """Robots and data that the problems share.

    Attributes:
        dh: the module dhcal_pin.
        np: NumPy.
        folder: of the variant, with the command line's cases.
        six, six_true: the paper's six-joint arm as designed and as it is.
        ur10, ur10_true: a UR10, and one with other origins, base and tool, a gain and compliances.
    """

    def __init__(self, folder: Path) -> None:
        import numpy as np

        import dhcal_pin

        self.dh, self.np, self.folder = Names(dhcal_pin), np, folder
        self.six, self.six_true = self.arm("six"), self.arm("six_true")
        self.ur10 = self.dh.read_robot(self.path("ur10"), "tool0")
        self.ur10_true = self.dh.read_robot(self.path("ur10_true"), "tool0")

    def path(self, name: str) -> str:
        """Return the path of an input file."""
        return str(self.folder.parent / "inputs" / PATHS[name])

    def arm(self, name: str, tip: str | None = None) -> Any:
        """Return the chain of a DH file, or of a URDF to its tip."""
        chain, path = self.dh.Chain, self.path(name)
        return chain.from_urdf(path, tip=tip) if tip else chain.from_dh(self.dh.read_dh(path))

    def joints(self, chain: Any, count: int, seed: int) -> Any:
        """Draw joint values (count, n)."""
        return self.np.random.default_rng(seed).uniform(-1.5, 1.5, (count, len(chain.joint_names)))

    def places(self, chain: Any, count: int, seed: int, sigma: float | None = 1e-4, gross: int = 0) -> Any:
        """Measure positions with noise of 0.1 mm, some of them off by 50 mm."""
        q, rng = self.joints(chain, count, seed), self.np.random.default_rng(seed + 100)
        at = chain.poses(q)[:, :3, 3] + rng.normal(0, 1e-4, (count, 3))
        at[:gross] += 0.05
        return make(self.dh.Position, q, at, sigma)

    def poses(self, chain: Any, count: int, seed: int, *sigmas: float) -> Any:
        """Measure poses whose positions have noise of 0.1 mm."""
        q, rng = self.joints(chain, count, seed), self.np.random.default_rng(seed + 200)
        poses = chain.poses(q)
        poses[:, :3, 3] += rng.normal(0, 1e-4, (count, 3))
        return make(self.dh.Pose, q, poses, *sigmas)

    def read(self, kind: str) -> Any:
        """Read what `dhcal simulate` wrote of a kind, with the compiled kernels."""
        path = self.folder.parent / VARIANTS[0] / f"simulate-{kind}/data.csv"
        return self.dh.read_measurements(path, self.six)

    def fit(self, *args: Any, **options: Any) -> dict[str, Any]:
        """Calibrate and return all numbers."""
        return self.numbers(call(self.dh.calibrate, *args, **options))

    def numbers(self, fit: Any) -> dict[str, Any]:
        """Return all numbers of a `Result`, and its predictions at some joint values."""
        q = self.joints(get(fit, "chain"), 20, 99)
        return pick(fit, FIT) | {
            "parameters": [pick(one, "name unit nominal prior") for one in get(fit, "parameters")],
            "estimates": [pick(one, ESTIMATE) for one in get(fit, "estimates")],
            "comparisons": [pick(one, COMPARISON) for one in get(fit, "comparisons")],
            "is_converged": fit.is_converged(),
            "reference": get(fit, "reference").poses(q),
            "predict": pick(fit.predict(q), "poses covariance position_std orientation_std"),
        }


@PROBLEMS.append
def kinds(lab: Lab) -> dict[str, Any]:
    """Calibrate with every kind alone, for the DH parameters."""
    more = {"point_distance": [lab.read("point")]}
    return {kind: lab.fit(lab.six, [*more.get(kind, ()), lab.read(kind)], "dh") for kind in KINDS}


@PROBLEMS.append
def parameter_sets(lab: Lab) -> dict[str, Any]:
    """Calibrate with the sets of unknowns."""
    mixed = [lab.poses(lab.six_true, 30, 0), lab.places(lab.six_true, 25, 1)]
    poses = lab.poses(lab.ur10_true, 40, 2)
    six = "dh modified-dh hayati minimal,base,tool placement,tool offset,base,tool dh,gain,harmonics"
    ur10 = "minimal,base,tool placement,base,tool offset,base,tool base,tool hayati minimal,coupling"
    found = {f"six {sets}": lab.fit(lab.six, mixed, sets) for sets in six.split()}
    return found | {f"ur10 {sets}": lab.fit(lab.ur10, poses, sets) for sets in ur10.split()}


@PROBLEMS.append
def options(lab: Lab) -> dict[str, Any]:
    """Calibrate with priors, fixed and freed parameters, bounds, known values, and with few samples."""
    data, wires = lab.poses(lab.six_true, 20, 3, 1e-4, 1e-4), lab.read("wires")
    known = {unknown.name: unknown.nominal + 0.01 for unknown in get(wires, "unknowns")[:2]}
    return {
        "none": lab.fit(lab.six, data, "dh", priors="none"),
        "given": lab.fit(lab.six, data, "dh", priors={"theta*": 0.01, "d2": 1e-4}),
        "fix": lab.fit(lab.six, data, "dh,base", fix=["d3", "alpha2", "base"]),
        "free": lab.fit(lab.six, data, "offset", free=["tool.x", "a2", "d4"]),
        "bounds": lab.fit(lab.six, data, "dh", bounds={"d*": (-1.0, 0.4331), "a2": (0.0, 0.5)}),
        "known": lab.fit(lab.six, wires, "dh", known=known),
        "gn": lab.fit(lab.six, data, "dh", method="gn"),
        "gn stopped": lab.fit(lab.six, data, "dh", method="gn", max_iterations=2),
        "holdout": lab.fit(lab.six, data, "dh", holdout=[lab.poses(lab.six_true, 9, 4)]),
        "few": lab.fit(lab.six, lab.poses(lab.six_true, 2, 5)),
        "few places": lab.fit(lab.ur10, lab.places(lab.ur10_true, 7, 5)),
    }


@PROBLEMS.append
def losses(lab: Lab) -> dict[str, Any]:
    """Calibrate with gross errors, sigmas stated and not."""
    data = {sigma: lab.places(lab.ur10_true, 60, 6, sigma, gross=4) for sigma in (1e-4, None)}
    return {f"{loss} {s}": lab.fit(lab.ur10, item, loss=loss) for loss in LOSSES for s, item in data.items()}


@PROBLEMS.append
def loads(lab: Lab) -> dict[str, Any]:
    """Calibrate compliance, with and without a payload."""
    data, sets = lab.poses(lab.ur10_true, 60, 7), "minimal,base,tool,compliance,gain"
    loaded = get(lab.ur10, "carrying")(lab.dh.Payload(3.0, (0.01, 0.0, 0.08)))
    return {"bare": lab.fit(lab.ur10, data, sets), "loaded": lab.fit(loaded, data, sets)}


@PROBLEMS.append
def contacts(lab: Lab) -> dict[str, Any]:
    """Calibrate with touched points at known distances, and with surfaces beside positions."""
    q, norm, pairs = lab.read("point").q, lab.np.linalg.norm, ((0, 1), (1, 2), (2, 3), (0, 3))
    at = lab.six_true.poses(q)[:4, :3, 3]
    touched = make(lab.dh.Touch, q, [f"p{i % 4 + 1}" for i in range(len(q))])
    names, length = [(f"p{i + 1}", f"p{j + 1}") for i, j in pairs], [norm(at[i] - at[j]) for i, j in pairs]
    gauge = make(lab.dh.PointDistance, len(lab.six.joint_names), names, length, 1e-5)
    surfaces = [lab.places(lab.six_true, 12, 8), lab.read("plane"), lab.read("sphere")]
    return {
        "points": lab.fit(lab.six, [touched, gauge], "dh"),
        "surfaces": lab.fit(lab.six, surfaces, "minimal"),
    }


@PROBLEMS.append
def robots(lab: Lab) -> dict[str, Any]:
    """Calibrate arms with a mimic, a sliding, and seven joints, and a way through a humanoid's torso."""
    found = {"three": lab.fit(lab.arm("three"), lab.places(lab.arm("three_true"), 12, 9), "dh", method="gn")}
    for name, tip in (("mimic", "c"), ("panda", "panda_link8"), ("talos", "gripper_left_base_link")):
        found[name] = lab.fit(lab.arm(name, tip), lab.poses(lab.arm(name, tip), 25, 10))
    follows = lab.poses(lab.arm("mimic_true", "c"), 25, 11)
    found["mimic true"] = lab.fit(lab.arm("mimic", "c"), follows, "minimal,base,tool,gain")
    for name in ("slider", "modified"):
        found[name] = lab.fit(lab.arm(name), lab.places(lab.arm(name), 25, 12), "minimal,base,tool")
    return found


@PROBLEMS.append
def real_data(lab: Lab) -> dict[str, Any]:
    """Calibrate with parts of the series that lie beside the project."""
    if not DATA.exists():
        return {}
    read, panda, ball = (
        lab.dh.read_measurements,
        lab.arm("panda", "panda_link8"),
        lab.arm("mukca", "ball_link"),
    )
    holes = sorted(glob(f"{lab.path('holes')}/[bf]*_left/hole_[01].csv"))
    tracker = read(lab.path("ipa_b"), lab.ur10, lab.path("ipa_map")).take(slice(None, None, 5))
    return {
        "fr3": lab.fit(panda, read(lab.path("camera"), panda), "placement,base,tool"),
        "ipa": lab.fit(lab.ur10, tracker, "minimal,base,tool,compliance"),
        "mukca": lab.fit(ball, [read(path, ball, lab.path("mukca_map")) for path in holes], "placement,tool"),
    }


@PROBLEMS.append
def extensions(lab: Lab) -> dict[str, Any]:
    """Let cross-validation add families of errors."""
    names, found = "family cv_before cv_after standard_error chance prior_width kept helps", {}
    for measure in (lab.poses, lab.places):
        fit, trials = lab.dh.extend(lab.ur10, measure(lab.ur10_true, 80, 13))
        found[measure.__name__] = lab.numbers(fit) | {"trials": [pick(trial, names) for trial in trials]}
    return found


@PROBLEMS.append
def cross_validation(lab: Lab) -> dict[str, Any]:
    """Judge a fit on what folds leave out."""
    data = [lab.places(lab.ur10_true, 40, 15), lab.poses(lab.ur10_true, 20, 16)]
    fit, dh, found = lab.dh.calibrate(lab.ur10, data), lab.dh, {}
    folds = {
        "random": lab.dh.random_folds(data, 5, 3),
        "region": lab.dh.region_folds(data),
        "default": None,
    }
    folds["group"] = lab.dh.group_folds(data, lab.np.arange(60) // 15)
    for name, one in folds.items():
        found[name] = pick(dh.cross_validate(fit, one), "folds errors accuracy") | {"masks": one}
    parts = [[part.q for part in side] for side in dh.split(data, 0.3, 7)]
    return found | {
        "split": parts,
        "accuracy": dh.accuracy(get(fit, "chain"), data),
        "validate": fit.validate(data),
    }


@PROBLEMS.append
def batches(lab: Lab) -> dict[str, Any]:
    """Solve stacked problems, of equal and of different sizes."""
    errors = lab.dh.select(lab.six, "minimal,base,tool")
    even = [[lab.places(lab.six_true, 20, seed), lab.poses(lab.six_true, 5, seed)] for seed in range(12)]
    uneven = [[lab.poses(lab.six_true, 8 + seed % 3, seed, 1e-4, 1e-4)] for seed in range(9)]
    solve = lab.dh.solve
    priors = get(errors, "priors")
    found: dict[str, Any] = {"priors": priors, "names": [one.name for one in get(errors, "parameters")]}
    for name, data, weights in (("even", even, 1 / priors), ("uneven", uneven, 0 * priors)):
        for method in ("lm", "gn"):
            ended = solve(make(lab.dh.Batch, [errors] * len(data), data, weights), method, 30)
            found[f"{name} {method}"] = pick(ended, "x converged iterations rank std cost covariance")
    return found


@PROBLEMS.append
def streams(lab: Lab) -> dict[str, Any]:
    """Calibrate with samples that are read part by part."""
    names = "x std rank samples before after converged solution.iterations unobservable"
    data = lab.places(lab.six_true, 600, 17, None)
    path = lab.folder.parent / VARIANTS[0] / "simulate-pose/data.csv"
    parts = [data.take(slice(i, i + 150)) for i in range(0, 600, 150)]
    stream, read = lab.dh.calibrate_stream, lab.dh.iter_measurements
    return {
        "memory": pick(stream(lab.six, lambda: parts, "minimal,base,tool"), names),
        "file": pick(stream(lab.six, lambda: read(path, lab.six, 8), "dh"), names),
    }


@PROBLEMS.append
def workspace_maps(lab: Lab) -> dict[str, Any]:
    """Predict errors by cells of the workspace."""
    names = "centre size std worst count readings measured expected"
    data = [lab.places(lab.ur10_true, 40, 18)]
    fit, of = lab.dh.calibrate(lab.ur10, data), lab.dh.workspace_map
    found = {
        "predicted": of(fit, samples=1500, cell=0.4),
        "measured": of(fit, data, samples=500, cell=0.5, seed=1),
    }
    return {name: pick(one, names) for name, one in found.items()}


@PROBLEMS.append
def compensations(lab: Lab) -> dict[str, Any]:
    """Correct targets, within reach and beyond."""
    found, starts = {}, {"middle": None, "near": lab.joints(lab.ur10, 12, 19)}
    for name in ("targets", "goals"):
        goals = lab.dh.read_targets(lab.path(name), lab.ur10)
        for start, near in starts.items():
            sent = lab.dh.compensate(lab.ur10, lab.ur10_true, get(goals, "targets"), near)
            found[f"{name} {start}"] = pick(sent, "q poses status miss reached")
    return found


@PROBLEMS.append
def plans(lab: Lab) -> dict[str, Any]:
    """Plan poses by each criterion, among given and among drawn candidates."""
    noise, plan, found = lab.dh.Noise(1e-4, 2e-4), lab.dh.plan, {}
    given, data = lab.joints(lab.ur10, 120, 20), lab.poses(lab.six_true, 15, 21)
    for criterion in ("D", "A", "E", "task", "robust"):
        found[criterion] = call(plan, lab.ur10, 9, noise=noise, criterion=criterion, candidates=given)
    box, eye = lab.np.array([[-1.0, -1.0, 0.1], [1.2, 1.0, 1.0]]), lab.np.array([2.5, 0.0, 1.0])
    drawn = {"candidates": 200, "noise": noise, "parameters": "dh"}
    space = lab.dh.Space(box, eye, 1.4)
    found["space"] = call(plan, lab.six, 8, kind="position", space=space, seed=3, **drawn)
    fit = lab.dh.calibrate(lab.six, data)
    found["learnt"] = call(plan, get(fit, "chain"), 5, learnt=get(fit, "uncertainty"), **drawn)
    found["data"] = call(plan, lab.six, 5, data=[data], **drawn)
    return {name: pick(one, PLAN) for name, one in found.items()}


@PROBLEMS.append
def models(lab: Lab) -> dict[str, Any]:
    """Compute the paper's factors, cross-checks, DH tables, and arms with errors."""
    dh, paper = lab.dh, lab.dh.read_dh(lab.path("six"))
    found = {
        "factors": dh.error_factors(paper, lab.joints(lab.six, 5, 22)),
        "urdf": dh.dh_to_urdf(paper, "six"),
    }
    for name, arm in (("six", lab.six), ("ur10", lab.ur10), ("slider", lab.arm("slider"))):
        found[f"check {name}"] = [
            pick(one, "holds") | {"all": [*vars(one).values()]} for one in dh.crosscheck(arm, 20)
        ]
        for convention in ("standard", "modified"):
            taken = lab.dh.extract(arm, convention)
            rows = pick(taken.table, "theta d a alpha beta base tool")
            found[f"{name} {convention}"] = rows | pick(taken, "frames notes")
        errors = lab.dh.select(arm, "minimal,base,tool,gain,harmonics,coupling")
        x = 1e-3 * lab.np.random.default_rng(23).normal(size=len(get(errors, "parameters")))
        found[f"moved {name}"] = get(errors, "at")(x).poses(lab.joints(arm, 10, 24))
        found[f"placements {name}"] = [placement.homogeneous for placement in arm.model.jointPlacements]
    return found


@PROBLEMS.append
def files(lab: Lab) -> dict[str, Any]:
    """Write an arm and read it again."""
    fit = lab.dh.calibrate(lab.ur10, lab.poses(lab.ur10_true, 30, 25), "minimal,base,tool,compliance")
    lab.dh.write_report(fit, lab.folder / "python.html")
    lab.dh.write_urdf(fit, lab.folder / "python.urdf")
    read = lab.dh.read_robot(lab.folder / "python.urdf", "tool0")
    return {"poses": read.poses(lab.joints(read, 10, 26)), "base": read.base, "tool": read.tool}


def frozen(value: Any) -> Any:
    """Return a value as JSON, every float as `float.hex()`."""
    if hasattr(value, "tolist"):
        return frozen(value.tolist())
    if isinstance(value, float):
        return value.hex()
    if isinstance(value, Mapping):
        return {str(key): frozen(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [frozen(item) for item in value]
    return value if value is None or isinstance(value, bool | int | str) else f"<{type(value).__name__}>"


def solve_problems(folder: Path) -> int:
    """Solve all problems in this process, write `python.json`, and return how many failed."""
    lab, found, failed = Lab(folder), {}, 0
    for function in PROBLEMS:
        try:
            found[function.__name__] = frozen(function(lab))
        except Exception as error:
            traceback.print_exc()
            found[function.__name__], failed = f"failed: {error}", failed + 1
    found["kernels"] = any(sys.modules.get(name) for name in KERNELS)
    (folder / "python.json").write_text(json.dumps(found))
    return failed


def freeze(folder: Path) -> int:
    """Run everything into a new folder; return 1 if a problem failed."""
    if folder.exists():
        sys.exit(f"{folder}: is there already; name a new folder")
    package = importlib.util.find_spec("dhcal_pin")
    print(f"freezing {package and package.origin} into {folder}", flush=True)
    write_inputs(folder / "inputs")
    (folder / "blocked").mkdir()
    lines = ["import sys", *(f"sys.modules[{name!r}] = None" for name in KERNELS)]
    (folder / "blocked/sitecustomize.py").write_text("\n".join(lines) + "\n")
    quiet = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "120", "MPLBACKEND": "agg"}
    start, failed = time.perf_counter(), 0
    for variant in VARIANTS:
        paths = [str(folder / "blocked")] if variant == "numpy" else []
        path = os.pathsep.join([*paths, *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = {**os.environ, **quiet, "PYTHONPATH": path}
        found = [run_case(folder / variant / name, words, environment) for name, words in cases(variant)]
        spent = time.perf_counter() - start
        print(f"{variant}: cases by exit status {dict(Counter(found))}, {spent:.0f} s", flush=True)
        command = [sys.executable, __file__, "problems", str(folder / variant)]
        failed += subprocess.run(command, env=environment, check=False).returncode
    info = Path("/proc/cpuinfo")
    cpu = re.search(r"model name\s*:\s*(.*)", info.read_text()) if info.exists() else None
    machine = {"processor": cpu[1] if cpu else platform.processor(), "python": platform.python_version()}
    machine |= {name: metadata.version(name) for name in ("pin", "numpy", "scipy")}
    (folder / "machine.json").write_text(json.dumps(machine))
    print(f"frozen in {time.perf_counter() - start:.0f} s; {failed} problems failed")
    return bool(failed)


# ---------------------------------------------------------------------------------------------------- compare

HEX = re.compile(r"-?0x[01]\.[0-9a-f]+p[+-]\d+|-?inf|nan")
# Arrays in base64: no other text is as long without a space, a dot or an underscore.
BINARY = re.compile(r"[A-Za-z0-9+/\n]{40,}={0,2}\n?")
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
SCENE = re.compile(r"<script[^>]*json[^>]*>(.*?)</script>", re.DOTALL)


def exact(value: Any) -> str | None:
    """Return a number in a form that is the same only for the same number; None for what is no number."""
    if isinstance(value, str):
        return value if HEX.fullmatch(value) else None
    return repr(float(value)) if isinstance(value, int | float) and not isinstance(value, bool) else None


def gap(before: str, after: str) -> float:
    """Return by how much two written numbers differ, NaN where they are none."""
    try:
        a, b = (float.fromhex(text) if "0x" in text else float(text) for text in (before, after))
    except ValueError:
        return math.nan
    return abs(b - a)


class Case:
    """What the outputs of a case before and after have in common.

    Attributes:
        numbers: how many numbers were compared.
        texts: how many texts differ.
        differences: what must not differ and does.
        notes: what may differ and does.
    """

    def __init__(self) -> None:
        self.numbers, self.texts = 0, 0
        self.differences: list[str] = []
        self.notes: list[str] = []

    def words(self, path: str, before: list[str], after: list[str]) -> None:
        """Compare two lists of written numbers."""
        self.numbers += len(before)
        pairs = [(gap(a, b), i, a, b) for i, (a, b) in enumerate(zip(before, after, strict=False)) if a != b]
        if len(before) != len(after):
            self.differences.append(f"{path}: {len(before)} numbers before, {len(after)} after")
        elif pairs:
            size, i, a, b = max(pairs, key=lambda pair: -1.0 if math.isnan(pair[0]) else pair[0])
            where = f"{path}[{i}]" if len(before) > 1 else path
            text = f"{where}: {a:.60} before, {b:.60} after, a difference of {size:.3g}"
            many = f"; {len(pairs)} of {len(before)} differ" if len(before) > 1 else ""
            self.differences.append(text + many)

    def values(self, path: str, before: Any, after: Any) -> None:
        """Compare two values of JSON or TOML."""
        if isinstance(before, dict) and isinstance(after, dict):
            self.objects(path, before, after)
        elif isinstance(before, list) and isinstance(after, list):
            words = [[text for item in items if (text := exact(item))] for items in (before, after)]
            if before and [*map(len, words)] == [len(before), len(after)]:
                self.words(path, *words)
            elif len(before) == len(after):
                for i, (a, b) in enumerate(zip(before, after, strict=True)):
                    self.values(f"{path}[{i}]", a, b)
            elif all(isinstance(item, str) for item in (*before, *after)):
                self.texts += 1
            else:
                self.differences.append(f"{path}: {len(before)} items before, {len(after)} after")
        elif (a := exact(before)) and (b := exact(after)):
            self.words(path, [a], [b])
        elif isinstance(before, str) and isinstance(after, str) and not BINARY.fullmatch(before):
            self.texts += before != after
        elif isinstance(before, str) and isinstance(after, str):
            if "".join(before.split()) != "".join(after.split()):
                self.differences.append(f"{path}: the arrays in base64 differ")
        elif before != after or type(before) is not type(after):
            self.differences.append(f"{path}: {before!r:.60} before, {after!r:.60} after")

    def objects(self, path: str, before: dict[str, Any], after: dict[str, Any]) -> None:
        """Compare two objects of JSON or TOML, whose keys may have new names."""
        new = {*after} - IGNORED_KEYS
        for key in before.keys() - IGNORED_KEYS:
            known = [name for name in (key, *KEY_RENAMES.get(key, ())) if name in after]
            new -= {*known[:1]}
            if known:
                self.values(f"{path}.{key}", before[key], after[known[0]])
            else:
                self.differences.append(f"{path}.{key}: is missing; add a new name to KEY_RENAMES")
        self.notes += [f"{path}.{key}: is new" for key in sorted(new)]

    def tables(self, name: str, before: dict[str, list[str]], after: dict[str, list[str]]) -> None:
        """Compare the columns of two CSV files: numbers as they are written."""
        for header, cells in before.items():
            key, bracket, unit = header.partition("[")
            names = [word + bracket + unit for word in (key, *KEY_RENAMES.get(key, ()))]
            known = [after[word] for word in names if word in after]
            if not known or len(cells) != len(known[0]):
                self.differences.append(f"{name}: column {header} is missing or has another number of rows")
                continue
            pairs = list(zip(cells, known[0], strict=True))
            written = [pair for pair in pairs if any(map(NUMBER.fullmatch, pair))]
            self.words(f"{name}: {header}", [a for a, _ in written], [b for _, b in written])
            self.texts += sum(a != b for a, b in pairs if (a, b) not in written)

    def files(self, name: str, before: Path, after: Path) -> None:
        """Compare two files as their ending asks for."""
        if not after.exists():
            (self.notes if before.suffix in INFORMATIVE else self.differences).append(f"{name}: is missing")
            return
        a, b = before.read_text(), after.read_text()
        if before.suffix == ".json":
            self.values(name, json.loads(a or "null"), json.loads(b or "null"))
        elif before.suffix == ".toml":
            self.values(name, tomllib.loads(a), tomllib.loads(b))
        elif before.suffix == ".csv":
            self.tables(name, columns(a), columns(b))
        elif before.suffix in INFORMATIVE:
            scenes = [[json.loads(scene) for scene in SCENE.findall(unframed(text))] for text in (a, b)]
            self.values(f"{name} scene", *scenes)
            lost, new = (Counter(NUMBER.findall(prose(text))) for text in (a, b))
            lost, new = sorted((lost - new).elements()), sorted((new - lost).elements())
            if lost or new:
                count = f"{len(lost)} numbers only before {lost[:8]}, {len(new)} only after {new[:8]}"
                self.notes.append(f"{name}: {count}")
        else:
            # URDF and YAML: the numbers as they are written, but for comments.
            bare = [re.sub(r"<!--.*?-->|#[^\n]*", "", text, flags=re.DOTALL) for text in (a, b)]
            self.words(name, *(NUMBER.findall(text) for text in bare))
            self.texts += bare[0] != bare[1]


def unframed(text: str) -> str:
    """Return a page with the pages that are framed in it."""
    return re.sub(r'srcdoc="([^"]*)"', lambda found: html.unescape(found[1]), text)


def prose(text: str) -> str:
    """Return what is written on a page or console, without drawings, programs and marks."""
    text = re.sub(r"<(svg|style|script|iframe)\b.*?</\1>", " ", text, flags=re.DOTALL)
    return html.unescape(re.sub(r"<[^>]*>", " ", text))


def columns(text: str) -> dict[str, list[str]]:
    """Return the columns of a CSV file by their headers."""
    rows = csv.reader(line for line in text.splitlines() if not line.startswith("#"))
    return {header: cells for header, *cells in zip(*rows, strict=True)}


def compare(before: Path, after: Path, every: bool) -> int:
    """Compare two folders of evidence, say what differs, and return 1 if a number does."""
    machines = [(folder / "machine.json").read_text() for folder in (before, after)]
    if machines[0] != machines[1]:
        print(f"warning: another machine or other libraries: {machines[0]} before, {machines[1]} after")
    for path in sorted((before / "inputs").glob("*.*")):
        if path.read_bytes() != (after / "inputs" / path.name).read_bytes():
            print(f"warning: inputs/{path.name} differs")
    found: dict[str, Case] = {}
    for path in sorted(path for variant in VARIANTS for path in (before / variant).rglob("*.*")):
        variant, name, *rest = path.relative_to(before).parts
        if path.name not in LOCAL:
            case = found.setdefault(f"{variant}/{name}" if rest else f"{variant}/python", Case())
            case.files("/".join(rest) or name, path, after.joinpath(variant, name, *rest))
    for name, case in found.items():
        texts = f", {case.texts} texts differ" if case.texts else ""
        print(f"{name}: {'DIFFERENT' if case.differences else 'equal'}, {case.numbers} numbers{texts}")
        lines = [*case.differences, *(f"for information: {note}" for note in case.notes)]
        hidden = 0 if every else max(0, len(lines) - 12)
        lines = [*lines[: len(lines) - hidden], *([f"and {hidden} more; --all shows them"] if hidden else [])]
        print("".join(f"    {line}\n" for line in lines), end="")
    wrong = [name for name, case in found.items() if case.differences]
    numbers, texts = (sum(getattr(case, name) for case in found.values()) for name in ("numbers", "texts"))
    print(
        f"{len(found)} cases with {numbers} numbers: {len(found) - len(wrong)} equal, {len(wrong)} different"
    )
    print(f"{texts} texts differ", *(["and numbers of", ", ".join(wrong)] if wrong else []))
    return bool(wrong)


def main() -> int:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, folders in (("freeze", ["folder"]), ("problems", ["folder"]), ("compare", ["before", "after"])):
        command = commands.add_parser(name)
        for folder in folders:
            command.add_argument(folder, type=lambda text: Path(text).resolve())
    command.add_argument("--all", action="store_true", help="show all differences of a case")
    args = parser.parse_args()
    if args.command == "compare":
        return compare(args.before, args.after, args.all)
    return freeze(args.folder) if args.command == "freeze" else solve_problems(args.folder)


if __name__ == "__main__":
    sys.exit(main())
