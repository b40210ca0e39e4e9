"""A notebook that was executed and saved still shows the scene, and so does its HTML."""

import nbformat
import numpy as np
import pytest
from nbconvert import HTMLExporter
from nbconvert.preprocessors import ExecutePreprocessor
from pages import LOOK, READY

CELL = """
import numpy as np, dhcal_pin as dh
from dhcal_pin.paper.experiment import paper_arm
arm, truth = paper_arm("sim_6dof"), paper_arm("sim_6dof_actual")
q = np.random.default_rng(0).uniform(-2, 2, (12, 6))
fit = dh.calibrate(arm, dh.Position.simulate(truth, q, dh.Noise(1e-4), np.random.default_rng(1)))
dh.show(arm, fit)
"""


# Jupyter's own libraries leave sockets and event loops behind.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::RuntimeWarning")
def test_the_scene_lives_in_a_saved_notebook_and_in_its_html(browser, tmp_path):
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(CELL)])
    ExecutePreprocessor(timeout=120).preprocess(notebook, {"metadata": {"path": str(tmp_path)}})
    saved = tmp_path / "arm.ipynb"
    nbformat.write(notebook, saved)
    assert saved.stat().st_size < 1.2e6
    exported = tmp_path / "arm.html"
    exported.write_text(HTMLExporter().from_filename(str(saved))[0], encoding="utf-8")

    page = browser.new_page(viewport={"width": 1000, "height": 800})
    # The shell that nbconvert puts around asks other hosts for scripts that we do not need.
    page.route("http*://**", lambda route: route.abort())
    page.goto(exported.as_uri())
    frame = next(frame for frame in page.frames if frame.parent_frame)
    frame.wait_for_function(READY)
    assert frame.evaluate("dhcal.scene.points.length") == 12
    # The frame is high enough for all sliders.
    height = frame.evaluate("innerHeight")
    boxes = frame.locator("#joints input").evaluate_all(
        "them => them.map(it => it.getBoundingClientRect().bottom)"
    )
    assert len(boxes) == 6
    assert max(boxes) <= height
    before = frame.evaluate(LOOK)
    assert before["calibrated"] > 200
    assert before["nominal"] > 15
    frame.locator("#joints input").first.press("End")
    assert frame.evaluate(LOOK)["print"] != before["print"]
    assert np.shape(frame.evaluate("dhcal.tip('nominal')")) == (4, 4)
    page.close()
