"""Files: robots, measurements, column maps, sidecars and settings. Units other than SI exist only here."""

from .atomic import save
from .dh_file import dh_text, read_dh
from .measurement_csv import (
    Readings,
    Targets,
    file_parts,
    measurement_text,
    read_measurements,
    read_readings,
    read_targets,
)
from .robot import read_robot, urdf_files, write_urdf
from .settings import read_bounds, read_priors
from .shipped_files import paper_file
from .sidecar import sidecar_path

__all__ = [
    "Readings",
    "Targets",
    "dh_text",
    "file_parts",
    "measurement_text",
    "paper_file",
    "read_bounds",
    "read_dh",
    "read_measurements",
    "read_priors",
    "read_readings",
    "read_robot",
    "read_targets",
    "save",
    "sidecar_path",
    "urdf_files",
    "write_urdf",
]
