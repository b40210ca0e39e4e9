"""Server of the page: accepts files from this computer's browser, runs a command, streams its messages.

The answer to a request has one JSON message per line (see `command`). The calculation belongs to the request:
when the browser closes the connection, it is stopped and its folder is removed. Requests do not share
anything, so several browsers can work at once.
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
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import tornado.httpserver
import tornado.iostream
import tornado.netutil
import tornado.web

from ..exceptions import DhcalError, InvalidArgumentError
from ..io.shipped_files import shipped_file
from ..loopback import LOOPBACK, is_same_origin, local_application, new_token
from ..messages import message_line
from . import command
from .upload import MAX_FILES, Upload

# Default limit of all files of a request [bytes].
DEFAULT_LIMIT = 100 * 10**6
# Largest number of calculations at once; each needs a processor and memory.
MAX_RUNS = 4
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
    """Create the locked folder of this server, and remove those of servers that were killed.

    The system releases the lock of a process that is killed.
    """
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


class _Service:
    """What the requests share.

    Attributes:
        folder: Folder in which each calculation has a folder of its own.
        limit: Largest size of all files of a request [bytes].
        tasks: Calculations that are running.
    """

    def __init__(self, folder: Path, limit: int) -> None:
        self.folder = folder
        self.limit = limit
        self.tasks: set[asyncio.Task[None]] = set()

    async def stop(self) -> None:
        """Stop all calculations and wait until their folders are removed."""
        for task in self.tasks:
            task.cancel()
        await asyncio.gather(*self.tasks, return_exceptions=True)


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
        *((path, _PageHandler, {"file": file, "limit": service.limit}) for path, file in pages.items()),
        *(
            (path, _RunHandler, {"service": service, "operation": operation})
            for path, operation in operations.items()
        ),
    ]


class _Handler(tornado.web.RequestHandler):
    """Handler whose answers are not stored, and that answers an error with one line of text."""

    def set_default_headers(self) -> None:
        for name, value in _HEADERS.items():
            self.set_header(name, value)
        self.clear_header("Server")

    def write_error(self, status_code: int, **_: Any) -> None:
        self.finish(f"{status_code}: {self._reason}\n")


class _PageHandler(_Handler):
    def initialize(self, file: str, limit: int) -> None:
        self._path = _PAGE_FOLDER / file
        self._limit = limit

    def get(self) -> None:
        self.set_header("Content-Type", f"{_TYPES[self._path.suffix]}; charset=utf-8")
        text = self._path.read_text(encoding="utf-8")
        text = text.replace("@LIMIT_BYTES@", str(self._limit)).replace("@MAX_FILES@", str(MAX_FILES))
        self.write(text)


class _ExampleHandler(_Handler):
    """Files of an example by name: photographs of a servo arm, whose corners were found, and its tip link."""

    def get(self) -> None:
        paths = [Path(shipped_file("so101.urdf")), *sorted((_PAGE_FOLDER / "example").iterdir())]
        files = {path.name: path.read_text(encoding="utf-8") for path in paths}
        self.write({"files": files, "tip": "gripper_frame_link"})


@tornado.web.stream_request_body
class _RunHandler(_Handler):
    """Runs one operation on the files of a form."""

    def initialize(self, service: _Service, operation: Operation) -> None:
        self._service = service
        self._operation = operation
        self._body = bytearray()
        self._task: asyncio.Task[None] | None = None

    def prepare(self) -> None:
        # Before the files arrive.
        if not is_same_origin(self.request):
            raise tornado.web.HTTPError(403, reason="this page may not send files to dhcal")

    def data_received(self, chunk: bytes) -> None:
        self._body += chunk

    async def post(self) -> None:
        self.set_header("Content-Type", "application/x-ndjson")
        if len(self._service.tasks) >= MAX_RUNS:
            await self._send({"error": f"{MAX_RUNS} calculations are running; wait until one of them ends"})
            return
        self._task = asyncio.create_task(self._run())
        self._service.tasks.add(self._task)
        try:
            await self._task
        except asyncio.CancelledError:
            # The browser is gone, or the server stops.
            pass
        finally:
            self._service.tasks.discard(self._task)

    def on_connection_close(self) -> None:
        if self._task:
            self._task.cancel()

    async def _run(self) -> None:
        """Send all messages of the operation."""
        try:
            try:
                upload = Upload.from_form(self.request.headers.get("Content-Type", ""), bytes(self._body))
            finally:
                self._body.clear()
            with TemporaryDirectory(dir=self._service.folder) as name:
                folder = Path(name)
                upload.save(folder)
                async with aclosing(self._operation(upload, folder)) as messages:
                    async for message in messages:
                        await self._send(message)
        except DhcalError as error:
            await self._send({"error": message_line(error)})

    async def _send(self, message: dict[str, Any]) -> None:
        self.write(json.dumps(message) + "\n")
        with suppress(tornado.iostream.StreamClosedError):
            await self.flush()
