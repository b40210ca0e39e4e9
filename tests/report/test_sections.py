"""Sections of the report: statements about accuracy, outliers and few data."""

from dataclasses import replace

import numpy as np
import pytest

from dhcal_pin.calibration import Verdict, calibrate
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Noise, Pose, Position
from dhcal_pin.report import Provenance, ReportContext
from dhcal_pin.report.calibration_report import calibration_document
from dhcal_pin.report.document import Section
from dhcal_pin.report.markdown import markdown
from dhcal_pin.report.sections import sections_of


def as_markdown(context: ReportContext) -> str:
    return markdown(calibration_document(context, "markdown"))


def test_sections_have_different_keys_and_titles(fit, quick):
    sections = sections_of(ReportContext(fit, Provenance()), "html")
    assert all(isinstance(section, Section) for section in sections)
    assert len({section.key for section in sections}) == len({section.title for section in sections})
    assert {"accuracy", "residuals", "observability"} <= {section.key for section in sections}


@pytest.mark.parametrize("status", ["ok", "refused"])
def test_a_refused_calibration_boasts_no_reduction(fit, status):
    judged = replace(fit, decision=Verdict(status, ("Wrong.",) if status == "refused" else ()))
    names = [name for _, name, _ in calibration_document(ReportContext(judged, Provenance()), "html").values]
    assert names == ["before, RMS", "after, RMS", *(["smaller"] if status == "ok" else [])]


def test_outliers_are_listed_with_file_row_and_size(sim_3dof, quick):
    rng = np.random.default_rng(0)
    data = Position.simulate(sim_3dof, rng.uniform(-1.5, 1.5, (60, 3)), Noise(1e-4), rng)
    data.values[16] += [0.0, 0.03, 0.04]
    source = Provenance(
        names=["in/laser.csv"], excluded_rows={"laser.csv": {3: "because"}}, notes={"laser.csv": ["x"]}
    )
    text = as_markdown(ReportContext(calibrate(sim_3dof, data, "dh", loss="tukey"), source))
    row = next(line for line in text.splitlines() if line.startswith("| laser.csv | 17 |"))
    assert float(row.split("|")[3].split()[0]) == pytest.approx(50, abs=1)
    assert "laser.csv, line 3: not used, because" in text
    assert "laser.csv: x" in text


def test_accuracy_is_said_to_contain_the_noise(fit, quick):
    assert "All errors contain the noise of the instrument." in as_markdown(ReportContext(fit, Provenance()))


def joint_section(fit) -> Section:
    sections = sections_of(ReportContext(fit, Provenance()), "html")
    return next(section for section in sections if section.key == "joints")


def test_joint_values_that_were_measured(fit, quick):
    section = joint_section(fit)
    assert section.title == "Measured joint values"
    (table,) = section.tables
    assert list(table.header) == ["joint", "not measured", "bins visited"]
    assert [row[0] for row in table.texts] == list(fit.chain.joint_names)
    # The values are between -86° and 86°; the table lists the widest gaps.
    assert all(row[1].startswith("−180° to −8") or "−180° to −7" in row[1] for row in table.texts)
    counts = [len(set(np.rint(np.rad2deg(fit.data[0].q[:, i]) / 5))) for i in range(6)]
    assert [row[2] for row in table.texts] == [f"{count} of 72" for count in counts]


def test_joint_correction_curves_of_joints_with_harmonics(sim_3dof, quick):
    rng = np.random.default_rng(0)
    errors = select_parameters(sim_3dof, "curves")
    truth = errors.at(errors.priors * rng.standard_normal(len(errors.priors)))
    data = Pose.simulate(truth, rng.uniform(-np.pi, 1.0, (60, 3)), Noise(1e-5, 1e-5), rng)
    joint = sim_3dof.joint_names[1]
    names = [p.name for p in errors.parameters if p.name.startswith(f"{joint}.")]
    fit = calibrate(sim_3dof, data, "dh", free=names, extend="none", session="off")
    context = ReportContext(fit, Provenance())
    section = joint_section(fit)
    assert section.title == "Joint correction curves"
    (table,) = section.tables
    filled = [row for row in table.texts if row[3]]
    assert [row[0] for row in filled] == [joint]
    assert all(text.endswith(("mrad", "µrad")) for text in filled[0][3:])
    assert section.figures is not None
    (group,) = section.figures()
    (panel,) = group.panels
    assert panel.caption == joint
    assert f"which are {filled[0][2]} bins" in panel.description
    ax = panel.plot()
    assert len(ax.patches) == len(context.joint_curves[0].coverage.gaps)
    assert "Joint correction curves" in as_markdown(context)
