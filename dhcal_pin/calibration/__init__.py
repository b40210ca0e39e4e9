"""Calibration: from a nominal chain and measurements to a result with its accuracy."""
