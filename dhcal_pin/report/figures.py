"""Figures of sections: which plots of `plots` a section shows.

A function gets the `ReportContext`, or samples, and returns groups of figures in their order on the page.
"""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from .. import plots, se3
from .._typing import Array
from ..calibration.evaluation import compute_errors, error_norms
from ..calibration.presentation.workspace import WorkspacePrediction
from ..formatting import Quantity, capitalized, round_up
from ..measurements.groups import ERROR_GROUPS, in_order
from ..plots import SQUARE_PANEL, WIDE_PANEL
from ..robot.chain import Chain
from ..session import histories
from ..visualization import scene
from .context import ReportContext
from .document import FigureGroup, LegendEntry, Panel
from .samples import ROLES, Samples

# A joint whose errors are larger than this multiple of the joints' median gets a scale of its own. Errors
# before the calibration are left out if they are larger than this multiple of those after it.
MAX_SCALE_RATIO = 4.0
# Displacement that the magnified errors should cause, relative to the size of the robot.
DRAWN_DISPLACEMENT = 0.05
# Largest number of triangles of the meshes of a scene in a report; they show the form of each link.
MAX_SCENE_TRIANGLES = 30_000
# Script of a scene that is part of a report.
SCENE_LINK = Path(__file__).with_name("page") / "scene_link.js"


def accuracy_figures(context: ReportContext) -> list[FigureGroup]:
    """Draw histograms of the errors before and after, for hold-out and fitted samples by error group."""
    fit, panels = context.fit, []
    norms = {
        role: [
            error_norms(compute_errors(fit.nominal_refitted, data, fit.nominal_instruments)),
            error_norms(compute_errors(fit.chain, data, fit.instruments)),
        ]
        for role, data in (("hold-out", fit.counted_holdout), ("fitted", fit.counted))
        if data
    }
    for group in in_order(set().union(*(after for _, after in norms.values()))):
        # Without a fitted image the pose of the camera is not known, nor the error at the board.
        roles = {
            role: (before[group], after[group])
            for role, (before, after) in norms.items()
            if group in after and np.isfinite(after[group]).all()
        }
        panels += histogram_panels(group, roles)
    legend = [LegendEntry(state, state, "area") for state in ("before", "after")]
    return [FigureGroup(panels, legend=legend, layout="wide")]


def histogram_panels(group: str, errors: Mapping[str, tuple[Array, Array]]) -> list[Panel]:
    """Draw histograms of the errors of samples of different roles, on the same horizontal axis."""
    if not errors:
        return []
    quantity, unit = ERROR_GROUPS[group].label, ERROR_GROUPS[group].unit
    bins = plots.histogram_edges(*(np.concatenate(side) for side in zip(*errors.values(), strict=True)))
    panels = []
    for role, (before, after) in errors.items():
        rms = [Quantity.error(float(np.sqrt(np.mean(norms**2))), unit) for norms in (before, after)]
        count = f"{len(after)} {role} samples"
        text = f"Histogram of the {quantity} of {count}: RMS {rms[0]} before, {rms[1]} after."
        caption = f"{capitalized(quantity)}, {count}"
        plot = partial(plots.plot_error_histogram, before, after, quantity=quantity, unit=unit, bins=bins)
        panels.append(Panel(f"histogram-{role}-{group}", caption, text, plot, WIDE_PANEL, role=role))
    return panels


def residual_figures(context: ReportContext) -> list[FigureGroup]:
    """Draw the residual error of each joint, and the errors over the joint positions and over the samples."""
    group = _joint_offset_group(context)
    return [*([group] if group.panels else []), *sample_figures(context.samples)]


def session_figures(context: ReportContext) -> list[FigureGroup]:
    """Draw what changed over the samples, and their errors with the events."""
    session, samples = context.fit.session, context.samples
    if session is None:
        return []
    panels = []
    for i, history in enumerate(histories(session)):
        largest = Quantity.error(float(history.values.max()), history.unit)
        text = f"Change of {history.of} relative to the end of the measurement; at most {largest}."
        arrays = (history.numbers + 1, history.values, history.std)
        plot = partial(plots.plot_change, *arrays, of=history.of, unit=history.unit)
        panels.append(Panel(f"change-{i}", f"Change of {history.of}", text, plot, WIDE_PANEL))
    items = zip(
        (*context.data_names, *context.holdout_names), (*context.fit.data, *context.fit.holdout), strict=True
    )
    names = {item.source: name for name, item in items}
    marks = []
    for event in session.events:
        is_first = (samples.file == names.get(event.file)) & (samples.line == event.line)
        marks += [float(number) - 0.5 for number in samples.number[is_first][:1]]
    group = next(iter(samples.errors))
    quantity, unit = ERROR_GROUPS[group].label, ERROR_GROUPS[group].unit
    plot = partial(
        plots.plot_errors_by_sample,
        _errors_by_role(samples, group),
        quantity=quantity,
        unit=unit,
        marks=marks,
    )
    text = f"{capitalized(quantity)} of the samples after calibration; lines mark the events."
    panels.append(Panel("session-errors", f"{capitalized(quantity)} by sample", text, plot, WIDE_PANEL))
    return [FigureGroup(panels, layout="wide")]


def sample_figures(samples: Samples) -> list[FigureGroup]:
    """Draw the errors of samples over the joint positions and in the order of their files."""
    return [group for group in (_joint_error_group(samples), _sample_group(samples)) if group.panels]


def _joint_offset_group(context: ReportContext) -> FigureGroup:
    profiles = [profile for profile in context.joint_profiles if len(profile.centres)]
    offsets = {
        p.name: {"before": (p.before, p.before_std), "after": (p.after, p.after_std)} for p in profiles
    }
    largest = {
        state: max((_largest_offset(*offsets[p.name][state]) for p in profiles), default=0.0)
        for state in ("before", "after")
    }
    states = ["before", "after"] if largest["before"] <= MAX_SCALE_RATIO * largest["after"] else ["after"]
    sizes = {p.name: max(_largest_offset(*offsets[p.name][state]) for state in states) for p in profiles}
    panels = []
    for i, profile in enumerate(profiles):
        of_type = [sizes[p.name] for p in profiles if p.is_prismatic == profile.is_prismatic]
        shown = {state: offsets[profile.name][state] for state in states}
        worst = Quantity.error(
            float(np.nanmax(np.abs(profile.after))), "m" if profile.is_prismatic else "rad"
        )
        text = (
            f"Residual error of {profile.name} over its position, with two standard errors; at most "
            f"{worst} after calibration."
        )
        plot = partial(
            plots.plot_joint_offsets,
            profile.centres,
            shown,
            joint=profile.name,
            is_prismatic=profile.is_prismatic,
            limit=_offset_limit(sizes[profile.name], of_type),
        )
        panels.append(Panel(f"offset-{i}", profile.name, text, plot))
    marks = {"before": "dashes", "after": "line"}
    return FigureGroup(
        panels,
        "Residual joint-angle error over joint angle",
        [LegendEntry(state, state, marks[state]) for state in states],
    )


def _largest_offset(value: Array, std: Array) -> float:
    """Return the largest distance from zero, two standard errors included."""
    return float(np.nanmax(np.abs(value) + 2 * std, initial=0.0))


def _offset_limit(largest: float, all_largest: Sequence[float]) -> float:
    """Return the common scale of the joints of one type; a joint with much larger errors gets its own."""
    typical = MAX_SCALE_RATIO * float(np.median(all_largest))
    return max(largest, *(value for value in all_largest if value <= typical))


def joint_curve_figures(context: ReportContext) -> list[FigureGroup]:
    """Draw the correction curve of each joint with its band and the joint values that were not measured."""
    curves = context.joint_curves
    if not curves:
        return []
    # Where nothing was measured the band is wide; it does not set the scale.
    limit = max(_largest_offset(c.correction[c.is_measured], c.std[c.is_measured]) for c in curves)
    panels = []
    for i, curve in enumerate(curves):
        coverage = curve.coverage
        largest = Quantity.error(
            float(np.max(np.abs(curve.correction[curve.is_measured]), initial=0.0)), "rad"
        )
        text = (
            f"Correction of {coverage.joint} over its position, with its 95 % band; at most {largest} at the "
            f"measured joint values, which are {coverage.n_visited} of {coverage.n_in_range} bins."
        )
        plot = partial(
            plots.plot_joint_corrections,
            curve.values,
            curve.correction,
            curve.std,
            gaps=coverage.gaps,
            joint=coverage.joint,
            limit=limit,
        )
        panels.append(Panel(f"correction-{i}", coverage.joint, text, plot, WIDE_PANEL))
    legend = [
        LegendEntry("correction", "after", "line"),
        LegendEntry("95 % band", "after", "area"),
        LegendEntry("not measured", "unknown", "cell"),
    ]
    return [FigureGroup(panels, legend=legend, layout="wide")]


def _joint_error_group(samples: Samples) -> FigureGroup:
    """Draw the errors of samples over the positions of the joints."""
    group = next(iter(samples.errors))
    quantity, errors, panels = ERROR_GROUPS[group].label, samples.errors[group]["after"], []
    is_shown = np.isfinite(errors) & np.isfinite(samples.q).all(1)
    state = _shown_state(samples, group)
    for i, joint in enumerate(samples.chain.joint_names if is_shown.any() else ()):
        plot = partial(
            plots.plot_errors_over_joint,
            samples.q[is_shown, i],
            errors[is_shown],
            joint=joint,
            is_prismatic=bool(samples.chain.is_prismatic[i]),
            quantity=quantity,
            unit=ERROR_GROUPS[group].unit,
        )
        text = f"{capitalized(quantity)} of the samples{state} over the position of {joint}."
        points = (f"joint:{i}", f"error:{group}")
        panels.append(Panel(f"joint-{i}", joint, text, plot, points=points))
    legend = [LegendEntry("sample", "sample", "dots"), LegendEntry("median", "text", "line")]
    return FigureGroup(panels, f"{capitalized(quantity)} over joint position", legend)


def _sample_group(samples: Samples) -> FigureGroup:
    """Draw the errors of samples in the order of their files."""
    panels, roles = [], {}
    for group in samples.errors:
        by_role = _errors_by_role(samples, group)
        if not by_role:
            continue
        roles |= dict.fromkeys(by_role)
        quantity, unit = ERROR_GROUPS[group].label, ERROR_GROUPS[group].unit
        errors = np.concatenate([errors for _, errors in by_role.values()])
        caption = f"{capitalized(quantity)} by sample"
        largest = Quantity.error(float(errors.max()), unit)
        state = _shown_state(samples, group)
        text = f"{capitalized(quantity)} of {len(errors)} samples{state}; at most {largest}."
        plot = partial(plots.plot_errors_by_sample, by_role, quantity=quantity, unit=unit)
        points = ("number", f"error:{group}")
        panels.append(Panel(f"sample-{group}", caption, text, plot, WIDE_PANEL, points))
    legend = [LegendEntry(role, plots.sample_color(role, "hold-out" in roles), "dots") for role in roles]
    return FigureGroup(panels, "Errors in the order of the files", legend, "wide")


def _shown_state(samples: Samples, group: str) -> str:
    """Return which errors the figures show until a reader chooses others, as a part of a sentence."""
    return " after calibration" if "before" in samples.errors[group] else ""


def _errors_by_role(samples: Samples, group: str) -> dict[str, tuple[Array, Array]]:
    """Return numbers and error norms of the samples by role; outliers are a role of their own."""
    errors = samples.errors[group]["after"]
    is_shown, roles = np.isfinite(errors), {}
    for role in (*ROLES, "outlier"):
        has_role = samples.is_outlier if role == "outlier" else (samples.role == role) & ~samples.is_outlier
        if (chosen := is_shown & has_role).any():
            roles[role] = (samples.number[chosen], errors[chosen])
    return roles


def workspace_figures(context: ReportContext) -> list[FigureGroup]:
    """Draw maps of the predicted standard deviation of the tool position, beside the measured errors."""
    samples = context.samples
    errors = samples.errors.get("position", {}).get("after", np.full(len(samples), np.nan))
    is_measured = np.isfinite(errors) & np.isfinite(samples.q).all(1)
    poses = se3.inverse(samples.chain.base) @ samples.chain.poses(samples.q[is_measured])
    return workspace_maps(context.workspace, poses[:, :3, 3], errors[is_measured])


def workspace_maps(workspace: WorkspacePrediction, points: Array, errors: Array) -> list[FigureGroup]:
    """Draw maps of predicted standard deviations and of measured errors, with the same colours."""
    finite = workspace.std[np.isfinite(workspace.std)]
    if not finite.size:
        return []
    panels = []
    median, p95 = (Quantity.error(float(np.quantile(finite, q)), "m") for q in (0.5, 0.95))
    # Both sorts of maps fit into the scale, except for a few large errors, which may be outliers.
    most = np.sort(errors)[: math.ceil(0.95 * len(errors))]
    both = plots.std_levels(workspace.std), plots.std_levels(most)
    levels = max(both, key=lambda edges: edges[-1])
    region = np.concatenate([workspace.points, points])
    for plane, view in (("xy", "from above"), ("xz", "from the side")):
        plot = partial(plots.plot_position_std_map, plane=plane, levels=levels, region=region)
        text = (
            f"Map of the predicted standard deviation of the tool position over {plane[0]} and {plane[1]}: "
            f"median {median}, 95th percentile {p95}."
        )
        predicted = partial(plot, workspace.points, workspace.std, measured=workspace.measured)
        caption = f"Predicted, {view}"
        panels.append(Panel(f"map-{plane}", caption, text, predicted, SQUARE_PANEL, plane_points(plane)))
        if len(errors):
            rms = Quantity.error(float(np.sqrt(np.mean(errors**2))), "m")
            text = f"Map of the measured position errors over {plane[0]} and {plane[1]}: RMS {rms}."
            measured = partial(plot, points, errors)
            panels.append(Panel(f"errors-{plane}", f"Measured error, {view}", text, measured, SQUARE_PANEL))
    legend = level_legend(levels)
    if len(finite) < len(workspace.std):
        legend.append(LegendEntry("not predictable", "unknown", "cell"))
    if len(workspace.measured):
        legend.append(LegendEntry("measured samples", "measured", "dots"))
    return [FigureGroup(panels, legend=legend, layout="wide")]


def level_legend(levels: Array) -> list[LegendEntry]:
    """Return the meaning of the colours of a map with these edges between its levels [m]."""
    edges = 1e3 * levels
    decimals = max(0, 1 - math.floor(math.log10(edges[1])))
    texts = [f"{low:.{decimals}f}–{high:.{decimals}f} mm" for low, high in pairwise(edges)]
    texts[-1] = f"above {edges[-2]:.{decimals}f} mm"
    return [LegendEntry(text, f"level-{k}", "cell") for k, text in enumerate(texts)]


def plane_points(plane: str) -> tuple[str, ...]:
    """Return the coordinates of samples in a plane of the base frame, such as "xy"."""
    return tuple(f"base:{'xyz'.index(axis)}" for axis in plane)


def scene_figures(context: ReportContext) -> list[FigureGroup]:
    """Draw the robot before and after calibration: a 3-D scene on screens, two drawings in print."""
    fit, magnification = context.fit, scene_magnification(context)
    base = se3.inverse(fit.chain.base)
    nominal, calibrated = (
        se3.transform_points(base, points)
        for points in (_arm_points(chain, context) for chain in (fit.nominal_refitted, fit.chain))
    )
    arms = {"before": nominal, "after": nominal + magnification * (calibrated - nominal)}
    scale = f"errors {magnification:g} times larger" if magnification > 1 else "true to scale"
    panels = []
    for plane, side in (("xz", "From the side"), ("xy", "From above")):
        caption = f"{side}, {scale}"
        text = f"Joints of the robot before and after calibration over {plane[0]} and {plane[1]}."
        plot = partial(plots.plot_arms, arms, plane=plane, samples=context.workspace.measured)
        panels.append(Panel(f"arm-{plane}", caption, text, plot, SQUARE_PANEL))
    legend = [
        LegendEntry("nominal", "before", "dashes"),
        LegendEntry("calibrated", "after", "line"),
        LegendEntry("fitted samples", "sample", "dots"),
    ]
    page = scene.scene_html(
        fit.nominal_refitted,
        fit,
        title=context.robot_name,
        magnification=magnification,
        triangles=MAX_SCENE_TRIANGLES,
    )
    return [FigureGroup(panels, legend=legend, layout="wide", scene=packed_scene(page))]


def packed_scene(page: str) -> str:
    """Compress the page of a scene, with the script that moves its arm to selected samples."""
    script = SCENE_LINK.read_text("utf-8")
    linked = f"<script>\n{script}</script>\n</body>".join(page.rsplit("</body>", 1))
    return base64.b64encode(zlib.compress(linked.encode(errors="backslashreplace"))).decode()


def scene_magnification(context: ReportContext) -> float:
    """Choose how many times larger than true the errors of the robot are drawn."""
    nominal, calibrated = (
        _arm_points(chain, context)[:-1] for chain in (context.fit.nominal_refitted, context.fit.chain)
    )
    displacement = float(np.linalg.norm(calibrated - nominal, axis=1).max())
    wanted = DRAWN_DISPLACEMENT * float(np.ptp(nominal, axis=0).max()) / max(displacement, 1e-12)
    return min(max(round_up(max(wanted, 1e-3) / 2), 1.0), scene.MAX_MAGNIFICATION)


def _arm_points(chain: Chain, context: ReportContext) -> Array:
    """Return the origins of the bodies and the tool (k, 3) at the sample nearest to the middle of all [m]."""
    used = [item.configurations() for item in context.fit.data if item.configurations_per_row > 0]
    q = np.zeros((1, chain.n_joints))
    if used:
        points = context.workspace.measured
        nearest = int(np.argmin(np.linalg.norm(points - points.mean(0), axis=1)))
        q = np.concatenate(used)[nearest : nearest + 1]
    frames = chain.forward_kinematics(q)
    return np.array([*(body[3, :, 0] for body in frames.bodies), frames.tool[3, :, 0]])


def observability_figures(context: ReportContext) -> list[FigureGroup]:
    """Draw the singular values of the whitened Jacobian."""
    values, rank = context.fit.solution.system.singular_values, context.fit.rank
    if not (values.size and values[0] > 0):
        return []
    smallest = values[rank - 1] / values[0]
    text = (
        f"{len(values)} singular values, {rank} of them above the limit of the rank; the smallest of these "
        f"is {smallest:.2g} of the largest."
    )
    plot = partial(plots.plot_singular_values, values, rank)
    return [FigureGroup([Panel("singular-values", "Singular values", text, plot)])]
