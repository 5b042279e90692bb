"""Inertial forces of a load, and identification of its inertia."""
