"""The `dhcal` command: no heavy import before a command needs it."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module

from ..exceptions import DhcalError
from .arguments import parser

# Where each command lives: module and function, imported when it is asked for and not before.
COMMANDS = {
    "demo": "demo:demo",
    "calibrate": "calibrate:calibrate",
    "validate": "validate:validate",
    "convert": "convert:convert",
    "view": "view:view",
    "check": "check:check",
    "plan": "plan:run",
    "simulate": "simulate:simulate",
    "compensate": "compensate:run",
    "study": "study:study",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; 0 done, 1 a check that failed, 2 wrong input, 130 interrupted."""
    args = parser().parse_args(argv)
    # Small and narrow matrices: further threads of a BLAS, which asks when NumPy loads, would only wait.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    try:
        module, _, function = COMMANDS[args.command].partition(":")
        return getattr(import_module(f".{module}", __package__), function)(args)
    except DhcalError as error:
        print(f"dhcal: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except MemoryError:
        print("dhcal: there is not enough memory for this; ask for fewer samples", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("dhcal: interrupted; nothing written", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
