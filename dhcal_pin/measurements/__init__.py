"""Measurement models: residuals and Jacobians of every supported instrument."""
