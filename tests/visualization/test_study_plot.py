"""A study's plot shows the numbers of its table."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from dhcal_pin.visualization.study_plot import plot

HEADER = ["noise", "poses", "position_rms[m]", "orientation_rms[rad]", "length_error[m]", "angle_error[rad]"]
ROWS = [
    [noise, poses, scale * 1e-3 / poses, None, None, None]
    for noise, scale in (("0.1mm", 1.0), ("1mm", 10.0))
    for poses in (10, 20, 40, 100)
]


def test_a_line_for_each_setting_at_the_numbers_of_the_table():
    """Errors that fall as one over the poses are straight in logarithms, a decade apart for ten times."""
    drawing = ElementTree.fromstring(plot("how many?", 2, HEADER, ROWS))
    paths = [item.attrib for item in drawing.iter() if item.tag.endswith("path")]
    lines = [path["d"] for path in paths if re.fullmatch(r"line s\d", path["class"]) and "L" in path["d"]]
    points = np.array([[pair.split() for pair in d[1:].split("L")] for d in lines], float)
    assert points.shape == (2, 4, 2)
    slopes = np.diff(points[..., 1]) / np.diff(points[..., 0])
    assert slopes == pytest.approx(slopes[0, 0], rel=0.02)
    apart = points[0, :, 1] - points[1, :, 1]
    # Ten times the noise is as far as ten times the poses.
    assert apart / (points[0, -1, 1] - points[0, 0, 1]) == pytest.approx(1, rel=0.02)
    words = {item.text for item in drawing.iter() if item.tag.endswith("text")}
    assert {"noise 0.1mm", "noise 1mm", "poses", "how many?", "position error, RMS [mm]"} <= words
    assert "orientation error, RMS [°]" not in words


def test_the_same_table_gives_the_same_text_and_one_setting_gives_none():
    assert plot("a", 2, HEADER, ROWS) == plot("a", 2, HEADER, ROWS)
    assert plot("a", 2, HEADER, ROWS[:1]) == ""
