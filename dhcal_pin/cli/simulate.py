"""What the small commands of `dhcal` do, once the command line is read.

Wrong input is found before anything is written or shown; JSON goes to stdout, all else to stderr.
"""

from __future__ import annotations

from argparse import Namespace

import numpy as np

from ..exceptions import DhcalError
from ..io.atomic import write_files
from ..io.measurement_csv import measurement_text
from ..io.robot import has_dh_table, read_robot
from ..measurements import KINDS
from ..measurements.base import Noise
from ..robot.sampling import joint_range
from ..units import parse_noise
from . import console
from .options import require_writable_outputs, sidecars


def simulate(args: Namespace) -> int:
    """Measurements of a robot that is known to be wrong."""
    robots = [args.robot, *([args.truth] if args.truth else [])]
    require_writable_outputs([args.output], [*robots, *sidecars(robots)])
    noise = Noise(*parse_noise(args.noise))
    if args.kind not in KINDS:
        raise DhcalError(f"--kind {args.kind}: choose from {', '.join(KINDS)}")
    chain = truth = read_robot(args.robot, args.tip)
    if args.truth:
        truth = read_robot(args.truth, None if has_dh_table(args.truth) else args.tip)
        if truth.joint_names != chain.joint_names:
            raise DhcalError(
                f"{args.truth}: its joints are {', '.join(truth.joint_names)}; "
                f"they must be those of {args.robot}: {', '.join(chain.joint_names)}"
            )
    rng = np.random.default_rng(args.seed)
    q = rng.uniform(*joint_range(chain), (args.samples, chain.n_joints))
    data = KINDS[args.kind].simulate(truth, q, noise, rng)
    comments = [f"simulated {args.kind} of {args.truth or args.robot}, noise {args.noise}, seed {args.seed}"]
    write_files({args.output: measurement_text(data, chain, comments)})
    console.print_lines(f"wrote {args.output}")
    return 0
