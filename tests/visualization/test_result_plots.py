"""Methods of results, plans and studies that draw them: what is drawn, and in which units."""

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from robots import URDF

import dhcal_pin as dh
from dhcal_pin.estimation import qr
from dhcal_pin.exceptions import InvalidArgumentError, UnknownNameError
from dhcal_pin.planning import plan
from dhcal_pin.plots import COLORS
from dhcal_pin.studies import plot_study, read_study, run

pytestmark = pytest.mark.usefixtures("unsuspected")

PLOTS = ("accuracy", "residuals", "parameters", "singular_values", "correlation", "workspace")


@pytest.fixture(scope="module")
def arm():
    return dh.Chain.from_dh(dh.read_dh(URDF / "sim_6dof.dh.toml"))


@pytest.fixture(scope="module")
def fit(arm):
    """Pose measurements with an outlier, 45 fitted and 15 held out."""
    rng = np.random.default_rng(0)
    actual = dh.Chain.from_dh(dh.read_dh(URDF / "sim_6dof_actual.dh.toml"))
    data = dh.Pose.simulate(actual, rng.uniform(-2.5, 2.5, (60, 6)), dh.Noise(1e-4, 1e-4), rng)
    poses = data.poses.copy()
    poses[3, 0, 3] += 0.02
    data = dh.Pose(data.q, poses, 1e-4, 1e-4)
    return dh.calibrate(arm, data.take(np.s_[:45]), "dh", holdout=data.take(np.s_[45:]), extend="none")


def drawn(ax):
    """Draw the figure, which fails if an artist is wrong."""
    ax.figure.canvas.draw()
    return ax


def series(ax):
    """Lines by label."""
    lines: dict[str, Any] = {line.get_label(): line for line in ax.get_lines()}
    return lines


@pytest.mark.parametrize("name", PLOTS)
def test_plots_take_axes_or_make_them(fit, name):
    method = getattr(fit, f"plot_{name}")
    given = Figure().add_subplot()
    assert method(given) is given
    first, second = drawn(method()), method()
    assert first.figure is not second.figure
    assert first.get_xlabel() or name == "correlation"
    drawn(given)


def test_accuracy_is_that_of_the_comparisons(fit):
    ax = drawn(fit.plot_accuracy())
    assert [text.get_text() for text in ax.get_yticklabels()] == [
        *("15 hold-out", "left-out regions", "44 fitted")
    ]
    lines = series(ax)
    first, last = fit.comparisons[0], fit.comparisons[-1]
    for state in ("before", "after"):
        rms = [1e3 * getattr(each, state).groups["position"].rms for each in (first, last)]
        np.testing.assert_allclose(lines[f"{state}, RMS"].get_xdata()[[0, -1]], rms)
        p95 = 1e3 * getattr(first, state).groups["position"].p95
        assert lines[f"{state}, 95th percentile"].get_xdata()[0] == pytest.approx(p95)
    assert fit.plot_accuracy(group="orientation").get_xlabel() == "orientation error, mrad"
    with pytest.raises(UnknownNameError, match="choose from position, orientation"):
        fit.plot_accuracy(group="residual")


def test_residuals_before_and_after(fit):
    lines = series(drawn(fit.plot_residuals()))
    nominal = fit.nominal_refitted
    expected = [
        1e3 * np.linalg.norm(item.poses[:, :3, 3] - nominal.poses(item.q)[:, :3, 3], axis=1)
        for item in (*fit.data, *fit.holdout)
    ]
    np.testing.assert_allclose(lines["before"].get_ydata(), np.concatenate(expected), rtol=1e-9)
    after = 1e3 * fit.residuals.norms("position")
    np.testing.assert_allclose(lines["after, hold-out"].get_ydata(), after[45:], rtol=1e-9)
    np.testing.assert_allclose(lines["after, hold-out"].get_xdata(), np.arange(46, 61))
    assert lines["after, outlier"].get_xdata().tolist() == [4]
    assert lines["after, outlier"].get_color() == COLORS["outlier"]
    assert len(lines["after, fitted"].get_xdata()) == 44


def test_residuals_over_a_joint_and_over_time(fit):
    q = np.concatenate([item.q for item in (*fit.data, *fit.holdout)])
    ax = drawn(fit.plot_residuals(over="joint_3"))
    assert ax.get_xlabel() == "joint_3, °"
    np.testing.assert_allclose(series(ax)["before"].get_xdata(), np.degrees(q[:, 2]))
    assert {"before, median", "after, median"} <= set(series(ax))
    time = np.linspace(0, 600, 60)
    np.testing.assert_allclose(series(fit.plot_residuals(over=time))["before"].get_xdata(), time)
    for over, words in (("joint_9", "choose from sample, histogram, joint_1"), (time[:5], r"\(60,\)")):
        with pytest.raises(UnknownNameError, match=words):
            fit.plot_residuals(over=over)


def test_histograms_share_their_bins(fit):
    ax = drawn(fit.plot_residuals(over="histogram"))
    steps = {patch.get_label(): patch.get_data() for patch in ax.patches}
    assert set(steps) == {
        f"{state}, {part}" for state in ("before", "after") for part in ("fitted", "hold-out")
    }
    for values, edges, _ in steps.values():
        assert values.sum() == pytest.approx(100)
        np.testing.assert_array_equal(edges, steps["before, fitted"][1])


def test_parameters_are_relative_to_their_priors(fit):
    ax = drawn(fit.plot_parameters(count=7))
    names = [text.get_text() for text in ax.get_yticklabels()]
    index = [[p.name for p in fit.parameters].index(name) for name in names]
    change = np.abs(fit.x / fit.prior_std)
    assert len(names) == 7
    assert min(change[index]) >= np.sort(change)[-7]
    dots = next(line for line in ax.get_lines() if len(line.get_xdata()) == 7)
    np.testing.assert_allclose(dots.get_xdata(), (fit.x / fit.prior_std)[index])
    (bars,) = (one for one in ax.collections if len(one.get_segments()) == 7)
    widths = np.array([segment[1, 0] - segment[0, 0] for segment in bars.get_segments()])
    np.testing.assert_allclose(widths, 4 * np.minimum(fit.std / fit.prior_std, 10)[index])
    assert ax.get_ylabel() == "7 largest of 24 corrections"


def test_singular_values_and_correlation(fit):
    values = qr.singular_values(fit.solution.system.r)
    lines = series(drawn(fit.plot_singular_values()))
    np.testing.assert_allclose(lines["observable"].get_ydata(), (values / values[0])[: fit.rank])
    (image,) = drawn(fit.plot_correlation()).images
    np.testing.assert_allclose(image.get_array().filled(np.nan), fit.correlation)
    assert image.get_clim() == (-1.0, 1.0)


def test_workspace(fit):
    ax = drawn(fit.plot_workspace(plane="xy"))
    assert "x in the base frame" in ax.get_xlabel()
    assert "y in the base frame" in ax.get_ylabel()
    assert len(series(ax)["measured samples"].get_xdata()) == 44
    with pytest.raises(UnknownNameError, match="choose from xy, xz, yz"):
        fit.plot_workspace(plane="zz")


def test_joint_corrections(arm, fit):
    with pytest.raises(InvalidArgumentError, match="no joint has a correction curve"):
        fit.plot_joint_corrections()
    curved = dh.calibrate(arm, fit.data, "dh,harmonics", extend="none")
    panels = curved.plot_joint_corrections()
    assert [panel.get_xlabel() for panel in panels] == [f"joint_{i}, °" for i in range(1, 7)]
    drawn(panels[0])
    given = list(Figure().subplots(1, 6))
    assert curved.plot_joint_corrections(given) == given
    with pytest.raises(InvalidArgumentError, match="2 axes; expected one per curve, 6"):
        curved.plot_joint_corrections(given[:2])


def test_plan_curve(arm):
    result = plan(arm, 12, noise=dh.Noise(1e-4, 1e-4), parameters="dh", candidates=100)
    lines = series(drawn(result.plot_curve()))
    np.testing.assert_allclose(lines["planned poses"].get_ydata(), 1e3 * result.errors)
    np.testing.assert_allclose(lines["random poses"].get_xdata(), result.random_sizes)
    assert lines["this plan"].get_xdata().tolist() == [12]


def test_study(tmp_path):
    path = tmp_path / "small.study.toml"
    robot = URDF / "sim_3dof.dh.toml"
    path.write_text(f'seeds = 5\n[settings]\nrobot = "{robot}"\nnoise = "0.1mm"\nposes = [10, 20, 40]\n')
    study = read_study(path)
    ax = drawn(plot_study(study, list(run(study))))
    (line,) = ax.get_lines()
    assert line.get_xdata().tolist() == [10, 20, 40]
    assert np.all(np.diff(line.get_ydata()) < 0)


def test_table_and_summary(fit):
    frame = fit.to_dataframe()
    assert frame.index.tolist() == [estimate.name for estimate in fit.estimates]
    np.testing.assert_allclose(frame["value"], [estimate.value for estimate in fit.estimates])
    np.testing.assert_allclose(frame["std"][: len(fit.x)], fit.std)
    text = fit.summary()
    assert text.startswith(f"Verdict: {fit.verdict.status}.")
    assert "on 15 hold-out samples" in text
    assert "Largest corrections: " in text


def test_kinds_without_joint_values_or_positions(arm):
    rng = np.random.default_rng(1)
    q = rng.uniform(-2.5, 2.5, (60, 6))
    lengths = dh.Wires.simulate(arm, q, dh.Noise(1e-4, 1e-4), rng)
    fit = dh.calibrate(arm, lengths, "dh", extend="none")
    assert drawn(fit.plot_residuals()).get_ylabel() == "residual, mm"
    assert drawn(fit.plot_accuracy()).get_xlabel() == "residual, mm"
