"""Options of `dhcal plan`."""

from __future__ import annotations

from argparse import ArgumentParser
from math import radians

from . import options

# Standard deviation of a laser tracker and a precise robot, used without --sigma and --data.
DEFAULT_SIGMA = "0.1mm,0.01deg"
# Standard deviation of detected corners and the same robot, used with --rig.
DEFAULT_IMAGE_SIGMA = "0.3px,0.1mm,0.01deg"
# The same of a low-cost arm, whose joints have play.
DEFAULT_LOW_COST_SIGMA = "0.3px,1mm,0.5deg"
# Views of a low-cost arm, which is led to the poses by hand or by servos with wrong zeros.
LOW_COST_VIEWS = {"min_share": 0.4, "joint_error": radians(3.0)}
# Poses of a check.
N_RECHECKED = 10
# Random candidates; images have more rows each, and more of their candidates are good.
N_CANDIDATES, N_IMAGE_CANDIDATES = 5000, 2000
# The same of images of a low-cost arm: with five joints, few poses have the board in view.
N_LOW_COST_CANDIDATES = 400


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the arguments of `dhcal plan`."""
    parser.add_argument("robot", **options.ROBOT)
    parser.add_argument(
        *("-n", "--count", "-m", "--samples"),
        dest="count",
        type=options.POSITIVE_INTEGER,
        metavar="N",
        help=f"number of poses; {N_RECHECKED} with --recheck if it is not given",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="poses.csv",
        required=True,
        help="joint values to write, ordered as a short tour",
    )
    options.add_urdf_options(parser)
    parser.add_argument(
        "--iso9283",
        action="store_true",
        help="plan a test according to ISO 9283 in place of a calibration: the points P1 to P5 of a cube in "
        "the workspace, in this order in each cycle; the column iso_point names point and cycle, such as "
        "P1:12, for `dhcal validate --iso9283`",
    )
    parser.add_argument(
        "--cube",
        metavar="SIDE",
        help="with --iso9283: side of the cube, such as 400mm (default: the largest of 1000, 630, 400 and "
        "250 mm that fits into the workspace)",
    )
    parser.add_argument(
        "--cycles",
        type=options.POSITIVE_INTEGER,
        metavar="N",
        help="with --iso9283: number of cycles (default: 30)",
    )
    _add_measurement_options(parser)
    _add_calibration_options(parser)
    _add_search_options(parser)
    options.add_motion_options(parser, "deg")
    parser.add_argument("--html", metavar="FILE", help="page with a preview of the poses and the moves")
    parser.add_argument("--report", metavar="R.html", help="write a report with the poses (.html)")
    parser.add_argument("--json", **options.JSON)


def _add_measurement_options(parser: ArgumentParser) -> None:
    """Declare what is measured, and with which instrument."""
    parser.add_argument(
        "--kind",
        metavar="KIND",
        help="kind of measurement (default: pose; camera with --rig): {plannable_kinds}",
    )
    parser.add_argument(
        "--sigma",
        "--noise",
        metavar="[PIXELS,]LENGTH[,ANGLE]",
        help="standard deviation per axis of instrument and robot repeatability (default: as in --data, else "
        f"{DEFAULT_SIGMA}); with --rig, of corners in the image and of the robot (default: "
        f"{DEFAULT_IMAGE_SIGMA})",
    )
    parser.add_argument(
        "--rig",
        metavar=options.RIG["metavar"],
        help="plan images by these cameras of these boards, with approximate poses and intrinsics; poses "
        "that are missing are those of a calibrated robot, or are estimated from --data",
    )
    parser.add_argument(
        "--distance",
        metavar="MIN:MAXUNIT",
        help="with --rig: distance of the middle of a board from the camera at which images are sharp, such "
        "as 300:900mm (default: from the size of the board in the image)",
    )
    parser.add_argument(
        "--angle",
        metavar="ANGLE",
        help="with --rig: largest angle between the normal of a board and the line of sight (default: 60deg)",
    )
    parser.add_argument(
        "--corners",
        metavar="SHARE",
        type=float,
        help="with --rig: smallest share of the corners of a board that is in the image (default: 1; 0.4 "
        "for a low-cost arm)",
    )
    parser.add_argument(
        "--border",
        metavar="PIXELS",
        help="with --rig: distance of the corners from the edge of the image, such as 60px; more if the "
        "poses of camera and board are uncertain (default: 2 %% of the width)",
    )


def _add_calibration_options(parser: ArgumentParser) -> None:
    """Declare the goal, and the calibration for which the poses are planned."""
    parser.add_argument(
        "--recheck",
        action="store_true",
        help="plan a check of a calibrated robot for `dhcal recheck`: poses that reveal a change of the zero "
        "of a joint, of the base or of the tool",
    )
    parser.add_argument(
        "--repeat",
        action="store_true",
        help="measure up to three of the poses at the begin, in the middle and at the end, so that a change "
        "during the measurement can be found; they count among the N poses",
    )
    parser.add_argument(
        "--criterion",
        metavar="C",
        help="optimality criterion (default: D): {criteria}",
    )
    parser.add_argument(
        "--task",
        metavar="FILE",
        help="configurations where the accuracy matters: joint values, or tool positions x[mm],y[mm],z[mm]",
    )
    parser.add_argument("--parameters", **options.PARAMETERS)
    parser.add_argument("--arm", **options.ARM)
    parser.add_argument("--servos", **options.SERVOS)
    parser.add_argument("--fix", default="", **options.FIX)
    parser.add_argument("--free", default="", **options.FREE)
    parser.add_argument(
        "--priors",
        metavar="default|FILE",
        help="prior standard deviations, as in calibrate (default: the uncertainty in the sidecar of a "
        "calibrated robot, else default)",
    )
    parser.add_argument("--instrument", **options.INSTRUMENT)
    parser.add_argument(
        "--data", **{**options.DATA, "help": f"existing measurements to complement: {options.DATA['help']}"}
    )
    parser.add_argument("--columns", **options.COLUMNS)
    parser.add_argument("--sheet", **options.SHEET)
    parser.add_argument("--skip-bad-rows", **options.SKIP_BAD_ROWS)


def _add_search_options(parser: ArgumentParser) -> None:
    """Declare where the poses may be."""
    parser.add_argument(
        "--candidates",
        type=options.POSITIVE_INTEGER,
        metavar="N",
        help=f"number of random candidates (default: {N_CANDIDATES}; {N_IMAGE_CANDIDATES} with --rig, "
        f"{N_LOW_COST_CANDIDATES} with --rig for a low-cost arm, 1500 with --iso9283)",
    )
    parser.add_argument(
        "--from", dest="candidates_from", metavar="FILE", help="choose from the joint values in a file"
    )
    parser.add_argument(
        "--box", metavar="X,Y,Z:X,Y,ZUNIT", help="allowed box of the tool in the measuring frame"
    )
    parser.add_argument(
        "--floor",
        metavar="HEIGHT|none",
        help="height of the floor above the root link, which the robot stays above (default: 0mm; none with "
        "--root); none for a robot without a floor, such as one on a ceiling",
    )
    parser.add_argument(
        "--obstacle",
        metavar="SCENE.urdf|X,Y,Z:X,Y,ZUNIT",
        action="append",
        default=[],
        help="obstacle in the frame of the root link: the collision shapes of a URDF, or a box; may be "
        "repeated",
    )
    parser.add_argument(
        "--visible-from",
        metavar="X,Y,ZUNIT",
        help="position of the instrument in the measuring frame; its line of sight to the tool must be free",
    )
    parser.add_argument(
        "--cone",
        metavar="ANGLE",
        help="largest angle between the z axis of the tool and the direction to the instrument, such "
        "as 30deg",
    )
    parser.add_argument(
        "--margin",
        default="5mm,2deg",
        metavar="LENGTH,ANGLE",
        help="distance to the joint limits (default: %(default)s)",
    )
    parser.add_argument(
        "--seed",
        metavar="N",
        type=options.NON_NEGATIVE_INTEGER,
        default=0,
        help="random seed of the candidates (default: %(default)s)",
    )
