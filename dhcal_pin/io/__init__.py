"""Files: robots, measurements, column maps, sidecars and settings. Units other than SI exist only here."""

from .atomic import write_files
from .dh_file import dh_text, read_dh
from .measurement_csv import (
    MeasurementFile,
    TargetPoses,
    iter_measurements,
    measurement_text,
    read_measurement_file,
    read_measurements,
    read_targets,
)
from .robot import read_robot, urdf_files, write_urdf
from .settings import read_bounds, read_priors
from .shipped_files import shipped_file
from .sidecar import sidecar_path

__all__ = [
    "MeasurementFile",
    "TargetPoses",
    "dh_text",
    "iter_measurements",
    "measurement_text",
    "read_bounds",
    "read_dh",
    "read_measurement_file",
    "read_measurements",
    "read_priors",
    "read_robot",
    "read_targets",
    "shipped_file",
    "sidecar_path",
    "urdf_files",
    "write_files",
    "write_urdf",
]
