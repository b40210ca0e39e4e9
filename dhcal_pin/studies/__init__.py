"""Studies: grids of simulated calibrations."""
