"""Measured deflections from recordings of pushes."""
