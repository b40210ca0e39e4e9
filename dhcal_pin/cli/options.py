"""Parser classes, shared options and help texts of the commands.

Shared options are rows of the tables `ARGUMENTS` of commands:

    ARGUMENTS = {"--tip": TIP}

Help texts may contain placeholders such as `{losses}`. When the help is printed they are replaced by names
and descriptions from the modules that define them. A new loss or measurement kind therefore appears without
an edit in this package. This module imports nothing heavy when it is loaded; even `dataclasses`
would take noticeable time of `dhcal --help`.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from ..exceptions import InvalidArgumentError
from ..messages import message_line, similar_words

if TYPE_CHECKING:
    from ..io.measurement_files import MeasurementFile
    from ..io.servo_file import ServoFile
    from ..measurements.mounting import MountedRig
    from ..robot.chain import Chain

# File name that stands for standard output.
STDOUT = "-"


def split_commas(text: str) -> list[str]:
    """Split the entries of a comma-separated option."""
    return [name.strip() for name in text.split(",") if name.strip()]


# --- parsers ---------------------------------------------------------------------------------------


class CommandParser(argparse.ArgumentParser):
    """Argument parser that reports an error in one line and takes -300mm and -1,2,3mm as values."""

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, allow_abbrev=False, **options)
        # argparse takes a word with a minus sign for a value only if this pattern matches it.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def has_option(self, name: str) -> bool:
        """Return whether an option is declared."""
        return name in self._option_string_actions

    def suggestion(self, name: str) -> str:
        """Name the options that an unknown one may be."""
        return _suggestion(name, (known for known in self._option_string_actions if known.startswith("--")))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Suggest a choice in place of a misspelt one."""
        choices = action.choices
        if choices and value not in choices and (text := _suggestion(str(value), choices)):
            raise argparse.ArgumentError(action, f"invalid choice: {value!r}{text}")
        super()._check_value(action, value)

    def print_help(self, file: Any = None) -> None:
        """Print the help on standard output."""
        from .screens.streams import print_result  # lazy import: a command that runs does not need it

        print_result(self.format_help(), "help")

    def error(self, message: str) -> NoReturn:
        """Print one line to stderr and exit with status 2."""
        from .screens.streams import print_message  # lazy import: only for errors

        print_message(f"{self.prog}: {message_line(message)}; see {self.prog} --help")
        sys.exit(2)


def _suggestion(word: str, known: Iterable[str]) -> str:
    """Name the words that an unknown one may be."""
    near = similar_words(word, known)
    return f" (did you mean {' or '.join(near[:3])}?)" if near else ""


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Help formatter with wide columns that replaces placeholders of help texts."""

    def __init__(self, prog: str, **options: Any):
        super().__init__(prog, max_help_position=30, **options)

    def add_argument(self, action: argparse.Action) -> None:
        """Add an option to the help."""
        if action.help and "{" in action.help:
            action.help = expand_placeholders(action.help)
        super().add_argument(action)


class IntegerType(NamedTuple):
    """Type of an integer option, for argparse and manifests."""

    minimum: int  # Smallest value

    @property
    def description(self) -> str:
        """Description of the values."""
        return f"an integer of at least {self.minimum}"

    def __call__(self, text: str) -> int:
        """Parse a value."""
        try:
            value = int(text)
        except ValueError:
            value = None
        if value is None or not self.minimum <= value < 2**63:
            raise argparse.ArgumentTypeError(f"{text!r} is invalid; expected {self.description}")
        return value


POSITIVE_INTEGER = IntegerType(1)
NON_NEGATIVE_INTEGER = IntegerType(0)


def find_robot(text: str) -> str:
    """Return the path of a robot file, also for `example:NAME` and for a robot that ships, and say which."""
    from ..io.shipped_files import resolve_robot_file  # lazy import, as the following: only for robots
    from ..ros_packages import EXAMPLE_PREFIX
    from .screens.streams import print_message

    path = resolve_robot_file(text)
    if path != text and not text.startswith(EXAMPLE_PREFIX):
        line = f"{text} is not in this folder; the file that ships with dhcal is used: {path}"
        print_message(message_line(line))
    return path


def robot_path(text: str) -> str:
    """Find a robot file for argparse."""
    from ..exceptions import UnknownNameError  # lazy import: only for robots

    try:
        return find_robot(text)
    except UnknownNameError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


# --- tables of options -----------------------------------------------------------------------------


class Exclusive(NamedTuple):
    """Options of which a command line may name one."""

    options: Options


# Arguments of a command in the order of its help. A key is the usage, such as `-o --output FILE`. A value has
# keywords of `ArgumentParser.add_argument`, or the help only; without a placeholder this is that of a switch.
Options = Mapping[str, "str | Mapping[str, Any] | Exclusive"]


def add_options(parser: argparse._ActionsContainer, table: Options) -> None:
    """Declare the arguments of a table."""
    for usage, content in table.items():
        if isinstance(content, Exclusive):
            add_options(parser.add_mutually_exclusive_group(), content.options)
            continue
        words = usage.split()
        has_placeholder = len(words) > 1 and not words[-1].startswith("-")
        placeholder = {"metavar": words.pop()} if has_placeholder else {}
        if isinstance(content, str):
            content = {"help": content} if has_placeholder else {"help": content, "action": "store_true"}
        parser.add_argument(*words, **placeholder, **content)


# --- shared options --------------------------------------------------------------------------------

ROBOT: dict[str, Any] = {
    "metavar": "ROBOT",
    "type": robot_path,
    "help": "robot: {robot_formats}, or example:NAME; flange.urdf (built in) for images with stated poses of "
    "the flange",
}
DATA: dict[str, Any] = {
    "metavar": "DATA",
    "nargs": "+",
    "help": "measurement files: text such as CSV, Excel, Parquet",
}
TIP: dict[str, Any] = {
    "metavar": "LINK",
    "help": "tip link of a URDF, or body or site of an MJCF (default: that of a sidecar, else the deepest)",
}
ROOT: dict[str, Any] = {
    "metavar": "LINK",
    "help": "link of a URDF where the chain begins, such as that of a camera (default: the root)",
}
RIG: dict[str, Any] = {
    "metavar": "RIG.toml",
    "help": "cameras and boards of image coordinates, columns u, v and corner",
}
PACKAGE_DIR: dict[str, Any] = {
    "metavar": "DIR",
    "help": "folder with the packages of meshes, or of one package; may be repeated (also searched: the "
    "folders above the URDF, ROS_PACKAGE_PATH, AMENT_PREFIX_PATH)",
}
COLUMNS: dict[str, Any] = {"metavar": "MAP.toml", "help": "column map of files in another layout"}
SHEET: dict[str, Any] = {
    "metavar": "NAME",
    "default": "",
    "help": "sheet of Excel files (default: the one with the most known columns, then the most rows)",
}
SERVOS: dict[str, Any] = {
    "metavar": "FILE",
    "help": "servo file of columns NAME[ticks] with counts: LeRobot's calibration of the arm (.json), or "
    ".toml",
}
ARM: dict[str, Any] = {
    "choices": ("industrial", "low-cost"),
    "help": "low-cost: a servo arm that was put together by hand (default with --servos): estimate its "
    "zeros, with the parameter set low-cost, and decide which joints turn the other way; industrial: any "
    "other (default)",
}
SKIP_BAD_ROWS: dict[str, Any] = {
    "action": "store_true",
    "help": "skip rows that lack a number, a name or a rotation, instead of an error that lists them",
}
FIT_FRAMES: dict[str, Any] = {
    "action": "store_true",
    "help": "fit base and tool to the measurements first",
}
MEND: dict[str, Any] = {
    "metavar": "CHANGE",
    "help": "undo a mistake in the measurements, as a refused calibration names it, such as "
    "sign:elbow_joint; CHANGE@FILE for one of several files, CHANGE@FILE:52-101 for some of its lines; may "
    "be repeated",
}
JSON: dict[str, Any] = {"metavar": "FILE", "help": "write the result as JSON; - for stdout"}
PARAMETERS: dict[str, Any] = {
    "metavar": "SET[,SET]",
    "help": "parameter sets to estimate (default: minimal,base,tool for a URDF, dh or modified-dh for a DH "
    "file): {parameter_sets}",
}
FIX: dict[str, Any] = {
    "metavar": "NAME[,NAME]",
    "help": "parameters or sets to keep at their nominal values",
}
FREE: dict[str, Any] = {"metavar": "NAME[,NAME]", "help": "single parameters to estimate in addition"}
INSTRUMENT: dict[str, Any] = {
    "metavar": "FILE.toml",
    "help": "known values of the instrument, such as wire1.x, in a table [instrument]",
}
SCHEDULER: dict[str, Any] = {
    "metavar": "ADDRESS",
    "help": "run on the Dask cluster of this scheduler, such as tcp://host:8786",
}


# Options of every command that reads a URDF.
URDF_OPTIONS: Options = {
    "--tip": TIP,
    "--root": ROOT,
    "--package-dir": {"action": "append", "default": [], **PACKAGE_DIR},
}
# How tables of measurements are read.
TABLE_OPTIONS: Options = {"--columns": COLUMNS, "--sheet": SHEET, "--servos": SERVOS}
# Options of all commands.
_VERBOSITY: dict[str, Any] = {"dest": "verbosity", "action": "store_const", "default": "normal"}
VERBOSITY_OPTIONS: Options = {
    "--quiet|--verbose": Exclusive(
        {
            "--quiet": {
                **_VERBOSITY,
                "const": "quiet",
                "help": "show the verdict or the final result only",
            },
            "--verbose": {
                **_VERBOSITY,
                "const": "verbose",
                "help": "show all tables, notes and warnings (default: one screen)",
            },
        }
    )
}


def open_option(text: str) -> Options:
    """Declare --open and --no-open of a command that can show a page; the default is None."""
    return {"--open": {"action": argparse.BooleanOptionalAction, "help": text}}


def motion_options(joint_units: str) -> Options:
    """Declare the options of a command that writes joint positions."""
    return {
        "--joint-units": {
            "choices": ("deg", "rad"),
            "default": joint_units,
            "help": "units of the joint positions: deg (degrees and millimetres) or rad (radians and "
            "metres) (default: %(default)s)",
        },
        "--export FILE": {
            "action": "append",
            "default": [],
            "help": "program for a controller: .script (URScript), .trajectory.csv (joint trajectory in s "
            "and rad) or .robodk.csv (joint positions and tool poses in deg and mm); may be repeated",
        },
    }


def execution_options(jobs_help: str, jobs: int | None) -> Options:
    """Declare --jobs and --scheduler, which exclude each other."""
    table = {"--jobs N": {"type": POSITIVE_INTEGER, "default": jobs, "help": jobs_help}}
    return {"--jobs|--scheduler": Exclusive({**table, "--scheduler": SCHEDULER})}


def forbid_options(args: argparse.Namespace, names: str, reason: str) -> None:
    """Raise an error if one of some options, named as attributes, is given."""
    for name in names.split():
        if getattr(args, name):
            raise InvalidArgumentError(f"--{name.replace('_', '-')}: {reason}")


def read_one_robot(path: str, args: argparse.Namespace, sidecar: str | None = None) -> Chain:
    """Read a robot with the options of a URDF."""
    from ..io.robot import read_robot  # lazy import: loads Pinocchio

    return read_robot(path, args.tip, sidecar, args.package_dir, args.root)


def read_robot_or_table(path: str, args: argparse.Namespace, tip: str | None = None) -> Chain:
    """Read one of several robots, to a tip unless --tip names one; a DH table has no such options."""
    from ..io.robot import has_dh_table, read_robot  # lazy import: loads Pinocchio

    tip, root = (None, None) if has_dh_table(path) else (args.tip or tip, args.root)
    return read_robot(path, tip, package_dirs=args.package_dir, root=root)


def read_mounted_rig(path: str | None, sidecar: str | None, chain: Chain) -> MountedRig | None:
    """Return the rig of a file, with poses of the sidecar where it has none, or that of the sidecar."""
    from ..io.rig_file import read_calibrated_rig, read_rig, with_poses_of  # lazy import, as the following
    from ..measurements.mounting import mount_rig

    calibrated = read_calibrated_rig(sidecar) if sidecar else None
    rig = read_rig(path) if path else calibrated
    if rig is not None and calibrated is not None:
        rig = with_poses_of(rig, calibrated)
    return mount_rig(rig, chain) if rig else None


def read_data(
    args: argparse.Namespace,
    chain: Chain,
    servos: ServoFile | None,
    rig: MountedRig | None = None,
    holdout: Sequence[str] = (),
    max_rows: int | None = None,
) -> list[MeasurementFile]:
    """Read the measurement files of a command or a job by its options, and further hold-out files."""
    from ..io import read_measurement_file  # lazy import: loads Pinocchio

    return [
        read_measurement_file(
            path,
            chain,
            args.columns,
            skip_bad_rows=args.skip_bad_rows,
            rig=rig,
            servos=servos,
            sheet=args.sheet,
            max_rows=max_rows,
        )
        for path in (*(args.data or ()), *holdout)
    ]


# --- help texts from the domain --------------------------------------------------------------------


def _described(entries: Mapping[str, Any]) -> str:
    """List names with their help texts."""
    return "; ".join(f"{name} ({entry.help})" for name, entry in entries.items())


def _parameter_sets() -> str:
    from ..calibration.cameras import DEFAULT_SETS, HAND_EYE_SETS, RIG_SETS  # lazy import: loads Pinocchio
    from ..estimation.parameters import PARAMETER_SETS

    images = "; ".join(f"{name} ({text})" for name, text in RIG_SETS.items())
    default = f"{DEFAULT_SETS} (and base,tool beside other instruments), or {HAND_EYE_SETS}"
    default += " if poses of the tip stand in place of joint values"
    return f"{_described(PARAMETER_SETS)}; with --rig, where the default is {default}: {images}"


def _error_families() -> str:
    from ..estimation.parameters import EXTENSIONS  # lazy import: loads Pinocchio
    from ..robot.error_families import FAMILIES

    return "; ".join(f"{name} ({FAMILIES[name].description})" for name in EXTENSIONS)


def _format_list(property_name: str) -> str:
    """List the file formats of robots that have a property, with their endings."""
    formats = (each for each in _module("io.robot").FORMATS if getattr(each, property_name))
    return ", ".join(f"{each.name} ({', '.join(each.endings)})" for each in formats)


def _module(name: str) -> Any:
    """Import a module of the package when a help page needs it; most of them load Pinocchio."""
    return import_module(f"..{name}", __package__)


# Text of each placeholder; called only when a help page is printed.
PLACEHOLDERS: dict[str, Callable[[], str]] = {
    "correction_formats": lambda: _format_list("correct"),
    "criteria": lambda: _described(_module("planning").CRITERIA),
    "error_families": _error_families,
    "kinds": lambda: ", ".join(_module("measurements").KINDS),
    "losses": lambda: _described(_module("estimation").LOSSES),
    "parameter_sets": _parameter_sets,
    "plannable_kinds": lambda: ", ".join(_module("planning").plannable_kinds()),
    "robot_formats": lambda: _format_list("is_readable"),
    "shipped_studies": lambda: ", ".join(_module("io.shipped_files").shipped_names(".study.toml")),
    "written_formats": lambda: _format_list("convert"),
}


def expand_placeholders(text: str) -> str:
    """Replace the placeholders of a help text."""
    return re.sub(r"\{(\w+)\}", lambda match: PLACEHOLDERS[match[1]]().replace("%", "%%"), text)
