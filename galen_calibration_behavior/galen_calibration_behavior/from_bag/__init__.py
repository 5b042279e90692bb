"""Calibration, inertia and cables from recordings."""
