"""Checks of a robot file: joints that are much farther apart than the others.

URDFs are in metres. An origin in millimetres places a joint a thousand times too far away. Its distance from
the joint before is compared with the median distance of the other joints. Distances that are zero in the
design, and hardly more after a calibration, do not count. DH tables of parallel axes have long offsets that
cancel; therefore the tip must be as far away as well.
"""

from __future__ import annotations

import numpy as np

from .._typing import Array
from ..robot.chain import Chain
from ..robot.urdf import UrdfJoint

# A joint is too far away if its distance is more than this many times the median of the others.
_MAX_RATIO = 100.0
# Distances below this may be zero in the design [m].
_MIN_DISTANCE = 0.01
# Share of the distance that the tip must reach: less if it cancels with those of other joints.
_MIN_TIP_SHARE = 0.5
# Number of configurations in which the tip is placed.
_N_CONFIGURATIONS = 64


def find_robot_warnings(chain: Chain) -> list[str]:
    """Warn of joints whose origins are far outside of the others, one sentence each."""
    joints = _joints_of_arm(chain)
    distances = np.array([np.linalg.norm(joint.origin[:3, 3]) for joint in joints])
    usual = np.array([_usual_distance(np.delete(distances, i)) for i in range(len(joints))])
    is_far = (distances > _MAX_RATIO * usual) & (_MIN_TIP_SHARE * distances < _tip_distance(chain))
    return [
        f"the origin of joint {joints[i].name} is {distances[i]:.4g} m away from the joint before it, and "
        f"those of the other joints {usual[i]:.2g} m in the median; check its unit, lengths of a URDF are in "
        "metres"
        for i in np.flatnonzero(is_far)
    ]


def _usual_distance(distances: Array) -> float:
    """Return the median of distances [m] that are not zero in the design; infinity without such distances."""
    known = distances[distances >= _MIN_DISTANCE]
    return float(np.median(known)) if known.size else np.inf


def _joints_of_arm(chain: Chain) -> list[UrdfJoint]:
    """Return the joints of the URDF from root to tip, without those that place the arm at its root."""
    to_root, to_tip = ({j.name: j for j in chain.urdf.path(link)} for link in (chain.root, chain.tip))
    own = [joint for name, joint in to_root.items() if name not in to_tip]
    joints = [*reversed(own), *(joint for name, joint in to_tip.items() if name not in to_root)]
    first = next(i for i, joint in enumerate(joints) if joint.name in chain.moving_joints)
    return joints[first:]


def _tip_distance(chain: Chain) -> float:
    """Return the largest distance of the tip from the first joint in random configurations [m]."""
    low, high = np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi)
    q: Array = np.random.default_rng(0).uniform(low, high, (_N_CONFIGURATIONS, chain.n_joints))
    first = (chain.base @ chain.origins[0])[:3, 3]
    return float(np.linalg.norm(chain.poses(q)[:, :3, 3] - first, axis=1).max())
