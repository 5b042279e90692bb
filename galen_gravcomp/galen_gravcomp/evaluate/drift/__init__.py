"""Drift of a long recording without contact, and whether it is predictable."""
