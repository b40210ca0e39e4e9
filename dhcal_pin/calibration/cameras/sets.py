"""Parameter sets of a rig: which parameters of cameras and boards are unknown.

They are named together with the sets of the robot, as in `placement,camera,board,intrinsics`. A set that is
not named is held at the values of the rig; parameters without such a value are estimated in any case.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ...estimation.parameters import LOW_COST, set_names
from ...exceptions import InvalidArgumentError
from ...measurements.base import Measurement
from ...measurements.camera import select_images
from ...robot.chain import Chain

# Parameter sets of a rig by name, with one line for help texts.
RIG_SETS = {
    "camera": "pose of each camera of the rig in its link",
    "board": "pose of each board of the rig in its link",
    "intrinsics": "focal lengths, image centre and distortion of each camera, unless the rig fixes them",
}
# Sets that are estimated by default from image coordinates; those of the arm are others for a low-cost arm.
_ARM_SETS = "placement,offset"
DEFAULT_SETS = f"{_ARM_SETS},camera,board,intrinsics"
# Sets that are estimated by default from images of which only the pose of the tip is known.
HAND_EYE_SETS = "camera,board,intrinsics"
# The same beside other instruments, which measure in a frame of their own and at a target of their own.
MIXED_SETS = f"{DEFAULT_SETS},base,tool"
# Largest number of corners of all boards that are estimated to judge whether boards are as stated.
MAX_POINTS = 150


def split_sets(parameters: str | Iterable[str]) -> tuple[list[str], list[str]]:
    """Separate the sets of the rig from those of the robot."""
    names = set_names(parameters)
    return [name for name in names if name not in RIG_SETS], [name for name in names if name in RIG_SETS]


def has_images(data: Sequence[Measurement]) -> bool:
    """Return whether there are image coordinates among measurements."""
    return any(item.rig is not None for item in data)


def image_sets(chain: Chain, sets: str = DEFAULT_SETS) -> str:
    """Return parameter sets of images for the type of arm: its own in place of those of other arms."""
    return sets.replace(_ARM_SETS, LOW_COST) if LOW_COST in chain.parameters else sets


def default_sets(chain: Chain, data: Sequence[Measurement]) -> str:
    """Return the parameter sets that are estimated by default."""
    if not has_images(data):
        return chain.parameters
    if not has_joint_values(data):
        return HAND_EYE_SETS
    return image_sets(chain, DEFAULT_SETS if all(item.rig is not None for item in data) else MIXED_SETS)


def has_joint_values(data: Sequence[Measurement]) -> bool:
    """Return whether the joint positions of all images were measured, rather than poses of the tip."""
    return all(item.has_joint_values for item in data)


def describe_configurations(data: Sequence[Measurement]) -> str:
    """Name what the files state of the robot, for messages."""
    return "joint values" if has_joint_values(data) else "flange poses"


def require_joint_values(data: Sequence[Measurement], names: Sequence[str]) -> None:
    """Check that parameters of the arm, other than base and tool, are estimated from joint values only."""
    if has_joint_values(data):
        return
    arm = [name for name in names if name not in ("base", "tool")]
    if arm:
        raise InvalidArgumentError(
            f"parameters {arm[0]!r}: need joint values, and the images have poses of the tip instead; "
            f"expected {HAND_EYE_SETS}, or joint values"
        )
    others = sorted({item.kind for item in data if item.rig is None})
    if others and has_images(data):
        raise InvalidArgumentError(
            f"measurements of kind {others[0]} beside images with poses of the tip: they need joint values; "
            "expected images alone, or joint values"
        )


def held_values(data: Sequence[Measurement], sets: Sequence[str]) -> dict[str, float]:
    """Find the parameters of cameras and boards that are held at the values of the rig."""
    images = select_images(data)
    if sets and not images:
        raise InvalidArgumentError(
            f"parameter set {sets[0]!r} needs image coordinates; expected measurements with the columns u, v "
            "and corner, and --rig RIG.toml"
        )
    return {
        name: value
        for item in images
        for name, value in item.stated_values.items()
        if item.set_of(name) not in sets
    }


def count_corners(data: Sequence[Measurement]) -> int:
    """Return the number of corners of all boards."""
    boards = {board.name: len(board.points) for item in select_images(data) for board in item.rig.boards}
    return sum(boards.values())
