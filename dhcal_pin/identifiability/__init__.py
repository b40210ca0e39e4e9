"""Identifiability: what the measurements can determine."""
