"""What other unknowns would have brought: a fit with too few of them looks like noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from . import calibration, tables
from .chain import Chain
from .evaluation import ENDINGS
from .measurements import Measurement
from .result import Result

# All that positions and poses can tell of any arm, wherever instrument and target are.
EVERYTHING = "minimal,base,tool"
# What leaves more than this share of the error is not worth a word; nor is what is left of exact readings.
WORTH, EXACT = 0.8, 1e-6


def narrow(sets: Sequence[str]) -> bool:
    """Whether sets are of the robot, and fewer than EVERYTHING."""
    frames = {"base", "tool"}
    full = frames <= set(sets) and {"minimal", "placement"} & set(sets)
    return not full and not set(sets) <= frames


def missed(fit: Result, chain: Chain, data: Sequence[Measurement], **options: Any) -> str:
    """A sentence on what EVERYTHING would bring on the samples that were not fitted; "" if little.

    Args:
        fit: as it is.
        chain: the nominal robot.
        data: what was fitted.
        options: of `calibrate`, as for the fit.
    """
    now = fit.comparisons[0]
    group = next(group for group in ENDINGS if f"{group}_rms{ENDINGS[group]}" in now.after)
    key = f"{group}_rms{ENDINGS[group]}"
    if now.after[key] < EXACT * now.before[key]:
        return ""
    wider = calibration.calibrate(chain, data, EVERYTHING, **options)
    then = wider.comparisons[0]
    if now.title == "fitted" or not wider.converged or then.after[key] > WORTH * now.after[key]:
        return ""
    left, of = tables.headline([then]), tables.headline([now])
    return (
        f"--parameters {EVERYTHING} would leave {left.after} RMS {tables.WORDS[group]} on samples left out, "
        f"and not {of.after}: the unknowns that were chosen cannot take up what was measured"
    )
