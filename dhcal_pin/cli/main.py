"""Entry point of the `dhcal` command: table of commands, parser and exit status."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from itertools import takewhile
from types import FrameType
from typing import Any, NoReturn

from ..exceptions import DhcalError
from ..messages import message_line
from ..parallel import BLAS_VARIABLES
from .options import VERBOSITY_OPTIONS, CommandParser, HelpFormatter, add_options

# Commands with their help. A word on the command line is the name of a module of `cli.commands`.
COMMANDS = {
    "demo": "reproduce the experiment and the simulations of the paper",
    "calibrate": "estimate the errors of a robot and write the corrected URDF",
    "inspect": "say what measurement files contain, without a fit",
    "validate": "compute the accuracy of a robot model on measurements",
    "diff": "compare two calibrations of one robot",
    "recheck": "check with a few poses whether a robot is still calibrated",
    "convert": "convert a robot file to another format, or a bag of ROS to measurements",
    "view": "show the nominal and the calibrated robot on one offline web page",
    "check": "compare the Jacobian with the paper, Pinocchio and finite differences",
    "plan": "choose the poses to measure and predict the resulting accuracy",
    "simulate": "simulate measurements of a robot with known errors",
    "compensate": "compute joint values and targets that correct the errors",
    "export": "write the calibrated model as C or Python code for other programs",
    "detect": "find the corners of boards in images and write their image coordinates",
    "board": "draw a board to print, at its true scale",
    "app": "serve a page on this computer that calibrates a robot from dropped files",
    "doctor": "say what is installed and whether it works",
    "completion": "print a completion script for bash, zsh or fish",
    "study": "simulate calibrations over a grid of settings",
}


class _LazyCommandParser(CommandParser):
    """Parser of one command that imports the command's module on first use."""

    def __init__(self, *, module: str, **options: Any):
        super().__init__(**options)
        self._module = module
        self._has_arguments = False

    def parse_known_args(self, *args: Any, **options: Any) -> Any:
        """Declare the arguments of the command, then parse. Options may stand between the names of files."""
        self.declare_arguments()
        self._refuse_unknown_options(args[0])
        found, others = super().parse_known_args(*args, **options)
        last = [action for action in self._actions if not action.option_strings][-1:]
        if others and last and last[0].nargs in ("*", "+") and not any(w.startswith("-") for w in others):
            # argparse ends a list of names at the first option.
            setattr(found, last[0].dest, [*getattr(found, last[0].dest), *others])
            others = []
        if others:
            self.error(f"unrecognized arguments: {' '.join(others)}")
        return found, others

    def _refuse_unknown_options(self, words: Sequence[str]) -> None:
        """Report the first unknown option with two hyphens, before options that are missing."""
        for word in takewhile(lambda word: word != "--", words):
            name = word.partition("=")[0]
            if name.startswith("--") and " " not in word and not self.has_option(name):
                hint = self.suggestion(name) or _owners_hint(name)
                self.error(f"unrecognized arguments: {name}{hint}")

    def declare_arguments(self) -> None:
        """Declare the arguments of the command, once."""
        if self._has_arguments:
            return
        self._has_arguments = True
        module = import_module(f".commands.{self._module}", __package__)
        self.epilog = f"example:\n  {module.EXAMPLE}"
        add_options(self, {**module.ARGUMENTS, **VERBOSITY_OPTIONS})
        self.set_defaults(run=module.run)


class _MainParser(CommandParser):
    """Parser of the words before the name of a command."""

    def parse_known_args(self, *args: Any, **options: Any) -> Any:
        """Refuse an unknown option before the command, whose value would be taken for the command."""
        words = args[0]
        name = words[0].partition("=")[0] if words else ""
        if name.startswith("-") and name != "--" and not self.has_option(name):
            if _owners(name):
                command = next((word for word in words if word in COMMANDS), "COMMAND")
                self.error(f"{name} stands before the command; expected dhcal {command} ... {name}")
            self.error(f"unrecognized arguments: {name}{self.suggestion(name)}")
        return super().parse_known_args(*args, **options)


class _VersionAction(argparse.Action):
    """Print the version, which is looked up only when it is asked for."""

    def __call__(self, *_: object) -> NoReturn:
        from importlib.metadata import version  # lazy import: reads the installed metadata

        from .screens.streams import print_result

        print_result(f"dhcal {version('dhcal-pin')}\n", "version")
        sys.exit(0)


def build_parser(words: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Build the parser of all commands, or of the one that the words begin with."""
    parser = _MainParser(
        prog="dhcal",
        description="Robot kinematic calibration: estimate the errors of a robot and correct its URDF.",
        epilog="ROBOT is a URDF, an MJCF, a DH table, a kinematics file of Universal Robots,\n"
        "or example:NAME. `dhcal COMMAND --help` shows the options and an example.",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--version", action=_VersionAction, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(
        title="commands", dest="command", metavar="COMMAND", required=True, parser_class=_LazyCommandParser
    )
    for name in words[:1] if words and words[0] in COMMANDS else COMMANDS:
        commands.add_parser(name, help=COMMANDS[name], **_parser_options(name))
    return parser


def command_parsers() -> dict[str, CommandParser]:
    """Build the complete parsers of all commands, for their documentation."""
    out = {}
    for name in COMMANDS:
        parser = out[name] = _LazyCommandParser(prog=f"dhcal {name}", **_parser_options(name))
        parser.declare_arguments()
    return out


def _owners(option: str) -> list[str]:
    """Return the commands that have an option."""
    return [name for name, parser in command_parsers().items() if parser.has_option(option)]


def _owners_hint(option: str) -> str:
    """Name the commands that have an option."""
    owners = _owners(option)
    return f" (an option of {', '.join(owners)})" if owners else ""


def _parser_options(name: str) -> dict[str, Any]:
    """Return the arguments of the parser of a command."""
    description = f"{COMMANDS[name][0].upper()}{COMMANDS[name][1:]}."
    return {"module": name, "description": description, "formatter_class": HelpFormatter}


class _NotedInterrupt:
    """Context in which SIGTERM interrupts as SIGINT does, and that notes both.

    Libraries may turn `KeyboardInterrupt` into another exception: NumPy raises `TypeError` if it is
    interrupted while it compares structured arrays.
    """

    is_received = False
    # Handlers that are replaced; others are those of a program that runs a command, or ignore the signal.
    _HANDLERS = ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL))

    def __init__(self, ends_process: bool):
        self._ends_process = ends_process

    def __enter__(self) -> None:
        for number, usual in self._HANDLERS:
            if signal.getsignal(number) == usual:
                with suppress(ValueError):  # only the main thread may install a handler
                    signal.signal(number, self._receive)

    def __exit__(self, kind: object, *_: object) -> None:
        for number, usual in self._HANDLERS:
            if signal.getsignal(number) == self._receive:
                if self._ends_process and number == signal.SIGINT:
                    # Python would print a traceback. A finished command has its exit status.
                    usual = signal.SIG_IGN if kind is None else signal.SIG_DFL
                signal.signal(number, usual)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.is_received = True
        if number == signal.SIGTERM and "multiprocessing" in sys.modules:
            # A terminal sends SIGINT to the workers, too.
            for worker in sys.modules["multiprocessing"].active_children():
                os.kill(worker.pid, signal.SIGINT)
        signal.default_int_handler(number, frame)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; without words those of the command line, after which the process ends."""
    interrupt = _NotedInterrupt(argv is None)
    try:
        with interrupt:
            if (outputs := _outputs_module()) is not None:
                outputs.forget_written_files()
            words = sys.argv[1:] if argv is None else argv
            args = build_parser(words).parse_args(words)
            # The matrices are small: more BLAS threads only wait. BLAS reads these when NumPy is loaded.
            for name in BLAS_VARIABLES:
                os.environ.setdefault(name, "1")
            return args.run(args)
    except (Exception, KeyboardInterrupt) as error:
        from .screens.streams import print_message  # lazy import: only for errors

        if isinstance(error, KeyboardInterrupt) or interrupt.is_received:
            outputs = _outputs_module()
            written = ", ".join(outputs.written_files()) if outputs is not None else ""
            what = f"these files are written: {written}" if written else "nothing written"
            print_message(f"dhcal: interrupted; {message_line(what)}")
            return 130
        if isinstance(error, DhcalError | MemoryError):
            is_known = isinstance(error, DhcalError)
            text = message_line(error) if is_known else "not enough memory; use fewer samples"
            print_message(f"dhcal: {text}")
            return 2
        raise


def _outputs_module() -> Any:
    """Return the module of output files if it is loaded; loading it here would take as long as a command."""
    return sys.modules.get(f"{__package__}.outputs")
