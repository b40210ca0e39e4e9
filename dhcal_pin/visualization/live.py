"""Live MeshCat scene of a robot that a program moves.

The offline page of `scene` needs no server. The live scene starts one in a process of its own, which listens
on the loopback address only and ends with the program. Commands that are not answered within a time limit
raise an error.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import Any

import meshcat
import meshcat.geometry as g
import numpy as np
import pinocchio as pin
import umsgpack
import zmq

from .. import se3
from .._frozen import frozen
from .._typing import Array, PathLike
from ..calibration.result import Result
from ..exceptions import DhcalError
from ..robot.chain import Chain
from .meshes import Visuals, visuals_of
from .scene import MAX_TRIANGLES, kinematic_tree, reach, with_shared_frames

# Longest time for one command of the server [ms].
TIMEOUT_MS = 2000
# Longest time for the start of the server, including imports from a slow disk [s].
START_TIMEOUT_S = 30.0
# Configurations per second while poses are played.
FRAMES_PER_SECOND = 30
# Colour and opacity of each layer.
STYLES = {"nominal": (0x0072B2, 0.35), "calibrated": (0xE69F00, 1.0), "arm": (0x0072B2, 1.0)}


def serve(
    nominal: Chain,
    calibrated: Chain | Result | None = None,
    *,
    package_dirs: Sequence[PathLike] | None = None,
    magnification: float = 1.0,
    triangles: int = MAX_TRIANGLES,
) -> Live:
    """Start a live scene of a robot, or of a robot before and after its calibration.

    Args:
        nominal: Nominal robot; transparent beside the calibrated one, solid if alone.
        calibrated: Calibrated robot with the same joints, or the result of the calibration.
        package_dirs: Folders that contain the meshes of the URDF; by default those of `ros_packages`.
        magnification: Magnification of the errors.
        triangles: Largest number of triangles of all meshes.

    Returns:
        Scene with all joints at zero; close it, or use it in a `with` statement.

    Raises:
        DhcalError: The two robots have different joints, or the server does not start.
    """
    if isinstance(calibrated, Result):
        nominal = replace(
            nominal, base=calibrated.nominal_refitted.base, tool=calibrated.nominal_refitted.tool
        )
        calibrated = calibrated.chain
    arm = calibrated or nominal
    bodies = kinematic_tree(nominal, arm)["bodies"]
    visuals = visuals_of(nominal, bodies, package_dirs, triangles)
    if calibrated is None:
        arms = {"arm": arm}
    else:
        errors = se3.log6(se3.inverse(nominal.origins) @ arm.origins)
        magnified = replace(arm, origins=nominal.origins @ se3.exp6(magnification * errors))
        arms = {"nominal": with_shared_frames(nominal, arm), "calibrated": magnified}
    window = _Window.start()
    scene = Live(window.web_url, arms, window)
    for name in arms:
        view = meshcat.Visualizer(window=window)[name]
        view.set_transform(se3.inverse(arm.base))
        _draw(view, STYLES[name], visuals, len(bodies) - 1)
    size = reach(arm)
    page = meshcat.Visualizer(window=window)
    page["/Cameras/default/rotated/<object>"].set_property("position", [0.7 * size, 0.4 * size, 0.8 * size])
    page["/Background"].set_property("top_color", [0.97, 0.98, 0.99])
    page["/Background"].set_property("bottom_color", [0.86, 0.9, 0.93])
    scene.show(np.zeros(nominal.n_joints))
    return scene


@frozen(eq=False)
class Live:
    """Running live scene.

    Attributes:
        url: Address of the page, for a browser on this computer.
        arms: Robots by layer.
    """

    url: str
    arms: Mapping[str, Chain]
    _window: _Window

    def show(self, q: Array) -> None:
        """Move the robots to a configuration of shape (n,) [rad or m].

        A wrong shape, or a server that does not answer within 3 s, is a `DhcalError`.
        """
        for name, chain in self.arms.items():
            for number, pose in enumerate(_body_poses(chain, q)):
                meshcat.Visualizer(window=self._window)[f"{name}/{number}"].set_transform(pose)

    def play(self, q: Array, seconds: float = 1.0) -> None:
        """Move the robots through configurations.

        Args:
            q: Joint positions, shape (m, n) [rad or m].
            seconds: Time from one configuration to the next [s].

        Raises:
            DhcalError: As for `show`.
        """
        q = next(iter(self.arms.values())).validated_q(q)
        steps = max(1, round(seconds * FRAMES_PER_SECOND))
        for start, end in zip(q, np.concatenate([q[1:], q[-1:]]), strict=True):
            for fraction in np.arange(steps) / steps:
                self.show(start + fraction * (end - start))
                time.sleep(1 / FRAMES_PER_SECOND)

    def close(self) -> None:
        """Stop the server."""
        self._window.close()

    def __enter__(self) -> Live:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _body_poses(chain: Chain, q: Array) -> list[Array]:
    """Return the poses (4, 4) of the bodies of `scene.kinematic_tree` in the measuring frame."""
    model, data = chain.model, chain.model.createData()
    pin.framesForwardKinematics(model, data, chain.configurations(np.atleast_2d(q))[0])
    model_poses = [*data.oMi, data.oMf[chain.frame_id]]
    poses = [chain.base @ pose.homogeneous for pose in model_poses]
    return [*poses, poses[-1] @ chain.tool]


def _draw(view: meshcat.Visualizer, style: tuple[int, float], visuals: Visuals, tool: int) -> None:
    """Send the shapes of a robot, each below the number of its body, and the axes of the tool frame."""
    color, opacity = style
    material = g.MeshPhongMaterial(color=color, opacity=opacity, transparent=opacity < 1)
    for number, shape in enumerate(visuals.shapes):
        shape_from_geometry = np.eye(4)
        if "box" in shape:
            geometry = g.Box(shape["box"])
        elif "sphere" in shape:
            geometry = g.Sphere(shape["sphere"])
        elif "cylinder" in shape:
            radius, length = shape["cylinder"]
            geometry = g.Cylinder(length, radius)
            # The axis of a cylinder is y in MeshCat and z in URDF.
            shape_from_geometry = se3.exp6(np.array([0, 0, 0, np.pi / 2, 0, 0]))
        else:
            mesh = visuals.meshes[shape["mesh"]]
            geometry = g.TriangularMeshGeometry(mesh.vertices, mesh.triangles)
        placement = np.concatenate([np.reshape(shape["placement"], (3, 4)), [[0, 0, 0, 1]]])
        view[f"{shape['body']}/{number}"].set_object(geometry, material)
        view[f"{shape['body']}/{number}"].set_transform(placement @ shape_from_geometry)
    view[f"{tool}/frame"].set_object(g.triad(0.2))


@frozen(eq=False)
class _Window:
    """Connection of `meshcat.Visualizer` to the server; the one of MeshCat waits without limit."""

    process: subprocess.Popen[str]  # Process of the server
    socket: zmq.Socket[bytes]  # Connection to the server
    folder: TemporaryDirectory[str]  # Folder of the socket file
    web_url: str  # Address of the page

    @classmethod
    def start(cls) -> _Window:
        """Start a server and connect to it."""
        folder = TemporaryDirectory(prefix="dhcal-")
        address = f"ipc://{folder.name}/commands"
        process = subprocess.Popen(
            [sys.executable, "-m", f"{__package__}.live_server", address],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            # The server finds the same modules.
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            # An interrupted notebook cell does not interrupt the server.
            start_new_session=True,
        )
        assert process.stdout is not None
        ready = select.select([process.stdout], [], [], START_TIMEOUT_S)[0]
        url = process.stdout.readline().strip() if ready else ""
        socket = zmq.Context.instance().socket(zmq.REQ)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SNDTIMEO, TIMEOUT_MS)
        socket.setsockopt(zmq.RCVTIMEO, TIMEOUT_MS)
        window = cls(process, socket, folder, url)
        if not url:
            window.close()
            raise DhcalError(
                f"the MeshCat server did not start within {START_TIMEOUT_S:.0f} s; start it again"
            )
        socket.connect(address)
        return window

    def send(self, command: Any) -> None:
        """Send a command of MeshCat and wait for the answer."""
        data = command.lower()
        try:
            if self.process.poll() is None:
                self.socket.send_multipart(
                    [data["type"].encode(), data["path"].encode(), umsgpack.packb(data)]
                )
                self.socket.recv()
                return
        except zmq.ZMQError:
            pass
        self.close()
        raise DhcalError(f"the MeshCat server at {self.web_url} does not answer; start a new scene")

    def close(self) -> None:
        """Stop the server and remove its socket file."""
        self.socket.close()
        self.process.kill()
        self.process.communicate()
        self.folder.cleanup()
