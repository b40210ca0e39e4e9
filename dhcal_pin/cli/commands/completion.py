"""`dhcal completion`: print a script that completes commands, options and file names in a shell."""

from __future__ import annotations

from argparse import Namespace, _SubParsersAction

from ...exceptions import InvalidArgumentError
from ..options import IntegerType, Options, expand_placeholders
from ..screens.streams import print_result

EXAMPLE = "dhcal completion bash"
SHELLS = ("bash", "zsh", "fish")

ARGUMENTS: Options = {
    "shell SHELL": {"choices": SHELLS, "help": f"shell: {', '.join(SHELLS)}"},
}


def run(args: Namespace) -> int:
    """Print the script for a shell."""
    from ..main import build_parser  # lazy import: it imports this module

    try:
        import shtab  # lazy import: an optional package
    except ImportError:
        raise InvalidArgumentError(
            "completion needs shtab; install it with pip install 'dhcal-pin[completion]'"
        ) from None
    parser = build_parser()
    (commands,) = (action for action in parser._actions if isinstance(action, _SubParsersAction))
    for command in commands.choices.values():
        command.declare_arguments()
        for action in command._actions:
            if action.help:
                action.help = expand_placeholders(action.help)
            if action.nargs != 0 and not action.choices and not isinstance(action.type, IntegerType):
                is_folder = action.metavar == "DIR"
                action.complete = shtab.DIRECTORY if is_folder else shtab.FILE  # pyright: ignore
    print_result(f"{shtab.complete(parser, args.shell)}\n", "script")
    return 0
