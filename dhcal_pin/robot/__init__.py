"""Robot models: kinematic chains from URDF and Denavit-Hartenberg tables."""
