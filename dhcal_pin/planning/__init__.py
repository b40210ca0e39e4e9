"""Planning: which poses to measure, and which accuracy to expect of them."""

from .information import Information
from .planner import CRITERIA, Plan, plan

__all__ = [
    "CRITERIA",
    "Information",
    "Plan",
    "plan",
]
