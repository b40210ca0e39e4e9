"""Frozen dataclasses behave as those of the standard library."""

import copy
import dataclasses
import inspect
import pickle
from dataclasses import FrozenInstanceError, dataclass, field
from typing import Any, ClassVar

import pytest

from dhcal_pin._frozen import frozen


def declared(decorator: Any) -> tuple[type, type]:
    """Return a class and a subclass that a decorator makes frozen."""

    class Base:
        count: ClassVar[int] = 3
        a: int
        b: list[str] = field(default_factory=list, compare=False)
        c: float = field(default=0.5, repr=False)
        set: int = 0
        factory: int = 1

    base = decorator(Base)

    class Derived(base):
        d: str = ""

        def __post_init__(self):
            object.__setattr__(self, "d", self.d.upper())

    return base, decorator(Derived)


def test_behaviour_is_that_of_the_standard_library():
    """Constructors, comparison, hash, text, copies and errors are the same."""
    for ours, theirs in zip(declared(frozen), declared(dataclass(frozen=True)), strict=True):
        assert str(inspect.signature(ours)) == str(inspect.signature(theirs))
        assert [f.name for f in dataclasses.fields(ours)] == [f.name for f in dataclasses.fields(theirs)]
        for arguments, others in (((1,), (1, ["x"])), ((1, [], 2.0), (1,)), ((1, [], 2.0), (1, [], 2.0))):
            (x, y), (u, v) = ((made(*arguments), made(*others)) for made in (ours, theirs))
            assert (x == y, hash(x) == hash(y)) == (u == v, hash(u) == hash(v))
            assert (repr(x), dataclasses.asdict(x)) == (repr(u), dataclasses.asdict(u))
            assert dataclasses.replace(x, c=7.0) == ours(arguments[0], c=7.0)
            assert x != u
            assert copy.deepcopy(x) == x
        with pytest.raises(FrozenInstanceError, match="'a'"):
            x.a = 2
        with pytest.raises(FrozenInstanceError, match="'a'"):
            del x.a
        with pytest.raises(TypeError, match="argument"):
            ours()
    base, derived = declared(frozen)
    assert derived(1, d="x").d == "X"
    assert base(1).b is not base(1).b


@frozen(eq=False)
class Point:
    """Point that is equal to itself only."""

    x: float


def test_objects_without_comparison_are_equal_to_themselves_only():
    """Without `eq`, objects with equal fields differ, and pickled ones are restored."""
    assert Point(1.0) != Point(1.0)
    assert len({Point(1.0), Point(1.0)}) == 2
    assert pickle.loads(pickle.dumps(Point(1.5))).x == 1.5
