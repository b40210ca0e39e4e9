"""Fixtures that tests share: the paper's arms and a browser."""

import gc
import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

# The workers of pytest share the processors, and NumPy reads this when it is loaded.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")
# Otherwise every command that a test starts compiles the package anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import pytest
from pages import ARGUMENTS, CHROMIUM, VIEWPORT, Browser, Window, window_of
from robots import missing, nominal_arm, paper

from dhcal_pin import plots
from dhcal_pin.calibration import evidence, procedure, verdict
from dhcal_pin.calibration.cameras import diagnosis, image_session
from dhcal_pin.calibration.cameras.mistakes import rig
from dhcal_pin.cli import main
from dhcal_pin.plausibility.diagnosis import NO_EVIDENCE, Diagnosis
from dhcal_pin.robot.chain import Chain
from dhcal_pin.robot.urdf import parse_urdf

# Otherwise every process compiles all tests anew.
sys.dont_write_bytecode = False
# The garbage collector would else take a tenth of the time of the tests.
gc.set_threshold(50_000, 20, 50)
# Benchmarks need rivals in environments of their own.
collect_ignore_glob = ["bench_*.py"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark notebooks in Jupyter as slow, but one; `test_tutorials.py` runs the cells of all of them."""
    for item in items:
        if item.path.suffix == ".ipynb" and item.path.stem != "01_paper":
            item.add_marker(pytest.mark.slow)


def pytest_collection_finish() -> None:
    """Spare the garbage collector the thousands of collected tests, which stay to the end."""
    gc.freeze()


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[Any, str, str]]:
    """Function that runs a command and returns its exit status, stdout and stderr."""

    def call(*args: object) -> tuple[Any, str, str]:
        try:
            status = main.main([str(arg) for arg in args])
        except SystemExit as stop:
            status = stop.code
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return call


@pytest.fixture(scope="session")
def sim_6dof() -> Chain:
    return Chain.from_dh(paper("sim_6dof"))


@pytest.fixture(scope="session")
def sim_6dof_actual() -> Chain:
    return Chain.from_dh(paper("sim_6dof_actual"))


@pytest.fixture(scope="session")
def sim_3dof() -> Chain:
    return Chain.from_dh(paper("sim_3dof"))


@pytest.fixture(scope="session")
def ur10() -> Chain:
    return nominal_arm("ur10")


@pytest.fixture(scope="session")
def mimicking() -> Chain:
    """An arm whose third joint follows its second, backwards, half as fast again, and from elsewhere."""
    arm = Chain.from_dh(paper("sim_6dof_actual"))
    follow = b'<mimic joint="joint_2" multiplier="-1.5" offset="0.2"/>'
    head, tail = arm.urdf.data.split(b'<joint name="joint_3"')
    body, rest = tail.split(b"</joint>", 1)
    data = head + b'<joint name="joint_3"' + body + follow + b"</joint>" + rest
    return Chain.from_urdf(parse_urdf(data, "mimicking.urdf"), "tool0")


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the plots of reports, which take a second, where only their texts are looked at."""
    monkeypatch.setattr(plots.SvgPanels, "draw", lambda self, plot, key, *_, **__: f'<svg id="{key}"></svg>')


def leave_out_events(patch: pytest.MonkeyPatch) -> None:
    """Leave out the search for events of a measurement."""
    patch.setattr(procedure, "can_have_session", lambda _: False)
    # Otherwise the poses of the images are calibrated for an event that is then not looked for.
    patch.setattr(image_session, "find_image_session", lambda *_: None)


def leave_out_mistakes(patch: pytest.MonkeyPatch) -> None:
    """Leave out the search for mistakes and events of a measurement, which takes seconds for some arms."""
    patch.setattr(evidence, "diagnose_mixups", lambda *_: Diagnosis(NO_EVIDENCE))
    leave_out_events(patch)


@pytest.fixture(scope="module")
def unsuspected() -> Iterator[None]:
    """Leave out the search for mistakes and events in all tests of a module."""
    with pytest.MonkeyPatch.context() as patch:
        leave_out_mistakes(patch)
        yield


@pytest.fixture
def unsuspected_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the search for mistakes and events in one test."""
    leave_out_mistakes(monkeypatch)


@pytest.fixture
def uneventful(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the search for events while images were taken, unless a test is slow.

    Mistakes in the joint values of the images are a part of it. `session/test_image_session.py` is about it.
    """
    if not request.node.get_closest_marker("slow"):
        leave_out_events(monkeypatch)


@pytest.fixture
def untried(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the trials of causes of errors in images, unless a test is slow.

    They take most of the time of a calibration of images. `calibration/test_hand_eye.py` is about them.
    """
    if not request.node.get_closest_marker("slow"):
        monkeypatch.setattr(diagnosis, "_try_causes", lambda *_: {})


@pytest.fixture
def ordered_axes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the trials of other orders of image axes, unless a test is slow.

    Each takes a calibration of the camera. `calibration/test_cameras.py` is about them.
    """
    if not request.node.get_closest_marker("slow"):
        monkeypatch.setattr(rig, "exchange_axes", lambda _, data: (tuple(data), ()))


@pytest.fixture
def inside_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the calibrations without each region of joint space, for reports and JSON documents."""
    without_regions = partial(evidence.estimate_generalization, folds=())
    monkeypatch.setattr(evidence, "estimate_generalization", lambda *args: without_regions(*args[:-1]))


@pytest.fixture(scope="module")
def own_loss() -> Iterator[None]:
    """Judge a calibration by its own loss alone; the verdict of another loss takes a second calibration."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verdict, "_other_loss", lambda *_: [])
        yield


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        missing("Chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        process = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield Browser(process)
        process.close()


@pytest.fixture(scope="session")
def shared_window(browser: Browser) -> Iterator[Window]:
    with window_of(browser) as out:
        yield out


@pytest.fixture
def window(shared_window: Window) -> Iterator[Window]:
    shared_window.page.set_viewport_size(VIEWPORT)
    yield shared_window
    shared_window.check()
    # A scene that stays open is drawn again and again while other tests run.
    shared_window.page.goto("about:blank")
