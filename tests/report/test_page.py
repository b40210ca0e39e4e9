"""Report in a browser: what its scripts do with a mouse and a keyboard, and what is there without them."""

import csv
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from pages import AXE, listen, wait_for
from robots import nominal_arm
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.calibration import Result, calibrate, split
from dhcal_pin.io import csv_text
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.report import Provenance, result_to_dict, write_report

NAME = "a & <b>.csv"
# Names of the tables that are wider than the page.
CUT_OFF = """[...document.querySelectorAll('.scroll')]
  .filter(box => box.scrollWidth > box.clientWidth).map(box => box.ariaLabel)"""
POSITION_PLOT = ".plot[data-x=number][data-y='error:position']"


@pytest.fixture(scope="module")
def fit(sim_6dof, sim_6dof_actual) -> Result:
    """Return a calibration with 40 poses of which one is an outlier and 12 are held out."""
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-1.5, 1.5, (40, 6)), Noise(2e-4, 3e-4), rng)
    fitted, held_out = split([data], 0.3, 0)
    fitted[0].poses[5, :3, 3] += [0.02, 0.0, 0.01]
    return calibrate(sim_6dof, fitted, "minimal,base,tool", holdout=held_out)


@pytest.fixture(scope="module")
def path(fit, tmp_path_factory) -> Path:
    """Return the report of the calibration; its file name has characters with a meaning in HTML."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_report(fit, path, Provenance(names=[NAME], holdout_names=[NAME]))
    return path


@pytest.fixture(scope="module")
def open_page(browser, path) -> Iterator[Callable[..., Any]]:
    """Return a function that opens the report in a browser with some options."""
    pages, complaints, requests = [], [], []

    def open_with(**options: Any) -> Any:
        page = browser.new_page(**({"viewport": {"width": 1200, "height": 800}} | options))
        pages.append(page)
        listen(page, complaints)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        page.goto(path.as_uri())
        return page

    yield open_with
    for page in pages:
        page.close()
    assert not complaints
    assert all(url.startswith(("file:", "data:", "about:", "blob:")) for url in requests), requests


@pytest.fixture(scope="module")
def shared_page(open_page) -> Any:
    return open_page()


@pytest.fixture
def page(shared_page, path) -> Iterator[Any]:
    shared_page.goto(path.as_uri())
    yield shared_page
    # The next test loads the page anew, and until then nothing is drawn.
    shared_page.goto("about:blank")
    shared_page.mouse.move(0, 0)


def sample(fit: Result, line: int) -> tuple[np.ndarray, float, float]:
    """Return joint positions of the sample of a line [rad] and its position errors before and after [m]."""
    index = int(np.flatnonzero(fit.residuals.line == line)[0])
    before, after = (side[index] for side in fit.error_norms["position"])
    q = np.concatenate([item.q for item in (*fit.data, *fit.holdout)])[index]
    return q, float(before), float(after)


def dot(page: Any, plot: Any, x: float, y: float) -> tuple[float, float]:
    """Return where a dot must be on the screen, from the frame of a plot and the texts of its axis."""
    left, _, right, _ = map(float, plot.locator("svg").get_attribute("data-frame").split())
    low, high = map(float, plot.locator("svg").get_attribute("data-x").split())
    ticks = plot.evaluate(
        "box => [...box.querySelectorAll('.grid')].map(line => [Number(line.nextSibling.textContent), "
        "Number(line.getAttribute('d').match(/ ([\\d.]+)H/)[1])])"
    )
    values, heights = np.transpose(ticks)
    slope, start = np.polyfit(values, heights, 1)
    plot.scroll_into_view_if_needed()
    box = plot.locator("svg").bounding_box()
    scale = box["width"] / float(plot.locator("svg").get_attribute("viewBox").split()[2])
    px = left + (x - low) / (high - low) * (right - left)
    return box["x"] + scale * px, box["y"] + scale * (start + slope * y)


def test_hovering_a_dot_shows_line_joints_and_error(page, fit):
    plot, line = page.locator(POSITION_PLOT), 7
    q, before, after = sample(fit, line)
    page.mouse.move(*dot(page, plot, line, 1e3 * after))
    lines = page.locator(".tooltip").inner_text().splitlines()
    assert lines[0].startswith(f"{NAME}:{line} (")
    assert f"position error, before: {1e3 * before:.3f} mm" in lines
    assert f"position error, after: {1e3 * after:.3f} mm" in lines
    for name, value in zip(fit.chain.joint_names, np.degrees(q), strict=True):
        assert f"{name}: {value:.3f}°" in lines
    # The same sample is marked in every plot that shows it.
    assert page.locator(".plot.live:has(.ring)").count() == page.locator(".plot.live").count() > 8


def test_clicking_a_dot_moves_the_arm_and_marks_the_row(page, fit):
    line = 12
    q, _, after = sample(fit, line)
    page.mouse.click(*dot(page, page.locator(POSITION_PLOT), line, 1e3 * after))
    # The pose of the tool by Pinocchio's own forward kinematics.
    data = fit.model.createData()
    pin.framesForwardKinematics(fit.model, data, q)
    tip = data.oMf[fit.model.getFrameId(fit.chain.tip)].homogeneous
    expected = fit.chain.base @ tip @ fit.chain.tool
    shown = [
        [float(value) for value in page.locator(f".{name} data").evaluate_all("all => all.map(d => d.value)")]
        for name in ("tool-position", "tool-rotation")
    ]
    assert np.abs(np.array(shown[0]) - expected[:3, 3]).max() < 1e-9
    assert np.abs(np.array(shown[1]) - se3.log3(expected[:3, :3])).max() < 1e-9
    marked = page.locator("#samples tr.chosen")
    assert marked.count() == 1
    assert marked.locator("th").inner_text() == str(line)
    # The scene is beside the plot, and its arm is in the same pose.
    assert page.locator(".scene.docked iframe").is_visible()
    frame = page.frames[1]
    wait_for(frame, "window.dhcal !== undefined && window.dhcal.ready === true")
    frame.evaluate("dhcal.setMagnification(1)")
    page.wait_for_timeout(200)
    assert np.abs(np.array(frame.evaluate("dhcal.tip('calibrated')")) - expected).max() < 1e-9


def test_samples_are_selected_with_the_keyboard(page, fit):
    plot = page.locator(POSITION_PLOT)
    plot.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    first = page.locator("[aria-live=polite]").inner_text()
    assert first.startswith(f"{NAME}:2 (")
    page.keyboard.press("Enter")
    assert f"{NAME}:2" in page.locator("aside.selection h2").inner_text()
    page.keyboard.press("Escape")
    assert not page.locator("aside.selection").is_visible()
    # The contents lead to the sections.
    page.locator(".contents a", has_text="Parameters").focus()
    page.keyboard.press("Enter")
    wait_for(page, "Math.abs(document.getElementById('parameters').getBoundingClientRect().top) < 40")
    wait_for(page, "document.querySelector('.contents a[aria-current]')?.textContent === 'Parameters'")
    assert page.locator(".contents a").all_inner_texts() == page.locator("main h2").all_inner_texts()


def test_dragging_selects_samples_in_all_plots_and_in_the_list(page, fit):
    plot = page.locator(POSITION_PLOT)
    plot.scroll_into_view_if_needed()
    lines = fit.residuals.line
    errors = 1e3 * fit.error_norms["position"][1]
    chosen = (lines > 3.5) & (lines < 20.5) & (errors < errors.max() * 0.9)
    start, end = dot(page, plot, 3.5, 0.0), dot(page, plot, 20.5, 0.9 * errors.max())
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=4)
    page.mouse.up()
    assert page.locator("#samples output").inner_text() == f"1–{chosen.sum()} of {chosen.sum()} samples"
    assert page.locator(".plot.live:has(.picked)").count() > 8
    page.locator("#samples button", has_text="Show all samples").click()
    assert page.locator("#samples output").inner_text().endswith(f"of {len(lines)} samples")


def test_tables_are_sorted_and_filtered(page, fit):
    section = page.locator("#samples")
    heading = section.locator("thead button", has_text="position error after")
    order = np.argsort(fit.error_norms["position"][1])
    # Largest errors first; then the order of the file; then smallest errors first.
    for state, expected in (
        ("descending", fit.residuals.line[order[::-1]]),
        (None, np.sort(fit.residuals.line)),
        ("ascending", fit.residuals.line[order]),
    ):
        assert heading.locator("xpath=..").get_attribute("aria-sort") == state
        lines = section.locator("tbody th").all_inner_texts()
        assert len(lines) == 25
        assert lines == [str(line) for line in expected[: len(lines)]]
        heading.click()
    section.locator("input[type=search]").fill("hold-out")
    assert section.locator("output").inner_text() == "1–12 of 12 samples"

    table = page.locator("#parameters table", has=page.locator("caption", has_text=re.compile("^Robot$")))
    names = table.locator("tbody tr:not(.group) th")
    before = names.all_inner_texts()
    table.locator("thead button", has_text="change").click()
    values = table.locator("tbody tr:not(.group)").evaluate_all(
        "rows => rows.filter(row => row.checkVisibility()).map(row => row.cells[3].textContent)"
    )
    units = [value.split()[1] for value in values]
    assert units == sorted(units)
    for unit in set(units):
        numbers = [float(v.split()[0].replace("−", "-")) for v in values if v.endswith(f" {unit}")]
        assert numbers == sorted(numbers)
    table.locator("thead button", has_text="change").click()
    table.locator("thead button", has_text="change").click()
    assert names.all_inner_texts() == before
    page.locator("#parameters input[type=search]").first.fill("joint_3.rx")
    visible = table.locator("tbody tr:not(.group)").evaluate_all(
        "rows => rows.filter(row => row.checkVisibility()).map(row => row.cells[0].textContent)"
    )
    assert visible == ["joint_3.rx"]


def test_parameters_without_a_change_are_folded(page, fit):
    rows = page.locator("#parameters tr.zero")
    unchanged = [e for e in fit.estimates if abs(e.change) < 0.01 * e.std and e.posterior_to_prior_std > 0.99]
    assert rows.count() == len(unchanged) > 0
    assert not any(row.is_visible() for row in rows.all())
    page.locator("#parameters button", has_text="without a change").first.click()
    assert rows.first.is_visible()
    groups = page.locator("#parameters tr.group th").all_inner_texts()
    assert groups[0].startswith("joint_1")
    assert len(groups) == 6 + 2


def test_toggles_show_other_errors_and_samples(page, fit):
    plot = page.locator(POSITION_PLOT)
    largest = {
        state: 1e3 * norms.max()
        for state, norms in zip(("before", "after"), fit.error_norms["position"], strict=True)
    }

    def ticks() -> list[float]:
        return [float(text) for text in plot.locator("text[text-anchor=end]").all_text_contents()]

    def count(selector: str = ".dot") -> int:
        return sum(
            path.count("h0")
            for path in plot.locator(selector).evaluate_all("all => all.map(p => p.getAttribute('d'))")
        )

    n_samples = len(fit.residuals)
    assert count() == n_samples
    assert ticks()[-1] <= 1.05 * largest["after"]
    page.locator("#shown input[name=state]").nth(0).check()
    assert 0.5 * largest["before"] <= ticks()[-1] <= 1.05 * largest["before"]
    page.locator("#shown input[name=state]").nth(2).check()
    assert count() == 2 * n_samples
    page.locator("#shown input[name=state]").nth(1).check()
    page.locator("#shown input[name=hold-out]").uncheck()
    assert count() == n_samples - 12
    assert not page.locator("figure[data-role=hold-out]").first.is_visible()
    assert page.locator("#samples output").inner_text().endswith(f"of {n_samples - 12} samples")
    page.locator("#shown input[name=outlier]").uncheck()
    assert count() == n_samples - 12 - int(fit.residuals.is_outlier.sum())
    assert ticks()[-1] < 0.5 * largest["after"]


def test_downloads_equal_the_files_of_the_command_line(page, fit):
    texts = {}
    for name in ("residuals.csv", "parameters.csv"):
        with page.expect_download() as download:
            page.locator("#samples button", has_text=f"Download {name}").click()
        assert download.value.suggested_filename == name
        texts[name] = Path(download.value.path()).read_text("utf-8")
    columns = fit.residuals.file_columns() | {"file": [NAME] * len(fit.residuals)}
    assert texts["residuals.csv"] == csv_text(columns)
    rows = list(csv.DictReader(texts["parameters.csv"].splitlines()))
    expected = json.loads(json.dumps(result_to_dict(fit, {}, {})["parameters"]))
    assert len(rows) == len(expected)
    for row, parameter in zip(rows, expected, strict=True):
        assert list(row) == list(parameter)
        for key, value in parameter.items():
            number = isinstance(value, float)
            assert (float(row[key] or "inf") if number else row[key]) == (value if number else str(value))


def test_everything_is_there_without_scripts(open_page, path):
    page = open_page(java_script_enabled=False)
    headings = page.locator("main h2").all_inner_texts()
    assert len(headings) > 8
    assert all(heading.is_visible() for heading in page.locator("main h2").all())
    assert all(row.is_visible() for row in page.locator("#parameters tr.zero").all())
    assert page.locator("#samples tbody tr").count() == 20
    assert page.locator(f"{POSITION_PLOT} .samples").count() > 1
    assert not page.locator(".script").count()
    # Drawings replace the scene.
    assert page.locator("#arm-xz-t").count() == 1
    assert page.locator(".paper svg").first.is_visible()
    page.close()


LOOKS = ((390, "light"), (768, "dark"), (1200, "light"))


@pytest.mark.parametrize("checked", some_slow([[LOOKS[2]], [*LOOKS]], {0}), ids=["one look", "all looks"])
def test_the_page_is_accessible_and_fits(browser, path, checked):
    """The widths of all looks are checked, other faults in one of them and in the report of another test."""
    without_scene = path.with_name("without_scene.html")
    without_scene.write_text(re.sub('data-scene="[^"]*"', 'data-scene=""', path.read_text("utf-8")), "utf-8")
    page = browser.new_page(bypass_csp=True)
    page.goto(without_scene.as_uri())
    page.locator("#samples tbody button").first.click()
    page.locator("aside.selection").wait_for()
    page.evaluate(AXE)
    for width, scheme in LOOKS:
        page.set_viewport_size({"width": width, "height": 800})
        page.emulate_media(color_scheme=scheme)
        assert page.evaluate("document.documentElement.scrollWidth") == width
        # No table is cut off: where it would not fit, its rows are lists.
        assert page.evaluate(CUT_OFF) == []
        if (width, scheme) in checked:
            found = page.evaluate("axe.run(document, {iframes: false, resultTypes: ['violations']})")
            assert len(found["passes"]) > 15
            assert not [(v["id"], v["nodes"][0]["html"]) for v in found["violations"]]
    page.close()


def test_sections_are_folded_on_a_small_screen(open_page):
    page = open_page(viewport={"width": 390, "height": 800})
    sections = page.locator("main > section[id]")
    assert sections.count() > 5
    assert all("folded" in (section.get_attribute("class") or "") for section in sections.all())
    height = page.evaluate("document.documentElement.scrollHeight")
    button = page.locator("#parameters h2 button")
    assert button.get_attribute("aria-expanded") == "false"
    button.click()
    assert page.locator("#parameters table").first.is_visible()
    assert button.get_attribute("aria-expanded") == "true"
    assert page.evaluate("document.documentElement.scrollHeight") > height
    page.locator(".contents a").last.click()
    assert page.locator("main > section.folded").count() <= sections.count() - 1
    # A button of a plot's sample leads to its row in the list.
    assert page.is_hidden("#samples tbody")
    page.evaluate("document.querySelector('#samples tbody tr').click()")
    page.click("text=Show in table")
    assert page.locator("#samples tr.chosen").is_visible()
    page.emulate_media(media="print")
    assert all(heading.is_visible() for heading in page.locator("main table").all()[:3])
    page.close()


def test_every_section_is_printed(open_page):
    page = open_page(viewport={"width": 700, "height": 900})
    headings = page.locator("main h2").all_inner_texts()
    document = page.pdf(prefer_css_page_size=True, outline=True, tagged=True)
    page.emulate_media(media="print")
    assert all(heading.is_visible() for heading in page.locator("main h2").all())
    assert not any(item.is_visible() for item in page.locator(".script, .contents, iframe").all())
    assert page.locator("#parameters tr.zero").first.is_visible()
    titles = re.findall(rb"/Title \((.*?)\)\n", document)
    assert [heading.encode() for heading in headings] == [
        title for title in titles if title.decode() in headings
    ]
    page.close()


def test_the_report_of_1500_samples_takes_at_most_3_megabytes(browser, tmp_path):
    # The links of this robot have detailed meshes.
    robot = nominal_arm("ur10")
    rng = np.random.default_rng(0)
    data = Pose.simulate(robot, rng.uniform(-3, 3, (1500, 6)), Noise(1e-4, 1e-4), rng)
    fitted, held_out = split([data], 0.3, 0)
    path = tmp_path / "report.html"
    write_report(calibrate(robot, fitted, "minimal,base,tool", holdout=held_out, extend="none"), path)
    page = path.read_text("utf-8")
    assert (
        len(json.loads(re.findall(r'id="samples-data"[^>]*>(.*?)</script>', page, re.S)[0])["line"]) == 1500
    )
    assert 1e6 < path.stat().st_size <= 3e6
    # Its joints have long names, which fit a narrow page as well.
    window = browser.new_page()
    window.goto(path.as_uri())
    for width in (390, 768, 1200):
        window.set_viewport_size({"width": width, "height": 800})
        assert window.evaluate(CUT_OFF) == []
    window.close()
