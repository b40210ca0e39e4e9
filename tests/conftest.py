"""Shared places: the paper's tables, real robots, and arms with what real ones lack."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from pages import ARGUMENTS, CHROMIUM, VIEWPORT, Window, window_of

from dhcal_pin.io.dh_file import read_dh
from dhcal_pin.robot.chain import Chain
from dhcal_pin.robot.dh import DHTable
from dhcal_pin.robot.urdf import parse_urdf

# Benchmarks need rivals in environments of their own.
collect_ignore_glob = ["bench_*.py"]

URDF = Path(__file__).resolve().parent.parent / "urdf"


def paper(name: str) -> DHTable:
    return read_dh(URDF / f"{name}.dh.toml")


def robot_file(path: str) -> Path:
    """A URDF of example-robot-data, by its path under robots/."""
    root = metadata.distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data")
    return Path(str(root)) / "robots" / path


def random_table(rng: np.random.Generator, convention: str = "standard", size: int | None = None) -> DHTable:
    """A table of revolute and prismatic joints, a metre long at most a link."""
    n = size or int(rng.integers(1, 9))
    zero = np.zeros(n)
    return DHTable(
        convention,  # pyright: ignore[reportArgumentType]
        tuple(f"j{i + 1}" for i in range(n)),
        rng.random(n) < 0.3,
        rng.uniform(-np.pi, np.pi, n),
        rng.uniform(-0.5, 0.5, n),
        rng.uniform(-0.5, 0.5, n),
        rng.uniform(-np.pi, np.pi, n),
        zero,
        zero - np.inf,
        zero + np.inf,
    )


def random_joints(rng: np.random.Generator, table: DHTable, m: int) -> np.ndarray:
    """Any angle, and half a metre of slide each way."""
    return rng.uniform(-1, 1, (m, table.n_joints)) * np.where(table.prismatic, 0.5, np.pi)


def with_masses(chain: Chain, rng: np.random.Generator) -> Chain:
    """The same arm with some kilograms on every link, off its axes."""
    root = ElementTree.fromstring(chain.urdf.data)
    for link in root.iter("link"):
        for old in link.findall("inertial"):
            link.remove(old)
        xyz = " ".join(map(repr, rng.uniform(-0.2, 0.2, 3).tolist()))
        link.append(
            ElementTree.fromstring(
                f'<inertial><origin xyz="{xyz}"/><mass value="{rng.uniform(1, 3)}"/>'
                '<inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial>'
            )
        )
    heavy = Chain.from_urdf(parse_urdf(ElementTree.tostring(root), "heavy.urdf"), chain.tip)
    return replace(heavy, parameters=chain.parameters)


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
def mimicking() -> Chain:
    """An arm whose third joint follows its second, backwards, half as fast again, and from elsewhere."""
    arm = Chain.from_dh(paper("sim_6dof_actual"))
    follow = b'<mimic joint="joint_2" multiplier="-1.5" offset="0.2"/>'
    head, tail = arm.urdf.data.split(b'<joint name="joint_3"')
    body, rest = tail.split(b"</joint>", 1)
    data = head + b'<joint name="joint_3"' + body + follow + b"</joint>" + rest
    return Chain.from_urdf(parse_urdf(data, "mimicking.urdf"), "tool0")


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    if not os.path.exists(CHROMIUM) and os.environ.get("CI") != "true":
        pytest.skip("no Chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def shared_window(browser: Any) -> Iterator[Window]:
    with window_of(browser) as out:
        yield out


@pytest.fixture
def window(shared_window: Window) -> Iterator[Window]:
    shared_window.page.set_viewport_size(VIEWPORT)
    yield shared_window
    shared_window.check()
