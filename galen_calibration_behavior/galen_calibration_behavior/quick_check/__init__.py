"""The calibration check: a few poses, then an answer."""
