"""A calibration file against recordings."""
