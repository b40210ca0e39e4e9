"""`dhcal plan --iso9283`: poses of a test according to ISO 9283, its output files and its screen."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..exceptions import InvalidArgumentError
from ..formatting import Table
from ..io.measurement_files import configurations_text
from ..iso9283.cube import CYCLES, N_CENTRES, SIDES, IsoCube, find_iso_cube
from ..measurements.base import Noise
from ..programs import Program, Stop, program_text
from ..report.provenance import file_digests, versions
from ..robot.chain import Chain
from ..units import parse_noise
from .options import read_one_robot
from .output_table import Makers, chosen_files, file_contents, paths_by_name
from .outputs import checked_files, write_outputs
from .plan_input import input_paths, parse_length, workspace_constraints
from .plan_outputs import OUTPUTS as OUTPUTS_OF_PLANS
from .screens import console
from .screens.result_screens import files_block, notes_block
from .screens.screen import Block, Screen

# Options of other plans.
_NAMES = "recheck repeat kind sigma rig criterion task parameters priors data html report"
_EXCLUDED = {"-n": "count", "--from": "candidates_from"} | {f"--{name}": name for name in _NAMES.split()}


@frozen(eq=False)
class IsoPlanned:
    """Planned test, from which its output files are made."""

    cube: IsoCube
    chain: Chain
    cycles: int
    args: Namespace
    digests: Mapping[str, str]  # SHA-256 of each input file by path

    @property
    def labels(self) -> list[str]:
        """Point and cycle of each row, such as P1:12."""
        return [f"P{point}:{cycle}" for cycle in range(1, self.cycles + 1) for point in range(1, 6)]

    @cached_property
    def q(self) -> Array:
        """Joint positions of all rows, (5 c, n) for c cycles [rad or m]."""
        return np.tile(self.cube.q, (self.cycles, 1))

    @cached_property
    def positions(self) -> Array:
        """Positions of the points in the measuring frame, (5, 3) [m]."""
        return self.chain.poses(self.cube.q)[:, :3, 3]

    @property
    def title(self) -> str:
        """Sentence on the cube and the cycles."""
        centre = ", ".join(f"{1e3 * value:.1f}" for value in self.cube.centre)
        return (
            f"ISO 9283: {self.cycles} cycles of P1 to P5 in a cube of {1e3 * self.cube.side:g} mm with "
            f"centre {centre} mm"
        )


def _poses_text(done: IsoPlanned) -> str:
    """Return the content of the file of poses."""
    comments = [done.title, "move to P5 before the first row: every point is approached from the one before"]
    return configurations_text(done.q, done.chain, comments, done.args.joint_units, done.labels)


def _program_content(done: IsoPlanned, path: str) -> str:
    """Make the program that visits the points."""
    poses = np.tile(replace(done.chain, base=np.eye(4)).poses(done.cube.q), (done.cycles, 1, 1))
    stops = [Stop(*each) for each in zip(done.labels, done.q, poses, strict=True)]
    stops[0] = replace(stops[0], way=(done.cube.q[-1],))
    warning = "The move to the first point is not checked for collisions; the others are checked."
    return program_text(Program(done.chain, done.title, warning, stops), path)


OUTPUTS = {name: OUTPUTS_OF_PLANS[name] for name in ("output", "json", "export")}


def run_iso_plan(args: Namespace) -> int:
    """Choose the poses of a test according to ISO 9283, write and show them."""
    for option, name in _EXCLUDED.items():
        if getattr(args, name):
            raise InvalidArgumentError(f"{option}: not allowed with --iso9283, which states all poses")
    inputs = input_paths(args)
    files = checked_files(args, OUTPUTS, inputs)
    sides = [parse_length(args.cube, "--cube", "a side with a unit, such as 400mm")] if args.cube else SIDES
    if sides[0] <= 0:
        raise InvalidArgumentError(f"--cube {args.cube}: expected a side above zero, such as 400mm")
    space, margin = workspace_constraints(args), Noise(*parse_noise(args.margin, "--margin"))
    chain = read_one_robot(args.robot, args)
    with console.show_progress("looking for a cube"):
        cube = find_iso_cube(chain, sides, space, margin, args.candidates or N_CENTRES, args.seed)
    done = IsoPlanned(cube, chain, args.cycles or CYCLES, args, file_digests(inputs))
    makers: Makers = {
        "output": lambda path: _poses_text(done),
        "export": lambda path: _program_content(done, path),
    }
    contents = file_contents(files, makers)
    write_outputs(contents, args.json, _document(done))
    rows = [[f"P{i}", *(f"{1e3 * value:.3f}" for value in row)] for i, row in enumerate(done.positions, 1)]
    blocks = [
        Block(Table(["point", "x, mm", "y, mm", "z, mm"], rows), title=done.title, is_verdict=True),
        notes_block(cube.notes),
        files_block(contents),
    ]
    console.show(Screen(blocks), args.verbosity)
    return 0


def _document(done: IsoPlanned) -> dict[str, Any]:
    """Create the JSON document, in SI units."""
    files = paths_by_name(chosen_files(vars(done.args), OUTPUTS))
    return {
        "poses": len(done.q),
        "side_m": done.cube.side,
        "centre_m": done.cube.centre.tolist(),
        "cycles": done.cycles,
        "points": [
            {"point": f"P{i}", "q": q.tolist(), "position_m": position.tolist()}
            for i, (q, position) in enumerate(zip(done.cube.q, done.positions, strict=True), 1)
        ],
        "notes": list(done.cube.notes),
        "files": {"poses" if name == "output" else name: path for name, path in files.items()},
        "inputs": done.digests,
        "versions": versions(),
    }
