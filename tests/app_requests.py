"""Requests to `dhcal app` in a process of its own."""

import json
import os
import re
import secrets
import signal
import subprocess
import sys
from contextlib import closing
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

# Command of the README without its outputs, and the options of a request with the same meaning.
CALIBRATE = "calibrate ur10.urdf laser.csv --tip tool0 --holdout 0.3".split()
REQUEST = {"robot": "ur10.urdf", "data": ["laser.csv"], "tip": "tool0", "holdout": "0.3"}


@dataclass(frozen=True)
class App:
    """Server in a process of its own; its temporary files are in a folder of their own."""

    process: subprocess.Popen[str]
    url: str
    folder: Path
    first_line: str

    def contents(self) -> list[Path]:
        """Everything in the temporary folder but the empty folder of the server."""
        return list(self.folder.glob("*/*"))

    def stop(self, number: int = signal.SIGTERM) -> int:
        """End the server and return its exit status."""
        self.process.send_signal(number)
        self.process.communicate(timeout=20)
        return self.process.returncode


def start_app(folder: Path, *options: str) -> App:
    folder.mkdir(exist_ok=True)
    process = subprocess.Popen(
        [sys.executable, "-m", "dhcal_pin.cli", "app", "--no-browser", *options],
        env=os.environ | {"TMPDIR": str(folder)},
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    line = process.stderr.readline()
    url = re.search(r"http://\S+/", line)
    assert url, line
    return App(process, url[0], folder, line)


def form(files: dict[str, bytes], request: Any) -> tuple[bytes, dict[str, str]]:
    """A form as a browser sends it, and its headers."""
    mark = secrets.token_hex(16)
    parts = [
        f'--{mark}\r\nContent-Disposition: form-data; name="request"\r\n\r\n'.encode(),
        f"{json.dumps(request)}\r\n".encode(),
    ]
    for name, content in files.items():
        head = f'--{mark}\r\nContent-Disposition: form-data; name="file"; filename="{name}"\r\n\r\n'
        parts += [head.encode(), content, b"\r\n"]
    body = b"".join([*parts, f"--{mark}--\r\n".encode()])
    return body, {"Content-Type": f"multipart/form-data; boundary={mark}"}


def post(
    app: App, operation: str, body: bytes = b"", path: str | None = None, **headers: str
) -> tuple[int, list[Any]]:
    """Status and messages of a form with the headers of the app's own page, unless others are given."""
    return ask(app, "POST", operation, body, path, **headers)[:2]


def ask(
    app: App, method: str, operation: str, body: bytes = b"", path: str | None = None, **headers: str
) -> tuple[int, list[Any], str]:
    """Status, messages and job of a request."""
    parts = urlsplit(app.url)
    all_headers = {"Host": parts.netloc, "Origin": f"http://{parts.netloc}", "Content-Length": str(len(body))}
    all_headers |= {name.replace("_", "-"): value for name, value in headers.items()}
    connection = HTTPConnection(parts.hostname or "", parts.port, timeout=60)
    with closing(connection):
        connection.putrequest(method, (parts.path if path is None else path) + operation, skip_host=True)
        for name, value in all_headers.items():
            if value:
                connection.putheader(name, value)
        connection.endheaders(body)
        answer = connection.getresponse()
        text = answer.read().decode()
        messages = [json.loads(line) for line in text.splitlines()] if answer.status == 200 else [text]
        return answer.status, messages, answer.headers.get("Job", "")


def example_form(example: Path, **request: Any) -> tuple[bytes, dict[str, str]]:
    files = {name: (example / name).read_bytes() for name in ("ur10.urdf", "laser.csv")}
    return form(files, REQUEST | request)
