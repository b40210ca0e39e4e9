"""Sources of measurements: which configurations a plan may choose, for tools and for images.

An image needs a board in view; other measurements of the tool can be taken in every configuration that the
robot can take.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._typing import Array
from ..measurements.camera import CameraCorners
from ..robot.sampling import ConfigurationSampler
from .view_sampler import ViewSampler
from .views import CameraViews, PlannedImages, summarize_views


@dataclass(frozen=True)
class ToolSource:
    """Measurements of the tool that can be taken in every configuration."""

    kind: str
    # What a configuration needs beside the constraints of the robot, for messages.
    condition = ""

    def restrict(self, sampler: ConfigurationSampler) -> ConfigurationSampler:
        """Restrict a sampler to configurations that can be measured: here all."""
        return sampler

    def can_measure(self, tools: Array) -> Array:
        """Return whether poses of the tool (m, 4, 4) can be measured, shape (m,): here all."""
        return np.ones(len(tools), bool)

    def summarize(self, tools: Array) -> tuple[CameraViews, ...]:
        """Return the images of a plan: here none."""
        return ()


@dataclass(frozen=True, eq=False)
class ImageSource:
    """Images of boards."""

    images: PlannedImages  # Cameras, boards and limits of their views
    kind = CameraCorners.kind
    condition = "; a board must be in view, and nothing may hide it"

    def restrict(self, sampler: ConfigurationSampler) -> ConfigurationSampler:
        """Restrict a sampler to views of a board."""
        return ViewSampler.from_sampler(sampler, self.images)

    def can_measure(self, tools: Array) -> Array:
        """Return in which poses of the tool (m, 4, 4) a board is in view, shape (m,)."""
        return self.images.in_view(tools)

    def summarize(self, tools: Array) -> tuple[CameraViews, ...]:
        """Describe the images of each camera."""
        return summarize_views(self.images, tools)


# What is measured in the configurations of a plan.
MeasurementSource = ToolSource | ImageSource
