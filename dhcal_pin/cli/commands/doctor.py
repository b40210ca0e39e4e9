"""`dhcal doctor`: say what is installed and whether it works."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict

from ...messages import message_line
from ..options import JSON, Options
from ..screens.streams import print_message

EXAMPLE = "dhcal doctor"
_STYLES = {"ok": "", "note": "yellow", "failed": "bold red"}

ARGUMENTS: Options = {
    "--json": JSON,
}


def run(args: Namespace) -> int:
    """Check the installation and calibrate a small robot."""
    try:
        from ...diagnostics.installation import check_installation  # lazy import: loads Pinocchio
        from ..outputs import require_writable_outputs, write_outputs
        from ..screens import console
    except ImportError as error:
        print_message(f"failed  imports: {message_line(error)}; install dhcal-pin again")
        return 1

    require_writable_outputs([args.json], [])
    checks = []
    for check in check_installation():
        checks.append(check)
        console.print_lines(f"{check.status:6}  {check.name}: {check.text}", style=_STYLES[check.status])
    is_working = all(check.status != "failed" for check in checks)
    write_outputs({}, args.json, {"works": is_working, "checks": [asdict(check) for check in checks]})
    return 0 if is_working else 1
