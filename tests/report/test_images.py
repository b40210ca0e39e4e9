"""Section of the report on images: stages, errors of each image, and errors over the image plane."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dhcal_pin.calibration import calibrate
from dhcal_pin.calibration.evaluation import compute_errors
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import CameraCorners, Noise
from dhcal_pin.report import Provenance, ReportContext
from dhcal_pin.report.calibration_report import calibration_document
from dhcal_pin.report.figures import accuracy_figures
from dhcal_pin.report.html import html_page
from dhcal_pin.report.images import image_figures, image_section, image_table, stage_table
from dhcal_pin.report.json_document import json_text, result_to_dict
from dhcal_pin.report.sections import sections_of
from dhcal_pin.visualization.image_plots import plot_reprojection


@pytest.fixture(scope="module")
def result(sim_6dof):
    rng = np.random.default_rng(0)
    errors = select_parameters(sim_6dof, "placement")
    scale = np.array([1e-3 if p.unit == "m" else 3e-3 for p in errors.parameters])
    truth = errors.at(scale * rng.normal(size=len(scale)))
    images = CameraCorners.simulate(truth, rng.uniform(-2.5, 2.5, (35, 6)), Noise(2e-4), rng)
    is_fitted = images.image < 30
    return calibrate(sim_6dof, images.take(is_fitted), "placement,camera", holdout=images.take(~is_fitted))


def test_stages_are_those_of_the_json(result):
    table = stage_table(result.camera_stages)
    stages = json.loads(json_text(result_to_dict(result, {}, {})))["camera_stages"]
    assert [row[0] for row in table.texts] == [stage["stage"] for stage in stages]
    for row, stage in zip(table.texts, stages, strict=True):
        assert float(row[3]) == pytest.approx(stage["fitted"]["residual_rms_px"], rel=0.01)
        assert float(row[8]) == pytest.approx(1e3 * stage["by_region"]["board_rms_m"], rel=0.01)


def test_the_position_error_of_the_tool_is_stated(result, quick):
    """It is the larger one of the predicted error and that of left-out images."""
    stated = result_to_dict(result, {}, {})["position_error_of_images_m"]
    assert stated == max(result.position_std, result.comparisons[0].after.groups["board"].rms)
    section = image_section(ReportContext(result, Provenance(names=["corners.csv"])))
    assert section is not None
    (text,) = (text for text in section.sentences if "position error" in text)
    assert float(text.split("about ")[1].split(" mm")[0]) == pytest.approx(1e3 * stated, rel=0.1)


def test_images_with_the_largest_errors_are_listed(result, quick):
    table = image_table(ReportContext(result, Provenance(names=["corners.csv"])))
    shown = [float(row[6]) for row in table.texts]
    assert shown == sorted(shown, reverse=True)
    rms = []
    for item in (*result.data, *result.holdout):
        squares = compute_errors(result.chain, [item], result.instruments)[0]["pixels"] ** 2
        rms += [np.sqrt(squares[item.image == i].sum(1).mean()) for i in range(item.n_images)]
    np.testing.assert_allclose(shown, sorted(rms, reverse=True)[: len(shown)], rtol=0.01)
    assert all(row[1].startswith("corners.csv, ") for row in table.texts if row[3] == "fitted")


def test_histograms_show_the_errors_of_the_table(result, quick):
    """Cameras and boards of the nominal robot are those that fit it best."""
    (group,) = accuracy_figures(ReportContext(result, Provenance(names=["corners.csv"])))
    texts = [panel.description for panel in group.panels]
    for comparison in result.comparisons:
        if comparison.title in ("hold-out", "fitted"):
            before = comparison.before.groups["pixels"].rms
            (text,) = (t for t in texts if "image error" in t and f"{comparison.title} samples" in t)
            assert float(text.split("RMS ")[1].split(" px")[0]) == pytest.approx(before, rel=0.02)


def test_images_are_called_by_their_names(result, quick):
    """The names are those of the samples; images without one are numbered."""
    named = replace(result, data=tuple(with_names(item) for item in result.data))
    assert "image" not in result.residuals.to_columns()
    context = ReportContext(named, Provenance(names=["corners.csv"]))
    table = image_table(context)
    lines = {}
    for item in named.data:
        for i, label in enumerate(item.image_labels):
            rows = item.rows[item.image == i]
            lines[label] = f"{rows.min()}-{rows.max()}"
    fitted = [row for row in table.texts if row[3] == "fitted"]
    assert fitted
    assert all(row[1].endswith(f", {lines[row[0]]}") for row in fitted)
    assert all(row[0].isdecimal() for row in table.texts if row[3] == "hold-out")
    titles = [panel.caption for group in image_figures(context) for panel in group.panels]
    assert any(title.startswith(f"Image {fitted[0][0]}: ") for title in titles)
    columns = named.residuals.file_columns()
    by_line = dict(zip(columns["line"], columns["image"], strict=True))
    for item in named.data:
        assert [by_line[row] for row in item.rows.tolist()] == item.image_names.tolist()


def with_names(item):
    """Return images with a name for each configuration."""
    return item.replace(image_names=np.array([f"{q[0]:.6f}.png" for q in item.q], object))


def test_page_shows_each_camera_and_the_worst_images(result, quick):
    context = ReportContext(result, Provenance())
    page = html_page(calibration_document(context, "html"))
    assert '<section id="images"' in page
    for panel in (panel for group in image_figures(context) for panel in group.panels):
        assert f'aria-labelledby="{panel.key}-t' in page
    assert all(f"Camera {name}, errors" in page for name in ("left", "right"))


def test_results_without_images_have_no_such_section(fit, quick):
    sections = sections_of(ReportContext(fit, Provenance()), "html")
    assert "images" not in [section.key for section in sections]


def test_errors_are_drawn_from_the_measured_corner_to_the_modelled_one():
    pixels, errors = np.array([[100.0, 50], [300, 200]]), np.array([[0.1, 0], [0, -0.2]])
    ax = plot_reprojection(pixels, errors, (640, 480), 100)
    x, y = ax.lines[0].get_data()
    np.testing.assert_allclose(np.stack([x, y], 1)[:2], [[100, 50], [90, 50]])
    np.testing.assert_allclose(np.stack([x, y], 1)[3:5], [[300, 200], [300, 220]])
    # v grows downwards.
    assert ax.get_ylim()[0] > ax.get_ylim()[1]
