"""Frozen dataclasses whose classes are created in a fifth of the time.

`dataclass(frozen=True)` compiles up to six functions per class, which takes 0.15 s for the 200 classes of a
calibration. `frozen` compiles the constructor only, when it is first used, and all classes share the other
functions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, FrozenInstanceError, dataclass, field, fields
from typing import Any, TypeVar, dataclass_transform, overload

_T = TypeVar("_T")


class _Factory:
    """Default of an argument whose value is made for each object."""

    def __repr__(self) -> str:
        return "<factory>"


_FACTORY = _Factory()


@overload
def frozen(cls: type[_T], /) -> type[_T]: ...
@overload
def frozen(*, eq: bool = True) -> Callable[[type[_T]], type[_T]]: ...
@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen(cls: Any = None, /, *, eq: bool = True) -> Any:
    """Make a class a frozen dataclass; `eq` is False for fields that are arrays."""
    if cls is None:
        return lambda given: _frozen(given, eq)
    return _frozen(cls, eq)


def bare(cls: Any) -> Any:
    """Make a class a dataclass that can be changed, without comparison and text."""
    made = dataclass(init=False, repr=False, eq=False)(cls)
    made.__init__ = _Constructor(made)
    return made


class _Constructor:
    """Constructor of a dataclass, which is compiled when it is first used."""

    def __init__(self, cls: Any):
        """Keep the dataclass."""
        self.cls = cls

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        """Return the constructor of an object or of the class."""
        self.cls.__init__ = _compiled_constructor(self.cls)
        return self.cls.__init__.__get__(instance, owner)


def _frozen(cls: Any, eq: bool) -> Any:
    """Make a class a frozen dataclass."""
    made = bare(cls)
    made.__setattr__, made.__delattr__ = _refuse_change, _refuse_change
    if made.__repr__ is object.__repr__:
        made.__repr__ = _repr
    if eq:
        made._compared_fields = tuple(f.name for f in fields(made) if f.compare)
        made.__eq__, made.__hash__ = _eq, _hash
    return made


def _compiled_constructor(cls: Any) -> Callable[..., None]:
    """Compile the constructor of a dataclass."""
    names: dict[str, Any] = {"__set__": object.__setattr__, "__factory__": _FACTORY}
    arguments, entries = ["self"], []
    for item in fields(cls):
        name = value = argument = item.name
        if item.default is not MISSING:
            names[f"__{name}"] = item.default
            argument = f"{name}=__{name}"
        elif item.default_factory is not MISSING:
            names[f"__{name}"] = item.default_factory
            argument, value = f"{name}=__factory__", f"__{name}() if {name} is __factory__ else {name}"
        arguments.append(argument)
        entries.append(f"'{name}': {value}")
    # A line per field takes twice as long to compile.
    lines = [f"__set__(self, '__dict__', {{{', '.join(entries)}}})"]
    if hasattr(cls, "__post_init__"):
        lines.append("self.__post_init__()")
    exec(f"def __init__({', '.join(arguments)}): {'; '.join(lines)}", names)
    init = names["__init__"]
    init.__qualname__ = f"{cls.__qualname__}.__init__"
    init.__annotations__ = {item.name: item.type for item in fields(cls)} | {"return": None}
    return init


def _refuse_change(self: Any, name: str, *value: Any) -> None:
    """Refuse to set or delete an attribute."""
    raise FrozenInstanceError(f"cannot {'assign to' if value else 'delete'} field {name!r}")


def _repr(self: Any) -> str:
    """Return the class and the fields."""
    shown = (f"{item.name}={getattr(self, item.name)!r}" for item in fields(self) if item.repr)
    return f"{type(self).__qualname__}({', '.join(shown)})"


def _values(self: Any) -> tuple[Any, ...]:
    """Return the values of the fields that are compared."""
    return tuple(map(vars(self).__getitem__, self._compared_fields))


def _eq(self: Any, other: object) -> bool:
    """Return whether another object has the same class and equal fields."""
    return _values(self) == _values(other) if type(other) is type(self) else NotImplemented


def _hash(self: Any) -> int:
    """Return the hash of the fields."""
    return hash(_values(self))
