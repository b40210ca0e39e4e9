"""The offline page: what it shows is proven by its pixels, where it says the tool is by Pinocchio."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from conftest import URDF, paper, robot_file

from dhcal_pin import se3
from dhcal_pin.calibration import calibrate
from dhcal_pin.chain import Chain
from dhcal_pin.cli import main
from dhcal_pin.errors import DhcalError
from dhcal_pin.lengths import Distance
from dhcal_pin.measurements import Noise
from dhcal_pin.poses import Pose
from dhcal_pin.positions import Position, Targets
from dhcal_pin.urdf import parse_urdf
from dhcal_pin.viewer import scene_html, show

CHROMIUM = "/usr/bin/chromium"
# Software rendering, which works without a graphics card and in a container.
ARGUMENTS = (
    "--no-sandbox --disable-dev-shm-usage --use-gl=angle --use-angle=swiftshader "
    "--enable-unsafe-swiftshader --hide-scrollbars"
).split()
FILES = {
    "ur10": ("ur_description/urdf/ur10_robot.urdf", None),
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand_tcp"),
    "z1": ("z1_description/urdf/z1.urdf", None),
    "so101": ("so_arm_description/urdf/so101.urdf", None),
}
ROBOTS = ("paper", *FILES)

# Draws the scene now and looks at its pixels: how many have each layer's colour, and a fingerprint.
LOOK = """([name, values]) => {
  if (name) dhcal[name](...values);
  const { viewer } = dhcal, canvas = viewer.renderer.domElement;
  viewer.render();
  const { width, height } = canvas, copy = document.createElement("canvas");
  Object.assign(copy, { width, height });
  const context = copy.getContext("2d");
  context.drawImage(canvas, 0, 0);
  const data = context.getImageData(0, 0, width, height).data;
  const seen = { nominal: 0, calibrated: 0, frames: 0, points: 0, arrows: 0, black: 0, print: 0 };
  for (let i = 0; i < data.length; i += 4) {
    const [r, g, b] = data.subarray(i, i + 3);
    if (b - r > 40 && g > r && r > 40) seen.nominal++;
    if (r - b > 70 && g - b > 35 && g > 0.55 * r) seen.calibrated++;
    if (g - r > 60 && g - b > 15) seen.frames++;
    if (r < 40 && g < 55 && b > 45 && b < 90) seen.points++;
    if (r - g > 45 && b - g > 25) seen.arrows++;
    if (r + g + b < 30) seen.black++;
    seen.print = (Math.imul(seen.print, 31) + r + 7 * g + 49 * b) | 0;
  }
  return seen;
}"""


def arms(name: str) -> tuple[Chain, Chain]:
    """A nominal arm and one whose joints are off by some tenths of a millimetre and of a degree."""
    if name == "paper":
        return Chain.from_dh(paper("sim_6dof")), Chain.from_dh(paper("sim_6dof_actual"))
    file, tip = FILES[name]
    return perturbed(Chain.from_urdf(robot_file(file), tip))


def perturbed(nominal: Chain, scale: float = 5e-4) -> tuple[Chain, Chain]:
    rng = np.random.default_rng(1)
    stations = range(2, nominal.tool_station, 2)
    return nominal, nominal.displaced({s: se3.exp6(scale * rng.standard_normal(6)) for s in stations})


def poses(chain: Chain, m: int) -> np.ndarray:
    """Joint values (m, n) well inside the limits, at most 1.3 rad or 0.3 m from zero."""
    reach = 1.3 if not chain.prismatic.any() else 0.3
    lower, upper = np.maximum(chain.lower, -reach), np.minimum(chain.upper, reach)
    return np.random.default_rng(2).uniform(lower, upper, (m, chain.size))


@dataclass(frozen=True)
class Window:
    """One page of the browser and everything it complained about or asked for."""

    page: Any
    complaints: list[str]
    requests: list[str]

    def open(self, path: Path, html: str) -> None:
        """Loads a page from disk and waits until it says that it is ready."""
        path.write_text(html, encoding="utf-8")
        self.page.goto(path.as_uri())
        self.page.wait_for_function("window.dhcal && window.dhcal.ready === true")

    def look(self, name: str = "", *values: Any) -> dict[str, int]:
        """What is seen, after a call of the page if there is one: together they draw only once."""
        return self.page.evaluate(LOOK, [name, list(values)])

    def tip(self, arm: str) -> np.ndarray:
        """Where the page says an arm's tool is, (4, 4)."""
        return np.array(self.page.evaluate("arm => dhcal.tip(arm)", arm))

    def call(self, name: str, *values: Any) -> None:
        """A function of the page."""
        self.page.evaluate("([name, values]) => dhcal[name](...values)", [name, list(values)])


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if not os.path.exists(CHROMIUM) and os.environ.get("CI") != "true":
        pytest.skip("no Chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture
def window(browser: Any) -> Iterator[Window]:
    page = browser.new_page(viewport={"width": 800, "height": 460})
    out = Window(page, [], [])
    page.on("console", lambda message: out.complaints.append(message.text))
    page.on("pageerror", lambda error: out.complaints.append(str(error)))
    page.on("request", lambda request: out.requests.append(request.url))
    yield out
    page.close()
    assert not out.complaints
    assert all(url.startswith(("file:", "data:", "about:")) for url in out.requests), out.requests


def check_tips(window: Window, nominal: Chain, calibrated: Chain) -> None:
    for q in poses(nominal, 5):
        window.call("setJoints", q.tolist())
        for arm, chain in (("nominal", nominal), ("calibrated", calibrated)):
            assert np.abs(window.tip(arm) - chain.poses(q)[0]).max() <= 1e-9
            # And without our own kinematics in between.
            data = chain.model.createData()
            pin.framesForwardKinematics(chain.model, data, chain.configurations(q)[0])
            there = chain.base @ data.oMf[chain.frame_id].homogeneous @ chain.tool
            assert np.abs(window.tip(arm) - there).max() <= 1e-9


@pytest.mark.parametrize("name", ROBOTS)
def test_every_layer_is_seen_and_the_tips_are_pinocchios(name, window, tmp_path):
    nominal, calibrated = arms(name)
    data = Position.simulate(calibrated, poses(nominal, 12), Noise(5e-4), np.random.default_rng(3))
    start = 2.0 if name == "paper" else 60.0
    html = scene_html(nominal, calibrated, measurements=[data], magnification=start)
    assert len(html.encode()) < (1.2e6 if name == "paper" else 6e6)
    window.open(tmp_path / "scene.html", html)
    assert window.page.evaluate("dhcal.renderCalls()") > 10
    if name == "paper":
        # Its arms are centimetres apart: residuals are drawn longer than these errors can be.
        window.page.evaluate("placePoints(magnification = 60); magnification = 2")
    seen = window.look("setLayer", "frames", True)
    assert seen["black"] == 0
    for layer in ("frames", "arrows", "points", "nominal", "calibrated"):
        assert seen[layer] > 15, layer
        seen = window.look("setLayer", layer, False)
        assert seen[layer] == 0, layer
    window.call("setMagnification", 1)
    check_tips(window, nominal, calibrated)


@pytest.mark.parametrize("name", ["paper", "ur10"])
def test_every_slider_and_switch_changes_the_picture(name, window, tmp_path):
    nominal, calibrated = arms(name)
    data = Position.simulate(calibrated, poses(nominal, 12), Noise(5e-4), np.random.default_rng(3))
    window.open(tmp_path / "scene.html", scene_html(nominal, calibrated, measurements=[data]))
    page, before = window.page, window.look()["print"]
    for slider in (page.locator("#magnification"), *page.locator("#joints input").all()):
        where = window.tip("calibrated")
        slider.press("End")
        after = window.look()["print"]
        assert after != before
        assert np.abs(window.tip("calibrated") - where).max() > 1e-6
        before = after
    before = window.look("setMagnification", 20)["print"]
    for box in page.locator("#layers input").all():
        box.uncheck()
        after = window.look()["print"]
        assert after != before
        before = after
    where = window.tip("nominal")
    page.get_by_role("button", name="Play").click()
    page.wait_for_timeout(400)
    page.get_by_role("button", name="Pause").click()
    assert np.abs(window.tip("nominal") - where).max() > 1e-3
    still = window.tip("nominal")
    page.wait_for_timeout(100)
    assert np.array_equal(window.tip("nominal"), still)


def test_on_a_telephone_the_controls_unfold(window, tmp_path):
    window.page.set_viewport_size({"width": 390, "height": 780})
    nominal, calibrated = arms("paper")
    window.open(tmp_path / "scene.html", scene_html(nominal, calibrated, q=poses(nominal, 3)))
    page, slider = window.page, window.page.locator("#joints input").first
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    assert not slider.is_visible()
    assert page.locator("#pane canvas").bounding_box()["height"] > 600
    page.get_by_role("button", name="Controls").click()
    before = window.look()["print"]
    slider.scroll_into_view_if_needed()
    slider.press("End")
    assert window.look()["print"] != before
    page.wait_for_function("document.querySelector('#pane canvas').clientHeight < 450")
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    assert window.look()["calibrated"] > 100
    page.get_by_role("button", name="Controls").click()
    assert not slider.is_visible()


def test_errors_grow_by_the_exponential(window, tmp_path):
    nominal, calibrated = perturbed(Chain.from_dh(paper("sim_3dof")))
    window.open(tmp_path / "scene.html", scene_html(nominal, calibrated))
    grown = nominal.origins @ se3.exp6(37 * se3.log6(se3.inverse(nominal.origins) @ calibrated.origins))
    q = poses(nominal, 1)
    window.call("setJoints", q[0].tolist())
    window.call("setMagnification", 37)
    assert np.abs(window.tip("calibrated") - replace(nominal, origins=grown).poses(q)[0]).max() <= 1e-9
    assert np.abs(window.tip("nominal") - nominal.poses(q)[0]).max() <= 1e-9


MIMIC = b"""<robot name="odd">
  <link name="world"/><link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/>
  <joint name="turn" type="continuous"><origin xyz="0.1 0 0.2" rpy="0.3 1.5707963267948966 0"/>
    <parent link="world"/><child link="a"/><axis xyz="0.6 0 0.8"/></joint>
  <joint name="slide" type="prismatic"><origin xyz="0 0.1 0.3"/><parent link="a"/><child link="b"/>
    <axis xyz="0 1 0"/><limit lower="-0.4" upper="0.4" effort="1" velocity="1"/></joint>
  <joint name="follow" type="revolute"><origin xyz="0.2 0 0"/><parent link="b"/><child link="c"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/>
    <mimic joint="turn" multiplier="-0.5" offset="0.2"/></joint>
  <joint name="aside" type="revolute"><parent link="b"/><child link="d"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="end" type="fixed"><origin xyz="0 0 0.1"/><parent link="c"/><child link="e"/></joint>
</robot>"""


def test_any_joint_in_any_place_without_anything_to_draw(window, tmp_path):
    nominal, calibrated = perturbed(Chain.from_urdf(parse_urdf(MIMIC, "odd.urdf"), "e"))
    away = se3.exp6(np.array([4.0, -3.0, 1.0, 0.3, -0.2, 2.0]))
    calibrated = replace(calibrated, base=away, tool=se3.translation([0.02, 0.0, 0.05]))
    html = scene_html(nominal, calibrated)
    window.open(tmp_path / "scene.html", html)
    assert "no visual geometry" in window.page.locator("#note").inner_text()
    check_tips(window, nominal, calibrated)
    assert window.look()["calibrated"] > 200
    # Both stand on the same base and hold the same tool, however far away that is.
    window.call("setMagnification", 500)
    window.call("setLayer", "calibrated", False)
    assert window.look()["nominal"] > 200


def test_a_result_shows_its_own_data_in_a_notebook(window, tmp_path, sim_6dof, sim_6dof_actual):
    truth = replace(sim_6dof_actual, base=se3.translation([2.0, 1.0, 0.5]))
    data = Pose.simulate(truth, poses(truth, 20), Noise(1e-4, 1e-4), np.random.default_rng(0))
    fit = calibrate(sim_6dof, data, "dh,base")
    cell = show(sim_6dof, fit, title='A <b>"&</b> arm')._repr_html_()
    window.page.set_content(f"<!DOCTYPE html>{cell}")
    frame = window.page.frames[1]
    frame.wait_for_function("window.dhcal && window.dhcal.ready === true")
    assert frame.locator("h1").inner_text() == 'A <b>"&</b> arm'
    assert frame.evaluate("dhcal.scene.points.length") == 20
    frame.evaluate("q => dhcal.setJoints(q)", data.q[0].tolist())
    assert (
        np.abs(np.array(frame.evaluate("dhcal.tip('calibrated')")) - fit.chain.poses(data.q[:1])[0]).max()
        <= 1e-9
    )
    before = fit.reference.poses(data.q[:1])[0]
    assert np.abs(np.array(frame.evaluate("dhcal.tip('nominal')")) - before).max() <= 1e-9


def test_reflectors_beside_the_tool_and_lengths_are_no_residuals(window, tmp_path, sim_6dof):
    rng = np.random.default_rng(0)
    q = poses(sim_6dof, 9)
    data = [kind.simulate(sim_6dof, q, Noise(), rng) for kind in (Targets, Distance)]
    places = (0.05, 0, 0.01, 0, 0.04, -0.02)
    known = {unknown.name: place for unknown, place in zip(data[0].unknowns, places, strict=True)}
    html = scene_html(sim_6dof, measurements=data, known=known)
    window.open(tmp_path / "scene.html", html)
    assert window.page.evaluate("dhcal.scene.poses.length") == 18
    assert window.page.evaluate("dhcal.scene.points.length") == 9
    assert window.page.evaluate("largest") < 1e-8
    assert window.look()["points"] > 15


def test_two_meshed_arms_stay_small_and_come_out_the_same():
    nominal, calibrated = perturbed(Chain.from_urdf(robot_file("ur_description/urdf/ur5_robot.urdf")))
    first, second = (scene_html(nominal, calibrated, q=poses(nominal, 20)) for _ in range(2))
    assert first == second
    assert len(first.encode()) < 6e6
    assert '"mesh":0' in first


def test_missing_meshes_become_a_skeleton(tmp_path):
    source = robot_file("ur_description/urdf/ur5_robot.urdf")
    lost = tmp_path / "arm.urdf"
    lost.write_bytes(source.read_bytes())
    page = scene_html(Chain.from_urdf(lost))
    assert "a mesh is missing" in page
    assert '"cylinder"' in page
    found = scene_html(Chain.from_urdf(lost), package_dirs=list(source.parents))
    assert '"mesh":0' in found


def test_what_does_not_fit_together_is_said(sim_6dof):
    with pytest.raises(DhcalError, match="the arms differ"):
        scene_html(sim_6dof, Chain.from_dh(paper("sim_3dof")))
    with pytest.raises(DhcalError, match="q has shape"):
        scene_html(sim_6dof, q=np.zeros((2, 3)))
    with pytest.raises(DhcalError, match="magnification"):
        scene_html(sim_6dof, magnification=0.5)


def test_view_writes_the_page(tmp_path):
    page = tmp_path / "scene.html"
    arms = [str(URDF / f"{name}.dh.toml") for name in ("experiment", "experiment_published")]
    data = str(URDF / "experiment_table5.csv")
    assert main(["view", *arms, "--data", data, "--html", str(page)]) == 0
    text = page.read_text()
    assert "experiment and experiment_published" in text
    assert main(["view", arms[0], "--html", str(tmp_path / "no" / "scene.html")]) == 2
