"""What a sidecar keeps of a calibration's uncertainty: its table `[uncertainty]`."""

from __future__ import annotations

import base64
import binascii
import json
from typing import Any

import numpy as np

from .chain import Chain
from .errors import DhcalError
from .files import PathLike, read_toml
from .parameters import EXTENSIONS, SETS
from .se3 import Array
from .transmission import Transmission
from .uncertainty import Uncertainty

_KEYS = ("joints", "terms", "root", "hidden")
_COLUMNS = 76


def uncertainty_lines(known: Uncertainty) -> list[str]:
    """The TOML lines of an uncertainty; none where no noise could be told, and so nothing is known of it."""
    if not np.isfinite(known.root).all():
        return []
    names = {entry: name for name, entry in _entries(known.chain).items()}
    terms = [names[int(entry)] for entry in known.entries]
    out = [
        "",
        "# Roots of the errors' covariance, and directions that nothing tells, by rows: six of each link's",
        "# motion (m, rad; the base's in the measuring frame), then the terms; doubles, base64.",
        "[uncertainty]",
        f"joints = {json.dumps(list(known.chain.moving), ensure_ascii=False)}",
        f"terms = {json.dumps(terms, ensure_ascii=False)}",
    ]
    for key, rows in (("root", known.root), ("hidden", known.hidden)):
        text = base64.b64encode(np.ascontiguousarray(rows, "<f8").tobytes()).decode()
        wrapped = [text[i : i + _COLUMNS] for i in range(0, len(text), _COLUMNS)]
        out += [f'{key} = """', *wrapped, '"""']
    return out


def read_uncertainty(path: PathLike, chain: Chain) -> Uncertainty | None:
    """What a sidecar knows of its arm's uncertainty, if it does.

    Args:
        path: the sidecar.
        chain: the calibrated arm, as read with it.

    Raises:
        DhcalError: the table is wrong, or another arm's.
    """
    here, table = f"{path}: [uncertainty]", read_toml(path).get("uncertainty")
    if table is None:
        return None
    if not isinstance(table, dict) or set(table) != set(_KEYS):
        raise DhcalError(f"{here} must be a table of {', '.join(_KEYS)}")
    if table["joints"] != list(chain.moving):
        raise DhcalError(f"{here} is of joints {table['joints']}; the arm's are {', '.join(chain.moving)}")
    entries, terms = _entries(chain), table["terms"]
    if not isinstance(terms, list) or not all(isinstance(name, str) and name in entries for name in terms):
        raise DhcalError(f"{here} terms = {terms!r}: every one must be one of {', '.join(entries)}")
    count = 6 * (len(chain.moving) + 1) + len(terms)
    root, hidden = (_rows(table[key], count, f"{here} {key}") for key in ("root", "hidden"))
    if terms and chain.transmission is None:
        chain = chain.driven(Transmission.ideal(chain.loads))
    return Uncertainty(chain, np.array([entries[name] for name in terms], int), root, hidden)


def _entries(chain: Chain) -> dict[str, int]:
    """Flat entries of the transmission's coefficients by parameter."""
    every = (p for name in EXTENSIONS for p in SETS[name](chain))
    return {p.name: p.entry for p in every if p.entry is not None}


def _rows(text: Any, count: int, here: str) -> Array:
    """The rows (count, ·) of a text."""
    try:
        data = base64.b64decode("".join(text.split()), validate=True)
    except (AttributeError, binascii.Error, ValueError):
        data = b"?"
    if len(data) % (8 * count):
        raise DhcalError(f"{here} is no base64 of {count} rows of doubles; calibrate again to have it right")
    out = np.frombuffer(data, "<f8").reshape(count, -1).astype(float)
    if not np.isfinite(out).all():
        raise DhcalError(f"{here} has numbers that are not finite; calibrate again to have it right")
    return out
