"""Page of the difference of two calibrations of one robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from .. import plots, se3
from ..diagnostics.difference import STATISTICS, Difference
from ..formatting import Quantity, Table
from ..plots import SQUARE_PANEL
from ..visualization import scene
from .document import Document, FigureGroup, Panel, Section
from .figures import MAX_SCENE_TRIANGLES, level_legend, packed_scene
from .html import html_page
from .provenance import origin_tables


def difference_table(difference: Difference) -> Table:
    """Return one row per region and sort of distance."""
    rows = []
    for where, each in (("measured region", difference.region), ("joint limits", difference.everywhere)):
        for what, unit in (("position", "m"), ("orientation", "rad")):
            values = each and getattr(each, what)
            if values is None:
                continue
            cells = [Quantity.error(float(function(values)), unit) for function in STATISTICS.values()]
            expected = each.expected if what == "position" and each.expected is not None else np.nan
            rows.append([f"{what}, {where}", *cells, Quantity.error(expected, "m")])
    return Table(["distance", "RMS", "95 %", "max", "expected RMS"], rows)


def difference_page(names: Sequence[str], difference: Difference, inputs: Mapping[str, str]) -> str:
    """Render the page of a difference of two robot files."""
    table = difference_table(difference)
    sections = [
        Section(
            "difference", "Distance of the tools", difference.sentences, tables=[table, *_joints(difference)]
        ),
        Section("map", "Over the workspace", figures=partial(_maps, difference)),
        Section("scene", "Both robots", figures=partial(_scene, difference)),
        Section("provenance", "Provenance", tables=origin_tables(inputs)),
    ]
    title = f"Difference of {names[0]} and {names[1]}"
    values = [("", row[0], f"{row[1]} RMS") for row in table.texts]
    return html_page(Document(title, sections, heading=difference.verdict, eyebrow=title, values=values))


def _joints(difference: Difference) -> list[Table]:
    """Return a table of the joints that differ."""
    rows = [[name, f"{value:.0f}"] for name, value in difference.joints.items()]
    return [Table(["joint", "part of chi-square"], rows)] if rows else []


def _maps(difference: Difference) -> list[FigureGroup]:
    """Draw maps of the distance of the tools."""
    a, b = difference.first, difference.second
    points, others = (chain.poses(difference.q)[:, :3, 3] for chain in (a, b))
    distances, base = np.linalg.norm(points - others, axis=1), se3.inverse(a.base)
    points = points @ base[:3, :3].T + base[:3, 3]
    levels, panels = plots.std_levels(distances), []
    for plane, view in (("xy", "from above"), ("xz", "from the side")):
        plot = partial(plots.plot_position_std_map, points, distances, plane=plane, levels=levels)
        rms = Quantity.error(float(STATISTICS["rms"](distances)), "m")
        text = f"Map of the distance of the tools over {plane[0]} and {plane[1]}: RMS {rms}."
        panels.append(Panel(f"difference-{plane}", f"Distance, {view}", text, plot, SQUARE_PANEL))
    return [FigureGroup(panels, legend=level_legend(levels), layout="wide")]


def _scene(difference: Difference) -> list[FigureGroup]:
    """Draw both robots in 3-D."""
    a, b = difference.first, difference.second
    page = scene.scene_html(a, b, title="Difference", triangles=MAX_SCENE_TRIANGLES)
    return [FigureGroup((), scene=packed_scene(page), scene_title="Both robots, in three dimensions")]
