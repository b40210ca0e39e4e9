"""The one root of everything a user can cause."""


class DhcalError(ValueError):
    """Wrong input: its text is one line that names the place, what is wrong and what would be right."""
