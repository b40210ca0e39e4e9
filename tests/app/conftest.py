"""Fixtures: a running `dhcal app`, and the files of the README's example."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from app_requests import CALIBRATE, App, start_app

from dhcal_pin.cli import main


@pytest.fixture(scope="session")
def app(tmp_path_factory: pytest.TempPathFactory) -> Iterator[App]:
    out = start_app(tmp_path_factory.mktemp("app"))
    yield out
    assert out.contents() == []
    assert out.stop() == 0
    assert list(out.folder.iterdir()) == []


@pytest.fixture(scope="session")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with robot and measurements of the README's example, and the result of its command.

    Without meshes, which take more time than the calibration.
    """
    folder = tmp_path_factory.mktemp("example")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        simulate = "simulate ur10.urdf --tip tool0 -m 100 --errors 1mm,0.3deg --noise 0.05mm --kind position"
        assert main.main(["convert", "example:ur10", "ur10.urdf"]) == 0
        Path("ur10.urdf").write_text(re.sub(r"(?s)<visual>.*?</visual>", "", Path("ur10.urdf").read_text()))
        assert main.main([*simulate.split(), "-o", "laser.csv"]) == 0
        outputs = ["-o", "ur10_calibrated.urdf", "--report", "report.html"]
        assert main.main([*CALIBRATE, *outputs]) == 0
    return folder
