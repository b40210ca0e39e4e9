"""Robots in and out: URDF or DH file to a chain, a calibrated chain back to URDF and sidecar."""

from __future__ import annotations

from pathlib import Path

from ..exceptions import DhcalError


def shipped_file(name: str) -> Path:
    """A file that ships with the package, such as the paper's tables, installed or in the source tree."""
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "data", package.parent / "urdf"):
        if (folder / name).exists():
            return folder / name
    raise DhcalError(f"{name}: no such file, nor one that ships with dhcal-pin; check its name")
