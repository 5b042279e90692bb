"""Worked examples and simulated recordings."""
