"""Fixtures of the tests of files."""

import pytest
from robots import SCARA, write

from dhcal_pin.io import read_dh
from dhcal_pin.robot import Chain


@pytest.fixture(scope="session")
def scara(tmp_path_factory) -> Chain:
    """Arm with a revolute joint `shoulder` and a prismatic joint `lift`."""
    return Chain.from_dh(read_dh(write(tmp_path_factory.mktemp("scara"), "scara.dh.toml", SCARA)))
