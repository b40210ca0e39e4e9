"""Plots: what is drawn where, the same SVG for the same data, and no import of matplotlib before a plot."""

import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import dhcal_pin
from dhcal_pin import plots
from dhcal_pin.plots import COLORS, svg_panels

# An import of matplotlib; the type of axes is imported for annotations only.
MATPLOTLIB = r"^\s*(from|import) matplotlib(?!\.axes import Axes$)"
HEADER = ["noise", "poses", "position_rms[m]", "orientation_rms[rad]", "length_error[m]", "angle_error[rad]"]
ROWS = [
    [noise, poses, scale * 1e-3 / poses, None, None, None]
    for noise, scale in (("0.1mm", 1.0), ("1mm", 10.0))
    for poses in (10, 20, 40, 100)
]


def draw(plot: partial[Any], key: str = "k", title: str = "t", description: str = "d") -> str:
    """Draw a plot as the only one of a page."""
    with svg_panels() as svg:
        return svg.draw(plot, key, title, description)


def parse(svg: str) -> ElementTree.Element:
    return ElementTree.fromstring(svg)


def dots_of(svg: str, color: str) -> np.ndarray:
    """Return the pixels (m, 2) of the dots of a colour."""
    paths = [e for e in parse(svg).iter("path") if f"stroke: var(--{color})" in e.get("style", "")]
    outline = next(e.get("d", "") for e in paths if "h0" in e.get("d", ""))
    return np.array([pair.split() for pair in outline.strip("M").replace("h0", "").split("M")], float)


@pytest.mark.parametrize(
    "plot",
    [
        partial(plots.plot_error_histogram, np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3])),
        partial(plots.plot_errors_by_sample, {"fitted": (np.arange(3), np.ones(3))}),
        partial(plots.plot_errors_over_joint, np.linspace(-1, 1, 200), np.ones(200)),
        partial(plots.plot_joint_offsets, np.arange(3.0), {"after": (np.zeros(3), np.ones(3))}),
        partial(plots.plot_joint_corrections, np.arange(3.0), np.zeros(3), np.ones(3)),
        partial(plots.plot_singular_values, np.array([1.0, 0.5, 1e-17]), 2),
        partial(plots.plot_position_std_map, np.random.default_rng(0).normal(size=(50, 3)), np.ones(50)),
        partial(plots.plot_arms, {"before": np.eye(3), "after": 2 * np.eye(3)}),
        partial(plots.plot_study, HEADER, ROWS, 2, "position_rms[m]"),
    ],
    ids=lambda plot: plot.func.__name__,
)
def test_every_plot_uses_the_given_axes_or_new_ones(plot):
    ax = plot()
    assert ax.figure.axes == [ax]
    assert ax.get_xlabel()
    assert ax.get_ylabel()
    assert ax.has_data()
    assert plot(ax=ax) is ax


def test_plots_are_in_shown_units():
    ax = plots.plot_errors_by_sample(
        {"fitted": (np.array([1, 2]), np.array([1e-3, 2e-3])), "hold-out": (np.array([3]), np.array([5e-3]))}
    )
    assert ax.get_ylabel() == "position error, mm"
    assert [line.get_ydata().tolist() for line in ax.lines] == [[1.0, 2.0], [5.0]]
    ax = plots.plot_joint_offsets(np.array([0.0, np.pi]), {"after": (np.array([1e-3, 2e-3]), np.zeros(2))})
    assert ax.get_xlabel() == "joint position, °"
    assert ax.lines[-1].get_xdata().tolist() == [0.0, 180.0]
    assert ax.lines[-1].get_ydata().tolist() == [1.0, 2.0]


def test_joint_corrections_have_a_band_and_gaps():
    values = np.deg2rad(np.linspace(-180, 180, 73))
    correction, std = 1e-3 * np.sin(values), np.where(values < 0, 1e-4, 1e-3)
    gaps = [(-np.pi, -np.pi / 2), (0.0, np.pi)]
    ax = plots.plot_joint_corrections(values, correction, std, gaps=gaps, joint="elbow", limit=2e-3)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("elbow, °", "correction, mrad")
    spans = [gap.get_bbox().intervalx for gap in ax.patches]
    assert np.array(spans) == pytest.approx(np.array([[-180, -90], [0, 180]]))
    assert np.asarray(ax.lines[-1].get_ydata()) == pytest.approx(1e3 * correction)
    band = ax.collections[0].get_paths()[0]
    assert band.contains_point((-90, -1 + 0.19))
    assert not band.contains_point((-90, -1 + 0.21))
    assert band.contains_point((90, 1 + 1.9))
    assert ax.get_ylim() == pytest.approx((-2.1, 2.1))
    assert ax.get_xticks()[1:-1].tolist() == [-90, 0, 90]
    assert ax.get_legend_handles_labels()[1] == ["not measured", "95 % band", "correction"]


def test_a_correction_that_is_not_determined_fills_the_axes():
    values, std = np.linspace(-1, 1, 11), np.full(11, np.inf)
    ax = plots.plot_joint_corrections(values, np.zeros(11), std, limit=1e-3)
    assert np.isfinite(ax.collections[0].get_paths()[0].vertices).all()
    assert ax.collections[0].get_paths()[0].contains_point((0, 1.0))


def test_a_histogram_counts_every_sample():
    before, after = np.random.default_rng(0).uniform(0, [[1e-3], [1e-4]], (2, 300))
    ax = plots.plot_error_histogram(before, after)
    assert [int(patch.get_data().values.sum()) for patch in ax.patches] == [300, 300]
    assert ax.get_xscale() == "log"
    assert plots.plot_error_histogram(before, 0.5 * before).get_xscale() == "linear"


def test_a_dot_is_where_its_axes_say():
    plot = partial(
        plots.plot_errors_by_sample,
        {
            "fitted": (np.array([0, 10, 5]), np.array([0.0, 1e-3, 0.5e-3])),
            "hold-out": (np.array([5]), np.zeros(1)),
        },
    )
    svg = draw(plot, "k", "A & B", "What <it> shows")
    root = parse(svg)
    assert [root.findtext("title"), root.findtext("desc")] == ["A & B", "What <it> shows"]
    assert root.attrib["aria-labelledby"].split() == [
        e.attrib["id"] for tag in ("title", "desc") for e in root.iter(tag)
    ]
    low, high, middle = dots_of(svg, "sample")
    assert middle == pytest.approx((low + high) / 2, abs=0.1)
    assert dots_of(svg, "holdout")[0] == pytest.approx([middle[0], low[1]], abs=0.1)


def test_panels_do_not_depend_on_the_panels_before():
    first = partial(plots.plot_singular_values, np.array([1.0, 0.5, 1e-17]), 2)
    second = partial(plots.plot_errors_over_joint, np.linspace(-1, 1, 200), np.linspace(0, 1e-3, 200))
    with svg_panels() as svg:
        drawn = [svg.draw(plot, key, key, "") for key, plot in (("a", first), ("b", second), ("c", first))]
    assert drawn[1] == draw(second, "b", "b", "")
    assert drawn[2] == draw(first, "c", "c", "")


def test_the_same_data_give_the_same_bytes_whatever_the_users_settings():
    import matplotlib

    plot = partial(plots.plot_errors_by_sample, {"fitted": (np.arange(50), np.linspace(0, 1e-3, 50))})
    wanted = draw(plot)
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "red", "lines.marker": "x"}):
        assert draw(plot) == wanted
        assert matplotlib.rcParams["font.size"] == 30
    assert "<metadata" not in wanted
    assert "<style" not in wanted


def test_colours_are_css_variables():
    plot = partial(plots.plot_singular_values, np.array([1.0, 0.5, 1e-17]), 2)
    svg = draw(plot)
    assert {f"var(--{name})" for name in ("text", "grid", "after", "outlier")} <= set(
        style.split(": ")[1] for e in parse(svg).iter() for style in e.get("style", "").split("; ") if style
    )
    assert not [color for color in COLORS.values() if color in svg]
    assert len(set(COLORS.values())) == len(COLORS)


def test_names_with_dollars_and_foreign_letters_are_plain_text():
    plot = partial(plots.plot_errors_over_joint, np.linspace(-1, 1, 20), np.ones(20), joint="$a_b$ 関節")
    assert "$a_b$ 関節, °" in [e.text for e in parse(draw(plot)).iter("text")]


def test_levels_of_a_map():
    std = np.concatenate([np.full(90, 0.10), np.full(10, 0.55), [np.inf]])
    edges = plots.std_levels(std)
    assert edges == pytest.approx(0.092 * np.arange(7))
    # Equal values get a colour in the middle of the scale.
    assert np.searchsorted(plots.std_levels(np.ones(5)), 1.0, side="right") - 1 in (2, 3)


def test_a_line_for_each_setting_at_the_numbers_of_the_table():
    ax = plots.plot_study(HEADER, ROWS, 2, "position_rms[m]")
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert [line.get_label() for line in ax.lines] == ["noise 0.1mm", "noise 1mm"]
    for line, scale in zip(ax.lines, (1.0, 10.0), strict=True):
        assert line.get_xdata().tolist() == [10, 20, 40, 100]
        assert line.get_ydata() == pytest.approx(scale / np.array([10, 20, 40, 100]))


def test_a_study_is_one_file_and_the_same_for_the_same_table():
    svg = plots.study_svg("how many?", HEADER, ROWS, 2)
    assert svg == plots.study_svg("how many?", HEADER, ROWS, 2)
    words = {e.text for e in ElementTree.fromstring(svg).iter() if e.tag.endswith("text")}
    assert {"noise 0.1mm", "noise 1mm", "poses", "how many?", "position error, RMS [mm]"} <= words
    assert "orientation error, RMS [°]" not in words
    assert plots.study_svg("a", HEADER, ROWS[:1], 2) == ""


def test_matplotlib_is_imported_for_plots_only():
    """Commands without a plot must not wait for the import."""
    modules = (
        "dhcal_pin.cli.main",
        "dhcal_pin.cli.commands.calibrate",
        "dhcal_pin.cli.commands.study",
        "dhcal_pin.report.html",
    )
    script = (
        f"import sys, dhcal_pin, {', '.join(modules)}\n"
        "dhcal_pin.calibrate, dhcal_pin.show, dhcal_pin.write_report\n"
        "sys.exit(any(name.split('.')[0] in ('matplotlib', 'jinja2') for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


def test_only_the_modules_of_plots_import_matplotlib():
    package = Path(dhcal_pin.__file__).parent
    importing = {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if re.search(MATPLOTLIB, path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert importing == {"plots.py", "calibration/presentation/fit_plots.py"}
