"""A calibration: the procedure, its poses and its estimate."""
