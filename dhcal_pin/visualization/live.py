"""A live MeshCat scene of an arm, on this computer only and only on request.

The offline page of `viewer` needs no server. This is for programs that move the arm while one looks on:
a server process on the loopback address that ends with the program, and that answers within a time
limit or is given up.
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

TIMEOUT_MS = 2000  # ms that the server may take for one command


START_TIMEOUT_S = 30.0  # s that it may take to start, imports from a slow disk included


FRAMES_PER_SECOND = 30  # a second, while poses are played


STYLES = {"nominal": (0x0072B2, 0.35), "calibrated": (0xE69F00, 1.0), "arm": (0x0072B2, 1.0)}


def serve(
    nominal: Chain,
    calibrated: Chain | Result | None = None,
    *,
    package_dirs: Sequence[PathLike] | None = None,
    magnification: float = 1.0,
    triangles: int = MAX_TRIANGLES,
) -> Live:
    """Starts a live scene of an arm, or of an arm before and after its calibration.

    Args:
        nominal: the arm as it was thought to be; a ghost beside the calibrated one, solid if alone.
        calibrated: the same arm, or the result that found it.
        package_dirs: where to look for the URDF's meshes; the folders above the URDF without it.
        magnification: how many times larger than true the errors are drawn.
        triangles: most of them that the meshes keep all together.

    Returns:
        The scene, in the pose of zeros; close it, or use it in a `with` statement.

    Raises:
        DhcalError: the two arms have different joints, or the server does not start.
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
    """A running scene.

    Attributes:
        url: of its page, for a browser on this computer.
        arms: what is drawn, by layer.
    """

    url: str
    arms: Mapping[str, Chain]
    _window: _Window

    def show(self, q: Array) -> None:
        """Puts the arms where joint values q (n,) say, rad or m.

        Raises:
            DhcalError: q does not fit, or the server is gone, within 3 s.
        """
        for name, chain in self.arms.items():
            for number, pose in enumerate(_body_poses(chain, q)):
                meshcat.Visualizer(window=self._window)[f"{name}/{number}"].set_transform(pose)

    def play(self, q: Array, seconds: float = 1.0) -> None:
        """Moves through poses q (m, n), so long from one to the next.

        Raises:
            DhcalError: as `show`.
        """
        q = next(iter(self.arms.values())).validated_q(q)
        steps = max(1, round(seconds * FRAMES_PER_SECOND))
        for start, end in zip(q, np.concatenate([q[1:], q[-1:]]), strict=True):
            for share in np.arange(steps) / steps:
                self.show(start + share * (end - start))
                time.sleep(1 / FRAMES_PER_SECOND)

    def close(self) -> None:
        """Ends the server."""
        self._window.close()

    def __enter__(self) -> Live:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _body_poses(chain: Chain, q: Array) -> list[Array]:
    """Poses (4, 4) of the bodies that `viewer.tree` lists, as Pinocchio has them, in the measuring frame."""
    model, data = chain.model, chain.model.createData()
    pin.framesForwardKinematics(model, data, chain.configurations(np.atleast_2d(q))[0])
    placed = [*data.oMi, data.oMf[chain.frame_id]]
    poses = [chain.base @ pose.homogeneous for pose in placed]
    return [*poses, poses[-1] @ chain.tool]


def _draw(view: meshcat.Visualizer, look: tuple[int, float], drawn: Visuals, tool: int) -> None:
    """Sends an arm's shapes, each under its body's number, and a triad for the tool."""
    color, opacity = look
    material = g.MeshPhongMaterial(color=color, opacity=opacity, transparent=opacity < 1)
    for number, shape in enumerate(drawn.shapes):
        turn = np.eye(4)
        if "box" in shape:
            geometry = g.Box(shape["box"])
        elif "sphere" in shape:
            geometry = g.Sphere(shape["sphere"])
        elif "cylinder" in shape:
            radius, length = shape["cylinder"]
            # MeshCat's cylinders stand along y, URDF's along z.
            geometry, turn = g.Cylinder(length, radius), se3.exp6(np.array([0, 0, 0, np.pi / 2, 0, 0]))
        else:
            mesh = drawn.meshes[shape["mesh"]]
            geometry = g.TriangularMeshGeometry(mesh.vertices, mesh.triangles)
        place = np.concatenate([np.reshape(shape["placement"], (3, 4)), [[0, 0, 0, 1]]])
        view[f"{shape['body']}/{number}"].set_object(geometry, material)
        view[f"{shape['body']}/{number}"].set_transform(place @ turn)
    view[f"{tool}/frame"].set_object(g.triad(0.2))


@dataclass(frozen=True, eq=False)
class _Window:
    """What `meshcat.Visualizer` sends its commands to; MeshCat's own waits for ever for an answer.

    Attributes:
        process: the server.
        socket: to it.
        folder: of the socket file.
        web_url: of the server's page.
    """

    process: subprocess.Popen[str]
    socket: zmq.Socket[bytes]
    folder: TemporaryDirectory[str]
    web_url: str

    @classmethod
    def start(cls) -> _Window:
        """With a server of its own."""
        folder = TemporaryDirectory(prefix="dhcal-")
        address = f"ipc://{folder.name}/commands"
        process = subprocess.Popen(
            [sys.executable, "-m", f"{__package__}.live_server", address],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            # The same modules as here; and an interrupt of a notebook's cell is not one of the server.
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
        """One command of MeshCat, answered within the time limit."""
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
        raise DhcalError(f"the MeshCat server at {self.web_url} is gone; start another one")

    def close(self) -> None:
        """Ends the server and removes its socket file."""
        self.socket.close()
        self.process.kill()
        self.process.communicate()
        self.folder.cleanup()
