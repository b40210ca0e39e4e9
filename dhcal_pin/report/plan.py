"""Page of a plan: the poses to measure, and the accuracy to expect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from .. import plots, se3
from .._frozen import frozen
from ..planning.planner import Plan
from ..planning.views import views_table
from ..robot.chain import Chain
from ..robot.coverage import joint_coverage
from . import figures
from .document import BarTable, Document, FigureGroup, Panel, Section
from .html import html_page
from .provenance import origin_tables
from .samples import Samples, samples_section


@frozen(eq=False)
class PlanReport:
    """Plan and what its page shows beside it."""

    plan: Plan  #: Plan.
    chain: Chain  #: Robot.
    name: str  #: Name of the robot.
    file: str  #: Name of the file with the poses.
    first_line: int  #: Line of the first pose in this file.
    text: str  #: Content of this file.
    moves: Sequence[str]  #: Sentences on the moves between the poses.
    scene: str  #: Page of a 3-D scene with the poses.
    inputs: Mapping[str, str]  #: SHA-256 of each input file by path.
    pixel_sigma: float  #: Standard deviation of the corners of planned images [px].


def plan_page(report: PlanReport) -> str:
    """Render the page of a plan."""
    plan, count = report.plan, len(report.plan.q)
    samples = Samples(
        chain=report.chain,
        file=np.full(count, report.file, object),
        line=report.first_line + np.arange(count),
        number=1 + np.arange(count),
        role=np.full(count, "planned"),
        is_outlier=np.zeros(count, bool),
        q=plan.q,
        errors={},
        downloads={"poses.csv": report.text},
    )
    noise = plan.information.noise
    percent = 100 * (1 - plan.relative_error)
    return html_page(
        Document(
            title=f"Poses for {report.name}",
            heading=f"{count} poses to measure",
            sections=_sections(report, samples),
            eyebrow=f"Plan for {report.name}",
            values=[
                ("before", "random poses, predicted RMS", f"{1e3 * plan.random_error:.3f} mm"),
                ("after", "planned poses, predicted RMS", f"{1e3 * plan.error:.3f} mm"),
                ("", "lower" if percent >= 0 else "higher", f"{abs(percent):.0f} %"),
            ],
            details=[
                ("", "criterion", plan.criterion),
                ("", "standard deviation of a position", f"{1e3 * noise.position:.3g} mm"),
                ("", "of an orientation", f"{np.degrees(noise.rotation):.3g}°"),
                *([("", "of a corner", f"{report.pixel_sigma:.3g} px")] if plan.views else []),
            ],
            remarks=[*report.moves, *plan.notes],
            samples=samples.page_data,
        )
    )


def _sections(report: PlanReport, samples: Samples) -> list[Section]:
    """Return the sections of the page."""
    plan = report.plan
    return [
        Section(
            "error",
            "Predicted accuracy",
            [
                "RMS position error over the task after the calibration, over the number of poses. Errors "
                "that the model lacks come in addition.",
                size_sentence(plan),
            ],
            figures=partial(_curve_figures, plan),
        ),
        Section(
            "joints",
            "Joint values",
            ["A bin of a turn is 5° wide and counts as visited if one pose lies in it."],
            tables=[_coverage_table(report)],
        ),
        *_views_sections(plan),
        Section("scene", "Robot and poses", figures=partial(_pose_figures, report, samples)),
        samples_section(samples, "Poses"),
        Section("provenance", "Provenance", tables=origin_tables(report.inputs)),
    ]


def size_sentence(plan: Plan) -> str:
    """Say beyond how many poses more of them help little."""
    if plan.recommended_size:
        return f"Diminishing returns beyond {plan.recommended_size} poses (less than 1 % per ten)."
    return f"No diminishing returns up to {plan.sizes[-1]} poses (still at least 1 % per ten)."


def _views_sections(plan: Plan) -> list[Section]:
    """Return the section with the planned images, if there are any."""
    if not plan.views:
        return []
    text = (
        "Distance of the middle of the board from the camera, angle between the normal of the board and the "
        "line of sight, and the share of the 10 x 10 cells of the image in which there is a corner."
    )
    return [Section("images", "Images of the boards", [text], tables=[views_table(plan.views)])]


def _curve_figures(plan: Plan) -> list[FigureGroup]:
    """Draw the predicted error over the number of poses."""
    text = (
        f"Predicted RMS position error over the number of poses: {1e3 * plan.error:.3f} mm for {len(plan.q)} "
        f"planned poses, {1e3 * plan.random_error:.3f} mm for as many random ones."
    )
    plot = partial(
        plots.plot_plan_curve,
        (plan.sizes, plan.errors),
        (plan.random_sizes, plan.random_errors),
        (len(plan.q), plan.error),
        plan.recommended_size,
    )
    return [
        FigureGroup([Panel("curve", "Predicted position error", text, plot, (640.0, 320.0))], layout="full")
    ]


def _coverage_table(report: PlanReport) -> BarTable:
    """Return the range of each joint and how much of a turn the poses visit."""
    coverage = {one.joint: one for one in joint_coverage(report.chain, report.plan.q)}
    rows, bars = [], []
    for i, joint in enumerate(report.chain.joint_names):
        low, high = report.plan.q[:, i].min(), report.plan.q[:, i].max()
        one = coverage.get(joint)
        factor, unit, decimals = (np.degrees(1.0), "°", 1) if one else (1e3, " mm", 1)
        bins = f"{one.n_visited} of {one.n_in_range}" if one else ""
        rows.append([joint, *(f"{factor * value:.{decimals}f}{unit}" for value in (low, high)), bins])
        bars.append(one.share if one else None)
    return BarTable(["joint", "lowest", "highest", "bins visited"], rows, bars={"share": bars})


def _pose_figures(report: PlanReport, samples: Samples) -> list[FigureGroup]:
    """Draw the tool positions of the poses, and the robot in 3-D."""
    poses = se3.inverse(report.chain.base) @ report.chain.poses(samples.q)
    panels = []
    for plane, view in (("xy", "from above"), ("xz", "from the side")):
        plot = partial(plots.plot_arms, {}, plane=plane, samples=poses[:, :3, 3])
        text = f"Tool positions of {len(samples)} poses over {plane[0]} and {plane[1]} in the base frame."
        points = figures.plane_points(plane)
        panels.append(Panel(f"poses-{plane}", f"Tool, {view}", text, plot, plots.SQUARE_PANEL, points))
    title = "The robot and the poses to measure, in three dimensions"
    return [
        FigureGroup((), scene=figures.packed_scene(report.scene), scene_title=title),
        FigureGroup(panels, "Tool positions", layout="wide"),
    ]
