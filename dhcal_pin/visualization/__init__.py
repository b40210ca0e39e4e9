"""Visualization: plots and three-dimensional scenes."""
