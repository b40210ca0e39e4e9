"""The page in a browser: files are dropped, checked and calibrated; keyboard, widths, colours."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from openpyxl import Workbook
from pages import AXE, READY, VIEWPORT, listen
from robots import URDF
from slow_cases import some_slow

import dhcal_pin.app.server
from dhcal_pin.calibration.summary import format_share
from dhcal_pin.cli.main import main
from dhcal_pin.io.rig_file import read_rig

# Width and colours of the looks at the page.
LOOKS = tuple(product((390, 768, 1200), ("light", "dark")))
EXAMPLE = Path(dhcal_pin.app.server.__file__).parent / "example"
DROP = """([files]) => {
  const data = new DataTransfer();
  for (const [name, text] of files) data.items.add(new File([text], name));
  dispatchEvent(new DragEvent("drop", { dataTransfer: data, cancelable: true }));
}"""


@contextmanager
def opened(browser: Any, url: str) -> Iterator[Any]:
    """The page in a browser of its own; it must not complain nor ask another server."""
    context = browser.new_context(viewport=VIEWPORT)
    context.set_default_timeout(120_000)
    page = context.new_page()
    complaints: list[str] = []
    # The pages that it opens, too.
    listen(context, complaints)
    context.on("weberror", lambda error: complaints.append(str(error.error)))
    context.on(
        "request",
        lambda request: request.url.startswith((url, "blob:", "data:")) or complaints.append(request.url),
    )
    page.goto(url)
    yield page
    context.close()
    assert complaints == []


@pytest.fixture(scope="module")
def shared_page(app, browser):
    with opened(browser, app.url) as page:
        yield page


@pytest.fixture
def page(shared_page):
    """The page as it is when it is opened; another process of the browser would take half a second."""
    shared_page.set_viewport_size(VIEWPORT)
    shared_page.emulate_media(color_scheme="light")
    shared_page.evaluate("sessionStorage.clear()")
    shared_page.reload()
    return shared_page


def drop(page: Any, *files: tuple[str, str]) -> None:
    page.evaluate(DROP, [list(files)])


def drop_with_tip(page: Any, *files: tuple[str, str]) -> None:
    """Name the tip first; a page with files checks them again after each change."""
    page.fill("#tip", "tool0")
    page.locator("#tip").blur()
    drop(page, *files)


def example_files(example: Path) -> list[tuple[str, str]]:
    return [(name, (example / name).read_text()) for name in ("ur10.urdf", "laser.csv")]


def download(page: Any, name: str) -> bytes:
    with page.expect_download() as waiting:
        page.click(f'[aria-label="Download {name}"]')
    assert waiting.value.suggested_filename == name
    return Path(waiting.value.path()).read_bytes()


def multiplied(example: Path, column: int, factor: float) -> str:
    """The measurements with a factor of one column."""
    lines = [line for line in (example / "laser.csv").read_text().splitlines() if line[0] != "#"]
    rows = [line.split(",") for line in lines]
    for row in rows[1:]:
        row[column] = str(factor * float(row[column]))
    return "\n".join(map(",".join, rows))


def wrong_sign(example: Path) -> str:
    """The measurements with the other sign of the elbow."""
    return multiplied(example, 2, -1)


def test_dropped_files_end_in_the_robot_of_the_command_line(page, example):
    drop_with_tip(page, *example_files(example))
    page.wait_for_selector("#check .card.ok")
    assert "position, 100 rows, 100 configurations" in page.inner_text("#check")
    assert page.eval_on_selector_all("#links option", "them => them.map(it => it.value)").count("tool0") == 1
    page.click("#calibrate")
    page.wait_for_selector("#result:not([hidden])")
    assert download(page, "ur10_calibrated.urdf") == (example / "ur10_calibrated.urdf").read_bytes()
    assert download(page, "report.html") == (example / "report.html").read_bytes()
    result = json.loads(download(page, "result.json"))
    before, after = page.eval_on_selector_all(".headline dd", "them => them.map(it => it.textContent)")
    assert float(before.split()[0]) == pytest.approx(
        1e3 * result["holdout_before"]["position_rms_m"], rel=0.05
    )
    assert float(after.split()[0]) == pytest.approx(1e3 * result["holdout_after"]["position_rms_m"], rel=0.05)
    shown = page.inner_text("#result")
    assert "Verdict: ok" in shown
    counts = {each["title"]: each["n_samples"] for each in result["comparisons"]}
    assert f"{counts['hold-out']} hold-out rows" in shown
    assert f"{counts['fitted']} fitted rows" in shown
    assert f"Accuracy unknown: {format_share(1 - result['reached_share'])} of joint space" in shown
    assert "use it in place of the old one; keep the sidecar beside it" in shown
    assert "dhcal calibrate ur10.urdf laser.csv --tip tool0 --holdout 0.3" in page.text_content("#result pre")
    for name in ("report.html", "scene.html"):
        with page.context.expect_page() as waiting:
            page.click(f'[aria-label="Open {name} in a new tab"]')
        waiting.value.wait_for_load_state()
        if name == "scene.html":
            waiting.value.wait_for_function(READY)
        assert "ur10" in waiting.value.title()
        waiting.value.close()


def test_too_many_photographs_need_the_corners_in_them(page):
    page.evaluate(DROP, [[(f"{i}.jpg", "") for i in range(200)]])
    page.wait_for_selector("#file-error:not([hidden])")
    assert "instead of photographs, add the corners that `dhcal detect` finds" in page.inner_text(
        "#file-error"
    )


def test_refusal_shows_the_remedy_and_applies_it(page, example):
    urdf, _ = example_files(example)
    drop_with_tip(page, urdf, ("laser.csv", wrong_sign(example)))
    page.click("#calibrate")
    page.wait_for_selector("#result .refused")
    assert "The sign of joint elbow_joint is wrong" in page.inner_text("#result")
    assert page.locator('#downloads a[download$=".urdf"]').count() == 0
    # The errors of a robot that is not written are no result.
    assert page.is_hidden("#result table")
    page.click("#result summary")
    assert page.is_visible("#result table")
    page.click("text=Apply the change and calibrate again")
    page.wait_for_selector("#result .card.ok")
    assert "sign:elbow_joint" in page.inner_text("#mends")
    # Other files start without the change.
    drop(page, ("laser.csv", "x"))
    assert page.is_hidden("#mends")
    assert page.is_hidden("#result")


def test_a_caution_has_the_buttons_of_which_it_speaks(page, example):
    urdf, _ = example_files(example)
    drop_with_tip(page, urdf, ("laser.csv", multiplied(example, 8, 1.002)))
    page.click("#calibrate")
    page.wait_for_selector("#result .card.caution")
    shown = page.inner_text("#result .card.caution")
    assert "Measured z is 0.2 % too long" in shown
    assert "press a button below" in shown
    assert "--mend" not in shown
    assert page.locator("text=Write the robot all the same").count() == 0
    page.click("text=Apply the change and calibrate again")
    page.wait_for_selector("#result .card.ok")
    assert "scale:z:1.002" in page.inner_text("#mends")


def test_a_loaded_page_shows_its_calibration_again(page, example):
    drop_with_tip(page, *example_files(example))
    page.click("#calibrate")
    page.wait_for_function("() => sessionStorage.job")
    page.reload()
    assert "add them again: ur10.urdf, laser.csv" in page.inner_text("#file-error")
    page.wait_for_selector("#result .card.ok")
    shown = page.inner_text("#result")
    assert page.is_disabled("#calibrate")
    page.reload()
    page.wait_for_selector("#result .card.ok")
    assert page.inner_text("#result") == shown
    assert download(page, "ur10_calibrated.urdf") == (example / "ur10_calibrated.urdf").read_bytes()
    # Other files begin anew.
    drop(page, *example_files(example))
    page.wait_for_selector("#check .card.ok")
    assert page.is_hidden("#file-error")
    page.reload()
    assert page.is_hidden("#result")


def test_a_cancelled_calibration_does_not_come_back(page, example):
    drop_with_tip(page, *example_files(example))
    page.click("#calibrate")
    page.wait_for_function("() => sessionStorage.job")
    page.click("#cancel")
    page.wait_for_selector("text=Cancelled. Nothing was kept.")
    page.reload()
    assert page.is_hidden("#cancel")
    assert page.is_hidden("#run-error")


def test_refused_remedies_need_the_files(page, example):
    urdf, _ = example_files(example)
    drop_with_tip(page, urdf, ("laser.csv", wrong_sign(example)))
    page.click("#calibrate")
    page.wait_for_selector("#result .refused")
    page.reload()
    page.wait_for_selector("#result .refused")
    assert page.is_disabled("text=Apply the change and calibrate again")


def test_the_check_names_what_is_missing_beside_its_control(page):
    """The servo file, the tip and the rig of the example are missing, and are added in turn."""
    corners, motors = ((name, (EXAMPLE / name).read_text()) for name in ("corners.csv", "so101.json"))
    drop(page, ("so101.urdf", (URDF / "so101.urdf").read_text()), corners)
    page.wait_for_selector("#needed-file:has-text('Add the servo file')")
    drop(page, motors)
    page.wait_for_selector("#tip-error:not([hidden])")
    assert page.get_attribute("#tip", "placeholder") == "moving_jaw_link"
    page.click("text=Rows of each image (20)")
    assert "00.png\t24" in page.inner_text("#check")
    page.fill("#tip", "gripper_frame_link")
    page.locator("#tip").blur()
    page.wait_for_selector("#needed-file:has-text('Add the rig file')")
    assert page.is_hidden("#tip-error")
    assert "RIG.toml" not in page.inner_text("#check")


def test_figures_of_the_page_count_as_the_command_does(page):
    """A fit to images of another board can reject all but one image and has no error there."""
    accuracy = {"residual_rms": 1e-9, "unit": "px"}
    result = {"before": accuracy, "after": accuracy, "comparisons": [
        {"title": "fitted", "n_samples": 24, "n_outliers": 480}
    ]}  # fmt: skip
    assert (
        page.evaluate("result => accuracies(result)[0]", result)[1] == "24 fitted rows, without 480 outliers"
    )


def test_a_proposed_column_map_is_used(page, example):
    lines = [line for line in (example / "laser.csv").read_text().splitlines() if line[0] != "#"]
    header = "A1;A2;A3;A4;A5;A6;X pos;Y pos;Z pos"
    rows = [";".join(line.split(",")[:9]).replace(".", ",") for line in lines[1:]]
    urdf, _ = example_files(example)
    drop_with_tip(page, urdf, ("tracker.csv", "\n".join([header, *rows])))
    page.wait_for_selector("#check .card.problem")
    page.click("#calibrate")
    page.wait_for_selector("#run-error:not([hidden])")
    assert "write a column map with the lines" in page.inner_text("#run-error")
    page.click("text=Use this column map")
    page.wait_for_selector("#check .card.ok")
    page.click("#calibrate")
    page.wait_for_selector("#result:not([hidden])")
    assert "Verdict: ok" in page.inner_text("#result")
    assert "--columns columns.toml" in page.text_content("#result pre")
    # The command needs the map, which only the page has.
    with page.expect_download() as download:
        page.click("#downloads a[download='columns.toml']")
    assert "A1" in download.value.path().read_text()
    assert page.locator("#downloads a[download='tracker.csv']").count() == 0


def test_a_sheet_of_an_excel_file_is_chosen(page, example, tmp_path):
    lines = [line for line in (example / "laser.csv").read_text().splitlines() if line[0] != "#"]
    header, *rows = (line.split(",") for line in lines)
    book = Workbook(write_only=True)
    for title, part in (("first", rows[:60]), ("second", rows[60:])):
        sheet = book.create_sheet(title)
        sheet.append(header)
        for row in part:
            sheet.append([float(value) for value in row])
    book.save(tmp_path / "laser.xlsx")
    assert page.is_hidden("#sheet")
    page.fill("#tip", "tool0")
    page.set_input_files("#picker", [example / "ur10.urdf", tmp_path / "laser.xlsx"])
    page.wait_for_selector("#check .card:has-text('60 rows')")
    page.fill("#sheet", "second")
    page.locator("#sheet").blur()
    page.wait_for_selector("#check .card:has-text('40 rows')")
    page.click("#calibrate")
    page.wait_for_selector("#result:not([hidden])")
    assert "--sheet second" in page.text_content("#result pre")


@pytest.mark.slow
def test_the_example_ends_in_the_corrected_files_of_a_servo_arm(page):
    page.click("#example")
    page.wait_for_selector("#check .card.ok")
    page.click("#calibrate")
    page.wait_for_selector("#result .card.ok")
    assert "elbow_flex" in page.inner_text("#result .card.warning")
    assert page.is_disabled("#parameters")
    before, after = page.eval_on_selector_all(
        ".headline dd", "them => them.map(it => parseFloat(it.textContent))"
    )
    assert after < 0.3 * before
    motors = json.loads(download(page, "so101_calibrated.json"))
    stated = json.loads((EXAMPLE / "so101.json").read_text())
    assert motors["elbow_flex"]["homing_offset"] != stated["elbow_flex"]["homing_offset"]
    assert download(page, "so101_calibrated.urdf").startswith(b"<?xml")
    # Without the rig the corners are no measurement.
    page.click('[aria-label="Remove rig.toml"]')
    page.wait_for_selector("#check .card.problem")


DROP_PHOTOGRAPH = """async () => {
  const canvas = Object.assign(document.createElement("canvas"), { width: 320, height: 200 });
  const blob = await new Promise(done => canvas.toBlob(done));
  const data = new DataTransfer();
  data.items.add(new File([blob], "photograph.png"));
  dispatchEvent(new DragEvent("drop", { dataTransfer: data, cancelable: true }));
}"""


def test_a_rig_file_is_made_and_its_board_is_printed(page, example, tmp_path, monkeypatch):
    page.evaluate(DROP_PHOTOGRAPH)
    page.wait_for_function("() => document.getElementById('rig-width').value === '320'")
    assert page.evaluate("sessionStorage.files") == "1 photograph"
    page.select_option("#rig-place", "world")
    page.fill("#rig-square", "25")
    page.fill("#rig-ruler", "149.5")
    with page.expect_download() as waiting:
        page.click("[data-paper=letter]")
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(page.input_value("#rig-text"))
    assert main("board rig.toml --paper letter -o board.pdf".split()) == 0
    assert Path(waiting.value.path()).read_bytes() == Path("board.pdf").read_bytes()
    with page.expect_download() as waiting:
        page.click("#rig-save")
    assert Path(waiting.value.path()).read_bytes() == Path("rig.toml").read_bytes()
    rig = read_rig("rig.toml")
    (camera,), (board,) = rig.cameras.values(), rig.boards.values()
    assert (camera.link, board.link, camera.width, camera.height) == ("world", "tip", 320, 200)
    page.click("#rig-use")
    page.wait_for_selector('[aria-label="Remove rig.toml"]')
    assert page.get_attribute("#rig-maker", "open") is None
    drop(page, ("other.toml", "[camera.a]\n"))
    page.wait_for_selector('[aria-label="Remove other.toml"]')
    assert "other.toml takes the place of rig.toml" in page.inner_text("#file-error")
    page.evaluate("document.getElementById('rig-maker').open = true")
    page.fill("#rig-square", "1000")
    page.click("[data-paper=a4]")
    page.wait_for_selector("#rig-error:not([hidden])")
    page.fill("#rig-square", "")
    assert page.inner_text("#rig-error") == "Square of the board [mm]: expected a positive number."
    page.fill("#rig-square", "20")
    assert page.is_hidden("#rig-error")
    page.fill("#rig-text", "[board.own]")
    assert page.is_disabled("#rig-square")
    page.fill("#rig-text", "")
    assert "square_mm = 20" in page.input_value("#rig-text")


def test_errors_are_shown_as_one_line(page, example):
    drop(page, *example_files(example))
    page.fill("#tip", "nowhere")
    page.click("#calibrate")
    page.wait_for_selector("#run-error:not([hidden])")
    assert "ur10.urdf: unknown link 'nowhere'" in page.inner_text("#run-error")
    page.wait_for_selector("#tip-error:not([hidden])")
    assert page.is_hidden("#result")
    # The size is checked before anything is sent.
    page.evaluate("document.documentElement.dataset.limit")
    assert page.evaluate("LIMIT") == 100_000_000
    page.evaluate("addFiles([{ name: 'big.csv', size: 1e9 }])")
    assert "1000.0 MB; at most 100.0 MB" in page.inner_text("#file-error")


def test_two_browsers_work_at_once_and_one_cancels(app, browser, example):
    with opened(browser, app.url) as one, opened(browser, app.url) as other:
        for page in (one, other):
            drop_with_tip(page, *example_files(example))
            page.wait_for_selector("#check .card.ok")
        other.select_option("#parameters", "offset,base,tool")
        one.click("#calibrate")
        other.click("#calibrate")
        other.wait_for_function("() => document.getElementById('phase').textContent !== 'reading the files'")
        other.click("#cancel")
        other.wait_for_selector("text=Cancelled. Nothing was kept.")
        assert other.is_hidden("#result")
        assert other.evaluate("document.activeElement.id") == "calibrate"
        one.wait_for_selector("#result:not([hidden])")
        assert download(one, "ur10_calibrated.urdf") == (example / "ur10_calibrated.urdf").read_bytes()
        other.click("#calibrate")
        other.wait_for_selector("#result:not([hidden])")
        assert "offset" in other.text_content("#result pre")


def test_the_keyboard_is_enough(page, example):
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "picker"
    # The browser itself opens the dialogue of a file input.
    page.set_input_files("#picker", [example / "ur10.urdf", example / "laser.csv"])
    page.wait_for_selector("#check .card.ok")
    visited = []
    for _ in range(20):
        page.keyboard.press("Tab")
        visited.append(page.evaluate("document.activeElement.id || document.activeElement.ariaLabel || ''"))
        if visited[-1] == "tip":
            page.keyboard.type("tool0")
        if visited[-1] == "calibrate":
            break
    assert [name for name in visited if name] == [
        *("example", "Use of ur10.urdf", "Remove ur10.urdf", "Use of laser.csv", "Remove laser.csv"),
        *("tip", "parameters", "holdout", "skip-bad-rows", "calibrate"),
    ]
    page.keyboard.press("Enter")
    page.wait_for_selector("#result:not([hidden])")
    assert page.evaluate("document.activeElement.id") == "result"


def violations(page: Any) -> list[tuple[str, list[str]]]:
    found = page.evaluate("() => axe.run(document, {resultTypes: ['violations']})")["violations"]
    return [(one["id"], [node["html"] for node in one["nodes"]]) for one in found]


# Looks of the first page, of a refusal, of a run and of a result that are checked for all faults.
SOME_LOOKS = [{(390, "light")}, {(1200, "dark")}, {(390, "light")}, {(390, "light"), (1200, "dark")}]


@pytest.mark.parametrize("looks", some_slow([SOME_LOOKS, 4 * [set(LOOKS)]], {0}), ids=["some", "all"])
def test_every_state_is_accessible_at_every_width(page, example, looks):
    """Nothing is wider than the page at any width; some looks are checked for all other faults."""
    page.evaluate(AXE)

    def check(checked: set[tuple[int, str]]) -> None:
        for width, scheme in LOOKS:
            page.set_viewport_size({"width": width, "height": 900})
            page.emulate_media(color_scheme=scheme)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            if (width, scheme) in checked:
                assert violations(page) == [], (width, scheme)

    page.click("#rig-maker summary")
    check(looks[0])
    page.click("#rig-maker summary")
    urdf, data = example_files(example)
    drop_with_tip(page, urdf, ("laser.csv", wrong_sign(example)))
    page.wait_for_selector("#check .card.warning")
    page.click("#check summary")
    page.click("#calibrate")
    page.wait_for_selector("#result .refused")
    check(looks[1])
    drop(page, data)
    page.click("#calibrate")
    check(looks[2])  # while it runs
    page.wait_for_selector("#result .card.ok")
    page.wait_for_selector("#check .card.ok")
    page.click("#result summary")
    check(looks[3])


def test_offered_parameter_sets_exist(page, sim_6dof):
    from dhcal_pin.estimation.parameters import select_parameters

    values = page.eval_on_selector_all("#parameters option", "them => them.map(it => it.value)")
    assert sorted(values) == ["", "base,tool", "dh,base,tool", "offset,base,tool", "placement,base,tool"]
    assert all(select_parameters(sim_6dof, value or sim_6dof.parameters).parameters for value in values)
