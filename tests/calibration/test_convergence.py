"""Fits that do not converge: with the options that the reason names, the same calibration does."""

import re
from typing import Any

import numpy as np
import pytest

from dhcal_pin import Result, calibrate, select_parameters
from dhcal_pin.calibration import verdict
from dhcal_pin.measurements import KINDS, Noise

# Calibrations of arms with large errors, of which nothing asks for mistakes.
pytestmark = pytest.mark.usefixtures("unsuspected")


def fitted(arm, kind: str, size: float, **options: Any) -> Result:
    """Calibrate an arm with errors of a size in prior standard deviations."""
    rng, errors = np.random.default_rng(1), select_parameters(arm, "minimal")
    truth = errors.at(size * errors.priors * rng.standard_normal(len(errors.parameters)))
    data = KINDS[kind].simulate(truth, rng.uniform(-2.5, 2.5, (40, 6)), Noise(1e-4, 1e-4), rng)
    return calibrate(arm, data, extend="none", **options)


def reason(fit: Result) -> str:
    """Return the reason that a calibration is refused."""
    assert not fit.converged
    assert fit.verdict.status == "refused"
    (text,) = (each for each in fit.verdict.reasons if "converge" in each)
    return text


@pytest.mark.parametrize(
    ("kind", "size", "method", "max_iterations", "remedy"),
    [
        ("position", 1, "lm", 1, "Allow more (--max-iterations 600)."),
        ("distance", 20, "lm", 1, "Allow more (--max-iterations 600)."),
        ("point", 20, "lm", 100, "Allow more (--max-iterations 600)."),
        ("pose", 20, "gn", 2, "Allow more (--max-iterations 600)."),
        ("pose", 1, "gn", 100, "Use --method lm."),
        ("distance", 1, "gn", 1, "Use --method lm --max-iterations 600."),
    ],
)
def test_the_named_options_help(sim_6dof, kind, size, method, max_iterations, remedy):
    text = reason(fitted(sim_6dof, kind, size, method=method, max_iterations=max_iterations))
    assert text.endswith(f". {remedy}")
    limit = re.search(r"--max-iterations (\d+)", text)
    method = "lm" if "--method lm" in text else method
    iterations = int(limit[1]) if limit else max_iterations
    assert fitted(sim_6dof, kind, size, method=method, max_iterations=iterations).converged


def test_no_option_is_named_that_does_not_help(sim_6dof, monkeypatch):
    """This fit needs more than 100 iterations."""
    monkeypatch.setattr(verdict, "MAX_CONTINUED", 1)
    text = reason(fitted(sim_6dof, "point", 20, max_iterations=50))
    assert text == "The fit did not converge in 50 iterations. It did not in 1 more, either."
