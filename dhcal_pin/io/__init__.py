"""Files: robots, measurements, column maps, sidecars and settings.

This package reads and writes files, and converts their units; everywhere else, lengths are metres and angles
radians. Errors in the content of a file are `FileFormatError` and name the file, the line or key, and what is
expected. What the content means belongs to `robot`, `measurements` and `estimation`.

To add a robot file format, add a module with its functions, and one row to `robot.FORMATS`.
"""

from .atomic import require_writable, write_files
from .dh_file import dh_text, read_dh
from .measurement_csv import (
    MeasurementFile,
    TargetPoses,
    configurations_text,
    iter_measurements,
    measurement_text,
    read_configurations,
    read_measurement_file,
    read_measurements,
    read_targets,
)
from .origins_file import joint_origins, origins_text
from .robot import FORMATS, convert_robot, read_robot, robot_name, urdf_files, write_urdf
from .robot_format import ConvertedRobot, RobotFormat, RobotSource
from .settings import parse_payload, read_bounds, read_priors
from .shipped_files import shipped_file, shipped_names
from .sidecar import existing_sidecar, read_instrument, read_uncertainty, sidecar_path
from .tabular import csv_text, read_csv_table, read_text, read_toml
from .toml_table import TomlTable

__all__ = [
    "FORMATS",
    "ConvertedRobot",
    "MeasurementFile",
    "RobotFormat",
    "RobotSource",
    "TargetPoses",
    "TomlTable",
    "configurations_text",
    "convert_robot",
    "csv_text",
    "dh_text",
    "existing_sidecar",
    "iter_measurements",
    "joint_origins",
    "measurement_text",
    "origins_text",
    "parse_payload",
    "read_bounds",
    "read_configurations",
    "read_csv_table",
    "read_dh",
    "read_instrument",
    "read_measurement_file",
    "read_measurements",
    "read_priors",
    "read_robot",
    "read_targets",
    "read_text",
    "read_toml",
    "read_uncertainty",
    "require_writable",
    "robot_name",
    "shipped_file",
    "shipped_names",
    "sidecar_path",
    "urdf_files",
    "write_files",
    "write_urdf",
]
