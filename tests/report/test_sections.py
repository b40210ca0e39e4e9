"""Sections of the report: statements about accuracy, outliers and few data."""

from __future__ import annotations

import numpy as np
import pytest

from dhcal_pin.calibration import calibrate
from dhcal_pin.measurements import Noise, Position
from dhcal_pin.report import Provenance, ReportContext
from dhcal_pin.report.sections import Section, markdown, report_sections


def test_sections_have_different_keys_and_titles(fit, quick):
    sections = report_sections(ReportContext.from_result(fit, Provenance()))
    assert all(isinstance(section, Section) for section in sections)
    assert len({section.key for section in sections}) == len({section.title for section in sections})
    assert {"accuracy", "residuals", "observability"} <= {section.key for section in sections}


def test_outliers_are_listed_with_file_row_and_size(sim_3dof, quick):
    rng = np.random.default_rng(0)
    data = Position.simulate(sim_3dof, rng.uniform(-1.5, 1.5, (60, 3)), Noise(1e-4), rng)
    data.values[16] += [0.0, 0.03, 0.04]
    source = Provenance(names=["in/laser.csv"], excluded_rows={"laser.csv": {3: "because"}})
    text = markdown(ReportContext.from_result(calibrate(sim_3dof, data, "dh", loss="tukey"), source))
    row = next(line for line in text.splitlines() if line.startswith("| laser.csv | 17 |"))
    assert float(row.split("|")[3].split()[0]) == pytest.approx(50, abs=1)
    assert "laser.csv, row 3: not used, because" in text
