"""Wrong arguments of the public functions: the message names the argument and what is expected."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robots import paper

from dhcal_pin.calibration import accuracy, calibrate, calibrate_stream, cross_validate, k_fold, split
from dhcal_pin.exceptions import InvalidArgumentError, UnknownNameError
from dhcal_pin.io import read_measurements
from dhcal_pin.measurements import Noise, Position
from dhcal_pin.paper import error_factors
from dhcal_pin.robot import Chain

pytestmark = pytest.mark.usefixtures("unsuspected")

CHAIN = Chain.from_dh(paper("sim_6dof"))
DATA = Position(np.random.default_rng(0).uniform(-3, 3, (40, 6)), np.zeros((40, 3)))


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (calibrate, (DATA, CHAIN), "chain: expected a Chain, got .* Position; the chain comes first"),
        (
            calibrate,
            ("arm.urdf", DATA),
            "chain: expected a Chain, got the path 'arm.urdf'; read a robot with",
        ),
        (
            calibrate,
            (CHAIN, "laser.csv"),
            r"data: expected measurements, got the path 'laser.csv'; .*read_meas",
        ),
        (calibrate, (CHAIN, Path("laser.csv")), r"data: expected measurements, got the path 'laser.csv'"),
        (calibrate, (CHAIN, [DATA, "laser.csv"]), "data: expected measurements, got the path 'laser.csv'"),
        (
            calibrate,
            (CHAIN, DATA.q),
            "data: expected measurements, got an object of type ndarray, such as Pose",
        ),
        (calibrate, (CHAIN, None), "data: expected measurements, got an object of type NoneType"),
        (calibrate, (CHAIN, CHAIN), "data: expected measurements, got .* Chain; the chain comes first"),
        (calibrate, (CHAIN, []), "no measurements to fit; expected at least one sample"),
        (calibrate_stream, (DATA, lambda: [DATA]), "chain: expected a Chain"),
        (accuracy, (DATA, [CHAIN]), "chain: expected a Chain"),
        (accuracy, (CHAIN, "laser.csv"), "data: expected measurements"),
        (split, ("laser.csv", 0.3), "data: expected measurements"),
        (k_fold, (CHAIN, 5), "data: expected measurements"),
        (read_measurements, (5, CHAIN), "source has type int; expected a path or a data frame"),
        (error_factors, (paper("sim_6dof"), "a"), "error_factors: q of type str is not an array of numbers"),
    ],
)
def test_wrong_types_are_named(function: Any, arguments: tuple[Any, ...], message: str):
    kwargs = {"parameters": "dh"} if function is calibrate else {}
    with pytest.raises(InvalidArgumentError, match=message):
        function(*arguments, **kwargs)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        (
            {"parameters": 5},
            InvalidArgumentError,
            "parameters has type int; expected names of parameter sets",
        ),
        ({"session": "x"}, UnknownNameError, "unknown session option 'x'; choose from auto, unordered, off"),
        ({"max_iterations": -1}, InvalidArgumentError, "max_iterations is -1; expected at least 1"),
        (
            {"max_iterations": 2.5},
            InvalidArgumentError,
            "max_iterations is 2.5; expected at least 1, a",
        ),
        ({"method": "newton"}, UnknownNameError, "unknown method 'newton'; choose from lm, gn"),
        (
            {"loss": "l1"},
            UnknownNameError,
            "unknown loss 'l1'; choose from auto, linear, huber, cauchy, tukey",
        ),
        (
            {"known": {"wire1.x": 0.0}},
            UnknownNameError,
            "known value of 'wire1.x': no such .*; these measurements have none",
        ),
        (
            {"holdout": "check.csv"},
            InvalidArgumentError,
            "holdout: expected measurements, got the path 'check.csv'",
        ),
        (
            {"bounds": {"x9": (-1.0, 1.0)}},
            UnknownNameError,
            "bounds for 'x9': no such parameter; choose from theta1",
        ),
        (
            {"bounds": {"d1": (5.0, 6.0)}},
            InvalidArgumentError,
            r"\[5.0, 6.0\] must contain the nominal value",
        ),
        (
            {"bounds": {"d1": (-5.0, 6.0)}, "method": "gn"},
            InvalidArgumentError,
            "bounds require method 'lm'; method 'gn' does not support bounds",
        ),
        ({"loss": "huber", "method": "gn"}, InvalidArgumentError, "loss 'huber' requires method 'lm'"),
    ],
)
def test_wrong_values_are_named(kwargs: dict[str, Any], error: type[Exception], message: str):
    with pytest.raises(error, match=message):
        calibrate(CHAIN, DATA, **{"parameters": "dh", **kwargs})


def test_a_share_of_held_out_samples_is_that_of_split():
    with pytest.raises(InvalidArgumentError, match=r"holdout: .*dhcal_pin.split\(data, fraction\) holds out"):
        calibrate(CHAIN, DATA, "dh", holdout=0.3)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("values", [(-1e-4, 0.0), (0.0, np.nan), ("1mm", 0.0), ((1e-4, 2e-4), 0.0)])
def test_noise_is_a_finite_number(values: tuple[Any, Any]):
    with pytest.raises(InvalidArgumentError, match="expected a finite number of at least 0"):
        Noise(*values)


def test_one_measurement_needs_no_list(sim_6dof, sim_6dof_actual):
    q = np.random.default_rng(0).uniform(-3, 3, (40, 6))
    data = Position(q, sim_6dof_actual.poses(q)[:, :3, 3])
    (fitted,), (held_out,) = split(data, 0.25)
    fit = calibrate(sim_6dof, fitted, "dh", holdout=held_out)
    assert fit.comparisons[0].n_samples == 10
    assert fit.validate(held_out) == accuracy(fit.chain, held_out)
    assert len(k_fold(fitted, 5)) == 5
    with pytest.raises(InvalidArgumentError, match="folds has type int; expected folds such as k_fold"):
        cross_validate(fit, 1)  # pyright: ignore[reportArgumentType]
    assert cross_validate(fit, k_fold(fitted, 5)).accuracy["position_samples"] == 30


def test_repr_is_one_line(sim_6dof, sim_6dof_actual):
    q = np.random.default_rng(0).uniform(-3, 3, (40, 6))
    fit = calibrate(sim_6dof, Position(q, sim_6dof_actual.poses(q)[:, :3, 3]), "dh")
    assert repr(fit).startswith("Result(24 parameters, 40 samples, RMS position error ")
    assert repr(fit).endswith("after, cross-validated)")
    assert len(repr(fit)) < 120
