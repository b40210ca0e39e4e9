"""Server of the page: accepts files from this computer's browser, runs a command, streams its messages.

The answer to a request has one JSON message per line (see `command`). The request starts a job, whose folder
is removed at its end. A job that no request follows is stopped. The header `Job` of a calibration names its
job: a page that is loaded again follows it, from the first message, while it runs and after its end.
"""

from __future__ import annotations

import asyncio
import fcntl
import json
import os
import shutil
import signal
import time
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import aclosing, contextmanager, suppress
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import tornado.httpserver
import tornado.iostream
import tornado.locks
import tornado.netutil
import tornado.web

from ..exceptions import DhcalError, InvalidArgumentError
from ..formatting import capitalized
from ..io.shipped_files import shipped_file
from ..loopback import LOOPBACK, is_same_origin, local_application, new_token
from ..messages import message_line
from . import command
from .upload import MAX_FILES, TOO_MANY_FILES, Upload

# Default limit of all files of a request [bytes].
DEFAULT_LIMIT = 100 * 10**6
# Largest number of calculations at once; each needs a processor and memory.
MAX_RUNS = 4
# Number of calibrations whose messages are kept after their end.
MAX_KEPT = 8
# Time that a page may take to load again before its calibration is stopped [s].
RELOAD_S = 10.0
# Largest number of a port.
MAX_PORT = 65535
# Largest part of a form that contains no file content [bytes].
_FORM_BYTES = 10**6

# Start of the names of the servers' folders in the folder for temporary files.
_FOLDER_PREFIX = "dhcal-app-"
# Age of a folder from which its server has locked it [s]; it does so at once.
_LOCKED_AGE_S = 0.5

_PAGE_FOLDER = Path(__file__).parent
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
# A report is opened from memory and inherits this policy. Its scripts are part of its text and therefore
# allowed. Nothing can be loaded from or sent to another server.
_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
    "img-src data: blob:; connect-src 'self'; frame-src 'self' blob:; form-action 'none'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": _POLICY,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}

Operation = Callable[[Upload, Path], AsyncGenerator[dict[str, Any], None]]


async def serve(show_address: Callable[[str], object], *, port: int = 0, limit: int = DEFAULT_LIMIT) -> None:
    """Serve the page until this process is interrupted or terminated.

    `show_address` gets the address when the server is ready. Port 0 means any free one. `limit` is the
    largest size of all files of a request [bytes].
    """
    if not 0 <= port <= MAX_PORT:
        raise InvalidArgumentError(f"--port {port}: expected a number from 0 to {MAX_PORT}")
    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, stopped.set)
    token = new_token()
    with _server_folder() as folder:
        service = _Service(folder, limit)
        server = tornado.httpserver.HTTPServer(
            local_application(token, _routes(service)), max_body_size=limit + _FORM_BYTES
        )
        try:
            sockets = tornado.netutil.bind_sockets(port, LOOPBACK)
        except OSError as error:
            raise InvalidArgumentError(f"--port {port}: {error.strerror}; choose another port") from error
        server.add_sockets(sockets)
        show_address(f"http://{LOOPBACK}:{sockets[0].getsockname()[1]}/{token}/")
        await stopped.wait()
        server.stop()
        await service.stop()
        await server.close_all_connections()


@contextmanager
def _server_folder() -> Iterator[Path]:
    """Create the locked folder of this server; remove those of killed servers, which hold no lock."""
    for other in Path(gettempdir()).glob(f"{_FOLDER_PREFIX}*"):
        with suppress(OSError):
            state = other.lstat()
            if state.st_uid == os.getuid() and time.time() - state.st_mtime > _LOCKED_AGE_S:
                with _locked(other):
                    shutil.rmtree(other, ignore_errors=True)
    with TemporaryDirectory(prefix=_FOLDER_PREFIX) as name, _locked(Path(name)):
        yield Path(name)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder; `OSError` if another server has locked it, or if it is no folder."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


class Job:
    """Run of an operation: its messages, and the requests that follow it."""

    def __init__(self, messages: AsyncGenerator[dict[str, Any], None], patience: float) -> None:
        """Start a run; it is stopped when nothing has followed it for `patience` seconds."""
        self._patience = patience
        self._messages: list[dict[str, Any] | None] = []
        self._grown = tornado.locks.Condition()
        self._n_followers = 0
        self.task = asyncio.create_task(self._collect(messages))

    async def _collect(self, messages: AsyncGenerator[dict[str, Any], None]) -> None:
        """Keep all messages, and None after the last one."""
        try:
            async with aclosing(messages):
                async for message in messages:
                    self._add(message)
        except DhcalError as error:
            self._add({"error": message_line(error)})
        finally:
            self._add(None)

    def _add(self, message: dict[str, Any] | None) -> None:
        """Keep a message and wake those who wait for it."""
        self._messages.append(message)
        self._grown.notify_all()

    async def follow(self) -> AsyncGenerator[dict[str, Any], None]:
        """Yield all messages, from the first one to the end of the run."""
        self._n_followers += 1
        try:
            for number in count():
                if number == len(self._messages):
                    await self._grown.wait()
                message = self._messages[number]
                if message is None:
                    return
                yield message
        finally:
            self._n_followers -= 1
            asyncio.get_running_loop().call_later(self._patience, self._stop_if_left)

    def _stop_if_left(self) -> None:
        """Stop the run if nothing follows it."""
        if not self._n_followers:
            self.task.cancel()


class _Service:
    """What the requests share."""

    def __init__(self, folder: Path, limit: int) -> None:
        self.folder = folder  # Folder in which each calculation has a folder of its own
        self.limit = limit  # Largest size of all files of a request [bytes]
        self.jobs: dict[str, Job] = {}  # Jobs that run, and calibrations that have ended, by their names

    def start(self, operation: Operation, content_type: str, body: bytearray) -> str:
        """Start an operation on the files of a form, and return the name of its job."""
        ended = [name for name, job in self.jobs.items() if job.task.done()]
        if len(self.jobs) - len(ended) >= MAX_RUNS:
            raise InvalidArgumentError(f"{MAX_RUNS} calculations are running; wait until one of them ends")
        for name in ended[: -MAX_KEPT + 1]:
            del self.jobs[name]
        name = new_token()
        is_kept = operation is command.calibrate
        job = Job(self._messages(operation, content_type, body), RELOAD_S if is_kept else 0)
        self.jobs[name] = job
        job.task.add_done_callback(lambda task: self._remove(name, is_kept, task))
        return name

    def _remove(self, name: str, is_kept: bool, task: asyncio.Task[None]) -> None:
        """Forget a job that has ended, unless a page may ask for its messages again."""
        if task.cancelled() or not is_kept:
            self.jobs.pop(name, None)

    async def _messages(
        self, operation: Operation, content_type: str, body: bytearray
    ) -> AsyncGenerator[dict[str, Any], None]:
        """Yield the messages of an operation on the files of a form."""
        try:
            upload = Upload.from_form(content_type, bytes(body))
        finally:
            body.clear()
        with TemporaryDirectory(dir=self.folder) as name:
            upload.save(Path(name))
            async with aclosing(operation(upload, Path(name))) as messages:
                async for message in messages:
                    yield message

    async def stop(self) -> None:
        """Stop all jobs and wait until their folders are removed."""
        tasks = [job.task for job in self.jobs.values()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _routes(service: _Service) -> list[tuple[Any, ...]]:
    """List the paths of the server."""
    pages = {"": "app.html", "app.css": "app.css", "app.js": "app.js"}
    operations: dict[str, Operation] = {
        "inspect": command.inspect,
        "calibrate": command.calibrate,
        "board": command.board,
    }
    return [
        ("example", _ExampleHandler),
        (r"job/([\w-]+)", _JobHandler, {"service": service}),
        *((path, _PageHandler, {"file": file, "limit": service.limit}) for path, file in pages.items()),
        *(
            (path, _RunHandler, {"service": service, "operation": operation})
            for path, operation in operations.items()
        ),
    ]


@tornado.web.stream_request_body
class _Handler(tornado.web.RequestHandler):
    """Handler that drops the request body. Its answers are not stored, and an error is one line of text."""

    def set_default_headers(self) -> None:
        for name, value in _HEADERS.items():
            self.set_header(name, value)
        self.clear_header("Server")

    def write_error(self, status_code: int, **_: Any) -> None:
        self.finish(f"{status_code}: {self._reason}\n")

    def data_received(self, chunk: bytes) -> None:
        pass


class _PageHandler(_Handler):
    def initialize(self, file: str, limit: int) -> None:
        self._path = _PAGE_FOLDER / file
        self._limit = limit

    def get(self) -> None:
        self.set_header("Content-Type", f"{_TYPES[self._path.suffix]}; charset=utf-8")
        text = self._path.read_text(encoding="utf-8")
        text = text.replace("@LIMIT_BYTES@", str(self._limit)).replace("@MAX_FILES@", str(MAX_FILES))
        text = text.replace("@TOO_MANY_FILES@", f"{capitalized(TOO_MANY_FILES)}.")
        self.write(text)


class _ExampleHandler(_Handler):
    """Files of an example by name: photographs of a servo arm, whose corners were found, and its tip link."""

    def get(self) -> None:
        paths = [Path(shipped_file("so101.urdf")), *sorted((_PAGE_FOLDER / "example").iterdir())]
        files = {path.name: path.read_text(encoding="utf-8") for path in paths}
        self.write({"files": files, "tip": "gripper_frame_link"})


class _FollowHandler(_Handler):
    """Handler whose answer has the messages of a job."""

    _answer: asyncio.Task[None] | None = None

    def prepare(self) -> None:
        # Before the files arrive. A browser does not send the origin of a request that only reads.
        if self.request.method != "GET" and not is_same_origin(self.request):
            raise tornado.web.HTTPError(403, reason="this page may not send files to dhcal")
        self.set_header("Content-Type", "application/x-ndjson")

    def on_connection_close(self) -> None:
        super().on_connection_close()
        if self._answer:
            self._answer.cancel()

    async def _follow(self, job: Job) -> None:
        """Send all messages of a job, until its end or until the browser is gone."""
        self._answer = asyncio.create_task(self._send_all(job))
        with suppress(asyncio.CancelledError):
            await self._answer

    async def _send_all(self, job: Job) -> None:
        """Send the name and all messages of a job."""
        async with aclosing(job.follow()) as messages:
            await self._flush()
            async for message in messages:
                await self._send(message)

    async def _send(self, message: dict[str, Any]) -> None:
        """Send a message."""
        self.write(json.dumps(message) + "\n")
        await self._flush()

    async def _flush(self) -> None:
        """Send what was written, if the browser is still there."""
        with suppress(tornado.iostream.StreamClosedError):
            await self.flush()


class _RunHandler(_FollowHandler):
    """Runs one operation on the files of a form."""

    def initialize(self, service: _Service, operation: Operation) -> None:
        self._service = service
        self._operation = operation
        self._body = bytearray()

    def data_received(self, chunk: bytes) -> None:
        self._body += chunk

    def on_connection_close(self) -> None:
        super().on_connection_close()
        self._body.clear()

    async def post(self) -> None:
        try:
            name = self._service.start(
                self._operation, self.request.headers.get("Content-Type", ""), self._body
            )
        except DhcalError as error:
            await self._send({"error": message_line(error)})
            return
        self.set_header("Job", name)
        await self._follow(self._service.jobs[name])


class _JobHandler(_FollowHandler):
    """Follows a job from its first message, or stops it."""

    def initialize(self, service: _Service) -> None:
        self._service = service

    async def get(self, name: str) -> None:
        if job := self._service.jobs.get(name):
            await self._follow(job)
        else:
            text = "this calibration is no longer kept; add the files and calibrate again"
            await self._send({"error": text})

    def delete(self, name: str) -> None:
        job = self._service.jobs.get(name)
        if job and not job.task.cancel():
            del self._service.jobs[name]
