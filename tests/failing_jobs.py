"""Jobs of a fleet that fail, in a module that worker processes can import."""

from __future__ import annotations

import os
import signal

from dhcal_pin.exceptions import DhcalError


def dies(job):
    """A run that brings its process down where the robot is called so."""
    if "killer" in job.robot:
        os.kill(os.getpid(), signal.SIGKILL)
    if "defect" in job.robot:
        raise ZeroDivisionError("by nought")
    if "wrong" in job.robot:
        raise DhcalError("wrong: input")
    return {"converged": job.robot != "slow", "folder": os.getcwd()}
