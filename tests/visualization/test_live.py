"""The live scene listens on this computer only, shows Pinocchio's poses, and reports a dead server."""

import os
import signal
import webbrowser
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from http.client import HTTPConnection
from urllib.parse import urlsplit

import numpy as np
import pinocchio as pin
import psutil
import pytest
from pages import LIVE_FIND
from robots import URDF
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.cli.main import main
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.robot.chain import Chain
from dhcal_pin.visualization.live import TIMEOUT_MS, Live, serve


def arms(chain: Chain) -> tuple[Chain, Chain]:
    """An arm, and the same with another origin, base and tool."""
    error = np.array([1e-3, 0, -2e-3, 0, 3e-3, 1e-3])
    wrong = chain.perturbed_at({4: se3.exp6(error)})
    return chain, replace(wrong, base=se3.translation([2.0, 0, 1]), tool=se3.translation([0, 0, 0.1]))


@pytest.fixture
def scene(sim_6dof: Chain) -> Iterator[Live]:
    with serve(*arms(sim_6dof), magnification=30) as scene:
        yield scene


def processes(scene: Live) -> list[psutil.Process]:
    here = psutil.Process(scene._window.process.pid)
    return [here, *here.children(recursive=True)]


def test_nothing_listens_elsewhere(scene):
    sockets = [socket for process in processes(scene) for socket in process.net_connections("inet")]
    listening = [socket for socket in sockets if socket.status == psutil.CONN_LISTEN]
    assert listening
    assert {socket.laddr.ip for socket in sockets} == {"127.0.0.1"}
    assert f"http://127.0.0.1:{listening[0].laddr.port}/" in scene.url
    folder = scene._window.folder.name
    assert os.stat(folder).st_mode & 0o77 == 0


def test_the_browser_shows_what_pinocchio_says(scene, browser, sim_6dof):
    nominal, calibrated = arms(sim_6dof)
    q = np.array([0.3, -0.7, 0.9, 0.2, -1.1, 0.5])
    # A twist magnified 30 times, and both arms in the frame of the calibrated base.
    grown = nominal.perturbed_at({4: se3.exp6(30 * np.array([1e-3, 0, -2e-3, 0, 3e-3, 1e-3]))})
    scene.show(q)
    page = browser.new_page(viewport={"width": 300, "height": 200})
    page.goto(scene.url)
    for name, chain in (("nominal", nominal), ("calibrated", grown)):
        model, data = chain.model, chain.model.createData()
        pin.framesForwardKinematics(model, data, chain.configurations(q[None])[0])
        tool = data.oMf[chain.frame_id].homogeneous @ calibrated.tool
        body = model.njoints + 1
        page.wait_for_function("([find, ...it]) => eval(find)(...it)", arg=[LIVE_FIND, name, body])
        seen = page.evaluate("([find, ...it]) => eval(find)(...it)", [LIVE_FIND, name, body])
        assert np.abs(np.reshape(seen, (4, 4)).T - tool).max() < 1e-6
    page.close()


@pytest.mark.parametrize("end", some_slow([signal.SIGKILL, signal.SIGSTOP], {1}))
def test_a_server_that_is_gone_is_named_in_time(scene, end):
    assert TIMEOUT_MS < 3000
    for process in processes(scene):
        process.send_signal(end)
    for _ in range(2):
        with pytest.raises(DhcalError, match=r"127\.0\.0\.1:\d+/[\w-]+/ does not answer; start a new scene"):
            scene.show(np.zeros(6))


def status_of(url: str, host: str = "", path: str | None = None, **headers: str) -> int:
    """Status of a request to the server of an address, as a browser that was told another name sends it."""
    parts = urlsplit(url)
    connection = HTTPConnection(parts.hostname or "", parts.port, timeout=10)
    connection.putrequest("GET", parts.path if path is None else path, skip_host=True)
    connection.putheader("Host", host or parts.netloc)
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    with closing(connection):
        return connection.getresponse().status


UPGRADE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec_WebSocket_Version": "13",
}


def test_only_who_knows_the_address_gets_the_scene(scene):
    url, path = scene.url, urlsplit(scene.url).path
    port = urlsplit(url).port
    assert len(path) > 20
    assert status_of(url) == 200
    assert status_of(url, f"localhost:{port}") == 200
    assert status_of(url, path=f"{path}main.min.js") == 200
    assert status_of(url, path=f"{path}socket", **UPGRADE) == 101
    # A page whose name resolves to this computer: its host and its origin agree.
    for host in ("evil.example", f"evil.example:{port}", f"127.0.0.1.evil.example:{port}", ""):
        origin = {"Origin": f"http://{host}"}
        assert status_of(url, host or "evil", **origin) == 404
        assert status_of(url, host or "evil", f"{path}socket", **UPGRADE, **origin) == 404
    # A page that asks for this address but has another origin.
    other = UPGRADE | {"Origin": "http://evil.example"}
    assert status_of(url, path=f"{path}socket", **other) == 403
    for guess in ("/", "/static/", "/socket", "/static/%00", "/%00", f"{path}%00", f"{path}../main.min.js"):
        assert status_of(url, path=guess) == 404


def test_the_server_ends_with_the_scene(sim_6dof):
    with serve(sim_6dof) as scene:
        mine = processes(scene)
    assert not psutil.wait_procs(mine, timeout=10)[1]
    assert not os.path.exists(scene._window.folder.name)


@pytest.mark.parametrize("data", [[], ["--data", str(URDF / "experiment_table5.csv")]])
def test_view_plays_the_measured_poses_until_it_is_interrupted(data, monkeypatch, capsys):
    opened, played = [], []

    def play(scene: Live, q: np.ndarray) -> None:
        scene.show(q[0])
        played.append(q)
        if len(played) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url) or True)
    monkeypatch.setattr(Live, "play", play)
    assert main(["view", str(URDF / "experiment.dh.toml"), "--live", *data]) == 0
    assert opened[0].startswith("http://127.0.0.1:")
    assert opened[0] in capsys.readouterr().err
    assert [q.shape for q in played] == [(8 if data else 1, 3)] * 2
