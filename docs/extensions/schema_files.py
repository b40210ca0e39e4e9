"""JSON schemas of the TOML files, written from the declarations that their readers use."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

from dhcal_pin.cameras.boards import BOARD_TYPES
from dhcal_pin.cameras.lens import LENSES
from dhcal_pin.cli.fleet import option_key
from dhcal_pin.cli.job import Job
from dhcal_pin.io.dh_file import HEAD_KEYS as DH_KEYS
from dhcal_pin.io.dh_file import JOINT_KEYS, POSE_TABLES
from dhcal_pin.io.measurement_files import column_map
from dhcal_pin.io.rig_file import board_keys, camera_keys
from dhcal_pin.io.servo_file import HEAD_KEYS as SERVO_KEYS
from dhcal_pin.io.servo_file import MOTOR_KEYS
from dhcal_pin.io.settings import BOUNDS, PRIOR
from dhcal_pin.io.sidecar import SIDECAR_KEYS
from dhcal_pin.io.toml_table import Key, table_by_name, table_of, table_schema
from dhcal_pin.studies.grid import HEAD_KEYS as STUDY_KEYS
from dhcal_pin.studies.grid import SETTING_KEYS

_FOLDER = Path("reference/schemas")


def _array(keys: Mapping[str, Key]) -> Key:
    """Declare an array of tables with these keys, at least one."""
    return Key(schema={"type": "array", "minItems": 1, "items": table_schema(keys)})


def _one_of(declarations: Mapping[str, Mapping[str, Key]], key: str) -> Key:
    """Declare tables by name, whose keys depend on the value of one of them."""
    choices = []
    for value, keys in declarations.items():
        schema = table_schema(keys)
        schema["properties"][key] = {"const": value}
        if keys[key].default not in (None, value):
            schema["required"].append(key)
        choices.append(schema)
    return Key(schema={"type": "object", "minProperties": 1, "additionalProperties": {"anyOf": choices}})


def _rig_schema() -> dict[str, Any]:
    cameras = _one_of({name: camera_keys(lens) for name, lens in LENSES.items()}, "model")
    boards = _one_of({name: board_keys(name) for name in BOARD_TYPES}, "type")
    for schema in cameras.schema["additionalProperties"]["anyOf"]:
        schema["dependentRequired"] = {"fx": ["fy", "cx", "cy"], "distortion": ["fx"]}
    return table_schema({"camera": cameras, "board": boards})


def _fleet_schema() -> dict[str, Any]:
    keys = {option.name: Key(schema=option_key(option).schema, is_optional=True) for option in fields(Job)}
    keys |= {name.replace("_", "-"): key for name, key in keys.items()}
    job = {"name": Key(schema={"type": "string"}, is_optional=True), **keys}
    return table_schema({"job": _array(job), **keys})


def _column_map_schema() -> dict[str, Any]:
    joints = table_of(column_map.joint_keys(names=("joint",)))
    rotations = [table_schema(column_map.rotation_keys(name)) for name in column_map.CONVENTIONS]
    return table_schema(
        {
            **column_map.LAYOUT_KEYS,
            "joints": joints,
            "to_joints": joints,
            "columns": table_by_name(table_of(column_map.COLUMN_KEYS)),
            "rotation": Key(schema={"anyOf": rotations}, is_optional=True),
            "constant": table_by_name(Key(schema={"type": "string"})),
        }
    )


def schemas() -> dict[str, dict[str, Any]]:
    """Return the JSON schema of each sort of file, by name."""
    contents = {
        "bounds": ("Bounds of parameters (--bounds FILE.toml)", table_by_name(BOUNDS).schema),
        "column_map": ("Column map", _column_map_schema()),
        "dh": ("DH table (.dh.toml)", table_schema({**DH_KEYS, "joint": _array(JOINT_KEYS), **POSE_TABLES})),
        "fleet": ("Manifest of several robots (.fleet.toml)", _fleet_schema()),
        "priors": ("Prior standard deviations (--priors FILE.toml)", table_by_name(PRIOR).schema),
        "rig": ("Cameras and boards (--rig RIG.toml)", _rig_schema()),
        "servos": (
            "Servo file (--servos FILE.toml)",
            table_schema({**SERVO_KEYS, "motor": table_by_name(table_of(MOTOR_KEYS))}),
        ),
        "sidecar": ("Sidecar (.calibration.toml)", table_schema(SIDECAR_KEYS)),
        "study": (
            "Study (.study.toml)",
            table_schema({**STUDY_KEYS, "settings": table_of(SETTING_KEYS, is_optional=False)}),
        ),
    }
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return {name: {**head, "title": title, **schema} for name, (title, schema) in contents.items()}


def write_schemas(app: Sphinx) -> None:
    """Write the schemas of all files."""
    for name, schema in schemas().items():
        path = Path(app.srcdir) / _FOLDER / f"{name}.schema.json"
        path.write_text(json.dumps(schema, indent=2) + "\n", encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension."""
    app.connect("builder-inited", write_schemas)
    return {"parallel_read_safe": True}
