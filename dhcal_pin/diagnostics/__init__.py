"""Diagnostics: checks of input data and of residuals."""
