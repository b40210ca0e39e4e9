"""`dhcal export`: write the model of a robot as source code for other programs."""

from __future__ import annotations

from argparse import Namespace
from keyword import iskeyword
from pathlib import Path

from .. import screens
from ..options import JSON, ROBOT, URDF_OPTIONS, Options, read_one_robot

EXAMPLE = "dhcal export ur10_calibrated.urdf --tip tool0 -o model.h"

ARGUMENTS: Options = {
    "robot": ROBOT,
    "-o --output FILE": {
        "required": True,
        "help": "file to write: NAME.h, a C99 header whose functions begin with the name of the file, or "
        "NAME.py, a Python module that needs NumPy only",
    },
    **URDF_OPTIONS,
    "--json": JSON,
}


def run(args: Namespace) -> int:
    """Write the source code."""
    from ...model_code import LANGUAGES, model_code  # lazy import, as the following
    from ..output_table import Output
    from ..outputs import checked_files, existing_sidecars, write_with_json

    inputs = [args.robot, *existing_sidecars([args.robot])]
    checked_files(args, {"output": Output("source code", tuple(LANGUAGES)), "json": Output()}, inputs)
    text = model_code(read_one_robot(args.robot, args), args.output)
    name = Path(args.output)
    notes = []
    if name.suffix.lower() == ".py" and (not name.stem.isidentifier() or iskeyword(name.stem)):
        notes.append(f"{args.output}: Python imports no module of this name; use letters, digits and _")
    write_with_json({args.output: text}, args.json, {"output": args.output}, inputs, notes=notes)
    screens.show(screens.files_screen([args.output], notes), args.verbosity)
    return 0
