"""Visual geometry of a robot: the meshes and primitives of its URDF, or a skeleton of cylinders.

A shape is a dictionary for the page. It has the number of the `body` that it moves with, its `placement` on
that body (upper three rows of the pose, 12 numbers [m]), and one of `box`, `sphere`, `cylinder` with sizes
[m], or `mesh` with the number of a mesh. Meshes are rounded to a grid, equal meshes are stored once, and
large meshes are simplified by edge collapse (fast-simplification).
"""

from __future__ import annotations

import base64
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import fast_simplification
import numpy as np
import pinocchio as pin

from .. import se3
from .._typing import Array, PathLike
from ..robot.chain import Chain
from ..robot.dh_urdf import MATERIALS

# Steps of the grid along the longest side of a mesh: about 0.1 mm on most links.
GRID = 8000
# Grids for meshes that are simplified, tried in this order.
COARSER_GRIDS = (400, 200, 100, 50, 25, 12, 6)
# Number of missing meshes that the note names.
MAX_NAMED = 3
# Colours of the axes that the URDF of a DH table draws.
TRIAD = [MATERIALS[f"{axis}_axis"] for axis in "xyz"]


@dataclass(frozen=True, eq=False)
class Visuals:
    """Shapes and meshes of a robot.

    Attributes:
        shapes: Shapes of all bodies.
        meshes: Meshes that the shapes refer to by number.
        note: Sentence about parts that are not drawn as the URDF describes them; empty if there are none.
    """

    shapes: list[dict[str, Any]]
    meshes: list[Mesh]
    note: str


def visuals_of(
    chain: Chain, bodies: Sequence[dict[str, Any]], package_dirs: Sequence[PathLike] | None, triangles: int
) -> Visuals:
    """Collect the shapes of all bodies of a robot.

    Args:
        chain: Robot.
        bodies: Bodies of the kinematic tree, for the skeleton: each with `parent`, `placement` (12 numbers)
            and, if it moves, `axes`.
        package_dirs: Folders to search for meshes. Default: the folders above the URDF.
        triangles: Largest number of triangles of all meshes together.

    Returns:
        Shapes, meshes and a note.
    """
    if package_dirs is None:
        package_dirs = list(Path(chain.urdf.source).absolute().parents)
    # Pinocchio splits numbers at spaces only; XML allows any white space.
    text = chain.urdf.data.decode("utf-8-sig").translate(dict.fromkeys(b"\t\r\n", " "))
    model = pin.buildModelFromXML(text)
    found, lost = _visuals(model, text, [os.fspath(path) for path in package_dirs])
    if not len(found) and not lost:
        every = set(range(len(bodies)))
        return Visuals(_skeleton(bodies, every), [], "Drawn as a skeleton: the URDF has no visual geometry.")
    numbers: dict[tuple[bytes, ...], int] = {}
    meshes: list[Mesh] = []
    shapes = []
    for item in found:
        if any(np.allclose(item.meshColor, axis, atol=1e-6) for axis in TRIAD):
            continue  # the URDF of a DH table draws its own tool frame; the page's is a layer
        shape = _primitive(item.geometry)
        if shape is None:
            mesh = Mesh.from_geometry(item.geometry)
            # Equal parts, such as the same motor five times, are sent once.
            number = numbers.setdefault(mesh.key, len(meshes))
            if number == len(meshes):
                meshes.append(mesh)
            shape = {"mesh": number}
        body, placement = _parent_body(model, chain, item.parentFrame, item.placement)
        shapes.append({"body": body, "placement": rows(np.round(placement, 9)), **shape})
    bare = {
        _parent_body(model, chain, model.getFrameId(link, pin.FrameType.BODY), pin.SE3.Identity())[0]
        for link in lost
    }
    kept = allocate_triangles([len(mesh.triangles) for mesh in meshes], triangles)
    drawn = [mesh.simplify(most) for mesh, most in zip(meshes, kept, strict=True)]
    return Visuals(shapes + _skeleton(bodies, bare), drawn, _missing_meshes_note(lost))


def rows(pose: Array) -> list[float]:
    """Return the upper three rows of a pose, shape (4, 4), as a list of 12 numbers."""
    return (np.asarray(pose, float)[:3] + 0.0).ravel().tolist()


# --- the URDF's visual geometry --------------------------------------------------------------------
def _visuals(
    model: pin.Model, text: str, folders: Sequence[str]
) -> tuple[Sequence[pin.GeometryObject], dict[str, list[str]]]:
    """Return the visual geometry that Pinocchio can load, and the missing or unreadable meshes by link."""
    if (found := _loaded(model, text, folders)) is not None:
        return found, {}
    # Pinocchio rejects the whole URDF if one mesh is missing: load each mesh in a robot with one link.
    robot = ElementTree.fromstring(text)
    lost: dict[str, list[str]] = {}
    for link in robot.findall("link"):
        for visual in link.findall("visual"):
            mesh = visual.find("geometry/mesh")
            alone = ElementTree.Element("robot", name="one")
            ElementTree.SubElement(alone, "link", name="one").append(visual)
            one = ElementTree.tostring(alone, "unicode")
            if mesh is not None and _loaded(pin.buildModelFromXML(one), one, folders) is None:
                link.remove(visual)
                lost.setdefault(link.get("name", ""), []).append(mesh.get("filename", ""))
    return _loaded(model, ElementTree.tostring(robot, "unicode"), folders) or [], lost


def _loaded(model: pin.Model, text: str, folders: Sequence[str]) -> Sequence[pin.GeometryObject] | None:
    """Load the visual geometry of a URDF; return None if one of its meshes cannot be loaded."""
    try:
        found = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.VISUAL, package_dirs=[*folders])
    except (ValueError, RuntimeError):
        return None
    return found.geometryObjects


def _missing_meshes_note(lost: dict[str, list[str]]) -> str:
    if not lost:
        return ""
    names = [f"{os.path.basename(name)} ({link})" for link, files in lost.items() for name in files]
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return f"Drawn as rods, because meshes are missing or unreadable: {', '.join(names[:MAX_NAMED])}{more}."


def _parent_body(model: pin.Model, chain: Chain, frame: int, placement: pin.SE3) -> tuple[int, Array]:
    """Return the body that carries a geometry, and the pose of the geometry on this body.

    A geometry that is fixed to the tip moves with the tip.

    Args:
        model: Pinocchio model of the whole URDF.
        chain: Robot.
        frame: Index of the frame of the link that has the geometry.
        placement: Pose of the geometry relative to its moving joint.

    Returns:
        Index of the body, and the pose, shape (4, 4).
    """
    tip, joint = chain.frame_id, int(model.frames[frame].parentJoint)
    while frame != tip and model.frames[frame].type != pin.FrameType.JOINT and frame > 0:
        frame = model.frames[frame].parentFrame
    if frame != tip:
        return joint, placement.homogeneous
    return model.njoints, (model.frames[tip].placement.inverse() * placement).homogeneous


def _primitive(geometry: Any) -> dict[str, Any] | None:
    """Return a box, sphere or cylinder with its sizes [m], or None for a mesh."""
    kind = type(geometry).__name__
    if kind == "Box":
        return {"box": (2 * geometry.halfSide).tolist()}
    if kind == "Sphere":
        return {"sphere": geometry.radius}
    if kind in ("Cylinder", "Capsule"):
        return {"cylinder": [geometry.radius, 2 * geometry.halfLength]}
    return None


# --- meshes ----------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh on a grid.

    Attributes:
        origin: Origin of the grid, shape (3,) [m].
        step: Step of the grid [m].
        corners: Grid coordinates of the corners, integers, shape (v, 3).
        triangles: Numbers of the corners of each triangle, shape (t, 3).
    """

    origin: Array
    step: float
    corners: Array
    triangles: Array

    @classmethod
    def from_geometry(cls, geometry: Any) -> Mesh:
        """Convert a mesh that coal has read from a file."""
        faces = [(t[0], t[1], t[2]) for t in map(geometry.tri_indices, range(geometry.num_tris))]
        return cls.on_grid(np.asarray(geometry.vertices(), float), np.array(faces, int).reshape(-1, 3))

    @classmethod
    def on_grid(cls, corners: Array, triangles: Array, grid: int = GRID) -> Mesh:
        """Round a mesh to a grid; merge equal corners, and remove degenerate and duplicate triangles.

        Args:
            corners: Corners, shape (v, 3) [m].
            triangles: Numbers of the corners of each triangle, shape (t, 3).
            grid: Number of steps along the longest side.

        Returns:
            Mesh on the grid.
        """
        origin, size = corners.min(0), np.ptp(corners, axis=0).max()
        step = size / grid or 1.0
        x, y, z = np.round((corners - origin) / step).astype(np.int64).T
        # np.unique is faster on one integer per corner than on three.
        kept, place = np.unique((x << 32) + (y << 16) + z, return_inverse=True)
        cells = np.stack([kept >> 32, kept >> 16 & 0xFFFF, kept & 0xFFFF], -1).astype("<u2")
        triangles = place[triangles]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
        low, middle, high = np.sort(triangles, axis=1).T
        once = np.unique((low * len(kept) + middle) * len(kept) + high, return_index=True)[1]
        return cls(np.round(origin, 9), float(step), cells, triangles[np.sort(once)])

    @property
    def vertices(self) -> Array:
        """Corners, shape (v, 3) [m]."""
        return self.origin + self.step * self.corners

    @property
    def key(self) -> tuple[bytes, ...]:
        """Key that is equal for equal meshes."""
        return self.origin.tobytes(), self.corners.tobytes(), self.triangles.tobytes()

    def simplify(self, most: int) -> Mesh:
        """Return a mesh with at most `most` triangles, simplified by edge collapse."""
        mesh = self
        for grid in COARSER_GRIDS:
            if len(mesh.triangles) <= most:
                break
            # Very thin triangles prevent edge collapse. A coarser grid removes them.
            mesh = Mesh.on_grid(mesh.vertices, mesh.triangles, grid)
            if len(mesh.triangles) > most:
                corners, triangles = fast_simplification.simplify(
                    mesh.vertices / mesh.step, mesh.triangles, target_count=most
                )[:2]
                mesh = Mesh.on_grid(mesh.step * corners, np.asarray(triangles, int))
        return mesh

    def encoded(self) -> dict[str, Any]:
        """Encode for the page: base64 of little-endian integers; indices of triangles have `bytes` bytes."""
        width = 2 if len(self.corners) <= 1 << 16 else 4
        return {
            "origin": self.origin.tolist(),
            "step": self.step,
            "bytes": width,
            "corners": base64.b64encode(self.corners.tobytes()).decode(),
            "triangles": base64.b64encode(self.triangles.astype(f"<u{width}").tobytes()).decode(),
        }


def allocate_triangles(counts: Sequence[int], total: int) -> list[int]:
    """Distribute a number of triangles over meshes in proportion to the square root of their sizes.

    No mesh gets more triangles than it has.

    Args:
        counts: Number of triangles of each mesh.
        total: Largest sum of the result.

    Returns:
        Number of triangles that each mesh keeps.
    """
    left, roots = float(total), np.sqrt(counts)
    rate = np.inf
    for i in np.argsort(roots):
        rate = left / roots[roots >= roots[i]].sum()
        if roots[i] > rate:
            break
        left -= counts[i]
    return np.minimum(counts, rate * roots).astype(int).tolist()


# --- rods and drums --------------------------------------------------------------------------------
def _skeleton(bodies: Sequence[dict[str, Any]], bare: set[int]) -> list[dict[str, Any]]:
    """Return cylinders for bodies without geometry: one on the joint, and rods to the next joints."""
    ends = [np.reshape(body["placement"], (3, 4))[:, 3] for body in bodies]
    radius = 0.02 * (sum(float(np.linalg.norm(end)) for end in ends[1:]) or 1.0)
    return [
        {"body": body, "placement": rows(np.round(pose, 9)), "cylinder": size}
        for body, pose, size in _rods(bodies, ends, radius)
        if body in bare
    ]


def _rods(
    bodies: Sequence[dict[str, Any]], ends: Sequence[Array], radius: float
) -> Iterator[tuple[int, Array, list[float]]]:
    """Yield body, pose on it, shape (4, 4), and radius and length [m] of each cylinder."""
    yield 0, *_rod(np.zeros(3), np.array([0.0, 0.0, -0.6 * radius]), 4 * radius)
    for i, (body, end) in enumerate(zip(bodies, ends, strict=True)):
        if i and np.linalg.norm(end) > 1e-6:
            yield body["parent"], *_rod(np.zeros(3), end, radius)
        if "axes" in body:
            half = 1.8 * radius * np.array(body["axes"][0])
            yield i, *_rod(-half, half, 1.6 * radius)


def _rod(start: Array, end: Array, radius: float) -> tuple[Array, list[float]]:
    """Return pose, shape (4, 4), and radius and length [m] of a cylinder between two points, shape (3,)."""
    z = (end - start) / np.linalg.norm(end - start)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    pose = se3.transform(np.stack([x, np.cross(z, x), z], -1), 0.5 * (start + end))
    return pose, [radius, float(np.linalg.norm(end - start))]
