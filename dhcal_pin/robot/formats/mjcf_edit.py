"""Edits of an MJCF that keep every other byte of the file.

`with_origins` rewrites `pos` and the orientation of the bodies and sites that hold the origins of joints. An
orientation is written as `quat`, in the place of the attribute that stated it before: it has all digits in
every pose. A translation or rotation that is unchanged keeps its text.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping

import numpy as np
import pinocchio as pin

from ... import se3
from ..._typing import Array
from ...exceptions import InvalidArgumentError
from ...messages import quote
from ..urdf import UrdfJoint
from ..urdf_edit import changed_origins
from .mjcf import ORIENTATIONS, Mjcf
from .xml_tags import Edit, attribute_edit, attribute_spans, attribute_text, edited, number_text


def require_writable(mjcf: Mjcf, joints: Iterable[str]) -> None:
    """Raise an error if the file cannot hold new origins of some joints."""
    for name in joints:
        if name in mjcf.fixed_origins:
            raise InvalidArgumentError(
                f"{mjcf.source}:{mjcf.joint(name).line}: joint {quote(name)}: not the first joint of its "
                "body; its origin cannot be written, so give each joint a body of its own"
            )


def with_origins(mjcf: Mjcf, origins: Mapping[str, Array]) -> bytes:
    """Return the bytes of an MJCF with new joint origins."""
    changed = list(changed_origins(mjcf, origins))
    require_writable(mjcf, (joint.name for joint, _ in changed))
    return edited(mjcf.file, itertools.chain.from_iterable(_pose_edits(mjcf, *item) for item in changed))


def _pose_edits(mjcf: Mjcf, joint: UrdfJoint, origin: Array) -> list[Edit]:
    """Return the edits that give a joint a new origin, shape (4, 4)."""
    place = mjcf.places[joint.name]
    pose = se3.inverse(place.before) @ origin @ se3.inverse(place.after)
    has_same_rotation = np.array_equal(origin[:3, :3], joint.origin[:3, :3])
    has_same_position = np.array_equal(origin[:3, 3], joint.origin[:3, 3])
    spans, end, quotes = attribute_spans(mjcf.file, place.tag.start)
    quotes = quotes or b'"'
    edits = []
    if not (has_same_position and (has_same_rotation or not place.after[:3, 3].any())):
        edits.append(attribute_edit(spans, end, b"pos", number_text(pose[:3, 3]), quotes))
    if not has_same_rotation:
        quat = pin.Quaternion(se3.nearest_rotation(pose[:3, :3]))
        # The scalar part is first in MJCF. A quaternion and its negative are the same rotation.
        values = np.array([quat.w, *quat.vec()])
        text = number_text(-values if values[np.argmax(np.abs(values))] < 0 else values)
        given = next((spans[key.encode()] for key in ORIENTATIONS if key.encode() in spans), None)
        if given is None:
            edits.append(Edit(end, end, attribute_text(b"quat", text, quotes)))
        else:
            edits += [Edit(*given.name, b"quat"), Edit(*given.value, text)]
    return edits
