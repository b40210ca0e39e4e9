"""`dhcal view`: the offline page of an arm, or a live scene of it until it is interrupted."""

from __future__ import annotations

import os
import tempfile
from argparse import Namespace

import numpy as np

from ..exceptions import DhcalError
from ..io.atomic import write_files
from ..io.measurement_csv import read_measurements
from ..io.robot import has_dh_table, read_robot, robot_name
from ..io.sidecar import existing_sidecar, read_instrument, read_uncertainty
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..visualization import scene
from . import console
from .options import require_writable_outputs, sidecars


def view(args: Namespace) -> int:
    """Writes the page, opens it where asked for or where no file is named."""
    if args.live and (args.html or args.open):
        raise DhcalError("--live writes no page; leave out --html and --open")
    given = [args.nominal, *([args.calibrated] if args.calibrated else [])]
    beside = sidecars(given)
    page = args.html or os.path.join(tempfile.mkdtemp(prefix="dhcal-"), f"{robot_name(args.nominal)}.html")
    require_writable_outputs([page], [*given, *beside, *args.data])
    arms = [read_robot(path, None if has_dh_table(path) else args.tip) for path in given]
    data = [read_measurements(path, arms[0]) for path in args.data]
    if args.live:
        return _live(arms, data, args)
    sidecar = existing_sidecar(given[-1])
    text = scene.scene_html(
        *arms,
        measurements=data,
        known=read_instrument(sidecar) if sidecar else None,
        predictor=read_uncertainty(sidecar, arms[-1]) if sidecar and len(arms) > 1 else None,
        title=" and ".join(robot_name(path) for path in given),
        magnification=args.magnification,
        triangles=args.simplify,
    )
    write_files({page: text})
    console.print_lines(f"wrote {page}")
    if args.open or not args.html:
        console.open_page(page)
    return 0


def _live(arms: list[Chain], data: list[Measurement], args: Namespace) -> int:
    """Plays the measured poses over and over."""
    from ..visualization import (
        live,  # MeshCat's Python side takes half a second to import
    )

    poses = np.concatenate([item.configurations() for item in data] or [np.zeros((1, arms[0].n_joints))])
    with live.serve(*arms, magnification=args.magnification, triangles=args.simplify) as scene:
        console.print_lines(f"live at {scene.url}; end with Ctrl-C")
        console.open_url(scene.url)
        try:
            while True:
                scene.play(poses)
        except KeyboardInterrupt:
            return 0
