"""`dhcal view`: show a robot on an offline web page, or as a live scene until it is interrupted."""

from __future__ import annotations

import os
import tempfile
from argparse import Namespace
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ... import diagnostics, io, robot
from ...exceptions import InvalidArgumentError
from ...formatting import texts_by_file
from .. import options, screens
from ..output_table import Output, chosen_files, require_endings

if TYPE_CHECKING:
    from ...measurements import Measurement

OUTPUTS = {"html": Output("a scene", (".html",), (".htm",))}

EXAMPLE = "dhcal view ur10.urdf ur10_calibrated.urdf --tip tool0 --data laser.csv --html scene.html"

ARGUMENTS: options.Options = {
    "nominal NOMINAL.urdf": {"type": options.ROBOT["type"], "help": options.ROBOT["help"]},
    "calibrated CALIBRATED.urdf": {"nargs": "?", "help": "the same robot, calibrated"},
    "--data": {
        **options.DATA,
        "help": f"{options.DATA['help']}; their poses are drawn and played",
        "default": [],
    },
    **options.TABLE_OPTIONS,
    "--skip-bad-rows": options.SKIP_BAD_ROWS,
    "--rig RIG.toml": "cameras and boards to draw, with their poses (default: those of the calibrated "
    "robot, which play image coordinates, too); needed for image coordinates of a robot that is not "
    "calibrated",
    "--html FILE": "page to write (default: a temporary file, opened in the browser)",
    **options.open_option("open the page in the browser"),
    "--magnification S": {
        "type": float,
        "default": 1.0,
        "help": "initial magnification of the errors, 1 to 500 (default: 1)",
    },
    "--simplify N": {
        "type": options.POSITIVE_INTEGER,
        "nargs": "?",
        "default": 60_000,
        "const": 15_000,
        "help": "maximum number of mesh triangles; fewer give a smaller page (default: %(default)s; "
        "%(const)s without N)",
    },
    "--live": "serve a moving scene on this computer until Ctrl-C, no page",
    "--fit-frames": options.FIT_FRAMES,
    **options.URDF_OPTIONS,
    "--json": options.JSON,
}


def run(args: Namespace) -> int:
    """Write the page of a robot, or serve a live scene."""
    from ...visualization import scene  # lazy import, as the following: they load Pinocchio
    from ..outputs import existing_sidecars, require_workbook, require_writable_outputs, write_with_json

    if args.live and (args.html or args.open or args.json):
        raise InvalidArgumentError("--live writes no page; omit --html, --open and --json")
    if args.fit_frames and not args.data:
        raise InvalidArgumentError(
            "--fit-frames: needs --data, the measurements to which base and tool are fitted"
        )
    robots = [args.nominal, *([args.calibrated] if args.calibrated else [])]
    sidecars = existing_sidecars(robots)
    page = args.html or os.path.join(tempfile.mkdtemp(prefix="dhcal-"), f"{io.robot_name(args.nominal)}.html")
    settings = filter(None, (args.rig, args.columns, args.servos))
    inputs = [*robots, *sidecars, *args.data, *settings]
    require_writable_outputs([page, args.json], inputs)
    require_workbook(args.sheet, inputs)
    require_endings(chosen_files(vars(args), OUTPUTS))
    chains = [options.read_robot_or_table(path, args) for path in robots]
    sidecar = io.existing_sidecar(robots[-1])
    rig = options.read_mounted_rig(args.rig, sidecar, chains[-1])
    servos = io.read_servos(args.servos) if args.servos else None
    files = options.read_data(args, chains[0], servos, rig)
    data = [file.data for file in files]
    known = io.read_instrument(sidecar) if sidecar else {}
    predictor = io.read_uncertainty(sidecar, chains[-1]) if sidecar and len(chains) > 1 else None
    warnings = {}
    if args.fit_frames:
        predictor = None  # The uncertainty holds for base and tool as calibrated.
        fits = [diagnostics.fit_frames(chain, data, known) for chain in chains]
        chains, known = [fit.chain for fit in fits], known | fits[-1].instruments
    elif data and diagnostics.frames_differ(chains[-1], data, known):
        warnings[robots[-1]] = [diagnostics.FRAMES_WARNING]
    if args.live:
        return _serve_live(chains, data, args)
    text = scene.scene_html(
        *chains,
        rig=rig,
        measurements=data,
        known=known,
        predictor=predictor,
        title=" and ".join(io.robot_name(path) for path in robots),
        magnification=args.magnification,
        triangles=args.simplify,
    )
    write_with_json({page: text}, args.json, {"html": page}, inputs, warnings=texts_by_file(warnings))
    notes = texts_by_file({file.source: file.notes for file in files})
    screens.show(screens.files_screen([page], notes, warnings), args.verbosity)
    if args.open if args.open is not None else not args.html:
        screens.open_page(page)
    return 0


def _serve_live(chains: Sequence[robot.Chain], data: Sequence[Measurement], args: Namespace) -> int:
    """Play the measured poses repeatedly in a live scene."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ...visualization import live

    q = np.concatenate([item.configurations() for item in data] or [np.zeros((1, chains[0].n_joints))])
    with live.serve(*chains, magnification=args.magnification, triangles=args.simplify) as server:
        screens.print_lines(server.url, "end with Ctrl-C")
        if args.open is not False:
            screens.open_url(server.url)
        try:
            while True:
                server.play(q)
        except KeyboardInterrupt:
            return 0
