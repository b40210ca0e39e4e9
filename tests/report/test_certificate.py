"""Certificate: what it states, what it leaves to fill in, and how it is printed."""

import hashlib
import json
import re
from html import escape, unescape
from pathlib import Path

import pytest
from pages import AXE, listen
from robots import URDF
from slow_cases import some_slow

from dhcal_pin.cli.main import main
from dhcal_pin.report import write_certificate
from dhcal_pin.report.certificate import parse_meta

META = {"serial": "<b>20</b>", "operator": 'A. "B" & C', "cell": "7"}


def texts(page: str) -> str:
    """Return the texts of a page without its elements."""
    return unescape(re.sub(r"<[^>]*>", " ", page.partition("<body>")[2]))


@pytest.fixture(scope="module")
def path(fit, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("certificate") / "certificate.html"
    write_certificate(fit, path, META)
    return path


def test_it_states_verdict_accuracy_and_metadata(fit, path):
    page = path.read_text("utf-8")
    shown = texts(page)
    assert f"Verdict: {fit.verdict.status}" in shown
    rms = re.findall(
        r"RMS position error on 12 hold-out samples: ([\d.]+) mm before, ([\d.]+) mm after", shown
    )
    first = fit.comparisons[0]
    expected = [1e3 * side.groups["position"].rms for side in (first.before, first.after)]
    # The figures are rounded by their own standard errors.
    assert [float(text) for text in rms[0]] == pytest.approx(expected, rel=0.02)
    for value in META.values():
        assert value in shown
        assert escape(value, quote=False) in page.replace("&#34;", '"')
    for label in ("Serial number", "Instrument", "Date of measurement", "Operator", "cell", "signature"):
        assert label in shown
    # Instrument and date are not given: two lines to fill in, and two for signatures.
    assert page.count('class="blank"') == 4


def test_it_is_the_same_for_the_same_input(fit, path, tmp_path):
    again = tmp_path / "again.html"
    write_certificate(fit, again, META)
    assert again.read_bytes() == path.read_bytes()


def test_metadata_of_the_command_line():
    assert parse_meta(["serial = 7", "note=a=b"]) == {"serial": "7", "note": "a=b"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--certificate", "c.html", "--meta", "serial"], "--meta serial: expected KEY=VALUE"),
        (["--certificate", "c.html", "--meta", "a=1", "--meta", "a=2"], "a is given twice"),
        (["--certificate", "c.pdf"], "c.pdf: unknown ending"),
        (["--meta", "serial=7"], "--meta: needs --certificate"),
    ],
)
def test_wrong_options_are_refused_in_one_line(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    data = [str(URDF / name) for name in ("experiment.dh.toml", "experiment_table5.csv")]
    assert main(["calibrate", *data, "-o", "out.urdf", *words]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_command_writes_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = [str(URDF / name) for name in ("experiment.dh.toml", "experiment_table5.csv")]
    words = ["--certificate", "c.html", "--meta", "date=2026-03-01", "--json", "c.json"]
    assert main(["calibrate", *data, "-o", "out.urdf", *words]) == 0
    document = json.loads(Path("c.json").read_text())
    shown = texts(Path("c.html").read_text("utf-8"))
    assert document["files"]["certificate"] == "c.html"
    assert "2026-03-01" in shown
    for digest in document["inputs"].values():
        assert digest in shown
    for name in ("out.urdf", "out.calibration.toml"):
        assert (
            f"SHA-256 of the result {name} {hashlib.sha256(Path(name).read_bytes()).hexdigest()}"
            in " ".join(shown.split())
        )
    assert str(tmp_path) not in shown


@pytest.mark.parametrize("width", some_slow([390, 1200], {0}))
def test_it_is_accessible_and_prints_on_two_pages_at_most(browser, path, width):
    page = browser.new_page(viewport={"width": width, "height": 800}, bypass_csp=True)
    complaints = []
    listen(page, complaints)
    page.goto(path.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == width
    page.evaluate(AXE)
    found = page.evaluate("axe.run(document)")
    document = page.pdf(prefer_css_page_size=True)
    page.close()
    assert not complaints
    assert not [(v["id"], v["nodes"][0]["html"]) for v in found["violations"]]
    assert 1 <= len(re.findall(rb"/Type /Page\b", document)) <= 2
