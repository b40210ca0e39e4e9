"""Base and tool of another set-up: recognize them in measurements, and fit them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..calibration import Result, accuracy, calibrate
from ..measurements.base import Measurement
from ..measurements.configurations import group_by_configuration
from ..robot.chain import Chain

# Base and tool are taken to be those of another set-up if fitting them to the measurements divides the error
# by at least this number.
ERROR_RATIO = 10.0
# Smaller errors [m or rad] show no difference of the frames.
MIN_ERROR = 1e-6
# Number of samples from which this is found out, or of measured values in different configurations: base and
# tool have up to 12 parameters. With fewer it is unknown.
MIN_SAMPLES, MIN_VALUES, MAX_SAMPLES = 12, 20, 1000

FRAMES_WARNING = "the frames (base, tool) differ: run again with --fit-frames"
# The same for accuracy by ISO 9283, which --fit-frames changes.
ISO_FRAMES_WARNING = (
    "the frames (base, tool) differ, and the accuracy AP contains it: write the measured base and reflector "
    "into the sidecar; repeatability is right"
)
ISO_FITTED_WARNING = "base and tool are fitted to these poses: AP is less than that of ISO 9283"


def fit_frames(
    chain: Chain,
    data: Sequence[Measurement],
    known: Mapping[str, float] | None = None,
    frames: str = "base,tool",
) -> Result:
    """Fit base and tool to measurements; samples have equal weights unless there are outliers."""
    fit = calibrate(chain, data, frames, known=known, loss="linear")
    if fit.n_outliers:
        fit = calibrate(chain, data, frames, known=known, loss="tukey")
    # A validation is not judged by another loss.
    return replace(fit, with_auto=None)


def frames_differ(chain: Chain, data: Sequence[Measurement], known: Mapping[str, float]) -> bool:
    """Check whether fitting base and tool to the measurements would reduce the error many times."""
    n_samples = sum(len(item.rows) for item in data)
    n_values = sum(len(np.unique(group_by_configuration(item.q))) * item.residual_dim for item in data)
    if n_samples < MIN_SAMPLES and n_values < MIN_VALUES:
        return False
    group, error = next(iter(accuracy(chain, data, known).groups.items()))
    if error.rms < MIN_ERROR:
        return False
    step = max(1, -(-n_samples // MAX_SAMPLES))
    fit = fit_frames(chain, [item.take(np.s_[::step]) for item in data], known)
    # Outliers are in neither figure.
    given = accuracy(chain, fit.counted, known).groups[group]
    return ERROR_RATIO * fit.comparisons[-1].after.groups[group].rms < given.rms
