"""Live MeshCat scene of a robot on the loopback address of this computer.

The offline page of `scene` needs no server. The live scene is for programs that move the robot. A server
process listens on the loopback address and ends with the program. If it does not answer within
`TIMEOUT_MS`, a DhcalError is raised; MeshCat itself would wait without limit.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from tempfile import TemporaryDirectory
from typing import Any

import meshcat
import meshcat.geometry as g
import numpy as np
import pinocchio as pin
import umsgpack
import zmq

from .. import se3
from .._typing import Array, PathLike
from ..calibration.result import Result
from ..exceptions import DhcalError
from ..robot.chain import Chain
from .meshes import Visuals, visuals_of
from .scene import MAX_TRIANGLES, kinematic_tree, with_shared_frames

# Largest duration of one command [ms].
TIMEOUT_MS = 2000
# Largest duration of the start, including imports from a slow disk [s].
START_TIMEOUT_S = 30.0
# Frames per second of `Live.play`.
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
    """Start a live scene of one robot, or of a nominal and a calibrated robot.

    Args:
        nominal: Nominal robot; transparent beside the calibrated one, opaque if alone.
        calibrated: Calibrated robot, or calibration result.
        package_dirs: Folders to search for meshes. Default: the folders above the URDF.
        magnification: Factor by which the errors are magnified.
        triangles: Largest number of triangles of all meshes together.

    Returns:
        Scene with all joints at zero. Close it, or use it in a `with` statement.

    Raises:
        DhcalError: The robots have different joints, or the server does not start.
    """
    if isinstance(calibrated, Result):
        nominal = replace(
            nominal, base=calibrated.nominal_refitted.base, tool=calibrated.nominal_refitted.tool
        )
        calibrated = calibrated.chain
    arm = calibrated or nominal
    bodies = kinematic_tree(nominal, arm)["bodies"]
    drawn = visuals_of(nominal, bodies, package_dirs, triangles)
    if calibrated is None:
        arms = {"arm": arm}
    else:
        errors = se3.log6(se3.inverse(nominal.origins) @ arm.origins)
        grown = replace(arm, origins=nominal.origins @ se3.exp6(magnification * errors))
        arms = {"nominal": with_shared_frames(nominal, arm), "calibrated": grown}
    window = _Window.start()
    scene = Live(window.web_url, arms, window)
    for name in arms:
        view = meshcat.Visualizer(window=window)[name]
        view.set_transform(se3.inverse(arm.base))
        _draw(view, STYLES[name], drawn, len(bodies) - 1)
    size = float(np.linalg.norm(arm.origins[:, :3, 3], axis=1).sum())
    page = meshcat.Visualizer(window=window)
    page["/Cameras/default/rotated/<object>"].set_property("position", [0.7 * size, 0.4 * size, 0.8 * size])
    page["/Background"].set_property("top_color", [0.97, 0.98, 0.99])
    page["/Background"].set_property("bottom_color", [0.86, 0.9, 0.93])
    scene.show(np.zeros(nominal.n_joints))
    return scene


@dataclass(frozen=True, eq=False)
class Live:
    """Running live scene.

    Attributes:
        url: Address of the page for a browser on this computer.
        arms: Robots by layer.
    """

    url: str
    arms: Mapping[str, Chain]
    _window: _Window

    def show(self, q: Array) -> None:
        """Show the robots at joint positions q, shape (n,) [rad or m].

        Raises:
            DhcalError: The shape is wrong, or the server does not answer.
        """
        for name, chain in self.arms.items():
            for number, pose in enumerate(_body_poses(chain, q)):
                meshcat.Visualizer(window=self._window)[f"{name}/{number}"].set_transform(pose)

    def play(self, q: Array, seconds: float = 1.0) -> None:
        """Move the robots through configurations.

        Args:
            q: Joint positions, shape (m, n) [rad or m].
            seconds: Duration of the motion from one configuration to the next [s].

        Raises:
            DhcalError: The shape is wrong, or the server does not answer.
        """
        q = next(iter(self.arms.values())).validated_q(q)
        steps = max(1, round(seconds * FRAMES_PER_SECOND))
        for start, end in zip(q, np.concatenate([q[1:], q[-1:]]), strict=True):
            for share in np.arange(steps) / steps:
                self.show(start + share * (end - start))
                time.sleep(1 / FRAMES_PER_SECOND)

    def close(self) -> None:
        """Stop the server."""
        self._window.close()

    def __enter__(self) -> Live:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _body_poses(chain: Chain, q: Array) -> list[Array]:
    """Compute the poses, shape (4, 4), of the bodies of `kinematic_tree` in the measuring frame."""
    model, data = chain.model, chain.model.createData()
    pin.framesForwardKinematics(model, data, chain.configurations(np.atleast_2d(q))[0])
    poses = [chain.base @ pose.homogeneous for pose in (*data.oMi, data.oMf[chain.frame_id])]
    return [*poses, poses[-1] @ chain.tool]


def _draw(view: meshcat.Visualizer, style: tuple[int, float], visuals: Visuals, tool: int) -> None:
    """Send the shapes of a robot, each under the number of its body, and a triad for the tool."""
    color, opacity = style
    material = g.MeshPhongMaterial(color=color, opacity=opacity, transparent=opacity < 1)
    for number, shape in enumerate(visuals.shapes):
        rotation = np.eye(4)
        if "box" in shape:
            geometry = g.Box(shape["box"])
        elif "sphere" in shape:
            geometry = g.Sphere(shape["sphere"])
        elif "cylinder" in shape:
            radius, length = shape["cylinder"]
            # The axis of a cylinder is y in MeshCat and z in URDF.
            geometry, rotation = g.Cylinder(length, radius), se3.exp6(np.array([0, 0, 0, np.pi / 2, 0, 0]))
        else:
            mesh = visuals.meshes[shape["mesh"]]
            geometry = g.TriangularMeshGeometry(mesh.vertices, mesh.triangles)
        placement = np.concatenate([np.reshape(shape["placement"], (3, 4)), [[0, 0, 0, 1]]])
        view[f"{shape['body']}/{number}"].set_object(geometry, material)
        view[f"{shape['body']}/{number}"].set_transform(placement @ rotation)
    view[f"{tool}/frame"].set_object(g.triad(0.2))


@dataclass(frozen=True, eq=False)
class _Window:
    """Connection of `meshcat.Visualizer` to a server, with a time limit for each answer.

    Attributes:
        process: Server process.
        socket: Socket that is connected to the server.
        folder: Folder of the socket file.
        web_url: Address of the page.
    """

    process: subprocess.Popen[str]
    socket: zmq.Socket[bytes]
    folder: TemporaryDirectory[str]
    web_url: str

    @classmethod
    def start(cls) -> _Window:
        """Start a server process and connect to it."""
        folder = TemporaryDirectory(prefix="dhcal-")
        address = f"ipc://{folder.name}/commands"
        process = subprocess.Popen(
            [sys.executable, "-m", f"{__package__}.live_server", address],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            # The server imports the same modules. It ignores the interrupt of a notebook cell.
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
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
            raise DhcalError(f"the MeshCat server did not start within {START_TIMEOUT_S:.0f} s")
        socket.connect(address)
        return window

    def send(self, command: Any) -> None:
        """Send one MeshCat command and wait for its answer."""
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
        """Stop the server and remove the socket file."""
        self.socket.close()
        self.process.kill()
        self.process.communicate()
        self.folder.cleanup()
