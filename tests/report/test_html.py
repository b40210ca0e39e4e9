"""HTML page of the report: its headline, equal bytes for equal input, and how a browser shows it."""

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pages import AXE, READY, listen, wait_for
from robots import URDF, with_small_errors
from slow_cases import some_slow

from dhcal_pin.calibration import accuracy, calibrate
from dhcal_pin.cli.main import main
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.measurements import KINDS, Noise
from dhcal_pin.report import Provenance, ReportContext, write_report
from dhcal_pin.report.calibration_report import calibration_document
from dhcal_pin.report.html import html_page
from dhcal_pin.report.markdown import markdown
from dhcal_pin.report.provenance import file_digests

# Width of an A4 page between margins of 14 mm [CSS px].
PRINTED = round((210 - 2 * 14) / 25.4 * 96)


class Texts(HTMLParser):
    """Texts of a page by element; the elements must be closed in order."""

    VOID = ("meta", "link", "br")

    def __init__(self, page: str):
        super().__init__()
        self.open: list[str] = []
        self.texts: dict[str, list[str]] = {}
        self.ids: list[str] = []
        self.feed(page)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        """Open an element."""
        self.ids += [value for name, value in attrs if name == "id"]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        """Close the innermost element, which must be this one."""
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Store a text."""
        if self.open and data.strip():
            self.texts.setdefault(self.open[-1], []).append(data.strip())


def as_html(context: ReportContext) -> str:
    return html_page(calibration_document(context, "html"))


def as_markdown(context: ReportContext) -> str:
    return markdown(calibration_document(context, "markdown"))


def test_the_headline_is_the_error_on_hold_out_samples(fit, quick, undrawn):
    context = ReportContext(fit, Provenance())
    holdout = accuracy(fit.chain, fit.holdout)["position_rms_m"]
    page = Texts(as_html(context))
    assert page.texts["h1"] == ["Position error on 12 hold-out samples"]
    before, after = page.texts["dd"][:2]
    assert float(after.split()[0]) == pytest.approx(1e3 * holdout, abs=0.051)
    assert f"{before} before, {after} after." in as_markdown(context)
    assert len(page.ids) == len(set(page.ids))
    assert "12 hold-out" in fit._repr_html_()
    assert "on 12 hold-out samples" in fit._repr_html_()


@pytest.mark.parametrize("count", [0, 1])
def test_the_headline_warns_of_few_hold_out_samples(count, calibrated, quick, undrawn):
    context = ReportContext(calibrated(count / 40), Provenance())
    page, text = Texts(as_html(context)), as_markdown(context)
    if count:
        assert page.texts["h1"] == ["Position error on 1 hold-out sample"]
        assert "So few samples give no reliable figure." in text
    else:
        assert page.texts["h1"] == ["Position error on 40 cross-validated samples"]
        assert "position error on 40 cross-validated samples" in text


# Few data of every kind, and enough data of two; the others are slow.
REPORTED = [*((kind, 3) for kind in sorted(KINDS)), *((kind, 30) for kind in sorted(KINDS))]
SOME_REPORTED = [i for i, (kind, count) in enumerate(REPORTED) if count == 3 or kind in ("camera", "pose")]


@pytest.mark.parametrize(("kind", "count"), some_slow(REPORTED, SOME_REPORTED))
def test_every_kind_has_a_report_even_with_few_data(kind, count, sim_6dof, quick):
    rng = np.random.default_rng(3)
    actual = with_small_errors(sim_6dof, rng)
    data = {
        m: KINDS[kind].simulate(actual, rng.uniform(-1, 1, (m, 6)), noise, rng)
        for m, noise in ((30, Noise(1e-4, 1e-4)), (3, Noise()))
    }
    priors = "none" if count == 3 else "default"
    fit = calibrate(
        sim_6dof, data[count], "minimal,base,tool", priors=priors, max_iterations=5, extend="none"
    )
    context = ReportContext(fit, Provenance())
    page, text = as_html(context), as_markdown(context)
    Texts(page)
    for words in (page.split("<iframe")[0], text):
        assert not re.search(r"\b(nan|inf)\b", words), words
    if count == 3:
        assert "All parameters are observable." not in text


def test_the_same_command_writes_the_same_report(tmp_path, monkeypatch, quick, unsuspected_once):
    robot, data = URDF / "sim_6dof.dh.toml", tmp_path / "data.csv"
    truth = ("--truth", URDF / "sim_6dof_actual.dh.toml", "-m", 30, "--noise", "0.1mm,0.01deg", "-o", data)
    assert main([str(a) for a in ("simulate", robot, *truth)]) == 0
    pages = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        reports = (f"--report={name}.html", "--report", f"{name}.md", "--json", f"{name}.json")
        assert (
            main(
                [
                    str(a)
                    for a in ("calibrate", robot, data, "--holdout", "0.2", "-o", f"{name}.urdf", *reports)
                ]
            )
            == 0
        )
        pages.append([Path(f"{name}.{end}").read_bytes() for end in ("html", "md")])
        assert file_digests([data])[str(data)].encode() in pages[-1][0]
    assert pages[0] == pages[1]
    for text in pages[0]:
        assert b"dhcal calibrate sim_6dof.dh.toml data.csv --holdout 0.2" in text
        assert str(tmp_path).encode() not in text


def test_a_report_with_another_ending_is_refused(fit, tmp_path, capsys):
    with pytest.raises(DhcalError, match=r"write a report as \.html or \.md"):
        write_report(fit, tmp_path / "report.pdf")
    out = str(tmp_path / "out.urdf")
    arm = str(URDF / "experiment.dh.toml")
    args = ["calibrate", arm, str(URDF / "experiment_table5.csv"), "-o", out, "--report", "report.pdf"]
    assert main(args) == 2
    assert "report.pdf: unknown ending" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


# --- the page in a browser -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def page_file(fit, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    names = ["a-rather-long-name-of-a-measurement-file.csv"]
    write_report(
        fit,
        path,
        Provenance(command="dhcal calibrate arm.urdf " + names[0], names=names, holdout_names=names),
    )
    return path


def test_the_page_needs_no_network_and_its_scene_is_ready(browser, page_file):
    page = browser.new_page()
    messages, requests = [], []
    listen(page, messages)
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(page_file.as_uri())
    page.locator("iframe").scroll_into_view_if_needed()
    frame = page.frames[1]
    wait_for(frame, READY)
    page.close()
    assert not messages
    assert all(url.startswith(("file:", "data:", "about:")) for url in requests), requests


@pytest.fixture(scope="module")
def page_without_scene(page_file) -> Path:
    """Return the page without its scene, which a browser needs seconds to draw."""
    path = page_file.with_name("without_scene.html")
    path.write_text(re.sub('data-scene="[^"]*"', 'data-scene=""', page_file.read_text("utf-8")), "utf-8")
    return path


@pytest.mark.parametrize(("scheme", "width"), some_slow([("light", 1200), ("dark", 390)], {1}))
def test_the_page_is_accessible_and_fits(browser, page_without_scene, scheme, width):
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme, bypass_csp=True)
    page.goto(page_without_scene.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == width
    page.evaluate(AXE)
    found = page.evaluate("axe.run(document, {iframes: false, resultTypes: ['violations']})")
    page.close()
    assert len(found["passes"]) > 15
    assert not [(v["id"], v["nodes"][0]["html"]) for v in found["violations"]]


def test_nothing_is_cut_off_in_print(browser, page_without_scene):
    page = browser.new_page(viewport={"width": PRINTED, "height": 1000}, color_scheme="dark")
    page.emulate_media(media="print")
    page.goto(page_without_scene.as_uri())
    ends = page.evaluate(
        "[...document.querySelectorAll('table, svg, p, h1, dd')].map(e => e.getBoundingClientRect().right)"
    )
    assert len(ends) > 50
    assert max(ends) <= PRINTED + 1
    # Paper is white in dark mode as well, and drawings replace the scene.
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert not page.locator("iframe").is_visible()
    assert page.locator("#arm-xz-t").count() == 1
    assert page.pdf(prefer_css_page_size=True).startswith(b"%PDF")
    page.close()
