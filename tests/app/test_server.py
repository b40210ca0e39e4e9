"""Requests to the server: results of the command line, who is refused, what stays behind."""

import asyncio
import base64
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import aclosing, suppress
from urllib.parse import urlsplit

import psutil
import pytest
from app_requests import ask, example_form, form, post, start_app
from robots import ROOT, URDF

from dhcal_pin.app import command
from dhcal_pin.app.server import MAX_KEPT, Job, _Service
from dhcal_pin.app.upload import MAX_FILES, Upload
from dhcal_pin.cli.main import main
from dhcal_pin.exceptions import InvalidArgumentError


def result_of(messages):
    """The last message, which must be a result."""
    assert "result" in messages[-1], messages[-1]
    return messages[-1]


def files_of(message):
    return {file["name"]: base64.b64decode(file["content"]) for file in message["files"]}


def test_the_robot_is_that_of_the_command_line(app, example):
    body, headers = example_form(example)
    status, messages = post(app, "calibrate", body, **headers)
    assert status == 200
    message = result_of(messages)
    assert message["status"] == "done"
    files = files_of(message)
    for name in ("ur10_calibrated.urdf", "ur10_calibrated.calibration.toml", "report.html"):
        assert files[name] == (example / name).read_bytes()
    assert json.loads(files["result.json"]) == message["result"]
    assert files["scene.html"].startswith(b"<!DOCTYPE html>")
    phases = [one["phase"] for one in messages[:-1]]
    assert {"fit", "robust weights", "accuracy and verdict"} <= set(phases)
    assert app.contents() == []


def test_inspection_is_that_of_the_command_line(app, example, monkeypatch, capsys):
    body, headers = example_form(example)
    _, messages = post(app, "inspect", body, **headers)
    monkeypatch.chdir(example)
    assert main("inspect laser.csv --robot ur10.urdf --tip tool0 --json -".split()) == 0
    assert result_of(messages)["result"] == json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_refusal_names_the_remedy_and_the_remedy_works(app, example):
    lines = [line for line in (example / "laser.csv").read_text().splitlines() if line[0] != "#"]
    cells = [line.split(",") for line in lines]
    for row in cells[1:]:
        row[2] = str(-float(row[2]))
    files = {
        "ur10.urdf": (example / "ur10.urdf").read_bytes(),
        "laser.csv": "\n".join(map(",".join, cells)).encode(),
    }
    request = {"robot": "ur10.urdf", "data": ["laser.csv"], "tip": "tool0"}
    body, headers = form(files, request)
    message = result_of(post(app, "calibrate", body, **headers)[1])
    assert message["status"] == "refused"
    assert "--mend sign:elbow_joint" in message["result"]["verdict"]["reasons"][0]
    assert not any(name.endswith((".urdf", ".calibration.toml")) for name in files_of(message))
    body, headers = form(files, request | {"mend": ["sign:elbow_joint"]})
    message = result_of(post(app, "calibrate", body, **headers)[1])
    assert message["result"]["verdict"]["status"] == "ok"
    assert "ur10_calibrated.urdf" in files_of(message)


@pytest.mark.parametrize(
    ("request_changes", "words"),
    [
        ({"tip": "nowhere"}, "ur10.urdf: unknown link 'nowhere'"),
        ({"holdout": "2"}, "holdout"),
        ({"parameters": "magic"}, "'magic'"),
        ({"columns": "missing.toml"}, "missing.toml"),
        ({"data": []}, "no measurement file"),
        ({"data": ["other.csv"]}, "other.csv"),
        ({"robot": ""}, "no robot file"),
        ({"output": "/tmp/x.urdf"}, "'output': unknown option"),
        ({"tip": 3}, "'tip': unknown option or value"),
    ],
)
def test_errors_are_one_line(app, example, request_changes, words):
    body, headers = example_form(example, **request_changes)
    status, messages = post(app, "calibrate", body, **headers)
    assert status == 200
    assert list(messages[-1]) == ["error"]
    assert words in messages[-1]["error"]
    assert "\n" not in messages[-1]["error"]
    assert not messages[-1]["error"].startswith("dhcal")
    assert app.contents() == []


def test_a_measurement_file_with_the_name_of_a_result_is_to_be_renamed(app, example):
    files = {"ur10.urdf": (example / "ur10.urdf").read_bytes(), "residuals.csv": b"x"}
    body, headers = form(files, {"robot": "ur10.urdf", "data": ["residuals.csv"], "tip": "tool0"})
    error = "residuals.csv: is an input file; rename it: a result has this name"
    assert post(app, "calibrate", body, **headers)[1] == [{"error": error}]


@pytest.mark.parametrize(
    "name", ["../ur10.urdf", "a/b.urdf", "-o.urdf", ".hidden.urdf", "example:ur10", "a\\b.urdf", "x" * 300]
)
def test_file_names_cannot_be_paths_or_options(name):
    body, headers = form({name: b"", "laser.csv": b""}, {"robot": name, "data": ["laser.csv"]})
    with pytest.raises(InvalidArgumentError):
        Upload.from_form(headers["Content-Type"], body)


@pytest.mark.parametrize("body", [b"", b"--x\r\n\r\n[]\r\n--x--", b"\xff" * 100])
def test_malformed_forms_are_one_line(app, body):
    status, messages = post(app, "calibrate", body, Content_Type="multipart/form-data; boundary=x")
    assert (status, messages) == (200, [{"error": "the form is malformed; load the page again"}])


def test_only_the_own_page_of_this_computer_is_served(app, example):
    body, headers = example_form(example)
    parts = urlsplit(app.url)
    origin = f"http://{parts.netloc}"
    for other in (
        "http://evil.example",
        "null",
        "",
        f"https://{parts.netloc}",
        f"http://127.0.0.1:{parts.port}1",
    ):
        assert post(app, "calibrate", body, Origin=other, **headers)[0] == 403, other
    for host in ("evil.example", f"evil.example:{parts.port}", f"127.0.0.1.evil.example:{parts.port}"):
        for its_origin in (origin, f"http://{host}"):
            assert post(app, "calibrate", body, Host=host, Origin=its_origin, **headers)[0] == 404
    for path in ("/", "/wrong/", parts.path[:-2] + "/", f"{parts.path}calibrate/"):
        assert post(app, "calibrate", body, path=path, **headers)[0] == 404
    assert app.contents() == []
    listening = [
        connection.laddr.ip
        for connection in psutil.Process(app.process.pid).net_connections("inet")
        if connection.status == psutil.CONN_LISTEN
    ]
    assert listening == ["127.0.0.1"]


def wait_until(condition):
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def open_request(app, body, headers):
    """Connection that has sent a calibration and received its first message."""
    parts = urlsplit(app.url)
    head = f"POST {parts.path}calibrate HTTP/1.1\r\nHost: {parts.netloc}\r\nOrigin: http://{parts.netloc}\r\n"
    head += f"Content-Type: {headers['Content-Type']}\r\nContent-Length: {len(body)}\r\n\r\n"
    connection = socket.create_connection((parts.hostname, parts.port), timeout=30)
    connection.sendall(head.encode() + body)
    answer = connection.recv(1000)
    assert b"200 OK" in answer
    return connection, re.findall(rb"Job: (\S+)", answer)[0].decode()


def test_a_cancelled_run_leaves_nothing(app, example):
    body, headers = example_form(example)
    server = psutil.Process(app.process.pid)
    connection, job = open_request(app, body, headers)
    wait_until(lambda: app.contents() and server.children(recursive=True))
    assert ask(app, "DELETE", f"job/{job}", Origin="http://evil.example")[0] == 403
    assert server.children(recursive=True)
    assert ask(app, "DELETE", f"job/{job}")[:2] == (200, [])
    wait_until(lambda: not server.children(recursive=True) and app.contents() == [])
    assert "no longer kept" in ask(app, "GET", f"job/{job}")[1][0]["error"]
    connection.close()


def test_a_calibration_is_followed_again_while_it_runs_and_after_its_end(app, example):
    body, headers = example_form(example)
    connection, job = open_request(app, body, headers)
    connection.close()
    _, messages, _ = ask(app, "GET", f"job/{job}")
    assert result_of(messages)["status"] == "done"
    assert len(messages) > 3
    assert ask(app, "GET", f"job/{job}")[1] == messages
    # What a page asks for at each change is not kept.
    assert ask(app, "GET", f"job/{ask(app, 'POST', 'inspect', body, **headers)[2]}")[1] == [
        {"error": "this calibration is no longer kept; add the files and calibrate again"}
    ]
    assert ask(app, "DELETE", f"job/{job}")[0] == 200
    assert "error" in ask(app, "GET", f"job/{job}")[1][0]


def finished(coroutine):
    """Run a coroutine in a thread of its own, as the browser of other tests has an event loop in this one."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, coroutine).result()


async def endless():
    yield {"phase": "fit"}
    await asyncio.Event().wait()


def test_a_job_that_nothing_follows_is_stopped():
    async def run():
        job = Job(endless(), 0.01)
        async with aclosing(job.follow()) as one, aclosing(job.follow()) as other:
            assert await anext(one) == await anext(other) == {"phase": "fit"}
            await one.aclose()
            await asyncio.sleep(0.05)
            assert not job.task.done()
        async with aclosing(job.follow()) as again:
            await anext(again)
            await asyncio.sleep(0.05)
            assert not job.task.done()
        await asyncio.wait([job.task])
        return job.task.cancelled()

    assert finished(run())


def test_the_last_calibrations_are_kept(tmp_path):
    async def run():
        service = _Service(tmp_path, 0)
        names = []
        for _ in range(MAX_KEPT + 3):
            names.append(service.start(command.calibrate, "", bytearray()))
            await asyncio.wait([service.jobs[names[-1]].task])
        return list(service.jobs) == names[-MAX_KEPT:]

    assert finished(run())


def test_a_calculation_ends_with_a_killed_server(tmp_path, monkeypatch):
    """The system closes the pipe of a process that is killed."""
    (tmp_path / "endless.py").write_text("import time\nwhile True: time.sleep(1)\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(command, "_PROGRAM", "endless")

    async def run():
        async with command._started((), tmp_path) as process:
            assert process.stdin is not None
            process.stdin.close()
            return await asyncio.wait_for(process.wait(), 30)

    assert finished(run()) == -signal.SIGKILL


def test_the_guide_names_the_use_of_each_file():
    text = (ROOT / "docs/howto/app.md").read_text()
    for ending, (label, use) in command.OUTPUTS.items():
        assert re.search(rf"\| `\w*{re.escape(ending)}` \| {re.escape(f'{label}: {use}')} \|", text), ending


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_the_end_of_the_server_removes_everything(number, example, tmp_path):
    app = start_app(tmp_path / "app")
    body, headers = example_form(example)
    connection, _ = open_request(app, body, headers)
    server = psutil.Process(app.process.pid)
    wait_until(server.children)
    children = server.children(recursive=True)
    assert app.stop(number) == 0
    assert not psutil.wait_procs(children, timeout=10)[1]
    assert list(app.folder.iterdir()) == []
    connection.close()


def test_large_files_are_refused_before_they_are_read(tmp_path):
    app = start_app(tmp_path / "app", "--max-size", "1")
    try:
        body, headers = form(
            {"a.urdf": b" " * 3_000_000, "a.csv": b""}, {"robot": "a.urdf", "data": ["a.csv"]}
        )
        try:
            assert post(app, "calibrate", body, **headers)[0] == 400
        except ConnectionError:
            pass  # closed while the form was sent
        assert app.contents() == []
        body, headers = form({"a.urdf": b" " * 900_000, "a.csv": b""}, {"robot": "a.urdf", "data": ["a.csv"]})
        assert post(app, "calibrate", body, **headers)[0] == 200
    finally:
        assert app.stop() == 0


def begin_upload(app, path):
    """Connect to the app and send the head of an upload of 95 MB."""
    parts = urlsplit(app.url)
    connection = socket.create_connection((parts.hostname, parts.port), timeout=30)
    connection.sendall(
        f"POST {path} HTTP/1.1\r\nHost: {parts.netloc}\r\nOrigin: http://{parts.netloc}\r\n"
        "Content-Length: 95000000\r\n\r\n".encode()
    )
    return connection


def test_a_wrong_token_is_refused_by_the_header(app):
    """The answer comes before the body, none of which is kept."""
    server = psutil.Process(app.process.pid)
    before = server.memory_info().rss
    for _ in range(3):
        with begin_upload(app, "/wrong/calibrate") as connection:
            assert b" 404 " in connection.recv(1000)
            with suppress(ConnectionError):
                for _ in range(30):
                    connection.sendall(b" " * 1_000_000)
            assert server.memory_info().rss - before < 10_000_000


def test_an_interrupted_upload_leaves_no_memory(app):
    server = psutil.Process(app.process.pid)
    before = server.memory_info().rss
    for _ in range(3):
        with begin_upload(app, f"{urlsplit(app.url).path}calibrate") as connection:
            connection.sendall(bytes(40_000_000))
            wait_until(lambda: server.memory_info().rss - before > 30_000_000)
        wait_until(lambda: server.memory_info().rss - before < 10_000_000)


@pytest.mark.parametrize("path", ["", "app.js", "job/1"])
def test_a_body_where_none_belongs_is_not_kept(app, path):
    server = psutil.Process(app.process.pid)
    before = server.memory_info().rss
    with begin_upload(app, f"{urlsplit(app.url).path}{path}") as connection:
        for _ in range(40):
            connection.sendall(bytes(1_000_000))
        assert server.memory_info().rss - before < 10_000_000
    body, headers = form({"a.csv": b""}, {})
    assert post(app, path, body, **headers)[0] == 405


@pytest.mark.parametrize("n_files", [MAX_FILES + 1, 300])
def test_too_many_files_are_one_line(app, n_files):
    names = [f"{i}.csv" for i in range(n_files)]
    body, headers = form(dict.fromkeys(names, b""), {"data": names})
    status, (message,) = post(app, "inspect", body, **headers)
    assert status == 200
    assert message["error"].startswith(
        f"more than {MAX_FILES} files; instead of photographs, add the corners "
    )


@pytest.mark.parametrize(
    "request_changes",
    [{"columns": "x" * 150_000}, {"mend": ["x" * 50_000] * 40}, {"data": ["a.csv"] * 50_000}],
)
def test_options_that_no_command_line_can_hold_are_one_line(app, request_changes):
    body, headers = form({"a.csv": b""}, {"data": ["a.csv"]} | request_changes)
    message = {"error": "names and options are too long; expected at most 100 kB together"}
    assert post(app, "inspect", body, **headers) == (200, [message])


@pytest.mark.parametrize("operation", ["inspect", "calibrate", "board"])
@pytest.mark.parametrize("text", ["tool0\0", "\ud800", "tool0\nx", "\x1b[31m"])
def test_characters_that_no_command_line_can_hold_are_one_line(app, operation, text):
    for field in ("tip", "parameters", "holdout", "columns", "rig", "servos", "paper", "mend"):
        value = [text] if field == "mend" else text
        body, headers = form({"a.csv": b""}, {"robot": "a.csv", "data": ["a.csv"], field: value})
        error = f"{f'--{field}={text}'!r}: has characters that cannot be printed; remove them"
        assert post(app, operation, body, **headers) == (200, [{"error": error}])


@pytest.mark.parametrize("request_changes", [{"robot": ["a.csv"]}, {"data": [["a.csv"]]}, {"images": [{}]}])
def test_names_of_files_that_are_no_texts_are_one_line(app, request_changes):
    body, headers = form({"a.csv": b""}, {"data": ["a.csv"]} | request_changes)
    status, (message,) = post(app, "inspect", body, **headers)
    assert status == 200
    assert message["error"].endswith(": the file is missing; add it again")


def test_the_next_start_removes_the_folder_of_a_killed_server(tmp_path):
    killed, other = start_app(tmp_path / "app"), start_app(tmp_path / "app")
    folders = set(killed.folder.iterdir())
    assert len(folders) == 2
    assert killed.stop(signal.SIGKILL) == -signal.SIGKILL
    assert set(killed.folder.iterdir()) == folders
    (killed.folder / "dhcal-app-file").touch()
    (killed.folder / "dhcal-app-link").symlink_to(tmp_path)
    for folder in folders:
        # A folder that was made just now may be one that its server has not locked yet.
        os.utime(folder, (0, 0))
    assert start_app(tmp_path / "app").stop() == 0
    assert len(folders & set(killed.folder.iterdir())) == 1
    assert other.stop() == 0
    assert {path.name for path in killed.folder.iterdir()} == {"dhcal-app-file", "dhcal-app-link"}
    assert tmp_path.exists()


def test_the_address_has_a_line_of_its_own(tmp_path):
    app = start_app(tmp_path / "app")
    app.process.send_signal(signal.SIGTERM)
    assert app.first_line == f"{app.url}\n"
    # Not communicate(), which drops what readline() has read ahead.
    assert app.process.stderr is not None
    with app.process.stderr as rest:
        assert rest.read() == "end with Ctrl-C\n"
    assert app.process.wait(20) == 0


def test_a_port_in_use_is_one_line(app):
    port = str(urlsplit(app.url).port)
    for value in (port, "70000"):
        words = [sys.executable, "-m", "dhcal_pin.cli", "app", "--no-browser", "--port", value]
        run = subprocess.run(words, capture_output=True, text=True, timeout=30)
        assert run.returncode == 2
        assert run.stderr.startswith(f"dhcal: --port {value}: ")
        assert run.stderr.count("\n") == 1


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """Folder with the rig, photographs, counts and servo file of the guide."""
    folder = tmp_path_factory.mktemp("photographed")
    text = (ROOT / "docs/howto/paper_arm.md").read_text()
    rig, code = (re.findall(rf"```{name}\n(.*?)```", text, re.S)[0] for name in ("toml", "python"))
    (folder / "rig.toml").write_text(rig)
    shutil.copy(URDF / "so101.urdf", folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(code, {})
    return folder


def photograph_form(folder, count, other_files=None, **changes):
    """Form with some of the photographs and all files that belong to them."""
    files = {path.name: path.read_bytes() for path in sorted((folder / "photographs").iterdir())[:count]}
    request = {"images": list(files), "data": ["counts.csv"], "robot": "so101.urdf", "rig": "rig.toml"}
    request |= {"servos": "so101.json", "tip": "gripper_frame_link"}
    files |= {name: (folder / name).read_bytes() for name in ("so101.urdf", "rig.toml", "so101.json")}
    counts = (folder / "counts.csv").read_text().splitlines(keepends=True)
    files["counts.csv"] = "".join(counts[: 1 + count]).encode()
    return form(files | (other_files or {}), request | changes)


def test_photographs_are_searched(app, photographed):
    body, headers = photograph_form(photographed, 2)
    found, last = post(app, "inspect", body, **headers)[1]
    (board,) = found["boards"]
    assert (board["images"], board["used"]) == (2, 2)
    # The corners are checked as those of a file.
    (corners,) = last["result"]["files"]
    assert (corners["path"], corners["configurations"], corners["problem"]) == ("corners.csv", 2, "")
    rig = (photographed / "rig.toml").read_text().replace("columns = 8", "columns = 5")
    rig = rig.replace("rows = 5", "rows = 8").encode()
    body, headers = photograph_form(photographed, 2, {"rig.toml": rig}, servos="")
    found, last = post(app, "inspect", body, **headers)[1]
    assert found["notes"] == ["board paper was printed with columns = 8, rows = 5; write so in rig.toml"]
    assert "expected --servos" in last["error"]
    body, headers = photograph_form(photographed, 2, rig="")
    assert "rig" in post(app, "calibrate", body, **headers)[1][-1]["error"]


@pytest.mark.slow
def test_few_photographs_say_what_is_missing(app, photographed):
    body, headers = photograph_form(photographed, 5)
    message = result_of(post(app, "calibrate", body, **headers)[1])
    assert message["status"] == "refused"
    assert "Take at least 5 more, better 15" in message["result"]["verdict"]["reasons"][0]
    assert b"shoulder_pan[ticks]" in files_of(message)["corners.csv"]
