"""`dhcal plan`: choose the poses to measure and predict the resulting accuracy."""

from __future__ import annotations

import os
import re
from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING, Any

from ...exceptions import InvalidArgumentError
from ..options import (
    COLUMNS,
    FIX,
    FREE,
    INSTRUMENT,
    JSON,
    NON_NEGATIVE_INTEGER,
    PARAMETERS,
    POSITIVE_INTEGER,
    RIG,
    ROBOT,
    add_motion_options,
    add_urdf_options,
    split_commas,
)

if TYPE_CHECKING:
    from ..._typing import Array, PathLike
    from ...measurements import MountedRig, Noise
    from ...planning import Plan, PlannedImages
    from ...programs import Program
    from ...robot import Chain, Obstacle, WorkspaceConstraints

EXAMPLE = "dhcal plan ur10.urdf -n 40 --tip tool0 --sigma 0.1mm,0.01deg -o poses.csv"

# Standard deviation of a laser tracker and a precise robot, used without --sigma and --data.
_DEFAULT_SIGMA = "0.1mm,0.01deg"
# Random candidates; images have more rows each, and more of their candidates are good.
_N_CANDIDATES, _N_IMAGE_CANDIDATES = 5000, 2000
# Standard deviation of detected corners and the same robot, used with --rig.
_DEFAULT_IMAGE_SIGMA = "0.3px,0.1mm,0.01deg"

# Decimals of joint positions in degrees and millimetres: 0.36 arc seconds.
_DEGREE_DECIMALS = 4

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the arguments of `dhcal plan`."""
    parser.add_argument("robot", **ROBOT)
    parser.add_argument(
        "-n", "--count", type=POSITIVE_INTEGER, required=True, metavar="N", help="number of poses"
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="poses.csv",
        required=True,
        help="joint values to write, ordered as a short tour",
    )
    add_urdf_options(parser)
    parser.add_argument(
        "--kind",
        metavar="KIND",
        help="kind of measurement (default: pose; camera with --rig): {plannable_kinds}",
    )
    parser.add_argument(
        "--sigma",
        metavar="[PIXELS,]LENGTH[,ANGLE]",
        help="standard deviation per axis of instrument and robot repeatability (default: as in --data, else "
        f"{_DEFAULT_SIGMA}); with --rig, of corners in the image and of the robot (default: "
        f"{_DEFAULT_IMAGE_SIGMA})",
    )
    parser.add_argument(
        "--rig",
        metavar=RIG["metavar"],
        help="plan images by these cameras of these boards, with approximate poses and intrinsics; poses "
        "that are missing are those of a calibrated robot, or are estimated from --data",
    )
    parser.add_argument(
        "--distance",
        metavar="MIN:MAXUNIT",
        help="with --rig: distance of the middle of a board from the camera at which images are sharp, such "
        "as 300:900mm (default: from the size of the board in the image)",
    )
    parser.add_argument(
        "--angle",
        metavar="ANGLE",
        help="with --rig: largest angle between the normal of a board and the line of sight (default: 60deg)",
    )
    parser.add_argument(
        "--corners",
        metavar="SHARE",
        type=float,
        help="with --rig: smallest share of the corners of a board that is in the image (default: 1)",
    )
    parser.add_argument(
        "--border",
        metavar="PIXELS",
        help="with --rig: distance of the corners from the edge of the image, such as 60px; more if the "
        "poses of camera and board are uncertain (default: 2 %% of the width)",
    )
    parser.add_argument(
        "--criterion",
        metavar="C",
        default="D",
        help="optimality criterion (default: %(default)s): {criteria}",
    )
    parser.add_argument(
        "--task",
        metavar="FILE",
        help="configurations where the accuracy matters: joint values, or tool positions x[mm],y[mm],z[mm]",
    )
    parser.add_argument("--parameters", **PARAMETERS)
    parser.add_argument("--fix", default="", **FIX)
    parser.add_argument("--free", default="", **FREE)
    parser.add_argument(
        "--priors",
        metavar="default|FILE",
        help="prior standard deviations, as in calibrate (default: the uncertainty in the sidecar of a "
        "calibrated robot, else default)",
    )
    parser.add_argument("--instrument", **INSTRUMENT)
    parser.add_argument(
        "--data", metavar="DATA", nargs="+", help="existing measurements to complement, as CSV files"
    )
    parser.add_argument("--columns", **COLUMNS)
    parser.add_argument(
        "--candidates",
        type=POSITIVE_INTEGER,
        metavar="N",
        help=f"number of random candidates (default: {_N_CANDIDATES}; {_N_IMAGE_CANDIDATES} with --rig)",
    )
    parser.add_argument(
        "--from", dest="candidates_from", metavar="FILE", help="choose from the joint values in a file"
    )
    parser.add_argument(
        "--box", metavar="X,Y,Z:X,Y,ZUNIT", help="allowed box of the tool in the measuring frame"
    )
    parser.add_argument(
        "--floor",
        metavar="HEIGHT|none",
        help="height of the floor above the root link, which the robot stays above (default: 0mm; none with "
        "--root); none for a robot without a floor, such as one on a ceiling",
    )
    parser.add_argument(
        "--obstacle",
        metavar="SCENE.urdf|X,Y,Z:X,Y,ZUNIT",
        action="append",
        default=[],
        help="obstacle in the frame of the root link: the collision shapes of a URDF, or a box; may be "
        "repeated",
    )
    parser.add_argument(
        "--visible-from",
        metavar="X,Y,ZUNIT",
        help="position of the instrument in the measuring frame; its line of sight to the tool must be free",
    )
    parser.add_argument(
        "--cone",
        metavar="ANGLE",
        help="largest angle between the z axis of the tool and the direction to the instrument, such "
        "as 30deg",
    )
    parser.add_argument(
        "--margin",
        default="5mm,2deg",
        metavar="LENGTH,ANGLE",
        help="distance to the joint limits (default: %(default)s)",
    )
    parser.add_argument(
        "--seed",
        metavar="N",
        type=NON_NEGATIVE_INTEGER,
        default=0,
        help="random seed of the candidates (default: %(default)s)",
    )
    add_motion_options(parser, "deg")
    parser.add_argument("--html", metavar="FILE", help="page with a preview of the poses and the moves")
    parser.add_argument("--report", metavar="R.html", help="write a report with the poses (.html)")
    parser.add_argument("--json", **JSON)


def run(args: Namespace) -> int:
    """Choose poses, write them and show the predicted accuracy."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ...io import configurations_text, read_configurations, read_measurement_file, read_priors, read_robot
    from ...io.sidecar import existing_sidecar, read_instrument, read_uncertainty
    from ...measurements import Noise
    from ...planning import plan, with_measured_poses
    from ...programs import program_text, require_program_ending
    from ...report.document import file_digests, versions
    from ...report.html import check_html_ending
    from ...units import parse_noise
    from ..outputs import existing_sidecars, require_writable_outputs, write_outputs
    from ..screens import console
    from ..screens.result_screens import plan_screen

    kind = _kind(args)
    files = [
        *(args.data or []),
        *filter(None, (args.candidates_from, args.task, args.columns, args.instrument)),
        *filter(_is_scene, args.obstacle),
    ]
    if args.rig:
        files.append(args.rig)
    priors = [args.priors] if args.priors not in (None, "default") else []
    inputs = [args.robot, *existing_sidecars([args.robot]), *files, *priors]
    require_writable_outputs([args.output, args.json, args.html, args.report, *args.export], inputs)
    if args.report:
        check_html_ending(args.report, "the report of a plan")
    for path in args.export:
        require_program_ending(path)
    chain = read_robot(args.robot, args.tip, package_dirs=args.package_dir, root=args.root)
    space = _workspace_constraints(args)
    candidates: int | Array = args.candidates or (_N_IMAGE_CANDIDATES if args.rig else _N_CANDIDATES)
    rows = np.zeros(0, int)
    if args.candidates_from:
        candidates = read_configurations(args.candidates_from, chain, args.columns)
        rows = np.arange(len(candidates))
        if args.rig:
            # A table of image coordinates has one row per corner.
            rows = np.sort(np.unique(candidates, axis=0, return_index=True)[1])
        candidates = candidates[rows]
        _require_few(args.candidates_from, len(candidates))
    rig = _mounted_rig(args.rig, args.robot, chain) if args.rig else None
    data = [read_measurement_file(path, chain, args.columns, rig=rig).data for path in args.data or []]
    # The uncertainty of an earlier calibration would count twice beside its data, and replaces the priors.
    sidecar = None if args.data or args.priors else existing_sidecar(args.robot)
    prior_uncertainty = read_uncertainty(sidecar, chain) if sidecar else None
    images = None
    if rig is not None:
        images, noise = _planned_images(args, with_measured_poses(rig, chain, data))
    elif args.sigma or not any(item.kind == kind for item in data):
        noise = Noise(*parse_noise(args.sigma or _DEFAULT_SIGMA, "--sigma"))
    else:
        noise = None
    with console.show_progress(f"choosing {args.count} poses") as progress:
        result = plan(
            chain,
            args.count,
            kind=kind,
            noise=noise,
            parameters=args.parameters,
            priors=read_priors(args.priors) or "default",
            fix=split_commas(args.fix),
            free=split_commas(args.free),
            criterion=args.criterion,
            data=data,
            known=read_instrument(args.instrument) if args.instrument else None,
            prior_uncertainty=prior_uncertainty,
            images=images,
            task=read_task(args.task, chain) if args.task else None,
            candidates=candidates,
            space=space,
            margin=Noise(*parse_noise(args.margin, "--margin")),
            seed=args.seed,
            progress=progress,
        )
    noise = result.information.noise
    moves = move_texts(result)
    chosen_rows = None if result.index is None else (rows[result.index] + 1).tolist()
    document = _plan_document(result, args, kind, chosen_rows)
    pixels = f"{images.sigma:.4g} px, " if images else ""
    comments = [
        f"{args.count} poses to measure ({kind}, criterion {result.criterion}), as a short tour",
        f"predicted position error {1e3 * result.error:.4g} mm RMS with standard deviation "
        f"{pixels}{1e3 * noise.position:.4g} mm, {np.degrees(noise.rotation):.4g} deg",
    ]
    document |= {"inputs": file_digests(inputs), "versions": versions()}
    decimals = _DEGREE_DECIMALS if args.joint_units == "deg" else None
    text = configurations_text(result.q, chain, [*comments, *moves], args.joint_units, decimals)
    contents: dict[PathLike, str | bytes] = {args.output: text}
    for path in args.export:
        contents[path] = program_text(_program(result, chain), path)
    if args.html:
        contents[args.html] = _preview(result, chain, space, args, images)
    if args.report:
        from ...io.robot import robot_name  # lazy import, as the following: only for reports
        from ...report.plan import PlanReport, plan_page

        contents[args.report] = plan_page(
            PlanReport(
                plan=result,
                chain=chain,
                name=robot_name(args.robot),
                file=os.path.basename(args.output),
                first_line=text.count("\n") - len(result.q) + 1,
                text=text,
                moves=moves,
                scene=_preview(result, chain, space, args, images),
                inputs=document["inputs"],
                pixel_sigma=images.sigma if images else np.nan,
            )
        )
    write_outputs(contents, args.json, document)
    console.show(plan_screen(result, moves, contents), args.verbosity)
    return 0


def _kind(args: Namespace) -> str:
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


def _mounted_rig(path: str, robot: str, chain: Chain) -> MountedRig:
    """Return the rig of a file, with the poses of a calibrated robot where it has none."""
    from ...io.rig_file import read_calibrated_rig, read_rig, with_poses_of  # lazy import, as the following
    from ...io.sidecar import existing_sidecar
    from ...measurements import mount_rig

    rig, sidecar = read_rig(path), existing_sidecar(robot)
    calibrated = read_calibrated_rig(sidecar) if sidecar else None
    return mount_rig(with_poses_of(rig, calibrated) if calibrated else rig, chain)


def _planned_images(args: Namespace, rig: MountedRig) -> tuple[PlannedImages, Noise]:
    """Return the images to plan and the noise of the robot, from the options that need --rig."""
    from ...measurements import Noise  # lazy import, as the following: they are slow to load
    from ...planning import PlannedImages
    from ...units import parse_noise

    pixels, *others = (args.sigma or _DEFAULT_IMAGE_SIGMA).split(",")
    sigma = _parse_pixels(pixels, "--sigma", f"pixels above zero first, such as {_DEFAULT_IMAGE_SIGMA}")
    noise = Noise(*parse_noise(",".join(others), "--sigma")) if others else Noise()
    distance = _parse_distances(args.distance) if args.distance else None
    options: dict[str, Any] = {"sigma": sigma, "distance": distance}
    if args.angle:
        options["max_angle"] = _parse_angle(args.angle, "--angle", 90.0)
    if args.corners is not None:
        if not 0 < args.corners <= 1:
            raise InvalidArgumentError(f"--corners {args.corners:g}: expected a share above 0 and at most 1")
        options["min_share"] = args.corners
    if args.border:
        options["margin"] = _parse_pixels(args.border, "--border")
    return PlannedImages(rig, **options), noise


def _parse_pixels(text: str, option: str, expected: str = "pixels above zero, such as 60px") -> float:
    """Parse a positive number of pixels."""
    match = re.fullmatch(rf"\s*({_NUMBER})\s*px\s*", text)
    if not match or float(match[1]) <= 0:
        raise InvalidArgumentError(f"{option} {text}: expected {expected}")
    return float(match[1])


def _parse_distances(text: str) -> tuple[float, float]:
    """Parse the smallest and the largest distance of a board [m]."""
    from ...units import LENGTHS  # lazy import: slow to load

    match = re.fullmatch(rf"\s*({_NUMBER})\s*:\s*({_NUMBER})\s*([a-zµμ]+)\s*", text)
    if not match or match[3] not in LENGTHS:
        raise InvalidArgumentError(
            f"--distance {text}: expected the smallest and the largest distance with a unit, such as "
            "300:900mm"
        )
    low, high = (float(match[i]) / LENGTHS[match[3]] for i in (1, 2))
    if not 0 <= low < high:
        raise InvalidArgumentError(
            f"--distance {text}: the first distance must be at least 0 and less than the second"
        )
    return low, high


def _parse_angle(text: str, option: str, largest: float, what: str = "angle") -> float:
    """Parse an angle above zero and at most some degrees [rad]."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ...units import ANGLES

    match = re.fullmatch(rf"\s*({_NUMBER})\s*(rad|deg)\s*", text)
    angle = float(match[1]) / ANGLES[match[2]] if match else 0.0
    if not 0 < angle <= np.deg2rad(largest):
        raise InvalidArgumentError(
            f"{option} {text}: invalid {what}; expected at most {largest:g}deg, such as 30deg"
        )
    return angle


def move_texts(result: Plan) -> list[str]:
    """Describe the moves between the poses of a plan."""
    if not result.is_way_free:
        return []
    blocked = [str(i) for i, is_free in enumerate(result.is_way_free, 1) if not is_free]
    with_way_points = [str(i) for i, way in enumerate(result.ways, 1) if len(way)]
    texts = []
    if with_way_points:
        listed = ", ".join(with_way_points)
        texts.append(f"Way points lead around collisions to poses {listed} (--export, --html).")
    if blocked:
        texts.append(f"The straight moves to poses {', '.join(blocked)} collide; no way around was found.")
    return texts or ["The straight moves in joint space from pose to pose are free of collisions."]


def _program(result: Plan, chain: Chain) -> Program:
    """Create the program that visits the poses."""
    from dataclasses import replace  # lazy import, as the following: they are slow to load

    import numpy as np

    from ...programs import Program, Stop

    poses = replace(chain, base=np.eye(4)).poses(result.q)
    is_checked = bool(result.is_way_free)
    stops = [
        Stop(f"pose {i + 1}", q, pose, tuple(way), not is_checked or result.is_way_free[i])
        for i, (q, pose, way) in enumerate(zip(result.q, poses, result.ways, strict=True))
    ]
    warning = (
        "The move to pose 1 is not checked for collisions; the others are checked against the model."
        if is_checked
        else "The moves are not checked for collisions."
    )
    return Program(chain, "poses to measure, by dhcal plan", warning, stops)


def _preview(
    result: Plan, chain: Chain, space: WorkspaceConstraints, args: Namespace, images: PlannedImages | None
) -> str:
    """Return the page that shows the poses, the path, cameras and boards, floor and obstacles."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ...io.robot import robot_name
    from ...visualization import Preview, scene_html

    path = [part for way, q in zip(result.ways, result.q, strict=True) for part in (way, q[None])]
    stops = np.cumsum([len(way) + 1 for way in result.ways]) - 1
    return scene_html(
        chain,
        preview=Preview(np.concatenate(path), stops.tolist(), space),
        rig=images.rig if images else None,
        title=f"{len(result.q)} poses for {robot_name(args.robot)}",
    )


def _is_scene(obstacle: str) -> bool:
    """Return whether the value of --obstacle names a file and not a box."""
    return obstacle.lower().endswith(".urdf") or os.path.exists(obstacle)


def _obstacles(args: Namespace) -> list[Obstacle]:
    """Create the obstacles of --obstacle."""
    from dataclasses import replace  # lazy import, as the following: they load Pinocchio

    from ...robot import Obstacle, obstacles_from_urdf, read_urdf

    obstacles = []
    for text in args.obstacle:
        if _is_scene(text):
            obstacles += obstacles_from_urdf(replace(read_urdf(text), package_dirs=tuple(args.package_dir)))
        else:
            obstacles.append(Obstacle.box(*_parse_box(text, "--obstacle", "a URDF, or corners")))
    return obstacles


def _floor(text: str | None, root: str | None) -> float | None:
    """Parse the height of the floor [m]; None without a floor."""
    from ...units import LENGTHS  # lazy import: slow to load

    # The height counts from the first link, which may be the head of the robot.
    text = text or ("none" if root else "0mm")
    if text == "none":
        return None
    match = re.fullmatch(rf"\s*({_NUMBER})\s*([a-zµμ]+)\s*", text)
    if not match or match[2] not in LENGTHS:
        raise InvalidArgumentError(f"--floor {text}: expected a height with a unit, such as -800mm, or none")
    return float(match[1]) / LENGTHS[match[2]]


def _parse_box(text: str, option: str, expected: str = "corners") -> Array:
    """Parse the lowest and the highest corner of a box, shape (2, 3) [m]."""
    import numpy as np  # lazy import: slow to load

    box = _parse_points(text, option, "200,-400,100:900,400,800mm", 2, expected)
    if not np.all(box[0] < box[1]):
        raise InvalidArgumentError(
            f"{option} {text}: the first corner must be below the second in x, y and z"
        )
    return box


def _workspace_constraints(args: Namespace) -> WorkspaceConstraints:
    """Create the constraints of the robot from --box, --visible-from, --cone, --floor and --obstacle."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ...robot import WorkspaceConstraints

    box = _parse_box(args.box, "--box") if args.box else None
    instrument = None
    if args.visible_from:
        instrument = _parse_points(args.visible_from, "--visible-from", "3000,0,1200mm", 1)[0]
    if args.cone and instrument is None:
        raise InvalidArgumentError("--cone: needs --visible-from, the position of the instrument")
    cone = _parse_angle(args.cone, "--cone", 180.0, "half angle") if args.cone else np.pi
    return WorkspaceConstraints(box, instrument, cone, _floor(args.floor, args.root), _obstacles(args))


def _parse_points(text: str, option: str, example: str, count: int, expected: str = "x,y,z") -> Array:
    """Parse points, shape (count, 3) [m], from coordinates with one unit at the end."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ...units import LENGTHS

    point = rf"\s*{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER}\s*"
    match = re.fullmatch(rf"({point}(?::{point}){{{count - 1}}})([a-zµμ]+)\s*", text)
    if not match or match[2] not in LENGTHS:
        raise InvalidArgumentError(
            f"{option} {text}: invalid coordinates; expected {expected} with a unit at the end, such as "
            f"{example}"
        )
    return np.array(re.findall(_NUMBER, match[1]), float).reshape(count, 3) / LENGTHS[match[2]]


def _require_few(source: str, count: int) -> None:
    """Require configurations that fit into the memory."""
    from ...planning.planner import MAX_CANDIDATES  # lazy import: slow to load

    if count > MAX_CANDIDATES:
        raise InvalidArgumentError(
            f"{source}: {count} configurations, more than {MAX_CANDIDATES}; give fewer"
        )


def read_task(path: PathLike, chain: Chain) -> Array:
    """Read the configurations where the accuracy matters."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ...compensation import LIMITS, compensate
    from ...io import read_configurations, read_targets
    from ...io.tables import read_table

    table = read_table(path)
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


def _plan_document(result: Plan, args: Namespace, kind: str, chosen_rows: list[int] | None) -> dict[str, Any]:
    """Create the JSON document of a plan, in SI units."""
    from ..outputs import json_path  # lazy import: loads Pinocchio

    noise = result.information.noise
    path = json_path(args.json)
    return {
        "poses": len(result.q),
        "kind": kind,
        "criterion": result.criterion,
        "sigma_position_m": noise.position,
        "sigma_orientation_rad": noise.rotation,
        "rows": chosen_rows,
        "log_det": result.log_det,
        "predicted_position_rms_m": result.error,
        "predicted_position_rms_with_points_m": result.error_with_points,
        "random_position_rms_m": result.random_error,
        "relative_error": result.relative_error,
        "recommended_size": result.recommended_size,
        "curve": _curve(result.sizes, result.errors),
        "random_curve": _curve(result.random_sizes, result.random_errors),
        "joint_curves": [
            {"poses": one.n_poses, "filled_share": one.filled_share, "curve_std_rad": one.curve_std}
            for one in result.curves
        ],
        "way_points": {str(i): way.tolist() for i, way in enumerate(result.ways, 1) if len(way)},
        "blocked_moves": [i for i, is_free in enumerate(result.is_way_free, 1) if not is_free],
        "views": [
            {
                "camera": one.camera,
                "images": one.n_images,
                "covered_share": one.covered_share,
                "distance_min_m": _or_null(one.distances[0]),
                "distance_max_m": _or_null(one.distances[1]),
                "angle_max_rad": _or_null(one.max_angle),
            }
            for one in result.views
        ],
        "notes": list(result.notes),
        "files": {"poses": args.output}
        | ({"json": path} if path else {})
        | ({"html": args.html} if args.html else {})
        | ({"report": args.report} if args.report else {}),
    }


def _or_null(value: float) -> float | None:
    """Return a number, or None in place of NaN."""
    return value if value == value else None


def _curve(sizes: Array, errors: Array) -> list[dict[str, float]]:
    """Convert a curve of errors over the number of poses to JSON."""
    return [
        {"poses": int(size), "predicted_position_rms_m": float(error)}
        for size, error in zip(sizes, errors, strict=True)
    ]
