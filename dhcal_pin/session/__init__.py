"""What happened during a session: events, drift, lag and scale, found from the order of the samples."""

from .check import Recheck, recheck
from .facts import History, Session, histories
from .refinement import refine_changes
from .scale import find_scale
from .search import can_have_session, find_session

__all__ = [
    "History",
    "Recheck",
    "Session",
    "can_have_session",
    "find_scale",
    "find_session",
    "histories",
    "recheck",
    "refine_changes",
]
