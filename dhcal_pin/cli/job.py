"""Calibration job: the options of `dhcal calibrate` for one robot.

The fields of `Job` declare these options once. The arguments of the command, the keys of a manifest of
several robots and the command line that a report shows are built from them. The metadata of a field are
keyword arguments of `argparse.ArgumentParser.add_argument`, and in addition

- `flags`: names on the command line; `--name` by default;
- `output`: the `Output` that the option names; None if it changes outputs only. The other options say how to
  calibrate. Output files are listed in the order of the fields.

A job contains text and numbers only, so it can be sent to another process.
"""

from __future__ import annotations

import shlex
from argparse import Namespace
from collections.abc import Mapping
from dataclasses import Field, field, fields
from typing import Any

from .._frozen import frozen
from ..exceptions import InvalidArgumentError
from . import job_outputs, options
from .output_table import Output, OutputFile, chosen_files

# Value of --holdout for regions of joint space that are left out in turn.
REGION = "region"
# Exit status with --strict of robots that are written with the verdict "caution".
DOUBTFUL = 4
# File extension of a bundle, and of a manifest of several jobs.
BUNDLE_ENDING = ".dhcal.zip"
MANIFEST_ENDING = ".fleet.toml"


def job_option(text: str, metavar: str = "", *, default: Any = None, **more: Any) -> Any:
    """Declare an option of `Job` by its help, its placeholder, its default and further metadata."""
    placeholder = {"metavar": metavar} if metavar else {}
    return field(default=default, metadata={"help": text, **placeholder, **more})


@frozen
class Job:
    """Options of `dhcal calibrate` for one robot, explained by `dhcal calibrate --help`."""

    robot: str = field(
        metadata={
            "flags": ("robot",),
            "metavar": "ROBOT",
            "nargs": "?",
            "type": options.ROBOT["type"],
            "help": f"{options.ROBOT['help']}; or a manifest of several robots, NAME{MANIFEST_ENDING}",
        }
    )
    data: tuple[str, ...] = field(
        metadata={
            "flags": ("data",),
            "metavar": "DATA",
            "nargs": "*",
            "help": f"{options.DATA['help']}; none with a manifest",
        }
    )
    output: str = field(
        metadata={
            "flags": ("-o", "--output"),
            "metavar": "OUT",
            "help": "; ".join(item.help for item in job_outputs.ROBOT_FORMATS.values())
            + "; with a manifest, a summary of all robots (.csv)",
            "output": None,
        }
    )
    tip: str | None = field(default=None, metadata=options.TIP)
    root: str | None = field(default=None, metadata=options.ROOT)
    package_dir: tuple[str, ...] = field(default=(), metadata=options.PACKAGE_DIR)
    columns: str | None = field(default=None, metadata=options.COLUMNS)
    sheet: str = field(default="", metadata=options.SHEET)
    rig: str | None = field(default=None, metadata=options.RIG)
    servos: str | None = field(default=None, metadata=options.SERVOS)
    skip_bad_rows: bool = field(default=False, metadata=options.SKIP_BAD_ROWS)
    mend: tuple[str, ...] = field(default=(), metadata=options.MEND)
    parameters: str | None = field(default=None, metadata=options.PARAMETERS)
    arm: str | None = field(default=None, metadata=options.ARM)
    turned: str = job_option(
        "joints that turn the other way than in the URDF, whose axes are reversed in the "
        "output: auto (decide it from the measurements of a low-cost arm; default), none, or names",
        "auto|none|JOINT[,JOINT]",
        default="auto",
    )
    extend: str = job_option(
        "joint error families to add if the measurements support them: auto (try all; default), "
        "none (geometry only), or some of {error_families}",
        "auto|none|FAMILY[,FAMILY]",
        default="auto",
    )
    fix: str = field(default="", metadata=options.FIX)
    free: str = field(default="", metadata=options.FREE)
    holdout: str | None = job_option(
        "hold-out data, excluded from the fit to measure the accuracy: a fraction such as 0.3, "
        f"or a measurement file; {REGION}: fit all data, and repeat the calibration without each region "
        "of joint space",
        f"FRACTION|FILE|{REGION}",
    )
    session: str = job_option(
        "auto: look for what happened during the measurement, such as a base that moved, and "
        "account for it (default); off: do not",
        default="auto",
        choices=("auto", "off"),
    )
    unordered: bool = job_option(
        "the rows are not in the order of measurement; only files may differ", default=False
    )
    method: str = job_option(
        "lm: Levenberg-Marquardt (default); gn: Gauss-Newton iteration of the paper",
        default="lm",
        choices=("lm", "gn"),
    )
    loss: str = job_option(
        "weights of the samples in the fit (default: auto): {losses}", "LOSS", default="auto"
    )
    priors: str | None = job_option(
        "prior standard deviations: default (if method is lm), none (if method is gn), or a TOML "
        "file by parameter name",
        "default|none|FILE",
    )
    bounds: str | None = job_option("lower and upper bounds by parameter name", "FILE.toml")
    instrument: str | None = field(default=None, metadata=options.INSTRUMENT)
    payload: str | None = job_option(
        "mass at the tip and its centre in the tip frame, for joint compliance: 5kg or 5kg@0,0,80mm",
        "KG[@X,Y,Z]",
    )
    max_iterations: int = job_option(
        "maximum number of iterations (default: 100)", "N", default=100, type=options.POSITIVE_INTEGER
    )
    seed: int = job_option(
        "random seed of the hold-out selection (default: 0)",
        "N",
        default=0,
        type=options.NON_NEGATIVE_INTEGER,
    )
    in_place: bool = job_option("allow OUT.urdf to replace ROBOT", default=False, output=None)
    world_joint: bool = job_option(
        "write the base pose into the URDF, as a joint from link `world`", default=False
    )
    tool_frame: str | None = job_option(
        "write the tool pose into the URDF, as a link of this name fixed to the tip", "NAME"
    )
    camera_frame: str | None = job_option(
        "write the pose of the camera into the URDF, as a link of this name fixed to the link "
        "that carries it; with several cameras, NAME_CAMERA each",
        "NAME",
    )
    camera_files: str | None = job_option(
        "write each camera for other programs: PREFIX_CAMERA.camera_info.yaml (ROS), "
        ".opencv.yaml and .handeye.yaml (transform from its link)",
        "PREFIX",
        output=None,
    )
    force: bool = job_option("write the corrected robot even if the calibration is refused", default=False)
    map: str | None = job_option(
        "write the predicted position uncertainty and the hold-out errors over the workspace (.csv or .html)",
        "MAP",
        output=Output("a map", (".csv", ".html")),
    )
    scene: str | None = job_option(
        "write the 3-D scene of the nominal and the calibrated robot (.html)",
        "SCENE.html",
        output=Output("a scene", (".html",), (".htm",)),
    )
    curves: str | None = job_option(
        "write joint corrections for controllers that accept a table: joint, value and the angle "
        "to add to it before it is commanded, in steps of 1 degree (.csv); beside it, the robot to use with "
        "it (.with_table.urdf)",
        "CURVES.csv",
        output=Output("a table of corrections", (".csv",)),
    )
    residuals: str | None = job_option(
        "write the residuals of all measurements with their files and lines (.csv)",
        "R.csv",
        output=Output("a table of residuals", (".csv",), is_written_if_refused=True),
    )
    json: str | None = field(
        default=None, metadata={**options.JSON, "output": Output(is_written_if_refused=True)}
    )
    report: tuple[str, ...] = job_option(
        "write a report (.html or .md); may be repeated",
        "R.html",
        default=(),
        output=Output("a report", (".html", ".md"), (".htm",), is_written_if_refused=True),
    )
    certificate: str | None = job_option(
        "write a certificate for quality records, to print or save as PDF (.html)",
        "C.html",
        output=Output("a certificate", (".html",), (".htm",)),
    )
    bundle: str | None = job_option(
        "write one file with all inputs, options and outputs, which --from repeats",
        f"NAME{BUNDLE_ENDING}",
        output=Output("a bundle", (BUNDLE_ENDING,), is_written_if_refused=True),
    )
    meta: tuple[str, ...] = job_option(
        "fact for the certificate: robot, serial, controller, instrument, temperature, location, "
        "date, operator or any other; may be repeated",
        "KEY=VALUE",
        default=(),
        output=None,
    )

    @classmethod
    def from_args(cls, args: Namespace) -> Job:
        """Create the job that a command line describes."""
        given = given_options(args)
        if missing := [name for name in ("robot", "output") if not given.get(name)]:
            flag = {"robot": "ROBOT", "output": "-o OUT.urdf"}[missing[0]]
            raise InvalidArgumentError(f"{flag} is required; see dhcal calibrate --help")
        return cls(**{"data": (), **given})

    @property
    def outputs(self) -> list[OutputFile]:
        """Output files except the robot."""
        rows = {option.name: option.metadata.get("output") for option in fields(self)}
        return chosen_files(vars(self), {name: output for name, output in rows.items() if output})

    @property
    def output_paths(self) -> list[str]:
        """Paths of all outputs; the sidecar is beside the first one."""
        return [self.output, *(file.path for file in self.outputs)]

    def command(self, names: Mapping[str, str]) -> str:
        """Format the command line of this job without the options that only name outputs.

        >>> Job("in/arm.urdf", ("in/a.csv",), "out.urdf", seed=3).command({"in/arm.urdf": "arm.urdf"})
        'dhcal calibrate arm.urdf in/a.csv --seed 3'
        """
        words = ["dhcal", "calibrate", *(names.get(path, path) for path in (self.robot, *self.data))]
        for option in fields(self):
            value = getattr(self, option.name)
            flag = option_flags(option)[-1]
            if flag.startswith("-") and "output" not in option.metadata and value != option.default:
                for item in value if isinstance(value, tuple) else (value,):
                    words += [flag] if item is True else [flag, names.get(str(item), str(item))]
        return shlex.join(words)


def option_flags(option: Field[Any]) -> tuple[str, ...]:
    """Return the names of an option on the command line."""
    return option.metadata.get("flags", (f"--{option.name.replace('_', '-')}",))


def given_options(args: Namespace) -> dict[str, Any]:
    """Return the options that a command line names, by the names of the fields."""
    values = {option.name: getattr(args, option.name, None) for option in fields(Job)}
    return {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in values.items()
        if value is not None and value != []
    }


def job_options() -> options.Options:
    """Declare the options of a job; those that are not named are absent from the arguments."""
    table: dict[str, Any] = {}
    for option in fields(Job):
        keywords = {key: v for key, v in option.metadata.items() if key not in ("flags", "output")}
        if option.default is False:
            keywords["action"] = "store_true"
        elif option.default == ():
            keywords["action"] = "append"
        table[" ".join(option_flags(option))] = {**keywords, "default": None}
    return table


def is_manifest(path: str) -> bool:
    """Tell a manifest of several jobs from a robot file by its name."""
    return path.lower().endswith(MANIFEST_ENDING)
