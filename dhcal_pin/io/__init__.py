"""Files: robots, measurements, sidecars, settings."""
