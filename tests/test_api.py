"""The public names of `dhcal_pin` and their parameters are those of `api.txt`.

A change of the list is a change for users. Write the new list with

    python tests/test_api.py

and describe the change in CHANGELOG.md.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dhcal_pin

SNAPSHOT = Path(__file__).with_name("api.txt")


def parameters(value: Callable[..., Any]) -> str:
    """Write the parameters of a function without their types; a default is shown as `=…`."""
    words = []
    for name, parameter in inspect.signature(value).parameters.items():
        if name == "self":
            continue
        if parameter.kind is parameter.KEYWORD_ONLY and not any("*" in word for word in words):
            words.append("*")
        mark = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
        words.append(f"{mark}{name}{'' if parameter.default is parameter.empty else '=…'}")
    return f"({', '.join(words)})"


def members(name: str, value: type) -> list[str]:
    """List the public attributes of a class that the package itself defines."""
    lines = []
    for member in dir(value):
        if member.startswith("_"):
            continue
        content = inspect.getattr_static(value, member)
        function = content.__func__ if isinstance(content, staticmethod | classmethod) else content
        if inspect.isfunction(function):
            lines.append(f"{name}.{member}{parameters(getattr(value, member))}")
        else:
            lines.append(f"{name}.{member}")
    fields = getattr(value, "__dataclass_fields__", {})
    return [*lines, *(f"{name}.{field}" for field in fields if not field.startswith("_"))]


def public_api() -> list[str]:
    """List the public names of the package, one per line."""
    lines = []
    for name in dir(dhcal_pin):
        value = getattr(dhcal_pin, name)
        if inspect.isclass(value) and issubclass(value, Exception):
            lines.append(f"{name}({', '.join(base.__name__ for base in value.__bases__)})")
        elif inspect.isclass(value):
            lines += [f"{name}{parameters(value)}", *members(name, value)]
        else:
            lines.append(f"{name}{parameters(value) if inspect.isfunction(value) else ''}")
    return sorted(set(lines))


def test_public_names_are_those_of_the_list():
    written = SNAPSHOT.read_text(encoding="utf-8").splitlines()
    missing, new = sorted(set(written) - set(public_api())), sorted(set(public_api()) - set(written))
    assert (missing, new) == ([], []), "write tests/api.txt anew: python tests/test_api.py"


if __name__ == "__main__":
    SNAPSHOT.write_text("\n".join(public_api()) + "\n", encoding="utf-8")
