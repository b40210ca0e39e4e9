"""The robot before and after calibration in one offline web page: MeshCat with sliders and switches.

The page holds everything it needs: MeshCat's own script, the meshes, the kinematics. It opens from
disk, inside a notebook and inside a report; it starts no server and asks no host for anything. Python
sends it a tree of *bodies*, each with its place in its parent as built on paper, the twist that leads
from there to the calibrated place, and the joint that moves it; `viewer.html` draws that. Errors are
magnified by stretching these twists, so that at 1 × the page shows the calibrated arm itself.

Everything is drawn in the frame of the calibrated arm's base link; the tips that the page states are
in the measuring frame. A nominal arm without base or tool of its own borrows the calibrated one's:
these say where the instrument stands and what it looks at, not how the robot was made.
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from .. import se3
from .._typing import Array, PathLike
from ..calibration.result import Result
from ..estimation.uncertainty import Predictor
from ..exceptions import DhcalError
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..robot.transmission import TERMS, GravityLoads
from .meshes import rows, visuals_of
from .subsampling import evenly_spaced_indices

MAX_POINTS = 2000  # more are thinned out evenly: the page keeps moving smoothly


MAX_ELLIPSOIDS = 400  # more would hide each other


MAX_TRIANGLES = 60_000  # that the meshes keep: with more the page would hardly turn, and be large


MIN_TRIANGLES = 100


DEFAULT_STROKE_M = 0.5  # m each way for a sliding joint without limits


PAGE = Path(__file__).with_name("viewer.html")


def scene_html(
    nominal: Chain,
    calibrated: Chain | Result | None = None,
    *,
    q: Array | None = None,
    measurements: Sequence[Measurement] | None = None,
    known: Mapping[str, float] | None = None,
    predictor: Predictor | None = None,
    title: str = "Robot calibration",
    package_dirs: Sequence[PathLike] | None = None,
    magnification: float = 1.0,
    triangles: int = MAX_TRIANGLES,
) -> str:
    """One offline HTML page of an arm, or of an arm before and after its calibration.

    Args:
        nominal: the arm as it was thought to be; a ghost beside the calibrated one, solid if alone.
        calibrated: the same arm with other origins, base and tool; or the result that found it: then the
            nominal arm stands where it was fitted to the same data, those data are shown, and ellipsoids
            of one standard deviation say how well the calibrated tool's place is known.
        q: (m, n) poses to play, rad or m; those of the measurements without it.
        measurements: those that are positions are drawn, with arrows from where the arm puts them.
        known: values of the instruments' unknowns, as in `Result.instruments`; without it where their
            search starts.
        predictor: how well the calibrated tool's place is known; the result itself without it.
        title: the page's heading.
        package_dirs: where to look for the URDF's meshes; the folders above the URDF without it.
        magnification: how many times larger than true the errors are drawn at first, 1 to 500.
        triangles: most of them that the meshes keep all together; 15,000 still show what each link is.

    Returns:
        The page; the same bytes for the same input.

    Raises:
        DhcalError: the two arms have different joints, or q does not fit them.
    """
    if not 1 <= magnification <= 500:
        raise DhcalError(f"magnification {magnification:g}: must be between 1 and 500")
    if triangles < MIN_TRIANGLES:
        raise DhcalError(f"{triangles} triangles draw no robot: allow {MIN_TRIANGLES} at least")
    if isinstance(calibrated, Result):
        predictor = predictor or calibrated
        measurements = calibrated.data if measurements is None else measurements
        known = calibrated.instruments if known is None else known
        nominal = replace(
            nominal, base=calibrated.nominal_refitted.base, tool=calibrated.nominal_refitted.tool
        )
        calibrated = calibrated.chain
    measurements = measurements or ()
    arm = nominal if calibrated is None else calibrated
    arms = kinematic_tree(nominal, arm)
    drawn = visuals_of(nominal, arms["bodies"], package_dirs, triangles)
    played = (
        [q]
        if q is not None
        else [item.configurations() for item in measurements if item.configurations_per_row]
    )
    poses = np.concatenate([np.empty((0, nominal.n_joints)), *map(nominal.validated_q, played)])
    samples, points, residuals = _points(arm, measurements, known or {})
    thinned = evenly_spaced_indices(len(samples), MAX_POINTS)
    notes = [drawn.note]
    if len(thinned) < len(samples):
        notes.append(f"{len(thinned)} of {len(samples)} measured points are drawn.")
    ellipsoids = _ellipsoids(predictor, poses) if predictor else []
    if predictor and len(poses) and not ellipsoids:
        notes.append("No ellipsoids: the data do not tell how well the tool's place is known.")
    scene = {
        "title": title,
        "note": " ".join(filter(None, notes)),
        "compared": calibrated is not None,
        "magnification": magnification,
        "joints": _joints(nominal, np.concatenate([poses, samples])),
        "poses": poses[evenly_spaced_indices(len(poses), MAX_POINTS)].tolist(),
        "samples": samples[thinned].tolist(),
        "points": np.round((points[thinned] - arm.base[:3, 3]) @ arm.base[:3, :3], 9).tolist(),
        "residuals": np.round(residuals[thinned] @ arm.base[:3, :3], 9).tolist(),
        "ellipsoids": ellipsoids,
        "shapes": drawn.shapes,
        "meshes": [mesh.encoded() for mesh in drawn.meshes],
        **arms,
    }
    data = json.dumps(scene, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")
    terms = ", ".join(f"{term.name}: (q, torque) => {term.javascript}" for term in TERMS)
    parts = {
        "@TITLE@": html.escape(title),
        "/*@MESHCAT@*/": _meshcat(),
        # Script text, not data of the scene: the page's security policy forbids evaluating strings.
        "/*@TERMS@*/": terms,
        "@SCENE@": data,
    }
    return re.sub("|".join(map(re.escape, parts)), lambda mark: parts[mark[0]], PAGE.read_text("utf-8"))


@dataclass(frozen=True)
class Scene:
    """A page that notebooks show inline.

    Attributes:
        html: the page.
        height: of the frame in the notebook, pixels.
    """

    html: str = field(repr=False)  # a notebook keeps the repr too
    height: int

    def _repr_html_(self) -> str:
        source = self.html.replace("&", "&amp;").replace('"', "&quot;")
        style = f"width:100%;height:{self.height}px;border:0;border-radius:8px"
        return f'<iframe srcdoc="{source}" style="{style}" title="Robot calibration"></iframe>'


def show(
    nominal: Chain, calibrated: Chain | Result | None = None, *, height: int = 620, **options: Any
) -> Scene:
    """The page inline in a notebook, also in a saved one.

    Args:
        nominal: the arm as it was thought to be.
        calibrated: the calibrated arm, or the result that found it.
        height: of the frame in the notebook, pixels.
        options: as for `scene_html`.
    """
    return Scene(scene_html(nominal, calibrated, **options), height)


def _meshcat() -> str:
    """MeshCat's script with its licences, without importing the package and its server."""
    package = metadata.distribution("meshcat")
    viewer = Path(str(package.locate_file("meshcat/viewer")))
    parts = ["/*!", (viewer / "LICENSE").read_text(encoding="utf-8"), "*/"]
    parts += [
        (viewer / "dist" / name).read_text(encoding="utf-8")
        for name in ("main.min.js.LICENSE.txt", "main.min.js")
    ]
    return "\n".join(parts).replace("</script", "<\\/script")


def with_shared_frames(nominal: Chain, arm: Chain) -> Chain:
    """The nominal arm as drawn and compared: with the other's base and tool where it has none of its own."""
    same = np.eye(4)
    return replace(
        nominal,
        base=arm.base if np.array_equal(nominal.base, same) else nominal.base,
        tool=arm.tool if np.array_equal(nominal.tool, same) else nominal.tool,
    )


def kinematic_tree(nominal: Chain, arm: Chain) -> dict[str, Any]:
    """The tree of bodies and the two arms' frames.

    Body 0 is the base link, body i the model's joint i, and the last two are tip and tool; each has
    `parent`, `placement` in it, `twist` (6) to the calibrated placement, and where it moves `axes` of
    both arms, `slides`, `mixing` (n,) and `shift`. The measuring frame sees a drawn tool D at `stands`·D.
    Of each of `arms`, `terms` say how its joints miss their values, and where they yield to weights
    `loads` are the bodies that these pull at.
    """
    if (arm.joint_names, arm.moving_joints) != (nominal.joint_names, nominal.moving_joints):
        raise DhcalError(
            f"the arms differ: one moves {', '.join(nominal.moving_joints)}, the other {', '.join(arm.moving_joints)}; "
            "give both the same tip"
        )
    drawn = with_shared_frames(nominal, arm)
    model, k = nominal.model, len(nominal.moving_joints)
    index = [model.getJointId(name) for name in nominal.moving_joints]
    bodies = [_body(-1, se3.inverse(arm.base) @ drawn.base, np.eye(4))]
    bodies += [
        _body(parent, placement.homogeneous, placement.homogeneous)
        for parent, placement in zip(list(model.parents)[1:], list(model.jointPlacements)[1:], strict=True)
    ]
    for j, i in enumerate(index):
        bodies[i] = _body(int(model.parents[i]), nominal.origins[j], arm.origins[j]) | {
            "axes": [nominal.axes[j].tolist(), arm.axes[j].tolist()],
            **_joint_input(nominal, j),
        }
    bodies.append(_body(index[-1], nominal.origins[k], arm.origins[k]))
    bodies.append(_body(len(bodies) - 1, drawn.tool, arm.tool))
    return {
        "bodies": bodies,
        "base_in_measuring_frame": rows(arm.base),
        "arms": [_transmission_terms(nominal), _transmission_terms(arm)],
    }


def _body(parent: int, placement: Array, calibrated: Array) -> dict[str, Any]:
    same = np.array_equal(placement, calibrated)
    twist = np.zeros(6) if same else se3.log6(se3.inverse(placement) @ calibrated)
    return {"parent": int(parent), "placement": rows(placement), "twist": twist.tolist()}


def _transmission_terms(chain: Chain) -> dict[str, Any]:
    """An arm's transmission, term by term: which joint by what of which joint, and its coefficient."""
    if chain.transmission is None:
        return {"terms": []}
    held = chain.transmission.coefficients
    terms = [
        {"name": TERMS[t].name, "joint": int(i), "of": int(j), "value": float(held[t, i, j])}
        for t, i, j in np.argwhere(held)
    ]
    return {"terms": terms} | (
        {"loads": _gravity_bodies(chain, chain.transmission.loads)}
        if chain.transmission.has_compliance
        else {}
    )


def _gravity_bodies(chain: Chain, loads: GravityLoads) -> list[dict[str, Any]]:
    """The tree of what loads a chain's joints: each body's weight, N, its centre, and what moves it."""
    model = loads.model
    moved = {model.getJointId(name): j for j, name in enumerate(chain.moving_joints)}
    out = []
    for i, inertia in enumerate(model.inertias):
        body = {
            "parent": int(model.parents[i]),
            "placement": rows(model.jointPlacements[i].homogeneous),
            "weight": -float(inertia.mass * model.gravity.linear[2]),
            "centre": inertia.lever.tolist(),
        }
        out.append(
            body
            | ({"axis": chain.axes[moved[i]].tolist()} | _joint_input(chain, moved[i]) if i in moved else {})
        )
    return out


def _joint_input(chain: Chain, j: int) -> dict[str, Any]:
    """What moves the moving joint j by how much."""
    return {
        "slides": bool(chain.prismatic[j]),
        "mixing": chain.mimic_matrix[j].tolist(),
        "shift": float(chain.mimic_offset[j]),
    }


def _joints(chain: Chain, poses: Array) -> list[dict[str, Any]]:
    """Sliders: range, wide enough for all poses (m, n), and where they start, rad or m."""
    slides = [
        bool(chain.prismatic[np.flatnonzero(chain.mimic_matrix[:, i])[0]]) for i in range(chain.n_joints)
    ]
    wide = np.where(slides, DEFAULT_STROKE_M, np.pi)
    lower = np.where(np.isfinite(chain.lower), chain.lower, np.minimum(chain.upper, wide) - 2 * wide)
    lower = np.where(np.isfinite(lower), lower, -wide)
    upper = np.where(np.isfinite(chain.upper), chain.upper, np.maximum(lower, -wide) + 2 * wide)
    start = np.where((lower <= 0) & (upper >= 0), 0.0, 0.5 * (lower + upper))
    if len(poses):
        lower, upper = np.minimum(lower, poses.min(0)), np.maximum(upper, poses.max(0))
        start = poses[0]
    return [
        {"name": name, "slides": slide, "lower": low, "upper": high, "start": value}
        for name, slide, low, high, value in zip(
            chain.joint_names, slides, lower.tolist(), upper.tolist(), start.tolist(), strict=True
        )
    ]


def _points(
    chain: Chain, measurements: Sequence[Measurement], known: Mapping[str, float]
) -> tuple[Array, Array, Array]:
    """Joint values (m, n), measured positions and residuals (m, 3) in the measuring frame, m."""
    q, points, residuals = [np.empty((0, chain.n_joints))], [np.empty((0, 3))], [np.empty((0, 3))]
    for item in measurements:
        if len(item.positions()):
            unknowns = item.initialized(chain).instrument_parameters
            u = np.array([known.get(unknown.name, unknown.nominal) for unknown in unknowns])
            q.append(chain.validated_q(item.q))
            points.append(item.positions())
            residuals.append(item.errors(chain.forward_kinematics(item.q), u)["position"])
    return np.concatenate(q), np.concatenate(points), np.concatenate(residuals)


def _ellipsoids(model: Predictor, poses: Array) -> list[dict[str, Any]]:
    """How well the calibrated tool's place is known at some of the poses (m, n).

    Each has its joint values `q` (n,) and `axes` (9), rows of the matrix whose columns are the half
    axes of one standard deviation, m, in axes of the calibrated base link. Poses at which a direction
    is not known at all have none.
    """
    poses = poses[evenly_spaced_indices(len(poses), MAX_ELLIPSOIDS)]
    covariance = model.predict(poses).covariance[:, :3, :3]
    told = np.isfinite(covariance).all((1, 2))
    squares, axes = np.linalg.eigh(covariance[told])
    # A flat ellipsoid would have no outside to be lit.
    half = np.sqrt(np.maximum(squares, 1e-6 * squares[:, -1:] + 1e-18))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    axes = model.chain.base[:3, :3].T @ axes * half[:, None]
    return [
        {"q": q, "axes": np.round(matrix, 12).ravel().tolist()}
        for q, matrix in zip(poses[told].tolist(), axes, strict=True)
    ]
