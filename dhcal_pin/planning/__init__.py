"""Planning of measurements: which poses to measure, and which accuracy to expect.

Optimality criteria, knowledge before a measurement, and the search for good poses belong here. Random
configurations, workspace constraints and collision checks belong to `robot`.
"""

from .information import Information, plannable_kinds
from .planner import CRITERIA, Plan, plan

__all__ = [
    "CRITERIA",
    "Information",
    "Plan",
    "plan",
    "plannable_kinds",
]
