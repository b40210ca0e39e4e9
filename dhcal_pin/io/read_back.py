"""Written robot files read back by other programs, whose forward kinematics must be those of the chain.

Pinocchio reads every robot. A URDF is read by yourdfpy too, and an MJCF by MuJoCo, where they are installed.
A program that already reads the nominal robot in another way, or not at all, is left out: axes that are not
normalized, for example, are read differently.
"""

from __future__ import annotations

import builtins
import dataclasses
import io
import os
import warnings
from collections.abc import Callable, Mapping
from functools import cache
from importlib.machinery import SourceFileLoader
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from .. import se3
from .._frozen import bare
from .._typing import Array, PathLike
from ..exceptions import DhcalError
from ..native_output import discard_native_messages
from ..robot.chain import Chain
from ..robot.formats.mjcf import ORIENTATIONS, Mjcf, MjcfTag
from ..robot.urdf import Urdf, xml_attribute
from ..robot.urdf_path import build_model

# Largest difference of the tip [m, and entries of its rotation].
READER_TOL = 1e-9
# Number of random configurations at which the tip is compared.
_N_SAMPLES = 10
# Elements of an MJCF that move bodies, with their attributes.
_POSE = ("name", "pos", *ORIENTATIONS)
_KINEMATIC = {
    "compiler": ("angle", "eulerseq"),
    "default": ("class",),
    "worldbody": ("childclass",),
    "body": (*_POSE, "childclass"),
    "frame": (*_POSE, "childclass"),
    "joint": ("name", "class", "type", "pos", "axis", "ref"),
    "freejoint": ("name",),
    "site": _POSE,
}


class Reader(NamedTuple):
    """Program that reads robot files."""

    name: str  # Name in messages
    module: str  # Python package that must be installed
    reads: tuple[type[Urdf], ...]  # Classes of the robots that it reads
    # Function that computes the poses (m, 4, 4) of the tip of a chain in its first link from joint positions
    # (m, n), with nothing but the file.
    poses: Callable[[Chain, Array], Array]


def _pinocchio_poses(chain: Chain, q: Array) -> Array:
    """Compute the poses of the tip by Pinocchio."""
    model = build_model(chain.urdf)
    data = model.createData()
    root, tip = (model.getFrameId(link, pin.FrameType.BODY) for link in (chain.root, chain.tip))
    out = []
    for configuration in chain.configurations(q):
        pin.framesForwardKinematics(model, data, configuration)
        out.append((data.oMf[root].inverse() * data.oMf[tip]).homogeneous)
    return np.array(out)


def _yourdfpy_poses(chain: Chain, q: Array) -> Array:
    """Compute the poses of the tip by the joints that yourdfpy reads."""
    robot: Any = _yourdfpy_reader()["URDF"].load(io.BytesIO(chain.urdf.data), build_scene_graph=False)
    by_child = {joint.child: joint for joint in robot.robot.joints}
    out = []
    for row in q:
        robot.update_cfg(dict(zip(chain.joint_names, row, strict=True)))
        root, tip = (_pose_in_base(robot, by_child, link) for link in (chain.root, chain.tip))
        out.append(se3.inverse(root) @ tip)
    return np.array(out)


def _pose_in_base(robot: Any, by_child: Mapping[str, Any], link: str) -> Array:
    """Multiply the poses of yourdfpy's joints from the base to a link."""
    pose = np.eye(4)
    while link in by_child:
        joint = by_child[link]
        pose = robot._forward_kinematics_joint(joint)[0] @ pose
        link = joint.parent
    return pose


@cache
def _yourdfpy_reader() -> dict[str, Any]:
    """Return the names of yourdfpy's module that reads URDF, without slow imports."""
    # The import of trimesh takes 0.7 s of processor time. Reading needs three functions of it,
    # and no comparison of objects.
    trimesh: Any = ModuleType("trimesh")
    trimesh.Trimesh = trimesh.Scene = object  # in annotations
    trimesh.transformations = SimpleNamespace(
        compose_matrix=lambda translate, angles: se3.transform(pin.rpy.rpyToMatrix(angles), translate),
        translation_matrix=se3.translation,
        rotation_matrix=lambda angle, axis: se3.transform(
            pin.AngleAxis(angle, axis / np.linalg.norm(axis)).matrix(), np.zeros(3)
        ),
    )

    simple: Any = SimpleNamespace(**vars(dataclasses))
    simple.dataclass = lambda cls=None, **_: bare if cls is None else bare(cls)
    replacements = {"trimesh": trimesh, "dataclasses": simple}

    def import_module(name: str, *args: Any) -> Any:
        return replacements.get(name.split(".")[0]) or builtins.__import__(name, *args)

    package = find_spec("yourdfpy")
    assert package is not None
    assert package.origin is not None
    path = Path(package.origin).with_name("urdf.py")
    names = {"__name__": __name__, "__builtins__": vars(builtins) | {"__import__": import_module}}
    code = SourceFileLoader(__name__, str(path)).get_code(__name__)
    assert code is not None
    exec(code, names)
    return names


def _mujoco_poses(chain: Chain, q: Array) -> Array:
    """Compute the poses of the tip by MuJoCo."""
    import mujoco  # lazy import: only for MJCF

    assert isinstance(chain.urdf, Mjcf)
    assert chain.urdf.document is not None
    model: Any = mujoco.MjModel.from_xml_string(kinematics_text(chain.urdf.document))
    data: Any = mujoco.MjData(model)
    bodies = {model.body(i).name for i in range(model.nbody)}
    frames = [data.body(name) if name in bodies else data.site(name) for name in (chain.root, chain.tip)]
    addresses = [model.joint(name).qposadr[0] for name in chain.joint_names]
    out = []
    for row in q:
        data.qpos[addresses] = row
        mujoco.mj_kinematics(model, data)
        root, tip = (se3.transform(frame.xmat.reshape(3, 3), frame.xpos) for frame in frames)
        out.append(se3.inverse(root) @ tip)
    return np.array(out)


def kinematics_text(tag: MjcfTag) -> str:
    """Write the elements of an MJCF that move bodies, with values as in the file, but without shapes."""
    if tag.element == "mujoco":
        attributes, start = "", '<compiler boundmass="1e-3" boundinertia="1e-6"/>'
    else:
        keys = [key for key in _KINEMATIC[tag.element] if key in tag.attributes]
        attributes = "".join(f" {key}={xml_attribute(tag.attributes[key])}" for key in keys)
        start = ""
    children = [
        child
        for child in tag.children
        # Defaults of sites may name materials, and have no poses.
        if child.element in _KINEMATIC and not (tag.element == "default" and child.element == "site")
    ]
    content = "".join(map(kinematics_text, children))
    return f"<{tag.element}{attributes}>{start}{content}</{tag.element}>"


READERS = (
    Reader("Pinocchio", "pinocchio", (Urdf, Mjcf), _pinocchio_poses),
    Reader("yourdfpy", "yourdfpy", (Urdf,), _yourdfpy_poses),
    Reader("MuJoCo", "mujoco", (Mjcf,), _mujoco_poses),
)


def require_agreement(written: Chain, nominal: Chain, path: PathLike) -> None:
    """Require that programs compute the tip of a written chain with ideal joints and no base or tool."""
    for reader in READERS:
        if type(written.urdf) not in reader.reads or not find_spec(reader.module):
            continue
        difference = _difference(reader, written)
        if difference <= READER_TOL or not _difference(reader, nominal) <= READER_TOL:
            continue
        result = (
            "cannot read it" if difference == np.inf else f"computes a tip that differs by {difference:.2g}"
        )
        raise DhcalError(f"{os.fspath(path)}: not written: {reader.name} {result}; please report it")


def _difference(reader: Reader, chain: Chain) -> float:
    """Return the largest difference of a tip from that of the chain; inf if the robot is not read."""
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (_N_SAMPLES, chain.n_joints))
    try:
        # Imports of the programs warn of their own dependencies.
        with warnings.catch_warnings(), discard_native_messages():
            warnings.simplefilter("ignore")
            difference = np.abs(reader.poses(chain, q) - chain.poses(q)).max()
    # What a program raises depends on the program.
    except Exception:
        return np.inf
    return float(difference) if np.isfinite(difference) else np.inf
