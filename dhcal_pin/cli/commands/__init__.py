"""Commands of `dhcal`: one module per command.

Each module has `EXAMPLE`, `ARGUMENTS` and `run(args)`, and a row of `COMMANDS` in `cli/main.py`.

Modules import only light modules at their top, and packages that load their public names on first use, such
as `io`. Everything else that loads NumPy or Pinocchio is imported inside functions ("lazy import"), so that
help pages and argument errors appear at once.
"""
