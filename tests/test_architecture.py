"""Rules of the code base: size of packages, public names, docstrings, plain sentences."""

import ast
import inspect
import re
import tomllib
from collections.abc import Callable, Iterator
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import dhcal_pin
from dhcal_pin.cli.main import COMMANDS
from dhcal_pin.measurements import KINDS

PACKAGE = Path(dhcal_pin.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
PACKAGES = sorted({path.parent for path in FILES} - {PACKAGE, PACKAGE / "data"})
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


def public_functions() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Yield the functions that users import, and the methods of the classes that they import."""
    for name in dir(dhcal_pin):
        value = getattr(dhcal_pin, name)
        if inspect.isfunction(value):
            yield name, value
        elif inspect.isclass(value):
            for method, content in inspect.getmembers_static(value):
                function = getattr(content, "__func__", content)
                if inspect.isfunction(function) and not method.startswith("_"):
                    yield f"{name}.{method}", function


@pytest.mark.parametrize(("name", "function"), [pytest.param(*row, id=row[0]) for row in public_functions()])
def test_public_functions_document_arguments_and_return_value(name, function):
    """A public function of two or more arguments has the sections Args and Returns."""
    signature = inspect.signature(function)
    arguments = [argument for argument in signature.parameters if argument not in ("self", "cls")]
    text = inspect.getdoc(function) or ""
    if not function.__module__.startswith("dhcal_pin.") or len(arguments) < 2:
        return
    if "Args:" not in text:
        text = inherited_text(name, text)
    assert [argument for argument in arguments if not re.search(rf"\b{argument}\b.*:", text)] == []
    assert "Args:" in text
    if signature.return_annotation not in ("None", "NoReturn"):
        assert re.search(r"^(Returns|Yields):|\AReturn ", text, re.MULTILINE)


def inherited_text(name: str, text: str) -> str:
    """Return the documentation of a method in a base class if its own has no sections."""
    owner, _, method = name.partition(".")
    bases = getattr(dhcal_pin, owner).__mro__[1:] if method else ()
    texts = [inspect.getdoc(base.__dict__[method]) or "" for base in bases if method in base.__dict__]
    return next((other for other in texts if "Args:" in other), text)


@pytest.mark.parametrize("path", [*FILES, *sorted(PACKAGE.rglob("*.html"))], ids=relative)
def test_sentences_are_plain(path):
    text = " ".join(re.sub(r'"\s*\n\s*f?"', "", path.read_text(encoding="utf-8")).split())
    assert [part for part in UNCLEAR if part in text] == []


def module_files() -> dict[str, Path]:
    """Return the modules of the package by their full names."""
    names = {
        path: ".".join(["dhcal_pin", *path.relative_to(PACKAGE).with_suffix("").parts]) for path in FILES
    }
    return {name.removesuffix(".__init__"): path for path, name in names.items()}


def imports_of(path: Path, name: str) -> Iterator[tuple[str, str]]:
    """Yield module and name of every import of a file, wherever it stands; the name is empty for a module."""
    package = name if path.stem == "__init__" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            module = ".".join([*parents, *([node.module] if node.module else [])])
            yield from ((module, alias.name) for alias in node.names)


def import_graph() -> dict[str, set[str]]:
    """Return the modules that each module imports: at its top, in functions and under TYPE_CHECKING.

    A public name of a package belongs to the module that its stub names.
    """
    modules = module_files()
    exported: dict[tuple[str, str], str] = {}
    for name, path in modules.items():
        if path.stem == "__init__":
            for source in filter(Path.exists, (path, path.with_suffix(".pyi"))):
                exported |= {(name, public): module for module, public in imports_of(source, name)}
    compiled = {(name, path.stem) for name in modules for path in modules[name].parent.glob("*.pyi")}
    graph: dict[str, set[str]] = {name: set() for name in modules}
    for name, path in modules.items():
        for module, imported in imports_of(path, name):
            if f"{module}.{imported}" in modules:
                module = f"{module}.{imported}"
            elif (module, imported) in compiled:
                continue
            while (module, imported) in exported and exported[module, imported] != module:
                module = exported[module, imported]
            if module in modules and module != name:
                graph[name].add(module)
    return graph


def test_imports_have_no_circle():
    """Imports in functions and for type checking count: a reader has to follow them, too."""
    sorter = TopologicalSorter(import_graph())
    try:
        order = list(sorter.static_order())
    except CycleError as error:
        pytest.fail(f"circle: {' -> '.join(error.args[1])}")
    assert len(order) > 200


def test_kinds_of_measurements_state_what_they_can():
    """Only the modules of images compare types with the kind of images; others ask for its rig."""
    images = [cls.__name__ for cls in KINDS.values() if cls.residual_groups.keys() & {"pixels"}]
    assert images == ["CameraCorners"]
    found = []
    for path in FILES:
        name = relative(path)
        if not any(image in path.read_text(encoding="utf-8") for image in images):
            continue
        if name == "measurements/camera.py" or name.startswith(
            ("measurements/images/", "calibration/cameras/")
        ):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            tested: list[ast.expr] = []
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("isinstance", "issubclass"):
                tested = node.args[1:]
            elif isinstance(node, ast.MatchClass):
                tested = [node.cls]
            elif isinstance(node, ast.Compare):
                tested = [node.left, *node.comparators]
            words = re.findall(r"\w+", " ".join(map(ast.unparse, tested)))
            found += [f"{name}:{node.lineno}" for image in images if image in words]
    assert found == []


@pytest.mark.parametrize("folder", [PACKAGE, *PACKAGES], ids=lambda folder: folder.name)
def test_packages_are_small_and_say_what_belongs_there(folder):
    modules = {path.stem for path in folder.glob("*.py")} - {"__init__", "__main__"}
    # One module per command, as the table of commands lists them.
    assert len(modules) <= (len(COMMANDS) if folder.name == "commands" else 16)
    assert len(ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))) or "") > 60


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda folder: folder.name)
def test_exported_names_exist_and_hide_no_module(folder):
    package = import_module(".".join(["dhcal_pin", *folder.relative_to(PACKAGE).parts]))
    exported = getattr(package, "__all__", [])
    assert exported or "cli" in folder.parts[-2:]
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
