"""The one root of everything a user can cause."""

from __future__ import annotations


class DhcalError(ValueError):
    """Wrong input: its text is one line that names the place, what is wrong and what would be right."""
