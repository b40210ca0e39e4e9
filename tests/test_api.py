"""The public names of `dhcal_pin` and their parameters are those of `api.txt`.

Members that several classes inherit stand once, under the base that the line of each class names. A change
of the list is a change for users. Write the new list with

    python tests/test_api.py

and describe the change in CHANGELOG.md.
"""

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


def is_shared(base: type) -> bool:
    """Return whether several public classes inherit from a class of the package."""
    values = (getattr(dhcal_pin, name) for name in dir(dhcal_pin))
    heirs = [value for value in values if inspect.isclass(value) and base in value.__mro__[1:]]
    return len(heirs) > 1 and base.__module__.startswith("dhcal_pin.")


def members(name: str, value: type, inherited: set[str]) -> set[str]:
    """List the public attributes of a class that are not those of a listed base."""
    lines = set()
    for member in {*dir(value), *getattr(value, "__dataclass_fields__", {})}:
        if member.startswith("_") or member in inherited:
            continue
        content = inspect.getattr_static(value, member, None)
        function = content.__func__ if isinstance(content, staticmethod | classmethod) else content
        is_function = inspect.isfunction(function)
        lines.add(f"{name}.{member}{parameters(getattr(value, member)) if is_function else ''}")
    return lines


def class_lines(name: str, value: type) -> set[str]:
    """List a class, its own members, and those of each base that several public classes share once."""
    base = next((each for each in value.__mro__[1:] if is_shared(each)), None)
    title = f"{name}{parameters(value)}"
    if base is None:
        return {title, *members(name, value, set())}
    # Members that the class, or a base that it alone has, defines anew are its own.
    own = {member for each in value.__mro__[: value.__mro__.index(base)] for member in vars(each)}
    inherited = {*dir(base), *getattr(base, "__dataclass_fields__", {})} - own
    return {f"{title}: {base.__name__}", *members(name, value, inherited), *class_lines(base.__name__, base)}


def public_api() -> list[str]:
    """List the public names of the package, one per line."""
    lines = set()
    for name in dir(dhcal_pin):
        value = getattr(dhcal_pin, name)
        if inspect.isclass(value) and issubclass(value, Exception):
            lines.add(f"{name}({', '.join(base.__name__ for base in value.__bases__)})")
        elif inspect.isclass(value):
            lines |= class_lines(name, value)
        else:
            lines.add(f"{name}{parameters(value) if inspect.isfunction(value) else ''}")
    return sorted(lines)


def test_public_names_are_those_of_the_list():
    written = SNAPSHOT.read_text(encoding="utf-8").splitlines()
    missing, new = sorted(set(written) - set(public_api())), sorted(set(public_api()) - set(written))
    assert (missing, new) == ([], []), "write tests/api.txt anew: python tests/test_api.py"


if __name__ == "__main__":
    SNAPSHOT.write_text("\n".join(public_api()) + "\n", encoding="utf-8")
