"""Identifiability: which parameters the measurements determine, and why not the others."""

from .explanations import unobservable, weakly_seen
from .observability import clusters, correlation, indices, seen_share

__all__ = [
    "clusters",
    "correlation",
    "indices",
    "seen_share",
    "unobservable",
    "weakly_seen",
]
