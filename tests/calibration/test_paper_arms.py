"""Servo arms that are calibrated from photographs of a printed board: signs, accuracy, and its prediction."""

import re
from dataclasses import replace

import numpy as np
import pytest
from paper_arms import PaperArm, photograph

from dhcal_pin.calibration import Result, calibrate
from dhcal_pin.calibration.cameras.gate import fit_with_jitter
from dhcal_pin.calibration.reweighting import Fit
from dhcal_pin.estimation.solver import minimize


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def informed_error(shot: PaperArm) -> float:
    """Held-out error [m] of a fit that knows the signs and the sizes of all errors."""
    known = calibrate(shot.nominal, shot.images, turned=",".join(shot.arm.wrong) or "none")
    problem = known.problem
    std = [
        1.5e-3 if p.unit == "m" else np.deg2rad(15 if p.name.endswith("offset") else 1)
        for p in problem.errors.parameters
    ]
    weights = np.concatenate([1 / np.array(std), [1 / p.prior for p in problem.instrument_parameters]])
    data = tuple(item.with_jitter(np.zeros_like(item.jitter)) for item in known.data)
    exact = replace(problem.with_data(data).with_prior_weights(weights), temperature=1.0)
    fit = Fit(data, exact, known.solution, tuple(np.ones(len(item.rows)) for item in data))
    fit = fit_with_jitter(fit, 30)[0]
    x = minimize(fit.problem, x=fit.solution.x).x
    chain = problem.errors.at(x[: len(problem.errors.parameters)])
    return rms(shot.held_out_errors(chain, fit.problem.instruments(x)))


def errors_of(shot: PaperArm, fit: Result) -> tuple[float, float]:
    """Held-out errors before and after a calibration [m]."""
    states = (fit.nominal_refitted, fit.nominal_instruments), (fit.chain, fit.instruments)
    before, after = (rms(shot.held_out_errors(*state)) for state in states)
    return before, after


# Number of images, seeds, and largest geometric mean of the error relative to that of the informed fit.
SERIES = [
    (25, [2], 1.3),
    pytest.param(25, range(50), 1.3, marks=pytest.mark.slow),
    pytest.param(12, range(30), np.inf, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("n_images", "seeds", "max_ratio"), SERIES)
def test_signs_are_right_and_the_arm_is_as_good_as_if_its_errors_were_known(n_images, seeds, max_ratio):
    ratios, predictions = [], []
    for seed in seeds:
        shot = photograph(seed, n_images)
        fit = calibrate(shot.nominal, shot.images)
        assert fit.signs is not None
        if set(fit.signs.turned) != set(shot.arm.wrong):
            assert fit.verdict.status != "ok", seed
            assert n_images < 25 or fit.signs.questions, seed
            continue
        before, after = errors_of(shot, fit)
        assert after < before or fit.verdict.status != "ok", seed
        if np.isfinite(max_ratio):
            ratios.append(after / informed_error(shot))
            # The prediction contains play and sag: they are in the left-out images, too.
            if inside := fit.generalization.cross_validated:
                tool = rms(shot.tool_errors(fit.chain, fit.instruments))
                predictions.append(inside.after.groups["board"].rms / tool)
            else:
                print(seed, fit.generalization.cross_validated_reason)
    if ratios:
        print(f"{len(ratios)} arms, {len(predictions)} predictions: {ratios}, {predictions}")
        assert len(predictions) >= 0.9 * len(ratios)
        assert np.exp(np.mean(np.log(ratios))) < max_ratio
        assert 0.7 < np.exp(np.mean(np.log(predictions))) < 1.4


@pytest.mark.slow
def test_few_images_say_what_is_missing_and_this_helps():
    shot = photograph(4, 20)
    images = shot.images
    q = np.unique(images.q, axis=0)
    near = q[np.argsort(np.linalg.norm(q - np.median(q, axis=0), axis=1))[:5]]
    first = calibrate(shot.nominal, images.take(np.any(np.all(images.q[:, None] == near, 2), 1)))
    assert first.verdict.status == "refused"
    found = re.match(
        r"5 different images are too few .* Take at least 5 more, better (\d+)\. Turn the joints .*: (.*)\.",
        first.verdict.reasons[0],
    )
    assert found
    assert 5 + int(found[1]) == len(q)
    # The joints that are named move farther in the other images.
    for text in found[2].split(", "):
        match = re.fullmatch(r"(\w+) (\S+)° to (\S+)°", text)
        assert match
        name, low, high = match.groups()
        moved = np.rad2deg(np.ptp(q[:, shot.nominal.joint_names.index(name)]))
        assert moved > float(high) - float(low)
    fit = calibrate(shot.nominal, images)
    assert fit.verdict.status == "ok"
    assert fit.signs
    assert set(fit.signs.turned) == set(shot.arm.wrong)
    before, after = errors_of(shot, fit)
    assert after < 0.2 * before
