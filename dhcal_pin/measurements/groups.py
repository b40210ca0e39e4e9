"""Residual groups: the unit of some residuals of a kind, and what texts call their error.

A measurement kind declares its groups by name:

    residual_groups = {"inclination": Group(slice(0, 2), "rad", "inclination error")}

Everything that shows errors takes the unit and the words from there. The groups of one `ErrorGroup` have
common statistics: each group has its own, but all measured lengths share `LENGTHS`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from .._frozen import frozen


@frozen
class ErrorGroup:
    """Errors that have common statistics."""

    name: str  # Name in the JSON document, such as "position"
    unit: str  # "m", "rad" or "px"
    label: str  # Name in texts, such as "position error"
    order: int = 2  # Place among the groups of a calibration; the first one is the most important
    is_vector: bool = False  # Whether the errors are vectors along the axes of a frame


# Lengths of wires, distances of contacts, coordinates along single axes.
LENGTHS = ErrorGroup("residual", "m", "residual")


@frozen
class Group:
    """Rows of the residual of a sample that share a unit and a standard deviation."""

    rows: slice  # Rows of the residual
    unit: str  # "m", "rad" or "px"
    label: str  # Name of the error in texts
    axes: str = ""  # Last letter of the name of each row, such as "xyz"; rows are numbered if empty
    statistics: ErrorGroup | None = None  # Errors with which the error has common statistics; its own if None

    @classmethod
    def of(cls, errors: ErrorGroup, rows: slice, axes: str = "") -> Group:
        """Return rows whose errors belong to a given error group."""
        return cls(rows, errors.unit, errors.label, axes, errors)


POSITION = Group.of(ErrorGroup("position", "m", "position error", 0, True), slice(0, 3), "xyz")
ORIENTATION = Group.of(ErrorGroup("orientation", "rad", "orientation error", 1, True), slice(3, 6), "xyz")

# Error groups by the name of a residual group, and by their own name, as the measurement kinds declare them.
_by_residual_group: dict[str, ErrorGroup] = {}
ERROR_GROUPS: dict[str, ErrorGroup] = {}


def declare(groups: Mapping[str, Group | ErrorGroup]) -> None:
    """Enter the groups of a measurement kind; a name has one unit and one label in all kinds."""
    for name, group in groups.items():
        errors = group if isinstance(group, ErrorGroup) else group.statistics
        errors = errors or ErrorGroup(name, group.unit, group.label)
        for known, key in ((_by_residual_group, name), (ERROR_GROUPS, errors.name)):
            if known.setdefault(key, errors) != errors:
                raise TypeError(f"residual group {key!r}: another kind declares it as {known[key]}")


def error_group(name: str) -> str:
    """Return the name of the error group of a residual group."""
    return _by_residual_group[name].name


def in_order(names: Iterable[str]) -> list[str]:
    """Sort names of error groups, the most important one first."""
    return sorted(names, key=lambda name: ERROR_GROUPS[name].order)
