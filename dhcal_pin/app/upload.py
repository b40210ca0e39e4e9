"""Files and options that the page sends, checked before anything is written or started.

The names of files and the values of options become words of a command line. A file name must therefore be a
plain name, and a value is always joined to its option (`--tip=tool0`), so that none is taken for an option.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tornado.httputil

from .._frozen import frozen
from ..exceptions import InvalidArgumentError
from ..messages import quote

# Longest file name that all file systems accept [bytes].
_MAX_NAME_BYTES = 255
# Largest number of files, and longest command line that is made of a request [bytes].
MAX_FILES, _MAX_COMMAND_BYTES = 90, 100_000
# Options with one text each, by the name of their field.
_TEXT_OPTIONS = ("tip", "parameters", "holdout", "columns", "sheet", "rig", "servos", "paper")
TOO_MANY_FILES = (
    f"more than {MAX_FILES} files; instead of photographs, add the corners that `dhcal detect` finds in "
    "their folder; join the rows of several measurement files in one"
)
# Files of a request by their use, and what there is without any.
_FILE_KEYS: Mapping[str, Any] = {"robot": "", "data": [], "images": []}
# Options without a value.
_SWITCHES = ("skip-bad-rows", "force")
# Options with a list of texts.
_LIST_OPTIONS = ("mend",)


@frozen
class Upload:
    """Files and options of one request."""

    files: Mapping[str, bytes]  # Content of each file, by name
    robot: str  # Name of the robot file; empty if there is none
    # Names of the measurement files; with photographs the first one has the joint values or counts of each.
    data: tuple[str, ...]
    images: tuple[str, ...]  # Names of the photographs
    options: tuple[str, ...]  # Words of the command line

    @classmethod
    def from_form(cls, content_type: str, body: bytes) -> Upload:
        """Read a form with files named `file` and a JSON object `request`."""
        arguments: dict[str, list[bytes]] = {}
        parts: dict[str, list[tornado.httputil.HTTPFile]] = {}
        try:
            tornado.httputil.parse_body_arguments(content_type, body, arguments, parts)
            request = json.loads(arguments["request"][0])
        except (ValueError, KeyError, RecursionError, tornado.httputil.HTTPInputError) as error:
            if "too many parts" in str(error):
                raise InvalidArgumentError(TOO_MANY_FILES) from error
            raise InvalidArgumentError("the form is malformed; load the page again") from error
        if not isinstance(request, dict):
            raise InvalidArgumentError("the form is malformed; load the page again")
        if len(parts.get("file", [])) > MAX_FILES:
            raise InvalidArgumentError(TOO_MANY_FILES)
        files: dict[str, bytes] = {}
        for part in parts.get("file", []):
            name = str(part["filename"])
            _require_plain_name(name)
            if name in files:
                raise InvalidArgumentError(f"{quote(name)}: two files have this name; rename one of them")
            files[name] = part["body"]
        robot, data, images = (request.pop(key, empty) for key, empty in _FILE_KEYS.items())
        options = _option_words(request)
        if not isinstance(data, list) or not isinstance(images, list):
            raise InvalidArgumentError("the form is malformed; load the page again")
        names = [*([robot] if robot else []), *data, *images]
        if unknown := [name for name in names if not isinstance(name, str) or name not in files]:
            raise InvalidArgumentError(f"{quote(unknown[0])}: the file is missing; add it again")
        if sum(len(word.encode()) + 1 for word in (*names, *options)) > _MAX_COMMAND_BYTES:
            raise InvalidArgumentError("names and options are too long; expected at most 100 kB together")
        return cls(files, robot, tuple(data), tuple(images), options)

    def save(self, folder: Path) -> None:
        """Write the files."""
        for name, content in self.files.items():
            (folder / name).write_bytes(content)

    def option(self, name: str) -> list[str]:
        """Return the word of an option as a list; empty without it."""
        return [word for word in self.options if word.startswith(f"--{name}=")]

    def require_data(self) -> None:
        """Raise an error if there are no measurements."""
        if not self.data:
            what = (
                "table of the joint values or counts of each photograph"
                if self.images
                else "measurement file"
            )
            raise InvalidArgumentError(f"no {what}; add at least one")

    @property
    def robot_name(self) -> str:
        """Name of the robot: that of its file up to the first dot."""
        return self.robot.split(".")[0]


def _require_plain_name(name: str) -> None:
    """Raise an error if a name could be a path, an option or no file name at all."""
    is_plain = name.isprintable() and not set(name) & set("/\\:") and name[:1] not in ("", "-", ".")
    if not is_plain or len(name.encode()) > _MAX_NAME_BYTES:
        raise InvalidArgumentError(
            f"{quote(name)}: unsuitable file name; expected one that begins with a letter or a digit and has "
            f"no slash, no colon and at most {_MAX_NAME_BYTES} bytes"
        )


def _option_words(request: Mapping[str, Any]) -> tuple[str, ...]:
    """Write options as words of a command line."""
    words: list[str] = []
    for name, value in request.items():
        if name in _TEXT_OPTIONS and isinstance(value, str):
            words += [f"--{name}={value}"] if value else []
        elif name in _SWITCHES and isinstance(value, bool):
            words += [f"--{name}"] if value else []
        elif name in _LIST_OPTIONS and isinstance(value, list) and all(isinstance(v, str) for v in value):
            words += [f"--{name}={v}" for v in value]
        else:
            raise InvalidArgumentError(f"{quote(name)}: unknown option or value; load the page again")
    for word in words:
        # No command line holds a NUL character or half of a surrogate pair.
        if not word.isprintable():
            raise InvalidArgumentError(f"{quote(word)}: has characters that cannot be printed; remove them")
    return tuple(words)
