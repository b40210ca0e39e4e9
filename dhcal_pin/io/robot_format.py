"""Robot file formats: how files of one format are recognized, read and written.

A format is one module of this package with its functions, and one row of `robot.FORMATS`. Two kinds of
robot description can be read: a DH table, whose only tip is the end of its last row, and a URDF, whose tip is
chosen by name. A file of a maker may hold corrections only, which are applied to a nominal robot. A format is
written from a `RobotSource`, the robot that is to be converted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from .._frozen import frozen
from .._typing import PathLike
from ..robot.chain import Chain
from ..robot.dh import Convention, DHTable
from ..robot.urdf import Urdf


@frozen
class RobotSource:
    """Robot that is to be written in another format."""

    chain: Chain  #: The robot with base, tool and joint errors from its sidecar.
    table: DHTable | None  #: DH table of the file; None if the format holds none.
    convention: Convention | None  #: Convention requested for a DH table; None if any will do.


class ConvertedRobot(NamedTuple):
    """Text of a robot file, and notes on what the format could not hold."""

    text: str  #: Content of the file.
    notes: Sequence[str] = ()  #: One sentence each.


@frozen
class RobotFormat:
    """File format of a robot."""

    name: str  #: Name in help texts and messages.
    endings: tuple[str, ...]  #: Recommended endings of file names, lower case.
    #: Function that returns the text of a robot at a path; None if the format is only read.
    convert: Callable[[RobotSource, PathLike], ConvertedRobot] | None = None
    #: Function that reads a DH table; None if the format holds none.
    read_table: Callable[[PathLike], DHTable] | None = None
    #: Function that reads a URDF; None if the format holds none.
    read_urdf: Callable[[PathLike], Urdf] | None = None
    #: Function that applies the corrections of a file to a nominal chain, and notes what it did; None if the
    #: format holds none.
    correct: Callable[[PathLike, Chain], tuple[Chain, list[str]]] | None = None
    other_endings: tuple[str, ...] = ()  #: Endings that are accepted, too.

    @property
    def is_readable(self) -> bool:
        """Whether robots can be read from the format."""
        return self.read_table is not None or self.read_urdf is not None
