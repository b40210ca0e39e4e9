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


class NotObservableError(DhcalError):
    """The measurements cannot determine what was asked for."""


class ConvergenceError(DhcalError):
    """An iteration diverged."""


class RefusedCalibrationError(DhcalError):
    """The verdict on a calibration is "refused", so its robot is not written."""
