"""Fixtures for the tests of diagnostics."""

from collections.abc import Callable
from pathlib import Path

import pytest

from dhcal_pin.diagnostics import find_input_warnings
from dhcal_pin.io import read_measurement_file
from dhcal_pin.measurements import MountedRig
from dhcal_pin.robot import Chain


@pytest.fixture
def warnings_of(tmp_path: Path) -> Callable[[Chain, str], list[str]]:
    """Return a function from a robot and the text of a file to the warnings."""

    def find(chain: Chain, text: str, rig: MountedRig | None = None) -> list[str]:
        path = tmp_path / "data.csv"
        path.write_text(text)
        return find_input_warnings(chain, read_measurement_file(path, chain, rig=rig))

    return find
