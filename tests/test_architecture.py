"""Rules of the code base: size of packages, public names, docstrings, standard terms, plain sentences."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

import dhcal_pin

PACKAGE = Path(dhcal_pin.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
PACKAGES = sorted({path.parent for path in FILES} - {PACKAGE, PACKAGE / "data"})
COMMANDS = set(
    "app calibrate doctor inspect validate convert simulate check demo plan compensate study view".split()
)
# Identifiers of an earlier vocabulary, each with the standard term that replaced it.
REPLACED = {
    "Triangle": "TriangularSystem",
    "Mixture": "ObservationMatrix",
    "mix_velocities": "apply_observation_matrix",
    "Passage": "PlainErrors",
    "placed": "initialize_frames",
    "refitted": "fit_frames",
    "kept_share": "compute_shrinkage_factor",
    "held_back": "shrinkage_notes",
    "Arms": "ChainBatch",
    "mixed_up": "diagnose_mixups",
    "Guess": "MixupHypothesis",
    "Sweep": "FrameBatch",
    "sweep": "forward_kinematics",
    "Motion": "JointState",
    "tool_velocities": "tool_jacobian",
    "station": "error_frame",
    "Tangent": "Linearization",
    "Unknown": "InstrumentParameter",
    "Ruler": "ScaleGauge",
    "count_in_arm": "normalize_by_scale",
    "Touch": "PointContact",
    "Room": "ConfigurationSampler",
    "evened": "scale_joint_units",
    "doubts": "warnings",
    "misfits": "poorly_fitted_files",
    "Trust": "DampingState",
    "leap": "undamped_steps",
    "blur": "cost_roundoff",
    "Families": "PriorGroups",
    "rescaled": "update_prior_scales",
    "unlinked": "without_mimics",
    "told": "determined",
    "seen": "observable",
    "unseen": "null_space",
    "gross": "n_outliers",
    "aside": "n_rejected",
    "again": "refit",
    "counted": "inliers",
    "portable": "transferable_instruments",
    "left_out": "cross_validate_folds",
    "Sheet": "DataTable",
    "scratch": "work_array",
    "Determinant": "DOptimality",
    "Pool": "CandidateSet",
    "HERE": "SERIAL",
    "Workers": "TaskExecutor",
    "redrawn": "resample_each_iteration",
    "looks": "visuals_of",
    "alike": "with_shared_frames",
}
# Parts of sentences that new users could not understand.
UNCLEAR = [
    "stay unseen",
    "no measurement of this arm tells",
    "weakly seen",
    "expected spread is left",
    "gross error",
    "would leave out such",
    "readings stand against",
    "stop paying",
    "as many at random leave",
    "gears that run out of true",
    "of the correction that fits best is kept",
    "asks of that joint alone",
    "minds as much",
]


def relative(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def classes(folder: Path) -> dict[str, ast.ClassDef]:
    """Return the classes of a package by name."""
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in folder.glob("*.py")]
    return {node.name: node for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)}


def inherited(node: ast.ClassDef, family: dict[str, ast.ClassDef]) -> set[str]:
    """Return the names of methods that a class inherits, and that its bases document."""
    out: set[str] = set()
    for base in node.bases:
        parent = family.get(ast.unparse(base).split("[")[0])
        if parent is not None:
            out |= {item.name for item in parent.body if isinstance(item, ast.FunctionDef)}
            out |= inherited(parent, family)
    return out


def public_functions(path: Path) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Yield the public functions of a module, and the methods that its public classes do not inherit."""
    family = classes(path.parent)
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node.name, node
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            known = inherited(node, family)
            for method in node.body:
                if isinstance(method, ast.FunctionDef) and not method.name.startswith("_"):
                    if method.name not in known:
                        yield f"{node.name}.{method.name}", method


def returns_a_value(function: ast.FunctionDef) -> bool:
    return not (isinstance(function.returns, ast.Constant) and function.returns.value is None) and (
        ast.unparse(function.returns or ast.Constant(None)) not in ("None", "NoReturn")
    )


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_public_functions_document_arguments_and_return_value(path):
    """A public function of two or more arguments has the sections Args and Returns."""
    missing = []
    for name, function in public_functions(path):
        arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
        arguments = [a.arg for a in arguments if a.arg not in ("self", "cls")]
        decorators = {ast.unparse(decorator) for decorator in function.decorator_list}
        text = ast.get_docstring(function) or ""
        if len(arguments) < 2 or decorators & {"override", "overload"}:
            continue
        missing += [
            f"{name}: {argument}" for argument in arguments if not re.search(rf"\b{argument}\b.*:", text)
        ]
        if "Args:" not in text:
            missing.append(f"{name}: Args")
        if returns_a_value(function) and not re.search(r"^(Returns|Yields):|\AReturn ", text, re.MULTILINE):
            missing.append(f"{name}: Returns")
    assert missing == []


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_identifiers_are_standard_terms(path):
    """No name that is defined or used in the package belongs to the replaced vocabulary."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Name):
            names.add(node.id)
        elif isinstance(node, ast.Attribute):
            names.add(node.attr)
        elif isinstance(node, ast.arg | ast.keyword) and node.arg:
            names.add(node.arg)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
    assert {name: REPLACED[name] for name in names & set(REPLACED)} == {}


@pytest.mark.parametrize("path", [*FILES, *sorted(PACKAGE.rglob("*.html"))], ids=relative)
def test_sentences_are_plain(path):
    text = " ".join(re.sub(r'"\s*\n\s*f?"', "", path.read_text(encoding="utf-8")).split())
    assert [part for part in UNCLEAR if part in text] == []


@pytest.mark.parametrize("folder", [PACKAGE, *PACKAGES], ids=lambda folder: folder.name)
def test_packages_are_small_and_say_what_belongs_there(folder):
    modules = {path.stem for path in folder.glob("*.py")} - {"__init__", "__main__"}
    if folder.name == "cli":
        modules -= COMMANDS
    assert len(modules) <= 14
    assert len(ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))) or "") > 60


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda folder: folder.name)
def test_exported_names_exist_and_hide_no_module(folder):
    package = import_module(".".join(["dhcal_pin", *folder.relative_to(PACKAGE).parts]))
    exported = getattr(package, "__all__", [])
    assert exported or folder.name == "cli"
    assert [name for name in exported if not hasattr(package, name)] == []
    assert set(exported) & {path.stem for path in folder.glob("*.py")} == set()


def test_every_package_is_installed():
    """An editable installation works without this list, an installed wheel does not."""
    settings = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8"))
    folders = {path.parent.relative_to(PACKAGE.parent) for path in PACKAGE.rglob("__init__.py")}
    expected = {".".join(folder.parts) for folder in folders}
    assert set(settings["tool"]["setuptools"]["packages"]) == expected | {"dhcal_pin.data"}


def test_the_top_level_lists_its_public_names_only():
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    names = {alias.name for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert set(dir(dhcal_pin)) == names
    assert all(getattr(dhcal_pin, name) is not None for name in names)
    assert re.fullmatch(r"\d+\.\d+\.\d+.*", dhcal_pin.__version__)
    assert (PACKAGE / "py.typed").exists()
