"""The offline page: what it shows is proven by its pixels, where it says the tool is by Pinocchio."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from pages import CLICK, READY, SLIDE, Window, window_of
from robots import URDF, paper, robot_file
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.calibration.result import Result
from dhcal_pin.cli.main import main
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import measurement_text
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.length import Distance
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.measurements.position import MultiTargetPosition, Position
from dhcal_pin.robot.chain import Chain
from dhcal_pin.robot.collision import Obstacle
from dhcal_pin.robot.sampling import WorkspaceConstraints
from dhcal_pin.robot.transmission import Transmission, n_coefficients, split_coefficients
from dhcal_pin.robot.urdf import parse_urdf
from dhcal_pin.visualization.scene import Preview, scene_html, show

pytestmark = pytest.mark.usefixtures("unsuspected")

FILES = {
    "ur10": ("ur_description/urdf/ur10_robot.urdf", None),
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand_tcp"),
    "z1": ("z1_description/urdf/z1.urdf", None),
    "so101": ("so_arm_description/urdf/so101.urdf", None),
}
PAPER = {"paper": "sim_6dof", "paper_3dof": "sim_3dof"}
ROBOTS = (*PAPER, *FILES)
# Robots whose page the fast suite opens: drawn by us, and with seven joints and meshes.
OPENED = ("paper", "panda")


def arms(name: str) -> tuple[Chain, Chain]:
    """A nominal arm and one whose joints are off by some tenths of a millimetre and of a degree."""
    if name in PAPER:
        return perturbed(Chain.from_dh(paper(PAPER[name])))
    file, tip = FILES[name]
    return perturbed(Chain.from_urdf(robot_file(file), tip))


def perturbed(nominal: Chain, scale: float = 5e-4) -> tuple[Chain, Chain]:
    rng = np.random.default_rng(1)
    stations = range(2, nominal.tool_frame_index, 2)
    return nominal, nominal.perturbed_at({s: se3.exp6(scale * rng.standard_normal(6)) for s in stations})


def poses(chain: Chain, m: int) -> np.ndarray:
    """Joint values (m, n) well inside the limits, at most 1.3 rad or 0.3 m from zero."""
    reach = 1.3 if not chain.prismatic.any() else 0.3
    lower, upper = np.maximum(chain.lower, -reach), np.minimum(chain.upper, reach)
    return np.random.default_rng(2).uniform(lower, upper, (m, chain.n_joints))


def check_tips(window: Window, nominal: Chain, calibrated: Chain) -> None:
    for q in poses(nominal, 5):
        window.call("setJoints", q.tolist())
        for arm, chain in (("nominal", nominal), ("calibrated", calibrated)):
            assert np.abs(window.tip(arm) - chain.poses(q[None])[0]).max() <= 1e-9
            # And without our own kinematics in between.
            data = chain.model.createData()
            pin.framesForwardKinematics(chain.model, data, chain.configurations(q[None])[0])
            there = chain.base @ data.oMf[chain.frame_id].homogeneous @ chain.tool
            assert np.abs(window.tip(arm) - there).max() <= 1e-9


@dataclass(frozen=True)
class Opened:
    """A robot's page, opened once for all that is asked of it."""

    window: Window
    fit: Result
    size: int


@pytest.fixture(scope="module", params=some_slow(ROBOTS, [ROBOTS.index(name) for name in OPENED]))
def opened(
    request: pytest.FixtureRequest, browser: Any, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Opened]:
    nominal, truth = arms(request.param)
    data = Position.simulate(truth, poses(nominal, 12), Noise(1e-3), np.random.default_rng(3))
    fit = calibrate(nominal, data)
    html = scene_html(nominal, fit, triangles=4000)
    with window_of(browser) as window:
        window.open(tmp_path_factory.mktemp("scene") / "scene.html", html)
        yield Opened(window, fit, len(html.encode()))


def test_every_layer_is_seen(opened):
    window = opened.window
    assert opened.size < 1.2e6
    assert window.page.evaluate("dhcal.renderCalls()") > 10
    assert window.look("setMagnification", 100)["black"] == 0
    # Ellipsoids are as green as y axes, and may hide the tool frames.
    window.call("setLayer", "frames", False)
    check_layers(window, "ellipsoids")
    window.call("setLayer", "frames", True)
    check_layers(window, "frames", "arrows", "points", "nominal", "calibrated")


def check_layers(window: Window, *layers: str) -> None:
    """Each is seen, and not once it is switched off."""
    seen = window.look()
    for layer in layers:
        assert seen[layer] > 15, layer
        seen = window.look("setLayer", layer, False)
        assert seen[layer] == 0, layer


def test_the_tips_are_pinocchios(opened):
    opened.window.call("setMagnification", 1)
    check_tips(opened.window, opened.fit.nominal_refitted, opened.fit.chain)


# One drawn by us, one with seven joints, one of many meshes.
@pytest.mark.parametrize("opened", some_slow(["paper", "panda", "so101"], {0, 1}), indirect=True)
def test_every_slider_and_switch_changes_the_picture(opened):
    window, page = opened.window, opened.window.page
    for box in page.locator("#layers input").all():
        box.evaluate("box => box.checked || box.click()")
    before = window.look("setMagnification", 1)["print"]
    for slider in (page.locator("#magnification"), *page.locator("#joints input").all()):
        where = window.tip("calibrated")
        after = window.touch(slider, SLIDE)["print"]
        assert after != before
        assert np.abs(window.tip("calibrated") - where).max() > 1e-6
        before = after
    before = window.look("setMagnification", 100)["print"]
    for box in page.locator("#layers input").all():
        after = window.touch(box, CLICK)["print"]
        assert after != before
        before = after
    where = window.tip("nominal")
    page.get_by_role("button", name="Play").click()
    page.wait_for_function("where => Math.abs(dhcal.tip('nominal')[0][3] - where) > 1e-3", arg=where[0, 3])
    page.get_by_role("button", name="Pause").click()
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
    check_tips(window, replace(nominal, base=calibrated.base, tool=calibrated.tool), calibrated)
    assert window.look()["calibrated"] > 200
    # Both stand on the same base and hold the same tool, however far away that is.
    window.call("setMagnification", 500)
    window.call("setLayer", "calibrated", False)
    assert window.look()["nominal"] > 200


WEIGHTS = re.sub(
    rb'<link name="(.)"/>',
    rb'<link name="\1"><inertial><origin xyz="0.05 -0.02 0.1"/><mass value="4"/>'
    rb'<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>',
    MIMIC,
)


def driven(chain: Chain, seed: int) -> Chain:
    """With every error that its joints can have."""
    rng = np.random.default_rng(seed)
    coefficients = rng.uniform(1, 3, n_coefficients(*chain.mimic_matrix.shape))
    linear, harmonics, joint_terms, link_terms = split_coefficients(coefficients, chain.n_joints)
    linear *= 2e-3 * (np.eye(chain.n_joints, dtype=bool) | ~chain.is_prismatic[:, None])
    harmonics *= 1e-4 * ~chain.is_prismatic
    joint_terms *= 1e-4 * ~chain.is_prismatic
    link_terms *= 1e-5
    return chain.with_transmission(Transmission(coefficients, chain.loads))


@pytest.mark.parametrize("robot", some_slow(["ur10", "odd"], {1}))
def test_joints_that_miss_their_values_stand_where_pinocchio_has_them(window, tmp_path, robot):
    pair = perturbed(Chain.from_urdf(parse_urdf(WEIGHTS, "odd.urdf"), "e")) if robot == "odd" else arms(robot)
    nominal, calibrated = (driven(chain, seed) for seed, chain in enumerate(pair))
    window.open(tmp_path / "scene.html", scene_html(nominal, calibrated, package_dirs=[tmp_path]))
    check_tips(window, nominal, calibrated)
    note = window.page.inner_text("#note")
    assert "without backlash" in note
    assert "without thermal growth" in note
    missed = np.abs(pair[1].poses(poses(nominal, 5)) - calibrated.poses(poses(nominal, 5))).max()
    assert missed > 1e-3
    # Enlarged, the calibrated joints leave the nominal ones in proportion.
    assert nominal.transmission is not None
    other = calibrated.with_transmission(nominal.transmission)
    window.open(tmp_path / "scene.html", scene_html(pair[0], other, package_dirs=[tmp_path]))
    window.call("setMagnification", 10)
    q = poses(nominal, 1)
    window.call("setJoints", q[0].tolist())
    grown = replace(nominal.transmission, coefficients=10 * nominal.transmission.coefficients)
    errors = se3.log6(se3.inverse(pair[0].origins) @ pair[1].origins)
    there = replace(pair[0], origins=pair[0].origins @ se3.exp6(10 * errors)).with_transmission(grown)
    assert np.abs(window.tip("calibrated") - there.poses(q)[0]).max() <= 1e-9


def test_a_result_shows_its_own_data_in_a_notebook(window, tmp_path, sim_6dof, sim_6dof_actual):
    truth = replace(sim_6dof_actual, base=se3.translation([2.0, 1.0, 0.5]))
    data = Pose.simulate(truth, poses(truth, 20), Noise(1e-4, 1e-4), np.random.default_rng(0))
    fit = calibrate(sim_6dof, data, "dh,base")
    cell = show(sim_6dof, fit, title='A <b>"&</b> arm')._repr_html_()
    window.page.set_content(f"<!DOCTYPE html>{cell}")
    frame = window.page.frames[1]
    frame.wait_for_function(READY)
    assert frame.locator("h1").inner_text() == 'A <b>"&</b> arm'
    assert frame.evaluate("dhcal.scene.points.length") == 20
    frame.evaluate("q => dhcal.setJoints(q)", data.q[0].tolist())
    assert (
        np.abs(np.array(frame.evaluate("dhcal.tip('calibrated')")) - fit.chain.poses(data.q[:1])[0]).max()
        <= 1e-9
    )
    before = fit.nominal_refitted.poses(data.q[:1])[0]
    assert np.abs(np.array(frame.evaluate("dhcal.tip('nominal')")) - before).max() <= 1e-9


def test_reflectors_beside_the_tool_and_lengths_are_no_residuals(window, tmp_path, sim_6dof):
    rng = np.random.default_rng(0)
    q = poses(sim_6dof, 9)
    data = [kind.simulate(sim_6dof, q, Noise(), rng) for kind in (MultiTargetPosition, Distance)]
    places = (0.05, 0, 0.01, 0, 0.04, -0.02)
    known = {
        unknown.name: place for unknown, place in zip(data[0].instrument_parameters, places, strict=True)
    }
    html = scene_html(sim_6dof, measurements=data, known=known)
    window.open(tmp_path / "scene.html", html)
    assert window.page.evaluate("dhcal.scene.configurations.length") == 27
    assert window.page.evaluate("dhcal.scene.points.length") == 9
    assert window.page.evaluate("Math.max(...largest)") < 1e-8
    assert window.look()["points"] > 15


def test_where_the_instrument_stands_is_no_difference_of_the_arms(window, tmp_path):
    """A nominal file knows no base and no tool: `apart` is what the robots alone make of it."""
    nominal, truth = perturbed(Chain.from_dh(paper("sim_6dof")))
    base, tool = (se3.exp6(np.array(x)) for x in ([2.0, -1, 0.3, 0.4, 0.8, -1.2], [0.1, 0, 0.2, 0.3, 0, 1]))
    calibrated = replace(truth, base=base, tool=tool)
    window.open(tmp_path / "scene.html", scene_html(nominal, calibrated))
    check_tips(window, replace(nominal, base=base, tool=tool), calibrated)
    apart = float(window.page.locator("#tips td").last.inner_text().split(" mm")[0])
    q = poses(nominal, 5)[-1:]
    wanted = 1e3 * np.linalg.norm((nominal.poses(q) @ tool - truth.poses(q) @ tool)[0, :3, 3])
    assert apart == pytest.approx(wanted, abs=1e-3)
    assert apart < 10


def test_ellipsoids_are_what_the_result_predicts(window, tmp_path):
    nominal, truth = perturbed(Chain.from_dh(paper("sim_6dof")))
    truth = replace(truth, base=se3.exp6(np.array([2.0, -1.0, 0.3, 0.4, 0.8, -1.2])))
    q = poses(nominal, 15)
    fit = calibrate(
        nominal, Position.simulate(truth, q, Noise(1e-3), np.random.default_rng(5)), "minimal,base"
    )
    window.open(tmp_path / "scene.html", scene_html(nominal, fit))
    seen = window.page.evaluate("dhcal.scene.ellipsoids")
    assert np.array_equal([each["q"] for each in seen], q)
    half = fit.chain.base[:3, :3] @ np.array([each["axes"] for each in seen]).reshape(-1, 3, 3)
    expected = fit.predict(q).covariance[:, :3, :3]
    assert np.abs(half @ np.swapaxes(half, 1, 2) / expected - 1).max() < 1e-3
    assert (np.linalg.det(half) > 0).all()
    # They stand around the calibrated tool, as large as the slider says, and the legend has their size.
    window.call("setMagnification", 40)
    columns = window.page.evaluate("[...ellipsoids.children[0].instanceMatrix.array.slice(7 * 16, 8 * 16)]")
    drawn = np.reshape(columns, (4, 4)).T
    window.call("setJoints", q[7].tolist())
    there = se3.inverse(fit.chain.base) @ window.tip("calibrated")
    assert np.abs(drawn[:3, 3] - there[:3, 3]).max() < 1e-6
    assert np.abs(fit.chain.base[:3, :3] @ drawn[:3, :3] - 40 * half[7]).max() < 1e-6
    largest = 1e3 * np.sqrt(np.linalg.eigvalsh(expected).max())
    assert f"up to {largest:.3f} mm" in window.page.locator("#layers").inner_text()


def test_a_tool_of_which_nothing_tells_the_place_has_no_ellipsoid(sim_6dof):
    data = Position.simulate(sim_6dof, poses(sim_6dof, 3), Noise(), np.random.default_rng(0))
    page = scene_html(sim_6dof, calibrate(sim_6dof, data, "dh", priors="none"))
    assert '"ellipsoids":[]' in page
    assert "No ellipsoids" in page


def test_what_does_not_fit_together_is_said(sim_6dof):
    with pytest.raises(DhcalError, match="the robots differ"):
        scene_html(sim_6dof, Chain.from_dh(paper("sim_3dof")))
    with pytest.raises(DhcalError, match="q has shape"):
        scene_html(sim_6dof, q=np.zeros((2, 3)))
    with pytest.raises(DhcalError, match="magnification"):
        scene_html(sim_6dof, magnification=0.5)
    with pytest.raises(DhcalError, match="3 triangles"):
        scene_html(sim_6dof, triangles=3)


def test_view_writes_the_page(tmp_path):
    page = tmp_path / "scene.html"
    arms = [str(URDF / f"{name}.dh.toml") for name in ("experiment", "experiment_published")]
    data = str(URDF / "experiment_table5.csv")
    assert main(["view", *arms, "--data", data, "--html", str(page)]) == 0
    text = page.read_text()
    assert "experiment and experiment_published" in text
    assert main(["view", arms[0], "--html", str(tmp_path / "no" / "scene.html")]) == 2


def test_a_calibrated_robots_sidecar_puts_the_points_where_its_tool_is(tmp_path, sim_6dof):
    truth = replace(sim_6dof, base=se3.exp6(np.array([3.0, -2.0, 1.0, 0.5, 0.2, 2.5])))
    truth = replace(truth, tool=se3.translation([0.01, 0.02, 0.15]))
    data = Position.simulate(truth, poses(truth, 40), Noise(1e-5), np.random.default_rng(0))
    csv, out, page = (tmp_path / name for name in ("data.csv", "out.urdf", "scene.html"))
    csv.write_text(measurement_text(data, truth))
    nominal = str(URDF / "sim_6dof.dh.toml")
    assert main(["calibrate", nominal, str(csv), "--parameters", "base,tool", "-o", str(out)]) == 0
    assert main(["view", nominal, str(out), "--data", str(csv), "--html", str(page), "--simplify"]) == 0
    scene = json.loads(page.read_text().split('type="application/json">')[1].split("</script>")[0])
    # Drawn in the frame of the base link, to where Pinocchio puts the true tool without its base.
    there = replace(truth, base=np.eye(4)).poses(data.q)[:, :3, 3]
    assert np.abs(np.array(scene["points"]) - there).max() < 5e-5
    assert np.abs(scene["residuals"]).max() < 5e-5


def test_view_serves_live_only_alone(tmp_path, capsys):
    assert main(["view", str(URDF / "sim_6dof.dh.toml"), "--live", "--html", str(tmp_path / "a.html")]) == 2
    assert "--live writes no page" in capsys.readouterr().err


STOPS = """() => {
  const object = dhcal.viewer.scene_tree.find(["dhcal", "stops"]).object;
  const found = [];
  object.traverse(node => { if (node.instanceMatrix) found.push(...node.instanceMatrix.array); });
  return found;
}"""


def test_preview_shows_stops_path_and_obstacles(window, tmp_path):
    """Layers are seen by their pixels, dots are at the tools of the stops; way points are not counted."""
    chain = Chain.from_dh(paper("sim_6dof"))
    q = poses(chain, 4)
    obstacle = Obstacle.box([0.3, -0.6, 0.0], [0.9, -0.2, 0.5])
    space = WorkspaceConstraints(floor=-0.25, obstacles=[obstacle, Obstacle.floor(-0.25)])
    window.open(tmp_path / "scene.html", scene_html(chain, preview=Preview(q, [0, 1, 3], space)))
    page = window.page
    assert page.locator("#which").inner_text() == "3 poses"
    labels = page.locator("#layers label").all_inner_texts()
    assert {"Planned poses", "Path of the tool", "Obstacles"} <= set(labels)
    pictures = [window.look()["print"]]
    for layer in ("stops", "path", "obstacles"):
        pictures.append(window.look("setLayer", layer, False)["print"])
    assert len(set(pictures)) == 4
    places = np.reshape(page.evaluate(STOPS), (3, 4, 4))[:, 3, :3]
    np.testing.assert_allclose(places, chain.poses(q[[0, 1, 3]])[:, :3, 3], atol=1e-6)
    # The floor is the grid; it is not drawn as a box too.
    assert page.evaluate("[dhcal.scene.floor, dhcal.scene.obstacles.length]") == [-0.25, 1]
