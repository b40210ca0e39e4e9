"""The robot before and after calibration in one offline web page: MeshCat with sliders and switches.

The page holds everything it needs: MeshCat's own script, the meshes, the kinematics. It opens from
disk, inside a notebook and inside a report; it starts no server and asks no host for anything. Python
sends it a tree of *bodies*, each with its place in its parent as built on paper, the twist that leads
from there to the calibrated place, and the joint that moves it; `viewer.html` draws that. Errors are
magnified by stretching these twists, so that at 1 × the page shows the calibrated arm itself.

Everything is drawn in the frame of the calibrated arm's base link; the tips that the page states are
in the measuring frame. A nominal arm without base or tool of its own borrows the calibrated one's to
be drawn: these say where the instrument stands and what it looks at, not how the robot was made.
"""

from __future__ import annotations

import base64
import html
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from . import se3
from .chain import Chain
from .dh_urdf import MATERIALS
from .errors import DhcalError
from .measurements import Measurement
from .result import Result
from .se3 import Array

PathLike = str | os.PathLike[str]

MOST_POINTS = 2000  # more are thinned out evenly: the page keeps moving smoothly
GRID = 8000  # mesh corners sit on a grid of this many steps along the longest side, 0.1 mm on most links
SLIDE = 0.5  # m each way for a sliding joint without limits
TRIAD = [MATERIALS[f"{axis}_axis"] for axis in "xyz"]
PAGE = Path(__file__).with_name("viewer.html")


def scene_html(
    nominal: Chain,
    calibrated: Chain | None = None,
    *,
    q: Array | None = None,
    measurements: Sequence[Measurement] = (),
    known: Mapping[str, float] | None = None,
    title: str = "Robot calibration",
    package_dirs: Sequence[PathLike] | None = None,
    magnification: float = 1.0,
) -> str:
    """One offline HTML page of an arm, or of an arm before and after its calibration.

    Args:
        nominal: the arm as it was thought to be; a ghost beside the calibrated one, solid if alone.
        calibrated: the same arm with other origins, base and tool.
        q: (m, n) poses to play, rad or m; those of the measurements without it.
        measurements: those that are positions are drawn, with arrows from where the arm puts them.
        known: values of the instruments' unknowns, as in `Result.instruments`; without it where their
            search starts.
        title: the page's heading.
        package_dirs: where to look for the URDF's meshes; the folders above the URDF without it.
        magnification: how many times larger than true the errors are drawn at first, 1 to 500.

    Returns:
        The page; the same bytes for the same input.

    Raises:
        DhcalError: the two arms have different joints, or q does not fit them.
    """
    if not 1 <= magnification <= 500:
        raise DhcalError(f"magnification {magnification:g}: must be between 1 and 500")
    arm = nominal if calibrated is None else calibrated
    bodies = _bodies(nominal, arm)
    shapes, meshes, note = _shapes(nominal, package_dirs)
    played = [q] if q is not None else [item.q for item in measurements]
    poses = np.concatenate([np.empty((0, nominal.size)), *map(nominal.checked, played)])
    samples, points, residuals = _points(arm, measurements, known or {})
    thinned = _thin(len(samples))
    if len(thinned) < len(samples):
        note = f"{note} {len(thinned)} of {len(samples)} measured points are drawn.".strip()
    scene = {
        "title": title,
        "note": note,
        "compared": calibrated is not None,
        "magnification": magnification,
        "joints": _joints(nominal, np.concatenate([poses, samples])),
        "poses": poses[_thin(len(poses))].tolist(),
        "samples": samples[thinned].tolist(),
        "points": np.round((points[thinned] - arm.base[:3, 3]) @ arm.base[:3, :3], 9).tolist(),
        "residuals": np.round(residuals[thinned] @ arm.base[:3, :3], 9).tolist(),
        "shapes": shapes,
        "meshes": meshes,
        **bodies,
    }
    data = json.dumps(scene, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")
    parts = {"@TITLE@": html.escape(title), "/*@MESHCAT@*/": _meshcat(), "@SCENE@": data}
    return re.sub("|".join(map(re.escape, parts)), lambda mark: parts[mark[0]], PAGE.read_text("utf-8"))


@dataclass(frozen=True)
class Scene:
    """A page that notebooks show inline.

    Attributes:
        html: the page.
        height: of the frame in the notebook, pixels.
    """

    html: str
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
        calibrated: the arm, or the result that found it: then the nominal arm stands where it was
            fitted to the same data, and those data are shown.
        height: of the frame in the notebook, pixels.
        options: as for `scene_html`.
    """
    if isinstance(calibrated, Result):
        fit, calibrated = calibrated, calibrated.chain
        nominal = replace(nominal, base=fit.reference.base, tool=fit.reference.tool)
        options = {"measurements": fit.data, "known": fit.instruments, **options}
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


def _rows(pose: Array) -> list[float]:
    """The upper three rows of a pose (4, 4), in full."""
    return (np.asarray(pose, float)[:3] + 0.0).ravel().tolist()


def _bodies(nominal: Chain, arm: Chain) -> dict[str, Any]:
    """The tree of bodies and the two arms' frames.

    Body 0 is the base link, body i the model's joint i, and the last two are tip and tool; each has
    `parent`, `placement` in it, `twist` (6) to the calibrated placement, and where it moves `axes` of
    both arms, `slides`, `mixing` (n,) and `shift`. The measuring frame sees a drawn tool D of an arm at
    `stands`·D·`holds`, which are its entries in `arms`.
    """
    if (arm.joint_names, arm.moving) != (nominal.joint_names, nominal.moving):
        raise DhcalError(
            f"the arms differ: one moves {', '.join(nominal.moving)}, the other {', '.join(arm.moving)}; "
            "give both the same tip"
        )
    same = np.eye(4)
    base = arm.base if np.array_equal(nominal.base, same) else nominal.base
    tool = arm.tool if np.array_equal(nominal.tool, same) else nominal.tool
    model, k = nominal.model, len(nominal.moving)
    index = [model.getJointId(name) for name in nominal.moving]
    bodies = [_body(-1, se3.inverse(arm.base) @ base, np.eye(4))]
    bodies += [
        _body(parent, placement.homogeneous, placement.homogeneous)
        for parent, placement in zip(list(model.parents)[1:], list(model.jointPlacements)[1:], strict=True)
    ]
    for j, i in enumerate(index):
        bodies[i] = _body(int(model.parents[i]), nominal.origins[j], arm.origins[j]) | {
            "axes": [nominal.axes[j].tolist(), arm.axes[j].tolist()],
            "slides": bool(nominal.prismatic[j]),
            "mixing": nominal.mixing[j].tolist(),
            "shift": float(nominal.shift[j]),
        }
    bodies.append(_body(index[-1], nominal.origins[k], arm.origins[k]))
    bodies.append(_body(len(bodies) - 1, tool, arm.tool))
    stands = nominal.base @ se3.inverse(base) @ arm.base
    holds = se3.inverse(tool) @ nominal.tool
    arms = [
        {"stands": _rows(stands), "holds": _rows(holds)},
        {"stands": _rows(arm.base), "holds": _rows(same)},
    ]
    return {"bodies": bodies, "arms": arms}


def _body(parent: int, placement: Array, calibrated: Array) -> dict[str, Any]:
    same = np.array_equal(placement, calibrated)
    twist = np.zeros(6) if same else se3.log6(se3.inverse(placement) @ calibrated)
    return {"parent": int(parent), "placement": _rows(placement), "twist": twist.tolist()}


def _joints(chain: Chain, poses: Array) -> list[dict[str, Any]]:
    """Sliders: range, wide enough for all poses (m, n), and where they start, rad or m."""
    slides = [bool(chain.prismatic[np.flatnonzero(chain.mixing[:, i])[0]]) for i in range(chain.size)]
    wide = np.where(slides, SLIDE, np.pi)
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
    q, points, residuals = [np.empty((0, chain.size))], [np.empty((0, 3))], [np.empty((0, 3))]
    for item in measurements:
        if len(item.positions()):
            unknowns = item.started(chain).unknowns
            u = np.array([known.get(unknown.name, unknown.nominal) for unknown in unknowns])
            q.append(chain.checked(item.q))
            points.append(item.positions())
            residuals.append(item.errors(chain.sweep(item.q), u)["position"])
    return np.concatenate(q), np.concatenate(points), np.concatenate(residuals)


def _thin(count: int) -> Array:
    """At most MOST_POINTS indices, evenly spread over `count`."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).round().astype(int))


def _shapes(
    chain: Chain, package_dirs: Sequence[PathLike] | None
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], str]:
    """What each body looks like, the meshes it refers to by number, and a note on what is missing."""
    if package_dirs is None:
        package_dirs = list(Path(chain.urdf.source).absolute().parents)
    text = chain.urdf.data.decode("utf-8-sig")
    model = pin.buildModelFromXML(text)
    try:
        found = pin.buildGeomFromUrdfString(
            model, text, pin.GeometryType.VISUAL, package_dirs=[os.fspath(path) for path in package_dirs]
        ).geometryObjects
    except (ValueError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0]
        return _skeleton(chain), [], f"Drawn as a skeleton, because a mesh is missing: {reason}"
    if not len(found):
        return _skeleton(chain), [], "Drawn as a skeleton: the URDF has no visual geometry."
    numbers: dict[str, int] = {}
    shapes = []
    for item in found:
        if any(np.allclose(item.meshColor, axis, atol=1e-6) for axis in TRIAD):
            continue  # the URDF of a DH table draws its own tool frame; the page's is a layer
        shape = _shape(item.geometry)
        if "mesh" in shape:
            # Equal parts, such as the same motor five times, are sent once.
            shape["mesh"] = numbers.setdefault(json.dumps(shape["mesh"]), len(numbers))
        body, placement = _home(model, chain.frame_id, item)
        shapes.append({"body": body, "placement": np.round(_rows(placement), 9).tolist(), **shape})
    return shapes, [json.loads(mesh) for mesh in numbers], ""


def _home(model: pin.Model, tip: int, item: pin.GeometryObject) -> tuple[int, Array]:
    """The body a shape belongs to and its pose (4, 4) there: what is fixed to the tip moves with it."""
    frame = item.parentFrame
    while frame != tip and model.frames[frame].type != pin.FrameType.JOINT and frame > 0:
        frame = model.frames[frame].parentFrame
    if frame != tip:
        return int(item.parentJoint), item.placement.homogeneous
    return model.njoints, (model.frames[tip].placement.inverse() * item.placement).homogeneous


def _shape(geometry: Any) -> dict[str, Any]:
    """A primitive with its sizes in metres, or a mesh."""
    kind = type(geometry).__name__
    if kind == "Box":
        return {"box": (2 * geometry.halfSide).tolist()}
    if kind == "Sphere":
        return {"sphere": geometry.radius}
    if kind in ("Cylinder", "Capsule"):
        return {"cylinder": [geometry.radius, 2 * geometry.halfLength]}
    return {"mesh": _mesh(geometry)}


def _mesh(geometry: Any) -> dict[str, Any]:
    """A triangle mesh on a grid: corners that fall together are one, triangles that vanish are left out.

    `corners` (v, 3) and `triangles` (t, 3) are base64 of little-endian integers, the latter of `bytes`
    bytes each; a corner is at `origin` + `step` · its integers, m.
    """
    corners = np.asarray(geometry.vertices(), float)
    triangles = np.array([(t[0], t[1], t[2]) for t in map(geometry.tri_indices, range(geometry.num_tris))])
    origin, size = corners.min(0), np.ptp(corners, axis=0).max()
    step = size / GRID or 1.0
    grid, place = np.unique(np.round((corners - origin) / step).astype("<u2"), axis=0, return_inverse=True)
    triangles = place.ravel()[triangles]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    width = 2 if len(grid) <= 1 << 16 else 4
    return {
        "origin": np.round(origin, 9).tolist(),
        "step": float(step),
        "bytes": width,
        "corners": base64.b64encode(grid.tobytes()).decode(),
        "triangles": base64.b64encode(triangles.astype(f"<u{width}").tobytes()).decode(),
    }


def _skeleton(chain: Chain) -> list[dict[str, Any]]:
    """Rods from joint to joint and a drum on each moving joint, where there is nothing else to draw."""
    tree = _bodies(chain, chain)["bodies"]
    ends = [np.reshape(body["placement"], (3, 4))[:, 3] for body in tree]
    radius = 0.02 * (sum(float(np.linalg.norm(end)) for end in ends[1:]) or 1.0)
    shapes = [_rod(0, np.zeros(3), np.array([0.0, 0.0, -0.6 * radius]), 4 * radius)]
    for i, (body, end) in enumerate(zip(tree, ends, strict=True)):
        if i and np.linalg.norm(end) > 1e-6:
            shapes.append(_rod(body["parent"], np.zeros(3), end, radius))
        if "axes" in body:
            half = 1.8 * radius * np.array(body["axes"][0])
            shapes.append(_rod(i, -half, half, 1.6 * radius))
    return shapes


def _rod(body: int, start: Array, end: Array, radius: float) -> dict[str, Any]:
    """A cylinder between two points (3,) of a body, m."""
    z = (end - start) / np.linalg.norm(end - start)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    pose = se3.transform(np.stack([x, np.cross(z, x), z], -1), 0.5 * (start + end))
    size = [radius, float(np.linalg.norm(end - start))]
    return {"body": body, "placement": np.round(_rows(pose), 9).tolist(), "cylinder": size}
