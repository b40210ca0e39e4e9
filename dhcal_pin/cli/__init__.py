"""Command line `dhcal`: options, calibration jobs, fleets and output files.

Commands are in `commands`, their console output in `screens`. Algorithms, file formats and report pages
do not belong here.
"""
