"""Command line `dhcal`: commands, their options and their console output.

Each command is one module with `EXAMPLE`, `add_arguments(parser)` and `run(args)`, and one row of
`main.COMMANDS`. Algorithms, file formats and report pages do not belong here.

Command modules import only light modules at their top; everything that loads NumPy or Pinocchio is imported
inside functions ("lazy import"), so that help pages and argument errors appear at once.
"""
