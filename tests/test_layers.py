"""No module imports to its right, and heavy or special packages stay in one place."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path

import pytest

import dhcal_pin
from dhcal_pin import cli

HOUSE = Path(dhcal_pin.__file__).parent
LAYERS = (
    {"errors"},
    {"executors"},
    {"se3"},
    {"urdf_tags", "dh", "scratch", "criteria"},
    {"urdf", "extraction"},
    {"urdf_origins", "dh_urdf"},
    {"transmission"},
    {"paths", "kinematics", "_kernel"},
    {"reduction", "compiled"},
    {"loops"},
    {"chain"},
    {"stations"},
    {"error_model", "factors", "measurements", "scale", "inverse", "trilateration", "clearance", "design"},
    {"parameters", "configurations", "point_readings"},
    {"poses", "positions"},
    {"lengths", "contacts", "relative"},
    {"frames", "observability", "robust", "kinds"},
    {"problem", "uncertainty", "mistakes"},
    {"solver"},
    {"restraint", "priors"},
    {"evaluation", "arms", "placing", "triangles", "passage", "leverage"},
    {"nullspace", "tables"},
    {"explanations"},
    {"folds"},
    {"batch", "result"},
    {"calibration", "compensation", "crossvalidation"},
    {"extension", "figures", "alternative"},
    {"check", "information", "workspace", "study_plot"},
    {"refinement"},
    {"planning"},
    {"files"},
    {"reading_columns", "saving"},
    {"column_maps"},
    {"foreign_files"},
    {
        "dh_files",
        "measurement_files",
        "transmission_files",
        "payload_files",
        "uncertainty_files",
        "ur_kinematics",
    },
    {"robot_files", "screening", "configuration_files"},
    {"study_grid"},
    {"study"},
    {"plausibility", "stream"},
    {"exports", "diagnosis"},
    {"report"},
    {"report_sections"},
    {"report_figures"},
    {"report_maps"},
    {"terminal"},
    {"shapes"},
    {"viewer"},
    {"report_page"},
    {"live_server", "workspace_files"},
    {"live"},
    {"outputs", "jobs"},
    {"fleet", "experiment"},
    {
        *("demo", "compensate_command", "fleet_command", "study_command"),
        *("plan_command", "view_command"),
    },
    {"calibrate_command", "commands"},
    {"arguments"},
    {"cli"},
)
# What is compiled is known by its stub.
FILES = {path.stem: path for path in HOUSE.glob("*.py*") if path.suffix in (".py", ".pyi")}
MODULES = sorted(set(FILES) - {"__init__"})


def imports(module: str) -> tuple[set[str], set[str]]:
    """Names of our own modules, and of packages, that a module imports anywhere."""
    own, others = set(), set()
    for node in ast.walk(ast.parse(FILES[module].read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            own |= {node.module} if node.module else {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            others.add(node.module.split(".")[0])
        elif isinstance(node, ast.Import):
            others |= {alias.name.split(".")[0] for alias in node.names}
    return own, others


def test_commands_live_to_the_left_of_the_command_line():
    allowed = set().union(*LAYERS[:-1])
    for home in cli.COMMANDS.values():
        module, _, function = home.partition(":")
        assert module in allowed
        assert callable(getattr(import_module(f"dhcal_pin.{module}"), function))


def test_every_module_has_its_place():
    assert sorted(set().union(*LAYERS)) == MODULES


@pytest.mark.parametrize("module", MODULES)
def test_imports_only_from_the_left(module):
    place = next(i for i, layer in enumerate(LAYERS) if module in layer)
    allowed = set().union(*LAYERS[:place]) if place else set()
    assert imports(module)[0] <= allowed


@pytest.mark.parametrize("module", MODULES)
def test_special_packages_stay_in_one_place(module):
    homes = {
        "meshcat": {"live", "live_server"},
        "matplotlib": set(),
        "rich": {"terminal"},
        "argparse": {
            "arguments",
            "calibrate_command",
            "commands",
            "jobs",
            "compensate_command",
            "fleet_command",
            "study_command",
            "view_command",
            "plan_command",
        },
    }
    for package, allowed in homes.items():
        if package in imports(module)[1]:
            assert module in allowed


def test_the_solver_names_no_kind_and_no_set():
    for module in ("problem", "solver", "result", "calibration", "observability"):
        text = (HOUSE / f"{module}.py").read_text()
        names = {node.id for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Name)}
        assert not names & {"Position", "Pose", "KINDS", "SETS", "minimal", "placement"}
