"""`dhcal app`: serve a page on this computer that calibrates a robot from dropped files."""

from __future__ import annotations

from argparse import SUPPRESS, Namespace

from .. import screens
from ..options import NON_NEGATIVE_INTEGER, POSITIVE_INTEGER, Options, open_option

EXAMPLE = "dhcal app"
_MEGABYTE = 10**6

ARGUMENTS: Options = {
    "--port N": {
        "type": NON_NEGATIVE_INTEGER,
        "default": 0,
        "help": "port of the loopback address (default: any free one)",
    },
    "--max-size MB": {
        "type": POSITIVE_INTEGER,
        "default": 100,
        "help": "largest size of all files that are dropped together, in MB (default: %(default)s)",
    },
    **open_option("open the page in the browser (default)"),
    "--no-browser": {"dest": "open", "action": "store_false", "help": SUPPRESS},
}


def run(args: Namespace) -> int:
    """Serve the page."""
    import asyncio  # lazy import, as the following: slow to load

    from ...app import serve

    def show_address(url: str) -> None:
        screens.print_lines(url, "end with Ctrl-C")
        if args.open is not False:
            screens.open_url(url)

    asyncio.run(serve(show_address, port=args.port, limit=args.max_size * _MEGABYTE))
    return 0
