"""Output files of `dhcal plan`: the table of its options, and the functions that make the contents."""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..io.measurement_files import configurations_text
from ..io.robot import robot_name
from ..io.servo_file import read_servos
from ..planning.planner import Plan
from ..planning.views import CameraViews
from ..programs import FORMATS, Program, Stop, program_text
from ..report.provenance import versions
from ..robot.chain import Chain
from .output_table import Makers, Output, chosen_files, paths_by_name


@frozen(eq=False)
class Planned:
    """Plan of a command, from which its output files are made."""

    plan: Plan
    chain: Chain
    given: Mapping[str, Any]  # Keyword arguments of `plan`
    rows: Array  # Row of each given candidate in its file, from 0, shape (m,)
    args: Namespace
    digests: Mapping[str, str]  # SHA-256 of each input file by path

    @cached_property
    def moves(self) -> list[str]:
        """Sentences on the moves between the poses."""
        result = self.plan
        if not result.is_way_free:
            return []
        blocked = [str(i) for i, is_free in enumerate(result.is_way_free, 1) if not is_free]
        with_way_points = [str(i) for i, way in enumerate(result.ways, 1) if len(way)]
        texts = []
        if with_way_points:
            listed = ", ".join(with_way_points)
            texts.append(f"Way points lead around collisions to poses {listed} (--export, --html).")
        if blocked:
            texts.append(
                f"The straight moves to poses {', '.join(blocked)} collide; no way around was found."
            )
        return texts or [
            "The straight moves in joint space are free of collisions as far as these are checked."
        ]

    @cached_property
    def poses_text(self) -> str:
        """Content of the file of poses."""
        plan, noise, images = self.plan, self.plan.information.noise, self.given["images"]
        pixels = f"{images.sigma:.4g} px, " if images else ""
        comments = [
            f"{len(plan.q)} poses to measure ({self.given['kind']}, criterion {plan.criterion}), as a short "
            "tour",
            f"predicted position error {1e3 * plan.error:.4g} mm RMS with standard deviation "
            f"{pixels}{1e3 * noise.position:.4g} mm, {np.degrees(noise.rotation):.4g} deg",
        ]
        comments += _counts(self)
        return configurations_text(plan.q, self.chain, [*comments, *self.moves], self.args.joint_units)

    @cached_property
    def scene(self) -> str:
        """Page that shows the poses, the path, cameras and boards, floor and obstacles."""
        from ..visualization import Preview, scene_html  # lazy import: only for pages

        plan, images = self.plan, self.given["images"]
        path = [part for way, q in zip(plan.ways, plan.q, strict=True) for part in (way, q[None])]
        stops = np.cumsum([len(way) + 1 for way in plan.ways]) - 1
        return scene_html(
            self.chain,
            preview=Preview(np.concatenate(path), stops.tolist(), self.given["space"]),
            rig=images.rig if images else None,
            title=f"{len(plan.q)} poses for {robot_name(self.args.robot)}",
        )


def _counts(done: Planned) -> list[str]:
    """Return the counts of the servos at each pose."""
    if not done.args.servos:
        return []
    servos, names = read_servos(done.args.servos).servos, done.chain.joint_names
    lines = []
    for number, q in enumerate(done.plan.q, 1):
        values = dict(zip(names, q.tolist(), strict=True))
        counts = [
            f"{s.joint} {round(s.zero + values[s.joint] / s.step)}" for s in servos if s.joint in values
        ]
        lines.append(f"counts of pose {number}: {', '.join(counts)}")
    return lines


def _program_content(done: Planned, path: str) -> str:
    """Make the program that visits the poses."""
    plan = done.plan
    poses = replace(done.chain, base=np.eye(4)).poses(plan.q)
    is_checked = bool(plan.is_way_free)
    stops = [
        Stop(f"pose {i + 1}", q, pose, tuple(way), not is_checked or plan.is_way_free[i])
        for i, (q, pose, way) in enumerate(zip(plan.q, poses, plan.ways, strict=True))
    ]
    warning = (
        "The move to pose 1 is not checked for collisions; the others are checked against the model."
        if is_checked
        else "The moves are not checked for collisions."
    )
    return program_text(Program(done.chain, "poses to measure, by dhcal plan", warning, stops), path)


def _report_content(done: Planned) -> str:
    """Make the report with the poses."""
    from ..report.plan import PlanReport, plan_page  # lazy import: only for reports

    images, text = done.given["images"], done.poses_text
    return plan_page(
        PlanReport(
            plan=done.plan,
            chain=done.chain,
            name=robot_name(done.args.robot),
            file=os.path.basename(done.args.output),
            first_line=text.count("\n") - len(done.plan.q) + 1,
            text=text,
            moves=done.moves,
            scene=done.scene,
            inputs=done.digests,
            pixel_sigma=images.sigma if images else np.nan,
        )
    )


OUTPUTS = {
    "output": Output("poses", (".csv",)),
    "json": Output(),
    "export": Output("a program", tuple(FORMATS)),
    "html": Output("a scene", (".html",), (".htm",)),
    "report": Output("the report of a plan", (".html",), (".htm",)),
}


def content_makers(done: Planned) -> Makers:
    """Return the functions that make the output files."""
    return {
        "output": lambda path: done.poses_text,
        "export": lambda path: _program_content(done, path),
        "html": lambda path: done.scene,
        "report": lambda path: _report_content(done),
    }


def plan_document(done: Planned) -> dict[str, Any]:
    """Create the JSON document of a plan, in SI units; NaN becomes null when it is written."""
    result, noise = done.plan, done.plan.information.noise
    files = paths_by_name(chosen_files(vars(done.args), OUTPUTS))
    return {
        "poses": len(result.q),
        "kind": done.given["kind"],
        "criterion": result.criterion,
        "sigma_position_m": noise.position,
        "sigma_orientation_rad": noise.rotation,
        "rows": None if result.index is None else (done.rows[result.index] + 1).tolist(),
        "log_det": result.log_det,
        "predicted_position_rms_m": result.error,
        "predicted_position_rms_with_points_m": result.error_with_points,
        "random_position_rms_m": result.random_error,
        "relative_error": result.relative_error,
        "recommended_size": result.recommended_size,
        "curve": _curve(result.sizes, result.errors),
        "random_curve": _curve(result.random_sizes, result.random_errors),
        "joint_curves": [
            {"poses": one.n_poses, "filled_share": one.filled_share, "curve_std_rad": one.curve_std}
            for one in result.curves
        ],
        "way_points": {str(i): way.tolist() for i, way in enumerate(result.ways, 1) if len(way)},
        "blocked_moves": [i for i, is_free in enumerate(result.is_way_free, 1) if not is_free],
        "views": [_view_entry(view) for view in result.views],
        "notes": list(result.notes),
        "files": {"poses": files["output"]}
        | {name: files[name] for name in ("json", "html", "report") if name in files},
        "inputs": done.digests,
        "versions": versions(),
    }


def _view_entry(view: CameraViews) -> dict[str, Any]:
    """Convert the planned images of a camera to JSON."""
    return {
        "camera": view.camera,
        "images": view.n_images,
        "covered_share": view.covered_share,
        "distance_min_m": view.distances[0],
        "distance_max_m": view.distances[1],
        "angle_max_rad": view.max_angle,
    }


def _curve(sizes: Array, errors: Array) -> list[dict[str, float]]:
    """Convert a curve of errors over the number of poses to JSON."""
    return [
        {"poses": int(size), "predicted_position_rms_m": float(error)}
        for size, error in zip(sizes, errors, strict=True)
    ]
