"""Exceptions: every error that a user can cause is a `DhcalError` with a message of one line.

Messages have the form `<where>: <what is wrong>; <what is expected>`.
"""


class DhcalError(ValueError):
    """Base class of all errors that a user can cause."""


class FileFormatError(DhcalError):
    """A file cannot be read or written, or its content is invalid."""


class UnknownNameError(DhcalError):
    """A parameter, parameter set, measurement kind, joint, link, column or option is unknown.

    Attributes:
        argument: Argument of `calibrate` that the name is from; empty if it is not one that files contain.
    """

    def __init__(self, message: str, argument: str = ""):
        super().__init__(message)
        self.argument = argument


class InvalidArgumentError(DhcalError):
    """An argument has a wrong type, shape or value, or arguments contradict each other."""


class SampleError(InvalidArgumentError):
    """A sample of measurements is invalid.

    Attributes:
        sample: Number of the sample, counted from 0.
        problem: Message without the number, for readers of files, which know the line.
    """

    def __init__(self, sample: int, problem: str):
        super().__init__(f"sample {sample + 1}: {problem}")
        self.sample, self.problem = sample, problem


class NotObservableError(DhcalError):
    """The measurements cannot determine what was asked for."""


class ConvergenceError(DhcalError):
    """An iteration diverged."""


class RefusedCalibrationError(DhcalError):
    """The verdict on a calibration is "refused", so its robot is not written."""
