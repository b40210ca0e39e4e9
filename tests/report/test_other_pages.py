"""Pages of validations and plans: their figures are those of the JSON, and samples can be selected."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pages import listen
from robots import URDF

from dhcal_pin.cli.main import main
from dhcal_pin.io import read_configurations, read_robot
from dhcal_pin.io.check_history import Check
from dhcal_pin.report import history_page

ROBOT, TRUTH = URDF / "sim_6dof.dh.toml", URDF / "sim_6dof_actual.dh.toml"


def run(*words: Any) -> None:
    assert main([str(word) for word in words]) == 0


def page_data(path: Path) -> dict[str, Any]:
    """Return the samples that a page contains."""
    return json.loads(re.findall(r'id="samples-data"[^>]*>(.*?)</script>', path.read_text("utf-8"), re.S)[0])


def check_in_browser(browser: Any, path: Path, headings: list[str], tool: np.ndarray) -> None:
    """Compare the headings of a page, and select its first sample: its tool must be at `tool` [m]."""
    page = browser.new_page(viewport={"width": 1200, "height": 800})
    complaints, requests = [], []
    listen(page, complaints)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(path.as_uri())
    assert page.locator("main h2").all_inner_texts() == headings
    line = page_data(path)["line"][0]
    page.locator("#samples input[type=search]").fill(f":{line}")
    page.get_by_role("button", name=f"Select line {line}", exact=True).click()
    shown = page.locator(".tool-position data").evaluate_all("all => all.map(d => d.value)")
    page.close()
    assert np.abs(np.array(shown, float) - tool).max() < 1e-9
    assert not complaints
    assert all(url.startswith(("file:", "data:", "about:")) for url in requests), requests


@pytest.fixture
def data(tmp_path, monkeypatch) -> str:
    monkeypatch.chdir(tmp_path)
    run("simulate", ROBOT, "--truth", TRUTH, "-m", 60, "--noise", "0.1mm,0.01deg", "-o", "data.csv")
    return "data.csv"


def test_page_of_a_validation(data, browser, unsuspected_once):
    run("calibrate", ROBOT, data, "-o", "out.urdf")
    words = ("validate", "out.urdf", data, "--nominal", ROBOT)
    run(*words, "--report", "a.html", "--json", "a.json")
    run(*words, "--report", "b.html")
    assert Path("a.html").read_bytes() == Path("b.html").read_bytes()
    document, samples = json.loads(Path("a.json").read_text()), page_data(Path("a.html"))
    assert document["files"]["report"] == "a.html"
    for state in ("before", "after"):
        rms = np.sqrt(np.mean(np.square(samples["errors"]["position"][state])))
        assert rms == pytest.approx(document[state]["position_rms_m"], rel=1e-6)
    chain = read_robot("out.urdf")
    q = read_configurations(data, chain)
    headings = ["Accuracy", "Residual errors", "Robot and measurements", "Samples", "Provenance"]
    check_in_browser(browser, Path("a.html").absolute(), headings, chain.poses(q[:1])[0, :3, 3])


def test_page_of_a_validation_without_a_nominal_robot(data):
    run("validate", TRUTH, data, "--fit-frames", "--report", "a.html", "--json", "a.json")
    document, samples = json.loads(Path("a.json").read_text()), page_data(Path("a.html"))
    assert list(samples["errors"]["position"]) == ["after"]
    rms = np.sqrt(np.mean(np.square(samples["errors"]["position"]["after"])))
    assert rms == pytest.approx(document["after"]["position_rms_m"], rel=1e-6)


def test_page_of_a_plan(tmp_path, monkeypatch, browser):
    monkeypatch.chdir(tmp_path)
    words = ("plan", ROBOT, "-n", 12, "--candidates", 200)
    run(*words, "-o", "poses.csv", "--report", "a.html", "--json", "a.json")
    run(*words, "-o", "poses.csv", "--report", "b.html")
    assert Path("a.html").read_bytes() == Path("b.html").read_bytes()
    document, samples = json.loads(Path("a.json").read_text()), page_data(Path("a.html"))
    assert document["files"]["report"] == "a.html"
    page = Path("a.html").read_text("utf-8")
    assert f"{1e3 * document['predicted_position_rms_m']:.3f} mm" in page
    # The lines are those of the file with the poses.
    rows = Path("poses.csv").read_text().splitlines()
    first = [float(cell) for cell in rows[samples["line"][0] - 1].split(",")]
    assert np.degrees([column[0] for column in samples["q"]]) == pytest.approx(first, abs=1e-4)
    assert samples["line"][-1] == len(rows)
    assert samples["downloads"]["poses.csv"] == Path("poses.csv").read_text()
    chain = read_robot(ROBOT)
    tool = chain.poses(np.array([[column[0] for column in samples["q"]]]))[0, :3, 3]
    headings = ["Predicted accuracy", "Joint values", "Robot and poses", "Poses", "Provenance"]
    check_in_browser(browser, Path("a.html").absolute(), headings, tool)


@pytest.mark.parametrize("command", ["validate", "plan"])
def test_a_report_with_another_ending_is_refused(command, data, capsys):
    words = {"validate": [data], "plan": ["-n", "5", "-o", "poses.csv"]}[command]
    assert main([command, str(ROBOT), *words, "--report", "report.md"]) == 2
    assert "report.md: unknown ending" in capsys.readouterr().err
    assert not Path("report.md").exists()


@pytest.mark.parametrize("expected", [None, 9e-5])
def test_checks_over_time_fill_the_page(window, tmp_path, expected):
    """Beside contents of 200 px, a page has 1080 of 1280 px; the table has lines, not cards for phones."""
    times = [f"2026-0{month}-01T10:00:00+00:00" for month in (1, 2)]
    checks = [
        Check(time, "a.urdf", ["b.csv"], "ok", "", None, None, None, 1e-4, expected, 8) for time in times
    ]
    path = tmp_path / "h.html"
    path.write_text(history_page("a", checks))
    window.page.set_viewport_size({"width": 1280, "height": 800})
    window.page.goto(path.as_uri())
    width = "document.querySelector('main').getBoundingClientRect().width"
    assert window.page.evaluate(width) == pytest.approx(1080)
    row = "getComputedStyle(document.querySelector('tbody tr')).display"
    assert window.page.evaluate(row) == "table-row"
    legend = window.page.locator(".legend li").all_inner_texts()
    assert legend == ["ok", *(["expected"] if expected else [])]
