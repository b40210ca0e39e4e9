"""Progress of a calibration: every phase is named and its steps are counted."""

from itertools import pairwise

import numpy as np
import pytest
from robots import URDF

from dhcal_pin import Chain, Noise, Position, calibrate, read_dh
from dhcal_pin.plausibility import mend


@pytest.fixture(scope="module")
def arm():
    return Chain.from_dh(read_dh(URDF / "sim_6dof.dh.toml"))


def phases(arm, mistake=None, **options):
    rng = np.random.default_rng(0)
    q = rng.uniform(-2.0, 2.0, (60, 6))
    data = Position.simulate(arm, q, Noise(1e-4, 1e-4), rng)
    data = mend(arm, data, mistake) if mistake else data
    calls = []
    calibrate(arm, data, progress=lambda *call: calls.append(call), **options)
    assert all(1 <= step <= total for _, step, total in calls)
    for name in {name for name, _, _ in calls}:
        steps = [step for phase, step, _ in calls if phase == name]
        # A phase that comes again starts from its first step.
        assert all(b in (a + 1, 1) for a, b in pairwise(steps))
    return {name: total for name, _, total in calls}


def test_phases_of_a_calibration(arm):
    assert phases(arm) == {"fit": 100, "robust weights": 30, "joint error families": 3}


def test_geometry_alone(arm):
    assert phases(arm, extend="none", max_iterations=50) == {"fit": 50, "robust weights": 30}


def test_left_out_regions(arm):
    found = phases(arm, extend="none", holdout="region")
    assert set(found) == {"fit", "robust weights", "left-out regions"}
    assert found["left-out regions"] >= 5


def test_mistakes_that_are_looked_for(arm):
    first = {"fit", "robust weights", "joint error families"}
    found = phases(arm, "sign:joint_3")
    assert set(found) == first | {"looking for mistakes in the measurements"}
    found = phases(arm, "sign:joint_2+swap:joint_4:joint_5")
    assert set(found) == first | {"looking for pairs of mistakes"}


def test_gauss_newton(arm):
    assert phases(arm, method="gn") == {"fit": 100}
