"""Identifiability: which parameters the measurements determine, and why not the others."""

from .explanations import explain_unobservable, explain_weakly_observable
from .observability import clusters, correlation, observability_indices, observable_fraction

__all__ = [
    "clusters",
    "correlation",
    "explain_unobservable",
    "explain_weakly_observable",
    "observability_indices",
    "observable_fraction",
]
