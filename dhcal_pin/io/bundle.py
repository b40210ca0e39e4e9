"""Bundles: one file with the inputs, the options and the outputs of a calibration.

A bundle is a zip file whose name ends with `.dhcal.zip`:

    manifest.json       options, versions, joints of the robot, and the SHA-256 of all other members
    result.json         result of the calibration, as `--json` writes it, with the names of its files
    inputs/NAME         files that the calibration read
    outputs/NAME        files that it wrote

In the options, paths are the names of members without their folder. The comment of the zip file is the
SHA-256 of `manifest.json`. All members have the same time stamp, so that equal content gives equal bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any

from .._frozen import frozen
from .._typing import PathLike
from ..exceptions import FileFormatError
from ..messages import quote
from .tabular import unreadable

# End of the names of bundles.
ENDING = ".dhcal.zip"
FORMAT, VERSION = "dhcal bundle", 1
MANIFEST, RESULT, INPUTS, OUTPUTS = "manifest.json", "result.json", "inputs/", "outputs/"
# Largest content of all members together [byte], and largest number of members.
MAX_BYTES, MAX_MEMBERS = 1 << 30, 10_000
# Time stamp of all members, the earliest one of zip files, and their permissions.
_TIME, _MODE = (1980, 1, 1, 0, 0, 0), 0o644 << 16
# Types of the entries of a manifest.
_TYPES = {"options": dict, "versions": dict, "joints": list, "tip": str, "sha256": dict}


@frozen
class Bundle:
    """Content of a bundle."""

    options: Mapping[str, Any]  #: Options of the calibration that differ from their defaults.
    versions: Mapping[str, str]  #: Versions of the packages that computed it.
    joints: tuple[str, ...]  #: Names of the robot's joints.
    tip: str  #: Tip of the chain.
    result: Mapping[str, Any]  #: Result, as the JSON document has it.
    inputs: Mapping[str, bytes]  #: Files that were read, by name.
    outputs: Mapping[str, bytes]  #: Files that were written, by name.

    @property
    def members(self) -> dict[str, bytes]:
        """Contents of all members except the manifest."""
        return {
            RESULT: _json_bytes(self.result),
            **{INPUTS + name: data for name, data in self.inputs.items()},
            **{OUTPUTS + name: data for name, data in self.outputs.items()},
        }

    @property
    def digests(self) -> dict[str, str]:
        """SHA-256 of all members except the manifest."""
        return {name: hashlib.sha256(data).hexdigest() for name, data in sorted(self.members.items())}


def is_bundle(path: PathLike) -> bool:
    """Tell a bundle from other files by its name."""
    return str(path).lower().endswith(ENDING)


def bundle_bytes(bundle: Bundle) -> bytes:
    """Return the content of the file of a bundle."""
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "options": dict(bundle.options),
        "versions": dict(bundle.versions),
        "joints": list(bundle.joints),
        "tip": bundle.tip,
        "sha256": bundle.digests,
    }
    text = _json_bytes(manifest)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in {MANIFEST: text, **dict(sorted(bundle.members.items()))}.items():
            info = zipfile.ZipInfo(name, _TIME)
            info.compress_type, info.external_attr, info.create_system = zipfile.ZIP_DEFLATED, _MODE, 3
            archive.writestr(info, data, compresslevel=9)
        archive.comment = hashlib.sha256(text).hexdigest().encode()
    return out.getvalue()


def read_bundle(path: PathLike) -> Bundle:
    """Read a bundle and check that nothing in it was changed."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = _read_members(archive, path)
            comment = archive.comment
    except FileFormatError:
        raise
    except OSError as error:
        raise unreadable(path, error, "a bundle") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, ValueError) as error:
        raise FileFormatError(f"{path}: not a bundle or damaged: {error}; expected a zip file") from error
    text = members.pop(MANIFEST, b"")
    manifest = _read_manifest(text, path)
    changed = f"{path}: %s was changed after the calibration; expected the bundle as it was written"
    for name in sorted({*manifest["sha256"], *members}):
        data = members.get(name)
        if data is None or hashlib.sha256(data).hexdigest() != manifest["sha256"].get(name):
            raise FileFormatError(changed % quote(name))
    if hashlib.sha256(text).hexdigest().encode() != comment:
        raise FileFormatError(changed % quote(MANIFEST))
    result = _json_object(members.get(RESULT, b""))
    if result is None:
        raise FileFormatError(f"{path}: no {RESULT}; expected a bundle of `dhcal calibrate --bundle`")
    inputs, outputs = (
        {name.removeprefix(folder): data for name, data in members.items() if name.startswith(folder)}
        for folder in (INPUTS, OUTPUTS)
    )
    names = {name: manifest[name] for name in ("options", "versions", "tip")}
    return Bundle(**names, joints=tuple(manifest["joints"]), result=result, inputs=inputs, outputs=outputs)


def _json_bytes(content: Any) -> bytes:
    """Return the text of a JSON document as members have it."""
    return json.dumps(content, indent=2).encode()


def _json_object(data: bytes) -> dict[str, Any] | None:
    """Return the object of a JSON document, None if there is none."""
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def _read_members(archive: zipfile.ZipFile, path: PathLike) -> dict[str, bytes]:
    """Read all members of a zip file, whose names must be safe and whose size is limited."""
    infos = archive.infolist()
    for info in infos:
        # `ZipInfo` replaces separators of this system; the original name shows them.
        name = info.orig_filename
        parts = name.split("/")
        if (
            not name
            or "\\" in name
            or "\0" in name
            or ":" in parts[0]
            or not {"", ".", ".."}.isdisjoint(parts)
        ):
            raise FileFormatError(
                f"{path}: unsafe name of a member: {quote(name)}; expected names inside the bundle"
            )
    if len({info.orig_filename for info in infos}) < len(infos):
        raise FileFormatError(f"{path}: two members have the same name; expected different names")
    if len(infos) > MAX_MEMBERS or sum(info.file_size for info in infos) > MAX_BYTES:
        raise FileFormatError(
            f"{path}: its content is too large; expected at most {MAX_MEMBERS} files, {MAX_BYTES >> 20} MiB"
        )
    members = {}
    for info in infos:
        with archive.open(info) as file:
            # The stated size may be wrong.
            members[info.orig_filename] = file.read(info.file_size + 1)
        if len(members[info.orig_filename]) != info.file_size:
            raise FileFormatError(
                f"{path}: the size of {quote(info.orig_filename)} is wrong; expected a bundle"
            )
    return members


def _read_manifest(data: bytes, path: PathLike) -> dict[str, Any]:
    """Read the manifest of a bundle."""
    manifest = _json_object(data) or {}
    has_types = all(isinstance(manifest.get(key), kind) for key, kind in _TYPES.items())
    if manifest.get("format") != FORMAT or not has_types:
        raise FileFormatError(
            f"{path}: no manifest of a bundle; expected a bundle of `dhcal calibrate --bundle`"
        )
    if manifest.get("version") != VERSION:
        raise FileFormatError(
            f"{path}: version {quote(str(manifest.get('version')))} of the format; expected {VERSION}"
        )
    return manifest
