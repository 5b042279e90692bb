"""Files: calibration files, JSON with checks, writing whole or not at all."""
