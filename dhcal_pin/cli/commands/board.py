"""`dhcal board`: draw a board to print, at its true scale."""

from __future__ import annotations

from argparse import Namespace

from ... import detection, io
from ...exceptions import InvalidArgumentError
from .. import screens
from ..options import JSON, Options

EXAMPLE = "dhcal board rig.toml --paper a4 -o board.pdf"

ARGUMENTS: Options = {
    "rig RIG.toml": "rig file with the board",
    "--board NAME": "board of the rig file; only needed if it has several",
    "--paper SIZE": {
        "choices": ("a4", "letter"),
        "help": "sheet of paper, a4 or letter, with a ruler line: its measured length, ruler_mm in the rig "
        "file, corrects the scale of the printer (default: a page of the size of the board)",
    },
    "-o --output board.pdf": {"required": True, "help": "page to write"},
    "--json": JSON,
}


def run(args: Namespace) -> int:
    """Draw a board."""
    from ..outputs import require_writable_outputs, write_with_json  # lazy import: loads Pinocchio

    require_writable_outputs([args.output, args.json], [args.rig])
    if not args.output.lower().endswith(".pdf"):
        raise InvalidArgumentError(f"{args.output}: unknown ending; write the board as .pdf")
    rig = io.read_rig(args.rig)
    board = io.only_entry(rig.boards, args.board, "board", args.rig)
    page = detection.board_pdf(board, args.paper)
    write_with_json({args.output: page}, args.json, {"output": args.output}, [args.rig], board=board.name)
    advice = "Print it at 100 %, without fitting it to the page, and measure a square afterwards."
    if args.paper:
        advice = (
            "Print it at 100 %, without fitting it to the page. Measure the ruler line and write its length "
            f"to [board.{board.name}] of {args.rig}, such as ruler_mm = 149.6. Glue the sheet to a plate."
        )
    screens.show(screens.files_screen([args.output]), args.verbosity)
    screens.print_lines(advice)
    return 0
