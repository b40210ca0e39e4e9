"""A whole calibration by figaroh, in the environment where it is installed.

Run by `bench_rivals.py` in a folder that holds robot.urdf, fit.csv, holdout.csv and task.yaml; prints JSON
with CPU seconds, the RMS distance in metres on the held-out poses, and the modelled poses there: x, y, z [m],
roll, pitch and yaw [rad].
"""

import json
import logging
import sys
import time
import warnings

import numpy as np
import pinocchio as pin
from figaroh.calibration.base_calibration import BaseCalibration  # pyright: ignore[reportMissingImports]
from figaroh.calibration.calibration_tools import calc_updated_fkm  # pyright: ignore[reportMissingImports]
from figaroh.calibration.data_loader import load_data  # pyright: ignore[reportMissingImports]

TASK = """
robot:
  name: arm
tasks:
  calibration:
    enabled: true
    type: kinematic_calibration
    kinematics: {base_frame: BASE, tool_frame: TIP}
    parameters: {calibration_level: full_params, include_non_geometric: false, outlier_threshold: 10.0}
    measurements:
      markers: [{measurable_dof: [true, true, true, true, true, true]}]
      poses: {base_pose: [0, 0, 0, 0, 0, 0], tool_pose: [0, 0, 0, 0, 0, 0]}
    data: {source_file: fit.csv, number_of_samples: COUNT}
"""


class Robot:
    """What figaroh asks of a robot."""

    def __init__(self, path: str):
        self.model = pin.buildModelFromUrdf(path)
        self.data = self.model.createData()
        self.q0 = pin.neutral(self.model)


class Arm(BaseCalibration):
    """The rows that its own examples use, metres and radians alike."""

    def cost_function(self, var):  # noqa: D102
        modelled = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
        return self._compute_logmap_residuals(self.PEE_measured, modelled)


def main(base: str, tip: str, count: int) -> None:
    """Fits fit.csv and judges by holdout.csv."""
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    with open("task.yaml", "w") as file:
        file.write(TASK.replace("BASE", base).replace("TIP", tip).replace("COUNT", str(count)))
    robot = Robot("robot.urdf")
    start = time.process_time()
    arm = Arm(robot, "task.yaml")
    arm.calib_config |= {"known_baseframe": False, "known_tipframe": False}
    arm.initialize()
    arm.solve(enable_logging=False)
    spent = time.process_time() - start
    seen, q = load_data("holdout.csv", arm.model, arm.calib_config)
    modelled = calc_updated_fkm(arm.model, arm.data, arm.var_, q, arm.calib_config)
    miss = (seen - modelled).reshape(6, -1)[:3]
    rms = float(np.sqrt(np.mean(np.sum(miss**2, 0))))
    print(json.dumps({"seconds": spent, "holdout": rms, "poses": modelled.reshape(6, -1).T.tolist()}))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
