"""The report: numbers against other ways to them, the page in a real browser, honesty where data are few."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from robots import URDF, missing, paper, robot_file

from dhcal_pin import Provenance, se3, write_report
from dhcal_pin.calibration.evaluation import accuracy
from dhcal_pin.calibration.partition import split
from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.calibration.result import Result
from dhcal_pin.cli import main
from dhcal_pin.diagnostics import predict_workspace, residuals, workspace
from dhcal_pin.estimation import Priors
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.measurements import KINDS
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.measurements.position import Position
from dhcal_pin.report import document, html
from dhcal_pin.report.context import ReportContext
from dhcal_pin.report.sections import markdown
from dhcal_pin.robot.chain import Chain

AXE = Path(sys.prefix) / "node_modules" / "axe-core" / "axe.min.js"
# The text of an A4 page between its margins of 14 mm, CSS pixels.
PRINTED = round((210 - 2 * 14) / 25.4 * 96)


def fitted(held: float = 0.3) -> Result:
    """The paper's simulated arm, calibrated on its actual one."""
    nominal, actual = Chain.from_dh(paper("sim_6dof")), Chain.from_dh(paper("sim_6dof_actual"))
    rng = np.random.default_rng(0)
    data = Pose.simulate(actual, rng.uniform(-1.5, 1.5, (40, 6)), Noise(2e-4, 3e-4), rng)
    kept, parted = split([data], held, 0)
    return calibrate(nominal, kept, "dh", holdout=parted)


@pytest.fixture(scope="module")
def fit() -> Result:
    return fitted()


@pytest.fixture
def quick(monkeypatch):
    """Fewer configurations over the workspace."""
    monkeypatch.setattr(workspace, "N_PREDICTED_CONFIGURATIONS", 300)


def test_a_joint_that_waves_is_seen_in_that_joint_alone():
    arm = Chain.from_urdf(robot_file("ur_description/urdf/ur5_robot.urdf"))
    rng = np.random.default_rng(2)
    q = rng.uniform(-2.5, 2.5, (1500, 6))
    wave = np.zeros_like(q)
    wave[:, 2] = 2e-3 * np.sin(q[:, 2])
    data = Pose.simulate(arm, q + wave, Noise(1e-4, 1e-4), rng)
    found = calibrate(arm, data.replace(q=q), "tool", fix=["tool.y"])
    traces = residuals.joint_offset_profiles(found)
    assert [t.name for t in traces] == list(arm.moving_joints)
    for j, t in enumerate(traces):
        wanted = 2e-3 * np.sin(t.centres) if j == 2 else 0 * t.centres
        assert len(t.centres) == residuals.N_BINS
        # A part is 0.42 rad wide: within it the wave's mean lies this far from its value in the middle.
        assert np.abs(t.after - wanted).max() < (6e-5 if j == 2 else 4.5 * t.after_std.max())
        assert np.all(t.after_std > 0)


def test_the_workspace_is_in_the_base_frame(quick):
    nominal, actual = Chain.from_dh(paper("sim_6dof")), Chain.from_dh(paper("sim_6dof_actual"))
    truth = replace(actual, base=se3.exp6(np.array([3.0, -2.0, 1.0, 0.3, 0.2, 2.0])))
    rng = np.random.default_rng(0)
    data = Pose.simulate(truth, rng.uniform(-1.5, 1.5, (40, 6)), Noise(1e-4, 1e-4), rng)
    found = predict_workspace(calibrate(nominal, data, "dh,base"), [data])
    model, state = actual.model, actual.model.createData()
    for q, point in zip(data.q, found.measured, strict=True):
        pin.framesForwardKinematics(model, state, actual.configurations(q[None])[0])
        # Base and first joint share directions that only a prior parts: millimetres.
        assert np.abs(state.oMf[actual.frame_id].translation - point).max() < 0.02
    assert found.std.shape == (300,)
    assert np.median(found.std) > np.median(found.measured_std)


# --- words -----------------------------------------------------------------------------------------


class Texts(HTMLParser):
    """The texts of a page by element, and whether its elements are closed in order."""

    VOID = ("meta", "link", "br")

    def __init__(self, page: str):
        super().__init__()
        self.open: list[str] = []
        self.texts: dict[str, list[str]] = {}
        self.ids: list[str] = []
        self.feed(page)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        """Opens an element."""
        self.ids += [value for name, value in attrs if name == "id"]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        """Closes the innermost element, which must be this one."""
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Keeps a text."""
        if self.open and data.strip():
            self.texts.setdefault(self.open[-1], []).append(data.strip())


def test_the_headline_is_the_error_on_what_was_not_fitted(fit, quick):
    held = accuracy(fit.chain, fit.holdout)["position_rms_m"]
    page = Texts(html.html_page(ReportContext.from_result(fit, Provenance())))
    assert page.texts["h1"] == ["Position error on 12 hold-out samples"]
    first = page.texts["dd"]
    assert float(first[1].split()[0]) == pytest.approx(1e3 * held, abs=0.051)
    assert f"{first[0]} before, {first[1]} after." in markdown(ReportContext.from_result(fit, Provenance()))
    assert len(page.ids) == len(set(page.ids))
    assert "12 hold-out" in fit._repr_html_()
    assert "on 12 hold-out samples" in fit._repr_html_()


@pytest.mark.parametrize("count", [0, 1])
def test_few_held_out_or_none_is_said(count, quick):
    found = ReportContext.from_result(fitted(held=count / 40), Provenance())
    page, text = Texts(html.html_page(found)), markdown(found)
    if count:
        assert page.texts["h1"] == ["Position error on 1 hold-out sample"]
        assert "So few samples give no reliable figure." in text
    else:
        ends = "on 40 cross-validated samples"
        assert page.texts["h1"] == [f"Position error {ends}"]
        assert f"position error {ends}" in text


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_kind_and_few_data_have_a_report(kind, quick):
    nominal = Chain.from_dh(paper("sim_6dof"))
    rng = np.random.default_rng(3)
    actual = Chain.from_dh(paper("sim_6dof_actual"))
    cases: tuple[tuple[int, Noise, Priors], ...] = (
        (30, Noise(1e-4, 1e-4), "default"),
        (3, Noise(), "none"),
    )
    for count, noise, priors in cases:
        data = KINDS[kind].simulate(actual, rng.uniform(-1, 1, (count, 6)), noise, rng)
        found = ReportContext.from_result(
            calibrate(nominal, data, "minimal,base,tool", priors=priors, max_iterations=5), Provenance()
        )
        page, text = html.html_page(found), markdown(found)
        Texts(page)
        for words in (page.split("<iframe")[0], text):
            assert not re.search(r"\b(nan|inf)\b", words), words
        if count == 3:
            assert "Nothing is hidden" not in text


def test_the_same_command_writes_the_same_report(tmp_path, monkeypatch, quick):
    robot, data = URDF / "sim_6dof.dh.toml", tmp_path / "data.csv"
    truth = ("--truth", URDF / "sim_6dof_actual.dh.toml", "-m", 30, "--noise", "0.1mm,0.01deg", "-o", data)
    assert main.main([str(a) for a in ("simulate", robot, *truth)]) == 0
    pages = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        out = (
            "-o",
            f"{name}.urdf",
            f"--report={name}.html",
            "--report",
            f"{name}.md",
            "--json",
            f"{name}.json",
        )
        assert main.main([str(a) for a in ("calibrate", robot, data, "--holdout", "0.2", *out)]) == 0
        pages.append([Path(f"{name}.{end}").read_bytes() for end in ("html", "md")])
        assert document.file_digests([data])[str(data)].encode() in pages[-1][0]
    assert pages[0] == pages[1]
    for text in pages[0]:
        assert b"dhcal calibrate sim_6dof.dh.toml data.csv --holdout 0.2" in text
        assert str(tmp_path).encode() not in text


def test_a_report_of_another_kind_is_refused(fit, tmp_path, capsys):
    with pytest.raises(DhcalError, match=r"write a report as \.html or \.md"):
        write_report(fit, tmp_path / "report.pdf")
    out = str(tmp_path / "out.urdf")
    arm = str(URDF / "experiment.dh.toml")
    args = ["calibrate", arm, str(URDF / "experiment_table5.csv"), "-o", out, "--report", "report.pdf"]
    assert main.main(args) == 2
    assert "report.pdf: unknown ending" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_gross_errors_are_listed_with_file_row_and_size(quick):
    nominal = Chain.from_dh(paper("sim_3dof"))
    rng = np.random.default_rng(0)
    data = Position.simulate(nominal, rng.uniform(-1.5, 1.5, (60, 3)), Noise(1e-4), rng)
    data.values[16] += [0.0, 0.03, 0.04]
    source = Provenance(names=["in/laser.csv"], excluded_rows={"laser.csv": {3: "because"}})
    text = markdown(ReportContext.from_result(calibrate(nominal, data, "dh", loss="tukey"), source))
    row = next(line for line in text.splitlines() if line.startswith("| laser.csv | 17 |"))
    assert float(row.split("|")[3].split()[0]) == pytest.approx(50, abs=1)
    assert "laser.csv, row 3: not used, because" in text


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


def test_the_page_asks_no_host_and_its_scene_is_ready(browser, page_file):
    page = browser.new_page()
    said, asked = [], []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(page_file.as_uri())
    page.locator("iframe").scroll_into_view_if_needed()
    page.wait_for_function("document.querySelector('iframe') !== null")
    frame = page.frames[1]
    frame.wait_for_function("window.dhcal && window.dhcal.ready === true")
    page.close()
    assert not said
    assert all(url.startswith(("file:", "data:", "about:")) for url in asked), asked


@pytest.fixture(scope="module")
def still_file(page_file) -> Path:
    """The page with an empty scene, which takes a browser seconds to draw."""
    path = page_file.with_name("still.html")
    path.write_text(re.sub('srcdoc="[^"]*"', 'srcdoc=""', page_file.read_text("utf-8")), "utf-8")
    return path


@pytest.mark.parametrize(("scheme", "width"), [("light", 1200), ("dark", 390)])
def test_the_page_is_accessible_and_fits(browser, still_file, scheme, width):
    if not AXE.exists():
        missing("axe-core")
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme, bypass_csp=True)
    page.goto(still_file.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == width
    page.evaluate(AXE.read_text(encoding="utf-8"))
    found = page.evaluate("axe.run(document, {iframes: false})")
    page.close()
    assert len(found["passes"]) > 15
    assert not [(v["id"], v["nodes"][0]["html"]) for v in found["violations"]]


def test_nothing_is_cut_in_print(browser, still_file):
    page = browser.new_page(viewport={"width": PRINTED, "height": 1000}, color_scheme="dark")
    page.emulate_media(media="print")
    page.goto(still_file.as_uri())
    ends = page.evaluate(
        "[...document.querySelectorAll('table, svg, p, h1, dd')].map(e => e.getBoundingClientRect().right)"
    )
    assert len(ends) > 50
    assert max(ends) <= PRINTED + 1
    # Paper is white whatever the screen is, and the scene gives way to a drawing.
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert not page.locator("iframe").is_visible()
    assert page.locator("#arm-xz-t").count() == 1
    assert page.pdf(prefer_css_page_size=True).startswith(b"%PDF")
    page.close()
