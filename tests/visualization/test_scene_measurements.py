"""What the page shows of measurements: sets, arrows, picked samples, cells, frames; keyboard."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from pages import AXE, Window, window_of
from robots import paper

from dhcal_pin import se3
from dhcal_pin.calibration.presentation.workspace import uncertainty_cells
from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.calibration.result import Result
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.position import Position
from dhcal_pin.robot.chain import Chain
from dhcal_pin.visualization.measured_samples import drawn_samples, measured_samples
from dhcal_pin.visualization.scene import scene_html

pytestmark = pytest.mark.usefixtures("unsuspected")

N_FITTED, N_HELD_OUT, WRONG = 150, 40, (3, 70)
# Instances of a mesh with a size, as (number, place).
DRAWN = """name => {
  const mesh = { points, arrows }[name], pose = new THREE.Matrix4(), out = [];
  for (let i = 0; i < mesh.count; i++) {
    mesh.getMatrixAt(i, pose);
    if (pose.determinant() !== 0) out.push(i);
  }
  return out;
}"""


@pytest.fixture(scope="module")
def fit() -> Result:
    nominal, truth = Chain.from_dh(paper("sim_6dof")), Chain.from_dh(paper("sim_6dof_actual"))
    truth = replace(truth, base=se3.exp6(np.array([2.0, -1, 0.3, 0.4, 0.8, -1.2])))
    rng = np.random.default_rng(4)
    q = rng.uniform(-1.3, 1.3, (N_FITTED + N_HELD_OUT, 6))
    data = Position.simulate(truth, q, Noise(1e-4), rng)
    data.positions()[list(WRONG)] += 0.05
    held_out = np.arange(len(q)) >= N_FITTED
    return calibrate(
        nominal, data.take(~held_out), "minimal,base", holdout=data.take(held_out), extend="none"
    )


@pytest.fixture(scope="module")
def opened(browser: Any, fit: Result, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Window]:
    with window_of(browser) as window:
        window.page.set_viewport_size({"width": 1000, "height": 800})
        window.open(tmp_path_factory.mktemp("scene") / "scene.html", scene_html(fit.nominal_refitted, fit))
        yield window


@pytest.fixture
def scene(opened: Window) -> Iterator[Window]:
    opened.page.evaluate(
        """() => {
          dhcal.setShown({ arm: 1, mode: "top", top: 100, threshold: 0, sets: [true, true, true] });
          dhcal.pick(-1);
          for (const box of document.querySelectorAll("#sets input")) box.checked = true;
          dhcal.setMagnification(1);
          document.getElementById("cells").value = "none";
          document.getElementById("cells").dispatchEvent(new Event("change"));
          document.getElementById("inspector").open = false;
          dhcal.frame();
        }"""
    )
    yield opened
    opened.check()


def lengths(fit: Result, arm: int) -> np.ndarray:
    """Distance from model to measured point of all samples, nominal or calibrated [m]."""
    chain = (fit.nominal_refitted, fit.chain)[arm]
    return np.concatenate(
        [
            np.linalg.norm(item.positions() - chain.poses(item.q)[:, :3, 3], axis=1)
            for item in (*fit.data, *fit.holdout)
        ]
    )


def drawn(window: Window, name: str) -> list[int]:
    return window.page.evaluate(DRAWN, name)


def test_the_default_is_the_largest_residuals(scene, fit):
    norms = lengths(fit, 1)
    assert drawn(scene, "arrows") == sorted(np.argsort(-norms)[:100].tolist())
    assert len(drawn(scene, "points")) == N_FITTED + N_HELD_OUT
    scene.page.select_option("#mode", "threshold")
    slider = scene.page.locator("#limit")
    slider.evaluate("it => { it.value = it.max / 2; it.dispatchEvent(new Event('input')); }")
    assert drawn(scene, "arrows") == np.flatnonzero(norms >= float(slider.input_value())).tolist()
    assert 0 < len(drawn(scene, "arrows")) < 10
    before = scene.look()
    scene.page.select_option("#mode", "colours")
    after = scene.look()
    assert drawn(scene, "arrows") == []
    # Dark points become points in the colours of the scale.
    assert after["points"] < before["points"]
    assert not slider.is_visible()


def test_sets_are_switched(scene, fit):
    boxes = scene.page.locator("#sets label").all_inner_texts()
    n_outliers = sum(map(len, fit.outliers))
    assert n_outliers >= len(WRONG)
    assert boxes == [
        f"Fitted ({N_FITTED - n_outliers})",
        f"Held out ({N_HELD_OUT})",
        f"Outliers ({n_outliers})",
    ]
    scene.page.locator("#set-0").uncheck()
    scene.page.locator("#set-1").uncheck()
    rows = np.concatenate(fit.outliers)
    assert drawn(scene, "points") == np.flatnonzero(np.isin(fit.data[0].rows, rows)).tolist()
    scene.page.locator("#set-1").check()
    scene.page.locator("#set-2").uncheck()
    assert drawn(scene, "points") == list(range(N_FITTED, N_FITTED + N_HELD_OUT))


def test_before_and_after_are_the_errors_of_both_robots(scene, fit):
    for arm, option in ((1, "1"), (0, "0")):
        scene.page.select_option("#model", option)
        shown = scene.page.evaluate("residuals[shown.arm].map(r => r.length())")
        np.testing.assert_allclose(shown, lengths(fit, arm), atol=1e-8)
        assert scene.page.inner_text("#largest") == f"{1e3 * lengths(fit, arm).max():.3f} mm"
        # The arrow ends at the measured point, from either robot.
        ends = scene.page.evaluate("scene.points.map((_, i) => drawnPoint(i).toArray())")
        np.testing.assert_allclose(ends, scene.page.evaluate("scene.points"), atol=1e-8)


def test_a_click_on_a_point_shows_its_row_and_moves_the_arm(scene, fit):
    page = scene.page
    item = fit.data[0]
    number = next(
        i
        for i in range(N_FITTED)
        if page.evaluate(
            """i => {
              const [x, y] = dhcal.pixel(i);
              return pointAt(x, y) === i && x > 20 && y > 20 && x < 680 && y < 700;
            }""",
            i,
        )
    )
    x, y = page.evaluate("i => dhcal.pixel(i)", number)
    page.mouse.click(x, y)
    text = page.inner_text("#picked")
    assert f"sample {item.rows[number]}, " in text
    assert f"{1e3 * lengths(fit, 1)[number]:.3f} mm" in text
    assert f"{1e3 * lengths(fit, 0)[number]:.3f} mm" in text
    assert f"{np.degrees(item.q[number, 1]):.1f}°" in text.replace("−", "-")
    assert np.abs(scene.tip("calibrated") - fit.chain.poses(item.q[number : number + 1])[0]).max() <= 1e-9
    # A drag turns the picture and picks nothing.
    page.evaluate("dhcal.pick(-1)")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 60, y + 30, steps=4)
    page.mouse.up()
    assert page.inner_text("#picked") == ""


def test_cells_are_rms_errors_and_predicted_uncertainty(scene, fit):
    page = scene.page
    expected = uncertainty_cells(fit)
    base = se3.inverse(fit.chain.base)
    points = np.concatenate([item.positions() for item in (*fit.data, *fit.holdout)])
    keys = np.floor((points @ base[:3, :3].T + base[:3, 3]) / expected.size).astype(int)
    page.select_option("#cells", "error")
    shown = {tuple(index): value for index, value in page.evaluate("dhcal.cellValues('error')")}
    cells = np.unique(keys, axis=0)
    assert set(shown) == set(map(tuple, cells.tolist()))
    for cell in cells:
        rms = np.sqrt(np.mean(lengths(fit, 1)[(keys == cell).all(1)] ** 2))
        assert shown[tuple(cell.tolist())] == pytest.approx(rms, abs=1e-8)
    page.select_option("#cells", "uncertainty")
    values = page.evaluate("dhcal.cellValues('uncertainty')")
    np.testing.assert_allclose([value for _, value in values], expected.std, atol=1e-9)
    assert page.inner_text("#cells-largest") == f"{1e3 * expected.std.max():.3f} mm"
    layer = page.evaluate("cellMeshes.uncertainty.count")
    page.locator("#height").evaluate("it => { it.value = -1; it.dispatchEvent(new Event('input')); }")
    assert 0 < layer < page.evaluate("cellMeshes.uncertainty.count") == len(expected.std)


def test_uncertainty_of_a_cell_is_that_of_its_configurations(fit):
    """The mean over all cells, weighted by nothing, is near that of an independent draw."""
    cells = uncertainty_cells(fit)
    lower, upper = np.maximum(fit.chain.lower, -np.pi), np.minimum(fit.chain.upper, np.pi)
    q = np.random.default_rng(9).uniform(lower, upper, (20000, 6))
    prediction = fit.predict(q)
    base = se3.inverse(fit.chain.base)
    points = prediction.poses[:, :3, 3] @ base[:3, :3].T + base[:3, 3]
    keys = np.floor(points / cells.size).astype(int)
    shown = {tuple(index): std for index, std in zip(cells.index.tolist(), cells.std, strict=True)}
    pairs = []
    for cell in np.unique(keys, axis=0).tolist():
        inside = (keys == cell).all(1)
        if inside.sum() >= 20 and tuple(cell) in shown:
            pairs.append((shown[tuple(cell)], np.sqrt(np.mean(prediction.position_std[inside] ** 2))))
    assert len(pairs) >= 3
    assert np.median(np.abs(np.log([a / b for a, b in pairs]))) < 0.25


def test_the_inspector_has_the_poses_of_pinocchio(scene, fit):
    page = scene.page
    q = np.array([0.3, -0.7, 0.9, 0.2, -1.1, 0.5])
    scene.call("setJoints", q.tolist())
    page.click("#inspector summary")
    names = page.locator("#link option").all_inner_texts()
    assert names[-2:] == [fit.chain.tip, "tool"]
    calibrated_base = se3.inverse(fit.chain.base)
    for body in (2, 4, len(names) - 2):
        page.select_option("#link", str(body))
        rows = page.locator("#frame-table tr").evaluate_all(
            "them => them.slice(1).map(row => [...row.cells].slice(1).map(it => Number(it.textContent)))"
        )
        for arm, chain in enumerate((fit.nominal_refitted, fit.chain)):
            model, data = chain.model, chain.model.createData()
            pin.framesForwardKinematics(model, data, chain.configurations(q[None])[0])
            pose = data.oMf[chain.frame_id] if body == len(names) - 2 else data.oMi[body]
            pose = calibrated_base @ chain.base @ pose.homogeneous
            shown = np.array(rows)[:, arm]
            np.testing.assert_allclose(shown[:3], 1e3 * pose[:3, 3], atol=6e-4)
            again = pin.rpy.rpyToMatrix(*np.radians(shown[3:]))
            np.testing.assert_allclose(again, pose[:3, :3], atol=3e-6)
    page.select_option("#relative", "parent")
    page.select_option("#link", "3")
    x, y, z = (
        float(page.locator("#frame-table tr").nth(row).locator("td").nth(1).inner_text()) for row in (1, 2, 3)
    )
    np.testing.assert_allclose([x, y, z], 1e3 * fit.chain.origins[2, :3, 3], atol=6e-4)


def test_the_keyboard_turns_zooms_and_picks(scene):
    page = scene.page
    canvas = page.locator("#pane canvas")
    canvas.focus()
    seen = [scene.look()["print"]]
    for key in ("ArrowLeft", "ArrowUp", "+", "-", "ArrowDown"):
        page.keyboard.press(key)
        seen.append(scene.look()["print"])
    assert all(a != b for a, b in pairwise(seen))
    for key, sample in (("n", "1"), ("n", "2"), ("p", "1"), ("p", str(N_FITTED + N_HELD_OUT))):
        page.keyboard.press(key)
        assert page.input_value("#sample") == sample
    page.fill("#sample", "7")
    page.keyboard.press("Enter")
    assert "sample 7," in page.inner_text("#picked")
    canvas.focus()
    page.keyboard.press("Space")
    assert page.inner_text("#play").endswith("Pause")
    page.keyboard.press("Space")
    page.keyboard.press("f")


def test_exaggeration_and_grid_have_units(scene):
    assert "Exaggeration" in scene.page.inner_text("#larger")
    caption = scene.page.inner_text("#caption")
    cell = scene.page.evaluate("gridCell")
    assert caption == f"One cell of the grid: {1e3 * cell:g} mm"
    assert f"{cell:.0e}"[0] in "125"
    scene.call("setMagnification", 100)
    assert scene.page.inner_text("#caption") == f"{caption}; drawn errors: {10 * cell:g} mm"


def test_the_picture_is_saved(scene):
    with scene.page.expect_download() as waiting:
        scene.page.get_by_role("button", name="Save picture").click()
    content = Path(waiting.value.path()).read_bytes()
    assert content.startswith(b"\x89PNG")
    assert len(content) > 10_000
    assert waiting.value.suggested_filename == "Robot calibration.png"


@pytest.mark.parametrize(
    "checked", [{(390, "light"), (1200, "dark")}, pytest.param(None, marks=pytest.mark.slow)]
)
def test_the_page_is_accessible_at_every_width(scene, checked):
    """Nothing is wider than the page in any look; two looks, or all, are checked for other faults."""
    page = scene.page
    page.evaluate(AXE)
    page.evaluate("dhcal.pick(0)")
    page.click("#inspector summary")
    page.select_option("#cells", "uncertainty")
    for width in (390, 768, 1200):
        page.set_viewport_size({"width": width, "height": 800})
        if width == 390:
            page.click("#fold")
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            if checked is None or (width, scheme) in checked:
                found = page.evaluate("axe.run(document, {resultTypes: ['violations']})")["violations"]
                assert [(one["id"], one["nodes"][0]["html"]) for one in found] == [], (width, scheme)
    page.emulate_media(color_scheme="light")
    page.set_viewport_size({"width": 1000, "height": 800})


def test_the_largest_residuals_are_always_drawn(sim_6dof):
    rng = np.random.default_rng(0)
    q = rng.uniform(-1, 1, (5000, 6))
    data = Position.simulate(sim_6dof, q, Noise(1e-3), rng)
    samples = measured_samples((sim_6dof, sim_6dof), [data], ({}, {}), [np.zeros(5000, int)])
    drawn = drawn_samples(samples, 2000, 200)
    norms = np.linalg.norm(samples.residuals, axis=1)
    assert len(drawn) == 2000
    assert len(set(drawn.tolist())) == 2000
    assert set(np.argsort(-norms)[:200].tolist()) <= set(drawn.tolist())
    # The others are spread over the whole file.
    assert np.diff(drawn).max() < 10
