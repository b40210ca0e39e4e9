"""Inclinations of a tool, against directions by hand, and their use together with positions."""

from __future__ import annotations

import numpy as np
import pytest

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.estimation import select_parameters

LEVEL = dh.Noise(1e-4, 1e-4)


def test_roll_and_pitch_are_rotations_about_x_then_y(sim_6dof):
    """A sensor along the tool has the rotation Rx(roll)·Ry(pitch), up to a turn about gravity."""
    rng = np.random.default_rng(0)
    angles = rng.uniform(-1.2, 1.2, (20, 2))
    turned = se3.exp3(np.pad(angles[:, :1], ((0, 0), (0, 2)))) @ se3.exp3(
        np.stack([np.zeros(20), angles[:, 1], np.zeros(20)], -1)
    )
    poses = se3.transform(turned, np.zeros((20, 3)))
    chain, q = sim_6dof, rng.uniform(-1, 1, (20, 6))
    frames = chain.forward_kinematics(q)
    frames = type(frames)(frames.columns, np.ascontiguousarray(poses[:, :3].transpose(2, 1, 0)))
    item = dh.Inclination(q, angles)
    assert np.abs(item.residual(frames, np.zeros(5))).max() < 1e-12


def test_lengths_do_not_change_inclinations(sim_6dof):
    rng = np.random.default_rng(1)
    data = dh.Inclination.simulate(sim_6dof, rng.uniform(-2, 2, (60, 6)), LEVEL, rng)
    fit = dh.calibrate(sim_6dof, data, "placement", extend="none")
    lengths = [i for i, parameter in enumerate(fit.parameters) if parameter.unit == "m"]
    assert fit.observable_fraction[lengths].max() < 1e-9
    assert fit.unobservable


def test_inclinations_add_to_few_positions():
    nominal = dh.Chain.from_urdf("example:ur10", tip="tool0")
    errors = select_parameters(nominal, "minimal")
    std = np.array([3e-3 if parameter.unit == "rad" else 1e-3 for parameter in errors.parameters])
    ratios = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        truth = errors.at(std * rng.standard_normal(len(std)))
        q = rng.uniform(-2, 2, (172, 6))
        positions = dh.Position.simulate(truth, q[:12], LEVEL, rng)
        angles = dh.Inclination.simulate(truth, q[12:72], LEVEL, rng)
        test = dh.Position.simulate(truth, q[72:], dh.Noise(), rng)
        alone, both = (
            dh.calibrate(nominal, data, "minimal,base,tool", extend="none")
            for data in ([positions], [positions, angles])
        )
        ratios.append(both.validate(test)["position_rms_m"] / alone.validate(test)["position_rms_m"])
    print(f"error with inclinations over error without: {np.round(ratios, 2)}")
    assert np.median(ratios) < 0.8


def test_angles_have_two_columns(sim_6dof):
    with pytest.raises(dh.DhcalError, match=r"Inclination: angles"):
        dh.Inclination(np.zeros((4, 6)), np.zeros((4, 3)))
