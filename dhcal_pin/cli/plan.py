"""`dhcal plan`: which poses to measure."""

from __future__ import annotations

import re
from argparse import Namespace
from typing import Any

import numpy as np

from .._typing import Array, PathLike
from ..compensation import compensate
from ..exceptions import DhcalError
from ..formatting import Table
from ..io.atomic import write_files
from ..io.measurement_csv import (
    configurations_text,
    read_configurations,
    read_measurement_file,
    read_targets,
)
from ..io.robot import read_robot
from ..io.settings import read_priors
from ..io.sidecar import existing_sidecar, read_instrument, read_uncertainty
from ..io.tabular import read_csv_table
from ..measurements.base import Noise
from ..planning.planner import Plan, plan
from ..report.document import file_digests, json_text, versions
from ..robot.chain import Chain
from ..robot.sampling import WorkspaceConstraints
from ..units import ANGLES, LENGTHS, parse_noise
from . import console
from .options import STDOUT, require_writable_outputs, sidecars, split_commas, write_json

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"


# A laser tracker and a good arm's repeatability, where neither --sigma nor --data tell.
_SIGMA = "0.1mm,0.01deg"


def run(args: Namespace) -> int:
    """Chooses poses and writes them, with what to expect of them."""
    given = [
        *(args.data or []),
        *filter(None, (args.candidates_from, args.task, args.columns, args.instrument)),
    ]
    priors = [args.priors] if args.priors not in (None, "default") else []
    inputs = [args.robot, *sidecars([args.robot]), *given, *priors]
    require_writable_outputs([args.output, args.json], inputs)
    chain = read_robot(args.robot, args.tip)
    space = _space(args)
    candidates: int | Array = args.candidates
    if args.candidates_from:
        candidates = read_configurations(args.candidates_from, chain, args.columns)
    data = [read_measurement_file(path, chain, args.columns).data for path in args.data or []]
    # Readings given tell themselves what they tell, and priors asked for stand alone.
    sidecar = None if args.data or args.priors else existing_sidecar(args.robot)
    learnt = read_uncertainty(sidecar, chain) if sidecar else None
    sigma = args.sigma or (None if any(item.kind == args.kind for item in data) else _SIGMA)
    with console.show_progress(f"choosing {args.count} poses"):
        found = plan(
            chain,
            args.count,
            kind=args.kind,
            noise=Noise(*parse_noise(sigma, "--sigma")) if sigma else None,
            parameters=args.parameters,
            priors=read_priors(args.priors) or "default",
            fix=split_commas(args.fix),
            free=split_commas(args.free),
            criterion=args.criterion,
            data=data,
            known=read_instrument(args.instrument) if args.instrument else None,
            prior_uncertainty=learnt,
            task=read_task(args.task, chain) if args.task else None,
            candidates=candidates,
            space=space,
            margin=Noise(*parse_noise(args.margin, "--margin")),
            seed=args.seed,
        )
    noise = found.information.noise
    document = _document(found, args)
    document |= {"inputs": file_digests(inputs), "versions": versions()}
    comments = [
        f"{args.count} poses to measure ({args.kind}, criterion {found.criterion}), as a short tour",
        f"predicted position error {1e3 * found.error:.4g} mm RMS with sigma "
        f"{1e3 * noise.position:.4g} mm, {np.degrees(noise.rotation):.4g} deg",
    ]
    contents: dict[PathLike, str | bytes] = {args.output: configurations_text(found.q, chain, comments)}
    if args.json and args.json != STDOUT:
        contents[args.json] = json_text(document)
    write_files(contents)
    if args.json == STDOUT:
        write_json(args.json, document)
    _say(found, args)
    return 0


def _space(args: Namespace) -> WorkspaceConstraints:
    """Where the tool may be, as the command line says it."""
    box = _places(args.box, "--box", "200,-400,100:900,400,800mm", 2) if args.box else None
    eye = _places(args.visible_from, "--visible-from", "3000,0,1200mm", 1)[0] if args.visible_from else None
    if box is not None and not np.all(box[0] < box[1]):
        raise DhcalError(f"--box {args.box}: the first corner must be below the second in x, y and z")
    if args.cone and eye is None:
        raise DhcalError("--cone needs --visible-from: where the instrument stands")
    cone = np.pi
    if args.cone:
        match = re.fullmatch(rf"\s*({_NUMBER})\s*(rad|deg)\s*", args.cone)
        cone = float(match[1]) / ANGLES[match[2]] if match else 0.0
        if not 0 < cone <= np.pi:
            raise DhcalError(f"--cone {args.cone}: write a half angle up to 180deg, as 30deg")
    return WorkspaceConstraints(box, eye, cone)


def _places(text: str, option: str, example: str, count: int) -> Array:
    """Places (count, 3) in m from coordinates with a unit at the end."""
    place = rf"\s*{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER}\s*"
    match = re.fullmatch(rf"({place}(?::{place}){{{count - 1}}})([a-zµμ]+)\s*", text)
    if not match or match[2] not in LENGTHS:
        raise DhcalError(f"{option} {text}: write x,y,z with a unit at the end, as {example}")
    return np.array(re.findall(_NUMBER, match[1]), float).reshape(count, 3) / LENGTHS[match[2]]


def _document(found: Plan, args: Namespace) -> dict[str, Any]:
    """What was chosen and what to expect, SI."""
    noise = found.information.noise
    return {
        "poses": len(found.q),
        "kind": args.kind,
        "criterion": found.criterion,
        "sigma_position_m": noise.position,
        "sigma_orientation_rad": noise.rotation,
        "rows": None if found.index is None else (found.index + 1).tolist(),
        "log_det": found.log_det,
        "predicted_position_rms_m": found.error,
        "random_position_rms_m": found.random_error,
        "relative_error": found.relative_error,
        "recommended_size": found.recommended_size,
        "curve": [
            {"poses": int(size), "predicted_position_rms_m": float(error)}
            for size, error in zip(found.sizes, found.errors, strict=True)
        ],
        "random_curve": [
            {"poses": int(size), "predicted_position_rms_m": float(error)}
            for size, error in zip(found.random_sizes, found.random_errors, strict=True)
        ],
        "notes": list(found.notes),
        "files": {"poses": args.output} | ({"json": args.json} if args.json not in (None, STDOUT) else {}),
    }


def _say(found: Plan, args: Namespace) -> None:
    """The table and the sentences."""
    random = dict(zip(found.random_sizes.tolist(), found.random_errors.tolist(), strict=True))
    sizes = found.sizes.tolist()
    last = {len(found.q), sizes[-1]} | ({found.recommended_size} if found.recommended_size else set())
    shown = sorted(size for size in {*random, *last} if size in sizes)
    rows = [
        [
            str(size),
            f"{1e3 * found.errors[sizes.index(size)]:.4f}",
            f"{1e3 * random[size]:.4f}" if size in random else "",
        ]
        for size in shown
    ]
    content = Table(["poses", "planned mm", "random mm"], rows, n_text_columns=0)
    console.print_table("predicted position error, RMS over the task", content)
    console.print_lines("")
    console.print_lines(
        f"{len(found.q)} planned poses leave {found.relative_error:.2f} of the error that as many at random leave"
    )
    if found.recommended_size:
        console.print_lines(
            f"more poses stop paying at {found.recommended_size}: ten more would lower what a check shows by under 1 %"
        )
    else:
        console.print_lines(f"more poses still pay at {sizes[-1]}")
    console.print_notes(found.notes)
    console.print_lines(f"wrote {args.output}")


def read_task(path: PathLike, chain: Chain) -> Array:
    """Joint values (m, n) of a task: as the file has them, or such that the tool is on its targets.

    Targets are places or poses of the chain's tool in the measuring frame.

    Raises:
        DhcalError: what is wrong, or a target that is out of reach.
    """
    columns = read_csv_table(path).columns
    if any(name in columns for name in chain.joint_names):
        return read_configurations(path, chain)
    targets = read_targets(path, chain)
    found = compensate(chain, chain, targets.values)
    if (lost := np.flatnonzero(~found.reached)).size:
        raise DhcalError(
            f"{targets.source}: target {lost[0] + 1} is out of reach ({found.status[lost[0]]}); "
            "correct or remove it"
        )
    return found.q
