"""Cross-check of the Jacobian on shipped and random robots."""

import numpy as np
import pytest
from robots import URDF, random_table

from dhcal_pin.io import read_robot
from dhcal_pin.paper import crosscheck
from dhcal_pin.robot import Chain, DHTable

KEYS = ("theta", "d", "a", "alpha")


@pytest.mark.parametrize("file", sorted(p.name for p in [*URDF.glob("*.urdf"), *URDF.glob("*.dh.toml")]))
def test_all_routes_agree_on_every_shipped_robot(file):
    rows = crosscheck(read_robot(URDF / file))
    assert len(rows) == 6
    for row in rows:
        assert row.difference <= (1e-7 if "differences" in row.route else 1e-12), row.route


@pytest.mark.parametrize("convention", ["standard", "modified"])
@pytest.mark.parametrize("slides", [False, True])
def test_all_routes_agree_on_a_single_joint(convention, slides):
    """Pinocchio returns the Jacobian of a single joint as a vector."""
    one = {key: np.array([value]) for key, value in zip(KEYS, (0.3, 0.2, -0.1, 0.7), strict=True)}
    limits = {"beta": np.zeros(1), "lower": np.array([-1.0]), "upper": np.ones(1)}
    table = DHTable(convention, ("only",), np.array([slides]), **one, **limits)
    assert all(row.agrees for row in crosscheck(Chain.from_dh(table)))


def test_all_routes_agree_on_random_tables():
    rng = np.random.default_rng(5)
    for convention in ("standard", "modified"):
        table = random_table(rng, convention, 5)
        for row in crosscheck(Chain.from_dh(table), 20):
            assert row.agrees, row


def test_all_routes_agree_on_a_robot_with_a_mimic_joint(mimicking):
    assert mimicking.n_joints < len(mimicking.moving_joints)
    for row in crosscheck(mimicking, 20):
        assert row.agrees, row
