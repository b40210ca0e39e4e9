"""Visualization: plots, and three-dimensional scenes in MeshCat."""

from .scene import Scene, scene_html, show

__all__ = [
    "Scene",
    "scene_html",
    "show",
]
