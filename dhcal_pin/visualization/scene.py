"""3-D scene of the robot before and after calibration, as one web page that needs no network.

The page contains everything that it shows: the script of MeshCat, the meshes and the kinematics. It opens
from disk, in notebooks and in reports.

Python describes the robot as a tree of bodies (`kinematic_tree`), which `viewer.html` draws. Each body has
its nominal placement in its parent, T, the twist ξ = log(T⁻¹ T_calibrated) of its calibrated placement, and
the joint that moves it. Errors are magnified by the factor s as T exp(s ξ), so that s = 1 shows the
calibrated robot itself.

The errors of the joints are functions in JavaScript, put together from the formulas in the rows of
`robot.error_families`. The page does not know the direction of motion and the temperature. It draws joints
without backlash, and links as they are at the reference temperature; a note says so.

Everything is drawn in the frame of the calibrated robot's base link. The page states tool positions in the
measuring frame. A nominal robot without base or tool takes those of the calibrated robot, because they
describe the set-up of the measurement and not the robot.
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from .. import se3
from .._frozen import frozen
from .._typing import Array, PathLike
from ..calibration.presentation.workspace import uncertainty_cells
from ..calibration.result import Result
from ..estimation.uncertainty import Predictor
from ..exceptions import InvalidArgumentError
from ..measurements.base import Measurement
from ..measurements.mounting import MountedRig
from ..robot.chain import Chain
from ..robot.conditions import CONDITIONS
from ..robot.sampling import WorkspaceConstraints
from ..robot.transmission import coefficient_indices
from ..subsampling import evenly_spaced_indices
from .measured_samples import SETS, drawn_samples, measured_samples, sets_of
from .meshes import obstacle_shapes, rows, visuals_of
from .rig_lines import rig_lines

# Largest number of measured points and of configurations to play; more would make the page slow.
MAX_POINTS = 2000
# Samples with the largest residuals, which are always among these points.
N_LARGEST = 200
# Largest number of ellipsoids; more would hide each other.
MAX_ELLIPSOIDS = 400
# Largest number of triangles of all meshes; more would make the page large and slow.
MAX_TRIANGLES = 60_000
# Fewer triangles cannot show a robot.
MIN_TRIANGLES = 100
# Largest magnification of errors.
MAX_MAGNIFICATION = 500
# Range of a slider in each direction for a prismatic joint without limits [m].
DEFAULT_STROKE_M = 0.5

PAGE = Path(__file__).with_name("viewer.html")


@frozen(eq=False)
class Preview:
    """Poses that the arm will visit, and what stands around it."""

    q: Array  # Joint positions on the way, shape (m, n) [rad or m]; moves between them are straight
    stops: Sequence[int]  # Rows of `q` at which the arm stops
    workspace: WorkspaceConstraints  # Floor and obstacles


def scene_html(
    nominal: Chain,
    calibrated: Chain | Result | None = None,
    *,
    q: Array | None = None,
    measurements: Sequence[Measurement] | None = None,
    known: Mapping[str, float] | None = None,
    predictor: Predictor | None = None,
    preview: Preview | None = None,
    rig: MountedRig | None = None,
    title: str = "Robot calibration",
    package_dirs: Sequence[PathLike] | None = None,
    magnification: float = 1.0,
    triangles: int = MAX_TRIANGLES,
) -> str:
    """Build the page of a robot, or of a robot before and after its calibration.

    Args:
        nominal: Nominal robot; transparent beside the calibrated one, solid if alone.
        calibrated: Calibrated robot with the same joints, or the result of the calibration. With a result,
            the nominal robot has the base and tool that fit the same measurements, these measurements and
            the held-out ones are shown, and ellipsoids show one standard deviation of the tool position.
        q: Joint positions to play, shape (m, n) [rad or m]; by default those of the measurements.
        measurements: Measurements; positions among them are drawn with arrows from the modelled positions.
        known: Values of instrument parameters by name, as in `Result.instruments`; by default their initial
            values.
        predictor: Source of the uncertainty of the tool position; by default the result.
        preview: Poses to play in place of `q`, drawn with the path of the tool, floor and obstacles.
        rig: Cameras and boards whose poses are known, drawn as lines with the lines of sight to the boards;
            by default those of the result.
        title: Heading of the page.
        package_dirs: Folders that contain the meshes of the URDF; by default those of `ros_packages`.
        magnification: Initial magnification of errors, from 1 to `MAX_MAGNIFICATION`.
        triangles: Largest number of triangles of all meshes; 15,000 still show the form of each link.

    Returns:
        Text of the page; the same for the same input.

    Raises:
        InvalidArgumentError: The two robots have different joints, or an argument has a wrong shape or value.
    """
    if not 1 <= magnification <= MAX_MAGNIFICATION:
        raise InvalidArgumentError(
            f"magnification {magnification:g}: expected a number from 1 to {MAX_MAGNIFICATION}"
        )
    if triangles < MIN_TRIANGLES:
        raise InvalidArgumentError(f"{triangles} triangles: expected at least {MIN_TRIANGLES}")
    nominal_known, sets = known, None
    if isinstance(calibrated, Result):
        predictor, rig = predictor or calibrated, rig or calibrated.rig
        if measurements is None:
            measurements = [*calibrated.data, *calibrated.holdout]
            sets = sets_of(calibrated)
        if known is None:
            known, nominal_known = calibrated.instruments, calibrated.nominal_instruments
        nominal = replace(
            nominal, base=calibrated.nominal_refitted.base, tool=calibrated.nominal_refitted.tool
        )
        calibrated = calibrated.chain
    measurements = measurements or ()
    sets = [np.zeros(len(item.rows), int) for item in measurements] if sets is None else sets
    shown = nominal if calibrated is None else calibrated
    tree = kinematic_tree(nominal, shown)
    visuals = visuals_of(nominal, tree["bodies"], package_dirs, triangles)
    obstacles, obstacle_meshes = obstacle_shapes(
        preview.workspace.obstacles if preview else (), len(visuals.meshes)
    )
    q = preview.q if preview else q
    parts = [item.configurations() for item in measurements if item.configurations_per_row]
    played = [q] if q is not None else parts
    configurations = np.concatenate([np.empty((0, nominal.n_joints)), *map(nominal.validated_q, played)])
    arms = (with_shared_frames(nominal, shown), shown)
    measured = measured_samples(arms, measurements, (nominal_known or {}, known or {}), sets)
    drawn = measured.take(drawn_samples(measured, MAX_POINTS, N_LARGEST))
    notes = [
        visuals.note,
        *(
            f"Drawn without {family.description}: the page does not know the "
            f"{CONDITIONS[family.condition].description}."
            for family in shown.error_families
            if family.condition
        ),
    ]
    if len(drawn) < len(measured):
        notes.append(f"{len(drawn)} of {len(measured)} measured points are drawn.")
    cells = uncertainty_cells(predictor) if predictor else None
    ellipsoids = _ellipsoids(predictor, configurations) if predictor else []
    if predictor and len(configurations) and not ellipsoids:
        notes.append("No ellipsoids: the measurements do not determine the uncertainty of the tool position.")
    base = shown.base
    scene = {
        "title": title,
        "note": " ".join(filter(None, notes)),
        "has_calibrated": calibrated is not None,
        "magnification": magnification,
        "max_magnification": MAX_MAGNIFICATION,
        "joints": _sliders(nominal, np.concatenate([configurations, measured.q])),
        "configurations": (
            configurations
            if preview
            else configurations[evenly_spaced_indices(len(configurations), MAX_POINTS)]
        ).tolist(),
        "stops": [int(i) for i in preview.stops] if preview else [],
        "obstacles": obstacles,
        "floor": (preview.workspace.floor if preview else None) or 0.0,
        "samples": drawn.q.tolist(),
        "points": np.round((drawn.points - base[:3, 3]) @ base[:3, :3], 9).tolist(),
        "residuals": np.round(drawn.residuals @ base[:3, :3], 9).tolist(),
        "nominal_residuals": np.round(drawn.nominal_residuals @ base[:3, :3], 9).tolist(),
        "set_names": SETS,
        "sets": drawn.sets.tolist(),
        "files": drawn.files.tolist(),
        "lines": drawn.lines.tolist(),
        "rig": rig_lines(rig, base, reach(shown)) if rig else {"parts": [], "rays": []},
        "ellipsoids": ellipsoids,
        "cells": {"size": cells.size, "index": cells.index.tolist(), "std": np.round(cells.std, 9).tolist()}
        if cells
        else None,
        "shapes": visuals.shapes,
        "meshes": [mesh.encoded() for mesh in (*visuals.meshes, *obstacle_meshes)],
        **tree,
    }
    data = json.dumps(scene, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")
    replacements = {
        "@TITLE@": html.escape(title),
        "/*@MESHCAT@*/": _meshcat(),
        "@SCENE@": data,
        "/*@JOINT_ERRORS@*/": ",\n  ".join(map(_joint_errors, (nominal, shown))),
    }
    marks = "|".join(map(re.escape, replacements))
    return re.sub(marks, lambda mark: replacements[mark[0]], PAGE.read_text("utf-8"))


def reach(chain: Chain) -> float:
    """Return the sum of the lengths of the links [m]."""
    return float(np.linalg.norm(chain.origins[:, :3, 3], axis=1).sum())


@frozen
class Scene:
    """Page that notebooks show inline."""

    # Notebooks save the repr as well, so it must be short.
    html: str = field(repr=False)  # Text of the page
    height: int  # Height of the frame in the notebook [px]

    def _repr_html_(self) -> str:
        source = self.html.replace("&", "&amp;").replace('"', "&quot;")
        style = f"width:100%;height:{self.height}px;border:0;border-radius:8px"
        return f'<iframe srcdoc="{source}" style="{style}" title="Robot calibration"></iframe>'


def show(
    nominal: Chain, calibrated: Chain | Result | None = None, *, height: int = 620, **options: Any
) -> Scene:
    """Show the robot in a notebook; the scene is part of the saved notebook.

    Args:
        nominal: Nominal robot.
        calibrated: Calibrated robot, or the result of the calibration.
        height: Height of the frame in the notebook [px].
        options: Further arguments of `scene_html`.

    Returns:
        Page that the notebook shows.
    """
    return Scene(scene_html(nominal, calibrated, **options), height)


def _meshcat() -> str:
    """Return the script of MeshCat with its licences, without importing the package and its server."""
    package = metadata.distribution("meshcat")
    viewer = Path(str(package.locate_file("meshcat/viewer")))
    parts = ["/*!", (viewer / "LICENSE").read_text(encoding="utf-8"), "*/"]
    parts += [
        (viewer / "dist" / name).read_text(encoding="utf-8")
        for name in ("main.min.js.LICENSE.txt", "main.min.js")
    ]
    return "\n".join(parts).replace("</script", "<\\/script")


def with_shared_frames(nominal: Chain, calibrated: Chain) -> Chain:
    """Give a nominal robot without base or tool those of the calibrated robot."""
    identity = np.eye(4)
    return replace(
        nominal,
        base=calibrated.base if np.array_equal(nominal.base, identity) else nominal.base,
        tool=calibrated.tool if np.array_equal(nominal.tool, identity) else nominal.tool,
    )


def kinematic_tree(nominal: Chain, calibrated: Chain) -> dict[str, Any]:
    """Describe the bodies and joints of both robots for the page.

    Body 0 is the base link, body i the link after joint i of the Pinocchio model, and the last two are tip
    and tool. A body has these keys:

    - `name`: name of the link, or "tool" for the measured point.
    - `parent`: number of its parent; -1 for the base link.
    - `placement`: nominal pose in the parent (upper three rows).
    - `twist`: twist from the nominal to the calibrated placement.
    - `axes`, if a joint moves it: joint axis of the nominal and of the calibrated robot; further the keys of
      `_joint_input`.
    """
    if (calibrated.joint_names, calibrated.moving_joints) != (nominal.joint_names, nominal.moving_joints):
        first, second = (", ".join(chain.moving_joints) for chain in (nominal, calibrated))
        raise InvalidArgumentError(
            f"the robots differ: one moves {first}, the other {second}; give both the same tip"
        )
    drawn = with_shared_frames(nominal, calibrated)
    model, n_moving = nominal.model, len(nominal.moving_joints)
    joint_ids = [model.getJointId(name) for name in nominal.moving_joints]
    names = _link_names(model)
    bodies = [_body(names[0], -1, se3.inverse(calibrated.base) @ drawn.base, np.eye(4))]
    bodies += [
        _body(name, parent, placement.homogeneous, placement.homogeneous)
        for name, parent, placement in zip(
            names[1:], list(model.parents)[1:], list(model.jointPlacements)[1:], strict=True
        )
    ]
    for j, i in enumerate(joint_ids):
        bodies[i] = _body(names[i], int(model.parents[i]), nominal.origins[j], calibrated.origins[j]) | {
            "axes": [nominal.axes[j].tolist(), calibrated.axes[j].tolist()],
            **_joint_input(nominal, j),
        }
    tip = nominal.origins[n_moving], calibrated.origins[n_moving]
    bodies.append(_body(nominal.tip, joint_ids[-1], *tip))
    bodies.append(_body("tool", len(bodies) - 1, drawn.tool, calibrated.tool))
    return {
        "bodies": bodies,
        "base_in_measuring_frame": rows(calibrated.base),
        "gravity_bodies": [_gravity_bodies(nominal), _gravity_bodies(calibrated)],
    }


def _link_names(model: pin.Model) -> list[str]:
    """Return the name of the link whose frame each joint moves: the first one; the joint's without a link."""
    names = list(model.names)
    for frame in reversed(list(model.frames)):
        if frame.type == pin.FrameType.BODY and frame.placement.isIdentity():
            names[frame.parentJoint] = frame.name
    return names


def _body(name: str, parent: int, placement: Array, calibrated: Array) -> dict[str, Any]:
    is_same = np.array_equal(placement, calibrated)
    twist = np.zeros(6) if is_same else se3.log6(se3.inverse(placement) @ calibrated)
    return {"name": name, "parent": int(parent), "placement": rows(placement), "twist": twist.tolist()}


def _joint_input(chain: Chain, j: int) -> dict[str, Any]:
    """Return the type of moving joint j and how its position follows from the independent joints."""
    return {
        "is_prismatic": bool(chain.prismatic[j]),
        "mimic_multipliers": chain.mimic_matrix[j].tolist(),
        "mimic_offset": float(chain.mimic_offset[j]),
    }


def _joint_errors(chain: Chain) -> str:
    """Return a JavaScript function of the differences between actual and commanded joint positions."""
    errors = [["0"] for _ in chain.joint_names]
    indices = coefficient_indices(*chain.mimic_matrix.shape)
    values = np.zeros(0) if chain.transmission is None else chain.transmission.coefficients
    for family in chain.error_families:
        for coefficient in [] if family.link_term else family.coefficients(chain, indices):
            value = values[coefficient.entry].item()
            if value:
                errors[coefficient.owner].append(f"{value!r} * {coefficient.formula}")
    conditions = "{ q, torque, approach, temperature, reference_temperature }"
    return f"({conditions}) => [{', '.join(map(' + '.join, errors))}]"


def _gravity_bodies(chain: Chain) -> list[dict[str, Any]]:
    """Return the bodies whose weight loads compliant joints: weight [N], centre of mass and joint of each."""
    if chain.transmission is None or not chain.transmission.has_compliance:
        return []
    model = chain.transmission.loads.model
    moving = {model.getJointId(name): j for j, name in enumerate(chain.moving_joints)}
    bodies = []
    for i, inertia in enumerate(model.inertias):
        body = {
            "parent": int(model.parents[i]),
            "placement": rows(model.jointPlacements[i].homogeneous),
            "weight": -float(inertia.mass * model.gravity.linear[2]),
            "centre_of_mass": inertia.lever.tolist(),
        }
        if i in moving:
            body |= {"axis": chain.axes[moving[i]].tolist(), **_joint_input(chain, moving[i])}
        bodies.append(body)
    return bodies


def _sliders(chain: Chain, configurations: Array) -> list[dict[str, Any]]:
    """Return range and initial value of each joint's slider; the range contains all configurations (m, n)."""
    is_prismatic = [
        bool(chain.prismatic[np.flatnonzero(chain.mimic_matrix[:, i])[0]]) for i in range(chain.n_joints)
    ]
    half_range = np.where(is_prismatic, DEFAULT_STROKE_M, np.pi)
    lower = np.where(
        np.isfinite(chain.lower), chain.lower, np.minimum(chain.upper, half_range) - 2 * half_range
    )
    lower = np.where(np.isfinite(lower), lower, -half_range)
    upper = np.where(np.isfinite(chain.upper), chain.upper, np.maximum(lower, -half_range) + 2 * half_range)
    start = np.where((lower <= 0) & (upper >= 0), 0.0, 0.5 * (lower + upper))
    if len(configurations):
        lower, upper = np.minimum(lower, configurations.min(0)), np.maximum(upper, configurations.max(0))
        start = configurations[0]
    columns = (chain.joint_names, is_prismatic, lower.tolist(), upper.tolist(), start.tolist())
    keys = ("name", "is_prismatic", "lower", "upper", "start")
    return [dict(zip(keys, values, strict=True)) for values in zip(*columns, strict=True)]


def _ellipsoids(model: Predictor, configurations: Array) -> list[dict[str, Any]]:
    """Return ellipsoids of one standard deviation of the tool position where it is determined."""
    configurations = configurations[evenly_spaced_indices(len(configurations), MAX_ELLIPSOIDS)]
    covariance = model.relative.predict(configurations).covariance[:, :3, :3]
    is_finite = np.isfinite(covariance).all((1, 2))
    variances, axes = np.linalg.eigh(covariance[is_finite])
    # A flat ellipsoid has no surface normals and would be black.
    lengths = np.sqrt(np.maximum(variances, 1e-6 * variances[:, -1:] + 1e-18))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    axes = model.chain.base[:3, :3].T @ axes * lengths[:, None]
    return [
        {"q": q, "axes": np.round(matrix, 12).ravel().tolist()}
        for q, matrix in zip(configurations[is_finite].tolist(), axes, strict=True)
    ]
