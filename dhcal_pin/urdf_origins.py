"""Joint origins of a URDF rewritten in place: every other byte of the file stays as it is."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from .errors import DhcalError
from .se3 import Array
from .urdf import MAX_ORIGIN, Urdf, UrdfJoint

_RIGID = 1e-9  # how far from orthonormal a rotation may be before it is no rotation
_ELEMENT = re.compile(rb"<[^ \t\r\n/>]+")
_ATTRIBUTE = re.compile(rb"""[ \t\r\n]+([^ \t\r\n=/>]+)[ \t\r\n]*=[ \t\r\n]*("[^"]*"|'[^']*')""")
_INDENT = re.compile(rb"(?:\r\n|\n|\r)[ \t]*\Z")


def _attributes(data: bytes, start: int) -> tuple[dict[bytes, tuple[int, int]], int, bytes]:
    """Of the tag at `start`: each value's span between its quotes, where the last ends, a quote.

    The tag is known to be well-formed; expat gives its offset, but values only after normalising them.
    """
    element = _ELEMENT.match(data, start)
    assert element is not None, "expat found a tag here"
    spans, end, quote = {}, element.end(), b""
    while found := _ATTRIBUTE.match(data, end):
        spans[found[1]] = found.start(2) + 1, found.end(2) - 1
        end, quote = found.end(), found[2][:1]
    return spans, end, quote


def _edits(urdf: Urdf, joint: UrdfJoint, origin: Array) -> list[tuple[int, int, bytes]]:
    """The (start, end, new bytes) that give a joint a new origin (4, 4)."""
    u, _, vt = np.linalg.svd(origin[:3, :3])
    rpy, old = pin.rpy.matrixToRpy(u @ vt), joint.origin
    texts = {
        key: " ".join(repr(float(x) + 0.0) for x in value).encode()  # + 0.0 turns -0.0 into 0.0
        for key, value, same in (
            (b"xyz", origin[:3, 3], np.array_equal(origin[:3, 3], old[:3, 3])),
            (b"rpy", rpy, np.array_equal(origin[:3, :3], old[:3, :3])),
        )
        if not (same and joint.origin_start is not None)
    }
    joint_quote = _attributes(urdf.data, joint.start)[2]
    if joint.origin_start is None:
        at, quote = joint.first_child, joint_quote
        inner = b"".join(b" " + key + b"=" + quote + text + quote for key, text in texts.items())
        indent = _INDENT.search(urdf.data, joint.start, at)
        return [(at, at, b"<origin" + inner + b"/>" + (indent[0] if indent else b""))]
    spans, end, quote = _attributes(urdf.data, joint.origin_start)
    quote = quote or joint_quote
    return [
        (*spans[key], text) if key in spans else (end, end, b" " + key + b"=" + quote + text + quote)
        for key, text in texts.items()
    ]


def with_origins(urdf: Urdf, origins: Mapping[str, Array]) -> bytes:
    """The URDF's bytes with new joint origins; every other byte stays as it is.

    Args:
        urdf: the file to start from.
        origins: by joint name the (4, 4) pose of the joint frame in its parent link, metres. Its
            position and rotation are each rewritten only if they differ from the file's.

    Raises:
        DhcalError: an unknown joint, or an origin that is no finite rigid motion.
    """
    edits: list[tuple[int, int, bytes]] = []
    for name, value in origins.items():
        joint, origin = urdf.joint(name), np.asarray(value, float)
        where = f"{urdf.source}:{joint.line}: joint {name!r}: its new origin"
        if origin.shape != (4, 4) or not np.isfinite(origin).all():
            raise DhcalError(f"{where} must be a (4, 4) matrix of finite numbers")
        rotation = origin[:3, :3]
        if (
            np.abs(origin).max() > MAX_ORIGIN
            or np.abs(origin[3] - (0, 0, 0, 1)).max() > _RIGID
            or np.abs(rotation.T @ rotation - np.eye(3)).max() > _RIGID
            or np.linalg.det(rotation) < 0
        ):
            raise DhcalError(f"{where} must be a rotation and a translation within {MAX_ORIGIN:g} m")
        if not np.array_equal(origin, joint.origin):
            edits += _edits(urdf, joint, origin)
    out, done = [], 0
    # Stable: two attributes inserted at the same place keep their order.
    for start, end, text in sorted(edits, key=lambda edit: edit[0]):
        out += [urdf.data[done:start], text]
        done = end
    return b"".join([*out, urdf.data[done:]])
