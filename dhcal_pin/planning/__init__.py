"""Planning: which poses to measure."""
