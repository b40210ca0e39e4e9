"""Options of `dhcal plan`."""

from __future__ import annotations

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

ARGUMENTS: options.Options = {
    "robot": options.ROBOT,
    "-n --count -m --samples N": {
        "dest": "count",
        "type": options.POSITIVE_INTEGER,
        "help": f"number of poses; {N_RECHECKED} with --recheck if it is not given",
    },
    "-o --output poses.csv": {"required": True, "help": "joint values to write, ordered as a short tour"},
    **options.URDF_OPTIONS,
    "--iso9283": "plan a test according to ISO 9283 in place of a calibration: the points P1 to P5 of a "
    "cube in the workspace, in this order in each cycle; the column iso_point names point and cycle, such "
    "as P1:12, for `dhcal validate --iso9283`",
    "--cube SIDE": "with --iso9283: side of the cube, such as 400mm (default: the largest of 1000, 630, 400 "
    "and 250 mm that fits into the workspace)",
    "--cycles N": {
        "type": options.POSITIVE_INTEGER,
        "help": "with --iso9283: number of cycles (default: 30)",
    },
    # What is measured, and with which instrument.
    "--kind KIND": "kind of measurement (default: pose; camera with --rig): {plannable_kinds}",
    "--sigma --noise [PIXELS,]LENGTH[,ANGLE]": "standard deviation per axis of instrument and robot "
    f"repeatability (default: as in --data, else {DEFAULT_SIGMA}); with --rig, of corners in the image and "
    f"of the robot (default: {DEFAULT_IMAGE_SIGMA})",
    "--rig RIG.toml": "plan images by these cameras of these boards, with approximate poses and intrinsics; "
    "poses that are missing are those of a calibrated robot, or are estimated from --data",
    "--distance MIN:MAXUNIT": "with --rig: distance of the middle of a board from the camera at which "
    "images are sharp, such as 300:900mm (default: from the size of the board in the image)",
    "--angle ANGLE": "with --rig: largest angle between the normal of a board and the line of sight "
    "(default: 60deg)",
    "--corners SHARE": {
        "type": float,
        "help": "with --rig: smallest share of the corners of a board that is in the image (default: 1; 0.4 "
        "for a low-cost arm)",
    },
    "--border PIXELS": "with --rig: distance of the corners from the edge of the image, such as 60px; more "
    "if the poses of camera and board are uncertain (default: 2 %% of the width)",
    # The goal, and the calibration for which the poses are planned.
    "--recheck": "plan a check of a calibrated robot for `dhcal recheck`: poses that reveal a change of the "
    "zero of a joint, of the base or of the tool",
    "--repeat": "measure up to three of the poses at the beginning, in the middle and at the end, so that a "
    "change during the measurement can be found; they count among the N poses",
    "--criterion C": "optimality criterion (default: D): {criteria}",
    "--task FILE": "configurations where the accuracy matters: joint values, or tool positions "
    "x[mm],y[mm],z[mm]",
    "--parameters": options.PARAMETERS,
    "--arm": options.ARM,
    "--servos": options.SERVOS,
    "--fix": {"default": "", **options.FIX},
    "--free": {"default": "", **options.FREE},
    "--priors default|FILE": "prior standard deviations, as in calibrate (default: the uncertainty in the "
    "sidecar of a calibrated robot, else default)",
    "--instrument": options.INSTRUMENT,
    "--data": {**options.DATA, "help": f"existing measurements to complement: {options.DATA['help']}"},
    "--columns": options.COLUMNS,
    "--sheet": options.SHEET,
    "--skip-bad-rows": options.SKIP_BAD_ROWS,
    # Where the poses may be.
    "--candidates N": {
        "type": options.POSITIVE_INTEGER,
        "help": f"number of random candidates (default: {N_CANDIDATES}; {N_IMAGE_CANDIDATES} with --rig, "
        f"{N_LOW_COST_CANDIDATES} with --rig for a low-cost arm, 1500 with --iso9283)",
    },
    "--from FILE": {"dest": "candidates_from", "help": "choose from the joint values in a file"},
    "--box X,Y,Z:X,Y,ZUNIT": "allowed box of the tool in the measuring frame",
    "--floor HEIGHT|none": "height of the floor above the root link, which the robot stays above (default: "
    "0mm; none with --root); none for a robot without a floor, such as one on a ceiling",
    "--obstacle SCENE.urdf|X,Y,Z:X,Y,ZUNIT": {
        "action": "append",
        "default": [],
        "help": "obstacle in the frame of the root link: the collision shapes of a URDF, or a box; may be "
        "repeated",
    },
    "--visible-from X,Y,ZUNIT": "position of the instrument in the measuring frame; its line of sight to "
    "the tool must be free",
    "--cone ANGLE": "largest angle between the z axis of the tool and the direction to the instrument, such "
    "as 30deg",
    "--margin LENGTH,ANGLE": {
        "default": "5mm,2deg",
        "help": "distance to the joint limits (default: %(default)s)",
    },
    "--seed N": {
        "type": options.NON_NEGATIVE_INTEGER,
        "default": 0,
        "help": "random seed of the candidates (default: %(default)s)",
    },
    # Outputs.
    **options.motion_options("deg"),
    "--html FILE": "page with a preview of the poses and the moves",
    "--report R.html": "write a report with the poses (.html)",
    "--json": options.JSON,
}
