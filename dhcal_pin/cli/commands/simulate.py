"""`dhcal simulate`: simulate measurements of a robot with known errors."""

from __future__ import annotations

import os
import re
from argparse import Namespace
from typing import TYPE_CHECKING

from ... import estimation, io, robot
from ...exceptions import InvalidArgumentError, UnknownNameError
from .. import options, screens

if TYPE_CHECKING:
    from ..._typing import PathLike
    from ...measurements import Measurement, Noise

EXAMPLE = "dhcal simulate arm.dh.toml --truth actual.dh.toml -n 50 --sigma 0.1mm,0.01deg -o data.csv"

ARGUMENTS: options.Options = {
    "robot ROBOT": {"type": options.ROBOT["type"], "help": f"nominal {options.ROBOT['help']}"},
    "-n --count -m --samples N": {
        "dest": "samples",
        "type": options.POSITIVE_INTEGER,
        "required": True,
        "help": "number of samples",
    },
    "--sigma --noise LENGTH[,ANGLE]": {
        "dest": "noise",
        "default": "0mm",
        "help": "standard deviation per axis, such as 0.1mm,0.01deg (default: %(default)s); for the kind "
        "camera in pixels, such as 0.2px",
    },
    "-o --output data.csv": {"required": True, "help": "measurement CSV file to write"},
    "--truth T.urdf": {
        "type": options.ROBOT["type"],
        "help": "robot with errors (default: ROBOT); conditions that its joint errors depend on, such as "
        "directions of approach or temperatures, are drawn and written",
    },
    "--errors LENGTH,ANGLE": "robot with random errors: standard deviations of the position and orientation "
    "of every joint origin, such as 1mm,0.3deg; drawn with the seed",
    "--kind KIND": {
        "default": "pose",
        "help": "kind of measurement (default: %(default)s): {kinds}; camera: six points on the tip in two "
        "cameras of 4096 x 4096 px, or more for large robots, that stand still, in which 1 mm at the robot "
        "is 1 px; their rig file NAME.rig.toml is written beside NAME.csv",
    },
    **options.URDF_OPTIONS,
    "--seed N": {
        "type": options.NON_NEGATIVE_INTEGER,
        "default": 0,
        "help": "random seed of joint values and noise (default: %(default)s)",
    },
    "--json": options.JSON,
}


def run(args: Namespace) -> int:
    """Simulate measurements and write them."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ...diagnostics.common_conditions import varied
    from ...measurements import KINDS, Noise
    from ...units import parse_noise
    from ..output_table import Output
    from ..outputs import checked_files, existing_sidecars, require_writable_outputs, write_with_json

    robots = [args.robot, *([args.truth] if args.truth else [])]
    inputs = [*robots, *existing_sidecars(robots)]
    checked_files(args, {"output": Output("measurements", (".csv",)), "json": Output()}, inputs)
    sigma = _length_of_pixels(args.noise) if args.kind == "camera" else args.noise
    noise = Noise(*parse_noise(sigma, "--sigma"))
    if args.truth and args.errors:
        raise InvalidArgumentError("--errors: not allowed with --truth, which is the robot with errors")
    if args.kind not in KINDS:
        raise UnknownNameError(f"--kind: unknown kind {args.kind!r}; choose from {', '.join(KINDS)}")
    _require_noise_of(KINDS[args.kind], noise, args.noise)
    nominal = truth = io.read_robot(args.robot, args.tip, root=args.root)
    if args.truth:
        truth = options.read_robot_or_table(args.truth, args)
        if truth.joint_names != nominal.joint_names:
            raise InvalidArgumentError(
                f"{args.truth}: its joints are {', '.join(truth.joint_names)}; "
                f"expected those of {args.robot}: {', '.join(nominal.joint_names)}"
            )
    elif args.errors:
        truth = _with_random_errors(nominal, *parse_noise(args.errors, "--errors"), args.seed)
    rng = np.random.default_rng(args.seed)
    q = rng.uniform(*robot.joint_range(nominal), (args.samples, nominal.n_joints))
    conditions = varied([truth], q, np.random.default_rng([args.seed, 2]))
    data = KINDS[args.kind].simulate(truth, conditions, noise, rng)
    errors = f" with random errors {args.errors}" if args.errors else ""
    comment = (
        f"simulated {args.kind} of {args.truth or args.robot}{errors}, noise {args.noise}, seed {args.seed}"
    )
    contents: dict[PathLike, str | bytes] = {args.output: io.measurement_text(data, nominal, [comment])}
    if data.rig is not None:
        rig_path = os.path.splitext(args.output)[0] + ".rig.toml"
        require_writable_outputs([rig_path], [*robots, args.output])
        contents[rig_path] = io.rig_text(data.rig.cameras, data.rig.boards)
    facts = {"samples": len(data.rows), "kind": args.kind, "noise": args.noise, "seed": args.seed}
    files: dict[str, str] = dict(zip(("output", "rig"), map(str, contents), strict=False))
    write_with_json(contents, args.json, files, inputs, tip=nominal.tip, **facts)
    screens.show(screens.simulation_screen(screens.robot_line(args.robot, nominal), contents), args.verbosity)
    return 0


def _require_noise_of(kind: type[Measurement], noise: Noise, text: str) -> None:
    """Require that noise which is not zero applies to a kind."""
    units = {group.unit for group in kind.residual_groups.values()}
    applies = {"m": noise.position, "px": noise.position, "rad": noise.rotation}
    if (noise.position or noise.rotation) and not any(applies[unit] for unit in units):
        examples = {"m": "0.1mm", "rad": "0.01deg", "px": "0.2px"}
        expected = ",".join(examples[unit] for unit in units)
        raise InvalidArgumentError(
            f"--sigma {text}: does not apply to the kind {kind.kind}; expected for example {expected}"
        )


def _length_of_pixels(noise: str) -> str:
    """Return noise in pixels as that in millimetres, which are as large in the simulated images."""
    return re.sub(r"^([0-9.eE+-]+)\s*px$", r"\1mm", noise.strip())


def _with_random_errors(nominal: robot.Chain, length: float, angle: float, seed: int) -> robot.Chain:
    """Move every joint origin by normally distributed errors, with standard deviations in m and rad."""
    import numpy as np  # lazy import: slow to load

    errors = estimation.select_parameters(nominal, "placement")
    std = np.array([length if parameter.unit == "m" else angle for parameter in errors.parameters])
    # A separate generator, so that the robot does not depend on the number of samples.
    return errors.at(std * np.random.default_rng([seed, 1]).standard_normal(len(std)))
