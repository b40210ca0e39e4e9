"""Job runner that fails on purpose, in a module that worker processes can import."""

import os
import signal

from dhcal_pin.exceptions import DhcalError


def run_or_fail(job):
    """Kill the process, raise an error or return a document, depending on the name of the robot."""
    if "killer" in job.robot:
        os.kill(os.getpid(), signal.SIGKILL)
    if "defect" in job.robot:
        raise ZeroDivisionError("by zero")
    if "wrong" in job.robot:
        raise DhcalError("wrong: input")
    status = "refused" if job.robot == "slow" else "ok"
    return {"verdict": {"status": status, "reasons": []}, "folder": os.getcwd()}
