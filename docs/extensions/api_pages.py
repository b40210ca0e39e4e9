"""Pages of the Python API, written from the public names of the packages before the build starts.

The first page has the names of `dhcal_pin` itself. Each package has a page with its other public names.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.inspect import TypeAliasForwardRef

import dhcal_pin

PACKAGES = (
    "robot measurements estimation identifiability io calibration plausibility planning diagnostics "
    "visualization iso9283 report studies paper"
).split()
_FOLDER = Path("reference/api")
# Order of the packages on the page of `dhcal_pin` itself.
_TOP_ORDER = (
    "calibration io measurements robot planning compensation report visualization diagnostics estimation "
    "paper exceptions"
).split()
# Types as Sphinx writes them; they are shown without their modules.
_QUALIFIED = re.compile(r"~?\b(?:[a-z_]\w*\.)+(?=\w)")
# Symbols that reStructuredText would read as markup.
_BARS = re.compile(r"(?<![`\\])\|")
_TRAILING_UNDERSCORE = re.compile(r"(?<=\w)_(?=[\s,;:).=·\]]|$)")


def _heading(text: str) -> list[str]:
    return [text, "=" * len(text), ""]


def _directive(name: str, value: Any) -> list[str]:
    """Write the directive of one public name."""
    if inspect.isclass(value):
        return [f".. autoclass:: {name}", "   :members:", *_inherited(value), ""]
    if inspect.isfunction(value):
        return [f".. autofunction:: {name}", ""]
    kind = type(value).__name__
    keys = ", ".join(f"``{key}``" for key in value) if isinstance(value, Mapping) else f"``{value!r}``"
    return [f".. py:data:: {name}", f"   :type: {kind}", "", f"   {keys}", ""]


def _inherited(value: type) -> list[str]:
    """Return the option that shows the members of bases that have no entry of their own."""
    bases = [base for base in value.__mro__[1:] if base.__module__.startswith("dhcal_pin.")]
    if all(_is_public(base) for base in bases):
        return []
    # Other bases are those of Python and those with an entry.
    others = [base.__name__ for base in value.__mro__[1:] if base not in bases or _is_public(base)]
    return [f"   :inherited-members: {', '.join(others)}"]


def _is_public(value: type) -> bool:
    """Return whether a class has an entry on a page."""
    package = value.__module__.split(".")[1]
    return hasattr(dhcal_pin, value.__name__) or (
        package in PACKAGES and value.__name__ in _public_names(package)
    )


def _module_of(name: str) -> str:
    """Return the package in which a public name of `dhcal_pin` is defined."""
    return getattr(dhcal_pin, name).__module__.split(".")[1]


def _public_names(package: str) -> list[str]:
    """Return the public names of a package that `dhcal_pin` itself does not have."""
    module = import_module(f"dhcal_pin.{package}")
    values = {name: getattr(module, name) for name in module.__all__}
    return [name for name, value in values.items() if getattr(dhcal_pin, name, None) is not value]


def _top_page() -> list[str]:
    lines = [*_heading("dhcal_pin"), ".. py:module:: dhcal_pin", ""]
    lines += ["Names of the package itself: ``import dhcal_pin as dh``.", ""]
    packages = dict.fromkeys([*_TOP_ORDER, *map(_module_of, dir(dhcal_pin))])
    for package in packages:
        names = [name for name in dir(dhcal_pin) if _module_of(name) == package]
        if names:
            lines += [package, "-" * len(package), ""]
        # Functions first.
        for name in sorted(names, key=lambda name: inspect.isclass(getattr(dhcal_pin, name))):
            lines += _directive(f"dhcal_pin.{name}", getattr(dhcal_pin, name))
    return lines


def _package_page(package: str) -> list[str]:
    name = f"dhcal_pin.{package}"
    module = import_module(name)
    lines = [*_heading(name), f".. py:module:: {name}", ""]
    text = ast.get_docstring(ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))) or ""
    lines += [*_escape(text.split("\n\n")[0].splitlines()), ""]
    for public in _public_names(package):
        lines += _directive(f"{name}.{public}", getattr(module, public))
    return lines


def _write(path: Path, lines: list[str]) -> None:
    """Write a page if it changed, so that Sphinx reads only what is new."""
    text = "\n".join(lines) + "\n"
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def write_pages(app: Sphinx) -> None:
    """Write the pages of the API."""
    folder = Path(app.srcdir) / _FOLDER
    folder.mkdir(exist_ok=True, parents=True)
    _write(folder / "dhcal_pin.rst", _top_page())
    pages = [package for package in PACKAGES if _public_names(package)]
    for package in pages:
        _write(folder / f"{package}.rst", _package_page(package))
    _write(
        folder / "index.rst",
        [
            *_heading("Python API"),
            "Lengths are metres and angles radians. Joint positions ``q`` have shape (m, n), one row per",
            "sample; poses have shape (m, 4, 4); twists are [v, ω]; T_ab is the pose of frame b in frame a.",
            "Every error that a user can cause is a :py:class:`dhcal_pin.DhcalError`.",
            "",
            ".. toctree::",
            "   :maxdepth: 2",
            "",
            *(f"   {page}" for page in ["dhcal_pin", *pages]),
        ],
    )


def _escape(lines: list[str]) -> list[str]:
    """Escape bars and trailing underscores outside of indented formulas."""
    return [
        line if line.startswith("    ") else _TRAILING_UNDERSCORE.sub(r"\\_", _BARS.sub(r"\\|", line))
        for line in lines
    ]


def _escape_docstring(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    lines[:] = _escape_all(lines)


def _escape_all(lines: list[str]) -> list[str]:
    """Escape bars and trailing underscores."""
    return [_TRAILING_UNDERSCORE.sub(r"\\_", _BARS.sub(r"\\|", line)) for line in lines]


def _keep_property_docstring(
    app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]
) -> None:
    """Restore the docstring of a property: Napoleon takes the words before its first colon for a type."""
    if what == "property":
        lines[:] = [*_escape_all((inspect.getdoc(value) or "").splitlines()), ""]


def _shorten(text: str | None) -> str | None:
    """Shorten the types of a signature."""
    return text and _QUALIFIED.sub("", text)


def _shorten_signature(
    app: Sphinx, what: str, name: str, value: Any, options: Any, signature: str, returned: str
) -> tuple[str | None, str | None]:
    return _shorten(signature), _shorten(returned)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension."""
    # Within other types, Sphinx writes the names of `autodoc_type_aliases` by their repr.
    TypeAliasForwardRef.__repr__ = lambda alias: alias.name
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-process-docstring", _escape_docstring, priority=100)
    app.connect("autodoc-process-docstring", _keep_property_docstring, priority=900)
    app.connect("autodoc-process-signature", _shorten_signature)
    return {"parallel_read_safe": True}
