"""Input of `dhcal plan`: files and values with units that its options name, as arguments of `plan`."""

from __future__ import annotations

import os
import re
from argparse import Namespace
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from .._typing import Array, PathLike
from ..compensation import LIMITS, compensate
from ..estimation.parameters import LOW_COST
from ..exceptions import InvalidArgumentError
from ..io.measurement_files import read_configurations, read_targets
from ..io.measurement_files.targets import TARGETS
from ..io.servo_file import read_servos
from ..io.settings import read_priors
from ..io.sidecar import existing_sidecar, read_instrument, read_uncertainty
from ..io.tables import read_table
from ..measurements.base import Noise
from ..measurements.mounting import MountedRig
from ..planning.changes import N_VISITS, change_options, repeated_count
from ..planning.planner import MAX_CANDIDATES
from ..planning.views import PlannedImages, with_measured_poses, with_typical_lenses
from ..robot.chain import Chain
from ..robot.collision import Obstacle, obstacles_from_urdf
from ..robot.sampling import WorkspaceConstraints
from ..robot.urdf import read_urdf
from ..units import ANGLES, LENGTHS, PIXELS, parse_noise
from .options import forbid_options, read_data, read_mounted_rig, split_commas
from .outputs import existing_sidecars
from .plan_options import (
    DEFAULT_IMAGE_SIGMA,
    DEFAULT_LOW_COST_SIGMA,
    DEFAULT_SIGMA,
    LOW_COST_VIEWS,
    N_CANDIDATES,
    N_IMAGE_CANDIDATES,
    N_LOW_COST_CANDIDATES,
    N_RECHECKED,
)

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"


def input_paths(args: Namespace) -> list[str]:
    """List the files that a plan reads."""
    paths = [args.robot, *existing_sidecars([args.robot]), *(args.data or [])]
    paths += filter(None, (args.candidates_from, args.task, args.columns, args.instrument, args.servos))
    paths += [*filter(_is_scene, args.obstacle), *([args.rig] if args.rig else [])]
    return paths if args.priors in (None, "default") else [*paths, args.priors]


def read_input(args: Namespace, chain: Chain, kind: str) -> tuple[dict[str, Any], Array]:
    """Return the keyword arguments of `plan`, and the rows (m,) of given candidates in their file, from 0."""
    space = workspace_constraints(args)
    candidates, rows = _read_candidates(args, chain)
    rig = read_mounted_rig(args.rig, existing_sidecar(args.robot), chain) if args.rig else None
    servos = read_servos(args.servos) if args.servos else None
    data = [file.data for file in read_data(args, chain, servos, rig)]
    # The uncertainty of an earlier calibration would count twice beside its data, and replaces the priors.
    sidecar = None if args.data or args.priors else existing_sidecar(args.robot)
    images, noise = None, None
    if rig is not None:
        rig, is_low_cost = with_measured_poses(rig, chain, data), LOW_COST in chain.parameters
        sigma = args.sigma or (DEFAULT_LOW_COST_SIGMA if is_low_cost else DEFAULT_IMAGE_SIGMA)
        options = LOW_COST_VIEWS if is_low_cost else {}
        images, noise = _planned_images(
            args, with_typical_lenses(rig) if is_low_cost else rig, sigma, options
        )
    elif args.sigma or not any(item.kind == kind for item in data):
        noise = Noise(*parse_noise(args.sigma or DEFAULT_SIGMA, "--sigma"))
    keywords = {
        "kind": kind,
        "noise": noise,
        "parameters": args.parameters,
        "priors": read_priors(args.priors) or "default",
        "fix": split_commas(args.fix),
        "free": split_commas(args.free),
        "criterion": args.criterion or "D",
        "data": data,
        "known": read_instrument(args.instrument) if args.instrument else None,
        "prior_uncertainty": read_uncertainty(sidecar, chain) if sidecar else None,
        "images": images,
        "task": read_task(args.task, chain) if args.task else None,
        "candidates": candidates,
        "space": space,
        "margin": Noise(*parse_noise(args.margin, "--margin")),
        "seed": args.seed,
    }
    return keywords | (change_options(chain) if args.recheck else {}), rows


def planned_count(args: Namespace) -> tuple[int, int]:
    """Return the number of different poses to plan, and how many of them are repeated."""
    if args.recheck:
        forbid_options(args, "rig data parameters priors criterion", "not allowed with --recheck")
    elif args.count is None:
        raise InvalidArgumentError("the number of poses is missing; expected -n, such as -n 40")
    count = args.count or N_RECHECKED
    repeated = repeated_count(count) if args.repeat else 0
    return count - (N_VISITS - 1) * repeated, repeated


def _read_candidates(args: Namespace, chain: Chain) -> tuple[int | Array, Array]:
    """Return the number of candidates to draw, or those of --from, and their rows in the file."""
    if not args.candidates_from:
        of_images = N_LOW_COST_CANDIDATES if LOW_COST in chain.parameters else N_IMAGE_CANDIDATES
        return args.candidates or (of_images if args.rig else N_CANDIDATES), np.zeros(0, int)
    candidates = read_configurations(args.candidates_from, chain, args.columns, args.sheet)
    rows = np.arange(len(candidates))
    if args.rig:
        # A table of image coordinates has one row per corner.
        rows = np.sort(np.unique(candidates, axis=0, return_index=True)[1])
    _require_few(args.candidates_from, len(rows))
    return candidates[rows], rows


def planned_kind(args: Namespace) -> str:
    """Return the kind of measurement, after a check of the options that need --rig or exclude it."""
    if args.rig:
        if args.kind not in (None, "camera"):
            raise InvalidArgumentError(f"--kind {args.kind}: not allowed with --rig, which plans images")
        return "camera"
    if args.kind == "camera":
        raise InvalidArgumentError("--kind camera: needs --rig, the file with cameras and boards")
    for option in ("distance", "angle", "corners", "border"):
        if getattr(args, option) is not None:
            raise InvalidArgumentError(f"--{option}: needs --rig, the file with cameras and boards")
    return args.kind or "pose"


def _planned_images(
    args: Namespace, rig: MountedRig, sigma: str, defaults: Mapping[str, float]
) -> tuple[PlannedImages, Noise]:
    """Return the images to plan and the noise of the robot, from the options that need --rig."""
    pixels, *others = sigma.split(",")
    noise_px = _parse_pixels(pixels, "--sigma", f"pixels above zero first, such as {DEFAULT_IMAGE_SIGMA}")
    noise = Noise(*parse_noise(",".join(others), "--sigma")) if others else Noise()
    distance = _parse_distances(args.distance) if args.distance else None
    options: dict[str, Any] = {**defaults, "sigma": noise_px, "distance": distance}
    if args.angle:
        options["max_angle"] = _parse_angle(args.angle, "--angle", 90.0)
    if args.corners is not None:
        if not 0 < args.corners <= 1:
            raise InvalidArgumentError(f"--corners {args.corners:g}: expected a share above 0 and at most 1")
        options["min_share"] = args.corners
    if args.border:
        options["margin"] = _parse_pixels(args.border, "--border")
    return PlannedImages(rig, **options), noise


def _is_scene(obstacle: str) -> bool:
    """Return whether the value of --obstacle names a file and not a box."""
    return obstacle.lower().endswith(".urdf") or os.path.exists(obstacle)


def _obstacles(args: Namespace) -> list[Obstacle]:
    """Create the obstacles of --obstacle."""
    obstacles = []
    for text in args.obstacle:
        if _is_scene(text):
            obstacles += obstacles_from_urdf(replace(read_urdf(text), package_dirs=tuple(args.package_dir)))
        else:
            obstacles.append(Obstacle.box(*_parse_box(text, "--obstacle", "a URDF, or corners")))
    return obstacles


def workspace_constraints(args: Namespace) -> WorkspaceConstraints:
    """Create the constraints of the robot from --box, --visible-from, --cone, --floor and --obstacle."""
    box = _parse_box(args.box, "--box") if args.box else None
    instrument = None
    if args.visible_from:
        instrument = _parse_points(args.visible_from, "--visible-from", "3000,0,1200mm", 1)[0]
    if args.cone and instrument is None:
        raise InvalidArgumentError("--cone: needs --visible-from, the position of the instrument")
    cone = _parse_angle(args.cone, "--cone", 180.0, "half angle") if args.cone else np.pi
    return WorkspaceConstraints(box, instrument, cone, _floor(args.floor, args.root), _obstacles(args))


def _require_few(source: str, count: int) -> None:
    """Require configurations that fit into the memory."""
    if count > MAX_CANDIDATES:
        raise InvalidArgumentError(
            f"{source}: {count} configurations, more than {MAX_CANDIDATES}; give fewer"
        )


def read_task(path: PathLike, chain: Chain) -> Array:
    """Read the configurations where the accuracy matters."""
    table = read_table(path, TARGETS)
    _require_few(os.fspath(path), len(table.lines))
    if any(name in table.columns for name in chain.joint_names):
        return read_configurations(path, chain)
    targets = read_targets(path, chain)
    result = compensate(chain, chain, targets.values)
    if (failed := np.flatnonzero(~result.reached)).size:
        is_limited = result.status[failed[0]] == LIMITS
        problem = "within reach only beyond the joint limits" if is_limited else "out of reach"
        raise InvalidArgumentError(
            f"{targets.source}: target {failed[0] + 1} is {problem}; correct or remove it"
        )
    return result.q


def _parse_pixels(text: str, option: str, expected: str = "pixels above zero, such as 60px") -> float:
    """Parse a positive number of pixels."""
    return _parse_numbers(text, option, "#", PIXELS, f"expected {expected}", lambda x: x[0] > 0)[0]


def _parse_distances(text: str) -> tuple[float, float]:
    """Parse the smallest and the largest distance of a board [m]."""
    problem = "expected the smallest and the largest distance with a unit, such as 300:900mm"
    low, high = _parse_numbers(text, "--distance", "#:#", LENGTHS, problem)
    if not 0 <= low < high:
        raise InvalidArgumentError(
            f"--distance {text}: the first distance must be at least 0 and less than the second"
        )
    return low, high


def _parse_angle(text: str, option: str, largest: float, what: str = "angle") -> float:
    """Parse an angle above zero and at most some degrees [rad]."""
    units = {unit: ANGLES[unit] for unit in ("rad", "deg")}
    problem = f"invalid {what}; expected at most {largest:g}deg, such as 30deg"
    return _parse_numbers(text, option, "#", units, problem, lambda x: 0 < x[0] <= np.deg2rad(largest))[0]


def _floor(text: str | None, root: str | None) -> float | None:
    """Parse the height of the floor [m]; None without a floor."""
    # The height counts from the first link, which may be the head of the robot.
    text = text or ("none" if root else "0mm")
    if text == "none":
        return None
    return parse_length(text, "--floor", "a height with a unit, such as -800mm, or none")


def parse_length(text: str, option: str, expected: str) -> float:
    """Parse a length with its unit [m]."""
    return _parse_numbers(text, option, "#", LENGTHS, f"expected {expected}")[0]


def _parse_box(text: str, option: str, expected: str = "corners") -> Array:
    """Parse the lowest and the highest corner of a box, shape (2, 3) [m]."""
    box = _parse_points(text, option, "200,-400,100:900,400,800mm", 2, expected)
    if not np.all(box[0] < box[1]):
        raise InvalidArgumentError(
            f"{option} {text}: the first corner must be below the second in x, y and z"
        )
    return box


def _parse_points(text: str, option: str, example: str, count: int, expected: str = "x,y,z") -> Array:
    """Parse points, shape (count, 3) [m], from coordinates with one unit at the end."""
    form = ":".join(["#,#,#"] * count)
    problem = f"invalid coordinates; expected {expected} with a unit at the end, such as {example}"
    return np.reshape(_parse_numbers(text, option, form, LENGTHS, problem), (count, 3))


def _parse_numbers(
    text: str,
    option: str,
    form: str,
    units: Mapping[str, float],
    problem: str,
    accepts: Callable[[list[float]], bool] = lambda values: True,
) -> list[float]:
    """Parse numbers with one unit at the end, in SI units; the form is #:# for a text such as 300:900mm."""
    numbers = rf"\s*({_NUMBER})\s*".join(form.split("#"))
    match = re.fullmatch(rf"{numbers}([a-zµμ]+)\s*", text)
    if match and match.groups()[-1] in units:
        *values, unit = match.groups()
        found = [float(value) / units[unit] for value in values]
        if accepts(found):
            return found
    raise InvalidArgumentError(f"{option} {text}: {problem}")
