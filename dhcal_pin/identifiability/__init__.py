"""Identifiability: which parameters the measurements determine, and why not the others.

Numbers (rank, observability indices, directions) are in `observability`, the causes of unobservable
directions in `null_space`, their geometry in `propagation`, and the sentences for users in `explanations`.
All of them analyze a linearized problem; what solves problems belongs to `estimation`.
"""

from .explanations import (
    EXPECTED,
    explain_unobservable,
    explain_weakly_observable,
    label_unobservable,
)
from .observability import correlation, observability_indices, observable_fraction

__all__ = [
    "EXPECTED",
    "correlation",
    "explain_unobservable",
    "explain_weakly_observable",
    "label_unobservable",
    "observability_indices",
    "observable_fraction",
]
