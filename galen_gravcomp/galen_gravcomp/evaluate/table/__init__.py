"""Load models against tables of readings."""
