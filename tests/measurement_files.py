"""Measurement files for the tests of diagnostics, and a UR10 with errors."""

import numpy as np
from robots import nominal_arm

from dhcal_pin import se3
from dhcal_pin.robot.chain import joint_frame


def joint_positions(chain, m=30, seed=0):
    return np.random.default_rng(seed).uniform(-2.5, 2.5, (m, chain.n_joints))


def frames():
    """Return the frames of an instrument 3 m away and of a target 0.2 m from the tip."""
    return se3.exp6(np.array([3.0, -1, 1, 0.4, 1, -2])), se3.exp6(np.array([0.1, 0.05, 0.2, 1, 1, 0]))


def csv_text_of(chain, q, *, joint="rad", length="mm", kind="pose", angle="rad", wrong=None):
    """Return a file whose header declares some units; `wrong` has the true ones where they differ."""
    factor = {"rad": 1.0, "deg": 180 / np.pi, "m": 1.0, "mm": 1e3}
    true = {"joint": joint, "length": length, "angle": angle} | (wrong or {})
    base, tool = frames()
    poses = base @ chain.poses(q) @ tool
    header = [f"{name}[{joint}]" for name in chain.joint_names] + [f"{axis}[{length}]" for axis in "xyz"]
    columns = [factor[true["joint"]] * q, factor[true["length"]] * poses[:, :3, 3]]
    if kind == "pose":
        header += [f"{axis}[{angle}]" for axis in ("rx", "ry", "rz")]
        columns.append(factor[true["angle"]] * se3.log3(poses[:, :3, :3]))
    rows = np.concatenate(columns, 1).tolist()
    return "\n".join([",".join(header), *(",".join(map(repr, row)) for row in rows)]) + "\n"


def real_ur10():
    """Return a UR10 with errors of up to 2 mm and 4 mrad at each joint."""
    rng = np.random.default_rng(3)
    arm = nominal_arm("ur10")
    scale = np.repeat([2e-3, 4e-3], 3)
    return arm.perturbed_at({joint_frame(j): se3.exp6(scale * rng.uniform(-1, 1, 6)) for j in range(1, 7)})
