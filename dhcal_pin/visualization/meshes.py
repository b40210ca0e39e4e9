"""Visual geometry of robots for scenes: meshes and primitives of the URDF, or rods where these are missing.

A shape is a dictionary for the page. It has the number `body` of the body with which it moves, its
`placement` in this body (upper three rows of the pose, 12 numbers [m]) and one of these keys:

- `box`: edge lengths [m],
- `sphere`: radius [m],
- `cylinder`: radius and length [m]; the axis is z,
- `mesh`: number of the mesh.

Meshes are stored with vertices on a grid of integers, and large ones are simplified by edge collapse
(fast-simplification, after Garland & Heckbert 1997).
"""

from __future__ import annotations

import base64
import itertools
import os
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from operator import itemgetter
from typing import Any
from xml.etree import ElementTree

import coal
import fast_simplification
import numpy as np
import pinocchio as pin

from .. import se3
from .._frozen import frozen
from .._typing import Array, PathLike
from ..formatting import capitalized, list_first
from ..native_output import discard_native_messages
from ..robot.chain import Chain
from ..robot.collision import FLOOR, Obstacle
from ..robot.dh_urdf import MATERIALS
from ..ros_packages import MAX_MESH_BYTES, is_mesh_too_large, mesh_files, mesh_remedy

# Steps of the grid of vertices along the longest side of a mesh: 0.1 mm on most links.
GRID = 8000
# Coarser grids, which are tried one after the other for meshes that are simplified.
COARSER_GRIDS = (400, 200, 100, 50, 25, 12, 6)
# Coal builds a tree of bounding volumes for each mesh, which is not used here. This type takes the least
# time. Python has no class for its meshes, so that vertices and triangles are read by the base class `_Mesh`.
_MESH_LOADER = coal.MeshLoader(coal.BV_AABB)
_Mesh = coal.BVHModelBase
# Largest number of missing meshes that a note names.
MAX_NAMED = 3
# Colours of the tool frame in the URDF of a DH table.
AXIS_COLORS = [MATERIALS[f"{axis}_axis"] for axis in "xyz"]


@frozen(eq=False)
class Visuals:
    """Shapes of a robot."""

    shapes: list[dict[str, Any]]  # Shapes of all bodies
    meshes: list[Mesh]
    note: str  # Sentence about shapes that replace missing ones; empty if there are none


def visuals_of(
    chain: Chain, bodies: Sequence[dict[str, Any]], package_dirs: Sequence[PathLike] | None, triangles: int
) -> Visuals:
    """Read the visual geometry of a robot."""
    folders = (
        chain.urdf.mesh_folders() if package_dirs is None else [os.fspath(path) for path in package_dirs]
    )
    # Pinocchio separates numbers by spaces only, but XML allows any white space.
    text = chain.urdf.data.decode("utf-8-sig").translate(dict.fromkeys(b"\t\r\n", " "))
    names = {mesh.get("filename", "") for mesh in ElementTree.fromstring(text).iter("mesh")}
    files = [file for name in sorted(names) for file in mesh_files(name, folders)]
    stamps = tuple((file, os.path.getmtime(file), os.path.getsize(file)) for file in files)
    model, objects, missing = _read_objects(text, tuple(folders), stamps)
    if not objects and not missing:
        shapes = _skeleton(bodies, set(range(len(bodies))))
        return Visuals(shapes, [], "Drawn as a skeleton: the URDF has no visual geometry.")
    numbers: dict[tuple[bytes, ...], int] = {}
    meshes: list[Mesh] = []
    shapes = []
    for item in objects:
        if any(np.allclose(item.color, color, atol=1e-6) for color in AXIS_COLORS):
            # The page has its own layer for the tool frame.
            continue
        shape = item.shape
        if isinstance(shape, Mesh):
            # Equal meshes, such as those of five equal motors, are stored once.
            number = numbers.setdefault(shape.key, len(meshes))
            if number == len(meshes):
                meshes.append(shape)
            shape = {"mesh": number}
        body, placement = _parent_body(model, chain, item.frame, item.placement)
        shapes.append({"body": body, "placement": rows(np.round(placement, 9)), **shape})
    bodies_without_mesh = {
        _parent_body(model, chain, model.getFrameId(link, pin.FrameType.BODY), pin.SE3.Identity())[0]
        for link in missing
    }
    limits = allocate_triangles([len(mesh.triangles) for mesh in meshes], triangles)
    simplified = [_simplified(mesh, limit) for mesh, limit in zip(meshes, limits, strict=True)]
    shapes += _skeleton(bodies, bodies_without_mesh)
    return Visuals(shapes, simplified, _missing_meshes_note(missing))


def rows(pose: Array) -> list[float]:
    """Return the upper three rows of a pose as a list."""
    return (np.asarray(pose, float)[:3] + 0.0).ravel().tolist()


# --- the URDF's visual geometry --------------------------------------------------------------------
@frozen(eq=False)
class _Object:
    """Visual object of a link."""

    frame: int  # Frame of the link
    placement: pin.SE3  # Pose in this frame
    color: Array  # Red, green, blue and opacity
    shape: dict[str, Any] | Mesh  # Keys of a primitive, or a mesh


# A job draws its robot several times, such as in the report and in the scene.
@lru_cache(maxsize=4)
def _read_objects(
    text: str, folders: tuple[str, ...], _stamps: tuple[tuple[str, float, int], ...]
) -> tuple[pin.Model, list[_Object], dict[str, list[str]]]:
    """Return the model, its visual objects, and by link the file names of meshes that cannot be used."""
    # A file with another stamp, which is its path, the time of its last change and its size, is read again.
    model = _build_model(text)
    objects, missing = _load_visuals(model, text, folders)
    return (
        model,
        [
            _Object(
                item.parentFrame,
                pin.SE3(item.placement),
                np.array(item.meshColor),
                _primitive(item.geometry) or Mesh.from_geometry(item.geometry),
            )
            for item in objects
        ],
        missing,
    )


def _load_visuals(
    model: pin.Model, text: str, folders: Sequence[str]
) -> tuple[Sequence[pin.GeometryObject], dict[str, list[str]]]:
    """Return the visual objects, and by link the file names of meshes that cannot be used."""
    robot = ElementTree.fromstring(text)
    names = (mesh.get("filename", "") for mesh in robot.iterfind("link/visual/geometry/mesh"))
    too_large = {name for name in names if is_mesh_too_large(name, folders)}
    if not too_large and (objects := _load_geometry(model, text, folders)) is not None:
        return objects, {}
    # Pinocchio rejects the whole URDF if one mesh is missing, so each mesh is loaded in a robot of one link.
    missing: dict[str, list[str]] = {}
    for link in robot.findall("link"):
        for visual in link.findall("visual"):
            mesh = visual.find("geometry/mesh")
            single = ElementTree.Element("robot", name="single")
            ElementTree.SubElement(single, "link", name="single").append(visual)
            single_text = ElementTree.tostring(single, "unicode")
            name = "a shape" if mesh is None else mesh.get("filename", "")
            if name in too_large or _load_geometry(_build_model(single_text), single_text, folders) is None:
                link.remove(visual)
                missing.setdefault(link.get("name", ""), []).append(name)
    return _load_geometry(model, ElementTree.tostring(robot, "unicode"), folders) or [], missing


def _build_model(text: str) -> pin.Model:
    with discard_native_messages():
        return pin.buildModelFromXML(text)


def _load_geometry(
    model: pin.Model, text: str, folders: Sequence[str]
) -> Sequence[pin.GeometryObject] | None:
    """Return all visual objects, or None if one of them cannot be loaded or is not finite."""
    try:
        with discard_native_messages():
            geometry = pin.buildGeomFromUrdfString(
                model,
                text,
                pin.GeometryType.VISUAL,
                package_dirs=[*folders],
                mesh_loader=_MESH_LOADER,
            )
    except (ValueError, RuntimeError):
        return None
    objects = geometry.geometryObjects
    return objects if all(_is_finite(item.geometry) for item in objects) else None


def _is_finite(geometry: Any) -> bool:
    """Return whether all sizes of a primitive, or all vertices of a mesh, are finite."""
    primitive = _primitive(geometry)
    sizes = _Mesh.vertices(geometry) if primitive is None else next(iter(primitive.values()))
    return bool(np.isfinite(sizes).all())


def _missing_meshes_note(missing: dict[str, list[str]]) -> str:
    if not missing:
        return ""
    names = [f"{os.path.basename(name)} ({link})" for link, files in missing.items() for name in files]
    remedy = mesh_remedy(next(name for files in missing.values() for name in files))
    return (
        f"Drawn as rods, because meshes are missing, unreadable or larger than {MAX_MESH_BYTES >> 20} MiB: "
        f"{list_first(names, MAX_NAMED)}. {capitalized(remedy)}."
    )


def _parent_body(model: pin.Model, chain: Chain, frame: int, placement: pin.SE3) -> tuple[int, Array]:
    """Return the body to which an object on a link frame is fixed, and its pose (4, 4) in this body."""
    tip, joint = chain.frame_id, int(model.frames[frame].parentJoint)
    while frame != tip and model.frames[frame].type != pin.FrameType.JOINT and frame > 0:
        frame = model.frames[frame].parentFrame
    if frame != tip:
        return joint, placement.homogeneous
    return model.njoints, (model.frames[tip].placement.inverse() * placement).homogeneous


def obstacle_shapes(obstacles: Sequence[Obstacle], n_meshes: int) -> tuple[list[dict[str, Any]], list[Mesh]]:
    """Return the shapes of obstacles for the page, on body 0."""
    shapes, meshes = [], []
    for obstacle in obstacles:
        if obstacle.name == FLOOR:
            continue
        shape = _primitive(obstacle.shape)
        if shape is None:
            shape = {"mesh": n_meshes + len(meshes)}
            meshes.append(Mesh.from_geometry(obstacle.shape))
        shapes.append({"body": 0, "placement": rows(np.round(obstacle.placement, 9)), **shape})
    return shapes, meshes


def _primitive(geometry: Any) -> dict[str, Any] | None:
    """Return a box, sphere or cylinder with its sizes, or None for a mesh."""
    kind = type(geometry).__name__
    if kind == "Box":
        return {"box": (2 * geometry.halfSide).tolist()}
    if kind == "Sphere":
        return {"sphere": geometry.radius}
    if kind in ("Cylinder", "Capsule"):
        return {"cylinder": [geometry.radius, 2 * geometry.halfLength]}
    return None


# --- meshes ----------------------------------------------------------------------------------------
@frozen(eq=False)
class Mesh:
    """Triangle mesh whose vertices lie on a grid."""

    origin: Array  # Corner of the grid, shape (3,) [m]
    step: float  # Distance of the grid points [m]
    corners: Array  # Vertices as integer multiples of the step, shape (v, 3)
    triangles: Array  # Numbers of the vertices of each triangle, shape (t, 3)

    @classmethod
    def from_geometry(cls, geometry: Any) -> Mesh:
        """Convert a mesh that Coal has read."""
        faces = map(partial(_Mesh.tri_indices, geometry), range(_Mesh.num_tris.__get__(geometry)))
        numbers = np.fromiter(itertools.chain.from_iterable(map(itemgetter(0, 1, 2), faces)), int)
        return cls.on_grid(np.asarray(_Mesh.vertices(geometry), float), numbers.reshape(-1, 3))

    @classmethod
    def on_grid(cls, corners: Array, triangles: Array, grid: int = GRID) -> Mesh:
        """Round the vertices to a grid; merge equal vertices and drop degenerate and duplicate triangles."""
        origin, size = corners.min(0), np.ptp(corners, axis=0).max()
        step = size / grid or 1.0
        x, y, z = np.round((corners - origin) / step).astype(np.int64).T
        # Three coordinates of 16 bits in one integer: np.unique is faster on integers than on rows.
        unique, inverse = np.unique((x << 32) + (y << 16) + z, return_inverse=True)
        cells = np.stack([unique >> 32, unique >> 16 & 0xFFFF, unique & 0xFFFF], -1).astype("<u2")
        triangles = inverse[triangles]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
        low, middle, high = np.sort(triangles, axis=1).T
        identity = (low * len(unique) + middle) * len(unique) + high
        first = np.unique(identity, return_index=True)[1]
        return cls(np.round(origin, 9), float(step), cells, triangles[np.sort(first)])

    @property
    def vertices(self) -> Array:
        """Vertices, shape (v, 3) [m]."""
        return self.origin + self.step * self.corners

    @property
    def key(self) -> tuple[bytes, ...]:
        """Dictionary key that is equal for equal meshes."""
        return self.origin.tobytes(), self.corners.tobytes(), self.triangles.tobytes()

    def simplify(self, limit: int) -> Mesh:
        """Reduce the number of triangles by collapsing the edges that change the form least."""
        mesh, limit = self, max(limit, 1)
        for grid in COARSER_GRIDS:
            if len(mesh.triangles) <= limit:
                break
            # Thin triangles, as on screw threads, block the collapse of edges; a coarser grid removes them.
            mesh = Mesh.on_grid(mesh.vertices, mesh.triangles, grid)
            if len(mesh.triangles) > limit:
                corners, triangles = fast_simplification.simplify(
                    mesh.vertices / mesh.step, mesh.triangles, target_count=limit
                )[:2]
                # Few triangles can collapse to nothing; the mesh on the coarser grid stays then.
                if len(triangles):
                    mesh = Mesh.on_grid(mesh.step * corners, np.asarray(triangles, int))
        return mesh

    def encoded(self) -> dict[str, Any]:
        """Return the mesh for the page."""
        width = 2 if len(self.corners) <= 1 << 16 else 4
        return {
            "origin": self.origin.tolist(),
            "step": self.step,
            "bytes": width,
            "corners": base64.b64encode(self.corners.tobytes()).decode(),
            "triangles": base64.b64encode(self.triangles.astype(f"<u{width}").tobytes()).decode(),
        }


@lru_cache(maxsize=64)
def _simplified(mesh: Mesh, limit: int) -> Mesh:
    """Return a mesh with fewer triangles; the meshes of a robot are simplified once for all its scenes."""
    return mesh.simplify(limit)


def allocate_triangles(counts: Sequence[int], total: int) -> list[int]:
    """Share a number of triangles between meshes, in proportion to the square roots of their own numbers."""
    remaining, roots = float(total), np.sqrt(counts)
    rate = 0.0
    # A damaged mesh may have no triangles.
    for i in (i for i in np.argsort(roots) if roots[i]):
        rate = remaining / roots[roots >= roots[i]].sum()
        if roots[i] > rate:
            break
        remaining -= counts[i]
    return np.minimum(counts, rate * roots).astype(int).tolist()


# --- skeleton -------------------------------------------------------------------------------------
def _skeleton(bodies: Sequence[dict[str, Any]], chosen: set[int]) -> list[dict[str, Any]]:
    """Return cylinders for the chosen bodies: one on the moving joint, and rods to the following joints."""
    ends = [np.reshape(body["placement"], (3, 4))[:, 3] for body in bodies]
    radius = 0.02 * (sum(float(np.linalg.norm(end)) for end in ends[1:]) or 1.0)
    return [
        {"body": body, "placement": rows(np.round(pose, 9)), "cylinder": size}
        for body, pose, size in _cylinders(bodies, ends, radius)
        if body in chosen
    ]


def _cylinders(
    bodies: Sequence[dict[str, Any]], ends: Sequence[Array], radius: float
) -> Iterator[tuple[int, Array, list[float]]]:
    """Yield body, pose (4, 4) in the body, and radius and length [m] of each cylinder."""
    yield 0, *_cylinder_between(np.zeros(3), np.array([0.0, 0.0, -0.6 * radius]), 4 * radius)
    for i, (body, end) in enumerate(zip(bodies, ends, strict=True)):
        if i and np.linalg.norm(end) > 1e-6:
            yield body["parent"], *_cylinder_between(np.zeros(3), end, radius)
        if "axes" in body:
            half = 1.8 * radius * np.array(body["axes"][0])
            yield i, *_cylinder_between(-half, half, 1.6 * radius)


def _cylinder_between(start: Array, end: Array, radius: float) -> tuple[Array, list[float]]:
    """Return pose (4, 4), and radius and length [m], of a cylinder between two points (3,)."""
    z = (end - start) / np.linalg.norm(end - start)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    pose = se3.transform(np.stack([x, np.cross(z, x), z], -1), 0.5 * (start + end))
    return pose, [radius, float(np.linalg.norm(end - start))]
